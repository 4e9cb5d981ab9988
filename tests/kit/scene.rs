//! Scenes as text, one `table.key = value` a line, and runs of them in the test's own process.

use ridgewatch::config::SceneFile;
use ridgewatch::run::{Event, Frame, RunOptions, RunReport, Setup, run};
use std::path::Path;
use std::sync::atomic::AtomicBool;

/// Domain of the double gyre.
pub const GYRE_BOX: &str = "
    domain.min = [0, 0, 0]
    domain.max = [2, 1, 0.2]
";

/// A network that a test trains within a second.
pub const SMALL_NETWORK: &str = "
    network.levels = 4
    network.log2_table = 12
    network.width = 16
    network.batch = 512
";

/// A scene of this source with pictures of this width, height and number of samples, `gated` with a network above a table unless `keys` say
/// otherwise.
pub fn scene(kind: &str, [width, height, samples]: [usize; 3], keys: &str) -> String {
    let mut text =
        format!("source.kind = \"{kind}\"\nrender.width = {width}\nrender.height = {height}\nrender.samples = {samples}\n{keys}\n");
    // Most tests are about the loop of training and trust.
    for (key, value) in [("render.method", "gated"), ("surrogate.kind", "residual")] {
        if !text.contains(key) {
            text += &format!("{key} = \"{value}\"\n");
        }
    }
    text
}

/// The double gyre in its box.
pub fn double_gyre(picture: [usize; 3], keys: &str) -> String {
    scene("double_gyre", picture, &format!("{GYRE_BOX}{keys}"))
}

/// A turbulence whose frames a surrogate answers where it is trusted. `keys` choose the surrogate and how long it is trained.
pub fn gated_turbulence(keys: &str) -> String {
    let common = "
        source.nodes = [48, 24, 24]
        time.slides = 1
        network.levels = 4
        network.features = 2
        network.log2_table = 14
        network.base_resolution = 8
        network.batch = 4096
        render.method = \"gated\"
        transfer.low = 0.1
        transfer.high = 0.3
    ";
    scene("turbulence", [48, 24, 8], &(common.to_owned() + keys))
}

/// Writes `scene.toml` into a folder; returns its path.
pub fn write(folder: &Path, text: &str) -> String {
    let path = folder.join("scene.toml");
    std::fs::write(&path, text).unwrap();
    path.display().to_string()
}

/// A scene with further keys.
pub fn parse(text: &str, keys: &[&str]) -> Result<SceneFile, ridgewatch::config::ConfigError> {
    let keys: Vec<String> = keys.iter().map(|&key| key.to_owned()).collect();
    SceneFile::parse(Path::new("scene.toml"), text, &keys)
}

/// The prepared run of a scene with further keys.
pub fn setup(text: &str, keys: &[&str]) -> Setup {
    Setup::new(parse(text, keys).unwrap().settings()).unwrap()
}

/// Runs a scene to its end; `seen` gets each frame.
pub fn run_frames(setup: Setup, options: &RunOptions, mut seen: impl FnMut(Frame) + Send) -> RunReport {
    let mut sink = |event: Event| {
        if let Event::Frame(frame) = event {
            seen(frame);
        }
    };
    run(setup, options, &mut sink, &AtomicBool::new(false)).unwrap()
}
