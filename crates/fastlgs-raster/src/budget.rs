//! No more Gaussians than the scene needs (`--budget auto`).
//!
//! The scene grows as far as its gradients ask and the limit allows; once it has grown, Gaussians are removed without which the photos would
//! hardly change: each is judged by what the training views would gain or lose
//! without it alone (as weights of a network are in Optimal Brain Damage, LeCun et al. 1990), and those that change least go, as many as together
//! change no more than a share, `AFFORDABLE`, of the squared error that is left, or fewer where that costs more than `AT_ONCE`. So a scene that shows its photos nearly without error keeps what is faint in
//! it, and what could only fit the noise of others goes. The rest of the run refines what is left, which takes over what went: together
//! they cost more at once than one by one, and in the end next to nothing.

use serde::{Deserialize, Serialize};

/// How much all that is removed at once may change the training views, one by one, as a share of their squared error.
const AFFORDABLE: f64 = 0.05;
/// How many dB a removal may cost at once: as much as twice the squared error. Where a scene shows its photos badly nearly all of it would be
/// affordable, and what each of many hides or holds back adds up to more than each alone.
const AT_ONCE: f64 = 3.01;
/// How often the share is halved until nothing goes.
const HALVINGS: usize = 9;
/// Colour keeps the lowest SH degree that loses no more than this on the watched views, in dB.
pub const DEGREE_LOSS: f64 = 0.02;
/// Every so many training views one is watched.
pub(crate) const WATCHED: usize = 10;
/// Where fewer would be left to train on, none is: of 28 views, the three that wait cost the held-out ones 1.7 dB.
const FEW: usize = 40;

/// Whether training view `index` of `count` is watched and not trained on while the scene grows.
pub(crate) fn is_watched(index: usize, count: usize) -> bool {
    count >= FEW + count / WATCHED && index % WATCHED == WATCHED / 2
}

/// What a removal cost, for reports.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Removal {
    /// Steps done before it.
    pub iteration: u32,
    /// Gaussians before it.
    pub before: usize,
    /// Gaussians after it.
    pub after: usize,
    /// PSNR in dB of the watched views before it, or of every tenth where none is watched; none where no pixel counts.
    pub psnr_before: Option<f64>,
    /// The same right after it, before what is left was refined.
    pub psnr_after: Option<f64>,
}

impl Removal {
    /// Whether it cost no more than it may at once, as far as that is known.
    pub(crate) fn is_bearable(&self) -> bool {
        self.psnr_before.zip(self.psnr_after).is_none_or(|(before, after)| before - after <= AT_ONCE)
    }
}

/// Places of those that may stay where so much squared error is left: the fewest first, in the end all.
pub(crate) fn candidates(changes: &[f32], squared_error: f64) -> impl Iterator<Item = Vec<usize>> {
    let shares = std::iter::successors(Some(AFFORDABLE), |share| Some(0.5 * share)).take(1 + HALVINGS);
    shares.map(move |share| needed(changes, share * squared_error)).chain(std::iter::once_with(|| (0..changes.len()).collect()))
}

/// Places of those that stay where so much squared error is affordable; all, if none were to.
fn needed(changes: &[f32], affordable: f64) -> Vec<usize> {
    let mut places: Vec<usize> = (0..changes.len()).collect();
    places.sort_by(|&a, &b| changes[a].total_cmp(&changes[b]).then(a.cmp(&b)));
    let mut sum = 0.0;
    let removed = places.iter().take_while(|&&i| {
        sum += f64::from(changes[i]);
        sum <= affordable
    });
    let removed = removed.count();
    let mut stay = places.split_off(if removed < changes.len() { removed } else { 0 });
    stay.sort_unstable();
    stay
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::change::Changes;
    use crate::view::View;
    use fastlgs_core::{Camera, Gaussians};
    use glam::Vec3;

    #[test]
    fn what_no_photo_shows_goes_and_what_makes_a_difference_stays() {
        let camera = Camera::look_at("a", Vec3::new(0.0, 0.0, -4.0), Vec3::ZERO, Vec3::Y, 64, 48, 0.8);
        let other = Camera::look_at("b", Vec3::new(0.0, 0.0, 4.0), Vec3::ZERO, Vec3::Y, 64, 48, 0.8);
        let mut scene = Gaussians::default();
        for depth in [0.0, 0.1, 0.2] {
            scene.push_sphere(Vec3::Z * depth, 0.2, 0.99, [0.5; 3]);
        }
        scene.push_sphere(Vec3::Z * 0.3, 0.05, 0.99, [0.9; 3]);
        scene.push_sphere(Vec3::new(0.5, 0.5, 0.0), 0.05, 0.01, [0.5; 3]);
        let [camera, other] = [camera, other].map(|c| View::new(&c, scene.len(), 0));
        let mut changes = Changes::of(&scene);
        changes.see(&camera, None);
        let one = changes.each.clone();
        changes.see(&other, None);
        let both = changes.each;
        // From one side the small one is hidden; the faint one is seen from both, but hardly.
        assert!(one[3] < 1e-4 * one[0] && both[3] > 100.0 * one[3], "{one:?} {both:?}");
        let error = f64::from(both[4]);
        assert_eq!(needed(&one, 2.0 * error), [0, 1, 2]);
        assert_eq!(needed(&both, 2.0 * error), [0, 1, 2, 3]);
        assert_eq!(needed(&both, 0.5 * error), [0, 1, 2, 3, 4]);
    }

    #[test]
    fn less_and_less_goes_until_a_removal_is_bearable() {
        let changes: Vec<f32> = (0..100).map(|i| 0.01 * i as f32).collect();
        let stay: Vec<usize> = candidates(&changes, 100.0).map(|places| places.len()).collect();
        assert_eq!(stay.len(), 2 + HALVINGS);
        assert!(stay.is_sorted() && stay[0] < stay[1], "{stay:?}");
        assert_eq!(stay[1 + HALVINGS], 100, "in the end nothing goes");
        let removal = |psnr_after| Removal { iteration: 1, before: 2, after: 1, psnr_before: Some(20.0), psnr_after };
        let bearable = [Some(17.5), Some(16.5), None].map(|after| removal(after).is_bearable());
        assert_eq!(bearable, [true, false, true]);
    }

    #[test]
    fn what_goes_adds_up_to_what_is_affordable() {
        assert_eq!(needed(&[0.5, 0.0, 0.4, 0.3, 9.0], 1.0), [0, 4]);
        assert_eq!(needed(&[0.5, 0.0, 0.4, 0.3, 9.0], 0.0), [0, 2, 3, 4], "what nobody sees goes in any case");
        assert_eq!(needed(&[0.3; 5], 1.0), [3, 4], "of equals the first");
        assert_eq!(needed(&[0.3; 3], 1.0), [0, 1, 2], "where all could go, it is the judgement that is wrong");
    }
}
