//! Tracing on the GPU: seeds are sorted by cell and traced in batches. Also the table surrogate, whose nodes are traced seeds.

mod sort;
mod table;
pub(super) mod trace;
mod tracer;

pub use sort::{SortCells, Sorter};
pub use table::DeviceTable;
pub use trace::{DeviceTracer, Tuning};
pub use tracer::CudaTracer;
