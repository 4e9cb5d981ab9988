//! Maps that a run leaves of its slides.

use super::command::ocean;
use crate::kit::program::{config, json, ridgewatch, run, set, summary, text};
use crate::kit::scene::{double_gyre, setup};
use ridgewatch::backend::Device;
use ridgewatch::map::{MapError, SlideMaps};
use ridgewatch::progress::work;
use ridgewatch::run::ShownSlide;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

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

/// Asserts that the map of a slide is the one that `map` draws with these options, bit for bit.
fn same_as_alone(folder: &Path, there: &Path, arguments: &[&str]) {
    let alone = folder.join("alone.png");
    let fixed = ["map", "--device", "cpu", "--width", "96", "--seeds", "4", "--set", "flow.steps=40", "--out", text(&alone)];
    run(&mut ridgewatch([&fixed[..], arguments].concat())).success();
    assert_eq!(json(&alone.with_extension("json")), json(&there.with_extension("json")), "{there:?}");
    assert!(std::fs::read(&alone).unwrap() == std::fs::read(there).unwrap(), "{there:?}: another picture than that of `map`");
}

#[test]
fn what_a_map_shows_over_its_colours_is_that_of_the_command() {
    let folder = tempfile::tempdir().unwrap();
    let gyre = config("double_gyre.toml");
    let sizes = set(&["time.tau=5", "time.slides=1", "render.width=96", "render.height=48"]);
    let cases: [(&str, &[&str], &[&str]); 3] = [
        ("lines", &["maps.ridges=true", "maps.contour=[0.2, 0.3]"], &["--ridges", "--contour", "0.2,0.3"]),
        ("arrows", &["maps.arrows=true"], &["--arrows"]),
        ("all", &["maps.ridges=true", "maps.arrows=true", "maps.both=true"], &["--ridges", "--arrows", "--both"]),
    ];
    let mut pictures = Vec::new();
    for (name, keys, options) in cases {
        let out = folder.path().join(name);
        replay(&gyre, &out, &[&["time.tau=5", "time.slides=1"], keys].concat(), &[]);
        let there = out.join("maps/slide_000000.png");
        same_as_alone(folder.path(), &there, &[&[&gyre[..]], &sizes[..], options].concat());
        pictures.push(std::fs::read(&there).unwrap());
    }
    assert!(pictures[0] != pictures[1] && pictures[1] != pictures[2]);
    let record = json(&folder.path().join("all/maps/slide_000000.json"));
    assert_eq!(record["panels"].as_array().unwrap().len(), 2);
    assert!(record["fastest"].as_f64().unwrap() > 0.0 && record["panels"][0]["ridge_lines"].as_u64().unwrap() > 0, "{record}");
}

#[test]
fn both_directions_of_an_archive_begin_when_twice_tau_is_known() {
    let folder = tempfile::tempdir().unwrap();
    let data = ocean(folder.path());
    let out = folder.path().join("ocean");
    let said = replay(text(&data), &out, &["time.tau=\"1 day\"", "time.slides=4", "maps.both=true"], &[]);
    let maps = out.join("maps");
    assert_eq!(names(&maps), ["slide_000002.json", "slide_000002.png", "slide_000003.json", "slide_000003.png"]);
    assert!(said.contains("maps of 2 of 4 slides in"), "{said}");
    assert_eq!(summary(&out)["files"]["maps_dropped"], 0, "none was too slow");
    // Slide 2 ends two days after the first snapshot: the map shows the time in the middle of them.
    let first = maps.join("slide_000002.png");
    assert_eq!(json(&first.with_extension("json"))["date"], "2002-01-02T00:00:00Z");
    same_as_alone(folder.path(), &first, &[text(&data), "--tau", "1 day", "--both"]);
    // Of nine snapshots over four days, none has three days on both sides.
    let long = folder.path().join("long");
    let arguments = ["replay", text(&data), "--device", "cpu", "--out", text(&long)];
    let keys = set(&["time.tau=\"3 days\"", "maps.both=true", "render.width=32", "render.height=16", "flow.steps=10"]);
    let outcome = run(&mut ridgewatch([&arguments[..], &keys].concat())).success();
    assert!(outcome.stderr.contains("the snapshots span less than twice tau"), "{}", outcome.stderr);
    assert!(!long.join("maps").exists());
}

#[test]
fn both_directions_of_a_time_that_no_slide_has_are_dated() {
    let folder = tempfile::tempdir().unwrap();
    let data = ocean(folder.path());
    // Snapshots are twelve hours apart: the middle of 36 hours lies between two of them.
    let out = folder.path().join("between");
    replay(text(&data), &out, &["time.tau=\"18 hours\"", "time.slides=2", "maps.both=true"], &[]);
    let between = out.join("maps/slide_000001.png");
    assert_eq!(json(&between.with_extension("json"))["date"], "2002-01-01T18:00:00Z");
    same_as_alone(folder.path(), &between, &[text(&data), "--tau", "18 hours", "--both"]);
    // Backward, a slide has the time of its window's newest snapshot: that in the middle of 72 hours is of no slide, as every second one.
    let out = folder.path().join("backward");
    let keys = ["time.tau=\"36 hours\"", "time.slides=3", "time.direction=backward", "time.snapshots_per_slide=2", "maps.both=true"];
    replay(text(&data), &out, &keys, &[]);
    assert_eq!(json(&out.join("maps/slide_000002.json"))["date"], "2002-01-03T00:00:00Z");
}

#[test]
fn keys_of_maps_that_do_nothing_are_told() {
    let folder = tempfile::tempdir().unwrap();
    let (out, gyre) = (folder.path().join("run"), config("double_gyre.toml"));
    let replay = |keys: &[&str]| run(&mut ridgewatch([&["replay", &gyre, "--out", text(&out)][..], &set(keys)].concat()));
    replay(&["publish.maps=false", "maps.ridges=true"]).refused(2, &["`maps.ridges`", "only with publish.maps = true"]);
    replay(&["maps.contour=[1, inf]"]).refused(2, &["`maps.contour`", "finite numbers"]);
    replay(&["maps.ridge=true"]).refused(2, &["ridge"]);
    assert!(!out.exists());
    let keys =
        ["maps.arrows=true", "time.tau=1", "time.slides=1", "render.width=16", "render.height=8", "surrogate.table_nodes=[16,16,16]"];
    let volume = run(&mut ridgewatch([&["replay", &config("abc.toml"), "--device", "cpu", "--out", text(&out)][..], &set(&keys)].concat()))
        .success();
    assert!(volume.stderr.contains("without effect on a flow of three dimensions: maps"), "{}", volume.stderr);
}

/// On one thread, so that each of its four parts takes long on any machine.
#[test]
fn the_map_of_a_slide_tells_the_time_left() {
    let mut scene = setup(&double_gyre([1024, 512, 1], "time.tau = 10\nflow.steps = 400\n"), &[]);
    let stop = AtomicBool::new(false);
    let slide = scene.slides.next_slide(&stop).unwrap().unwrap();
    let map = scene.plan.map.clone();
    let mut maps = SlideMaps::new(&scene.plan, &Device::Cpu { why: None }).unwrap();
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let told = std::thread::scope(|scope| {
        let drawing =
            scope.spawn(|| pool.install(|| maps.draw(ShownSlide { slide, asked: map.clone(), map, is_new: true, next: None }, &stop)));
        let mut told = None;
        while told.is_none() && !drawing.is_finished() {
            told = work().filter(|text| text.starts_with("drawing the map of the slide: "));
            std::thread::sleep(Duration::from_millis(20));
        }
        stop.store(true, Ordering::Relaxed);
        assert!(matches!(drawing.join().unwrap(), Err(MapError::Stopped)));
        told.unwrap()
    });
    assert!(told.contains(" %, about ") && told.ends_with(" left"), "{told}");
}
