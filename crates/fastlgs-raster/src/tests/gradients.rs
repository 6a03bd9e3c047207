//! Tests of all gradients against finite differences of an independent renderer and loss in double
//! precision.

use super::{camera, gpu_in_each_shape};
use crate::density::State;
use crate::view::DEPTH_MOMENTS;
use crate::{
    Channels, CpuEngine, Engine, Exposure, GpuEngine, Step, StepOptions, TargetImage, View, pack,
};
use fastlgs_core::Gaussians;
use fastlgs_core::gaussians::channel::FEATURE;
use fastlgs_core::gaussians::{BASE_CHANNELS, channels as channels_of, rest_len};
use fastlgs_core::rng::Rng;
use glam::{DMat3, DMat4, DQuat, DVec2, DVec3, Vec3};

const SIZE: (usize, usize) = (24, 16);
const LAMBDA: f64 = 0.2;
const FEATURE_WEIGHT: f64 = 0.7;

/// Trained values that are not stored with the Gaussians: background and exposure.
#[derive(Clone)]
struct Surroundings {
    background: [f64; 6],
    gain: [f64; 3],
    offset: [f64; 3],
}

/// A projected Gaussian.
struct Splat {
    depth: f64,
    mean: DVec2,
    /// Inverse covariance: xx, xy, yy.
    conic: [f64; 3],
    opacity: f64,
    values: [f64; 6],
}

/// Renders six planes with the formulas of the 3DGS paper, every Gaussian at every pixel.
fn render(view: &View, params: &[f64], around: &Surroundings) -> Vec<f64> {
    let n = view.gaussians as usize;
    let at = |c: usize, i: usize| params[c * n + i];
    let vec3 = |c: usize, i: usize| DVec3::new(at(c, i), at(c + 1, i), at(c + 2, i));
    let pose = DMat4::from_cols_array(&view.world_to_camera.map(f64::from));
    let eye = pose.inverse().w_axis.truncate();
    let rotation = DMat3::from_mat4(pose);
    let (focal, centre) = (
        DVec2::new(view.focal[0].into(), view.focal[1].into()),
        DVec2::new(view.centre[0].into(), view.centre[1].into()),
    );
    let mut splats: Vec<Splat> = (0..n)
        .map(|i| {
            let t = pose.transform_point3(vec3(0, i));
            let q = DQuat::from_xyzw(at(7, i), at(8, i), at(9, i), at(6, i)).normalize();
            let m = DMat3::from_quat(q) * DMat3::from_diagonal(vec3(3, i).map(f64::exp));
            let jacobian = DMat3::from_cols(
                DVec3::new(focal.x / t.z, 0.0, 0.0),
                DVec3::new(0.0, focal.y / t.z, 0.0),
                DVec3::new(
                    -focal.x * t.x / (t.z * t.z),
                    -focal.y * t.y / (t.z * t.z),
                    0.0,
                ),
            );
            let a = jacobian * rotation * m;
            let cov = a * a.transpose();
            let (xx, xy, yy) = (cov.x_axis.x, cov.x_axis.y, cov.y_axis.y);
            let (dxx, dyy) = (
                xx + f64::from(crate::cpu::DILATION),
                yy + f64::from(crate::cpu::DILATION),
            );
            let det = dxx * dyy - xy * xy;
            let compensation = if view.antialias == 1 {
                ((xx * yy - xy * xy) / det).sqrt()
            } else {
                1.0
            };
            let direction = (vec3(0, i) - eye).normalize();
            let mut color = DVec3::splat(0.5) + 0.282_094_791_773_878_14 * vec3(11, i);
            for (k, basis) in harmonics(direction)
                .into_iter()
                .take(rest_len(view.sh_degree))
                .enumerate()
            {
                color += basis * vec3(17 + 3 * k, i);
            }
            let [x, y, z] = if view.depth_as_feature == DEPTH_MOMENTS {
                [t.z.ln(), t.z.ln().powi(2), 1.0]
            } else {
                [at(14, i), at(15, i), at(16, i)]
            };
            let values = [
                color.x.max(0.0),
                color.y.max(0.0),
                color.z.max(0.0),
                x,
                y,
                z,
            ];
            let left_out =
                crate::cpu::pcg3d(glam::UVec3::new(i as u32, view.draw, 2)).x < view.dropped;
            let gain = if left_out {
                0.0
            } else {
                1.0 / (1.0 - f64::from(view.dropped) / 4_294_967_296.0)
            };
            let opacity = gain * compensation / (1.0 + (-at(10, i)).exp());
            Splat {
                depth: t.z,
                mean: focal * t.truncate() / t.z + centre,
                conic: [dyy / det, -xy / det, dxx / det],
                opacity,
                values,
            }
        })
        .collect();
    splats.sort_by(|a, b| a.depth.total_cmp(&b.depth));
    let (w, h) = SIZE;
    let mut planes = vec![0.0; 6 * w * h];
    for (j, i) in (0..h).flat_map(|j| (0..w).map(move |i| (j, i))) {
        let mut transmittance = 1.0;
        let mut sums = [0.0; 6];
        for Splat {
            mean,
            conic,
            opacity,
            values,
            ..
        } in &splats
        {
            let d = DVec2::new(i as f64 + 0.5, j as f64 + 0.5) - *mean;
            let power =
                -0.5 * (conic[0] * d.x * d.x + 2.0 * conic[1] * d.x * d.y + conic[2] * d.y * d.y);
            let weight = transmittance * opacity * power.exp();
            (0..6).for_each(|c| sums[c] += weight * values[c]);
            transmittance *= 1.0 - opacity * power.exp();
        }
        for c in 0..6 {
            planes[c * w * h + j * w + i] = sums[c] + transmittance * around.background[c];
        }
    }
    planes
}

/// Returns the real spherical harmonics of degrees 1 to 3, from the table of Sloan (2008) with the
/// signs of 3DGS.
fn harmonics(d: DVec3) -> [f64; 15] {
    let (x, y, z) = (d.x, d.y, d.z);
    let pi = std::f64::consts::PI;
    let (c1, c2, c3) = (
        (3.0 / (4.0 * pi)).sqrt(),
        (15.0 / (4.0 * pi)).sqrt(),
        (5.0 / (16.0 * pi)).sqrt(),
    );
    let (c4, c5) = ((35.0 / (32.0 * pi)).sqrt(), (105.0 / (4.0 * pi)).sqrt());
    let (c6, c7) = ((21.0 / (32.0 * pi)).sqrt(), (7.0 / (16.0 * pi)).sqrt());
    [
        -c1 * y,
        c1 * z,
        -c1 * x,
        c2 * x * y,
        -c2 * y * z,
        c3 * (2.0 * z * z - x * x - y * y),
        -c2 * x * z,
        0.5 * c2 * (x * x - y * y),
        -c4 * y * (3.0 * x * x - y * y),
        c5 * x * y * z,
        -c6 * y * (4.0 * z * z - x * x - y * y),
        c7 * z * (2.0 * z * z - 3.0 * x * x - 3.0 * y * y),
        -c6 * x * (4.0 * z * z - x * x - y * y),
        0.5 * c5 * z * (x * x - y * y),
        -c4 * x * (x * x - 3.0 * y * y),
    ]
}

/// Returns (1 - lambda) L1 + lambda (1 - SSIM) of colour, plus the same of the feature times its
/// weight.
fn loss(planes: &[f64], target: &[f64], around: &Surroundings) -> f64 {
    loss_of(0..6, planes, target, around)
}

/// Returns the mean over the pixels of the depth loss; docs/how-it-works.md, 5.7.
fn depth_loss(planes: &[f64], depth: &[f32]) -> f64 {
    let n = depth.len();
    let of_pixel = |(pixel, depth): (usize, &f32)| {
        let [m1, m2, m0] = [3, 4, 5].map(|channel| planes[channel * n + pixel]);
        let depth = f64::from(*depth);
        let (u, weight) = match depth {
            known if known > 0.0 => (known.ln(), 1.0),
            ignored if ignored < 0.0 => (0.0, 0.0),
            _ => (m1 / m0, 0.25),
        };
        let squares = m2 - 2.0 * u * m1 + u * u * m0;
        weight * (squares + 0.01f64.powi(2)).sqrt()
    };
    depth.iter().enumerate().map(of_pixel).sum::<f64>() / n as f64
}

/// Returns the loss of these channels.
fn loss_of(
    channels: std::ops::Range<usize>,
    planes: &[f64],
    target: &[f64],
    around: &Surroundings,
) -> f64 {
    let (w, h) = SIZE;
    let n = w * h;
    let taps: Vec<f64> = (-5i32..=5)
        .map(|k| (-f64::from(k * k) / (2.0 * 1.5 * 1.5)).exp())
        .collect();
    let total: f64 = taps.iter().sum();
    let blurred = |values: &dyn Fn(usize) -> f64, i: usize, j: usize| -> f64 {
        let mut sum = 0.0;
        for (dy, wy) in (-5i32..=5).zip(&taps) {
            for (dx, wx) in (-5i32..=5).zip(&taps) {
                let (x, y) = (i as i32 + dx, j as i32 + dy);
                if x >= 0 && y >= 0 && x < w as i32 && y < h as i32 {
                    sum += wx * wy / (total * total) * values((y * w as i32 + x) as usize);
                }
            }
        }
        sum
    };
    channels
        .map(|c| {
            let x = |p: usize| {
                if c < 3 {
                    around.gain[c] * planes[c * n + p] + around.offset[c]
                } else {
                    planes[c * n + p]
                }
            };
            let y = |p: usize| target[c * n + p];
            let l1 = (0..n).map(|p| (x(p) - y(p)).abs()).sum::<f64>();
            let mut ssim = 0.0;
            for (j, i) in (0..h).flat_map(|j| (0..w).map(move |i| (j, i))) {
                let (mx, my) = (blurred(&x, i, j), blurred(&y, i, j));
                let xx = blurred(&|p| x(p) * x(p), i, j) - mx * mx;
                let yy = blurred(&|p| y(p) * y(p), i, j) - my * my;
                let xy = blurred(&|p| x(p) * y(p), i, j) - mx * my;
                ssim += (2.0 * mx * my + 1e-4) * (2.0 * xy + 9e-4)
                    / ((mx * mx + my * my + 1e-4) * (xx + yy + 9e-4));
            }
            let weight = if c < 3 { 1.0 } else { FEATURE_WEIGHT };
            weight * ((1.0 - LAMBDA) * l1 + LAMBDA * (n as f64 - ssim)) / (3 * n) as f64
        })
        .sum()
}

/// Returns wide, faint Gaussians that cover the whole image, so that no finite difference crosses a
/// cut-off. They are far enough to be drawn.
fn scene(sh_degree: u32) -> Gaussians {
    let mut rng = Rng::new(11, "gradients");
    let mut scene = Gaussians {
        sh_degree,
        ..Gaussians::default()
    };
    for i in 0..6 {
        let mean = Vec3::new(0.4 * rng.normal(), 0.4 * rng.normal(), 0.8 * i as f32 - 1.6);
        scene.push_sphere(
            mean,
            1.0,
            rng.range(0.3, 0.6),
            [
                rng.range(0.3, 0.7),
                rng.range(0.3, 0.7),
                rng.range(0.3, 0.7),
            ],
        );
        scene.log_scales[i] = Vec3::new(
            rng.range(0.6, 1.0),
            rng.range(0.6, 1.0),
            rng.range(0.4, 0.9),
        );
        scene.rotations[i] = [
            1.0,
            0.4 * rng.normal(),
            0.4 * rng.normal(),
            0.4 * rng.normal(),
        ];
        scene.features[i] = Vec3::new(rng.uniform(), rng.uniform(), rng.uniform());
    }
    scene
        .sh_rest
        .iter_mut()
        .for_each(|v| *v = 0.05 * Vec3::new(rng.normal(), rng.normal(), rng.normal()));
    scene
}

fn check(engine: &mut dyn Engine, sh_degree: u32, antialias: u32) {
    let scene = scene(sh_degree);
    let n = scene.len();
    let around = Surroundings {
        background: [0.1, 0.3, 0.2, 0.6, 0.5, 0.4],
        gain: [1.1, 0.95, 1.0],
        offset: [0.02, -0.01, 0.03],
    };
    let [r, g, b, x, y, z] = around.background.map(|v| v as f32);
    let view = View {
        antialias,
        background_color: [r, g, b, 0.0],
        background_feature: [x, y, z, 0.0],
        ..View::new(&camera(SIZE.0 as u32, SIZE.1 as u32), n, sh_degree)
    };
    // This draw leaves out one of the six Gaussians.
    let view = if sh_degree == 1 {
        view.with_dropout(0.2, 6)
    } else {
        view
    };
    let wave = |i: usize| (127.0 + 100.0 * (i as f64 * 0.05).sin()) as u8;
    let pixels = SIZE.0 * SIZE.1;
    let plane = |from: usize| {
        (0..pixels)
            .map(|p| pack([0, 1, 2].map(|c| wave((from + c) * pixels + p)), true))
            .collect()
    };
    let target = TargetImage {
        size: view.size,
        color: plane(0),
        feature: plane(3),
        depth: Vec::new(),
    };
    let target_values: Vec<f64> = (0..6 * pixels)
        .map(|i| f64::from(wave(i)) / 255.0)
        .collect();

    engine.set_state(&State::of(&scene)).unwrap();
    engine.set_target(0, target).unwrap();
    let exposure = Exposure {
        gain: around.gain.map(|v| v as f32),
        offset: around.offset.map(|v| v as f32),
    };
    let options = StepOptions {
        channels: Channels::Coupled,
        lambda: LAMBDA as f32,
        feature_weight: FEATURE_WEIGHT as f32,
        exposure,
        depth_weight: 0.0,
    };
    engine
        .step(
            view,
            0,
            &options,
            &Step::new(1, 0..channels_of(sh_degree), &[0.0; BASE_CHANNELS + 1]),
        )
        .unwrap();
    let (gradients, losses) = (engine.gradients().unwrap(), engine.losses().unwrap());

    let params: Vec<f64> = scene.to_channels().into_iter().map(f64::from).collect();
    let step = 1e-5;
    let central_difference = |at: &dyn Fn(f64) -> f64| (at(step) - at(-step)) / (2.0 * step);
    let what = format!(
        "{}, degree {sh_degree}, antialias {antialias}",
        engine.name()
    );
    for c in 0..channels_of(sh_degree) {
        let largest = gradients[c * n..(c + 1) * n]
            .iter()
            .fold(0.0f32, |m, g| m.max(g.abs()));
        for k in c * n..(c + 1) * n {
            let difference = central_difference(&|delta| {
                let mut shifted_params = params.clone();
                shifted_params[k] += delta;
                loss(
                    &render(&view, &shifted_params, &around),
                    &target_values,
                    &around,
                )
            });
            let (found, allowed) = (f64::from(gradients[k]), 2e-3 * f64::from(largest) + 1e-7);
            assert!(
                (difference - found).abs() <= allowed,
                "channel {c} of Gaussian {}: {found} against {difference} ({what})",
                k - c * n
            );
        }
    }
    let check_surroundings =
        |what_moves: &str, found: f64, change: &dyn Fn(&mut Surroundings, f64)| {
            let difference = central_difference(&|delta| {
                let mut around = around.clone();
                change(&mut around, delta);
                loss(&render(&view, &params, &around), &target_values, &around)
            });
            assert!(
                (difference - found).abs() <= 2e-3 * difference.abs() + 1e-6,
                "{what_moves}: {found} against {difference} ({what})"
            );
        };
    for c in 0..6 {
        check_surroundings("background", losses.by_background[c], &|a, delta| {
            a.background[c] += delta
        });
    }
    for c in 0..3 {
        check_surroundings("gain", losses.by_gain[c], &|a, delta| a.gain[c] += delta);
        check_surroundings("offset", losses.by_offset[c], &|a, delta| {
            a.offset[c] += delta
        });
    }
}

/// Checks the gradients of a step with a depth loss. Of three neighbouring pixels, one has a known
/// depth, one an unknown one, and the loss ignores one.
fn check_depth(engine: &mut dyn Engine) {
    const WEIGHT: f64 = 0.4;
    let scene = scene(1);
    let n = scene.len();
    let around = Surroundings {
        background: [0.1, 0.3, 0.2, 0.0, 0.0, 0.0],
        gain: [1.0; 3],
        offset: [0.0; 3],
    };
    let view = View::new(&camera(SIZE.0 as u32, SIZE.1 as u32), n, 1)
        .with_background([0.1, 0.3, 0.2])
        .with_depth_moments();
    let pixels = SIZE.0 * SIZE.1;
    let depth: Vec<f32> = (0..pixels)
        .map(|pixel| [3.0 + 0.01 * pixel as f32, 0.0, -1.0][pixel % 3])
        .collect();
    let target = TargetImage {
        size: view.size,
        color: vec![pack([90, 120, 150], true); pixels],
        feature: Vec::new(),
        depth: depth.clone(),
    };
    let colors = [90.0, 120.0, 150.0].map(|value: f64| vec![value / 255.0; pixels]);
    let colors = colors.concat();
    engine.set_state(&State::of(&scene)).unwrap();
    engine.set_target(0, target.clone()).unwrap();
    let options = StepOptions {
        channels: Channels::Coupled,
        lambda: LAMBDA as f32,
        feature_weight: 0.0,
        exposure: Exposure::default(),
        depth_weight: WEIGHT as f32,
    };
    let step = Step::new(1, 0..FEATURE.start, &[0.0; BASE_CHANNELS + 1]);
    engine.step(view, 0, &options, &step).unwrap();
    let gradients = engine.gradients().unwrap();
    let params: Vec<f64> = scene.to_channels().into_iter().map(f64::from).collect();
    let loss = |params: &[f64]| {
        let planes = render(&view, params, &around);
        loss_of(0..3, &planes, &colors, &around) + WEIGHT * depth_loss(&planes, &depth)
    };
    for c in 0..channels_of(1) {
        let of_channel = &gradients[c * n..(c + 1) * n];
        let largest = of_channel.iter().fold(0.0f32, |m, g| m.max(g.abs()));
        for k in c * n..(c + 1) * n {
            let moved = |delta: f64| {
                let mut params = params.clone();
                params[k] += delta;
                loss(&params)
            };
            let difference = (moved(1e-5) - moved(-1e-5)) / 2e-5;
            let (found, allowed) = (f64::from(gradients[k]), 2e-3 * f64::from(largest) + 1e-6);
            assert!(
                (difference - found).abs() <= allowed,
                "channel {c} of Gaussian {}: {found} against {difference} ({})",
                k - c * n,
                engine.name()
            );
        }
    }
    let stats = engine.stats().unwrap();
    assert!(stats.iter().all(|v| *v == 0.0), "no colour gradient counts");
    let without = TargetImage {
        depth: Vec::new(),
        ..target
    };
    engine.set_target(0, without).unwrap();
    let refused = engine.step(view, 0, &options, &step).unwrap_err();
    assert!(refused.to_string().contains("depth"), "{refused}");
}

/// Checks a Gaussian whose opacity reaches its limit only by the gain of DropGaussian. A loss that
/// asks for more opacity must give the gradient 0.
fn check_limit(engine: &mut dyn Engine) {
    let mut scene = Gaussians::default();
    // 0.9 / (1 - 0.2) is above the largest opacity.
    scene.push_sphere(Vec3::ZERO, 1.0, 0.9, [1.0; 3]);
    let (w, h) = (SIZE.0 as u32, SIZE.1 as u32);
    let drawn = |draw: u32| View::new(&camera(w, h), 1, 0).with_dropout(0.2, draw);
    let is_drawn =
        |view: &View| crate::cpu::pcg3d(glam::UVec3::new(0, view.draw, 2)).x >= view.dropped;
    let view = (0..)
        .map(drawn)
        .find(is_drawn)
        .expect("most draws keep the Gaussian");
    engine.set_state(&State::of(&scene)).unwrap();
    let target = TargetImage {
        size: view.size,
        color: vec![pack([255; 3], true); SIZE.0 * SIZE.1],
        feature: Vec::new(),
        depth: Vec::new(),
    };
    engine.set_target(0, target).unwrap();
    let exposure = Exposure {
        gain: [1.0; 3],
        offset: [0.0; 3],
    };
    let options = StepOptions {
        channels: Channels::Color,
        lambda: 0.0,
        feature_weight: 0.0,
        exposure,
        depth_weight: 0.0,
    };
    engine
        .step(
            view,
            0,
            &options,
            &Step::new(1, 0..channels_of(0), &[0.0; BASE_CHANNELS + 1]),
        )
        .unwrap();
    assert_eq!(engine.gradients().unwrap()[10], 0.0, "{}", engine.name());
}

#[test]
fn on_the_cpu() {
    check_limit(&mut CpuEngine::new());
    check_depth(&mut CpuEngine::new());
    for (sh_degree, antialias) in [(0, 0), (1, 1), (2, 0), (3, 1)] {
        check(&mut CpuEngine::new(), sh_degree, antialias);
    }
}

#[test]
fn on_the_gpu() {
    for gpu in gpu_in_each_shape() {
        let mut engine = GpuEngine::new(gpu);
        check_limit(&mut engine);
        check_depth(&mut engine);
        for (sh_degree, antialias) in [(0, 1), (1, 0), (2, 1), (3, 0)] {
            check(&mut engine, sh_degree, antialias);
        }
    }
}
