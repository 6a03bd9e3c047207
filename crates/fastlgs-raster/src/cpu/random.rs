//! CPU twin of `shaders/shared/random.wgsl`: a hash.

use glam::UVec3;

/// Returns three random words from three words (PCG3D, Jarzynski & Olano 2020).
pub(crate) fn pcg3d(seed: UVec3) -> UVec3 {
    let step = |v: &mut UVec3| {
        v.x = v.x.wrapping_add(v.y.wrapping_mul(v.z));
        v.y = v.y.wrapping_add(v.z.wrapping_mul(v.x));
        v.z = v.z.wrapping_add(v.x.wrapping_mul(v.y));
    };
    let mut v = seed.map(|s| s.wrapping_mul(1_664_525).wrapping_add(1_013_904_223));
    step(&mut v);
    v ^= v >> 16u32;
    step(&mut v);
    v
}
