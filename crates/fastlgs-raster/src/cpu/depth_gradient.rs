//! CPU twin of `shaders/depth_gradient.wgsl`: gradient of the depth loss by the depth moments.

use crate::view::DepthLoss;

/// Spread of ln z below which the loss is quadratic.
const SOFTNESS: f32 = 0.01;
/// Weight of pixels with an unknown depth, relative to the others.
const GATHERING: f32 = 0.25;
/// Opacity below which a pixel has no depth.
const MIN_OPACITY: f32 = 0.001;

/// Writes dL/d frame of the depth moments, channels 3 to 5.
pub fn depth_gradient(loss: &DepthLoss, frame: &[f32], targets: &[u32], gradient: &mut [f32]) {
    let width = 4 * loss.quads as usize;
    let plane = width * loss.rows as usize;
    for pixel in 0..plane {
        let inside = pixel % width < loss.size[0] as usize && pixel / width < loss.size[1] as usize;
        let moments = [3, 4, 5].map(|channel| frame[channel * plane + pixel]);
        let depth = f32::from_bits(targets[2 * plane + pixel]);
        let scale = if inside { loss.scale } else { 0.0 };
        let by_moments = depth_gradient_at(moments, depth, scale);
        for (channel, value) in (3..6).zip(by_moments) {
            gradient[channel * plane + pixel] = value;
        }
    }
}

/// Returns the gradient of one pixel with the weight `scale` by its moments `[m1, m2, m0]`. `depth`
/// is the target: 0 if it is unknown, negative if the loss ignores the pixel. Symbols are those of
/// docs/how-it-works.md, 5.7.
#[inline(always)]
pub(crate) fn depth_gradient_at([m1, m2, m0]: [f32; 3], depth: f32, scale: f32) -> [f32; 3] {
    let (u, share) = if depth > 0.0 {
        (depth.ln(), 1.0)
    } else {
        (m1 / m0.max(MIN_OPACITY), GATHERING)
    };
    let squares = (m2 - 2.0 * u * m1 + u * u * m0).max(0.0);
    let counts = m0 >= MIN_OPACITY && depth >= 0.0;
    let weight = if counts { share * scale } else { 0.0 };
    let by_m2 = 0.5 * weight / (squares + SOFTNESS * SOFTNESS).sqrt();
    [-2.0 * u * by_m2, by_m2, u * u * by_m2]
}
