//! The frame buffer, and the loss with its gradient.

use super::kernels::{GROUP, Training};
use crate::channels::Channels;
use crate::cpu::ROWS_PER_INVOCATION;
use crate::engine::{Losses, Memory, StepOptions, losses_from_sums, planes};
use crate::pass::{Groups, Recorder};
use crate::shader::shaders::{
    DepthGradientBuffers, LossGradientBuffers, SsimBackwardRowsBuffers, SsimColumnsBuffers,
    SsimRowsBuffers,
};
use crate::shape::Shape;
use crate::view::{DepthLoss, Planes, View};
use crate::{Gpu, Result};
use wgpu::Buffer;

/// Buffers with one item for each pixel.
pub struct Picture {
    size: [u32; 2],
    pub frame: Buffer,
}

impl Picture {
    /// Returns a frame buffer of the view's size; reuses `known` if its size is the same.
    pub fn reuse_or_create(known: Option<Self>, gpu: &Gpu, view: &View) -> Result<Self> {
        match known.filter(|p| p.size == view.size) {
            Some(picture) => Ok(picture),
            None => Ok(Self {
                size: view.size,
                frame: gpu.storage("the frame", 32 * view.padded_pixels() as u64)?,
            }),
        }
    }
}

/// Bytes that every adapter can bind at once.
const PORTABLE_BINDING_BYTES: u64 = 128 << 20;

/// Buffers of the loss.
pub struct Loss {
    size: [u32; 2],
    /// Number of planes that are processed at once.
    at_once: usize,
    pub gradient: Buffer,
    rows: Buffer,
    partials: Buffer,
    ssim_sums: Buffer,
    sums: Buffer,
}

impl Loss {
    /// Returns buffers for frames of the view's size with `planes` planes; reuses `known` if it
    /// fits.
    pub fn fitting(known: Option<Self>, gpu: &Gpu, view: &View, planes: usize) -> Result<Self> {
        let pixels = view.padded_pixels() as u64;
        // A hardware adapter processes all planes at once. The cache of a software adapter holds
        // one.
        let rows = 16 * pixels;
        let at_once = if gpu.shape == Shape::Wide {
            1
        } else {
            (PORTABLE_BINDING_BYTES.min(gpu.max_binding) / rows).clamp(1, 6)
        };
        // Divide the planes into batches of equal size.
        let at_once = (planes as u64).div_ceil((planes as u64).div_ceil(at_once));
        if let Some(loss) = known.filter(|l| l.size == view.size && l.at_once as u64 == at_once) {
            return Ok(loss);
        }
        let sums = 24 * u64::from(ROWS_PER_INVOCATION as u32 * view.tile_count());
        Ok(Self {
            size: view.size,
            at_once: at_once as usize,
            gradient: gpu.storage("the frame's gradient", 24 * pixels)?,
            rows: gpu.storage("SSIM rows", at_once * rows)?,
            partials: gpu.storage("SSIM partials", at_once * 12 * pixels)?,
            ssim_sums: gpu.storage("SSIM sums", sums)?,
            sums: gpu.storage("loss sums", 4 * sums)?,
        })
    }

    /// Records the loss of a frame against its target, and the gradient with respect to the frame.
    pub fn record(
        &self,
        passes: &Training,
        r: &mut Recorder,
        view: &View,
        options: &StepOptions,
        frame: &Buffer,
        targets: &Buffer,
    ) -> Result<()> {
        let Self {
            gradient,
            rows,
            partials,
            ssim_sums,
            sums,
            ..
        } = self;
        for batch in planes(view, options).chunks(self.at_once) {
            let (planes, plane) = (Planes::new(batch), batch[0]);
            let by_row = Groups {
                flat: (plane.quads / 2 * plane.rows).div_ceil(GROUP),
                z: planes.count,
            };
            let by_column = Groups {
                flat: (plane.rows / 8 * plane.quads).div_ceil(GROUP),
                z: planes.count,
            };
            r.run(
                &passes.ssim_rows,
                &planes,
                SsimRowsBuffers {
                    frame,
                    targets,
                    rows,
                },
                by_row,
            )?;
            r.run(
                &passes.ssim_columns,
                &planes,
                SsimColumnsBuffers {
                    rows,
                    partials,
                    sums: ssim_sums,
                },
                by_column,
            )?;
            r.run(
                &passes.ssim_backward_rows,
                &planes,
                SsimBackwardRowsBuffers { partials, rows },
                by_row,
            )?;
            r.run(
                &passes.loss_gradient,
                &planes,
                LossGradientBuffers {
                    frame,
                    targets,
                    rows,
                    gradient,
                    sums,
                },
                by_column,
            )?;
        }
        if options.depth_weight > 0.0 {
            let loss = DepthLoss::new(view, options.depth_weight);
            r.run(
                &passes.depth_gradient,
                &loss,
                DepthGradientBuffers {
                    frame,
                    targets,
                    gradient,
                },
                (loss.quads * loss.rows).div_ceil(GROUP),
            )?;
        }
        Ok(())
    }

    /// Reads the losses of the last recorded step.
    pub fn read(&self, gpu: &Gpu, view: &View, channels: Channels) -> Result<Losses> {
        let sums = 6 * ROWS_PER_INVOCATION * view.tile_count() as usize;
        Ok(losses_from_sums(
            view,
            channels,
            &gpu.read(&self.ssim_sums, sums)?,
            &gpu.read(&self.sums, 4 * sums)?,
        ))
    }

    /// Adds its bytes to `memory`.
    pub fn count(&self, memory: &mut Memory) {
        let own = [
            &self.gradient,
            &self.rows,
            &self.partials,
            &self.ssim_sums,
            &self.sums,
        ];
        memory.frame += own.iter().map(|b| b.size()).sum::<u64>();
    }
}

impl Picture {
    /// Adds its bytes to `memory`.
    pub fn count(&self, memory: &mut Memory) {
        memory.frame += self.frame.size();
    }
}
