//! Audit of a frame: measures the surrogate's error on points that are traced regardless of the gate.
//!
//! The points are a stratified random sample (Cochran 1977, *Sampling Techniques*, chapter 5): each cell of a regular grid gets its own number of
//! uniform points, drawn with the counter-based generator Philox4x32-10 (Salmon et al. 2011). The same seed, stream and strata give the same points
//! on every backend.

use super::DeviceError;
use super::router::push_sample;
use rayon::prelude::*;
use ridgewatch_field::{DomainPoint, UnitPoint};
use ridgewatch_flow::{Extras, Traced};
use ridgewatch_render::Transfer;
use ridgewatch_render::rng::{philox, unit};
use ridgewatch_surrogate::{Predict, Samples, Trace};
use ridgewatch_trust::{Audited, Gate, Residual, Strata, TrustedError};
use std::sync::atomic::AtomicBool;

/// Points per parallel task.
const CHUNK: usize = 1 << 12;
/// Philox counter word that separates audit points from the random numbers of light paths, which never reach this dimension.
const AUDIT_DIMENSION: u32 = u32::MAX;

/// Returns the [`philox`] key, and the counter words after the point number: the stream (low, high) and [`AUDIT_DIMENSION`].
pub(super) fn draws(seed: u64, stream: u64) -> ([u32; 2], [u32; 3]) {
    ([seed as u32, (seed >> 32) as u32], [stream as u32, (stream >> 32) as u32, AUDIT_DIMENSION])
}

/// Draws the points of all strata, cell by cell: `strata.drawn[cell]` uniform points in each cell.
pub fn stratified_points(strata: &Strata, seed: u64, stream: u64) -> Vec<UnitPoint> {
    let cells = strata.shape;
    let (key, [low, high, dimension]) = draws(seed, stream);
    let mut first = 0;
    let cell_starts: Vec<(usize, u32, u32)> = (strata.drawn.iter().enumerate())
        .map(|(cell, &count)| {
            first += count;
            (cell, first - count, count)
        })
        .collect();
    let in_cell = |&(cell, first, count): &(usize, u32, u32)| {
        let index = [cell % cells[0], cell / cells[0] % cells[1], cell / (cells[0] * cells[1])];
        (first..first + count).map(move |number| {
            let words = philox([number, low, high, dimension], key);
            UnitPoint(std::array::from_fn(|k| {
                let at = |offset: f32| (index[k] as f32 + offset) / cells[k] as f32;
                let drawn = at(unit(words[k]));
                // Rounding moves about one point in a million across the edge of its cell; the cell's centre replaces it.
                if (drawn * cells[k] as f32) as usize == index[k] { drawn } else { at(0.5) }
            }))
        })
    };
    cell_starts.par_iter().with_min_len(64).flat_map_iter(in_cell).collect()
}

/// Traced audit points. Points in missing cells are excluded.
pub struct Audit {
    /// The points as samples for the replay buffer.
    pub samples: Samples,
    /// Index of each sample among the drawn points.
    pub numbers: Vec<usize>,
    /// Number of points drawn, including those in missing cells.
    pub drawn: usize,
    /// Mean of the particle lifetime over tau, over the points outside missing cells.
    pub mean_lifetime_share: f64,
}

/// Traces points. `extras` selects the arrival points and Jacobians of the samples.
///
/// # Errors
/// The tracer's device fails or lacks memory.
pub fn trace(tracer: &dyn Trace, unit: &[UnitPoint], extras: Extras) -> Result<Audit, DeviceError> {
    let domain = tracer.flow().domain();
    let points: Vec<DomainPoint> = unit.par_iter().with_min_len(CHUNK).map(|&u| domain.from_unit(u)).collect();
    let mut traced = Traced::default();
    tracer.trace(&points, extras, &mut traced)?;
    // Chunks are summed in order, so that the result does not depend on the number of threads.
    let parts: Vec<(Samples, Vec<usize>, f64)> = (points.par_chunks(CHUNK).enumerate())
        .map(|(chunk, points)| {
            let (mut samples, mut numbers, mut lifetimes) = (Samples::default(), Vec::new(), 0.0);
            for (i, &point) in (chunk * CHUNK..).zip(points) {
                if !tracer.flow().is_missing(point) {
                    push_sample(&mut samples, domain, point, &traced, i, extras);
                    numbers.push(i);
                    lifetimes += f64::from(traced.lifetime_share[i]);
                }
            }
            (samples, numbers, lifetimes)
        })
        .collect();
    let (mut samples, mut numbers) = (Samples::default(), Vec::new());
    let mut lifetimes = 0.0;
    for (mut part, mut part_numbers, part_lifetimes) in parts {
        numbers.append(&mut part_numbers);
        samples.points.append(&mut part.points);
        samples.log_stretch.append(&mut part.log_stretch);
        samples.arrival.append(&mut part.arrival);
        samples.jacobian.append(&mut part.jacobian);
        lifetimes += part_lifetimes;
    }
    let mean_lifetime_share = lifetimes / samples.len().max(1) as f64;
    Ok(Audit { samples, numbers, drawn: points.len(), mean_lifetime_share })
}

/// Returns the residuals of `surrogate` on traced samples that are not in its training set. A sample whose traced value is not finite has NaN
/// residuals. `tau` is the integration time, in the unit of the data: FTLE = log-stretch / tau.
///
/// # Errors
/// The surrogate's device fails or lacks memory.
pub fn residuals(surrogate: &dyn Predict, samples: &Samples, transfer: &Transfer, tau: f64) -> Result<Vec<Residual>, DeviceError> {
    let mut predicted = vec![0.0; samples.len()];
    surrogate.predict(&samples.points, &mut predicted)?;
    let ramp = |s: f32| transfer.ramp(s / tau as f32);
    let pairs = predicted.par_iter().zip(&samples.log_stretch).zip(&samples.points);
    Ok(pairs
        .with_min_len(CHUNK)
        .map(|((&predicted, &traced), &point)| {
            if !traced.is_finite() {
                return Residual { point, optical: f32::NAN, log_stretch: f32::NAN };
            }
            // A prediction that is not finite counts as the largest possible error.
            let optical = if predicted.is_finite() { (ramp(predicted) - ramp(traced)).abs() } else { 1.0 };
            let log_stretch = if predicted.is_finite() { predicted - traced } else { traced.abs() };
            Residual { point, optical, log_stretch }
        })
        .collect())
}

/// Returns the error over the audit points in trusted cells. `None` if fewer than two points lie there.
pub fn trusted_error(audited: &Audited, gate: &Gate) -> Option<TrustedError> {
    TrustedError::of(audited, |cell| gate.trusts(audited.strata().centre(cell)))
}

/// Returns the PSNR, 20 log10(`peak` / RMS error), of the surrogate's log-stretch over the audit points, in decibels. `peak` is the largest
/// traced value. `None` if the result is not finite.
pub fn psnr(audited: &Audited, peak: f32) -> Option<f64> {
    Some(20.0 * (f64::from(peak) / audited.log_stretch_rms()).log10()).filter(|psnr| psnr.is_finite())
}

/// Inputs of the audit of one frame.
#[derive(Clone)]
pub struct AuditRequest<'a> {
    /// Number of points in each cell.
    pub strata: Strata,
    /// Key of the random numbers.
    pub seed: u64,
    /// Random stream, unique for each frame.
    pub stream: u64,
    /// Transfer function whose ramp measures the optical residuals.
    pub transfer: &'a Transfer,
    /// Extras of the samples to return for training. `None`: no samples are returned.
    pub samples: Option<Extras>,
    /// Setting it may end the tracing early; the findings are then of no use.
    pub stop: &'a AtomicBool,
}

/// Result of the audit of one frame.
pub struct AuditFindings {
    /// Number of points drawn.
    pub drawn: usize,
    /// Number of points outside missing cells.
    pub points: usize,
    /// Mean of the particle lifetime over tau, over the points outside missing cells.
    pub mean_lifetime_share: f64,
    /// Seconds of device time; 0 where the host measured.
    pub device_seconds: f64,
    /// Largest finite traced log-stretch; minus infinity if no value is finite.
    pub peak: f32,
    /// The points outside missing cells as samples; empty if the request has `samples: None`.
    pub samples: Samples,
    /// Residuals of the surrogate. `None` without a surrogate.
    pub errors: Option<Audited>,
}

impl AuditFindings {
    /// Of a frame that is not audited.
    pub fn none() -> Self {
        Self {
            drawn: 0,
            points: 0,
            mean_lifetime_share: 0.0,
            device_seconds: 0.0,
            peak: f32::NEG_INFINITY,
            samples: Samples::default(),
            errors: None,
        }
    }
}

/// Audits a frame on the CPU: draws the points, traces them, and measures the surrogate on them. The tracer and the surrogate may run on a device.
///
/// # Errors
/// A device fails or lacks memory.
pub fn audit(request: &AuditRequest<'_>, tracer: &dyn Trace, surrogate: Option<&dyn Predict>) -> Result<AuditFindings, DeviceError> {
    let unit = stratified_points(&request.strata, request.seed, request.stream);
    let Audit { samples, numbers, drawn, mean_lifetime_share } = trace(tracer, &unit, request.samples.unwrap_or_default())?;
    let in_order = |surrogate: &dyn Predict| -> Result<Audited, DeviceError> {
        let mut in_order = vec![(f32::NAN, f32::NAN); drawn];
        let residuals = residuals(surrogate, &samples, request.transfer, tracer.flow().tau())?;
        for (number, residual) in numbers.into_iter().zip(residuals) {
            in_order[number] = (residual.optical, residual.log_stretch);
        }
        Ok(Audited::in_order(&in_order, request.strata.clone()))
    };
    Ok(AuditFindings {
        drawn,
        points: samples.len(),
        mean_lifetime_share,
        device_seconds: 0.0,
        peak: samples.log_stretch.iter().copied().filter(|s| s.is_finite()).fold(f32::NEG_INFINITY, f32::max),
        errors: surrogate.map(in_order).transpose()?,
        samples: if request.samples.is_some() { samples } else { Samples::default() },
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_cell_gets_its_points() {
        let cells = [4, 3, 1];
        let points = stratified_points(&Strata::even(cells, 5), 7, 9);
        let mut count = [0; 12];
        for p in &points {
            assert!(p.0.iter().all(|u| (0.0..1.0).contains(u)));
            count[(p.0[1] * 3.0) as usize * 4 + (p.0[0] * 4.0) as usize] += 1;
        }
        assert_eq!(count, [5; 12]);
        assert_ne!(points, stratified_points(&Strata::even(cells, 5), 7, 10), "another frame draws other points");
    }
}
