//! Structure from motion with COLMAP (Schoenberger & Frahm 2016), for photos without poses.
//!
//! pycolmap, which `models install-offline` installs, computes poses from key points that are found
//! and matched here. It runs both the global mapper (GLOMAP, Pan et al. 2024) and the incremental
//! one. An installed `colmap` program runs all stages itself.

use crate::keypoints::{self, Keypoints};
use crate::matching::matches;
use crate::neighbours;
use crate::process_output::lines;
use crate::tracks::PairMatches;
use crate::{Error, Result};
use fastlgs_core::dataset::{self, colmap, is_photo};
use fastlgs_core::image_io::OrientationRule;
use fastlgs_core::{Camera, fs, image_io};
use glam::Mat4;
use rayon::prelude::*;
use serde_json::json;
use std::collections::BTreeSet;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::mpsc::{self, RecvTimeoutError};
use std::time::Duration;

/// COLMAP's camera model, with one radial distortion term. All photos of one size share a camera.
const CAMERA_MODEL: &str = "SIMPLE_RADIAL";
/// Largest number of photos for which all pairs are matched.
const EXHAUSTIVE: usize = 120;
/// With more photos, each is matched with this many that are most similar.
const SIMILAR: usize = 20;
/// In addition, all pairs of this many evenly spread photos are matched. In a video, the most
/// similar photos are those just before and after, which do not close loops.
const LOOP_PHOTOS: usize = 40;
/// Largest longer side, in pixels, of the images for key point detection.
const STRUCTURE_SIDE: u32 = 1000;
/// Smallest number of matches of a pair that is passed to COLMAP.
const MIN_PAIR_MATCHES: usize = 15;

const RECONSTRUCT: &str = include_str!("../assets/reconstruct.py");

/// Program that computes poses.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Tool {
    /// Path of a Python interpreter with pycolmap.
    Pycolmap(PathBuf),
    /// Path of the program `colmap`.
    Colmap(PathBuf),
}

impl Tool {
    /// Finds a Python interpreter that can import pycolmap: `installed`, else the `python3` on the
    /// path. Else returns [`Self::find_colmap`].
    ///
    /// # Errors
    /// No tool is installed; the message says how to install one.
    pub fn find(installed: PathBuf) -> Result<Self> {
        let imports = |python: &PathBuf| {
            Command::new(python)
                .args(["-c", "import pycolmap"])
                .output()
                .is_ok_and(|o| o.status.success())
        };
        let pythons = std::iter::once(installed).chain(on_path("python3"));
        let pycolmap = pythons.filter(|p| p.is_file()).find(imports);
        pycolmap.map_or_else(Self::find_colmap, |python| Ok(Self::Pycolmap(python)))
    }

    /// Finds the program `colmap` on the path.
    ///
    /// # Errors
    /// As [`Self::find`].
    pub fn find_colmap() -> Result<Self> {
        let program = on_path("colmap").map(Self::Colmap);
        program.ok_or(Error::NoPoseProgram)
    }
}

/// Returns the file of this name in the first folder of the path that has one.
fn on_path(name: &str) -> Option<PathBuf> {
    let path = std::env::var_os("PATH")?;
    let mut files = std::env::split_paths(&path).map(|folder| folder.join(name));
    files.find(|file| file.is_file())
}

/// Returns the photos in a folder, sorted by name.
///
/// # Errors
/// Fewer than three photos; the message names files that were not read.
pub fn photos_in(images: &Path) -> Result<Vec<PathBuf>> {
    let entries = images.read_dir().map_err(fastlgs_core::Error::io(images))?;
    let mut files: Vec<PathBuf> = entries
        .flatten()
        .map(|e| e.path())
        .filter(|p| is_photo(p))
        .collect();
    files.sort();
    if files.len() < 3 {
        let folders = dataset::folders_within(images);
        let below = (!folders.is_empty()).then(|| {
            format!(
                "photos in subfolders are not read ({}): move them into this folder",
                folders.join(", ")
            )
        });
        let notes: String = dataset::unreadable_images_warning(images)
            .into_iter()
            .chain(below)
            .map(|reason| format!("; {reason}"))
            .collect();
        return Err(Error::TooFewPhotos {
            folder: images.to_owned(),
            found: files.len(),
            notes,
        });
    }
    Ok(files)
}

/// Computes the poses of the photos of one folder. Returns the folder of the largest COLMAP model.
///
/// The result lies in the folder `work`, which is emptied first. `progress` receives the stage and
/// the latest output of the tool, at least once a second. It returns whether to continue.
///
/// # Errors
/// The tool fails, no photo could be placed, or `progress` cancelled the work. The message contains
/// the last output of the tool.
pub fn reconstruct(
    tool: &Tool,
    files: &[PathBuf],
    work: &Path,
    seed: u64,
    progress: impl Fn(&str, &str) -> bool + Sync,
) -> Result<PathBuf> {
    let images = files
        .first()
        .and_then(|file| file.parent())
        .unwrap_or(Path::new("."));
    let _ = std::fs::remove_dir_all(work);
    let models = work.join("sparse");
    std::fs::create_dir_all(&models).map_err(fastlgs_core::Error::io(&models))?;
    match tool {
        Tool::Colmap(program) => by_program(program, images, work, &models, files, &progress)?,
        Tool::Pycolmap(python) => {
            prepare_input(files, work, seed, &progress)?;
            by_script(python, work, &progress)?;
        }
    }
    largest_model(&models).ok_or_else(|| Error::NoPoses(images.to_owned()))
}

/// Runs pycolmap on the input files in the work folder.
fn by_script(python: &Path, work: &Path, progress: &impl Fn(&str, &str) -> bool) -> Result<()> {
    let script = work.join("reconstruct.py");
    std::fs::write(&script, RECONSTRUCT).map_err(fastlgs_core::Error::io(&script))?;
    run(
        Command::new(python).arg(&script).arg(work),
        "structure from motion",
        progress,
    )
}

/// Runs all stages with the `colmap` program.
fn by_program(
    program: &Path,
    images: &Path,
    work: &Path,
    models: &Path,
    files: &[PathBuf],
    progress: &impl Fn(&str, &str) -> bool,
) -> Result<()> {
    let matcher = if files.len() <= EXHAUSTIVE {
        "exhaustive_matcher"
    } else {
        "sequential_matcher"
    };
    // With a single camera, COLMAP skips photos whose size differs from that of the first.
    let sizes: BTreeSet<_> = files
        .iter()
        .filter_map(|file| image_io::dimensions(file).ok())
        .collect();
    let single = if sizes.len() <= 1 { "1" } else { "0" };
    let (is_single, model) = ("--ImageReader.single_camera", "--ImageReader.camera_model");
    let one_camera = [is_single, single, model, CAMERA_MODEL];
    let stages: [(&str, &str, &[&str]); 3] = [
        ("features", "feature_extractor", &one_camera),
        ("matches", matcher, &[]),
        ("mapping", "mapper", &[]),
    ];
    let list = work.join("photos.txt");
    let names: String = files
        .iter()
        .filter_map(|file| file.file_name())
        .map(|name| format!("{}\n", name.to_string_lossy()))
        .collect();
    std::fs::write(&list, names).map_err(fastlgs_core::Error::io(&list))?;
    for (stage, name, options) in stages {
        let mut command = Command::new(program);
        command
            .arg(name)
            .arg("--database_path")
            .arg(work.join("database.db"));
        if name != matcher {
            command.arg("--image_path").arg(images);
        }
        if name == "feature_extractor" {
            // Without this list, COLMAP would read masks and other images in subfolders as photos.
            command.arg("--image_list_path").arg(&list);
        }
        if name == "mapper" {
            command.arg("--output_path").arg(models);
        }
        // Without a display, COLMAP must not use a GPU. The option's name depends on its version.
        if let Some(option) = known_option(program, name, &USE_GPU) {
            command.args([option, "0"]);
        }
        run(command.args(options), stage, progress)?;
    }
    Ok(())
}

/// Options of COLMAP 3 and 4 that enable the GPU.
const USE_GPU: [&str; 4] = [
    "--SiftExtraction.use_gpu",
    "--FeatureExtraction.use_gpu",
    "--SiftMatching.use_gpu",
    "--FeatureMatching.use_gpu",
];

/// Returns the first of these options that the program's help for a stage contains.
fn known_option(program: &Path, stage: &str, options: &[&'static str]) -> Option<&'static str> {
    let help = Command::new(program)
        .args([stage, "--help"])
        .output()
        .ok()?;
    let text = [help.stdout, help.stderr].concat();
    let text = String::from_utf8_lossy(&text);
    options.iter().copied().find(|option| text.contains(option))
}

/// Finds and matches key points, and writes the input files of `reconstruct.py` into the work
/// folder.
fn prepare_input(
    files: &[PathBuf],
    work: &Path,
    seed: u64,
    progress: &(impl Fn(&str, &str) -> bool + Sync),
) -> Result<()> {
    let found = |path: &PathBuf| -> Result<(u32, u32, Keypoints)> {
        check_cancelled(progress(
            "features",
            &path.file_name().unwrap_or_default().to_string_lossy(),
        ))?;
        let photo = image_io::load_photo(path, OrientationRule::Upright)?.pixels;
        let scale =
            (f64::from(STRUCTURE_SIDE) / f64::from(photo.width().max(photo.height()))).min(1.0);
        let size = |n: u32| ((f64::from(n) * scale).round() as u32).max(1);
        let small = image_io::resize(&photo, size(photo.width()), size(photo.height()));
        let points = keypoints::detect(&image::imageops::grayscale(&small))?;
        Ok((small.width(), small.height(), points))
    };
    let photos = files.par_iter().map(found).collect::<Result<Vec<_>>>()?;
    let points: Vec<&Keypoints> = photos.iter().map(|p| &p.2).collect();
    let pairs = matched(&points, progress)?;
    let name = |path: &PathBuf| {
        path.file_name()
            .unwrap_or_default()
            .to_string_lossy()
            .into_owned()
    };
    let image = |(path, (width, height, points)): (&PathBuf, &(u32, u32, Keypoints))| {
        let path_text = std::path::absolute(path).unwrap_or_else(|_| path.clone());
        json!({ "name": name(path), "path": path_text, "width": width, "height": height, "keypoints": points.positions.len() })
    };
    let images = files.iter().zip(&photos).map(image).collect();
    write_plan(work, images, &points, &pairs, seed)
}

/// Writes photos, key points and matches into the work folder, in the format that `reconstruct.py`
/// reads.
fn write_plan(
    work: &Path,
    images: Vec<serde_json::Value>,
    points: &[&Keypoints],
    pairs: &[PairMatches],
    seed: u64,
) -> Result<()> {
    let plan = json!({
        "images": images,
        "pairs": pairs.iter().map(|m| json!({ "a": m.a, "b": m.b, "matches": m.pairs.len() })).collect::<Vec<_>>(),
        "seed": seed % (1 << 31),
        "camera_model": CAMERA_MODEL,
    });
    fs::write_json(&work.join("features.json"), &plan)?;
    let points = points
        .iter()
        .flat_map(|p| &p.positions)
        .flat_map(|p| [p.x.to_bits(), p.y.to_bits()]);
    let matched = pairs
        .iter()
        .flat_map(|m| &m.pairs)
        .flat_map(|(i, j)| [*i as u32, *j as u32]);
    let bytes: Vec<u8> = points.chain(matched).flat_map(u32::to_le_bytes).collect();
    Ok(fs::write_atomic(&work.join("features.bin"), |file| {
        file.write_all(&bytes)
    })?)
}

/// Computes new poses of photos with known intrinsics, from their key points. Returns a
/// world-to-camera matrix per photo, or `None` for photos that could not be placed.
/// Origin and scale of the poses are arbitrary. `photos` are the image files. The folder `work` is
/// emptied first, and the tool stores its files there.
///
/// # Errors
/// The tool fails, or `progress` cancelled the work.
pub fn reconstruct_with_lenses(
    python: &Path,
    photos: &[PathBuf],
    cameras: &[Camera],
    points: &[Keypoints],
    work: &Path,
    seed: u64,
    progress: impl Fn(&str, &str) -> bool + Sync,
) -> Result<Vec<Option<Mat4>>> {
    let _ = std::fs::remove_dir_all(work);
    std::fs::create_dir_all(work).map_err(fastlgs_core::Error::io(work))?;
    let points: Vec<&Keypoints> = points.iter().collect();
    let pairs = matched(&points, &progress)?;
    let image = |((path, camera), points): ((&PathBuf, &Camera), &Keypoints)| {
        let path = std::path::absolute(path).unwrap_or_else(|_| path.clone());
        json!({
            "name": camera.name, "path": path, "width": camera.width, "height": camera.height, "keypoints": points.positions.len(),
            "lens": [camera.fx, camera.fy, camera.cx, camera.cy],
        })
    };
    let images = photos
        .iter()
        .zip(cameras)
        .zip(points.iter().copied())
        .map(image)
        .collect();
    write_plan(work, images, &points, &pairs, seed)?;
    by_script(python, work, &progress)?;
    // Rows of [R t] per photo, from the model with the most photos.
    let rows: Vec<Option<[[f32; 4]; 3]>> = fs::read_json(&work.join("poses.json"))?;
    let pose = |[x, y, z]: [[f32; 4]; 3]| {
        Mat4::from_cols_array_2d(&[x, y, z, [0.0, 0.0, 0.0, 1.0]]).transpose()
    };
    let found: Vec<Option<Mat4>> = rows.into_iter().map(|rows| rows.map(pose)).collect();
    if found.len() == cameras.len() {
        Ok(found)
    } else {
        Err(Error::PoseProgram {
            program: "pycolmap".to_owned(),
            stage: "structure from motion".to_owned(),
            reason: "it returned poses for another number of photos".to_owned(),
        })
    }
}

/// Matches the key points of photo pairs. Pairs with fewer than `MIN_PAIR_MATCHES` matches are left out.
fn matched(
    points: &[&Keypoints],
    progress: &(impl Fn(&str, &str) -> bool + Sync),
) -> Result<Vec<PairMatches>> {
    let of_pair = |(a, b): (usize, usize)| {
        check_cancelled(progress("matches", ""))?;
        Ok(PairMatches {
            a,
            b,
            pairs: matches(points[a], points[b]),
        })
    };
    let all = pairs(points)
        .into_par_iter()
        .map(of_pair)
        .collect::<Result<Vec<_>>>()?;
    Ok(all
        .into_iter()
        .filter(|m| m.pairs.len() >= MIN_PAIR_MATCHES)
        .collect())
}

/// Returns the pairs of photos to match.
fn pairs(points: &[&Keypoints]) -> Vec<(usize, usize)> {
    let count = points.len();
    if count <= EXHAUSTIVE {
        return (0..count)
            .flat_map(|a| (a + 1..count).map(move |b| (a, b)))
            .collect();
    }
    let mut pairs = BTreeSet::new();
    for (a, others) in neighbours::of_each(points, SIMILAR).into_iter().enumerate() {
        pairs.extend(others.into_iter().map(|b| (a.min(b), a.max(b))));
    }
    let spread: Vec<usize> = (0..LOOP_PHOTOS).map(|k| k * count / LOOP_PHOTOS).collect();
    pairs.extend(
        spread
            .iter()
            .flat_map(|&a| spread.iter().filter(move |b| a < **b).map(move |&b| (a, b))),
    );
    pairs.into_iter().collect()
}

/// Returns the model with the largest `images.bin`. COLMAP may write several models.
fn largest_model(models: &Path) -> Option<PathBuf> {
    let folders = models
        .read_dir()
        .ok()?
        .flatten()
        .map(|e| e.path())
        .filter(|p| colmap::is_model(p));
    folders.max_by_key(|p| {
        (
            std::fs::metadata(p.join("images.bin")).map_or(0, |m| m.len()),
            std::cmp::Reverse(p.clone()),
        )
    })
}

/// Returns an error if the callback cancelled the search for poses.
fn check_cancelled(continues: bool) -> Result<()> {
    if continues {
        Ok(())
    } else {
        Err(Error::Cancelled)
    }
}

/// Longest time between two calls of `progress` while a tool prints nothing.
const PROGRESS_INTERVAL: Duration = Duration::from_secs(1);

/// Runs one stage and passes its output to `progress`.
fn run(command: &mut Command, stage: &str, progress: &impl Fn(&str, &str) -> bool) -> Result<()> {
    let program = command.get_program().to_string_lossy().into_owned();
    let failed = |reason| Error::PoseProgram {
        program: program.clone(),
        stage: stage.to_owned(),
        reason,
    };
    check_cancelled(progress(stage, ""))?;
    // Both streams are read, so that a full pipe does not block the tool.
    let mut child = command
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .map_err(|e| failed(e.to_string()))?;
    let errors = child
        .stderr
        .take()
        .map(|stream| std::thread::spawn(move || lines(stream).last()));
    let (speaker, printed) = mpsc::channel();
    if let Some(stream) = child.stdout.take() {
        std::thread::spawn(move || lines(stream).try_for_each(|line| speaker.send(line)));
    }
    let mut last = String::new();
    loop {
        match printed.recv_timeout(PROGRESS_INTERVAL) {
            Ok(line) if line.trim().is_empty() => continue,
            Ok(line) => {
                tracing::debug!(stage, line, "COLMAP");
                last = line;
            }
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => break,
        }
        if !progress(stage, last.trim()) {
            let _ = child.kill();
            let _ = child.wait();
            return check_cancelled(false);
        }
    }
    let status = child.wait().map_err(|e| failed(e.to_string()))?;
    let last_error_line = errors.and_then(|thread| thread.join().ok().flatten());
    if status.success() {
        Ok(())
    } else {
        Err(failed(last_error_line.unwrap_or(last)))
    }
}

#[cfg(all(test, unix))]
mod tests {
    use super::*;
    use fastlgs_core::rng::Rng;
    use glam::Vec2;
    use std::os::unix::fs::PermissionsExt;
    use std::sync::Mutex;

    /// Creates a fake `colmap` that logs its arguments and then runs `script`.
    fn stand_in(dir: &Path, script: &str) -> Tool {
        let path = dir.join("colmap");
        std::fs::write(
            &path,
            format!(
                "#!/bin/sh\necho \"$@\" >> {}/calls\n{script}",
                dir.display()
            ),
        )
        .unwrap();
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o755)).unwrap();
        Tool::Colmap(path)
    }

    fn photos(dir: &Path, count: usize) -> Vec<PathBuf> {
        let images = dir.join("images");
        std::fs::create_dir_all(&images).unwrap();
        (0..count).for_each(|k| std::fs::write(images.join(format!("{k}.jpg")), b"").unwrap());
        photos_in(&images).unwrap()
    }

    const MAPPER: &str = "if [ \"$2\" = --help ]; then echo '  --SiftExtraction.use_gpu arg (=1)'; exit 0; fi
    if [ \"$1\" = mapper ]; then
        for k in 0 1; do
            mkdir -p \"$7/$k\"; printf x > \"$7/$k/cameras.bin\"; printf x > \"$7/$k/points3D.bin\"; head -c $((10 + k)) /dev/zero > \"$7/$k/images.bin\"
        done
    fi";

    #[test]
    fn the_largest_model_is_found() {
        let dir = tempfile::tempdir().unwrap();
        let photos = photos(dir.path(), 4);
        let stages = Mutex::new(Vec::new());
        let work = dir.path().join("work");
        let model = reconstruct(
            &stand_in(dir.path(), MAPPER),
            &photos,
            &work,
            0,
            |stage, _| {
                stages.lock().unwrap().push(stage.to_owned());
                true
            },
        )
        .unwrap();
        stages.lock().unwrap().dedup();
        assert_eq!(*stages.lock().unwrap(), ["features", "matches", "mapping"]);
        assert_eq!(
            std::fs::metadata(model.join("images.bin")).unwrap().len(),
            11
        );
        let calls = std::fs::read_to_string(dir.path().join("calls")).unwrap();
        assert!(
            calls.contains("exhaustive_matcher") && calls.contains("single_camera 1"),
            "{calls}"
        );
        assert!(calls.contains("--SiftExtraction.use_gpu 0"), "{calls}");
    }

    #[test]
    fn errors_contain_the_last_output_of_the_tool() {
        let dir = tempfile::tempdir().unwrap();
        let broken = stand_in(dir.path(), "echo 'cannot open display' >&2; exit 1");
        let error = reconstruct(
            &broken,
            &photos(dir.path(), 4),
            &dir.path().join("work"),
            0,
            |_, _| true,
        )
        .unwrap_err()
        .to_string();
        assert!(
            error.contains("cannot open display") && error.contains("features"),
            "{error}"
        );
        let nothing = stand_in(dir.path(), "exit 0");
        assert!(
            reconstruct(
                &nothing,
                &photos(dir.path(), 4),
                &dir.path().join("work"),
                0,
                |_, _| true
            )
            .unwrap_err()
            .to_string()
            .contains("place no photo")
        );
        let few = tempfile::tempdir().unwrap();
        (0..2).for_each(|k| std::fs::write(few.path().join(format!("{k}.jpg")), b"").unwrap());
        assert!(
            photos_in(few.path())
                .unwrap_err()
                .to_string()
                .contains("at least 3")
        );
    }

    #[test]
    fn a_silent_tool_can_be_cancelled() {
        let dir = tempfile::tempdir().unwrap();
        let asleep = stand_in(dir.path(), "[ \"$2\" = --help ] || exec sleep 600");
        let began = std::time::Instant::now();
        let error = reconstruct(
            &asleep,
            &photos(dir.path(), 4),
            &dir.path().join("work"),
            0,
            |_, _| began.elapsed() < PROGRESS_INTERVAL,
        )
        .unwrap_err();
        assert!(error.to_string().contains("cancelled"), "{error}");
        assert!(began.elapsed() < 10 * PROGRESS_INTERVAL);
    }

    #[test]
    fn many_photos_are_matched_with_similar_ones_and_across_loops() {
        let mut rng = Rng::new(3, "views");
        let descriptors: Vec<[u8; 128]> = (0..3300)
            .map(|_| std::array::from_fn(|_| rng.below(256) as u8))
            .collect();
        // Photos along a wall, in shuffled order: neighbours share nine tenths of their points.
        let place = |photo: usize| photo * 77 % 300;
        let photos: Vec<Keypoints> = (0..300)
            .map(|photo| Keypoints {
                positions: vec![Vec2::ZERO; 100],
                descriptors: descriptors[10 * place(photo)..][..100].to_vec(),
            })
            .collect();
        let photos: Vec<&Keypoints> = photos.iter().collect();
        assert_eq!(
            pairs(&photos[..4]),
            [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]
        );
        let many = pairs(&photos);
        let near = |reach: usize| {
            let within = |(a, b): &&(usize, usize)| place(*a).abs_diff(place(*b)) <= reach;
            many.iter().filter(within).count()
        };
        assert!(near(3) > 3 * 300 * 98 / 100, "{} pairs", near(3));
        assert!(
            many.contains(&(0, 292)),
            "evenly spread photos must be matched"
        );
        assert!(many.len() < 300 * SIMILAR + LOOP_PHOTOS * LOOP_PHOTOS / 2);
    }
}
