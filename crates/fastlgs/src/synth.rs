//! Generates scenes with exact poses, depths and masks.

use crate::error::{Context, bail};
#[cfg(feature = "clap")]
use crate::query::parse_size;
use crate::{Result, Run};
use fastlgs_synth::{KINDS, Kind, Masks};
use fastlgs_vision::models;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// Options of a generated scene.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(default)]
#[cfg_attr(feature = "clap", derive(clap::Args))]
pub struct SynthConfig {
    /// Kind of scene.
    #[cfg_attr(feature = "clap", arg(value_parser = kinds()))]
    pub kind: String,
    /// Output folder of images/, transforms.json, masks/, depth/ and labels/.
    #[cfg_attr(feature = "clap", arg(short, long))]
    pub output: PathBuf,
    /// Number of photos; by default 40 for most kinds.
    #[cfg_attr(feature = "clap", arg(long))]
    pub views: Option<usize>,
    /// Size of the photos in pixels.
    #[cfg_attr(feature = "clap", arg(long, default_value = "320x240", value_parser = parse_size))]
    pub size: (u32, u32),
    /// Folder of the pictures in the room, instead of the installed ones.
    #[cfg_attr(feature = "clap", arg(long))]
    pub pictures: Option<PathBuf>,
    /// Write overlapping masks of objects and their parts as COCO lists, instead of label maps of
    /// three levels.
    #[cfg_attr(feature = "clap", arg(long))]
    pub mask_lists: bool,
    /// Leave out the object of this name, as ground truth for `remove`.
    #[cfg_attr(feature = "clap", arg(long, value_name = "NAME"))]
    pub without: Option<String>,
    /// Label every N-th view, so that it can be held out.
    #[cfg_attr(feature = "clap", arg(long, default_value_t = SynthConfig::default().holdout))]
    pub holdout: usize,
}

impl Default for SynthConfig {
    fn default() -> Self {
        Self {
            kind: KINDS[0].0.to_owned(),
            output: PathBuf::new(),
            views: None,
            size: (320, 240),
            without: None,
            pictures: None,
            mask_lists: false,
            holdout: 8,
        }
    }
}

#[cfg(feature = "clap")]
fn kinds() -> Vec<clap::builder::PossibleValue> {
    KINDS
        .iter()
        .map(|(name, _, about)| clap::builder::PossibleValue::new(name).help(about))
        .collect()
}

/// Report of `synth`.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct SynthReport {
    /// Kind of scene.
    pub kind: String,
    /// Folder of the photos.
    pub photos: PathBuf,
    /// Number of photos.
    pub views: usize,
    /// Size of the photos, as `WIDTHxHEIGHT` in pixels.
    pub size: String,
    /// Names of the objects in the scene.
    pub objects: Vec<String>,
}

/// Writes a generated scene.
///
/// # Errors
/// An unknown kind, fewer than four views, missing pictures, or a file that cannot be written.
pub fn synth(config: &SynthConfig, run: &Run) -> Result<SynthReport> {
    let kind = Kind::of(&config.kind).with_context(|| {
        format!(
            "'{}' is not a kind of generated scene; the kinds are {}",
            config.kind,
            KINDS.map(|kind| kind.0).join(", ")
        )
    })?;
    let views = config.views.unwrap_or(kind.views());
    if views < 4 {
        bail!("the number of views is {views}, but at least 4 are needed");
    }
    let pictures = config.pictures.clone().unwrap_or_else(models::pictures_dir);
    let mut world = kind.world(&pictures, views, config.size, run.seed)?;
    if let Some(name) = config.without.as_ref().filter(|name| !world.remove(name)) {
        bail!(
            "without: '{name}' is none of the objects of this scene: {}",
            world.names().join(", ")
        );
    }
    let work = run.work("synth", views as u64);
    let masks = if config.mask_lists {
        Masks::Lists
    } else {
        Masks::Levels
    };
    fastlgs_synth::write(&config.output, &world, config.holdout, masks, || {
        drop(work.advance())
    })?;
    work.check()?;
    Ok(SynthReport {
        kind: config.kind.clone(),
        photos: config.output.clone(),
        views,
        size: format!("{}x{}", config.size.0, config.size.1),
        objects: world.names().into_iter().map(str::to_owned).collect(),
    })
}
