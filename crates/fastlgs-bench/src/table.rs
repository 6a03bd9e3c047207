//! Writes tables as JSON, CSV and Markdown.

use anyhow::Result;
use fastlgs_core::fs;
use serde_json::{Value, json};
use std::path::Path;

/// Writes `NAME.json`, `NAME.csv` and `NAME.md` into `folder`. CSV and Markdown hold the given
/// columns, JSON holds all values. Returns the content of the JSON file.
pub fn write(folder: &Path, name: &str, columns: &[&str], rows: &[Value]) -> Result<Value> {
    for (ending, framed) in [("md", true), ("csv", false)] {
        let text = text(rows, columns, framed);
        fs::write_atomic(&folder.join(format!("{name}.{ending}")), |out| {
            std::io::Write::write_all(out, text.as_bytes())
        })?;
    }
    let value = json!({ "rows": rows, "chart": folder.join(format!("{name}.svg")) });
    fs::write_json(&folder.join(format!("{name}.json")), &value)?;
    Ok(value)
}

/// Returns the rows as Markdown (`markdown`) or CSV.
fn text(rows: &[Value], columns: &[&str], markdown: bool) -> String {
    let line = |cells: Vec<String>| {
        if markdown {
            format!("| {} |\n", cells.join(" | "))
        } else {
            format!("{}\n", cells.join(","))
        }
    };
    let cell = |row: &Value, name: &str| match &row[name] {
        Value::String(text) if markdown => text.clone(),
        Value::String(text) => format!("\"{}\"", text.replace('"', "\"\"")),
        Value::Number(n) if n.is_f64() => format!("{:.3}", n.as_f64().unwrap_or(f64::NAN)),
        Value::Null => String::new(),
        other => other.to_string(),
    };
    let mut out = line(columns.iter().map(|c| (*c).to_owned()).collect());
    if markdown {
        out += &line(columns.iter().map(|_| "---".to_owned()).collect());
    }
    rows.iter()
        .for_each(|row| out += &line(columns.iter().map(|c| cell(row, c)).collect()));
    out
}

/// Returns a number of a row, or 0 if it is missing.
pub fn number(row: &Value, name: &str) -> f64 {
    row[name].as_f64().unwrap_or(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_are_rounded_and_quoted() {
        let rows = [json!({ "a": 1.23456, "b": "x \"y\"", "c": 3, "d": null })];
        assert_eq!(
            text(&rows, &["a", "b", "c", "d"], false),
            "a,b,c,d\n1.235,\"x \"\"y\"\"\",3,\n"
        );
        assert_eq!(text(&rows, &["b"], true), "| b |\n| --- |\n| x \"y\" |\n");
    }
}
