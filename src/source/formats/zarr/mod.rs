//! Zarr, versions 2 and 3: folders and zip files, consolidated or not, and consolidated ones behind URLs, read chunk by chunk.
//!
//! Without the crate `zarrs`: its codecs unpack whatever a chunk holds, however much that is, and its features of other crates change
//! the whole program. The codecs here come from crates and are bounded by what the metadata declare.
//! Sources: "Zarr storage specification version 2", "Zarr core specification version 3.0", the conventions of xarray
//! ("Zarr Encoding Specification").

mod cache;
mod codecs;
mod http;
mod json;
mod metadata;
mod parts;

use super::guard::{guarded, open_guarded};
use super::limits::{Limits, MAX_ATTRIBUTE_BYTES, MAX_ATTRIBUTES, MAX_DEPTH, MAX_OBJECTS};
use super::messages::{Attribute, Dimension, Format, FormatError, FormatFault, Listing, NumberType, Variable};
use super::scan::Chunks;
use super::store::{Store, advance};
use cache::Cache;
use codecs::{most_stored, unpack};
use http::HttpParts;
pub use http::{ACCEPTED_URLS, checked_url, is_url};
use metadata::{Array, Codecs, Shard, collect};
pub use parts::is_store;
use parts::{FolderParts, Parts, Span, ZipParts, within};
use serde_json::Value;
use std::cell::{Cell, RefCell};
use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::sync_channel;

/// Chunks that one request may reach: each costs at least a look into a folder.
const MAX_CHUNKS: u64 = 1 << 20;
/// Memory that a byte of metadata may take once it is parsed. An object of one entry, `{"":0},`, takes 700 bytes for its 7.
const PARSED_BYTES: u64 = 128;
/// Bytes of the name of a variable, with its groups.
const MAX_NAME: usize = 4096;
/// Name of an array that is the whole store.
const ROOT: &str = "array";
/// The share of the memory in which unpacked chunks are kept: a fourth.
const CACHE_SHARE: u64 = 4;
/// The share of the memory for parts that are asked for at once: an eighth.
const AT_ONCE_SHARE: u64 = 8;
/// Chunks whose names are held while they are asked for at once.
const BATCH: usize = 512;

/// An index of a shard; `None` if the shard is not stored.
type Index = Option<Arc<Vec<u8>>>;

/// An open store.
pub struct ZarrStore {
    path: PathBuf,
    parts: Box<dyn Parts>,
    /// In the order of the listing.
    arrays: Vec<(String, Array)>,
    cache: RefCell<Cache>,
    /// Bytes for parts that are asked for at once, and again for the indices of shards that are needed for them.
    at_once: u64,
    /// A part that was not found in the request that is under way.
    absent: RefCell<Option<String>>,
    /// Parts read, their bytes, and chunks unpacked.
    counts: Cell<[u64; 3]>,
    /// Bytes of the values that were asked for, unpacked.
    needed: Cell<u64>,
}

impl Drop for ZarrStore {
    fn drop(&mut self) {
        let [parts, bytes, unpacked] = self.counts.get();
        let (needed, requests) = (self.needed.get(), self.parts.requests());
        let asked = if requests > 0 { format!(" in {requests} requests") } else { String::new() };
        tracing::debug!(
            "{}: read {bytes} bytes of {parts} parts{asked}, unpacked {unpacked} chunks, for values of {needed} bytes",
            self.path.display()
        );
    }
}

impl ZarrStore {
    /// Opens a folder.
    ///
    /// # Errors
    /// No store, metadata that are damaged, or more than the limits allow.
    pub fn open_folder(path: &Path, limits: &Limits) -> Result<(Listing, Self, Chunks), FormatError> {
        Self::open(path, limits, || Ok(Box::new(FolderParts::open(path, limits).map_err(|e| FormatFault::Open(e.to_string()))?)))
    }

    /// Opens a zip file.
    ///
    /// # Errors
    /// As for folders.
    pub fn open_zip(path: &Path, file: File, limits: &Limits) -> Result<(Listing, Self, Chunks), FormatError> {
        Self::open(path, limits, || Ok(Box::new(ZipParts::open(file, limits)?)))
    }

    /// Opens a store behind a URL that was checked, see [`checked_url`].
    ///
    /// # Errors
    /// As for folders; a server that does not answer, and a group without consolidated metadata.
    pub fn open_url(path: &Path, url: &str, limits: &Limits) -> Result<(Listing, Self, Chunks), FormatError> {
        Self::open(path, limits, || Ok(Box::new(HttpParts::open(url)?)))
    }

    fn open(
        path: &Path,
        limits: &Limits,
        parts: impl FnOnce() -> Result<Box<dyn Parts>, FormatFault>,
    ) -> Result<(Listing, Self, Chunks), FormatError> {
        let opened = open_guarded(path, "its metadata are not understood", || {
            Ok::<_, String>(parts().and_then(|parts| Nodes::read(&*parts, limits).map(|nodes| (parts, nodes))))
        })?;
        let (parts, nodes) = opened.map_err(|fault| fault.of(path))?;
        let named = nodes.arrays.iter().any(|(_, array)| array.dimensions.iter().take(array.rank).any(Option::is_some));
        let format = Format::Zarr { version: nodes.version, named };
        // Chunks that hold the fill value are often not stored, so that the length of the store says nothing.
        let (bytes, attributes) = (u64::MAX, nodes.attributes);
        let mut listing = Listing { path: path.into(), format, bytes, dimensions: vec![], variables: vec![], attributes };
        let mut chunks = Chunks::new();
        let mut arrays = nodes.arrays;
        for (folder, array) in &mut arrays {
            let name = if folder.is_empty() { ROOT } else { folder };
            let named = std::mem::take(&mut array.dimensions).into_iter().zip(&array.shape).enumerate();
            let named = named.map(|(k, (name, &len))| Dimension { name: name.unwrap_or_else(|| format!("axis {k}")), len });
            let dimensions = named.map(|dimension| listing.dimension(dimension)).collect();
            chunks.insert(name.to_owned(), array.block_bytes().max(array.index_bytes()));
            let attributes = std::mem::take(&mut array.attributes);
            listing.variables.push(Variable { name: name.to_owned(), number: array.number, dimensions, attributes });
            if listing.dimensions.len() > MAX_OBJECTS {
                let what = format!("it holds more than {MAX_OBJECTS} dimensions (up to `{name}`)");
                return Err(FormatFault::Refused(what).of(path));
            }
        }
        let cache = RefCell::new(Cache::new(limits.memory / CACHE_SHARE));
        let at_once = limits.memory / AT_ONCE_SHARE;
        let (counts, needed) = (Cell::default(), Cell::default());
        let absent = RefCell::default();
        Ok((listing, Self { path: path.into(), parts, arrays, cache, at_once, absent, counts, needed }, chunks))
    }

    /// Reads parts of the store and hands each on as it comes, in any order. Behind a network, several are on their way at once.
    fn fetch(
        &self,
        wanted: &[(String, Span)],
        most: u64,
        mut each: impl FnMut(usize, Option<Vec<u8>>) -> Result<(), String>,
    ) -> Result<(), String> {
        let mut hand = |place: usize, read: Result<Option<Vec<u8>>, String>| {
            let data = read.map_err(|what| format!("`{}`: {what}", wanted[place].0))?;
            match &data {
                Some(data) => {
                    let [parts, bytes, unpacked] = self.counts.get();
                    self.counts.set([parts + 1, bytes + data.len() as u64, unpacked]);
                }
                None => {
                    self.absent.borrow_mut().get_or_insert_with(|| wanted[place].0.clone());
                }
            }
            each(place, data)
        };
        let room = (self.at_once / most.max(1)).clamp(1, self.parts.at_once() as u64) as usize;
        let (parts, next) = (&*self.parts, AtomicUsize::new(0));
        if room.min(wanted.len()) < 2 {
            return wanted.iter().enumerate().try_for_each(|(place, (name, span))| hand(place, parts.read(name, *span, most)));
        }
        let read: Result<(), String> = std::thread::scope(|scope| {
            let (sender, receiver) = sync_channel(1);
            for _ in 0..room.min(wanted.len()) {
                let (sender, next) = (sender.clone(), &next);
                let work = move || {
                    loop {
                        let place = next.fetch_add(1, Ordering::Relaxed);
                        let Some((name, span)) = wanted.get(place) else { return };
                        // The receiver is gone after an error.
                        if sender.send((place, parts.read(name, *span, most))).is_err() {
                            return;
                        }
                    }
                };
                let started = std::thread::Builder::new().name("ridgewatch-part".into()).spawn_scoped(scope, work);
                started.map_err(|e| format!("no thread to read it: {e}"))?;
            }
            drop(sender);
            let read = receiver.into_iter().try_for_each(|(place, read)| hand(place, read));
            // The threads end before this scope: not with all the tries that they have left.
            parts.give_up(read.is_err());
            read
        });
        parts.give_up(false);
        read
    }

    /// Makes sure that what was not found in this request is not stored: a store that was moved, or may not be read any more, would turn
    /// all values into missing ones. One look after the last answer serves for all of them.
    fn confirm(&self) -> Result<(), String> {
        let Some(name) = self.absent.take() else { return Ok(()) };
        let unsure = |what: String| format!("`{name}`: it was not found, but neither can the metadata of its store be read now: {what}");
        self.parts.confirm().map_err(unsure)?;
        self.cache.borrow_mut().confirm();
        Ok(())
    }

    fn unpack(&self, name: &str, steps: &[codecs::Step], data: Vec<u8>, bytes: u64) -> Result<Arc<Vec<u8>>, String> {
        let [parts, read, unpacked] = self.counts.get();
        self.counts.set([parts, read, unpacked + 1]);
        unpack(steps, data, bytes).map(Arc::new).map_err(|what| format!("`{name}`: {what}"))
    }

    /// The indices of shards, by the place of the shard: start and length of each inner chunk.
    fn indices(&self, variable: usize, codecs: &Shard, shards: BTreeSet<Vec<usize>>) -> Result<BTreeMap<Vec<usize>, Index>, String> {
        let (folder, array) = &self.arrays[variable];
        let key = |shard: &[usize]| (variable, shard.iter().zip(&array.chunk).map(|(k, extent)| k * extent).collect(), true);
        let mut found = BTreeMap::new();
        let (mut wanted, mut places) = (Vec::new(), Vec::new());
        let bytes = array.index_bytes();
        let sums = codecs.index_steps.iter().filter(|&&step| step == codecs::Step::Crc32c).count() as u64;
        let stored = bytes.saturating_add(4 * sums);
        let span = if codecs.index_first { Span::From(0, stored) } else { Span::Last(stored) };
        for shard in shards {
            match self.cache.borrow().get(&key(&shard)) {
                Some(held) => {
                    found.insert(shard, held);
                }
                None => {
                    wanted.push((within(folder, &array.names.of(&shard[..array.rank])), span));
                    places.push(shard);
                }
            }
        }
        self.fetch(&wanted, most_stored(bytes), |which, data| {
            let unpacked = data.map(|data| unpack(&codecs.index_steps, data, bytes).map(Arc::new)).transpose();
            let index = unpacked.map_err(|what| format!("the index of `{}`: {what}", wanted[which].0))?;
            self.cache.borrow_mut().keep(key(&places[which]), &array.chunk, &index);
            found.insert(places[which].clone(), index);
            Ok(())
        })?;
        Ok(found)
    }

    /// What is unpacked at once, by its place among its like; what is not stored is left out. It is kept if the request leaves some of it.
    fn blocks(
        &self,
        variable: usize,
        codecs: &Codecs,
        places: &[Vec<usize>],
        keep: impl Fn(&[usize]) -> bool,
        mut each: impl FnMut(&[usize], &[u8]),
    ) -> Result<(), String> {
        let (folder, array) = &self.arrays[variable];
        let (block, bytes) = (array.block(), array.block_bytes());
        let origin = |place: &[usize]| -> Vec<usize> { place.iter().zip(block).map(|(k, extent)| k * extent).collect() };
        let chunk = |place: &[usize]| -> Vec<usize> { origin(place).iter().zip(&array.chunk).map(|(k, extent)| k / extent).collect() };
        let mut missing = Vec::new();
        for place in places {
            let held = self.cache.borrow().get(&(variable, origin(place), false));
            match held {
                Some(held) => held.iter().for_each(|data| each(place, data)),
                None => missing.push(place),
            }
        }
        let name = |place: &[usize]| within(folder, &array.names.of(&chunk(place)[..array.rank]));
        let (mut wanted, mut of) = (Vec::new(), Vec::new());
        match &codecs.shard {
            None => {
                wanted.extend(missing.iter().map(|place| (name(place), Span::All)));
                of = missing;
            }
            Some(shard) => {
                let indices = self.indices(variable, shard, missing.iter().map(|place| chunk(place)).collect())?;
                for place in missing {
                    let (origin, chunk) = (origin(place), chunk(place));
                    let Some(Some(index)) = indices.get(&chunk) else { continue };
                    let inner = |k: usize| (origin[k] - chunk[k] * array.chunk[k]) / block[k];
                    let number = (0..block.len()).fold(0, |n, k| n * (array.chunk[k] / block[k]) + inner(k));
                    let entry = |at: usize| {
                        let bytes = index.get(at * 8..at * 8 + 8).and_then(|b| b.try_into().ok()).unwrap_or([0xff; 8]);
                        if shard.index_big_endian { u64::from_be_bytes(bytes) } else { u64::from_le_bytes(bytes) }
                    };
                    match (entry(2 * number), entry(2 * number + 1)) {
                        (u64::MAX, u64::MAX) => {}
                        (start, length) => {
                            wanted.push((name(place), Span::From(start, length)));
                            of.push(place);
                        }
                    }
                }
            }
        }
        self.fetch(&wanted, most_stored(bytes), |which, data| {
            let place = of[which];
            let data = data.map(|data| self.unpack(&wanted[which].0, &codecs.steps, data, bytes)).transpose()?;
            if keep(place) {
                self.cache.borrow_mut().keep((variable, origin(place), false), block, &data);
            }
            data.iter().for_each(|data| each(place, data));
            Ok(())
        })
    }

    fn read_block(&self, variable: usize, start: &[usize], count: &[usize], out: &mut Vec<f64>) -> Result<(), String> {
        let array = &self.arrays[variable].1;
        let codecs = array.codecs.as_ref().map_err(Clone::clone)?;
        let (block, rank) = (array.block(), count.len());
        let ends: Vec<usize> = (0..rank).map(|k| start[k] + count[k]).collect();
        let first: Vec<usize> = (0..rank).map(|k| start[k] / block[k]).collect();
        let blocks: Vec<usize> = (0..rank).map(|k| (ends[k] - 1) / block[k] - first[k] + 1).collect();
        let needed = blocks.iter().fold(1u64, |n, &k| n.saturating_mul(k as u64));
        if needed > MAX_CHUNKS {
            return Err(format!("{needed} chunks would have to be read at once; accepted are {MAX_CHUNKS}"));
        }
        self.cache.borrow_mut().begin(variable, start, count);
        *self.absent.borrow_mut() = None;
        out.resize(count.iter().product(), array.fill);
        let strides = strides(block, &codecs.order);
        let rows = strides_of(count);
        let stored = array.stored.bytes() as u64;
        self.needed.set(count.iter().fold(stored, |n, &k| n.saturating_mul(k as u64)).saturating_add(self.needed.get()));
        let low = |place: &[usize], k: usize| start[k].max(place[k] * block[k]);
        let high = |place: &[usize], k: usize| ends[k].min((place[k] + 1).saturating_mul(block[k]));
        let end = |place: &[usize], k: usize| array.shape[k].min((place[k] + 1).saturating_mul(block[k]));
        let whole = |place: &[usize]| (0..rank).all(|k| low(place, k) == place[k] * block[k] && high(place, k) == end(place, k));
        let remote = self.parts.at_once() > 1;
        // A network is slower than memory: what the search for land or the choice of a grid has read serves again.
        let keep = |place: &[usize]| remote || !whole(place);
        let mut copy = |place: &[usize], data: &[u8]| {
            let from = (0..rank).map(|k| (low(place, k) - place[k] * block[k]) * strides[k]).sum();
            let to = (0..rank).map(|k| (low(place, k) - start[k]) * rows[k]).sum();
            let extents: Vec<usize> = (0..rank).map(|k| high(place, k) - low(place, k)).collect();
            let elements = Elements { data, number: array.stored, big_endian: codecs.big_endian };
            elements.copy(from, &strides, &extents, &mut out[to..], &rows);
        };
        let index_bytes = array.index_bytes();
        let shard = |place: &[usize]| -> Vec<usize> { (0..rank).map(|k| place[k] * block[k] / array.chunk[k]).collect() };
        let (mut number, mut shards) = (vec![0; rank], BTreeSet::new());
        let mut places: Vec<Vec<usize>> = Vec::new();
        loop {
            let place: Vec<usize> = (0..rank).map(|k| first[k] + number[k]).collect();
            if index_bytes > 0 && shards.insert(shard(&place)) {
                // The indices of a batch are in memory together. One of them has to be.
                let bytes = index_bytes.saturating_mul(shards.len() as u64);
                if shards.len() > 1 && bytes > self.at_once {
                    self.blocks(variable, codecs, &places, keep, &mut copy)?;
                    places.clear();
                    shards = BTreeSet::from([shard(&place)]);
                }
            }
            places.push(place);
            let more = advance(&mut number, &blocks);
            if !more || !remote || places.len() == BATCH {
                self.blocks(variable, codecs, &places, keep, &mut copy)?;
                places.clear();
                shards.clear();
            }
            if !more {
                return self.confirm();
            }
        }
    }
}

impl Store for ZarrStore {
    fn read(&self, index: usize, _: &Variable, start: &[usize], count: &[usize], out: &mut Vec<f64>) -> Result<(), String> {
        guarded(&self.path, || self.read_block(index, start, count, out)).unwrap_or_else(|| Err("its codecs failed on it".into()))
    }
}

/// Distances between neighbours along each dimension, in elements, if the dimensions have this order in memory, slowest first.
fn strides(extents: &[usize], order: &[usize]) -> Vec<usize> {
    let mut strides = vec![1; extents.len()];
    let mut stride = 1;
    for &k in order.iter().rev() {
        strides[k] = stride;
        stride *= extents[k];
    }
    strides
}

fn strides_of(extents: &[usize]) -> Vec<usize> {
    strides(extents, &(0..extents.len()).collect::<Vec<_>>())
}

/// Elements of an unpacked chunk.
struct Elements<'a> {
    data: &'a [u8],
    number: NumberType,
    big_endian: bool,
}

impl Elements<'_> {
    /// Copies a block: from element `from` on with these strides, to the start of `out` with the strides `rows`, the last of which is 1.
    fn copy(&self, from: usize, strides: &[usize], extents: &[usize], out: &mut [f64], rows: &[usize]) {
        macro_rules! copy {
            ($($number:ident $type:ty),*) => {
                match self.number {
                    $(NumberType::$number => {
                        let little = |bytes| <$type>::from_le_bytes(bytes) as f64;
                        let big = |bytes| <$type>::from_be_bytes(bytes) as f64;
                        if self.big_endian { self.rows(from, strides, extents, out, rows, big) } else { self.rows(from, strides, extents, out, rows, little) }
                    })*
                    NumberType::Text | NumberType::Other => {}
                }
            };
        }
        copy!(Int8 i8, Uint8 u8, Int16 i16, Uint16 u16, Int32 i32, Uint32 u32, Int64 i64, Uint64 u64, Float32 f32, Float64 f64);
    }

    fn rows<const N: usize>(
        &self,
        from: usize,
        strides: &[usize],
        extents: &[usize],
        out: &mut [f64],
        rows: &[usize],
        value: impl Fn([u8; N]) -> f64,
    ) {
        let (elements, _) = self.data.as_chunks::<N>();
        let outer = extents.len().saturating_sub(1);
        let (length, step) = (extents.last().copied().unwrap_or(1), strides.last().copied().unwrap_or(1));
        let mut index = vec![0; outer];
        loop {
            let at = from + (0..outer).map(|k| index[k] * strides[k]).sum::<usize>();
            let to = (0..outer).map(|k| index[k] * rows[k]).sum::<usize>();
            for (out, &element) in out[to..to + length].iter_mut().zip(elements[at..].iter().step_by(step)) {
                *out = value(element);
            }
            if !advance(&mut index, &extents[..outer]) {
                return;
            }
        }
    }
}

/// Why a URL is not read.
fn no_store(denied: bool) -> String {
    let found = if denied {
        "the server answers 403 (forbidden) where its metadata would be, as it does for what is not there, or for who may not read it"
    } else {
        "it holds no `zarr.json`, `.zmetadata`, `.zgroup` or `.zarray`"
    };
    format!("{found}; behind a URL, accepted are the folders of Zarr stores: files, zip files among them, have to be copied first")
}

/// Groups and arrays of a store.
struct Nodes {
    version: u8,
    attributes: Vec<(String, Attribute)>,
    arrays: Vec<(String, Array)>,
}

/// Reads metadata within the limits.
struct Reader<'a> {
    parts: &'a dyn Parts,
    limits: &'a Limits,
    /// Bytes of metadata that may still be read.
    left: u64,
    nodes: usize,
    arrays: Vec<(String, Array)>,
    attributes: usize,
}

impl Nodes {
    fn read(parts: &dyn Parts, limits: &Limits) -> Result<Self, FormatFault> {
        let mut reader = Reader { parts, limits, left: MAX_ATTRIBUTE_BYTES, nodes: 0, arrays: Vec::new(), attributes: 0 };
        let (version, attributes) = reader.root()?;
        let mut arrays = reader.arrays;
        arrays.sort_by(|a, b| a.0.cmp(&b.0));
        Ok(Self { version, attributes, arrays })
    }
}

impl Reader<'_> {
    /// Reads and parses a file of metadata.
    fn json(&mut self, name: &str) -> Result<Option<Value>, FormatFault> {
        let what = |what: String| FormatFault::Damaged(format!("`{name}`: {what}"));
        // What a server does not answer may be intact.
        let fault = if self.parts.lists() { FormatFault::Refused } else { FormatFault::Open };
        let Some(bytes) = self.parts.read(name, Span::All, self.left).map_err(|e| fault(format!("`{name}`: {e}")))? else {
            return Ok(None);
        };
        self.left -= bytes.len() as u64;
        // All of it counts: metadata of a group stay in memory while what the group holds is read.
        let parsed = (MAX_ATTRIBUTE_BYTES - self.left) * PARSED_BYTES;
        self.limits.check(parsed, &format!("the metadata up to `{name}`")).map_err(FormatFault::Refused)?;
        json::parse(&bytes).map(Some).map_err(what)
    }

    /// Reads all metadata. Returns the version and the attributes of the store.
    fn root(&mut self) -> Result<(u8, Vec<(String, Attribute)>), FormatFault> {
        if let Some(root) = self.json("zarr.json")? {
            match root["consolidated_metadata"]["metadata"].as_object() {
                Some(nodes) if !nodes.is_empty() => {
                    for (name, node) in nodes {
                        self.count()?;
                        if node["node_type"] == "array" {
                            self.add(name, Array::version_3(node), "zarr.json")?;
                        }
                    }
                }
                _ => self.version_3("", &root, 0)?,
            }
            return Ok((3, collect(&root["attributes"])));
        }
        if let Some(root) = self.json(".zmetadata")? {
            let Some(nodes) = root["metadata"].as_object() else {
                return Err(FormatFault::Damaged("`.zmetadata`: it has no object `metadata`".into()));
            };
            for (key, node) in nodes {
                self.count()?;
                if let Some(name) = key.strip_suffix("/.zarray").or((key == ".zarray").then_some("")) {
                    self.version_2(name, node, nodes.get(&within(name, ".zattrs")))?;
                }
            }
            return Ok((2, nodes.get(".zattrs").map(collect).unwrap_or_default()));
        }
        self.folders("", 0)?;
        if self.arrays.is_empty() {
            let group = self.json(".zgroup")?.is_some();
            match (group, self.parts.lists()) {
                (true, false) => self.parts.folders("").map(drop).map_err(FormatFault::Refused)?,
                (true, true) => {}
                (false, true) => return Err(FormatFault::Unknown("it holds no `zarr.json`, `.zmetadata`, `.zgroup` or `.zarray`".into())),
                (false, false) => return Err(FormatFault::Refused(no_store(self.parts.denied()))),
            }
        }
        let attributes = self.json(".zattrs")?;
        Ok((2, attributes.as_ref().map(collect).unwrap_or_default()))
    }

    /// Metadata of version 3 of a folder and all within.
    fn version_3(&mut self, folder: &str, node: &Value, depth: usize) -> Result<(), FormatFault> {
        if node["node_type"] == "array" {
            return self.add(folder, Array::version_3(node), "zarr.json");
        }
        for inner in self.listed(folder, depth)? {
            let name = within(folder, &inner);
            if let Some(node) = self.json(&within(&name, "zarr.json"))? {
                self.version_3(&name, &node, depth + 1)?;
            }
        }
        Ok(())
    }

    /// Metadata of version 2 of a folder and, if folders can be listed, of all within.
    fn folders(&mut self, folder: &str, depth: usize) -> Result<(), FormatFault> {
        if let Some(array) = self.json(&within(folder, ".zarray"))? {
            let attributes = self.json(&within(folder, ".zattrs"))?;
            return self.version_2(folder, &array, attributes.as_ref());
        }
        if !self.parts.lists() {
            return Ok(());
        }
        for inner in self.listed(folder, depth)? {
            self.folders(&within(folder, &inner), depth + 1)?;
        }
        Ok(())
    }

    /// Folders in a folder, which are counted.
    fn listed(&mut self, folder: &str, depth: usize) -> Result<Vec<String>, FormatFault> {
        let at = if folder.is_empty() { String::new() } else { format!("`{folder}`: ") };
        let mut inner = self.parts.folders(folder).map_err(|what| FormatFault::Refused(format!("{at}{what}")))?;
        if depth > MAX_DEPTH && !inner.is_empty() {
            return Err(FormatFault::Refused(format!("its groups are nested more than {MAX_DEPTH} deep, or in a circle")));
        }
        inner.iter().try_for_each(|_| self.count())?;
        // Folders come in any order: the first error must always be the same.
        inner.sort();
        Ok(inner)
    }

    /// Counts a group or array.
    fn count(&mut self) -> Result<(), FormatFault> {
        self.nodes += 1;
        // Consolidated metadata of version 2 count a variable twice or three times.
        if self.nodes <= 3 * MAX_OBJECTS && self.arrays.len() <= MAX_OBJECTS {
            return Ok(());
        }
        Err(FormatFault::Refused(format!("it holds more than {MAX_OBJECTS} groups and variables; accepted are files of fewer")))
    }

    fn version_2(&mut self, name: &str, array: &Value, attributes: Option<&Value>) -> Result<(), FormatFault> {
        let own = name.rsplit('/').next().unwrap_or_default();
        self.add(name, Array::version_2(array, attributes, own), ".zarray")
    }

    fn add(&mut self, name: &str, array: Result<Array, String>, part: &str) -> Result<(), FormatFault> {
        if name.len() > MAX_NAME {
            let found = name.len();
            return Err(FormatFault::Refused(format!("the name of a variable has {found} bytes; accepted are {MAX_NAME} at most")));
        }
        let array = array.map_err(|what| FormatFault::Damaged(format!("`{}`: {what}", within(name, part))))?;
        self.attributes += array.attributes.len();
        if self.attributes > MAX_ATTRIBUTES {
            return Err(FormatFault::Refused(format!("it holds more than {MAX_ATTRIBUTES} attributes (up to `{name}`)")));
        }
        self.arrays.push((name.to_owned(), array));
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A store of 12 times on 4 x 4 nodes, in chunks of 4 times and 2 x 2 nodes. The number at a place is its index.
    fn store(folder: &Path) {
        let array = r#"{"zarr_format": 2, "shape": [12, 4, 4], "chunks": [4, 2, 2], "dtype": "<i4", "order": "C", "fill_value": null}"#;
        for name in ["u", "v"] {
            let path = folder.join(name);
            std::fs::create_dir_all(&path).unwrap();
            std::fs::write(path.join(".zarray"), array).unwrap();
            for (t, y, x) in (0..12).map(|i| (i / 4, i / 2 % 2, i % 2)) {
                let index = |i: i32| ((t * 4 + i / 4) * 4 + y * 2 + i / 2 % 2) * 4 + x * 2 + i % 2;
                let bytes: Vec<u8> = (0..16).flat_map(|i| index(i).to_le_bytes()).collect();
                std::fs::write(path.join(format!("{t}.{y}.{x}")), bytes).unwrap();
            }
        }
    }

    /// Reads both variables at all times, with `room` bytes for chunks. Returns the parts that were read, their bytes, and the chunks that were unpacked.
    fn replayed(folder: &Path, room: u64, columns: usize) -> [u64; 3] {
        let (listing, mut store, _) = ZarrStore::open_folder(folder, &Limits::NONE).unwrap();
        store.cache = RefCell::new(Cache::new(room));
        for time in 0..12 {
            for (index, variable) in listing.variables.iter().enumerate() {
                let mut out = Vec::new();
                store.read(index, variable, &[time, 0, 0], &[1, 4, columns], &mut out).unwrap();
                let expected = (0..4).flat_map(|y| (0..columns).map(move |x| ((time * 4 + y) * 4 + x) as f64));
                assert!(out.into_iter().eq(expected), "time {time}");
            }
        }
        store.counts.get()
    }

    #[test]
    fn a_replay_reads_each_byte_in_question_once() {
        let folder = tempfile::tempdir().unwrap();
        store(folder.path());
        let all = 2 * 12 * 4 * 4 * 4;
        assert_eq!(replayed(folder.path(), u64::MAX, 4), [24, all, 24]);
        // Half of the columns: half of the chunks.
        assert_eq!(replayed(folder.path(), u64::MAX, 2), [12, all / 2, 12]);
        // Room for one snapshot of both variables, and not for two.
        let [_, bytes, unpacked] = replayed(folder.path(), 9 * (64 + 256), 4);
        assert!(unpacked <= 48 && bytes <= 2 * all, "{unpacked} {bytes}");
        // Without room, each time reads all of its chunks.
        assert_eq!(replayed(folder.path(), 0, 4), [96, 4 * all, 96]);
    }

    /// A folder of which two parts are read at once, and the indices that were read.
    struct Apart(FolderParts, Arc<AtomicUsize>);

    impl Parts for Apart {
        fn read(&self, name: &str, span: Span, most: u64) -> Result<Option<Vec<u8>>, String> {
            self.1.fetch_add(usize::from(matches!(span, Span::Last(_))), Ordering::Relaxed);
            self.0.read(name, span, most)
        }

        fn folders(&self, name: &str) -> Result<Vec<String>, String> {
            self.0.folders(name)
        }

        fn at_once(&self) -> usize {
            2
        }
    }

    #[test]
    fn the_indices_of_a_batch_are_bounded() {
        let folder = tempfile::tempdir().unwrap();
        let array = r#"{"shape": [4, 8], "data_type": "int32", "node_type": "array", "zarr_format": 3, "fill_value": 0,
            "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [2, 2]}},
            "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
            "codecs": [{"name": "sharding_indexed", "configuration": {"chunk_shape": [1, 1],
                "codecs": [{"name": "bytes", "configuration": {"endian": "little"}}],
                "index_codecs": [{"name": "bytes", "configuration": {"endian": "little"}}]}}]}"#;
        std::fs::write(folder.path().join("zarr.json"), array).unwrap();
        for (y, x) in (0..8i32).map(|i| (i / 4, i % 4)) {
            let values = (0..4i32).flat_map(|i| ((2 * y + i / 2) * 8 + 2 * x + i % 2).to_le_bytes());
            let index = (0..4u64).flat_map(|i| [4 * i, 4]).flat_map(u64::to_le_bytes);
            std::fs::create_dir_all(folder.path().join(format!("c/{y}"))).unwrap();
            std::fs::write(folder.path().join(format!("c/{y}/{x}")), values.chain(index).collect::<Vec<u8>>()).unwrap();
        }
        // Each of the 8 shards once; or, with room for two indices, each of a row's 4 shards in each of the 4 rows; or one by one.
        for (room, expected) in [(u64::MAX, 8), (2 * 64, 16), (1, 16)] {
            let (listing, mut store, _) = ZarrStore::open_folder(folder.path(), &Limits::NONE).unwrap();
            let count = Arc::new(AtomicUsize::new(0));
            store.parts = Box::new(Apart(FolderParts::open(folder.path(), &Limits::NONE).unwrap(), count.clone()));
            (store.cache, store.at_once) = (RefCell::new(Cache::new(0)), room);
            let mut out = Vec::new();
            store.read(0, &listing.variables[0], &[0, 0], &[4, 8], &mut out).unwrap();
            assert!(out.into_iter().eq((0..32i32).map(f64::from)), "{room}");
            assert_eq!(count.load(Ordering::Relaxed), expected, "{room}");
        }
    }
}
