//! A dashboard that is a process of its own asks for the layers of the newest frame while a page needs them.

use crate::kit::program::until;
use crate::values::{agrees, body, bytes, film, frame, map_frame_above, stage_of};
use crate::visitor::{Received, get};
use crate::{LIMIT, Stage};
use ridgewatch::publish::{MapAbout, NewestFrame, PublishSettings, Publisher, RunAbout, channels_at, decode_exr};
use ridgewatch::render::Film;
use ridgewatch::run::Frame;
use ridgewatch::trust::Gate;
use serde_json::{Value, json};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

fn publisher(stage: &Stage, about: MapAbout) -> Publisher {
    let publisher = Publisher::start(&stage.endpoint(), &PublishSettings::default()).unwrap();
    publisher.describe(&RunAbout::new(Path::new("out/gulf"), about));
    publisher
}

#[test]
fn values_are_those_of_the_run_and_layers_are_subscribed_to_only_while_they_are_needed() {
    let stage = Stage::new();
    let (address, token) = (stage.address(), stage.token.as_str());
    let publisher = publisher(&stage, MapAbout::default());
    let film = Arc::new(film([9, 4], true));
    let ends = AtomicBool::new(false);
    let made = || publisher.statistics().layers;
    std::thread::scope(|scope| {
        scope.spawn(|| {
            for number in 0.. {
                publisher.frame(Frame { film: Arc::clone(&film), ..frame(number, Film::new(9, 4)) });
                if ends.load(Ordering::Relaxed) {
                    return;
                }
                std::thread::sleep(Duration::from_millis(50));
            }
        });
        let end = Ends(&ends);
        let mut visitor = stage.visit();
        let state = visitor.until_state(|state| state["status"] == "following");
        assert!(state["values"]["ready"].is_string(), "{state}");
        visitor.frame();
        // What an idle page asks for does not count.
        assert_eq!(get(address, &format!("/frame.png?if=newest&token={token}"), &[]).0, 204);
        std::thread::sleep(Duration::from_millis(1500));
        assert_eq!(made(), 0, "no page needs any");
        let begin = Instant::now();
        for (x, y) in (0..36).map(|pixel| (pixel % 9, pixel / 9)) {
            let (status, answer) = get(address, &format!("/values?token={token}&x={x}&y={y}"), &[]);
            assert_eq!(status, 200, "{answer}");
            let values: Value = serde_json::from_str(body(&answer)).unwrap();
            assert_eq!((&values["unit"], &values["slide"]), (&json!("1/day"), &json!(2)));
            agrees(&values, &film);
        }
        let (head, exr) = bytes(address, &format!("/frame.exr?token={token}"));
        assert!(head.contains("filename=\"gulf-frame-"), "{head}");
        let saved = decode_exr(&exr).unwrap();
        for pixel in (0..36).map(|pixel| [pixel % 9, pixel / 9]) {
            let bits = |film: &Film| channels_at(film, pixel).into_iter().map(|(name, value)| (name, value.to_bits())).collect::<Vec<_>>();
            assert_eq!(bits(&saved), bits(&film), "{pixel:?}");
        }
        visitor.until_state(|state| state["values"]["ready"] == "gulf");
        let first = get(address, &format!("/histogram?token={token}"), &[]);
        let number = |answer: &str| serde_json::from_str::<Value>(body(answer)).unwrap()["frame"].as_u64().unwrap();
        until("later layers", || number(&get(address, &format!("/histogram?token={token}"), &[]).1) > number(&first.1));
        let (most, seconds) = (made(), begin.elapsed().as_secs() + 2);
        assert!((2..=seconds).contains(&most), "{most} in {seconds} s");
        // Ten seconds after the last question they are given up.
        std::thread::sleep(Duration::from_secs(12));
        let before = made();
        assert!(before > most, "they went on for some seconds");
        std::thread::sleep(Duration::from_secs(3));
        assert_eq!(made(), before, "no page needs any");
        assert_eq!(get(address, &format!("/frame.png?if=newest&token={token}"), &[]).0, 204, "and none are kept");
        let (status, _) = get(address, &format!("/values?token={token}&x=0&y=0"), &[]);
        assert_eq!(status, 200, "they come again");
        drop(end);
    });
    // The run has ended: what is there stays until it is given up.
    publisher.finish(LIMIT);
    assert_eq!(get(address, &format!("/values?token={token}&x=0&y=0"), &[]).0, 200);
    std::thread::sleep(Duration::from_secs(12));
    let (status, answer) = get(address, &format!("/frame.json?token={token}"), &[]);
    assert!(status == 404 && answer.contains("the run is not reached"), "{status} {answer}");
}

#[test]
fn a_connection_that_ends_before_the_layers_have_come_is_named_and_not_tried_at_once() {
    let stage = Stage::new();
    let publisher = publisher(&stage, MapAbout::default());
    std::thread::scope(|scope| {
        // As of a client that takes longer than it may.
        scope.spawn(|| {
            std::thread::sleep(Duration::from_secs(3));
            publisher.finish(LIMIT);
        });
        for waited in [4, 1] {
            let begin = Instant::now();
            let (status, answer) = get(stage.address(), &format!("/values?token={}&x=0&y=0", stage.token), &[]);
            assert!(status == 404 && answer.contains("ended before its layers had come"), "{status} {answer}");
            assert!(begin.elapsed() < Duration::from_secs(waited), "{:?}", begin.elapsed());
        }
    });
}

/// Also when a test fails.
struct Ends<'a>(&'a AtomicBool);

impl Drop for Ends<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

#[test]
fn a_map_is_the_file_that_the_run_makes_of_it_and_trust_is_drawn() {
    let about: MapAbout = serde_json::from_value(json!({"title": "Gulf", "georeference": {
        "axes": [
            {"name": "lon", "units": "degrees_east", "standard_name": "longitude", "long_name": "Longitude", "positive": null, "conversion": {"Linear": 1.0}},
            {"name": "lat", "units": "degrees_north", "standard_name": "latitude", "long_name": null, "positive": null, "conversion": {"Linear": 1.0}},
        ],
        "mapping": {"name": "crs", "attributes": [["grid_mapping_name", "latitude_longitude"], ["earth_radius", [6_371_000.0]]]},
        "calendar": "proleptic_gregorian",
    }}))
    .unwrap();
    let map = map_frame_above(3, [8, 4]);
    let own = Arc::new(NewestFrame::new(Path::new("out/gulf"), about.clone()));
    own.put(map.clone());
    let (own, apart) = (stage_of(own), Stage::new());
    let publisher = publisher(&apart, about);
    publisher.frame(map.clone());
    let [own, file] = [&own, &apart].map(|stage| {
        let (address, target) = (stage.address(), format!("/frame.nc?token={}", stage.token));
        move || bytes(address, &target)
    });
    // The history has the second.
    until("the same file", || {
        let ((own, first), (head, second)) = (own(), file());
        assert!(own.starts_with("HTTP/1.1 200") && head.starts_with("HTTP/1.1 200"), "{own} {head}: {}", String::from_utf8_lossy(&second));
        first == second
    });
    let text = String::from_utf8_lossy(&file().1).into_owned();
    assert!(["degrees_north", "latitude_longitude", "Gulf"].iter().all(|words| text.contains(words)));
    let (status, answer) = get(apart.address(), &format!("/field.nc?token={}", apart.token), &[]);
    assert!(status == 404 && answer.contains("only a run with --dashboard has it"), "{answer}");
    // The trusted cells come with the layers: the left half of the domain.
    let gate = Gate::new([2, 1, 1], vec![true, false]);
    let mut record = (*map.record).clone();
    (record.frame, record.method, record.surrogate) = (4, "gated".into(), Some("table".into()));
    publisher.frame(Frame { gate: Some(Arc::new(gate)), record: Arc::new(record), ..map });
    until("the next frame", || {
        let (head, body) = bytes(apart.address(), &format!("/plane?of=trusted&token={}", apart.token));
        assert!(head.starts_with("HTTP/1.1 200"), "{head}");
        let Received { json, payload } = Received::of(&body);
        let shares: Vec<u8> = payload.chunks_exact(2).map(|half| u8::from(half == [0, 0x3c])).collect();
        json["frame"] == 4 && shares == [1, 1, 1, 1, 0, 0, 0, 0].repeat(4)
    });
}
