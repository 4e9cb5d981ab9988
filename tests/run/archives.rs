//! Archives and checkpoints in runs of the program.

use crate::kit::netcdf::{Fixture, NETCDF4, f32s, fill};
use crate::kit::program::{self, config, records, run, set, summary, text};
use crate::kit::scene;
use crate::{picture, ridgewatch};
use ridgewatch::run::{FrameRecord, open_snapshots};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

/// Replays with small pictures into the folder `out`; the result must be exit status 0.
fn replay(scene: &str, out: &Path, options: &[&str]) -> program::Outcome {
    let mut command = program::ridgewatch(["replay", scene, "--out", text(out)]);
    run(command.args(picture([48, 32, 2])).args(options)).success()
}

/// Ten days of an eddy of about 1 m/s over 10 x 8 degrees, with a square of land (NaN) in the south-west.
fn eddy(folder: &Path) -> PathBuf {
    days_of_eddy(folder, "eddy.nc", 0..10)
}

fn days_of_eddy(folder: &Path, name: &str, days: Range<usize>) -> PathBuf {
    let (nt, ny, nx) = (days.len(), 17, 21);
    let land = |y: usize, x: usize| x < 5 && y < 5;
    let component = |sign: f64, along: fn(f64, f64) -> f64| {
        f32s(fill(nt, ny, nx, move |t, y, x| {
            let (east, north) = (x as f64 / 20.0 - 0.5 - 0.01 * t as f64, y as f64 / 16.0 - 0.5);
            if land(y, x) { f64::NAN } else { sign * along(east, north) * 4.0 * (-6.0 * (east * east + north * north)).exp() }
        }))
    };
    let degrees = |first: f64, n: usize| (0..n).map(|i| first + 0.5 * i as f64).collect::<Vec<_>>();
    let days: Vec<f64> = days.map(|t| t as f64).collect();
    let (lon, lat) = (degrees(10.0, nx), degrees(-40.0, ny));
    let axes: [(&str, &str, &[f64]); 3] =
        [("time", "days since 2000-01-01", &days), ("lat", "degrees_north", &lat), ("lon", "degrees_east", &lon)];
    Fixture::on(NETCDF4, &axes)
        .fields("m/s", [("u", component(-1.0, |_, north| north))])
        .with("standard_name", "eastward_sea_water_velocity")
        .fields("m/s", [("v", component(1.0, |east, _| east))])
        .with("standard_name", "northward_sea_water_velocity")
        .write(&folder.join(name))
}

/// The window goes on into a file that is written while the run waits for it.
#[test]
fn an_archive_that_is_followed_gives_the_slides_that_come() {
    let folder = tempfile::tempdir().unwrap();
    let data = folder.path().join("data");
    std::fs::create_dir(&data).unwrap();
    let out = folder.path().join("run");
    days_of_eddy(&data, "first.nc", 0..4);
    let writer = std::thread::spawn({
        let (records, data, aside) = (out.join("records.jsonl"), data.clone(), folder.path().to_owned());
        move || {
            let begin = Instant::now();
            while std::fs::read_to_string(&records).map_or(0, |text| text.lines().count()) < 2 {
                assert!(begin.elapsed() < Duration::from_secs(120), "no frames came");
                std::thread::sleep(Duration::from_millis(20));
            }
            std::fs::rename(days_of_eddy(&aside, "part", 4..8), data.join("second.nc")).unwrap();
        }
    });
    let keys = set(&["time.tau=2 days", "time.slides=5", "render.method=reference"]);
    replay(text(&data), &out, &[&["--follow=120"], &keys[..]].concat());
    writer.join().unwrap();
    let dates: Vec<String> = records(&out).into_iter().map(|r| r.date.unwrap()).collect();
    assert_eq!(dates, (3..8).map(|day| format!("2000-01-{day:02}T00:00:00Z")).collect::<Vec<_>>());
    assert_eq!(summary(&out)["run"]["slides"], 5);
}

#[test]
fn one_of_three_snapshots_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let file = eddy(folder.path());
    let report = |keys: &[&str]| ridgewatch([&["inspect", text(&file), "--json"][..], &set(keys)].concat()).success().json();
    let (all, read) = (report(&[]), report(&["time.every=3"]));
    let of = |report: &serde_json::Value, key: &str| report["time"][key].clone();
    assert_eq!((of(&all, "snapshots"), of(&read, "snapshots"), of(&read, "interval")), (10.into(), 4.into(), (3.0 * 86_400.0).into()));
    assert_eq!(of(&read, "last"), "2000-01-10T00:00:00Z");
    assert!(read["source"]["notes"].to_string().contains("4 of 10 snapshots are read, as set (time.every = 3)"), "{read}");
    // A particle goes three times as far between two of them. Both look at the first and the last, and at others between.
    let far = |report: &serde_json::Value| report["resolution"]["rms_cells"].as_f64().unwrap();
    assert!((2.5..=3.5).contains(&(far(&read) / far(&all))), "{} {}", far(&read), far(&all));
    for (snapshots, read) in [(8, 3), (9, 3), (10, 4)] {
        let name = format!("of_{snapshots}.nc");
        let file = days_of_eddy(folder.path(), &name, 0..snapshots);
        let scene = scene::scene("archive", [8, 8, 1], &format!("archive.files = [{:?}]\ntime.every = 3", text(&file)));
        let mut source = open_snapshots(&scene::parse(&scene, &[]).unwrap().settings()).unwrap();
        assert_eq!(source.times().len(), read, "ceil({snapshots} / 3)");
        let days: Vec<f64> = (0..read).map(|index| (source.read(index).unwrap().time - source.times()[0]) / 86_400.0).collect();
        assert_eq!(days, (0..read).map(|index| 3.0 * index as f64).collect::<Vec<_>>());
    }
    // Days 0, 3, 6 and 9: two windows of six days, and one that moves by two snapshots.
    let dates = |name: &str, keys: &[&str]| {
        let run = folder.path().join(name);
        replay(text(&file), &run, &set(&[&["time.every=3", "render.method=reference", "time.tau=6 days"][..], keys].concat()));
        records(&run).into_iter().map(|record| record.date.unwrap()).collect::<Vec<_>>()
    };
    assert_eq!(dates("single", &[]), ["2000-01-07T00:00:00Z", "2000-01-10T00:00:00Z"]);
    assert_eq!(dates("double", &["time.tau=3 days", "time.snapshots_per_slide=2"]), ["2000-01-04T00:00:00Z", "2000-01-10T00:00:00Z"]);
    let out = folder.path().join("none");
    let refused = |keys: &[&str], status, parts: &[&str]| {
        ridgewatch([&["replay", text(&file), "--out", text(&out)][..], &set(keys)].concat()).refused(status, parts);
    };
    refused(&["time.every=10"], 1, &["eddy.nc (time.every = 10) holds one time"]);
    refused(&["time.every=3", "time.tau=9.5 days"], 1, &["eddy.nc (time.every = 3) has 4"]);
    refused(&["time.every=0"], 2, &["`time.every` is 0; accepted: a whole number from 1 to 1000000"]);
}

/// HDF5 locks files that it reads, and a solver that cannot open its file to append to it ends.
#[test]
fn a_solver_appends_to_the_file_that_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let (file, out) = (folder.path().join("growing.nc"), folder.path().join("run"));
    let write = |file: &mut netcdf::FileMut, day: usize| {
        file.variable_mut("time").unwrap().put_values(&[day as f64], day..=day).unwrap();
        for (name, sign) in [("u", -1.0), ("v", 1.0)] {
            let values: Vec<f32> = (0..32 * 32).map(|i| sign * ([i / 32, i % 32][usize::from(name == "v")] as f32 - 15.5) / 8.0).collect();
            file.variable_mut(name).unwrap().put_values(&values, (day..=day, 0..32, 0..32)).unwrap();
        }
    };
    {
        let mut new = netcdf::create(&file).unwrap();
        new.add_unlimited_dimension("time").unwrap();
        for (name, units) in [("lat", "degrees_north"), ("lon", "degrees_east")] {
            new.add_dimension(name, 32).unwrap();
            let mut axis = new.add_variable::<f64>(name, &[name]).unwrap();
            axis.put_attribute("units", units).unwrap();
            axis.put_values(&(0..32).map(|i| 10.0 + 0.25 * f64::from(i)).collect::<Vec<_>>(), ..).unwrap();
        }
        new.add_variable::<f64>("time", &["time"]).unwrap().put_attribute("units", "days since 2000-01-01").unwrap();
        for name in ["u", "v"] {
            new.add_variable::<f32>(name, &["time", "lat", "lon"]).unwrap().put_attribute("units", "m/s").unwrap();
        }
        (0..6).for_each(|day| write(&mut new, day));
    }
    let records_file = out.join("records.jsonl");
    let solver = || {
        // In each thread, libhdf5 prints errors that libnetcdf expects.
        hdf5_metno::silence_errors(true);
        let begin = Instant::now();
        while std::fs::read_to_string(&records_file).map_or(0, |text| text.lines().count()) < 1 {
            assert!(begin.elapsed() < Duration::from_secs(120), "no frame came");
            std::thread::sleep(Duration::from_millis(20));
        }
        // The run reads three days more, and has the file open.
        for day in 6..12 {
            write(&mut netcdf::append(&file).expect("the solver's file is locked"), day);
            std::thread::sleep(Duration::from_millis(100));
        }
    };
    std::thread::scope(|scope| {
        scope.spawn(solver);
        let keys = set(&["time.tau=2 days", "time.slides=10", "render.method=reference"]);
        replay(text(&file), &out, &[&["--follow=120"], &keys[..]].concat());
    });
    let dates: Vec<String> = records(&out).into_iter().map(|r| r.date.unwrap()).collect();
    assert_eq!(dates, (3..13).map(|day| format!("2000-01-{day:02}T00:00:00Z")).collect::<Vec<_>>());
}

/// The program takes no locks, and heeds those of others.
#[test]
fn a_file_that_another_process_has_locked_is_refused_unless_locks_are_off() {
    let folder = tempfile::tempdir().unwrap();
    let file = eddy(folder.path());
    let locked = std::fs::File::open(&file).unwrap();
    locked.lock().unwrap();
    let mut inspect = program::ridgewatch(["inspect", text(&file)]);
    run(&mut inspect).refused(1, &["eddy.nc", "another process has locked it", "HDF5_USE_FILE_LOCKING=FALSE"]);
    run(inspect.env("HDF5_USE_FILE_LOCKING", "FALSE")).success();
}

#[test]
fn an_archive_with_land_goes_through_the_whole_loop() {
    let folder = tempfile::tempdir().unwrap();
    let run = folder.path().join("run");
    let keys =
        set(&["time.tau=6 days", "render.method=gated", "surrogate.kind=residual", "training.steps_per_frame=20", "trust.cells=[8, 8, 1]"]);
    replay(text(&eddy(folder.path())), &run, &keys);
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
    let summary = summary(&run);
    // 21 x 17 nodes of 4 f32, seven snapshots.
    assert!(summary["run"]["window_bytes_peak"].as_u64().unwrap() < 2 * 7 * 21 * 17 * 16);
    // Without table nodes in the scene, the table below the network has those of the data: 21 x 17 f32.
    assert!(summary["run"]["surrogate_bytes"].as_u64().unwrap() > 21 * 17 * 4);
}

/// The FTLE folds into filaments finer than the nodes of the data: the picture of a table at these is mostly the noise of its correction.
#[test]
fn smooth_pictures_of_a_flat_archive_have_a_table_as_fine_as_they_are() {
    let folder = tempfile::tempdir().unwrap();
    let file = eddy(folder.path());
    let stated = |name: &str, keys: &[&str]| {
        let run = folder.path().join(name);
        let common =
            ["render.method=two_level", "time.tau=6 days", "time.slides=1", "render.samples=8", "transfer.low=1e-6", "transfer.high=5e-6"];
        replay(text(&file), &run, &set(&[&common, keys].concat()));
        (summary(&run)["run"]["surrogate_bytes"].as_u64().unwrap(), records(&run)[0].picture_error.unwrap().rms.value)
    };
    // Two a pixel along 10 degrees of longitude, and in proportion along 8 of latitude.
    let (bytes, error) = stated("fine", &["surrogate.refine=false"]);
    let (coarse_bytes, coarse_error) = stated("coarse", &["surrogate.table_nodes=[21, 17, 2]"]);
    assert_eq!(coarse_bytes, 21 * 17 * 4);
    assert!((97 * 70 * 4..=97 * 97 * 4).contains(&bytes), "{bytes}");
    assert!(error < 0.7 * coarse_error, "{error} {coarse_error}");
    // Eight samples a pixel in a single frame are worth a table of four times as many nodes.
    let (refined_bytes, _) = stated("refined", &[]);
    assert!((193 * 139 * 4..=193 * 193 * 4).contains(&refined_bytes), "{refined_bytes}");
}

#[test]
fn the_shipped_archive_scenes_run_over_what_they_promise() {
    for (name, nodes, tau) in [("ecmwf", "[24, 12, 6]", 11.0), ("flame", "[24, 12, 12]", 6.0), ("globe", "[24, 13, 5]", 11.0 * 86_400.0)] {
        let folder = tempfile::tempdir().unwrap();
        let (run, files) = (folder.path().join("run"), folder.path().join("archive"));
        let (nodes, files) = (format!("archive.synthetic.nodes={nodes}"), format!("archive.synthetic.folder={files:?}"));
        let said = replay(&config(&format!("{name}.toml")), &run, &set(&[&nodes, &files])).stderr;
        let records = records(&run);
        assert_eq!(records.len(), 3, "{name}: of 14 or 9 snapshots, windows of 12 or 7");
        for record in &records {
            assert_eq!((record.direction.as_str(), record.tau, record.missing), ("backward", tau, 0), "{name}");
            // At least one step an interval, and no more than the colours need.
            let steps = record.integration_steps.unwrap();
            assert!(
                (if name == "flame" { 6..=12 } else { 11..=22 }).contains(&steps) && record.integration_residual.unwrap() <= 0.02,
                "{name}: {steps}"
            );
        }
        assert_eq!(said.contains("goes round: periodic with 360"), name == "globe", "{name}: {said}");
    }
}

#[test]
fn a_variable_that_the_file_lacks_points_at_its_line() {
    let folder = tempfile::tempdir().unwrap();
    let file = eddy(folder.path());
    let scene = format!("[source]\nkind = \"archive\"\n[archive]\nfiles = {:?}\nu = \"uo\"\n", text(&file));
    let scene = scene::write(folder.path(), &scene);
    let parts = ["scene.toml:5: `archive.u` is \"uo\"", "eddy.nc", "| u = \"uo\""];
    ridgewatch(["replay", &scene, "--out", text(&folder.path().join("run"))]).refused(2, &parts);
    ridgewatch(["ftle", text(&file), "--set", "archive.v=vo"]).refused(2, &["--set archive.v=vo: `archive.v`"]);
}

#[test]
fn a_default_that_an_archive_makes_unacceptable_names_the_archive() {
    // A strip of 4 m by 400,000 km: the default extinction follows the shortest edge, and is too large along the strip.
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("strip.nc");
    let constant = || f32s(vec![1.0; 2 * 5 * 5]);
    let (short, long) = ([0.0, 1.0, 2.0, 3.0, 4.0], [0.0, 1e8, 2e8, 3e8, 4e8]);
    let axes: [(&str, &str, &[f64]); 3] = [("time", "days since 2000-01-01", &[0.0, 1.0]), ("y", "m", &short), ("x", "m", &long)];
    Fixture::on(NETCDF4, &axes).winds(constant(), constant()).write(&file);
    ridgewatch(["ftle", text(&file), "--set", "time.tau=3600"]).refused(2, &["`transfer.extinction`", "strip.nc"]);
}

#[test]
fn one_snapshot_is_a_steady_flow_where_that_is_set() {
    // Half a rotation a day about (0, 0), on a plane in metres.
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("one.nc");
    let axis: Vec<f64> = (0..21).map(|i| f64::from(i) * 1000.0 - 10_000.0).collect();
    let rate = std::f64::consts::PI / 86_400.0;
    let axes: [(&str, &str, &[f64]); 3] = [("time", "days since 2000-01-01", &[3.0]), ("y", "m", &axis), ("x", "m", &axis)];
    let [u, v] = [fill(1, 21, 21, |_, y, _| -rate * axis[y]), fill(1, 21, 21, |_, _, x| rate * axis[x])];
    Fixture::on(NETCDF4, &axes).winds(f32s(u), f32s(v)).write(&file);
    let ftle = |keys: &[&str]| ridgewatch([&["ftle", text(&file), "--grid", "5x5", "--json"][..], &set(keys)].concat());
    let output = ftle(&["time.tau=1 day"]);
    assert!(output.status != Some(0) && output.stderr.contains("one.nc holds one time (2000-01-04T00:00:00Z)"), "{output:?}");
    ftle(&["archive.steady=true"]).refused(2, &["`time.tau` is missing"]);
    for direction in ["time.direction=backward", "time.direction=forward"] {
        let found = ftle(&[direction, "archive.steady=true", "time.tau=1 day", "flow.boundary=clamp"]).success().json().to_string();
        assert!(found.contains("2000-01-04T00:00:00Z"), "{found}");
    }
}

/// A scene of so many frames, written into a folder.
fn gyre(folder: &Path, frames: usize) -> String {
    let keys = "
        time.tau = 10
        time.slides = 1
        flow.steps = 40
        transfer.low = 0.05
        transfer.high = 0.45
        surrogate.kind = \"network\"
        network.log2_table = 14
        network.batch = 2048
        training.steps_per_frame = 150
    ";
    scene::write(folder, &scene::double_gyre([32, 16, 1], &format!("{keys}time.frames_per_slide = {frames}")))
}

#[test]
fn a_run_goes_on_from_a_checkpoint() {
    let folder = tempfile::tempdir().unwrap();
    let weights = folder.path().join("weights.safetensors").display().to_string();
    let at = |name: &str| folder.path().join(name);
    ridgewatch(["replay", &gyre(folder.path(), 4), "--out", text(&at("first")), "--checkpoint", &weights]).success();
    let scene = gyre(folder.path(), 1);
    ridgewatch(["replay", &scene, "--out", text(&at("second")), "--resume", &weights]).success();
    let (first, second) = (records(&at("first")), records(&at("second")));
    let loss = |record: &FrameRecord| record.training.as_ref().unwrap().loss.unwrap();
    // It begins with the loss at the end of the first run, which is far below half of the loss at its beginning.
    assert!(loss(&second[0]) < 0.5 * loss(&first[0]), "{} against {}", loss(&second[0]), loss(&first[0]));
    assert!(loss(&second[0]) < 1.5 * loss(&first[3]), "{} against {}", loss(&second[0]), loss(&first[3]));
    // A checkpoint of another shape is refused, with the reason.
    ridgewatch(["replay", &scene, "--out", text(&at("third")), "--resume", &weights, "--set", "network.width=32"])
        .refused(1, &["weights.safetensors", "does not fit"]);
}

#[test]
#[cfg(unix)]
fn what_is_written_may_be_read_by_those_whom_the_umask_lets() {
    use std::os::unix::fs::PermissionsExt;
    let folder = tempfile::tempdir().unwrap();
    let weights = folder.path().join("weights.safetensors");
    let field = folder.path().join("field.nc");
    let scene = gyre(folder.path(), 1);
    let shell = |command: String| run(Command::new("sh").args(["-c", &command])).success();
    let program = env!("CARGO_BIN_EXE_ridgewatch");
    let out = folder.path().join("run");
    shell(format!("umask 027; '{program}' replay '{scene}' --out '{}' --checkpoint '{}'", out.display(), weights.display()));
    shell(format!("umask 022; '{program}' ftle '{scene}' --grid 9x5 --out '{}'", field.display()));
    let mode = |path: &Path| std::fs::metadata(path).unwrap().permissions().mode() & 0o777;
    assert_eq!((mode(&weights), mode(&field)), (0o640, 0o644));
}

#[test]
fn adaptive_paths_have_no_number_of_steps() {
    let folder = tempfile::tempdir().unwrap();
    let run = folder.path().join("run");
    let keys = set(&["time.tau=6 days", "time.slides=2", "flow.integrator=dormandprince", "flow.precision=f64"]);
    replay(text(&eddy(folder.path())), &run, &[&["--method", "reference"][..], &keys].concat());
    let records = records(&run);
    assert!(records.len() == 2 && records.iter().all(|record| record.integration_steps.is_none() && record.traced > 0));
}

#[test]
fn what_is_chosen_is_in_the_summary_with_its_reason_and_can_be_given() {
    let folder = tempfile::tempdir().unwrap();
    let file = eddy(folder.path());
    let small = ["render.method=two_level", "render.width=32", "render.height=16", "time.slides=1", "publish.maps=false"];
    let decisions = |name: &str, keys: &[&str]| {
        let run = folder.path().join(name);
        let keys = set(&[&small[..], keys].concat());
        ridgewatch([&["replay", text(&file), "--out", text(&run)][..], &keys].concat()).success();
        let summary = summary(&run);
        let decisions = summary["run"]["decisions"].as_array().unwrap();
        let word = |decision: &serde_json::Value, key: &str| decision[key].as_str().unwrap().to_owned();
        decisions.iter().map(|d| ["setting", "chosen", "why"].map(|key| word(d, key))).collect::<Vec<_>>()
    };
    let open = decisions("open", &[]);
    let settings: Vec<&str> = open.iter().map(|[setting, ..]| setting.as_str()).collect();
    assert_eq!(settings, ["time.tau", "surrogate.table_nodes", "transfer.low", "transfer.high", "flow.steps", "time.every"], "{open:?}");
    // Two nodes a pixel along x, and both ends.
    assert!(open[1][1].starts_with("[129,") && open[1][2].starts_with("two a pixel"), "{open:?}");
    // Sixteen samples a pixel in a single frame are worth a finer table.
    assert!(open[1][2].contains("cells of [65, 53, 1] halved after 0 frames of slide 0"), "{open:?}");
    assert!(open.iter().all(|[.., why]| why.bytes().any(|c| c.is_ascii_digit()) || why.contains("median")), "{open:?}");
    let keys = ["time.tau=6 days", "surrogate.table_nodes=[32, 16, 1]", "transfer.low=0", "transfer.high=1e-5", "flow.steps=40"];
    assert_eq!(decisions("given", &keys), Vec::<[String; 3]>::new());
}

#[test]
fn a_size_left_to_the_measured_error_grows_and_says_why() {
    let folder = tempfile::tempdir().unwrap();
    let run = folder.path().join("run");
    let keys = set(&["network.size=auto", "surrogate.kind=table", "surrogate.table_nodes=[16, 8, 2]"]);
    let scene = gyre(folder.path(), 24);
    ridgewatch([&["replay", &scene, "--out", text(&run)][..], &keys].concat()).success();
    let summary = summary(&run);
    let sizes = summary["run"]["sizes"].as_array().unwrap();
    // A quarter of 16 x 8 nodes cannot hold the double gyre's ridges within 0.03.
    assert!(sizes.len() >= 2 && sizes.iter().all(|s| s.as_str().unwrap().contains("grow to size")), "{sizes:?}");
    let records = records(&run);
    let psnr = |record: &FrameRecord| record.surrogate_psnr.unwrap();
    // Every doubling of the nodes lowers the error of linear interpolation; 3 dB are less than one of them.
    assert!(psnr(&records[23]) > psnr(&records[0]) + 3.0, "{} against {} dB", psnr(&records[23]), psnr(&records[0]));
    ridgewatch(["replay", &scene, "--resume", "w", "--set", "network.size=auto"]).refused(2, &["network.size"]);
}
