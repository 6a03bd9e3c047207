//! What a run makes lies aside until all of it is there: one that fails or is killed leaves the earlier scene as it was.

use crate::Result;
use fastlgs_core::scene_folder::{MANIFEST, Manifest};
use fastlgs_core::{Error, SceneFolder};
use std::path::Path;

/// What the earlier scene had, until it is removed with the rest.
const BEFORE: &str = "before";

/// A folder within the scene's, which is gone with this.
pub(crate) struct Aside {
    /// What is made is written here.
    pub folder: SceneFolder,
    /// Whether it must stay, as it holds what could not be put back.
    stays: bool,
}

impl Aside {
    /// An empty one for a stage; what a run that was killed left goes.
    pub fn new(scene: &SceneFolder, stage: &str) -> Result<Self> {
        let root = scene.root.join(format!("{stage}.partial"));
        let _ = std::fs::remove_dir_all(&root);
        std::fs::create_dir_all(&root).map_err(Error::io(&root))?;
        Ok(Self { folder: SceneFolder::new(root), stays: false })
    }

    /// Puts files and folders of these names in their places; those that were not made are no longer there. The manifest, without which there
    /// is no scene, goes first and comes last.
    ///
    /// # Errors
    /// The system's refusal; the earlier scene is then put back.
    pub fn take_its_place(mut self, scene: &SceneFolder, names: &[&str], manifest: &Manifest) -> Result<()> {
        self.folder.save_manifest(manifest)?;
        let before = self.folder.root.join(BEFORE);
        let (made, place) = (|name: &str| self.folder.root.join(name), |name: &str| scene.root.join(name));
        let away = std::iter::once(&MANIFEST).chain(names).map(|name| (place(name), before.join(name)));
        let into = names.iter().chain([&MANIFEST]).map(|name| (made(name), place(name)));
        let mut moved = Vec::new();
        let done = away.chain(into).try_for_each(|(from, to)| {
            if rename_if_there(&from, &to)? {
                moved.push((from, to));
            }
            Ok(())
        });
        if done.is_err() {
            self.stays = moved.iter().rev().any(|(from, to)| std::fs::rename(to, from).is_err());
        }
        done
    }

    /// Puts the earlier scene back where a run was killed between the first and the last of these moves.
    pub fn recover(scene: &SceneFolder, stage: &str, names: &[&str]) -> Result<()> {
        let before = scene.root.join(format!("{stage}.partial")).join(BEFORE);
        if !before.join(MANIFEST).is_file() || scene.root.join(MANIFEST).exists() {
            return Ok(());
        }
        for name in names.iter().chain([&MANIFEST]) {
            let (place, old) = (scene.root.join(name), before.join(name));
            if old.exists() && place.exists() {
                rename_if_there(&place, &before.join("new").join(name))?;
            }
            rename_if_there(&old, &place)?;
        }
        Ok(())
    }
}

impl Drop for Aside {
    fn drop(&mut self) {
        if !self.stays {
            let _ = std::fs::remove_dir_all(&self.folder.root);
        }
    }
}

/// Renames what is there; whether there was anything.
fn rename_if_there(from: &Path, to: &Path) -> Result<bool> {
    if !from.exists() {
        return Ok(false);
    }
    if let Some(parent) = to.parent() {
        std::fs::create_dir_all(parent).map_err(Error::io(parent))?;
    }
    std::fs::rename(from, to).map_err(Error::io(from))?;
    Ok(true)
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn manifest(segmenter: &str) -> Manifest {
        let fields =
            json!({ "version": "0", "photos": "p", "holdout": 8, "segmenter": segmenter, "encoder": "offline", "seed": 0, "warnings": [] });
        serde_json::from_value(fields).unwrap()
    }

    #[test]
    fn a_scene_is_the_earlier_one_or_the_new_one() {
        let dir = tempfile::tempdir().unwrap();
        let scene = SceneFolder::new(dir.path());
        let write = |folder: &SceneFolder, name: &str, text: &str| {
            let path = folder.root.join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, text).unwrap();
        };
        let read = |name: &str| std::fs::read_to_string(scene.root.join(name)).ok();
        for name in ["photos/a.png", "alpha/a.png", "cameras/trained.json", "scene.ply"] {
            write(&scene, name, "old");
        }
        scene.save_manifest(&manifest("offline")).unwrap();
        let begun = || {
            let aside = Aside::new(&scene, "preprocess").unwrap();
            write(&aside.folder, "photos/b.png", "new");
            write(&aside.folder, "cameras/cameras.json", "new");
            aside
        };
        drop(begun());
        assert_eq!((read("photos/a.png"), read("photos/b.png")), (Some("old".to_owned()), None));
        begun().take_its_place(&scene, &["photos", "alpha", "cameras"], &manifest("sam")).unwrap();
        for gone in ["photos/a.png", "alpha/a.png", "cameras/trained.json", "preprocess.partial/before/photos/a.png"] {
            assert_eq!(read(gone), None, "{gone}");
        }
        assert_eq!((read("photos/b.png").as_deref(), read("scene.ply").as_deref()), (Some("new"), Some("old")));
        assert_eq!(scene.manifest().unwrap().segmenter, "sam");
        // A file cannot take the place of a folder: what was moved until then goes back.
        let aside = begun();
        write(&aside.folder, "scene.ply", "new");
        std::fs::create_dir_all(aside.folder.root.join(BEFORE).join("scene.ply")).unwrap();
        aside.take_its_place(&scene, &["photos", "scene.ply"], &manifest("import")).unwrap_err();
        assert_eq!((read("photos/b.png").as_deref(), read("scene.ply").as_deref()), (Some("new"), Some("old")));
        assert_eq!(scene.manifest().unwrap().segmenter, "sam");
        // Killed in between: as the first run left it, with the manifest away.
        let aside = begun();
        std::fs::create_dir_all(aside.folder.root.join(BEFORE)).unwrap();
        std::fs::rename(scene.root.join("photos"), aside.folder.root.join(BEFORE).join("photos")).unwrap();
        std::fs::rename(aside.folder.root.join("photos"), scene.root.join("photos")).unwrap();
        std::fs::rename(scene.root.join(MANIFEST), aside.folder.root.join(BEFORE).join(MANIFEST)).unwrap();
        write(&scene, "photos/c.png", "newer");
        std::mem::forget(aside);
        Aside::recover(&scene, "preprocess", &["photos", "alpha"]).unwrap();
        assert_eq!((read("photos/b.png").as_deref(), read("photos/c.png")), (Some("new"), None));
        assert_eq!(scene.manifest().unwrap().segmenter, "sam");
    }
}
