//! What a page is told of work that takes long.

use crate::kit::program::{ridgewatch, set, start, text};
use crate::kit::scene::{self, SMALL_NETWORK, double_gyre};
use crate::program::{parts, url};
use crate::visitor::Visitor;
use crate::{Stage, raw_publisher, values};
use ridgewatch::dashboard::{Dashboard, DashboardSettings, Token};
use ridgewatch::progress::Work;
use ridgewatch_zmtp::Keep;
use serde_json::{Value, json};
use std::time::{Duration, Instant};

const TRACING: &str = "tracing the table of this test";

/// Other tests of this process have work as well, which is told first if it began earlier.
#[test]
fn the_page_of_a_run_is_told_its_work_and_the_time_left_and_is_not_silent_meanwhile() {
    let (stage, _newest) = values::stage(None);
    let apart = Stage::new();
    let mut visitor = stage.visit();
    let _publisher = raw_publisher(&stage, &mut visitor);
    let tells = |state: &Value| state["work"].as_str().is_some_and(|work| work.starts_with(TRACING));
    let work = Work::begun(TRACING, Instant::now() - Duration::from_secs(3));
    work.reached(1, 4);
    let state = visitor.until_state(tells);
    let told = state["work"].as_str().unwrap();
    assert!(told.starts_with(&format!("{TRACING}: 25 %, about ")) && told.ends_with(" s left"), "{told}");
    let state = visitor.until_state(|state| tells(state) && state["seconds_since_message"].as_f64().unwrap() > 4.0);
    assert_eq!(state["status"], "following");
    let state = apart.visit().until_state(|_| true);
    assert!(state["work"].is_null(), "no run is there: {state}");
    drop(work);
    visitor.until_state(|state| !tells(state));
    visitor.until_state(|state| state["work"].is_null() && state["status"] == "silent");
}

/// A run in another process tells it by messages.
#[test]
fn a_page_apart_from_the_run_is_told_its_work_by_messages_and_is_not_silent_meanwhile() {
    let stage = Stage::new();
    let mut visitor = stage.visit();
    let publisher = raw_publisher(&stage, &mut visitor);
    let words = format!("{TRACING}: 25 %, about 9 s left, {}", "a".repeat(1000));
    let tell = |marks: u32| {
        let mark = json!({"protocol": 3, "work": words, "marks": marks}).to_string();
        publisher.send(&[b"work"], mark.into_bytes(), Keep::Note);
        std::thread::sleep(Duration::from_millis(300));
    };
    std::thread::scope(|scope| {
        scope.spawn(|| (0..25).for_each(tell));
        let state = visitor.until_state(|state| state["seconds_since_message"].as_f64().unwrap() > 4.0);
        assert_eq!((&state["work"], &state["status"]), (&json!(words[..300]), &json!("following")), "{state}");
    });
    visitor.until_state(|state| state["work"].is_null() && state["status"] == "silent");
}

#[test]
fn a_run_tells_its_page_and_one_apart_how_far_a_frame_a_target_and_training_are() {
    let folder = tempfile::tempdir().unwrap();
    let common = "time.tau = 10\ntime.slides = 1\nflow.steps = 20\n";
    let network =
        format!("surrogate.kind = \"network\"\nrender.method = \"two_level\"\ntraining.steps_per_frame = 10000000\n{SMALL_NETWORK}");
    for (name, picture, keys, begin, part) in [
        ("frame", [96, 48, 20_000], "render.method = \"reference\"\n", "rendering the frame: ", " %, about "),
        (
            "target",
            [256, 128, 2],
            "render.method = \"two_level\"\nsurrogate.kind = \"table\"\nrender.until = \"80dB\"\n",
            "refining to 80dB: ",
            " frames, ",
        ),
        ("training", [32, 16, 1], network.as_str(), "training: ", " %, about "),
    ] {
        let run = folder.path().join(name);
        std::fs::create_dir(&run).unwrap();
        let scene = scene::write(&run, &double_gyre(picture, &format!("{common}{keys}")));
        let endpoint = format!("ipc://{}", run.join("frames").display());
        let arguments = ["replay", &scene, "--device", "cpu", "--json", "--dashboard=0", "--publish", &endpoint, "--stop-within", "2"];
        let mut command = ridgewatch(arguments);
        command.args(["--out", text(&run.join("run"))]).args(set(&["publish.preview=false", "publish.exr=\"none\""]));
        let running = start(&mut command);
        let (address, token) = parts(&url(&running));
        let apart = Token::random().unwrap();
        let secret = apart.secret().to_owned();
        let apart = Dashboard::start(DashboardSettings::local(endpoint.clone(), Some(0), apart)).unwrap();
        for (address, token) in [(address, token), (apart.address(), secret)] {
            let state = Visitor::open(address, &token)
                .until_state(|state| state["work"].as_str().is_some_and(|work| work.starts_with(begin) && work.contains(part)));
            assert!(state["work"].as_str().unwrap().ends_with(" left"), "{state}");
        }
        running.signal(libc::SIGTERM);
        running.wait();
    }
}
