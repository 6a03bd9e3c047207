//! Arithmetic of the vectorised bodies ([`fastlgs_core::simd`]).

pub(super) use fastlgs_core::vectorised;

/// a * b + c.
#[inline(always)]
pub fn madd<const FMA: bool>(a: f32, b: f32, c: f32) -> f32 {
    if FMA { a.mul_add(b, c) } else { a * b + c }
}

/// 2^x for x between -126 and 126, within 2e-7 of it; smaller x are taken for -126.
#[inline(always)]
pub fn exp2<const FMA: bool>(x: f32) -> f32 {
    // Adding 1.5 * 2^23 rounds to the nearest integer, which then stands in the lowest bits.
    const ROUND: f32 = 12_582_912.0;
    let x = if x > -126.0 { x } else { -126.0 };
    let shifted = x + ROUND;
    let f = x - (shifted - ROUND);
    let mut p = 1.540_353e-4;
    for c in [1.333_355_8e-3, 9.618_129e-3, 5.550_411e-2, 2.402_265e-1, 6.931_472e-1, 1.0] {
        p = madd::<FMA>(p, f, c);
    }
    f32::from_bits(p.to_bits().wrapping_add(shifted.to_bits() << 23))
}

#[cfg(test)]
mod tests {
    #[test]
    fn exp2_is_close() {
        for k in -1260..=0 {
            let x = k as f32 * 0.1;
            for value in [super::exp2::<false>(x), super::exp2::<true>(x)] {
                assert!((value - x.exp2()).abs() <= 3e-7 * x.exp2(), "{x}: {value}");
            }
        }
        assert!(super::exp2::<false>(-1e9) < 1e-37);
    }
}
