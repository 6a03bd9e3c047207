//! Runs the binary, on the machine's adapter unless a test names another device. Not every test needs all of this.
#![allow(dead_code)]

use fastlgs_core::label_map::LabelMap;
use fastlgs_core::metrics;
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::OnceLock;
use std::time::UNIX_EPOCH;

const PROGRAM: &str = env!("CARGO_BIN_EXE_fastlgs");

/// The first adapter by name: what `--device auto` would pass over, if the processor is faster, is what must be tested.
pub fn adapter() -> &'static str {
    static ADAPTER: OnceLock<String> = OnceLock::new();
    ADAPTER.get_or_init(|| {
        let output = Command::new(PROGRAM).args(["info", "--json", "-"]).output().expect("the binary starts");
        let info: Value = serde_json::from_slice(&output.stdout).expect("JSON");
        info["adapters"][0].as_str().unwrap_or("auto").to_owned()
    })
}

/// Where what a test program teaches is kept: it is none of the user's names.
pub fn data() -> PathBuf {
    Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("data-{}", env!("CARGO_CRATE_NAME")))
}

pub fn fastlgs(args: &[&str]) -> Output {
    Command::new(PROGRAM).env("FASTLGS_DEVICE", adapter()).env("FASTLGS_DATA", data()).args(args).output().expect("the binary starts")
}

/// Whether everything is to be tested (`./test.sh --all`), or a smaller dose of what takes long.
pub fn all() -> bool {
    std::env::var_os("FASTLGS_TEST_ALL").is_some()
}

/// The generated room with exact masks, trained on the adapter: `photos` and `scene`. Made once for all test programs of a build, which
/// leave it as it is.
pub struct Room {
    pub photos: PathBuf,
    pub scene: PathBuf,
}

/// The room; nothing where models or device are missing.
pub fn room() -> Option<&'static Room> {
    static ROOM: OnceLock<Option<Room>> = OnceLock::new();
    let make = || {
        if !ready() {
            return None;
        }
        let program = std::fs::metadata(PROGRAM).expect("the binary");
        let built = program.modified().expect("a time").duration_since(UNIX_EPOCH).expect("after 1970").as_nanos();
        let fixtures = Path::new(env!("CARGO_TARGET_TMPDIR")).join("fixtures");
        let folder = fixtures.join(format!("room-{}-{built}", program.len()));
        if !folder.is_dir() {
            // Those of earlier builds are of no use.
            let _ = std::fs::remove_dir_all(&fixtures);
            std::fs::create_dir_all(&fixtures).expect("a folder");
            let partial = tempfile::tempdir_in(&fixtures).expect("a folder");
            let (photos, scene) = (partial.path().join("photos"), partial.path().join("room"));
            json(&["synth", "room", "-o", text(&photos), "--views", "32", "--size", "320x240"]);
            let report = json(&["preprocess", text(&photos), "-o", text(&scene), "--segmenter", "import"]);
            assert_eq!((report["photos"].as_u64(), report["held_out"].as_u64()), (Some(32), Some(4)));
            assert_eq!(report["moved_cameras"], 0, "all blocks look alike from four sides, and yet the poses are exact: {report}");
            let report = json(&["train", text(&scene), "--iterations", "900", "--budget", "15000"]);
            assert!(report["psnr_held_out"].as_f64().expect("a number") > 19.0, "{report}");
            assert_eq!(report["device"]["device"], adapter());
            std::fs::rename(partial.keep(), &folder).expect("the finished fixture takes its place");
        }
        Some(Room { photos: folder.join("photos"), scene: folder.join("room") })
    };
    ROOM.get_or_init(make).as_ref()
}

/// The room, and a folder of a test program's own.
pub struct Fixture {
    pub dir: tempfile::TempDir,
    pub photos: PathBuf,
    pub scene: PathBuf,
}

/// The generated room that all test programs share, and a folder of these tests' own.
pub fn fixture() -> Option<&'static Fixture> {
    static FIXTURE: OnceLock<Option<Fixture>> = OnceLock::new();
    let make = || {
        let room = room()?;
        let dir = tempfile::tempdir().expect("a temporary folder");
        Some(Fixture { dir, photos: room.photos.clone(), scene: room.scene.clone() })
    };
    FIXTURE.get_or_init(make).as_ref()
}

/// IoU of an answer's mask with the coffee's exact one in view 008.
pub fn coffee_iou(f: &Fixture, answer: &Value) -> f64 {
    let mask = LabelMap::load(Path::new(answer["mask"].as_str().expect("a path"))).expect("the mask is a grey PNG");
    let truth = LabelMap::load(&f.photos.join("masks/008.png.png")).expect("exact masks");
    let found: Vec<bool> = mask.labels.iter().map(|m| *m > 0).collect();
    metrics::iou(&found, &truth.mask(2))
}

pub fn json(args: &[&str]) -> Value {
    let mut all = args.to_vec();
    all.extend(["--json", "-"]);
    let output = fastlgs(&all);
    assert!(output.status.success(), "{args:?}: {}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap_or_else(|e| panic!("{args:?}: {e}"))
}

/// The one line that says what went wrong, after an exit with code 1.
pub fn complaint(args: &[&str], output: &Output) -> String {
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(1), "{args:?}: {said}");
    assert!(!said.contains("panicked"), "{said}");
    let line = said.lines().find(|l| l.starts_with("error: ")).unwrap_or_else(|| panic!("{args:?} gives no message: {said}"));
    line.to_owned()
}

/// Fails with exit code 1 and one line that holds all `words`.
pub fn fails(args: &[&str], words: &[&str]) {
    let line = complaint(args, &fastlgs(args));
    assert!(words.iter().all(|w| line.contains(w)), "{args:?}: '{line}' lacks one of {words:?}");
}

pub fn text(path: &Path) -> &str {
    path.to_str().expect("a UTF-8 path")
}

/// Whether models and device are there; skips loudly without them, unless FASTLGS_REQUIRE_GPU makes them a must.
pub fn ready() -> bool {
    let ready = json(&["info"]);
    let complete = ready["offline_models"] == true && ready["adapters"].as_array().is_some_and(|a| !a.is_empty());
    if !complete {
        assert!(std::env::var_os("FASTLGS_REQUIRE_GPU").is_none(), "models or device are missing: {ready}");
        eprintln!("SKIPPED: needs the offline models and a Vulkan device: {ready}");
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
            std::fs::copy(entry.path(), &target).map(|_| ()).expect("a copy")
        }
    }
}
