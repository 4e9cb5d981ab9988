//! Traced answers that come back to the host, as labels to learn from: a bounded, even sample of all that a frame traced.
//!
//! Which ones are kept is a function of their points alone (`keeps_label` of `answer.cuh`): of every 2^shift points one, where the shift
//! grows as a frame traces more. So the set does not depend on the order in which the device's threads come, nor does its order here.

use crate::backend::cuda::layout::LabelsArgument;
use crate::backend::cuda::{Buffer, DeviceError, Gpu};
use crate::backend::router::unit_arrival;
use crate::field::Domain;
use crate::render::rng::philox;
use crate::surrogate::Samples;
use rayon::prelude::*;

/// Most labels that one frame keeps (64 MiB).
const MOST: usize = 1 << 22;

/// Where a network learns on the device, one label of 2^3 may come back to the host, and is not learned from there: what is held out of
/// training must be held out on both sides.
pub(in crate::backend::cuda) const HELD_BACK: u32 = 3;

/// A traced point.
#[derive(Debug, Clone, Copy)]
struct Label {
    /// Domain coordinates, log-stretch.
    at: [f32; 4],
    /// Where it arrives, domain coordinates; NaN where that is not asked for.
    arrival: [f32; 3],
}

impl Label {
    fn point(&self) -> [f32; 3] {
        let [x, y, z, _] = self.at;
        [x, y, z]
    }
}

/// Labels on the device.
#[derive(Debug)]
struct Memory {
    at: Buffer<[f32; 4]>,
    arrivals: Option<Buffer<[f32; 3]>>,
}

/// Whether the label at a point belongs to the kept share of 1 in 2^shift.
pub fn keeps_label(point: [f32; 3], shift: u32) -> bool {
    let [x, y, z] = point.map(f32::to_bits);
    shift == 0 || (shift < 32 && philox([x, y, z, 0], [0, 0])[0] >> (32 - shift) == 0)
}

/// The labels of one frame.
pub struct Labels {
    /// How many may be kept.
    keep: usize,
    shift: u32,
    /// Points traced so far.
    offered: u64,
    /// Brought back before the memory on the device was full.
    back: Vec<Label>,
    memory: Option<Memory>,
    arrivals: bool,
}

impl Labels {
    /// Keeps fewer than `keep`, of every 2^shift points one at most; none where `keep` is 1 or 0. `arrivals`: with those of each.
    pub fn new(gpu: &Gpu, keep: usize, shift: u32, arrivals: bool) -> Result<Self, DeviceError> {
        let keep = if keep > 1 { keep.min(MOST) } else { 0 };
        let room = Self::with_luck(keep);
        let memory = || -> Result<Memory, DeviceError> {
            let arrivals = arrivals.then(|| gpu.alloc("labels", room)).transpose()?;
            Ok(Memory { at: gpu.alloc("labels", room)?, arrivals })
        };
        Ok(Self { keep, shift, offered: 0, back: Vec::new(), memory: (keep > 0).then(memory).transpose()?, arrivals })
    }

    /// Six standard deviations more than a number that is drawn, and a few.
    fn with_luck(expected: usize) -> usize {
        expected + (6.0 * (expected as f64).sqrt()) as usize + 64
    }

    /// What the kernel is told for `traced` further points. `stored` labels are in the device's memory, whose count is at `length`; when
    /// they leave too little room they come back first, and the count is to be set to 0 (true).
    pub fn offer(&mut self, traced: usize, stored: usize, length: u64) -> Result<(LabelsArgument, bool), DeviceError> {
        let Some(memory) = &self.memory else {
            return Ok((LabelsArgument { at: 0, arrivals: 0, length, capacity: 0, shift: 0 }, false));
        };
        self.offered += traced as u64;
        // Three quarters, so that what is drawn in excess does not cost half of it.
        while self.offered >> self.shift > (self.keep - self.keep / 4) as u64 {
            self.shift += 1;
        }
        let (at, capacity) = (memory.at.address(), memory.at.len());
        let arrivals = memory.arrivals.as_ref().map_or(0, Buffer::address);
        let full = stored + Self::with_luck(traced >> self.shift) > capacity;
        if full {
            self.take(stored)?;
        }
        Ok((LabelsArgument { at, arrivals, length, capacity: capacity as u32, shift: self.shift }, full))
    }

    /// Brings `stored` labels back, all that are on the device.
    pub fn take(&mut self, stored: usize) -> Result<(), DeviceError> {
        let Some(memory) = &self.memory else { return Ok(()) };
        let mut at = vec![[0.0; 4]; stored.min(memory.at.len())];
        memory.at.read(&mut at)?;
        let mut arrivals = vec![[f32::NAN; 3]; at.len()];
        if let Some(buffer) = &memory.arrivals {
            buffer.read(&mut arrivals)?;
        }
        self.back.extend(at.into_iter().zip(arrivals).map(|(at, arrival)| Label { at, arrival }));
        self.thin();
        Ok(())
    }

    fn thin(&mut self) {
        let shift = self.shift;
        self.back.retain(|label| keeps_label(label.point(), shift));
    }

    /// All that is kept and was brought back, in unit coordinates of `domain`.
    pub fn finish(&mut self, domain: &Domain) -> Samples {
        while self.back.len() >= self.keep.max(1) && self.shift < 32 {
            self.shift += 1;
            self.thin();
        }
        self.back.par_sort_unstable_by_key(|label| label.at.map(f32::to_bits));
        let arrivals = if self.arrivals { &self.back[..] } else { &[] };
        Samples {
            points: self.back.par_iter().map(|label| domain.to_unit(label.point())).collect(),
            log_stretch: self.back.iter().map(|label| label.at[3]).collect(),
            arrival: arrivals.par_iter().map(|label| unit_arrival(domain, label.arrival)).collect(),
            ..Samples::default()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_shift_halves_what_is_kept() {
        let point = |i: u32| [i as f32 * 0.001, (i % 97) as f32, 0.5];
        let kept = |shift| (0..1 << 16).filter(|&i| keeps_label(point(i), shift)).count() as f64;
        for shift in 0..6 {
            let expected = f64::from(1 << 16) / f64::from(1 << shift);
            // Four standard deviations of a binomial count.
            assert!((kept(shift) - expected).abs() <= 4.0 * expected.sqrt(), "{} of {expected} at {shift}", kept(shift));
        }
        assert!((0..1000).all(|i| !keeps_label(point(i), 4) || keeps_label(point(i), 3)), "a larger share holds the smaller");
        assert_eq!(kept(32), 0.0);
    }
}
