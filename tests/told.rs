//! What a run tells whoever reads its lines and files alone: what the data are, what colours and units mean, what was lost.

#![allow(clippy::unwrap_used)]

mod netcdf_fixture;

use netcdf_fixture::{Fixture, NETCDF4, f32s, fill};
use ridgewatch::run::FrameRecord;
use ridgewatch::surrogate::network::{Architecture, NetworkSettings};
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// Runs in `folder`, with what is logged of each frame.
fn ridgewatch(folder: &Path, arguments: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_ridgewatch"));
    command.args(arguments).args(["--device", "cpu"]).current_dir(folder).env("RIDGEWATCH_LOG", "ridgewatch=info").output().unwrap()
}

fn succeeds(folder: &Path, arguments: &[&str]) -> (String, String) {
    let output = ridgewatch(folder, arguments);
    let [out, said] = [&output.stdout, &output.stderr].map(|bytes| String::from_utf8_lossy(bytes).into_owned());
    assert!(output.status.success(), "{arguments:?}: {said}");
    (out, said)
}

fn config(name: &str) -> String {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("configs").join(name).display().to_string()
}

fn json(path: &Path) -> serde_json::Value {
    serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap()
}

fn records(run: &Path) -> Vec<FrameRecord> {
    std::fs::read_to_string(run.join("records.jsonl")).unwrap().lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

const SMALL: [&str; 6] = ["--set", "render.width=32", "--set", "render.height=16", "--set", "render.samples=1"];
/// `configs/globe.toml` at a size for tests.
const GLOBE: [&str; 4] = ["--set", "archive.synthetic.nodes=[24, 13, 6]", "--set", "archive.synthetic.snapshots=4"];
const TWO_DAYS: [&str; 2] = ["--set", "time.tau=2 days"];

/// Four days over a plane of 2000 km by 1000 km with these velocities (m/s) at x and y in [0, 1].
fn winds(folder: &Path, velocity: fn(f64, f64) -> [f64; 2]) -> PathBuf {
    let (nt, ny, nx) = (4, 11, 21);
    let component = |c: usize| f32s(fill(nt, ny, nx, move |_, y, x| velocity(x as f64 / 20.0, y as f64 / 10.0)[c]));
    let metres = |n: usize| (0..n).map(|i| 1e5 * i as f64).collect::<Vec<_>>();
    Fixture::new(NETCDF4, &[("time", nt), ("y", ny), ("x", nx)])
        .axis("x", "m", &metres(nx))
        .axis("y", "m", &metres(ny))
        .axis("time", "days since 2000-01-01", &[0.0, 1.0, 2.0, 3.0])
        .variable("u", &["time", "y", "x"], component(0))
        .with("units", "m/s")
        .variable("v", &["time", "y", "x"], component(1))
        .with("units", "m/s")
        .write(&folder.join("winds.nc"))
}

#[test]
fn a_globe_has_cells_and_entries_along_its_longitudes_and_says_that_it_is_made_up() {
    let folder = tempfile::tempdir().unwrap();
    let settings = NetworkSettings { log2_table: 12, ..NetworkSettings::default() };
    let set = ["--set", "network.log2_table=12", "--set", "surrogate.kind=network", "--set", "training.steps_per_frame=1"];
    let scene = config("globe.toml");
    let run = ["replay", &scene, "--set", "time.slides=1", "--out", "run"];
    let (_, said) = succeeds(folder.path(), &[&run[..], &GLOBE, &TWO_DAYS, &SMALL, &set].concat());
    assert!(said.contains("the velocities are synthetic turbulence, seed 0"), "{said}");
    assert!(!said.contains('\u{1b}'), "no colours for a file: {said:?}");
    let (summary, records) = (json(&folder.path().join("run/summary.json")), records(&folder.path().join("run")));
    assert!(records[0].source.starts_with("synthetic turbulence, seed 0") && records[0].source.contains("NetCDF"), "{}", records[0].source);
    assert_eq!((summary["run"]["source"].as_str().unwrap(), records[0].time_unit.as_str()), (records[0].source.as_str(), "s"));
    // 360 by 180 degrees, and heights that count as a quarter of the longer edge.
    let shape = Architecture::new(&settings, &[0, 1, 2], [360.0, 180.0, 90.0]).unwrap();
    assert_eq!(summary["run"]["surrogate_bytes"].as_u64(), Some(4 * shape.parameters() as u64));

    // The files say it too, whoever reads them.
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
    let file = winds(folder.path(), |x, y| [20.0 * (6.0 * y).sin(), 20.0 * (6.0 * x).cos()]).display().to_string();
    for (set, unit, counted_from) in [
        (&["--set", "archive.metric=cartesian", "--set", "time.tau=2 days"][..], "s", "s since 1970-01-01"),
        (&["--set", "archive.metric=index", "--set", "time.tau=2"], "snapshots", "snapshots"),
    ] {
        let (out, said) = succeeds(folder.path(), &[&["ftle", &file, "--grid", "9x5", "-o", "field.nc"][..], set].concat());
        assert!(out.contains(&format!(" {unit}: tangent")) && said.contains("from that of twice as many"), "{out}{said}");
        let field = netcdf::open(folder.path().join("field.nc")).unwrap();
        let text = |attribute: Option<netcdf::Attribute>| match attribute.unwrap().value().unwrap() {
            netcdf::AttributeValue::Str(text) => text,
            other => panic!("{other:?}"),
        };
        assert_eq!(text(field.variable("ftle").unwrap().attribute("units")), format!("{unit}-1"));
        assert_eq!((text(field.attribute("tau_units")), text(field.attribute("seed_time_units"))), (unit.into(), counted_from.into()));
        assert!(field.attribute("integration_difference").is_some(), "how right it is goes with it");
    }
}

#[test]
fn colours_are_told_and_what_has_none_is_warned_of() {
    let folder = tempfile::tempdir().unwrap();
    let colours = "colours from FTLE ";
    let file = winds(folder.path(), |x, y| [20.0 * (6.0 * y).sin(), 20.0 * (6.0 * x).cos()]).display().to_string();
    let (_, said) = succeeds(folder.path(), &[&["replay", &file, "--out", "run"][..], &TWO_DAYS, &SMALL].concat());
    assert!(said.contains(colours) && said.contains(" /s (") && !said.contains("FTLE is uniform"), "{said}");
    let (summary, records) = (json(&folder.path().join("run/summary.json")), records(&folder.path().join("run")));
    let transfer = records[0].transfer;
    assert!(transfer.low < transfer.high && transfer.extinction > 0.0, "{transfer:?}");
    assert_eq!(summary["run"]["transfer"], serde_json::to_value(transfer).unwrap());

    let still = winds(folder.path(), |_, _| [0.0, 0.0]).display().to_string();
    let saddle = folder.path().join("saddle.toml").display().to_string();
    std::fs::write(&saddle, "[source]\nkind = \"saddle\"\n[domain]\nmin = [-1, -1, 0]\nmax = [1, 1, 0.2]\n[time]\ntau = 2\n").unwrap();
    for source in [&still, &saddle] {
        let set: &[&str] = if *source == still { &TWO_DAYS } else { &[] };
        let (_, said) =
            succeeds(folder.path(), &[&["render", source, "--out", "r.png", "--method", "reference"][..], set, &SMALL].concat());
        assert!(said.contains(colours) && said.contains("FTLE is uniform"), "{source}: {said}");
        let given = ["--set", "transfer.low=0", "--set", "transfer.high=1"];
        let (_, said) =
            succeeds(folder.path(), &[&["render", source, "--out", "r.png", "--method", "reference"][..], set, &SMALL, &given].concat());
        assert!(said.contains(" to 1.000e0") && !said.contains("FTLE is uniform"), "as set: {said}");
    }
}

#[test]
fn land_is_no_share_of_what_is_traced() {
    let folder = tempfile::tempdir().unwrap();
    let coast = |x: f64, y: f64| if x < 0.4 { [f64::NAN; 2] } else { [2.0 * (6.0 * y).sin(), 2.0 * (6.0 * x).cos()] };
    let file = winds(folder.path(), coast).display().to_string();
    let replay = ["replay", &file, "--out", "run", "--method", "reference", "--set", "time.slides=1"];
    let (out, _) = succeeds(folder.path(), &[&replay[..], &TWO_DAYS, &SMALL].concat());
    let record = &records(&folder.path().join("run"))[0];
    assert!(record.missing > 0 && record.traced_share == 1.0, "{record:?}");
    let told = format!("traced 100.0 % of {} queries, {} more on land", record.queries - record.missing, record.missing);
    assert!(out.contains(&told), "{out}");
    assert_eq!(json(&folder.path().join("run/summary.json"))["totals"]["traced_share"], 1.0);
}

#[test]
fn particles_that_do_not_live_are_told_of() {
    let folder = tempfile::tempdir().unwrap();
    // A fill value that nobody declared.
    let file = winds(folder.path(), |x, y| [1e30 * (6.0 * y).sin(), 1e30 * (6.0 * x).cos()]).display().to_string();
    let replay = ["replay", &file, "--out", "run", "--method", "reference"];
    let (out, said) = succeeds(folder.path(), &[&replay[..], &TWO_DAYS, &SMALL].concat());
    assert!(out.contains("particles live 0.0 % of tau"), "{out}");
    assert_eq!(said.matches("of tau on average").count(), 1, "once a run: {said}");
    // Those of the plain wind live.
    let file = winds(folder.path(), |_, y| [0.1 * (6.0 * y).sin(), 0.0]).display().to_string();
    let (_, said) =
        succeeds(folder.path(), &[&["replay", &file, "--out", "other", "--method", "reference"][..], &TWO_DAYS, &SMALL].concat());
    assert!(!said.contains("of tau on average"), "{said}");
}

#[test]
fn a_closed_form_is_not_published_as_another_flow() {
    let folder = tempfile::tempdir().unwrap();
    for name in ["saddle.toml", "double_gyre.toml"] {
        let output = ridgewatch(folder.path(), &["publish", &config(name), "--ring", "ring"]);
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.code() == Some(2) && said.contains("`source.kind`") && said.contains("\"turbulence\""), "{said}");
        assert!(!folder.path().join("ring").exists());
    }
}

#[test]
#[cfg(unix)]
fn lost_pictures_are_a_failure() {
    let folder = tempfile::tempdir().unwrap();
    // No file beyond 16 KiB: an EXR of 64 x 48 pixels is larger, records are not. What a full disk does, but with an error of its own.
    let replay = |more: &str| {
        let command = format!(
            "trap '' XFSZ; ulimit -f 16; exec '{}' replay '{}' --out run --overwrite --method reference --device cpu \
             --set render.width=64 --set render.height=48 --set render.samples=1 --set time.slides=2 --set time.frames_per_slide=1 --set time.warmup_frames=0 {more}",
            env!("CARGO_BIN_EXE_ridgewatch"),
            config("double_gyre.toml")
        );
        let output = Command::new("bash").args(["-c", &command]).current_dir(folder.path()).output().unwrap();
        (output.status.code(), String::from_utf8_lossy(&output.stdout).into_owned() + &String::from_utf8_lossy(&output.stderr))
    };
    let (status, said) = replay("");
    assert!(status == Some(1) && said.contains("run/frames: 0 of 2 pictures written (2 failed: File too large"), "{status:?} {said}");
    assert!(!said.contains("frames in run/frames"), "{said}");
    let (status, said) = replay("--json");
    assert!(status == Some(1) && said.contains("0 of 2 pictures written"), "{status:?} {said}");
    // Nothing was asked for that is not there.
    let (status, said) = replay("--set publish.exr=none");
    assert!(status == Some(0) && said.contains("frames in run/frames"), "{status:?} {said}");
}
