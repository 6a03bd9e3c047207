//! Segment Anything (Kirillov et al. 2023; SAM 2: Ravi et al. 2024) from ONNX exports: `exports` asks the models, `generation` asks about
//! the whole photo, `windows` keeps what they answer.

pub(crate) mod exports;
pub(crate) mod generation;
mod windows;

use crate::Result;
use crate::masks::{BitMask, box_iou};
use crate::segmenter::Segmenter;
use exports::Exports;
use fastlgs_core::MaskList;
use fastlgs_core::mask_list::Mask;
use generation::Candidate;
use image::RgbImage;
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

/// Changes with what is made of the same models' answers.
pub const VERSION: u32 = 2;

/// Constants of mask generation; the defaults are those of SAM's own generator, but that a whole does not drop a part of like bounds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Config {
    /// Point prompts along each side of the photo, and of each crop.
    pub points_per_side: u32,
    /// Least IoU that the model predicts for its own mask.
    pub predicted_iou: f32,
    /// Least IoU of the masks cut at logits of plus and minus one.
    pub stability: f32,
    /// IoU of boxes from which the worse of two masks is dropped.
    pub box_nms: f32,
    /// Whether that holds between masks of different levels too.
    pub across_levels: bool,
    /// Layers of crops beside the photo itself: the k-th has 4^k.
    pub crop_layers: u32,
    /// What is dropped of a level's masks in the end.
    pub suppression: Option<Suppression>,
}

/// When a mask gives way to another one of its level.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Suppression {
    /// IoU above which it repeats a better one.
    pub iou: f32,
    /// Predicted IoU times stability that a mask needs.
    pub score: f32,
    /// Product of the shares that two have in common, below which the one that lies in the other goes.
    pub inner: f32,
    /// Share from which one lies in the other.
    pub held: f32,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            points_per_side: 32,
            predicted_iou: 0.88,
            stability: 0.95,
            box_nms: 0.7,
            across_levels: false,
            crop_layers: 0,
            suppression: None,
        }
    }
}

impl Config {
    /// What LangSplat asks of SAM, whose pipeline the paper follows: laxer filters, one layer of crops, and suppression by masks.
    pub fn langsplat() -> Self {
        let suppression = Some(Suppression { iou: 0.8, score: 0.7, inner: 0.5, held: 0.85 });
        Self { predicted_iou: 0.7, stability: 0.85, crop_layers: 1, suppression, ..Self::default() }
    }
}

/// Holes and islands below this share of the photo are removed.
const SPECK: f32 = 2e-4;
/// Mask IoU from which a mask of a finer level is the same as one of a coarser level.
const SAME: f32 = 0.9;

/// So many photos without a mask, and none with, are too many.
const IN_NONE: usize = 5;

/// Image encoder and prompt decoder.
pub struct Sam {
    exports: Exports,
    config: Config,
    told: std::sync::Once,
    /// Whether any photo had a mask yet.
    found: AtomicBool,
    /// Photos that had none.
    without: AtomicUsize,
}

impl Sam {
    /// Loads an encoder and the decoder that belongs to it.
    ///
    /// # Errors
    /// When a file is missing or of no known kind.
    pub fn load(encoder: &Path, decoder: &Path, config: Config) -> Result<Self> {
        Ok(Self {
            exports: Exports::load(encoder, decoder)?,
            config,
            told: std::sync::Once::new(),
            found: AtomicBool::new(false),
            without: AtomicUsize::new(0),
        })
    }
}

impl Segmenter for Sam {
    fn name(&self) -> &'static str {
        "sam"
    }

    fn segment(&self, view: &str, photo: &RgbImage) -> Result<MaskList> {
        let (width, height) = photo.dimensions();
        let least = (SPECK * (width * height) as f32) as usize;
        let (found, single) = generation::masks(&self.exports, photo, &self.config)?;
        if single {
            self.told.call_once(|| {
                tracing::warn!("SAM gives one mask a prompt: what is a whole, a part or a part of a part is told by its size")
            });
        }
        let mut levels: [Vec<Candidate>; 3] = Default::default();
        for mut candidate in found {
            if let Some(mask) = candidate.mask.without_specks(least) {
                candidate.mask = mask;
                levels[candidate.level as usize].push(candidate);
            }
        }
        if let Some(rule) = &self.config.suppression {
            levels = levels.map(|level| generation::suppressed(level, rule));
        }
        for level in 1..levels.len() {
            let (coarser, finer) = levels.split_at_mut(level);
            let same = |a: &BitMask, b: &BitMask| box_iou(a.bounds, b.bounds) > 0.5 && a.iou(b) > SAME;
            finer[0].retain(|c| !coarser.iter().flatten().any(|other| same(&other.mask, &c.mask)));
        }
        if levels.iter().any(|level| !level.is_empty()) {
            self.found.store(true, Ordering::Relaxed);
        } else {
            // A photo may be blurred or empty; where none has a mask, something else is wrong.
            tracing::warn!("SAM found no mask in '{view}'");
            if !self.found.load(Ordering::Relaxed) && self.without.fetch_add(1, Ordering::Relaxed) + 1 >= IN_NONE {
                return Err(self.exports.refuse("it found no mask in any photo so far; are encoder and decoder of one model?"));
            }
        }
        let told = |c: Candidate| {
            let runs = c.mask.runs(width, height);
            Mask { level: c.level, predicted_iou: c.predicted_iou, stability: c.stability, track: None, runs }
        };
        Ok(MaskList { width, height, masks: levels.into_iter().flatten().map(told).collect() })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::toy_models::{self, SamExport};
    use fastlgs_core::Level;
    use image::Rgb;

    const GRAY: [u8; 3] = [90, 90, 90];
    const RED: [u8; 3] = [220, 20, 20];
    const DARK_RED: [u8; 3] = [150, 15, 15];
    const BLUE: [u8; 3] = [20, 20, 230];

    /// A red thing with a dark part, and a blue thing with a hole of one pixel, on grey.
    fn photo() -> RgbImage {
        RgbImage::from_fn(120, 80, |x, y| {
            Rgb(match (x, y) {
                (20..32, 20..32) => DARK_RED,
                (10..60, 10..50) => RED,
                (90, 60) => GRAY,
                (70..110, 40..70) => BLUE,
                _ => GRAY,
            })
        })
    }

    fn sam(export: SamExport, config: Config) -> Option<(tempfile::TempDir, Sam)> {
        let dir = tempfile::tempdir().unwrap();
        let (encoder, decoder) = (dir.path().join("encoder.onnx"), dir.path().join("decoder.onnx"));
        toy_models::sam(export, &encoder, &decoder);
        if let Err(e) = crate::places::runtime_library() {
            assert!(std::env::var_os("FASTLGS_REQUIRE_MODELS").is_none(), "{e}");
            eprintln!("SKIPPED: {e}");
            return None;
        }
        Some((dir, Sam::load(&encoder, &decoder, config).unwrap()))
    }

    /// IoU of the best label.
    fn agree(map: &fastlgs_core::LabelMap, member: impl Fn(u32, u32) -> bool) -> f32 {
        let best = (1..=map.max()).map(|l| {
            let (mut common, mut either) = (0.0, 0.0);
            for (x, y) in (0..map.height).flat_map(|y| (0..map.width).map(move |x| (x, y))) {
                let (a, b) = (map.at(x, y) == l, member(x, y));
                common += f32::from(u8::from(a && b));
                either += f32::from(u8::from(a || b));
            }
            common / f32::max(either, 1.0)
        });
        best.fold(0.0, f32::max)
    }

    #[test]
    fn every_export_gives_the_same_masks_at_their_levels() {
        let config = Config { points_per_side: 12, ..Config::default() };
        let official = [true, false].map(|batched| SamExport::Official { batched });
        let others = [SamExport::Efficient, SamExport::Transformers, SamExport::Edge, SamExport::Second, SamExport::Half];
        for export in official.into_iter().chain(others) {
            let Some((_dir, sam)) = sam(export, config) else { return };
            let found = sam.segment("", &photo()).unwrap();
            let [whole, part, subpart] = Level::ALL.map(|level| found.painted(level));
            let red = |x: u32, y: u32| (10..60).contains(&x) && (10..50).contains(&y);
            let blue = |x: u32, y: u32| (70..110).contains(&x) && (40..70).contains(&y);
            let dark = |x: u32, y: u32| (20..32).contains(&x) && (20..32).contains(&y);
            // Interpolated borders of half-resolution masks cost a row of pixels; the hole is filled.
            assert!(agree(&whole, red) > 0.9, "{export:?}: {}", agree(&whole, red));
            assert!(agree(&whole, blue) > 0.9, "{export:?}: {}", agree(&whole, blue));
            assert!(agree(&whole, dark) < 0.5, "{export:?}: the part is no whole");
            assert!(agree(&part, dark) > 0.75, "{export:?}: {}", agree(&part, dark));
            assert_eq!(part.at(100, 50), 0, "{export:?}: a part that is the whole is not repeated");
            assert_eq!(subpart.at(100, 50), 0, "{export:?}: nor is a subpart");
        }
    }

    #[test]
    fn crops_and_suppression_leave_the_same_things() {
        let config = Config { points_per_side: 8, ..Config::langsplat() };
        let Some((_dir, sam)) = sam(SamExport::Official { batched: true }, config) else { return };
        let found = sam.segment("", &photo()).unwrap();
        let whole = found.painted(Level::Whole);
        assert!(agree(&whole, |x, y| (10..60).contains(&x) && (10..50).contains(&y)) > 0.9);
        assert!(agree(&whole, |x, y| (70..110).contains(&x) && (40..70).contains(&y)) > 0.9);
        let areas: Vec<usize> = found.masks.iter().filter(|m| m.level == Level::Whole).map(|m| m.runs.area()).collect();
        assert!(areas.iter().all(|a| *a > 0) && areas.len() < 8, "what several crops found is there once: {areas:?}");
    }

    #[test]
    fn a_single_mask_a_prompt_gets_its_level_by_its_size() {
        let config = Config { points_per_side: 12, ..Config::default() };
        let Some((_dir, sam)) = sam(SamExport::Single, config) else { return };
        let found = sam.segment("", &photo()).unwrap();
        assert!(agree(&found.painted(Level::Whole), |x, y| (10..60).contains(&x) && (10..50).contains(&y)) > 0.9);
        assert!(found.masks.iter().all(|m| (m.level == Level::Whole) == (m.runs.area() >= 288)), "3 % of 9,600 pixels");
    }

    #[test]
    fn filters_drop_what_the_model_doubts() {
        let config = Config { points_per_side: 4, predicted_iou: 0.99, ..Config::default() };
        let Some((_dir, sam)) = sam(SamExport::Transformers, config) else { return };
        // One such photo may be empty; many are a sign.
        let mut photos = (0..IN_NONE).map(|_| sam.segment("", &photo()));
        assert!(photos.by_ref().take(IN_NONE - 1).all(|list| list.unwrap().masks.is_empty()));
        assert!(photos.next().unwrap().err().unwrap().to_string().contains("no mask"));
    }

    #[test]
    fn other_models_are_refused_by_name() {
        let Some((dir, _)) = sam(SamExport::Transformers, Config::default()) else { return };
        let encoder = dir.path().join("encoder.onnx");
        let error = Sam::load(&encoder, &encoder, Config::default()).err().unwrap().to_string();
        assert!(error.contains("encoder.onnx") && error.contains("pixel_values"), "{error}");
        let missing = Sam::load(&dir.path().join("none.onnx"), &encoder, Config::default()).err().unwrap().to_string();
        assert!(missing.contains("none.onnx") && missing.contains("models pull"), "{missing}");
    }
}
