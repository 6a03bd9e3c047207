//! How much the brightness of a set of photos varies, by what the same points look like in two of them.

use crate::keypoints::Keypoints;
use crate::triangulate::PairMatches;
use glam::Vec2;
use image::RgbImage;

/// Fewest matches that tell how bright one photo is against another.
const FEW: usize = 8;
/// Half side of the patch around a key point, in pixels.
const PATCH: i32 = 2;
/// Values near black say nothing about ratios.
const DARK: f32 = 8.0;

/// Mean colour around a point, 0..255.
fn color_at(photo: &RgbImage, at: Vec2) -> [f32; 3] {
    let (w, h) = (photo.width() as i32, photo.height() as i32);
    let mut sum = [0.0; 3];
    for d in 0..(2 * PATCH + 1).pow(2) {
        let (dx, dy) = (d % (2 * PATCH + 1) - PATCH, d / (2 * PATCH + 1) - PATCH);
        let pixel = photo.get_pixel((at.x as i32 + dx).clamp(0, w - 1) as u32, (at.y as i32 + dy).clamp(0, h - 1) as u32);
        sum.iter_mut().zip(pixel.0).for_each(|(s, v)| *s += f32::from(v));
    }
    sum.map(|s| s / (2 * PATCH + 1).pow(2) as f32)
}

fn median(values: &mut [f32]) -> Option<f32> {
    values.sort_by(f32::total_cmp);
    values.get(values.len() / 2).copied()
}

/// The typical difference between two photos of the same thing in stops (factors of two), in the colour channel that differs most: the
/// median over pairs of photos of the median over their matches. 0 where nothing matches.
pub fn spread(photos: &[&RgbImage], points: &[Keypoints], matches: &[PairMatches]) -> f32 {
    let of_channel = |c: usize| {
        let difference = |m: &PairMatches| {
            let at = |view: usize, point: usize| color_at(photos[view], points[view].positions[point])[c];
            let colors = m.pairs.iter().map(|&(i, j)| (at(m.a, i), at(m.b, j)));
            let mut stops: Vec<f32> = colors.filter(|(a, b)| a.min(*b) > DARK).map(|(a, b)| (a / b).log2()).collect();
            if stops.len() < FEW { None } else { median(&mut stops).map(f32::abs) }
        };
        let mut differences: Vec<f32> = matches.iter().filter_map(difference).collect();
        median(&mut differences).unwrap_or(0.0)
    };
    (0..3).map(of_channel).fold(0.0, f32::max)
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::Rgb;

    #[test]
    fn half_the_light_is_one_stop() {
        let photo = |gain: f32| {
            RgbImage::from_fn(40, 40, |x, y| Rgb([120 + (x * 3) as u8 % 90, 100 + y as u8, 140].map(|v| (f32::from(v) * gain) as u8)))
        };
        let (bright, dark) = (photo(1.0), photo(0.5));
        let positions: Vec<Vec2> = (0..20).map(|k| Vec2::new(3.0 + 1.7 * k as f32, 35.0 - k as f32)).collect();
        let points = || Keypoints { positions: positions.clone(), descriptors: vec![[0; 128]; 20] };
        let matches = [PairMatches { a: 0, b: 1, pairs: (0..20).map(|k| (k, k)).collect() }];
        let between = |a, b| spread(&[a, b], &[points(), points()], &matches);
        assert!((between(&bright, &dark) - 1.0).abs() < 0.03);
        assert!(between(&bright, &bright) < 1e-6);
        assert_eq!(spread(&[&bright, &dark], &[points(), points()], &[]), 0.0);
    }
}
