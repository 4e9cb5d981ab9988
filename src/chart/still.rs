//! Pictures of a window that stands still, and what they share.

use super::slides::FirstSlides;
use super::{failed, with_method};
#[cfg(feature = "cuda")]
use crate::backend::cuda::Cuda;
use crate::backend::{Backend, Cpu, Device};
use crate::render::{Method, TransferSettings};
use crate::run::{Event, Frame, Plan, RunError, RunOptions, Settings, Setup, Slide, run, settled_colours};
use crate::surrogate::Kind;
use std::sync::atomic::{AtomicBool, Ordering};

/// Transfer function for all pictures of a chart, scaled to the first slide's FTLE where the scene leaves it open.
///
/// # Errors
/// The source cannot be opened, or the device fails.
pub fn fixed_colours(settings: &Settings, device: &Device) -> Result<TransferSettings, RunError> {
    colours_of(settings, Method::Reference, device, &FirstSlides::read(settings, 1, &AtomicBool::new(false))?)
}

/// Those of pictures by a method, with slides that were read before.
pub(super) fn colours_of(settings: &Settings, method: Method, device: &Device, slides: &FirstSlides) -> Result<TransferSettings, RunError> {
    let plan = Setup::new(with_method(&slides.settled(settings), method, Kind::Table))?.plan;
    fn of<B: Backend>(mut backend: B, plan: &Plan, slide: &Slide) -> Result<TransferSettings, RunError> {
        let tracer = backend.tracer(&slide.velocity, &plan.map, slide.time).map_err(failed)?;
        settled_colours(plan, &tracer, slide)
    }
    match device {
        Device::Cpu { .. } => of(Cpu, &plan, slides.first()),
        #[cfg(feature = "cuda")]
        Device::Cuda(device) => of(Cuda::new(device), &plan, slides.first()),
    }
}

/// Runs slide `slide` of a scene, counted from 0, until `seen` returns false for a frame. Returns the bytes of the surrogate.
pub(super) fn still(
    settings: Settings,
    options: &RunOptions,
    (slides, slide): (&FirstSlides, usize),
    mut seen: impl FnMut(&Frame) -> bool + Send,
) -> Result<usize, RunError> {
    let mut settings = settings;
    (settings.time.warmup_frames, settings.time.frames_per_slide) = (0, 1_000_000);
    let enough = AtomicBool::new(false);
    let mut sink = |event: Event| {
        if let Event::Frame(frame) = event
            && !enough.load(Ordering::Relaxed)
            && !seen(&frame)
        {
            enough.store(true, Ordering::Relaxed);
        }
    };
    Ok(run(slides.setup(settings, slide)?, options, &mut sink, &enough)?.surrogate_bytes)
}

/// Renders a frame that is not measured: on a GPU the first one compiles kernels.
pub(super) fn compile(settings: &Settings, options: &RunOptions, slides: &FirstSlides) -> Result<(), RunError> {
    if options.device.is_gpu() {
        still(with_method(settings, Method::TwoLevel, settings.surrogate.kind), options, (slides, 0), |_| false)?;
    }
    Ok(())
}
