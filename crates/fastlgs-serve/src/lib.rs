//! The viewer: a page in the browser and an HTTP interface to one scene, which is opened or in
//! training.

mod api;
mod failure;
mod guard;
mod live;
mod page;
mod scene_worker;
pub mod share;
mod shared;
mod splats;

use anyhow::{Context, Result};
use axum::extract::DefaultBodyLimit;
use axum::routing::{get, post};
use axum::{Router, middleware};
use fastlgs::progress::{Message, Sink};
use fastlgs_core::{Camera, SceneFolder};
use glam::Vec3;
use guard::Guard;
pub use live::Live;
use scene_worker::SceneWorker;
use shared::AppState;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::{Arc, OnceLock, PoisonError, RwLock};
use tokio::net::TcpListener;
use tokio::runtime::Runtime;

/// A running server.
pub struct Server {
    runtime: Runtime,
    shared: Arc<AppState>,
    /// Address of the page, with the token if there is one.
    pub url: String,
}

impl Server {
    /// Starts a server at the address `bind`.
    ///
    /// With `live`, the scene is still in training; without it, [`Self::open_scene`] must follow.
    /// `hosts` are further host names that a server on a loopback address accepts.
    ///
    /// # Errors
    /// The address cannot be used, or the cameras cannot be read.
    pub fn start(
        folder: &SceneFolder,
        bind: SocketAddr,
        live: Option<Arc<Live>>,
        hosts: &[String],
    ) -> Result<Self> {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(2)
            .enable_all()
            .build()?;
        let listener = runtime.block_on(TcpListener::bind(bind));
        let listener = listener
            .with_context(|| format!("cannot listen on {bind}; choose another address or port"))?;
        let address = listener.local_addr()?;
        let guard = Arc::new(Guard::new(address, hosts)?);
        let url = match &guard.token {
            Some(token) => format!("http://{address}/?token={token}"),
            None => format!("http://{address}/"),
        };
        let root = folder
            .root
            .canonicalize()
            .unwrap_or_else(|_| folder.root.clone());
        let shared = Arc::new(AppState {
            name: root
                .file_name()
                .unwrap_or_default()
                .to_string_lossy()
                .into_owned(),
            cameras: RwLock::new(Arc::new(folder.cameras()?)),
            folder: folder.clone(),
            live,
            scene_handle: OnceLock::new(),
            focus: OnceLock::new(),
        });
        let router = router(guard, shared.clone());
        runtime.spawn(async move {
            if let Err(error) = axum::serve(listener, router).await {
                tracing::error!("the server stopped: {error}");
            }
        });
        Ok(Self {
            runtime,
            shared,
            url,
        })
    }

    /// Sets the distance from each camera to its subject, for the page. `means` are those of the
    /// Gaussians.
    pub fn set_focus(&self, means: &[Vec3]) {
        let _ = self.shared.focus.set(
            self.shared
                .cameras()
                .iter()
                .map(|c| subject_distance(means, c))
                .collect(),
        );
    }

    /// Opens the trained scene for queries.
    ///
    /// # Errors
    /// The scene cannot be read, or the device fails.
    pub fn open_scene(&self, device: &str, clip_text: Option<PathBuf>) -> Result<()> {
        // Training may have moved the cameras.
        *self
            .shared
            .cameras
            .write()
            .unwrap_or_else(PoisonError::into_inner) = Arc::new(self.shared.folder.cameras()?);
        let scene_handle = SceneWorker::open(
            self.shared.folder.root.clone(),
            device.to_owned(),
            clip_text,
        )?;
        let _ = self.shared.scene_handle.set(scene_handle);
        Ok(())
    }

    /// Serves until Ctrl-C or SIGTERM.
    pub fn wait(self) -> Result<()> {
        self.runtime.block_on(async {
            #[cfg(unix)]
            {
                let mut terminate =
                    tokio::signal::unix::signal(tokio::signal::unix::SignalKind::terminate())?;
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

/// Shows a running training on the page.
impl Sink for Server {
    fn on_message(&self, message: Message<'_>) {
        let Some(live) = &self.shared.live else {
            return;
        };
        match message {
            Message::TrainingBegins(first) => {
                self.set_focus(&first.means);
                live.set_snapshot(first);
            }
            Message::Trained { step, total, scene } if live.report(step, total) => match scene() {
                Ok(scene) => live.set_snapshot(&scene),
                Err(error) => tracing::warn!("cannot show the scene during training: {error}"),
            },
            Message::TrainingEnds(scene) => live.finish(scene),
            _ => {}
        }
    }
}

fn router(guard: Arc<Guard>, shared: Arc<AppState>) -> Router {
    page::routes()
        .route("/api/scene", get(api::scene))
        .route("/api/training", get(api::training))
        .route("/api/splats", get(api::splats))
        .route("/api/objects", get(api::objects))
        .route("/api/objects/names", get(api::object_names))
        .route("/api/objects/{id}/thumbnail.png", get(api::thumbnail))
        .route("/api/objects/{id}/view", get(api::best_view))
        .route("/api/names", get(api::names).post(api::teach_name))
        .route("/api/photos/{view}", get(api::photo))
        .route("/api/query", post(api::query))
        .route("/api/render", post(api::render))
        .route("/api/export", get(api::export))
        .fallback(api::unknown)
        .method_not_allowed_fallback(api::wrong_method)
        // The guard limits bodies.
        .layer(DefaultBodyLimit::disable())
        .layer(middleware::from_fn_with_state(guard, guard::check))
        .with_state(shared)
}

/// Returns the distance from a camera to its subject: the median depth of the Gaussians in the
/// central 40 % of the image along each axis. Returns 1 if there are none.
fn subject_distance(means: &[Vec3], camera: &Camera) -> f32 {
    const SAMPLES: usize = 4_000;
    let middle = |m: &Vec3| {
        let p = camera.world_to_camera.transform_point3(*m);
        let pixel = camera.to_pixel(p);
        let near = |v: f32, size: u32| (v / size as f32 - 0.5).abs() < 0.2;
        (p.z > 0.0 && near(pixel.x, camera.width) && near(pixel.y, camera.height)).then_some(p.z)
    };
    let samples = means.iter().step_by(means.len().div_ceil(SAMPLES).max(1));
    fastlgs_core::stats::median(samples.filter_map(middle)).unwrap_or(1.0)
}
