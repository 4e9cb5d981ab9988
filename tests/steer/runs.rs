//! What commands do to a run.

use crate::kit;
use crate::kit::program::{ridgewatch, set, start, text, until};
use crate::kit::scene::{double_gyre, run_frames, scene as scene_of, setup, write};
use ridgewatch::run::{ColorBar, Event, Frame, RunOptions, RunReport, Setup, Steering, run};
use ridgewatch::steer::{Outcome, Steerer};
use serde_json::{Value, json};
use std::collections::{BTreeMap, HashSet};
use std::os::unix::fs::MetadataExt;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

const CAMERA: &str =
    r#"{"eye": [0.5, 0.25, 1.0], "look_at": [0.5, 0.25, 0.1], "up": [0, 1, 0], "field_of_view": 60, "orthographic": true}"#;

/// Runs a scene; `seen` gets the commands, and each frame. It ends the run by returning true.
fn steered(setup: Setup, mut seen: impl FnMut(&Arc<Steering>, &Frame) -> bool + Send) -> (Vec<Frame>, RunReport) {
    let steering = Arc::new(Steering::new(&setup.plan));
    let options = RunOptions { steering: Some(Arc::clone(&steering)), threads: 2, ..RunOptions::default() };
    let (stop, mut frames) = (AtomicBool::new(false), Vec::new());
    let mut sink = |event: Event| {
        if let Event::Frame(frame) = event {
            if seen(&steering, &frame) {
                stop.store(true, Ordering::Relaxed);
            }
            frames.push(frame);
        }
    };
    let report = run(setup, &options, &mut sink, &stop).unwrap();
    (frames, report)
}

fn command(steering: &Steering, set: Value) {
    steering.command(set.as_object().unwrap()).unwrap();
}

fn scene(keys: &str) -> Setup {
    setup(&double_gyre([48, 24, 4], &format!("time.tau = 10\nflow.steps = 20\nsurrogate.kind = \"table\"\n{keys}")), &[])
}

#[test]
fn a_command_is_in_effect_and_in_the_record_of_the_next_frame() {
    for method in ["reference", "gated", "two_level"] {
        let setup = scene(&format!("time.frames_per_slide = 6\nrender.method = \"{method}\"\n"));
        let camera: Value = serde_json::from_str(CAMERA).unwrap();
        let (frames, _) = steered(setup, |steering, frame| {
            match frame.record.frame {
                1 => command(steering, json!({"camera": camera, "trust.tolerance": 0.25})),
                2 => assert!(steering.command(json!({"camera": {}}).as_object().unwrap()).is_err()),
                3 => command(steering, json!({"camera": null, "transfer": {"low": 0.01, "high": 0.02}})),
                _ => {}
            }
            false
        });
        let records: Vec<_> = frames.iter().map(|frame| &*frame.record).collect();
        assert_eq!(records.len(), 6, "{method}");
        let numbers: Vec<Vec<u64>> = records.iter().map(|record| record.commands.iter().map(|command| command.number).collect()).collect();
        assert_eq!(numbers, [vec![], vec![], vec![1], vec![], vec![2], vec![]], "{method}");
        let given = serde_json::from_value(camera.clone()).unwrap();
        assert_eq!((&records[2].camera, &records[3].camera), (&Some(given), &records[2].camera), "{method}");
        assert_ne!(records[1].camera, records[2].camera);
        assert_eq!((records[1].tolerance, records[2].tolerance, records[5].tolerance), (0.03, 0.25, 0.25));
        // Back home, with other colours.
        assert_eq!((&records[4].camera, records[4].scale), (&records[0].camera, records[0].scale));
        assert_eq!((records[4].transfer.low, records[4].transfer.high), (0.01, 0.02));
        assert_eq!(frames[4].color_bar.as_ref().unwrap().high, 0.02);
        assert_ne!(frames[1].film.rgba, frames[2].film.rgba, "{method}: another view is another picture");
        assert_ne!(frames[4].film.rgba, frames[0].film.rgba, "{method}: other colours are another picture");
    }
}

/// Extinction and albedo change the picture alone, and stay with another tau, whose range is chosen anew.
#[test]
fn extinction_and_albedo_are_those_of_the_latest_command() {
    let keys = "time.frames_per_slide = 6\nrender.method = \"two_level\"\n";
    let setup = scene(keys);
    let settings = setup.plan.scene.clone();
    let (frames, _) = steered(setup, |steering, frame| {
        match frame.record.frame {
            0 => command(steering, json!({"transfer.extinction": 2.5})),
            2 => command(steering, json!({"transfer.albedo": "deep"})),
            4 => command(steering, json!({"time.tau": 5})),
            _ => {}
        }
        false
    });
    let transfer: Vec<_> = frames.iter().map(|frame| frame.record.transfer).collect();
    assert!(transfer[0].extinction > 3.0, "the scene leaves it open: {transfer:?}");
    assert!(transfer[1..].iter().all(|transfer| transfer.extinction == 2.5), "{transfer:?}");
    assert!(transfer[..5].iter().all(|t| t.low == transfer[0].low) && transfer[5].low != transfer[0].low, "{transfer:?}");
    let bar = |frame: usize| &frames[frame].color_bar.as_ref().unwrap().colors;
    assert!(bar(0) != bar(1) && bar(1) == bar(2) && bar(2) != bar(3) && bar(3) == bar(5));
    // A figure of the run has these colours too: the record tells them.
    for frame in &frames {
        assert_eq!(Some(ColorBar::of(&settings, &frame.record).unwrap()), frame.color_bar.as_deref().cloned(), "{}", frame.record.frame);
    }
    assert!(frames[1].film.rgba[..] != frames[0].film.rgba[..] && frames[3].film.rgba[..] != frames[2].film.rgba[..]);
    // Thinner, the picture lets more of the background through.
    let opacity = |frame: usize| frames[frame].film.rgba.iter().map(|pixel| f64::from(pixel[3])).sum::<f64>();
    assert!(opacity(1) < 0.9 * opacity(0), "{} after {}", opacity(1), opacity(0));
}

/// A finer tolerance, and a steeper ramp, show an error of the integration that the former ones did not.
#[test]
fn the_steps_of_the_integration_follow_tolerance_and_colours() {
    let keys = "time.tau = 10\ntime.frames_per_slide = 6\nsurrogate.kind = \"table\"\nrender.method = \"marched\"\ntrust.tolerance = 0.5\n";
    let (frames, report) = steered(setup(&double_gyre([48, 24, 1], keys), &[]), |steering, frame| {
        match frame.record.frame {
            1 => command(steering, json!({"trust.tolerance": 0.05})),
            3 => command(steering, json!({"transfer": {"low": 0.2, "high": 0.201}})),
            _ => {}
        }
        false
    });
    let steps: Vec<u64> = frames.iter().map(|frame| frame.record.integration_steps.unwrap()).collect();
    assert!(
        steps[0] == steps[1] && steps[2] > steps[1] && steps[3] == steps[2] && steps[4] > steps[3] && steps[5] == steps[4],
        "{steps:?}"
    );
    assert_eq!(report.integration_steps, Some(steps[5] as usize));
    for (number, tolerance) in [(0, 0.5), (2, 0.05)] {
        let residual = frames[number].record.integration_residual.unwrap();
        assert!(residual <= tolerance / 15.0, "frame {number}: {residual}");
    }
}

/// What fewer steps leave in a picture is measured for a new view once it stands, not while it moves.
#[test]
fn the_error_of_the_steps_is_that_of_the_view() {
    let keys = "domain.min = [0, 0, 0]\ndomain.max = [6.283, 6.283, 6.283]\nflow.boundary = \"stop\"\ntime.tau = 4\ntime.slides = 1
        time.frames_per_slide = 5\nsurrogate.kind = \"table\"\nrender.method = \"two_level\"\n";
    let corner = json!({"eye": [0.2, 0.2, 5.0], "look_at": [0.2, 0.2, 0.0], "up": [0, 1, 0], "field_of_view": 5, "orthographic": true});
    let (frames, _) = steered(setup(&scene_of("abc", [32, 24, 2], keys), &[]), |steering, frame| {
        if frame.record.frame == 1 {
            command(steering, json!({"camera": corner}));
        }
        false
    });
    let stated: Vec<f64> = frames.iter().map(|frame| frame.record.picture_error.unwrap().steps_rms).collect();
    assert!(stated[0] > 0.0 && stated[..3].iter().all(|rms| *rms == stated[0]), "{stated:?}");
    assert!(stated[3] != stated[0] && stated[4] == stated[3], "{stated:?}");
}

/// What a command sets is a decision no more, and what follows from it is decided anew.
#[test]
fn decisions_follow_commands() {
    let keys = "time.tau = 10\ntime.frames_per_slide = 3\nsurrogate.kind = \"table\"\nrender.method = \"marched\"\n";
    let decisions = |set: Option<Value>| {
        let (_, report) = steered(setup(&double_gyre([48, 24, 1], keys), &[]), |steering, frame| {
            if let Some(set) = set.as_ref().filter(|_| frame.record.frame == 0) {
                command(steering, set.clone());
            }
            false
        });
        let decisions: BTreeMap<String, String> = report.decisions.into_iter().map(|d| (d.setting, d.chosen)).collect();
        let transfer = report.transfer.unwrap();
        for (setting, value) in [("transfer.low", transfer.low), ("transfer.high", transfer.high)] {
            assert!(decisions.get(setting).is_none_or(|chosen| *chosen == value.to_string()), "{decisions:?}");
        }
        assert_eq!(decisions.get("flow.steps"), report.integration_steps.map(|steps| steps.to_string()).as_ref());
        decisions
    };
    let open = decisions(None);
    assert_eq!(open.keys().collect::<Vec<_>>(), ["flow.steps", "surrogate.table_nodes", "transfer.high", "transfer.low"]);
    let shorter = decisions(Some(json!({"time.tau": 5})));
    assert!(open.keys().eq(shorter.keys()), "{shorter:?}");
    assert!(["flow.steps", "transfer.low", "transfer.high"].iter().all(|setting| open[*setting] != shorter[*setting]), "{shorter:?}");
    let coloured = decisions(Some(json!({"transfer": {"low": 0.01, "high": 0.02}})));
    assert_eq!(coloured.keys().collect::<Vec<_>>(), ["flow.steps", "surrogate.table_nodes"]);
}

#[test]
fn what_comes_too_late_is_told() {
    let (frames, report) = steered(scene("render.method = \"reference\"\n"), |steering, _| {
        command(steering, json!({"trust.tolerance": 0.25}));
        false
    });
    assert!(frames.len() == 1 && frames[0].record.commands.is_empty());
    let told = report.warnings.iter().any(|warning| warning.contains("commands 1 to 1 came too late: no frame shows them"));
    assert!(told, "{:?}", report.warnings);
}

/// The bar is that of the box, not of what happens to be in the middle of the picture.
#[test]
fn a_view_past_the_box_keeps_the_colours_of_its_bar() {
    let aside = r#"{"eye": [4.0, 0.25, 1.0], "look_at": [4.0, 0.25, 0.1], "up": [0, 1, 0], "field_of_view": 60, "orthographic": true}"#;
    let (frames, _) = steered(scene("time.frames_per_slide = 2\nrender.method = \"reference\"\n"), |steering, frame| {
        if frame.record.frame == 0 {
            command(steering, json!({"camera": serde_json::from_str::<Value>(aside).unwrap()}));
        }
        false
    });
    let different = |frame: &Frame| {
        let mut colours = frame.color_bar.as_ref().unwrap().colors.clone();
        colours.dedup();
        colours.len()
    };
    assert!(different(&frames[0]) > 8 && different(&frames[1]) > 8, "{} and {} colours", different(&frames[0]), different(&frames[1]));
}

/// As many samples as if the picture had begun with that camera: nothing of the former view is left in it.
#[test]
fn an_accumulating_picture_starts_anew_with_another_camera() {
    let keys = "time.frames_per_slide = 8\nrender.method = \"two_level\"\nsurrogate.refine = false\n";
    let (frames, _) = steered(scene(keys), |steering, frame| {
        if frame.record.frame == 4 {
            command(steering, json!({"camera": serde_json::from_str::<Value>(CAMERA).unwrap()}));
        }
        false
    });
    let samples: Vec<f64> = frames.iter().map(|frame| frame.record.picture_error.unwrap().samples_per_pixel).collect();
    assert!(samples[4] > 3.0 * samples[0] && samples[5] < 0.5 * samples[4] && samples[7] > samples[5], "{samples:?}");
}

#[test]
fn a_pause_holds_the_window_and_its_frames_end_until_the_next_command() {
    let setup = scene("time.slides = 5\nrender.method = \"two_level\"\n");
    let mut since = None;
    let (frames, report) = steered(setup, |steering, frame| {
        match frame.record.frame {
            0 => command(steering, json!({"paused": true})),
            // The last frame before the run waits: 32 after the command. A command from elsewhere comes meanwhile.
            32 => {
                since = Some(Instant::now());
                let steering = Arc::clone(steering);
                std::thread::spawn(move || {
                    std::thread::sleep(Duration::from_millis(300));
                    command(&steering, json!({"paused": false}));
                });
            }
            33 => assert!(since.unwrap().elapsed() >= Duration::from_millis(300), "the run waits"),
            _ => {}
        }
        false
    });
    let slides: Vec<u64> = frames.iter().map(|frame| frame.record.slide).collect();
    assert_eq!((slides.len(), report.slides), (38, 5));
    assert!(slides[..34].iter().all(|slide| *slide == 0) && slides[34..] == [1, 2, 3, 4], "{slides:?}");
    let paused: Vec<_> = frames.iter().flat_map(|frame| &frame.record.commands).map(|command| command.set.paused).collect();
    assert_eq!(paused, [Some(true), Some(false)]);
}

#[test]
fn a_run_that_waits_for_a_command_ends_when_asked_or_when_its_time_is_up() {
    let begin = Instant::now();
    let keys = "time.slides = 5\nrender.method = \"reference\"\n";
    let setup = scene(keys);
    let steering = Arc::new(Steering::new(&setup.plan));
    command(&steering, json!({"paused": true}));
    let options = RunOptions { steering: Some(steering), seconds: Some(3.0), threads: 2, ..RunOptions::default() };
    let report = run(setup, &options, &mut |_| {}, &AtomicBool::new(false)).unwrap();
    assert_eq!((report.frames, report.slides, report.interrupted), (32, 1, false));
    assert!(begin.elapsed() >= Duration::from_secs(3));
    let (frames, report) = steered(scene(keys), |steering, frame| {
        command(steering, json!({"paused": true}));
        frame.record.frame == 2
    });
    assert!(frames.len() == 3 && report.interrupted);
}

#[tokio::test(flavor = "multi_thread")]
async fn the_program_is_steered_by_its_connection_file_alone() {
    let folder = tempfile::tempdir().unwrap();
    let scene = write(folder.path(), &double_gyre([32, 16, 1], "time.tau = 10\ntime.slides = 1000\nrender.method = \"reference\"\n"));
    let out = folder.path().join("run");
    let endpoint = format!("ipc://{}", folder.path().join("commands").display());
    let file = folder.path().join("commands.connection");
    let mut replay = ridgewatch(["replay", &scene, &format!("--steer={endpoint}"), "--out", text(&out)]);
    let running = start(replay.args(set(&["flow.steps=20", "publish.preview=false"])));
    until("a connection file", || file.exists());
    let mut steerer = Steerer::connect(&file).await.unwrap();
    let outcome = steerer.command(json!({"trust.tolerance": 0.125, "paused": true}).as_object().unwrap()).await.unwrap();
    assert!(matches!(outcome, Outcome::Accepted(state) if state.paused), "{outcome:?}");
    let records = || std::fs::read_to_string(out.join("records.jsonl")).unwrap_or_default();
    until("the command in a record", || records().contains(r#""commands":[{"number":1,"set":{"trust.tolerance":0.125,"paused":true}}]"#));
    running.signal(libc::SIGTERM);
    let outcome = running.wait_at_most(Duration::from_secs(60));
    assert!(outcome.stderr.contains(&format!("commands at {endpoint}, with the key in {}", file.display())), "{}", outcome.stderr);
    assert!(!file.exists(), "the key goes with the run");
    let mut replay = ridgewatch(["replay", &scene, "--steer=udp://127.0.0.1:1", "--out", text(&folder.path().join("no"))]);
    crate::kit::program::run(&mut replay).refused(2, &["udp://127.0.0.1:1", "neither tcp:// nor ipc://"]);
}

/// Each picture is that of its method: a smooth one states its error, the reference traces all, and the reference trains nothing.
#[test]
fn a_method_is_in_effect_on_the_next_frame() {
    let network = "surrogate.kind = \"network\"\nnetwork.levels = 2\nnetwork.log2_table = 8\nnetwork.width = 16\nnetwork.batch = 64\n";
    let keys = format!(
        "time.tau = 10\nflow.steps = 20\ntime.frames_per_slide = 15\ntraining.steps_per_frame = 2\nrender.method = \"two_level\"\n{network}"
    );
    let methods = ["reference", "gated", "marched", "two_level"];
    let (frames, report) = steered(setup(&double_gyre([32, 16, 2], &keys), &[]), |steering, frame| {
        let number = frame.record.frame as usize;
        if number % 3 == 2 && number < 12 {
            command(steering, json!({"render.method": methods[number / 3]}));
        }
        false
    });
    assert!(frames.len() == 15 && report.warnings.is_empty(), "{:?}", report.warnings);
    for (number, Frame { record, film, .. }) in frames.iter().enumerate() {
        let method = number.checked_sub(3).map_or("two_level", |since| methods[since / 3]);
        assert_eq!((record.method.as_str(), record.commands.len()), (method, usize::from(number > 0 && number % 3 == 0)), "frame {number}");
        let is_smooth = ["marched", "two_level"].contains(&method);
        // A picture that has just begun may know too little of its error to state one of all of it.
        assert!((record.picture_error.is_none() || is_smooth) && film.error.is_empty() != is_smooth, "frame {number}");
        let is_reference = method == "reference";
        assert_eq!((record.surrogate.is_none(), record.surrogate_psnr.is_none()), (is_reference, is_reference), "frame {number}");
        assert!(!is_reference || record.traced_share == 1.0 && record.traced > 0, "frame {number}");
        // What was trained before its first frame may be told with it.
        assert!(!is_reference || number % 3 == 0 || record.training.is_none(), "frame {number}: nothing is trained");
        assert!(
            is_reference || number == 0 || record.training.as_ref().is_some_and(|training| training.steps > 0) || number % 3 == 0,
            "frame {number}"
        );
    }
}

/// Seeds go on counting under other colours, and a new view begins anew. The map takes the place of other methods, and gives it back.
#[test]
fn a_map_is_steered() {
    let (low, high) = (0.02, 0.3);
    let (frames, report) = steered(scene("time.frames_per_slide = 7\nrender.method = \"two_level\"\n"), |steering, frame| {
        match frame.record.frame {
            0 => command(steering, json!({"render.method": "map"})),
            2 => command(steering, json!({"transfer": {"low": low, "high": high}})),
            3 => command(steering, json!({"camera": serde_json::from_str::<Value>(CAMERA).unwrap()})),
            5 => command(steering, json!({"render.method": "two_level"})),
            _ => {}
        }
        false
    });
    assert!(frames.len() == 7 && report.warnings.is_empty(), "{:?}", report.warnings);
    let methods: Vec<&str> = frames.iter().map(|frame| frame.record.method.as_str()).collect();
    assert_eq!(methods, ["two_level", "map", "map", "map", "map", "map", "two_level"]);
    let seeds: Vec<f64> = frames[1..6].iter().map(|frame| frame.record.picture_error.unwrap().samples_per_pixel).collect();
    assert_eq!(seeds, [4.0, 8.0, 12.0, 4.0, 8.0], "colours keep the seeds, a camera does not");
    assert_eq!((frames[3].record.transfer.low, frames[3].record.transfer.high), (low, high));
    let bar = frames[3].color_bar.as_ref().unwrap();
    assert_eq!((bar.low, bar.high, bar.colors[0], bar.colors[31]), (low, high, [68, 1, 84], [253, 231, 37]), "viridis");
    // The value at a pixel stays, its colour does not.
    let pixel = 12 * 48 + 20;
    let value = |frame: usize| frames[frame].film.ftle_mean[pixel];
    assert!((value(3) - value(2)).abs() < 0.1 * value(2).abs() && frames[3].film.rgba[pixel] != frames[2].film.rgba[pixel]);
    assert_ne!(frames[4].film.ftle_mean, frames[3].film.ftle_mean);
}

#[test]
fn a_budget_gives_the_next_frame_its_samples() {
    let keys = "time.frames_per_slide = 7\nrender.method = \"two_level\"\nsurrogate.refine = false\n";
    let (frames, _) = steered(scene(keys), |steering, frame| {
        match frame.record.frame {
            1 => command(steering, json!({"render.budget": 0.2})),
            // It waits for its method.
            3 => command(steering, json!({"render.method": "gated"})),
            4 => command(steering, json!({"render.method": "two_level", "render.budget": 40})),
            _ => {}
        }
        false
    });
    let samples: Vec<f64> = frames.iter().map(|frame| frame.record.samples_per_pixel).collect();
    assert_eq!((samples[1], samples[4]), (4.0, 4.0), "{samples:?}");
    // Its cost with another method says nothing about the first one with a budget.
    assert_eq!(samples[5], 0.25);
    // And nothing of the pictures before is left in its own.
    let held = |number: usize| frames[number].film.samples.iter().sum::<f32>() / frames[number].film.samples.len() as f32;
    assert!(held(1) > 6.0 && held(3) >= held(1) && held(5) < 1.0, "{} {} {}", held(1), held(3), held(5));
    // March and combination alone take longer.
    assert_eq!(samples[2..4], [1.0 / 16.0; 2]);
    // The frame before tells what a sample takes: tracing at least, and at most all of its time, of which the march is half as long as it goes on. If
    // that is above the budget, it is the march of a new picture, which does not come again.
    let seconds = frames[5].record.seconds;
    let [all, tracing] = [seconds.render + seconds.trace + seconds.predict, seconds.trace].map(|seconds| samples[5] * 0.04 / seconds);
    let fewest = if all > samples[5] { 0.5 * all } else { 0.0 };
    let limits = [fewest, tracing].map(|samples| samples.clamp(1.0 / 16.0, 4096.0));
    assert!((limits[0]..=limits[1]).contains(&samples[6]), "{samples:?}, not within {limits:?}");
}

/// Those that end in the pause are heard, so that others follow: at first only the one on its way ended.
#[test]
fn checkpoints_go_on_in_a_pause() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("weights");
    let network = "surrogate.kind = \"network\"\nnetwork.levels = 2\nnetwork.log2_table = 8\nnetwork.width = 16\nnetwork.batch = 64\n";
    let keys =
        format!("time.tau = 10\nflow.steps = 20\ntime.slides = 5\ntraining.steps_per_frame = 1\nrender.method = \"gated\"\n{network}");
    let setup = setup(&double_gyre([24, 12, 1], &keys), &[]);
    let steering = Arc::new(Steering::new(&setup.plan));
    let options = RunOptions {
        steering: Some(Arc::clone(&steering)),
        checkpoint: Some(path.clone()),
        checkpoint_seconds: Some(0.05),
        threads: 2,
        ..RunOptions::default()
    };
    let (stop, mut last) = (AtomicBool::new(false), 0);
    let report = std::thread::scope(|scope| {
        let mut sink = |event: Event| {
            let Event::Frame(frame) = event else { return };
            last = frame.record.frame;
            match last {
                0 => command(&steering, json!({"paused": true})),
                // The last frame of the pause. Each checkpoint is another file.
                32 => {
                    let (path, stop) = (&path, &stop);
                    scope.spawn(move || {
                        let (mut files, end) = (HashSet::new(), Instant::now() + Duration::from_secs(60));
                        while files.len() < 4 && Instant::now() < end {
                            files.extend(path.metadata().map(|about| (about.ino(), about.mtime_nsec())));
                            std::thread::sleep(Duration::from_millis(5));
                        }
                        stop.store(true, Ordering::Relaxed);
                        assert!(files.len() >= 4, "{files:?}");
                    });
                }
                _ => {}
            }
        };
        run(setup, &options, &mut sink, &stop).unwrap()
    });
    let totals = report.checkpoints.unwrap();
    assert!(last == 32 && totals.failed == 0 && totals.written >= 4, "{totals:?}");
}

/// The picture is the one that a run of that tau and direction makes, whatever was traced before, and later slides follow.
#[test]
fn tau_and_direction_are_in_effect_on_the_next_frame() {
    // Steps keep their length: 20 over 5 are 10 over 2.5.
    let (long, short) = ("time.tau = 5\nflow.steps = 20\n", "time.tau = 2.5\ntime.direction = \"backward\"\nflow.steps = 10\n");
    let marched = "surrogate.kind = \"table\"\nrender.method = \"marched\"\n";
    let gyre = |keys: &str| setup(&double_gyre([48, 24, 1], &format!("{marched}{keys}")), &[]);
    let turbulence = |keys: &str| {
        let source = "source.nodes = [24, 12, 12]\nsource.snapshots = 8\ntransfer.low = 0.05\ntransfer.high = 0.3\n";
        setup(&kit::scene::scene("turbulence", [48, 24, 1], &format!("{marched}{source}{keys}")), &[])
    };
    // The windows of the steered run end at 5 and 6, those of the other one at 3, 4 and 5. Closed forms have none, and the colours follow tau.
    for (name, steered_run, times, other, same) in [
        ("double gyre", gyre(&format!("{long}time.slides = 1\ntime.frames_per_slide = 2\n")), vec![0.0], gyre(short), 0),
        (
            "turbulence",
            turbulence(&format!("{long}time.slides = 2\ntime.frames_per_slide = 2\n")),
            vec![5.0, 6.0, 6.0],
            turbulence(&format!("{short}time.slides = 3\n")),
            2,
        ),
    ] {
        let (frames, report) = steered(steered_run, |steering, frame| {
            if frame.record.frame == 0 {
                command(steering, json!({"time.tau": 2.5, "time.direction": "backward"}));
            }
            false
        });
        assert!(report.warnings.is_empty(), "{name}: {:?}", report.warnings);
        let told: Vec<_> = frames.iter().map(|Frame { record, .. }| (record.tau, record.direction.as_str(), record.time)).collect();
        let mut expected = vec![(5.0, "forward", 0.0)];
        expected.extend(times.iter().map(|time| (2.5, "backward", *time)));
        assert_eq!(told, expected, "{name}");
        assert!(frames[1].record.warnings.is_empty(), "{name}: {:?}", frames[1].record.warnings);
        assert_eq!(frames[1].record.integration_steps, Some(10), "{name}");
        let mut others = Vec::new();
        run_frames(other, &RunOptions { threads: 2, ..RunOptions::default() }, |frame| others.push(frame));
        let (one, other) = (&frames[1], &others[same]);
        assert_eq!(one.record.transfer, other.record.transfer, "{name}");
        let distance = |a: &Frame, b: &Frame| {
            let squares = a.film.rgba.iter().flatten().zip(b.film.rgba.iter().flatten()).map(|(a, b)| f64::from(a - b).powi(2));
            squares.sum::<f64>().sqrt()
        };
        // How many rays are marched in the time of a frame is up to the machine.
        let (difference, apart) = (distance(one, other), distance(&frames[0], one));
        assert!(difference < 0.05 * apart, "{name}: {difference}, {apart}: another map is another picture");
    }
}

/// A run goes on with the map that it has where another one cannot be traced.
#[test]
fn a_tau_that_no_steps_suffice_for_is_told_and_has_no_effect() {
    let keys = "time.tau = 5\ntime.frames_per_slide = 3\nsurrogate.kind = \"table\"\nrender.method = \"marched\"\n";
    let (frames, _) = steered(setup(&double_gyre([24, 12, 1], keys), &[]), |steering, frame| {
        match frame.record.frame {
            0 => command(steering, json!({"time.tau": 2000})),
            1 => {
                let state = steering.command(&serde_json::Map::new()).unwrap();
                assert_eq!((state.tau, state.longest_tau), (5.0, None));
            }
            _ => {}
        }
        false
    });
    assert_eq!(frames.iter().map(|frame| frame.record.tau).collect::<Vec<_>>(), [5.0; 3]);
    let warnings = &frames[1].record.warnings;
    assert!(frames[1].record.commands.is_empty(), "{:?}", frames[1].record.commands);
    assert!(warnings.iter().any(|warning| warning.starts_with("tau and direction stay 5 and forward: ")), "{warnings:?}");
    assert!(frames[2].film.rgba.iter().flatten().all(|value| value.is_finite()));
}

/// A shorter tau has a larger FTLE, whose median may lie above the end that the scene gives.
#[test]
fn colours_that_do_not_suit_another_tau_stay() {
    let keys = "time.tau = 10\nflow.steps = 20\ntime.frames_per_slide = 2\ntransfer.high = 0.3\nsurrogate.kind = \"table\"\nrender.method = \"marched\"\n";
    let (frames, _) = steered(setup(&double_gyre([24, 12, 1], keys), &[]), |steering, frame| {
        if frame.record.frame == 0 {
            command(steering, json!({"time.tau": 0.5}));
        }
        false
    });
    let (before, after) = (&frames[0].record, &frames[1].record);
    assert_eq!((after.tau, after.transfer.low, after.transfer.high), (0.5, before.transfer.low, 0.3));
    assert!(after.warnings.iter().any(|warning| warning.starts_with("the colours stay, since")), "{:?}", after.warnings);
}

/// Labels of the former map would teach the network a wrong field.
#[test]
fn a_network_forgets_what_it_learned_of_another_map() {
    let network = "surrogate.kind = \"network\"\nnetwork.levels = 4\nnetwork.log2_table = 10\nnetwork.width = 16\nnetwork.batch = 512\n";
    let keys = format!(
        "time.tau = 5\nflow.steps = 20\ntime.frames_per_slide = 40\ntraining.steps_per_frame = 20\nrender.method = \"gated\"\n{network}"
    );
    let (frames, _) = steered(setup(&double_gyre([32, 16, 1], &keys), &[]), |steering, frame| {
        if frame.record.frame == 19 {
            command(steering, json!({"time.tau": 1.0, "time.direction": "backward"}));
        }
        false
    });
    let (before, after, last) = (&frames[19].record, &frames[20].record, &frames[39].record);
    assert!(before.traced_share < 0.9, "the network had earned trust: {}", before.traced_share);
    assert!(after.traced_share > before.traced_share, "{} {}", after.traced_share, before.traced_share);
    let psnr = |record: &ridgewatch::run::FrameRecord| record.surrogate_psnr.unwrap();
    assert!(psnr(last) > psnr(after) + 3.0, "it learns the new map: {} {}", psnr(after), psnr(last));
}
