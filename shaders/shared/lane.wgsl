// An 8x8 tile is blended by 8 invocations of 4x2 pixels: two columns, four rows of such blocks.
struct Lane {
    tile: u32,
    // Left pixel and upper row of the block.
    x: u32,
    y: u32,
}

fn lane_of(tile: u32, lane: u32, view: View) -> Lane {
    let tx = tile % view.tiles.x;
    let ty = tile / view.tiles.x;
    return Lane(tile, tx * TILE + (lane & 1u) * 4u, ty * TILE + (lane >> 1u) * 2u);
}

// Alpha of one Gaussian on four neighbouring pixels; 0 where it is not drawn.
fn alphas(dx: vec4<f32>, dy: f32, q: vec3<f32>, opacity: f32, transmittance: vec4<f32>) -> vec4<f32> {
    let power = min(dx * (q.x * dx + q.y * dy) + q.z * dy * dy, vec4<f32>(0.0));
    let alpha = min(opacity * exp2(power), vec4<f32>(ALPHA_MAX));
    let drawn = (alpha >= vec4<f32>(ALPHA_MIN)) & (transmittance >= vec4<f32>(TRANSMITTANCE_MIN));
    return select(vec4<f32>(0.0), alpha, drawn);
}
