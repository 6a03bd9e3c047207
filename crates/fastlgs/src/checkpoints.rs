//! Steps of a training that was broken off, in the scene's folder.

use fastlgs_core::SceneFolder;
use std::path::PathBuf;

/// Where they are kept: a header of this name with the ending json, and what it names.
pub(crate) fn path(folder: &SceneFolder) -> PathBuf {
    folder.root.join("checkpoints/train")
}

/// Whether a run was broken off that can go on.
pub(crate) fn is_begun(folder: &SceneFolder) -> bool {
    path(folder).with_extension("json").is_file()
}

/// Forgets a run that was broken off.
pub(crate) fn forget(folder: &SceneFolder) {
    fastlgs_raster::checkpoint::remove(&path(folder));
    // What views were trained towards.
    let _ = std::fs::remove_dir_all(folder.root.join("checkpoints/borders"));
    // It stays where anything else lies in it.
    let _ = std::fs::remove_dir(folder.root.join("checkpoints"));
}
