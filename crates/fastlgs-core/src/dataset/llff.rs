//! Reads LLFF's `poses_bounds.npy`: 17 numbers for each photo, photos sorted by file name.
//!
//! The first 15 numbers are a 3x5 matrix in row-major order. Its columns are the camera axes down,
//! right and back in the world, the position, and (height, width, focal length). The nearest and
//! farthest depth follow.

use super::album::images_folder;
use super::pose::{PoseConvention, RawPose};
use super::{ParsedPoses, PosedPhoto, is_photo};
use crate::undistort::Distortion;
use crate::{Camera, Error, Result, npy};
use glam::{DMat4, DVec3, Mat4};
use std::path::{Path, PathBuf};

/// Name of the pose file in PHOTOS.
pub const FILE: &str = "poses_bounds.npy";

/// Reads `PHOTOS/poses_bounds.npy`. The photos are in PHOTOS/images, PHOTOS/input or PHOTOS itself.
///
/// # Errors
/// A damaged file, an entry that is not finite, or a number of photos that differs from the number
/// of rows.
pub fn load(photos: &Path) -> Result<ParsedPoses> {
    let path = photos.join(FILE);
    let table = npy::read(&path)?;
    let [rows, 17] = table.shape[..] else {
        return Err(Error::format(
            &path,
            format!(
                "the array has shape {:?}, not (photos, 17); export the poses from LLFF again",
                table.shape
            ),
        ));
    };
    let folder = images_folder(photos).unwrap_or_else(|| photos.join("images"));
    let entries = std::fs::read_dir(&folder).map_err(Error::io(&folder))?;
    let mut files: Vec<PathBuf> = entries
        .flatten()
        .map(|e| e.path())
        .filter(|p| is_photo(p))
        .collect();
    files.sort();
    if files.len() != rows {
        let count = files.len();
        return Err(Error::format(
            &path,
            format!(
                "{rows} poses for {count} photos; each photo needs one row, in the order of the file names"
            ),
        ));
    }
    let photos = files
        .into_iter()
        .zip(table.values.chunks_exact(17))
        .map(|(file, row)| posed(&path, file, row))
        .collect::<Result<_>>()?;
    // The format defines the axes, so there is only one convention.
    Ok(ParsedPoses {
        photos,
        conventions: vec![PoseConvention::C2wOpencv],
        ..ParsedPoses::default()
    })
}

/// Returns the photo of a row: a 3x5 matrix by rows, and two depths. The columns of the matrix are
/// the axes down, right and back, the position, and height, width and focal length.
fn posed(path: &Path, file: PathBuf, row: &[f64]) -> Result<PosedPhoto> {
    if let Some(bad) = row[..15].iter().find(|v| !v.is_finite()) {
        let name = file.file_name().unwrap_or_default().to_string_lossy();
        return Err(Error::format(
            path,
            format!("the pose of '{name}' contains {bad}; correct that row"),
        ));
    }
    let column = |k: usize| DVec3::new(row[k], row[5 + k], row[10 + k]);
    let (down, right, back, position) = (column(0), column(1), column(2), column(3));
    let [height, width, focal] = [row[4], row[9], row[14]].map(|v| v as f32);
    let camera_to_world = DMat4::from_cols(
        right.extend(0.0),
        down.extend(0.0),
        (-back).extend(0.0),
        position.extend(1.0),
    );
    Ok(PosedPhoto {
        path: file,
        camera: Camera {
            name: String::new(),
            width: width as u32,
            height: height as u32,
            fx: focal,
            fy: focal,
            cx: width / 2.0,
            cy: height / 2.0,
            world_to_camera: Mat4::IDENTITY,
        },
        raw_pose: RawPose::Matrix(camera_to_world),
        distortion: Distortion::default(),
        ignore: None,
        upright: false,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;
    use npyz::WriterBuilder;

    #[test]
    fn axes_are_down_right_back() {
        let dir = tempfile::tempdir().unwrap();
        std::fs::create_dir(dir.path().join("images")).unwrap();
        image::RgbImage::new(8, 6)
            .save(dir.path().join("images/a.png"))
            .unwrap();
        // A camera at (1, 2, 3) that looks along world -z with y up. Its axes are down = -y, right
        // = x and back = z.
        let row = [
            0.0, 1.0, 0.0, 1.0, 6.0, -1.0, 0.0, 0.0, 2.0, 8.0, 0.0, 0.0, 1.0, 3.0, 5.0, 0.1, 9.0,
        ];
        let write = |rows: u64, values: &[f64]| {
            let mut bytes = Vec::new();
            let mut writer = npyz::WriteOptions::new()
                .default_dtype()
                .shape(&[rows, 17])
                .writer(&mut bytes)
                .begin_nd()
                .unwrap();
            writer.extend(values.iter().copied()).unwrap();
            writer.finish().unwrap();
            std::fs::write(dir.path().join(FILE), bytes).unwrap();
        };
        write(1, &row);
        let dataset = super::super::load(dir.path()).unwrap();
        let camera = &dataset.photos[0].camera;
        assert_eq!((camera.width, camera.height, camera.fx), (8, 6, 5.0));
        assert!(camera.centre().distance(Vec3::new(1.0, 2.0, 3.0)) < 1e-5);
        assert!(camera.forward().distance(-Vec3::Z) < 1e-6);
        let above = camera
            .world_to_camera
            .transform_point3(Vec3::new(1.0, 3.0, -3.0));
        assert!(
            above.y < 0.0 && above.z > 0.0,
            "a point above the optical axis has a negative y in the camera"
        );
        write(2, &[row, row].concat());
        assert!(
            super::super::load(dir.path())
                .unwrap_err()
                .to_string()
                .contains("2 poses for 1 photos")
        );
        let mut bad = row;
        bad[3] = f64::NAN;
        write(1, &bad);
        assert!(
            super::super::load(dir.path())
                .unwrap_err()
                .to_string()
                .contains("a.png")
        );
    }
}
