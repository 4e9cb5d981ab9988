//! Batches: seeds sorted by cell, traced in lanes by all threads, and put back in order.

use super::rk4::{self, MAX_LANES, Paths};
use super::steps::Chosen;
use super::velocity::{Chart, Velocity};
use super::voids::Voids;
use super::{Boundary, Extras, Normalisation, Traced, Tracer, dormand_prince};
use crate::field::Domain;
use crate::simd::{Lanes, Mask, Real};
use rayon::prelude::*;
use std::marker::PhantomData;

/// How a batch of at most `L::LANES` particles is traced.
pub trait Kernel<V, L: Lanes, const D: usize, const C: usize>: Send + Sync {
    /// Steps a path gets; 0 where they are chosen on the way.
    fn steps(&self) -> usize;
    /// Traces a batch.
    fn paths(&self, field: &V, points: &[[f32; 3]]) -> Paths<L, D, C>;
}

/// All stage times of fixed steps, evaluated once.
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
    fn paths(&self, field: &V, points: &[[f32; 3]]) -> Paths<L, D, C> {
        rk4::tangent(field, &self.0.stages, self.0.step, points)
    }
}

/// Central differences, Runge-Kutta of order 4.
pub struct DifferencesKernel<S>(pub Stages<S>, pub f64);

impl<L: Lanes, V: Velocity<L, D, C>, const D: usize, const C: usize> Kernel<V, L, D, C> for DifferencesKernel<V::Stage> {
    fn steps(&self) -> usize {
        self.0.stages.len() / 2
    }
    fn paths(&self, field: &V, points: &[[f32; 3]]) -> Paths<L, D, C> {
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
    fn paths(&self, field: &V, points: &[[f32; 3]]) -> Paths<f64, D, C> {
        dormand_prince::trace(field, self.from, self.to, self.tolerance, points)
    }
}

/// A field and a kernel, ready for seeds.
pub struct CpuTracer<K, V, L, const D: usize, const C: usize> {
    /// The velocity.
    pub field: V,
    /// What traces it.
    pub kernel: K,
    /// Where seeds may lie.
    pub domain: Domain,
    /// Seed time.
    pub start: f64,
    /// |tau|.
    pub tau: f64,
    /// Edge policy.
    pub boundary: Boundary,
    /// Divisor for particles that stopped early.
    pub normalisation: Normalisation,
    /// Whether batches are sorted.
    pub order: Order,
    /// How the number of steps was chosen, where it was.
    pub chosen: Option<Chosen>,
    /// Where seeds have no velocity.
    pub voids: Voids,
    /// Kind of lanes.
    pub lanes: PhantomData<L>,
}

/// In which order seeds are traced.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Order {
    /// By cell where velocities are read from memory and the batch is large; otherwise as they come.
    Auto,
    /// As they come.
    Given,
}

/// Batches below this are not worth sorting.
const SORT_FROM: usize = 1 << 12;
/// Seeds that are sorted and traced at a time, which bounds the memory of the keys.
const BLOCK: usize = 1 << 22;
/// Seeds that a thread takes at a time, at most.
const CHUNK: usize = 1 << 10;

/// One array that threads write at indices of their own.
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
    /// `index` is inside the array, and no other thread writes it.
    unsafe fn put(&self, index: usize, value: T) {
        // SAFETY: the caller's.
        unsafe { *self.0.add(index) = value }
    }
}

impl<K, V, L, const D: usize, const C: usize> CpuTracer<K, V, L, D, C>
where
    K: Kernel<V, L, D, C>,
    V: Chart<D, C>,
    L: Lanes,
{
    /// Indices of the seeds in the order in which they are traced.
    fn sorted(&self, seeds: &[[f32; 3]]) -> Option<Vec<u32>> {
        if self.order == Order::Given || seeds.len() < SORT_FROM {
            return None;
        }
        self.field.sort_key(seeds[0])?;
        let mut keys: Vec<u64> =
            seeds.par_iter().enumerate().map(|(i, &seed)| u64::from(self.field.sort_key(seed).unwrap_or(0)) << 32 | i as u64).collect();
        keys.par_sort_unstable();
        Some(keys.into_par_iter().map(|key| key as u32).collect())
    }

    /// Log-stretch and lived share of a lane, with edge policy and normalisation applied.
    fn verdict(&self, paths: &Paths<L, D, C>, lane: usize) -> (f64, f64) {
        let (stretch, lived) = (paths.log_stretch.lane(lane).to_f64(), paths.lived.lane(lane).to_f64());
        if self.boundary == Boundary::Zero && paths.left.lane(lane) {
            return (0.0, lived);
        }
        match self.normalisation {
            Normalisation::Tau => (stretch, lived),
            Normalisation::Lived => (if lived > 0.0 { stretch / lived } else { 0.0 }, lived),
        }
    }

    fn jacobian(&self, paths: &Paths<L, D, C>, lane: usize, seed: [f32; 3]) -> [f32; 9] {
        let factor = paths.exponent.lane(lane).to_f64().exp2();
        let metric: [[f64; C]; C] = paths.metric.map(|row| row.map(|entry| entry.lane(lane).to_f64() * factor));
        let state = paths.state.map(|x| x.lane(lane).to_f64());
        let jacobian = self.field.coordinate_jacobian(seed.map(f64::from), &state, metric);
        std::array::from_fn(|i| {
            let (row, column) = (i / 3, i % 3);
            if row < C && column < C { jacobian[row][column] as f32 } else { f32::from(u8::from(row == column)) }
        })
    }
}

impl<K, V, L, const D: usize, const C: usize> Tracer for CpuTracer<K, V, L, D, C>
where
    K: Kernel<V, L, D, C>,
    V: Chart<D, C>,
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

    fn chosen(&self) -> Option<Chosen> {
        self.chosen
    }

    fn is_void(&self, seed: [f32; 3]) -> bool {
        self.voids.hold(seed)
    }

    fn trace(&self, seeds: &[[f32; 3]], extras: Extras, out: &mut Traced) {
        let double = size_of::<L::Real>() == size_of::<f64>();
        let wanted = |yes: bool| if yes { seeds.len() } else { 0 };
        out.log_stretch.resize(seeds.len(), 0.0);
        out.lived.resize(seeds.len(), 0.0);
        out.arrival.resize(wanted(extras.arrival), [0.0; 3]);
        out.jacobian.resize(wanted(extras.jacobian), [0.0; 9]);
        out.log_stretch_f64.resize(wanted(double), 0.0);
        let threads = rayon::current_num_threads();
        for start in (0..seeds.len()).step_by(BLOCK) {
            let block = start..(start + BLOCK).min(seeds.len());
            let seeds = &seeds[block.clone()];
            let order = self.sorted(seeds);
            let stretch = Scatter::new(&mut out.log_stretch[block.clone()]);
            let lived = Scatter::new(&mut out.lived[block.clone()]);
            let arrival = Scatter::new(if extras.arrival { &mut out.arrival[block.clone()] } else { &mut [] });
            let jacobian = Scatter::new(if extras.jacobian { &mut out.jacobian[block.clone()] } else { &mut [] });
            let precise = Scatter::new(if double { &mut out.log_stretch_f64[block.clone()] } else { &mut [] });
            // Enough chunks that no thread waits long for the last one.
            let chunk = (seeds.len() / (8 * threads)).next_multiple_of(L::LANES).clamp(L::LANES, CHUNK);
            (0..seeds.len().div_ceil(chunk)).into_par_iter().for_each(|c| {
                let mut points = [[0.0f32; 3]; MAX_LANES];
                let mut indices = [0usize; MAX_LANES];
                let end = ((c + 1) * chunk).min(seeds.len());
                for from in (c * chunk..end).step_by(L::LANES) {
                    let count = L::LANES.min(end - from);
                    for lane in 0..count {
                        indices[lane] = order.as_ref().map_or(from + lane, |order| order[from + lane] as usize);
                        points[lane] = seeds[indices[lane]];
                    }
                    let paths = self.kernel.paths(&self.field, &points[..count]);
                    for lane in 0..count {
                        let (index, (s, share)) = (indices[lane], self.verdict(&paths, lane));
                        // SAFETY: `order` is a permutation of the block's indices, so that each is written by one thread only, and
                        // every array that is there has one element a seed of the block.
                        unsafe {
                            if let Some(array) = &stretch {
                                array.put(index, s as f32);
                            }
                            if let Some(array) = &lived {
                                array.put(index, share as f32);
                            }
                            if let Some(array) = &precise {
                                array.put(index, s);
                            }
                            if let Some(array) = &arrival {
                                let state = paths.state.map(|x| x.lane(lane).to_f64());
                                array.put(index, self.field.arrival(&state, points[lane]));
                            }
                            if let Some(array) = &jacobian {
                                array.put(index, self.jacobian(&paths, lane, points[lane]));
                            }
                        }
                    }
                }
            });
        }
    }
}
