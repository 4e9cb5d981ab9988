//! The scene file that a run leaves beside its results.

use super::error::PublishError;
use crate::files::write_whole;
use std::io::{self, Read};
use std::path::Path;

/// First words of every such file, which tell it from a user's own scene.
const FIRST_WORDS: &str = "# Written by ridgewatch ";

/// Whether a run wrote the scene file at `path`.
pub(super) fn is_ours(path: &Path) -> io::Result<bool> {
    let mut start = Vec::new();
    crate::files::open(path)?.take(FIRST_WORDS.len() as u64).read_to_end(&mut start)?;
    Ok(start == FIRST_WORDS.as_bytes())
}

/// Refuses to replace a scene file that no run wrote.
///
/// # Errors
/// Such a file exists, or the file cannot be read.
pub fn refuse_foreign_scene(path: &Path) -> Result<(), PublishError> {
    match is_ours(path) {
        Ok(true) => Ok(()),
        Err(error) if matches!(error.kind(), io::ErrorKind::NotFound | io::ErrorKind::NotADirectory) => Ok(()),
        Ok(false) => Err(PublishError::File {
            path: path.to_owned(),
            problem: "no run wrote it, so it is not replaced by the scene of this run: choose another folder or name".to_owned(),
        }),
        Err(error) => Err(PublishError::File { path: path.to_owned(), problem: format!("cannot be read: {error}") }),
    }
}

/// Text of a scene file of this name.
pub(super) fn text_of(name: &str, command: &str, scene: &str) -> String {
    let (name, version) = (name.escape_debug(), env!("CARGO_PKG_VERSION"));
    format!("{FIRST_WORDS}{version}, whose next run here replaces it: `ridgewatch {command} {name}` makes this again.\n{scene}")
}

/// Writes a scene (TOML), with the command that repeats the run in its first line.
///
/// # Errors
/// Errors of the system.
pub fn write_scene(path: &Path, command: &str, scene: &str) -> Result<(), PublishError> {
    let text = text_of(&path.file_name().unwrap_or_default().to_string_lossy(), command, scene);
    let failed = |error| PublishError::File { path: path.to_owned(), problem: format!("cannot be written: {error}") };
    write_whole(path, text.as_bytes()).map_err(failed)
}
