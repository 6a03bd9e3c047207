//! Runs the binary on the first adapter, unless a test names another device.
// Not every test program uses all functions.
#![allow(dead_code)]

#[path = "skip.rs"]
mod skip;

use fastlgs_core::label_map::LabelMap;
use fastlgs_core::metrics;
use serde_json::Value;
pub use skip::skip;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::OnceLock;
use std::time::UNIX_EPOCH;

const PROGRAM: &str = env!("CARGO_BIN_EXE_fastlgs");

/// Returns the name of the first adapter. Tests must cover it even if `--device auto` would prefer
/// the processor.
pub fn adapter() -> &'static str {
    static ADAPTER: OnceLock<String> = OnceLock::new();
    ADAPTER.get_or_init(|| {
        let output = Command::new(PROGRAM)
            .args(["info", "--json", "-"])
            .output()
            .expect("the binary starts");
        let info: Value = serde_json::from_slice(&output.stdout).expect("JSON");
        info["adapters"][0].as_str().unwrap_or("auto").to_owned()
    })
}

/// Returns the folder of taught names of this test program, so that the user's names stay
/// untouched.
pub fn data() -> PathBuf {
    Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("data-{}", env!("CARGO_CRATE_NAME")))
}

pub fn fastlgs(args: &[&str]) -> Output {
    Command::new(PROGRAM)
        .env("FASTLGS_DEVICE", adapter())
        .env("FASTLGS_DATA", data())
        .args(args)
        .output()
        .expect("the binary starts")
}

/// Returns whether the full tests run (`./test.sh --all`). Otherwise slow tests are shortened.
pub fn full_tests() -> bool {
    std::env::var_os("FASTLGS_TEST_ALL").is_some()
}

/// The generated room with exact masks, trained on the CPU. It is made once per build, and all
/// test programs share it. Tests must not change it.
pub struct Room {
    pub photos: PathBuf,
    pub scene: PathBuf,
}

/// Returns the room. `None` without models or device.
pub fn room() -> Option<&'static Room> {
    static ROOM: OnceLock<Option<Room>> = OnceLock::new();
    let make = || {
        if !requirements_met() {
            return None;
        }
        let program = std::fs::metadata(PROGRAM).expect("the binary");
        let built = program
            .modified()
            .expect("a time")
            .duration_since(UNIX_EPOCH)
            .expect("after 1970")
            .as_nanos();
        let fixtures = Path::new(env!("CARGO_TARGET_TMPDIR")).join("fixtures");
        let folder = fixtures.join(format!("room-{}-{built}", program.len()));
        if !folder.is_dir() {
            // The fixtures of earlier builds are obsolete.
            let _ = std::fs::remove_dir_all(&fixtures);
            std::fs::create_dir_all(&fixtures).expect("a folder");
            let partial = tempfile::tempdir_in(&fixtures).expect("a folder");
            let (photos, scene) = (partial.path().join("photos"), partial.path().join("room"));
            json(&[
                "synth",
                "room",
                "-o",
                text(&photos),
                "--views",
                "32",
                "--size",
                "320x240",
            ]);
            let report = json(&[
                "preprocess",
                text(&photos),
                "-o",
                text(&scene),
                "--segmenter",
                "import",
            ]);
            assert_eq!(
                (report["photos"].as_u64(), report["held_out"].as_u64()),
                (Some(32), Some(4))
            );
            assert_eq!(
                report["moved_cameras"], 0,
                "exact poses must stay, although the blocks look the same from four sides: {report}"
            );
            let report = json(&[
                "train",
                text(&scene),
                "--iterations",
                "900",
                "--budget",
                "15000",
                "--device",
                "cpu",
            ]);
            assert!(
                report["psnr_held_out"].as_f64().expect("a number") > 19.0,
                "{report}"
            );
            std::fs::rename(partial.keep(), &folder).expect("the finished fixture takes its place");
        }
        Some(Room {
            photos: folder.join("photos"),
            scene: folder.join("room"),
        })
    };
    ROOM.get_or_init(make).as_ref()
}

/// The shared room, and a folder of this test program.
pub struct Fixture {
    pub dir: tempfile::TempDir,
    pub photos: PathBuf,
    pub scene: PathBuf,
}

/// Returns the shared room, and a folder of this test program. `None` without models or device.
pub fn fixture() -> Option<&'static Fixture> {
    static FIXTURE: OnceLock<Option<Fixture>> = OnceLock::new();
    let make = || {
        let room = room()?;
        let dir = tempfile::tempdir().expect("a temporary folder");
        Some(Fixture {
            dir,
            photos: room.photos.clone(),
            scene: room.scene.clone(),
        })
    };
    FIXTURE.get_or_init(make).as_ref()
}

/// Returns the IoU of an answer's mask and the exact mask of the coffee in view 008.
pub fn coffee_iou(f: &Fixture, answer: &Value) -> f64 {
    let mask = LabelMap::load(Path::new(answer["mask"].as_str().expect("a path")))
        .expect("the mask is a grey PNG");
    let truth = LabelMap::load(&f.photos.join("masks/008.png.png")).expect("exact masks");
    let found: Vec<bool> = mask.labels.iter().map(|m| *m > 0).collect();
    metrics::iou(&found, &truth.mask(2))
}

pub fn json(args: &[&str]) -> Value {
    let mut all = args.to_vec();
    all.extend(["--json", "-"]);
    let output = fastlgs(&all);
    assert!(
        output.status.success(),
        "{args:?}: {}",
        String::from_utf8_lossy(&output.stderr)
    );
    serde_json::from_slice(&output.stdout).unwrap_or_else(|e| panic!("{args:?}: {e}"))
}

/// Asserts exit code 1, and returns the line with the error message.
pub fn error_line(args: &[&str], output: &Output) -> String {
    let printed = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(1), "{args:?}: {printed}");
    assert!(!printed.contains("panicked"), "{printed}");
    let line = printed
        .lines()
        .find(|l| l.starts_with("error: "))
        .unwrap_or_else(|| panic!("{args:?} prints no error message: {printed}"));
    line.to_owned()
}

/// Asserts that a command fails with exit code 1 and one line that contains all `words`.
pub fn assert_fails(args: &[&str], words: &[&str]) {
    let line = error_line(args, &fastlgs(args));
    assert!(
        words.iter().all(|w| line.contains(w)),
        "{args:?}: '{line}' lacks one of {words:?}"
    );
}

pub fn text(path: &Path) -> &str {
    path.to_str().expect("a UTF-8 path")
}

/// Returns whether models and device exist. If not, prints a message, or fails if
/// FASTLGS_REQUIRE_GPU is set.
pub fn requirements_met() -> bool {
    let ready = json(&["info"]);
    let complete = ready["offline_models"] == true
        && ready["adapters"].as_array().is_some_and(|a| !a.is_empty());
    if !complete {
        assert!(
            std::env::var_os("FASTLGS_REQUIRE_GPU").is_none(),
            "models or device are missing: {ready}"
        );
        skip(format_args!(
            "needs the offline models and a Vulkan device: {ready}"
        ));
    }
    complete
}

pub fn copy_folder(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).expect("a folder");
    for entry in std::fs::read_dir(from).expect("a folder").flatten() {
        let target = to.join(entry.file_name());
        if entry.path().is_dir() {
            copy_folder(&entry.path(), &target)
        } else {
            std::fs::copy(entry.path(), &target)
                .map(|_| ())
                .expect("a copy")
        }
    }
}
