// The blur along columns of `rows` [maps][h][w], a buffer that the pass declares; outside the picture is zero.
#import window

fn at(map: u32, column: u32, j: i32) -> f32 {
    let row = u32(clamp(j, 0, i32(plane.height) - 1));
    let value = rows[(map * plane.height + row) * plane.width + column];
    return select(0.0, value, j >= 0 && j < i32(plane.height));
}

fn blurred(map: u32, column: u32, first: i32) -> array<f32, 8> {
    return blur(array<f32, 18>(
        at(map, column, first - 5), at(map, column, first - 4), at(map, column, first - 3), at(map, column, first - 2), at(map, column, first - 1), at(map, column, first + 0),
        at(map, column, first + 1), at(map, column, first + 2), at(map, column, first + 3), at(map, column, first + 4), at(map, column, first + 5), at(map, column, first + 6),
        at(map, column, first + 7), at(map, column, first + 8), at(map, column, first + 9), at(map, column, first + 10), at(map, column, first + 11), at(map, column, first + 12),
    ));
}
