//! How often the stated intervals hold, and how fast the error falls, over pictures and scenes whose exact picture is known: the traced
//! field is that of nodes, which are marched finely.

use super::{ErrorEstimate, Medium, Nodes, Picture, RaySum, Refinement, StepsError, ToLight};
use crate::{CameraSettings, Film, LightSettings, LogStretch, Method, RenderSettings, Renderer, Scene, Target, TransferSettings};
use rayon::prelude::*;
use ridgewatch_field::{Domain, DomainPoint, UnitPoint};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

static NEVER: AtomicBool = AtomicBool::new(false);
const NODES: usize = 33;
const SEEDS: u64 = 24;

struct Traced<'a>(&'a Nodes);

impl LogStretch for Traced<'_> {
    fn evaluate(&mut self, points: &[DomainPoint], log_stretch: &mut [f32], traced: &mut [bool]) {
        // The domain is the unit cube.
        points.iter().zip(log_stretch).for_each(|(p, s)| *s = self.0.at(UnitPoint(p.0)));
        traced.fill(true);
    }
}

fn nodes(of: impl Fn([f32; 3]) -> f32) -> Nodes {
    nodes_along(NODES, of)
}

fn nodes_along(edge: usize, of: impl Fn([f32; 3]) -> f32) -> Nodes {
    Nodes::new([edge; 3], Arc::new((0..edge.pow(3)).map(|i| of(Nodes::unit([edge; 3], i).0)).collect()))
}

fn ridges(p: [f32; 3]) -> f32 {
    0.5 + 0.5 * (5.0 * p[0] + 2.0 * p[2]).sin() * (6.0 * p[1] - p[2]).cos()
}

/// The traced field and the surrogate.
fn fields(which: usize) -> [Nodes; 2] {
    match which {
        0 => [nodes(ridges), nodes(|p| ridges(p) + 0.1 * (11.0 * p[0]).sin())],
        1 => [nodes(|p| 0.1 + 0.5 * p[0]), nodes(|_| 0.1)],
        // A tube that the surrogate does not know.
        _ => [nodes(|p| if (p[0] - 0.53).hypot(p[1] - 0.47) < 0.15 { 0.8 } else { 0.1 }), nodes(|_| 0.1)],
    }
}

fn scene(width: usize, seed: u64) -> Scene {
    let camera =
        CameraSettings { eye: [0.5, 0.5, 1.5], look_at: [0.5, 0.5, 1.0], up: [0.0, 1.0, 0.0], field_of_view: 90.0, orthographic: true };
    Scene {
        camera,
        light: LightSettings::directional([0.3, 0.2, -1.0], 4.0 * std::f64::consts::PI),
        transfer: TransferSettings { low: Some(0.0), high: Some(1.0), extinction: Some(5.0), albedo: [vec![0.8], vec![0.6], vec![0.4]] },
        settings: RenderSettings { width, height: width, background: [0.0; 3], ..RenderSettings::default() },
        seed,
        scale: [1.0; 3],
        plane: None,
    }
}

fn renderer(width: usize, seed: u64) -> Renderer {
    Renderer::new(scene(width, seed), &Domain::cuboid([0.0; 3], [1.0; 3]), 1.0).unwrap()
}

/// Radiance of every pixel of a field, without noise.
fn exact(traced: &Nodes, width: usize) -> Vec<[f64; 3]> {
    const RAYS: u64 = 16;
    let renderer = renderer(width, 1);
    let scene = renderer.frame_scene(0);
    let medium = Medium { scene: &scene, nodes: traced, missing: None };
    let spacing = medium.spacing() as f32;
    let pixel = |pixel: u32| {
        let mut sum = RaySum::default();
        (0..RAYS).for_each(|j| sum.add(&medium.ray(pixel, j, 0.25 * spacing, ToLight::March(0.5 * spacing), false)));
        sum.radiance.map(|c| f64::from(c) / RAYS as f64)
    };
    (0..(width * width) as u32).into_par_iter().map(pixel).collect()
}

/// Weighted mean square error over lit pixels and channels.
fn true_square(film: &Film, exact: &[[f64; 3]], weight: impl Fn(f64) -> f64) -> f64 {
    let lit: Vec<usize> = (0..exact.len()).filter(|&i| film.rgba[i][3] > 0.01).collect();
    let square = |i: usize, k: usize| {
        let found = f64::from(film.rgba[i][k]);
        (found - exact[i][k]).powi(2) * weight(found)
    };
    lit.iter().flat_map(|&i| (0..3).map(move |k| (i, k))).map(|(i, k)| square(i, k)).sum::<f64>() / (3 * lit.len()) as f64
}

/// A round of a picture whose steps leave nothing in it.
fn round(nodes: &Nodes, (method, sum): (Method, bool), samples: f64, number: u64) -> Refinement<'_> {
    Refinement { nodes, missing: None, method, sum, samples, budget: None, steps_error: StepsError::default(), number, stop: &NEVER }
}

/// Numbers of pictures that state an error, whose interval holds the true one, is above it and below it.
fn counted([traced, surrogate]: &[Nodes; 2], width: usize, (method, sum): (Method, bool), pairs_per_pixel: f64, rounds: u64) -> [usize; 4] {
    let exact = exact(traced, width);
    let found = |seed: u64| {
        let mut renderer = renderer(width, 100 + seed);
        let mut picture = Picture::default();
        let mut last = None;
        for number in 0..rounds {
            let samples = 2.0 * pairs_per_pixel;
            let round = round(surrogate, (method, sum), samples, number);
            last = renderer.refine(&mut picture, &round, &mut Traced(traced));
        }
        let (film, _, error) = last.unwrap();
        let truth = true_square(&film, &exact, |_| 1.0).sqrt();
        let ErrorEstimate { low, high, .. } = error.rms;
        [error.is_known(), (low..=high).contains(&truth), low > truth, high < truth].map(|is| usize::from(is && error.is_known()))
    };
    (0..SEEDS).into_par_iter().map(found).reduce(|| [0; 4], |a, b| std::array::from_fn(|i| a[i] + b[i]))
}

/// Fails with the quantile of the normal distribution, and with the difference between a tile's quarters as the scatter of a sum.
#[test]
fn intervals_hold_over_scenes_and_numbers_of_samples() {
    let mut all = [0; 4];
    for which in 0..3 {
        let fields = fields(which);
        for width in [16, 32] {
            for (method, pairs, rounds) in [
                ((Method::TwoLevel, false), 1.0 / 16.0, 1),
                ((Method::TwoLevel, false), 1.0, 1),
                ((Method::TwoLevel, true), 1.0, 2),
                ((Method::TwoLevel, false), 1.0 / 64.0, 1),
                ((Method::Marched, false), 1.0, 2),
            ] {
                let found = counted(&fields, width, method, pairs, rounds);
                all = std::array::from_fn(|i| all[i] + found[i]);
                assert!(found[1] * 10 >= found[0] * 8, "field {which}, {width}x{width}, {method:?}, {pairs} pairs x {rounds}: {found:?}");
            }
        }
    }
    let [known, inside, above, below] = all;
    assert!(inside * 100 >= known * 93 && above > 0 && below > 0, "{all:?}");
}

/// Fails if each pixel's error is that of the squares around it alone, whose few samples mostly see nothing of heavy tails.
#[test]
#[allow(clippy::print_stdout)]
fn errors_of_pixels_hold() {
    const WIDTH: usize = 96;
    const SEEDS: u64 = 8;
    let mut shares = Vec::new();
    for which in 0..3 {
        let [traced, surrogate] = fields(which);
        let exact = exact(&traced, WIDTH);
        for (method, rounds) in [(Method::TwoLevel, 1), (Method::TwoLevel, 4), (Method::Marched, 2)] {
            let found = |seed: u64| {
                let mut renderer = renderer(WIDTH, 100 + seed);
                let (mut picture, mut last) = (Picture::default(), None);
                for number in 0..rounds {
                    let round = round(&surrogate, (method, false), 1.0, number);
                    last = renderer.refine(&mut picture, &round, &mut Traced(&traced));
                }
                let film = last.unwrap().0;
                let square = |i: usize| (0..3).map(|k| (f64::from(film.rgba[i][k]) - exact[i][k]).powi(2)).sum::<f64>() / 3.0;
                let lit: Vec<usize> = (0..exact.len()).filter(|&i| film.rgba[i][3] > 0.01).collect();
                let held = lit.iter().filter(|&&i| square(i) <= (1.96 * f64::from(film.error[i])).powi(2)).count();
                held as f64 / lit.len() as f64
            };
            let held = (0..SEEDS).into_par_iter().map(found).sum::<f64>() / SEEDS as f64;
            println!("field {which}, {method:?}, {rounds} rounds: {:.1} % of the lit pixels", 100.0 * held);
            shares.push(held);
        }
    }
    let mean = shares.iter().sum::<f64>() / shares.len() as f64;
    assert!((0.93..0.98).contains(&mean) && shares.iter().all(|share| (0.88..0.99).contains(share)), "{mean:.3}: {shares:.3?}");
}

/// Fails if the estimate alone decides: most of the frames that it picks are lucky ones.
#[test]
fn a_target_is_reached_when_it_is_met() {
    const WIDTH: usize = 32;
    const MOST: f64 = 4e-3;
    const SEEDS: u64 = 24;
    let target = Target::Relmse(MOST);
    let [traced, surrogate] = fields(1);
    let exact = exact(&traced, WIDTH);
    let reached = |seed: u64| {
        let mut renderer = renderer(WIDTH, 100 + seed);
        let (mut picture, mut early) = (Picture::default(), None);
        for number in 0..400 {
            let round = round(&surrogate, (Method::TwoLevel, false), 1.0, number);
            let (film, _, error) = renderer.refine(&mut picture, &round, &mut Traced(&traced)).unwrap();
            let missed = true_square(&film, &exact, |c| 1.0 / (c * c + 0.01)) / MOST;
            if error.relmse.value <= MOST {
                early.get_or_insert(missed);
            }
            if target.is_met_by(&error) {
                assert!(error.relmse.value <= MOST && error.relmse.high <= 1.2 * MOST);
                return [missed, early.unwrap(), number as f64];
            }
        }
        panic!("{target:?} is not reached");
    };
    let found: Vec<[f64; 3]> = (0..SEEDS).into_par_iter().map(reached).collect();
    let held = |which: usize| found.iter().filter(|found| found[which] <= 1.2).count() * 100 >= found.len() * 93;
    assert!(held(0), "{found:.2?}");
    assert!(!held(1), "the estimate alone would do: {found:.2?}");
}

/// Half a pair a pixel and round, spread evenly: the second round completes the picture.
#[test]
fn a_sum_is_called_unbiased_once_every_pixel_has_samples() {
    let [traced, surrogate] = fields(0);
    let mut renderer = renderer(32, 5);
    let mut picture = Picture::default();
    let unbiased = [0, 1].map(|number| {
        let round = round(&surrogate, (Method::TwoLevel, true), 1.0, number);
        renderer.refine(&mut picture, &round, &mut Traced(&traced)).unwrap().2.unbiased
    });
    assert_eq!(unbiased, [false, true]);
}

/// A table too coarse to show the field's waves, which are in every pixel and in all scales of the transform. Fails if gains do not go to
/// 1, or if marching does not become finer with the samples.
#[test]
#[allow(clippy::print_stdout)]
fn a_shrunk_correction_converges_with_its_samples() {
    const WIDTH: usize = 32;
    /// Pictures of 1, 4, 16, ... 4096 samples a pixel; that of 64.
    const PICTURES: i32 = 7;
    const MANY: usize = 3;
    /// Root mean square error with four times the samples. Independent samples give 1/2, and what marching leaves, whose light volume stays
    /// a quarter of the nodes apart, falls later.
    const FOURFOLD: f64 = 0.7;
    /// Shrinkage adds nothing to the error of the plain sum in the mean, and marching a tenth (the root of 1.2). The ratio scatters by 3 %,
    /// three times.
    const MOST: f64 = 1.2;
    let waves = |p: [f32; 3]| 0.4 + 0.4 * (31.0 * p[0] + 9.0 * p[1] + 3.0 * p[2]).sin();
    let (traced, surrogate) = (nodes(waves), nodes_along(5, waves));
    let exact = exact(&traced, WIDTH);
    let errors = |sum: bool| -> Vec<f64> {
        let mut renderer = renderer(WIDTH, 7);
        let mut picture = Picture::default();
        let error_of = |number: i32| {
            let all = 4_f64.powi(number);
            let (method, samples) = (Method::TwoLevel, if number > 0 { 0.75 * all } else { all });
            let round = round(&surrogate, (method, sum), samples, number as u64);
            let (film, _, stated) = renderer.refine(&mut picture, &round, &mut Traced(&traced)).unwrap();
            assert!((stated.samples_per_pixel / all - 1.0).abs() < 0.05, "{} samples, not {all}", stated.samples_per_pixel);
            true_square(&film, &exact, |_| 1.0).sqrt()
        };
        (0..PICTURES).map(error_of).collect()
    };
    let [shrunk, summed] = [false, true].map(errors);
    println!("{shrunk:.5?}, sum {summed:.5?}");
    assert!(shrunk.windows(2).all(|pair| pair[1] < pair[0]), "{shrunk:.5?}");
    assert!(shrunk[MANY..].windows(2).all(|pair| pair[1] <= FOURFOLD * pair[0]), "{shrunk:.5?}");
    assert!(shrunk.iter().zip(&summed).all(|(shrunk, summed)| *shrunk <= MOST * summed), "{shrunk:.5?}, sum {summed:.5?}");
}
