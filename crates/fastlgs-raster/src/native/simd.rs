//! SIMD arithmetic: [`fastlgs_core::simd`] for loops that the compiler vectorises, [`Vector`] for
//! loops that it does not.

pub(super) use fastlgs_core::vectorised;

#[cfg(target_arch = "x86_64")]
pub(super) use x86::{Avx2, Avx512};

/// Returns a * b + c, fused if `FMA`.
#[inline(always)]
pub fn madd<const FMA: bool>(a: f32, b: f32, c: f32) -> f32 {
    if FMA { a.mul_add(b, c) } else { a * b + c }
}

/// Number of Gaussians that [`prefetch`] runs ahead of scattered reads.
pub const AHEAD: usize = 8;

/// Prefetches a value of up to two cache lines into the cache.
#[inline(always)]
pub fn prefetch<T>(value: &T) {
    #[cfg(target_arch = "x86_64")]
    {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        let first = std::ptr::from_ref(value).cast::<i8>();
        for end in [first, first.wrapping_add(size_of::<T>() - 1)] {
            // SAFETY: a prefetch is only a hint, and the addresses lie in `value`.
            unsafe { _mm_prefetch::<_MM_HINT_T0>(end) };
        }
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = value;
}

/// Number of floats of a gradient slot.
pub const SLOT_FLOATS: usize = 12;

/// One SIMD register of floats.
///
/// The type is explicit because, in a body with many sums, the compiler packs sums instead of
/// pixels into registers and mostly shuffles.
pub trait Vector: Copy {
    /// Number of floats.
    const LANES: usize;

    /// Returns a vector with `value` in all lanes.
    fn splat(value: f32) -> Self;
    /// Loads the first values of a slice. Panics if the slice is too short.
    fn load(from: &[f32]) -> Self;
    /// Writes to the first values of a slice. Panics if the slice is too short.
    fn store(self, to: &mut [f32]);
    /// Returns self + b.
    fn add(self, b: Self) -> Self;
    /// Returns self - b.
    fn sub(self, b: Self) -> Self;
    /// Returns self * b.
    fn mul(self, b: Self) -> Self;
    /// Returns self / b.
    fn div(self, b: Self) -> Self;
    /// Returns self * b + c.
    fn madd(self, b: Self, c: Self) -> Self;
    /// Returns the larger value of each lane; `b` if either is NaN.
    fn max(self, b: Self) -> Self;
    /// Returns the smaller value of each lane; `b` if either is NaN.
    fn min(self, b: Self) -> Self;
    /// Returns self, with 0 in lanes that are below `least` or NaN.
    fn at_least_or_zero(self, least: Self) -> Self;
    /// Returns the sum of the lanes of each vector.
    fn lane_sums(all: &[Self; SLOT_FLOATS]) -> [f32; SLOT_FLOATS];

    /// Splits self into the nearest integers, as [`Self::times_power_of_two`] expects them, and the
    /// remainders.
    fn split(self) -> (Self, Self);
    /// Returns self * 2^k, with k from [`Self::split`].
    fn times_power_of_two(self, k: Self) -> Self;

    /// Returns 2^self for self up to 126, with a relative error of about 2e-7. Below -126 the
    /// result lies between 0 and 2^-126.
    #[inline(always)]
    // One coefficient is close to ln 2.
    #[allow(clippy::approx_constant)]
    fn exp2(self) -> Self {
        let (k, f) = self.split();
        // Polynomial of degree 5 with p(0) = 1 and the least maximum relative error on [-1/2, 1/2].
        let mut p = Self::splat(1.326_472_7e-3);
        for c in [
            9.671_513e-3,
            5.550_733_6e-2,
            2.402_224_2e-1,
            6.931_47e-1,
            1.0,
        ] {
            p = p.madd(f, Self::splat(c));
        }
        p.times_power_of_two(k)
    }
}

/// 1.5 * 2^23. Adding it rounds to the nearest integer, which is then in the lowest mantissa bits.
const ROUND: f32 = 12_582_912.0;

/// Implements [`Vector::split`] without a rounding instruction.
#[inline(always)]
fn split<V: Vector>(x: V) -> (V, V) {
    let x = x.max(V::splat(-126.0));
    let shifted = x.add(V::splat(ROUND));
    (shifted, x.sub(shifted.sub(V::splat(ROUND))))
}

/// `N` floats in an array. The compiler chooses the registers.
#[derive(Clone, Copy)]
pub struct Portable<const N: usize>([f32; N]);

impl<const N: usize> Portable<N> {
    #[inline(always)]
    fn zip_with(self, b: Self, f: impl Fn(f32, f32) -> f32) -> Self {
        Self(std::array::from_fn(|i| f(self.0[i], b.0[i])))
    }
}

impl<const N: usize> Vector for Portable<N> {
    const LANES: usize = N;

    #[inline(always)]
    fn splat(value: f32) -> Self {
        Self([value; N])
    }

    #[inline(always)]
    fn load(from: &[f32]) -> Self {
        Self(*from.first_chunk().expect("slice holds a vector"))
    }

    #[inline(always)]
    fn store(self, to: &mut [f32]) {
        *to.first_chunk_mut().expect("slice holds a vector") = self.0;
    }

    #[inline(always)]
    fn add(self, b: Self) -> Self {
        self.zip_with(b, |a, b| a + b)
    }

    #[inline(always)]
    fn sub(self, b: Self) -> Self {
        self.zip_with(b, |a, b| a - b)
    }

    #[inline(always)]
    fn mul(self, b: Self) -> Self {
        self.zip_with(b, |a, b| a * b)
    }

    #[inline(always)]
    fn div(self, b: Self) -> Self {
        self.zip_with(b, |a, b| a / b)
    }

    #[inline(always)]
    fn madd(self, b: Self, c: Self) -> Self {
        Self(std::array::from_fn(|i| {
            madd::<{ cfg!(target_arch = "aarch64") }>(self.0[i], b.0[i], c.0[i])
        }))
    }

    #[inline(always)]
    fn max(self, b: Self) -> Self {
        self.zip_with(b, |a, b| if a > b { a } else { b })
    }

    #[inline(always)]
    fn min(self, b: Self) -> Self {
        self.zip_with(b, |a, b| if a < b { a } else { b })
    }

    #[inline(always)]
    fn at_least_or_zero(self, least: Self) -> Self {
        self.zip_with(least, |a, least| if a >= least { a } else { 0.0 })
    }

    #[inline(always)]
    fn split(self) -> (Self, Self) {
        split(self)
    }

    #[inline(always)]
    fn times_power_of_two(self, k: Self) -> Self {
        self.zip_with(k, |a, k| {
            f32::from_bits(a.to_bits().wrapping_add(k.to_bits() << 23))
        })
    }

    #[inline(always)]
    fn lane_sums(all: &[Self; SLOT_FLOATS]) -> [f32; SLOT_FLOATS] {
        std::array::from_fn(|k| {
            let (mut v, mut n) = (all[k].0, N);
            while n > 1 {
                n /= 2;
                (0..n).for_each(|i| v[i] += v[i + n]);
            }
            v[0]
        })
    }
}

#[cfg(target_arch = "x86_64")]
mod x86 {
    //! SIMD registers of x86-64. The functions of a type require the instructions that the type is
    //! named after; [`super::dispatched`] checks for them. Slices that are too short cause a panic.

    use super::{SLOT_FLOATS, Vector};
    use std::arch::x86_64::*;

    /// Eight floats: AVX2 and FMA.
    #[derive(Clone, Copy)]
    pub struct Avx2(__m256);

    /// Sixteen floats: AVX-512 F and DQ.
    #[derive(Clone, Copy)]
    pub struct Avx512(__m512);

    /// Implements methods by intrinsics.
    macro_rules! by_intrinsics {
        ($(fn $name:ident($($arg:ident),*) = $body:expr;)*) => {
            $(
                #[inline(always)]
                fn $name(self $(, $arg: Self)*) -> Self {
                    let a = self.0;
                    $(let $arg = $arg.0;)*
                    // SAFETY: see the module.
                    Self(unsafe { $body(a $(, $arg)*) })
                }
            )*
        };
    }

    impl Vector for Avx2 {
        const LANES: usize = 8;

        by_intrinsics! {
            fn add(b) = _mm256_add_ps;
            fn sub(b) = _mm256_sub_ps;
            fn mul(b) = _mm256_mul_ps;
            fn div(b) = _mm256_div_ps;
            fn madd(b, c) = _mm256_fmadd_ps;
            fn max(b) = _mm256_max_ps;
            fn min(b) = _mm256_min_ps;
            fn at_least_or_zero(least) = |a, least| _mm256_and_ps(a, _mm256_cmp_ps::<_CMP_GE_OQ>(a, least));
            fn times_power_of_two(k) = |a, k| {
                let exponent = _mm256_slli_epi32::<23>(_mm256_castps_si256(k));
                _mm256_castsi256_ps(_mm256_add_epi32(_mm256_castps_si256(a), exponent))
            };
        }

        #[inline(always)]
        fn split(self) -> (Self, Self) {
            super::split(self)
        }

        #[inline(always)]
        fn splat(value: f32) -> Self {
            // SAFETY: see the module.
            Self(unsafe { _mm256_set1_ps(value) })
        }

        #[inline(always)]
        fn load(from: &[f32]) -> Self {
            assert!(from.len() >= Self::LANES, "slice is shorter than a vector");
            // SAFETY: see the module.
            Self(unsafe { _mm256_loadu_ps(from.as_ptr()) })
        }

        #[inline(always)]
        fn store(self, to: &mut [f32]) {
            assert!(to.len() >= Self::LANES, "slice is shorter than a vector");
            // SAFETY: see the module.
            unsafe { _mm256_storeu_ps(to.as_mut_ptr(), self.0) }
        }

        #[inline(always)]
        fn lane_sums(all: &[Self; SLOT_FLOATS]) -> [f32; SLOT_FLOATS] {
            let mut out = [0.0; SLOT_FLOATS];
            // SAFETY: see the module; `out` holds 8 + 4 floats.
            unsafe {
                // Adds the halves of two vectors, then the quarters of four, then the eighths of
                // eight.
                let halves = |i: usize, j: usize| {
                    let (a, b) = (all[i].0, all[j].0);
                    _mm256_add_ps(
                        _mm256_permute2f128_ps::<0x20>(a, b),
                        _mm256_permute2f128_ps::<0x31>(a, b),
                    )
                };
                let quarters = |a, b| {
                    _mm256_add_ps(
                        _mm256_shuffle_ps::<0x44>(a, b),
                        _mm256_shuffle_ps::<0xee>(a, b),
                    )
                };
                let [low, high] = [
                    quarters(halves(0, 4), halves(1, 5)),
                    quarters(halves(2, 6), halves(3, 7)),
                ];
                _mm256_storeu_ps(out.as_mut_ptr(), _mm256_hadd_ps(low, high));
                let half = |i: usize| {
                    _mm_add_ps(
                        _mm256_castps256_ps128(all[i].0),
                        _mm256_extractf128_ps::<1>(all[i].0),
                    )
                };
                let last = _mm_hadd_ps(
                    _mm_hadd_ps(half(8), half(9)),
                    _mm_hadd_ps(half(10), half(11)),
                );
                _mm_storeu_ps(out[8..].as_mut_ptr(), last);
            }
            out
        }
    }

    impl Vector for Avx512 {
        const LANES: usize = 16;

        by_intrinsics! {
            fn add(b) = _mm512_add_ps;
            fn sub(b) = _mm512_sub_ps;
            fn mul(b) = _mm512_mul_ps;
            fn div(b) = _mm512_div_ps;
            fn madd(b, c) = _mm512_fmadd_ps;
            fn max(b) = _mm512_max_ps;
            fn min(b) = _mm512_min_ps;
            fn at_least_or_zero(least) = |a, least| _mm512_maskz_mov_ps(_mm512_cmp_ps_mask::<_CMP_GE_OQ>(a, least), a);
            fn times_power_of_two(k) = _mm512_scalef_ps;
        }

        #[inline(always)]
        fn split(self) -> (Self, Self) {
            // SAFETY: see the module.
            let whole = Self(unsafe { _mm512_roundscale_ps::<_MM_FROUND_TO_NEAREST_INT>(self.0) });
            (whole, self.sub(whole))
        }

        #[inline(always)]
        fn splat(value: f32) -> Self {
            // SAFETY: see the module.
            Self(unsafe { _mm512_set1_ps(value) })
        }

        #[inline(always)]
        fn load(from: &[f32]) -> Self {
            assert!(from.len() >= Self::LANES, "slice is shorter than a vector");
            // SAFETY: see the module.
            Self(unsafe { _mm512_loadu_ps(from.as_ptr()) })
        }

        #[inline(always)]
        fn store(self, to: &mut [f32]) {
            assert!(to.len() >= Self::LANES, "slice is shorter than a vector");
            // SAFETY: see the module.
            unsafe { _mm512_storeu_ps(to.as_mut_ptr(), self.0) }
        }

        #[inline(always)]
        fn lane_sums(all: &[Self; SLOT_FLOATS]) -> [f32; SLOT_FLOATS] {
            let mut halves = [Avx2::splat(0.0); SLOT_FLOATS];
            for (half, v) in halves.iter_mut().zip(all) {
                // SAFETY: see the module.
                half.0 = unsafe {
                    _mm256_add_ps(
                        _mm512_castps512_ps256(v.0),
                        _mm512_extractf32x8_ps::<1>(v.0),
                    )
                };
            }
            Avx2::lane_sums(&halves)
        }
    }
}

/// `dispatched! { fn name<const ...>(args) = body }` defines `name`, which runs `body::<V, ...>`
/// with the widest [`Vector`] of the processor. `body` must be `#[inline(always)]`.
macro_rules! dispatched {
    ($(#[$doc:meta])* fn $name:ident $(<$(const $p:ident: bool),+>)? ($($arg:ident: $ty:ty),* $(,)?) = $body:ident) => {
        $(#[$doc])*
        pub fn $name $(<$(const $p: bool),+>)? ($($arg: $ty),*) {
            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw,avx2,fma")]
                fn avx512 $(<$(const $p: bool),+>)? ($($arg: $ty),*) {
                    $body::<$crate::native::simd::Avx512 $($(, $p)+)?>($($arg),*);
                }
                #[target_feature(enable = "avx2,fma")]
                fn avx2 $(<$(const $p: bool),+>)? ($($arg: $ty),*) {
                    $body::<$crate::native::simd::Avx2 $($(, $p)+)?>($($arg),*);
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
            $body::<$crate::native::simd::Portable<8> $($(, $p)+)?>($($arg),*);
        }
    };
}
pub(super) use dispatched;

#[cfg(test)]
mod tests {
    use super::*;

    dispatched! {
        /// Checks the widest vectors of the processor.
        fn widest(check: &mut u32) = check_body
    }

    /// Checks vector arithmetic against scalar arithmetic.
    #[inline(always)]
    fn check_body<V: Vector>(checked: &mut u32) {
        let read = |v: V| {
            let mut out = [0.0; 16];
            v.store(&mut out);
            out
        };
        let values: Vec<f32> = (0..400).map(|k| 0.37 * k as f32 - 60.0).collect();
        for start in 0..values.len() - 32 {
            let (a, b) = (&values[start..], &values[start + 16..]);
            let (x, y) = (V::load(a), V::load(b));
            let all = [
                read(x.add(y)),
                read(x.sub(y)),
                read(x.mul(y)),
                read(x.div(y)),
                read(x.max(y)),
                read(x.madd(y, V::splat(3.0))),
            ];
            let (least, powers) = (read(x.at_least_or_zero(V::splat(a[3]))), read(x.exp2()));
            for i in 0..V::LANES {
                let expected = [
                    a[i] + b[i],
                    a[i] - b[i],
                    a[i] * b[i],
                    a[i] / b[i],
                    a[i].max(b[i]),
                    a[i] * b[i] + 3.0,
                ];
                for (found, expected) in all.iter().zip(expected) {
                    assert!(
                        (found[i] - expected).abs() <= 1e-6 * expected.abs().max(100.0),
                        "{} and {}: {}",
                        a[i],
                        b[i],
                        found[i]
                    );
                }
                assert_eq!(least[i], if a[i] >= a[3] { a[i] } else { 0.0 });
                assert!(
                    (powers[i] - a[i].exp2()).abs() <= 3e-7 * a[i].exp2(),
                    "2^{}: {}",
                    a[i],
                    powers[i]
                );
            }
            let rows: [V; SLOT_FLOATS] = std::array::from_fn(|k| V::load(&values[start + k..]));
            for (k, sum) in V::lane_sums(&rows).into_iter().enumerate() {
                let expected: f32 = values[start + k..][..V::LANES].iter().sum();
                assert!(
                    (sum - expected).abs() < 1e-3,
                    "sum {k}: {sum} instead of {expected}"
                );
            }
        }
        for low in [-1e9, -1000.5, -160.0, -127.3] {
            assert!(
                (0.0..1.2e-38).contains(&read(V::splat(low).exp2())[0]),
                "2^{low}"
            );
        }
        // Alphas are computed like this. NaN must give 0.
        let alpha = |x: f32| {
            read(
                V::splat(-0.5)
                    .min(V::splat(x))
                    .exp2()
                    .at_least_or_zero(V::splat(0.01)),
            )[0]
        };
        assert_eq!([f32::NAN, f32::NEG_INFINITY, -200.0].map(alpha), [0.0; 3]);
        assert_eq!([f32::INFINITY, 1e9].map(alpha), [alpha(-0.5); 2]);
        *checked += V::LANES as u32;
    }

    #[test]
    fn vector_arithmetic_equals_scalar_arithmetic() {
        let mut checked = 0;
        check_body::<Portable<8>>(&mut checked);
        check_body::<Portable<16>>(&mut checked);
        widest(&mut checked);
        println!(
            "checked: portable vectors of 8 and 16 lanes, and vectors of {} lanes",
            checked - 24
        );
        assert!(checked >= 32);
        #[cfg(target_arch = "x86_64")]
        if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
            #[target_feature(enable = "avx2,fma")]
            fn avx2(checked: &mut u32) {
                check_body::<Avx2>(checked);
            }
            // SAFETY: the features were found a line above.
            unsafe { avx2(&mut checked) };
        }
    }
}
