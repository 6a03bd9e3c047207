//! The text tower of a scene's encoder, with what its scores are judged by.

use crate::error::{Context, bail};
use crate::{Result, eyes};
use fastlgs_core::SceneFolder;
use fastlgs_core::scene_folder::Manifest;
use fastlgs_grid::relevancy::{CANONICAL, OFFLINE_ANYTHING, TextQuery};
use fastlgs_grid::{Grid, query};
use fastlgs_vision::TextEncoder;
use std::path::Path;

/// The manifest's name of the encoder that comes with the program.
const OFFLINE: &str = "offline";

/// A loaded text tower.
pub struct Texts {
    encoder: Box<dyn TextEncoder>,
    canonical: Vec<Vec<f32>>,
    anything: f32,
    min_score: f32,
}

impl Texts {
    /// The text tower of the encoder that made the scene's embeddings.
    pub fn load(folder: &SceneFolder, manifest: &Manifest, clip_text: Option<&Path>) -> Result<Self> {
        let encoder = eyes::text_encoder_of(manifest, clip_text)?;
        let offline = manifest.encoder == OFFLINE;
        let canonical = if offline { Vec::new() } else { encoder.embed(&CANONICAL)? };
        let anything = if offline { OFFLINE_ANYTHING } else { -1.0 };
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
        Ok(Self { encoder, canonical, anything, min_score: min_score(manifest) })
    }

    /// Prepares a text.
    pub fn query(&self, text: &str) -> Result<TextQuery> {
        let anything = self.anything + self.encoder.advantage(text);
        Ok(TextQuery { text: self.encoder.embed(&[text])?.remove(0), canonical: self.canonical.clone(), anything })
    }

    /// Relevancy from which an object counts as found.
    pub fn min_score(&self) -> f32 {
        self.min_score
    }
}

/// Relevancy from which an object counts as found, with the encoder that made a scene's embeddings.
pub fn min_score(manifest: &Manifest) -> f32 {
    if manifest.encoder == OFFLINE { query::MIN_SCORE } else { query::CLIP_MIN_SCORE }
}
