//! What all requests share.

use crate::desk::Bell;
use crate::failure::Failure;
use crate::live::Live;
use anyhow::Result;
use axum::http::StatusCode;
use fastlgs_core::{Camera, SceneFolder};
use serde_json::{Value, json};
use std::sync::{Arc, OnceLock, PoisonError, RwLock};

/// What all requests share.
pub struct Shared {
    pub name: String,
    pub folder: SceneFolder,
    /// As training left them so far.
    pub cameras: RwLock<Arc<Vec<Camera>>>,
    pub live: Option<Arc<Live>>,
    pub bell: OnceLock<Bell>,
    pub focus: OnceLock<Vec<f32>>,
}

impl Shared {
    /// The opened scene, once there is one.
    pub fn bell(&self) -> Option<Bell> {
        self.bell.get().cloned()
    }

    /// The opened scene, or why there is none yet.
    pub fn ready(&self) -> Result<Bell, Failure> {
        self.bell().ok_or_else(|| Failure::new(StatusCode::CONFLICT, "the scene is still in training; ask again when it has objects"))
    }

    /// The cameras that the scene has now.
    pub fn cameras(&self) -> Arc<Vec<Camera>> {
        self.cameras.read().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// All views as the page wants them.
    pub fn views(&self) -> Result<Vec<Value>> {
        views(&self.folder, &self.cameras(), self.focus.get().map_or(&[], Vec::as_slice))
    }
}

/// All views as the page wants them. `focus` is how far what each looks at is, where that is known.
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
