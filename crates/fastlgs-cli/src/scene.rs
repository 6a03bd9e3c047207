//! An opened, trained scene: what `render`, `query` and `eval` share.

use crate::eyes;
use anyhow::{Context, Result, bail};
use fastlgs_core::scene_folder::Manifest;
use fastlgs_core::{Camera, Gaussians, SceneFolder, camera_path};
use fastlgs_grid::query::{self, Field};
use fastlgs_grid::relevancy::{CANONICAL, OFFLINE_ANYTHING, TextQuery};
use fastlgs_grid::{Grid, codes};
use fastlgs_raster::density::State;
use fastlgs_raster::{Channels, Engine, Frame, View};
use fastlgs_vision::{Encoder, TextEncoder};
use std::cell::OnceCell;
use std::path::{Path, PathBuf};

/// A trained scene on a device.
pub struct Scene {
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
    texts: OnceCell<Texts>,
}

/// A loaded text tower.
pub struct Texts {
    encoder: Box<dyn TextEncoder>,
    canonical: Vec<Vec<f32>>,
    anything: f32,
    offline: bool,
}

impl Texts {
    /// The text tower of the encoder that made the scene's embeddings.
    pub fn load(folder: &SceneFolder, manifest: &Manifest, clip_text: Option<&Path>) -> Result<Self> {
        let encoder = eyes::text_encoder_of(manifest, clip_text)?;
        let offline = manifest.encoder == "offline";
        let canonical = if offline { Vec::new() } else { encoder.embed(&CANONICAL)? };
        let anything = if offline { OFFLINE_ANYTHING } else { -1.0 };
        let length = encoder.embed(&CANONICAL[..1])?[0].len();
        let grid = Grid::load(folder).context("the object grid cannot be read; run 'fastlgs train' again")?;
        let own = grid.objects.iter().flat_map(|o| &o.embeddings).map(Vec::len).next();
        if let Some(own) = own.filter(|own| *own != length) {
            let root = folder.root.display();
            bail!(
                "{root}: its embeddings have {own} numbers, those of texts {length}; they are of another encoder or version: \
                 run 'fastlgs train {root}' again, or name the right tower with --clip-text"
            );
        }
        Ok(Self { encoder, canonical, anything, offline })
    }

    /// Prepares a text.
    pub fn query(&self, text: &str) -> Result<TextQuery> {
        let anything = self.anything + self.encoder.advantage(text);
        Ok(TextQuery { text: self.encoder.embed(&[text])?.remove(0), canonical: self.canonical.clone(), anything })
    }

    /// Relevancy from which an object counts as found.
    pub fn min_score(&self) -> f32 {
        min_score(self.offline)
    }
}

/// Relevancy from which an object counts as found, with the offline encoder or with CLIP.
fn min_score(offline: bool) -> f32 {
    if offline { query::MIN_SCORE } else { query::CLIP_MIN_SCORE }
}

impl Scene {
    /// Loads SCENE and puts it on the device.
    pub fn open(root: &Path, device: &str) -> Result<Self> {
        let folder = SceneFolder::open(root)?;
        let manifest = folder.manifest()?;
        let mut gaussians = folder.gaussians()?;
        if !manifest.notes.contains_key("train") {
            let root = root.display();
            bail!("{root}: its photos were preprocessed again after it was trained; run 'fastlgs train {root}' again");
        }
        if folder.is_compact() {
            Grid::load(&folder).context("the object grid cannot be read; export the scene again")?.set_codes(&mut gaussians);
        }
        let mut engine = fastlgs_raster::open_engine(device)?;
        engine.set_state(&State::of(&gaussians))?;
        let cameras = folder.cameras()?;
        Ok(Self { manifest, cameras, folder, gaussians, engine, clip_text: None, texts: OnceCell::new() })
    }

    /// Puts other Gaussians in the place of the scene's.
    pub fn show(&mut self, gaussians: Gaussians) -> Result<()> {
        self.engine.set_state(&State::of(&gaussians))?;
        self.gaussians = gaussians;
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
    pub fn grid(&self) -> Result<Grid> {
        Grid::load(&self.folder).context("the object grid cannot be read; run 'fastlgs train' again")
    }

    /// Renders colour, feature and transmittance.
    pub fn render(&mut self, camera: &Camera) -> Result<Frame> {
        Ok(self.engine.render(self.view(camera), Channels::Both)?)
    }

    /// The frame of a camera, rendered in the way the scene was trained.
    fn view(&self, camera: &Camera) -> View {
        let mut view = View::new(camera, self.gaussians.len(), self.gaussians.sh_degree);
        if let Some(train) = self.manifest.notes.get("train") {
            view.antialias = u32::from(train["antialias"] == true);
            for (k, value) in train["background"].as_array().into_iter().flatten().take(3).enumerate() {
                view.background_color[k] = value.as_f64().unwrap_or(0.0) as f32;
            }
        }
        view
    }

    /// Renders the expected depth (sum of w z / sum of w), infinite where nothing is.
    pub fn render_depth(&mut self, camera: &Camera) -> Result<Vec<f32>> {
        let frame = self.engine.render(View { depth_as_feature: 1, ..self.view(camera) }, Channels::Feature)?;
        let solid = |(z, t): (&f32, &f32)| if *t < 0.999 { z / (1.0 - t) } else { f32::INFINITY };
        Ok(frame.channels(3, 4).iter().zip(frame.channels(6, 7)).map(solid).collect())
    }

    /// What a view tells about objects, in the way the scene was trained, unless `tau_ac` asks for the paper's.
    pub fn field(&mut self, camera: &Camera, tau_ac: Option<f32>) -> Result<Field> {
        let lifted = self.manifest.notes.get("train").is_some_and(|t| t["feature_mode"] == "lift");
        if lifted && tau_ac.is_none() {
            return Ok(Field::Shares(self.engine.render_ids(self.view(camera), &self.gaussians.object_ids)?));
        }
        let frame = self.engine.render(self.view(camera), Channels::Feature)?;
        let (width, height) = (frame.width, frame.height);
        // Codes that were trained make up for what passes through; those that were lifted do not.
        let values = if lifted { covered(&frame).concat() } else { frame.channels(3, 6).to_vec() };
        Ok(Field::Features { width, height, values, tau_ac: tau_ac.unwrap_or(codes::TAU_AC) })
    }

    /// Prepares a text with the encoder that made the scene's embeddings; the first one loads it.
    pub fn text_query(&self, text: &str) -> Result<TextQuery> {
        if self.texts.get().is_none() {
            let _ = self.texts.set(Texts::load(&self.folder, &self.manifest, self.clip_text.as_deref())?);
        }
        self.texts.get().expect("set above").query(text)
    }

    /// The image tower that made the scene's embeddings.
    pub fn image_encoder(&self) -> Result<Box<dyn Encoder>> {
        eyes::encoder_of(&self.folder, &self.manifest)
    }

    /// Relevancy from which an object counts as found, with the scene's encoder.
    pub fn min_score(&self) -> f32 {
        min_score(self.manifest.encoder == "offline")
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
    let files = [model, "grid.safetensors", "grid.json", "scene.json", "cameras/cameras.json"].into_iter();
    files.filter_map(|f| std::fs::metadata(root.join(f)).ok()).map(|m| m.len()).sum()
}

/// Which cameras a command works on.
#[derive(clap::Args, Clone)]
pub struct ViewChoice {
    /// A view of the scene by its photo's name.
    #[arg(long, value_name = "NAME")]
    pub view: Option<String>,
    /// All views of the scene.
    #[arg(long, conflicts_with = "view")]
    pub all_views: bool,
    /// A camera file: JSON with name, width, height, fx, fy, cx, cy and world_to_camera (16 numbers, column-major).
    #[arg(long, value_name = "FILE", conflicts_with_all = ["view", "all_views"])]
    pub camera: Option<PathBuf>,
    /// A camera path as nerfstudio's viewer saves it: every frame is rendered.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["view", "all_views", "camera"])]
    path: Option<PathBuf>,
    /// Size of the pictures, as WIDTHxHEIGHT.
    #[arg(long, value_name = "WxH", value_parser = parse_size)]
    pub size: Option<(u32, u32)>,
}

impl ViewChoice {
    /// The cameras; the first view where nothing was chosen.
    pub fn cameras(&self, scene: &Scene) -> Result<Vec<Camera>> {
        let chosen = if let Some(path) = &self.camera {
            vec![Camera::load(path)?]
        } else if let Some(path) = &self.path {
            camera_path::read(path)?
        } else if self.all_views {
            scene.cameras.clone()
        } else if let Some(name) = &self.view {
            vec![scene.cameras[scene.folder.view_index(&scene.cameras, name)?].clone()]
        } else {
            scene.cameras.first().cloned().into_iter().collect()
        };
        if chosen.is_empty() {
            bail!("{}: the scene has no views", scene.folder.root.display());
        }
        Ok(chosen.into_iter().map(|c| self.size.map_or(c.clone(), |(w, h)| c.resized(w, h))).collect())
    }
}

/// Parses `640x480`.
pub fn parse_size(text: &str) -> Result<(u32, u32), String> {
    let sizes = text.split_once('x').and_then(|(w, h)| Some((w.parse().ok()?, h.parse().ok()?)));
    sizes.filter(|(w, h)| (1..=16384).contains(w) && (1..=16384).contains(h)).ok_or_else(|| format!("'{text}' is not a size like 640x480"))
}
