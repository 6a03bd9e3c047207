//! Fuzz tests of all parsers. A parser may reject a damaged file in one sentence, but must neither
//! panic nor hang.
//!
//! Inputs are mutations of valid files and of inputs in the corpus `target/fuzz/PARSER`. An input
//! with a new message is added to the corpus for later runs. `FASTLGS_FUZZ_SECONDS` sets the
//! seconds per parser: 0.5 by default, 5 in `./test.sh --all`.

use fastlgs_core::compact::{self, Precision};
use fastlgs_core::mask_list::annotations;
use fastlgs_core::rng::Rng;
use fastlgs_core::scene_folder::{load_tensors, save_tensors};
use fastlgs_core::{
    Camera, Gaussians, WorldFrame, camera_path, dataset, fs, glb, image_io, labels, npy, ply, sog,
    splat, spz,
};
use glam::Vec3;
use image::{GrayImage, Luma, RgbImage};
use std::collections::BTreeSet;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::LazyLock;
use std::time::{Duration, Instant};

/// A parser under test, with its valid file.
struct Target {
    name: &'static str,
    /// Path of the damaged file within the folder.
    file: &'static str,
    /// Writes the other files of the folder.
    prepare: fn(&Path),
    seed: Vec<u8>,
    parse: fn(&Path) -> fastlgs_core::Result<()>,
}

/// Largest number of inputs in a corpus.
const MAX_INPUTS: usize = 400;
/// Limit of processor time for one input of a few kilobytes. A slower parser counts as hanging.
const SLOW: Duration = Duration::from_secs(5);

/// Returns the processor time of this thread, which other programs do not prolong. Elsewhere than on
/// Linux, returns the time of the clock.
fn cpu_time() -> Duration {
    static START: LazyLock<Instant> = LazyLock::new(Instant::now);
    let statistics = std::fs::read_to_string("/proc/thread-self/schedstat").unwrap_or_default();
    let nanoseconds = statistics.split(' ').next().and_then(|n| n.parse().ok());
    nanoseconds.map_or_else(|| START.elapsed(), Duration::from_nanos)
}

fn scene() -> Gaussians {
    let mut scene = Gaussians::default();
    for k in 0..5 {
        scene.push_sphere(Vec3::new(k as f32, 0.5, -1.0), 0.1, 0.7, [0.2, 0.5, 0.8]);
    }
    scene.with_sh_degree(1)
}

/// Returns the bytes that a writer produces.
fn written(write: impl FnOnce(&Path)) -> Vec<u8> {
    let dir = tempfile::tempdir().expect("a folder");
    let path = dir.path().join("file");
    write(&path);
    std::fs::read(path).expect("the file")
}

fn photo(folder: &Path) {
    image_io::save_png(&folder.join("images/a.png"), RgbImage::new(8, 6)).expect("a photo");
}

fn colmap_text(folder: &Path) {
    photo(folder);
    let write = |name: &str, text: &str| {
        let path = folder.join("sparse/0").join(name);
        fs::write_atomic(&path, |f| std::io::Write::write_all(f, text.as_bytes()))
            .expect("a model");
    };
    write("cameras.txt", CAMERAS);
    write("images.txt", IMAGES);
    write("points3D.txt", POINTS);
}

const CAMERAS: &str = "# comment\n1 OPENCV 8 6 7.0 7.0 4.0 3.0 0.01 0.0 0.0 0.0\n";
const IMAGES: &str = "1 0.9 0.1 0.2 0.3 1.0 2.0 3.0 1 a.png\n1.5 2.5 7 3.0 4.0 -1\n";
const POINTS: &str = "7 0.1 0.2 0.3 200 100 50 0.5 1 0\n";

fn bytes(parts: &[&[u8]]) -> Vec<u8> {
    parts.concat()
}

fn doubles(values: &[f64]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

fn cameras_bin() -> Vec<u8> {
    let (one, id, model) = (1u64.to_le_bytes(), 1u32.to_le_bytes(), 1i32.to_le_bytes());
    bytes(&[
        &one,
        &id,
        &model,
        &8u64.to_le_bytes(),
        &6u64.to_le_bytes(),
        &doubles(&[7.0, 7.0, 4.0, 3.0]),
    ])
}

fn images_bin() -> Vec<u8> {
    let (one, id) = (1u64.to_le_bytes(), 1u32.to_le_bytes());
    let pose = doubles(&[0.9, 0.1, 0.2, 0.3, 1.0, 2.0, 3.0]);
    bytes(&[
        &one,
        &id,
        &pose,
        &id,
        b"a.png\0",
        &one,
        &doubles(&[1.5, 2.5]),
        &7i64.to_le_bytes(),
    ])
}

fn points_bin() -> Vec<u8> {
    let one = 1u64.to_le_bytes();
    bytes(&[
        &one,
        &7u64.to_le_bytes(),
        &doubles(&[0.1, 0.2, 0.3]),
        &[200, 100, 50],
        &doubles(&[0.5]),
        &one,
        &[1, 0, 0, 0, 0, 0, 0, 0],
    ])
}

fn colmap_binary(folder: &Path) {
    photo(folder);
    for (name, data) in [
        ("cameras.bin", cameras_bin()),
        ("images.bin", images_bin()),
        ("points3D.bin", points_bin()),
    ] {
        fs::write_atomic(&folder.join("sparse/0").join(name), |f| {
            std::io::Write::write_all(f, &data)
        })
        .expect("a model");
    }
}

fn class_mask(folder: &Path) {
    image_io::save_png(
        &folder.join("00/camera.png"),
        GrayImage::from_pixel(3, 2, Luma([255])),
    )
    .expect("a mask");
}

fn nothing(_: &Path) {}

/// Returns a float array in numpy's format.
fn npy_file(shape: &str, values: &[f64]) -> Vec<u8> {
    let mut header = format!("{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}");
    while (header.len() + 11) % 64 != 0 {
        header.push(' ');
    }
    header.push('\n');
    bytes(&[
        b"\x93NUMPY\x01\x00",
        &(header.len() as u16).to_le_bytes(),
        header.as_bytes(),
        &doubles(values),
    ])
}

fn some_camera() -> Camera {
    Camera::look_at(
        "a.png",
        Vec3::new(0.0, 0.0, -3.0),
        Vec3::ZERO,
        Vec3::Y,
        8,
        6,
        0.8,
    )
}

/// Returns a compressed PLY file with one chunk and one Gaussian.
fn compressed_ply() -> Vec<u8> {
    let bounds = ["x", "y", "z", "scale_x", "scale_y", "scale_z"]
        .map(|name| ["min", "max"].map(|side| format!("property float {side}_{name}\n")));
    let packed = ["position", "rotation", "scale", "color"]
        .map(|name| format!("property uint packed_{name}\n"));
    let elements = format!(
        "element chunk 1\n{}element vertex 1\n{}",
        bounds.as_flattened().concat(),
        packed.concat()
    );
    [
        format!("ply\nformat binary_little_endian 1.0\n{elements}end_header\n").into_bytes(),
        vec![0; 12 * 4 + 4 * 4],
    ]
    .concat()
}

/// Returns an SPZ file of version 4 with one Gaussian: a header, a table of five streams, and each
/// stream as one raw block of Zstandard.
fn spz_4() -> Vec<u8> {
    let lengths = [9u8, 1, 3, 3, 4];
    let mut data = [
        0x5053_474e_u32.to_le_bytes(),
        4u32.to_le_bytes(),
        1u32.to_le_bytes(),
        [0, 12, 0, 5],
        32u32.to_le_bytes(),
    ]
    .concat();
    data.resize(32, 0);
    let frame = |length: u8| {
        [
            &[0x28, 0xb5, 0x2f, 0xfd, 0x20, length],
            [length << 3 | 1, 0, 0].as_slice(),
            &vec![128; usize::from(length)],
        ]
        .concat()
    };
    for length in lengths {
        data.extend((frame(length).len() as u64).to_le_bytes());
        data.extend(u64::from(length).to_le_bytes());
    }
    data.extend(lengths.into_iter().flat_map(frame));
    data
}

fn targets() -> Vec<Target> {
    let camera = some_camera();
    let target = |name, file, prepare, seed, parse| Target {
        name,
        file,
        prepare,
        seed,
        parse,
    };
    let photos = |folder: &Path| dataset::load(folder).map(|_| ());
    let llff = [
        1.0, 0.0, 0.0, 0.1, 6.0, 0.0, 1.0, 0.0, 0.2, 8.0, 0.0, 0.0, 1.0, 0.3, 7.0, 1.0, 10.0,
    ];
    vec![
        target("ply", "a.ply", nothing, written(|p| ply::write(p, &scene()).expect("a file")), |f| ply::read(&f.join("a.ply")).map(|_| ())),
        target("spz", "a.spz", nothing, written(|p| spz::write(p, &scene()).expect("a file")), |f| spz::read(&f.join("a.spz")).map(|_| ())),
        target("sog", "a.sog", nothing, written(|p| sog::write(p, &scene()).expect("a file")), |f| sog::read(&f.join("a.sog")).map(|_| ())),
        target("splat", "a.splat", nothing, vec![64; 96], |f| splat::read(&f.join("a.splat")).map(|_| ())),
        target("compressed_ply", "a.ply", nothing, compressed_ply(), |f| ply::read(&f.join("a.ply")).map(|_| ())),
        target("glb", "a.glb", nothing, written(|p| glb::write(p, &scene(), Vec3::Y, &WorldFrame::default()).expect("a file")), |f| {
            glb::read(&f.join("a.glb")).map(|_| ())
        }),
        target("spz_4", "a.spz", nothing, spz_4(), |f| spz::read(&f.join("a.spz")).map(|_| ())),
        target(
            "annotations",
            "a.json",
            nothing,
            br#"{"images": [{"id": 1, "file_name": "a.png", "width": 8, "height": 6}], "annotations": [{"image_id": 1, "segmentation": [[1, 1, 5, 1, 5, 4.5]], "track_id": "x"}]}"#.to_vec(),
            |f| annotations::load(&f.join("a.json"), Some("a.png"), None).map(|_| ()),
        ),
        target("compact", "a.safetensors", nothing, written(|p| compact::write(p, &scene(), &Precision::default()).expect("a file")), |f| {
            compact::read(&f.join("a.safetensors")).map(|_| ())
        }),
        target("safetensors", "t.safetensors", nothing, written(|p| save_tensors(p, &[("a", vec![2, 2], &[1.0; 4])]).expect("a file")), |f| {
            load_tensors(&f.join("t.safetensors")).map(|_| ())
        }),
        target("npy", "a.npy", nothing, npy_file("(2, 3)", &[0.5; 6]), |f| npy::read(&f.join("a.npy")).map(|_| ())),
        target("camera", "camera.json", nothing, serde_json::to_vec(&camera).expect("JSON"), |f| Camera::load(&f.join("camera.json"), &WorldFrame::default()).map(|_| ())),
        target("camera_path", "path.json", nothing, written(|p| camera_path::write(p, &[some_camera()], &WorldFrame::default()).expect("a file")), |f| {
            camera_path::read(&f.join("path.json"), &WorldFrame::default()).map(|_| ())
        }),
        target(
            "lerf_labels",
            "a.json",
            nothing,
            br#"{"info": {"name": "a.png", "width": 8, "height": 6}, "objects": [{"category": "cat", "segmentation": [[1, 1], [5, 1], [5, 4.5]]}]}"#.to_vec(),
            |f| {
                let views = labels::load(f, None)?;
                views.iter().for_each(|v| v.labels.iter().for_each(|l| drop((v.mask(l, 8, 6), v.boxes(l, 8, 6)))));
                Ok(())
            },
        ),
        target("classes", "classes.txt", class_mask, b"camera\n".to_vec(), |f| labels::load(f, None).map(|_| ())),
        target("mask_png", "00/camera.png", |f| std::fs::write(f.join("classes.txt"), "camera\n").expect("a list"), written(|p| {
            let dir = p.parent().expect("a folder");
            class_mask(dir);
            std::fs::copy(dir.join("00/camera.png"), p).expect("a copy");
        }), |f| labels::load(f, None).map(|_| ())),
        target(
            "transforms",
            "transforms.json",
            photo,
            br#"{"fl_x": 7.0, "k1": 0.01, "w": 8, "h": 6, "frames": [{"file_path": "images/a.png", "transform_matrix": [[1,0,0,0],[0,1,0,0],[0,0,1,2],[0,0,0,1]]}]}"#
                .to_vec(),
            photos,
        ),
        target("colmap_cameras_txt", "sparse/0/cameras.txt", colmap_text, CAMERAS.as_bytes().to_vec(), photos),
        target("colmap_images_txt", "sparse/0/images.txt", colmap_text, IMAGES.as_bytes().to_vec(), photos),
        target("colmap_points_txt", "sparse/0/points3D.txt", colmap_text, POINTS.as_bytes().to_vec(), photos),
        target("colmap_cameras_bin", "sparse/0/cameras.bin", colmap_binary, cameras_bin(), photos),
        target("colmap_images_bin", "sparse/0/images.bin", colmap_binary, images_bin(), photos),
        target("colmap_points_bin", "sparse/0/points3D.bin", colmap_binary, points_bin(), photos),
        target("llff", "poses_bounds.npy", photo, npy_file("(1, 17)", &llff), photos),
    ]
}

/// Applies one to four random changes to a random input of the corpus.
fn mutated(corpus: &[Vec<u8>], rng: &mut Rng) -> Vec<u8> {
    let mut data = corpus[rng.below(corpus.len())].clone();
    for _ in 0..1 + rng.below(4) {
        let at = rng.below(data.len() + 1);
        let end = (at + 1 + rng.below(8)).min(data.len());
        match rng.below(8) {
            0 => data.truncate(at),
            1 if at < data.len() => data[at] ^= 1 << rng.below(8),
            2 if at < data.len() => data[at] = rng.next_u64() as u8,
            3 => drop(data.drain(at..end)),
            4 => {
                let copy = data[at..end].to_vec();
                data.splice(at..at, copy);
            }
            5 => {
                // Counts and sizes too large for any file.
                let huge = [u64::MAX, 1 << 62, 1 << 32, 0x7fff_ffff, 0][rng.below(5)].to_le_bytes();
                data[at..end].copy_from_slice(&huge[..end - at]);
            }
            6 => {
                let word: &[u8] = [
                    &b"-1"[..],
                    b"NaN",
                    b"1e999",
                    b"99999999999",
                    b"\0",
                    b"\"",
                    b" ",
                    b"\n",
                    b"[[",
                    b"null",
                ][rng.below(10)];
                data.splice(at..at, word.iter().copied());
            }
            _ => {
                let other = &corpus[rng.below(corpus.len())];
                let from = rng.below(other.len() + 1);
                data.splice(at.., other[from..].iter().copied());
            }
        }
    }
    data.truncate(1 << 16);
    data
}

/// Returns the message of a parser without numbers and quoted parts.
fn outcome(result: &fastlgs_core::Result<()>) -> String {
    let Err(error) = result else {
        return "ok".to_owned();
    };
    let text = error.to_string();
    let own: String = text.split(['\'', '"', '`']).step_by(2).collect();
    own.chars()
        .filter(|c| c.is_ascii_alphabetic() || *c == ' ')
        .take(160)
        .collect()
}

fn corpus_folder(name: &str) -> PathBuf {
    Path::new(env!("CARGO_TARGET_TMPDIR"))
        .parent()
        .expect("the target folder")
        .join("fuzz")
        .join(name)
}

#[test]
fn parsers_survive_damaged_files() {
    let seconds = std::env::var("FASTLGS_FUZZ_SECONDS")
        .ok()
        .and_then(|s| s.parse().ok())
        .unwrap_or(0.5);
    let (mut total, mut failures) = (0, Vec::new());
    for target in targets() {
        let dir = tempfile::tempdir().expect("a folder");
        (target.prepare)(dir.path());
        let file = dir.path().join(target.file);
        std::fs::create_dir_all(file.parent().expect("a folder")).expect("a folder");
        let parse = |data: &[u8]| {
            std::fs::write(&file, data).expect("the input");
            catch_unwind(AssertUnwindSafe(|| (target.parse)(dir.path())))
        };
        assert!(
            matches!(parse(&target.seed), Ok(Ok(()))),
            "{}: the valid file is rejected: {:?}",
            target.name,
            (target.parse)(dir.path())
        );
        let kept = corpus_folder(target.name);
        std::fs::create_dir_all(&kept).expect("the corpus");
        let mut earlier: Vec<PathBuf> = std::fs::read_dir(&kept)
            .expect("the corpus")
            .flatten()
            .map(|e| e.path())
            .collect();
        earlier.sort();
        let mut corpus: Vec<Vec<u8>> = vec![target.seed.clone()];
        corpus.extend(earlier.iter().filter_map(|p| std::fs::read(p).ok()));
        let mut outcomes: BTreeSet<String> = corpus
            .iter()
            .filter_map(|data| Some(outcome(&parse(data).ok()?)))
            .collect();
        let before = corpus.len();
        // The seed depends on the corpus size, so that each run tries new inputs.
        let mut rng = Rng::new(corpus.len() as u64, target.name);
        let (started, mut runs) = (Instant::now(), 0);
        while started.elapsed().as_secs_f64() < seconds {
            let data = mutated(&corpus, &mut rng);
            let input_started = cpu_time();
            let result = parse(&data);
            runs += 1;
            let new = match &result {
                Ok(result) => outcomes.insert(outcome(result)),
                Err(_) => false,
            };
            if result.is_err() || cpu_time() - input_started > SLOW {
                let path = kept.join("failure");
                std::fs::write(&path, &data).expect("the failure");
                failures.push(format!(
                    "{}: panics or hangs; the input is in {}",
                    target.name,
                    path.display()
                ));
                break;
            }
            if let Ok(Err(error)) = &result {
                let text = error.to_string();
                assert!(
                    text.len() > 20 && !text.contains(char::is_control),
                    "{}: the message is too short or has control characters: {text:?}",
                    target.name
                );
            }
            if new && corpus.len() < MAX_INPUTS {
                std::fs::write(kept.join(format!("{:03}", corpus.len())), &data)
                    .expect("the corpus");
                corpus.push(data);
            }
        }
        println!(
            "fuzz {:20} {runs:6} inputs, {} different results, corpus {before} -> {}",
            target.name,
            outcomes.len(),
            corpus.len()
        );
        total += runs;
    }
    println!("fuzz: {total} inputs in total");
    assert!(failures.is_empty(), "{failures:#?}");
}
