//! Flow maps that some device traces.

use ridgewatch_base::DeviceError;
use ridgewatch_field::DomainPoint;
use ridgewatch_flow::{Extras, Traced, Tracer};

/// A flow map on any device. Tracing fails if the device fails.
pub trait Trace: Send + Sync {
    /// The flow map on the CPU: domain, start, duration, steps and missing cells.
    fn flow(&self) -> &dyn Tracer;

    /// Traces seeds, as [`Tracer::trace`] does.
    ///
    /// # Errors
    /// The device fails; `out` is then unspecified.
    fn trace(&self, seeds: &[DomainPoint], extras: Extras, out: &mut Traced) -> Result<(), DeviceError>;

    /// Traces seeds and returns the seconds that the processor takes. Copies to and from a device do not count.
    ///
    /// # Errors
    /// The device fails or lacks memory.
    fn seconds(&self, seeds: &[DomainPoint], out: &mut Traced) -> Result<f64, DeviceError> {
        let began = std::time::Instant::now();
        self.trace(seeds, Extras::default(), out)?;
        Ok(began.elapsed().as_secs_f64())
    }
}

impl<T: Tracer> Trace for T {
    fn flow(&self) -> &dyn Tracer {
        self
    }

    fn trace(&self, seeds: &[DomainPoint], extras: Extras, out: &mut Traced) -> Result<(), DeviceError> {
        Tracer::trace(self, seeds, extras, out);
        Ok(())
    }
}
