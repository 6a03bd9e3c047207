//! Input of Algorithm 1 in the scene folder.
//!
//! `pairs.safetensors` counts the key points that masks share; `embeddings.safetensors` describes
//! each mask.

use crate::Result;
use crate::mapping::{Correspondences, Mask};
use fastlgs_core::scene_folder::{
    embedding_encoder, load_tensors, parse_tensors, save_embeddings, save_tensors,
};
use fastlgs_core::{Error, SceneFolder, fs};
use std::collections::BTreeMap;
use std::path::PathBuf;

/// A mask: index of its view among the training views, and its label there.
pub type MaskKey = (usize, u16);

/// Numbers of key-point pairs, by `[mask of a later view, mask of an earlier view]`.
pub type Pairs = BTreeMap<[MaskKey; 2], u32>;

/// Returns the path of the mask descriptions.
pub fn masks_path(folder: &SceneFolder) -> PathBuf {
    folder.root.join("embeddings.safetensors")
}

fn pairs_path(folder: &SceneFolder) -> PathBuf {
    folder.root.join("pairs.safetensors")
}

/// Writes the numbers of key-point pairs between masks.
///
/// # Errors
/// The file cannot be written.
pub fn save_pairs(folder: &SceneFolder, pairs: &Pairs) -> Result<()> {
    let number = |(view, label): MaskKey| [view as f32, f32::from(label)];
    let row = |(&[later, earlier], &count): (&[MaskKey; 2], &u32)| {
        [&number(later)[..], &number(earlier), &[count as f32]].concat()
    };
    let rows: Vec<f32> = pairs.iter().flat_map(row).collect();
    Ok(save_tensors(
        &pairs_path(folder),
        &[("pairs", vec![pairs.len(), 5], rows.as_slice())],
    )?)
}

/// Reads the file of [`save_pairs`]; masks become indices into `masks`. Leaves out pairs whose
/// masks are not in `masks`.
///
/// # Errors
/// The file is missing or damaged.
pub fn load_pairs(folder: &SceneFolder, masks: &[Mask]) -> Result<Correspondences> {
    let path = pairs_path(folder);
    let tensors = load_tensors(&path)?;
    let rows = tensors.get("pairs").filter(|t| matches!(t.0[..], [_, 5]));
    let rows = rows.ok_or_else(|| {
        Error::format(
            &path,
            "tensor 'pairs' is missing; run 'fastlgs preprocess' again",
        )
    })?;
    let index: BTreeMap<MaskKey, usize> = masks
        .iter()
        .enumerate()
        .map(|(i, m)| ((m.view, m.label), i))
        .collect();
    let place = |of: &[f32]| index.get(&(of[0] as usize, of[1] as u16)).copied();
    let pair = |row: &[f32]| Some(((place(&row[..2])?, place(&row[2..4])?), row[4] as u32));
    Ok(rows.1.chunks_exact(5).filter_map(pair).collect())
}

/// Writes view, label, area, embedding and histogram of each mask, and the identity of the encoder.
///
/// # Errors
/// The file cannot be written.
pub fn save_masks(folder: &SceneFolder, masks: &[Mask], encoder: &str) -> Result<()> {
    let n = masks.len();
    let width = |f: fn(&Mask) -> &Vec<f32>| masks.first().map_or(0, |m| f(m).len());
    let places: Vec<f32> = masks
        .iter()
        .flat_map(|m| [m.view as f32, f32::from(m.label), m.area])
        .collect();
    let embeddings: Vec<f32> = masks
        .iter()
        .flat_map(|m| m.embedding.iter().copied())
        .collect();
    let histograms: Vec<f32> = masks
        .iter()
        .flat_map(|m| m.histogram.iter().copied())
        .collect();
    let tensors = [
        ("view_label_area", vec![n, 3], places.as_slice()),
        ("embeddings", vec![n, width(|m| &m.embedding)], &embeddings),
        ("histograms", vec![n, width(|m| &m.histogram)], &histograms),
    ];
    Ok(save_embeddings(&masks_path(folder), &tensors, encoder)?)
}

/// Reads the file of [`save_masks`]: the masks, and the identity of their encoder (empty if
/// unknown).
///
/// # Errors
/// The file is missing or damaged.
pub fn load_masks(folder: &SceneFolder) -> Result<(Vec<Mask>, String)> {
    let path = masks_path(folder);
    let file = fs::read(&path)?;
    let (tensors, encoder) = (
        parse_tensors(&path, &file)?,
        embedding_encoder(&path, &file)?,
    );
    let get = |name: &str| {
        let found = tensors.get(name).filter(|t| t.0.len() == 2);
        found.ok_or_else(|| {
            Error::format(
                &path,
                format!("tensor '{name}' is missing; run 'fastlgs preprocess' again"),
            )
        })
    };
    let (places, embeddings, histograms) = (
        get("view_label_area")?,
        get("embeddings")?,
        get("histograms")?,
    );
    let n = places.0[0];
    if embeddings.0[0] != n || histograms.0[0] != n || places.0[1] != 3 {
        return Err(Error::format(
            &path,
            "its tensors differ in length; run 'fastlgs preprocess' again",
        )
        .into());
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
    Ok((masks.collect(), encoder))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn round_trip() {
        let dir = tempfile::tempdir().unwrap();
        let folder = SceneFolder::new(dir.path());
        let mask = |view, label| Mask {
            view,
            label,
            area: 0.25,
            embedding: vec![0.5, 0.25],
            histogram: vec![1.0, 0.0, 0.0],
        };
        save_masks(&folder, &[mask(0, 1), mask(3, 2)], "offline 3").unwrap();
        let (masks, encoder) = load_masks(&folder).unwrap();
        assert_eq!(
            (masks.len(), masks[1].view, masks[1].label, encoder.as_str()),
            (2, 3, 2, "offline 3")
        );
        assert_eq!(masks[0].histogram, [1.0, 0.0, 0.0]);
        // The second pair names a mask without a description.
        save_pairs(
            &folder,
            &Pairs::from([([(3, 2), (0, 1)], 7), ([(3, 9), (0, 1)], 2)]),
        )
        .unwrap();
        assert_eq!(
            load_pairs(&folder, &masks).unwrap(),
            Correspondences::from([((1, 0), 7)])
        );
    }
}
