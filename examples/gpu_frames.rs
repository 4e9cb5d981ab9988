//! Measures frames of the standard easy turbulence on a GPU with every query traced: frame rate, time by stage, cost of a new snapshot.
//! Prints a table; needs a GPU. `-- WIDTH HEIGHT NX NY NZ` sets another picture or grid.

#![allow(clippy::unwrap_used, clippy::print_stdout)] // a measurement, which may stop and prints

use ridgewatch::backend::cuda::{CudaTracer, Gpu, GpuRenderer, GpuSettings, LookAhead, SnapshotStore, Timeline, TraceAll, Tuning};
use ridgewatch::field::turbulence::Turbulence;
use ridgewatch::field::{DomainPoint, UnitPoint, Window};
use ridgewatch::flow::{Boundary, Direction, Extras, FlowMap, Integrator, Interpolation, Normalisation, Precision, Steps, VelocitySource};
use ridgewatch::render::{RenderSettings, Renderer, Scene, TransferSettings};
use ridgewatch::surrogate::Trace;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Instant;

static NEVER: AtomicBool = AtomicBool::new(false);
const TAU: f64 = 11.0;

fn map(steps: usize) -> FlowMap {
    FlowMap {
        tau: TAU,
        direction: Direction::Forward,
        integrator: Integrator::Tangent,
        precision: Precision::F32,
        steps: Steps::Fixed(steps),
        difference_step: 1e-4,
        boundary: Boundary::Clamp,
        normalisation: Normalisation::Tau,
        interpolation: Interpolation::Linear,
    }
}

/// Default scene of a file of this field, at this size.
fn scene(tracer: &CudaTracer, width: usize, height: usize, seed: u64) -> Scene {
    let domain = tracer.host().domain();
    let at = |i: usize, n: usize| (i as f32 + 0.5) / n as f32;
    let unit = (0..64 * 64 * 16).map(|i| UnitPoint([at(i % 64, 64), at(i / 64 % 64, 64), at(i / 4096, 16)]));
    let seeds: Vec<DomainPoint> = unit.map(|u| domain.from_unit(u)).collect();
    let mut probes = ridgewatch::flow::Traced::default();
    tracer.trace(&seeds, Extras::default(), &mut probes).unwrap();
    let ftle: Vec<f32> = probes.log_stretch.iter().map(|s| s / TAU as f32).collect();
    let settings = RenderSettings { width, height, ..RenderSettings::default() };
    let mut scene = Scene::assemble(domain, None, None, None, settings, seed);
    scene.transfer = TransferSettings::default().scaled_to(&ftle);
    scene
}

/// A renderer whose majorants have settled.
fn settled(device: &mut GpuRenderer, tracer: &CudaTracer, scene: Scene) -> Renderer {
    let mut renderer = Renderer::new(scene, tracer.host().domain(), TAU).unwrap();
    for frame in 0..6 {
        device.render_samples(&mut renderer, 1 << 40 | frame, 0..1, &mut TraceAll(tracer.device()), None, &NEVER).unwrap();
    }
    renderer
}

fn main() {
    let given: Vec<usize> = std::env::args().skip(1).filter_map(|a| a.parse().ok()).collect();
    let value = |i: usize, default: usize| given.get(i).copied().unwrap_or(default);
    let (width, height) = (value(0, 1920), value(1, 1080));
    let shape = [value(2, 600), value(3, 192), value(4, 192)];

    let began = Instant::now();
    let gpu = Gpu::open(0, &GpuSettings::default()).unwrap_or_else(|why| panic!("nothing is measured: {why}"));
    let mut device = GpuRenderer::new(&gpu).unwrap();
    let opened = began.elapsed().as_secs_f64();

    let grid = Turbulence::grid(shape).unwrap();
    let turbulence = Turbulence::easy(shape, 0);
    let mut window: Window = turbulence.window(&grid, 12).unwrap();
    let next = Arc::new(turbulence.snapshot(12.0, &grid));
    let store = SnapshotStore::new(&gpu);
    let source = VelocitySource::Window(Arc::new(window.clone()));
    let began = Instant::now();
    drop(CudaTracer::new(&store, &gpu, source.clone(), &map(22), 0.0, Tuning::default()).unwrap());
    gpu.synchronize().unwrap();
    let ready = began.elapsed().as_secs_f64();

    println!("<!-- block frames -->");
    println!(
        "{width}x{height} pixels of {shape:?} nodes; device opened and rendering kernels ready after {opened:.2} s, window on the device and tracing"
    );
    println!("kernels ready after another {ready:.2} s.\n");
    println!(
        "| steps | ahead | frame (wall) | start | advance | sort and trace | film | waves | queries | traced ahead | traced, M/s | frames/s |"
    );
    println!("|---|---|---|---|---|---|---|---|---|---|---|---|");
    let mut frame_seconds = 0.0;
    for (steps, camera, shadow) in
        [(22, 1, 1), (22, 2, 4), (22, 4, 8), (22, 8, 8), (22, 2, 16), (22, 8, 32), (11, 4, 8), (44, 4, 8), (110, 4, 8)]
    {
        let tracer = CudaTracer::new(&store, &gpu, source.clone(), &map(steps), 0.0, Tuning::default()).unwrap();
        device = device.with_look_ahead(LookAhead { camera, shadow });
        let mut renderer = settled(&mut device, &tracer, scene(&tracer, width, height, 0));
        let mut frames: Vec<(f64, Timeline, u64)> = (0..9)
            .map(|frame| {
                let began = Instant::now();
                let (_, stats) = device.render_samples(&mut renderer, frame, 0..1, &mut TraceAll(tracer.device()), None, &NEVER).unwrap();
                (began.elapsed().as_secs_f64(), device.timeline(), stats.queries)
            })
            .collect();
        frames.sort_by(|a, b| a.0.total_cmp(&b.0));
        let (wall, t, queries) = frames[4];
        println!(
            "| {steps} | {camera}, {shadow} | {:.1} | {:.2} | {:.2} | {:.2} | {:.2} | {} | {} | {:.1} % | {:.0} | {:.1} |",
            1e3 * wall,
            1e3 * t.start,
            1e3 * t.advance,
            1e3 * t.answer,
            1e3 * t.film,
            t.waves,
            queries,
            100.0 * (t.points as f64 / queries as f64 - 1.0),
            1e-6 * t.points as f64 / t.answer,
            1.0 / wall
        );
        if (steps, camera) == (22, 4) {
            frame_seconds = wall;
        }
    }

    // A slide: uploads one more snapshot, adds it to the window, and renders a frame.
    let _ = window.push(next).unwrap();
    let tracer = CudaTracer::new(&store, &gpu, source, &map(22), 0.0, Tuning::default()).unwrap();
    device = device.with_look_ahead(LookAhead { camera: 4, shadow: 8 });
    let mut renderer = settled(&mut device, &tracer, scene(&tracer, width, height, 0));
    let before = gpu.memory().0;
    let began = Instant::now();
    let slid = CudaTracer::new(&store, &gpu, VelocitySource::Window(Arc::new(window)), &map(22), 1.0, Tuning::default()).unwrap();
    let seconds = began.elapsed().as_secs_f64();
    renderer.window_slid();
    device.render_samples(&mut renderer, 1, 0..1, &mut TraceAll(slid.device()), None, &NEVER).unwrap();
    println!(
        "\nA new snapshot, brought on the slide: {:.1} ms until the tracer of the slid window stands, {:.1} ms with the first frame on it (a frame: {:.1} ms); \
         memory {} MiB before, {} MiB after",
        1e3 * seconds,
        1e3 * began.elapsed().as_secs_f64(),
        1e3 * frame_seconds,
        before >> 20,
        gpu.memory().0 >> 20
    );
}
