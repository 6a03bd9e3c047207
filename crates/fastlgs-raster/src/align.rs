//! Where a photo was taken, by a scene that stays as it is: Gauss-Newton on the six numbers of a camera, from coarse to fine. Slopes are
//! differences of seven renders, so that every engine can do it, and a handful of steps is enough where descent needs dozens.

use crate::Result;
use crate::channels::Channels;
use crate::engine::{Engine, Exposure};
use crate::target::Target;
use crate::view::View;
use fastlgs_core::Camera;
use glam::{Mat4, Quat, Vec3};
use nalgebra::{SMatrix, SVector};

/// How far the picture moves between the renders that slopes are taken from, in pixels.
const NUDGE: f32 = 0.25;
/// Difference of a pixel's channel from which it counts less: things that moved, highlights.
const SOFT: f32 = 0.1;
/// Steps at a quarter, half and all of the resolution.
pub const STEPS: [usize; 3] = [4, 2, 2];
/// Smallest side of a picture that is compared.
const SMALL: u32 = 24;

/// A turn and a shift of camera space: q becomes exp(turn) q + shift.
type Motion = [f32; 6];

fn moved(camera: &Camera, motion: &Motion) -> Camera {
    let turn = Quat::from_scaled_axis(Vec3::new(motion[0], motion[1], motion[2]));
    let motion = Mat4::from_rotation_translation(turn, Vec3::new(motion[3], motion[4], motion[5]));
    Camera { world_to_camera: motion * camera.world_to_camera, ..camera.clone() }
}

/// The camera near `target`'s from which the engine's Gaussians look most like its photo. `frame` makes the frame of a camera, `steps` are
/// those at a quarter, half and all of the resolution.
///
/// # Errors
/// As [`Engine::render`].
pub fn align(
    engine: &mut dyn Engine,
    frame: impl Fn(&Camera) -> View,
    target: &Target,
    exposure: &Exposure,
    steps: [usize; 3],
) -> Result<Camera> {
    let half = target.halved();
    let quarter = half.halved();
    let Some(depth) = median_depth(engine, frame(&target.camera))? else { return Ok(target.camera.clone()) };
    let mut pose = target.camera.world_to_camera;
    for (level, steps) in [&quarter, &half, target].into_iter().zip(steps) {
        if level.camera.width.min(level.camera.height) < SMALL {
            continue;
        }
        let mut camera = Camera { world_to_camera: pose, ..level.camera.clone() };
        let mut damping = 1e-3;
        let mut render = |camera: &Camera| compared(engine, frame(camera), level, exposure);
        let mut now = render(&camera)?;
        // What fits coarsely need not fit better in detail.
        let given = render(&level.camera)?;
        if cost(&given) < cost(&now) {
            (camera, now) = (level.camera.clone(), given);
        }
        for _ in 0..steps {
            let pixel = NUDGE / camera.fx;
            let sizes = [pixel, pixel, pixel, pixel * depth, pixel * depth, pixel * depth];
            let mut slopes = Vec::with_capacity(6);
            for (k, size) in sizes.into_iter().enumerate() {
                let mut motion = Motion::default();
                motion[k] = size;
                slopes.push(render(&moved(&camera, &motion))?);
            }
            let (mut normal, mut right) = (SMatrix::<f64, 6, 6>::zeros(), SVector::<f64, 6>::zeros());
            for (p, r) in now.iter().enumerate() {
                let row = SVector::<f32, 6>::from_fn(|k, _| slopes[k][p] - r);
                let weight = weight(*r);
                normal += (row * row.transpose() * weight).cast::<f64>();
                right -= (row * (weight * r)).cast::<f64>();
            }
            (0..6).for_each(|k| normal[(k, k)] = normal[(k, k)] * (1.0 + damping) + 1e-12);
            let Some(step) = normal.cholesky().map(|factors| factors.solve(&right)) else { break };
            let next = moved(&camera, &std::array::from_fn(|k| step[k] as f32 * sizes[k]));
            let then = render(&next)?;
            if cost(&then) < cost(&now) {
                (camera, now, damping) = (next, then, damping * 0.1);
            } else {
                damping *= 100.0;
            }
        }
        pose = camera.world_to_camera;
    }
    Ok(Camera { world_to_camera: pose, ..target.camera.clone() })
}

/// Moves all cameras alike, so that on average they stay where they were: as a whole a scene may lie anywhere.
pub(crate) fn keep_mean(before: &[Camera], after: &mut [Camera]) {
    let n = before.len().max(1) as f32;
    let middle = before.iter().map(Camera::centre).sum::<Vec3>() / n;
    // What moves the world so that the camera before sees what the camera after does.
    let motion = |(before, after): (&Camera, &Camera)| after.world_to_camera.inverse() * before.world_to_camera;
    let (mut turn, mut shift) = (Vec3::ZERO, Vec3::ZERO);
    for motion in before.iter().zip(after.iter()).map(motion) {
        turn += Quat::from_mat4(&motion).to_scaled_axis() / n;
        shift += (motion.transform_point3(middle) - middle) / n;
    }
    let back = Mat4::from_translation(middle + shift) * Mat4::from_quat(Quat::from_scaled_axis(turn)) * Mat4::from_translation(-middle);
    after.iter_mut().for_each(|camera| camera.world_to_camera *= back);
}

fn weight(residual: f32) -> f32 {
    1.0 / (1.0 + (residual / SOFT).powi(2))
}

fn cost(residuals: &[f32]) -> f64 {
    residuals.iter().map(|r| f64::from((r / SOFT).powi(2)).ln_1p()).sum()
}

/// Rendered minus photographed colour of every channel of every pixel; 0 where it does not count.
fn compared(engine: &mut dyn Engine, view: View, target: &Target, exposure: &Exposure) -> Result<Vec<f32>> {
    let frame = engine.render(view, Channels::Color)?;
    let difference = |(c, value, packed): (usize, &f32, &u32)| {
        let bytes = packed.to_le_bytes();
        let shown = exposure.gain[c] * value + exposure.offset[c];
        if bytes[3] == 255 { shown - f32::from(bytes[c]) / 255.0 } else { 0.0 }
    };
    let of_channel = |c: usize| frame.channels(c, c + 1).iter().zip(&target.image.color).map(move |(v, p)| (c, v, p)).collect::<Vec<_>>();
    Ok((0..3).flat_map(|c| of_channel(c).into_iter().map(difference).collect::<Vec<_>>()).collect())
}

/// Median depth of what a view sees; none where it sees nothing.
fn median_depth(engine: &mut dyn Engine, view: View) -> Result<Option<f32>> {
    let frame = engine.render(View { depth_as_feature: 1, ..view }, Channels::Feature)?;
    let solid = frame.channels(3, 4).iter().zip(frame.channels(6, 7)).filter(|(_, t)| **t < 0.5);
    let mut depths: Vec<f32> = solid.map(|(z, t)| z / (1.0 - t)).collect();
    depths.sort_by(f32::total_cmp);
    Ok(depths.get(depths.len() / 2).copied())
}
