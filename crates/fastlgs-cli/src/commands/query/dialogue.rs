//! Interactive dialogue: `fastlgs query SCENE -` on a terminal.

use super::QueryRunner;
use super::answer_text::answer_text;
use crate::outcome::Outcome;
use crate::ui::print_line;
use anyhow::{Result, bail};
use fastlgs::query::ObjectQuery;
use std::io::{BufRead, Write};
use std::path::PathBuf;

/// A parsed line of the dialogue.
#[derive(Debug, PartialEq)]
enum Command<'a> {
    Nothing,
    Text(&'a str),
    View(&'a str),
    Views,
    Save,
    Help,
    Quit,
}

impl<'a> Command<'a> {
    fn of(line: &'a str) -> Self {
        let line = line.trim();
        match line.split_once(' ') {
            Some(("view", name)) if !name.trim().is_empty() => Self::View(name.trim()),
            _ => match line {
                "" => Self::Nothing,
                "views" => Self::Views,
                "save" => Self::Save,
                "help" | "?" => Self::Help,
                "quit" | "exit" => Self::Quit,
                text => Self::Text(text),
            },
        }
    }
}

const HELP: &str = "enter a text to find it; view NAME: change the view; views: list the views; save: write the pictures of the last answer; quit: end";

impl QueryRunner<'_> {
    /// Runs the dialogue until `quit` or the end of input.
    pub(super) fn run_dialogue(&mut self) -> Result<Outcome> {
        print_line!("{HELP}");
        let mut last = None;
        loop {
            // The contact sheet shows only the answer that is saved.
            self.tiles.clear();
            print!("{}> ", self.cameras[0].name);
            std::io::stdout().flush()?;
            let mut line = Vec::new();
            if std::io::stdin().lock().read_until(b'\n', &mut line)? == 0 {
                print_line!("");
                return Ok(Outcome::Done);
            }
            let Ok(line) = String::from_utf8(line) else {
                print_line!("the line is not UTF-8 text; send it in UTF-8");
                continue;
            };
            let reply = match Command::of(&line) {
                Command::Quit => return Ok(Outcome::Done),
                Command::Nothing => continue,
                Command::Help => Ok(HELP.to_owned()),
                Command::Views => Ok(self
                    .scene
                    .cameras()
                    .iter()
                    .map(|c| c.name.as_str())
                    .collect::<Vec<_>>()
                    .join("  ")),
                Command::View(name) => self.set_view(name).map(|()| String::new()),
                Command::Save => self.save(last.as_deref()),
                Command::Text(text) => {
                    last = Some(text.to_owned());
                    self.answer(&ObjectQuery::Text(text.to_owned()), 0)
                        .map(|report| answer_text(&report, &self.scene.folder().root))
                }
            };
            match reply {
                Ok(words) if words.is_empty() => {}
                Ok(words) => print_line!("{words}"),
                Err(error) => print_line!("{error:#}"),
            }
        }
    }

    fn set_view(&mut self, name: &str) -> Result<()> {
        let camera = self.scene.camera(name)?;
        self.cameras = vec![
            self.args
                .views
                .size
                .map_or(camera.clone(), |(w, h)| camera.resized(w, h)),
        ];
        self.rendered_view = None;
        Ok(())
    }

    /// Writes the pictures of the last answer to the output folder, by default `answers`.
    fn save(&mut self, last: Option<&str>) -> Result<String> {
        let Some(text) = last else {
            bail!("nothing was asked yet; enter a text first")
        };
        let named = self
            .output
            .get_or_insert_with(|| PathBuf::from("answers"))
            .clone();
        self.rendered_view = None;
        let saved = self
            .answer(&ObjectQuery::Text(text.to_owned()), 0)
            .and_then(|report| Ok((report, self.sheet()?.unwrap_or(named))));
        // Also reset after an error: later answers are written only with --output.
        self.output.clone_from(&self.args.output);
        let (report, sheet) = saved?;
        Ok(format!(
            "{}\ncontact sheet: {}",
            answer_text(&report, &self.scene.folder().root),
            sheet.display()
        ))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_of_a_dialogue_is_a_text_unless_it_is_a_command() {
        let said = [
            "",
            "red cup",
            " view 003.png ",
            "view",
            "views",
            "save",
            "?",
            "exit",
        ]
        .map(Command::of);
        let view = Command::View("003.png");
        assert_eq!(
            said,
            [
                Command::Nothing,
                Command::Text("red cup"),
                view,
                Command::Text("view"),
                Command::Views,
                Command::Save,
                Command::Help,
                Command::Quit
            ]
        );
    }
}
