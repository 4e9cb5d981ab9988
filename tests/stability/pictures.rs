//! Pictures: majorants that are too low, marching that is too coarse, corrections whose variance few samples show.

use crate::sweep::{rms, row};
use ridgewatch::field::Domain;
use ridgewatch::render::smooth::{LightVolume, Medium, Nodes, Picture, RaySum, Refinement, ToLight};
use ridgewatch::render::{CameraSettings, Film, LightSettings, LogStretch, Method, RenderSettings, Renderer, Scene, TransferSettings};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

static NEVER: AtomicBool = AtomicBool::new(false);

struct Field<F>(F);

impl<F: Fn([f32; 3]) -> f32> LogStretch for Field<F> {
    fn evaluate(&mut self, points: &[[f32; 3]], log_stretch: &mut [f32], traced: &mut [bool]) {
        points.iter().zip(log_stretch).for_each(|(p, s)| *s = (self.0)(*p));
        traced.fill(true);
    }
}

fn cube() -> Domain {
    Domain::cuboid([0.0; 3], [1.0; 3])
}

/// The unit cube fills the picture in parallel projection along -z; the ramp is the FTLE.
fn scene(width: usize, extinction: f64, majorant_cells: Option<[usize; 3]>, seed: u64) -> Scene {
    let camera =
        CameraSettings { eye: [0.5, 0.5, 1.5], look_at: [0.5, 0.5, 1.0], up: [0.0, 1.0, 0.0], field_of_view: 90.0, orthographic: true };
    Scene {
        camera,
        light: LightSettings::directional([0.3, 0.2, -1.0], 4.0 * std::f64::consts::PI),
        transfer: TransferSettings {
            low: Some(0.0),
            high: Some(1.0),
            extinction: Some(extinction),
            albedo: [vec![0.8], vec![0.8], vec![0.8]],
        },
        settings: RenderSettings { width, height: width, background: [0.0; 3], majorant_cells, ..RenderSettings::default() },
        seed,
        scale: [1.0; 3],
    }
}

/// Mean opacity of a film and its standard error, from the spread of the pixels.
fn opacity(film: &Film) -> (f64, f64) {
    let n = film.rgba.len() as f64;
    let mean = film.rgba.iter().map(|p| f64::from(p[3])).sum::<f64>() / n;
    let variance = film.rgba.iter().map(|p| (f64::from(p[3]) - mean).powi(2)).sum::<f64>() / (n - 1.0);
    (mean, (variance / n).sqrt())
}

#[test]
fn majorant_too_low() {
    const EXTINCTION: f64 = 5.0;
    const RAMP: f64 = 0.6;
    const SEEN: usize = 1_000_000;
    let truth = 1.0 - (-EXTINCTION * RAMP).exp();
    let frames = |low: f64| {
        let mut renderer = Renderer::new(scene(32, EXTINCTION, Some([1; 3]), 3), &cube(), 1.0).unwrap();
        // Values whose margins (a tenth, 0.02 and 8 over their number; see `src/render/majorant.rs`) give the wanted majorant.
        let told = if low > 0.0 { (RAMP * (1.0 - low) - 0.02 - 8.0 / SEEN as f64) / 1.1 } else { RAMP };
        renderer.observe(&vec![[0.5; 3]; SEEN], &vec![told as f32; SEEN]);
        [0, 1].map(|frame| {
            let (film, stats) = renderer.render(frame, &mut Field(|_| RAMP as f32), 256, None, &NEVER).unwrap();
            (opacity(&film), stats.majorant_exceeded as f64 / stats.queries as f64)
        })
    };
    let sweep: Vec<(f64, [((f64, f64), f64); 2])> =
        [0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9].map(|low| (low, frames(low))).to_vec();
    let clamped = |low: f64| 1.0 - (-EXTINCTION * RAMP * (1.0 - low)).exp() - truth;
    let usual = sweep[0].1[0].0.1;
    for (low, [((first, error), exceeded), ((second, error2), exceeded2)]) in &sweep {
        println!(
            "{:.0} % low: {first:.4} +- {error:.4} ({:.0} % above; unweighted {:+.3}), next frame {second:.4} +- {error2:.4} ({exceeded2})",
            100.0 * low,
            100.0 * exceeded,
            clamped(*low)
        );
        // Every query sees the same extinction, so that all or none are above the majorant.
        assert_eq!(*exceeded > 0.0, *low > 0.0, "what is above its majorant is counted");
        assert_eq!(*exceeded2, 0.0, "the next frame's majorant is raised");
        assert!((second - truth).abs() < 4.0 * error2 && *error2 < 1.5 * usual, "{low}: {second} +- {error2}");
        if *low <= 0.5 {
            assert!((first - truth).abs() < 4.0 * error, "weights leave no bias: {first} +- {error} of {truth}");
            assert!(*low < 0.15 || 4.0 * error < 0.9 * clamped(*low).abs(), "and without them the test would see one: {low}");
        }
    }
    let fails = sweep.iter().find(|(_, [((_, error), _), _])| *error > 0.1 * truth).expect("weights fail in the end");
    assert!((0.5..0.9).contains(&fails.0), "{fails:?}");
    let at = |low: f64| sweep.iter().find(|s| (s.0 - low).abs() < 1e-9).unwrap().1[0].0;
    let text: Vec<String> =
        [0.2, 0.5, 0.9].map(|low| format!("{:.0} % low {:+.3} ± {:.3}", 100.0 * low, at(low).0 - truth, at(low).1)).to_vec();
    row([
        "majorant too low",
        &format!("{:.0} % too low: one frame's noise is above 10 %", 100.0 * fails.0),
        "`majorant_exceeded`",
        "weights collisions (no bias), and raises the majorant for the next frame",
        &format!(
            "opacity, first frame: {}; without weights {:+.2}, {:+.2}, {:+.2}; next frame ± {:.4}",
            text.join(", "),
            clamped(0.2),
            clamped(0.5),
            clamped(0.9),
            at(0.0).1
        ),
        "majorant_too_low",
    ]);
}

/// Nodes of a unit cube.
fn nodes(n: usize, of: impl Fn([f32; 3]) -> f32) -> Nodes {
    Nodes::new([n; 3], Arc::new((0..n * n * n).map(|i| of(Nodes::unit([n; 3], i))).collect()))
}

/// Radiance of every pixel, the mean of its first rays. Steps are shares of the distance between nodes; a `light` of 0: by the light volume.
fn marched(renderer: &Renderer, nodes: &Nodes, rays: u64, step: f32, light: f32) -> Vec<f64> {
    let scene = renderer.frame_scene(0);
    let medium = Medium { scene: &scene, nodes, missing: None };
    let volume = (light == 0.0).then(|| LightVolume::new(&medium, 1 << 24, 1));
    let spacing = medium.spacing() as f32;
    let light = volume.as_ref().map_or(ToLight::March(light * spacing), ToLight::Volume);
    (0..(scene.width * scene.height) as u32)
        .map(|pixel| {
            let mut sum = RaySum::default();
            (0..rays).for_each(|j| sum.add(&medium.ray(pixel, j, step * spacing, light, false)));
            f64::from(sum.radiance[0]) / rays as f64
        })
        .collect()
}

#[test]
fn marching_too_coarse() {
    let nodes = nodes(9, |p| 0.5 + 0.5 * (5.0 * p[0] + 2.0 * p[2]).sin() * (4.0 * p[1] - 2.0 * p[2]).cos());
    let mut found = Vec::new();
    for extinction in [0.5, 2.0, 8.0, 32.0, 128.0] {
        let scene = scene(16, extinction, None, 7);
        let mut renderer = Renderer::new(scene.clone(), &cube(), 1.0).unwrap();

        let exact = marched(&renderer, &nodes, 2, 1.0 / 16.0, 1.0 / 16.0);

        let size = rms(exact.iter().copied());
        let error = |found: &[f64]| rms(found.iter().zip(&exact).map(|(a, b)| a - b)) / size;

        let (step, light) =
            (error(&marched(&renderer, &nodes, 2, 1.0, 1.0 / 16.0)), error(&marched(&renderer, &nodes, 2, 1.0 / 16.0, 0.0)));
        let first = error(&marched(&renderer, &nodes, 2, 1.0, 0.0));

        // The program's own picture: it is told nothing of the truth, and refines where its audit asks for it.
        let mut picture = Picture::default();

        let (mut stated, mut found_at_last) = (0.0, 0.0);
        let truth = marched(&renderer, &nodes, 64, 1.0 / 16.0, 1.0 / 4.0);
        for number in 0..6 {
            let round =
                Refinement { nodes: &nodes, missing: None, method: Method::Marched, sum: false, samples: 2.0, number, stop: &NEVER };
            let mut answers = Field(|p: [f32; 3]| nodes.at(p));

            let (film, _, error) = renderer.refine(&mut picture, &round, &mut answers).unwrap();
            stated = error.march_rms / size;
            found_at_last = rms(film.rgba.iter().zip(&truth).map(|(p, t)| f64::from(p[0]) - t)) / size;
        }
        println!(
            "extinction {extinction}: step {step:.1e}, light volume {light:.1e}, both {first:.1e}; in the end {found_at_last:.1e}, stated {stated:.1e}"
        );
        found.push((extinction, first, stated, found_at_last));
    }

    let fails = found.iter().find(|f| f.1 > 0.02).expect("a node's step fails in the end");
    let last = found[found.len() - 1];
    assert!(fails.0 > found[0].0, "{found:?}");

    assert!(last.3 < 0.3 * last.1, "marching gets finer: {last:?}");

    // The audit compares the first two rays of a pixel with the next two, which are nearer to one another than to the mean over the pixel.
    assert!(found.iter().all(|f| f.2 > 0.33 * f.3), "and states its error to a factor of three: {found:?}");

    row([
        "marching step and light volume too coarse",
        &format!("optical depth of a node above {:.1} (radiance off by 2 %)", fails.0 / 8.0),
        "`picture_error.march_rms`",
        "compares random pixels with a finer march, and halves the step down to a sixteenth",
        &format!(
            "first march {:.1} % at that depth, {:.0} % at {:.0}; after six frames there {:.1} %, stated {:.1} %",
            100.0 * fails.1,
            100.0 * last.1,
            last.0 / 8.0,
            100.0 * last.3,
            100.0 * last.2
        ),
        "marching_too_coarse",
    ]);
}

/// Mean square error over all pixels and channels, with the noise of the truth removed by the product of two halves.
fn true_square(film: &Film, [a, b]: &[Film; 2]) -> f64 {
    let lit: Vec<usize> = (0..film.rgba.len()).filter(|&i| film.rgba[i][3] > 0.01).collect();
    let d = |other: &Film, i: usize, k: usize| f64::from(film.rgba[i][k] - other.rgba[i][k]);
    lit.iter().flat_map(|&i| (0..3).map(move |k| (i, k))).map(|(i, k)| d(a, i, k) * d(b, i, k)).sum::<f64>() / (3 * lit.len()) as f64
}

#[test]
fn a_correction_that_few_samples_hit() {
    const WIDTH: usize = 32;
    const SEEDS: u64 = 24;
    let surrogate = nodes(9, |_| 0.1);
    let mut found = Vec::new();
    for radius in [0.2f32, 0.1, 0.05, 0.025] {
        // A tube along the view that the surrogate does not know.
        let field = move |p: [f32; 3]| if (p[0] - 0.53).hypot(p[1] - 0.47) < radius { 1.0 } else { 0.1 };
        let truth = [1, 2].map(|seed| {
            let mut renderer = Renderer::new(scene(WIDTH, 5.0, None, 1000 + seed), &cube(), 1.0).unwrap();
            let mut sum = renderer.render(0, &mut Field(field), 256, None, &NEVER).unwrap().0;
            for frame in 1..4 {
                sum.accumulate(&renderer.render(frame, &mut Field(field), 256, None, &NEVER).unwrap().0).unwrap();
            }
            sum
        });
        let (mut below, mut inside, mut stated, mut true_mean) = (0, 0, 0.0, 0.0);
        for seed in 0..SEEDS {
            let mut renderer = Renderer::new(scene(WIDTH, 5.0, None, seed), &cube(), 1.0).unwrap();
            let round = Refinement {
                nodes: &surrogate,
                missing: None,
                method: Method::TwoLevel,
                sum: false,
                samples: 2.0,
                number: 0,
                stop: &NEVER,
            };
            let (film, _, error) = renderer.refine(&mut Picture::default(), &round, &mut Field(field)).unwrap();

            let exact = true_square(&film, &truth).max(0.0).sqrt();
            assert!(error.rms.value > 0.0 && error.rms.value.is_finite(), "radius {radius}: {:?}", error.rms);

            below += u32::from(error.rms.high < exact);
            inside += u32::from((error.rms.low..=error.rms.high).contains(&exact));
            stated += error.rms.value / SEEDS as f64;
            true_mean += exact / SEEDS as f64;
        }
        println!("radius {radius}: stated {stated:.4}, true {true_mean:.4}, {inside} of {SEEDS} inside, {below} too small");
        found.push((radius, stated, true_mean, inside, below));
    }
    // Pixels that the tube covers.
    let pixels = |radius: f32| std::f32::consts::PI * (radius * WIDTH as f32).powi(2);
    let held = |f: &(f32, f64, f64, u32, u32)| f.3 * 5 >= SEEDS as u32 * 4;
    assert!(held(&found[0]), "a wide one is seen: {:?}", found[0]);
    let fails = found.iter().find(|f| !held(f));
    let last = found[found.len() - 1];
    row([
        "correction that few samples hit",
        &fails.map_or(format!("not down to {:.0} pixels at 2 samples a pixel", pixels(last.0)), |f| {
            format!("a ridge of {:.0} pixels at 2 samples a pixel ({} of {SEEDS} intervals hold)", pixels(f.0), f.3)
        }),
        "`picture_error`, its interval",
        "scores each half of the samples by the other; states no less than half the standard error",
        &format!(
            "rms stated {:.4}, true {:.4} for {:.0} pixels; {:.4}, {:.4} for {:.0}",
            found[0].1,
            found[0].2,
            pixels(found[0].0),
            last.1,
            last.2,
            pixels(last.0)
        ),
        "a_correction_that_few_samples_hit",
    ]);
}
