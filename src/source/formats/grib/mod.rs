//! GRIB, editions 1 and 2: the messages of a file, shown as variables on times, members, levels, latitudes and longitudes.
//!
//! Opening reads the headers of all messages; values are unpacked when they are asked for, a message at a time.
//!
//! Without the crate `grib`: it reads edition 2 only, takes memory for as many values as a packed field claims to have, and gives wrong values
//! for images that ecCodes writes with another depth than the message states. The pure-Rust codecs that it uses are called here directly.
//! Sources: WMO Manual on Codes (WMO-No. 306), FM 92 GRIB edition 1 (1994 to 2001, volume I.2) and edition 2; names as in ecCodes and cfgrib.

mod cube;
mod date;
mod edition1;
mod edition2;
mod grid;
mod image;
mod input;
mod message;
mod names;
mod packing;

use super::guard::{guarded, open_guarded};
use super::limits::Limits;
use super::messages::{FormatError, Listing, Variable};
use super::scan::Chunks;
use super::store::{Store, advance};
use cube::{Content, Cube};
use input::Input;
use message::{Message, Place};
use packing::{Packing, spread};
use std::fs::File;
use std::os::unix::fs::FileExt;
use std::path::PathBuf;

/// An open file.
pub struct GribStore {
    path: PathBuf,
    file: File,
    limits: Limits,
    /// Places of the messages, of which each variable has a part.
    places: Vec<Place>,
    /// In the order of the listing.
    contents: Vec<Content>,
}

impl GribStore {
    /// Fills an empty listing from the headers of all messages.
    ///
    /// # Errors
    /// A file that is cut short or no series of messages, or one of more messages than the limits allow.
    pub fn open(listing: Listing, file: File, limits: &Limits) -> Result<(Listing, Self, Chunks), FormatError> {
        let path = listing.path.clone();
        let opened = open_guarded(&path, "its headers are not understood", || {
            let messages = Message::all(&mut Input::new(&file, listing.bytes), limits);
            Ok::<_, String>(messages.and_then(|messages| {
                // A field of one value takes no bytes, so that the length of the file says nothing.
                cube::listed(Listing { bytes: u64::MAX, ..listing }, messages)
            }))
        })?;
        let (listing, places, contents) = opened.map_err(|fault| fault.of(&path))?;
        let chunk = |content: &Content| match content {
            Content::Cube(cube) => places[cube.places.clone()].iter().map(|place| place.bytes(cube.grid.points())).max().unwrap_or(0),
            Content::Axis(_) | Content::Unread => 0,
        };
        let chunks = listing.variables.iter().zip(&contents).map(|(variable, content)| (variable.name.clone(), chunk(content))).collect();
        Ok((listing, Self { path, file, limits: *limits, places, contents }, chunks))
    }

    /// The values of a message in their order there; NaN where one is missing.
    fn field(&self, place: &Place, points: usize) -> Result<Vec<f64>, String> {
        let bitmap = place.bitmap.map(|span| self.part(span)).transpose()?;
        let present = |bitmap: &Vec<u8>| -> Result<usize, String> {
            let bits = bitmap.get(..points.div_ceil(8)).ok_or("its bitmap is shorter than its grid")?;
            let behind = (points..bits.len() * 8).filter(|&k| bits[k / 8] & (0x80 >> (k % 8)) != 0).count();
            Ok(bits.iter().map(|byte| byte.count_ones() as usize).sum::<usize>() - behind)
        };
        let count = bitmap.as_ref().map_or(Ok(points), present)?;
        let packing = Packing::of(place, &self.part(place.description)?, count)?;
        let values = packing.unpack(&self.part(place.data)?, count, &self.limits)?;
        if values.len() != count {
            return Err(format!("it unpacks to {} values, but has {count}", values.len()));
        }
        Ok(match bitmap {
            Some(bitmap) => spread(&values, &bitmap, points),
            None => values,
        })
    }

    fn part(&self, (offset, length): (u64, u64)) -> Result<Vec<u8>, String> {
        let mut bytes = Vec::new();
        bytes.try_reserve_exact(length as usize).map_err(|_| format!("out of memory for {length} bytes"))?;
        bytes.resize(length as usize, 0);
        self.file.read_exact_at(&mut bytes, offset).map_err(|e| e.to_string())?;
        Ok(bytes)
    }

    fn read_cube(&self, cube: &Cube, shape: &[usize], start: &[usize], count: &[usize], out: &mut Vec<f64>) -> Result<(), String> {
        let outer = count.len() - 2;
        let mut index = vec![0; outer];
        loop {
            let entry = (0..outer).fold(0, |entry, k| entry * shape[k] + start[k] + index[k]);
            let place = &self.places[cube.places.clone()][entry];
            let values = self.field(place, cube.grid.points()).map_err(|what| format!("its message at byte {}: {what}", place.begin))?;
            cube.grid.copy(&values, [start[outer], start[outer + 1]], [count[outer], count[outer + 1]], out);
            if !advance(&mut index, &count[..outer]) {
                return Ok(());
            }
        }
    }
}

impl Store for GribStore {
    fn read(&self, index: usize, _: &Variable, start: &[usize], count: &[usize], out: &mut Vec<f64>) -> Result<(), String> {
        match &self.contents[index] {
            Content::Axis(axis) => {
                out.extend((start[0]..start[0] + count[0]).map(|i| axis.coordinate(i)));
                Ok(())
            }
            Content::Cube(cube) => guarded(&self.path, || self.read_cube(cube, &cube.shape, start, count, out))
                .unwrap_or_else(|| Err("its packing is not understood".into())),
            Content::Unread => Err("it cannot be unpacked".into()),
        }
    }
}
