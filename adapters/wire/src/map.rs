//! Shared memory of a ring: a file on tmpfs or ramfs, reserved and mapped before it is used.

use crate::WireError;
use rustix::fs::{fstatfs, fstatvfs};
use rustix::io::Errno;
use rustix::mm::{MapFlags, ProtFlags, mmap, munmap};
use rustix::process::{Resource, getrlimit};
use std::fs::{File, Metadata};
use std::io;
use std::os::fd::AsRawFd;
use std::os::unix::fs::MetadataExt;
use std::path::Path;

/// Interruptions by signals that the reservation of one piece tolerates. After about thirty a piece is one page.
const MAX_INTERRUPTIONS: u32 = 1000;

/// File system types of linux/magic.h.
const TMPFS: u32 = 0x0102_1994;
const RAMFS: u32 = 0x8584_58f6;

/// Reserves bytes 0 to `end` by calls of `allocate(from, bytes)`.
///
/// The first call asks for all bytes, so that a full file system refuses before it allocates anything. After each interruption the pieces are halved:
/// older Linux undoes an interrupted call, and next to a fast timer (a profiler's) the same call would be repeated forever.
fn reserve(end: u64, mut allocate: impl FnMut(u64, u64) -> Result<(), Errno>) -> Result<(), Errno> {
    let (mut from, mut piece, mut interruptions) = (0, end, 0);
    while from < end {
        let bytes = piece.min(end - from);
        match allocate(from, bytes) {
            Ok(()) => (from, interruptions) = (from + bytes, 0),
            Err(Errno::INTR) if interruptions < MAX_INTERRUPTIONS => (piece, interruptions) = ((piece / 2).max(4096), interruptions + 1),
            Err(error) => return Err(error),
        }
    }
    Ok(())
}

/// Reserves memory for part of a file. Unlike `ftruncate` this fails on a full file system, where a later write would raise SIGBUS.
///
/// libc, because rustix has `fallocate` alone, which ramfs does not implement; `posix_fallocate` then writes to each page.
fn allocate(file: &File, from: u64, bytes: u64) -> Result<(), Errno> {
    let (Ok(from), Ok(bytes)) = (from.try_into(), bytes.try_into()) else { return Err(Errno::FBIG) };
    // SAFETY: the descriptor is open.
    match unsafe { libc::posix_fallocate(file.as_raw_fd(), from, bytes) } {
        0 => Ok(()),
        code => Err(Errno::from_raw_os_error(code)),
    }
}

/// Checks that a file lies in memory. A write to a mapping on a disk or a server may block on writeback, or end the process on an error.
fn check_in_memory(file: &File, path: &Path) -> Result<(), WireError> {
    let about = fstatfs(file).map_err(|e| WireError::io(path, "its file system cannot be examined", e.into()))?;
    // 32 bits; the sign of the system's type varies.
    match about.f_type as u32 {
        TMPFS | RAMFS => Ok(()),
        found => Err(WireError::NotInMemory { path: path.to_owned(), found: u64::from(found) }),
    }
}

/// Bytes that a file can have at most once `freed` bytes are freed: what is available to this user, and what the file has.
pub(crate) fn room_with(file: &File, freed: u64) -> io::Result<u64> {
    let about = fstatvfs(file)?;
    let available = about.f_bavail.saturating_mul(about.f_frsize);
    Ok(available.saturating_add(allocated(&file.metadata()?)).saturating_add(freed))
}

/// Bytes of the file system that a file occupies.
pub(crate) fn allocated(about: &Metadata) -> u64 {
    about.blocks() * 512
}

/// A file mapped for reading and writing, with all pages present.
#[derive(Debug)]
pub(crate) struct Map {
    start: *mut u8,
    length: usize,
}

// SAFETY: this value alone owns the mapping, which does not depend on a thread.
unsafe impl Send for Map {}
// SAFETY: the callers of `start` synchronise their writes.
unsafe impl Sync for Map {}

impl Map {
    /// Gives the file `length` bytes, all of them backed by memory, and maps it. If the file system or the user's quota is full, `make_room` is called
    /// until it returns false, which means that nothing more can be freed.
    ///
    /// # Errors
    /// `NotInMemory`: the file is on a disk or a server. `FileSize`: the process limit is lower. `NoSpace`: there is no room. After an error no page is
    /// left that could fail when it is written.
    pub fn create(file: &File, path: &Path, length: u64, mut make_room: impl FnMut() -> bool) -> Result<Self, WireError> {
        check_in_memory(file, path)?;
        let no_space = || WireError::NoSpace { path: path.to_owned(), needed: length };
        if let Some(limit) = getrlimit(Resource::Fsize).current.filter(|limit| length > *limit) {
            // The system would end the process by SIGXFSZ.
            return Err(WireError::FileSize { path: path.to_owned(), needed: length, limit });
        }
        let reserved = loop {
            match reserve(length, |from, bytes| allocate(file, from, bytes)) {
                Err(Errno::NOSPC | Errno::DQUOT) if make_room() => {}
                reserved => break reserved,
            }
        };
        reserved.map_err(|error| match error {
            Errno::NOSPC | Errno::FBIG | Errno::NOMEM | Errno::DQUOT => no_space(),
            error => WireError::io(path, "memory cannot be reserved", error.into()),
        })?;
        let length = usize::try_from(length).map_err(|_| no_space())?;
        let (rights, flags) = (ProtFlags::READ | ProtFlags::WRITE, MapFlags::SHARED | MapFlags::POPULATE);
        // SAFETY: a new mapping of an open file at an address that the system chooses.
        let start = unsafe { mmap(std::ptr::null_mut(), length, rights, flags, file, 0) };
        let map = Self { start: start.map_err(|e| WireError::io(path, "cannot be mapped", e.into()))?.cast(), length };
        // MAP_POPULATE maps for reading. A write to each page avoids page faults in the first step.
        for page in (0..length).step_by(4096) {
            // SAFETY: inside the mapping, which no other thread has yet.
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
        let _ = unsafe { munmap(self.start.cast(), self.length) };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn room_is_reserved_whole_although_a_timer_interrupts() {
        // A signal every 300 pages, and a system that undoes the interrupted call.
        let (mut reserved, mut worked) = (0, 0u64);
        let end = (100 << 20) + 5000;
        let result = reserve(end, |from, bytes| {
            assert!(from == reserved && bytes > 0 && from + bytes <= end, "{from} {bytes}");
            let pages = bytes.div_ceil(4096);
            let left = 300 - worked % 300;
            worked += pages.min(left);
            assert!(worked < 1 << 20, "without end");
            if pages >= left {
                return Err(Errno::INTR);
            }
            reserved += bytes;
            Ok(())
        });
        assert_eq!((result, reserved), (Ok(()), end));
        // A call that is always interrupted ends too, and any other error ends the reservation at once.
        assert_eq!(reserve(end, |_, _| Err(Errno::INTR)), Err(Errno::INTR));
        let mut calls = 0;
        let full = |_, bytes| {
            calls += 1;
            assert_eq!(bytes, end);
            Err(Errno::NOSPC)
        };
        assert_eq!((reserve(end, full), calls), (Err(Errno::NOSPC), 1));
    }
}
