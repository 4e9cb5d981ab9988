//! Training labels of a frame on the host, by the label rule of [`crate::QueryRouter`].
//!
//! The set of the labels does not depend on the order in which GPU threads run. The host sorts it, so its order does not either.

use crate::cuda::layout::LabelsArgument;
use crate::cuda::{Buffer, DeviceError, Gpu};
use crate::router::{LabelShare, unit_jacobian};
use rayon::prelude::*;
use ridgewatch_field::{Domain, DomainPoint};
use ridgewatch_flow::Extras;
use ridgewatch_surrogate::Samples;

/// Limit on the labels of one frame (64 MiB).
const MAX_LABELS: usize = 1 << 22;

/// With training on the device, one label in 2^3 may go to the host instead of the label pool of the device. The host holds out some of its labels
/// for validation, so the pool must not contain them.
pub(in crate::cuda) const HELD_BACK: u32 = 3;

/// Labels on the host. Arrays that are not requested are empty. They are plain and filled by one thread: it takes longer to hand some ten thousand
/// labels to other threads than to copy them.
#[derive(Debug, Default)]
struct HostLabels {
    /// Domain coordinates, log-stretch.
    at: Vec<[f32; 4]>,
    arrivals: Vec<[f32; 3]>,
    /// In domain coordinates.
    jacobians: Vec<[f32; 9]>,
}

impl HostLabels {
    /// Those of these numbers, in their order.
    fn chosen(&self, numbers: &[u32]) -> Self {
        fn of<T: Copy>(values: &[T], numbers: &[u32]) -> Vec<T> {
            let numbers = if values.is_empty() { &[] } else { numbers };
            numbers.iter().map(|&number| values[number as usize]).collect()
        }
        Self { at: of(&self.at, numbers), arrivals: of(&self.arrivals, numbers), jacobians: of(&self.jacobians, numbers) }
    }

    /// Drops those outside of a share.
    fn thin(&mut self, share: LabelShare) {
        let kept: Vec<u32> = (0..self.at.len() as u32).into_par_iter().filter(|&i| share.keeps(point(self.at[i as usize]))).collect();
        *self = self.chosen(&kept);
    }

    fn append(&mut self, mut other: Self) {
        if self.at.is_empty() {
            *self = other;
            return;
        }
        self.at.append(&mut other.at);
        self.arrivals.append(&mut other.arrivals);
        self.jacobians.append(&mut other.jacobians);
    }

    /// Sorts by place and log-stretch.
    fn sort(&mut self) {
        let bits = |at: [f32; 4]| at.map(f32::to_bits);
        if self.arrivals.is_empty() && self.jacobians.is_empty() {
            self.at.par_sort_unstable_by_key(|&at| bits(at));
            return;
        }
        let mut order: Vec<u32> = (0..self.at.len() as u32).collect();
        order.par_sort_unstable_by_key(|&number| bits(self.at[number as usize]));
        *self = self.chosen(&order);
    }
}

fn point([x, y, z, _]: [f32; 4]) -> DomainPoint {
    DomainPoint([x, y, z])
}

/// Labels on the device.
#[derive(Debug)]
struct Memory {
    at: Buffer<[f32; 4]>,
    arrivals: Option<Buffer<[f32; 3]>>,
    jacobians: Option<Buffer<[f32; 9]>>,
}

/// The labels of one frame.
pub struct Labels {
    share: LabelShare,
    /// Read back whenever the device's memory was full.
    back: HostLabels,
    /// Shift of the share of those on the host.
    taken: u32,
    /// Shift of the share of the first labels that are on the device now; later ones have no larger share.
    offered: u32,
    memory: Option<Memory>,
}

impl Labels {
    /// Allocates memory for fewer than `keep` labels, at most one of 2^shift traced points; no labels if `keep` is 0 or 1. `extras`: what
    /// they have besides the log-stretch.
    ///
    /// # Errors
    /// The device fails or lacks memory.
    pub fn new(gpu: &Gpu, keep: usize, shift: u32, extras: Extras) -> Result<Self, DeviceError> {
        let keep = if keep > 1 { keep.min(MAX_LABELS) } else { 0 };
        let room = Self::with_luck(keep);
        let memory = || -> Result<Memory, DeviceError> {
            let arrivals = extras.arrival.then(|| gpu.alloc("labels", room)).transpose()?;
            let jacobians = extras.jacobian.then(|| gpu.alloc("labels", room)).transpose()?;
            Ok(Memory { at: gpu.alloc("labels", room)?, arrivals, jacobians })
        };
        Ok(Self {
            share: LabelShare::new(keep, shift),
            back: HostLabels::default(),
            taken: shift,
            offered: shift,
            memory: (keep > 0).then(memory).transpose()?,
        })
    }

    /// Returns the capacity for an expected number of labels: a margin of six standard deviations of the binomial count, and 64.
    fn with_luck(expected: usize) -> usize {
        expected + (6.0 * (expected as f64).sqrt()) as usize + 64
    }

    /// Returns the kernel argument for `traced` further points. The device holds `stored` labels, with their count at the address `length`. If the
    /// free space is too small, they are read back first; the second result is then true, and the caller must set the count to 0.
    ///
    /// # Errors
    /// The device fails.
    pub fn offer(&mut self, traced: usize, stored: usize, length: u64) -> Result<(LabelsArgument, bool), DeviceError> {
        let Some(memory) = &self.memory else {
            return Ok((LabelsArgument { at: 0, arrivals: 0, jacobians: 0, length, capacity: 0, shift: 0 }, false));
        };
        self.share.expect(traced);
        let shift = self.share.shift;
        let (at, capacity) = (memory.at.address(), memory.at.len());
        let arrivals = memory.arrivals.as_ref().map_or(0, Buffer::address);
        let jacobians = memory.jacobians.as_ref().map_or(0, Buffer::address);
        let full = stored + Self::with_luck(traced >> shift) > capacity;
        if full {
            self.take(stored)?;
        }
        if full || stored == 0 {
            self.offered = shift;
        }
        Ok((LabelsArgument { at, arrivals, jacobians, length, capacity: capacity as u32, shift }, full))
    }

    /// Reads back the `stored` labels that are on the device.
    ///
    /// # Errors
    /// The device fails.
    pub fn take(&mut self, stored: usize) -> Result<(), DeviceError> {
        let Some(memory) = &self.memory else { return Ok(()) };
        let count = stored.min(memory.at.len());
        let mut new = HostLabels { at: vec![[0.0; 4]; count], ..HostLabels::default() };
        memory.at.read(&mut new.at)?;
        if let Some(arrivals) = &memory.arrivals {
            new.arrivals.resize(count, [f32::NAN; 3]);
            arrivals.read(&mut new.arrivals)?;
        }
        if let Some(jacobians) = &memory.jacobians {
            new.jacobians.resize(count, [f32::NAN; 9]);
            jacobians.read(&mut new.jacobians)?;
        }
        let share = self.share;
        if share.shift > self.offered {
            new.thin(share);
        }
        if share.shift > self.taken {
            self.back.thin(share);
        }
        self.taken = share.shift;
        self.back.append(new);
        Ok(())
    }

    /// Returns the labels on the host, sorted, in unit coordinates of `domain`.
    pub fn finish(&mut self, domain: &Domain) -> Samples {
        while self.share.halve_if_full(self.back.at.len()) {
            self.back.thin(self.share);
        }
        self.back.sort();
        let HostLabels { at, arrivals, jacobians } = &self.back;
        Samples {
            points: at.iter().map(|&at| domain.to_unit(point(at))).collect(),
            log_stretch: at.iter().map(|at| at[3]).collect(),
            arrival: arrivals.iter().map(|&arrival| domain.to_unit_unclamped(DomainPoint(arrival))).collect(),
            jacobian: jacobians.iter().map(|jacobian| unit_jacobian(domain, jacobian)).collect(),
            ..Samples::default()
        }
    }
}
