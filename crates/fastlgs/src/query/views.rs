//! Options that select cameras.

use crate::Result;
use crate::error::bail;
use fastlgs_core::{Camera, SceneFolder, camera_path};
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// Selection of cameras.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
#[cfg_attr(feature = "clap", derive(clap::Args))]
pub struct ViewChoice {
    /// Use the view of this photo.
    #[cfg_attr(feature = "clap", arg(long, value_name = "NAME"))]
    pub view: Option<String>,
    /// Use all views of the scene.
    #[cfg_attr(feature = "clap", arg(long, conflicts_with = "view"))]
    pub all_views: bool,
    /// Use the camera in a JSON file with name, width, height, fx, fy, cx, cy and world_to_camera
    /// (16 numbers, column-major).
    #[cfg_attr(feature = "clap", arg(long, value_name = "FILE", conflicts_with_all = ["view", "all_views"]))]
    pub camera: Option<PathBuf>,
    /// Use all frames of a camera path that the nerfstudio viewer saved.
    #[cfg_attr(feature = "clap", arg(long, value_name = "FILE", conflicts_with_all = ["view", "all_views", "camera"]))]
    pub path: Option<PathBuf>,
    /// Size of the images in pixels, such as 640x480.
    #[cfg_attr(feature = "clap", arg(long, value_name = "WxH", value_parser = parse_size))]
    pub size: Option<(u32, u32)>,
}

impl ViewChoice {
    /// Returns whether any option is set.
    pub fn is_given(&self) -> bool {
        self.all_views
            || self.view.is_some()
            || self.camera.is_some()
            || self.path.is_some()
            || self.size.is_some()
    }

    /// Returns the selected cameras in the selected size; by default the first view.
    ///
    /// # Errors
    /// An unknown view, a damaged camera file, or a scene without views.
    pub fn cameras(&self, folder: &SceneFolder, scene_cameras: &[Camera]) -> Result<Vec<Camera>> {
        let frame = || Ok::<_, crate::Error>(folder.manifest()?.frame);
        let chosen = if let Some(path) = &self.camera {
            vec![Camera::load(path, &frame()?)?]
        } else if let Some(path) = &self.path {
            camera_path::read(path, &frame()?)?
        } else if self.all_views {
            scene_cameras.to_vec()
        } else if let Some(name) = &self.view {
            vec![scene_cameras[folder.view_index(scene_cameras, name)?].clone()]
        } else {
            scene_cameras.first().cloned().into_iter().collect()
        };
        if chosen.is_empty() {
            bail!("{}: the scene has no views", folder.root.display());
        }
        Ok(chosen
            .into_iter()
            .map(|c| self.size.map_or(c.clone(), |(w, h)| c.resized(w, h)))
            .collect())
    }
}

/// Parses a size such as `640x480` into width and height.
///
/// # Errors
/// Another text, or a side outside of 1 to 16,384 pixels.
pub fn parse_size(text: &str) -> Result<(u32, u32), String> {
    let sizes = text
        .split_once('x')
        .and_then(|(w, h)| Some((w.parse().ok()?, h.parse().ok()?)));
    sizes
        .filter(|(w, h)| (1..=16384).contains(w) && (1..=16384).contains(h))
        .ok_or_else(|| {
            format!("'{text}' is not a size such as 640x480, with sides of 1 to 16384 pixels")
        })
}
