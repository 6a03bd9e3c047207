//! `fastlgs bench vision`: how good masks and embeddings are by themselves, on the labelled photos, without any scene.
//!
//! *Oracle mask IoU*: the best single mask of any level for each label, and the best union of up to three. *Text top-1*: of
//! all the labels' names, is the one nearest to the embedding of the labelled crop its own?

use anyhow::{Context, Result, bail};
use fastlgs::Run;
use fastlgs::eyes::Eyes;
use fastlgs::preprocess::load_photo;
use fastlgs_core::{LabelMap, Level, MaskList, dataset, labels, metrics};
use fastlgs_vision::import;
use serde_json::{Value, json};
use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::time::Instant;

#[derive(clap::Args)]
#[command(after_help = "Example: fastlgs bench vision photos/fox photos/bonsai --max-side 960 -o out")]
pub struct Args {
    /// Folders of posed photos with labels/ beside images/; names of all of them compete.
    #[arg(required = true)]
    photos: Vec<PathBuf>,
    #[command(flatten)]
    eyes: Eyes,
    /// Longer side of the photos in pixels.
    #[arg(long, default_value_t = 960)]
    max_side: u32,
    /// Folder for the confusion table (confusion.md).
    #[arg(short, long)]
    output: Option<PathBuf>,
}

/// Masks that a union may be made of: those that share most with the label.
const UNITED: usize = 16;

/// One label of one photo.
struct Scored {
    photo: String,
    label: String,
    single: f64,
    union: f64,
    embedding: Vec<f32>,
}

pub fn run(args: &Args, run: &Run) -> Result<Value> {
    let mut scored = Vec::new();
    let (mut segment_seconds, mut embed_seconds, mut counts) = (0.0, 0.0, BTreeMap::<&str, f64>::new());
    let mut photos = 0;
    let progress = run.work("photos", 0);
    for folder in &args.photos {
        let dataset = dataset::load(folder)?;
        let lenses = import::lenses(&dataset);
        let segmenter = args.eyes.segmenter(folder, &lenses)?;
        let encoder = args.eyes.encoder(folder, &lenses)?;
        for view in labels::load(&folder.join("labels"), None)? {
            let posed = dataset.photos.iter().find(|p| p.camera.name == view.name);
            let posed = posed.with_context(|| format!("{}: the label '{}' has no photo", folder.display(), view.name))?;
            let photo = load_photo(posed, args.max_side)?;
            let (w, h) = photo.pixels.dimensions();
            progress.note(&view.name);
            progress.check()?;
            let started = Instant::now();
            let mut found = segmenter.segment(&view.name, &photo.pixels)?;
            found.masks.retain(|mask| args.eyes.keeps(mask.level));
            segment_seconds += started.elapsed().as_secs_f64();
            for level in Level::ALL {
                *counts.entry(level.name()).or_default() += found.count(level) as f64;
            }
            let started = Instant::now();
            for label in &view.labels {
                let truth = view.mask(label, w, h);
                let (single, union) = oracle(&found, &truth);
                let map = LabelMap { width: w, height: h, labels: truth.iter().map(|t| u16::from(*t)).collect() };
                let embedding = encoder.embed_masks(&view.name, &photo.pixels, &map)?.pop();
                let embedding = embedding.with_context(|| format!("the label '{}' of '{}' covers no pixel", label.category, view.name))?;
                scored.push(Scored { photo: view.name.clone(), label: label.category.clone(), single, union, embedding });
            }
            embed_seconds += started.elapsed().as_secs_f64();
            photos += 1;
        }
    }
    if scored.is_empty() {
        bail!("no labels were found");
    }
    let texts = args.eyes.text_encoder()?;
    let names: Vec<&str> = scored.iter().map(|s| s.label.as_str()).collect::<BTreeSet<_>>().into_iter().collect();
    let embedded = texts.embed(&names)?;
    let mean = |f: &dyn Fn(&Scored) -> f64| scored.iter().map(f).sum::<f64>() / scored.len() as f64;
    let mut table = "| label | photo | nearest name | own name's cosine, rank |\n|---|---|---|---|\n".to_owned();
    let mut hits = 0;
    let mut rows = Vec::new();
    for s in &scored {
        let mut cosines: Vec<(f32, &str)> =
            embedded.iter().zip(&names).map(|(e, n)| (e.iter().zip(&s.embedding).map(|(a, b)| a * b).sum(), *n)).collect();
        cosines.sort_by(|a, b| b.0.total_cmp(&a.0));
        let rank = cosines.iter().position(|c| c.1 == s.label).expect("every label is a name");
        hits += usize::from(rank == 0);
        table += &format!("| {} | {} | {} {:.2} | {:.2}, {} |\n", s.label, s.photo, cosines[0].1, cosines[0].0, cosines[rank].0, rank + 1);
        rows.push(
            json!({ "photo": s.photo, "label": s.label, "single": s.single, "union": s.union, "named": cosines[0].1, "rank": rank + 1 }),
        );
    }
    if let Some(folder) = &args.output {
        fastlgs_core::fs::write_atomic(&folder.join("confusion.md"), |file| std::io::Write::write_all(file, table.as_bytes()))?;
    }
    let value = json!({
        "photos": photos,
        "max_side": args.max_side,
        "segmenter": args.eyes.segmenter,
        "encoder": args.eyes.encoder,
        "labels": scored.len(),
        "names": names.len(),
        "oracle_mask_iou": mean(&|s| s.single),
        "oracle_union_of_three_iou": mean(&|s| s.union),
        "text_top1": hits as f64 / scored.len() as f64,
        "masks_per_photo": counts.into_iter().map(|(level, n)| (level, n / f64::from(photos))).collect::<BTreeMap<_, _>>(),
        "segment_seconds_per_photo": segment_seconds / f64::from(photos),
        "embed_seconds_per_label": embed_seconds / scored.len() as f64,
        "rows": rows,
    });
    if let Some(folder) = &args.output {
        fastlgs_core::fs::write_json(&folder.join("vision.json"), &value)?;
    }
    Ok(value)
}

/// IoU of the best mask of any level, and of the best union of up to three.
fn oracle(list: &MaskList, truth: &[bool]) -> (f64, f64) {
    let mut masks: Vec<(usize, Vec<bool>)> = Vec::new();
    for one in &list.masks {
        let mut mask = vec![false; truth.len()];
        list.places(one).for_each(|p| mask[p] = true);
        let shared = mask.iter().zip(truth).filter(|(m, t)| **m && **t).count();
        if shared > 0 {
            masks.push((shared, mask));
        }
    }
    let single = masks.iter().map(|m| metrics::iou(&m.1, truth)).fold(0.0f64, f64::max);
    masks.sort_by_key(|m| std::cmp::Reverse(m.0));
    masks.truncate(UNITED);
    let united = |chosen: &[usize]| {
        let union: Vec<bool> = (0..truth.len()).map(|p| chosen.iter().any(|&k| masks[k].1[p])).collect();
        metrics::iou(&union, truth)
    };
    let mut best = single;
    for a in 0..masks.len() {
        for b in a..masks.len() {
            for c in b..masks.len() {
                best = best.max(united(&[a, b, c]));
            }
        }
    }
    (single, best)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unions_of_three_over_all_levels() {
        let map = |labels: &[u16]| LabelMap { width: 4, height: 1, labels: labels.to_vec() };
        let levels = [map(&[1, 2, 2, 3]), map(&[1, 1, 0, 0]), map(&[0, 0, 0, 0])];
        assert_eq!(oracle(&MaskList::of_levels(&levels), &[true, true, false, false]), (1.0, 1.0));
        assert_eq!(oracle(&MaskList::of_levels(&levels), &[true, false, false, true]), (0.5, 1.0));
        assert_eq!(oracle(&MaskList::of_levels(&levels), &[true, true, true, false]), (2.0 / 3.0, 1.0));
    }
}
