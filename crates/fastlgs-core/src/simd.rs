//! A macro that compiles one function for AVX-512, AVX2 with FMA, and the baseline, and selects at
//! run time.

/// Defines a function that runs its body with the widest vectors of the processor:
/// `vectorised! { fn name<const ...>(args) = body }` calls `body::<FMA, ...>(args)`.
///
/// The body is an `#[inline(always)]` function that returns nothing. Its first const parameter is
/// true if a fused multiply-add is fast.
#[macro_export]
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
                    // SAFETY: the features were detected above; avx512dq implies avx512f, which
                    // implies avx2 and fma.
                    return unsafe { avx512 $(::<$($p),+>)? ($($arg),*) };
                }
                if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
                    // SAFETY: the features were detected above.
                    return unsafe { avx2 $(::<$($p),+>)? ($($arg),*) };
                }
            }
            $body::<{ cfg!(target_arch = "aarch64") } $($(, $p)+)?>($($arg),*);
        }
    };
}
