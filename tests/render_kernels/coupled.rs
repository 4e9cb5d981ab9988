//! Coupled paths of the kernels against the CPU's, path by path.

use super::*;
use ridgewatch::field::{DomainPoint, UnitPoint};
use ridgewatch::render::smooth::{CoupledPath, Nodes};

/// Planes of the sums: differences by half, quarter and channel, pairs by quarter, differences of alpha.
const PLANES: usize = 15;
const PIXELS: usize = 37 * 23;

/// A smooth field near [`Waves`], on nodes.
struct NearWaves(Domain);

impl Tracer for NearWaves {
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
        out.log_stretch = seeds.iter().map(|p| 1.05 * (7.0 * p.0[0] + 3.0 * p.0[2]).sin() * (9.0 * p.0[1]).cos() - 0.02).collect();
    }
}

/// The table of [`NearWaves`] and the same values as nodes.
fn surrogate(dimensions: usize) -> (Table, Nodes) {
    let domain = if dimensions == 3 { domain() } else { Domain::slab([0.0; 2], [2.0, 1.0], (0.0, 1.0)) };
    let table = Table::trace(&NearWaves(domain), [17, 9, 11]).unwrap();
    let nodes = Nodes::new(table.nodes(), Arc::new(table.values().to_vec()));
    (table, nodes)
}

/// How the waves are run, which must not matter.
#[derive(Clone, Copy)]
struct Waving {
    ahead: u32,
    most_guesses: u32,
    band: u32,
}
const PLAIN: Waving = Waving { ahead: 1, most_guesses: 0, band: 1 << 12 };
const FAR: Waving = Waving { ahead: 64, most_guesses: 1 << 20, band: 1 << 12 };

/// A round of the kernels.
struct Round {
    /// Queries, traced, missing, exceeded, paths, over budget.
    counts: [u32; 6],
    evaluated: u32,
    waves: u32,
    /// Difference and alpha of each path.
    found: Vec<[f32; 4]>,
    seen: CellObservations,
}

/// Runs a round for the listed pixels and adds it to the sums.
fn round(
    renderer: &mut Renderer,
    (table, dimensions): (&Table, i32),
    missing_cells: &[u8],
    equal: bool,
    list: &[u32],
    sums: &mut Vec<f32>,
    waving: Waving,
) -> Round {
    let setup = renderer.round_setup(5);
    let cells = setup.majorants.len();
    let mut input = [unit_box_bytes(&domain()), bytes(&[0_i32; 4]), missing_cells.to_vec()].concat();
    input.extend(table_bytes(table, dimensions));
    input.extend(bytes(&[u32::from(equal)]));
    input.extend(setup.parameters.as_bytes());
    input.extend(bytes(setup.majorants));
    input.extend(bytes(setup.may_be_missing));
    input.extend(bytes(&[list.len() as u32]));
    input.extend(bytes(list));
    input.extend(bytes(sums));
    input.extend(bytes(&[waving.ahead, waving.most_guesses, waving.band]));
    let output = ask("coupled", &input);
    let mut output = &output[..];
    let counts = read::<[u32; 6]>(&mut output, 1)[0];
    let [evaluated, waves] = read::<[u32; 2]>(&mut output, 1)[0];
    let found = read(&mut output, 2 * list.len());
    *sums = read(&mut output, PLANES * PIXELS);
    let seen = CellObservations { count: read(&mut output, cells), highest: read(&mut output, cells), missing: read(&mut output, cells) };
    assert!(output.is_empty());
    Round { counts, evaluated, waves, found, seen }
}

/// [`Waves`] outside of missing cells.
struct Holed<'a>(Option<&'a dyn Tracer>, u64);

impl LogStretch for Holed<'_> {
    fn evaluate(&mut self, points: &[DomainPoint], log_stretch: &mut [f32], traced: &mut [bool]) {
        Waves.evaluate(points, log_stretch, traced);
        for (i, &p) in points.iter().enumerate() {
            if self.0.is_some_and(|tracer| tracer.is_missing(p)) {
                (log_stretch[i], traced[i]) = (f32::NAN, false);
            }
            self.1 += u64::from(!log_stretch[i].is_finite());
        }
    }
}

/// No missing cells, in the harness's format.
fn none_missing() -> Vec<u8> {
    bytes(&[0_i32])
}

/// Teaches the majorants values that are too low.
pub fn mislead(renderer: &Renderer) {
    let mut random = uniform(12);
    let points: Vec<DomainPoint> = (0..20_000).map(|_| domain().from_unit(UnitPoint([random(), random(), random()]))).collect();
    renderer.observe(&points, &vec![0.6; points.len()]);
}

#[test]
fn coupled_paths_are_the_same_bits() {
    let tracer = holed(false);
    let list: Vec<u32> = (0..PIXELS as u32).filter(|pixel| pixel % 7 != 3).rev().collect();
    for (point_light, dimensions, with_missing, misled) in [(false, 3, false, false), (true, 3, true, true), (false, 2, false, true)] {
        let (table, nodes) = surrogate(dimensions);
        let missing_cells = if with_missing { missing_cells_bytes(&*tracer, false) } else { none_missing() };
        let is_missing = |p: DomainPoint| tracer.is_missing(p);
        let is_missing: Option<ridgewatch::render::smooth::IsMissing<'_>> = if with_missing { Some(&is_missing) } else { None };
        let scene = scene(point_light, false, misled.then_some([5, 3, 7]));
        let mut reference = Renderer::new(scene, &domain(), 1.0).unwrap();
        if misled {
            mislead(&reference);
        }
        let mut renderer = reference.clone();
        let (mut sums, mut expected_sums) = (vec![0.0_f32; PLANES * PIXELS], vec![0.0_f32; PLANES * PIXELS]);
        // Later rounds have majorants from the values of earlier ones.
        for pair in 0..3 {
            let paths: Vec<(u32, u32)> = list.iter().flat_map(|&pixel| [(pixel, 2 * pair), (pixel, 2 * pair + 1)]).collect();
            let mut answers = Holed(with_missing.then_some(&*tracer), 0);
            let expected = reference.coupled_paths(5, &nodes, is_missing, &paths, &mut answers);
            let waving = [PLAIN, FAR, Waving { ahead: 5, most_guesses: 700, band: 300 }][pair as usize];
            let found = round(&mut renderer, (&table, dimensions as i32), &missing_cells, false, &list, &mut sums, waving);
            for (i, expected) in expected.iter().enumerate() {
                let CoupledPath { radiance: [r, g, b], alpha, .. } = *expected;
                let equal = found.found[i].map(f32::to_bits) == [r, g, b, alpha].map(f32::to_bits);
                assert!(equal, "round {pair}, path {i}: {:?} instead of {expected:?}", found.found[i]);
            }
            let total = |of: fn(&CoupledPath) -> u32| expected.iter().map(of).sum::<u32>();
            let [queries, traced, missing, exceeded, ended, over_budget] = found.counts;
            assert_eq!((queries, traced), (total(|path| path.queries), total(|path| path.traced)));
            assert_eq!((u64::from(missing), ended, over_budget), (answers.1, 2 * list.len() as u32, 0));
            assert!(pair > 0 || (exceeded > 100) == misled, "{exceeded} exceeded");
            let [differ, apart] = [0, 3].map(|k| found.found.iter().filter(|path| path[k] != 0.0).count());
            assert!(differ > 100 && apart > 10, "{differ} paths differ, {apart} scatter in one field alone");
            assert!(renderer.absorb(&found.seen));
            add(&mut expected_sums, &list, &expected, pair);
        }
        assert!(sums.iter().zip(&expected_sums).all(|(a, b)| a.to_bits() == b.to_bits()));
        renderer.round_setup(5);
        reference.round_setup(5);
        assert_eq!(renderer.majorants().majorants(), reference.majorants().majorants());
    }
}

/// Adds pair `pair` of each listed pixel to the sums, in the order of the kernels.
fn add(sums: &mut [f32], list: &[u32], paths: &[CoupledPath], pair: u32) {
    for (&pixel, halves) in list.iter().zip(paths.chunks_exact(2)) {
        let quarter = ((pair + (pixel % 37).count_ones() + (pixel / 37).count_ones()) & 1) as usize;
        let mut at = |plane: usize, value: f32| sums[plane * PIXELS + pixel as usize] += value;
        for (half, path) in halves.iter().enumerate() {
            (0..3).for_each(|k| at(3 * (2 * half + quarter) + k, path.radiance[k]));
        }
        at(12 + quarter, 1.0);
        at(14, halves[0].alpha + halves[1].alpha);
    }
}

#[test]
fn the_look_ahead_changes_waves_alone() {
    let (table, _) = surrogate(3);
    let list: Vec<u32> = (0..PIXELS as u32).collect();
    let tracer = holed(false);
    let missing_cells = missing_cells_bytes(&*tracer, false);
    let mut renderer = Renderer::new(scene(false, false, None), &domain(), 1.0).unwrap();
    let mut run = |waving: Waving| {
        let mut sums = vec![0.0; PLANES * PIXELS];
        (round(&mut renderer, (&table, 3), &missing_cells, false, &list, &mut sums, waving), sums)
    };
    let (plain, sums) = run(PLAIN);
    // Missing values that the field has of its own are asked for, those of missing cells are not.
    let [queries, _, missing, ..] = plain.counts;
    assert!(plain.evaluated > queries - missing && plain.evaluated < queries, "{} of {queries}, {missing} missing", plain.evaluated);
    for waving in [FAR, Waving { ahead: 3, ..FAR }, Waving { most_guesses: 50, band: 64, ..FAR }] {
        let (found, other) = run(waving);
        assert_eq!((found.counts, &found.seen), (plain.counts, &plain.seen));
        assert!(other.iter().zip(&sums).all(|(a, b)| a.to_bits() == b.to_bits()));
        if waving.band == FAR.band {
            assert!(found.waves < plain.waves && found.evaluated > plain.evaluated);
        }
    }
    let (far, _) = run(FAR);
    assert!(far.waves * 3 < plain.waves, "{} waves instead of {}", far.waves, plain.waves);
}

#[test]
fn equal_fields_differ_by_exactly_nothing() {
    let (table, _) = surrogate(3);
    let list: Vec<u32> = (0..PIXELS as u32).collect();
    let tracer = holed(false);
    let missing_cells = missing_cells_bytes(&*tracer, false);
    let mut renderer = Renderer::new(scene(true, false, None), &domain(), 1.0).unwrap();
    let mut sums = vec![0.0; PLANES * PIXELS];
    for _ in 0..3 {
        let found = round(&mut renderer, (&table, 3), &missing_cells, true, &list, &mut sums, Waving { ahead: 1 << 16, ..FAR });
        assert!(found.found.iter().flatten().all(|&difference| difference == 0.0));
        // What s foresees is what f does, so one wave answers whole paths, and each of its points is used.
        assert_eq!((found.waves, found.evaluated), (1, found.counts[1]));
        assert!(found.counts[0] > 2000 && found.counts[2] > 100, "{:?}", found.counts);
        assert!(renderer.absorb(&found.seen));
    }
    assert!(sums[..12 * PIXELS].iter().chain(&sums[14 * PIXELS..15 * PIXELS]).all(|&sum| sum == 0.0));
    assert_eq!(sums[12 * PIXELS..14 * PIXELS].iter().sum::<f32>(), 3.0 * PIXELS as f32);
}

/// The surrogate as a field of its own.
struct FromNodes<'a>(&'a Nodes, &'a dyn Tracer);

impl LogStretch for FromNodes<'_> {
    fn evaluate(&mut self, points: &[DomainPoint], log_stretch: &mut [f32], traced: &mut [bool]) {
        traced.fill(false);
        for (value, &p) in log_stretch.iter_mut().zip(points) {
            *value = if self.1.is_missing(p) { f32::NAN } else { self.0.at(domain().to_unit(p)) };
        }
    }
}

/// Traced values without missing ones beyond the missing cells.
struct Whole<'a>(&'a dyn Tracer);

impl LogStretch for Whole<'_> {
    fn evaluate(&mut self, points: &[DomainPoint], log_stretch: &mut [f32], traced: &mut [bool]) {
        traced.fill(true);
        for (value, &p) in log_stretch.iter_mut().zip(points) {
            *value = if self.0.is_missing(p) { f32::NAN } else { (7.0 * p.0[0] + 3.0 * p.0[2]).sin() * (9.0 * p.0[1]).cos() };
        }
    }
}

/// Mean luminance of a picture tracked with these answers, and its variance.
fn mean_luminance(mut renderer: Renderer, answers: &mut dyn LogStretch) -> (f64, f64) {
    let (film, _) = renderer.render_samples(9, 0..400, answers, None, &NEVER).unwrap();
    let luminance = |p: &[f32; 4]| 0.2126 * f64::from(p[0]) + 0.7152 * f64::from(p[1]) + 0.0722 * f64::from(p[2]);
    let variance: f64 = film.variance.iter().map(|&v| f64::from(v)).sum();
    (film.rgba.iter().map(luminance).sum::<f64>() / PIXELS as f64, variance / (PIXELS * PIXELS) as f64)
}

#[test]
fn the_mean_is_the_difference_of_two_tracked_pictures() {
    let (_, nodes) = surrogate(3);
    let tracer = holed(false);
    let is_missing = |p: DomainPoint| tracer.is_missing(p);
    let mut renderer = Renderer::new(scene(false, false, Some([5, 3, 7])), &domain(), 1.0).unwrap();
    mislead(&renderer);
    let pixels: Vec<(u32, u32)> = (0..PIXELS as u32 * 200).map(|i| (i % PIXELS as u32, i / PIXELS as u32)).collect();
    let (traced, traced_variance) = mean_luminance(renderer.clone(), &mut Whole(&*tracer));
    let (smooth, smooth_variance) = mean_luminance(renderer.clone(), &mut FromNodes(&nodes, &*tracer));
    let paths = renderer.coupled_paths(2, &nodes, Some(&is_missing), &pixels, &mut Whole(&*tracer));
    let count = paths.len() as f64;
    let differences = paths
        .iter()
        .map(|CoupledPath { radiance: [r, g, b], .. }| 0.2126 * f64::from(*r) + 0.7152 * f64::from(*g) + 0.0722 * f64::from(*b));
    let (sum, squares) = differences.fold((0.0, 0.0), |(sum, squares), d| (sum + d, squares + d * d));
    let (mean, variance) = (sum / count, (squares / count - (sum / count).powi(2)) / count);
    let error = (variance + traced_variance + smooth_variance).sqrt();
    assert!((mean - (traced - smooth)).abs() < 5.0 * error, "{mean} instead of {traced} - {smooth}, standard error {error}");
    // The difference is worth measuring: it is seen, and by less noise than that of one picture.
    assert!((traced - smooth).abs() > 5.0 * error, "{traced} - {smooth}, standard error {error}");
    assert!(variance * count < 0.5 * traced_variance * 400.0 * PIXELS as f64);
}

#[test]
fn tiles_list_each_pixel_in_its_turn() {
    let (width, height) = (37_u32, 23_u32);
    let tiles = 3 * 2;
    let listed = |count: u16, cursor: u16| {
        let mut input = bytes(&[width, height, tiles]);
        for _ in 0..tiles {
            input.extend(bytes(&[0_u32]));
            input.extend(bytes(&[count, cursor]));
        }
        let output = ask("listed", &input);
        let mut pixels = read::<u32>(&mut &output[..], tiles as usize * 256);
        pixels.retain(|&pixel| pixel != u32::MAX);
        pixels
    };
    let mut all: Vec<u32> =
        [(7, 0), (121, 7), (100, 128), (28, 228)].into_iter().flat_map(|(count, cursor)| listed(count, cursor)).collect();
    let wrapped = listed(40, 230);
    assert_eq!(wrapped.len(), listed(26, 230).len() + listed(14, 0).len());
    all.sort_unstable();
    assert_eq!(all, (0..width * height).collect::<Vec<_>>());
    // A quarter of the ranks is one pixel of each block of four.
    let mut blocks: Vec<[u32; 2]> = listed(64, 64).iter().map(|p| [p % width / 2, p / width / 2]).collect();
    let found = blocks.len();
    blocks.sort_unstable();
    blocks.dedup();
    assert_eq!(blocks.len(), found);
    assert!(listed(0, 9).is_empty() && listed(256, 9).len() == (width * height) as usize);
}
