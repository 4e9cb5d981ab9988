//! Producer side: copies a step into the next slot of the ring.

use crate::byte_lock::{self, Kind};
use crate::copy::Field;
use crate::header::{DESCRIPTION, ENDED, Header, MARK, MARK_BYTES, MARKS, MAX_SLOTS, OPEN, OVERWRITTEN, PUBLISHED, SLOT_HEADER, STATE};
use crate::lock::{Dead, NameLock, clean_up, dead, is_followed, is_held};
use crate::map::{Map, allocated, room_with};
use crate::private::{create_private, open_private, remove_own};
use crate::{Description, Limits, WireError, block_path, part_path, system};
use rustix::fs::fstat;
use std::fs::File;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering, fence};
use std::time::{Duration, Instant};

/// Longest wait for a name that is taken: a follower that leaves takes each name for a moment to see whether its producer lives.
const NAME_TIMEOUT: Duration = Duration::from_secs(1);
/// Age of a follower's last heartbeat from which the producer does not wait for it.
const SILENCE: Duration = Duration::from_secs(5);

/// Treatment of a step that no follower has taken yet, when its slot is needed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Policy {
    /// The step is overwritten: the solver never waits.
    #[default]
    NewestWins,
    /// The solver waits up to this long, then overwrites the step. It does not wait again until a follower has taken a step.
    Wait(Duration),
}

/// Result of publishing a step.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Published {
    /// Steps published so far, including this one.
    pub count: u64,
    /// True if the step overwrote one that no follower had taken.
    pub overwrote: bool,
}

/// A ring that this process publishes into. Dropping it ends the ring.
#[derive(Debug)]
pub struct Producer {
    ring: PathBuf,
    header: Header,
    first_slot: usize,
    map: Map,
    /// The mapped file. Its byte 0 is locked until the ring ends, so that no other process truncates or replaces it, even if the name's lock file is
    /// removed by hand.
    file: File,
    policy: Policy,
    /// Process that opened the ring; a fork may not publish.
    process: u32,
    writer: Mutex<Writer>,
    lock: Option<NameLock>,
}

/// State of the thread that publishes.
#[derive(Debug)]
struct Writer {
    count: u64,
    /// Time of the last publication, nanoseconds since 1970.
    published: u64,
    /// Steps that the followers had taken when the last wait timed out.
    given_up_at: Option<u64>,
}

/// Progress of the followers.
#[derive(Debug, Clone, Copy)]
struct Progress {
    /// Steps that all of them have taken.
    steps: u64,
    /// True if there were followers and all of them are silent. A follower that never came is waited for.
    silent: bool,
}

impl Producer {
    /// Opens the ring of one block in the folder `ring` (created if it does not exist), with `slots` steps (at least 2). The ring of a killed run is
    /// replaced. All memory is allocated here.
    ///
    /// # Errors
    /// An invalid description; a folder or file that does not belong to this user alone or is not in memory (tmpfs, ramfs); a living producer of the same
    /// name (after a second); no room; a file longer than the process limit; no memory.
    pub fn open(ring: &Path, description: Description, slots: u32, policy: Policy) -> Result<Self, WireError> {
        description.check(&Limits { step_bytes: u64::MAX })?;
        if !(2..=MAX_SLOTS).contains(&slots) {
            return Err(WireError::field("slots", slots, format!("2 to {MAX_SLOTS}")));
        }
        let block = description.block.index;
        let path = block_path(ring, block);
        let begin = Instant::now();
        let lock = loop {
            if let Some(lock) = NameLock::take(ring, block)? {
                match is_held(ring, block) {
                    Ok(false) => break lock,
                    // A producer lives whose lock file was removed by hand: this one is not left in its place.
                    held => (lock.remove(), held?),
                };
            }
            if begin.elapsed() > NAME_TIMEOUT {
                return Err(WireError::InUse { pid: holder(&path), path });
            }
            std::thread::sleep(Duration::from_millis(1));
        };
        // The first reading of the clock looks it up in the vDSO, for which memory may be needed.
        system::monotonic();
        let random = system::random().map_err(|e| WireError::io(&path, "no random numbers", e))?;
        let header = Header {
            description,
            slots,
            producer: u64::from_le_bytes(random),
            generation: system::since_1970(),
            pid: u64::from(std::process::id()),
        };
        let part = part_path(ring, block);
        let made = header.encode().and_then(|(fixed, description, total, first_slot)| {
            let (file, map) = Self::room(ring, block, total)?;
            let producer = Self {
                ring: ring.to_owned(),
                header,
                first_slot: first_slot as usize,
                map,
                file,
                policy,
                process: std::process::id(),
                writer: Mutex::new(Writer { count: 0, published: 0, given_up_at: None }),
                lock: None,
            };
            producer.put(0, &fixed);
            producer.put(DESCRIPTION, &description);
            producer.word(STATE).store(OPEN, Ordering::Release);
            std::fs::rename(&part, &path).map_err(|e| WireError::io(&path, "cannot be renamed into place", e))?;
            Ok(producer)
        });
        match made {
            Ok(mut producer) => {
                producer.lock = Some(lock);
                Ok(producer)
            }
            Err(error) => {
                let _ = std::fs::remove_file(&part);
                lock.remove();
                // Succeeds only if the folder is empty.
                let _ = std::fs::remove_dir(ring);
                Err(error)
            }
        }
    }

    /// Allocates a ring under a temporary name, and locks its file. If there is no room, rings whose producers have ended are removed one after another, even with unread
    /// steps, but only if that can free enough.
    fn room(ring: &Path, block: u32, bytes: u64) -> Result<(File, Map), WireError> {
        let (part, path) = (part_path(ring, block), block_path(ring, block));
        // A killed run may have left one.
        let _ = std::fs::remove_file(&part);
        let file = create_private(&part, true).map_err(|e| WireError::io(&part, "cannot be created", e))?;
        // Nobody else locks a new file.
        byte_lock::try_lock(&file, Kind::Exclusive, 0).map_err(|e| WireError::io(&part, "cannot be locked", e))?;
        let mut found = None;
        let map = Map::create(&file, &path, bytes, || found.get_or_insert_with(|| removable(ring, &path, &file, bytes)).remove_one())?;
        drop(found);
        Ok((file, map))
    }

    /// The published field.
    pub fn description(&self) -> &Description {
        &self.header.description
    }

    /// Publishes a step. Allocates nothing, even on an error. With [`Policy::NewestWins`] it waits only for other threads that publish.
    ///
    /// # Errors
    /// A time that is not finite, a wrong number of components, a null or misaligned pointer, a fork of the process that opened the ring, or a ring whose
    /// file was removed ([`WireError::Removed`]). Nothing was published then.
    ///
    /// # Safety
    /// Every value that `field` and the block's extent describe is readable and does not change during the call.
    pub unsafe fn publish(&self, step: u64, time: f64, field: &Field) -> Result<Published, WireError> {
        let here = std::process::id();
        if here != self.process {
            return Err(WireError::Forked { opened: self.process, here });
        }
        if !time.is_finite() {
            return Err(WireError::Time { time });
        }
        field.check(self.header.description.components())?;
        if self.is_removed() {
            return Err(WireError::Removed);
        }
        let mut writer = self.writer.lock().unwrap_or_else(|broken| broken.into_inner());
        let count = writer.count;
        let overwrote = !self.has_room(&mut writer);
        let slot = self.first_slot + (count % u64::from(self.header.slots)) as usize * self.header.stride() as usize;
        let sequence = self.word(slot);
        sequence.store(2 * count + 1, Ordering::Relaxed);
        // No value of the new step may become visible before the odd number.
        fence(Ordering::Release);
        self.word(slot + 8).store(step, Ordering::Relaxed);
        self.word(slot + 16).store(time.to_bits(), Ordering::Relaxed);
        // SAFETY: the caller guarantees the values. The slot has room for them behind its header, and only the holder of `writer` writes there.
        unsafe { field.copy_to(self.header.description.block.extent, self.map.start().add(slot + SLOT_HEADER).cast()) };
        // Followers recognise repeated steps by these times, so they rise even if the clock is set back.
        writer.published = system::since_1970().max(writer.published + 1);
        self.word(slot + 24).store(writer.published, Ordering::Relaxed);
        sequence.store(2 * count + 2, Ordering::Release);
        writer.count += 1;
        if overwrote {
            self.word(OVERWRITTEN).fetch_add(1, Ordering::Relaxed);
        }
        self.word(PUBLISHED).store(count + 1, Ordering::Release);
        Ok(Published { count: count + 1, overwrote })
    }

    /// Returns true if no name is left of the ring's file. Asks the file and not its path, which may lead over a server for which the solver would wait.
    fn is_removed(&self) -> bool {
        fstat(&self.file).is_ok_and(|about| about.st_nlink == 0)
    }

    /// Returns true if the next slot is free, after waiting as the policy demands.
    fn has_room(&self, writer: &mut Writer) -> bool {
        let slots = u64::from(self.header.slots);
        let free = |taken: u64| writer.count < taken.saturating_add(slots);
        let mut seen = self.progress();
        if free(seen.steps) {
            return true;
        }
        let Policy::Wait(limit) = self.policy else { return false };
        if writer.given_up_at == Some(seen.steps) {
            return false;
        }
        let begin = system::monotonic();
        let (mut nap, limit) = (Duration::from_micros(20), limit.as_nanos() as u64);
        while !seen.silent && system::monotonic().saturating_sub(begin) < limit {
            std::thread::sleep(nap);
            nap = (nap * 2).min(Duration::from_millis(1));
            seen = self.progress();
            if free(seen.steps) {
                return true;
            }
        }
        writer.given_up_at = Some(seen.steps);
        false
    }

    /// Reads the followers' marks. Silent followers count only if no other is left.
    fn progress(&self) -> Progress {
        let now = system::monotonic();
        let (mut least, mut left) = (None, None);
        for mark in 0..MARKS as usize {
            let place = MARK + MARK_BYTES * mark;
            let beat = self.word(place + 8).load(Ordering::Relaxed);
            if beat == 0 {
                continue;
            }
            let steps = self.word(place).load(Ordering::Acquire);
            if now.saturating_sub(beat) <= SILENCE.as_nanos() as u64 {
                least = Some(least.map_or(steps, |least: u64| least.min(steps)));
            } else {
                left = left.max(Some(steps));
            }
        }
        Progress { steps: least.or(left).unwrap_or(0), silent: least.is_none() && left.is_some() }
    }

    /// The word at a multiple of 8.
    fn word(&self, offset: usize) -> &AtomicU64 {
        debug_assert!(offset.is_multiple_of(8) && offset + 8 <= self.map.len());
        // SAFETY: inside the mapping, which starts on a page, and aligned. Other processes change it as one word.
        unsafe { &*self.map.start().add(offset).cast::<AtomicU64>() }
    }

    fn put(&self, offset: usize, bytes: &[u8]) {
        debug_assert!(offset + bytes.len() <= self.map.len());
        // SAFETY: the file has room for both parts of the header, and no other process has opened it yet.
        unsafe { std::ptr::copy_nonoverlapping(bytes.as_ptr(), self.map.start().add(offset), bytes.len()) };
    }
}

impl Drop for Producer {
    /// Ends the ring. Its files are removed if it has no followers; otherwise the last follower removes them when it leaves.
    fn drop(&mut self) {
        if std::process::id() != self.process {
            return;
        }
        let Some(lock) = self.lock.take() else { return };
        let block = self.header.description.block.index;
        self.word(STATE).store(ENDED, Ordering::Release);
        // Nothing is written after this. Before the name: who takes that finds the file free. Closing it would not do, see `FileLock`.
        byte_lock::unlock_all(&self.file);
        if is_followed(&self.ring) {
            drop(lock);
            // A follower that left at this moment may have found the name taken.
            return clean_up(&self.ring, NAME_TIMEOUT);
        }
        remove_own(&block_path(&self.ring, block), &self.file);
        lock.remove();
        // Succeeds only if the folder is empty: other blocks may be there.
        let _ = std::fs::remove_dir(&self.ring);
    }
}

/// Rings of producers that have ended, which may be removed for their memory.
struct Removable<Others> {
    /// The ring whose name this producer has taken.
    own: Option<PathBuf>,
    others: Option<Others>,
}

/// Removable rings of a folder; none if a file of `bytes` would not fit even without them. A ring whose name another producer takes meanwhile stays.
fn removable(ring: &Path, own: &Path, file: &File, bytes: u64) -> Removable<impl Iterator<Item = Dead>> {
    let size = |path: &Path| std::fs::symlink_metadata(path).map_or(0, |about| allocated(&about));
    let freed = size(own) + dead(ring).map(|dead| dead.files().iter().map(|path| size(path)).sum::<u64>()).sum::<u64>();
    let enough = room_with(file, freed).is_ok_and(|room| room >= bytes);
    Removable { own: enough.then(|| own.to_owned()), others: enough.then(|| dead(ring)) }
}

impl<Others: Iterator<Item = Dead>> Removable<Others> {
    /// Removes one; returns false if none is left.
    fn remove_one(&mut self) -> bool {
        match self.own.take().filter(|own| own.exists()) {
            Some(own) => free(&own),
            None => match self.others.as_mut().and_then(Iterator::next) {
                Some(dead) => dead.remove(free),
                None => return false,
            },
        }
        true
    }
}

/// Removes a ring and frees its memory even if followers have it open. They read it through the file, and find that it was truncated. A producer that has it
/// mapped would be killed by a signal, so a locked ring stays.
fn free(path: &Path) {
    if let Ok(file) = open_private(path, true) {
        if !matches!(byte_lock::conflict(&file, Kind::Exclusive), Ok(None)) {
            return;
        }
        let _ = file.set_len(0);
    }
    let _ = std::fs::remove_file(path);
}

/// Process that a ring names; 0 if it cannot be read.
fn holder(path: &Path) -> u64 {
    let Ok(file) = open_private(path, false) else { return 0 };
    let mut pid = [0; 8];
    file.read_exact_at(&mut pid, 64).map_or(0, |()| u64::from_le_bytes(pid))
}
