use crate::View;

/// Twin of `shaders/emit.wgsl`.
pub fn emit(
    view: &View,
    order: &[u32],
    offsets: &[u32],
    rects: &[[u32; 2]],
    touched: &[u32],
    pair_tiles: &mut [u32],
    pair_gaussians: &mut [u32],
    first_pair: &mut [u32],
) {
    for rank in 0..view.gaussians as usize {
        let g = order[rank] as usize;
        let mut e = offsets[rank] as usize;
        first_pair[g] = e as u32;
        if touched[g] == 0 {
            continue;
        }
        let [first, end] = rects[g];
        for y in first >> 16..end >> 16 {
            for x in first & 0xffff..end & 0xffff {
                pair_tiles[e] = y * view.tiles[0] + x;
                pair_gaussians[e] = g as u32;
                e += 1;
            }
        }
    }
}
