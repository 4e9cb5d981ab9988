//! Flow maps that some device traces.

use ridgewatch_base::DeviceError;
use ridgewatch_flow::{Extras, Traced, Tracer};

/// A flow map on any device. Tracing fails if the device fails.
pub trait Trace: Send + Sync {
    /// The flow map on the CPU: domain, start, duration, steps and missing cells.
    fn flow(&self) -> &dyn Tracer;

    /// Traces seeds, as [`Tracer::trace`] does.
    ///
    /// # Errors
    /// The device fails; `out` is then unspecified.
    fn trace(&self, seeds: &[[f32; 3]], extras: Extras, out: &mut Traced) -> Result<(), DeviceError>;
}

impl<T: Tracer> Trace for T {
    fn flow(&self) -> &dyn Tracer {
        self
    }

    fn trace(&self, seeds: &[[f32; 3]], extras: Extras, out: &mut Traced) -> Result<(), DeviceError> {
        Tracer::trace(self, seeds, extras, out);
        Ok(())
    }
}
