//! Compares real architectures with random weights to the output of their authors' programs, in
//! files that tests/reference.sh writes.

use crate::clip::{ClipImage, ClipText};
use crate::encoder::Encoder;
use crate::masks::BitMask;
use crate::sam::exports::Exports;
use crate::sam::{SamConfig, generation};
use fastlgs_core::{LabelMap, fs, image_io, npy};
use std::path::{Path, PathBuf};

/// Returns the folder of one architecture; `None` if its files were not made.
fn folder(which: &str) -> Option<PathBuf> {
    let Some(all) = std::env::var_os("FASTLGS_REFERENCE") else {
        crate::skip::skip(
            "FASTLGS_REFERENCE does not name the folder that tests/reference.sh writes",
        );
        return None;
    };
    let folder = Path::new(&all).join(which);
    if which == "sam2" && !folder.is_dir() {
        crate::skip::skip("the SAM 2 files are missing; set REFERENCE_SAM2 for tests/reference.sh");
        return None;
    }
    Some(folder)
}

/// Reads values and shape of a .npy file.
fn numbers(path: &Path) -> (Vec<f32>, Vec<usize>) {
    let file = npy::read(path).unwrap();
    (
        file.values.into_iter().map(|v| v as f32).collect(),
        file.shape,
    )
}

fn largest_difference(a: &[f32], b: &[f32]) -> f32 {
    assert_eq!(a.len(), b.len());
    a.iter()
        .zip(b)
        .map(|(a, b)| (a - b).abs())
        .fold(0.0, f32::max)
}

#[test]
fn sam_answers_as_the_originals_do() {
    for which in ["authors", "transformers", "sam2"] {
        let Some(folder) = folder(which) else { return };
        let exports =
            Exports::load(&folder.join("encoder.onnx"), &folder.join("decoder.onnx")).unwrap();
        let photo = image_io::load_rgb(&folder.join("photo.png")).unwrap();
        let encoded = exports.encode(&photo).unwrap();
        let size = [photo.width(), photo.height()].map(|s| s as f32);
        let (points, _) = numbers(&folder.join("points.npy"));
        let shares: Vec<[f32; 2]> = points
            .chunks_exact(2)
            .map(|p| [p[0] / size[0], p[1] / size[1]])
            .collect();
        let (low, shape) = numbers(&folder.join("low.npy"));
        let (scores, _) = numbers(&folder.join("scores.npy"));
        let (mut values, mut our_scores) = (Vec::new(), Vec::new());
        for points in shares.chunks(exports.fixed_batch().unwrap_or(shares.len())) {
            let found = exports.decode(&encoded, points).unwrap();
            assert_eq!(
                vec![points.len(), found.masks, found.rows, found.columns],
                [&[points.len()], &shape[1..]].concat(),
                "{which}"
            );
            values.extend(found.values);
            our_scores.extend(found.scores);
        }
        let spread = low.iter().fold(0.0f32, |m, v| m.max(v.abs()));
        let (logits, scores) = (
            largest_difference(&values, &low) / spread,
            largest_difference(&our_scores, &scores),
        );
        println!("{which}: logits differ by {logits:.1e} of the largest, scores by {scores:.1e}");
        assert!(
            logits < 1e-3 && scores < 1e-3,
            "{which}: {logits}, {scores}"
        );
    }
}

#[test]
fn masks_are_those_of_the_authors_generator() {
    for which in ["authors", "sam2"] {
        let Some(folder) = folder(which) else { return };
        compare_masks(&folder);
    }
}

/// Compares our masks of one architecture with those of the authors' generator, in both directions.
fn compare_masks(folder: &Path) {
    let exports =
        Exports::load(&folder.join("encoder.onnx"), &folder.join("decoder.onnx")).unwrap();
    let photo = image_io::load_rgb(&folder.join("photo.png")).unwrap();
    let filters: serde_json::Value = fs::read_json(&folder.join("filters.json")).unwrap();
    let filter = |name: &str| filters[name].as_f64().unwrap();
    let config = SamConfig {
        points_per_side: filter("points_per_side") as u32,
        predicted_iou: filter("predicted_iou") as f32,
        stability: filter("stability") as f32,
        crop_layers: filter("crop_layers") as u32,
        box_nms: 1.0,
        ..SamConfig::default()
    };
    let ours = generation::masks(&exports, &photo, &config).unwrap().0;
    let (pixels, shape) = numbers(&folder.join("masks.npy"));
    let (their_scores, _) = numbers(&folder.join("mask_scores.npy"));
    let (w, h) = (shape[2], shape[1]);
    let theirs: Vec<(BitMask, f32, f32)> = pixels
        .chunks_exact(w * h)
        .zip(their_scores.chunks_exact(2))
        .map(|(p, t)| {
            (
                BitMask::from_fn([0, 0, w as u32, h as u32], |x, y| {
                    p[y as usize * w + x as usize] > 0.0
                })
                .unwrap(),
                t[0],
                t[1],
            )
        })
        .collect();
    println!(
        "{}: {} masks, the authors' generator has {}",
        folder.display(),
        ours.len(),
        theirs.len()
    );
    // A mask that barely passes a filter may fail it in the other program.
    let clear = |score: f32, stability: f32| {
        score > config.predicted_iou + 0.01 && stability > config.stability + 0.02
    };
    assert!(
        theirs.iter().filter(|t| clear(t.1, t.2)).count() > 30,
        "too few masks pass the filters clearly"
    );
    assert!(
        ours.len().abs_diff(theirs.len()) <= 3,
        "{} and {}",
        ours.len(),
        theirs.len()
    );
    for own in &ours {
        let same = |t: &&(BitMask, f32, f32)| {
            (t.1 - own.predicted_iou).abs() < 1e-3 && own.mask.iou(&t.0) >= 0.99
        };
        let found = theirs.iter().find(same);
        assert!(
            found.is_some() || !clear(own.predicted_iou, own.stability),
            "{:?} {} {}",
            own.mask.bounds,
            own.predicted_iou,
            own.stability
        );
        assert!(
            found.is_none_or(|t| (t.2 - own.stability).abs() < 0.02),
            "{:?}",
            found.map(|t| (t.2, own.stability))
        );
    }
    for (mask, score, stability) in &theirs {
        let same = |own: &generation::Candidate| own.mask.iou(mask) >= 0.99;
        assert!(
            ours.iter().any(same) || !clear(*score, *stability),
            "{:?} {score} {stability}",
            mask.bounds
        );
    }
}

#[test]
fn clip_embeds_as_the_original_does() {
    embeds_as_the_original_does("clip", "image.onnx", "text.onnx");
}

#[test]
fn siglip_embeds_as_the_original_does() {
    embeds_as_the_original_does("siglip", "onnx/vision_model.onnx", "onnx/text_model.onnx");
}

fn embeds_as_the_original_does(which: &str, image: &str, text: &str) {
    let Some(folder) = folder(which) else { return };
    let cosine = |a: &[f32], b: &[f32]| {
        let product =
            |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| f64::from(a * b)).sum::<f64>();
        product(a, b) / (product(a, a) * product(b, b)).sqrt()
    };
    let photo = image_io::load_rgb(&folder.join("photo.png")).unwrap();
    let (width, height) = photo.dimensions();
    let all = LabelMap {
        width,
        height,
        labels: vec![1; (width * height) as usize],
    };
    let own = ClipImage::load(&folder.join(image))
        .unwrap()
        .embed_masks("", &photo, &all)
        .unwrap()
        .remove(0);
    let picture = cosine(&own, &numbers(&folder.join("picture.npy")).0);
    println!("picture: cosine {picture:.6}");
    assert!(picture >= 0.9999, "{picture}");
    let texts: Vec<String> = fs::read_json(&folder.join("texts.json")).unwrap();
    let (wanted, shape) = numbers(&folder.join("texts.npy"));
    let own = ClipText::load(&folder.join(text))
        .unwrap()
        .sentences(&texts)
        .unwrap();
    for ((text, own), wanted) in texts.iter().zip(&own).zip(wanted.chunks_exact(shape[1])) {
        let alike = cosine(own, wanted);
        println!("'{text}': cosine {alike:.6}");
        assert!(alike >= 0.9999, "'{text}': {alike}");
    }
}
