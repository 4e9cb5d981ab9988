//! Smooth pictures: marching and coupled samples against tracking, and the error that they state.

use crate::NEVER;
use ridgewatch::chart::most_wrong;
use ridgewatch::field::analytic::Analytic;
use ridgewatch::field::{Domain, DomainPoint, UnitPoint};
use ridgewatch::flow::{FlowMap, VelocitySource, cpu_tracer};
use ridgewatch::render::smooth::{IsMissing, LightVolume, Medium, Nodes, Picture, PictureError, RaySum, Refinement, StepsError, ToLight};
use ridgewatch::render::{CameraSettings, Film, LightSettings, LogStretch, Method, RenderSettings, Renderer, Scene, TransferSettings};
use ridgewatch::surrogate::network::NetworkSettings;
use ridgewatch::surrogate::{Kind, Predict, SurrogateSettings, build};
use std::sync::Arc;

const TAU: f64 = 2.0;

/// A field of log-stretch with ridges, and a corner without values.
fn field(DomainPoint(p): DomainPoint) -> f32 {
    1.0 + (5.0 * p[0] + 2.0 * p[2]).sin() * (6.0 * p[1] - p[2]).cos()
}

/// A surrogate that differs from it by up to 0.15 and misses a thin ridge.
fn nearby(p: DomainPoint) -> f32 {
    field(p) + 0.15 * (11.0 * p.0[0]).sin()
}

fn is_missing(DomainPoint(p): DomainPoint) -> bool {
    p[0] < 0.3 && p[1] < 0.4
}

struct Traced<F>(F);

impl<F: FnMut(DomainPoint) -> f32> LogStretch for Traced<F> {
    fn evaluate(&mut self, points: &[DomainPoint], log_stretch: &mut [f32], traced: &mut [bool]) {
        points.iter().zip(log_stretch).for_each(|(p, s)| *s = (self.0)(*p));
        traced.fill(true);
    }
}

fn cube() -> Domain {
    Domain::cuboid([0.0; 3], [1.0; 3])
}

fn slab() -> Domain {
    Domain::slab([0.0; 2], [1.0; 2], (0.0, 0.5))
}

fn nodes(domain: &Domain, shape: [usize; 3], of: impl Fn(DomainPoint) -> f32) -> Nodes {
    let count = shape.iter().product();
    Nodes::new(shape, Arc::new((0..count).map(|i| of(domain.from_unit(Nodes::unit(shape, i)))).collect()))
}

fn scene(domain: &Domain, width: usize, orthographic: bool, light: LightSettings) -> Scene {
    let camera = CameraSettings { eye: [0.8, -0.4, 1.9], look_at: [0.5, 0.5, 0.4], up: [0.0, 1.0, 0.2], field_of_view: 60.0, orthographic };
    let transfer = TransferSettings { low: Some(0.3), high: Some(0.9), extinction: Some(8.0), ..TransferSettings::default() };
    let settings = RenderSettings { width, height: width, background: [1.0, 0.7, 0.4], ..RenderSettings::default() };
    Scene::assemble(domain, Some(camera), Some(light), Some(transfer), settings, 5)
}

fn oblique() -> LightSettings {
    LightSettings::directional([0.6, 0.3, -1.0], 12.0)
}

fn point(position: [f64; 3]) -> LightSettings {
    LightSettings { direction: None, position: Some(position), radiance: [4.0; 3] }
}

/// A tracked picture of `frames` frames of 256 samples.
fn tracked(scene: &Scene, domain: &Domain, frames: u64, of: impl Fn(DomainPoint) -> f32) -> Film {
    let mut renderer = Renderer::new(scene.clone(), domain, TAU).unwrap();
    let mut answers = Traced(&of);
    // The first frame tightens the majorants.
    let mut sum = renderer.render(1000, &mut answers, 256, None, &NEVER).unwrap().0;
    for frame in 1..frames {
        sum.accumulate(&renderer.render(1000 + frame, &mut answers, 256, None, &NEVER).unwrap().0).unwrap();
    }
    sum
}

struct Smooth {
    renderer: Renderer,
    picture: Picture,
    rounds: u64,
}

impl Smooth {
    fn new(scene: &Scene, domain: &Domain) -> Self {
        Self { renderer: Renderer::new(scene.clone(), domain, TAU).unwrap(), picture: Picture::default(), rounds: 0 }
    }

    fn round(
        &mut self,
        nodes: &Nodes,
        missing: Option<IsMissing<'_>>,
        (method, sum, samples): (Method, bool, f64),
        of: impl Fn(DomainPoint) -> f32,
    ) -> (Film, PictureError) {
        let round = Refinement {
            nodes,
            missing,
            method,
            sum,
            samples,
            budget: None,
            steps_error: StepsError::default(),
            number: self.rounds,
            stop: &NEVER,
        };
        self.rounds += 1;
        let (film, _, error) = self.renderer.refine(&mut self.picture, &round, &mut Traced(of)).unwrap();
        (film, error)
    }
}

/// A picture by many rays with small steps and a fine light volume.
fn converged(medium: &Medium<'_>) -> Film {
    const RAYS: u64 = 64;
    let (width, height) = (medium.scene.width, medium.scene.height);
    let (step, volume) = (0.25 * medium.spacing() as f32, LightVolume::new(medium, 1 << 24, 4));
    let mut film = Film::new(width, height);
    for (pixel, rgba) in film.rgba.iter_mut().enumerate() {
        let mut sum = RaySum::default();
        (0..RAYS).for_each(|j| sum.add(&medium.ray(pixel as u32, j, step, ToLight::Volume(&volume), false)));
        let [red, green, blue] = sum.radiance;
        *rgba = [red, green, blue, sum.alpha].map(|c| c / RAYS as f32);
    }
    film
}

/// Deviation of the mean of every block of 8 x 8 pixels from that of a tracked picture, in standard errors of the latter; the variances of the
/// former are added. Returns root mean square and maximum over blocks and channels.
fn deviations(found: &Film, truth: &Film, variance: impl Fn(usize) -> f64) -> (f64, f64) {
    const BLOCK: usize = 8;
    let (mut square, mut count, mut most) = (0.0, 0.0, 0.0_f64);
    let [shown, expected] = [found, truth].map(Film::luminances);
    for y in (0..truth.height).step_by(BLOCK) {
        for x in (0..truth.width).step_by(BLOCK) {
            let block: Vec<usize> = (0..BLOCK * BLOCK).map(|i| (y + i / BLOCK) * truth.width + x + i % BLOCK).collect();
            let difference: f64 = block.iter().map(|&i| shown[i] - expected[i]).sum();
            let spread: f64 = block.iter().map(|&i| f64::from(truth.variance[i]) + variance(i)).sum();
            if spread > 0.0 {
                let deviation = difference / spread.sqrt();
                (square, count, most) = (square + deviation * deviation, count + 1.0, most.max(deviation.abs()));
            }
        }
    }
    (f64::sqrt(square / count), most)
}

/// A finer table answers for the same view: with as many rays as before, the picture becomes no coarser.
#[test]
fn other_nodes_get_as_many_rays_as_those_before() {
    let domain = slab();
    let scene = scene(&domain, 48, false, oblique());
    let of = |p: DomainPoint| 0.6 + 0.3 * (9.0 * p.0[0]).sin() * (7.0 * p.0[1]).cos();
    let mut smooth = Smooth::new(&scene, &domain);
    let coarse = nodes(&domain, [17, 17, 2], of);
    let how = (Method::Marched, false, 0.25);
    let rays =
        (0..40).map(|_| smooth.round(&coarse, None, how, of).1.rays_per_pixel).find(|rays| *rays > 4).expect("rays come with rounds");
    let finer = nodes(&domain, [33, 33, 2], of);
    let first = smooth.round(&finer, None, how, of).1;
    assert!(first.rays_per_pixel >= rays && first.samples_per_pixel < 1.0, "{first:?}, {rays} rays before");
}

#[test]
fn a_marched_picture_is_the_mean_of_tracked_ones() {
    for (what, domain, orthographic, light) in [
        ("directional light, pinhole", cube(), false, oblique()),
        ("directional light from below, parallel rays", cube(), true, LightSettings::directional([-0.2, 1.0, 0.5], 12.0)),
        ("light along an axis", cube(), false, LightSettings::directional([0.0, 0.0, -1.0], 12.0)),
        ("point light outside", cube(), false, point([1.5, -0.5, 1.8])),
        ("point light inside", cube(), false, point([0.64, 0.15, 0.5])),
        ("slab", slab(), false, oblique()),
    ] {
        let scene = scene(&domain, 32, orthographic, light);
        let shape = if domain.dimensions == 2 { [65, 65, 1] } else { [65, 65, 65] };
        let nodes = nodes(&domain, shape, field);
        for missing in [false, true] {
            let gone: IsMissing<'_> = &is_missing;
            let of = |p: DomainPoint| if missing && is_missing(p) { f32::NAN } else { nodes.at(domain.to_unit(p)) };
            let truth = [scene.seed, scene.seed + 1].map(|seed| tracked(&Scene { seed, ..scene.clone() }, &domain, 8, of));
            // No difference between the fields: all that is left is the march.
            let (film, stated) = Smooth::new(&scene, &domain).round(&nodes, missing.then_some(gone), (Method::Marched, false, 2.0), of);
            let renderer = Renderer::new(scene.clone(), &domain, TAU).unwrap();
            let marched = converged(&Medium { scene: &renderer.frame_scene(0), nodes: &nodes, missing: missing.then_some(gone) });
            // The noise of the truth leaves some 1e-6 of its product. Next to a light inside the box the radiance has no bound, so that only the mean
            // is compared.
            let apart = true_error(&marched, &truth);
            assert!(
                apart.abs() < 3e-6 || what == "point light inside",
                "{what}, missing cells: {missing}: a fine march is off by {apart:e}"
            );
            let (found, stated) = (true_error(&film, &[marched.clone(), marched]), stated.march_rms.powi(2));
            let sound = (0.7 * found..6.0 * found).contains(&stated);
            assert!(sound, "{what}, missing cells: {missing}: mean square of the march {found:e}, stated {stated:e}");
            let mean = |film: &Film| film.rgba.iter().flatten().map(|&c| f64::from(c)).sum::<f64>() / film.rgba.len() as f64;
            let difference = mean(&film) - 0.5 * (mean(&truth[0]) + mean(&truth[1]));
            assert!(difference.abs() < 0.005, "{what}, missing cells: {missing}: means differ by {difference}");
        }
    }
}

/// In a uniform medium the depth to the light is the extinction times the way to the wall, right up to walls that light comes in through.
#[test]
fn the_light_volume_is_exact_in_a_uniform_medium() {
    let domain = cube();
    let nodes = nodes(&domain, [9; 3], |_| 1.2);
    // Along an axis, nearly so, through one, two and three walls, with all signs.
    let mut directions = vec![[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1e-17, 1.0, -1e-17], [1e-4, 1.0, 0.0]];
    for sign in 0..8 {
        let signed = |k: usize, size: f64| if sign >> k & 1 == 1 { -size } else { size };
        directions.extend([[signed(0, 0.5), signed(1, 1.0), 0.0], [signed(0, 0.6), signed(1, 0.9), signed(2, 1.0)]]);
        directions.push([signed(0, 1.0), signed(1, 0.2), signed(2, 0.97)]);
    }
    let mut worst = 0.0_f32;
    for toward in directions {
        let scene = scene(&domain, 8, true, LightSettings::directional(toward.map(|c| -c), 1.0));
        let renderer = Renderer::new(scene, &domain, TAU).unwrap();
        let frame = renderer.frame_scene(0);
        let medium = Medium { scene: &frame, nodes: &nodes, missing: None };
        let volume = LightVolume::new(&medium, 1 << 20, 1);
        let length = toward.iter().map(|c| c * c).sum::<f64>().sqrt();
        for i in 0..13_u32 * 13 * 13 {
            // Walls and points near them are among these.
            let unit = [i % 13, i / 13 % 13, i / 169].map(|n| (n as f32 / 12.0).clamp(0.003, 0.997));
            let exit = (0..3).filter(|&k| toward[k] != 0.0).map(|k| {
                let wall = if toward[k] > 0.0 { 1.0 } else { 0.0 };
                (wall - f64::from(unit[k])) * length / toward[k]
            });
            let depth = medium.extinction(UnitPoint(unit)) * exit.fold(f64::INFINITY, f64::min) as f32;
            worst = worst.max((volume.at(UnitPoint(unit)) - depth).abs());
        }
    }
    assert!(worst < 1e-4, "{worst:e}");
}

#[test]
fn equal_fields_leave_no_difference() {
    let (domain, scene) = (cube(), scene(&cube(), 32, false, oblique()));
    let nodes = nodes(&domain, [17, 17, 17], field);
    let mut renderer = Renderer::new(scene, &domain, TAU).unwrap();
    let paths: Vec<(u32, u32)> = (0..32 * 32).flat_map(|pixel| (0..8).map(move |sample| (pixel, sample))).collect();
    let mut answers = Traced(|p: DomainPoint| nodes.at(domain.to_unit(p)));
    let found = renderer.coupled_paths(3, &nodes, None, &paths, &mut answers);
    let scattered = found.iter().filter(|path| path.queries > 0).count();
    // Unit coordinates are rounded on two ways, which may part a path in many thousands.
    let parted = found.iter().filter(|path| path.radiance.iter().any(|c| c.abs() > 1e-4)).count();
    assert!(scattered > paths.len() / 4 && parted <= 2, "{scattered} paths with queries, {parted} of them parted");
}

#[test]
fn the_sum_of_march_and_correction_is_the_traced_picture() {
    let domain = cube();
    for light in [oblique(), point([0.4, 0.6, 0.5])] {
        let scene = scene(&domain, 32, false, light);
        let nodes = nodes(&domain, [33, 33, 33], nearby);
        let gone: IsMissing<'_> = &is_missing;
        let of = |p: DomainPoint| if is_missing(p) { f32::NAN } else { field(p) };
        let truth = tracked(&scene, &domain, 16, of);
        let mut smooth = Smooth::new(&scene, &domain);
        let mut last = None;
        for _ in 0..32 {
            last = Some(smooth.round(&nodes, Some(gone), (Method::TwoLevel, true, 32.0), of));
        }
        let (film, error) = last.unwrap();
        let variance = |_: usize| error.rms.value.powi(2);
        let (rms, most) = deviations(&film, &truth, variance);
        assert!(rms < 1.5 && most < 5.0, "{rms} and {most} standard errors");
        // The surrogate alone is another picture, which the test would notice.
        let (marched, _) = Smooth::new(&scene, &domain).round(&nodes, Some(gone), (Method::Marched, false, 2.0), of);
        assert!(deviations(&marched, &truth, |_| 0.0).0 > 5.0, "the surrogate is wrong by much");
    }
}

/// Luminances of a picture, and the variance of each.
struct Truth {
    luminances: Vec<f64>,
    variance: Vec<f64>,
}

/// Deviation of the mean of pictures from the truth: over the picture, over the twentieth of the pixels in which `surrogate` is most wrong, and over each
/// tile of 16 x 16 pixels. Each as a difference of luminance and its standard error, from the scatter between pictures and that of the truth.
fn biases(pictures: &[Vec<f64>], truth: &Truth, surrogate: &[f64], width: usize) -> Vec<[f64; 2]> {
    let Truth { luminances: truth, variance } = truth;
    const TILE: usize = 16;
    let tile = |x: usize, y: usize| (0..TILE * TILE).map(|i| (y + i / TILE) * width + x + i % TILE).collect::<Vec<_>>();
    let tiles = (0..truth.len() / width).step_by(TILE).flat_map(|y| (0..width).step_by(TILE).map(move |x| tile(x, y)));
    let mean = |pixels: &[usize], values: &[f64]| pixels.iter().map(|&i| values[i]).sum::<f64>() / pixels.len() as f64;
    let deviation = |pixels: Vec<usize>| {
        let of_pictures: Vec<f64> = pictures.iter().map(|picture| mean(&pixels, picture) - mean(&pixels, truth)).collect();
        let n = of_pictures.len() as f64;
        let bias = of_pictures.iter().sum::<f64>() / n;
        let of_truth = pixels.iter().map(|&i| variance[i]).sum::<f64>() / (pixels.len() as f64).powi(2);
        [bias, (of_pictures.iter().map(|d| (d - bias).powi(2)).sum::<f64>() / (n - 1.0) / n + of_truth).sqrt()]
    };
    [(0..truth.len()).collect(), most_wrong(truth, surrogate)].into_iter().chain(tiles).map(deviation).collect()
}

/// A network that has learned nothing, on nodes.
fn untrained(domain: &Domain) -> Nodes {
    let settings = SurrogateSettings { kind: Kind::Network, ..SurrogateSettings::default() };
    let network = NetworkSettings { levels: Some(6), log2_table: Some(12), width: 16, ..NetworkSettings::default() };
    let flow = VelocitySource::Analytic(Analytic::Abc { a: 1.0, b: 1.0, c: 1.0, growth: 0.0 }, domain.clone());
    let tracer = cpu_tracer(flow, &FlowMap::tangent(TAU, 1), 0.0).unwrap();
    let surrogate = build(&settings, &network, domain, 5, &tracer).unwrap();
    let points: Vec<UnitPoint> = (0..33 * 33 * 33).map(|i| Nodes::unit([33; 3], i)).collect();
    let mut values = vec![0.0; points.len()];
    surrogate.freeze().unwrap().predict(&points, &mut values).unwrap();
    Nodes::new([33; 3], Arc::new(values))
}

/// Whatever the surrogate, and however coarse the march: the mean of `combine = "sum"` is the picture that `reference` tracks. With the samples of another
/// surrogate, or on a march that is not mended, it is not.
#[test]
fn corrections_of_any_surrogate_are_unbiased() {
    const WIDTH: usize = 32;
    const SEEDS: u64 = 64;
    const SAMPLES: f64 = 16.0;
    /// Two-sided quantile of Student's t with 63 degrees of freedom at 1 %, over all 30 comparisons (Bonferroni).
    const LIMIT: f64 = 3.81;
    let domain = cube();
    let scene = scene(&domain, WIDTH, false, oblique());
    let traced = nodes(&domain, [33; 3], field);
    let converged_of = |nodes: &Nodes| {
        let renderer = Renderer::new(scene.clone(), &domain, TAU).unwrap();
        converged(&Medium { scene: &renderer.frame_scene(0), nodes, missing: None }).luminances()
    };
    let exact = |luminances: Vec<f64>| Truth { variance: vec![0.0; luminances.len()], luminances };
    let film = tracked(&scene, &domain, 16, |p| traced.at(domain.to_unit(p)));
    let truth = Truth { luminances: film.luminances(), variance: film.variance.iter().map(|&v| f64::from(v)).collect() };
    let beyond = |found: &[[f64; 2]]| found.iter().filter(|[bias, error]| bias.abs() > LIMIT * error).count();
    let ridge = |p: DomainPoint| field(p) + 0.8 * (-((p.0[0] - 0.53) / 0.03).powi(2)).exp();
    let on_nodes = |of: &dyn Fn(DomainPoint) -> f32| nodes(&domain, [33; 3], of);
    let surrogates = [
        ("good", on_nodes(&nearby), 0.02),
        // It shows next to nothing, and one that is off by as little shows the same.
        ("untrained", untrained(&domain), 1.0),
        ("off by a constant", on_nodes(&|p| field(p) + 0.3), 0.02),
        ("wrong in a thin ridge", on_nodes(&ridge), 0.02),
    ];
    let paths: Vec<(u32, u32)> =
        (0..(WIDTH * WIDTH) as u32).flat_map(|pixel| (0..SAMPLES as u32).map(move |sample| (pixel, sample))).collect();
    for (what, surrogate, other) in surrogates {
        let base = converged_of(&surrogate);
        let picture = |seed: u64| {
            let mut smooth = Smooth::new(&Scene { seed: 1000 + seed, ..scene.clone() }, &domain);
            let round = (Method::TwoLevel, true, SAMPLES);
            smooth.round(&surrogate, None, round, |p: DomainPoint| traced.at(domain.to_unit(p))).0.luminances()
        };
        let pictures: Vec<Vec<f64>> = (0..SEEDS).map(picture).collect();
        let found = biases(&pictures, &truth, &base, WIDTH);
        assert_eq!(beyond(&found), 0, "{what}: {found:?}");
        // What bias of the picture, of the pixels in which the surrogate is most wrong, and of tiles would show.
        let shows = |found: &[[f64; 2]]| 20.0 * (LIMIT * found.iter().map(|[_, error]| *error).fold(0.0, f64::max)).log10();
        let [all, wrong, tiles] = [&found[..1], &found[1..2], &found[2..]].map(shows);
        assert!(
            all < -60.0 && wrong < -44.0 && tiles < -52.0,
            "{what}: {all:.1} dB, {wrong:.1} dB where it is most wrong, {tiles:.1} dB in tiles"
        );
        // The samples of another surrogate than the one that is shown.
        let other = Nodes::new([33; 3], Arc::new(surrogate.values().iter().map(|s| s + other).collect()));
        let broken = |seed: u64| {
            let mut renderer = Renderer::new(Scene { seed: 1000 + seed, ..scene.clone() }, &domain, TAU).unwrap();
            let mut picture = base.clone();
            let found = renderer.coupled_paths(0, &other, None, &paths, &mut Traced(|p: DomainPoint| traced.at(domain.to_unit(p))));
            for ((pixel, _), path) in paths.iter().zip(found) {
                let [red, green, blue] = path.radiance.map(f64::from);
                picture[*pixel as usize] += (0.2126 * red + 0.7152 * green + 0.0722 * blue) / SAMPLES;
            }
            picture
        };
        let broken = biases(&(0..SEEDS).map(broken).collect::<Vec<_>>(), &truth, &base, WIDTH);
        assert!(beyond(&broken) > 0, "{what}: a broken coupling is not noticed");
    }
    // The base alone, with steps and a light volume that are too coarse: mended, and as marched.
    let surrogate = nodes(&domain, [33; 3], nearby);
    let expected = exact(converged_of(&surrogate));
    let based = |mended: bool| {
        let of_seed = |seed: u64| {
            let renderer = Renderer::new(Scene { seed: 1000 + seed, ..scene.clone() }, &domain, TAU).unwrap();
            let frame = renderer.frame_scene(0);
            let medium = Medium { scene: &frame, nodes: &surrogate, missing: None };
            let (volume, step) = (LightVolume::new(&medium, 1 << 12, 1), 4.0 * medium.spacing() as f32);
            let mut film = Film::new(WIDTH, WIDTH);
            for (pixel, rgba) in film.rgba.iter_mut().enumerate() {
                let mut sum = RaySum::default();
                (0..16).for_each(|j| {
                    sum.add(&match mended {
                        true => medium.mended_ray(pixel as u32, j, step, &volume),
                        false => medium.ray(pixel as u32, j, step, ToLight::Volume(&volume), true),
                    });
                });
                let [red, green, blue] = sum.radiance;
                *rgba = [red, green, blue, sum.alpha].map(|c| c / 16.0);
            }
            film.luminances()
        };
        biases(&(0..SEEDS).map(of_seed).collect::<Vec<_>>(), &expected, &truth.luminances, WIDTH)
    };
    let (mended, marched) = (based(true), based(false));
    assert!(beyond(&mended) == 0 && LIMIT * mended[0][1] < 1e-3, "{mended:?}");
    assert!(beyond(&marched) > 0, "a coarse march is not noticed: {marched:?}");
}

/// Mean square error over lit pixels and channels, with the noise of the truth removed by the product of two halves.
fn true_error(film: &Film, [a, b]: &[Film; 2]) -> f64 {
    let (mut sum, mut count) = (0.0, 0.0);
    for i in 0..film.rgba.len() {
        if film.rgba[i][3] > 0.01 {
            let d = |other: &Film, k: usize| f64::from(film.rgba[i][k] - other.rgba[i][k]);
            sum += (0..3).map(|k| d(a, k) * d(b, k)).sum::<f64>() / 3.0;
            count += 1.0;
        }
    }
    sum / count
}

#[test]
fn the_stated_error_is_the_true_one() {
    let domain = cube();
    let scene = scene(&domain, 64, false, oblique());
    let nodes = nodes(&domain, [33, 33, 33], nearby);
    let truth = [tracked(&scene, &domain, 8, field), {
        let other = Scene { seed: 6, ..scene.clone() };
        tracked(&other, &domain, 8, field)
    }];
    let (mut inside, mut all, mut ratio) = (0, 0, 0.0);
    let mut lasts = Vec::new();
    for seed in 0..8 {
        let mut smooth = Smooth::new(&Scene { seed: 100 + seed, ..scene.clone() }, &domain);
        let mut errors = Vec::new();
        for _ in 0..4 {
            let (film, stated) = smooth.round(&nodes, None, (Method::TwoLevel, false, 4.0), field);
            let error = true_error(&film, &truth).max(0.0).sqrt();
            inside += u32::from((stated.rms.low..=stated.rms.high).contains(&error));
            all += 1;
            ratio += stated.rms.value / error;
            errors.push(error);
        }
        lasts.push((errors[0], errors[3]));
    }
    assert!((ratio / f64::from(all) - 1.0).abs() < 0.2, "{ratio} over {all}");
    assert!(inside * 10 >= all * 8, "{inside} of {all} inside");
    assert!(lasts.iter().all(|(first, last)| last < first), "more samples, less error: {lasts:?}");
}

#[test]
fn a_picture_starts_anew_when_anything_else_is_shown() {
    let (domain, scene) = (cube(), scene(&cube(), 16, false, oblique()));
    let nodes = nodes(&domain, [17, 17, 17], nearby);
    let mut smooth = Smooth::new(&scene, &domain);
    let method = (Method::TwoLevel, false, 2.0);
    let samples = |smooth: &mut Smooth, nodes: &Nodes| smooth.round(nodes, None, method, field).1.samples_per_pixel;
    let first = samples(&mut smooth, &nodes);
    let second = samples(&mut smooth, &nodes);
    assert!((1.5..2.5).contains(&first) && (3.0..5.0).contains(&second), "{first} {second}");
    let mut other = scene.clone();
    other.camera.eye[0] += 0.1;
    smooth.renderer.set_scene(other).unwrap();
    assert!(samples(&mut smooth, &nodes) < 2.5, "another camera");
    let renewed = Nodes::new(nodes.shape(), Arc::new(nodes.values().to_vec()));
    assert!(samples(&mut smooth, &renewed) < 2.5, "another window");
}
