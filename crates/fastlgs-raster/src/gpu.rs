//! wgpu adapters, the opened device, and its buffers.

use crate::profile::Profile;
use crate::shape::Shape;
use crate::{Error, Result};
use std::sync::{Arc, Mutex};

/// Bytes between two uniforms: enough for each of them, and a multiple of every adapter's offset
/// alignment.
pub(crate) const UNIFORM_SLOT: u64 = 512;
/// Largest number of uniforms in one submission.
pub(crate) const UNIFORM_SLOTS: u64 = 256;

/// An opened device.
pub struct Gpu {
    /// The logical device.
    pub device: wgpu::Device,
    /// Its queue.
    pub queue: wgpu::Queue,
    /// Name of the adapter.
    pub name: String,
    /// How the kernels divide their work.
    pub shape: Shape,
    /// Whether it is a software adapter.
    pub software: bool,
    /// Largest storage binding in bytes.
    pub max_binding: u64,
    /// Timestamps of the passes, while profiling.
    pub(crate) profile: Option<Profile>,
    /// Uniforms of the passes of one submission, in slots.
    pub(crate) uniforms: wgpu::Buffer,
    /// Buffer of the last read, kept for the next one.
    staging: Mutex<Option<wgpu::Buffer>>,
    /// First uncaught error (out of memory, lost device).
    failure: Arc<Mutex<Option<String>>>,
}

fn instance() -> wgpu::Instance {
    wgpu::Instance::new(wgpu::InstanceDescriptor {
        backends: wgpu::Backends::VULKAN | wgpu::Backends::METAL | wgpu::Backends::DX12,
        ..wgpu::InstanceDescriptor::new_without_display_handle()
    })
}

/// Returns the names of the adapters, in the order of their indices.
pub fn adapters() -> Vec<String> {
    let list = pollster::block_on(instance().enumerate_adapters(wgpu::Backends::all()));
    list.iter().map(|a| a.get_info().name).collect()
}

impl Gpu {
    /// Opens an adapter: `auto` (the first hardware adapter, else the first of all), an index, or a
    /// part of its name.
    ///
    /// # Errors
    /// When there is no such adapter; the message lists the available ones.
    pub fn open(which: &str) -> Result<Self> {
        let mut list = pollster::block_on(instance().enumerate_adapters(wgpu::Backends::all()));
        let names: Vec<String> = list.iter().map(|a| a.get_info().name).collect();
        let wanted = which.to_lowercase();
        let found = if which == "auto" {
            let hardware = |a: &wgpu::Adapter| a.get_info().device_type != wgpu::DeviceType::Cpu;
            list.iter()
                .position(hardware)
                .or(if list.is_empty() { None } else { Some(0) })
        } else {
            match which.parse::<usize>() {
                // A short number is an index. A long one, such as "4090", is a part of a name.
                Ok(index) if which.len() < 3 => Some(index).filter(|index| *index < list.len()),
                _ => names
                    .iter()
                    .position(|n| n.to_lowercase().contains(&wanted)),
            }
        };
        let index = found.ok_or_else(|| {
            Error::Adapter(if names.is_empty() {
                "no Vulkan, Metal or DirectX device found; install a driver (on Debian: mesa-vulkan-drivers) or select the device 'cpu'".to_owned()
            } else {
                let listed = names.iter().enumerate().map(|(index, name)| format!("{index} ({name})")).collect::<Vec<_>>();
                format!("no device '{which}'; available devices: {}, and cpu", listed.join(", "))
            })
        })?;
        Self::from_adapter(&list.swap_remove(index))
    }

    fn from_adapter(adapter: &wgpu::Adapter) -> Result<Self> {
        let info = adapter.get_info();
        let limits = adapter.limits();
        let software = info.device_type == wgpu::DeviceType::Cpu;
        let shape = if software { Shape::Wide } else { Shape::Lanes };
        let features = adapter.features() & wgpu::Features::TIMESTAMP_QUERY;
        let descriptor = wgpu::DeviceDescriptor {
            label: Some("fastlgs"),
            required_features: features,
            required_limits: wgpu::Limits {
                max_storage_buffer_binding_size: limits.max_storage_buffer_binding_size,
                max_buffer_size: limits.max_buffer_size,
                // The limit that every WebGPU adapter grants; blend_backward needs all eight.
                max_storage_buffers_per_shader_stage: 8,
                ..wgpu::Limits::default()
            },
            ..Default::default()
        };
        let failed = |reason: String| Error::Device {
            device: info.name.clone(),
            reason,
        };
        let (device, queue) = pollster::block_on(adapter.request_device(&descriptor))
            .map_err(|e| failed(e.to_string()))?;
        let uniforms = device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("uniforms"),
            size: UNIFORM_SLOTS * UNIFORM_SLOT,
            usage: wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        let failure = Arc::new(Mutex::new(None));
        let slot = failure.clone();
        device.on_uncaptured_error(Arc::new(move |e: wgpu::Error| {
            let reason = match e {
                wgpu::Error::OutOfMemory { .. } => {
                    "out of memory; lower the option budget, size or sh_degree".to_owned()
                }
                other => other.to_string(),
            };
            slot.lock()
                .expect("no panic while holding the lock")
                .get_or_insert(reason);
        }));
        Ok(Self {
            device,
            queue,
            name: info.name,
            shape,
            software,
            max_binding: limits.max_storage_buffer_binding_size,
            profile: None,
            uniforms,
            staging: Mutex::new(None),
            failure,
        })
    }

    /// Creates an uninitialised storage buffer of `bytes` (at least 16).
    ///
    /// # Errors
    /// When it exceeds the adapter's binding limit; `what` names the buffer in the message.
    pub fn storage(&self, what: &str, bytes: u64) -> Result<wgpu::Buffer> {
        let size = bytes.max(16).next_multiple_of(16);
        if size > self.max_binding {
            let mib = |b: u64| b.div_ceil(1 << 20);
            return Err(Error::TooLarge(format!(
                "the buffer for {what} needs {} MiB, but '{}' binds at most {} MiB; lower the option size or budget",
                mib(size),
                self.name,
                mib(self.max_binding)
            )));
        }
        Ok(self.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some(what),
            size,
            usage: wgpu::BufferUsages::STORAGE
                | wgpu::BufferUsages::COPY_SRC
                | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        }))
    }

    /// Creates a storage buffer with the given content.
    ///
    /// # Errors
    /// As [`Self::storage`].
    pub fn storage_with<T: bytemuck::Pod>(&self, what: &str, data: &[T]) -> Result<wgpu::Buffer> {
        let bytes: &[u8] = bytemuck::cast_slice(data);
        let buffer = self.storage(what, bytes.len() as u64)?;
        self.queue.write_buffer(&buffer, 0, bytes);
        Ok(buffer)
    }

    /// Returns a new command encoder.
    pub fn encoder(&self) -> wgpu::CommandEncoder {
        self.device
            .create_command_encoder(&wgpu::CommandEncoderDescriptor::default())
    }

    /// Submits the recorded commands.
    pub fn submit(&self, encoder: wgpu::CommandEncoder) {
        self.queue.submit([encoder.finish()]);
    }

    /// Reads `count` values from the start of a buffer, after all submitted work.
    ///
    /// # Errors
    /// When the device failed since the last call.
    pub fn read<T: bytemuck::Pod>(&self, buffer: &wgpu::Buffer, count: usize) -> Result<Vec<T>> {
        self.read_with(buffer, count, <[T]>::to_vec)
    }

    /// Like `read`, but passes the mapped values to `take` without copying them.
    ///
    /// # Errors
    /// When the device failed since the last call.
    pub fn read_with<T: bytemuck::Pod, R>(
        &self,
        buffer: &wgpu::Buffer,
        count: usize,
        take: impl FnOnce(&[T]) -> R,
    ) -> Result<R> {
        let bytes = ((count * size_of::<T>()) as u64)
            .next_multiple_of(8)
            .min(buffer.size());
        // Keep the buffer for the next call: allocation costs more than the copy.
        let mut kept = self
            .staging
            .lock()
            .expect("no panic while holding the lock");
        let staging = kept
            .take()
            .filter(|b| b.size() >= bytes)
            .unwrap_or_else(|| {
                self.device.create_buffer(&wgpu::BufferDescriptor {
                    label: Some("read"),
                    size: bytes.max(8),
                    usage: wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST,
                    mapped_at_creation: false,
                })
            });
        let mut encoder = self.encoder();
        encoder.copy_buffer_to_buffer(buffer, 0, &staging, 0, bytes);
        self.submit(encoder);
        staging.map_async(wgpu::MapMode::Read, .., |_| {});
        let waited = self.device.poll(wgpu::PollType::wait_indefinitely());
        let failed = |reason: String| Error::Device {
            device: self.name.clone(),
            reason,
        };
        waited.map_err(|e| failed(e.to_string()))?;
        if let Some(reason) = self
            .failure
            .lock()
            .expect("no panic while holding the lock")
            .take()
        {
            return Err(failed(reason));
        }
        let view = staging
            .get_mapped_range(..bytes)
            .map_err(|e| failed(e.to_string()))?;
        let taken = take(&bytemuck::cast_slice(&view)[..count]);
        drop(view);
        staging.unmap();
        *kept = Some(staging);
        Ok(taken)
    }
}
