//! Speed against accuracy of a scene: which methods and settings reach which error at which cost, measured on the scene itself.
//!
//! In: the settings of a scene and a device. Out: a [`Chart`] with its panels, as CSV, SVG, PNG and JSON, and a verdict in words. Calls `run`,
//! `publish` (differences of pictures) and the rooms below them.
//!
//! All errors are against a truth made in the same process: Dormand-Prince in f64 for the FTLE, two independent halves of `reference` for pictures.

mod draw;
mod front;
mod ftle;
mod map;
mod networks;
mod picture;
mod scaling;
mod slides;
mod still;
mod table;
mod train;
mod verdict;

pub use draw::{Curve, DrawError, write_epochs, write_png, write_svg};
pub use front::{front, pick};
pub use ftle::{Front, FtlePanel, FtlePoint};
pub use picture::{PictureCurve, PictureErrors, PicturePanel, PicturePoint, Sliding, TARGETS, Truth, most_wrong, picture_errors};
pub use scaling::{Axis, ScalingPanel, ScalingPoint};
pub use still::fixed_colours;
pub use table::csv;
pub use train::{Epoch, TrainOptions, TrainReport, train};
pub use verdict::verdict;

#[cfg(feature = "cuda")]
use crate::backend::cuda::Cuda;
use crate::backend::{Backend as _, BackendError, Cpu, Device};
use crate::render::Method;
use crate::run::{RunError, Settings, auto_is_map};
use crate::surrogate::Kind;
use serde::{Deserialize, Deserializer, Serialize};
use slides::FirstSlides;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// What is charted, and for how long.
#[derive(Debug, Clone, PartialEq)]
pub struct ChartOptions {
    /// Seconds for everything. What did not fit is named in [`Chart::not_measured`].
    pub seconds: f64,
    /// FTLE panel.
    pub ftle: bool,
    /// Picture panel.
    pub pictures: bool,
    /// Scaling panel.
    pub scaling: bool,
}

impl Default for ChartOptions {
    fn default() -> Self {
        Self { seconds: 300.0, ftle: true, pictures: true, scaling: true }
    }
}

/// The chart of a scene.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Chart {
    /// Title of the scene.
    pub scene: String,
    /// Description of the velocity.
    pub source: String,
    /// The device that computed, as in the records.
    pub device: String,
    /// Threads of the CPU.
    pub threads: usize,
    /// |tau|.
    pub tau: f64,
    /// Unit of tau and 1/FTLE; empty if it has none.
    pub time_unit: String,
    /// Errors and costs of FTLE samples.
    pub ftle: Option<FtlePanel>,
    /// Errors and times of pictures.
    pub pictures: Option<PicturePanel>,
    /// Costs against the size of the task.
    pub scaling: Option<ScalingPanel>,
    /// Methods and settings that were not measured, with the reason.
    pub not_measured: Vec<String>,
    /// Wall-clock seconds of the whole chart.
    pub seconds: f64,
}

/// What the panels share: the scene, the device, the clock, and what could not be measured.
struct Charting<'a> {
    settings: &'a Settings,
    device: &'a Device,
    pool: rayon::ThreadPool,
    ends: Instant,
    stop: &'a AtomicBool,
    tell: &'a (dyn Fn(&str) + Sync),
    not_measured: Vec<String>,
}

impl Charting<'_> {
    /// Notes that something was not measured.
    fn skip(&mut self, what: impl std::fmt::Display, why: impl std::fmt::Display) {
        self.not_measured.push(format!("{what}: {why}"));
    }

    /// Notes that something was not measured because it was refused. A lost device is an error.
    fn refused(&mut self, what: impl std::fmt::Display, error: RunError) -> Result<(), RunError> {
        if let RunError::Device(device) = &error
            && device.is_fault()
        {
            return Err(error);
        }
        self.skip(what, error);
        Ok(())
    }

    /// True if there is time for something. Otherwise notes that it was not measured.
    fn has_time_for(&mut self, what: &str) -> bool {
        if self.stop.load(Ordering::Relaxed) {
            self.skip(what, "stopped");
            return false;
        }
        if Instant::now() >= self.ends {
            self.skip(what, "no time was left (--seconds)");
            return false;
        }
        (self.tell)(what);
        true
    }

    /// Runs work with another end: after the given share of the time that is left.
    fn with_share<T>(&mut self, share: f64, work: impl FnOnce(&mut Self) -> T) -> T {
        let whole = self.begin_share(share);
        let result = work(self);
        self.ends = whole;
        result
    }

    /// Moves the end to the given share of the time that is left, and returns the end before.
    fn begin_share(&mut self, share: f64) -> Instant {
        let end = Instant::now() + Duration::from_secs_f64(share * self.left());
        std::mem::replace(&mut self.ends, end)
    }

    fn left(&self) -> f64 {
        self.ends.saturating_duration_since(Instant::now()).as_secs_f64()
    }
}

/// Name of a device, as in the records.
pub fn device_name(device: &Device) -> String {
    match device {
        Device::Cpu { .. } => Cpu.name(),
        #[cfg(feature = "cuda")]
        Device::Cuda(device) => Cuda::new(device).name(),
    }
}

/// A number that JSON writes as `null`, since it is none or infinite.
fn number_or_nan<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    Ok(Option::deserialize(deserializer)?.unwrap_or(f64::NAN))
}

/// Error of a backend or its device.
fn failed(error: impl Into<BackendError>) -> RunError {
    RunError::of(error.into())
}

/// Charts a scene on a device with `threads` threads of the CPU (0: as many as the process may use). `tell` is called with what is being measured.
/// Setting `stop` ends the chart soon, with what was measured until then.
///
/// # Errors
/// The source cannot be opened, or the device fails. A method that a device or a scene does not have is no error.
pub fn chart(
    settings: &Settings,
    options: &ChartOptions,
    device: &Device,
    threads: usize,
    tell: &(dyn Fn(&str) + Sync),
    stop: &AtomicBool,
) -> Result<Chart, RunError> {
    let began = Instant::now();
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build()?;
    let threads = pool.current_num_threads();
    let ends = began + Duration::from_secs_f64(options.seconds);
    let slides = FirstSlides::read(settings, if options.pictures { picture::SLIDES } else { 1 }, stop)?;
    let given = settings;
    let settings = &slides.settled(settings);
    let mut charting = Charting { settings, device, pool, ends, stop, tell, not_measured: Vec::new() };
    let opened = ftle::Opened::new(settings, device, &slides)?;
    let (source, tau, time_unit) = (opened.plan.source.clone(), opened.plan.map.tau, opened.plan.time_unit.clone());
    let auto_is_map = auto_is_map(given, &opened.plan.domain);
    let ftle = if options.ftle {
        let share = if options.pictures { 0.45 } else { 0.85 };
        Some(charting.with_share(share, |charting| ftle::panel(charting, &opened))?)
    } else {
        None
    };
    let scaling = if options.scaling { Some(charting.with_share(0.15, |charting| scaling::panel(charting, &opened))?) } else { None };
    let pictures = if options.pictures { Some(picture::panel(&mut charting, &opened, &slides, auto_is_map)?) } else { None };
    Ok(Chart {
        scene: settings.title.clone(),
        source,
        device: opened.device_name,
        threads,
        tau,
        time_unit,
        ftle,
        pictures,
        scaling,
        not_measured: charting.not_measured,
        seconds: began.elapsed().as_secs_f64(),
    })
}

/// The scene with another method, and a number of samples that the method accepts.
fn with_method(settings: &Settings, method: Method, kind: Kind) -> Settings {
    let mut settings = settings.clone();
    (settings.render.method, settings.render.until, settings.render.budget) = (method, None, None);
    if !method.is_smooth() {
        settings.render.samples = settings.render.samples.ceil().max(1.0);
    }
    if kind != settings.surrogate.kind {
        (settings.surrogate.kind, settings.surrogate.table_nodes) = (kind, None);
    }
    if kind != Kind::Network {
        (settings.network.inputs, settings.network.start_range) = (Vec::new(), None);
    }
    settings.training.resume = None;
    settings
}
