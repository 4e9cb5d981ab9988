use super::*;

const GYRE: &str = "[source]\nkind = \"double_gyre\"\n[domain]\nmin = [0, 0, 0]\nmax = [2, 1, 1]\n[time]\ntau = 10\n";

fn error(text: &str, overrides: &[&str]) -> String {
    let overrides: Vec<String> = overrides.iter().map(|s| (*s).to_owned()).collect();
    SceneFile::parse(Path::new("scene.toml"), text, &overrides).unwrap_err().to_string()
}

#[test]
fn an_unknown_key_points_at_its_line_and_names_the_nearest() {
    let said = error(&format!("{GYRE}[trust]\ntolerence = 0.1\n"), &[]);
    assert!(said.starts_with("scene.toml:9: "), "{said}");
    assert!(said.contains("Did you mean `tolerance`?"), "{said}");
    assert!(said.contains("   9 | tolerence = 0.1"), "{said}");
}

#[test]
fn a_value_out_of_range_points_at_its_line() {
    let said = error(&format!("{GYRE}[trust]\ntolerance = -1\n"), &[]);
    assert_eq!(said, "scene.toml:9: `trust.tolerance` is -1.0; accepted: a number above 0\n     9 | tolerance = -1");
}

#[test]
fn an_override_is_blamed_for_its_own_faults() {
    assert!(error(GYRE, &["trust.tolerance=-1"]).starts_with("--set trust.tolerance=-1: `trust.tolerance` is -1.0"));
    assert!(error(GYRE, &["trust.tolerence=1"]).contains("Did you mean `tolerance`?"));
    assert!(error(GYRE, &["nonsense"]).contains("accepted: table.key=value"));
    assert!(error(GYRE, &["title.x=1"]).contains("`title` is a value, not a table"));
}

#[test]
fn overrides_take_words_numbers_and_lists() {
    let set = ["flow.boundary=stop", "flow.steps=40", "domain.max=[4, 1, 1]", "time.tau=12.5"].map(str::to_owned);
    let scene = SceneFile::parse(Path::new("s"), GYRE, &set).unwrap();
    assert_eq!(scene.flow.boundary, Some(crate::flow::Boundary::Stop));
    assert_eq!(scene.flow.steps, crate::flow::StepsSetting::Fixed(40));
    assert_eq!(scene.domain.unwrap().max[0], 4.0);
    assert_eq!(scene.time.tau.unwrap().value(), Some(12.5));
}

#[test]
fn parameters_of_another_flow_are_refused() {
    let said = error(&GYRE.replace("\"double_gyre\"\n", "\"double_gyre\"\nrate = 1\n"), &[]);
    assert!(said.contains("`source.rate` does not belong to kind \"double_gyre\""), "{said}");
    assert!(error("[source]\nkind = \"saddle\"\n[time]\ntau = 1\n", &[]).contains("`domain` is missing"));
    assert!(error("[source]\nkind = \"archive\"\n", &[]).contains("`archive.files` is empty"));
}

/// A scene in which each section is there, and the line of `fault` in it.
fn with_fault(section: &str, fault: &str) -> (String, usize) {
    let mut text = String::from(GYRE);
    let heading = format!("[{section}]\n");
    if !text.contains(&heading) {
        text += &heading;
    }
    let at = text.find(&heading).unwrap() + heading.len();
    text.insert_str(at, &format!("{fault}\n"));
    let line = text[..at].lines().count() + 1;
    (text, line)
}

#[test]
fn a_fault_in_any_section_points_at_its_line() {
    let camera = "look_at = [1, 0.5, 0]\nup = [0, 1, 0]";
    for (section, fault, key, found, accepted) in [
        ("source", "epsilon = nan", "source.epsilon", "nan", "a finite number"),
        ("time", "frames_per_slide = 0", "time.frames_per_slide", "0", "from 1 to"),
        ("flow", "difference_step = 0.0", "flow.difference_step", "0", "above 0"),
        ("surrogate", "table_nodes = [1, 8, 8]", "surrogate.table_nodes", "[1, 8, 8]", "at least 2"),
        ("network", "features = 3\n[surrogate]\nkind = \"residual\"", "network.features", "3", "1, 2, 4 or 8"),
        ("network", "growth = 0.5\n[surrogate]\nkind = \"residual\"", "network.growth", "0.5", "1 to 4"),
        ("network", "loss = \"published\"\n[surrogate]\nkind = \"residual\"", "network.loss", "published", "mean_square"),
        ("training", "share = 1.0\n[surrogate]\nkind = \"residual\"", "training.share", "1", "not including, 1"),
        ("trust", "min_samples = 1", "trust.min_samples", "1", "4 to 4096"),
        ("render", "samples = 0", "render.samples", "0", "1/64 to 4096"),
        ("render", "samples = 1.5\nmethod = \"reference\"", "render.samples", "1.5", "1 to 16777216"),
        ("render", "tone_map = [1, 1, 0]", "render.tone_map", "0.0", "gamma above 0"),
        ("camera", &format!("field_of_view = 200\neye = [1, 0.5, 2]\n{camera}"), "camera.field_of_view", "200", "below 180"),
        ("light", "direction = [0, 0, 0]\nradiance = [1, 1, 1]", "light.direction", "0.0", "not zero"),
        ("transfer", "extinction = -1", "transfer.extinction", "-1", "0 or above"),
        ("transfer", "albedo = [[2.0], [0.5], [0.5]]", "transfer.albedo", "2.0", "values in [0, 1]"),
        ("publish", "keep = 0", "publish.keep", "0", "at least 1"),
        ("publish", "stall_seconds = 0", "publish.stall_seconds", "0", "0.1 to 3600"),
    ] {
        let (text, line) = with_fault(section, fault);
        let said = error(&text, &[]);
        assert!(said.starts_with(&format!("scene.toml:{line}: `{key}` ")), "{said}\n{text}");
        let excerpt = fault.lines().next().unwrap();
        assert!(said.contains(found) && said.contains(accepted) && said.ends_with(&format!("{line:>4} | {excerpt}")), "{said}");
    }
}

#[test]
fn a_fault_found_later_is_located_and_options_are_blamed_for_theirs() {
    let text = format!("{GYRE}[flow]\ndifference_step = 1e-12\nintegrator = \"differences\"\n");
    let mut scene = SceneFile::parse(Path::new("scene.toml"), &text, &[]).unwrap();
    let late = crate::flow::FlowError::OutOfRange { key: "difference_step", found: 1e-12, accepted: "more" }.refused().unwrap();
    assert!(scene.locate(late.clone()).to_string().starts_with("scene.toml:9: `flow.difference_step` is 0.000000000001; accepted: more"));
    scene.set_by("flow.difference_step", "--difference-step 1e-12");
    assert!(scene.locate(late).to_string().starts_with("--difference-step 1e-12: `flow.difference_step`"));
}

#[test]
fn paths_in_a_scene_are_relative_to_it_and_those_of_the_command_line_are_not() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scene.toml");
    std::fs::write(&path, "[source]\nkind = \"archive\"\n[archive]\nfiles = \"a.nc\"\n[training]\nresume = \"w.safetensors\"\n[surrogate]\nkind = \"residual\"\n")
        .unwrap();
    let scene = SceneFile::read(&path, &[]).unwrap();
    assert_eq!(
        (&scene.archive.files[0], scene.training.resume.as_ref().unwrap()),
        (&folder.path().join("a.nc"), &folder.path().join("w.safetensors"))
    );
    let set = ["archive.files=b.nc".to_owned(), "training.resume=v.safetensors".to_owned()];
    let scene = SceneFile::read(&path, &set).unwrap();
    assert_eq!((scene.archive.files[0].to_str(), scene.training.resume.unwrap().to_str()), (Some("b.nc"), Some("v.safetensors")));
}

/// Of the two ends of a range, the error names the one just set.
#[test]
fn of_two_keys_at_fault_together_the_one_on_the_command_line_is_named() {
    let said = error(GYRE, &["domain.min=[3, 0, 0]"]);
    assert!(said.starts_with("--set domain.min=[3, 0, 0]: `domain.max` is [2.0, 1.0, 1.0]"), "{said}");
    let said = error(GYRE, &["domain={ min = [0, 0, 0], max = [0, 1, 1] }"]);
    assert!(said.starts_with("--set domain={"), "{said}");
    let said = error(&GYRE.replace("max = [2,", "max = [0,"), &["time.tau=5"]);
    assert!(said.starts_with("scene.toml:5: `domain.max`"), "{said}");
    let transfer = format!("{GYRE}[transfer]\nlow = 0.0\nhigh = 0.2\n");
    let said = error(&transfer, &["transfer.low=0.3"]);
    assert!(said.starts_with("--set transfer.low=0.3: `transfer.high` is 0.2"), "{said}");
}

#[test]
fn values_are_shown_as_a_scene_file_writes_them() {
    assert!(error(GYRE, &["time.tau=-1"]).contains("`time.tau` is -1.0;"));
    assert!(error(GYRE, &["time.tau=soon"]).contains("`time.tau` is \"soon\";"));
    assert!(error(GYRE, &["render.majorant_cells=[0, 1, 1]"]).contains("is [0, 1, 1];"));
}

#[test]
fn an_old_key_is_refused_with_its_new_name() {
    for (old, new) in RENAMED.into_iter().filter(|(old, _)| !old.starts_with("--")) {
        assert_eq!(renamed(new), None, "{new} is the name of today");
        let (table, key) = old.split_once('.').unwrap();
        let (text, line) = with_fault(table, &format!("{key} = 1"));
        let words = format!("`{old}` has a new name; accepted: `{new}`");
        assert_eq!(error(&text, &[]), format!("scene.toml:{line}: {words}\n  {line:>4} | {key} = 1"));
        for set in [format!("{old}=1"), format!("{table}={{ {key} = 1 }}")] {
            let said = error(GYRE, &[&set]);
            assert!(said.starts_with("--set ") && said.ends_with(&words), "{said}");
        }
        // The new name is accepted; only this value is wrong.
        let said = error(&with_fault(table, &format!("{} = {{ a = 1 }}", new.split_once('.').unwrap().1)).0, &[]);
        assert!(said.contains(&format!("`{new}` is ")) && said.contains("; accepted: "), "{said}");
    }
}

#[test]
fn types_are_said_in_plain_words() {
    for (set, words) in [
        ("render.width=many", "is \"many\"; accepted: a whole number, 0 or above"),
        ("render.width=1.5", "is 1.5; accepted: a whole number, 0 or above"),
        ("render.width=-1", "is -1; accepted: a whole number, 0 or above"),
        ("trust.tolerance=low", "is \"low\"; accepted: a number"),
        ("trust.cells=[8, 8]", "is a list of 2; accepted: a list of 3"),
        ("trust.cells=8", "is 8; accepted: a list of 3"),
        ("render=3", "is 3; accepted: a table"),
        ("title=3", "is 3; accepted: a text in quotation marks"),
        ("archive.steady=1", "is 1; accepted: true or false"),
        ("time.tau=[1]", "a number, or words such as"),
    ] {
        let said = error(GYRE, &[set]);
        assert!(said.starts_with(&format!("--set {set}: ")) && said.contains(words), "{set}: {said}");
    }
    let said = error(&format!("{GYRE}[render]\nwidth = \"wide\"\n"), &[]);
    assert_eq!(said, "scene.toml:9: `render.width` is \"wide\"; accepted: a whole number, 0 or above\n     9 | width = \"wide\"");
    assert!(error("[source]\nomega = 1\n", &[]).contains("`source.kind` is missing"));
}

/// Otherwise nobody would notice the mistake.
#[test]
fn keys_that_do_nothing_are_refused_where_they_stand() {
    for (section, line, key) in [
        ("archive", "w = \"none\"", "archive.w"),
        ("archive.synthetic", "shape = \"flame\"", "archive.synthetic.shape"),
        ("live", "at_end = \"stop\"", "live.at_end"),
        ("time", "every = 2", "time.every"),
        ("time", "snapshots_per_slide = 2", "time.snapshots_per_slide"),
        ("flow", "difference_step = 1e-3", "flow.difference_step"),
        ("flow", "tolerance = 0.1\nsteps = 9", "flow.tolerance"),
        ("flow", "steps = 9\nintegrator = \"dormand_prince\"\nprecision = \"f64\"", "flow.steps"),
        ("flow", "interpolation = \"cubic\"", "flow.interpolation"),
        ("surrogate", "table_nodes = [8, 8, 8]\nkind = \"network\"", "surrogate.table_nodes"),
        ("surrogate", "refine = true\ntable_nodes = [8, 8, 8]", "surrogate.refine"),
        ("network", "width = 32\n[surrogate]\nkind = \"table\"", "network.width"),
        ("training", "steps_per_frame = 9\n[surrogate]\nkind = \"table\"", "training.steps_per_frame"),
        ("training", "seconds_per_frame = 0.1\nsteps_per_frame = 9\n[surrogate]\nkind = \"residual\"", "training.seconds_per_frame"),
        ("network", "growth = 2.0\nencoding = \"frequency\"\n[surrogate]\nkind = \"residual\"", "network.growth"),
        ("network", "octaves = 8\n[surrogate]\nkind = \"residual\"", "network.octaves"),
        ("network", "mean_penalty = 0.5\n[surrogate]\nkind = \"residual\"", "network.mean_penalty"),
        ("network", "jacobian_weight = 0.5\n[surrogate]\nkind = \"residual\"", "network.jacobian_weight"),
    ] {
        let (text, at) = with_fault(section, line);
        let said = error(&text, &[]);
        assert!(said.starts_with(&format!("scene.toml:{at}: `{key}` does nothing here; accepted: ")), "{said}");
    }
    let archive = "[source]\nkind = \"archive\"\n[archive]\nfiles = \"a.nc\"\n[time]\n";
    for line in ["start = 1.0", "seed_step = 2.0"] {
        let said = error(&format!("{archive}{line}\n"), &[]);
        assert!(said.starts_with("scene.toml:6: `time.s") && said.contains("only with closed forms"), "{said}");
    }
    assert!(
        error(GYRE, &["flow.difference_step=1e-3"])
            .starts_with("--set flow.difference_step=1e-3: `flow.difference_step` does nothing here")
    );
    assert!(error(GYRE, &["time.seed_step=0", "time.slides=2"]).starts_with("--set time.slides=2: `time.seed_step` is 0"));
    // An option that leaves a part of the file without effect is no fault of the file.
    let text = format!("{GYRE}[surrogate]\ntable_nodes = [8, 8, 8]\n");
    let parsed = |text: &str, set: &str| SceneFile::parse(Path::new("s"), text, &[set.to_owned()]);
    assert!(parsed(&text, "surrogate.kind=network").is_ok());
    // One that gives a part effect mends it.
    let text = format!("{GYRE}[surrogate]\nkind = \"table\"\n[training]\nsteps_per_frame = 9\n");
    assert!(parsed(&text, "surrogate.kind=residual").is_ok() && parsed(&text, "surrogate.table_nodes=[8, 8, 8]").is_err());
    // Options change the method.
    let network = format!("{GYRE}[network]\nwidth = 32\n[surrogate]\nkind = \"residual\"\n");
    assert!(parsed(&network, "render.method=reference").is_ok());
    let files = "[source]\nkind = \"archive\"\n[archive]\nfiles = \"a.nc\"\n[archive.synthetic]\nshape = \"flame\"\n";
    let said = error(files, &[]);
    assert!(said.starts_with("scene.toml:6: `archive.synthetic.shape` does nothing here; accepted: only without archive.files"), "{said}");
}

#[test]
fn a_name_cut_short_is_recognised() {
    assert!(error(GYRE, &["trust.tol=0.1"]).contains("Did you mean `tolerance`?"));
    assert!(error(GYRE, &["render.samples_per_pixel=4"]).contains("Did you mean `samples`?"));
    assert!(!error(GYRE, &["trust.banana=0.1"]).contains("Did you mean"));
}

#[test]
fn a_live_run_neither_waits_for_the_disk_nor_fills_it_by_default() {
    use crate::publish::WhenDiskSlow::{Drop, Wait};
    let told = |overrides: &[&str]| {
        let overrides: Vec<String> = overrides.iter().chain(&["time.tau=1"]).map(|s| (*s).to_owned()).collect();
        let publish = SceneFile::for_live(&overrides).unwrap().publish_settings();
        (publish.keep, publish.keep_bytes, publish.records_bytes, publish.when_disk_slow)
    };
    let gib = Some(1 << 30);
    assert_eq!(told(&[]), (Some(100), None, gib, Some(Drop)));
    assert_eq!(told(&["publish.keep=7", "publish.when_disk_slow=wait"]), (Some(7), None, gib, Some(Wait)));
    assert_eq!(told(&["publish.keep_bytes=1000000"]), (None, Some(1_000_000), gib, Some(Drop)));
    assert_eq!(told(&["publish.records_bytes=2000000"]), (Some(100), None, Some(2_000_000), Some(Drop)));
    let replayed = SceneFile::parse(Path::new("scene.toml"), GYRE, &[]).unwrap();
    assert_eq!(replayed.publish_settings(), replayed.publish);
}
