//! Layout of a ring file, and its checks. Little-endian; offsets in bytes.
//!
//! | offset | content |
//! |---|---|
//! | 0 | magic `RIDGERNG`, version u32, bytes of the description u32 |
//! | 16 | bytes of the file u64, slots u32, components u32, bytes from slot to slot u64, offset of the first slot u64 |
//! | 48 | producer id u64 (random), generation u64 (time of the opening, nanoseconds since 1970), process id u64, checksum u64 of 0..72 and the description |
//! | 1024 | steps published u64, state u64 (1 open, 2 ended), steps that overwrote an untaken one u64 |
//! | 4096 | 64 marks, each written by one follower: steps taken u64, heartbeat u64 (nanoseconds, CLOCK_MONOTONIC; 0: no follower) |
//! | 8192 | the description |
//! | slots | sequence u64 (2n + 1 while step n is written, 2n + 2 when it is complete), step number u64, time f64, published at u64 (nanoseconds since 1970); from 64 on the components as f32, one after another, x fastest |

use crate::bytes::{Parser, Writer, checksum};
use crate::{Description, Limits, WireError};

/// First bytes of a ring.
pub const MAGIC: [u8; 8] = *b"RIDGERNG";
/// Version of the layout.
pub const VERSION: u32 = 2;
/// Most slots of a ring.
pub(crate) const MAX_SLOTS: u32 = 4096;
/// Bytes before the checksum.
const SUMMED: usize = 72;
/// Bytes of the fixed part.
pub(crate) const FIXED: usize = 80;
pub(crate) const PUBLISHED: usize = 1024;
pub(crate) const STATE: usize = 1032;
pub(crate) const OVERWRITTEN: usize = 1040;
/// Offset of the first follower's mark: steps taken, heartbeat.
pub(crate) const MARK: usize = 4096;
/// Bytes from mark to mark.
pub(crate) const MARK_BYTES: usize = 16;
/// Most followers of one ring.
pub(crate) const MARKS: u32 = 64;
pub(crate) const DESCRIPTION: usize = 8192;
/// Bytes of a slot before its values.
pub(crate) const SLOT_HEADER: usize = 64;
pub(crate) const OPEN: u64 = 1;
pub(crate) const ENDED: u64 = 2;
const PAGE: u64 = 4096;
/// Most bytes of a description: three axes and their texts.
pub(crate) const DESCRIPTION_BYTES: u32 = 25 << 20;

/// Header of a ring.
#[derive(Debug, Clone, PartialEq)]
pub struct Header {
    /// The published field.
    pub description: Description,
    /// Number of steps that the ring holds.
    pub slots: u32,
    /// Random number of this opening.
    pub producer: u64,
    /// Time of the opening, nanoseconds since 1970.
    pub generation: u64,
    /// Process id of the producer.
    pub pid: u64,
}

impl Header {
    /// Bytes from slot to slot.
    pub(crate) fn stride(&self) -> u64 {
        (SLOT_HEADER as u64).saturating_add(self.description.block_bytes()).div_ceil(PAGE).saturating_mul(PAGE)
    }

    /// Bytes of the file, and the offset of the first slot.
    pub(crate) fn extent(&self, description_bytes: usize) -> (u64, u64) {
        let first = (DESCRIPTION as u64 + description_bytes as u64).div_ceil(PAGE) * PAGE;
        (first.saturating_add(self.stride().saturating_mul(u64::from(self.slots))), first)
    }

    /// The fixed part, the description, the bytes of the whole file and the offset of the first slot.
    ///
    /// # Errors
    /// No memory.
    pub(crate) fn encode(&self) -> Result<(Vec<u8>, Vec<u8>, u64, u64), WireError> {
        let description = self.description.encode()?;
        let (total, first) = self.extent(description.len());
        let mut out = Writer(MAGIC.to_vec());
        out.u32(VERSION);
        out.u32(description.len() as u32);
        out.u64(total);
        out.u32(self.slots);
        out.u32(self.description.components() as u32);
        out.u64(self.stride());
        out.u64(first);
        out.u64(self.producer);
        out.u64(self.generation);
        out.u64(self.pid);
        let sum = checksum(&[&out.0, &description]);
        out.u64(sum);
        Ok((out.0, description, total, first))
    }

    /// Bytes of the description, as the fixed part announces them.
    pub(crate) fn description_bytes(fixed: &[u8; FIXED]) -> Result<usize, WireError> {
        let mut input = Parser::new("the ring", fixed);
        let found = input.array()?;
        if found != MAGIC {
            return Err(WireError::NotARing { found });
        }
        input.version(VERSION)?;
        let bytes = input.u32()?;
        if bytes > DESCRIPTION_BYTES {
            return Err(WireError::TooLarge { what: "the description", needed: bytes.into(), limit: DESCRIPTION_BYTES.into() });
        }
        Ok(bytes as usize)
    }

    /// Checks both parts against each other and against the length of the file. Returns the header and the offset of the first slot.
    pub(crate) fn decode(fixed: &[u8; FIXED], description: &[u8], file: u64, limits: &Limits) -> Result<(Self, u64), WireError> {
        Self::description_bytes(fixed)?;
        let mut input = Parser::new("the header", &fixed[16..]);
        let (total, slots, components) = (input.u64()?, input.u32()?, input.u32()?);
        let (stride, first) = (input.u64()?, input.u64()?);
        let (producer, generation, pid, sum) = (input.u64()?, input.u64()?, input.u64()?, input.u64()?);
        let computed = checksum(&[&fixed[..SUMMED], description]);
        if sum != computed {
            return Err(WireError::Checksum { found: sum, computed });
        }
        if !(2..=MAX_SLOTS).contains(&slots) {
            return Err(WireError::field("slots", slots, format!("2 to {MAX_SLOTS}")));
        }
        let bytes = description.len();
        let description = Description::decode(description, limits)?;
        if components as usize != description.components() {
            return Err(WireError::field("components", components, format!("{}, as many as axes", description.components())));
        }
        let header = Self { description, slots, producer, generation, pid };
        let (needed, begin) = header.extent(bytes);
        if (total, stride, first) != (needed, header.stride(), begin) {
            let found = format!("{total} bytes, {stride} a slot from {first}");
            return Err(WireError::field("lengths", found, format!("{needed} bytes, {} a slot from {begin}", header.stride())));
        }
        if file < needed {
            return Err(WireError::Short { what: "the ring", found: file, needed });
        }
        Ok((header, first))
    }
}
