//! Trust: residuals that few audit points hit, surrogates that go wrong in mid-run, slides, hot spots thinner than a cell.

use crate::sweep::{bisect, row};
use ridgewatch::backend::{stratified_points, trusted_error};
use ridgewatch::field::{Domain, UnitPoint};
use ridgewatch::render::rng::{philox, unit};
use ridgewatch::trust::{Audited, Gate, REJECTED, Residual, Strata, TrustMap, TrustSettings, TrustedError};

const TOLERANCE: f64 = 0.03;

/// The loop of `src/run/assess.rs` on a surrogate whose residual is a given function of place and of a random number.
struct Loop {
    map: TrustMap,
    frame: u64,
    seed: u64,
}

/// A frame: what it stated, the evidence against the gate, and the gate under which it was drawn.
struct Stated {
    error: Option<TrustedError>,
    evidence: f64,
    gate: Gate,
}

impl Loop {
    fn new(seed: u64) -> Self {
        let domain = Domain::slab([0.0, 0.0], [2.0, 1.0], (0.0, 1.0));
        Self { map: TrustMap::new(&TrustSettings::default(), &domain), frame: 0, seed }
    }

    fn audit(&self, strata: Strata, residual: &dyn Fn(UnitPoint, f64) -> f64) -> Audited {
        let points = stratified_points(&strata, self.seed, self.frame);
        let residuals: Vec<Residual> = (0..)
            .zip(points)
            .map(|(i, point)| {
                let random = f64::from(unit(philox([i, self.frame as u32, 7, 7], [self.seed as u32, 1])[0]));
                Residual { point, optical: residual(point, random) as f32, log_stretch: 0.0 }
            })
            .collect();
        Audited::of(&residuals, strata)
    }

    fn frame(&mut self, residual: impl Fn(UnitPoint, f64) -> f64) -> Stated {
        let gate = self.map.gate();
        let audited = self.audit(self.map.audit_strata(&gate, 8), &residual);
        let error = trusted_error(&audited, &gate);
        let evidence = error.map_or(0.0, |error| self.map.weigh(&error).0);
        self.map.decay();
        self.map.observe(Some(&audited), &[]);
        self.frame += 1;
        Stated { error, evidence, gate }
    }

    /// Frames until the gate is open.
    fn opened(seed: u64, residual: impl Fn(UnitPoint, f64) -> f64 + Copy) -> Self {
        let mut run = Self::new(seed);
        (0..12).for_each(|_| drop(run.frame(residual)));
        run
    }
}

/// An exponential residual of this root mean square.
fn skewed(rms: f64, random: f64) -> f64 {
    -rms / 2f64.sqrt() * (1.0 - random).max(1e-12).ln()
}

#[test]
fn residuals_that_few_points_hit() {
    const LARGE: f64 = 0.5;
    const FRAMES: usize = 200;
    let mut found = Vec::new();
    for exponent in [-2.5, -3.0, -3.25, -3.5, -3.75, -4.0, -4.5, -5.0] {
        let share = 10f64.powf(exponent);
        let residual =
            move |_: UnitPoint, random: f64| if random < share { LARGE } else { skewed(0.002, (random - share) / (1.0 - share)) };
        let truth = (share * LARGE * LARGE + (1.0 - share) * 4e-6).sqrt();
        let (mut held, mut stated, mut points) = (0, 0.0, 0.0);
        let mut run = Loop::opened(5, residual);
        for _ in 0..FRAMES {
            let Some(error) = run.frame(residual).error else { continue };
            let [low, high] = error.optical_rms_interval;
            held += usize::from((low..=high).contains(&truth));
            stated += error.optical_rms / FRAMES as f64;
            points += error.points as f64 / FRAMES as f64;
        }
        println!("share {share:.1e}: {held} of {FRAMES} intervals hold {truth:.4}, stated {stated:.4} on {points:.0} points");
        found.push((share, held as f64 / FRAMES as f64, share * points, truth, stated));
    }
    let fails = found.iter().find(|f| f.1 < 0.8).expect("rare enough residuals are missed");
    // 200 trials of 0.95 less three standard errors.
    assert!(found.iter().filter(|f| f.2 > 3.0).all(|f| f.1 >= 0.9), "{found:?}");
    let held = found.iter().take_while(|f| f.1 >= 0.8).last().expect("frequent ones are not");
    // With h hits expected, no hit at all has a probability of e^-h; an interval needs some of them.
    assert!((0.01..=10.0).contains(&fails.2), "{fails:?}");
    assert!(held.2 > 1.0, "{held:?}");
    row([
        "trusted error, rare large residuals",
        &format!(
            "{:.1} points a frame hit them ({:.0} % of the intervals hold; at {:.1} points {:.0} %)",
            fails.2,
            100.0 * fails.1,
            held.2,
            100.0 * held.1
        ),
        "`trusted_error.optical_rms_interval`",
        "traces at least eight points a cell and frame; nothing says what they miss",
        &format!("stated {:.4} on average, true {:.4}; within the tolerance of 0.03", fails.4, fails.3),
        "residuals_that_few_points_hit",
    ]);
}

/// Fails without the additional sample at twice the tolerance.
#[test]
fn cells_trusted_on_few_samples() {
    const SEEDS: u64 = 8;
    // Share of the cells that are trusted although their error is this many times the tolerance.
    let trusted = |samples: u32, factor: f64| {
        let share = |seed| {
            let mut run = Loop::new(seed);
            let audited = run.audit(Strata::even(run.map.shape(), samples), &|_, random| skewed(factor * TOLERANCE, random));
            run.map.observe(Some(&audited), &[]);
            run.map.gate().share()
        };
        (0..SEEDS).map(share).sum::<f64>() / SEEDS as f64
    };
    let found = [8, 16, 32, 64, 128, 256].map(|samples| (samples, trusted(samples, 1.0), trusted(samples, 1.2), trusted(samples, 1.5)));
    println!("{found:?}");
    let few = TrustSettings::default().min_samples;
    assert!(found.iter().all(|f| (f.1 > 0.0) == (f64::from(f.0) >= few)), "none on fewer than trust.min_samples: {found:?}");
    // A bound of 95 % for normal residuals; these are exponential. Without the additional sample a quarter would be trusted.
    assert!(found.iter().all(|f| f.1 < 0.15 && f.2 < 0.05), "{found:?}");
    let worst = found.into_iter().max_by(|a, b| a.1.total_cmp(&b.1)).unwrap();
    row([
        "a cell trusted on few samples",
        &format!("{} samples: {:.0} % of the cells whose error just reaches the tolerance are trusted", worst.0, 100.0 * worst.1),
        "`trusted_error`, `tolerance_excess`",
        &format!("waits for {few:.0} samples, and adds one at twice the tolerance to the bound"),
        &format!("cells that err by 1.2 times the tolerance: {:.1} %, 1.5 times: {:.1} %", 100.0 * worst.2, 100.0 * worst.3),
        "cells_trusted_on_few_samples",
    ]);
}

#[test]
fn a_surrogate_that_goes_wrong() {
    let mut rows = Vec::new();
    for factor in [0.8, 1.05, 1.2, 1.5, 2.0, 4.0, 10.0] {
        let mut run = Loop::opened(9, |_, random| skewed(0.3 * TOLERANCE, random));
        assert!(run.map.gate().share() > 0.9, "a good surrogate is trusted");
        let (mut closed, mut rejected, mut worst) = (None, None, 0.0f64);
        for frame in 1..=60 {
            let stated = run.frame(|_, random| skewed(factor * TOLERANCE, random));
            worst = worst.max(stated.error.map_or(0.0, |error| error.optical_rms * stated.gate.share()));
            if run.map.gate().share() < 0.05 {
                closed = closed.or(Some(frame));
            }
            if stated.evidence >= REJECTED {
                rejected = rejected.or(Some(frame));
            }
        }
        println!("error {factor} of the tolerance: closed after {closed:?}, evidence after {rejected:?}, worst frame {worst:.3}");
        rows.push((factor, closed, rejected, worst));
    }
    let of = |factor: f64| rows.iter().find(|r| r.0 == factor).unwrap();
    // The first frame under the old gate shows the change; the next one is traced.
    assert!([2.0, 4.0, 10.0].iter().all(|&f| of(f).1.is_some_and(|closed| closed <= 2)), "{rows:?}");
    assert!(of(1.2).1.is_some(), "{rows:?}");
    assert!(rows.iter().filter(|r| r.0 < 1.0).all(|r| r.2.is_none()), "no evidence against a gate that keeps its promise: {rows:?}");
    let slowest = rows.iter().filter(|r| r.0 > 1.0).map(|r| r.1.unwrap_or(999)).max().unwrap();
    row([
        "regime change in mid-run (no slide)",
        &format!(
            "frames until the gate closes: error of 1.2 times the tolerance {}, 2 times {}, 10 times {}",
            of(1.2).1.unwrap(),
            of(2.0).1.unwrap(),
            of(10.0).1.unwrap()
        ),
        "`trusted_error`, `tolerance_excess`",
        &format!("closes cell by cell, after at most {slowest} frames"),
        &format!("{:.3} of the ramp in the frame that shows it, for 2 times; {:.2} for 10 times", of(2.0).3, of(10.0).3),
        "a_surrogate_that_goes_wrong",
    ]);
}

#[test]
fn evidence_of_a_gate_that_promises_too_much() {
    // Errors that the map believes to be smaller: audits far above what rendered samples show.
    let mut map = Loop::opened(2, |_, random| skewed(0.3 * TOLERANCE, random)).map;
    let error = |factor: f64| TrustedError { points: 1000, optical_rms: factor * TOLERANCE, ..TrustedError::default() };
    let frames = |map: &mut TrustMap, factor: f64| (1..=1000).find(|_| map.weigh(&error(factor)).0 >= REJECTED);
    let mut found = Vec::new();
    for factor in [1.05, 1.1, 1.2, 1.5, 2.0, 4.0] {
        let mut run = map.clone();
        let late = {
            let mut run = map.clone();
            assert!(frames(&mut run, 0.9).is_none(), "a promise that is kept");
            frames(&mut run, factor)
        };
        let frame = frames(&mut run, factor);
        assert_eq!(run.gate().share(), if frame.is_some() { 0.0 } else { map.gate().share() }, "at the limit every cell loses its trust");
        found.push((factor, frame, late));
    }
    println!("{found:?}");
    let of = |factor: f64| found.iter().find(|f| f.0 == factor).unwrap();
    assert!(of(2.0).1.is_some_and(|frame| frame <= 18) && of(2.0).2.is_some_and(|frame| frame <= 18), "{found:?}");
    map.reset();
    assert_eq!(map.gate().share(), 0.0);
    let text = |frame: Option<u32>| frame.map_or("more than 1000".to_owned(), |f| f.to_string());
    row([
        "a gate that errs a little in every frame",
        &format!(
            "error 1.1 times the tolerance: {} frames; 1.5 times: {}; 2 times: {}, after 1000 good ones {}",
            text(of(1.1).1),
            text(of(1.5).1),
            text(of(2.0).1),
            text(of(2.0).2)
        ),
        "`gate_evidence`",
        "at 20 every cell earns its trust again",
        "as stated in each frame: `tolerance_excess`",
        "evidence_of_a_gate_that_promises_too_much",
    ]);
}

/// Fails without the inflation of residuals at a slide.
#[test]
fn a_slide_doubles_the_error() {
    // Until the next audit the error after a slide is unknown: cells stay trusted only if twice their error is within the tolerance.
    let open = |rms: f64, slides: bool| {
        let constant = move |_: UnitPoint, _: f64| rms;
        let mut run = Loop::new(3);
        (0..12).for_each(|_| drop(run.frame(constant)));
        // Many samples, so that the loss of weight alone does not close the gate.
        let many = run.audit(Strata::even(run.map.shape(), 300), &constant);
        run.map.observe(Some(&many), &[]);
        if slides {
            run.map.window_slid();
        }
        run.map.gate().share()
    };
    let [still, slid] = [false, true].map(|slides| bisect(0.001, 0.1, |rms| open(rms, slides) < 0.5));
    println!("the gate closes at {still:.4}, at a slide at {slid:.4}");
    // Inflation of 4 on mean squares; the pseudo-sample at twice the tolerance takes the rest.
    assert!(2.0 * slid <= TOLERANCE && slid > 0.25 * TOLERANCE, "{slid}");
    assert!(still <= TOLERANCE && still > 0.9 * TOLERANCE, "{still}");
    // A field that drifts faster than that, twice in a row: the growth measured at the first slide holds for the second.
    let second = |growth: f64| {
        let mut run = Loop::new(4);
        let settle = |run: &mut Loop| {
            (0..12).for_each(|_| drop(run.frame(|_, _| 0.005)));
            let many = run.audit(Strata::even(run.map.shape(), 300), &|_, _| 0.005);
            run.map.observe(Some(&many), &[]);
        };
        settle(&mut run);
        run.map.window_slid();
        run.frame(|_, _| 0.005 * growth);
        settle(&mut run);
        run.map.window_slid();
        run.map.gate().share()
    };
    let distrusted = bisect(1.0, 100.0, |growth| second(growth) < 0.5);
    assert!(distrusted * 0.005 <= TOLERANCE, "{distrusted}: the grown error would be above the tolerance");
    row([
        "a slide of the window, error grows",
        &format!("residual above {slid:.4} before it ({still:.4} without a slide)"),
        "`trusted_volume`, `traced_share`",
        "quarters the weight and takes four times the mean square, or the growth measured at the last slide, until audits show better",
        &format!(
            "within the tolerance if the slide at most doubles the residual; after one growth of {distrusted:.1} the second slide closes a gate at 0.005"
        ),
        "a_slide_doubles_the_error",
    ]);
}

#[test]
fn a_hot_spot_thinner_than_a_cell() {
    const LIMIT: u32 = 2000;
    let domain_cell = |map: &TrustMap| map.shape().map(|n| 1.0 / n as f32);
    let mut found = Vec::new();
    for exponent in [0, 3, 5, 6, 7, 8, 9, 10, 11] {
        let share = 0.5f64.powi(exponent);
        let mut frames = Vec::new();
        for seed in 0..12 {
            let mut run = Loop::opened(100 + seed, |_, _| 0.004);
            let [dx, dy, _] = domain_cell(&run.map);
            // A strip of the cell in which the surrogate is entirely wrong, such as a ridge between its nodes.
            let (cell, strip) = ([7.0 * dx, 5.0 * dy], share as f32 * dx);
            let spot = move |UnitPoint(p): UnitPoint, _: f64| {
                let inside = p[0] >= cell[0] && p[0] < cell[0] + strip && p[1] >= cell[1] && p[1] < cell[1] + dy;
                if inside { 1.0 } else { 0.004 }
            };
            let place = [cell[0] + 0.5 * dx, cell[1] + 0.5 * dy, 0.5];
            frames.push((1..=LIMIT).find(|_| {
                run.frame(spot);
                !run.map.gate().trusts(UnitPoint(place))
            }));
        }
        let mean = frames.iter().map(|f| f64::from(f.unwrap_or(LIMIT))).sum::<f64>() / frames.len() as f64;
        println!("share 1/{:.0}: {mean:.1} frames, true rms of the cell {:.3}", 1.0 / share, share.sqrt());
        found.push((share, mean));
    }
    // A spot matters to the cell's promise from a share of the tolerance squared on, 1 / 1111. With eight points a frame it is hit within
    // 1111 / 8 = 139 frames on average.
    let matters: Vec<&(f64, f64)> = found.iter().filter(|f| f.0 > TOLERANCE * TOLERANCE).collect();
    let slowest = matters[matters.len() - 1];
    for (share, mean) in &matters {
        assert!(*mean < 2.0 * (1.0 + 1.0 / (8.0 * share)), "{share}: {mean} frames");
    }
    let hidden = found.iter().find(|f| f.1 > 10.0).expect("thin ones hide");
    row([
        "a hot spot thinner than a trust cell or a node",
        &format!("1/{:.0} of a cell: {:.0} frames until an audit point hits it", 1.0 / hidden.0, hidden.1),
        "`trusted_error` from then on",
        "traces at least eight points a cell and frame wherever the surrogate answers",
        &format!(
            "{:.2} of the ramp in the cell meanwhile; at the tolerance (1/{:.0} of a cell) {:.0} frames",
            hidden.0.sqrt(),
            1.0 / slowest.0,
            slowest.1
        ),
        "a_hot_spot_thinner_than_a_cell",
    ]);
}
