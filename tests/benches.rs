//! Tests of the benches on generated scenes. They run, their figures are consistent, and the
//! documented bounds hold. Most take minutes: `./test.sh --all` runs them.

#[path = "support/skip.rs"]
mod skip;

use fastlgs::model_choice::SegmenterKind;
use fastlgs::{Run, preprocess, synth, train};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Runs `fastlgs-bench` on the CPU backend and returns its figures.
fn bench(args: &[&str]) -> Value {
    let program = env!("CARGO_BIN_EXE_fastlgs-bench");
    let output = Command::new(program)
        .args(args)
        .args(["--device", "cpu", "--json", "-"])
        .output()
        .expect("the binary starts");
    assert!(
        output.status.success(),
        "{args:?}: {}",
        String::from_utf8_lossy(&output.stderr)
    );
    serde_json::from_slice(&output.stdout).expect("JSON")
}

/// A trained table with exact masks, 32 views of 240x180, in `folder`.
fn table(folder: &Path) -> PathBuf {
    let (photos, scene) = (folder.join("photos"), folder.join("table"));
    let run = Run::silent("cpu", 0);
    let kind = synth::SynthConfig {
        kind: "table".into(),
        output: photos.clone(),
        views: Some(32),
        size: (240, 180),
        ..Default::default()
    };
    fastlgs::synth(&kind, &run).expect("generated photos");
    let mut config = preprocess::PreprocessConfig {
        photos,
        output: scene.clone(),
        ..Default::default()
    };
    config.eyes.segmenter = SegmenterKind::Import;
    fastlgs::preprocess(&config, &run).expect("a preprocessed scene");
    let config = train::TrainConfig {
        scene: scene.clone(),
        iterations: Some(1000),
        ..Default::default()
    };
    fastlgs::train(&config, &run).expect("a trained scene");
    scene
}

fn text(path: &Path) -> &str {
    path.to_str().expect("a UTF-8 path")
}

fn number(row: &Value, name: &str) -> f64 {
    row[name]
        .as_f64()
        .unwrap_or_else(|| panic!("no {name} in {row}"))
}

fn rows(figures: &Value) -> &[Value] {
    figures["rows"].as_array().expect("rows")
}

fn row<'a>(figures: &'a Value, column: &str, value: &str) -> &'a Value {
    rows(figures)
        .iter()
        .find(|row| row[column] == value)
        .unwrap_or_else(|| panic!("no row {value} in {figures}"))
}

fn assert_written(folder: &Path, files: &[&str]) {
    for file in files {
        let length = std::fs::metadata(folder.join(file))
            .unwrap_or_else(|e| panic!("{file}: {e}"))
            .len();
        assert!(length > 100, "{file} has {length} bytes");
    }
}

#[test]
fn speed() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let out = text(folder.path());
    let devices = if fastlgs_raster::adapters().is_empty() {
        "cpu"
    } else {
        "0,cpu"
    };
    let settings = [
        "--gaussians",
        "500,2000",
        "--size",
        "64x48,96x64",
        "--steps",
        "2",
        "--devices",
        devices,
    ];
    let figures = bench(&[&["speed", "-o", out], &settings[..]].concat());
    let tables = figures["devices"].as_array().expect("devices");
    assert_eq!(tables.len(), devices.split(',').count());
    for table in tables {
        let settings = table["settings"].as_array().expect("settings");
        assert_eq!(settings.len(), 4);
        assert!(
            settings
                .iter()
                .all(|row| number(row, "train_iterations_per_second") > 0.0
                    && number(row, "render_ms") > 0.0)
        );
        assert!(
            table["growth"]["train_ms"]["gaussians"].is_number()
                && table["growth"]["render_ms"]["pixels"].is_number(),
            "{table}"
        );
        assert!(
            settings[0]["train_pass_ms"]["blend"].is_number()
                && settings[0]["memory"]["state"].is_number(),
            "{table}"
        );
    }
    assert_written(folder.path(), &["speed.json", "speed.svg"]);
}

#[test]
#[ignore = "minutes; ./test.sh --all runs it"]
fn all_measures_missing_rows_only() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let out = text(folder.path());
    let ways = "quick,paper's mapping,mean embeddings without a grid,compact,SPZ,a quarter of the Gaussians,\
        SH degree 0,40 % of the masks missing,noise of half an embedding's length,at most 10000 Gaussians";
    let measured = |ways: &str| {
        let settings = [
            "--scenes",
            "table",
            "--seeds",
            "0",
            "--iterations",
            "1000",
            "-o",
            out,
        ];
        bench(&[&["all", "--ways", ways], &settings[..]].concat())
    };
    // Texts of ways without the detector are compared with quick without it: one more row.
    assert_eq!(measured(ways)["rows"], 11);
    let rows: Value =
        serde_json::from_slice(&std::fs::read(folder.path().join("rows.json")).expect("the rows"))
            .expect("JSON");
    let figure = |way: &str, name: &str| number(row(&rows, "way", way), name);
    let best = |way: &str| figure(way, "oracle_miou");
    assert!(best("quick") > 0.75, "{rows}");
    let answer = |way: &str| figure(way, "miou");
    assert!(answer("mean embeddings without a grid") > 0.0, "{rows}");
    assert!(
        figure("quick", "query_ms") > 1.0,
        "rendering is included: {rows}"
    );
    assert!(
        best("40 % of the masks missing") > best("quick") - 0.05,
        "{rows}"
    );
    let bytes = |way: &str| figure(way, "scene_bytes");
    assert!(
        bytes("compact") < bytes("quick") && bytes("SPZ") < bytes("quick"),
        "{rows}"
    );
    assert!(bytes("SH degree 0") < bytes("quick"), "{rows}");
    let kept = figure("a quarter of the Gaussians", "gaussians") / figure("quick", "gaussians");
    assert!((kept - 0.25).abs() < 0.01, "{rows}");
    // A second run measures nothing and writes the same pages.
    let page = std::fs::read(folder.path().join("speed.md")).expect("a page");
    assert_eq!(measured("quick")["rows"], 11);
    assert_eq!(
        page,
        std::fs::read(folder.path().join("speed.md")).expect("a page")
    );
    assert_written(
        folder.path(),
        &[
            "README.md",
            "speed.svg",
            "stability.md",
            "stability.svg",
            "size.md",
            "paper.md",
        ],
    );
}

#[test]
#[ignore = "minutes; ./test.sh --all runs it"]
fn names() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let scene = table(folder.path());
    let labels = text(&folder.path().join("photos/labels")).to_owned();
    let figures = bench(&[
        "names",
        text(&scene),
        text(&scene),
        "--labels",
        &format!("{labels},{labels}"),
    ]);
    // Both scenes are the same, so the calibration of one has the same accuracy on the other.
    assert_eq!(figures["gap"], 0.0, "{figures}");
    assert!(number(&figures, "auroc_pooled") > 0.6, "{figures}");
}

/// Runs `fastlgs-bench clip` on a bad folder; the message must contain all `words`.
fn assert_clip_refuses(folder: &Path, words: &[&str]) {
    let output = Command::new(env!("CARGO_BIN_EXE_fastlgs-bench"))
        .args(["clip", text(folder)])
        .output()
        .expect("the binary starts");
    let message = String::from_utf8_lossy(&output.stderr);
    assert!(
        output.status.code() == Some(1) && words.iter().all(|word| message.contains(word)),
        "{message}"
    );
}

#[test]
fn real_clip_embeddings_are_found_and_absent_names_are_not() {
    let empty = tempfile::tempdir().expect("a temporary folder");
    assert_clip_refuses(empty.path(), &["texts.json"]);
    let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data/clip");
    if !data.is_dir() {
        skip::skip(format_args!("{} is absent", data.display()));
        return;
    }
    let figures = bench(&["clip", text(&data)]);
    let at_least = |group: &Value, name: &str, least: f64| {
        assert!(number(group, name) >= least, "{name}: {figures}");
    };
    // The calibration of each room is from the other rooms.
    for group in [&figures["default"], &figures["left_out"]] {
        at_least(group, "present", 0.9);
        at_least(group, "furniture", 0.7);
        assert!(number(group, "absent") <= 0.085, "{figures}");
    }
    at_least(&figures["auroc"], "present", 0.96);
    at_least(&figures["auroc"], "furniture", 0.92);
    // The constants are those that the bench measures.
    let measured = |name: &str| number(&figures["calibrations"][name], "temperature");
    assert!((measured("texts") - 105.0).abs() < 1.0, "{figures}");
    assert!((measured("pictures") - 36.0).abs() < 1.0, "{figures}");
    let pairs = &figures["pairs"][0]["calibration"];
    assert!(
        (number(pairs, "temperature") - 85.0).abs() < 1.0,
        "{figures}"
    );

    let copy = |from: &str, to: &str| {
        std::fs::copy(data.join(from), empty.path().join(to)).expect("a copy");
    };
    copy("texts.json", "texts.json");
    assert_clip_refuses(empty.path(), &["texts.npy"]);
    copy("scene0200_00.npy", "texts.npy");
    assert_clip_refuses(empty.path(), &["103 texts", "14 rows"]);
    copy("texts.npy", "texts.npy");
    assert_clip_refuses(empty.path(), &["no room"]);
    copy("scene0200_00.npy", "room.npy");
    copy("scene0062_00.views.npy", "room.views.npy");
    assert_clip_refuses(empty.path(), &["room.npy", "14 objects"]);
}
