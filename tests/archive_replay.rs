//! Archives and checkpoints through the front door.

#![allow(clippy::unwrap_used)]

mod netcdf_fixture;

use netcdf_fixture::{Fixture, NETCDF4, f32s, fill};
use ridgewatch::run::FrameRecord;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

fn ridgewatch(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_ridgewatch")).args(arguments).output().unwrap()
}

fn succeeds(arguments: &[&str]) -> Output {
    let output = ridgewatch(arguments);
    assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    output
}

/// Every record, which must read back as one: JSON turns a number that is none into null.
fn records(run: &Path) -> Vec<FrameRecord> {
    let text = std::fs::read_to_string(run.join("records.jsonl")).unwrap();
    text.lines().map(|line| serde_json::from_str(line).unwrap_or_else(|e| panic!("{e}: {line}"))).collect()
}

/// Ten days of an eddy of about 1 m/s over 10 x 8 degrees, with a square of land (NaN) in the south-west.
fn eddy(folder: &Path) -> PathBuf {
    let (nt, ny, nx) = (10, 17, 21);
    let land = |y: usize, x: usize| x < 5 && y < 5;
    let component = |sign: f64, along: fn(f64, f64) -> f64| {
        f32s(fill(nt, ny, nx, move |t, y, x| {
            let (east, north) = (x as f64 / 20.0 - 0.5 - 0.01 * t as f64, y as f64 / 16.0 - 0.5);
            if land(y, x) { f64::NAN } else { sign * along(east, north) * 4.0 * (-6.0 * (east * east + north * north)).exp() }
        }))
    };
    let degrees = |first: f64, n: usize| (0..n).map(|i| first + 0.5 * i as f64).collect::<Vec<_>>();
    let days: Vec<f64> = (0..nt).map(|t| t as f64).collect();
    Fixture::new(NETCDF4, &[("time", nt), ("lat", ny), ("lon", nx)])
        .axis("lon", "degrees_east", &degrees(10.0, nx))
        .axis("lat", "degrees_north", &degrees(-40.0, ny))
        .axis("time", "days since 2000-01-01", &days)
        .variable("u", &["time", "lat", "lon"], component(-1.0, |_, north| north))
        .with("standard_name", "eastward_sea_water_velocity")
        .with("units", "m/s")
        .variable("v", &["time", "lat", "lon"], component(1.0, |east, _| east))
        .with("standard_name", "northward_sea_water_velocity")
        .with("units", "m/s")
        .write(&folder.join("eddy.nc"))
}

const SMALL: [&str; 6] = ["--set", "render.width=48", "--set", "render.height=32", "--set", "render.samples=2"];

#[test]
fn an_archive_with_land_goes_through_the_whole_loop() {
    let folder = tempfile::tempdir().unwrap();
    let file = eddy(folder.path()).display().to_string();
    let run = folder.path().join("run");
    let out = run.display().to_string();
    let set = ["--set", "time.tau=6 days", "--set", "training.steps_per_frame=20", "--set", "trust.cells=[8, 8, 1]"];
    succeeds(&[&["replay", &file, "--out", &out][..], &SMALL, &set].concat());
    let records = records(&run);
    // Ten days, a window of six: the newest time is day 6, 7, 8, 9.
    let dates: Vec<&str> = records.iter().map(|r| r.date.as_deref().unwrap()).collect();
    assert_eq!(dates, ["2000-01-07T00:00:00Z", "2000-01-08T00:00:00Z", "2000-01-09T00:00:00Z", "2000-01-10T00:00:00Z"]);
    for record in &records {
        assert_eq!((record.direction.as_str(), record.tau), ("backward", 6.0 * 86_400.0));
        let missing = record.missing as f64 / record.queries as f64;
        assert!(missing > 0.0 && missing < 0.5, "land is a part of the domain: {missing}");
        assert!(record.mean_lifetime_share < 1.0, "some particles met land");
        assert!(record.integration_steps.is_some() && record.traced <= record.queries - record.missing);
    }
    let summary: serde_json::Value = serde_json::from_slice(&std::fs::read(run.join("summary.json")).unwrap()).unwrap();
    // 21 x 17 nodes of 4 f32, seven snapshots.
    assert!(summary["run"]["window_bytes_peak"].as_u64().unwrap() < 2 * 7 * 21 * 17 * 16);
    // No table nodes were set: the data's own, 21 x 17 f32 below the network.
    assert!(summary["run"]["surrogate_bytes"].as_u64().unwrap() > 21 * 17 * 4);
}

#[test]
fn the_shipped_archive_scenes_run_over_what_they_promise() {
    for (name, nodes, tau) in [("ecmwf", "[24, 12, 6]", 11.0), ("flame", "[24, 12, 12]", 6.0), ("globe", "[24, 13, 5]", 11.0 * 86_400.0)] {
        let folder = tempfile::tempdir().unwrap();
        let (run, files) = (folder.path().join("run"), folder.path().join("archive"));
        let scene = format!("{}/configs/{name}.toml", env!("CARGO_MANIFEST_DIR"));
        let (out, nodes) = (run.display().to_string(), format!("archive.synthetic.nodes={nodes}"));
        let files = format!("archive.synthetic.folder={:?}", files.display().to_string());
        let output = succeeds(&[&["replay", &scene, "--out", &out, "--set", &nodes, "--set", &files][..], &SMALL].concat());
        let said = String::from_utf8_lossy(&output.stderr);
        let records = records(&run);
        assert_eq!(records.len(), 3, "{name}: of 14 or 9 snapshots, windows of 12 or 7");
        for record in &records {
            assert_eq!((record.direction.as_str(), record.tau, record.missing), ("backward", tau, 0), "{name}");
            // Two steps an interval at the least: a path that stays within one would have two in all.
            assert!(record.integration_steps.unwrap() >= if name == "flame" { 12 } else { 22 }, "{name}: {:?}", record.integration_steps);
        }
        assert_eq!(said.contains("goes round: periodic with 360"), name == "globe", "{name}: {said}");
    }
}

#[test]
fn a_variable_that_the_file_lacks_points_at_its_line() {
    let folder = tempfile::tempdir().unwrap();
    let file = eddy(folder.path());
    let scene = folder.path().join("scene.toml");
    std::fs::write(&scene, format!("[source]\nkind = \"archive\"\n[archive]\nfiles = {:?}\nu = \"uo\"\n", file.display().to_string()))
        .unwrap();
    let output = ridgewatch(&["replay", &scene.display().to_string(), "--out", &folder.path().join("run").display().to_string()]);
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{said}");
    for part in ["scene.toml:5: `archive.u` is \"uo\"", "eddy.nc", "| u = \"uo\""] {
        assert!(said.contains(part), "{said:?} without {part:?}");
    }
    let output = ridgewatch(&["ftle", &file.display().to_string(), "--set", "archive.v=vo"]);
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.code() == Some(2) && said.contains("--set archive.v=vo: `archive.v`"), "{said}");
}

#[test]
fn a_default_that_an_archive_makes_unacceptable_names_the_archive() {
    // A strip of 4 m and 400,000 km: the default extinction, by the shortest edge, is too deep along it.
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("strip.nc");
    let still = || f32s(fill(2, 5, 5, |_, _, _| 1.0));
    Fixture::new(NETCDF4, &[("time", 2), ("y", 5), ("x", 5)])
        .axis("x", "m", &[0.0, 1e8, 2e8, 3e8, 4e8])
        .axis("y", "m", &[0.0, 1.0, 2.0, 3.0, 4.0])
        .axis("time", "days since 2000-01-01", &[0.0, 1.0])
        .variable("u", &["time", "y", "x"], still())
        .with("units", "m/s")
        .variable("v", &["time", "y", "x"], still())
        .with("units", "m/s")
        .write(&file);
    let output = ridgewatch(&["ftle", &file.display().to_string(), "--set", "time.tau=3600"]);
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.code() == Some(2) && said.contains("`transfer.extinction`") && said.contains("strip.nc"), "{said}");
}

#[test]
fn one_snapshot_is_a_steady_flow_where_that_is_set() {
    // Half a rotation a day about (0, 0), on a plane in metres.
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("one.nc");
    let axis: Vec<f64> = (0..21).map(|i| f64::from(i) * 1000.0 - 10_000.0).collect();
    let rate = std::f64::consts::PI / 86_400.0;
    let at = axis.clone();
    Fixture::new(NETCDF4, &[("time", 1), ("y", 21), ("x", 21)])
        .axis("x", "m", &axis)
        .axis("y", "m", &axis)
        .axis("time", "days since 2000-01-01", &[3.0])
        .variable("u", &["time", "y", "x"], f32s(fill(1, 21, 21, |_, y, _| -rate * at[y])))
        .with("units", "m/s")
        .variable("v", &["time", "y", "x"], f32s(fill(1, 21, 21, |_, _, x| rate * at[x])))
        .with("units", "m/s")
        .write(&file);
    let file = file.display().to_string();
    let said = |output: Output| (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned());
    let (code, message) = said(ridgewatch(&["ftle", &file, "--set", "time.tau=1 day"]));
    assert!(code != Some(0) && message.contains("one.nc holds one time (2000-01-04T00:00:00Z)"), "{message}");
    let (code, message) = said(ridgewatch(&["ftle", &file, "--set", "archive.steady=true"]));
    assert!(code == Some(2) && message.contains("`time.tau` is missing"), "{message}");
    let steady = ["--set", "archive.steady=true", "--set", "time.tau=1 day", "--set", "flow.boundary=clamp", "--grid", "5x5", "--json"];
    for direction in ["time.direction=backward", "time.direction=forward"] {
        let output = succeeds(&[&["ftle", &file, "--set", direction][..], &steady].concat());
        let found: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
        let text = found.to_string();
        assert!(text.contains("2000-01-04T00:00:00Z"), "{text}");
    }
}

fn gyre(folder: &Path, frames: usize) -> String {
    let path = folder.join(format!("gyre{frames}.toml"));
    let text = format!(
        "[source]\nkind = \"double_gyre\"\n[domain]\nmin = [0, 0, 0]\nmax = [2, 1, 0.2]\n[time]\ntau = 10\nslides = 1\nframes_per_slide = {frames}\n\
         [flow]\nsteps = 40\n[transfer]\nlow = 0.05\nhigh = 0.45\n[surrogate]\nkind = \"network\"\n[network]\nlog2_table = 14\nbatch = 2048\n\
         [render]\nwidth = 32\nheight = 16\nsamples = 1\n[training]\nsteps_per_frame = 150\n"
    );
    std::fs::write(&path, text).unwrap();
    path.display().to_string()
}

#[test]
fn a_run_goes_on_from_a_checkpoint() {
    let folder = tempfile::tempdir().unwrap();
    let weights = folder.path().join("weights.safetensors").display().to_string();
    let at = |name: &str| folder.path().join(name);
    succeeds(&["replay", &gyre(folder.path(), 4), "--out", &at("first").display().to_string(), "--checkpoint", &weights]);
    succeeds(&["replay", &gyre(folder.path(), 1), "--out", &at("second").display().to_string(), "--resume", &weights]);
    let (first, second) = (records(&at("first")), records(&at("second")));
    let loss = |record: &FrameRecord| record.training.as_ref().unwrap().loss.unwrap();
    // It begins where the other ended, not where the other began, whose loss fell by far more than half in its first frames.
    assert!(loss(&second[0]) < 0.5 * loss(&first[0]), "{} against {}", loss(&second[0]), loss(&first[0]));
    assert!(loss(&second[0]) < 1.5 * loss(&first[3]), "{} against {}", loss(&second[0]), loss(&first[3]));
    // One of another shape is refused, and says what it is.
    let other = ["--set", "network.width=32"];
    let output = ridgewatch(
        &[&["replay", &gyre(folder.path(), 1), "--out", &at("third").display().to_string(), "--resume", &weights][..], &other].concat(),
    );
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.code() == Some(1) && said.contains("weights.safetensors") && said.contains("does not fit"), "{said}");
}

#[test]
#[cfg(unix)]
fn what_is_written_may_be_read_by_those_whom_the_umask_lets() {
    use std::os::unix::fs::PermissionsExt;
    let folder = tempfile::tempdir().unwrap();
    let weights = folder.path().join("weights.safetensors");
    let field = folder.path().join("field.nc");
    let scene = gyre(folder.path(), 1);
    let shell = |command: String| {
        let output = Command::new("sh").args(["-c", &command]).output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    };
    let program = env!("CARGO_BIN_EXE_ridgewatch");
    let run = folder.path().join("run");
    shell(format!("umask 027; '{program}' replay '{scene}' --out '{}' --checkpoint '{}'", run.display(), weights.display()));
    shell(format!("umask 022; '{program}' ftle '{scene}' --grid 9x5 --out '{}'", field.display()));
    let mode = |path: &Path| std::fs::metadata(path).unwrap().permissions().mode() & 0o777;
    assert_eq!((mode(&weights), mode(&field)), (0o640, 0o644));
}

#[test]
fn adaptive_paths_have_no_number_of_steps() {
    let folder = tempfile::tempdir().unwrap();
    let file = eddy(folder.path()).display().to_string();
    let run = folder.path().join("run");
    let set =
        ["--set", "time.tau=6 days", "--set", "time.slides=2", "--set", "flow.integrator=dormandprince", "--set", "flow.precision=f64"];
    succeeds(&[&["replay", &file, "--method", "reference", "--out", &run.display().to_string()][..], &SMALL, &set].concat());
    let records = records(&run);
    assert!(records.len() == 2 && records.iter().all(|record| record.integration_steps.is_none() && record.traced > 0));
}

#[test]
fn a_size_left_to_the_measured_error_grows_and_says_why() {
    let folder = tempfile::tempdir().unwrap();
    let run = folder.path().join("run");
    let set = ["--set", "network.size=auto", "--set", "surrogate.kind=table", "--set", "surrogate.table_nodes=[16, 8, 2]"];
    succeeds(&[&["replay", &gyre(folder.path(), 24), "--out", &run.display().to_string()][..], &set].concat());
    let summary: serde_json::Value = serde_json::from_slice(&std::fs::read(run.join("summary.json")).unwrap()).unwrap();
    let sizes = summary["run"]["sizes"].as_array().unwrap();
    // A quarter of 16 x 8 nodes cannot hold the double gyre's ridges within 0.03.
    assert!(sizes.len() >= 2 && sizes.iter().all(|s| s.as_str().unwrap().contains("grow to size")), "{sizes:?}");
    let records = records(&run);
    let psnr = |record: &FrameRecord| record.surrogate_psnr.unwrap();
    // Every doubling of the nodes lowers the error of linear interpolation; 3 dB are less than one of them.
    assert!(psnr(&records[23]) > psnr(&records[0]) + 3.0, "{} against {} dB", psnr(&records[23]), psnr(&records[0]));
    let output = ridgewatch(&["replay", &gyre(folder.path(), 1), "--resume", "w", "--set", "network.size=auto"]);
    assert!(output.status.code() == Some(2) && String::from_utf8_lossy(&output.stderr).contains("network.size"));
}
