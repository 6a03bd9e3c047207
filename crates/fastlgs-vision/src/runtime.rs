//! Runs ONNX models.

use crate::environment::environment;
use crate::provider::Provider;
use crate::{Error, Result, model_paths};
use half::f16;
use ort::session::Session;
use ort::value::{DynValue, Tensor, TensorElementType, ValueType};
use std::path::Path;
use std::sync::Mutex;

fn cores() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

/// A tensor: shape and row-major values. Integers are stored as floats, which is exact up to 2^24.
#[derive(Clone, Debug, PartialEq)]
pub struct Array {
    /// Length of each dimension.
    pub shape: Vec<usize>,
    /// Row-major values.
    pub values: Vec<f32>,
}

impl Array {
    /// Creates an array of `shape`; `values` are row-major.
    pub fn new(shape: impl Into<Vec<usize>>, values: Vec<f32>) -> Self {
        Self {
            shape: shape.into(),
            values,
        }
    }
}

/// An input of a model.
#[derive(Clone, Debug)]
pub struct Slot {
    /// Name of the input.
    pub name: String,
    /// Length of each dimension; `None` if it is variable.
    pub shape: Vec<Option<usize>>,
    kind: TensorElementType,
}

/// A loaded model.
#[derive(Debug)]
pub struct Model {
    name: String,
    /// Inputs of the model.
    pub inputs: Vec<Slot>,
    /// Names of the outputs.
    pub outputs: Vec<String>,
    /// One session, or one per core. A run uses one that is free.
    sessions: Vec<Mutex<Session>>,
}

/// Returns whether the processor adds products of 8-bit numbers in 32 bits. Older x86 processors
/// add two of them in 16 bits, which do not suffice.
fn has_dot_products() -> bool {
    #[cfg(target_arch = "x86_64")]
    let found = [
        is_x86_feature_detected!("avx512vnni"),
        is_x86_feature_detected!("avxvnni"),
    ];
    #[cfg(not(target_arch = "x86_64"))]
    let found = [true];
    found.contains(&true)
}

/// Opens a session of a model on a provider.
fn open(path: &Path, threads: usize, provider: Provider) -> Result<Session> {
    let failed = |e: &dyn std::fmt::Display| Error::Inference {
        model: path.display().to_string(),
        reason: e.to_string(),
    };
    let mut builder = Session::builder(&environment()?)
        .map_err(|e| failed(&e))?
        .with_intra_threads(threads)
        .map_err(|e| failed(&e))?;
    if !has_dot_products() {
        builder = builder.with_precise_qmm().map_err(|e| failed(&e))?;
    }
    if let Some(dispatch) = provider.dispatch() {
        builder = builder
            .with_execution_providers([dispatch])
            .map_err(|e| failed(&e))?;
    }
    builder.commit_from_file(path).map_err(|e| failed(&e))
}

/// Opens the first session of a model on the chosen provider, and returns both. `Auto` becomes the
/// first provider that works.
fn first_session(path: &Path, threads: usize) -> Result<(Provider, Session)> {
    environment()?;
    let chosen = Provider::chosen();
    if chosen == Provider::Auto {
        let built_in = Provider::AUTOMATIC.into_iter().filter(|p| p.is_built_in());
        for provider in built_in {
            match open(path, threads, provider) {
                Ok(session) => return Ok((provider, session)),
                Err(error) => tracing::info!("{} is not used: {error}", provider.name()),
            }
        }
        return Ok((Provider::Cpu, open(path, threads, Provider::Cpu)?));
    }
    if !chosen.is_built_in() {
        let library = model_paths::runtime_library()?;
        return Err(chosen.unavailable(&library, "the library was built without it"));
    }
    match open(path, threads, chosen) {
        Ok(session) => Ok((chosen, session)),
        // A model that the processor cannot open either is the reason.
        Err(error) if chosen == Provider::Cpu || open(path, threads, Provider::Cpu).is_err() => {
            Err(error)
        }
        Err(error) => {
            let reason = match error {
                Error::Inference { reason, .. } => reason,
                other => other.to_string(),
            };
            Err(chosen.unavailable(&model_paths::runtime_library()?, &reason))
        }
    }
}

impl Model {
    /// Loads an ONNX file; each run uses as many threads as the machine has cores.
    ///
    /// # Errors
    /// The file or ONNX Runtime is missing, or the file is not a valid model.
    pub fn load(path: &Path) -> Result<Self> {
        Self::with_sessions(path, 1, cores())
    }

    /// Loads a small ONNX file once per core, for parallel runs with one thread each. The code
    /// around the runs then uses all cores as well.
    ///
    /// # Errors
    /// As [`Self::load`].
    pub fn load_for_each_core(path: &Path) -> Result<Self> {
        Self::with_sessions(path, cores(), 1)
    }

    fn with_sessions(path: &Path, count: usize, threads: usize) -> Result<Self> {
        let name = path.display().to_string();
        if !path.is_file() {
            let hint = "run 'fastlgs models install-offline' for the offline models, or 'fastlgs models pull NAME' for the others";
            return Err(Error::Missing(format!(
                "{name}: model file not found; {hint}"
            )));
        }
        let failed = |e: &dyn std::fmt::Display| Error::Inference {
            model: name.clone(),
            reason: e.to_string(),
        };
        let (provider, first) = first_session(path, threads)?;
        provider.record();
        let mut sessions = vec![first];
        // A graphics card runs one model at a time.
        while provider == Provider::Cpu && sessions.len() < count {
            sessions.push(open(path, threads, provider)?);
        }
        let session = &sessions[0];
        let slot = |outlet: &ort::value::Outlet| match outlet.dtype() {
            ValueType::Tensor { ty, shape, .. } => {
                let shape = shape
                    .iter()
                    .map(|d| usize::try_from(*d).ok().filter(|d| *d > 0))
                    .collect();
                Ok(Slot {
                    name: outlet.name().to_owned(),
                    shape,
                    kind: *ty,
                })
            }
            _ => Err(failed(&format!(
                "its input '{}' is not a tensor",
                outlet.name()
            ))),
        };
        let inputs = session
            .inputs()
            .iter()
            .map(slot)
            .collect::<Result<Vec<_>>>()?;
        let outputs = session
            .outputs()
            .iter()
            .map(|o| o.name().to_owned())
            .collect();
        Ok(Self {
            inputs,
            outputs,
            sessions: sessions.into_iter().map(Mutex::new).collect(),
            name,
        })
    }

    /// Returns the first input that has one of these names.
    pub fn input(&self, names: &[&str]) -> Option<&Slot> {
        self.inputs
            .iter()
            .find(|slot| names.contains(&slot.name.as_str()))
    }

    /// Returns the output that has one of these names; earlier names take precedence.
    pub fn output(&self, names: &[&str]) -> Option<&str> {
        names
            .iter()
            .find_map(|name| self.outputs.iter().find(|o| o == name))
            .map(String::as_str)
    }

    /// Returns an error that names this model and the reason.
    pub fn error(&self, reason: impl Into<String>) -> Error {
        Error::Inference {
            model: self.name.clone(),
            reason: reason.into(),
        }
    }

    /// Runs the model and returns the named outputs as floats. Inputs are converted to the element
    /// types of the model.
    ///
    /// # Errors
    /// An unknown name, an unsupported type, or an error of ONNX Runtime.
    pub fn run(&self, inputs: Vec<(&str, Array)>, outputs: &[&str]) -> Result<Vec<Array>> {
        let failed = |e: ort::Error| self.error(e.to_string());
        let mut values = Vec::new();
        for (name, array) in inputs {
            let slot = self
                .input(&[name])
                .ok_or_else(|| self.error(format!("it has no input '{name}'")))?;
            values.push((name.to_owned(), self.tensor(slot, array)?));
        }
        let free = self
            .sessions
            .iter()
            .find_map(|session| session.try_lock().ok());
        let mut session = free.unwrap_or_else(|| {
            self.sessions[0]
                .lock()
                .expect("no panic while holding the lock")
        });
        let found = session.run(values).map_err(failed)?;
        let array = |name: &&str| {
            let value = found
                .get(*name)
                .ok_or_else(|| self.error(format!("it has no output '{name}'")))?;
            let lengths = |shape: &[i64]| shape.iter().map(|d| *d as usize).collect::<Vec<_>>();
            if let Ok((shape, data)) = value.try_extract_tensor::<f16>() {
                return Ok(Array::new(
                    lengths(shape),
                    data.iter().map(|v| v.to_f32()).collect(),
                ));
            }
            let (shape, data) = value.try_extract_tensor::<f32>().map_err(failed)?;
            Ok(Array::new(lengths(shape), data.to_vec()))
        };
        outputs.iter().map(array).collect()
    }

    fn tensor(&self, slot: &Slot, Array { shape, values }: Array) -> Result<DynValue> {
        let value = match slot.kind {
            TensorElementType::Float32 => Tensor::from_array((shape, values)).map(Tensor::into_dyn),
            TensorElementType::Float16 => Tensor::from_array((
                shape,
                values.iter().map(|v| f16::from_f32(*v)).collect::<Vec<_>>(),
            ))
            .map(Tensor::into_dyn),
            TensorElementType::Int64 => {
                Tensor::from_array((shape, values.iter().map(|v| *v as i64).collect::<Vec<_>>()))
                    .map(Tensor::into_dyn)
            }
            TensorElementType::Int32 => {
                Tensor::from_array((shape, values.iter().map(|v| *v as i32).collect::<Vec<_>>()))
                    .map(Tensor::into_dyn)
            }
            TensorElementType::Uint8 => {
                Tensor::from_array((shape, values.iter().map(|v| *v as u8).collect::<Vec<_>>()))
                    .map(Tensor::into_dyn)
            }
            other => {
                return Err(self.error(format!(
                    "its input '{}' has the type {other}, which is not supported",
                    slot.name
                )));
            }
        };
        value.map_err(|e| self.error(e.to_string()))
    }
}
