//! The engine on a wgpu device.

mod backward;
mod kernels;
mod lists;
mod pages;
mod picture;
mod sorting;
mod votes;

use crate::channels::Channels;
use crate::density::State;
use crate::engine::{
    Engine, ExposedPhoto, Frame, Losses, Memory, StepOptions, TargetImage, check_ids,
    check_saliency, no_depth, planes,
};
use crate::lift::{Vote, check_labels};
use crate::pass::Recorder;
use crate::profile::Profile;
use crate::shader::shaders::{BlendBuffers, BlendIdsBuffers};
use crate::view::{Step, View};
use crate::{Error, Gpu, Result};
use backward::{Slots, adam};
use fastlgs_core::id_weights::IDS_PER_PIXEL;
use fastlgs_core::{IdWeights, LabelMap};
use kernels::{Kernels, kind};
use lists::{ListBuilder, Lists};
use pages::Gaussians;
use picture::{Loss, Picture};
use std::collections::{BTreeMap, HashMap};
use wgpu::Buffer;

/// A target image on the device.
struct DeviceTarget {
    size: [u32; 2],
    has_depth: bool,
    planes: Buffer,
}

/// [`Engine`] on a wgpu adapter.
pub struct GpuEngine {
    pub(crate) gpu: Gpu,
    kernels: Kernels,
    lists: ListBuilder,
    gaussians: Option<Gaussians>,
    picture: Option<Picture>,
    /// Created on the first step.
    loss: Option<Loss>,
    slots: Slots,
    targets: HashMap<usize, DeviceTarget>,
    last: Option<(View, Channels)>,
    /// Number of passes at the start of every frame that run as their CPU twins, to find a faulty
    /// pass. The environment variable `FASTLGS_PASSES_ON_CPU` sets it.
    pub passes_on_cpu: usize,
}

impl GpuEngine {
    /// Compiles the passes. Those that depend on the kind of frame are compiled when they are first
    /// needed.
    pub fn new(gpu: Gpu) -> Self {
        Self {
            kernels: Kernels::new(&gpu),
            lists: ListBuilder::default(),
            gpu,
            gaussians: None,
            picture: None,
            loss: None,
            slots: Slots::default(),
            targets: HashMap::new(),
            last: None,
            passes_on_cpu: std::env::var("FASTLGS_PASSES_ON_CPU")
                .ok()
                .and_then(|k| k.parse().ok())
                .unwrap_or(0),
        }
    }

    /// Compiles what a frame needs and builds its tile lists. With `frozen`, the lists of that view
    /// are cached.
    fn prepare(
        &mut self,
        view: View,
        channels: Channels,
        frozen: Option<usize>,
        on_cpu: &mut usize,
    ) -> Result<Lists> {
        let held = self.len();
        let kind = kind(&view, channels);
        let Some(g) = self
            .gaussians
            .as_ref()
            .filter(|g| g.n == view.gaussians as usize && g.n > 0)
        else {
            return Err(Error::Invalid(format!(
                "the view has {} Gaussians, but the engine holds {held}; both must be equal and more than 0",
                view.gaussians
            )));
        };
        self.kernels.prepare(&self.gpu, kind);
        self.picture = Some(Picture::reuse_or_create(
            self.picture.take(),
            &self.gpu,
            &view,
        )?);
        match frozen {
            Some(id) => self
                .lists
                .frozen(&self.gpu, &self.kernels, g, view, kind, id, on_cpu),
            None => self
                .lists
                .lists(&self.gpu, &self.kernels, g, view, kind, on_cpu),
        }
    }

    /// Runs all passes up to blending into the frame buffer.
    fn forward(
        &mut self,
        view: View,
        channels: Channels,
        frozen: Option<usize>,
        on_cpu: &mut usize,
    ) -> Result<Lists> {
        let lists = self.prepare(view, channels, frozen, on_cpu)?;
        let (splats, frame) = (&self.gaussians().splats, &self.picture().frame);
        let mut r = Recorder::new(&self.gpu, *on_cpu);
        let Lists {
            ranges,
            tile_order,
            sorted_pairs,
            pair_gaussians,
            ..
        } = &lists;
        let buffers = BlendBuffers {
            ranges,
            tile_order,
            sorted_pairs,
            pair_gaussians,
            splats,
            frame,
        };
        let view = View {
            pairs: lists.view.pairs,
            ..view
        };
        r.run(
            &self.kernels.blending(kind(&view, channels)).blend,
            &view,
            buffers,
            self.gpu.shape.groups(view.tile_count()),
        )?;
        *on_cpu = r.submit();
        Ok(Lists { view, ..lists })
    }

    /// Returns the Gaussians; needs [`Self::prepare`] first.
    fn gaussians(&self) -> &Gaussians {
        self.gaussians
            .as_ref()
            .expect("checked when the frame was prepared")
    }

    /// Returns the frame buffer; needs [`Self::prepare`] first.
    fn picture(&self) -> &Picture {
        self.picture
            .as_ref()
            .expect("made when the frame was prepared")
    }

    /// Reads the channels of the frame that was blended last.
    fn read_frame(&self, view: &View, channels: Channels) -> Result<Frame> {
        let plane = view.padded_pixels();
        self.gpu
            .read_with(&self.picture().frame, 8 * plane, |planes: &[f32]| {
                Frame::gathered(view, channels, |channel, y| {
                    &planes[channel * plane + view.index_of(0, y)..]
                })
            })
    }

    fn read_pages(&self, what: impl Fn(&pages::Page) -> &Buffer) -> Result<Vec<f32>> {
        self.gaussians
            .as_ref()
            .map_or_else(|| Ok(Vec::new()), |g| g.read(&self.gpu, what))
    }
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
        self.lists.clear_cache();
        // Free the old buffers before new ones are created.
        let known = self
            .gaussians
            .take()
            .filter(|g| (g.n, g.sh_degree) == (n, sh_degree));
        let g = match known {
            Some(g) => g,
            None => Gaussians::new(&self.gpu, n, sh_degree)?,
        };
        g.write(&self.gpu, state);
        let mut r = Recorder::new(&self.gpu, 0);
        r.clear(&g.stats);
        // Gradients of untrained channels stay zero.
        g.pages.iter().for_each(|page| r.clear(&page.gradients));
        r.submit();
        self.gaussians = Some(g);
        Ok(())
    }

    fn state(&self) -> Result<State> {
        let sh_degree = self.gaussians.as_ref().map_or(0, |g| g.sh_degree);
        let params = self.read_pages(|p| &p.params)?;
        Ok(State {
            sh_degree,
            params,
            moment1: self.read_pages(|p| &p.moment1)?,
            moment2: self.read_pages(|p| &p.moment2)?,
        })
    }

    fn stats(&self) -> Result<Vec<f32>> {
        self.gaussians
            .as_ref()
            .map_or(Ok(Vec::new()), |g| self.gpu.read(&g.stats, 2 * g.n))
    }

    fn set_stats(&mut self, stats: &[f32]) -> Result<()> {
        if let Some(g) = &self.gaussians {
            self.gpu
                .queue
                .write_buffer(&g.stats, 0, bytemuck::cast_slice(stats));
        }
        Ok(())
    }

    fn gradients(&self) -> Result<Vec<f32>> {
        self.read_pages(|p| &p.gradients)
    }

    fn set_target(&mut self, id: usize, target: TargetImage) -> Result<()> {
        let camera_less = View {
            size: target.size,
            tiles: target.size.map(|s| s.div_ceil(crate::view::TILE)),
            ..bytemuck::Zeroable::zeroed()
        };
        let planes = self
            .gpu
            .storage_with("a target image", &target.padded(&camera_less))?;
        let target = DeviceTarget {
            size: target.size,
            has_depth: !target.depth.is_empty(),
            planes,
        };
        self.targets.insert(id, target);
        self.lists.forget_view(id);
        Ok(())
    }

    fn remove_target(&mut self, id: usize) {
        self.targets.remove(&id);
        self.lists.forget_view(id);
    }

    fn render(&mut self, view: View, channels: Channels) -> Result<Frame> {
        let mut on_cpu = self.passes_on_cpu;
        let view = self.forward(view, channels, None, &mut on_cpu)?.view;
        self.read_frame(&view, channels)
    }

    fn render_ids(&mut self, view: View, ids: &[u16]) -> Result<IdWeights> {
        check_ids(&view, ids, self.len())?;
        let mut on_cpu = self.passes_on_cpu;
        let lists = self.prepare(view, Channels::Feature, None, &mut on_cpu)?;
        let words: Vec<u32> = ids.iter().map(|id| u32::from(*id)).collect();
        let ids = &self.gpu.storage_with("object ids", &words)?;
        // The frame has eight words a pixel; the id weights need four.
        let (splats, shares) = (&self.gaussians().splats, &self.picture().frame);
        let mut r = Recorder::new(&self.gpu, on_cpu);
        let Lists {
            ranges,
            sorted_pairs,
            pair_gaussians,
            ..
        } = &lists;
        let buffers = BlendIdsBuffers {
            ranges,
            sorted_pairs,
            pair_gaussians,
            splats,
            ids,
            shares,
        };
        r.run(
            &self.kernels.blend_ids,
            &lists.view,
            buffers,
            view.tile_count().div_ceil(8),
        )?;
        r.submit();
        let [width, height] = view.size;
        let plane = view.padded_pixels();
        let gather = |slots: &[u32]| {
            let pixel = |(x, y)| std::array::from_fn(|k| slots[k * plane + view.index_of(x, y)]);
            (0..height)
                .flat_map(|y| (0..width).map(move |x| (x, y)))
                .map(pixel)
                .collect()
        };
        Ok(IdWeights {
            width,
            height,
            pixels: self.gpu.read_with(shares, IDS_PER_PIXEL * plane, gather)?,
        })
    }

    fn votes(&mut self, view: View, labels: &LabelMap) -> Result<Vec<Vote>> {
        check_labels(&view, labels)?;
        self.votes_on_device(
            View {
                sh_degree: 0,
                ..view
            },
            labels,
        )
    }

    fn saliency(
        &mut self,
        view: View,
        photo: Option<&ExposedPhoto>,
        scores: &mut [f32],
    ) -> Result<f64> {
        check_saliency(&view, photo, scores)?;
        self.saliency_on_device(view, photo, scores)
    }

    fn step(&mut self, view: View, id: usize, options: &StepOptions, step: &Step) -> Result<()> {
        let channels = options.channels;
        let mut on_cpu = self.passes_on_cpu;
        let frozen = (channels == Channels::Feature).then_some(id);
        // Cached lists contain all Gaussians, so none is dropped.
        let view = if frozen.is_some() {
            view.with_dropout(0.0, 0)
        } else {
            view
        };
        let lists = self.forward(view, channels, frozen, &mut on_cpu)?;
        let view = lists.view;
        self.loss = Some(Loss::fitting(
            self.loss.take(),
            &self.gpu,
            &view,
            planes(&view, options).len(),
        )?);
        let target = self.targets.get(&id).filter(|t| t.size == view.size);
        let target = target.ok_or_else(|| {
            Error::Invalid(format!(
                "view {id} has no target image of {}x{} pixels",
                view.size[0], view.size[1]
            ))
        })?;
        if options.depth_weight > 0.0 && !target.has_depth {
            return Err(no_depth());
        }
        let (Some(g), Some(picture), Some(loss)) = (&self.gaussians, &self.picture, &self.loss)
        else {
            unreachable!("prepared above")
        };
        let mut r = Recorder::new(&self.gpu, on_cpu);
        loss.record(
            &self.kernels.training,
            &mut r,
            &view,
            options,
            &picture.frame,
            &target.planes,
        )?;
        let blending = self.kernels.blending(kind(&view, channels));
        self.slots.record(
            &self.gpu,
            blending,
            &mut r,
            channels,
            &lists,
            g,
            &picture.frame,
            &loss.gradient,
        )?;
        adam(&self.kernels.training, &mut r, g, step)?;
        r.submit();
        self.last = Some((view, channels));
        Ok(())
    }

    fn losses(&self) -> Result<Losses> {
        match (&self.last, &self.loss) {
            (Some((view, channels)), Some(loss)) => loss.read(&self.gpu, view, *channels),
            _ => Ok(Losses::default()),
        }
    }

    fn memory(&self) -> Memory {
        let mut memory = Memory::default();
        self.gaussians.iter().for_each(|g| g.count(&mut memory));
        self.picture.iter().for_each(|p| p.count(&mut memory));
        self.loss.iter().for_each(|l| l.count(&mut memory));
        self.lists.count(&mut memory);
        memory.lists += self.slots.bytes();
        memory.views += self.targets.values().map(|t| t.planes.size()).sum::<u64>();
        memory
    }

    fn set_profiling(&mut self, on: bool) -> bool {
        self.gpu.profile = if on { Profile::new(&self.gpu) } else { None };
        self.gpu.profile.is_some() == on
    }

    fn take_profile(&mut self) -> Result<BTreeMap<&'static str, f64>> {
        self.gpu
            .profile
            .as_ref()
            .map_or_else(|| Ok(BTreeMap::new()), |p| p.take(&self.gpu))
    }
}
