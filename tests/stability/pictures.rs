//! Pictures: majorants that are too low, marching that is too coarse, corrections whose variance few samples show.

use crate::sweep::{rms, row};
use ridgewatch::field::{Domain, DomainPoint, UnitPoint};
use ridgewatch::render::smooth::{
    AuditedPixel, FIRST_AUDIT_RAY, LightVolume, MarchControl, Medium, NET, Nodes, Picture, RaySum, Refinement, StepsError, ToLight, ToneMap,
};
use ridgewatch::render::{CameraSettings, Film, LightSettings, LogStretch, Method, RenderSettings, Renderer, Scene, TransferSettings};
use std::cell::Cell;
use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

static NEVER: AtomicBool = AtomicBool::new(false);

struct Field<F>(F);

impl<F: Fn([f32; 3]) -> f32> LogStretch for Field<F> {
    fn evaluate(&mut self, points: &[DomainPoint], log_stretch: &mut [f32], traced: &mut [bool]) {
        points.iter().zip(log_stretch).for_each(|(p, s)| *s = (self.0)(p.0));
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
        plane: None,
    }
}

/// Mean opacity of a film and its standard error, from the spread of the pixels.
fn opacity(film: &Film) -> (f64, f64) {
    let n = film.rgba.len() as f64;
    let mean = film.rgba.iter().map(|p| f64::from(p[3])).sum::<f64>() / n;
    let variance = film.rgba.iter().map(|p| (f64::from(p[3]) - mean).powi(2)).sum::<f64>() / (n - 1.0);
    (mean, (variance / n).sqrt())
}

/// Fails unless the path and the next frame raise a majorant that was exceeded, and without the weights of collisions above it.
#[test]
fn majorant_too_low() {
    const EXTINCTION: f64 = 5.0;
    const RAMP: f64 = 0.6;
    const SEEN: usize = 1_000_000;
    const WIDTH: usize = 32;
    const SAMPLES: usize = 256;
    let truth = 1.0 - (-EXTINCTION * RAMP).exp();
    let frames = |low: f64| {
        let mut renderer = Renderer::new(scene(WIDTH, EXTINCTION, Some([1; 3]), 3), &cube(), 1.0).unwrap();
        // Values whose margins (a tenth, 0.02 and 8 over their number; see `src/render/majorant.rs`) give the wanted majorant.
        let told = if low > 0.0 { (RAMP * (1.0 - low) - 0.02 - 8.0 / SEEN as f64) / 1.1 } else { RAMP };
        renderer.observe(&vec![DomainPoint([0.5; 3]); SEEN], &vec![told as f32; SEEN]);
        [0, 1].map(|frame| {
            let (film, stats) = renderer.render(frame, &mut Field(|_| RAMP as f32), SAMPLES, None, &NEVER).unwrap();
            (opacity(&film), stats.majorant_exceeded as f64 / stats.queries as f64)
        })
    };
    let sweep: Vec<(f64, [((f64, f64), f64); 2])> =
        // The margin of 0.02 alone is 96.7 % too low.
        [0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.966].map(|low| (low, frames(low))).to_vec();
    let clamped = |low: f64| 1.0 - (-EXTINCTION * RAMP * (1.0 - low)).exp() - truth;
    let usual = sweep[0].1[0].0.1;
    for (low, [((first, error), exceeded), ((second, error2), exceeded2)]) in &sweep {
        println!(
            "{:.1} % low: {first:.4} +- {error:.4} ({:.0} % above; unweighted {:+.3}), next frame {second:.4} +- {error2:.4} ({exceeded2})",
            100.0 * low,
            100.0 * exceeded,
            clamped(*low)
        );
        assert_eq!(*exceeded > 0.0, *low > 0.0, "what is above its majorant is counted");
        assert_eq!(*exceeded2, 0.0, "the next frame's majorant is raised");
        assert!((second - truth).abs() < 4.0 * error2 && *error2 < 1.5 * usual, "{low}: {second} +- {error2}");
        assert!((first - truth).abs() < 4.0 * error, "weights leave no bias: {first} +- {error} of {truth}");
        assert!(*low < 0.15 || 4.0 * error < 0.9 * clamped(*low).abs(), "and without them the test would see one: {low}");
        // With a majorant that stays too low, weights multiply: 90 % too low, the noise of a frame is larger than the opacity.
        assert!(*error < 0.05 * truth, "{low}: {error}");
    }
    let at = |low: f64| sweep.iter().find(|s| (s.0 - low).abs() < 1e-9).unwrap().1[0].0;
    // Standard deviation of a pixel, as a share of the opacity.
    let pixel = |error: f64| error * WIDTH as f64 / truth;
    let (fails, (_, error)) = sweep.iter().map(|s| (s.0, s.1[0].0)).find(|s| pixel(s.1.1) > 1.0).expect("the noise of a pixel hides it");
    let text: Vec<String> =
        [0.2, 0.5, 0.9].map(|low| format!("{:.0} % low {:+.3} ± {:.3}", 100.0 * low, at(low).0 - truth, at(low).1)).to_vec();
    row([
        "majorant too low",
        &format!(
            "{:.1} % too low: the noise of a pixel of {SAMPLES} samples is {:.2} of its opacity; of the whole picture {:.1} %",
            100.0 * fails,
            pixel(error),
            100.0 * error / truth
        ),
        "`majorant_exceeded`",
        "weights collisions (no bias); the path takes the largest extinction from there on, the next frame raises the majorant; none is below \
         2 % of the largest extinction",
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
    Nodes::new([n; 3], Arc::new((0..n * n * n).map(|i| of(Nodes::unit([n; 3], i).0)).collect()))
}

/// Radiance of every pixel, the mean of some of its rays. Steps are shares of the distance between nodes; a `light` of 0: by the light volume.
fn marched(renderer: &Renderer, nodes: &Nodes, rays: Range<u64>, step: f32, light: f32) -> Vec<f64> {
    let scene = renderer.frame_scene(0);
    let medium = Medium { scene: &scene, nodes, missing: None };
    let volume = (light == 0.0).then(|| LightVolume::new(&medium, 1 << 24, 1));
    let spacing = medium.spacing() as f32;
    let light = volume.as_ref().map_or(ToLight::March(light * spacing), ToLight::Volume);
    (0..(scene.width * scene.height) as u32)
        .map(|pixel| {
            let mut sum = RaySum::default();
            rays.clone().for_each(|j| sum.add(&medium.ray(pixel, j, step * spacing, light, false)));
            f64::from(sum.radiance[0]) / (rays.end - rays.start) as f64
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
        let exact = marched(&renderer, &nodes, 0..2, 1.0 / 16.0, 1.0 / 16.0);
        let size = rms(exact.iter().copied());
        let error = |found: &[f64]| rms(found.iter().zip(&exact).map(|(a, b)| a - b)) / size;
        let (step, light) =
            (error(&marched(&renderer, &nodes, 0..2, 1.0, 1.0 / 16.0)), error(&marched(&renderer, &nodes, 0..2, 1.0 / 16.0, 0.0)));
        let first = error(&marched(&renderer, &nodes, 0..2, 1.0, 0.0));
        // The program's own picture: it is told nothing of the truth, and refines where its audit asks for it.
        let mut picture = Picture::default();
        let (mut stated, mut last) = (0.0, None);
        for number in 0..6 {
            let round = Refinement {
                nodes: &nodes,
                missing: None,
                method: Method::Marched,
                sum: false,
                samples: 2.0,
                budget: None,
                steps_error: StepsError::default(),
                number,
                stop: &NEVER,
            };
            let mut answers = Field(|p: [f32; 3]| nodes.at(UnitPoint(p)));
            let (film, _, error) = renderer.refine(&mut picture, &round, &mut answers).unwrap();
            stated = error.march_rms / size;
            last = Some((film, error.rays_per_pixel));
        }
        // The same rays, so that the pixel filter is the same.
        let (film, rays) = last.unwrap();
        let truth = marched(&renderer, &nodes, 0..rays, 1.0 / 16.0, 1.0 / 4.0);
        let found_at_last = rms(film.rgba.iter().zip(&truth).map(|(p, t)| f64::from(p[0]) - t)) / size;
        println!(
            "extinction {extinction}: step {step:.1e}, light volume {light:.1e}, both {first:.1e}; in the end {found_at_last:.1e}, stated {stated:.1e}"
        );
        found.push((extinction, first, stated, found_at_last));
    }
    let fails = found.iter().find(|f| f.1 > 0.02).expect("a node's step fails in the end");
    let last = found[found.len() - 1];
    assert!(fails.0 > found[0].0, "{found:?}");
    assert!(last.3 < 0.3 * last.1, "marching gets finer: {last:?}");
    // Measured on 24 pixels, a few of which make most of the sum of squares.
    assert!(found.iter().all(|f| f.2 > 0.33 * f.3), "and states its error to a factor of three: {found:?}");
    row([
        "marching step and light volume too coarse",
        &format!("optical depth of a node of {:.2} (radiance off by {:.1} %)", fails.0 / 8.0, 100.0 * fails.1),
        "`picture_error.march_rms`",
        "compares random pixels with a finer march, and halves the step down to a sixteenth",
        &format!(
            "first march {:.0} % at a depth of {:.0}; after six frames there {:.1} %, stated {:.1} %",
            100.0 * last.1,
            last.0 / 8.0,
            100.0 * last.3,
            100.0 * last.2
        ),
        "marching_too_coarse",
    ]);
}

#[test]
fn few_rays_a_pixel() {
    const WIDTH: usize = 16;
    const FINER: usize = 8;
    let nodes = nodes(9, |p| 0.5 + 0.5 * (5.0 * p[0] + 2.0 * p[2]).sin() * (4.0 * p[1] - 2.0 * p[2]).cos());
    let of = |width: usize, rays: Range<u64>| {
        marched(&Renderer::new(scene(width, 8.0, None, 7), &cube(), 1.0).unwrap(), &nodes, rays, 0.25, 0.25)
    };
    // Means over the pixels of a finer picture: no sequence of offsets within a pixel is taken to be right.
    let fine = of(WIDTH * FINER, 0..4);
    let mean = |i: usize| {
        let [x, y] = [i % WIDTH, i / WIDTH].map(|n| n * FINER);
        (0..FINER * FINER).map(|j| fine[(y + j / FINER) * WIDTH * FINER + x + j % FINER]).sum::<f64>() / (FINER * FINER) as f64
    };
    let truth: Vec<f64> = (0..WIDTH * WIDTH).map(mean).collect();
    let size = rms(truth.iter().copied());
    // The program's own estimate: the rays of each pixel against two nets.
    let nets = [FIRST_AUDIT_RAY, FIRST_AUDIT_RAY + NET].map(|first| of(WIDTH, first..first + NET));
    let found: Vec<(u64, f64, f64)> = [1, 2, 4, 8, 16, 32]
        .map(|rays| {
            let shown = of(WIDTH, 0..rays);
            let mut control = MarchControl::default();
            let audited = shown.iter().zip(nets[0].iter().zip(&nets[1])).map(|(shown, (one, other))| AuditedPixel {
                shown: [*shown, *shown, *shown, 1.0],
                nets: [[*one; 3], [*other; 3]],
                ..AuditedPixel::default()
            });
            control.audit(audited, ToneMap::new([1.0, 0.5, 1.0]));
            let error = rms(shown.iter().zip(&truth).map(|(a, b)| a - b));
            (rays, error / size, control.error().sqrt() / size)
        })
        .to_vec();
    found.iter().for_each(|(rays, error, stated)| println!("{rays} rays: true {error:.1e}, stated {stated:.1e}"));
    let fails = found.iter().rev().find(|f| f.1 > 0.01).expect("few rays are not enough");
    let most = found[found.len() - 1];
    // Independent rays would leave 1 / sqrt(32).
    assert!(most.1 < 0.5 * found[0].1, "more rays, less error: {found:?}");
    assert!(found.iter().all(|f| (f.2 / f.1 - 1.0).abs() < 0.25), "stated: {found:?}");
    row([
        "few rays a pixel",
        &format!("{} rays (radiance off by {:.1} % in a picture of {WIDTH}x{WIDTH})", fails.0, 100.0 * fails.1),
        "`picture_error.march_rms`",
        "adds rays while their error is above a tenth of the rest, up to 64",
        &format!("{} rays: {:.2} %, stated {:.2} %", most.0, 100.0 * most.1, 100.0 * most.2),
        "few_rays_a_pixel",
    ]);
}

/// Mean square error over all pixels and channels, with the noise of the truth removed by the product of two halves.
fn true_square(film: &Film, [a, b]: &[Film; 2]) -> f64 {
    let lit: Vec<usize> = (0..film.rgba.len()).filter(|&i| film.rgba[i][3] > 0.01).collect();
    let d = |other: &Film, i: usize, k: usize| f64::from(film.rgba[i][k] - other.rgba[i][k]);
    lit.iter().flat_map(|&i| (0..3).map(move |k| (i, k))).map(|(i, k)| d(a, i, k) * d(b, i, k)).sum::<f64>() / (3 * lit.len()) as f64
}

/// A round of `two_level` with this many samples a pixel.
fn corrected(nodes: &Nodes, samples: f64) -> Refinement<'_> {
    Refinement {
        nodes,
        missing: None,
        method: Method::TwoLevel,
        sum: false,
        samples,
        budget: None,
        steps_error: StepsError::default(),
        number: 0,
        stop: &NEVER,
    }
}

/// Fails without the floor of half the standard error.
#[test]
fn a_correction_that_few_samples_hit() {
    const WIDTH: usize = 32;
    const SEEDS: u64 = 24;
    // A tube along the view that the surrogate does not know, of ramp 1, in a ground of this ramp.
    let of = |ground: f32, radius: f32| {
        let surrogate = nodes(9, |_| ground);
        let field = move |p: [f32; 3]| if (p[0] - 0.53).hypot(p[1] - 0.47) < radius { 1.0 } else { ground };
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
            let round = corrected(&surrogate, 2.0);
            let (film, _, error) = renderer.refine(&mut Picture::default(), &round, &mut Field(field)).unwrap();
            let exact = true_square(&film, &truth).max(0.0).sqrt();
            assert!(error.rms.value.is_finite(), "radius {radius}: {:?}", error.rms);
            assert!(ground < 0.1 || error.rms.value > 0.0, "radius {radius}: {:?}", error.rms);
            below += u32::from(error.rms.high < exact);
            inside += u32::from((error.rms.low..=error.rms.high).contains(&exact));
            stated += error.rms.value / SEEDS as f64;
            true_mean += exact / SEEDS as f64;
        }
        println!("{ground}, radius {radius}: stated {stated:.4}, true {true_mean:.4}, {inside} of {SEEDS} inside, {below} too small");
        (radius, stated, true_mean, inside, below)
    };
    let found = [0.2, 0.1, 0.05, 0.025].map(|radius| of(0.1, radius));
    // Where no pair meets a difference, the interval allows for one as large as the radiance shown: little, on a dim ground.
    let dim = [0.2, 0.05, 0.025, 0.0125, 0.00625].map(|radius| of(0.01, radius));
    // Pixels that the tube covers.
    let pixels = |radius: f32| std::f32::consts::PI * (radius * WIDTH as f32).powi(2);
    let held = |f: &(f32, f64, f64, u32, u32)| f.3 * 5 >= SEEDS as u32 * 4;
    assert!(held(&found[0]) && held(&dim[0]), "wide ones are seen: {:?} {:?}", found[0], dim[0]);
    let fails = dim.iter().find(|f| !held(f)).expect("thin ones are not met");
    assert!(fails.4 > 0, "what is not met is stated too small: {fails:?}");
    let last = found[found.len() - 1];
    let ten_times = found
        .iter()
        .find(|f| !held(f))
        .map_or(format!("not down to {:.0}", pixels(last.0)), |f| format!("{:.0} ({} intervals hold)", pixels(f.0), f.3));
    row([
        "correction that few samples hit",
        &format!(
            "a ridge of {:.1} pixels at 2 samples a pixel, 100 times as dense as what is around it ({} of {SEEDS} intervals hold); 10 times: \
             {ten_times}",
            pixels(fails.0),
            fails.3
        ),
        "`picture_error`, its interval",
        "scores each half of the samples by the other; states no less than half the standard error",
        &format!(
            "rms stated {:.4}, true {:.4} there; 10 times as dense {:.4}, {:.4} for {:.0} pixels; {:.4}, {:.4} for {:.0}",
            fails.1,
            fails.2,
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

/// Fails without the floor on the variance of a tile.
#[test]
fn a_tile_that_shows_no_difference() {
    const WIDTH: usize = 32;
    const FRAMES: usize = 6;
    const SEEDS: u64 = 8;
    let surrogate = nodes(9, |_| 0.1);
    // Wrong in the upper right tile alone, whose light comes through no other; in the lower left one a tube as thin as a part of a pixel.
    let in_tube = |p: &[f32; 3], radius: f32| (p[0] - 0.27).hypot(p[1] - 0.23) < radius;
    // In the lower left tile: samples of each frame, of the mean; the stated error of its corner, of the whole; the frame that first meets the tube.
    let run = |seed: u64, radius: f32| {
        let mut renderer = Renderer::new(scene(WIDTH, 5.0, None, seed), &cube(), 1.0).unwrap();
        let (mut picture, mut before, mut stated, mut shares, met) = (Picture::default(), 0.0, 0.0, Vec::new(), Cell::new(None));
        for frame in 1..=FRAMES {
            let round = corrected(&surrogate, 2.0);
            let mut answers = Field(|p: [f32; 3]| {
                if in_tube(&p, radius) {
                    met.set(met.get().or(Some(frame)));
                    return 1.0;
                }
                if p[0] > 0.5 && p[1] > 0.5 { 0.5 } else { 0.1 }
            });
            let (film, _, error) = renderer.refine(&mut picture, &round, &mut answers).unwrap();
            // The corner is farther from any difference than the error is averaged.
            stated = f64::from(film.error[WIDTH * (WIDTH - 1)]) / error.rms.value;
            let quiet = |i: &usize| i % WIDTH < WIDTH / 2 && i / WIDTH >= WIDTH / 2;
            let samples: f64 = (0..WIDTH * WIDTH).filter(quiet).map(|i| f64::from(film.samples[i])).sum();
            shares.push((samples - before) / (0.5 * (WIDTH * WIDTH) as f64));
            before = samples;
        }
        (shares, stated, met.get())
    };
    let (shares, stated, _) = run(0, 0.0);
    let later = shares[1..].iter().sum::<f64>() / (FRAMES - 1) as f64;
    println!("samples in a tile without differences, of the mean: {shares:.2?}; stated {stated:.3} of the mean error");
    // Even share 0.25, and 0.75 times the quotient of the deviations sqrt(0.02 / 4) and (1 + 3 sqrt(0.02 / 4)) / 4. Fails without the variance
    // floor, which leaves 0.25.
    let deviation = f64::sqrt(0.02 / 4.0);
    let expected = 0.25 + 0.75 * 4.0 * deviation / (1.0 + 3.0 * deviation);
    assert!((later / expected - 1.0).abs() < 0.1, "{later} {expected}");
    // A twentieth of the mean square. Fails without that floor.
    assert!(stated > 0.2, "{stated}");
    let mut found = Vec::new();
    for radius in [0.02f32, 0.01, 0.005, 0.0025] {
        let pixels = std::f64::consts::PI * f64::from(radius * WIDTH as f32).powi(2);
        let met = (0..SEEDS).filter(|seed| run(1 + seed, radius).2.is_some()).count();
        println!("tube of {pixels:.3} pixels: met in {met} of {SEEDS} runs of {FRAMES} frames");
        found.push((pixels, met));
    }
    assert_eq!(found[0].1, SEEDS as usize, "a pixel is met: {found:?}");
    let fails = found.iter().find(|f| f.1 * 2 < SEEDS as usize).expect("a thin one is not");
    // What a pixel of the tube shows at most, in shares of a picture without it.
    let radiance =
        |value: f32| rms(marched(&Renderer::new(scene(8, 5.0, None, 1), &cube(), 1.0).unwrap(), &nodes(9, |_| value), 0..4, 0.25, 0.25));
    let contrast = (radiance(1.0) / radiance(0.1) - 1.0).abs();
    row([
        "a tile that shows no difference",
        &format!("a ridge of {:.2} pixels in it (met in {} of {SEEDS} runs of {FRAMES} frames of 2 samples a pixel)", fails.0, fails.1),
        "layers `samples.count` and `error`",
        &format!(
            "spreads a quarter of the samples evenly and takes the variance as 2 % of the mean at least: {later:.2} of the mean samples"
        ),
        &format!("one pixel off by {:.0} % of its radiance; the tile states {stated:.2} of the mean error", 100.0 * fails.0 * contrast),
        "a_tile_that_shows_no_difference",
    ]);
}

/// Fails with the quantile of the normal distribution, and without the rule of three where no pair shows a difference.
#[test]
fn too_few_pairs_for_an_interval() {
    // Four tiles: the interval comes from one difference a tile.
    const WIDTH: usize = 32;
    const SEEDS: u64 = 24;
    let surrogate = nodes(9, |_| 0.1);
    let field = |p: [f32; 3]| 0.1 + 0.5 * p[0];
    let truth = [1, 2].map(|seed| {
        let mut renderer = Renderer::new(scene(WIDTH, 5.0, None, 1000 + seed), &cube(), 1.0).unwrap();
        renderer.render(0, &mut Field(field), 256, None, &NEVER).unwrap().0
    });
    let mut found = Vec::new();
    // No first picture takes fewer than one pair a tile.
    for pairs in [1024, 256, 64, 16, 4] {
        let samples = 2.0 * f64::from(pairs) / (WIDTH * WIDTH) as f64;
        let (mut known, mut inside, mut width, mut silent, mut errs) = (0, 0, 0.0, 0, 0.0);
        for seed in 0..SEEDS {
            let mut renderer = Renderer::new(scene(WIDTH, 5.0, None, seed), &cube(), 1.0).unwrap();
            let round = corrected(&surrogate, samples);
            let (film, _, error) = renderer.refine(&mut Picture::default(), &round, &mut Field(field)).unwrap();
            if !error.is_known() {
                continue;
            }
            let exact = true_square(&film, &truth).max(0.0).sqrt();
            known += 1;
            inside += u32::from((error.rms.low..=error.rms.high).contains(&exact));
            width += (error.rms.high - error.rms.low) / exact;
            errs += exact;
            // One pair a tile is in one quarter, and may show no difference.
            silent += u32::from(error.rms.value <= 1.001 * error.march_rms);
            assert!(pairs > 4 || error.rms.high > 1.5 * error.rms.low, "{:?}", error.rms);
        }
        println!(
            "{pairs} pairs: {known} of {SEEDS} known, {inside} inside, width {:.2}, {silent} show no difference",
            width / f64::from(known)
        );
        found.push((pairs, known, inside, width / f64::from(known), silent, errs / f64::from(known)));
    }
    let last = found[found.len() - 1];
    // Of 24 intervals of 95 %, 20 or more hold with a probability of 0.99.
    assert!(found.iter().all(|f| f.2 * 6 >= f.1 * 5), "intervals hold with any number of pairs: {found:?}");
    row([
        "too few pairs of samples for an interval",
        &format!(
            "none found down to one pair a tile, the fewest of a picture: {} in one of {WIDTH}x{WIDTH} ({} of {} intervals hold)",
            last.0, last.2, last.1
        ),
        "`picture_error`, its interval; `samples_per_pixel`",
        "takes Student's quantile for the number of tiles, and at least the rule of three",
        &format!(
            "interval {:.1} times as wide as the error, {:.4} rms; {:.1} times with {} pairs, {:.4}; with {} pairs {} of {} pictures show no difference",
            last.3, last.5, found[0].3, found[0].0, found[0].5, last.0, last.4, last.1
        ),
        "too_few_pairs_for_an_interval",
    ]);
}
