//! Which segmenter and encoders a command works with: chosen by options in `preprocess`, remembered in `scene.json`.

use crate::error::{Context, bail};
use crate::{Result, calibrations};
use fastlgs_core::scene_folder::{Manifest, ModelFile};
use fastlgs_core::{Camera, LabelMap, Level, MaskList, SceneFolder};
use fastlgs_grid::mapping::Mask;
use fastlgs_grid::{Grid, evidence};
use fastlgs_vision::import::{self, Import, Lens};
use fastlgs_vision::pull::Named;
use fastlgs_vision::sam::{self, Sam};
use fastlgs_vision::{
    ClipImage, ClipText, Conse, Encoder, OfflineSegmenter, OfflineText, Segmenter, TextEncoder, appearance, clip, conse, models, places,
    segmenter,
};
use image::RgbImage;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// What finds masks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
pub enum SegmenterKind {
    /// Learned edges, merged into regions.
    #[default]
    Offline,
    /// ONNX exports of SAM.
    Sam,
    /// Masks beside the photos, made by other programs; docs/formats.md lists the layouts.
    Import,
}

impl SegmenterKind {
    /// What `scene.json` calls it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Offline => "offline",
            Self::Sam => "sam",
            Self::Import => "import",
        }
    }
}

/// How SAM is asked for all masks of a photo.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
pub enum SamPreset {
    /// As its authors' generator does: predicted IoU 0.88, stability 0.95, no crops.
    #[default]
    Meta,
    /// As LangSplat does, whose masks the paper takes: 0.7, 0.85, one layer of crops, and masks of one level that do not repeat or hold each
    /// other.
    #[cfg_attr(feature = "clap", value(name = "langsplat"))]
    LangSplat,
}

/// What embeds masks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
pub enum EncoderKind {
    /// A classifier of 1,000 things.
    #[default]
    Offline,
    /// ONNX exports of CLIP.
    Clip,
    /// Embeddings beside the photos.
    Import,
}

impl EncoderKind {
    /// What `scene.json` calls it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Offline => "offline",
            Self::Clip => "clip",
            Self::Import => "import",
        }
    }
}

/// Which segmenter and encoder `preprocess` works with.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(default)]
#[cfg_attr(feature = "clap", derive(clap::Args))]
pub struct Eyes {
    /// What finds masks.
    #[cfg_attr(feature = "clap", arg(long, value_enum, default_value_t))]
    pub segmenter: SegmenterKind,
    /// What embeds masks.
    #[cfg_attr(feature = "clap", arg(long, value_enum, default_value_t))]
    pub encoder: EncoderKind,
    /// Levels of masks that are kept, separated by commas; Algorithm 1 makes objects of the whole ones alone.
    #[cfg_attr(feature = "clap", arg(long, value_delimiter = ',', default_value = "whole,part,subpart", value_parser = ["whole", "part", "subpart"]))]
    pub levels: Vec<String>,
    /// SAM by the name that `models pull` knows it by.
    #[cfg_attr(feature = "clap", arg(long, default_value = "slimsam", value_name = "NAME"))]
    pub sam: String,
    /// SAM's image encoder, instead of --sam.
    #[cfg_attr(feature = "clap", arg(long, value_name = "FILE", requires = "sam_decoder"))]
    pub sam_encoder: Option<PathBuf>,
    /// SAM's prompt decoder, instead of --sam.
    #[cfg_attr(feature = "clap", arg(long, value_name = "FILE", requires = "sam_encoder"))]
    pub sam_decoder: Option<PathBuf>,
    /// How SAM is asked for all masks of a photo; by default as its authors do, and as LangSplat does where all is made as the paper has it.
    #[cfg_attr(feature = "clap", arg(long, value_enum))]
    pub sam_preset: Option<SamPreset>,
    /// Point prompts along each side of a photo, instead of the preset's 32.
    #[cfg_attr(feature = "clap", arg(long, value_parser = clap::value_parser!(u32).range(1..=128)))]
    pub sam_points: Option<u32>,
    /// Least IoU that SAM predicts for its own mask, instead of the preset's.
    #[cfg_attr(feature = "clap", arg(long))]
    pub sam_iou: Option<f32>,
    /// Least stability of SAM's masks, instead of the preset's.
    #[cfg_attr(feature = "clap", arg(long))]
    pub sam_stability: Option<f32>,
    /// CLIP by the name that `models pull` knows it by.
    #[cfg_attr(feature = "clap", arg(long, default_value = "clip-vit-b16", value_name = "NAME"))]
    pub clip: String,
    /// CLIP's image tower, instead of --clip.
    #[cfg_attr(feature = "clap", arg(long, value_name = "FILE", requires = "clip_text"))]
    pub clip_image: Option<PathBuf>,
    /// CLIP's text tower, instead of --clip; with imported embeddings the tower that belongs to them.
    #[cfg_attr(feature = "clap", arg(long, value_name = "FILE"))]
    pub clip_text: Option<PathBuf>,
}

impl Default for Eyes {
    fn default() -> Self {
        Self {
            segmenter: SegmenterKind::default(),
            encoder: EncoderKind::default(),
            levels: Level::ALL.map(|level| level.name().to_owned()).to_vec(),
            sam: "slimsam".to_owned(),
            sam_encoder: None,
            sam_decoder: None,
            sam_preset: None,
            sam_points: None,
            sam_iou: None,
            sam_stability: None,
            clip: "clip-vit-b16".to_owned(),
            clip_image: None,
            clip_text: None,
        }
    }
}

impl Eyes {
    /// Refuses files and settings that the chosen segmenter and encoder would not look at.
    pub(crate) fn check(&self) -> Result<()> {
        let of_sam = [
            ("--sam-encoder", self.sam_encoder.is_some()),
            ("--sam-decoder", self.sam_decoder.is_some()),
            ("--sam-points", self.sam_points.is_some()),
            ("--sam-iou", self.sam_iou.is_some()),
            ("--sam-stability", self.sam_stability.is_some()),
        ];
        if let Some((option, _)) = of_sam.iter().find(|(_, is_set)| *is_set && self.segmenter != SegmenterKind::Sam) {
            bail!("{option} is for SAM: add --segmenter sam");
        }
        if self.encoder != EncoderKind::Clip && self.clip_image.is_some() {
            bail!("--clip-image is for CLIP: add --encoder clip");
        }
        if self.encoder == EncoderKind::Offline && self.clip_text.is_some() {
            bail!("--clip-text is for CLIP: add --encoder clip");
        }
        Ok(())
    }

    fn sam_files(&self) -> Result<[PathBuf; 2]> {
        Ok(match (&self.sam_encoder, &self.sam_decoder) {
            (Some(encoder), Some(decoder)) => [encoder.clone(), decoder.clone()],
            _ => Named::find(&self.sam)?.pair()?,
        })
    }

    /// CLIP's towers.
    pub(crate) fn clip_files(&self) -> Result<[PathBuf; 2]> {
        Ok(match (&self.clip_image, &self.clip_text) {
            (Some(image), Some(text)) => [image.clone(), text.clone()],
            (None, Some(text)) => bail!("{}: a text tower needs the image tower that belongs to it: --clip-image FILE", text.display()),
            (Some(image), None) => bail!("{}: an image tower needs the text tower that belongs to it: --clip-text FILE", image.display()),
            (None, None) => Named::find(&self.clip)?.pair()?,
        })
    }

    fn sam_config(&self) -> sam::Config {
        let preset = match self.sam_preset.unwrap_or_default() {
            SamPreset::Meta => sam::Config::default(),
            SamPreset::LangSplat => sam::Config::langsplat(),
        };
        sam::Config {
            points_per_side: self.sam_points.unwrap_or(preset.points_per_side),
            predicted_iou: self.sam_iou.unwrap_or(preset.predicted_iou),
            stability: self.sam_stability.unwrap_or(preset.stability),
            ..preset
        }
    }

    /// The segmenter.
    pub fn segmenter(&self, photos: &Path, lenses: &BTreeMap<String, Lens>) -> Result<Box<dyn Segmenter>> {
        Ok(match self.segmenter {
            SegmenterKind::Sam => {
                let [encoder, decoder] = self.sam_files()?;
                Box::new(Sam::load(&encoder, &decoder, self.sam_config())?)
            }
            SegmenterKind::Import => Box::new(Import::open(photos, lenses.clone())?),
            SegmenterKind::Offline => Box::new(OfflineSegmenter::load()?),
        })
    }

    /// The image encoder.
    pub fn encoder(&self, photos: &Path, lenses: &BTreeMap<String, Lens>) -> Result<Box<dyn Encoder>> {
        Ok(match self.encoder {
            EncoderKind::Clip => Box::new(self.clip_image()?.with_background(calibrations::best_background(&self.files()?))),
            EncoderKind::Import => Box::new(Import::open(photos, lenses.clone())?),
            EncoderKind::Offline => Box::new(Conse::load()?),
        })
    }

    /// CLIP's image tower, once the text tower is known to belong to it: a wrong pair would only show in the first query.
    pub(crate) fn clip_image(&self) -> Result<ClipImage> {
        let [image, text] = self.clip_files()?;
        let image = ClipImage::load(&image)?;
        clip::check_pair(&image, &ClipText::load(&text)?)?;
        Ok(image)
    }

    /// The text tower that belongs to the image encoder.
    pub fn text_encoder(&self) -> Result<Box<dyn TextEncoder>> {
        Ok(match (self.encoder, &self.clip_text) {
            (EncoderKind::Clip, _) => Box::new(ClipText::load(&self.clip_files()?[1])?),
            (EncoderKind::Import, Some(text)) => Box::new(ClipText::load(text)?),
            (EncoderKind::Import, None) => bail!("imported embeddings need the text tower that belongs to them: --clip-text FILE"),
            (EncoderKind::Offline, _) => Box::new(OfflineText::load()?),
        })
    }

    /// The files of the models, for the record.
    pub fn files(&self) -> Result<BTreeMap<String, ModelFile>> {
        let mut files = BTreeMap::new();
        let mut add = |role: &str, path: PathBuf| -> Result<()> {
            // Not what it links to: other files of the model lie beside the link.
            let path = std::path::absolute(&path).unwrap_or(path);
            let (bytes, sha256) = places::digest(&path)?;
            files.insert(role.to_owned(), ModelFile { path, bytes, sha256 });
            Ok(())
        };
        if self.segmenter == SegmenterKind::Sam {
            let [encoder, decoder] = self.sam_files()?;
            add("sam_encoder", encoder)?;
            add("sam_decoder", decoder)?;
        }
        match (self.encoder, &self.clip_text) {
            (EncoderKind::Clip, _) => {
                let [image, text] = self.clip_files()?;
                add("clip_image", image)?;
                add("clip_text", text)?;
            }
            (EncoderKind::Import, Some(text)) => add("clip_text", text.clone())?,
            _ => {}
        }
        Ok(files)
    }

    /// What masks depend on beside the photo; nothing where they come from files that may change unseen.
    pub fn segmenter_identity(&self) -> Result<Option<String>> {
        Ok(match self.segmenter {
            SegmenterKind::Import => None,
            SegmenterKind::Sam => {
                // SAM's own files alone: another encoder leaves the masks as they are.
                let files = self.files()?;
                let sums: Vec<&str> = files.iter().filter(|(role, _)| role.starts_with("sam")).map(|(_, f)| f.sha256.as_str()).collect();
                Some(format!("sam {} {:?} {}", sam::VERSION, self.sam_config(), sums.join(" ")))
            }
            SegmenterKind::Offline => Some(format!("offline {} {}", segmenter::VERSION, models::offline_stamp())),
        })
    }

    /// Whether masks of a level are kept.
    pub fn keeps(&self, level: Level) -> bool {
        level == Level::Whole || self.levels.iter().any(|l| l == level.name())
    }
}

/// What embeddings of a scene can be compared with: those that the same files made, with the same around the masks.
pub(crate) fn identity_of(manifest: &Manifest) -> String {
    let file = |role: &str| manifest.models.get(role).map(|file| format!("clip {} {}", file.sha256, manifest.crops).trim_end().to_owned());
    match manifest.encoder.as_str() {
        calibrations::OFFLINE => format!("offline {}", conse::VERSION),
        other => file("clip_image").or_else(|| file("clip_text")).unwrap_or_else(|| other.to_owned()),
    }
}

/// An embedding of a scene's encoder for what knows nothing but words: without the numbers that count only between examples.
pub fn for_words(manifest: &Manifest, embedding: Vec<f32>) -> Vec<f32> {
    if manifest.encoder == calibrations::OFFLINE { appearance::for_words(embedding) } else { embedding }
}

/// The numbers of an embedding that texts are compared by.
pub fn words<'a>(manifest: &Manifest, embedding: &'a mut [f32]) -> &'a mut [f32] {
    if manifest.encoder == calibrations::OFFLINE { appearance::words(embedding) } else { embedding }
}

/// Whether `embeddings` that `encoder` made, if anybody knows, can be compared with those of a scene's encoder.
pub(crate) fn is_current<'a>(manifest: &Manifest, encoder: &str, mut embeddings: impl Iterator<Item = &'a Vec<f32>>) -> bool {
    // Earlier versions did not say; of the offline encoder's the length tells.
    if encoder.is_empty() {
        manifest.encoder != calibrations::OFFLINE || embeddings.all(|e| e.len() == conse::LENGTH)
    } else {
        encoder == identity_of(manifest)
    }
}

/// Fails where the objects of a scene were embedded by another encoder than its own or an earlier version of it, with which nothing of this one can be
/// compared.
///
/// # Errors
/// One sentence with the mend.
pub fn check_version(manifest: &Manifest, grid: &Grid, folder: &SceneFolder) -> Result<()> {
    if !is_current(manifest, &grid.encoder, grid.objects.iter().flat_map(|o| &o.embeddings)) {
        let root = folder.root.display();
        bail!(
            "{root}: its objects were embedded by another encoder than the scene's, or by an earlier version of it; \
             'fastlgs train {root} --init {root}/scene.ply --iterations 0' embeds them again and keeps the Gaussians"
        );
    }
    Ok(())
}

/// The model file of a role, as the manifest remembers it.
fn remembered<'a>(manifest: &'a Manifest, role: &str) -> Result<&'a Path> {
    let what = role.replace('_', " ");
    let file = manifest.models.get(role).with_context(|| format!("the scene does not say which {what} it was made with"))?;
    let bytes = std::fs::metadata(&file.path).with_context(|| format!("the {what} of the scene, {}", file.path.display()))?.len();
    // The length first: it costs nothing.
    if bytes != file.bytes || places::digest(&file.path)?.1 != file.sha256 {
        bail!("{}: not the {what} that the scene was made with; its content is another, name the right file", file.path.display());
    }
    Ok(&file.path)
}

/// The encoder that made a scene's embeddings, for masks that come later.
pub fn encoder_of(folder: &SceneFolder, manifest: &Manifest) -> Result<Box<dyn Encoder>> {
    Ok(match manifest.encoder.as_str() {
        "offline" => Box::new(Conse::load()?),
        "clip" => Box::new(ClipImage::load(remembered(manifest, "clip_image")?)?.with_background(calibrations::background_of(manifest)?)),
        "import" => Box::new(Recorded::load(folder, manifest)?),
        other => bail!("the scene's embeddings were made by the encoder '{other}', which this program does not know"),
    })
}

/// The text tower of the encoder that made a scene's embeddings; `clip_text` stands in for a CLIP tower.
pub fn text_encoder_of(manifest: &Manifest, clip_text: Option<&Path>) -> Result<Box<dyn TextEncoder>> {
    Ok(match (manifest.encoder.as_str(), clip_text) {
        ("offline", _) => Box::new(OfflineText::load()?),
        (_, Some(path)) => Box::new(ClipText::load(path)?),
        ("clip", None) => Box::new(ClipText::load(remembered(manifest, "clip_text")?)?),
        ("import", None) if manifest.models.contains_key("clip_text") => Box::new(ClipText::load(remembered(manifest, "clip_text")?)?),
        ("import", None) => bail!("the scene's embeddings were imported: name the text tower that belongs to them with --clip-text FILE"),
        (other, None) => bail!("the scene's embeddings were made by the encoder '{other}', which this program does not know"),
    })
}

/// Imported embeddings as `preprocess` left them in the scene folder: those of the masks that fit.
struct Recorded {
    folder: SceneFolder,
    views: Vec<Camera>,
    masks: Vec<Mask>,
}

impl Recorded {
    fn load(folder: &SceneFolder, manifest: &Manifest) -> Result<Self> {
        let views = manifest.training(&folder.cameras()?);
        Ok(Self { folder: folder.clone(), views, masks: evidence::load_masks(folder)?.0 })
    }
}

impl Encoder for Recorded {
    fn name(&self) -> &'static str {
        "import"
    }

    fn embed_masks(&self, view: &str, _photo: &RgbImage, masks: &LabelMap) -> fastlgs_vision::Result<Vec<Vec<f32>>> {
        let index = self.views.iter().position(|camera| camera.name == view);
        let Some(camera) = index.map(|i| &self.views[i]) else {
            return Err(fastlgs_vision::Error::Missing(format!("the view '{view}' is none of the training")));
        };
        let mut whole = MaskList::new(camera.width, camera.height);
        let labels = whole.add(Level::Whole, &self.folder.masks(camera)?.painted(Level::Whole));
        let row = |label: u16| self.masks.iter().find(|m| Some(m.view) == index && m.label == label).map(|m| m.embedding.clone());
        let dimension = self.masks.first().map_or(0, |m| m.embedding.len());
        let fitting = import::fitting(masks, &whole).into_iter();
        Ok(fitting.map(|place| place.and_then(|p| row(labels[p])).unwrap_or_else(|| vec![0.0; dimension])).collect())
    }
}
