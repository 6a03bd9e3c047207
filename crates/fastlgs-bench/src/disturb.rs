//! Disturbances of photos, masks and embeddings, for `fastlgs-bench all`.

use anyhow::{Context, Result};
use fastlgs::model_choice;
use fastlgs_core::labels::{self, LabelledView};
use fastlgs_core::mask_list::{Mask, RunLengths};
use fastlgs_core::rng::Rng;
use fastlgs_core::scene_folder::find_view;
use fastlgs_core::{Camera, MaskList, SceneFolder, fs, image_io};
use fastlgs_grid::Grid;
use glam::{Mat4, Quat, Vec2, Vec3, Vec4};
use image::codecs::jpeg::JpegEncoder;
use image::{GrayImage, Luma, RgbImage, imageops};
use serde_json::json;
use std::collections::BTreeSet;
use std::io::Cursor;
use std::path::Path;

/// A change of photos or poses. Labelled views keep their photo and pose, because accuracy is
/// measured on them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum PhotoChange {
    /// No change: the reference.
    Unchanged,
    /// A random rotation of each camera, with this mean shift of the image in pixels.
    Pose(f32),
    /// A random fraction of the photos is missing.
    Missing(f32),
    /// The photos are in random order.
    Shuffled,
    /// Random brightness of each photo, with this standard deviation in stops.
    Exposure(f32),
    /// Random gains of red and blue of each photo, with this standard deviation around 1.
    WhiteBalance(f32),
    /// A Gaussian blur with this standard deviation in pixels.
    Blur(f32),
    /// JPEG compression of this quality, 1 to 100.
    Jpeg(u8),
    /// The focal length is too long by this fraction.
    Focal(f32),
}

/// A change of the masks of all levels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum MaskChange {
    /// Erosion by this many pixels.
    Eroded(u32),
    /// A random fraction of the masks is split in two along a line.
    Split(f32),
    /// A random fraction of the masks is merged with an adjacent mask.
    Merged(f32),
    /// A random fraction of the masks is missing.
    Dropped(f32),
}

/// A prepared photo with its camera and masks.
struct Shot {
    camera: Camera,
    pixels: RgbImage,
    /// Ignored pixels are black.
    ignore: Option<GrayImage>,
    /// Imported masks. `None` if a segmenter makes the masks.
    masks: Option<MaskList>,
    labelled: bool,
}

/// The prepared photos of a scene, with its labels.
pub struct Album {
    shots: Vec<Shot>,
    labels: Vec<LabelledView>,
    /// Name of the shot of each labelled view, in the order of `labels`.
    labelled: Vec<String>,
}

impl Album {
    /// Loads the training views and labelled views of a scene. Masks are loaded if the scene
    /// imported them.
    ///
    /// # Errors
    /// Unreadable files, or a label without a photo.
    pub fn of(scene: &SceneFolder, label_folder: &Path) -> Result<Self> {
        let manifest = scene.manifest()?;
        let cameras = scene.cameras()?;
        let labels = labels::load(label_folder, None)?;
        let named = |view: &LabelledView| {
            find_view(cameras.iter().map(|c| c.name.as_str()), &view.name)
                .map(|i| cameras[i].name.clone())
        };
        let labelled: Vec<String> = labels
            .iter()
            .map(|v| {
                named(v).with_context(|| {
                    format!("{}: the labels name a photo that the scene lacks", v.name)
                })
            })
            .collect::<Result<_>>()?;
        let training: BTreeSet<String> = manifest
            .training(&cameras)
            .into_iter()
            .map(|c| c.name)
            .collect();
        let mut shots = Vec::new();
        for camera in cameras
            .into_iter()
            .filter(|c| training.contains(&c.name) || labelled.contains(&c.name))
        {
            let name = &camera.name;
            let ignored: Vec<GrayImage> = [scene.ignore_path(name), scene.alpha_path(name)]
                .into_iter()
                .filter(|p| p.is_file())
                .map(|p| image_io::load_gray(&p))
                .collect::<Result<_, _>>()?;
            let darker = |a: GrayImage, b: GrayImage| {
                GrayImage::from_fn(a.width(), a.height(), |x, y| {
                    Luma([a.get_pixel(x, y)[0].min(b.get_pixel(x, y)[0])])
                })
            };
            let own = manifest.segmenter == "import" && scene.masks_path(name).is_file();
            let masks = own.then(|| scene.masks(&camera)).transpose()?;
            let (pixels, labelled) = (scene.photo(name)?, labelled.contains(name));
            shots.push(Shot {
                ignore: ignored.into_iter().reduce(darker),
                pixels,
                masks,
                labelled,
                camera,
            });
        }
        Ok(Self {
            shots,
            labels,
            labelled,
        })
    }

    /// Writes a dataset with the changed photos into `to`: `images/`, `transforms.json`, `masks/`,
    /// `ignore/`, and `labels/` in the layout of 3D-OVS.
    pub fn write(&self, to: &Path, change: PhotoChange, seed: u64) -> Result<()> {
        let mut rng = Rng::new(seed, "disturbed photos");
        let missing = match change {
            PhotoChange::Missing(share) => random_subset(self.shots.len(), share, &mut rng, |k| {
                !self.shots[k].labelled
            }),
            _ => BTreeSet::new(),
        };
        let mut places: Vec<usize> = (0..self.shots.len()).collect();
        if change == PhotoChange::Shuffled {
            rng.shuffle(&mut places);
        }
        let mut frames = Vec::new();
        for (shot, place) in self
            .shots
            .iter()
            .zip(&places)
            .enumerate()
            .filter(|(k, _)| !missing.contains(k))
            .map(|(_, s)| s)
        {
            let (camera, pixels) = if shot.labelled {
                (shot.camera.clone(), shot.pixels.clone())
            } else {
                shot.changed(change, &mut rng)?
            };
            let name = format!("{place:05}.png");
            image_io::save_png(&to.join("images").join(&name), pixels)?;
            if let Some(ignore) = &shot.ignore {
                image_io::save_png(
                    &to.join("ignore").join(format!("{name}.png")),
                    ignore.clone(),
                )?;
            }
            if let Some(masks) = &shot.masks {
                masks.save(&to.join("masks").join(format!("{name}.json")))?;
            }
            let flip = Mat4::from_diagonal(Vec4::new(1.0, -1.0, -1.0, 1.0));
            let camera_to_world = (camera.world_to_camera.inverse() * flip)
                .transpose()
                .to_cols_array_2d();
            frames.push(json!({
                "file_path": format!("images/{name}"), "transform_matrix": camera_to_world,
                "fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy, "w": camera.width, "h": camera.height,
            }));
        }
        let mut classes = BTreeSet::new();
        for (view, name) in self.labels.iter().zip(&self.labelled) {
            let place = places[self
                .shots
                .iter()
                .position(|s| s.camera.name == *name)
                .context("a labelled shot")?];
            for label in &view.labels {
                let mask = view.mask(label, view.width, view.height);
                let picture = GrayImage::from_fn(view.width, view.height, |x, y| {
                    Luma([255 * u8::from(mask[(y * view.width + x) as usize])])
                });
                // The category becomes a file name, which cannot have a slash.
                let class = label.category.replace('/', " ");
                image_io::save_png(&to.join(format!("labels/{place:05}/{class}.png")), picture)?;
                classes.insert(class);
            }
        }
        let list: String = classes.iter().map(|c| format!("{c}\n")).collect();
        fs::write_atomic(&to.join("labels/classes.txt"), |file| {
            std::io::Write::write_all(file, list.as_bytes())
        })?;
        Ok(fs::write_json(
            &to.join("transforms.json"),
            &json!({ "frames": frames }),
        )?)
    }
}

/// Returns a random `share` (0 to 1) of the indices below `count` that `is_candidate` accepts.
fn random_subset(
    count: usize,
    share: f32,
    rng: &mut Rng,
    is_candidate: impl Fn(usize) -> bool,
) -> BTreeSet<usize> {
    let mut all: Vec<usize> = (0..count).filter(|k| is_candidate(*k)).collect();
    rng.shuffle(&mut all);
    all.truncate((share * all.len() as f32).round() as usize);
    all.into_iter().collect()
}

impl Shot {
    fn changed(&self, change: PhotoChange, rng: &mut Rng) -> Result<(Camera, RgbImage)> {
        let (mut camera, mut pixels) = (self.camera.clone(), self.pixels.clone());
        match change {
            PhotoChange::Unchanged | PhotoChange::Missing(_) | PhotoChange::Shuffled => {}
            PhotoChange::Pose(moved) => {
                // A vector of two standard normal numbers has the mean length sqrt(pi / 2).
                let deviation = moved / (camera.fx * std::f32::consts::FRAC_PI_2.sqrt());
                let axis = Vec3::new(rng.normal(), rng.normal(), 0.0) * deviation;
                camera.world_to_camera =
                    Mat4::from_quat(Quat::from_scaled_axis(axis)) * camera.world_to_camera;
            }
            PhotoChange::Exposure(stops) => {
                let gain = (stops * rng.normal()).exp2();
                scale_channels(&mut pixels, [gain; 3]);
            }
            PhotoChange::WhiteBalance(deviation) => {
                let gains = [
                    1.0 + deviation * rng.normal(),
                    1.0,
                    1.0 + deviation * rng.normal(),
                ];
                scale_channels(&mut pixels, gains);
            }
            PhotoChange::Blur(sigma) => pixels = imageops::blur(&pixels, sigma),
            PhotoChange::Jpeg(quality) => {
                let mut file = Vec::new();
                JpegEncoder::new_with_quality(Cursor::new(&mut file), quality)
                    .encode_image(&pixels)?;
                pixels = image::load_from_memory(&file)?.into_rgb8();
            }
            PhotoChange::Focal(share) => {
                (camera.fx, camera.fy) = (camera.fx * (1.0 + share), camera.fy * (1.0 + share))
            }
        }
        Ok((camera, pixels))
    }
}

fn scale_channels(pixels: &mut RgbImage, gains: [f32; 3]) {
    for pixel in pixels.pixels_mut() {
        for (value, gain) in pixel.0.iter_mut().zip(gains) {
            *value = (f32::from(*value) * gain + 0.5).clamp(0.0, 255.0) as u8;
        }
    }
}

/// Changes the masks of all training views of a scene in place.
pub fn masks(scene: &SceneFolder, change: MaskChange, seed: u64) -> Result<()> {
    let mut rng = Rng::new(seed, "disturbed masks");
    for camera in scene.manifest()?.training(&scene.cameras()?) {
        changed_masks(&scene.masks(&camera)?, change, &mut rng)
            .save(&scene.masks_path(&camera.name))?;
    }
    Ok(())
}

/// Returns the changed masks. They may overlap, as the given ones. Empty masks are removed.
fn changed_masks(list: &MaskList, change: MaskChange, rng: &mut Rng) -> MaskList {
    let (w, h) = (list.width as usize, list.height as usize);
    let drawn = |runs: &RunLengths| {
        let mut inside = vec![false; w * h];
        runs.pixel_indices(list.width, list.height)
            .for_each(|p| inside[p] = true);
        inside
    };
    let runs = |inside: &[bool]| {
        RunLengths::from_fn(list.width, list.height, |x, y| {
            inside[y as usize * w + x as usize]
        })
    };
    let some = |share: f32, rng: &mut Rng| random_subset(list.masks.len(), share, rng, |_| true);
    let mut out = list.clone();
    match change {
        MaskChange::Eroded(pixels) => out.masks.iter_mut().for_each(|mask| {
            let inside = drawn(&mask.runs);
            mask.runs = runs(
                &(0..w * h)
                    .map(|p| neighbours(p, w, h, pixels as isize).all(|q| inside[q]))
                    .collect::<Vec<_>>(),
            );
        }),
        MaskChange::Dropped(share) => {
            let dropped = some(share, rng);
            out.masks = out
                .masks
                .into_iter()
                .enumerate()
                .filter(|(k, _)| !dropped.contains(k))
                .map(|m| m.1)
                .collect();
        }
        MaskChange::Merged(share) => {
            for own in some(share, rng) {
                let mut inside = drawn(&out.masks[own].runs);
                let around: Vec<bool> = (0..w * h)
                    .map(|p| neighbours(p, w, h, 1).any(|q| inside[q]))
                    .collect();
                let is_adjacent = |other: &&Mask| {
                    let both = other.runs.pixel_indices(list.width, list.height);
                    let (touching, common) =
                        both.fold((false, false), |(t, c), p| (t || around[p], c || inside[p]));
                    other.level == list.masks[own].level && touching && !common
                };
                let beside: Vec<usize> = (0..list.masks.len())
                    .filter(|k| is_adjacent(&&out.masks[*k]))
                    .collect();
                if !beside.is_empty() {
                    let other = &mut out.masks[beside[rng.below(beside.len())]];
                    std::mem::take(&mut other.runs)
                        .pixel_indices(list.width, list.height)
                        .for_each(|p| inside[p] = true);
                    out.masks[own] = Mask {
                        runs: runs(&inside),
                        track: None,
                        ..out.masks[own].clone()
                    };
                }
            }
        }
        MaskChange::Split(share) => {
            for own in some(share, rng) {
                let inside = drawn(&list.masks[own].runs);
                let place = |p: usize| Vec2::new((p % w) as f32, (p / w) as f32);
                let middle = list
                    .pixel_indices(&list.masks[own])
                    .map(place)
                    .sum::<Vec2>()
                    / list.masks[own].runs.area() as f32;
                let across = Vec2::from_angle(std::f32::consts::TAU * rng.uniform());
                let half = |side: bool| {
                    runs(
                        &(0..w * h)
                            .map(|p| inside[p] && (across.dot(place(p) - middle) > 0.0) == side)
                            .collect::<Vec<_>>(),
                    )
                };
                out.masks[own] = Mask {
                    runs: half(false),
                    track: None,
                    ..list.masks[own].clone()
                };
                out.masks.push(Mask {
                    runs: half(true),
                    ..out.masks[own].clone()
                });
            }
        }
    }
    out.masks.retain(|mask| mask.runs.area() > 0);
    out
}

/// Returns the indices of the pixels in the same row or column, up to `pixels` away. At the image
/// border, indices are clamped.
fn neighbours(place: usize, w: usize, h: usize, pixels: isize) -> impl Iterator<Item = usize> {
    let (x, y) = ((place % w) as isize, (place / w) as isize);
    let at = move |x: isize, y: isize| {
        y.clamp(0, h as isize - 1) as usize * w + x.clamp(0, w as isize - 1) as usize
    };
    (-pixels..=pixels).flat_map(move |d| [at(x + d, y), at(x, y + d)])
}

/// Adds noise to the part of each object's embeddings that texts are compared with, and normalises
/// that part. `noise` is the root mean square length of the added vector.
pub fn embeddings(scene: &SceneFolder, noise: f32, seed: u64) -> Result<()> {
    let mut rng = Rng::new(seed, "disturbed embeddings");
    let mut grid = Grid::load(scene)?;
    let manifest = scene.manifest()?;
    for embedding in grid.objects.iter_mut().flat_map(|o| &mut o.embeddings) {
        let words = model_choice::text_components(&manifest, embedding);
        let deviation = noise / (words.len() as f32).sqrt();
        words
            .iter_mut()
            .for_each(|v| *v += deviation * rng.normal());
        let length = words
            .iter()
            .map(|v| v * v)
            .sum::<f32>()
            .sqrt()
            .max(f32::MIN_POSITIVE);
        words.iter_mut().for_each(|v| *v /= length);
    }
    Ok(grid.save(scene)?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use fastlgs_core::Level;

    /// Whole masks of columns 2..4, 4..6 and 6..8 of eight, and a part mask of columns 2..6.
    fn list() -> MaskList {
        let columns = |from: u32, to: u32| {
            Mask::new(
                Level::Whole,
                RunLengths::from_fn(8, 4, |x, _| (from..to).contains(&x)),
            )
        };
        let both = Mask {
            level: Level::Part,
            ..columns(2, 6)
        };
        MaskList {
            masks: vec![columns(2, 4), columns(4, 6), columns(6, 8), both],
            ..MaskList::new(8, 4)
        }
    }

    fn areas(change: MaskChange) -> Vec<usize> {
        changed_masks(&list(), change, &mut Rng::new(0, "test"))
            .masks
            .iter()
            .map(|m| m.runs.area())
            .collect()
    }

    #[test]
    fn changed_masks_have_the_expected_areas() {
        assert_eq!(
            areas(MaskChange::Eroded(1)),
            [4, 8],
            "the image border protects the last mask, and the wide mask keeps its middle columns"
        );
        assert_eq!(areas(MaskChange::Dropped(0.5)).len(), 2);
        let split = areas(MaskChange::Split(1.0));
        assert_eq!((split.len(), split.iter().sum::<usize>()), (8, 40));
        let merged = areas(MaskChange::Merged(1.0));
        assert_eq!(
            merged,
            [24, 16],
            "the three whole masks become one; the part mask has no adjacent mask of its level"
        );
    }
}
