//! The files of the page, which are embedded in the binary.

use crate::shared::AppState;
use axum::Router;
use axum::http::header;
use axum::routing::get;
use std::sync::Arc;

/// Address, content type, and content of each file.
const FILES: [(&str, &str, &str); 24] = [
    ("/", HTML, include_str!("../web/index.html")),
    (
        "/style.css",
        "text/css; charset=utf-8",
        include_str!("../web/style.css"),
    ),
    ("/app.js", SCRIPT, include_str!("../web/app.js")),
    ("/stage.js", SCRIPT, include_str!("../web/stage.js")),
    ("/objects.js", SCRIPT, include_str!("../web/objects.js")),
    ("/training.js", SCRIPT, include_str!("../web/training.js")),
    ("/server.js", SCRIPT, include_str!("../web/server.js")),
    ("/link.js", SCRIPT, include_str!("../web/link.js")),
    ("/measure.js", SCRIPT, include_str!("../web/measure.js")),
    ("/recent.js", SCRIPT, include_str!("../web/recent.js")),
    ("/sentence.js", SCRIPT, include_str!("../web/sentence.js")),
    ("/save.js", SCRIPT, include_str!("../web/save.js")),
    ("/camera.js", SCRIPT, include_str!("../web/camera.js")),
    ("/frame.js", SCRIPT, include_str!("../web/frame.js")),
    ("/renderer.js", SCRIPT, include_str!("../web/renderer.js")),
    ("/webgpu.js", SCRIPT, include_str!("../web/webgpu.js")),
    ("/webgl2.js", SCRIPT, include_str!("../web/webgl2.js")),
    ("/pictures.js", SCRIPT, include_str!("../web/pictures.js")),
    ("/sorter.js", SCRIPT, include_str!("../web/sorter.js")),
    (
        "/splat.wgsl",
        TEXT,
        include_str!(concat!(env!("OUT_DIR"), "/splat.wgsl")),
    ),
    ("/present.wgsl", TEXT, include_str!("../web/present.wgsl")),
    (
        "/corner.glsl",
        TEXT,
        include_str!(concat!(env!("OUT_DIR"), "/corner.glsl")),
    ),
    (
        "/pixel.glsl",
        TEXT,
        include_str!(concat!(env!("OUT_DIR"), "/pixel.glsl")),
    ),
    (
        "/api/openapi.json",
        "application/json",
        include_str!("../web/openapi.json"),
    ),
];

const HTML: &str = "text/html; charset=utf-8";
const SCRIPT: &str = "text/javascript; charset=utf-8";
const TEXT: &str = "text/plain; charset=utf-8";

/// Returns names and contents of the files of a static folder. In it, `files.js` takes the place of
/// `server.js`.
pub fn files() -> impl Iterator<Item = (&'static str, &'static str)> {
    let static_file = |(address, _, content): (&'static str, &str, &'static str)| match address {
        "/" => Some(("index.html", content)),
        "/server.js" => Some(("server.js", include_str!("../web/files.js"))),
        _ => address
            .strip_prefix('/')
            .filter(|name| !name.contains('/'))
            .map(|name| (name, content)),
    };
    FILES.into_iter().filter_map(static_file)
}

/// Returns a router with one route per file.
pub fn routes() -> Router<Arc<AppState>> {
    FILES
        .into_iter()
        .fold(Router::new(), |router, (address, kind, content)| {
            router.route(
                address,
                get(move || async move { ([(header::CONTENT_TYPE, kind)], content) }),
            )
        })
}
