//! Little-endian encoding, and the transfer of a step's values in pieces.

use crate::WireError;

/// Bytes of a piece of values. Between two pieces, heartbeats are sent and a stop request is noticed.
pub(crate) const PIECE: usize = 1 << 20;

/// Fills `values` with `count` values, piece by piece. The first touch of fresh memory, which may take longer than the transfer, happens piece by piece too.
/// Returns false if `next` did: the transfer was stopped.
///
/// # Errors
/// There is no memory for all values; and those of `next`.
pub(crate) fn fill(
    values: &mut Vec<f32>,
    count: usize,
    mut next: impl FnMut(&mut [u8]) -> Result<bool, WireError>,
) -> Result<bool, WireError> {
    values.truncate(count);
    let missing = count - values.len();
    values.try_reserve_exact(missing).map_err(|_| WireError::no_memory(4 * missing))?;
    for start in (0..count).step_by(PIECE / 4) {
        let end = count.min(start + PIECE / 4);
        if values.len() < end {
            values.resize(end, 0.0);
        }
        let piece = &mut values[start..end];
        // SAFETY: any bytes are valid f32 values, and the length is theirs.
        let bytes = unsafe { std::slice::from_raw_parts_mut(piece.as_mut_ptr().cast::<u8>(), size_of_val(piece)) };
        if !next(bytes)? {
            return Ok(false);
        }
    }
    Ok(true)
}

/// Reads values from the front of some bytes.
pub(crate) struct Parser<'a> {
    what: &'static str,
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Parser<'a> {
    pub fn new(what: &'static str, bytes: &'a [u8]) -> Self {
        Self { what, bytes, at: 0 }
    }

    pub fn take(&mut self, count: usize) -> Result<&'a [u8], WireError> {
        let end = self.at.saturating_add(count);
        let taken =
            self.bytes.get(self.at..end).ok_or(WireError::Short { what: self.what, found: self.bytes.len() as u64, needed: end as u64 })?;
        self.at = end;
        Ok(taken)
    }

    pub fn array<const N: usize>(&mut self) -> Result<[u8; N], WireError> {
        let mut array = [0; N];
        array.copy_from_slice(self.take(N)?);
        Ok(array)
    }

    pub fn u32(&mut self) -> Result<u32, WireError> {
        self.array().map(u32::from_le_bytes)
    }

    pub fn u64(&mut self) -> Result<u64, WireError> {
        self.array().map(u64::from_le_bytes)
    }

    pub fn f64(&mut self) -> Result<f64, WireError> {
        self.array().map(f64::from_le_bytes)
    }

    pub fn three(&mut self) -> Result<[u64; 3], WireError> {
        Ok([self.u64()?, self.u64()?, self.u64()?])
    }

    /// Reads a text: its length in bytes, then UTF-8.
    pub fn text(&mut self, field: &'static str, longest: usize) -> Result<String, WireError> {
        let length = self.u32()? as usize;
        if length > longest {
            return Err(WireError::field(field, format_args!("{length} bytes long"), format!("at most {longest} bytes")));
        }
        let text = std::str::from_utf8(self.take(length)?).map_err(|_| WireError::field(field, "not UTF-8", "UTF-8"))?;
        match text.chars().find(|c| c.is_control()) {
            Some(c) => Err(WireError::field(field, format_args!("{text:?} with {c:?}"), "text without control characters")),
            None => Ok(text.to_owned()),
        }
    }

    /// Reads a version and compares it with the supported one.
    pub fn version(&mut self, known: u32) -> Result<(), WireError> {
        match self.u32()? {
            found if found == known => Ok(()),
            found => Err(WireError::Version { what: self.what, found, known }),
        }
    }

    /// Checks that no bytes are left.
    pub fn end(&self) -> Result<(), WireError> {
        if self.at == self.bytes.len() {
            return Ok(());
        }
        Err(WireError::field("length", format_args!("{} bytes of {}", self.bytes.len(), self.what), format!("{} bytes", self.at)))
    }
}

/// Writes values one after another.
#[derive(Default)]
pub(crate) struct Writer(pub Vec<u8>);

impl Writer {
    pub fn u32(&mut self, value: u32) {
        self.0.extend_from_slice(&value.to_le_bytes());
    }

    pub fn u64(&mut self, value: u64) {
        self.0.extend_from_slice(&value.to_le_bytes());
    }

    pub fn f64(&mut self, value: f64) {
        self.0.extend_from_slice(&value.to_le_bytes());
    }

    pub fn three(&mut self, values: [u64; 3]) {
        values.into_iter().for_each(|v| self.u64(v));
    }

    pub fn text(&mut self, text: &str) {
        self.u32(text.len() as u32);
        self.0.extend_from_slice(text.as_bytes());
    }
}

/// FNV-1a, 64 bits: distinguishes a torn header from a complete one. Owner and mode of the file protect against intent.
///
/// Not BLAKE3: the field is 64 bits of layout version 2, which solvers of earlier builds write, and the libraries that solvers link contain no cryptography.
pub(crate) fn checksum(parts: &[&[u8]]) -> u64 {
    let mix = |sum: u64, byte: &u8| (sum ^ u64::from(*byte)).wrapping_mul(0x0000_0100_0000_01b3);
    parts.iter().flat_map(|part| part.iter()).fold(0xcbf2_9ce4_8422_2325, mix)
}
