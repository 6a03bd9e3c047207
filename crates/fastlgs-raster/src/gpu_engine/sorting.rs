//! Prefix sums and stable radix sorts over chunks of items.

use super::kernels::Sorting;
use crate::pass::Recorder;
use crate::shader::shaders::{
    RadixCountBuffers, RadixScatterBuffers, ScanApplyBuffers, ScanChunksBuffers,
};
use crate::view::ChunkJob;
use crate::{Gpu, Result};
use wgpu::Buffer;

/// Number of values of an 8-bit digit.
const DIGITS: u32 = 256;

/// Double buffers of a radix sort, and its histogram `[digit][chunk]`. The caller writes the keys
/// to `keys[0]`.
pub struct Sort {
    pub keys: [Buffer; 2],
    pub values: [Buffer; 2],
    histogram: Buffer,
    scan: Scan,
}

impl Sort {
    /// Creates the buffers for `n` keys.
    pub fn new(gpu: &Gpu, what: &str, n: usize) -> Result<Self> {
        let make = || gpu.storage(what, 4 * n as u64);
        let places = DIGITS * gpu.shape.chunks(n as u32).0;
        let histogram = gpu.storage(what, 4 * u64::from(places))?;
        Ok(Self {
            keys: [make()?, make()?],
            values: [make()?, make()?],
            histogram,
            scan: Scan::new(gpu, what, places)?,
        })
    }

    /// Returns the size of the buffers in bytes.
    pub fn bytes(&self) -> u64 {
        let lists: u64 = self.keys.iter().chain(&self.values).map(Buffer::size).sum();
        lists + self.histogram.size() + self.scan.bytes()
    }

    /// Sorts the first `n` keys by their lowest `bits`. Returns the index of the buffers that hold
    /// the result. The values are the previous positions of the keys.
    pub fn record(
        &self,
        gpu: &Gpu,
        passes: &Sorting,
        r: &mut Recorder,
        n: u32,
        bits: u32,
    ) -> Result<usize> {
        let mut current = 0;
        let histogram = &self.histogram;
        let (chunks, groups) = gpu.shape.chunks(n);
        for (round, shift) in (0..bits).step_by(8).enumerate() {
            let job = ChunkJob {
                n,
                shift,
                first: u32::from(round == 0),
                chunks,
            };
            let (keys, values) = (&self.keys[current], &self.values[current]);
            r.run(
                &passes.radix_count,
                &job,
                RadixCountBuffers { keys, histogram },
                groups,
            )?;
            self.scan
                .record(gpu, passes, r, histogram, DIGITS * chunks)?;
            current = 1 - current;
            let (keys_out, values_out) = (&self.keys[current], &self.values[current]);
            r.run(
                &passes.radix_scatter,
                &job,
                RadixScatterBuffers {
                    keys,
                    values,
                    histogram,
                    keys_out,
                    values_out,
                },
                groups,
            )?;
        }
        Ok(current)
    }
}

/// Buffer of an exclusive prefix sum: the totals of its chunks, then the total of all items.
pub struct Scan {
    totals: Buffer,
}

impl Scan {
    /// Creates the buffer for at most `n` items.
    pub fn new(gpu: &Gpu, what: &str, n: u32) -> Result<Self> {
        Ok(Self {
            totals: gpu.storage(what, 4 * (u64::from(gpu.shape.chunks(n).0) + 1))?,
        })
    }

    /// Returns the size of the buffer in bytes.
    pub fn bytes(&self) -> u64 {
        self.totals.size()
    }

    /// Replaces `items` by their exclusive prefix sums. [`Self::total`] then reads the sum of all
    /// items.
    pub fn record(
        &self,
        gpu: &Gpu,
        passes: &Sorting,
        r: &mut Recorder,
        items: &Buffer,
        n: u32,
    ) -> Result<()> {
        let (chunks, groups) = gpu.shape.chunks(n);
        let job = ChunkJob {
            n,
            shift: 0,
            first: 0,
            chunks,
        };
        let totals = &self.totals;
        r.run(
            &passes.scan_chunks,
            &job,
            ScanChunksBuffers { items, totals },
            groups,
        )?;
        r.run(
            &passes.scan_apply,
            &job,
            ScanApplyBuffers { items, totals },
            groups,
        )
    }

    /// Returns the sum of the `n` items of the last scan; `u32::MAX` if it exceeds 32 bits.
    pub fn total(&self, gpu: &Gpu, n: u32) -> Result<u32> {
        let chunks = gpu.shape.chunks(n).0 as usize;
        Ok(gpu.read::<u32>(&self.totals, chunks + 1)?[chunks])
    }
}
