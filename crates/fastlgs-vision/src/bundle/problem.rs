//! The equations of bundle adjustment, and their solution by Levenberg-Marquardt.

use fastlgs_core::Camera;
use glam::{DMat3, DMat4, DQuat, DVec2, DVec3};
use nalgebra::{DMatrix, DVector, Matrix2x3, SMatrix, SVector};
use rayon::prelude::*;

/// How well a given lens is known before any photo speaks: relative focal length, and the radial term.
const LENS_DEVIATION: f64 = 0.1;
/// Fewest observations by which a camera is moved.
const FEW: usize = 20;
/// Error in pixels from which an observation counts less.
const SOFT: f64 = 1.0;
/// Levenberg-Marquardt steps of a round.
const STEPS: usize = 12;

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

/// What is solved for.
#[derive(Clone)]
pub(super) struct Values {
    pub poses: Vec<Pose>,
    pub lenses: Vec<Lens>,
    pub points: Vec<DVec3>,
}

/// A key point that shows a point.
#[derive(Clone, Copy)]
pub(super) struct Observation {
    pub view: usize,
    pub pixel: DVec2,
}

pub(super) struct Problem<'a> {
    pub cameras: &'a [Camera],
    /// Lens of each camera, where it is adjusted.
    pub lens: Vec<Option<usize>>,
    /// Observations of each point.
    pub seen: Vec<Vec<Observation>>,
}

/// Numbers of a camera: a turn, a shift, and its lens.
const OWN: usize = 6;
const ALL: usize = OWN + 2;
/// By a camera's turn, shift and lens.
type ByCamera = SMatrix<f64, 2, ALL>;
/// Of a point, by those of a camera.
type Coupling = SMatrix<f64, ALL, 3>;

impl Pose {
    pub fn of(camera: &Camera) -> Self {
        let pose = camera.world_to_camera.as_dmat4();
        Self { rotation: DMat3::from_mat4(pose), translation: pose.w_axis.truncate() }
    }

    /// A small turn and shift after this pose: q becomes exp(turn) q + shift.
    fn nudged(&self, turn: DVec3, shift: DVec3) -> Self {
        let turn = DMat3::from_quat(DQuat::from_scaled_axis(turn));
        Self { rotation: turn * self.rotation, translation: turn * self.translation + shift }
    }
}

impl Values {
    /// Writes poses and focal lengths into cameras, which are as given but for those.
    pub fn apply(&self, problem: &Problem, cameras: &mut [Camera]) {
        for (view, camera) in cameras.iter_mut().enumerate() {
            let Pose { rotation, translation } = self.poses[view];
            let mut pose = DMat4::from_mat3(DMat3::from_quat(DQuat::from_mat3(&rotation).normalize()));
            pose.w_axis = translation.extend(1.0);
            camera.world_to_camera = pose.as_mat4();
            let factor = problem.lens[view].map_or(1.0, |l| self.lenses[l].log_focal.exp()) as f32;
            (camera.fx, camera.fy) = (problem.cameras[view].fx * factor, problem.cameras[view].fy * factor);
        }
    }

    /// After a step: six numbers a camera, two a lens, three a point.
    fn stepped(&self, cameras: &DVector<f64>, points: &[DVec3]) -> Self {
        let three = |k: usize| DVec3::new(cameras[k], cameras[k + 1], cameras[k + 2]);
        let lenses_at = OWN * self.poses.len();
        Self {
            poses: self.poses.iter().enumerate().map(|(v, pose)| pose.nudged(three(OWN * v), three(OWN * v + 3))).collect(),
            lenses: (self.lenses.iter().enumerate())
                .map(|(l, lens)| Lens {
                    log_focal: lens.log_focal + cameras[lenses_at + 2 * l],
                    k1: lens.k1 + cameras[lenses_at + 2 * l + 1],
                })
                .collect(),
            points: self.points.iter().zip(points).map(|(p, d)| *p + *d).collect(),
        }
    }
}

/// The normal equations of the cameras, points eliminated.
struct Reduced {
    matrix: DMatrix<f64>,
    right: DVector<f64>,
}

impl Problem<'_> {
    /// Where a camera sees a point; none behind it.
    fn project(&self, values: &Values, view: usize, point: DVec3) -> Option<DVec2> {
        let (camera, pose) = (&self.cameras[view], &values.poses[view]);
        let q = pose.rotation * point + pose.translation;
        let lens = self.lens[view].map_or_else(Lens::default, |l| values.lenses[l]);
        let ray = q.truncate() / q.z;
        let focal = DVec2::new(camera.fx.into(), camera.fy.into()) * lens.log_focal.exp();
        (q.z > 0.0).then(|| focal * ray * (1.0 + lens.k1 * ray.length_squared()) + DVec2::new(camera.cx.into(), camera.cy.into()))
    }

    /// Sum of Cauchy's loss, and what the lenses deviate from the given ones.
    fn cost(&self, values: &Values) -> f64 {
        let of_point = |(seen, point): (&Vec<Observation>, &DVec3)| -> f64 {
            let loss = |o: &Observation| {
                self.project(values, o.view, *point).map_or(1e3, |p| (1.0 + (p - o.pixel).length_squared() / (SOFT * SOFT)).ln())
            };
            seen.iter().map(loss).sum()
        };
        let of_points: Vec<f64> = self.seen.par_iter().zip(&values.points).map(of_point).collect();
        let of_lenses = values.lenses.iter().map(|l| (l.log_focal.powi(2) + l.k1.powi(2)) / (LENS_DEVIATION * LENS_DEVIATION));
        of_points.into_iter().sum::<f64>() + of_lenses.sum::<f64>()
    }

    /// Residual of an observation with its slopes by camera and by point, weighted by the loss; none behind the camera.
    fn linear(&self, values: &Values, o: &Observation, point: DVec3) -> Option<(SVector<f64, 2>, ByCamera, Matrix2x3<f64>)> {
        let (camera, pose) = (&self.cameras[o.view], &values.poses[o.view]);
        let q = pose.rotation * point + pose.translation;
        let residual = self.project(values, o.view, point)? - o.pixel;
        let lens = self.lens[o.view].map_or_else(Lens::default, |l| values.lenses[l]);
        let (ray, focal) = (q.truncate() / q.z, DVec2::new(camera.fx.into(), camera.fy.into()) * lens.log_focal.exp());
        let (r2, radial) = (ray.length_squared(), 1.0 + lens.k1 * ray.length_squared());
        // Rows of d(pixel)/d(ray), then through the division by z.
        let by_ray = [
            focal.x * DVec2::new(radial + 2.0 * lens.k1 * ray.x * ray.x, 2.0 * lens.k1 * ray.x * ray.y),
            focal.y * DVec2::new(2.0 * lens.k1 * ray.x * ray.y, radial + 2.0 * lens.k1 * ray.y * ray.y),
        ];
        let by_q = by_ray.map(|row| (row / q.z).extend(-row.dot(ray) / q.z));
        // q moves by turn x q + shift.
        let by_turn = by_q.map(|row| q.cross(row));
        let by_point = by_q.map(|row| pose.rotation.transpose() * row);
        let by_lens = [0, 1].map(|k| [focal[k] * ray[k] * radial, focal[k] * ray[k] * r2]);
        let weight = (1.0 / (1.0 + residual.length_squared() / (SOFT * SOFT))).sqrt() / SOFT;
        let adjusts_lens = if self.lens[o.view].is_some() { weight } else { 0.0 };
        let camera = ByCamera::from_fn(|r, c| match c {
            0..3 => weight * by_turn[r][c],
            3..6 => weight * by_q[r][c - 3],
            _ => adjusts_lens * by_lens[r][c - 6],
        });
        let point = Matrix2x3::from_fn(|r, c| weight * by_point[r][c]);
        Some((SVector::from([weight * residual.x, weight * residual.y]), camera, point))
    }

    /// Where the numbers of a view begin among those of all cameras, and those of its lens.
    fn columns(&self, view: usize) -> [usize; ALL] {
        // A lens that is not adjusted has slopes of zero, which may go anywhere.
        let lens = OWN * self.cameras.len() + 2 * self.lens[view].unwrap_or(0);
        std::array::from_fn(|k| if k < OWN { OWN * view + k } else { lens + k - OWN })
    }

    /// Columns of all cameras and lenses; one lens at least, so that [`Self::columns`] lie inside.
    fn width(&self, values: &Values) -> usize {
        OWN * self.cameras.len() + 2 * values.lenses.len().max(1)
    }

    /// The normal equations of some points, and for each what its step follows from: the inverse of its own block, its right side, and
    /// its coupling to the cameras.
    fn eliminate(&self, values: &Values, damping: f64) -> (Reduced, Vec<Eliminated>) {
        // The number of parts is fixed, so that sums do not depend on the number of threads.
        const PARTS: usize = 4;
        let width = self.width(values);
        let size = self.seen.len().div_ceil(PARTS).max(1);
        let parts: Vec<(Reduced, Vec<Eliminated>)> = (self.seen.par_chunks(size).zip(values.points.par_chunks(size)))
            .map(|(seen, points)| {
                let mut reduced = Reduced { matrix: DMatrix::zeros(width, width), right: DVector::zeros(width) };
                let eliminated =
                    seen.iter().zip(points).map(|(seen, point)| self.eliminate_one(values, seen, *point, damping, &mut reduced)).collect();
                (reduced, eliminated)
            })
            .collect();
        let mut all = Reduced { matrix: DMatrix::zeros(width, width), right: DVector::zeros(width) };
        let mut eliminated = Vec::new();
        for (reduced, some) in parts {
            all.matrix += reduced.matrix;
            all.right += reduced.right;
            eliminated.extend(some);
        }
        (all, eliminated)
    }

    fn eliminate_one(&self, values: &Values, seen: &[Observation], point: DVec3, damping: f64, reduced: &mut Reduced) -> Eliminated {
        let (mut own, mut right) = (SMatrix::<f64, 3, 3>::zeros(), SVector::<f64, 3>::zeros());
        let mut couplings: Vec<(usize, Coupling)> = Vec::with_capacity(seen.len());
        for o in seen {
            let Some((residual, by_camera, by_point)) = self.linear(values, o, point) else { continue };
            own += by_point.transpose() * by_point;
            right -= by_point.transpose() * residual;
            couplings.push((o.view, by_camera.transpose() * by_point));
            let columns = self.columns(o.view);
            let (normal, side) = (by_camera.transpose() * by_camera, by_camera.transpose() * residual);
            for (r, row) in columns.into_iter().enumerate() {
                reduced.right[row] -= side[r];
                columns.iter().enumerate().for_each(|(c, column)| reduced.matrix[(row, *column)] += normal[(r, c)]);
            }
        }
        (0..3).for_each(|k| own[(k, k)] *= 1.0 + damping);
        let inverse = own.try_inverse().unwrap_or_else(SMatrix::zeros);
        for (view, coupling) in &couplings {
            let through = coupling * inverse;
            let (rows, side) = (self.columns(*view), through * right);
            rows.iter().enumerate().for_each(|(r, row)| reduced.right[*row] -= side[r]);
            for (other, back) in &couplings {
                let (columns, product) = (self.columns(*other), through * back.transpose());
                for (c, column) in columns.into_iter().enumerate() {
                    rows.iter().enumerate().for_each(|(r, row)| reduced.matrix[(*row, column)] -= product[(r, c)]);
                }
            }
        }
        Eliminated { inverse, right, couplings }
    }

    /// Levenberg-Marquardt steps until they no longer pay.
    pub fn solve(&self, values: &mut Values) {
        let (mut damping, mut cost) = (1e-4, self.cost(values));
        let mut counts = vec![0; self.cameras.len()];
        self.seen.iter().flatten().for_each(|o| counts[o.view] += 1);
        for _ in 0..STEPS {
            let (mut reduced, eliminated) = self.eliminate(values, damping);
            for (l, lens) in values.lenses.iter().enumerate() {
                for (k, value) in [lens.log_focal, lens.k1].into_iter().enumerate() {
                    let column = OWN * self.cameras.len() + 2 * l + k;
                    reduced.matrix[(column, column)] += 1.0 / (LENS_DEVIATION * LENS_DEVIATION);
                    reduced.right[column] -= value / (LENS_DEVIATION * LENS_DEVIATION);
                }
            }
            for k in 0..reduced.right.len() {
                let moves = k >= OWN * self.cameras.len() || counts[k / OWN] >= FEW;
                // What nothing holds stays: a camera without tracks, a lens that is not adjusted.
                if !moves || reduced.matrix[(k, k)] <= 0.0 {
                    reduced.matrix.row_mut(k).fill(0.0);
                    reduced.matrix.column_mut(k).fill(0.0);
                    (reduced.matrix[(k, k)], reduced.right[k]) = (1.0, 0.0);
                }
                reduced.matrix[(k, k)] *= 1.0 + damping;
            }
            let Some(factors) = reduced.matrix.cholesky() else {
                damping *= 10.0;
                continue;
            };
            let step = factors.solve(&reduced.right);
            let points: Vec<DVec3> = eliminated.iter().map(|e| e.step(&step, |view| self.columns(view))).collect();
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

/// What a point's step follows from, once those of the cameras are known.
struct Eliminated {
    inverse: SMatrix<f64, 3, 3>,
    right: SVector<f64, 3>,
    couplings: Vec<(usize, Coupling)>,
}

impl Eliminated {
    fn step(&self, cameras: &DVector<f64>, columns: impl Fn(usize) -> [usize; ALL]) -> DVec3 {
        let mut right = self.right;
        for (view, coupling) in &self.couplings {
            let of_camera = SVector::<f64, ALL>::from(columns(*view).map(|k| cameras[k]));
            right -= coupling.transpose() * of_camera;
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
    fn slopes_are_those_of_finite_differences() {
        let camera = Camera::look_at("a", Vec3::new(0.3, -0.2, -4.0), Vec3::ZERO, Vec3::Y, 320, 240, 0.9);
        let problem = Problem { cameras: std::slice::from_ref(&camera), lens: vec![Some(0)], seen: Vec::new() };
        let point = DVec3::new(0.7, -0.5, 0.4);
        let values = Values { poses: vec![Pose::of(&camera)], lenses: vec![Lens { log_focal: 0.02, k1: -0.1 }], points: vec![point] };
        // The key point lies beside where the point is seen, so that the loss has a slope and a weight.
        let observation = Observation { view: 0, pixel: problem.project(&values, 0, point).unwrap() + DVec2::new(0.4, -0.7) };
        let (residual, by_camera, by_point) = problem.linear(&values, &observation, point).unwrap();
        let weight = residual.norm() / DVec2::new(0.4, -0.7).length();
        let seen = |camera: [f64; ALL], moved: DVec3| {
            let values = values.stepped(&DVector::from_row_slice(&camera), &[moved]);
            problem.project(&values, 0, values.points[0]).unwrap()
        };
        const H: f64 = 1e-5;
        for k in 0..ALL + 3 {
            let at = |size: f64| {
                if k < ALL { seen(along(k, size), DVec3::ZERO) } else { seen([0.0; ALL], DVec3::from(along::<3>(k - ALL, size))) }
            };
            let slope = weight * (at(H) - at(-H)) / (2.0 * H);
            let told = if k < ALL { by_camera.column(k) } else { by_point.column(k - ALL) };
            let apart = (slope - DVec2::new(told[0], told[1])).length();
            assert!(apart < 1e-5 * slope.length().max(1.0), "number {k}: {slope} by differences, {told} as computed");
        }
    }
}
