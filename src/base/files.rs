//! Files: opened only if regular, written under their names only when whole.

use crate::folder::Folder;
use std::fs::{self, File};
use std::io::{self, ErrorKind, Write as _};
use std::path::Path;

/// Opens a regular file for reading. A pipe could wait for a writer forever, and a device has no length.
///
/// # Errors
/// Errors of the system; `InvalidInput` if the file is not regular.
pub fn open(path: &Path) -> io::Result<File> {
    if !fs::metadata(path)?.is_file() {
        return Err(io::Error::new(ErrorKind::InvalidInput, "it is a folder, a pipe or a device; accepted: a regular file"));
    }
    File::open(path)
}

/// Writes a file beside its place and renames it, so that an unfinished file never has the final name. No link is followed.
///
/// # Errors
/// Errors of the system; then the place is unchanged.
pub fn write_whole(path: &Path, bytes: &[u8]) -> io::Result<()> {
    write_with(path, |file| file.write_all(bytes))
}

/// As [`write_whole`], with what `write` puts into the new file.
///
/// # Errors
/// Errors of the system and of `write`; then the place is unchanged.
pub fn write_with(path: &Path, write: impl FnOnce(&mut File) -> io::Result<()>) -> io::Result<()> {
    let name = path.file_name().ok_or_else(|| io::Error::new(ErrorKind::InvalidInput, "no file name"))?;
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    Folder::open(folder)?.write_with(name, write)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_regular_files_are_opened() {
        for path in ["/", "/dev/null"] {
            assert!(open(Path::new(path)).unwrap_err().to_string().contains("regular file"));
        }
        assert_eq!(open(Path::new("/nowhere/at/all")).unwrap_err().kind(), ErrorKind::NotFound);
        open(&std::env::current_exe().unwrap()).unwrap();
    }
}
