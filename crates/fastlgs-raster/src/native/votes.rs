//! Votes and saliency on the CPU; `shaders/blend_votes.wgsl` and `shaders/blend_saliency.wgsl`.

use super::Lists;
use super::blend::{self, Blended, Job, Tile};
use crate::engine::ExposedPhoto;
use crate::lift::{TileLabels, Vote, summed};
use crate::view::View;
use fastlgs_core::LabelMap;
use rayon::prelude::*;

/// Returns the votes of the Gaussians for the labels of a view.
pub fn votes(view: &View, lists: &Lists, map: &LabelMap) -> Vec<Vote> {
    let of_tile = |sums: &mut Vec<f32>, tile: usize| {
        let job = Job::new(view, tile, lists);
        let labels = TileLabels::of(map, view, tile);
        let mut masks = vec![blend::EMPTY; labels.labels.len()];
        for (p, label) in labels.of_pixel.iter().enumerate() {
            masks[usize::from(*label)][p] = 1.0;
        }
        let mut transmittance = blend::inside_image(view, &job);
        blend::by_mask(&job, &masks, &mut transmittance, sums);
        let rows = job.gaussians().zip(sums.chunks_exact(masks.len()));
        rows.flat_map(|(gaussian, sums)| labels.votes(gaussian, sums))
            .collect::<Vec<_>>()
    };
    let tiles: Vec<Vec<Vote>> = (0..view.tile_count() as usize)
        .into_par_iter()
        .map_init(Vec::new, of_tile)
        .collect();
    summed(&tiles)
}

/// Adds the squared changes of a view without each Gaussian to `scores`, and returns the squared
/// error of the view.
pub fn saliency(
    view: &View,
    lists: &Lists,
    photo: Option<&ExposedPhoto>,
    scores: &mut [f32],
) -> f64 {
    let of_tile = |changes: &mut Vec<f32>, tile: usize| {
        let job = Job::new(view, tile, lists);
        let inside = blend::inside_image(view, &job);
        let mut blended = Blended {
            sums: [blend::EMPTY; 6],
            transmittance: inside,
            walked: 0,
        };
        blend::forward::<true, false>(&job, &mut blended);
        let color = |c: usize, p: usize| {
            blended.sums[c][p] + view.background_color[c] * blended.transmittance[p]
        };
        let mut behind: [Tile; 3] = std::array::from_fn(|c| std::array::from_fn(|p| color(c, p)));
        let (factors, error) = factors_and_error(view, &job, &inside, &behind, photo);
        blend::by_change(&job, &factors, &mut behind, &mut inside.clone(), changes);
        let by_gaussian = job.gaussians().zip(changes.iter().copied());
        (by_gaussian.collect::<Vec<_>>(), error)
    };
    let tiles: Vec<(Vec<(u32, f32)>, f64)> = (0..view.tile_count() as usize)
        .into_par_iter()
        .map_init(Vec::new, of_tile)
        .collect();
    let mut squared_error = 0.0;
    for (changes, error) in tiles {
        for (gaussian, change) in changes {
            scores[gaussian as usize] += change;
        }
        squared_error += error;
    }
    squared_error
}

/// Returns the factors on the changes of a tile's colours, and the squared error of the tile.
fn factors_and_error(
    view: &View,
    job: &Job,
    inside: &Tile,
    colors: &[Tile; 3],
    photo: Option<&ExposedPhoto>,
) -> ([Tile; 3], f64) {
    let mut factors = [*inside; 3];
    let Some(photo) = photo else {
        return (factors, 0.0);
    };
    let mut error = 0.0;
    for p in (0..inside.len()).filter(|p| inside[*p] > 0.0) {
        let (x, y) = (
            job.x as usize + p % blend::EDGE,
            job.y as usize + p / blend::EDGE,
        );
        let pixel = y * view.size[0] as usize + x;
        let of_pixel = photo.factors(pixel);
        for c in 0..3 {
            factors[c][p] = of_pixel[c];
        }
        error += photo.squared_error(pixel, [0, 1, 2].map(|c| colors[c][p]));
    }
    (factors, error)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::density::State;
    use crate::tests::{camera, cloud, target};
    use crate::{Channels, CpuEngine, Engine, Exposure};
    use fastlgs_core::Gaussians;

    #[test]
    fn saliency_is_the_squared_change_without_a_gaussian() {
        let scene = cloud(60, 3, 1, false);
        let (width, height) = (61, 45);
        let view = |gaussians| View {
            background_color: [0.2, 0.4, 0.6, 0.0],
            ..View::new(&camera(width, height), gaussians, 1)
        };
        let rendered = |scene: &Gaussians| {
            let mut engine = CpuEngine::new();
            engine.set_state(&State::of(scene)).unwrap();
            engine
                .render(view(scene.len()), Channels::Color)
                .unwrap()
                .color()
                .to_vec()
        };
        let whole = rendered(&scene);
        let image = target(width, height);
        let exposure = Exposure {
            gain: [0.5, 1.0, 2.0],
            offset: [0.1, 0.0, -0.1],
        };
        let photo = ExposedPhoto {
            image: &image,
            exposure,
        };
        let pixels = (width * height) as usize;
        for photo in [None, Some(&photo)] {
            let mut scores = vec![0.0; scene.len()];
            let mut engine = CpuEngine::new();
            engine.set_state(&State::of(&scene)).unwrap();
            let squared_error = engine
                .saliency(view(scene.len()), photo, &mut scores)
                .unwrap();
            assert!(
                scores.iter().filter(|c| **c > 0.1).count() > 20,
                "{scores:?}"
            );
            // [colour][pixel], the layout of frames.
            let sum = |of: &dyn Fn(usize, f32, f32) -> f32| -> f32 {
                let counts = |k: usize| {
                    photo.is_none_or(|photo| photo.image.color[k % pixels].to_le_bytes()[3] == 255)
                };
                let gain = |k: usize| photo.map_or(1.0, |photo| photo.exposure.gain[k / pixels]);
                (0..3 * pixels)
                    .filter(|k| counts(*k))
                    .map(|k| of(k, gain(k), whole[k]).powi(2))
                    .sum()
            };
            for (i, estimate) in scores.iter().enumerate() {
                let others: Vec<usize> = (0..scene.len()).filter(|k| *k != i).collect();
                let without = rendered(&scene.select(&others));
                let square = sum(&|k, gain, with| gain * (with - without[k]));
                assert!(
                    (estimate - square).abs() <= 1e-3 * square + 1e-4,
                    "Gaussian {i}: score {estimate}, measured {square}"
                );
            }
            let error = photo.map_or(0.0, |photo| {
                let wanted = |k: usize| {
                    f32::from(photo.image.color[k % pixels].to_le_bytes()[k / pixels]) / 255.0
                };
                sum(&|k, gain, with| gain * with + exposure.offset[k / pixels] - wanted(k))
            });
            assert!(
                (squared_error as f32 - error).abs() <= 1e-4 * error,
                "error {}, measured {error}",
                squared_error
            );
        }
    }
}
