//! Samples on the device: traced points, their times and labels, as one network learns from them.

use crate::backend::cuda::network::layout::ReadingArgument;
use crate::backend::cuda::network::network::{NetworkKernels, POINT, further_places, placed_times, reading, sample_fours, unit_box};
use crate::backend::cuda::{Buffer, DeviceError, DeviceTable, launch, threads};
use crate::field::Domain;
use crate::surrogate::Samples;
use crate::surrogate::network::{Objective, Target};
use cudarc::driver::PushKernelArg;
use std::borrow::Cow;
use std::ops::Range;
use std::sync::Arc;

/// Turns traced points on the device into samples of one network.
#[derive(Debug, Clone)]
pub(super) struct SampleWriter {
    pub(super) kernels: Arc<NetworkKernels>,
    pub(super) objective: Objective,
}

/// Traced points, as device addresses.
#[derive(Debug, Clone, Copy)]
pub(super) struct TracedPoints {
    /// Three f32 each, with the times at the places of axes that are no inputs, unless those of all are the same.
    pub(super) points: u64,
    /// Log-stretch (f32 each), or for the flow map arrivals (three f32 each, as points).
    pub(super) labels: u64,
    /// Times that points have no place for, as many f32 each as the network has such; 0: they are of the unit times instead.
    pub(super) further: u64,
}

impl SampleWriter {
    /// Points of samples on the host, with their times where the network is shown them; and those times that find no place in a point.
    pub(super) fn placed<'a>(&self, samples: &'a Samples, range: Range<usize>) -> (Cow<'a, [[f32; 3]]>, Vec<f32>) {
        let shape = &self.kernels.shape;
        if shape.times().is_empty() {
            return (Cow::Borrowed(&samples.points[range]), Vec::new());
        }
        let mut further = Vec::new();
        let with_times = |index: usize| {
            let times = placed_times(shape, Some(samples.times_of(index)));
            further.extend(&times[POINT..][..further_places(shape)]);
            std::array::from_fn(|k| if times[k].is_nan() { samples.points[index][k] } else { times[k] })
        };
        (range.map(with_times).collect(), further)
    }

    /// Labels of samples on the host; none is NaN.
    pub(super) fn labels<'a>(&self, samples: &'a Samples, range: Range<usize>) -> Cow<'a, [f32]> {
        match self.target() {
            Target::Ftle => Cow::Borrowed(&samples.log_stretch[range]),
            Target::FlowMap => match samples.arrival.get(range.clone()) {
                Some(arrivals) => Cow::Borrowed(arrivals.as_flattened()),
                None => Cow::Owned(vec![f32::NAN; 3 * range.len()]),
            },
        }
    }

    /// What the network is trained on.
    pub(super) fn target(&self) -> Target {
        self.kernels.shape.target
    }

    /// Bytes of a sample.
    pub(super) fn sample_bytes(&self) -> usize {
        size_of::<[f32; 4]>() * sample_fours(&self.kernels.shape)
    }

    /// Traced points on the device go to the places of `to`. Of every 2^held_back of them one cannot be learned from
    /// ([`super::keeps_label`]), since the host may keep it; with 0 all can. They are of the unit times, or bring theirs along.
    ///
    /// # Safety
    /// As for [`super::DeviceTraining::append`].
    pub(super) unsafe fn place(
        &self,
        ring: &DeviceSamples,
        to: Range<usize>,
        domain: &Domain,
        traced: TracedPoints,
        base: Option<&DeviceTable>,
        times: Option<[f32; 2]>,
        held_back: u32,
    ) -> Result<(), DeviceError> {
        if to.is_empty() {
            return Ok(());
        }
        assert!(to.end <= ring.capacity(), "a ring of {} for samples {to:?}", ring.capacity());
        let (domain, shape, TracedPoints { points, labels, further }) = (unit_box(domain), &self.kernels.shape, traced);
        let mut times = placed_times(shape, times);
        if further != 0 {
            times[POINT..].fill(f32::NAN);
        }
        let reading = ReadingArgument { further, ..reading(shape, &self.objective, times, base, 1.0) };
        let (n, at) = (to.len() as u32, ring.samples.address_of(ring.fours * to.start));
        let stream = self.kernels.gpu.work();
        let mut call = stream.launch_builder(&self.kernels.samples);
        call.arg(&domain).arg(&reading).arg(&points).arg(&labels).arg(&n).arg(&held_back).arg(&at);
        // SAFETY: the arguments of `network_samples`; the caller's addresses, and as many samples fit behind `at`.
        unsafe { launch(&mut call, threads(to.len(), 256)) }
    }

    /// Takes traced points in; of more than the ring holds the last ones.
    ///
    /// # Safety
    /// As for [`super::DeviceTraining::append`].
    pub(super) unsafe fn append(
        &self,
        ring: &mut DeviceSamples,
        domain: &Domain,
        points: u64,
        labels: u64,
        count: usize,
        base: Option<&DeviceTable>,
        times: Option<[f32; 2]>,
        held_back: u32,
    ) -> Result<(), DeviceError> {
        let capacity = ring.capacity();
        let label_bytes = if self.target() == Target::FlowMap { 12 } else { 4 };
        let skipped = count.saturating_sub(capacity);
        let before_the_end = (count - skipped).min(capacity - ring.filled.next);
        for (from, part) in [(skipped, before_the_end), (skipped + before_the_end, count - skipped - before_the_end)] {
            let (at, from) = (ring.filled.next, from as u64);
            let traced = TracedPoints { points: points + 12 * from, labels: labels + label_bytes * from, further: 0 };
            // Before it is known whether they arrive: what lay there is gone.
            ring.filled.append(part, capacity);
            // SAFETY: the caller's.
            unsafe { self.place(ring, at..at + part, domain, traced, base, times, held_back) }?;
        }
        Ok(())
    }
}

/// Samples to learn from: unit point, further times, targets. A ring: the newest take the place of the oldest.
#[derive(Debug)]
pub struct DeviceSamples {
    pub(super) samples: Buffer<[f32; 4]>,
    /// Of a sample.
    pub(super) fours: usize,
    pub(super) filled: Filled,
}

/// How far a ring is filled.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(in crate::backend::cuda) struct Filled {
    pub(super) len: usize,
    /// Where the next one goes.
    next: usize,
    /// Samples that were appended since it was empty.
    appended: u64,
}

impl Filled {
    /// As many were appended, no more than fit.
    fn append(&mut self, count: usize, capacity: usize) {
        self.next = (self.next + count) % capacity;
        self.len = (self.len + count).min(capacity);
        self.appended += count as u64;
    }

    /// Back to what it was, where all of that is still there; otherwise empty.
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

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.filled.len == 0
    }

    /// How far it is filled.
    pub(super) fn filled(&self) -> Filled {
        self.filled
    }

    /// Forgets what was appended since; where that took the place of older ones, all.
    pub(super) fn go_back(&mut self, to: Filled) {
        self.filled.go_back(to, self.capacity());
    }

    pub(super) fn capacity(&self) -> usize {
        self.samples.len() / self.fours
    }

    /// Forgets all samples.
    pub(super) fn clear(&mut self) {
        self.filled = Filled::default();
    }

    /// Unit point, further times and targets of each, in one or two times four numbers.
    ///
    /// # Errors
    /// What the device says.
    pub fn values(&self) -> Result<Vec<[f32; 4]>, DeviceError> {
        let mut values = vec![[0.0; 4]; self.fours * self.len()];
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
