//! The viewer: a page in the browser and an HTTP interface to one scene, opened or still in training.

mod api;
mod desk;
mod failure;
mod guard;
mod live;
mod page;
pub mod share;
mod shared;
mod splats;
mod thumbnails;

use anyhow::{Context, Result};
use axum::extract::DefaultBodyLimit;
use axum::routing::{get, post};
use axum::{Router, middleware};
use desk::Desk;
use fastlgs::progress::{Message, Sink};
use fastlgs_core::{Camera, SceneFolder};
use glam::Vec3;
use guard::Guard;
pub use live::Live;
use shared::Shared;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::{Arc, OnceLock, PoisonError, RwLock};
use tokio::net::TcpListener;
use tokio::runtime::Runtime;

/// A running server.
pub struct Server {
    runtime: Runtime,
    shared: Arc<Shared>,
    /// Where the page is.
    pub url: String,
}

impl Server {
    /// Binds and answers from now on; on the loopback also under the names `hosts` of a proxy. With `live` the scene is still in training; without it, [`Self::open_scene`] must follow.
    pub fn start(folder: &SceneFolder, bind: SocketAddr, live: Option<Arc<Live>>, hosts: &[String]) -> Result<Self> {
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build()?;
        let listener = runtime.block_on(TcpListener::bind(bind));
        let listener = listener.with_context(|| format!("{bind} cannot be listened on; name another address with --bind"))?;
        let address = listener.local_addr()?;
        let guard = Arc::new(Guard::new(address, hosts)?);
        let url = match &guard.token {
            Some(token) => format!("http://{address}/?token={token}"),
            None => format!("http://{address}/"),
        };
        let root = folder.root.canonicalize().unwrap_or_else(|_| folder.root.clone());
        let shared = Arc::new(Shared {
            name: root.file_name().unwrap_or_default().to_string_lossy().into_owned(),
            cameras: RwLock::new(Arc::new(folder.cameras()?)),
            folder: folder.clone(),
            live,
            bell: OnceLock::new(),
            focus: OnceLock::new(),
        });
        let router = router(guard, shared.clone());
        runtime.spawn(async move {
            if let Err(error) = axum::serve(listener, router).await {
                tracing::error!("the server stopped: {error}");
            }
        });
        Ok(Self { runtime, shared, url })
    }

    /// Tells the page how far the cameras' subjects are.
    pub fn set_focus(&self, means: &[Vec3]) {
        let _ = self.shared.focus.set(self.shared.cameras().iter().map(|c| focus(means, c)).collect());
    }

    /// Opens the trained scene for questions.
    pub fn open_scene(&self, device: &str, clip_text: Option<PathBuf>) -> Result<()> {
        // Training may have moved them.
        *self.shared.cameras.write().unwrap_or_else(PoisonError::into_inner) = Arc::new(self.shared.folder.cameras()?);
        let bell = Desk::open(self.shared.folder.root.clone(), device.to_owned(), clip_text)?;
        let _ = self.shared.bell.set(bell);
        Ok(())
    }

    /// Answers until the process is told to stop (Ctrl-C or SIGTERM).
    pub fn wait(self) -> Result<()> {
        self.runtime.block_on(async {
            #[cfg(unix)]
            {
                let mut terminate = tokio::signal::unix::signal(tokio::signal::unix::SignalKind::terminate())?;
                tokio::select! {
                    pressed = tokio::signal::ctrl_c() => pressed,
                    _ = terminate.recv() => Ok(()),
                }
            }
            #[cfg(not(unix))]
            tokio::signal::ctrl_c().await
        })?;
        self.runtime.shutdown_background();
        Ok(())
    }
}

/// A server that watches a training shows it.
impl Sink for Server {
    fn tell(&self, message: Message<'_>) {
        let Some(live) = &self.shared.live else { return };
        match message {
            Message::TrainingBegins(first) => {
                self.set_focus(&first.means);
                live.picture(first);
            }
            Message::Trained { step, total, scene } if live.report(step, total) => match scene() {
                Ok(scene) => live.picture(&scene),
                Err(error) => tracing::warn!("the growing scene cannot be shown: {error}"),
            },
            Message::TrainingEnds(scene) => live.finish(scene),
            _ => {}
        }
    }
}

fn router(guard: Arc<Guard>, shared: Arc<Shared>) -> Router {
    page::routes()
        .route("/api/scene", get(api::scene))
        .route("/api/training", get(api::training))
        .route("/api/splats", get(api::splats))
        .route("/api/objects", get(api::objects))
        .route("/api/objects/{id}/thumbnail.png", get(api::thumbnail))
        .route("/api/objects/{id}/view", get(api::best_view))
        .route("/api/names", get(api::names).post(api::name))
        .route("/api/photos/{view}", get(api::photo))
        .route("/api/query", post(api::query))
        .route("/api/render", post(api::render))
        .route("/api/export", get(api::export))
        .fallback(api::unknown)
        .method_not_allowed_fallback(api::wrong_method)
        // The guard has limited bodies already.
        .layer(DefaultBodyLimit::disable())
        .layer(middleware::from_fn_with_state(guard, guard::check))
        .with_state(shared)
}

/// Distance from each camera to what it looks at: the median depth of what lies in the middle of its picture.
fn focus(means: &[Vec3], camera: &Camera) -> f32 {
    const SAMPLES: usize = 4_000;
    let middle = |m: &Vec3| {
        let p = camera.world_to_camera.transform_point3(*m);
        let pixel = camera.to_pixel(p);
        let near = |v: f32, size: u32| (v / size as f32 - 0.5).abs() < 0.2;
        (p.z > 0.0 && near(pixel.x, camera.width) && near(pixel.y, camera.height)).then_some(p.z)
    };
    let mut depths: Vec<f32> = means.iter().step_by(means.len().div_ceil(SAMPLES).max(1)).filter_map(middle).collect();
    depths.sort_by(f32::total_cmp);
    depths.get(depths.len() / 2).copied().unwrap_or(1.0)
}
