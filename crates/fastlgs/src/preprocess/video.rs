//! A video in place of photos: its frames become photos, in the scene folder.

use crate::error::{Context, bail};
use crate::{Result, Run};
use fastlgs_core::{SceneFolder, fs};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::time::UNIX_EPOCH;

/// Says which video the photos were made of, and their names.
const NOTE: &str = "video.json";

/// The note beside the photos of a video.
#[derive(PartialEq, Serialize, Deserialize)]
struct Note {
    /// The video.
    video: PathBuf,
    /// Its fingerprint.
    file: Value,
    /// The version of the program that chose the frames.
    version: String,
    /// File names of the photos.
    images: Vec<String>,
}

/// What tells whether a video is still the same: its size, and when it was changed.
pub(crate) fn fingerprint(video: &Path) -> Result<Value> {
    let about = video.metadata().with_context(|| format!("{}: the video cannot be opened", video.display()))?;
    let changed = about.modified().ok().and_then(|time| time.duration_since(UNIX_EPOCH).ok()).map(|time| time.as_secs());
    Ok(json!([about.len(), changed]))
}

/// The folder of photos that a video becomes. What was made of the same video is kept.
pub(super) fn photos(video: &Path, folder: &SceneFolder, run: &Run) -> Result<PathBuf> {
    let photos = folder.root.join("video");
    let (path, file, version) = (std::path::absolute(video)?, fingerprint(video)?, env!("CARGO_PKG_VERSION").to_owned());
    let earlier = fs::read_json::<Note>(&photos.join(NOTE)).ok();
    let is_same = |known: &Note| (&known.video, &known.file, &known.version) == (&path, &file, &version);
    if earlier.as_ref().is_some_and(is_same) {
        return Ok(photos);
    }
    if earlier.is_none() && photos.exists() {
        bail!("{}: this folder is not of FastLGS and is in the way of the video's frames; move it, or name a new scene", photos.display());
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
    let made = made.and_then(|_| {
        let names = partial.join("images").read_dir()?.map(|entry| Ok(entry?.file_name().to_string_lossy().into_owned()));
        let mut images = names.collect::<std::io::Result<Vec<String>>>()?;
        images.sort();
        Ok(fs::write_json(&partial.join(NOTE), &Note { video: path, file, version, images })?)
    });
    if let Err(error) = made {
        let _ = std::fs::remove_dir_all(&partial);
        return Err(error);
    }
    if let Some(earlier) = earlier {
        remove_frames(&photos, &earlier)?;
    }
    std::fs::rename(&partial, &photos).map_err(fastlgs_core::Error::io(&photos))?;
    Ok(photos)
}

/// Removes the frames of an earlier video. Other files that lie among them are the user's: they stay, and the folder is then in the way.
fn remove_frames(photos: &Path, earlier: &Note) -> Result<()> {
    let images = photos.join("images");
    let names = |folder: &Path| -> Vec<String> {
        let entries = folder.read_dir().into_iter().flatten().flatten();
        entries.map(|entry| entry.file_name().to_string_lossy().into_owned()).collect()
    };
    let others = names(&images).iter().any(|name| !earlier.images.contains(name));
    if others || names(photos).iter().any(|name| name != NOTE && name != "images") {
        bail!("{}: files that are not of FastLGS lie among the frames of an earlier video; move them elsewhere", photos.display());
    }
    for name in earlier.images.iter().filter(|name| Path::new(name).file_name().is_some_and(|own| own == name.as_str())) {
        let _ = std::fs::remove_file(images.join(name));
    }
    let _ = std::fs::remove_dir(&images);
    let _ = std::fs::remove_file(photos.join(NOTE));
    Ok(std::fs::remove_dir(photos)?)
}
