//! NumPy's array files.

use crate::{Error, Result};
use npyz::{NpyFile, Order};
use std::fs::File;
use std::io::BufReader;
use std::path::Path;

/// Numbers with their shape.
#[derive(Clone, Debug, PartialEq)]
pub struct Npy {
    /// Length of each dimension.
    pub shape: Vec<usize>,
    /// Row-major values.
    pub values: Vec<f64>,
}

/// Reads a `.npy` file of numbers or truth values in C order.
///
/// # Errors
/// When the file is missing, cut off, or of another kind.
pub fn read(path: &Path) -> Result<Npy> {
    let bad = |reason: String| Error::format(path, format!("{reason}; save it with numpy.save in C order"));
    let file = File::open(path).map_err(Error::io(path))?;
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
                    let values = data.map(|v| v.map($convert)).collect::<Result<Vec<f64>, _>>();
                    return Ok(Npy { shape, values: values.map_err(|e| bad(format!("it is cut off ({e})")))? });
                }
                Err(other) => other,
            };
        )*};
    }
    try_kinds!(f32 => f64::from, f64 => |v| v, i32 => f64::from, i64 => |v| v as f64, u8 => f64::from, u16 => f64::from,
        i16 => f64::from, u32 => f64::from, bool => f64::from);
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
        assert_eq!(read(&path).unwrap(), Npy { shape: vec![2, 2], values: vec![-1.0, 0.0, 7.0, 300.0] });
        std::fs::write(&path, &bytes[..bytes.len() - 3]).unwrap();
        assert!(read(&path).unwrap_err().to_string().contains("a.npy"));
        std::fs::write(&path, b"no").unwrap();
        assert!(read(&path).unwrap_err().to_string().contains("a.npy"));
    }
}
