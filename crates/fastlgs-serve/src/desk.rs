//! The one thread that holds the opened scene. Requests leave their work on its desk and wait.

use crate::failure::Failure;
use crate::splats;
use crate::thumbnails::Thumbnails;
use anyhow::{Context, Result, anyhow};
use axum::body::Bytes;
use axum::http::StatusCode;
use fastlgs::Session;
use fastlgs::session::selection;
use fastlgs_core::{Camera, Gaussians, WorldFrame, turbo};
use fastlgs_grid::Grid;
use fastlgs_grid::field::Field;
use fastlgs_grid::grid::Object;
use fastlgs_grid::query::{self, QueryConfig};
use image::RgbImage;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::time::Instant;
use tokio::sync::{mpsc, oneshot};

/// Pieces of work that may wait; who comes later is told to come back.
const WAITING: usize = 32;

/// The opened scene with what is kept between requests.
pub struct Desk {
    /// The scene.
    pub scene: Session,
    /// Its objects.
    pub grid: Grid,
    /// Pictures of the objects.
    thumbnails: Thumbnails,
    /// The view that was last looked at, and what was shown there, with what it tells about objects.
    seen: Option<(Camera, Choice, Field)>,
    /// Which Gaussians are on the device, and all of them while these are not.
    choice: Choice,
    all: Option<Gaussians>,
    /// What browsers draw, once one has asked for it.
    splats: Option<Bytes>,
}

/// Which objects pictures show; each with all that lies in it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Choice {
    /// Objects that are left out.
    pub hidden: Vec<u16>,
    /// Objects that are shown alone; all where there are none.
    pub only: Vec<u16>,
}

type Work = Box<dyn FnOnce(&mut Desk) + Send>;

/// Where work is left.
#[derive(Clone)]
pub struct Bell(mpsc::Sender<Work>);

impl Desk {
    /// Opens a scene.
    pub fn new(root: &Path, device: &str, clip_text: Option<PathBuf>) -> Result<Self> {
        let mut scene = Session::open(root, device)?;
        scene.clip_text = clip_text;
        let grid = scene.grid()?;
        Ok(Self { scene, grid, thumbnails: Thumbnails::default(), seen: None, choice: Choice::default(), all: None, splats: None })
    }

    /// Opens a scene on a thread of its own; returns once it can be asked.
    pub fn open(root: PathBuf, device: String, clip_text: Option<PathBuf>) -> Result<Bell> {
        let (bell, mut work) = mpsc::channel::<Work>(WAITING);
        let (opened, wait) = std::sync::mpsc::channel();
        std::thread::Builder::new().name("scene".into()).spawn(move || {
            let open = || -> Result<Self> {
                let mut desk = Self::new(&root, &device, clip_text)?;
                desk.scene.warm_up()?;
                // The first question should not wait for the encoder. Without it the page still shows the scene.
                if let Err(error) = desk.scene.text_query("warm up") {
                    tracing::warn!("texts cannot be asked for: {error:#}");
                }
                Ok(desk)
            };
            match open() {
                Ok(mut desk) => {
                    let _ = opened.send(Ok(()));
                    while let Some(work) = work.blocking_recv() {
                        work(&mut desk);
                    }
                }
                Err(error) => {
                    let _ = opened.send(Err(error));
                }
            }
        })?;
        wait.recv().map_err(|_| anyhow!("the scene's thread ended before it was opened"))??;
        Ok(Bell(bell))
    }

    /// What a view tells about some objects, rendered unless it is the last one; with the milliseconds it took. `None`, and all stays as it
    /// was, where nothing would be left to look at.
    pub fn look(&mut self, camera: &Camera, choice: &Choice) -> Result<Option<f64>> {
        if !self.choose(choice)? {
            return Ok(None);
        }
        if self.seen.as_ref().is_some_and(|(seen, shown, _)| (seen, shown) == (camera, choice)) {
            return Ok(Some(0.0));
        }
        let started = Instant::now();
        let field = self.scene.field(camera, None)?;
        self.seen = Some((camera.clone(), choice.clone(), field));
        Ok(Some(started.elapsed().as_secs_f64() * 1e3))
    }

    /// What [`Self::look`] last saw.
    pub fn seen(&self) -> Result<&Field> {
        self.seen.as_ref().map(|seen| &seen.2).context("no view was looked at")
    }

    /// Shows some objects in the pictures that follow; `false`, and all stays as it was, where nothing would be left to show.
    pub fn choose(&mut self, choice: &Choice) -> Result<bool> {
        if self.choice == *choice {
            return Ok(true);
        }
        let all = &*self.all.get_or_insert_with(|| self.scene.gaussians.clone());
        if *choice == Choice::default() {
            self.scene.show(all.clone())?;
            self.all = None;
        } else {
            let (hidden, only) = (self.grid.members(&choice.hidden), self.grid.members(&choice.only));
            let among = |members: &[bool], i: usize| members.get(usize::from(all.object_ids[i])) == Some(&true);
            let shown = |i: &usize| !among(&hidden, *i) && (choice.only.is_empty() || among(&only, *i));
            let places: Vec<usize> = (0..all.len()).filter(shown).collect();
            if places.is_empty() {
                return Ok(false);
            }
            self.scene.show(all.select(&places))?;
        }
        self.choice = choice.clone();
        Ok(true)
    }

    /// What the page needs to know of a scene that can be asked.
    pub fn about(&self) -> Value {
        json!({
            "stage": "ready",
            "antialias": self.scene.trained.antialias,
            "background": self.scene.trained.background,
            "objects": self.grid.objects.len(),
            "overlaps": self.grid.overlaps.0,
            "gaussians": self.gaussians(),
            "min_score": QueryConfig::default().min_score(),
            "support_share": query::SUPPORT_SHARE,
            "segmenter": self.scene.manifest.segmenter,
            "encoder": self.scene.manifest.encoder,
            "adapter": self.scene.engine.name(),
            // Cameras, boxes and Gaussians of this interface are in the scene's own coordinates: world = origin + scale x own.
            "frame": self.scene.manifest.frame,
        })
    }

    /// All objects and parts, by id.
    pub fn objects(&mut self) -> Result<Value> {
        self.choose(&Choice::default())?;
        // One pass: the Gaussians of each object, those of what lies in it included.
        let mut own: Vec<Vec<usize>> = vec![Vec::new(); self.grid.objects.len() + 1];
        for (i, id) in self.scene.gaussians.object_ids.iter().enumerate() {
            for above in self.grid.chain(*id) {
                own[usize::from(above)].push(i);
            }
        }
        let shares = self.grid.shares();
        let row = |o: &Object| {
            let own = &own[usize::from(o.id)];
            json!({
                "id": o.id,
                "parent": o.parent,
                "support": o.support,
                "share": shares[usize::from(o.id) - 1],
                "views": o.views,
                "gaussians": own.len(),
                "bbox3d": selection::robust_box(&self.scene.gaussians, &WorldFrame::default(), own),
                "color": turbo::id_color(o.id),
            })
        };
        Ok(Value::Array(self.grid.objects.iter().map(row).collect()))
    }

    /// The picture of an object; nothing for one that no view shows.
    pub fn picture(&mut self, id: u16) -> Result<Option<RgbImage>> {
        self.choose(&Choice::default())?;
        self.thumbnails.picture(&mut self.scene, &self.grid, id)
    }

    /// The PNG of an object; nothing for one that no view shows.
    pub fn thumbnail(&mut self, id: u16) -> Result<Option<Vec<u8>>> {
        self.choose(&Choice::default())?;
        self.thumbnails.png(&mut self.scene, &self.grid, id)
    }

    /// The view that shows most of an object; nothing for one that no view shows.
    pub fn best_view(&mut self, id: u16) -> Result<Option<String>> {
        self.choose(&Choice::default())?;
        self.thumbnails.view(&mut self.scene, &self.grid, id)
    }

    /// How many Gaussians there are, hidden ones included.
    pub fn gaussians(&self) -> usize {
        self.all.as_ref().unwrap_or(&self.scene.gaussians).len()
    }

    /// All Gaussians as browsers draw them.
    pub fn splats(&mut self) -> Bytes {
        let all = self.all.as_ref().unwrap_or(&self.scene.gaussians);
        self.splats.get_or_insert_with(|| Bytes::from(splats::pack(all))).clone()
    }
}

impl Bell {
    /// Leaves work and waits for what comes of it. Work whose asker has gone is not begun.
    pub async fn ask<T: Send + 'static>(&self, work: impl FnOnce(&mut Desk) -> Result<T, Failure> + Send + 'static) -> Result<T, Failure> {
        let (reply, answer) = oneshot::channel();
        let work: Work = Box::new(move |desk| {
            if !reply.is_closed() {
                // A panic must cost one request, not the server.
                let done = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| work(desk)));
                let failed = || Failure::new(StatusCode::INTERNAL_SERVER_ERROR, "this request failed inside; the log says where");
                let _ = reply.send(done.unwrap_or_else(|_| Err(failed())));
            }
        });
        self.0.try_send(work).map_err(|_| Failure::busy())?;
        answer.await.map_err(|_| Failure::busy())?
    }
}
