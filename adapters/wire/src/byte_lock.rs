//! Open file description locks over single bytes of a file.
//!
//! libc, because rustix has process-owned record locks and whole-file locks alone: a process-owned lock ends when the process closes any descriptor of the
//! file, and a whole-file lock has no bytes.

use rustix::io::Errno;
use std::fs::File;
use std::io;
use std::os::fd::AsRawFd;

/// Kind of a lock.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Kind {
    Shared = libc::F_RDLCK as isize,
    Exclusive = libc::F_WRLCK as isize,
}

fn record(kind: libc::c_int, start: u32, length: libc::off_t) -> libc::flock {
    // SAFETY: all fields are integers.
    let mut lock: libc::flock = unsafe { std::mem::zeroed() };
    lock.l_type = kind as libc::c_short;
    lock.l_whence = libc::SEEK_SET as libc::c_short;
    (lock.l_start, lock.l_len) = (start.into(), length);
    lock
}

fn control(file: &File, command: libc::c_int, lock: &mut libc::flock) -> io::Result<()> {
    // SAFETY: the descriptor is open, and the lock outlives the call.
    if unsafe { libc::fcntl(file.as_raw_fd(), command, lock) } == 0 { Ok(()) } else { Err(io::Error::last_os_error()) }
}

/// Locks one byte, which the file need not have. Returns false if another lock conflicts.
pub(crate) fn try_lock(file: &File, kind: Kind, byte: u32) -> io::Result<bool> {
    match control(file, libc::F_OFD_SETLK, &mut record(kind as libc::c_int, byte, 1)) {
        Err(error) if matches!(Errno::from_io_error(&error), Some(Errno::AGAIN | Errno::ACCESS)) => Ok(false),
        locked => locked.map(|()| true),
    }
}

/// Releases the locks of all bytes.
pub(crate) fn unlock_all(file: &File) {
    let _ = control(file, libc::F_OFD_SETLK, &mut record(libc::F_UNLCK, 0, 0));
}

/// Kind of another's lock of byte 0 that conflicts with `kind`; `None` if there is no such lock.
pub(crate) fn conflict(file: &File, kind: Kind) -> io::Result<Option<Kind>> {
    let mut lock = record(kind as libc::c_int, 0, 1);
    control(file, libc::F_OFD_GETLK, &mut lock)?;
    Ok(match libc::c_int::from(lock.l_type) {
        libc::F_UNLCK => None,
        libc::F_RDLCK => Some(Kind::Shared),
        _ => Some(Kind::Exclusive),
    })
}
