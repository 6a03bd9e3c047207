//! `fastlgs query`: finds objects by text, picture or pixel, as masks and as Gaussians (paper,
//! querying features).

mod answer_text;
mod dialogue;

use self::answer_text::{answer_text, caption};
use super::library;
use super::lines::{Line, is_closed, parse_line};
use crate::outcome::Outcome;
use crate::ui::print_line;
use crate::{report, ui};
use anyhow::{Result, bail};
use fastlgs::query::answer::{AnswerReport, NearObject};
use fastlgs::query::sheet::{self, Tile};
use fastlgs::query::{Answer, ObjectQuery, Pixels, ViewChoice, parse_size, selection};
use fastlgs::{Run, Scene};
use fastlgs_core::{Camera, image_io};
use fastlgs_grid::Grid;
use fastlgs_grid::field::Field;
use fastlgs_grid::query::QueryConfig;
use fastlgs_raster::Frame;
use serde_json::json;
use std::io::{BufRead, IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;

#[derive(clap::Args)]
#[command(
    after_help = "Examples: fastlgs query scenes/fox \"fox\" --view 0027.jpg --heatmap -o answers\n          fastlgs query --library scenes \"fox\"\n\nExit code 3 means that nothing in the scene matches."
)]
pub struct Args {
    /// Trained scene folder; omitted with --library.
    #[arg(required_unless_present = "scenes_below")]
    scene: Option<PathBuf>,
    /// Texts to find, answered in turn. "wheel of the bicycle" finds a part. `-` reads one text per
    /// line from standard input and prints one line of JSON each; on a terminal, it starts a
    /// dialogue.
    #[arg(required_unless_present_any = ["image", "point", "object", "scenes_below"])]
    text: Vec<String>,
    /// Picture of the object to find, cut out of its surroundings.
    #[arg(long, value_name = "FILE")]
    image: Vec<PathBuf>,
    /// Pixel of the view that shows the object to find. X,Y+X,Y gives several pixels of one object.
    #[arg(long, value_name = "X,Y")]
    point: Vec<Pixels>,
    /// Id of the object to find, as `fastlgs objects` lists it; may be repeated.
    #[arg(long, value_name = "ID")]
    object: Vec<u16>,
    /// Text that must not match an object better than the query does; may be repeated.
    #[arg(long, value_name = "TEXT")]
    negative: Vec<String>,
    /// Search all scenes below DIR and list those that contain the object.
    #[arg(long = "library", value_name = "DIR")]
    scenes_below: Option<PathBuf>,
    /// Largest number of scenes to list, with --library.
    #[arg(long, value_name = "N", default_value_t = 10, value_parser = clap::builder::RangedU64ValueParser::<usize>::new().range(1..))]
    scenes: usize,
    #[command(flatten)]
    views: ViewChoice,
    /// Folder for masks, overlays, heat maps and the contact sheet; without it, only the report is
    /// printed.
    #[arg(short, long)]
    output: Option<PathBuf>,
    /// Largest number of objects in an answer.
    #[arg(long, default_value_t = QueryConfig::default().top_k, value_parser = clap::builder::RangedU64ValueParser::<usize>::new().range(1..))]
    top_k: usize,
    /// Accepted rate of false alarms: share of absent names that are answered, 0 to 1. A larger
    /// rate also finds more present objects.
    #[arg(long, visible_alias = "false-positive-rate", value_name = "SHARE", default_value_t = QueryConfig::default().false_alarms, value_parser = parse_share)]
    false_alarms: f32,
    /// CLIP text tower, for scenes with imported embeddings, or if the file has moved.
    #[arg(long, value_name = "FILE")]
    clip_text: Option<PathBuf>,
    /// Classify pixels as in the paper: largest distance of a rendered feature from its code, on
    /// the 0..255 scale (5 in the paper). Without it, lifted scenes use the objects that have most
    /// of a pixel's id weight.
    #[arg(long)]
    tau_ac: Option<f32>,
    /// Add the same view of another scene to the contact sheet, for example after `fastlgs remove`.
    #[arg(long, value_name = "SCENE")]
    beside: Option<PathBuf>,
    /// Also write a heat map of the relevancy, in turbo colours.
    #[arg(long)]
    heatmap: bool,
    /// Dilate the masks with a kernel of this size, for example for inpainting.
    #[arg(long, value_name = "WxH", num_args = 0..=1, default_missing_value = "5x5", value_parser = parse_size)]
    dilate: Option<(u32, u32)>,
    /// Number of times that the kernel of --dilate is applied.
    #[arg(long, value_name = "N", default_value_t = 5, value_parser = clap::value_parser!(u32).range(1..=1000))]
    dilate_times: u32,
    /// Write the Gaussians of the answer to FILE.ply, FILE.spz, FILE.sog or FILE.glb.
    #[arg(long, value_name = "FILE")]
    export: Option<PathBuf>,
    /// Write all other Gaussians to FILE, in the same formats.
    #[arg(long, value_name = "FILE")]
    export_rest: Option<PathBuf>,
}

fn parse_share(text: &str) -> Result<f32, String> {
    text.parse()
        .ok()
        .filter(|share| (0.0..=1.0).contains(share))
        .ok_or_else(|| "a number from 0 to 1 is needed".into())
}

/// Number of tiles per row of the contact sheet of a single view.
const TILES_PER_ROW: usize = 4;

/// The view that was rendered last.
struct RenderedView {
    view_index: usize,
    color: Frame,
}

/// An opened scene with the options for its queries.
struct QueryRunner<'a> {
    args: &'a Args,
    scene: Scene,
    grid: Arc<Grid>,
    cameras: Vec<Camera>,
    rendered_view: Option<RenderedView>,
    tiles: Vec<Tile>,
    /// Folder of the pictures.
    output: Option<PathBuf>,
}

pub fn run(args: &Args, common: &ui::Common, run: &Run) -> Result<Outcome> {
    if let Some(root) = &args.scenes_below {
        return search_library(root, args, common, run);
    }
    let reads_lines = args.text.iter().any(|t| t == "-");
    let exports = args.export.is_some() || args.export_rest.is_some();
    check(args, reads_lines, exports)?;
    let Some(path) = &args.scene else {
        bail!("no scene is given; name a trained scene folder")
    };
    let mut scene = Scene::open(path, run.device)?;
    let grid = scene.grid()?;
    let cameras = args.views.cameras(scene.folder(), scene.cameras())?;
    if exports && !args.point.is_empty() && cameras.len() > 1 {
        bail!("--export and --export-rest with --point need a single view; choose it with --view");
    }
    scene.set_clip_text(args.clip_text.clone());
    if !args.text.is_empty() || !args.negative.is_empty() {
        // The text encoder is loaded once, before the first query is timed.
        scene.text_query("warm up")?;
    }
    scene.warm_up()?;
    let mut runner = QueryRunner {
        args,
        scene,
        grid,
        cameras,
        rendered_view: None,
        tiles: Vec::new(),
        output: args.output.clone(),
    };
    match reads_lines {
        true if std::io::stdin().is_terminal() && std::io::stdout().is_terminal() => {
            runner.run_dialogue()
        }
        true => runner.answer_lines(),
        false => runner.answer_arguments(common, run),
    }
}

/// Refuses options that contradict each other.
fn check(args: &Args, reads_lines: bool, exports: bool) -> Result<()> {
    if args.beside.is_some() && args.output.is_none() {
        bail!("--beside adds a picture to the contact sheet; give its folder with -o");
    }
    if reads_lines && args.text.len() > 1 {
        bail!("'-' reads all texts from standard input; leave out other texts");
    }
    if args.heatmap && args.output.is_none() {
        bail!("--heatmap writes a picture; give its folder with -o");
    }
    if reads_lines && exports {
        bail!("--export and --export-rest need a single query; leave out '-'");
    }
    Ok(())
}

/// Runs `--library`: texts are found in all scenes below a folder.
fn search_library(root: &Path, args: &Args, common: &ui::Common, run: &Run) -> Result<Outcome> {
    // With --library, the first positional argument is a text, not a scene.
    let first = args
        .scene
        .iter()
        .map(|text| text.to_string_lossy().into_owned());
    let texts: Vec<String> = first.chain(args.text.iter().cloned()).collect();
    if texts.is_empty() {
        bail!("--library: give a text to find, or '-' to read texts from standard input");
    }
    let writes = args.output.is_some() || args.export.is_some() || args.export_rest.is_some();
    let by_example = !args.image.is_empty() || !args.point.is_empty() || !args.object.is_empty();
    if by_example || writes {
        bail!(
            "--library accepts only texts; query a single scene for pictures, pixels, ids, exports and output files"
        );
    }
    if args.views.is_given() || args.heatmap || args.dilate.is_some() || args.tau_ac.is_some() {
        bail!("--library renders no view; leave out the options for views, masks and heat maps");
    }
    let config = fastlgs::library::SearchConfig {
        scenes: args.scenes,
        false_alarms: args.false_alarms,
        negatives: args.negative.clone(),
        clip_text: args.clip_text.clone(),
    };
    library::run(root, config, &texts, common, run)
}

impl QueryRunner<'_> {
    fn answer_arguments(&mut self, common: &ui::Common, run: &Run) -> Result<Outcome> {
        let texts = self.args.text.iter().cloned().map(ObjectQuery::Text);
        let picture = |path: &PathBuf| -> Result<ObjectQuery> {
            let name = path
                .file_stem()
                .unwrap_or_default()
                .to_string_lossy()
                .into_owned();
            Ok(ObjectQuery::Image(name, image_io::load_rgb(path)?))
        };
        let pictures = self
            .args
            .image
            .iter()
            .map(picture)
            .collect::<Result<Vec<_>>>()?;
        let points = self.args.point.iter().cloned().map(ObjectQuery::Point);
        let ids = self.args.object.iter().copied().map(ObjectQuery::Object);
        let queries: Vec<ObjectQuery> = texts.chain(pictures).chain(points).chain(ids).collect();
        if queries.len() > 1 && (self.args.export.is_some() || self.args.export_rest.is_some()) {
            bail!("--export and --export-rest need a single query; leave out the others");
        }
        let mut answers = Vec::new();
        for place in 0..self.cameras.len() {
            for query in &queries {
                answers.push(self.answer(query, place)?);
            }
        }
        if let Some(root) = &self.args.beside {
            self.add_other_scene(root, run)?;
        }
        let sheet = self.sheet()?;
        let found = answers.iter().any(|a| a.found);
        let single = answers.len() == 1;
        if common.json.is_some() && single {
            report::write_fields(common, &answers.remove(0))?;
        } else if common.json.is_some() {
            report::write_fields(common, &answers)?;
        } else if !common.quiet {
            answers.iter().for_each(|answer| {
                print_line!("{}", answer_text(answer, &self.scene.folder().root))
            });
            sheet
                .iter()
                .for_each(|path| print_line!("contact sheet: {}", path.display()));
        }
        if !found && !common.quiet {
            let names: Vec<String> = queries
                .iter()
                .map(|a| format!("\"{}\"", a.name()))
                .collect();
            eprintln!("nothing in this scene matches {}", names.join(", "));
        }
        Ok(if found {
            Outcome::Done
        } else {
            Outcome::NotFound
        })
    }

    /// Writes the contact sheet of all answers. A single view has rows of [`TILES_PER_ROW`] tiles;
    /// several views have one row each.
    fn sheet(&self) -> Result<Option<PathBuf>> {
        let Some(path) = self.output.as_ref().map(|folder| folder.join("sheet.png")) else {
            return Ok(None);
        };
        let columns = if self.cameras.len() == 1 {
            TILES_PER_ROW
        } else {
            self.tiles.len() / self.cameras.len()
        };
        image_io::save_png(&path, sheet::sheet(&self.tiles, columns))?;
        Ok(Some(path))
    }

    /// Adds a tile of the last view in another scene.
    fn add_other_scene(&mut self, root: &Path, run: &Run) -> Result<()> {
        let Some(camera) = self.cameras.last() else {
            return Ok(());
        };
        let frame = Scene::open(root, run.device)?.render(camera)?;
        let picture = image_io::from_planar(frame.color(), frame.width, frame.height);
        let name = root.file_name().unwrap_or_default().to_string_lossy();
        self.tiles
            .push(Tile::new(&picture, name.into_owned(), camera.name.clone()));
        Ok(())
    }

    /// Answers each line of standard input with a line of JSON. Errors are answers, too.
    fn answer_lines(&mut self) -> Result<Outcome> {
        let mut out = std::io::stdout();
        for line in std::io::stdin().lock().split(b'\n') {
            let text = match parse_line(&line?) {
                Line::None => continue,
                Line::Text(text) => text,
                Line::Unreadable(answer)
                    if is_closed(writeln!(out, "{answer}").and_then(|()| out.flush()))? =>
                {
                    return Ok(Outcome::Done);
                }
                Line::Unreadable(_) => continue,
            };
            for place in 0..self.cameras.len() {
                let answer = self
                    .answer(&ObjectQuery::Text(text.clone()), place)
                    .and_then(|report| Ok(serde_json::to_value(&report)?));
                let answer =
                    answer.unwrap_or_else(|e| json!({ "text": text, "error": format!("{e:#}") }));
                if is_closed(writeln!(out, "{answer}"))? {
                    return Ok(Outcome::Done);
                }
                // No contact sheet is written in this mode.
                self.tiles.clear();
            }
            if is_closed(out.flush())? {
                return Ok(Outcome::Done);
            }
        }
        Ok(Outcome::Done)
    }

    /// Renders the colour of a view for the pictures, and adds its tiles to the sheet. Does nothing
    /// without an output folder, or if this view was rendered last.
    fn render_view_tiles(&mut self, view_index: usize, field: &Field) -> Result<()> {
        if self.output.is_none()
            || self
                .rendered_view
                .as_ref()
                .is_some_and(|s| s.view_index == view_index)
        {
            return Ok(());
        }
        let camera = &self.cameras[view_index];
        let color = self.scene.render(camera)?;
        self.tiles.extend(sheet::view_tiles(
            &self.scene,
            &self.grid,
            camera,
            &color,
            field,
        ));
        self.rendered_view = Some(RenderedView { view_index, color });
        Ok(())
    }

    /// Answers one query in one view.
    fn answer(&mut self, query: &ObjectQuery, view_index: usize) -> Result<AnswerReport> {
        let args = self.args;
        let dilate = args
            .dilate
            .map(|(w, h)| [w / 2 * args.dilate_times, h / 2 * args.dilate_times]);
        let mut answer = self
            .scene
            .query(query.clone())
            .camera(&self.cameras[view_index])
            .negatives(&args.negative)
            .false_alarms(args.false_alarms)
            .top_k(args.top_k)
            .dilate(dilate)
            .tau_ac(args.tau_ac)
            .run()?;
        self.render_view_tiles(view_index, &answer.field)?;
        if let (Some(folder), Some(view)) = (&self.output, &self.rendered_view) {
            let picture = answer.write(folder, &view.color, args.heatmap)?;
            let report = &answer.report;
            self.tiles
                .push(Tile::new(&picture, &report.text, caption(report)));
            let nearest = answer.report.nearest.clone();
            self.add_nearest_tiles(&answer.report.text, nearest)?;
        }
        self.export(&answer)?;
        Ok(answer.report)
    }

    /// Adds a tile for each of the nearest objects of a text that is not found.
    fn add_nearest_tiles(&mut self, text: &str, nearest: Vec<NearObject>) -> Result<()> {
        // Several views have one row of the sheet each, with a tile for each query.
        if self.cameras.len() > 1 {
            return Ok(());
        }
        for object in nearest {
            if let Some(picture) = self.scene.thumbnail(&self.grid, object.id)? {
                let title = format!("{text}? #{}", object.id);
                let view = object.best_view.unwrap_or_default();
                let note = format!("not found, {:.2}, in {view}", object.score);
                self.tiles.push(Tile::new(&picture, title, note));
            }
        }
        Ok(())
    }

    /// Writes the Gaussians of an answer to `--export`, and all others to `--export-rest`.
    fn export(&self, answer: &Answer) -> Result<()> {
        let ids = answer.target_ids();
        for (path, keep) in [(&self.args.export, true), (&self.args.export_rest, false)] {
            if let Some(path) = path.as_ref().filter(|_| !ids.is_empty()) {
                let (scene, gaussians) = (&self.scene, self.scene.gaussians());
                let selected = selection::gaussians(gaussians, &answer.grid, &ids);
                let world = selection::World::of(scene.manifest(), scene.cameras());
                selection::export(path, gaussians, &world, &selected, keep)?;
            }
        }
        Ok(())
    }
}
