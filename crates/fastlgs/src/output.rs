//! Checks output folders, and locks a scene so that only one run writes it.

use crate::Result;
use crate::error::{Context, bail};
use crate::staged::StagedOutput;
use fastlgs_core::dataset::images_folder;
use fastlgs_core::scene_folder::{MANIFEST, Manifest};
use fastlgs_core::{Error, SceneFolder, fs};
use std::fs::{File, TryLockError};
use std::io::{Read, Seek, Write};
use std::path::{Component, Path, PathBuf};

/// Lock file in a scene folder. It also marks a folder that a killed first run created.
const LOCK: &str = "scene.lock";
/// First word of a lock file.
const LOCK_HEADER: &str = "FastLGS";

/// Lock of a scene folder: as long as it exists, no other run writes the scene. The operating
/// system releases it when the process ends.
pub(crate) struct SceneLock {
    folder: PathBuf,
    /// Whether this run created the folder.
    created: bool,
    _file: File,
}

impl SceneLock {
    /// Checks that `stage` may write the folder `scene`, creates it if necessary, and locks it.
    /// Restores a scene that a killed run was replacing.
    ///
    /// # Errors
    /// The folder holds other files than a scene, another run writes it, or it cannot be created.
    pub fn take(scene: &Path, stage: &str) -> Result<Self> {
        let folder = resolve_path(scene)?;
        check_writable(&folder)
            .with_context(|| format!("{} cannot be written", scene.display()))?;
        let created = !folder.exists();
        std::fs::create_dir_all(&folder).map_err(Error::io(scene))?;
        let path = folder.join(LOCK);
        let open = File::options()
            .create(true)
            .truncate(false)
            .read(true)
            .write(true)
            .open(&path);
        let mut file = open.map_err(Error::io(&path))?;
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                let mut holder = String::new();
                let _ = file.read_to_string(&mut holder);
                let holder = holder
                    .trim()
                    .strip_prefix(LOCK_HEADER)
                    .map_or("another run", |line| line.trim_start_matches([':', ' ']));
                bail!(
                    "{}: {holder} is writing this scene; wait until it ends, or stop it",
                    scene.display()
                );
            }
            Err(TryLockError::Error(error)) => return Err(Error::io(&path)(error).into()),
        }
        let line = format!(
            "{LOCK_HEADER}: 'fastlgs {stage}' (process {})\n",
            std::process::id()
        );
        let note = file
            .set_len(0)
            .and_then(|()| file.rewind())
            .and_then(|()| file.write_all(line.as_bytes()));
        note.map_err(Error::io(&path))?;
        StagedOutput::recover(&SceneFolder::new(&folder))?;
        Ok(Self {
            folder,
            created,
            _file: file,
        })
    }
}

impl SceneLock {
    /// Locks an existing scene.
    ///
    /// # Errors
    /// A folder that is not a scene, and those of [`SceneLock::take`].
    pub fn of_scene(scene: &Path, stage: &str) -> Result<Self> {
        // If a run was killed while it replaced the scene, the lock file remains, and `take`
        // restores the scene.
        if !scene.join(LOCK).is_file() {
            SceneFolder::open(scene)?;
        }
        Self::take(scene, stage)
    }
}

impl Drop for SceneLock {
    fn drop(&mut self) {
        // A run that failed before it wrote anything leaves nothing behind.
        let only_lock = self
            .folder
            .read_dir()
            .is_ok_and(|entries| entries.flatten().all(|entry| entry.file_name() == LOCK));
        if only_lock {
            let _ = std::fs::remove_file(self.folder.join(LOCK));
            if self.created {
                let _ = std::fs::remove_dir(&self.folder);
            }
        }
    }
}

/// Checks that a folder may be written: it does not exist, is empty, is a scene, or was left by a
/// killed first run.
fn check_writable(folder: &Path) -> Result<()> {
    let entries = match folder.read_dir() {
        Ok(entries) => entries,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(()),
        Err(error) => return Err(Error::io(folder)(error).into()),
    };
    let mut names: Vec<String> = entries
        .flatten()
        .map(|entry| entry.file_name().to_string_lossy().into_owned())
        .collect();
    names.sort();
    let manifest = folder.join(MANIFEST);
    if manifest.is_file() {
        return match fs::read_json::<Manifest>(&manifest) {
            Err(error) => bail!(
                "its {MANIFEST} was not written by FastLGS ({error}); choose a folder that does not exist yet"
            ),
            Ok(manifest) if manifest.files.is_empty() => {
                bail!(
                    "its {MANIFEST} does not list the files of the scene; choose a folder that does not exist yet"
                )
            }
            Ok(_) => Ok(()),
        };
    }
    let is_unfinished_scene = std::fs::read_to_string(folder.join(LOCK))
        .is_ok_and(|text| text.is_empty() || text.starts_with(LOCK_HEADER));
    match names.first() {
        Some(name) if !is_unfinished_scene => {
            bail!(
                "it is not empty ('{name}') and has no {MANIFEST}, so it is not a scene; choose a folder that does not exist yet or is empty"
            )
        }
        _ => Ok(()),
    }
}

/// Checks that photos (a folder or a video) and the output scene do not contain each other. Links
/// are resolved.
///
/// # Errors
/// A message with both paths.
pub(crate) fn check_apart(photos: &Path, scene: &Path) -> Result<()> {
    let folder = resolve_path(scene)?;
    let album = resolve_path(photos)?;
    // Linked photos must not lie in the scene, which is replaced while they are read.
    let folders = std::iter::once(photos.to_owned()).chain(images_folder(photos));
    let links = folders.flat_map(|folder| folder.read_dir().into_iter().flatten().flatten());
    let links = links
        .filter(|entry| entry.file_type().is_ok_and(|kind| kind.is_symlink()))
        .filter_map(|entry| entry.path().canonicalize().ok());
    let photo_in_scene = std::iter::once(album.clone())
        .chain(links)
        .find(|place| place.starts_with(&folder));
    let Some(place) = photo_in_scene.or_else(|| folder.starts_with(&album).then(|| album.clone()))
    else {
        return Ok(());
    };
    let relation = match (place == folder, place.starts_with(&folder)) {
        (true, _) => "it is the folder of the photos",
        (_, true) => "it contains the photos",
        _ => "it lies in the folder of the photos",
    };
    let (scene, photos, other) = (scene.display(), photos.display(), suggested_scene(&album));
    bail!(
        "{scene} cannot be the output folder for the photos {photos}: {relation}; nothing was written; choose a folder beside the photos, such as {}",
        other.display()
    )
}

/// Returns a path for a scene beside a folder of photos.
fn suggested_scene(photos: &Path) -> PathBuf {
    let name = photos
        .file_stem()
        .unwrap_or_default()
        .to_string_lossy()
        .into_owned();
    photos.with_file_name(format!("{name}-scene"))
}

/// Returns an absolute path without links and dots. Its last folders need not exist.
///
/// # Errors
/// An empty path, or one that cannot be made absolute.
pub(crate) fn resolve_path(path: &Path) -> Result<PathBuf> {
    if path.as_os_str().is_empty() {
        bail!("the path of the folder is empty; name a folder");
    }
    let mut resolved = PathBuf::new();
    for part in std::path::absolute(path)
        .map_err(Error::io(path))?
        .components()
    {
        match part {
            Component::ParentDir => drop(resolved.pop()),
            Component::CurDir => {}
            part => resolved.push(part),
        }
        // A link is resolved before the parts that follow it.
        resolved = resolved.canonicalize().unwrap_or(resolved);
    }
    Ok(resolved)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the message of an error with its causes.
    fn refusal<T>(result: Result<T>) -> String {
        crate::one_sentence(&result.err().expect("a refusal"))
    }

    #[test]
    fn folders_with_other_files_are_refused() {
        let dir = tempfile::tempdir().unwrap();
        let new = dir.path().join("a/b/scene");
        drop(SceneLock::take(&new, "preprocess").unwrap());
        assert!(!new.exists(), "a run that wrote nothing leaves nothing");
        let album = dir.path().join("album");
        std::fs::create_dir(&album).unwrap();
        drop(SceneLock::take(&album, "preprocess").unwrap());
        assert_eq!(
            std::fs::read_dir(&album).unwrap().count(),
            0,
            "an existing folder remains unchanged"
        );
        std::fs::write(album.join("IMG_1.CR3"), "raw").unwrap();
        let refused = refusal(SceneLock::take(&album, "preprocess"));
        assert!(
            refused.contains("IMG_1.CR3") && refused.contains("not a scene"),
            "{refused}"
        );
        // A scene.json of another program.
        std::fs::write(album.join(MANIFEST), r#"{"nodes": []}"#).unwrap();
        assert!(refusal(SceneLock::take(&album, "preprocess")).contains("not written by FastLGS"));
        assert_eq!(
            std::fs::read_dir(&album).unwrap().count(),
            2,
            "nothing was written"
        );
        // A folder that a killed run left.
        let killed = dir.path().join("killed");
        let lock = SceneLock::take(&killed, "make").unwrap();
        std::fs::create_dir(killed.join("cache")).unwrap();
        let second = refusal(SceneLock::take(&killed, "preprocess"));
        assert!(
            second.contains("'fastlgs make'")
                && second.contains(&format!("process {}", std::process::id())),
            "{second}"
        );
        drop(lock);
        SceneLock::take(&killed, "preprocess").unwrap();
    }

    #[test]
    #[cfg(unix)]
    fn overlapping_photo_and_scene_folders_are_refused() {
        let dir = tempfile::tempdir().unwrap();
        let at = |name: &str| dir.path().join(name);
        std::fs::create_dir_all(at("album/images")).unwrap();
        std::fs::create_dir_all(at("scene/photos")).unwrap();
        std::os::unix::fs::symlink(at("album"), at("link")).unwrap();
        for scene in [
            "album",
            "album/scene",
            "link",
            "link/images/../new",
            ".",
            "album/../link",
            "new/../album/x",
        ] {
            let refused = refusal(check_apart(&at("album"), &at(scene)));
            assert!(
                refused.contains("nothing was written"),
                "{scene}: {refused}"
            );
        }
        for scene in ["scene", "album-scene", "album/../scene"] {
            check_apart(&at("album"), &at(scene)).unwrap();
        }
        // Photos that are links into the scene.
        std::fs::create_dir(at("linked")).unwrap();
        std::os::unix::fs::symlink(at("scene/photos"), at("linked/images")).unwrap();
        refusal(check_apart(&at("linked"), &at("scene")));
        std::fs::write(at("scene/clip.mp4"), "").unwrap();
        refusal(check_apart(&at("scene/clip.mp4"), &at("scene")));
    }
}
