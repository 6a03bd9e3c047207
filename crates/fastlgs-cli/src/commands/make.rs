//! `fastlgs make`: builds a scene from photos and prints the next commands.

use crate::outcome::Outcome;
use crate::words::thousands;
use crate::{report, ui};
use anyhow::Result;
use fastlgs::Run;
use fastlgs::make::{self, MakeConfig, State};

pub fn run(config: &MakeConfig, common: &ui::Common, run: &Run) -> Result<Outcome> {
    let made = fastlgs::make(config, run)?;
    report::write_summary(common, &made, |made| {
        words(made, &config.preprocess.output.display().to_string())
    })
}

fn words(made: &make::MakeReport, scene: &str) -> String {
    let train = &made.train;
    let seconds = train.seconds + train.mapping_seconds;
    let status = match made.state {
        State::Made => {
            format!(
                "{} iterations and the objects took {seconds:.0} s ({})",
                thousands(train.iterations as usize),
                train.adapter
            )
        }
        State::Kept => "is up to date; photos and options have not changed".to_owned(),
    };
    let [training, held_out] = made.photos;
    let colour = train
        .psnr_held_out
        .map(|psnr| format!("; PSNR {psnr:.1} dB on {held_out} held-out photos"))
        .unwrap_or_default();
    // Quotes a name with characters that the shell interprets.
    let is_shell_safe = scene
        .chars()
        .all(|c| c.is_alphanumeric() || "/._-".contains(c));
    let scene = if is_shell_safe {
        scene.to_owned()
    } else {
        format!("'{}'", scene.replace('\'', "'\\''"))
    };
    format!(
        "{scene}: {status}\n{training} photos, {} Gaussians, {} objects and parts{colour}\n\nquery it:  fastlgs query {scene} \"red cup\"\nview it:   fastlgs serve {scene}",
        thousands(train.gaussians),
        thousands(train.objects)
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_next_commands_can_be_copied() {
        let train = fastlgs::train::TrainReport {
            gaussians: 12,
            objects: 3,
            psnr_held_out: Some(31.26),
            ..Default::default()
        };
        let made = make::MakeReport {
            state: State::Kept,
            photos: [7, 1],
            train,
        };
        let said = words(&made, "my photos/fox");
        assert!(
            said.contains(
                "7 photos, 12 Gaussians, 3 objects and parts; PSNR 31.3 dB on 1 held-out"
            ),
            "{said}"
        );
        assert!(said.ends_with("fastlgs serve 'my photos/fox'"), "{said}");
    }
}
