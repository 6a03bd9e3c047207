//! `fastlgs bench growth`: what global mapping and the paper's cost as photos, masks and Gaussians grow, on a generated plain of tiles whose masks
//! are exact.

use crate::speed::peak_process_bytes;
use anyhow::{Context, Result};
use fastlgs::Run;
use fastlgs::objects::{self, Config};
use fastlgs_core::rng::Rng;
use fastlgs_core::{Camera, Gaussians, LabelMap, MaskList, SceneFolder};
use fastlgs_grid::mapping::{self, Mask, PaperConfig};
use glam::{Mat3, Vec2, Vec3};
use rayon::prelude::*;
use serde_json::{Value, json};
use std::time::Instant;

#[derive(clap::Args)]
#[command(after_help = "Example: fastlgs bench growth --photos 300 --masks 300 --gaussians 1000000 --device cpu")]
pub struct Args {
    /// Photos, of 480x360 pixels.
    #[arg(long, default_value_t = 40)]
    photos: usize,
    /// Masks a photo.
    #[arg(long, default_value_t = 60)]
    masks: usize,
    /// Gaussians.
    #[arg(long, default_value_t = 60_000)]
    gaussians: usize,
    /// Also map with half the photos, half the masks and half the Gaussians, and tell the exponents of global mapping.
    #[arg(long)]
    exponents: bool,
}

/// Half the side of the plain.
const HALF: f32 = 1.0;
/// Share of the plain that a photo shows, about.
const SHOWN: f32 = 0.2;
const SIZE: (u32, u32) = (480, 360);

pub fn run(args: &Args, run: &Run) -> Result<Value> {
    let whole = measured([args.photos, args.masks, args.gaussians], run)?;
    let mut value = json!({ "size": format!("{}x{}", SIZE.0, SIZE.1), "adapter": run.device, "runs": [whole] });
    if args.exponents {
        let seconds = |v: &Value| v["seconds"].as_f64().context("seconds");
        for (k, name) in ["photos", "masks", "gaussians"].into_iter().enumerate() {
            let mut sizes = [args.photos, args.masks, args.gaussians];
            sizes[k] /= 2;
            let half = measured(sizes, run)?;
            value["exponents"][name] = json!((seconds(&value["runs"][0])? / seconds(&half)?).log2());
            value["runs"].as_array_mut().context("a list")?.push(half);
        }
    }
    // Of the process so far: the first run is the largest.
    value["peak_process_bytes"] = json!(peak_process_bytes());
    Ok(value)
}

/// Maps a plain with so many photos, masks a photo and Gaussians.
fn measured([photos, masks, gaussians]: [usize; 3], run: &Run) -> Result<Value> {
    let dir = tempfile::tempdir().context("no temporary folder")?;
    let folder = SceneFolder::new(dir.path());
    // A third of the masks are tiles, two thirds their halves.
    let tiles = ((masks as f32 / 3.0 / SHOWN).sqrt().round() as u32).max(2);
    let cameras: Vec<Camera> = (0..photos).map(|k| camera(k, photos)).collect();
    let counts = cameras.par_iter().map(|c| {
        let list = masks_of(c, tiles);
        list.save(&folder.masks_path(&c.name)).map(|()| list.masks.len())
    });
    let found: usize = counts.collect::<Result<Vec<_>, _>>()?.into_iter().sum();
    let mut scene = plain(gaussians);
    let config = Config { objects: fastlgs_grid::objects::Config::default(), antialias: false };
    let started = Instant::now();
    let mapped = objects::map(&mut scene, &folder, &cameras, &config, run)?;
    let seconds = started.elapsed().as_secs_f64();
    let seen = embedded(&cameras, tiles);
    let started = Instant::now();
    let matched = mapping::paper(&seen, &mapping::Correspondences::new(), &PaperConfig::default())?;
    Ok(json!({
        "photos": photos, "masks_per_photo": found as f64 / photos as f64, "gaussians": scene.len(),
        "seconds": seconds,
        "sets": mapped.summary.sets, "objects": mapped.chosen.support.len(), "things": 3 * tiles * tiles,
        "paper_masks": seen.len(), "paper_seconds": started.elapsed().as_secs_f64(), "paper_objects": matched.count,
        "paper_comparisons": matched.comparisons,
    }))
}

/// Spheres that cover the plain, side by side.
fn plain(count: usize) -> Gaussians {
    let side = (count as f32).sqrt() as usize;
    let step = 2.0 * HALF / side as f32;
    let mut scene = Gaussians::default();
    for k in 0..side * side {
        let at = Vec2::new((k % side) as f32 + 0.5, (k / side) as f32 + 0.5) * step - HALF;
        scene.push_sphere(Vec3::new(at.x, 0.0, at.y), 0.6 * step, 0.95, [0.5; 3]);
    }
    scene
}

/// Cameras above the plain that look down aslant, spread like the seeds of a sunflower.
fn camera(k: usize, count: usize) -> Camera {
    let turn = 2.399_963 * k as f32;
    let at = 0.7 * HALF * ((k as f32 + 0.5) / count as f32).sqrt() * Vec2::from_angle(turn);
    let aside = 0.3 * Vec2::from_angle(2.0 * turn);
    let eye = Vec3::new(at.x + aside.x, 0.8, at.y + aside.y);
    Camera::look_at(&format!("{k:04}.png"), eye, Vec3::new(at.x, 0.0, at.y), Vec3::Y, SIZE.0, SIZE.1, 0.95)
}

/// Numbers of an embedding and of a colour histogram, as CLIP's ViT-B/16 and the paper's have them.
const EMBEDDING: usize = 512;
/// How much an embedding wavers from view to view: cosines of one tile are about 0.98.
const WAVERING: f32 = 0.14;

/// The halves of tiles that views show, as Algorithm 1 takes them: each half looks its own way.
fn embedded(cameras: &[Camera], tiles: u32) -> Vec<Mask> {
    let one = |(view, camera): (usize, &Camera)| {
        let mut areas = std::collections::BTreeMap::new();
        halves_of(camera, tiles).into_iter().flatten().for_each(|half| *areas.entry(half).or_insert(0.0) += 1.0);
        let pixels = (camera.width * camera.height) as f32;
        let mask = |(half, area): (u16, f32)| {
            let mut look = Rng::new(u64::from(half), "look");
            let mut wavering = Rng::new((view as u64) << 16 | u64::from(half), "wavering");
            let mut embedding: Vec<f32> = (0..EMBEDDING).map(|_| look.normal() + WAVERING * wavering.normal()).collect();
            let length = embedding.iter().map(|v| v * v).sum::<f32>().sqrt();
            embedding.iter_mut().for_each(|v| *v /= length);
            let mut histogram: Vec<f32> = (0..EMBEDDING).map(|_| look.normal().powi(2)).collect();
            let sum: f32 = histogram.iter().sum();
            histogram.iter_mut().for_each(|v| *v /= sum);
            Mask { view, label: half, area: area / pixels, embedding, histogram }
        };
        areas.into_iter().map(mask).collect::<Vec<_>>()
    };
    cameras.par_iter().enumerate().flat_map_iter(one).collect()
}

/// The tiles that a view shows, and their halves.
fn masks_of(camera: &Camera, tiles: u32) -> MaskList {
    let mut levels = [(); 3].map(|()| LabelMap::new(camera.width, camera.height));
    for (p, half) in halves_of(camera, tiles).into_iter().enumerate() {
        let Some(half) = half else { continue };
        (levels[0].labels[p], levels[1].labels[p]) = (half.div_ceil(2), half);
    }
    MaskList::of_levels(&levels)
}

/// Which half of a tile each pixel shows, counted from 1; tile t has the halves 2 t - 1 and 2 t.
fn halves_of(camera: &Camera, tiles: u32) -> Vec<Option<u16>> {
    let to_world = Mat3::from_mat4(camera.world_to_camera).transpose();
    let eye = camera.centre();
    let half = |p: u32| {
        let pixel = Vec2::new((p % camera.width) as f32 + 0.5, (p / camera.width) as f32 + 0.5);
        let ray = to_world * camera.ray(pixel);
        let at = eye - ray * (eye.y / ray.y);
        let place = (Vec2::new(at.x, at.z) + HALF) * tiles as f32 / (2.0 * HALF);
        let tile = place.y as u32 * tiles + place.x as u32;
        let shown = ray.y < 0.0 && place.min_element() >= 0.0 && place.max_element() < tiles as f32;
        shown.then(|| (2 * tile + u32::from(place.x.fract() > 0.5)) as u16 + 1)
    };
    (0..camera.width * camera.height).map(half).collect()
}
