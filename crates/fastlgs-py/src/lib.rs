//! `fastlgs._fastlgs`: the pipeline as a Python module.
//!
//! `python/fastlgs/__init__.pyi` documents the interface. Names, units and conventions are those of
//! the Rust libraries.

mod answer;
mod camera;
mod fork;
mod object;
mod options;
mod scene;
mod stage;
mod texts;

use pyo3::create_exception;
use pyo3::exceptions::PyException;
use pyo3::prelude::*;
use pyo3::types::PyDict;

create_exception!(
    fastlgs,
    Error,
    PyException,
    "An error of the pipeline: one sentence that names the file and the solution."
);

create_exception!(
    fastlgs,
    NotFound,
    Error,
    "A view, object or name that does not exist."
);
create_exception!(
    fastlgs,
    Cancelled,
    Error,
    "The progress callback cancelled the stage."
);

/// Converts an error of the pipeline to a Python exception.
fn to_py_error(error: impl Into<fastlgs::Error>) -> PyErr {
    let error = error.into();
    let sentence = fastlgs::one_sentence(&error);
    let mut cause = &error;
    while let fastlgs::Error::While { source, .. } = cause {
        cause = source;
    }
    match cause {
        fastlgs::Error::NotFound(_) | fastlgs::Error::Core(fastlgs_core::Error::NotFound(_)) => {
            NotFound::new_err(sentence)
        }
        fastlgs::Error::Cancelled => Cancelled::new_err(sentence),
        _ => Error::new_err(sentence),
    }
}

/// Makes a queryable scene from photos. Keeps an existing scene if photos and options have not
/// changed.
#[pyfunction]
#[pyo3(signature = (photos, output, *, progress = None, device = "auto", seed = 0, effort = None, **options))]
#[expect(clippy::too_many_arguments, reason = "they are keywords")]
fn make<'py>(
    py: Python<'py>,
    photos: std::path::PathBuf,
    output: std::path::PathBuf,
    progress: Option<Py<PyAny>>,
    device: &str,
    seed: u64,
    effort: Option<&str>,
    options: Option<&Bound<'py, PyDict>>,
) -> PyResult<Bound<'py, PyAny>> {
    let defaults = fastlgs::preprocess::PreprocessConfig {
        photos,
        output,
        ..Default::default()
    };
    let usual = fastlgs::make::MakeConfig::default();
    let effort = effort
        .map(|effort| options::value_of("effort", effort))
        .transpose()?
        .unwrap_or(usual.effort);
    let config = fastlgs::make::MakeConfig {
        preprocess: options::with_options(&defaults, options)?,
        effort,
    };
    let made = stage::run(py, progress, device, seed, move |run| {
        fastlgs::make(&config, run)
    })?;
    options::to_python(py, &made)
}

/// Computes masks, key points, poses and points from photos, in the scene folder `output`.
#[pyfunction]
#[pyo3(signature = (photos, output, *, progress = None, device = "auto", seed = 0, **options))]
fn preprocess<'py>(
    py: Python<'py>,
    photos: std::path::PathBuf,
    output: std::path::PathBuf,
    progress: Option<Py<PyAny>>,
    device: &str,
    seed: u64,
    options: Option<&Bound<'py, PyDict>>,
) -> PyResult<Bound<'py, PyAny>> {
    let known = fastlgs::preprocess::PreprocessConfig {
        photos,
        output,
        ..Default::default()
    };
    stage::with_options(
        py,
        &known,
        options,
        progress,
        device,
        seed,
        fastlgs::preprocess,
    )
}

/// Trains Gaussians and finds objects in the scene folder `scene`.
#[pyfunction]
#[pyo3(signature = (scene, *, progress = None, device = "auto", seed = 0, **options))]
fn train<'py>(
    py: Python<'py>,
    scene: std::path::PathBuf,
    progress: Option<Py<PyAny>>,
    device: &str,
    seed: u64,
    options: Option<&Bound<'py, PyDict>>,
) -> PyResult<Bound<'py, PyAny>> {
    let known = fastlgs::train::TrainConfig {
        scene,
        ..Default::default()
    };
    stage::with_options(py, &known, options, progress, device, seed, fastlgs::train)
}

/// Generates photos with exact poses, depths and masks in the folder `output`.
#[pyfunction]
#[pyo3(signature = (kind, output, *, progress = None, device = "auto", seed = 0, **options))]
fn synth<'py>(
    py: Python<'py>,
    kind: String,
    output: std::path::PathBuf,
    progress: Option<Py<PyAny>>,
    device: &str,
    seed: u64,
    options: Option<&Bound<'py, PyDict>>,
) -> PyResult<Bound<'py, PyAny>> {
    let known = fastlgs::synth::SynthConfig {
        kind,
        output,
        ..Default::default()
    };
    stage::with_options(py, &known, options, progress, device, seed, fastlgs::synth)
}

#[pymodule]
fn _fastlgs(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add("__version__", env!("CARGO_PKG_VERSION"))?;
    module.add("Error", module.py().get_type::<Error>())?;
    module.add("NotFound", module.py().get_type::<NotFound>())?;
    module.add("Cancelled", module.py().get_type::<Cancelled>())?;
    module.add_class::<scene::Scene>()?;
    module.add_class::<answer::Answer>()?;
    module.add_class::<object::Object>()?;
    module.add_class::<object::FoundObject>()?;
    module.add_class::<camera::Camera>()?;
    module.add_function(wrap_pyfunction!(make, module)?)?;
    module.add_function(wrap_pyfunction!(preprocess, module)?)?;
    module.add_function(wrap_pyfunction!(train, module)?)?;
    module.add_function(wrap_pyfunction!(synth, module)?)
}
