//! Inpainters: compute colours for the parts of pictures that no photo shows.

use crate::runtime::{Array, Model};
use crate::{Error, Result};
use fastlgs_core::image_io;
use image::{GrayImage, Luma};
use std::path::Path;

/// Fills holes of pictures.
pub trait Inpainter {
    /// Fills the pixels of `hole` with colours that continue their surroundings. `colors`:
    /// `[3][height][width]`, 0 to 1; `hole`: `[height][width]`.
    ///
    /// # Errors
    /// When the inpainter rejects the picture.
    fn fill(&self, colors: &mut [f32], hole: &[bool], width: u32) -> Result<()>;
}

/// OpenCV's inpainting (Telea 2004): colours and their gradients are continued from the border of
/// the hole inwards.
#[cfg(feature = "opencv")]
pub struct Telea;

/// Radius in pixels of the neighbourhood that determines the colour of a pixel.
#[cfg(feature = "opencv")]
const REACH: f32 = 5.0;

#[cfg(feature = "opencv")]
impl Inpainter for Telea {
    fn fill(&self, colors: &mut [f32], hole: &[bool], width: u32) -> Result<()> {
        let mut picture = image_io::from_planar(colors, width, hole.len() as u32 / width);
        fastlgs_opencv::inpaint::telea(&mut picture, &mask(hole, width), REACH)
            .map_err(|e| Error::Invalid(e.to_string()))?;
        replace(colors, &image_io::to_planar(&picture), hole);
        Ok(())
    }
}

/// An inpainting network in an ONNX file, such as LaMa.
///
/// Inputs are `image` `[1][3][h][w]`, from 0 to 1, and `mask` `[1][1][h][w]`, 1 in the hole. The
/// output is one picture `[1][3][h][w]`, from 0 to 1 or from 0 to 255. Pictures are resized to the
/// input size of the model, or to multiples of 8 pixels if it accepts any size.
pub struct Learned(Model);

/// LaMa halves its pictures three times, so sides must be multiples of 8 pixels.
const BLOCK: u32 = 8;

impl Learned {
    /// Loads the model.
    ///
    /// # Errors
    /// When the model cannot be loaded, or has other inputs.
    pub fn load(path: &Path) -> Result<Self> {
        let model = Model::load(path)?;
        if model
            .input(&["image"])
            .is_none_or(|slot| slot.shape.len() != 4)
            || model.input(&["mask"]).is_none()
            || model.inputs.len() != 2
        {
            return Err(model.error("it is not an inpainter: its inputs must be 'image' [1][3][h][w] and 'mask' [1][1][h][w], as in LaMa's exports"));
        }
        Ok(Self(model))
    }
}

impl Inpainter for Learned {
    fn fill(&self, colors: &mut [f32], hole: &[bool], width: u32) -> Result<()> {
        let height = hole.len() as u32 / width;
        let wanted = &self
            .0
            .input(&["image"])
            .expect("`load` checks that it exists")
            .shape;
        let side = |wanted: Option<usize>, own: u32| {
            wanted.map_or(own.next_multiple_of(BLOCK), |n| n as u32)
        };
        let (w, h) = (side(wanted[3], width), side(wanted[2], height));
        let picture = image_io::resize(&image_io::from_planar(colors, width, height), w, h);
        let within = image_io::resize_gray(&mask(hole, width), w, h);
        let shape = |planes: usize| vec![1, planes, h as usize, w as usize];
        let image = Array::new(shape(3), image_io::to_planar(&picture));
        let mask = Array::new(
            shape(1),
            within.iter().map(|v| f32::from(u8::from(*v > 0))).collect(),
        );
        let output = self.0.outputs[0].clone();
        let found = self
            .0
            .run(vec![("image", image), ("mask", mask)], &[&output])?
            .remove(0);
        if found.shape != shape(3) {
            return Err(self.0.error(format!(
                "it returned a picture of shape {:?} instead of {:?}",
                found.shape,
                shape(3)
            )));
        }
        let white = if found.values.iter().any(|v| *v > 2.0) {
            255.0
        } else {
            1.0
        };
        let values: Vec<f32> = found.values.iter().map(|v| v / white).collect();
        let picture = image_io::resize(&image_io::from_planar(&values, w, h), width, height);
        replace(colors, &image_io::to_planar(&picture), hole);
        Ok(())
    }
}

/// Returns a hole as a picture: 255 inside, 0 outside.
fn mask(hole: &[bool], width: u32) -> GrayImage {
    GrayImage::from_fn(width, hole.len() as u32 / width, |x, y| {
        Luma([if hole[(y * width + x) as usize] {
            255
        } else {
            0
        }])
    })
}

/// Copies the pixels of the hole from `filled`.
fn replace(colors: &mut [f32], filled: &[f32], hole: &[bool]) {
    for (p, (color, filled)) in colors.iter_mut().zip(filled).enumerate() {
        if hole[p % hole.len()] {
            *color = *filled;
        }
    }
}

/// Returns the inpainter of a name: `opencv`, or the path of an ONNX file.
///
/// # Errors
/// When this build has no OpenCV, or the file is not an inpainter.
pub fn by_name(name: &str) -> Result<Box<dyn Inpainter>> {
    match name {
        #[cfg(feature = "opencv")]
        "opencv" => Ok(Box::new(Telea)),
        #[cfg(not(feature = "opencv"))]
        "opencv" => Err(Error::Invalid("this build has no OpenCV; build with the feature opencv, or use the inpainter 'membrane'".to_owned())),
        path if Path::new(path).extension().is_some_and(|e| e.eq_ignore_ascii_case("onnx")) => {
            Ok(Box::new(Learned::load(Path::new(path))?))
        }
        other => Err(Error::Invalid(format!("'{other}' is not an inpainter; use membrane, opencv, or an ONNX file like LaMa's"))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::onnx::{Graph, Kind};

    /// Returns colours that increase to the right, the same with other colours in a hole, and the
    /// hole.
    fn picture(width: u32, height: u32) -> (Vec<f32>, Vec<f32>, Vec<bool>) {
        let n = (width * height) as usize;
        let at = |p: usize| ((p % width as usize) as f32, (p / width as usize) as f32);
        let whole: Vec<f32> = (0..3 * n).map(|k| 0.2 + 0.02 * at(k % n).0).collect();
        let hole: Vec<bool> = (0..n)
            .map(|p| (8.0..18.0).contains(&at(p).0) && (6.0..12.0).contains(&at(p).1))
            .collect();
        let mut holed = whole.clone();
        (0..3 * n)
            .filter(|k| hole[k % n])
            .for_each(|k| holed[k] = 1.0);
        (whole, holed, hole)
    }

    #[test]
    #[cfg(feature = "opencv")]
    fn opencv_continues_slopes() {
        let (whole, mut holed, hole) = picture(30, 20);
        Telea.fill(&mut holed, &hole, 30).expect("it is filled");
        let worst = whole
            .iter()
            .zip(&holed)
            .map(|(a, b)| (a - b).abs())
            .fold(0.0, f32::max);
        assert!(worst < 0.06, "{worst}");
    }

    /// A model that paints holes black: image x (1 - mask), from 0 to 255.
    #[test]
    fn a_network_fills_only_the_hole() {
        if let Err(e) = crate::model_paths::runtime_library() {
            assert!(std::env::var_os("FASTLGS_REQUIRE_MODELS").is_none(), "{e}");
            eprintln!("skipped: {e}");
            return;
        }
        let dir = tempfile::tempdir().expect("a folder");
        for side in [-1, 16] {
            let mut graph = Graph::default();
            let image = graph.input("image", Kind::Float, &[1, 3, side, side]);
            let mask = graph.input("mask", Kind::Float, &[1, 1, side, side]);
            let [one, white] = [1.0, 255.0].map(|v| graph.floats(&[], &[v]));
            let outside = graph.op("Sub", &[&one, &mask], &[]);
            let kept = graph.op("Mul", &[&image, &outside], &[]);
            let painted = graph.op("Mul", &[&kept, &white], &[]);
            graph.output(&painted, "output", &[1, 3, side, side]);
            let path = dir.path().join("black.onnx");
            graph.save(&path);
            let (_, before, hole) = picture(30, 20);
            let mut after = before.clone();
            Learned::load(&path)
                .expect("an inpainter")
                .fill(&mut after, &hole, 30)
                .expect("it is filled");
            for (p, (before, after)) in before.iter().zip(&after).enumerate() {
                let expected = if hole[p % hole.len()] { 0.0 } else { *before };
                assert!(
                    (after - expected).abs() < if side < 0 { 1e-6 } else { 0.5 },
                    "side {side}, pixel {p}: {after}"
                );
            }
        }
        assert!(
            by_name("paint")
                .err()
                .expect("refused")
                .to_string()
                .contains("membrane, opencv, or an ONNX file")
        );
    }
}
