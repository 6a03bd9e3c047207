//! `fastlgs-bench baseline`: other language fields on the same Gaussians, masks and embeddings.
//!
//! A field gives each Gaussian a vector by lifting. The vectors are rendered three numbers at a
//! time, and each pixel is classified on its own.

mod fields;
mod vectors;

use crate::autoencoder::Autoencoder;
use anyhow::{Context, Result};
use fastlgs::{Run, Scene, eval};
use fastlgs_core::id_weights::{IdWeights, pack, unpack};
use fastlgs_core::labels::{self, LabelledView};
use fastlgs_core::{Camera, metrics};
use fastlgs_grid::Grid;
use fastlgs_grid::field::Field;
use fastlgs_grid::query::{self, QueryConfig};
use fastlgs_grid::relevancy::TextQuery;
use fields::lattice_codes;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::time::Instant;
use vectors::{Vectors, normalised, rendered};

#[derive(clap::Args)]
#[command(after_help = "Example: fastlgs-bench baseline scenes/fox --method raw --device cpu")]
pub struct Args {
    /// Trained scene with a labels/ folder beside its photos.
    scene: PathBuf,
    /// Field to evaluate.
    ///
    /// `raw`: mean embedding of the whole masks that show a Gaussian, without a grid (the paper's
    /// ablation). `lerf`: embeddings of tiles at three scales; each pixel uses its most relevant
    /// scale. `langsplat`: embeddings of whole and part masks, compressed to three numbers by a
    /// scene-wise autoencoder. `code1` to `code4`: the grid with codes of 1 to 4 numbers for the
    /// smallest object of each Gaussian; each pixel belongs to the object with the nearest code.
    /// `codes`: the same with an axis for each object, so that codes do not mix.
    #[arg(
        long,
        value_parser = ["raw", "lerf", "langsplat", "code1", "code2", "code3", "code4", "codes"]
    )]
    method: String,
}

/// Relevancy threshold. From 0.5 on, a pixel is closer to the text than to every canonical phrase.
const RELEVANCY_THRESHOLD: f32 = 0.5;

pub fn run(args: &Args, run: &Run) -> Result<Value> {
    let mut scene = Scene::open(&args.scene, run.device)?;
    let grid = scene.grid()?;
    let views = labels::load(&Path::new(&scene.manifest().photos).join("labels"), None)?;
    let started = Instant::now();
    let field = match args.method.as_str() {
        "raw" => PerPixel::raw(&scene, run)?,
        "lerf" => PerPixel::lerf(&scene, run)?,
        "langsplat" => PerPixel::langsplat(&scene, run)?,
        "codes" => PerPixel::of_codes(&scene, &grid, Vectors::eye(grid.objects.len())),
        code => PerPixel::of_codes(
            &scene,
            &grid,
            lattice_codes(
                grid.objects.len(),
                code[4..].parse().context("a dimension")?,
                run.seed,
            ),
        ),
    };
    let seconds = started.elapsed().as_secs_f64();
    let bytes: usize = field.layers.iter().map(|v| 4 * v.len()).sum();
    let (mut oracle, mut text, mut localised, mut milliseconds, mut wrong) =
        (Vec::new(), Vec::new(), Vec::new(), Vec::new(), Vec::new());
    for view in &views {
        let camera =
            scene.cameras()[scene.folder().view_index(scene.cameras(), &view.name)?].clone();
        let started = Instant::now();
        let pictures = field
            .layers
            .iter()
            .map(|v| rendered(&mut scene, &camera, v))
            .collect::<Result<Vec<_>>>()?;
        milliseconds.push(started.elapsed().as_secs_f64() * 1e3);
        wrong.extend(field.wrong_pixel_share(&mut scene, &grid, &camera, &pictures[0])?);
        for score in field.score(&scene, &grid, view, &camera, pictures)? {
            oracle.push(score[0]);
            text.push(score[1]);
            localised.push(score[2]);
        }
    }
    let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len().max(1) as f64;
    let camera = &scene.cameras()[0];
    let value = json!({
        "scene": args.scene,
        "method": args.method,
        "oracle_miou": mean(&oracle),
        "miou": mean(&text),
        "loc_acc": mean(&localised),
        "wrong_pixels": (!wrong.is_empty()).then(|| mean(&wrong)),
        "labels_scored": oracle.len(),
        "seconds": seconds,
        "render_ms": mean(&milliseconds),
        "field_bytes": bytes,
        "gaussians": scene.gaussians().len(),
        "objects": grid.objects.len(),
        "size": format!("{}x{}", camera.width, camera.height),
        "adapter": scene.adapter(),
    });
    Ok(value)
}

/// Meaning of a rendered vector.
enum Representation {
    /// An embedding.
    Embedding,
    /// The autoencoder's code of an embedding.
    Encoded(Autoencoder),
    /// The code of an object. Holds the codes of all objects, one per row.
    Object(Vectors),
}

/// A field whose pixels are classified independently.
struct PerPixel {
    /// Vectors of all Gaussians, one array for each scale or level.
    layers: Vec<Vectors>,
    meaning: Representation,
}

impl PerPixel {
    /// Returns the fraction of a view's pixels that are classified as an object that is not at the
    /// pixel. An object is at a pixel if it is one of the pixel's blended ids or contains one. A
    /// blend of two codes can come near a third code, which causes such errors. `None` for fields
    /// without codes.
    fn wrong_pixel_share(
        &self,
        scene: &mut Scene,
        grid: &Grid,
        camera: &Camera,
        picture: &Vectors,
    ) -> Result<Option<f64>> {
        let field = scene.field(camera, None)?;
        let (Representation::Object(codes), Field::IdWeights(shares)) = (&self.meaning, &*field)
        else {
            return Ok(None);
        };
        let there = |ids: &[u32; 4], id: u16| {
            ids.iter()
                .any(|s| grid.chain(unpack(*s).0).any(|a| a == id))
        };
        let decided = picture
            .rows()
            .into_iter()
            .map(|p| nearest(&p.to_vec(), codes));
        let wrong = decided
            .zip(&shares.pixels)
            .filter(|(id, ids)| *id > 0 && !there(ids, *id))
            .count();
        Ok(Some(wrong as f64 / shares.pixels.len() as f64))
    }

    /// Returns for each label: oracle IoU, IoU of the text's mask, and 1 or 0 for the localisation.
    fn score(
        &self,
        scene: &Scene,
        grid: &Grid,
        view: &LabelledView,
        camera: &Camera,
        pictures: Vec<Vectors>,
    ) -> Result<Vec<[f64; 3]>> {
        let (w, h) = (camera.width, camera.height);
        let localised = |relevancy: &[f32], label: &labels::Label| {
            f64::from(u8::from(metrics::peak_in_box(
                relevancy,
                w,
                h,
                &view.boxes(label, w, h),
            )))
        };
        if let Representation::Object(codes) = &self.meaning {
            let pixels = pictures[0]
                .rows()
                .into_iter()
                .map(|p| [pack(nearest(&p.to_vec(), codes), 1.0), 0, 0, 0])
                .collect();
            let field = Field::IdWeights(IdWeights {
                width: w,
                height: h,
                pixels,
            });
            let score = |label: &labels::Label| -> Result<[f64; 3]> {
                let truth = view.mask(label, w, h);
                let text = scene.text_query(&label.category)?;
                let ranked = query::rank(grid, &text);
                let mask = field.mask(
                    grid,
                    &query::select(grid, &ranked, &text, &QueryConfig::default()),
                );
                Ok([
                    eval::best_object(grid, &field, &truth).0,
                    metrics::iou(&mask, &truth),
                    localised(&field.relevancy(grid, &ranked), label),
                ])
            };
            return view.labels.iter().map(score).collect();
        }
        let decoded = pictures.into_iter().map(|picture| match &self.meaning {
            Representation::Encoded(coder) => coder.decode(picture),
            _ => picture,
        });
        let embeddings: Vec<Vectors> = decoded.map(normalised).collect();
        let score = |label: &labels::Label| {
            let truth = view.mask(label, w, h);
            let text = scene.text_query(&label.category)?;
            let relevancy = relevancy(&embeddings, &text);
            let above = |threshold: f32| {
                metrics::iou(
                    &relevancy
                        .iter()
                        .map(|r| *r >= threshold)
                        .collect::<Vec<_>>(),
                    &truth,
                )
            };
            Ok([
                thresholds(&relevancy)
                    .into_iter()
                    .map(above)
                    .fold(0.0, f64::max),
                above(RELEVANCY_THRESHOLD),
                localised(&relevancy, label),
            ])
        };
        view.labels.iter().map(score).collect()
    }
}

/// Returns the relevancy of each pixel: the maximum over all layers.
fn relevancy(layers: &[Vectors], text: &TextQuery) -> Vec<f32> {
    let pixels = layers[0].nrows();
    let of = |p: usize| {
        layers
            .iter()
            .map(|l| text.relevancy(&l.row(p).to_vec()))
            .fold(0.0, f32::max)
    };
    (0..pixels).map(of).collect()
}

/// Returns the thresholds that the oracle tries: 64 equal steps from the smallest value to the
/// largest.
fn thresholds(values: &[f32]) -> Vec<f32> {
    let (low, high) = values
        .iter()
        .fold((f32::INFINITY, f32::NEG_INFINITY), |(l, h), v| {
            (l.min(*v), h.max(*v))
        });
    (0..64)
        .map(|k| low + (high - low) * k as f32 / 64.0)
        .collect()
}

/// Returns the id of the object with the nearest code, or 0 if the origin is nearer. The paper
/// limits the distance to trained codes. Here such a limit would drop almost every pixel, because
/// translucent Gaussians shift each blended code.
fn nearest(rendered: &[f32], codes: &Vectors) -> u16 {
    let distance = |code: ndarray::ArrayView1<f32>| {
        code.iter()
            .zip(rendered)
            .map(|(c, r)| (c - r).powi(2))
            .sum::<f32>()
    };
    let none = rendered.iter().map(|r| r * r).sum::<f32>();
    let all = codes.rows().into_iter().map(distance).enumerate();
    all.min_by(|a, b| a.1.total_cmp(&b.1))
        .filter(|(_, d)| *d < none)
        .map_or(0, |(k, _)| k as u16 + 1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use fastlgs_grid::calibration::Calibration;

    #[test]
    fn a_pixel_gets_the_object_with_the_nearest_code() {
        let codes = Vectors::from_shape_vec((2, 1), vec![0.25, 0.75]).expect("a shape");
        assert_eq!(
            (
                nearest(&[0.26], &codes),
                nearest(&[0.6], &codes),
                nearest(&[0.1], &codes)
            ),
            (1, 2, 0)
        );
    }

    #[test]
    fn relevancy_is_the_maximum_over_layers() {
        let layer =
            |v: [f32; 4]| normalised(Vectors::from_shape_vec((2, 2), v.to_vec()).expect("a shape"));
        let layers = [layer([1.0, 0.0, 0.0, 2.0]), layer([0.0, 1.0, 3.0, 0.0])];
        let text = TextQuery {
            min_canonical: 0.5,
            ..TextQuery::new(vec![vec![1.0, 0.0]], Calibration::OFFLINE)
        };
        let found = relevancy(&layers, &text);
        assert!(found[0] > 0.9 && found[1] > 0.9);
        assert_eq!(thresholds(&found).len(), 64);
    }
}
