//! What an HDF5 file holds, counted before a library reads all of it.
//!
//! libnetcdf opens every group and follows every link when it opens a file, in recursion, and reads every attribute. Here, one
//! object after the other is looked at, and nothing of which the size is not known.

use super::guard::open_guarded;
use super::limits::{Limits, MAX_ATTRIBUTE_BYTES, MAX_ATTRIBUTES, MAX_DEPTH, MAX_OBJECTS};
use super::messages::{FormatError, FormatFault};
use hdf5_metno::dataset::Layout;
use hdf5_metno::filters::Filter;
use hdf5_metno::types::TypeDescriptor;
use hdf5_metno::{Dataset, Group, LinkType, Location};
use std::collections::HashMap;
use std::path::Path;

/// Bytes of a chunk of each dataset, by its path without the leading `/`.
pub type Chunks = HashMap<String, u64>;

/// Elements of an attribute of variable length, each of which may be as long as the file.
const MAX_VARIABLE: usize = 1024;
/// Characters of a path in a message.
const MAX_SHOWN: usize = 80;

/// Why a file is not read.
enum Stop {
    Refused(String),
    Library(hdf5_metno::Error),
}

impl From<hdf5_metno::Error> for Stop {
    fn from(error: hdf5_metno::Error) -> Self {
        Self::Library(error)
    }
}

/// Counts what a file holds and looks for links to other files.
///
/// # Errors
/// The file leads to other files, which the limits exclude, or holds more than is accepted; the library fails.
pub fn scan(path: &Path, limits: &Limits) -> Result<Chunks, FormatError> {
    let scanned = open_guarded(path, "the HDF5 library failed on it", || {
        let file = hdf5_metno::File::open(path)?;
        let mut scan = Scan::new(limits, false);
        let mut end = scan.group(&file, "", 0);
        // No link leaves the file now, but soft links may form circles.
        if end.is_ok() && scan.soft {
            scan = Scan::new(limits, true);
            end = scan.group(&file, "", 0);
        }
        match end {
            Err(Stop::Library(error)) => Err(error),
            Err(Stop::Refused(what)) => Ok(Err(what)),
            Ok(()) => Ok(Ok(scan.chunks)),
        }
    })?;
    scanned.map_err(|what| FormatFault::Refused(what).of(path))
}

/// Refuses a dataset whose values lie in other files, unless the limits allow it, and one that is compressed more than once. Returns the bytes of a chunk, 0 without chunks.
///
/// # Errors
/// The reason, about the dataset of this path.
pub fn look_at(dataset: &Dataset, path: &str, limits: &Limits) -> hdf5_metno::Result<Result<u64, String>> {
    let created = dataset.dcpl()?;
    if !limits.external {
        if let Some(other) = created.get_external()?.first() {
            return Ok(Err(elsewhere(path, &format!("keeps its values in another file, `{}`", shown(&other.name)))));
        }
        if created.get_layout()? == Layout::Virtual {
            let maps = created.get_virtual_map()?;
            let other = maps.first().map_or("none", |map| map.src_filename.as_str());
            return Ok(Err(elsewhere(path, &format!("is virtual: its values lie in other datasets, of the file `{}`", shown(other)))));
        }
    }
    // What deflate shrinks once, it shrinks 1032 times at most: a chunk compressed twice could unpack to anything.
    let deflated = created.get_filters().unwrap_or_default().iter().filter(|f| matches!(f, Filter::Deflate(_))).count();
    if deflated > 1 {
        return Ok(Err(format!("`{}` is compressed {deflated} times by deflate; accepted is once", shown(path))));
    }
    let values = created.get_chunk()?.map_or(0, |chunk| chunk.iter().fold(1u64, |n, &c| n.saturating_mul(c as u64)));
    Ok(Ok(values.saturating_mul(dataset.dtype()?.size() as u64)))
}

fn elsewhere(path: &str, what: &str) -> String {
    format!("`{}` {what}; accepted are files that hold their own values, or any with `archive.external = true`", shown(path))
}

/// A name or path for a message.
fn shown(path: &str) -> String {
    let mut text: String = path.chars().take(MAX_SHOWN).collect();
    if text.len() < path.len() {
        text.push_str("...");
    }
    text
}

struct Scan<'a> {
    limits: &'a Limits,
    /// Whether soft links are followed.
    follow: bool,
    /// Whether there are soft links.
    soft: bool,
    objects: u64,
    attributes: usize,
    attribute_bytes: u64,
    chunks: Chunks,
}

impl<'a> Scan<'a> {
    fn new(limits: &'a Limits, follow: bool) -> Self {
        Self { limits, follow, soft: false, objects: 0, attributes: 0, attribute_bytes: 0, chunks: Chunks::new() }
    }

    fn group(&mut self, group: &Group, path: &str, depth: usize) -> Result<(), Stop> {
        if depth > MAX_DEPTH {
            return Err(Stop::Refused(format!("its groups are nested more than {MAX_DEPTH} deep, or in a circle (`{}`)", shown(path))));
        }
        // Known before any of them is looked at.
        self.objects = self.objects.saturating_add(group.len());
        if self.objects > MAX_OBJECTS as u64 {
            return Err(Stop::Refused(format!("it holds more than {MAX_OBJECTS} groups and variables; accepted are files of fewer")));
        }
        self.attributes_of(group, path)?;
        let mut links = Vec::new();
        group.iter_visit_default(|name, info| {
            links.push((name.to_owned(), info.link_type));
            Ok(())
        })?;
        for (name, link) in links {
            let path = if path.is_empty() { name.clone() } else { format!("{path}/{name}") };
            match link {
                LinkType::External if self.limits.external => {}
                LinkType::External => return Err(Stop::Refused(elsewhere(&path, "links to another file"))),
                LinkType::Soft if !self.follow => {
                    self.soft = true;
                    continue;
                }
                LinkType::Soft | LinkType::Hard => {}
            }
            if let Ok(dataset) = group.dataset(&name) {
                self.attributes_of(&dataset, &path)?;
                let chunk = look_at(&dataset, &path, self.limits)?.map_err(Stop::Refused)?;
                self.chunks.insert(path, chunk);
            } else if let Ok(inner) = group.group(&name) {
                self.group(&inner, &path, depth + 1)?;
            }
        }
        Ok(())
    }

    fn attributes_of(&mut self, object: &Location, path: &str) -> Result<(), Stop> {
        self.attributes = self.attributes.saturating_add(object.loc_info()?.num_attrs);
        let shown = || if path.is_empty() { "the file".to_owned() } else { format!("`{}`", shown(path)) };
        if self.attributes > MAX_ATTRIBUTES {
            return Err(Stop::Refused(format!("it holds more than {MAX_ATTRIBUTES} attributes (up to {})", shown())));
        }
        for name in object.attr_names()? {
            // One that cannot be opened here costs nothing: the libraries fail at it too.
            let Ok(attribute) = object.attr(&name) else { continue };
            let Ok(kind) = attribute.dtype() else { continue };
            self.attribute_bytes = self.attribute_bytes.saturating_add((attribute.size() as u64).saturating_mul(kind.size() as u64));
            if self.attribute_bytes > MAX_ATTRIBUTE_BYTES {
                let what = format!("it holds more than {} MiB of attributes (up to {})", MAX_ATTRIBUTE_BYTES >> 20, shown());
                return Err(Stop::Refused(what));
            }
            let variable = matches!(kind.to_descriptor(), Ok(TypeDescriptor::VarLenAscii | TypeDescriptor::VarLenUnicode));
            if variable && attribute.size() > MAX_VARIABLE {
                let (found, of) = (attribute.size(), shown());
                return Err(Stop::Refused(format!("an attribute of {of} holds {found} texts; accepted are {MAX_VARIABLE} at most")));
            }
        }
        Ok(())
    }
}
