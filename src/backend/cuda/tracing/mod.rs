//! Seeds on the GPU: sorted by cell, traced in one batch, and tables of traced nodes.

mod sort;
mod table;
pub(super) mod trace;
mod tracer;

pub use sort::{SortCells, Sorter};
pub use table::DeviceTable;
pub use trace::{DeviceTracer, Tuning};
pub use tracer::CudaTracer;
