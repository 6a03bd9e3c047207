//! The pipeline as a library: typed reports, messages, and what a cancelled run leaves.
//!
//! Needs the offline models; skips loudly without them unless FASTLGS_REQUIRE_MODELS is set.

use fastlgs::progress::{Message, Sink};
use fastlgs::{Error, Run, Session, preprocess, synth, train};
use std::path::Path;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};

/// Notes what it hears; once told to, cancels when training has begun.
#[derive(Default)]
struct Watcher {
    heard: Mutex<Vec<String>>,
    impatient: AtomicBool,
    training: AtomicBool,
}

impl Sink for Watcher {
    fn tell(&self, message: Message<'_>) {
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
        self.heard.lock().expect("no panic").push(line);
    }

    fn cancelled(&self) -> bool {
        self.impatient.load(Ordering::Relaxed) && self.training.load(Ordering::Relaxed)
    }
}

#[test]
fn stages_report_and_a_cancelled_one_leaves_the_scene_as_it_was() {
    if !fastlgs_vision::models::offline_installed() {
        assert!(std::env::var_os("FASTLGS_REQUIRE_MODELS").is_none(), "the offline models are missing");
        eprintln!("SKIPPED: needs the offline models");
        return;
    }
    let dir = tempfile::tempdir().expect("a temporary folder");
    let (photos, scene) = (dir.path().join("photos"), dir.path().join("scene"));
    let watcher = Watcher::default();
    let run = Run { progress: &watcher, ..Run::silent("cpu", 7) };
    let made = synth::Config { kind: "table".into(), output: photos.clone(), views: Some(12), size: (96, 72), ..Default::default() };
    assert_eq!(fastlgs::synth(&made, &run).expect("a generated scene").views, 12);

    let mut config = preprocess::Config { photos, output: scene.clone(), ..Default::default() };
    config.eyes.segmenter = fastlgs::eyes::SegmenterKind::Import;
    let report = fastlgs::preprocess(&config, &run).expect("a preprocessed scene");
    assert_eq!((report.photos, report.training_photos, report.size.as_str()), (12, 10, "96x72"));

    let quick = train::Config { scene: scene.clone(), iterations: Some(200), budget: Some(1500), ..Default::default() };
    let report = fastlgs::train(&quick, &run).expect("a trained scene");
    assert!(report.gaussians > 0 && report.iterations == 200 && report.device.device == "cpu", "{report:?}");
    // Reports are data: what is written is what is read.
    let text = serde_json::to_string(&report).expect("JSON");
    let again: train::Report = serde_json::from_str(&text).expect("a report");
    let counts = |r: &train::Report| (r.gaussians, r.objects, r.iterations, r.preset, r.feature_mode, r.size.clone(), r.device.clone());
    assert_eq!(counts(&again), counts(&report));
    let config: train::Config = serde_json::from_str(r#"{"scene":"s","preset":"quick","mapping":"paper"}"#).expect("a configuration");
    assert_eq!((config.preset, config.mapping, config.theta), (train::Preset::Quick, train::Mapping::Paper, quick.theta));

    let file = |name: &str| std::fs::read(scene.join(name)).expect("a file of the scene");
    let before = [file("scene.ply"), file("grid.json"), file("scene.json")];
    watcher.impatient.store(true, Ordering::Relaxed);
    watcher.training.store(false, Ordering::Relaxed);
    let longer = train::Config { iterations: Some(5000), ..quick };
    assert!(matches!(fastlgs::train(&longer, &run), Err(Error::Cancelled)));
    assert_eq!(before, [file("scene.ply"), file("grid.json"), file("scene.json")], "a cancelled run leaves the earlier scene");
    assert_eq!(Session::open(&scene, "cpu").expect("the scene").gaussians.len(), report.gaussians);

    let heard = watcher.heard.lock().expect("no panic");
    for stage in ["synth", "photos", "masks", "embeddings", "matches", "train", "votes", "objects"] {
        let place = |what: &str| heard.iter().position(|line| *line == format!("{stage} {what}"));
        assert!(place("begins").is_some() && place("begins") < place("ends"), "{stage}: {heard:?}");
    }
}

#[test]
fn errors_name_the_file_and_the_mend() {
    let missing = Path::new("/nowhere/photos");
    let config = preprocess::Config { photos: missing.into(), output: "/nowhere/scene".into(), ..Default::default() };
    let error = fastlgs::preprocess(&config, &Run::silent("cpu", 0)).expect_err("no photos");
    assert!(fastlgs::one_sentence(&error).contains("/nowhere/photos"), "{error}");
    let error =
        fastlgs::train(&train::Config { scene: missing.into(), ..Default::default() }, &Run::silent("cpu", 0)).expect_err("no scene");
    assert!(fastlgs::one_sentence(&error).contains("fastlgs preprocess"), "{error}");
}
