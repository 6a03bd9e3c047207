//! Colours and materials by name, measured from a mask's pixels because the classifier does not
//! report them.
//!
//! Embeddings of the offline encoder have one value for each attribute. For a mask, it measures how
//! much of the mask has that colour; for a text, whether the text names it. Their product is added
//! to the cosine of the rest of the text.

use fastlgs_core::LabelMap;
use fastlgs_core::color::lab;
use image::RgbImage;

/// An attribute: the words that name it, and its colours in CIE Lab.
struct Attribute {
    words: &'static [&'static str],
    colors: &'static [[f32; 3]],
}

/// Basic colour terms (Berlin & Kay 1969) with their focal colours, and wood, which is also
/// recognised by its colours.
const ATTRIBUTES: [Attribute; 12] = [
    Attribute {
        words: &["red", "crimson", "scarlet"],
        colors: &[[45.0, 65.0, 45.0], [35.0, 50.0, 30.0], [25.0, 38.0, 20.0]],
    },
    Attribute {
        words: &["orange"],
        colors: &[[65.0, 42.0, 65.0]],
    },
    Attribute {
        words: &["yellow", "golden"],
        colors: &[[85.0, 0.0, 75.0], [70.0, 5.0, 60.0]],
    },
    Attribute {
        words: &["green"],
        colors: &[
            [50.0, -45.0, 35.0],
            [35.0, -20.0, 22.0],
            [65.0, -25.0, 35.0],
        ],
    },
    Attribute {
        words: &["blue"],
        colors: &[[35.0, 15.0, -50.0], [55.0, -5.0, -35.0], [25.0, 5.0, -25.0]],
    },
    Attribute {
        words: &["purple", "violet"],
        colors: &[
            [35.0, 35.0, -35.0],
            [40.0, 20.0, -20.0],
            [25.0, 22.0, -18.0],
        ],
    },
    Attribute {
        words: &["pink"],
        colors: &[[70.0, 40.0, 5.0], [82.0, 20.0, 5.0]],
    },
    Attribute {
        words: &["brown"],
        colors: &[[35.0, 15.0, 22.0], [25.0, 10.0, 14.0], [48.0, 17.0, 28.0]],
    },
    Attribute {
        words: &["black"],
        colors: &[[6.0, 0.0, 0.0], [16.0, 0.0, 0.0]],
    },
    Attribute {
        words: &["white"],
        colors: &[[97.0, 0.0, 0.0], [88.0, 0.0, 4.0]],
    },
    Attribute {
        words: &["gray", "grey", "silver"],
        colors: &[[52.0, 0.0, 0.0], [36.0, 0.0, 0.0], [70.0, 0.0, 0.0]],
    },
    Attribute {
        words: &["wooden", "wood"],
        colors: &[
            [35.0, 15.0, 22.0],
            [48.0, 17.0, 28.0],
            [62.0, 12.0, 30.0],
            [25.0, 10.0, 14.0],
        ],
    },
];

/// Number of attributes; each is one value of an embedding.
pub const COUNT: usize = ATTRIBUTES.len();
/// Share of a mask at which a colour counts neither for nor against the mask.
const NEUTRAL: f32 = 0.25;
/// Weight of attributes in embeddings of masks. It is small, so that attributes hardly affect
/// comparisons between masks.
const MASK_WEIGHT: f32 = 0.1;
/// Weight of an attribute that a text names, relative to the cosine of the rest of the text.
const ATTRIBUTE_WEIGHT: f32 = 0.25;
/// Cosine that unrelated masks gain because they have the named colour. Adding it to the baseline
/// makes absent names with a colour score like those without.
const COLOR_BASELINE_SHIFT: f32 = 0.08;

/// Returns the index of the basic colour whose focal colours are nearest to a Lab colour.
fn nearest(color: [f32; 3]) -> usize {
    let distance = |focal: &[f32; 3]| {
        // Hue distinguishes colours better than lightness does.
        let [l, a, b] = [0, 1, 2].map(|k| color[k] - focal[k]);
        0.5 * l * l + a * a + b * b
    };
    let basic = ATTRIBUTES[..COUNT - 1].iter().enumerate();
    let best = basic.map(|(k, attribute)| {
        (
            attribute
                .colors
                .iter()
                .map(distance)
                .fold(f32::INFINITY, f32::min),
            k,
        )
    });
    best.min_by(|a, b| a.0.total_cmp(&b.0)).map_or(0, |b| b.1)
}

/// Returns whether a Lab colour may be that of wood.
fn wooden(color: [f32; 3]) -> bool {
    let near =
        |focal: &[f32; 3]| (0..3).map(|k| (color[k] - focal[k]).powi(2)).sum::<f32>() < 18.0 * 18.0;
    ATTRIBUTES[COUNT - 1].colors.iter().any(near)
}

/// Returns the attributes of each label 1..=max, measured from the photo's pixels.
pub fn of_masks(photo: &RgbImage, masks: &LabelMap) -> Vec<[f32; COUNT]> {
    let mut counts = vec![[0.0f32; COUNT]; usize::from(masks.max())];
    let mut areas = vec![0.0f32; usize::from(masks.max())];
    for (x, y) in (0..masks.height).flat_map(|y| (0..masks.width).map(move |x| (x, y))) {
        let label = usize::from(masks.at(x, y));
        if label == 0 {
            continue;
        }
        let color = lab(photo
            .get_pixel(
                x * photo.width() / masks.width,
                y * photo.height() / masks.height,
            )
            .0);
        counts[label - 1][nearest(color)] += 1.0;
        counts[label - 1][COUNT - 1] += f32::from(u8::from(wooden(color)));
        areas[label - 1] += 1.0;
    }
    let share = |(counts, area): ([f32; COUNT], f32)| {
        counts.map(|n| MASK_WEIGHT * (n / area.max(1.0) - NEUTRAL))
    };
    counts.into_iter().zip(areas).map(share).collect()
}

/// Returns by how much a text raises the cosine of unrelated masks: 0 if it names no attribute.
pub fn baseline_shift(text: &str) -> f32 {
    let named = of_text(text).0.iter().any(|n| *n > 0.0);
    if named { COLOR_BASELINE_SHIFT } else { 0.0 }
}

/// Returns the attributes that a text names, and the text without them. If nothing else is left,
/// returns the whole text.
pub fn of_text(text: &str) -> ([f32; COUNT], String) {
    let mut named = [0.0; COUNT];
    let mut rest = Vec::new();
    for word in text.split_whitespace() {
        let plain = word.to_lowercase();
        match ATTRIBUTES
            .iter()
            .position(|a| a.words.contains(&plain.as_str()))
        {
            Some(k) => named[k] = 1.0,
            None => rest.push(word),
        }
    }
    let count = named.iter().sum::<f32>().max(1.0);
    let named = named.map(|n: f32| n / count * ATTRIBUTE_WEIGHT / MASK_WEIGHT);
    (
        named,
        if rest.is_empty() {
            text.to_owned()
        } else {
            rest.join(" ")
        },
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    fn dot(a: &[f32; COUNT], b: &[f32; COUNT]) -> f32 {
        a.iter().zip(b).map(|(x, y)| x * y).sum()
    }

    #[test]
    fn colours_are_found_and_taken_from_the_text() {
        let photo = RgbImage::from_fn(4, 1, |x, _| {
            image::Rgb([[200, 20, 30], [90, 60, 130], [110, 75, 45], [10, 10, 12]][x as usize])
        });
        let masks = LabelMap {
            width: 4,
            height: 1,
            labels: vec![1, 2, 3, 4],
        };
        let attributes = of_masks(&photo, &masks);
        for (k, text) in ["red curtain", "purple cloth", "wooden shield", "black pot"]
            .into_iter()
            .enumerate()
        {
            let (named, rest) = of_text(text);
            assert_eq!(Some(rest.as_str()), text.split(' ').nth(1));
            let best = (0..4).max_by(|a, b| {
                dot(&attributes[*a], &named).total_cmp(&dot(&attributes[*b], &named))
            });
            assert_eq!(best, Some(k), "{text}");
            assert!(
                (dot(&attributes[k], &named) - ATTRIBUTE_WEIGHT * (1.0 - NEUTRAL)).abs() < 1e-5
            );
        }
        assert_eq!(of_text("fox"), ([0.0; COUNT], "fox".to_owned()));
        assert_eq!(of_text("Red").1, "Red");
        assert_eq!(
            ["fox", "purple umbrella", "Red"].map(baseline_shift),
            [0.0, COLOR_BASELINE_SHIFT, COLOR_BASELINE_SHIFT]
        );
    }
}
