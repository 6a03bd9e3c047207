//! Similar photos, found by their key points: which pairs of many photos to match.
//!
//! Each photo gets a vector of locally aggregated descriptors (VLAD; Jegou et al. 2010): of each
//! of its descriptors, the difference to the nearest of a few centres is added up.

use crate::keypoints::Keypoints;
use rayon::prelude::*;

/// Number of centres.
const CENTRES: usize = 64;
/// Number of descriptors from which the centres are computed.
const SAMPLE: usize = 16_384;
/// Number of steps of k-means.
const STEPS: usize = 8;

type Descriptor = [f32; 128];

/// Returns a descriptor whose values have the root of their share of the sum (RootSIFT, Arandjelovic
/// & Zisserman 2012).
fn rooted(descriptor: &[u8; 128]) -> Descriptor {
    let sum: f32 = descriptor.iter().map(|v| f32::from(*v)).sum();
    descriptor.map(|v| (f32::from(v) / sum.max(1.0)).sqrt())
}

fn dot(a: &[f32], b: &[f32]) -> f32 {
    // Eight sums side by side, so that the loop can be vectorised.
    let mut sums = [0.0; 8];
    for (a, b) in a.as_chunks::<8>().0.iter().zip(b.as_chunks::<8>().0) {
        (0..8).for_each(|k| sums[k] += a[k] * b[k]);
    }
    sums.iter().sum()
}

/// Returns the index of the nearest centre. Rooted descriptors have length 1, those of centres vary.
fn nearest(descriptor: &Descriptor, centres: &[Descriptor]) -> usize {
    let closeness = |c: &Descriptor| dot(descriptor, c) - 0.5 * dot(c, c);
    let all: Vec<f32> = centres.iter().map(closeness).collect();
    (0..all.len()).fold(0, |best, k| if all[k] > all[best] { k } else { best })
}

/// Computes the centres by k-means, from descriptors of all photos.
fn centres(photos: &[&Keypoints]) -> Vec<Descriptor> {
    let count: usize = photos.iter().map(|p| p.descriptors.len()).sum();
    let all = photos.iter().flat_map(|p| &p.descriptors);
    let sample: Vec<Descriptor> = all
        .step_by(count.div_ceil(SAMPLE).max(1))
        .map(rooted)
        .collect();
    let mut centres: Vec<Descriptor> = sample
        .iter()
        .step_by(sample.len().div_ceil(CENTRES).max(1))
        .copied()
        .collect();
    for _ in 0..STEPS {
        let own: Vec<usize> = sample.par_iter().map(|d| nearest(d, &centres)).collect();
        let mut sums = vec![([0.0; 128], 0.0f32); centres.len()];
        for (descriptor, own) in sample.iter().zip(own) {
            let (sum, members) = &mut sums[own];
            (0..128).for_each(|k| sum[k] += descriptor[k]);
            *members += 1.0;
        }
        for (centre, (sum, members)) in centres.iter_mut().zip(sums) {
            if members > 0.0 {
                *centre = sum.map(|v| v / members);
            }
        }
    }
    centres
}

/// Returns the vector of a photo, `[centres][128]`. The part of each centre has length 1, so that
/// repeated patterns do not dominate.
fn vector(photo: &Keypoints, centres: &[Descriptor]) -> Vec<f32> {
    let mut vector = vec![0.0; 128 * centres.len()];
    for descriptor in &photo.descriptors {
        let descriptor = rooted(descriptor);
        let own = nearest(&descriptor, centres);
        let part = &mut vector[128 * own..128 * (own + 1)];
        (0..128).for_each(|k| part[k] += descriptor[k] - centres[own][k]);
    }
    for part in vector.chunks_exact_mut(128) {
        let length = dot(part, part).sqrt().max(f32::MIN_POSITIVE);
        part.iter_mut().for_each(|v| *v /= length);
    }
    vector
}

/// Returns for each photo the `count` most similar others, the most similar one first.
pub fn of_each(photos: &[&Keypoints], count: usize) -> Vec<Vec<usize>> {
    let centres = centres(photos);
    let vectors: Vec<Vec<f32>> = photos.par_iter().map(|p| vector(p, &centres)).collect();
    let of = |a: usize| {
        let similar: Vec<f32> = vectors.iter().map(|b| dot(&vectors[a], b)).collect();
        let mut others: Vec<usize> = (0..photos.len()).filter(|b| *b != a).collect();
        others.sort_by(|x, y| similar[*y].total_cmp(&similar[*x]).then(x.cmp(y)));
        others.truncate(count);
        others
    };
    (0..photos.len()).into_par_iter().map(of).collect()
}
