//! Opens the engine that a device name selects.

use crate::Result;
use crate::engine::Engine;
use crate::gpu::{Gpu, adapters};
use crate::gpu_engine::GpuEngine;
use crate::native::CpuEngine;
use serde::{Deserialize, Serialize};

/// The device that a name selects, and the reason.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Choice {
    /// `cpu`, or a name that [`Gpu::open`] takes.
    pub device: String,
    /// The reason, for reports.
    pub why: String,
}

impl Choice {
    fn new(device: impl Into<String>, why: impl Into<String>) -> Self {
        Self {
            device: device.into(),
            why: why.into(),
        }
    }
}

/// Resolves a device name. `auto` selects a hardware adapter if there is one, else the CPU backend,
/// which is faster than a software adapter on the same processor.
pub fn choice(device: &str) -> Choice {
    if device != "auto" {
        return Choice::new(device, "requested");
    }
    if adapters().is_empty() {
        return Choice::new("cpu", "there is no Vulkan, Metal or DirectX device");
    }
    match Gpu::open("auto") {
        Ok(gpu) if gpu.software => Choice::new(
            "cpu",
            format!("faster than the software adapter '{}'", gpu.name),
        ),
        Ok(gpu) => Choice::new(gpu.name, "a hardware adapter"),
        Err(error) => Choice::new("cpu", format!("no graphics device can be opened: {error}")),
    }
}

/// Opens `cpu` (the vectorised CPU backend), `auto` ([`choice`]), or an adapter by name or index.
///
/// # Errors
/// When there is no such adapter.
pub fn open_engine(device: &str) -> Result<Box<dyn Engine>> {
    let Choice { device, why } = choice(device);
    tracing::debug!(device, why, "device");
    if device == "cpu" {
        return Ok(Box::new(CpuEngine::new()));
    }
    Ok(Box::new(GpuEngine::new(Gpu::open(&device)?)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn auto_prefers_hardware_and_else_the_cpu() {
        assert_eq!(choice("cpu"), Choice::new("cpu", "requested"));
        assert_eq!(choice("3").device, "3");
        let Some(gpu) = crate::tests::gpu() else {
            return;
        };
        let expected = if gpu.software {
            "cpu"
        } else {
            gpu.name.as_str()
        };
        assert_eq!(choice("auto").device, expected);
        assert!(open_engine("no such adapter").is_err());
    }
}
