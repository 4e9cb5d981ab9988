//! The seam for engines that train networks on a device: what is asked of one.
//!
//! burn's module stays on the host. It goes over when training begins; for a checkpoint and every minute or so a copy comes back while training
//! goes on, and when the device is lost, training goes on here from what came back last.

use super::network::{Architecture, Average, Model, Objective, PlannedStep};
use super::{SampleRing, Table};
use std::any::Any;
use std::ops::Range;
use std::sync::Arc;

/// Trains networks on a device.
pub trait Offload: Send + Sync {
    /// Whether networks of this shape can be trained there.
    fn takes(&self, shape: &Architecture, objective: &Objective) -> bool;

    /// Takes a network over, parameters, moments and their running mean, with room for a ring of so many samples, and for steps of at most so many.
    ///
    /// # Errors
    /// [`NotTaken`]; nothing is left there then.
    fn training(
        &self,
        model: &Model,
        objective: &Objective,
        average: &Average,
        ring: usize,
        batch: usize,
    ) -> Result<Box<dyn OffloadedTraining>, NotTaken>;
}

/// Why a device does not take a network over, or samples and steps of one that it has.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum NotTaken {
    /// It is lost.
    #[error(transparent)]
    Lost(#[from] DeviceLost),
    /// It works, but has no memory for it; for what, in words. What it has of the network is as it was, and can be brought back.
    #[error("{0}")]
    NoRoom(String),
    /// The same for the table that targets are relative to: the next may find room, or go there by itself.
    #[error("{0}")]
    NoRoomForBase(String),
}

/// The device is lost, for a reason that was told where it happened.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the device is lost")]
pub struct DeviceLost;

/// Samples on a device.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Brought {
    /// Those that can be trained on. A device may hold more than the ring: labels that were traced there and never left it.
    pub usable: usize,
    /// Those of the ring that cannot, since they are not finite.
    pub dropped: usize,
}

/// A network in training on a device, where any call may be the last: every one of them may fail with [`DeviceLost`], and those that take memory with
/// [`NotTaken`].
#[allow(clippy::missing_errors_doc)] // said above
pub trait OffloadedTraining: Send + Sync {
    /// Brings over what `ring` has got since the last call, with what the labels have beyond `base` as targets.
    fn bring(&mut self, ring: &SampleRing, base: Option<&Table>) -> Result<Brought, NotTaken>;

    /// What was traced on the device so far is wrong from now on: the window has slid.
    fn forget_labels(&mut self);

    /// Gives back what the device holds of the table that targets are relative to, which is about to be traced anew.
    fn let_go_of_base(&mut self);

    /// Takes steps on the samples that were brought over; the loss of each, before it. Where there is no memory for one, those before it are taken.
    fn steps(&mut self, steps: &[PlannedStep]) -> Result<Vec<f64>, NotTaken>;

    /// Remembers parameters, moments and mean as what to come back to.
    fn keep(&mut self) -> Result<(), NotTaken>;

    /// Comes back to what was kept last.
    fn roll_back(&mut self) -> Result<(), DeviceLost>;

    /// Sets the running mean to the present parameters.
    fn restart_average(&mut self) -> Result<(), DeviceLost>;

    /// Sets parameters of the layers to 0, and their moments and means.
    fn zero_layers(&mut self, range: Range<usize>) -> Result<(), DeviceLost>;

    /// What the running mean predicts, for good.
    fn frozen(&self) -> Result<Arc<dyn OffloadedNetwork>, NotTaken>;

    /// Brings parameters, moments and mean back, and waits for them. Takes no memory there.
    fn fetch(&self, model: &mut Model, average: &mut Average) -> Result<(), DeviceLost>;

    /// Copies parameters, moments and mean where they are, to be brought back by another thread while training goes on. Not asked for while the
    /// copy before is still there.
    fn copy(&mut self) -> Result<Copied, DeviceLost>;

    /// Seconds of device time that steps have taken since this was last asked.
    fn device_seconds(&mut self) -> f64;
}

/// What [`OffloadedTraining::copy`] came to.
pub enum Copied {
    /// A copy.
    There(Box<dyn OffloadedCopy>),
    /// There is no memory for one; why, in words.
    NoRoom(String),
}

/// A copy on a device of a network in training.
pub trait OffloadedCopy: Send {
    /// Brings parameters, moments and mean back, into what has the same shape, and gives the copy up.
    ///
    /// # Errors
    /// When the device is lost; `model` and `average` then hold anything.
    fn read(self: Box<Self>, model: &mut Model, average: &mut Average) -> Result<(), DeviceLost>;
}

/// A network on a device that does not change.
pub trait OffloadedNetwork: Send + Sync {
    /// Writes the log-stretch (or the residual's part of it) at each unit point, at these unit times.
    ///
    /// # Errors
    /// [`NotTaken`], told where it happened; `out` then holds anything.
    fn predict(&self, points: &[[f32; 3]], times: [f32; 2], out: &mut [f32]) -> Result<(), NotTaken>;

    /// Brings the parameters that it predicts by back, into those of the same shape, perhaps rounded to halves. Takes no memory there.
    ///
    /// # Errors
    /// When the device is lost; `into` then holds anything.
    fn fetch(&self, into: &mut Average) -> Result<(), DeviceLost>;

    /// Itself, for the engine whose device it is on.
    fn as_any(&self) -> &dyn Any;
}
