//! What the run keeps in its folder, for pages that look back further than what they received.

use crate::Stage;
use crate::kit::publishing;
use crate::values::{body, bytes};
use crate::visitor::{Received, get};
use ridgewatch::dashboard::DashboardSettings;
use ridgewatch::publish::{ExrFrames, Output, PublishSettings, RunFolder};
use ridgewatch::render::Film;
use ridgewatch::run::{Frame, FrameRecord};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

fn frame(number: u64) -> Frame {
    let film = Film { rgba: (0..24).map(|i| [i as f32 / 24.0, number as f32 / 20.0, 0.5, 1.0]).collect(), ..Film::new(6, 4) };
    publishing::frame(FrameRecord { frame: number, slide: number, size: [6, 4], time: number as f64, ..Default::default() }, film)
}

/// The folder of a run of ten frames, of which the pictures of the last three are kept.
fn run(folder: &Path, preview: bool) -> PathBuf {
    let path = folder.join("run");
    let settings =
        PublishSettings { keep: Some(3), preview, exr: if preview { ExrFrames::None } else { ExrFrames::Every }, ..Default::default() };
    let mut output = Output::start(&settings, Some(RunFolder::create(&path, false).unwrap())).unwrap();
    (0..10).for_each(|number| output.frame(frame(number)));
    output.finish(serde_json::Map::new());
    path
}

fn stage(run: &Path) -> Stage {
    Stage::start(tempfile::tempdir().unwrap(), |settings| DashboardSettings { run: Some(run.to_owned()), ..settings })
}

#[test]
fn pictures_that_the_run_keeps_are_read_by_their_number() {
    for preview in [true, false] {
        let folder = tempfile::tempdir().unwrap();
        let run = run(folder.path(), preview);
        let stage = stage(&run);
        let (address, token) = (stage.address(), &stage.token);
        assert_eq!(stage.visit().until_state(|_| true)["has_past"], true);
        let (status, answer) = get(address, &format!("/node/a/past.json?token={token}"), &[]);
        let listed: Value = serde_json::from_str(body(&answer)).unwrap();
        assert_eq!((status, &listed["frames"]), (200, &json!([7, 8, 9])));
        let numbers: Vec<u64> = listed["records"].as_array().unwrap().iter().map(|record| record["frame"].as_u64().unwrap()).collect();
        assert_eq!(numbers, (0..10).collect::<Vec<_>>());
        for number in 7..10 {
            let (head, found) = bytes(address, &format!("/past?frame={number}&token={token}"));
            assert!(head.starts_with("HTTP/1.1 200"), "{head}");
            let Received { json, payload } = Received::of(&found);
            assert_eq!((&json["frame"], &json["encoding"], &json["shape"]), (&json!(number), &json!("png"), &json!([4, 6, 3])));
            assert_eq!(serde_json::from_value::<FrameRecord>(json["record"].clone()).unwrap(), *frame(number).record);
            let picture = image::load_from_memory(&payload).unwrap().to_rgb8();
            assert_eq!(picture.into_raw(), frame(number).film.tone_mapped([1.0, 0.5, 1.0]), "{number}");
        }
    }
}

#[test]
fn what_is_gone_or_no_number_is_said_and_only_those_who_know_a_token_are_told() {
    let folder = tempfile::tempdir().unwrap();
    let run = run(folder.path(), true);
    let stage = stage(&run);
    let (address, token) = (stage.address(), stage.token.clone());
    std::fs::remove_file(run.join("frames/frame_000008.png")).unwrap();
    std::fs::write(run.join("frames/frame_000009.png"), "no picture").unwrap();
    for (query, status, words) in [
        ("frame=2&", 410, "the run has no picture of frame 2 any more"),
        ("frame=8&", 410, "the run has no picture of frame 8 any more"),
        ("frame=10&", 404, "the run has no frame 10 in its records"),
        ("frame=9&", 500, "the folder of the run cannot be read"),
        ("frame=&", 400, "`frame` is \"\"; accepted: the number of a frame"),
        ("", 400, "`frame` is \"\""),
        ("frame=-1&", 400, "`frame` is \"-1\""),
        ("frame=7.png&", 400, "`frame` is \"7.png\""),
        ("frame=../../records.jsonl&", 400, "accepted: the number of a frame"),
        ("frame=18446744073709551616&", 400, "accepted: the number of a frame"),
    ] {
        let (found, answer) = get(address, &format!("/past?{query}token={token}"), &[]);
        assert!(found == status && body(&answer).contains(words), "{query}: {answer}");
        assert!(!answer.contains(run.to_str().unwrap()), "{answer}");
    }
    let watching = stage.dashboard.watching_url().split("token=").nth(1).unwrap().to_owned();
    for target in ["/past?frame=7&", "/past.json?"] {
        assert_eq!(get(address, &format!("{target}token={watching}"), &[]).0, 200);
        assert_eq!(get(address, &format!("{target}token={token}"), &["Origin: https://evil.example.org"]).0, 403);
        for wrong in ["", "token=", "token=0"] {
            let (status, answer) = get(address, &format!("{target}{wrong}"), &[]);
            assert!(status == 403 && body(&answer).starts_with("This page needs its token"), "{answer}");
        }
    }
    // Before the first frame there is nothing, and without a folder never.
    std::fs::remove_file(run.join("records.jsonl")).unwrap();
    assert_eq!(body(&get(address, &format!("/past.json?token={token}"), &[]).1), "{\"frames\":[],\"records\":[]}");
    let alone = Stage::new();
    assert_eq!(alone.visit().until_state(|_| true)["has_past"], false);
    for target in ["/past?frame=7&", "/past.json?"] {
        let (status, answer) = get(alone.address(), &format!("{target}token={}", alone.token), &[]);
        assert!(status == 404 && answer.contains("ridgewatch dashboard --run FOLDER"), "{answer}");
    }
}
