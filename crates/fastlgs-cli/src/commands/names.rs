//! `fastlgs names`: what the user has taught.

use crate::outcome::Outcome;
use crate::ui::say;
use crate::{report, ui};
use anyhow::Result;
use fastlgs::names::Names;
use serde_json::json;
use std::path::PathBuf;

#[derive(clap::Args)]
#[command(after_help = "Example: fastlgs names export my-names.json")]
pub struct Args {
    #[command(subcommand)]
    action: Action,
}

#[derive(clap::Subcommand)]
enum Action {
    /// Every name with where its examples are from.
    List,
    /// Forgets a name.
    Remove {
        /// The name.
        name: String,
    },
    /// Writes all names to a file, for another machine.
    Export {
        /// The file.
        file: PathBuf,
    },
    /// Adds the names of a file that `names export` wrote.
    Import {
        /// The file.
        file: PathBuf,
    },
}

pub fn run(args: &Args, common: &ui::Common) -> Result<Outcome> {
    match &args.action {
        Action::List if common.json.is_none() => {
            if !common.quiet {
                let rows = Names::load()?.rows();
                rows.iter().for_each(|row| say!("{}: {} views, from {}", row.name, row.views, row.from.join("; ")));
                if rows.is_empty() {
                    say!("nothing was taught yet; 'fastlgs teach --help' says how");
                }
            }
            Ok(Outcome::Done)
        }
        Action::List => report::give(common, &json!({ "kept": Names::path(), "names": Names::load()?.rows() })),
        Action::Remove { name } => {
            let left = Names::change(|names| {
                names.remove(name)?;
                Ok(names.rows().len())
            })?;
            report::give(common, &json!({ "forgotten": name, "names": left }))
        }
        Action::Export { file } => {
            let names = Names::load()?;
            names.write(file)?;
            report::give(common, &json!({ "written": file, "names": names.rows().len() }))
        }
        Action::Import { file } => {
            let others = Names::read(file)?;
            let (came, all) = Names::change(|names| Ok((names.extend(others), names.rows().len())))?;
            report::give(common, &json!({ "came": came, "names": all }))
        }
    }
}
