//! Extracts photos from a video into the folder `video` of the scene.

use crate::error::{Context, bail};
use crate::{Result, Run};
use fastlgs_core::{SceneFolder, fs};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::time::UNIX_EPOCH;

/// File beside the photos that names their video.
const NOTE: &str = "video.json";

/// Contents of this file.
#[derive(PartialEq, Serialize, Deserialize)]
struct Note {
    /// Path of the video.
    video: PathBuf,
    /// Fingerprint of the video.
    file: Value,
    /// Version of FastLGS that chose the frames.
    version: String,
    /// File names of the photos.
    images: Vec<String>,
}

/// Returns the fingerprint of a file: its size in bytes, and its modification time in Unix seconds.
pub(crate) fn fingerprint(video: &Path) -> Result<Value> {
    let about = video
        .metadata()
        .with_context(|| format!("{}: the file cannot be opened", video.display()))?;
    let changed = about
        .modified()
        .ok()
        .and_then(|time| time.duration_since(UNIX_EPOCH).ok())
        .map(|time| time.as_secs());
    Ok(json!([about.len(), changed]))
}

/// Extracts photos from a video and returns their folder. Reuses earlier photos of the same video
/// and version.
///
/// # Errors
/// The video cannot be decoded, other files are in the way, or the run is cancelled.
pub(super) fn photos(video: &Path, folder: &SceneFolder, run: &Run) -> Result<PathBuf> {
    let photos = folder.root.join("video");
    let (path, file, version) = (
        std::path::absolute(video)?,
        fingerprint(video)?,
        env!("CARGO_PKG_VERSION").to_owned(),
    );
    let earlier = fs::read_json::<Note>(&photos.join(NOTE)).ok();
    let is_same =
        |known: &Note| (&known.video, &known.file, &known.version) == (&path, &file, &version);
    if earlier.as_ref().is_some_and(is_same) {
        return Ok(photos);
    }
    if earlier.is_none() && photos.exists() {
        bail!(
            "{}: FastLGS did not create this folder, but needs it for the frames of the video; move it, or choose a new scene folder",
            photos.display()
        );
    }
    // Photos of another video stay until the new ones are complete.
    let partial = folder.root.join("video.partial");
    let _ = std::fs::remove_dir_all(&partial);
    std::fs::create_dir_all(&partial).map_err(fastlgs_core::Error::io(&partial))?;
    let work = run.work("frames", 0);
    let on_frame = |seconds: f64, chosen: usize| {
        work.set_activity(&format!("{seconds:.0} s, {chosen} photos"));
        work.check()
    };
    let made = fastlgs_sfm::video::photos(video, &partial.join("images"), on_frame);
    let made = made.and_then(|_| {
        let names = partial
            .join("images")
            .read_dir()?
            .map(|entry| Ok(entry?.file_name().to_string_lossy().into_owned()));
        let mut images = names.collect::<std::io::Result<Vec<String>>>()?;
        images.sort();
        Ok(fs::write_json(
            &partial.join(NOTE),
            &Note {
                video: path,
                file,
                version,
                images,
            },
        )?)
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

/// Removes the frames of an earlier video.
///
/// # Errors
/// Other files lie among the frames. They belong to the user and stay.
fn remove_frames(photos: &Path, earlier: &Note) -> Result<()> {
    let images = photos.join("images");
    let names = |folder: &Path| -> Vec<String> {
        let entries = folder.read_dir().into_iter().flatten().flatten();
        entries
            .map(|entry| entry.file_name().to_string_lossy().into_owned())
            .collect()
    };
    let others = names(&images)
        .iter()
        .any(|name| !earlier.images.contains(name));
    if others
        || names(photos)
            .iter()
            .any(|name| name != NOTE && name != "images")
    {
        bail!(
            "{}: files that FastLGS did not create lie among the frames of an earlier video; move them elsewhere",
            photos.display()
        );
    }
    for name in earlier.images.iter().filter(|name| {
        Path::new(name)
            .file_name()
            .is_some_and(|own| own == name.as_str())
    }) {
        let _ = std::fs::remove_file(images.join(name));
    }
    let _ = std::fs::remove_dir(&images);
    let _ = std::fs::remove_file(photos.join(NOTE));
    Ok(std::fs::remove_dir(photos)?)
}
