//! One body, compiled for what the processor has: AVX-512, AVX2 with FMA, or the baseline.

/// `vectorised! { fn name<const ...>(args) -> T = body }`: `name` runs `body::<FMA, ...>` with the widest vectors there are.
/// The body is an `#[inline(always)]` function whose first const parameter says whether a fused multiply-add is cheap.
macro_rules! vectorised {
    ($(#[$doc:meta])* fn $name:ident $(<$(const $p:ident: bool),+>)? ($($arg:ident: $ty:ty),* $(,)?) = $body:ident) => {
        $(#[$doc])*
        pub fn $name $(<$(const $p: bool),+>)? ($($arg: $ty),*) {
            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw,avx2,fma")]
                fn avx512 $(<$(const $p: bool),+>)? ($($arg: $ty),*) {
                    $body::<true $($(, $p)+)?>($($arg),*);
                }
                #[target_feature(enable = "avx2,fma")]
                fn avx2 $(<$(const $p: bool),+>)? ($($arg: $ty),*) {
                    $body::<true $($(, $p)+)?>($($arg),*);
                }
                if is_x86_feature_detected!("avx512dq") && is_x86_feature_detected!("avx512vl") && is_x86_feature_detected!("avx512bw") {
                    // SAFETY: the features were found a line above; avx512dq implies avx512f.
                    return unsafe { avx512 $(::<$($p),+>)? ($($arg),*) };
                }
                if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
                    // SAFETY: the features were found a line above.
                    return unsafe { avx2 $(::<$($p),+>)? ($($arg),*) };
                }
            }
            $body::<{ cfg!(target_arch = "aarch64") } $($(, $p)+)?>($($arg),*);
        }
    };
}
pub(super) use vectorised;

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
