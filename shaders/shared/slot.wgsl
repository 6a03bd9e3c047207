// Gradient slots: SLOT vec4s for each (tile, Gaussian) pair; shaders/blend_backward.wgsl says what they hold.
//
// Where all pairs do not fit one binding, they are done in windows. The slots of a Gaussian are neighbours and belong to
// the window in which the first of them lies; so a window holds the pairs of one Gaussian more than it counts.
#ifdef WITH_COLOR
const SLOT: u32 = 3u;
#else
const SLOT: u32 = 1u;
#endif

fn in_window(e: u32, view: View) -> bool {
    return e >= view.slot_first && e - view.slot_first < view.slot_count + view.tiles.x * view.tiles.y;
}
