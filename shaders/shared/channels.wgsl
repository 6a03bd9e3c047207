// Trained floats of a Gaussian, stored [channel][gaussian]. Mirrors `fastlgs_core::gaussians::CHANNELS`.
const MEAN: u32 = 0u;
const LOG_SCALE: u32 = 3u;
const ROTATION: u32 = 6u;
const OPACITY: u32 = 10u;
const COLOR: u32 = 11u;
const FEATURE: u32 = 14u;
const CHANNELS: u32 = 17u;
const SH_C0: f32 = 0.28209479;
