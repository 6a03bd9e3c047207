//! Checkpoints of an interrupted training in the scene folder.

use fastlgs_core::SceneFolder;
use std::path::PathBuf;

/// Returns the path of the checkpoint without extension. With `.json` it is the header, which names
/// the other files.
pub(crate) fn path(folder: &SceneFolder) -> PathBuf {
    folder.root.join("checkpoints/train")
}

/// Returns whether there is a checkpoint to resume from.
pub(crate) fn can_resume(folder: &SceneFolder) -> bool {
    path(folder).with_extension("json").is_file()
}

/// Removes all checkpoints.
pub(crate) fn remove_all(folder: &SceneFolder) {
    fastlgs_raster::checkpoint::remove(&path(folder));
    // Mask targets of the views (see `train/mask_supervision.rs`).
    let _ = std::fs::remove_dir_all(folder.root.join("checkpoints/borders"));
    // This fails if other files are in the folder, which then stays.
    let _ = std::fs::remove_dir(folder.root.join("checkpoints"));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn other_files_in_the_folder_stay() {
        let dir = tempfile::tempdir().unwrap();
        let folder = SceneFolder::new(dir.path());
        let checkpoints = dir.path().join("checkpoints");
        std::fs::create_dir_all(checkpoints.join("borders")).unwrap();
        std::fs::write(path(&folder).with_extension("json"), "{}").unwrap();
        std::fs::write(checkpoints.join("notes.txt"), "mine").unwrap();
        assert!(can_resume(&folder));
        remove_all(&folder);
        assert!(!can_resume(&folder) && !checkpoints.join("borders").exists());
        assert!(checkpoints.join("notes.txt").is_file());
        std::fs::remove_file(checkpoints.join("notes.txt")).unwrap();
        remove_all(&folder);
        assert!(!checkpoints.exists());
    }
}
