//! The follower's side: what is in the ring, checked.
//!
//! Everything is read through the file, not through a mapping: a ring that is cut short under the reader's hands gives an error and no
//! signal, and what a producer writes meanwhile is seen by the sequence numbers.

use crate::bytes::fill;
use crate::header::{DESCRIPTION, ENDED, FIXED, Header, MARK, MARK_BYTES, MARKS, PUBLISHED, SLOT_HEADER, STATE};
use crate::system::{self, open_private};
use crate::{Limits, WireError, block_path};
use std::fs::File;
use std::os::unix::fs::{FileExt, MetadataExt};
use std::path::{Path, PathBuf};
use std::sync::atomic::{Ordering, fence};

/// Steps that are begun to be read in one look, if the producer overtakes each of them.
const ATTEMPTS: usize = 4;

const CUT_SHORT: &str = "cannot be read (was it cut short?)";

/// What stands in the slot of a step that was published.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Found {
    /// The step, with the solver's number.
    Step(u64),
    /// A later one.
    Overwritten,
    /// What was there before it: the step is not seen yet.
    Unseen,
}

/// What came of reading one step.
pub(crate) enum Tried {
    /// The step; its values are in the buffer.
    Step(StepInfo),
    /// A later one stands in its slot, or is being written.
    Overwritten,
    /// Whoever reads did not want to go on.
    BrokenOff,
}

/// Bytes that can be read anywhere: a file, or memory in tests.
pub trait ReadAt {
    /// Bytes there.
    fn length(&self) -> std::io::Result<u64>;
    /// Fills `to` from `offset` on.
    fn read_at(&self, to: &mut [u8], offset: u64) -> std::io::Result<()>;
    /// Writes the follower's words.
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

/// What is known of a step besides its values.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StepInfo {
    /// Its number among those published, from 0.
    pub number: u64,
    /// The solver's number.
    pub step: u64,
    /// The solver's time.
    pub time: f64,
    /// When it was published, nanoseconds since 1970.
    pub published: u64,
    /// Steps before it that were overwritten before they could be read.
    pub missed: u64,
}

/// What a reader found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Read {
    /// A step; its values are in the buffer.
    Step(StepInfo),
    /// Nothing new yet.
    Nothing,
    /// All was read, and the producer has closed the ring.
    Ended,
}

/// Follows the ring of one block.
#[derive(Debug)]
pub struct RingReader<F = File> {
    path: PathBuf,
    file: F,
    header: Header,
    first_slot: u64,
    /// The next step wanted.
    next: u64,
    /// Steps before it that were passed over since the last that was read.
    passed: u64,
    device_and_inode: (u64, u64),
}

impl RingReader<File> {
    /// Opens a block's ring; reading begins with the oldest step that is there.
    ///
    /// # Errors
    /// No ring, somebody else's, of another version, torn, larger than `limits`.
    pub fn open(ring: &Path, block: u32, limits: &Limits) -> Result<Self, WireError> {
        let path = block_path(ring, block);
        let file = open_private(&path, true)?;
        let about = file.metadata().map_err(|e| WireError::io(&path, "cannot be looked at", e))?;
        let mut reader = Self::over(path, file, limits)?;
        reader.device_and_inode = (about.dev(), about.ino());
        let found = reader.header.description.block.index;
        if found != block {
            return Err(WireError::Block { block, found: format!("its ring says block {found}"), accepted: "its own number".into() });
        }
        Ok(reader)
    }

    /// Whether the file at the path is still this one: a producer that starts anew puts another in its place.
    pub fn is_current(&self) -> bool {
        std::fs::symlink_metadata(&self.path).is_ok_and(|now| (now.dev(), now.ino()) == self.device_and_inode)
    }
}

impl<F: ReadAt> RingReader<F> {
    /// A ring in any bytes; `path` appears in errors.
    ///
    /// # Errors
    /// Those of [`RingReader::open`], but for owner and mode.
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
        // Before memory is taken for it.
        if length < needed {
            return Err(WireError::Short { what: "the ring", found: length, needed });
        }
        let mut description = vec![0; bytes];
        file.read_at(&mut description, DESCRIPTION as u64).map_err(failed)?;
        let (header, first_slot) = Header::decode(&fixed, &description, length, limits)?;
        let mut reader = Self { path, file, header, first_slot, next: 0, passed: 0, device_and_inode: (0, 0) };
        reader.next = reader.word(PUBLISHED)?.saturating_sub(u64::from(reader.header.slots));
        Ok(reader)
    }

    /// What the ring says of itself.
    pub fn header(&self) -> &Header {
        &self.header
    }

    /// Reads the oldest step that was not read yet and is still there: its components, one behind the other, x fastest, in native f32. Where the producer
    /// overtakes the reading, the newest one instead, which will be there for longest. `values` keeps its memory from call to call.
    ///
    /// # Errors
    /// The file went away or was cut short; its counts run backwards.
    pub fn read(&mut self, values: &mut Vec<f32>) -> Result<Read, WireError> {
        self.read_beside(values, &mut |_| true).map(|found| found.unwrap_or(Read::Nothing))
    }

    /// The same, with `beside` asked after each piece of the values whether to go on; none: it broke off, and nothing was taken.
    pub(crate) fn read_beside(&mut self, values: &mut Vec<f32>, beside: &mut dyn FnMut(&Self) -> bool) -> Result<Option<Read>, WireError> {
        let slots = u64::from(self.header.slots);
        let began = self.next;
        // Not `next` itself, which the producer is told of meanwhile.
        let mut number = began;
        // Before the count is read: no step can come after it.
        let ended = self.is_closed()?;
        for _ in 0..ATTEMPTS {
            let published = self.word(PUBLISHED)?;
            if published < began {
                return Err(self.ran_back(published, began));
            }
            number = number.max(published.saturating_sub(slots));
            if number >= published {
                // What was overwritten while it was read counts as missed by the step that comes.
                return Ok(Some(if number == began && ended { Read::Ended } else { Read::Nothing }));
            }
            match self.try_slot(number, values, beside)? {
                Tried::Step(mut info) => {
                    info.missed = number - began;
                    self.next = number + 1;
                    return Ok(Some(Read::Step(info)));
                }
                Tried::BrokenOff => return Ok(None),
                Tried::Overwritten => number = (number + 1).max(self.word(PUBLISHED)?.saturating_sub(1)),
            }
        }
        // The producer is faster than any reading; what else is to be done comes first.
        Ok(Some(Read::Nothing))
    }

    /// Numbers of the steps that the ring holds; the first may be overwritten at this moment.
    pub(crate) fn there(&self) -> Result<std::ops::Range<u64>, WireError> {
        let published = self.word(PUBLISHED)?;
        if published < self.next {
            return Err(self.ran_back(published, self.next));
        }
        Ok(published.saturating_sub(u64::from(self.header.slots))..published)
    }

    /// What stands where a step was published.
    pub(crate) fn look_at(&self, number: u64) -> Result<Found, WireError> {
        let head = self.any_head(number)?;
        if head[0] == sequence(number) {
            return Ok(Found::Step(head[1]));
        }
        // The slot's next step has come, or is being written: either is seen, and what was there before the step is no sign of that.
        let slots = u64::from(self.header.slots);
        let is_over = head[0] > sequence(number) || self.word(PUBLISHED)? >= number.saturating_add(slots);
        Ok(if is_over { Found::Overwritten } else { Found::Unseen })
    }

    /// Reads this step and no other, as [`Self::read_beside`] does. What is before it counts as missed.
    pub(crate) fn take(&mut self, number: u64, values: &mut Vec<f32>, beside: &mut dyn FnMut(&Self) -> bool) -> Result<Tried, WireError> {
        let mut tried = self.try_slot(number, values, beside)?;
        if let Tried::Step(info) = &mut tried {
            self.pass(number);
            info.missed = std::mem::take(&mut self.passed);
            self.next = number + 1;
        }
        Ok(tried)
    }

    /// Wants nothing before a step any more; whether that changes anything.
    pub(crate) fn pass(&mut self, number: u64) -> bool {
        let passed = number.saturating_sub(self.next);
        (self.next, self.passed) = (self.next + passed, self.passed + passed);
        passed > 0
    }

    /// Tells the producer that this follower has taken all steps before the next, and lives. Which of the 64 marks is its own says
    /// [`crate::Following::mark`].
    ///
    /// # Errors
    /// The file cannot be written, or was cut short.
    pub fn acknowledge(&self, mark: u32) -> Result<(), WireError> {
        self.put_mark(mark, system::monotonic())
    }

    /// Tells the producer that this follower goes: nobody waits for it any more.
    ///
    /// # Errors
    /// The file cannot be written, or was cut short.
    pub fn leave(&self, mark: u32) -> Result<(), WireError> {
        // Long ago.
        self.put_mark(mark, 1)
    }

    /// A ring that was given up is empty. Its length is looked at before anything is written, which would make it long again.
    ///
    /// # Errors
    /// It is shorter than its header says.
    fn check_whole(&self) -> Result<(), WireError> {
        let needed = self.first_slot + self.header.stride() * u64::from(self.header.slots);
        let length = self.file.length().map_err(|e| WireError::io(&self.path, "cannot be looked at", e))?;
        if length < needed {
            return Err(WireError::io(&self.path, CUT_SHORT, std::io::ErrorKind::UnexpectedEof.into()));
        }
        Ok(())
    }

    /// The error of a count below one that was seen; of a ring that was cut short, and made longer by a mark, that.
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

    /// Whether the producer has closed the ring: what is read of it afterwards is all that it will ever hold.
    pub fn is_closed(&self) -> Result<bool, WireError> {
        Ok(self.word(STATE)? == ENDED)
    }

    fn slot(&self, number: u64) -> u64 {
        self.first_slot + number % u64::from(self.header.slots) * self.header.stride()
    }

    /// The head of a step's slot in words, whatever step it holds.
    fn any_head(&self, number: u64) -> Result<[u64; 4], WireError> {
        let mut head = [0; 32];
        self.read_bytes(&mut head, self.slot(number))?;
        Ok([0, 1, 2, 3].map(|k| u64::from_ne_bytes(head.as_chunks::<8>().0[k])))
    }

    /// The head of a step's slot; none: it holds another step, or is being written.
    fn head(&self, number: u64) -> Result<Option<[u64; 4]>, WireError> {
        Ok(Some(self.any_head(number)?).filter(|words| words[0] == sequence(number)))
    }

    fn try_slot(&self, number: u64, values: &mut Vec<f32>, beside: &mut dyn FnMut(&Self) -> bool) -> Result<Tried, WireError> {
        let slot = self.slot(number);
        // At most what the limits allow: the header was checked.
        let count = (self.header.description.block_bytes() / 4) as usize;
        let Some(head) = self.head(number)? else { return Ok(Tried::Overwritten) };
        fence(Ordering::Acquire);
        let (mut place, mut broken_off) = (slot + SLOT_HEADER as u64, false);
        let is_whole = fill(values, count, |piece| {
            self.read_bytes(piece, place)?;
            place += piece.len() as u64;
            broken_off = !beside(self);
            // All values so far before another look at the number.
            fence(Ordering::Acquire);
            Ok(!broken_off && self.head(number)?.is_some())
        })?;
        if !is_whole {
            return Ok(if broken_off { Tried::BrokenOff } else { Tried::Overwritten });
        }
        let time = f64::from_bits(head[2]);
        if !time.is_finite() {
            return Err(WireError::field("time", time, "a finite number"));
        }
        Ok(Tried::Step(StepInfo { number, step: head[1], time, published: head[3], missed: 0 }))
    }

    /// A word of the producer's: what it wrote before that is seen by whatever is read after.
    fn word(&self, offset: usize) -> Result<u64, WireError> {
        let mut bytes = [0; 8];
        self.read_bytes(&mut bytes, offset as u64)?;
        fence(Ordering::Acquire);
        Ok(u64::from_ne_bytes(bytes))
    }

    fn read_bytes(&self, to: &mut [u8], offset: u64) -> Result<(), WireError> {
        self.file.read_at(to, offset).map_err(|e| WireError::io(&self.path, CUT_SHORT, e))
    }
}

/// What stands at the head of a slot that holds this step, whole.
fn sequence(number: u64) -> u64 {
    number.wrapping_mul(2).wrapping_add(2)
}
