//! Queries of a scene: texts, pictures and pixels, and their answers.
//!
//! ```no_run
//! # fn main() -> fastlgs::Result<()> {
//! let mut scene = fastlgs::Scene::open("scenes/fox".as_ref(), "auto")?;
//! let answer = scene.query("fox").view("0027.jpg").run()?;
//! println!("{} {:.2}", answer.report.found, answer.report.score);
//! # Ok(())
//! # }
//! ```

pub mod answer;
pub mod object_query;
pub mod phrase;
pub mod pictures;
mod pixels;
pub mod selection;
pub mod sheet;
mod texts;
mod views;

pub use answer::{Answer, AnswerReport, CANDIDATES};
pub use object_query::ObjectQuery;
pub use pixels::Pixels;
pub use texts::Texts;
pub use views::{ViewChoice, parse_size};

use crate::error::Context;
use crate::{Result, Scene};
use answer::Milliseconds;
use fastlgs_core::{Camera, metrics};
use fastlgs_grid::query::QueryConfig;
use std::time::Instant;

/// A query of a scene with its options; [`Scene::query`] starts one.
pub struct Query<'a> {
    scene: &'a mut Scene,
    object: ObjectQuery,
    viewpoint: Viewpoint,
    negatives: Vec<String>,
    config: QueryConfig,
    dilation: Option<[u32; 2]>,
    candidates: usize,
    tau_ac: Option<f32>,
}

/// The camera of a query.
enum Viewpoint {
    FirstView,
    View(String),
    Camera(Box<Camera>),
}

impl<'a> Query<'a> {
    pub(crate) fn new(scene: &'a mut Scene, object: ObjectQuery) -> Self {
        Self {
            scene,
            object,
            viewpoint: Viewpoint::FirstView,
            negatives: Vec::new(),
            config: QueryConfig::default(),
            dilation: None,
            candidates: CANDIDATES,
            tau_ac: None,
        }
    }

    /// Answers in the view of this name; by default in the first view.
    #[must_use]
    pub fn view(mut self, name: &str) -> Self {
        self.viewpoint = Viewpoint::View(name.to_owned());
        self
    }

    /// Answers in the view of any camera, in the coordinates of the scene.
    #[must_use]
    pub fn camera(mut self, camera: &Camera) -> Self {
        self.viewpoint = Viewpoint::Camera(Box::new(camera.clone()));
        self
    }

    /// Excludes objects that fit one of these texts at least as well as the query. Has no effect on
    /// pixels.
    #[must_use]
    pub fn negatives(mut self, texts: &[String]) -> Self {
        self.negatives = texts.to_vec();
        self
    }

    /// Sets the accepted false-positive rate for absent objects, 0 to 1; 0.07 by default.
    #[must_use]
    pub fn false_alarms(mut self, rate: f32) -> Self {
        self.config.false_alarms = rate;
        self
    }

    /// Sets the largest number of objects that together form the answer; 8 by default.
    #[must_use]
    pub fn top_k(mut self, objects: usize) -> Self {
        self.config.top_k = objects;
        self
    }

    /// Sets the number of objects that the report lists as candidates.
    #[must_use]
    pub fn candidates(mut self, objects: usize) -> Self {
        self.candidates = objects;
        self
    }

    /// Dilates the mask by a window of this half width and half height in pixels.
    #[must_use]
    pub fn dilate(mut self, radius: Option<[u32; 2]>) -> Self {
        self.dilation = radius;
        self
    }

    /// Decides pixels as in the paper: by the distance of the rendered code to the object's code,
    /// at most `tau_ac` on the scale 0 to 255.
    #[must_use]
    pub fn tau_ac(mut self, tau_ac: Option<f32>) -> Self {
        self.tau_ac = tau_ac;
        self
    }

    /// Answers the query. The scene keeps the rendered view, so that the next query in the same
    /// view does not render it again.
    ///
    /// # Errors
    /// A view that does not exist, a text or picture that cannot be embedded, a point outside the
    /// view, or a device that fails.
    pub fn run(self) -> Result<Answer> {
        let camera = match self.viewpoint {
            Viewpoint::FirstView => self
                .scene
                .cameras()
                .first()
                .context("the scene has no views")?
                .clone(),
            Viewpoint::View(name) => self.scene.camera(&name)?,
            Viewpoint::Camera(camera) => *camera,
        };
        let scene = self.scene;
        let grid = scene.grid()?;
        let mut clock = Instant::now();
        let mut lap = || {
            std::mem::replace(&mut clock, Instant::now())
                .elapsed()
                .as_secs_f64()
                * 1e3
        };
        let is_rendered = scene.rendered(&camera, self.tau_ac).is_some();
        let field = scene.field(&camera, self.tau_ac)?;
        let render = if is_rendered { 0.0 } else { lap() };
        let embedded = self.object.embed(scene, &self.negatives)?;
        let encode = lap();
        let found = embedded.find(&grid, &field, &camera, &self.config)?;
        let select = lap();
        let mut mask = field.mask(&grid, &found.targets);
        let restore = lap();
        if let Some(radius) = self.dilation {
            mask = metrics::dilate(&mask, camera.width, camera.height, radius);
        }
        let ms = Milliseconds {
            encode,
            render,
            select,
            restore,
            total: encode + render + select + restore,
            gaussians: 0.0,
        };
        let mut answer = Answer {
            grid,
            field,
            camera,
            found,
            mask,
            report: AnswerReport::default(),
        };
        answer.report = answer.describe(scene, &self.object, &embedded, self.candidates, ms);
        answer.report.find_best_view(scene, &answer.grid)?;
        let ranked = &answer.found.ranked;
        answer.report.find_nearest(scene, &answer.grid, ranked)?;
        Ok(answer)
    }
}
