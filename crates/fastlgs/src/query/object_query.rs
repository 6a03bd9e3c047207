//! Queries by text, picture or pixels of a view, and the objects that they select.

use super::{Pixels, Texts, phrase, selection, texts};
use crate::error::{Context, bail};
use crate::{Result, Scene};
use fastlgs_core::{Camera, LabelMap};
use fastlgs_grid::Grid;
use fastlgs_grid::field::Field;
use fastlgs_grid::query::{self, Found, Hit, QueryConfig};
use fastlgs_grid::relevancy::TextQuery;
use image::RgbImage;

/// A query.
#[derive(Clone)]
pub enum ObjectQuery {
    /// A text or a taught name. "A of B" selects the part A of object B if that scores higher than
    /// the whole phrase.
    Text(String),
    /// Name and pixels of a picture of the object.
    Image(String, RgbImage),
    /// Pixels of the view that show one object.
    Point(Pixels),
    /// Id of the object.
    Object(u16),
}

/// An embedded query, which does not depend on a view yet.
pub enum EmbeddedQuery {
    /// Embeddings of a text or picture.
    Embedded(Box<Embedded>),
    /// Pixels of the view that show one object.
    Point(Pixels),
    /// Id of an object of the scene.
    Object(u16),
}

/// Embeddings of a text or picture. For "A of B", `split` holds the queries of B and A.
pub struct Embedded {
    phrase_query: TextQuery,
    split: Option<[TextQuery; 2]>,
}

impl ObjectQuery {
    /// Returns the name of the query in reports and file names.
    pub fn name(&self) -> String {
        match self {
            Self::Text(text) => text.clone(),
            Self::Image(name, _) => name.clone(),
            Self::Point(pixels) => pixels.to_string(),
            Self::Object(id) => format!("object {id}"),
        }
    }

    /// Embeds a text or picture. An object that fits one of the `negatives` at least as well as the
    /// query is never a target. For pixels and ids, `negatives` have no effect.
    ///
    /// # Errors
    /// A text or picture that cannot be embedded, or an id that the scene does not have.
    pub fn embed(&self, scene: &Scene, negatives: &[String]) -> Result<EmbeddedQuery> {
        Ok(match self {
            Self::Point(pixels) => EmbeddedQuery::Point(pixels.clone()),
            Self::Object(id) => {
                let grid = scene.grid()?;
                if !(1..=grid.objects.len()).contains(&usize::from(*id)) {
                    return Err(selection::no_object(&scene.folder().root, &grid, *id));
                }
                EmbeddedQuery::Object(*id)
            }
            Self::Image(name, photo) => {
                let whole = picture_query(scene, name, photo)?;
                let whole = if negatives.is_empty() {
                    whole
                } else {
                    scene.texts()?.with_negatives(whole, negatives)?
                };
                EmbeddedQuery::Embedded(Box::new(whole.into()))
            }
            Self::Text(text) => EmbeddedQuery::Embedded(Box::new(Embedded::from_text(
                text,
                scene.texts()?,
                negatives,
            )?)),
        })
    }
}

impl From<&str> for ObjectQuery {
    fn from(text: &str) -> Self {
        Self::Text(text.to_owned())
    }
}

impl From<Pixels> for ObjectQuery {
    fn from(pixels: Pixels) -> Self {
        Self::Point(pixels)
    }
}

impl From<TextQuery> for Embedded {
    fn from(whole: TextQuery) -> Self {
        Self {
            phrase_query: whole,
            split: None,
        }
    }
}

impl Embedded {
    /// Embeds a text or a taught name. An object that fits one of the `negatives` at least as well
    /// as the query is never a target.
    ///
    /// # Errors
    /// Those of [`Texts::query`] and [`Texts::with_negatives`].
    pub fn from_text(text: &str, texts: &Texts, negatives: &[String]) -> Result<Self> {
        let embedded = |text: &str| texts.with_negatives(texts.query(text)?, negatives);
        let plain = phrase::normalised(text);
        let text = if texts.is_taught(text) {
            text
        } else {
            plain.as_str()
        };
        let split = split_part_and_object(text).filter(|_| !texts.is_taught(text));
        // Only the whole phrase is used if a part cannot be embedded. A taught name, for example,
        // cannot be compared with a text as negative.
        let split =
            split.and_then(|(part, object)| Some([embedded(object).ok()?, embedded(part).ok()?]));
        Ok(Self {
            phrase_query: embedded(text)?,
            split,
        })
    }

    /// Ranks all objects and selects the targets.
    pub fn find(&self, grid: &Grid, config: &QueryConfig) -> Found {
        let answer_to = |query: &TextQuery| {
            let ranked = query::rank(grid, query);
            Found {
                targets: query::select(grid, &ranked, query, config),
                ranked,
            }
        };
        let whole = answer_to(&self.phrase_query);
        let Some([object, part]) = &self.split else {
            return whole;
        };
        let object_answer = answer_to(object);
        match query::part(grid, &object_answer.targets, part, config) {
            Some(part) if query::best_score(&part.ranked) > query::best_score(&whole.ranked) => {
                part
            }
            _ if !whole.targets.is_empty() => whole,
            _ => object_answer,
        }
    }
}

/// Splits "A of B" into part A and object B, without the article of B. "flower pot of the bonsai"
/// gives "flower pot" and "bonsai".
fn split_part_and_object(text: &str) -> Option<(&str, &str)> {
    let (part, object) = text.split_once(" of ")?;
    let object = ["the ", "a ", "an "]
        .iter()
        .find_map(|article| object.strip_prefix(article))
        .unwrap_or(object);
    let (part, object) = (part.trim(), object.trim());
    (!part.is_empty() && !object.is_empty()).then_some((part, object))
}

/// Converts a picture to a query. The picture is embedded like a mask that covers all of it.
///
/// # Errors
/// The encoder of the scene cannot embed pictures, or its embeddings do not fit those of the
/// objects.
pub(crate) fn picture_query(scene: &Scene, name: &str, photo: &RgbImage) -> Result<TextQuery> {
    let (width, height) = photo.dimensions();
    let everything = LabelMap {
        width,
        height,
        labels: vec![1; (width * height) as usize],
    };
    let encoder = scene.image_encoder()?;
    let found = encoder
        .embed_masks(name, photo, &everything)?
        .pop()
        .filter(|e| e.iter().any(|v| *v != 0.0));
    let whole = found.with_context(|| format!("{name}: this picture cannot be embedded, because the embeddings of the scene were imported; use a text or a point instead"))?;
    texts::check_embeddings(
        scene.manifest(),
        &*scene.grid()?,
        scene.folder(),
        "pictures",
        whole.len(),
    )?;
    Ok(TextQuery::of_examples(
        vec![whole],
        scene.calibrations().pictures,
    ))
}

impl EmbeddedQuery {
    /// Returns whether scores rest on a measured calibration. Pixels and ids need none.
    pub fn is_calibrated(&self) -> bool {
        match self {
            Self::Embedded(meant) => meant.phrase_query.calibration.measured,
            Self::Point(..) | Self::Object(_) => true,
        }
    }

    /// Returns whether a source of names knows the text, or both parts of "A of B". Pictures, pixels
    /// and ids need none.
    pub fn is_known(&self, grid: &Grid) -> bool {
        let Self::Embedded(meant) = self else {
            return true;
        };
        let known = |query: &TextQuery| query.is_known(grid);
        known(&meant.phrase_query)
            || meant
                .split
                .as_ref()
                .is_some_and(|split| split.iter().all(known))
    }

    /// Ranks objects and selects the targets. For pixels, the ranking lists the objects there,
    /// smallest first, with their support as score. For an id, the object has its support, too.
    ///
    /// # Errors
    /// A pixel outside the view.
    pub fn find(
        &self,
        grid: &Grid,
        field: &Field,
        camera: &Camera,
        config: &QueryConfig,
    ) -> Result<Found> {
        let hit = |id: u16| Hit {
            id,
            score: grid.objects[usize::from(id) - 1].support,
        };
        match self {
            Self::Embedded(meant) => Ok(meant.find(grid, config)),
            Self::Point(pixels) => {
                if let Some((x, y)) = pixels.outside(camera) {
                    bail!(
                        "the pixel {x},{y} is outside the view, which has {}x{} pixels",
                        camera.width,
                        camera.height
                    );
                }
                let (at_pixels, selected) =
                    query::select_at_pixels(grid, &field.at(grid, pixels.all()));
                Ok(Found {
                    ranked: at_pixels.into_iter().map(hit).collect(),
                    targets: selected.map(hit).into_iter().collect(),
                })
            }
            Self::Object(id) => Ok(Found {
                ranked: vec![hit(*id)],
                targets: vec![hit(*id)],
            }),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_of_b_is_split_into_part_and_object() {
        assert_eq!(
            split_part_and_object("flower pot of the bonsai"),
            Some(("flower pot", "bonsai"))
        );
        assert_eq!(
            split_part_and_object("wheel of a bicycle"),
            Some(("wheel", "bicycle"))
        );
        assert_eq!(split_part_and_object("fox"), None);
        assert_eq!(split_part_and_object("top of "), None);
    }
}
