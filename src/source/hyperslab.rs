//! One time of one component, from the file's order onto the grid.

use super::SourceError;
use super::axes::runs;
use super::container::Container;
use super::layout::{ComponentPlan, Role};

/// Which entries of the file are the nodes along x, y and z.
pub(super) type Orders = [Vec<usize>; 3];

/// All entries, as they stand in the file; one where there is no such axis.
pub(super) fn as_in_file(component: &ComponentPlan) -> Orders {
    std::array::from_fn(|k| {
        let along = component.roles.iter().zip(&component.shape).find(|(role, _)| **role == Role::Axis(k));
        (0..along.map_or(1, |(_, &n)| n)).collect()
    })
}

/// Reads one time of one component, x fastest.
pub(super) fn read_component(file: &Container, component: &ComponentPlan, orders: &Orders, entry: usize) -> Result<Vec<f32>, SourceError> {
    let [nx, ny, nz] = [0, 1, 2].map(|k| orders[k].len());
    let gone = || SourceError::Read { path: file.path.clone(), variable: component.name.clone(), what: "it is gone".into() };
    let variable = file.header.find(&component.name).ok_or_else(gone)?;
    let mut values = vec![f32::NAN; nx * ny * nz];
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
                let raw = file.read(variable, &start, &count)?;
                // Distance in `raw` between neighbours along each axis of the grid.
                let (mut strides, mut stride) = ([0usize; 3], 1);
                for (role, n) in component.roles.iter().zip(&count).rev() {
                    if let Role::Axis(k) = *role {
                        strides[k] = stride;
                    }
                    stride *= n;
                }
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
    Ok(values)
}
