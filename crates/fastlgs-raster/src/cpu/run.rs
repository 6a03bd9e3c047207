//! Runs a CPU twin by its name on raw buffers.

use super::*;
use crate::channels::Channels;
use crate::view::{ChunkJob, DepthLoss, Planes, Step, View};
use bytemuck::{Pod, cast_slice, cast_slice_mut};

/// Calls a twin with its first arguments and its buffers. A buffer is `words` (u32), or `read` or
/// `write` (another type, for reading or writing).
macro_rules! call {
    ($twin:ident($($first:expr),*), $buffers:ident, [$($buffer:ident: $access:ident),*]) => {{
        let [$($buffer),*] = $buffers else {
            panic!("{} with {} buffers", stringify!($twin), $buffers.len())
        };
        $twin($($first,)* $(call!(@$access $buffer)),*)
    }};
    (@words $buffer:ident) => { $buffer };
    (@read $buffer:ident) => { cast_slice($buffer) };
    (@write $buffer:ident) => { cast_slice_mut($buffer) };
}

/// Runs the twin of the pass `name` on its uniform and its storage buffers. `buffers` is in the
/// order of the bindings.
///
/// # Panics
/// If there is no such pass, or a buffer is missing or too small.
pub(crate) fn run(name: &str, channels: Channels, uniform: &[u8], buffers: &mut [Vec<u32>]) {
    let b = buffers;
    match name {
        "radix_count" => call!(radix_count(&job(uniform)), b, [keys: words, histogram: words]),
        "radix_scatter" => call!(radix_scatter(&job(uniform)), b,
            [keys: words, values: words, histogram: words, keys_out: words, values_out: words]),
        "scan_chunks" => call!(scan_chunks(&job(uniform)), b, [items: words, totals: words]),
        "scan_apply" => call!(scan_apply(&job(uniform)), b, [items: words, totals: words]),
        "adam" => call!(adam(&of::<Step>(uniform)), b,
            [gradients: read, params: write, moment1: write, moment2: write]),
        "depth_gradient" => call!(depth_gradient(&of::<DepthLoss>(uniform)), b,
            [frame: read, targets: words, gradient: write]),
        "ssim_rows" | "ssim_columns" | "ssim_backward_rows" | "loss_gradient" => {
            run_loss(name, &of(uniform), b);
        }
        _ => run_frame(name, channels, &of(uniform), b),
    }
}

/// Runs a twin that renders a view, or computes its gradients.
fn run_frame(name: &str, channels: Channels, view: &View, b: &mut [Vec<u32>]) {
    match name {
        "project" => call!(project(view), b,
            [params: read, splats: write, depths: words, footprints: write, touched: words]),
        "gather_counts" => call!(gather_counts(view), b,
            [order: words, touched: words, offsets: words]),
        "emit" => call!(emit(view), b, [order: words, offsets: words, footprints: read,
            touched: words, tiles: words, gaussians: words, first: words]),
        "tile_ranges" => call!(tile_ranges(view), b, [tiles: words, ranges: words]),
        "tile_load" => call!(tile_load(view), b, [ranges: words, keys: words]),
        "blend" => {
            // The buffer of the sorted tiles may be longer than the frame needs.
            b[1].truncate(view.tile_count() as usize);
            call!(blend(view, channels), b, [ranges: words, order: words, sorted: words,
                gaussians: words, splats: read, frame: write]);
        }
        "blend_ids" => call!(blend_ids(view), b, [ranges: words, sorted: words, gaussians: words,
            splats: read, ids: words, shares: words]),
        "blend_votes" => call!(blend_votes(view), b, [ranges: words, sorted: words,
            gaussians: words, splats: read, labels: words, tile_votes: words, votes: write]),
        "blend_saliency" => call!(blend_saliency(view), b, [ranges: words, sorted: words,
            gaussians: words, splats: read, frame: read, factors: read, saliency: write]),
        "blend_backward" => {
            b[1].truncate(view.tile_count() as usize);
            call!(blend_backward(view, channels), b, [ranges: words, order: words, sorted: words,
                gaussians: words, splats: read, frame: read, gradient: read, slots: write]);
        }
        "fold_slots" => call!(fold_slots(view, channels), b,
            [touched: words, first: words, gaussians: words, slots: write]),
        "project_backward" => call!(project_backward(view, channels), b, [params: read,
            splats: read, order: words, touched: words, first: words, slots: read,
            gradients: write, stats: write]),
        name => panic!("there is no CPU twin '{name}'"),
    }
}

/// Runs a twin of the loss on each plane, with the plane's own maps.
fn run_loss(name: &str, planes: &Planes, buffers: &mut [Vec<u32>]) {
    for (number, plane) in planes.each[..planes.count as usize].iter().enumerate() {
        let size = (4 * plane.quads * plane.rows) as usize;
        let rows_of = |rows: usize| number * rows * size..(number + 1) * rows * size;
        let (rows, partials) = (rows_of(4), rows_of(3));
        match (name, &mut *buffers) {
            ("ssim_rows", [frame, targets, maps]) => {
                ssim_rows(
                    plane,
                    cast_slice(frame),
                    targets,
                    cast_slice_mut(&mut maps[rows]),
                );
            }
            ("ssim_columns", [maps, sums_of_rows, sums]) => ssim_columns(
                plane,
                cast_slice(&maps[rows]),
                cast_slice_mut(&mut sums_of_rows[partials]),
                cast_slice_mut(sums),
            ),
            ("ssim_backward_rows", [sums_of_rows, maps]) => ssim_backward_rows(
                plane,
                cast_slice(&sums_of_rows[partials]),
                cast_slice_mut(&mut maps[rows]),
            ),
            ("loss_gradient", [frame, targets, maps, gradient, sums]) => loss_gradient(
                plane,
                cast_slice(frame),
                targets,
                cast_slice(&maps[rows]),
                cast_slice_mut(gradient),
                cast_slice_mut(sums),
            ),
            (name, buffers) => panic!("{name} with {} buffers", buffers.len()),
        }
    }
}

fn job(uniform: &[u8]) -> ChunkJob {
    of(uniform)
}

fn of<T: Pod>(bytes: &[u8]) -> T {
    bytemuck::pod_read_unaligned(&bytes[..size_of::<T>()])
}
