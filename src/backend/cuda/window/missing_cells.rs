//! Missing cells on the device: grid cells without velocity data, in which no particle can start.

use crate::cuda::layout::{MissingCellsArgument, MissingCellsAxis};
use crate::cuda::{Buffer, DeviceError, Gpu};
use bytemuck::Zeroable;
use ridgewatch_flow::MissingCells;

/// Missing cells at the start time of one window.
#[derive(Debug)]
pub struct DeviceMissingCells {
    argument: MissingCellsArgument,
    // Owners of the memory that the argument points to.
    _nodes: Vec<Buffer<f64>>,
    _empty: Buffer<u8>,
}

impl DeviceMissingCells {
    /// Uploads the missing cells. `None` if every cell has data.
    ///
    /// # Errors
    /// The device fails or lacks memory.
    pub(in crate::cuda) fn new(gpu: &Gpu, voids: &MissingCells) -> Result<Option<Self>, DeviceError> {
        let Some((grid, empty)) = voids.cells() else { return Ok(None) };
        let mut argument = MissingCellsArgument { dimensions: grid.axes.len() as i32, ..Zeroable::zeroed() };
        let mut nodes = Vec::new();
        for (k, axis) in grid.axes.iter().enumerate() {
            let held = gpu.upload("missing cells", axis.coordinates())?;
            argument.axes[k] =
                MissingCellsAxis { nodes: held.address(), period: axis.period().unwrap_or(0.0), count: axis.len() as i32, pad: 0 };
            argument.cells[k] = axis.cells() as i32;
            nodes.push(held);
        }
        let empty: Vec<u8> = empty.into_iter().map(u8::from).collect();
        let empty = gpu.upload("missing cells", &empty)?;
        argument.missing = empty.address();
        Ok(Some(Self { argument, _nodes: nodes, _empty: empty }))
    }

    /// Kernel argument, the struct `MissingCells` of `missing_cells.cuh`.
    pub(in crate::cuda) fn argument(&self) -> MissingCellsArgument {
        self.argument
    }
}
