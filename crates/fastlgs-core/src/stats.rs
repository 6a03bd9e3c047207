//! Medians, which outliers do not shift.

use glam::Vec3;

/// Returns the (upper) median; `None` without values.
pub fn median(values: impl IntoIterator<Item = f32>) -> Option<f32> {
    let mut values: Vec<f32> = values.into_iter().collect();
    values.sort_by(f32::total_cmp);
    values.get(values.len() / 2).copied()
}

/// Returns the median of each coordinate; the origin without points.
pub fn median_position(points: impl Iterator<Item = Vec3> + Clone) -> Vec3 {
    let coordinate = |k: usize| median(points.clone().map(|point| point[k])).unwrap_or(0.0);
    Vec3::from_array([0, 1, 2].map(coordinate))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_outlier_does_not_shift_the_median() {
        assert_eq!(median([1.0, 900.0, 3.0]), Some(3.0));
        assert_eq!(median([1.0, 2.0, 3.0, 4.0]), Some(3.0));
        assert_eq!(median([]), None);
        let points = [Vec3::X, Vec3::new(3.0, 1e9, 0.0), Vec3::new(2.0, 1.0, -1.0)];
        let middle = median_position(points.into_iter());
        assert_eq!(middle, Vec3::new(2.0, 1.0, 0.0));
    }
}
