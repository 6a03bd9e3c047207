//! Detector of everyday objects: NanoDet-g (Lyu 2020), trained on the 80 classes of COCO.

use crate::runtime::{Array, Model};
use crate::{Result, model_paths};
use fastlgs_core::image_io;
use image::RgbImage;

/// File name of the model in the folder of the offline models.
pub(crate) const FILE: &str = "detector.onnx";

/// COCO's class names, in the order of the model's scores.
pub const CLASSES: [&str; 80] = [
    "person",
    "bicycle",
    "car",
    "motorcycle",
    "airplane",
    "bus",
    "train",
    "truck",
    "boat",
    "traffic light",
    "fire hydrant",
    "stop sign",
    "parking meter",
    "bench",
    "bird",
    "cat",
    "dog",
    "horse",
    "sheep",
    "cow",
    "elephant",
    "bear",
    "zebra",
    "giraffe",
    "backpack",
    "umbrella",
    "handbag",
    "tie",
    "suitcase",
    "frisbee",
    "skis",
    "snowboard",
    "sports ball",
    "kite",
    "baseball bat",
    "baseball glove",
    "skateboard",
    "surfboard",
    "tennis racket",
    "bottle",
    "wine glass",
    "cup",
    "fork",
    "knife",
    "spoon",
    "bowl",
    "banana",
    "apple",
    "sandwich",
    "orange",
    "broccoli",
    "carrot",
    "hot dog",
    "pizza",
    "donut",
    "cake",
    "chair",
    "couch",
    "potted plant",
    "bed",
    "dining table",
    "toilet",
    "tv",
    "laptop",
    "mouse",
    "remote",
    "keyboard",
    "cell phone",
    "microwave",
    "oven",
    "toaster",
    "sink",
    "refrigerator",
    "book",
    "clock",
    "vase",
    "scissors",
    "teddy bear",
    "hair drier",
    "toothbrush",
];

/// Side of the model's input in pixels.
const SIDE: u32 = 416;
/// Mean and standard deviation of the training pictures, BGR in [0, 255].
const MEAN_BGR: [f32; 3] = [103.53, 116.28, 123.675];
const DEVIATION_BGR: [f32; 3] = [57.375, 57.12, 58.395];
/// Lowest score of a detection.
const MIN_SCORE: f32 = 0.05;
/// Of two boxes of one class with a larger IoU, the one with the lower score is dropped.
const MAX_IOU: f32 = 0.6;

/// A rectangle: left, top, right and bottom, as shares of the photo's width and height.
pub type Bounds = [f32; 4];

/// An object that the detector found in a photo.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Detection {
    /// Index in [`CLASSES`].
    pub class: usize,
    /// Score, 0 to 1.
    pub score: f32,
    /// Its rectangle. It can exceed the photo.
    pub bounds: Bounds,
}

/// Returns the intersection of two rectangles over their union.
pub fn box_iou(a: Bounds, b: Bounds) -> f32 {
    let area =
        |[left, top, right, bottom]: Bounds| (right - left).max(0.0) * (bottom - top).max(0.0);
    let common = area([
        a[0].max(b[0]),
        a[1].max(b[1]),
        a[2].min(b[2]),
        a[3].min(b[3]),
    ]);
    common / (area(a) + area(b) - common).max(f32::MIN_POSITIVE)
}

/// The detector.
pub struct Detector(Model);

impl Detector {
    /// Returns whether the model is installed.
    pub fn is_installed() -> bool {
        model_paths::offline_dir().join(FILE).is_file()
    }

    /// Loads the model from the cache folder.
    ///
    /// # Errors
    /// When it is not installed.
    pub fn load() -> Result<Self> {
        let path = model_paths::offline_dir().join(FILE);
        Ok(Self(Model::load_for_each_core(&path)?))
    }

    /// Returns the objects of a photo, sorted by class, then by score in descending order.
    ///
    /// # Errors
    /// When inference fails.
    pub fn detect(&self, photo: &RgbImage) -> Result<Vec<Detection>> {
        let (image, inner) = letterboxed(photo);
        let side = SIDE as usize;
        let inputs = vec![("image", Array::new([1, 3, side, side], image))];
        let found = self.0.run(inputs, &["scores", "boxes"])?;
        let [scores, boxes] = &found[..] else {
            return Err(self.0.error("it has other outputs than scores and boxes"));
        };
        let cells = boxes.values.len() / 4;
        let bounds = |cell: usize| -> Bounds {
            std::array::from_fn(|k| {
                let (start, length) = (inner[k % 2], inner[k % 2 + 2]);
                (boxes.values[4 * cell + k] - start) / length
            })
        };
        let of_class = |class: usize| {
            let score = |cell: usize| scores.values[cell * CLASSES.len() + class];
            let found = (0..cells).filter(|cell| score(*cell) >= MIN_SCORE);
            let candidates = found.map(|cell| Detection {
                class,
                score: score(cell),
                bounds: bounds(cell),
            });
            without_duplicates(candidates.collect())
        };
        Ok((0..CLASSES.len()).flat_map(of_class).collect())
    }
}

/// Returns the normalised input `[3][SIDE][SIDE]`, BGR: the photo in its centre, black around it.
/// Also returns the photo's rectangle in the input: left, top, width and height in pixels.
fn letterboxed(photo: &RgbImage) -> (Vec<f32>, [f32; 4]) {
    let scale = SIDE as f32 / photo.width().max(photo.height()) as f32;
    let [w, h] =
        [photo.width(), photo.height()].map(|n| ((n as f32 * scale).round() as u32).clamp(1, SIDE));
    let small = image_io::resize(photo, w, h);
    let (left, top) = ((SIDE - w) / 2, (SIDE - h) / 2);
    let pixels = (SIDE * SIDE) as usize;
    let mut image: Vec<f32> = (0..3 * pixels)
        .map(|i| -MEAN_BGR[i / pixels] / DEVIATION_BGR[i / pixels])
        .collect();
    for (x, y, pixel) in small.enumerate_pixels() {
        let place = ((top + y) * SIDE + left + x) as usize;
        for k in 0..3 {
            image[k * pixels + place] = (f32::from(pixel[2 - k]) - MEAN_BGR[k]) / DEVIATION_BGR[k];
        }
    }
    (image, [left, top, w, h].map(|v| v as f32))
}

/// Non-maximum suppression of the detections of one class.
fn without_duplicates(mut found: Vec<Detection>) -> Vec<Detection> {
    found.sort_by(|a, b| b.score.total_cmp(&a.score));
    let mut kept: Vec<Detection> = Vec::new();
    for one in found {
        if kept
            .iter()
            .all(|other| box_iou(one.bounds, other.bounds) <= MAX_IOU)
        {
            kept.push(one);
        }
    }
    kept
}

#[cfg(test)]
mod tests {
    use super::*;
    use fastlgs_synth::Kind;

    #[test]
    fn the_best_of_two_overlapping_boxes_is_kept() {
        let detection = |score: f32, left: f32| Detection {
            class: 3,
            score,
            bounds: [left, 0.0, left + 1.0, 1.0],
        };
        assert!((box_iou([0.0, 0.0, 2.0, 1.0], [1.0, 0.0, 3.0, 1.0]) - 1.0 / 3.0).abs() < 1e-6);
        assert_eq!(box_iou([0.0, 0.0, 1.0, 1.0], [2.0, 2.0, 3.0, 3.0]), 0.0);
        let found = vec![
            detection(0.5, 0.1),
            detection(0.9, 0.0),
            detection(0.3, 0.6),
        ];
        assert_eq!(
            without_duplicates(found),
            [detection(0.9, 0.0), detection(0.3, 0.6)]
        );
    }

    #[test]
    fn a_generated_chair_is_detected() {
        let detector = match Detector::load() {
            Ok(detector) => detector,
            Err(e) => return crate::skip::skip(format_args!("{e}")),
        };
        let world = Kind::Study
            .world("".as_ref(), 8, (400, 300), 0)
            .expect("a room");
        let chair = 1 + world
            .objects
            .iter()
            .position(|object| object.name == "chair")
            .expect("a chair") as u16;
        let class = CLASSES.iter().position(|class| *class == "chair");
        let mut best = Vec::new();
        for view in 0..8 {
            let view = world.render(view, 1);
            let Some([left, top, right, bottom]) = view.instances.boxes()[usize::from(chair)]
            else {
                continue;
            };
            let share = |v: u32, size: u32| v as f32 / size as f32;
            let (w, h) = (view.instances.width, view.instances.height);
            let bounds = [
                share(left, w),
                share(top, h),
                share(right, w),
                share(bottom, h),
            ];
            let found = detector.detect(&view.photo).expect("detections");
            let scores = found
                .iter()
                .filter(|d| Some(d.class) == class && box_iou(d.bounds, bounds) > 0.5)
                .map(|d| d.score);
            best.push(scores.fold(0.0, f32::max));
        }
        let mean = best.iter().sum::<f32>() / best.len() as f32;
        assert!(mean > 0.3, "scores of the chair in each view: {best:?}");
    }

    #[test]
    fn a_wide_photo_lies_in_the_middle_of_the_input() {
        let photo = RgbImage::from_pixel(832, 416, image::Rgb([255, 0, 0]));
        let (image, inner) = letterboxed(&photo);
        assert_eq!(inner, [0.0, 104.0, 416.0, 208.0]);
        let red = |y: usize| image[2 * 416 * 416 + y * 416 + 200] * DEVIATION_BGR[2] + MEAN_BGR[2];
        assert!(red(103).abs() < 1e-3 && (red(104) - 255.0).abs() < 1e-3);
    }
}
