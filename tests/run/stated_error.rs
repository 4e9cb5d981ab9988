//! The error that the records of a run state, against the error that is measured afterwards; and trust after a slide.

use crate::kit::program::{self, text};
use crate::kit::scene;
use crate::ridgewatch;
use ridgewatch::run::FrameRecord;
use ridgewatch::trust::TrustedError;

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
