//! Placement of the work on the device or on the CPU, decided once per slide from a memory estimate.
//!
//! The window and the tracing are always on the device. The surrogate and the frames are on the device if the table and the network fit. Training is
//! on the device if its memory fits as well. If memory runs out in spite of the estimate, the placement is lowered by one step and the slide is
//! planned again.

/// Processor that runs a piece of work.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Place {
    /// On the device.
    Device,
    /// On the CPU.
    Host,
}

/// Device memory that a surrogate needs, in bytes.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Needs {
    /// The table; 0 without one.
    pub table: u64,
    /// The network for prediction; 0 without one.
    pub network: u64,
    /// Training state and samples, in addition to `network`; 0 if the device does not train it.
    pub training: u64,
}

/// Processors that render and train.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Placement {
    /// Frames, and the surrogate that they query.
    pub frames: Place,
    /// Optimizer steps.
    pub training: Place,
}

impl Placement {
    /// Everything on the device.
    pub const DEVICE: Self = Self { frames: Place::Device, training: Place::Device };
    /// Only the window and the tracing on the device.
    pub const TRACING_ONLY: Self = Self { frames: Place::Host, training: Place::Host };

    /// Returns the highest placement, not above `self`, that needs at most `left` bytes. If it is lower than `self`, a warning says why.
    pub fn within(self, needs: Needs, left: u64) -> (Self, Option<String>) {
        let mib = |bytes: u64| bytes.div_ceil(1 << 20);
        let resident = needs.table + needs.network;
        if self.frames == Place::Device && resident > left {
            let why = format!(
                "the CPU renders the frames and the GPU traces for them: the surrogate needs {} MiB on the device, {} MiB are left",
                mib(resident),
                mib(left)
            );
            return (Self::TRACING_ONLY, Some(why));
        }
        let training = resident + needs.training;
        if self.training == Place::Device && needs.training > 0 && training > left {
            let why = format!(
                "the network is trained on the CPU: surrogate and training need {} MiB on the device, {} MiB are left",
                mib(training),
                mib(left)
            );
            return (Self { training: Place::Host, ..self }, Some(why));
        }
        (self, None)
    }

    /// Returns the next lower placement. `None` if only tracing is on the device.
    pub fn lower(self, trains_on_device: bool) -> Option<Self> {
        match self {
            Self { training: Place::Device, .. } if trains_on_device => Some(Self { training: Place::Host, ..self }),
            Self { frames: Place::Device, .. } => Some(Self::TRACING_ONLY),
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const NEEDS: Needs = Needs { table: 100 << 20, network: 20 << 20, training: 50 << 20 };

    #[test]
    fn work_moves_to_the_cpu_as_memory_gets_short() {
        let planned = |mib: u64| Placement::DEVICE.within(NEEDS, mib << 20);
        assert_eq!(planned(170), (Placement::DEVICE, None));
        let (placement, why) = planned(169);
        assert_eq!((placement.frames, placement.training), (Place::Device, Place::Host));
        assert!(why.unwrap().contains("170 MiB on the device, 169 MiB are left"));
        let (placement, why) = planned(119);
        assert_eq!(placement, Placement::TRACING_ONLY);
        assert!(why.unwrap().contains("120 MiB on the device, 119 MiB are left"));
        assert_eq!(placement.within(NEEDS, 1 << 40), (placement, None), "a plan never rises above what it is bound by");
    }

    #[test]
    fn a_shortage_lowers_the_placement_until_only_tracing_is_left() {
        let training_here = Placement::DEVICE.lower(true).unwrap();
        assert_eq!(training_here, Placement { frames: Place::Device, training: Place::Host });
        assert_eq!(training_here.lower(false), Some(Placement::TRACING_ONLY));
        assert_eq!(Placement::DEVICE.lower(false), Some(Placement::TRACING_ONLY));
        assert_eq!(Placement::TRACING_ONLY.lower(false), None);
    }
}
