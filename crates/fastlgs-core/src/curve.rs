//! Morton order: sorts points so that neighbours in the order are mostly neighbours in space.

use glam::Vec3;

/// Bits of a cell index along each axis.
const BITS: u32 = 10;
/// Share of the points at each end of an axis that may lie outside the grid. Outliers would make
/// the cells of all other points too large.
const OUTLIER_SHARE: f64 = 0.01;

/// Returns the indices of the points in Morton order (Morton 1966). Points of one cell keep their
/// order; a NaN coordinate gives cell index 0 along its axis.
pub fn morton_order(points: &[Vec3]) -> Vec<usize> {
    let ranges = [0, 1, 2].map(|axis| range(points.iter().map(|p| p[axis])));
    let cells = (1u32 << BITS) as f32;
    let code = |point: &Vec3| -> u32 {
        let cell = |axis: usize| {
            let [low, high] = ranges[axis];
            // The cast maps NaN to 0 and saturates values outside the range.
            (((point[axis] - low) / (high - low) * cells) as u32).min((1 << BITS) - 1)
        };
        (0..3).map(|axis| spread(cell(axis)) << axis).sum()
    };
    let mut order: Vec<(u32, usize)> = points
        .iter()
        .enumerate()
        .map(|(i, point)| (code(point), i))
        .collect();
    order.sort_unstable();
    order.into_iter().map(|(_, i)| i).collect()
}

/// Returns the range of the finite values without the outliers at each end; zeros if there are
/// none.
fn range(values: impl Iterator<Item = f32>) -> [f32; 2] {
    let mut values: Vec<f32> = values.filter(|v| v.is_finite()).collect();
    if values.is_empty() {
        return [0.0; 2];
    }
    let beyond = (values.len() as f64 * OUTLIER_SHARE) as usize;
    let last = values.len() - 1;
    let low = *values.select_nth_unstable_by(beyond, f32::total_cmp).1;
    [
        low,
        *values
            .select_nth_unstable_by(last - beyond, f32::total_cmp)
            .1,
    ]
}

/// Inserts two zero bits before each bit.
fn spread(bits: u32) -> u32 {
    (0..BITS).map(|k| (bits >> k & 1) << (3 * k)).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Rng;

    #[test]
    fn neighbours_in_space_are_neighbours_in_the_order() {
        let mut rng = Rng::new(5, "curve");
        let mut points: Vec<Vec3> = (0..4096)
            .map(|_| Vec3::new(rng.normal(), rng.normal(), rng.normal()))
            .collect();
        // Outliers do not affect the order of the other points.
        points.extend([Vec3::splat(1e30), Vec3::NEG_INFINITY, Vec3::NAN]);
        let order = morton_order(&points);
        let mut all = order.clone();
        all.sort_unstable();
        assert_eq!(
            all,
            (0..points.len()).collect::<Vec<_>>(),
            "each index occurs once"
        );
        let length = |points: &[Vec3]| {
            points
                .windows(2)
                .map(|p| p[0].distance(p[1]))
                .filter(|d| *d < 100.0)
                .sum::<f32>()
        };
        let sorted: Vec<Vec3> = order.iter().map(|i| points[*i]).collect();
        assert!(
            length(&sorted) < 0.2 * length(&points),
            "{} of {}",
            length(&sorted),
            length(&points)
        );
        assert_eq!(
            morton_order(&sorted),
            (0..points.len()).collect::<Vec<_>>(),
            "sorted points keep their order"
        );
        // Points at the same position keep their order.
        assert_eq!(morton_order(&[Vec3::ONE; 5]), [0, 1, 2, 3, 4]);
        assert!(morton_order(&[]).is_empty());
        assert_eq!(spread(0b1011), 0b1_000_001_001);
    }
}
