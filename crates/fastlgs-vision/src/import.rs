//! Imports masks and embeddings of other programs, in the layouts that these programs write.

use crate::runtime::Array;
use crate::segmenter::Segmenter;
use crate::{Encoder, Error, Result, encoder};
use fastlgs_core::dataset::{Dataset, images_folder, is_photo};
use fastlgs_core::mask_image::MaskImage;
use fastlgs_core::mask_list::{Mask, RunLengths, annotations};
use fastlgs_core::npy::{self, Npy};
use fastlgs_core::scene_folder::load_tensors;
use fastlgs_core::undistort::Distortion;
use fastlgs_core::{Camera, LabelMap, Level, MaskList};
use image::RgbImage;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Layout of the masks beside the photos.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Layout {
    /// `masks/NAME.png`: 16-bit labels, 0 means none. Finer levels are in `masks/part/` and
    /// `masks/subpart/`.
    Labels,
    /// JSON of COCO, labelme or Label Studio in `masks/`, `annotations/` or `images/`: one file for
    /// each photo (`NAME.json` or `STEM.json`) or one for all. Masks may overlap; a `track_id` is
    /// the same object in all photos.
    Annotations,
    /// `masks/STEM/*.png`: one black-and-white picture for each mask. Masks may overlap.
    MaskFolders,
    /// LangSplat's `language_features/STEM_s.npy` (levels default, small, medium, large) and
    /// `STEM_f.npy`.
    LangSplat,
    /// Gaussian Grouping's `object_mask/STEM.png`: an id is the same object in all photos.
    GaussianGrouping,
    /// SPIn-NeRF's `label/STEM.png` or `images_N/label/STEM.png`: one object, black and white.
    SpinNerf,
}

/// Camera of a photo, at any size, and the distortion of its lens. Imported masks were drawn on the
/// distorted photo.
pub type Lens = (Camera, Distortion);

/// Returns the lens of each photo, by name.
pub fn lenses(dataset: &Dataset) -> BTreeMap<String, Lens> {
    dataset
        .photos
        .iter()
        .map(|p| (p.camera.name.clone(), (p.camera.clone(), p.distortion)))
        .collect()
}

/// Imported masks and embeddings.
pub struct Import {
    photos: PathBuf,
    layout: Layout,
    lenses: BTreeMap<String, Lens>,
}

/// Largest relative difference between the aspect ratios of masks and photo.
const PROPORTIONS: f64 = 0.02;
/// Smallest IoU at which the embedding of an imported mask is used for another mask.
const MIN_IOU: f32 = 0.3;

fn stem(view: &str) -> &str {
    Path::new(view)
        .file_stem()
        .and_then(|s| s.to_str())
        .unwrap_or(view)
}

/// Masks as they are on disk, with the row of each mask's embedding. Masks of finer levels have no
/// row.
struct LoadedMasks {
    list: MaskList,
    rows: Vec<Option<usize>>,
}

impl LoadedMasks {
    /// Collects the masks of label maps, from coarse to fine. Embeddings follow the labels of the
    /// coarsest map, from 1 on.
    fn of_maps(maps: &[LabelMap]) -> Self {
        let mut found = Self {
            list: MaskList::new(maps[0].width, maps[0].height),
            rows: Vec::new(),
        };
        for (level, map) in Level::ALL.into_iter().zip(maps) {
            let row = |label: u16| (level == Level::Whole).then(|| usize::from(label) - 1);
            // Finer levels may have another size.
            let map = map.resized(found.list.width, found.list.height);
            found
                .rows
                .extend(found.list.add(level, &map).into_iter().map(row));
        }
        found
    }

    /// Takes masks whose embeddings are in the same order.
    fn in_order(list: MaskList) -> Self {
        Self {
            rows: (0..list.masks.len()).map(Some).collect(),
            list,
        }
    }
}

impl Import {
    /// Detects the layout of the folder `photos`.
    ///
    /// # Errors
    /// When it has no known layout; the message lists all of them.
    pub fn open(photos: &Path, lenses: BTreeMap<String, Lens>) -> Result<Self> {
        let masks = photos.join("masks");
        let some = |folder: &Path, want: &dyn Fn(&Path) -> bool| {
            folder
                .read_dir()
                .is_ok_and(|d| d.flatten().any(|e| want(&e.path())))
        };
        let png = |p: &Path| p.extension().is_some_and(|e| e == "png");
        let level = |p: &Path| Level::ALL.iter().any(|l| p.ends_with(l.name()));
        let layout = if some(&masks, &is_json) {
            Layout::Annotations
        } else if some(&masks, &png) || some(&masks.join("whole"), &png) {
            Layout::Labels
        } else if some(&masks, &|p| p.is_dir() && !level(p)) {
            Layout::MaskFolders
        } else if photos.join("language_features").is_dir() {
            Layout::LangSplat
        } else if photos.join("object_mask").is_dir() {
            Layout::GaussianGrouping
        } else if spin_nerf_folder(photos).is_some() {
            Layout::SpinNerf
        } else if annotation_folders(photos)
            .iter()
            .any(|folder| some(folder, &is_json))
        {
            Layout::Annotations
        } else {
            return Err(Error::Missing(format!(
                "{}: no masks to import; expected masks/*.json (COCO, labelme, Label Studio), masks/NAME.png (16-bit labels), masks/STEM/*.png, language_features/ (LangSplat), \
                 object_mask/ (Gaussian Grouping) or label/ (SPIn-NeRF) beside images/",
                photos.display()
            )));
        };
        Ok(Self {
            photos: photos.to_owned(),
            layout,
            lenses,
        })
    }

    /// Returns the detected layout.
    pub fn layout(&self) -> Layout {
        self.layout
    }

    /// Returns the first of `candidates` that exists.
    fn find(&self, view: &str, candidates: &[PathBuf]) -> Result<PathBuf> {
        candidates.iter().find(|p| p.exists()).cloned().ok_or_else(|| {
            let first = candidates.first().map(|p| p.display().to_string()).unwrap_or_default();
            Error::Missing(format!("{first}: not found, so the photo '{view}' has no masks; add them, or remove the photo from images/"))
        })
    }

    /// Loads the masks of a view from its own annotation file, or from a file for several photos.
    fn annotated(&self, view: &str) -> Result<MaskList> {
        let sides = self
            .lenses
            .get(view)
            .map(|(camera, _)| (camera.width, camera.height));
        let folders = annotation_folders(&self.photos);
        let named =
            |folder: &PathBuf| [view, stem(view)].map(|name| folder.join(format!("{name}.json")));
        let own: Vec<PathBuf> = folders
            .iter()
            .flat_map(named)
            .filter(|path| path.is_file())
            .collect();
        let mut shared: Vec<PathBuf> = folders
            .iter()
            .flat_map(|folder| folder.read_dir().into_iter().flatten().flatten())
            .map(|e| e.path())
            .collect();
        shared.retain(|path| is_json(path));
        shared.sort();
        for path in own
            .iter()
            .take(1)
            .chain(&shared)
            .filter(|path| own.first() == Some(*path) || own.is_empty())
        {
            if let Some(list) = annotations::load(path, Some(view), sides)? {
                return Ok(list);
            }
        }
        let looked_at: Vec<String> = own
            .iter()
            .chain(&shared)
            .take(5)
            .map(|path| path.display().to_string())
            .collect();
        Err(Error::Missing(format!(
            "the photo '{view}' has no masks in {}; add them, or remove the photo from images/",
            looked_at.join(", ")
        )))
    }

    /// Loads the masks of a view as they are on disk.
    fn load_masks(&self, view: &str) -> Result<LoadedMasks> {
        let stem = stem(view);
        let named = |folder: PathBuf, ending: &str| {
            [view, stem].map(|n| folder.join(format!("{n}.{ending}")))
        };
        let masks = self.photos.join("masks");
        match self.layout {
            Layout::Annotations => self.annotated(view).map(LoadedMasks::in_order),
            Layout::Labels => {
                let beside = named(masks.clone(), "png");
                let below = named(masks.join("whole"), "png");
                let whole = self.find(view, &[beside, below].concat())?;
                let finer = [Level::Part, Level::Subpart].map(|level| {
                    named(masks.join(level.name()), "png")
                        .into_iter()
                        .find(|p| p.is_file())
                });
                let whole = LabelMap::load_with_void(&whole)?;
                let empty = || Ok(LabelMap::new(whole.width, whole.height));
                let [part, subpart] = finer
                    .map(|path| path.map_or_else(empty, |path| LabelMap::load_with_void(&path)));
                Ok(LoadedMasks::of_maps(&[whole.clone(), part?, subpart?]))
            }
            Layout::MaskFolders => Ok(LoadedMasks::in_order(pictures(
                &self.find(view, &[masks.join(stem), masks.join(view)])?,
            )?)),
            Layout::LangSplat => {
                let file = self.photos.join(format!("language_features/{stem}_s.npy"));
                lang_splat_masks(&self.find(view, &[file])?)
            }
            Layout::GaussianGrouping => {
                let files = named(self.photos.join("object_mask"), "png");
                let map = LabelMap::load_with_void(&self.find(view, &files)?)?;
                let mut found = LoadedMasks::of_maps(&[map]);
                // Rows of embeddings follow the labels, and a label is the same object in all
                // photos.
                for (mask, row) in found.list.masks.iter_mut().zip(&found.rows) {
                    mask.track = row.map(|r| r as u32 + 1);
                }
                Ok(found)
            }
            Layout::SpinNerf => {
                let folder = spin_nerf_folder(&self.photos).expect("found when it was opened");
                let candidates = ["png", "jpg", "jpeg", "JPG"]
                    .map(|ending| named(folder.clone(), ending))
                    .concat();
                let mask = MaskImage::load(&self.find(view, &candidates)?)?;
                let inside = mask.inside.iter();
                Ok(LoadedMasks::of_maps(&[LabelMap {
                    width: mask.width,
                    height: mask.height,
                    labels: inside.map(|inside| u16::from(*inside)).collect(),
                }]))
            }
        }
    }

    /// Returns the masks of a view at the size of the prepared photo, without lens distortion.
    /// Masks that become empty are removed.
    fn load_prepared(&self, view: &str, width: u32, height: u32) -> Result<LoadedMasks> {
        let LoadedMasks { list, rows } = self.load_masks(view)?;
        if list.masks.is_empty() {
            tracing::warn!("the photo '{view}' has no masks");
            return Ok(LoadedMasks::in_order(MaskList::new(width, height)));
        }
        let proportions = |w: u32, h: u32| f64::from(w) / f64::from(h);
        if (proportions(list.width, list.height) / proportions(width, height) - 1.0).abs()
            > PROPORTIONS
        {
            let (w, h) = (list.width, list.height);
            return Err(Error::Invalid(format!(
                "{}: the masks of '{view}' are {w}x{h}, which does not fit a photo of {width}x{height}; use masks that are neither cropped nor rotated",
                self.photos.display()
            )));
        }
        let lens = self
            .lenses
            .get(view)
            .filter(|(_, distortion)| !distortion.is_none());
        if (list.width, list.height) == (width, height) && lens.is_none() {
            return Ok(LoadedMasks { list, rows });
        }
        let fit = |map: LabelMap| {
            let map = map.resized(width, height);
            match lens {
                Some((camera, distortion)) => {
                    map.undistorted(&camera.resized(width, height), distortion)
                }
                None => map,
            }
        };
        let (masks, rows) = list
            .redrawn(fit)
            .zip(rows)
            .filter_map(|(mask, row)| Some((mask?, row)))
            .unzip();
        Ok(LoadedMasks {
            list: MaskList {
                masks,
                ..MaskList::new(width, height)
            },
            rows,
        })
    }

    /// Loads the embeddings of a view's *whole* masks, label 1 first; `None` if there are none.
    fn rows(&self, view: &str) -> Result<Option<Array>> {
        let stem = stem(view);
        let rows = if self.layout == Layout::LangSplat {
            array(npy::read(
                &self.photos.join(format!("language_features/{stem}_f.npy")),
            )?)
        } else {
            let at = |ending: &str| {
                [view, stem]
                    .map(|n| self.photos.join(format!("embeddings/{n}.{ending}")))
                    .into_iter()
                    .find(|p| p.is_file())
            };
            if let Some(path) = at("npy") {
                array(npy::read(&path)?)
            } else if let Some(path) = at("safetensors") {
                let mut tensors = load_tensors(&path)?;
                let (shape, values) = tensors.remove("embeddings").ok_or_else(|| {
                    Error::Invalid(format!(
                        "{}: it has no tensor 'embeddings'; write one with a row for each mask",
                        path.display()
                    ))
                })?;
                Array::new(shape, values)
            } else {
                return Ok(None);
            }
        };
        if rows.shape.len() != 2 || rows.values.iter().any(|v| !v.is_finite()) {
            return Err(Error::Invalid(format!(
                "{}: the embeddings of '{view}' have shape {:?}; write one row of finite numbers for each mask",
                self.photos.display(),
                rows.shape
            )));
        }
        Ok(Some(rows))
    }
}

fn array(npy: Npy) -> Array {
    Array::new(
        npy.shape,
        npy.values.into_iter().map(|v| v as f32).collect(),
    )
}

/// Returns SPIn-NeRF's label folder of the highest resolution: `label` or `images_N/label`.
fn spin_nerf_folder(photos: &Path) -> Option<PathBuf> {
    let folders = [
        "label",
        "images/label",
        "images_2/label",
        "images_4/label",
        "images_8/label",
    ];
    folders.iter().map(|f| photos.join(f)).find(|f| f.is_dir())
}

fn is_json(path: &Path) -> bool {
    path.extension().is_some_and(|ending| ending == "json")
}

/// Returns the folders in which annotation programs save their files.
fn annotation_folders(photos: &Path) -> Vec<PathBuf> {
    let mut folders = vec![photos.join("masks"), photos.join("annotations")];
    folders.extend(images_folder(photos));
    folders.retain(|folder| folder != photos);
    folders
}

/// Loads all black-and-white pictures of a folder as masks, in the order of their names.
fn pictures(folder: &Path) -> Result<MaskList> {
    let entries = folder.read_dir().map_err(fastlgs_core::Error::io(folder))?;
    let mut paths: Vec<PathBuf> = entries
        .flatten()
        .map(|e| e.path())
        .filter(|p| is_photo(p))
        .collect();
    paths.sort();
    let mut list: Option<MaskList> = None;
    for path in paths {
        let picture = MaskImage::load(&path)?;
        let (width, height) = (picture.width, picture.height);
        let list = list.get_or_insert_with(|| MaskList::new(width, height));
        if (list.width, list.height) != (width, height) {
            return Err(Error::Invalid(format!(
                "{}: its size differs from that of the other masks in its folder; use one size",
                path.display()
            )));
        }
        list.masks.push(Mask::new(
            Level::Whole,
            RunLengths::from_fn(width, height, |x, y| {
                picture.inside[(y * width + x) as usize]
            }),
        ));
    }
    list.ok_or_else(|| {
        Error::Missing(format!(
            "{}: the folder contains no masks; add *.png files",
            folder.display()
        ))
    })
}

impl Segmenter for Import {
    fn segment(&self, view: &str, photo: &RgbImage) -> Result<MaskList> {
        Ok(self
            .load_prepared(view, photo.width(), photo.height())?
            .list)
    }
}

impl Encoder for Import {
    /// Returns the imported embedding of the mask that fits each label best; zeros if none fits.
    fn embed_masks(&self, view: &str, photo: &RgbImage, masks: &LabelMap) -> Result<Vec<Vec<f32>>> {
        let missing = || {
            let folder = self.photos.display();
            Error::Missing(format!(
                "{folder}/embeddings: no embeddings of '{view}'; add a .npy or .safetensors file with one row for each mask"
            ))
        };
        let embeddings = self.rows(view)?.ok_or_else(missing)?;
        let dimension = embeddings.shape[1];
        let LoadedMasks { list, rows } = self.load_prepared(view, photo.width(), photo.height())?;
        // Count the masks on disk: undistorting may have removed some.
        let needed = self
            .load_masks(view)?
            .rows
            .iter()
            .flatten()
            .max()
            .map_or(0, |r| r + 1);
        let given = embeddings.shape[0];
        // LangSplat's rows cover all levels.
        if needed > given || (needed < given && self.layout != Layout::LangSplat) {
            let row_unit = match self.layout {
                Layout::Labels | Layout::GaussianGrouping | Layout::SpinNerf => {
                    "labels (row 0 is label 1; the background has no row)"
                }
                Layout::Annotations | Layout::MaskFolders | Layout::LangSplat => {
                    "masks (rows are in their order)"
                }
            };
            return Err(Error::Invalid(format!(
                "{}/embeddings: '{view}' has {given} embeddings for {needed} {row_unit}; write one row for each",
                self.photos.display()
            )));
        }
        let with_row = MaskList {
            masks: list
                .masks
                .iter()
                .zip(&rows)
                .filter(|m| m.1.is_some())
                .map(|m| m.0.clone())
                .collect(),
            ..list
        };
        let rows: Vec<usize> = rows.into_iter().flatten().collect();
        let embedding = |place: Option<usize>| match place {
            Some(place) => {
                let mut row = embeddings.values[rows[place] * dimension..][..dimension].to_vec();
                encoder::normalise(&mut row);
                row
            }
            None => vec![0.0; dimension],
        };
        Ok(best_matches(masks, &with_row)
            .into_iter()
            .map(embedding)
            .collect())
    }
}

/// Returns for each label 1..=max of `masks` the index of the mask in `others` with the largest
/// IoU; `None` if that is too small. Both have the same size.
pub fn best_matches(masks: &LabelMap, others: &MaskList) -> Vec<Option<usize>> {
    let areas = masks.areas();
    let mut best: Vec<(f32, Option<usize>)> = vec![(MIN_IOU, None); areas.len()];
    for (place, other) in others.masks.iter().enumerate() {
        let mut common: BTreeMap<u16, usize> = BTreeMap::new();
        others
            .pixel_indices(other)
            .for_each(|p| *common.entry(masks.labels[p]).or_default() += 1);
        let area = other.runs.area();
        for (label, n) in common {
            let iou = n as f32 / (areas[usize::from(label)] + area - n) as f32;
            let (before, chosen) = &mut best[usize::from(label)];
            if iou > *before || (iou == *before && chosen.is_none()) {
                (*before, *chosen) = (iou, Some(place));
            }
        }
    }
    best.into_iter().skip(1).map(|b| b.1).collect()
}

/// Reads the segmentations of LangSplat: (4, rows, columns), of which the last three are subpart,
/// part and whole, or (1, rows, columns).
fn lang_splat_masks(path: &Path) -> Result<LoadedMasks> {
    let Npy { shape, values } = npy::read(path)?;
    let [levels @ (1 | 4), rows, columns] = shape[..] else {
        return Err(Error::Invalid(format!(
            "{}: the array has shape {shape:?}; LangSplat's segmentations have (4, rows, columns)",
            path.display()
        )));
    };
    let level = |k: usize| {
        let own = &values[k * rows * columns..][..rows * columns];
        LabelMap {
            width: columns as u32,
            height: rows as u32,
            labels: own.iter().map(|v| (v + 1.0).max(0.0) as u16).collect(),
        }
    };
    Ok(if levels == 1 {
        LoadedMasks::of_maps(&[level(0)])
    } else {
        LoadedMasks::of_maps(&[3, 2, 1].map(level))
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use fastlgs_core::image_io;
    use image::{GrayImage, Luma};
    use npyz::WriterBuilder;

    const PHOTO: (u32, u32) = (8, 4);

    fn photo() -> RgbImage {
        RgbImage::new(PHOTO.0, PHOTO.1)
    }

    /// Label map with 1 in the left half and 2 in the right half.
    fn halves(width: u32, height: u32) -> LabelMap {
        LabelMap {
            width,
            height,
            labels: (0..width * height)
                .map(|i| if i % width < width / 2 { 1 } else { 2 })
                .collect(),
        }
    }

    fn npy<T: npyz::AutoSerialize + Copy>(path: &Path, shape: &[u64], values: &[T]) {
        let mut bytes = Vec::new();
        let mut writer = npyz::WriteOptions::new()
            .default_dtype()
            .shape(shape)
            .writer(&mut bytes)
            .begin_nd()
            .unwrap();
        writer.extend(values.iter().copied()).unwrap();
        writer.finish().unwrap();
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, bytes).unwrap();
    }

    fn open(dir: &Path) -> Import {
        Import::open(dir, BTreeMap::new()).unwrap()
    }

    fn levels(import: &Import) -> [LabelMap; 3] {
        let found = import.segment("a.jpg", &photo()).unwrap();
        Level::ALL.map(|level| found.painted(level))
    }

    fn gray(path: &Path, value: impl Fn(u32, u32) -> u8) {
        image_io::save_png(
            path,
            GrayImage::from_fn(PHOTO.0, PHOTO.1, |x, y| Luma([value(x, y)])),
        )
        .unwrap();
    }

    #[test]
    fn label_maps_with_levels() {
        let dir = tempfile::tempdir().unwrap();
        halves(16, 8)
            .save(&dir.path().join("masks/a.jpg.png"))
            .unwrap();
        halves(8, 4)
            .save(&dir.path().join("masks/part/a.png"))
            .unwrap();
        let import = open(dir.path());
        assert_eq!(import.layout(), Layout::Labels);
        let [whole, part, subpart] = levels(&import);
        assert_eq!(
            (&whole, &part),
            (&halves(8, 4), &halves(8, 4)),
            "scaled to the photo"
        );
        assert_eq!(subpart.max(), 0);
        assert!(
            import
                .segment("b.jpg", &photo())
                .err()
                .unwrap()
                .to_string()
                .contains("b.jpg")
        );
        halves(8, 8).save(&dir.path().join("masks/c.png")).unwrap();
        let error = import.segment("c.jpg", &photo()).err().unwrap().to_string();
        assert!(error.contains("8x8") && error.contains("8x4"), "{error}");
        assert!(
            import
                .embed_masks("a.jpg", &photo(), &whole)
                .unwrap_err()
                .to_string()
                .contains("embeddings")
        );
    }

    #[test]
    fn embeddings_follow_the_masks_that_fit() {
        let dir = tempfile::tempdir().unwrap();
        halves(8, 4).save(&dir.path().join("masks/a.png")).unwrap();
        npy(
            &dir.path().join("embeddings/a.npy"),
            &[2, 2],
            &[3.0f32, 0.0, 0.0, 2.0],
        );
        let import = open(dir.path());
        // Swapped labels, and one mask that fits no imported mask.
        let mut other = halves(8, 4);
        other.labels.iter_mut().for_each(|l| *l = 3 - *l);
        other.labels[0] = 3;
        assert_eq!(
            import.embed_masks("a.jpg", &photo(), &other).unwrap(),
            [vec![0.0, 1.0], vec![1.0, 0.0], vec![0.0, 0.0]]
        );
        npy(
            &dir.path().join("embeddings/a.npy"),
            &[1, 2],
            &[3.0f32, 0.0],
        );
        assert!(
            import
                .embed_masks("a.jpg", &photo(), &other)
                .unwrap_err()
                .to_string()
                .contains("1 embeddings")
        );
        npy(
            &dir.path().join("embeddings/a.npy"),
            &[3, 2],
            &[9.0f32, 9.0, 3.0, 0.0, 0.0, 2.0],
        );
        let background = import
            .embed_masks("a.jpg", &photo(), &other)
            .unwrap_err()
            .to_string();
        assert!(
            background.contains("3 embeddings for 2 labels") && background.contains("background"),
            "{background}"
        );
        // Each of two overlapping masks is matched on its own.
        let both = |x: u32| if x < 2 { 1 } else { 2 };
        let map = LabelMap {
            width: 8,
            height: 4,
            labels: (0..32).map(|p| both(p % 8)).collect(),
        };
        let list = |ends: [u32; 2]| MaskList {
            masks: ends
                .map(|end| Mask::new(Level::Whole, RunLengths::from_fn(8, 4, |x, _| x < end)))
                .to_vec(),
            ..MaskList::new(8, 4)
        };
        assert_eq!(best_matches(&map, &list([8, 2])), [Some(1), Some(0)]);
    }

    #[test]
    fn langsplat() {
        let dir = tempfile::tempdir().unwrap();
        let features = dir.path().join("language_features");
        let level = |value: i32| (0..32).map(move |i| if i % 8 < 4 { value } else { -1 });
        npy(
            &features.join("a_s.npy"),
            &[4, 4, 8],
            &level(0)
                .chain(level(1))
                .chain(level(2))
                .chain(level(3))
                .collect::<Vec<_>>(),
        );
        npy(
            &features.join("a_f.npy"),
            &[4, 2],
            &[1.0f32, 0.0, 0.0, 1.0, 1.0, 1.0, 0.0, -2.0],
        );
        let import = open(dir.path());
        let levels = levels(&import);
        assert_eq!(
            levels.each_ref().map(|m| m.at(0, 0)),
            [1; 3],
            "large, medium, small"
        );
        assert_eq!(levels[0].at(7, 0), 0);
        let embeddings = import.embed_masks("a.jpg", &photo(), &levels[0]).unwrap();
        assert_eq!(embeddings, [[0.0, -1.0]], "embedding of the large mask");
    }

    #[test]
    fn spin_nerf_gaussian_grouping_and_mask_folders() {
        let dir = tempfile::tempdir().unwrap();
        gray(&dir.path().join("images_4/label/a.png"), |x, _| {
            if x < 2 { 255 } else { 0 }
        });
        let import = open(dir.path());
        assert_eq!(import.layout(), Layout::SpinNerf);
        let whole = |import: &Import| levels(import)[0].clone();
        assert_eq!((whole(&import).at(1, 0), whole(&import).at(2, 0)), (1, 0));

        gray(&dir.path().join("object_mask/a.png"), |x, _| {
            if x < 2 { 7 } else { 9 }
        });
        assert_eq!(open(dir.path()).layout(), Layout::GaussianGrouping);
        let tracks: Vec<_> = open(dir.path())
            .segment("a.jpg", &photo())
            .unwrap()
            .masks
            .iter()
            .map(|m| m.track)
            .collect();
        assert_eq!(tracks, [Some(7), Some(9)]);

        gray(&dir.path().join("masks/a/0.png"), |_, _| 255);
        gray(&dir.path().join("masks/a/1.png"), |x, _| {
            if x < 2 { 255 } else { 0 }
        });
        let import = open(dir.path());
        assert_eq!(import.layout(), Layout::MaskFolders);
        assert_eq!((whole(&import).at(0, 0), whole(&import).at(5, 0)), (2, 1));
        let areas: Vec<usize> = import
            .segment("a.jpg", &photo())
            .unwrap()
            .masks
            .iter()
            .map(|m| m.runs.area())
            .collect();
        assert_eq!(areas, [32, 8], "the mask below is complete");

        // Masks with the values 0 and 1.
        gray(&dir.path().join("masks/a/0.png"), |_, _| 1);
        gray(&dir.path().join("masks/a/1.png"), |x, _| u8::from(x < 2));
        let areas: Vec<usize> = import
            .segment("a.jpg", &photo())
            .unwrap()
            .masks
            .iter()
            .map(|m| m.runs.area())
            .collect();
        assert_eq!(areas, [32, 8]);

        import
            .segment("a.jpg", &photo())
            .unwrap()
            .save(&dir.path().join("masks/a.json"))
            .unwrap();
        assert_eq!(open(dir.path()).layout(), Layout::Annotations);
        assert_eq!(
            open(dir.path()).segment("a.jpg", &photo()).unwrap(),
            import.segment("a.jpg", &photo()).unwrap()
        );
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
            ..Camera::look_at(
                "a",
                glam::Vec3::Z,
                glam::Vec3::ZERO,
                glam::Vec3::Y,
                8,
                4,
                0.8,
            )
        };
        let lens = (
            camera,
            Distortion {
                k1: 1.0,
                ..Distortion::default()
            },
        );
        let import =
            Import::open(dir.path(), BTreeMap::from([("a.jpg".to_owned(), lens)])).unwrap();
        let [whole, ..] = levels(&import);
        // The ray of the corner lies outside of the distorted photo.
        assert_eq!((whole.at(0, 0), whole.at(3, 2), whole.at(4, 2)), (0, 1, 2));
    }

    #[test]
    fn folders_without_masks_are_refused() {
        let dir = tempfile::tempdir().unwrap();
        assert!(
            Import::open(dir.path(), BTreeMap::new())
                .err()
                .unwrap()
                .to_string()
                .contains("no masks to import")
        );
    }
}
