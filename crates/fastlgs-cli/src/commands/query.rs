//! `fastlgs query`: what a text names, as a mask (paper, querying features).

use crate::scene::{Scene, ViewChoice};
use crate::{Outcome, report, ui};
use anyhow::Result;
use fastlgs_core::{Camera, image_io, turbo};
use fastlgs_grid::Grid;
use fastlgs_grid::query::{self, Field, Hit, QueryConfig};
use fastlgs_raster::Frame;
use image::{GrayImage, Luma, Rgb, RgbImage};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::time::Instant;

#[derive(clap::Args)]
#[command(
    after_help = "Example: fastlgs query scenes/fox \"fox\" --view 0027.jpg --heatmap -o answers\n\nExit code 3 means that nothing in the scene matches the text."
)]
pub struct Args {
    /// Trained scene folder.
    scene: PathBuf,
    /// What to look for; several texts are answered one after the other.
    #[arg(required = true)]
    text: Vec<String>,
    #[command(flatten)]
    views: ViewChoice,
    /// Folder for mask, overlay and heat map; without it only the report is given.
    #[arg(short, long)]
    output: Option<PathBuf>,
    /// Most objects that together form the answer.
    #[arg(long, default_value_t = QueryConfig::default().top_k)]
    top_k: usize,
    /// Relevancy from which an object counts as found; by default what suits the scene's encoder (0.65 offline, 0.55 CLIP).
    #[arg(long)]
    min_score: Option<f32>,
    /// CLIP's text tower, for scenes whose embeddings were imported, or when the file has moved.
    #[arg(long, value_name = "FILE")]
    clip_text: Option<PathBuf>,
    /// Further objects must score within this of the best.
    #[arg(long, default_value_t = QueryConfig::default().margin)]
    margin: f32,
    /// Decide as in the paper: the largest distance (5 there) of a rendered feature to its code, on the 0..255 scale.
    /// Without it, lifted scenes take the objects that have most of a pixel's weight.
    #[arg(long)]
    tau_ac: Option<f32>,
    /// Also write the relevancy of every pixel in turbo colours.
    #[arg(long)]
    heatmap: bool,
}

pub fn run(args: &Args, common: &ui::Common) -> Result<Outcome> {
    let mut scene = Scene::open(&args.scene, &common.device)?;
    let grid = scene.grid()?;
    let cameras = args.views.cameras(&scene)?;
    scene.clip_text.clone_from(&args.clip_text);
    let min_score = args.min_score.unwrap_or(scene.min_score());
    // The text encoder is loaded once, before the first query is timed.
    scene.text_query("warm up")?;
    let mut answers = Vec::new();
    let mut found_any = false;
    for camera in &cameras {
        let started = Instant::now();
        let field = scene.field(camera, args.tau_ac)?;
        let render_ms = started.elapsed().as_secs_f64() * 1e3;
        let color = args.output.as_ref().map(|_| scene.render(camera)).transpose()?;
        for text in &args.text {
            let started = Instant::now();
            let text_query = scene.text_query(text)?;
            let encode_ms = started.elapsed().as_secs_f64() * 1e3;
            let started = Instant::now();
            let ranked = query::rank(&grid, &text_query);
            let targets = query::select(&grid, &ranked, &QueryConfig { min_score, top_k: args.top_k, margin: args.margin });
            let answer = Answer { grid: &grid, field: &field, ranked: &ranked, targets: &targets };
            let mask = field.mask(&grid, &targets);
            let restore_ms = started.elapsed().as_secs_f64() * 1e3;
            found_any |= !targets.is_empty();
            let mut value = answer.report(&scene, &mask, text, camera);
            let total = encode_ms + render_ms + restore_ms;
            value["ms"] = json!({ "encode": encode_ms, "render": render_ms, "restore": restore_ms, "total": total });
            if let (Some(folder), Some(color)) = (&args.output, &color) {
                answer.write(folder, color, &mask, &camera.name, args.heatmap, &mut value)?;
            }
            answers.push(value);
        }
    }
    let single = answers.len() == 1;
    let value = if single { answers.remove(0) } else { Value::Array(answers) };
    if common.json.is_some() || single {
        report::give(common, &value)?;
    } else {
        for answer in value.as_array().into_iter().flatten() {
            report::give(common, answer)?;
        }
    }
    if !found_any && !common.quiet {
        eprintln!("nothing in this scene matches {}", args.text.iter().map(|t| format!("\"{t}\"")).collect::<Vec<_>>().join(", "));
    }
    Ok(if found_any { Outcome::Done } else { Outcome::NotFound })
}

/// One text in one view.
struct Answer<'a> {
    grid: &'a Grid,
    field: &'a Field,
    ranked: &'a [Hit],
    targets: &'a [Hit],
}

impl Answer<'_> {
    fn report(&self, scene: &Scene, mask: &[bool], text: &str, camera: &Camera) -> Value {
        let objects: Vec<Value> = self.targets.iter().map(|t| self.object(scene, camera.width, t)).collect();
        json!({
            "text": text,
            "view": camera.name,
            "size": format!("{}x{}", camera.width, camera.height),
            "found": !self.targets.is_empty(),
            "score": self.ranked.first().map_or(0.0, |h| h.score),
            "objects": objects,
            "pixels": mask.iter().filter(|m| **m).count(),
            "mask": Value::Null,
            "heatmap": Value::Null,
            "gaussians": scene.gaussians.len(),
            "adapter": scene.engine.name(),
        })
    }

    /// Box and size of one object in this view and in the world.
    fn object(&self, scene: &Scene, width: u32, hit: &Hit) -> Value {
        let mut bounds: Option<[u32; 4]> = None;
        let mask = self.field.mask(self.grid, &[*hit]);
        for p in (0..mask.len() as u32).filter(|p| mask[*p as usize]) {
            let (x, y) = (p % width, p / width);
            let b = bounds.get_or_insert([x, y, x + 1, y + 1]);
            *b = [b[0].min(x), b[1].min(y), b[2].max(x + 1), b[3].max(y + 1)];
        }
        let members = self.grid.members(&[hit.id]);
        let is_member = |id: u16| members.get(usize::from(id)) == Some(&true);
        let own: Vec<usize> = (0..scene.gaussians.len()).filter(|&i| is_member(scene.gaussians.object_ids[i])).collect();
        json!({
            "id": hit.id,
            "parent": self.grid.objects[usize::from(hit.id) - 1].parent,
            "score": hit.score,
            "bbox2d": bounds,
            "bbox3d": robust_box(scene, &own),
            "pixels": mask.iter().filter(|m| **m).count(),
            "gaussians": own.len(),
        })
    }

    fn write(&self, folder: &Path, frame: &Frame, mask: &[bool], view: &str, heatmap: bool, value: &mut Value) -> Result<()> {
        let (w, h) = (frame.width, frame.height);
        let text = value["text"].as_str().unwrap_or_default();
        let safe: String = text.chars().map(|c| if c.is_alphanumeric() { c } else { '_' }).collect();
        let path = |what: &str| folder.join(format!("{view}.{safe}.{what}.png"));
        let at = |x: u32, y: u32| (y * w + x) as usize;
        let color = image_io::from_planar(frame.channels(0, 3), w, h);
        if self.targets.is_empty() {
            // A mask of an earlier run would contradict the answer.
            for what in ["mask", "overlay"] {
                let _ = std::fs::remove_file(path(what));
            }
        } else {
            image_io::save_png(&path("mask"), GrayImage::from_fn(w, h, |x, y| Luma([if mask[at(x, y)] { 255 } else { 0 }])))?;
            let overlay = RgbImage::from_fn(w, h, |x, y| {
                let c = color.get_pixel(x, y).0;
                Rgb(if mask[at(x, y)] { [c[0] / 2 + 127, c[1] / 2 + 40, c[2] / 2] } else { c.map(|v| v / 3) })
            });
            image_io::save_png(&path("overlay"), overlay)?;
            value["mask"] = json!(path("mask"));
        }
        if heatmap {
            let relevancy = self.field.relevancy(self.grid, self.ranked);
            let picture = RgbImage::from_fn(w, h, |x, y| {
                let heat = turbo::turbo(relevancy[at(x, y)]);
                let c = color.get_pixel(x, y).0;
                Rgb(std::array::from_fn(|k| ((u16::from(heat[k]) * 3 + u16::from(c[k])) / 4) as u8))
            });
            image_io::save_png(&path("heatmap"), picture)?;
            value["heatmap"] = json!(path("heatmap"));
        }
        Ok(())
    }
}

/// World box [min, max] between the 2nd and 98th percentile of the Gaussians' centres: a few floaters do not stretch it.
fn robust_box(scene: &Scene, own: &[usize]) -> Option<[[f32; 3]; 2]> {
    if own.is_empty() {
        return None;
    }
    let mut out = [[0.0; 3]; 2];
    for k in 0..3 {
        let mut values: Vec<f32> = own.iter().map(|&i| scene.gaussians.means[i][k]).collect();
        values.sort_by(f32::total_cmp);
        out[0][k] = values[values.len() * 2 / 100];
        out[1][k] = values[(values.len() - 1) * 98 / 100];
    }
    Some(out)
}
