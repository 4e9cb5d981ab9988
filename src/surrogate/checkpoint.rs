//! Checkpoints in the safetensors format: an 8-byte little-endian header length, a JSON header, then raw little-endian f32. Any
//! safetensors reader opens them; other values (shape, step count, rate) are text under `__metadata__`.
//!
//! A checkpoint is written to `.NAME.part` beside the target, brought to the disk and then renamed, so that readers never see a partial file. A
//! writer that is killed leaves at most that file, which the next one uses again.
//! On reading, the header is checked first, then the size of the file, and only a file of the expected size is read. All of it is checked before
//! any state changes.

use super::CheckpointError;
use ridgewatch_base::folder::Folder;
use serde_json::{Map, Value, json};
use std::borrow::Cow;
use std::ffi::{OsStr, OsString};
use std::fmt::Display;
use std::fs::File;
use std::io::{BufWriter, ErrorKind, Read, Write};
use std::ops::{Range, RangeInclusive};
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

/// A checkpoint file whose header has been read.
pub(super) struct Opened {
    file: File,
    /// Bytes of the values.
    bytes: u64,
    /// Name, shape and bytes of each tensor.
    listed: Vec<(String, Vec<usize>, Range<usize>)>,
    checkpoint: Checkpoint<'static>,
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
        let Some(name) = path.file_name() else { return Err(io(ErrorKind::InvalidInput.into())) };
        let part = [OsStr::new("."), name, OsStr::new(".part")].into_iter().collect::<OsString>();
        let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
        let folder = Folder::open(folder).map_err(io)?;
        let mut file = folder.open_part(&part).map_err(io)?;
        let mut write = || -> std::io::Result<()> {
            let mut out = BufWriter::new(&mut file);
            out.write_all(&(header.len() as u64).to_le_bytes())?;
            out.write_all(header.as_bytes())?;
            for entry in &self.entries {
                for value in entry.values.iter() {
                    out.write_all(&value.to_le_bytes())?;
                }
            }
            out.flush()?;
            out.get_ref().sync_all()?;
            folder.rename(&part, &folder, name)
        };
        write().map_err(|error| {
            // `error` is the one that matters.
            let _ = folder.remove(&part);
            io(error)
        })?;
        // The new name, too, outlives a loss of power, where the file system can bring a folder to the disk; the file is whole in any case.
        let _ = folder.sync();
        Ok((8 + header.len() + offset) as u64)
    }

    /// Reads the header of a checkpoint of this kind.
    pub(super) fn open(path: &Path, kind: &str) -> Result<Opened, CheckpointError> {
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
        let checkpoint = Checkpoint { path: path.into(), notes, entries: Vec::new() };
        checkpoint.expect_note("format", FORMAT)?;
        checkpoint.expect_note("kind", kind)?;
        let bytes = size - 8 - length;
        let (mut listed, mut used) = (Vec::new(), 0_u64);
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
            if end as u64 > bytes {
                return Err(foreign(&format!("a truncated file: entry `{name}` ends at byte {end} of {bytes}")));
            }
            used = used.saturating_add((end - begin) as u64);
            listed.push((name, shape, begin..end));
        }
        if used != bytes {
            return Err(foreign(&format!("{bytes} bytes of data, {used} of them named")));
        }
        Ok(Opened { file, bytes, listed, checkpoint })
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
            Some(found) if let Some((found, wanted)) = differences(found, expected) => Err(self.mismatch(found, wanted)),
            found => Err(self.mismatch(format!("{key} {}", found.unwrap_or("missing")), format!("{key} {expected}"))),
        }
    }

    /// Parses a note as a number or another value.
    pub(super) fn number<T: FromStr>(&self, key: &str) -> Result<T, CheckpointError> {
        let text = self.text(key);
        text.and_then(|text| text.parse().ok())
            .ok_or_else(|| self.mismatch(format!("{key} {}", text.unwrap_or("missing")), format!("{key} as a number")))
    }

    /// Parses a note as a number in a range. NaN is in none.
    pub(super) fn number_in<T: FromStr + PartialOrd + Display>(&self, key: &str, range: RangeInclusive<T>) -> Result<T, CheckpointError> {
        let number: T = self.number(key)?;
        if range.contains(&number) {
            return Ok(number);
        }
        Err(self.mismatch(format!("{key} {number}"), format!("{key} from {} to {}", range.start(), range.end())))
    }

    /// Parses a note as a finite number.
    pub(super) fn finite(&self, key: &str) -> Result<f32, CheckpointError> {
        self.number_in(key, f32::MIN..=f32::MAX)
    }

    /// A tensor of `len` finite values.
    pub(super) fn finite_values(&self, name: &str, len: usize) -> Result<Vec<f32>, CheckpointError> {
        let values = self.values(name, len)?;
        match values.iter().filter(|value| !value.is_finite()).count() {
            0 => Ok(values),
            odd => Err(self.mismatch(format!("{name} with {odd} of {len} values that are not finite"), "finite values".into())),
        }
    }

    /// A tensor of `len` values.
    fn values(&self, name: &str, len: usize) -> Result<Vec<f32>, CheckpointError> {
        match self.entries.iter().find(|entry| entry.name == name) {
            Some(entry) if entry.values.len() == len => Ok(entry.values.to_vec()),
            Some(entry) => Err(self.mismatch(format!("{name} of {} values", entry.values.len()), format!("{len} values"))),
            None => Err(self.mismatch(format!("no {name}"), format!("{name} of {len} values"))),
        }
    }
}

impl Opened {
    /// The notes of the header.
    pub(super) fn header(&self) -> &Checkpoint<'static> {
        &self.checkpoint
    }

    /// Reads the values, if there are as many as expected.
    pub(super) fn read(self, expected: usize) -> Result<Checkpoint<'static>, CheckpointError> {
        let Self { mut file, bytes, listed, mut checkpoint } = self;
        if bytes != 4 * expected as u64 {
            return Err(checkpoint.mismatch(format!("{bytes} bytes of values"), format!("{} bytes", 4 * expected as u64)));
        }
        let mut data = vec![0; bytes as usize];
        let path = &checkpoint.path;
        file.read_exact(&mut data).map_err(|source| CheckpointError::Io { path: path.clone(), source })?;
        let value = |b: &[u8]| f32::from_le_bytes([b[0], b[1], b[2], b[3]]);
        for (name, shape, range) in listed {
            let values: Vec<f32> = data[range].chunks_exact(4).map(value).collect();
            checkpoint.entries.push(Entry { name, shape, values: values.into() });
        }
        let words = data.chunks_exact(4).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]));
        checkpoint.expect_note("checksum", &format!("{:016x}", checksum(words)))?;
        Ok(checkpoint)
    }
}

/// The entries in which two objects in JSON differ, as `name value`; `None` for texts of another kind.
fn differences(found: &str, expected: &str) -> Option<(String, String)> {
    let [Value::Object(found), Value::Object(expected)] = [found, expected].map(|text| serde_json::from_str(text).unwrap_or_default())
    else {
        return None;
    };
    let differ = |name: &&String| found.get(*name) != expected.get(*name);
    let names: std::collections::BTreeSet<_> = found.keys().chain(expected.keys()).filter(differ).collect();
    let listed = |of: &serde_json::Map<String, Value>| {
        let entry = |name: &&String| format!("{name} {}", of.get(*name).map_or("none".into(), Value::to_string));
        names.iter().map(entry).collect::<Vec<_>>().join(", ")
    };
    (!names.is_empty()).then(|| (listed(&found), listed(&expected)))
}
