//! What preprocessing knows of the masks, kept for whichever mapping comes after: `embeddings.safetensors`.

use crate::Result;
use crate::mapping::{Correspondences, Mask};
use fastlgs_core::scene_folder::{load_tensors, save_tensors};
use fastlgs_core::{Error, SceneFolder};

const FILE: &str = "embeddings.safetensors";

/// Writes masks (view, label, area, embedding, histogram) and key-point pairs between them.
///
/// # Errors
/// The system's refusal.
pub fn save(folder: &SceneFolder, masks: &[Mask], pairs: &Correspondences) -> Result<()> {
    let n = masks.len();
    let width = |f: fn(&Mask) -> &Vec<f32>| masks.first().map_or(0, |m| f(m).len());
    let places: Vec<f32> = masks.iter().flat_map(|m| [m.view as f32, f32::from(m.label), m.area]).collect();
    let embeddings: Vec<f32> = masks.iter().flat_map(|m| m.embedding.iter().copied()).collect();
    let histograms: Vec<f32> = masks.iter().flat_map(|m| m.histogram.iter().copied()).collect();
    let rows: Vec<f32> = pairs.iter().flat_map(|(&(later, earlier), &count)| [later as f32, earlier as f32, count as f32]).collect();
    let tensors = [
        ("view_label_area", vec![n, 3], places.as_slice()),
        ("embeddings", vec![n, width(|m| &m.embedding)], &embeddings),
        ("histograms", vec![n, width(|m| &m.histogram)], &histograms),
        ("pairs", vec![pairs.len(), 3], &rows),
    ];
    Ok(save_tensors(&folder.root.join(FILE), &tensors)?)
}

/// Reads what [`save`] wrote.
///
/// # Errors
/// Missing or damaged file.
pub fn load(folder: &SceneFolder) -> Result<(Vec<Mask>, Correspondences)> {
    let path = folder.root.join(FILE);
    let tensors = load_tensors(&path)?;
    let get = |name: &str| {
        let found = tensors.get(name).filter(|t| t.0.len() == 2);
        found.ok_or_else(|| Error::format(&path, format!("tensor '{name}' is missing; run 'fastlgs preprocess' again")))
    };
    let (places, embeddings, histograms, rows) = (get("view_label_area")?, get("embeddings")?, get("histograms")?, get("pairs")?);
    let n = places.0[0];
    if embeddings.0[0] != n || histograms.0[0] != n || places.0[1] != 3 || rows.0[1] != 3 {
        return Err(Error::format(&path, "its tensors differ in length; run 'fastlgs preprocess' again").into());
    }
    let row = |t: &(Vec<usize>, Vec<f32>), i: usize| t.1[i * t.0[1]..(i + 1) * t.0[1]].to_vec();
    let masks = (0..n).map(|i| {
        let place = row(places, i);
        Mask {
            view: place[0] as usize,
            label: place[1] as u16,
            area: place[2],
            embedding: row(embeddings, i),
            histogram: row(histograms, i),
        }
    });
    let pairs = rows.1.chunks_exact(3).map(|r| ((r[0] as usize, r[1] as usize), r[2] as u32)).collect();
    Ok((masks.collect(), pairs))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn round_trip() {
        let dir = tempfile::tempdir().unwrap();
        let folder = SceneFolder::new(dir.path());
        let mask = |view, label| Mask { view, label, area: 0.25, embedding: vec![0.5, 0.25], histogram: vec![1.0, 0.0, 0.0] };
        let pairs = Correspondences::from([((1, 0), 7)]);
        save(&folder, &[mask(0, 1), mask(3, 2)], &pairs).unwrap();
        let (masks, read) = load(&folder).unwrap();
        assert_eq!((masks.len(), masks[1].view, masks[1].label, read), (2, 3, 2, pairs));
        assert_eq!(masks[0].histogram, [1.0, 0.0, 0.0]);
    }
}
