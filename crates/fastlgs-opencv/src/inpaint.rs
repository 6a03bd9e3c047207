//! Inpainting by Telea's fast marching (`inpaint.cpp`).

use crate::{Result, checked, side};
use image::{GrayImage, RgbImage};
use std::ffi::{c_char, c_int};

unsafe extern "C" {
    fn fastlgs_opencv_inpaint(
        pixels: *mut u8,
        hole: *const u8,
        width: c_int,
        height: c_int,
        radius: f32,
        reason: *mut c_char,
        reason_size: usize,
    ) -> c_int;
}

/// Fills the pixels of `picture` where `hole` is not 0, from pixels within `radius` pixels. Both
/// have the same size.
///
/// # Errors
/// When OpenCV refuses the picture.
pub fn telea(picture: &mut RgbImage, hole: &GrayImage, radius: f32) -> Result<()> {
    assert_eq!(
        picture.dimensions(),
        hole.dimensions(),
        "the hole must have the size of the picture"
    );
    let (width, height) = (side(picture.width())?, side(picture.height())?);
    // SAFETY: `picture` holds 3 x width x height bytes, which are read and written. `hole` holds
    // width x height bytes, which are only read. The function writes at most `reason_size` bytes to
    // `reason`, including the final zero.
    checked("inpainting", |reason, reason_size| unsafe {
        fastlgs_opencv_inpaint(
            picture.as_mut_ptr(),
            hole.as_ptr(),
            width,
            height,
            radius,
            reason,
            reason_size,
        )
    })?;
    Ok(())
}
