//! A compute pass made from an assembled shader.

use crate::gpu::Gpu;

/// How a shader uses a binding.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Binding {
    /// Uniform buffer.
    Uniform,
    /// Storage buffer, read only.
    Read,
    /// Storage buffer, read and written.
    ReadWrite,
}

/// An assembled, validated shader; all permutations have the same bindings 0, 1, 2, ...
pub struct Shader {
    /// File name without ending: also that of the CPU twin.
    pub name: &'static str,
    /// Source for each [`crate::gpu::Shape`], in its order.
    pub sources: [&'static str; 3],
    /// Kind of each binding.
    pub bindings: &'static [Binding],
}

/// All shaders of `shaders/`, by upper-case name.
#[allow(missing_docs, reason = "generated: each item names its file")]
pub mod shaders {
    use super::{Binding, Shader};
    include!(concat!(env!("OUT_DIR"), "/shaders.rs"));
}

/// A pipeline with an explicit layout (an automatic one drops bindings that a permutation does not use).
pub struct Pass {
    name: &'static str,
    pipeline: wgpu::ComputePipeline,
    layout: wgpu::BindGroupLayout,
}

/// Largest number of workgroups along one dimension that every adapter grants.
const MAX_GROUPS: u32 = 65_535;

impl Pass {
    /// Compiles the permutation that the device can run.
    pub fn new(gpu: &Gpu, shader: &Shader) -> Self {
        let source = shader.sources[gpu.shape as usize];
        let module = gpu.device.create_shader_module(wgpu::ShaderModuleDescriptor {
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
        let layout = gpu.device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor { label: Some(shader.name), entries: &entries });
        let pipeline_layout = gpu.device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
            label: Some(shader.name),
            bind_group_layouts: &[Some(&layout)],
            immediate_size: 0,
        });
        let pipeline = gpu.device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label: Some(shader.name),
            layout: Some(&pipeline_layout),
            module: &module,
            entry_point: Some("main"),
            compilation_options: wgpu::PipelineCompilationOptions::default(),
            cache: None,
        });
        Self { name: shader.name, pipeline, layout }
    }

    /// Records one dispatch of `groups` workgroups, split over y above the limit.
    pub fn record(&self, gpu: &Gpu, encoder: &mut wgpu::CommandEncoder, buffers: &[&wgpu::Buffer], groups: u32) {
        if groups == 0 {
            return;
        }
        let entries: Vec<_> =
            buffers.iter().enumerate().map(|(i, b)| wgpu::BindGroupEntry { binding: i as u32, resource: b.as_entire_binding() }).collect();
        let bindings =
            gpu.device.create_bind_group(&wgpu::BindGroupDescriptor { label: Some(self.name), layout: &self.layout, entries: &entries });
        let timestamp_writes = gpu.profile.as_ref().and_then(|p| p.next(self.name));
        let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor { label: Some(self.name), timestamp_writes });
        pass.set_pipeline(&self.pipeline);
        pass.set_bind_group(0, &bindings, &[]);
        let rows = groups.div_ceil(MAX_GROUPS);
        pass.dispatch_workgroups(groups.div_ceil(rows), rows, 1);
    }
}
