//! Poses for photos that come without: structure from motion by COLMAP (Schoenberger & Frahm 2016), as a program on the
//! path or as pycolmap in Python.

use crate::{Error, Result};
use fastlgs_core::dataset::{colmap, is_photo};
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// One camera took all photos; its lens has one radial term, which the photos then lose.
const CAMERA_MODEL: &str = "SIMPLE_RADIAL";
/// Up to so many photos each is matched with each, above with those that follow it.
const EXHAUSTIVE: usize = 200;

const RECONSTRUCT: &str = include_str!("../assets/reconstruct.py");

/// What there is to run.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Tool {
    /// The program `colmap`.
    Colmap(PathBuf),
    /// A Python that has pycolmap.
    Pycolmap(PathBuf),
}

impl Tool {
    /// `colmap` on the path, else a `python3` that can import pycolmap.
    ///
    /// # Errors
    /// When there is neither; the message says how to get one.
    pub fn find() -> Result<Self> {
        let folders: Vec<PathBuf> = std::env::var_os("PATH").map(|p| std::env::split_paths(&p).collect()).unwrap_or_default();
        let on_path = |name: &str| folders.iter().map(|f| f.join(name)).find(|p| p.is_file());
        if let Some(colmap) = on_path("colmap") {
            return Ok(Self::Colmap(colmap));
        }
        let imports = |python: &PathBuf| Command::new(python).args(["-c", "import pycolmap"]).output().is_ok_and(|o| o.status.success());
        on_path("python3").filter(imports).map(Self::Pycolmap).ok_or_else(|| {
            let mend = "install COLMAP ('apt-get install colmap', or 'pip install pycolmap'), or add poses";
            Error::Missing(format!("the photos have no poses, and neither 'colmap' nor pycolmap is there to find them: {mend}"))
        })
    }
}

/// Finds the poses of the photos in `PHOTOS/images` and leaves them in `PHOTOS/sparse/0`. `say` is told each stage, and what
/// the tool prints.
///
/// # Errors
/// When the tool fails or no photo could be placed; what it said last is in the message.
pub fn reconstruct(tool: &Tool, photos: &Path, mut say: impl FnMut(&str, &str)) -> Result<()> {
    let images = photos.join("images");
    let entries = images.read_dir().map_err(fastlgs_core::Error::io(&images))?;
    let count = entries.flatten().filter(|e| is_photo(&e.path())).count();
    if count < 3 {
        return Err(Error::Invalid(format!("{}: {count} photos; poses need at least 3", images.display())));
    }
    let work = photos.join("sparse.partial");
    let _ = std::fs::remove_dir_all(&work);
    let models = work.join("sparse");
    std::fs::create_dir_all(&models).map_err(fastlgs_core::Error::io(&models))?;
    let database = work.join("database.db");
    match tool {
        Tool::Colmap(program) => {
            let matcher = if count <= EXHAUSTIVE { "exhaustive_matcher" } else { "sequential_matcher" };
            let stages: [(&str, &str, &[&str]); 3] = [
                (
                    "features",
                    "feature_extractor",
                    &["--ImageReader.single_camera", "1", "--ImageReader.camera_model", CAMERA_MODEL, "--SiftExtraction.use_gpu", "0"],
                ),
                ("matches", matcher, &["--SiftMatching.use_gpu", "0"]),
                ("mapping", "mapper", &[]),
            ];
            for (stage, name, options) in stages {
                let mut command = Command::new(program);
                command.arg(name).arg("--database_path").arg(&database);
                if name != matcher {
                    command.arg("--image_path").arg(&images);
                }
                if name == "mapper" {
                    command.arg("--output_path").arg(&models);
                }
                run(command.args(options), stage, &mut say)?;
            }
        }
        Tool::Pycolmap(python) => {
            let script = work.join("reconstruct.py");
            std::fs::write(&script, RECONSTRUCT).map_err(fastlgs_core::Error::io(&script))?;
            run(Command::new(python).arg(&script).arg(&images).arg(&work).arg(CAMERA_MODEL), "structure from motion", &mut say)?;
        }
    }
    let best = largest_model(&models).ok_or_else(|| {
        let images = images.display();
        Error::Invalid(format!("{images}: COLMAP could place no photo; are they sharp and do neighbours overlap?"))
    })?;
    let target = photos.join("sparse/0");
    std::fs::create_dir_all(photos.join("sparse")).map_err(fastlgs_core::Error::io(&target))?;
    std::fs::rename(best, &target).map_err(fastlgs_core::Error::io(&target))?;
    let _ = std::fs::remove_dir_all(&work);
    Ok(())
}

/// COLMAP may leave several models: the one whose list of photos is longest counts.
fn largest_model(models: &Path) -> Option<PathBuf> {
    let folders = models.read_dir().ok()?.flatten().map(|e| e.path()).filter(|p| colmap::is_model(p));
    folders.max_by_key(|p| (std::fs::metadata(p.join("images.bin")).map_or(0, |m| m.len()), std::cmp::Reverse(p.clone())))
}

/// Runs one stage and passes on what it prints.
fn run(command: &mut Command, stage: &str, say: &mut impl FnMut(&str, &str)) -> Result<()> {
    let name = command.get_program().to_string_lossy().into_owned();
    let failed = |reason: String| Error::Missing(format!("{name} failed while finding poses ({stage}): {reason}"));
    say(stage, "");
    // Both streams are read, so that neither fills up and stops the tool.
    let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().map_err(|e| failed(e.to_string()))?;
    let errors = child.stderr.take().map(|stream| std::thread::spawn(move || BufReader::new(stream).lines().map_while(|l| l.ok()).last()));
    let lines = child.stdout.take().into_iter().flat_map(|stream| BufReader::new(stream).lines().map_while(|l| l.ok()));
    let mut last = String::new();
    for line in lines.filter(|l| !l.trim().is_empty()) {
        say(stage, line.trim());
        last = line;
    }
    let status = child.wait().map_err(|e| failed(e.to_string()))?;
    let complaint = errors.and_then(|thread| thread.join().ok().flatten());
    if status.success() { Ok(()) } else { Err(failed(complaint.unwrap_or(last))) }
}

#[cfg(all(test, unix))]
mod tests {
    use super::*;
    use std::os::unix::fs::PermissionsExt;

    /// A stand-in for COLMAP: notes how it was called, and its mapper leaves two models.
    fn stand_in(dir: &Path, script: &str) -> Tool {
        let path = dir.join("colmap");
        std::fs::write(&path, format!("#!/bin/sh\necho \"$@\" >> {}/calls\n{script}", dir.display())).unwrap();
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o755)).unwrap();
        Tool::Colmap(path)
    }

    fn photos(dir: &Path, count: usize) -> PathBuf {
        let photos = dir.join("photos");
        std::fs::create_dir_all(photos.join("images")).unwrap();
        (0..count).for_each(|k| std::fs::write(photos.join(format!("images/{k}.jpg")), b"").unwrap());
        photos
    }

    const MAPPER: &str = "if [ \"$1\" = mapper ]; then
        for k in 0 1; do
            mkdir -p \"$7/$k\"; printf x > \"$7/$k/cameras.bin\"; printf x > \"$7/$k/points3D.bin\"; head -c $((10 + k)) /dev/zero > \"$7/$k/images.bin\"
        done
    fi";

    #[test]
    fn the_largest_model_becomes_sparse_0() {
        let dir = tempfile::tempdir().unwrap();
        let photos = photos(dir.path(), 4);
        let mut stages = Vec::new();
        reconstruct(&stand_in(dir.path(), MAPPER), &photos, |stage, _| stages.push(stage.to_owned())).unwrap();
        assert_eq!(stages, ["features", "matches", "mapping"]);
        assert_eq!(std::fs::metadata(photos.join("sparse/0/images.bin")).unwrap().len(), 11);
        assert!(!photos.join("sparse.partial").exists());
        let calls = std::fs::read_to_string(dir.path().join("calls")).unwrap();
        assert!(calls.contains("exhaustive_matcher") && calls.contains("single_camera 1"), "{calls}");
    }

    #[test]
    fn failures_are_told_in_the_tools_words() {
        let dir = tempfile::tempdir().unwrap();
        let broken = stand_in(dir.path(), "echo 'cannot open display' >&2; exit 1");
        let error = reconstruct(&broken, &photos(dir.path(), 4), |_, _| {}).unwrap_err().to_string();
        assert!(error.contains("cannot open display") && error.contains("features"), "{error}");
        let nothing = stand_in(dir.path(), "exit 0");
        assert!(reconstruct(&nothing, &photos(dir.path(), 4), |_, _| {}).unwrap_err().to_string().contains("place no photo"));
        let few = tempfile::tempdir().unwrap();
        assert!(reconstruct(&nothing, &photos(few.path(), 2), |_, _| {}).unwrap_err().to_string().contains("at least 3"));
    }
}
