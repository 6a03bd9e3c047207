//! Label maps: images with one 16-bit label per pixel, 0 for none.

use crate::undistort::Distortion;
use crate::{Camera, Error, Result, fs, image_io};
use glam::Vec2;
use image::{ColorType, DynamicImage, ImageBuffer, ImageReader, Luma};
use std::io::Cursor;
use std::path::Path;

/// Largest decoded size of a palette image, in bytes. A damaged header may state any size.
const MAX_BYTES: usize = 1 << 28;

/// Labels of one view, such as non-overlapping masks; 0 means none.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct LabelMap {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// Labels in row-major order.
    pub labels: Vec<u16>,
}

impl LabelMap {
    /// Creates a map without labels.
    pub fn new(width: u32, height: u32) -> Self {
        Self {
            width,
            height,
            labels: vec![0; (width * height) as usize],
        }
    }

    /// Returns the label of a pixel.
    pub fn at(&self, x: u32, y: u32) -> u16 {
        self.labels[(y * self.width + x) as usize]
    }

    /// Returns the largest label.
    pub fn max(&self) -> u16 {
        self.labels.iter().copied().max().unwrap_or(0)
    }

    /// Returns the number of pixels of each label, indexed by label.
    pub fn areas(&self) -> Vec<usize> {
        let mut areas = vec![0; usize::from(self.max()) + 1];
        for &l in &self.labels {
            areas[usize::from(l)] += 1;
        }
        areas
    }

    /// Returns the bounding boxes (x0, y0, x1, y1) indexed by label, with exclusive ends; `None`
    /// for labels that do not occur.
    pub fn boxes(&self) -> Vec<Option<[u32; 4]>> {
        let mut boxes: Vec<Option<[u32; 4]>> = vec![None; usize::from(self.max()) + 1];
        for y in 0..self.height {
            for x in 0..self.width {
                let b = boxes[usize::from(self.at(x, y))].get_or_insert([x, y, x + 1, y + 1]);
                *b = [b[0].min(x), b[1].min(y), b[2].max(x + 1), b[3].max(y + 1)];
            }
        }
        boxes
    }

    /// Returns the mask of `label`.
    pub fn mask(&self, label: u16) -> Vec<bool> {
        self.labels.iter().map(|&l| l == label).collect()
    }

    /// Renumbers the labels 1, 2, ... without gaps, in ascending order. Also returns the old label
    /// of each new label, indexed by the new one; entry 0 is 0.
    pub fn dense(&self) -> (Self, Vec<u16>) {
        let mut number = vec![0u16; usize::from(self.max()) + 1];
        self.labels.iter().for_each(|l| number[usize::from(*l)] = 1);
        let mut names = vec![0];
        for (label, number) in number.iter_mut().enumerate().skip(1).filter(|n| *n.1 > 0) {
            *number = names.len() as u16;
            names.push(label as u16);
        }
        number[0] = 0;
        (
            Self {
                labels: self
                    .labels
                    .iter()
                    .map(|l| number[usize::from(*l)])
                    .collect(),
                ..*self
            },
            names,
        )
    }

    /// Resizes the map with nearest-neighbour sampling.
    pub fn resized(&self, width: u32, height: u32) -> Self {
        let pick = |n: u32, from: u32, to: u32| {
            ((u64::from(n) * 2 + 1) * u64::from(from) / (2 * u64::from(to))) as u32
        };
        let labels = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
        let labels = labels
            .map(|(x, y)| self.at(pick(x, self.width, width), pick(y, self.height, height)))
            .collect();
        Self {
            width,
            height,
            labels,
        }
    }

    /// Resamples the map to the ideal pinhole `camera` of the same size, with nearest-neighbour
    /// sampling. Pixels outside the distorted image get no label.
    pub fn undistorted(&self, camera: &Camera, distortion: &Distortion) -> Self {
        let mut out = Self::new(self.width, self.height);
        for (i, label) in out.labels.iter_mut().enumerate() {
            let (x, y) = (i as u32 % self.width, i as u32 / self.width);
            let d = distortion.distort(
                camera
                    .ray(Vec2::new(x as f32 + 0.5, y as f32 + 0.5))
                    .truncate(),
            );
            let (u, v) = (
                (camera.fx * d.x + camera.cx).floor(),
                (camera.fy * d.y + camera.cy).floor(),
            );
            if u >= 0.0 && v >= 0.0 && u < self.width as f32 && v < self.height as f32 {
                *label = self.at(u as u32, v as u32);
            }
        }
        out
    }

    /// Writes a 16-bit grey PNG atomically.
    ///
    /// # Errors
    /// [`Error::Io`] with the path.
    pub fn save(&self, path: &Path) -> Result<()> {
        let picture: ImageBuffer<Luma<u16>, _> =
            ImageBuffer::from_raw(self.width, self.height, self.labels.clone())
                .expect("there is one label per pixel");
        image_io::save_png(path, DynamicImage::ImageLuma16(picture))
    }

    /// Reads a label map that may use the largest value (255, or 65,535 with 16 bits) for "no
    /// label". Tools of COCO, Cityscapes and ScanNet write such maps.
    ///
    /// The value counts as a label if it directly follows the largest other label, or if there is
    /// no other label (a binary mask).
    ///
    /// # Errors
    /// As [`Self::load`].
    pub fn load_with_void(path: &Path) -> Result<Self> {
        let mut map = Self::load(path)?;
        let has_16_bits = image_io::color_type(path)? == ColorType::L16;
        let void = if has_16_bits {
            u16::MAX
        } else {
            u16::from(u8::MAX)
        };
        let next = map
            .labels
            .iter()
            .copied()
            .filter(|label| *label != void)
            .max()
            .unwrap_or(0);
        if next > 0 && next + 1 < void {
            map.labels
                .iter_mut()
                .filter(|label| **label == void)
                .for_each(|label| *label = 0);
        }
        Ok(map)
    }

    /// Reads a grey PNG of 8 or 16 bits, or the palette indices of a PNG with a palette. Trackers
    /// and the tools of DAVIS store ids as palette indices.
    ///
    /// # Errors
    /// [`Error::Io`], or [`Error::Format`] for other images.
    pub fn load(path: &Path) -> Result<Self> {
        let bytes = fs::read(path)?;
        if let Some(indexed) = Self::palette_indices(&bytes) {
            return indexed
                .map_err(|e| Error::format(path, format!("the label map cannot be read: {e}")));
        }
        let reader = ImageReader::new(Cursor::new(bytes))
            .with_guessed_format()
            .map_err(Error::io(path))?;
        let decoded = reader
            .decode()
            .map_err(|e| Error::format(path, format!("the label map cannot be read: {e}")))?;
        let (width, height) = (decoded.width(), decoded.height());
        let labels = match decoded {
            DynamicImage::ImageLuma16(map) => map.into_raw(),
            DynamicImage::ImageLuma8(map) => map.into_raw().into_iter().map(u16::from).collect(),
            _ => {
                return Err(Error::format(
                    path,
                    "a label map must be a grey PNG of 8 or 16 bits or a PNG with a palette; convert it",
                ));
            }
        };
        Ok(Self {
            width,
            height,
            labels,
        })
    }

    /// Decodes the palette indices of a PNG; `None` for a file without a palette. The `image` crate
    /// would return colours.
    fn palette_indices(bytes: &[u8]) -> Option<Result<Self, png::DecodingError>> {
        let mut reader = png::Decoder::new(Cursor::new(bytes)).read_info().ok()?;
        let (width, height, bits) = (
            reader.info().width,
            reader.info().height,
            reader.info().bit_depth as usize,
        );
        if reader.info().color_type != png::ColorType::Indexed {
            return None;
        }
        let mut packed = vec![
            0;
            reader
                .output_buffer_size()
                .filter(|bytes| *bytes <= MAX_BYTES)?
        ];
        if let Err(error) = reader.next_frame(&mut packed) {
            return Some(Err(error));
        }
        // Each row starts with a new byte. The highest bits of a byte belong to the leftmost pixel.
        let row = reader.output_line_size(width)?;
        let label = |x: usize, y: usize| {
            u16::from(packed[y * row + x * bits / 8] << (x * bits % 8) >> (8 - bits))
        };
        let labels = (0..height as usize)
            .flat_map(|y| (0..width as usize).map(move |x| (x, y)))
            .map(|(x, y)| label(x, y))
            .collect();
        Some(Ok(Self {
            width,
            height,
            labels,
        }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn void_value_is_removed_unless_it_follows_the_labels() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.png");
        let read = |labels: &[u16], eight: bool| {
            let (width, height) = (labels.len() as u32, 1);
            if eight {
                let picture = image::GrayImage::from_raw(
                    width,
                    height,
                    labels.iter().map(|l| *l as u8).collect(),
                )
                .unwrap();
                image_io::save_png(&path, picture).unwrap();
            } else {
                LabelMap {
                    width,
                    height,
                    labels: labels.to_vec(),
                }
                .save(&path)
                .unwrap();
            }
            LabelMap::load_with_void(&path).unwrap().labels
        };
        assert_eq!(read(&[0, 1, 7, 255], true), [0, 1, 7, 0]);
        assert_eq!(read(&[0, 255, 255], true), [0, 255, 255], "a binary mask");
        assert_eq!(
            read(&[1, 254, 255], true),
            [1, 254, 255],
            "255 follows the largest other label"
        );
        assert_eq!(read(&[3, 300, 65535], false), [3, 300, 0]);
        assert_eq!(read(&[3, 255, 300], false), [3, 255, 300]);
        assert_eq!(
            read(&[3, 17, 255], false),
            [3, 17, 255],
            "255 is an ordinary label with 16 bits"
        );
    }

    #[test]
    fn png_keeps_all_16_bits() {
        let dir = tempfile::tempdir().unwrap();
        let mut map = LabelMap::new(3, 2);
        map.labels = vec![0, 1, 300, 65535, 2, 2];
        map.save(&dir.path().join("a.png")).unwrap();
        assert_eq!(LabelMap::load(&dir.path().join("a.png")).unwrap(), map);
        assert_eq!(map.boxes()[2], Some([1, 1, 3, 2]));
        assert_eq!(map.areas()[2], 2);
        let double = map.resized(6, 4);
        assert_eq!(
            (double.at(4, 1), double.at(0, 2), double.at(2, 3)),
            (300, 65535, 2)
        );
    }

    #[test]
    fn palette_png_is_read_as_indices() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("tracked.png");
        for (depth, packed) in [
            (png::BitDepth::Eight, vec![0, 3, 1, 2, 2, 0]),
            (png::BitDepth::Two, vec![0b0011_0100, 0b1010_0000]),
        ] {
            let mut encoder = png::Encoder::new(std::fs::File::create(&path).unwrap(), 3, 2);
            encoder.set_color(png::ColorType::Indexed);
            encoder.set_depth(depth);
            encoder.set_palette(vec![0, 0, 0, 128, 0, 0, 0, 128, 0, 128, 128, 0]);
            encoder
                .write_header()
                .unwrap()
                .write_image_data(&packed)
                .unwrap();
            let map = LabelMap::load(&path).unwrap();
            assert_eq!(
                (map.width, map.height, map.labels),
                (3, 2, vec![0, 3, 1, 2, 2, 0]),
                "{depth:?}"
            );
        }
        std::fs::write(&path, &std::fs::read(&path).unwrap()[..60]).unwrap();
        assert!(
            LabelMap::load(&path)
                .unwrap_err()
                .to_string()
                .contains("tracked.png")
        );
    }

    #[test]
    fn dense_numbers_have_no_gaps() {
        let map = LabelMap {
            width: 5,
            height: 1,
            labels: vec![60_000, 0, 7, 60_000, 9],
        };
        let (dense, names) = map.dense();
        assert_eq!(
            (dense.labels, names),
            (vec![3, 0, 1, 3, 2], vec![0, 7, 9, 60_000])
        );
        assert_eq!(LabelMap::new(2, 2).dense().1, [0]);
    }
}
