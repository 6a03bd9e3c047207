//! Tests of each WGSL pass against its CPU twin, on inputs that the twins compute.

use super::{CHANNELS, assert_close, camera, cloud, floats, gpu};
use crate::Shape;
use crate::cpu;
use crate::gpu::UNIFORM_SLOTS;
use crate::pass::{Groups, Pass, Recorder};
use crate::shader::{Kernel, Shader, shaders};
use crate::view::{ChunkJob, Plane, Planes, Step, View, stride};
use crate::{Channels, Gpu};
use fastlgs_core::gaussians::channel::OPACITY;
use fastlgs_core::gaussians::{BASE_CHANNELS, channels as channels_of};
use fastlgs_core::rng::Rng;
use std::collections::BTreeMap;

/// (Gaussians, width, height): 1 to 200,000 Gaussians, in images with empty and with crowded tiles.
const SIZES: [(usize, u32, u32); 5] = [
    (1, 17, 13),
    (300, 64, 48),
    (5000, 97, 61),
    (20_000, 270, 480),
    (200_000, 480, 360),
];

/// Runs one pass on the device. `buffers` holds the storage buffers in the order of their bindings;
/// the results replace them.
fn on_device<U: bytemuck::Pod>(
    gpu: &Gpu,
    pass: &Pass,
    uniform: &U,
    buffers: &mut [Vec<u32>],
    groups: Groups,
) {
    let storages: Vec<_> = buffers
        .iter()
        .map(|b| gpu.storage_with("test", b).unwrap())
        .collect();
    let mut r = Recorder::new(gpu, 0);
    r.record(
        pass,
        bytemuck::bytes_of(uniform),
        &storages.iter().collect::<Vec<_>>(),
        groups,
    );
    r.submit();
    for (buffer, storage) in buffers.iter_mut().zip(&storages) {
        *buffer = gpu.read(storage, buffer.len()).unwrap();
    }
}

/// Runs a pass and its twin on the same buffers. Returns the device's buffers, then the twin's.
fn on_device_and_twin<U: bytemuck::Pod>(
    gpu: &Gpu,
    shader: &'static Shader,
    channels: Channels,
    harmonics: bool,
    uniform: &U,
    buffers: &[&[u32]],
    groups: impl Into<Groups>,
) -> [Vec<Vec<u32>>; 2] {
    let mut device: Vec<Vec<u32>> = buffers.iter().map(|b| b.to_vec()).collect();
    let mut twin = device.clone();
    on_device(
        gpu,
        &Pass::new(gpu, shader, channels, harmonics),
        uniform,
        &mut device,
        groups.into(),
    );
    cpu::run(
        shader.name,
        channels,
        bytemuck::bytes_of(uniform),
        &mut twin,
    );
    [device, twin]
}

/// Returns `[channels][n]` as one page with the kernels' stride, as words.
fn page(params: &[f32], n: usize) -> Vec<u32> {
    let padding = std::iter::repeat_n(0.0f32, stride(n) - n);
    params
        .chunks_exact(n)
        .flat_map(|c| c.iter().copied().chain(padding.clone()))
        .map(f32::to_bits)
        .collect()
}

fn zeros(n: usize) -> Vec<u32> {
    vec![0; n]
}

/// Results of all passes before blending, computed by the twins.
struct Lists {
    view: View,
    params: Vec<u32>,
    buffers: BTreeMap<&'static str, Vec<u32>>,
}

/// Runs a twin on named buffers.
fn twin<U: bytemuck::Pod>(
    all: &mut BTreeMap<&'static str, Vec<u32>>,
    name: &str,
    uniform: &U,
    names: &[&'static str],
) {
    let mut buffers: Vec<_> = names
        .iter()
        .map(|n| std::mem::take(all.get_mut(n).unwrap_or_else(|| panic!("{n}"))))
        .collect();
    cpu::run(
        name,
        Channels::Both,
        bytemuck::bytes_of(uniform),
        &mut buffers,
    );
    for (name, buffer) in names.iter().zip(buffers) {
        all.insert(name, buffer);
    }
}

/// Sorts `keys` stably. `values` receives the original indices.
fn sort_twin(all: &mut BTreeMap<&'static str, Vec<u32>>, keys: &'static str, values: &'static str) {
    let list = &all[keys];
    let mut order: Vec<u32> = (0..list.len() as u32).collect();
    order.sort_by_key(|&i| list[i as usize]);
    let sorted = order.iter().map(|&i| list[i as usize]).collect();
    all.insert(keys, sorted);
    all.insert(values, order);
}

fn lists(n: usize, w: u32, h: u32, sh_degree: u32, antialias: bool) -> Lists {
    let scene = cloud(n, 9, sh_degree, true);
    let n = scene.len();
    let mut view = View::new(&camera(w, h), n, sh_degree);
    view.background_color = [0.2, 0.4, 0.6, 0.0];
    view.antialias = u32::from(antialias);
    let params = page(&scene.to_channels(), n);
    let mut b: BTreeMap<&'static str, Vec<u32>> = BTreeMap::new();
    b.insert("params", params.clone());
    for (name, words) in [
        ("splats", 12),
        ("keys", 1),
        ("footprints", 8),
        ("touched", 1),
        ("offsets", 1),
        ("first", 1),
    ] {
        b.insert(name, zeros(words * n));
    }
    twin(
        &mut b,
        "project",
        &view,
        &["params", "splats", "keys", "footprints", "touched"],
    );
    sort_twin(&mut b, "keys", "order");
    twin(
        &mut b,
        "gather_counts",
        &view,
        &["order", "touched", "offsets"],
    );
    b.insert("totals", zeros(2));
    let job = ChunkJob {
        n: n as u32,
        shift: 0,
        first: 0,
        chunks: 1,
    };
    twin(&mut b, "scan_chunks", &job, &["offsets", "totals"]);
    twin(&mut b, "scan_apply", &job, &["offsets", "totals"]);
    view.pairs = b["totals"][1];
    b.insert("tiles", zeros(view.pairs as usize));
    b.insert("gaussians", zeros(view.pairs as usize));
    twin(
        &mut b,
        "emit",
        &view,
        &[
            "order",
            "offsets",
            "footprints",
            "touched",
            "tiles",
            "gaussians",
            "first",
        ],
    );
    sort_twin(&mut b, "tiles", "sorted");
    b.insert("ranges", zeros(2 * view.tile_count() as usize));
    b.insert("loads", zeros(view.tile_count() as usize));
    twin(&mut b, "tile_ranges", &view, &["tiles", "ranges"]);
    twin(&mut b, "tile_load", &view, &["ranges", "loads"]);
    sort_twin(&mut b, "loads", "tile_order");
    Lists {
        view,
        params,
        buffers: b,
    }
}

#[test]
fn project() {
    let Some(gpu) = gpu() else { return };
    for (seed, (n, w, h)) in SIZES.into_iter().enumerate() {
        let sh_degree = seed as u32 % 4;
        let scene = cloud(n, seed as u64, sh_degree, true);
        let n = scene.len();
        let view = View {
            antialias: seed as u32 % 2,
            ..View::new(&camera(w, h), n, sh_degree)
        };
        let view = if seed % 2 == 1 {
            view.with_dropout(0.25, 7)
        } else {
            view
        };
        let params = page(&scene.to_channels(), n);
        let blank = zeros(12 * n);
        let buffers = [
            &params[..],
            &blank,
            &blank[..n],
            &blank[..8 * n],
            &blank[..n],
        ];
        let [device, twin] = on_device_and_twin(
            &gpu,
            shaders::Project::SHADER,
            Channels::Both,
            sh_degree > 0,
            &view,
            &buffers,
            (n as u32).div_ceil(64),
        );
        let flips = device[4]
            .iter()
            .zip(&twin[4])
            .filter(|(a, b)| a != b)
            .count();
        assert!(
            flips as f64 <= 0.002 * n as f64,
            "{flips} of {n} tile counts differ"
        );
        assert!(device[4].iter().any(|t| *t > 0));
        let drawn: Vec<usize> = (0..n)
            .filter(|&i| device[4][i] > 0 && twin[4][i] > 0)
            .collect();
        let pick = |words: &[u32]| {
            drawn
                .iter()
                .flat_map(|&i| floats(&words[12 * i..12 * i + 12]).to_vec())
                .collect::<Vec<_>>()
        };
        assert_close("splats", &pick(&device[1]), &pick(&twin[1]), 2e-3, 0.002);
        let depth_flips = device[2]
            .iter()
            .zip(&twin[2])
            .filter(|(a, b)| a.abs_diff(**b) > 1)
            .count();
        assert!(depth_flips <= flips, "{depth_flips} depth keys differ");
    }
}

#[test]
fn sorting_and_scanning() {
    let Some(mut gpu) = gpu() else { return };
    let mut rng = Rng::new(3, "sort");
    for (shape, n) in [Shape::Wide, Shape::Lanes]
        .into_iter()
        .flat_map(|shape| [1usize, 255, 256, 257, 2048, 2049, 600_003].map(|n| (shape, n)))
    {
        gpu.shape = shape;
        let keys: Vec<u32> = (0..n).map(|_| rng.next_u64() as u32 & 0xffff).collect();
        let values: Vec<u32> = (0..n as u32).rev().collect();
        let (chunks, groups) = shape.chunks(n as u32);
        let job = ChunkJob {
            n: n as u32,
            shift: 8,
            first: 0,
            chunks,
        };
        // Buffers from index `first_compared` on must equal the twin's.
        let exact = |shader: &'static Shader,
                     job: &ChunkJob,
                     buffers: &[&[u32]],
                     groups: u32,
                     first_compared: usize| {
            let [device, twin] =
                on_device_and_twin(&gpu, shader, Channels::Both, false, job, buffers, groups);
            assert_eq!(
                device[first_compared..],
                twin[first_compared..],
                "{} of {n} in the shape {shape:?}",
                shader.name
            );
            device
        };
        let histogram = exact(
            shaders::RadixCount::SHADER,
            &job,
            &[&keys, &vec![7; 256 * chunks as usize]],
            groups,
            0,
        )
        .remove(1);
        let scanned = |items: &[u32]| {
            let (chunks, groups) = shape.chunks(items.len() as u32);
            let job = ChunkJob {
                n: items.len() as u32,
                chunks,
                ..job
            };
            let totals = exact(
                shaders::ScanChunks::SHADER,
                &job,
                &[items, &zeros(chunks as usize + 1)],
                groups,
                0,
            )
            .remove(1);
            let mut scanned = exact(
                shaders::ScanApply::SHADER,
                &job,
                &[items, &totals],
                groups,
                0,
            );
            (scanned.swap_remove(0), scanned[0][chunks as usize])
        };
        let (places, total) = scanned(&histogram);
        assert_eq!(total as usize, n);
        // The pass uses the histogram as scratch space, so that it is not compared.
        let sorted = exact(
            shaders::RadixScatter::SHADER,
            &job,
            &[&keys, &values, &places, &zeros(n), &zeros(n)],
            groups,
            3,
        );
        assert!(sorted[3].windows(2).all(|p| p[0] >> 8 <= p[1] >> 8));
        // Equal digits keep their order; here their values descend.
        assert!(
            (1..n)
                .all(|i| sorted[3][i - 1] >> 8 != sorted[3][i] >> 8
                    || sorted[4][i - 1] > sorted[4][i])
        );
        // Sums beyond 32 bits saturate instead of wrapping.
        assert_eq!(scanned(&vec![u32::MAX / 2; 3 * n.max(2)]).1, u32::MAX);
    }
}

#[test]
fn listing() {
    let Some(mut gpu) = gpu() else { return };
    for (shape, (n, w, h)) in [Shape::Wide, Shape::Lanes]
        .into_iter()
        .flat_map(|shape| SIZES.map(|size| (shape, size)))
    {
        gpu.shape = shape;
        let fixture = lists(n, w, h, 0, false);
        let b = |name: &str| &fixture.buffers[name][..];
        let exact = |shader: &'static Shader, buffers: &[&[u32]], items: u32| {
            let [device, twin] = on_device_and_twin(
                &gpu,
                shader,
                Channels::Both,
                false,
                &fixture.view,
                buffers,
                items.div_ceil(64),
            );
            assert_eq!(device, twin, "{} of {n}", shader.name);
        };
        exact(
            shaders::GatherCounts::SHADER,
            &[b("order"), b("touched"), b("offsets")],
            fixture.view.gaussians,
        );
        let (pairs, blank) = (
            fixture.view.pairs as usize,
            zeros((fixture.view.pairs + fixture.view.gaussians) as usize),
        );
        let inputs = [
            b("order"),
            b("offsets"),
            b("footprints"),
            b("touched"),
            &blank[..pairs],
            &blank[..pairs],
            &blank[..b("first").len()],
        ];
        exact(
            shaders::Emit::SHADER,
            &inputs,
            fixture.view.gaussians * gpu.shape.writers(),
        );
        exact(
            shaders::TileRanges::SHADER,
            &[b("tiles"), &vec![0; b("ranges").len()]],
            fixture.view.pairs,
        );
        // log2 may differ in its last bit, and the key by 1.
        let [device, twin] = on_device_and_twin(
            &gpu,
            shaders::TileLoad::SHADER,
            Channels::Both,
            false,
            &fixture.view,
            &[b("ranges"), b("loads")],
            fixture.view.tile_count().div_ceil(64),
        );
        assert!(
            device[1]
                .iter()
                .zip(&twin[1])
                .all(|(a, b)| a.abs_diff(*b) <= 1)
        );
    }
}

#[test]
fn recorder_submits_when_its_uniform_slots_are_full() {
    let Some(gpu) = gpu() else { return };
    let pass = Pass::new(&gpu, shaders::Adam::SHADER, Channels::Both, false);
    let params = page(&cloud(5, 1, 0, false).to_channels(), 5);
    let moments = zeros(params.len());
    let mut twin = vec![
        vec![1f32.to_bits(); params.len()],
        params,
        moments.clone(),
        moments,
    ];
    let buffers: Vec<_> = twin
        .iter()
        .map(|words| gpu.storage_with("test", words).unwrap())
        .collect();
    let bound: Vec<_> = buffers.iter().collect();
    let mut r = Recorder::new(&gpu, 0);
    for t in 1..2 * UNIFORM_SLOTS as u32 + 4 {
        let rates = [1e-4 * (t % 7) as f32; BASE_CHANNELS + 1];
        let job = Step {
            quads: stride(5) as u32 / 4,
            ..Step::new(t, 0..3, &rates)
        };
        r.record(&pass, bytemuck::bytes_of(&job), &bound, Groups::from(1));
        cpu::run("adam", Channels::Both, bytemuck::bytes_of(&job), &mut twin);
    }
    r.submit();
    // Each step has its own rates: with the uniform of another step the sums would differ.
    assert_close(
        "means",
        floats(&gpu.read(&buffers[1], twin[1].len()).unwrap()),
        floats(&twin[1]),
        1e-4,
        0.0,
    );
}

#[test]
fn surplus_pairs_of_emit_are_ignored() {
    let Some(mut gpu) = gpu() else { return };
    gpu.shape = Shape::Lanes;
    let l = lists(300, 64, 48, 0, false);
    let b = |name: &str| &l.buffers[name][..];
    let n = l.view.gaussians as usize;
    // As if `project` had counted three tiles more than `emit` finds.
    let touched: Vec<u32> = b("touched")
        .iter()
        .map(|t| if *t > 0 { t + 3 } else { 0 })
        .collect();
    let mut offsets: Vec<u32> = b("order").iter().map(|g| touched[*g as usize]).collect();
    let pairs = offsets
        .iter_mut()
        .fold(0, |sum, own| sum + std::mem::replace(own, sum));
    let view = View {
        pairs,
        fold_length: gpu.shape.fold(),
        ..l.view
    };
    let blank = zeros(pairs as usize);
    let inputs = [
        b("order"),
        &offsets,
        b("footprints"),
        &touched,
        &blank,
        &blank,
        &zeros(n),
    ];
    let groups = (n as u32 * gpu.shape.writers()).div_ceil(64);
    let [device, emitted] = on_device_and_twin(
        &gpu,
        shaders::Emit::SHADER,
        Channels::Both,
        false,
        &view,
        &inputs,
        groups,
    );
    assert_eq!(device, emitted);
    assert_eq!(
        emitted[3],
        b("touched"),
        "`touched` is the number of tiles found"
    );
    let surplus = emitted[4]
        .iter()
        .filter(|tile| **tile == view.tile_count())
        .count();
    assert_eq!(surplus, 3 * touched.iter().filter(|t| **t > 0).count());
    // Slots of surplus pairs are never written and must not be added up.
    let slots: Vec<u32> = emitted[4]
        .iter()
        .flat_map(|tile| {
            [if *tile == view.tile_count() {
                f32::NAN
            } else {
                1.0
            }; 12]
        })
        .map(f32::to_bits)
        .collect();
    let inputs = [&emitted[3][..], &emitted[6], &emitted[5], &slots];
    let [device, folded] = on_device_and_twin(
        &gpu,
        shaders::FoldSlots::SHADER,
        Channels::Both,
        false,
        &view,
        &inputs,
        pairs.div_ceil(view.fold_length).div_ceil(64),
    );
    for (what, all) in [("device", device), ("twin", folded)] {
        let slots = floats(&all[3]);
        for (g, count) in emitted[3]
            .iter()
            .enumerate()
            .filter(|(_, count)| **count > 0)
        {
            let (first, end) = (emitted[6][g], emitted[6][g] + count);
            let runs = (first / view.fold_length + 1) * view.fold_length;
            let sum: f32 = std::iter::once(first)
                .chain((runs..end).step_by(view.fold_length as usize))
                .map(|e| slots[12 * e as usize])
                .sum();
            assert_eq!(sum, *count as f32, "{what}: each slot counts once");
        }
    }
}

#[test]
fn blending_and_its_gradients() {
    let Some(mut gpu) = gpu() else { return };
    for (k, (n, w, h)) in SIZES.into_iter().enumerate() {
        let sh_degree = k as u32 % 4;
        let l = lists(n, w, h, sh_degree, k % 2 == 1);
        let view = l.view;
        let b = |name: &str| &l.buffers[name][..];
        // The largest size runs once, the others in all shapes and with all channels.
        let choices = Shape::ALL
            .iter()
            .rev()
            .flat_map(|s| CHANNELS.iter().map(move |c| (*s, *c)));
        for (shape, channels) in choices.take(if n > 100_000 { 1 } else { 12 }) {
            gpu.shape = shape;
            let what = format!("{n} Gaussians, {shape:?}, {channels:?}");
            let groups = shape.groups(view.tile_count());
            let listed = [
                b("ranges"),
                b("tile_order"),
                b("sorted"),
                b("gaussians"),
                b("splats"),
            ];
            let pixels = view.padded_pixels();
            let frame = zeros(8 * pixels);
            let [device, twin] = on_device_and_twin(
                &gpu,
                shaders::Blend::SHADER,
                channels,
                false,
                &view,
                &[&listed[..], &[&frame]].concat(),
                groups,
            );
            let [seen, expected] = [&device, &twin].map(|all| &floats(&all[5])[..7 * pixels]);
            assert_close(&format!("frame, {what}"), seen, expected, 1e-3, 0.001);
            let frame = &twin[5];

            let mut rng = Rng::new(2, "gradient");
            let gradient: Vec<u32> = (0..6 * pixels).map(|_| rng.normal().to_bits()).collect();
            let slots = vec![9.0f32.to_bits(); 4 * channels.slot() * view.pairs as usize];
            let buffers = [&listed[..], &[frame, &gradient, &slots]].concat();
            let [device, mut twin] = on_device_and_twin(
                &gpu,
                shaders::BlendBackward::SHADER,
                channels,
                false,
                &view,
                &buffers,
                groups,
            );
            assert_close(
                &format!("slots, {what}"),
                floats(&device[7]),
                floats(&twin[7]),
                0.02,
                0.005,
            );

            let view = View {
                fold_length: shape.fold(),
                ..view
            };
            if view.fold_length > 1 {
                let buffers = [b("touched"), b("first"), b("gaussians"), &twin[7]];
                let runs = view.pairs.div_ceil(view.fold_length).div_ceil(64);
                let [device, mut folded] = on_device_and_twin(
                    &gpu,
                    shaders::FoldSlots::SHADER,
                    channels,
                    false,
                    &view,
                    &buffers,
                    runs,
                );
                assert_close(
                    &format!("folded slots, {what}"),
                    floats(&device[3]),
                    floats(&folded[3]),
                    1e-4,
                    0.0,
                );
                twin[7] = folded.swap_remove(3);
            }

            let count = view.gaussians as usize;
            let (gradients, stats) = (zeros(l.params.len()), zeros(2 * count));
            let buffers = [
                &l.params[..],
                b("splats"),
                b("order"),
                b("touched"),
                b("first"),
                &twin[7],
                &gradients,
                &stats,
            ];
            let groups = view.gaussians.div_ceil(64);
            let [device, twin] = on_device_and_twin(
                &gpu,
                shaders::ProjectBackward::SHADER,
                channels,
                sh_degree > 0,
                &view,
                &buffers,
                groups,
            );
            for c in 0..channels_of(sh_degree) {
                let range = c * stride(count)..(c + 1) * stride(count);
                let [device, twin] = [&device, &twin].map(|all| &floats(&all[6])[range.clone()]);
                assert_close(
                    &format!("gradient of channel {c}, {what}"),
                    device,
                    twin,
                    0.02,
                    0.005,
                );
            }
            assert_close(
                &format!("stats, {what}"),
                floats(&device[7]),
                floats(&twin[7]),
                0.02,
                0.005,
            );
        }
    }
}

/// Asserts that the id weights of each pixel agree within 0.001 in any order, except for the share
/// `flips` of the pixels.
fn assert_same_shares(
    what: &str,
    a: impl Iterator<Item = [u32; 4]>,
    b: impl Iterator<Item = [u32; 4]>,
    flips: f64,
) {
    let weight = |pixel: &[u32; 4], id: u32| {
        pixel
            .iter()
            .filter(|s| *s >> 16 == id)
            .map(|s| s & 0xffff)
            .sum::<u32>()
    };
    let agree = |a: &[u32; 4], b: &[u32; 4]| {
        a.iter()
            .chain(b)
            .all(|s| weight(a, s >> 16).abs_diff(weight(b, s >> 16)) <= 66)
    };
    let pairs: Vec<_> = a.zip(b).collect();
    let off = pairs.iter().filter(|(a, b)| !agree(a, b)).count();
    assert!(
        off as f64 <= flips * pairs.len() as f64,
        "{what}: {off} of {} pixels differ",
        pairs.len()
    );
    assert!(
        pairs
            .iter()
            .any(|(a, _)| a.iter().filter(|s| **s & 0xffff > 655).count() > 1),
        "{what}: no pixel shows two objects"
    );
}

#[test]
fn blending_ids() {
    let Some(gpu) = gpu() else { return };
    for (n, w, h) in SIZES.into_iter().skip(1) {
        let l = lists(n, w, h, 0, false);
        let b = |name: &str| &l.buffers[name][..];
        let pixels = l.view.padded_pixels();
        // With 3 objects no id is dropped. With 40 objects the lightest ids are dropped where many
        // Gaussians overlap.
        for (objects, flips) in [(3, 0.002), (40, 0.01)] {
            let ids: Vec<u32> = (0..l.view.gaussians).map(|g| g % objects).collect();
            let buffers = [
                b("ranges"),
                b("sorted"),
                b("gaussians"),
                b("splats"),
                &ids,
                &zeros(4 * pixels),
            ];
            let groups = l.view.tile_count().div_ceil(8);
            let [device, twin] = on_device_and_twin(
                &gpu,
                shaders::BlendIds::SHADER,
                Channels::Both,
                false,
                &l.view,
                &buffers,
                groups,
            );
            let shares = |all: &[Vec<u32>]| {
                (0..pixels)
                    .map(|p| [0, 1, 2, 3].map(|k| all[5][k * pixels + p]))
                    .collect::<Vec<_>>()
            };
            assert_same_shares(
                &format!("{objects} objects of {n}"),
                shares(&device).into_iter(),
                shares(&twin).into_iter(),
                flips,
            );
        }
    }
}

#[test]
fn blending_votes() {
    let Some(gpu) = gpu() else { return };
    for (n, w, h) in SIZES.into_iter().skip(1) {
        let l = lists(n, w, h, 0, false);
        let b = |name: &str| &l.buffers[name][..];
        // Tiles have one to three labels. The window holds the second half of the sums.
        let tile_count = l.view.tile_count();
        let labels: Vec<u32> = (0..64 * tile_count)
            .map(|p| p % 64 % (1 + p / 64 % 3))
            .collect();
        let mut sums = 0;
        let mut tile_votes = Vec::new();
        for (tile, range) in b("ranges").chunks_exact(2).enumerate() {
            let count = 1 + tile as u32 % 3;
            tile_votes.extend([sums, count]);
            sums += count * (range[1] - range[0]);
        }
        let middle = tile_votes[2 * (tile_count as usize / 2)];
        for (first, end) in [(0, sums), (middle, sums)] {
            let view = View {
                slot_first: first,
                slot_count: end - first,
                ..l.view
            };
            let buffers = [
                b("ranges"),
                b("sorted"),
                b("gaussians"),
                b("splats"),
                &labels,
                &tile_votes,
                &zeros((end - first).max(1) as usize),
            ];
            let [device, twin] = on_device_and_twin(
                &gpu,
                shaders::BlendVotes::SHADER,
                Channels::Both,
                false,
                &view,
                &buffers,
                tile_count.div_ceil(8),
            );
            assert!(floats(&twin[6]).iter().any(|sum| *sum > 0.1));
            let what = format!("votes from {first} of {n}");
            assert_close(&what, floats(&device[6]), floats(&twin[6]), 2e-3, 0.002);
        }
    }
}

#[test]
fn blending_saliency() {
    let Some(gpu) = gpu() else { return };
    for (n, w, h) in SIZES.into_iter().skip(1) {
        let l = lists(n, w, h, 0, false);
        let b = |name: &str| &l.buffers[name][..];
        let pixels = l.view.padded_pixels();
        let listed = [b("ranges"), b("sorted"), b("gaussians"), b("splats")];
        let mut blending = vec![
            b("ranges").to_vec(),
            b("tile_order").to_vec(),
            b("sorted").to_vec(),
            b("gaussians").to_vec(),
            b("splats").to_vec(),
            zeros(8 * pixels),
        ];
        cpu::run(
            "blend",
            Channels::Color,
            bytemuck::bytes_of(&l.view),
            &mut blending,
        );
        let mut rng = Rng::new(5, "factors");
        let factors: Vec<u32> = (0..3 * pixels).map(|_| rng.uniform().to_bits()).collect();
        let saliency = zeros(l.view.pairs as usize);
        let [device, twin] = on_device_and_twin(
            &gpu,
            shaders::BlendSaliency::SHADER,
            Channels::Both,
            false,
            &l.view,
            &[&listed[..], &[&blending[5], &factors, &saliency]].concat(),
            l.view.tile_count().div_ceil(8),
        );
        assert!(floats(&twin[6]).iter().any(|sum| *sum > 0.1));
        assert_close(
            &format!("saliency of {n}"),
            floats(&device[6]),
            floats(&twin[6]),
            5e-3,
            0.005,
        );
    }
}

#[test]
fn loss() {
    let Some(gpu) = gpu() else { return };
    for (w, h) in [(17u32, 13u32), (64, 50), (131, 77), (1440, 1080)] {
        let view = View::new(&camera(w, h), 1, 0);
        let n = view.padded_pixels();
        let mut rng = Rng::new(4, "loss");
        let frame: Vec<u32> = (0..8 * n).map(|_| rng.uniform().to_bits()).collect();
        let targets: Vec<u32> = (0..2 * n)
            .map(|i| rng.next_u64() as u32 | if i % 31 == 0 { 0 } else { 0x8000_0000 })
            .collect();
        let (quads, rows) = (2 * view.tiles[0], 8 * view.tiles[1]);
        let plane = Plane {
            size: view.size,
            quads,
            rows,
            channel: 2,
            scale: 0.5,
            lambda: 0.2,
            gain: 1.1,
            offset: -0.05,
            unused: [0; 3],
        };
        let planes = Planes::new(&[
            plane,
            Plane {
                channel: 3,
                gain: 1.0,
                offset: 0.0,
                ..plane
            },
        ]);
        let [row_groups, column_groups] =
            [quads / 2 * rows, rows / 8 * quads].map(|items| Groups {
                flat: items.div_ceil(64),
                z: 2,
            });
        let sums = zeros(24 * (rows / 8 * quads * 4) as usize);
        let run = |shader: &'static Shader,
                   buffers: &[&[u32]],
                   groups: Groups,
                   tolerances: &[(usize, f32)]| {
            let [device, twin] = on_device_and_twin(
                &gpu,
                shader,
                Channels::Both,
                false,
                &planes,
                buffers,
                groups,
            );
            for (k, tolerance) in tolerances {
                assert_close(
                    &format!("{} {k} at {w}x{h}", shader.name),
                    floats(&device[*k]),
                    floats(&twin[*k]),
                    *tolerance,
                    0.0,
                );
            }
            twin
        };
        let blurred = run(
            shaders::SsimRows::SHADER,
            &[&frame, &targets, &zeros(8 * n)],
            row_groups,
            &[(2, 1e-4)],
        );
        let ssim = run(
            shaders::SsimColumns::SHADER,
            &[&blurred[2], &zeros(6 * n), &sums],
            column_groups,
            &[(1, 1e-2), (2, 1e-3)],
        );
        let back = run(
            shaders::SsimBackwardRows::SHADER,
            &[&ssim[1], &blurred[2]],
            row_groups,
            &[(1, 1e-3)],
        );
        run(
            shaders::LossGradient::SHADER,
            &[&frame, &targets, &back[1], &zeros(6 * n), &sums],
            column_groups,
            &[(3, 1e-2), (4, 2e-3)],
        );
    }
}

#[test]
fn adam() {
    let Some(gpu) = gpu() else { return };
    for (n, degree) in [(1usize, 0u32), (1001, 3)] {
        let mut rng = Rng::new(4, "adam");
        let words = channels_of(degree) * stride(n);
        let mut random = |scale: f32| {
            (0..words)
                .map(|_| (scale * rng.normal()).to_bits())
                .collect::<Vec<u32>>()
        };
        let (gradients, params, m1) = (random(1.0), random(1.0), random(1.0));
        let m2: Vec<u32> = random(1.0)
            .iter()
            .map(|v| (f32::from_bits(*v).powi(2)).to_bits())
            .collect();
        let rates: [f32; BASE_CHANNELS + 1] = std::array::from_fn(|c| 0.01 * (c + 1) as f32);
        let step = Step {
            quads: stride(n) as u32 / 4,
            opacity_weight: 0.3,
            frozen: n as u32 / 2,
            ..Step::new(7, 3..channels_of(degree), &rates)
        };
        let [device, twin] = on_device_and_twin(
            &gpu,
            shaders::Adam::SHADER,
            Channels::Both,
            false,
            &step,
            &[&gradients, &params, &m1, &m2],
            step.quads.div_ceil(64),
        );
        for k in 1..4 {
            assert_close("adam", floats(&device[k]), floats(&twin[k]), 1e-3, 0.0);
        }
        assert_eq!(
            device[1][..3 * stride(n)],
            params[..3 * stride(n)],
            "channels that are not trained do not change"
        );
        let of_opacity = OPACITY * stride(n)..OPACITY * stride(n) + n;
        let [before, after] = [&params, &device[1]].map(|values| &values[of_opacity.clone()]);
        assert_eq!(before[..n / 2], after[..n / 2], "frozen");
        assert!(
            before[n / 2..]
                .iter()
                .zip(&after[n / 2..])
                .all(|(a, b)| a != b)
        );
    }
}
