//! Which engine a device's name means.

use crate::engine::Engine;
use crate::gpu::{Gpu, adapters};
use crate::gpu_engine::GpuEngine;
use crate::native::CpuEngine;
use crate::shape::Shape;
use crate::{Error, Result, tuning};
use serde::{Deserialize, Serialize};

/// What a device's name means here, and the reason.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Choice {
    /// `cpu`, or a name that [`Gpu::open`] takes.
    pub device: String,
    /// Why, in words.
    pub why: String,
}

impl Choice {
    fn new(device: impl Into<String>, why: impl Into<String>) -> Self {
        Self { device: device.into(), why: why.into() }
    }
}

/// What `device` means. `auto` is a hardware adapter where there is one; else the faster of software adapter and CPU backend, as
/// [`tuning::tune`] measured it once; the CPU backend, which usually is, until then.
pub fn choice(device: &str) -> Choice {
    if device != "auto" {
        return Choice::new(device, "asked for");
    }
    if adapters().is_empty() {
        return Choice::new("cpu", "there is no Vulkan, Metal or DirectX device");
    }
    let gpu = match Gpu::open("auto") {
        Ok(gpu) => gpu,
        Err(error) => return Choice::new("cpu", format!("no graphics device can be opened: {error}")),
    };
    if !gpu.software {
        return Choice::new(&gpu.name, "a hardware adapter");
    }
    match tuning::against_cpu(&gpu.identity) {
        None => Choice::new("cpu", format!("not measured yet; usually faster than the software adapter '{}'", gpu.name)),
        Some([adapter, cpu]) => {
            let measured = format!("measured: {cpu:.0} ms a training step on cpu, {adapter:.0} ms on '{}'", gpu.name);
            Choice::new(if adapter < cpu { gpu.name.as_str() } else { "cpu" }, measured)
        }
    }
}

/// Opens `cpu` (the fast CPU backend), `auto` ([`choice`]), or an adapter by name or index.
///
/// # Errors
/// When there is no such adapter.
pub fn open_engine(device: &str) -> Result<Box<dyn Engine>> {
    open_engine_as(device, None)
}

/// The same with kernels of a given shape, instead of the one that was fastest.
///
/// # Errors
/// As [`open_engine`], and for `cpu`, which has no shapes.
pub fn open_engine_as(device: &str, shape: Option<Shape>) -> Result<Box<dyn Engine>> {
    let Choice { device, why } = choice(device);
    tracing::debug!(device, why, "device");
    if device == "cpu" {
        return match shape {
            None => Ok(Box::new(CpuEngine::new())),
            Some(_) => Err(Error::Adapter("the cpu has no kernel shapes: name an adapter with --device, or leave out --shape".to_owned())),
        };
    }
    let mut gpu = Gpu::open(&device)?;
    gpu.shape = shape.or_else(|| tuning::remembered(&gpu.identity)).unwrap_or(gpu.shape);
    Ok(Box::new(GpuEngine::new(gpu)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn kernels_have_the_shape_that_is_asked_for() {
        let on_cpu = |shape| open_engine_as("cpu", shape);
        assert_eq!(on_cpu(None).unwrap().shape(), None);
        assert!(on_cpu(Some(Shape::Wide)).err().unwrap().to_string().contains("no kernel shapes"));
        let Some(gpu) = crate::tests::gpu() else { return };
        for shape in Shape::ALL {
            let named = shape.to_string().parse().unwrap();
            assert_eq!(open_engine_as(&gpu.name, Some(named)).unwrap().shape(), Some(shape));
        }
        assert!("narrow".parse::<Shape>().unwrap_err().contains("lanes32, lanes64, wide"));
    }
}
