// Stages the Gaussians of a tile's list in workgroup memory. While 16 Gaussians are blended, each
// invocation of the tile fetches one of the next 16. This hides the latency of the three dependent
// reads of a splat. The pass declares `sorted_pairs`, `pair_gaussians` and `splats`.
struct Staged {
    pair: u32,
    s0: vec4<f32>,
    s1: vec4<f32>,
    s2: vec4<f32>,
}

// Also holds the pairs of the previous 16, because some invocations still add up those while others
// stage the next ones.
var<workgroup> staged_pairs: array<u32, 2u * LANES>;
var<workgroup> staged_splats: array<array<vec4<f32>, 3>, LANES>;

// Fetches the k-th Gaussian of the list. Beyond the end, returns one that is not drawn, so that the
// loop needs no bounds check.
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

// Returns the index of the k-th Gaussian in the staged arrays.
fn staged_at(tile: u32, k: u32) -> u32 {
    return tile * TILE_LANES + k % TILE_LANES;
}

fn staged_pair_at(tile: u32, k: u32) -> u32 {
    return (k / TILE_LANES % 2u) * LANES + staged_at(tile, k);
}

fn stage(fetched: Staged, tile: u32, k: u32) {
    staged_pairs[staged_pair_at(tile, k)] = fetched.pair;
    staged_splats[staged_at(tile, k)] = array<vec4<f32>, 3>(fetched.s0, fetched.s1, fetched.s2);
}
