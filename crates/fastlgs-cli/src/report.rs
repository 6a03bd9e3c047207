//! Output of reports: as text, or as JSON with `--json`.

use crate::outcome::Outcome;
use crate::ui::{self, Common, print_line};
use anyhow::{Context, Result};
use serde::Serialize;
use serde_json::Value;
use std::path::Path;

/// Writes a report as JSON if `--json` is given; otherwise prints its summary by `words`.
pub fn write_summary<R: Serialize>(
    common: &Common,
    report: &R,
    words: impl FnOnce(&R) -> String,
) -> Result<Outcome> {
    if common.json.is_some() {
        return write_fields(common, report);
    }
    if !common.quiet {
        print_line!("{}", words(report));
    }
    Ok(Outcome::Done)
}

/// Writes a report as JSON if `--json` is given; otherwise prints a table of its fields.
pub fn write_fields(common: &Common, report: &impl Serialize) -> Result<Outcome> {
    let value = &serde_json::to_value(report)?;
    match common.json.as_deref() {
        Some(path) if path == Path::new("-") => {
            ui::write_line(format_args!("{}", serde_json::to_string_pretty(value)?))?
        }
        Some(path) => {
            fastlgs_core::fs::write_json(path, value).context("cannot write the report")?
        }
        None if common.quiet => {}
        None => print_table(value, 0),
    }
    Ok(Outcome::Done)
}

fn print_table(value: &Value, indent: usize) {
    let Value::Object(map) = value else {
        return print_line!("{value}");
    };
    let width = map.keys().map(String::len).max().unwrap_or(0);
    for (name, value) in map {
        match value {
            Value::Object(_) => {
                print_line!("{:indent$}{name}", "");
                print_table(value, indent + 2);
            }
            Value::String(text) => print_line!("{:indent$}{name:width$}  {text}", ""),
            Value::Number(n) if n.is_f64() => print_line!(
                "{:indent$}{name:width$}  {:.4}",
                "",
                n.as_f64().unwrap_or(f64::NAN)
            ),
            other => print_line!("{:indent$}{name:width$}  {other}", ""),
        }
    }
}
