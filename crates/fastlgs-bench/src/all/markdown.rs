//! What all pages have in common.

use super::figures::{distinct, machines};
use super::rows::Rows;
use std::collections::BTreeSet;

/// Returns a Markdown table.
pub fn table(head: &[&str], lines: &[Vec<String>]) -> String {
    let line = |cells: Vec<&str>| format!("| {} |\n", cells.join(" | "));
    let mut text = line(head.to_vec()) + &line(vec!["---"; head.len()]);
    for cells in lines {
        text += &line(cells.iter().map(String::as_str).collect());
    }
    text
}

/// States what the figures of a page were measured with.
pub fn stamp(rows: &Rows) -> String {
    let seeds: BTreeSet<u64> = rows
        .rows
        .iter()
        .filter_map(|row| row["seed"].as_u64())
        .collect();
    let machines = machines(rows);
    let times = if machines.len() > 1 {
        " Times are of the first processor alone where it has measured them, so they can be of fewer seeds."
    } else {
        ""
    };
    format!(
        "FastLGS {}. {}. Device: {}. Seeds: {}.{times}\n",
        rows.version,
        machines.join("; "),
        distinct(rows, "adapter").join("; "),
        seeds
            .iter()
            .map(u64::to_string)
            .collect::<Vec<_>>()
            .join(", "),
    )
}

/// How to read the figures of all pages.
pub const MEANS: &str = "Means over the seeds, with their range in brackets. *Best object*: IoU of the best single object, \
mean over the labels of held-out views.";
/// How to read the column *text*.
pub const TEXT: &str =
    " *Text*: IoU of the answer to the label's name, mean over the labels; no answer is 0.";
