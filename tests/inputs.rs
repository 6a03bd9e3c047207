//! Inputs of real users: output folders within the album, masks of other programs, other
//! conventions and origins of poses, truncated photos, and scenes saved by other editors. No file
//! of the user is lost, and no error is silent.
//!
//! Needs the offline models and a Vulkan device. Without them the tests are skipped with a message,
//! or fail if FASTLGS_REQUIRE_GPU is set.

#[path = "support/run.rs"]
mod run;

use fastlgs_core::{SceneFolder, ply};
use glam::{DMat4, DVec3, DVec4};
use image::{GrayImage, Luma, Rgba, RgbaImage};
use run::{assert_fails, json, text};
use serde_json::{Value, json as value};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

/// Returns an album of 24 generated photos with exact poses. `None` without models or device. Tests
/// change copies of it.
fn album() -> Option<&'static Path> {
    static ALBUM: OnceLock<Option<tempfile::TempDir>> = OnceLock::new();
    let make = || {
        let dir = run::requirements_met().then(|| tempfile::tempdir().expect("a folder"))?;
        json(&[
            "synth",
            "table",
            "-o",
            text(&dir.path().join("album")),
            "--views",
            "24",
            "--size",
            "160x120",
        ]);
        Some(dir)
    };
    ALBUM
        .get_or_init(make)
        .as_ref()
        .map(tempfile::TempDir::path)
}

/// Copies the album with its exact masks into a new folder. Returns that folder and the copy's
/// path.
fn copy() -> Option<(tempfile::TempDir, PathBuf)> {
    let from = album()?.join("album");
    let dir = tempfile::tempdir().expect("a folder");
    let to = dir.path().join("album");
    for (path, data) in contents(&from)
        .into_iter()
        .filter(|(path, _)| !path.starts_with(from.join("depth")))
    {
        let place = to.join(path.strip_prefix(&from).expect("below it"));
        std::fs::create_dir_all(place.parent().expect("a folder")).expect("a folder");
        std::fs::write(place, data).expect("a file");
    }
    Some((dir, to))
}

/// Returns all files below a folder with their contents.
fn contents(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut found = BTreeMap::new();
    let mut folders = vec![folder.to_owned()];
    while let Some(folder) = folders.pop() {
        for path in std::fs::read_dir(&folder)
            .expect("a folder")
            .flatten()
            .map(|entry| entry.path())
        {
            if path.is_dir() {
                folders.push(path);
            } else {
                found.insert(path.clone(), std::fs::read(&path).expect("a file"));
            }
        }
    }
    found
}

#[test]
fn photo_folders_are_never_written() {
    let Some((dir, photos)) = copy() else { return };
    std::fs::write(photos.join("masks/mine.txt"), "mine").expect("a file");
    let raw = dir.path().join("raw");
    std::fs::create_dir_all(raw.join("photos")).expect("a folder");
    std::fs::write(raw.join("photos/IMG_1.CR3"), "raw").expect("a file");
    let before = contents(dir.path());
    let (inside, above) = (photos.join("scene"), dir.path().to_owned());
    for output in [&photos, &inside, &above, &raw] {
        for command in ["preprocess", "make"] {
            let why = if output == &raw {
                "not a scene"
            } else {
                "nothing was written"
            };
            assert_fails(&[command, text(&photos), "-o", text(output)], &[why]);
        }
    }
    assert_fails(
        &["synth", "table", "-o", text(&raw), "--views", "8"],
        &["not empty"],
    );
    assert_eq!(contents(dir.path()), before);
}

#[test]
fn a_second_run_on_a_locked_scene_is_refused() {
    let Some((dir, photos)) = copy() else { return };
    let scene = dir.path().join("scene");
    let args = [
        "preprocess",
        text(&photos),
        "-o",
        text(&scene),
        "--segmenter",
        "import",
        "--quiet",
    ];
    let (one, two) = std::thread::scope(|scope| {
        let other = scope.spawn(|| run::fastlgs(&args));
        (run::fastlgs(&args), other.join().expect("the other run"))
    });
    let refused: Vec<_> = [&one, &two]
        .into_iter()
        .filter(|output| !output.status.success())
        .collect();
    assert_eq!(refused.len(), 1, "{one:?} {two:?}");
    let printed = String::from_utf8_lossy(&refused[0].stderr);
    assert!(printed.contains("is writing this scene"), "{printed}");
    SceneFolder::open(&scene)
        .and_then(|folder| folder.manifest())
        .expect("the scene of the first run");
    // Other files of the user in the scene folder stay. A second run replaces only its own files.
    std::fs::write(scene.join("photos/IMG_1.CR3"), "raw").expect("a file");
    json(&[
        "preprocess",
        text(&photos),
        "-o",
        text(&scene),
        "--segmenter",
        "import",
        "--max-side",
        "96",
    ]);
    assert_eq!(
        std::fs::read(scene.join("photos/IMG_1.CR3")).expect("the user's file"),
        b"raw"
    );
}

/// Preprocesses a copy of the album with `mask` drawn as ignore mask of every photo. Returns the
/// fraction of pixels to train on, or the error message.
fn trained_share(mask: impl Fn(u32, u32, &Path)) -> Option<Result<f64, String>> {
    let (dir, photos) = copy()?;
    let scene = dir.path().join("scene");
    std::fs::create_dir_all(photos.join("ignore")).expect("a folder");
    for entry in std::fs::read_dir(photos.join("images"))
        .expect("photos")
        .flatten()
    {
        mask(160, 120, &photos.join("ignore").join(entry.file_name()));
    }
    let args = [
        "preprocess",
        text(&photos),
        "-o",
        text(&scene),
        "--segmenter",
        "import",
        "--holdout",
        "0",
        "--quiet",
    ];
    let output = run::fastlgs(&args);
    if !output.status.success() {
        return Some(Err(run::error_line(&args, &output)));
    }
    let mask = image::open(scene.join("ignore/003.png.png"))
        .expect("a mask")
        .into_luma8();
    Some(Ok(
        mask.pixels().filter(|p| p[0] >= 128).count() as f64 / mask.pixels().len() as f64
    ))
}

#[test]
fn ignore_masks_of_all_encodings_have_the_same_effect() {
    let outside = |x: u32, y: u32| !(40..80).contains(&x) || !(30..90).contains(&y);
    let expected = 1.0 - 40.0 * 60.0 / (160.0 * 120.0);
    let one = |x: u32, y: u32| u8::from(outside(x, y));
    let save = |picture: image::DynamicImage, path: &Path| picture.save(path).expect("a mask");
    type Draw<'a> = &'a dyn Fn(u32, u32, &Path);
    let ways: [(&str, Draw<'_>); 3] = [
        ("0 and 1", &|w, h, path| {
            save(
                GrayImage::from_fn(w, h, |x, y| Luma([one(x, y)])).into(),
                path,
            )
        }),
        ("alpha", &|w, h, path| {
            save(
                RgbaImage::from_fn(w, h, |x, y| Rgba([0, 0, 0, 255 * one(x, y)])).into(),
                path,
            )
        }),
        ("0 and 255", &|w, h, path| {
            save(
                GrayImage::from_fn(w, h, |x, y| Luma([255 * one(x, y)])).into(),
                path,
            )
        }),
    ];
    for (name, draw) in ways {
        let Some(share) = trained_share(draw) else {
            return;
        };
        assert!(
            (share.clone().expect("a scene") - expected).abs() < 0.01,
            "{name}: {share:?}"
        );
    }
    // Masks that ignore all pixels are an error.
    let black = trained_share(|w, h, path| save(GrayImage::new(w, h).into(), path)).expect("ready");
    assert!(
        black
            .as_ref()
            .is_err_and(|said| said.contains("leave nothing")),
        "{black:?}"
    );
}

/// Preprocesses and briefly trains a copy of the album with changed poses. Returns the messages,
/// and the PSNR of held-out views in dB.
fn train_with_poses(
    change: impl Fn(usize, DMat4) -> DMat4,
) -> Option<(String, f64, tempfile::TempDir)> {
    let (dir, photos) = copy()?;
    let scene = dir.path().join("scene");
    let path = photos.join("transforms.json");
    let mut poses: Value =
        serde_json::from_slice(&std::fs::read(&path).expect("poses")).expect("JSON");
    for (k, frame) in poses["frames"]
        .as_array_mut()
        .expect("frames")
        .iter_mut()
        .enumerate()
    {
        let rows: [[f64; 4]; 4] =
            serde_json::from_value(frame["transform_matrix"].clone()).expect("a matrix");
        frame["transform_matrix"] = value!(
            change(k, DMat4::from_cols_array_2d(&rows).transpose())
                .transpose()
                .to_cols_array_2d()
        );
    }
    std::fs::write(&path, poses.to_string()).expect("poses");
    let output = run::fastlgs(&[
        "preprocess",
        text(&photos),
        "-o",
        text(&scene),
        "--segmenter",
        "import",
    ]);
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{said}");
    let report = json(&[
        "train",
        text(&scene),
        "--iterations",
        "200",
        "--device",
        "cpu",
    ]);
    Some((
        said,
        report["psnr_held_out"].as_f64().expect("held-out views"),
        dir,
    ))
}

/// Smallest PSNR of a brief training with correct poses, in dB. Correct poses reach 26 to 27 dB,
/// wrong poses 15 to 20.
const CORRECT_POSES_PSNR: f64 = 24.5;

#[test]
fn poses_far_from_the_origin_keep_their_precision() {
    let utm = DVec3::new(512_345.6, 5_403_210.9, 431.2);
    let moved = |_: usize, mut pose: DMat4| {
        pose.w_axis += utm.extend(0.0);
        pose
    };
    let Some((_, psnr, dir)) = train_with_poses(moved) else {
        return;
    };
    assert!(psnr > CORRECT_POSES_PSNR, "{psnr}");
    let (scene, at) = (dir.path().join("scene"), |name: &str| dir.path().join(name));
    // Exports are in world coordinates, and can be imported again.
    json(&["export", text(&scene), text(&at("world.ply"))]);
    json(&["export", text(&scene), text(&at("cameras.json"))]);
    let world = ply::read(&at("world.ply")).expect("an export");
    let local = ply::read(&scene.join("scene.ply")).expect("the scene");
    assert!(
        world
            .means
            .iter()
            .all(|mean| mean.as_dvec3().distance(utm) < 1e3)
            && local.means[0].length() < 1e3
    );
    let again = json(&[
        "train",
        text(&scene),
        "--init",
        text(&at("world.ply")),
        "--iterations",
        "0",
        "--device",
        "cpu",
    ]);
    assert!(
        (again["psnr_held_out"].as_f64().expect("a number") - psnr).abs() < 0.1,
        "{again}"
    );
    let path: Value =
        serde_json::from_slice(&std::fs::read(at("cameras.json")).expect("an export"))
            .expect("JSON");
    let easting = path["camera_path"][0]["camera_to_world"][3]
        .as_f64()
        .expect("a number");
    assert!((easting - utm.x).abs() < 10.0, "{easting}");
    // A camera in world coordinates renders the same picture as the view.
    json(&[
        "render",
        text(&scene),
        "--path",
        text(&at("cameras.json")),
        "-o",
        text(&at("there")),
    ]);
    json(&[
        "render",
        text(&scene),
        "--view",
        "000.png",
        "-o",
        text(&at("here")),
    ]);
    let [there, here] = ["there", "here"].map(|folder| {
        fastlgs_core::image_io::load_rgb(&at(folder).join("000.png.color.png")).expect("a picture")
    });
    let difference = there
        .as_raw()
        .iter()
        .zip(here.as_raw())
        .map(|(a, b)| f64::from(a.abs_diff(*b)))
        .sum::<f64>()
        / here.as_raw().len() as f64;
    assert!(difference < 1.0, "{difference}");
}

#[test]
fn training_tolerates_any_unit_and_one_wrong_pose() {
    for unit in [1e-5f64, 1e5] {
        let scaled = |_: usize, mut pose: DMat4| {
            pose.w_axis = (unit * pose.w_axis.truncate()).extend(1.0);
            pose
        };
        let Some((_, psnr, _)) = train_with_poses(scaled) else {
            return;
        };
        assert!(psnr > CORRECT_POSES_PSNR, "unit {unit}: {psnr}");
    }
    let wrong = |k: usize, mut pose: DMat4| {
        pose.w_axis += if k == 5 {
            DVec4::new(1e4, 1e4, 1e4, 0.0)
        } else {
            DVec4::ZERO
        };
        pose
    };
    let Some((said, psnr, _)) = train_with_poses(wrong) else {
        return;
    };
    assert!(
        said.contains("005.png") && psnr > CORRECT_POSES_PSNR,
        "{psnr}: {said}"
    );
}

#[test]
fn the_convention_of_poses_is_detected_from_the_photos() {
    let flip = DMat4::from_diagonal(DVec4::new(1.0, -1.0, -1.0, 1.0));
    type Write<'a> = &'a dyn Fn(usize, DMat4) -> DMat4;
    let conventions: [(&str, Write<'_>); 3] = [
        ("c2w-opencv", &|_, pose| pose * flip),
        ("w2c-opengl", &|_, pose| pose.inverse()),
        ("transposed", &|_, pose| pose.transpose()),
    ];
    for (name, write) in conventions {
        let Some((said, psnr, _)) = train_with_poses(write) else {
            return;
        };
        assert!(
            said.contains(name) && psnr > CORRECT_POSES_PSNR,
            "{name}, {psnr}: {said}"
        );
    }
}

#[test]
fn truncated_photos_are_refused() {
    let Some((dir, photos)) = copy() else { return };
    let path = photos.join("images/003.png");
    let mut jpeg = std::io::Cursor::new(Vec::new());
    image::open(&path)
        .expect("a photo")
        .into_rgb8()
        .write_to(&mut jpeg, image::ImageFormat::Jpeg)
        .expect("a JPEG");
    let whole = jpeg.into_inner();
    std::fs::write(&path, &whole[..whole.len() / 2]).expect("half of it");
    assert_fails(
        &[
            "preprocess",
            text(&photos),
            "-o",
            text(&dir.path().join("scene")),
        ],
        &["003.png", "cut off"],
    );
}

#[test]
fn a_scene_file_without_object_ids_is_reported() {
    let Some(room) = run::room() else { return };
    let dir = tempfile::tempdir().expect("a folder");
    let scene = dir.path().join("scene");
    for (path, data) in contents(&room.scene) {
        let to = scene.join(path.strip_prefix(&room.scene).expect("below it"));
        std::fs::create_dir_all(to.parent().expect("a folder")).expect("a folder");
        std::fs::write(to, data).expect("a file");
    }
    let path = scene.join("scene.ply");
    let data = std::fs::read(&path).expect("the scene");
    let at = data
        .windows(9)
        .position(|w| w == b"object_id")
        .expect("the column");
    std::fs::write(&path, [&data[..at], b"something", &data[at + 9..]].concat())
        .expect("the scene");
    let remedy = ["object_id", "iterations to 0"];
    assert_fails(&["query", text(&scene), "coffee"], &remedy);
    assert_fails(
        &[
            "remove",
            text(&scene),
            "--object",
            "1",
            "-o",
            text(&dir.path().join("rest")),
        ],
        &remedy,
    );
    // Texts with articles, typographic quotes and a byte order mark.
    let run_query = |words: &str| json(&["query", text(&room.scene), words, "--view", "008.png"]);
    let plain = run_query("coffee");
    for words in ["a coffee", "\u{201c}the coffee\u{201d}", "\u{feff}coffee"] {
        let answer = run_query(words);
        assert_eq!(
            (&answer["found"], &answer["score"], &answer["objects"]),
            (&plain["found"], &plain["score"], &plain["objects"]),
            "{words}"
        );
    }
}
