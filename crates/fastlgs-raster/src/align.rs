//! Aligns a camera to a fixed scene by damped Gauss-Newton, from coarse to fine.
//!
//! The six parameters are a rotation and a translation. Derivatives are finite differences of seven
//! renders, so every engine can compute them. A few steps suffice where gradient descent needs
//! dozens.

use crate::Result;
use crate::channels::Channels;
use crate::engine::{Engine, Exposure};
use crate::target::Target;
use crate::view::View;
use fastlgs_core::Camera;
use fastlgs_core::stats;
use glam::{Mat4, Quat, Vec3};
use nalgebra::{SMatrix, SVector};

/// Image motion between the renders of a finite difference, in pixels.
const DIFFERENCE_PX: f32 = 0.25;
/// Scale of the robust loss, as a residual of a colour channel (0 to 1). Moved objects and
/// highlights exceed it and lose weight.
const RESIDUAL_SCALE: f32 = 0.1;
/// Numbers of Gauss-Newton steps at a quarter, half and full resolution.
pub const STEPS: [usize; 3] = [4, 2, 2];
/// Levels whose shorter side has fewer pixels are skipped.
const MIN_SIDE: u32 = 24;

/// Rotation vector and translation in camera space: q becomes exp(rotation) q + translation.
type Motion = [f32; 6];

fn move_camera(camera: &Camera, motion: &Motion) -> Camera {
    let turn = Quat::from_scaled_axis(Vec3::new(motion[0], motion[1], motion[2]));
    let motion = Mat4::from_rotation_translation(turn, Vec3::new(motion[3], motion[4], motion[5]));
    Camera {
        world_to_camera: motion * camera.world_to_camera,
        ..camera.clone()
    }
}

/// Returns the camera of `target` at the nearby pose whose render is most similar to the photo.
///
/// `view_of` returns the view of a camera. `steps` are the numbers of steps at a quarter, half and
/// full resolution. The camera is returned unchanged if no pixel of its render is opaque
/// (transmittance below 0.5).
///
/// # Errors
/// As [`Engine::render`].
pub fn align(
    engine: &mut dyn Engine,
    view_of: impl Fn(&Camera) -> View,
    target: &Target,
    exposure: &Exposure,
    steps: [usize; 3],
) -> Result<Camera> {
    let half = target.halved();
    let quarter = half.halved();
    let Some(depth) = median_depth(engine, view_of(&target.camera))? else {
        return Ok(target.camera.clone());
    };
    let mut pose = target.camera.world_to_camera;
    for (level, steps) in [&quarter, &half, target].into_iter().zip(steps) {
        if level.camera.width.min(level.camera.height) < MIN_SIDE {
            continue;
        }
        let mut camera = Camera {
            world_to_camera: pose,
            ..level.camera.clone()
        };
        let mut damping = 1e-3;
        let mut render = |camera: &Camera| residuals_of(engine, view_of(camera), level, exposure);
        let mut residuals = render(&camera)?;
        // The pose from the coarser level may fit this level worse than the given pose.
        let start_residuals = render(&level.camera)?;
        if cost(&start_residuals) < cost(&residuals) {
            (camera, residuals) = (level.camera.clone(), start_residuals);
        }
        for _ in 0..steps {
            let pixel = DIFFERENCE_PX / camera.fx;
            let sizes = [
                pixel,
                pixel,
                pixel,
                pixel * depth,
                pixel * depth,
                pixel * depth,
            ];
            let mut slopes = Vec::with_capacity(6);
            for (k, size) in sizes.into_iter().enumerate() {
                let mut motion = Motion::default();
                motion[k] = size;
                slopes.push(render(&move_camera(&camera, &motion))?);
            }
            let (mut normal, mut right) =
                (SMatrix::<f64, 6, 6>::zeros(), SVector::<f64, 6>::zeros());
            for (p, r) in residuals.iter().enumerate() {
                let row = SVector::<f32, 6>::from_fn(|k, _| slopes[k][p] - r);
                let weight = weight(*r);
                normal += (row * row.transpose() * weight).cast::<f64>();
                right -= (row * (weight * r)).cast::<f64>();
            }
            (0..6).for_each(|k| normal[(k, k)] = normal[(k, k)] * (1.0 + damping) + 1e-12);
            let Some(step) = normal.cholesky().map(|factors| factors.solve(&right)) else {
                break;
            };
            let next = move_camera(&camera, &std::array::from_fn(|k| step[k] as f32 * sizes[k]));
            let next_residuals = render(&next)?;
            if cost(&next_residuals) < cost(&residuals) {
                (camera, residuals, damping) = (next, next_residuals, damping * 0.1);
            } else {
                damping *= 100.0;
            }
        }
        pose = camera.world_to_camera;
    }
    Ok(Camera {
        world_to_camera: pose,
        ..target.camera.clone()
    })
}

/// Moves all cameras by one rigid motion that restores their mean pose. Photos do not determine
/// where the scene as a whole lies.
pub(crate) fn restore_mean_pose(before: &[Camera], after: &mut [Camera]) {
    let n = before.len().max(1) as f32;
    let middle = before.iter().map(Camera::centre).sum::<Vec3>() / n;
    // Rigid motion M of the world for each camera, with after * M = before.
    let motion = |(before, after): (&Camera, &Camera)| {
        after.world_to_camera.inverse() * before.world_to_camera
    };
    let (mut turn, mut shift) = (Vec3::ZERO, Vec3::ZERO);
    for motion in before.iter().zip(after.iter()).map(motion) {
        turn += Quat::from_mat4(&motion).to_scaled_axis() / n;
        shift += (motion.transform_point3(middle) - middle) / n;
    }
    let back = Mat4::from_translation(middle + shift)
        * Mat4::from_quat(Quat::from_scaled_axis(turn))
        * Mat4::from_translation(-middle);
    after
        .iter_mut()
        .for_each(|camera| camera.world_to_camera *= back);
}

fn weight(residual: f32) -> f32 {
    1.0 / (1.0 + (residual / RESIDUAL_SCALE).powi(2))
}

fn cost(residuals: &[f32]) -> f64 {
    residuals
        .iter()
        .map(|r| f64::from((r / RESIDUAL_SCALE).powi(2)).ln_1p())
        .sum()
}

/// Returns rendered minus photographed colour, `[3][h][w]`; 0 at pixels that the loss ignores.
fn residuals_of(
    engine: &mut dyn Engine,
    view: View,
    target: &Target,
    exposure: &Exposure,
) -> Result<Vec<f32>> {
    let frame = engine.render(view, Channels::Color)?;
    let difference = |(c, value, packed): (usize, &f32, &u32)| {
        let bytes = packed.to_le_bytes();
        let rendered = exposure.gain[c] * value + exposure.offset[c];
        if bytes[3] == 255 {
            rendered - f32::from(bytes[c]) / 255.0
        } else {
            0.0
        }
    };
    let of_channel = |c: usize| {
        frame
            .channels(c, c + 1)
            .iter()
            .zip(&target.image.color)
            .map(move |(v, p)| (c, v, p))
            .collect::<Vec<_>>()
    };
    Ok((0..3)
        .flat_map(|c| {
            of_channel(c)
                .into_iter()
                .map(difference)
                .collect::<Vec<_>>()
        })
        .collect())
}

/// Returns the median depth of the pixels whose transmittance is below 0.5; `None` if there are
/// none.
fn median_depth(engine: &mut dyn Engine, view: View) -> Result<Option<f32>> {
    let frame = engine.render(view.with_depth_as_feature(), Channels::Feature)?;
    let solid = frame
        .channels(3, 4)
        .iter()
        .zip(frame.transmittance())
        .filter(|(_, t)| **t < 0.5);
    Ok(stats::median(solid.map(|(z, t)| z / (1.0 - t))))
}
