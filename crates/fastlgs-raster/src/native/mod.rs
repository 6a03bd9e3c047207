//! The CPU engine: computes the same frames and gradients as the shaders, with SIMD on all cores.

mod adam;
pub(crate) mod blend;
mod lists;
mod loss;
mod picture;
mod simd;
mod votes;

use crate::channels::Channels;
use crate::cpu;
use crate::density::State;
use crate::engine::{
    Engine, ExposedPhoto, Frame, Losses, Memory, StepOptions, TargetImage, check_ids,
    check_saliency, no_depth, planes, rendered,
};
use crate::lift::{Vote, check_labels};
use crate::view::{DEPTH_MOMENTS, DepthLoss, Step, View};
use crate::{Error, Result};
use blend::{BackwardInput, Blended, EDGE, Job, Tile};
use fastlgs_core::gaussians::{BASE_CHANNELS, channels as channels_of};
use fastlgs_core::id_weights::{IDS_PER_PIXEL, pack};
use fastlgs_core::{IdWeights, LabelMap};
pub(crate) use lists::Lists;
use picture::TiledPlanes;
use rayon::prelude::*;
use simd::{AHEAD, SLOT_FLOATS};
use std::collections::{BTreeMap, HashMap};
use std::time::Instant;

/// Limit in bytes of the tile lists that are kept while geometry is frozen. Lists of further views
/// are computed anew in every step.
const CACHE_LIMIT: usize = 1 << 30;

/// [`Engine`] on the CPU.
#[derive(Default)]
pub struct CpuEngine {
    n: usize,
    sh_degree: u32,
    /// Trained values, `[n][channels]`. Moments and gradients have the same layout.
    params: Vec<f32>,
    moment1: Vec<f32>,
    moment2: Vec<f32>,
    gradients: Vec<f32>,
    stats: Vec<f32>,
    targets: HashMap<usize, TargetImage>,
    frame: TiledPlanes<8>,
    gradient: TiledPlanes<6>,
    scratch: loss::Scratch,
    processed: Vec<u32>,
    /// Gradient sums of a Gaussian over the tiles of one row. [`Lists::positions`] holds indices
    /// into it.
    slots: Vec<[f32; SLOT_FLOATS]>,
    lists: Option<Lists>,
    /// Tile lists by target id, kept while geometry is frozen.
    cached: HashMap<usize, Lists>,
    losses: Losses,
    profile: Option<BTreeMap<&'static str, f64>>,
}

/// Transposes `[channels][n]` into `[n][channels]`. With the number of channels as `n`, transposes
/// back.
pub(crate) fn transposed(columns: &[f32], n: usize) -> Vec<f32> {
    let channels = columns.len() / n.max(1);
    (0..n)
        .flat_map(|i| (0..channels).map(move |c| columns[c * n + i]))
        .collect()
}

/// Returns the `IDS_PER_PIXEL` ids with the largest weights as packed id weights, in descending
/// order.
fn heaviest(weights: impl Iterator<Item = (u16, f32)>) -> [u32; IDS_PER_PIXEL] {
    let mut best = [(0, 0.0); IDS_PER_PIXEL];
    for (id, weight) in weights {
        let place = best.iter().position(|b| weight > b.1);
        if let Some(place) = place {
            best[place..].rotate_right(1);
            best[place] = (id, weight);
        }
    }
    best.map(|(id, weight)| pack(id, weight))
}

/// Blends a tile including the background. Channels that are not requested are 0.
fn blended<const COLOR: bool, const FEATURE: bool>(
    view: &View,
    lists: &Lists,
    tile: usize,
) -> Blended {
    let job = Job::new(view, tile, lists);
    let inside = blend::inside_image(view, &job);
    let mut out = Blended {
        sums: [blend::EMPTY; 6],
        transmittance: inside,
        walked: 0,
    };
    blend::forward::<COLOR, FEATURE>(&job, &mut out);
    let background = view.background_color[..3]
        .iter()
        .chain(&view.background_feature[..3]);
    let asked = [COLOR, COLOR, COLOR, FEATURE, FEATURE, FEATURE];
    for ((sums, background), _) in out
        .sums
        .iter_mut()
        .zip(background)
        .zip(asked)
        .filter(|(_, asked)| *asked)
    {
        for (p, sum) in sums.iter_mut().enumerate() {
            *sum = inside[p] * (*sum + out.transmittance[p] * background);
        }
    }
    out
}

/// Writes dL/d frame of the depth moments. `depth` is the target `[h][w]` without padding.
fn depth_gradient(
    loss: &DepthLoss,
    frame: &TiledPlanes<8>,
    depth: &[f32],
    gradient: &mut TiledPlanes<6>,
) {
    let [width, padded] = [loss.size[0] as usize, gradient.width];
    let rows = gradient.rows_mut().zip(depth.par_chunks_exact(width));
    rows.enumerate().for_each(|(y, (out, depth))| {
        let moments = [3, 4, 5].map(|channel| frame.row(channel, y));
        for (x, depth) in depth.iter().enumerate() {
            let by_moments = cpu::depth_gradient_at(moments.map(|row| row[x]), *depth, loss.scale);
            for (channel, value) in (3..6).zip(by_moments) {
                out[channel * padded + x] = value;
            }
        }
    });
}

/// Returns [`blended`] for these channels.
fn blended_by(channels: Channels) -> fn(&View, &Lists, usize) -> Blended {
    match channels {
        Channels::Color => blended::<true, false>,
        Channels::Feature => blended::<false, true>,
        Channels::Both | Channels::Coupled => blended::<true, true>,
    }
}

impl CpuEngine {
    /// Creates an engine without Gaussians.
    pub fn new() -> Self {
        Self::default()
    }

    fn timed<T>(&mut self, name: &'static str, work: impl FnOnce(&mut Self) -> T) -> T {
        let started = Instant::now();
        let out = work(self);
        if let Some(profile) = &mut self.profile {
            *profile.entry(name).or_default() += started.elapsed().as_secs_f64();
        }
        out
    }

    /// Projects the Gaussians of a view and builds its tile lists. `frozen` is the id of the target
    /// whose cached lists are reused while geometry is frozen.
    fn list(&mut self, view: &View, frozen: Option<usize>) -> Result<()> {
        if view.gaussians as usize != self.n || self.n == 0 {
            return Err(Error::Invalid(format!(
                "the view expects {} Gaussians, but the engine holds {}",
                view.gaussians, self.n
            )));
        }
        self.timed("lists", |s| {
            s.lists = match frozen.and_then(|id| s.cached.remove(&id)) {
                Some(mut lists) => {
                    lists.refresh(view, &s.params);
                    Some(lists)
                }
                None => Some(Lists::new(view, &s.params)),
            };
        });
        Ok(())
    }

    /// Renders the frame that the loss compares. Stores how many pairs each tile processes.
    fn blend(&mut self, view: &View, channels: Channels) {
        self.frame.prepare(view);
        self.processed.resize(view.tile_count() as usize, 0);
        let (lists, blended) = (
            self.lists.as_ref().expect("made before blending"),
            blended_by(channels),
        );
        let (width, tiles_x) = (self.frame.width, view.tiles[0] as usize);
        let bands = self
            .frame
            .data
            .par_chunks_exact_mut(EDGE * 8 * width)
            .zip(self.processed.par_chunks_exact_mut(tiles_x));
        bands.enumerate().for_each(|(row, (band, walked))| {
            for column in 0..tiles_x {
                let tile = blended(view, lists, row * tiles_x + column);
                walked[column] = tile.walked;
                for (y, line) in band.chunks_exact_mut(8 * width).enumerate() {
                    for (c, plane) in line
                        .chunks_exact_mut(width)
                        .enumerate()
                        .filter(|(c, _)| rendered(channels, *c))
                    {
                        tile.write_row(c, y, &mut plane[column * EDGE..][..EDGE]);
                    }
                }
            }
        });
    }

    fn blend_backward<const COLOR: bool, const FEATURE: bool, const MOVES: bool>(
        &mut self,
        view: &View,
    ) {
        let lists = self.lists.as_ref().expect("made by the forward pass");
        self.slots.resize(lists.positions.len(), [0.0; SLOT_FLOATS]);
        let tiles_x = view.tiles[0] as usize;
        // Each row of tiles owns a contiguous range of the slots.
        let mut bands = Vec::new();
        let mut rest = &mut self.slots[..];
        for band in &lists.bands {
            let (own, after) = rest.split_at_mut(band.gaussians.len());
            bands.push(own);
            rest = after;
        }
        let (frame, gradient, walked) = (&self.frame, &self.gradient, &self.processed);
        bands.into_par_iter().enumerate().for_each(|(row, slots)| {
            slots.fill([0.0; SLOT_FLOATS]);
            for tile in row * tiles_x..(row + 1) * tiles_x {
                let job = Job::new(view, tile, lists);
                let trained = |c: usize| if c < 3 { COLOR } else { FEATURE };
                let g: [Tile; 6] = std::array::from_fn(|c| {
                    if trained(c) {
                        gradient.tile(c, &job)
                    } else {
                        blend::EMPTY
                    }
                });
                let mut r_dot_g = blend::EMPTY;
                for c in 0..if MOVES { 6 } else { 3 } {
                    let light = frame.tile(c, &job);
                    for (b, (l, g)) in r_dot_g.iter_mut().zip(light.iter().zip(&g[c])) {
                        *b += l * g;
                    }
                }
                let mut input = BackwardInput {
                    gradient: g,
                    r_dot_g,
                    transmittance: blend::inside_image(view, &job),
                    walked: walked[tile],
                };
                blend::backward::<COLOR, FEATURE, MOVES>(&job, &mut input, slots);
            }
        });
    }

    /// Computes gradients, statistics and the next trained values from the slots.
    fn update(&mut self, view: &View, channels: Channels, step: &Step) {
        let lists = self.lists.as_ref().expect("made by the forward pass");
        let (slots, width) = (&self.slots, channels_of(self.sh_degree));
        let rates: Vec<f32> = (0..adam::BLOCK * width)
            .map(|k| step.rates[(k % width).min(BASE_CHANNELS)])
            .collect();
        let (lengths, counts) = self.stats.split_at_mut(self.n);
        let size = adam::BLOCK * width;
        let blocks = self
            .params
            .par_chunks_mut(size)
            .zip(self.moment1.par_chunks_mut(size))
            .zip(self.moment2.par_chunks_mut(size));
        let blocks = blocks.zip(self.gradients.par_chunks_mut(size));
        let stats = lengths
            .par_chunks_mut(adam::BLOCK)
            .zip(counts.par_chunks_mut(adam::BLOCK));
        blocks.zip(stats).enumerate().for_each(
            |(block, ((((params, moment1), moment2), gradients), (lengths, counts)))| {
                for (k, (params, gradients)) in params
                    .chunks_exact(width)
                    .zip(gradients.chunks_exact_mut(width))
                    .enumerate()
                {
                    let i = block * adam::BLOCK + k;
                    let places = lists.positions_of(i);
                    lists
                        .positions_of(i + AHEAD)
                        .iter()
                        .for_each(|place| simd::prefetch(&slots[*place as usize]));
                    let mut slot = [0.0; SLOT_FLOATS];
                    for place in places {
                        let values = &slots[*place as usize];
                        (0..SLOT_FLOATS).for_each(|k| slot[k] += values[k]);
                    }
                    let put = |c: usize, value: f32| gradients[c] = value;
                    let gradient_length = cpu::backward_one(
                        view,
                        channels,
                        |c| params[c],
                        !places.is_empty(),
                        &lists.splats[i],
                        &slot,
                        put,
                    );
                    let counts_gradient =
                        channels.color() && view.depth_as_feature != DEPTH_MOMENTS;
                    if let Some(length) = gradient_length.filter(|_| counts_gradient) {
                        lengths[k] += length;
                        counts[k] += 1.0;
                    }
                }
                let first = block * adam::BLOCK;
                let frozen = width * (step.frozen as usize).saturating_sub(first);
                let frozen = frozen.min(params.len());
                adam::update_block(
                    step,
                    width,
                    &rates,
                    adam::Values {
                        params: &mut params[frozen..],
                        moment1: &mut moment1[frozen..],
                        moment2: &mut moment2[frozen..],
                        gradients: &gradients[frozen..],
                    },
                );
            },
        );
    }
}

impl Engine for CpuEngine {
    fn name(&self) -> String {
        let vectors = if cfg!(target_arch = "x86_64") {
            x86_vectors()
        } else {
            ""
        };
        format!("cpu ({} threads{vectors})", rayon::current_num_threads())
    }

    fn len(&self) -> usize {
        self.n
    }

    fn set_state(&mut self, state: &State) -> Result<()> {
        self.n = state.len();
        self.sh_degree = state.sh_degree;
        self.params = transposed(&state.params, self.n);
        self.moment1 = transposed(&state.moment1, self.n);
        self.moment2 = transposed(&state.moment2, self.n);
        self.gradients = vec![0.0; self.params.len()];
        self.stats = vec![0.0; 2 * self.n];
        self.cached.clear();
        Ok(())
    }

    fn state(&self) -> Result<State> {
        let columns = |rows: &[f32]| transposed(rows, channels_of(self.sh_degree));
        let (params, moment1, moment2) = (
            columns(&self.params),
            columns(&self.moment1),
            columns(&self.moment2),
        );
        Ok(State {
            sh_degree: self.sh_degree,
            params,
            moment1,
            moment2,
        })
    }

    fn stats(&self) -> Result<Vec<f32>> {
        Ok(self.stats.clone())
    }

    fn set_stats(&mut self, stats: &[f32]) -> Result<()> {
        self.stats = stats.to_vec();
        Ok(())
    }

    fn gradients(&self) -> Result<Vec<f32>> {
        Ok(transposed(&self.gradients, channels_of(self.sh_degree)))
    }

    fn set_target(&mut self, id: usize, mut target: TargetImage) -> Result<()> {
        target.color.append(&mut target.feature);
        self.targets.insert(id, target);
        self.cached.remove(&id);
        Ok(())
    }

    fn remove_target(&mut self, id: usize) {
        self.targets.remove(&id);
        self.cached.remove(&id);
    }

    fn render(&mut self, view: View, channels: Channels) -> Result<Frame> {
        self.list(&view, None)?;
        let (lists, blended) = (
            self.lists.as_ref().expect("made a line above"),
            blended_by(channels),
        );
        let (mut frame, width) = (
            Frame::new(&View {
                pairs: lists.pairs() as u32,
                ..view
            }),
            view.size[0] as usize,
        );
        // Splits each plane into the pixel rows of each row of tiles.
        let mut planes: Vec<_> = frame
            .data
            .chunks_exact_mut(view.pixels())
            .map(|plane| plane.chunks_mut(EDGE * width))
            .collect();
        let band =
            |_| -> Vec<&mut [f32]> { planes.iter_mut().filter_map(Iterator::next).collect() };
        let bands: Vec<Vec<&mut [f32]>> = (0..view.tiles[1]).map(band).collect();
        bands
            .into_par_iter()
            .enumerate()
            .for_each(|(row, mut band)| {
                for column in 0..view.tiles[0] as usize {
                    let tile = blended(&view, lists, row * view.tiles[0] as usize + column);
                    let columns = column * EDGE..width.min((column + 1) * EDGE);
                    for (c, plane) in band
                        .iter_mut()
                        .enumerate()
                        .filter(|(c, _)| rendered(channels, *c))
                    {
                        for (y, line) in plane.chunks_exact_mut(width).enumerate() {
                            tile.write_row(c, y, &mut line[columns.clone()]);
                        }
                    }
                }
            });
        Ok(frame)
    }

    fn render_ids(&mut self, view: View, ids: &[u16]) -> Result<IdWeights> {
        check_ids(&view, ids, self.n)?;
        let lists = Lists::new(&view, &self.params);
        let [width, height] = view.size;
        let mut pixels = vec![[0; IDS_PER_PIXEL]; view.pixels()];
        pixels
            .par_chunks_mut(EDGE * width as usize)
            .enumerate()
            .for_each_init(Vec::new, |sums, (row, band)| {
                for tile in row * view.tiles[0] as usize..(row + 1) * view.tiles[0] as usize {
                    let job = Job::new(&view, tile, &lists);
                    blend::weights_by_id(&job, ids, &mut blend::inside_image(&view, &job), sums);
                    for (y, line) in band.chunks_exact_mut(width as usize).enumerate() {
                        for (x, pixel) in line[job.x as usize..].iter_mut().take(EDGE).enumerate() {
                            let at = |tile: &Tile| tile[y * EDGE + x];
                            *pixel = heaviest(sums.iter().map(|(id, tile)| (*id, at(tile))));
                        }
                    }
                }
            });
        Ok(IdWeights {
            width,
            height,
            pixels,
        })
    }

    fn votes(&mut self, view: View, labels: &LabelMap) -> Result<Vec<Vote>> {
        check_labels(&view, labels)?;
        let view = View {
            sh_degree: 0,
            ..view
        };
        self.list(&view, None)?;
        let lists = self.lists.as_ref().expect("made a line above");
        Ok(votes::votes(&view, lists, labels))
    }

    fn saliency(
        &mut self,
        view: View,
        photo: Option<&ExposedPhoto>,
        scores: &mut [f32],
    ) -> Result<f64> {
        check_saliency(&view, photo, scores)?;
        self.list(&view, None)?;
        let lists = self.lists.as_ref().expect("made a line above");
        Ok(votes::saliency(&view, lists, photo, scores))
    }

    fn step(&mut self, view: View, id: usize, options: &StepOptions, step: &Step) -> Result<()> {
        let channels = options.channels;
        if self.targets.get(&id).is_none_or(|t| t.size != view.size) {
            return Err(Error::Invalid(format!(
                "target {id} of size {}x{} is missing; call set_target first",
                view.size[0], view.size[1]
            )));
        }
        if options.depth_weight > 0.0 {
            if self.targets[&id].depth.is_empty() {
                return Err(no_depth());
            }
        } else if channels.feature() {
            // Pixels without a feature do not enter the loss.
            let target = self.targets.get_mut(&id).expect("checked above");
            target.color.resize(2 * view.pixels(), 0);
        }
        let frozen = (channels == Channels::Feature).then_some(id);
        // Cached lists must contain all Gaussians, so no Gaussian is dropped.
        let view = if frozen.is_some() {
            view.with_dropout(0.0, 0)
        } else {
            view
        };
        self.list(&view, frozen)?;
        self.timed("blend", |s| s.blend(&view, channels));
        self.timed("loss", |s| {
            s.gradient.prepare(&view);
            s.losses = Losses::default();
            for plane in planes(&view, options) {
                s.scratch.plane(
                    &plane,
                    &s.frame,
                    &s.targets[&id].color,
                    &mut s.gradient,
                    &mut s.losses,
                );
            }
        });
        if options.depth_weight > 0.0 {
            let loss = DepthLoss::new(&view, options.depth_weight);
            self.timed("depth_gradient", |s| {
                depth_gradient(&loss, &s.frame, &s.targets[&id].depth, &mut s.gradient);
            });
        }
        self.timed("blend_backward", |s| match channels {
            Channels::Color => s.blend_backward::<true, false, false>(&view),
            Channels::Feature => s.blend_backward::<false, true, false>(&view),
            Channels::Both => s.blend_backward::<true, true, false>(&view),
            Channels::Coupled => s.blend_backward::<true, true, true>(&view),
        });
        self.timed("update", |s| s.update(&view, channels, step));
        if let Some(id) = frozen
            && self.cached.values().map(Lists::bytes).sum::<usize>() < CACHE_LIMIT
        {
            self.cached
                .extend(self.lists.take().map(|lists| (id, lists)));
        }
        Ok(())
    }

    fn losses(&self) -> Result<Losses> {
        Ok(self.losses)
    }

    fn memory(&self) -> Memory {
        let bytes = |words: usize| 4 * words as u64;
        let words = |lists: &Lists| lists.pairs() + 2 * lists.positions.len();
        Memory {
            state: bytes(3 * self.params.len()),
            lists: bytes(self.lists.as_ref().map_or(0, words) + SLOT_FLOATS * self.slots.len()),
            gaussians: bytes(self.gradients.len() + 14 * self.n),
            frame: bytes(self.frame.data.len() + self.gradient.data.len() + self.scratch.words()),
            views: self
                .targets
                .values()
                .map(|t| bytes(t.color.len()))
                .sum::<u64>()
                + self
                    .cached
                    .values()
                    .map(|l| bytes(words(l) + 14 * self.n))
                    .sum::<u64>(),
        }
    }

    fn set_profiling(&mut self, on: bool) -> bool {
        self.profile = on.then(BTreeMap::new);
        true
    }

    fn take_profile(&mut self) -> Result<BTreeMap<&'static str, f64>> {
        Ok(self
            .profile
            .as_mut()
            .map(std::mem::take)
            .unwrap_or_default())
    }
}

/// Returns the vector instructions of the processor, for reports.
fn x86_vectors() -> &'static str {
    #[cfg(target_arch = "x86_64")]
    {
        if is_x86_feature_detected!("avx512dq") {
            return ", AVX-512";
        }
        if is_x86_feature_detected!("avx2") {
            return ", AVX2";
        }
    }
    ""
}
