// The blur along columns of `rows` [maps][padded rows / 2][quads], a buffer that the pass declares, which holds every second row of a map and
// lies between zeros: eight rows of a quad.
#import window

fn at(map: u32, quad: u32, j: i32) -> vec4<f32> {
    let held = i32(plane.rows / 2u);
    let value = rows[(map * (plane.rows / 2u) + u32(clamp(j, 0, held - 1))) * plane.quads + quad];
    return select(vec4<f32>(0.0), value, j >= 0 && j < held);
}

fn blurred(map: u32, quad: u32, first: i32) -> array<vec4<f32>, 8> {
    // Rows that are held have five of the window's taps on rows that are held, the others have the six between these.
    let on = array<vec4<f32>, 8>(
#each K 8
        at(map, quad, first / 2 + $K - 2),
#end
    );
    let beside = array<vec4<f32>, 9>(
#each K 9
        at(map, quad, first / 2 + $K - 2 - i32(plane.phase)),
#end
    );
    let none = vec4<f32>(0.0);
#each K 4
    let held$K = window(on[$Ku + 2u], none, on[$Ku + 1u] + on[$Ku + 3u], none, on[$Ku] + on[$Ku + 4u], none);
    let between$K = window(none, beside[$Ku + 2u] + beside[$Ku + 3u], none, beside[$Ku + 1u] + beside[$Ku + 4u], none, beside[$Ku] + beside[$Ku + 5u]);
#end
    let odd = plane.phase == 1u;
    return array<vec4<f32>, 8>(
#each K 4
        select(held$K, between$K, odd),
        select(between$K, held$K, odd),
#end
    );
}
