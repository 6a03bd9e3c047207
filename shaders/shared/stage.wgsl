// Gaussians of a tile's list on their way through workgroup memory: each invocation of a tile fetches one of the next 16 while the present 16 are
// blended, so that nobody waits for the three reads that lead to a splat. The pass declares `sorted_pairs`, `pair_gaussians` and `splats`.
struct Staged {
    pair: u32,
    s0: vec4<f32>,
    s1: vec4<f32>,
    s2: vec4<f32>,
}

// Pairs of the 16 before as well: who adds up is still at them when others put down the next.
var<workgroup> staged_pairs: array<u32, 2u * LANES>;
var<workgroup> staged_splats: array<array<vec4<f32>, 3>, LANES>;

// The k-th of the list; after its end, one that is not drawn, so that nobody needs to ask where it ends.
fn fetch(start: u32, k: u32, length: u32) -> Staged {
    var out: Staged;
    out.s1.y = -1e9;
    if k < length {
        out.pair = sorted_pairs[start + k];
        let i = 3u * pair_gaussians[out.pair];
        out.s0 = splats[i];
        out.s1 = splats[i + 1u];
        out.s2 = splats[i + 2u];
    }
    return out;
}

// Where the k-th lies.
fn staged_at(tile: u32, k: u32) -> u32 {
    return tile * TILE_LANES + k % TILE_LANES;
}

fn staged_pair_at(tile: u32, k: u32) -> u32 {
    return (k / TILE_LANES % 2u) * LANES + staged_at(tile, k);
}

fn put_down(fetched: Staged, tile: u32, k: u32) {
    staged_pairs[staged_pair_at(tile, k)] = fetched.pair;
    staged_splats[staged_at(tile, k)] = array<vec4<f32>, 3>(fetched.s0, fetched.s1, fetched.s2);
}
