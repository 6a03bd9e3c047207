//! Real photo collections: without poses, with masks, with lens distortion, as a video; and the
//! cache when photos change.
//!
//! Needs the offline models and a Vulkan device. Without them the tests are skipped with a message,
//! or fail if FASTLGS_REQUIRE_GPU is set.

#[path = "support/run.rs"]
mod run;

use fastlgs_core::LabelMap;
use fastlgs_core::dataset::SfmPoint;
use fastlgs_core::image_io::{load_rgb, save_png};
use fastlgs_core::metrics::{iou, psnr};
use fastlgs_core::undistort::{Distortion, undistort};
use run::{assert_fails, json, text};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Returns an empty folder for scenes. `None` without models or device.
fn scene_dir() -> Option<tempfile::TempDir> {
    run::requirements_met().then(|| tempfile::tempdir().expect("a temporary folder"))
}

#[test]
fn transparent_and_masked_pixels_do_not_count() {
    let Some(dir) = scene_dir() else { return };
    let (photos, scene) = (dir.path().join("photos"), dir.path().join("scene"));
    json(&[
        "synth",
        "room",
        "-o",
        text(&photos),
        "--views",
        "8",
        "--size",
        "96x64",
    ]);
    let opaque = image::open(photos.join("images/001.png"))
        .expect("a photo")
        .into_rgb8();
    // The left half is transparent with arbitrary colours.
    let half = |x: u32| x < opaque.width() / 2;
    let nonsense = |x: u32, y: u32| {
        if half(x) {
            [255, 0, 255, 0]
        } else {
            let p = opaque.get_pixel(x, y);
            [p[0], p[1], p[2], 255]
        }
    };
    image::RgbaImage::from_fn(96, 64, |x, y| image::Rgba(nonsense(x, y)))
        .save(photos.join("images/001.png"))
        .expect("a photo");
    std::fs::create_dir_all(photos.join("ignore")).expect("a folder");
    image::GrayImage::from_fn(96, 64, |_, y| image::Luma([if y < 32 { 0 } else { 255 }]))
        .save(photos.join("ignore/002.png"))
        .expect("a mask");
    json(&[
        "preprocess",
        text(&photos),
        "-o",
        text(&scene),
        "--segmenter",
        "import",
        "--holdout",
        "0",
    ]);
    assert!(
        scene.join("alpha/001.png.png").is_file() && scene.join("ignore/002.png.png").is_file()
    );
    assert!(!scene.join("alpha/003.png.png").exists());
    let train = |background: &str| {
        json(&[
            "train",
            text(&scene),
            "--antialias",
            "--iterations",
            "60",
            "--budget",
            "2000",
            "--device",
            "cpu",
            "--curve",
            "40",
            "--background",
            background,
        ])
    };
    let report = train("0,1,0");
    assert_eq!(report["background"], serde_json::json!([0.0, 1.0, 0.0]));
    assert_eq!(report["curve"][0]["iteration"], 40);
    assert_fails(
        &[
            "train",
            text(&scene),
            "--iterations",
            "1",
            "--background",
            "learn",
        ],
        &["001.png", "transparent"],
    );

    // Mapping the Gaussians again keeps the background of their training.
    let ply = scene.join("scene.ply");
    let again = json(&[
        "train",
        text(&scene),
        "--init",
        text(&ply),
        "--iterations",
        "0",
        "--device",
        "cpu",
    ]);
    assert_eq!(
        [&again["background"], &again["antialias"]],
        [&report["background"], &true.into()]
    );

    // With few photos, training starts with a backdrop of opaque Gaussians, unless a photo is
    // transparent.
    let solid = || {
        json(&[
            "train",
            text(&scene),
            "--iterations",
            "1",
            "--device",
            "cpu",
        ]);
        let opacities = fastlgs_core::ply::read(&ply)
            .expect("a scene")
            .opacity_logits;
        opacities.iter().filter(|logit| **logit > 1.5).count()
    };
    assert_eq!(solid(), 0);
    std::fs::remove_file(scene.join("alpha/001.png.png")).expect("an alpha channel");
    assert!(solid() > 20);
}

/// Lens distortion that no input file reports is estimated and removed.
#[test]
fn unstated_lens_distortion_is_found_and_removed() {
    let Some(dir) = scene_dir() else { return };
    let (photos, scene) = (dir.path().join("photos"), dir.path().join("scene"));
    json(&[
        "synth",
        "study",
        "-o",
        text(&photos),
        "--views",
        "40",
        "--size",
        "480x360",
    ]);
    const K1: f32 = -0.15;
    let camera = fastlgs_core::dataset::load(&photos).expect("photos").photos[0]
        .camera
        .clone();
    // Inverse distortion to second order: k1' = -k1, k2' = 3 k1^2.
    let lens = Distortion {
        k1: -K1,
        k2: 3.0 * K1 * K1,
        ..Distortion::default()
    };
    let straight: Vec<(PathBuf, image::RgbImage)> = std::fs::read_dir(photos.join("images"))
        .expect("photos")
        .map(|entry| {
            let path = entry.expect("a photo").path();
            let photo = load_rgb(&path).expect("a photo");
            save_png(&path, undistort(&photo, &camera, &lens)).expect("a photo");
            (path, photo)
        })
        .collect();
    // Imported masks have the distortion of the photos.
    let drawn: Vec<[LabelMap; 2]> = straight
        .iter()
        .map(|(photo, _)| {
            let path = photos.join("masks").join(format!(
                "{}.png",
                photo.file_name().expect("a name").to_string_lossy()
            ));
            let map = LabelMap::load(&path).expect("masks");
            let distorted = map.undistorted(&camera, &lens);
            distorted.save(&path).expect("masks");
            [map, distorted]
        })
        .collect();
    for finer in ["part", "subpart"] {
        let _ = std::fs::remove_dir_all(photos.join("masks").join(finer));
    }
    let report = json(&[
        "preprocess",
        text(&photos),
        "-o",
        text(&scene),
        "--segmenter",
        "import",
    ]);
    let found = report["adjusted"]["k1"].as_f64().expect("a number") as f32;
    assert!((found - K1).abs() < 0.03, "{report}");
    let warned = report["warnings"]
        .as_array()
        .expect("a list")
        .iter()
        .any(|w| w.as_str().expect("words").contains("were straightened"));
    assert!(warned, "{report}");
    // Compares the centre only, because the distorted photos lack the borders.
    let inner = |photo: &image::RgbImage| {
        let inside = image::imageops::crop_imm(photo, 60, 45, 360, 270).to_image();
        inside
            .into_raw()
            .into_iter()
            .map(|v| f32::from(v) / 255.0)
            .collect::<Vec<_>>()
    };
    let folder = fastlgs_core::SceneFolder::open(&scene).expect("a scene");
    let mean = |photo: &dyn Fn(&Path) -> image::RgbImage| {
        straight
            .iter()
            .map(|(path, truth)| psnr(&inner(&photo(path)), &inner(truth)))
            .sum::<f64>()
            / straight.len() as f64
    };
    let bent = mean(&|path| load_rgb(path).expect("a photo"));
    let corrected = mean(&|path| {
        folder
            .photo(&path.file_name().expect("a name").to_string_lossy())
            .expect("a photo")
    });
    println!(
        "k1 {found:.3}, truth {K1}; PSNR against undistorted photos {bent:.1} dB before, {corrected:.1} dB after"
    );
    assert!(
        corrected > bent + 2.0,
        "{bent} dB before, {corrected} dB after"
    );

    // Finds the best IoU for each object of 400 to 20,000 pixels, in the distorted and in the
    // corrected masks.
    let manifest = folder.manifest().expect("a manifest");
    let cameras = manifest.training(&folder.cameras().expect("cameras"));
    let mut agreement = [Vec::new(), Vec::new()];
    for ((path, _), [truth, bent]) in straight.iter().zip(&drawn) {
        let Some(camera) = cameras.iter().find(|c| path.ends_with(&c.name)) else {
            continue;
        };
        let mended = folder
            .masks(camera)
            .expect("masks")
            .painted(fastlgs_core::Level::Whole);
        let areas = truth.areas();
        for label in (1..areas.len()).filter(|label| (400..20_000).contains(&areas[*label])) {
            let inside = |map: &LabelMap, label: u16| {
                map.labels.iter().map(|l| *l == label).collect::<Vec<_>>()
            };
            let thing = inside(truth, label as u16);
            for (map, found) in [bent, &mended].into_iter().zip(&mut agreement) {
                let best = (1..=map.max())
                    .map(|other| iou(&inside(map, other), &thing))
                    .fold(0.0, f64::max);
                found.push(best);
            }
        }
    }
    let [bent, mended] = agreement.map(|all| all.iter().sum::<f64>() / all.len() as f64);
    println!("IoU with undistorted masks {bent:.3} before, {mended:.3} after");
    assert!(
        mended > 0.95 && mended > bent,
        "{bent} before, {mended} after"
    );
}

#[test]
fn preprocessing_recomputes_only_what_changed() {
    let Some(dir) = scene_dir() else { return };
    let (photos, scene) = (dir.path().join("photos"), dir.path().join("scene"));
    json(&[
        "synth",
        "room",
        "-o",
        text(&photos),
        "--views",
        "10",
        "--size",
        "160x120",
    ]);
    let run = || {
        json(&[
            "preprocess",
            text(&photos),
            "-o",
            text(&scene),
            "--memory",
            "20M",
        ])
    };
    let counts = |report: &Value, stage: &str| {
        [0, 1].map(|k| report["cached"][stage][k].as_u64().expect("a number"))
    };
    let first = run();
    let results = || {
        ["points.safetensors", "pairs.safetensors"]
            .map(|f| std::fs::read(scene.join(f)).expect("a file"))
    };
    let before = results();
    assert_eq!(
        [counts(&first, "masks"), counts(&first, "poses")],
        [[0, 8], [0, 1]]
    );
    // Views 0 and 8 are held out. `seen_by` holds indices of training views.
    let folder = fastlgs_core::SceneFolder::open(&scene).expect("a scene");
    let training = folder
        .manifest()
        .expect("a manifest")
        .training(&folder.cameras().expect("cameras"));
    let points = folder.points().expect("points");
    let inside = |camera: &fastlgs_core::Camera, place| {
        let pixel = camera.to_pixel(camera.world_to_camera.transform_point3(place));
        // Key points may be two pixels outside.
        (-2.0..162.0).contains(&pixel.x) && (-2.0..122.0).contains(&pixel.y)
    };
    let observations = |p: &SfmPoint| {
        p.seen_by
            .iter()
            .map(|view| inside(&training[*view as usize], p.position))
            .collect::<Vec<bool>>()
    };
    let seen: Vec<bool> = points.iter().flat_map(observations).collect();
    assert!(
        seen.len() > 100 && seen.iter().all(|inside| *inside),
        "{} observations of {} points",
        seen.len(),
        points.len()
    );
    let second = run();
    for stage in ["masks", "poses", "key points", "matches"] {
        let [there, all] = counts(&second, stage);
        assert_eq!(there, all, "{stage}");
    }
    assert!(before == results(), "cached results give the same bytes");
    // After a change of one photo, only its own masks and matches are computed again.
    let path = photos.join("images/003.png");
    let changed = image::imageops::huerotate(&load_rgb(&path).expect("a photo"), 90);
    save_png(&path, changed).expect("a photo");
    let third = run();
    assert_eq!(
        [counts(&third, "masks"), counts(&third, "poses")],
        [[7, 8], [0, 1]]
    );
    assert!(before != results());
}

/// Without the exact poses, structure from motion must recover them up to a similarity transform.
#[test]
fn photos_without_poses_get_poses() {
    let Some(dir) = scene_dir() else { return };
    let (photos, exact, scene) = (
        dir.path().join("photos"),
        dir.path().join("exact"),
        dir.path().join("scene"),
    );
    json(&[
        "synth",
        "table",
        "-o",
        text(&photos),
        "--views",
        "24",
        "--size",
        "400x300",
    ]);
    // Names of photos may contain spaces.
    for [from, to] in [
        "images/*",
        "masks/*.png",
        "masks/part/*.png",
        "masks/subpart/*.png",
    ]
    .map(|f| ["003.png", "photo 3.png"].map(|n| photos.join(f.replace('*', n))))
    {
        if from.is_file() {
            std::fs::rename(from, to).expect("another name");
        }
    }
    let poses = std::fs::read_to_string(photos.join("transforms.json")).expect("poses");
    std::fs::write(
        photos.join("transforms.json"),
        poses.replace("images/003.png", "images/photo 3.png"),
    )
    .expect("poses");
    json(&[
        "preprocess",
        text(&photos),
        "-o",
        text(&exact),
        "--segmenter",
        "import",
    ]);
    std::fs::remove_file(photos.join("transforms.json")).expect("the poses");
    let report = json(&[
        "preprocess",
        text(&photos),
        "-o",
        text(&scene),
        "--segmenter",
        "import",
    ]);
    assert!(report["photos"].as_u64() >= Some(22), "{report}");
    assert!(
        std::fs::read(scene.join("cameras/cameras.json"))
            .is_ok_and(|c| String::from_utf8_lossy(&c).contains("photo 3.png"))
    );
    assert!(
        scene.join("sparse/0/images.bin").is_file() && !photos.join("sparse").exists(),
        "the photo folder is not written"
    );
    let cameras = |scene: &Path| -> Vec<fastlgs_core::Camera> {
        fastlgs_core::SceneFolder::open(scene)
            .and_then(|folder| folder.cameras())
            .expect("cameras")
    };
    let (exact, found) = (cameras(&exact), cameras(&scene));
    // Distances between camera centres, divided by their mean, are invariant to similarity
    // transforms.
    let pairs = |all: &[fastlgs_core::Camera]| -> Vec<f32> {
        let centre = |name: &str| {
            all.iter()
                .find(|c| c.name == name)
                .expect("a camera")
                .centre()
        };
        let names: Vec<&str> = found.iter().map(|c| c.name.as_str()).collect();
        let far = names
            .iter()
            .zip(names.iter().skip(5))
            .map(|(a, b)| centre(a).distance(centre(b)))
            .collect::<Vec<_>>();
        let mean = far.iter().sum::<f32>() / far.len() as f32;
        far.iter().map(|d| d / mean).collect()
    };
    let mut errors: Vec<f32> = pairs(&exact)
        .iter()
        .zip(pairs(&found))
        .map(|(a, b)| (a - b).abs())
        .collect();
    errors.sort_by(f32::total_cmp);
    let (median, worst) = (errors[errors.len() / 2], errors[errors.len() - 1]);
    println!(
        "{} of 24 photos placed; distances between centres differ by {median:.4} of their mean, at most {worst:.4}",
        found.len()
    );
    // The table's plain surfaces give only about 36 points per photo, so single photos may be
    // wrong.
    assert!(median < 0.02 && worst < 0.3, "{errors:?}");
}

/// Two fifths of the poses are wrong but consistent with each other, as when a room has two similar
/// sides. All poses are computed again.
#[test]
fn all_poses_are_recomputed_if_many_are_wrong() {
    let Some(dir) = scene_dir() else { return };
    let fox = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data/fox");
    if !fox.is_dir() {
        run::skip(format_args!("{} is absent", fox.display()));
        return;
    }
    let (photos, exact, scene) = (
        dir.path().join("photos"),
        dir.path().join("exact"),
        dir.path().join("scene"),
    );
    for folder in ["images", "masks"] {
        std::fs::create_dir_all(photos.join(folder)).expect("a folder");
    }
    for entry in std::fs::read_dir(fox.join("images")).expect("photos") {
        let path = entry.expect("a photo").path();
        let name = path
            .file_name()
            .expect("a name")
            .to_string_lossy()
            .into_owned();
        std::fs::copy(&path, photos.join("images").join(&name)).expect("a photo");
        // This test does not depend on the masks.
        let (width, height) = image::image_dimensions(&path).expect("a photo");
        let halves = image::GrayImage::from_fn(width, height, |x, _| {
            image::Luma([1 + u8::from(2 * x < width)])
        });
        halves
            .save(photos.join("masks").join(format!("{name}.png")))
            .expect("masks");
    }
    let file = photos.join("transforms.json");
    let truth = std::fs::read_to_string(fox.join("transforms.json")).expect("poses");
    std::fs::write(&file, &truth).expect("poses");
    json(&[
        "preprocess",
        text(&photos),
        "-o",
        text(&exact),
        "--segmenter",
        "import",
        "--max-side",
        "480",
        "--poses",
        "keep",
    ]);
    let mut poses: Value = serde_json::from_str(&truth).expect("poses");
    // Rotation about the y axis of the world.
    let (sin, cos) = 0.7f64.sin_cos();
    for frame in poses["frames"]
        .as_array_mut()
        .expect("frames")
        .iter_mut()
        .skip(34)
    {
        let [x, y, z, last]: [[f64; 4]; 4] =
            serde_json::from_value(frame["transform_matrix"].clone()).expect("a matrix");
        let row = |a: f64, b: f64| -> [f64; 4] { std::array::from_fn(|k| a * x[k] + b * z[k]) };
        frame["transform_matrix"] = serde_json::json!([row(cos, sin), y, row(-sin, cos), last]);
    }
    std::fs::write(&file, poses.to_string()).expect("poses");
    let report = json(&[
        "preprocess",
        text(&photos),
        "-o",
        text(&scene),
        "--segmenter",
        "import",
        "--max-side",
        "480",
    ]);
    assert_eq!(
        report["cached"]["poses anew"],
        serde_json::json!([0, 1]),
        "{report}"
    );
    assert!(
        (16..22).contains(&report["moved_cameras"].as_u64().expect("a number")),
        "{report}"
    );
    let cameras = |scene: &Path| {
        fastlgs_core::SceneFolder::open(scene)
            .and_then(|folder| folder.cameras())
            .expect("cameras")
    };
    let (exact, found) = (cameras(&exact), cameras(&scene));
    let extent = fastlgs_core::camera::scene_extent(&exact);
    // The result is in the frame and unit of the correct cameras.
    let mut off: Vec<f32> = exact
        .iter()
        .zip(&found)
        .map(|(a, b)| a.centre().distance(b.centre()) / extent)
        .collect();
    off.sort_by(f32::total_cmp);
    println!(
        "camera position errors in scene extents: median {:.4}, largest {:.4}",
        off[off.len() / 2],
        off[off.len() - 1]
    );
    assert!(
        off[off.len() / 2] < 0.005 && off[off.len() - 2] < 0.03,
        "{off:?}"
    );
    let again = json(&[
        "preprocess",
        text(&photos),
        "-o",
        text(&scene),
        "--segmenter",
        "import",
        "--max-side",
        "480",
    ]);
    assert_eq!(
        again["cached"]["poses anew"],
        serde_json::json!([1, 1]),
        "{again}"
    );
    assert!(cameras(&scene) == found && !scene.join("sfm.partial").exists());
}

/// A video around a table, with a short blurred section.
#[test]
fn videos_become_photos() {
    if !run::requirements_met() {
        return;
    }
    if Command::new("ffmpeg").arg("-version").output().is_err() {
        assert!(
            std::env::var_os("FASTLGS_REQUIRE_MODELS").is_none(),
            "ffmpeg is missing"
        );
        run::skip("ffmpeg is missing");
        return;
    }
    let dir = tempfile::tempdir().expect("a temporary folder");
    let (frames, video, scene) = (
        dir.path().join("frames"),
        dir.path().join("walk 100%.mp4"),
        dir.path().join("scene"),
    );
    json(&[
        "synth",
        "table",
        "-o",
        text(&frames),
        "--views",
        "180",
        "--size",
        "400x300",
    ]);
    let shaken: Vec<PathBuf> = (60..75)
        .map(|k| frames.join(format!("images/{k:03}.png")))
        .collect();
    for frame in &shaken {
        let sharp = load_rgb(frame).expect("a frame");
        save_png(frame, image::imageops::fast_blur(&sharp, 6.0)).expect("a frame");
    }
    let pattern = frames.join("images/%03d.png");
    let made = Command::new("ffmpeg")
        .args([
            "-v",
            "error",
            "-framerate",
            "15",
            "-i",
            text(&pattern),
            "-c:v",
            "mpeg4",
            "-q:v",
            "2",
            text(&video),
        ])
        .status();
    assert!(made.expect("ffmpeg starts").success());

    let preprocess = || json(&["preprocess", text(&video), "-o", text(&scene)]);
    let report = preprocess();
    let photos: Vec<PathBuf> = std::fs::read_dir(scene.join("video/images"))
        .expect("photos")
        .map(|e| e.expect("a photo").path())
        .collect();
    println!(
        "{} of 180 frames became photos, {} of them have poses",
        photos.len(),
        report["photos"]
    );
    assert!((16..90).contains(&photos.len()), "{} photos", photos.len());
    assert!(
        report["photos"].as_u64() >= Some(photos.len() as u64 * 9 / 10),
        "{report}"
    );
    assert!(
        report["warnings"]
            .as_array()
            .expect("a list")
            .iter()
            .all(|w| !w.as_str().expect("words").contains("blurred")),
        "{report}"
    );
    let changed = |path: &Path| path.metadata().and_then(|m| m.modified()).expect("a time");
    let before = changed(&photos[0]);
    assert_eq!(preprocess()["photos"], report["photos"]);
    assert_eq!(
        changed(&photos[0]),
        before,
        "frames of the same video are kept"
    );

    std::fs::write(&video, "no video").expect("a file");
    assert_fails(
        &["preprocess", text(&video), "-o", text(&scene)],
        &["walk 100%.mp4", "ffmpeg cannot read"],
    );
    assert_eq!(
        changed(&photos[0]),
        before,
        "the earlier frames are unchanged"
    );
}
