//! Fills the gaps that a removed object leaves.
//!
//! Gaps are filled view by view, the largest first. Inverse depth is continued into the gap, and an
//! inpainter computes its colours. Each pixel of the gap becomes a Gaussian, which later views
//! contain, so that all views agree on one surface.

use super::hidden::count_set;
use super::{behind, membrane};
use crate::{Result, Run, Scene};
use fastlgs_core::Camera;
use fastlgs_grid::Grid;
use fastlgs_vision::inpaint::Inpainter;
use glam::Vec2;

/// Opacity of the Gaussians that fill a gap.
const FILL_OPACITY: f32 = 0.95;
/// Radius of these Gaussians in pixel spacings at their depth: wide enough to close the space
/// between neighbours.
const FILL_RADIUS: f32 = 0.7;
/// A gap with at most this share of the pixels of a view is not filled.
const MIN_GAP_SHARE: f64 = 1e-5;
/// Transmittance above which a hidden pixel belongs to a gap.
const EMPTY: f32 = 0.5;
/// Transmittance above which the colour of a hidden pixel is unknown in a filled photo.
const UNCERTAIN: f32 = 0.1;

/// Result of filling.
pub struct Filled {
    /// Number of new Gaussians.
    pub gaussians: usize,
    /// Number of pixels of the gaps of all views.
    pub gap_pixels: usize,
}

/// Renders colours, `[3][h][w]`. The inpainter computes those of hidden pixels whose transmittance is
/// above a limit; the others are without the background's share.
fn inpainted(
    scene: &mut Scene,
    (camera, hidden): &(Camera, Vec<bool>),
    limit: f32,
    inpainter: &dyn Inpainter,
) -> Result<Vec<f32>> {
    let frame = scene.render(camera)?;
    let behind = scene.trained().background;
    let transmittance = frame.transmittance();
    let solid = |c: usize| {
        let channel = frame.channels(c, c + 1).iter().zip(transmittance);
        channel.map(move |(color, t)| {
            if *t <= limit {
                (color - t * behind[c]) / (1.0 - t)
            } else {
                *color
            }
        })
    };
    let mut colors: Vec<f32> = (0..3).flat_map(solid).collect();
    let unknown = hidden_above(hidden, transmittance, limit);
    if unknown.contains(&true) && unknown.contains(&false) {
        inpainter.fill(&mut colors, &unknown, camera.width)?;
    }
    Ok(colors)
}

/// Returns the colours of a training view without the object, `[3][h][w]`.
pub fn photo_colors(
    scene: &mut Scene,
    view: &(Camera, Vec<bool>),
    inpainter: &dyn Inpainter,
) -> Result<Vec<f32>> {
    inpainted(scene, view, UNCERTAIN, inpainter)
}

/// Returns which hidden pixels have a transmittance above a limit.
fn hidden_above(hidden: &[bool], transmittance: &[f32], limit: f32) -> Vec<bool> {
    let pixels = hidden.iter().zip(transmittance);
    pixels.map(|(hidden, t)| *hidden && *t > limit).collect()
}

/// Returns the pixels of a view that belong to a gap.
fn gap(scene: &mut Scene, (camera, hidden): &(Camera, Vec<bool>)) -> Result<Vec<bool>> {
    Ok(hidden_above(
        hidden,
        scene.render(camera)?.transmittance(),
        EMPTY,
    ))
}

/// Fills the gaps within the hidden pixels of `views`, the training views.
pub fn fill(
    scene: &mut Scene,
    grid: &Grid,
    views: &[(Camera, Vec<bool>)],
    inpainter: &dyn Inpainter,
    run: &Run,
) -> Result<Filled> {
    let before = scene.gaussians().len();
    let mut gap_sizes = Vec::new();
    for view in views {
        gap_sizes.push(count_set(&gap(scene, view)?));
    }
    let mut order: Vec<usize> = (0..views.len()).collect();
    order.sort_by_key(|k| std::cmp::Reverse(gap_sizes[*k]));
    let work = run.work("gaps", order.len() as u64);
    for view in order.into_iter().map(|k| &views[k]) {
        work.advance()?;
        // Other views may have filled a part of this gap.
        let (camera, gap) = (&view.0, gap(scene, view)?);
        let (n, width) = (gap.len(), camera.width as usize);
        if count_set(&gap) as f64 <= MIN_GAP_SHARE * n as f64 || count_set(&gap) == n {
            continue;
        }
        let inverse = behind::inverse_depth_behind(&scene.render_depth(camera)?, &gap, width);
        let colors = inpainted(scene, view, EMPTY, inpainter)?;
        let ids = membrane::extend_labels(
            &scene.field_without_transparent(camera)?.ids(grid).labels,
            &gap,
            width,
        );
        let to_world = camera.world_to_camera.inverse();
        let mut filled = scene.gaussians().clone();
        for p in (0..n).filter(|p| gap[*p] && inverse[*p] > 0.0) {
            let pixel = Vec2::new((p % width) as f32 + 0.5, (p / width) as f32 + 0.5);
            let depth = 1.0 / inverse[p];
            let place = to_world.transform_point3(camera.ray(pixel) * depth);
            filled.push_sphere(
                place,
                FILL_RADIUS * depth / camera.fx,
                FILL_OPACITY,
                std::array::from_fn(|c| colors[c * n + p].clamp(0.0, 1.0)),
            );
            let last = filled.len() - 1;
            (filled.object_ids[last], filled.features[last]) = (ids[p], grid.code_of(ids[p]));
        }
        scene.set_gaussians(filled)?;
    }
    Ok(Filled {
        gaussians: scene.gaussians().len() - before,
        gap_pixels: gap_sizes.iter().sum(),
    })
}
