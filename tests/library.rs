//! The pipeline as a library: typed reports, progress messages, and cancelled runs.
//!
//! Needs the offline models. Without them the tests are skipped with a message, or fail if
//! FASTLGS_REQUIRE_MODELS is set.

#[path = "support/skip.rs"]
mod skip;

use fastlgs::progress::{Message, Sink};
use fastlgs::{Error, Run, Scene, preprocess, synth, train};
use fastlgs_core::rng::Rng;
use fastlgs_core::{Camera, SceneFolder};
use glam::{Mat4, Quat, Vec3};
use std::path::Path;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};

/// A progress sink that records stages. If `cancel_enabled` is set, it cancels once training has
/// started.
#[derive(Default)]
struct Watcher {
    stages: Mutex<Vec<String>>,
    cancel_enabled: AtomicBool,
    training: AtomicBool,
}

impl Sink for Watcher {
    fn on_message(&self, message: Message<'_>) {
        let line = match message {
            Message::Started { stage, .. } => format!("{stage} begins"),
            Message::Finished { stage } => format!("{stage} ends"),
            Message::Trained { step, total, scene } => {
                self.training.store(true, Ordering::Relaxed);
                assert!(step.iteration <= total && step.loss > 0.0);
                assert_eq!(scene().expect("the growing scene").len(), step.gaussians);
                return;
            }
            _ => return,
        };
        self.stages.lock().expect("no panic").push(line);
    }

    fn cancelled(&self) -> bool {
        self.cancel_enabled.load(Ordering::Relaxed) && self.training.load(Ordering::Relaxed)
    }
}

/// Returns whether the offline models are installed. Prints a message if they are not.
fn models_are_there() -> bool {
    let installed = fastlgs_vision::models::offline_installed();
    assert!(
        installed || std::env::var_os("FASTLGS_REQUIRE_MODELS").is_none(),
        "the offline models are missing"
    );
    if !installed {
        skip::skip("needs the offline models");
    }
    installed
}

#[test]
fn stages_report_progress_and_cancelling_keeps_the_scene() {
    if !models_are_there() {
        return;
    }
    let dir = tempfile::tempdir().expect("a temporary folder");
    let (photos, scene) = (dir.path().join("photos"), dir.path().join("scene"));
    let watcher = Watcher::default();
    let run = Run {
        progress: &watcher,
        ..Run::silent("cpu", 7)
    };
    let made = synth::SynthConfig {
        kind: "table".into(),
        output: photos.clone(),
        views: Some(12),
        size: (96, 72),
        ..Default::default()
    };
    assert_eq!(
        fastlgs::synth(&made, &run)
            .expect("a generated scene")
            .views,
        12
    );

    let mut config = preprocess::PreprocessConfig {
        photos,
        output: scene.clone(),
        ..Default::default()
    };
    config.eyes.segmenter = fastlgs::model_choice::SegmenterKind::Import;
    let report = fastlgs::preprocess(&config, &run).expect("a preprocessed scene");
    assert_eq!(
        (report.photos, report.training_photos, report.size.as_str()),
        (12, 10, "96x72")
    );

    let quick = train::TrainConfig {
        scene: scene.clone(),
        iterations: Some(200),
        budget: Some(1500),
        ..Default::default()
    };
    let report = fastlgs::train(&quick, &run).expect("a trained scene");
    assert!(
        report.gaussians > 0 && report.iterations == 200 && report.device.device == "cpu",
        "{report:?}"
    );
    // Reports survive serialisation.
    let text = serde_json::to_string(&report).expect("JSON");
    let again: train::TrainReport = serde_json::from_str(&text).expect("a report");
    let counts = |r: &train::TrainReport| {
        (
            r.gaussians,
            r.objects,
            r.iterations,
            r.preset,
            r.feature_mode,
            r.size.clone(),
            r.device.clone(),
        )
    };
    assert_eq!(counts(&again), counts(&report));
    let config: train::TrainConfig =
        serde_json::from_str(r#"{"scene":"s","preset":"quick","mapping":"paper"}"#)
            .expect("a configuration");
    assert_eq!(
        (config.preset, config.mapping, config.theta),
        (train::Preset::Quick, train::Mapping::Paper, quick.theta)
    );

    let file = |name: &str| std::fs::read(scene.join(name)).expect("a file of the scene");
    let before = [file("scene.ply"), file("grid.json"), file("scene.json")];
    watcher.cancel_enabled.store(true, Ordering::Relaxed);
    watcher.training.store(false, Ordering::Relaxed);
    let longer = train::TrainConfig {
        iterations: Some(5000),
        ..quick
    };
    assert!(matches!(
        fastlgs::train(&longer, &run),
        Err(Error::Cancelled)
    ));
    assert_eq!(
        before,
        [file("scene.ply"), file("grid.json"), file("scene.json")],
        "a cancelled run leaves the scene unchanged"
    );
    assert_eq!(
        Scene::open(&scene, "cpu")
            .expect("the scene")
            .gaussians()
            .len(),
        report.gaussians
    );

    let heard = watcher.stages.lock().expect("no panic");
    for stage in [
        "synth",
        "photos",
        "masks",
        "embeddings",
        "matches",
        "train",
        "votes",
        "objects",
    ] {
        let place = |what: &str| {
            heard
                .iter()
                .position(|line| *line == format!("{stage} {what}"))
        };
        assert!(
            place("begins").is_some() && place("begins") < place("ends"),
            "{stage}: {heard:?}"
        );
    }
}

/// Returns the rotations between consecutive cameras. They do not depend on the coordinate system.
fn turns(cameras: &[Camera]) -> Vec<Quat> {
    let turn = |c: &Camera| Quat::from_mat4(&c.world_to_camera);
    cameras
        .windows(2)
        .map(|pair| turn(&pair[1]) * turn(&pair[0]).inverse())
        .collect()
}

/// Returns the mean difference of these rotations between two sets of cameras, in pixels of the
/// picture.
fn rotation_error(a: &[Camera], b: &[Camera]) -> f32 {
    let angles = turns(a)
        .into_iter()
        .zip(turns(b))
        .map(|(a, b)| a.angle_between(b));
    a[0].fx * angles.sum::<f32>() / (a.len() - 1) as f32
}

/// `preprocess` removes small random rotations of the cameras, unless it must keep the poses.
#[test]
fn noise_on_poses_is_removed() {
    if !models_are_there() {
        return;
    }
    let dir = tempfile::tempdir().expect("a temporary folder");
    let photos = dir.path().join("photos");
    let run = Run::silent("cpu", 3);
    let made = synth::SynthConfig {
        kind: "table".into(),
        output: photos.clone(),
        views: Some(30),
        size: (320, 240),
        ..Default::default()
    };
    fastlgs::synth(&made, &run).expect("a generated scene");
    let preprocessed = |name: &str, poses: preprocess::Poses| {
        let scene = dir.path().join(name);
        let mut config = preprocess::PreprocessConfig {
            photos: photos.clone(),
            output: scene.clone(),
            poses,
            ..Default::default()
        };
        config.eyes.segmenter = fastlgs::model_choice::SegmenterKind::Import;
        let report = fastlgs::preprocess(&config, &run).expect("a preprocessed scene");
        (SceneFolder::new(scene).cameras().expect("cameras"), report)
    };
    let (truth, report) = preprocessed("exact", preprocess::Poses::Check);
    assert!(
        report.adjusted.is_some_and(|a| !a.used),
        "exact poses are kept: {:?}",
        report.adjusted
    );

    let file = photos.join("transforms.json");
    let mut transforms: serde_json::Value =
        serde_json::from_slice(&std::fs::read(&file).expect("poses")).expect("JSON");
    let mut rng = Rng::new(1, "noise");
    for frame in transforms["frames"].as_array_mut().expect("frames") {
        let rows: [[f32; 4]; 4] =
            serde_json::from_value(frame["transform_matrix"].clone()).expect("a matrix");
        let deviation = 3.0 / truth[0].fx;
        let turn =
            Quat::from_scaled_axis(deviation * Vec3::new(rng.normal(), rng.normal(), rng.normal()));
        let moved =
            (Mat4::from_cols_array_2d(&rows).transpose() * Mat4::from_quat(turn)).transpose();
        frame["transform_matrix"] = serde_json::json!(moved.to_cols_array_2d());
    }
    std::fs::write(&file, transforms.to_string()).expect("poses");
    let (kept, report) = preprocessed("kept", preprocess::Poses::Keep);
    assert_eq!(report.adjusted, None);
    let (adjusted, report) = preprocessed("checked", preprocess::Poses::Check);
    let how = report.adjusted.expect("adjusted poses");
    assert!(
        how.used && how.error_after < 0.9 * how.error_before && how.moved_median > 1.0,
        "{how:?}"
    );
    let [before, after] = [
        rotation_error(&kept, &truth),
        rotation_error(&adjusted, &truth),
    ];
    assert!(
        before > 5.0 && after < 0.1 * before,
        "{before} px before, {after} after"
    );
}

/// Cameras that training moved belong to its Gaussians. A run that starts from these Gaussians
/// keeps them, a new training starts from the given cameras.
#[test]
fn moved_cameras_stay_with_their_gaussians() {
    if !models_are_there() {
        return;
    }
    let dir = tempfile::tempdir().expect("a temporary folder");
    let (photos, scene) = (dir.path().join("photos"), dir.path().join("scene"));
    let run = Run::silent("cpu", 5);
    let made = synth::SynthConfig {
        kind: "table".into(),
        output: photos.clone(),
        views: Some(10),
        size: (96, 72),
        ..Default::default()
    };
    fastlgs::synth(&made, &run).expect("a generated scene");
    let mut config = preprocess::PreprocessConfig {
        photos,
        output: scene.clone(),
        ..Default::default()
    };
    config.eyes.segmenter = fastlgs::model_choice::SegmenterKind::Import;
    fastlgs::preprocess(&config, &run).expect("a preprocessed scene");
    let cameras = || SceneFolder::new(&scene).cameras().expect("cameras");
    let given = cameras();

    let moving = train::TrainConfig {
        scene: scene.clone(),
        iterations: Some(100),
        budget: Some(1500),
        align: train::Switch::On,
        ..Default::default()
    };
    assert!(
        fastlgs::train(&moving, &run)
            .expect("a trained scene")
            .aligned
    );
    let moved = cameras();
    assert_ne!(moved, given);
    let lifting = train::TrainConfig {
        iterations: Some(0),
        init: Some(scene.join("scene.ply")),
        align: train::Switch::Auto,
        ..moving.clone()
    };
    assert!(
        fastlgs::train(&lifting, &run)
            .expect("a lifted scene")
            .aligned
    );
    assert_eq!(
        cameras(),
        moved,
        "objects are lifted with the cameras that the Gaussians were trained with"
    );
    let anew = train::TrainConfig {
        align: train::Switch::Auto,
        ..moving
    };
    let report = fastlgs::train(&anew, &run).expect("a trained scene");
    assert!(
        !report.aligned && report.alignment_gain.is_none(),
        "no validation views were held out: {report:?}"
    );
    assert_eq!(cameras(), given);
}

#[test]
fn errors_name_the_file_and_the_remedy() {
    let missing = Path::new("/nowhere/photos");
    let config = preprocess::PreprocessConfig {
        photos: missing.into(),
        output: "/nowhere/scene".into(),
        ..Default::default()
    };
    let error = fastlgs::preprocess(&config, &Run::silent("cpu", 0)).expect_err("no photos");
    assert!(
        fastlgs::one_sentence(&error).contains("/nowhere/photos"),
        "{error}"
    );
    let error = fastlgs::train(
        &train::TrainConfig {
            scene: missing.into(),
            ..Default::default()
        },
        &Run::silent("cpu", 0),
    )
    .expect_err("no scene");
    assert!(
        fastlgs::one_sentence(&error).contains("fastlgs preprocess"),
        "{error}"
    );
}
