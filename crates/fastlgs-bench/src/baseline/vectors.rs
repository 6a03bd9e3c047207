//! Vectors of Gaussians: lifting from the training views, and rendering.

use anyhow::{Result, bail};
use fastlgs::Scene;
use fastlgs::scene::mean_features;
use fastlgs_core::{Camera, Gaussians, LabelMap};
use fastlgs_raster::density::State;
use fastlgs_raster::{CpuEngine, Engine};
use glam::Vec3;
use ndarray::{Array2, Axis};

/// Largest size of the vectors of all Gaussians, in bytes.
const MAX_VECTOR_BYTES: usize = 4 << 30;

/// One row per Gaussian, pixel or object.
pub type Vectors = Array2<f32>;

/// A label map with the vectors of its labels.
pub type Labelled = (LabelMap, Vec<(u16, Vec<f32>)>);

/// Returns vectors of equal length as rows.
pub fn rows(vectors: &[&Vec<f32>]) -> Result<Vectors> {
    let width = vectors.first().map_or(0, |v| v.len());
    Ok(Vectors::from_shape_vec(
        (vectors.len(), width),
        vectors.iter().flat_map(|v| v.iter().copied()).collect(),
    )?)
}

/// Returns the mean vector of each Gaussian over all training views, weighted by blending weights.
/// `labelled_view` returns the label map of a view and the vectors of its labels.
///
/// # Errors
/// The vectors need more than 4 GiB.
pub fn lifted(
    scene: &Scene,
    labelled_view: impl Fn(usize, &Camera) -> Result<Labelled>,
) -> Result<Vectors> {
    let mut sums = Vectors::zeros((0, 0));
    let mut weights = vec![0.0f32; scene.gaussians().len()];
    let training = scene.manifest().training(scene.cameras());
    let mut engine = CpuEngine::new();
    engine.set_state(&State::of(scene.gaussians()))?;
    for (view, camera) in training.iter().enumerate() {
        let (map, vectors) = labelled_view(view, camera)?;
        let width = vectors.first().map_or(sums.ncols(), |v| v.1.len());
        if sums.is_empty() {
            let bytes = 4 * width * scene.gaussians().len();
            if bytes > MAX_VECTOR_BYTES {
                bail!(
                    "vectors of {width} numbers for {} Gaussians need {} MB, but the limit is {} MB; use a smaller scene",
                    scene.gaussians().len(),
                    bytes >> 20,
                    MAX_VECTOR_BYTES >> 20
                );
            }
            sums = Vectors::zeros((scene.gaussians().len(), width));
        }
        let mut place = vec![None; usize::from(map.max()) + 1];
        for (k, (label, _)) in vectors.iter().enumerate() {
            if let Some(place) = place.get_mut(usize::from(*label)) {
                *place = Some(k);
            }
        }
        for vote in engine.votes(scene.view(camera), &map)? {
            if let Some(k) = place[usize::from(vote.label)] {
                let mut row = sums.row_mut(vote.gaussian as usize);
                row.iter_mut()
                    .zip(&vectors[k].1)
                    .for_each(|(sum, v)| *sum += vote.weight * v);
                weights[vote.gaussian as usize] += vote.weight;
            }
        }
    }
    sums.rows_mut()
        .into_iter()
        .zip(weights)
        .filter(|(_, w)| *w > 0.0)
        .for_each(|(mut row, w)| row /= w);
    Ok(sums)
}

/// Renders the vectors into a view, three numbers per pass. Returns one row per pixel.
pub fn rendered(scene: &mut Scene, camera: &Camera, vectors: &Vectors) -> Result<Vectors> {
    let (pixels, width) = ((camera.width * camera.height) as usize, vectors.ncols());
    let mut out = Vectors::zeros((pixels, width));
    let original = scene.gaussians().clone();
    for first in (0..width).step_by(3) {
        let at =
            |row: ndarray::ArrayView1<f32>, k: usize| row.get(first + k).copied().unwrap_or(0.0);
        let features = vectors
            .rows()
            .into_iter()
            .map(|row| Vec3::new(at(row, 0), at(row, 1), at(row, 2)))
            .collect();
        scene.set_gaussians(Gaussians {
            features,
            ..original.clone()
        })?;
        let frame = scene.render_feature(camera)?;
        for (k, channel) in mean_features(&frame)
            .into_iter()
            .enumerate()
            .take(width - first)
        {
            out.column_mut(first + k)
                .iter_mut()
                .zip(channel)
                .for_each(|(o, v)| *o = v);
        }
    }
    scene.set_gaussians(original)?;
    Ok(out)
}

/// Scales all rows to length 1. Rows of length 0 stay as they are.
pub fn normalised(mut vectors: Vectors) -> Vectors {
    for mut row in vectors.axis_iter_mut(Axis(0)) {
        let length = row.dot(&row).sqrt();
        if length > 1e-6 {
            row /= length;
        }
    }
    vectors
}
