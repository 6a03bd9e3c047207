//! Which cameras a question or a picture is for.

use crate::Result;
use crate::error::bail;
use fastlgs_core::{Camera, SceneFolder, camera_path};
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// Which cameras a command works on.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
#[cfg_attr(feature = "clap", derive(clap::Args))]
pub struct ViewChoice {
    /// A view of the scene by its photo's name.
    #[cfg_attr(feature = "clap", arg(long, value_name = "NAME"))]
    pub view: Option<String>,
    /// All views of the scene.
    #[cfg_attr(feature = "clap", arg(long, conflicts_with = "view"))]
    pub all_views: bool,
    /// A camera file: JSON with name, width, height, fx, fy, cx, cy and world_to_camera (16 numbers, column-major).
    #[cfg_attr(feature = "clap", arg(long, value_name = "FILE", conflicts_with_all = ["view", "all_views"]))]
    pub camera: Option<PathBuf>,
    /// A camera path as nerfstudio's viewer saves it: every frame is rendered.
    #[cfg_attr(feature = "clap", arg(long, value_name = "FILE", conflicts_with_all = ["view", "all_views", "camera"]))]
    pub path: Option<PathBuf>,
    /// Size of the pictures, as WIDTHxHEIGHT.
    #[cfg_attr(feature = "clap", arg(long, value_name = "WxH", value_parser = parse_size))]
    pub size: Option<(u32, u32)>,
}

impl ViewChoice {
    /// Whether anything was chosen.
    pub fn is_given(&self) -> bool {
        self.all_views || self.view.is_some() || self.camera.is_some() || self.path.is_some() || self.size.is_some()
    }

    /// The cameras; the first view where nothing was chosen.
    ///
    /// # Errors
    /// An unknown view, a damaged camera file, or a scene without views.
    pub fn cameras(&self, folder: &SceneFolder, known: &[Camera]) -> Result<Vec<Camera>> {
        let frame = || Ok::<_, crate::Error>(folder.manifest()?.frame);
        let chosen = if let Some(path) = &self.camera {
            vec![Camera::load(path, &frame()?)?]
        } else if let Some(path) = &self.path {
            camera_path::read(path, &frame()?)?
        } else if self.all_views {
            known.to_vec()
        } else if let Some(name) = &self.view {
            vec![known[folder.view_index(known, name)?].clone()]
        } else {
            known.first().cloned().into_iter().collect()
        };
        if chosen.is_empty() {
            bail!("{}: the scene has no views", folder.root.display());
        }
        Ok(chosen.into_iter().map(|c| self.size.map_or(c.clone(), |(w, h)| c.resized(w, h))).collect())
    }
}

/// Parses `640x480`.
///
/// # Errors
/// Anything that is no size of 1 to 16,384 pixels a side.
pub fn parse_size(text: &str) -> Result<(u32, u32), String> {
    let sizes = text.split_once('x').and_then(|(w, h)| Some((w.parse().ok()?, h.parse().ok()?)));
    sizes.filter(|(w, h)| (1..=16384).contains(w) && (1..=16384).contains(h)).ok_or_else(|| format!("'{text}' is not a size like 640x480"))
}
