//! Learned edges: HED (Xie & Tu 2015).

use crate::runtime::{Array, Model};
use crate::{Result, model_paths};
use image::RgbImage;

/// Mean of the training pictures, BGR in [0, 255].
const MEAN_BGR: [f32; 3] = [103.939, 116.779, 123.68];

/// The edge detector.
pub struct Hed(Model);

impl Hed {
    /// Loads the model from the cache folder.
    ///
    /// # Errors
    /// When it is not installed.
    pub fn load() -> Result<Self> {
        Ok(Self(Model::load_for_each_core(
            &model_paths::offline_dir().join("edges8.onnx"),
        )?))
    }

    /// Returns the edge probability of each pixel, row-major.
    ///
    /// # Errors
    /// When inference fails.
    pub fn edges(&self, photo: &RgbImage) -> Result<Vec<f32>> {
        let (w, h) = (photo.width() as usize, photo.height() as usize);
        let mut data = vec![0.0; 3 * w * h];
        for (i, pixel) in photo.pixels().enumerate() {
            for k in 0..3 {
                data[k * w * h + i] = f32::from(pixel[2 - k]) - MEAN_BGR[k];
            }
        }
        Ok(self
            .0
            .run(vec![("image", Array::new([1, 3, h, w], data))], &["edge"])?
            .remove(0)
            .values)
    }
}
