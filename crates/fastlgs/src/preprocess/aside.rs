//! What a run makes lies aside until all of it is there: one that fails or is killed leaves the earlier scene as it was.

use crate::Result;
use fastlgs_core::scene_folder::Manifest;
use fastlgs_core::{Error, SceneFolder};
use std::path::Path;

/// Where it lies, in the scene's folder.
const ASIDE: &str = "preprocess.partial";
/// What the earlier scene had, until it is removed with the rest.
const BEFORE: &str = "before";
/// All that preprocessing leaves, beside the manifest.
const LEFT: [&str; 8] =
    ["photos", "alpha", "ignore", "cameras", "masks", "points.safetensors", "pairs.safetensors", "embeddings.safetensors"];

/// A folder within the scene's, which is gone with this.
pub(super) struct Aside {
    /// What is made is written here.
    pub folder: SceneFolder,
}

impl Aside {
    /// An empty one; what a run that was killed left goes.
    pub fn new(scene: &SceneFolder) -> Result<Self> {
        let root = scene.root.join(ASIDE);
        let _ = std::fs::remove_dir_all(&root);
        std::fs::create_dir_all(&root).map_err(Error::io(&root))?;
        Ok(Self { folder: SceneFolder::new(root) })
    }

    /// Puts everything in its place. The manifest, without which there is no scene, goes first and comes last.
    pub fn take_its_place(self, scene: &SceneFolder, manifest: &Manifest) -> Result<()> {
        let before = self.folder.root.join(BEFORE);
        std::fs::create_dir_all(&before).map_err(Error::io(&before))?;
        scene.remove_manifest()?;
        for name in LEFT {
            let (made, place) = (self.folder.root.join(name), scene.root.join(name));
            rename_if_there(&place, &before.join(name))?;
            rename_if_there(&made, &place)?;
        }
        Ok(scene.save_manifest(manifest)?)
    }
}

impl Drop for Aside {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.folder.root);
    }
}

fn rename_if_there(from: &Path, to: &Path) -> Result<()> {
    match std::fs::rename(from, to) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => Err(Error::io(from)(error).into()),
        _ => Ok(()),
    }
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
            let aside = Aside::new(&scene).unwrap();
            write(&aside.folder, "photos/b.png", "new");
            write(&aside.folder, "cameras/cameras.json", "new");
            aside
        };
        drop(begun());
        assert_eq!((read("photos/a.png"), read("photos/b.png")), (Some("old".to_owned()), None));
        begun().take_its_place(&scene, &manifest("sam")).unwrap();
        for gone in ["photos/a.png", "alpha/a.png", "cameras/trained.json", "preprocess.partial/before/photos/a.png"] {
            assert_eq!(read(gone), None, "{gone}");
        }
        assert_eq!((read("photos/b.png").as_deref(), read("scene.ply").as_deref()), (Some("new"), Some("old")));
        assert_eq!(scene.manifest().unwrap().segmenter, "sam");
    }
}
