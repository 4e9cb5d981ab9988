//! The table surrogate on the device: log-stretch traced at the nodes of a regular grid, with multilinear interpolation in between.
//!
//! The seeds are generated brick by brick (8^3 or 8^2 nodes), so that neighbouring threads trace neighbouring seeds.

use crate::cuda::layout::{Outputs, TableArgument, TableFrame, UnitBoxArgument};
use crate::cuda::tracing::sort::Sorter;
use crate::cuda::tracing::trace::DeviceTracer;
use crate::cuda::{Buffer, DeviceError, DevicePredict, Gpu, launch, threads};
use cudarc::driver::{CudaFunction, PushKernelArg};
use ridgewatch_field::Domain;
use ridgewatch_surrogate::Table;
use std::sync::Arc;

/// Log-stretch at nodes i / (n - 1) of the unit domain, x fastest.
#[derive(Debug)]
pub struct DeviceTable {
    gpu: Arc<Gpu>,
    frame: TableFrame,
    values: Buffer<f32>,
    /// Seeds that are traced, in the order of the bricks; the maximum if the values come from elsewhere.
    traced: usize,
    not_finite: usize,
    bricks: CudaFunction,
    mend: CudaFunction,
    lookup: CudaFunction,
    /// Memory for the seeds of one part of the grid.
    scratch: Sorter,
}

/// Nodes along the edge of a brick in `table_bricks`.
const EDGE: usize = 8;

impl DeviceTable {
    /// Traces every node. In two dimensions, the number of nodes along z is ignored. Along the other axes it is at least 2.
    ///
    /// # Errors
    /// The table has more nodes than 32 bits can count, or the device fails or lacks memory.
    pub fn trace(tracer: &DeviceTracer, domain: &Domain, nodes: [usize; 3]) -> Result<Self, DeviceError> {
        let mut table = Self::untraced(tracer.gpu(), domain, nodes)?;
        table.trace_more(tracer, usize::MAX)?;
        Ok(table)
    }

    /// Uploads a table of the host.
    ///
    /// # Errors
    /// As for [`Self::trace`].
    pub fn upload(gpu: &Arc<Gpu>, domain: &Domain, table: &Table) -> Result<Self, DeviceError> {
        let mut copy = Self::untraced(gpu, domain, table.nodes())?;
        copy.values.write(table.values())?;
        (copy.traced, copy.not_finite) = (usize::MAX, table.not_finite());
        Ok(copy)
    }

    /// Creates a table with the same nodes and the values of `table`.
    ///
    /// # Errors
    /// The device fails or lacks memory.
    pub(in crate::cuda) fn with_values(&self, table: &Table) -> Result<Self, DeviceError> {
        let domain =
            ridgewatch_field::Domain { dimensions: self.frame.dimensions as usize, ..ridgewatch_field::Domain::cuboid([0.0; 3], [1.0; 3]) };
        let mut copy = Self::untraced(&self.gpu, &domain, self.nodes())?;
        copy.frame = self.frame;
        copy.values.write(table.values())?;
        (copy.traced, copy.not_finite) = (usize::MAX, table.not_finite());
        Ok(copy)
    }

    /// The GPU that holds the table.
    pub fn gpu(&self) -> &Arc<Gpu> {
        &self.gpu
    }

    /// Creates a table none of whose nodes is traced yet; their values are uninitialised.
    ///
    /// # Errors
    /// As for [`Self::trace`].
    pub fn untraced(gpu: &Arc<Gpu>, domain: &Domain, nodes: [usize; 3]) -> Result<Self, DeviceError> {
        let dimensions = domain.dimensions.clamp(2, 3);
        let nodes: [usize; 3] = std::array::from_fn(|k| if k < dimensions { nodes[k].max(2) } else { 1 });
        let all = nodes.iter().try_fold(1usize, |all, n| all.checked_mul(*n)).filter(|all| *all < u32::MAX as usize);
        let Some(all) = all else { return Err(DeviceError::Unsupported { what: format!("a table of {nodes:?} nodes") }) };
        let kernel = |name| gpu.kernel("table.cu", &[], name);
        Ok(Self {
            gpu: gpu.clone(),
            frame: TableFrame { nodes: nodes.map(|n| n as i32), dimensions: dimensions as i32, domain: UnitBoxArgument::new(domain) },
            values: gpu.alloc("a table", all)?,
            traced: 0,
            not_finite: 0,
            bricks: kernel("table_bricks")?,
            mend: kernel("table_mend")?,
            lookup: kernel("table_lookup")?,
            scratch: Sorter::new(gpu)?,
        })
    }

    /// Traces every node again, after the window has slid. Waits for the result.
    ///
    /// # Errors
    /// The device fails or lacks memory.
    pub fn retrace(&mut self, tracer: &DeviceTracer) -> Result<(), DeviceError> {
        self.traced = 0;
        self.trace_more(tracer, usize::MAX).map(drop)
    }

    /// Traces the next nodes, about `most`. True once every node is traced. Waits for the result.
    ///
    /// # Errors
    /// The device fails or lacks memory.
    pub fn trace_more(&mut self, tracer: &DeviceTracer, most: usize) -> Result<bool, DeviceError> {
        let nodes = self.frame.nodes.map(|n| n as usize);
        let [bricks_x, bricks_y, bricks_z] = nodes.map(|n| n.div_ceil(EDGE));
        let in_brick = if self.frame.dimensions == 3 { EDGE * EDGE * EDGE } else { EDGE * EDGE };
        // Bricks at the faces reach beyond the nodes.
        let all = bricks_x * bricks_y * bricks_z * in_brick;
        let end = all.min(self.traced.saturating_add(most));
        let stream = self.gpu.work().clone();
        let out = Outputs { log_stretch: self.values.address(), ..Outputs::default() };
        let (x, y) = (bricks_x as u32, bricks_y as u32);
        let at_once = self.scratch.at_once();
        for first in (self.traced..end).step_by(at_once) {
            let count = (end - first).min(at_once);
            let seeds = self.scratch.buffer(count)?;
            let (from, n) = (first as u64, count as u32);
            // SAFETY: arguments as declared in table.cu; `seeds` holds `count` entries, and `values` holds every node.
            unsafe {
                let mut call = stream.launch_builder(&self.bricks);
                launch(call.arg(&self.frame).arg(&x).arg(&y).arg(&from).arg(&n).arg(&seeds), threads(count, 256))?;
                tracer.in_sequence(seeds, count, &out)?;
            }
        }
        self.traced = end;
        if end < all {
            self.gpu.synchronize()?;
            return Ok(false);
        }
        let values = self.values.len() as u64;
        let odd = self.gpu.upload("a counter", &[0u32])?;
        let (address, counter) = (self.values.address(), odd.address());
        // SAFETY: arguments as declared in table.cu.
        unsafe {
            launch(stream.launch_builder(&self.mend).arg(&address).arg(&values).arg(&counter), threads(self.values.len(), 256))?;
        }
        let mut count = [0u32];
        odd.read(&mut count)?;
        self.not_finite = count[0] as usize;
        // Freed until the next slide, because for a fine grid it is half as large as the table.
        self.scratch.release();
        Ok(true)
    }

    /// Nodes along x, y, z.
    pub fn nodes(&self) -> [usize; 3] {
        self.frame.nodes.map(|n| n as usize)
    }
    /// Number of nodes whose traced value is not finite. They hold 0.
    pub fn not_finite(&self) -> usize {
        self.not_finite
    }
    /// Device address of the values.
    pub fn address(&self) -> u64 {
        self.values.address()
    }
    /// Kernel argument, the struct `Table` of `table.cuh`.
    pub(in crate::cuda) fn argument(&self) -> TableArgument {
        let TableFrame { nodes, dimensions, .. } = self.frame;
        TableArgument { nodes, dimensions, values: self.values.address() }
    }
    /// Reads the values back, while later work continues on the device.
    ///
    /// # Errors
    /// The device fails or lacks pinned memory.
    pub fn values(&self) -> Result<Vec<f32>, DeviceError> {
        self.gpu.readback().read(&self.values, self.values.len())
    }
}

impl DevicePredict for DeviceTable {
    unsafe fn predict(&self, points: u64, count: usize, out: u64) -> Result<(), DeviceError> {
        if count == 0 {
            return Ok(());
        }
        let (table, n) = (self.argument(), count as u32);
        let stream = self.gpu.work();
        let mut call = stream.launch_builder(&self.lookup);
        call.arg(&table).arg(&points).arg(&n).arg(&out);
        // SAFETY: arguments as declared in table.cu; the caller guarantees the addresses.
        unsafe { launch(&mut call, threads(count, 256)) }
    }
}
