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

#import quad

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
