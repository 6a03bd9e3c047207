// Gradient slots: SLOT vec4s for each (tile, Gaussian) pair; layout in shaders/blend_backward.wgsl.
//
// If the slots of all pairs do not fit one binding, they are processed in windows. The slots of a
// Gaussian are contiguous and belong to the window that contains the first of them. So a window
// needs room beyond slot_count for the rest of its last Gaussian: at most one pair for each tile.
#ifdef WITH_COLOR
const SLOT: u32 = 3u;
#else
const SLOT: u32 = 1u;
#endif

fn in_window(e: u32, view: View) -> bool {
    return e >= view.slot_first && e - view.slot_first < view.slot_count + view.tiles.x * view.tiles.y;
}
