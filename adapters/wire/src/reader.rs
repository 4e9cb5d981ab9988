//! Follower side: reads steps from the ring and checks them.
//!
//! The ring is read through its file, not through a mapping: a ring that is truncated during a read gives an error and no signal. Sequence numbers show
//! what a producer overwrites during a read (a sequence lock).

use crate::bytes::fill;
use crate::header::{DESCRIPTION, ENDED, FIXED, Header, MARK, MARK_BYTES, MARKS, PUBLISHED, SLOT_HEADER, STATE};
use crate::private::{metadata, open_private};
use crate::{Limits, WireError, block_path, system};
use std::fs::File;
use std::os::unix::fs::{FileExt, MetadataExt};
use std::path::{Path, PathBuf};
use std::sync::atomic::{Ordering, fence};

/// Most steps that one call starts to read, if the producer overtakes each of them.
const ATTEMPTS: usize = 4;

const TRUNCATED: &str = "cannot be read (was it truncated?)";

/// Content of a published step's slot.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum SlotContent {
    /// The step, with the solver's number.
    Step(u64),
    /// A later one.
    Overwritten,
    /// An earlier one: the step is not visible yet.
    NotVisible,
}

/// Result of reading one slot.
pub(crate) enum SlotRead {
    /// The step; its values are in the buffer.
    Step(StepInfo),
    /// The slot holds a later step, or one is being written.
    Overwritten,
    /// The caller stopped the read.
    Stopped,
}

/// Bytes with random access: a file, or memory in tests.
pub trait ReadAt {
    /// Number of bytes.
    ///
    /// # Errors
    /// Those of the system.
    fn length(&self) -> std::io::Result<u64>;
    /// Fills `to` from `offset` on.
    ///
    /// # Errors
    /// Those of the system; `UnexpectedEof` if there are fewer bytes.
    fn read_at(&self, to: &mut [u8], offset: u64) -> std::io::Result<()>;
    /// Writes the follower's mark.
    ///
    /// # Errors
    /// Those of the system.
    fn write_at(&self, from: &[u8], offset: u64) -> std::io::Result<()>;
}

impl ReadAt for File {
    fn length(&self) -> std::io::Result<u64> {
        self.metadata().map(|about| about.len())
    }

    fn read_at(&self, to: &mut [u8], offset: u64) -> std::io::Result<()> {
        self.read_exact_at(to, offset)
    }

    fn write_at(&self, from: &[u8], offset: u64) -> std::io::Result<()> {
        self.write_all_at(from, offset)
    }
}

/// A step without its values.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StepInfo {
    /// Its number among the published steps, from 0.
    pub number: u64,
    /// The solver's number.
    pub step: u64,
    /// The solver's time.
    pub time: f64,
    /// Time of publication, nanoseconds since 1970.
    pub published: u64,
    /// Steps before it that were overwritten before they were read.
    pub missed: u64,
}

/// Result of [`RingReader::read`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Read {
    /// A step; its values are in the buffer.
    Step(StepInfo),
    /// Nothing new yet.
    Nothing,
    /// All steps were read, and the producer has closed the ring.
    Ended,
}

/// Reads the ring of one block.
#[derive(Debug)]
pub struct RingReader<F = File> {
    path: PathBuf,
    file: F,
    header: Header,
    first_slot: u64,
    /// Number of the next step.
    next: u64,
    /// Steps skipped since the last one that was read.
    skipped: u64,
    device_and_inode: (u64, u64),
}

impl RingReader<File> {
    /// Opens a block's ring. Reading begins with the oldest step.
    ///
    /// # Errors
    /// There is no ring; it belongs to another user, has another version, is torn or exceeds `limits`.
    pub fn open(ring: &Path, block: u32, limits: &Limits) -> Result<Self, WireError> {
        let path = block_path(ring, block);
        let file = open_private(&path, true)?;
        let about = metadata(&path, file.metadata())?;
        let mut reader = Self::over(path, file, limits)?;
        reader.device_and_inode = (about.dev(), about.ino());
        let found = reader.header.description.block.index;
        if found != block {
            return Err(WireError::Block { block, found: format!("its ring says block {found}"), accepted: "its own number".into() });
        }
        Ok(reader)
    }

    /// Returns true if the path still names this file; a restarted producer replaces it.
    pub fn is_current(&self) -> bool {
        std::fs::symlink_metadata(&self.path).is_ok_and(|now| (now.dev(), now.ino()) == self.device_and_inode)
    }
}

impl<F: ReadAt> RingReader<F> {
    /// Reads a ring from any bytes; `path` appears in errors.
    ///
    /// # Errors
    /// Those of [`RingReader::open`], except owner and mode.
    pub fn over(path: PathBuf, file: F, limits: &Limits) -> Result<Self, WireError> {
        let failed = |e| WireError::io(&path, "cannot be read", e);
        let length = file.length().map_err(failed)?;
        let needed = (DESCRIPTION + FIXED) as u64;
        if length < needed {
            return Err(WireError::Short { what: "the ring", found: length, needed });
        }
        let mut fixed = [0; FIXED];
        file.read_at(&mut fixed, 0).map_err(failed)?;
        let bytes = Header::description_bytes(&fixed)?;
        let needed = (DESCRIPTION + bytes) as u64;
        // Before memory is allocated for it.
        if length < needed {
            return Err(WireError::Short { what: "the ring", found: length, needed });
        }
        let mut description = vec![0; bytes];
        file.read_at(&mut description, DESCRIPTION as u64).map_err(failed)?;
        let (header, first_slot) = Header::decode(&fixed, &description, length, limits)?;
        let mut reader = Self { path, file, header, first_slot, next: 0, skipped: 0, device_and_inode: (0, 0) };
        reader.next = reader.word(PUBLISHED)?.saturating_sub(u64::from(reader.header.slots));
        Ok(reader)
    }

    /// The ring's header.
    pub fn header(&self) -> &Header {
        &self.header
    }

    /// Reads the oldest unread step: its components, one after another, x fastest, in native f32. If the producer overtakes the read, the newest step is
    /// read instead, which stays longest. `values` keeps its memory from call to call.
    ///
    /// # Errors
    /// The file was truncated, or its counts run backwards.
    pub fn read(&mut self, values: &mut Vec<f32>) -> Result<Read, WireError> {
        self.read_while(values, &mut |_| true).map(|found| found.unwrap_or(Read::Nothing))
    }

    /// [`Self::read`] that calls `go_on` after each piece of the values. Returns `None` if `go_on` returned false; the step stays unread then.
    pub(crate) fn read_while(&mut self, values: &mut Vec<f32>, go_on: &mut dyn FnMut(&Self) -> bool) -> Result<Option<Read>, WireError> {
        let slots = u64::from(self.header.slots);
        let began = self.next;
        // Not `next` itself, which heartbeats report to the producer meanwhile.
        let mut number = began;
        // Before the count is read: no step can follow it.
        let ended = self.is_closed()?;
        for _ in 0..ATTEMPTS {
            let published = self.word(PUBLISHED)?;
            if published < began {
                return Err(self.ran_back(published, began));
            }
            number = number.max(published.saturating_sub(slots));
            if number >= published {
                // Steps that were overwritten during this call count as missed before the next one.
                return Ok(Some(if number == began && ended { Read::Ended } else { Read::Nothing }));
            }
            match self.try_slot(number, values, go_on)? {
                SlotRead::Step(mut info) => {
                    info.missed = number - began;
                    self.next = number + 1;
                    return Ok(Some(Read::Step(info)));
                }
                SlotRead::Stopped => return Ok(None),
                SlotRead::Overwritten => number = (number + 1).max(self.word(PUBLISHED)?.saturating_sub(1)),
            }
        }
        // The producer is faster than any read; the caller has other work to do.
        Ok(Some(Read::Nothing))
    }

    /// Numbers of the steps in the ring; the first may be overwritten at this moment.
    pub(crate) fn available(&self) -> Result<std::ops::Range<u64>, WireError> {
        let published = self.word(PUBLISHED)?;
        if published < self.next {
            return Err(self.ran_back(published, self.next));
        }
        Ok(published.saturating_sub(u64::from(self.header.slots))..published)
    }

    /// Reads the head of a published step's slot.
    pub(crate) fn peek(&self, number: u64) -> Result<SlotContent, WireError> {
        let head = self.any_head(number)?;
        if head[0] == sequence(number) {
            return Ok(SlotContent::Step(head[1]));
        }
        // Without a newer head or a newer count, the slot's old content is merely visible for longer than the count.
        let slots = u64::from(self.header.slots);
        let is_over = head[0] > sequence(number) || self.word(PUBLISHED)? >= number.saturating_add(slots);
        Ok(if is_over { SlotContent::Overwritten } else { SlotContent::NotVisible })
    }

    /// Reads this step and no other, as [`Self::read_while`] does. Earlier unread steps count as missed.
    pub(crate) fn take(&mut self, number: u64, values: &mut Vec<f32>, go_on: &mut dyn FnMut(&Self) -> bool) -> Result<SlotRead, WireError> {
        let mut read = self.try_slot(number, values, go_on)?;
        if let SlotRead::Step(info) = &mut read {
            self.skip_to(number);
            info.missed = std::mem::take(&mut self.skipped);
            self.next = number + 1;
        }
        Ok(read)
    }

    /// Skips all steps before a number; returns true if there were any.
    pub(crate) fn skip_to(&mut self, number: u64) -> bool {
        let skipped = number.saturating_sub(self.next);
        (self.next, self.skipped) = (self.next + skipped, self.skipped + skipped);
        skipped > 0
    }

    /// Writes this follower's progress and heartbeat to its mark, whose number is [`crate::Following::mark`].
    ///
    /// # Errors
    /// The file cannot be written, or was truncated.
    pub fn acknowledge(&self, mark: u32) -> Result<(), WireError> {
        self.put_mark(mark, system::monotonic())
    }

    /// Marks this follower as gone, so that the producer does not wait for it.
    ///
    /// # Errors
    /// The file cannot be written, or was truncated.
    pub fn leave(&self, mark: u32) -> Result<(), WireError> {
        // A heartbeat of long ago.
        self.put_mark(mark, 1)
    }

    /// Checks the length before a write, which would extend a ring that was truncated for its memory.
    ///
    /// # Errors
    /// The file is shorter than its header says.
    fn check_whole(&self) -> Result<(), WireError> {
        let needed = self.first_slot + self.header.stride() * u64::from(self.header.slots);
        let length = self.file.length().map_err(|e| WireError::io(&self.path, "cannot be examined", e))?;
        if length < needed {
            return Err(WireError::io(&self.path, TRUNCATED, std::io::ErrorKind::UnexpectedEof.into()));
        }
        Ok(())
    }

    /// Error of a count below an earlier one, or of the truncation that caused it (a mark may have extended the file again).
    fn ran_back(&self, published: u64, seen: u64) -> WireError {
        let ran_back = || WireError::field("published", published, format!("at least {seen}, which was seen before"));
        self.check_whole().err().unwrap_or_else(ran_back)
    }

    fn put_mark(&self, mark: u32, heartbeat: u64) -> Result<(), WireError> {
        self.check_whole()?;
        let mut words = [0; MARK_BYTES];
        words[..8].copy_from_slice(&self.next.to_ne_bytes());
        words[8..].copy_from_slice(&heartbeat.to_ne_bytes());
        let place = MARK + MARK_BYTES * (mark % MARKS) as usize;
        self.file.write_at(&words, place as u64).map_err(|e| WireError::io(&self.path, "cannot be written", e))
    }

    /// Returns true if the producer has closed the ring: no step is added after that.
    ///
    /// # Errors
    /// The file cannot be read, or was truncated.
    pub fn is_closed(&self) -> Result<bool, WireError> {
        Ok(self.word(STATE)? == ENDED)
    }

    fn slot(&self, number: u64) -> u64 {
        self.first_slot + number % u64::from(self.header.slots) * self.header.stride()
    }

    /// The head of a step's slot in words, for whichever step it holds.
    fn any_head(&self, number: u64) -> Result<[u64; 4], WireError> {
        let mut head = [0; 32];
        self.read_bytes(&mut head, self.slot(number))?;
        Ok([0, 1, 2, 3].map(|k| u64::from_ne_bytes(head.as_chunks::<8>().0[k])))
    }

    /// The head of a step's slot; `None` if it holds another step or is being written.
    fn head(&self, number: u64) -> Result<Option<[u64; 4]>, WireError> {
        Ok(Some(self.any_head(number)?).filter(|words| words[0] == sequence(number)))
    }

    fn try_slot(&self, number: u64, values: &mut Vec<f32>, go_on: &mut dyn FnMut(&Self) -> bool) -> Result<SlotRead, WireError> {
        let slot = self.slot(number);
        // Within the limits, since the header was checked.
        let count = (self.header.description.block_bytes() / 4) as usize;
        let Some(head) = self.head(number)? else { return Ok(SlotRead::Overwritten) };
        fence(Ordering::Acquire);
        let (mut place, mut stopped) = (slot + SLOT_HEADER as u64, false);
        let is_whole = fill(values, count, |piece| {
            self.read_bytes(piece, place)?;
            place += piece.len() as u64;
            stopped = !go_on(self);
            // All values so far are read before the number is read again.
            fence(Ordering::Acquire);
            Ok(!stopped && self.head(number)?.is_some())
        })?;
        if !is_whole {
            return Ok(if stopped { SlotRead::Stopped } else { SlotRead::Overwritten });
        }
        let time = f64::from_bits(head[2]);
        if !time.is_finite() {
            return Err(WireError::field("time", time, "a finite number"));
        }
        Ok(SlotRead::Step(StepInfo { number, step: head[1], time, published: head[3], missed: 0 }))
    }

    /// A word of the producer's. Later reads see everything that it wrote before this word.
    fn word(&self, offset: usize) -> Result<u64, WireError> {
        let mut bytes = [0; 8];
        self.read_bytes(&mut bytes, offset as u64)?;
        fence(Ordering::Acquire);
        Ok(u64::from_ne_bytes(bytes))
    }

    fn read_bytes(&self, to: &mut [u8], offset: u64) -> Result<(), WireError> {
        self.file.read_at(to, offset).map_err(|e| WireError::io(&self.path, TRUNCATED, e))
    }
}

/// Sequence number of a slot that holds this complete step.
fn sequence(number: u64) -> u64 {
    number.wrapping_mul(2).wrapping_add(2)
}
