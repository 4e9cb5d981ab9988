//! `ridgewatch map`: pictures, records, lines, and refusals.

use crate::kit::netcdf::{Data, Fixture, NETCDF4, f32s, fill};
use crate::kit::program::{config, json, ridgewatch, run, start, text, until};
use ridgewatch::map::LAND;
use serde_json::Value;
use std::path::{Path, PathBuf};

/// A current along 20 by 10 degrees over four days, a jet that meanders; an island in the south-west quarter.
pub(crate) fn ocean(folder: &Path) -> PathBuf {
    let lon: Vec<f64> = (0..41).map(|i| 15.0 + 0.5 * f64::from(i)).collect();
    let lat: Vec<f64> = (0..21).map(|j| -40.0 + 0.5 * f64::from(j)).collect();
    let time: Vec<f64> = (0..9).map(|t| 12.0 * f64::from(t)).collect();
    let wave = |t: usize, i: usize| 0.6 * (0.4 * lon[i] - 0.02 * time[t]).sin();
    let island = |i: usize, j: usize| (18.0..=20.0).contains(&lon[i]) && (-38.0..=-36.0).contains(&lat[j]);
    let land = |j: usize, i: usize, value: f64| if island(i, j) { f64::NAN } else { value };
    let u = fill(9, 21, 41, |t, j, i| land(j, i, 1.2 * (-(lat[j] + 35.0 - wave(t, i)).powi(2)).exp()));
    let v = fill(9, 21, 41, |t, j, i| land(j, i, 0.5 * (0.4 * lon[i] - 0.02 * time[t]).cos() * (-(lat[j] + 35.0).powi(2) / 4.0).exp()));
    Fixture::on(NETCDF4, &[("time", "hours since 2002-01-01", &time), ("lat", "degrees_north", &lat), ("lon", "degrees_east", &lon)])
        .winds(f32s(u), f32s(v))
        .write(&folder.join("ocean.nc"))
}

fn map(out: &Path, arguments: &[&str]) -> Value {
    let mut all = vec!["map", "--device", "cpu", "--json", "--out", text(out)];
    all.extend(arguments);
    run(&mut ridgewatch(all)).success().json()
}

#[test]
fn the_saddle_is_its_rate_in_every_pixel() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("saddle.png");
    let record = map(&out, &[&config("saddle.toml"), "--width", "64", "--ridges", "--seeds", "4"]);
    let panel = &record["panels"][0];
    for value in panel["ftle"].as_array().unwrap() {
        assert!((value.as_f64().unwrap() - 1.0).abs() < 1e-5, "{panel}");
    }
    assert!(panel["error"]["rms"].as_f64().unwrap() < 1e-6 && panel["error"]["pixels"] == 64 * 64, "{panel}");
    assert!(panel["ridge_lines"] == 0 && record["projection"] == "plain" && panel["missing_share"] == 0.0, "a uniform field has no ridges");
    let mut beside = json(&out.with_extension("json"));
    beside["picture"] = record["picture"].clone();
    beside["lines"] = Value::Null;
    assert_eq!(beside, record, "the file has what is printed");
    let picture = image::open(&out).unwrap().to_rgb8();
    assert!(picture.width() > 600 && picture.height() > 150, "words have room beside a small raster");
}

#[test]
fn land_is_grey_and_lines_reach_other_tools() {
    let folder = tempfile::tempdir().unwrap();
    let data = ocean(folder.path());
    let lines = |name: &str| folder.path().join(name);
    let out = folder.path().join("ocean.png");
    let geojson = lines("ridges.geojson");
    let base = [text(&data), "--tau", "2 days", "--width", "240", "--seeds", "4", "--set", "flow.interpolation=\"linear\""];
    let record = map(&out, &[&base[..], &["--arrows", "--contour", "0.4", "--lines", text(&geojson), "--ridge-percentile", "50"]].concat());
    assert_eq!((&record["projection"], &record["ftle_unit"]), (&Value::from("plate_carree"), &Value::from("1/day")));
    assert_eq!(record["date"], "2002-01-03T00:00:00Z", "backward from the end of the first window");
    // Missing nodes from 18 to 20 and -38 to -36 degrees; linear interpolation loses the half degree around them: 3 x 3 of 20 x 10 degrees.
    let share = record["panels"][0]["missing_share"].as_f64().unwrap();
    assert!((share - 9.0 / 200.0).abs() < 0.002, "{share}");
    let picture = image::open(&out).unwrap().to_rgb8();
    // Flat pixels of the island; graticule and coast are few.
    let grey = picture.pixels().filter(|p| p.0 == LAND).count() as f64;
    let pixels = record["pixels"].as_array().unwrap().iter().map(|n| n.as_f64().unwrap()).product::<f64>();
    assert!(grey > 0.75 * share * pixels && grey < 1.05 * share * pixels, "{grey} of {}", share * pixels);
    let features = json(&geojson);
    let features = features["features"].as_array().unwrap();
    assert!(!features.is_empty() && record["panels"][0]["ridge_lines"] == features.len());
    for feature in features {
        assert_eq!(
            (&feature["geometry"]["type"], &feature["properties"]["kind"]),
            (&Value::from("LineString"), &Value::from("attracting"))
        );
        for place in feature["geometry"]["coordinates"].as_array().unwrap() {
            let [lon, lat] = [0, 1].map(|k| place[k].as_f64().unwrap());
            assert!((15.0..=35.0).contains(&lon) && (-40.0..=-30.0).contains(&lat), "{place}");
            assert!(!((17.5..=20.5).contains(&lon) && (-38.5..=-35.5).contains(&lat)), "no ridge on land: {place}");
        }
    }
    let [nc, vtk] = ["ridges.nc", "ridges.vtk"].map(lines);
    for file in [&nc, &vtk] {
        map(&out, &[&base[..], &["--lines", text(file), "--ridge-percentile", "50"]].concat());
    }
    let points: usize = features.iter().map(|f| f["geometry"]["coordinates"].as_array().unwrap().len()).sum();
    let file = netcdf::open(&nc).unwrap();
    let counts = file.variable("node_count").unwrap().get_values::<i32, _>(..).unwrap();
    let x = file.variable("x").unwrap().get_values::<f64, _>(..).unwrap();
    assert_eq!((counts.len(), counts.iter().sum::<i32>() as usize, x.len()), (features.len(), points, points));
    assert!((x[0] - features[0]["geometry"]["coordinates"][0][0].as_f64().unwrap()).abs() < 1e-9);
    let vtk = std::fs::read_to_string(vtk).unwrap();
    assert!(vtk.starts_with("# vtk DataFile Version 3.0\n") && vtk.contains(&format!("POINTS {points} double")), "{}", &vtk[..200]);
}

#[test]
fn a_ridge_grid_that_is_too_coarse_is_told() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("gyre.png");
    let gyre = config("double_gyre.toml");
    for (grid, is_told) in [("16x8", true), ("200x100", false)] {
        let arguments = ["map", &gyre, "--device", "cpu", "--width", "64", "--seeds", "2", "--ridges", "--ridge-grid", grid];
        let done = run(&mut ridgewatch([&arguments[..], &["--both", "--json", "--out", text(&out)]].concat())).success();
        let panels = done.json()["panels"].clone();
        for panel in panels.as_array().unwrap() {
            assert_eq!(panel["ridge_roughness"].as_f64().unwrap() > 0.4, is_told, "{grid}: {panel}");
        }
        let told = done.stderr.matches("take a finer grid (`map --ridge-grid`)").count();
        assert_eq!((told, done.stderr.contains("backward FTLE, tau = ")), (if is_told { 2 } else { 0 }, is_told), "{}", done.stderr);
    }
}

/// Kinks at the faces of cells are no ridges, where the cells resolve the FTLE.
#[test]
fn ridges_are_not_finer_than_data_that_resolve_them() {
    let folder = tempfile::tempdir().unwrap();
    // Waves of 20 degrees, 40 cells.
    let axis = |first: f64, count: usize| (0..count).map(|i| first + 0.5 * i as f64).collect::<Vec<_>>();
    let (lon, lat, wave) = (axis(15.0, 41), axis(-40.0, 21), |degrees: f64| (degrees * std::f64::consts::TAU / 20.0).sin());
    let data = Fixture::on(
        NETCDF4,
        &[("time", "days since 2002-01-01", &[0.0, 1.0, 2.0]), ("lat", "degrees_north", &lat), ("lon", "degrees_east", &lon)],
    )
    .winds(f32s(fill(3, 21, 41, |_, j, _| 0.8 * wave(lat[j]))), f32s(fill(3, 21, 41, |_, _, i| 0.5 * wave(lon[i]))))
    .write(&folder.path().join("waves.nc"));
    let out = folder.path().join("waves.png");
    let base = [text(&data), "--tau", "1 days", "--width", "200", "--seeds", "2", "--ridges"];
    let panel = |more: &[&str]| map(&out, &[&base[..], more].concat())["panels"][0].clone();
    let number = |panel: &Value, key: &str| panel[key].as_f64().unwrap();
    // 401 x 201 nodes, 40 x 20 cells: ten nodes a cell.
    let found = panel(&["--ridge-grid", "401x201"]);
    assert_eq!((number(&found, "ridge_smoothing"), number(&found, "ridge_length")), (4.0, 30.0), "{found}");
    let found = panel(&["--ridge-grid", "2001x1001"]);
    assert_eq!((number(&found, "ridge_smoothing"), number(&found, "ridge_length")), (20.0, 50.0), "{found}");
    let given = panel(&["--ridge-grid", "2001x1001", "--ridge-smoothing", "3", "--ridge-length", "7"]);
    assert_eq!((number(&given, "ridge_smoothing"), number(&given, "ridge_length")), (3.0, 7.0), "{given}");
    let coarse = panel(&["--ridge-grid", "41x21"]);
    assert_eq!((number(&coarse, "ridge_smoothing"), number(&coarse, "ridge_length")), (2.0, 30.0), "{coarse}");
}

#[test]
fn both_directions_and_several_taus_share_a_picture() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("gyre.svg");
    let gyre = config("double_gyre.toml");
    let record = map(&out, &[&gyre, "--both", "--tau", "5,10", "--width", "100", "--seeds", "2", "--ridges"]);
    let panels = record["panels"].as_array().unwrap();
    let kinds: Vec<(&str, f64)> = panels.iter().map(|p| (p["direction"].as_str().unwrap(), p["tau"].as_f64().unwrap())).collect();
    assert_eq!(kinds, [("forward", 5.0), ("backward", 5.0), ("forward", 10.0), ("backward", 10.0)]);
    // At phase 0 the double gyre's reversal is its mirror image in x: both directions have the same mean.
    let mean = |k: usize| panels[k]["ftle"][1].as_f64().unwrap();
    assert!((mean(2) - mean(3)).abs() < 0.005 * mean(2), "{} {}", mean(2), mean(3));
    let svg = std::fs::read_to_string(&out).unwrap();
    assert!(svg.matches("<image").count() == 2 && svg.contains("tau = 10") && svg.trim_end().ends_with("</svg>"));
    // An archive needs twice tau: the four days have room for two, not for three.
    let data = ocean(folder.path());
    let png = folder.path().join("ocean.png");
    let record = map(&png, &[text(&data), "--both", "--tau", "2 days", "--width", "64", "--seeds", "2"]);
    assert_eq!(record["date"], "2002-01-03T00:00:00Z", "the middle of the archive");
    let long = ["map", text(&data), "--both", "--tau", "3 days", "--out", text(&png)];
    run(&mut ridgewatch(long)).refused(1, &["--both needs data over twice tau", "ocean.nc"]);
}

#[test]
fn what_a_map_does_not_show_is_told() {
    let folder = tempfile::tempdir().unwrap();
    let said = |arguments: &[&str]| {
        let base = ["map", "--device", "cpu", "--width", "32", "--seeds", "2", "--out", "map.png"];
        run(ridgewatch(base.iter().chain(arguments)).current_dir(folder.path())).success().stderr
    };
    let (gyre, saddle, data) = (config("double_gyre.toml"), config("saddle.toml"), ocean(folder.path()));
    let told = said(&[&gyre, "--contour", "0.2,90", "--range", "20,30"]);
    assert!(told.contains("--contour 90: no line, since the FTLE of the map is ") && !told.contains("--contour 0.2"), "{told}");
    assert!(told.contains("--range 20,30: one colour, since the FTLE of the map is "), "{told}");
    let told = said(&[&saddle]);
    assert!(told.contains("FTLE is uniform") && told.contains("--range and --contour set the colours"), "{told}");
    // Seconds, where days were meant.
    let told = said(&[text(&data), "--tau", "2"]);
    assert!(told.contains("tau is 2 s, less than the ") && told.contains("as \"5 days\""), "{told}");
    let told = said(&[&config("abc.toml"), "--tau", "2"]);
    assert!(told.contains("--level is not given: 3.14 is shown of 0 to 6.28"), "{told}");
}

#[test]
fn refusals_name_what_is_wrong() {
    let folder = tempfile::tempdir().unwrap();
    let (gyre, abc, data) = (config("double_gyre.toml"), config("abc.toml"), ocean(folder.path()));
    let cases: [(&[&str], &[&str]); 15] = [
        (&[&gyre, "--seeds", "3"], &["--seeds", "even numbers from 2 to 4096"]),
        (&[&gyre, "--width", "8"], &["--width", "16"]),
        (&[&gyre, "--projection", "mercator"], &["--projection mercator", "accepted: plain"]),
        (&[&gyre, "--projection", "round"], &["--projection", "plate_carree, mercator, lambert, polar"]),
        (&[&gyre, "--level", "0.1"], &["--level 0.1", "two dimensions"]),
        (&[&abc, "--level", "99"], &["--level 99", "accepted: 0 to 6.28"]),
        (&[&gyre, "--tau", "soon"], &["--tau", "30 days"]),
        (&[&gyre, "--range", "2,1"], &["--range", "LOW below HIGH"]),
        (&[&gyre, "--slide", "99"], &["--slide 99", "fewer slides: 10, counted from 0"]),
        (&[&gyre, "--ridge-length", "4"], &["--ridge-length", "no ridge lines", "--ridges"]),
        (&[&gyre, "--ridge-percentile", "80"], &["--ridge-percentile", "no ridge lines", "--ridges"]),
        (&[&gyre, "--out", "map.gif"], &["--out map.gif", ".png or .svg"]),
        (&[&gyre, "--width", "32", "--lines", "ridges.geojson"], &["--lines ridges.geojson", ".nc or .vtk"]),
        (&[&gyre, "--width", "32", "--lines", "ridges.shp"], &["--lines ridges.shp", ".geojson, .nc or .vtk"]),
        (&[text(&data), "--tau", "2 days", "--projection", "polar", "--level", "3"], &["--level 3", "two dimensions"]),
    ];
    for (arguments, parts) in cases {
        let elsewhere = tempfile::tempdir().unwrap();
        let all: Vec<&str> = ["map"].into_iter().chain(arguments.iter().copied()).collect();
        run(ridgewatch(all).current_dir(elsewhere.path())).refused(2, parts);
        let left: Vec<_> =
            std::fs::read_dir(elsewhere.path()).unwrap().map(|e| e.unwrap().file_name()).filter(|name| name != "out").collect();
        assert!(left.is_empty(), "{arguments:?} leaves {left:?}");
    }
    // All velocities are missing.
    let lon: Vec<f64> = (0..6).map(f64::from).collect();
    let nothing = Fixture::on(
        NETCDF4,
        &[("time", "hours since 2002-01-01", &[0.0, 1.0]), ("lat", "degrees_north", &lon), ("lon", "degrees_east", &lon)],
    )
    .winds(Data::F32(vec![f32::NAN; 72]), Data::F32(vec![f32::NAN; 72]))
    .write(&folder.path().join("nothing.nc"));
    run(ridgewatch(["map", text(&nothing), "--tau", "3600"]).current_dir(folder.path())).refused(1, &["no pixel has a velocity"]);
}

#[test]
fn a_signal_leaves_no_picture() {
    let folder = tempfile::tempdir().unwrap();
    let gyre = config("double_gyre.toml");
    let mut command = ridgewatch(["map", &gyre, "--device", "cpu", "--width", "4000", "--seeds", "64", "--out", "map.png", "-vv"]);
    let mut running = start(command.current_dir(folder.path()));
    std::thread::sleep(std::time::Duration::from_millis(1500));
    assert!(!running.has_ended(), "{}", running.stderr());
    // `nohup` and background shells ignore SIGINT.
    running.signal(libc::SIGTERM);
    until("the end", || running.has_ended());
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0, "nothing half written");
}
