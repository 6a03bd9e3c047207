//! Types of the assembled shaders: sources and bindings.
//!
//! `build.rs` generates a type for each pass, and one for its buffers with the names in the shader.

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
    /// File name without extension; also the name of the CPU twin.
    pub name: &'static str,
    /// Flags and source of each permutation.
    pub sources: &'static [(&'static [&'static str], &'static str)],
    /// Kind of each binding.
    pub bindings: &'static [Binding],
}

/// A shader as a type that fixes its uniform and its buffers.
pub trait Kernel {
    /// The shader.
    const SHADER: &'static Shader;
    /// Type of the uniform at binding 0.
    type Uniform: bytemuck::Pod;
    /// Its storage buffers, with the names in the shader.
    type Buffers<'a>;
    /// Returns the buffers in the order of their bindings.
    fn in_order<'a>(buffers: &Self::Buffers<'a>) -> Vec<&'a wgpu::Buffer>;
}

/// Two types for each file of `shaders/`: the pass and its buffers. An unknown or missing buffer,
/// or a uniform of another type or size, is a build error.
#[allow(missing_docs, reason = "generated: each item names its file")]
pub mod shaders {
    use super::{Binding, Kernel, Shader};
    include!(concat!(env!("OUT_DIR"), "/shaders.rs"));
}
