//! Charts and offline training through the command line.

#![allow(clippy::unwrap_used)]

#[path = "../kit/mod.rs"]
mod kit;

use kit::program::{config, json, ridgewatch, run, text};
use serde_json::Value;
use std::path::Path;

/// A small double gyre, in seconds instead of minutes.
const SMALL: [&str; 5] = ["render.width=96", "render.height=48", "time.tau=5", "time.slides=3", "render.samples=2"];

/// The command on a copy of the scene beside `out`, since `chart` leaves a file beside its scene.
fn command(name: &str, out: &Path, more: &[&str]) -> Vec<String> {
    let scene = out.with_file_name("gyre.toml");
    std::fs::copy(config("double_gyre.toml"), &scene).unwrap();
    let mut arguments: Vec<String> = vec![name.into(), text(&scene).into(), "--device".into(), "cpu".into()];
    arguments.extend(SMALL.iter().flat_map(|key| ["--set".into(), (*key).to_owned()]));
    arguments.extend(["--out".into(), text(out).into()]);
    arguments.extend(more.iter().map(|word| (*word).to_owned()));
    arguments
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("no number: {value}"))
}

/// Errors are those of the numerics: they fall with steps and with nodes, and the pick is the cheapest method within the tolerance.
#[test]
fn errors_fall_with_steps_and_nodes() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("chart");
    run(&mut ridgewatch(command("chart", &out, &["--only", "ftle", "--seconds", "25"]))).success();
    let chart = json(&out.join("chart.json"));
    let methods = chart["ftle"]["methods"].as_array().unwrap();
    let rms = |method: &str, setting: &str| {
        let found = methods.iter().find(|point| point["method"] == method && point["setting"].as_str().unwrap().starts_with(setting));
        number(&found.unwrap_or_else(|| panic!("{method}, {setting} is missing: {:?}", chart["not_measured"]))["rms"])
    };
    let steps = chart["ftle"]["chosen_steps"].as_u64().unwrap();
    let of_steps = |n: u64| rms("tangent RK4, f64", &format!("{n} steps"));
    // Order 4: a fourth of the step has 1/256 of the error, until that of the truth is reached.
    assert!(of_steps(4 * steps) < of_steps(steps) / 50.0, "{} {}", of_steps(4 * steps), of_steps(steps));
    let tables: Vec<f64> = ["64x32", "128x64", "256x128"].map(|nodes| rms("table", nodes)).to_vec();
    assert!(tables.windows(2).all(|pair| pair[1] < 0.6 * pair[0]), "{tables:?}");
    // The published gap of 1e-6 drowns in the rounding of f32. In f64 only the error of the steps is left.
    let published = rms("differences, f32", "gap 1e-6");
    assert!(published > 3.0 * rms("differences, f32", "gap 1e-5") && published > 5.0 * rms("differences, f64", "gap 1e-6"), "{published}");
    let tolerance = number(&chart["ftle"]["tolerance"]);
    let within = methods.iter().filter(|point| number(&point["rms"]) <= tolerance);
    let cost = |point: &Value| number(&point["build_seconds"]) + 1e6 / number(&point["samples_per_second"]);
    let best = within.min_by(|a, b| cost(a).total_cmp(&cost(b))).unwrap();
    let verdict = chart["verdict"][0].as_str().unwrap();
    let name = format!("{} ({})", best["method"].as_str().unwrap(), best["setting"].as_str().unwrap());
    assert!(verdict.starts_with("1e6 FTLE samples") && verdict.contains(&name), "{verdict}; {name}");
    let front = &chart["ftle"]["fronts"][0];
    assert_eq!(methods[front["pick"].as_u64().unwrap() as usize], *best);
    let of_front: Vec<f64> =
        front["methods"].as_array().unwrap().iter().map(|n| number(&methods[n.as_u64().unwrap() as usize]["rms"])).collect();
    assert!(of_front.windows(2).all(|pair| pair[1] < pair[0]), "from the cheapest to the most exact: {of_front:?}");
    let said = chart["verdict"].to_string();
    assert!(said.contains("Pareto front of 1e9 samples") && said.contains("Cheapest within the tolerance ("), "{said}");
    // One line per measurement below the head.
    let csv = std::fs::read_to_string(out.join("chart.csv")).unwrap();
    assert_eq!(csv.lines().count(), methods.len() + 1);
    assert!(csv.lines().all(|line| columns(line) == 16), "{csv}");
    // For the dashboard.
    assert_eq!(std::fs::read(folder.path().join("gyre.chart.svg")).unwrap(), std::fs::read(out.join("chart.svg")).unwrap());
}

/// Columns of a line of CSV, whose commas inside quotes count as text.
fn columns(line: &str) -> usize {
    line.split('"').step_by(2).map(|outside| outside.matches(',').count()).sum::<usize>() + 1
}

#[test]
fn pictures_converge_and_the_chart_is_drawn() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("chart");
    // So few nodes that a picture of them errs by more than even a short truth tells: it takes samples to mend it.
    let coarse = ["--only", "pictures,scaling", "--seconds", "60", "--set", "surrogate.table_nodes=[17, 9, 2]"];
    run(&mut ridgewatch(command("chart", &out, &coarse))).success();
    let chart = json(&out.join("chart.json"));
    let curves = chart["pictures"]["curves"].as_array().unwrap();
    let frames = |method: &str| {
        let curve =
            curves.iter().find(|curve| curve["method"] == method).unwrap_or_else(|| panic!("{method}: {:?}", chart["not_measured"]));
        curve["frames"].as_array().unwrap().clone()
    };
    // A few seconds of truth tell little more than the first frame of the one, and much of the other.
    for (method, gain) in [("two_level", 0.5), ("reference", 3.0)] {
        let frames = frames(method);
        let (first, last) = (number(&frames[0]["psnr"]), number(&frames[frames.len() - 1]["psnr"]));
        assert!(frames.len() > 1 && last > first + gain, "{method}: {first} to {last} dB in {} frames", frames.len());
        assert!(frames.windows(2).all(|pair| number(&pair[0]["seconds"]) < number(&pair[1]["seconds"])), "time goes on");
    }
    // A single frame may be off by more, and what the truth does not tell does not count.
    let told = number(&chart["pictures"]["truth_psnr"]) + 5.9;
    let compared: Vec<Value> = frames("two_level").into_iter().filter(|frame| number(&frame["psnr"]) < told).collect();
    let mean_square = |psnr: &str| compared.iter().map(|frame| 10f64.powf(-0.1 * number(&frame[psnr]))).sum::<f64>();
    let ratio = mean_square("stated_psnr") / mean_square("psnr");
    assert!(10.0 * ratio.log10().abs() < 2.5, "stated over measured mean square: {ratio} in {compared:?}");
    // The coarse table may keep all of them below 40 dB, and then there is no race.
    let last = |method: &str| number(&frames(method).last().unwrap()["psnr"]);
    let race = &chart["pictures"]["race"];
    assert_eq!(race.is_null(), ["two_level", "marched"].iter().all(|method| last(method) < 40.0), "{race}");
    let verdict = chart["verdict"].to_string();
    assert!(verdict.contains("begins with two_level, table: "), "{verdict}");
    let steps: Vec<f64> =
        chart["scaling"]["points"].as_array().unwrap().iter().filter(|p| p["axis"] == "tau").map(|p| number(&p["steps"])).collect();
    assert!(steps.len() >= 2 && steps[0] < steps[steps.len() - 1], "a longer tau takes more steps: {steps:?}");
    let picture = image::load_from_memory(&std::fs::read(out.join("chart.png")).unwrap()).unwrap().into_rgb8();
    let coloured = picture.pixels().filter(|pixel| pixel.0.iter().max() != pixel.0.iter().min()).count();
    assert!(picture.width() == 1800 && coloured > 500, "curves have colours: {coloured} pixels");
    let svg = std::fs::read_to_string(out.join("chart.svg")).unwrap();
    for words in ["two_level, table", "reference", "PSNR over lit pixels, dB", "relMSE over lit pixels", "SSIM of frames", "Double gyre"] {
        assert!(svg.contains(words), "{words}");
    }
    // The frames that are named for a target tell all measures of error.
    let reached = curves.iter().flat_map(|curve| curve["frames"].as_array().unwrap()).find(|frame| number(&frame["psnr"]) >= 30.0).unwrap();
    assert!(reached["ssim"].is_number() && verdict.contains("relMSE ") && verdict.contains(", SSIM "), "{reached} {verdict}");
    // Drawn anew from its file, without the scene.
    let again = folder.path().join("again");
    run(&mut ridgewatch(["chart", text(&out.join("chart.json")), "--out", text(&again)])).success();
    assert_eq!(json(&again.join("chart.json"))["verdict"], chart["verdict"]);
    assert!(["chart.svg", "chart.png"].iter().all(|file| again.join(file).exists()));
    let [first, second] = [&out, &again].map(|folder| std::fs::read_to_string(folder.join("chart.csv")).unwrap());
    assert_eq!(first.lines().count(), second.lines().count());
    for (one, other) in first.split([',', '\n']).zip(second.split([',', '\n'])) {
        // The last digit of a number in JSON may be another one.
        let is_close = || one.parse::<f64>().is_ok_and(|a| other.parse::<f64>().is_ok_and(|b| (a - b).abs() <= 2e-6 * a.abs()));
        assert!(one == other || is_close(), "{one}, then {other}");
    }
}

/// What `auto` draws as a map is not said to begin with a method of volumes, and the map has a curve.
#[test]
fn a_flat_scene_is_said_to_be_drawn_as_a_map() {
    let folder = tempfile::tempdir().unwrap();
    let (out, scene) = (folder.path().join("chart"), folder.path().join("flat.toml"));
    let keys = "[source]\nkind = \"double_gyre\"\n[domain]\nmin = [0, 0, 0]\nmax = [2, 1, 0.2]\n[time]\ntau = 5\n[render]\nwidth = 32\nheight = 16\n";
    std::fs::write(&scene, keys).unwrap();
    let chart = ["chart", text(&scene), "--device", "cpu", "--only", "pictures", "--seconds", "8", "--out", text(&out)];
    run(&mut ridgewatch(chart)).success();
    let chart = json(&out.join("chart.json"));
    let verdict = chart["verdict"].to_string();
    assert!(verdict.contains("draws this scene as a map") && !verdict.contains("begins with"), "{verdict}");
    let frames = chart["pictures"]["map"]["frames"].as_array().unwrap();
    let [first, last] = [&frames[0], &frames[frames.len() - 1]].map(|frame| number(&frame["psnr"]));
    // Eight seeds more in each frame; two frames are told apart.
    assert!(frames.len() > 1 && last > first + 3.0, "{first} to {last} dB in {} frames", frames.len());
    let compared = frames.iter().filter(|frame| number(&frame["psnr"]) < 45.0);
    let off: Vec<f64> = compared.map(|frame| number(&frame["stated_psnr"]) - number(&frame["psnr"])).collect();
    assert!(!off.is_empty() && off.iter().all(|decibels| decibels.abs() < 3.0), "stated less true PSNR: {off:?}");
    assert!(verdict.contains("The map, of which the FTLE of each pixel is compared: 30 dB after "), "{verdict}");
    let csv = std::fs::read_to_string(out.join("chart.csv")).unwrap();
    assert_eq!(csv.lines().filter(|line| line.starts_with("picture,\"map\",still,")).count(), frames.len());
    assert!(std::fs::read_to_string(out.join("chart.svg")).unwrap().contains("map (of its FTLE)"));
}

/// Of snapshots that are left out the chart says what they were worth.
#[test]
fn the_error_of_fewer_snapshots_falls_with_their_number() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("chart");
    let scene = folder.path().join("turbulence.toml");
    std::fs::copy(config("turbulence_easy.toml"), &scene).unwrap();
    let keys = ["source.nodes=[32, 16, 16]", "source.snapshots=13"].iter().flat_map(|key| ["--set", *key]);
    let given = ["chart", text(&scene), "--device", "cpu", "--only", "scaling", "--seconds", "30", "--out", text(&out)];
    run(&mut ridgewatch(given.into_iter().chain(keys))).success();
    let chart = json(&out.join("chart.json"));
    let points = chart["scaling"]["points"].as_array().unwrap();
    let of = |axis: &str| points.iter().filter(|point| point["axis"] == axis).cloned().collect::<Vec<Value>>();
    let values = |axis: &str| of(axis).iter().map(|point| number(&point["value"])).collect::<Vec<_>>();
    assert_eq!(values("snapshots"), [4.0, 7.0, 12.0], "{:?}", chart["not_measured"]);
    // A quarter, half and twice as many nodes along each axis, and those of the scene.
    assert_eq!(values("nodes"), [8 * 4 * 4, 16 * 8 * 8, 64 * 32 * 32, 32 * 16 * 16].map(f64::from), "{:?}", chart["not_measured"]);
    let found: Vec<(f64, f64)> = of("snapshots")[..2].iter().map(|point| (number(&point["value"]), number(&point["rms"]))).collect();
    let svg = std::fs::read_to_string(out.join("chart.svg")).unwrap();
    for against in ["tau", "snapshots in tau", "nodes of the grid"] {
        assert!(svg.contains(&format!("Cost of a sample against {against}, steps by error")), "{against}");
    }
    assert!(found[1].1 > 0.0 && found[1].1 < 0.7 * found[0].1, "{found:?}");
    let tables: Vec<f64> = points.iter().map(|point| number(&point["table_rms"])).collect();
    assert!(tables.iter().all(|rms| *rms > 0.0) && chart["verdict"].to_string().contains(" samples on, with rms "), "{tables:?}");
    assert!(chart["verdict"].to_string().contains("rms from that of all snapshots"), "{}", chart["verdict"]);
}

/// Columns of a training's table.
const HEAD: &str = "epoch,steps,seconds,loss,rms,psnr,rollbacks";

#[test]
fn training_lowers_the_error_on_points_it_never_sees() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("train");
    let network =
        ["--set", "surrogate.kind=network", "--set", "network.log2_table=12", "--set", "network.width=16", "--set", "network.batch=4096"];
    let given = [&network[..], &["--epochs", "12", "--labels", "65536", "--pictures", "1,3"]].concat();
    run(&mut ridgewatch(command("train", &out, &given))).success();
    let written = std::fs::read_to_string(out.join("epochs.csv")).unwrap();
    assert_eq!(written.lines().next(), Some(HEAD));
    let rows: Vec<Vec<f64>> =
        written.lines().skip(1).map(|line| line.split(',').map(|cell| cell.parse().unwrap_or(f64::NAN)).collect()).collect();
    assert_eq!(rows.len(), 12);
    // 65536 labels in batches of 4096 are 16 steps an epoch.
    assert_eq!([rows[0][1], rows[11][1]], [16.0, 192.0]);
    assert!(rows[11][4] < 0.5 * rows[0][4], "rms from {} to {}", rows[0][4], rows[11][4]);
    for epoch in [1, 3, 12] {
        assert!(out.join(format!("epoch_{epoch:06}.png")).exists(), "{epoch}");
    }
    assert!(std::fs::read_to_string(out.join("epochs.svg")).unwrap().contains("<svg"));
    // Another training is drawn beside it, each by the name of its folder.
    let second = folder.path().join("second");
    // A single epoch is a point.
    let given = [&network[..], &["--epochs", "1", "--labels", "8192"]].concat();
    run(&mut ridgewatch(command("train", &folder.path().join("single"), &given))).success();
    let given = [&network[..], &["--epochs", "2", "--labels", "8192", "--beside", text(&out)]].concat();
    run(&mut ridgewatch(command("train", &second, &given))).success();
    let drawn = std::fs::read_to_string(second.join("epochs.svg")).unwrap();
    assert!([">\ntrain\n<", ">\nsecond\n<"].iter().all(|name| drawn.contains(name)), "{drawn}");
    std::fs::write(out.join("epochs.csv"), format!("{HEAD}\n1,16,0.1\n")).unwrap();
    run(&mut ridgewatch(command("train", &second, &given))).refused(1, &["epochs.csv, line 2", "1,16,0.1", "accepted: epoch,steps"]);
    run(&mut ridgewatch(command("train", &out, &[]))).refused(2, &["a table is not trained", "surrogate.kind"]);
}

#[test]
fn what_cannot_be_charted_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    run(&mut ridgewatch(["chart", config("live.toml").as_str(), "--out", text(folder.path())]))
        .refused(2, &["running simulation", "accepted"]);
    run(&mut ridgewatch(command("chart", &folder.path().join("chart"), &["--only", "speed"]))).refused(2, &["speed", "ftle"]);
    let other = folder.path().join("other.json");
    std::fs::write(&other, "{\"scene\": 1}").unwrap();
    run(&mut ridgewatch(["chart", text(&other), "--out", text(folder.path())])).refused(1, &["other.json is no chart.json", "line 1"]);
}
