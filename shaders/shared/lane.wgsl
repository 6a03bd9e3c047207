// Who blends which pixels. Pixels are handled in quads of four neighbours in a row; `#each Q` repeats its lines for the
// quads of an invocation, so that their state stays in registers.
//
// Two shapes. On real GPUs an 8x8 tile is shared by 8 invocations of 4x2 pixels (two columns, four rows of such blocks),
// which add up their gradients. A software rasteriser runs invocations as vector lanes, for which adding across lanes
// and scattered access are dear: there (WIDE) an invocation owns a whole tile, and a workgroup 8 neighbouring tiles.
#ifdef WIDE
const QUADS_X: u32 = 2u;
#else
const QUADS_X: u32 = 1u;
#endif

struct Lane {
    tile: u32,
    // Upper left pixel of the invocation's block.
    x: u32,
    y: u32,
}

fn lane_of(group: u32, lane: u32, view: View) -> Lane {
#ifdef WIDE
    let tile = group * 8u + lane;
    return Lane(tile, (tile % view.tiles.x) * TILE, (tile / view.tiles.x) * TILE);
#else
    return Lane(group, (group % view.tiles.x) * TILE + (lane & 1u) * 4u, (group / view.tiles.x) * TILE + (lane >> 1u) * 2u);
#endif
}

// Which pixels of a quad lie in the picture.
fn inside(x: u32, y: u32, view: View) -> vec4<bool> {
    return (vec4<u32>(x) + vec4<u32>(0u, 1u, 2u, 3u) < vec4<u32>(view.size.x)) & vec4<bool>(y < view.size.y);
}

// Alpha of one Gaussian on a quad; 0 where it is not drawn.
fn alphas(dx: vec4<f32>, dy: f32, q: vec3<f32>, opacity: f32, open: vec4<bool>) -> vec4<f32> {
    let power = fma(dx, fma(vec4<f32>(q.x), dx, vec4<f32>(q.y * dy)), vec4<f32>(q.z * dy * dy));
    let alpha = opacity * exp2(power);
    return select(vec4<f32>(0.0), alpha, (alpha >= vec4<f32>(ALPHA_MIN)) & open);
}
