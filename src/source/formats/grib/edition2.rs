//! Messages of edition 2, which may hold several fields: sections 3 to 7 may repeat. Octets are counted from 0 here, from 1 in the manual.

use super::super::limits::Limits;
use super::super::messages::FormatFault;
use super::date;
use super::grid::Grid;
use super::input::Input;
use super::message::{Kind, Message, Place, Process, Span, damaged, signed, unit_fault, unit_seconds, unsigned};
use super::names::{ISOBARIC, Levels, Parameter};
use super::packing::unread_template;

/// Bytes of a section that are read: no more are needed.
const SECTION_BYTES: u32 = 256;
/// Section 8: `7777`.
const END: u64 = 4;

/// What sections 1 to 6 said before the values come.
#[derive(Default)]
struct State {
    reference: Option<Result<i64, String>>,
    grid: Option<Grid>,
    product: Option<Vec<u8>>,
    /// Section 5, and why it cannot be read.
    packing: Option<(Span, Option<String>)>,
    /// Section 6: the bitmap, if there is one.
    bitmap: Option<Option<Span>>,
    /// The last bitmap that the message holds.
    defined: Option<Span>,
    /// A bitmap that it does not hold.
    foreign: Option<u8>,
}

/// Reads the headers of the message at `begin`. Returns its end.
pub fn read(input: &mut Input<'_>, begin: u64, all: &mut Vec<Message>, limits: &Limits) -> Result<u64, FormatFault> {
    let head = input.bytes::<16>(begin)?;
    let discipline = head[6];
    let [.., a, b, c, d, e, f, g, h] = head;
    let length = u64::from_be_bytes([a, b, c, d, e, f, g, h]);
    let end = begin.checked_add(length).ok_or_else(|| damaged(begin, "its length overflows"))?;
    if end > input.length {
        return Err(FormatFault::Truncated { expected: end, found: input.length });
    }
    let mut state = State::default();
    let mut at = begin + 16;
    while at + END < end {
        let head = input.bytes::<5>(at)?;
        let (length, number) = (unsigned(&head[..4]), head[4]);
        let next = at + u64::from(length);
        let bytes = input.some(at, length.min(SECTION_BYTES) as usize)?.to_vec();
        let least = match number {
            1 => 21,
            3 => 14,
            4 => 11,
            5 => 11,
            6 => 6,
            _ => 5,
        };
        if length < least || next + END > end || bytes.len() < least as usize {
            return Err(damaged(begin, format!("its section {number} has {length} bytes, which does not fit")));
        }
        match number {
            1 => {
                let [month, day, hour, minute, second] = [14, 15, 16, 17, 18].map(|at| i64::from(bytes[at]));
                let date = [unsigned(&bytes[12..14]).into(), month, day, hour, minute, second];
                state.reference = Some(date::seconds(date).ok_or_else(|| format!("{date:?} is no date")));
            }
            2 => {}
            3 => state.grid = Some(Grid::of_edition2(&bytes)),
            4 => state.product = Some(bytes),
            5 => state.packing = Some(((at, length.min(SECTION_BYTES).into()), unread_template(unsigned(&bytes[9..11])))),
            6 => {
                state.foreign = None;
                state.bitmap = Some(match bytes[5] {
                    0 => {
                        state.defined = Some((at + 6, u64::from(length) - 6));
                        state.defined
                    }
                    255 => None,
                    254 => Some(state.defined.ok_or_else(|| damaged(begin, "it refers to a bitmap before that it does not hold"))?),
                    other => {
                        state.foreign = Some(other);
                        None
                    }
                });
            }
            7 => state.field(begin, discipline, (at + 5, u64::from(length) - 5))?.add(all, limits)?,
            _ => return Err(damaged(begin, format!("its section {number} is unknown"))),
        }
        at = next;
    }
    if at + END != end || input.bytes::<4>(at)? != *b"7777" {
        return Err(damaged(begin, "it does not end with 7777"));
    }
    Ok(end)
}

impl State {
    fn field(&self, begin: u64, discipline: u8, data: Span) -> Result<Message, FormatFault> {
        let (Some(reference), Some(grid), Some(product), Some((description, unread)), Some(bitmap)) =
            (&self.reference, &self.grid, &self.product, &self.packing, &self.bitmap)
        else {
            return Err(damaged(begin, "its values come before the sections that describe them"));
        };
        let mut fault = unread.clone();
        if let Some(number) = self.foreign {
            fault = Some(format!("its bitmap is number {number} of a catalogue"));
        }
        let product = match Product::of(product) {
            Ok(product) => product,
            Err(what) => {
                fault = Some(what);
                // At the same place in every template, so that the parameter is told by its name.
                Product { category: product[9], number: product[10], ..Product::default() }
            }
        };
        let time = reference.clone().and_then(|reference| match product.end {
            Some(end) => date::seconds(end).ok_or_else(|| format!("{end:?} is no date")),
            None => Ok(reference + product.step),
        });
        let time = time.unwrap_or_else(|what| {
            fault = Some(what);
            0
        });
        let Product { category, number, process, member, levels, level, .. } = product;
        let kind = Kind { parameter: Parameter::of_edition2([discipline, category, number]), levels, process, grid: grid.clone() };
        let place = Place { begin, description: *description, bitmap: *bitmap, data, decimal: None };
        Ok(Message { kind, time, member, level, place, fault })
    }
}

/// Section 4.
struct Product {
    category: u8,
    number: u8,
    process: Option<Process>,
    member: u32,
    levels: Levels,
    level: f64,
    /// Seconds since the reference time.
    step: i64,
    /// End of the interval of a statistical process.
    end: Option<[i64; 6]>,
}

impl Default for Product {
    fn default() -> Self {
        let levels = Levels { code: 255, second: 255, valued: false };
        Self { category: 255, number: 255, process: None, member: 0, levels, level: 0.0, step: 0, end: None }
    }
}

impl Product {
    /// Templates 4.0, 4.1, 4.2, 4.8, 4.11, 4.12, 4.60 and 4.61: instants and intervals of an analysis, a forecast, a member and a derived
    /// forecast.
    fn of(section: &[u8]) -> Result<Self, String> {
        let template = unsigned(&section[7..9]);
        let short = || format!("its product description {template} has {} bytes only", section.len());
        let bytes = |from: usize, count: usize| section.get(from..from + count).ok_or_else(short);
        // Where the end of an interval is told.
        let (interval, member, derived) = match template {
            0 => (None, false, false),
            1 | 60 => (None, true, false),
            2 => (None, false, true),
            8 => (Some(34), false, false),
            11 => (Some(37), true, false),
            12 => (Some(36), false, true),
            61 => (Some(44), true, false),
            _ => {
                return Err(format!(
                    "its product description {template} is not understood; accepted are instants and intervals of a forecast or a member \
                     (4.0, 4.1, 4.2, 4.8, 4.11, 4.12, 4.60, 4.61)"
                ));
            }
        };
        let code = bytes(17, 1)?[0];
        let unit = if code == 13 { 1 } else { unit_seconds(code).ok_or_else(|| unit_fault(code))? };
        let step = i64::from(signed(bytes(18, 4)?)) * unit;
        let surface = bytes(22, 12)?;
        let (factor, scaled) = (surface[1] as i8, unsigned(&surface[2..6]));
        let valued = !Levels::is_single(surface[0]) && surface[0] != 255 && surface[1] != 255 && scaled != u32::MAX;
        let levels = Levels { code: surface[0], second: surface[6], valued };
        let level = if valued { scale(signed(&surface[2..6]), factor) } else { 0.0 };
        // In hPa, as edition 1 has it.
        let level = if levels.code == ISOBARIC { level / 100.0 } else { level };
        let mut process = if derived { Some(Process::Derived(bytes(34, 1)?[0])) } else { None };
        let mut end = None;
        if let Some(at) = interval {
            let date = bytes(at, 7)?;
            let [month, day, hour, minute, second] = [2, 3, 4, 5, 6].map(|k| i64::from(date[k]));
            end = Some([unsigned(&date[..2]).into(), month, day, hour, minute, second]);
            // Behind the number of time ranges and of missing values.
            process = process.or(Some(Process::Statistic(bytes(at + 12, 1)?[0])));
        }
        let member = if member { bytes(35, 1)?[0].into() } else { 0 };
        Ok(Self { category: section[9], number: section[10], process, member, levels, level, step, end })
    }
}

/// A number times a negative power of ten. The sign of the factor is its first bit.
fn scale(value: i32, factor: i8) -> f64 {
    let factor = signed(&[factor as u8]);
    if factor > 0 { f64::from(value) / 10f64.powi(factor) } else { f64::from(value) * 10f64.powi(-factor) }
}
