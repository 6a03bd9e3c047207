// Gaussians on four neighbouring pixels of a row.

// Returns 1 for pixels of a quad that lie in the image, else 0.
fn inside(x: u32, y: u32, view: View) -> vec4<f32> {
    let in_row = vec4<u32>(x) + vec4<u32>(0u, 1u, 2u, 3u) < vec4<u32>(view.size.x);
    return select(vec4<f32>(0.0), vec4<f32>(1.0), in_row & vec4<bool>(y < view.size.y));
}

// Linear coefficients of a Gaussian's exponent (base 2, including opacity) in one row:
// qx dx^2 + c1 dx + c0.
struct Row {
    c1: f32,
    c0: f32,
}

fn row_of(s0: vec4<f32>, s1: vec4<f32>, dy: f32) -> Row {
    return Row(s0.w * dy, fma(s1.x * dy, dy, s1.y));
}

// Returns the alphas of one Gaussian on a quad; 0 below ALPHA_MIN. The minimum with ALPHA_MAX is
// needed because rounding lifts the exponent far out on a long, thin Gaussian.
fn alphas(dx: vec4<f32>, qx: f32, row: Row) -> vec4<f32> {
    let alpha = min(exp2(fma(dx, fma(vec4<f32>(qx), dx, vec4<f32>(row.c1)), vec4<f32>(row.c0))), vec4<f32>(ALPHA_MAX));
    return select(vec4<f32>(0.0), alpha, alpha >= vec4<f32>(ALPHA_MIN));
}
