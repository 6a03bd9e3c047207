//! The binary from photos to queries on a generated scene with exact masks, and its messages about
//! bad input.
//!
//! Needs the offline models ('fastlgs models install-offline') and a Vulkan device. Without them
//! the tests are skipped with a message, or fail if FASTLGS_REQUIRE_GPU is set.

#[path = "support/onnx.rs"]
mod onnx;
#[path = "support/run.rs"]
mod run;
#[path = "support/toy_models.rs"]
mod toy_models;

use fastlgs_core::label_map::LabelMap;
use fastlgs_core::{SceneFolder, ply};
use fastlgs_grid::Grid;
use run::{assert_fails, coffee_iou, copy_folder, fastlgs, fixture, json, text};
use serde_json::Value;
use std::path::Path;

/// Trains a small scene with the shaders, where the other tests train on the CPU.
#[test]
fn the_adapter_trains_a_scene() {
    if !run::requirements_met() {
        return;
    }
    let dir = tempfile::tempdir().expect("a temporary folder");
    let (photos, scene) = (dir.path().join("photos"), dir.path().join("scene"));
    let synth = ["synth", "table", "--views", "12", "--size", "96x72", "-o"];
    json(&[&synth[..], &[text(&photos)]].concat());
    let preprocess = ["preprocess", text(&photos), "-o", text(&scene)];
    json(&[&preprocess[..], &["--segmenter", "import"]].concat());
    let train = ["train", text(&scene), "--iterations", "200"];
    let report = json(&[&train[..], &["--budget", "2000"]].concat());
    assert_eq!(report["device"]["device"], run::adapter());
    assert!(report["psnr_held_out"].as_f64() > Some(15.0), "{report}");
}

#[test]
fn the_papers_mapping_and_trained_features_work_too() {
    let Some(f) = fixture() else { return };
    let scene = f.dir.path().join("paper");
    copy_folder(&f.scene, &scene);
    let start = f.scene.join("scene.ply");
    let options = [
        "--iterations",
        "250",
        "--budget",
        "15000",
        "--mapping",
        "paper",
        "--feature-mode",
        "train",
        "--theta",
        "0.8",
        "--device",
        "cpu",
    ];
    let mut args = vec!["train", text(&scene), "--init", text(&start)];
    args.extend(options);
    let report = json(&args);
    assert!(
        report["objects"].as_u64().is_some_and(|k| k >= 4),
        "{report}"
    );
    let answer = json(&[
        "query",
        text(&scene),
        "coffee",
        "--view",
        "008",
        "--false-alarms",
        "0.5",
        "-o",
        text(&f.dir.path().join("paper-out")),
    ]);
    assert!(
        answer["pixels"].as_u64().is_some_and(|n| n > 100),
        "the mask within tau_ac is not empty: {answer}"
    );
    let mask = LabelMap::load(Path::new(answer["mask"].as_str().expect("a path")))
        .expect("the mask is a grey PNG");
    let truth = LabelMap::load(&f.photos.join("masks/008.png.png")).expect("exact masks");
    let found = mask.labels.iter().filter(|m| **m > 0).count();
    let right = mask
        .labels
        .iter()
        .zip(&truth.labels)
        .filter(|(m, t)| **m > 0 && **t == 2)
        .count();
    assert!(
        2 * right > found,
        "only {right} of {found} pixels belong to the coffee"
    );
    assert_fails(
        &["train", text(&scene), "--feature-mode", "train"],
        &["--feature-mode", "mapping to paper"],
    );

    // With --freeze, only features are trained. Geometry and colour of the Gaussians stay.
    let before = ply::read(&start).expect("the start");
    args.push("--freeze");
    args[5] = "100";
    let report = json(&args);
    let after = ply::read(&scene.join("scene.ply")).expect("the scene");
    assert_eq!(
        (&before.means, &before.sh_dc, &before.opacity_logits),
        (&after.means, &after.sh_dc, &after.opacity_logits)
    );
    assert_ne!(before.features, after.features);
    assert!(
        report["adapter"]
            .as_str()
            .is_some_and(|a| a.starts_with("cpu")),
        "{report}"
    );
}

/// Lifting and gradient descent can each start from the scene of the other, and keep the objects.
#[test]
fn either_feature_mode_refines_the_other() {
    let Some(f) = fixture() else { return };
    let scene = f.dir.path().join("refined");
    copy_folder(&f.scene, &scene);
    let ply_path = scene.join("scene.ply");
    let refine = |mode: &str, iterations: &str, more: &[&str]| {
        let start = [
            "train",
            text(&scene),
            "--init",
            text(&ply_path),
            "--mapping",
            "keep",
            "--device",
            "cpu",
        ];
        json(
            &[
                &start,
                ["--feature-mode", mode, "--iterations", iterations].as_slice(),
                more,
            ]
            .concat(),
        )
    };
    let coffee = || {
        let out = f.dir.path().join("refined-out");
        let answer = json(&[
            "query",
            text(&scene),
            "coffee",
            "--view",
            "008",
            "--device",
            "cpu",
            "-o",
            text(&out),
        ]);
        (answer["objects"][0]["id"].as_u64(), coffee_iou(f, &answer))
    };
    let lifted = coffee();
    let before = ply::read(&ply_path).expect("the scene");
    let report = refine("train", "150", &["--freeze"]);
    let trained = coffee();
    let between = ply::read(&ply_path).expect("the scene");
    assert_eq!(
        (&before.means, &before.sh_dc),
        (&between.means, &between.sh_dc),
        "{report}"
    );
    assert_ne!(before.features, between.features);
    refine("lift", "0", &[]);
    let again = coffee();
    println!(
        "IoU of the coffee: lifted {:.3}, refined by descent {:.3}, lifted again {:.3}",
        lifted.1, trained.1, again.1
    );
    assert!(
        lifted.0 == trained.0 && lifted.0 == again.0,
        "{lifted:?} {trained:?} {again:?}"
    );
    assert!(
        trained.1 > 0.5 && again.1 > 0.9 * lifted.1,
        "{lifted:?} {trained:?} {again:?}"
    );
    std::fs::remove_file(scene.join("masks/objects").join("001.png.png")).expect("an object map");
    assert_fails(
        &[
            "train",
            text(&scene),
            "--mapping",
            "keep",
            "--iterations",
            "0",
            "--init",
            text(&ply_path),
        ],
        &["001.png.png", "train it first"],
    );
}

#[test]
fn exports_keep_what_queries_need() {
    let Some(f) = fixture() else { return };
    let at = |name: &str| f.dir.path().join("export").join(name);
    let ply_report = json(&["export", text(&f.scene), text(&at("scene.ply"))]);
    assert_eq!(
        ply::read(&at("scene.ply")).expect("the export"),
        ply::read(&f.scene.join("scene.ply")).expect("the scene")
    );
    let spz_report = json(&["export", text(&f.scene), text(&at("scene.spz"))]);
    assert!(
        spz_report["psnr_against_original"]
            .as_f64()
            .is_some_and(|db| db > 35.0),
        "{spz_report}"
    );
    let bytes = |report: &Value| report["bytes"].as_u64().expect("a number");
    assert!(
        4 * bytes(&spz_report) < bytes(&ply_report),
        "{spz_report} {ply_report}"
    );
    let sog_report = json(&["export", text(&f.scene), text(&at("scene.sog"))]);
    assert!(
        sog_report["psnr_against_original"]
            .as_f64()
            .is_some_and(|db| db > 35.0),
        "{sog_report}"
    );
    println!("SPZ: {spz_report}\nSOG: {sog_report}");
    // In such a small scene, SOG's palette, codebooks and file names cost as many bytes as SOG
    // saves. Its PSNR is higher than SPZ's.
    assert!(
        10 * bytes(&sog_report) < 11 * bytes(&spz_report),
        "{sog_report} {spz_report}"
    );
    let psnr = |report: &Value| report["psnr_against_original"].as_f64().expect("a number");
    assert!(
        psnr(&sog_report) > psnr(&spz_report),
        "{sog_report} {spz_report}"
    );
    let small = at("small");
    let report = json(&["export", text(&f.scene), text(&small)]);
    assert!(
        3 * bytes(&report) < report["bytes_before"].as_u64().expect("a number"),
        "{report}"
    );
    let run_query = |scene: &Path| {
        json(&[
            "query",
            text(scene),
            "coffee",
            "--view",
            "008",
            "-o",
            text(&at("out")),
        ])
    };
    let (whole, compressed) = (run_query(&f.scene), run_query(&small));
    assert_eq!(whole["objects"][0]["id"], compressed["objects"][0]["id"]);
    let pixels = |answer: &Value| answer["pixels"].as_f64().expect("a number");
    assert!(
        (pixels(&whole) / pixels(&compressed) - 1.0).abs() < 0.05,
        "{whole} {compressed}"
    );
    assert_fails(
        &["export", text(&f.scene), text(&f.scene)],
        &["the scene itself"],
    );
    let loss = |when: &str| report["psnr_held_out"][when].as_f64().expect("a number");
    assert!(loss("before") - loss("after") < 0.1, "{report}");
    let model = small.join("scene.safetensors");
    let original = std::fs::read(&model).expect("the model");
    std::fs::write(&model, &original[..original.len() / 2]).expect("a file");
    assert_fails(
        &["query", text(&small), "coffee"],
        &["scene.safetensors", "export the scene again"],
    );
}

/// Stand-ins for SAM (masks of similar colour) and CLIP (names of colours) run through all stages,
/// from photos to queries.
#[test]
fn onnx_exports_of_sam_and_clip() {
    let Some(f) = fixture() else { return };
    let folder = f.dir.path().join("toy");
    std::fs::create_dir_all(&folder).expect("a folder");
    let file = |name: &str| folder.join(name);
    let [encoder, decoder, image, words] =
        ["encoder", "decoder", "image", "text"].map(|n| file(&format!("{n}.onnx")));
    toy_models::sam(
        toy_models::SamExport::Official { batched: true },
        &encoder,
        &decoder,
    );
    toy_models::clip(&image, &words, 32);
    let (scene, second) = (file("scene"), file("second"));
    let sam = [
        "--segmenter",
        "sam",
        "--sam-encoder",
        text(&encoder),
        "--sam-decoder",
        text(&decoder),
        "--sam-points",
        "8",
    ];
    let clip = [
        "--encoder",
        "clip",
        "--clip-image",
        text(&image),
        "--clip-text",
        text(&words),
    ];
    let mut args = vec![
        "preprocess",
        text(&f.photos),
        "-o",
        text(&scene),
        "--max-side",
        "160",
        "--levels",
        "whole,part",
    ];
    args.extend(sam.iter().chain(&clip));
    let report = json(&args);
    let masks = &report["masks_per_photo"];
    assert!(
        masks["whole"].as_f64().is_some_and(|n| n > 1.0) && masks["subpart"].is_null(),
        "{report}"
    );
    // With eight prompts per side, many objects lack masks in many views, which lowers their
    // support.
    json(&[
        "train",
        text(&scene),
        "--init",
        text(&f.scene.join("scene.ply")),
        "--iterations",
        "0",
        "--support",
        "0.3",
    ]);
    let ask = |color: &str| {
        let options = ["--view", "008", "--false-alarms", "0.5", "--top-k", "1"];
        json(
            &[
                &["query", text(&scene), color, "-o", text(&file("out"))],
                &options[..],
            ]
            .concat(),
        )
    };
    let (red, blue) = (ask("red"), ask("blue"));
    assert!(
        red["found"] == true && blue["found"] == true,
        "{red} {blue}"
    );
    assert_ne!(red["objects"][0]["id"], blue["objects"][0]["id"]);
    let mask = image::open(red["mask"].as_str().expect("a path"))
        .expect("the mask")
        .into_luma8();
    let photo = image::open(scene.join("photos/008.png.png"))
        .expect("the photo")
        .into_rgb8();
    let inside: Vec<_> = photo
        .pixels()
        .zip(mask.pixels())
        .filter(|(_, m)| m[0] > 0)
        .map(|(p, _)| p.0.map(f64::from))
        .collect();
    let redness = inside
        .iter()
        .map(|p| p[0] - (p[1] + p[2]) / 2.0)
        .sum::<f64>()
        / inside.len() as f64;
    assert!(redness > 20.0, "{redness} over {} pixels", inside.len());
    // The two towers are not calibrated yet, so the query uses a default calibration.
    assert_eq!(red["calibrated"], false, "{red}");
    let towers = ["--clip-image", text(&image), "--clip-text", text(&words)];
    let measured = json(&[&["models", "calibrate"], &towers[..]].concat());
    assert!(
        measured["texts"]["temperature"]
            .as_f64()
            .is_some_and(|t| t > 0.0),
        "{measured}"
    );
    // Another text tower is refused, although its embeddings have the same length.
    let foreign = file("foreign.onnx");
    std::fs::copy(&words, &foreign).expect("a copy");
    let copied = json(&["query", text(&scene), "red", "--clip-text", text(&foreign)]);
    assert_eq!(copied["text"], "red");
    std::fs::copy(&image, &foreign).expect("a copy");
    assert_fails(
        &["query", text(&scene), "red", "--clip-text", text(&foreign)],
        &["--clip-text", "foreign.onnx", "not the text tower"],
    );
    // Linux has no DirectML, so that the library is always built without it.
    assert_eq!(report["onnx"], "cpu");
    assert_fails(
        &["query", text(&scene), "red", "--onnx", "directml"],
        &["directml", "onnxruntime-directml", "ORT_DYLIB_PATH"],
    );
    // The existing scene keeps the background of its crops. The next scene uses the best
    // background.
    assert_eq!(ask("red")["calibrated"], measured["agrees"], "{measured}");
    let background = measured["background"].as_str().expect("a word").to_owned();
    let separation = &measured["separation"];
    let of = |background: &str| separation[background].as_f64().expect("a number");
    assert!(
        ["grey", "black", "blurred"]
            .iter()
            .all(|other| of(other) <= of(&background)),
        "{measured}"
    );
    args[3] = text(&second);
    json(&args);
    let remembered: serde_json::Value =
        fastlgs_core::fs::read_json(&second.join("scene.json")).expect("the manifest");
    assert_eq!(
        remembered["crops"].as_str().expect("a word"),
        background.replace("grey", ""),
        "{measured}"
    );
    // Another background in the calibration file is used as well.
    let kept = measured["kept"].as_str().expect("a path");
    let other = if background == "black" {
        "blurred"
    } else {
        "black"
    };
    let mut measurement: serde_json::Value =
        fastlgs_core::fs::read_json(Path::new(kept)).expect("the measurement");
    measurement["background"] = other.into();
    fastlgs_core::fs::write_json(Path::new(kept), &measurement).expect("a file");
    json(&args);
    let remembered: serde_json::Value =
        fastlgs_core::fs::read_json(&second.join("scene.json")).expect("the manifest");
    assert_eq!(remembered["crops"], other);
    // Embeddings of another encoder are rejected.
    let manifest = std::fs::read_to_string(scene.join("scene.json")).expect("the manifest");
    std::fs::write(
        scene.join("scene.json"),
        manifest.replace("\"encoder\": \"clip\"", "\"encoder\": \"offline\""),
    )
    .expect("a file");
    assert_fails(
        &["query", text(&scene), "red"],
        &["another encoder", "iterations to 0"],
    );
    std::fs::write(scene.join("scene.json"), manifest).expect("a file");
    // A scene knows the hashes of its models and rejects other files.
    std::fs::write(&words, b"short").expect("a file");
    assert_fails(&["query", text(&scene), "red"], &["text.onnx", "made with"]);
    assert_fails(
        &[
            "preprocess",
            text(&f.photos),
            "-o",
            text(&file("x")),
            "--segmenter",
            "sam",
            "--sam",
            "sam9",
        ],
        &["sam9", "slimsam"],
    );
    let unused = file("x");
    let alone = [
        "preprocess",
        text(&f.photos),
        "-o",
        text(&unused),
        "--encoder",
        "clip",
        "--clip-text",
        text(&image),
    ];
    assert_fails(&alone, &["image.onnx", "--clip-image"]);
    args[3] = "unused";
    *args.last_mut().expect("options") = text(&image);
    assert_fails(&args, &["image.onnx", "no text tower"]);
}

#[test]
fn renders_every_kind_of_picture_and_any_camera() {
    let Some(f) = fixture() else { return };
    let out = f.dir.path().join("pictures");
    let what = ["--what", "color,depth,feature,objects", "-o", text(&out)];
    let mut args = vec!["render", text(&f.scene), "--view", "008.png"];
    args.extend(what);
    let report = json(&args);
    assert!(
        report["render_ms"][0].as_f64().is_some_and(|ms| ms > 0.0),
        "{report}"
    );
    let (_, _, features) =
        fastlgs_core::exr_image::read(&out.join("008.png.feature.exr")).expect("features");
    assert!(
        features.len() == 3
            && features
                .iter()
                .all(|f| f.1.iter().any(|value| *value > 0.05)),
        "the feature picture is not empty"
    );
    let (w, h, depth) =
        fastlgs_core::exr_image::read(&out.join("008.png.depth.exr")).expect("depth");
    let (_, _, truth) =
        fastlgs_core::exr_image::read(&f.photos.join("depth/008.png.exr")).expect("exact depth");
    assert_eq!((w, h), (320, 240));
    // Depth errors count on objects only. The bare walls have too little texture for reliable
    // depth.
    let things = LabelMap::load(&f.photos.join("masks/008.png.png")).expect("exact masks");
    let pairs = depth[0]
        .1
        .iter()
        .zip(&truth[0].1)
        .zip(&things.labels)
        .filter(|(_, l)| **l > 0);
    let mut errors: Vec<f32> = pairs.map(|((a, b), _)| (a - b).abs() / b).collect();
    errors.sort_by(f32::total_cmp);
    assert!(
        errors[errors.len() / 2] < 0.1,
        "median relative depth error {}",
        errors[errors.len() / 2]
    );
    let cameras: Value = serde_json::from_slice(
        &std::fs::read(f.scene.join("cameras/cameras.json")).expect("cameras"),
    )
    .expect("JSON");
    let file = f.dir.path().join("camera.json");
    std::fs::write(&file, cameras[3].to_string()).expect("a temporary file");
    let report = json(&[
        "render",
        text(&f.scene),
        "--camera",
        text(&file),
        "--size",
        "97x61",
        "-o",
        text(&out),
    ]);
    assert_eq!(report["size"], "97x61");
}

#[test]
fn bad_input_is_reported_and_scenes_stay_unchanged() {
    let Some(f) = fixture() else { return };
    let dir = tempfile::tempdir().expect("a temporary folder");
    let at = |name: &str| dir.path().join(name);
    let out = at("out");
    std::fs::create_dir(at("empty")).expect("a folder");
    assert_fails(
        &["preprocess", text(&at("empty")), "-o", text(&out)],
        &["empty", "no poses"],
    );
    assert_fails(
        &["preprocess", text(&at("nowhere")), "-o", text(&out)],
        &["nowhere", "no such folder"],
    );
    assert_fails(&["train", text(&out)], &["not a scene", "preprocess"]);

    // A photo that cannot be decoded, a pose without a photo, a photo without a pose, and NaN in a
    // pose.
    let transforms = |edit: &dyn Fn(&mut Value)| {
        let photos = at("photos");
        let _ = std::fs::remove_dir_all(&photos);
        std::fs::create_dir_all(photos.join("images")).expect("a folder");
        let mut value: Value = serde_json::from_slice(
            &std::fs::read(f.photos.join("transforms.json")).expect("poses"),
        )
        .expect("JSON");
        value["frames"].as_array_mut().expect("frames").truncate(3);
        for k in 0..3 {
            std::fs::copy(
                f.photos.join(format!("images/00{k}.png")),
                photos.join(format!("images/00{k}.png")),
            )
            .expect("a copy");
        }
        edit(&mut value);
        std::fs::write(photos.join("transforms.json"), value.to_string()).expect("a file");
        photos
    };
    let photos = transforms(&|_| {});
    std::fs::write(photos.join("images/001.png"), b"not a photo").expect("a file");
    assert_fails(
        &["preprocess", text(&photos), "-o", text(&out)],
        &["001.png", "cannot be read"],
    );
    let photos = transforms(&|v| v["frames"][1]["transform_matrix"][0][0] = Value::Null);
    assert_fails(
        &["preprocess", text(&photos), "-o", text(&out)],
        &["001.png", "NaN"],
    );
    let photos = transforms(&|v| v["frames"].as_array_mut().expect("frames").truncate(0));
    assert_fails(
        &["preprocess", text(&photos), "-o", text(&out)],
        &["transforms.json", "no frames"],
    );
    let photos = transforms(&|v| v["frames"][1]["file_path"] = "images/lost.png".into());
    let output = fastlgs(&[
        "preprocess",
        text(&photos),
        "-o",
        text(&out),
        "--max-side",
        "64",
        "--holdout",
        "0",
    ]);
    let printed = String::from_utf8_lossy(&output.stderr);
    assert!(
        output.status.success() && printed.contains("lost.png") && printed.contains("001.png"),
        "a warning names each of both files: {printed}"
    );
    assert_fails(
        &["render", text(&out), "-o", text(&at("r"))],
        &["never trained"],
    );

    // A trained scene: an unknown view, a truncated PLY file, and a failed run that leaves the
    // scene unchanged.
    assert_fails(
        &[
            "render",
            text(&f.scene),
            "--view",
            "nobody.png",
            "-o",
            text(&at("r")),
        ],
        &["nobody.png", "views"],
    );
    let copy = at("copy");
    copy_folder(&f.scene, &copy);
    let ply = std::fs::read(copy.join("scene.ply")).expect("the scene");
    assert_fails(
        &[
            "train",
            text(&copy),
            "--init",
            text(&at("missing.ply")),
            "--iterations",
            "1",
        ],
        &["missing.ply"],
    );
    assert_eq!(
        std::fs::read(copy.join("scene.ply")).expect("the scene"),
        ply,
        "a failed run leaves the scene unchanged"
    );
    std::fs::write(copy.join("scene.ply"), &ply[..ply.len() - 11]).expect("a file");
    assert_fails(&["query", text(&copy), "cat"], &["scene.ply", "truncated"]);
    let cut = std::fs::read(copy.join("grid.safetensors")).expect("the grid");
    std::fs::write(copy.join("scene.ply"), &ply).expect("a file");
    std::fs::write(copy.join("grid.safetensors"), &cut[..cut.len() / 2]).expect("a file");
    assert_fails(&["query", text(&copy), "cat"], &["grid.safetensors"]);
    // Embeddings of another encoder version fail, with a message that names the remedy.
    std::fs::write(copy.join("grid.safetensors"), &cut).expect("a file");
    let folder = SceneFolder::new(&copy);
    let grid = Grid::load(&folder).expect("the grid");
    assert!(grid.encoder.starts_with("offline "), "{}", grid.encoder);
    Grid {
        encoder: "offline 1".to_owned(),
        ..grid
    }
    .save(&folder)
    .expect("a file");
    assert_fails(
        &["query", text(&copy), "cat"],
        &["another encoder", "iterations to 0"],
    );
    json(&[
        "train",
        text(&copy),
        "--init",
        text(&copy.join("scene.ply")),
        "--iterations",
        "0",
    ]);
    json(&["query", text(&copy), "cat"]);
    assert_fails(
        &["info", "--device", "nonsense", text(&at("nowhere"))],
        &["nowhere"],
    );
    assert_fails(
        &[
            "render",
            text(&f.scene),
            "--device",
            "nonsense",
            "-o",
            text(&at("r")),
        ],
        &["nonsense"],
    );
    assert_eq!(fastlgs(&["query"]).status.code(), Some(2), "wrong usage");
}
