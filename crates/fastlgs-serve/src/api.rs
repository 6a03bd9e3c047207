//! The HTTP interface: what each address does. `web/openapi.json` describes it for programs.

use crate::desk::{Choice, Desk};
use crate::failure::Failure;
use crate::guard::LARGEST_BODY;
use crate::shared::Shared;
use axum::Json;
use axum::body::Bytes;
use axum::extract::rejection::{JsonRejection, PathRejection, QueryRejection};
use axum::extract::{Path, Query, State};
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse, Response};
use base64::Engine as _;
use fastlgs::session::Pixels;
use fastlgs::session::answer::{CANDIDATES, Question};
use fastlgs::session::ask::Ask;
use fastlgs::session::pictures::{heatmap, mask_picture, overlay};
use fastlgs::session::selection::World;
use fastlgs::session::{parse_size, selection};
use fastlgs::teach::learn;
use fastlgs_core::camera::mean_up;
use fastlgs_core::{Camera, image_io, turbo};
use fastlgs_grid::query::{self, QueryConfig};
use image::{DynamicImage, Rgb, RgbImage};
use serde::Deserialize;
use serde_json::{Value, json};
use std::sync::Arc;

/// Largest picture that is rendered for a request, in pixels.
const MOST_PIXELS: u32 = 1 << 22;
/// Longest text.
const LONGEST_TEXT: usize = 300;
/// Most texts of one question that its answer must not be nearer to.
const MOST_NEGATIVES: usize = 8;

type Answer<T = Json<Value>> = Result<T, Failure>;
type App = State<Arc<Shared>>;

/// `GET /api/scene`: everything that the page needs to begin.
pub async fn scene(State(app): App) -> Answer {
    let mut value = json!({
        "name": app.name,
        "views": app.views()?,
        "trained_here": app.live.is_some(),
        "up": mean_up(&app.cameras()).to_array(),
        "limits": { "pixels": MOST_PIXELS, "text": LONGEST_TEXT, "body": LARGEST_BODY },
    });
    let more = match app.bell() {
        None => {
            let live = app.live.as_ref().ok_or_else(Failure::busy)?;
            json!({ "stage": "training", "antialias": live.antialias, "background": live.background, "objects": 0 })
        }
        Some(bell) => bell.ask(|desk| Ok(desk.about())).await?,
    };
    if let (Value::Object(all), Value::Object(more)) = (&mut value, more) {
        all.extend(more);
    }
    Ok(Json(value))
}

/// `GET /api/training`: the curves of a run; 404 where there was none.
pub async fn training(State(app): App) -> Answer<Response> {
    let live = app.live.as_ref().ok_or_else(|| Failure::new(StatusCode::NOT_FOUND, "this scene was not trained here"))?;
    Ok(Json(live.progress()).into_response())
}

/// `GET /api/splats`: the Gaussians as browsers draw them.
pub async fn splats(State(app): App) -> Answer<Response> {
    let data = match (app.bell(), &app.live) {
        (Some(bell), _) => bell.ask(|desk| Ok(desk.splats())).await?,
        (None, Some(live)) => live.splats(),
        (None, None) => return Err(Failure::busy()),
    };
    Ok(([(header::CONTENT_TYPE, "application/octet-stream")], data).into_response())
}

/// `GET /api/objects`: all objects and parts, by id.
pub async fn objects(State(app): App) -> Answer {
    app.ready()?.ask(|desk| Ok(Json(desk.objects()?))).await
}

/// `GET /api/objects/{id}/thumbnail.png`
pub async fn thumbnail(State(app): App, id: Result<Path<u16>, PathRejection>) -> Answer<Response> {
    let Path(id) = id?;
    let made = app.ready()?.ask(move |desk| Ok(desk.thumbnail(id)?)).await?;
    let data = made.ok_or_else(|| Failure::new(StatusCode::NOT_FOUND, format!("no view shows an object {id}")))?;
    Ok(([(header::CONTENT_TYPE, "image/png")], data).into_response())
}

/// `GET /api/objects/{id}/view`: where to look at it from.
pub async fn best_view(State(app): App, id: Result<Path<u16>, PathRejection>) -> Answer {
    let Path(id) = id?;
    let view = app.ready()?.ask(move |desk| Ok(desk.best_view(id)?)).await?;
    let view = view.ok_or_else(|| Failure::new(StatusCode::NOT_FOUND, format!("no view shows an object {id}")))?;
    Ok(Json(json!({ "view": view })))
}

/// What an object is called.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Naming {
    name: String,
    object: u16,
}

/// `GET /api/names`: names that were taught with the scene's encoder.
pub async fn names(State(app): App) -> Answer {
    app.ready()?.ask(|desk| Ok(Json(json!(desk.scene.taught_names()?)))).await
}

/// `POST /api/names`: teaches the name of an object; texts know it from now on.
pub async fn name(State(app): App, request: Result<Json<Naming>, JsonRejection>) -> Answer {
    let Json(naming) = request?;
    let name = checked_text(&naming.name)?.to_owned();
    let work = move |desk: &mut Desk| {
        let known = usize::from(naming.object).checked_sub(1).is_some_and(|k| k < desk.grid.objects.len());
        if !known {
            return Err(Failure::new(StatusCode::NOT_FOUND, format!("there is no object {}", naming.object)));
        }
        let learned = learn(&desk.scene, &desk.grid, &name, naming.object)?;
        desk.scene.forget_texts();
        Ok(Json(json!({ "name": learned.name, "object": learned.object, "views": learned.views, "examples": learned.examples })))
    };
    app.ready()?.ask(work).await
}

/// `GET /api/photos/{view}`: the photo as it was trained on.
pub async fn photo(State(app): App, view: Result<Path<String>, PathRejection>) -> Answer<Response> {
    let Path(view) = view?;
    let known = app.cameras().iter().find(|c| c.name == view).map(|c| app.folder.photo_path(&c.name)).filter(|p| p.is_file());
    let path = known.ok_or_else(|| Failure::new(StatusCode::NOT_FOUND, format!("the scene has no photo '{view}'")))?;
    Ok(([(header::CONTENT_TYPE, "image/png")], fastlgs_core::fs::read(&path)?).into_response())
}

/// Where a request looks from.
fn camera_of(app: &Shared, view: Option<&str>, camera: Option<Camera>, size: Option<&str>) -> Answer<Camera> {
    let mut camera = match (view, camera) {
        (Some(_), Some(_)) => return Err(Failure::bad("give a view or a camera, not both")),
        (None, Some(camera)) => camera,
        (Some(view), None) => {
            let cameras = app.cameras();
            let index = app.folder.view_index(&cameras, view).map_err(|e| Failure::bad(e.to_string()))?;
            cameras[index].clone()
        }
        (None, None) => app.cameras().first().cloned().ok_or_else(|| Failure::bad("the scene has no views"))?,
    };
    if let Some(size) = size {
        let (w, h) = parse_size(size).map_err(Failure::bad)?;
        camera = camera.resized(w, h);
    }
    camera.check().map_err(Failure::bad)?;
    if camera.width.saturating_mul(camera.height) > MOST_PIXELS {
        return Err(Failure::bad(format!(
            "{}x{} is too large: at most {} million pixels",
            camera.width,
            camera.height,
            MOST_PIXELS / 1_000_000
        )));
    }
    Ok(camera)
}

fn checked_text(text: &str) -> Answer<&str> {
    let text = text.trim();
    match text.chars().count() {
        0 => Err(Failure::bad("the text is empty")),
        n if n > LONGEST_TEXT => Err(Failure::bad(format!("the text has {n} letters; at most {LONGEST_TEXT}"))),
        _ => Ok(text),
    }
}

/// A question; one of `text`, `point` and `image`.
#[derive(Deserialize, Default)]
#[serde(deny_unknown_fields, default)]
pub struct Asked {
    text: Option<String>,
    point: Option<Pixels>,
    /// A PNG or JPEG in base64.
    image: Option<String>,
    negative: Vec<String>,
    view: Option<String>,
    camera: Option<Camera>,
    size: Option<String>,
    top_k: Option<usize>,
    false_alarms: Option<f32>,
    /// Objects that are listed with their scores.
    candidates: Option<usize>,
    /// Objects that are not looked at, as in `/api/render`.
    hidden: Vec<u16>,
    /// Objects that alone are looked at.
    only: Vec<u16>,
    /// Whether mask and heat map come with the answer, as data URLs.
    mask: bool,
    heatmap: bool,
}

/// `POST /api/query`: the fields of `fastlgs query --json`.
pub async fn query(State(app): App, request: Result<Json<Asked>, JsonRejection>) -> Answer {
    let Json(asked) = request?;
    let camera = camera_of(&app, asked.view.as_deref(), asked.camera.clone(), asked.size.as_deref())?;
    let ask = match (&asked.text, &asked.point, &asked.image) {
        (Some(text), None, None) => Ask::Text(checked_text(text)?.to_owned()),
        (None, Some(pixels), None) => match pixels.outside(&camera) {
            None => Ask::Point(pixels.clone()),
            Some((x, y)) => {
                return Err(Failure::bad(format!("the point {x},{y} lies outside the view of {}x{}", camera.width, camera.height)));
            }
        },
        (None, None, Some(data)) => {
            let data = base64::engine::general_purpose::STANDARD.decode(data).map_err(|e| Failure::bad(format!("image: {e}")))?;
            // Beside what answers others.
            let decoded = tokio::task::spawn_blocking(move || image_io::decode_rgb("image", &data)).await;
            let decoded = decoded.map_err(|e| anyhow::anyhow!("image: {e}"))?;
            Ask::Image("image".into(), decoded.map_err(|e| Failure::bad(e.to_string()))?)
        }
        _ => return Err(Failure::bad("ask for one of text, point and image")),
    };
    if asked.false_alarms.is_some_and(|share| !(share > 0.0 && share < 1.0)) {
        return Err(Failure::bad("false_alarms: a share between 0 and 1, like 0.05"));
    }
    if asked.negative.len() > MOST_NEGATIVES {
        return Err(Failure::bad(format!("at most {MOST_NEGATIVES} negatives")));
    }
    let negatives = asked.negative.iter().map(|n| checked_text(n).map(str::to_owned)).collect::<Answer<Vec<_>>>()?;
    let (want_mask, want_heat) = (asked.mask, asked.heatmap);
    let choice = Choice { hidden: asked.hidden, only: asked.only };
    let work = move |desk: &mut Desk| {
        let defaults = QueryConfig::default();
        let config = QueryConfig {
            false_alarms: asked.false_alarms.unwrap_or(defaults.false_alarms),
            top_k: asked.top_k.unwrap_or(defaults.top_k).max(1),
        };
        let candidates = asked.candidates.unwrap_or(CANDIDATES);
        let Some(render_ms) = desk.look(&camera, &choice)? else { return Err(Failure::bad("nothing would be left to look at")) };
        let question = Question { ask: &ask, negatives: &negatives, config, dilate: None, candidates };
        let (answer, mut report) = question.put(&desk.scene, &desk.grid, desk.seen()?, &camera, render_ms)?;
        let mask = (want_mask && report.found).then(|| mask_picture(&answer.mask, camera.width, camera.height));
        let relevancy = want_heat.then(|| answer.field.relevancy(&desk.grid, &answer.found.heat()));
        report.look_elsewhere(&mut desk.scene, &desk.grid)?;
        let mut value = serde_json::to_value(&report).map_err(anyhow::Error::from)?;
        if let Some(mask) = mask {
            value["mask"] = data_url(mask)?;
        }
        if let Some(relevancy) = relevancy {
            let frame = desk.scene.render(&camera)?;
            let color = image_io::from_planar(frame.channels(0, 3), frame.width, frame.height);
            value["heatmap"] = data_url(heatmap(&color, &relevancy))?;
        }
        Ok(Json(value))
    };
    app.ready()?.ask(work).await
}

fn data_url(picture: impl Into<DynamicImage>) -> Answer<Value> {
    let data = base64::engine::general_purpose::STANDARD.encode(image_io::encode_png(picture)?);
    Ok(json!(format!("data:image/png;base64,{data}")))
}

/// A picture.
#[derive(Deserialize, Default)]
#[serde(deny_unknown_fields, default)]
pub struct Wanted {
    view: Option<String>,
    camera: Option<Camera>,
    size: Option<String>,
    /// `color`, `objects`, or `heatmap`, which needs `text`.
    what: Option<String>,
    text: Option<String>,
    /// Objects that are lit up while the rest is dimmed.
    selected: Vec<u16>,
    /// Objects that are left out.
    hidden: Vec<u16>,
    /// Objects that are shown alone.
    only: Vec<u16>,
}

/// `POST /api/render`: a PNG.
pub async fn render(State(app): App, request: Result<Json<Wanted>, JsonRejection>) -> Answer<Response> {
    let Json(wanted) = request?;
    let camera = camera_of(&app, wanted.view.as_deref(), wanted.camera.clone(), wanted.size.as_deref())?;
    let what = wanted.what.as_deref().unwrap_or("color").to_owned();
    let text = wanted.text.as_deref().map(checked_text).transpose()?.map(str::to_owned);
    if !["color", "objects", "heatmap"].contains(&what.as_str()) {
        return Err(Failure::bad(format!("what: '{what}' is unknown; there are color, objects and heatmap")));
    }
    if (what == "heatmap") != text.is_some() {
        return Err(Failure::bad("a heatmap needs a text, and nothing else does"));
    }
    let choice = Choice { hidden: wanted.hidden, only: wanted.only };
    let work = move |desk: &mut Desk| {
        if !desk.choose(&choice)? {
            return Err(Failure::bad("nothing would be left to show"));
        }
        let frame = desk.scene.render(&camera)?;
        let color = image_io::from_planar(frame.channels(0, 3), frame.width, frame.height);
        let picture = if what == "objects" {
            let ids = desk.scene.field(&camera, None)?.owners(&desk.grid);
            RgbImage::from_fn(ids.width, ids.height, |x, y| Rgb(turbo::id_color(ids.at(x, y))))
        } else if let Some(text) = &text {
            let field = desk.scene.field(&camera, None)?;
            let meaning = Ask::Text(text.clone()).meaning(&desk.scene, &[])?;
            let found = meaning.find(&desk.grid, &field, &camera, &QueryConfig::default())?;
            heatmap(&color, &field.relevancy(&desk.grid, &found.heat()))
        } else if wanted.selected.is_empty() {
            color
        } else {
            let hits: Vec<query::Hit> = wanted.selected.iter().map(|id| query::Hit { id: *id, score: 1.0 }).collect();
            overlay(&color, &desk.scene.field(&camera, None)?.mask(&desk.grid, &hits))
        };
        Ok(image_io::encode_png(picture)?)
    };
    let data = app.ready()?.ask(work).await?;
    Ok(([(header::CONTENT_TYPE, "image/png")], data).into_response())
}

/// A selection as a file.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Export {
    /// Object ids separated by commas.
    objects: String,
    /// `ply`, `spz`, `sog` or `glb`.
    format: String,
    /// False: everything but these objects.
    #[serde(default = "yes")]
    keep: bool,
    /// Checked before.
    #[serde(rename = "token")]
    _token: Option<String>,
}

fn yes() -> bool {
    true
}

/// `GET /api/export`
pub async fn export(State(app): App, request: Result<Query<Export>, QueryRejection>) -> Answer<Response> {
    let Query(wanted) = request?;
    let ids: Option<Vec<u16>> = wanted.objects.split(',').map(|id| id.trim().parse().ok()).collect();
    let ids = ids.ok_or_else(|| Failure::bad("objects: give ids like 3,17"))?;
    let ending = wanted.format;
    if !selection::ENDINGS.contains(&ending.as_str()) {
        return Err(Failure::bad(format!("format: '{ending}' is unknown; there are {}", selection::ENDINGS.join(", "))));
    }
    let name = format!("{}-{}.{ending}", app.name, if wanted.keep { "selection" } else { "rest" });
    let work = move |desk: &mut Desk| {
        desk.choose(&Choice::default())?;
        let selected = selection::gaussians(&desk.scene.gaussians, &desk.grid, &ids);
        if selected.is_empty() || (!wanted.keep && selected.len() == desk.scene.gaussians.len()) {
            return Err(Failure::bad("there is nothing to write: these objects have no Gaussians, or all of them"));
        }
        let folder = tempfile::tempdir().map_err(|e| anyhow::anyhow!("no temporary folder: {e}"))?;
        let path = folder.path().join("selection").with_extension(&ending);
        let world = World::of(&desk.scene.manifest, &desk.scene.cameras);
        selection::export(&path, &desk.scene.gaussians, &world, &selected, wanted.keep)?;
        Ok(fastlgs_core::fs::read(&path)?)
    };
    let data: Vec<u8> = app.ready()?.ask(work).await?;
    let mut headers = HeaderMap::new();
    let safe: String = name.chars().map(|c| if c.is_ascii_alphanumeric() || "-_.".contains(c) { c } else { '_' }).collect();
    let disposition = format!("attachment; filename=\"{safe}\"");
    headers.insert(header::CONTENT_DISPOSITION, disposition.parse().map_err(|e| anyhow::anyhow!("{disposition}: {e}"))?);
    headers.insert(header::CONTENT_TYPE, header::HeaderValue::from_static("application/octet-stream"));
    Ok((headers, Bytes::from(data)).into_response())
}

/// `GET` of anything else.
pub async fn unknown() -> Failure {
    Failure::new(StatusCode::NOT_FOUND, "there is nothing here; /api/openapi.json lists what there is")
}

/// A known address asked in the wrong way.
pub async fn wrong_method() -> Failure {
    Failure::new(StatusCode::METHOD_NOT_ALLOWED, "this address is asked in another way; see /api/openapi.json")
}
