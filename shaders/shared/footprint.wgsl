// The ellipse on which alpha equals ALPHA_MIN. Two vec4s for each Gaussian:
// (mean.xy, lean, spread) (squared half height, apex, first tile row, end tile row), with
//   lean    shift in x of the middle of the ellipse for each pixel in y: cov_xy / cov_yy
//   spread  squared half width in a row divided by (half height^2 - dy^2): det / cov_yy^2
//   apex    dy of the rightmost point; the leftmost point is at -apex
//
// Returns first and end (excluded) tile that the ellipse touches in a row of tiles, measured at
// pixel centres.
fn footprint_span(f0: vec4<f32>, f1: vec4<f32>, row: u32, tiles_x: u32) -> vec2<u32> {
    let half_height = sqrt(f1.x);
    let top = max(f32(row * TILE) + 0.5 - f0.y, -half_height);
    let bottom = min(f32(row * TILE + TILE) - 0.5 - f0.y, half_height);
    let dy_right = clamp(f1.y, top, max(top, bottom));
    let dy_left = clamp(-f1.y, top, max(top, bottom));
    let right = f0.x + f0.z * dy_right + sqrt(max(f1.x - dy_right * dy_right, 0.0) * f0.w);
    let left = f0.x + f0.z * dy_left - sqrt(max(f1.x - dy_left * dy_left, 0.0) * f0.w);
    let size = f32(TILE);
    let first = clamp(ceil((left + 0.5) / size) - 1.0, 0.0, f32(tiles_x));
    let end = clamp(floor((right - 0.5) / size) + 1.0, 0.0, f32(tiles_x));
    return vec2<u32>(u32(first), select(u32(first), u32(max(first, end)), top <= bottom));
}
