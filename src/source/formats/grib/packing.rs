//! Packed values: simple and complex packing, plain numbers; images and CCSDS in [`super::image`].

use super::super::limits::Limits;
use super::image;
use super::message::{Place, signed, unsigned};

/// How the values of a field are packed.
pub struct Packing {
    reference: f64,
    /// Powers of two and ten.
    binary: f64,
    decimal: f64,
    /// Bits of a packed number.
    bits: u32,
    method: Method,
}

enum Method {
    Simple,
    Complex(Groups),
    /// IEEE numbers of four or eight bytes.
    Ieee(usize),
    Jpeg2000,
    Ccsds {
        flags: u8,
        block: u32,
        interval: u32,
    },
    Png,
}

/// Templates 5.2 and 5.3: groups of numbers, each with its minimum and its width in bits.
struct Groups {
    count: usize,
    /// 0: none, 1: the largest number is missing, 2: the largest but one too.
    missing: u8,
    width_reference: u32,
    width_bits: u32,
    length_reference: u64,
    length_increment: u64,
    last_length: u64,
    length_bits: u32,
    /// Order of the differences, and bytes of their first values and minimum.
    order: usize,
    octets: usize,
}

/// Why a way of packing (code table 5.0) cannot be read.
pub fn unread_template(template: u32) -> Option<String> {
    let name = match template {
        0 | 2 | 3 | 4 | 40 | 41 | 42 => return None,
        1 => "matrices",
        50 | 51 => "spherical harmonics",
        53 => "bi-Fourier coefficients",
        61 => "logarithms",
        200 => "run lengths",
        _ => return Some(format!("it is packed in the unknown way {template}: {REPACK}")),
    };
    Some(format!("it is packed as {name}: {REPACK}"))
}

/// What would help.
pub const REPACK: &str = "pack it again, for example with `grib_set -r -s packingType=grid_simple IN OUT`";

impl Packing {
    /// The packing of a field of `count` values. Sections are those that the reader of headers has seen; the file may have changed since.
    pub fn of(place: &Place, section: &[u8], count: usize) -> Result<Self, String> {
        let short = || format!("its description of the packing has {} bytes only", section.len());
        if let Some(decimal) = place.decimal {
            let bytes: &[u8; 11] = section.try_into().map_err(|_| short())?;
            let (binary, reference) = (signed(&bytes[4..6]), ibm(unsigned(&bytes[6..10])));
            return Self::scaled(reference, binary, decimal.into(), bytes[10], Method::Simple);
        }
        let need = |bytes: usize| section.get(..bytes).ok_or_else(short);
        let template = unsigned(&need(11)?[9..11]);
        let stated = unsigned(&section[5..9]) as usize;
        if stated != count {
            return Err(format!("it is said to pack {stated} values, but its grid and its bitmap have {count}"));
        }
        if template == 4 {
            return match need(12)?[11] {
                precision @ (1 | 2) => Self::scaled(0.0, 0, 0, 0, Method::Ieee(4 * usize::from(precision))),
                precision => Err(format!("its numbers are of the unknown precision {precision}")),
            };
        }
        let head = need(21)?;
        let method = match template {
            0 => Method::Simple,
            2 => Method::Complex(Groups::of(need(47)?, 0, 0)),
            3 => Method::Complex(Groups::of(need(49)?, section[47], section[48])),
            40 => Method::Jpeg2000,
            41 => Method::Png,
            42 => {
                let bytes = need(25)?;
                Method::Ccsds { flags: bytes[21], block: bytes[22].into(), interval: unsigned(&bytes[23..25]) }
            }
            _ => return Err(unread_template(template).unwrap_or_default()),
        };
        let reference = f64::from(f32::from_bits(unsigned(&head[11..15])));
        Self::scaled(reference, signed(&head[15..17]), signed(&head[17..19]), head[19], method)
    }

    fn scaled(reference: f64, binary: i32, decimal: i32, bits: u8, method: Method) -> Result<Self, String> {
        if bits > 32 {
            return Err(format!("its packed numbers have {bits} bits; accepted are up to 32"));
        }
        Ok(Self { reference, binary: 2f64.powi(binary), decimal: 10f64.powi(-decimal), bits: bits.into(), method })
    }

    /// All values; NaN where one is missing.
    ///
    /// # Errors
    /// Data that are damaged, or would take more memory than the limits allow.
    pub fn unpack(&self, data: &[u8], count: usize, limits: &Limits) -> Result<Vec<f64>, String> {
        let value = |packed: f64| (self.reference + packed * self.binary) * self.decimal;
        let scaled = |packed: Vec<u32>| packed.into_iter().map(|packed| value(packed.into())).collect();
        // All values are the reference, and nothing is packed.
        let constant = self.bits == 0 && !matches!(self.method, Method::Complex(_) | Method::Ieee(_));
        if constant || count == 0 {
            return Ok(vec![value(0.0); count]);
        }
        match &self.method {
            Method::Simple => {
                let mut bits = Bits::new(data);
                bits.check(count as u64, self.bits)?;
                Ok((0..count).map(|_| value(bits.take(self.bits).into())).collect())
            }
            Method::Complex(groups) => {
                Ok(groups.unpack(data, count, self.bits)?.into_iter().map(|n| n.map_or(f64::NAN, |n| value(n as f64))).collect())
            }
            Method::Ieee(4) => Ok(data.as_chunks().0.iter().take(count).map(|&bytes| f32::from_be_bytes(bytes).into()).collect()),
            Method::Ieee(_) => Ok(data.as_chunks().0.iter().take(count).map(|&bytes| f64::from_be_bytes(bytes)).collect()),
            Method::Jpeg2000 => image::jpeg2000(data, count, limits).map(scaled),
            Method::Png => image::png(data, count).map(scaled),
            Method::Ccsds { flags, block, interval } => image::ccsds(data, count, self.bits as u8, *flags, *block, *interval).map(scaled),
        }
    }
}

impl Groups {
    /// The bytes are those of section 5, at least as many as the template has.
    fn of(section: &[u8], order: u8, octets: u8) -> Self {
        let number = |from: usize| unsigned(&section[from..from + 4]);
        Self {
            count: number(31) as usize,
            missing: section[22],
            width_reference: section[35].into(),
            width_bits: section[36].into(),
            length_reference: number(37).into(),
            length_increment: section[41].into(),
            last_length: number(42).into(),
            length_bits: section[46].into(),
            order: order.into(),
            octets: octets.into(),
        }
    }

    /// The packed numbers; `None` where one is missing. No more memory is taken than for `count` of them.
    fn unpack(&self, data: &[u8], count: usize, reference_bits: u32) -> Result<Vec<Option<i64>>, String> {
        if self.order > 2 || (self.order > 0 && !(1..=4).contains(&self.octets)) || self.missing > 2 {
            let Self { order, octets, missing, .. } = self;
            return Err(format!("differences of order {order} in {octets} bytes and missing values of kind {missing} are not understood"));
        }
        if self.width_bits > 32 || self.length_bits > 32 {
            return Err("its groups are described by numbers of more than 32 bits".into());
        }
        if self.count > count {
            return Err(format!("it has {} groups of {count} values", self.count));
        }
        let head = data.get(..if self.order > 0 { (self.order + 1) * self.octets } else { 0 }).ok_or(SHORT)?;
        let mut bits = Bits::new(&data[head.len()..]);
        let mut references = bits.list(self.count, reference_bits)?;
        let mut widths = bits.list(self.count, self.width_bits)?;
        let mut lengths = bits.list(self.count, self.length_bits)?;
        let mut numbers = Vec::with_capacity(count);
        for group in 0..self.count {
            let reference = references.take(reference_bits);
            let width = self.width_reference.saturating_add(widths.take(self.width_bits));
            let scaled = u64::from(lengths.take(self.length_bits)) * self.length_increment + self.length_reference;
            let length = if group + 1 == self.count { self.last_length } else { scaled };
            if length > (count - numbers.len()) as u64 {
                return Err(format!("its groups hold more than its {count} values"));
            }
            if width > 32 {
                return Err(format!("a group has numbers of {width} bits; accepted are up to 32"));
            }
            bits.check(length, width)?;
            for _ in 0..length {
                let packed = bits.take(width);
                // A group without widths is missing as a whole if its reference is.
                let (number, size) = if width == 0 { (reference, reference_bits) } else { (packed, width) };
                let largest = u32::MAX.checked_shr(32 - size).unwrap_or(0);
                let missing = (0..u32::from(self.missing)).any(|k| number == largest.wrapping_sub(k));
                numbers.push((!missing).then_some(i64::from(reference) + i64::from(packed)));
            }
        }
        if numbers.len() != count {
            return Err(format!("its groups hold {} values, not {count}", numbers.len()));
        }
        if self.order > 0 {
            self.integrate(head, &mut numbers);
        }
        Ok(numbers)
    }

    /// Sums up the differences (regulation 92.9.4): the first values are stored apart, and so is the minimum of the differences.
    fn integrate(&self, head: &[u8], numbers: &mut [Option<i64>]) {
        let stored: Vec<&[u8]> = head.chunks(self.octets).collect();
        let minimum = i64::from(signed(stored[self.order]));
        let (mut before, mut last) = (0i64, 0i64);
        for (place, number) in numbers.iter_mut().flatten().enumerate() {
            let value = match (self.order, place) {
                (order, place) if place < order => i64::from(unsigned(stored[place])),
                (1, _) => number.wrapping_add(minimum).wrapping_add(last),
                _ => number.wrapping_add(minimum).wrapping_add(last.wrapping_mul(2)).wrapping_sub(before),
            };
            (before, last) = (last, value);
            *number = value;
        }
    }
}

const SHORT: &str = "its data end before its last value";

/// Numbers of up to 32 bits, most significant bit first.
#[derive(Clone)]
pub struct Bits<'a> {
    data: &'a [u8],
    /// Bits taken.
    at: u64,
}

impl<'a> Bits<'a> {
    pub fn new(data: &'a [u8]) -> Self {
        Self { data, at: 0 }
    }

    /// Checks that so many numbers follow.
    ///
    /// # Errors
    /// The data end before.
    pub fn check(&self, count: u64, width: u32) -> Result<(), String> {
        let left = (self.data.len() as u64 * 8).saturating_sub(self.at);
        if count.saturating_mul(width.into()) <= left { Ok(()) } else { Err(SHORT.into()) }
    }

    /// The next number; bits behind the end are 0.
    pub fn take(&mut self, width: u32) -> u32 {
        if width == 0 {
            return 0;
        }
        let mut word = [0; 8];
        let rest = self.data.get((self.at / 8) as usize..).unwrap_or_default();
        let some = rest.len().min(8);
        word[..some].copy_from_slice(&rest[..some]);
        let number = (u64::from_be_bytes(word) << (self.at % 8)) >> (64 - width);
        self.at += u64::from(width);
        number as u32
    }

    /// So many numbers, which are left out here, together with the rest of their last byte.
    fn list(&mut self, count: usize, width: u32) -> Result<Self, String> {
        self.check(count as u64, width)?;
        let list = self.clone();
        self.at = (self.at + count as u64 * u64::from(width)).next_multiple_of(8);
        Ok(list)
    }
}

/// Spreads values over the set bits; NaN elsewhere.
pub fn spread(values: &[f64], bitmap: &[u8], points: usize) -> Vec<f64> {
    let mut next = values.iter();
    let there = |k: usize| bitmap[k / 8] & (0x80 >> (k % 8)) != 0;
    (0..points).map(|k| if there(k) { next.next().copied().unwrap_or(f64::NAN) } else { f64::NAN }).collect()
}

/// A number of four bytes as IBM's System/360 has it: a power of 16 and 24 bits of fraction (regulation 92.6.5 of edition 1).
fn ibm(bits: u32) -> f64 {
    let exponent = (bits >> 24 & 0x7f) as i32 - 64;
    let size = f64::from(bits & 0x00ff_ffff) / f64::from(1 << 24) * 16f64.powi(exponent);
    if bits >> 31 == 0 { size } else { -size }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ibm_numbers() {
        for (bits, value) in [(0, 0.0), (0x4110_0000, 1.0), (0xc276_a000, -118.625), (0x4019_999a, 0.100_000_023_841_857_91)] {
            assert_eq!(ibm(bits), value);
        }
    }

    #[test]
    fn bits_are_taken_from_the_most_significant_one() {
        let mut bits = Bits::new(&[0b1010_0110, 0b1111_0000, 0xff, 0xff, 0xff, 0xff, 0x80]);
        assert_eq!([3, 0, 7, 1].map(|width| bits.take(width)), [0b101, 0, 0b001_1011, 1]);
        assert!(bits.list(1, 1).is_ok_and(|mut list| list.take(1) == 1));
        assert_eq!(bits.take(32), u32::MAX);
        assert!(bits.check(8, 1).is_ok() && bits.check(9, 1).is_err() && bits.check(u64::MAX, 32).is_err());
        assert_eq!((bits.take(9), bits.take(5)), (0b1_0000_0000, 0));
    }
}
