//! Gaussians in the order of a curve through space: neighbours on the device are then neighbours in pictures as well, and what a step asks for lies
//! together.

use crate::density::State;
use glam::Vec3;

/// Bits of a place along each axis: a thousandth of where most of the scene is.
const BITS: u32 = 10;
/// Standard deviations on both sides of the middle in which places differ; what lies farther has the last.
const REACH: f32 = 2.0;

impl State {
    /// Puts the Gaussians along a Morton curve (Morton 1966).
    pub(crate) fn along_curve(&mut self) {
        let n = self.len() as f32;
        let means: Vec<Vec3> = (0..self.len()).map(|i| self.mean(i)).collect();
        let middle = means.iter().sum::<Vec3>() / n;
        let variance = means.iter().map(|m| (*m - middle).powf(2.0)).sum::<Vec3>() / n;
        let reach = REACH * variance.map(f32::sqrt).max(Vec3::splat(f32::MIN_POSITIVE));
        let cells = (1u32 << BITS) as f32;
        let code = |mean: Vec3| {
            let place = ((mean - middle) / reach * 0.5 + 0.5) * cells;
            place.to_array().into_iter().enumerate().map(|(axis, p)| spread(p.clamp(0.0, cells - 1.0) as u32) << axis).sum::<u32>()
        };
        let mut order: Vec<(u32, usize)> = means.iter().enumerate().map(|(i, mean)| (code(*mean), i)).collect();
        order.sort_unstable();
        self.keep(&order.into_iter().map(|(_, i)| i).collect::<Vec<_>>());
    }
}

/// The lowest bits with two zeros before each.
fn spread(bits: u32) -> u32 {
    (0..BITS).map(|k| (bits >> k & 1) << (3 * k)).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use fastlgs_core::Gaussians;
    use fastlgs_core::rng::Rng;

    #[test]
    fn neighbours_come_to_lie_together() {
        let mut rng = Rng::new(5, "curve");
        let mut scene = Gaussians::default();
        (0..4096).for_each(|_| scene.push_sphere(Vec3::new(rng.normal(), rng.normal(), rng.normal()), 0.1, 0.5, [rng.uniform(); 3]));
        let sorted = |scene: &Gaussians| {
            let mut state = State::of(scene);
            state.along_curve();
            Gaussians::from_channels(&state.params, 0, None)
        };
        let steps = |scene: &Gaussians| scene.means.windows(2).map(|m| m[0].distance(m[1])).sum::<f32>();
        let after = sorted(&scene);
        assert!(steps(&after) < 0.2 * steps(&scene), "{} of {}", steps(&after), steps(&scene));
        // All of them, each with its own values.
        let values = |scene: &Gaussians| {
            let mut all: Vec<[u32; 4]> = (0..scene.len())
                .map(|i| [scene.means[i].x, scene.means[i].y, scene.means[i].z, scene.sh_dc[i].x].map(f32::to_bits))
                .collect();
            all.sort_unstable();
            all
        };
        assert_eq!(values(&after), values(&scene));
        assert_eq!(sorted(&after), after, "what lies along it stays");
        // One Gaussian, or all in one place, have no extent.
        scene.means.fill(Vec3::ONE);
        assert_eq!(sorted(&scene), scene);
        assert_eq!(spread(0b1011), 0b1_000_001_001);
    }
}
