//! Prefix sums and stable radix sorts, by serial chunks.

use super::kernels::{GROUP, Sorting};
use crate::cpu::CHUNKS;
use crate::pass::Recorder;
use crate::shader::shaders::{RadixCountBuffers, RadixScatterBuffers, ScanApplyBuffers, ScanChunksBuffers};
use crate::view::Job;
use crate::{Gpu, Result};
use wgpu::Buffer;

/// Ping-pong buffers of a radix sort. Keys go into `keys[0]`.
pub struct Sort {
    pub keys: [Buffer; 2],
    pub values: [Buffer; 2],
}

impl Sort {
    /// Room for `n` keys.
    pub fn new(gpu: &Gpu, what: &str, n: usize) -> Result<Self> {
        let make = || gpu.storage(what, 4 * n as u64);
        Ok(Self { keys: [make()?, make()?], values: [make()?, make()?] })
    }

    /// What it takes.
    pub fn bytes(&self) -> u64 {
        self.keys.iter().chain(&self.values).map(Buffer::size).sum()
    }
}

/// Buffers that all sorts share.
pub struct Scratch {
    histogram: Buffer,
    totals: Buffer,
}

impl Scratch {
    /// The buffers, which are small.
    pub fn new(gpu: &Gpu) -> Self {
        let small = |words: usize| gpu.storage("sorting", 4 * words as u64).expect("a small buffer fits every adapter");
        Self { histogram: small(256 * CHUNKS), totals: small(CHUNKS + 1) }
    }

    /// Exclusive prefix sum of `items`, in place; [`Self::total`] then reads their sum.
    pub fn scan(&self, passes: &Sorting, r: &mut Recorder, items: &Buffer, n: u32) -> Result<()> {
        let job = Job { n, shift: 0, first: 0, unused: 0 };
        let (totals, groups) = (&self.totals, CHUNKS as u32 / GROUP);
        r.run(&passes.scan_chunks, &job, ScanChunksBuffers { items, totals }, groups)?;
        r.run(&passes.scan_apply, &job, ScanApplyBuffers { items, totals }, groups)
    }

    /// Sum of the items of the last scan; `u32::MAX` where it is too large.
    pub fn total(&self, gpu: &Gpu) -> Result<u32> {
        Ok(gpu.read::<u32>(&self.totals, CHUNKS + 1)?[CHUNKS])
    }

    /// Sorts by the lowest `bits`; returns the side that holds the result. Values come out as former places.
    pub fn sort(&self, passes: &Sorting, r: &mut Recorder, sort: &Sort, n: u32, bits: u32) -> Result<usize> {
        let mut side = 0;
        let (histogram, groups) = (&self.histogram, CHUNKS as u32 / GROUP);
        for (round, shift) in (0..bits).step_by(8).enumerate() {
            let job = Job { n, shift, first: u32::from(round == 0), unused: 0 };
            let (keys, values) = (&sort.keys[side], &sort.values[side]);
            r.run(&passes.radix_count, &job, RadixCountBuffers { keys, histogram }, groups)?;
            self.scan(passes, r, histogram, 256 * CHUNKS as u32)?;
            side = 1 - side;
            let (keys_out, values_out) = (&sort.keys[side], &sort.values[side]);
            r.run(&passes.radix_scatter, &job, RadixScatterBuffers { keys, values, histogram, keys_out, values_out }, groups)?;
        }
        Ok(side)
    }
}
