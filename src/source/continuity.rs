//! Vertical velocity from the horizontal one: a fluid whose density stays the same has no divergence.

use ridgewatch_field::{Axis, Geometry, Grid};

/// Cosine of latitudes that count as a pole.
const POLE: f64 = 1e-6;

/// Vertical velocity at the nodes of a grid whose levels are metres, upwards, m/s: w(z) is minus the integral of du/dx + dv/dy from the lowest node of the column
/// that is known, where w is 0, up to z. In the air, whose density falls as exp(-z / H), each part of the integral grows by its share of the density. Differences
/// are of second order, integration by trapezoids. u and v at missing nodes beside known ones count as 0: nothing flows into land.
///
/// `scale_height`: H in the grid's metres; `None` in water.
pub fn vertical_velocity(grid: &Grid, u: &[f32], v: &[f32], scale_height: Option<f64>) -> Vec<f32> {
    let [nx, ny, nz] = grid.shape();
    let (x, y, z) = (&grid.axes[0], &grid.axes[1], grid.axes[2].coordinates());
    let on_sphere = |value: f64| match grid.geometry {
        Geometry::Sphere { .. } => value.to_radians().cos(),
        Geometry::Cartesian => 1.0,
    };
    let unit = match grid.geometry {
        Geometry::Sphere { radius } => radius.to_radians(),
        Geometry::Cartesian => 1.0,
    };
    let cosines: Vec<f64> = y.coordinates().iter().map(|&latitude| on_sphere(latitude)).collect();
    let known = |value: f32| if value.is_nan() { 0.0 } else { f64::from(value) };
    let divergence = |i: usize, j: usize, k: usize| {
        let row = (k * ny + j) * nx;
        if u[row + i].is_nan() || v[row + i].is_nan() {
            return f64::NAN;
        }
        let eastward = slope(x, i, |i| known(u[row + i])) / (unit * cosines[j]);
        let northward = slope(y, j, |j| known(v[(k * ny + j) * nx + i]) * cosines[j]) / (unit * cosines[j]);
        eastward + northward
    };
    let mut w = vec![f32::NAN; nx * ny * nz];
    for j in (0..ny).filter(|&j| cosines[j] > POLE) {
        for i in 0..nx {
            let (mut sum, mut below) = (0.0, f64::NAN);
            for k in 0..nz {
                let here = divergence(i, j, k);
                if !here.is_nan() {
                    sum = match below.is_nan() {
                        true => 0.0,
                        false => {
                            let step = z[k] - z[k - 1];
                            let thinner = scale_height.map_or(1.0, |height| (step / height).exp());
                            thinner * sum - 0.5 * (thinner * below + here) * step
                        }
                    };
                    w[(k * ny + j) * nx + i] = sum as f32;
                }
                below = here;
            }
        }
    }
    // A pole has no east: it takes the mean of the row beside it.
    for (j, beside) in [(0, 1.min(ny - 1)), (ny - 1, ny.saturating_sub(2))].into_iter().filter(|&(j, _)| cosines[j] <= POLE) {
        for k in 0..nz {
            let row: Vec<f64> = (0..nx).map(|i| f64::from(w[(k * ny + beside) * nx + i])).filter(|w| !w.is_nan()).collect();
            let mean = row.iter().sum::<f64>() / row.len() as f64;
            w[(k * ny + j) * nx..][..nx].fill(mean as f32);
        }
    }
    w
}

/// Derivative along an axis at node `n`: of the parabola through three nodes; at an end of the line through two.
fn slope(axis: &Axis, n: usize, value: impl Fn(usize) -> f64) -> f64 {
    let (places, count) = (axis.coordinates(), axis.len());
    let [before, after] = match axis.period() {
        Some(period) => {
            let gap = period - (places[count - 1] - places[0]);
            [
                Some(if n == 0 { (count - 1, gap) } else { (n - 1, places[n] - places[n - 1]) }),
                Some(if n + 1 == count { (0, gap) } else { (n + 1, places[n + 1] - places[n]) }),
            ]
        }
        None => [
            n.checked_sub(1).map(|before| (before, places[n] - places[before])),
            (n + 1 < count).then(|| (n + 1, places[n + 1] - places[n])),
        ],
    };
    match (before, after) {
        (Some((before, a)), Some((after, b))) => {
            (a * a * value(after) - b * b * value(before) + (b * b - a * a) * value(n)) / (a * b * (a + b))
        }
        (None, Some((after, b))) => (value(after) - value(n)) / b,
        (Some((before, a)), None) => (value(n) - value(before)) / a,
        (None, None) => 0.0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grid(axes: [Axis; 3], geometry: Geometry) -> Grid {
        Grid { axes: axes.to_vec(), geometry, slab: (0.0, 1.0) }
    }

    fn on(grid: &Grid, f: impl Fn([f64; 3]) -> f64) -> Vec<f32> {
        let [nx, ny, _] = grid.shape();
        let at = |n: usize, k: usize| grid.axes[k].coordinates()[[n % nx, n / nx % ny, n / (nx * ny)][k]];
        (0..grid.nodes()).map(|n| f([0, 1, 2].map(|k| at(n, k))) as f32).collect()
    }

    #[test]
    fn a_flow_that_spreads_sinks_towards_the_bottom() {
        let axis = |name: &str, values: &[f64]| Axis::new(name, "m", values.to_vec()).unwrap();
        let axes = [axis("x", &[0.0, 100.0, 250.0, 300.0]), axis("y", &[0.0, 50.0, 200.0]), axis("z", &[-30.0, -20.0, 0.0])];
        let grid = grid(axes, Geometry::Cartesian);
        let (mut u, v) = (on(&grid, |[x, ..]| 1e-4 * x), on(&grid, |[_, y, _]| 2e-4 * y));
        let expected = on(&grid, |[.., z]| -3e-4 * (z + 30.0));
        let apart = |w: &[f32]| w.iter().zip(&expected).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        let found = vertical_velocity(&grid, &u, &v, None);
        assert!(apart(&found) < 1e-8, "{found:?}");
        // A column whose lowest node is rock begins above it.
        u[4] = f32::NAN;
        let found = vertical_velocity(&grid, &u, &v, None);
        assert!(found[4].is_nan() && found[12 + 4] == 0.0 && found[24 + 4] < 0.0, "{found:?}");
    }

    #[test]
    fn air_that_spreads_sinks_faster_where_it_is_thinner() {
        let heights: Vec<f64> = (0..81).map(|k| 200.0 * f64::from(k)).collect();
        let axis = |name: &str, values: &[f64]| Axis::new(name, "m", values.to_vec()).unwrap();
        let grid = grid([axis("x", &[0.0, 1e4]), axis("y", &[0.0, 1e4]), axis("z", &heights)], Geometry::Cartesian);
        let (u, v) = (on(&grid, |[x, ..]| 1e-5 * x), on(&grid, |_| 0.0));
        let found = vertical_velocity(&grid, &u, &v, Some(7000.0));
        // The integral of exp((z - z') / H) D over z' from 0 to z.
        let expected = on(&grid, |[.., z]| -1e-5 * 7000.0 * ((z / 7000.0).exp() - 1.0));
        // Trapezoids of 200 m: (200 / 7000)^2 / 12 of the integral.
        assert!(found.iter().zip(&expected).all(|(a, b)| (a - b).abs() <= 7e-5 * b.abs() + 1e-9), "{:?}", &found[found.len() - 4..]);
    }

    #[test]
    fn on_the_sphere_meridians_meet() {
        let longitude = Axis::uniform("lon", "degrees_east", 0.0, 350.0, 36).unwrap().with_period(360.0);
        let latitude = Axis::uniform("lat", "degrees_north", -90.0, 90.0, 181).unwrap();
        let axes = [longitude, latitude, Axis::new("z", "m", vec![-10.0, 0.0]).unwrap()];
        let radius = 6.371e6;
        let grid = grid(axes, Geometry::Sphere { radius });
        // u = cos(lat) sin(lon), v = sin(2 lat) / 2: the divergence is (cos(lon) + cos(2 lat) - sin(lat)^2) / R.
        let u = on(&grid, |[x, y, _]| y.to_radians().cos() * x.to_radians().sin());
        let v = on(&grid, |[_, y, _]| 0.5 * (2.0 * y.to_radians()).sin());
        // Differences over 10 degrees see less of a wave.
        let seen = 10f64.to_radians().sin() / 10f64.to_radians();
        let expected = on(&grid, |[x, y, z]| {
            let (x, y) = (x.to_radians(), y.to_radians());
            -(z + 10.0) * (seen * x.cos() + (2.0 * y).cos() - y.sin().powi(2)) / radius
        });
        let found = vertical_velocity(&grid, &u, &v, None);
        for (node, (a, b)) in found.iter().zip(&expected).enumerate() {
            let row = node / 36 % 181;
            // Beside a pole its cosine is small, and the error of differences counts.
            let tolerance = if (3..=177).contains(&row) { 2e-9 } else { 5e-6 };
            assert!((a - b).abs() < tolerance, "row {row}: {a} {b}");
        }
    }
}
