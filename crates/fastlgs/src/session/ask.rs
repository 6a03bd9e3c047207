//! What is asked for: a text, a picture, or a point in a view; and the objects that it means.

use super::{Pixels, Session, Texts, phrase, texts};
use crate::Result;
use crate::calibrations::Calibrations;
use crate::error::{Context, bail};
use fastlgs_core::{Camera, LabelMap};
use fastlgs_grid::Grid;
use fastlgs_grid::field::Field;
use fastlgs_grid::query::{self, Found, Hit, QueryConfig};
use fastlgs_grid::relevancy::TextQuery;
use image::RgbImage;

/// One question.
pub enum Ask {
    /// Words, or a name that was taught. "A of B" means the part A of B where that answers better than the whole phrase.
    Text(String),
    /// A picture of the thing, with its name.
    Image(String, RgbImage),
    /// Pixels of the view that show one thing.
    Point(Pixels),
}

/// What a question means, before any view is looked at.
pub enum Meaning {
    /// Words or a picture.
    Embedded(Box<Embedded>),
    /// Pixels of the view that show one thing.
    Point(Pixels),
}

/// Embedded words or a picture; for "A of B" also B and A.
pub struct Embedded {
    whole: TextQuery,
    split: Option<[TextQuery; 2]>,
}

impl Ask {
    /// What reports and file names call it.
    pub fn name(&self) -> String {
        match self {
            Self::Text(text) => text.clone(),
            Self::Image(name, _) => name.clone(),
            Self::Point(pixels) => pixels.to_string(),
        }
    }

    /// Embeds what needs embedding; `negatives` are texts that the object must not be nearer to.
    pub fn meaning(&self, session: &Session, negatives: &[String]) -> Result<Meaning> {
        Ok(match self {
            Self::Point(pixels) => Meaning::Point(pixels.clone()),
            Self::Image(name, photo) => {
                let whole = picture(session, name, photo)?;
                let whole = if negatives.is_empty() { whole } else { session.texts()?.with_negatives(whole, negatives)? };
                Meaning::Embedded(Box::new(whole.into()))
            }
            Self::Text(text) => Meaning::Embedded(Box::new(Embedded::words(text, session.texts()?, negatives)?)),
        })
    }
}

impl From<TextQuery> for Embedded {
    fn from(whole: TextQuery) -> Self {
        Self { whole, split: None }
    }
}

impl Embedded {
    /// Words, or a name that was taught; `negatives` are texts that the object must not be nearer to.
    ///
    /// # Errors
    /// Those of [`Texts::query`] and [`Texts::with_negatives`].
    pub fn words(text: &str, texts: &Texts, negatives: &[String]) -> Result<Self> {
        let embedded = |text: &str| texts.with_negatives(texts.query(text)?, negatives);
        let plain = phrase::normalised(text);
        let text = if texts.is_taught(text) { text } else { plain.as_str() };
        let split = part_of(text).filter(|_| !texts.is_taught(text));
        // What cannot be split, as half of it was taught and cannot be compared with a negative, is meant as a whole.
        let split = split.and_then(|(part, object)| Some([embedded(object).ok()?, embedded(part).ok()?]));
        Ok(Self { whole: embedded(text)?, split })
    }

    /// What a scene must have something like: the whole phrase, or what the part is of.
    pub fn sought(&self) -> impl Iterator<Item = &TextQuery> {
        std::iter::once(&self.whole).chain(self.split.iter().map(|[object, _]| object))
    }

    /// The objects that are meant.
    pub fn find(&self, grid: &Grid, config: &QueryConfig) -> Found {
        let by = |query: &TextQuery| {
            let ranked = query::rank(grid, query);
            Found { targets: query::select(grid, &ranked, query, config), ranked }
        };
        let whole = by(&self.whole);
        let Some([object, part]) = &self.split else { return whole };
        let around = by(object);
        match query::part(grid, &around.targets, part, config) {
            Some(part) if query::best_score(&part.ranked) > query::best_score(&whole.ranked) => part,
            _ if !whole.targets.is_empty() => whole,
            _ => around,
        }
    }
}

/// "flower pot of the bonsai" is the part "flower pot" of "bonsai".
fn part_of(text: &str) -> Option<(&str, &str)> {
    let (part, object) = text.split_once(" of ")?;
    let object = ["the ", "a ", "an "].iter().find_map(|article| object.strip_prefix(article)).unwrap_or(object);
    let (part, object) = (part.trim(), object.trim());
    (!part.is_empty() && !object.is_empty()).then_some((part, object))
}

/// A picture as a query: the whole of it is embedded like a mask.
pub(crate) fn picture(session: &Session, name: &str, photo: &RgbImage) -> Result<TextQuery> {
    let (width, height) = photo.dimensions();
    let everything = LabelMap { width, height, labels: vec![1; (width * height) as usize] };
    let encoder = session.image_encoder()?;
    let found = encoder.embed_masks(name, photo, &everything)?.pop().filter(|e| e.iter().any(|v| *v != 0.0));
    let whole = found.with_context(|| format!("{name}: the scene's embeddings were imported, so that pictures cannot be embedded"))?;
    texts::check(&session.manifest, &session.grid()?, &session.folder, "pictures", whole.len())?;
    Ok(TextQuery::of_examples(vec![whole], session.calibrations.unwrap_or_else(|| Calibrations::of(&session.manifest)).pictures))
}

impl Meaning {
    /// Whether what scores mean was measured with the encoder.
    pub fn is_calibrated(&self) -> bool {
        match self {
            Self::Embedded(meant) => meant.whole.calibration.measured,
            Self::Point(..) => true,
        }
    }

    /// The objects that are meant.
    pub fn find(&self, grid: &Grid, field: &Field, camera: &Camera, config: &QueryConfig) -> Result<Found> {
        match self {
            Self::Embedded(meant) => Ok(meant.find(grid, config)),
            Self::Point(pixels) => {
                if let Some((x, y)) = pixels.outside(camera) {
                    bail!("--point {x},{y} lies outside the view of {}x{}", camera.width, camera.height);
                }
                let (there, meant) = query::pointed(grid, &field.at(grid, pixels.all()));
                let hit = |id: u16| Hit { id, score: grid.objects[usize::from(id) - 1].support };
                Ok(Found { ranked: there.into_iter().map(hit).collect(), targets: meant.map(hit).into_iter().collect() })
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_are_named_by_of() {
        assert_eq!(part_of("flower pot of the bonsai"), Some(("flower pot", "bonsai")));
        assert_eq!(part_of("wheel of a bicycle"), Some(("wheel", "bicycle")));
        assert_eq!(part_of("fox"), None);
        assert_eq!(part_of("top of "), None);
    }
}
