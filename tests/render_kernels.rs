//! Compares the rendering kernels' numerics, compiled as host C++, with the Rust code on random inputs. The source is the one that runs on the
//! GPU; the test needs no GPU but a C++ compiler (`c++`, or the one in CXX).
#![allow(clippy::unwrap_used)] // helpers of tests, which may panic

use ridgewatch::backend::{DeviceError, residuals, stratified_points};
use ridgewatch::field::{Axis, Domain, DomainPoint, Geometry, Grid, Snapshot, UnitPoint, Window};
use ridgewatch::flow::{
    Boundary, Direction, Extras, FlowMap, Integrator, Interpolation, Normalisation, Precision, Steps, Traced, Tracer, VelocitySource,
    cpu_tracer,
};
use ridgewatch::render::rng::{FrameRandom, philox};
use ridgewatch::render::{
    Camera, CameraSettings, CellObservations, Film, LightSettings, LogStretch, RenderSettings, Renderer, Scene, Transfer, TransferSettings,
};
use ridgewatch::surrogate::{Predict, Samples, Table};
use ridgewatch::trust::{Audited, Gate, Residual, Strata, TrustMap, TrustSettings};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, OnceLock};

#[path = "render_kernels/coupled.rs"]
mod coupled;

static NEVER: AtomicBool = AtomicBool::new(false);

/// Path of the compiled harness. Contraction to fused multiply-add is off, as in rustc.
fn harness() -> &'static Path {
    static BUILT: OnceLock<PathBuf> = OnceLock::new();
    BUILT.get_or_init(|| {
        let root = Path::new(env!("CARGO_MANIFEST_DIR"));
        let out = Path::new(env!("CARGO_TARGET_TMPDIR")).join("render_kernels_harness");
        let compiler = std::env::var("CXX").unwrap_or_else(|_| "c++".into());
        let status = Command::new(&compiler)
            .args(["-std=c++17", "-O2", "-ffp-contract=off", "-Wall", "-Wextra", "-Werror", "-I"])
            .arg(root.join("kernels"))
            .arg(root.join("tests/render_kernels/harness.cpp"))
            .arg("-o")
            .arg(&out)
            .status()
            .unwrap_or_else(|error| panic!("{compiler} does not start: {error}"));
        assert!(status.success(), "the kernels' headers do not compile as host C++");
        out
    })
}

fn ask(request: &str, input: &[u8]) -> Vec<u8> {
    let mut child = Command::new(harness()).arg(request).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
    let mut stdin = child.stdin.take().unwrap();
    let output = std::thread::scope(|scope| {
        scope.spawn(move || stdin.write_all(input).unwrap());
        child.wait_with_output().unwrap()
    });
    assert!(output.status.success(), "{request}: {}", output.status);
    output.stdout
}

fn bytes<T: bytemuck::NoUninit>(values: &[T]) -> Vec<u8> {
    bytemuck::cast_slice(values).to_vec()
}

/// Reads values off the front.
fn read<T: Copy>(bytes: &mut &[u8], count: usize) -> Vec<T> {
    let (front, rest) = bytes.split_at(count * size_of::<T>());
    *bytes = rest;
    // SAFETY: called with numbers and structs of numbers, for which every bit pattern is valid.
    front.chunks(size_of::<T>()).map(|chunk| unsafe { chunk.as_ptr().cast::<T>().read_unaligned() }).collect()
}

/// Random numbers in [0, 1).
fn uniform(stream: u32) -> impl FnMut() -> f32 {
    let mut i = 0;
    move || {
        i += 1;
        (philox([i, stream, 0, 0], [17, 4])[0] >> 8) as f32 / 16_777_216.0
    }
}

#[test]
fn random_words_are_the_same_bits() {
    let mut input = bytes(&[20_000_u32]);
    let mut expected = Vec::new();
    for i in 0..20_000_u32 {
        let w = philox([i, 0, 0, 0], [1, 2]);
        let (seed, frame) = ((u64::from(w[0]) << 32) | u64::from(w[1]), u64::from(w[2]) << (i % 12));
        // As in `FrameRandom`.
        let key = [seed as u32, ((seed >> 32) as u32).wrapping_add((frame >> 32) as u32)];
        input.extend(bytes(&[key[0], key[1], frame as u32, w[3], i, w[1] >> 20]));
        expected.extend(FrameRandom::new(seed, frame).words(w[3], i, w[1] >> 20));
    }
    assert!(ask("words", &input) == bytes(&expected));
}

fn domain() -> Domain {
    Domain::cuboid([0.0; 3], [2.0, 1.0, 1.0])
}

fn scene(point_light: bool, orthographic: bool, cells: Option<[usize; 3]>) -> Scene {
    let settings = RenderSettings { width: 37, height: 23, majorant_cells: cells, ..RenderSettings::default() };
    let camera = CameraSettings { eye: [1.1, 0.4, 2.3], look_at: [1.0, 0.5, 0.5], up: [0.1, 1.0, 0.0], field_of_view: 90.0, orthographic };
    let light = if point_light {
        LightSettings { direction: None, position: Some([0.3, 2.0, 1.7]), radiance: [8.0, 9.0, 10.0] }
    } else {
        LightSettings { direction: Some([-1.0, -1.0, -1.0]), position: None, radiance: [12.0; 3] }
    };
    let transfer = TransferSettings { low: Some(0.2), high: Some(0.9), extinction: Some(20.0), ..TransferSettings::default() };
    Scene::assemble(&domain(), Some(camera), Some(light), Some(transfer), settings, 1)
}

#[test]
fn rays_and_colours_are_the_same_numbers() {
    for orthographic in [false, true] {
        let scene = scene(false, orthographic, None);
        let camera = Camera::new(&scene.camera, 37.0 / 23.0).unwrap();
        let transfer = Transfer::new(&scene.transfer, 1.0).unwrap();
        let mut renderer = Renderer::new(scene, &domain(), 1.0).unwrap();
        let mut input = renderer.frame_setup(0, 0..1).unwrap().parameters.as_bytes().to_vec();
        let n = 5000_u32;
        input.extend(bytes(&[n]));
        let (mut random, mut asked) = (uniform(1), Vec::new());
        for _ in 0..n {
            let (x, y, ftle) = (f64::from(2.0 * random() - 1.0), f64::from(2.0 * random() - 1.0), 2.0 * random() - 0.5);
            input.extend(bytes(&[x, y]));
            input.extend(bytes(&[ftle]));
            asked.push((x, y, ftle));
        }
        let output = ask("scene", &input);
        let mut output = &output[..];
        for (x, y, ftle) in asked {
            let (origin, direction) = camera.ray(x, y);
            assert_eq!(read::<[f64; 3]>(&mut output, 2), [origin, direction]);
            let found = read::<f32>(&mut output, 5);
            let [r, g, b] = transfer.albedo(ftle);
            assert_eq!(found, [transfer.ramp(ftle), transfer.extinction(ftle), r, g, b], "FTLE {ftle}");
        }
    }
}

/// A cheap test field with structure: some values are missing, some count as traced.
struct Waves;

impl LogStretch for Waves {
    fn evaluate(&mut self, points: &[DomainPoint], log_stretch: &mut [f32], traced: &mut [bool]) {
        for (i, p) in points.iter().enumerate() {
            let value = (7.0 * p.0[0] + 3.0 * p.0[2]).sin() * (9.0 * p.0[1]).cos();
            log_stretch[i] = if p.0[0] > 1.8 && p.0[1] < 0.3 { f32::NAN } else { value };
            traced[i] = p.0[1] > 0.5;
        }
    }
}

/// A frame tracked by the harness.
struct Tracked {
    /// Queries, traced, missing, exceeded, paths, over budget.
    counts: [u64; 6],
    film: Film,
    seen: CellObservations,
}

/// Tracks samples of a frame with the kernels' code. A pixel's samples are divided into `parts`; a flight queues `ahead` collisions at once.
fn tracked(renderer: &mut Renderer, frame: u64, samples: std::ops::Range<u32>, parts: u32, ahead: [u32; 2]) -> Tracked {
    tracked_by("frame", &[], renderer, frame, samples, parts, ahead)
}

/// `PixelValue` of `kernels/rendering/film.cuh`.
#[repr(C)]
#[derive(Clone, Copy)]
struct PixelValue {
    rgba: [f32; 4],
    rest: [f32; 6],
}

/// As [`tracked`], with the answers of `request`, whose own input is `setup`.
fn tracked_by(
    request: &str,
    answer_setup: &[u8],
    renderer: &mut Renderer,
    frame: u64,
    samples: std::ops::Range<u32>,
    parts: u32,
    ahead: [u32; 2],
) -> Tracked {
    let setup = renderer.frame_setup(frame, samples.clone()).unwrap();
    let (pixels, cells) = (setup.parameters.pixels(), setup.majorants.len());
    let mut input = [answer_setup, setup.parameters.as_bytes()].concat();
    input.extend(bytes(setup.majorants));
    input.extend(bytes(setup.may_be_missing));
    input.extend(bytes(&[0, pixels as u32, parts, samples.start, samples.end - samples.start, 0]));
    input.extend(bytes(&ahead));
    let output = ask(request, &input);
    let mut output = &output[..];
    let counts = read::<[u32; 6]>(&mut output, 1)[0].map(u64::from);
    let mut film = Film::new(37, 23);
    for (i, value) in read::<PixelValue>(&mut output, pixels).into_iter().enumerate() {
        film.rgba[i] = value.rgba;
        [film.ftle_mean[i], film.traced[i], film.variance[i], film.samples[i], film.missing[i], film.queries[i]] = value.rest;
    }
    let seen = CellObservations { count: read(&mut output, cells), highest: read(&mut output, cells), missing: read(&mut output, cells) };
    assert!(output.is_empty());
    Tracked { counts, film, seen }
}

/// Films hold NaN where nothing was hit, so bits are compared.
fn bits(film: &Film) -> Vec<u32> {
    let rgba = film.rgba.iter().flatten();
    let rest = [&film.ftle_mean, &film.traced, &film.variance, &film.samples, &film.missing, &film.queries];
    rgba.chain(rest.into_iter().flatten()).map(|v| v.to_bits()).collect()
}

#[test]
fn whole_frames_are_the_same_bits() {
    let cases = [(false, None, false), (true, Some([5, 3, 7]), false), (true, Some([5, 3, 7]), true), (false, Some([1, 1, 1]), false)];
    for (point_light, cells, misled) in cases {
        let scene = scene(point_light, false, cells);
        let mut reference = Renderer::new(scene, &domain(), 1.0).unwrap();
        if misled {
            coupled::mislead(&reference);
        }
        let mut renderer = reference.clone();
        // The first frame uses the largest majorants, or those that are too low. Later ones have majorants from the values of earlier frames.
        for (frame, samples) in [(0, 0..3), (1, 0..1), (2, 4..9)] {
            let (expected, stats) = reference.render_samples(frame, samples.clone(), &mut Waves, None, &NEVER).unwrap();
            // Of what a flight has looked ahead to, nothing counts once it has met an extinction above its majorant.
            let found = tracked(&mut renderer, frame, samples, 1, if misled { [4, 6] } else { [1, 1] });
            assert!((stats.majorant_exceeded > 100) == (misled && frame == 0), "frame {frame}: {} exceeded", stats.majorant_exceeded);
            assert_eq!(
                found.counts,
                [stats.queries, stats.traced, stats.missing, stats.majorant_exceeded, stats.paths, 0],
                "frame {frame}, cells {cells:?}"
            );
            assert!(bits(&found.film) == bits(&expected), "frame {frame}, cells {cells:?}");
            assert!(renderer.absorb(&found.seen));
        }
        reference.frame_setup(3, 0..1).unwrap();
        renderer.frame_setup(3, 0..1).unwrap();
        assert_eq!(renderer.majorants().majorants(), reference.majorants().majorants());
    }
}

#[test]
fn looking_ahead_changes_no_bit() {
    let mut renderer = Renderer::new(scene(false, false, None), &domain(), 1.0).unwrap();
    let first = tracked(&mut renderer, 0, 0..2, 1, [1, 1]);
    assert!(renderer.absorb(&first.seen));
    let plain = tracked(&mut renderer, 1, 0..6, 1, [1, 1]);
    for ahead in [[2, 2], [1, 16], [7, 3]] {
        let found = tracked(&mut renderer, 1, 0..6, 1, ahead);
        assert_eq!(found.counts, plain.counts, "{ahead:?}");
        assert_eq!(found.seen, plain.seen, "{ahead:?}");
        assert!(bits(&found.film) == bits(&plain.film), "{ahead:?}");
    }
}

#[test]
fn parts_of_a_pixel_merge_to_the_whole() {
    let mut renderer = Renderer::new(scene(false, false, None), &domain(), 1.0).unwrap();
    let whole = tracked(&mut renderer, 1, 0..13, 1, [1, 1]);
    for parts in [2, 5, 13] {
        let found = tracked(&mut renderer, 1, 0..13, parts, [1, 1]);
        assert_eq!((found.counts, &found.seen), (whole.counts, &whole.seen), "{parts} parts");
        assert_eq!((&found.film.samples, &found.film.queries), (&whole.film.samples, &whole.film.queries));
        // Sums in f64 in another order, rounded to f32 once, differ by a unit in the last place.
        let near = |a: f32, b: f32| (a.is_nan() && b.is_nan()) || (a - b).abs() <= 2e-7 * (1.0 + b.abs());
        for i in 0..whole.film.samples.len() {
            assert!((0..4).all(|k| near(found.film.rgba[i][k], whole.film.rgba[i][k])), "{parts} parts, pixel {i}");
            assert!(near(found.film.variance[i], whole.film.variance[i]), "{parts} parts, pixel {i}");
            assert!(near(found.film.ftle_mean[i], whole.film.ftle_mean[i]), "{parts} parts, pixel {i}");
        }
    }
}

#[test]
fn the_gate_trusts_the_same_points() {
    let gate = some_gate();
    let mut random = uniform(3);
    let mut points: Vec<UnitPoint> = (0..20_000).map(|_| UnitPoint(std::array::from_fn(|_| 1.2 * random() - 0.1))).collect();
    points.extend([[0.0; 3], [1.0; 3]].map(UnitPoint));
    let mut input = bytes(&[5_i32, 3, 4]);
    input.extend(bytes(gate.cells()));
    input.extend(bytes(&[points.len() as u32]));
    input.extend(bytes(&points));
    let expected: Vec<u8> = points.iter().map(|&p| u8::from(gate.trusts(p))).collect();
    assert!(ask("gate", &input) == expected);
}

/// A tracer of a simple formula, which fills tables.
struct Plane(Domain);

impl Tracer for Plane {
    fn domain(&self) -> &Domain {
        &self.0
    }
    fn start(&self) -> f64 {
        0.0
    }
    fn tau(&self) -> f64 {
        1.0
    }
    fn steps(&self) -> usize {
        1
    }
    fn trace(&self, seeds: &[DomainPoint], _: Extras, out: &mut Traced) {
        out.log_stretch = seeds.iter().map(|p| (5.0 * p.0[0]).sin() + (3.0 * p.0[1]).cos() * p.0[2]).collect();
    }
}

fn table_bytes(table: &Table, dimensions: i32) -> Vec<u8> {
    [bytes(&table.nodes().map(|n| n as i32)), bytes(&[dimensions]), bytes(table.values())].concat()
}

#[test]
fn tables_are_looked_up_alike() {
    for (domain, dimensions) in [(domain(), 3), (Domain::slab([0.0; 2], [2.0, 1.0], (0.0, 1.0)), 2)] {
        let table = Table::trace(&Plane(domain), [9, 5, 6]).unwrap();
        let mut random = uniform(5);
        let mut points: Vec<UnitPoint> = (0..10_000).map(|_| UnitPoint(std::array::from_fn(|_| 1.2 * random() - 0.1))).collect();
        points.extend([[0.0; 3], [1.0; 3]].map(UnitPoint));
        let mut expected = vec![0.0; points.len()];
        table.interpolate(&points, &mut expected);
        let mut input = table_bytes(&table, dimensions);
        input.extend(bytes(&[points.len() as u32]));
        input.extend(bytes(&points));
        let output = ask("table", &input);
        for ((found, expected), point) in read::<f32>(&mut &output[..], points.len()).iter().zip(&expected).zip(&points) {
            // A CPU without fused multiply-add rounds twice: values up to 2 at each of three levels.
            assert!((found - expected).abs() <= 1e-6, "{point:?}: {found} and {expected}");
        }
    }
}

/// Constant velocity on [`axes`], the first of them periodic if asked, with missing nodes at the time of the seeds.
fn holed(periodic: bool) -> Box<dyn Tracer> {
    let [x, y, z] = axes(periodic);
    let x = Axis::new("x", "", x).unwrap();
    let x = if periodic { x.with_period(2.0) } else { x };
    let axes = vec![x, Axis::new("y", "", y).unwrap(), Axis::new("z", "", z).unwrap()];
    let grid = Arc::new(Grid { axes, geometry: Geometry::Cartesian, slab: (0.0, 1.0) });
    let mut window = Window::new(1.0);
    for time in [0.0, 1.0] {
        let u: Vec<f32> = (0..grid.nodes()).map(|i| if i % 41 == 3 && time == 0.0 { f32::NAN } else { 0.1 }).collect();
        let v = vec![0.0; grid.nodes()];
        window.push(Arc::new(Snapshot::from_components(time, grid.clone(), &u, &v, &v))).unwrap();
    }
    let map = FlowMap {
        tau: 1.0,
        direction: Direction::Forward,
        integrator: Integrator::Tangent,
        precision: Precision::F32,
        steps: Steps::Fixed(2),
        difference_step: 1e-4,
        boundary: Boundary::Clamp,
        normalisation: Normalisation::Tau,
        interpolation: Interpolation::Linear,
    };
    cpu_tracer(VelocitySource::Window(Arc::new(window)), &map, 0.0).unwrap()
}

/// Uneven nodes over the domain.
fn axes(periodic: bool) -> [Vec<f64>; 3] {
    let at = |length: f64, n: usize| -> Vec<f64> {
        (0..n).map(|i| length * (i as f64 + 0.3 * (2.0 * i as f64).sin()) / (n as f64 - 1.0 + 0.3 * (2.0 * n as f64 - 2.0).sin())).collect()
    };
    [at(if periodic { 1.8 } else { 2.0 }, 11), at(1.0, 6), at(1.0, 7)]
}

/// Missing cells in the harness's input format: those at whose centre the tracer has no value.
fn missing_cells_bytes(tracer: &dyn Tracer, periodic: bool) -> Vec<u8> {
    let axes = axes(periodic);
    let mut out = bytes(&[3_i32]);
    let mut middles: Vec<Vec<f64>> = axes.iter().map(|nodes| nodes.windows(2).map(|pair| (pair[0] + pair[1]) / 2.0).collect()).collect();
    if periodic {
        middles[0].push(1.9);
    }
    for (k, nodes) in axes.iter().enumerate() {
        out.extend(bytes(&[if periodic && k == 0 { 2.0 } else { 0.0 }]));
        out.extend(bytes(&[nodes.len() as i32]));
        out.extend(bytes(nodes));
    }
    for &z in &middles[2] {
        for &y in &middles[1] {
            out.extend(middles[0].iter().map(|&x| u8::from(tracer.is_missing(DomainPoint([x as f32, y as f32, z as f32])))));
        }
    }
    out
}

/// `UnitBox` of the kernels.
fn unit_box_bytes(domain: &Domain) -> Vec<u8> {
    [bytes(&[domain.min, domain.extent()]), bytes(&domain.inward_corners())].concat()
}

/// Domain, gate, missing cells and table in the harness's input format. Without a gate RK4 answers everywhere.
fn answer_setup_bytes(domain: &Domain, spent: bool, gate: Option<&Gate>, missing_cells: &[u8], table: &Table) -> Vec<u8> {
    let mut out = unit_box_bytes(domain);
    out.extend(bytes(&[i32::from(spent)]));
    match gate {
        Some(gate) => {
            out.extend(bytes(&gate.shape().map(|n| n as i32)));
            out.extend(bytes(gate.cells()));
        }
        None => out.extend(bytes(&[0_i32; 3])),
    }
    out.extend(missing_cells);
    out.extend(table_bytes(table, 3));
    out
}

/// A gate that trusts some cells and not others.
fn some_gate() -> Gate {
    let mut map = TrustMap::new(&TrustSettings { cells: Some([5, 3, 4]), ..TrustSettings::default() }, &domain());
    let mut random = uniform(7);
    let residuals: Vec<Residual> = (0..4000)
        .map(|_| {
            let point = UnitPoint([random(), random(), random()]);
            Residual { point, optical: if point.0[0] + point.0[1] > 1.0 { 0.2 } else { 0.001 }, log_stretch: 0.0 }
        })
        .collect();
    map.observe(None, &residuals);
    let gate = map.gate();
    assert!(gate.share() > 0.1 && gate.share() < 0.9, "both kinds of cells: {}", gate.share());
    gate
}

#[test]
fn the_same_one_answers_at_every_point() {
    let (gate, domain) = (some_gate(), domain());
    let table = Table::trace(&Plane(domain.clone()), [9, 5, 6]).unwrap();
    for (periodic, spent) in [(false, false), (true, true)] {
        let tracer = holed(periodic);
        let mut random = uniform(8);
        let mut points: Vec<DomainPoint> = (0..20_000).map(|_| domain.from_unit(UnitPoint([random(), random(), random()]))).collect();
        // Outside the domain, corners, and nodes of the velocity grid themselves.
        let outside: Vec<DomainPoint> = (0..5000)
            .map(|_| DomainPoint(std::array::from_fn(|k| ((1.8 * random() - 0.4) * domain.extent()[k] as f32) + domain.min[k] as f32)))
            .collect();
        assert!(outside.iter().filter(|point| !domain.contains(**point)).count() > 2500);
        points.extend(outside);
        points.extend([[0.0; 3], [2.0, 1.0, 1.0]].map(DomainPoint));
        let nodes = axes(periodic);
        points.extend((0..77).map(|i| DomainPoint([nodes[0][i % 11] as f32, nodes[1][i % 6] as f32, nodes[2][i % 7] as f32])));
        let mut input = answer_setup_bytes(&domain, spent, Some(&gate), &missing_cells_bytes(&*tracer, periodic), &table);
        input.extend(bytes(&[points.len() as u32]));
        input.extend(bytes(&points));
        let output = ask("choices", &input);
        let mut output = &output[..];
        let mut seen = [0; 4];
        for &point in &points {
            let who = read::<i32>(&mut output, 1)[0];
            let values = read::<f32>(&mut output, 4);
            let unit = domain.to_unit(point);
            let expected = match (tracer.is_missing(point), gate.trusts(unit), spent) {
                (true, ..) => 0,
                (_, true, _) => 1,
                (.., true) => 2,
                _ => 3,
            };
            assert_eq!(who, expected, "{point:?}");
            seen[expected as usize] += 1;
            if expected > 0 {
                let mut predicted = [0.0];
                table.interpolate(&[unit], &mut predicted);
                assert_eq!(values[..3], unit.0, "{point:?}");
                assert!((values[3] - predicted[0]).abs() <= 1e-6, "{point:?}");
            }
        }
        let unused = if spent { 3 } else { 2 };
        assert!((0..4).all(|who| (seen[who] > 500) != (who == unused)), "{seen:?}");
    }
}

/// A surrogate with given predictions.
struct Given(Vec<f32>);

impl Predict for Given {
    fn name(&self) -> &'static str {
        "given"
    }
    fn predict(&self, _: &[UnitPoint], out: &mut [f32]) -> Result<(), DeviceError> {
        out.copy_from_slice(&self.0);
        Ok(())
    }
    fn bytes(&self) -> usize {
        0
    }
}

#[test]
fn audits_draw_the_same_points_and_add_up_to_the_same_bits() {
    let shape = [5, 3, 7];
    let mut random = uniform(11);
    let strata = Strata::new(shape, (0..105).map(|_| (90.0 * random() * random()) as u32).collect());
    let (seed, stream, tau) = (0x1234_5678_9abc_u64, (7_u64 << 33) + 5, 1.7);
    let unit = stratified_points(&strata, seed, stream);
    let settings = TransferSettings { low: Some(0.2), high: Some(0.9), ..TransferSettings::default() };
    let transfer = Transfer::new(&settings, 1.0).unwrap();
    let per_range = 1.0 / (0.9_f64 - 0.2) as f32;
    let mut input = bytes(&shape.map(|n| n as i32));
    input.extend(bytes(&[seed as u32, (seed >> 32) as u32, stream as u32, (stream >> 32) as u32, u32::MAX]));
    input.extend(bytes(&[0.2_f32, per_range, tau as f32]));
    let (mut samples, mut predicted) = (Samples::default(), Vec::new());
    let mut number = 0;
    for &drawn in &strata.drawn {
        input.extend(bytes(&[drawn]));
        for _ in 0..drawn {
            // Some points are missing, some traces are NaN, some predictions are not finite.
            let (missing, lifetime_share) = (random() < 0.1, random());
            let traced = if random() < 0.05 { f32::NAN } else { 2.0 * random() - 0.2 };
            let said = if random() < 0.05 { f32::INFINITY } else { traced + 0.2 * random() * random() };
            input.extend(bytes(&[f32::from(u8::from(missing)), lifetime_share, said, traced]));
            if !missing {
                samples.points.push(unit[number]);
                samples.log_stretch.push(traced);
                predicted.push(said);
            }
            number += 1;
        }
    }
    let output = ask("audit", &input);
    let mut output = &output[..];
    let expected = Audited::of(&residuals(&Given(predicted), &samples, &transfer, tau).unwrap(), strata.clone());
    let (mut number, mut points, mut peak) = (0, 0.0, f64::NEG_INFINITY);
    for (cell, &drawn) in strata.drawn.iter().enumerate() {
        for _ in 0..drawn {
            assert_eq!(read::<UnitPoint>(&mut output, 1)[0], unit[number], "point {number}");
            number += 1;
        }
        // Figures of the points themselves follow the sums.
        let found = read::<[f64; 10]>(&mut output, 1)[0];
        let sums = expected.cells()[cell];
        let sums = [sums.count, sums.optical, sums.square, sums.fourth, sums.second, sums.third, sums.log_square];
        assert_eq!(found[..7].iter().map(|x| x.to_bits()).collect::<Vec<_>>(), sums.map(f64::to_bits), "cell {cell}");
        points += found[7];
        peak = peak.max(found[9]);
    }
    assert_eq!((points, number), (samples.len() as f64, strata.total()));
    let highest = samples.log_stretch.iter().copied().filter(|s| s.is_finite()).fold(f32::NEG_INFINITY, f32::max);
    assert_eq!(peak, f64::from(highest));
}

#[test]
#[cfg(feature = "cuda")]
fn the_same_labels_are_kept() {
    let mut random = uniform(9);
    let points: Vec<DomainPoint> = (0..20_000).map(|_| DomainPoint(std::array::from_fn(|_| random()))).collect();
    for shift in [0_u32, 1, 5, 32] {
        let mut input = bytes(&[shift, points.len() as u32]);
        input.extend(bytes(&points));
        let expected: Vec<u8> = points.iter().map(|&p| u8::from(ridgewatch::backend::keeps_label(p, shift))).collect();
        assert!(ask("labels", &input) == expected, "1 in 2^{shift}");
    }
}

/// Answers on the CPU: missing cells, then the table inside the gate, and the test field outside.
struct Gated<'a> {
    tracer: &'a dyn Tracer,
    gate: Option<&'a Gate>,
    table: &'a Table,
    spent: bool,
    over_budget: u64,
}

impl LogStretch for Gated<'_> {
    fn evaluate(&mut self, points: &[DomainPoint], log_stretch: &mut [f32], traced: &mut [bool]) {
        for (i, &p) in points.iter().enumerate() {
            let unit = domain().to_unit(p);
            traced[i] = false;
            if self.tracer.is_missing(p) {
                log_stretch[i] = f32::NAN;
            } else if self.gate.is_some_and(|gate| self.spent || gate.trusts(unit)) {
                self.over_budget += u64::from(self.gate.is_some_and(|gate| !gate.trusts(unit)));
                self.table.interpolate(&[unit], &mut log_stretch[i..=i]);
            } else {
                (log_stretch[i], traced[i]) = ((7.0 * p.0[0] + 3.0 * p.0[2]).sin() * (9.0 * p.0[1]).cos(), true);
            }
        }
    }
}

#[test]
fn gated_frames_are_the_cpu_s() {
    let (gate, domain) = (some_gate(), domain());
    let table = Table::trace(&Plane(domain.clone()), [9, 5, 6]).unwrap();
    let tracer = holed(false);
    let missing_cells = missing_cells_bytes(&*tracer, false);
    for (gate, spent) in [(Some(&gate), false), (Some(&gate), true), (None, false)] {
        let scene = scene(false, false, None);
        let mut reference = Renderer::new(scene.clone(), &domain, 1.0).unwrap();
        let mut renderer = Renderer::new(scene, &domain, 1.0).unwrap();
        let setup = answer_setup_bytes(&domain, spent, gate, &missing_cells, &table);
        for (frame, samples) in [(0, 0..2), (1, 0..5)] {
            let mut answers = Gated { tracer: &*tracer, gate, table: &table, spent, over_budget: 0 };
            let (expected, stats) = reference.render_samples(frame, samples.clone(), &mut answers, None, &NEVER).unwrap();
            let found = tracked_by("gated", &setup, &mut renderer, frame, samples, 1, [3, 5]);
            let tally = [stats.queries, stats.traced, stats.missing, stats.majorant_exceeded, stats.paths, answers.over_budget];
            assert_eq!(found.counts, tally, "frame {frame}, budget spent: {spent}");
            assert!(bits(&found.film) == bits(&expected), "frame {frame}, budget spent: {spent}");
            assert!(stats.missing > 100 && (answers.over_budget > 100) == spent && (stats.traced > 100) != spent, "{tally:?}");
            assert!(renderer.absorb(&found.seen));
        }
    }
}
