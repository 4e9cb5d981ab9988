//! Commands to a run on the device.

use super::scenes::*;
use crate::kit::scene::{double_gyre, scene, setup};
use ridgewatch::backend::Device;
use ridgewatch::backend::cuda::GpuSettings;
use ridgewatch::publish::compare_films;
use ridgewatch::run::{Event, Frame, RunOptions, Steering, run};
use serde_json::{Value, json};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// Frames of a run that is given a command after its second frame.
fn steered(device: Device, scene: &str, set: &Value) -> Vec<Frame> {
    let setup = setup(scene, &[]);
    let steering = Arc::new(Steering::new(&setup.plan));
    let options = RunOptions { device, steering: Some(Arc::clone(&steering)), ..RunOptions::default() };
    let mut frames: Vec<Frame> = Vec::new();
    let mut sink = |event: Event| {
        if let Event::Frame(frame) = event {
            if frame.record.frame == 1 {
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
    let camera = json!({"eye": [0.5, 0.25, 1], "look_at": [0.5, 0.25, 0.1], "up": [0, 1, 0], "orthographic": true});
    let set = json!({"camera": camera, "transfer": {"low": 0.02, "high": 0.3}, "trust.tolerance": 0.02});
    // With a loose tolerance the steps of the first frames are few. A device refines its table after fewer frames than the CPU.
    for (method, key) in [("reference", "flow.steps = 20"), ("two_level", "flow.steps = 20"), ("two_level", "trust.tolerance = 0.5")] {
        let keys = format!(
            "time.tau = 10\ntime.frames_per_slide = 6\n{key}\nsurrogate.kind = \"table\"\nsurrogate.refine = false\nrender.method = \"{method}\"\n"
        );
        let scene = double_gyre([96, 48, 32], &keys);
        let (found, expected) = (steered(device(GpuSettings::default()), &scene, &set), steered(Device::CPU, &scene, &set));
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

/// The next frame starts from the other end of the window on the device, and later slides follow.
#[test]
#[ignore = "needs a GPU"]
fn tau_and_direction_are_steered_on_the_device() {
    let source = "source.nodes = [48, 24, 24]\nsource.snapshots = 9\ntransfer.low = 0.05\ntransfer.high = 0.3\n";
    let time = "time.tau = 5\nflow.steps = 20\ntime.slides = 2\ntime.frames_per_slide = 4\n";
    let network = "surrogate.kind = \"network\"\nnetwork.levels = 4\nnetwork.log2_table = 12\nnetwork.width = 16\nnetwork.batch = 1024\n";
    // A device refines its table after fewer frames than the CPU.
    let table = "surrogate.kind = \"table\"\nsurrogate.refine = false\n";
    let set = json!({"time.tau": 2.5, "time.direction": "backward"});
    for (method, surrogate) in [("reference", ""), ("marched", table), ("two_level", table), ("gated", network)] {
        let keys = format!("{source}{time}{surrogate}render.method = \"{method}\"\n");
        let scene = scene("turbulence", [96, 48, 32], &keys);
        let (found, expected) = (steered(device(GpuSettings::default()), &scene, &set), steered(Device::CPU, &scene, &set));
        let told = |frames: &[Frame]| {
            frames.iter().map(|Frame { record, .. }| (record.tau, record.direction.clone(), record.time)).collect::<Vec<_>>()
        };
        assert_eq!(told(&found), told(&expected), "{method}");
        assert_eq!((found[2].record.tau, found[2].record.time), (2.5, 5.0), "{method}");
        for (frame, other) in found.iter().zip(&expected) {
            assert!(
                frame.record.device.starts_with("cuda:0") && warnings(&frame.record).is_empty(),
                "{method}: {:?}",
                frame.record.warnings
            );
            let psnr = compare_films(&frame.film, &other.film, frame.tone_map).unwrap().psnr.unwrap_or(f64::INFINITY);
            measured!("tau and direction steered, `{method}`, frame {}: {psnr:.1} dB", frame.record.frame);
            // Two samplings of one picture, or the same march.
            assert!(psnr > if method == "marched" { 50.0 } else { 28.0 }, "{method}, frame {}: {psnr} dB", frame.record.frame);
        }
    }
}
