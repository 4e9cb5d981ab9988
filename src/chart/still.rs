//! Pictures of a window that stands still, and what they share.

use super::slides::FirstSlides;
use super::{failed, with_method};
#[cfg(feature = "cuda")]
use crate::backend::cuda::Cuda;
use crate::backend::{Backend, Cpu, Device};
use crate::render::smooth::{LIT, squared_slope};
use crate::render::{Film, Method, TransferSettings};
use crate::run::{Event, Frame, Plan, RunError, RunOptions, Settings, Setup, Slide, run, settled_colours};
use crate::surrogate::Kind;
use std::sync::atomic::{AtomicBool, Ordering};

/// PSNR over lit pixels, in decibels, of the mean of two independent pictures, from their difference.
pub(super) fn noise_psnr(a: &Film, b: &Film, tone_map: [f64; 3]) -> f64 {
    let (mut sum, mut lit) = (0.0, 0.0);
    for (a, b) in a.rgba.iter().zip(&b.rgba).filter(|(a, b)| a[3] + b[3] > 2.0 * LIT) {
        lit += 1.0;
        for (a, b) in a[..3].iter().zip(&b[..3]) {
            sum += f64::from(squared_slope(tone_map, 0.5 * (a + b))) * f64::from(0.5 * (a - b)).powi(2) / 3.0;
        }
    }
    -10.0 * (sum / lit).max(1e-12).log10()
}

/// Transfer function for all pictures of a chart, scaled to the first slide's FTLE where the scene leaves it open.
///
/// # Errors
/// The source cannot be opened, or the device fails.
pub fn fixed_colours(settings: &Settings, device: &Device) -> Result<TransferSettings, RunError> {
    colours_of(settings, device, &FirstSlides::read(settings, 1, &AtomicBool::new(false))?)
}

/// As [`fixed_colours`], with slides that were read before.
pub(super) fn colours_of(settings: &Settings, device: &Device, slides: &FirstSlides) -> Result<TransferSettings, RunError> {
    let plan = Setup::new(with_method(&slides.settled(settings), Method::Reference, Kind::Table))?.plan;
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
