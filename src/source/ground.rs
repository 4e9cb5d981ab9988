//! Velocities over the ground on grids whose x does not run east, or whose metres are not those of the ground: projections and rotated poles.

use crate::archive_settings::{ArchiveSettings, Metric, VelocityUnit};
use crate::cf::coordinate::Kind;
use crate::cf::velocity::says_eastward;
use crate::error::SourceError;
use crate::formats::DataFile;
use crate::georeference::{Positions, mapping, unit_of_plane};
use crate::grids::Layout;
use crate::projection::{Jacobian, Projection, difference, turned};
use rayon::iter::{IntoParallelIterator, ParallelIterator};
use ridgewatch_field::EARTH_RADIUS;

/// Distance over which longitudes and latitudes are compared, metres. Of single precision they are a metre apart.
const REACH: f64 = 20_000.0;
/// Metres of a map in a metre on the ground. Others are those of an idealised model, whose longitudes are made up.
const SCALES: std::ops::RangeInclusive<f64> = 0.2..=6.0;
/// Largest second difference of the scale along rows, root mean square, as a share of it: a map of 300 km a cell has 0.001.
const MOST_BENT: f64 = 0.01;

/// Turns velocities over the ground to the x and y of a grid, and stretches them to its metres.
#[derive(Debug, Clone, PartialEq)]
pub struct GroundToGrid {
    /// For each node of a level, x fastest: x and y for the first component, then for the second: [xx, xy, yx, yy] of the matrix.
    matrices: Vec<[f32; 4]>,
}

impl GroundToGrid {
    /// What the velocities of an archive's first file need, by the names of the velocity, the grid mapping and the longitudes and latitudes of the nodes
    /// (`positions`, if they were read already); and what is done, as a sentence. `None` on grids that run east and north, or over which the file tells nothing.
    ///
    /// # Errors
    /// The settings say that velocities run east and north, but the file does not tell where east is.
    pub fn of(
        file: &DataFile,
        layout: &Layout,
        settings: &ArchiveSettings,
        positions: Option<&Positions>,
    ) -> Result<Option<(Option<Self>, String)>, SourceError> {
        let variable = |name: &str| file.listing.find(name).map(|index| &file.listing.variables[index]);
        let u = layout.frames[0].first().and_then(|component| variable(&component.name));
        let x = variable(layout.axes[0].axis.name());
        let is_rotated = x.is_some_and(|x| x.text("standard_name") == Some("grid_longitude") || x.name.eq_ignore_ascii_case("rlon"));
        let is_plane = [layout.axes[0].kind, layout.axes[1].kind] == [Kind::X, Kind::Y];
        let fits = layout.resampling.is_none() && layout.metric != Metric::Index && settings.velocity_unit == VelocityUnit::Si;
        let (Some(u), true) = (u, fits && (is_plane || is_rotated)) else { return Ok(None) };
        let eastward = match (settings.grid_relative, says_eastward(u)) {
            (Some(true), _) => None,
            (Some(false), _) => Some("as set".to_owned()),
            (None, why) => why,
        };
        let read = if positions.is_none() { Positions::of(file, layout) } else { None };
        let known = positions.or(read.as_ref());
        let projection = Self::projection(file, layout, is_plane, known);
        let (xs, ys) = (layout.axes[0].axis.coordinates(), layout.poles.rows_of_file(layout.axes[1].axis.coordinates()));
        let nodes: Vec<[f64; 2]> = ys.iter().flat_map(|&y| xs.iter().map(move |&x| [x, y])).collect();
        let is_wide = |coordinates: &[f64]| coordinates[coordinates.len() - 1] - coordinates[0] >= REACH;
        let is_measured = is_plane && unit_of_plane(layout).is_some() && is_wide(xs) && is_wide(ys);
        let jacobians: Option<Vec<Jacobian>> = match (&projection, known) {
            (Some(projection), _) => some_known(nodes.into_par_iter().map(|place| projection.near(place)).collect()),
            (None, Some(known)) if is_measured => measured(&known.degrees, xs, ys),
            (None, Some(known)) if eastward.is_some() => some_known(rows(&known.degrees, xs.len())),
            (None, _) => None,
        };
        // Longitudes and latitudes that are no map's may still tell where east is.
        let is_stretched = is_plane && jacobians.is_some() && (projection.is_some() || is_measured);
        let jacobians = match (jacobians, known) {
            (None, Some(known)) if eastward.is_some() && projection.is_none() => some_known(rows(&known.degrees, xs.len())),
            (jacobians, _) => jacobians,
        };
        let by = if projection.is_some() { "the grid mapping" } else { "the longitudes and latitudes of the nodes" };
        let scale = |[xe, xn, ye, yn]: &Jacobian| (xe * yn - xn * ye).abs().sqrt();
        let range =
            |values: &mut dyn Iterator<Item = f64>| values.fold([f64::INFINITY, f64::NEG_INFINITY], |[a, b], v| [a.min(v), b.max(v)]);
        match (eastward, jacobians) {
            (Some(why), Some(jacobians)) => {
                let greatest = range(&mut jacobians.iter().map(|[xe, _, ye, _]| ye.atan2(*xe).abs().to_degrees()))[1];
                let [least, most] = range(&mut jacobians.iter().map(scale));
                let stretched = match is_stretched {
                    true => format!(", and stretched to its metres by {least:.4} to {most:.4}"),
                    false => String::new(),
                };
                let note = format!(
                    "velocities run east and north ({why}) and are turned to x and y by {by}, by up to {greatest:.1} degrees{stretched}; --set \
                     archive.grid_relative=true if they run along x and y"
                );
                Ok(Some((Some(Self::new(jacobians.into_iter())), note)))
            }
            (None, Some(jacobians)) if is_stretched => {
                let [least, most] = range(&mut jacobians.iter().map(scale));
                let note = format!(
                    "velocities run along x and y, and are stretched to the metres of the projection by {by}, by {least:.4} to {most:.4}; --set \
                     archive.grid_relative=false if they run east and north"
                );
                let stretches = jacobians.iter().map(|jacobian| {
                    let [x, y] = along_axes(jacobian);
                    [x, 0.0, 0.0, y]
                });
                Ok(Some((Some(Self::new(stretches)), note)))
            }
            (None, _) => {
                let is_projected = x.is_some_and(|x| x.text("standard_name") == Some("projection_x_coordinate"));
                let unknown = "a metre along x and y is taken as a metre on the ground: neither a grid mapping that is known nor longitudes and latitudes of its \
                               points tell the scale of the projection";
                let set = settings.grid_relative.map(|_| "velocities run along x and y, as set".to_owned());
                Ok(set.or(is_projected.then(|| unknown.to_owned())).map(|note| (None, note)))
            }
            (Some(why), None) => {
                let what = "neither a grid mapping that is known nor longitudes and latitudes of its points tell where east is";
                if settings.grid_relative.is_some() {
                    return Err(SourceError::variable(
                        &file.listing.path,
                        &u.name,
                        format!("{what}, which archive.grid_relative=false needs"),
                    ));
                }
                let note = format!(
                    "WARNING: velocities run east and north ({why}), but are taken along x and y: {what}; name a file of its longitudes and \
                     latitudes too, or write --set archive.grid_relative=true if they do run along x and y"
                );
                Ok(Some((None, note)))
            }
        }
    }

    /// The projection of the grid mapping, unless longitudes and latitudes of the file lie elsewhere.
    fn projection(file: &DataFile, layout: &Layout, is_plane: bool, known: Option<&Positions>) -> Option<Projection> {
        let unit = if is_plane { unit_of_plane(layout)? } else { 1.0 };
        let mapping = mapping(file, layout)?;
        let projection = Projection::of(mapping.kind(), |name| mapping.numbers(name), unit)?;
        if matches!(projection, Projection::Plane { .. }) != is_plane {
            return None;
        }
        let Some(known) = known else { return Some(projection) };
        let (xs, ys) = (layout.axes[0].axis.coordinates(), layout.poles.rows_of_file(layout.axes[1].axis.coordinates()));
        let agrees = |i: usize, j: usize| {
            let (Some(found), expected) = (projection.position([xs[i], ys[j]]), known.degrees[j * xs.len() + i]) else { return false };
            let east = (found[0] - expected[0] + 180.0).rem_euclid(360.0) - 180.0;
            // Ellipsoids differ by a fifth of a degree.
            expected[0].is_nan() || (east * expected[1].to_radians().cos()).hypot(found[1] - expected[1]) < 0.25
        };
        let [right, top] = [xs.len() - 1, ys.len() - 1];
        (agrees(0, 0) && agrees(right, 0) && agrees(0, top) && agrees(right, top)).then_some(projection)
    }

    fn new(matrices: impl Iterator<Item = Jacobian>) -> Self {
        Self { matrices: matrices.map(|matrix| matrix.map(|d| d as f32)).collect() }
    }

    /// Turns and stretches the first two components, level after level.
    pub fn apply(&self, components: &mut [Vec<f32>]) {
        let [u, v, ..] = components else { return };
        debug_assert!(u.len().is_multiple_of(self.matrices.len()), "matrices of another grid");
        for (node, (u, v)) in u.iter_mut().zip(v).enumerate() {
            let [xx, xy, yx, yy] = self.matrices[node % self.matrices.len()];
            (*u, *v) = (xx * *u + xy * *v, yx * *u + yy * *v);
        }
    }
}

/// Metres along x and along y for a metre on the ground in the direction of these axes.
fn along_axes([xe, xn, ye, yn]: &Jacobian) -> [f64; 2] {
    let determinant = (xe * yn - xn * ye).abs();
    [determinant / yn.hypot(*ye), determinant / xn.hypot(*xe)]
}

/// `None` if nothing is known at any node. Velocities at nodes that lie nowhere are missing.
fn some_known(found: Vec<Jacobian>) -> Option<Vec<Jacobian>> {
    found.iter().any(|jacobian| jacobian[0].is_finite()).then_some(found)
}

/// Derivatives at nodes with known longitudes and latitudes, by second-order differences along both axes, whose coordinates are metres. Differences reach over
/// [`REACH`], over which no projection changes much, so that the last digits of the longitudes do not count. Where places are missing, derivatives are those of
/// the nearest node in the row. `None` if the metres are not those of a map.
fn measured(degrees: &[[f64; 2]], xs: &[f64], ys: &[f64]) -> Option<Vec<Jacobian>> {
    let width = xs.len();
    let along = |here: [f64; 2], n: usize, coordinates: &[f64], place: &dyn Fn(usize) -> [f64; 2]| {
        let last = coordinates.len() - 1;
        let wide = ((REACH / (coordinates[1] - coordinates[0])).ceil() as usize).clamp(1, (last / 2).max(1));
        let step = |a: usize, b: usize| coordinates[b] - coordinates[a];
        let ends: Vec<(usize, f64)> = match n {
            _ if last < 2 => vec![(last, 1.0 / step(0, last)), (0, -1.0 / step(0, last))],
            n if n < wide => {
                let [near, far] = [n + wide, (n + 2 * wide).min(last)];
                parabola(step(n, near), step(n, far)).into_iter().zip([n, near, far]).map(|(weight, node)| (node, weight)).collect()
            }
            n if n + wide > last => {
                let [near, far] = [n - wide, n.saturating_sub(2 * wide)];
                parabola(step(n, near), step(n, far)).into_iter().zip([n, near, far]).map(|(weight, node)| (node, weight)).collect()
            }
            n => vec![(n + wide, 1.0 / step(n - wide, n + wide)), (n - wide, -1.0 / step(n - wide, n + wide))],
        };
        let weighted: Vec<([f64; 2], f64)> = ends.into_iter().map(|(node, weight)| (place(node), weight)).collect();
        difference(here, &weighted).map(|share| share * EARTH_RADIUS)
    };
    let at = |node: usize| {
        let (i, j, here) = (node % width, node / width, degrees[node]);
        let [ex, nx] = along(here, i, xs, &|i| degrees[j * width + i]);
        let [ey, ny] = along(here, j, ys, &|j| degrees[j * width + i]);
        let determinant = ex * ny - ey * nx;
        [ny, -ey, -nx, ex].map(|d| d / determinant)
    };
    let mut found: Vec<Jacobian> = (0..degrees.len()).map(at).collect();
    let is_known = |jacobian: &Jacobian| jacobian.iter().all(|d| d.is_finite());
    let scale = |jacobian: &Jacobian| (jacobian[0] * jacobian[3] - jacobian[1] * jacobian[2]).abs().sqrt();
    if !found.iter().any(is_known) || found.iter().filter(|jacobian| is_known(jacobian)).any(|jacobian| !SCALES.contains(&scale(jacobian)))
    {
        return None;
    }
    // Coarsely rounded places scatter from node to node, as no map does.
    let bends = found.chunks(width).flat_map(|row| row.windows(3)).map(|nodes| {
        let [before, here, after] = [0, 1, 2].map(|k| scale(&nodes[k]));
        (before - 2.0 * here + after) / here
    });
    let (sum, count) = bends.filter(|bend| bend.is_finite()).fold((0.0, 0u32), |(sum, count), bend| (sum + bend * bend, count + 1));
    if (sum / f64::from(count.max(1))).sqrt() > MOST_BENT {
        return None;
    }
    for row in found.chunks_mut(width) {
        let known: Vec<usize> = (0..width).filter(|&i| is_known(&row[i])).collect();
        for i in 0..width {
            if let (false, Some(&nearest)) = (is_known(&row[i]), known.iter().min_by_key(|k| k.abs_diff(i))) {
                row[i] = row[nearest];
            }
        }
    }
    // Rows without a known node.
    found.iter_mut().filter(|jacobian| !jacobian.iter().all(|d| d.is_finite())).for_each(|jacobian| *jacobian = [f64::NAN; 4]);
    Some(found)
}

/// Weights of the values here and at two signed distances for the derivative of the parabola through them.
fn parabola(near: f64, far: f64) -> [f64; 3] {
    let [a, b] = [far / (near * (far - near)), -near / (far * (far - near))];
    [-a - b, a, b]
}

/// Turns at nodes with known longitudes and latitudes, by second-order differences along rows of `width`.
fn rows(degrees: &[[f64; 2]], width: usize) -> Vec<Jacobian> {
    let turn = |node: usize| {
        let at = |step: isize| degrees[node.wrapping_add_signed(step)];
        let row = match node % width {
            0 if width < 3 => [(at(1), 1.0), (at(0), -1.0), (at(0), 0.0)],
            _ if width < 3 => [(at(0), 1.0), (at(-1), -1.0), (at(0), 0.0)],
            0 => [(at(1), 4.0), (at(2), -1.0), (at(0), -3.0)],
            column if column + 1 == width => [(at(-1), -4.0), (at(-2), 1.0), (at(0), 3.0)],
            _ => [(at(1), 1.0), (at(-1), -1.0), (at(0), 0.0)],
        };
        turned(degrees[node], &row).unwrap_or([f64::NAN; 4])
    };
    (0..degrees.len()).map(turn).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A plane of single precision, 500 m a cell, and one whose longitudes are made up.
    #[test]
    fn scales_are_measured_over_many_cells() {
        let coordinates: Vec<f64> = (0..121).map(|i| 500.0 * f64::from(i)).collect();
        let place = |scale: f64, n: usize| {
            let [x, y] = [coordinates[n % 121], coordinates[n / 121]];
            let latitude = 60.0 + (y / scale / EARTH_RADIUS).to_degrees();
            let longitude = 100.0 + (x / scale / EARTH_RADIUS / latitude.to_radians().cos()).to_degrees();
            [longitude, latitude].map(|angle| f64::from(angle as f32))
        };
        let mut degrees: Vec<[f64; 2]> = (0..121 * 121).map(|n| place(1.1, n)).collect();
        degrees[121 * 40 + 40] = [f64::NAN; 2];
        let found = measured(&degrees, &coordinates, &coordinates).unwrap();
        for (n, jacobian) in found.iter().enumerate() {
            let scale = (jacobian[0] * jacobian[3] - jacobian[1] * jacobian[2]).sqrt();
            // Two metres in 20 km, and meridians that meet.
            assert!((scale / 1.1 - 1.0).abs() < 6e-4, "{n}: {scale}");
        }
        let made_up: Vec<[f64; 2]> = (0..121 * 121).map(|n| [(n % 121) as f64, 10.0 + (n / 121) as f64 * 0.5]).collect();
        assert_eq!(measured(&made_up, &coordinates, &coordinates), None);
        // To a hundredth of a degree, a kilometre.
        let rounded: Vec<[f64; 2]> = (0..121 * 121).map(|n| place(1.1, n).map(|angle| (100.0 * angle).round() / 100.0)).collect();
        assert_eq!(measured(&rounded, &coordinates, &coordinates), None);
    }

    #[test]
    fn a_plane_that_is_not_conformal_stretches_its_axes_apart() {
        // Turned by 30 degrees from east to x; a metre on the ground is 0.9 along x and 1.2 along y.
        let (sine, cosine) = 30f64.to_radians().sin_cos();
        let jacobian = [0.9 * cosine, 0.9 * sine, -1.2 * sine, 1.2 * cosine];
        let [x, y] = along_axes(&jacobian);
        assert!((x - 0.9).abs() < 1e-12 && (y - 1.2).abs() < 1e-12, "{x} {y}");
        let mut components = [vec![1.0f32, 0.0], vec![0.0, 1.0]];
        GroundToGrid::new([jacobian].into_iter()).apply(&mut components);
        let found = [components[0][0], components[1][0], components[0][1], components[1][1]].map(f64::from);
        let expected = [jacobian[0], jacobian[2], jacobian[1], jacobian[3]];
        assert!(found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6), "{found:?}");
    }
}
