//! Where the parts of a store lie: files of a folder, or entries of a zip file. Those behind a URL are in [`super::http`].

use super::super::limits::{Limits, MAX_DEPTH, MAX_OBJECTS};
use super::super::messages::FormatFault;
use rawzip::{CompressionMethod, FileReader, RECOMMENDED_BUFFER_SIZE, ReaderAt, ZipArchive, ZipArchiveEntryWayfinder};
use std::collections::{BTreeSet, HashMap};
use std::fs::File;
use std::io::{ErrorKind, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

/// Names of the files that describe a group or an array.
pub const METADATA: [&str; 5] = ["zarr.json", ".zmetadata", ".zgroup", ".zarray", ".zattrs"];
/// Bytes that an entry of a zip file takes in memory, beside its name.
const ENTRY_BYTES: u64 = 256;

/// Which bytes of a part are wanted.
#[derive(Debug, Clone, Copy)]
pub enum Span {
    All,
    Last(u64),
    From(u64, u64),
}

impl Span {
    /// Start and number of bytes in a part of this length.
    pub fn of(self, length: u64, most: u64) -> Result<(u64, u64), String> {
        let (start, bytes) = match self {
            Self::All => (0, length),
            Self::Last(bytes) => (length.saturating_sub(bytes), bytes),
            Self::From(start, bytes) => (start, bytes),
        };
        if start.checked_add(bytes).is_none_or(|end| end > length) {
            return Err(format!("it ends after {length} bytes, but bytes {start} to {} are needed", start.saturating_add(bytes)));
        }
        if bytes > most {
            return Err(format!("it holds {bytes} bytes, more than the {most} that are accepted here"));
        }
        Ok((start, bytes))
    }
}

/// A store, as named parts. Names are paths within it, with `/`.
pub trait Parts: Send + Sync {
    /// Bytes of a part, `most` of them at most; `None` if there is no such part.
    ///
    /// # Errors
    /// A part that cannot be read, is shorter or longer, or lies outside the store.
    fn read(&self, name: &str, span: Span, most: u64) -> Result<Option<Vec<u8>>, String>;

    /// Names of the folders in a folder.
    ///
    /// # Errors
    /// They cannot be listed, or are too many.
    fn folders(&self, name: &str) -> Result<Vec<String>, String>;

    /// Whether folders can be listed.
    fn lists(&self) -> bool {
        true
    }

    /// How many parts are worth being asked for at once.
    fn at_once(&self) -> usize {
        1
    }

    /// Looks whether the store may be read still: else a part that was not found before this call may be stored all the same.
    ///
    /// # Errors
    /// It cannot be read, and why.
    fn confirm(&self) -> Result<(), String> {
        Ok(())
    }

    /// Says whether reads that are under way shall end instead of being tried again.
    fn give_up(&self, _: bool) {}

    /// Whether metadata may be there, but not for this reader.
    fn denied(&self) -> bool {
        false
    }

    /// Requests to a server so far.
    fn requests(&self) -> u64 {
        0
    }
}

/// Refuses names that lead out of a store.
pub fn checked(name: &str) -> Result<(), String> {
    let odd = |part: &str| part.is_empty() || part == "." || part == ".." || part.contains(['\\', '\0']);
    if name.split('/').any(odd) { Err("names of parts hold no `..` and no empty pieces".into()) } else { Ok(()) }
}

/// A name within a folder; the folder may be the store itself.
pub fn within(folder: &str, name: &str) -> String {
    if folder.is_empty() { name.into() } else { format!("{folder}/{name}") }
}

/// True if a folder is a store or a part of one.
pub fn is_store(path: &Path) -> bool {
    path.is_dir() && METADATA[..4].iter().any(|name| path.join(name).is_file())
}

/// A folder.
pub struct FolderParts {
    /// Without links.
    root: PathBuf,
    /// Whether links may lead out of it.
    external: bool,
}

impl FolderParts {
    pub fn open(path: &Path, limits: &Limits) -> std::io::Result<Self> {
        Ok(Self { root: path.canonicalize()?, external: limits.external })
    }

    /// Path of a part; `None` if there is none.
    fn find(&self, name: &str) -> Result<Option<PathBuf>, String> {
        checked(name)?;
        let path = self.root.join(name);
        match path.canonicalize() {
            Ok(real) if self.external || real.starts_with(&self.root) => Ok(Some(real)),
            Ok(real) => Err(format!(
                "it is a link out of the store, to `{}`; accepted are stores that hold their own values, or any with \
                 `archive.external = true`",
                real.display()
            )),
            Err(error) if matches!(error.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory) => Ok(None),
            Err(error) => Err(error.to_string()),
        }
    }
}

impl Parts for FolderParts {
    fn read(&self, name: &str, span: Span, most: u64) -> Result<Option<Vec<u8>>, String> {
        let Some(path) = self.find(name)? else { return Ok(None) };
        let mut file = ridgewatch_base::files::open(&path).map_err(|e| e.to_string())?;
        let length = file.metadata().map_err(|e| e.to_string())?.len();
        let (start, bytes) = span.of(length, most)?;
        file.seek(SeekFrom::Start(start)).map_err(|e| e.to_string())?;
        let mut out = vec![0; bytes as usize];
        file.read_exact(&mut out).map_err(|e| e.to_string())?;
        Ok(Some(out))
    }

    fn folders(&self, name: &str) -> Result<Vec<String>, String> {
        let path = if name.is_empty() { Some(self.root.clone()) } else { self.find(name)? };
        let Some(path) = path else { return Ok(Vec::new()) };
        let mut names = Vec::new();
        for (count, entry) in std::fs::read_dir(path).map_err(|e| e.to_string())?.enumerate() {
            if count >= MAX_OBJECTS {
                return Err(format!("it holds more than {MAX_OBJECTS} files and folders; accepted are groups of fewer"));
            }
            let entry = entry.map_err(|e| e.to_string())?;
            if entry.path().is_dir()
                && let Ok(name) = entry.file_name().into_string()
            {
                names.push(name);
            }
        }
        Ok(names)
    }
}

/// An entry of a zip file.
#[derive(Clone, Copy)]
struct Entry {
    place: ZipArchiveEntryWayfinder,
    deflated: bool,
}

/// A zip file.
pub struct ZipParts {
    archive: ZipArchive<FileReader>,
    entries: HashMap<String, Entry>,
    /// Folders in the folders that lead to metadata.
    folders: HashMap<String, BTreeSet<String>>,
}

impl ZipParts {
    /// Reads the directory of a zip file. A store may lie in the only folder of the file.
    ///
    /// # Errors
    /// A directory that is damaged or needs more memory than the limits allow.
    pub fn open(file: File, limits: &Limits) -> Result<Self, FormatFault> {
        let damaged = |e: rawzip::Error| FormatFault::Damaged(format!("zip: {e}"));
        let mut buffer = vec![0; RECOMMENDED_BUFFER_SIZE];
        let archive = ZipArchive::from_file(file, &mut buffer).map_err(damaged)?;
        let mut entries = HashMap::new();
        let mut bytes = 0;
        let mut found = archive.entries(&mut buffer);
        while let Some(entry) = found.next_entry().map_err(damaged)? {
            // Names that are not UTF-8 name no part of a store.
            let Ok(name) = std::str::from_utf8(entry.file_path().as_bytes()) else { continue };
            let (pieces, described) = (name.split('/').count(), METADATA.contains(&name.rsplit('/').next().unwrap_or_default()));
            // The array, its file and the folder of the store come on top of the groups.
            if described && pieces > MAX_DEPTH + 3 {
                return Err(FormatFault::Refused(format!("its groups are nested more than {MAX_DEPTH} deep")));
            }
            // Each folder that leads to metadata is held by its whole name.
            let names = if described { 2 + pieces as u64 } else { 2 };
            bytes += names * name.len() as u64 + ENTRY_BYTES;
            limits.check(bytes, "the names in its directory").map_err(FormatFault::Refused)?;
            let method = entry.compression_method();
            if checked(name).is_ok() && (method == CompressionMethod::STORE || method == CompressionMethod::DEFLATE) {
                entries.insert(name.to_owned(), Entry { place: entry.wayfinder(), deflated: method == CompressionMethod::DEFLATE });
            }
        }
        let described =
            |entries: &HashMap<String, Entry>, folder: &str| METADATA[..4].iter().any(|name| entries.contains_key(&within(folder, name)));
        if !described(&entries, "") {
            // Programs that make zip files add entries of their own beside the store.
            let mut tops: BTreeSet<String> = entries.keys().filter_map(|name| Some(name.split_once('/')?.0.to_owned())).collect();
            tops.retain(|top| described(&entries, top));
            if tops.len() > 1 {
                let names: Vec<&str> = tops.iter().take(2).map(String::as_str).collect();
                return Err(FormatFault::Refused(format!(
                    "it holds {} stores, among them {}; accepted is one",
                    tops.len(),
                    names.join(" and ")
                )));
            }
            if let Some(top) = tops.pop_first() {
                let inner = |(name, entry): (String, Entry)| Some((name.strip_prefix(&top)?.strip_prefix('/')?.to_owned(), entry));
                entries = entries.into_iter().filter_map(inner).collect();
            }
        }
        let mut folders: HashMap<String, BTreeSet<String>> = HashMap::new();
        for name in entries.keys() {
            let Some((mut folder, file)) = name.rsplit_once('/') else { continue };
            if !METADATA.contains(&file) {
                continue;
            }
            while !folder.is_empty() {
                let (parent, own) = folder.rsplit_once('/').unwrap_or(("", folder));
                if !folders.entry(parent.to_owned()).or_default().insert(own.to_owned()) {
                    break;
                }
                folder = parent;
            }
        }
        Ok(Self { archive, entries, folders })
    }
}

impl Parts for ZipParts {
    fn read(&self, name: &str, span: Span, most: u64) -> Result<Option<Vec<u8>>, String> {
        checked(name)?;
        let Some(entry) = self.entries.get(name) else { return Ok(None) };
        let found = self.archive.get_entry(entry.place).map_err(|e| e.to_string())?;
        if entry.deflated && !matches!(span, Span::All) {
            return Err("it is a shard that the zip file compresses; accepted are stored ones (`zip -0`)".into());
        }
        if matches!(span, Span::All) {
            // The declared length may be wrong.
            let stored = found.reader();
            let mut whole = Vec::new();
            let read = if entry.deflated {
                let inflated = flate2::read::DeflateDecoder::new(stored);
                found.verifying_reader(inflated).take(most + 1).read_to_end(&mut whole)
            } else {
                found.verifying_reader(stored).take(most + 1).read_to_end(&mut whole)
            };
            if whole.len() as u64 > most {
                return Err(format!("it holds more than the {most} bytes that are accepted here"));
            }
            read.map_err(|e| e.to_string())?;
            return Ok(Some(whole));
        }
        let (begin, end) = found.compressed_data_range();
        let (start, bytes) = span.of(end - begin, most)?;
        let mut out = vec![0; bytes as usize];
        self.archive.get_ref().read_exact_at(&mut out, begin + start).map_err(|e| e.to_string())?;
        Ok(Some(out))
    }

    fn folders(&self, name: &str) -> Result<Vec<String>, String> {
        Ok(self.folders.get(name).into_iter().flatten().cloned().collect())
    }
}
