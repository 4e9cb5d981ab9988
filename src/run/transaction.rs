//! A step of a run as a transaction on one backend.
//!
//! A step first computes, and takes effect only after every fallible operation has succeeded. If the device is out of memory, the slide is
//! replanned and the step is repeated on the device. If the device is lost, or no smaller plan exists, the CPU repeats the step, from the latest
//! host copy of the weights.

use super::stop::RunEnd;
use super::{RunError, Slide};
use crate::backend::{Backend, Cpu, DeviceError, Interruptible, Surrogate, WhenLost};
use crate::flow::FlowMap;
use crate::surrogate::NetworkFrom;
use std::sync::atomic::AtomicBool;

/// A backend with the flow map and the surrogate of the present slide.
pub(super) struct On<B: Backend> {
    pub(super) backend: B,
    /// Holds the window, on the host and on the device. `None` between two slides.
    pub(super) tracer: Option<B::Tracer>,
    /// `None` for the methods `reference` and `map`.
    pub(super) surrogate: Option<B::Surrogate>,
    /// Picture of the slide, which accumulates over smooth frames.
    pub(super) picture: B::Picture,
}

/// Returns the flow map of the slide in progress.
pub(super) fn present<T>(tracer: &Option<T>) -> &T {
    tracer.as_ref().unwrap_or_else(|| unreachable!("steps run while a slide is in progress"))
}

impl<B: Backend> On<B> {
    /// Returns the flow map of the slide in progress.
    pub(super) fn tracer(&self) -> &B::Tracer {
        present(&self.tracer)
    }
}

/// Backend in use.
#[allow(clippy::large_enum_variant)] // A run has a single one.
pub(super) enum Session<B: Backend> {
    /// The backend of the options.
    Device(On<B>),
    /// The CPU, after the device failed.
    Cpu(On<Cpu>),
}

/// Runs `$work` with `$on` bound to the session's backend, whichever it is.
macro_rules! with {
    ($session:expr, $on:ident => $work:expr) => {
        match $session {
            $crate::run::transaction::Session::Device($on) => $work,
            $crate::run::transaction::Session::Cpu($on) => $work,
        }
    };
}

/// Runs `$work` as a transaction: repeats it after a device failure.
macro_rules! transaction {
    ($cycle:expr, $slide:expr, $run:ident, $on:ident => $work:expr) => {
        loop {
            let $run = &mut $cycle.run;
            let result: Result<_, RunEnd> = with!(&mut $cycle.session, $on => $work);
            match result {
                Err(RunEnd::Device(error)) => $cycle.session.recover(error, $slide, &$cycle.map, $run)?,
                result => break result?,
            }
        }
    };
}

pub(super) use {transaction, with};

/// The part of a run that a recovery needs.
pub(super) trait Recovering: Sync {
    /// Adds a warning to the next record.
    fn warn(&mut self, warning: String);
    /// Threads that trace.
    fn pool(&self) -> &rayon::ThreadPool;
    /// Set to request a stop.
    fn stop(&self) -> &AtomicBool;
}

impl<B: Backend> Session<B> {
    /// Prepares the repetition of a step after `error`.
    ///
    /// # Errors
    /// The settings end the run if the device is lost, or the CPU rejects the flow map.
    pub(super) fn recover(&mut self, error: DeviceError, slide: &Slide, map: &FlowMap, run: &mut impl Recovering) -> Result<(), RunEnd> {
        let Session::Device(on) = self else { return Err(RunError::Device(Box::new(error)).into()) };
        let mut error = error;
        // Without a flow map there is no other plan: the window itself does not fit.
        if let (true, Some(tracer)) = (error.is_refusal(), &on.tracer) {
            match run.pool().install(|| on.backend.replan(&error, tracer, &mut on.surrogate)) {
                Ok(Some(warning)) => {
                    run.warn(warning);
                    return Ok(());
                }
                Ok(None) => {}
                Err(worse) => error = worse,
            }
        }
        self.move_to_cpu(error, slide, map, run)
    }

    /// Moves the rest of the run to the CPU.
    ///
    /// # Errors
    /// The settings end the run if the device is lost, or the CPU rejects the flow map.
    pub(super) fn move_to_cpu(
        &mut self,
        error: DeviceError,
        slide: &Slide,
        map: &FlowMap,
        run: &mut impl Recovering,
    ) -> Result<(), RunEnd> {
        let Session::Device(on) = self else { return Ok(()) };
        if on.backend.when_lost() == WhenLost::Stop && !error.is_refusal() {
            return Err(RunError::Device(Box::new(error)).into());
        }
        let mut backend = Cpu;
        let tracer = run.pool().install(|| backend.tracer(&slide.velocity, map, slide.time))?;
        let surrogate = match &mut on.surrogate {
            None => None,
            Some(surrogate) => {
                let alive = error.is_refusal().then(|| surrogate.to_host(NetworkFrom::Device).ok()).flatten();
                let mut host = match alive {
                    Some(host) => host,
                    None => surrogate.to_host(NetworkFrom::HostCopy)?,
                };
                run.pool().install(|| host.trace_table(&Interruptible::new(&tracer, run.stop())))?;
                Some(host)
            }
        };
        *self = Session::Cpu(On { backend, tracer: Some(tracer), surrogate, picture: Default::default() });
        run.warn(format!("work on the GPU has ended, the CPU goes on: {error}"));
        Ok(())
    }
}
