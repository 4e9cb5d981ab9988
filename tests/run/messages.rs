//! Messages and files of a run for readers who have nothing else: the data, colours and units, and what was lost.

use crate::kit::netcdf::{Fixture, NETCDF4, f32s, fill};
use crate::kit::program::{Outcome, config, records, run, summary};
use crate::kit::scene::{self, scene};
use crate::{in_folder, picture};
use ridgewatch::surrogate::network::{Architecture, NetworkSettings};
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::Command;

/// Runs in `folder`, with a log line for each frame.
fn ridgewatch(folder: &Path, arguments: &[&str]) -> Outcome {
    run(in_folder(folder, arguments).env("RIDGEWATCH_LOG", "ridgewatch=info"))
}

/// Standard output and standard error of a run that succeeds.
fn succeeds(folder: &Path, arguments: &[&str]) -> (String, String) {
    let outcome = ridgewatch(folder, arguments).success();
    (outcome.stdout, outcome.stderr)
}

/// Runs with pictures of 32 x 16 pixels.
fn drawn(folder: &Path, arguments: &[&str]) -> (String, String) {
    let picture = picture([32, 16, 1]);
    succeeds(folder, &arguments.iter().copied().chain(picture.iter().map(String::as_str)).collect::<Vec<_>>())
}

/// `configs/globe.toml` at a size for tests.
const GLOBE: [&str; 4] = ["--set", "archive.synthetic.nodes=[24, 13, 6]", "--set", "archive.synthetic.snapshots=4"];
const TWO_DAYS: [&str; 2] = ["--set", "time.tau=2 days"];

/// Four days over a plane of 2000 km by 1000 km with these velocities (m/s) at x and y in [0, 1].
fn winds(folder: &Path, velocity: fn(f64, f64) -> [f64; 2]) -> String {
    let (nt, ny, nx) = (4, 11, 21);
    let component = |c: usize| f32s(fill(nt, ny, nx, |_, y, x| velocity(x as f64 / 20.0, y as f64 / 10.0)[c]));
    let metres = |n: usize| (0..n).map(|i| 1e5 * i as f64).collect::<Vec<_>>();
    let axes: [(&str, &str, &[f64]); 3] =
        [("time", "days since 2000-01-01", &[0.0, 1.0, 2.0, 3.0]), ("y", "m", &metres(ny)), ("x", "m", &metres(nx))];
    Fixture::on(NETCDF4, &axes).winds(component(0), component(1)).write(&folder.join("winds.nc")).display().to_string()
}

/// Winds that stretch.
fn waves(x: f64, y: f64) -> [f64; 2] {
    [20.0 * (6.0 * y).sin(), 20.0 * (6.0 * x).cos()]
}

#[test]
fn a_globe_has_cells_and_entries_along_its_longitudes_and_says_that_it_is_made_up() {
    let folder = tempfile::tempdir().unwrap();
    let settings = NetworkSettings { log2_table: Some(12), ..NetworkSettings::default() };
    let set = ["--set", "network.log2_table=12", "--set", "surrogate.kind=network", "--set", "training.steps_per_frame=1"];
    let scene = config("globe.toml");
    let run = ["replay", &scene, "--set", "time.slides=1", "--out", "run"];
    let (_, said) = drawn(folder.path(), &[&run[..], &GLOBE, &TWO_DAYS, &set].concat());
    assert!(said.contains("the velocities are synthetic turbulence, seed 0"), "{said}");
    assert!(!said.contains('\u{1b}'), "no colours for a file: {said:?}");
    let (summary, records) = (summary(&folder.path().join("run")), records(&folder.path().join("run")));
    assert!(records[0].source.starts_with("synthetic turbulence, seed 0") && records[0].source.contains("NetCDF"), "{}", records[0].source);
    assert_eq!((summary["run"]["source"].as_str().unwrap(), records[0].time_unit.as_str()), (records[0].source.as_str(), "s"));
    // 360 by 180 degrees, and heights that count as a quarter of the longer edge.
    let shape = Architecture::new(&settings, &[0, 1, 2], [360.0, 180.0, 90.0]).unwrap();
    assert_eq!(summary["run"]["surrogate_bytes"].as_u64(), Some(4 * shape.parameters() as u64));

    // The files say so as well.
    let [archive] =
        std::fs::read_dir(folder.path().join("out/synthetic")).unwrap().map(|e| e.unwrap().path()).collect::<Vec<_>>().try_into().unwrap();
    let files = archive.join("*.nc").display().to_string();
    let (inspected, _) = succeeds(folder.path(), &["inspect", &files]);
    assert!(inspected.contains("synthetic turbulence, seed 0"), "{inspected}");
    succeeds(folder.path(), &["synthesize", "flame", "--out", "flame", "--nodes", "8x8x8", "--snapshots", "2", "--seed", "5"]);
    let (inspected, _) = succeeds(folder.path(), &["inspect", "flame"]);
    assert!(inspected.contains("synthetic turbulence, seed 5"), "{inspected}");

    // As many seeds along z as there are levels, not one every other degree in metres.
    let (report, said) = succeeds(folder.path(), &[&["ftle", &scene, "--grid", "9x5", "--json"][..], &GLOBE, &TWO_DAYS].concat());
    assert_eq!(serde_json::from_str::<serde_json::Value>(&report).unwrap()["grid"], serde_json::json!([9, 5, 6]));
    assert!(said.contains("synthetic"), "{said}");
}

#[test]
fn a_field_has_the_units_of_its_source() {
    let folder = tempfile::tempdir().unwrap();
    let file = winds(folder.path(), waves);
    // UDUNITS knows no snapshots.
    for (set, unit, of_ftle, counted_from) in [
        (&["--set", "archive.metric=cartesian", "--set", "time.tau=2 days"][..], "s", "s-1", "seconds since 1970-01-01 00:00:00"),
        (&["--set", "archive.metric=index", "--set", "time.tau=2"], "snapshots", "1", "1"),
    ] {
        let (out, said) = succeeds(folder.path(), &[&["ftle", &file, "--grid", "9x5", "-o", "field.nc"][..], set].concat());
        assert!(
            out.contains(&format!(" {unit}")) && out.contains(&format!(" 1/{unit}\n")) && said.contains("from that of twice as many"),
            "{out}{said}"
        );
        let field = netcdf::open(folder.path().join("field.nc")).unwrap();
        let text = |attribute: Option<netcdf::Attribute>| match attribute.unwrap().value().unwrap() {
            netcdf::AttributeValue::Str(text) => text,
            other => panic!("{other:?}"),
        };
        let of = |variable: &str, name: &str| text(field.variable(variable).unwrap().attribute(name));
        assert_eq!(
            (of("ftle", "units"), of("ftle", "integration_time_units"), of("time", "units")),
            (of_ftle.into(), unit.into(), counted_from.into())
        );
        let error = field.variable("ftle_error_of_steps").unwrap().get_value::<f64, _>([0]).unwrap();
        assert!(error > 0.0 && error < 1.0, "the field states its accuracy: {error}");
    }
}

#[test]
fn colours_are_told_and_what_has_none_is_warned_of() {
    let folder = tempfile::tempdir().unwrap();
    let colours = "colours from FTLE ";
    let file = winds(folder.path(), waves);
    let (_, said) = drawn(folder.path(), &[&["replay", &file, "--out", "run"][..], &TWO_DAYS].concat());
    assert!(said.contains(colours) && said.contains(" /s (") && !said.contains("FTLE is uniform"), "{said}");
    let (summary, records) = (summary(&folder.path().join("run")), records(&folder.path().join("run")));
    let transfer = records[0].transfer;
    assert!(transfer.low < transfer.high && transfer.extinction > 0.0, "{transfer:?}");
    assert_eq!(summary["run"]["transfer"], serde_json::to_value(transfer).unwrap());

    let still = winds(folder.path(), |_, _| [0.0, 0.0]);
    let saddle = scene("saddle", [32, 16, 1], "domain.min = [-1, -1, 0]\ndomain.max = [1, 1, 0.2]\ntime.tau = 2");
    let saddle = scene::write(folder.path(), &saddle);
    for source in [&still, &saddle] {
        let set: &[&str] = if *source == still { &TWO_DAYS } else { &[] };
        let (_, said) = drawn(folder.path(), &[&["render", source, "--out", "r.png", "--method", "reference"][..], set].concat());
        assert!(said.contains(colours) && said.contains("FTLE is uniform"), "{source}: {said}");
        let given = ["--set", "transfer.low=0", "--set", "transfer.high=1"];
        let (_, said) = drawn(folder.path(), &[&["render", source, "--out", "r.png", "--method", "reference"][..], set, &given].concat());
        assert!(said.contains(" to 1.000e0") && !said.contains("FTLE is uniform"), "as set: {said}");
        assert!(!said.contains("next to no FTLE lies"), "{said}");
    }
    // Rates of a day, where those of a second are asked for.
    let given = ["--set", "transfer.low=0.1", "--set", "transfer.high=2"];
    let (_, said) = drawn(folder.path(), &[&["render", &file, "--out", "r.png"][..], &TWO_DAYS, &given].concat());
    assert!(said.contains("next to no FTLE lies above transfer.low = 1.000e-1 /s"), "{said}");
}

#[test]
fn a_fill_value_that_the_file_does_not_name_is_told() {
    let folder = tempfile::tempdir().unwrap();
    let file = winds(folder.path(), |x, y| if x < 0.4 { [-9999.0; 2] } else { waves(x, y) });
    let told = "the velocity along x is -9999 at ";
    let (_, said) = succeeds(folder.path(), &["inspect", &file]);
    assert!(said.contains(told) && said.contains("archive.fill_value = -9999 takes it as missing"), "{said}");
    let (_, said) = succeeds(folder.path(), &["inspect", &file, "--set", "archive.fill_value=-9999"]);
    assert!(!said.contains(told), "{said}");
}

#[test]
fn land_is_no_share_of_what_is_traced() {
    let folder = tempfile::tempdir().unwrap();
    let coast = |x: f64, y: f64| if x < 0.4 { [f64::NAN; 2] } else { [2.0 * (6.0 * y).sin(), 2.0 * (6.0 * x).cos()] };
    let file = winds(folder.path(), coast);
    let replay = ["replay", &file, "--out", "run", "--method", "reference", "--set", "time.slides=1"];
    let (out, _) = drawn(folder.path(), &[&replay[..], &TWO_DAYS].concat());
    let record = &records(&folder.path().join("run"))[0];
    assert!(record.missing > 0 && record.traced_share == 1.0, "{record:?}");
    let told = format!("traced 100.0 % of {} queries, {} more on land", record.queries - record.missing, record.missing);
    assert!(out.contains(&told), "{out}");
    assert_eq!(summary(&folder.path().join("run"))["totals"]["traced_share"], 1.0);
}

#[test]
fn particles_that_do_not_live_are_told_of() {
    let folder = tempfile::tempdir().unwrap();
    // A fill value that the file does not declare.
    let file = winds(folder.path(), |x, y| [1e30 * (6.0 * y).sin(), 1e30 * (6.0 * x).cos()]);
    let replay = ["replay", &file, "--out", "run", "--method", "reference"];
    let (out, said) = drawn(folder.path(), &[&replay[..], &TWO_DAYS].concat());
    assert!(out.contains("particles live 0.0 % of tau"), "{out}");
    assert_eq!(said.matches("of tau on average").count(), 1, "once a run: {said}");
    // Particles of a slow wind live.
    let file = winds(folder.path(), |_, y| [0.1 * (6.0 * y).sin(), 0.0]);
    let (_, said) = drawn(folder.path(), &[&["replay", &file, "--out", "other", "--method", "reference"][..], &TWO_DAYS].concat());
    assert!(!said.contains("of tau on average"), "{said}");
}

#[test]
fn a_closed_form_is_not_published_as_another_flow() {
    let folder = tempfile::tempdir().unwrap();
    for name in ["saddle.toml", "double_gyre.toml"] {
        ridgewatch(folder.path(), &["publish", &config(name), "--ring", "ring"]).refused(2, &["`source.kind`", "\"turbulence\""]);
        assert!(!folder.path().join("ring").exists());
    }
}

#[test]
#[cfg(unix)]
fn lost_pictures_are_a_failure() {
    let folder = tempfile::tempdir().unwrap();
    // No file may exceed 16 KiB: an EXR of 64 x 48 pixels does, records do not. Like a full disk, with another error.
    let replay = |more: &str| {
        let command = format!(
            "trap '' XFSZ; ulimit -f 16; exec '{}' replay '{}' --out run --overwrite --method reference --device cpu \
             --set render.width=64 --set render.height=48 --set render.samples=1 --set time.slides=2 --set time.frames_per_slide=1 --set time.warmup_frames=0 {more}",
            env!("CARGO_BIN_EXE_ridgewatch"),
            config("double_gyre.toml")
        );
        let outcome = run(Command::new("bash").args(["-c", &command]).current_dir(folder.path()));
        (outcome.status, outcome.stdout + &outcome.stderr)
    };
    let (status, said) = replay("");
    assert!(
        status == Some(1) && said.contains("run/frames: 0 of 2 pictures written (2 failed, and 2 maps: File too large"),
        "{status:?} {said}"
    );
    assert!(!said.contains("frames in run/frames"), "{said}");
    let (status, said) = replay("--json");
    assert!(status == Some(1) && said.contains("0 of 2 pictures written"), "{status:?} {said}");
    // A map is larger as well.
    let (status, said) = replay("--set publish.exr=none");
    assert!(status == Some(1) && said.contains("run/maps: 2 maps are lost (File too large"), "{status:?} {said}");
    // Without EXR files and maps, everything that was asked for exists.
    let (status, said) = replay("--set publish.exr=none --set publish.maps=false");
    assert!(status == Some(0) && said.contains("frames in run/frames"), "{status:?} {said}");
}

/// In a folder that others could prepare, an archive replaces links instead of writing to where they lead, and is not written where all users may write.
#[test]
fn a_synthetic_archive_follows_no_links() {
    let folder = tempfile::tempdir().unwrap();
    let precious = folder.path().join("precious");
    std::fs::write(&precious, "precious").unwrap();
    for (shape, file) in [("ecmwf", "ecmwf_0000.nc"), ("flame", "flame_0000.h5")] {
        let out = folder.path().join(shape);
        std::fs::create_dir(&out).unwrap();
        for link in [file.to_owned(), format!(".{file}.part")] {
            std::os::unix::fs::symlink(&precious, out.join(link)).unwrap();
        }
        let arguments = ["synthesize", shape, "--out", shape, "--nodes", "8x8x8", "--snapshots", "2"];
        succeeds(folder.path(), &arguments);
        assert_eq!(std::fs::read_to_string(&precious).unwrap(), "precious");
        succeeds(folder.path(), &["inspect", shape]);
        std::fs::set_permissions(&out, std::fs::Permissions::from_mode(0o777)).unwrap();
        ridgewatch(folder.path(), &arguments).refused(1, &["has mode 0777", "into which not all users may write"]);
    }
}
