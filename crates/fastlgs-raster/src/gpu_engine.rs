//! The passes on a wgpu device.

use crate::cpu::{CHAINS, CHUNKS, RUN};
use crate::density::State;
use crate::engine::{Engine, Frame, Losses, Memory, StepOptions, TargetImage, check_ids, losses_of, planes, tile_bits};
use crate::pass::{Channels, Pass, Recorder, Shader, shaders};
use crate::profile::Profile;
use crate::view::{Ceiling, Job, Perturb, Step, View, stride};
use crate::{Error, Gpu, Result};
use fastlgs_core::Shares;
use fastlgs_core::gaussians::channels as channels_of;
use fastlgs_core::shares::KEPT;
use std::collections::{BTreeMap, HashMap};
use std::time::Instant;
use wgpu::Buffer;

/// Workgroup size of the kernels that run over Gaussians, pairs or pixels.
const GROUP: u32 = 64;

/// Views' lists are kept for feature training as long as they take no more than this.
const CACHE_LIMIT: u64 = 1 << 30;

struct Passes {
    radix_count: Pass,
    radix_scatter: Pass,
    scan_chunks: Pass,
    scan_apply: Pass,
    gather_counts: Pass,
    emit: Pass,
    tile_ranges: Pass,
    tile_load: Pass,
    blend_ids: Pass,
    ssim_rows: Pass,
    ssim_columns: Pass,
    ssim_backward_rows: Pass,
    loss_gradient: Pass,
    adam: Pass,
    perturb: Pass,
}

/// The passes that differ with what is trained.
struct Blending {
    project: Pass,
    blend: Pass,
    blend_backward: Pass,
    project_backward: Pass,
}

/// Trained values of as many Gaussians as one binding holds, each buffer `[channel][gaussian of the page]`.
struct Page {
    first: usize,
    n: usize,
    params: Buffer,
    moment1: Buffer,
    moment2: Buffer,
    gradients: Buffer,
}

/// Buffers with one item a Gaussian.
struct PerGaussian {
    n: usize,
    sh_degree: u32,
    pages: Vec<Page>,
    stats: Buffer,
    splats: Buffer,
    footprints: Buffer,
    offsets: Buffer,
    touched: Buffer,
    first_pair: Buffer,
    sort: Sort,
}

/// Buffers with one item a pixel or tile; training ones are made on the first step.
struct PerFrame {
    size: [u32; 2],
    ranges: Buffer,
    tile_sort: Sort,
    frame: Buffer,
    training: Option<Training>,
}

struct Training {
    gradient: Buffer,
    rows: Buffer,
    partials: Buffer,
    ssim_sums: Buffer,
    sums: Buffer,
}

/// Buffers with one item a (tile, Gaussian) pair.
struct PerPair {
    capacity: usize,
    gaussians: Buffer,
    sort: Sort,
}

/// Ping-pong buffers of a radix sort. Keys go into `keys[0]`.
struct Sort {
    keys: [Buffer; 2],
    values: [Buffer; 2],
}

impl Sort {
    fn new(gpu: &Gpu, what: &str, n: usize) -> Result<Self> {
        let make = || gpu.storage(what, 4 * n as u64);
        Ok(Self { keys: [make()?, make()?], values: [make()?, make()?] })
    }

    fn bytes(&self) -> u64 {
        bytes_of(&[&self.keys[0], &self.keys[1], &self.values[0], &self.values[1]])
    }
}

fn bytes_of(buffers: &[&Buffer]) -> u64 {
    buffers.iter().map(|b| b.size()).sum()
}

/// What blending walks through; buffers are handles, so that copies are cheap.
#[derive(Clone)]
struct Lists {
    view: View,
    order: Buffer,
    touched: Buffer,
    first_pair: Buffer,
    ranges: Buffer,
    tile_order: Buffer,
    sorted_pairs: Buffer,
    pair_gaussians: Buffer,
}

impl Lists {
    fn bytes(&self) -> u64 {
        bytes_of(&[&self.order, &self.touched, &self.first_pair, &self.ranges, &self.tile_order, &self.sorted_pairs, &self.pair_gaussians])
    }
}

/// [`Engine`] on a wgpu adapter.
pub struct GpuEngine {
    gpu: Gpu,
    passes: Passes,
    blending: HashMap<(Channels, bool), Blending>,
    histogram: Buffer,
    totals: Buffer,
    gaussians: Option<PerGaussian>,
    frame: Option<PerFrame>,
    pairs: Option<PerPair>,
    /// Gradient slots of a window of pairs.
    slots: Option<Buffer>,
    targets: HashMap<usize, ([u32; 2], Buffer)>,
    /// Lists of views whose geometry is frozen.
    cached: HashMap<usize, Lists>,
    last: Option<(View, Channels)>,
    /// This many first passes of every frame run as their CPU twins, to find a wrong one; `FASTLGS_PASSES_ON_CPU` sets it.
    pub passes_on_cpu: usize,
}

impl GpuEngine {
    /// Compiles the passes; those that differ with what is trained follow when they are needed.
    pub fn new(gpu: Gpu) -> Self {
        let pass = |shader: &Shader| Pass::new(&gpu, shader, Channels::Both, false);
        let passes = Passes {
            radix_count: pass(&shaders::RADIX_COUNT),
            radix_scatter: pass(&shaders::RADIX_SCATTER),
            scan_chunks: pass(&shaders::SCAN_CHUNKS),
            scan_apply: pass(&shaders::SCAN_APPLY),
            gather_counts: pass(&shaders::GATHER_COUNTS),
            emit: pass(&shaders::EMIT),
            tile_ranges: pass(&shaders::TILE_RANGES),
            tile_load: pass(&shaders::TILE_LOAD),
            blend_ids: pass(&shaders::BLEND_IDS),
            ssim_rows: pass(&shaders::SSIM_ROWS),
            ssim_columns: pass(&shaders::SSIM_COLUMNS),
            ssim_backward_rows: pass(&shaders::SSIM_BACKWARD_ROWS),
            loss_gradient: pass(&shaders::LOSS_GRADIENT),
            adam: pass(&shaders::ADAM),
            perturb: pass(&shaders::PERTURB),
        };
        let small = |words: usize| gpu.storage("sorting", 4 * words as u64).expect("a small buffer fits every adapter");
        Self {
            histogram: small(256 * CHUNKS),
            totals: small(CHUNKS + 1),
            gpu,
            passes,
            blending: HashMap::new(),
            gaussians: None,
            frame: None,
            pairs: None,
            slots: None,
            targets: HashMap::new(),
            cached: HashMap::new(),
            last: None,
            passes_on_cpu: std::env::var("FASTLGS_PASSES_ON_CPU").ok().and_then(|k| k.parse().ok()).unwrap_or(0),
        }
    }

    /// Exclusive prefix sum of `items`, in place; the total goes to `totals[CHUNKS]`.
    fn scan(&self, r: &mut Recorder, items: &Buffer, n: u32) -> Result<()> {
        let job = Job { n, shift: 0, first: 0, unused: 0 };
        let groups = CHUNKS as u32 / GROUP;
        r.run(&self.passes.scan_chunks, &job, &[items, &self.totals], groups)?;
        r.run(&self.passes.scan_apply, &job, &[items, &self.totals], groups)
    }

    /// Sorts by the lowest `bits`; returns the side that holds the result. Values come out as former places.
    fn radix_sort(&self, r: &mut Recorder, sort: &Sort, n: u32, bits: u32) -> Result<usize> {
        let mut side = 0;
        let groups = CHUNKS as u32 / GROUP;
        for (round, shift) in (0..bits).step_by(8).enumerate() {
            let job = Job { n, shift, first: u32::from(round == 0), unused: 0 };
            r.run(&self.passes.radix_count, &job, &[&sort.keys[side], &self.histogram], groups)?;
            self.scan(r, &self.histogram, 256 * CHUNKS as u32)?;
            let (from, to) = (side, 1 - side);
            let buffers = [&sort.keys[from], &sort.values[from], &self.histogram, &sort.keys[to], &sort.values[to]];
            r.run(&self.passes.radix_scatter, &job, &buffers, groups)?;
            side = to;
        }
        Ok(side)
    }

    fn prepare_blending(&mut self, key: (Channels, bool)) {
        let gpu = &self.gpu;
        let pass = |shader: &Shader| Pass::new(gpu, shader, key.0, key.1);
        self.blending.entry(key).or_insert_with(|| Blending {
            project: pass(&shaders::PROJECT),
            blend: pass(&shaders::BLEND),
            blend_backward: pass(&shaders::BLEND_BACKWARD),
            project_backward: pass(&shaders::PROJECT_BACKWARD),
        });
    }

    fn prepare_frame(&mut self, view: &View, training: bool) -> Result<()> {
        let pixels = view.padded_pixels() as u64;
        let tiles = view.tile_count();
        let storage = |what: &str, bytes: u64| self.gpu.storage(what, bytes);
        if self.frame.as_ref().is_none_or(|f| f.size != view.size) {
            self.frame = Some(PerFrame {
                size: view.size,
                ranges: storage("tile ranges", 8 * u64::from(tiles))?,
                tile_sort: Sort::new(&self.gpu, "tile order", tiles as usize)?,
                frame: storage("the frame", 32 * pixels)?,
                training: None,
            });
        }
        let frame = self.frame.as_mut().expect("made above");
        if training && frame.training.is_none() {
            let sums = 24 * u64::from(RUN as u32 * tiles);
            frame.training = Some(Training {
                gradient: storage("the frame's gradient", 24 * pixels)?,
                rows: storage("SSIM rows", 20 * pixels)?,
                partials: storage("SSIM partials", 12 * pixels)?,
                ssim_sums: storage("SSIM sums", sums)?,
                sums: storage("loss sums", 4 * sums)?,
            });
        }
        Ok(())
    }

    /// Room for `pairs` pairs, with a quarter to spare so that growth is rare.
    fn prepare_pairs(&mut self, pairs: usize) -> Result<()> {
        if self.pairs.as_ref().is_none_or(|p| p.capacity < pairs) {
            let most = (self.gpu.max_binding / 4) as usize;
            let capacity = (pairs + pairs / 4 + 1024).min(most.max(pairs));
            self.pairs = None;
            let gaussians = self.gpu.storage("the tile list", 4 * capacity as u64)?;
            let sort = Sort::new(&self.gpu, "the tile list", capacity)?;
            self.pairs = Some(PerPair { capacity, gaussians, sort });
        }
        Ok(())
    }

    /// Gradient slots for all pairs, or for as many as one binding holds; returns the windows (first pair, pairs).
    fn prepare_slots(&mut self, view: &View, channels: Channels) -> Result<Vec<(u32, u32)>> {
        let bytes = 16 * channels.slot();
        let most = (self.gpu.max_binding as usize / bytes).min(u32::MAX as usize / 2);
        let (pairs, spare) = (view.pairs as usize, view.tile_count() as usize);
        let window = if pairs <= most { pairs } else { most.saturating_sub(spare) };
        if window == 0 && pairs > 0 {
            return Err(Error::TooLarge(format!("{} tiles are too many for '{}'; lower --size", spare, self.gpu.name)));
        }
        let needed = (bytes * pairs.min(most)) as u64;
        if self.slots.as_ref().is_none_or(|slots| slots.size() < needed) {
            self.slots = None;
            let roomy = (needed + needed / 4).min((bytes * most) as u64);
            self.slots = Some(self.gpu.storage("gradient slots of the tile list", roomy)?);
        }
        if pairs <= most {
            return Ok(vec![(0, u32::MAX / 2)]);
        }
        let firsts: Vec<u32> = (0..pairs).step_by(window).map(|first| first as u32).collect();
        let last = *firsts.last().expect("pairs > most");
        Ok(firsts.iter().map(|&f| (f, if f == last { (pairs - f as usize) as u32 + 1 } else { window as u32 })).collect())
    }

    fn project(&self, r: &mut Recorder, view: &View, channels: Channels) -> Result<()> {
        let pass = &self.blending[&kind(view, channels)].project;
        let g = self.gaussians.as_ref().expect("checked by the caller");
        for page in &g.pages {
            let view = View { first: page.first as u32, page: page.n as u32, ..*view };
            let buffers = [&page.params, &g.splats, &g.sort.keys[0], &g.footprints, &g.touched];
            r.run(pass, &view, &buffers, view.page.div_ceil(GROUP))?;
        }
        Ok(())
    }

    /// Projection and sorting: everything that blending needs.
    fn lists(&mut self, mut view: View, channels: Channels, on_cpu: &mut usize) -> Result<Lists> {
        let n = self.len();
        let g = self.gaussians.as_ref().expect("checked by the caller");
        let groups = (n as u32).div_ceil(GROUP);
        let mut r = Recorder::new(&self.gpu, *on_cpu);
        self.project(&mut r, &view, channels)?;
        let side = self.radix_sort(&mut r, &g.sort, n as u32, 24)?;
        let order = &g.sort.values[side];
        r.run(&self.passes.gather_counts, &view, &[order, &g.touched, &g.offsets], groups)?;
        self.scan(&mut r, &g.offsets, n as u32)?;
        *on_cpu = r.submit();
        // Counted before anything is written, so that no list can overflow.
        view.pairs = self.gpu.read::<u32>(&self.totals, CHUNKS + 1)?[CHUNKS];
        if view.pairs == u32::MAX {
            let reason = "more than 4 billion pairs of tiles and Gaussians: the scene has huge Gaussians; prune them or lower --size";
            return Err(Error::TooLarge(reason.to_owned()));
        }
        self.prepare_pairs(view.pairs as usize)?;
        let g = self.gaussians.as_ref().expect("as above");
        let (list, frame) = (self.pairs.as_ref().expect("prepared"), self.frame.as_ref().expect("prepared"));
        let order = &g.sort.values[side];
        let mut r = Recorder::new(&self.gpu, *on_cpu);
        let buffers = [order, &g.offsets, &g.footprints, &g.touched, &list.sort.keys[0], &list.gaussians, &g.first_pair];
        r.run(&self.passes.emit, &view, &buffers, groups)?;
        let sorted = self.radix_sort(&mut r, &list.sort, view.pairs, tile_bits(&view))?;
        r.clear(&frame.ranges);
        r.run(&self.passes.tile_ranges, &view, &[&list.sort.keys[sorted], &frame.ranges], view.pairs.div_ceil(GROUP))?;
        r.run(&self.passes.tile_load, &view, &[&frame.ranges, &frame.tile_sort.keys[0]], view.tile_count().div_ceil(GROUP))?;
        let ordered = self.radix_sort(&mut r, &frame.tile_sort, view.tile_count(), 8)?;
        *on_cpu = r.submit();
        Ok(Lists {
            view,
            order: order.clone(),
            touched: g.touched.clone(),
            first_pair: g.first_pair.clone(),
            ranges: frame.ranges.clone(),
            tile_order: frame.tile_sort.values[ordered].clone(),
            sorted_pairs: list.sort.values[sorted].clone(),
            pair_gaussians: list.gaussians.clone(),
        })
    }

    /// The lists of a view whose geometry is frozen: made once, then kept with the view's target.
    fn frozen_lists(&mut self, view: View, channels: Channels, id: usize, on_cpu: &mut usize) -> Result<Lists> {
        let known = self.cached.get(&id).filter(|l| same_camera(&l.view, &view)).cloned();
        if let Some(lists) = known {
            let mut r = Recorder::new(&self.gpu, *on_cpu);
            self.project(&mut r, &view, channels)?;
            *on_cpu = r.submit();
            return Ok(lists);
        }
        let lists = self.lists(view, channels, on_cpu)?;
        if self.cached.values().map(Lists::bytes).sum::<u64>() < CACHE_LIMIT {
            let (pairs, n, tiles) = (lists.view.pairs, lists.view.gaussians, lists.view.tile_count());
            let mut r = Recorder::new(&self.gpu, 0);
            let mut keep = |from: &Buffer, words: u32| -> Result<Buffer> {
                let to = self.gpu.storage("a view's lists", 4 * u64::from(words))?;
                r.copy(from, &to);
                Ok(to)
            };
            let kept = Lists {
                view: lists.view,
                order: keep(&lists.order, n)?,
                touched: keep(&lists.touched, n)?,
                first_pair: keep(&lists.first_pair, n)?,
                ranges: keep(&lists.ranges, 2 * tiles)?,
                tile_order: keep(&lists.tile_order, tiles)?,
                sorted_pairs: keep(&lists.sorted_pairs, pairs)?,
                pair_gaussians: keep(&lists.pair_gaussians, pairs)?,
            };
            r.submit();
            self.cached.insert(id, kept);
        }
        Ok(lists)
    }

    /// Everything up to blending into the frame buffer.
    fn forward(&mut self, view: View, channels: Channels, frozen: Option<usize>, training: bool, on_cpu: &mut usize) -> Result<Lists> {
        let n = self.len();
        if view.gaussians as usize != n || n == 0 {
            return Err(Error::Invalid(format!("the view was made for {} Gaussians, the device holds {n}", view.gaussians)));
        }
        self.prepare_blending(kind(&view, channels));
        self.prepare_frame(&view, training)?;
        let lists = match frozen {
            Some(id) => self.frozen_lists(view, channels, id, on_cpu)?,
            None => self.lists(view, channels, on_cpu)?,
        };
        let (g, frame) = (self.gaussians.as_ref().expect("n > 0"), self.frame.as_ref().expect("prepared"));
        let mut r = Recorder::new(&self.gpu, *on_cpu);
        let buffers = [&lists.ranges, &lists.tile_order, &lists.sorted_pairs, &lists.pair_gaussians, &g.splats, &frame.frame];
        let view = View { pairs: lists.view.pairs, ..view };
        r.run(&self.blending[&kind(&view, channels)].blend, &view, &buffers, self.gpu.shape.groups(view.tile_count()))?;
        *on_cpu = r.submit();
        Ok(Lists { view, ..lists })
    }

    fn each_page(&self, what: impl Fn(&Page) -> &Buffer) -> Result<Vec<f32>> {
        let Some(g) = &self.gaussians else { return Ok(Vec::new()) };
        let channels = channels_of(g.sh_degree);
        let mut out = vec![0.0; channels * g.n];
        for page in &g.pages {
            let stride = stride(page.n);
            let values: Vec<f32> = self.gpu.read(what(page), channels * stride)?;
            for c in 0..channels {
                out[c * g.n + page.first..][..page.n].copy_from_slice(&values[c * stride..][..page.n]);
            }
        }
        Ok(out)
    }
}

/// Which kernels a frame needs: its channels, and whether colour depends on the view.
fn kind(view: &View, channels: Channels) -> (Channels, bool) {
    (channels, view.sh_degree > 0)
}

/// Whether lists made for `a` serve `b`.
fn same_camera(a: &View, b: &View) -> bool {
    let key = |v: &View| (v.world_to_camera, v.focal, v.centre, v.size, v.gaussians, v.antialias);
    key(a) == key(b)
}

/// The Gaussians `first..first + n` of values `[channels][all]`, with the page's stride.
fn page_of(values: &[f32], all: usize, first: usize, n: usize) -> Vec<f32> {
    let padding = std::iter::repeat_n(0.0, stride(n) - n);
    values.chunks_exact(all).flat_map(|channel| channel[first..first + n].iter().copied().chain(padding.clone())).collect()
}

impl Engine for GpuEngine {
    fn name(&self) -> String {
        self.gpu.name.clone()
    }

    fn len(&self) -> usize {
        self.gaussians.as_ref().map_or(0, |g| g.n)
    }

    fn set_state(&mut self, state: &State) -> Result<()> {
        let (n, sh_degree) = (state.len(), state.sh_degree);
        self.cached.clear();
        if self.gaussians.as_ref().is_none_or(|g| (g.n, g.sh_degree) != (n, sh_degree)) {
            self.gaussians = None;
            let gpu = &self.gpu;
            let storage = |what: &str, words: usize| gpu.storage(what, 4 * words as u64);
            let channels = channels_of(sh_degree);
            let size = ((gpu.max_binding / 4) as usize / channels / 64 * 64).max(64);
            let page = |first: usize| {
                let length = size.min(n - first);
                let values = |what: &str| storage(what, channels * stride(length));
                Ok(Page {
                    first,
                    n: length,
                    params: values("the Gaussians")?,
                    moment1: values("Adam's first moment")?,
                    moment2: values("Adam's second moment")?,
                    gradients: values("the gradients")?,
                })
            };
            self.gaussians = Some(PerGaussian {
                n,
                sh_degree,
                pages: (0..n).step_by(size).map(page).collect::<Result<_>>()?,
                stats: storage("density statistics", 2 * n)?,
                splats: storage("the projected Gaussians", 12 * n)?,
                footprints: storage("footprints", 8 * n)?,
                touched: storage("tile counts", n)?,
                offsets: storage("tile offsets", n)?,
                first_pair: storage("first pairs", n)?,
                sort: Sort::new(gpu, "the depth sort", n)?,
            });
        }
        let g = self.gaussians.as_ref().expect("made above");
        for page in &g.pages {
            for (buffer, all) in [(&page.params, &state.params), (&page.moment1, &state.moment1), (&page.moment2, &state.moment2)] {
                self.gpu.queue.write_buffer(buffer, 0, bytemuck::cast_slice(&page_of(all, n, page.first, page.n)));
            }
        }
        let mut r = Recorder::new(&self.gpu, 0);
        r.clear(&g.stats);
        // Gradients of channels that are not trained stay what they are: zero.
        g.pages.iter().for_each(|page| r.clear(&page.gradients));
        r.submit();
        Ok(())
    }

    fn state(&self) -> Result<State> {
        let sh_degree = self.gaussians.as_ref().map_or(0, |g| g.sh_degree);
        let (params, moment1, moment2) = (self.each_page(|p| &p.params)?, self.each_page(|p| &p.moment1)?, self.each_page(|p| &p.moment2)?);
        Ok(State { sh_degree, params, moment1, moment2 })
    }

    fn stats(&self) -> Result<Vec<f32>> {
        self.gaussians.as_ref().map_or(Ok(Vec::new()), |g| self.gpu.read(&g.stats, 2 * g.n))
    }

    fn set_stats(&mut self, stats: &[f32]) -> Result<()> {
        if let Some(g) = &self.gaussians {
            self.gpu.queue.write_buffer(&g.stats, 0, bytemuck::cast_slice(stats));
        }
        Ok(())
    }

    fn gradients(&self) -> Result<Vec<f32>> {
        self.each_page(|p| &p.gradients)
    }

    fn set_target(&mut self, id: usize, target: &TargetImage) -> Result<()> {
        let camera_less =
            View { size: target.size, tiles: target.size.map(|s| s.div_ceil(crate::view::TILE)), ..bytemuck::Zeroable::zeroed() };
        let buffer = self.gpu.storage_with("a target picture", &target.padded(&camera_less))?;
        self.targets.insert(id, (target.size, buffer));
        self.cached.remove(&id);
        Ok(())
    }

    fn render(&mut self, view: View, channels: Channels) -> Result<Frame> {
        let mut on_cpu = self.passes_on_cpu;
        let view = self.forward(view, channels, None, false, &mut on_cpu)?.view;
        let frame = self.frame.as_ref().expect("made by forward");
        let plane = view.padded_pixels();
        self.gpu.read_with(&frame.frame, 8 * plane, |planes: &[f32]| {
            Frame::gathered(&view, channels, |channel, y| &planes[channel * plane + view.at(0, y)..])
        })
    }

    fn render_ids(&mut self, view: View, ids: &[u16]) -> Result<Shares> {
        check_ids(&view, ids, self.len())?;
        let channels = Channels::Feature;
        let mut on_cpu = self.passes_on_cpu;
        self.prepare_blending(kind(&view, channels));
        self.prepare_frame(&view, false)?;
        let lists = self.lists(view, channels, &mut on_cpu)?;
        let words: Vec<u32> = ids.iter().map(|id| u32::from(*id)).collect();
        let ids = self.gpu.storage_with("object ids", &words)?;
        let (g, frame) = (self.gaussians.as_ref().expect("n > 0"), self.frame.as_ref().expect("prepared"));
        let mut r = Recorder::new(&self.gpu, on_cpu);
        // The frame has room for eight words a pixel, shares need four.
        let buffers = [&lists.ranges, &lists.sorted_pairs, &lists.pair_gaussians, &g.splats, &ids, &frame.frame];
        r.run(&self.passes.blend_ids, &lists.view, &buffers, view.tile_count())?;
        r.submit();
        let [width, height] = view.size;
        let plane = view.padded_pixels();
        let gather = |slots: &[u32]| {
            let pixel = |(x, y)| std::array::from_fn(|k| slots[k * plane + view.at(x, y)]);
            (0..height).flat_map(|y| (0..width).map(move |x| (x, y))).map(pixel).collect()
        };
        Ok(Shares { width, height, pixels: self.gpu.read_with(&frame.frame, KEPT * plane, gather)? })
    }

    fn step(&mut self, view: View, id: usize, options: &StepOptions, step: &Step) -> Result<()> {
        let channels = options.channels;
        let mut on_cpu = self.passes_on_cpu;
        let frozen = (channels == Channels::Feature).then_some(id);
        let lists = self.forward(view, channels, frozen, true, &mut on_cpu)?;
        let view = lists.view;
        let windows = self.prepare_slots(&view, channels)?;
        let target = self.targets.get(&id).filter(|t| t.0 == view.size).map(|t| &t.1);
        let target = target.ok_or_else(|| Error::Invalid(format!("no target {id} of {}x{}", view.size[0], view.size[1])))?;
        let (g, frame) = (self.gaussians.as_ref().expect("made"), self.frame.as_ref().expect("made"));
        let t = frame.training.as_ref().expect("made");
        let slots = self.slots.as_ref().expect("made");
        let mut r = Recorder::new(&self.gpu, on_cpu);
        for plane in planes(&view, options) {
            let (row_groups, column_groups) =
                ((plane.quads / 2 * plane.rows).div_ceil(GROUP), (plane.rows / 8 * plane.quads).div_ceil(GROUP));
            r.run(&self.passes.ssim_rows, &plane, &[&frame.frame, target, &t.rows], row_groups)?;
            r.run(&self.passes.ssim_columns, &plane, &[&t.rows, &t.partials, &t.ssim_sums], column_groups)?;
            r.run(&self.passes.ssim_backward_rows, &plane, &[&t.partials, &t.rows], row_groups)?;
            r.run(&self.passes.loss_gradient, &plane, &[&frame.frame, target, &t.rows, &t.gradient, &t.sums], column_groups)?;
        }
        let blending = &self.blending[&kind(&view, channels)];
        for (slot_first, slot_count) in windows {
            let view = View { slot_first, slot_count, ..view };
            let lists_of = [&lists.ranges, &lists.tile_order, &lists.sorted_pairs, &lists.pair_gaussians, &g.splats];
            let buffers = [&lists_of[..], &[&frame.frame, &t.gradient, slots]].concat();
            r.run(&blending.blend_backward, &view, &buffers, self.gpu.shape.groups(view.tile_count()))?;
            for page in &g.pages {
                let view = View { first: page.first as u32, page: page.n as u32, ..view };
                let buffers = [&page.params, &g.splats, &lists.order, &lists.touched, &lists.first_pair, slots, &page.gradients, &g.stats];
                r.run(&blending.project_backward, &view, &buffers, view.gaussians.div_ceil(GROUP))?;
            }
        }
        for page in &g.pages {
            let step = Step { quads: stride(page.n) as u32 / 4, ..*step };
            let buffers = [&page.gradients, &page.params, &page.moment1, &page.moment2];
            r.run(&self.passes.adam, &step, &buffers, step.quads.div_ceil(GROUP))?;
        }
        r.submit();
        self.last = Some((view, channels));
        Ok(())
    }

    fn perturb(&mut self, seed: u32, amount: f32) -> Result<()> {
        let mut r = Recorder::new(&self.gpu, 0);
        for page in self.gaussians.iter().flat_map(|g| &g.pages) {
            let job = Perturb { n: page.n as u32, first: page.first as u32, seed, amount };
            r.run(&self.passes.perturb, &job, &[&page.params], job.n.div_ceil(GROUP))?;
        }
        r.submit();
        Ok(())
    }

    fn losses(&self) -> Result<Losses> {
        let (Some((view, channels)), Some(t)) = (&self.last, self.frame.as_ref().and_then(|f| f.training.as_ref())) else {
            return Ok(Losses::default());
        };
        let sums = 6 * RUN * view.tile_count() as usize;
        Ok(losses_of(view, *channels, &self.gpu.read(&t.ssim_sums, sums)?, &self.gpu.read(&t.sums, 4 * sums)?))
    }

    fn ceiling(&self) -> Result<f64> {
        let pass = Pass::new(&self.gpu, &shaders::CEILING, Channels::Both, false);
        let out = self.gpu.storage("the ceiling", 4 * 65_536)?;
        let mut best = 0.0f64;
        let mut rounds = 100;
        // The first run compiles the kernel; each later one is longer, until the launch no longer counts.
        for attempt in 0..6 {
            let job = Ceiling { invocations: 65_536, rounds, factor: 0.999, summand: 0.001 };
            let started = Instant::now();
            let mut r = Recorder::new(&self.gpu, 0);
            r.run(&pass, &job, &[&out], job.invocations / GROUP)?;
            r.submit();
            self.gpu.read::<f32>(&out, 1)?;
            let seconds = started.elapsed().as_secs_f64();
            if attempt > 0 {
                best = best.max(f64::from(rounds) * (65_536 * CHAINS * 4 * 2) as f64 / seconds);
            }
            if attempt > 0 && seconds < 0.05 {
                rounds *= 4;
            }
        }
        Ok(best)
    }

    fn memory(&self) -> Memory {
        let mut memory = Memory::default();
        if let Some(g) = &self.gaussians {
            for page in &g.pages {
                memory.state += bytes_of(&[&page.params, &page.moment1, &page.moment2]);
                memory.gaussians += page.gradients.size();
            }
            memory.gaussians += bytes_of(&[&g.stats, &g.splats, &g.footprints, &g.offsets, &g.touched, &g.first_pair]);
            memory.lists += g.sort.bytes();
        }
        memory.lists +=
            self.pairs.as_ref().map_or(0, |p| p.gaussians.size() + p.sort.bytes()) + self.slots.as_ref().map_or(0, Buffer::size);
        if let Some(f) = &self.frame {
            memory.frame += bytes_of(&[&f.ranges, &f.frame]) + f.tile_sort.bytes();
            memory.frame += f.training.as_ref().map_or(0, |t| bytes_of(&[&t.gradient, &t.rows, &t.partials, &t.ssim_sums, &t.sums]));
        }
        memory.views = self.targets.values().map(|t| t.1.size()).sum::<u64>() + self.cached.values().map(Lists::bytes).sum::<u64>();
        memory
    }

    fn set_profiling(&mut self, on: bool) -> bool {
        self.gpu.profile = if on { Profile::new(&self.gpu) } else { None };
        self.gpu.profile.is_some() == on
    }

    fn take_profile(&mut self) -> Result<BTreeMap<&'static str, f64>> {
        self.gpu.profile.as_ref().map_or_else(|| Ok(BTreeMap::new()), |p| p.take(&self.gpu))
    }
}
