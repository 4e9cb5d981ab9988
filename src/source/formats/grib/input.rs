//! The bytes of a file, read through a window: headers are small and close together.

use super::super::messages::FormatFault;
use std::fs::File;
use std::os::unix::fs::FileExt;

/// Bytes that are read at once.
const WINDOW: u64 = 8192;
/// Most bytes between two messages: paddings, and the headers of bulletins.
const MAX_GAP: u64 = 1 << 16;

pub struct Input<'a> {
    file: &'a File,
    /// Bytes of the file.
    pub length: u64,
    window: Vec<u8>,
    at: u64,
}

impl<'a> Input<'a> {
    pub fn new(file: &'a File, length: u64) -> Self {
        Self { file, length, window: Vec::new(), at: 0 }
    }

    /// Bytes from `offset` on, up to the end of the file.
    ///
    /// # Errors
    /// The operating system refuses, or the file ends before.
    pub fn bytes<const N: usize>(&mut self, offset: u64) -> Result<[u8; N], FormatFault> {
        match self.some(offset, N)?.try_into() {
            Ok(bytes) => Ok(bytes),
            Err(_) => Err(FormatFault::Truncated { expected: offset.saturating_add(N as u64), found: self.length }),
        }
    }

    /// Up to `count` bytes from `offset` on; fewer at the end of the file. `count` is no more than the window.
    pub fn some(&mut self, offset: u64, count: usize) -> Result<&[u8], FormatFault> {
        let end = self.length.min(offset.saturating_add(count as u64));
        if offset >= end {
            return Ok(&[]);
        }
        if offset < self.at || end > self.at + self.window.len() as u64 {
            self.window.resize((self.length - offset).min(WINDOW) as usize, 0);
            self.file.read_exact_at(&mut self.window, offset).map_err(|e| FormatFault::Open(e.to_string()))?;
            self.at = offset;
        }
        Ok(&self.window[(offset - self.at) as usize..(end - self.at) as usize])
    }

    /// The start of the first message from `offset` on; `None` behind the last.
    ///
    /// # Errors
    /// Too much else before.
    pub fn message(&mut self, offset: u64) -> Result<Option<u64>, FormatFault> {
        let mut at = offset;
        while at < self.length.min(offset + MAX_GAP) {
            let bytes = self.some(at, WINDOW as usize)?;
            if let Some(place) = bytes.windows(4).position(|four| four == b"GRIB") {
                return Ok(Some(at + place as u64));
            }
            at += (bytes.len() as u64).saturating_sub(3).max(1);
        }
        if at >= self.length {
            return Ok(None);
        }
        Err(FormatFault::Damaged(format!("no message begins within {MAX_GAP} bytes after byte {offset}, where the one before ends")))
    }
}
