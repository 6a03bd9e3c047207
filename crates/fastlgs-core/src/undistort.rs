//! Removal of lens distortion (Brown-Conrady with two radial and two tangential terms, as OpenCV and COLMAP define it).

use crate::Camera;
use glam::Vec2;
use image::{GrayImage, Luma, Rgb, RgbImage};

/// Distortion coefficients; all zero means an ideal pinhole.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Distortion {
    /// Radial, r^2.
    pub k1: f32,
    /// Radial, r^4.
    pub k2: f32,
    /// Tangential.
    pub p1: f32,
    /// Tangential.
    pub p2: f32,
}

impl Distortion {
    /// Whether there is nothing to remove.
    pub fn is_none(&self) -> bool {
        *self == Self::default()
    }

    /// Where the ideal ray (x/z, y/z) lands on the distorted image plane.
    pub fn distort(&self, p: Vec2) -> Vec2 {
        let r2 = p.length_squared();
        let radial = 1.0 + r2 * (self.k1 + r2 * self.k2);
        let Vec2 { x, y } = p;
        Vec2::new(
            x * radial + 2.0 * self.p1 * x * y + self.p2 * (r2 + 2.0 * x * x),
            y * radial + self.p1 * (r2 + 2.0 * y * y) + 2.0 * self.p2 * x * y,
        )
    }
}

/// Resamples a photo as the ideal pinhole `camera` of the same size would have seen it (bilinear, edges repeated).
pub fn undistort(photo: &RgbImage, camera: &Camera, distortion: &Distortion) -> RgbImage {
    let (width, height) = photo.dimensions();
    RgbImage::from_fn(width, height, |i, j| {
        let ray = camera.ray(Vec2::new(i as f32 + 0.5, j as f32 + 0.5)).truncate();
        let d = distortion.distort(ray);
        sample(photo, camera.fx * d.x + camera.cx - 0.5, camera.fy * d.y + camera.cy - 0.5)
    })
}

/// As [`undistort`], for masks.
pub fn undistort_gray(mask: &GrayImage, camera: &Camera, distortion: &Distortion) -> GrayImage {
    let rgb = RgbImage::from_fn(mask.width(), mask.height(), |x, y| Rgb([mask.get_pixel(x, y)[0]; 3]));
    let out = undistort(&rgb, camera, distortion);
    GrayImage::from_fn(mask.width(), mask.height(), |x, y| Luma([out.get_pixel(x, y)[0]]))
}

/// Bilinear sample with coordinates of pixel centres at whole numbers.
fn sample(photo: &RgbImage, x: f32, y: f32) -> Rgb<u8> {
    let (w, h) = photo.dimensions();
    let (x, y) = (x.clamp(0.0, (w - 1) as f32), y.clamp(0.0, (h - 1) as f32));
    let (x0, y0) = (x as u32, y as u32);
    let (x1, y1) = ((x0 + 1).min(w - 1), (y0 + 1).min(h - 1));
    let (u, v) = (x - x0 as f32, y - y0 as f32);
    let (a, b, c, d) = (photo.get_pixel(x0, y0), photo.get_pixel(x1, y0), photo.get_pixel(x0, y1), photo.get_pixel(x1, y1));
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
    fn straight_lines_become_straight() {
        let camera = Camera::look_at("a", Vec3::Z, Vec3::ZERO, Vec3::Y, 200, 200, 0.9);
        let lens = Distortion { k1: 0.2, k2: 0.0, p1: 0.0, p2: 0.0 };
        // A world line seen by the real lens: x = 0.3 on the ideal plane, so curved in the photo.
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
            .filter_map(|j| (0..200).max_by_key(|&i| ideal.get_pixel(i, j)[0]).filter(|&i| ideal.get_pixel(i, j)[0] > 60))
            .collect();
        assert!(columns.len() > 100, "the line is seen in most rows");
        let (low, high) = (columns.iter().min().unwrap(), columns.iter().max().unwrap());
        assert!(high - low <= 2, "columns {low} to {high}");
    }
}
