//! One component of the velocity in a file, and its values at one time.

use super::axes::runs;
use super::column::Columns;
use super::land::Mask;
use super::own_axes::OwnAxis;
use crate::cf::packing::Packing;
use crate::error::SourceError;
use crate::formats::DataFile;
use std::sync::Arc;

/// Meaning of a dimension of a variable.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Role {
    Time,
    /// Axis 0, 1 or 2 of the grid.
    Axis(usize),
    /// Always this entry.
    Fixed(usize),
}

/// A component in one file. The packing may differ from file to file.
#[derive(Debug, Clone, PartialEq)]
pub struct ComponentPlan {
    pub name: String,
    pub shape: Vec<usize>,
    /// Names of its dimensions.
    pub dimensions: Vec<String>,
    pub roles: Vec<Role>,
    pub packing: Packing,
    /// Factor to SI.
    pub factor: f64,
    /// Why it was chosen.
    pub why: String,
    /// True if its names say that it is a velocity of water, and of air.
    pub of_water: bool,
    pub of_air: bool,
    /// Its points on land.
    pub mask: Option<Arc<Mask>>,
    /// Levels that follow the bottom, and the heights that they are interpolated to.
    pub columns: Option<Arc<Columns>>,
    /// Coordinates of its own along x, y and z, where those of the other components differ.
    pub own: [Option<Arc<OwnAxis>>; 3],
}

impl ComponentPlan {
    /// Entries along an axis of the grid; 1 if it has no such axis.
    pub fn along(&self, axis: usize) -> usize {
        self.roles.iter().zip(&self.shape).find(|(role, _)| **role == Role::Axis(axis)).map_or(1, |(_, &n)| n)
    }

    /// Levels that [`super::own_axes::read_levels`] counts.
    pub fn levels(&self) -> usize {
        match (&self.columns, &self.own[2]) {
            (Some(columns), _) => columns.heights.len(),
            (None, Some(own)) => own.nodes(),
            (None, None) => self.along(2),
        }
    }

    /// True if nodes of the grid are no points of the component.
    pub fn is_interpolated(&self) -> bool {
        self.columns.is_some() || self.own.iter().any(Option::is_some)
    }

    /// All entries in the order of the file.
    pub fn file_order(&self) -> Orders {
        [0, 1, 2].map(|axis| (0..self.along(axis)).collect())
    }
}

/// Entries of the file that are the nodes along x, y and z.
pub type Orders = [Vec<usize>; 3];

/// Reads one component at one entry along time, x fastest, in SI; missing values are NaN.
///
/// # Errors
/// The values cannot be read.
pub fn read_component(file: &DataFile, component: &ComponentPlan, orders: &Orders, entry: usize) -> Result<Vec<f32>, SourceError> {
    let [nx, ny, nz] = [0, 1, 2].map(|k| orders[k].len());
    let variable = file.listing.find(&component.name).ok_or_else(|| file.listing.read_error(&component.name, "it is gone"))?;
    // Before memory is taken: a file of a few bytes may claim any extent.
    let total = file.listing.check_count(&file.listing.variables[variable], &[nx, ny, nz])?;
    let mut values = Vec::new();
    let lacking = |_| file.listing.read_error(&component.name, format!("out of memory for {total} values"));
    values.try_reserve_exact(total).map_err(lacking)?;
    values.resize(total, f32::NAN);
    let (runs_x, runs_y, runs_z) = (runs(&orders[0]), runs(&orders[1]), runs(&orders[2]));
    for run_z in &runs_z {
        for run_y in &runs_y {
            for run_x in &runs_x {
                let block = [run_x, run_y, run_z];
                let (start, count): (Vec<usize>, Vec<usize>) = component
                    .roles
                    .iter()
                    .map(|role| match *role {
                        Role::Time => (entry, 1),
                        Role::Fixed(index) => (index, 1),
                        Role::Axis(k) => (block[k].start, block[k].nodes.len()),
                    })
                    .unzip();
                // Distance in the block between neighbours along each axis of the grid.
                let (mut strides, mut stride) = ([0usize; 3], 1);
                for (role, n) in component.roles.iter().zip(&count).rev() {
                    if let Role::Axis(k) = *role {
                        strides[k] = stride;
                    }
                    stride *= n;
                }
                let raw = file.read(variable, start, count)?;
                let at = |k: usize, i: usize| if block[k].reversed { block[k].nodes.len() - 1 - i } else { i } * strides[k];
                for z in 0..run_z.nodes.len() {
                    for y in 0..run_y.nodes.len() {
                        let from = at(2, z) + at(1, y);
                        let to = ((run_z.nodes.start + z) * ny + run_y.nodes.start + y) * nx + run_x.nodes.start;
                        for x in 0..run_x.nodes.len() {
                            values[to + x] = (component.packing.unpack(raw[from + at(0, x)]) * component.factor) as f32;
                        }
                    }
                }
            }
        }
    }
    if let Some(mask) = &component.mask {
        for (i, value) in values.iter_mut().enumerate() {
            if mask.is_land([orders[0][i % nx], orders[1][i / nx % ny], orders[2][i / (nx * ny)]]) {
                *value = f32::NAN;
            }
        }
    }
    Ok(values)
}

/// Sums of squares of interpolated values against exact ones.
#[derive(Default)]
pub struct SquaredErrors {
    error: f64,
    size: f64,
    count: usize,
}

impl SquaredErrors {
    /// Counts a pair of finite values.
    pub fn add(&mut self, found: f64, exact: f64) {
        if found.is_finite() && exact.is_finite() {
            self.error += (found - exact).powi(2);
            self.size += exact.powi(2);
            self.count += 1;
        }
    }

    /// Root mean squares of the error and of the exact values.
    pub fn root_mean_squares(&self) -> [f64; 2] {
        [self.error, self.size].map(|sum| (sum / self.count.max(1) as f64).sqrt())
    }
}
