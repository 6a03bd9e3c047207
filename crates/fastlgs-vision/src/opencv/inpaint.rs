//! Inpainting by Telea's fast marching (`inpaint.cpp`).

use super::{checked, side};
use crate::Result;
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

/// Fills the pixels of `picture` where `hole`, of the same size, is not 0, from what lies within `radius` pixels of them.
///
/// # Errors
/// When OpenCV refuses the picture.
pub fn telea(picture: &mut RgbImage, hole: &GrayImage, radius: f32) -> Result<()> {
    assert_eq!(picture.dimensions(), hole.dimensions(), "a hole of the picture's size");
    let (width, height) = (side(picture.width())?, side(picture.height())?);
    // SAFETY: the picture holds 3 x width x height bytes, which are read and written, the hole a third of them, which are only read; the reason
    // has the room that is named, and the function writes no more than that, with its final zero.
    checked("inpainting", |reason, reason_size| unsafe {
        fastlgs_opencv_inpaint(picture.as_mut_ptr(), hole.as_ptr(), width, height, radius, reason, reason_size)
    })?;
    Ok(())
}
