//! Locks that show which producers and followers live. The system releases them when their holder ends, however it ends.

use crate::byte_lock::{self, Kind};
use crate::description::BLOCKS;
use crate::header::MARKS;
use crate::private::{check_private, create_private, make_folder, metadata, names, open_private, refused, remove_own};
use crate::{Limits, RingReader, WireError, block_path, followers_path, lock_path, part_path};
use rustix::io::Errno;
use std::fs::File;
use std::io::{Error, ErrorKind};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Attempts to lock a file that others remove or replace at the same time.
const ATTEMPTS: usize = 100;
/// Longest wait for another process that cleans the ring's folder.
const CLEANUP_TIMEOUT: Duration = Duration::from_secs(5);

/// A file whose byte 0 is locked while its owner is present.
#[derive(Debug)]
struct FileLock {
    path: PathBuf,
    file: File,
    /// Process that took the lock. A fork has a copy of the descriptor and must not release its parent's lock.
    process: u32,
}

impl FileLock {
    /// [`Self::take`] in a ring's folder, which is created if it does not exist. Another process may remove the empty folder in between.
    fn take_in(ring: &Path, path: PathBuf, kind: Kind) -> Result<Option<Self>, WireError> {
        let mut attempts = 0;
        loop {
            attempts += 1;
            let gone = |error: &Error| matches!(error.kind(), ErrorKind::NotFound | ErrorKind::AlreadyExists);
            match make_folder(ring).and_then(|()| Self::take(path.clone(), kind)) {
                Err(WireError::Io { source, .. }) if gone(&source) && attempts < ATTEMPTS => std::thread::yield_now(),
                taken => return taken,
            }
        }
    }

    /// Locks a file, which is created if it does not exist. Returns `None` if another lock conflicts.
    fn take(path: PathBuf, kind: Kind) -> Result<Option<Self>, WireError> {
        for _ in 0..ATTEMPTS {
            let file = create_private(&path, false).map_err(|e| match Errno::from_io_error(&e) {
                Some(Errno::NOSPC) => WireError::NoSpace { path: path.clone(), needed: 4096 },
                _ => refused(&path, "cannot be created", e),
            })?;
            check_private(&path, &metadata(&path, file.metadata())?)?;
            if !byte_lock::try_lock(&file, kind, 0).map_err(|e| WireError::io(&path, "cannot be locked", e))? {
                return Ok(None);
            }
            // Its last holder may have removed the file that was just locked.
            if names(&path, &file).map_err(|e| WireError::io(&path, "cannot be examined", e))? {
                return Ok(Some(Self { path, file, process: std::process::id() }));
            }
            std::thread::yield_now();
        }
        let error = Error::other(format!("another file was at its path after each of {ATTEMPTS} attempts"));
        Err(WireError::io(&path, "cannot be locked", error))
    }

    /// Changes the lock of the present owner, without a moment in between in which the file is not locked.
    fn share(&self) -> Result<(), WireError> {
        let shared = byte_lock::try_lock(&self.file, Kind::Shared, 0).map_err(|e| WireError::io(&self.path, "cannot be locked", e))?;
        debug_assert!(shared, "nobody else has a lock");
        Ok(())
    }

    /// Removes the file while it is locked: a process that opened it finds that it is no longer at the path. Another's file at the path stays: somebody
    /// removed this one by hand.
    fn remove(self) {
        remove_own(&self.path, &self.file);
    }
}

impl Drop for FileLock {
    /// Releases the lock explicitly. Closing the file is not enough: a child that another thread has just forked holds a copy of the descriptor until it
    /// calls `exec`, and with it the lock.
    fn drop(&mut self) {
        if std::process::id() == self.process {
            byte_lock::unlock_all(&self.file);
        }
    }
}

/// Kind of another's lock that conflicts with `kind`; `None` if there is no such lock or no file.
///
/// # Errors
/// The file cannot be opened or examined, for instance because no descriptor is left.
fn conflict(path: &Path, kind: Kind) -> Result<Option<Kind>, WireError> {
    let file = match open_private(path, kind == Kind::Exclusive) {
        Err(WireError::Io { source, .. }) if source.kind() == ErrorKind::NotFound => return Ok(None),
        opened => opened?,
    };
    byte_lock::conflict(&file, kind).map_err(|e| WireError::io(path, "its locks cannot be examined", e))
}

/// A block's name, which belongs to one producer until it is dropped.
#[derive(Debug)]
pub(crate) struct NameLock(FileLock);

impl NameLock {
    /// Takes the name, and creates the ring's folder if it does not exist. Returns `None` if another producer has the name.
    pub fn take(ring: &Path, block: u32) -> Result<Option<Self>, WireError> {
        Ok(FileLock::take_in(ring, lock_path(ring, block), Kind::Exclusive)?.map(Self))
    }

    /// Releases the name and removes its file.
    pub fn remove(self) {
        self.0.remove();
    }
}

/// Returns true if a block's producer lives: its process runs and has not closed the ring.
///
/// # Errors
/// The locks cannot be examined, for instance because no descriptor is left.
pub fn producer_lives(ring: &Path, block: u32) -> Result<bool, WireError> {
    Ok(conflict(&lock_path(ring, block), Kind::Shared)?.is_some() || is_held(ring, block)?)
}

/// Returns true if a living producer has locked the block's ring itself, or the file that becomes its ring. The name's lock does not show a producer whose
/// lock file was removed by hand.
///
/// # Errors
/// Those of [`producer_lives`].
pub(crate) fn is_held(ring: &Path, block: u32) -> Result<bool, WireError> {
    for path in [block_path(ring, block), part_path(ring, block)] {
        match conflict(&path, Kind::Shared) {
            Ok(None) => {}
            // A link or another user's file: no producer of this user made it.
            Err(WireError::Foreign { .. }) => {}
            found => return found.map(|found| found.is_some()),
        }
    }
    Ok(false)
}

/// Returns true if the ring has followers, or if that cannot be found out: unread steps must not be lost.
pub(crate) fn is_followed(ring: &Path) -> bool {
    conflict(&followers_path(ring), Kind::Exclusive).map_or(true, |found| found.is_some())
}

/// Files of a producer that has ended, or was killed while it opened. No other producer can take the name meanwhile.
pub(crate) struct Dead {
    block: u32,
    ring: PathBuf,
    part: PathBuf,
    name: NameLock,
}

impl Dead {
    /// The files that occupy memory.
    pub fn files(&self) -> [&Path; 2] {
        [&self.ring, &self.part]
    }

    /// Returns true if the producer closed the ring: a follower that comes reads its last steps.
    fn is_closed_in_order(&self, ring: &Path) -> bool {
        // Of any size: another follower may have more memory.
        RingReader::open(ring, self.block, &Limits { step_bytes: u64::MAX }).and_then(|reader| reader.is_closed()).unwrap_or(false)
    }

    /// Removes all files; the ring by `remove`.
    pub fn remove(self, remove: impl Fn(&Path)) {
        remove(&self.ring);
        let _ = std::fs::remove_file(self.part);
        self.name.remove();
    }
}

/// Files of producers that have ended, one producer after another: one at a time takes memory and a descriptor.
pub(crate) fn dead(ring: &Path) -> impl Iterator<Item = Dead> {
    let of = |block| {
        let name = NameLock::take(ring, block).ok()??;
        if is_held(ring, block).unwrap_or(true) {
            // Its own lock file was removed by hand, and `take` made this one.
            name.remove();
            return None;
        }
        Some(Dead { block, ring: block_path(ring, block), part: part_path(ring, block), name })
    };
    blocks(ring).filter_map(of)
}

/// A ring's folder without followers, until it is dropped: no follower comes meanwhile.
pub(crate) struct Unfollowed(FileLock);

impl Unfollowed {
    /// Returns `None` if the ring has followers, or if another process cleans it.
    ///
    /// # Errors
    /// The folder does not exist, or a file does not belong to this user alone.
    pub fn take(ring: &Path) -> Result<Option<Self>, WireError> {
        Ok(FileLock::take(followers_path(ring), Kind::Exclusive)?.map(Self))
    }

    /// Removes the rings of producers that have ended, and the folder if it is empty.
    pub fn clean(self, ring: &Path) {
        // A producer that holds its name cleans up by itself when it ends.
        dead(ring).for_each(|dead| dead.remove(|path| drop(std::fs::remove_file(path))));
        self.0.remove();
        let _ = std::fs::remove_dir(ring);
    }
}

/// Removes the rings of producers that have ended, and the folder if it is empty, unless the ring has followers. Waits up to `limit` for another process
/// that does the same: files that were in use when that process looked would otherwise stay.
pub(crate) fn clean_up(ring: &Path, limit: Duration) {
    let (path, begin) = (followers_path(ring), Instant::now());
    let last = loop {
        match Unfollowed::take(ring) {
            Ok(Some(last)) => break last,
            Ok(None) => {
                // The last follower will do it.
                if matches!(conflict(&path, Kind::Exclusive), Ok(Some(Kind::Shared))) || begin.elapsed() > limit {
                    return;
                }
                std::thread::sleep(Duration::from_millis(1));
            }
            // The folder does not exist any more.
            Err(_) => return,
        }
    };
    last.clean(ring);
}

/// Marks the ring as followed: a producer that ends leaves its last steps there. Dropping it removes the rings of producers that have ended, unless
/// another follower is left.
#[derive(Debug)]
pub struct Following {
    ring: PathBuf,
    lock: Option<FileLock>,
}

impl Following {
    /// Creates the ring's folder if it does not exist. The first follower removes what killed producers left, which no follower reads.
    ///
    /// # Errors
    /// The folder or a file does not belong to this user alone; another process (a stopped one) cleans the folder for too long.
    pub fn begin(ring: &Path) -> Result<Self, WireError> {
        let (path, begin) = (followers_path(ring), Instant::now());
        let lock = loop {
            if let Some(alone) = FileLock::take_in(ring, path.clone(), Kind::Exclusive)? {
                let killed = dead(ring).filter(|dead| !dead.is_closed_in_order(ring));
                killed.for_each(|dead| dead.remove(|path| drop(std::fs::remove_file(path))));
                alone.share()?;
                break alone;
            }
            match FileLock::take_in(ring, path.clone(), Kind::Shared)? {
                Some(lock) => break lock,
                None if begin.elapsed() > CLEANUP_TIMEOUT => {
                    return Err(WireError::io(&path, "is locked by a follower that leaves", ErrorKind::TimedOut.into()));
                }
                None => std::thread::sleep(Duration::from_millis(1)),
            }
        };
        Ok(Self { ring: ring.to_owned(), lock: Some(lock) })
    }

    /// Takes a number for this follower's marks in the rings. No other follower has the same number until this one is dropped.
    ///
    /// # Errors
    /// All 64 numbers are taken.
    pub fn mark(&self) -> Result<u32, WireError> {
        let path = followers_path(&self.ring);
        let Some(lock) = &self.lock else { unreachable!("taken only by drop") };
        for mark in 0..MARKS {
            // Byte 0 shows the presence of any follower.
            if byte_lock::try_lock(&lock.file, Kind::Exclusive, mark + 1).map_err(|e| WireError::io(&path, "cannot be locked", e))? {
                return Ok(mark);
            }
        }
        Err(WireError::field("followers", format_args!("{} follow {} already", MARKS, self.ring.display()), format!("at most {MARKS}")))
    }
}

impl Drop for Following {
    fn drop(&mut self) {
        drop(self.lock.take());
        clean_up(&self.ring, CLEANUP_TIMEOUT);
    }
}

/// Indices, ascending, of the blocks that have a ring, a partial ring or a lock in the folder. The memory does not grow with their number.
pub fn blocks(ring: &Path) -> impl Iterator<Item = u32> + use<> {
    let mut present = [0u64; BLOCKS as usize / 64];
    let number = |name: &str| {
        let name = name.strip_prefix("block-").or(name.strip_prefix(".block-"))?;
        let digits = [".ring", ".part", ".lock"].iter().find_map(|end| name.strip_suffix(end))?;
        (digits.len() == 5).then(|| digits.parse::<u32>().ok()).flatten()
    };
    let entries = std::fs::read_dir(ring).into_iter().flatten().take(1 << 18).flatten();
    for block in entries.filter_map(|entry| entry.file_name().to_str().and_then(number)).filter(|block| *block < BLOCKS) {
        present[block as usize / 64] |= 1 << (block % 64);
    }
    (0..BLOCKS).filter(move |block| present[*block as usize / 64] >> (block % 64) & 1 == 1)
}
