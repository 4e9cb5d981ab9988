//! Who publishes under a name, and who follows: locks that the system takes back when their holder ends, however it ends.

use crate::description::BLOCKS;
use crate::header::MARKS;
use crate::system::{create_private, foreign};
use crate::{WireError, block_path, followers_path, lock_path, part_path, system};
use std::fs::File;
use std::io;
use std::os::fd::AsRawFd;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Attempts to lock a file that others remove or replace meanwhile.
const ATTEMPTS: usize = 100;
/// How long somebody is waited for who sweeps a ring's folder up.
const SWEEP_PATIENCE: Duration = Duration::from_secs(5);

/// A locked file.
#[derive(Debug)]
struct FileLock {
    path: PathBuf,
    file: File,
    /// Whose lock it is: a fork has a copy of the descriptor, and with it the means to free its parent's.
    process: u32,
}

/// A lock over a file's byte 0, which stands for the presence of whoever has it.
fn presence(kind: libc::c_int) -> libc::flock {
    byte_lock(kind, 0)
}

/// A lock over one byte of a file; it need not be there.
fn byte_lock(kind: libc::c_int, byte: u32) -> libc::flock {
    // SAFETY: all of its fields are integers.
    let mut lock: libc::flock = unsafe { std::mem::zeroed() };
    lock.l_type = kind as libc::c_short;
    lock.l_whence = libc::SEEK_SET as libc::c_short;
    lock.l_start = libc::off_t::from(byte);
    lock.l_len = 1;
    lock
}

impl FileLock {
    /// The same in a ring's folder, made where it is not there. Another process that ends may remove the empty folder in between.
    fn take_in(ring: &Path, path: PathBuf, kind: libc::c_int) -> Result<Option<Self>, WireError> {
        let mut attempts = 0;
        loop {
            attempts += 1;
            let gone = |error: &io::Error| matches!(error.kind(), io::ErrorKind::NotFound | io::ErrorKind::AlreadyExists);
            match crate::producer::make_folder(ring).and_then(|()| Self::take(path.clone(), kind)) {
                Err(WireError::Io { source, .. }) if gone(&source) && attempts < ATTEMPTS => std::thread::yield_now(),
                taken => return taken,
            }
        }
    }

    /// Locks a file, made where it is not there; none when it is locked against that.
    fn take(path: PathBuf, kind: libc::c_int) -> Result<Option<Self>, WireError> {
        for _ in 0..ATTEMPTS {
            let file = create_private(&path, false).map_err(|e| match e.raw_os_error() {
                Some(libc::ELOOP) => foreign(&path, "is a symbolic link".into()),
                Some(libc::EACCES | libc::EPERM) => foreign(&path, "may not be opened by this user".into()),
                Some(libc::ENOSPC) => WireError::NoSpace { path: path.clone(), needed: 4096 },
                _ => WireError::io(&path, "cannot be made", e),
            })?;
            let about = file.metadata().map_err(|e| WireError::io(&path, "cannot be looked at", e))?;
            system::check_private(&path, &about, system::user())?;
            // SAFETY: the descriptor is open, and the lock outlives the call.
            if unsafe { libc::fcntl(file.as_raw_fd(), libc::F_OFD_SETLK, &presence(kind)) } != 0 {
                return match io::Error::last_os_error() {
                    error if matches!(error.raw_os_error(), Some(libc::EAGAIN | libc::EACCES)) => Ok(None),
                    error => Err(WireError::io(&path, "cannot be locked", error)),
                };
            }
            // Its last holder may have removed the file that was just locked.
            match std::fs::metadata(&path) {
                Ok(now) if (now.dev(), now.ino()) == (about.dev(), about.ino()) => {
                    return Ok(Some(Self { path, file, process: std::process::id() }));
                }
                Ok(_) => {}
                Err(error) if error.kind() == io::ErrorKind::NotFound => {}
                Err(error) => return Err(WireError::io(&path, "cannot be looked at", error)),
            }
            std::thread::yield_now();
        }
        let error = io::Error::other(format!("another file is at its path after each of {ATTEMPTS} attempts"));
        Err(WireError::io(&path, "cannot be locked", error))
    }

    /// Removes the file while it is still locked: whoever opened it finds that it is not the one at the path.
    fn remove(self) {
        let _ = std::fs::remove_file(&self.path);
    }
}

impl Drop for FileLock {
    /// Frees it by name and not by closing the file: children that another thread has just made hold copies of the descriptor until they call `exec`, and
    /// with them the lock.
    fn drop(&mut self) {
        if std::process::id() != self.process {
            return;
        }
        // Its marks with it.
        let all = libc::flock { l_len: 0, ..presence(libc::F_UNLCK) };
        // SAFETY: the descriptor is open, and the lock outlives the call.
        unsafe { libc::fcntl(self.file.as_raw_fd(), libc::F_OFD_SETLK, &all) };
    }
}

/// The kind of somebody's lock that stands in the way of `kind`.
///
/// # Errors
/// It cannot be told, for want of a descriptor for instance.
fn in_the_way(path: &Path, kind: libc::c_int) -> Result<Option<libc::c_int>, WireError> {
    let file = match system::open_private(path, kind == libc::F_WRLCK) {
        Err(WireError::Io { source, .. }) if source.kind() == io::ErrorKind::NotFound => return Ok(None),
        opened => opened?,
    };
    let mut lock = presence(kind);
    // SAFETY: the descriptor is open, and the lock outlives the call.
    if unsafe { libc::fcntl(file.as_raw_fd(), libc::F_OFD_GETLK, &mut lock) } != 0 {
        return Err(WireError::io(path, "cannot be asked for its locks", io::Error::last_os_error()));
    }
    Ok(Some(libc::c_int::from(lock.l_type)).filter(|found| *found != libc::F_UNLCK))
}

/// A block's name, which is this producer's until it is dropped.
#[derive(Debug)]
pub(crate) struct NameLock(FileLock);

impl NameLock {
    /// Takes it, and makes the ring's folder where it is not there; none when somebody has it.
    pub fn take(ring: &Path, block: u32) -> Result<Option<Self>, WireError> {
        Ok(FileLock::take_in(ring, lock_path(ring, block), libc::F_WRLCK)?.map(Self))
    }

    /// Frees the name and removes its file.
    pub fn remove(self) {
        self.0.remove();
    }
}

/// Whether a block's producer lives (its process runs, and has not closed the ring).
///
/// # Errors
/// It cannot be told, for want of a descriptor for instance.
pub fn producer_lives(ring: &Path, block: u32) -> Result<bool, WireError> {
    Ok(in_the_way(&lock_path(ring, block), libc::F_RDLCK)?.is_some())
}

/// Whether anybody follows the ring, for all that can be told: what nobody reads is lost.
pub(crate) fn is_followed(ring: &Path) -> bool {
    in_the_way(&followers_path(ring), libc::F_WRLCK).map_or(true, |found| found.is_some())
}

/// What a producer left that has ended, or was killed while it opened. Nobody else can take its name meanwhile.
pub(crate) struct Dead {
    ring: PathBuf,
    part: PathBuf,
    name: NameLock,
}

impl Dead {
    /// Its files that take room.
    pub fn files(&self) -> [&Path; 2] {
        [&self.ring, &self.part]
    }

    /// Removes it, the ring by `remove`.
    pub fn remove(self, remove: impl Fn(&Path)) {
        remove(&self.ring);
        let _ = std::fs::remove_file(self.part);
        self.name.remove();
    }
}

/// What producers that have ended left in a folder, one after another: of however many there are, one takes memory and descriptors at a time.
pub(crate) fn dead(ring: &Path) -> impl Iterator<Item = Dead> {
    let of = |block| Some(Dead { ring: block_path(ring, block), part: part_path(ring, block), name: NameLock::take(ring, block).ok()?? });
    blocks(ring).filter_map(of)
}

/// Removes the rings of producers that have ended, and the folder when it is empty, where nobody follows. Somebody else who does so is waited for, so
/// long at most: what was still taken when it looked would stay.
pub(crate) fn sweep(ring: &Path, limit: Duration) {
    let (path, begin) = (followers_path(ring), Instant::now());
    let last = loop {
        match FileLock::take(path.clone(), libc::F_WRLCK) {
            Ok(Some(last)) => break last,
            Ok(None) => {
                // Who follows will do it.
                if matches!(in_the_way(&path, libc::F_WRLCK), Ok(Some(libc::F_RDLCK))) || begin.elapsed() > limit {
                    return;
                }
                std::thread::sleep(Duration::from_millis(1));
            }
            // The folder is gone.
            Err(_) => return,
        }
    };
    // Whoever has a name publishes, and looks for followers once more when it has ended.
    dead(ring).for_each(|dead| dead.remove(|path| drop(std::fs::remove_file(path))));
    last.remove();
    let _ = std::fs::remove_dir(ring);
}

/// Says that somebody follows the ring: a producer that ends leaves its last steps there. Dropping it removes the rings of producers that
/// have ended, where nobody else follows.
#[derive(Debug)]
pub struct Following {
    ring: PathBuf,
    lock: Option<FileLock>,
}

impl Following {
    /// Makes the ring's folder where it is not there.
    ///
    /// # Errors
    /// A folder or file that is not this user's alone; somebody who sweeps the folder up and does not come to an end (a process that was stopped).
    pub fn begin(ring: &Path) -> Result<Self, WireError> {
        let (path, begin) = (followers_path(ring), Instant::now());
        let lock = loop {
            match FileLock::take_in(ring, path.clone(), libc::F_RDLCK)? {
                Some(lock) => break lock,
                None if begin.elapsed() > SWEEP_PATIENCE => {
                    return Err(WireError::io(&path, "is locked by a follower that leaves", io::ErrorKind::TimedOut.into()));
                }
                None => std::thread::sleep(Duration::from_millis(1)),
            }
        };
        Ok(Self { ring: ring.to_owned(), lock: Some(lock) })
    }

    /// Takes a number for the marks that this follower leaves in the rings, which nobody else has until it is dropped.
    ///
    /// # Errors
    /// All 64 are taken.
    pub fn mark(&self) -> Result<u32, WireError> {
        let path = followers_path(&self.ring);
        let Some(lock) = &self.lock else { unreachable!("taken only by drop") };
        for mark in 0..MARKS {
            // SAFETY: the descriptor is open, and the lock outlives the call. Byte 0 is the presence of all.
            if unsafe { libc::fcntl(lock.file.as_raw_fd(), libc::F_OFD_SETLK, &byte_lock(libc::F_WRLCK, mark + 1)) } == 0 {
                return Ok(mark);
            }
            let error = io::Error::last_os_error();
            if !matches!(error.raw_os_error(), Some(libc::EAGAIN | libc::EACCES)) {
                return Err(WireError::io(&path, "cannot be locked", error));
            }
        }
        Err(WireError::field("followers", format_args!("{} follow {} already", MARKS, self.ring.display()), format!("at most {MARKS}")))
    }
}

impl Drop for Following {
    fn drop(&mut self) {
        drop(self.lock.take());
        sweep(&self.ring, SWEEP_PATIENCE);
    }
}

/// The blocks of which a ring, a part of one or a lock is in the folder, ascending. Takes no more memory for more of them.
pub fn blocks(ring: &Path) -> impl Iterator<Item = u32> + use<> {
    // A bit a block.
    let mut there = [0u64; BLOCKS as usize / 64];
    let number = |name: &str| {
        let name = name.strip_prefix("block-").or(name.strip_prefix(".block-"))?;
        let digits = [".ring", ".part", ".lock"].iter().find_map(|end| name.strip_suffix(end))?;
        (digits.len() == 5).then(|| digits.parse::<u32>().ok()).flatten()
    };
    let entries = std::fs::read_dir(ring).into_iter().flatten().take(1 << 18).flatten();
    for block in entries.filter_map(|entry| entry.file_name().to_str().and_then(number)).filter(|block| *block < BLOCKS) {
        there[block as usize / 64] |= 1 << (block % 64);
    }
    (0..BLOCKS).filter(move |block| there[*block as usize / 64] >> (block % 64) & 1 == 1)
}
