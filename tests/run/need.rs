//! How much of its time training takes as its loss stalls and the window slides.

use crate::kit::scene::{self, SMALL_NETWORK};
use ridgewatch::run::{FrameRecord, RunOptions};

/// Records of a still double gyre on the CPU, whose network learns at a rate at which it learns nothing: the loss stands from the first
/// step, on any machine.
fn records(keys: &[&str]) -> Vec<FrameRecord> {
    let common = "
        time.tau = 5
        time.seed_step = 0.5
        time.slides = 2
        time.frames_per_slide = 24
        flow.steps = 25
        render.method = \"surrogate\"
        surrogate.kind = \"network\"
        network.learning_rate = 1e-9
    ";
    let text = scene::double_gyre([16, 8, 1], &[common, SMALL_NETWORK].concat());
    let mut records = Vec::new();
    scene::run_frames(scene::setup(&text, keys), &RunOptions::default(), |frame| records.push(FrameRecord::clone(&frame.record)));
    records
}

fn seconds(record: &FrameRecord) -> f64 {
    record.training.as_ref().map_or(0.0, |learned| learned.seconds)
}

#[test]
fn training_takes_less_time_once_its_loss_has_stalled_and_all_of_it_after_a_slide() {
    let records = records(&[]);
    let mut slides = Vec::new();
    for slide in 0..2 {
        let frames: Vec<&FrameRecord> = records.iter().filter(|record| record.slide == slide).collect();
        let needs: Vec<f64> = frames.iter().map(|record| record.training_need.unwrap()).collect();
        assert_eq!((needs[0], needs[needs.len() - 1]), (1.0, 1.0 / 16.0), "slide {slide}: {needs:?}");
        let mean = |at_full: bool| {
            let taken = frames.iter().filter(|record| (record.training_need == Some(1.0)) == at_full);
            let taken: Vec<f64> = taken.map(|record| seconds(record)).collect();
            taken.iter().sum::<f64>() / taken.len() as f64
        };
        slides.push([mean(true), mean(false)]);
    }
    let [before, after] = slides[..] else { unreachable!("two slides") };
    assert!(before[1] < 0.5 * before[0], "it falls: {slides:?}");
    assert!(after[0] > 0.5 * before[0], "and is back: {slides:?}");
}

#[test]
fn given_times_and_steps_of_training_stay_as_they_are() {
    let seconds_given = records(&["training.seconds_per_frame=0.05", "time.slides=1"]);
    let steps_given = records(&["training.steps_per_frame=200", "time.slides=1"]);
    assert!(seconds_given.iter().chain(&steps_given).all(|record| record.training_need.is_none()));
    let shortest = seconds_given.iter().map(seconds).fold(f64::INFINITY, f64::min);
    // The last step may end a little early.
    assert!(shortest > 0.04, "{shortest} s");
    // Long enough for the loss to stall.
    let steps: Vec<u64> = steps_given.iter().map(|record| record.training.as_ref().unwrap().steps).collect();
    assert!(steps.len() >= 24 && steps.iter().all(|&steps| steps == 200), "{steps:?}");
}
