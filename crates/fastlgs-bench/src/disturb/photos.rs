//! Disturbed photos and poses.

use super::random_subset;
use anyhow::{Context, Result};
use fastlgs_core::labels::{self, LabelledView};
use fastlgs_core::rng::Rng;
use fastlgs_core::scene_folder::find_view;
use fastlgs_core::{Camera, MaskList, SceneFolder, fs, image_io};
use glam::{Mat4, Quat, Vec3, Vec4};
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
        self.write_labels(to, &places)?;
        Ok(fs::write_json(
            &to.join("transforms.json"),
            &json!({ "frames": frames }),
        )?)
    }

    /// Writes `labels/` in the layout of 3D-OVS. `places` has the new number of each shot.
    fn write_labels(&self, to: &Path, places: &[usize]) -> Result<()> {
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
        Ok(fs::write_atomic(&to.join("labels/classes.txt"), |file| {
            std::io::Write::write_all(file, list.as_bytes())
        })?)
    }
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
