//! The frame, and on it the loss with its gradient.

use super::kernels::{GROUP, Training};
use crate::channels::Channels;
use crate::cpu::RUN;
use crate::engine::{Losses, Memory, StepOptions, losses_of, planes};
use crate::pass::Recorder;
use crate::shader::shaders::{LossGradientBuffers, SsimBackwardRowsBuffers, SsimColumnsBuffers, SsimRowsBuffers};
use crate::view::View;
use crate::{Gpu, Result};
use wgpu::Buffer;

/// Buffers with one item a pixel.
pub struct Picture {
    size: [u32; 2],
    pub frame: Buffer,
}

impl Picture {
    /// A frame of the view's size: `known`, if it is.
    pub fn fitting(known: Option<Self>, gpu: &Gpu, view: &View) -> Result<Self> {
        match known.filter(|p| p.size == view.size) {
            Some(picture) => Ok(picture),
            None => Ok(Self { size: view.size, frame: gpu.storage("the frame", 32 * view.padded_pixels() as u64)? }),
        }
    }
}

/// Buffers of the loss.
pub struct Loss {
    size: [u32; 2],
    pub gradient: Buffer,
    rows: Buffer,
    partials: Buffer,
    ssim_sums: Buffer,
    sums: Buffer,
}

impl Loss {
    /// Buffers for frames of the view's size: `known`, if they are.
    pub fn fitting(known: Option<Self>, gpu: &Gpu, view: &View) -> Result<Self> {
        if let Some(loss) = known.filter(|l| l.size == view.size) {
            return Ok(loss);
        }
        let pixels = view.padded_pixels() as u64;
        let sums = 24 * u64::from(RUN as u32 * view.tile_count());
        Ok(Self {
            size: view.size,
            gradient: gpu.storage("the frame's gradient", 24 * pixels)?,
            rows: gpu.storage("SSIM rows", 20 * pixels)?,
            partials: gpu.storage("SSIM partials", 12 * pixels)?,
            ssim_sums: gpu.storage("SSIM sums", sums)?,
            sums: gpu.storage("loss sums", 4 * sums)?,
        })
    }

    /// The loss of a frame against its target, and the gradient by the frame.
    pub fn record(
        &self,
        passes: &Training,
        r: &mut Recorder,
        view: &View,
        options: &StepOptions,
        frame: &Buffer,
        targets: &Buffer,
    ) -> Result<()> {
        let Self { gradient, rows, partials, ssim_sums, sums, .. } = self;
        for plane in planes(view, options) {
            let row_groups = (plane.quads / 2 * plane.rows).div_ceil(GROUP);
            let column_groups = (plane.rows / 8 * plane.quads).div_ceil(GROUP);
            r.run(&passes.ssim_rows, &plane, SsimRowsBuffers { frame, targets, rows }, row_groups)?;
            r.run(&passes.ssim_columns, &plane, SsimColumnsBuffers { rows, partials, sums: ssim_sums }, column_groups)?;
            r.run(&passes.ssim_backward_rows, &plane, SsimBackwardRowsBuffers { partials, rows }, row_groups)?;
            r.run(&passes.loss_gradient, &plane, LossGradientBuffers { frame, targets, rows, gradient, sums }, column_groups)?;
        }
        Ok(())
    }

    /// What the last recorded loss was.
    pub fn read(&self, gpu: &Gpu, view: &View, channels: Channels) -> Result<Losses> {
        let sums = 6 * RUN * view.tile_count() as usize;
        Ok(losses_of(view, channels, &gpu.read(&self.ssim_sums, sums)?, &gpu.read(&self.sums, 4 * sums)?))
    }

    /// Adds what it takes.
    pub fn count(&self, memory: &mut Memory) {
        let own = [&self.gradient, &self.rows, &self.partials, &self.ssim_sums, &self.sums];
        memory.frame += own.iter().map(|b| b.size()).sum::<u64>();
    }
}

impl Picture {
    /// Adds what it takes.
    pub fn count(&self, memory: &mut Memory) {
        memory.frame += self.frame.size();
    }
}
