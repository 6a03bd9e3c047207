//! Packs Gaussians for browsers: a header of 32 bytes, then the texels that `web/splat.wgsl` reads.

use fastlgs_core::Gaussians;
use fastlgs_core::gaussians::{rest_len, sigmoid};
use glam::Vec3;

/// Version of the format; `web/frame.js` checks it.
const VERSION: u32 = 1;
const MAGIC: u32 = u32::from_le_bytes(*b"FLGS");
/// Log-scales are stored in 16 bits, from -20 to 10.
const LOG_SCALE_LOW: f32 = -20.0;
const LOG_SCALE_RANGE: f32 = 30.0;

/// Returns the number of 16-byte texels of a Gaussian.
fn texels(sh_degree: u32) -> usize {
    2 + rest_len(sh_degree).div_ceil(4)
}

/// Packs all Gaussians, little-endian.
///
/// The header has eight 32-bit words: magic, version, number of Gaussians, SH degree, texels per
/// Gaussian, largest coefficient of degree 0 (float), largest coefficient of higher degrees
/// (float), 0. A Gaussian has 32 bytes, and 16 more for every four SH coefficients.
pub fn pack(scene: &Gaussians) -> Vec<u8> {
    let largest = |values: &[Vec3]| {
        values
            .iter()
            .fold(1e-6f32, |most, v| most.max(v.abs().max_element()))
    };
    let (color_range, sh_range) = (largest(&scene.sh_dc), largest(&scene.sh_rest));
    let texels = texels(scene.sh_degree);
    let mut words: Vec<u32> = Vec::with_capacity(8 + 4 * texels * scene.len());
    words.extend([
        MAGIC,
        VERSION,
        scene.len() as u32,
        scene.sh_degree,
        texels as u32,
        color_range.to_bits(),
        sh_range.to_bits(),
        0,
    ]);
    for i in 0..scene.len() {
        let scale = (scene.log_scales[i] - LOG_SCALE_LOW) / LOG_SCALE_RANGE;
        let (low, high) = pack_rotation(scene.rotations[i]);
        words.extend(scene.means[i].to_array().map(f32::to_bits));
        words.push(pack_two_16(scale.x, scale.y));
        words.push(pack_two_16(scale.z, sigmoid(scene.opacity_logits[i])));
        words.push(pack_three_10(scene.sh_dc[i] / color_range));
        words.push(low);
        words.push(u32::from(scene.object_ids[i]) << 16 | high);
        words.extend(scene.rest(i).iter().map(|c| pack_three_10(*c / sh_range)));
        words.resize(words.len().next_multiple_of(4), 0);
    }
    words.iter().flat_map(|w| w.to_le_bytes()).collect()
}

/// Quantises a value from 0 to 1 to `bits` bits.
fn fixed(value: f32, bits: u32) -> u32 {
    let most = ((1u32 << bits) - 1) as f32;
    (value.clamp(0.0, 1.0) * most).round() as u32
}

fn pack_two_16(low: f32, high: f32) -> u32 {
    fixed(low, 16) | fixed(high, 16) << 16
}

/// Packs three values from -1 to 1 with ten bits each.
fn pack_three_10(v: Vec3) -> u32 {
    let v = v * 0.5 + 0.5;
    fixed(v.x, 10) | fixed(v.y, 10) << 10 | fixed(v.z, 10) << 20
}

/// Packs a quaternion (w, x, y, z) into 48 bits: its three smallest components in 16, 16 and 14
/// bits, and the index of the largest in two bits.
fn pack_rotation(q: [f32; 4]) -> (u32, u32) {
    let length = q.iter().map(|v| v * v).sum::<f32>().sqrt().max(1e-12);
    let largest = (0..4)
        .max_by(|&a, &b| q[a].abs().total_cmp(&q[b].abs()))
        .expect("four components");
    let sign = if q[largest] < 0.0 { -length } else { length };
    let mut rest = (0..4)
        .filter(|k| *k != largest)
        .map(|k| q[k] / sign * std::f32::consts::FRAC_1_SQRT_2 + 0.5);
    let mut next = || rest.next().expect("three of four are left");
    let (a, b, c) = (next(), next(), next());
    (pack_two_16(a, b), fixed(c, 14) | (largest as u32) << 14)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Same as `unpack_rotation` of `web/splat.wgsl`.
    fn unpack_rotation(low: u32, high: u32) -> [f32; 4] {
        let part = |bits: u32, most: f32| {
            ((bits as f32 / most) * 2.0 - 1.0) * std::f32::consts::FRAC_1_SQRT_2
        };
        let v = [
            part(low & 0xffff, 65535.0),
            part(low >> 16, 65535.0),
            part(high & 0x3fff, 16383.0),
        ];
        let largest = (1.0 - v.iter().map(|v| v * v).sum::<f32>()).max(0.0).sqrt();
        let mut out = v.to_vec();
        out.insert(((high >> 14) & 3) as usize, largest);
        out.try_into().unwrap()
    }

    #[test]
    fn rotations_lose_little() {
        for q in [
            [1.0, 0.0, 0.0, 0.0],
            [-0.1, 0.9, -0.3, 0.2],
            [0.5, -0.5, 0.5, -0.5],
            [0.0, 0.0, 0.01, -3.0],
        ] {
            let (low, high) = pack_rotation(q);
            let back = unpack_rotation(low, high);
            let length = q.iter().map(|v| v * v).sum::<f32>().sqrt();
            let same = q
                .iter()
                .zip(back)
                .map(|(a, b)| a / length * b)
                .sum::<f32>()
                .abs();
            assert!(same > 0.999_999, "{q:?} {back:?}");
            assert_eq!(high >> 16, 0, "the object id needs these bits");
        }
    }

    #[test]
    fn length_is_what_the_header_says() {
        let mut scene = Gaussians::default();
        scene.push_sphere(Vec3::ONE, 0.5, 0.5, [1.0, 0.0, 0.5]);
        scene.push_sphere(Vec3::ZERO, 0.5, 0.5, [0.0; 3]);
        scene.object_ids[1] = 517;
        for (degree, texels) in [(0, 2), (1, 3), (2, 4), (3, 6)] {
            let data = pack(&scene.clone().with_sh_degree(degree));
            let word = |k: usize| u32::from_le_bytes(data[4 * k..4 * k + 4].try_into().unwrap());
            assert_eq!(
                (word(0), word(2), word(3), word(4) as usize),
                (MAGIC, 2, degree, texels)
            );
            assert_eq!(data.len(), 32 + 2 * 16 * texels);
            assert_eq!(word(8 + 4 * texels + 7) >> 16, 517);
            assert_eq!(f32::from_bits(word(8)), 1.0);
        }
    }
}
