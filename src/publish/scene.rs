//! The scene of a run, beside what the run made.

use super::PublishError;
use super::run_folder::write_whole;
use std::io::{self, Read};
use std::path::Path;

/// How such a file begins: what does not is somebody else's.
const FIRST_WORDS: &str = "# Written by ridgewatch ";

/// Whether a run wrote the scene file that is there.
pub(super) fn is_ours(path: &Path) -> io::Result<bool> {
    let mut start = Vec::new();
    crate::files::open(path)?.take(FIRST_WORDS.len() as u64).read_to_end(&mut start)?;
    Ok(start == FIRST_WORDS.as_bytes())
}

/// Refuses a place at which there is a file that no run wrote: a user's own scene must not be replaced.
///
/// # Errors
/// There is one, or it cannot be read.
pub fn refuse_foreign_scene(path: &Path) -> Result<(), PublishError> {
    match is_ours(path) {
        Ok(true) => Ok(()),
        Err(error) if matches!(error.kind(), io::ErrorKind::NotFound | io::ErrorKind::NotADirectory) => Ok(()),
        Ok(false) => Err(PublishError::Scene {
            path: path.to_owned(),
            problem: "no run wrote it, and the scene of this one goes there: choose another folder or name".to_owned(),
        }),
        Err(error) => Err(PublishError::Scene { path: path.to_owned(), problem: format!("what is there cannot be read: {error}") }),
    }
}

/// Writes a scene (TOML) with the command that makes the same again from it.
///
/// # Errors
/// Those of the system.
pub fn write_scene(path: &Path, command: &str, scene: &str) -> Result<(), PublishError> {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let name = name.escape_debug();
    let version = env!("CARGO_PKG_VERSION");
    let text = format!("{FIRST_WORDS}{version}, whose next run here replaces it: `ridgewatch {command} {name}` makes this again.\n{scene}");
    let written = write_whole(path, text.as_bytes());
    written.map_err(|error| PublishError::Scene { path: path.to_owned(), problem: format!("cannot be written: {error}") })
}
