//! This program, started again for one step of a larger work: each step is what a user could have typed.

use crate::ui;
use anyhow::{Context, Result, bail};
use serde_json::Value;
use std::process::Command;

/// Runs `fastlgs COMMAND ARGS` with the same device, and `seed`; returns its report.
pub fn call(common: &ui::Common, seed: u64, command: &str, args: &[&str]) -> Result<Value> {
    let program = std::env::current_exe().context("this program's own file")?;
    let mut call = Command::new(program);
    call.arg(command).args(args).args(["--json", "-", "-q", "--device", &common.device, "--seed", &seed.to_string()]);
    let output = call.output().context("the program cannot be started again")?;
    if !output.status.success() {
        bail!("fastlgs {command} {}: {}", args.join(" "), String::from_utf8_lossy(&output.stderr).trim());
    }
    serde_json::from_slice(&output.stdout).with_context(|| format!("fastlgs {command} gave no report"))
}
