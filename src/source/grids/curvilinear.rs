//! Longitudes and latitudes as arrays of two dimensions (ocean models, projections), resampled to a grid of even longitudes and
//! latitudes.
//!
//! Algorithm: each node of the new grid is located in a cell of the mesh, in the plane that touches the sphere at the cell (gnomonic
//! projection). Its value is the inverse bilinear interpolation of the cell's four corners. It is missing if a corner is missing or no
//! cell contains the node. Points without rows are the corners of triangles: see [`super::triangles`]. Each horizontal component is
//! resampled from its own points as a vector in space, along its direction there: east and north turn about a pole within a cell, vectors
//! do not.

use super::axes::{AxisPlan, Quantity};
use super::component::ComponentPlan;
use super::locator::{Locator, Mesh, Target};
use super::own_axes::read_levels;
use super::refine::Choice;
use crate::cf::coordinate::Kind;
use crate::error::SourceError;
use crate::formats::DataFile;
use ridgewatch_field::{Axis, AxisFault};
use std::sync::Arc;

/// How to read a file of curvilinear coordinates.
#[derive(Debug, Clone)]
pub struct Curvilinear {
    /// Names of the longitudes and latitudes.
    pub names: [String; 2],
    /// Points of each component.
    pub meshes: Vec<Arc<Mesh>>,
    /// Unit vectors along u and v, at each of their points.
    pub directions: Arc<[Vec<[f32; 3]>; 2]>,
    pub target: Target,
    /// Places of the grid's nodes among the points of each component.
    pub locators: Vec<Arc<Locator>>,
    /// Unit vectors to the east and to the north, at each node of the grid.
    pub bases: [Vec<[f32; 3]>; 2],
    /// Why the grid has this spacing.
    pub choice: Choice,
}

/// Vectors in space: their components along x, y and z.
pub type Vectors = [Vec<f32>; 3];

impl Curvilinear {
    /// Locates the nodes of a grid among the points of each component. Components on the same points share their mesh.
    pub fn new(names: [String; 2], meshes: Vec<Arc<Mesh>>, directions: Arc<[Vec<[f32; 3]>; 2]>, target: Target, choice: Choice) -> Self {
        let locators = locators(&meshes, &target);
        Self { names, meshes, directions, target, locators, bases: target.bases(), choice }
    }

    /// The same mesh on another grid.
    pub fn on(&self, target: Target, choice: Choice) -> Self {
        Self::new(self.names.clone(), self.meshes.clone(), self.directions.clone(), target, choice)
    }

    /// Description of the resampling.
    pub fn what(&self) -> String {
        let ([a, b], [mx, my], [nx, ny], [dx, dy]) = (&self.names, self.meshes[0].shape, self.target.nodes, self.target.step);
        let from = match &self.meshes[0].triangles {
            None => format!("have two dimensions: resampled bilinearly from {mx} x {my} points"),
            Some(triangles) => format!("are those of a mesh without rows: resampled from {mx} points{triangles}"),
        };
        format!("`{a}` and `{b}` {from} to {nx} x {ny} nodes, every {dx:.4} x {dy:.4} degrees ({})", self.choice)
    }

    /// Longitudes and latitudes of the grid; longitudes that go round are periodic if `periodic` is set.
    pub fn axes(&self, periodic: bool) -> Result<[AxisPlan; 2], AxisFault> {
        let Target { first, step, nodes, round } = self.target;
        let axis = |k: usize, kind: Kind, units: &str| {
            let axis = Axis::uniform(self.names[k].as_str(), units, first[k], first[k] + step[k] * (nodes[k] - 1) as f64, nodes[k])?;
            Ok(AxisPlan::made(kind, if k == 0 && round && periodic { axis.with_period(360.0) } else { axis }, Quantity::Angle))
        };
        Ok([axis(0, Kind::Longitude, "degrees_east")?, axis(1, Kind::Latitude, "degrees_north")?])
    }

    /// Reads one entry along time onto the grid. `levels` are the grid's, as [`read_levels`] counts them.
    pub fn read(&self, file: &DataFile, frame: &[ComponentPlan], entry: usize, levels: &[usize]) -> Result<Vec<Vec<f32>>, SourceError> {
        let values = |which: usize| {
            let [x, y, _] = frame[which].file_order();
            read_levels(file, &frame[which], &[x, y, levels.to_vec()], entry)
        };
        let mut out = self.horizontal(&values(0)?, &values(1)?);
        if let Some(locator) = self.locators.get(2) {
            out.push(values(2)?.chunks_exact(locator.points()).flat_map(|level| locator.apply(level)).collect());
        }
        Ok(out)
    }

    /// Eastward and northward velocities at the nodes of all levels.
    pub fn horizontal(&self, u: &[f32], v: &[f32]) -> Vec<Vec<f32>> {
        let mut out = vec![Vec::new(), Vec::new()];
        for along in self.vectors(&self.locators, u, v) {
            for (values, base) in out.iter_mut().zip(&self.bases) {
                values.extend(base.iter().enumerate().map(|(node, e)| (0..3).map(|k| e[k] * along[k][node]).sum::<f32>()));
            }
        }
        out
    }

    /// Velocities, level after level, at places that `locators` have located.
    pub fn vectors<'a>(&'a self, locators: &'a [Arc<Locator>], u: &'a [f32], v: &'a [f32]) -> impl Iterator<Item = Vectors> + 'a {
        u.chunks_exact(locators[0].points()).zip(v.chunks_exact(locators[1].points())).map(move |levels| {
            std::array::from_fn(|k| {
                let part = |which: usize, level: &[f32]| {
                    let part: Vec<f32> = level.iter().zip(&self.directions[which]).map(|(value, d)| value * d[k]).collect();
                    locators[which].apply(&part)
                };
                part(0, levels.0).iter().zip(part(1, levels.1)).map(|(a, b)| a + b).collect()
            })
        })
    }
}

/// Places of a grid's nodes among the points of each component.
pub fn locators(meshes: &[Arc<Mesh>], target: &Target) -> Vec<Arc<Locator>> {
    let mut found: Vec<Arc<Locator>> = Vec::new();
    for (k, mesh) in meshes.iter().enumerate() {
        let twin = meshes[..k].iter().position(|other| Arc::ptr_eq(other, mesh));
        found.push(twin.map_or_else(|| Arc::new(Locator::new(mesh, target)), |twin| found[twin].clone()));
    }
    found
}
