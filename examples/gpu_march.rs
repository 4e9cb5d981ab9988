//! Measures marched pictures of a traced table on a GPU: preparation, rays, and the combination with a correction. Prints a table; needs a GPU.
//! `-- WIDTH HEIGHT NX NY NZ` sets another picture or table.

#![allow(clippy::unwrap_used, clippy::print_stdout)] // a measurement, which may stop and prints

use ridgewatch::backend::cuda::{
    CombineInput, CudaTracer, DeviceError, DeviceNodes, DeviceTable, Filled, Gpu, GpuCombine, GpuMarch, GpuSettings, Medium, PinnedFilm,
    RayCheck, SnapshotStore, Tuning,
};
use ridgewatch::field::Window;
use ridgewatch::field::turbulence::Turbulence;
use ridgewatch::flow::{Boundary, Direction, FlowMap, Integrator, Interpolation, Normalisation, Precision, Steps, VelocitySource};
use ridgewatch::render::{Combine, LightSettings, RenderSettings, Renderer, Scene, TransferSettings};
use std::sync::Arc;

const TAU: f64 = 11.0;
/// Limit on the values of the light volume: 1 GiB.
const LIGHT_VALUES: usize = 1 << 28;

/// Median device time of a piece of work in milliseconds.
fn median(gpu: &Gpu, mut work: impl FnMut() -> Result<(), DeviceError>) -> f32 {
    let mut times: Vec<f32> = (0..9)
        .map(|_| {
            let began = gpu.mark().unwrap();
            work().unwrap();
            gpu.milliseconds(&began, &gpu.mark().unwrap()).unwrap()
        })
        .collect();
    times.sort_by(f32::total_cmp);
    times[times.len() / 2]
}

fn main() {
    let given: Vec<usize> = std::env::args().skip(1).filter_map(|a| a.parse().ok()).collect();
    let value = |i: usize, default: usize| given.get(i).copied().unwrap_or(default);
    let (width, height) = (value(0, 1920), value(1, 1080));
    let shape = [value(2, 600), value(3, 192), value(4, 192)];
    let gpu = Gpu::open(0, &GpuSettings::default()).unwrap_or_else(|why| panic!("nothing is measured: {why}"));
    let grid = Turbulence::grid(shape).unwrap();
    let window: Window = Turbulence::easy(shape, 0).window(&grid, 12).unwrap();
    let map = FlowMap {
        tau: TAU,
        direction: Direction::Forward,
        integrator: Integrator::Tangent,
        precision: Precision::F32,
        steps: Steps::Fixed(22),
        difference_step: 1e-4,
        boundary: Boundary::Clamp,
        normalisation: Normalisation::Tau,
        interpolation: Interpolation::Linear,
    };
    let store = SnapshotStore::new(&gpu);
    let tracer = CudaTracer::new(&store, &gpu, VelocitySource::Window(Arc::new(window)), &map, 0.0, Tuning::default()).unwrap();
    let domain = tracer.host().domain().clone();
    let table = DeviceTable::trace(tracer.device(), &domain, shape).unwrap();
    let ftle: Vec<f32> = table.values().unwrap().iter().step_by(97).map(|s| s / TAU as f32).collect();
    let nodes = DeviceNodes::new(&gpu).unwrap();
    let mut march = GpuMarch::new(&gpu).unwrap();
    let mut combine = GpuCombine::new(&gpu).unwrap();

    println!("{width}x{height} pixels, {shape:?} nodes on a {}; milliseconds of device time.\n", gpu.name());
    println!("| light | preparation | step, cells | 2 rays | 4 rays | 48 checks |");
    println!("|---|---|---|---|---|---|");
    let corner = std::array::from_fn(|k| domain.max[k] + 0.5 * domain.extent()[k]);
    for (name, light, values) in [
        ("default", None, LIGHT_VALUES),
        ("along -x", Some(LightSettings::directional([-1.0, -0.3, -0.2], 12.0)), LIGHT_VALUES),
        ("along +y", Some(LightSettings::directional([0.2, 1.0, -0.4], 12.0)), LIGHT_VALUES),
        ("point", Some(LightSettings { direction: None, position: Some(corner), radiance: [12.0; 3] }), 1 << 18),
    ] {
        let settings = RenderSettings { width, height, ..RenderSettings::default() };
        let transfer = TransferSettings::default().scaled_to(&ftle);
        let mut renderer = Renderer::new(Scene::assemble(&domain, None, light, Some(transfer), settings, 0), &domain, TAU).unwrap();
        let parameters = renderer.frame_setup(0, 0..1).unwrap().parameters;
        let medium = Medium { parameters: &parameters, nodes: nodes.grid(Some(&table)).unwrap(), missing_cells: None };
        let spacing = renderer.node_spacing(shape) as f32;
        let preparation = median(&gpu, || march.prepare(&renderer, &medium, values, 1));
        for cells in [1.0, 0.5] {
            let rays = [2, 4].map(|rays| {
                median(&gpu, || {
                    march.restart();
                    march.march(&medium, cells * spacing, rays, false)
                })
            });
            let pixel = |i: usize| (i * 7919 % (width * height)) as u32;
            let checks: Vec<RayCheck> = (0..48)
                .map(|i| RayCheck {
                    pixel: pixel(i / 4),
                    ray: i as u32 % 4,
                    step: 0.25 * cells * spacing,
                    shadow_step: 0.5 * cells * spacing,
                })
                .collect();
            let checked = median(&gpu, || march.check(&medium, &checks, false).map(drop));
            println!("| {name} | {preparation:.3} | {cells} | {:.3} | {:.3} | {checked:.3} |", rays[0], rays[1]);
        }
    }

    // Four pairs a pixel of a correction with noise.
    let pixels = width * height;
    let noise = |i: usize| ((i as u32).wrapping_mul(2_654_435_769) >> 8) as f32 / 16_777_216.0 - 0.5;
    let mut pairs: Vec<f32> = (0..12 * pixels).map(|i| 0.2 * noise(i) + 0.01).collect();
    pairs.extend(std::iter::repeat_n(2.0, 2 * pixels));
    pairs.extend(std::iter::repeat_n(0.0, 2 * pixels));
    let pairs = gpu.upload("pairs", &pairs).unwrap();
    println!("\n| correction | combination | error and film |");
    println!("|---|---|---|");
    for (name, how) in [("left out", None), ("shrunk", Some(Combine::Shrink)), ("summed", Some(Combine::Sum))] {
        let (mut finished, mut film) = (f32::INFINITY, PinnedFilm::new(&gpu, Filled::Combined, width, height));
        let combined = median(&gpu, || {
            let input = CombineInput { size: [width, height], pairs: &pairs, march: &march, how, tone_map: [1.85, 0.75, 1.4], lit: 0.01 };
            combine.combine(&input, None).map(drop)
        });
        for _ in 0..5 {
            let input = CombineInput { size: [width, height], pairs: &pairs, march: &march, how, tone_map: [1.85, 0.75, 1.4], lit: 0.01 };
            let tiles = combine.combine(&input, None).unwrap().len();
            let began = gpu.mark().unwrap();
            combine.finish(&vec![[1e-4; 2]; tiles], 1e-5, &mut film, false).unwrap();
            finished = finished.min(gpu.milliseconds(&began, &gpu.mark().unwrap()).unwrap());
        }
        println!("| {name} | {combined:.3} | {finished:.3} |");
    }
    println!("\nMemory in use: {} MiB.", gpu.memory().0 >> 20);
}
