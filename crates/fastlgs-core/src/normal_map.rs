//! Surface normals from depth maps.

use crate::Camera;
use glam::{Vec2, Vec3};

/// Returns the unit normal of each pixel in camera axes (x right, y down, z forward), row by row.
/// It points towards the camera. It is zero where the depth of the pixel or of a neighbour that it
/// needs is not positive and finite.
///
/// The normal is the cross product of the differences of the unprojected neighbours, left to right
/// and top to bottom; at the image border, of the pixel itself and its only neighbour.
pub fn normals(camera: &Camera, depth: &[f32]) -> Vec<Vec3> {
    let (width, height) = (camera.width as usize, camera.height as usize);
    let point = |x: usize, y: usize| {
        camera.ray(Vec2::new(x as f32 + 0.5, y as f32 + 0.5)) * depth[y * width + x]
    };
    let normal = |pixel: usize| {
        let (x, y) = (pixel % width, pixel / width);
        let (left, right) = (x.saturating_sub(1), (x + 1).min(width - 1));
        let (above, below) = (y.saturating_sub(1), (y + 1).min(height - 1));
        let used = [(x, y), (left, y), (right, y), (x, above), (x, below)];
        let is_known = |(x, y): (usize, usize)| {
            let depth = depth[y * width + x];
            depth > 0.0 && depth.is_finite()
        };
        if !used.into_iter().all(is_known) {
            return Vec3::ZERO;
        }
        let across = point(right, y) - point(left, y);
        let down = point(x, below) - point(x, above);
        let normal = down.cross(across).normalize_or_zero();
        if normal.dot(point(x, y)) > 0.0 {
            -normal
        } else {
            normal
        }
    };
    (0..width * height).map(normal).collect()
}

/// Returns the colour of a normal: 0 to 255 for -1 to 1 of each axis, and black for none.
pub fn color(normal: Vec3) -> [u8; 3] {
    if normal == Vec3::ZERO {
        return [0; 3];
    }
    let byte = |value: f32| (127.5 + 127.5 * value).round().clamp(0.0, 255.0) as u8;
    normal.to_array().map(byte)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn normals_of_a_tilted_plane() {
        let camera = Camera::look_at("a", Vec3::ZERO, Vec3::Z, Vec3::NEG_Y, 8, 6, 0.8);
        let expected = Vec3::new(0.3, -0.2, -1.0).normalize();
        // The plane n p = n_z * 2 through (0, 0, 2).
        let mut depth: Vec<f32> = (0..48)
            .map(|pixel| {
                let pixel = Vec2::new((pixel % 8) as f32 + 0.5, (pixel / 8) as f32 + 0.5);
                2.0 * expected.z / expected.dot(camera.ray(pixel))
            })
            .collect();
        for normal in normals(&camera, &depth) {
            assert!(normal.distance(expected) < 1e-4, "{normal}");
        }
        depth[9] = f32::INFINITY;
        let normals = normals(&camera, &depth);
        let unknown: Vec<usize> = (0..48).filter(|p| normals[*p] == Vec3::ZERO).collect();
        assert_eq!(unknown, [1, 8, 9, 10, 17]);
        assert_eq!(color(Vec3::NEG_Z), [128, 128, 0]);
        assert_eq!(color(Vec3::ZERO), [0; 3]);
    }
}
