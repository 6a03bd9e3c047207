//! Compute passes made from assembled shaders, and a recorder that runs them in order.

use crate::channels::Channels;
use crate::gpu::{Gpu, UNIFORM_SLOT, UNIFORM_SLOTS};
use crate::shader::{Binding, Kernel, Shader};
use crate::{Result, cpu};
use std::marker::PhantomData;

/// A compute pipeline with an explicit layout. An automatic layout would drop bindings that a
/// permutation does not use.
pub struct Pass {
    shader: &'static Shader,
    channels: Channels,
    pipeline: wgpu::ComputePipeline,
    layout: wgpu::BindGroupLayout,
}

/// A [`Pass`] with typed uniform and buffers.
pub struct TypedPass<K: Kernel> {
    pass: Pass,
    kernel: PhantomData<K>,
}

impl<K: Kernel> TypedPass<K> {
    /// Compiles the pass as [`Pass::new`] does.
    pub fn new(gpu: &Gpu, channels: Channels, harmonics: bool) -> Self {
        Self {
            pass: Pass::new(gpu, K::SHADER, channels, harmonics),
            kernel: PhantomData,
        }
    }
}

/// Workgroups of a dispatch: any number in one dimension, for each z.
#[derive(Clone, Copy)]
pub(crate) struct Groups {
    pub flat: u32,
    pub z: u32,
}

impl From<u32> for Groups {
    fn from(flat: u32) -> Self {
        Self { flat, z: 1 }
    }
}

/// Records passes in order. The first `on_cpu` of them run as their CPU twins instead, to find a
/// faulty pass.
pub(crate) struct Recorder<'a> {
    gpu: &'a Gpu,
    encoder: wgpu::CommandEncoder,
    /// The current compute pass. All passes share it, because beginning a compute pass costs more
    /// than recording one of ours.
    compute_pass: Option<wgpu::ComputePass<'static>>,
    /// Content of [`Gpu::uniforms`], written once when the passes are submitted.
    uniforms: Vec<u8>,
    on_cpu: usize,
}

impl<'a> Recorder<'a> {
    pub fn new(gpu: &'a Gpu, on_cpu: usize) -> Self {
        Self {
            gpu,
            encoder: gpu.encoder(),
            compute_pass: None,
            uniforms: Vec::new(),
            on_cpu,
        }
    }

    /// Runs one pass with its uniform and storage buffers.
    pub fn run<K: Kernel>(
        &mut self,
        pass: &TypedPass<K>,
        uniform: &K::Uniform,
        buffers: K::Buffers<'_>,
        groups: impl Into<Groups>,
    ) -> Result<()> {
        let storages = K::in_order(&buffers);
        let uniform = bytemuck::bytes_of(uniform);
        if self.on_cpu > 0 {
            self.on_cpu -= 1;
            return self.run_twin(&pass.pass, uniform, &storages);
        }
        self.record(&pass.pass, uniform, &storages, groups.into());
        Ok(())
    }

    /// Records a pass whose storage buffers are untyped and in the order of their bindings.
    pub fn record(
        &mut self,
        pass: &Pass,
        uniform: &[u8],
        storages: &[&wgpu::Buffer],
        groups: Groups,
    ) {
        if groups.flat == 0 {
            return;
        }
        if self.uniforms.len() as u64 == UNIFORM_SLOTS * UNIFORM_SLOT {
            self.flush();
        }
        let place = self.uniforms.len();
        self.uniforms.extend_from_slice(uniform);
        self.uniforms.resize(place + UNIFORM_SLOT as usize, 0);
        let size = std::num::NonZeroU64::new(uniform.len() as u64);
        let uniform = wgpu::BufferBinding {
            buffer: &self.gpu.uniforms,
            offset: place as u64,
            size,
        };
        // Timestamps are written at the ends of compute passes, so each pass needs its own.
        let timestamp_writes = self
            .gpu
            .profile
            .as_ref()
            .and_then(|p| p.next(pass.shader.name));
        if self.gpu.profile.is_some() {
            self.compute_pass = None;
        }
        let encoder = &mut self.encoder;
        let open = self.compute_pass.get_or_insert_with(|| {
            encoder
                .begin_compute_pass(&wgpu::ComputePassDescriptor {
                    label: Some(pass.shader.name),
                    timestamp_writes,
                })
                .forget_lifetime()
        });
        pass.record(self.gpu, open, uniform, storages, groups);
    }

    fn run_twin(&mut self, pass: &Pass, uniform: &[u8], storages: &[&wgpu::Buffer]) -> Result<()> {
        self.flush();
        let words = |b: &&wgpu::Buffer| self.gpu.read::<u32>(b, (b.size() / 4) as usize);
        let mut contents = storages.iter().map(words).collect::<Result<Vec<_>>>()?;
        cpu::run(pass.shader.name, pass.channels, uniform, &mut contents);
        for ((buffer, content), kind) in storages
            .iter()
            .zip(&contents)
            .zip(&pass.shader.bindings[1..])
        {
            if *kind == Binding::ReadWrite {
                self.gpu
                    .queue
                    .write_buffer(buffer, 0, bytemuck::cast_slice(content));
            }
        }
        Ok(())
    }

    /// Sets a buffer to zero.
    pub fn clear(&mut self, buffer: &wgpu::Buffer) {
        self.compute_pass = None;
        self.encoder.clear_buffer(buffer, 0, None);
    }

    /// Copies the start of one buffer to another, up to the smaller size.
    pub fn copy(&mut self, from: &wgpu::Buffer, to: &wgpu::Buffer) {
        self.compute_pass = None;
        self.encoder
            .copy_buffer_to_buffer(from, 0, to, 0, to.size().min(from.size()));
    }

    fn flush(&mut self) {
        self.compute_pass = None;
        // This write takes effect before the submission below and after all earlier ones.
        self.gpu
            .queue
            .write_buffer(&self.gpu.uniforms, 0, &self.uniforms);
        self.uniforms.clear();
        self.gpu
            .submit(std::mem::replace(&mut self.encoder, self.gpu.encoder()));
    }

    /// Submits the recorded passes. Returns the number of further passes to run as CPU twins.
    pub fn submit(mut self) -> usize {
        self.flush();
        self.on_cpu
    }
}

/// Largest number of workgroups in one dimension that every adapter grants.
const MAX_GROUPS: u32 = 65_535;

impl Pass {
    /// Compiles the permutation for the device's shape and for `channels`, with view-dependent
    /// colour if `harmonics`.
    pub fn new(gpu: &Gpu, shader: &'static Shader, channels: Channels, harmonics: bool) -> Self {
        let wanted = |flag: &&str| {
            gpu.shape.flag() == Some(*flag)
                || channels.flags().contains(flag)
                || (harmonics && *flag == "WITH_SH")
        };
        // Of the permutations with only wanted flags, take the one with most flags. It lacks only
        // flags that the pass does not use.
        let fitting = shader
            .sources
            .iter()
            .filter(|(flags, _)| flags.iter().all(&wanted));
        let source = fitting
            .max_by_key(|(flags, _)| flags.len())
            .expect("a permutation for every choice")
            .1;
        let module = gpu
            .device
            .create_shader_module(wgpu::ShaderModuleDescriptor {
                label: Some(shader.name),
                source: wgpu::ShaderSource::Wgsl(source.into()),
            });
        let entries: Vec<_> = shader
            .bindings
            .iter()
            .enumerate()
            .map(|(i, kind)| wgpu::BindGroupLayoutEntry {
                binding: i as u32,
                visibility: wgpu::ShaderStages::COMPUTE,
                ty: wgpu::BindingType::Buffer {
                    ty: match kind {
                        Binding::Uniform => wgpu::BufferBindingType::Uniform,
                        Binding::Read => wgpu::BufferBindingType::Storage { read_only: true },
                        Binding::ReadWrite => wgpu::BufferBindingType::Storage { read_only: false },
                    },
                    has_dynamic_offset: false,
                    min_binding_size: None,
                },
                count: None,
            })
            .collect();
        let layout = gpu
            .device
            .create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
                label: Some(shader.name),
                entries: &entries,
            });
        let pipeline_layout = gpu
            .device
            .create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
                label: Some(shader.name),
                bind_group_layouts: &[Some(&layout)],
                immediate_size: 0,
            });
        let pipeline = gpu
            .device
            .create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
                label: Some(shader.name),
                layout: Some(&pipeline_layout),
                module: &module,
                entry_point: Some("main"),
                // Every pass writes its workgroup memory before it reads it.
                compilation_options: wgpu::PipelineCompilationOptions {
                    zero_initialize_workgroup_memory: false,
                    ..Default::default()
                },
                cache: None,
            });
        Self {
            shader,
            channels,
            pipeline,
            layout,
        }
    }

    /// Records one dispatch of `groups` workgroups. Above the limit, they are split over y.
    fn record(
        &self,
        gpu: &Gpu,
        open: &mut wgpu::ComputePass<'_>,
        uniform: wgpu::BufferBinding<'_>,
        storages: &[&wgpu::Buffer],
        groups: Groups,
    ) {
        let resources = std::iter::once(wgpu::BindingResource::Buffer(uniform))
            .chain(storages.iter().map(|b| b.as_entire_binding()));
        let entries: Vec<_> = resources
            .enumerate()
            .map(|(i, resource)| wgpu::BindGroupEntry {
                binding: i as u32,
                resource,
            })
            .collect();
        let bindings = gpu.device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some(self.shader.name),
            layout: &self.layout,
            entries: &entries,
        });
        open.set_pipeline(&self.pipeline);
        open.set_bind_group(0, &bindings, &[]);
        let rows = groups.flat.div_ceil(MAX_GROUPS);
        open.dispatch_workgroups(groups.flat.div_ceil(rows), rows, groups.z);
    }
}
