//! Blending and its gradients, one tile at a time. A vector of 8 lanes holds one row of a tile, a
//! vector of 16 lanes two.

use super::lists::{Band, Lists};
use super::simd::{SLOT_FLOATS, Vector, dispatched};
use crate::cpu::{ALPHA_MIN, BATCH, LOG2_ALPHA_MAX, Splat};
use crate::view::View;

/// Tile edge in pixels.
pub const EDGE: usize = crate::view::TILE as usize;

/// A value for each pixel of a tile, row by row.
pub type Tile = [f32; EDGE * EDGE];

/// A tile of zeros.
pub const EMPTY: Tile = [0.0; EDGE * EDGE];

/// x offsets of the pixel centres from the tile's upper left corner.
const COLUMN_OFFSETS: Tile = {
    let mut out = EMPTY;
    let mut p = 0;
    while p < out.len() {
        out[p] = (p % EDGE) as f32 + 0.5;
        p += 1;
    }
    out
};

/// y offsets of the pixel centres from the tile's upper left corner.
const ROWS: Tile = {
    let mut out = EMPTY;
    let mut p = 0;
    while p < out.len() {
        out[p] = (p / EDGE) as f32 + 0.5;
        p += 1;
    }
    out
};

/// Result of the forward pass for one tile.
#[derive(Clone)]
pub struct Blended {
    /// Sums of r, g, b, f0, f1, f2; [`forward`] does not add the background.
    pub sums: [Tile; 6],
    /// Transmittance behind the processed Gaussians.
    pub transmittance: Tile,
    /// Number of pairs processed.
    pub walked: u32,
}

impl Blended {
    /// Writes row `y` of one channel of [`Frame`](crate::engine::Frame) to `out`, which may be
    /// shorter than a tile edge.
    pub fn write_row(&self, channel: usize, y: usize, out: &mut [f32]) {
        let own = y * EDGE..y * EDGE + out.len();
        match channel {
            0..6 => out.copy_from_slice(&self.sums[channel][own]),
            6 => out.copy_from_slice(&self.transmittance[own]),
            _ => out.fill(self.walked as f32),
        }
    }
}

/// A tile to blend: its position and its list of Gaussians.
pub struct Job<'a> {
    /// x of the upper left pixel.
    pub x: f32,
    /// y of the upper left pixel.
    pub y: f32,
    /// Indices into the band's Gaussians, front to back.
    list: &'a [u32],
    band: &'a Band,
    lists: &'a Lists,
    /// Transmittance below which a pixel needs no more Gaussians.
    min_transmittance: f32,
}

impl<'a> Job<'a> {
    /// Creates the job of tile `tile`; tiles are numbered row by row.
    pub fn new(view: &View, tile: usize, lists: &'a Lists) -> Self {
        let (column, row) = (tile % view.tiles[0] as usize, tile / view.tiles[0] as usize);
        let band = &lists.bands[row];
        Self {
            x: (column * EDGE) as f32,
            y: (row * EDGE) as f32,
            list: band.tile(column),
            band,
            lists,
            min_transmittance: view.min_transmittance,
        }
    }

    /// Returns the Gaussians of the tile, front to back.
    pub fn gaussians(&self) -> impl Iterator<Item = u32> {
        self.list
            .iter()
            .map(|place| self.band.gaussians[*place as usize])
    }
}

/// Returns 1 for pixels of the image and 0 for pixels of the padding.
pub fn inside_image(view: &View, job: &Job) -> Tile {
    let [w, h] = view.size.map(|s| s as f32);
    if job.x + EDGE as f32 <= w && job.y + EDGE as f32 <= h {
        return [1.0; EDGE * EDGE];
    }
    std::array::from_fn(|p| {
        if job.x + ((p % EDGE) as f32) < w && job.y + ((p / EDGE) as f32) < h {
            1.0
        } else {
            0.0
        }
    })
}

/// A splat relative to a tile. log2 of its alpha is level + slope dy + qz dy^2.
struct TileSplat<'a, V> {
    splat: &'a Splat,
    /// x offsets of a vector's pixels from the mean, the same for all vectors of the tile.
    dx: V,
    /// y of the tile's upper edge minus y of the mean.
    down: f32,
    /// log2 of alpha at dy = 0.
    level: V,
    /// Derivative of log2 of alpha by dy at dy = 0.
    slope: V,
    /// First pixel of each vector in which alpha may reach `ALPHA_MIN`.
    pixels: std::iter::StepBy<std::ops::Range<usize>>,
}

impl<'a, V: Vector> TileSplat<'a, V> {
    #[inline(always)]
    fn new(job: &Job<'a>, gaussian: usize) -> Self {
        let splat = &job.lists.splats[gaussian];
        let [[x, y, qx, qy], [_, log_opacity, ..], _] = *splat;
        let (dx, down) = (V::load(&COLUMN_OFFSETS).add(V::splat(job.x - x)), job.y - y);
        let reach = job.lists.reach[gaussian];
        let row = |y: f32| y.clamp(0.0, EDGE as f32) as i32 as usize;
        let rows = row((-reach - down - 0.5).ceil())..row((reach - down - 0.5).floor() + 1.0);
        let per_vector = V::LANES / EDGE;
        let pixels = (rows.start / per_vector * V::LANES..rows.end.div_ceil(per_vector) * V::LANES)
            .step_by(V::LANES);
        let level = V::splat(qx).mul(dx).madd(dx, V::splat(log_opacity));
        Self {
            splat,
            dx,
            down,
            level,
            slope: V::splat(qy).mul(dx),
            pixels,
        }
    }

    /// Returns the y offsets from the mean of the vector that starts at pixel `p`.
    #[inline(always)]
    fn dy(&self, p: usize) -> V {
        V::load(&ROWS[p..]).add(V::splat(self.down))
    }

    /// Returns the alphas of a vector with the y offsets `dy`.
    #[inline(always)]
    fn alphas(&self, dy: V) -> V {
        let [_, [qz, ..], _] = *self.splat;
        let exponent = V::splat(qz).madd(dy, self.slope).madd(dy, self.level);
        // The minimum is needed because rounding lifts the exponent far out on a long, thin
        // Gaussian. A NaN passes the minimum and becomes 0 in the comparison.
        V::splat(LOG2_ALPHA_MAX)
            .min(exponent)
            .exp2()
            .at_least_or_zero(V::splat(ALPHA_MIN))
    }

    /// Returns colour and feature, one vector for each channel.
    #[inline(always)]
    fn values(&self) -> [V; 6] {
        let [_, [_, _, r, g], [b, f0, f1, f2]] = *self.splat;
        // Written out, because `map` is not inlined here.
        [
            V::splat(r),
            V::splat(g),
            V::splat(b),
            V::splat(f0),
            V::splat(f1),
            V::splat(f2),
        ]
    }
}

/// Returns whether all pixels are below the transmittance limit.
#[inline(always)]
fn finished(job: &Job<'_>, transmittance: &Tile) -> bool {
    transmittance.iter().all(|t| *t < job.min_transmittance)
}

/// Returns the blending weights for these alphas and subtracts them from the transmittance.
#[inline(always)]
fn absorb<V: Vector>(alpha: V, transmittance: &mut [f32]) -> V {
    let light = V::load(transmittance);
    let w = alpha.mul(light);
    light.sub(w).store(transmittance);
    w
}

/// Returns the channels of a step: colour 0..3, feature 3..6.
#[inline(always)]
fn channels<const COLOR: bool, const FEATURE: bool>() -> std::ops::Range<usize> {
    (if COLOR { 0 } else { 3 })..(if FEATURE { 6 } else { 3 })
}

dispatched! {
    /// Blends the list of a tile. `out.transmittance` must be 1 in the image and 0 in the padding.
    fn forward<const COLOR: bool, const FEATURE: bool>(job: &Job<'_>, out: &mut Blended) = forward_body
}

#[inline(always)]
fn forward_body<V: Vector, const COLOR: bool, const FEATURE: bool>(
    job: &Job<'_>,
    out: &mut Blended,
) {
    for batch in job.list.chunks(BATCH) {
        for &place in batch {
            let placed = TileSplat::<V>::new(job, job.band.gaussians[place as usize] as usize);
            let values = placed.values();
            for p in placed.pixels.clone() {
                let w = absorb(placed.alphas(placed.dy(p)), &mut out.transmittance[p..]);
                for c in channels::<COLOR, FEATURE>() {
                    let sums = &mut out.sums[c][p..];
                    w.madd(values[c], V::load(sums)).store(sums);
                }
            }
        }
        out.walked += batch.len() as u32;
        if finished(job, &out.transmittance) {
            break;
        }
    }
}

dispatched! {
    /// Sums the blending weights of a tile's Gaussians by object id. The ids are in the order of
    /// their first occurrence.
    /// `transmittance` must be 1 in the image and 0 in the padding.
    fn weights_by_id(job: &Job<'_>, ids: &[u16], transmittance: &mut Tile, sums: &mut Vec<(u16, Tile)>) = by_id_body
}

#[inline(always)]
fn by_id_body<V: Vector>(
    job: &Job<'_>,
    ids: &[u16],
    transmittance: &mut Tile,
    sums: &mut Vec<(u16, Tile)>,
) {
    sums.clear();
    for batch in job.list.chunks(BATCH) {
        for &place in batch {
            let g = job.band.gaussians[place as usize] as usize;
            let id = ids[g];
            let place = sums.iter().position(|s| s.0 == id).unwrap_or_else(|| {
                sums.push((id, EMPTY));
                sums.len() - 1
            });
            let placed = TileSplat::<V>::new(job, g);
            for p in placed.pixels.clone() {
                let w = absorb(placed.alphas(placed.dy(p)), &mut transmittance[p..]);
                let sum = &mut sums[place].1[p..];
                w.add(V::load(sum)).store(sum);
            }
        }
        if finished(job, transmittance) {
            break;
        }
    }
}

dispatched! {
    /// Sums the blending weights of each Gaussian over the pixels of each mask (1 inside, 0
    /// outside). `sums` is `[Gaussian of the list][mask]` and ends where the tile is finished.
    fn by_mask(job: &Job<'_>, masks: &[Tile], transmittance: &mut Tile, sums: &mut Vec<f32>) = by_mask_body
}

#[inline(always)]
fn by_mask_body<V: Vector>(
    job: &Job<'_>,
    masks: &[Tile],
    transmittance: &mut Tile,
    sums: &mut Vec<f32>,
) {
    sums.clear();
    for batch in job.list.chunks(BATCH) {
        for &place in batch {
            let placed = TileSplat::<V>::new(job, job.band.gaussians[place as usize] as usize);
            let mut weights = EMPTY;
            for p in placed.pixels.clone() {
                absorb(placed.alphas(placed.dy(p)), &mut transmittance[p..])
                    .store(&mut weights[p..]);
            }
            // `V::lane_sums` reduces `SLOT_FLOATS` vectors at a time.
            for masks in masks.chunks(SLOT_FLOATS) {
                let mut inside = [V::splat(0.0); SLOT_FLOATS];
                for (sum, mask) in inside.iter_mut().zip(masks) {
                    for p in placed.pixels.clone() {
                        *sum = V::load(&weights[p..]).madd(V::load(&mask[p..]), *sum);
                    }
                }
                sums.extend(&V::lane_sums(&inside)[..masks.len()]);
            }
        }
        if finished(job, transmittance) {
            break;
        }
    }
}

dispatched! {
    /// Measures how much the pixels of a tile change without each Gaussian: the sum of squared
    /// colour differences, each difference times `brightness`. `changes` has one value for each
    /// Gaussian of the list, up to where the tile is finished. On entry `behind` holds the tile's
    /// colours including the background; each Gaussian is then subtracted from it.
    fn by_change(job: &Job<'_>, brightness: &[Tile; 3], behind: &mut [Tile; 3], transmittance: &mut Tile, changes: &mut Vec<f32>)
        = by_change_body
}

#[inline(always)]
fn by_change_body<V: Vector>(
    job: &Job<'_>,
    brightness: &[Tile; 3],
    remaining: &mut [Tile; 3],
    transmittance: &mut Tile,
    changes: &mut Vec<f32>,
) {
    changes.clear();
    let one = V::splat(1.0);
    for batch in job.list.chunks(BATCH) {
        for &place in batch {
            let placed = TileSplat::<V>::new(job, job.band.gaussians[place as usize] as usize);
            let values = placed.values();
            let mut squares = V::splat(0.0);
            for p in placed.pixels.clone() {
                let alpha = placed.alphas(placed.dy(p));
                let w = absorb(alpha, &mut transmittance[p..]);
                // Without the Gaussian, the colour behind it increases by alpha / (1 - alpha) times
                // itself.
                let more = alpha.div(one.sub(alpha));
                for ((behind, brightness), value) in
                    remaining.iter_mut().zip(brightness).zip(values)
                {
                    let own = w.mul(value);
                    let rest = V::load(&behind[p..]).sub(own);
                    rest.store(&mut behind[p..]);
                    let change = rest.mul(more).sub(own).mul(V::load(&brightness[p..]));
                    squares = change.madd(change, squares);
                }
            }
            let mut lanes = EMPTY;
            squares.store(&mut lanes);
            changes.push(lanes[..V::LANES].iter().sum());
        }
        if finished(job, transmittance) {
            break;
        }
    }
}

/// Inputs of the backward pass for one tile.
pub struct BackwardInput {
    /// dL/d(colour, feature).
    pub gradient: [Tile; 6],
    /// R.g, with R the colour behind the Gaussians processed so far; docs/how-it-works.md, 5.1.
    pub r_dot_g: Tile,
    /// On entry 1 in the image and 0 in the padding.
    pub transmittance: Tile,
    /// Number of pairs that the forward pass processed.
    pub walked: u32,
}

dispatched! {
    /// Adds the gradients of a tile to the slots of its band.
    fn backward<const COLOR: bool, const FEATURE: bool, const MOVES: bool>(job: &Job<'_>, given: &mut BackwardInput, slots: &mut [[f32; SLOT_FLOATS]])
        = backward_body
}

#[inline(always)]
fn backward_body<V: Vector, const COLOR: bool, const FEATURE: bool, const MOVES: bool>(
    job: &Job<'_>,
    input: &mut BackwardInput,
    slots: &mut [[f32; SLOT_FLOATS]],
) {
    let (zero, one) = (V::splat(0.0), V::splat(1.0));
    for &place in &job.list[..input.walked as usize] {
        let placed = TileSplat::<V>::new(job, job.band.gaussians[place as usize] as usize);
        let values = placed.values();
        let [mut p_sum, mut py_sum, mut pyy_sum] = [zero; 3];
        let mut sums = [zero; 6];
        for at in placed.pixels.clone() {
            let dy = placed.dy(at);
            let alpha = placed.alphas(dy);
            let w = absorb(alpha, &mut input.transmittance[at..]);
            let gradient = |c: usize| V::load(&input.gradient[c][at..]);
            for c in channels::<COLOR, FEATURE>() {
                sums[c] = w.madd(gradient(c), sums[c]);
            }
            if COLOR {
                let mut c_dot_g = zero;
                for c in 0..if MOVES { 6 } else { 3 } {
                    c_dot_g = values[c].madd(gradient(c), c_dot_g);
                }
                let behind = &mut input.r_dot_g[at..];
                let w_c_dot_g = w.mul(c_dot_g);
                let r_dot_g = V::load(behind).sub(w_c_dot_g);
                r_dot_g.store(behind);
                let p = w_c_dot_g.sub(r_dot_g.mul(alpha.div(one.sub(alpha))));
                p_sum = p_sum.add(p);
                py_sum = p.madd(dy, py_sum);
                pyy_sum = p.mul(dy).madd(dy, pyy_sum);
            }
        }
        let (px, pxy) = (p_sum.mul(placed.dx), py_sum.mul(placed.dx));
        let [r, g, b, f0, f1, f2] = sums;
        let sums = V::lane_sums(&[
            px,
            py_sum,
            px.mul(placed.dx),
            pxy,
            pyy_sum,
            p_sum,
            r,
            g,
            b,
            f0,
            f1,
            f2,
        ]);
        slots[place as usize]
            .iter_mut()
            .zip(sums)
            .for_each(|(slot, sum)| *slot += sum);
    }
}

#[cfg(test)]
mod tests {
    use super::super::simd::Portable;
    use super::super::transposed;
    use super::*;
    use crate::density::State;
    use crate::tests::{camera, cloud};

    /// Runs all bodies with vectors of one width and concatenates their results.
    fn run_all_bodies<V: Vector>(
        view: &View,
        lists: &Lists,
        ids: &[u16],
        masks: &[Tile],
    ) -> Vec<f32> {
        let mut out = Vec::new();
        for tile in 0..(view.tiles[0] * view.tiles[1]) as usize {
            let job = Job::new(view, tile, lists);
            let transmittance = inside_image(view, &job);
            let mut blended = Blended {
                sums: [EMPTY; 6],
                transmittance,
                walked: 0,
            };
            forward_body::<V, true, true>(&job, &mut blended);
            let mut colours: [Tile; 3] = std::array::from_fn(|c| blended.sums[c]);
            let mut given = BackwardInput {
                gradient: blended.sums,
                r_dot_g: blended.transmittance,
                transmittance,
                walked: blended.walked,
            };
            let mut slots = vec![[0.0; SLOT_FLOATS]; job.band.gaussians.len()];
            backward_body::<V, true, true, true>(&job, &mut given, &mut slots);
            let (mut shares, mut inside, mut changes) = (Vec::new(), Vec::new(), Vec::new());
            by_id_body::<V>(&job, ids, &mut transmittance.clone(), &mut shares);
            by_mask_body::<V>(&job, masks, &mut transmittance.clone(), &mut inside);
            by_change_body::<V>(
                &job,
                &[transmittance; 3],
                &mut colours,
                &mut transmittance.clone(),
                &mut changes,
            );
            out.extend(blended.sums.concat());
            out.extend(blended.transmittance);
            out.extend(slots.concat());
            shares.sort_by_key(|share| share.0);
            out.extend(shares.iter().flat_map(|share| share.1));
            out.extend(inside);
            out.extend(changes);
        }
        out
    }

    #[test]
    fn log2_alpha_max_matches_alpha_max() {
        assert!((LOG2_ALPHA_MAX.exp2() - crate::cpu::ALPHA_MAX).abs() < 2e-7);
    }

    #[test]
    fn results_do_not_depend_on_the_vector_width() {
        let scene = cloud(3000, 4, 1, true);
        let state = State::of(&scene);
        // Neither image side is a multiple of the tile edge.
        let view = View::new(&camera(93, 61), scene.len(), 1);
        let lists = Lists::new(&view, &transposed(&state.params, scene.len()));
        let ids: Vec<u16> = (0..scene.len() as u16).map(|k| k % 7).collect();
        let masks: Vec<Tile> = (0..SLOT_FLOATS + 1)
            .map(|k| std::array::from_fn(|p| f32::from(u8::from(p % (k + 2) == 0))))
            .collect();
        let (eight, sixteen) = (
            run_all_bodies::<Portable<8>>(&view, &lists, &ids, &masks),
            run_all_bodies::<Portable<16>>(&view, &lists, &ids, &masks),
        );
        assert_eq!(eight.len(), sixteen.len());
        assert!(eight.iter().filter(|v| **v != 0.0).count() > eight.len() / 4);
        for (a, b) in eight.iter().zip(&sixteen) {
            assert!((a - b).abs() <= 1e-4 * a.abs().max(1.0), "{a} and {b}");
        }
    }
}
