//! `fastlgs query --library`: finds the scenes of a folder that contain an object.

use super::lines::{Line, is_closed, parse_line};
use crate::outcome::Outcome;
use crate::ui::print_line;
use crate::{report, ui};
use anyhow::Result;
use fastlgs::Run;
use fastlgs::library::{Search, SearchConfig, SearchReport};
use serde_json::json;
use std::io::{BufRead, Write};
use std::path::Path;

/// Answers all texts. If `texts` is `-`, reads one text per line from standard input and answers in
/// JSON.
pub fn run(
    root: &Path,
    config: SearchConfig,
    texts: &[String],
    common: &ui::Common,
    run: &Run,
) -> Result<Outcome> {
    let search = Search::open(root, config, run)?;
    if texts == ["-"] {
        let mut out = std::io::stdout();
        for line in std::io::stdin().lock().split(b'\n') {
            let answer = match parse_line(&line?) {
                Line::None => continue,
                Line::Unreadable(answer) => answer,
                Line::Text(text) => match search.ask(&text) {
                    Ok(report) => serde_json::to_value(&report)?,
                    Err(error) => json!({ "text": text, "error": fastlgs::one_sentence(&error) }),
                },
            };
            if is_closed(writeln!(out, "{answer}").and_then(|()| out.flush()))? {
                break;
            }
        }
        return Ok(Outcome::Done);
    }
    let mut answers = texts
        .iter()
        .map(|text| Ok(search.ask(text)?))
        .collect::<Result<Vec<_>>>()?;
    let found = answers.iter().any(|a| a.found);
    if common.json.is_some() && answers.len() == 1 {
        report::write_fields(common, &answers.remove(0))?;
    } else if common.json.is_some() {
        report::write_fields(common, &answers)?;
    } else if !common.quiet {
        answers.iter().for_each(print);
    }
    Ok(if found {
        Outcome::Done
    } else {
        Outcome::NotFound
    })
}

fn print(answer: &SearchReport) {
    let found = answer.scenes.iter().filter(|row| row.found);
    let (count, listed, all) = (
        found.clone().count(),
        answer.scenes.len(),
        answer.searched.scenes,
    );
    // Scenes that are not listed may contain the object, too.
    let out_of = if count > 0 && count == listed && listed < all {
        format!("the best {listed} of {all}")
    } else {
        all.to_string()
    };
    print_line!(
        "\"{}\": in {count} of {out_of} scenes ({:.1} ms)",
        answer.text,
        answer.ms.search
    );
    for row in found {
        print_line!("  {:.3}  object {:<5} {}", row.score, row.object, row.scene);
    }
}
