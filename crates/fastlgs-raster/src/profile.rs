//! Measures the time of each pass on the device with timestamp queries.

use crate::{Gpu, Result};
use std::collections::BTreeMap;
use std::sync::Mutex;

/// Largest number of dispatches between two readings; wgpu allows 4,096 queries in a set.
const CAPACITY: usize = 2048;

/// Two timestamps for each dispatch since the last reading.
pub(crate) struct Profile {
    queries: wgpu::QuerySet,
    resolved: wgpu::Buffer,
    names: Mutex<Vec<&'static str>>,
}

impl Profile {
    /// Returns `None` if the device has no timestamps.
    pub fn new(gpu: &Gpu) -> Option<Self> {
        if !gpu
            .device
            .features()
            .contains(wgpu::Features::TIMESTAMP_QUERY)
        {
            return None;
        }
        let queries = gpu.device.create_query_set(&wgpu::QuerySetDescriptor {
            label: Some("profile"),
            ty: wgpu::QueryType::Timestamp,
            count: 2 * CAPACITY as u32,
        });
        let resolved = gpu.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("profile"),
            size: 16 * CAPACITY as u64,
            usage: wgpu::BufferUsages::QUERY_RESOLVE | wgpu::BufferUsages::COPY_SRC,
            mapped_at_creation: false,
        });
        Some(Self {
            queries,
            resolved,
            names: Mutex::default(),
        })
    }

    /// Returns where the next dispatch writes its times; `None` if the set is full.
    pub fn next(&self, name: &'static str) -> Option<wgpu::ComputePassTimestampWrites<'_>> {
        let mut names = self.names.lock().expect("no panic while holding the lock");
        if names.len() == CAPACITY {
            return None;
        }
        let index = 2 * names.len() as u32;
        names.push(name);
        Some(wgpu::ComputePassTimestampWrites {
            query_set: &self.queries,
            beginning_of_pass_write_index: Some(index),
            end_of_pass_write_index: Some(index + 1),
        })
    }

    /// Returns the seconds of each pass since the last call.
    pub fn take(&self, gpu: &Gpu) -> Result<BTreeMap<&'static str, f64>> {
        let names =
            std::mem::take(&mut *self.names.lock().expect("no panic while holding the lock"));
        let mut seconds = BTreeMap::new();
        if names.is_empty() {
            return Ok(seconds);
        }
        let mut encoder = gpu.encoder();
        encoder.resolve_query_set(&self.queries, 0..2 * names.len() as u32, &self.resolved, 0);
        gpu.submit(encoder);
        let ticks: Vec<u64> = gpu.read(&self.resolved, 2 * names.len())?;
        let tick = f64::from(gpu.queue.get_timestamp_period()) * 1e-9;
        for (name, pair) in names.into_iter().zip(ticks.chunks_exact(2)) {
            *seconds.entry(name).or_default() += pair[1].saturating_sub(pair[0]) as f64 * tick;
        }
        Ok(seconds)
    }
}
