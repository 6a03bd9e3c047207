//! Conjugate gradients with a preconditioner (Hestenes & Stiefel 1952; Saad 2003, section 9.2):
//! solves a large sparse system of which only the product with a vector is known.

use nalgebra::DVector;

/// Returns x for which `product(x)` differs from `right` by at most `tolerance` times the length of
/// `right`. The system must be symmetric and positive definite; `precondition` multiplies by an
/// approximate inverse that is, too. Returns `None` if the system is not positive definite.
pub fn solve(
    product: impl Fn(&DVector<f64>) -> DVector<f64>,
    precondition: impl Fn(&DVector<f64>) -> DVector<f64>,
    right: &DVector<f64>,
    tolerance: f64,
) -> Option<DVector<f64>> {
    let mut x = DVector::zeros(right.len());
    let mut residual = right.clone();
    let mut better = precondition(&residual);
    let mut direction = better.clone();
    let mut size = residual.dot(&better);
    // In exact arithmetic, as many steps as unknowns suffice.
    for _ in 0..right.len() {
        if residual.norm() <= tolerance * right.norm() {
            break;
        }
        let image = product(&direction);
        let curvature = direction.dot(&image);
        if !(curvature > 0.0 && size > 0.0) {
            return None;
        }
        x.axpy(size / curvature, &direction, 1.0);
        residual.axpy(-size / curvature, &image, 1.0);
        better = precondition(&residual);
        let next = residual.dot(&better);
        direction.axpy(1.0, &better, next / size);
        size = next;
    }
    Some(x)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::DMatrix;

    #[test]
    fn solution_equals_that_of_cholesky() {
        let mut matrix = DMatrix::from_fn(30, 30, |r, c| ((r * 7 + c * 3) % 11) as f64 - 5.0);
        matrix = &matrix * matrix.transpose() + DMatrix::identity(30, 30);
        let right = DVector::from_fn(30, |r, _| (r as f64).sin());
        let exact = matrix.clone().cholesky().unwrap().solve(&right);
        let diagonal = matrix.diagonal();
        let found = solve(
            |x| &matrix * x,
            |r| r.component_div(&diagonal),
            &right,
            1e-9,
        )
        .unwrap();
        let apart = (&found - &exact).norm() / exact.norm();
        assert!(apart < 1e-6, "{apart}");
        assert_eq!(
            solve(|x| &matrix * x, DVector::clone, &DVector::zeros(30), 1e-6),
            Some(DVector::zeros(30))
        );
    }

    #[test]
    fn indefinite_systems_are_refused() {
        let right = DVector::from_element(4, 1.0);
        assert_eq!(solve(|x| -x, DVector::clone, &right, 1e-6), None);
    }
}
