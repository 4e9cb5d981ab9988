//! Gridded data: too few snapshots, interpolation, rounded weights and velocities, a moving shock.

use crate::kit::scene;
use crate::sweep::{
    TOLERANCE, adaptive, bisect, decibels, double_gyre, grid, gridded_gyre, gyre, gyre_box, lattice, map, map_psnr, rms, rms_difference,
    row, traced, window,
};
use ridgewatch::field::{Axis, DomainPoint, Geometry, Grid, Snapshot, Window};
use ridgewatch::flow::Direction;
use ridgewatch::flow::{Boundary, FlowMap, Interpolation, Precision, Steps, VelocitySource, cpu_tracer, time_resolution};
use ridgewatch::run::RunOptions;
use std::sync::Arc;

const TAU: f64 = 10.0;
/// `COARSE_IN_TIME` of `src/run/cycle.rs`: a run warns when the FTLE changes by more without every second snapshot.
const WARNED: f64 = 0.25;

/// Cubic interpolation, in double precision, so that neither space nor rounding hides what is swept.
fn gridded(steps: usize, interpolation: Interpolation) -> FlowMap {
    FlowMap { boundary: Boundary::Clamp, interpolation, ..map(TAU, steps, Precision::F64) }
}

#[test]
fn too_few_snapshots() {
    let seeds = lattice(&gyre_box(), [60, 30]);
    let exact = traced(&double_gyre(), &adaptive(TAU), 0.0, &seeds);
    let size = rms(exact.iter().copied());
    let map = gridded(200, Interpolation::Cubic);
    let mut found = Vec::new();
    for interval in [0.1, 0.2, 0.25, 0.5, 1.0, 1.25, 2.5, 5.0] {
        let window = gridded_gyre(129, TAU, interval);
        let stretches = traced(&VelocitySource::Window(window.clone()), &map, 0.0, &seeds);
        let error = rms_difference(&stretches, &exact) / size;
        let resolution = time_resolution(&window, &map, 0.0).unwrap();
        found.push((interval, error, resolution.ftle_change.unwrap() / resolution.ftle_rms, map_psnr(&stretches, &exact)));
        println!("interval {interval}: error {:.1} %, recorded change {:.1} %", 100.0 * error, 100.0 * found[found.len() - 1].2);
    }
    let fails = found.iter().find(|f| f.1 > 0.1).expect("a failing interval");
    let warned = found.iter().find(|f| f.2 > WARNED).expect("a warning");
    assert!(warned.3 < found[0].3, "{found:?}");
    assert!(found.iter().all(|f| f.0 >= warned.0 || f.1 < WARNED), "an error of a quarter of the FTLE is warned of: {found:?}");
    // Linear interpolation of a sine errs by (omega dt)^2 / 8: the record, which doubles dt, sees more than the error.
    assert!(found.iter().filter(|f| f.0 < 5.0).all(|f| f.2 > f.1), "the record overstates while the flow is resolved: {found:?}");
    // The warning itself: a run of turbulence that is ever faster for its snapshots.
    let says = [1.0, 3.0, 10.0, 30.0, 100.0].map(|amplitude| {
        let keys = format!(
            "source.nodes = [24, 12, 12]\nsource.amplitude = {amplitude}\ntime.tau = 6\ntime.slides = 1\nflow.steps = 48\nrender.method = \"reference\""
        );
        let mut said = false;
        let report = scene::run_frames(scene::setup(&scene::scene("turbulence", [8, 4, 1], &keys), &[]), &RunOptions::default(), |frame| {
            said |= frame.record.warnings.iter().any(|w| w.starts_with("coarse in time"));
        });
        let resolution = report.time_resolution.unwrap();
        (said, resolution.ftle_change.unwrap() / resolution.ftle_rms)
    });
    println!("turbulence: warned, recorded change {says:.3?}");
    assert!(says.iter().all(|(said, change)| *said == (*change > WARNED)), "{says:?}");
    assert!(says.iter().any(|s| s.0) && says.iter().any(|s| !s.0), "{says:?}");
    let before = found.iter().rev().find(|f| f.0 < warned.0).unwrap();
    row([
        "too few snapshots",
        &format!("interval {} of a period of 10 (error above 10 %)", fails.0),
        "summary: `time_resolution.ftle_change`, without every second snapshot; of colours, the decision `time.every` (`tests/run/snapshots.rs`: \
         `a_fast_flow_needs_all_snapshots`)",
        &format!("warns from interval {} on: changes by {:.0} % of the rms FTLE", warned.0, 100.0 * warned.2),
        &format!(
            "{:.0} % at the first warning (map {}); {:.0} % at {} (map {}), where `ftle_change` is {:.0} % and nothing warns",
            100.0 * warned.1,
            decibels(warned.3),
            100.0 * before.1,
            before.0,
            decibels(before.3),
            100.0 * before.2
        ),
        "too_few_snapshots",
    ]);
    // Half a period apart every snapshot is the same: the flow looks steady, with and without every second one.
    let aliased = found[found.len() - 1];
    assert!(aliased.1 > WARNED && aliased.2 < 1e-6, "{aliased:?}");
    row([
        "snapshots half a period apart",
        "interval 5 of a period of 10",
        "none: `ftle_change` is 0",
        "nothing: the data do not hold the motion",
        &format!("{:.0} % of the rms FTLE; map {}", 100.0 * aliased.1, decibels(aliased.3)),
        "too_few_snapshots",
    ]);
}

#[test]
fn linear_against_cubic() {
    let seeds = lattice(&gyre_box(), [60, 30]);
    let exact = traced(&double_gyre(), &adaptive(TAU), 0.0, &seeds);
    let mut found = Vec::new();
    for nodes in [17, 33, 65, 129, 257] {
        let window = VelocitySource::Window(gridded_gyre(nodes, TAU, 0.1));
        let both = [Interpolation::Linear, Interpolation::Cubic].map(|interpolation| {
            let stretches = traced(&window, &gridded(200, interpolation), 0.0, &seeds);
            let error = rms_difference(&stretches, &exact);
            // Seeds on both sides of the cell faces x = k / 8, a millionth apart: the stretch of a smooth flow does not jump.
            let pairs: Vec<DomainPoint> = (0..200)
                .flat_map(|i| [-1.0, 1.0].map(|side| DomainPoint([(1 + i % 15) as f32 / 8.0 + side * 5e-7, 0.0043 * (i + 10) as f32, 0.5])))
                .collect();
            let short = FlowMap { tau: 0.5, ..gridded(20, interpolation) };
            let jumps = rms(traced(&window, &short, 0.0, &pairs).chunks(2).map(|pair| pair[1] - pair[0]));
            (error, jumps, map_psnr(&stretches, &exact))
        });
        println!(
            "{nodes} nodes: linear {:.1e}, jumps {:.1e}, map {}; cubic {:.1e}, jumps {:.1e}, map {}",
            both[0].0,
            both[0].1,
            decibels(both[0].2),
            both[1].0,
            both[1].1,
            decibels(both[1].2)
        );
        found.push((nodes, both[0], both[1]));
    }
    let first = |good: &dyn Fn(&(usize, (f64, f64, f64), (f64, f64, f64))) -> bool| found.iter().find(|f| good(f)).map(|f| f.0);
    let (linear, cubic) = (first(&|f| f.1.0 < 0.02), first(&|f| f.2.0 < 0.02));
    let (last, nodes) = (found[found.len() - 1], cubic.expect("cubic resolves the flow"));
    assert!(linear.is_none_or(|linear| linear > 2 * nodes), "linear {linear:?}, cubic {nodes}");
    // The gradient of the linear interpolant jumps by a second derivative times a cell; the cubic one's is continuous.
    assert!(found.iter().all(|f| f.1.1 > 10.0 * f.2.1), "{found:?}");
    let resolved = found.iter().find(|f| f.0 == nodes).unwrap();
    assert!(resolved.1.2 < resolved.2.2, "the map shows it: {resolved:?}");
    // What the record says of it.
    let window = VelocitySource::Window(gridded_gyre(65, TAU, 0.5));
    let choice = |interpolation| {
        let map = FlowMap { steps: Steps::Auto { tolerance: TOLERANCE }, ..gridded(1, interpolation) };
        cpu_tracer(window.clone(), &map, 0.0).unwrap().step_choice().unwrap()
    };
    let [rough, smooth] = [Interpolation::Linear, Interpolation::Cubic].map(choice);
    assert!(rough.difference > 10.0 * smooth.difference, "{rough:?} {smooth:?}");
    row([
        "linear interpolation, kinks at faces",
        &format!(
            "error above 0.02 of the log-stretch {}; cubic below {nodes} nodes across",
            linear.map_or(format!("at every resolution up to {} nodes across", last.0), |n| format!("below {n} nodes across"))
        ),
        &format!(
            "`integration_difference`: {:.0e} with {} steps; cubic {:.0e} with {}",
            rough.difference, rough.steps, smooth.difference, smooth.steps
        ),
        "cubic by default in two dimensions",
        &format!(
            "{:.2} (linear), {:.3} (cubic) at {} nodes; map {} (linear), {} (cubic) at {nodes}",
            last.1.0,
            last.2.0,
            last.0,
            decibels(resolved.1.2),
            decibels(resolved.2.2)
        ),
        "linear_against_cubic",
    ]);
}

/// Bilinear interpolation whose weights in space have few bits, as those of texture units (8 bits of fraction).
struct Texture {
    window: Arc<Window>,
    shape: [usize; 2],
    spacing: [f64; 2],
    /// Steps between two nodes that a weight can take; `None`: exact.
    levels: Option<f64>,
}

impl Texture {
    fn new(window: &Arc<Window>, bits: Option<i32>) -> Self {
        let grid = window.grid().unwrap();
        let [nx, ny, _] = grid.shape();
        let spacing = [0, 1].map(|k| grid.axes[k].uniform_step().unwrap());
        Self { window: window.clone(), shape: [nx, ny], spacing, levels: bits.map(|bits| 2f64.powi(bits)) }
    }

    /// Velocity, and its gradient as the interpolant's differences of nodes.
    fn sample(&self, time: f64, p: [f64; 2]) -> ([f64; 2], [[f64; 2]; 2]) {
        let snapshots: Vec<&Arc<Snapshot>> = self.window.snapshots().collect();
        let interval = snapshots[1].time;
        let first = ((time / interval + 1e-9).floor() as usize).min(snapshots.len() - 2);
        let late = time / interval - first as f64;
        let (mut cell, mut weight) = ([0; 2], [0.0; 2]);
        for k in 0..2 {
            let at = (p[k] / self.spacing[k]).clamp(0.0, (self.shape[k] - 1) as f64);
            cell[k] = (at as usize).min(self.shape[k] - 2);
            weight[k] = at - cell[k] as f64;
            if let Some(levels) = self.levels {
                weight[k] = (weight[k] * levels).round() / levels;
            }
        }
        let node = |i: usize, j: usize, c: usize| {
            let [a, b] = [0, 1].map(|n| f64::from(snapshots[first + n].nodes[(cell[1] + j) * self.shape[0] + cell[0] + i][c]));
            a + late * (b - a)
        };
        let mix = |a: f64, b: f64, w: f64| a + w * (b - a);
        let (mut v, mut gradient) = ([0.0; 2], [[0.0; 2]; 2]);
        for c in 0..2 {
            let [[a, b], [d, e]] = [0, 1].map(|j| [0, 1].map(|i| node(i, j, c)));
            v[c] = mix(mix(a, b, weight[0]), mix(d, e, weight[0]), weight[1]);
            gradient[c] = [mix(b - a, e - d, weight[1]) / self.spacing[0], mix(d - a, e - b, weight[0]) / self.spacing[1]];
        }
        (v, gradient)
    }

    /// State (x, y, J) after RK4 steps from `seed`.
    fn integrate(&self, seed: [f64; 2], steps: usize) -> [f64; 6] {
        let rate = |time: f64, s: &[f64; 6]| {
            let (v, g) = self.sample(time, [s[0], s[1]]);
            let j = |row: usize, column: usize| g[row][0] * s[2 + column] + g[row][1] * s[4 + column];
            [v[0], v[1], j(0, 0), j(0, 1), j(1, 0), j(1, 1)]
        };
        let along = |s: &[f64; 6], k: &[f64; 6], h: f64| -> [f64; 6] { std::array::from_fn(|i| s[i] + h * k[i]) };
        let h = TAU / steps as f64;
        (0..steps).fold([seed[0], seed[1], 1.0, 0.0, 0.0, 1.0], |s, n| {
            let t = h * n as f64;
            let a = rate(t, &s);
            let b = rate(t + h / 2.0, &along(&s, &a, h / 2.0));
            let c = rate(t + h / 2.0, &along(&s, &b, h / 2.0));
            let d = rate(t + h, &along(&s, &c, h));
            std::array::from_fn(|i| s[i] + h / 6.0 * (a[i] + 2.0 * b[i] + 2.0 * c[i] + d[i]))
        })
    }

    /// Log-stretches by the tangent (no gap) or by differences.
    fn stretches(&self, seeds: &[DomainPoint], steps: usize, gap: Option<f64>) -> Vec<f64> {
        let sigma = |m: [f64; 4]| 0.5 * ((m[0] + m[3]).hypot(m[1] - m[2]) + (m[0] - m[3]).hypot(m[1] + m[2]));
        let of = |seed: &DomainPoint| {
            let p = [f64::from(seed.0[0]), f64::from(seed.0[1])];
            let m = match gap {
                None => {
                    let s = self.integrate(p, steps);
                    [s[2], s[3], s[4], s[5]]
                }
                Some(gap) => {
                    let [[a, b], [c, d]] = [[gap, 0.0], [0.0, gap]]
                        .map(|o| [1.0, -1.0].map(|side| self.integrate([p[0] + side * o[0], p[1] + side * o[1]], steps)));
                    [a[0] - b[0], c[0] - d[0], a[1] - b[1], c[1] - d[1]].map(|x| x / (2.0 * gap))
                }
            };
            sigma(m).ln()
        };
        seeds.iter().map(of).collect()
    }
}

#[test]
fn eight_bit_weights() {
    const STEPS: usize = 50;
    let window = gridded_gyre(65, TAU, 1.0);
    let seeds = lattice(&gyre_box(), [20, 10]);
    let exact = Texture::new(&window, None);
    let (tangent, gap) = (exact.stretches(&seeds, STEPS, None), 1e-4);
    let differences = exact.stretches(&seeds, STEPS, Some(gap));
    // The program interpolates in full floats: in double precision it is the same integration.
    let ours = traced(&VelocitySource::Window(window.clone()), &gridded(STEPS, Interpolation::Linear), 0.0, &seeds);
    assert!(rms_difference(&ours, &tangent) < 1e-9, "{:e}", rms_difference(&ours, &tangent));
    let single = FlowMap { precision: Precision::F32, ..gridded(STEPS, Interpolation::Linear) };
    let rounding = rms_difference(&traced(&VelocitySource::Window(window.clone()), &single, 0.0, &seeds), &tangent);
    let sweep: Vec<(i32, f64, f64)> = (4..=24)
        .step_by(2)
        .map(|bits| {
            let texture = Texture::new(&window, Some(bits));
            (
                bits,
                rms_difference(&texture.stretches(&seeds, STEPS, None), &tangent),
                rms_difference(&texture.stretches(&seeds, STEPS, Some(gap)), &differences),
            )
        })
        .collect();
    sweep.iter().for_each(|(bits, tangent, differences)| println!("{bits} bits: tangent {tangent:.1e}, differences {differences:.1e}"));
    let needed = |error: &dyn Fn(&(i32, f64, f64)) -> f64| sweep.iter().find(|s| error(s) <= TOLERANCE).map(|s| s.0).unwrap();
    let [by_tangent, by_differences] = [needed(&|s| s.1), needed(&|s| s.2)];
    // Paths and differences see the staircase; the tangent, whose gradient comes from the nodes, hardly does.
    assert!(by_tangent <= 8 && by_differences > 8, "{by_tangent} {by_differences}");
    let eight = sweep.iter().find(|s| s.0 == 8).unwrap();
    let texture = Texture::new(&window, Some(8));
    let pictures =
        [None, Some(gap)].map(|gap| map_psnr(&texture.stretches(&seeds, STEPS, gap), if gap.is_none() { &tangent } else { &differences }));
    assert!(pictures[1] < pictures[0], "{pictures:?}");
    assert!(rounding < 0.1 * eight.1, "{rounding:e} {eight:?}");
    row([
        "interpolation weights of 8 bits (texture units)",
        &format!("below {by_tangent} bits (tangent), {by_differences} bits (differences, gap {gap:.0e})"),
        "none is needed",
        "interpolates in floats, not with texture units",
        &format!(
            "f32 {rounding:.0e} of the log-stretch; 8 bits: {:.0e} (tangent, map {}), {:.1e} (differences, map {})",
            eight.1,
            decibels(pictures[0]),
            eight.2,
            decibels(pictures[1])
        ),
        "eight_bit_weights",
    ]);
}

/// The nearest number with 11 significant bits and the exponents of half precision; infinite beyond its range.
fn half(x: f32) -> f32 {
    if x == 0.0 {
        return x;
    }
    let step = (x.abs().log2().floor().max(-14.0) - 10.0).exp2();
    let rounded = (x / step).round_ties_even() * step;
    if rounded.abs() > 65_504.0 { f32::INFINITY } else { rounded }
}

#[test]
fn half_precision_storage() {
    let seeds = lattice(&gyre_box(), [40, 20]);
    let grid = grid([2.0, 1.0], [65, 33]);
    // The same flow with its velocities times `unit` and its times divided by it.
    let stretched = |unit: f64, round: &dyn Fn(f32) -> f32| {
        let mut scaled = Window::new(TAU / unit);
        for i in 0..=20 {
            let snapshot = gyre().snapshot(0.5 * f64::from(i), &grid);
            let component = |c: usize| snapshot.nodes.iter().map(|n| round((f64::from(n[c]) * unit) as f32)).collect::<Vec<f32>>();
            let time = 0.5 * f64::from(i) / unit;
            scaled.push(Arc::new(Snapshot::from_components(time, grid.clone(), &component(0), &component(1), &[]))).unwrap();
        }
        let map = FlowMap { tau: TAU / unit, ..gridded(100, Interpolation::Linear) };
        traced(&VelocitySource::Window(Arc::new(scaled)), &map, 0.0, &seeds)
    };
    let exact = stretched(1.0, &|x| x);
    let error = |unit: f64, round: &dyn Fn(f32) -> f32| rms_difference(&stretched(unit, round), &exact);
    let normal = error(1.0, &half);
    // A share of the points lives in missing cells where velocities overflow; there the stretch is 0.
    let slow = 1.0 / bisect(1.0, 1e10, |inverse| error(1.0 / inverse, &half) > 3.0 * normal);
    let fast = bisect(1.0, 1e10, |unit| error(unit, &half) > 3.0 * normal);
    // As `src/backend/cuda/window/store.rs`: v / scale with a power of two as the scale of the window.
    let fastest = (0..=20)
        .flat_map(|i| gyre().snapshot(0.5 * f64::from(i), &grid).nodes)
        .map(|n| f64::from(n[0].abs().max(n[1].abs())))
        .fold(0.0, f64::max);
    let peak = |unit: f64| ((fastest * unit) as f32).log2().ceil().exp2();
    let worst = [1e-10, 1e-5, 1.0, 1e6, 1e10]
        .map(|unit| error(unit, &|x| half(x / peak(unit) * 256.0) * peak(unit) / 256.0))
        .into_iter()
        .fold(0.0, f64::max);
    println!("half precision: {normal:.1e}; fails below {slow:.1e} and above {fast:.1e}; scaled {worst:.1e}");
    // Normal numbers end at 6.1e-5, the largest is 65504.
    let [slow, fast] = [slow * fastest, fast * fastest];
    assert!((6.1e-5..6.1e-3).contains(&slow) && (65_000.0..67_000.0).contains(&fast), "{slow:e} {fast:e}");
    assert!(worst < 2.0 * normal, "a scale leaves the rounding alone: {worst:e} {normal:e}");
    let picture = |unit: f64| map_psnr(&stretched(unit, &half), &exact);
    row([
        "velocities in f16",
        &format!("largest velocity below {slow:.0e} (degrees a second, say) or above {fast:.0}"),
        "none",
        "`device.storage = \"f16\"` divides a window by a power of two; by default half precision is taken where a smooth picture does not tell it",
        &format!(
            "{normal:.0e} of the log-stretch by rounding, in every unit (map {}); without the scale map {} at half the smallest and {} at twice the \
             largest of these velocities",
            decibels(picture(1.0)),
            decibels(picture(0.5 * slow / fastest)),
            decibels(picture(2.0 * fast / fastest))
        ),
        "half_precision_storage",
    ]);
    // A table in half precision: the largest rounding of log-stretches from one power of two to the next.
    let largest = |low: f64, round: &dyn Fn(f64) -> f64| {
        (0..1000).map(|i| low * (1.0 + 1e-3 * f64::from(i))).map(|s| (round(s) - s).abs()).fold(0.0, f64::max)
    };
    let coarse = |low: f64| largest(low, &|s| f64::from(half(s as f32)));
    let fails = (0..8).map(|power| 2f64.powi(power)).find(|&low| coarse(low) > TOLERANCE).unwrap();
    assert_eq!(fails, 32.0, "half of 2^5 / 2^10 is above a hundredth");
    // The same picture after a longer time.
    let longest = exact.iter().copied().fold(0.0, f64::max);
    let long: Vec<f64> = exact.iter().map(|s| 2.0 * fails * s / longest).collect();
    let rounded: Vec<f64> = long.iter().map(|&s| f64::from(half(s as f32))).collect();
    row([
        "a table in f16",
        &format!("log-stretch above {fails:.0}"),
        "none is needed",
        "keeps tables in f32",
        &format!(
            "up to {:.3} of the log-stretch there; f32 {:.0e}; map of stretches up to {:.0} {}",
            coarse(fails),
            largest(fails, &|s| f64::from(s as f32)),
            2.0 * fails,
            decibels(map_psnr(&rounded, &long))
        ),
        "half_precision_storage",
    ]);
}

/// A channel that is periodic along x, with nodes from 0 to 1 across it.
fn channel(nodes: usize) -> Arc<Grid> {
    let along = Axis::uniform("x", "", 0.0, 0.5, 2).unwrap().with_period(1.0);
    let axes = vec![along, Axis::uniform("y", "", 0.0, 1.0, nodes).unwrap()];
    Arc::new(Grid { axes, geometry: Geometry::Cartesian, slab: (0.0, 1.0) })
}

/// Velocities along x as `device.storage = "f16_pairs"` holds them (`kernels/tracing/window.cu`): half precision of the window's scale, and behind
/// each node its change to the next snapshot. An interval ends at what the change makes of a node, and the next one begins at the node itself.
fn in_pairs(span: f64, times: &[f64], nodes: usize, u: &dyn Fn(f64, usize) -> f32) -> Arc<Window> {
    let grid = channel(nodes);
    let peak = times.iter().flat_map(|&time| (0..nodes).map(move |j| u(time, j).abs())).fold(0.0, f32::max);
    // As `src/backend/cuda/window/store.rs`.
    let scale = (peak / 4096.0).log2().ceil().exp2();
    let held = |time: f64, j: usize| half(u(time, j) / scale);
    let mut window = Window::new(span);
    let mut push = |time: f64, of: &dyn Fn(usize) -> f32| {
        let along: Vec<f32> = (0..2 * nodes).map(|i| scale * of(i / 2)).collect();
        window.push(Arc::new(Snapshot::from_components(time, grid.clone(), &along, &vec![0.0; 2 * nodes], &[]))).unwrap();
    };
    for pair in times.windows(2) {
        let [now, next] = [pair[0], pair[1]];
        push(now, &|j| held(now, j));
        // Close to the next snapshot, which has values of its own.
        push(next - 1e-6 * (next - now), &|j| held(now, j) + half(held(next, j) - held(now, j)));
    }
    let last = times[times.len() - 1];
    push(last, &|j| held(last, j));
    Arc::new(window)
}

#[test]
fn a_weak_shear_in_a_strong_wind_held_in_pairs() {
    const SPAN: f64 = 8.0;
    const NODES: usize = 65;
    const PERIOD: f64 = std::f64::consts::TAU;
    // Particles stay at their height, where the wind shears at the rate cos(2 pi y), however strong it is: log-stretch asinh(rate tau / 2). Both
    // windows have the same nodes, so that only rounding differs.
    let shear = |j: usize| (PERIOD * j as f64 / (NODES - 1) as f64).sin() / PERIOD;
    let times: Vec<f64> = (0..=16).map(|i| 0.5 * f64::from(i)).collect();
    let map = FlowMap { boundary: Boundary::Clamp, ..map(SPAN, 160, Precision::F64) };
    let seeds: Vec<DomainPoint> = (0..500).map(|i| DomainPoint([0.5, (i as f32 + 0.5) / 500.0, 0.5])).collect();
    let stretches = |window: Arc<Window>| traced(&VelocitySource::Window(window), &map, 0.0, &seeds);
    let exact = {
        let grid = channel(NODES);
        let u: Vec<f32> = (0..2 * NODES).map(|i| shear(i / 2) as f32).collect();
        stretches(window(SPAN, 0.5, |time| Snapshot::from_components(time, grid.clone(), &u, &vec![0.0; 2 * NODES], &[])))
    };
    let fastest = 1.0 / PERIOD;
    let found: Vec<(f64, f64, f64)> = [0.0, 1.0, 4.0, 16.0, 64.0, 256.0, 1024.0]
        .map(|times_as_fast: f64| {
            // A wind that changes in every interval.
            let wind = |time: f64| times_as_fast * fastest * (0.4 * time).cos();
            let held = stretches(in_pairs(SPAN, &times, NODES, &|time, j| (wind(time) + shear(j)) as f32));
            (times_as_fast, rms_difference(&held, &exact), map_psnr(&held, &exact))
        })
        .to_vec();
    found.iter().for_each(|(wind, error, psnr)| println!("wind {wind} times as fast: {error:.1e}, map {}", decibels(*psnr)));
    assert!(found[0].1 < TOLERANCE, "without a wind rounding is small: {found:?}");
    let fails = found.iter().find(|f| f.1 > TOLERANCE).expect("a strong wind hides the shear");
    let last = found[found.len() - 1];
    // Rounding is a share of the wind: 256 times as fast loses the shear from node to node.
    assert!(last.1 > 3.0 * fails.1 && last.2 < found[0].2, "{found:?}");
    row([
        "velocities in f16 pairs",
        &format!("a uniform wind {:.0} times as fast as the flow that shears in it ({NODES} nodes across)", fails.0),
        "summary: the decision `device.storage`, colours that differ",
        "takes pairs where a smooth picture does not tell them from double precision; single precision elsewhere, and from the slide on where it does",
        &format!(
            "{:.0e} of the log-stretch there (map {}), {:.0e} without a wind (map {}); {:.1} (map {}) at {:.0} times",
            fails.1,
            decibels(fails.2),
            found[0].1,
            decibels(found[0].2),
            last.1,
            decibels(last.2),
            last.0
        ),
        "a_weak_shear_in_a_strong_wind_held_in_pairs",
    ]);
}

#[test]
fn moving_shock() {
    const WIDTH: f64 = 0.25;
    const END: f64 = 4.0;
    // A front of this width that moves at speed 1 and draws particles in from both sides; backward in time it pulls neighbours apart.
    let grid = grid([10.0, 1.0], [401, 2]);
    let of = |interval: f64| {
        window(END, interval, |time| {
            let front = |x: f64| (1.0 - 0.5 * ((x - 3.0 - time) / WIDTH).tanh()) as f32;
            let u: Vec<f32> = (0..grid.nodes()).map(|i| front(grid.axes[0].coordinates()[i % 401])).collect();
            Snapshot::from_components(time, grid.clone(), &u, &vec![0.0; grid.nodes()], &[])
        })
    };
    let map = FlowMap { tau: END, direction: Direction::Backward, boundary: Boundary::Clamp, ..map(END, 640, Precision::F64) };
    let seeds: Vec<DomainPoint> = (0..1000).map(|i| DomainPoint([5.0 + 0.004 * (i as f32 + 0.5), 0.5, 0.5])).collect();
    let exact = traced(&VelocitySource::Window(of(0.0125)), &map, END, &seeds);
    let size = rms(exact.iter().copied());
    let mut found = Vec::new();
    for interval in [0.025, 0.05, 0.1, 0.2, 0.25, 0.5, 1.0, 2.0] {
        let window = of(interval);
        let stretches = traced(&VelocitySource::Window(window.clone()), &map, END, &seeds);
        let error = rms_difference(&stretches, &exact) / size;
        let resolution = time_resolution(&window, &map, END).unwrap();
        let change = resolution.ftle_change.unwrap() / resolution.ftle_rms;
        found.push((interval, error, change, resolution.displacement_max, map_psnr(&stretches, &exact)));
    }
    found.iter().for_each(|f| println!("interval {}: error {:.1} %, recorded {:.1} %, {:.1} cells", f.0, 100.0 * f.1, 100.0 * f.2, f.3));
    let fails = found.iter().find(|f| f.1 > 0.1).expect("a failing interval");
    let warned = found.iter().find(|f| f.2 > WARNED).expect("a warning");
    // Between two snapshots the front is two half fronts once it has moved by more than its width.
    assert!((0.25..=4.0).contains(&(fails.0 / WIDTH)), "{fails:?}");
    assert!(warned.0 <= fails.0, "warned at {warned:?}, fails at {fails:?}");
    assert!(found[7].4 < found[0].4, "{found:?}");
    row([
        "moving shock",
        &format!("moves by {:.1} of its width between snapshots (error above 10 %)", fails.0 / WIDTH),
        "summary: `time_resolution`",
        &format!("warns when it moves by {:.1} of its width: changes by {:.0} %", warned.0 / WIDTH, 100.0 * warned.2),
        &format!(
            "{:.0} % of the rms FTLE at the first warning (map {}), {:.0} % at a move of {:.0} widths (map {})",
            100.0 * warned.1,
            decibels(warned.4),
            100.0 * found[7].1,
            found[7].0 / WIDTH,
            decibels(found[7].4)
        ),
        "moving_shock",
    ]);
}
