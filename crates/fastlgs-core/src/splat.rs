//! Reads `.splat`, the format of antimatter15's viewer: 32 bytes per Gaussian, with position and
//! scale as floats and colour, opacity and rotation as bytes. It has no view-dependent colour.

use crate::gaussians::{SH_C0, logit};
use crate::{Error, Gaussians, Result, fs};
use glam::Vec3;
use std::path::Path;

const ROW: usize = 32;

/// Reads a scene. Features are zero and object ids 0.
///
/// # Errors
/// [`Error::Format`] for an empty file or a length that is not a multiple of 32 bytes.
pub fn read(path: &Path) -> Result<Gaussians> {
    let data = fs::read(path)?;
    if data.is_empty() || !data.len().is_multiple_of(ROW) {
        let length = data.len();
        return Err(Error::format(
            path,
            format!(
                "its length of {length} bytes is not a multiple of {ROW} bytes per Gaussian; copy it again"
            ),
        ));
    }
    let mut scene = Gaussians::default();
    for row in data.as_chunks::<ROW>().0 {
        let float = |k: usize| {
            f32::from_le_bytes([row[4 * k], row[4 * k + 1], row[4 * k + 2], row[4 * k + 3]])
        };
        let byte = |k: usize| f32::from(row[k]) / 255.0;
        scene.push_sphere(Vec3::new(float(0), float(1), float(2)), 1.0, 0.5, [0.5; 3]);
        let last = scene.len() - 1;
        scene.log_scales[last] = Vec3::new(float(3), float(4), float(5)).map(f32::ln);
        scene.sh_dc[last] = (Vec3::new(byte(24), byte(25), byte(26)) - 0.5) / SH_C0;
        // Opacities of exactly 0 and 1 have no finite logit.
        scene.opacity_logits[last] = logit(byte(27).clamp(0.001, 0.999));
        scene.rotations[last] = std::array::from_fn(|k| (f32::from(row[28 + k]) - 128.0) / 128.0);
    }
    Ok(scene)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gaussians::sigmoid;

    #[test]
    fn rows_are_read_and_other_lengths_refused() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.splat");
        let floats = [1.0f32, -2.0, 3.0, 0.1, 0.2, 0.4];
        let bytes = [255u8, 0, 128, 204, 255, 128, 128, 128];
        let row: Vec<u8> = floats
            .iter()
            .flat_map(|v| v.to_le_bytes())
            .chain(bytes)
            .collect();
        std::fs::write(&path, [row.as_slice(), &row].concat()).unwrap();
        let scene = read(&path).unwrap();
        assert_eq!(
            (scene.len(), scene.means[1]),
            (2, Vec3::new(1.0, -2.0, 3.0))
        );
        assert!((scene.log_scales[0].map(f32::exp) - Vec3::new(0.1, 0.2, 0.4)).length() < 1e-6);
        assert!(
            (sigmoid(scene.opacity_logits[0]) - 0.8).abs() < 1e-6 && scene.rotation(0).w > 0.9999
        );
        assert!((scene.sh_dc[0].x * SH_C0 + 0.5 - 1.0).abs() < 1e-6);
        std::fs::write(&path, &row[..20]).unwrap();
        assert!(read(&path).unwrap_err().to_string().contains("a.splat"));
    }
}
