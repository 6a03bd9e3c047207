//! Masks and embeddings that other programs made, in the layouts that they leave beside the photos.

use crate::masks::{Mask, paint};
use crate::runtime::Array;
use crate::segmenter::{Level, Segmentation, Segmenter};
use crate::{Encoder, Error, Result, encoder};
use fastlgs_core::dataset::Dataset;
use fastlgs_core::npy::{self, Npy};
use fastlgs_core::scene_folder::load_tensors;
use fastlgs_core::undistort::Distortion;
use fastlgs_core::{Camera, LabelMap, image_io};
use image::RgbImage;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// How masks lie beside the photos.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Layout {
    /// `masks/NAME.png`: 16-bit labels, 0 for none; finer levels in `masks/part/` and `masks/subpart/`.
    Labels,
    /// `masks/STEM/*.png`: one black-and-white picture a mask, which may overlap.
    MaskFolders,
    /// LangSplat's `language_features/STEM_s.npy` (levels default, small, medium, large) and `STEM_f.npy`.
    LangSplat,
    /// Gaussian Grouping's `object_mask/STEM.png`: ids that are the same in all photos.
    GaussianGrouping,
    /// SPIn-NeRF's `label/STEM.png` or `images_N/label/STEM.png`: one object, black and white.
    SpinNerf,
}

/// The camera of a photo, at any size, and the distortion of its lens: imported masks were drawn on the distorted photo.
pub type Lens = (Camera, Distortion);

/// The lens of each photo, by name.
pub fn lenses(dataset: &Dataset) -> BTreeMap<String, Lens> {
    dataset.photos.iter().map(|p| (p.camera.name.clone(), (p.camera.clone(), p.distortion))).collect()
}

/// Imported masks and embeddings.
pub struct Import {
    photos: PathBuf,
    layout: Layout,
    lenses: BTreeMap<String, Lens>,
}

/// Proportions of a label map may differ from the photo's by this share.
const PROPORTIONS: f64 = 0.02;
/// IoU from which the embedding of an imported mask describes another mask.
const SAME: f32 = 0.3;

fn stem(view: &str) -> &str {
    Path::new(view).file_stem().and_then(|s| s.to_str()).unwrap_or(view)
}

/// Label maps as they are on disk, coarse to fine; those that a layout lacks are `None`.
type Maps = [Option<LabelMap>; 3];

impl Import {
    /// Finds out which layout PHOTOS has.
    ///
    /// # Errors
    /// When there is none; the message lists those that are known.
    pub fn open(photos: &Path, lenses: BTreeMap<String, Lens>) -> Result<Self> {
        let masks = photos.join("masks");
        let some = |folder: &Path, want: &dyn Fn(&Path) -> bool| folder.read_dir().is_ok_and(|d| d.flatten().any(|e| want(&e.path())));
        let png = |p: &Path| p.extension().is_some_and(|e| e == "png");
        let level = |p: &Path| Level::ALL.iter().any(|l| p.ends_with(l.name()));
        let layout = if some(&masks, &png) || some(&masks.join("whole"), &png) {
            Layout::Labels
        } else if some(&masks, &|p| p.is_dir() && !level(p)) {
            Layout::MaskFolders
        } else if photos.join("language_features").is_dir() {
            Layout::LangSplat
        } else if photos.join("object_mask").is_dir() {
            Layout::GaussianGrouping
        } else if spin_nerf_folder(photos).is_some() {
            Layout::SpinNerf
        } else {
            return Err(Error::Missing(format!(
                "{}: no masks to import; expected masks/NAME.png (16-bit labels), masks/STEM/*.png, language_features/ (LangSplat), \
                 object_mask/ (Gaussian Grouping) or label/ (SPIn-NeRF) beside images/",
                photos.display()
            )));
        };
        Ok(Self { photos: photos.to_owned(), layout, lenses })
    }

    /// The layout that was found.
    pub fn layout(&self) -> Layout {
        self.layout
    }

    /// The first of some files of a view that is there.
    fn find(&self, view: &str, candidates: &[PathBuf]) -> Result<PathBuf> {
        candidates.iter().find(|p| p.exists()).cloned().ok_or_else(|| {
            let first = candidates.first().map(|p| p.display().to_string()).unwrap_or_default();
            Error::Missing(format!("{first}: the photo '{view}' has no masks; add them, or take the photo out of images/"))
        })
    }

    fn maps(&self, view: &str) -> Result<Maps> {
        let stem = stem(view);
        let named = |folder: PathBuf| [folder.join(format!("{view}.png")), folder.join(format!("{stem}.png"))];
        match self.layout {
            Layout::Labels => {
                let masks = self.photos.join("masks");
                let whole = self.find(view, &[named(masks.clone()), named(masks.join("whole"))].concat())?;
                let finer = |level: Level| {
                    let path = named(masks.join(level.name())).into_iter().find(|p| p.is_file());
                    path.map(|p| LabelMap::load(&p)).transpose()
                };
                Ok([Some(LabelMap::load(&whole)?), finer(Level::Part)?, finer(Level::Subpart)?])
            }
            Layout::MaskFolders => {
                let masks = self.photos.join("masks");
                let folder = self.find(view, &[masks.join(stem), masks.join(view)])?;
                Ok([Some(overlaid(&folder)?), None, None])
            }
            Layout::LangSplat => {
                let path = self.find(view, &[self.photos.join(format!("language_features/{stem}_s.npy"))])?;
                let Npy { shape, values } = npy::read(&path)?;
                let [levels @ (1 | 4), rows, columns] = shape[..] else {
                    return Err(Error::Invalid(format!(
                        "{}: shape {shape:?}; LangSplat's segmentations are (4, rows, columns)",
                        path.display()
                    )));
                };
                let level = |k: usize| {
                    let own = &values[k * rows * columns..][..rows * columns];
                    LabelMap { width: columns as u32, height: rows as u32, labels: own.iter().map(|v| (v + 1.0).max(0.0) as u16).collect() }
                };
                Ok(if levels == 1 { [Some(level(0)), None, None] } else { [3, 2, 1].map(|k| Some(level(k))) })
            }
            Layout::GaussianGrouping => {
                let path = self.find(view, &named(self.photos.join("object_mask")))?;
                Ok([Some(LabelMap::load(&path)?), None, None])
            }
            Layout::SpinNerf => {
                let folder = spin_nerf_folder(&self.photos).expect("found when it was opened");
                let mut map = LabelMap::load(&self.find(view, &named(folder))?)?;
                map.labels.iter_mut().for_each(|l| *l = u16::from(*l > 0));
                Ok([Some(map), None, None])
            }
        }
    }

    /// A map at the size of the working photo, without the lens's distortion.
    fn fitted(&self, view: &str, map: LabelMap, width: u32, height: u32) -> Result<LabelMap> {
        let proportions = |w: u32, h: u32| f64::from(w) / f64::from(h);
        if (proportions(map.width, map.height) / proportions(width, height) - 1.0).abs() > PROPORTIONS {
            let (w, h) = (map.width, map.height);
            return Err(Error::Invalid(format!(
                "the masks of '{view}' are {w}x{h}, which does not fit a photo of {width}x{height}; were they cropped or rotated?"
            )));
        }
        let map = map.resized(width, height);
        Ok(match self.lenses.get(view) {
            Some((camera, distortion)) if !distortion.is_none() => map.undistorted(&camera.resized(width, height), distortion),
            _ => map,
        })
    }

    /// Embeddings of a view's *whole* masks, label 1 first; none where the layout has none.
    fn rows(&self, view: &str) -> Result<Option<Array>> {
        let stem = stem(view);
        let rows = if self.layout == Layout::LangSplat {
            array(npy::read(&self.photos.join(format!("language_features/{stem}_f.npy")))?)
        } else {
            let at =
                |ending: &str| [view, stem].map(|n| self.photos.join(format!("embeddings/{n}.{ending}"))).into_iter().find(|p| p.is_file());
            if let Some(path) = at("npy") {
                array(npy::read(&path)?)
            } else if let Some(path) = at("safetensors") {
                let mut tensors = load_tensors(&path)?;
                let (shape, values) =
                    tensors.remove("embeddings").ok_or_else(|| Error::Invalid(format!("{}: no tensor 'embeddings'", path.display())))?;
                Array::new(shape, values)
            } else {
                return Ok(None);
            }
        };
        if rows.shape.len() != 2 || rows.values.iter().any(|v| !v.is_finite()) {
            return Err(Error::Invalid(format!("the embeddings of '{view}' have shape {:?}; one finite row a mask is needed", rows.shape)));
        }
        Ok(Some(rows))
    }
}

fn array(npy: Npy) -> Array {
    Array::new(npy.shape, npy.values.into_iter().map(|v| v as f32).collect())
}

/// The folder of SPIn-NeRF's labels: the finest of `label`, `images_N/label`.
fn spin_nerf_folder(photos: &Path) -> Option<PathBuf> {
    let folders = ["label", "images/label", "images_2/label", "images_4/label", "images_8/label"];
    folders.iter().map(|f| photos.join(f)).find(|f| f.is_dir())
}

/// All black-and-white pictures of a folder, in the order of their names, as one map; the smaller lie on top.
fn overlaid(folder: &Path) -> Result<LabelMap> {
    let entries = folder.read_dir().map_err(fastlgs_core::Error::io(folder))?;
    let mut paths: Vec<PathBuf> = entries.flatten().map(|e| e.path()).filter(|p| p.extension().is_some_and(|e| e == "png")).collect();
    paths.sort();
    let mut size = None;
    let mut masks = Vec::new();
    for path in paths {
        let picture = image_io::load_gray(&path)?;
        let own = picture.dimensions();
        if *size.get_or_insert(own) != own {
            return Err(Error::Invalid(format!("{}: it differs in size from the other masks of its folder", path.display())));
        }
        match Mask::of([0, 0, own.0, own.1], |x, y| picture.get_pixel(x, y)[0] > 127) {
            Some(mask) => masks.push(mask),
            None => tracing::warn!("{}: the mask is empty", path.display()),
        }
    }
    let (width, height) = size.ok_or_else(|| Error::Missing(format!("{}: no masks (*.png) in it", folder.display())))?;
    Ok(paint(&masks, width, height))
}

impl Segmenter for Import {
    fn name(&self) -> &'static str {
        "import"
    }

    fn segment(&self, view: &str, photo: &RgbImage) -> Result<Segmentation> {
        let empty = || LabelMap::new(photo.width(), photo.height());
        let [whole, part, subpart] =
            self.maps(view)?.map(|map| map.map_or_else(|| Ok(empty()), |map| self.fitted(view, map, photo.width(), photo.height())));
        let levels = [whole?, part?, subpart?];
        if levels[0].max() == 0 {
            tracing::warn!("the label map of '{view}' is empty");
        }
        Ok(Segmentation { levels })
    }
}

impl Encoder for Import {
    fn name(&self) -> &'static str {
        "import"
    }

    /// The imported embedding of the mask that fits each label best; zeros where none does.
    fn embed_masks(&self, view: &str, photo: &RgbImage, masks: &LabelMap) -> Result<Vec<Vec<f32>>> {
        let missing = || {
            let folder = self.photos.display();
            Error::Missing(format!("{folder}/embeddings: no embeddings of '{view}' (.npy or .safetensors, one row a mask)"))
        };
        let rows = self.rows(view)?.ok_or_else(missing)?;
        let dimension = rows.shape[1];
        let [whole, ..] = self.segment(view, photo)?.levels;
        if usize::from(whole.max()) > rows.shape[0] {
            return Err(Error::Invalid(format!("'{view}' has masks up to label {} but {} embeddings", whole.max(), rows.shape[0])));
        }
        let embedding = |label: Option<u16>| match label {
            Some(label) => {
                let mut row = rows.values[(usize::from(label) - 1) * dimension..][..dimension].to_vec();
                encoder::normalise(&mut row);
                row
            }
            None => vec![0.0; dimension],
        };
        Ok(fitting(masks, &whole).into_iter().map(embedding).collect())
    }
}

/// For each label 1..=max of `masks` the label of `others`, which may be of another size, whose mask fits best, if it fits.
pub fn fitting(masks: &LabelMap, others: &LabelMap) -> Vec<Option<u16>> {
    let others = others.resized(masks.width, masks.height);
    let mut common: BTreeMap<(u16, u16), usize> = BTreeMap::new();
    masks.labels.iter().zip(&others.labels).for_each(|pair| *common.entry((*pair.0, *pair.1)).or_default() += 1);
    let (areas, other_areas) = (masks.areas(), others.areas());
    let best = |label: u16| {
        let overlaps = common.range((label, 1)..=(label, u16::MAX)).map(|(&(_, other), &n)| {
            let either = areas[usize::from(label)] + other_areas[usize::from(other)] - n;
            (n as f32 / either as f32, other)
        });
        let best = overlaps.filter(|(iou, _)| *iou >= SAME).max_by(|a, b| a.0.total_cmp(&b.0).then(b.1.cmp(&a.1)));
        best.map(|(_, other)| other)
    };
    (1..=masks.max()).map(best).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::{GrayImage, Luma};
    use npyz::WriterBuilder;

    const PHOTO: (u32, u32) = (8, 4);

    fn photo() -> RgbImage {
        RgbImage::new(PHOTO.0, PHOTO.1)
    }

    /// Left half 1, right half 2.
    fn halves(width: u32, height: u32) -> LabelMap {
        LabelMap { width, height, labels: (0..width * height).map(|i| if i % width < width / 2 { 1 } else { 2 }).collect() }
    }

    fn npy<T: npyz::AutoSerialize + Copy>(path: &Path, shape: &[u64], values: &[T]) {
        let mut bytes = Vec::new();
        let mut writer = npyz::WriteOptions::new().default_dtype().shape(shape).writer(&mut bytes).begin_nd().unwrap();
        writer.extend(values.iter().copied()).unwrap();
        writer.finish().unwrap();
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, bytes).unwrap();
    }

    fn open(dir: &Path) -> Import {
        Import::open(dir, BTreeMap::new()).unwrap()
    }

    fn gray(path: &Path, value: impl Fn(u32, u32) -> u8) {
        image_io::save_png(path, GrayImage::from_fn(PHOTO.0, PHOTO.1, |x, y| Luma([value(x, y)]))).unwrap();
    }

    #[test]
    fn label_maps_with_levels() {
        let dir = tempfile::tempdir().unwrap();
        halves(16, 8).save(&dir.path().join("masks/a.jpg.png")).unwrap();
        halves(8, 4).save(&dir.path().join("masks/part/a.png")).unwrap();
        let import = open(dir.path());
        assert_eq!(import.layout(), Layout::Labels);
        let [whole, part, subpart] = import.segment("a.jpg", &photo()).unwrap().levels;
        assert_eq!((&whole, &part), (&halves(8, 4), &halves(8, 4)), "scaled to the photo");
        assert_eq!(subpart.max(), 0);
        assert!(import.segment("b.jpg", &photo()).err().unwrap().to_string().contains("b.jpg"));
        halves(8, 8).save(&dir.path().join("masks/c.png")).unwrap();
        let error = import.segment("c.jpg", &photo()).err().unwrap().to_string();
        assert!(error.contains("8x8") && error.contains("8x4"), "{error}");
        assert!(import.embed_masks("a.jpg", &photo(), &whole).unwrap_err().to_string().contains("embeddings"));
    }

    #[test]
    fn embeddings_follow_the_masks_that_fit() {
        let dir = tempfile::tempdir().unwrap();
        halves(8, 4).save(&dir.path().join("masks/a.png")).unwrap();
        npy(&dir.path().join("embeddings/a.npy"), &[2, 2], &[3.0f32, 0.0, 0.0, 2.0]);
        let import = open(dir.path());
        // Other labels, and one mask that fits nothing.
        let mut other = halves(8, 4);
        other.labels.iter_mut().for_each(|l| *l = 3 - *l);
        other.labels[0] = 3;
        assert_eq!(import.embed_masks("a.jpg", &photo(), &other).unwrap(), [vec![0.0, 1.0], vec![1.0, 0.0], vec![0.0, 0.0]]);
        npy(&dir.path().join("embeddings/a.npy"), &[1, 2], &[3.0f32, 0.0]);
        assert!(import.embed_masks("a.jpg", &photo(), &other).unwrap_err().to_string().contains("1 embeddings"));
    }

    #[test]
    fn langsplat() {
        let dir = tempfile::tempdir().unwrap();
        let features = dir.path().join("language_features");
        let level = |value: i32| (0..32).map(move |i| if i % 8 < 4 { value } else { -1 });
        npy(&features.join("a_s.npy"), &[4, 4, 8], &level(0).chain(level(1)).chain(level(2)).chain(level(3)).collect::<Vec<_>>());
        npy(&features.join("a_f.npy"), &[4, 2], &[1.0f32, 0.0, 0.0, 1.0, 1.0, 1.0, 0.0, -2.0]);
        let import = open(dir.path());
        let levels = import.segment("a.jpg", &photo()).unwrap().levels;
        assert_eq!(levels.each_ref().map(|m| m.at(0, 0)), [4, 3, 2], "large, medium, small");
        assert_eq!(levels[0].at(7, 0), 0);
        let embeddings = import.embed_masks("a.jpg", &photo(), &levels[0]).unwrap();
        assert_eq!(embeddings[3], [0.0, -1.0]);
    }

    #[test]
    fn spin_nerf_gaussian_grouping_and_mask_folders() {
        let dir = tempfile::tempdir().unwrap();
        gray(&dir.path().join("images_4/label/a.png"), |x, _| if x < 2 { 255 } else { 0 });
        let import = open(dir.path());
        assert_eq!(import.layout(), Layout::SpinNerf);
        let whole = |import: &Import| import.segment("a.jpg", &photo()).unwrap().levels[0].clone();
        assert_eq!((whole(&import).at(1, 0), whole(&import).at(2, 0)), (1, 0));

        gray(&dir.path().join("object_mask/a.png"), |x, _| if x < 2 { 7 } else { 9 });
        assert_eq!((open(dir.path()).layout(), whole(&open(dir.path())).at(7, 3)), (Layout::GaussianGrouping, 9));

        gray(&dir.path().join("masks/a/0.png"), |_, _| 255);
        gray(&dir.path().join("masks/a/1.png"), |x, _| if x < 2 { 255 } else { 0 });
        let import = open(dir.path());
        assert_eq!(import.layout(), Layout::MaskFolders);
        assert_eq!((whole(&import).at(0, 0), whole(&import).at(5, 0)), (2, 1));
    }

    #[test]
    fn masks_lose_the_distortion_of_the_lens() {
        let dir = tempfile::tempdir().unwrap();
        halves(8, 4).save(&dir.path().join("masks/a.png")).unwrap();
        let camera = Camera {
            cx: 4.0,
            cy: 2.0,
            fx: 4.0,
            fy: 4.0,
            ..Camera::look_at("a", glam::Vec3::Z, glam::Vec3::ZERO, glam::Vec3::Y, 8, 4, 0.8)
        };
        let lens = (camera, Distortion { k1: 1.0, ..Distortion::default() });
        let import = Import::open(dir.path(), BTreeMap::from([("a.jpg".to_owned(), lens)])).unwrap();
        let whole = import.segment("a.jpg", &photo()).unwrap().levels[0].clone();
        // The corner's ray lies outside what the distorted photo shows.
        assert_eq!((whole.at(0, 0), whole.at(3, 2), whole.at(4, 2)), (0, 1, 2));
    }

    #[test]
    fn folders_without_masks_are_refused() {
        let dir = tempfile::tempdir().unwrap();
        assert!(Import::open(dir.path(), BTreeMap::new()).err().unwrap().to_string().contains("no masks to import"));
    }
}
