//! A video in place of photos: its frames become photos, in the scene folder.

use crate::error::Context;
use crate::{Result, Run};
use fastlgs_core::{SceneFolder, fs};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::time::UNIX_EPOCH;

/// What the photos were made of.
const NOTE: &str = "video.json";

/// What tells whether a video is still the same: its size, and when it was changed.
pub(crate) fn fingerprint(video: &Path) -> Result<Value> {
    let about = video.metadata().with_context(|| format!("{}: the video cannot be opened", video.display()))?;
    let changed = about.modified().ok().and_then(|time| time.duration_since(UNIX_EPOCH).ok()).map(|time| time.as_secs());
    Ok(json!([about.len(), changed]))
}

/// The folder of photos that a video becomes, which its poses will lie in as well. What was made of the same video is kept.
pub(super) fn photos(video: &Path, folder: &SceneFolder, run: &Run) -> Result<PathBuf> {
    let photos = folder.root.join("video");
    let now = json!({ "video": std::path::absolute(video)?, "file": fingerprint(video)?, "version": env!("CARGO_PKG_VERSION") });
    if fs::read_json::<Value>(&photos.join(NOTE)).is_ok_and(|known| known == now) {
        return Ok(photos);
    }
    // Those of another video stay until these are whole.
    let partial = folder.root.join("video.partial");
    let _ = std::fs::remove_dir_all(&partial);
    std::fs::create_dir_all(&partial).map_err(fastlgs_core::Error::io(&partial))?;
    let work = run.work("frames", 0);
    let looked = |seconds: f64, chosen: usize| {
        work.note(&format!("{seconds:.0} s, {chosen} photos"));
        work.check()
    };
    let made = fastlgs_vision::video::photos(video, &partial.join("images"), looked);
    let made = made.and_then(|_| Ok(fs::write_json(&partial.join(NOTE), &now)?));
    if let Err(error) = made {
        let _ = std::fs::remove_dir_all(&partial);
        return Err(error);
    }
    let _ = std::fs::remove_dir_all(&photos);
    std::fs::rename(&partial, &photos).map_err(fastlgs_core::Error::io(&photos))?;
    Ok(photos)
}
