// Who blends which pixels. Pixels are handled in quads of four neighbours in a row.
//
// On real GPUs an 8x8 tile is shared by 16 invocations of one quad each, and a workgroup of LANES has the tiles that follow each other in
// `tile_order`, whose lists are about as long. A software rasteriser runs invocations as vector lanes, for which adding across lanes and scattered
// access are dear: there (WIDE) an invocation owns a whole tile, and its neighbours in the vector the tiles that follow. `#each Q` repeats its
// lines for the quads of an invocation, so that their state stays in registers.
#ifdef WIDE
const LANES: u32 = 8u;
const TILE_LANES: u32 = 1u;
const QUADS_X: u32 = 2u;
#else
#ifdef LANES64
const LANES: u32 = 64u;
#else
const LANES: u32 = 32u;
#endif
const TILE_LANES: u32 = 16u;
const QUADS_X: u32 = 1u;
#endif
// Tiles of a workgroup.
const TILES: u32 = LANES / TILE_LANES;

#import quad

struct Lane {
    // Which of the workgroup's tiles, and which of its invocations.
    tile: u32,
    number: u32,
    // Place in `tile_order`.
    place: u32,
    // Upper left pixel of the invocation's quads in the tile.
    x: u32,
    y: u32,
}

fn lane_of(group: u32, lane: u32) -> Lane {
    let tile = lane / TILE_LANES;
    let number = lane % TILE_LANES;
    return Lane(tile, number, group * TILES + tile, (number & 1u) * 4u, number >> 1u);
}
