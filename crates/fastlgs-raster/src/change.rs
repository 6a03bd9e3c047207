//! Scores of Gaussians: how much the pixels of views change when one Gaussian is removed.
//!
//! Without a Gaussian, a pixel loses its weighted colour and shows more of what lies behind it:
//! d = alpha / (1 - alpha) x (colour behind) - weight x (own colour).
//! The sum of d^2 corresponds to the diagonal of the Hessian in Optimal Brain Damage
//! (LeCun et al. 1990).

use crate::engine::{Exposure, TargetImage};
use crate::native::blend::{self, Blended, Job, Tile};
use crate::native::{self, Lists};
use crate::view::View;
use fastlgs_core::Gaussians;
use rayon::prelude::*;

/// Scores of the Gaussians of a scene, accumulated over views.
pub struct Changes {
    /// Trained values, `[Gaussian][channel]`.
    rows: Vec<f32>,
    /// For each Gaussian, the sum of squared changes of colour (0 to 1) without it.
    pub scores: Vec<f32>,
    /// Sum of squared differences between photos and rendered colours.
    pub error: f64,
}

impl Changes {
    /// Starts the scores of a scene, before any view is added.
    pub fn of(scene: &Gaussians) -> Self {
        let rows = native::transposed(&scene.to_channels(), scene.len());
        Self {
            rows,
            scores: vec![0.0; scene.len()],
            error: 0.0,
        }
    }

    /// Adds a view. With a photo, only the pixels that count are used, and changes are scaled by
    /// the gain of the exposure. Without one, all pixels are used as rendered.
    ///
    /// # Panics
    /// If photo and view differ in size.
    pub fn add_view(&mut self, view: &View, photo: Option<(&TargetImage, Exposure)>) {
        assert!(
            photo.is_none_or(|(image, _)| image.size == view.size),
            "the photo must have the view's size"
        );
        let lists = Lists::new(view, &self.rows);
        let of_tile = |changes: &mut Vec<f32>, tile: usize| {
            let job = Job::new(view, tile, &lists);
            let shown = blend::inside_image(view, &job);
            let mut blended = Blended {
                sums: [blend::EMPTY; 6],
                transmittance: shown,
                walked: 0,
            };
            blend::forward::<true, false>(&job, &mut blended);
            let colour = |c: usize, p: usize| {
                blended.sums[c][p] + view.background_color[c] * blended.transmittance[p]
            };
            let mut colours: [Tile; 3] =
                std::array::from_fn(|c| std::array::from_fn(|p| colour(c, p)));
            let (brightness, error) = pixel_factors(&job, &shown, &colours, photo);
            blend::by_change(&job, &brightness, &mut colours, &mut shown.clone(), changes);
            (
                job.gaussians()
                    .zip(changes.iter().copied())
                    .collect::<Vec<_>>(),
                error,
            )
        };
        let tiles: Vec<(Vec<(u32, f32)>, f64)> = (0..view.tile_count() as usize)
            .into_par_iter()
            .map_init(Vec::new, of_tile)
            .collect();
        for (changes, error) in tiles {
            changes
                .into_iter()
                .for_each(|(gaussian, change)| self.scores[gaussian as usize] += change);
            self.error += error;
        }
    }
}

/// Returns the factor on the changes of each pixel and colour of a tile, and the squared error of
/// the tile. The factor is the gain of the exposure, or 0 for pixels that do not count.
fn pixel_factors(
    job: &Job,
    shown: &Tile,
    colours: &[Tile; 3],
    photo: Option<(&TargetImage, Exposure)>,
) -> ([Tile; 3], f64) {
    let mut brightness = [*shown; 3];
    let Some((image, exposure)) = photo else {
        return (brightness, 0.0);
    };
    let mut error = 0.0;
    for p in (0..shown.len()).filter(|p| shown[*p] > 0.0) {
        let (x, y) = (
            job.x as usize + p % blend::EDGE,
            job.y as usize + p / blend::EDGE,
        );
        let bytes = image.color[y * image.size[0] as usize + x].to_le_bytes();
        for c in 0..3 {
            let counts = if bytes[3] == 255 { 1.0 } else { 0.0 };
            brightness[c][p] = counts * exposure.gain[c];
            let missed =
                exposure.gain[c] * colours[c][p] + exposure.offset[c] - f32::from(bytes[c]) / 255.0;
            error += f64::from(counts * missed * missed);
        }
    }
    (brightness, error)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::density::State;
    use crate::tests::{camera, cloud, target};
    use crate::{Channels, CpuEngine, Engine};

    #[test]
    fn a_change_is_what_a_picture_loses_without_one_of_its_gaussians() {
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
        let (photo, exposure) = (
            target(width, height),
            Exposure {
                gain: [0.5, 1.0, 2.0],
                offset: [0.1, 0.0, -0.1],
            },
        );
        let pixels = (width * height) as usize;
        for photo in [None, Some((&photo, exposure))] {
            let mut changes = Changes::of(&scene);
            changes.add_view(&view(scene.len()), photo);
            assert!(
                changes.scores.iter().filter(|c| **c > 0.1).count() > 20,
                "{:?}",
                changes.scores
            );
            // [colour][pixel], the layout of frames.
            let sum = |of: &dyn Fn(usize, f32, f32) -> f32| -> f32 {
                let counts = |k: usize| {
                    photo.is_none_or(|(image, _)| image.color[k % pixels].to_le_bytes()[3] == 255)
                };
                let gain = |k: usize| photo.map_or(1.0, |(_, exposure)| exposure.gain[k / pixels]);
                (0..3 * pixels)
                    .filter(|k| counts(*k))
                    .map(|k| of(k, gain(k), whole[k]).powi(2))
                    .sum()
            };
            for (i, estimate) in changes.scores.iter().enumerate() {
                let others: Vec<usize> = (0..scene.len()).filter(|k| *k != i).collect();
                let without = rendered(&scene.select(&others));
                let square = sum(&|k, gain, with| gain * (with - without[k]));
                assert!(
                    (estimate - square).abs() <= 1e-3 * square + 1e-4,
                    "Gaussian {i}: score {estimate}, measured {square}"
                );
            }
            let error = photo.map_or(0.0, |(image, exposure)| {
                let wanted =
                    |k: usize| f32::from(image.color[k % pixels].to_le_bytes()[k / pixels]) / 255.0;
                sum(&|k, gain, with| gain * with + exposure.offset[k / pixels] - wanted(k))
            });
            assert!(
                (changes.error as f32 - error).abs() <= 1e-4 * error,
                "error {}, measured {error}",
                changes.error
            );
        }
    }
}
