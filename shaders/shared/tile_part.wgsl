// Eight invocations share a tile, each with two quads of four pixels, one above the other. A
// workgroup of 64 invocations has eight tiles.

const BATCH: u32 = 8u;

struct TilePart {
    // Index of the tile in the frame, of the tile in the workgroup, and of the invocation in the
    // tile.
    tile: u32,
    slot: u32,
    lane: u32,
    // First pair of the tile's list, and number of its pairs; 0 if the tile does not exist.
    start: u32,
    length: u32,
    // Left pixel of the upper quad.
    x: u32,
    y: u32,
}

// Returns the part of an invocation. Uses `view` and `ranges`, which the pass declares.
fn tile_part_of(group: u32, index: u32) -> TilePart {
    var own: TilePart;
    own.tile = group * 8u + index / 8u;
    own.slot = index / 8u;
    own.lane = index % 8u;
    if own.tile < view.tiles.x * view.tiles.y {
        own.start = ranges[2u * own.tile];
        own.length = ranges[2u * own.tile + 1u] - own.start;
    }
    own.x = (own.tile % view.tiles.x) * TILE + (own.lane & 1u) * 4u;
    own.y = (own.tile / view.tiles.x) * TILE + (own.lane >> 1u) * 2u;
    return own;
}

// Sums of the invocations for a batch of Gaussians: [tile][Gaussian of the batch][invocation].
var<workgroup> partials: array<f32, 8u * BATCH * 8u>;
// Bit mask of the workgroup's tiles that are not finished.
var<workgroup> unfinished_tiles: atomic<u32>;

fn put_partial(own: TilePart, gaussian: u32, values: vec4<f32>) {
    partials[(own.slot * BATCH + gaussian) * 8u + own.lane] = (values.x + values.y) + (values.z + values.w);
}

// Returns the sum over the tile for the Gaussian whose number in the batch is that of the invocation.
fn tile_sum(own: TilePart) -> f32 {
    var sum = 0.0;
#each K 8
    sum += partials[(own.slot * BATCH + own.lane) * 8u + $Ku];
#end
    return sum;
}

// Marks a tile as unfinished, if one of the invocation's pixels is.
fn mark_unfinished(own: TilePart, transmittance: vec4<f32>) {
    if any(transmittance >= vec4<f32>(view.finished)) {
        atomicOr(&unfinished_tiles, 1u << own.slot);
    }
}
