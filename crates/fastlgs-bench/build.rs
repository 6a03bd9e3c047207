//! Embeds commit and date of the measured code: the last one that changed anything but what measures, the bench and
//! `fastlgs eval`.

use std::process::Command;

fn main() {
    // A new commit changes this log.
    println!("cargo:rerun-if-changed=../../.git/logs/HEAD");
    println!("cargo:rerun-if-changed=..");
    println!("cargo:rerun-if-changed=../../shaders");
    let git = |args: &[&str]| {
        let paths = [
            "--",
            "crates",
            "shaders",
            "Cargo.toml",
            "Cargo.lock",
            ":!crates/fastlgs-bench",
            ":!crates/fastlgs/src/eval",
        ];
        let output = Command::new("git")
            .current_dir("../..")
            .args(args)
            .args(paths)
            .output();
        let output = output.ok().filter(|output| output.status.success());
        output.map(|output| String::from_utf8_lossy(&output.stdout).trim().to_owned())
    };
    let commit = git(&["log", "-1", "--format=%h of %cs"]).unwrap_or_default();
    let changed = git(&["status", "--porcelain"]).is_some_and(|changes| !changes.is_empty());
    let version = match (commit.is_empty(), changed) {
        (true, _) => "unknown",
        (false, true) => "with uncommitted changes",
        (false, false) => &commit,
    };
    println!("cargo:rustc-env=FASTLGS_COMMIT={version}");
}
