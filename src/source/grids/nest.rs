//! Place of a WRF grid: nests that follow a storm move by whole cells, from time to time and from file to file.
//!
//! The longitudes and latitudes of the grid's corners at some time are searched among those of its centres at the archive's first
//! time.

use super::locator::apart;
use crate::error::SourceError;
use crate::formats::DataFile;
use ridgewatch_field::EARTH_RADIUS;
use std::sync::Arc;

/// Largest distance of a corner from a centre, in cells: more than rounding, less than any move.
const SLACK: f64 = 0.1;

/// Longitudes and latitudes of the centres.
const CENTRES: [&str; 2] = ["XLONG", "XLAT"];

/// Cells along x and y by which a grid has moved.
pub type Shift = [isize; 2];

/// Place of a grid at the archive's first time.
#[derive(Debug, Clone)]
pub struct Nest {
    /// Centres along x and y.
    cells: [usize; 2],
    /// Longitude and latitude of each centre, degrees.
    centres: Arc<[[f64; 2]]>,
    /// Width of a cell, degrees of a great circle.
    width: f64,
}

impl Nest {
    /// Place at the first time of a file; `None` if the file does not say. `step` is the width of a cell in metres.
    pub fn of(file: &DataFile, cells: [usize; 2], step: f64) -> Result<Option<Self>, SourceError> {
        let Some(variables) = coordinates(file, cells) else { return Ok(None) };
        let centres = points(file, variables, 0, [0, 0], cells)?.into();
        Ok(Some(Self { cells, centres, width: (step / EARTH_RADIUS).to_degrees() }))
    }

    /// Shift of the grid from its first place, at an entry along time.
    ///
    /// # Errors
    /// No corner is a centre of the first place.
    pub fn shift(&self, file: &DataFile, entry: usize) -> Result<Shift, SourceError> {
        let fault = |what: String| SourceError::variable(&file.listing.path, CENTRES[0], what);
        let Some(variables) = coordinates(file, self.cells) else {
            return Err(fault("the longitudes and latitudes of the centres are missing, which the first file has".into()));
        };
        let [nx, ny] = self.cells;
        let mut first = None;
        for corner in [[0, 0], [nx - 1, 0], [0, ny - 1], [nx - 1, ny - 1]] {
            let point = points(file, variables, entry, corner, [1, 1])?[0];
            first = first.or(Some(point));
            let meets = |centre: usize| apart(point, self.centres[centre]) <= SLACK * self.width;
            // Most grids do not move.
            let own = corner[1] * nx + corner[0];
            let met = if meets(own) { Some(own) } else { (0..nx * ny).find(|&centre| meets(centre)) };
            if let Some(centre) = met {
                return Ok([(centre % nx) as isize - corner[0] as isize, (centre / nx) as isize - corner[1] as isize]);
            }
        }
        let [here, there] = [first.unwrap_or([f64::NAN; 2]), self.centres[0]].map(|[x, y]| format!("{x:.3} E, {y:.3} N"));
        Err(fault(format!(
            "the grid has moved: its first centre lies at {here} at time {entry} of this file, at {there} at the first time of the archive; accepted are \
             moves by whole cells, to places that overlap the first one"
        )))
    }
}

/// Longitudes and latitudes at all centres, at the first `entries` times of a file: x and y in cells of the first place, and the degrees at each
/// place, x fastest; NaN where no centre ever is. `None` if the file does not say, or cannot be read.
pub fn places(file: &DataFile, nest: &Nest, entries: usize) -> Option<([Vec<f64>; 2], Vec<[f64; 2]>)> {
    let [nx, ny] = nest.cells;
    let mut seen: Vec<(Shift, Vec<[f64; 2]>)> = Vec::new();
    for entry in 0..entries {
        let shift = nest.shift(file, entry).ok()?;
        if seen.iter().all(|(known, _)| *known != shift) {
            seen.push((shift, points(file, coordinates(file, nest.cells)?, entry, [0, 0], nest.cells).ok()?));
        }
    }
    let [least, greatest] = [isize::min as fn(isize, isize) -> isize, isize::max].map(|f| {
        let of = |k: usize| seen.iter().map(|(shift, _)| shift[k]).reduce(f);
        Some([of(0)?, of(1)?])
    });
    let (least, greatest) = (least?, greatest?);
    let [width, height] = [0, 1].map(|k| nest.cells[k] + (greatest[k] - least[k]) as usize);
    let mut degrees = vec![[f64::NAN; 2]; width * height];
    for (shift, centres) in &seen {
        let [i0, j0] = [0, 1].map(|k| (shift[k] - least[k]) as usize);
        for j in 0..ny {
            degrees[(j0 + j) * width + i0..][..nx].copy_from_slice(&centres[j * nx..][..nx]);
        }
    }
    let along = |k: usize, n: usize| (0..n).map(|a| (least[k] + a as isize) as f64).collect();
    Some(([along(0, width), along(1, height)], degrees))
}

/// The variables of longitude and latitude, on (y, x) or (time, y, x).
fn coordinates(file: &DataFile, [nx, ny]: [usize; 2]) -> Option<[usize; 2]> {
    let find = |name| {
        let index = file.listing.find(name)?;
        let shape = file.listing.shape(&file.listing.variables[index]);
        matches!(shape[..], [j, i] | [_, j, i] if [i, j] == [nx, ny]).then_some(index)
    };
    Some([find(CENTRES[0])?, find(CENTRES[1])?])
}

/// A rectangle of centres at an entry along time, x fastest.
fn points(
    file: &DataFile,
    variables: [usize; 2],
    entry: usize,
    [i, j]: [usize; 2],
    [nx, ny]: [usize; 2],
) -> Result<Vec<[f64; 2]>, SourceError> {
    let read = |variable: usize| {
        let places = [(entry, 1), (j, ny), (i, nx)];
        let rank = file.listing.variables[variable].dimensions.len();
        let (start, count): (Vec<usize>, Vec<usize>) = places[3 - rank..].iter().copied().unzip();
        file.read(variable, start, count)
    };
    let (longitude, latitude) = (read(variables[0])?, read(variables[1])?);
    Ok(longitude.into_iter().zip(latitude).map(|(x, y)| [x, y]).collect())
}
