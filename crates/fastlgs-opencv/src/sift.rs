//! SIFT key points by OpenCV (`sift.cpp`).

use crate::{Result, checked, side};
use glam::Vec2;
use image::GrayImage;
use std::ffi::{c_char, c_int};

unsafe extern "C" {
    fn fastlgs_opencv_sift(
        pixels: *const u8,
        width: c_int,
        height: c_int,
        most: c_int,
        capacity: c_int,
        positions: *mut f32,
        descriptors: *mut u8,
        reason: *mut c_char,
        reason_size: usize,
    ) -> c_int;
}

/// Positions in pixels, where (0, 0) is the corner of the photo, and the descriptors.
pub type Detected = (Vec<Vec2>, Vec<[u8; 128]>);

/// Detects and describes the `most` strongest key points. Key points as strong as the last of these
/// are added, up to 2 x `most` in all.
///
/// # Errors
/// When OpenCV refuses the picture.
pub fn detect(photo: &GrayImage, most: usize) -> Result<Detected> {
    let capacity = 2 * most;
    let mut positions = vec![[0.0f32; 2]; capacity];
    let mut descriptors = vec![[0u8; 128]; capacity];
    let (width, height) = (side(photo.width())?, side(photo.height())?);
    // SAFETY: `photo` holds width x height bytes, which are only read. The function writes at most
    // `capacity` positions and descriptors, and at most `reason_size` bytes with the final zero.
    let count = checked("SIFT", |reason, reason_size| unsafe {
        fastlgs_opencv_sift(
            photo.as_raw().as_ptr(),
            width,
            height,
            most as c_int,
            capacity as c_int,
            positions.as_mut_ptr().cast(),
            descriptors.as_mut_ptr().cast(),
            reason,
            reason_size,
        )
    })?;
    descriptors.truncate(count);
    // SIFT doubles the picture first. OpenCV's origin is the centre of the first doubled pixel,
    // 0.25 photo pixels from the photo's corner.
    let positions = positions[..count]
        .iter()
        .map(|[x, y]| Vec2::new(x + 0.25, y + 0.25))
        .collect();
    Ok((positions, descriptors))
}
