//! What is asked of the system: files that nobody else may open, memory that is there before it is written, clocks, random numbers.

use crate::WireError;
use std::fs::{File, Metadata, OpenOptions};
use std::io;
use std::os::fd::AsRawFd;
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::Path;
#[cfg(feature = "messages")]
use std::time::Duration;
use std::time::{SystemTime, UNIX_EPOCH};

/// The user that this process acts as.
pub(crate) fn user() -> u32 {
    // SAFETY: takes and touches nothing.
    unsafe { libc::geteuid() }
}

/// Nanoseconds since 1970.
pub(crate) fn since_1970() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_nanos() as u64)
}

/// Nanoseconds of the clock that never goes back, common to all processes of the node.
pub(crate) fn monotonic() -> u64 {
    let mut time = libc::timespec { tv_sec: 0, tv_nsec: 0 };
    // SAFETY: `time` outlives the call.
    unsafe { libc::clock_gettime(libc::CLOCK_MONOTONIC, &mut time) };
    (time.tv_sec as u64).wrapping_mul(1_000_000_000).wrapping_add(time.tv_nsec as u64)
}

/// Random bytes.
pub(crate) fn random<const N: usize>() -> io::Result<[u8; N]> {
    let mut bytes = [0; N];
    let mut filled = 0;
    while filled < N {
        // SAFETY: the pointer and the length are those of what is left of `bytes`.
        let got = unsafe { libc::getrandom(bytes[filled..].as_mut_ptr().cast(), N - filled, 0) };
        match got {
            got if got > 0 => filled += got as usize,
            _ => match io::Error::last_os_error() {
                error if error.kind() == io::ErrorKind::Interrupted => {}
                error => return Err(error),
            },
        }
    }
    Ok(bytes)
}

/// Whether something can be read, its end too, within a limit (in whole milliseconds).
#[cfg(feature = "messages")]
pub(crate) fn readable(from: &impl AsRawFd, limit: Duration) -> io::Result<bool> {
    let mut what = libc::pollfd { fd: from.as_raw_fd(), events: libc::POLLIN, revents: 0 };
    // SAFETY: one entry, which outlives the call.
    match unsafe { libc::poll(&mut what, 1, limit.as_millis() as libc::c_int) } {
        -1 => match io::Error::last_os_error() {
            error if error.kind() == io::ErrorKind::Interrupted => Ok(false),
            error => Err(error),
        },
        found => Ok(found > 0),
    }
}

/// Makes a file that only this user may open.
pub(crate) fn create_private(path: &Path, exclusive: bool) -> io::Result<File> {
    let mut options = OpenOptions::new();
    options.read(true).write(true).create(true).mode(0o600).custom_flags(libc::O_NOFOLLOW | libc::O_CLOEXEC);
    if exclusive {
        options.create_new(true);
    }
    options.truncate(false).open(path)
}

/// Opens a file of this user that nobody else may open.
///
/// # Errors
/// It is a link, no regular file, another user's, or others have rights to it.
pub(crate) fn open_private(path: &Path, write: bool) -> Result<File, WireError> {
    let mut options = OpenOptions::new();
    // Without O_NONBLOCK a pipe in its place would wait for its other end.
    options.read(true).write(write).custom_flags(libc::O_NOFOLLOW | libc::O_CLOEXEC | libc::O_NONBLOCK);
    let file = options.open(path).map_err(|e| match e.raw_os_error() {
        Some(libc::ELOOP) => foreign(path, "is a symbolic link".into()),
        // Under a sticky, foreign folder the system itself may refuse.
        Some(libc::EACCES | libc::EPERM) => foreign(path, "may not be opened by this user".into()),
        _ => WireError::io(path, "cannot be opened", e),
    })?;
    let about = file.metadata().map_err(|e| WireError::io(path, "cannot be looked at", e))?;
    check_private(path, &about, user())?;
    Ok(file)
}

/// Whether a file is this user's alone.
pub(crate) fn check_private(path: &Path, about: &Metadata, user: u32) -> Result<(), WireError> {
    if !about.is_file() {
        return Err(foreign(path, "is no regular file".into()));
    }
    if about.uid() != user {
        return Err(foreign(path, format!("belongs to user {}", about.uid())));
    }
    if about.mode() & 0o077 != 0 {
        return Err(foreign(path, format!("has mode {:04o}", about.mode() & 0o7777)));
    }
    Ok(())
}

pub(crate) fn foreign(path: &Path, found: String) -> WireError {
    WireError::Foreign { path: path.to_owned(), found, user: user() }
}

/// Bytes of the longest file that this process may make.
fn file_size_limit() -> io::Result<u64> {
    let mut limit = libc::rlimit { rlim_cur: 0, rlim_max: 0 };
    // SAFETY: `limit` outlives the call.
    match unsafe { libc::getrlimit(libc::RLIMIT_FSIZE, &mut limit) } {
        0 => Ok(limit.rlim_cur),
        _ => Err(io::Error::last_os_error()),
    }
}

/// Signals that may interrupt the reservation of one piece; after some thirty a piece is a page.
const INTERRUPTIONS: u32 = 1000;

/// Reserves bytes 0 to `end` by calls of `allocate(from, bytes)`, whose status is returned. At once where the system can, so that it refuses what does not fit
/// before it has taken anything; in smaller and smaller pieces where signals come, since older Linux undoes a call into which any signal falls: beside a timer
/// that is faster than the call (a profiler's) the same call would be tried without end.
fn reserve(end: libc::off_t, mut allocate: impl FnMut(libc::off_t, libc::off_t) -> libc::c_int) -> libc::c_int {
    let (mut from, mut piece, mut interruptions) = (0, end, 0);
    while from < end {
        let bytes = piece.min(end - from);
        match allocate(from, bytes) {
            0 => (from, interruptions) = (from + bytes, 0),
            libc::EINTR if interruptions < INTERRUPTIONS => (piece, interruptions) = ((piece / 2).max(4096), interruptions + 1),
            code => return code,
        }
    }
    0
}

/// Whether a file is in memory. A mapping of one on a disk or a server would make who writes into it wait for its pages to be written back, or end the
/// process where they cannot be.
fn check_in_memory(file: &File, path: &Path) -> Result<(), WireError> {
    // SAFETY: all of its fields are integers.
    let mut about: libc::statfs = unsafe { std::mem::zeroed() };
    // SAFETY: the descriptor is open, and `about` outlives the call.
    if unsafe { libc::fstatfs(file.as_raw_fd(), &mut about) } != 0 {
        return Err(WireError::io(path, "its file system cannot be looked at", io::Error::last_os_error()));
    }
    // Of 32 bits, whatever the sign that the system's type gives them.
    match about.f_type as u32 {
        TMPFS | RAMFS => Ok(()),
        found => Err(WireError::NotInMemory { path: path.to_owned(), found: u64::from(found) }),
    }
}

/// Types of file systems as linux/magic.h has them.
const TMPFS: u32 = 0x0102_1994;
const RAMFS: u32 = 0x8584_58f6;

/// Bytes that a file could take at most if these were freed besides: what the file system has left for this user, and what the file has already.
pub(crate) fn room_with(file: &File, freed: u64) -> io::Result<u64> {
    // SAFETY: all of its fields are integers.
    let mut about: libc::statvfs = unsafe { std::mem::zeroed() };
    // SAFETY: the descriptor is open, and `about` outlives the call.
    if unsafe { libc::fstatvfs(file.as_raw_fd(), &mut about) } != 0 {
        return Err(io::Error::last_os_error());
    }
    Ok(about.f_bavail.saturating_mul(about.f_frsize).saturating_add(taken(&file.metadata()?)).saturating_add(freed))
}

/// Bytes of the file system that a file has.
pub(crate) fn taken(about: &Metadata) -> u64 {
    about.blocks() * 512
}

/// A file mapped for reading and writing, all its pages there.
#[derive(Debug)]
pub(crate) struct Map {
    start: *mut u8,
    length: usize,
}

// SAFETY: the mapping belongs to this value alone and no thread's state hangs on it.
unsafe impl Send for Map {}
// SAFETY: the callers of `start` say who writes where.
unsafe impl Sync for Map {}

impl Map {
    /// Gives the file `length` bytes, all of them backed by memory, and maps it. Where the file system or the user's share of it is full, `make_room` is
    /// asked, each time that it is so, until it says that there is nothing to be done.
    ///
    /// # Errors
    /// `NotInMemory`: the file lies on a disk or a server. `NoSpace`: there is no room. Never leaves pages that could fail when they are written.
    pub fn create(file: &File, path: &Path, length: u64, mut make_room: impl FnMut() -> bool) -> Result<Self, WireError> {
        check_in_memory(file, path)?;
        let no_space = || WireError::NoSpace { path: path.to_owned(), needed: length };
        let most = file_size_limit().map_err(|e| WireError::io(path, "no limit of its length can be had", e))?;
        if length > most {
            // The system would end the process by SIGXFSZ.
            return Err(WireError::FileSize { path: path.to_owned(), needed: length, limit: most });
        }
        let size = libc::off_t::try_from(length).ok().zip(usize::try_from(length).ok());
        let (end, length) = size.ok_or_else(no_space)?;
        let status = loop {
            // SAFETY: the descriptor is open. Unlike `ftruncate`, this reserves: a full file system answers here and not by SIGBUS later.
            match reserve(end, |from, bytes| unsafe { libc::posix_fallocate(file.as_raw_fd(), from, bytes) }) {
                libc::ENOSPC | libc::EDQUOT if make_room() => {}
                status => break status,
            }
        };
        match status {
            0 => {}
            libc::ENOSPC | libc::EFBIG | libc::ENOMEM | libc::EDQUOT => return Err(no_space()),
            code => return Err(WireError::io(path, "room cannot be reserved", io::Error::from_raw_os_error(code))),
        }
        let (rights, flags) = (libc::PROT_READ | libc::PROT_WRITE, libc::MAP_SHARED | libc::MAP_POPULATE);
        // SAFETY: a new mapping of an open file; the address is the system's choice.
        let start = unsafe { libc::mmap(std::ptr::null_mut(), length, rights, flags, file.as_raw_fd(), 0) };
        if start == libc::MAP_FAILED {
            return Err(WireError::io(path, "cannot be mapped", io::Error::last_os_error()));
        }
        let map = Self { start: start.cast(), length };
        // MAP_POPULATE maps for reading; a write to every page makes it this process's before the first step.
        for page in (0..length).step_by(4096) {
            // SAFETY: inside the mapping, which nobody else has seen yet.
            unsafe { map.start.add(page).write_volatile(0) };
        }
        Ok(map)
    }

    pub fn start(&self) -> *mut u8 {
        self.start
    }

    pub fn len(&self) -> usize {
        self.length
    }
}

impl Drop for Map {
    fn drop(&mut self) {
        // SAFETY: mapped by `create` and unmapped only here.
        unsafe { libc::munmap(self.start.cast(), self.length) };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn room_is_reserved_whole_although_a_timer_interrupts() {
        // A signal each 300 pages, and a system that undoes the call into which it falls.
        let (mut reserved, mut worked) = (0, 0u64);
        let end = (100 << 20) + 5000;
        let status = reserve(end, |from, bytes| {
            assert!(from == reserved && bytes > 0 && from + bytes <= end, "{from} {bytes}");
            let pages = (bytes as u64).div_ceil(4096);
            let left = 300 - worked % 300;
            worked += pages.min(left);
            assert!(worked < 1 << 20, "without end");
            if pages >= left {
                return libc::EINTR;
            }
            reserved += bytes;
            0
        });
        assert_eq!((status, reserved), (0, end));
        // One that is always interrupted ends too, and so does any other fault, at once.
        assert_eq!(reserve(end, |_, _| libc::EINTR), libc::EINTR);
        let mut calls = 0;
        let full = |_, bytes| {
            calls += 1;
            assert_eq!(bytes, end);
            libc::ENOSPC
        };
        assert_eq!((reserve(end, full), calls), (libc::ENOSPC, 1));
    }
}
