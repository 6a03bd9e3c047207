//! Cross-view grid mapping (paper, Algorithm 1): matches masks of different photos to objects.

use crate::{Error, Result};
use fastlgs_core::vectorised;
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::ops::Range;

/// One mask of a photo.
#[derive(Clone, Debug, serde::Serialize, serde::Deserialize)]
pub struct Mask {
    /// Index of the photo in the sequence.
    pub view: usize,
    /// Label in the label map of that photo.
    pub label: u16,
    /// Area as a share of the photo.
    pub area: f32,
    /// Embedding L, L2-normalised in the part that masks are compared by; zeros if there is none.
    pub embedding: Vec<f32>,
    /// Colour histogram C, with sum 1.
    pub histogram: Vec<f32>,
}

/// Constants of the paper.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PaperConfig {
    /// Smallest number of key-point pairs that makes two masks one object (tau).
    pub tau: u32,
    /// Smallest similarity that makes two masks one object (theta).
    pub theta: f32,
    /// Weight of colour relative to the embedding (alpha); 0 ignores colour.
    pub alpha: f32,
    /// Whether key points are used.
    pub key_points: bool,
}

impl Default for PaperConfig {
    fn default() -> Self {
        Self {
            tau: 4,
            theta: 0.95,
            alpha: 0.3,
            key_points: true,
        }
    }
}

/// Numbers of key-point pairs, by (later mask, earlier mask). Masks are indices into the mask list.
pub type Correspondences = BTreeMap<(usize, usize), u32>;

impl Mask {
    /// Returns one vector for colours and embedding, whose inner products are the paper's
    /// similarities.
    ///
    /// sim = alpha * Bhattacharyya coefficient of C + (1 - alpha) * cosine of L. The paper's prose
    /// swaps the two names; this follows its formulas.
    fn descriptor(&self, alpha: f32) -> Vec<f32> {
        let color = self.histogram.iter().map(|share| (alpha * share).sqrt());
        color
            .chain(
                self.embedding
                    .iter()
                    .map(|value| (1.0 - alpha).sqrt() * value),
            )
            .collect()
    }
}

vectorised! {
    /// Computes the inner products of `with` and each of `others`. All vectors have the same
    /// length.
    fn products(with: &[f32], others: &[Vec<f32>], out: &mut [f32]) = products_body
}

#[inline(always)]
fn products_body<const FMA: bool>(with: &[f32], others: &[Vec<f32>], out: &mut [f32]) {
    const LANES: usize = 16;
    for (other, out) in others.iter().zip(out) {
        let ((a, a_rest), (b, b_rest)) = (with.as_chunks::<LANES>(), other.as_chunks::<LANES>());
        let mut sums = [0.0f32; LANES];
        for (a, b) in a.iter().zip(b) {
            for k in 0..LANES {
                sums[k] = if FMA {
                    a[k].mul_add(b[k], sums[k])
                } else {
                    sums[k] + a[k] * b[k]
                };
            }
        }
        *out =
            sums.iter().sum::<f32>() + a_rest.iter().zip(b_rest).map(|(x, y)| x * y).sum::<f32>();
    }
}

/// Similarity from which two masks of an object are treated as equal. A mask that is this similar
/// to a representative of its object does not become one.
///
/// Objects whose similarities to a mask differ by at most 1 minus this are treated as equally
/// similar.
const SAME_SIMILARITY: f32 = 0.98;

/// Result of Algorithm 1.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Mapped {
    /// Object id of each mask, 1..=count.
    pub object_of: Vec<u16>,
    /// Number of objects K.
    pub count: u16,
    /// Number of similarities computed.
    pub comparisons: usize,
}

/// Runs Algorithm 1. `masks` are sorted by view.
///
/// Photos are processed in sequence; each mask of the first photo starts an object. Key points
/// decide first: a mask joins the object of the earlier mask that shares most pairs with it, if
/// these are at least tau. Several masks of a photo may join one object in this way.
///
/// All other masks are matched by similarity, one to one and in descending order. Objects that the
/// photo already shows are no candidates, so that two objects that look the same stay separate.
/// Among equally similar objects shared key points decide, even if there are fewer than tau.
///
/// A mask is compared with the representatives of each object, not with all earlier masks. A mask
/// that is at least 0.98 similar to a representative of its object does not become one. So the work
/// grows linearly with the number of photos.
///
/// # Errors
/// There are more than 65,535 objects; ids have 16 bits.
pub fn paper(masks: &[Mask], pairs: &Correspondences, config: &PaperConfig) -> Result<Mapped> {
    let mut mapped = Mapped {
        object_of: Vec::with_capacity(masks.len()),
        ..Mapped::default()
    };
    let mut representatives: Vec<usize> = Vec::new();
    let looks: Vec<Vec<f32>> = masks
        .par_iter()
        .map(|mask| mask.descriptor(config.alpha))
        .collect();
    for photo in masks.chunk_by(|a, b| a.view == b.view) {
        let first = mapped.object_of.len();
        let by_key_points: Vec<Option<u16>> = (first..first + photo.len())
            .map(|j| most_corresponding(j, first, pairs, &mapped, config))
            .collect();
        mapped.comparisons += photo.len() * representatives.len();
        let similarity_to = similarities(
            &looks,
            first..first + photo.len(),
            &representatives,
            &mapped,
        );
        let mut object_of = by_key_points;
        let key_points = |mask: usize, object: u16| {
            shared_with(first + mask, object, first, pairs, &mapped, config)
        };
        for (mask, object) in candidates_by_similarity(&similarity_to, config.theta, key_points) {
            if object_of[mask].is_none() && !object_of.contains(&Some(object)) {
                object_of[mask] = Some(object);
            }
        }
        for (k, object) in object_of.into_iter().enumerate() {
            let object = match object {
                Some(object) => object,
                None => {
                    mapped.count = mapped.count.checked_add(1).ok_or(Error::TooManyObjects)?;
                    mapped.count
                }
            };
            if similarity_to[k]
                .get(&object)
                .is_none_or(|sim| *sim < SAME_SIMILARITY)
            {
                representatives.push(first + k);
            }
            mapped.object_of.push(object);
        }
    }
    Ok(mapped)
}

/// Returns the object of the mask before `first` that shares most key points with mask `j`; `None`
/// below tau.
fn most_corresponding(
    j: usize,
    first: usize,
    pairs: &Correspondences,
    mapped: &Mapped,
    config: &PaperConfig,
) -> Option<u16> {
    let most = pairs
        .range((j, 0)..(j, first))
        .map(|(&(_, k), &n)| (n, std::cmp::Reverse(k)))
        .max()?;
    Some(mapped.object_of[most.1.0]).filter(|_| config.key_points && most.0 >= config.tau)
}

/// Counts the key points that mask `j` shares with an object's masks before mask `first`.
fn shared_with(
    j: usize,
    object: u16,
    first: usize,
    pairs: &Correspondences,
    mapped: &Mapped,
    config: &PaperConfig,
) -> u32 {
    let of_object = pairs
        .range((j, 0)..(j, first))
        .filter(|((_, k), _)| config.key_points && mapped.object_of[*k] == object);
    of_object.map(|(_, n)| n).sum()
}

/// Returns for each mask of a photo its similarity to each object: the largest one to a
/// representative.
fn similarities(
    looks: &[Vec<f32>],
    photo: Range<usize>,
    representatives: &[usize],
    mapped: &Mapped,
) -> Vec<BTreeMap<u16, f32>> {
    // Loop order for the cache: the vectors of the photo stay in it, and each representative is
    // read once.
    let with = |k: &usize| {
        let mut row = vec![0.0; photo.len()];
        products(&looks[*k], &looks[photo.clone()], &mut row);
        row
    };
    let rows: Vec<Vec<f32>> = representatives.par_iter().map(with).collect();
    let best = |mask: usize| {
        let mut best = BTreeMap::new();
        for (k, row) in representatives.iter().zip(&rows) {
            let sim = best.entry(mapped.object_of[*k]).or_insert(f32::MIN);
            *sim = sim.max(row[mask]);
        }
        best
    };
    (0..photo.len()).into_par_iter().map(best).collect()
}

/// Returns the candidates (mask, object) with a similarity of at least `theta`, best first.
///
/// Sorts by shared key points, then by similarity. Key points count only if the object is about as
/// similar as the mask's most similar one.
fn candidates_by_similarity(
    alike: &[BTreeMap<u16, f32>],
    theta: f32,
    key_points: impl Fn(usize, u16) -> u32,
) -> Vec<(usize, u16)> {
    let mut pairs: Vec<(u32, f32, usize, u16)> = Vec::new();
    for (mask, objects) in alike.iter().enumerate() {
        let most = objects.values().copied().fold(f32::MIN, f32::max);
        for (&object, &sim) in objects.iter().filter(|(_, sim)| **sim >= theta) {
            let shared = if most - sim <= 1.0 - SAME_SIMILARITY {
                key_points(mask, object)
            } else {
                0
            };
            pairs.push((shared, sim, mask, object));
        }
    }
    pairs.sort_by(|a, b| {
        b.0.cmp(&a.0)
            .then(b.1.total_cmp(&a.1))
            .then((a.2, a.3).cmp(&(b.2, b.3)))
    });
    pairs
        .into_iter()
        .map(|(_, _, mask, object)| (mask, object))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mask(view: usize, label: u16, embedding: [f32; 2], histogram: [f32; 2]) -> Mask {
        Mask {
            view,
            label,
            area: 0.1,
            embedding: embedding.to_vec(),
            histogram: histogram.to_vec(),
        }
    }

    /// View 0 shows a cup and a book. View 1 shows the cup (by key points), a similar book, and a
    /// new object. View 2 shows an object with three key-point pairs, fewer than tau.
    #[test]
    fn algorithm_1_by_hand() {
        let masks = [
            mask(0, 1, [1.0, 0.0], [1.0, 0.0]),
            mask(0, 2, [0.0, 1.0], [0.5, 0.5]),
            mask(1, 1, [0.6, 0.8], [0.0, 1.0]),
            mask(1, 2, [0.0, 1.0], [0.45, 0.55]),
            mask(1, 3, [-1.0, 0.0], [1.0, 0.0]),
            mask(2, 1, [0.8, -0.6], [0.2, 0.8]),
        ];
        let pairs = Correspondences::from([((2, 0), 4), ((2, 1), 2), ((5, 0), 3)]);
        let map = |config: PaperConfig| paper(&masks, &pairs, &config).unwrap();
        let found = map(PaperConfig::default());
        assert_eq!((found.object_of, found.count), (vec![1, 2, 1, 2, 3, 4], 4));
        assert_eq!(
            map(PaperConfig {
                tau: 3,
                ..PaperConfig::default()
            })
            .object_of[5],
            1,
            "tau is an option"
        );
        assert_eq!(
            map(PaperConfig {
                key_points: false,
                ..PaperConfig::default()
            })
            .object_of,
            [1, 2, 3, 2, 4, 5],
            "key points are an option"
        );
        let mut similarity = [0.0];
        products(
            &masks[1].descriptor(0.3),
            &[masks[3].descriptor(0.3)],
            &mut similarity,
        );
        assert!((similarity[0] - (0.7 + 0.3 * (0.225f32.sqrt() + 0.275f32.sqrt()))).abs() < 1e-6);
    }

    /// Two mugs look the same. Key points match the left one of the second photo to the right one
    /// of the first. A third, less similar object shares more key points, which do not count.
    #[test]
    fn key_points_separate_objects_that_look_the_same() {
        let masks = [
            mask(0, 1, [1.0, 0.0], [1.0, 0.0]),
            mask(0, 2, [1.0, 0.0], [1.0, 0.0]),
            mask(0, 3, [0.96, 0.28], [1.0, 0.0]),
            mask(1, 1, [1.0, 0.0], [1.0, 0.0]),
            mask(1, 2, [1.0, 0.0], [1.0, 0.0]),
        ];
        let pairs = Correspondences::from([((3, 1), 1), ((3, 2), 3)]);
        let map = |key_points| {
            paper(
                &masks,
                &pairs,
                &PaperConfig {
                    key_points,
                    ..PaperConfig::default()
                },
            )
            .unwrap()
            .object_of
        };
        assert_eq!(
            [map(false), map(true)],
            [vec![1, 2, 3, 1, 2], vec![1, 2, 3, 2, 1]]
        );
    }

    /// Generates `views` photos of 40 objects. Each photo shows ten; their embeddings vary between
    /// photos.
    fn walk(views: usize) -> Vec<Mask> {
        let mut rng = fastlgs_core::rng::Rng::new(2, "walk");
        let looks: Vec<Vec<f32>> = (0..40)
            .map(|_| unit((0..16).map(|_| rng.normal()).collect()))
            .collect();
        let mut wavering =
            |look: &[f32]| unit(look.iter().map(|v| v + 0.03 * rng.normal()).collect());
        let mask = |view: usize, label: usize, embedding| Mask {
            view,
            label: label as u16,
            area: 0.1,
            embedding,
            histogram: vec![1.0],
        };
        (0..views)
            .flat_map(|v| (0..10).map(move |k| (v, (v + k) % 40)))
            .map(|(v, thing)| mask(v, thing, wavering(&looks[thing])))
            .collect()
    }

    fn unit(mut v: Vec<f32>) -> Vec<f32> {
        let length = v.iter().map(|x| x * x).sum::<f32>().sqrt();
        v.iter_mut().for_each(|x| *x /= length);
        v
    }

    #[test]
    fn work_grows_linearly_with_the_number_of_photos() {
        let [few, many] = [250, 1000].map(|views| {
            let masks = walk(views);
            let mapped = paper(
                &masks,
                &Correspondences::new(),
                &PaperConfig {
                    theta: 0.9,
                    ..PaperConfig::default()
                },
            )
            .unwrap();
            assert_eq!(mapped.count, 40, "each generated object is found once");
            assert!(masks.iter().zip(&mapped.object_of).all(|(m, o)| {
                masks
                    .iter()
                    .zip(&mapped.object_of)
                    .find(|(n, _)| n.label == m.label)
                    .is_some_and(|f| f.1 == o)
            }));
            mapped.comparisons as f64
        });
        let exponent = (many / few).ln() / 4f64.ln();
        println!(
            "comparisons grow with the {exponent:.2}th power of the number of photos, up to 1,000"
        );
        assert!(exponent < 1.3, "{exponent}");
    }

    #[test]
    fn ids_have_sixteen_bits() {
        let masks: Vec<Mask> = (0..=u16::MAX)
            .map(|label| mask(0, label, [1.0, 0.0], [1.0, 0.0]))
            .collect();
        assert_eq!(
            paper(
                &masks[1..],
                &Correspondences::new(),
                &PaperConfig::default()
            )
            .unwrap()
            .count,
            u16::MAX
        );
        assert!(
            paper(&masks, &Correspondences::new(), &PaperConfig::default())
                .unwrap_err()
                .to_string()
                .contains("65,535")
        );
    }
}
