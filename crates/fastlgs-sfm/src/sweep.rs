//! Plane sweep stereo: computes initial points from photos with known poses, so that training also
//! starts with surfaces between key points.
//!
//! Depth maps are computed as by Collins 1996 and merged as by Schoenberger et al. 2016: several
//! photos must agree on the depth of a point.

use crate::tracks::Track;
use fastlgs_core::dataset::SfmPoint;
use fastlgs_core::{Camera, image_io, vectorised};
use glam::{Mat3, Vec2, Vec3};
use image::RgbImage;
use rayon::prelude::*;

/// Longer side of the swept photos, in pixels. One point per pixel of these is dense enough for
/// initialisation.
const SWEEP_SIDE: u32 = 240;
/// Number of depth planes, uniform in 1 / depth.
const PLANES: usize = 96;
/// Number of neighbours that each photo is compared with.
const NEIGHBOURS: usize = 4;
/// Allowed parallax of a neighbour, in degrees. Smaller angles do not determine depth; at larger
/// ones most patches look different. Neighbours with the smallest parallax are taken first, so
/// large angles matter only if photos are few.
const PARALLAX: [f32; 2] = [2.0, 60.0];
/// Radius of a patch in pixels; its side is 2 * PATCH_RADIUS + 1.
const PATCH_RADIUS: usize = 3;
/// Smallest correlation of an accepted depth.
const MIN_CORRELATION: f32 = 0.7;
/// Smallest difference between the best correlation and that at any other depth.
const MIN_SCORE_MARGIN: f32 = 0.05;
/// Planes up to this distance from the best one count as the same depth.
const SAME_DEPTH_PLANES: u32 = 3;
/// Smallest standard deviation of a patch, in grey values of 255. Smaller ones are noise.
const MIN_PATCH_DEVIATION: f32 = 3.0;
/// Number of other photos that must find the same depth, within one pixel.
const MIN_AGREEING_VIEWS: usize = 2;
/// A point replaces other points within `SPACING` pixels if their relative depth difference is
/// below `SAME_DEPTH`.
const SPACING: usize = 1;
const SAME_DEPTH: f32 = 0.05;
/// Smallest number of tracks that determine the depth range of a photo.
const MIN_TRACKS: usize = 10;
/// Share of the nearest and farthest track depths that is ignored, and the factor by which the
/// remaining range is extended.
const OUTLIERS: f32 = 0.02;
const RANGE_FACTOR: f32 = 1.3;

/// A swept photo: grey values 0 to 255, colours and camera at reduced size.
struct View {
    camera: Camera,
    grey: Vec<f32>,
    color: RgbImage,
    /// Nearest and farthest depth, in scene units; `None` without tracks.
    bounds: Option<[f32; 2]>,
}

impl View {
    fn width(&self) -> usize {
        self.camera.width as usize
    }

    fn height(&self) -> usize {
        self.camera.height as usize
    }

    /// Returns the world position at a depth along the ray through a pixel's centre.
    fn point(&self, pixel: usize, depth: f32) -> Vec3 {
        self.camera.point_at(pixel, depth)
    }
}

/// Returns surface points on which the photos of `cameras` agree. `tracks` determine the depth
/// range of each photo. `advance` is called after each photo.
///
/// # Errors
/// Errors of `photo` and of `advance`.
pub fn points<E: Send>(
    cameras: &[Camera],
    tracks: &[Track],
    photo: impl Fn(&Camera) -> Result<RgbImage, E> + Sync,
    advance: impl Fn() -> Result<(), E> + Sync,
) -> Result<Vec<SfmPoint>, E> {
    let bounds = bounds(cameras, tracks);
    let view = |(camera, bounds): (&Camera, Option<[f32; 2]>)| {
        let camera = &camera.shrunk_to(SWEEP_SIDE);
        let color = image_io::resize(&photo(camera)?, camera.width, camera.height);
        let grey = color
            .pixels()
            .map(|p| 0.299 * f32::from(p[0]) + 0.587 * f32::from(p[1]) + 0.114 * f32::from(p[2]))
            .collect();
        Ok(View {
            camera: camera.clone(),
            grey,
            color,
            bounds,
        })
    };
    let views: Vec<View> = cameras
        .par_iter()
        .zip(bounds)
        .map(view)
        .collect::<Result<_, E>>()?;
    let neighbours: Vec<Vec<usize>> = (0..views.len()).map(|v| neighbours(&views, v)).collect();
    let depths = (0..views.len()).into_par_iter().map(|v| {
        let depths = depths(&views, v, &neighbours[v]);
        advance().map(|()| depths)
    });
    let depths = depths.collect::<Result<Vec<_>, E>>()?;
    Ok(merged(&views, &neighbours, &depths))
}

/// Returns the depth range of each camera from its tracks. With too few of its own, it uses all
/// tracks in front of the camera.
fn bounds(cameras: &[Camera], tracks: &[Track]) -> Vec<Option<[f32; 2]>> {
    let mut own: Vec<Vec<f32>> = vec![Vec::new(); cameras.len()];
    let depth = |view: usize, p: Vec3| cameras[view].world_to_camera.transform_point3(p).z;
    for track in tracks {
        track
            .key_points
            .iter()
            .for_each(|&(view, _)| own[view].push(depth(view, track.position)));
    }
    let all = |view: usize| {
        tracks
            .iter()
            .map(|t| depth(view, t.position))
            .filter(|z| *z > 0.0)
            .collect::<Vec<_>>()
    };
    let of = |(view, mut depths): (usize, Vec<f32>)| {
        if depths.len() < MIN_TRACKS {
            depths = all(view);
        }
        depths.sort_by(f32::total_cmp);
        let last = depths.len().checked_sub(1)?;
        let cut = (OUTLIERS * last as f32) as usize;
        Some([
            depths[cut] / RANGE_FACTOR,
            depths[last - cut] * RANGE_FACTOR,
        ])
    };
    own.into_iter().enumerate().map(of).collect()
}

/// Returns the neighbours of a view, sorted by parallax at the centre of its depth range.
/// Neighbours outside `PARALLAX` are left out.
fn neighbours(views: &[View], view: usize) -> Vec<usize> {
    let own = &views[view];
    let Some([near, far]) = own.bounds else {
        return Vec::new();
    };
    let middle = own.camera.centre() + own.camera.forward() * (near * far).sqrt();
    let angle = |other: &View| {
        (own.camera.centre() - middle)
            .angle_between(other.camera.centre() - middle)
            .to_degrees()
    };
    let turned = |other: &View| {
        own.camera
            .forward()
            .angle_between(other.camera.forward())
            .to_degrees()
    };
    let has_usable_parallax =
        |&(_, angle): &(usize, f32)| (PARALLAX[0]..PARALLAX[1]).contains(&angle);
    let others = (0..views.len()).filter(|&v| v != view && turned(&views[v]) < PARALLAX[1]);
    let mut others: Vec<(usize, f32)> = others
        .map(|v| (v, angle(&views[v])))
        .filter(has_usable_parallax)
        .collect();
    others.sort_by(|a, b| a.1.total_cmp(&b.1).then(a.0.cmp(&b.0)));
    others.into_iter().take(NEIGHBOURS).map(|o| o.0).collect()
}

/// Returns the depth of each pixel whose patch is found in the neighbours at exactly one depth; 0
/// for other pixels.
fn depths(views: &[View], view: usize, neighbours: &[usize]) -> Vec<f32> {
    let own = &views[view];
    let (w, h) = (own.width(), own.height());
    let mut out = vec![0.0; w * h];
    let (Some([near, far]), true) = (own.bounds, neighbours.len() >= MIN_AGREEING_VIEWS) else {
        return out;
    };
    let inverse = |plane: f32| 1.0 / far + (1.0 / near - 1.0 / far) * plane / (PLANES - 1) as f32;
    let patches = Patches::of(&own.grey, w, h);
    let mut work = Buffers::new(w * h);
    // `[plane][pixel]`: mean of the two best neighbours. The others may be occluded.
    let mut scores = vec![-1.0f32; PLANES * w * h];
    for (plane, scores) in scores.chunks_exact_mut(w * h).enumerate() {
        let mut second = vec![-1.0f32; w * h];
        for &other in neighbours {
            warp(
                own,
                &views[other],
                1.0 / inverse(plane as f32),
                &mut work.warped,
            );
            correlate(&own.grey, &patches, w, h, &mut work);
            for ((best, second), score) in scores.iter_mut().zip(&mut second).zip(&work.score) {
                *second = second.max(score.min(*best));
                *best = best.max(*score);
            }
        }
        scores
            .iter_mut()
            .zip(second)
            .for_each(|(best, second)| *best = 0.5 * (*best + second));
    }
    let (best_planes, elsewhere) = best_planes(&scores, w * h);
    for (pixel, depth) in out.iter_mut().enumerate() {
        let score = |plane: usize| scores[plane * w * h + pixel];
        let best = best_planes[pixel] as usize;
        if best == 0
            || best == PLANES - 1
            || score(best) < MIN_CORRELATION
            || score(best) - elsewhere[pixel] < MIN_SCORE_MARGIN
            || patches.deviation[pixel] < MIN_PATCH_DEVIATION
        {
            continue;
        }
        // Vertex of the parabola through the scores of three planes.
        let [before, top, after] = [score(best - 1), score(best), score(best + 1)];
        let shift = 0.5 * (before - after) / (before - 2.0 * top + after).min(-1e-6);
        *depth = 1.0 / inverse(best as f32 + shift.clamp(-0.5, 0.5));
    }
    out
}

/// Returns for each pixel the plane with the largest score, the last one of equal ones, and the
/// largest score of planes at other depths. `scores` is `[plane][pixel]`.
fn best_planes(scores: &[f32], pixels: usize) -> (Vec<u32>, Vec<f32>) {
    let (mut planes, mut top) = (vec![0u32; pixels], vec![f32::NEG_INFINITY; pixels]);
    for (plane, scores) in (0..).zip(scores.chunks_exact(pixels)) {
        for ((best, top), score) in planes.iter_mut().zip(&mut top).zip(scores) {
            if score >= top {
                (*best, *top) = (plane, *score);
            }
        }
    }
    let mut elsewhere = vec![-1.0f32; pixels];
    for (plane, scores) in (0u32..).zip(scores.chunks_exact(pixels)) {
        for ((elsewhere, best), score) in elsewhere.iter_mut().zip(&planes).zip(scores) {
            if plane.abs_diff(*best) > SAME_DEPTH_PLANES {
                *elsewhere = elsewhere.max(*score);
            }
        }
    }
    (planes, elsewhere)
}

/// Mean and standard deviation of the patch around each pixel.
struct Patches {
    mean: Vec<f32>,
    deviation: Vec<f32>,
}

impl Patches {
    fn of(grey: &[f32], w: usize, h: usize) -> Self {
        let mut work = Buffers::new(grey.len());
        work.warped.copy_from_slice(grey);
        let (mut mean, mut square) = (vec![0.0; grey.len()], vec![0.0; grey.len()]);
        box_mean(&work.warped, w, h, &mut work.rows, &mut mean);
        work.product
            .iter_mut()
            .zip(grey)
            .for_each(|(p, g)| *p = g * g);
        box_mean(&work.product, w, h, &mut work.rows, &mut square);
        let deviation = mean
            .iter()
            .zip(&square)
            .map(|(m, s)| (s - m * m).max(0.0).sqrt())
            .collect();
        Self { mean, deviation }
    }
}

/// Reusable buffers, one value per pixel.
struct Buffers {
    warped: Vec<f32>,
    product: Vec<f32>,
    rows: Vec<f32>,
    mean: Vec<f32>,
    square: Vec<f32>,
    cross: Vec<f32>,
    score: Vec<f32>,
}

impl Buffers {
    fn new(pixels: usize) -> Self {
        let plane = || vec![0.0; pixels];
        Self {
            warped: plane(),
            product: plane(),
            rows: plane(),
            mean: plane(),
            square: plane(),
            cross: plane(),
            score: plane(),
        }
    }
}

vectorised! {
    /// Warps `other` into `own` for a plane at `depth`: grey values, NaN outside of `other`.
    fn warp(own: &View, other: &View, depth: f32, out: &mut [f32]) = warp_body
}

#[inline(always)]
fn warp_body<const FMA: bool>(own: &View, other: &View, depth: f32, out: &mut [f32]) {
    let relative = other.camera.world_to_camera * own.camera.world_to_camera.inverse();
    // A ray r (z = 1) of `own` at this depth has the direction R r + t / depth in `other`.
    let (turn, shift) = (
        Mat3::from_mat4(relative),
        relative.w_axis.truncate() / depth,
    );
    let (w, h) = (other.width(), other.height());
    let step = turn * (own.camera.ray(Vec2::new(1.0, 0.0)) - own.camera.ray(Vec2::ZERO));
    let camera = &other.camera;
    let (most_x, most_y) = ((w - 1) as f32, (h - 1) as f32);
    let mut places = vec![[0.0f32; 2]; own.width()];
    for (y, row) in out.chunks_exact_mut(own.width()).enumerate() {
        let first = turn * own.camera.ray(Vec2::new(0.5, y as f32 + 0.5)) + shift;
        // This loop is vectorised; the next one, which reads the photo, is not.
        for (x, place) in places.iter_mut().enumerate() {
            let x = x as f32;
            let z = first.z + x * step.z;
            let u = camera.fx * (first.x + x * step.x) / z + camera.cx - 0.5;
            let v = camera.fy * (first.y + x * step.y) / z + camera.cy - 0.5;
            let inside = (z > 0.0) & (u >= 0.0) & (v >= 0.0) & (u < most_x) & (v < most_y);
            *place = if inside { [u, v] } else { [f32::NAN; 2] };
        }
        for (value, [u, v]) in row.iter_mut().zip(&places) {
            *value = if u.is_nan() {
                f32::NAN
            } else {
                bilinear(&other.grey, w, *u, *v)
            };
        }
    }
}

/// Interpolates between the four pixels around a place, whose upper left one is at (u, v) rounded
/// down.
#[inline(always)]
fn bilinear(grey: &[f32], w: usize, u: f32, v: f32) -> f32 {
    let (x, y) = (u as usize, v as usize);
    let (u, v) = (u - x as f32, v - y as f32);
    let at = y * w + x;
    let [a, b, c, d] = [grey[at], grey[at + 1], grey[at + w], grey[at + w + 1]];
    (a * (1.0 - u) + b * u) * (1.0 - v) + (c * (1.0 - u) + d * u) * v
}

vectorised! {
    /// Writes the normalised correlation of each patch of `grey` and `work.warped` into
    /// `work.score`: 1 if they are equal, -1 if a patch extends beyond its image.
    fn correlate(grey: &[f32], patches: &Patches, w: usize, h: usize, work: &mut Buffers) = correlate_body
}

#[inline(always)]
fn correlate_body<const FMA: bool>(
    grey: &[f32],
    patches: &Patches,
    w: usize,
    h: usize,
    work: &mut Buffers,
) {
    box_mean(&work.warped, w, h, &mut work.rows, &mut work.mean);
    work.product
        .iter_mut()
        .zip(&work.warped)
        .for_each(|(p, v)| *p = v * v);
    box_mean(&work.product, w, h, &mut work.rows, &mut work.square);
    work.product
        .iter_mut()
        .zip(&work.warped)
        .zip(grey)
        .for_each(|((p, v), g)| *p = v * g);
    box_mean(&work.product, w, h, &mut work.rows, &mut work.cross);
    for p in 0..w * h {
        let covariance = work.cross[p] - work.mean[p] * patches.mean[p];
        let deviation = (work.square[p] - work.mean[p] * work.mean[p])
            .max(0.25)
            .sqrt();
        let score = covariance / (deviation * patches.deviation[p].max(0.5));
        work.score[p] = if score.is_nan() { -1.0 } else { score };
    }
}

/// Computes the mean over each patch; NaN if the patch extends beyond the image.
#[inline(always)]
fn box_mean(plane: &[f32], w: usize, h: usize, rows: &mut [f32], out: &mut [f32]) {
    const SIDES: usize = 2 * PATCH_RADIUS + 1;
    const SHARE: f32 = 1.0 / (SIDES * SIDES) as f32;
    rows.fill(f32::NAN);
    out.fill(f32::NAN);
    if w < SIDES || h < SIDES {
        return;
    }
    for (from, to) in plane.chunks_exact(w).zip(rows.chunks_exact_mut(w)) {
        for x in 0..w - SIDES + 1 {
            to[x + PATCH_RADIUS] = (0..SIDES).map(|k| from[x + k]).sum();
        }
    }
    for y in PATCH_RADIUS..h - PATCH_RADIUS {
        let to = &mut out[y * w..][..w];
        to.fill(0.0);
        for k in 0..SIDES {
            let from = &rows[(y + k - PATCH_RADIUS) * w..][..w];
            to.iter_mut().zip(from).for_each(|(t, f)| *t += f * SHARE);
        }
    }
}

/// Returns one point for each surface position on which several depth maps agree. Pixels that a
/// point covers, in any view, create no further point.
fn merged(views: &[View], neighbours: &[Vec<usize>], depths: &[Vec<f32>]) -> Vec<SfmPoint> {
    let mut used: Vec<Vec<bool>> = depths.iter().map(|d| vec![false; d.len()]).collect();
    let mut out = Vec::new();
    for (v, view) in views.iter().enumerate() {
        for pixel in 0..depths[v].len() {
            if depths[v][pixel] <= 0.0 || used[v][pixel] {
                continue;
            }
            let point = view.point(pixel, depths[v][pixel]);
            let (mut sum, mut seen_by) = (point, vec![v as u32]);
            for &other in &neighbours[v] {
                let Some((other_pixel, _)) = views[other].camera.pixel_and_depth(point) else {
                    continue;
                };
                let seen = views[other].point(other_pixel, depths[other][other_pixel]);
                let apart = (pixel as isize
                    - view
                        .camera
                        .pixel_and_depth(seen)
                        .map_or(-1, |s| s.0 as isize))
                .unsigned_abs();
                // The same pixel, or an adjacent one.
                let touches =
                    [0, 1, view.width() - 1, view.width(), view.width() + 1].contains(&apart);
                if depths[other][other_pixel] > 0.0 && touches {
                    sum += seen;
                    seen_by.push(other as u32);
                }
            }
            if seen_by.len() > MIN_AGREEING_VIEWS {
                let position = sum / seen_by.len() as f32;
                let color = view
                    .color
                    .get_pixel((pixel % view.width()) as u32, (pixel / view.width()) as u32)
                    .0;
                out.push(SfmPoint {
                    position,
                    color,
                    seen_by,
                });
                views
                    .iter()
                    .zip(depths)
                    .zip(&mut used)
                    .for_each(|((view, depths), used)| cover(view, depths, position, used));
            }
        }
    }
    out
}

/// Marks the pixels around a point that have about its depth. One point per pixel would be denser
/// than needed.
fn cover(view: &View, depths: &[f32], point: Vec3, used: &mut [bool]) {
    let Some((pixel, depth)) = view.camera.pixel_and_depth(point) else {
        return;
    };
    let (x, y) = (pixel % view.width(), pixel / view.width());
    for y in y.saturating_sub(SPACING)..(y + SPACING + 1).min(view.height()) {
        for x in x.saturating_sub(SPACING)..(x + SPACING + 1).min(view.width()) {
            let at = y * view.width() + x;
            used[at] |= (depths[at] / depth - 1.0).abs() < SAME_DEPTH;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Grey value at a point of a textured wall: waves of several lengths.
    fn texture(p: Vec3) -> f32 {
        let wave =
            |k: f32| (k * p.x + 0.7 * k * p.y).sin() * (0.6 * k * p.y - 0.3 * k * p.x + k).cos();
        127.0 + 40.0 * wave(7.0) + 30.0 * wave(19.0) + 25.0 * wave(41.0)
    }

    /// Renders a photo of the wall z = 0. It has no texture where x > 1.
    fn photo(camera: &Camera) -> RgbImage {
        let (eye, turn) = (
            camera.centre(),
            Mat3::from_mat4(camera.world_to_camera).transpose(),
        );
        RgbImage::from_fn(camera.width, camera.height, |x, y| {
            let ray = turn * camera.ray(Vec2::new(x as f32 + 0.5, y as f32 + 0.5));
            let p = eye - ray * (eye.z / ray.z);
            let grey = if p.x > 1.0 { 90.0 } else { texture(p) };
            image::Rgb([grey as u8, (0.5 * grey) as u8, 10])
        })
    }

    #[test]
    fn a_wall_is_found_where_it_has_texture() {
        let eye = |k: usize| Vec3::new(-1.0 + 0.5 * k as f32, 0.3, 4.0);
        let cameras: Vec<Camera> = (0..5)
            .map(|k| Camera::look_at(&k.to_string(), eye(k), Vec3::ZERO, Vec3::Y, 160, 120, 0.8))
            .collect();
        // The tracks only determine the depth range.
        let track = |k: usize| Track {
            key_points: (0..5).map(|v| (v, k)).collect(),
            position: Vec3::new(0.1 * k as f32 - 1.0, 0.0, 0.0),
            error: 0.5,
        };
        let tracks: Vec<Track> = (0..20).map(track).collect();
        let found = points(&cameras, &tracks, |c| Ok::<_, ()>(photo(c)), || Ok(())).unwrap();
        assert!(found.len() > 1000, "{} points", found.len());
        let near = found.iter().filter(|p| p.position.z.abs() < 0.05).count();
        assert!(
            near as f32 > 0.98 * found.len() as f32,
            "{near} of {} points lie on the wall",
            found.len()
        );
        let bare = found.iter().filter(|p| p.position.x > 1.1).count();
        assert!(
            bare < found.len() / 50,
            "{bare} points on the part without texture"
        );
        let shows = |p: &SfmPoint, view: u32| {
            let camera = &cameras[view as usize];
            let pixel = camera.to_pixel(camera.world_to_camera.transform_point3(p.position));
            (0.0..160.0).contains(&pixel.x) && (0.0..120.0).contains(&pixel.y)
        };
        assert!(
            found.iter().all(|p| p.seen_by.len() > MIN_AGREEING_VIEWS
                && p.seen_by.iter().all(|view| shows(p, *view))),
            "each photo in seen_by must see the point"
        );
        let right = |p: &&SfmPoint| (f32::from(p.color[0]) - texture(p.position)).abs() < 25.0;
        assert!(
            found.iter().filter(right).count() as f32 > 0.95 * found.len() as f32,
            "points must have the colours of the wall"
        );
        assert!(
            points(&cameras, &[], |c| Ok::<_, ()>(photo(c)), || Ok(()))
                .unwrap()
                .is_empty(),
            "without tracks there is no depth range and no point"
        );
    }
}
