//! Results of preprocessing by what they were made from: a second run does again only what changed, and one that was killed
//! goes on where it was.

use crate::Result;
use fastlgs_core::{SceneFolder, fs};
use serde::Serialize;
use serde::de::DeserializeOwned;
use sha2::{Digest, Sha256};
use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::sync::Mutex;

/// A fingerprint of inputs.
pub type Key = [u8; 32];

/// Fingerprint of some inputs; where one ends and the next begins counts.
pub fn key(parts: &[&[u8]]) -> Key {
    let mut hash = Sha256::new();
    for part in parts {
        hash.update((part.len() as u64).to_le_bytes());
        hash.update(part);
    }
    hash.finalize().into()
}

/// Length of the name of a result: sixteen bytes of its fingerprint in hexadecimal digits.
const NAME_LENGTH: usize = 32;
/// Bytes that may lie idle in any case.
const IDLE: u64 = 256 << 20;

/// `SCENE/cache/STAGE/FINGERPRINT`.
pub struct Cache {
    root: PathBuf,
    used: Mutex<BTreeSet<PathBuf>>,
    /// By stage: results that were there, and all.
    counts: Mutex<BTreeMap<&'static str, [usize; 2]>>,
}

impl Cache {
    /// The cache of a scene folder.
    pub fn new(folder: &SceneFolder) -> Self {
        Self { root: folder.root.join("cache"), used: Mutex::default(), counts: Mutex::default() }
    }

    /// What `make` once made from inputs of this fingerprint, by this version of the program; else makes and keeps it.
    pub fn get<T: Serialize + DeserializeOwned>(&self, stage: &'static str, inputs: &Key, make: impl FnOnce() -> Result<T>) -> Result<T> {
        let key = key(&[env!("CARGO_PKG_VERSION").as_bytes(), inputs]);
        let name: String = key[..NAME_LENGTH / 2].iter().map(|b| format!("{b:02x}")).collect();
        let path = self.root.join(stage).join(name);
        // A file that cannot be read is as good as none.
        let known = std::fs::read(&path).ok().and_then(|bytes| postcard::from_bytes(&bytes).ok());
        self.used.lock().expect("no panic while holding the lock").insert(path.clone());
        let mut counts = self.counts.lock().expect("no panic while holding the lock");
        let [there, all] = counts.entry(stage).or_default();
        *all += 1;
        *there += usize::from(known.is_some());
        drop(counts);
        if let Some(known) = known {
            return Ok(known);
        }
        let made = make()?;
        let bytes = postcard::to_stdvec(&made)?;
        fs::write_atomic(&path, |file| std::io::Write::write_all(file, &bytes))?;
        Ok(made)
    }

    /// By stage, how many results were there already and how many were asked for.
    pub fn counts(&self) -> BTreeMap<&'static str, [usize; 2]> {
        self.counts.lock().expect("no panic while holding the lock").clone()
    }

    /// Removes what this run had no use for, oldest first, until the rest takes no more room than what it used, or than [`IDLE`]: a trial with
    /// another segmenter, or with masks of another program, leaves the first one's results.
    pub fn tidy(&self) {
        self.tidy_to(IDLE);
    }

    fn tidy_to(&self, least: u64) {
        let used = self.used.lock().expect("no panic while holding the lock");
        let stages = std::fs::read_dir(&self.root).into_iter().flatten().flatten();
        let files = stages.flat_map(|stage| std::fs::read_dir(stage.path()).into_iter().flatten().flatten());
        // Other files in these folders are not ours.
        let ours = |file: &std::fs::DirEntry| {
            let name = file.file_name();
            name.len() == NAME_LENGTH && name.as_encoded_bytes().iter().all(u8::is_ascii_hexdigit)
        };
        let known = files.filter(ours).filter_map(|file| Some((file.path(), file.metadata().ok()?)));
        let (in_use, mut idle): (Vec<_>, Vec<_>) = known.partition(|(path, _)| used.contains(path));
        let room = in_use.iter().map(|(_, about)| about.len()).sum::<u64>().max(least);
        // The newest first.
        idle.sort_by_key(|(path, about)| (std::cmp::Reverse(about.modified().ok()), path.clone()));
        let mut taken = 0;
        for (path, about) in idle {
            taken += about.len();
            if taken > room {
                let _ = std::fs::remove_file(path);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_changed_is_made_again() {
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
        assert_eq!((ask(&cache, "one"), ask(&cache, "three"), ask(&cache, "one")), (vec![3], vec![5], vec![3]));
        assert_eq!((*made.borrow(), cache.counts()["stage"]), (2, [1, 3]));
        // A run that uses one of two leaves the other, one that uses one of many does not leave all.
        let rest = |input: &str| {
            let cache = Cache::new(&SceneFolder::new(dir.path()));
            ask(&cache, input);
            cache.tidy_to(0);
            std::fs::read_dir(dir.path().join("cache/stage")).unwrap().count()
        };
        assert_eq!(rest("one"), 2, "as much as is in use may lie idle");
        let cache = Cache::new(&SceneFolder::new(dir.path()));
        (0..8).for_each(|k| drop(ask(&cache, &"x".repeat(10 + k))));
        assert_eq!((rest("one"), *made.borrow()), (2, 10));
        assert_ne!(key(&[b"ab", b"c"]), key(&[b"a", b"bc"]));
    }
}
