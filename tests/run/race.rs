//! Races of methods, for `render.method = "auto"`.

use crate::kit::program::{config, json, records, ridgewatch, run, summary, text};
use crate::kit::scene;
use crate::steps::Gusts;
use ridgewatch::render::Method;
use ridgewatch::run::{RunOptions, Setup};
use serde_json::Value;
use std::path::Path;
use std::sync::atomic::AtomicBool;

/// A thin medium and few nodes, so that frames take milliseconds.
const SMALL: [&str; 7] = [
    "render.width=16",
    "render.height=8",
    "render.samples=1",
    "transfer.extinction=5",
    "surrogate.table_nodes=[17, 9, 2]",
    "time.tau=5",
    "publish.maps=false",
];

fn auto(command: &str, scene: &Path, out: &Path, more: &[&str]) -> Value {
    let keys = [&SMALL[..], more].concat();
    let mut given = vec![command, text(scene), "--device", "cpu", "--method", "auto", "--json", "--out", text(out)];
    given.extend(keys.iter().flat_map(|key| ["--set", key]));
    run(&mut ridgewatch(given)).success().json()
}

#[test]
fn the_method_that_wins_draws_and_the_next_run_knows() {
    let folder = tempfile::tempdir().unwrap();
    let [scene, first, second, picture] = ["gyre.toml", "first", "second", "picture.png"].map(|name| folder.path().join(name));
    std::fs::copy(config("double_gyre.toml"), &scene).unwrap();
    auto("replay", &scene, &first, &["time.slides=600", "time.frames_per_slide=1"]);
    let (drawn, report) = (records(&first), summary(&first));
    let (race, decisions) = (&report["run"]["race"], report["run"]["decisions"].as_array().unwrap());
    let slide = race["slide"].as_u64().unwrap();
    assert_eq!(drawn[0].method, "two_level");
    assert!(drawn.iter().filter(|record| record.slide > slide).all(|record| race["method"] == record.method.as_str()), "{race}");
    assert!(drawn[slide as usize + 1].seconds.race > 0.0);
    // A race that is given up, since it takes longer than a tenth, takes a picture more at most.
    let [raced, all] = [drawn.iter().map(|record| record.seconds.race).sum::<f64>(), drawn[drawn.len() - 1].seconds.elapsed];
    assert!(raced < 0.3 * all, "{raced} of {all} s");
    let decision = decisions.iter().find(|decision| decision["setting"] == "render.method").unwrap();
    assert!(
        decision["chosen"] == race["method"] && decision["why"].as_str().unwrap().starts_with("first to 40 dB after a slide ("),
        "{decision}"
    );

    // Another winner in the file shows that it is read. Without a table there is none to trace, to name or to decide on.
    let kept = folder.path().join("gyre.auto.json");
    let mut other = json(&kept);
    assert_eq!(other["race"], *race);
    other["race"]["method"] = "reference".into();
    std::fs::write(&kept, other.to_string()).unwrap();
    auto("replay", &scene, &second, &["time.slides=2"]);
    assert!(records(&second).iter().all(|record| record.method == "reference" && record.surrogate.is_none()));
    let report = summary(&second);
    let decisions = report["run"]["decisions"].to_string();
    assert!(decisions.contains(", in an earlier run") && !decisions.contains("surrogate.table_nodes"), "{decisions}");
    assert_eq!(report["run"]["surrogate_bytes"], 0);
    // Neither the number of slides nor that of frames matters, but tau does, and what else the file says.
    assert_eq!(auto("render", &scene, &picture, &[])["method"], "reference");
    assert_eq!(auto("render", &scene, &picture, &["time.tau=4"])["method"], "two_level");
    for (key, value) in [("of", "another scene"), ("method", "map")] {
        let mut wrong = other.clone();
        *(if key == "of" { &mut wrong[key] } else { &mut wrong["race"][key] }) = value.into();
        std::fs::write(&kept, wrong.to_string()).unwrap();
        assert_eq!(auto("render", &scene, &picture, &[])["method"], "two_level", "{key}");
    }
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
