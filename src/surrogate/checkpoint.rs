//! Checkpoints in the safetensors format: an 8-byte little-endian header length, a JSON header, then raw little-endian f32. Any
//! safetensors reader opens them; other values (shape, step count, rate) are text under `__metadata__`.
//!
//! A checkpoint is written to a temporary file beside the target and then renamed, so that readers never see a partial file. On reading, the whole
//! file is checked before any state changes.

use super::CheckpointError;
use serde_json::{Map, Value, json};
use std::borrow::Cow;
use std::io::{Read, Write};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::str::FromStr;

/// Format name with the version of the layout.
const FORMAT: &str = "ridgewatch-surrogate-1";
/// Maximum size of a header, in bytes. Headers of this format take a few kilobytes.
const LONGEST_HEADER: u64 = 1 << 20;

/// One tensor of f32.
pub(super) struct Entry<'a> {
    name: String,
    shape: Vec<usize>,
    values: Cow<'a, [f32]>,
}

impl<'a> Entry<'a> {
    pub(super) fn new(name: &str, shape: &[usize], values: impl Into<Cow<'a, [f32]>>) -> Self {
        Self { name: name.into(), shape: shape.to_vec(), values: values.into() }
    }
}

/// FNV-1a over 32-bit words.
fn checksum(words: impl Iterator<Item = u32>) -> u64 {
    words.fold(0xcbf2_9ce4_8422_2325, |sum, word| (sum ^ u64::from(word)).wrapping_mul(0x0000_0100_0000_01b3))
}

/// Contents of a checkpoint file.
pub(super) struct Checkpoint<'a> {
    path: PathBuf,
    notes: Map<String, Value>,
    entries: Vec<Entry<'a>>,
}

impl<'a> Checkpoint<'a> {
    /// Creates an empty checkpoint for a surrogate of this kind.
    pub(super) fn new(kind: &str) -> Self {
        let mut notes = Map::new();
        notes.insert("format".into(), FORMAT.into());
        notes.insert("kind".into(), kind.into());
        Self { path: PathBuf::new(), notes, entries: Vec::new() }
    }

    /// Adds a value as text.
    pub(super) fn note(&mut self, key: &str, text: String) {
        self.notes.insert(key.into(), text.into());
    }

    /// Adds a tensor.
    pub(super) fn push(&mut self, entry: Entry<'a>) {
        self.entries.push(entry);
    }

    /// Writes the file atomically and returns its size in bytes.
    pub(super) fn write(&mut self, path: &Path) -> Result<u64, CheckpointError> {
        let checksum = checksum(self.entries.iter().flat_map(|entry| entry.values.iter().map(|value| value.to_bits())));
        self.note("checksum", format!("{checksum:016x}"));
        let mut header = Map::new();
        header.insert("__metadata__".into(), Value::Object(self.notes.clone()));
        let mut offset = 0;
        for entry in &self.entries {
            let end = offset + 4 * entry.values.len();
            header.insert(entry.name.clone(), json!({"dtype": "F32", "shape": entry.shape, "data_offsets": [offset, end]}));
            offset = end;
        }
        let mut header = Value::Object(header).to_string();
        // The format requires tensors to start at a multiple of 8 bytes, with spaces as padding.
        header.extend(std::iter::repeat_n(' ', header.len().next_multiple_of(8) - header.len()));
        let io = |source| CheckpointError::Io { path: path.into(), source };
        let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
        // Permissions follow the umask; temporary files are otherwise readable by their owner only.
        let mut file = tempfile::Builder::new().permissions(std::fs::Permissions::from_mode(0o666)).tempfile_in(folder).map_err(io)?;
        let mut out = std::io::BufWriter::new(file.as_file_mut());
        let mut write = || -> std::io::Result<()> {
            out.write_all(&(header.len() as u64).to_le_bytes())?;
            out.write_all(header.as_bytes())?;
            for entry in &self.entries {
                for value in entry.values.iter() {
                    out.write_all(&value.to_le_bytes())?;
                }
            }
            out.flush()?;
            out.get_ref().sync_all()
        };
        write().map_err(io)?;
        drop(out);
        file.persist(path).map_err(|fault| io(fault.error))?;
        Ok((8 + header.len() + offset) as u64)
    }

    /// Reads a checkpoint of this kind.
    pub(super) fn read(path: &Path, kind: &str) -> Result<Checkpoint<'static>, CheckpointError> {
        let io = |source| CheckpointError::Io { path: path.into(), source };
        let foreign =
            |found: &str| CheckpointError::Mismatch { path: path.into(), found: found.into(), expected: format!("a {kind} checkpoint") };
        let mut file = ridgewatch_base::files::open(path).map_err(io)?;
        let size = file.metadata().map_err(io)?.len();
        let mut length = [0; 8];
        if size < 8 {
            return Err(foreign(&format!("a file of {size} bytes")));
        }
        file.read_exact(&mut length).map_err(io)?;
        let length = u64::from_le_bytes(length);
        if length > LONGEST_HEADER || 8 + length > size {
            return Err(foreign("no safetensors header, or a truncated one"));
        }
        let mut header = vec![0; length as usize];
        file.read_exact(&mut header).map_err(io)?;
        let Ok(Value::Object(mut header)) = serde_json::from_slice(&header) else {
            return Err(foreign("a header that is not JSON"));
        };
        let Some(Value::Object(notes)) = header.remove("__metadata__") else {
            return Err(foreign("a header without metadata"));
        };
        let mut checkpoint = Checkpoint { path: path.into(), notes, entries: Vec::new() };
        checkpoint.expect_note("format", FORMAT)?;
        checkpoint.expect_note("kind", kind)?;
        let mut data = Vec::new();
        // Allocations are bounded by the size of the file.
        file.read_to_end(&mut data).map_err(io)?;
        let mut used = 0;
        for (name, tensor) in header {
            let shape: Option<Vec<usize>> = serde_json::from_value(tensor["shape"].clone()).ok();
            let range: Option<[usize; 2]> = serde_json::from_value(tensor["data_offsets"].clone()).ok();
            let (Some(shape), Some([begin, end]), Some("F32")) = (shape, range, tensor["dtype"].as_str()) else {
                return Err(foreign(&format!("an unreadable entry `{name}`")));
            };
            let count = shape.iter().try_fold(4_usize, |n, &d| n.checked_mul(d));
            if begin > end || count != Some(end - begin) {
                return Err(foreign(&format!("an entry `{name}` whose size does not match its shape")));
            }
            let Some(bytes) = data.get(begin..end) else {
                return Err(foreign(&format!("a truncated file: entry `{name}` ends at byte {end} of {}", data.len())));
            };
            let values: Vec<f32> = bytes.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
            used += end - begin;
            checkpoint.entries.push(Entry { name, shape, values: values.into() });
        }
        if used != data.len() {
            return Err(foreign(&format!("{} bytes of data, {used} of them named", data.len())));
        }
        let words = data.chunks_exact(4).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]));
        checkpoint.expect_note("checksum", &format!("{:016x}", checksum(words)))?;
        Ok(checkpoint)
    }

    pub(super) fn mismatch(&self, found: String, expected: String) -> CheckpointError {
        CheckpointError::Mismatch { path: self.path.clone(), found, expected }
    }

    fn text(&self, key: &str) -> Option<&str> {
        self.notes.get(key).and_then(Value::as_str)
    }

    /// Fails unless the note has exactly this value.
    pub(super) fn expect_note(&self, key: &str, expected: &str) -> Result<(), CheckpointError> {
        match self.text(key) {
            Some(found) if found == expected => Ok(()),
            found => Err(self.mismatch(format!("{key} {}", found.unwrap_or("missing")), format!("{key} {expected}"))),
        }
    }

    /// Parses a note as a number or another value.
    pub(super) fn number<T: FromStr>(&self, key: &str) -> Result<T, CheckpointError> {
        let text = self.text(key);
        text.and_then(|text| text.parse().ok())
            .ok_or_else(|| self.mismatch(format!("{key} {}", text.unwrap_or("missing")), format!("{key} as a number")))
    }

    /// A tensor of `len` values.
    pub(super) fn values(&self, name: &str, len: usize) -> Result<Vec<f32>, CheckpointError> {
        match self.entries.iter().find(|entry| entry.name == name) {
            Some(entry) if entry.values.len() == len => Ok(entry.values.to_vec()),
            Some(entry) => Err(self.mismatch(format!("{name} of {} values", entry.values.len()), format!("{len} values"))),
            None => Err(self.mismatch(format!("no {name}"), format!("{name} of {len} values"))),
        }
    }
}
