//! The text tower of a scene's encoder, with what its scores are judged by.

use crate::error::{Context, bail};
use crate::{Result, eyes};
use fastlgs_core::SceneFolder;
use fastlgs_core::scene_folder::Manifest;
use fastlgs_grid::Grid;
use fastlgs_grid::relevancy::{CANONICAL, Calibration, TextQuery};
use fastlgs_vision::TextEncoder;
use std::path::Path;

/// The manifest's name of the encoder that comes with the program.
const OFFLINE: &str = "offline";

/// A loaded text tower.
pub struct Texts {
    encoder: Box<dyn TextEncoder>,
    canonical: Vec<Vec<f32>>,
    calibration: Calibration,
}

impl Texts {
    /// The text tower of the encoder that made the scene's embeddings.
    pub fn load(folder: &SceneFolder, manifest: &Manifest, clip_text: Option<&Path>) -> Result<Self> {
        let encoder = eyes::text_encoder_of(manifest, clip_text)?;
        let calibration = calibration(manifest);
        let canonical = if manifest.encoder == OFFLINE { Vec::new() } else { encoder.embed(&CANONICAL)? };
        let length = encoder.embed(&CANONICAL[..1])?[0].len();
        let grid = Grid::load(folder).context("the object grid cannot be read; run 'fastlgs train' again")?;
        let own = grid.objects.iter().flat_map(|o| &o.embeddings).map(Vec::len).next();
        if let Some(own) = own.filter(|own| *own != length) {
            let root = folder.root.display();
            bail!(
                "{root}: its embeddings have {own} numbers, those of texts {length}; they are of another encoder or version: \
                 run 'fastlgs train {root}' again, or name the right tower with --clip-text"
            );
        }
        Ok(Self { encoder, canonical, calibration })
    }

    /// Prepares a text.
    pub fn query(&self, text: &str) -> Result<TextQuery> {
        let calibration = self.calibration;
        let anything = calibration.anything + self.encoder.advantage(text);
        Ok(TextQuery {
            text: self.encoder.embed(&[text])?.remove(0),
            canonical: self.canonical.clone(),
            negatives: Vec::new(),
            anything,
            calibration,
        })
    }

    /// What the encoder's cosines are worth.
    pub fn calibration(&self) -> Calibration {
        self.calibration
    }
}

/// What the cosines of the encoder that made a scene's embeddings are worth.
pub fn calibration(manifest: &Manifest) -> Calibration {
    if manifest.encoder == OFFLINE { Calibration::OFFLINE } else { Calibration::CLIP }
}
