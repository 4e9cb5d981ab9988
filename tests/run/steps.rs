//! The Runge-Kutta steps that a run chooses.

use crate::kit::{flow::quasi_random, scene};
use ridgewatch::field::{DomainPoint, UnitPoint, analytic::Analytic};
use ridgewatch::flow::{Extras, FlowMap, Steps, Traced, VelocitySource, cpu_tracer, dormand_prince_tracer};
use ridgewatch::render::Film;
use ridgewatch::run::{RunError, RunOptions, RunReport, Setup, Slide, Slides, settled_colours};
use ridgewatch::trust::TrustSettings;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

const SCENES: [(&str, &str); 2] = [
    (
        "turbulence",
        "source.nodes = [48, 24, 24]\nsource.amplitude = 8.0\nsource.k_max = 30.0\nsource.snapshots = 8\ntime.tau = 7.0\ntime.slides = 1",
    ),
    ("double_gyre", "domain.min = [0, 0, 0]\ndomain.max = [2, 1, 0.2]\ntime.tau = 10\ntime.slides = 1"),
];

fn report(kind: &str, keys: &str, method: &str, others: &[&str]) -> RunReport {
    let text = scene::scene(kind, [16, 8, 1], &format!("{keys}\nrender.method = \"{method}\"\nsurrogate.kind = \"table\""));
    scene::run_frames(scene::setup(&text, others), &RunOptions::default(), |_| {})
}

#[test]
fn a_smooth_picture_takes_as_few_steps_as_its_colours_do_not_tell_from_more() {
    for (kind, keys) in SCENES {
        let full = report(kind, keys, "reference", &[]);
        let found = report(kind, keys, "two_level", &[]);
        let (most, steps) = (full.integration_steps.unwrap(), found.integration_steps.unwrap());
        assert_eq!(full.integration_residual, None, "tracking is the reference of other methods");
        assert!(4 * steps <= 3 * most, "{kind}: {steps} of {most} steps");
        assert_eq!(report(kind, keys, "marched", &[]).integration_steps, Some(steps));
        for method in ["gated", "surrogate"] {
            assert_eq!(report(kind, keys, method, &[]).integration_steps, Some(most), "{method}");
        }
        // Where the samples show nothing, nothing is told from it.
        let unseen = report(kind, keys, "two_level", &["transfer.low=1e3", "transfer.high=2e3"]);
        assert_eq!((unseen.integration_steps, unseen.integration_residual), (Some(most), None));
        // A tolerance of the user's is about the log-stretch.
        let obeyed = report(kind, keys, "two_level", &["flow.tolerance=0.01"]);
        assert_eq!(obeyed.integration_residual, None);
        assert!(obeyed.integration_difference.unwrap() <= 0.01);

        // The truth, by another integrator, on points of its own.
        let text = scene::scene(kind, [16, 8, 1], keys);
        let mut setup = scene::setup(&text, &[]);
        let slide = setup.slides.next_slide(&AtomicBool::new(false)).ok().flatten().unwrap();
        let plan = &setup.plan;
        let fixed = |steps| FlowMap { steps: Steps::Fixed(steps), ..plan.map.clone() };
        let tracer = cpu_tracer(slide.velocity.clone(), &fixed(steps), slide.time).unwrap();
        let colours = settled_colours(plan, &tracer, &slide).unwrap();
        let truth = dormand_prince_tracer(slide.velocity.clone(), &fixed(steps), slide.time, 1e-10).unwrap();
        let points: Vec<DomainPoint> = (0..4096).map(|i| plan.domain.from_unit(UnitPoint(quasi_random(i).map(|x| x as f32)))).collect();
        let ramps = |tracer: &dyn ridgewatch::flow::Tracer| {
            let mut out = Traced::default();
            tracer.trace(&points, Extras::default(), &mut out);
            let (low, high, tau) = (colours.low.unwrap(), colours.high.unwrap(), plan.map.tau);
            out.log_stretch.iter().map(|&s| ((f64::from(s) / tau - low) / (high - low)).clamp(0.0, 1.0)).collect::<Vec<_>>()
        };
        let (ours, theirs) = (ramps(&*tracer), ramps(&*truth));
        let rms = (ours.iter().zip(&theirs).map(|(a, b)| (a - b).powi(2)).sum::<f64>() / points.len() as f64).sqrt();
        let share = if plan.domain.dimensions == 3 { 1.0 } else { 0.1 };
        assert!(rms <= share * TrustSettings::default().tolerance, "{kind}: {rms} with {steps} steps");
        let stated = found.integration_residual.unwrap();
        assert!((0.7..=1.5).contains(&(stated / rms)), "{kind}: {rms} with {steps} of {most} steps, stated {stated}");
    }
}

/// Where paths end at an edge, fewer steps shorten all of them: the picture keeps an error that no sample shows, and states it.
#[test]
fn the_picture_states_what_fewer_steps_leave_in_it() {
    let keys = "domain.min = [0, 0, 0]\ndomain.max = [6.283, 6.283, 6.283]\nflow.boundary = \"stop\"\ntime.tau = 4\ntime.slides = 1\nsurrogate.kind = \"table\"";
    let frame = |method: &str, samples: usize, others: &[&str]| {
        let text = scene::scene("abc", [48, 32, samples], &format!("{keys}\nrender.method = \"{method}\""));
        let mut found = None;
        let report = scene::run_frames(scene::setup(&text, others), &RunOptions::default(), |frame| {
            found.get_or_insert(frame);
        });
        (found.unwrap(), report)
    };
    let (first, report) = frame("two_level", 4, &[]);
    let stated = first.record.picture_error.unwrap();
    let transfer = report.transfer.unwrap();
    let colours = [format!("transfer.low={}", transfer.low), format!("transfer.high={}", transfer.high)];
    // Pictures of both numbers of steps by the same random numbers, twice: the product of two differences is free of their noise.
    let film = |steps: Option<usize>, seed: &str| {
        let steps = steps.map(|steps| format!("flow.steps={steps}"));
        let others: Vec<&str> = colours.iter().chain(&steps).map(String::as_str).chain([seed]).collect();
        frame("reference", 256, &others).0.film
    };
    let [one, other] = ["seed=11", "seed=12"].map(|seed| [report.integration_steps, None].map(|steps| film(steps, seed)));
    let lit: Vec<usize> = (0..one[1].rgba.len()).filter(|&pixel| one[1].rgba[pixel][3] > 0.01).collect();
    let apart = |[few, many]: &[Arc<Film>; 2], pixel: usize, k: usize| f64::from(few.rgba[pixel][k] - many.rgba[pixel][k]);
    let square = |&pixel: &usize| (0..3).map(|k| apart(&one, pixel, k) * apart(&other, pixel, k)).sum::<f64>() / 3.0;
    let rms = (lit.iter().map(square).sum::<f64>() / lit.len() as f64).sqrt();
    assert!((0.8..=1.25).contains(&(stated.steps_rms / rms)), "{rms}, stated {}", stated.steps_rms);
    assert!(stated.rms.value >= stated.steps_rms && stated.rms.low >= stated.steps_rms, "{stated:?}");
    // Steps that the scene gives, or the log-stretch asks for, are those of the field.
    for given in ["flow.steps=40", "flow.tolerance=0.01"] {
        assert_eq!(frame("two_level", 4, &[given]).0.record.picture_error.unwrap().steps_rms, 0.0, "{given}");
    }
}

/// Slides of a double gyre that turns at another speed in each.
pub struct Gusts {
    pub first: Slide,
    pub speeds: std::vec::IntoIter<f64>,
}

impl Slides for Gusts {
    fn next_slide(&mut self, _: &AtomicBool) -> Result<Option<Slide>, RunError> {
        let Some(speed) = self.speeds.next() else { return Ok(None) };
        let VelocitySource::Analytic(_, domain) = self.first.velocity.clone() else { unreachable!("a closed form") };
        let flow = Analytic::DoubleGyre { amplitude: speed, epsilon: 0.1, omega: std::f64::consts::TAU / 10.0 };
        let slide = Slide { velocity: VelocitySource::Analytic(flow, domain), ..self.first.clone() };
        self.first.index += 1;
        Ok(Some(slide))
    }

    fn expected(&self) -> Option<u64> {
        Some(self.speeds.len() as u64)
    }
}

#[test]
fn a_faster_flow_gets_more_steps_and_a_calm_one_fewer() {
    let (kind, keys) = SCENES[1];
    let text = scene::scene(kind, [16, 8, 1], &format!("{keys}\nrender.method = \"marched\"\nsurrogate.kind = \"table\""));
    let speeds = vec![0.1, 0.1, 0.4, 0.4, 0.1];
    let count = speeds.len();
    let mut setup = scene::setup(&text, &[]);
    let first = setup.slides.next_slide(&AtomicBool::new(false)).ok().flatten().unwrap();
    let mut found = Vec::new();
    scene::run_frames(Setup { slides: Box::new(Gusts { first, speeds: speeds.into_iter() }), ..setup }, &RunOptions::default(), |frame| {
        found.push((frame.record.integration_steps.unwrap(), frame.record.integration_residual));
    });
    assert_eq!(found.len(), count);
    assert_eq!(found[0], found[1], "nothing has changed");
    assert!(found[2].0 > 2 * found[0].0, "{found:?}");
    assert_eq!(found[2], found[3], "nothing has changed");
    assert_eq!(found[4], found[0], "the flow is the first one again");
    let most = TrustSettings::default().tolerance / 15.0;
    assert!(found[2].1.is_some_and(|residual| residual <= most), "{found:?}");
}
