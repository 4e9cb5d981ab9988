//! The cells in which no particle can start, on the device.

use super::layout::{LandArgument, LandAxis};
use super::{Buffer, DeviceError, Gpu};
use crate::flow::MissingCells;

/// Land under the seeds of one window.
#[derive(Debug)]
pub struct DeviceLand {
    argument: LandArgument,
    // Memory that the argument points to.
    _nodes: Vec<Buffer<f64>>,
    _empty: Buffer<u8>,
}

impl DeviceLand {
    /// None where particles can start everywhere.
    pub(super) fn new(gpu: &Gpu, voids: &MissingCells) -> Result<Option<Self>, DeviceError> {
        let Some((grid, empty)) = voids.cells() else { return Ok(None) };
        let mut argument = LandArgument { dimensions: grid.axes.len() as i32, ..LandArgument::NONE };
        let mut nodes = Vec::new();
        for (k, axis) in grid.axes.iter().enumerate() {
            let held = gpu.upload("land", axis.coordinates())?;
            argument.axes[k] = LandAxis { nodes: held.address(), period: axis.period().unwrap_or(0.0), count: axis.len() as i32, pad: 0 };
            argument.cells[k] = axis.cells() as i32;
            nodes.push(held);
        }
        let empty: Vec<u8> = empty.into_iter().map(u8::from).collect();
        let empty = gpu.upload("land", &empty)?;
        argument.empty = empty.address();
        Ok(Some(Self { argument, _nodes: nodes, _empty: empty }))
    }

    /// `Land` of `land.cuh`.
    pub(super) fn argument(&self) -> LandArgument {
        self.argument
    }
}
