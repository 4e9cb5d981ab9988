//! The numerics of the rendering kernels, compiled as host C++, against the Rust code on random inputs: the same text that runs on the
//! GPU, held to the reference on machines without one. Needs a C++ compiler (`c++`, or what CXX names).
#![allow(clippy::unwrap_used)] // helpers of tests, which may panic

use ridgewatch::field::Domain;
use ridgewatch::flow::{Extras, Traced, Tracer};
use ridgewatch::render::rng::{FrameRandom, philox};
use ridgewatch::render::{
    Camera, CameraSettings, Film, LightSettings, LogStretch, PixelValue, RenderSettings, Renderer, Scene, SeenInCells, Transfer,
    TransferSettings,
};
use ridgewatch::surrogate::{Predict, Table};
use ridgewatch::trust::{Residual, Strata, TrustMap, TrustSettings};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::OnceLock;
use std::sync::atomic::AtomicBool;

static NEVER: AtomicBool = AtomicBool::new(false);

/// The compiled harness. Contraction to fused multiply-add is off, since rustc does not contract either.
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

fn bytes<T: Copy>(values: &[T]) -> Vec<u8> {
    // SAFETY: called with numbers and arrays of numbers only, which have no padding.
    unsafe { std::slice::from_raw_parts(values.as_ptr().cast(), size_of_val(values)) }.to_vec()
}

/// Reads values off the front.
fn read<T: Copy>(bytes: &mut &[u8], count: usize) -> Vec<T> {
    let (front, rest) = bytes.split_at(count * size_of::<T>());
    *bytes = rest;
    // SAFETY: called with numbers and structs of numbers, for which every bit pattern is a value.
    front.chunks(size_of::<T>()).map(|chunk| unsafe { chunk.as_ptr().cast::<T>().read_unaligned() }).collect()
}

/// Fresh numbers in [0, 1).
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
        // As `FrameRandom` folds them.
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
        let mut input = renderer.set_up(0, 0..1).unwrap().parameters.as_bytes().to_vec();
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

/// Something cheap with structure, some of it missing, some traced.
struct Waves;

impl LogStretch for Waves {
    fn evaluate(&mut self, points: &[[f32; 3]], log_stretch: &mut [f32], traced: &mut [bool]) {
        for (i, p) in points.iter().enumerate() {
            let value = (7.0 * p[0] + 3.0 * p[2]).sin() * (9.0 * p[1]).cos();
            log_stretch[i] = if p[0] > 1.8 && p[1] < 0.3 { f32::NAN } else { value };
            traced[i] = p[1] > 0.5;
        }
    }
}

/// A frame tracked by the harness.
struct Tracked {
    /// Queries, traced, missing, exceeded, paths.
    counts: [u64; 5],
    film: Film,
    seen: SeenInCells,
}

/// Tracks samples of a frame with the kernels' code. `parts` of a pixel's samples run side by side, `ahead` collisions of a flight.
fn tracked(renderer: &mut Renderer, frame: u64, samples: std::ops::Range<u32>, parts: u32, ahead: [u32; 2]) -> Tracked {
    let setup = renderer.set_up(frame, samples.clone()).unwrap();
    let (pixels, cells) = (setup.parameters.pixels(), setup.majorants.len());
    let mut input = setup.parameters.as_bytes().to_vec();
    input.extend(bytes(setup.majorants));
    input.extend(bytes(setup.may_miss));
    input.extend(bytes(&[0, pixels as u32, parts, samples.start, samples.end - samples.start, 0]));
    input.extend(bytes(&ahead));
    let output = ask("frame", &input);
    let mut output = &output[..];
    let counts = read::<[u32; 5]>(&mut output, 1)[0].map(u64::from);
    let mut film = Film::new(37, 23);
    film.write_pixels(0, &read::<PixelValue>(&mut output, pixels));
    let seen = SeenInCells { count: read(&mut output, cells), highest: read(&mut output, cells), missing: read(&mut output, cells) };
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
    for (point_light, cells) in [(false, None), (true, Some([5, 3, 7])), (false, Some([1, 1, 1]))] {
        let scene = scene(point_light, false, cells);
        let mut reference = Renderer::new(scene.clone(), &domain(), 1.0).unwrap();
        let mut renderer = Renderer::new(scene, &domain(), 1.0).unwrap();
        // The first frame walks with the largest majorants, later ones with what the frames before have seen.
        for (frame, samples) in [(0, 0..3), (1, 0..1), (2, 4..9)] {
            let (expected, stats) = reference.render_samples(frame, samples.clone(), &mut Waves, None, &NEVER).unwrap();
            let found = tracked(&mut renderer, frame, samples, 1, [1, 1]);
            assert_eq!(
                found.counts,
                [stats.queries, stats.traced, stats.missing, stats.majorant_exceeded, stats.paths],
                "frame {frame}, cells {cells:?}"
            );
            assert!(bits(&found.film) == bits(&expected), "frame {frame}, cells {cells:?}");
            assert!(renderer.absorb(&found.seen));
        }
        reference.set_up(3, 0..1).unwrap();
        renderer.set_up(3, 0..1).unwrap();
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
        // Sums in f64 in another order, rounded to f32 once: a unit in the last place.
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
    let settings = TrustSettings { cells: Some([5, 3, 4]), ..TrustSettings::default() };
    let mut map = TrustMap::new(&settings, &domain());
    let mut random = uniform(2);
    let residuals: Vec<Residual> = (0..4000)
        .map(|_| {
            let point = [random(), random(), random()];
            Residual { point, optical: if point[0] + point[1] > 1.0 { 0.2 } else { 0.001 }, log_stretch: 0.0 }
        })
        .collect();
    map.observe(&[], &Strata::even(map.shape(), 0), &residuals);
    let gate = map.gate();
    assert!(gate.share() > 0.1 && gate.share() < 0.9, "both kinds of cells: {}", gate.share());
    let mut random = uniform(3);
    let mut points: Vec<[f32; 3]> = (0..20_000).map(|_| std::array::from_fn(|_| 1.2 * random() - 0.1)).collect();
    points.extend([[0.0; 3], [1.0; 3]]);
    let mut input = bytes(&[5_i32, 3, 4]);
    input.extend(bytes(gate.cells()));
    input.extend(bytes(&[points.len() as u32]));
    input.extend(bytes(&points));
    let expected: Vec<u8> = points.iter().map(|&p| u8::from(gate.trusts(p))).collect();
    assert!(ask("gate", &input) == expected);
}

/// Something to fill a table with.
struct Plane(Domain);

impl Tracer for Plane {
    fn domain(&self) -> &Domain {
        &self.0
    }
    fn tau(&self) -> f64 {
        1.0
    }
    fn steps(&self) -> usize {
        1
    }
    fn trace(&self, seeds: &[[f32; 3]], _: Extras, out: &mut Traced) {
        out.log_stretch = seeds.iter().map(|p| (5.0 * p[0]).sin() + (3.0 * p[1]).cos() * p[2]).collect();
    }
}

#[test]
fn tables_are_looked_up_alike() {
    for (domain, dimensions) in [(domain(), 3), (Domain::slab([0.0; 2], [2.0, 1.0], (0.0, 1.0)), 2)] {
        let table = Table::trace(&Plane(domain), [9, 5, 6]);
        let mut random = uniform(5);
        let mut points: Vec<[f32; 3]> = (0..10_000).map(|_| std::array::from_fn(|_| 1.2 * random() - 0.1)).collect();
        points.extend([[0.0; 3], [1.0; 3]]);
        let mut expected = vec![0.0; points.len()];
        table.predict(&points, &mut expected);
        let mut input = bytes(&table.nodes().map(|n| n as i32));
        input.extend(bytes(&[dimensions]));
        input.extend(bytes(table.values()));
        input.extend(bytes(&[points.len() as u32]));
        input.extend(bytes(&points));
        let output = ask("table", &input);
        for ((found, expected), point) in read::<f32>(&mut &output[..], points.len()).iter().zip(&expected).zip(&points) {
            // The CPU's lanes fuse multiply and add where the processor can: two roundings of values up to 2 at each of three levels.
            assert!((found - expected).abs() <= 1e-6, "{point:?}: {found} and {expected}");
        }
    }
}
