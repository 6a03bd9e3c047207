//! Choice of segmenter and encoders: options of `preprocess`, afterwards read from `scene.json`.

use crate::error::{Context, bail};
use crate::{Error, Result, calibrations};
use fastlgs_core::scene_folder::{Manifest, ModelFile};
use fastlgs_core::{Camera, LabelMap, Level, MaskList, SceneFolder};
use fastlgs_grid::mapping::Mask;
use fastlgs_grid::{Grid, mask_pairs};
use fastlgs_vision::crops::Background;
use fastlgs_vision::import::{self, Import, Lens};
use fastlgs_vision::pull::ModelPair;
use fastlgs_vision::sam::{self, Sam};
use fastlgs_vision::{
    ClipImage, ClipText, Conse, Encoder, OfflineSegmenter, OfflineText, Segmenter, TextEncoder,
    appearance, clip, conse, model_paths, models, segmenter,
};
use image::RgbImage;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Segmenter, which finds masks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
pub enum SegmenterKind {
    /// Learned edges, merged into regions.
    #[default]
    Offline,
    /// SAM, from ONNX files.
    Sam,
    /// Masks of other programs beside the photos; docs/reference/formats.md lists the layouts.
    Import,
}

impl SegmenterKind {
    /// Returns the name in `scene.json`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Offline => "offline",
            Self::Sam => "sam",
            Self::Import => "import",
        }
    }
}

/// Settings with which SAM segments a photo.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
pub enum SamPreset {
    /// As in the generator of its authors: predicted IoU 0.88, stability 0.95, no crops.
    #[default]
    Meta,
    /// As in LangSplat, whose masks the paper uses: predicted IoU 0.7, stability 0.85, one layer of
    /// crops. Masks of one level neither repeat nor contain each other.
    #[cfg_attr(feature = "clap", value(name = "langsplat"))]
    LangSplat,
}

/// Encoder, which embeds masks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
pub enum EncoderKind {
    /// A classifier of 1,000 classes, and a sentence encoder.
    #[default]
    Offline,
    /// CLIP, from ONNX files.
    Clip,
    /// Embeddings of other programs beside the photos.
    Import,
}

impl EncoderKind {
    /// Returns the name in `scene.json`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Offline => "offline",
            Self::Clip => "clip",
            Self::Import => "import",
        }
    }
}

/// Segmenter and encoder of `preprocess`.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(default)]
#[cfg_attr(feature = "clap", derive(clap::Args))]
pub struct ModelChoice {
    /// Segmenter, which finds masks.
    #[cfg_attr(feature = "clap", arg(long, value_enum, default_value_t))]
    pub segmenter: SegmenterKind,
    /// Encoder, which embeds masks.
    #[cfg_attr(feature = "clap", arg(long, value_enum, default_value_t))]
    pub encoder: EncoderKind,
    /// Levels of masks to keep, separated by commas. Whole masks are always kept; Algorithm 1 uses
    /// only those.
    #[cfg_attr(feature = "clap", arg(long, value_delimiter = ',', default_value = "whole,part,subpart", value_parser = ["whole", "part", "subpart"]))]
    pub levels: Vec<String>,
    /// SAM model, by its name in `models pull`.
    #[cfg_attr(
        feature = "clap",
        arg(long, default_value = "slimsam", value_name = "NAME")
    )]
    pub sam: String,
    /// ONNX file of SAM's image encoder, instead of --sam.
    #[cfg_attr(
        feature = "clap",
        arg(long, value_name = "FILE", requires = "sam_decoder")
    )]
    pub sam_encoder: Option<PathBuf>,
    /// ONNX file of SAM's prompt decoder, instead of --sam.
    #[cfg_attr(
        feature = "clap",
        arg(long, value_name = "FILE", requires = "sam_encoder")
    )]
    pub sam_decoder: Option<PathBuf>,
    /// Settings with which SAM segments a photo. Default: meta, but langsplat with `make --effort
    /// like-paper`.
    #[cfg_attr(feature = "clap", arg(long, value_enum))]
    pub sam_preset: Option<SamPreset>,
    /// Number of point prompts along each side of a photo, instead of the preset's 32.
    #[cfg_attr(feature = "clap", arg(long, value_parser = clap::value_parser!(u32).range(1..=128)))]
    pub sam_points: Option<u32>,
    /// Least predicted IoU of SAM's masks, instead of the preset's.
    #[cfg_attr(feature = "clap", arg(long))]
    pub sam_iou: Option<f32>,
    /// Least stability of SAM's masks, instead of the preset's.
    #[cfg_attr(feature = "clap", arg(long))]
    pub sam_stability: Option<f32>,
    /// CLIP model, by its name in `models pull`.
    #[cfg_attr(
        feature = "clap",
        arg(long, default_value = "clip-vit-b16", value_name = "NAME")
    )]
    pub clip: String,
    /// ONNX file of CLIP's image tower, instead of --clip.
    #[cfg_attr(
        feature = "clap",
        arg(long, value_name = "FILE", requires = "clip_text")
    )]
    pub clip_image: Option<PathBuf>,
    /// ONNX file of CLIP's text tower, instead of --clip. With imported embeddings: the tower that
    /// belongs to them.
    #[cfg_attr(feature = "clap", arg(long, value_name = "FILE"))]
    pub clip_text: Option<PathBuf>,
    /// Pixels around a mask in its crop for CLIP: grey, black, the blurred photo, or the photo
    /// itself with a margin. Default: the best one by `models calibrate`, else grey; black with
    /// `make --effort like-paper`.
    #[cfg_attr(feature = "clap", arg(long, value_parser = background_parser()))]
    pub crops: Option<Background>,
}

/// Parses the name of a background.
#[cfg(feature = "clap")]
fn background_parser() -> impl clap::builder::TypedValueParser<Value = Background> {
    use clap::builder::{PossibleValuesParser, TypedValueParser};
    PossibleValuesParser::new(Background::NAMES)
        .map(|name| Background::by_name(&name).unwrap_or_default())
}

impl Default for ModelChoice {
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
            crops: None,
        }
    }
}

impl ModelChoice {
    /// Checks that no option is set that the chosen segmenter and encoder ignore.
    pub(crate) fn check(&self) -> Result<()> {
        let of_sam = [
            ("sam_encoder", self.sam_encoder.is_some()),
            ("sam_decoder", self.sam_decoder.is_some()),
            ("sam_points", self.sam_points.is_some()),
            ("sam_iou", self.sam_iou.is_some()),
            ("sam_stability", self.sam_stability.is_some()),
        ];
        if let Some((option, _)) = of_sam
            .into_iter()
            .find(|(_, is_set)| *is_set && self.segmenter != SegmenterKind::Sam)
        {
            return Err(Error::option(
                option,
                "this is for SAM; set segmenter to sam",
            ));
        }
        let for_clip = "this is for CLIP; set encoder to clip";
        if self.encoder != EncoderKind::Clip && self.clip_image.is_some() {
            return Err(Error::option("clip_image", for_clip));
        }
        if self.encoder != EncoderKind::Clip && self.crops.is_some() {
            return Err(Error::option("crops", for_clip));
        }
        if self.encoder == EncoderKind::Offline && self.clip_text.is_some() {
            return Err(Error::option("clip_text", for_clip));
        }
        Ok(())
    }

    fn sam_files(&self) -> Result<[PathBuf; 2]> {
        Ok(match (&self.sam_encoder, &self.sam_decoder) {
            (Some(encoder), Some(decoder)) => [encoder.clone(), decoder.clone()],
            _ => ModelPair::find(&self.sam)?.pair()?,
        })
    }

    /// Returns the files of CLIP's image and text tower.
    pub(crate) fn clip_files(&self) -> Result<[PathBuf; 2]> {
        Ok(match (&self.clip_image, &self.clip_text) {
            (Some(image), Some(text)) => [image.clone(), text.clone()],
            (None, Some(text)) => {
                return Err(Error::option(
                    "clip_image",
                    format!("name the image tower that belongs to {}", text.display()),
                ));
            }
            (Some(image), None) => {
                return Err(Error::option(
                    "clip_text",
                    format!("name the text tower that belongs to {}", image.display()),
                ));
            }
            (None, None) => ModelPair::find(&self.clip)?.pair()?,
        })
    }

    fn sam_config(&self) -> sam::SamConfig {
        let preset = match self.sam_preset.unwrap_or_default() {
            SamPreset::Meta => sam::SamConfig::default(),
            SamPreset::LangSplat => sam::SamConfig::langsplat(),
        };
        sam::SamConfig {
            points_per_side: self.sam_points.unwrap_or(preset.points_per_side),
            predicted_iou: self.sam_iou.unwrap_or(preset.predicted_iou),
            stability: self.sam_stability.unwrap_or(preset.stability),
            ..preset
        }
    }

    /// Loads the segmenter. Imported masks are read beside `photos` and undistorted by `lenses`.
    pub fn segmenter(
        &self,
        photos: &Path,
        lenses: &BTreeMap<String, Lens>,
    ) -> Result<Box<dyn Segmenter>> {
        Ok(match self.segmenter {
            SegmenterKind::Sam => {
                let [encoder, decoder] = self.sam_files()?;
                Box::new(Sam::load(&encoder, &decoder, self.sam_config())?)
            }
            SegmenterKind::Import => Box::new(Import::open(photos, lenses.clone())?),
            SegmenterKind::Offline => Box::new(OfflineSegmenter::load()?),
        })
    }

    /// Loads the image encoder. Imported embeddings are read beside `photos`.
    pub fn encoder(
        &self,
        photos: &Path,
        lenses: &BTreeMap<String, Lens>,
    ) -> Result<Box<dyn Encoder>> {
        Ok(match self.encoder {
            EncoderKind::Clip => Box::new(
                self.clip_image()?
                    .with_background(self.background(&self.files()?)),
            ),
            EncoderKind::Import => Box::new(Import::open(photos, lenses.clone())?),
            EncoderKind::Offline => Box::new(Conse::load()?),
        })
    }

    /// Returns the background around masks in crops. `files` are the model files.
    pub(crate) fn background(&self, files: &BTreeMap<String, ModelFile>) -> Background {
        self.crops
            .unwrap_or_else(|| calibrations::best_background(files))
    }

    /// Loads CLIP's image tower, after checking that the text tower belongs to it. Otherwise a
    /// wrong pair is noticed only at the first query.
    pub(crate) fn clip_image(&self) -> Result<ClipImage> {
        let [image, text] = self.clip_files()?;
        let image = ClipImage::load(&image)?;
        clip::check_pair(&image, &ClipText::load(&text)?)?;
        Ok(image)
    }

    /// Loads the text tower that belongs to the image encoder.
    pub fn text_encoder(&self) -> Result<Box<dyn TextEncoder>> {
        Ok(match (self.encoder, &self.clip_text) {
            (EncoderKind::Clip, _) => Box::new(ClipText::load(&self.clip_files()?[1])?),
            (EncoderKind::Import, Some(text)) => Box::new(ClipText::load(text)?),
            (EncoderKind::Import, None) => {
                return Err(Error::option(
                    "clip_text",
                    "name the text tower that belongs to the imported embeddings",
                ));
            }
            (EncoderKind::Offline, _) => Box::new(OfflineText::load()?),
        })
    }

    /// Returns the model files by role, as the manifest records them.
    pub fn files(&self) -> Result<BTreeMap<String, ModelFile>> {
        let mut files = BTreeMap::new();
        let mut add = |role: &str, path: PathBuf| -> Result<()> {
            // Do not resolve links: other files of the model lie beside the link.
            let path = std::path::absolute(&path).unwrap_or(path);
            let (bytes, sha256) = model_paths::digest(&path)?;
            files.insert(
                role.to_owned(),
                ModelFile {
                    path,
                    bytes,
                    sha256,
                },
            );
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

    /// Returns a text that identifies the segmenter, its settings and its model files, for cache
    /// keys. Returns `None` for imported masks, whose files can change at any time.
    pub fn segmenter_identity(&self) -> Result<Option<String>> {
        Ok(match self.segmenter {
            SegmenterKind::Import => None,
            SegmenterKind::Sam => {
                // Only the files of SAM: masks do not depend on the encoder.
                let files = self.files()?;
                let sums: Vec<&str> = files
                    .iter()
                    .filter(|(role, _)| role.starts_with("sam"))
                    .map(|(_, f)| f.sha256.as_str())
                    .collect();
                Some(format!(
                    "sam {} {:?} {}",
                    sam::VERSION,
                    self.sam_config(),
                    sums.join(" ")
                ))
            }
            SegmenterKind::Offline => Some(format!(
                "offline {} {}",
                segmenter::VERSION,
                models::offline_stamp()
            )),
        })
    }

    /// Returns whether masks of a level are kept.
    pub fn keeps(&self, level: Level) -> bool {
        level == Level::Whole || self.levels.iter().any(|l| l == level.name())
    }
}

/// Returns the identity of the encoder of a scene. Embeddings are comparable if they have the same
/// identity: same model files, same background around masks.
pub(crate) fn identity_of(manifest: &Manifest) -> String {
    let file = |role: &str| {
        manifest.models.get(role).map(|file| {
            format!("clip {} {}", file.sha256, manifest.crops)
                .trim_end()
                .to_owned()
        })
    };
    match manifest.encoder.as_str() {
        calibrations::OFFLINE => format!("offline {}", conse::VERSION),
        other => file("clip_image")
            .or_else(|| file("clip_text"))
            .unwrap_or_else(|| other.to_owned()),
    }
}

/// Returns an embedding for comparisons with texts: components that count only between pictures are
/// set to 0.
pub fn for_texts(manifest: &Manifest, embedding: Vec<f32>) -> Vec<f32> {
    if manifest.encoder == calibrations::OFFLINE {
        appearance::without_appearance(embedding)
    } else {
        embedding
    }
}

/// Returns the components of an embedding that are compared with texts.
pub fn text_components<'a>(manifest: &Manifest, embedding: &'a mut [f32]) -> &'a mut [f32] {
    if manifest.encoder == calibrations::OFFLINE {
        appearance::text_part(embedding)
    } else {
        embedding
    }
}

/// Returns whether `embeddings` are comparable with those of a scene's encoder. `encoder` is the
/// identity of the encoder that made them; empty if unknown.
pub(crate) fn is_current<'a>(
    manifest: &Manifest,
    encoder: &str,
    mut embeddings: impl Iterator<Item = &'a Vec<f32>>,
) -> bool {
    // Without an identity, only embeddings of the offline encoder can be checked, by their length.
    if encoder.is_empty() {
        manifest.encoder != calibrations::OFFLINE || embeddings.all(|e| e.len() == conse::LENGTH)
    } else {
        encoder == identity_of(manifest)
    }
}

/// Checks that the encoder of a scene made the embeddings of its objects.
///
/// # Errors
/// Another encoder, or another version of it, made them, so that they are not comparable.
pub fn check_version(manifest: &Manifest, grid: &Grid, folder: &SceneFolder) -> Result<()> {
    if !is_current(
        manifest,
        &grid.encoder,
        grid.objects.iter().flat_map(|o| &o.embeddings),
    ) {
        let root = folder.root.display();
        bail!(
            "{root}: its objects were embedded by another encoder, or by another version of the encoder; \
             train it again with init set to {root}/scene.ply and iterations to 0, which keeps the Gaussians"
        );
    }
    Ok(())
}

/// Returns the model file of a role in the manifest.
///
/// # Errors
/// The manifest names none, or size or SHA-256 of the file differ.
fn recorded_model<'a>(manifest: &'a Manifest, role: &str) -> Result<&'a Path> {
    let what = role.replace('_', " ");
    let file = manifest.models.get(role).with_context(|| format!("scene.json does not name the {what} that the scene was made with; run 'fastlgs preprocess' again"))?;
    let bytes = std::fs::metadata(&file.path)
        .with_context(|| {
            format!(
                "{}: the {what} of the scene cannot be opened",
                file.path.display()
            )
        })?
        .len();
    // Compare the size first, because hashing is slow.
    if bytes != file.bytes || model_paths::digest(&file.path)?.1 != file.sha256 {
        bail!(
            "{}: this is not the {what} that the scene was made with, because its content differs; restore the original file",
            file.path.display()
        );
    }
    Ok(&file.path)
}

/// Loads the encoder that made a scene's embeddings, to embed more masks.
pub fn encoder_of(folder: &SceneFolder, manifest: &Manifest) -> Result<Box<dyn Encoder>> {
    Ok(match manifest.encoder.as_str() {
        "offline" => Box::new(Conse::load()?),
        "clip" => Box::new(
            ClipImage::load(recorded_model(manifest, "clip_image")?)?
                .with_background(calibrations::background_of(manifest)?),
        ),
        "import" => Box::new(ImportedEmbeddings::load(folder, manifest)?),
        other => bail!(
            "the embeddings of the scene come from the encoder '{other}', which this version does not know; update FastLGS"
        ),
    })
}

/// Checks that a text tower has the content of the one that the manifest records, if it records one.
///
/// # Errors
/// Another content. Its embeddings may have the same length, but mean something else.
fn check_text_tower(manifest: &Manifest, path: &Path) -> Result<()> {
    let Some(recorded) = manifest.models.get("clip_text") else {
        return Ok(());
    };
    if model_paths::digest(path)?.1 != recorded.sha256 {
        return Err(Error::option(
            "clip_text",
            format!(
                "{} is not the text tower that belongs to the embeddings of the scene, which was {}; name a copy of that \
                 file, or run 'fastlgs preprocess' again with the new tower",
                path.display(),
                recorded.path.display()
            ),
        ));
    }
    Ok(())
}

/// Loads the text tower of the encoder that made a scene's embeddings. `clip_text` replaces the
/// CLIP tower that the manifest names.
pub fn text_encoder_of(
    manifest: &Manifest,
    clip_text: Option<&Path>,
) -> Result<Box<dyn TextEncoder>> {
    Ok(match (manifest.encoder.as_str(), clip_text) {
        ("offline", _) => Box::new(OfflineText::load()?),
        (_, Some(path)) => {
            check_text_tower(manifest, path)?;
            Box::new(ClipText::load(path)?)
        }
        ("clip", None) => Box::new(ClipText::load(recorded_model(manifest, "clip_text")?)?),
        ("import", None) if manifest.models.contains_key("clip_text") => {
            Box::new(ClipText::load(recorded_model(manifest, "clip_text")?)?)
        }
        ("import", None) => {
            return Err(Error::option(
                "clip_text",
                "name the text tower that belongs to the imported embeddings of the scene",
            ));
        }
        (other, None) => bail!(
            "the embeddings of the scene come from the encoder '{other}', which this version does not know; update FastLGS"
        ),
    })
}

/// Encoder that returns the imported embeddings in the scene folder. Each mask gets the embedding
/// of the imported mask that matches it best.
struct ImportedEmbeddings {
    folder: SceneFolder,
    views: Vec<Camera>,
    masks: Vec<Mask>,
}

impl ImportedEmbeddings {
    fn load(folder: &SceneFolder, manifest: &Manifest) -> Result<Self> {
        let views = manifest.training(&folder.cameras()?);
        Ok(Self {
            folder: folder.clone(),
            views,
            masks: mask_pairs::load_masks(folder)?.0,
        })
    }
}

impl Encoder for ImportedEmbeddings {
    fn embed_masks(
        &self,
        view: &str,
        _photo: &RgbImage,
        masks: &LabelMap,
    ) -> fastlgs_vision::Result<Vec<Vec<f32>>> {
        let index = self.views.iter().position(|camera| camera.name == view);
        let Some(camera) = index.map(|i| &self.views[i]) else {
            return Err(fastlgs_vision::Error::Missing(format!(
                "the view '{view}' is not a training view"
            )));
        };
        let mut whole = MaskList::new(camera.width, camera.height);
        let labels = whole.add(
            Level::Whole,
            &self.folder.masks(camera)?.painted(Level::Whole),
        );
        let row = |label: u16| {
            self.masks
                .iter()
                .find(|m| Some(m.view) == index && m.label == label)
                .map(|m| m.embedding.clone())
        };
        let dimension = self.masks.first().map_or(0, |m| m.embedding.len());
        let fitting = import::best_matches(masks, &whole).into_iter();
        Ok(fitting
            .map(|place| {
                place
                    .and_then(|p| row(labels[p]))
                    .unwrap_or_else(|| vec![0.0; dimension])
            })
            .collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn options_of_models_that_are_not_chosen_are_refused_by_name() {
        let refused = |choice: ModelChoice| match choice.check() {
            Err(Error::Option { option, .. }) => option,
            other => panic!("{other:?}"),
        };
        let points = ModelChoice {
            sam_points: Some(8),
            ..ModelChoice::default()
        };
        assert_eq!(refused(points), "sam_points");
        let image = ModelChoice {
            clip_image: Some("a.onnx".into()),
            ..ModelChoice::default()
        };
        assert_eq!(refused(image.clone()), "clip_image");
        let alone = ModelChoice {
            encoder: EncoderKind::Clip,
            ..image
        };
        assert!(alone.check().is_ok());
        let missing = alone.clip_files().unwrap_err().to_string();
        assert!(missing.contains("clip_text") && missing.contains("a.onnx"));
    }
}
