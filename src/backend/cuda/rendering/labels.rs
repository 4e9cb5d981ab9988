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

/// A traced query.
#[derive(Debug, Clone, Copy)]
struct Label {
    /// Domain coordinates, log-stretch.
    at: [f32; 4],
    /// Arrival point; NaN if arrival points are not requested.
    arrival: DomainPoint,
    /// Jacobian in domain coordinates; NaN if Jacobians are not requested.
    jacobian: [f32; 9],
}

impl Label {
    fn point(&self) -> DomainPoint {
        let [x, y, z, _] = self.at;
        DomainPoint([x, y, z])
    }
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
    /// Labels on the host, read back whenever the device's memory was full.
    back: Vec<Label>,
    memory: Option<Memory>,
    extras: Extras,
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
        Ok(Self { share: LabelShare::new(keep, shift), back: Vec::new(), memory: (keep > 0).then(memory).transpose()?, extras })
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
        Ok((LabelsArgument { at, arrivals, jacobians, length, capacity: capacity as u32, shift }, full))
    }

    /// Reads back the `stored` labels that are on the device.
    ///
    /// # Errors
    /// The device fails.
    pub fn take(&mut self, stored: usize) -> Result<(), DeviceError> {
        let Some(memory) = &self.memory else { return Ok(()) };
        let mut at = vec![[0.0; 4]; stored.min(memory.at.len())];
        memory.at.read(&mut at)?;
        let mut arrivals = vec![DomainPoint([f32::NAN; 3]); at.len()];
        if let Some(buffer) = &memory.arrivals {
            buffer.read(bytemuck::cast_slice_mut(&mut arrivals))?;
        }
        let mut jacobians = vec![[f32::NAN; 9]; at.len()];
        if let Some(buffer) = &memory.jacobians {
            buffer.read(&mut jacobians)?;
        }
        let labels = at.into_iter().zip(arrivals).zip(jacobians);
        self.back.extend(labels.map(|((at, arrival), jacobian)| Label { at, arrival, jacobian }));
        self.thin();
        Ok(())
    }

    fn thin(&mut self) {
        let share = self.share;
        self.back.retain(|label| share.keeps(label.point()));
    }

    /// Returns the labels on the host, sorted, in unit coordinates of `domain`.
    pub fn finish(&mut self, domain: &Domain) -> Samples {
        while self.share.halve_if_full(self.back.len()) {
            self.thin();
        }
        self.back.par_sort_unstable_by_key(|label| label.at.map(f32::to_bits));
        let labels_if = |wanted: bool| if wanted { &self.back[..] } else { &[] };
        Samples {
            points: self.back.par_iter().map(|label| domain.to_unit(label.point())).collect(),
            log_stretch: self.back.iter().map(|label| label.at[3]).collect(),
            arrival: labels_if(self.extras.arrival).par_iter().map(|label| domain.to_unit_unclamped(label.arrival)).collect(),
            jacobian: labels_if(self.extras.jacobian).par_iter().map(|label| unit_jacobian(domain, &label.jacobian)).collect(),
            ..Samples::default()
        }
    }
}
