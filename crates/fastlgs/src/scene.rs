//! An opened, trained scene, which renders views and answers queries.

use crate::calibrations::Calibrations;
use crate::error::{Context, bail};
use crate::query::{ObjectQuery, Query, Texts};
use crate::train::{self, TrainReport};
use crate::visibility::Visibility;
use crate::{Result, SceneNotes, model_choice};
use fastlgs_core::scene_folder::Manifest;
use fastlgs_core::{Camera, Gaussians, SceneFolder, ply};
use fastlgs_grid::Grid;
use fastlgs_grid::field::Field;
use fastlgs_grid::relevancy::{Rule, TextQuery};
use fastlgs_raster::density::State;
use fastlgs_raster::{Channels, Engine, Frame, View};
use fastlgs_vision::{Encoder, TextEncoder};
use image::RgbImage;
use std::cell::OnceCell;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Largest distance of a rendered code from the code of its object, on a scale of 0 to 255 (paper).
const PAPER_TAU_AC: f32 = 5.0;

/// A trained scene on a device.
pub struct Scene {
    folder: SceneFolder,
    manifest: Manifest,
    /// Cameras of all views, sorted by name.
    cameras: Vec<Camera>,
    gaussians: Gaussians,
    /// Engine of the device, with the Gaussians loaded.
    engine: Box<dyn Engine>,
    /// File of a CLIP text tower to use instead of the one that the manifest records.
    clip_text: Option<PathBuf>,
    trained: TrainReport,
    /// Calibrations to use instead of those of the encoder.
    calibrations: Option<Calibrations>,
    /// The object table, loaded at its first use.
    grid: OnceCell<Arc<Grid>>,
    /// The view that was rendered last.
    last_field: Option<LastField>,
    texts: OnceCell<Texts>,
    /// Whether taught names are used.
    use_taught_names: bool,
    /// Which views show which objects, after the first call that needs it.
    visibility: Option<Visibility>,
}

/// Rendered object data of a view, and what it depends on.
struct LastField {
    camera: Camera,
    tau_ac: Option<f32>,
    field: Arc<Field>,
}

impl Scene {
    /// Loads the scene in the folder `root`, and copies its Gaussians to the device.
    ///
    /// # Errors
    /// A scene that is not trained, damaged files, or a device that fails.
    pub fn open(root: &Path, device: &str) -> Result<Self> {
        let folder = SceneFolder::open(root)?;
        let manifest = folder.manifest()?;
        let mut gaussians = folder.gaussians()?;
        let Some(trained) = SceneNotes::read(&manifest, root)?.train else {
            let root = root.display();
            bail!(
                "{root}: the photos were preprocessed again after the training; run 'fastlgs train {root}' again"
            );
        };
        if folder.is_compact() {
            Grid::load(&folder)
                .context("the object grid cannot be read; export the scene again")?
                .set_codes(&mut gaussians);
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
            grid: OnceCell::new(),
            last_field: None,
            texts: OnceCell::new(),
            use_taught_names: true,
            visibility: None,
        })
    }

    /// Starts a query by a text, a picture or pixels.
    pub fn query(&mut self, object: impl Into<ObjectQuery>) -> Query<'_> {
        Query::new(self, object.into())
    }

    /// The folder of the scene.
    pub fn folder(&self) -> &SceneFolder {
        &self.folder
    }

    /// The manifest of the scene.
    pub fn manifest(&self) -> &Manifest {
        &self.manifest
    }

    /// The cameras of all views, sorted by name.
    pub fn cameras(&self) -> &[Camera] {
        &self.cameras
    }

    /// Returns the camera of a view, named with or without extension.
    ///
    /// # Errors
    /// No view of this name, or several.
    pub fn camera(&self, name: &str) -> Result<Camera> {
        Ok(self.cameras[self.folder.view_index(&self.cameras, name)?].clone())
    }

    /// The Gaussians.
    pub fn gaussians(&self) -> &Gaussians {
        &self.gaussians
    }

    /// The report of the training.
    pub fn trained(&self) -> &TrainReport {
        &self.trained
    }

    /// How text queries rank and accept objects: as in the paper for the preset `like-paper`.
    pub fn rule(&self) -> Rule {
        match self.trained.preset {
            train::Preset::LikePaper => Rule::Paper,
            _ => Rule::Calibrated,
        }
    }

    /// Name of the device.
    pub fn adapter(&self) -> String {
        self.engine.name()
    }

    /// The engine of the device, with the Gaussians loaded.
    pub fn engine(&mut self) -> &mut dyn Engine {
        &mut *self.engine
    }

    /// The calibrations of the encoder.
    pub fn calibrations(&self) -> Calibrations {
        self.calibrations
            .unwrap_or_else(|| Calibrations::of(&self.manifest))
    }

    /// Replaces the calibrations of the encoder, for measurements.
    pub fn set_calibrations(&mut self, calibrations: Calibrations) {
        self.calibrations = Some(calibrations);
        self.drop_texts();
    }

    /// Uses another CLIP text tower than the one that the manifest records.
    pub fn set_clip_text(&mut self, file: Option<PathBuf>) {
        self.clip_text = file;
        self.drop_texts();
    }

    /// Replaces the Gaussians of the scene, on the device as well.
    pub fn set_gaussians(&mut self, gaussians: Gaussians) -> Result<()> {
        self.engine.set_state(&State::of(&gaussians))?;
        self.gaussians = gaussians;
        self.visibility = None;
        self.last_field = None;
        Ok(())
    }

    /// Replaces the object ids of the Gaussians, one for each.
    pub(crate) fn set_object_ids(&mut self, ids: Vec<u16>) {
        self.gaussians.object_ids = ids;
        self.visibility = None;
        self.last_field = None;
    }

    /// Renders a view of 16x16 pixels, so that the driver compiles the shaders before the first
    /// query.
    pub fn warm_up(&mut self) -> Result<()> {
        match self.cameras.first().map(|c| c.resized(16, 16)) {
            Some(small) => self.render_objects(&small, None).map(|_| ()),
            None => Ok(()),
        }
    }

    /// Returns the object table; the first call loads it.
    ///
    /// # Errors
    /// A damaged table, or a PLY file that another program saved without object ids.
    pub fn grid(&self) -> Result<Arc<Grid>> {
        if let Some(grid) = self.grid.get() {
            return Ok(grid.clone());
        }
        if !self.folder.is_compact() && !ply::has_object_ids(&self.folder.ply_path())? {
            let path = self.folder.ply_path();
            bail!(
                "{}: another program saved this file without the column object_id, so the objects are lost; \
                 train the scene again with init set to this file and iterations to 0, which keeps the Gaussians",
                path.display()
            );
        }
        let grid = Grid::load(&self.folder)
            .context("the object grid cannot be read; run 'fastlgs train' again")?;
        Ok(self.grid.get_or_init(|| Arc::new(grid)).clone())
    }

    /// Renders colour and transmittance; features are 0.
    pub fn render(&mut self, camera: &Camera) -> Result<Frame> {
        Ok(self.engine.render(self.view(camera), Channels::Color)?)
    }

    /// Renders feature and transmittance; colour is 0.
    pub fn render_feature(&mut self, camera: &Camera) -> Result<Frame> {
        Ok(self.engine.render(self.view(camera), Channels::Feature)?)
    }

    /// Returns the render settings of a camera, as in training.
    pub fn view(&self, camera: &Camera) -> View {
        self.trained.view(camera, &self.gaussians)
    }

    /// Renders the expected depth of each pixel, in units of the scene: sum of w z / sum of w, with
    /// blending weights w. Pixels with a transmittance of 0.999 or more are infinite.
    pub fn render_depth(&mut self, camera: &Camera) -> Result<Vec<f32>> {
        let view = self.view(camera).with_depth_as_feature();
        let frame = self.engine.render(view, Channels::Feature)?;
        Ok(frame.depth(0.999))
    }

    /// Renders the object data of a view: id weights if features are lifted, codes if they are
    /// trained. With `tau_ac`, codes are rendered in both cases (paper). Id weights include
    /// transparent objects, drawn as solid. The view that was rendered last is kept.
    pub fn field(&mut self, camera: &Camera, tau_ac: Option<f32>) -> Result<Arc<Field>> {
        if let Some(field) = self.rendered(camera, tau_ac) {
            return Ok(field);
        }
        let field = Arc::new(self.render_objects(camera, tau_ac)?);
        self.last_field = Some(LastField {
            camera: camera.clone(),
            tau_ac,
            field: field.clone(),
        });
        Ok(field)
    }

    /// Returns the object data of the view that was rendered last, if it is this one.
    pub(crate) fn rendered(&self, camera: &Camera, tau_ac: Option<f32>) -> Option<Arc<Field>> {
        let last = self.last_field.as_ref()?;
        (last.camera == *camera && last.tau_ac == tau_ac).then(|| last.field.clone())
    }

    pub(crate) fn render_objects(&mut self, camera: &Camera, tau_ac: Option<f32>) -> Result<Field> {
        let papers = (self.rule() == Rule::Paper).then_some(PAPER_TAU_AC);
        let tau_ac = tau_ac.or(papers);
        let has_transparent = self.trained.clear > 0;
        let view = self.view(camera).with_transparent_as_solid(has_transparent);
        self.render_field(view, tau_ac)
    }

    /// Renders the object data of a view without transparent objects.
    pub fn field_without_transparent(&mut self, camera: &Camera) -> Result<Field> {
        self.render_field(self.view(camera), None)
    }

    fn render_field(&mut self, view: View, tau_ac: Option<f32>) -> Result<Field> {
        let lifted = self.trained.feature_mode == train::FeatureMode::Lift;
        if lifted && tau_ac.is_none() {
            return Ok(Field::IdWeights(
                self.engine.render_ids(view, &self.gaussians.object_ids)?,
            ));
        }
        let frame = self
            .engine
            .render(view.with_transparent_as_solid(false), Channels::Feature)?;
        let (width, height) = (frame.width, frame.height);
        // Trained codes compensate for the transmittance; lifted codes must be divided by the
        // coverage.
        let values = if lifted {
            mean_features(&frame).concat()
        } else {
            frame.feature().to_vec()
        };
        Ok(Field::Features {
            width,
            height,
            values,
            tau_ac,
        })
    }

    /// Returns which views show which objects; the first call renders all views in a small size.
    ///
    /// # Errors
    /// The device fails.
    fn visibility(&mut self, grid: &Grid) -> Result<Visibility> {
        match self.visibility.take() {
            Some(known) => Ok(known),
            None => Visibility::of(self, grid),
        }
    }

    /// Returns the name of the view that shows most pixels of some objects; `None` if no view shows
    /// them.
    ///
    /// # Errors
    /// The device fails.
    pub fn most_visible_view(&mut self, grid: &Grid, ids: &[u16]) -> Result<Option<String>> {
        let visibility = self.visibility(grid)?;
        let best = visibility.best_view(ids);
        self.visibility = Some(visibility);
        Ok(best.map(|view| self.cameras[view].name.clone()))
    }

    /// Returns a small picture of an object; `None` if no view shows it.
    ///
    /// # Errors
    /// The device fails.
    pub fn thumbnail(&mut self, grid: &Grid, id: u16) -> Result<Option<RgbImage>> {
        let mut visibility = self.visibility(grid)?;
        let picture = visibility.thumbnail(self, id);
        self.visibility = Some(visibility);
        picture
    }

    /// Returns the text encoder of the scene; the first call loads it.
    pub(crate) fn texts(&self) -> Result<&Texts> {
        if self.texts.get().is_none() {
            let file = self.clip_text.as_deref();
            let texts = Texts::load(&self.folder, &self.manifest, file, self.rule())?;
            let _ = self.texts.set(self.configure_texts(texts));
        }
        Ok(self.texts.get().expect("set above"))
    }

    /// Applies the calibrations of this scene to a text encoder, and removes taught names if they
    /// are not used.
    fn configure_texts(&self, mut texts: Texts) -> Texts {
        texts.calibrations = self.calibrations.unwrap_or(texts.calibrations);
        if !self.use_taught_names {
            texts.ignore_taught_names();
        }
        texts
    }

    /// Embeds a text, or looks up a taught name.
    ///
    /// # Errors
    /// As [`Texts::query`], or a text encoder that cannot be loaded.
    pub fn text_query(&self, text: &str) -> Result<TextQuery> {
        self.texts()?.query(text)
    }

    /// Embeds many texts at once. A name that was taught only with another encoder is embedded as a
    /// text.
    ///
    /// # Errors
    /// As [`Self::text_query`], except for such names.
    pub fn text_queries(&self, texts: &[String]) -> Result<Vec<TextQuery>> {
        self.texts()?.queries(texts)
    }

    /// Returns the names that were taught with the encoder of this scene.
    ///
    /// # Errors
    /// As [`Self::text_query`].
    pub fn taught_names(&self) -> Result<Vec<String>> {
        Ok(self.texts()?.taught())
    }

    /// Returns whether a text is a taught name; false if the text encoder cannot be loaded.
    pub fn is_taught(&self, text: &str) -> bool {
        self.texts().is_ok_and(|texts| texts.is_taught(text))
    }

    /// Replaces the text encoder, for scenes with imported embeddings.
    ///
    /// # Errors
    /// An encoder whose embeddings have another length than those of the scene.
    pub fn use_text_encoder(&mut self, encoder: Box<dyn TextEncoder>) -> Result<()> {
        let texts = Texts::from_encoder(encoder, &self.folder, &self.manifest, self.rule())?;
        self.texts = OnceCell::from(self.configure_texts(texts));
        Ok(())
    }

    /// Ignores taught names from now on, so that an evaluation measures the encoder alone.
    pub fn ignore_taught_names(&mut self) {
        self.use_taught_names = false;
        if let Some(texts) = self.texts.get_mut() {
            texts.ignore_taught_names();
        }
    }

    /// Drops the text encoder. The next query loads it again, with the current taught names.
    pub fn drop_texts(&mut self) {
        self.texts = OnceCell::new();
    }

    /// Loads the image encoder of the scene.
    pub fn image_encoder(&self) -> Result<Box<dyn Encoder>> {
        model_choice::encoder_of(&self.folder, &self.manifest)
    }
}

/// Returns the mean feature of each pixel, one plane for each channel: the blended feature divided
/// by 1 - transmittance. It is 0 at a transmittance of 0.999 or more.
pub fn mean_features(frame: &Frame) -> [Vec<f32>; 3] {
    let over = |(v, t): (&f32, &f32)| if *t < 0.999 { v / (1.0 - t) } else { 0.0 };
    [3, 4, 5].map(|k| {
        frame
            .channels(k, k + 1)
            .iter()
            .zip(frame.transmittance())
            .map(over)
            .collect()
    })
}

/// Returns the size of all files that a query needs, in bytes.
pub fn query_file_bytes(root: &Path) -> u64 {
    let model = if root.join("scene.ply").is_file() {
        "scene.ply"
    } else {
        "scene.safetensors"
    };
    let files = [
        model,
        "grid.safetensors",
        "grid.json",
        "scene.json",
        "cameras/cameras.json",
        "cameras/trained.json",
    ]
    .into_iter();
    files
        .filter_map(|f| std::fs::metadata(root.join(f)).ok())
        .map(|m| m.len())
        .sum()
}
