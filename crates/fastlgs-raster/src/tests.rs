//! Every pass against its CPU twin on a real adapter, and the twins' gradients against finite differences.

use crate::cpu::{self, CHUNKS, RUN, Splat};
use crate::engine::{CpuEngine, Engine, StepOptions, radix_sort_cpu, tile_bits};
use crate::gpu::Shape;
use crate::pass::{Pass, Shader, shaders};
use crate::view::{Job, Plane, Step, View};
use crate::{Gpu, GpuEngine};
use fastlgs_core::gaussians::CHANNELS;
use fastlgs_core::rng::Rng;
use fastlgs_core::{Camera, Gaussians};
use glam::Vec3;

/// The adapter, or a loud skip. FASTLGS_REQUIRE_GPU=1 turns the skip into a failure (set by test.sh).
fn gpu() -> Option<Gpu> {
    match Gpu::open("auto") {
        Ok(gpu) => Some(gpu),
        Err(e) if std::env::var_os("FASTLGS_REQUIRE_GPU").is_some() => panic!("{e}"),
        Err(e) => {
            eprintln!("SKIPPED: {e}");
            None
        }
    }
}

fn camera(width: u32, height: u32) -> Camera {
    Camera::look_at("test", Vec3::new(0.3, 0.5, -4.0), Vec3::ZERO, Vec3::Y, width, height, 0.9)
}

/// A cloud around the origin; `nasty` adds Gaussians that must not be drawn or are hard to draw.
fn cloud(n: usize, seed: u64, nasty: bool) -> Gaussians {
    let mut rng = Rng::new(seed, "cloud");
    let mut scene = Gaussians::default();
    for i in 0..n {
        let mean = Vec3::new(rng.normal(), rng.normal(), rng.normal());
        scene.push_sphere(mean, 0.05, rng.range(0.05, 0.95), [rng.uniform(), rng.uniform(), rng.uniform()]);
        scene.log_scales[i] = Vec3::new(rng.range(-4.0, -1.5), rng.range(-4.0, -1.5), rng.range(-4.0, -1.5));
        scene.rotations[i] = [rng.normal(), rng.normal(), rng.normal(), rng.normal()];
        scene.features[i] = Vec3::new(rng.uniform(), rng.uniform(), rng.uniform());
    }
    if nasty {
        let at = |x: f32| Vec3::new(x, 0.0, 0.0);
        scene.push_sphere(Vec3::new(0.0, 0.0, -9.0), 0.1, 0.5, [1.0; 3]); // behind the camera
        scene.push_sphere(at(f32::NAN), 0.1, 0.5, [1.0; 3]);
        scene.push_sphere(at(0.1), 1e-8, 0.9, [1.0, 0.0, 0.0]);
        scene.push_sphere(at(0.2), 50.0, 0.1, [0.0, 1.0, 0.0]);
        scene.push_sphere(at(0.3), 0.1, 0.5, [0.0, 0.0, 1.0]);
        scene.push_sphere(at(0.3), 0.1, 0.5, [1.0, 0.0, 1.0]); // the same depth
        *scene.opacity_logits.last_mut().unwrap() = 40.0; // opacity 1
        scene.push_sphere(at(0.4), 0.1, 0.5, [1.0; 3]);
        *scene.opacity_logits.last_mut().unwrap() = -40.0; // opacity 0
        scene.push_sphere(at(0.5), 0.1, 0.5, [1.0; 3]);
        *scene.rotations.last_mut().unwrap() = [0.0; 4]; // no rotation at all
    }
    scene
}

/// Runs one pass on the given buffers (uniform first) and returns all storage buffers.
fn run_pass(gpu: &Gpu, shader: &Shader, uniform: &impl bytemuck::Pod, storages: &[&[u8]], groups: u32) -> Vec<Vec<u8>> {
    let pass = Pass::new(gpu, shader);
    let uniform = gpu.uniform(uniform);
    let buffers: Vec<_> = storages.iter().map(|s| gpu.storage_with("test", s).unwrap()).collect();
    let mut all = vec![&uniform];
    all.extend(&buffers);
    let mut encoder = gpu.encoder();
    pass.record(gpu, &mut encoder, &all, groups);
    gpu.submit(encoder);
    storages.iter().zip(&buffers).map(|(s, b)| gpu.read(b, s.len()).unwrap()).collect()
}

fn bytes<T: bytemuck::Pod>(data: &[T]) -> &[u8] {
    bytemuck::cast_slice(data)
}

fn words(data: &[u8]) -> Vec<u32> {
    data.chunks_exact(4).map(bytemuck::pod_read_unaligned).collect()
}

fn floats(data: &[u8]) -> Vec<f32> {
    data.chunks_exact(4).map(bytemuck::pod_read_unaligned).collect()
}

/// Tight agreement but for a bounded share of values, which flip where a Gaussian crosses a cut-off.
fn assert_close(what: &str, a: &[f32], b: &[f32], tolerance: f32, flips: f64) {
    assert_eq!(a.len(), b.len(), "{what}: lengths");
    let scale = b.iter().filter(|v| v.is_finite()).fold(0.0f32, |m, v| m.max(v.abs())).max(1e-6);
    let off =
        a.iter().zip(b).filter(|(a, b)| !((*a - *b).abs() <= tolerance * (scale * 0.01 + b.abs()) || (a.is_nan() && b.is_nan()))).count();
    let share = off as f64 / a.len().max(1) as f64;
    let worst = a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0f32, f32::max);
    assert!(share <= flips, "{what}: {off} of {} values differ (worst {worst}, scale {scale})", a.len());
}

struct Projected {
    splats: Vec<Splat>,
    depths: Vec<u32>,
    footprints: Vec<cpu::Footprint>,
    touched: Vec<u32>,
}

fn projected(view: &View, params: &[f32]) -> Projected {
    let n = view.gaussians as usize;
    let mut p = Projected { splats: vec![[[0.0; 4]; 3]; n], depths: vec![0; n], footprints: vec![[[0.0; 4]; 2]; n], touched: vec![0; n] };
    cpu::project(view, params, &mut p.splats, &mut p.depths, &mut p.footprints, &mut p.touched);
    p
}

const SIZES: [(usize, u32, u32); 4] = [(1, 17, 13), (300, 64, 48), (5000, 97, 61), (20_000, 270, 480)];

#[test]
fn project_matches_its_twin() {
    let Some(gpu) = gpu() else { return };
    for (seed, (n, w, h)) in SIZES.into_iter().enumerate() {
        let params = cloud(n, seed as u64, true).to_channels();
        let n = params.len() / CHANNELS;
        let view = View::new(&camera(w, h), n);
        let twin = projected(&view, &params);
        let zeros = vec![0u8; 48 * n];
        let out = run_pass(
            &gpu,
            &shaders::PROJECT,
            &view,
            &[bytes(&params), &zeros, &zeros[..4 * n], &zeros[..32 * n], &zeros[..4 * n]],
            (n as u32).div_ceil(64),
        );
        let touched = words(&out[4]);
        let flips = touched.iter().zip(&twin.touched).filter(|(a, b)| a != b).count();
        assert!(flips as f64 <= 0.002 * n as f64, "{flips} of {n} tile counts differ");
        assert!(touched.iter().any(|t| *t > 0));
        let drawn: Vec<usize> = (0..n).filter(|&i| touched[i] > 0 && twin.touched[i] > 0).collect();
        let pick = |values: &[f32]| drawn.iter().flat_map(|&i| values[12 * i..12 * i + 12].to_vec()).collect::<Vec<_>>();
        assert_close("splats", &pick(&floats(&out[1])), &pick(bytemuck::cast_slice(&twin.splats)), 2e-3, 0.002);
        let depth_flips = words(&out[2]).iter().zip(&twin.depths).filter(|(a, b)| a.abs_diff(**b) > 1).count();
        assert!(depth_flips <= flips, "{depth_flips} depth keys differ");
    }
}

#[test]
fn sorting_and_scanning_passes_match_their_twins() {
    let Some(gpu) = gpu() else { return };
    let mut rng = Rng::new(3, "sort");
    for n in [1usize, 255, 256, 257, 100_003] {
        let keys: Vec<u32> = (0..n).map(|_| rng.next_u64() as u32 & 0xffff).collect();
        let values: Vec<u32> = (0..n as u32).rev().collect();
        let job = Job { n: n as u32, shift: 8, first: 0, unused: 0 };
        let mut histogram = vec![7u32; 256 * CHUNKS];
        let out = run_pass(&gpu, &shaders::RADIX_COUNT, &job, &[bytes(&keys), bytes(&histogram)], 4);
        cpu::radix_count(&job, &keys, &mut histogram);
        assert_eq!(words(&out[1]), histogram, "radix_count {n}");

        let scan = Job { n: histogram.len() as u32, ..job };
        let mut totals = vec![0u32; CHUNKS + 1];
        let out = run_pass(&gpu, &shaders::SCAN_CHUNKS, &scan, &[bytes(&histogram), bytes(&totals)], 4);
        cpu::scan_chunks(&scan, &histogram, &mut totals);
        assert_eq!(words(&out[1]), totals, "scan_chunks {n}");
        let out = run_pass(&gpu, &shaders::SCAN_APPLY, &scan, &[bytes(&histogram), bytes(&totals)], 4);
        cpu::scan_apply(&scan, &mut histogram, &mut totals);
        assert_eq!((words(&out[0]), words(&out[1])), (histogram.clone(), totals), "scan_apply {n}");

        let (mut keys_out, mut values_out) = (vec![0u32; n], vec![0u32; n]);
        let buffers = [bytes(&keys), bytes(&values), bytes(&histogram), bytes(&keys_out), bytes(&values_out)];
        let out = run_pass(&gpu, &shaders::RADIX_SCATTER, &job, &buffers, 4);
        cpu::radix_scatter(&job, &keys, &values, &mut histogram.clone(), &mut keys_out, &mut values_out);
        assert_eq!((words(&out[3]), words(&out[4])), (keys_out.clone(), values_out), "radix_scatter {n}");
        assert!(keys_out.windows(2).all(|p| p[0] >> 8 <= p[1] >> 8));

        let mut sorted = keys.clone();
        let order = radix_sort_cpu(&mut sorted, 16);
        let mut expected: Vec<u32> = (0..n as u32).collect();
        expected.sort_by_key(|&i| keys[i as usize]);
        assert_eq!(order, expected, "the whole sort is stable, {n}");
    }
}

/// Lists, ranges and frame of a twin's forward run.
struct Lists {
    view: View,
    p: Projected,
    order: Vec<u32>,
    offsets: Vec<u32>,
    pair_tiles: Vec<u32>,
    pair_gaussians: Vec<u32>,
    first_pair: Vec<u32>,
    sorted_tiles: Vec<u32>,
    sorted_pairs: Vec<u32>,
    ranges: Vec<u32>,
}

fn lists(mut view: View, params: &[f32]) -> Lists {
    let mut p = projected(&view, params);
    let n = view.gaussians as usize;
    let order = radix_sort_cpu(&mut p.depths, 24);
    let mut offsets = vec![0; n];
    cpu::gather_counts(&view, &order, &p.touched, &mut offsets);
    let mut sum = 0;
    offsets.iter_mut().for_each(|o| sum += std::mem::replace(o, sum));
    view.pairs = sum;
    let (mut pair_tiles, mut pair_gaussians, mut first_pair) = (vec![0; sum as usize], vec![0; sum as usize], vec![0; n]);
    cpu::emit(&view, &order, &offsets, &p.footprints, &mut p.touched, &mut pair_tiles, &mut pair_gaussians, &mut first_pair);
    let mut sorted_tiles = pair_tiles.clone();
    let sorted_pairs = radix_sort_cpu(&mut sorted_tiles, tile_bits(&view));
    let mut ranges = vec![0; 2 * view.tile_count() as usize];
    cpu::tile_ranges(&view, &sorted_tiles, &mut ranges);
    Lists { view, p, order, offsets, pair_tiles, pair_gaussians, first_pair, sorted_tiles, sorted_pairs, ranges }
}

#[test]
fn listing_passes_match_their_twins() {
    let Some(gpu) = gpu() else { return };
    for (n, w, h) in SIZES {
        let params = cloud(n, 5, true).to_channels();
        let l = lists(View::new(&camera(w, h), params.len() / CHANNELS), &params);
        let groups = l.view.gaussians.div_ceil(64);
        let zeros = vec![0u8; 8 * (l.view.pairs + l.view.gaussians + l.view.tile_count()) as usize];
        let (g4, p4) = (4 * l.view.gaussians as usize, 4 * l.view.pairs as usize);
        let out = run_pass(&gpu, &shaders::GATHER_COUNTS, &l.view, &[bytes(&l.order), bytes(&l.p.touched), &zeros[..g4]], groups);
        let expected: Vec<u32> = l.order.iter().map(|&i| l.p.touched[i as usize]).collect();
        assert_eq!(words(&out[2]), expected);
        let inputs =
            [bytes(&l.order), bytes(&l.offsets), bytes(&l.p.footprints), bytes(&l.p.touched), &zeros[..p4], &zeros[..p4], &zeros[..g4]];
        let out = run_pass(&gpu, &shaders::EMIT, &l.view, &inputs, groups);
        assert_eq!((words(&out[4]), words(&out[5]), words(&out[6])), (l.pair_tiles, l.pair_gaussians, l.first_pair));
        let out = run_pass(
            &gpu,
            &shaders::TILE_RANGES,
            &l.view,
            &[bytes(&l.sorted_tiles), &zeros[..8 * l.view.tile_count() as usize]],
            l.view.pairs.div_ceil(64),
        );
        assert_eq!(words(&out[1]), l.ranges);
    }
}

#[test]
fn blending_passes_match_their_twins() {
    let Some(mut gpu) = gpu() else { return };
    let subgroups = gpu.device.features().contains(wgpu::Features::SUBGROUP);
    let shapes = [Shape::Wide, Shape::Shared, Shape::Subgroups];
    for (shape, (n, w, h)) in shapes.into_iter().filter(|s| subgroups || *s != Shape::Subgroups).flat_map(|s| SIZES.map(|size| (s, size))) {
        gpu.shape = shape;
        let params = cloud(n, 9, true).to_channels();
        let mut view = View::new(&camera(w, h), params.len() / CHANNELS);
        view.background_color = [0.2, 0.4, 0.6, 0.0];
        view.feature_moves_geometry = 1;
        let l = lists(view, &params);
        let mut frame = vec![0.0; 8 * l.view.pixels()];
        let out = run_pass(
            &gpu,
            &shaders::BLEND,
            &l.view,
            &[bytes(&l.ranges), bytes(&l.sorted_pairs), bytes(&l.pair_gaussians), bytes(&l.p.splats), bytes(&frame)],
            shape.groups(l.view.tile_count()),
        );
        cpu::blend(&l.view, &l.ranges, &l.sorted_pairs, &l.pair_gaussians, &l.p.splats, &mut frame);
        let visible = 7 * l.view.pixels();
        assert_close(&format!("frame, {shape:?}"), &floats(&out[4])[..visible], &frame[..visible], 1e-3, 0.001);

        let mut rng = Rng::new(2, "gradient");
        let gradient: Vec<f32> = (0..6 * l.view.pixels()).map(|_| rng.normal()).collect();
        let mut slots: Vec<Splat> = vec![[[9.0; 4]; 3]; l.view.pairs as usize];
        let inputs = [
            bytes(&l.ranges),
            bytes(&l.sorted_pairs),
            bytes(&l.pair_gaussians),
            bytes(&l.p.splats),
            bytes(&frame),
            bytes(&gradient),
            bytes(&slots),
        ];
        let out = run_pass(&gpu, &shaders::BLEND_BACKWARD, &l.view, &inputs, shape.groups(l.view.tile_count()));
        cpu::blend_backward(&l.view, &l.ranges, &l.sorted_pairs, &l.pair_gaussians, &l.p.splats, &frame, &gradient, &mut slots);
        assert_close(&format!("slots, {shape:?}"), &floats(&out[6]), bytemuck::cast_slice(&slots), 0.02, 0.005);

        let count = view.gaussians as usize;
        let (mut gradients, mut stats) = (vec![0.0; CHANNELS * count], vec![0.0; 2 * count]);
        let inputs = [
            bytes(&params),
            bytes(&l.p.splats),
            bytes(&l.p.touched),
            bytes(&l.first_pair),
            bytes(&slots),
            bytes(&gradients),
            bytes(&stats),
        ];
        let out = run_pass(&gpu, &shaders::PROJECT_BACKWARD, &l.view, &inputs, view.gaussians.div_ceil(64));
        cpu::project_backward(&l.view, &params, &l.p.splats, &l.p.touched, &l.first_pair, &slots, &mut gradients, &mut stats);
        for c in 0..CHANNELS {
            let range = c * count..(c + 1) * count;
            assert_close(&format!("gradient of channel {c}"), &floats(&out[5])[range.clone()], &gradients[range], 0.02, 0.005);
        }
        assert_close("stats", &floats(&out[6]), &stats, 0.02, 0.005);
    }
}

#[test]
fn loss_passes_and_adam_match_their_twins() {
    let Some(gpu) = gpu() else { return };
    for (w, h) in [(17u32, 13u32), (64, 50), (131, 77)] {
        let n = (w * h) as usize;
        let mut rng = Rng::new(4, "loss");
        let frame: Vec<f32> = (0..6 * n).map(|_| rng.uniform()).collect();
        let target: Vec<f32> = (0..6 * n).map(|i| if i % 31 == 0 { -1.0 } else { rng.uniform() }).collect();
        let plane = Plane { width: w, height: h, channel: 2, scale: 0.5, lambda: 0.2, unused: [0; 3] };
        let (mut rows, mut partials, mut gradient) = (vec![0.0; 5 * n], vec![0.0; 3 * n], vec![0.0; 6 * n]);
        let mut sums = vec![0.0; 6 * (h.div_ceil(RUN as u32) * w) as usize];
        let (row_groups, column_groups) = ((w.div_ceil(8) * h).div_ceil(64), (h.div_ceil(8) * w).div_ceil(64));
        let out = run_pass(&gpu, &shaders::SSIM_ROWS, &plane, &[bytes(&frame), bytes(&target), bytes(&rows)], row_groups);
        cpu::ssim_rows(&plane, &frame, &target, &mut rows);
        assert_close("ssim_rows", &floats(&out[2]), &rows, 1e-4, 0.0);
        let out = run_pass(&gpu, &shaders::SSIM_COLUMNS, &plane, &[bytes(&rows), bytes(&partials), bytes(&sums)], column_groups);
        cpu::ssim_columns(&plane, &rows, &mut partials, &mut sums);
        assert_close("ssim partials", &floats(&out[1]), &partials, 1e-2, 0.0);
        assert_close("ssim sums", &floats(&out[2]), &sums, 1e-3, 0.0);
        let out = run_pass(&gpu, &shaders::SSIM_BACKWARD_ROWS, &plane, &[bytes(&partials), bytes(&rows)], row_groups);
        cpu::ssim_backward_rows(&plane, &partials, &mut rows);
        assert_close("ssim_backward_rows", &floats(&out[1]), &rows, 1e-3, 0.0);
        let out = run_pass(
            &gpu,
            &shaders::LOSS_GRADIENT,
            &plane,
            &[bytes(&frame), bytes(&target), bytes(&rows), bytes(&gradient), bytes(&sums)],
            column_groups,
        );
        cpu::loss_gradient(&plane, &frame, &target, &rows, &mut gradient, &mut sums);
        assert_close("loss_gradient", &floats(&out[3]), &gradient, 1e-2, 0.0);
        assert_close("l1 sums", &floats(&out[4]), &sums, 1e-3, 0.0);

        let count = n / 4;
        let random = |rng: &mut Rng| (0..CHANNELS * count).map(|_| rng.normal()).collect::<Vec<_>>();
        let (gradients, mut params, mut m1) = (random(&mut rng), random(&mut rng), random(&mut rng));
        let mut m2: Vec<f32> = random(&mut rng).iter().map(|v| v * v).collect();
        let step = Step::new(count, 7, std::array::from_fn(|c| 0.01 * (c + 1) as f32));
        let groups = ((CHANNELS * count) as u32).div_ceil(64);
        let out = run_pass(&gpu, &shaders::ADAM, &step, &[bytes(&gradients), bytes(&params), bytes(&m1), bytes(&m2)], groups);
        cpu::adam(&step, &gradients, &mut params, &mut m1, &mut m2);
        assert_close("adam", &floats(&out[1]), &params, 1e-3, 0.0);
        assert_close("moment1", &floats(&out[2]), &m1, 1e-4, 0.0);
        assert_close("moment2", &floats(&out[3]), &m2, 1e-4, 0.0);
    }
}

/// Loss of the twin: the real training loss with all six channels, in f64 sums.
fn loss_of(params: &[f32], view: &View, target: &[f32]) -> f64 {
    let l = lists(*view, params);
    let mut frame = vec![0.0; 8 * view.pixels()];
    cpu::blend(&l.view, &l.ranges, &l.sorted_pairs, &l.pair_gaussians, &l.p.splats, &mut frame);
    let n = view.pixels();
    let [w, h] = view.size.map(|v| v as usize);
    let l1: f64 = frame[..6 * n].iter().zip(target).map(|(a, b)| f64::from((a - b).abs())).sum::<f64>() / (3 * n) as f64;
    let ssim = |from: usize| fastlgs_core::metrics::ssim(&frame[from * n..(from + 3) * n], &target[from * n..(from + 3) * n], w, h);
    0.8 * l1 + 0.2 * (2.0 - ssim(0) - ssim(3))
}

#[test]
fn gradients_match_finite_differences() {
    // Wide, faint Gaussians cover the whole picture, so that no cut-off moves under the difference.
    let mut rng = Rng::new(11, "fd");
    let mut scene = Gaussians::default();
    for i in 0..6 {
        let mean = Vec3::new(0.4 * rng.normal(), 0.4 * rng.normal(), 0.8 * i as f32 - 2.0);
        scene.push_sphere(mean, 1.0, rng.range(0.3, 0.6), [rng.range(0.2, 0.8), rng.range(0.2, 0.8), rng.range(0.2, 0.8)]);
        scene.log_scales[i] = Vec3::new(rng.range(0.6, 1.0), rng.range(0.6, 1.0), rng.range(0.4, 0.9));
        scene.rotations[i] = [1.0, 0.4 * rng.normal(), 0.4 * rng.normal(), 0.4 * rng.normal()];
        scene.features[i] = Vec3::new(rng.uniform(), rng.uniform(), rng.uniform());
    }
    let params = scene.to_channels();
    let mut view = View::new(&camera(24, 16), 6);
    view.feature_moves_geometry = 1;
    let target: Vec<f32> = (0..6 * 24 * 16).map(|i| 0.5 + 0.3 * ((i as f32) * 0.05).sin()).collect();
    let mut engine = CpuEngine::default();
    let zeros = vec![0.0; params.len()];
    engine.set_state(&params, &zeros, &zeros).unwrap();
    engine.set_target(0, &target).unwrap();
    let options = StepOptions { lambda: 0.2, feature_weight: 1.0 };
    engine.step(view, 0, options, &Step::new(6, 1, [0.0; CHANNELS])).unwrap();
    let gradients = engine.gradients().unwrap();
    let largest = |c: usize| gradients[c * 6..c * 6 + 6].iter().fold(0.0f32, |m, g| m.max(g.abs()));
    let mut checked = 0;
    for (k, &gradient) in gradients.iter().enumerate() {
        let epsilon = 4e-3;
        let at = |delta: f32| {
            let mut moved = params.clone();
            moved[k] += delta;
            loss_of(&moved, &view, &target)
        };
        let difference = ((at(epsilon) - at(-epsilon)) / (2.0 * f64::from(epsilon))) as f32;
        let allowed = 0.03 * gradient.abs() + 0.03 * largest(k / 6) + 2e-6;
        assert!((difference - gradient).abs() <= allowed, "channel {} of Gaussian {}: {gradient} against {difference}", k / 6, k % 6);
        checked += 1;
    }
    assert_eq!(checked, 6 * CHANNELS);
}

/// Whole steps: both engines stay together, and the GPU repeats itself to the byte.
#[test]
fn engines_agree_and_the_gpu_is_deterministic() {
    let Some(_) = gpu() else { return };
    let scene = cloud(2000, 21, false);
    let camera = camera(96, 64);
    let params = scene.to_channels();
    let zeros = vec![0.0; params.len()];
    let target: Vec<f32> = (0..6 * 96 * 64).map(|i| 0.5 + 0.4 * ((i as f32) * 0.013).sin()).collect();
    let run = |engine: &mut dyn Engine| {
        engine.set_state(&params, &zeros, &zeros).unwrap();
        engine.set_target(0, &target).unwrap();
        let options = StepOptions { lambda: 0.2, feature_weight: 1.0 };
        for t in 1..=5 {
            engine.step(View::new(&camera, 2000), 0, options, &Step::new(2000, t, [1e-3; CHANNELS])).unwrap();
        }
        (engine.params().unwrap(), engine.losses().unwrap())
    };
    let mut engines = [GpuEngine::new(Gpu::open("auto").unwrap()), GpuEngine::new(Gpu::open("auto").unwrap())];
    let [a, b] = engines.each_mut().map(|e| run(e));
    assert_eq!(bytes(&a.0), bytes(&b.0), "the same adapter gives the same bytes");
    let c = run(&mut CpuEngine::default());
    assert!((a.1.color_l1 - c.1.color_l1).abs() < 1e-4 && (a.1.color_ssim - c.1.color_ssim).abs() < 1e-3, "{:?} {:?}", a.1, c.1);
    // Adam's first steps follow the sign of tiny gradients, so a share may differ by whole steps.
    let moved = a.0.iter().zip(&c.0).filter(|(a, b)| (*a - *b).abs() > 2e-3).count();
    assert!(moved < params.len() / 50, "{moved} of {} values drifted apart", params.len());
}

#[test]
fn training_resumes_to_the_same_bytes() {
    let Some(_) = gpu() else { return };
    let dir = tempfile::tempdir().unwrap();
    let camera = camera(64, 48);
    let config = crate::TrainConfig { iterations: 1100, budget: 400, ..Default::default() };
    let trainer = || {
        let image = (0..6 * 64 * 48).map(|i| 0.5 + 0.4 * ((i as f32) * 0.013).sin()).collect();
        let targets = vec![crate::Target { camera: camera.clone(), image }];
        crate::Trainer::new(Box::new(GpuEngine::new(Gpu::open("auto").unwrap())), &cloud(200, 8, false), targets, config.clone()).unwrap()
    };
    let checkpoint = dir.path().join("train");
    let mut whole = trainer();
    whole.run(Some(&checkpoint), |_| {}).unwrap();
    let mut resumed = trainer();
    assert!(resumed.resume(&checkpoint).unwrap(), "a checkpoint was left at step 1000");
    let report = resumed.run(None, |_| {}).unwrap();
    assert_eq!(report.steps_here, 100);
    assert_eq!(whole.gaussians().unwrap(), resumed.gaussians().unwrap());
}
