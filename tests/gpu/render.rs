//! Rendering on the GPU against rendering on the CPU: the same picture from the same answers, whatever the schedule.

use crate::scenes::{gpu, opened, store, turbulence};
use ridgewatch::backend::cuda::driver_error;
use ridgewatch::backend::cuda::{CudaTracer, DeviceError, DeviceLogStretch, Gpu, GpuRenderer, GpuSettings, LookAhead, TraceAll, Tuning};
use ridgewatch::field::analytic::Analytic;
use ridgewatch::field::{Domain, DomainPoint};
use ridgewatch::flow::{
    Boundary, Direction, Extras, FlowMap, Integrator, Interpolation, Normalisation, Precision, Steps, Tracer, VelocitySource, cpu_tracer,
};
use ridgewatch::publish::compare_films;
use ridgewatch::render::{CameraSettings, Film, LightSettings, LogStretch, RenderSettings, RenderStats, Renderer, Scene, TransferSettings};
use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

static NEVER: AtomicBool = AtomicBool::new(false);

/// Something cheap with structure, some of it missing, some traced.
pub fn waves(p: [f32; 3]) -> (f32, bool) {
    let value = (7.0 * p[0] + 3.0 * p[2]).sin() * (9.0 * p[1]).cos();
    (if p[0] > 1.8 && p[1] < 0.3 { f32::NAN } else { value }, p[1] > 0.5)
}

pub struct OnHost;

impl LogStretch for OnHost {
    fn evaluate(&mut self, points: &[DomainPoint], log_stretch: &mut [f32], traced: &mut [bool]) {
        for (i, p) in points.iter().enumerate() {
            (log_stretch[i], traced[i]) = waves(p.0);
        }
    }
}

/// Answers device points on the host: the very same answers, so that what differs is tracking.
pub struct ThroughHost<'a>(pub &'a Gpu);

impl DeviceLogStretch for ThroughHost<'_> {
    fn evaluate(&mut self, points: u64, count: usize, log_stretch: u64, by: u64) -> Result<(), DeviceError> {
        use cudarc::driver::result;
        let doing = driver_error("answering on the host");
        let stream = self.0.work().cu_stream();
        let mut host = vec![[0.0_f32; 3]; count];
        // SAFETY: the renderer says that as many values lie there.
        unsafe { result::memcpy_dtoh_async(&mut host, points, stream) }.map_err(&doing)?;
        self.0.synchronize()?;
        let answers: Vec<(f32, bool)> = host.iter().map(|&p| waves(p)).collect();
        let values: Vec<f32> = answers.iter().map(|a| a.0).collect();
        let flags: Vec<u8> = answers.iter().map(|a| u8::from(a.1)).collect();
        // SAFETY: as above; the host arrays outlive the synchronisation.
        unsafe {
            result::memcpy_htod_async(log_stretch, &values, stream).map_err(&doing)?;
            result::memcpy_htod_async(by, &flags, stream).map_err(&doing)?;
        }
        self.0.synchronize()
    }
}

pub fn domain() -> Domain {
    Domain::cuboid([0.0; 3], [2.0, 1.0, 1.0])
}

pub fn scene(width: usize, height: usize, point_light: bool) -> Scene {
    let settings = RenderSettings { width, height, ..RenderSettings::default() };
    let camera =
        CameraSettings { eye: [1.1, 0.4, 2.3], look_at: [1.0, 0.5, 0.5], up: [0.1, 1.0, 0.0], field_of_view: 90.0, orthographic: false };
    let light = if point_light {
        LightSettings { direction: None, position: Some([0.3, 2.0, 1.7]), radiance: [8.0, 9.0, 10.0] }
    } else {
        LightSettings { direction: Some([-1.0, -1.0, -1.0]), position: None, radiance: [12.0; 3] }
    };
    let transfer = TransferSettings { low: Some(0.2), high: Some(0.9), extinction: Some(20.0), ..TransferSettings::default() };
    Scene::assemble(&domain(), Some(camera), Some(light), Some(transfer), settings, 1)
}

fn on_gpu(device: &mut GpuRenderer, gpu: &Gpu, renderer: &mut Renderer, frame: u64, samples: Range<u32>) -> (Film, RenderStats) {
    // What a kernel reads before it has written it would show.
    device.poison().unwrap();
    let (film, stats) = device.render_samples(renderer, frame, samples, &mut ThroughHost(gpu), None, &NEVER).unwrap();
    (Arc::unwrap_or_clone(film), stats)
}

/// Films hold NaN where nothing was hit, so bits are compared.
fn bits(film: &Film) -> Vec<u32> {
    let rgba = film.rgba.iter().flatten();
    let rest = [&film.ftle_mean, &film.traced, &film.variance, &film.samples, &film.missing, &film.queries];
    rgba.chain(rest.into_iter().flatten()).map(|v| v.to_bits()).collect()
}

#[test]
#[ignore = "needs a GPU"]
fn the_same_answers_give_the_cpu_s_picture() {
    let gpu = gpu();
    for point_light in [false, true] {
        let scene = scene(120, 80, point_light);
        let tone_map = scene.settings.tone_map;
        let mut cpu = Renderer::new(scene.clone(), &domain(), 1.0).unwrap();
        let mut renderer = Renderer::new(scene, &domain(), 1.0).unwrap();
        let mut device = GpuRenderer::new(&gpu).unwrap();
        // The third frame walks with tight majorants.
        for (frame, samples) in [(0, 0..2), (1, 3..11), (2, 0..64)] {
            let (expected, cpu_stats) = cpu.render_samples(frame, samples.clone(), &mut OnHost, None, &NEVER).unwrap();
            let (found, stats) = on_gpu(&mut device, &gpu, &mut renderer, frame, samples.clone());
            assert_eq!((stats.paths, &found.samples), (cpu_stats.paths, &expected.samples));
            let psnr = compare_films(&found, &expected, tone_map).unwrap().psnr.unwrap_or(f64::INFINITY);
            let light = if point_light { "point light" } else { "directional light" };
            measured!(
                "answers alike, {light}, {} samples: {psnr:.1} dB, {} and {} queries",
                samples.len(),
                stats.queries,
                cpu_stats.queries
            );
            println!("{:?}", device.timeline());
            // Rounding moves a collision by some 1e-7 of the box, which turns a decision about once in 1e5.
            assert!(psnr > 55.0, "frame {frame}: {psnr} dB");
            for (found, expected) in [
                (stats.queries, cpu_stats.queries),
                (stats.traced, cpu_stats.traced),
                (stats.missing, cpu_stats.missing),
                (stats.majorant_exceeded, cpu_stats.majorant_exceeded),
            ] {
                assert!((found as f64 - expected as f64).abs() <= 2.0 + 1e-3 * expected as f64, "frame {frame}: {found} for {expected}");
            }
            let near = |a: f32, b: f32| (a.is_nan() && b.is_nan()) || (a - b).abs() <= 0.02 * (1.0 + b.abs());
            let odd = (0..found.rgba.len())
                .filter(|&i| !near(found.variance[i], expected.variance[i]) || !near(found.ftle_mean[i], expected.ftle_mean[i]))
                .count();
            assert!(odd * 100 <= found.rgba.len(), "{odd} pixels of {} differ in variance or FTLE", found.rgba.len());
        }
    }
}

fn map(tau: f64, steps: usize, boundary: Boundary) -> FlowMap {
    FlowMap {
        tau,
        direction: Direction::Forward,
        integrator: Integrator::Tangent,
        precision: Precision::F32,
        steps: Steps::Fixed(steps),
        difference_step: 1e-4,
        boundary,
        normalisation: Normalisation::Tau,
        interpolation: Interpolation::Linear,
    }
}

/// The CPU's tracer as the renderer asks it.
struct ByCpu(Box<dyn Tracer>);

impl LogStretch for ByCpu {
    fn evaluate(&mut self, points: &[DomainPoint], log_stretch: &mut [f32], traced: &mut [bool]) {
        let mut out = ridgewatch::flow::Traced::default();
        self.0.trace(points, Extras::default(), &mut out);
        log_stretch.copy_from_slice(&out.log_stretch);
        traced.fill(true);
    }
}

/// Traced pictures of the same seed; `psnr` in dB is what they must reach.
fn traced_pictures_agree(name: &str, source: VelocitySource, map: &FlowMap, scene: Scene, samples: u32, least: f64) {
    let gpu = gpu();
    let host = cpu_tracer(source.clone(), map, 0.0).unwrap();
    let domain = host.domain().clone();
    let mut by_cpu = ByCpu(host);
    let tracer = CudaTracer::new(store(), &gpu, source, map, 0.0, Tuning::default()).unwrap();
    let tone_map = scene.settings.tone_map;
    let mut cpu = Renderer::new(scene.clone(), &domain, map.tau).unwrap();
    let mut renderer = Renderer::new(scene, &domain, map.tau).unwrap();
    let mut device = GpuRenderer::new(&gpu).unwrap();
    for (frame, samples) in [(0, 0..1), (1, 0..samples)] {
        let (expected, cpu_stats) = cpu.render_samples(frame, samples.clone(), &mut by_cpu, None, &NEVER).unwrap();
        device.poison().unwrap();
        let (found, stats) =
            device.render_samples(&mut renderer, frame, samples.clone(), &mut TraceAll(tracer.device()), None, &NEVER).unwrap();
        let comparison = compare_films(&found, &expected, tone_map).unwrap();
        let psnr = comparison.psnr.unwrap_or(f64::INFINITY);
        measured!("traced, {name}, {} samples: {psnr:.1} dB, {} and {} queries", samples.end, stats.queries, cpu_stats.queries);
        assert_eq!((stats.paths, stats.traced), (cpu_stats.paths, stats.queries));
        // Unbiased counts: decisions that rounding turns go either way.
        assert!((stats.queries as f64 / cpu_stats.queries as f64 - 1.0).abs() < 2e-3, "{} for {}", stats.queries, cpu_stats.queries);
        assert!(samples.end == 1 || psnr >= least, "{psnr} dB");
    }
}

#[test]
#[ignore = "needs a GPU"]
fn the_double_gyre_is_the_cpu_s_picture_to_50_db() {
    let flow = Analytic::DoubleGyre { amplitude: 0.1, epsilon: 0.25, omega: 0.2 * std::f64::consts::PI };
    let domain = Domain::slab([0.0, 0.0], [2.0, 1.0], (0.0, 1.0));
    let settings = RenderSettings { width: 320, height: 160, ..RenderSettings::default() };
    let camera =
        CameraSettings { eye: [1.0, 0.5, 2.3], look_at: [1.0, 0.5, 0.5], up: [0.0, 1.0, 0.0], field_of_view: 90.0, orthographic: false };
    let light = LightSettings { direction: Some([-1.0, -1.0, -1.0]), position: None, radiance: [12.0; 3] };
    let transfer = TransferSettings { low: Some(0.05), high: Some(0.45), extinction: Some(60.0), ..TransferSettings::default() };
    let scene = Scene::assemble(&domain, Some(camera), Some(light), Some(transfer), settings, 3);
    // Answers that differ in their last places turn a decision now and then: more than the 55 dB of equal answers, fewer than 50 allow.
    traced_pictures_agree("double gyre", VelocitySource::Analytic(flow, domain), &map(10.0, 100, Boundary::Unbounded), scene, 64, 50.0);
}

#[test]
#[ignore = "needs a GPU"]
fn turbulence_is_the_cpu_s_picture() {
    let source = turbulence([96, 48, 48], 12);
    let domain = crate::scenes::domain(&source);
    let settings = RenderSettings { width: 160, height: 80, ..RenderSettings::default() };
    let transfer = TransferSettings { low: Some(0.1), high: Some(0.3), ..TransferSettings::default() };
    let scene = Scene::assemble(&domain, None, None, Some(transfer), settings, 3);
    // Sums of f32 over 22 steps differ by some 1e-5 of the log-stretch: fewer turned decisions than 50 dB allow.
    traced_pictures_agree("turbulence", source, &map(11.0, 22, Boundary::Clamp), scene, 64, 50.0);
}

#[test]
#[ignore = "needs a GPU"]
fn schedule_and_memory_leave_every_bit_alone() {
    let gpu = gpu();
    let render = |device: GpuRenderer| {
        let mut device = device;
        let mut renderer = Renderer::new(scene(200, 90, false), &domain(), 1.0).unwrap();
        (0..3).map(|frame| bits(&on_gpu(&mut device, &gpu, &mut renderer, frame, 0..5).0)).collect::<Vec<_>>()
    };
    let reference = render(GpuRenderer::new(&gpu).unwrap());
    assert!(reference[0] != reference[1], "frames draw different numbers");
    assert!(render(GpuRenderer::new(&gpu).unwrap()) == reference, "a second run");
    for (camera, shadow) in [(1, 1), (1, 16), (7, 2)] {
        let device = GpuRenderer::new(&gpu).unwrap().with_look_ahead(LookAhead { camera, shadow });
        assert!(render(device) == reference, "looking {camera} and {shadow} ahead");
    }
    for memory in [4 << 20, 8 << 20] {
        assert!(render(GpuRenderer::new(&gpu).unwrap().with_memory(memory)) == reference, "{memory} bytes");
    }
    // What was left when rendering began is others' by the first frame.
    let capped = opened(GpuSettings { memory_cap: Some(64 << 20), ..GpuSettings::default() });
    let mut device = GpuRenderer::new(&capped).unwrap();
    let others = capped.alloc::<u8>("what others have", 48 << 20).unwrap();
    let mut renderer = Renderer::new(scene(200, 90, false), &domain(), 1.0).unwrap();
    assert!(bits(&on_gpu(&mut device, &capped, &mut renderer, 0, 0..5).0) == reference[0], "in what others left");
    drop(others);
}

#[test]
#[ignore = "needs a GPU"]
fn memory_is_flat_over_a_thousand_frames() {
    // A handle of its own, so that no other test's memory counts.
    let gpu = opened(GpuSettings::default());
    let mut renderer = Renderer::new(scene(32, 16, false), &domain(), 1.0).unwrap();
    let mut device = GpuRenderer::new(&gpu).unwrap();
    let free = || gpu.context().mem_get_info().unwrap().0;
    let mut after_first = (0, 0);
    for frame in 0..1000 {
        device.render_samples(&mut renderer, frame, 0..1 + frame as u32 % 3, &mut ThroughHost(&gpu), None, &NEVER).unwrap();
        if frame == 9 {
            after_first = (gpu.memory().0, free());
        }
    }
    assert_eq!(gpu.memory().0, after_first.0);
    // The driver may keep a little for itself.
    assert!(free() + (4 << 20) >= after_first.1, "{} of {} bytes are left", free(), after_first.1);
}

#[test]
#[ignore = "needs a GPU"]
fn a_stopped_frame_has_no_half_finished_pixels() {
    let gpu = gpu();
    let mut renderer = Renderer::new(scene(64, 32, false), &domain(), 1.0).unwrap();
    let mut device = GpuRenderer::new(&gpu).unwrap();
    let (film, stats) = device.render_samples(&mut renderer, 0, 0..100, &mut ThroughHost(&gpu), None, &AtomicBool::new(true)).unwrap();
    assert!(stats.stopped && film.samples.iter().all(|n| *n == 0.0));
}
