//! Atomic file writes, locks, user folders, and a reader for binary files.

use crate::{Error, Result};
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

/// Writes `path` atomically: writes a temporary file beside it and renames that when `write`
/// succeeds. A symbolic link is kept and its target replaced. Devices and pipes (such as
/// `/dev/null`) are written directly.
///
/// # Errors
/// Errors of `write` and of the operating system, as [`Error::Io`]. The existing file then stays
/// unchanged.
pub fn write_atomic(
    path: &Path,
    write: impl FnOnce(&mut BufWriter<File>) -> std::io::Result<()>,
) -> Result<()> {
    let path = &path.canonicalize().unwrap_or_else(|_| path.to_owned());
    if path.metadata().is_ok_and(|m| !m.is_file() && !m.is_dir()) {
        let into = |device: File| {
            let mut device = BufWriter::new(device);
            write(&mut device)?;
            device.flush()
        };
        return File::options()
            .write(true)
            .open(path)
            .and_then(into)
            .map_err(Error::io(path));
    }
    if let Some(parent) = path.parent().filter(|p| !p.as_os_str().is_empty()) {
        std::fs::create_dir_all(parent).map_err(Error::io(parent))?;
    }
    let partial = partial_name(path);
    let result = (|| {
        let mut file = BufWriter::new(File::create(&partial)?);
        write(&mut file)?;
        file.flush()?;
        file.get_ref().sync_all()
    })();
    if let Err(source) = result.and_then(|()| std::fs::rename(&partial, path)) {
        let _ = std::fs::remove_file(&partial);
        return Err(Error::Io {
            path: path.to_owned(),
            source,
        });
    }
    Ok(())
}

/// Returns a temporary name beside `path`. The process id and a counter keep concurrent writers
/// apart, even of one file.
fn partial_name(path: &Path) -> PathBuf {
    static COUNT: AtomicU64 = AtomicU64::new(0);
    let mut name = path.file_name().unwrap_or_default().to_owned();
    name.push(format!(
        ".{}-{}.partial",
        std::process::id(),
        COUNT.fetch_add(1, Ordering::Relaxed)
    ));
    path.with_file_name(name)
}

/// Takes an exclusive lock on `path` through a lock file beside it. Waits for other processes and
/// threads; dropping the result releases the lock.
///
/// # Errors
/// [`Error::Io`] with the path of the lock file.
pub fn acquire_lock(path: &Path) -> Result<File> {
    let path = path.with_added_extension("lock");
    if let Some(parent) = path.parent() {
        std::fs::create_dir_all(parent).map_err(Error::io(parent))?;
    }
    let lock = File::options()
        .create(true)
        .append(true)
        .open(&path)
        .map_err(Error::io(&path))?;
    lock.lock().map_err(Error::io(&path))?;
    Ok(lock)
}

/// Returns the cache folder: `FASTLGS_CACHE`, else `$XDG_CACHE_HOME/fastlgs`, else
/// `~/.cache/fastlgs`.
pub fn cache_dir() -> PathBuf {
    let variable = |name: &str| {
        std::env::var_os(name)
            .filter(|v| !v.is_empty())
            .map(PathBuf::from)
    };
    variable("FASTLGS_CACHE")
        .or_else(|| variable("XDG_CACHE_HOME").map(|p| p.join("fastlgs")))
        .or_else(|| variable("HOME").map(|p| p.join(".cache/fastlgs")))
        .unwrap_or_else(|| std::env::temp_dir().join("fastlgs"))
}

/// Returns the folder of the user's own data: `FASTLGS_DATA`, else `$XDG_DATA_HOME/fastlgs`, else
/// `~/.local/share/fastlgs`.
pub fn data_dir() -> PathBuf {
    let variable = |name: &str| {
        std::env::var_os(name)
            .filter(|v| !v.is_empty())
            .map(PathBuf::from)
    };
    variable("FASTLGS_DATA")
        .or_else(|| variable("XDG_DATA_HOME").map(|p| p.join("fastlgs")))
        .or_else(|| variable("HOME").map(|p| p.join(".local/share/fastlgs")))
        .unwrap_or_else(|| std::env::temp_dir().join("fastlgs-data"))
}

/// Reads a whole file.
///
/// # Errors
/// [`Error::Io`] with the path.
pub fn read(path: &Path) -> Result<Vec<u8>> {
    std::fs::read(path).map_err(Error::io(path))
}

/// Writes a value as indented JSON, atomically.
///
/// # Errors
/// [`Error::Io`] with the path.
pub fn write_json(path: &Path, value: &impl serde::Serialize) -> Result<()> {
    write_atomic(path, |file| {
        serde_json::to_writer_pretty(&mut *file, value)?;
        file.write_all(b"\n")
    })
}

/// Reads a JSON file.
///
/// # Errors
/// [`Error::Io`], or [`Error::Format`] with the line and column.
pub fn read_json<T: serde::de::DeserializeOwned>(path: &Path) -> Result<T> {
    serde_json::from_slice(&read(path)?)
        .map_err(|e| Error::format(path, format!("not the expected JSON: {e}")))
}

/// Little-endian reader of a byte slice. Its errors name the file and the offset.
pub struct ByteReader<'a> {
    path: &'a Path,
    data: &'a [u8],
    at: usize,
}

impl<'a> ByteReader<'a> {
    /// Creates a reader at the first byte of `data`. `path` is the file that errors name.
    pub fn new(path: &'a Path, data: &'a [u8]) -> Self {
        Self { path, data, at: 0 }
    }

    /// Reads the next `n` bytes.
    ///
    /// # Errors
    /// [`Error::Format`] when fewer bytes are left.
    pub fn take(&mut self, n: usize) -> Result<&'a [u8]> {
        let rest = &self.data[self.at..];
        if n > rest.len() {
            return Err(Error::format(
                self.path,
                format!(
                    "truncated: {n} bytes expected at offset {}, but {} left; copy the file again",
                    self.at,
                    rest.len()
                ),
            ));
        }
        self.at += n;
        Ok(&rest[..n])
    }

    /// Returns the number of bytes that are not read yet.
    pub fn remaining(&self) -> usize {
        self.data.len() - self.at
    }

    /// Reads an unsigned 8-byte count. The remaining bytes must suffice for that many items of at
    /// least `item` bytes.
    ///
    /// # Errors
    /// [`Error::Format`] when they do not.
    pub fn count(&mut self, item: usize) -> Result<usize> {
        let n = self.u64()?;
        if n > (self.remaining() / item.max(1)) as u64 {
            return Err(Error::format(
                self.path,
                format!("truncated: it ends before the {n} announced entries; copy the file again"),
            ));
        }
        Ok(n as usize)
    }

    /// Reads the text up to the next NUL byte and consumes that byte.
    ///
    /// # Errors
    /// [`Error::Format`] without a NUL byte, or for text that is not UTF-8.
    pub fn c_string(&mut self) -> Result<&'a str> {
        let rest = &self.data[self.at..];
        let end = rest.iter().position(|&b| b == 0).ok_or_else(|| {
            Error::format(self.path, "truncated inside a name; copy the file again")
        })?;
        self.at += end + 1;
        std::str::from_utf8(&rest[..end])
            .map_err(|_| Error::format(self.path, "a name is not UTF-8"))
    }
}

macro_rules! number {
    ($($name:ident $type:ty),*) => {
        impl ByteReader<'_> {$(
            /// Reads the next little-endian number.
            ///
            /// # Errors
            /// [`Error::Format`] when the file ends before it.
            pub fn $name(&mut self) -> Result<$type> {
                const SIZE: usize = std::mem::size_of::<$type>();
                let mut raw = [0; SIZE];
                raw.copy_from_slice(self.take(SIZE)?);
                Ok(<$type>::from_le_bytes(raw))
            }
        )*}
    };
}
number!(u32 u32, i32 i32, u64 u64, f64 f64);

#[cfg(all(test, unix))]
mod tests {
    use super::*;

    /// A plain rename onto `/dev/null` by root would replace the device with a file.
    #[test]
    fn write_atomic_keeps_pipes_and_symbolic_links() {
        use std::os::unix::fs::FileTypeExt;
        let folder = tempfile::tempdir().expect("a folder");
        let pipe = folder.path().join("pipe");
        assert!(
            std::process::Command::new("mkfifo")
                .arg(&pipe)
                .status()
                .expect("mkfifo")
                .success()
        );
        let reader = std::thread::spawn({
            let pipe = pipe.clone();
            move || std::fs::read(pipe).expect("the pipe")
        });
        write_atomic(&pipe, |file| file.write_all(b"through")).expect("written");
        assert_eq!(reader.join().expect("the reader"), b"through");
        assert!(pipe.metadata().expect("the pipe").file_type().is_fifo());

        let (target, link) = (folder.path().join("target"), folder.path().join("link"));
        write_atomic(&target, |file| file.write_all(b"old")).expect("written");
        std::os::unix::fs::symlink("target", &link).expect("a link");
        write_atomic(&link, |file| file.write_all(b"new")).expect("written");
        assert!(link.symlink_metadata().expect("the link").is_symlink());
        assert_eq!(std::fs::read(&target).expect("the target"), b"new");
    }

    #[test]
    fn lock_serialises_concurrent_changes() {
        let dir = tempfile::tempdir().expect("a folder");
        let path = dir.path().join("count");
        let count = || {
            std::fs::read_to_string(&path)
                .map_or(0, |text| text.parse::<usize>().expect("a whole number"))
        };
        let up = || {
            (0..50).for_each(|_| {
                let _alone = acquire_lock(&path).expect("a lock");
                let next = count() + 1;
                std::fs::write(&path, next.to_string()).expect("a file");
            });
        };
        std::thread::scope(|scope| (0..4).for_each(|_| drop(scope.spawn(up))));
        assert_eq!(count(), 200);
    }
}
