//! Pixels of a map: the mean of the FTLE over what a pixel covers, and the error of that mean.

use super::view::View;
use crate::backend::{BackendError, Device};
use crate::field::DomainPoint;
use crate::flow::{Extras, FlowMap, Traced, VelocitySource, cpu_tracer};
use crate::render::footprint;
use crate::run::short_lived;
use crate::surrogate::Trace;
use rayon::prelude::*;
use serde::Serialize;
use std::ops::Range;
use std::time::Instant;

/// Seeds traced at once, which bounds the memory beside the picture.
const AT_ONCE: usize = 1 << 19;
/// Seeds of the first part.
const FIRST: usize = 1 << 13;
/// Seconds of a part up to which the next one has twice as many seeds.
const BRIEF: f64 = 0.05;

/// Works through `0..count`, each of which has `seeds` seeds, in parts, until `work` returns false. Parts become larger as long as they take little time,
/// so that a map can be abandoned soon on any device. Returns whether all was done.
///
/// # Errors
/// Those of `work`.
pub(super) fn in_parts<E>(count: usize, seeds: usize, mut work: impl FnMut(Range<usize>) -> Result<bool, E>) -> Result<bool, E> {
    let of_seeds = |most: usize| (most / seeds.max(1)).max(1);
    let (mut next, mut at_once) = (0, of_seeds(FIRST));
    while next < count {
        let (part, begin) = (next..(next + at_once).min(count), Instant::now());
        next = part.end;
        if !work(part)? {
            return Ok(false);
        }
        if begin.elapsed().as_secs_f64() < BRIEF {
            at_once = (2 * at_once).min(of_seeds(AT_ONCE));
        }
    }
    Ok(true)
}

/// A flow map on the chosen device. If the device fails and its settings allow it, the CPU goes on.
pub struct MapTracer<'a> {
    device: &'a Device,
    velocity: &'a VelocitySource,
    map: &'a FlowMap,
    start: f64,
    tracer: Box<dyn Trace>,
    /// Why the CPU traces instead of the device.
    pub note: Option<String>,
    /// Sum of the lifetime shares of seeds with a velocity, and their number.
    lifetimes: (f64, u64),
}

impl<'a> MapTracer<'a> {
    /// The flow map of `map` for seeds at `start`.
    ///
    /// # Errors
    /// The flow map is invalid, or the device fails and the CPU may not take over.
    pub fn new(device: &'a Device, velocity: &'a VelocitySource, map: &'a FlowMap, start: f64) -> Result<Self, BackendError> {
        let (tracer, note) = device.tracer(velocity, map, start)?;
        Ok(Self { device, velocity, map, start, tracer, note, lifetimes: (0.0, 0) })
    }

    /// The flow map on the CPU.
    pub fn flow(&self) -> &dyn crate::flow::Tracer {
        self.tracer.flow()
    }

    fn trace(&mut self, seeds: &[DomainPoint], out: &mut Traced) -> Result<(), BackendError> {
        match self.tracer.trace(seeds, Extras::default(), out) {
            Ok(()) => Ok(()),
            Err(error) if self.device.may_fall_back(&error) => {
                self.note = Some(format!("traced on the CPU: {error}"));
                self.tracer = Box::new(cpu_tracer(self.velocity.clone(), self.map, self.start)?);
                Ok(self.tracer.trace(seeds, Extras::default(), out)?)
            }
            Err(error) => Err(error.into()),
        }
    }

    /// FTLE at seeds, in 1 / time unit; NaN where there is no velocity. Calls `done` with the number of seeds after each part.
    ///
    /// # Errors
    /// The device fails.
    pub fn ftle(&mut self, seeds: &[DomainPoint], done: &mut dyn FnMut(usize)) -> Result<Vec<f32>, BackendError> {
        let mut values = Vec::with_capacity(seeds.len());
        let mut traced = Traced::default();
        for part in seeds.chunks(AT_ONCE) {
            self.trace(part, &mut traced)?;
            let (flow, tau) = (self.flow(), self.flow().tau() as f32);
            let from = values.len();
            values.par_extend(
                part.par_iter().zip(&traced.log_stretch).map(|(seed, s)| if flow.is_missing(*seed) { f32::NAN } else { s / tau }),
            );
            let lived = values[from..].iter().zip(&traced.lifetime_share).filter(|(value, _)| value.is_finite());
            let (sum, count) = lived.fold((0.0, 0), |(sum, count), (_, share)| (sum + f64::from(*share), count + 1));
            self.lifetimes = (self.lifetimes.0 + sum, self.lifetimes.1 + count);
            done(part.len());
        }
        Ok(values)
    }

    /// Warning about seeds whose particles stop early, of all that were traced.
    pub fn short_lived(&self) -> Option<String> {
        let (sum, count) = self.lifetimes;
        short_lived(sum / count as f64)
    }
}

/// Seeds per pixel, in two halves.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Sampling {
    /// Seeds per pixel, an even number.
    pub seeds: usize,
    /// Seed of the random shifts.
    pub seed: u64,
}

/// Pixels of one FTLE field. Rows from the top.
#[derive(Debug, Clone, PartialEq)]
pub struct Raster {
    /// Pixels along x and y.
    pub size: [usize; 2],
    /// Mean FTLE in 1 / time unit over the part of the pixel that has a velocity. NaN for pixels without.
    pub mean: Vec<f32>,
    /// Share of the pixel, within the data, without a velocity. NaN outside of the data.
    pub missing: Vec<f32>,
    /// Error of the means; `None` if no pixel has seeds with a velocity in both halves.
    pub error: Option<RasterError>,
    /// Seeds with a velocity whose integration gave no finite number.
    pub failed: usize,
}

/// Stated error of the means of a raster, without the error of the integration.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct RasterError {
    /// Root mean square over the pixels, in 1 / time unit.
    pub rms: f64,
    /// 95 % interval of it.
    pub interval: [f64; 2],
    /// Pixels that it is taken over.
    pub pixels: usize,
}

/// Sums over the variances of pixels.
#[derive(Default)]
struct Variances {
    count: usize,
    sum: f64,
    square: f64,
}

impl Variances {
    /// Adds a pixel by the means a and b of its two independent, unbiased halves: the mean (a + b) / 2 has the variance E[(a - b)^2] / 4.
    fn add(&mut self, [a, b]: [f64; 2]) {
        let variance = (a - b).powi(2) / 4.0;
        self.count += 1;
        self.sum += variance;
        self.square += variance * variance;
    }

    fn error(&self) -> Option<RasterError> {
        if self.count < 2 {
            return None;
        }
        let mean = self.sum / self.count as f64;
        // Of the mean of the variances, by the central limit theorem.
        let deviation = ((self.square / self.count as f64 - mean * mean).max(0.0) / (self.count - 1) as f64).sqrt();
        let interval = [mean - 1.96 * deviation, mean + 1.96 * deviation].map(|v| v.max(0.0).sqrt());
        Some(RasterError { rms: mean.sqrt(), interval, pixels: self.count })
    }
}

/// Places of the seeds of one half of a pixel ([`footprint`]).
pub(super) fn offsets(sampling: Sampling, pixel: usize, half: usize) -> impl Iterator<Item = [f64; 2]> {
    footprint(sampling.seed, pixel, half, 0..sampling.seeds / 2)
}

impl Raster {
    /// Traces the pixels of a view. Calls `done` with the number of pixels after each part; `None` once that returns false.
    ///
    /// # Errors
    /// The device fails.
    pub fn trace(
        view: &View,
        tracer: &mut MapTracer<'_>,
        sampling: Sampling,
        done: &mut dyn FnMut(usize) -> bool,
    ) -> Result<Option<Self>, BackendError> {
        let count = view.size[0] * view.size[1];
        let mut raster = Self { size: view.size, mean: vec![f32::NAN; count], missing: vec![f32::NAN; count], error: None, failed: 0 };
        let mut variances = Variances::default();
        let is_whole = in_parts(count, sampling.seeds, |part| {
            let seeds: Vec<Vec<(usize, DomainPoint)>> = part.clone().into_par_iter().map(|pixel| seeds_of(view, sampling, pixel)).collect();
            let flat: Vec<DomainPoint> = seeds.iter().flatten().map(|(_, seed)| *seed).collect();
            let values = tracer.ftle(&flat, &mut |_| ())?;
            let flow = tracer.flow();
            let mut next = 0;
            let pixels = part.len();
            for (pixel, seeds) in part.zip(&seeds) {
                let (mut sum, mut number, mut missing) = ([0.0; 2], [0usize; 2], 0usize);
                for (half, seed) in seeds {
                    let value = values[next];
                    next += 1;
                    if value.is_finite() {
                        sum[*half] += f64::from(value);
                        number[*half] += 1;
                    } else if flow.is_missing(*seed) {
                        missing += 1;
                    } else {
                        raster.failed += 1;
                    }
                }
                if !seeds.is_empty() {
                    raster.missing[pixel] = missing as f32 / seeds.len() as f32;
                }
                let all = number[0] + number[1];
                if all > 0 {
                    raster.mean[pixel] = ((sum[0] + sum[1]) / all as f64) as f32;
                }
                if number[0] > 0 && number[1] > 0 {
                    variances.add([sum[0] / number[0] as f64, sum[1] / number[1] as f64]);
                }
            }
            Ok::<_, BackendError>(done(pixels))
        })?;
        raster.error = variances.error();
        Ok(is_whole.then_some(raster))
    }

    /// Whether most of a pixel has no velocity.
    pub fn is_land(&self, pixel: usize) -> bool {
        self.missing[pixel] >= 0.5
    }
}

/// Seeds of a pixel within the data, with their half.
fn seeds_of(view: &View, sampling: Sampling, pixel: usize) -> Vec<(usize, DomainPoint)> {
    let [x, y] = [pixel % view.size[0], pixel / view.size[0]].map(|n| n as f64);
    let half = |half: usize| offsets(sampling, pixel, half).map(move |[u, v]| (half, x + u, y + v));
    let all = half(0).chain(half(1));
    all.filter_map(|(half, x, y)| view.place(x, y).map(|place| (half, view.seed(place)))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_are_small_at_first_and_hold_everything_once() {
        for (count, seeds) in [(100_000, 4), (7, 1 << 20), (1, 1), (0, 4)] {
            let mut parts = Vec::new();
            let is_whole = in_parts(count, seeds, |part| {
                parts.push(part);
                Ok::<_, ()>(true)
            });
            assert_eq!(is_whole, Ok(true));
            assert!(parts.windows(2).all(|pair| pair[0].end == pair[1].start), "{parts:?}");
            assert_eq!(parts.iter().map(|part| part.len()).sum::<usize>(), count);
            assert!(parts.iter().all(|part| part.len() == 1 || part.len() * seeds <= AT_ONCE), "{parts:?}");
            assert!(parts.first().is_none_or(|part| part.start == 0 && (part.len() == 1 || part.len() * seeds <= FIRST)), "{parts:?}");
        }
        let mut parts = 0;
        let is_whole = in_parts(100_000, 4, |_| {
            parts += 1;
            Ok::<_, ()>(parts < 3)
        });
        assert_eq!((is_whole, parts), (Ok(false), 3));
        assert_eq!(in_parts(10, 1, |_| Err::<bool, _>("device")), Err("device"));
    }
}
