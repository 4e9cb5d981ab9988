//! Audit of a frame on the device, by the method of [`crate::audit`]: stratified random points, drawn with Philox4x32-10.
//!
//! The device draws, traces and predicts the points, and sums the residuals of each cell. The host reads back the sums, the optical residual of each
//! point (for quantiles), and the samples if they are requested for training.

use crate::audit::{AuditFindings, AuditRequest, draws};
use crate::cuda::driver::pinned::Pinned;
use crate::cuda::layout::{AuditBatchArgument, AuditDrawArgument, AuditPointsArgument, CellFindings, Outputs, UnitBoxArgument};
use crate::cuda::{Buffer, CudaTracer, DeviceError, DeviceMissingCells, DevicePredict, Gpu, launch, threads};
use crate::router::unit_jacobian;
use cudarc::driver::{CudaFunction, DeviceRepr, PushKernelArg};
use ridgewatch_field::{Domain, DomainPoint, UnitPoint};
use ridgewatch_flow::Extras;
use ridgewatch_surrogate::Samples;
use ridgewatch_trust::Audited;
use std::ops::Range;
use std::sync::Arc;

/// Limit on the points of a batch, to bound the memory. A batch of a single cell may have more.
const MAX_POINTS: usize = 1 << 22;
/// Threads of a warp. Each warp processes one cell.
const WARP: usize = 32;

/// Audits frames. It reuses its memory between frames.
pub struct Audits {
    gpu: Arc<Gpu>,
    draw: CudaFunction,
    measure: CudaFunction,
    memory: Option<Memory>,
}

/// Device memory for the points of one batch and for all cells, with pinned memory for the readback.
struct Memory {
    unit: Buffer<[f32; 3]>,
    points: Buffer<[f32; 3]>,
    missing: Buffer<u8>,
    traced: Buffer<f32>,
    lifetime_share: Buffer<f32>,
    /// `None` until arrival points are requested.
    arrivals: Option<Buffer<[f32; 3]>>,
    /// `None` until Jacobians are requested.
    jacobians: Option<Buffer<[f32; 9]>>,
    predicted: Buffer<f32>,
    optical: Buffer<f32>,
    begins: Buffer<u32>,
    findings: Buffer<CellFindings>,
    unit_back: Pinned<[f32; 3]>,
    missing_back: Pinned<u8>,
    traced_back: Pinned<f32>,
    optical_back: Pinned<f32>,
    findings_back: Pinned<CellFindings>,
}

impl Memory {
    fn new(gpu: &Gpu, points: usize, cells: usize) -> Result<Self, DeviceError> {
        let what = "audit points";
        Ok(Self {
            unit: gpu.alloc(what, points)?,
            points: gpu.alloc(what, points)?,
            missing: gpu.alloc(what, points)?,
            traced: gpu.alloc(what, points)?,
            lifetime_share: gpu.alloc(what, points)?,
            arrivals: None,
            jacobians: None,
            predicted: gpu.alloc(what, points)?,
            optical: gpu.alloc(what, points)?,
            begins: gpu.alloc(what, cells + 1)?,
            findings: gpu.alloc(what, cells)?,
            unit_back: Pinned::new(gpu.context(), points)?,
            missing_back: Pinned::new(gpu.context(), points)?,
            traced_back: Pinned::new(gpu.context(), points)?,
            optical_back: Pinned::new(gpu.context(), points)?,
            findings_back: Pinned::new(gpu.context(), cells)?,
        })
    }

    fn holds(&self, points: usize, cells: usize) -> bool {
        self.unit.len() >= points && self.findings.len() >= cells
    }
}

/// Groups consecutive cells into batches of at most [`MAX_POINTS`] points. `begins` holds the first point of each cell, followed by the number of
/// points.
fn batches(begins: &[u32]) -> Vec<Range<usize>> {
    let cells = begins.len() - 1;
    let mut batches = Vec::new();
    let mut first = 0;
    while first < cells {
        let fits = |end: &usize| (begins[*end] - begins[first]) as usize <= MAX_POINTS;
        let end = (first + 2..=cells).take_while(fits).last().unwrap_or(first + 1);
        batches.push(first..end);
        first = end;
    }
    batches
}

impl Audits {
    /// Compiles the kernels or loads them from the cache.
    ///
    /// # Errors
    /// A kernel does not compile, or the device fails.
    pub fn new(gpu: &Arc<Gpu>) -> Result<Self, DeviceError> {
        let kernel = |name| gpu.kernel("audit.cu", &[], name);
        Ok(Self { draw: kernel("audit_draw")?, measure: kernel("audit_measure")?, gpu: gpu.clone(), memory: None })
    }

    /// Audits a frame. The result is bitwise that of [`crate::audit::audit`] if traced and predicted values are equal.
    ///
    /// # Errors
    /// The device fails or lacks memory.
    pub fn audit(
        &mut self,
        request: &AuditRequest<'_>,
        tracer: &CudaTracer,
        predictor: &dyn DevicePredict,
    ) -> Result<AuditFindings, DeviceError> {
        let strata = &request.strata;
        let cells = strata.drawn.len();
        let mut begins = vec![0_u32];
        for &drawn in &strata.drawn {
            begins.push(begins[begins.len() - 1] + drawn);
        }
        let batches = batches(&begins);
        let in_batch = |batch: &Range<usize>| (begins[batch.end] - begins[batch.start]) as usize;
        let most = batches.iter().map(in_batch).max().unwrap_or(0);
        if !self.memory.as_ref().is_some_and(|memory| memory.holds(most, cells)) {
            // Freed first, so that old and new memory are never allocated together.
            self.memory = None;
            self.memory = Some(Memory::new(&self.gpu, most.next_power_of_two().min(MAX_POINTS.max(most)), cells)?);
        }
        let Some(memory) = &mut self.memory else {
            return Err(DeviceError::Unsupported { what: "an audit without memory".into() });
        };
        memory.begins.write(&begins)?;
        let gpu = &self.gpu;
        let extras = request.samples.unwrap_or_default();
        if extras.arrival && memory.arrivals.is_none() {
            memory.arrivals = Some(gpu.alloc("audit points", memory.unit.len())?);
        }
        if extras.jacobian && memory.jacobians.is_none() {
            memory.jacobians = Some(gpu.alloc("audit points", memory.unit.len())?);
        }
        let arrival = memory.arrivals.as_ref().filter(|_| extras.arrival).map_or(0, Buffer::address);
        let jacobian = memory.jacobians.as_ref().filter(|_| extras.jacobian).map_or(0, Buffer::address);
        let stream = gpu.work();
        let (key, stream_words) = draws(request.seed, request.stream);
        let domain = tracer.host().domain();
        let draw = AuditDrawArgument {
            shape: strata.shape.map(|n| n as i32),
            key,
            stream: stream_words,
            domain: UnitBoxArgument::new(domain),
            missing_cells: tracer.missing_cells().map_or_else(bytemuck::Zeroable::zeroed, DeviceMissingCells::argument),
        };
        let points = AuditPointsArgument {
            unit: memory.unit.address(),
            points: memory.points.address(),
            is_missing: memory.missing.address(),
            traced: memory.traced.address(),
            lifetime_share: memory.lifetime_share.address(),
            predicted: memory.predicted.address(),
            optical: memory.optical.address(),
        };
        let (low, per_range, tau) = request.transfer.ramp_parts(tracer.host().tau());
        let (mut optical, mut samples, mut device_seconds) = (Vec::with_capacity(strata.total()), Samples::default(), 0.0);
        for batch in batches {
            let began = gpu.mark()?;
            let count = in_batch(&batch);
            let argument = AuditBatchArgument { begins: memory.begins.address(), first: batch.start as u32, count: batch.len() as u32 };
            let warps = threads(batch.len() * WARP, 256);
            let findings = memory.findings.address();
            let traced =
                Outputs { log_stretch: points.traced, lifetime_share: points.lifetime_share, arrival, jacobian, ..Outputs::default() };
            // SAFETY: arguments as declared in audit.cu; all arrays hold the points of the batch, and `begins` and `findings` hold every cell.
            unsafe {
                launch(stream.launch_builder(&self.draw).arg(&draw).arg(&argument).arg(&points), warps)?;
                tracer.device().trace(points.points, count, &traced)?;
                predictor.predict(points.unit, count, points.predicted)?;
                let mut call = stream.launch_builder(&self.measure);
                launch(call.arg(&low).arg(&per_range).arg(&tau).arg(&argument).arg(&points).arg(&findings), warps)?;
                memory.optical_back.copy_from(gpu.work(), points.optical, count)?;
                if request.samples.is_some() {
                    memory.unit_back.copy_from(gpu.work(), points.unit, count)?;
                    memory.missing_back.copy_from(gpu.work(), points.is_missing, count)?;
                    memory.traced_back.copy_from(gpu.work(), points.traced, count)?;
                }
            }
            let ended = gpu.mark()?;
            gpu.synchronize()?;
            device_seconds += f64::from(gpu.milliseconds(&began, &ended)?) * 1e-3;
            if request.samples.is_some() {
                keep(memory, count, domain, extras, &mut samples)?;
            }
            optical.extend_from_slice(&memory.optical_back.values()[..count]);
        }
        let from = memory.findings.address();
        // SAFETY: `findings` holds one entry for every cell.
        unsafe { memory.findings_back.copy_from(gpu.work(), from, cells) }?;
        gpu.synchronize()?;
        let findings = &memory.findings_back.values()[..cells];
        let points: f64 = findings.iter().map(|cell| cell.points).sum();
        Ok(AuditFindings {
            drawn: optical.len(),
            points: points as usize,
            mean_lifetime_share: findings.iter().map(|cell| cell.lifetimes).sum::<f64>() / points.max(1.0),
            device_seconds,
            peak: findings.iter().map(|cell| cell.peak as f32).fold(f32::NEG_INFINITY, f32::max),
            samples,
            errors: Some(Audited::new(strata.clone(), findings.iter().map(|cell| cell.errors).collect(), optical)),
        })
    }
}

/// Keeps the points of a batch, which are on the host, that lie outside missing cells, in unit coordinates of `domain`.
fn keep(memory: &Memory, count: usize, domain: &Domain, extras: Extras, samples: &mut Samples) -> Result<(), DeviceError> {
    fn back<T: DeviceRepr + Copy>(from: &Buffer<T>, zero: T, count: usize) -> Result<Vec<T>, DeviceError> {
        let mut values = vec![zero; count];
        from.read(&mut values)?;
        Ok(values)
    }
    let (unit, traced, missing) = (memory.unit_back.values(), memory.traced_back.values(), memory.missing_back.values());
    let present = || (0..count).filter(|&i| missing[i] == 0);
    samples.points.reserve(count);
    samples.log_stretch.reserve(count);
    samples.points.extend(present().map(|i| UnitPoint(unit[i])));
    samples.log_stretch.extend(present().map(|i| traced[i]));
    if let Some(buffer) = memory.arrivals.as_ref().filter(|_| extras.arrival) {
        let arrivals = back(buffer, [0.0; 3], count)?;
        samples.arrival.extend(present().map(|i| domain.to_unit_unclamped(DomainPoint(arrivals[i]))));
    }
    if let Some(buffer) = memory.jacobians.as_ref().filter(|_| extras.jacobian) {
        let jacobians = back(buffer, [0.0; 9], count)?;
        samples.jacobian.extend(present().map(|i| unit_jacobian(domain, &jacobians[i])));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn batches_hold_whole_cells_and_all_of_them() {
        let million = 1 << 20;
        let begins = [0, 3 * million, 4 * million, 4 * million + 1, 4 * million + 2, 10 * million, 10 * million, 11 * million];
        assert_eq!(batches(&begins), [0..2, 2..4, 4..5, 5..7]);
        assert_eq!(batches(&[0, 5, 9]).len(), 1);
        assert!(batches(&[0]).is_empty());
    }
}
