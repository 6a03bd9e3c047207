//! SIFT key points (Lowe 2004), and the epipolar check of their matches.

use crate::{Error, Result};
use fastlgs_core::Camera;
use glam::{Mat3, Vec2, Vec3};
use image::GrayImage;

/// Key points of one photo.
#[derive(Clone, Debug, Default, serde::Serialize, serde::Deserialize)]
pub struct Keypoints {
    /// Positions in pixels; (0, 0) is the corner of the first pixel.
    pub positions: Vec<Vec2>,
    /// 128-byte descriptors.
    #[serde(with = "descriptors")]
    pub descriptors: Vec<[u8; 128]>,
}

/// Stores descriptors as one byte string, because Serde does not support arrays of length 128.
mod descriptors {
    use serde::{Deserialize, Deserializer, Serializer};

    pub fn serialize<S: Serializer>(all: &[[u8; 128]], to: S) -> Result<S::Ok, S::Error> {
        to.serialize_bytes(all.as_flattened())
    }

    pub fn deserialize<'d, D: Deserializer<'d>>(from: D) -> Result<Vec<[u8; 128]>, D::Error> {
        Ok(Vec::<u8>::deserialize(from)?.as_chunks().0.to_vec())
    }
}

/// Largest number of key points of a photo; the strongest are kept.
pub const MAX_KEYPOINTS: usize = 2500;

/// Detects and describes key points, with OpenCV if this build has it, otherwise in pure Rust.
///
/// # Errors
/// When the detector rejects the picture.
pub fn detect(photo: &GrayImage) -> Result<Keypoints> {
    #[cfg(feature = "opencv")]
    return detect_with_opencv(photo);
    #[cfg(not(feature = "opencv"))]
    detect_in_rust(photo)
}

#[cfg(feature = "opencv")]
fn detect_with_opencv(photo: &GrayImage) -> Result<Keypoints> {
    let (positions, descriptors) = fastlgs_opencv::sift::detect(photo, MAX_KEYPOINTS)
        .map_err(|e| Error::KeyPoints(e.to_string()))?;
    Ok(Keypoints {
        positions,
        descriptors,
    })
}

/// Smoothing and scaling of pictures for the SIFT in Rust.
///
/// Halving keeps the first of two pixels, so that the first pixels of all octaves coincide. The
/// default of the library keeps the second, which shifts each octave further.
#[cfg(feature = "rust-sift")]
struct Scaling;

#[cfg(feature = "rust-sift")]
type Floats = image::ImageBuffer<image::Luma<f32>, Vec<f32>>;

#[cfg(feature = "rust-sift")]
impl sift_features::Processing for Scaling {
    fn gaussian_blur(picture: &Floats, sigma: f64) -> Floats {
        sift_features::ImageprocProcessing::gaussian_blur(picture, sigma)
    }

    fn resize_linear(picture: &Floats, width: u32, height: u32) -> Floats {
        sift_features::ImageprocProcessing::resize_linear(picture, width, height)
    }

    fn resize_nearest(picture: &Floats, width: u32, height: u32) -> Floats {
        let [right, bottom] = [picture.width() - 1, picture.height() - 1];
        Floats::from_fn(width, height, |x, y| {
            *picture.get_pixel((2 * x).min(right), (2 * y).min(bottom))
        })
    }
}

#[cfg(feature = "rust-sift")]
#[cfg_attr(feature = "opencv", allow(dead_code, reason = "tests compare both"))]
fn detect_in_rust(photo: &GrayImage) -> Result<Keypoints> {
    let found = sift_features::sift_with_processing::<Scaling>(photo, Some(MAX_KEYPOINTS));
    let descriptors = found
        .descriptors
        .rows()
        .into_iter()
        .map(|row| std::array::from_fn(|k| row[k]))
        .collect::<Vec<[u8; 128]>>();
    if descriptors.len() != found.keypoints.len() {
        return Err(Error::KeyPoints(
            "it returned different numbers of key points and descriptors".to_owned(),
        ));
    }
    // SIFT doubles the picture first. Its origin is the centre of the first doubled pixel, 0.25
    // photo pixels from the photo's corner.
    let positions = found
        .keypoints
        .iter()
        .map(|p| Vec2::new(p.x + 0.25, p.y + 0.25))
        .collect();
    Ok(Keypoints {
        positions,
        descriptors,
    })
}

#[cfg(not(any(feature = "rust-sift", feature = "opencv")))]
compile_error!("key points need the feature 'rust-sift' or the feature 'opencv'");

/// Returns the name of this build's SIFT.
pub fn backend() -> &'static str {
    if cfg!(feature = "opencv") {
        "OpenCV"
    } else {
        "pure Rust"
    }
}

/// Returns the version of this build's key points, for caches. The number is raised when the
/// detector finds other positions.
pub fn version() -> &'static str {
    if cfg!(feature = "opencv") {
        "OpenCV 2"
    } else {
        "pure Rust 3"
    }
}

/// Returns the fundamental matrix F: x_b^T F x_a = 0 for pixels of the same point.
pub fn fundamental(a: &Camera, b: &Camera) -> Mat3 {
    let relative = b.world_to_camera * a.world_to_camera.inverse();
    let t = relative.w_axis.truncate();
    let cross = Mat3::from_cols(
        Vec3::new(0.0, t.z, -t.y),
        Vec3::new(-t.z, 0.0, t.x),
        Vec3::new(t.y, -t.x, 0.0),
    );
    let k = |c: &Camera| {
        Mat3::from_cols(
            Vec3::new(c.fx, 0.0, 0.0),
            Vec3::new(0.0, c.fy, 0.0),
            Vec3::new(c.cx, c.cy, 1.0),
        )
    };
    k(b).inverse().transpose() * cross * Mat3::from_mat4(relative) * k(a).inverse()
}

/// Returns the larger distance in pixels of two points from each other's epipolar line.
pub fn epipolar_error(f: &Mat3, a: Vec2, b: Vec2) -> f32 {
    let (pa, pb) = (a.extend(1.0), b.extend(1.0));
    let (line_b, line_a) = (*f * pa, f.transpose() * pb);
    let residual = pb.dot(line_b).abs();
    (residual / line_b.truncate().length().max(1e-12))
        .max(residual / line_a.truncate().length().max(1e-12))
}

/// Returns the signed first-order distance in pixels of a match from the epipolar geometry
/// (Sampson).
pub fn epipolar_residual(f: &Mat3, a: Vec2, b: Vec2) -> f32 {
    let (pa, pb) = (a.extend(1.0), b.extend(1.0));
    let (line_b, line_a) = (*f * pa, f.transpose() * pb);
    pb.dot(line_b)
        / (line_b.truncate().length_squared() + line_a.truncate().length_squared())
            .sqrt()
            .max(1e-12)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::matching::matches;

    #[test]
    fn a_shifted_picture_matches_itself() {
        // Bright and dark blobs of several sizes at seeded positions.
        let mut rng = fastlgs_core::rng::Rng::new(1, "blobs");
        let blobs: Vec<[f32; 4]> = (0..150)
            .map(|_| {
                [
                    rng.range(0.0, 280.0),
                    rng.range(0.0, 220.0),
                    rng.range(2.0, 9.0),
                    rng.range(-90.0, 90.0),
                ]
            })
            .collect();
        let texture = |x: u32, y: u32| {
            let at = |b: &[f32; 4]| {
                b[3] * (-((x as f32 - b[0]).powi(2) + (y as f32 - b[1]).powi(2))
                    / (2.0 * b[2] * b[2]))
                    .exp()
            };
            (127.0 + blobs.iter().map(at).sum::<f32>()).clamp(0.0, 255.0) as u8
        };
        let a = GrayImage::from_fn(240, 200, |x, y| image::Luma([texture(x + 20, y + 10)]));
        let b = GrayImage::from_fn(240, 200, |x, y| image::Luma([texture(x + 28, y + 5)]));
        let (ka, kb) = (detect(&a).unwrap(), detect(&b).unwrap());
        let pairs = matches(&ka, &kb);
        assert!(pairs.len() > 20, "{} matches", pairs.len());
        let right = pairs
            .iter()
            .filter(|(i, j)| {
                (ka.positions[*i] - kb.positions[*j] - Vec2::new(8.0, -5.0)).length() < 1.5
            })
            .count();
        assert!(right * 10 >= pairs.len() * 8, "{right} of {}", pairs.len());
    }

    /// Key points lie on their blobs on average: a bias of half a pixel would rotate every camera.
    #[test]
    fn key_points_are_centred_on_blobs() {
        // Each range of radii belongs to one octave, so that a shifted octave shows as a bias.
        const RADII: [f32; 3] = [1.5, 3.0, 6.0];
        const BLOBS: usize = 40;
        let check = |detect: fn(&GrayImage) -> Result<Keypoints>| {
            for least in RADII {
                let mut rng = fastlgs_core::rng::Rng::new(2, "blobs");
                let (mut errors, mut found) = (Vec::new(), 0);
                for _ in 0..BLOBS {
                    // Positions count from the corner of the first pixel.
                    let (x, y, radius) = (
                        rng.range(60.0, 68.0),
                        rng.range(60.0, 68.0),
                        rng.range(least, 2.0 * least),
                    );
                    let at = |u: u32, v: u32| {
                        (u as f32 + 0.5 - x).powi(2) + (v as f32 + 0.5 - y).powi(2)
                    };
                    let grey =
                        |u, v| (60.0 + 150.0 * (-at(u, v) / (2.0 * radius * radius)).exp()) as u8;
                    let points = detect(&GrayImage::from_fn(128, 128, |u, v| {
                        image::Luma([grey(u, v)])
                    }))
                    .unwrap()
                    .positions;
                    let own: Vec<Vec2> = points
                        .iter()
                        .map(|p| *p - Vec2::new(x, y))
                        .filter(|e| e.length() < 4.0)
                        .collect();
                    found += usize::from(!own.is_empty());
                    errors.extend(own);
                }
                let mean = errors.iter().sum::<Vec2>() / errors.len() as f32;
                assert!(
                    4 * found >= BLOBS && mean.abs().max_element() < 0.08,
                    "radii from {least}: {found} of {BLOBS} blobs, off by {mean}"
                );
            }
        };
        #[cfg(feature = "opencv")]
        check(detect_with_opencv);
        #[cfg(feature = "rust-sift")]
        check(detect_in_rust);
    }

    /// Both implementations find mostly the same matches in two neighbouring photos of fox.
    #[cfg(all(feature = "opencv", feature = "rust-sift"))]
    #[test]
    fn opencv_and_rust_find_the_same_correspondences() {
        let images = std::path::Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("../../../shared/data/fox/images");
        let photo = |name: &str| {
            let photo = fastlgs_core::image_io::load_rgb(&images.join(name)).unwrap();
            image::imageops::grayscale(&fastlgs_core::image_io::resize(&photo, 270, 480))
        };
        if !images.is_dir() {
            crate::skip::skip(format_args!("{} does not exist", images.display()));
            return;
        }
        let (a, b) = (photo("0001.jpg"), photo("0002.jpg"));
        let flow = |detect: fn(&GrayImage) -> Result<Keypoints>| {
            let (a, b) = (detect(&a).unwrap(), detect(&b).unwrap());
            matches(&a, &b)
                .into_iter()
                .map(|(i, j)| (a.positions[i], b.positions[j]))
                .collect::<Vec<_>>()
        };
        let (opencv, rust) = (flow(detect_with_opencv), flow(detect_in_rust));
        let again = |(p, q): &&(Vec2, Vec2)| {
            rust.iter()
                .any(|(r, s)| r.distance(*p) < 2.0 && s.distance(*q) < 2.0)
        };
        let shared = opencv.iter().filter(again).count();
        println!(
            "correspondences of OpenCV {}, Rust {}; {shared} of OpenCV's found by both",
            opencv.len(),
            rust.len()
        );
        assert!(opencv.len() > 100 && rust.len() > 100);
        assert!(
            2 * shared > opencv.len().min(rust.len()),
            "{shared} of {} and {}",
            opencv.len(),
            rust.len()
        );
    }

    #[test]
    fn epipolar_error_is_zero_for_one_point_seen_twice() {
        let a = Camera::look_at(
            "a",
            Vec3::new(3.0, 0.0, 0.0),
            Vec3::ZERO,
            Vec3::Y,
            320,
            240,
            0.8,
        );
        let b = Camera::look_at(
            "b",
            Vec3::new(1.0, 0.5, 3.0),
            Vec3::ZERO,
            Vec3::Y,
            300,
            200,
            0.7,
        );
        let point = Vec3::new(0.2, -0.3, 0.1);
        let see = |c: &Camera| c.to_pixel(c.world_to_camera.transform_point3(point));
        let f = fundamental(&a, &b);
        assert!(epipolar_error(&f, see(&a), see(&b)) < 0.02);
        assert!(epipolar_error(&f, see(&a), see(&b) + Vec2::new(20.0, 20.0)) > 2.0);
    }
}
