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
