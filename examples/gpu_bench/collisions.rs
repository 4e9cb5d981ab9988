//! Collision points that a frame's waves query.

use cudarc::driver::result;
use ridgewatch::backend::cuda::driver_error;
use ridgewatch::backend::cuda::{Buffer, CudaTracer, DeviceError, DeviceLogStretch, Gpu, GpuRenderer, TraceAll};
use ridgewatch::field::{DomainPoint, UnitPoint};
use ridgewatch::flow::Extras;
use ridgewatch::render::{RenderSettings, Renderer, Scene, TransferSettings};
use ridgewatch::surrogate::Trace;
use std::error::Error;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

static NEVER: AtomicBool = AtomicBool::new(false);
/// Picture size. Larger than a screen, to have enough points.
const PICTURE: [usize; 2] = [3840, 2160];

/// The first collision points of a reference frame, in the order in which its waves queue them.
pub struct Collisions {
    pub points: Buffer<[f32; 3]>,
    pub first_wave: usize,
    /// Number of waves of these points.
    pub waves: usize,
    pub picture: [usize; 2],
}

impl Collisions {
    /// At most `most` points of the default scene of a file of this field, after its majorants have settled.
    pub fn new(gpu: &Arc<Gpu>, tracer: &CudaTracer, most: usize) -> Result<Self, Box<dyn Error>> {
        let (domain, tau) = (tracer.host().domain(), tracer.host().tau());
        let at = |i: usize, n: usize| (i as f32 + 0.5) / n as f32;
        let unit = (0..64 * 64 * 16).map(|i| UnitPoint([at(i % 64, 64), at(i / 64 % 64, 64), at(i / 4096, 16)]));
        let seeds: Vec<DomainPoint> = unit.map(|u| domain.from_unit(u)).collect();
        let mut probes = ridgewatch::flow::Traced::default();
        tracer.trace(&seeds, Extras::default(), &mut probes)?;
        let ftle: Vec<f32> = probes.log_stretch.iter().map(|s| s / tau as f32).collect();
        let settings = RenderSettings { width: PICTURE[0], height: PICTURE[1], ..RenderSettings::default() };
        let transfer = TransferSettings::default().scaled_to(&ftle);
        let scene = Scene::assemble(domain, None, None, Some(transfer), settings, 0);
        let mut renderer = Renderer::new(scene, domain, tau)?;
        let mut device = GpuRenderer::new(gpu)?;
        for frame in 0..4 {
            device.render_samples(&mut renderer, frame, 0..1, &mut TraceAll(tracer.device()), None, &NEVER)?;
        }
        let mut heard = Listening { inner: TraceAll(tracer.device()), points: gpu.alloc("points", most)?, waves: Vec::new() };
        device.render_samples(&mut renderer, 4, 0..1, &mut heard, None, &NEVER)?;
        let mut points = heard.points;
        let found: usize = heard.waves.iter().sum();
        if found < most {
            let mut fewer = gpu.alloc("points", found)?;
            let mut held = vec![[0.0; 3]; found];
            points.read(&mut held)?;
            fewer.write(&held)?;
            points = fewer;
        }
        Ok(Self { points, first_wave: heard.waves.first().copied().unwrap_or(0), waves: heard.waves.len(), picture: PICTURE })
    }
}

/// Traces every query and copies its points until the buffer is full.
struct Listening<'a> {
    inner: TraceAll<'a>,
    points: Buffer<[f32; 3]>,
    /// Points copied of each wave.
    waves: Vec<usize>,
}

impl DeviceLogStretch for Listening<'_> {
    fn evaluate(&mut self, points: u64, count: usize, log_stretch: u64, by: u64) -> Result<(), DeviceError> {
        let filled: usize = self.waves.iter().sum();
        let part = count.min(self.points.len() - filled);
        if part > 0 {
            let gpu = self.inner.0.gpu();
            let to = self.points.address() + 12 * filled as u64;
            // SAFETY: the queue holds `count` points, and the buffer has room for `part` more.
            unsafe { result::memcpy_dtod_async(to, points, 12 * part, gpu.work().cu_stream()) }.map_err(driver_error("copying points"))?;
            self.waves.push(part);
        }
        self.inner.evaluate(points, count, log_stretch, by)
    }
}
