//! Readers of files that other programs wrote; `tests/fixtures/README.md` names the programs.

use fastlgs_core::mask_list::annotations;
use fastlgs_core::{Gaussians, WorldFrame, dataset, image_io, splat_file};
use glam::Vec3;
use std::path::{Path, PathBuf};

fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../../tests/fixtures")
        .join(name)
}

/// Largest accepted errors of a format.
struct Tolerance {
    mean: f32,
    scale: f32,
    rotation: f32,
    opacity: f32,
    color: f32,
    harmonics: f32,
}

/// Compares a file with the formulas that it was made from. Gaussians may have another order.
fn assert_helix(name: &str, tolerance: &Tolerance) {
    let (scene, warning) = splat_file::read(&fixture(name), &WorldFrame::default()).expect(name);
    assert_eq!(warning, None, "{name}");
    // splat-transform converts the axes of PLY (y down) to those of SPZ (y up). Training
    // compares both with the photos.
    let is_y_up = name.ends_with(".spz");
    let scene = if is_y_up {
        scene.with_y_and_z_flipped()
    } else {
        scene
    };
    assert_eq!((scene.len(), scene.sh_degree), (12, 1), "{name}");
    for k in 0..12 {
        let t = k as f32;
        let mean = Vec3::new((0.5 * t).cos(), 0.1 * t, (0.5 * t).sin());
        let distance = |i: &usize| scene.means[*i].distance(mean);
        let i = (0..12)
            .min_by(|a, b| distance(a).total_cmp(&distance(b)))
            .expect("twelve");
        let near = |what: &str, error: f32, limit: f32| {
            assert!(
                error <= limit,
                "{name}: Gaussian {k}, {what}: {error} above {limit}"
            );
        };
        near("mean", distance(&i), tolerance.mean);
        let scales = Vec3::new(-3.0 + 0.1 * t, -2.5, -2.0 - 0.05 * t);
        near(
            "scales",
            (scene.log_scales[i] - scales).abs().max_element(),
            tolerance.scale,
        );
        let opacity = 1.0 / (1.0 + (1.0 - 0.3 * t).exp());
        let read = 1.0 / (1.0 + (-scene.opacity_logits[i]).exp());
        near("opacity", (read - opacity).abs(), tolerance.opacity);
        let color = Vec3::new(0.1 * t - 0.5, 0.5 - 0.1 * t, 0.05 * t);
        near(
            "colour",
            (scene.sh_dc[i] - color).abs().max_element(),
            tolerance.color,
        );
        near("rotation", rotation_error(&scene, i, t), tolerance.rotation);
        for (coefficient, rgb) in scene.sh_rest[3 * i..3 * i + 3].iter().enumerate() {
            // f_rest has all coefficients of red, then of green, then of blue.
            let expected =
                |channel: usize| 0.02 * ((3 * channel + coefficient) as f32 - 4.0) + 0.01 * t;
            let expected = Vec3::new(expected(0), expected(1), expected(2));
            near(
                "harmonics",
                (*rgb - expected).abs().max_element(),
                tolerance.harmonics,
            );
        }
    }
}

/// Returns 1 - |cosine| of the read and the expected quaternion.
fn rotation_error(scene: &Gaussians, i: usize, t: f32) -> f32 {
    let expected = [1.0, 0.1 * t, 0.2, -0.05 * t];
    let read = scene.rotations[i];
    let dot = |a: [f32; 4], b: [f32; 4]| (0..4).map(|c| a[c] * b[c]).sum::<f32>();
    1.0 - dot(read, expected).abs() / (dot(read, read) * dot(expected, expected)).sqrt()
}

#[test]
fn exact_formats_of_splat_transform() {
    let exact = Tolerance {
        mean: 1e-5,
        scale: 1e-5,
        rotation: 1e-5,
        opacity: 1e-5,
        color: 1e-5,
        harmonics: 1e-5,
    };
    assert_helix("splats/helix.ply", &exact);
}

/// splat-transform turns glTF by half a turn around z, against the axes of PLY.
#[test]
fn a_gltf_file_of_splat_transform() {
    let path = fixture("splats/helix.glb");
    let (scene, _) = splat_file::read(&path, &WorldFrame::default()).expect("Gaussians");
    assert_eq!((scene.len(), scene.sh_degree), (12, 1));
    for (k, mean) in scene.means.iter().enumerate() {
        let t = k as f32;
        let expected = Vec3::new(-(0.5 * t).cos(), -0.1 * t, (0.5 * t).sin());
        assert!(mean.distance(expected) < 1e-5, "{k}: {mean}");
        let scales = Vec3::new(-3.0 + 0.1 * t, -2.5, -2.0 - 0.05 * t);
        assert!((scene.log_scales[k] - scales).abs().max_element() < 1e-5);
        assert!((scene.opacity_logits[k] - (0.3 * t - 1.0)).abs() < 1e-4);
        let color = Vec3::new(0.1 * t - 0.5, 0.5 - 0.1 * t, 0.05 * t);
        assert!((scene.sh_dc[k] - color).abs().max_element() < 1e-5);
    }
}

#[test]
fn quantised_formats_of_splat_transform() {
    let coarse = Tolerance {
        mean: 2e-3,
        scale: 0.04,
        rotation: 1e-3,
        opacity: 0.01,
        color: 0.03,
        harmonics: 0.04,
    };
    for name in [
        "splats/helix.compressed.ply",
        "splats/helix.spz",
        "splats/helix.sog",
    ] {
        assert_helix(name, &coarse);
    }
}

#[test]
fn masks_of_pycocotools() {
    let list = annotations::load(&fixture("coco/masks.json"), Some("photo.png"), None)
        .expect("the masks")
        .expect("masks of this photo");
    assert_eq!((list.width, list.height), (50, 36));
    let squared =
        |x: i32, y: i32, centre: (i32, i32)| (x - centre.0).pow(2) + (y - centre.1).pow(2);
    let shapes: [&dyn Fn(i32, i32) -> bool; 3] = [
        &|x, y| squared(x, y, (20, 15)) < 100,
        &|x, y| (64..196).contains(&squared(x, y, (34, 20))),
        &|_, y| y == 35,
    ];
    assert_eq!(list.masks.len(), 3);
    for (mask, shape) in list.masks.iter().zip(shapes) {
        let expected = (0..36 * 50).filter(|p| shape(*p % 50, *p / 50));
        let expected: Vec<usize> = expected.map(|p| p as usize).collect();
        // COCO counts pixels column by column.
        let mut pixels: Vec<usize> = list.pixel_indices(mask).collect();
        pixels.sort_unstable();
        assert_eq!(pixels, expected);
    }
}

#[test]
fn a_model_of_pycolmap() {
    let photos = tempfile::tempdir().expect("a folder");
    let model = photos.path().join("sparse/0");
    std::fs::create_dir_all(&model).expect("a folder");
    for file in ["cameras.bin", "images.bin", "points3D.bin"] {
        std::fs::copy(fixture("colmap").join(file), model.join(file)).expect("a copy");
    }
    for k in 0..3 {
        let path = photos.path().join(format!("images/photo {k}.png"));
        image_io::save_png(&path, image::RgbImage::new(64, 48)).expect("a photo");
    }
    let data = dataset::load(photos.path()).expect("the model");
    assert_eq!((data.photos.len(), data.points.len()), (3, 4));
    for (k, photo) in data.photos.iter().enumerate() {
        let camera = &photo.camera;
        assert_eq!(camera.name, format!("photo {k}.png"));
        assert_eq!((camera.width, camera.height), (64, 48));
        let lens = [camera.fx, camera.fy, camera.cx, camera.cy];
        assert_eq!(lens, [60.0, 61.0, 32.5, 23.5]);
        let moved = camera.world_to_camera.w_axis.truncate();
        let expected = Vec3::new(0.1 * k as f32, -0.2, 1.0 + k as f32);
        assert!(moved.distance(expected) < 1e-5, "{moved}");
        let turn = glam::Quat::from_xyzw(0.0, 0.1 * k as f32, 0.02 * k as f32, 1.0).normalize();
        let turned = glam::Quat::from_mat4(&camera.world_to_camera);
        assert!(turned.dot(turn).abs() > 1.0 - 1e-5, "{turned}");
        assert!(photo.distortion != Default::default(), "no distortion");
    }
    let mut points: Vec<_> = data.points.iter().map(|p| (p.position, p.color)).collect();
    points.sort_by(|a, b| a.0.x.total_cmp(&b.0.x));
    for (j, (position, color)) in points.iter().enumerate() {
        assert!(position.distance(Vec3::new(0.5 * j as f32, 0.25, 2.0)) < 1e-5);
        assert_eq!(*color, [10 * j as u8, 20, 30]);
    }
}
