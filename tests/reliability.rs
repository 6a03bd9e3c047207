//! Reliability under external faults: killed processes, full disks, unwritable folders, many
//! simultaneous users.

#[path = "support/run.rs"]
mod run;

use run::{copy_folder, error_line, json, text};
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::OnceLock;

/// A small trained scene. `dir` also holds its `photos` and the `untrained` scene.
struct Fixture {
    dir: tempfile::TempDir,
    trained: PathBuf,
}

const TRAINING: [&str; 6] = [
    "--iterations",
    "1200",
    "--budget",
    "2500",
    "--device",
    "cpu",
];

fn fixture() -> Option<&'static Fixture> {
    static FIXTURE: OnceLock<Option<Fixture>> = OnceLock::new();
    FIXTURE
        .get_or_init(|| {
            if !run::requirements_met() {
                return None;
            }
            let dir = tempfile::tempdir().expect("a temporary folder");
            let (photos, trained) = (dir.path().join("photos"), dir.path().join("trained"));
            json(&[
                "synth",
                "table",
                "-o",
                text(&photos),
                "--views",
                "14",
                "--size",
                "128x96",
            ]);
            json(&[
                "preprocess",
                text(&photos),
                "-o",
                text(&trained),
                "--segmenter",
                "import",
            ]);
            copy_folder(&trained, &dir.path().join("untrained"));
            json(&[&["train", text(&trained)], &TRAINING[..]].concat());
            Some(Fixture { dir, trained })
        })
        .as_ref()
}

/// Returns the files that training writes.
fn results(scene: &Path) -> [Vec<u8>; 3] {
    ["scene.ply", "grid.json", "grid.safetensors"]
        .map(|f| std::fs::read(scene.join(f)).expect("a file"))
}

/// Runs the binary until it aborts at a stop point, as if it were killed there. Returns whether it
/// was stopped.
fn stopped(args: &[&str], stage: &str, step: u64) -> bool {
    let output = Command::new(env!("CARGO_BIN_EXE_fastlgs"))
        .env("FASTLGS_STOP_AT", format!("{stage}:{step}"))
        .args(args)
        .output()
        .expect("the binary starts");
    let message = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(
        output.status.success() || output.status.code().is_none(),
        "{args:?}: {message}"
    );
    !output.status.success()
}

#[test]
fn training_survives_kills() {
    let Some(f) = fixture() else { return };
    let scene = f.dir.path().join("killed");
    copy_folder(&f.dir.path().join("untrained"), &scene);
    let train = [
        &["train", text(&scene), "--resume", "--quiet"],
        &TRAINING[..],
    ]
    .concat();
    // Before the first checkpoint, after it, after the second, while objects are found, and while
    // the finished scene replaces the earlier one.
    for (stage, step) in [
        ("train", 200),
        ("train", 620),
        ("train", 1100),
        ("votes", 5),
        ("publish", 2),
    ] {
        assert!(stopped(&train, stage, step), "{stage}:{step}");
    }
    json(&train);
    assert!(
        results(&scene) == results(&f.trained),
        "a training that was killed and resumed ends in the same bytes"
    );
}

#[test]
fn a_killed_make_continues() {
    let Some(f) = fixture() else { return };
    let (photos, scene) = (f.dir.path().join("photos"), f.dir.path().join("made"));
    let make = |scene: &Path| -> Vec<String> {
        let options = ["--segmenter", "import", "--device", "cpu"];
        let words = ["make", text(&photos), "-o", text(scene)];
        words
            .iter()
            .chain(&options)
            .map(|word| (*word).to_owned())
            .collect()
    };
    let words = make(&scene);
    let words: Vec<&str> = words.iter().map(String::as_str).collect();
    assert!(stopped(&words, "train", 520));
    let output = run::fastlgs(&[&words[..], &["-v"]].concat());
    let messages = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{messages}");
    assert!(
        messages.contains("training continues from its checkpoint"),
        "{messages}"
    );
    assert_eq!(json(&[&words[..], &["-q"]].concat())["state"], "kept");
    let anew = f.dir.path().join("anew");
    let words = make(&anew);
    json(&words.iter().map(String::as_str).collect::<Vec<_>>());
    assert!(
        results(&scene) == results(&anew),
        "an interrupted make ends in the same bytes"
    );
}

/// Returns the files of a scene, without the manifest, which contains durations.
fn files_of(root: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let folders = ["photos", "cameras", "masks"].map(|folder| root.join(folder));
    let entries = folders
        .iter()
        .flat_map(std::fs::read_dir)
        .flat_map(Iterator::flatten);
    let paths = entries
        .map(|entry| entry.path())
        .chain([root.join("scene.ply")]);
    let content = |path: PathBuf| {
        let name = path.strip_prefix(root).expect("within").to_owned();
        (name, std::fs::read(&path).expect("a file"))
    };
    paths.filter(|path| path.is_file()).map(content).collect()
}

#[test]
fn an_interrupted_preprocess_keeps_the_scene() {
    let Some(f) = fixture() else { return };
    let scene = f.dir.path().join("begun");
    copy_folder(&f.trained, &scene);
    let photos = f.dir.path().join("photos");
    let manifest = |root: &Path| std::fs::read(root.join("scene.json")).ok();
    let before = (files_of(&scene), manifest(&scene));
    let smaller = |scene: &Path| -> Vec<String> {
        let options = [
            "--max-side",
            "96",
            "--segmenter",
            "import",
            "--device",
            "cpu",
        ];
        let words = ["preprocess", text(&photos), "-o", text(scene)];
        words
            .iter()
            .chain(&options)
            .map(|word| (*word).to_owned())
            .collect()
    };
    let words = smaller(&scene);
    let words: Vec<&str> = words.iter().map(String::as_str).collect();

    let labels = f.dir.path().join("labels-of-others");
    std::fs::create_dir_all(&labels).expect("a folder");
    let label = std::fs::read_to_string(photos.join("labels/000.json")).expect("a label");
    std::fs::write(labels.join("999.json"), label.replace("000", "999")).expect("a label");
    let with_labels = [&words[..], &["--holdout-labels", text(&labels)]].concat();
    run::assert_fails(&with_labels, &["999", "none of the photos"]);
    assert!(
        (files_of(&scene), manifest(&scene)) == before,
        "labels of other photos"
    );

    for (stage, step) in [("photos", 3), ("matches", 5), ("masks", 10)] {
        assert!(stopped(&words, stage, step), "{stage}:{step}");
        assert!(
            (files_of(&scene), manifest(&scene)) == before,
            "killed at {stage}:{step}"
        );
    }
    // The manifest is moved away first and comes last. Until then the next run restores the scene.
    for step in [1, 5, 40] {
        assert!(stopped(&words, "publish", step), "publish:{step}");
        assert!(manifest(&scene).is_none(), "publish:{step}");
        assert!(stopped(&words, "photos", 1), "the next run");
        assert!(
            (files_of(&scene), manifest(&scene)) == before,
            "restored after publish:{step}"
        );
    }
    let anew = f.dir.path().join("begun-anew");
    copy_folder(&f.trained, &anew);
    let other = smaller(&anew);
    json(&other.iter().map(String::as_str).collect::<Vec<_>>());
    json(&words);
    assert!(files_of(&scene) == files_of(&anew) && files_of(&scene) != before.0);
    assert!(!scene.join("preprocess.partial").exists());
}

#[test]
fn a_full_disk_leaves_earlier_results_whole() {
    let Some(f) = fixture() else { return };
    let scene = f.dir.path().join("full");
    copy_folder(&f.trained, &scene);
    let before = results(&scene);
    // Limits files to 64 blocks of 512 or 1024 bytes, also for root. The shell ignores the signal
    // XFSZ, which the kernel sends at the limit.
    let limited = |args: &[&str]| {
        let script = "trap '' XFSZ; ulimit -f 64; exec \"$0\" \"$@\"";
        Command::new("sh")
            .args(["-c", script, env!("CARGO_BIN_EXE_fastlgs")])
            .args(args)
            .output()
            .expect("a shell")
    };
    let (small, ply) = (f.dir.path().join("small"), f.dir.path().join("out.ply"));
    std::fs::write(&ply, "earlier").expect("a file");
    let train = [&["train", text(&scene)], &TRAINING[..]].concat();
    let mut tried = 0;
    for (args, word) in [
        (train.as_slice(), "train"),
        (&["export", text(&scene), text(&ply)], "out.ply"),
        (&["export", text(&scene), text(&small)], "small"),
    ] {
        let line = error_line(args, &limited(args));
        assert!(
            line.contains("too large") || line.contains("No space"),
            "{line}"
        );
        assert!(
            line.contains(word) || line.contains(text(&scene)),
            "the message names the file: {line}"
        );
        tried += 1;
    }
    assert!(results(&scene) == before, "the earlier scene is unchanged");
    assert_eq!(std::fs::read(&ply).expect("the earlier file"), b"earlier");
    json(&[
        "query",
        text(&scene),
        "table",
        "--false-alarms",
        "1",
        "--device",
        "cpu",
    ]);
    println!("full disk: {tried} commands failed, earlier results unchanged");
}

#[test]
fn unwritable_output_paths_are_reported() {
    let Some(f) = fixture() else { return };
    let scene = text(&f.trained);
    // Nobody can write there, not even root.
    let nowhere = "/proc/fastlgs";
    let mut tried = 0;
    for args in [
        vec![
            "synth", "twins", "-o", nowhere, "--views", "4", "--size", "16x12",
        ],
        vec![
            "preprocess",
            text(&f.dir.path().join("photos")),
            "-o",
            nowhere,
            "--segmenter",
            "import",
        ],
        vec!["render", scene, "-o", nowhere, "--device", "cpu"],
        vec![
            "query",
            scene,
            "table",
            "--false-alarms",
            "1",
            "-o",
            nowhere,
            "--device",
            "cpu",
        ],
        vec!["export", scene, "/proc/fastlgs/out.ply", "--device", "cpu"],
        vec![
            "eval",
            scene,
            "--json",
            "/proc/fastlgs/report.json",
            "--device",
            "cpu",
        ],
    ] {
        let line = error_line(&args, &run::fastlgs(&args));
        assert!(line.contains(nowhere), "{args:?}: {line}");
        tried += 1;
    }
    println!("unwritable output: {tried} commands failed");
}

#[test]
fn many_queries_at_once_agree() {
    let Some(f) = fixture() else { return };
    const USERS: usize = 24;
    let out = |user: usize| f.dir.path().join(format!("user-{user}"));
    let ask = |user: usize| {
        Command::new(env!("CARGO_BIN_EXE_fastlgs"))
            .args([
                "query",
                text(&f.trained),
                "table",
                "--false-alarms",
                "1",
                "--device",
                "cpu",
                "--json",
                "-",
                "-o",
                text(&out(user)),
            ])
            .stdout(Stdio::piped())
            .spawn()
            .expect("the binary starts")
    };
    let children: Vec<_> = (0..USERS).map(ask).collect();
    let answers: Vec<(Value, Vec<u8>)> = children
        .into_iter()
        .map(|child| {
            let output = child.wait_with_output().expect("an end");
            assert!(output.status.success());
            let mut answer: Value = serde_json::from_slice(&output.stdout).expect("JSON");
            let mask = std::fs::read(answer["mask"].as_str().expect("a path")).expect("the mask");
            // Times and paths differ.
            ["ms", "mask", "overlay", "heatmap"]
                .iter()
                .for_each(|k| drop(answer.as_object_mut().expect("an object").remove(*k)));
            (answer, mask)
        })
        .collect();
    assert!(
        answers.iter().all(|a| *a == answers[0]),
        "{:?}",
        answers[0].0
    );
    println!("{USERS} simultaneous queries agree");
}
