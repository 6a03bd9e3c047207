// Blur along a row: returns the two middle quads of six neighbouring ones.
#import window

fn blurred_row(v: array<vec4<f32>, 6>) -> array<vec4<f32>, 2> {
    // Quads that start 5 pixels before the first output, 4 before it, and so on.
    let a = array<vec4<f32>, 15>(
        vec4<f32>(v[0].w, v[1].xyz),
        v[1],
        vec4<f32>(v[1].yzw, v[2].x),
        vec4<f32>(v[1].zw, v[2].xy),
        vec4<f32>(v[1].w, v[2].xyz),
        v[2],
        vec4<f32>(v[2].yzw, v[3].x),
        vec4<f32>(v[2].zw, v[3].xy),
        vec4<f32>(v[2].w, v[3].xyz),
        v[3],
        vec4<f32>(v[3].yzw, v[4].x),
        vec4<f32>(v[3].zw, v[4].xy),
        vec4<f32>(v[3].w, v[4].xyz),
        v[4],
        vec4<f32>(v[4].yzw, v[5].x),
    );
    return array<vec4<f32>, 2>(
        window(a[5], a[4] + a[6], a[3] + a[7], a[2] + a[8], a[1] + a[9], a[0] + a[10]),
        window(a[9], a[8] + a[10], a[7] + a[11], a[6] + a[12], a[5] + a[13], a[4] + a[14]),
    );
}
