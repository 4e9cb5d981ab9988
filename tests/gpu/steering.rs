//! Commands to a run on the device.

use super::scenes::*;
use crate::kit::scene::{double_gyre, setup};
use ridgewatch::backend::Device;
use ridgewatch::backend::cuda::GpuSettings;
use ridgewatch::publish::compare_films;
use ridgewatch::run::{Event, Frame, RunOptions, Steering, run};
use serde_json::json;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// Frames of a run that is given another camera, other colours and another tolerance after its second frame.
fn steered(device: Device, method: &str, key: &str) -> Vec<Frame> {
    let keys = format!("time.tau = 10\ntime.frames_per_slide = 6\n{key}\nsurrogate.kind = \"table\"\nrender.method = \"{method}\"\n");
    let setup = setup(&double_gyre([96, 48, 32], &keys), &[]);
    let steering = Arc::new(Steering::new(&setup.plan));
    let options = RunOptions { device, steering: Some(Arc::clone(&steering)), ..RunOptions::default() };
    let mut frames: Vec<Frame> = Vec::new();
    let mut sink = |event: Event| {
        if let Event::Frame(frame) = event {
            if frame.record.frame == 1 {
                let camera = json!({"eye": [0.5, 0.25, 1], "look_at": [0.5, 0.25, 0.1], "up": [0, 1, 0], "orthographic": true});
                let set = json!({"camera": camera, "transfer": {"low": 0.02, "high": 0.3}, "trust.tolerance": 0.02});
                steering.command(set.as_object().unwrap()).unwrap();
            }
            frames.push(frame);
        }
    };
    run(setup, &options, &mut sink, &AtomicBool::new(false)).unwrap();
    frames
}

#[test]
#[ignore = "needs a GPU"]
fn a_steered_run_on_the_device_shows_the_cpu_s_film() {
    // With a loose tolerance the steps of the first frames are few.
    for (method, key) in [("reference", "flow.steps = 20"), ("two_level", "flow.steps = 20"), ("two_level", "trust.tolerance = 0.5")] {
        let (found, expected) = (steered(device(GpuSettings::default()), method, key), steered(Device::CPU, method, key));
        assert!(found[2].record.device.starts_with("cuda:0"));
        assert_eq!((found[2].record.commands.len(), &found[2].record.camera), (1, &expected[2].record.camera));
        assert_ne!(found[1].film.rgba, found[2].film.rgba);
        let steps = |frames: &[Frame]| frames.iter().map(|frame| frame.record.integration_steps.unwrap()).collect::<Vec<_>>();
        assert_eq!(steps(&found), steps(&expected));
        assert_eq!(steps(&found)[2] > steps(&found)[1], key.starts_with("trust"), "{method}, {key}: {:?}", steps(&found));
        let (last, other) = (&found[5], &expected[5]);
        let psnr = compare_films(&last.film, &other.film, last.tone_map).unwrap().psnr.unwrap_or(f64::INFINITY);
        measured!("steered, `{method}`, {key}: {psnr:.1} dB, {:?} steps", steps(&found));
        // Two samplings of one picture; of the view before, it would be below 20.
        assert!(psnr > 30.0, "{method}: {psnr} dB");
    }
}
