//! Paths of the models and of ONNX Runtime on this machine, and file digests.

use crate::{Error, Result};
use fastlgs_core::fs::cache_dir;
use sha2::{Digest, Sha256};
use std::path::{Path, PathBuf};

/// File name of CLIP's published BPE merges, for text towers without a tokenizer file.
pub const CLIP_MERGES: &str = "bpe_simple_vocab_16e6.txt.gz";

/// File name of the class-name embeddings, stored beside the offline models.
pub(crate) const NAMES: &str = "names.safetensors";

/// Returns the folder of the Python environment with pycolmap.
pub(crate) fn poses_venv() -> PathBuf {
    cache_dir().join("poses-venv")
}

/// Returns the Python interpreter of `poses_venv`.
pub fn poses_python() -> PathBuf {
    poses_venv().join(if cfg!(windows) {
        "Scripts/python.exe"
    } else {
        "bin/python"
    })
}

/// Returns the folder of the converted offline models.
pub fn offline_dir() -> PathBuf {
    cache_dir().join("offline")
}

/// File name of ONNX Runtime on this system.
pub(crate) const RUNTIME: &str = if cfg!(windows) {
    "onnxruntime.dll"
} else if cfg!(target_os = "macos") {
    "libonnxruntime.dylib"
} else {
    "libonnxruntime.so"
};

/// Returns the path of the ONNX Runtime shared library: `ORT_DYLIB_PATH`, or the one that
/// `install-offline` unpacked. If ONNX Runtime is linked in, it is the path of this program.
///
/// # Errors
/// The file does not exist.
pub fn runtime_library() -> Result<PathBuf> {
    if !cfg!(feature = "load-ort") {
        return std::env::current_exe().map_err(|e| {
            Error::Missing(format!(
                "the path of this program cannot be determined: {e}"
            ))
        });
    }
    let installed = cache_dir().join(RUNTIME);
    let path = std::env::var_os("ORT_DYLIB_PATH").map_or(installed, PathBuf::from);
    if path.is_file() {
        return Ok(path);
    }
    Err(Error::Missing(format!(
        "{}: ONNX Runtime is not installed; run 'fastlgs models install-offline'",
        path.display()
    )))
}

/// Returns the length in bytes and the SHA-256 (hexadecimal) of a file.
///
/// # Errors
/// The file cannot be read.
pub fn digest(path: &Path) -> Result<(u64, String)> {
    let mut hash = Sha256::new();
    let file = std::fs::File::open(path).map_err(fastlgs_core::Error::io(path))?;
    let bytes = std::io::copy(
        &mut std::io::BufReader::with_capacity(1 << 16, file),
        &mut HashWriter(&mut hash),
    );
    let bytes = bytes.map_err(fastlgs_core::Error::io(path))?;
    Ok((
        bytes,
        hash.finalize().iter().map(|b| format!("{b:02x}")).collect(),
    ))
}

struct HashWriter<'a>(&'a mut Sha256);

impl std::io::Write for HashWriter<'_> {
    fn write(&mut self, data: &[u8]) -> std::io::Result<usize> {
        self.0.update(data);
        Ok(data.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}
