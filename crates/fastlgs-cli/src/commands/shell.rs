//! `fastlgs completions` and `fastlgs man`: write the files that packages install with the binary.

use crate::outcome::Outcome;
use anyhow::{Context, Result};
use clap_complete::Shell;
use std::path::PathBuf;

#[derive(clap::Args)]
#[command(
    after_help = "Example: fastlgs completions bash > ~/.local/share/bash-completion/completions/fastlgs"
)]
pub struct Completions {
    /// Shell of the script.
    shell: Shell,
}

#[derive(clap::Args)]
#[command(after_help = "Example: fastlgs man -o ~/.local/share/man/man1")]
pub struct Man {
    /// Output folder, for fastlgs.1 and a page per command.
    #[arg(short, long)]
    output: PathBuf,
}

/// Writes a completion script to standard output.
pub fn completions(args: &Completions, mut program: clap::Command) -> Result<Outcome> {
    let mut script = Vec::new();
    clap_complete::generate(args.shell, &mut program, "fastlgs", &mut script);
    std::io::Write::write_all(&mut std::io::stdout(), &script)?;
    Ok(Outcome::Done)
}

/// Writes the manual pages.
pub fn man(args: &Man, program: clap::Command) -> Result<Outcome> {
    std::fs::create_dir_all(&args.output).with_context(|| args.output.display().to_string())?;
    clap_mangen::generate_to(program, &args.output)
        .with_context(|| format!("{}: cannot write the manual pages", args.output.display()))?;
    Ok(Outcome::Done)
}
