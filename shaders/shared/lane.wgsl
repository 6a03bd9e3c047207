// Assigns pixels to invocations. Pixels are processed in quads: four neighbours in a row.
//
// On real GPUs 16 invocations share an 8x8 tile, one quad each. A workgroup of LANES invocations
// has consecutive tiles of `tile_order`, whose lists have similar lengths.
// A software adapter runs invocations as vector lanes; sums across lanes and scattered access are
// slow there. So with WIDE an invocation has a whole tile, and neighbouring lanes have consecutive
// tiles of `tile_order`. `#each Q` repeats its lines for the quads of an invocation, so that their
// state stays in registers.
#ifdef WIDE
const LANES: u32 = 8u;
const TILE_LANES: u32 = 1u;
const QUADS_X: u32 = 2u;
#else
const LANES: u32 = 32u;
const TILE_LANES: u32 = 16u;
const QUADS_X: u32 = 1u;
#endif
// Number of tiles of a workgroup.
const TILES: u32 = LANES / TILE_LANES;

#import quad

struct Lane {
    // Index of the tile in the workgroup, and of the invocation in the tile.
    tile: u32,
    plane_index: u32,
    // Whether the tile exists. If not, its list is empty.
    exists: bool,
    // First and end pair of the tile's list.
    start: u32,
    end: u32,
    // Upper left pixel of the invocation's quads.
    x: u32,
    y: u32,
}

// Returns the lane of an invocation. Uses `view`, `tile_order` and `ranges`, which the pass
// declares.
fn lane_of(group: u32, index: u32) -> Lane {
    var lane: Lane;
    lane.tile = index / TILE_LANES;
    lane.plane_index = index % TILE_LANES;
    let order_index = group * TILES + lane.tile;
    lane.exists = order_index < view.tiles.x * view.tiles.y;
    var tile = 0u;
    if lane.exists {
        tile = tile_order[order_index];
        lane.start = ranges[2u * tile];
        lane.end = ranges[2u * tile + 1u];
    }
    lane.x = (tile % view.tiles.x) * TILE + (lane.plane_index & 1u) * 4u;
    lane.y = (tile / view.tiles.x) * TILE + (lane.plane_index >> 1u);
    return lane;
}
