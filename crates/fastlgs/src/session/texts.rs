//! The text tower of a scene's encoder, with what its scores are judged by and the names that were taught.

use crate::calibrations::{self, Calibrations};
use crate::error::{Context, bail};
use crate::names::Names;
use crate::session::phrase;
use crate::{Result, eyes};
use fastlgs_core::SceneFolder;
use fastlgs_core::scene_folder::Manifest;
use fastlgs_grid::Grid;
use fastlgs_grid::relevancy::{CANONICAL, TextQuery};
use fastlgs_vision::TextEncoder;
use std::path::Path;

/// Fails where the objects' embeddings cannot be compared with those of texts or pictures, which have so many numbers.
pub(super) fn check(manifest: &Manifest, grid: &Grid, folder: &SceneFolder, what: &str, length: usize) -> Result<()> {
    eyes::check_version(manifest, grid, folder)?;
    let own = grid.objects.iter().flat_map(|o| &o.embeddings).map(Vec::len).next();
    if let Some(own) = own.filter(|own| *own != length) {
        let root = folder.root.display();
        bail!(
            "{root}: its embeddings have {own} numbers, those of {what} {length}; they are of another encoder: \
             name the right tower with --clip-text, or run 'fastlgs train {root}' again"
        );
    }
    Ok(())
}

/// A loaded text tower.
pub struct Texts {
    encoder: Box<dyn TextEncoder>,
    canonical: Vec<Vec<f32>>,
    /// What cosines are worth.
    pub calibrations: Calibrations,
    names: Names,
    identity: String,
}

impl Texts {
    /// The text tower of the encoder that made the scene's embeddings.
    pub fn load(folder: &SceneFolder, manifest: &Manifest, clip_text: Option<&Path>) -> Result<Self> {
        Self::of(eyes::text_encoder_of(manifest, clip_text)?, folder, manifest)
    }

    /// A text tower of the caller's, which must belong to what made the scene's embeddings.
    pub fn of(encoder: Box<dyn TextEncoder>, folder: &SceneFolder, manifest: &Manifest) -> Result<Self> {
        let canonical = if manifest.encoder == calibrations::OFFLINE { Vec::new() } else { encoder.embed(&CANONICAL)? };
        let length = encoder.embed(&CANONICAL[..1])?[0].len();
        let grid = Grid::load(folder).context("the object grid cannot be read; run 'fastlgs train' again")?;
        check(manifest, &grid, folder, "texts", length)?;
        let (calibrations, identity) = (Calibrations::of(manifest), eyes::identity_of(manifest));
        Ok(Self { encoder, canonical, calibrations, names: Names::load()?, identity })
    }

    /// Takes all texts as words from now on.
    pub fn forget_names(&mut self) {
        self.names = Names::default();
    }

    /// Whether the user has taught this name.
    pub fn is_taught(&self, text: &str) -> bool {
        self.names.of(text).is_some()
    }

    /// Prepares a text: the examples of a name that was taught, else its embedding.
    ///
    /// # Errors
    /// An empty text, or a name that was taught with another encoder only.
    pub fn query(&self, text: &str) -> Result<TextQuery> {
        // What was taught under a name that looks like a phrase is asked for by it.
        let plain = phrase::normalised(text);
        let text = if self.is_taught(text) { text } else { plain.as_str() };
        if text.trim().is_empty() {
            bail!("the text is empty; say what to look for");
        }
        if self.is_taught(text) {
            return self.of_examples(text).with_context(|| {
                format!(
                    "'{text}' was taught with another encoder than that of this scene, or an earlier version of it: teach it here as well, or forget \
                     it: fastlgs names remove '{text}'"
                )
            });
        }
        Ok(self.worded(text, self.encoder.embed(&[text])?.remove(0)))
    }

    /// Prepares many texts; a name that was taught with another encoder only is a text like others.
    ///
    /// # Errors
    /// When inference fails.
    pub fn queries(&self, texts: &[String]) -> Result<Vec<TextQuery>> {
        let plain = |text: &String| if self.of_examples(text).is_some() { text.clone() } else { phrase::normalised(text) };
        let texts: Vec<String> = texts.iter().map(plain).collect();
        let embeddings = self.encoder.embed(&texts.iter().map(String::as_str).collect::<Vec<_>>())?;
        let query = |(text, embedding): (&String, Vec<f32>)| self.of_examples(text).unwrap_or_else(|| self.worded(text, embedding));
        Ok(texts.iter().zip(embeddings).map(query).collect())
    }

    /// Names that were taught with this encoder.
    pub fn taught(&self) -> Vec<String> {
        self.names.rows().into_iter().map(|row| row.name).filter(|name| self.of_examples(name).is_some()).collect()
    }

    /// Adds texts that the objects must not be nearer to.
    ///
    /// # Errors
    /// As [`Self::query`]; words where pictures are meant, and pictures where words are: their cosines cannot be compared.
    pub fn with_negatives(&self, mut query: TextQuery, negatives: &[String]) -> Result<TextQuery> {
        for text in negatives {
            let negative = self.query(text)?;
            if negative.shown != query.shown {
                let [meant, unwanted] = [query.shown, negative.shown].map(|shown| if shown { "a picture" } else { "words" });
                bail!("--negative '{text}' is {unwanted}, what is looked for {meant}: how like they are to an object cannot be compared");
            }
            query.negatives.extend(negative.meant);
        }
        Ok(query)
    }

    /// What was taught under a name with this encoder; nothing where nothing was.
    fn of_examples(&self, name: &str) -> Option<TextQuery> {
        let own = self.names.of(name)?.iter().filter(|e| e.encoder == self.identity);
        let meant: Vec<Vec<f32>> = own.flat_map(|e| e.embeddings.iter().cloned()).collect();
        (!meant.is_empty()).then(|| TextQuery::of_examples(meant, self.calibrations.pictures))
    }

    /// A text with its embedding.
    fn worded(&self, text: &str, embedding: Vec<f32>) -> TextQuery {
        let calibration = self.calibrations.texts;
        let anything = calibration.anything + self.encoder.advantage(text);
        TextQuery { canonical: self.canonical.clone(), anything, ..TextQuery::new(vec![embedding], calibration) }
    }
}
