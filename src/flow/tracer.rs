//! Traces batches of seeds on the CPU: sorted by cell (Morton order), in lanes, by all threads.

use super::missing_cells::MissingCells;
use super::rk4::{self, MAX_LANES, TracedBatch};
use super::velocity::{Coordinates, Velocity};
use super::{Boundary, Extras, Normalisation, StepChoice, Traced, Tracer, dormand_prince};
use rayon::prelude::*;
use ridgewatch_base::progress;
use ridgewatch_field::{Domain, DomainPoint};
use ridgewatch_simd::{Lanes, Mask, Real};
use std::marker::PhantomData;

/// Integrator of a batch of at most `L::LANES` particles.
pub trait Kernel<V, L: Lanes, const D: usize, const C: usize>: Send + Sync {
    /// Steps per path; 0 if the step size is adaptive.
    fn steps(&self) -> usize;
    /// Traces at most `L::LANES` points.
    fn trace_batch(&self, field: &V, points: &[DomainPoint]) -> TracedBatch<L, D, C>;
}

/// The velocity stages at all times of fixed steps, evaluated once.
pub struct Stages<S> {
    stages: Vec<S>,
    step: f64,
}

impl<S> Stages<S> {
    /// No steps yet.
    pub fn empty() -> Self {
        Self { stages: Vec::new(), step: 0.0 }
    }

    /// `steps` steps from `from` to `to`.
    pub fn new<V: Velocity<L, D, C, Stage = S>, L: Lanes, const D: usize, const C: usize>(
        field: &V,
        from: f64,
        to: f64,
        steps: usize,
    ) -> Self {
        let halves = 2 * steps;
        let stages = (0..=halves).map(|i| field.stage(from + (to - from) * (i as f64 / halves as f64))).collect();
        Self { stages, step: (to - from) / steps as f64 }
    }
}

/// Tangent flow, Runge-Kutta of order 4.
pub struct TangentKernel<S>(pub Stages<S>);

impl<L: Lanes, V: Velocity<L, D, C>, const D: usize, const C: usize> Kernel<V, L, D, C> for TangentKernel<V::Stage> {
    fn steps(&self) -> usize {
        self.0.stages.len() / 2
    }
    fn trace_batch(&self, field: &V, points: &[DomainPoint]) -> TracedBatch<L, D, C> {
        rk4::tangent(field, &self.0.stages, self.0.step, points)
    }
}

/// Central differences, Runge-Kutta of order 4.
pub struct DifferencesKernel<S>(pub Stages<S>, pub f64);

impl<L: Lanes, V: Velocity<L, D, C>, const D: usize, const C: usize> Kernel<V, L, D, C> for DifferencesKernel<V::Stage> {
    fn steps(&self) -> usize {
        self.0.stages.len() / 2
    }
    fn trace_batch(&self, field: &V, points: &[DomainPoint]) -> TracedBatch<L, D, C> {
        rk4::differences(field, &self.0.stages, self.0.step, self.1, points)
    }
}

/// Tangent flow, adaptive.
pub struct AdaptiveKernel {
    /// Start time.
    pub from: f64,
    /// End time.
    pub to: f64,
    /// Local error.
    pub tolerance: f64,
}

impl<V: Velocity<f64, D, C>, const D: usize, const C: usize> Kernel<V, f64, D, C> for AdaptiveKernel {
    fn steps(&self) -> usize {
        0
    }
    fn trace_batch(&self, field: &V, points: &[DomainPoint]) -> TracedBatch<f64, D, C> {
        dormand_prince::trace(field, self.from, self.to, self.tolerance, points)
    }
}

/// The tracer of the CPU: a velocity and a kernel.
pub struct CpuTracer<K, V, L, const D: usize, const C: usize> {
    /// The velocity.
    pub field: V,
    /// The integrator.
    pub kernel: K,
    /// Box in which seeds may lie.
    pub domain: Domain,
    /// Seed time.
    pub start: f64,
    /// |tau|.
    pub tau: f64,
    /// Boundary policy.
    pub boundary: Boundary,
    /// Divisor for particles that stopped early.
    pub normalisation: Normalisation,
    /// Order in which seeds are traced.
    pub order: Order,
    /// How the number of steps was chosen; `None` if it was given.
    pub chosen: Option<StepChoice>,
    /// Cells without a velocity at the start time.
    pub missing_cells: MissingCells,
    /// Type of the lanes.
    pub lanes: PhantomData<L>,
}

/// Order in which seeds are traced.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Order {
    /// Sorted by cell if velocities are read from memory and the batch is large; otherwise as given.
    Auto,
    /// As given.
    Given,
}

/// Smallest batch that is worth sorting.
const SORT_FROM: usize = 1 << 12;
/// Largest number of seeds sorted and traced at once, which bounds the memory of the keys.
const BLOCK: usize = 1 << 22;
/// Largest number of seeds per task of a thread.
const CHUNK: usize = 1 << 10;

/// An array of which each thread writes its own elements.
struct Scatter<T>(*mut T);
// SAFETY: threads write disjoint elements (see `put`), and `T: Send` values may be written from any thread.
unsafe impl<T: Send> Sync for Scatter<T> {}
// SAFETY: as above.
unsafe impl<T: Send> Send for Scatter<T> {}

impl<T> Scatter<T> {
    fn new(values: &mut [T]) -> Option<Self> {
        (!values.is_empty()).then_some(Self(values.as_mut_ptr()))
    }
    /// # Safety
    /// `index` is in bounds, and no other thread writes this element.
    unsafe fn write(&self, index: usize, value: T) {
        // SAFETY: guaranteed by the caller.
        unsafe { *self.0.add(index) = value }
    }
}

impl<K, V, L, const D: usize, const C: usize> CpuTracer<K, V, L, D, C>
where
    K: Kernel<V, L, D, C>,
    V: Coordinates<D, C>,
    L: Lanes,
{
    /// Indices of the seeds in the order in which they are traced; `None` if that is the given order.
    fn sorted(&self, seeds: &[DomainPoint]) -> Option<Vec<u32>> {
        if self.order == Order::Given || seeds.len() < SORT_FROM {
            return None;
        }
        self.field.sort_key(seeds[0])?;
        let mut keys: Vec<u64> =
            seeds.par_iter().enumerate().map(|(i, &seed)| u64::from(self.field.sort_key(seed).unwrap_or(0)) << 32 | i as u64).collect();
        keys.par_sort_unstable();
        Some(keys.into_par_iter().map(|key| key as u32).collect())
    }

    /// Log-stretch and lifetime share of a lane, with boundary policy and normalisation applied.
    fn normalised_stretch(&self, batch: &TracedBatch<L, D, C>, lane: usize) -> (f64, f64) {
        let (stretch, lifetime_share) = (batch.log_stretch.lane(lane).to_f64(), batch.lifetime_share.lane(lane).to_f64());
        if self.boundary == Boundary::Zero && batch.left_domain.lane(lane) {
            return (0.0, lifetime_share);
        }
        match self.normalisation {
            Normalisation::Tau => (stretch, lifetime_share),
            Normalisation::Lifetime => (if lifetime_share > 0.0 { stretch / lifetime_share } else { 0.0 }, lifetime_share),
        }
    }

    fn jacobian(&self, batch: &TracedBatch<L, D, C>, lane: usize, seed: DomainPoint) -> [f32; 9] {
        let factor = batch.exponent.lane(lane).to_f64().exp2();
        let gradient: [[f64; C]; C] = batch.gradient.map(|row| row.map(|entry| entry.lane(lane).to_f64() * factor));
        let state = batch.state.map(|x| x.lane(lane).to_f64());
        let jacobian = self.field.coordinate_jacobian(seed.0.map(f64::from), &state, gradient);
        std::array::from_fn(|i| {
            let (row, column) = (i / 3, i % 3);
            if row < C && column < C { jacobian[row][column] as f32 } else { f32::from(u8::from(row == column)) }
        })
    }
}

impl<K, V, L, const D: usize, const C: usize> Tracer for CpuTracer<K, V, L, D, C>
where
    K: Kernel<V, L, D, C>,
    V: Coordinates<D, C>,
    L: Lanes,
{
    fn domain(&self) -> &Domain {
        &self.domain
    }

    fn start(&self) -> f64 {
        self.start
    }

    fn tau(&self) -> f64 {
        self.tau
    }

    fn steps(&self) -> usize {
        self.kernel.steps()
    }

    fn step_choice(&self) -> Option<StepChoice> {
        self.chosen
    }

    fn has_missing(&self) -> bool {
        !self.missing_cells.is_empty()
    }
    fn is_missing(&self, seed: DomainPoint) -> bool {
        self.missing_cells.is_missing(seed)
    }

    fn trace(&self, seeds: &[DomainPoint], extras: Extras, out: &mut Traced) {
        let double = size_of::<L::Real>() == size_of::<f64>();
        out.set_len(seeds.len(), extras, double);
        let threads = rayon::current_num_threads();
        for start in (0..seeds.len()).step_by(BLOCK) {
            let block = start..(start + BLOCK).min(seeds.len());
            let seeds = &seeds[block.clone()];
            let order = self.sorted(seeds);
            let stretch = Scatter::new(&mut out.log_stretch[block.clone()]);
            let lifetime_share = Scatter::new(&mut out.lifetime_share[block.clone()]);
            let arrival = Scatter::new(if extras.arrival { &mut out.arrival[block.clone()] } else { &mut [] });
            let jacobian = Scatter::new(if extras.jacobian { &mut out.jacobian[block.clone()] } else { &mut [] });
            let precise = Scatter::new(if double { &mut out.log_stretch_f64[block.clone()] } else { &mut [] });
            // Several chunks per thread, so that no thread waits long for the last one.
            let chunk = (seeds.len() / (8 * threads)).next_multiple_of(L::LANES).clamp(L::LANES, CHUNK);
            (0..seeds.len().div_ceil(chunk)).into_par_iter().for_each(|c| {
                progress::mark();
                let mut points = [DomainPoint::default(); MAX_LANES];
                let mut indices = [0usize; MAX_LANES];
                let end = ((c + 1) * chunk).min(seeds.len());
                for from in (c * chunk..end).step_by(L::LANES) {
                    let count = L::LANES.min(end - from);
                    for lane in 0..count {
                        indices[lane] = order.as_ref().map_or(from + lane, |order| order[from + lane] as usize);
                        points[lane] = seeds[indices[lane]];
                    }
                    let batch = self.kernel.trace_batch(&self.field, &points[..count]);
                    for lane in 0..count {
                        let (index, (s, share)) = (indices[lane], self.normalised_stretch(&batch, lane));
                        // SAFETY: `order` is a permutation of the block's indices, so that each element is written by one thread only,
                        // and every array has one element per seed of the block.
                        unsafe {
                            if let Some(array) = &stretch {
                                array.write(index, s as f32);
                            }
                            if let Some(array) = &lifetime_share {
                                array.write(index, share as f32);
                            }
                            if let Some(array) = &precise {
                                array.write(index, s);
                            }
                            if let Some(array) = &arrival {
                                let state = batch.state.map(|x| x.lane(lane).to_f64());
                                array.write(index, self.field.arrival_point(&state, points[lane]));
                            }
                            if let Some(array) = &jacobian {
                                array.write(index, self.jacobian(&batch, lane, points[lane]));
                            }
                        }
                    }
                }
            });
        }
    }
}
