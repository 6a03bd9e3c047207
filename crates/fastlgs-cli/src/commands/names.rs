//! `fastlgs names`: lists, removes, exports and imports taught names.

use crate::outcome::Outcome;
use crate::ui::print_line;
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
    /// List all names with the sources of their examples.
    List,
    /// Remove a name.
    Remove {
        /// Name to remove.
        name: String,
    },
    /// Write all names to a file, for another machine.
    Export {
        /// Output file.
        file: PathBuf,
    },
    /// Add the names of a file that `names export` wrote.
    Import {
        /// File to read.
        file: PathBuf,
    },
}

pub fn run(args: &Args, common: &ui::Common) -> Result<Outcome> {
    match &args.action {
        Action::List if common.json.is_none() => {
            if !common.quiet {
                let rows = Names::load()?.rows();
                rows.iter().for_each(|row| {
                    print_line!(
                        "{}: {} views, from {}",
                        row.name,
                        row.views,
                        row.from.join("; ")
                    )
                });
                if rows.is_empty() {
                    print_line!("no names are taught yet; see 'fastlgs teach --help'");
                }
            }
            Ok(Outcome::Done)
        }
        Action::List => report::write_fields(
            common,
            &json!({ "kept": Names::path(), "names": Names::load()?.rows() }),
        ),
        Action::Remove { name } => {
            let left = Names::change(|names| {
                names.remove(name)?;
                Ok(names.rows().len())
            })?;
            report::write_fields(common, &json!({ "forgotten": name, "names": left }))
        }
        Action::Export { file } => {
            let names = Names::load()?;
            names.write(file)?;
            report::write_fields(
                common,
                &json!({ "written": file, "names": names.rows().len() }),
            )
        }
        Action::Import { file } => {
            let others = Names::read(file)?;
            let (added, all) =
                Names::change(|names| Ok((names.extend(others), names.rows().len())))?;
            report::write_fields(common, &json!({ "came": added, "names": all }))
        }
    }
}
