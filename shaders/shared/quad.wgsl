// Gaussians on four neighbouring pixels of a row.

// 1 for the pixels of a quad that lie in the picture, else 0.
fn inside(x: u32, y: u32, view: View) -> vec4<f32> {
    let in_row = vec4<u32>(x) + vec4<u32>(0u, 1u, 2u, 3u) < vec4<u32>(view.size.x);
    return select(vec4<f32>(0.0), vec4<f32>(1.0), in_row & vec4<bool>(y < view.size.y));
}

// What the exponent of a Gaussian (base 2, opacity included) has in common along a row: c1 dx + c0.
struct Row {
    c1: f32,
    c0: f32,
}

fn row_of(s0: vec4<f32>, s1: vec4<f32>, dy: f32) -> Row {
    return Row(s0.w * dy, fma(s1.x * dy, dy, s1.y));
}

// Alpha of one Gaussian on a quad; 0 where it is not drawn. Far out on a long needle, rounding would lift it above any opacity.
fn alphas(dx: vec4<f32>, qx: f32, row: Row) -> vec4<f32> {
    let alpha = min(exp2(fma(dx, fma(vec4<f32>(qx), dx, vec4<f32>(row.c1)), vec4<f32>(row.c0))), vec4<f32>(ALPHA_MAX));
    return select(vec4<f32>(0.0), alpha, alpha >= vec4<f32>(ALPHA_MIN));
}
