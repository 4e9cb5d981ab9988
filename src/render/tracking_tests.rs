use super::*;
use crate::{CameraSettings, LightSettings, TransferSettings};
use ridgewatch_field::Domain;

/// A grid with a different majorant in each cell: 1 + index, over a box of unit cells.
fn graded(cells: [usize; 3]) -> MajorantGrid {
    let settings = TransferSettings { low: Some(0.0), high: Some(1e6), extinction: Some(1e6), albedo: [vec![1.0], vec![1.0], vec![1.0]] };
    let transfer = Transfer::new(&settings, 1.0).unwrap();
    let mut grid = MajorantGrid::new(cells, &transfer);
    grid.set_for_test((0..cells.iter().product()).map(|i| 1.0 + i as f32).collect());
    grid
}

/// Cells visited on the way out, found by asking for ever larger depths.
fn visited(grid: &MajorantGrid, origin: GridPoint, direction: [f32; 3], end: f32) -> Vec<u32> {
    let mut cells: Vec<u32> = Vec::new();
    for i in 1..200_000 {
        match walk(grid, 0.0, origin, direction, 0.0, end, i as f32 * 1e-3) {
            Some(hit) if cells.last() != Some(&hit.cell) => cells.push(hit.cell),
            Some(_) => {}
            None => break,
        }
    }
    cells
}

#[test]
fn walks_visit_the_cells_on_the_line() {
    let grid = graded([4, 3, 2]);
    assert_eq!(visited(&grid, GridPoint([0.0, 0.5, 0.5]), [1.0, 0.0, 0.0], 4.0), [0, 1, 2, 3]);
    assert_eq!(visited(&grid, GridPoint([4.0, 1.5, 1.5]), [-1.0, 0.0, 0.0], 4.0), [19, 18, 17, 16]);
    // From (0, 0.5) up at slope 1/2: crosses x = 1 at y = 1 together; then x = 2 at 1.5, y = 2 and x = 3 together.
    assert_eq!(visited(&grid, GridPoint([0.2, 0.5, 0.1]), [2.0, 1.0, 0.0], 1.5), [0, 1, 5, 6, 7]);
    assert_eq!(visited(&grid, GridPoint([0.5, 0.5, 0.5]), [0.0, 0.0, 1.0], 1.0), [0, 12], "ends inside the last cell");
}

#[test]
fn walks_add_up_the_majorants() {
    // Against brute force: march in small steps through the same line.
    let grid = graded([5, 4, 3]);
    let random = FrameRandom::new(3, 0);
    for case in 0..200 {
        let words = random.words(case, 0, 0).map(unit);
        let more = random.words(case, 1, 0).map(unit);
        let origin = GridPoint([words[0] * 5.0, words[1] * 4.0, words[2] * 3.0]);
        let direction = [more[0] - 0.5, more[1] - 0.5, more[2] - 0.5];
        let wanted = words[3] * 60.0;
        let (mut depth, mut t) = (0.0_f64, 0.0_f64);
        let step = 1e-4;
        let marched = loop {
            let place: [f64; 3] = std::array::from_fn(|k| f64::from(origin.0[k]) + (t + 0.5 * step) * f64::from(direction[k]));
            if (0..3).any(|k| place[k] < 0.0 || place[k] >= grid.cells()[k] as f64) {
                break None;
            }
            let cell = place[0] as usize + 5 * (place[1] as usize + 4 * place[2] as usize);
            depth += step * f64::from(grid.majorants()[cell]);
            t += step;
            if depth > f64::from(wanted) {
                break Some(t);
            }
        };
        let found = walk(&grid, 0.0, origin, direction, 0.0, f32::INFINITY, wanted).map(|hit| f64::from(hit.t));
        match (marched, found) {
            // A march of steps 1e-4 misplaces each of up to 12 walls by a step, between majorants that differ up to 60-fold.
            (Some(a), Some(b)) => assert!((a - b).abs() < 0.02, "{case}: {a} {b}"),
            (None, None) => {}
            (a, b) => assert!((depth - f64::from(wanted)).abs() < 0.05, "{case}: {a:?} {b:?} at depth {depth} of {wanted}"),
        }
    }
}

#[test]
fn a_restarted_walk_finds_the_same_place() {
    let grid = graded([8, 8, 8]);
    let direction = [0.3, 0.8, -0.5];
    let origin = GridPoint([1.0, 0.0, 8.0]);
    let whole = walk(&grid, 0.0, origin, direction, 0.0, 9.0, 900.0).unwrap();
    let mut t = 0.0;
    for _ in 0..30 {
        t = walk(&grid, 0.0, origin, direction, t, 9.0, 30.0).unwrap().t;
    }
    // Thirty roundings of a depth of 900.
    assert!((whole.t - t).abs() < 1e-4, "{} {t}", whole.t);
}

fn with_scene<R>(extinction: f64, majorant: f32, photons: [f64; 3], test: impl Fn(&FrameScene) -> R) -> R {
    let domain = Domain::cuboid([0.0; 3], [1.0; 3]);
    let settings =
        TransferSettings { low: Some(0.0), high: Some(1.0), extinction: Some(extinction), albedo: [vec![1.0], vec![1.0], vec![1.0]] };
    let transfer = Transfer::new(&settings, 1.0).unwrap();
    let camera =
        CameraSettings { eye: [0.5, 0.5, 2.0], look_at: [0.5, 0.5, 1.0], up: [0.0, 1.0, 0.0], field_of_view: 40.0, orthographic: true };
    let mut majorants = MajorantGrid::new([1, 1, 1], &transfer);
    majorants.set_for_test(vec![majorant]);
    test(&FrameScene {
        camera: &Camera::new(&camera, 1.0).unwrap(),
        light: &Light::new(&LightSettings::directional(photons, 4.0 * std::f64::consts::PI)).unwrap(),
        transfer: &transfer,
        space: &SceneBox::new(&domain, [1.0; 3], [1, 1, 1]),
        majorants: &majorants,
        random: FrameRandom::new(5, 0),
        width: 1,
        height: 1,
        background: [0.0; 3],
        missing: [0.0; 3],
        inverse_tau: 1.0,
    })
}

/// Mean and standard error of what `paths` paths in a medium of constant FTLE 0.5 bring home.
fn measure(scene: &FrameScene, paths: u32, value: impl Fn(&PathSample) -> f32) -> (f64, f64, u64) {
    let (mut sum, mut squares, mut exceeded) = (0.0, 0.0, 0);
    for sample in 0..paths {
        let (mut flight, mut outcome) = Flight::start(scene, 0, sample, 0);
        let path = loop {
            match outcome {
                Outcome::Done(path) => break path,
                Outcome::Pending => outcome = flight.resolve(scene, 0.5, true, &mut exceeded),
            }
        };
        let v = f64::from(value(&path));
        sum += v;
        squares += v * v;
    }
    let n = f64::from(paths);
    let mean = sum / n;
    (mean, ((squares / n - mean * mean) / n).sqrt(), exceeded)
}

#[test]
fn extinctions_above_their_majorant_stay_unbiased() {
    // Extinction 2 over a length of 1, light from the camera's side: alpha = 1 - exp(-2), radiance = (1 - exp(-4)) / 2.
    for (majorant, exceeds) in [(4.0, false), (2.0, false), (1.6, true), (1.2, true), (0.4, true), (0.2, true)] {
        with_scene(4.0, majorant, [0.0, 0.0, -1.0], |scene| {
            let (alpha, alpha_error, exceeded) = measure(scene, 200_000, |path| path.scattered);
            assert!((alpha - (1.0 - (-2.0_f64).exp())).abs() < 4.0 * alpha_error, "majorant {majorant}: alpha {alpha} +- {alpha_error}");
            let (radiance, error, _) = measure(scene, 200_000, |path| path.radiance[0]);
            assert!((radiance - 0.5 * (1.0 - (-4.0_f64).exp())).abs() < 4.0 * error, "majorant {majorant}: {radiance} +- {error}");
            assert_eq!(exceeded > 0, exceeds, "each is counted");
            // One weight of up to 2 ratio - 1 = 19 a path, in a fifth of the paths. Were there one a collision, most of the variance would be in paths too
            // rare to be met.
            assert!(alpha_error.max(error) < 0.025, "majorant {majorant}: errors {alpha_error}, {error}");
        });
    }
}

#[test]
fn thin_transmittance_survives_the_roulette() {
    // Extinction 6, light from behind: every path of light is as long as the box is deep, radiance = 6 exp(-6), all of it at
    // transmittances below the roulette's threshold or close to it.
    for majorant in [9.0, 60.0] {
        with_scene(12.0, majorant, [0.0, 0.0, 1.0], |scene| {
            let (radiance, error, _) = measure(scene, 400_000, |path| path.radiance[0]);
            let expected = 6.0 * (-6.0_f64).exp();
            assert!(error < 0.05 * expected && (radiance - expected).abs() < 4.0 * error, "majorant {majorant}: {radiance} +- {error}");
        });
    }
}
