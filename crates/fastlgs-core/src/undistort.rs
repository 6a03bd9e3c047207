//! Lens distortion of COLMAP's camera models (see `dataset/colmap.rs`) and its removal.
//!
//! The projection of the lens (pinhole or fisheye) comes first. The rational radial, tangential and
//! thin-prism terms of Brown and Conrady follow, as in OpenCV and COLMAP.

use crate::Camera;
use glam::Vec2;
use image::{GrayImage, Luma, Rgb, RgbImage};

/// Projection of a lens: the distance from the image centre, in focal lengths, at which a ray
/// appears whose angle to the optical axis is theta.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum LensProjection {
    /// Pinhole: tan(theta).
    #[default]
    None,
    /// Equidistant fisheye: theta.
    Fisheye,
    /// Field-of-view model: atan(2 tan(theta) tan(omega / 2)) / omega (Devernay & Faugeras 2001).
    Fov(f32),
}

/// Distortion coefficients; the default is an ideal pinhole.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Distortion {
    /// Projection that is applied before the terms below.
    pub projection: LensProjection,
    /// Radial coefficient of r^2.
    pub k1: f32,
    /// Radial coefficient of r^4.
    pub k2: f32,
    /// Radial coefficient of r^6.
    pub k3: f32,
    /// Radial coefficient of r^8.
    pub k4: f32,
    /// Radial coefficients of r^2, r^4 and r^6 in the denominator.
    pub radial_denominator: [f32; 3],
    /// First tangential coefficient.
    pub p1: f32,
    /// Second tangential coefficient.
    pub p2: f32,
    /// Thin-prism coefficients: multiples of r^2 that are added to x and y.
    pub prism: [f32; 2],
}

impl Distortion {
    /// Returns whether there is no distortion.
    pub fn is_none(&self) -> bool {
        *self == Self::default()
    }

    /// Maps an ideal ray (x/z, y/z) to the distorted image plane.
    pub fn distort(&self, ray: Vec2) -> Vec2 {
        let r = ray.length();
        let projected_radius = match self.projection {
            LensProjection::None => r,
            LensProjection::Fisheye => r.atan(),
            LensProjection::Fov(omega) => (2.0 * r * (omega / 2.0).tan()).atan() / omega,
        };
        let p = if r > 1e-9 {
            ray * (projected_radius / r)
        } else {
            ray
        };
        let r2 = p.length_squared();
        let above = 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * (self.k3 + r2 * self.k4)));
        let radial = above
            / (1.0
                + r2 * (self.radial_denominator[0]
                    + r2 * (self.radial_denominator[1] + r2 * self.radial_denominator[2])));
        let Vec2 { x, y } = p;
        Vec2::new(
            x * radial + 2.0 * self.p1 * x * y + self.p2 * (r2 + 2.0 * x * x) + self.prism[0] * r2,
            y * radial + self.p1 * (r2 + 2.0 * y * y) + 2.0 * self.p2 * x * y + self.prism[1] * r2,
        )
    }

    /// Maps a point of the distorted image plane to its ideal ray: the inverse of
    /// [`Self::distort`]. The fixed-point iteration converges only for moderate distortion.
    pub fn undistort_point(&self, place: Vec2) -> Vec2 {
        let mut ray = place;
        (0..INVERSION_STEPS).for_each(|_| ray += place - self.distort(ray));
        ray
    }

    /// Maps a pixel of the distorted photo of `camera` to the undistorted photo.
    pub fn undistort_pixel(&self, camera: &Camera, pixel: Vec2) -> Vec2 {
        camera.to_pixel(
            self.undistort_point(camera.ray(pixel).truncate())
                .extend(1.0),
        )
    }
}

/// Iterations that invert the distortion. Each reduces the error to a few hundredths for usual
/// lenses.
const INVERSION_STEPS: usize = 20;

/// Resamples a photo to the ideal pinhole `camera` of the same size. Sampling is bilinear and
/// repeats the edges.
pub fn undistort(photo: &RgbImage, camera: &Camera, distortion: &Distortion) -> RgbImage {
    let (width, height) = photo.dimensions();
    RgbImage::from_fn(width, height, |i, j| {
        let ray = camera
            .ray(Vec2::new(i as f32 + 0.5, j as f32 + 0.5))
            .truncate();
        let d = distortion.distort(ray);
        sample(
            photo,
            camera.fx * d.x + camera.cx - 0.5,
            camera.fy * d.y + camera.cy - 0.5,
        )
    })
}

/// Returns a mask of the pixels that [`undistort`] samples inside the photo: 255 inside, 0 outside.
/// `None` if all are inside.
pub fn coverage_mask(camera: &Camera, distortion: &Distortion) -> Option<GrayImage> {
    let (width, height) = (camera.width as f32, camera.height as f32);
    let mask = GrayImage::from_fn(camera.width, camera.height, |i, j| {
        let d = distortion.distort(
            camera
                .ray(Vec2::new(i as f32 + 0.5, j as f32 + 0.5))
                .truncate(),
        );
        let (x, y) = (camera.fx * d.x + camera.cx, camera.fy * d.y + camera.cy);
        Luma([
            if (0.0..=width).contains(&x) && (0.0..=height).contains(&y) {
                255
            } else {
                0
            },
        ])
    });
    mask.pixels().any(|p| p[0] == 0).then_some(mask)
}

/// As [`undistort`], for masks.
pub fn undistort_gray(mask: &GrayImage, camera: &Camera, distortion: &Distortion) -> GrayImage {
    let rgb = RgbImage::from_fn(mask.width(), mask.height(), |x, y| {
        Rgb([mask.get_pixel(x, y)[0]; 3])
    });
    let out = undistort(&rgb, camera, distortion);
    GrayImage::from_fn(mask.width(), mask.height(), |x, y| {
        Luma([out.get_pixel(x, y)[0]])
    })
}

/// Samples bilinearly. Pixel centres have integer coordinates here.
fn sample(photo: &RgbImage, x: f32, y: f32) -> Rgb<u8> {
    let (w, h) = photo.dimensions();
    let (x, y) = (x.clamp(0.0, (w - 1) as f32), y.clamp(0.0, (h - 1) as f32));
    let (x0, y0) = (x as u32, y as u32);
    let (x1, y1) = ((x0 + 1).min(w - 1), (y0 + 1).min(h - 1));
    let (u, v) = (x - x0 as f32, y - y0 as f32);
    let (a, b, c, d) = (
        photo.get_pixel(x0, y0),
        photo.get_pixel(x1, y0),
        photo.get_pixel(x0, y1),
        photo.get_pixel(x1, y1),
    );
    Rgb(std::array::from_fn(|k| {
        let top = f32::from(a[k]) * (1.0 - u) + f32::from(b[k]) * u;
        let bottom = f32::from(c[k]) * (1.0 - u) + f32::from(d[k]) * u;
        (top * (1.0 - v) + bottom * v + 0.5) as u8
    }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;

    #[test]
    fn coverage_mask_marks_pixels_outside_the_photo() {
        let name = "a.jpg".to_owned();
        let world_to_camera = glam::Mat4::IDENTITY;
        let camera = Camera {
            name,
            width: 160,
            height: 120,
            fx: 138.0,
            fy: 138.0,
            cx: 80.0,
            cy: 60.0,
            world_to_camera,
        };
        let barrel = Distortion {
            k1: -0.1,
            ..Distortion::default()
        };
        assert!(
            coverage_mask(&camera, &barrel).is_none()
                && coverage_mask(&camera, &Distortion::default()).is_none()
        );
        // Pincushion distortion: corners of the undistorted image lie outside the photo.
        let mask = coverage_mask(
            &camera,
            &Distortion {
                k1: 0.05,
                ..Distortion::default()
            },
        )
        .expect("corners are missing");
        assert_eq!(
            [(0, 0), (159, 119), (80, 60), (80, 0)].map(|(x, y)| mask.get_pixel(x, y)[0]),
            [0, 0, 255, 0]
        );
        assert_eq!(mask.get_pixel(80, 3)[0], 255);
    }

    #[test]
    fn undistort_point_inverts_distort() {
        let lens = Distortion {
            k1: -0.15,
            k2: 0.03,
            p1: 0.002,
            ..Distortion::default()
        };
        for ray in [Vec2::ZERO, Vec2::new(0.4, -0.3), Vec2::new(-0.6, 0.5)] {
            assert!((lens.undistort_point(lens.distort(ray)) - ray).length() < 1e-6);
        }
    }

    #[test]
    fn straight_lines_become_straight() {
        let camera = Camera::look_at("a", Vec3::Z, Vec3::ZERO, Vec3::Y, 200, 200, 0.9);
        let lens = Distortion {
            k1: 0.2,
            ..Distortion::default()
        };
        // A straight line x = 0.3 on the ideal plane, which is curved in the photo.
        let mut photo = RgbImage::new(200, 200);
        for t in 0..4000 {
            let ideal = Vec2::new(0.3, (t as f32 / 4000.0 - 0.5) * 0.9);
            let d = lens.distort(ideal);
            let (i, j) = (camera.fx * d.x + camera.cx, camera.fy * d.y + camera.cy);
            if (0.0..200.0).contains(&i) && (0.0..200.0).contains(&j) {
                photo.put_pixel(i as u32, j as u32, Rgb([255; 3]));
            }
        }
        let ideal = undistort(&photo, &camera, &lens);
        let columns: Vec<u32> = (20..180)
            .filter_map(|j| {
                (0..200)
                    .max_by_key(|&i| ideal.get_pixel(i, j)[0])
                    .filter(|&i| ideal.get_pixel(i, j)[0] > 60)
            })
            .collect();
        assert!(columns.len() > 100, "the line must be visible in most rows");
        let (low, high) = (columns.iter().min().unwrap(), columns.iter().max().unwrap());
        assert!(high - low <= 2, "columns {low} to {high}");
    }

    /// Expected values computed by hand for the ray (0.3, 0.4): r = 0.5, theta = atan(0.5) =
    /// 0.463648.
    #[test]
    fn lens_models_by_hand() {
        let ray = Vec2::new(0.3, 0.4);
        let none = Distortion::default();
        let near = |lens: Distortion, x: f32, y: f32| {
            let d = lens.distort(ray);
            assert!(d.distance(Vec2::new(x, y)) < 1e-5, "{lens:?}: {d}");
        };
        near(
            Distortion {
                projection: LensProjection::Fisheye,
                ..none
            },
            0.278_189,
            0.370_918,
        );
        // theta (1 + 0.1 theta^2 - 0.2 theta^4 + 0.3 theta^6 + 0.4 theta^8) = 0.463648 * 1.016089
        near(
            Distortion {
                projection: LensProjection::Fisheye,
                k1: 0.1,
                k2: -0.2,
                k3: 0.3,
                k4: 0.4,
                ..none
            },
            0.282_664,
            0.376_886,
        );
        // A ray of length 1: atan(2 tan(0.45)) / 0.9 = 0.853514.
        let fov = Distortion {
            projection: LensProjection::Fov(0.9),
            ..none
        };
        assert!(
            fov.distort(2.0 * ray)
                .distance(Vec2::new(0.512109, 0.682811))
                < 1e-5
        );
        // 1 + 0.1 / 4 over 1 + 0.2 / 4
        near(
            Distortion {
                k1: 0.1,
                radial_denominator: [0.2, 0.0, 0.0],
                ..none
            },
            0.3 * 1.025 / 1.05,
            0.4 * 1.025 / 1.05,
        );
        // r^2 = 0.25: x + 2 p1 xy + p2 (r^2 + 2 x^2) + sx r^2
        near(
            Distortion {
                p1: 0.1,
                p2: 0.2,
                prism: [0.04, -0.04],
                ..none
            },
            0.3 + 0.024 + 0.086 + 0.01,
            0.4 + 0.057 + 0.048 - 0.01,
        );
        assert_eq!(none.distort(Vec2::ZERO), Vec2::ZERO);
    }
}
