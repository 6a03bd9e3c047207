//! Segment Anything (Kirillov et al. 2023; SAM 2: Ravi et al. 2024) from ONNX exports. `exports`
//! runs the models, `generation` finds the masks of a photo, and `windows` stores mask logits.

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

/// Version of the mask generation. Increase it whenever the same models give other masks.
pub const VERSION: u32 = 2;

/// Options of mask generation. The defaults are those of SAM's own generator, except that masks of
/// different levels do not suppress each other.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SamConfig {
    /// Number of point prompts along each side of the photo and of each crop.
    pub points_per_side: u32,
    /// Smallest IoU that the model predicts for its own mask, 0 to 1.
    pub predicted_iou: f32,
    /// Smallest stability: IoU of the masks thresholded at logits of plus and minus one.
    pub stability: f32,
    /// Box IoU above which the worse of two masks is removed; 1 keeps all.
    pub box_nms: f32,
    /// Whether masks of different levels suppress each other too.
    pub across_levels: bool,
    /// Number of crop layers besides the photo itself; layer k has 4^k crops.
    pub crop_layers: u32,
    /// Suppression among the masks of each level, after all crops are merged.
    pub suppression: Option<Suppression>,
}

/// Thresholds at which a mask is suppressed by another mask of its level.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Suppression {
    /// Mask IoU above which a mask repeats a better one.
    pub iou: f32,
    /// Score, predicted IoU times stability, that a mask must exceed.
    pub score: f32,
    /// Limit of a product: the intersection as a share of one mask, times its share of the other.
    /// Below the limit, a contained mask that covers less than half of the other is suppressed.
    pub inner: f32,
    /// Share of a mask that must lie in another mask for it to count as contained.
    pub containment: f32,
}

impl Default for SamConfig {
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

impl SamConfig {
    /// Returns the options of LangSplat, whose pipeline the paper follows: laxer filters, one layer
    /// of crops, and mask suppression.
    pub fn langsplat() -> Self {
        let suppression = Some(Suppression {
            iou: 0.8,
            score: 0.7,
            inner: 0.5,
            containment: 0.85,
        });
        Self {
            predicted_iou: 0.7,
            stability: 0.85,
            crop_layers: 1,
            suppression,
            ..Self::default()
        }
    }
}

/// Holes and islands with a smaller share of the photo's area are removed.
const SPECK: f32 = 2e-4;
/// Mask IoU above which a mask of a finer level repeats one of a coarser level.
const SAME: f32 = 0.9;

/// Number of photos without a mask, before any photo with one, at which segmentation fails.
const MAX_EMPTY_PHOTOS: usize = 5;

/// Segmenter with SAM's image encoder and prompt decoder.
pub struct Sam {
    exports: Exports,
    config: SamConfig,
    single_mask_warning: std::sync::Once,
    /// Whether any photo had a mask.
    found: AtomicBool,
    /// Number of photos without a mask.
    photos_without_mask: AtomicUsize,
}

impl Sam {
    /// Loads an encoder and its decoder.
    ///
    /// # Errors
    /// A missing file, or a model of an unknown kind.
    pub fn load(encoder: &Path, decoder: &Path, config: SamConfig) -> Result<Self> {
        Ok(Self {
            exports: Exports::load(encoder, decoder)?,
            config,
            single_mask_warning: std::sync::Once::new(),
            found: AtomicBool::new(false),
            photos_without_mask: AtomicUsize::new(0),
        })
    }
}

impl Segmenter for Sam {
    fn segment(&self, view: &str, photo: &RgbImage) -> Result<MaskList> {
        let (width, height) = photo.dimensions();
        let least = (SPECK * (width * height) as f32) as usize;
        let (found, single) = generation::masks(&self.exports, photo, &self.config)?;
        if single {
            self.single_mask_warning.call_once(|| {
                tracing::warn!("this SAM export returns one mask per prompt; the level of each mask is derived from its area")
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
            let same =
                |a: &BitMask, b: &BitMask| box_iou(a.bounds, b.bounds) > 0.5 && a.iou(b) > SAME;
            finer[0].retain(|c| {
                !coarser
                    .iter()
                    .flatten()
                    .any(|other| same(&other.mask, &c.mask))
            });
        }
        if levels.iter().any(|level| !level.is_empty()) {
            self.found.store(true, Ordering::Relaxed);
        } else {
            // A single photo may be blurred or empty. If no photo has a mask, the models are
            // probably wrong.
            tracing::warn!("SAM found no mask in '{view}'");
            if !self.found.load(Ordering::Relaxed)
                && self.photos_without_mask.fetch_add(1, Ordering::Relaxed) + 1 >= MAX_EMPTY_PHOTOS
            {
                return Err(self.exports.error("it found no mask in any of the first photos; check that encoder and decoder belong to the same model"));
            }
        }
        let with_level = |c: Candidate| {
            let runs = c.mask.runs(width, height);
            Mask {
                level: c.level,
                predicted_iou: c.predicted_iou,
                stability: c.stability,
                track: None,
                runs,
            }
        };
        Ok(MaskList {
            width,
            height,
            masks: levels.into_iter().flatten().map(with_level).collect(),
        })
    }

    fn is_parallel(&self) -> bool {
        false
    }

    fn seconds_per_photo(&self, photo: &RgbImage) -> Result<Option<f64>> {
        generation::seconds(&self.exports, photo, &self.config).map(Some)
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

    /// A red object with a dark part, and a blue object with a hole of one pixel, on grey.
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

    fn sam(export: SamExport, config: SamConfig) -> Option<(tempfile::TempDir, Sam)> {
        let dir = tempfile::tempdir().unwrap();
        let (encoder, decoder) = (
            dir.path().join("encoder.onnx"),
            dir.path().join("decoder.onnx"),
        );
        toy_models::sam(export, &encoder, &decoder);
        if let Err(e) = crate::model_paths::runtime_library() {
            assert!(std::env::var_os("FASTLGS_REQUIRE_MODELS").is_none(), "{e}");
            crate::skip::skip(format_args!("{e}"));
            return None;
        }
        Some((dir, Sam::load(&encoder, &decoder, config).unwrap()))
    }

    /// Returns the largest IoU of a label with the pixels of `member`.
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
        let config = SamConfig {
            points_per_side: 12,
            ..SamConfig::default()
        };
        let official = [true, false].map(|batched| SamExport::Official { batched });
        let others = [
            SamExport::Efficient,
            SamExport::Transformers,
            SamExport::Edge,
            SamExport::Second,
            SamExport::Half,
        ];
        for export in official.into_iter().chain(others) {
            let Some((_dir, sam)) = sam(export, config) else {
                return;
            };
            let found = sam.segment("", &photo()).unwrap();
            let [whole, part, subpart] = Level::ALL.map(|level| found.painted(level));
            let red = |x: u32, y: u32| (10..60).contains(&x) && (10..50).contains(&y);
            let blue = |x: u32, y: u32| (70..110).contains(&x) && (40..70).contains(&y);
            let dark = |x: u32, y: u32| (20..32).contains(&x) && (20..32).contains(&y);
            // The interpolated borders of half-resolution masks lose a row of pixels; the hole is
            // filled.
            assert!(
                agree(&whole, red) > 0.9,
                "{export:?}: {}",
                agree(&whole, red)
            );
            assert!(
                agree(&whole, blue) > 0.9,
                "{export:?}: {}",
                agree(&whole, blue)
            );
            assert!(
                agree(&whole, dark) < 0.5,
                "{export:?}: the dark part must not be a whole"
            );
            assert!(
                agree(&part, dark) > 0.75,
                "{export:?}: {}",
                agree(&part, dark)
            );
            assert_eq!(
                part.at(100, 50),
                0,
                "{export:?}: the part level must not repeat a whole"
            );
            assert_eq!(
                subpart.at(100, 50),
                0,
                "{export:?}: the subpart level must not repeat a whole"
            );
        }
    }

    #[test]
    fn seconds_are_estimated_before_photos_are_segmented_one_by_one() {
        let config = SamConfig {
            points_per_side: 16,
            ..SamConfig::default()
        };
        let Some((_dir, sam)) = sam(SamExport::Transformers, config) else {
            return;
        };
        assert!(!sam.is_parallel());
        let seconds = sam.seconds_per_photo(&photo()).unwrap().unwrap();
        let began = std::time::Instant::now();
        sam.segment("", &photo()).unwrap();
        let needed = began.elapsed().as_secs_f64();
        // Other tests run beside this one.
        assert!(
            seconds > needed / 20.0 && seconds < 20.0 * needed,
            "estimated {seconds} s, needed {needed} s"
        );
    }

    #[test]
    fn crops_and_suppression_keep_the_same_objects() {
        let config = SamConfig {
            points_per_side: 8,
            ..SamConfig::langsplat()
        };
        let Some((_dir, sam)) = sam(SamExport::Official { batched: true }, config) else {
            return;
        };
        let found = sam.segment("", &photo()).unwrap();
        let whole = found.painted(Level::Whole);
        assert!(
            agree(&whole, |x, y| (10..60).contains(&x)
                && (10..50).contains(&y))
                > 0.9
        );
        assert!(
            agree(&whole, |x, y| (70..110).contains(&x)
                && (40..70).contains(&y))
                > 0.9
        );
        let areas: Vec<usize> = found
            .masks
            .iter()
            .filter(|m| m.level == Level::Whole)
            .map(|m| m.runs.area())
            .collect();
        assert!(
            areas.iter().all(|a| *a > 0) && areas.len() < 8,
            "masks that several crops found must not be repeated: {areas:?}"
        );
    }

    #[test]
    fn single_masks_get_their_level_by_area() {
        let config = SamConfig {
            points_per_side: 12,
            ..SamConfig::default()
        };
        let Some((_dir, sam)) = sam(SamExport::Single, config) else {
            return;
        };
        let found = sam.segment("", &photo()).unwrap();
        assert!(
            agree(&found.painted(Level::Whole), |x, y| (10..60).contains(&x)
                && (10..50).contains(&y))
                > 0.9
        );
        assert!(
            found
                .masks
                .iter()
                .all(|m| (m.level == Level::Whole) == (m.runs.area() >= 288)),
            "wholes have at least 3 % of 9,600 pixels"
        );
    }

    #[test]
    fn masks_with_a_low_predicted_iou_are_dropped() {
        let config = SamConfig {
            points_per_side: 4,
            predicted_iou: 0.99,
            ..SamConfig::default()
        };
        let Some((_dir, sam)) = sam(SamExport::Transformers, config) else {
            return;
        };
        // If none of the first MAX_EMPTY_PHOTOS photos has a mask, it is an error.
        let mut photos = (0..MAX_EMPTY_PHOTOS).map(|_| sam.segment("", &photo()));
        assert!(
            photos
                .by_ref()
                .take(MAX_EMPTY_PHOTOS - 1)
                .all(|list| list.unwrap().masks.is_empty())
        );
        assert!(
            photos
                .next()
                .unwrap()
                .err()
                .unwrap()
                .to_string()
                .contains("no mask")
        );
    }

    #[test]
    fn other_models_are_refused_by_name() {
        let Some((dir, _)) = sam(SamExport::Transformers, SamConfig::default()) else {
            return;
        };
        let encoder = dir.path().join("encoder.onnx");
        let error = Sam::load(&encoder, &encoder, SamConfig::default())
            .err()
            .unwrap()
            .to_string();
        assert!(
            error.contains("encoder.onnx") && error.contains("pixel_values"),
            "{error}"
        );
        let missing = Sam::load(
            &dir.path().join("none.onnx"),
            &encoder,
            SamConfig::default(),
        )
        .err()
        .unwrap()
        .to_string();
        assert!(
            missing.contains("none.onnx") && missing.contains("models pull"),
            "{missing}"
        );
    }
}
