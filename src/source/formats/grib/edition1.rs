//! Messages of edition 1. Octets are counted from 0 here, from 1 in the manual.

use super::super::limits::Limits;
use super::super::messages::FormatFault;
use super::date;
use super::grid::Grid;
use super::input::Input;
use super::message::{Kind, Message, Place, Process, damaged, signed, unit_fault, unit_seconds, unsigned};
use super::names::{ISOBARIC, Levels, Parameter};
use super::packing::REPACK;

/// Bytes of a section that are read: no more are needed.
const SECTION_BYTES: usize = 256;
/// Section 5: `7777`.
const END: u64 = 4;

/// Reads the headers of the message at `begin`. Returns its end.
pub fn read(input: &mut Input<'_>, begin: u64, all: &mut Vec<Message>, limits: &Limits) -> Result<u64, FormatFault> {
    let damaged = |what: &str| damaged(begin, what);
    let stated = u64::from(unsigned(&input.bytes::<8>(begin)?[4..7]));
    let mut at = begin + 8;
    let product =
        section(input, &mut at, 28).map_err(|fault| fault.unwrap_or_else(|| damaged("its section 1 is shorter than 28 bytes")))?;
    let (has_grid, has_bitmap) = (product[7] & 0x80 != 0, product[7] & 0x40 != 0);
    let grid = if has_grid {
        let grid = section(input, &mut at, 6).map_err(|fault| fault.unwrap_or_else(|| damaged("its section 2 is too short")))?;
        Grid::of_edition1(&grid)
    } else {
        Grid::Other(format!("its grid is number {} of a catalogue and not described", product[6]))
    };
    let mut fault = None;
    let bitmap = if has_bitmap {
        let from = at;
        let head = section(input, &mut at, 6).map_err(|fault| fault.unwrap_or_else(|| damaged("its section 3 is too short")))?;
        if unsigned(&head[4..6]) != 0 {
            fault = Some(format!("its bitmap is number {} of a catalogue", unsigned(&head[4..6])));
        }
        Some((from + 6, at - from - 6))
    } else {
        None
    };
    let head = input.bytes::<11>(at)?;
    let length = u64::from(unsigned(&head[..3]));
    // A length beyond 2^23 is counted in units of 120 bytes, and the section says by how much it is too long. This is no part of the
    // standard, but what ECMWF writes.
    let long = stated & 0x80_0000 != 0 && length < 120;
    let end = if long { (begin + (stated & 0x7f_ffff) * 120 + END).saturating_sub(length) } else { begin + stated };
    if end > input.length {
        return Err(FormatFault::Truncated { expected: end, found: input.length });
    }
    let data_end = if long { end.saturating_sub(END) } else { at + length };
    if data_end < at + 11 || data_end + END > end {
        return Err(damaged("its section 4 does not end where the message does"));
    }
    if input.bytes::<4>(end - END)? != *b"7777" {
        return Err(damaged("it does not end with 7777"));
    }
    let packing = head[3];
    if packing & 0x80 != 0 {
        fault = Some("it holds spherical harmonics".into());
    } else if packing & 0x50 != 0 {
        fault = Some(format!("it has second-order packing, or several values at a point: {REPACK}"));
    }
    let (time, process) = match times(&product) {
        Ok(both) => both,
        Err(what) => {
            fault = Some(what);
            (0, None)
        }
    };
    let (levels, level) = level(product[9], &product[10..12]);
    let kind = Kind { parameter: Parameter::of_edition1(product[4], product[3], product[8]), levels, process, grid };
    let place =
        Place { begin, description: (at, 11), bitmap, data: (at + 11, data_end - at - 11), decimal: Some(signed(&product[26..28]) as i16) };
    Message { kind, time, member: member(&product), level, place, fault }.add(all, limits)?;
    Ok(end)
}

/// The first bytes of the section at `at`, at least `least`, which moves behind it. The error is `None` if it is shorter.
fn section(input: &mut Input<'_>, at: &mut u64, least: usize) -> Result<Vec<u8>, Option<FormatFault>> {
    let length = unsigned(&input.bytes::<3>(*at)?) as usize;
    let bytes = input.some(*at, length.min(SECTION_BYTES))?.to_vec();
    *at += length as u64;
    if length < least {
        return Err(None);
    }
    if bytes.len() < length.min(SECTION_BYTES) {
        return Err(Some(FormatFault::Truncated { expected: *at, found: input.length }));
    }
    Ok(bytes)
}

/// The time for which a field is valid, and the process over several times (code tables 4 and 5).
fn times(product: &[u8]) -> Result<(i64, Option<Process>), String> {
    let [year, century] = [product[12], product[24]].map(i64::from);
    let [month, day, hour, minute] = [13, 14, 15, 16].map(|at| i64::from(product[at]));
    let date = [(century - 1) * 100 + year, month, day, hour, minute, 0];
    let reference = date::seconds(date).ok_or_else(|| format!("{date:?} is no date"))?;
    let unit = match product[17] {
        13 => 15 * 60,
        14 => 30 * 60,
        254 => 1,
        code => unit_seconds(code).ok_or_else(|| unit_fault(code))?,
    };
    let [first, second] = [product[18], product[19]].map(i64::from);
    let (steps, process) = match product[20] {
        0 => (first, None),
        1 => (0, None),
        10 => (first << 8 | second, None),
        2 => (second, None),
        3 => (second, Some(Process::Statistic(0))),
        4 => (second, Some(Process::Statistic(1))),
        5 => (second, Some(Process::Statistic(4))),
        code => return Err(format!("its time range indicator {code} is not understood; accepted are 0 to 5 and 10")),
    };
    Ok((reference + steps * unit, process))
}

/// The type of level in the words of edition 2, and its value (code table 3).
fn level(kind: u8, value: &[u8]) -> (Levels, f64) {
    let single = |code: u8, divisor: f64| (Levels { code, second: 255, valued: true }, f64::from(unsigned(value)) / divisor);
    match kind {
        1..=9 => (Levels { code: kind, second: 255, valued: false }, 0.0),
        102 => (Levels { code: 101, second: 255, valued: false }, 0.0),
        200 => (Levels { code: 10, second: 255, valued: false }, 0.0),
        100 => single(ISOBARIC, 1.0),
        210 => single(ISOBARIC, 100.0),
        103 => single(102, 1.0),
        105 => single(103, 1.0),
        107 => single(104, 10_000.0),
        109 => single(105, 1.0),
        111 => single(106, 100.0),
        113 => single(107, 1.0),
        160 => single(160, 1.0),
        // Mostly layers: a number that tells them apart.
        _ => (Levels { code: 255, second: kind, valued: true }, f64::from(unsigned(value))),
    }
}

/// The number of a member of an ensemble of ECMWF, from its local descriptions 1, 30 and 36.
fn member(product: &[u8]) -> u32 {
    let described = product[4] == 98 && matches!(product.get(40), Some(1 | 30 | 36));
    product.get(49).copied().filter(|_| described).unwrap_or(0).into()
}
