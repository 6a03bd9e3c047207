//! Reads NumPy array files (`.npy`).

use crate::{Error, Result};
use npyz::{NpyFile, Order};
use std::fs::File;
use std::io::BufReader;
use std::path::Path;

/// An array of numbers.
#[derive(Clone, Debug, PartialEq)]
pub struct Npy {
    /// Size of each dimension.
    pub shape: Vec<usize>,
    /// Row-major values.
    pub values: Vec<f64>,
}

/// Reads a `.npy` file of numbers or booleans, in C or Fortran order.
///
/// # Errors
/// When the file is missing, truncated, or has another type.
pub fn read(path: &Path) -> Result<Npy> {
    let bad = |reason: String| Error::format(path, reason);
    let file = File::open(path).map_err(Error::io(path))?;
    let opened = NpyFile::new(BufReader::new(file));
    let mut file = opened.map_err(|e| {
        bad(format!(
            "not a complete .npy file ({e}); save it with numpy.save"
        ))
    })?;
    let by_columns = file.order() != Order::C && file.shape().len() > 1;
    let shape: Vec<usize> = file.shape().iter().map(|d| *d as usize).collect();
    let kind = file.dtype().descr();
    macro_rules! try_kinds {
        ($($t:ty => $convert:expr),*) => {$(
            file = match file.try_data::<$t>() {
                Ok(data) => {
                    let values = data.map(|v| v.map($convert)).collect::<Result<Vec<f64>, _>>();
                    let values = values.map_err(|e| bad(format!("it is cut off ({e}); copy it again")))?;
                    let values = if by_columns { to_row_major(&values, &shape) } else { values };
                    return Ok(Npy { shape, values });
                }
                Err(other) => other,
            };
        )*};
    }
    try_kinds!(f32 => f64::from, f64 => |v| v, i32 => f64::from, i64 => |v| v as f64, u8 => f64::from, u16 => f64::from,
        i16 => f64::from, u32 => f64::from, i8 => f64::from, u64 => |v| v as f64, half::f16 => f64::from, bool => f64::from);
    let _ = file;
    Err(bad(format!(
        "its values have the type {kind}; save numbers, for example with array.astype('float32')"
    )))
}

/// Reorders values from Fortran order (first index fastest) to row-major order.
fn to_row_major(values: &[f64], shape: &[usize]) -> Vec<f64> {
    let fortran_index = |row_major: usize| {
        let (mut rest, mut index) = (row_major, vec![0; shape.len()]);
        for (k, length) in shape.iter().enumerate().rev() {
            (index[k], rest) = (rest % length, rest / length);
        }
        index
            .iter()
            .zip(shape)
            .rev()
            .fold(0, |place, (i, length)| place * length + i)
    };
    (0..values.len())
        .map(|k| values[fortran_index(k)])
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use npyz::WriterBuilder;

    #[test]
    fn number_types_are_read_and_errors_name_the_file() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.npy");
        let mut bytes = Vec::new();
        let mut writer = npyz::WriteOptions::new()
            .default_dtype()
            .shape(&[2, 2])
            .writer(&mut bytes)
            .begin_nd()
            .unwrap();
        writer.extend([-1i32, 0, 7, 300]).unwrap();
        writer.finish().unwrap();
        std::fs::write(&path, &bytes).unwrap();
        assert_eq!(
            read(&path).unwrap(),
            Npy {
                shape: vec![2, 2],
                values: vec![-1.0, 0.0, 7.0, 300.0]
            }
        );
        // The same array in Fortran order.
        let mut columns = Vec::new();
        let options = npyz::WriteOptions::new()
            .default_dtype()
            .order(Order::Fortran)
            .shape(&[2, 2]);
        let mut writer = options.writer(&mut columns).begin_nd().unwrap();
        writer.extend([-1i32, 7, 0, 300]).unwrap();
        writer.finish().unwrap();
        std::fs::write(&path, &columns).unwrap();
        assert_eq!(
            read(&path).unwrap(),
            Npy {
                shape: vec![2, 2],
                values: vec![-1.0, 0.0, 7.0, 300.0]
            }
        );
        assert_eq!(
            to_row_major(&[0.0, 3.0, 1.0, 4.0, 2.0, 5.0], &[2, 3]),
            [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
        );
        // Half precision and 8-bit integers.
        let header = |kind: &str| {
            let text = format!("{{'descr': '{kind}', 'fortran_order': False, 'shape': (2,), }}");
            let text = format!("{text:<117}\n");
            [
                b"\x93NUMPY\x01\x00".as_slice(),
                &(text.len() as u16).to_le_bytes(),
                text.as_bytes(),
            ]
            .concat()
        };
        let halves = [1.5f32, -0.25]
            .map(|v| half::f16::from_f32(v).to_le_bytes())
            .concat();
        std::fs::write(&path, [header("<f2"), halves].concat()).unwrap();
        assert_eq!(read(&path).unwrap().values, [1.5, -0.25]);
        std::fs::write(&path, [header("|i1"), vec![255, 5]].concat()).unwrap();
        assert_eq!(read(&path).unwrap().values, [-1.0, 5.0]);
        std::fs::write(&path, [header("<c8"), vec![0; 16]].concat()).unwrap();
        let refused = read(&path).unwrap_err().to_string();
        assert!(
            refused.contains("c8") && refused.contains("astype"),
            "{refused}"
        );
        std::fs::write(&path, &bytes[..bytes.len() - 3]).unwrap();
        assert!(read(&path).unwrap_err().to_string().contains("a.npy"));
        std::fs::write(&path, b"no").unwrap();
        assert!(read(&path).unwrap_err().to_string().contains("a.npy"));
    }
}
