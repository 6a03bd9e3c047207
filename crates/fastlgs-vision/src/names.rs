//! Text embeddings of the classifier's 1,000 class names, computed once and saved with the models.

use crate::encoder::{TextEncoder, normalise};
use crate::model_paths::{NAMES, offline_dir};
use crate::{Error, MiniLm, Result};
use fastlgs_core::fs;
use fastlgs_core::scene_folder::{load_tensors, save_tensors};
use std::collections::BTreeSet;

/// Number of names used for each class. Later names are rarer; the last ones are Latin.
const SYNONYMS: usize = 3;

/// Returns the embeddings of the class names, `[1000][384]`, L2-normalised. They are read from the
/// cache folder, or computed and saved there.
///
/// # Errors
/// When the offline models are not installed.
pub fn embeddings() -> Result<Vec<Vec<f32>>> {
    let folder = offline_dir();
    let lists: Vec<Vec<String>> = fs::read_json(&folder.join("classes.json"))?;
    let path = folder.join(NAMES);
    let cached = load_tensors(&path).ok().and_then(|mut t| t.remove("names"));
    if let Some((shape, values)) =
        cached.filter(|(shape, _)| shape.len() == 2 && shape[0] == lists.len() && shape[1] > 0)
    {
        return Ok(values.chunks_exact(shape[1]).map(<[f32]>::to_vec).collect());
    }
    let embeddings = embed(&lists)?;
    let shape = vec![lists.len(), embeddings.first().map_or(0, Vec::len)];
    // If the cache folder cannot be written, the embeddings are computed again next time.
    if let Err(e) = save_tensors(&path, &[("names", shape, &embeddings.concat())]) {
        tracing::debug!("the embeddings of the class names cannot be saved: {e}");
    }
    Ok(embeddings)
}

/// Returns the first name of each class, in the order of [`embeddings`].
///
/// # Errors
/// When the offline models are not installed.
pub fn class_names() -> Result<Vec<String>> {
    let lists: Vec<Vec<String>> = fs::read_json(&offline_dir().join("classes.json"))?;
    let first = |list: Vec<String>| list.into_iter().next().unwrap_or_default();
    Ok(lists.into_iter().map(first).collect())
}

/// Returns at most `most` words, each once: the classifier's class names, then English words of
/// MiniLM's vocabulary, roughly in descending order of frequency.
///
/// # Errors
/// When the offline models are not installed.
pub fn common_words(most: usize) -> Result<Vec<String>> {
    let folder = offline_dir();
    let lists: Vec<Vec<String>> = fs::read_json(&folder.join("classes.json"))?;
    let path = folder.join("tokenizer.json");
    let tokenizer = tokenizers::Tokenizer::from_file(&path)
        .map_err(|e| Error::Missing(format!("{}: {e}", path.display())))?;
    let mut pieces: Vec<(u32, String)> = tokenizer
        .get_vocab(false)
        .into_iter()
        .map(|(piece, place)| (place, piece))
        .collect();
    pieces.sort();
    let is_word = |piece: &String| piece.len() > 2 && piece.bytes().all(|b| b.is_ascii_lowercase());
    let class_names = lists
        .into_iter()
        .flat_map(|list| list.into_iter().take(SYNONYMS))
        .map(|name| name.to_lowercase());
    let mut seen = BTreeSet::new();
    let words = class_names
        .chain(pieces.into_iter().map(|p| p.1).filter(is_word))
        .filter(|word| seen.insert(word.clone()));
    Ok(words.take(most).collect())
}

/// Returns for each class the mean embedding of its first names.
fn embed(lists: &[Vec<String>]) -> Result<Vec<Vec<f32>>> {
    let names = |list: &[String]| list.len().min(SYNONYMS);
    let mut texts: Vec<(usize, &str)> = lists
        .iter()
        .enumerate()
        .flat_map(|(k, l)| l[..names(l)].iter().map(move |n| (k, n.as_str())))
        .collect();
    // Texts of similar length need less padding.
    texts.sort_by_key(|(k, name)| (name.len(), *k));
    let embeddings = MiniLm::load()?.embed(&texts.iter().map(|t| t.1).collect::<Vec<_>>())?;
    let mut means = vec![vec![0.0; embeddings.first().map_or(0, Vec::len)]; lists.len()];
    for ((class, _), embedding) in texts.iter().zip(embeddings) {
        means[*class]
            .iter_mut()
            .zip(embedding)
            .for_each(|(m, e)| *m += e);
    }
    means.iter_mut().for_each(|m| normalise(m));
    Ok(means)
}
