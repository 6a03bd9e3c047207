//! Buffers with one item for each Gaussian.
//!
//! Trained values are stored in pages: the 48 SH coefficients of 700,000 Gaussians exceed 128 MiB,
//! the largest binding of some adapters.

use super::sorting::{Scan, Sort};
use crate::density::State;
use crate::engine::Memory;
use crate::view::stride;
use crate::{Gpu, Result};
use fastlgs_core::gaussians::channels as channels_of;
use wgpu::Buffer;

/// Trained values of as many Gaussians as one binding holds. Each buffer is `[channel][Gaussian of
/// the page]`.
pub struct Page {
    pub first: usize,
    pub n: usize,
    pub params: Buffer,
    pub moment1: Buffer,
    pub moment2: Buffer,
    pub gradients: Buffer,
}

/// All buffers of the Gaussians on the device.
pub struct Gaussians {
    pub n: usize,
    pub sh_degree: u32,
    pub pages: Vec<Page>,
    pub stats: Buffer,
    pub splats: Buffer,
    pub footprints: Buffer,
    pub offsets: Buffer,
    pub touched: Buffer,
    pub first_pair: Buffer,
    pub sort: Sort,
    pub scan: Scan,
}

impl Gaussians {
    /// Creates the buffers of `n` Gaussians.
    pub fn new(gpu: &Gpu, n: usize, sh_degree: u32) -> Result<Self> {
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
        Ok(Self {
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
            scan: Scan::new(gpu, "tile offsets", n as u32)?,
        })
    }

    /// Writes trained values and moments.
    pub fn write(&self, gpu: &Gpu, state: &State) {
        for page in &self.pages {
            for (buffer, all) in [
                (&page.params, &state.params),
                (&page.moment1, &state.moment1),
                (&page.moment2, &state.moment2),
            ] {
                gpu.queue.write_buffer(
                    buffer,
                    0,
                    bytemuck::cast_slice(&page_of(all, self.n, page.first, page.n)),
                );
            }
        }
    }

    /// Reads one buffer of all pages as `[channel][Gaussian]`.
    pub fn read(&self, gpu: &Gpu, what: impl Fn(&Page) -> &Buffer) -> Result<Vec<f32>> {
        let channels = channels_of(self.sh_degree);
        let mut out = vec![0.0; channels * self.n];
        for page in &self.pages {
            let stride = stride(page.n);
            let values: Vec<f32> = gpu.read(what(page), channels * stride)?;
            for c in 0..channels {
                out[c * self.n + page.first..][..page.n]
                    .copy_from_slice(&values[c * stride..][..page.n]);
            }
        }
        Ok(out)
    }

    /// Adds its bytes to `memory`.
    pub fn count(&self, memory: &mut Memory) {
        let bytes = |buffers: &[&Buffer]| buffers.iter().map(|b| b.size()).sum::<u64>();
        for page in &self.pages {
            memory.state += bytes(&[&page.params, &page.moment1, &page.moment2]);
            memory.gaussians += page.gradients.size();
        }
        memory.gaussians += bytes(&[
            &self.stats,
            &self.splats,
            &self.footprints,
            &self.offsets,
            &self.touched,
            &self.first_pair,
        ]);
        memory.lists += self.sort.bytes() + self.scan.bytes();
    }
}

/// Returns the Gaussians `first..first + n` of values `[channel][all]`, with the page's stride.
fn page_of(values: &[f32], all: usize, first: usize, n: usize) -> Vec<f32> {
    let padding = std::iter::repeat_n(0.0, stride(n) - n);
    values
        .chunks_exact(all)
        .flat_map(|channel| {
            channel[first..first + n]
                .iter()
                .copied()
                .chain(padding.clone())
        })
        .collect()
}
