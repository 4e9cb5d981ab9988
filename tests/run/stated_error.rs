//! The error that the records of a run state, against the error that is measured afterwards; and trust after a slide.

use crate::kit::program::{self, text};
use crate::kit::scene;
use crate::ridgewatch;
use ridgewatch::backend::{
    AuditFindings, AuditRequest, Backend, BackendError, Cpu, DeviceError, FrameJob, FrozenOf, HostFrame, HostPicture, Rendered,
    SurrogateRequest, audit, render_on_cpu,
};
use ridgewatch::field::UnitPoint;
use ridgewatch::flow::{FlowMap, Tracer, VelocitySource};
use ridgewatch::render::Renderer;
use ridgewatch::run::{Event, FrameRecord, RunOptions, run_on};
use ridgewatch::source::Listener;
use ridgewatch::surrogate::{HostSurrogate, Predict, Samples};
use ridgewatch::trust::{REJECTED, TrustedError};
use std::sync::atomic::{AtomicBool, Ordering};

/// Records of a run with fixed numbers of training steps and fixed seeds: the same on every machine, except for rounding.
fn records(options: &[&str]) -> Vec<FrameRecord> {
    let folder = tempfile::tempdir().unwrap();
    let keys = "
        time.tau = 5
        time.seed_step = 0.1
        time.slides = 4
        time.frames_per_slide = 5
        flow.steps = 50
        training.steps_per_frame = 100
        network.batch = 2048
        surrogate.kind = \"network\"
    ";
    let scene = scene::write(folder.path(), &scene::double_gyre([32, 16, 4], keys));
    let out = folder.path().join("run");
    ridgewatch([&["replay", &scene, "--out", text(&out)][..], options].concat()).success();
    program::records(&out)
}

#[test]
fn a_run_knows_its_error_and_loses_and_regains_trust_on_a_slide() {
    let records = records(&["--verify", "100000"]);
    let pairs: Vec<_> = records.iter().filter_map(|r| Some((r.trusted_error?, r.verified_error?))).collect();
    assert!(pairs.len() >= 20, "{} of {} frames state an error", pairs.len(), records.len());
    // The bounds are those of the promise: 20 % in root mean square over frames, and the interval holds in 90 % of the frames.
    let relative = |(stated, verified): &(TrustedError, TrustedError)| stated.optical_rms / verified.optical_rms - 1.0;
    let rms = (pairs.iter().map(|pair| relative(pair).powi(2)).sum::<f64>() / pairs.len() as f64).sqrt();
    assert!(rms <= 0.2, "stated and verified error differ by {:.1} %", 100.0 * rms);
    let holds = |(stated, verified): &&(TrustedError, TrustedError)| {
        let [low, high] = stated.optical_rms_interval;
        (low..=high).contains(&verified.optical_rms)
    };
    let held = pairs.iter().filter(holds).count();
    assert!(held as f64 >= 0.9 * pairs.len() as f64, "the interval holds the truth in {held} of {} frames", pairs.len());

    // An interval that holds everything says nothing.
    let mut widths: Vec<f64> = pairs.iter().map(|(s, _)| (s.optical_rms_interval[1] - s.optical_rms_interval[0]) / s.optical_rms).collect();
    widths.sort_by(f64::total_cmp);
    let median = widths[widths.len() / 2];
    assert!(median <= 1.0, "the median interval is {median:.2} times as wide as its value");

    let of_slide = |slide: u64| records.iter().filter(move |r| r.slide == slide);
    for slide in 1..4 {
        let before = of_slide(slide - 1).next_back().unwrap();
        let (first, last) = (of_slide(slide).next().unwrap(), of_slide(slide).next_back().unwrap());
        assert!(first.trusted_volume < before.trusted_volume, "slide {slide} costs trust");
        assert!(last.trusted_volume > first.trusted_volume, "slide {slide}: trust is earned again");
    }
    // The traced share follows.
    let share = |record: Option<&FrameRecord>| record.unwrap().traced_share;
    let before = share(of_slide(1).next_back());
    let (first, last) = (share(of_slide(2).next()), share(of_slide(2).next_back()));
    assert!(first > before && last < first, "traced share {before:.3}, then {first:.3}, {last:.3}");
    // The surrogate's own PSNR over the whole domain is a learning curve.
    assert!(records.last().unwrap().surrogate_psnr.unwrap() > records[0].surrogate_psnr.unwrap() + 10.0);
}

#[test]
fn a_spent_tracing_budget_is_said_and_flagged() {
    let records = records(&["--set", "trust.trace_budget=1e-9", "--set", "time.slides=1"]);
    let spent: Vec<_> = records.iter().filter(|r| r.over_budget > 0).collect();
    assert!(!spent.is_empty(), "no frame had more to trace than a nanosecond allows");
    for record in &records {
        let said = record.warnings.iter().any(|w| w.contains("the tracing budget was spent"));
        assert_eq!(said, record.over_budget > 0, "frame {}: {:?}", record.frame, record.warnings);
        assert!(record.over_budget == 0 || record.tolerance_excess.is_some(), "frame {} is flagged", record.frame);
        assert!(record.traced + record.over_budget <= record.queries);
    }
    // The untrained network is far off where it is not trusted, and the frame states the excess.
    assert!(spent[0].tolerance_excess.unwrap() > 0.0, "{:?}", spent[0].tolerance_excess);
}

/// A surrogate that predicts a large log-stretch everywhere.
struct Corrupted<'a>(&'a dyn Predict);

impl Predict for Corrupted<'_> {
    fn name(&self) -> &'static str {
        self.0.name()
    }
    fn predict(&self, points: &[UnitPoint], out: &mut [f32]) -> Result<(), DeviceError> {
        self.0.predict(points, out)?;
        out.iter_mut().for_each(|log_stretch| *log_stretch += 10.0);
        Ok(())
    }
    fn bytes(&self) -> usize {
        self.0.bytes()
    }
}

/// The CPU, whose surrogate is corrupted while the flag is set.
struct Corrupting<'a>(&'a AtomicBool);

impl Corrupting<'_> {
    /// Calls `then` with the surrogate as it is now.
    fn with<T>(&self, surrogate: Option<&dyn Predict>, then: impl FnOnce(Option<&dyn Predict>) -> T) -> T {
        let corrupted = surrogate.filter(|_| self.0.load(Ordering::Relaxed)).map(Corrupted);
        then(corrupted.as_ref().map(|corrupted| corrupted as &dyn Predict).or(surrogate))
    }
}

impl Backend for Corrupting<'_> {
    type Tracer = Box<dyn Tracer>;
    type Surrogate = HostSurrogate;
    type Samples = Samples;
    type Picture = HostPicture;

    fn name(&self) -> String {
        "cpu".into()
    }
    fn prefetch(&self) -> Option<Listener> {
        None
    }
    fn tracer(&mut self, velocity: &VelocitySource, map: &FlowMap, t0: f64) -> Result<Self::Tracer, BackendError> {
        Cpu.tracer(velocity, map, t0)
    }
    fn surrogate(&mut self, request: &SurrogateRequest<'_>, tracer: &Self::Tracer) -> Result<HostSurrogate, BackendError> {
        Cpu.surrogate(request, tracer)
    }
    fn render(
        &mut self,
        job: &FrameJob<'_, Self>,
        renderer: &mut Renderer,
        picture: &mut HostPicture,
    ) -> Result<Rendered<Samples>, DeviceError> {
        let surrogate = job.surrogate.map(|surrogate| surrogate as &dyn Predict);
        self.with(surrogate, |surrogate| render_on_cpu(&HostFrame::of(job, job.tracer, surrogate), renderer, picture))
    }
    fn audit(
        &mut self,
        request: &AuditRequest<'_>,
        tracer: &Self::Tracer,
        surrogate: Option<&FrozenOf<Self>>,
    ) -> Result<AuditFindings, DeviceError> {
        let surrogate = surrogate.map(|surrogate| surrogate as &dyn Predict);
        self.with(surrogate, |surrogate| audit::audit(request, tracer, surrogate))
    }
    fn replan(&mut self, _: &DeviceError, _: &Self::Tracer, _: &mut Option<HostSurrogate>) -> Result<Option<String>, DeviceError> {
        Ok(None)
    }
}

/// Records of a picture that stands still, whose surrogate is corrupted from a frame on.
fn standing(method: &str, kind: &str, corrupted_from: Option<u64>) -> Vec<FrameRecord> {
    of_a_picture([32, 16, 4], method, kind, "", corrupted_from)
}

fn of_a_picture(size: [usize; 3], method: &str, kind: &str, keys: &str, corrupted_from: Option<u64>) -> Vec<FrameRecord> {
    let keys = format!(
        "
        time.tau = 5
        time.frames_per_slide = 8
        flow.steps = 50
        training.steps_per_frame = 100
        render.method = \"{method}\"
        surrogate.kind = \"{kind}\"
        {keys}
        {}",
        scene::SMALL_NETWORK
    );
    let setup = scene::setup(&scene::double_gyre(size, &keys), &[]);
    let is_corrupted = AtomicBool::new(corrupted_from == Some(0));
    let mut records = Vec::new();
    let mut sink = |event: Event| {
        if let Event::Frame(frame) = event {
            let next = frame.record.frame + 1;
            is_corrupted.store(corrupted_from.is_some_and(|first| next >= first), Ordering::Relaxed);
            records.push((*frame.record).clone());
        }
    };
    let options = RunOptions { threads: 2, ..RunOptions::default() };
    run_on(Corrupting(&is_corrupted), setup, &options, &mut sink, &AtomicBool::new(false)).unwrap();
    records
}

/// The gate chooses the nodes that a smooth picture traces for a network, so that it is weighed there as in `gated`.
#[test]
fn the_gate_of_a_smooth_picture_is_weighed_if_it_decides_what_is_traced() {
    for (method, kind, decides) in [("two_level", "network", true), ("marched", "network", true), ("two_level", "residual", false)] {
        let records = standing(method, kind, None);
        assert!(records.len() == 8 && records.iter().any(|record| record.trusted_error.is_some()), "{method}, {kind}: nothing is trusted");
        for record in &records {
            let is_weighed = decides && record.trusted_error.is_some();
            assert_eq!(record.gate_evidence.is_some(), is_weighed, "{method}, {kind}, frame {}", record.frame);
            assert_eq!(record.untraced_share.is_some(), decides, "{method}, {kind}, frame {}", record.frame);
        }
        // Each frame counts once. What is not trusted is traced over the pictures, not at once.
        let frames: Vec<u64> = records.iter().filter_map(|record| record.gate_frames).collect();
        assert!(frames.iter().zip(1..).all(|(frames, number)| *frames == number), "{method}, {kind}: {frames:?}");
        let shares: Vec<f64> = records.iter().filter_map(|record| record.untraced_share).collect();
        assert!(shares.iter().all(|share| (0.0..1.0).contains(share)), "{method}: {shares:?}");
        assert!(method == "marched" || shares.iter().all(|share| *share == 0.0), "all nodes are traced at once: {shares:?}");
    }
}

/// A small picture has time for few nodes: until all are traced, records tell how many show a network that nobody trusts, after a slide too.
#[test]
fn nodes_that_wait_to_be_traced_are_told() {
    let keys = "time.slides = 2";
    let records = of_a_picture([6, 3, 1], "two_level", "network", keys, None);
    let shares: Vec<f64> = records.iter().map(|record| record.untraced_share.unwrap()).collect();
    let (before, after) = shares.split_at(8);
    assert!(before[0] > 0.3 && before.windows(2).all(|pair| pair[1] <= pair[0]) && before[7] < before[0], "{shares:?}");
    assert!(after[0] > before[7], "the slide closed cells: {shares:?}");
    // Nodes of cells that are not trusted, and what of others lies in the same bricks.
    let at_most = |record: &FrameRecord, share: f64| share <= 1.25 * (1.0 - record.trusted_volume);
    assert!(at_most(&records[0], shares[0]) && at_most(&records[8], shares[8]), "{shares:?}");
}

#[test]
fn a_corrupted_network_of_a_smooth_picture_is_found_in_a_frame() {
    let healthy = standing("two_level", "network", None);
    // Nothing speaks against a gate that is open. The first frames are those of a network that was hardly trained.
    let is_open = |record: &FrameRecord| record.trusted_volume > 0.1 && record.gate_evidence.is_some_and(|evidence| evidence < 1.0);
    let first = (2..healthy.len() - 1).find(|&frame| is_open(&healthy[frame])).expect("a tenth of the domain is trusted");
    let records = standing("two_level", "network", Some(first as u64));
    let [found, next] = [&records[first], &records[first + 1]];
    assert_eq!(found.trusted_volume, healthy[first].trusted_volume, "the gate was chosen before");
    let is_said = |record: &FrameRecord| record.warnings.iter().any(|warning| warning.contains("every cell must earn trust again"));
    assert!(found.gate_evidence.unwrap() >= REJECTED && is_said(found) && !is_said(&healthy[first]), "{:?}", found.gate_evidence);
    // A large log-stretch is right only where the transfer function is saturated.
    let reset = records[first + 1..].iter().find_map(|record| record.gate_frames);
    assert!(reset.is_none_or(|frames| frames == 1), "the evidence begins anew: {reset:?}");
    assert!(next.trusted_volume < 0.25 * found.trusted_volume, "{} trusted, then {}", found.trusted_volume, next.trusted_volume);
}
