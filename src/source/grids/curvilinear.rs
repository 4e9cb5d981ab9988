//! Longitudes and latitudes as arrays of two dimensions (ocean models, projections), resampled to a grid of even longitudes and
//! latitudes.
//!
//! Algorithm: each node of the new grid is located in a cell of the mesh, in the plane that touches the sphere at the cell (gnomonic
//! projection). Its value is the inverse bilinear interpolation of the cell's four corners. It is missing if a corner is missing or no
//! cell contains the node. Each horizontal component is resampled from its own points as a vector in space, along its direction
//! there: east and north turn about a pole within a cell, vectors do not.

use super::component::{ComponentPlan, SquaredErrors, read_component};
use super::locator::{Locator, Mesh, Target};
use crate::error::SourceError;
use crate::formats::DataFile;
use std::sync::Arc;

/// How to read a file of curvilinear coordinates.
#[derive(Debug)]
pub struct Curvilinear {
    /// Places of the grid's nodes among the points of each component.
    pub locators: Vec<Arc<Locator>>,
    /// Points of each component.
    pub meshes: Vec<Arc<Mesh>>,
    pub target: Target,
    /// Unit vectors along u and v, at each of their points.
    pub directions: [Vec<[f32; 3]>; 2],
    /// Unit vectors to the east and to the north, at each node of the grid.
    pub bases: [Vec<[f32; 3]>; 2],
    /// Description of the resampling.
    pub what: String,
}

impl Curvilinear {
    /// Reads one entry along time onto the grid. `levels` are the file's entries of the grid's levels.
    pub fn read(&self, file: &DataFile, frame: &[ComponentPlan], entry: usize, levels: &[usize]) -> Result<Vec<Vec<f32>>, SourceError> {
        let values = |which: usize| {
            let [x, y, _] = frame[which].file_order();
            read_component(file, &frame[which], &[x, y, levels.to_vec()], entry)
        };
        let mut out = self.horizontal(&values(0)?, &values(1)?);
        if let Some(locator) = self.locators.get(2) {
            out.push(values(2)?.chunks_exact(locator.points()).flat_map(|level| locator.apply(level)).collect());
        }
        Ok(out)
    }

    /// Eastward and northward velocities at the nodes of all levels.
    fn horizontal(&self, u: &[f32], v: &[f32]) -> Vec<Vec<f32>> {
        let mut out = vec![Vec::new(), Vec::new()];
        for levels in u.chunks_exact(self.locators[0].points()).zip(v.chunks_exact(self.locators[1].points())) {
            let along: [Vec<f32>; 3] = std::array::from_fn(|k| {
                let part = |which: usize, level: &[f32]| {
                    let part: Vec<f32> = level.iter().zip(&self.directions[which]).map(|(value, d)| value * d[k]).collect();
                    self.locators[which].apply(&part)
                };
                part(0, levels.0).iter().zip(part(1, levels.1)).map(|(a, b)| a + b).collect()
            });
            for (values, base) in out.iter_mut().zip(&self.bases) {
                values.extend(base.iter().enumerate().map(|(node, e)| (0..3).map(|k| e[k] * along[k][node]).sum::<f32>()));
            }
        }
        out
    }

    /// See [`super::layout::Resampling::error`]. Interpolates vectors, as the flow is sampled.
    pub fn error(&self, file: &DataFile, frame: &[ComponentPlan], entry: usize) -> Result<[f64; 2], SourceError> {
        let mut own = Vec::with_capacity(2);
        for plan in &frame[..2] {
            own.push(read_component(file, plan, &plan.file_order(), entry)?);
        }
        let on_grid = self.horizontal(&own[0], &own[1]);
        let nodes = self.bases[0].len();
        let mut sums = SquaredErrors::default();
        for (level, (east, north)) in on_grid[0].chunks_exact(nodes).zip(on_grid[1].chunks_exact(nodes)).enumerate() {
            let along: [Vec<f32>; 3] =
                std::array::from_fn(|k| (0..nodes).map(|n| east[n] * self.bases[0][n][k] + north[n] * self.bases[1][n][k]).collect());
            for which in 0..2 {
                let (mesh, points) = (&self.meshes[which], self.locators[which].points());
                for (point, &value) in own[which][level * points..][..points].iter().enumerate() {
                    let at = |k: usize| self.target.interpolate(&along[k], mesh.longitude[point], mesh.latitude[point]);
                    let found: f64 = (0..3).map(|k| at(k) * f64::from(self.directions[which][point][k])).sum();
                    sums.add(found, value.into());
                }
            }
        }
        Ok(sums.root_mean_squares())
    }
}
