//! Samples of one network on the device: traced points, their times and targets, in a replay buffer.

use crate::cuda::layout::UnitBoxArgument;
use crate::cuda::network::layout::ReadingArgument;
use crate::cuda::network::network::{NetworkKernels, POINT, further_places, placed_times, reading, sample_float4s};
use crate::cuda::{Buffer, DeviceError, DeviceTable, launch, threads};
use bytemuck::cast_slice;
use cudarc::driver::PushKernelArg;
use ridgewatch_field::Domain;
use ridgewatch_surrogate::Samples;
use ridgewatch_surrogate::network::{Objective, Target};
use std::borrow::Cow;
use std::ops::Range;
use std::sync::Arc;

/// Turns traced points on the device into samples of one network.
#[derive(Debug, Clone)]
pub(super) struct SampleWriter {
    pub(super) kernels: Arc<NetworkKernels>,
    pub(super) objective: Objective,
}

/// Device addresses of the labels of traced points.
#[derive(Debug, Clone, Copy)]
pub struct DeviceLabels {
    /// Log-stretch (one f32 per point), or for a flow map arrivals (three f32 per point, in domain coordinates).
    pub values: u64,
    /// Jacobians (nine f32 per point, row-major, in domain coordinates), which a loss with derivatives needs; 0 if there are none.
    pub jacobians: u64,
}

impl From<u64> for DeviceLabels {
    fn from(values: u64) -> Self {
        Self { values, jacobians: 0 }
    }
}

/// Traced points on the device that become samples. Addresses are device addresses.
#[derive(Debug, Clone, Copy)]
pub(super) struct TracedBatch<'a> {
    /// Domain of the points.
    pub(super) domain: &'a Domain,
    /// Three f32 per point, with its times at the places of unused axes unless `times` are given.
    pub(super) points: u64,
    /// Their labels.
    pub(super) labels: DeviceLabels,
    /// Number of points.
    pub(super) count: usize,
    /// Table to which the network adds.
    pub(super) base: Option<&'a DeviceTable>,
    /// Unit times of all points; `None` if points carry theirs.
    pub(super) times: Option<[f32; 2]>,
    /// One point in 2^held_back gets no target ([`crate::keeps_label`]), since the host may keep it for validation; with 0 all get one.
    pub(super) held_back: u32,
}

impl SampleWriter {
    /// Points of samples on the host, with times at their places if these are inputs, and the times without a place in a point.
    pub(super) fn placed<'a>(&self, samples: &'a Samples, range: Range<usize>) -> (Cow<'a, [[f32; 3]]>, Vec<f32>) {
        let shape = &self.kernels.shape;
        if shape.times().is_empty() {
            return (Cow::Borrowed(cast_slice(&samples.points[range])), Vec::new());
        }
        let mut further = Vec::new();
        let with_times = |index: usize| {
            let times = placed_times(shape, Some(samples.times_of(index)));
            further.extend(&times[POINT..][..further_places(shape)]);
            std::array::from_fn(|k| if times[k].is_nan() { samples.points[index].0[k] } else { times[k] })
        };
        (range.map(with_times).collect(), further)
    }

    /// Labels of samples on the host; NaN stands for a label that does not exist.
    pub(super) fn labels<'a>(&self, samples: &'a Samples, range: Range<usize>) -> Cow<'a, [f32]> {
        match self.target() {
            Target::Ftle => Cow::Borrowed(&samples.log_stretch[range]),
            Target::FlowMap => match samples.arrival.get(range.clone()) {
                Some(arrivals) => Cow::Borrowed(cast_slice(arrivals)),
                None => Cow::Owned(vec![f32::NAN; 3 * range.len()]),
            },
        }
    }

    /// Jacobians of samples on the host. `None` if the loss does not need them or the samples have none.
    pub(super) fn jacobians<'a>(&self, samples: &'a Samples, range: Range<usize>) -> Option<&'a [[f32; 9]]> {
        samples.jacobian.get(range).filter(|_| self.objective.derivatives())
    }

    /// Target of the network.
    pub(super) fn target(&self) -> Target {
        self.kernels.shape.target
    }

    /// Bytes of a sample.
    pub(super) fn sample_bytes(&self) -> usize {
        size_of::<[f32; 4]>() * sample_float4s(&self.kernels.shape, &self.objective)
    }

    /// Writes samples of traced points from number `first` on. `further`: device address of the times without a place in a point, 0 if the
    /// batch's unit times apply instead.
    ///
    /// # Safety
    /// As for [`super::DeviceTraining::append`].
    pub(super) unsafe fn write(&self, to: &DeviceSamples, first: usize, batch: TracedBatch<'_>, further: u64) -> Result<(), DeviceError> {
        let TracedBatch { domain, points, labels, count, base, times, held_back } = batch;
        if count == 0 {
            return Ok(());
        }
        assert!(first + count <= to.capacity(), "a buffer of {} for {count} samples from number {first} on", to.capacity());
        let (domain, shape) = (UnitBoxArgument::new(domain), &self.kernels.shape);
        let mut times = placed_times(shape, times);
        if further != 0 {
            times[POINT..].fill(f32::NAN);
        }
        let reading = ReadingArgument { further, ..reading(shape, &self.objective, times, base, 1.0) };
        let (n, at) = (count as u32, to.samples.address_of(to.float4s * first));
        let DeviceLabels { values, jacobians } = labels;
        let mut call = self.kernels.gpu.work().launch_builder(&self.kernels.samples);
        call.arg(&domain).arg(&reading).arg(&points).arg(&values).arg(&n).arg(&held_back).arg(&at).arg(&jacobians);
        // SAFETY: the arguments of `network_samples`; the caller's addresses, and `count` samples fit behind `at`.
        unsafe { launch(&mut call, threads(count, 256)) }
    }

    /// Appends traced points to a replay buffer. If there are more than it holds, the last ones remain.
    ///
    /// # Safety
    /// As for [`super::DeviceTraining::append`].
    pub(super) unsafe fn append(&self, to: &mut DeviceSamples, batch: TracedBatch<'_>) -> Result<(), DeviceError> {
        let (capacity, count) = (to.capacity(), batch.count);
        let label_bytes = if self.target() == Target::FlowMap { 12 } else { 4 };
        let skipped = count.saturating_sub(capacity);
        let before_the_end = (count - skipped).min(capacity - to.filled.next);
        for (from, count) in [(skipped, before_the_end), (skipped + before_the_end, count - skipped - before_the_end)] {
            let (first, from) = (to.filled.next, from as u64);
            let DeviceLabels { values, jacobians } = batch.labels;
            let jacobians = if jacobians == 0 { 0 } else { jacobians + 36 * from };
            let labels = DeviceLabels { values: values + label_bytes * from, jacobians };
            let part = TracedBatch { points: batch.points + 12 * from, labels, count, ..batch };
            // Counted before the write: even if it fails, the old samples there are lost.
            to.filled.append(count, capacity);
            // SAFETY: as required of the caller.
            unsafe { self.write(to, first, part, 0) }?;
        }
        Ok(())
    }
}

/// Replay buffer of samples (unit point, further times, targets, targets of derivatives): a ring in which the newest samples replace the oldest.
#[derive(Debug)]
pub struct DeviceSamples {
    pub(super) samples: Buffer<[f32; 4]>,
    /// Buffer elements per sample.
    pub(super) float4s: usize,
    pub(super) filled: Filled,
}

/// Fill state of a replay buffer.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(in crate::cuda) struct Filled {
    pub(super) len: usize,
    /// Index of the next sample.
    next: usize,
    /// Number of samples appended since the buffer was empty.
    appended: u64,
}

impl Filled {
    /// Counts appended samples, at most `capacity`.
    fn append(&mut self, count: usize, capacity: usize) {
        self.next = (self.next + count) % capacity;
        self.len = (self.len + count).min(capacity);
        self.appended += count as u64;
    }

    /// Returns to an earlier state if all of its samples are still present, otherwise to the empty state.
    fn go_back(&mut self, to: Self, capacity: usize) {
        let behind = self.appended.checked_sub(to.appended);
        let is_there = behind.is_some_and(|behind| behind <= (capacity - to.len) as u64);
        *self = if is_there { to } else { Self::default() };
    }
}

impl DeviceSamples {
    /// Number of samples.
    pub fn len(&self) -> usize {
        self.filled.len
    }

    /// Returns true if there are no samples.
    pub fn is_empty(&self) -> bool {
        self.filled.len == 0
    }

    /// Fill state, for [`Self::go_back`].
    pub(super) fn filled(&self) -> Filled {
        self.filled
    }

    /// Forgets the samples appended since `to`; forgets all if they replaced older ones.
    pub(super) fn go_back(&mut self, to: Filled) {
        self.filled.go_back(to, self.capacity());
    }

    pub(super) fn capacity(&self) -> usize {
        self.samples.len() / self.float4s
    }

    /// Forgets all samples.
    pub(super) fn clear(&mut self) {
        self.filled = Filled::default();
    }

    /// Downloads unit point, further times, targets and, if the loss has them, the derivatives' targets along each axis of each sample, in groups of
    /// four numbers.
    ///
    /// # Errors
    /// Error of the driver.
    pub fn values(&self) -> Result<Vec<[f32; 4]>, DeviceError> {
        let mut values = vec![[0.0; 4]; self.float4s * self.len()];
        self.samples.read(&mut values)?;
        Ok(values)
    }
}

#[cfg(test)]
mod tests {
    use super::Filled;

    #[test]
    fn a_ring_goes_back_to_what_it_still_holds() {
        const CAPACITY: usize = 10;
        let filled = |counts: &[usize]| {
            let mut filled = Filled::default();
            counts.iter().for_each(|&count| filled.append(count, CAPACITY));
            filled
        };
        let before = filled(&[4]);
        let back = |mut now: Filled| {
            now.go_back(before, CAPACITY);
            now
        };
        assert_eq!(back(filled(&[4])), before);
        assert_eq!(back(filled(&[4, 3, 3])), before, "filled to the brim");
        assert_eq!(back(filled(&[4, 3, 4])), Filled::default(), "the oldest is gone");
        assert_eq!(back(filled(&[4, 10])), Filled::default());
        assert_eq!(back(filled(&[2])), Filled::default(), "emptied since");
        let (around, mut now) = (filled(&[10, 3]), filled(&[10, 3, 1]));
        now.go_back(around, CAPACITY);
        assert_eq!(now, Filled::default(), "a full one keeps nothing apart");
    }
}
