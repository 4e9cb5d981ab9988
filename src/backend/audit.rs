//! Audit points: drawn evenly over the domain and traced whatever the gate says.

use super::DeviceError;
use super::router::push_sample;
use crate::flow::{Extras, Traced};
use crate::render::Transfer;
use crate::render::rng::{philox, unit};
use crate::surrogate::{Predict, Samples, Trace};
use crate::trust::{Audited, Gate, Residual, Strata, TrustedError};
use rayon::prelude::*;

/// Points that a thread takes at a time.
const CHUNK: usize = 1 << 12;
/// Dimension that no path reaches.
const AUDIT_DIMENSION: u32 = u32::MAX;

/// Key and stream of the words that points are drawn with: [`philox`] of a point's number, the stream and a dimension that no path reaches.
pub(super) fn draws(seed: u64, stream: u64) -> ([u32; 2], [u32; 3]) {
    ([seed as u32, (seed >> 32) as u32], [stream as u32, (stream >> 32) as u32, AUDIT_DIMENSION])
}

/// Uniform points in each cell of the unit cube, as many as `strata` says, cell by cell.
pub fn stratified_points(strata: &Strata, seed: u64, stream: u64) -> Vec<[f32; 3]> {
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
        (first..first + count).map(move |number| -> [f32; 3] {
            let words = philox([number, low, high, dimension], key);
            std::array::from_fn(|k| {
                let at = |offset: f32| (index[k] as f32 + offset) / cells[k] as f32;
                let drawn = at(unit(words[k]));
                // Rounding takes one point in a million over the edge of its cell.
                if (drawn * cells[k] as f32) as usize == index[k] { drawn } else { at(0.5) }
            })
        })
    };
    cell_starts.par_iter().with_min_len(64).flat_map_iter(in_cell).collect()
}

/// Traced audit points, voids (land) left out.
pub struct Audit {
    /// As labelled samples for the ring.
    pub samples: Samples,
    /// Which of the points drawn each of them is.
    pub numbers: Vec<usize>,
    /// Points drawn, voids included.
    pub drawn: usize,
    /// Mean lived share over points that are not void.
    pub mean_lifetime_share: f64,
}

/// Traces `unit` points; samples come with `extras`.
///
/// # Errors
/// The tracer's device fails.
pub fn trace(tracer: &dyn Trace, unit: &[[f32; 3]], extras: Extras) -> Result<Audit, DeviceError> {
    let domain = tracer.flow().domain();
    let points: Vec<[f32; 3]> = unit.par_iter().with_min_len(CHUNK).map(|&u| domain.from_unit(u)).collect();
    let mut traced = Traced::default();
    tracer.trace(&points, extras, &mut traced)?;
    // Sums are those of the chunks in order, on any number of threads.
    let parts: Vec<(Samples, Vec<usize>, f64)> = (points.par_chunks(CHUNK).enumerate())
        .map(|(chunk, points)| {
            let (mut samples, mut numbers, mut lived) = (Samples::default(), Vec::new(), 0.0);
            for (i, &point) in (chunk * CHUNK..).zip(points) {
                if !tracer.flow().is_missing(point) {
                    push_sample(&mut samples, domain, point, &traced, i, extras);
                    numbers.push(i);
                    lived += f64::from(traced.lived[i]);
                }
            }
            (samples, numbers, lived)
        })
        .collect();
    let (mut samples, mut numbers) = (Samples::default(), Vec::new());
    let mut lived = 0.0;
    for (mut part, mut part_numbers, part_lived) in parts {
        numbers.append(&mut part_numbers);
        samples.points.append(&mut part.points);
        samples.log_stretch.append(&mut part.log_stretch);
        samples.arrival.append(&mut part.arrival);
        samples.jacobian.append(&mut part.jacobian);
        lived += part_lived;
    }
    let mean_lifetime_share = lived / samples.len().max(1) as f64;
    Ok(Audit { samples, numbers, drawn: points.len(), mean_lifetime_share })
}

/// Residuals of `surrogate` on traced samples that it has not seen, NaN where the trace gave no number. `tau` turns log-stretch into FTLE
/// for the ramp.
///
/// # Errors
/// The surrogate's device fails.
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
            // A prediction that is no number is as wrong as can be.
            let optical = if predicted.is_finite() { (ramp(predicted) - ramp(traced)).abs() } else { 1.0 };
            let log_stretch = if predicted.is_finite() { predicted - traced } else { traced.abs() };
            Residual { point, optical, log_stretch }
        })
        .collect())
}

/// Error over the audit points in cells that the gate trusts.
pub fn trusted_error(audited: &Audited, gate: &Gate) -> Option<TrustedError> {
    TrustedError::of(audited, |cell| gate.trusts(audited.strata().centre(cell)))
}

/// PSNR in decibels of the surrogate's log-stretch over the audit points, for the largest traced value `peak`. None where either has no
/// finite value.
pub fn psnr(audited: &Audited, peak: f32) -> Option<f64> {
    Some(20.0 * (f64::from(peak) / audited.log_stretch_rms()).log10()).filter(|psnr| psnr.is_finite())
}

/// What a frame's audit asks for.
#[derive(Clone)]
pub struct AuditRequest<'a> {
    /// How many points are drawn in each cell.
    pub strata: Strata,
    /// What they are drawn with.
    pub seed: u64,
    /// As above; no two frames have the same.
    pub stream: u64,
    /// In whose ramp residuals are measured.
    pub transfer: &'a Transfer,
    /// Whether what was traced is wanted as samples to learn from, and with what extras.
    pub samples: Option<Extras>,
}

/// What a frame's audit found.
pub struct AuditFindings {
    /// Points drawn.
    pub drawn: usize,
    /// Of them, those that do not lie on land.
    pub points: usize,
    /// Mean lived share over these.
    pub mean_lifetime_share: f64,
    /// Largest finite log-stretch; minus infinity where there is none.
    pub peak: f32,
    /// These points, where they were asked for.
    pub samples: Samples,
    /// Residuals of the surrogate; none without one.
    pub errors: Option<Audited>,
}

/// Draws and traces audit points, and measures the surrogate on them, on the CPU. The tracer's device may be another.
///
/// # Errors
/// A device fails.
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
            assert!(p.iter().all(|u| (0.0..1.0).contains(u)));
            count[(p[1] * 3.0) as usize * 4 + (p[0] * 4.0) as usize] += 1;
        }
        assert_eq!(count, [5; 12]);
        assert_ne!(points, stratified_points(&Strata::even(cells, 5), 7, 10), "another frame draws other points");
    }
}
