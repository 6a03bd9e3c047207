//! ONNX Runtime, loaded at run time from a shared library.

use crate::{Error, Result, models};
use ort::environment::Environment;
use ort::session::Session;
use ort::value::Tensor;
use std::path::Path;
use std::sync::Mutex;

static ENVIRONMENT: Mutex<Option<Environment>> = Mutex::new(None);

/// The process-wide environment, opened on first use.
fn environment() -> Result<Environment> {
    let mut slot = ENVIRONMENT.lock().expect("no panic while holding the lock");
    if let Some(environment) = slot.as_ref() {
        return Ok(environment.clone());
    }
    let library = models::runtime_library()?;
    let failed = |e: &dyn std::fmt::Display| Error::Missing(format!("{}: ONNX Runtime cannot be loaded: {e}", library.display()));
    let environment = ort::init_from(&library).map_err(|e| failed(&e))?.with_name("fastlgs").build().map_err(|e| failed(&e))?;
    Ok(slot.insert(environment).clone())
}

/// A loaded model.
pub struct Model {
    name: String,
    session: Mutex<Session>,
}

impl Model {
    /// Loads an ONNX file; it uses as many threads as the machine has cores.
    pub fn load(path: &Path) -> Result<Self> {
        let name = path.display().to_string();
        if !path.is_file() {
            return Err(Error::Missing(format!("{name}: the model is not installed; run 'fastlgs models install-offline'")));
        }
        let failed = |e: &dyn std::fmt::Display| Error::Inference { model: name.clone(), reason: e.to_string() };
        let environment = environment()?;
        let threads = std::thread::available_parallelism().map_or(1, usize::from);
        let mut builder = Session::builder(&environment).map_err(|e| failed(&e))?.with_intra_threads(threads).map_err(|e| failed(&e))?;
        let session = builder.commit_from_file(path).map_err(|e| failed(&e))?;
        Ok(Self { name, session: Mutex::new(session) })
    }

    /// Runs on float or integer inputs; returns the first output's shape and values.
    pub fn run(&self, inputs: Vec<(&str, Input)>, output: &str) -> Result<(Vec<usize>, Vec<f32>)> {
        let failed = |e: ort::Error| Error::Inference { model: self.name.clone(), reason: e.to_string() };
        let mut values = Vec::new();
        for (name, input) in inputs {
            let value = match input {
                Input::Float(shape, data) => Tensor::from_array((shape, data)).map_err(failed)?.into_dyn(),
                Input::Int(shape, data) => Tensor::from_array((shape, data)).map_err(failed)?.into_dyn(),
            };
            values.push((name.to_owned(), value));
        }
        let mut session = self.session.lock().expect("no panic while holding the lock");
        let outputs = session.run(values).map_err(failed)?;
        let value = outputs
            .get(output)
            .ok_or_else(|| Error::Inference { model: self.name.clone(), reason: format!("it has no output '{output}'") })?;
        let (shape, data) = value.try_extract_tensor::<f32>().map_err(failed)?;
        Ok((shape.iter().map(|d| *d as usize).collect(), data.to_vec()))
    }
}

/// A named input: shape and row-major values.
pub enum Input {
    /// 32-bit floats.
    Float(Vec<usize>, Vec<f32>),
    /// 64-bit integers.
    Int(Vec<usize>, Vec<i64>),
}
