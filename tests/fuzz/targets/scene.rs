//! A scene file of any text is read or refused with a place, and a scene that is read can be written and read again.
#![no_main]

use libfuzzer_sys::fuzz_target;
use ridgewatch::config::SceneFile;
use std::path::Path;

fuzz_target!(|input: &str| {
    let path = Path::new("scene.toml");
    // The last line may be a key of the command line.
    let (text, keys) = match input.rsplit_once("\n--set ") {
        Some((text, key)) => (text, vec![key.to_owned()]),
        None => (input, Vec::new()),
    };
    match SceneFile::parse(path, text, &keys) {
        Ok(scene) => {
            if let Ok(again) = scene.to_toml() {
                SceneFile::parse(path, &again, &[]).expect("a scene that was written");
            }
        }
        Err(error) => assert!(!error.to_string().is_empty()),
    }
});
