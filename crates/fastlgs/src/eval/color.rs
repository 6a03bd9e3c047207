//! Measures colour on held-out views: with the given poses, with aligned poses, and with aligned
//! poses and fitted exposures.

use crate::compared::Compared;
use crate::{Result, Scene, train};
use fastlgs_core::{Camera, metrics};
use fastlgs_raster::{Target, align};

/// Colour accuracy: means over the held-out views.
#[derive(Clone, Copy, Debug, Default)]
pub struct Quality {
    /// PSNR in dB.
    pub psnr: f64,
    /// SSIM.
    pub ssim: f64,
    /// PSNR in dB after the pose of each view is aligned to the scene. Wrong poses of the held-out
    /// photos do not lower it.
    pub psnr_aligned: f64,
    /// PSNR in dB after a gain and an offset of each channel are fitted to each photo as well.
    /// Different exposures do not lower it.
    pub psnr_affine: f64,
}

/// Measures the held-out views in which any pixel counts; `None` if there are none.
pub fn quality(scene: &mut Scene) -> Result<Option<Quality>> {
    let cameras = scene.manifest().held_out(scene.cameras());
    let background = train::Background {
        color: scene.trained().background,
        learn: false,
    };
    let mut sum = Quality::default();
    let mut views = 0;
    for camera in &cameras {
        let target = train::target(scene.folder(), camera, None, &background)?;
        let given = scene.render(camera)?;
        let Some(compared) = Compared::of(&target, given.color()) else {
            continue;
        };
        views += 1;
        sum.psnr += compared.psnr();
        let [w, h] = [camera.width, camera.height].map(|side| side as usize);
        sum.ssim += metrics::ssim(&compared.rendered, &compared.photo, w, h, &compared.counts);
        let camera = align_camera(scene, &target)?;
        let aligned = scene.render(&camera)?;
        let Some(mut compared) = Compared::of(&target, aligned.color()) else {
            continue;
        };
        sum.psnr_aligned += compared.psnr();
        compared.fit_exposure();
        sum.psnr_affine += compared.psnr();
    }
    let mean = |v: f64| v / f64::from(views);
    let Quality {
        psnr,
        ssim,
        psnr_aligned,
        psnr_affine,
    } = sum;
    let all = Quality {
        psnr: mean(psnr),
        ssim: mean(ssim),
        psnr_aligned: mean(psnr_aligned),
        psnr_affine: mean(psnr_affine),
    };
    Ok((views > 0).then_some(all))
}

/// Returns the camera of a view with its pose aligned to the scene.
fn align_camera(scene: &mut Scene, target: &Target) -> Result<Camera> {
    let (trained, gaussians) = (scene.trained().clone(), scene.gaussians().len());
    let degree = scene.gaussians().sh_degree;
    let frame = |camera: &Camera| trained.view_of(camera, gaussians, degree);
    Ok(align::align(
        scene.engine(),
        frame,
        target,
        &Default::default(),
        align::STEPS,
    )?)
}
