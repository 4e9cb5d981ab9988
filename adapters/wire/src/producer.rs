//! The solver's side: copy a step into the next slot, and go on.

use crate::copy::Field;
use crate::header::{DESCRIPTION, ENDED, Header, MARK, MARK_BYTES, MARKS, OPEN, OVERWRITTEN, PUBLISHED, SLOT_HEADER, SLOTS, STATE};
use crate::lock::{Dead, NameLock, dead, is_followed, sweep};
use crate::system::{self, Map, create_private, open_private, room_with, taken};
use crate::{Description, Limits, WireError, block_path, part_path};
use std::fs::File;
use std::os::unix::fs::{DirBuilderExt, MetadataExt};
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering, fence};
use std::time::{Duration, Instant};

/// How long a name that is taken is waited for: a follower that leaves takes each for a moment, to see whether anybody has it.
const NAME_PATIENCE: Duration = Duration::from_secs(1);
/// How long a follower may be silent before nobody waits for it.
const SILENCE: Duration = Duration::from_secs(5);

/// What happens when the slot that comes next holds a step that no follower has taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Policy {
    /// It is overwritten: the solver never waits.
    #[default]
    NewestWins,
    /// The solver waits for the follower, so long at most; then it is overwritten, and nobody waits again before the follower has moved.
    Wait(Duration),
}

/// What became of a step.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Published {
    /// Steps published so far, this one with them.
    pub count: u64,
    /// Whether it overwrote one that no follower had taken.
    pub overwrote: bool,
}

/// A ring that this process publishes into. Dropping it ends the ring.
#[derive(Debug)]
pub struct Producer {
    ring: PathBuf,
    header: Header,
    first_slot: usize,
    map: Map,
    policy: Policy,
    /// Who may publish: the process that opened it, not a fork.
    process: u32,
    writer: Mutex<Writer>,
    lock: Option<NameLock>,
}

/// What one thread at a time may touch.
#[derive(Debug)]
struct Writer {
    count: u64,
    /// When the last step was published.
    published: u64,
    /// The follower's count when it was given up waiting for.
    given_up_at: Option<u64>,
}

/// What followers have taken.
#[derive(Debug, Clone, Copy)]
struct Progress {
    /// Steps that all of them have.
    steps: u64,
    /// Followers came, and none of them is heard of any more: nobody waits for them. One that never came is waited for.
    silent: bool,
}

impl Producer {
    /// Opens the ring of one block in the folder `ring` (made where it is not there), with `slots` steps (at least 2). A ring that a
    /// killed run left is replaced. All memory is taken here.
    ///
    /// # Errors
    /// A description that cannot be; a folder or file that is not this user's alone, or not in memory (tmpfs, ramfs); a living producer of the same name (after a second); no room; a file
    /// that is longer than the process may make; no memory.
    pub fn open(ring: &Path, description: Description, slots: u32, policy: Policy) -> Result<Self, WireError> {
        description.check(&Limits { step_bytes: u64::MAX })?;
        if !(2..=SLOTS).contains(&slots) {
            return Err(WireError::field("slots", slots, format!("2 to {SLOTS}")));
        }
        let block = description.block.index;
        let path = block_path(ring, block);
        let begin = Instant::now();
        let lock = loop {
            match NameLock::take(ring, block)? {
                Some(lock) => break lock,
                None if begin.elapsed() > NAME_PATIENCE => return Err(WireError::InUse { pid: holder(&path), path }),
                None => std::thread::sleep(Duration::from_millis(1)),
            }
        };
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
            let map = Self::room(ring, block, total)?;
            let producer = Self {
                ring: ring.to_owned(),
                header,
                first_slot: first_slot as usize,
                map,
                policy,
                process: std::process::id(),
                writer: Mutex::new(Writer { count: 0, published: 0, given_up_at: None }),
                lock: None,
            };
            producer.put(0, &fixed);
            producer.put(DESCRIPTION, &description);
            producer.word(STATE).store(OPEN, Ordering::Release);
            std::fs::rename(&part, &path).map_err(|e| WireError::io(&path, "cannot be put in its place", e))?;
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
                // Only where it is empty.
                let _ = std::fs::remove_dir(ring);
                Err(error)
            }
        }
    }

    /// Memory for a ring, under another name until it is whole. Where there is none, that of rings whose producers have ended is taken, with what followers
    /// had not read of them, one after another, and only where all of it is enough.
    fn room(ring: &Path, block: u32, bytes: u64) -> Result<Map, WireError> {
        let (part, path) = (part_path(ring, block), block_path(ring, block));
        // A killed run may have left it.
        let _ = std::fs::remove_file(&part);
        let file = create_private(&part, true).map_err(|e| WireError::io(&part, "cannot be made", e))?;
        let mut left = None;
        Map::create(&file, &path, bytes, || left.get_or_insert_with(|| left_over(ring, &path, &file, bytes)).give_up_one())
    }

    /// What is published.
    pub fn description(&self) -> &Description {
        &self.header.description
    }

    /// Publishes a step. Takes no memory, even where it fails, and with [`Policy::NewestWins`] waits for nobody but another thread that is publishing.
    ///
    /// # Errors
    /// Nothing was published: a time that is not finite, another number of components, a null or misaligned pointer, or this process is a fork of
    /// the one that opened the ring.
    ///
    /// # Safety
    /// Every value that `field` and the block's extent speak of can be read, and is not written meanwhile.
    pub unsafe fn publish(&self, step: u64, time: f64, field: &Field) -> Result<Published, WireError> {
        let here = std::process::id();
        if here != self.process {
            return Err(WireError::Forked { opened: self.process, here });
        }
        if !time.is_finite() {
            return Err(WireError::Time { time });
        }
        field.check(self.header.description.components())?;
        let mut writer = self.writer.lock().unwrap_or_else(|broken| broken.into_inner());
        let count = writer.count;
        let overwrote = !self.has_room(&mut writer);
        let slot = self.first_slot + (count % u64::from(self.header.slots)) as usize * self.header.stride() as usize;
        let sequence = self.word(slot);
        sequence.store(2 * count + 1, Ordering::Relaxed);
        // No value of the new step may be seen before the odd number.
        fence(Ordering::Release);
        self.word(slot + 8).store(step, Ordering::Relaxed);
        self.word(slot + 16).store(time.to_bits(), Ordering::Relaxed);
        // SAFETY: the caller vouches for the values; the slot has room for the block's values behind its header, and only the holder of
        // `writer` writes there.
        unsafe { field.copy_to(self.header.description.block.extent, self.map.start().add(slot + SLOT_HEADER).cast()) };
        // By these times a follower tells a step from one that came already, also where the clock is set back.
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

    /// Whether the next slot is free, after waiting as the policy says.
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

    /// What the followers' marks say: those that fell silent count only where no other is left.
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
        // SAFETY: inside the mapping, which starts on a page, and aligned; other processes change it as one word.
        unsafe { &*self.map.start().add(offset).cast::<AtomicU64>() }
    }

    fn put(&self, offset: usize, bytes: &[u8]) {
        debug_assert!(offset + bytes.len() <= self.map.len());
        // SAFETY: the file was given room for both parts of the header; nobody has seen it yet.
        unsafe { std::ptr::copy_nonoverlapping(bytes.as_ptr(), self.map.start().add(offset), bytes.len()) };
    }
}

impl Drop for Producer {
    /// Ends the ring. Its files go when no follower is there to take the last steps; a follower that is, removes them when it leaves.
    fn drop(&mut self) {
        if std::process::id() != self.process {
            return;
        }
        let Some(lock) = self.lock.take() else { return };
        let block = self.header.description.block.index;
        self.word(STATE).store(ENDED, Ordering::Release);
        if is_followed(&self.ring) {
            drop(lock);
            // One that was about to leave may have found the name taken.
            return sweep(&self.ring, NAME_PATIENCE);
        }
        let _ = std::fs::remove_file(block_path(&self.ring, block));
        lock.remove();
        // Only where it is empty: other blocks may be there.
        let _ = std::fs::remove_dir(&self.ring);
    }
}

/// Rings of producers that have ended, to be given up for the room that they take.
struct Left<Others> {
    /// The one whose name this producer has.
    own: Option<PathBuf>,
    others: Option<Others>,
}

/// Those of a folder; none where a file of so many bytes would not fit even without them. One whose name somebody takes meanwhile is left alone.
fn left_over(ring: &Path, own: &Path, file: &File, bytes: u64) -> Left<impl Iterator<Item = Dead>> {
    let size = |path: &Path| std::fs::symlink_metadata(path).map_or(0, |about| taken(&about));
    let freed = size(own) + dead(ring).map(|dead| dead.files().iter().map(|path| size(path)).sum::<u64>()).sum::<u64>();
    let enough = room_with(file, freed).is_ok_and(|room| room >= bytes);
    Left { own: enough.then(|| own.to_owned()), others: enough.then(|| dead(ring)) }
}

impl<Others: Iterator<Item = Dead>> Left<Others> {
    /// Gives one up; whether there was one.
    fn give_up_one(&mut self) -> bool {
        match self.own.take().filter(|own| own.exists()) {
            Some(own) => give_up(&own),
            None => match self.others.as_mut().and_then(Iterator::next) {
                Some(dead) => dead.remove(give_up),
                None => return false,
            },
        }
        true
    }
}

/// Removes a ring and frees its memory, although followers may have it open: they read it through the file, and find that it was cut short.
fn give_up(path: &Path) {
    let _ = open_private(path, true).map(|file| file.set_len(0));
    let _ = std::fs::remove_file(path);
}

/// Makes the ring's folder, and refuses one that others may write into, or put another in the place of.
pub(crate) fn make_folder(ring: &Path) -> Result<(), WireError> {
    let made = std::fs::DirBuilder::new().mode(0o700).recursive(true).create(ring);
    made.map_err(|e| WireError::io(ring, "cannot be made", e))?;
    let above = ring.parent().map(|above| if above.as_os_str().is_empty() { Path::new(".") } else { above });
    if let Some(above) = above {
        let about = std::fs::metadata(above).map_err(|e| WireError::io(above, "cannot be looked at", e))?;
        // Who may write into a sticky folder may not rename what is another's in it.
        let sticky = about.mode() & 0o1000 != 0;
        if !sticky && ![0, system::user()].contains(&about.uid()) {
            return Err(system::foreign(
                above,
                format!("is a folder of user {}, who may put another in the place of {}", about.uid(), ring.display()),
            ));
        }
        if !sticky && about.mode() & 0o002 != 0 {
            return Err(system::foreign(above, format!("is a folder that all may write into (mode {:04o})", about.mode() & 0o7777)));
        }
    }
    let about = std::fs::symlink_metadata(ring).map_err(|e| WireError::io(ring, "cannot be looked at", e))?;
    if !about.is_dir() {
        return Err(system::foreign(ring, "is no folder".into()));
    }
    if about.uid() != system::user() {
        return Err(system::foreign(ring, format!("belongs to user {}", about.uid())));
    }
    if about.mode() & 0o022 != 0 {
        return Err(system::foreign(ring, format!("is a folder that others may write into (mode {:04o})", about.mode() & 0o7777)));
    }
    Ok(())
}

/// The process that a ring names.
fn holder(path: &Path) -> u64 {
    let Ok(file) = open_private(path, false) else { return 0 };
    let mut pid = [0; 8];
    std::os::unix::fs::FileExt::read_exact_at(&file, &mut pid, 64).map_or(0, |()| u64::from_le_bytes(pid))
}
