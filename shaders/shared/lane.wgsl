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
const LANES: u32 = 32u;
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
    // Whether there is such a tile; where not, its list is empty.
    exists: bool,
    // First and end pair of the tile's list.
    start: u32,
    end: u32,
    // Upper left pixel of the invocation's quads.
    x: u32,
    y: u32,
}

// By `view`, `tile_order` and `ranges`, which the pass declares.
fn lane_of(group: u32, index: u32) -> Lane {
    var lane: Lane;
    lane.tile = index / TILE_LANES;
    lane.number = index % TILE_LANES;
    let place = group * TILES + lane.tile;
    lane.exists = place < view.tiles.x * view.tiles.y;
    var tile = 0u;
    if lane.exists {
        tile = tile_order[place];
        lane.start = ranges[2u * tile];
        lane.end = ranges[2u * tile + 1u];
    }
    lane.x = (tile % view.tiles.x) * TILE + (lane.number & 1u) * 4u;
    lane.y = (tile / view.tiles.x) * TILE + (lane.number >> 1u);
    return lane;
}
