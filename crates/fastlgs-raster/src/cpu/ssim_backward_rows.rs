use super::ssim_rows::blur_row;
use crate::view::Plane;

/// Twin of `shaders/ssim_backward_rows.wgsl`.
pub fn ssim_backward_rows(plane: &Plane, partials: &[f32], rows: &mut [f32]) {
    let (w, h) = (4 * plane.quads as usize, plane.rows as usize / 2);
    for (row, out) in partials.chunks_exact(w).zip(rows.chunks_exact_mut(w)).take(3 * h) {
        out.iter_mut().enumerate().for_each(|(i, out)| *out = blur_row(row, i));
    }
}
