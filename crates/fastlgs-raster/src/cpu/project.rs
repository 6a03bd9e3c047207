//! CPU twin of `shaders/project.wgsl`: projection of Gaussians into a view.

use super::footprint::{Footprint, span};
use super::harmonics::basis;
use super::{ALPHA_MAX, ALPHA_MIN, NEAR, SOLID_OPACITY, Splat, covariance, pcg3d};
use crate::View;
use crate::view::{DEPTH_MOMENTS, TILE, stride};
use fastlgs_core::gaussians::{BASE_CHANNELS, SH_C0, TRANSPARENT_LOGIT, rest_len, sigmoid};
use glam::{Mat4, UVec3, Vec2, Vec3};

/// A Gaussian projected into the image.
#[derive(Clone, Copy)]
pub(crate) struct Projected {
    pub splat: Splat,
    /// 24-bit key, ascending with depth.
    pub depth: u32,
    pub footprint: Footprint,
}

/// Depth key of a Gaussian that is not drawn. It sorts last.
pub(crate) const NOT_DRAWN: u32 = 0xff_ffff;

/// Projects the Gaussians of a page. Gaussians that touch no tile are not drawn.
pub fn project(
    view: &View,
    params: &[f32],
    splats: &mut [Splat],
    depths: &mut [u32],
    footprints: &mut [Footprint],
    touched: &mut [u32],
) {
    let (page, first) = (view.page as usize, view.first as usize);
    for i in 0..page {
        let g = first + i;
        (depths[g], touched[g]) = (NOT_DRAWN, 0);
        let Some(p) = project_one(view, g as u32, |c| params[c * stride(page) + i]) else {
            continue;
        };
        let [top, bottom] = [p.footprint[1][2], p.footprint[1][3]].map(|row| row as u32);
        let tiles = (top..bottom)
            .map(|row| span(&p.footprint, row, view.tiles[0]).len() as u32)
            .sum();
        if tiles > 0 {
            (splats[g], depths[g], footprints[g], touched[g]) =
                (p.splat, p.depth, p.footprint, tiles);
        }
    }
}

/// Projects Gaussian `g`; `param` returns the value of a channel. Returns none if the Gaussian is
/// not drawn. Does not check whether it touches a tile.
#[inline(always)]
pub(crate) fn project_one(view: &View, g: u32, param: impl Fn(usize) -> f32) -> Option<Projected> {
    if view.dropped > 0 && pcg3d(UVec3::new(g, view.draw, 2)).x < view.dropped {
        return None;
    }
    let param3 = |c: usize| Vec3::new(param(c), param(c + 1), param(c + 2));
    let mean = param3(0);
    let t = Mat4::from_cols_array(&view.world_to_camera).transform_point3(mean);
    let s = param3(3).map(f32::exp);
    if t.z.is_nan() || t.z <= NEAR * s.length() {
        return None;
    }
    let r = covariance::rotation(&param).1;
    let [jx, jy] = covariance::affine(t, view);
    let (ax, ay) = (r.transpose() * jx * s, r.transpose() * jy * s);
    let cov = covariance::dilated(ax, ay);
    let (cxx, cxy, cyy) = (cov.x, cov.y, cov.z);
    let dets = covariance::determinants(ax, ay);
    let det = dets[1];
    let logit = param(10);
    let own = if view.solid == 1 && logit <= TRANSPARENT_LOGIT {
        SOLID_OPACITY
    } else {
        sigmoid(logit)
    };
    let opacity = view.kept_gain() * covariance::compensation(dets, view) * own;
    if opacity.is_nan() || opacity < ALPHA_MIN {
        return None;
    }
    let center = Vec2::from(view.focal) * t.truncate() / t.z + Vec2::from(view.centre);
    // Squared Mahalanobis radius of the ellipse on which alpha equals ALPHA_MIN, slightly enlarged
    // so that rounding loses no pixel.
    let reach2 = 2.002 * (opacity / ALPHA_MIN).ln() + 1e-4;
    let half_height = (reach2 * cyy).sqrt();
    let finite = det > 0.0
        && det < 1e30
        && center.x.abs() < 1e9
        && center.y.abs() < 1e9
        && half_height < 1e9
        && cxx < 1e15;
    if !finite {
        return None;
    }
    let (size, rows) = (TILE as f32, view.tiles[1] as f32);
    let first_row = (((center.y - half_height + 0.5) / size).ceil() - 1.0).clamp(0.0, rows);
    let end_row = (((center.y + half_height - 0.5) / size).floor() + 1.0).clamp(0.0, rows);
    let footprint = [
        [center.x, center.y, cxy / cyy, det / (cyy * cyy)],
        [
            reach2 * cyy,
            (reach2 / cxx).sqrt() * cxy,
            first_row,
            end_row,
        ],
    ];
    let color = color_of(view, mean, &param).max(Vec3::ZERO);
    let f = match view.depth_as_feature {
        0 => param3(14),
        DEPTH_MOMENTS => Vec3::new(t.z.ln(), t.z.ln() * t.z.ln(), 1.0),
        _ => Vec3::new(t.z, 0.0, 0.0),
    };
    let log2e = std::f32::consts::LOG2_E;
    let (qa, qb, qc) = (cyy / det, -cxy / det, cxx / det);
    let splat = [
        [center.x, center.y, -0.5 * log2e * qa, -log2e * qb],
        [
            -0.5 * log2e * qc,
            opacity.min(ALPHA_MAX).log2(),
            color.x,
            color.y,
        ],
        [color.z, f.x, f.y, f.z],
    ];
    Some(Projected {
        splat,
        depth: (t.z.to_bits() >> 7).min(NOT_DRAWN - 1),
        footprint,
    })
}

/// Returns the colour before it is clamped at 0.
#[inline(always)]
fn color_of(view: &View, mean: Vec3, param: impl Fn(usize) -> f32) -> Vec3 {
    let param3 = |c: usize| Vec3::new(param(c), param(c + 1), param(c + 2));
    let mut color = Vec3::splat(0.5) + SH_C0 * param3(11);
    if view.sh_degree > 0 {
        let b = basis((mean - Vec3::from_slice(&view.camera)).normalize());
        for k in 0..rest_len(view.sh_degree) {
            color += b[k] * param3(BASE_CHANNELS + 3 * k);
        }
    }
    color
}
