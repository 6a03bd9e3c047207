//! Runs a CPU twin by its name on raw buffers.

use super::*;
use crate::channels::Channels;
use crate::view::Planes;
use bytemuck::{Pod, cast_slice as read, cast_slice_mut as write};

/// Runs the twin of the pass `name` on its uniform and its storage buffers. `buffers` is in the
/// order of the bindings.
///
/// # Panics
/// If there is no such pass, or a buffer is too small.
pub(crate) fn run(name: &str, channels: Channels, uniform: &[u8], buffers: &mut [Vec<u32>]) {
    let view = || uniform_of::<crate::View>(uniform);
    let job = || uniform_of::<crate::view::ChunkJob>(uniform);
    match (name, buffers) {
        ("project", [params, splats, depths, footprints, touched]) => {
            project(
                &view(),
                read(params),
                write(splats),
                depths,
                write(footprints),
                touched,
            );
        }
        ("radix_count", [keys, histogram]) => radix_count(&job(), keys, histogram),
        ("radix_scatter", [keys, values, histogram, keys_out, values_out]) => {
            radix_scatter(&job(), keys, values, histogram, keys_out, values_out);
        }
        ("scan_chunks", [items, totals]) => scan_chunks(&job(), items, totals),
        ("scan_apply", [items, totals]) => scan_apply(&job(), items, totals),
        ("gather_counts", [order, touched, offsets]) => {
            gather_counts(&view(), order, touched, offsets)
        }
        ("emit", [order, offsets, footprints, touched, tiles, gaussians, first]) => {
            emit(
                &view(),
                order,
                offsets,
                read(footprints),
                touched,
                tiles,
                gaussians,
                first,
            );
        }
        ("tile_ranges", [tiles, ranges]) => tile_ranges(&view(), tiles, ranges),
        ("tile_load", [ranges, keys]) => tile_load(&view(), ranges, keys),
        ("blend", [ranges, order, sorted, gaussians, splats, frame]) => {
            let order = &order[..view().tile_count() as usize];
            blend(
                &view(),
                channels,
                ranges,
                order,
                sorted,
                gaussians,
                read(splats),
                write(frame),
            );
        }
        ("blend_ids", [ranges, sorted, gaussians, splats, ids, shares]) => {
            blend_ids(
                &view(),
                ranges,
                sorted,
                gaussians,
                read(splats),
                ids,
                shares,
            );
        }
        ("blend_votes", [ranges, sorted, gaussians, splats, labels, tile_votes, votes]) => {
            blend_votes(
                &view(),
                ranges,
                sorted,
                gaussians,
                read(splats),
                labels,
                tile_votes,
                write(votes),
            );
        }
        ("blend_saliency", [ranges, sorted, gaussians, splats, frame, factors, saliency]) => {
            blend_saliency(
                &view(),
                ranges,
                sorted,
                gaussians,
                read(splats),
                read(frame),
                read(factors),
                write(saliency),
            );
        }
        ("ssim_rows", [frame, targets, rows]) => {
            each_plane(&uniform_of(uniform), rows, &mut [], |plane, rows, _| {
                ssim_rows(plane, read(frame), targets, write(rows))
            });
        }
        ("ssim_columns", [rows, partials, sums]) => {
            each_plane(
                &uniform_of(uniform),
                rows,
                partials,
                |plane, rows, partials| {
                    ssim_columns(plane, read(rows), write(partials), write(sums))
                },
            );
        }
        ("ssim_backward_rows", [partials, rows]) => {
            each_plane(
                &uniform_of(uniform),
                rows,
                partials,
                |plane, rows, partials| ssim_backward_rows(plane, read(partials), write(rows)),
            );
        }
        ("loss_gradient", [frame, targets, rows, gradient, sums]) => {
            let mut twin = |plane: &Plane, rows: &mut [u32]| {
                loss_gradient(
                    plane,
                    read(frame),
                    targets,
                    read(rows),
                    write(gradient),
                    write(sums),
                )
            };
            each_plane(&uniform_of(uniform), rows, &mut [], |plane, rows, _| {
                twin(plane, rows)
            });
        }
        ("fold_slots", [touched, first, gaussians, slots]) => {
            fold_slots(&view(), channels, touched, first, gaussians, write(slots))
        }
        (
            "blend_backward",
            [
                ranges,
                order,
                sorted,
                gaussians,
                splats,
                frame,
                gradient,
                slots,
            ],
        ) => {
            let order = &order[..view().tile_count() as usize];
            let (frame, gradient) = (read(frame), read(gradient));
            blend_backward(
                &view(),
                channels,
                ranges,
                order,
                sorted,
                gaussians,
                read(splats),
                frame,
                gradient,
                write(slots),
            );
        }
        (
            "project_backward",
            [
                params,
                splats,
                order,
                touched,
                first,
                slots,
                gradients,
                stats,
            ],
        ) => {
            let (params, slots) = (read(params), read(slots));
            project_backward(
                &view(),
                channels,
                params,
                read(splats),
                order,
                touched,
                first,
                slots,
                write(gradients),
                write(stats),
            );
        }
        ("adam", [gradients, params, moment1, moment2]) => {
            adam(
                &uniform_of(uniform),
                read(gradients),
                write(params),
                write(moment1),
                write(moment2),
            );
        }
        (name, buffers) => panic!("no CPU twin '{name}' with {} buffers", buffers.len()),
    }
}

fn uniform_of<T: Pod>(bytes: &[u8]) -> T {
    bytemuck::pod_read_unaligned(&bytes[..size_of::<T>()])
}

/// Runs a twin on each plane with the plane's own maps: four of `rows`, and three of `partials` if
/// given.
fn each_plane(
    planes: &Planes,
    rows: &mut [u32],
    partials: &mut [u32],
    mut twin: impl FnMut(&Plane, &mut [u32], &mut [u32]),
) {
    for (number, plane) in planes.each[..planes.count as usize].iter().enumerate() {
        let size = (4 * plane.quads * plane.rows) as usize;
        let own = |maps: usize| number * maps * size..(number + 1) * maps * size;
        twin(
            plane,
            &mut rows[own(4)],
            partials.get_mut(own(3)).unwrap_or_default(),
        );
    }
}
