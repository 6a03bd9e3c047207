//! Cache of preprocessing results, with fingerprints of their inputs as keys.
//!
//! A second run computes only what changed, and an interrupted run continues.

use crate::Result;
use fastlgs_core::{SceneFolder, fs};
use serde::Serialize;
use serde::de::DeserializeOwned;
use sha2::{Digest, Sha256};
use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::sync::Mutex;

/// SHA-256 fingerprint of inputs.
pub type Key = [u8; 32];

/// Returns the fingerprint of inputs. The length of each input is part of it.
pub fn key(parts: &[&[u8]]) -> Key {
    let mut hash = Sha256::new();
    for part in parts {
        hash.update((part.len() as u64).to_le_bytes());
        hash.update(part);
    }
    hash.finalize().into()
}

/// Length of the file name of a result: 16 bytes of its fingerprint in hexadecimal digits.
const NAME_LENGTH: usize = 32;
/// Bytes of unused results that are kept in any case.
const MIN_UNUSED_BYTES: u64 = 256 << 20;

/// The cache of a scene, with files `SCENE/cache/STAGE/FINGERPRINT`.
pub struct Cache {
    root: PathBuf,
    used: Mutex<BTreeSet<PathBuf>>,
    /// By stage: number of results found, and number of results requested.
    counts: Mutex<BTreeMap<&'static str, [usize; 2]>>,
}

impl Cache {
    /// Returns the cache of a scene folder.
    pub fn new(folder: &SceneFolder) -> Self {
        Self {
            root: folder.root.join("cache"),
            used: Mutex::default(),
            counts: Mutex::default(),
        }
    }

    /// Returns the cached result of these inputs and this version of the program. If there is none,
    /// calls `make` and stores its result.
    ///
    /// # Errors
    /// Errors of `make`, or a file that cannot be written.
    pub fn get<T: Serialize + DeserializeOwned>(
        &self,
        stage: &'static str,
        inputs: &Key,
        make: impl FnOnce() -> Result<T>,
    ) -> Result<T> {
        let path = self.path(stage, inputs);
        // An unreadable file counts as missing.
        let cached = std::fs::read(&path)
            .ok()
            .and_then(|bytes| postcard::from_bytes(&bytes).ok());
        self.used
            .lock()
            .expect("no panic while holding the lock")
            .insert(path.clone());
        let mut counts = self.counts.lock().expect("no panic while holding the lock");
        let [hits, requests] = counts.entry(stage).or_default();
        *requests += 1;
        *hits += usize::from(cached.is_some());
        drop(counts);
        if let Some(known) = cached {
            return Ok(known);
        }
        let made = make()?;
        let bytes = postcard::to_stdvec(&made)?;
        fs::write_atomic(&path, |file| std::io::Write::write_all(file, &bytes))?;
        Ok(made)
    }

    /// Returns whether there is a result of these inputs and this version of the program.
    pub fn has(&self, stage: &str, inputs: &Key) -> bool {
        self.path(stage, inputs).is_file()
    }

    fn path(&self, stage: &str, inputs: &Key) -> PathBuf {
        let key = key(&[env!("CARGO_PKG_VERSION").as_bytes(), inputs]);
        let name: String = key[..NAME_LENGTH / 2]
            .iter()
            .map(|b| format!("{b:02x}"))
            .collect();
        self.root.join(stage).join(name)
    }

    /// Returns by stage the number of results found, and the number of results requested.
    pub fn counts(&self) -> BTreeMap<&'static str, [usize; 2]> {
        self.counts
            .lock()
            .expect("no panic while holding the lock")
            .clone()
    }

    /// Removes the oldest results that this run did not use. Unused results may take as many bytes
    /// as used ones, and at least [`MIN_UNUSED_BYTES`]. A trial with another segmenter therefore
    /// keeps the earlier results.
    pub fn tidy(&self) {
        self.tidy_to(MIN_UNUSED_BYTES);
    }

    fn tidy_to(&self, least: u64) {
        let used = self.used.lock().expect("no panic while holding the lock");
        let stages = std::fs::read_dir(&self.root)
            .into_iter()
            .flatten()
            .flatten();
        let files = stages.flat_map(|stage| {
            std::fs::read_dir(stage.path())
                .into_iter()
                .flatten()
                .flatten()
        });
        // Other files in these folders are not results.
        let is_result = |file: &std::fs::DirEntry| {
            let name = file.file_name();
            name.len() == NAME_LENGTH && name.as_encoded_bytes().iter().all(u8::is_ascii_hexdigit)
        };
        let results = files
            .filter(is_result)
            .filter_map(|file| Some((file.path(), file.metadata().ok()?)));
        let (in_use, mut unused): (Vec<_>, Vec<_>) =
            results.partition(|(path, _)| used.contains(path));
        let max_unused_bytes = in_use
            .iter()
            .map(|(_, about)| about.len())
            .sum::<u64>()
            .max(least);
        // The newest first.
        unused
            .sort_by_key(|(path, about)| (std::cmp::Reverse(about.modified().ok()), path.clone()));
        let mut taken = 0;
        for (path, about) in unused {
            taken += about.len();
            if taken > max_unused_bytes {
                let _ = std::fs::remove_file(path);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_changed_inputs_are_recomputed() {
        let dir = tempfile::tempdir().unwrap();
        let made = std::cell::RefCell::new(0);
        let ask = |cache: &Cache, input: &str| {
            let make = || {
                *made.borrow_mut() += 1;
                Ok(vec![input.len() as u32])
            };
            cache.get("stage", &key(&[input.as_bytes()]), make).unwrap()
        };
        let cache = Cache::new(&SceneFolder::new(dir.path()));
        assert_eq!(
            (ask(&cache, "one"), ask(&cache, "three"), ask(&cache, "one")),
            (vec![3], vec![5], vec![3])
        );
        assert_eq!((*made.borrow(), cache.counts()["stage"]), (2, [1, 3]));
        // A run that uses one of two results keeps the other. A run that uses one of many does not
        // keep all.
        let rest = |input: &str| {
            let cache = Cache::new(&SceneFolder::new(dir.path()));
            ask(&cache, input);
            cache.tidy_to(0);
            std::fs::read_dir(dir.path().join("cache/stage"))
                .unwrap()
                .count()
        };
        assert_eq!(
            rest("one"),
            2,
            "unused results may take as many bytes as used ones"
        );
        let cache = Cache::new(&SceneFolder::new(dir.path()));
        (0..8).for_each(|k| drop(ask(&cache, &"x".repeat(10 + k))));
        assert_eq!((rest("one"), *made.borrow()), (2, 10));
        assert_ne!(key(&[b"ab", b"c"]), key(&[b"a", b"bc"]));
    }
}
