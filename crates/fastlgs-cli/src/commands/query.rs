//! `fastlgs query`: what a text, a picture or a point names, as masks and as Gaussians (paper, querying features).

mod dialogue;

use super::library;
use super::lines::{Line, ends, line_of};
use crate::outcome::Outcome;
use crate::ui::say;
use crate::words::thousands;
use crate::{report, ui};
use anyhow::{Result, bail};
use fastlgs::session::answer::{CANDIDATES, ObjectReport, Question, Report};
use fastlgs::session::ask::Ask;
use fastlgs::session::sheet::{self, Tile};
use fastlgs::session::{Pixels, ViewChoice, parse_size, selection};
use fastlgs::{Run, Session};
use fastlgs_core::{Camera, image_io};
use fastlgs_grid::Grid;
use fastlgs_grid::field::Field;
use fastlgs_grid::query::QueryConfig;
use fastlgs_raster::Frame;
use serde_json::json;
use std::io::{BufRead, IsTerminal, Write};
use std::path::PathBuf;
use std::time::Instant;

#[derive(clap::Args)]
#[command(
    after_help = "Examples: fastlgs query scenes/fox \"fox\" --view 0027.jpg --heatmap -o answers\n          fastlgs query --library scenes \"fox\"\n\nExit code 3 means that nothing in the scene matches."
)]
pub struct Args {
    /// Trained scene folder; not with --library.
    #[arg(required_unless_present = "scenes_below")]
    scene: Option<PathBuf>,
    /// What to look for; several texts are answered one after the other. "wheel of the bicycle" asks for a part. `-` reads
    /// texts from standard input and answers each line at once with a line of JSON; on a terminal it is a dialogue.
    #[arg(required_unless_present_any = ["image", "point", "scenes_below"])]
    text: Vec<String>,
    /// A picture of what to look for, cut out of its surroundings.
    #[arg(long, value_name = "FILE")]
    image: Vec<PathBuf>,
    /// A pixel of the view: the object that it shows; several as X,Y+X,Y: the object that they tell of together.
    #[arg(long, value_name = "X,Y")]
    point: Vec<Pixels>,
    /// A text that the object must not be nearer to than to what is looked for; may be given several times.
    #[arg(long, value_name = "TEXT")]
    negative: Vec<String>,
    /// Ask all scenes below DIR which of them hold it; the index that this needs is kept there as library.index.
    #[arg(long = "library", value_name = "DIR")]
    scenes_below: Option<PathBuf>,
    /// Most scenes that --library names.
    #[arg(long, value_name = "N", default_value_t = 10, value_parser = clap::builder::RangedU64ValueParser::<usize>::new().range(1..))]
    scenes: usize,
    #[command(flatten)]
    views: ViewChoice,
    /// Folder for mask, overlay and heat map; without it only the report is given.
    #[arg(short, long)]
    output: Option<PathBuf>,
    /// Most objects that together form the answer.
    #[arg(long, default_value_t = QueryConfig::default().top_k, value_parser = clap::builder::RangedU64ValueParser::<usize>::new().range(1..))]
    top_k: usize,
    /// Share of the names of absent things that may be answered all the same, 0 to 1; more finds more that is there, too.
    #[arg(long, value_name = "SHARE", default_value_t = QueryConfig::default().false_alarms, value_parser = parse_share)]
    false_alarms: f32,
    /// CLIP's text tower, for scenes whose embeddings were imported, or when the file has moved.
    #[arg(long, value_name = "FILE")]
    clip_text: Option<PathBuf>,
    /// Decide as in the paper: the largest distance (5 there) of a rendered feature to its code, on the 0..255 scale.
    /// Without it, lifted scenes take the objects that have most of a pixel's weight.
    #[arg(long)]
    tau_ac: Option<f32>,
    /// Also write the relevancy of every pixel in turbo colours.
    #[arg(long)]
    heatmap: bool,
    /// Widen the masks by a kernel, as inpainting wants them.
    #[arg(long, value_name = "WxH", num_args = 0..=1, default_missing_value = "5x5", value_parser = parse_size)]
    dilate: Option<(u32, u32)>,
    /// How often the kernel of --dilate is applied.
    #[arg(long, value_name = "N", default_value_t = 5, value_parser = clap::value_parser!(u32).range(1..=1000))]
    dilate_times: u32,
    /// Write the selected Gaussians as a scene of their own: FILE.ply, FILE.spz, FILE.sog or FILE.glb.
    #[arg(long, value_name = "FILE", alias = "export-ply")]
    export: Option<PathBuf>,
    /// Write the scene without the selected Gaussians, in the same formats.
    #[arg(long, value_name = "FILE", alias = "remove-ply")]
    export_rest: Option<PathBuf>,
}

fn parse_share(text: &str) -> Result<f32, String> {
    text.parse().ok().filter(|share| (0.0..=1.0).contains(share)).ok_or_else(|| "a share from 0 to 1 is needed".into())
}

/// An answer in a few words.
fn told(report: &Report) -> String {
    let Report { text, view, score, .. } = report;
    let of = |object: &ObjectReport| {
        let place = object.bbox2d.map_or_else(|| "not in this view".to_owned(), |[x0, y0, x1, y1]| format!("at {x0},{y0} to {x1},{y1}"));
        format!("  #{}: {} pixels {place}, confidence {:.2}", object.id, thousands(object.pixels), object.score)
    };
    let sure = if report.calibrated { "" } else { " (not calibrated: run fastlgs models calibrate)" };
    let taught = if report.taught { ", taught" } else { "" };
    if !report.found {
        return format!("{text}: not found; the nearest object has a confidence of {score:.2}{sure}{taught}");
    }
    let count = if report.objects.len() == 1 { "1 object".to_owned() } else { format!("{} objects", report.objects.len()) };
    let shown = match &report.seen_best {
        Some(best) => format!("hidden in {view}; seen best in {best}"),
        None => format!("{} pixels in {view}", thousands(report.pixels)),
    };
    let mut lines = vec![format!("{text}: found, confidence {score:.2}{sure}{taught}, {count}, {shown} ({:.0} ms)", report.ms.total)];
    if report.objects.len() > 1 {
        lines.extend(report.objects.iter().map(of));
    }
    let files = [("mask", &report.mask), ("heat map", &report.heatmap)];
    lines.extend(files.into_iter().filter_map(|(what, path)| Some(format!("  {what}: {}", path.as_ref()?.display()))));
    lines.join("\n")
}

/// An answer in the words under its picture.
fn in_short(report: &Report) -> String {
    let verdict = if report.found { "found" } else { "not found" };
    format!("{verdict}, {:.2}, {} pixels", report.score, thousands(report.pixels))
}

/// Tiles of a view in a row of a contact sheet.
const IN_A_ROW: usize = 4;

/// A view as it was last rendered.
struct Shown {
    place: usize,
    field: Field,
    color: Option<Frame>,
}

/// What questions are put to, and how.
struct Asker<'a> {
    args: &'a Args,
    scene: Session,
    grid: Grid,
    cameras: Vec<Camera>,
    config: QueryConfig,
    shown: Option<Shown>,
    tiles: Vec<Tile>,
    /// Where pictures go.
    output: Option<PathBuf>,
}

pub fn run(args: &Args, common: &ui::Common, run: &Run) -> Result<Outcome> {
    if let Some(root) = &args.scenes_below {
        // What stands in the scene's place is the first text.
        let first = args.scene.iter().map(|text| text.to_string_lossy().into_owned());
        let texts: Vec<String> = first.chain(args.text.iter().cloned()).collect();
        if texts.is_empty() {
            bail!("--library: say what to look for, or '-' for lines of standard input");
        }
        if !args.image.is_empty() || !args.point.is_empty() || args.output.is_some() || args.export.is_some() || args.export_rest.is_some()
        {
            bail!("--library answers texts with scenes; ask one of these scenes for pictures, points and selections");
        }
        if args.views.is_given() || args.heatmap || args.dilate.is_some() || args.tau_ac.is_some() {
            bail!("--library looks at no view: leave out options of views, masks and heat maps");
        }
        let (negatives, clip_text) = (args.negative.clone(), args.clip_text.clone());
        let config = fastlgs::library::Config { scenes: args.scenes, false_alarms: args.false_alarms, negatives, clip_text };
        return library::run(root, config, &texts, common, run);
    }
    let shown = !args.point.is_empty() || !args.image.is_empty();
    if shown && !args.text.is_empty() {
        bail!("ask in one way: a text, or --point, or --image");
    }
    let lines = args.text.iter().any(|t| t == "-");
    if lines && (args.text.len() > 1 || !args.image.is_empty() || !args.point.is_empty()) {
        bail!("'-' reads all questions from standard input: leave out other texts, --image and --point");
    }
    if args.heatmap && args.output.is_none() {
        bail!("--heatmap is a picture: name a folder for it with -o");
    }
    let exports = args.export.is_some() || args.export_rest.is_some();
    if lines && exports {
        bail!("--export and --export-rest write the answer to one question: leave out '-'");
    }
    let Some(path) = &args.scene else { bail!("name a trained scene") };
    let mut scene = Session::open(path, run.device)?;
    let grid = scene.grid()?;
    let cameras = args.views.cameras(&scene.folder, &scene.cameras)?;
    if exports && !args.point.is_empty() && cameras.len() > 1 {
        bail!("--export and --export-rest write what a pixel of one view shows: name one --view");
    }
    scene.clip_text.clone_from(&args.clip_text);
    let config = QueryConfig { false_alarms: args.false_alarms, top_k: args.top_k };
    if !args.text.is_empty() || !args.negative.is_empty() {
        // The text encoder is loaded once, before the first query is timed.
        scene.text_query("warm up")?;
    }
    scene.warm_up()?;
    let mut asker = Asker { args, scene, grid, cameras, config, shown: None, tiles: Vec::new(), output: args.output.clone() };
    match lines {
        true if std::io::stdin().is_terminal() && std::io::stdout().is_terminal() => asker.converse(),
        true => asker.answer_lines(),
        false => asker.answer_arguments(common),
    }
}

impl Asker<'_> {
    fn answer_arguments(&mut self, common: &ui::Common) -> Result<Outcome> {
        let texts = self.args.text.iter().cloned().map(Ask::Text);
        let picture = |path: &PathBuf| -> Result<Ask> {
            let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
            Ok(Ask::Image(name, image_io::load_rgb(path)?))
        };
        let pictures = self.args.image.iter().map(picture).collect::<Result<Vec<_>>>()?;
        let points = self.args.point.iter().cloned().map(Ask::Point);
        let asks: Vec<Ask> = texts.chain(pictures).chain(points).collect();
        if asks.len() > 1 && (self.args.export.is_some() || self.args.export_rest.is_some()) {
            bail!("--export and --export-rest write the answer to one question: ask only one");
        }
        let mut answers = Vec::new();
        for place in 0..self.cameras.len() {
            for ask in &asks {
                answers.push(self.answer(ask, place)?);
            }
        }
        let sheet = self.sheet()?;
        let found = answers.iter().any(|a| a.found);
        let single = answers.len() == 1;
        if common.json.is_some() && single {
            report::give(common, &answers.remove(0))?;
        } else if common.json.is_some() {
            report::give(common, &answers)?;
        } else if !common.quiet {
            answers.iter().for_each(|answer| say!("{}", told(answer)));
            sheet.iter().for_each(|path| say!("all of it on one sheet: {}", path.display()));
        }
        if !found && !common.quiet {
            let names: Vec<String> = asks.iter().map(|a| format!("\"{}\"", a.name())).collect();
            eprintln!("nothing in this scene matches {}", names.join(", "));
        }
        Ok(if found { Outcome::Done } else { Outcome::NotFound })
    }

    /// Writes the contact sheet of all answers: where one view was asked in rows of [`IN_A_ROW`], else a row for each view.
    fn sheet(&self) -> Result<Option<PathBuf>> {
        let Some(path) = self.output.as_ref().map(|folder| folder.join("sheet.png")) else { return Ok(None) };
        let columns = if self.cameras.len() == 1 { IN_A_ROW } else { self.tiles.len() / self.cameras.len() };
        image_io::save_png(&path, sheet::sheet(&self.tiles, columns))?;
        Ok(Some(path))
    }

    /// Each line of standard input is a text; each answer a line of JSON, also where something is wrong with the question.
    fn answer_lines(&mut self) -> Result<Outcome> {
        let mut out = std::io::stdout();
        for line in std::io::stdin().lock().split(b'\n') {
            let text = match line_of(&line?) {
                Line::None => continue,
                Line::Text(text) => text,
                Line::Unreadable(answer) if ends(writeln!(out, "{answer}").and_then(|()| out.flush()))? => return Ok(Outcome::Done),
                Line::Unreadable(_) => continue,
            };
            for place in 0..self.cameras.len() {
                let answer = self.answer(&Ask::Text(text.clone()), place).and_then(|report| Ok(serde_json::to_value(&report)?));
                let answer = answer.unwrap_or_else(|e| json!({ "text": text, "error": format!("{e:#}") }));
                if ends(writeln!(out, "{answer}"))? {
                    return Ok(Outcome::Done);
                }
                // Lines make no sheet.
                self.tiles.clear();
            }
            if ends(out.flush())? {
                return Ok(Outcome::Done);
            }
        }
        Ok(Outcome::Done)
    }

    /// Renders a view unless it is the one that was rendered last; milliseconds, 0 where nothing was to do.
    fn show(&mut self, place: usize) -> Result<f64> {
        if self.shown.as_ref().is_some_and(|s| s.place == place) {
            return Ok(0.0);
        }
        let started = Instant::now();
        let field = self.scene.field(&self.cameras[place], self.args.tau_ac)?;
        let ms = started.elapsed().as_secs_f64() * 1e3;
        let color = self.output.as_ref().map(|_| self.scene.render(&self.cameras[place])).transpose()?;
        if let Some(frame) = &color {
            self.tiles.extend(sheet::of_view(&self.scene, &self.grid, &self.cameras[place], frame, &field));
        }
        self.shown = Some(Shown { place, field, color });
        Ok(ms)
    }

    /// One question in one view.
    fn answer(&mut self, ask: &Ask, place: usize) -> Result<Report> {
        let render_ms = self.show(place)?;
        let Some(Shown { field, color, .. }) = &self.shown else { bail!("no view was rendered") };
        let (args, scene, grid, camera) = (self.args, &self.scene, &self.grid, &self.cameras[place]);
        let dilate = args.dilate.map(|(w, h)| [w / 2 * args.dilate_times, h / 2 * args.dilate_times]);
        let question = Question { ask, negatives: &args.negative, config: self.config, dilate, candidates: CANDIDATES };
        let (answer, mut report) = question.put(scene, grid, field, camera, render_ms)?;
        let targets = &answer.found.targets;
        let mut tile = None;
        if let (Some(folder), Some(color)) = (&self.output, color) {
            let picture = answer.write(folder, color, args.heatmap, &mut report)?;
            tile = Some(Tile::new(&picture, &report.text, in_short(&report)));
        }
        for (path, keep) in [(&args.export, true), (&args.export_rest, false)] {
            if let Some(path) = path.as_ref().filter(|_| !targets.is_empty()) {
                let ids: Vec<u16> = targets.iter().map(|t| t.id).collect();
                let selected = selection::gaussians(&scene.gaussians, grid, &ids);
                let world = selection::World::of(&scene.manifest, &scene.cameras);
                selection::export(path, &scene.gaussians, &world, &selected, keep)?;
            }
        }
        report.look_elsewhere(&mut self.scene, &self.grid)?;
        self.tiles.extend(tile);
        Ok(report)
    }
}
