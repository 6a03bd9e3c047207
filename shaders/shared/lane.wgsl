// Who blends which pixels. Pixels are handled in quads of four neighbours in a row; `#each Q` repeats its lines for the
// quads of an invocation, so that their state stays in registers.
//
// Two shapes. On real GPUs an 8x8 tile is shared by 8 invocations of 4x2 pixels (two columns, four rows of such blocks),
// which add up their gradients. A software rasteriser runs invocations as vector lanes, for which adding across lanes
// and scattered access are dear: there (WIDE) an invocation owns a whole tile. Its neighbours in the vector own the
// tiles that follow in `tile_order`, whose lists are about as long, so that none waits for the others.
#ifdef WIDE
const QUADS_X: u32 = 2u;
#else
const QUADS_X: u32 = 1u;
#endif

struct Lane {
    // Place in `tile_order`.
    place: u32,
    // Upper left pixel of the invocation's block in its tile.
    x: u32,
    y: u32,
}

fn lane_of(group: u32, lane: u32) -> Lane {
#ifdef WIDE
    return Lane(group * 8u + lane, 0u, 0u);
#else
    return Lane(group, (lane & 1u) * 4u, (lane >> 1u) * 2u);
#endif
}

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

// Alpha of one Gaussian on a quad; 0 where it is not drawn.
fn alphas(dx: vec4<f32>, qx: f32, row: Row) -> vec4<f32> {
    let alpha = exp2(fma(dx, fma(vec4<f32>(qx), dx, vec4<f32>(row.c1)), vec4<f32>(row.c0)));
    return select(vec4<f32>(0.0), alpha, alpha >= vec4<f32>(ALPHA_MIN));
}
