//! What the renderer itself costs a query: answers are nearly free here.

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use ridgewatch::field::{Domain, DomainPoint};
use ridgewatch::render::{CameraSettings, LogStretch, RenderSettings, Renderer, Scene, TransferSettings};
use std::hint::black_box;
use std::sync::atomic::AtomicBool;

/// Ridges of a few cells' width.
struct Ridges;

impl LogStretch for Ridges {
    fn evaluate(&mut self, points: &[DomainPoint], log_stretch: &mut [f32], traced: &mut [bool]) {
        traced.fill(true);
        for (s, p) in log_stretch.iter_mut().zip(points) {
            let distance = (8.0 * p.0[0] + 3.0 * (5.0 * p.0[1]).fract()).fract() - 0.5;
            *s = 1.0 - 8.0 * distance.abs();
        }
    }
}

fn walking(c: &mut Criterion) {
    let mut group = c.benchmark_group("render");
    for (name, domain) in [("map", Domain::slab([0.0, 0.0], [2.0, 1.0], (0.0, 1.0))), ("volume", Domain::cuboid([0.0; 3], [2.0, 1.0, 1.0]))]
    {
        let settings = RenderSettings { width: 320, height: 160, ..RenderSettings::default() };
        let camera = CameraSettings {
            eye: [1.0, 0.5, 2.3],
            look_at: [1.0, 0.5, 0.5],
            up: [0.0, 1.0, 0.0],
            field_of_view: 90.0,
            orthographic: false,
        };
        let transfer = TransferSettings { low: Some(0.0), high: Some(1.0), extinction: Some(100.0), ..TransferSettings::default() };
        let scene = Scene::assemble(&domain, Some(camera), None, Some(transfer), settings, 1);
        let mut renderer = Renderer::new(scene, &domain, 1.0).expect("a valid scene");
        let never = AtomicBool::new(false);
        let mut frame = 0;
        let mut draw = |samples| {
            frame += 1;
            renderer.render(frame, &mut Ridges, samples, None, &never).expect("samples in range").1
        };
        // Majorants settle.
        (0..4).for_each(|_| _ = draw(16));
        let stats = draw(4);
        group.throughput(Throughput::Elements(stats.queries)).sample_size(10);
        eprintln!(
            "{name}: {:.2} M queries/s outside of evaluate, {:.2} queries a path, {} of {} above their majorant",
            stats.queries as f64 / stats.walk_seconds * 1e-6,
            stats.queries as f64 / stats.paths as f64,
            stats.majorant_exceeded,
            stats.queries
        );
        group.bench_function(name, |b| b.iter(|| black_box(draw(4))));
    }
    group.finish();
}

criterion_group!(benches, walking);
criterion_main!(benches);
