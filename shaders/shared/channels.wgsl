// Channels of the trained values of a Gaussian. Values are stored in pages of [channel][Gaussian of
// the page, padded to a multiple of four], so that no binding exceeds the adapter's limit.
// Mirrors `fastlgs_core::gaussians::BASE_CHANNELS`. SH coefficients from degree 1 on follow,
// coefficient by coefficient.
const MEAN: u32 = 0u;
const LOG_SCALE: u32 = 3u;
const ROTATION: u32 = 6u;
const OPACITY: u32 = 10u;
const COLOR: u32 = 11u;
const FEATURE: u32 = 14u;
const SH_REST: u32 = 17u;

fn stride(page: u32) -> u32 {
    return (page + 3u) & ~3u;
}
