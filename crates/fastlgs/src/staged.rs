//! Staged output: files are written beside the scene and moved into it when they are complete. A
//! run that fails or is killed leaves the earlier scene.

use crate::Result;
use crate::error::bail;
use crate::stop_point;
use fastlgs_core::scene_folder::{MANIFEST, Manifest};
use fastlgs_core::{Error, SceneFolder};
use std::collections::BTreeSet;
use std::path::Path;

/// Subfolder of the replaced files, which is removed together with the staged output.
const REPLACED_FOLDER: &str = "before";

/// A folder within the scene folder; dropping this value removes it.
pub(crate) struct StagedOutput {
    /// Folder that the stage writes.
    pub folder: SceneFolder,
    /// Whether the folder must remain, because it holds replaced files that could not be restored.
    keep_folder: bool,
}

impl StagedOutput {
    /// Creates an empty folder for the output of a stage.
    pub fn new(scene: &SceneFolder, stage: &str) -> Result<Self> {
        let root = scene.root.join(format!("{stage}.partial"));
        let _ = std::fs::remove_dir_all(&root);
        std::fs::create_dir_all(&root).map_err(Error::io(&root))?;
        Ok(Self {
            folder: SceneFolder::new(root),
            keep_folder: false,
        })
    }

    /// Moves the staged files into the scene, and lists them in its manifest. `reserved` are
    /// further files to list, which later stages write in place.
    ///
    /// Only files that the earlier manifest lists are replaced: those that equal or lie in one of
    /// `replaced`, and those that the stage writes again. A folder without manifest is not a scene,
    /// so the manifest is moved away first and moved in last.
    ///
    /// # Errors
    /// A file in the way that the manifest does not list, or a move that fails. The earlier scene
    /// is then restored.
    pub fn publish(
        mut self,
        scene: &SceneFolder,
        replaced: &[&str],
        reserved: impl IntoIterator<Item = String>,
        manifest: &Manifest,
    ) -> Result<()> {
        let listed = scene.manifest().map(|earlier| earlier.files);
        let listed = listed.unwrap_or_default();
        let staged_files = files_in(&self.folder.root)?;
        let new: BTreeSet<String> = staged_files.iter().cloned().chain(reserved).collect();
        let is_foreign = |file: &&String| !listed.contains(*file) && scene.root.join(file).exists();
        if let Some(foreign) = new.iter().find(is_foreign) {
            bail!(
                "{}: this file does not belong to the scene and is in the way; move it, or choose a new folder",
                scene.root.join(foreign).display()
            );
        }
        let is_replaced = |file: &String| {
            replaced
                .iter()
                .any(|name| Path::new(file).starts_with(name))
        };
        let (old, kept): (BTreeSet<String>, BTreeSet<String>) =
            listed.into_iter().partition(is_replaced);
        // A file that the stage writes again is replaced as well.
        let (old, kept) = (&old | &(&kept & &new), &kept - &new);
        let files = &kept | &new;
        self.folder.save_manifest(&Manifest {
            files,
            ..manifest.clone()
        })?;
        let before = self.folder.root.join(REPLACED_FOLDER);
        let manifest = [MANIFEST.to_owned()];
        let (staged, final_root) = (&self.folder.root, &scene.root);
        let out = manifest.iter().chain(&old);
        let moves_out = out.map(|name| (final_root.join(name), before.join(name)));
        let new = staged_files.iter().chain(&manifest);
        let moves_in = new.map(|name| (staged.join(name), final_root.join(name)));
        let mut moved = Vec::new();
        let done = moves_out.chain(moves_in).try_for_each(|(from, to)| {
            if rename_if_exists(&from, &to)? {
                moved.push((from, to));
                stop_point::reach("publish", moved.len() as u64);
            }
            Ok(())
        });
        if done.is_err() {
            self.keep_folder = moved
                .iter()
                .rev()
                .any(|(from, to)| std::fs::rename(to, from).is_err());
        } else {
            for file in &old {
                remove_empty_folders(&scene.root, file);
            }
        }
        done
    }

    /// Restores a scene after a killed run: undoes unfinished moves, and removes the folders of
    /// staged output.
    pub fn recover(scene: &SceneFolder) -> Result<()> {
        let entries = scene
            .root
            .read_dir()
            .map_err(Error::io(&scene.root))?
            .flatten()
            .map(|entry| entry.path());
        let staged: Vec<SceneFolder> = entries
            .filter(|path| {
                path.extension().is_some_and(|ending| ending == "partial") && path.is_dir()
            })
            .map(SceneFolder::new)
            .collect();
        if !scene.root.join(MANIFEST).exists() {
            let with_earlier = staged
                .iter()
                .find(|staged| staged.root.join(REPLACED_FOLDER).join(MANIFEST).is_file());
            // The first run of a scene replaces no earlier manifest.
            if let Some(staged) = with_earlier.or_else(|| {
                staged
                    .iter()
                    .find(|staged| staged.root.join(MANIFEST).is_file())
            }) {
                restore_earlier_scene(scene, staged)?;
            }
        }
        for staged in staged {
            let _ = std::fs::remove_dir_all(&staged.root);
        }
        Ok(())
    }
}

/// Moves the files of a killed run out of the scene, and the replaced files back into it.
fn restore_earlier_scene(scene: &SceneFolder, staged: &SceneFolder) -> Result<()> {
    let before = staged.root.join(REPLACED_FOLDER);
    let old = if before.is_dir() {
        files_in(&before)?
    } else {
        BTreeSet::new()
    };
    let kept = SceneFolder::new(&before)
        .manifest()
        .map(|manifest| manifest.files)
        .unwrap_or_default();
    // Files that were moved into the scene: in the new manifest, no longer staged, and not kept
    // from the earlier scene.
    let moved_in = staged
        .manifest()?
        .files
        .into_iter()
        .filter(|file| !kept.contains(file) || old.contains(file));
    for name in moved_in.filter(|file| !staged.root.join(file).exists()) {
        rename_if_exists(&scene.root.join(&name), &staged.root.join(&name))?;
    }
    for name in old.iter().chain([&MANIFEST.to_owned()]) {
        rename_if_exists(&before.join(name), &scene.root.join(name))?;
    }
    Ok(())
}

impl Drop for StagedOutput {
    fn drop(&mut self) {
        if !self.keep_folder {
            let _ = std::fs::remove_dir_all(&self.folder.root);
        }
    }
}

/// Returns the paths of all files below a folder except its manifest, relative to it and separated
/// by '/'.
fn files_in(root: &Path) -> Result<BTreeSet<String>> {
    let mut found = BTreeSet::new();
    let mut folders = vec![root.to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in folder.read_dir().map_err(Error::io(&folder))? {
            let path = entry.map_err(Error::io(&folder))?.path();
            if path.is_dir() {
                folders.push(path);
                continue;
            }
            let relative = path.strip_prefix(root).unwrap_or(&path);
            let parts: Vec<_> = relative.iter().map(|part| part.to_string_lossy()).collect();
            found.insert(parts.join("/"));
        }
    }
    found.remove(MANIFEST);
    Ok(found)
}

/// Removes the parent folders of a moved file that are empty now.
fn remove_empty_folders(root: &Path, file: &str) {
    let folders = Path::new(file)
        .ancestors()
        .skip(1)
        .filter(|folder| !folder.as_os_str().is_empty());
    // `remove_dir` fails for a folder that is not empty.
    folders
        .take_while(|folder| std::fs::remove_dir(root.join(folder)).is_ok())
        .for_each(drop);
}

/// Renames a file if it exists, and returns whether it did.
fn rename_if_exists(from: &Path, to: &Path) -> Result<bool> {
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
        let fields = json!({ "version": "0", "photos": "p", "holdout": 8, "segmenter": segmenter, "encoder": "offline", "seed": 0, "warnings": [] });
        serde_json::from_value(fields).unwrap()
    }

    fn write(folder: &SceneFolder, name: &str, text: &str) {
        let path = folder.root.join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, text).unwrap();
    }

    fn read(folder: &SceneFolder, name: &str) -> Option<String> {
        std::fs::read_to_string(folder.root.join(name)).ok()
    }

    const REPLACED: [&str; 3] = ["photos", "alpha", "cameras"];

    /// Creates a scene whose files contain "old".
    fn create_earlier_scene(root: &Path) -> SceneFolder {
        let scene = SceneFolder::new(root);
        let staged = StagedOutput::new(&scene, "first").unwrap();
        for name in [
            "photos/a.png",
            "photos/same.png",
            "alpha/a.png",
            "cameras/trained.json",
            "scene.ply",
        ] {
            write(&staged.folder, name, "old");
        }
        staged
            .publish(
                &scene,
                &[],
                ["masks/objects/a.png".to_owned()],
                &manifest("offline"),
            )
            .unwrap();
        scene
    }

    /// Stages new output without publishing it.
    fn stage_new_output(scene: &SceneFolder) -> StagedOutput {
        let staged = StagedOutput::new(scene, "preprocess").unwrap();
        for name in ["photos/b.png", "photos/same.png", "cameras/cameras.json"] {
            write(&staged.folder, name, "new");
        }
        staged
    }

    #[test]
    fn publishing_replaces_the_earlier_scene() {
        let dir = tempfile::tempdir().unwrap();
        let scene = create_earlier_scene(dir.path());
        drop(stage_new_output(&scene));
        assert_eq!(
            (
                read(&scene, "photos/same.png").as_deref(),
                read(&scene, "photos/b.png")
            ),
            (Some("old"), None)
        );
        stage_new_output(&scene)
            .publish(&scene, &REPLACED, [], &manifest("sam"))
            .unwrap();
        for gone in [
            "photos/a.png",
            "alpha",
            "cameras/trained.json",
            "preprocess.partial",
        ] {
            assert!(!scene.root.join(gone).exists(), "{gone}");
        }
        let now = ["photos/b.png", "photos/same.png", "scene.ply"]
            .map(|name| read(&scene, name).unwrap());
        assert_eq!(now, ["new", "new", "old"]);
        let known = scene.manifest().unwrap();
        assert_eq!(known.segmenter, "sam");
        let files: Vec<&str> = known.files.iter().map(String::as_str).collect();
        assert_eq!(
            files,
            [
                "cameras/cameras.json",
                "masks/objects/a.png",
                "photos/b.png",
                "photos/same.png",
                "scene.ply"
            ]
        );
    }

    #[test]
    fn files_of_the_users_are_neither_moved_nor_replaced() {
        let dir = tempfile::tempdir().unwrap();
        let scene = create_earlier_scene(dir.path());
        write(&scene, "photos/IMG_1.CR3", "mine");
        stage_new_output(&scene)
            .publish(&scene, &REPLACED, [], &manifest("sam"))
            .unwrap();
        assert_eq!(read(&scene, "photos/IMG_1.CR3").as_deref(), Some("mine"));
        // A user's file with the name of a staged file.
        write(&scene, "ignore/b.png", "mine");
        let staged = stage_new_output(&scene);
        write(&staged.folder, "ignore/b.png", "new");
        let refused = staged
            .publish(&scene, &["photos", "ignore"], [], &manifest("import"))
            .unwrap_err()
            .to_string();
        assert!(
            refused.contains("ignore/b.png") && refused.contains("move it"),
            "{refused}"
        );
        assert_eq!(
            (
                read(&scene, "ignore/b.png").as_deref(),
                read(&scene, "photos/b.png").as_deref()
            ),
            (Some("mine"), Some("new"))
        );
        assert_eq!(scene.manifest().unwrap().segmenter, "sam");
    }

    #[test]
    fn a_move_that_fails_is_undone() {
        let dir = tempfile::tempdir().unwrap();
        let scene = create_earlier_scene(dir.path());
        // A file cannot replace a folder.
        let staged = stage_new_output(&scene);
        write(&staged.folder, "scene.ply", "new");
        std::fs::create_dir_all(staged.folder.root.join(REPLACED_FOLDER).join("scene.ply"))
            .unwrap();
        staged
            .publish(&scene, &["photos", "scene.ply"], [], &manifest("import"))
            .unwrap_err();
        assert_eq!(
            (
                read(&scene, "photos/same.png").as_deref(),
                read(&scene, "scene.ply").as_deref()
            ),
            (Some("old"), Some("old"))
        );
        assert_eq!(scene.manifest().unwrap().segmenter, "offline");
    }

    #[test]
    fn a_killed_move_is_undone_by_the_next_run() {
        for moved_in in 0..3 {
            let dir = tempfile::tempdir().unwrap();
            let scene = create_earlier_scene(dir.path());
            let staged = stage_new_output(&scene);
            let before = staged.folder.root.join(REPLACED_FOLDER);
            // The run is killed after it moved all replaced files away and some new ones in.
            let files = files_in(&staged.folder.root).unwrap();
            let listed = &files | &scene.manifest().unwrap().files;
            staged
                .folder
                .save_manifest(&Manifest {
                    files: listed,
                    ..manifest("sam")
                })
                .unwrap();
            for name in [
                "scene.json",
                "photos/a.png",
                "photos/same.png",
                "cameras/trained.json",
            ] {
                rename_if_exists(&scene.root.join(name), &before.join(name)).unwrap();
            }
            for name in files.iter().rev().take(moved_in) {
                rename_if_exists(&staged.folder.root.join(name), &scene.root.join(name)).unwrap();
            }
            std::mem::forget(staged);
            StagedOutput::recover(&scene).unwrap();
            for name in [
                "photos/a.png",
                "photos/same.png",
                "alpha/a.png",
                "cameras/trained.json",
                "scene.ply",
            ] {
                assert_eq!(
                    read(&scene, name).as_deref(),
                    Some("old"),
                    "{name} with {moved_in}"
                );
            }
            assert_eq!(
                (
                    read(&scene, "photos/b.png"),
                    scene.manifest().unwrap().segmenter
                ),
                (None, "offline".to_owned())
            );
            assert!(!scene.root.join("preprocess.partial").exists());
        }
    }

    #[test]
    fn a_first_run_that_was_killed_leaves_nothing_in_the_way() {
        let dir = tempfile::tempdir().unwrap();
        let scene = SceneFolder::new(dir.path());
        let staged = stage_new_output(&scene);
        let files = files_in(&staged.folder.root).unwrap();
        staged
            .folder
            .save_manifest(&Manifest {
                files: files.clone(),
                ..manifest("sam")
            })
            .unwrap();
        for name in files.iter().take(2) {
            rename_if_exists(&staged.folder.root.join(name), &scene.root.join(name)).unwrap();
        }
        std::mem::forget(staged);
        StagedOutput::recover(&scene).unwrap();
        stage_new_output(&scene)
            .publish(&scene, &REPLACED, [], &manifest("sam"))
            .unwrap();
        assert_eq!(read(&scene, "photos/b.png").as_deref(), Some("new"));
    }
}
