//! The equations of bundle adjustment, and their solution by Levenberg-Marquardt.

use crate::conjugate_gradients;
use fastlgs_core::Camera;
use glam::{DMat3, DMat4, DQuat, DVec2, DVec3};
use nalgebra::{DVector, Matrix2x3, SMatrix, SVector};
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Prior standard deviation of a lens: of the logarithm of its focal length, and of k1.
const LENS_DEVIATION: f64 = 0.1;
/// Smallest number of observations for which a camera's pose is adjusted.
const MIN_OBSERVATIONS: usize = 20;
/// Scale of Cauchy's loss in pixels: larger errors count less.
const LOSS_SCALE: f64 = 1.0;
/// Relative accuracy of a Levenberg-Marquardt step. More accurate steps take longer and gain
/// nothing, because the equations are only linear near the current values.
const STEP_TOLERANCE: f64 = 1e-2;
/// Largest number of Levenberg-Marquardt steps in a round.
const BUNDLE_STEPS: usize = 12;

/// A lens that several photos share.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Lens {
    pub log_focal: f64,
    pub k1: f64,
}

#[derive(Clone, Copy)]
pub(super) struct Pose {
    rotation: DMat3,
    translation: DVec3,
}

/// The unknowns of the adjustment.
#[derive(Clone)]
pub(super) struct Values {
    pub poses: Vec<Pose>,
    pub lenses: Vec<Lens>,
    pub points: Vec<DVec3>,
}

/// A key point, in pixels, that shows a point of the scene.
#[derive(Clone, Copy)]
pub(super) struct Observation {
    pub view: usize,
    pub pixel: DVec2,
}

pub(super) struct Problem<'a> {
    pub cameras: &'a [Camera],
    /// Index of each camera's lens; `None` if the lens is not adjusted.
    pub lens: Vec<Option<usize>>,
    /// Observations of each point.
    pub seen: Vec<Vec<Observation>>,
}

/// Number of parameters of a pose: rotation vector and translation.
const POSE_PARAMETERS: usize = 6;
/// Number of parameters of a pose and its lens.
const CAMERA_PARAMETERS: usize = POSE_PARAMETERS + 2;
/// Derivatives of a pixel by rotation, translation and lens of its camera.
type ByCamera = SMatrix<f64, 2, CAMERA_PARAMETERS>;
/// Block of the normal matrix that couples the parameters of two cameras.
type CameraBlock = SMatrix<f64, CAMERA_PARAMETERS, CAMERA_PARAMETERS>;
/// Block of the normal matrix that couples the parameters of a camera with a point.
type Coupling = SMatrix<f64, CAMERA_PARAMETERS, 3>;

impl Pose {
    pub fn of(camera: &Camera) -> Self {
        let pose = camera.world_to_camera.as_dmat4();
        Self {
            rotation: DMat3::from_mat4(pose),
            translation: pose.w_axis.truncate(),
        }
    }

    /// Returns this pose followed by a small rotation and translation: q becomes exp(turn) q +
    /// shift.
    fn nudged(&self, turn: DVec3, shift: DVec3) -> Self {
        let turn = DMat3::from_quat(DQuat::from_scaled_axis(turn));
        Self {
            rotation: turn * self.rotation,
            translation: turn * self.translation + shift,
        }
    }
}

impl Values {
    /// Writes poses and focal lengths into `cameras`; their other values stay unchanged.
    pub fn apply(&self, problem: &Problem, cameras: &mut [Camera]) {
        for (view, camera) in cameras.iter_mut().enumerate() {
            let Pose {
                rotation,
                translation,
            } = self.poses[view];
            let mut pose =
                DMat4::from_mat3(DMat3::from_quat(DQuat::from_mat3(&rotation).normalize()));
            pose.w_axis = translation.extend(1.0);
            camera.world_to_camera = pose.as_mat4();
            let factor = problem.lens[view].map_or(1.0, |l| self.lenses[l].log_focal.exp()) as f32;
            (camera.fx, camera.fy) = (
                problem.cameras[view].fx * factor,
                problem.cameras[view].fy * factor,
            );
        }
    }

    /// Returns the values after a step. `cameras` has six numbers for each camera, then two for
    /// each lens; `points` has one shift for each point.
    fn stepped(&self, cameras: &DVector<f64>, points: &[DVec3]) -> Self {
        let three = |k: usize| DVec3::new(cameras[k], cameras[k + 1], cameras[k + 2]);
        let lenses_at = POSE_PARAMETERS * self.poses.len();
        Self {
            poses: self
                .poses
                .iter()
                .enumerate()
                .map(|(v, pose)| {
                    pose.nudged(three(POSE_PARAMETERS * v), three(POSE_PARAMETERS * v + 3))
                })
                .collect(),
            lenses: (self.lenses.iter().enumerate())
                .map(|(l, lens)| Lens {
                    log_focal: lens.log_focal + cameras[lenses_at + 2 * l],
                    k1: lens.k1 + cameras[lenses_at + 2 * l + 1],
                })
                .collect(),
            points: self
                .points
                .iter()
                .zip(points)
                .map(|(p, d)| *p + *d)
                .collect(),
        }
    }
}

/// Normal equations of the cameras after elimination of the points (Schur complement).
struct Reduced {
    /// Blocks of the matrix, by their two cameras, the first one not above the second one. The
    /// block at (b, a) is the transpose of that at (a, b).
    blocks: BTreeMap<(usize, usize), CameraBlock>,
    /// What is added to the diagonal: priors and damping.
    added: DVector<f64>,
    right: DVector<f64>,
}

impl Reduced {
    fn new(width: usize) -> Self {
        Self {
            blocks: BTreeMap::new(),
            added: DVector::zeros(width),
            right: DVector::zeros(width),
        }
    }

    fn add(&mut self, cameras: (usize, usize), block: CameraBlock) {
        *self.blocks.entry(cameras).or_insert_with(SMatrix::zeros) += block;
    }
}

impl Problem<'_> {
    /// Returns the pixel at which a camera sees a point; `None` if the point is behind it.
    fn project(&self, values: &Values, view: usize, point: DVec3) -> Option<DVec2> {
        let (camera, pose) = (&self.cameras[view], &values.poses[view]);
        let q = pose.rotation * point + pose.translation;
        let lens = self.lens[view].map_or_else(Lens::default, |l| values.lenses[l]);
        let ray = q.truncate() / q.z;
        let focal = DVec2::new(camera.fx.into(), camera.fy.into()) * lens.log_focal.exp();
        (q.z > 0.0).then(|| {
            focal * ray * (1.0 + lens.k1 * ray.length_squared())
                + DVec2::new(camera.cx.into(), camera.cy.into())
        })
    }

    /// Returns the sum of Cauchy's loss over all observations, plus the prior of the lenses. A
    /// point behind a camera costs 1,000.
    fn cost(&self, values: &Values) -> f64 {
        let of_point = |(seen, point): (&Vec<Observation>, &DVec3)| -> f64 {
            let loss = |o: &Observation| {
                self.project(values, o.view, *point).map_or(1e3, |p| {
                    (1.0 + (p - o.pixel).length_squared() / (LOSS_SCALE * LOSS_SCALE)).ln()
                })
            };
            seen.iter().map(loss).sum()
        };
        let of_points: Vec<f64> = self
            .seen
            .par_iter()
            .zip(&values.points)
            .map(of_point)
            .collect();
        let of_lenses = values
            .lenses
            .iter()
            .map(|l| (l.log_focal.powi(2) + l.k1.powi(2)) / (LENS_DEVIATION * LENS_DEVIATION));
        of_points.into_iter().sum::<f64>() + of_lenses.sum::<f64>()
    }

    /// Returns the residual of an observation and its derivatives by camera and by point, weighted
    /// by the loss. Returns `None` if the point is behind the camera.
    fn linear(
        &self,
        values: &Values,
        o: &Observation,
        point: DVec3,
    ) -> Option<(SVector<f64, 2>, ByCamera, Matrix2x3<f64>)> {
        let (camera, pose) = (&self.cameras[o.view], &values.poses[o.view]);
        let q = pose.rotation * point + pose.translation;
        let residual = self.project(values, o.view, point)? - o.pixel;
        let lens = self.lens[o.view].map_or_else(Lens::default, |l| values.lenses[l]);
        let (ray, focal) = (
            q.truncate() / q.z,
            DVec2::new(camera.fx.into(), camera.fy.into()) * lens.log_focal.exp(),
        );
        let (r2, radial) = (ray.length_squared(), 1.0 + lens.k1 * ray.length_squared());
        // Rows of d(pixel)/d(ray). `by_q` multiplies them by the derivative of the division by z.
        let by_ray = [
            focal.x
                * DVec2::new(
                    radial + 2.0 * lens.k1 * ray.x * ray.x,
                    2.0 * lens.k1 * ray.x * ray.y,
                ),
            focal.y
                * DVec2::new(
                    2.0 * lens.k1 * ray.x * ray.y,
                    radial + 2.0 * lens.k1 * ray.y * ray.y,
                ),
        ];
        let by_q = by_ray.map(|row| (row / q.z).extend(-row.dot(ray) / q.z));
        // A small pose change moves q by turn x q + shift.
        let by_turn = by_q.map(|row| q.cross(row));
        let by_point = by_q.map(|row| pose.rotation.transpose() * row);
        let by_lens = [0, 1].map(|k| [focal[k] * ray[k] * radial, focal[k] * ray[k] * r2]);
        let weight = (1.0 / (1.0 + residual.length_squared() / (LOSS_SCALE * LOSS_SCALE))).sqrt()
            / LOSS_SCALE;
        let adjusts_lens = if self.lens[o.view].is_some() {
            weight
        } else {
            0.0
        };
        let camera = ByCamera::from_fn(|r, c| match c {
            0..3 => weight * by_turn[r][c],
            3..6 => weight * by_q[r][c - 3],
            _ => adjusts_lens * by_lens[r][c - 6],
        });
        let point = Matrix2x3::from_fn(|r, c| weight * by_point[r][c]);
        Some((
            SVector::from([weight * residual.x, weight * residual.y]),
            camera,
            point,
        ))
    }

    /// Returns the columns of a view's pose parameters, then those of its lens.
    fn columns(&self, view: usize) -> [usize; CAMERA_PARAMETERS] {
        // A lens that is not adjusted has zero derivatives, so any column will do.
        let lens = POSE_PARAMETERS * self.cameras.len() + 2 * self.lens[view].unwrap_or(0);
        std::array::from_fn(|k| {
            if k < POSE_PARAMETERS {
                POSE_PARAMETERS * view + k
            } else {
                lens + k - POSE_PARAMETERS
            }
        })
    }

    /// Returns the number of columns of all cameras and lenses. It counts at least one lens, so
    /// that [`Self::columns`] are always valid.
    fn width(&self, values: &Values) -> usize {
        POSE_PARAMETERS * self.cameras.len() + 2 * values.lenses.len().max(1)
    }

    /// Returns the normal equations of the cameras, and for each point the values from which its
    /// step is computed.
    fn eliminate(&self, values: &Values, damping: f64) -> (Reduced, Vec<Eliminated>) {
        // The number of parts is fixed: sums must not depend on the number of threads.
        const PARTS: usize = 4;
        let width = self.width(values);
        let size = self.seen.len().div_ceil(PARTS).max(1);
        let parts: Vec<(Reduced, Vec<Eliminated>)> = (self
            .seen
            .par_chunks(size)
            .zip(values.points.par_chunks(size)))
        .map(|(seen, points)| {
            let mut reduced = Reduced::new(width);
            let eliminated = seen
                .iter()
                .zip(points)
                .map(|(seen, point)| {
                    self.eliminate_one(values, seen, *point, damping, &mut reduced)
                })
                .collect();
            (reduced, eliminated)
        })
        .collect();
        let mut all = Reduced::new(width);
        let mut eliminated = Vec::new();
        for (reduced, some) in parts {
            for (cameras, block) in reduced.blocks {
                all.add(cameras, block);
            }
            all.right += reduced.right;
            eliminated.extend(some);
        }
        (all, eliminated)
    }

    /// Adds the observations of one point to `reduced` and eliminates the point.
    fn eliminate_one(
        &self,
        values: &Values,
        seen: &[Observation],
        point: DVec3,
        damping: f64,
        reduced: &mut Reduced,
    ) -> Eliminated {
        let (mut own, mut right) = (SMatrix::<f64, 3, 3>::zeros(), SVector::<f64, 3>::zeros());
        let mut couplings: Vec<(usize, Coupling)> = Vec::with_capacity(seen.len());
        for o in seen {
            let Some((residual, by_camera, by_point)) = self.linear(values, o, point) else {
                continue;
            };
            own += by_point.transpose() * by_point;
            right -= by_point.transpose() * residual;
            couplings.push((o.view, by_camera.transpose() * by_point));
            reduced.add((o.view, o.view), by_camera.transpose() * by_camera);
            self.scatter(
                o.view,
                -by_camera.transpose() * residual,
                &mut reduced.right,
            );
        }
        (0..3).for_each(|k| own[(k, k)] *= 1.0 + damping);
        let inverse = own.try_inverse().unwrap_or_else(SMatrix::zeros);
        for (view, coupling) in &couplings {
            let through = coupling * inverse;
            self.scatter(*view, -through * right, &mut reduced.right);
            for (other, back) in couplings.iter().filter(|(other, _)| view <= other) {
                reduced.add((*view, *other), -through * back.transpose());
            }
        }
        Eliminated {
            inverse,
            right,
            couplings,
        }
    }

    /// Adds the values of a view and its lens to `all`.
    fn scatter(
        &self,
        view: usize,
        values: SVector<f64, CAMERA_PARAMETERS>,
        all: &mut DVector<f64>,
    ) {
        let columns = self.columns(view).into_iter();
        columns.zip(&values).for_each(|(k, v)| all[k] += v);
    }

    /// Returns the values of a view and its lens.
    fn gather(&self, view: usize, all: &DVector<f64>) -> SVector<f64, CAMERA_PARAMETERS> {
        SVector::from(self.columns(view).map(|k| all[k]))
    }

    /// Returns the diagonal of the matrix. That of a lens is approximate: it lacks the blocks of two
    /// cameras with the same lens. Damping and preconditioner need no more.
    fn diagonal(&self, reduced: &Reduced) -> DVector<f64> {
        let mut diagonal = reduced.added.clone();
        for ((a, b), block) in &reduced.blocks {
            if a == b {
                self.scatter(*a, block.diagonal(), &mut diagonal);
            }
        }
        diagonal
    }

    /// Solves the reduced equations. Parameters that do not move get 0. Returns `None` if the
    /// matrix is not positive definite.
    fn solve_reduced(&self, reduced: &Reduced, moves: &[bool]) -> Option<DVector<f64>> {
        let masked = |mut x: DVector<f64>| {
            x.iter_mut()
                .zip(moves)
                .filter(|(_, moves)| !**moves)
                .for_each(|(x, _)| *x = 0.0);
            x
        };
        let product = |x: &DVector<f64>| {
            let mut y = x.component_mul(&reduced.added);
            for (&(a, b), block) in &reduced.blocks {
                self.scatter(a, block * self.gather(b, x), &mut y);
                if a != b {
                    self.scatter(b, block.tr_mul(&self.gather(a, x)), &mut y);
                }
            }
            masked(y)
        };
        // The preconditioner inverts the block of each pose and the diagonal of the lenses.
        let lenses_at = POSE_PARAMETERS * self.cameras.len();
        let of_lenses = self.diagonal(reduced);
        let of_pose = |view: usize| {
            let added = reduced.added.fixed_rows(POSE_PARAMETERS * view);
            let mut own = SMatrix::<f64, POSE_PARAMETERS, POSE_PARAMETERS>::from_diagonal(&added);
            if let Some(block) = reduced.blocks.get(&(view, view)) {
                own += block.fixed_view::<POSE_PARAMETERS, POSE_PARAMETERS>(0, 0);
            }
            own.try_inverse().unwrap_or_else(SMatrix::identity)
        };
        let of_poses: Vec<_> = (0..self.cameras.len()).map(of_pose).collect();
        let precondition = |r: &DVector<f64>| {
            let mut better = r.clone();
            for (view, inverse) in of_poses.iter().enumerate() {
                let at = POSE_PARAMETERS * view;
                let own = inverse * r.fixed_rows::<POSE_PARAMETERS>(at);
                better.fixed_rows_mut::<POSE_PARAMETERS>(at).copy_from(&own);
            }
            for k in lenses_at..r.len() {
                better[k] = r[k] / of_lenses[k].max(f64::MIN_POSITIVE);
            }
            masked(better)
        };
        let right = masked(reduced.right.clone());
        conjugate_gradients::solve(product, precondition, &right, STEP_TOLERANCE)
    }

    /// Takes at most `BUNDLE_STEPS` Levenberg-Marquardt steps; stops when the relative gain is below 1e-4.
    pub fn solve(&self, values: &mut Values) {
        let (mut damping, mut cost) = (1e-4, self.cost(values));
        let mut counts = vec![0; self.cameras.len()];
        self.seen.iter().flatten().for_each(|o| counts[o.view] += 1);
        let lenses_at = POSE_PARAMETERS * self.cameras.len();
        // Parameters without enough data stay fixed: cameras with few observations, lenses that
        // are not adjusted.
        let moves: Vec<bool> = (0..self.width(values))
            .map(|k| {
                if k < lenses_at {
                    counts[k / POSE_PARAMETERS] >= MIN_OBSERVATIONS
                } else {
                    (k - lenses_at) / 2 < values.lenses.len()
                }
            })
            .collect();
        for _ in 0..BUNDLE_STEPS {
            let (mut reduced, eliminated) = self.eliminate(values, damping);
            for (l, lens) in values.lenses.iter().enumerate() {
                for (k, value) in [lens.log_focal, lens.k1].into_iter().enumerate() {
                    let column = lenses_at + 2 * l + k;
                    reduced.added[column] += 1.0 / (LENS_DEVIATION * LENS_DEVIATION);
                    reduced.right[column] -= value / (LENS_DEVIATION * LENS_DEVIATION);
                }
            }
            reduced.added += damping * self.diagonal(&reduced);
            let Some(step) = self.solve_reduced(&reduced, &moves) else {
                damping *= 10.0;
                continue;
            };
            let points: Vec<DVec3> = eliminated
                .iter()
                .map(|e| e.step(|view| self.gather(view, &step)))
                .collect();
            let next = values.stepped(&step, &points);
            let new_cost = self.cost(&next);
            tracing::trace!(cost, new_cost, damping, "bundle adjustment");
            if new_cost < cost {
                let gained = 1.0 - new_cost / cost;
                (*values, cost, damping) = (next, new_cost, damping / 10.0);
                if gained < 1e-4 {
                    break;
                }
            } else {
                damping *= 10.0;
            }
        }
    }
}

/// Values from which the step of a point is computed, after the steps of the cameras: the inverse
/// of the point's block of the normal matrix, its right-hand side, and its couplings to cameras.
struct Eliminated {
    inverse: SMatrix<f64, 3, 3>,
    right: SVector<f64, 3>,
    couplings: Vec<(usize, Coupling)>,
}

impl Eliminated {
    /// Returns the step of the point; `of_camera` returns the step of a camera.
    fn step(&self, of_camera: impl Fn(usize) -> SVector<f64, CAMERA_PARAMETERS>) -> DVec3 {
        let mut right = self.right;
        for (view, coupling) in &self.couplings {
            right -= coupling.transpose() * of_camera(*view);
        }
        let step = self.inverse * right;
        DVec3::new(step[0], step[1], step[2])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;

    /// `size` along axis k, zero along the others.
    fn along<const N: usize>(k: usize, size: f64) -> [f64; N] {
        std::array::from_fn(|c| if c == k { size } else { 0.0 })
    }

    #[test]
    fn derivatives_agree_with_finite_differences() {
        let camera = Camera::look_at(
            "a",
            Vec3::new(0.3, -0.2, -4.0),
            Vec3::ZERO,
            Vec3::Y,
            320,
            240,
            0.9,
        );
        let problem = Problem {
            cameras: std::slice::from_ref(&camera),
            lens: vec![Some(0)],
            seen: Vec::new(),
        };
        let point = DVec3::new(0.7, -0.5, 0.4);
        let values = Values {
            poses: vec![Pose::of(&camera)],
            lenses: vec![Lens {
                log_focal: 0.02,
                k1: -0.1,
            }],
            points: vec![point],
        };
        // The key point lies off the projection, so that the loss has a gradient and a weight.
        let observation = Observation {
            view: 0,
            pixel: problem.project(&values, 0, point).unwrap() + DVec2::new(0.4, -0.7),
        };
        let (residual, by_camera, by_point) = problem.linear(&values, &observation, point).unwrap();
        let weight = residual.norm() / DVec2::new(0.4, -0.7).length();
        let seen = |camera: [f64; CAMERA_PARAMETERS], moved: DVec3| {
            let values = values.stepped(&DVector::from_row_slice(&camera), &[moved]);
            problem.project(&values, 0, values.points[0]).unwrap()
        };
        const H: f64 = 1e-5;
        for k in 0..CAMERA_PARAMETERS + 3 {
            let at = |size: f64| {
                if k < CAMERA_PARAMETERS {
                    seen(along(k, size), DVec3::ZERO)
                } else {
                    seen(
                        [0.0; CAMERA_PARAMETERS],
                        DVec3::from(along::<3>(k - CAMERA_PARAMETERS, size)),
                    )
                }
            };
            let slope = weight * (at(H) - at(-H)) / (2.0 * H);
            let analytic = if k < CAMERA_PARAMETERS {
                by_camera.column(k)
            } else {
                by_point.column(k - CAMERA_PARAMETERS)
            };
            let apart = (slope - DVec2::new(analytic[0], analytic[1])).length();
            assert!(
                apart < 1e-5 * slope.length().max(1.0),
                "parameter {k}: {slope} by finite differences, {analytic} analytically"
            );
        }
    }
}
