//! Races of methods, for `render.method = "auto"`.

use crate::kit::program::{config, json, records, ridgewatch, run, summary, text};
use crate::kit::scene;
use crate::steps::Gusts;
use ridgewatch::render::Method;
use ridgewatch::run::{RunOptions, Setup};
use serde_json::Value;
use std::path::Path;
use std::sync::atomic::AtomicBool;

/// Nodes that take longer than all samples that a picture this small needs.
const DEAR: &str = "surrogate.table_nodes=[301, 151, 2]";
/// So thin a medium, and so many samples, that one frame of `reference` has 40 dB.
const SMALL: [&str; 5] = ["render.width=16", "render.height=8", "render.samples=256", "transfer.extinction=5", "time.tau=5"];

fn auto(command: &str, scene: &Path, out: &Path, more: &[&str]) -> Value {
    let keys = [&SMALL[..], &[DEAR], more].concat();
    let mut given = vec![command, text(scene), "--device", "cpu", "--method", "auto", "--json", "--out", text(out)];
    given.extend(keys.iter().flat_map(|key| ["--set", key]));
    run(&mut ridgewatch(given)).success().json()
}

#[test]
fn a_table_that_costs_more_than_it_saves_loses_and_the_next_run_knows() {
    let folder = tempfile::tempdir().unwrap();
    let [scene, first, second, picture] = ["gyre.toml", "first", "second", "picture.png"].map(|name| folder.path().join(name));
    std::fs::copy(config("double_gyre.toml"), &scene).unwrap();
    auto("replay", &scene, &first, &["time.slides=100", "time.frames_per_slide=1", "publish.maps=false"]);
    let methods = |folder: &Path| {
        let all = records(folder);
        assert!(all.iter().all(|record| record.method != "reference" || record.surrogate.is_none()), "the table is gone");
        all.into_iter().map(|record| record.method).collect::<Vec<_>>()
    };
    let drawn = methods(&first);
    let raced = drawn.iter().position(|method| method == "reference").unwrap();
    assert!(raced > 0 && drawn[..raced].iter().all(|method| method == "two_level"), "{drawn:?}");
    assert!(drawn[raced..].iter().all(|method| method == "reference"), "{drawn:?}");
    let report = summary(&first);
    let race = &report["run"]["race"];
    let time = |k: usize| race["seconds"][k][1].as_f64().unwrap_or(f64::INFINITY);
    assert!(race["method"] == "reference" && race["slide"] == raced - 1 && time(2) * 1.1 < time(0), "{race}");
    let decision = report["run"]["decisions"].as_array().unwrap().iter().find(|decision| decision["setting"] == "render.method").cloned();
    let decision = decision.unwrap();
    assert!(
        decision["chosen"] == "reference" && decision["why"].as_str().unwrap().starts_with("first to 40 dB after a slide ("),
        "{decision}"
    );
    assert_eq!(report["run"]["surrogate_bytes"], 0);
    // Neither the number of slides nor that of frames matters, but tau does.
    auto("replay", &scene, &second, &["time.slides=2", "publish.maps=false"]);
    assert!(methods(&second).iter().all(|method| method == "reference"), "{:?}", methods(&second));
    assert!(summary(&second)["run"]["decisions"].to_string().contains(", in an earlier run"));
    assert_eq!(auto("render", &scene, &picture, &[])["method"], "reference");
    assert_eq!(auto("render", &scene, &picture, &["time.tau=4"])["method"], "two_level");
    let kept = folder.path().join("gyre.auto.json");
    let mut other = json(&kept);
    other["of"] = "another scene".into();
    std::fs::write(&kept, other.to_string()).unwrap();
    assert_eq!(auto("render", &scene, &picture, &[])["method"], "two_level");
}

#[test]
fn methods_race_again_when_the_window_changes() {
    const CALM: usize = 300;
    // A thin medium, so that frames take milliseconds.
    let keys =
        "time.tau = 5\nrender.method = \"auto\"\nsurrogate.kind = \"table\"\nsurrogate.table_nodes = [17, 9, 2]\ntransfer.extinction = 5\n";
    let text = scene::double_gyre([16, 8, 1], keys);
    let mut setup = scene::setup(&text, &[]);
    assert!(setup.plan.races && setup.plan.scene.render.method == Method::TwoLevel);
    let first = setup.slides.next_slide(&AtomicBool::new(false)).ok().flatten().unwrap();
    let gusts = Gusts { first, speeds: [vec![0.1; CALM], vec![0.4; CALM]].concat().into_iter() };
    let mut steps = Vec::new();
    let report = scene::run_frames(Setup { slides: Box::new(gusts), ..setup }, &RunOptions::default(), |frame| {
        steps.push(frame.record.integration_steps.unwrap());
    });
    assert!(steps[CALM] > 2 * steps[0], "the faster flow takes more steps");
    let race = report.race.unwrap();
    assert!(race.slide >= CALM as u64 && race.seconds.len() == 3, "{race:?}");
}
