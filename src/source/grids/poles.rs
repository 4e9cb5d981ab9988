//! Grids whose last row lies beside a pole: the pole becomes a row too, so that no hole remains around it.

use super::axes::AxisPlan;
use ridgewatch_field::{Axis, AxisFault};

/// Poles that were added as rows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Poles {
    south: bool,
    north: bool,
}

impl Poles {
    /// Rows that are those of the file, of latitudes to which the poles were added.
    pub fn rows_of_file(self, latitudes: &[f64]) -> &[f64] {
        &latitudes[usize::from(self.south)..latitudes.len() - usize::from(self.north)]
    }

    /// Adds the poles that lie less than three quarters of a cell beyond the ends of `latitude`, if `longitude` is periodic.
    pub fn close(longitude: &AxisPlan, latitude: &mut AxisPlan) -> Result<Self, AxisFault> {
        let rows = latitude.axis.coordinates().to_vec();
        let count = rows.len();
        if longitude.axis.period().is_none() {
            return Ok(Self::default());
        }
        let missing = |gap: f64, cell: f64| gap > 1e-6 * cell && gap < 0.75 * cell;
        let south = missing(rows[0] + 90.0, rows[1] - rows[0]);
        let north = missing(90.0 - rows[count - 1], rows[count - 1] - rows[count - 2]);
        if south || north {
            let all = south.then_some(-90.0).into_iter().chain(rows).chain(north.then_some(90.0)).collect();
            latitude.axis = Axis::new(latitude.axis.name(), latitude.axis.units(), all)?;
            let which = [(south, "south"), (north, "north")].iter().filter(|p| p.0).map(|p| p.1).collect::<Vec<_>>().join(" and ");
            latitude.notes.push(format!(
                "`{}` ends beside the {which} pole: a row at the pole is added, with the mean vector of the last row",
                latitude.axis.name()
            ));
        }
        Ok(Self { south, north })
    }

    /// Adds the rows of the poles to u, v and w on `longitudes` (degrees) and `ny` rows of the file. A pole gets the mean vector of
    /// its neighbouring row.
    pub fn extend(self, components: &mut [Vec<f32>], longitudes: &[f64], ny: usize) {
        if self == Self::default() {
            return;
        }
        let nx = longitudes.len();
        let turns: Vec<(f64, f64)> = longitudes.iter().map(|l| l.to_radians().sin_cos()).collect();
        let planes = components[0].len() / (nx * ny);
        let mut grown: Vec<Vec<f32>> = components.iter().map(|c| Vec::with_capacity(c.len() + 2 * nx * planes)).collect();
        for plane in 0..planes {
            let row = |c: &[f32], y: usize| -> Vec<f32> { c[(plane * ny + y) * nx..(plane * ny + y + 1) * nx].to_vec() };
            let pole = |y: usize, sign: f64| -> Vec<Vec<f32>> {
                // In the plane of the pole, east is (-sin, cos) and north is -sign (cos, sin).
                let (u, v) = (row(&components[0], y), row(&components[1], y));
                let (mut ahead, mut aside) = (0.0, 0.0);
                for (i, (sin, cos)) in turns.iter().enumerate() {
                    let (east, north) = (f64::from(u[i]), f64::from(v[i]));
                    ahead += -sin * east - sign * cos * north;
                    aside += cos * east - sign * sin * north;
                }
                let (ahead, aside) = (ahead / nx as f64, aside / nx as f64);
                let mut rows = vec![
                    turns.iter().map(|(sin, cos)| (-sin * ahead + cos * aside) as f32).collect(),
                    turns.iter().map(|(sin, cos)| (-sign * (cos * ahead + sin * aside)) as f32).collect(),
                ];
                if let Some(w) = components.get(2) {
                    let mean = row(w, y).iter().map(|&w| f64::from(w)).sum::<f64>() / nx as f64;
                    rows.push(vec![mean as f32; nx]);
                }
                rows
            };
            let south = if self.south { pole(0, -1.0) } else { Vec::new() };
            let north = if self.north { pole(ny - 1, 1.0) } else { Vec::new() };
            for (c, grown) in grown.iter_mut().enumerate() {
                grown.extend(south.get(c).into_iter().flatten());
                grown.extend_from_slice(&components[c][plane * ny * nx..(plane + 1) * ny * nx]);
                grown.extend(north.get(c).into_iter().flatten());
            }
        }
        components.iter_mut().zip(grown).for_each(|(component, grown)| *component = grown);
    }
}
