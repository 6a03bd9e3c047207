//! The passes on a wgpu device.

use crate::cpu::{CHUNKS, RUN};
use crate::engine::{Engine, Frame, Losses, StepOptions, losses_of, planes, tile_bits};
use crate::pass::{Pass, shaders};
use crate::profile::Profile;
use crate::view::{Job, Step, View};
use crate::{Error, Gpu, Result};
use fastlgs_core::gaussians::CHANNELS;
use std::collections::{BTreeMap, HashMap};
use wgpu::{Buffer, CommandEncoder};

/// Workgroup size of the kernels that run over Gaussians, pairs or pixels.
const GROUP: u32 = 64;

struct Passes {
    project: Pass,
    radix_count: Pass,
    radix_scatter: Pass,
    scan_chunks: Pass,
    scan_apply: Pass,
    gather_counts: Pass,
    emit: Pass,
    tile_ranges: Pass,
    blend: Pass,
    ssim_rows: Pass,
    ssim_columns: Pass,
    ssim_backward_rows: Pass,
    loss_gradient: Pass,
    blend_backward: Pass,
    project_backward: Pass,
    adam: Pass,
}

/// Buffers with one item a Gaussian.
struct PerGaussian {
    n: usize,
    params: Buffer,
    moment1: Buffer,
    moment2: Buffer,
    gradients: Buffer,
    stats: Buffer,
    splats: Buffer,
    footprints: Buffer,
    touched: Buffer,
    offsets: Buffer,
    first_pair: Buffer,
    sort: Sort,
}

/// Buffers with one item a pixel or tile; training ones are made on the first step.
struct PerFrame {
    size: [u32; 2],
    ranges: Buffer,
    frame: Buffer,
    training: Option<Training>,
}

struct Training {
    gradient: Buffer,
    rows: Buffer,
    partials: Buffer,
    ssim_sums: Buffer,
    l1_sums: Buffer,
}

/// Buffers with one item a (tile, Gaussian) pair.
struct PerPair {
    capacity: usize,
    gaussians: Buffer,
    sort: Sort,
    slots: Option<Buffer>,
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
}

/// [`Engine`] on a wgpu adapter.
pub struct GpuEngine {
    gpu: Gpu,
    passes: Passes,
    histogram: Buffer,
    totals: Buffer,
    gaussians: Option<PerGaussian>,
    frame: Option<PerFrame>,
    pairs: Option<PerPair>,
    targets: HashMap<usize, (usize, Buffer)>,
    last: Option<View>,
}

impl GpuEngine {
    /// Compiles all passes.
    pub fn new(gpu: Gpu) -> Self {
        let pass = |shader| Pass::new(&gpu, shader);
        let passes = Passes {
            project: pass(&shaders::PROJECT),
            radix_count: pass(&shaders::RADIX_COUNT),
            radix_scatter: pass(&shaders::RADIX_SCATTER),
            scan_chunks: pass(&shaders::SCAN_CHUNKS),
            scan_apply: pass(&shaders::SCAN_APPLY),
            gather_counts: pass(&shaders::GATHER_COUNTS),
            emit: pass(&shaders::EMIT),
            tile_ranges: pass(&shaders::TILE_RANGES),
            blend: pass(&shaders::BLEND),
            ssim_rows: pass(&shaders::SSIM_ROWS),
            ssim_columns: pass(&shaders::SSIM_COLUMNS),
            ssim_backward_rows: pass(&shaders::SSIM_BACKWARD_ROWS),
            loss_gradient: pass(&shaders::LOSS_GRADIENT),
            blend_backward: pass(&shaders::BLEND_BACKWARD),
            project_backward: pass(&shaders::PROJECT_BACKWARD),
            adam: pass(&shaders::ADAM),
        };
        let small = |words: usize| gpu.storage("sort", 4 * words as u64).expect("a megabyte fits every adapter");
        let (histogram, totals) = (small(256 * CHUNKS), small(CHUNKS + 1));
        Self { gpu, passes, histogram, totals, gaussians: None, frame: None, pairs: None, targets: HashMap::new(), last: None }
    }

    /// Exclusive prefix sums of `items` in place; the total goes to `totals[CHUNKS]`.
    fn scan(&self, encoder: &mut CommandEncoder, items: &Buffer, n: u32) {
        let job = self.gpu.uniform(&Job { n, shift: 0, first: 0, unused: 0 });
        let groups = CHUNKS as u32 / GROUP;
        self.passes.scan_chunks.record(&self.gpu, encoder, &[&job, items, &self.totals], groups);
        self.passes.scan_apply.record(&self.gpu, encoder, &[&job, items, &self.totals], groups);
    }

    /// Sorts by the lowest `bits`; returns the side that holds the result. Values come out as former places.
    fn radix_sort(&self, encoder: &mut CommandEncoder, sort: &Sort, n: u32, bits: u32) -> usize {
        let mut side = 0;
        let groups = CHUNKS as u32 / GROUP;
        for (round, shift) in (0..bits).step_by(8).enumerate() {
            let job = self.gpu.uniform(&Job { n, shift, first: u32::from(round == 0), unused: 0 });
            self.passes.radix_count.record(&self.gpu, encoder, &[&job, &sort.keys[side], &self.histogram], groups);
            self.scan(encoder, &self.histogram, 256 * CHUNKS as u32);
            let (from, to) = (side, 1 - side);
            let buffers = [&job, &sort.keys[from], &sort.values[from], &self.histogram, &sort.keys[to], &sort.values[to]];
            self.passes.radix_scatter.record(&self.gpu, encoder, &buffers, groups);
            side = to;
        }
        side
    }

    fn prepare_frame(&mut self, view: &View, training: bool) -> Result<()> {
        let pixels = view.pixels() as u64;
        if self.frame.as_ref().is_none_or(|f| f.size != view.size) {
            self.frame = Some(PerFrame {
                size: view.size,
                ranges: self.gpu.storage("tile ranges", 8 * u64::from(view.tile_count()))?,
                frame: self.gpu.storage("the frame", 32 * pixels)?,
                training: None,
            });
        }
        let frame = self.frame.as_mut().expect("made above");
        if training && frame.training.is_none() {
            let sums = 24 * u64::from(view.size[1].div_ceil(RUN as u32) * view.size[0]);
            frame.training = Some(Training {
                gradient: self.gpu.storage("the frame's gradient", 24 * pixels)?,
                rows: self.gpu.storage("SSIM rows", 20 * pixels)?,
                partials: self.gpu.storage("SSIM partials", 12 * pixels)?,
                ssim_sums: self.gpu.storage("SSIM sums", sums)?,
                l1_sums: self.gpu.storage("L1 sums", sums)?,
            });
        }
        Ok(())
    }

    /// Room for `pairs` pairs, with a quarter to spare so that growth is rare.
    fn prepare_pairs(&mut self, pairs: usize, training: bool) -> Result<()> {
        if self.pairs.as_ref().is_none_or(|p| p.capacity < pairs) {
            let capacity = pairs + pairs / 4 + 1024;
            let sort = Sort::new(&self.gpu, "the tile list", capacity)?;
            self.pairs = Some(PerPair { capacity, gaussians: self.gpu.storage("the tile list", 4 * capacity as u64)?, sort, slots: None });
        }
        let list = self.pairs.as_mut().expect("made above");
        if training && list.slots.is_none() {
            // The spare quarter is given up where the binding limit would not allow it.
            let most = (self.gpu.max_binding / 48) as usize;
            let capacity = list.capacity.min(most.max(pairs));
            list.slots = Some(self.gpu.storage("gradient slots of the tile list", 48 * capacity as u64)?);
            list.capacity = capacity;
        }
        Ok(())
    }

    /// Projection, sorting and blending into the frame buffer; returns the view with its pair count.
    fn forward(&mut self, mut view: View, training: bool) -> Result<View> {
        let n = self.len();
        if view.gaussians as usize != n || n == 0 {
            return Err(Error::Invalid(format!("the view was made for {} Gaussians, the device holds {n}", view.gaussians)));
        }
        self.prepare_frame(&view, training)?;
        let g = self.gaussians.as_ref().expect("n > 0");
        let groups = (n as u32).div_ceil(GROUP);
        let uniform = self.gpu.uniform(&view);
        let mut encoder = self.gpu.encoder();
        let e = &mut encoder;
        self.passes.project.record(&self.gpu, e, &[&uniform, &g.params, &g.splats, &g.sort.keys[0], &g.footprints, &g.touched], groups);
        let side = self.radix_sort(e, &g.sort, n as u32, 24);
        let order = &g.sort.values[side];
        self.passes.gather_counts.record(&self.gpu, e, &[&uniform, order, &g.touched, &g.offsets], groups);
        self.scan(e, &g.offsets, n as u32);
        self.gpu.submit(encoder);
        view.pairs = self.gpu.read::<u32>(&self.totals, CHUNKS + 1)?[CHUNKS];

        self.prepare_pairs(view.pairs as usize, training)?;
        let g = self.gaussians.as_ref().expect("n > 0");
        let (list, frame) = (self.pairs.as_ref().expect("prepared"), self.frame.as_ref().expect("prepared"));
        let order = &g.sort.values[side];
        let uniform = self.gpu.uniform(&view);
        let mut encoder = self.gpu.encoder();
        let e = &mut encoder;
        let buffers = [&uniform, order, &g.offsets, &g.footprints, &g.touched, &list.sort.keys[0], &list.gaussians, &g.first_pair];
        self.passes.emit.record(&self.gpu, e, &buffers, groups);
        let side = self.radix_sort(e, &list.sort, view.pairs, tile_bits(&view));
        e.clear_buffer(&frame.ranges, 0, None);
        self.passes.tile_ranges.record(&self.gpu, e, &[&uniform, &list.sort.keys[side], &frame.ranges], view.pairs.div_ceil(GROUP));
        let buffers = [&uniform, &frame.ranges, &list.sort.values[side], &list.gaussians, &g.splats, &frame.frame];
        self.passes.blend.record(&self.gpu, e, &buffers, self.gpu.shape.groups(view.tile_count()));
        self.gpu.submit(encoder);
        Ok(view)
    }
}

impl Engine for GpuEngine {
    fn name(&self) -> String {
        self.gpu.name.clone()
    }

    fn len(&self) -> usize {
        self.gaussians.as_ref().map_or(0, |g| g.n)
    }

    fn set_state(&mut self, params: &[f32], moment1: &[f32], moment2: &[f32]) -> Result<()> {
        let n = params.len() / CHANNELS;
        let gpu = &self.gpu;
        let storage = |what: &str, words: usize| gpu.storage(what, 4 * words as u64);
        if self.gaussians.as_ref().is_none_or(|g| g.n != n) {
            self.gaussians = Some(PerGaussian {
                n,
                params: storage("the Gaussians", CHANNELS * n)?,
                moment1: storage("Adam's first moment", CHANNELS * n)?,
                moment2: storage("Adam's second moment", CHANNELS * n)?,
                gradients: storage("the gradients", CHANNELS * n)?,
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
        for (buffer, data) in [(&g.params, params), (&g.moment1, moment1), (&g.moment2, moment2)] {
            gpu.queue.write_buffer(buffer, 0, bytemuck::cast_slice(data));
        }
        let mut encoder = gpu.encoder();
        encoder.clear_buffer(&g.stats, 0, None);
        gpu.submit(encoder);
        Ok(())
    }

    fn params(&self) -> Result<Vec<f32>> {
        self.gaussians.as_ref().map_or(Ok(Vec::new()), |g| self.gpu.read(&g.params, CHANNELS * g.n))
    }

    fn moments(&self) -> Result<(Vec<f32>, Vec<f32>)> {
        let Some(g) = &self.gaussians else { return Ok(Default::default()) };
        Ok((self.gpu.read(&g.moment1, CHANNELS * g.n)?, self.gpu.read(&g.moment2, CHANNELS * g.n)?))
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
        self.gaussians.as_ref().map_or(Ok(Vec::new()), |g| self.gpu.read(&g.gradients, CHANNELS * g.n))
    }

    fn set_target(&mut self, id: usize, target: &[f32]) -> Result<()> {
        self.targets.insert(id, (target.len(), self.gpu.storage_with("a target picture", target)?));
        Ok(())
    }

    fn render(&mut self, view: View) -> Result<Frame> {
        let view = self.forward(view, false)?;
        let frame = self.frame.as_ref().expect("made by forward");
        let data = self.gpu.read(&frame.frame, 8 * view.pixels())?;
        Ok(Frame { width: view.size[0], height: view.size[1], data, pairs: view.pairs })
    }

    fn step(&mut self, view: View, id: usize, options: StepOptions, step: &Step) -> Result<()> {
        let view = self.forward(view, true)?;
        let target = self.targets.get(&id).filter(|t| t.0 == 6 * view.pixels()).map(|t| &t.1);
        let target = target.ok_or_else(|| Error::Invalid(format!("no target {id} of {}x{}", view.size[0], view.size[1])))?;
        let (g, list) = (self.gaussians.as_ref().expect("made"), self.pairs.as_ref().expect("made"));
        let frame = self.frame.as_ref().expect("made");
        let t = frame.training.as_ref().expect("made");
        let slots = list.slots.as_ref().expect("made");
        let mut encoder = self.gpu.encoder();
        let e = &mut encoder;
        let [width, height] = view.size;
        let row_groups = (width.div_ceil(RUN as u32) * height).div_ceil(GROUP);
        let column_groups = (height.div_ceil(RUN as u32) * width).div_ceil(GROUP);
        if options.feature_weight == 0.0 {
            e.clear_buffer(&t.gradient, 0, None);
        }
        for plane in planes(&view, &options) {
            let plane = self.gpu.uniform(&plane);
            self.passes.ssim_rows.record(&self.gpu, e, &[&plane, &frame.frame, target, &t.rows], row_groups);
            self.passes.ssim_columns.record(&self.gpu, e, &[&plane, &t.rows, &t.partials, &t.ssim_sums], column_groups);
            self.passes.ssim_backward_rows.record(&self.gpu, e, &[&plane, &t.partials, &t.rows], row_groups);
            let buffers = [&plane, &frame.frame, target, &t.rows, &t.gradient, &t.l1_sums];
            self.passes.loss_gradient.record(&self.gpu, e, &buffers, column_groups);
        }
        let uniform = self.gpu.uniform(&view);
        // The tile sort ends on the side given by its number of rounds.
        let side = tile_bits(&view).div_ceil(8) as usize % 2;
        let sorted = &list.sort.values[side];
        let buffers = [&uniform, &frame.ranges, sorted, &list.gaussians, &g.splats, &frame.frame, &t.gradient, slots];
        self.passes.blend_backward.record(&self.gpu, e, &buffers, self.gpu.shape.groups(view.tile_count()));
        let buffers = [&uniform, &g.params, &g.splats, &g.touched, &g.first_pair, slots, &g.gradients, &g.stats];
        self.passes.project_backward.record(&self.gpu, e, &buffers, (g.n as u32).div_ceil(GROUP));
        let step = self.gpu.uniform(step);
        let buffers = [&step, &g.gradients, &g.params, &g.moment1, &g.moment2];
        self.passes.adam.record(&self.gpu, e, &buffers, ((CHANNELS * g.n) as u32).div_ceil(GROUP));
        self.gpu.submit(encoder);
        self.last = Some(view);
        Ok(())
    }

    fn losses(&self) -> Result<Losses> {
        let (Some(view), Some(t)) = (&self.last, self.frame.as_ref().and_then(|f| f.training.as_ref())) else {
            return Ok(Losses::default());
        };
        let sums = 6 * (view.size[1].div_ceil(RUN as u32) * view.size[0]) as usize;
        Ok(losses_of(view, &self.gpu.read(&t.ssim_sums, sums)?, &self.gpu.read(&t.l1_sums, sums)?))
    }

    fn set_profiling(&mut self, on: bool) -> bool {
        self.gpu.profile = if on { Profile::new(&self.gpu) } else { None };
        self.gpu.profile.is_some() == on
    }

    fn take_profile(&mut self) -> Result<BTreeMap<&'static str, f64>> {
        self.gpu.profile.as_ref().map_or_else(|| Ok(BTreeMap::new()), |p| p.take(&self.gpu))
    }
}
