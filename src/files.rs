//! Opening files that a user named.

use std::fs::File;
use std::io;
use std::path::Path;

/// Opens a regular file for reading. A pipe would wait for a writer without end, and a device gives no length.
///
/// # Errors
/// Those of the system, and one for what is no regular file.
pub fn open(path: &Path) -> io::Result<File> {
    if !std::fs::metadata(path)?.is_file() {
        return Err(io::Error::new(io::ErrorKind::InvalidInput, "it is a folder, a pipe or a device; accepted: a regular file"));
    }
    File::open(path)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_and_a_device_are_no_files() {
        for path in ["/", "/dev/null"] {
            assert!(open(Path::new(path)).unwrap_err().to_string().contains("regular file"));
        }
        assert_eq!(open(Path::new("/nowhere/at/all")).unwrap_err().kind(), io::ErrorKind::NotFound);
        open(&std::env::current_exe().unwrap()).unwrap();
    }
}
