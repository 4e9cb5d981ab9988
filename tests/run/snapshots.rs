//! What a run says of its snapshots: what every second one is worth to the picture, and that `time.every` leaves the others out.

use super::notes::Single;
use crate::kit::{
    flow::{quasi_random, trace},
    scene,
};
use ridgewatch::field::{DomainPoint, Snapshot, UnitPoint, Window};
use ridgewatch::flow::{Extras, FlowMap, Precision, Steps, VelocitySource};
use ridgewatch::run::{Decision, RunOptions, RunReport, Setup, Slide};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

const SLOW: &str = "source.amplitude = 0.2\nsource.snapshots = 61\ntime.tau = 60";
const FAST: &str = "source.amplitude = 16\nsource.snapshots = 9\ntime.tau = 8";

fn turbulence(keys: &str, set: &[&str]) -> Setup {
    let keys = format!("{keys}\nsource.nodes = [24, 12, 12]\ntime.slides = 1\nrender.method = \"two_level\"\nsurrogate.kind = \"table\"");
    scene::setup(&scene::scene("turbulence", [16, 8, 1], &keys), set)
}

fn report(setup: Setup) -> RunReport {
    scene::run_frames(setup, &RunOptions::default(), |_| {})
}

fn told(report: &RunReport) -> Option<&Decision> {
    report.decisions.iter().find(|decision| decision.setting == "time.every")
}

/// The differences of the colours that a decision states: found, and allowed.
fn stated(decision: &Decision) -> [f64; 2] {
    ["differ by ", "allowed: "].map(|before| {
        let number = decision.why.split(before).nth(1).unwrap();
        number.split([' ', ';']).next().unwrap().parse().unwrap()
    })
}

fn first_slide(setup: &mut Setup) -> Slide {
    setup.slides.next_slide(&AtomicBool::new(false)).unwrap().unwrap()
}

fn window(slide: &Slide) -> &Arc<Window> {
    let VelocitySource::Window(window) = &slide.velocity else { panic!("a window") };
    window
}

#[test]
fn colours_differ_by_what_was_told_where_every_second_snapshot_is_enough() {
    let all = report(turbulence(SLOW, &[]));
    let decision = told(&all).unwrap();
    let [found, allowed] = stated(decision);
    assert!(decision.chosen == "1" && found <= allowed && decision.why.contains("time.every = 2 reads half"), "{decision}");
    // The same flow map at points of its own, in the colours of the run.
    let colours = all.transfer.unwrap();
    let ramps = |set: &[&str]| {
        let mut setup = turbulence(SLOW, set);
        let slide = first_slide(&mut setup);
        let map = FlowMap { steps: Steps::Fixed(240), precision: Precision::F64, ..setup.plan.map.clone() };
        let at = |i: usize| setup.plan.domain.from_unit(UnitPoint(quasi_random(i).map(|x| x as f32)));
        let points: Vec<DomainPoint> = (0..4096).map(at).collect();
        let stretches = trace(&slide.velocity, &map, slide.time, &points, Extras::default()).log_stretch;
        let ramp = |stretch: &f32| ((f64::from(*stretch) / map.tau - colours.low) / (colours.high - colours.low)).clamp(0.0, 1.0);
        (window(&slide).snapshots().len(), stretches.iter().map(ramp).collect::<Vec<_>>())
    };
    let ((count, ramps), (half, ramps_of_half)) = (ramps(&[]), ramps(&["time.every=2"]));
    assert_eq!((count, half), (61, 31));
    let squares = ramps.iter().zip(&ramps_of_half).map(|(a, b)| (a - b).powi(2));
    let rms = (squares.sum::<f64>() / ramps.len() as f64).sqrt();
    assert!((0.3..=1.3).contains(&(rms / found)), "{rms}, told {found}");
    // The run itself, of which nothing more is asked.
    let run = report(turbulence(SLOW, &["time.every=2"]));
    assert!(run.frames == 1 && told(&run).is_none(), "{run:?}");
    assert!(10 * run.window_bytes < 6 * all.window_bytes, "{} of {} bytes", run.window_bytes, all.window_bytes);
}

#[test]
fn a_fast_flow_needs_all_snapshots() {
    let report = report(turbulence(FAST, &[]));
    let decision = told(&report).unwrap();
    let [found, allowed] = stated(decision);
    assert!(decision.chosen == "1" && found > allowed && decision.why.ends_with("all are needed"), "{decision}");
}

/// Paths stop there, and would not without the snapshot.
#[test]
fn what_is_missing_in_a_single_snapshot_counts() {
    let mut setup = turbulence(SLOW, &[]);
    let mut slide = first_slide(&mut setup);
    let mut holed = Window::new(window(&slide).span());
    for (number, snapshot) in window(&slide).snapshots().enumerate() {
        let mut nodes = snapshot.nodes.clone();
        if number == 1 {
            let third = nodes.len() / 3;
            nodes[..third].fill([f32::NAN; 4]);
        }
        holed.push(Arc::new(Snapshot::new(snapshot.time, snapshot.grid.clone(), nodes))).unwrap();
    }
    slide.velocity = VelocitySource::Window(Arc::new(holed));
    let report = report(Setup { slides: Box::new(Single(Some(slide))), ..setup });
    let decision = told(&report).unwrap();
    let [found, allowed] = stated(decision);
    assert!(found > 3.0 * allowed && decision.why.ends_with("all are needed"), "{decision}");
}

#[test]
fn nothing_is_asked_where_steps_are_not_left_to_the_picture_or_hardly_anything_could_be_left_out() {
    for set in [
        &["flow.precision=f64"][..],
        &["flow.steps=120"],
        &["flow.tolerance=0.1"],
        &["render.method=reference"],
        &["source.snapshots=4", "time.tau=3"],
        &["time.every=3"],
    ] {
        let report = report(turbulence(SLOW, set));
        assert!(report.frames == 1 && told(&report).is_none(), "{set:?}: {:?}", report.decisions);
    }
}
