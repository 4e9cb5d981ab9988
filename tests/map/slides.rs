//! Maps that a replay leaves of its slides.

use super::command::ocean;
use crate::kit::program::{config, json, ridgewatch, run, set, summary, text};
use std::path::Path;

/// Names in a folder, in order; none if it does not exist.
fn names(folder: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(folder).into_iter().flatten();
    let mut names: Vec<_> = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

fn replay(source: &str, out: &Path, keys: &[&str], options: &[&str]) -> String {
    let small = set(&["render.width=96", "render.height=48", "render.samples=1", "time.warmup_frames=0", "flow.steps=40"]);
    let keys = set(keys);
    run(&mut ridgewatch([&["replay", source, "--device", "cpu", "--out", text(out)][..], &small, &keys, options].concat())).success().stdout
}

#[test]
fn a_replay_in_two_dimensions_leaves_the_map_of_each_slide() {
    let folder = tempfile::tempdir().unwrap();
    let (out, gyre) = (folder.path().join("run"), config("double_gyre.toml"));
    let slides = ["time.tau=5", "time.slides=2", "time.frames_per_slide=2"];
    let said = replay(&gyre, &out, &slides, &[]);
    let maps = out.join("maps");
    assert!(said.contains(&format!("a map of each slide in {}", maps.display())), "{said}");
    assert_eq!(
        names(&maps),
        ["slide_000000.json", "slide_000000.png", "slide_000001.json", "slide_000001.png"],
        "one a slide, not one a frame"
    );
    let files = &summary(&out)["files"];
    assert_eq!((files["maps_written"].as_u64(), files["maps_failed"].as_u64()), (Some(2), Some(0)));
    // They are those of `map` with the same pixels and seeds: bit for bit, the second one in the colours of the first.
    let [first, second] = [0, 1].map(|n| json(&maps.join(format!("slide_{n:06}.json"))));
    let range = first["range"].as_array().unwrap();
    assert_eq!(range, second["range"].as_array().unwrap());
    assert_ne!((&first["time"], &first["panels"]), (&second["time"], &second["panels"]));
    for (slide, record) in [("0", &first), ("1", &second)] {
        let alone = folder.path().join("alone.png");
        let range = format!("{},{}", range[0], range[1]);
        let map =
            ["map", &gyre, "--device", "cpu", "--width", "96", "--seeds", "4", "--slide", slide, "--range", &range, "--out", text(&alone)];
        let keys = set(&["time.tau=5", "time.slides=2", "flow.steps=40", "render.width=96", "render.height=48"]);
        run(&mut ridgewatch([&map[..], &keys].concat())).success();
        assert_eq!(&json(&alone.with_extension("json")), record);
        let there = maps.join(format!("slide_00000{slide}.png"));
        assert!(std::fs::read(&alone).unwrap() == std::fs::read(&there).unwrap(), "slide {slide}: another picture than that of `map`");
    }
    // A run in its place takes them away, and one that may keep a frame keeps its map.
    replay(&gyre, &out, &[&slides[..], &["publish.keep=1"]].concat(), &["--overwrite"]);
    assert_eq!(names(&maps), ["slide_000001.json", "slide_000001.png"]);
    let said = replay(&gyre, &out, &[&slides[..], &["publish.maps=false"]].concat(), &["--overwrite"]);
    assert!(!said.contains("map") && names(&maps).is_empty(), "{said}");
    assert_eq!(summary(&out)["files"]["maps_written"], 0);
}

#[test]
fn maps_of_an_archive_have_land_and_volumes_have_none() {
    let folder = tempfile::tempdir().unwrap();
    let data = ocean(folder.path());
    let out = folder.path().join("ocean");
    replay(text(&data), &out, &["time.tau=\"2 days\""], &["--set", "time.slides=2"]);
    let record = json(&out.join("maps/slide_000001.json"));
    assert_eq!((&record["projection"], &record["ftle_unit"]), (&"plate_carree".into(), &"1/day".into()));
    assert_eq!((&record["date"], &record["panels"][0]["direction"]), (&"2002-01-03T12:00:00Z".into(), &"backward".into()));
    assert!(record["panels"][0]["missing_share"].as_f64().unwrap() > 0.01, "the island: {record}");
    let volume = folder.path().join("abc");
    replay(
        &config("abc.toml"),
        &volume,
        &["time.tau=1", "time.slides=1", "time.frames_per_slide=1", "surrogate.table_nodes=[16,16,16]"],
        &[],
    );
    assert!(!volume.join("maps").exists());
}
