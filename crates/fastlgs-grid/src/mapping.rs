//! Cross-view grid mapping (paper, Algorithm 1): which masks of different photos show the same object.

use crate::{Error, Result};
use fastlgs_core::vectorised;
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::ops::Range;

/// One mask of one photo.
#[derive(Clone, Debug, serde::Serialize, serde::Deserialize)]
pub struct Mask {
    /// Index of the photo in the sequence.
    pub view: usize,
    /// Label in that photo's map.
    pub label: u16,
    /// Share of the photo that it covers.
    pub area: f32,
    /// Embedding L, L2-normalised as masks are compared by it; zeros where there is none.
    pub embedding: Vec<f32>,
    /// Colour distribution C, summing to 1.
    pub histogram: Vec<f32>,
}

/// Constants of the paper.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PaperConfig {
    /// Fewest key-point pairs that make two masks one object (tau).
    pub tau: u32,
    /// Least similarity that makes two masks one object (theta).
    pub theta: f32,
    /// Weight of colour against the embedding (alpha); 0 leaves colour out.
    pub alpha: f32,
    /// Whether key points count.
    pub key_points: bool,
}

impl Default for PaperConfig {
    fn default() -> Self {
        Self { tau: 4, theta: 0.95, alpha: 0.3, key_points: true }
    }
}

/// Key-point pairs between masks: (later mask, earlier mask) -> number. Masks are indices into the mask list.
pub type Correspondences = BTreeMap<(usize, usize), u32>;

impl Mask {
    /// One vector for embedding and colours, whose inner products are the paper's similarities:
    /// sim = alpha * Bhattacharyya coefficient of C + (1 - alpha) * cosine of L. (The paper's prose swaps the two names; its formulas are meant
    /// like this.)
    fn look(&self, alpha: f32) -> Vec<f32> {
        let color = self.histogram.iter().map(|share| (alpha * share).sqrt());
        color.chain(self.embedding.iter().map(|value| (1.0 - alpha).sqrt() * value)).collect()
    }
}

vectorised! {
    /// Inner products of a vector with others of its length.
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
                sums[k] = if FMA { a[k].mul_add(b[k], sums[k]) } else { sums[k] + a[k] * b[k] };
            }
        }
        *out = sums.iter().sum::<f32>() + a_rest.iter().zip(b_rest).map(|(x, y)| x * y).sum::<f32>();
    }
}

/// Masks that are more alike than this stand for each other. Where two objects differ by no more in how like a mask they are, looks do not tell them
/// apart.
const ALIKE: f32 = 0.98;

/// What Algorithm 1 made of the masks.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Mapped {
    /// Object of each mask, 1..=count.
    pub object_of: Vec<u16>,
    /// Number of objects K.
    pub count: u16,
    /// Similarities that were computed.
    pub comparisons: usize,
}

/// Algorithm 1. `masks` are sorted by view.
///
/// Photos are taken in sequence; masks of the first photo are objects of their own. Key points decide first, and a photo may show several masks
/// of an object that they find. Similarity is for what is left, and one to one, the most alike first: an object that the photo shows already is
/// no candidate, so that two things of one look stay two; which is which, key points tell, though they be fewer than tau. A mask is compared not
/// with every earlier one but with each object's representatives, of which none is more than 0.98 like another one. An object that is seen for the
/// hundredth time adds none, so that the work grows with the photos, not with their square.
///
/// # Errors
/// More than 65,535 objects: a Gaussian's id has 16 bits.
pub fn paper(masks: &[Mask], pairs: &Correspondences, config: &PaperConfig) -> Result<Mapped> {
    let mut mapped = Mapped { object_of: Vec::with_capacity(masks.len()), ..Mapped::default() };
    let mut representatives: Vec<usize> = Vec::new();
    let looks: Vec<Vec<f32>> = masks.par_iter().map(|mask| mask.look(config.alpha)).collect();
    for photo in masks.chunk_by(|a, b| a.view == b.view) {
        let first = mapped.object_of.len();
        let by_key_points: Vec<Option<u16>> =
            (first..first + photo.len()).map(|j| most_corresponding(j, first, pairs, &mapped, config)).collect();
        mapped.comparisons += photo.len() * representatives.len();
        let alike = similarities(&looks, first..first + photo.len(), &representatives, &mapped);
        let mut object_of = by_key_points;
        let key_points = |mask: usize, object: u16| shared_with(first + mask, object, first, pairs, &mapped, config);
        for (mask, object) in most_alike_first(&alike, config.theta, key_points) {
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
            // One of the same object that is as good as the mask itself makes it superfluous.
            if alike[k].get(&object).is_none_or(|sim| *sim < ALIKE) {
                representatives.push(first + k);
            }
            mapped.object_of.push(object);
        }
    }
    Ok(mapped)
}

/// The object of the mask of an earlier photo, one before `first`, that shares most key points with mask `j`; none below tau.
fn most_corresponding(j: usize, first: usize, pairs: &Correspondences, mapped: &Mapped, config: &PaperConfig) -> Option<u16> {
    let most = pairs.range((j, 0)..(j, first)).map(|(&(_, k), &n)| (n, std::cmp::Reverse(k))).max()?;
    Some(mapped.object_of[most.1.0]).filter(|_| config.key_points && most.0 >= config.tau)
}

/// Key points that mask `j` shares with all masks of an object, in photos before that of mask `first`.
fn shared_with(j: usize, object: u16, first: usize, pairs: &Correspondences, mapped: &Mapped, config: &PaperConfig) -> u32 {
    let of_object = pairs.range((j, 0)..(j, first)).filter(|((_, k), _)| config.key_points && mapped.object_of[*k] == object);
    of_object.map(|(_, n)| n).sum()
}

/// How much each mask of a photo is like each object: like its most similar representative.
fn similarities(looks: &[Vec<f32>], photo: Range<usize>, representatives: &[usize], mapped: &Mapped) -> Vec<BTreeMap<u16, f32>> {
    // The photo's own vectors stay at hand while each of the many representatives comes by once.
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

/// Pairs (mask, object) from theta on. Those come first that share key points, if the mask is as like that object as the one it is most like: looks
/// do not tell such objects apart.
fn most_alike_first(alike: &[BTreeMap<u16, f32>], theta: f32, key_points: impl Fn(usize, u16) -> u32) -> Vec<(usize, u16)> {
    let mut pairs: Vec<(u32, f32, usize, u16)> = Vec::new();
    for (mask, objects) in alike.iter().enumerate() {
        let most = objects.values().copied().fold(f32::MIN, f32::max);
        for (&object, &sim) in objects.iter().filter(|(_, sim)| **sim >= theta) {
            let shared = if most - sim <= 1.0 - ALIKE { key_points(mask, object) } else { 0 };
            pairs.push((shared, sim, mask, object));
        }
    }
    pairs.sort_by(|a, b| b.0.cmp(&a.0).then(b.1.total_cmp(&a.1)).then((a.2, a.3).cmp(&(b.2, b.3))));
    pairs.into_iter().map(|(_, _, mask, object)| (mask, object)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mask(view: usize, label: u16, embedding: [f32; 2], histogram: [f32; 2]) -> Mask {
        Mask { view, label, area: 0.1, embedding: embedding.to_vec(), histogram: histogram.to_vec() }
    }

    /// View 0 shows a cup and a book; view 1 the cup (by key points), a book of the same look (by similarity), and
    /// something new; view 2 a thing with three pairs only, which is not enough.
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
        assert_eq!(map(PaperConfig { tau: 3, ..PaperConfig::default() }).object_of[5], 1, "tau is an option");
        assert_eq!(map(PaperConfig { key_points: false, ..PaperConfig::default() }).object_of, [1, 2, 3, 2, 4, 5], "so are key points");
        let mut similarity = [0.0];
        products(&masks[1].look(0.3), &[masks[3].look(0.3)], &mut similarity);
        assert!((similarity[0] - (0.7 + 0.3 * (0.225f32.sqrt() + 0.275f32.sqrt()))).abs() < 1e-6);
    }

    /// Two mugs of one look, and the second photo's left one shares a key point with the first photo's right one; a third thing that
    /// is less like it shares more, which does not count.
    #[test]
    fn key_points_tell_twins_apart() {
        let masks = [
            mask(0, 1, [1.0, 0.0], [1.0, 0.0]),
            mask(0, 2, [1.0, 0.0], [1.0, 0.0]),
            mask(0, 3, [0.96, 0.28], [1.0, 0.0]),
            mask(1, 1, [1.0, 0.0], [1.0, 0.0]),
            mask(1, 2, [1.0, 0.0], [1.0, 0.0]),
        ];
        let pairs = Correspondences::from([((3, 1), 1), ((3, 2), 3)]);
        let map = |key_points| paper(&masks, &pairs, &PaperConfig { key_points, ..PaperConfig::default() }).unwrap().object_of;
        assert_eq!([map(false), map(true)], [vec![1, 2, 3, 1, 2], vec![1, 2, 3, 2, 1]]);
    }

    /// `views` photos of 40 things, of which each shows ten; how a thing looks wavers from photo to photo.
    fn walk(views: usize) -> Vec<Mask> {
        let mut rng = fastlgs_core::rng::Rng::new(2, "walk");
        let looks: Vec<Vec<f32>> = (0..40).map(|_| unit((0..16).map(|_| rng.normal()).collect())).collect();
        let mut wavering = |look: &[f32]| unit(look.iter().map(|v| v + 0.03 * rng.normal()).collect());
        let mask = |view: usize, label: usize, embedding| Mask { view, label: label as u16, area: 0.1, embedding, histogram: vec![1.0] };
        (0..views).flat_map(|v| (0..10).map(move |k| (v, (v + k) % 40))).map(|(v, thing)| mask(v, thing, wavering(&looks[thing]))).collect()
    }

    fn unit(mut v: Vec<f32>) -> Vec<f32> {
        let length = v.iter().map(|x| x * x).sum::<f32>().sqrt();
        v.iter_mut().for_each(|x| *x /= length);
        v
    }

    #[test]
    fn work_grows_with_the_photos_and_not_with_their_square() {
        let [few, many] = [250, 1000].map(|views| {
            let masks = walk(views);
            let mapped = paper(&masks, &Correspondences::new(), &PaperConfig { theta: 0.9, ..PaperConfig::default() }).unwrap();
            assert_eq!(mapped.count, 40, "every thing is one object");
            assert!(
                masks.iter().zip(&mapped.object_of).all(|(m, o)| masks
                    .iter()
                    .zip(&mapped.object_of)
                    .find(|(n, _)| n.label == m.label)
                    .is_some_and(|f| f.1 == o))
            );
            mapped.comparisons as f64
        });
        let exponent = (many / few).ln() / 4f64.ln();
        println!("comparisons grow with the {exponent:.2}th power of the number of photos, up to 1,000");
        assert!(exponent < 1.3, "{exponent}");
    }

    #[test]
    fn ids_have_sixteen_bits() {
        let masks: Vec<Mask> = (0..=u16::MAX).map(|label| mask(0, label, [1.0, 0.0], [1.0, 0.0])).collect();
        assert_eq!(paper(&masks[1..], &Correspondences::new(), &PaperConfig::default()).unwrap().count, u16::MAX);
        assert!(paper(&masks, &Correspondences::new(), &PaperConfig::default()).unwrap_err().to_string().contains("65,535"));
    }
}
