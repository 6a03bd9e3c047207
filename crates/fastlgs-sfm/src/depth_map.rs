//! Depth maps of views.

use fastlgs_core::Camera;
use glam::Vec3;

/// Relative depth difference of neighbouring pixels up to which they show one surface.
const SAME_SURFACE: f32 = 0.1;

/// Depths at the pixels of a camera, in units of the scene.
#[derive(Clone)]
pub struct DepthMap {
    /// The camera; its size is that of the map.
    pub camera: Camera,
    /// Depth of each pixel, row by row; 0 where it is unknown.
    pub depth: Vec<f32>,
}

impl DepthMap {
    /// Returns a map without known depths.
    pub fn empty(camera: Camera) -> Self {
        let pixels = (camera.width * camera.height) as usize;
        Self {
            camera,
            depth: vec![0.0; pixels],
        }
    }

    /// Adds a point in scene coordinates, unless a nearer one is known at its pixel.
    pub fn add(&mut self, position: Vec3) {
        if let Some((pixel, depth)) = self.camera.pixel_and_depth(position) {
            let known = &mut self.depth[pixel];
            if *known <= 0.0 || depth < *known {
                *known = depth;
            }
        }
    }

    /// Returns the position of a pixel's surface in scene coordinates.
    pub fn point(&self, pixel: usize) -> Vec3 {
        self.camera.point_at(pixel, self.depth[pixel])
    }

    /// Returns the depths at another size, row by row. 1 / depth is interpolated, which is exact on
    /// planes. The depth is unknown where the four neighbours do not show one surface.
    pub fn resized(&self, width: u32, height: u32) -> Vec<f32> {
        let own = [self.camera.width as usize, self.camera.height as usize];
        let neighbours = |at: u32, side: u32, own: usize| {
            let place = (at as f32 + 0.5) * own as f32 / side as f32 - 0.5;
            let place = place.clamp(0.0, own as f32 - 1.0);
            let first = (place as usize).min(own.saturating_sub(2));
            (first, (first + 1).min(own - 1), place - first as f32)
        };
        let depth = |x: u32, y: u32| {
            let (left, right, across) = neighbours(x, width, own[0]);
            let (above, below, down) = neighbours(y, height, own[1]);
            let at = |x: usize, y: usize| self.depth[y * own[0] + x];
            let corners = [
                at(left, above),
                at(right, above),
                at(left, below),
                at(right, below),
            ];
            let nearest = corners.into_iter().fold(f32::INFINITY, f32::min);
            let farthest = corners.into_iter().fold(0.0, f32::max);
            if nearest <= 0.0 || farthest > (1.0 + SAME_SURFACE) * nearest {
                return 0.0;
            }
            let [a, b, c, d] = corners.map(|depth| 1.0 / depth);
            let (upper, lower) = (a + (b - a) * across, c + (d - c) * across);
            1.0 / (upper + (lower - upper) * down)
        };
        let pixels = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
        pixels.map(|(x, y)| depth(x, y)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec2;

    #[test]
    fn a_resized_plane_is_exact_and_edges_are_unknown() {
        let wide = Camera::look_at("a", Vec3::ZERO, Vec3::Z, Vec3::NEG_Y, 40, 20, 0.8);
        let normal = Vec3::new(0.2, -0.1, -1.0);
        let plane = |camera: &Camera, x: u32, y: u32| {
            let ray = camera.ray(Vec2::new(x as f32 + 0.5, y as f32 + 0.5));
            -3.0 / normal.dot(ray)
        };
        let small = wide.shrunk_to(10);
        let mut map = DepthMap::empty(small.clone());
        for y in 0..5 {
            for x in 0..10 {
                map.depth[(y * 10 + x) as usize] = plane(&small, x, y);
            }
        }
        let depth = map.resized(40, 20);
        // Half a pixel of the small map along the border is not between four neighbours.
        for y in 2..18 {
            for x in 2..38 {
                let (found, exact) = (depth[(y * 40 + x) as usize], plane(&wide, x, y));
                assert!((found / exact - 1.0).abs() < 1e-4, "{found} and {exact}");
            }
        }
        map.depth[24] = 9.0;
        map.depth[0] = 0.0;
        let depth = map.resized(40, 20);
        assert_eq!(depth[10 * 40 + 17], 0.0, "a depth step");
        assert_eq!(depth[0], 0.0, "an unknown pixel");
        map.add(map.point(24) * 0.5);
        assert!(
            (map.depth[24] - 4.5).abs() < 1e-3,
            "the nearer point is kept"
        );
        map.add(map.point(24) * 3.0);
        assert!((map.depth[24] - 4.5).abs() < 1e-3);
    }
}
