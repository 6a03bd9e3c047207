//! Automatic mask generation: a grid of point prompts over the photo and its crops, filters, and
//! non-maximum suppression.

use super::exports::{Encoded, Exports, Logits};
use super::windows::Grid;
use super::{SamConfig, Suppression};
use crate::Result;
use crate::masks::{BitMask, box_iou};
use fastlgs_core::Level;
use image::{RgbImage, imageops};
use std::collections::HashSet;
use std::time::Instant;

/// Largest number of prompts in one inference.
const BATCH: usize = 64;
/// Logit offset of the stability score: IoU of the masks thresholded at plus and minus this value.
const STABILITY_OFFSET: f32 = 1.0;
/// Masks with fewer cells have their stability measured at the size of the photo. On the coarse
/// grid, a border of one cell would be a large share of them.
const FEW_CELLS: usize = 400;
/// Overlap of neighbouring crops, as a share of the photo's shorter side.
const OVERLAP: f32 = 512.0 / 1500.0;
/// A mask that ends within this distance of a crop's border is treated as cut off. Share of the
/// photo's longer side: 20 of 1,024 pixels.
const BORDER: f32 = 20.0 / 1024.0;
/// Smallest area, as a share of the photo, of a whole and of a part. Used if the decoder returns
/// one mask per prompt.
const MIN_LEVEL_AREAS: [f32; 2] = [0.03, 0.005];

/// A mask that passed the filters.
#[derive(Clone, Debug)]
pub struct Candidate {
    /// Size class.
    pub level: Level,
    /// IoU with the true object, as the model predicts it, 0 to 1.
    pub predicted_iou: f32,
    /// IoU of the masks thresholded at plus and minus `STABILITY_OFFSET`, 0 to 1.
    pub stability: f32,
    /// Mask in pixels of the photo, or of the crop until it is placed.
    pub mask: BitMask,
    /// Width of the crop it was found in, as a share of the photo's width.
    crop: f32,
}

/// Returns left, top, width and height of each crop of a layer. Layer 0 is the photo; layer k has
/// 2^k x 2^k overlapping crops.
fn crops([w, h]: [u32; 2], layer: u32) -> Vec<[u32; 4]> {
    let n = 1 << layer;
    let overlap = (OVERLAP * w.min(h) as f32 * 2.0 / n as f32) as u32;
    let side = |all: u32| {
        if n == 1 {
            all
        } else {
            (overlap * (n - 1) + all).div_ceil(n)
        }
    };
    let [width, height] = [side(w), side(h)];
    let step = |k: u32, own: u32| {
        if n == 1 {
            0
        } else {
            k * own.saturating_sub(overlap)
        }
    };
    let all = (0..n).flat_map(|y| (0..n).map(move |x| [step(x, width), step(y, height)]));
    all.map(|[x, y]| [x, y, width.min(w - x), height.min(h - y)])
        .collect()
}

/// Returns all masks of a photo that pass the filters, and whether the decoder returned one mask
/// per prompt.
pub fn masks(
    exports: &Exports,
    photo: &RgbImage,
    config: &SamConfig,
) -> Result<(Vec<Candidate>, bool)> {
    let (mut all, mut single) = (Vec::new(), false);
    for layer in 0..=config.crop_layers {
        for crop in crops([photo.width(), photo.height()], layer) {
            let found = masks_of_crop(exports, photo, crop, config, &mut single)?;
            all.extend(found);
        }
    }
    if config.crop_layers > 0 {
        // Masks from smaller crops are preferred: they have a finer resolution.
        all = non_maximum_suppression(
            all,
            config.box_nms,
            |a, b| a.level == b.level || config.across_levels,
            |c| 1.0 / c.crop,
        );
    }
    Ok((all, single))
}

/// Returns the seconds that the masks of a photo take, from one image and one batch of prompts. The
/// filters after inference are left out.
pub fn seconds(exports: &Exports, photo: &RgbImage, config: &SamConfig) -> Result<f64> {
    // The first runs of a model are slower than the others.
    exports.encode(photo)?;
    let began = Instant::now();
    let encoded = exports.encode(photo)?;
    let encoding = began.elapsed().as_secs_f64();
    let batch = batch_size(exports, &encoded);
    let points = vec![[0.5; 2]; batch];
    let mut decoding = f64::INFINITY;
    for _ in 0..3 {
        let began = Instant::now();
        exports.decode(&encoded, &points)?;
        decoding = decoding.min(began.elapsed().as_secs_f64());
    }
    let prompts = config.points_per_side.pow(2) as usize;
    let images = (0..=config.crop_layers)
        .map(|layer| 1u32 << (2 * layer))
        .sum::<u32>();
    let batches = prompts.div_ceil(batch) as f64;
    Ok(f64::from(images) * (encoding + batches * decoding))
}

/// Returns the number of prompts in one inference.
fn batch_size(exports: &Exports, encoded: &Encoded) -> usize {
    let most = || exports.most_prompts(encoded).min(BATCH);
    exports.fixed_batch().unwrap_or_else(most)
}

fn masks_of_crop(
    exports: &Exports,
    photo: &RgbImage,
    crop: [u32; 4],
    config: &SamConfig,
    single: &mut bool,
) -> Result<Vec<Candidate>> {
    let [x0, y0, width, height] = crop;
    let part = imageops::crop_imm(photo, x0, y0, width, height).to_image();
    let encoded = exports.encode(&part)?;
    let n = config.points_per_side;
    let at = |k: u32| (k as f32 + 0.5) / n as f32;
    let grid: Vec<[f32; 2]> = (0..n)
        .flat_map(|y| (0..n).map(move |x| [at(x), at(y)]))
        .collect();
    let mut found: Vec<Candidate> = Vec::new();
    for points in grid.chunks(batch_size(exports, &encoded)) {
        let mut asked = points.to_vec();
        asked.resize(exports.fixed_batch().unwrap_or(points.len()), points[0]);
        let logits = exports.decode(&encoded, &asked)?;
        for prompt in 0..points.len() {
            let mut own = masks_of_prompt(&logits, prompt, [width, height], config);
            if logits.masks == 1 {
                *single = true;
                own.iter_mut()
                    .for_each(|c| c.level = by_size(&c.mask, photo));
            }
            found.extend(
                own.into_iter()
                    .filter_map(|candidate| placed(candidate, photo, crop)),
            );
        }
        // Duplicates are removed after each batch, so that memory hardly grows with the number of
        // prompts.
        if config.box_nms < 1.0 {
            found = without_copies(found);
        }
    }
    Ok(non_maximum_suppression(
        found,
        config.box_nms,
        |a, b| a.level == b.level || config.across_levels,
        |c| c.predicted_iou,
    ))
}

/// Keeps the best of all candidates with the same level and box.
/// The kept one suppresses the same boxes as the removed ones, so the result does not depend on the
/// order of prompts.
fn without_copies(mut candidates: Vec<Candidate>) -> Vec<Candidate> {
    candidates.sort_by(|a, b| b.predicted_iou.total_cmp(&a.predicted_iou));
    let mut seen = HashSet::new();
    candidates.retain(|c| seen.insert((c.level, c.mask.bounds)));
    candidates
}

/// Returns the masks of a prompt that pass the filters, at the size of the crop.
fn masks_of_prompt(
    logits: &Logits,
    prompt: usize,
    crop: [u32; 2],
    config: &SamConfig,
) -> Vec<Candidate> {
    let cells = logits.rows * logits.columns;
    // The first of four masks is meant for prompts of several points. Each prompt here is one
    // point.
    let skipped = usize::from(logits.masks == 4);
    let grid = |mask: usize| Grid {
        logits: &logits.values[(prompt * logits.masks + mask) * cells..][..cells],
        columns: logits.columns,
        covered_cells: logits.covered_cells,
        scale: logits.scale,
    };
    let mut masks: Vec<(usize, usize)> = (skipped..logits.masks)
        .map(|mask| (grid(mask).area(0.0), mask))
        .collect();
    masks.sort_by_key(|m| std::cmp::Reverse(m.0));
    let mut out = Vec::new();
    for ((area, mask), level) in masks.into_iter().zip(Level::ALL) {
        let predicted_iou = logits.scores[prompt * logits.masks + mask];
        if area == 0 || predicted_iou < config.predicted_iou {
            continue;
        }
        let grid = grid(mask);
        let Some(window) = grid.window(-STABILITY_OFFSET) else {
            continue;
        };
        let few = area < FEW_CELLS;
        let above = |threshold: f32| {
            if few {
                window.area(crop, threshold)
            } else {
                grid.area(threshold)
            }
        };
        let stability = above(STABILITY_OFFSET) as f32 / above(-STABILITY_OFFSET).max(1) as f32;
        if stability < config.stability {
            continue;
        }
        if let Some(mask) = window.mask(crop) {
            out.push(Candidate {
                level,
                predicted_iou,
                stability,
                mask,
                crop: 1.0,
            });
        }
    }
    out
}

/// Returns the level of a mask by its share of the photo's area.
fn by_size(mask: &BitMask, photo: &RgbImage) -> Level {
    let share = mask.area() as f32 / (photo.width() * photo.height()) as f32;
    Level::ALL[MIN_LEVEL_AREAS.iter().filter(|s| share < **s).count()]
}

/// Moves a mask from crop to photo coordinates. Returns `None` if the crop's border cut it off.
fn placed(
    candidate: Candidate,
    photo: &RgbImage,
    [x0, y0, width, height]: [u32; 4],
) -> Option<Candidate> {
    let near = (BORDER * photo.width().max(photo.height()) as f32) as u32;
    let [l, t, r, b] = candidate.mask.bounds;
    let inner = [
        (l, x0 == 0),
        (t, y0 == 0),
        (width - r, x0 + width == photo.width()),
        (height - b, y0 + height == photo.height()),
    ];
    let cut_off = inner
        .iter()
        .any(|(distance, at_photos_border)| !at_photos_border && *distance <= near);
    let mask = BitMask {
        bounds: [l + x0, t + y0, r + x0, b + y0],
        ..candidate.mask
    };
    (!cut_off).then_some(Candidate {
        mask,
        crop: width as f32 / photo.width() as f32,
        ..candidate
    })
}

/// Non-maximum suppression: of competing candidates whose boxes have an IoU above `most`, keeps the
/// one with the highest score. Of equal scores it keeps the first.
fn non_maximum_suppression(
    mut candidates: Vec<Candidate>,
    most: f32,
    compete: impl Fn(&Candidate, &Candidate) -> bool,
    score: impl Fn(&Candidate) -> f32,
) -> Vec<Candidate> {
    candidates.sort_by(|a, b| score(b).total_cmp(&score(a)));
    let mut kept: Vec<Candidate> = Vec::new();
    for c in candidates {
        if !kept
            .iter()
            .any(|k| compete(k, &c) && box_iou(k.mask.bounds, c.mask.bounds) > most)
        {
            kept.push(c);
        }
    }
    kept
}

/// Mask suppression of LangSplat's preprocessing, for the masks of one level. It removes masks that
/// repeat a better one, small parts of another mask, and masks with a low score.
pub fn suppressed(mut candidates: Vec<Candidate>, rule: &Suppression) -> Vec<Candidate> {
    let score = |c: &Candidate| c.predicted_iou * c.stability;
    candidates.sort_by(|a, b| score(b).total_cmp(&score(a)));
    let areas: Vec<f32> = candidates.iter().map(|c| c.mask.area() as f32).collect();
    let is_suppressed_by = |k: usize, other: usize| {
        let common = candidates[k].mask.common(&candidates[other].mask) as f32;
        let [own, theirs] = [k, other].map(|c| common / areas[c]);
        let repeats = other < k && common / (areas[k] + areas[other] - common) > rule.iou;
        repeats || (own >= rule.containment && theirs < 0.5 && own * theirs < rule.inner)
    };
    let all = 0..candidates.len();
    let stays = |k: &usize| {
        score(&candidates[*k]) > rule.score
            && !all
                .clone()
                .any(|other| other != *k && is_suppressed_by(*k, other))
    };
    let mut kept: Vec<Candidate> = all
        .clone()
        .filter(stays)
        .map(|k| candidates[k].clone())
        .collect();
    // At least one mask remains: otherwise up to three of the best are kept.
    if kept.is_empty() {
        candidates.truncate(3);
        kept = candidates;
    }
    kept
}

#[cfg(test)]
mod tests {
    use super::*;

    fn candidate(bounds: [u32; 4], predicted_iou: f32) -> Candidate {
        let mask = BitMask::from_fn(bounds, |_, _| true).unwrap();
        Candidate {
            level: Level::Whole,
            predicted_iou,
            stability: 1.0,
            mask,
            crop: 1.0,
        }
    }

    #[test]
    fn crops_cover_the_photo_and_overlap() {
        assert_eq!(crops([1500, 1000], 0), [[0, 0, 1500, 1000]]);
        let four = crops([1500, 1000], 1);
        // Overlap of 341 pixels: (341 + 1500) / 2 and (341 + 1000) / 2, rounded up.
        assert_eq!(four[0], [0, 0, 921, 671]);
        assert_eq!(
            (four[3][0] + four[3][2], four[3][1] + four[3][3]),
            (1500, 1000)
        );
        assert_eq!(crops([40, 30], 2).len(), 16);
    }

    #[test]
    fn masks_cut_off_by_a_crop_are_dropped() {
        let photo = RgbImage::new(200, 100);
        let of = |bounds: [u32; 4], crop: [u32; 4]| {
            placed(candidate(bounds, 1.0), &photo, crop).map(|c| c.mask.bounds)
        };
        assert_eq!(
            of([0, 40, 30, 60], [0, 0, 120, 100]),
            Some([0, 40, 30, 60]),
            "a mask at the photo's own border is not cut off"
        );
        assert_eq!(of([90, 40, 119, 60], [0, 0, 120, 100]), None);
        assert_eq!(
            of([10, 40, 40, 60], [80, 0, 120, 100]),
            Some([90, 40, 120, 60])
        );
    }

    #[test]
    fn the_better_of_two_boxes_stays() {
        let all = vec![
            candidate([0, 0, 10, 10], 0.8),
            candidate([0, 0, 10, 9], 0.9),
            candidate([20, 0, 30, 10], 0.7),
        ];
        let kept = non_maximum_suppression(all, 0.7, |_, _| true, |c| c.predicted_iou);
        assert_eq!(
            kept.iter().map(|c| c.predicted_iou).collect::<Vec<_>>(),
            [0.9, 0.7]
        );
    }

    #[test]
    fn result_does_not_depend_on_the_order_of_prompts() {
        // The second overlaps the first and the third. The third suppresses the second, so the
        // first remains.
        let of = |x: u32, score: f32| candidate([x, 0, x + 100, 10], score);
        let all = [of(0, 0.8), of(12, 0.9), of(24, 0.95), of(24, 0.85)];
        for order in [[0, 1, 2, 3], [3, 2, 1, 0], [1, 3, 0, 2]] {
            let mut found = Vec::new();
            for k in order {
                found.push(all[k].clone());
                found = without_copies(found);
            }
            let kept = non_maximum_suppression(found, 0.7, |_, _| true, |c| c.predicted_iou);
            assert_eq!(
                kept.iter().map(|c| c.predicted_iou).collect::<Vec<_>>(),
                [0.95, 0.8],
                "{order:?}"
            );
        }
    }

    #[test]
    fn repeated_small_and_low_score_masks_are_suppressed() {
        let rule = Suppression {
            iou: 0.8,
            score: 0.7,
            inner: 0.5,
            containment: 0.85,
        };
        let scores = |all: Vec<Candidate>| {
            suppressed(all, &rule)
                .iter()
                .map(|c| c.predicted_iou)
                .collect::<Vec<_>>()
        };
        // The second repeats the first, the third is a small part of it, the fourth has a low
        // score, the fifth is separate.
        let all = [
            ([0, 0, 10, 10], 0.95),
            ([0, 0, 10, 9], 0.9),
            ([0, 0, 3, 3], 0.8),
            ([20, 0, 30, 10], 0.6),
            ([40, 0, 50, 10], 0.75),
        ];
        assert_eq!(
            scores(all.map(|(b, s)| candidate(b, s)).to_vec()),
            [0.95, 0.75]
        );
        assert_eq!(
            scores(vec![candidate([0, 0, 10, 10], 0.3)]),
            [0.3],
            "at least one mask remains"
        );
    }
}
