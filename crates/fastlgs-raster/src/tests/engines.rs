//! Tests of whole frames and steps: GPU against CPU, several pages and windows against one, CPU
//! twins in place of GPU passes.

use super::{CHANNELS, assert_close, camera, cloud, gpu, gpu_in_each_shape, target};
use crate::density::State;
use crate::{Channels, CpuEngine, Engine, ExposedPhoto, Exposure, GpuEngine, StepOptions};
use crate::{Step, View};
use fastlgs_core::LabelMap;
use fastlgs_core::gaussians::{BASE_CHANNELS, channels as channels_of};

fn options(channels: Channels) -> StepOptions {
    let exposure = Exposure {
        gain: [1.1, 0.9, 1.0],
        offset: [0.02, 0.0, -0.03],
    };
    StepOptions {
        channels,
        lambda: 0.2,
        feature_weight: 0.7,
        exposure,
        depth_weight: 0.0,
    }
}

/// Returns the frame (requested channels and transmittance), gradients and losses of one step with
/// learning rates of 0.
fn one_step(
    engine: &mut dyn Engine,
    view: View,
    channels: Channels,
    state: &State,
    size: (u32, u32),
) -> (Vec<f32>, Vec<f32>, crate::Losses) {
    engine.set_state(state).unwrap();
    engine.set_target(0, target(size.0, size.1)).unwrap();
    let frame = engine.render(view, channels).unwrap();
    let all = 0..channels_of(state.sh_degree);
    engine
        .step(
            view,
            0,
            &options(channels),
            &Step::new(1, all, &[0.0; BASE_CHANNELS + 1]),
        )
        .unwrap();
    let n = (size.0 * size.1) as usize;
    let asked = |c: usize| {
        if c < 3 {
            channels.color()
        } else {
            c >= 6 || channels.feature()
        }
    };
    let planes = frame.data.chunks_exact(n).take(7).enumerate();
    assert!(
        planes
            .clone()
            .filter(|(c, _)| !asked(*c))
            .all(|(_, plane)| plane.iter().all(|v| *v == 0.0)),
        "channels that were not requested are 0"
    );
    let shown = planes
        .filter(|(c, _)| asked(*c))
        .flat_map(|(_, plane)| plane.to_vec())
        .collect();
    (shown, engine.gradients().unwrap(), engine.losses().unwrap())
}

#[test]
fn gpu_and_cpu_agree() {
    let mut devices: Vec<_> = gpu_in_each_shape().map(GpuEngine::new).collect();
    let mut cpu = CpuEngine::new();
    let cases = [
        (1, 17, 13, 0),
        (2000, 96, 64, 3),
        (20_000, 270, 480, 1),
        (200_000, 1440, 1080, 0),
    ];
    for (k, (n, w, h, degree)) in cases.into_iter().enumerate() {
        let scene = cloud(n, 21, degree, true);
        let state = State::of(&scene);
        let view = View {
            antialias: k as u32 % 2,
            background_color: [0.1, 0.2, 0.3, 0.0],
            background_feature: [0.3, 0.2, 0.1, 0.0],
            ..View::new(&camera(w, h), scene.len(), degree)
        };
        let view = if k == 1 {
            view.with_dropout(0.25, 7)
        } else {
            view
        };
        for channels in CHANNELS.into_iter().take(if n > 100_000 { 1 } else { 4 }) {
            let b = one_step(&mut cpu, view, channels, &state, (w, h));
            for device in &mut devices {
                let what = format!(
                    "{n} Gaussians at {w}x{h}, {channels:?}, {:?}",
                    device.gpu.shape
                );
                let a = one_step(device, view, channels, &state, (w, h));
                assert_close(&format!("frame, {what}"), &a.0, &b.0, 2e-3, 0.002);
                for c in 0..channels_of(degree) {
                    let range = c * scene.len()..(c + 1) * scene.len();
                    assert_close(
                        &format!("gradient of channel {c}, {what}"),
                        &a.1[range.clone()],
                        &b.1[range],
                        0.03,
                        0.02,
                    );
                }
                let near = |a: f64, b: f64| {
                    assert!(
                        (a - b).abs() <= 1e-4 + 2e-3 * b.abs(),
                        "{what}: {a} against {b}"
                    )
                };
                near(a.2.color_l1, b.2.color_l1);
                near(a.2.color_ssim, b.2.color_ssim);
                near(a.2.feature_l1, b.2.feature_l1);
                (0..3).for_each(|c| near(a.2.by_gain[c], b.2.by_gain[c]));
                (0..3).for_each(|c| near(a.2.by_offset[c], b.2.by_offset[c]));
                (0..6).for_each(|c| near(a.2.by_background[c], b.2.by_background[c]));
            }
        }
    }
}

#[test]
fn gpu_and_cpu_agree_on_votes_and_saliency() {
    let Some(mut small) = gpu() else { return };
    let (width, height) = (97, 61);
    let scene = cloud(3000, 21, 1, true);
    let view = View::new(&camera(width, height), scene.len(), 1);
    // Enough for the histograms of the sort, but not for all votes at once.
    small.max_binding = 1 << 18;
    let mut labels = LabelMap::new(width, height);
    for (p, label) in labels.labels.iter_mut().enumerate() {
        *label = (p as u32 % width / 5) as u16;
    }
    let image = target(width, height);
    let photo = ExposedPhoto {
        image: &image,
        exposure: options(Channels::Color).exposure,
    };
    let results = |engine: &mut dyn Engine| {
        engine.set_state(&State::of(&scene)).unwrap();
        let mut of_label = vec![0.0; scene.len() * 32];
        for vote in engine.votes(view, &labels).unwrap() {
            of_label[32 * vote.gaussian as usize + usize::from(vote.label)] = vote.weight;
        }
        let mut scores = vec![0.0; scene.len()];
        let error = engine.saliency(view, Some(&photo), &mut scores).unwrap();
        (of_label, scores, error)
    };
    let cpu = results(&mut CpuEngine::new());
    assert!(cpu.0.iter().filter(|weight| **weight > 0.1).count() > 1000);
    let mut mixed = GpuEngine::new(gpu().expect("opened above"));
    mixed.passes_on_cpu = 1000;
    for mut engine in [
        GpuEngine::new(gpu().expect("opened above")),
        GpuEngine::new(small),
        mixed,
    ] {
        let device = results(&mut engine);
        assert_close("votes", &device.0, &cpu.0, 0.01, 0.002);
        assert_close("saliency", &device.1, &cpu.1, 0.01, 0.005);
        assert!((device.2 - cpu.2).abs() < 1e-3 * cpu.2);
    }
    let wrong_size = CpuEngine::new().votes(view, &LabelMap::new(8, 8));
    assert!(wrong_size.unwrap_err().to_string().contains("8x8"));
}

#[test]
fn several_pages_and_windows_give_the_result_of_one() {
    let scene = cloud(12_000, 5, 1, true);
    let state = State::of(&scene);
    let view = View::new(&camera(96, 64), scene.len(), 1).with_dropout(0.25, 7);
    for (whole, mut small) in gpu_in_each_shape().zip(gpu_in_each_shape()) {
        // Trained values need 26 x 4 bytes for each Gaussian and may be split into pages. Splats
        // need 48 bytes for each Gaussian in one binding.
        small.max_binding = 48 * scene.len() as u64 + 16;
        assert!(
            u64::from(26 * scene.len() as u32 * 4) > small.max_binding / 2,
            "the trained values need several pages"
        );
        let shape = whole.shape;
        let (mut whole, mut small) = (GpuEngine::new(whole), GpuEngine::new(small));
        for channels in CHANNELS {
            let a = one_step(&mut whole, view, channels, &state, (96, 64));
            let b = one_step(&mut small, view, channels, &state, (96, 64));
            assert_eq!(a.0, b.0, "{channels:?}, {shape:?}");
            // Runs of slots start elsewhere in each window, so that sums are added in another
            // order.
            if shape.fold() == 1 {
                assert_eq!(a.1, b.1, "{channels:?}, {shape:?}");
            }
            assert_close(
                &format!("gradients, {channels:?}, {shape:?}"),
                &a.1,
                &b.1,
                1e-3,
                0.001,
            );
        }
    }
    // Half of that cannot hold the splats. The engine must report an error.
    let Some(mut tiny) = super::gpu() else { return };
    tiny.max_binding = 24 * scene.len() as u64;
    let message = GpuEngine::new(tiny)
        .set_state(&state)
        .unwrap_err()
        .to_string();
    assert!(
        message.contains("lower the option size or budget"),
        "{message}"
    );
}

#[test]
fn first_passes_can_run_as_cpu_twins() {
    let scene = cloud(300, 6, 1, false);
    let state = State::of(&scene);
    let view = View::new(&camera(40, 30), scene.len(), 1);
    for mut engine in gpu_in_each_shape().map(GpuEngine::new) {
        let reference = one_step(&mut engine, view, Channels::Both, &state, (40, 30));
        for passes in [1, 14, 30, 34, 40, 58, 1000] {
            engine.passes_on_cpu = passes;
            let mixed = one_step(&mut engine, view, Channels::Both, &state, (40, 30));
            let what = format!("{passes} passes, {:?}", engine.gpu.shape);
            assert_close(
                &format!("frame, {what}"),
                &mixed.0,
                &reference.0,
                2e-3,
                0.002,
            );
            assert_close(
                &format!("gradients, {what}"),
                &mixed.1,
                &reference.1,
                0.03,
                0.01,
            );
        }
    }
}

#[test]
fn frozen_geometry_keeps_its_lists_and_learns_features() {
    let Some(gpu) = gpu() else { return };
    let engines: [Box<dyn Engine>; 2] = [Box::new(GpuEngine::new(gpu)), Box::new(CpuEngine::new())];
    for mut engine in engines {
        let scene = cloud(2000, 7, 0, false);
        let state = State::of(&scene);
        engine.set_state(&state).unwrap();
        engine.set_target(0, target(96, 64)).unwrap();
        let view = View::new(&camera(96, 64), scene.len(), 0);
        let mut errors = Vec::new();
        for t in 1..=20 {
            let step = Step::new(t, 14..BASE_CHANNELS, &[0.02; BASE_CHANNELS + 1]);
            engine
                .step(view, 0, &options(Channels::Feature), &step)
                .unwrap();
            errors.push(engine.losses().unwrap().feature_l1);
        }
        assert!(
            errors[19] < 0.9 * errors[0],
            "{}: {errors:?}",
            engine.name()
        );
        let after = engine.state().unwrap().params;
        assert_eq!(
            after[..14 * 2000],
            state.params[..14 * 2000],
            "geometry and colour do not change"
        );
    }
}

#[test]
fn gpu_training_repeats_the_same_bytes() {
    let scene = cloud(2000, 21, 2, false);
    let run = |gpu: crate::Gpu| {
        let mut engine = GpuEngine::new(gpu);
        engine.set_state(&State::of(&scene)).unwrap();
        engine.set_target(0, target(96, 64)).unwrap();
        for t in 1..=5 {
            let step = Step::new(t, 0..channels_of(2), &[1e-3; BASE_CHANNELS + 1]);
            engine
                .step(
                    View::new(&camera(96, 64), 2000, 2),
                    0,
                    &options(Channels::Coupled),
                    &step,
                )
                .unwrap();
        }
        engine
            .state()
            .unwrap()
            .params
            .iter()
            .map(|v| v.to_bits())
            .collect::<Vec<_>>()
    };
    for (first, second) in gpu_in_each_shape().zip(gpu_in_each_shape()) {
        assert_eq!(run(first), run(second));
    }
}

#[test]
fn gpu_and_cpu_agree_on_objects() {
    let Some(gpu) = gpu() else { return };
    let mut device = GpuEngine::new(gpu);
    let mut cpu = CpuEngine::new();
    for (n, w, h) in [(300, 17, 13), (5000, 270, 479), (20_000, 1440, 1080)] {
        let scene = cloud(n, 5, 0, true);
        let view = View::new(&camera(w, h), scene.len(), 0);
        // Objects are compact regions, as in real scenes, so that few objects meet in a pixel.
        let ids: Vec<u16> = scene
            .means
            .iter()
            .map(|m| u16::from(m.x > 0.0) + 2 * u16::from(m.y > 0.0))
            .collect();
        let both = [&mut device as &mut dyn Engine, &mut cpu].map(|engine| {
            engine.set_state(&State::of(&scene)).unwrap();
            assert!(
                engine
                    .render_ids(view, &ids[1..])
                    .unwrap_err()
                    .to_string()
                    .contains("ids")
            );
            let shares = engine.render_ids(view, &ids).unwrap();
            let sets: Vec<Vec<u16>> = (0..4)
                .map(|id| Some(id).filter(|id| *id > 0).into_iter().collect())
                .collect();
            shares
                .majority_sets(&sets)
                .map(|held| held.first().copied())
                .collect::<Vec<_>>()
        });
        let off = both[0].iter().zip(&both[1]).filter(|(a, b)| a != b).count();
        assert!(
            off as f64 <= 0.002 * view.pixels() as f64,
            "{off} of {} pixels differ",
            view.pixels()
        );
        assert!((1..4).all(|id| both[0].contains(&Some(id))));
    }
}

#[test]
fn transparent_gaussians_are_drawn_only_if_solid_is_set() {
    let mut scene = cloud(2000, 5, 0, true);
    let plain = scene.clone();
    // A transparent pane in front of the left half of the image: four rows of spheres.
    let camera = camera(96, 64);
    let to_world = camera.world_to_camera.inverse();
    for k in 0..24 {
        let pixel = glam::Vec2::new(4.0 + 8.0 * (k % 6) as f32, 8.0 + 16.0 * (k / 6) as f32);
        scene.push_sphere(
            to_world.transform_point3(camera.ray(pixel)),
            0.08,
            0.5,
            [1.0, 0.0, 0.0],
        );
        *scene.opacity_logits.last_mut().unwrap() =
            1.2 * fastlgs_core::gaussians::TRANSPARENT_LOGIT;
    }
    let ids: Vec<u16> = (0..scene.len())
        .map(|g| if g < plain.len() { 1 } else { 2 })
        .collect();
    let sets = [vec![], vec![1], vec![2]];
    let engines = gpu()
        .map(|gpu| Box::new(GpuEngine::new(gpu)) as Box<dyn Engine>)
        .into_iter()
        .chain([Box::new(CpuEngine::new()) as Box<dyn Engine>]);
    for mut engine in engines {
        engine.set_state(&State::of(&plain)).unwrap();
        let before = engine
            .render(View::new(&camera, plain.len(), 0), Channels::Color)
            .unwrap();
        engine.set_state(&State::of(&scene)).unwrap();
        let view = View::new(&camera, scene.len(), 0);
        assert_eq!(
            engine.render(view, Channels::Color).unwrap().data,
            before.data,
            "{}",
            engine.name()
        );
        let mut solid_pixels = |solid: u32| -> usize {
            let shares = engine.render_ids(View { solid, ..view }, &ids).unwrap();
            shares
                .majority_sets(&sets)
                .enumerate()
                .filter(|(p, held)| p % 96 < 48 && held.first() == Some(&2))
                .count()
        };
        assert_eq!(solid_pixels(0), 0);
        assert!(solid_pixels(1) > 48 * 64 * 3 / 4, "{}", solid_pixels(1));
    }
}

#[test]
fn a_step_drops_the_requested_share_of_gaussians() {
    let scene = cloud(20_000, 3, 0, true);
    let view = View::new(&camera(96, 64), scene.len(), 0);
    let mut cpu = CpuEngine::new();
    cpu.set_state(&State::of(&scene)).unwrap();
    let mut drawn = |view: View| {
        cpu.set_state(&State::of(&scene)).unwrap();
        cpu.set_target(0, target(96, 64)).unwrap();
        cpu.step(
            view,
            0,
            &options(Channels::Color),
            &Step::new(1, 0..1, &[0.0; BASE_CHANNELS + 1]),
        )
        .unwrap();
        cpu.stats().unwrap()[scene.len()..]
            .iter()
            .map(|drawn| *drawn > 0.0)
            .collect::<Vec<bool>>()
    };
    let [all, some, others] =
        [view, view.with_dropout(0.2, 1), view.with_dropout(0.2, 2)].map(&mut drawn);
    let count = |drawn: &[bool]| drawn.iter().filter(|d| **d).count() as f64;
    assert!(
        (count(&some) / count(&all) - 0.8).abs() < 0.02,
        "{} of {}",
        count(&some),
        count(&all)
    );
    assert_ne!(some, others, "each draw leaves out other Gaussians");
}

#[test]
fn opacity_gain_compensates_for_dropped_gaussians() {
    // Low opacities let about half of the light through.
    let mut scene = cloud(1500, 3, 0, true);
    scene.opacity_logits.fill(-1.5);
    let view = View::new(&camera(96, 64), scene.len(), 0);
    let mut cpu = CpuEngine::new();
    let mut mean_transmittance = |opacity: f32, share: f32| {
        let mut thinned = scene.clone();
        thinned.opacity_logits.iter_mut().for_each(|l| {
            *l = fastlgs_core::gaussians::logit(opacity * fastlgs_core::gaussians::sigmoid(*l))
        });
        cpu.set_state(&State::of(&thinned)).unwrap();
        let of_draw = |draw| {
            let frame = cpu
                .render(view.with_dropout(share, draw), Channels::Color)
                .unwrap();
            frame
                .transmittance()
                .iter()
                .map(|t| f64::from(*t))
                .sum::<f64>()
                / view.pixels() as f64
        };
        (0..20).map(of_draw).sum::<f64>() / 20.0
    };
    // In the third case, opacities are multiplied by 0.8, which cancels the gain of the Gaussians
    // that are kept.
    let (whole, thinned, without) = (
        mean_transmittance(1.0, 0.0),
        mean_transmittance(1.0, 0.2),
        mean_transmittance(0.8, 0.2),
    );
    assert!(
        (0.2..0.8).contains(&whole) && (thinned - whole).abs() < 0.2 * (without - whole),
        "{whole}, {thinned}, {without}"
    );
}
