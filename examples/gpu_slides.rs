//! Measures the cost of a new snapshot in a running loop: the standard easy turbulence, streamed, with every query traced. Times of frames and
//! slides by stage, and device memory over a thousand frames. Prints a table; needs a GPU. `-- WIDTH HEIGHT NX NY NZ` sets another picture or grid.

#![allow(clippy::unwrap_used, clippy::print_stdout)] // a measurement, which may stop and prints

use ridgewatch::backend::cuda::{Cuda, CudaSamples, CudaSurrogate, CudaTracer, DeviceError, Gpu, GpuSettings};
use ridgewatch::backend::{
    AuditFindings, AuditRequest, Backend, BackendError, CudaDevice, FrameJob, FrozenOf, Rendered, Storage, SurrogateRequest, WhenLost,
};
use ridgewatch::config::SceneFile;
use ridgewatch::field::Snapshot;
use ridgewatch::field::turbulence::Turbulence;
use ridgewatch::flow::{FlowMap, VelocitySource};
use ridgewatch::render::Renderer;
use ridgewatch::run::{Event, FrameRecord, RunOptions, Setup, run_on};
use ridgewatch::source::{Listener, MemorySource};
use std::path::Path;
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex};
use std::time::Instant;

/// Timings of the work that slides request from a GPU.
#[derive(Default)]
struct Clock {
    tracer_seconds: Vec<f64>,
    /// Snapshots uploaded until the latest slide, and how many of them were prefetched.
    uploaded: u64,
    ahead: u64,
}

/// The GPU backend with timings, with or without prefetching of snapshots.
struct Timed {
    inner: Cuda,
    ahead: bool,
    clock: Arc<Mutex<Clock>>,
}

impl Backend for Timed {
    type Tracer = CudaTracer;
    type Surrogate = CudaSurrogate;
    type Samples = CudaSamples;
    type Picture = <Cuda as Backend>::Picture;

    fn name(&self) -> String {
        self.inner.name()
    }
    fn prefetch(&self) -> Option<Listener> {
        self.inner.prefetch().filter(|_| self.ahead)
    }
    fn tracer(&mut self, velocity: &VelocitySource, map: &FlowMap, t0: f64) -> Result<CudaTracer, BackendError> {
        let began = Instant::now();
        let tracer = self.inner.tracer(velocity, map, t0);
        let mut clock = self.clock.lock().unwrap();
        clock.tracer_seconds.push(began.elapsed().as_secs_f64());
        (clock.uploaded, clock.ahead) = (self.inner.snapshots().uploaded(), self.inner.snapshots().prefetched());
        tracer
    }
    fn surrogate(&mut self, request: &SurrogateRequest<'_>, tracer: &CudaTracer) -> Result<CudaSurrogate, BackendError> {
        self.inner.surrogate(request, tracer)
    }
    fn render(
        &mut self,
        job: &FrameJob<'_, Self>,
        renderer: &mut Renderer,
        accumulated: &mut Self::Picture,
    ) -> Result<Rendered<CudaSamples>, DeviceError> {
        let &FrameJob { tracer, surrogate, routing, picture, samples, smooth, is_map, progress, stop } = job;
        self.inner.render(&FrameJob { tracer, surrogate, routing, picture, samples, smooth, is_map, progress, stop }, renderer, accumulated)
    }
    fn audit(
        &mut self,
        request: &AuditRequest<'_>,
        tracer: &CudaTracer,
        surrogate: Option<&FrozenOf<Self>>,
    ) -> Result<AuditFindings, DeviceError> {
        self.inner.audit(request, tracer, surrogate)
    }
    fn most_refined_nodes(&self) -> usize {
        self.inner.most_refined_nodes()
    }
    fn nodes_per_sample(&self) -> [usize; 2] {
        self.inner.nodes_per_sample()
    }
    fn replan(
        &mut self,
        shortage: &DeviceError,
        tracer: &CudaTracer,
        surrogate: &mut Option<CudaSurrogate>,
    ) -> Result<Option<String>, DeviceError> {
        self.inner.replan(shortage, tracer, surrogate)
    }
    fn when_lost(&self) -> WhenLost {
        self.inner.when_lost()
    }
    fn may_fall_back(&self) -> bool {
        self.inner.may_fall_back()
    }
}

struct Seen {
    record: Arc<FrameRecord>,
    /// Since the frame before.
    interval: f64,
    /// Bytes allocated by ridgewatch, and free bytes of the device.
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
    // A measurement must not fall back to the CPU.
    let chosen = CudaDevice { gpu: gpu.clone(), storage: Some(Storage::F32), when_lost: WhenLost::Stop, may_fall_back: false };
    let mut memory = Vec::new();
    for (what, ahead, slides, frames_per_slide) in
        [("brought on the slide", false, 24, 1), ("brought ahead", true, 24, 1), ("brought ahead", true, 40, 25)]
    {
        let clock = Arc::<Mutex<Clock>>::default();
        let device = Timed { inner: Cuda::new(&chosen), ahead, clock: clock.clone() };
        let seen = stream(&gpu, device, [width, height], shape, slides, frames_per_slide);
        let clock = clock.lock().unwrap();
        let of = |with_slide: bool| seen.iter().filter(move |s| s.record.slide > 0 && (s.record.seconds.slide > 0.0) == with_slide);
        let from_frame_to_frame = |with_slide: bool| spread(of(with_slide).map(|s| s.interval - s.record.seconds.waiting));
        println!(
            "| {what} | {slides} | {frames_per_slide} | {} | {} | {} | {} | {} | {} | {} | {} |",
            spread(of(true).map(|s| s.record.seconds.slide)),
            spread(clock.tracer_seconds.iter().skip(1).copied()),
            spread(of(true).map(|s| s.record.seconds.waiting)),
            spread(of(true).map(|s| s.record.seconds.total)),
            spread(of(false).map(|s| s.record.seconds.total)),
            spread(seen.iter().map(|s| s.record.seconds.audit)),
            from_frame_to_frame(true),
            from_frame_to_frame(false)
        );
        // All memory is allocated before the third slide.
        let settled: Vec<&Seen> = seen.iter().filter(|s| s.record.slide >= 2).collect();
        let (least, most) = (settled.iter().map(|s| s.taken).min().unwrap_or(0), settled.iter().map(|s| s.taken).max().unwrap_or(0));
        let (begin, end) = (settled.first().map_or(0, |s| s.free), settled.last().map_or(0, |s| s.free));
        memory.push(format!(
            "{} frames, {} of {} snapshots ahead: {} to {} MiB taken from the third slide on; free at its begin {} MiB, at the end {} MiB.",
            seen.len(),
            clock.ahead,
            clock.uploaded,
            least >> 20,
            most >> 20,
            begin >> 20,
            end >> 20
        ));
    }
    println!("\n{}", memory.join("\n"));
}

/// Runs the cycle over snapshots that are ready in memory, so that reading costs nothing.
fn stream(gpu: &Arc<Gpu>, device: Timed, size: [usize; 2], shape: [usize; 3], slides: usize, frames_per_slide: usize) -> Vec<Seen> {
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
    let options = RunOptions::default();
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
    run_on(device, setup, &options, &mut sink, &AtomicBool::new(false)).unwrap();
    seen
}
