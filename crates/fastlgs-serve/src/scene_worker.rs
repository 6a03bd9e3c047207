//! The scene worker: a thread that owns the opened scene and runs the work of all requests.

use crate::failure::Failure;
use crate::splats;
use anyhow::{Result, anyhow};
use axum::body::Bytes;
use axum::http::StatusCode;
use fastlgs::Scene;
use fastlgs::listing::likeliest_names;
use fastlgs::query::selection;
use fastlgs::visibility::Visibility;
use fastlgs_core::{Gaussians, WorldFrame, image_io, turbo};
use fastlgs_grid::Grid;
use fastlgs_grid::grid::Object;
use fastlgs_grid::query::{self, QueryConfig};
use image::RgbImage;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use tokio::sync::{mpsc, oneshot};

/// Largest number of names of an object.
const MOST_NAMES: usize = 3;
/// Largest number of waiting requests; further ones get status 503.
const MAX_WAITING: usize = 32;

/// The opened scene, and the state that is kept between requests.
pub struct SceneWorker {
    /// The scene.
    pub scene: Scene,
    /// Object table of the scene.
    pub grid: Arc<Grid>,
    /// Which views show which objects, with nothing hidden; after the first request that needs it.
    visibility: Option<Visibility>,
    /// Visible objects, whose Gaussians are on the device. `all` has all Gaussians while some are
    /// hidden.
    visible: VisibleObjects,
    all: Option<Gaussians>,
    /// Gaussians packed for browsers, after the first request for them.
    splats: Option<Bytes>,
}

/// Visible objects; each includes its parts.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct VisibleObjects {
    /// Ids of objects to leave out.
    pub hidden: Vec<u16>,
    /// Ids of the only objects to show; all if empty.
    pub only: Vec<u16>,
}

type Work = Box<dyn FnOnce(&mut SceneWorker) + Send>;

/// Handle of the scene worker, to which requests send their work.
#[derive(Clone)]
pub struct SceneHandle(mpsc::Sender<Work>);

impl SceneWorker {
    /// Opens a scene on a device. `clip_text` replaces the CLIP text tower that the scene names.
    pub fn new(root: &Path, device: &str, clip_text: Option<PathBuf>) -> Result<Self> {
        let mut scene = Scene::open(root, device)?;
        scene.set_clip_text(clip_text);
        let grid = scene.grid()?;
        Ok(Self {
            scene,
            grid,
            visibility: None,
            visible: VisibleObjects::default(),
            all: None,
            splats: None,
        })
    }

    /// Opens a scene on a new thread. Returns when it can answer queries.
    pub fn open(root: PathBuf, device: String, clip_text: Option<PathBuf>) -> Result<SceneHandle> {
        let (sender, mut work) = mpsc::channel::<Work>(MAX_WAITING);
        let (open_result, wait) = std::sync::mpsc::channel();
        std::thread::Builder::new()
            .name("scene".into())
            .spawn(move || {
                let open = || -> Result<Self> {
                    let mut worker = Self::new(&root, &device, clip_text)?;
                    worker.scene.warm_up()?;
                    // Loads the text encoder before the first query. Without it, the page still
                    // shows the scene.
                    if let Err(error) = worker.scene.text_query("warm up") {
                        tracing::warn!("text queries are not available: {error:#}");
                    }
                    Ok(worker)
                };
                match open() {
                    Ok(mut worker) => {
                        let _ = open_result.send(Ok(()));
                        while let Some(work) = work.blocking_recv() {
                            work(&mut worker);
                        }
                    }
                    Err(error) => {
                        let _ = open_result.send(Err(error));
                    }
                }
            })?;
        wait.recv()
            .map_err(|_| anyhow!("the scene worker stopped before the scene was opened"))??;
        Ok(SceneHandle(sender))
    }

    /// Sets the visible objects of later renderings.
    ///
    /// Returns `false` and changes nothing if no Gaussian would be visible.
    pub fn set_visible(&mut self, choice: &VisibleObjects) -> Result<bool> {
        if self.visible == *choice {
            return Ok(true);
        }
        let all = &*self
            .all
            .get_or_insert_with(|| self.scene.gaussians().clone());
        if *choice == VisibleObjects::default() {
            self.scene.set_gaussians(all.clone())?;
            self.all = None;
        } else {
            let (hidden, only) = (
                self.grid.members(&choice.hidden),
                self.grid.members(&choice.only),
            );
            let among = |members: &[bool], i: usize| {
                members.get(usize::from(all.object_ids[i])) == Some(&true)
            };
            let shown =
                |i: &usize| !among(&hidden, *i) && (choice.only.is_empty() || among(&only, *i));
            let visible: Vec<usize> = (0..all.len()).filter(shown).collect();
            if visible.is_empty() {
                return Ok(false);
            }
            self.scene.set_gaussians(all.select(&visible))?;
        }
        self.visible = choice.clone();
        Ok(true)
    }

    /// Describes the opened scene for the page.
    pub fn description(&self) -> Value {
        json!({
            "stage": "ready",
            "antialias": self.scene.trained().antialias,
            "background": self.scene.trained().background,
            "objects": self.grid.objects.len(),
            "overlaps": self.grid.overlaps.0,
            "gaussians": self.gaussians(),
            "min_score": QueryConfig::default().min_score(self.scene.rule()),
            "support_share": query::SUPPORT_SHARE,
            "segmenter": self.scene.manifest().segmenter,
            "encoder": self.scene.manifest().encoder,
            "adapter": self.scene.adapter(),
            // This interface uses scene coordinates: world = origin + scale x scene.
            "frame": self.scene.manifest().frame,
        })
    }

    /// Lists all objects and parts in order of their ids.
    pub fn objects(&mut self) -> Result<Value> {
        self.set_visible(&VisibleObjects::default())?;
        let own = selection::gaussians_by_object(self.scene.gaussians(), &self.grid);
        let shares = self.grid.shares();
        let row = |o: &Object| {
            let own = &own[usize::from(o.id) - 1];
            json!({
                "id": o.id,
                "parent": o.parent,
                "support": o.support,
                "share": shares[usize::from(o.id) - 1],
                "views": o.views,
                "gaussians": own.len(),
                "bbox3d": selection::robust_box(self.scene.gaussians(), &WorldFrame::default(), own),
                "color": turbo::id_color(o.id),
            })
        };
        Ok(Value::Array(self.grid.objects.iter().map(row).collect()))
    }

    /// Lists the likeliest names of each object, in order of id.
    pub fn object_names(&self) -> Result<Value> {
        Ok(json!(likeliest_names(&self.scene, &self.grid, MOST_NAMES)?))
    }

    /// Returns which views show which objects, and the scene with nothing hidden.
    fn visibility(&mut self) -> Result<(&mut Visibility, &mut Scene)> {
        self.set_visible(&VisibleObjects::default())?;
        let visibility = match self.visibility.take() {
            Some(known) => known,
            None => Visibility::of(&mut self.scene, &self.grid)?,
        };
        Ok((self.visibility.insert(visibility), &mut self.scene))
    }

    /// Returns the picture of an object, or `None` if no view shows it.
    pub fn picture(&mut self, id: u16) -> Result<Option<RgbImage>> {
        let (visibility, scene) = self.visibility()?;
        Ok(visibility.thumbnail(scene, id)?)
    }

    /// Returns the picture of an object as PNG, or `None` if no view shows it.
    pub fn thumbnail(&mut self, id: u16) -> Result<Option<Vec<u8>>> {
        let picture = self.picture(id)?;
        Ok(picture.map(image_io::encode_png).transpose()?)
    }

    /// Returns the name of the view that shows most of an object, or `None` if no view does.
    pub fn best_view(&mut self, id: u16) -> Result<Option<String>> {
        let (visibility, scene) = self.visibility()?;
        let best = visibility.best_view(&[id]);
        Ok(best.map(|view| scene.cameras()[view].name.clone()))
    }

    /// Returns the number of Gaussians, including hidden ones.
    pub fn gaussians(&self) -> usize {
        self.all.as_ref().unwrap_or(self.scene.gaussians()).len()
    }

    /// Returns all Gaussians, packed for browsers.
    pub fn splats(&mut self) -> Bytes {
        let all = self.all.as_ref().unwrap_or(self.scene.gaussians());
        self.splats
            .get_or_insert_with(|| Bytes::from(splats::pack(all)))
            .clone()
    }
}

impl SceneHandle {
    /// Sends work to the scene worker and waits for its result. Work of a cancelled request is not
    /// started.
    ///
    /// # Errors
    /// Errors of `work`, status 500 if it panics, and 503 if too many requests are waiting.
    pub async fn run<T: Send + 'static>(
        &self,
        work: impl FnOnce(&mut SceneWorker) -> Result<T, Failure> + Send + 'static,
    ) -> Result<T, Failure> {
        let (reply, answer) = oneshot::channel();
        let work: Work = Box::new(move |worker| {
            if !reply.is_closed() {
                // A panic fails this request, not the server.
                let done = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| work(worker)));
                let failed = || {
                    Failure::new(
                        StatusCode::INTERNAL_SERVER_ERROR,
                        "internal error; see the log of the server",
                    )
                };
                let _ = reply.send(done.unwrap_or_else(|_| Err(failed())));
            }
        });
        self.0.try_send(work).map_err(|_| Failure::busy())?;
        answer.await.map_err(|_| Failure::busy())?
    }
}
