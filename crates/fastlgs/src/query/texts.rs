//! The text encoder of a scene, with its calibrations and the taught names.

use crate::calibrations::{self, Calibrations};
use crate::error::{Context, bail};
use crate::everyday::EVERYDAY;
use crate::names::Names;
use crate::query::phrase;
use crate::{Result, model_choice};
use fastlgs_core::SceneFolder;
use fastlgs_core::fs::cache_dir;
use fastlgs_core::scene_folder::{Manifest, load_tensors, save_tensors};
use fastlgs_grid::Grid;
use fastlgs_grid::relevancy::{CANONICAL, Rule, Source, TextQuery};
use fastlgs_vision::detector::CLASSES;
use fastlgs_vision::{Nouns, TextEncoder, names};
use std::path::Path;

/// Checks that the embeddings of the objects can be compared with those of `what` (texts or
/// pictures), which have `length` dimensions.
///
/// # Errors
/// The object table has embeddings of another encoder or length.
pub(super) fn check_embeddings(
    manifest: &Manifest,
    grid: &Grid,
    folder: &SceneFolder,
    what: &str,
    length: usize,
) -> Result<()> {
    model_choice::check_version(manifest, grid, folder)?;
    let own = grid
        .objects
        .iter()
        .flat_map(|o| &o.embeddings)
        .map(Vec::len)
        .next();
    if let Some(own) = own.filter(|own| *own != length) {
        let root = folder.root.display();
        bail!(
            "{root}: the embeddings of the scene have {own} dimensions, but those of {what} have {length}, so they are from different encoders; \
             set clip_text to the text tower of the scene, or run 'fastlgs train {root}' again"
        );
    }
    Ok(())
}

/// Embeds texts: each alone by the paper's rule, otherwise in several prompts.
fn embed_by(rule: Rule, encoder: &dyn TextEncoder, texts: &[&str]) -> Result<Vec<Vec<f32>>> {
    Ok(match rule {
        Rule::Paper => encoder.embed_alone(texts)?,
        Rule::Calibrated => encoder.embed(texts)?,
    })
}

/// Returns a hash of texts and of their encoder, which `embeddings` of it identify.
fn fingerprint(embeddings: &[f32], texts: &str) -> u64 {
    let values = embeddings.iter().flat_map(|v| v.to_bits().to_le_bytes());
    let bytes = values.chain(texts.bytes());
    // FNV-1a.
    bytes.fold(0xcbf2_9ce4_8422_2325, |hash, byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3)
    })
}

/// A loaded text encoder.
pub struct Texts {
    encoder: Box<dyn TextEncoder>,
    canonical: Vec<Vec<f32>>,
    /// Calibrations of the encoder.
    pub calibrations: Calibrations,
    /// How text queries rank and accept objects.
    rule: Rule,
    names: Names,
    /// Which names detector and classifier know; `None` for CLIP, or if it is not installed.
    nouns: Option<Nouns>,
    identity: String,
}

impl Texts {
    /// Loads the text encoder of the scene. `clip_text` replaces the CLIP text tower that the
    /// manifest records.
    pub fn load(
        folder: &SceneFolder,
        manifest: &Manifest,
        clip_text: Option<&Path>,
        rule: Rule,
    ) -> Result<Self> {
        Self::from_encoder(
            model_choice::text_encoder_of(manifest, clip_text)?,
            folder,
            manifest,
            rule,
        )
    }

    /// Uses a text encoder of the caller.
    ///
    /// # Errors
    /// Its embeddings have another length than those of the scene, or the object table cannot be
    /// read.
    pub fn from_encoder(
        encoder: Box<dyn TextEncoder>,
        folder: &SceneFolder,
        manifest: &Manifest,
        rule: Rule,
    ) -> Result<Self> {
        let canonical = embed_by(rule, &*encoder, &CANONICAL)?;
        let length = canonical[0].len();
        let canonical = if manifest.encoder == calibrations::OFFLINE {
            Vec::new()
        } else {
            canonical
        };
        let grid = Grid::load(folder)
            .context("the object grid cannot be read; run 'fastlgs train' again")?;
        check_embeddings(manifest, &grid, folder, "texts", length)?;
        let has_nouns = manifest.encoder == calibrations::OFFLINE && Nouns::is_installed();
        let nouns = has_nouns.then(Nouns::load).transpose()?;
        let (calibrations, identity) = (
            Calibrations::of(manifest),
            model_choice::identity_of(manifest),
        );
        Ok(Self {
            encoder,
            canonical,
            calibrations,
            rule,
            names: Names::load()?,
            nouns,
            identity,
        })
    }

    fn embed(&self, texts: &[&str]) -> Result<Vec<Vec<f32>>> {
        embed_by(self.rule, &*self.encoder, texts)
    }

    /// Ignores taught names from now on.
    pub fn ignore_taught_names(&mut self) {
        self.names = Names::default();
    }

    /// Returns whether a text is a taught name.
    pub fn is_taught(&self, text: &str) -> bool {
        self.names.examples(text).is_some()
    }

    /// Returns the query of a text: the examples of a taught name, or else the embedding of the
    /// text.
    ///
    /// # Errors
    /// An empty text, or a name that was taught only with another encoder.
    pub fn query(&self, text: &str) -> Result<TextQuery> {
        // A taught name is looked up before the text is normalised.
        let plain = phrase::normalised(text);
        let text = if self.is_taught(text) {
            text
        } else {
            plain.as_str()
        };
        if text.trim().is_empty() {
            bail!("the text is empty; enter the name of an object");
        }
        if self.is_taught(text) {
            return self.example_query(text).with_context(|| {
                format!(
                    "'{text}' was taught with another encoder or encoder version than this scene has; teach it in this scene as well, \
                     or remove it: fastlgs names remove '{text}'"
                )
            });
        }
        Ok(self.embedded_query(text, self.embed(&[text])?.remove(0)))
    }

    /// Returns the queries of many texts. A name that was taught only with another encoder is
    /// embedded as a text.
    ///
    /// # Errors
    /// Inference fails.
    pub fn queries(&self, texts: &[String]) -> Result<Vec<TextQuery>> {
        let plain = |text: &String| {
            if self.example_query(text).is_some() {
                text.clone()
            } else {
                phrase::normalised(text)
            }
        };
        let texts: Vec<String> = texts.iter().map(plain).collect();
        let embeddings = self.embed(&texts.iter().map(String::as_str).collect::<Vec<_>>())?;
        let query = |(text, embedding): (&String, Vec<f32>)| {
            self.example_query(text)
                .unwrap_or_else(|| self.embedded_query(text, embedding))
        };
        Ok(texts.iter().zip(embeddings).map(query).collect())
    }

    /// Returns the names that were taught with this encoder.
    pub fn taught(&self) -> Vec<String> {
        self.names
            .rows()
            .into_iter()
            .map(|row| row.name)
            .filter(|name| self.example_query(name).is_some())
            .collect()
    }

    /// Returns names that objects may have, with their queries: taught names, and the classes of the
    /// offline encoder or everyday names.
    ///
    /// # Errors
    /// Inference fails, or the offline models are not installed.
    pub fn vocabulary(&self) -> Result<Vec<(String, TextQuery)>> {
        let (names, embeddings) = if self.canonical.is_empty() {
            (names::class_names()?, names::embeddings()?)
        } else {
            let names: Vec<String> = EVERYDAY.map(str::to_owned).into();
            (names, self.everyday_embeddings()?)
        };
        let taught = self.taught().into_iter();
        let taught = taught.filter_map(|name| Some((name.clone(), self.example_query(&name)?)));
        let known = names.into_iter().zip(embeddings);
        let known = known.map(|(name, embedding)| {
            let query = self.embedded_query(&name, embedding);
            (name, query)
        });
        // The detector's own names replace those of the classifier that mean the same.
        let known = known.filter(|(_, query)| query.source == Source::Embeddings);
        Ok(taught.chain(self.detector_names()).chain(known).collect())
    }

    /// Returns the names of the detector's classes with their queries; none if it is not used.
    fn detector_names(&self) -> Vec<(String, TextQuery)> {
        let named = |name: &&str| {
            let query = TextQuery {
                source: Source::Detector(vec![(*name).to_owned()]),
                ..TextQuery::new(Vec::new(), self.calibrations.texts)
            };
            ((*name).to_owned(), query)
        };
        let classes = self.nouns.iter().flat_map(|_| &CLASSES);
        classes.map(named).collect()
    }

    /// Returns the embeddings of everyday names. They are saved in the cache folder, because CLIP
    /// takes half a minute for them on two cores.
    fn everyday_embeddings(&self) -> Result<Vec<Vec<f32>>> {
        let key = fingerprint(&self.canonical.concat(), &EVERYDAY.concat());
        let path = cache_dir()
            .join("names")
            .join(format!("{key:016x}.safetensors"));
        let cached = load_tensors(&path).ok().and_then(|mut t| t.remove("names"));
        if let Some((shape, values)) =
            cached.filter(|(shape, _)| shape.first() == Some(&EVERYDAY.len()))
        {
            return Ok(values.chunks_exact(shape[1]).map(<[f32]>::to_vec).collect());
        }
        let embeddings = self.embed(&EVERYDAY)?;
        let shape = vec![EVERYDAY.len(), embeddings[0].len()];
        if let Err(e) = save_tensors(&path, &[("names", shape, &embeddings.concat())]) {
            tracing::debug!("the embeddings of everyday names cannot be saved: {e}");
        }
        Ok(embeddings)
    }

    /// Adds negative texts to a query. An object that fits one of them at least as well as the
    /// query is never a target.
    ///
    /// # Errors
    /// As [`Self::query`]. A text and an example cannot be combined, because their cosines cannot
    /// be compared.
    pub fn with_negatives(&self, mut query: TextQuery, negatives: &[String]) -> Result<TextQuery> {
        for text in negatives {
            let negative = self.query(text)?;
            if negative.from_example != query.from_example {
                let [meant, unwanted] = [query.from_example, negative.from_example]
                    .map(|shown| if shown { "an example" } else { "a text" });
                bail!(
                    "the negative '{text}' is {unwanted}, but the query is {meant}; their cosines cannot be compared, so use a negative of the same kind"
                );
            }
            query.negatives.extend(negative.positive);
        }
        Ok(query)
    }

    /// Returns the query of the examples of a name; `None` if it was not taught with this encoder.
    fn example_query(&self, name: &str) -> Option<TextQuery> {
        let own = self
            .names
            .examples(name)?
            .iter()
            .filter(|e| e.encoder == self.identity);
        let embeddings: Vec<Vec<f32>> = own.flat_map(|e| e.embeddings.iter().cloned()).collect();
        (!embeddings.is_empty())
            .then(|| TextQuery::of_examples(embeddings, self.calibrations.pictures))
    }

    /// Returns the query of a text from its embedding.
    fn embedded_query(&self, text: &str, embedding: Vec<f32>) -> TextQuery {
        let calibration = self.calibrations.texts;
        let anything = calibration.anything + self.encoder.baseline_shift(text);
        TextQuery {
            canonical: self.canonical.clone(),
            min_canonical: anything,
            rule: self.rule,
            source: self.source(text),
            ..TextQuery::new(vec![embedding], calibration)
        }
    }

    /// Returns the source that knows a name.
    fn source(&self, text: &str) -> Source {
        let Some(nouns) = &self.nouns else {
            return Source::Embeddings;
        };
        let classes = nouns.classes(text);
        if classes.is_empty() {
            Source::Unknown
        } else if classes.detector.is_empty() {
            Source::Embeddings
        } else {
            let name = |class: &usize| CLASSES[*class].to_owned();
            Source::Detector(classes.detector.iter().map(name).collect())
        }
    }
}
