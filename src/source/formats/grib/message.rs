//! One field of a message: what it is of, and where its values lie.

use super::super::guard::more_is_read;
use super::super::limits::Limits;
use super::super::messages::FormatFault;
use super::grid::Grid;
use super::input::Input;
use super::names::{Levels, Parameter};
use super::{edition1, edition2};
use ridgewatch_base::progress::Work;

/// Most fields of a file.
const MAX_FIELDS: usize = 1 << 20;
/// Memory that a field takes until its variable is known.
const FIELD_BYTES: u64 = 1024;

/// Offset in the file and length.
pub type Span = (u64, u64);

/// Where the values of a field lie.
#[derive(Debug, Clone, Copy)]
pub struct Place {
    /// Start of the message.
    pub begin: u64,
    /// How the values are packed: section 5 of edition 2, the first 11 bytes of section 4 of edition 1.
    pub description: Span,
    /// The bits that say which values are there.
    pub bitmap: Option<Span>,
    /// The packed values.
    pub data: Span,
    /// The power of ten of edition 1, whose section 1 has it; `None` for edition 2.
    pub decimal: Option<i16>,
}

impl Place {
    /// Memory for unpacking the values of a grid.
    pub fn bytes(&self, points: usize) -> u64 {
        // Values as f64, once packed and once spread by the bitmap, and whole numbers of four bytes in between.
        self.data.1.saturating_add(self.bitmap.map_or(0, |span| span.1)).saturating_add((points as u64).saturating_mul(20))
    }
}

/// What the fields of one variable have in common.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Kind {
    pub parameter: Parameter,
    pub levels: Levels,
    /// How the field was made from several times or members, if it was.
    pub process: Option<Process>,
    pub grid: Grid,
}

/// Code tables 4.10 (statistical processes) and 4.7 (derived forecasts) of edition 2.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Process {
    Statistic(u8),
    Derived(u8),
}

/// A field as its header describes it.
pub struct Message {
    pub kind: Kind,
    /// Seconds since 1970 for which it is valid.
    pub time: i64,
    pub member: u32,
    /// In the unit of [`Levels`]; 0 without.
    pub level: f64,
    pub place: Place,
    /// Why its values or its time cannot be read.
    pub fault: Option<String>,
}

impl Message {
    /// The fields of all messages.
    ///
    /// # Errors
    /// A message that is cut short or contradicts itself, or too many.
    pub fn all(input: &mut Input<'_>, limits: &Limits) -> Result<Vec<Self>, FormatFault> {
        let mut all: Vec<Self> = Vec::new();
        let mut at = 0;
        let work = Work::begin("reading headers");
        while let Some(begin) = input.message(at)? {
            work.reached(begin as usize, input.length as usize);
            more_is_read();
            let head = input.bytes::<8>(begin)?;
            at = match head[7] {
                1 => edition1::read(input, begin, &mut all, limits)?,
                2 => edition2::read(input, begin, &mut all, limits)?,
                edition => {
                    return Err(FormatFault::Damaged(format!(
                        "the message at byte {begin} is of edition {edition} of GRIB; accepted are 1 and 2"
                    )));
                }
            };
        }
        Ok(all)
    }

    /// Adds a field, unless there are too many. A message of edition 2 may hold fields of five bytes each.
    ///
    /// # Errors
    /// More fields than are accepted, or than memory is granted for.
    pub fn add(self, all: &mut Vec<Self>, limits: &Limits) -> Result<(), FormatFault> {
        if all.len() >= MAX_FIELDS {
            return Err(FormatFault::Refused(format!("it holds more than {MAX_FIELDS} fields; accepted are files of fewer")));
        }
        let bytes = (all.len() as u64 + 1) * FIELD_BYTES;
        if bytes > limits.memory {
            limits.check(bytes, &format!("the headers of {} fields", all.len() + 1)).map_err(FormatFault::Refused)?;
        }
        all.push(self);
        Ok(())
    }
}

/// A message that is damaged.
pub fn damaged(begin: u64, what: impl std::fmt::Display) -> FormatFault {
    FormatFault::Damaged(format!("the message at byte {begin}: {what}"))
}

/// Up to four bytes as a number.
pub fn unsigned(bytes: &[u8]) -> u32 {
    bytes.iter().fold(0, |value, &byte| value << 8 | u32::from(byte))
}

/// Up to four bytes as a number whose first bit is its sign.
pub fn signed(bytes: &[u8]) -> i32 {
    let sign = 1 << (8 * bytes.len() - 1);
    let value = unsigned(bytes);
    let size = (value & (sign - 1)) as i32;
    if value & sign == 0 { size } else { -size }
}

/// Seconds of a unit of code table 4.4 that both editions have.
pub fn unit_seconds(code: u8) -> Option<i64> {
    match code {
        0 => Some(60),
        1 => Some(3600),
        2 => Some(86_400),
        10 => Some(3 * 3600),
        11 => Some(6 * 3600),
        12 => Some(12 * 3600),
        _ => None,
    }
}

/// Why times in a unit cannot be read.
pub fn unit_fault(code: u8) -> String {
    match code {
        3..=7 => "its forecast is counted in months or years, which have no fixed length".into(),
        _ => format!("the unit {code} of its forecast is unknown"),
    }
}
