//! The scene that a run leaves beside what it made: it reads back as what ran, from anywhere, and makes the same again.

#![allow(clippy::unwrap_used)]

use ridgewatch::config::SceneFile;
use ridgewatch::publish::read_exr;
use ridgewatch::render::Method;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

const SMALL: &str = "[source]\nkind = \"double_gyre\"\n[domain]\nmin = [0, 0, 0]\nmax = [2, 1, 0.2]\n[time]\ntau = 2\nseed_step = 0.1\nslides = 2\n\
                     [flow]\nsteps = 20\n[surrogate]\ntable_nodes = [33, 17, 2]\n[network]\nlevels = 4\nlog2_table = 12\nwidth = 16\nbatch = 512\n\
                     [training]\nseconds_per_frame = 0.1\n[render]\nwidth = 32\nheight = 16\nsamples = 2\n[publish]\nexr = \"every\"\n";

fn project(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(name)
}

/// Writes the scene into a folder of its own and reads it back.
fn read_back(scene: &SceneFile) -> SceneFile {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scene.toml");
    let text = scene.to_toml().unwrap();
    std::fs::write(&path, &text).unwrap();
    let again = SceneFile::read(&path, &[]).unwrap_or_else(|error| panic!("{error}\n{text}"));
    assert_eq!(again.to_toml().unwrap(), text, "what is written does not change any more");
    again
}

fn assert_same(mut scene: SceneFile, what: &str) {
    let again = read_back(&scene);
    // Relative to where the command runs, like all that is written.
    if let Some(synthetic) = &mut scene.archive.synthetic {
        synthetic.folder = std::path::absolute(&synthetic.folder).unwrap();
    }
    assert_eq!(again.settings(), scene.settings(), "{what}");
    assert_eq!((&again.publish, &again.device), (&scene.publish, &scene.device), "{what}");
}

#[test]
fn every_scene_reads_back_as_it_is() {
    let mut shipped: Vec<PathBuf> = std::fs::read_dir(project("configs")).unwrap().map(|entry| entry.unwrap().path()).collect();
    shipped.push(project("examples/fluidsim/live.toml"));
    assert!(shipped.len() > 10);
    for path in shipped {
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
        let source = "[source]\nkind = \"double_gyre\"\n[domain]\nmin = [0, 0, 0]\nmax = [2, 1, 1]\n[time]\ntau = 0.1\n[light]\nradiance = [1, 1, 1]\n";
        // A light has a direction or a position.
        let source = if set.iter().any(|key| key.starts_with("light")) {
            source.to_owned()
        } else {
            source.replace("[light]\nradiance = [1, 1, 1]\n", "")
        };
        let set: Vec<String> = set.iter().map(|key| (*key).to_owned()).collect();
        assert_same(SceneFile::parse(Path::new("scene.toml"), &source, &set).unwrap(), &set.join(", "));
    }
}

#[test]
fn what_an_option_makes_idle_is_left_out() {
    let parsed = |set: &[&str]| {
        let set: Vec<String> = set.iter().map(|key| (*key).to_owned()).collect();
        SceneFile::parse(Path::new("scene.toml"), SMALL, &set).unwrap()
    };
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
    let path = folder.path().join("scene.toml");
    let archive = "[source]\nkind = \"archive\"\n[archive]\nfiles = [\"a/*.nc\", \"/b.nc\"]\n[training]\nresume = \"w.safetensors\"\n";
    std::fs::write(&path, archive).unwrap();
    let again = read_back(&SceneFile::read(&path, &["training.resume=v.safetensors".to_owned()]).unwrap());
    assert_eq!(again.archive.files, [folder.path().join("a/*.nc"), "/b.nc".into()]);
    assert_eq!(again.training.resume, Some(std::env::current_dir().unwrap().join("v.safetensors")));
    std::fs::write(&path, "[source]\nkind = \"live\"\n[live]\nconnections = [\"c.json\"]\n[time]\ntau = 1\n").unwrap();
    assert_eq!(read_back(&SceneFile::read(&path, &[]).unwrap()).live.connections, [folder.path().join("c.json")]);
    std::fs::write(&path, "[source]\nkind = \"live\"\n[live]\nring = \"ring\"\n[time]\ntau = 1\n").unwrap();
    assert_eq!(read_back(&SceneFile::read(&path, &[]).unwrap()).live.ring, Some(folder.path().join("ring")));
}

#[cfg(unix)]
#[test]
fn a_name_that_no_scene_can_hold_is_named() {
    use std::os::unix::ffi::OsStrExt;
    let odd = PathBuf::from(std::ffi::OsStr::from_bytes(b"/currents/\xff.nc"));
    let said = SceneFile::for_archive(vec![odd], &[]).unwrap().to_toml().unwrap_err().to_string();
    assert!(said.contains("`archive.files`") && said.contains("\\xFF.nc") && said.contains("UTF-8"), "{said}");
}

fn ridgewatch(folder: &Path, arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_ridgewatch")).args(arguments).args(["--device", "cpu"]).current_dir(folder).output().unwrap()
}

fn succeeds(folder: &Path, arguments: &[&str]) {
    let output = ridgewatch(folder, arguments);
    assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
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
    std::fs::write(at("small.toml"), SMALL).unwrap();
    let options = ["--seed", "7", "--set", "training.steps_per_frame=20", "--set", "trust.tolerance=0.1"];
    succeeds(folder.path(), &[&["replay", "small.toml", "--out", "first"][..], &options].concat());
    std::fs::remove_file(at("small.toml")).unwrap();
    std::fs::create_dir(at("elsewhere")).unwrap();
    succeeds(&at("elsewhere"), &["replay", "../first/scene.toml", "--out", "../again"]);
    assert!(pictures(&at("first")) == pictures(&at("again")), "bit for bit");
    assert_eq!(std::fs::read(at("first/scene.toml")).unwrap(), std::fs::read(at("again/scene.toml")).unwrap());
    // The options are what makes them so.
    succeeds(folder.path(), &["replay", "first/scene.toml", "--out", "other", "--seed", "8"]);
    assert!(pictures(&at("first")) != pictures(&at("other")));
    // From the scene in the folder itself, which is replaced with the rest.
    succeeds(folder.path(), &["replay", "other/scene.toml", "--out", "other", "--overwrite", "--seed", "7"]);
    assert!(pictures(&at("first")) == pictures(&at("other")));
}

#[test]
fn one_picture_is_made_again_from_the_scene_beside_it() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("small.toml"), SMALL).unwrap();
    // More samples than the frames before it have, which train what answers.
    let options = ["--spp", "5", "--warmup", "2", "--seed", "3", "--set", "training.steps_per_frame=20"];
    succeeds(folder.path(), &[&["render", "small.toml", "--out", "a.exr"][..], &options].concat());
    succeeds(folder.path(), &["render", "a.scene.toml", "--out", "b.exr"]);
    let [a, b] = ["a.exr", "b.exr"].map(|name| picture(&folder.path().join(name)));
    assert!(a == b, "bit for bit");
    succeeds(folder.path(), &["render", "a.scene.toml", "--out", "c.exr", "--set", "time.warmup_samples=5"]);
    assert!(a != picture(&folder.path().join("c.exr")), "the frames before it count");
}

#[test]
fn a_scene_that_no_run_wrote_is_never_replaced() {
    let folder = tempfile::tempdir().unwrap();
    for name in ["scene.toml", "a.scene.toml"] {
        std::fs::write(folder.path().join(name), SMALL).unwrap();
    }
    for arguments in [
        &["replay", "scene.toml", "--out", "."][..],
        &["replay", "scene.toml", "--out", ".", "--overwrite"],
        &["render", "scene.toml", "--out", "a.png"],
    ] {
        let output = ridgewatch(folder.path(), arguments);
        let said = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.code() == Some(1) && said.contains("scene.toml: no run wrote it"), "{arguments:?}: {said}");
    }
    let mut left: Vec<_> = std::fs::read_dir(folder.path()).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    left.sort();
    assert_eq!(left, ["a.scene.toml", "scene.toml"]);
    for name in left {
        assert_eq!(std::fs::read_to_string(folder.path().join(name)).unwrap(), SMALL);
    }
    // A pipe has a writer to wait for, without end.
    let piped = folder.path().join("piped");
    std::fs::create_dir(&piped).unwrap();
    assert!(Command::new("mkfifo").arg(piped.join("scene.toml")).status().unwrap().success());
    let output = ridgewatch(folder.path(), &["replay", "scene.toml", "--out", "piped"]);
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.code() == Some(1) && said.contains("accepted: a regular file"), "{said}");
}
