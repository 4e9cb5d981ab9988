//! Files and folders that belong to this user alone.

use crate::{WireError, system};
use rustix::fs::OFlags;
use rustix::io::Errno;
use std::fs::{DirBuilder, File, Metadata, OpenOptions};
use std::io;
use std::os::unix::fs::{DirBuilderExt, MetadataExt, OpenOptionsExt};
use std::path::Path;

/// The system's root, as user namespaces (containers) show it: the owner of their /dev/shm.
const NOBODY: u32 = 65534;

/// Creates a file with mode 0600, or opens it if it exists and `exclusive` is false.
pub(crate) fn create_private(path: &Path, exclusive: bool) -> io::Result<File> {
    let mut options = OpenOptions::new();
    options.read(true).write(true).create(true).truncate(false).mode(0o600).custom_flags(OFlags::NOFOLLOW.bits() as i32);
    if exclusive {
        options.create_new(true);
    }
    options.open(path)
}

/// Opens a file of this user that nobody else may open.
///
/// # Errors
/// `Foreign`: the path is a symbolic link or no regular file, or another user owns it or has rights to it.
pub(crate) fn open_private(path: &Path, write: bool) -> Result<File, WireError> {
    // O_NONBLOCK: opening a pipe would otherwise block until its other end is opened.
    let flags = OFlags::NOFOLLOW | OFlags::NONBLOCK;
    let opened = OpenOptions::new().read(true).write(write).custom_flags(flags.bits() as i32).open(path);
    let file = opened.map_err(|e| refused(path, "cannot be opened", e))?;
    check_private(path, &metadata(path, file.metadata())?)?;
    Ok(file)
}

/// Error of a file that the system did not open or create.
pub(crate) fn refused(path: &Path, action: &'static str, error: io::Error) -> WireError {
    match Errno::from_io_error(&error) {
        Some(Errno::LOOP) => foreign(path, "is a symbolic link".into()),
        // In a sticky folder of another user the system itself may refuse.
        Some(Errno::ACCESS | Errno::PERM) => foreign(path, "may not be opened by this user".into()),
        _ => WireError::io(path, action, error),
    }
}

/// Returns true if a path still names this file: nobody removed or replaced it.
pub(crate) fn names(path: &Path, file: &File) -> io::Result<bool> {
    let about = file.metadata()?;
    match std::fs::symlink_metadata(path) {
        Ok(now) => Ok((now.dev(), now.ino()) == (about.dev(), about.ino())),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(false),
        Err(error) => Err(error),
    }
}

/// Removes a file if the path still names it.
pub(crate) fn remove_own(path: &Path, file: &File) {
    if names(path, file).unwrap_or(false) {
        let _ = std::fs::remove_file(path);
    }
}

/// Adds the path to an error of `stat`.
pub(crate) fn metadata(path: &Path, found: io::Result<Metadata>) -> Result<Metadata, WireError> {
    found.map_err(|e| WireError::io(path, "cannot be examined", e))
}

/// Checks that a file is regular and belongs to this user alone.
pub(crate) fn check_private(path: &Path, about: &Metadata) -> Result<(), WireError> {
    if !about.is_file() {
        return Err(foreign(path, "is no regular file".into()));
    }
    if about.uid() != system::user() {
        return Err(foreign(path, format!("belongs to user {}", about.uid())));
    }
    if about.mode() & 0o077 != 0 {
        return Err(foreign(path, format!("has mode {:04o}", about.mode() & 0o7777)));
    }
    Ok(())
}

fn foreign(path: &Path, found: String) -> WireError {
    WireError::Foreign { path: path.to_owned(), found, user: system::user() }
}

/// Creates the ring's folder if it does not exist.
///
/// # Errors
/// `ForeignFolder`: others may write into the folder, or may replace it.
pub(crate) fn make_folder(ring: &Path) -> Result<(), WireError> {
    if let Err(error) = DirBuilder::new().mode(0o700).recursive(true).create(ring) {
        // The cause may be another user, who has made the folder's parent first and lets nobody in.
        return match check_parent(ring) {
            Err(foreign @ WireError::ForeignFolder { .. }) => Err(foreign),
            _ => Err(WireError::io(ring, "cannot be created", error)),
        };
    }
    check_folder(ring)
}

/// Checks that a ring's folder is one, and that nobody else may write into it or replace it.
///
/// # Errors
/// `ForeignFolder`: others may. The folder cannot be examined, for instance because it does not exist.
pub(crate) fn check_folder(ring: &Path) -> Result<(), WireError> {
    check_parent(ring)?;
    let about = metadata(ring, std::fs::symlink_metadata(ring))?;
    let found = if !about.is_dir() {
        "is no folder".to_owned()
    } else if about.uid() != system::user() {
        format!("belongs to user {}", about.uid())
    } else if about.mode() & 0o022 != 0 {
        format!("is a folder that others may write into (mode {:04o})", about.mode() & 0o7777)
    } else {
        return Ok(());
    };
    Err(WireError::ForeignFolder { path: ring.to_owned(), found, user: system::user() })
}

/// Checks that nobody else may replace a ring's folder.
fn check_parent(ring: &Path) -> Result<(), WireError> {
    let Some(parent) = ring.parent().map(|parent| if parent.as_os_str().is_empty() { Path::new(".") } else { parent }) else {
        return Ok(());
    };
    let about = metadata(parent, std::fs::metadata(parent))?;
    // Nobody may rename folders of others in a sticky folder, except its owner.
    let sticky = about.mode() & 0o1000 != 0;
    let found = if ![0, system::user()].contains(&about.uid()) && !(sticky && about.uid() == NOBODY) {
        format!("is a folder of user {}, who may replace {}", about.uid(), ring.display())
    } else if !sticky && about.mode() & 0o002 != 0 {
        format!("is a folder that all users may write into (mode {:04o})", about.mode() & 0o7777)
    } else {
        return Ok(());
    };
    Err(WireError::ForeignFolder { path: parent.to_owned(), found, user: system::user() })
}
