// The 11-tap Gaussian window (sigma 1.5) of SSIM, and the job of its passes: one channel at a time.
struct Plane {
    width: u32,
    height: u32,
    // Channel of the picture.
    channel: u32,
    // Weight of this channel's loss / number of its pixels.
    scale: f32,
    // The paper's lambda: share of D-SSIM against L1.
    lambda: f32,
    unused0: u32,
    unused1: u32,
    unused2: u32,
}

// Outputs an invocation computes, sharing their inputs in registers.
const RUN: u32 = 8u;
const REACH: u32 = 18u;

const WINDOW = array<f32, 11>(
    0.0010283801, 0.0075987581, 0.0360007721, 0.1093606895, 0.2130055377, 0.2660117249,
    0.2130055377, 0.1093606895, 0.0360007721, 0.0075987581, 0.0010283801,
);
