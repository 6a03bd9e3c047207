//! Tests: every pass against its CPU twin, both engines against each other, gradients against
//! finite differences.

mod alignment;
mod engines;
mod gradients;
mod passes;
mod training;

use crate::{Channels, Gpu, Shape, TargetImage, pack};
use fastlgs_core::rng::Rng;
use fastlgs_core::{Camera, Gaussians};
use glam::Vec3;

/// Opens the adapter. Without one, prints that the test is skipped, or panics if
/// FASTLGS_REQUIRE_GPU is set (test.sh sets it).
pub(crate) fn gpu() -> Option<Gpu> {
    match Gpu::open("auto") {
        Ok(gpu) => Some(gpu),
        Err(e) if std::env::var_os("FASTLGS_REQUIRE_GPU").is_some() => panic!("{e}"),
        Err(e) => {
            crate::skip::skip(format_args!("{e}"));
            None
        }
    }
}

/// Opens the adapter once for each kernel shape.
pub(crate) fn gpu_in_each_shape() -> impl Iterator<Item = Gpu> {
    Shape::ALL.into_iter().filter_map(|shape| {
        let mut gpu = gpu()?;
        gpu.shape = shape;
        Some(gpu)
    })
}

pub(crate) fn camera(width: u32, height: u32) -> Camera {
    Camera::look_at(
        "test",
        Vec3::new(0.3, 0.5, -4.0),
        Vec3::ZERO,
        Vec3::Y,
        width,
        height,
        0.9,
    )
}

/// Returns a random cloud around the origin. `with_edge_cases` adds Gaussians that must not be
/// drawn or are hard to draw.
pub(crate) fn cloud(n: usize, seed: u64, sh_degree: u32, with_edge_cases: bool) -> Gaussians {
    let mut rng = Rng::new(seed, "cloud");
    // Larger clouds have smaller Gaussians, as trained scenes do.
    let shrink = (n as f32 / 20_000.0).max(1.0).ln();
    let mut scene = Gaussians {
        sh_degree,
        ..Gaussians::default()
    };
    for i in 0..n {
        let mean = Vec3::new(rng.normal(), rng.normal(), rng.normal());
        scene.push_sphere(
            mean,
            0.05,
            rng.range(0.05, 0.95),
            [rng.uniform(), rng.uniform(), rng.uniform()],
        );
        scene.log_scales[i] = Vec3::new(
            rng.range(-4.0, -1.5),
            rng.range(-4.0, -1.5),
            rng.range(-4.0, -1.5),
        ) - shrink;
        scene.rotations[i] = [rng.normal(), rng.normal(), rng.normal(), rng.normal()];
        scene.features[i] = Vec3::new(rng.uniform(), rng.uniform(), rng.uniform());
    }
    scene
        .sh_rest
        .iter_mut()
        .for_each(|v| *v = 0.1 * Vec3::new(rng.normal(), rng.normal(), rng.normal()));
    if with_edge_cases {
        let at = |x: f32| Vec3::new(x, 0.0, 0.0);
        scene.push_sphere(Vec3::new(0.0, 0.0, -9.0), 0.1, 0.5, [1.0; 3]); // behind the camera
        scene.push_sphere(at(f32::NAN), 0.1, 0.5, [1.0; 3]);
        scene.push_sphere(at(0.1), 1e-8, 0.9, [1.0, 0.0, 0.0]);
        scene.push_sphere(at(0.2), 4.0, 0.1, [0.0, 1.0, 0.0]); // fills the image, but is drawn
        scene.push_sphere(at(0.22), 50.0, 0.1, [0.0, 1.0, 0.0]); // contains the camera
        scene.push_sphere(at(0.25), 1e30, 0.1, [0.0, 1.0, 0.0]); // covariance is not finite
        scene.push_sphere(at(0.3), 0.1, 0.5, [0.0, 0.0, 1.0]);
        scene.push_sphere(at(0.3), 0.1, 0.5, [1.0, 0.0, 1.0]); // same depth as the previous one
        *scene.opacity_logits.last_mut().unwrap() = 40.0; // opacity 1
        scene.push_sphere(at(0.4), 0.1, 0.5, [1.0; 3]);
        *scene.opacity_logits.last_mut().unwrap() = -40.0; // opacity 0
        scene.push_sphere(at(0.5), 0.1, 0.5, [1.0; 3]);
        *scene.rotations.last_mut().unwrap() = [0.0; 4]; // zero quaternion
        // Colours are clamped at black. The gradient there depends on rounding, which differs
        // between devices.
        scene.sh_dc[n..]
            .iter_mut()
            .for_each(|c| *c = c.max(Vec3::splat(-1.7)));
    }
    scene
}

/// Returns a target of waves. Every 31st pixel does not enter the loss.
pub(crate) fn target(width: u32, height: u32) -> TargetImage {
    let wave = |i: u32, c: u32| (127.0 + 100.0 * ((i + 977 * c) as f32 * 0.013).sin()) as u8;
    let plane = |from: u32| {
        (0..width * height)
            .map(|i| {
                pack(
                    [wave(i, from), wave(i, from + 1), wave(i, from + 2)],
                    i % 31 != 0,
                )
            })
            .collect()
    };
    TargetImage {
        size: [width, height],
        color: plane(0),
        feature: plane(3),
        depth: Vec::new(),
    }
}

const CHANNELS: [Channels; 4] = [
    Channels::Color,
    Channels::Feature,
    Channels::Both,
    Channels::Coupled,
];

fn floats(words: &[u32]) -> &[f32] {
    bytemuck::cast_slice(words)
}

/// Asserts that `a` and `b` agree within `tolerance`, except for the share `flips` of the values.
/// Values flip where a Gaussian crosses a cut-off.
fn assert_close(what: &str, a: &[f32], b: &[f32], tolerance: f32, flips: f64) {
    assert_eq!(a.len(), b.len(), "{what}: lengths");
    let scale = b
        .iter()
        .filter(|v| v.is_finite())
        .fold(0.0f32, |m, v| m.max(v.abs()))
        .max(1e-6);
    let agree = |a: f32, b: f32| {
        (a - b).abs() <= tolerance * (scale * 0.01 + b.abs()) || (a.is_nan() && b.is_nan())
    };
    let off = a.iter().zip(b).filter(|(a, b)| !agree(**a, **b)).count();
    let worst = a
        .iter()
        .zip(b)
        .map(|(a, b)| (a - b).abs())
        .fold(0.0f32, f32::max);
    let share = off as f64 / a.len().max(1) as f64;
    assert!(
        share <= flips,
        "{what}: {off} of {} values differ (worst {worst}, scale {scale})",
        a.len()
    );
}
