//! An opened, trained scene that renders and answers.

pub mod answer;
pub mod ask;
pub mod phrase;
pub mod pictures;
mod pixels;
pub mod selection;
pub mod sheet;
mod texts;
mod views;

use crate::calibrations::Calibrations;
use crate::error::{Context, bail};
use crate::{Result, eyes, train};
use fastlgs_core::scene_folder::Manifest;
use fastlgs_core::{Camera, Gaussians, SceneFolder, ply};
use fastlgs_grid::Grid;
use fastlgs_grid::field::Field;
use fastlgs_grid::query::Hit;
use fastlgs_grid::relevancy::TextQuery;
use fastlgs_raster::density::State;
use fastlgs_raster::{Channels, Engine, Frame, View};
use fastlgs_vision::{Encoder, TextEncoder};
pub use pixels::Pixels;
use std::cell::OnceCell;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
pub use texts::Texts;
pub use views::{ViewChoice, parse_size};

/// A trained scene on a device.
pub struct Session {
    /// Its folder.
    pub folder: SceneFolder,
    /// What made it.
    pub manifest: Manifest,
    /// All views, sorted by name.
    pub cameras: Vec<Camera>,
    /// The Gaussians.
    pub gaussians: Gaussians,
    /// The device, holding the Gaussians.
    pub engine: Box<dyn Engine>,
    /// A CLIP text tower that is used instead of the one the scene remembers.
    pub clip_text: Option<PathBuf>,
    /// How it was trained.
    pub trained: train::Report,
    /// What cosines are worth, where that is not to be what is known of the scene's encoder.
    pub calibrations: Option<Calibrations>,
    texts: OnceCell<Texts>,
    /// Whether names that the user taught are known.
    taught: bool,
    /// The views that show objects best, as far as they were asked for.
    seen_best: BTreeMap<Vec<u16>, Option<String>>,
}

impl Session {
    /// Loads SCENE and puts it on the device.
    pub fn open(root: &Path, device: &str) -> Result<Self> {
        let folder = SceneFolder::open(root)?;
        let manifest = folder.manifest()?;
        let mut gaussians = folder.gaussians()?;
        let Some(trained) = train::Report::of(&manifest, root)? else {
            let root = root.display();
            bail!("{root}: its photos were preprocessed again after it was trained; run 'fastlgs train {root}' again");
        };
        if folder.is_compact() {
            Grid::load(&folder).context("the object grid cannot be read; export the scene again")?.set_codes(&mut gaussians);
        }
        let mut engine = fastlgs_raster::open_engine(device)?;
        engine.set_state(&State::of(&gaussians))?;
        let cameras = folder.cameras()?;
        Ok(Self {
            manifest,
            cameras,
            folder,
            gaussians,
            engine,
            clip_text: None,
            trained,
            calibrations: None,
            texts: OnceCell::new(),
            taught: true,
            seen_best: BTreeMap::new(),
        })
    }

    /// Puts other Gaussians in the place of the scene's.
    pub fn show(&mut self, gaussians: Gaussians) -> Result<()> {
        self.engine.set_state(&State::of(&gaussians))?;
        self.gaussians = gaussians;
        self.seen_best.clear();
        Ok(())
    }

    /// Renders once in passing: drivers compile kernels when they first run, which no query should wait for.
    pub fn warm_up(&mut self) -> Result<()> {
        match self.cameras.first().map(|c| c.resized(16, 16)) {
            Some(small) => self.field(&small, None).map(|_| ()),
            None => Ok(()),
        }
    }

    /// The object table.
    ///
    /// # Errors
    /// A damaged table, or Gaussians that another program saved without the objects that they belong to.
    pub fn grid(&self) -> Result<Grid> {
        if !self.folder.is_compact() && !ply::has_objects(&self.folder.ply_path())? {
            let (path, root) = (self.folder.ply_path(), self.folder.root.display());
            bail!(
                "{}: another program saved it without the column object_id, so that it has no objects; \
                 'fastlgs train {root} --init {} --iterations 0' finds them again and keeps the Gaussians",
                path.display(),
                path.display()
            );
        }
        Grid::load(&self.folder).context("the object grid cannot be read; run 'fastlgs train' again")
    }

    /// Renders colour and transmittance; features are 0.
    pub fn render(&mut self, camera: &Camera) -> Result<Frame> {
        Ok(self.engine.render(self.view(camera), Channels::Color)?)
    }

    /// Renders feature and transmittance; colour is 0.
    pub fn render_feature(&mut self, camera: &Camera) -> Result<Frame> {
        Ok(self.engine.render(self.view(camera), Channels::Feature)?)
    }

    /// The frame of a camera, rendered in the way the scene was trained.
    pub fn view(&self, camera: &Camera) -> View {
        self.trained.view(camera, &self.gaussians)
    }

    /// Renders the expected depth (sum of w z / sum of w), infinite where nothing is.
    pub fn render_depth(&mut self, camera: &Camera) -> Result<Vec<f32>> {
        let frame = self.engine.render(View { depth_as_feature: 1, ..self.view(camera) }, Channels::Feature)?;
        let solid = |(z, t): (&f32, &f32)| if *t < 0.999 { z / (1.0 - t) } else { f32::INFINITY };
        Ok(frame.channels(3, 4).iter().zip(frame.channels(6, 7)).map(solid).collect())
    }

    /// What a view tells about objects, in the way the scene was trained, unless `tau_ac` asks for the paper's.
    pub fn field(&mut self, camera: &Camera, tau_ac: Option<f32>) -> Result<Field> {
        let solid = u32::from(self.trained.clear > 0);
        self.field_of(View { solid, ..self.view(camera) }, tau_ac)
    }

    /// The same of what shows alone, as if nothing were seen through.
    pub fn field_of_shown(&mut self, camera: &Camera) -> Result<Field> {
        self.field_of(self.view(camera), None)
    }

    fn field_of(&mut self, view: View, tau_ac: Option<f32>) -> Result<Field> {
        let lifted = self.trained.feature_mode == train::FeatureMode::Lift;
        if lifted && tau_ac.is_none() {
            return Ok(Field::Shares(self.engine.render_ids(view, &self.gaussians.object_ids)?));
        }
        let frame = self.engine.render(View { solid: 0, ..view }, Channels::Feature)?;
        let (width, height) = (frame.width, frame.height);
        // Codes that were trained make up for what passes through; those that were lifted do not.
        let values = if lifted { covered(&frame).concat() } else { frame.channels(3, 6).to_vec() };
        Ok(Field::Features { width, height, values, tau_ac })
    }

    /// The view that shows most of some objects; nothing where none does.
    ///
    /// # Errors
    /// When the device fails.
    pub fn seen_best(&mut self, grid: &Grid, ids: &[u16]) -> Result<Option<String>> {
        /// Longer side of the small pictures that are looked at.
        const SIDE: u32 = 128;
        if let Some(known) = self.seen_best.get(ids) {
            return Ok(known.clone());
        }
        let targets: Vec<Hit> = ids.iter().map(|id| Hit { id: *id, score: 1.0 }).collect();
        let mut best = (0, None);
        for camera in self.cameras.clone() {
            let longer = camera.width.max(camera.height);
            let side = |v: u32| (v * SIDE.min(longer) / longer).max(1);
            let small = camera.resized(side(camera.width), side(camera.height));
            let pixels = self.field(&small, None)?.mask(grid, &targets).iter().filter(|m| **m).count();
            if pixels > best.0 {
                best = (pixels, Some(camera.name));
            }
        }
        self.seen_best.insert(ids.to_vec(), best.1.clone());
        Ok(best.1)
    }

    /// The text tower of the encoder that made the scene's embeddings; the first call loads it.
    fn texts(&self) -> Result<&Texts> {
        if self.texts.get().is_none() {
            let texts = Texts::load(&self.folder, &self.manifest, self.clip_text.as_deref())?;
            let _ = self.texts.set(self.as_asked_here(texts));
        }
        Ok(self.texts.get().expect("set above"))
    }

    /// A text tower with this session's calibrations, and without names where these are not to count.
    fn as_asked_here(&self, mut texts: Texts) -> Texts {
        texts.calibrations = self.calibrations.unwrap_or(texts.calibrations);
        if !self.taught {
            texts.forget_names();
        }
        texts
    }

    /// Prepares a text.
    ///
    /// # Errors
    /// As [`Texts::query`], and where the text tower cannot be loaded.
    pub fn text_query(&self, text: &str) -> Result<TextQuery> {
        self.texts()?.query(text)
    }

    /// Prepares many texts at once.
    ///
    /// # Errors
    /// As [`Self::text_query`], but names that were taught with another encoder are taken as words.
    pub fn text_queries(&self, texts: &[String]) -> Result<Vec<TextQuery>> {
        self.texts()?.queries(texts)
    }

    /// Names that the user has taught with this scene's encoder.
    ///
    /// # Errors
    /// As [`Self::text_query`].
    pub fn taught_names(&self) -> Result<Vec<String>> {
        Ok(self.texts()?.taught())
    }

    /// Whether the user has taught a name.
    pub fn is_taught(&self, text: &str) -> bool {
        self.texts().is_ok_and(|texts| texts.is_taught(text))
    }

    /// Embeds texts by a tower of the caller's from now on, for scenes whose embeddings were imported.
    ///
    /// # Errors
    /// A tower whose embeddings have another length than the scene's.
    pub fn use_text_encoder(&mut self, encoder: Box<dyn TextEncoder>) -> Result<()> {
        let texts = Texts::of(encoder, &self.folder, &self.manifest)?;
        self.texts = OnceCell::from(self.as_asked_here(texts));
        Ok(())
    }

    /// Takes all texts as words from now on, whatever the user taught: figures tell what the encoder knows by itself.
    pub fn forget_taught(&mut self) {
        self.taught = false;
        if let Some(texts) = self.texts.get_mut() {
            texts.forget_names();
        }
    }

    /// Forgets the text tower, so that the next text is asked with the names as they are then.
    pub fn forget_texts(&mut self) {
        self.texts = OnceCell::new();
    }

    /// The image tower that made the scene's embeddings.
    pub fn image_encoder(&self) -> Result<Box<dyn Encoder>> {
        eyes::encoder_of(&self.folder, &self.manifest)
    }
}

/// The three features of each pixel as a mean over what covers it: blended ones over 1 - transmittance.
pub fn covered(frame: &Frame) -> [Vec<f32>; 3] {
    let over = |(v, t): (&f32, &f32)| if *t < 0.999 { v / (1.0 - t) } else { 0.0 };
    [3, 4, 5].map(|k| frame.channels(k, k + 1).iter().zip(frame.channels(6, 7)).map(over).collect())
}

/// Bytes of everything that a query needs.
pub fn bytes(root: &Path) -> u64 {
    let model = if root.join("scene.ply").is_file() { "scene.ply" } else { "scene.safetensors" };
    let files = [model, "grid.safetensors", "grid.json", "scene.json", "cameras/cameras.json", "cameras/trained.json"].into_iter();
    files.filter_map(|f| std::fs::metadata(root.join(f)).ok()).map(|m| m.len()).sum()
}
