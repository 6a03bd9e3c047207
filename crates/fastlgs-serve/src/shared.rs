//! State that all requests share.

use crate::failure::Failure;
use crate::live::Live;
use crate::scene_worker::SceneHandle;
use anyhow::Result;
use axum::http::StatusCode;
use fastlgs_core::{Camera, SceneFolder};
use serde_json::{Value, json};
use std::sync::{Arc, OnceLock, PoisonError, RwLock};

/// State that all requests share.
pub struct AppState {
    pub name: String,
    pub folder: SceneFolder,
    /// Current cameras; training may move them.
    pub cameras: RwLock<Arc<Vec<Camera>>>,
    /// The training run, if the scene is trained by this process.
    pub live: Option<Arc<Live>>,
    /// Handle of the scene worker, once the scene is opened.
    pub scene_handle: OnceLock<SceneHandle>,
    /// Distance from each camera to its subject, in scene units.
    pub focus: OnceLock<Vec<f32>>,
}

impl AppState {
    /// Returns the handle of the scene worker, or `None` during training.
    pub fn scene_handle(&self) -> Option<SceneHandle> {
        self.scene_handle.get().cloned()
    }

    /// Returns the handle of the scene worker.
    ///
    /// # Errors
    /// Status 409 during training.
    pub fn ready(&self) -> Result<SceneHandle, Failure> {
        self.scene_handle().ok_or_else(|| {
            Failure::new(
                StatusCode::CONFLICT,
                "the scene is still in training; try again when its objects are found",
            )
        })
    }

    /// Returns the current cameras.
    pub fn cameras(&self) -> Arc<Vec<Camera>> {
        self.cameras
            .read()
            .unwrap_or_else(PoisonError::into_inner)
            .clone()
    }

    /// Describes all views for the page.
    pub fn views(&self) -> Result<Vec<Value>> {
        views(
            &self.folder,
            &self.cameras(),
            self.focus.get().map_or(&[], Vec::as_slice),
        )
    }
}

/// Describes views for the page. `focus` has the distance from each camera to its subject; 1 if
/// missing.
pub fn views(folder: &SceneFolder, cameras: &[Camera], focus: &[f32]) -> Result<Vec<Value>> {
    let manifest = folder.manifest()?;
    let view = |(k, camera): (usize, &Camera)| {
        let mut value = serde_json::to_value(camera)?;
        value["held_out"] = json!(manifest.is_held_out(k, &camera.name));
        value["photo"] = json!(folder.photo_path(&camera.name).is_file());
        value["focus"] = json!(focus.get(k).copied().unwrap_or(1.0));
        Ok(value)
    };
    cameras.iter().enumerate().map(view).collect()
}
