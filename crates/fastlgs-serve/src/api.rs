//! Handlers of the HTTP interface. `web/openapi.json` describes it for programs.

use crate::failure::Failure;
use crate::guard::MAX_BODY_BYTES;
use crate::scene_worker::{SceneWorker, VisibleObjects};
use crate::shared::AppState;
use axum::Json;
use axum::body::Bytes;
use axum::extract::rejection::{JsonRejection, PathRejection, QueryRejection};
use axum::extract::{Path, Query, State};
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse, Response};
use base64::Engine as _;
use fastlgs::query::pictures::{heatmap, mask_picture, overlay};
use fastlgs::query::selection::World;
use fastlgs::query::{CANDIDATES, ObjectQuery, Pixels, parse_size, selection};
use fastlgs::teach::teach_object;
use fastlgs_core::camera::mean_up;
use fastlgs_core::{Camera, image_io, turbo};
use fastlgs_grid::query::{self, QueryConfig};
use image::{DynamicImage, Rgb, RgbImage};
use serde::Deserialize;
use serde_json::{Value, json};
use std::sync::Arc;

/// Largest picture that is rendered for a request, in pixels.
const MAX_VIEW_PIXELS: u32 = 1 << 22;
/// Longest text of a query or name, in characters.
const MAX_TEXT_CHARACTERS: usize = 300;
/// Largest number of negative texts of a query.
const MOST_NEGATIVES: usize = 8;

type Answer<T = Json<Value>> = Result<T, Failure>;
type App = State<Arc<AppState>>;

/// `GET /api/scene`: describes the scene, its views and the limits of requests.
pub async fn scene(State(app): App) -> Answer {
    let mut value = json!({
        "name": app.name,
        "views": app.views()?,
        "trained_here": app.live.is_some(),
        "up": mean_up(&app.cameras()).to_array(),
        "limits": { "pixels": MAX_VIEW_PIXELS, "text": MAX_TEXT_CHARACTERS, "body": MAX_BODY_BYTES },
    });
    let more = match app.scene_handle() {
        None => {
            let live = app.live.as_ref().ok_or_else(Failure::busy)?;
            json!({ "stage": "training", "antialias": live.antialias, "background": live.background, "objects": 0 })
        }
        Some(handle) => handle.run(|worker| Ok(worker.description())).await?,
    };
    if let (Value::Object(all), Value::Object(more)) = (&mut value, more) {
        all.extend(more);
    }
    Ok(Json(value))
}

/// `GET /api/training`: returns the curves of the training run; 404 without one.
pub async fn training(State(app): App) -> Answer<Response> {
    let live = app.live.as_ref().ok_or_else(|| {
        Failure::new(
            StatusCode::NOT_FOUND,
            "this scene was not trained here, so it has no curves",
        )
    })?;
    Ok(Json(live.progress()).into_response())
}

/// `GET /api/splats`: returns the Gaussians, packed for browsers.
pub async fn splats(State(app): App) -> Answer<Response> {
    let data = match (app.scene_handle(), &app.live) {
        (Some(handle), _) => handle.run(|worker| Ok(worker.splats())).await?,
        (None, Some(live)) => live.splats(),
        (None, None) => return Err(Failure::busy()),
    };
    Ok(([(header::CONTENT_TYPE, "application/octet-stream")], data).into_response())
}

/// `GET /api/objects`: lists all objects and parts in order of their ids.
pub async fn objects(State(app): App) -> Answer {
    app.ready()?.run(|worker| Ok(Json(worker.objects()?))).await
}

/// `GET /api/objects/names`: lists the likeliest names of all objects in order of their ids.
pub async fn object_names(State(app): App) -> Answer {
    app.ready()?
        .run(|worker| Ok(Json(worker.object_names()?)))
        .await
}

/// `GET /api/objects/{id}/thumbnail.png`: returns a small picture of an object.
pub async fn thumbnail(State(app): App, id: Result<Path<u16>, PathRejection>) -> Answer<Response> {
    let Path(id) = id?;
    let made = app
        .ready()?
        .run(move |worker| Ok(worker.thumbnail(id)?))
        .await?;
    let data = made
        .ok_or_else(|| Failure::new(StatusCode::NOT_FOUND, format!("no view shows object {id}")))?;
    Ok(([(header::CONTENT_TYPE, "image/png")], data).into_response())
}

/// `GET /api/objects/{id}/view`: returns the view that shows most of an object.
pub async fn best_view(State(app): App, id: Result<Path<u16>, PathRejection>) -> Answer {
    let Path(id) = id?;
    let view = app
        .ready()?
        .run(move |worker| Ok(worker.best_view(id)?))
        .await?;
    let view = view
        .ok_or_else(|| Failure::new(StatusCode::NOT_FOUND, format!("no view shows object {id}")))?;
    Ok(Json(json!({ "view": view })))
}

/// Body of `POST /api/names`.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NameRequest {
    name: String,
    object: u16,
}

/// `GET /api/names`: lists the names that were taught with the scene's encoder.
pub async fn names(State(app): App) -> Answer {
    app.ready()?
        .run(|worker| Ok(Json(json!(worker.scene.taught_names()?))))
        .await
}

/// `POST /api/names`: teaches the name of an object. Later text queries find it.
pub async fn teach_name(
    State(app): App,
    request: Result<Json<NameRequest>, JsonRejection>,
) -> Answer {
    let Json(naming) = request?;
    let name = checked_text(&naming.name)?.to_owned();
    let work = move |worker: &mut SceneWorker| {
        let is_object = usize::from(naming.object)
            .checked_sub(1)
            .is_some_and(|k| k < worker.grid.objects.len());
        if !is_object {
            return Err(Failure::new(
                StatusCode::NOT_FOUND,
                format!("the scene has no object {}", naming.object),
            ));
        }
        let learned = teach_object(&worker.scene, &worker.grid, &name, naming.object)?;
        worker.scene.drop_texts();
        Ok(Json(
            json!({ "name": learned.name, "object": learned.object, "views": learned.views, "examples": learned.examples }),
        ))
    };
    app.ready()?.run(work).await
}

/// `GET /api/photos/{view}`: returns the prepared photo of a view.
pub async fn photo(State(app): App, view: Result<Path<String>, PathRejection>) -> Answer<Response> {
    let Path(view) = view?;
    let known = app
        .cameras()
        .iter()
        .find(|c| c.name == view)
        .map(|c| app.folder.photo_path(&c.name))
        .filter(|p| p.is_file());
    let path = known.ok_or_else(|| {
        Failure::new(
            StatusCode::NOT_FOUND,
            format!("the scene has no photo '{view}'"),
        )
    })?;
    Ok((
        [(header::CONTENT_TYPE, "image/png")],
        fastlgs_core::fs::read(&path)?,
    )
        .into_response())
}

/// Returns the camera of a request: `camera`, else that of the named view, else that of the first
/// view.
///
/// # Errors
/// Status 400 for both a view and a camera, an unknown view, an invalid camera or size, or too many
/// pixels.
fn camera_of(
    app: &AppState,
    view: Option<&str>,
    camera: Option<Camera>,
    size: Option<&str>,
) -> Answer<Camera> {
    let mut camera = match (view, camera) {
        (Some(_), Some(_)) => {
            return Err(Failure::bad_request("give a view or a camera, not both"));
        }
        (None, Some(camera)) => camera,
        (Some(view), None) => {
            let cameras = app.cameras();
            let index = app
                .folder
                .view_index(&cameras, view)
                .map_err(|e| Failure::bad_request(e.to_string()))?;
            cameras[index].clone()
        }
        (None, None) => app
            .cameras()
            .first()
            .cloned()
            .ok_or_else(|| Failure::bad_request("the scene has no views"))?,
    };
    if let Some(size) = size {
        let (w, h) = parse_size(size).map_err(Failure::bad_request)?;
        camera = camera.resized(w, h);
    }
    camera.check().map_err(Failure::bad_request)?;
    if camera.width.saturating_mul(camera.height) > MAX_VIEW_PIXELS {
        return Err(Failure::bad_request(format!(
            "{}x{} is too large: at most {} million pixels",
            camera.width,
            camera.height,
            MAX_VIEW_PIXELS / 1_000_000
        )));
    }
    Ok(camera)
}

/// Returns the text without surrounding white space.
///
/// # Errors
/// Status 400 if it is empty or too long.
fn checked_text(text: &str) -> Answer<&str> {
    let text = text.trim();
    match text.chars().count() {
        0 => Err(Failure::bad_request("the text is empty")),
        n if n > MAX_TEXT_CHARACTERS => Err(Failure::bad_request(format!(
            "the text has {n} characters; at most {MAX_TEXT_CHARACTERS} are allowed"
        ))),
        _ => Ok(text),
    }
}

/// Body of `POST /api/query`; exactly one of `text`, `point`, `image` and `object` is required.
#[derive(Deserialize, Default)]
#[serde(deny_unknown_fields, default)]
pub struct QueryBody {
    text: Option<String>,
    point: Option<Pixels>,
    /// A PNG or JPEG in base64.
    image: Option<String>,
    /// Id of an object.
    object: Option<u16>,
    negative: Vec<String>,
    view: Option<String>,
    camera: Option<Camera>,
    size: Option<String>,
    top_k: Option<usize>,
    false_alarms: Option<f32>,
    /// Number of objects to list with their scores.
    candidates: Option<usize>,
    /// Ids of objects to leave out, as in `/api/render`.
    hidden: Vec<u16>,
    /// Ids of the only objects to show; all if empty.
    only: Vec<u16>,
    /// Whether to return the mask and the heat map, as data URLs.
    mask: bool,
    heatmap: bool,
}

/// `POST /api/query`: answers a query with the fields of `fastlgs query --json`.
pub async fn query(State(app): App, request: Result<Json<QueryBody>, JsonRejection>) -> Answer {
    let Json(body) = request?;
    let camera = camera_of(
        &app,
        body.view.as_deref(),
        body.camera.clone(),
        body.size.as_deref(),
    )?;
    let object_query = object_query(&body, &camera).await?;
    if body
        .false_alarms
        .is_some_and(|share| !(share > 0.0 && share < 1.0))
    {
        return Err(Failure::bad_request(
            "false_alarms: give a number between 0 and 1, such as 0.05",
        ));
    }
    if body.negative.len() > MOST_NEGATIVES {
        return Err(Failure::bad_request(format!(
            "negative: at most {MOST_NEGATIVES} texts are allowed"
        )));
    }
    let negatives = body
        .negative
        .iter()
        .map(|n| checked_text(n).map(str::to_owned))
        .collect::<Answer<Vec<_>>>()?;
    let work = move |worker: &mut SceneWorker| {
        answer(worker, object_query, &camera, &negatives, &body).map(Json)
    };
    app.ready()?.run(work).await
}

/// Returns what a request asks for.
async fn object_query(body: &QueryBody, camera: &Camera) -> Answer<ObjectQuery> {
    match (&body.text, &body.point, &body.image, body.object) {
        (None, None, None, Some(id)) => Ok(ObjectQuery::Object(id)),
        (Some(text), None, None, None) => Ok(ObjectQuery::Text(checked_text(text)?.to_owned())),
        (None, Some(pixels), None, None) => match pixels.outside(camera) {
            None => Ok(ObjectQuery::Point(pixels.clone())),
            Some((x, y)) => Err(Failure::bad_request(format!(
                "the point {x},{y} lies outside the view of {}x{}",
                camera.width, camera.height
            ))),
        },
        (None, None, Some(data), None) => {
            let data = base64::engine::general_purpose::STANDARD
                .decode(data)
                .map_err(|e| Failure::bad_request(format!("image: {e}")))?;
            // Decoded on a blocking thread, so that other requests are not delayed.
            let decoded =
                tokio::task::spawn_blocking(move || image_io::decode_rgb("image", &data)).await;
            let decoded = decoded.map_err(|e| anyhow::anyhow!("image: {e}"))?;
            let picture = decoded.map_err(|e| Failure::bad_request(e.to_string()))?;
            Ok(ObjectQuery::Image("image".into(), picture))
        }
        _ => Err(Failure::bad_request(
            "give exactly one of text, point, image and object",
        )),
    }
}

/// Answers a query on the scene worker, with the pictures that the request asks for.
fn answer(
    worker: &mut SceneWorker,
    object_query: ObjectQuery,
    camera: &Camera,
    negatives: &[String],
    body: &QueryBody,
) -> Answer<Value> {
    let choice = VisibleObjects {
        hidden: body.hidden.clone(),
        only: body.only.clone(),
    };
    if !worker.set_visible(&choice)? {
        return Err(Failure::bad_request(
            "nothing would be left to query; hide fewer objects",
        ));
    }
    let defaults = QueryConfig::default();
    let answer = worker
        .scene
        .query(object_query)
        .camera(camera)
        .negatives(negatives)
        .false_alarms(body.false_alarms.unwrap_or(defaults.false_alarms))
        .top_k(body.top_k.unwrap_or(defaults.top_k).max(1))
        .candidates(body.candidates.unwrap_or(CANDIDATES))
        .run()?;
    let mut value = serde_json::to_value(&answer.report).map_err(anyhow::Error::from)?;
    if body.mask && answer.report.found {
        value["mask"] = data_url(mask_picture(&answer.mask, camera.width, camera.height))?;
    }
    if body.heatmap {
        let relevancy = answer.relevancy();
        let frame = worker.scene.render(camera)?;
        let color = image_io::from_planar(frame.color(), frame.width, frame.height);
        value["heatmap"] = data_url(heatmap(&color, &relevancy))?;
    }
    Ok(value)
}

fn data_url(picture: impl Into<DynamicImage>) -> Answer<Value> {
    let data = base64::engine::general_purpose::STANDARD.encode(image_io::encode_png(picture)?);
    Ok(json!(format!("data:image/png;base64,{data}")))
}

/// Body of `POST /api/render`.
#[derive(Deserialize, Default)]
#[serde(deny_unknown_fields, default)]
pub struct RenderRequest {
    view: Option<String>,
    camera: Option<Camera>,
    size: Option<String>,
    /// `color`, `objects`, or `heatmap`, which needs `text`.
    what: Option<String>,
    text: Option<String>,
    /// Ids of objects to highlight; the rest is dimmed.
    selected: Vec<u16>,
    /// Ids of objects to leave out.
    hidden: Vec<u16>,
    /// Ids of the only objects to show; all if empty.
    only: Vec<u16>,
}

/// `POST /api/render`: renders a view as PNG.
pub async fn render(
    State(app): App,
    request: Result<Json<RenderRequest>, JsonRejection>,
) -> Answer<Response> {
    let Json(wanted) = request?;
    let camera = camera_of(
        &app,
        wanted.view.as_deref(),
        wanted.camera.clone(),
        wanted.size.as_deref(),
    )?;
    let what = wanted.what.as_deref().unwrap_or("color").to_owned();
    let text = wanted
        .text
        .as_deref()
        .map(checked_text)
        .transpose()?
        .map(str::to_owned);
    if !["color", "objects", "heatmap"].contains(&what.as_str()) {
        return Err(Failure::bad_request(format!(
            "what: '{what}' is unknown; use color, objects or heatmap"
        )));
    }
    if (what == "heatmap") != text.is_some() {
        return Err(Failure::bad_request(
            "text: required for a heatmap, and allowed only there",
        ));
    }
    let choice = VisibleObjects {
        hidden: wanted.hidden,
        only: wanted.only,
    };
    let work = move |worker: &mut SceneWorker| {
        if !worker.set_visible(&choice)? {
            return Err(Failure::bad_request(
                "nothing would be left to show; hide fewer objects",
            ));
        }
        let picture = if what == "objects" {
            object_picture(worker, &camera)?
        } else if let Some(text) = &text {
            text_heatmap(worker, &camera, text)?
        } else {
            color_picture(worker, &camera, &wanted.selected)?
        };
        Ok(image_io::encode_png(picture)?)
    };
    let data = app.ready()?.run(work).await?;
    Ok(([(header::CONTENT_TYPE, "image/png")], data).into_response())
}

/// Renders a view with a colour for each object.
fn object_picture(worker: &mut SceneWorker, camera: &Camera) -> Answer<RgbImage> {
    let ids = worker.scene.field(camera, None)?.owners(&worker.grid);
    let color = |x, y| Rgb(turbo::id_color(ids.at(x, y)));
    Ok(RgbImage::from_fn(ids.width, ids.height, color))
}

/// Renders a view with the heat map of a text.
fn text_heatmap(worker: &mut SceneWorker, camera: &Camera, text: &str) -> Answer<RgbImage> {
    let color = color_picture(worker, camera, &[])?;
    let field = worker.scene.field(camera, None)?;
    let query = ObjectQuery::Text(text.to_owned()).embed(&worker.scene, &[])?;
    let found = query.find(&worker.grid, &field, camera, &QueryConfig::default())?;
    Ok(heatmap(
        &color,
        &field.relevancy(&worker.grid, &found.heat()),
    ))
}

/// Renders a view. If objects are selected, everything else is dimmed.
fn color_picture(worker: &mut SceneWorker, camera: &Camera, selected: &[u16]) -> Answer<RgbImage> {
    let frame = worker.scene.render(camera)?;
    let color = image_io::from_planar(frame.color(), frame.width, frame.height);
    if selected.is_empty() {
        return Ok(color);
    }
    let hit = |id: &u16| query::Hit {
        id: *id,
        score: 1.0,
    };
    let hits: Vec<query::Hit> = selected.iter().map(hit).collect();
    let field = worker.scene.field(camera, None)?;
    Ok(overlay(&color, &field.mask(&worker.grid, &hits)))
}

/// Query string of `GET /api/export`.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Export {
    /// Object ids separated by commas.
    objects: String,
    /// `ply`, `spz`, `sog` or `glb`.
    format: String,
    /// Whether to write these objects, or all others.
    #[serde(default = "yes")]
    keep: bool,
    /// Checked by the guard; listed here because unknown fields are rejected.
    #[serde(rename = "token")]
    _token: Option<String>,
}

fn yes() -> bool {
    true
}

/// `GET /api/export`: returns the Gaussians of objects, or all others, as a file.
pub async fn export(
    State(app): App,
    request: Result<Query<Export>, QueryRejection>,
) -> Answer<Response> {
    let Query(wanted) = request?;
    let ids: Option<Vec<u16>> = wanted
        .objects
        .split(',')
        .map(|id| id.trim().parse().ok())
        .collect();
    let ids = ids.ok_or_else(|| Failure::bad_request("objects: give ids like 3,17"))?;
    let ending = wanted.format;
    if !selection::EXTENSIONS.contains(&ending.as_str()) {
        return Err(Failure::bad_request(format!(
            "format: '{ending}' is unknown; use one of {}",
            selection::EXTENSIONS.join(", ")
        )));
    }
    let name = format!(
        "{}-{}.{ending}",
        app.name,
        if wanted.keep { "selection" } else { "rest" }
    );
    let work = move |worker: &mut SceneWorker| {
        worker.set_visible(&VisibleObjects::default())?;
        let all = worker.scene.gaussians();
        let selected = selection::gaussians(all, &worker.grid, &ids);
        if selected.is_empty() || (!wanted.keep && selected.len() == all.len()) {
            return Err(Failure::bad_request(
                "there is nothing to write: the selection has no Gaussians",
            ));
        }
        let folder = tempfile::tempdir()
            .map_err(|e| anyhow::anyhow!("cannot create a temporary folder: {e}"))?;
        let path = folder.path().join("selection").with_extension(&ending);
        let world = World::of(worker.scene.manifest(), worker.scene.cameras());
        selection::export(&path, all, &world, &selected, wanted.keep)?;
        Ok(fastlgs_core::fs::read(&path)?)
    };
    let data: Vec<u8> = app.ready()?.run(work).await?;
    let mut headers = HeaderMap::new();
    let is_plain = |c: char| c.is_ascii_alphanumeric() || "-_.".contains(c);
    let plain = name.chars().map(|c| if is_plain(c) { c } else { '_' });
    let file_name: String = plain.collect();
    let disposition = format!("attachment; filename=\"{file_name}\"");
    headers.insert(
        header::CONTENT_DISPOSITION,
        disposition
            .parse()
            .map_err(|e| anyhow::anyhow!("{disposition}: {e}"))?,
    );
    headers.insert(
        header::CONTENT_TYPE,
        header::HeaderValue::from_static("application/octet-stream"),
    );
    Ok((headers, Bytes::from(data)).into_response())
}

/// Answers requests for unknown addresses with status 404.
pub async fn unknown() -> Failure {
    Failure::new(
        StatusCode::NOT_FOUND,
        "unknown address; /api/openapi.json lists all addresses",
    )
}

/// Answers requests with a wrong method with status 405.
pub async fn wrong_method() -> Failure {
    Failure::new(
        StatusCode::METHOD_NOT_ALLOWED,
        "this address does not support this method; see /api/openapi.json",
    )
}
