//! Runs the binary. Not every test needs all of this.
#![allow(dead_code)]

use serde_json::Value;
use std::path::Path;
use std::process::{Command, Output};

pub fn fastlgs(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_fastlgs")).args(args).output().expect("the binary starts")
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
