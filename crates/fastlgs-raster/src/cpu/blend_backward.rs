//! CPU twin of `shaders/blend_backward.wgsl`: gradients of blending (docs/how-it-works.md, section
//! 5.1).

use super::blend::{inside_image, pixels_of};
use super::{Splat, alpha, values_of};
use crate::View;
use crate::channels::Channels;
use crate::view::TILE;
use rayon::prelude::*;

/// State of one pixel while the Gaussians of its tile are processed, front to back.
struct Pixel {
    x: f32,
    y: f32,
    transmittance: f32,
    /// R.g, with R the colour behind the Gaussians processed so far.
    r_dot_g: f32,
    /// dL/d(colour, feature); 0 for channels that are not trained.
    gradient: [f32; 6],
}

impl Pixel {
    /// Adds the contribution of a Gaussian to its slot. The gradients of the first
    /// `geometry_channels` channels move geometry.
    fn add(&mut self, splat: &Splat, geometry_channels: usize, slot: &mut [f32; 12]) {
        let values = values_of(splat);
        let (dx, dy) = (self.x - splat[0][0], self.y - splat[0][1]);
        let a = alpha(splat, dx, dy);
        let w = a * self.transmittance;
        self.transmittance -= w;
        let c_dot_g: f32 = (0..geometry_channels)
            .map(|c| values[c] * self.gradient[c])
            .sum();
        self.r_dot_g -= w * c_dot_g;
        let p = w * c_dot_g - self.r_dot_g * (a / (1.0 - a));
        let moments = [p * dx, p * dy, p * dx * dx, p * dx * dy, p * dy * dy, p];
        let channels = self.gradient.map(|g| w * g);
        for (sum, value) in slot.iter_mut().zip(moments.into_iter().chain(channels)) {
            *sum += value;
        }
    }
}

/// Writes the gradient sums of each (tile, Gaussian) pair to its slot. `slots` holds 12 floats for
/// each pair of the window, or 4 with frozen geometry.
pub fn blend_backward(
    view: &View,
    channels: Channels,
    ranges: &[u32],
    tile_order: &[u32],
    sorted_pairs: &[u32],
    pair_gaussians: &[u32],
    splats: &[Splat],
    frame: &[f32],
    gradient: &[f32],
    slots: &mut [f32],
) {
    let n = view.padded_pixels();
    let geometry_channels = match channels {
        Channels::Feature => 0,
        Channels::Color | Channels::Both => 3,
        Channels::Coupled => 6,
    };
    let of_tile = |&tile: &u32| -> Vec<(u32, [f32; 12])> {
        let range = ranges[2 * tile as usize] as usize..ranges[2 * tile as usize + 1] as usize;
        let corner = view.index_of(tile % view.tiles[0] * TILE, tile / view.tiles[0] * TILE);
        let walked = frame[7 * n + corner] as usize;
        let mut pixels: Vec<Pixel> = pixels_of(tile, view)
            .map(|(x, y)| pixel(view, channels, geometry_channels, frame, gradient, x, y))
            .collect();
        let slot_of = |(k, &pair): (usize, &u32)| {
            let mut slot = [0.0f32; 12];
            if k < walked {
                let splat = &splats[pair_gaussians[pair as usize] as usize];
                for pixel in &mut pixels {
                    pixel.add(splat, geometry_channels, &mut slot);
                }
            }
            (pair, slot)
        };
        let pairs = sorted_pairs[range].iter().enumerate();
        pairs.map(slot_of).collect()
    };
    let tiles: Vec<_> = tile_order.par_iter().map(of_tile).collect();
    let floats = 4 * channels.slot();
    for (e, slot) in tiles.into_iter().flatten() {
        if e >= view.slot_first && e - view.slot_first < view.slot_count + view.tile_count() {
            let at = (e - view.slot_first) as usize * floats;
            slots[at..at + floats].copy_from_slice(&slot[12 - floats..]);
        }
    }
}

/// Returns the initial state of a pixel.
fn pixel(
    view: &View,
    channels: Channels,
    geometry_channels: usize,
    frame: &[f32],
    gradient: &[f32],
    x: u32,
    y: u32,
) -> Pixel {
    let (n, at) = (view.padded_pixels(), view.index_of(x, y));
    let gradient: [f32; 6] = std::array::from_fn(|c| {
        if channels.includes(c) {
            gradient[c * n + at]
        } else {
            0.0
        }
    });
    Pixel {
        x: x as f32 + 0.5,
        y: y as f32 + 0.5,
        transmittance: inside_image(x, y, view),
        r_dot_g: (0..geometry_channels)
            .map(|c| frame[c * n + at] * gradient[c])
            .sum(),
        gradient,
    }
}
