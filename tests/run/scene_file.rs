//! The scene that a run leaves beside its results: it reads back as the scene that ran, from anywhere, and gives the same results again.

use crate::in_folder;
use crate::kit::program::{Outcome, project, run};
use crate::kit::scene::{self, GYRE_BOX, SMALL_NETWORK, double_gyre};
use ridgewatch::config::SceneFile;
use ridgewatch::publish::read_exr;
use ridgewatch::render::Method;
use std::path::{Path, PathBuf};
use std::process::Command;

fn small() -> String {
    let keys = "
        time.tau = 2
        time.seed_step = 0.1
        time.slides = 2
        flow.steps = 20
        surrogate.table_nodes = [33, 17, 2]
        training.seconds_per_frame = 0.1
        publish.exr = \"every\"
    ";
    double_gyre([32, 16, 2], &format!("{keys}{SMALL_NETWORK}"))
}

/// Writes the scene into a new folder and reads it back.
fn read_back(scene: &SceneFile) -> SceneFile {
    let folder = tempfile::tempdir().unwrap();
    let text = scene.to_toml().unwrap();
    let path = scene::write(folder.path(), &text);
    let again = SceneFile::read(Path::new(&path), &[]).unwrap_or_else(|error| panic!("{error}\n{text}"));
    assert_eq!(again.to_toml().unwrap(), text, "a scene that was read back is written as before");
    again
}

fn assert_same(mut scene: SceneFile, what: &str) {
    let again = read_back(&scene);
    // Relative to the folder in which the command runs, like all output.
    if let Some(synthetic) = &mut scene.archive.synthetic {
        synthetic.folder = std::path::absolute(&synthetic.folder).unwrap();
    }
    assert_eq!(again.settings(), scene.settings(), "{what}");
    assert_eq!((&again.publish, &again.device), (&scene.publish, &scene.device), "{what}");
}

/// The scenes of this repository. `chart` leaves pictures beside them.
pub fn shipped() -> Vec<PathBuf> {
    let entries = std::fs::read_dir(project("configs")).unwrap().map(|entry| entry.unwrap().path());
    let scenes = entries.filter(|path| path.extension().is_some_and(|extension| extension == "toml"));
    scenes.chain([project("examples/fluidsim/live.toml")]).collect()
}

#[test]
fn every_scene_reads_back_as_it_is() {
    assert!(shipped().len() > 10);
    for path in shipped() {
        assert_same(SceneFile::read(&path, &[]).unwrap(), &path.display().to_string());
    }
    let tau = ["time.tau=6 h".to_owned()];
    assert_same(SceneFile::for_live(&tau).unwrap(), "a simulation");
    assert_same(SceneFile::for_archive(vec!["/nowhere/[1] *.nc".into()], &[]).unwrap(), "files by name");
    for set in [
        &["surrogate.kind=network", "network.encoding=frequency", "network.target=flow_map", "network.jacobian_weight=0.3"][..],
        &["surrogate.kind=network", "network.loss=published", "network.mean_penalty=0.7", "network.inputs=[\"start\"]"],
        &[
            "surrogate.kind=table",
            "network.size=auto",
            "trust.trace_budget=0.1",
            "publish.keep_bytes=1000000",
            "publish.records_bytes=2000000",
        ],
        &[
            "flow.integrator=dormand_prince",
            "flow.precision=f64",
            "transfer.albedo=ember",
            "light.radiance=[1, 1, 1]",
            "light.position=[1, 1, 9]",
        ],
        &[
            "flow.integrator=differences",
            "flow.difference_step=1e-3",
            "flow.boundary=clamp",
            "seed=9223372036854775807",
            "title=\"two\\nlines\"",
        ],
        &["device.storage=f16_pairs", "device.memory_mib=9", "device.when_lost=stop", "render.tone_map=[1.1, 1e-300, 0.1]"],
    ] {
        // A light has a direction or a position.
        let light = if set.iter().any(|key| key.starts_with("light")) { "light.radiance = [1, 1, 1]" } else { "" };
        let source = format!("source.kind = \"double_gyre\"\ntime.tau = 0.1\n{GYRE_BOX}{light}\n");
        assert_same(scene::parse(&source, set).unwrap(), &set.join(", "));
    }
}

#[test]
fn what_an_option_makes_idle_is_left_out() {
    let parsed = |keys: &[&str]| scene::parse(&small(), keys).unwrap();
    let table = read_back(&parsed(&["surrogate.kind=table"]));
    assert_eq!((table.surrogate.table_nodes, table.network.width), (Some([33, 17, 2]), 64));
    assert_eq!(read_back(&parsed(&["surrogate.kind=network"])).surrogate.table_nodes, None);
    let mut reference = parsed(&[]);
    reference.render.method = Method::Reference;
    let again = read_back(&reference);
    assert_eq!((again.render.method, again.network.width), (Method::Reference, 16), "for another method");
}

#[test]
fn paths_are_absolute_wherever_they_were_said() {
    let folder = tempfile::tempdir().unwrap();
    let written = |text: &str, keys: &[String]| read_back(&SceneFile::read(Path::new(&scene::write(folder.path(), text)), keys).unwrap());
    let archive = "source.kind = \"archive\"\narchive.files = [\"a/*.nc\", \"/b.nc\"]\ntraining.resume = \"w.safetensors\"\nsurrogate.kind = \"residual\"\n";
    let again = written(archive, &["training.resume=v.safetensors".to_owned()]);
    assert_eq!(again.archive.files, [folder.path().join("a/*.nc"), "/b.nc".into()]);
    assert_eq!(again.training.resume, Some(std::env::current_dir().unwrap().join("v.safetensors")));
    let live = |key: &str| written(&format!("source.kind = \"live\"\ntime.tau = 1\n{key}\n"), &[]).live;
    assert_eq!(live("live.connections = [\"c.json\"]").connections, [folder.path().join("c.json")]);
    assert_eq!(live("live.ring = \"ring\"").ring, Some(folder.path().join("ring")));
}

#[cfg(unix)]
#[test]
fn a_name_that_no_scene_can_hold_is_named() {
    use std::os::unix::ffi::OsStrExt;
    let odd = PathBuf::from(std::ffi::OsStr::from_bytes(b"/currents/\xff.nc"));
    let said = SceneFile::for_archive(vec![odd], &[]).unwrap().to_toml().unwrap_err().to_string();
    assert!(said.contains("`archive.files`") && said.contains("\\xFF.nc") && said.contains("UTF-8"), "{said}");
}

fn ridgewatch(folder: &Path, arguments: &[&str]) -> Outcome {
    run(&mut in_folder(folder, arguments))
}

/// Bits of all layers and of the preview.
fn picture(exr: &Path) -> (Vec<u32>, Vec<u8>) {
    let film = read_exr(exr).unwrap();
    let mut bits: Vec<u32> = film.rgba.iter().flatten().map(|value| value.to_bits()).collect();
    bits.extend(film.ftle_mean.iter().chain(&film.traced).chain(&film.variance).map(|value| value.to_bits()));
    (bits, std::fs::read(exr.with_extension("png")).unwrap())
}

fn pictures(run: &Path) -> Vec<(Vec<u32>, Vec<u8>)> {
    (0..2).map(|n| picture(&run.join(format!("frames/frame_{n:06}.exr")))).collect()
}

#[test]
fn a_run_is_made_again_from_its_own_scene() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let succeeds = |folder: &Path, arguments: &[&str]| drop(ridgewatch(folder, arguments).success());
    std::fs::write(at("small.toml"), small()).unwrap();
    let options = ["--seed", "7", "--set", "training.steps_per_frame=20", "--set", "trust.tolerance=0.1"];
    succeeds(folder.path(), &[&["replay", "small.toml", "--out", "first"][..], &options].concat());
    std::fs::remove_file(at("small.toml")).unwrap();
    std::fs::create_dir(at("elsewhere")).unwrap();
    succeeds(&at("elsewhere"), &["replay", "../first/scene.toml", "--out", "../again"]);
    assert!(pictures(&at("first")) == pictures(&at("again")), "bit for bit");
    assert_eq!(std::fs::read(at("first/scene.toml")).unwrap(), std::fs::read(at("again/scene.toml")).unwrap());
    // The options decide the pictures.
    succeeds(folder.path(), &["replay", "first/scene.toml", "--out", "other", "--seed", "8"]);
    assert!(pictures(&at("first")) != pictures(&at("other")));
    // A run from the scene in its own folder replaces the scene with the rest.
    succeeds(folder.path(), &["replay", "other/scene.toml", "--out", "other", "--overwrite", "--seed", "7"]);
    assert!(pictures(&at("first")) == pictures(&at("other")));
}

#[test]
fn the_scene_of_a_run_has_the_integration_time_that_was_chosen() {
    let folder = tempfile::tempdir().unwrap();
    let succeeds = |arguments: &[&str]| ridgewatch(folder.path(), arguments).success();
    succeeds(&["synthesize", "flame", "--out", "flame", "--nodes", "8x8x8", "--snapshots", "6"]);
    let small = ["--set", "render.width=16", "--set", "render.height=8", "--set", "surrogate.kind=table"];
    let said = succeeds(&[&["replay", "flame", "--out", "first"][..], &small].concat()).stderr;
    let chosen = said.split("time.tau is not given: ").nth(1).and_then(|rest| rest.split(' ').next()).unwrap();
    let scene = std::fs::read_to_string(folder.path().join("first/scene.toml")).unwrap();
    let document: toml_edit::DocumentMut = scene.parse().unwrap();
    assert_eq!(document["time"]["tau"].as_float(), chosen.parse().ok(), "{scene}");
    let said = succeeds(&["replay", "first/scene.toml", "--out", "again"]).stderr;
    assert!(!said.contains("time.tau is not given"), "{said}");
    assert_eq!(scene, std::fs::read_to_string(folder.path().join("again/scene.toml")).unwrap());
    succeeds(&[&["render", "flame", "--out", "a.exr"][..], &small].concat());
    let rendered: toml_edit::DocumentMut = std::fs::read_to_string(folder.path().join("a.scene.toml")).unwrap().parse().unwrap();
    assert_eq!(rendered["time"]["tau"].as_float(), chosen.parse().ok());
}

#[test]
fn one_picture_is_made_again_from_the_scene_beside_it() {
    let folder = tempfile::tempdir().unwrap();
    let succeeds = |arguments: &[&str]| drop(ridgewatch(folder.path(), arguments).success());
    std::fs::write(folder.path().join("small.toml"), small()).unwrap();
    // More samples than the frames before it, which train the surrogate.
    let options = ["--spp", "5", "--warmup", "2", "--seed", "3", "--set", "training.steps_per_frame=20"];
    succeeds(&[&["render", "small.toml", "--out", "a.exr"][..], &options].concat());
    succeeds(&["render", "a.scene.toml", "--out", "b.exr"]);
    let [a, b] = ["a.exr", "b.exr"].map(|name| picture(&folder.path().join(name)));
    assert!(a == b, "bit for bit");
    succeeds(&["render", "a.scene.toml", "--out", "c.exr", "--set", "time.warmup_samples=5"]);
    assert!(a != picture(&folder.path().join("c.exr")), "the frames before it count");
}

#[test]
fn a_scene_that_no_run_wrote_is_never_replaced() {
    let folder = tempfile::tempdir().unwrap();
    for name in ["scene.toml", "a.scene.toml"] {
        std::fs::write(folder.path().join(name), small()).unwrap();
    }
    for arguments in [
        &["replay", "scene.toml", "--out", "."][..],
        &["replay", "scene.toml", "--out", ".", "--overwrite"],
        &["render", "scene.toml", "--out", "a.png"],
    ] {
        ridgewatch(folder.path(), arguments).refused(1, &["scene.toml: no run wrote it"]);
    }
    let mut left: Vec<_> = std::fs::read_dir(folder.path()).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    left.sort();
    assert_eq!(left, ["a.scene.toml", "scene.toml"]);
    for name in left {
        assert_eq!(std::fs::read_to_string(folder.path().join(name)).unwrap(), small());
    }
    // Reading a pipe would wait for a writer without end.
    let piped = folder.path().join("piped");
    std::fs::create_dir(&piped).unwrap();
    assert!(Command::new("mkfifo").arg(piped.join("scene.toml")).status().unwrap().success());
    ridgewatch(folder.path(), &["replay", "scene.toml", "--out", "piped"]).refused(1, &["accepted: a regular file"]);
}
