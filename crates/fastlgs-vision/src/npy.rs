//! NumPy's array files.

use crate::runtime::Array;
use crate::{Error, Result};
use npyz::{NpyFile, Order};
use std::fs::File;
use std::io::BufReader;
use std::path::Path;

/// Reads a `.npy` file of numbers or truth values in C order.
///
/// # Errors
/// When the file is missing, cut off, or of another kind.
pub fn read(path: &Path) -> Result<Array> {
    let bad = |reason: String| Error::Invalid(format!("{}: {reason}; save it with numpy.save in C order", path.display()));
    let file = File::open(path).map_err(fastlgs_core::Error::io(path))?;
    let mut file = NpyFile::new(BufReader::new(file)).map_err(|e| bad(format!("not a whole .npy file ({e})")))?;
    if file.order() != Order::C && file.shape().len() > 1 {
        return Err(bad("its columns come first (Fortran order)".to_owned()));
    }
    let shape: Vec<usize> = file.shape().iter().map(|d| *d as usize).collect();
    let kind = file.dtype().descr();
    macro_rules! try_kinds {
        ($($t:ty => $convert:expr),*) => {$(
            file = match file.try_data::<$t>() {
                Ok(data) => {
                    let values = data.map(|v| v.map($convert)).collect::<Result<Vec<f32>, _>>();
                    return Ok(Array::new(shape, values.map_err(|e| bad(format!("it is cut off ({e})")))?));
                }
                Err(other) => other,
            };
        )*};
    }
    try_kinds!(f32 => |v| v, f64 => |v| v as f32, i32 => |v| v as f32, i64 => |v| v as f32, u8 => f32::from, u16 => f32::from,
        i16 => f32::from, u32 => |v| v as f32, bool => |v| f32::from(u8::from(v)));
    let _ = file;
    Err(bad(format!("its values are of the kind {kind}, which is not supported")))
}

#[cfg(test)]
mod tests {
    use super::*;
    use npyz::WriterBuilder;

    #[test]
    fn numbers_of_several_kinds_are_read_and_damage_is_named() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.npy");
        let mut bytes = Vec::new();
        let mut writer = npyz::WriteOptions::new().default_dtype().shape(&[2, 2]).writer(&mut bytes).begin_nd().unwrap();
        writer.extend([-1i32, 0, 7, 300]).unwrap();
        writer.finish().unwrap();
        std::fs::write(&path, &bytes).unwrap();
        assert_eq!(read(&path).unwrap(), Array::new([2, 2], vec![-1.0, 0.0, 7.0, 300.0]));
        std::fs::write(&path, &bytes[..bytes.len() - 3]).unwrap();
        assert!(read(&path).unwrap_err().to_string().contains("a.npy"));
        std::fs::write(&path, b"no").unwrap();
        assert!(read(&path).unwrap_err().to_string().contains("a.npy"));
    }
}
