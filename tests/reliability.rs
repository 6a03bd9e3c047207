//! Reliability under external faults: killed processes, full disks, unwritable folders, many
//! simultaneous users.

#[path = "support/run.rs"]
mod run;

use fastlgs_core::rng::Rng;
use run::{copy_folder, error_line, json, text};
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::OnceLock;
use std::time::{Duration, Instant};

/// A small preprocessed and trained scene, with the duration of its training.
struct Fixture {
    dir: tempfile::TempDir,
    trained: PathBuf,
    training: Duration,
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
            let started = Instant::now();
            json(&[&["train", text(&trained)], &TRAINING[..]].concat());
            Some(Fixture {
                dir,
                trained,
                training: started.elapsed(),
            })
        })
        .as_ref()
}

/// Returns the files that training writes.
fn results(scene: &Path) -> [Vec<u8>; 3] {
    ["scene.ply", "grid.json", "grid.safetensors"]
        .map(|f| std::fs::read(scene.join(f)).expect("a file"))
}

#[test]
fn training_survives_kills() {
    let Some(f) = fixture() else { return };
    let scene = f.dir.path().join("killed");
    copy_folder(&f.dir.path().join("untrained"), &scene);
    let mut rng = Rng::new(20, "kills");
    let (mut kills, mut resumed, mut finished) = (0, 0, 0);
    // Later runs find a checkpoint more often, because resumed runs start in the middle.
    let target_kills = if run::full_tests() { 20 } else { 5 };
    while kills < target_kills {
        resumed += usize::from(scene.join("checkpoints/train.json").is_file());
        let mut child = Command::new(env!("CARGO_BIN_EXE_fastlgs"))
            .args([&["train", text(&scene), "--resume", "-q"], &TRAINING[..]].concat())
            .stderr(Stdio::null())
            .stdout(Stdio::null())
            .spawn()
            .expect("the binary starts");
        std::thread::sleep(f.training.mul_f32(rng.range(0.05, 0.8)));
        match child.try_wait().expect("a child") {
            Some(status) => {
                assert!(
                    status.success(),
                    "the run after {kills} kills failed: {status}"
                );
                finished += 1;
            }
            None => {
                child.kill().expect("a child");
                child.wait().expect("an end");
                kills += 1;
            }
        }
    }
    json(&[&["train", text(&scene), "--resume"], &TRAINING[..]].concat());
    println!(
        "kills: {kills}, runs with a checkpoint: {resumed}, runs that finished before their kill: {finished}"
    );
    assert!(
        resumed > target_kills / 7,
        "too few runs found a checkpoint: {resumed}"
    );
    assert!(
        results(&scene) == results(&f.trained),
        "a killed and resumed run must give the same bytes"
    );
    let left = std::fs::read_dir(&scene)
        .expect("the scene")
        .flatten()
        .filter(|e| e.file_name().to_string_lossy().contains(".partial"));
    println!("partial files left by kills: {}", left.count());
}

#[test]
fn a_killed_make_goes_on() {
    let Some(f) = fixture() else { return };
    let (photos, scene) = (f.dir.path().join("photos"), f.dir.path().join("made"));
    let make = [
        "make",
        text(&photos),
        "-o",
        text(&scene),
        "--segmenter",
        "import",
        "--device",
        "cpu",
    ];
    let begun = scene.join("checkpoints/train.json");
    let mut child = Command::new(env!("CARGO_BIN_EXE_fastlgs"))
        .args(make)
        .arg("-q")
        .stdout(Stdio::null())
        .spawn()
        .expect("the binary starts");
    while !begun.is_file() {
        let ended = child.try_wait().expect("a child");
        assert!(
            ended.is_none(),
            "the run ended before its first checkpoint: {ended:?}"
        );
        std::thread::sleep(Duration::from_millis(5));
    }
    child.kill().expect("a child");
    child.wait().expect("an end");
    let output = run::fastlgs(&[&make[..], &["-v"]].concat());
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{said}");
    assert!(
        said.contains("training continues from its checkpoint"),
        "{said}"
    );
    assert_eq!(json(&[&make[..], &["-q"]].concat())["state"], "kept");
    let anew = f.dir.path().join("anew");
    json(&[
        "make",
        text(&photos),
        "-o",
        text(&anew),
        "--segmenter",
        "import",
        "--device",
        "cpu",
    ]);
    assert!(
        results(&scene) == results(&anew),
        "a killed and resumed make must give the same bytes"
    );
}

#[test]
fn a_preprocess_that_ends_early_leaves_the_scene_whole() {
    let Some(f) = fixture() else { return };
    let scene = f.dir.path().join("begun");
    copy_folder(&f.trained, &scene);
    let photos = f.dir.path().join("photos");
    // Reads the scene's files without the manifest. The manifest holds seconds, which differ
    // between runs.
    let made = |root: &Path| {
        let folders = ["photos", "cameras", "masks"].map(|folder| root.join(folder));
        let entries = folders
            .iter()
            .flat_map(std::fs::read_dir)
            .flat_map(Iterator::flatten)
            .map(|entry| entry.path());
        let file = |path: PathBuf| {
            (
                path.strip_prefix(root).expect("within").to_owned(),
                std::fs::read(&path).expect("a file"),
            )
        };
        entries
            .filter(|path| path.is_file())
            .chain([root.join("scene.ply")])
            .map(file)
            .collect::<BTreeMap<_, _>>()
    };
    let manifest = |root: &Path| std::fs::read(root.join("scene.json")).ok();
    let all = |root: &Path| (made(root), manifest(root));
    let before = all(&scene);
    let labels = f.dir.path().join("labels-of-others");
    std::fs::create_dir_all(&labels).expect("a folder");
    let label = std::fs::read_to_string(photos.join("labels/000.json")).expect("a label");
    std::fs::write(labels.join("999.json"), label.replace("000", "999")).expect("a label");
    let smaller = [
        "preprocess",
        text(&photos),
        "-o",
        text(&scene),
        "--max-side",
        "96",
        "--segmenter",
        "import",
        "--device",
        "cpu",
    ];
    run::assert_fails(
        &[&smaller[..], &["--holdout-labels", text(&labels)]].concat(),
        &["999", "none of the photos"],
    );
    assert!(
        all(&scene) == before,
        "a run that fails for labels of other photos must not change the scene"
    );
    let anew = f.dir.path().join("begun-anew");
    copy_folder(&f.trained, &anew);
    json(&[
        "preprocess",
        text(&photos),
        "-o",
        text(&anew),
        "--max-side",
        "96",
        "--segmenter",
        "import",
        "--device",
        "cpu",
    ]);
    let after = made(&anew);
    assert!(after != before.0);
    let begin = || {
        Command::new(env!("CARGO_BIN_EXE_fastlgs"))
            .args(smaller)
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
    };
    let end = |mut run: Child| {
        let was_running = run.try_wait().expect("a child").is_none();
        let _ = run.kill();
        run.wait().expect("an end");
        was_running
    };
    let mut kills = 0;
    for wait in [20, 60, 120, 200, 400] {
        let run = begin().expect("the binary starts");
        std::thread::sleep(Duration::from_millis(wait));
        // A run that already moves its output into the scene, or has finished, is tested in the
        // next loop.
        if !end(run) || manifest(&scene) != before.1 {
            break;
        }
        assert!(
            all(&scene) == before,
            "a run killed after {wait} ms must not change the scene"
        );
        kills += 1;
    }
    // Kills runs while or after they move their output into the scene. If the manifest is missing,
    // the next run must restore the earlier scene.
    let mut killed_while_moving = 0;
    for _ in 0..3 {
        std::fs::remove_dir_all(&scene).expect("a scene");
        copy_folder(&f.trained, &scene);
        let mut run = begin().expect("the binary starts");
        while manifest(&scene) == before.1 && run.try_wait().expect("a child").is_none() {}
        end(run);
        if manifest(&scene).is_none() {
            killed_while_moving += 1;
            let run = begin().expect("the binary starts");
            let started = Instant::now();
            while manifest(&scene).is_none() {
                assert!(
                    started.elapsed() < Duration::from_secs(60),
                    "the next run does not restore the earlier scene"
                );
            }
            let had_time = !end(run) || made(&scene) == after;
            assert!(
                had_time || all(&scene) == before,
                "the earlier scene must be restored"
            );
        } else {
            assert!(
                made(&scene) == after,
                "a run killed after moving its manifest must leave a complete scene"
            );
        }
    }
    println!(
        "preprocess: {kills} kills before and {killed_while_moving} of 3 during the final moves, no scene is mixed"
    );
    json(&smaller);
    assert!(kills > 0 && made(&scene) == after && !scene.join("preprocess.partial").exists());
}

#[test]
fn a_full_disk_leaves_earlier_results_whole() {
    let Some(f) = fixture() else { return };
    let scene = f.dir.path().join("full");
    copy_folder(&f.trained, &scene);
    let before = results(&scene);
    // Limits files to 64 blocks of 512 or 1024 bytes, also for root. The shell ignores the signal
    // XFSZ that goes with the limit.
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
fn places_that_cannot_be_written_are_named() {
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
