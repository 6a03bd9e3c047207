//! Objects in 3-D: the Gaussians of an object, and a scene without that object.

#[path = "support/run.rs"]
mod run;

use fastlgs::query::selection;
use fastlgs_core::label_map::LabelMap;
use fastlgs_core::{Camera, Gaussians, SceneFolder, exr_image, image_io, metrics};
use fastlgs_grid::Grid;
use run::{Fixture, assert_fails, fastlgs, fixture, json, text};
use serde_json::Value;
use std::path::Path;
use std::time::Instant;

/// Label of the coffee in the room's exact masks.
const COFFEE: u16 = 2;

fn coffee(f: &Fixture) -> u16 {
    let answer: Value = json(&["query", text(&f.scene), "coffee", "--view", "008"]);
    answer["objects"][0]["id"].as_u64().expect("an object") as u16
}

/// Returns the label of the surface on which Gaussian `i` lies, by a vote of all photos with exact
/// depth and masks. A photo votes if its depth agrees within 3 %. Returns `None` without votes.
fn label_of(scene: &Gaussians, i: usize, photos: &[(Camera, Vec<f32>, LabelMap)]) -> Option<u16> {
    let mut votes = std::collections::BTreeMap::new();
    for (camera, depth, things) in photos {
        let there = camera.world_to_camera.transform_point3(scene.means[i]);
        let at = camera.to_pixel(there);
        if there.z > 0.0
            && at.x >= 0.0
            && at.y >= 0.0
            && at.x < camera.width as f32
            && at.y < camera.height as f32
        {
            let pixel = at.y as usize * camera.width as usize + at.x as usize;
            if (depth[pixel] - there.z).abs() < 0.03 * there.z {
                *votes.entry(things.labels[pixel]).or_insert(0) += 1;
            }
        }
    }
    votes
        .into_iter()
        .max_by_key(|(thing, count)| (*count, *thing))
        .map(|(thing, _)| thing)
}

/// 3-D segmentation from a text. (The paper passes its masks to SAGA for this.)
#[test]
fn the_gaussians_of_an_answer_lie_on_the_object() {
    let Some(f) = fixture() else { return };
    let id = coffee(f);
    let folder = SceneFolder::open(&f.scene).expect("the scene");
    let (scene, grid) = (
        folder.gaussians().expect("Gaussians"),
        Grid::load(&folder).expect("a grid"),
    );
    let started = Instant::now();
    let selected = selection::gaussians(&scene, &grid, &[id]);
    let milliseconds = started.elapsed().as_secs_f64() * 1e3;
    let exact = |camera: Camera| {
        let depth = exr_image::read(&f.photos.join("depth").join(format!("{}.exr", camera.name)));
        let depth = depth.expect("exact depth").2.remove(0).1;
        let things = LabelMap::load(&f.photos.join("masks").join(format!("{}.png", camera.name)))
            .expect("exact masks");
        (camera, depth, things)
    };
    let photos: Vec<_> = folder
        .initial_cameras()
        .expect("cameras")
        .into_iter()
        .map(exact)
        .collect();
    let (mut both, mut found, mut there) = (0, 0, 0);
    for i in 0..scene.len() {
        let Some(thing) = label_of(&scene, i, &photos) else {
            continue;
        };
        let (is_selected, is_coffee) = (selected.binary_search(&i).is_ok(), thing == COFFEE);
        found += usize::from(is_selected);
        there += usize::from(is_coffee);
        both += usize::from(is_selected && is_coffee);
    }
    let (precision, recall) = (both as f64 / found as f64, both as f64 / there as f64);
    println!(
        "{found} surface Gaussians selected in {milliseconds:.3} ms: precision {precision:.3}, recall {recall:.3}"
    );
    assert!(
        there > 50 && precision >= 0.95 && recall >= 0.95,
        "{both} of {found} and {there}"
    );
}

/// The ground truth is the same room, generated without the object.
#[test]
fn a_removed_object_is_replaced_by_its_background() {
    let Some(f) = fixture() else { return };
    let at = |name: &str| f.dir.path().join("removal").join(name);
    let (truth, removed_scene) = (at("truth"), at("tidy"));
    let made = json(&[
        "synth",
        "room",
        "-o",
        text(&truth),
        "--views",
        "32",
        "--size",
        "320x240",
        "--without",
        "coffee",
    ]);
    assert!(
        made["objects"]
            .as_array()
            .is_some_and(|names| !names.is_empty() && names.iter().all(|name| name != "coffee")),
        "{made}"
    );
    let id = coffee(f).to_string();
    let report = json(&[
        "remove",
        text(&f.scene),
        "--object",
        &id,
        "-o",
        text(&removed_scene),
    ]);
    assert!(
        report["removed"].as_u64().is_some_and(|n| n > 50),
        "{report}"
    );

    // Compares held-out views, which training has not seen.
    let quality = |scene: &Path, name: &str| {
        let out = at(name);
        json(&[
            "render",
            text(scene),
            "--all-views",
            "--what",
            "color",
            "-o",
            text(&out),
        ]);
        let (mut inside, mut outside) = (Vec::new(), Vec::new());
        for view in ["008.png", "016.png", "024.png"] {
            let wanted = image_io::to_planar(
                &image_io::load_rgb(&truth.join("images").join(view)).expect("the truth"),
            );
            let rendered = image_io::to_planar(
                &image_io::load_rgb(&out.join(format!("{view}.color.png"))).expect("a picture"),
            );
            let mask = LabelMap::load(&f.photos.join("masks").join(format!("{view}.png")))
                .expect("exact masks")
                .mask(COFFEE);
            let around = metrics::dilate(&mask, 320, 240, [12, 12]);
            let psnr = |member: &dyn Fn(usize) -> bool| {
                let pick = |planes: &[f32]| -> Vec<f32> {
                    planes
                        .iter()
                        .enumerate()
                        .filter(|(k, _)| member(k % mask.len()))
                        .map(|(_, v)| *v)
                        .collect()
                };
                metrics::psnr(&pick(&rendered), &pick(&wanted))
            };
            if mask.iter().filter(|m| **m).count() > 50 {
                inside.push(psnr(&|p| mask[p]));
                outside.push(psnr(&|p| !around[p]));
            }
        }
        let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
        [mean(&inside), mean(&outside)]
    };
    let (before, after) = (
        quality(&f.scene, "before"),
        quality(&removed_scene, "after"),
    );
    println!(
        "PSNR in the coffee's mask: {:.1} dB before, {:.1} dB after removal; elsewhere {:.2} and {:.2} dB",
        before[0], after[0], before[1], after[1]
    );
    assert!(
        after[0] > before[0] + 3.0 && (after[1] - before[1]).abs() < 0.3,
        "{before:?} {after:?}"
    );

    // The new scene works like any other, and does not find the object.
    let asked = fastlgs(&["query", text(&removed_scene), "coffee", "--view", "008"]);
    assert_eq!(
        asked.status.code(),
        Some(3),
        "{}",
        String::from_utf8_lossy(&asked.stdout)
    );
    let objects = |scene: &Path| {
        Grid::load(&SceneFolder::open(scene).expect("a scene"))
            .expect("a grid")
            .objects
            .len()
    };
    assert!(objects(&removed_scene) < objects(&f.scene));
    json(&["eval", text(&removed_scene)]);
    json(&["export", text(&removed_scene), text(&at("tidy.spz"))]);
    let small = at("small/");
    json(&["export", text(&f.scene), text(&small)]);
    assert_fails(
        &[
            "remove",
            text(&small),
            "--object",
            &id,
            "-o",
            text(&at("x")),
        ],
        &["photos are not there"],
    );
    assert_fails(
        &[
            "remove",
            text(&f.scene),
            "--object",
            &id,
            "-o",
            text(&removed_scene),
        ],
        &["tidy", "already"],
    );
    assert_fails(
        &[
            "remove",
            text(&f.scene),
            "--object",
            "999",
            "-o",
            text(&at("x")),
        ],
        &["none is 999"],
    );
    assert_fails(
        &["remove", text(&f.scene), "submarine", "-o", text(&at("x"))],
        &["'submarine' is not found", "by its id"],
    );
    assert!(!at("x").exists());
    assert_fails(
        &[
            "synth",
            "room",
            "-o",
            text(&at("y")),
            "--without",
            "submarine",
        ],
        &["none of", "coffee"],
    );
}
