//! Frames that a surrogate answers where it is trusted, and scenes with land: walked, predicted and traced on the GPU, against the CPU.

use crate::scenes::{cartesian, device, even, frames, gpu, opened, smooth, store, turbulence, warnings};
use ridgewatch::backend::cuda::{
    CudaTracer, DeviceError, DeviceLearns, DevicePredict, DeviceQueryRouter, DeviceTable, FrameQueries, Gpu, GpuRenderer, GpuSettings,
    LookAhead, Outputs, SnapshotStore, Tuning,
};
use ridgewatch::backend::{Device, QueryRouter, Routing, Tally, audit, keeps_label, residuals, stratified_points};
use ridgewatch::field::{Domain, DomainPoint, UnitPoint};
use ridgewatch::flow::{
    Boundary, Direction, Extras, FlowMap, Integrator, Interpolation, Normalisation, Precision, Steps, Tracer, VelocitySource, cpu_tracer,
};
use ridgewatch::publish::compare_films;
use ridgewatch::render::{Film, RenderSettings, RenderStats, Renderer, Scene, TransferSettings};
use ridgewatch::run::RunOptions;
use ridgewatch::surrogate::network::NetworkSettings;
use ridgewatch::surrogate::{HostSurrogate, Kind, Predict, Samples, SurrogateSettings, Trace, build};
use ridgewatch::trust::{Audited, Gate, Strata, TrustMap, TrustSettings};
use std::cell::RefCell;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

static NEVER: AtomicBool = AtomicBool::new(false);

fn map(tau: f64, steps: usize) -> FlowMap {
    FlowMap {
        tau,
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

/// One flow on both sides, with its picture.
struct Stage {
    gpu: Arc<Gpu>,
    host: Box<dyn Tracer>,
    cuda: CudaTracer,
    scene: Scene,
    table: HostSurrogate,
    on_device: DeviceTable,
    gate: Gate,
}

fn table_of(host: &dyn Trace, nodes: [usize; 3]) -> HostSurrogate {
    let settings = SurrogateSettings { kind: Kind::Table, table_nodes: Some(nodes), ..SurrogateSettings::default() };
    build(&settings, &NetworkSettings::default(), host.flow().domain(), 5, host).unwrap()
}

impl Stage {
    fn new(
        gpu: Arc<Gpu>,
        store: &SnapshotStore,
        source: VelocitySource,
        map: &FlowMap,
        transfer: TransferSettings,
        nodes: [usize; 3],
    ) -> Self {
        let host = cpu_tracer(source.clone(), map, 0.0).unwrap();
        let cuda = CudaTracer::new(store, &gpu, source, map, 0.0, Tuning::default()).unwrap();
        let settings = RenderSettings { width: 160, height: 80, ..RenderSettings::default() };
        let scene = Scene::assemble(host.domain(), None, None, Some(transfer), settings, 3);
        let table = table_of(&host, nodes);
        let on_device = DeviceTable::upload(&gpu, host.domain(), table.table().unwrap()).unwrap();
        // A gate as runs earn it, probes held against the table, at the first tolerance that trusts a third of the cells.
        let trust = |tolerance: f64| TrustMap::new(&TrustSettings { tolerance, ..TrustSettings::default() }, host.domain());
        let strata = Strata::even(trust(0.03).shape(), 32);
        let probes = audit::trace(&host, &stratified_points(&strata, 5, 0), Extras::default()).unwrap();
        let renderer = Renderer::new(scene.clone(), host.domain(), map.tau).unwrap();
        let measured = residuals(&table.freeze().unwrap(), &probes.samples, renderer.transfer(), map.tau).unwrap();
        let gate = |i: i32| {
            let mut trust = trust(0.03 * 1.1_f64.powi(i));
            trust.observe(Some(&Audited::of(&measured, strata.clone())), &[]);
            trust.gate()
        };
        let gate = (0..40).map(gate).find(|gate| gate.share() > 0.33).unwrap();
        Self { gpu, host, cuda, scene, table, on_device, gate }
    }

    fn domain(&self) -> &Domain {
        self.host.domain()
    }

    fn renderer(&self) -> Renderer {
        Renderer::new(self.scene.clone(), self.domain(), self.host.tau()).unwrap()
    }

    fn on_cpu(&self, renderer: &mut Renderer, frame: u64, samples: u32, how: &How<'_>) -> (Film, RenderStats, Tally) {
        let frozen = self.table.freeze().unwrap();
        let surrogate = how.surrogate.then_some(&frozen as &dyn Predict);
        let routing = Routing { gate: &self.gate, trace_budget: how.budget, keep: 0, extras: Extras::default() };
        let mut router = QueryRouter::new(&self.host, surrogate, routing);
        let (film, stats) = renderer.render_samples(frame, 0..samples, &mut router, None, &NEVER).unwrap();
        let (tally, _) = router.finish().unwrap();
        (film, stats, tally)
    }

    fn on_gpu(
        &self,
        side: &mut Side,
        renderer: &mut Renderer,
        frame: u64,
        samples: u32,
        how: &How<'_>,
    ) -> (Film, RenderStats, Tally, Samples) {
        // What a kernel reads before it has written it would show.
        side.renderer.poison().unwrap();
        side.router.poison().unwrap();
        let mut routed = side
            .router
            .begin(FrameQueries {
                tracer: self.cuda.device(),
                domain: self.domain(),
                missing_cells: self.cuda.missing_cells(),
                surrogate: how.surrogate.then_some(&self.on_device as &dyn DevicePredict),
                label_sink: how.label_sink,
                gate: &self.gate,
                trace_budget: how.budget,
                keep: how.keep,
                extras: Extras { arrival: how.label_sink.is_some(), jacobian: how.label_sink.is_some() },
            })
            .unwrap();
        let (film, stats) = side.renderer.render_samples(renderer, frame, 0..samples, &mut routed, None, &NEVER).unwrap();
        let film = Arc::unwrap_or_clone(film);
        let labels = routed.labels();
        assert!(routed.trace_seconds() >= 0.0 && routed.predict_seconds() > 0.0);
        let tally = Tally {
            queries: stats.queries,
            traced: stats.traced,
            missing: stats.missing,
            over_budget: side.renderer.over_budget(),
            trace_seconds: routed.trace_seconds(),
            predict_seconds: routed.predict_seconds(),
            ..Tally::default()
        };
        (film, stats, tally, labels)
    }
}

/// What the GPU keeps from frame to frame.
struct Side {
    renderer: GpuRenderer,
    router: DeviceQueryRouter,
}

impl Side {
    fn new(gpu: &Arc<Gpu>) -> Self {
        Self { renderer: GpuRenderer::new(gpu).unwrap(), router: DeviceQueryRouter::new(gpu).unwrap() }
    }
}

struct How<'a> {
    surrogate: bool,
    budget: Option<f64>,
    keep: usize,
    label_sink: Option<&'a dyn DeviceLearns>,
}

const GATED: How<'static> = How { surrogate: true, budget: None, keep: 0, label_sink: None };

fn turbulent() -> Stage {
    turbulent_on(gpu(), store())
}

fn turbulent_on(gpu: Arc<Gpu>, store: &SnapshotStore) -> Stage {
    let transfer = TransferSettings { low: Some(0.1), high: Some(0.3), ..TransferSettings::default() };
    Stage::new(gpu, store, turbulence([96, 48, 48], 12), &map(11.0, 22), transfer, [96, 48, 48])
}

fn near(found: u64, expected: u64, what: &str) {
    // Decisions that rounding turns go either way.
    assert!((found as f64 - expected as f64).abs() <= 5.0 + 2e-3 * expected as f64, "{what}: {found} for {expected}");
}

/// Frames of the same seed to 50 dB, and the same counts; the second one walks with majorants that the first has tightened.
fn pictures_agree(stage: &Stage, how: &How<'_>, name: &str) -> Tally {
    let (mut cpu, mut renderer, mut side) = (stage.renderer(), stage.renderer(), Side::new(&stage.gpu));
    let mut last = Tally::default();
    for (frame, samples) in [(0, 1), (1, 64)] {
        let (expected, cpu_stats, cpu_tally) = stage.on_cpu(&mut cpu, frame, samples, how);
        let (found, stats, tally, _) = stage.on_gpu(&mut side, &mut renderer, frame, samples, how);
        let psnr = compare_films(&found, &expected, stage.scene.settings.tone_map).unwrap().psnr.unwrap_or(f64::INFINITY);
        measured!("{name}, {samples} samples: {psnr:.1} dB, {} and {} queries", tally.queries, cpu_tally.queries);
        println!("CPU {cpu_tally:?}; GPU {tally:?}; {:?}", side.renderer.timeline());
        assert_eq!(stats.paths, cpu_stats.paths);
        near(tally.queries, cpu_tally.queries, "queries");
        near(tally.traced, cpu_tally.traced, "traced");
        near(tally.missing, cpu_tally.missing, "missing");
        near(tally.over_budget, cpu_tally.over_budget, "over budget");
        // The layer is the records' figure pixel by pixel.
        let by_pixel: f64 = found.traced.iter().zip(&found.queries).map(|(&share, &n)| f64::from(share) * f64::from(n)).sum();
        assert!((by_pixel - stats.traced as f64).abs() <= 1.0 + 1e-6 * stats.traced as f64, "{by_pixel} traced in the film");
        assert!(samples == 1 || psnr >= 50.0, "{name}: {psnr} dB");
        last = tally;
    }
    last
}

#[test]
#[ignore = "needs a GPU"]
fn gated_frames_are_the_cpu_s_pictures_to_50_db() {
    let stage = turbulent();
    let share = stage.gate.share();
    assert!(share < 0.7, "some cells are not trusted: {share}");
    let tally = pictures_agree(&stage, &GATED, "gated");
    assert!(tally.traced > tally.queries / 50 && tally.traced < tally.queries * 49 / 50 && tally.over_budget == 0);
    // Nothing left of the budget from the first wave on.
    let tally = pictures_agree(&stage, &How { budget: Some(0.0), ..GATED }, "over budget");
    assert!(tally.traced == 0 && tally.over_budget > tally.queries / 50);
    let trusting = Stage { gate: Gate::uniform(true), ..stage };
    let tally = pictures_agree(&trusting, &GATED, "surrogate");
    assert_eq!((tally.traced, tally.over_budget), (0, 0));
}

#[test]
#[ignore = "needs a GPU"]
fn a_budget_ends_tracing_in_the_course_of_a_frame() {
    let stage = turbulent();
    let mut side = Side::new(&stage.gpu);
    // Other tests may use the device at the same time: the shortest of a few frames has least of them in it.
    let mut whole = Tally { trace_seconds: f64::INFINITY, ..Tally::default() };
    for _ in 0..5 {
        let (.., tally, _) = stage.on_gpu(&mut side, &mut stage.renderer(), 0, 8, &GATED);
        whole = if tally.trace_seconds < whole.trace_seconds { tally } else { whole };
    }
    let half = How { budget: Some(0.5 * whole.trace_seconds), ..GATED };
    let mut renderer = stage.renderer();
    let (.., tally, _) = stage.on_gpu(&mut side, &mut renderer, 0, 8, &half);
    assert!(tally.traced > 0 && tally.over_budget > 0, "{tally:?}, without a budget {whole:?}");
    assert!(tally.traced < whole.traced, "{tally:?}, without a budget {whole:?}");
}

#[test]
#[ignore = "needs a GPU"]
fn pictures_with_land_are_the_cpu_s() {
    // A corner is missing from the third snapshot on; seeds start at the last one.
    let source = smooth(&cartesian(even(&[40, 30, 20])), 0.6, true);
    let backward = FlowMap { direction: Direction::Backward, ..map(3.0, 12) };
    let transfer = TransferSettings { low: Some(0.1), high: Some(0.6), ..TransferSettings::default() };
    let gpu = gpu();
    let host = cpu_tracer(source.clone(), &backward, 3.5).unwrap();
    let cuda = CudaTracer::new(store(), &gpu, source, &backward, 3.5, Tuning::default()).unwrap();
    assert!(cuda.missing_cells().is_some());
    let settings = RenderSettings { width: 160, height: 80, ..RenderSettings::default() };
    let scene = Scene::assemble(host.domain(), None, None, Some(transfer), settings, 3);
    let table = table_of(&host, [40, 30, 20]);
    let on_device = DeviceTable::upload(&gpu, host.domain(), table.table().unwrap()).unwrap();
    let mut stage = Stage { gpu, host, cuda, scene, table, on_device, gate: Gate::uniform(false) };
    let tally = pictures_agree(&stage, &How { surrogate: false, ..GATED }, "reference with land");
    assert!(tally.missing > tally.queries / 100 && tally.traced + tally.missing == tally.queries, "{tally:?}");
    stage.gate = Gate::uniform(true);
    let tally = pictures_agree(&stage, &GATED, "surrogate with land");
    assert!(tally.missing > tally.queries / 100 && tally.traced == 0, "{tally:?}");
}

#[test]
#[ignore = "needs a GPU"]
fn labels_are_what_was_traced_an_even_share_of_it_and_the_same_in_every_run() {
    let stage = turbulent();
    for keep in [300_000, 4000] {
        let how = How { keep, ..GATED };
        let labels = |look_ahead: LookAhead| {
            let mut side = Side::new(&stage.gpu);
            side.renderer = side.renderer.with_look_ahead(look_ahead);
            let (_, _, tally, labels) = stage.on_gpu(&mut side, &mut stage.renderer(), 0, 16, &how);
            (tally, labels)
        };
        let (tally, first) = labels(LookAhead { camera: 4, shadow: 8 });
        let (_, second) = labels(LookAhead { camera: 4, shadow: 8 });
        assert!(first.points == second.points && first.log_stretch == second.log_stretch, "the same in every run");
        println!("{} of {} traced are kept where {keep} may be", first.len(), tally.traced);
        assert!(first.len() < keep && (first.len() > keep / 4 || first.len() as u64 >= tally.traced), "{} for {keep}", first.len());
        // They lie where nothing is trusted, and hold what the CPU traces there.
        assert!(first.points.iter().all(|&p| !stage.gate.trusts(p)));
        let points: Vec<DomainPoint> = first.points.iter().map(|&p| stage.domain().from_unit(p)).collect();
        let mut exact = ridgewatch::flow::Traced::default();
        Trace::trace(&stage.host, &points, Extras::default(), &mut exact).unwrap();
        let mut errors: Vec<f32> = exact.log_stretch.iter().zip(&first.log_stretch).map(|(a, b)| (a - b).abs()).collect();
        errors.sort_by(f32::total_cmp);
        // Unit coordinates round the seed, by 1e-7 of a domain of 96 cells: 1e-5 of a cell, stretched by up to e^4.
        let most = errors[errors.len() * 98 / 100];
        assert!(most < 5e-3, "{most}");
    }
    // Without look-ahead, labels are of queries alone: as many as were traced, if all may be kept.
    let mut side = Side::new(&stage.gpu);
    side.renderer = side.renderer.with_look_ahead(LookAhead { camera: 1, shadow: 1 });
    let (_, _, tally, labels) = stage.on_gpu(&mut side, &mut stage.renderer(), 0, 1, &How { keep: 1 << 21, ..GATED });
    assert_eq!(labels.len() as u64, tally.traced);
}

/// Keeps what it is told to learn from.
struct Heard(RefCell<Vec<(DomainPoint, f32, DomainPoint, [f32; 9])>>);

impl DeviceLearns for Heard {
    unsafe fn learn_from(&self, points: u64, traced: &Outputs, count: usize) -> Result<(), DeviceError> {
        let (mut at, mut values, mut arrivals) =
            (vec![DomainPoint::default(); count], vec![0.0_f32; count], vec![DomainPoint::default(); count]);
        let mut jacobians = vec![[0.0_f32; 9]; count];
        gpu().synchronize()?;
        // SAFETY: the caller's; the work that wrote them is done.
        unsafe {
            cudarc::driver::result::memcpy_dtoh_sync(bytemuck::cast_slice_mut::<_, f32>(&mut at), points).unwrap();
            cudarc::driver::result::memcpy_dtoh_sync(&mut values, traced.log_stretch).unwrap();
            cudarc::driver::result::memcpy_dtoh_sync(bytemuck::cast_slice_mut::<_, f32>(&mut arrivals), traced.arrival).unwrap();
            cudarc::driver::result::memcpy_dtoh_sync(&mut jacobians, traced.jacobian).unwrap();
        }
        let labels = at.into_iter().zip(values).zip(arrivals).zip(jacobians);
        self.0.borrow_mut().extend(labels.map(|(((at, value), arrival), jacobian)| (at, value, arrival, jacobian)));
        Ok(())
    }
}

/// Everything that is traced is learned from where it lies, but for the eighth part that comes back instead.
#[test]
#[ignore = "needs a GPU"]
fn what_stays_on_the_device_is_what_was_traced() {
    let stage = turbulent();
    let mut side = Side::new(&stage.gpu);
    side.renderer = side.renderer.with_look_ahead(LookAhead { camera: 1, shadow: 1 });
    let heard = Heard(RefCell::default());
    let how = How { keep: 1 << 21, label_sink: Some(&heard), ..GATED };
    let (_, _, tally, labels) = stage.on_gpu(&mut side, &mut stage.renderer(), 0, 1, &how);
    let heard = heard.0.into_inner();
    assert_eq!(heard.len() as u64, tally.traced);
    // As traced on the host: in the unit coordinates of labels, which do not end at the domain's edges.
    let domain = stage.domain();
    let bits = |point: UnitPoint, value: f32, arrival: UnitPoint, jacobian: [f32; 9]| {
        (point.0.map(f32::to_bits), value.to_bits(), arrival.0.map(f32::to_bits), jacobian.map(f32::to_bits))
    };
    let extent = domain.extent();
    let in_units = |jacobian: [f32; 9]| std::array::from_fn(|e| (f64::from(jacobian[e]) * extent[e % 3] / extent[e / 3]) as f32);
    let mut held_back: Vec<_> = (heard.iter().filter(|(point, ..)| keeps_label(*point, 3)))
        .map(|&(point, value, there, jacobian)| bits(domain.to_unit(point), value, domain.to_unit_unclamped(there), in_units(jacobian)))
        .collect();
    let mut back: Vec<_> = (labels.points.iter().zip(&labels.log_stretch).zip(&labels.arrival).zip(&labels.jacobian))
        .map(|(((&point, &value), &arrival), &jacobian)| bits(point, value, arrival, jacobian))
        .collect();
    held_back.sort_unstable();
    back.sort_unstable();
    assert!(back.len() > 100 && back == held_back, "{} came back, {} were held back", back.len(), held_back.len());
}

#[test]
#[ignore = "needs a GPU"]
fn memory_is_flat_over_gated_frames() {
    // A handle of its own, so that no other test's memory counts.
    let gpu = opened(GpuSettings::default());
    let store = SnapshotStore::new(&gpu);
    let stage = turbulent_on(gpu, &store);
    let (mut renderer, mut side) = (stage.renderer(), Side::new(&stage.gpu));
    let how = How { keep: 1000, ..GATED };
    let mut after_first = 0;
    for frame in 0..200 {
        stage.on_gpu(&mut side, &mut renderer, frame, 1, &how);
        if frame == 9 {
            after_first = stage.gpu.memory().0;
        }
    }
    assert_eq!(stage.gpu.memory().0, after_first);
}

/// A small run.
const RUN: &str = "
[source]
kind = \"turbulence\"
nodes = [64, 32, 32]
[time]
tau = 8
slides = 2
frames_per_slide = 3
[flow]
steps = 16
[surrogate]
kind = \"table\"
[render]
width = 160
height = 80
samples = 8
";

#[test]
#[ignore = "needs a GPU"]
fn a_run_walks_on_the_device_and_records_what_the_cpu_s_would() {
    for method in ["reference", "gated", "surrogate"] {
        let made = |device: Device| frames(RUN, &[format!("render.method=\"{method}\"")], &RunOptions { device, ..RunOptions::default() });
        let (found, expected) = (made(device(GpuSettings::default())), made(Device::CPU));
        assert_eq!(found.len(), expected.len());
        for (found, expected) in found.iter().zip(&expected) {
            let (gpu, cpu) = (&found.record, &expected.record);
            println!("{method}: trusted share {:.3} and {:.3}, {:?}", gpu.trusted_volume, cpu.trusted_volume, gpu.seconds);
            assert!(gpu.device.starts_with("cuda:0") && warnings(gpu) == warnings(cpu), "{:?}", gpu.warnings);
            // Points ahead of their flights are answered by a GPU that walks, and by nobody else.
            assert!(gpu.speculative_traces > 0 && cpu.speculative_traces == 0);
            assert!((gpu.queries as f64 / cpu.queries as f64 - 1.0).abs() < 0.01, "{} and {}", gpu.queries, cpu.queries);
            // Cells at the edge of the tolerance may fall to either side: other labels are kept.
            assert!((gpu.traced_share - cpu.traced_share).abs() < 0.05 && (gpu.trusted_volume - cpu.trusted_volume).abs() < 0.05);
            let psnr = compare_films(&found.film, &expected.film, found.tone_map).unwrap().psnr.unwrap_or(f64::INFINITY);
            measured!("a run, `{method}`: {psnr:.1} dB; traced share {:.3} and {:.3}", gpu.traced_share, cpu.traced_share);
            println!("stated {:?} and {:?}", gpu.trusted_error, cpu.trusted_error);
            if let (Some(gpu), Some(cpu)) = (gpu.trusted_error.filter(|_| method == "surrogate"), cpu.trusted_error) {
                // The same points, unless rounding puts one more into a cell.
                assert!((gpu.optical_rms / cpu.optical_rms - 1.0).abs() < 0.02, "{gpu:?} for {cpu:?}");
            }
            // Where rounding, or which labels were kept, turns a cell's trust, one side looks up what the other traces: an error within
            // the tolerance in a part of the picture.
            assert!(psnr > if method == "gated" { 40.0 } else { 50.0 }, "{method}: {psnr} dB");
        }
    }
}
