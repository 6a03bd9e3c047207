//! Shaders as the build found them: sources, and what each binds, by the names that it gives its buffers.

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
    /// Sources by the flags that they were assembled for.
    pub sources: &'static [(&'static [&'static str], &'static str)],
    /// Kind of each binding.
    pub bindings: &'static [Binding],
}

/// A shader as a type: what its passes must be given.
pub trait Kernel {
    /// The shader.
    const SHADER: &'static Shader;
    /// The value of binding 0.
    type Uniform: bytemuck::Pod;
    /// Its storage buffers, by the names in the shader.
    type Buffers<'a>;
    /// These in the order of their bindings.
    fn in_order<'a>(buffers: &Self::Buffers<'a>) -> Vec<&'a wgpu::Buffer>;
}

/// One type a file of `shaders/`, and one for its buffers. A buffer that a shader does not have, one that is missing, a uniform of another
/// type or size: each is a build error.
#[allow(missing_docs, reason = "generated: each item names its file")]
pub mod shaders {
    use super::{Binding, Kernel, Shader};
    include!(concat!(env!("OUT_DIR"), "/shaders.rs"));
}
