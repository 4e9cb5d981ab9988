//! Maps as frames: which scenes have them, what they show, and when they are good enough.

use crate::kit::program::{config, records, set, summary, text};
use crate::kit::scene::{GYRE_BOX, run_frames, setup};
use crate::ridgewatch;
use ridgewatch::render::Method;
use ridgewatch::run::{Frame, RunOptions, RunReport};

fn gyre(keys: &str) -> String {
    format!("source.kind = \"double_gyre\"\n{GYRE_BOX}\ntime.tau = 10\nrender.width = 64\nrender.height = 32\n{keys}\n")
}

/// Frames of a scene, and its report.
fn frames(scene: &str) -> (Vec<Frame>, RunReport) {
    let mut frames = Vec::new();
    let report = run_frames(setup(scene, &[]), &RunOptions::default(), |frame| frames.push(frame));
    (frames, report)
}

#[test]
fn flows_in_two_dimensions_are_maps_unless_the_scene_has_what_volumes_have() {
    let camera = "camera.eye = [1, 0.5, 1.2]\ncamera.look_at = [1, 0.5, 0.2]\ncamera.up = [0, 1, 0]";
    for (keys, wanted, why) in [
        ("", Method::Map, "the flow has two dimensions"),
        ("render.until = \"40dB\"\ntransfer.low = 0.1", Method::Map, "the flow has two dimensions"),
        (camera, Method::TwoLevel, "the scene sets camera"),
        ("light.direction = [0, 0, -1]\nlight.radiance = [12, 12, 12]", Method::TwoLevel, "the scene sets light"),
        ("transfer.extinction = 60", Method::TwoLevel, "the scene sets transfer.extinction"),
        ("render.budget = 50", Method::TwoLevel, "the scene sets render.budget"),
        ("surrogate.kind = \"residual\"", Method::TwoLevel, "the scene sets surrogate"),
        ("trust.tolerance = 0.01", Method::TwoLevel, "the scene sets trust"),
    ] {
        let setup = setup(&gyre(keys), &[]);
        assert_eq!(setup.plan.scene.render.method, wanted, "{keys}");
        let decision = setup.decisions.iter().find(|decision| decision.setting == "render.method").unwrap();
        assert!(decision.why.contains(why) && decision.chosen == wanted.name(), "{keys}: {decision}");
    }
    // What is named is no choice.
    let named = setup(&gyre("render.method = \"reference\""), &[]);
    assert!(named.plan.scene.render.method == Method::Reference && named.decisions.is_empty());
    let volume = "source.kind = \"turbulence\"\nsource.nodes = [12, 12, 12]\nsource.snapshots = 4\ntime.tau = 2\n";
    assert_eq!(setup(volume, &[]).plan.scene.render.method, Method::TwoLevel);
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("x.png");
    ridgewatch(["render", &config("abc.toml"), "--method", "map", "--out", text(&out)])
        .refused(2, &["`render.method` is \"map\"", "of which the command map draws a level"]);
}

#[test]
fn seeds_accumulate_and_the_stated_error_is_that_against_many() {
    let common = "time.frames_per_slide = 3\ntime.slides = 2\ntransfer.low = 0\ntransfer.high = 0.4\nflow.steps = 40\n";
    let (found, report) = frames(&gyre(&format!("{common}render.samples = 3")));
    let samples: Vec<f64> = found.iter().map(|frame| frame.record.picture_error.unwrap().samples_per_pixel).collect();
    assert_eq!(samples, [4.0, 8.0, 12.0, 4.0, 8.0, 12.0], "three are rounded up to four, and a new window begins anew");
    assert_eq!(report.surrogate_bytes, 0);
    for frame in &found {
        let record = &frame.record;
        // The domain of two by one fills the picture.
        assert_eq!((record.method.as_str(), record.queries, record.traced, record.missing), ("map", 4 * 64 * 32, 4 * 64 * 32, 0));
        assert!(record.surrogate.is_none() && record.trusted_error.is_none() && record.preparation_traces == 0 && frame.gate.is_none());
    }
    // Seeds of another seed of the shifts, and many.
    let (many, _) = frames(&gyre(&format!("{common}render.samples = 1024\nseed = 77")));
    let truth = &many[0].film.ftle_mean;
    for frame in &found[..3] {
        let squared: f64 = frame.film.ftle_mean.iter().zip(truth).map(|(a, b)| (f64::from(a - b) / 0.4).powi(2)).sum();
        let (rms, stated) = ((squared / truth.len() as f64).sqrt(), frame.record.picture_error.unwrap().rms);
        assert!((stated.low..=stated.high).contains(&rms), "{rms} is not in {stated:?}");
        let layer: f64 = frame.film.error.iter().map(|error| f64::from(*error / 0.4).powi(2)).sum::<f64>() / truth.len() as f64;
        assert!((0.7..1.4).contains(&(layer.sqrt() / stated.value)), "the layer's root mean square: {} of {}", layer.sqrt(), stated.value);
    }
}

#[test]
fn a_slide_gets_frames_until_the_map_is_good_enough() {
    let (found, _) = frames(&gyre("render.until = \"38dB\"\nrender.samples = 2"));
    let psnr: Vec<f64> = found.iter().map(|frame| frame.record.picture_error.unwrap().psnr.value).collect();
    assert!(psnr.len() > 1 && psnr.last().unwrap() >= &38.0 && psnr[psnr.len() - 2] < 38.8, "{psnr:?}");
}

#[test]
fn the_program_tells_what_it_draws() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("gyre.toml"), gyre("time.slides = 1\ntime.frames_per_slide = 2")).unwrap();
    let (scene, run) = (folder.path().join("gyre.toml"), folder.path().join("run"));
    let outcome = ridgewatch(["replay", text(&scene), "--out", text(&run), "--device", "cpu"]).success();
    let (stdout, stderr) = (&outcome.stdout, &outcome.stderr);
    assert!(stdout.contains(" seeds") && !stdout.contains("surrogate") && !stderr.contains("extinction"), "{stdout}{stderr}");
    assert!(stderr.contains("0 or a low percentile"), "{stderr}");
    let records = records(&run);
    assert!(records.iter().all(|record| record.method == "map"));
    // Colours from 0 on, as the FTLE of the calm middle is far below the ridges.
    assert_eq!(records[0].transfer.low, 0.0);
    let decisions = summary(&run)["run"]["decisions"].clone();
    let of = |setting: &str| decisions.as_array().unwrap().iter().find(|decision| decision["setting"] == setting).cloned();
    assert_eq!(of("render.method").unwrap()["chosen"], "map");
    assert!(of("surrogate.table_nodes").is_none());
    // A page of a frame, from the run folder alone.
    let page = folder.path().join("page.svg");
    ridgewatch(["figure", text(&run), "-o", text(&page)]).success();
    let page = std::fs::read_to_string(page).unwrap();
    assert!(page.contains("Method: map, ") && page.contains("seeds a pixel") && page.contains("pixels with a value"), "{page}");
    let repeated = folder.path().join("again");
    let again = ridgewatch(["replay", text(&run.join("scene.toml")), "--out", text(&repeated), "--device", "cpu"]);
    again.success();
    assert_eq!(crate::kit::program::records(&repeated)[1].method, "map");
    let volume = folder.path().join("volume");
    let keys = set(&["render.method=reference"]);
    ridgewatch([&["replay", text(&scene), "--out", text(&volume), "--device", "cpu"][..], &keys].concat()).success();
    assert_eq!(crate::kit::program::records(&volume)[0].method, "reference");
}
