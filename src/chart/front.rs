//! The Pareto front of cost and error, and the pick on it.

/// Indices of the points that no other point beats in cost and error at once, by rising cost. Each is `[cost, error]`, smaller is better; points
/// that are not finite are left out, and of equal points the first is kept.
pub fn front(points: &[[f64; 2]]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..points.len()).filter(|&i| points[i].iter().all(|value| value.is_finite())).collect();
    order.sort_by(|&a, &b| points[a][0].total_cmp(&points[b][0]).then(points[a][1].total_cmp(&points[b][1])));
    let mut least = f64::INFINITY;
    order.retain(|&i| {
        points[i][1] < least && {
            least = points[i][1];
            true
        }
    });
    order
}

/// The cheapest point whose error is within the tolerance; `None` if none is.
pub fn pick(points: &[[f64; 2]], tolerance: f64) -> Option<usize> {
    front(points).into_iter().find(|&i| points[i][1] <= tolerance)
}

#[cfg(test)]
mod tests {
    use super::*;

    const POINTS: [[f64; 2]; 7] = [[4.0, 1.0], [1.0, 9.0], [2.0, 3.0], [3.0, 3.0], [2.0, 5.0], [f64::NAN, 0.0], [5.0, f64::INFINITY]];

    #[test]
    fn only_points_that_are_not_beaten_are_on_the_front() {
        assert_eq!(front(&POINTS), [1, 2, 0]);
        assert_eq!(front(&[[1.0, 1.0], [1.0, 1.0]]), [0], "equal points are one");
        assert!(front(&[]).is_empty());
    }

    #[test]
    fn the_cheapest_point_within_the_tolerance_is_picked() {
        assert_eq!([10.0, 4.0, 1.0, 0.5].map(|tolerance| pick(&POINTS, tolerance)), [Some(1), Some(2), Some(0), None]);
    }
}
