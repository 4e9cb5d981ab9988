//! Audit points: drawn evenly over the domain and traced whatever the gate says.

use super::answers::push_sample;
use crate::flow::{Extras, Traced, Tracer};
use crate::render::Transfer;
use crate::render::rng::{philox, unit};
use crate::surrogate::{Predict, Samples};
use crate::trust::{Gate, Residual, Strata, TrustedError, log_stretch_rms};
use rayon::prelude::*;

/// Points that a thread takes at a time.
const CHUNK: usize = 1 << 12;
/// Dimension that no path reaches.
const AUDIT_DIMENSION: u32 = u32::MAX;

/// Uniform points in each cell of the unit cube, as many as `strata` says.
pub fn stratified_points(strata: &Strata, seed: u64, stream: u64) -> Vec<[f32; 3]> {
    let cells = strata.shape;
    let key = [seed as u32, (seed >> 32) as u32];
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
            // The last word keeps these draws apart from every pixel's.
            let words = philox([number, stream as u32, (stream >> 32) as u32, AUDIT_DIMENSION], key);
            std::array::from_fn(|k| (index[k] as f32 + unit(words[k])) / cells[k] as f32)
        })
    };
    cell_starts.par_iter().with_min_len(64).flat_map_iter(in_cell).collect()
}

/// Traced audit points, voids (land) left out.
pub struct Audit {
    /// As labelled samples for the ring.
    pub samples: Samples,
    /// Points drawn, voids included.
    pub drawn: usize,
    /// Mean lived share over points that are not void.
    pub lived_share: f64,
}

/// Traces `unit` points.
pub fn trace(tracer: &dyn Tracer, unit: &[[f32; 3]], flow_map: bool) -> Audit {
    let domain = tracer.domain();
    let points: Vec<[f32; 3]> = unit.par_iter().with_min_len(CHUNK).map(|&u| domain.from_unit(u)).collect();
    let extras = Extras { arrival: flow_map, jacobian: flow_map };
    let mut traced = Traced::default();
    tracer.trace(&points, extras, &mut traced);
    // Sums are those of the chunks in order, on any number of threads.
    let parts: Vec<(Samples, f64)> = (points.par_chunks(CHUNK).enumerate())
        .map(|(chunk, points)| {
            let (mut samples, mut lived) = (Samples::default(), 0.0);
            for (i, &point) in (chunk * CHUNK..).zip(points) {
                if !tracer.is_void(point) {
                    push_sample(&mut samples, domain, point, &traced, i, extras);
                    lived += f64::from(traced.lived[i]);
                }
            }
            (samples, lived)
        })
        .collect();
    let mut samples = Samples::default();
    let mut lived = 0.0;
    for (mut part, part_lived) in parts {
        samples.points.append(&mut part.points);
        samples.log_stretch.append(&mut part.log_stretch);
        samples.arrival.append(&mut part.arrival);
        samples.jacobian.append(&mut part.jacobian);
        lived += part_lived;
    }
    let lived_share = lived / samples.len().max(1) as f64;
    Audit { samples, drawn: points.len(), lived_share }
}

/// Residuals of `surrogate` on traced samples that it has not seen. `tau` turns log-stretch into FTLE for the ramp.
pub fn residuals(surrogate: &dyn Predict, samples: &Samples, transfer: &Transfer, tau: f64) -> Vec<Residual> {
    let mut predicted = vec![0.0; samples.len()];
    surrogate.predict(&samples.points, &mut predicted);
    let ramp = |s: f32| transfer.ramp(s / tau as f32);
    let pairs = predicted.par_iter().zip(&samples.log_stretch).zip(&samples.points);
    pairs
        .with_min_len(CHUNK)
        .filter(|((_, traced), _)| traced.is_finite())
        .map(|((&predicted, &traced), &point)| {
            // A prediction that is no number is as wrong as can be.
            let optical = if predicted.is_finite() { (ramp(predicted) - ramp(traced)).abs() } else { 1.0 };
            let log_stretch = if predicted.is_finite() { predicted - traced } else { traced.abs() };
            Residual { point, optical, log_stretch }
        })
        .collect()
}

/// Error over the residuals whose points the gate trusts; they were drawn as `strata` says.
pub fn trusted_error(residuals: &[Residual], strata: &Strata, gate: &Gate) -> Option<TrustedError> {
    let trusted: Vec<Residual> = residuals.iter().copied().filter(|r| gate.trusts(r.point)).collect();
    TrustedError::of(&trusted, strata)
}

/// PSNR in decibels of the surrogate's log-stretch over the points of `residuals`, for the largest traced value `peak`. None where
/// either has no finite value.
pub fn psnr(residuals: &[Residual], peak: f32, strata: &Strata) -> Option<f64> {
    let error = log_stretch_rms(residuals, strata);
    Some(20.0 * (f64::from(peak) / error).log10()).filter(|psnr| psnr.is_finite())
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
