//! What a new snapshot costs a running loop: the standard easy turbulence, streamed, every query traced; frames and slides by stage, and
//! the device's memory over a thousand frames. Prints; needs a GPU. `-- WIDTH HEIGHT NX NY NZ` for another picture or grid.

#![allow(clippy::unwrap_used, clippy::print_stdout)] // a measurement, which may stop and prints

use ridgewatch::backend::cuda::{CudaAccelerator, CudaTracerError, DeviceError, Gpu, GpuSettings};
use ridgewatch::backend::{Device, Storage};
use ridgewatch::config::SceneFile;
use ridgewatch::field::Snapshot;
use ridgewatch::field::turbulence::Turbulence;
use ridgewatch::flow::{FlowMap, Tracer, VelocitySource};
use ridgewatch::run::{Accelerator, DeviceRenderer, Event, FrameRecord, Health, RunOptions, Setup, run};
use ridgewatch::source::MemorySource;
use std::path::Path;
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex};
use std::time::Instant;

/// The GPU, with a clock on what a slide asks of it; told of snapshots ahead or not.
#[derive(Debug)]
struct Timed {
    inner: CudaAccelerator,
    ahead: bool,
    tracer_seconds: Mutex<Vec<f64>>,
}

impl Accelerator for Timed {
    fn name(&self) -> String {
        self.inner.name()
    }
    fn health(&self) -> &Arc<Health> {
        self.inner.health()
    }
    fn tracer(&self, source: VelocitySource, map: &FlowMap, t0: f64) -> Result<Box<dyn Tracer>, CudaTracerError> {
        let began = Instant::now();
        let tracer = self.inner.tracer(source, map, t0);
        self.tracer_seconds.lock().unwrap().push(began.elapsed().as_secs_f64());
        tracer
    }
    fn renderer(&self) -> Result<Box<dyn DeviceRenderer>, DeviceError> {
        self.inner.renderer()
    }
    fn expect(&self, snapshot: &Arc<Snapshot>) {
        if self.ahead {
            self.inner.expect(snapshot);
        }
    }
}

struct Seen {
    record: Arc<FrameRecord>,
    /// Since the frame before.
    interval: f64,
    /// Bytes that ridgewatch has taken, and bytes of the device that are free.
    taken: u64,
    free: usize,
}

/// Median and largest, in milliseconds.
fn spread(values: impl Iterator<Item = f64>) -> String {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    match values.as_slice() {
        [] => "-".into(),
        [.., last] => format!("{:.1}, {:.1}", 1e3 * values[values.len() / 2], 1e3 * last),
    }
}

fn main() {
    let given: Vec<usize> = std::env::args().skip(1).filter_map(|a| a.parse().ok()).collect();
    let value = |i: usize, default: usize| given.get(i).copied().unwrap_or(default);
    let (width, height) = (value(0, 1920), value(1, 1080));
    let shape = [value(2, 600), value(3, 192), value(4, 192)];
    let gpu = Gpu::open(0, &GpuSettings::default()).unwrap_or_else(|why| panic!("nothing is measured: {why}"));
    println!("<!-- block slides -->");
    println!("{width}x{height} pixels of {shape:?} nodes, 22 steps, one sample; milliseconds, median and largest.\n");
    println!(
        "| snapshots | slides | frames a slide | slide | its tracer | waiting for input | first frame of a slide | other frames | audits | \
         frame to frame with a slide | without |"
    );
    println!("|---|---|---|---|---|---|---|---|---|---|---|");
    let mut memory = Vec::new();
    for (what, ahead, slides, frames_per_slide) in
        [("brought on the slide", false, 24, 1), ("brought ahead", true, 24, 1), ("brought ahead", true, 40, 25)]
    {
        let device = Timed { inner: CudaAccelerator::new(gpu.clone(), Storage::F32), ahead, tracer_seconds: Mutex::default() };
        let device = Arc::new(device);
        let seen = stream(&gpu, &device, [width, height], shape, slides, frames_per_slide);
        let of = |with_slide: bool| seen.iter().filter(move |s| s.record.slide > 0 && (s.record.seconds.slide > 0.0) == with_slide);
        let tracers = device.tracer_seconds.lock().unwrap();
        let from_frame_to_frame = |with_slide: bool| spread(of(with_slide).map(|s| s.interval - s.record.seconds.waiting));
        println!(
            "| {what} | {slides} | {frames_per_slide} | {} | {} | {} | {} | {} | {} | {} | {} |",
            spread(of(true).map(|s| s.record.seconds.slide)),
            spread(tracers.iter().skip(1).copied()),
            spread(of(true).map(|s| s.record.seconds.waiting)),
            spread(of(true).map(|s| s.record.seconds.total)),
            spread(of(false).map(|s| s.record.seconds.total)),
            spread(seen.iter().map(|s| s.record.seconds.audit)),
            from_frame_to_frame(true),
            from_frame_to_frame(false)
        );
        // From the third slide on, everything that is ever taken has been.
        let settled: Vec<&Seen> = seen.iter().filter(|s| s.record.slide >= 2).collect();
        let (least, most) = (settled.iter().map(|s| s.taken).min().unwrap_or(0), settled.iter().map(|s| s.taken).max().unwrap_or(0));
        let (begin, end) = (settled.first().map_or(0, |s| s.free), settled.last().map_or(0, |s| s.free));
        memory.push(format!(
            "{} frames, {} of {} snapshots ahead: {} to {} MiB taken from the third slide on; free at its begin {} MiB, at the end {} MiB.",
            seen.len(),
            device.inner.snapshots().brought_ahead(),
            device.inner.snapshots().brought(),
            least >> 20,
            most >> 20,
            begin >> 20,
            end >> 20
        ));
    }
    println!("\n{}", memory.join("\n"));
}

/// Runs the cycle over snapshots that are ready in memory, so that reading costs nothing.
fn stream(gpu: &Arc<Gpu>, device: &Arc<Timed>, size: [usize; 2], shape: [usize; 3], slides: usize, frames_per_slide: usize) -> Vec<Seen> {
    let text = format!(
        "[source]\nkind = \"turbulence\"\nnodes = {shape:?}\n[time]\ntau = 11\nframes_per_slide = {frames_per_slide}\n[flow]\nsteps = 22\n\
         [render]\nmethod = \"reference\"\nwidth = {}\nheight = {}\nsamples = 1\n",
        size[0], size[1]
    );
    let scene = SceneFile::parse(Path::new("slides.toml"), &text, &[]).unwrap();
    let grid = Turbulence::grid(shape).unwrap();
    let turbulence = Turbulence::easy(shape, 0);
    let mut ready: Vec<Option<Snapshot>> = (0..11 + slides).map(|t| Some(turbulence.snapshot(t as f64, &grid))).collect();
    let times = (0..ready.len()).map(|t| t as f64).collect();
    let source = MemorySource::new("streamed turbulence", grid, times, move |index, _| ready[index].take().unwrap()).unwrap();
    let setup = Setup::over(scene.settings(), Some(Box::new(source))).unwrap();
    let options = RunOptions { device: Device::Gpu { gpu: device.clone(), may_fall_back: false }, ..RunOptions::default() };
    let (mut seen, mut last) = (Vec::new(), Instant::now());
    let mut sink = |event: Event| {
        if let Event::Frame(frame) = event {
            let interval = last.elapsed().as_secs_f64();
            last = Instant::now();
            seen.push(Seen {
                record: frame.record.clone(),
                interval,
                taken: gpu.memory().0,
                free: gpu.context().mem_get_info().unwrap().0,
            });
        }
    };
    run(setup, &options, &mut sink, &AtomicBool::new(false)).unwrap();
    assert_eq!(device.health().failure(), None);
    seen
}
