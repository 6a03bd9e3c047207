// Blur along the columns of `rows` [planes][4][padded rows][quads], which the pass declares.
// Returns eight rows of a quad.
#import window

fn at(map: u32, quad: u32, j: i32) -> vec4<f32> {
    let row = u32(clamp(j, 0, i32(plane.rows) - 1));
    let value = rows[((4u * plane_index + map) * plane.rows + row) * plane.quads + quad];
    return select(vec4<f32>(0.0), value, j >= 0 && j < i32(plane.rows));
}

fn blurred(map: u32, quad: u32, first: i32) -> array<vec4<f32>, 8> {
    let a = array<vec4<f32>, 18>(
#each K 18
        at(map, quad, first + $K - 5),
#end
    );
    return array<vec4<f32>, 8>(
#each K 8
        window(a[$Ku + 5u], a[$Ku + 4u] + a[$Ku + 6u], a[$Ku + 3u] + a[$Ku + 7u], a[$Ku + 2u] + a[$Ku + 8u], a[$Ku + 1u] + a[$Ku + 9u], a[$Ku] + a[$Ku + 10u]),
#end
    );
}
