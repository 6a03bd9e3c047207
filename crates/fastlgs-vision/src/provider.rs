//! Execution providers of ONNX Runtime: the hardware that runs the models.

use crate::environment::environment;
use crate::{Error, Result};
use ort::ep::{self, ExecutionProvider, ExecutionProviderDispatch};
use serde::{Deserialize, Serialize};
use std::sync::OnceLock;

/// An execution provider of ONNX Runtime.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Provider {
    /// CUDA, CoreML or DirectML if the library has it and it works, otherwise the processor.
    #[default]
    Auto,
    /// The processor.
    Cpu,
    /// NVIDIA GPUs.
    Cuda,
    /// NVIDIA GPUs; compiles each model, which takes minutes.
    TensorRt,
    /// Apple's GPUs and neural engine.
    CoreMl,
    /// GPUs on Windows.
    DirectMl,
    /// Intel's processors and GPUs.
    OpenVino,
}

/// The provider that the user chose.
static CHOSEN: OnceLock<Provider> = OnceLock::new();
/// The provider of the first model that was loaded.
static USED: OnceLock<Provider> = OnceLock::new();

impl Provider {
    /// All providers that ONNX Runtime may have, besides the processor.
    pub const ACCELERATED: [Self; 5] = [
        Self::Cuda,
        Self::TensorRt,
        Self::CoreMl,
        Self::DirectMl,
        Self::OpenVino,
    ];
    /// Names of all providers, `auto` and `cpu` first.
    pub const NAMES: [&str; 7] = [
        "auto", "cpu", "cuda", "tensorrt", "coreml", "directml", "openvino",
    ];
    /// Providers that `Auto` tries, in this order. TensorRT and OpenVINO compile each model first,
    /// so they have to be chosen.
    pub(crate) const AUTOMATIC: [Self; 3] = [Self::Cuda, Self::CoreMl, Self::DirectMl];

    /// Chooses the provider of all models that this process loads from now on. Only the first call
    /// has an effect.
    pub fn choose(self) {
        let _ = CHOSEN.set(self);
    }

    /// Returns the chosen provider.
    pub(crate) fn chosen() -> Self {
        CHOSEN.get().copied().unwrap_or_default()
    }

    /// Returns the provider of the models that this process has loaded; `None` without models.
    pub fn used() -> Option<Self> {
        USED.get().copied()
    }

    /// Records the provider of a loaded model.
    pub(crate) fn record(self) {
        let _ = USED.set(self);
    }

    /// Returns the name, as in the option.
    pub fn name(self) -> &'static str {
        match self {
            Self::Auto => "auto",
            Self::Cpu => "cpu",
            Self::Cuda => "cuda",
            Self::TensorRt => "tensorrt",
            Self::CoreMl => "coreml",
            Self::DirectMl => "directml",
            Self::OpenVino => "openvino",
        }
    }

    /// Returns the provider of a name; `None` for an unknown one.
    pub fn by_name(name: &str) -> Option<Self> {
        let all = [Self::Auto, Self::Cpu].into_iter().chain(Self::ACCELERATED);
        all.into_iter().find(|provider| provider.name() == name)
    }

    /// Returns whether the loaded library was built with this provider. Its libraries and its device
    /// may still be missing.
    pub(crate) fn is_built_in(self) -> bool {
        let available = match self {
            Self::Auto | Self::Cpu => Ok(true),
            Self::Cuda => ep::CUDA::is_available(),
            Self::TensorRt => ep::TensorRT::is_available(),
            Self::CoreMl => ep::CoreML::is_available(),
            Self::DirectMl => ep::DirectML::is_available(),
            Self::OpenVino => ep::OpenVINO::is_available(),
        };
        available.unwrap_or(false)
    }

    /// Returns the provider as sessions take it; `None` for the processor, which they always have.
    pub(crate) fn dispatch(self) -> Option<ExecutionProviderDispatch> {
        let dispatch = match self {
            Self::Auto | Self::Cpu => return None,
            Self::Cuda => ep::CUDA::default().build(),
            Self::TensorRt => ep::TensorRT::default().build(),
            Self::CoreMl => ep::CoreML::default().build(),
            Self::DirectMl => ep::DirectML::default().build(),
            Self::OpenVino => ep::OpenVINO::default().build(),
        };
        Some(dispatch.error_on_failure())
    }

    /// Returns the error for a chosen provider that does not work.
    pub(crate) fn unavailable(self, library: &std::path::Path, reason: &str) -> Error {
        let package = match self {
            Self::Auto | Self::Cpu | Self::CoreMl => "onnxruntime",
            Self::Cuda | Self::TensorRt => "onnxruntime-gpu",
            Self::DirectMl => "onnxruntime-directml",
            Self::OpenVino => "onnxruntime-openvino",
        };
        Error::Missing(format!(
            "{}: ONNX Runtime cannot use '{}' ({reason}); install the Python package {package}, set ORT_DYLIB_PATH to the \
             library in it, or choose another provider",
            library.display(),
            self.name()
        ))
    }
}

/// Returns the providers that the installed library was built with.
///
/// # Errors
/// ONNX Runtime is not installed or cannot be loaded.
pub fn built_in() -> Result<Vec<Provider>> {
    environment()?;
    let mut found = vec![Provider::Cpu];
    found.extend(
        Provider::ACCELERATED
            .into_iter()
            .filter(|p| p.is_built_in()),
    );
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_name_provider_library_and_package() {
        let library = std::path::Path::new("/lib/libonnxruntime.so");
        for provider in Provider::ACCELERATED {
            let message = provider.unavailable(library, "why").to_string();
            let words = [provider.name(), "libonnxruntime.so", "onnxruntime", "why"];
            assert!(words.iter().all(|word| message.contains(word)), "{message}");
        }
        assert!(Provider::Cpu.is_built_in() && Provider::Cpu.dispatch().is_none());
    }

    #[test]
    fn names_are_those_of_reports() {
        assert!(
            Provider::NAMES
                .iter()
                .all(|name| Provider::by_name(name).is_some())
        );
        for provider in Provider::ACCELERATED {
            let name = serde_json::to_value(provider).expect("a name");
            assert_eq!(name, provider.name());
            assert_eq!(Provider::by_name(provider.name()), Some(provider));
        }
    }
}
