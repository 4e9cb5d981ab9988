//! Answers requests. The file of the last request stays open.

use super::classic::ClassicStore;
use super::grib::GribStore;
use super::hdf5::Hdf5Store;
use super::limits::Limits;
use super::messages::{Description, Format, FormatError, FormatFault, Listing, NumberType, Request, Response, UNREADABLE};
use super::netcdf4::NetCdf4Store;
use super::scan::{Chunks, scan};
use super::store::Store;
use super::zarr::{ZarrStore, is_url};
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;

/// The formats, reached through requests.
pub struct FormatServer {
    limits: Limits,
    open: Option<OpenFile>,
}

struct OpenFile {
    listing: Listing,
    store: Box<dyn Store>,
    /// Bytes of a chunk of each variable; empty for formats without chunks.
    chunks: Chunks,
}

impl FormatServer {
    /// A server without an open file.
    pub fn new(limits: Limits) -> Self {
        Self { limits, open: None }
    }

    /// Answers one request.
    ///
    /// # Errors
    /// A file that is missing, damaged or of another format; a variable or block that does not exist.
    pub fn answer(&mut self, request: Request) -> Result<Response, FormatError> {
        match request {
            Request::List { path, expected } => {
                // The previous file closes before the next one opens.
                self.open = None;
                Ok(Response::Listing(self.open.insert(OpenFile::open(&path, expected.as_ref(), &self.limits)?).listing.clone()))
            }
            Request::Describe { path, variable } => {
                let listing = &self.opened(&path)?.listing;
                let found = &listing.variables[listing.find(&variable).ok_or_else(|| listing.read_error(&variable, "it is gone"))?];
                let dimensions = found.dimensions.iter().map(|&d| listing.dimensions[d].clone()).collect();
                Ok(Response::Description(Description { number: found.number, dimensions, attributes: found.attributes.clone() }))
            }
            Request::Read { path, variable, start, count } => {
                let limits = self.limits;
                self.opened(&path)?.read(&variable, &start, &count, &limits).map(Response::Values)
            }
        }
    }

    fn opened(&mut self, path: &Path) -> Result<&OpenFile, FormatError> {
        let open = match self.open.take() {
            Some(open) if open.listing.path == path => open,
            _ => OpenFile::open(path, None, &self.limits)?,
        };
        Ok(self.open.insert(open))
    }
}

impl OpenFile {
    /// Opens a file and reads its header, nothing else. libnetcdf reads all variables of a NetCDF-4 file when it opens it, which
    /// takes milliseconds and many small reads; a file that resembles `expected` is opened through libhdf5 instead.
    fn open(path: &Path, expected: Option<&Listing>, limits: &Limits) -> Result<Self, FormatError> {
        let failed = |cause: std::io::Error| FormatFault::Open(cause.to_string()).of(path);
        let zarr = |(listing, store, chunks)| Self { listing, store: Box::new(store) as Box<dyn Store>, chunks };
        if let Some(url) = path.to_str().filter(|_| is_url(path)) {
            return ZarrStore::open_url(path, url, limits).map(zarr);
        }
        if path.is_dir() {
            return ZarrStore::open_folder(path, limits).map(zarr);
        }
        let mut file = ridgewatch_base::files::open(path).map_err(failed)?;
        let bytes = file.metadata().map_err(failed)?.len();
        if is_zip(&mut file, bytes).map_err(failed)? {
            return ZarrStore::open_zip(path, file, limits).map(zarr);
        }
        let format = recognise(&mut file, bytes).map_err(failed)?.map_err(|found| FormatFault::Unknown(found).of(path))?;
        let empty = |format| Listing { path: path.into(), format, bytes, dimensions: vec![], variables: vec![], attributes: vec![] };
        if let Format::Classic(version) = format {
            let (listing, store) = ClassicStore::open(empty(format), file, version)?;
            return Ok(Self { listing, store: Box::new(store), chunks: Chunks::new() });
        }
        if let Format::Grib(_) = format {
            let (listing, store, chunks) = GribStore::open(empty(format), file, limits)?;
            return Ok(Self { listing, store: Box::new(store), chunks });
        }
        if let Some((listing, store, chunks)) =
            expected.and_then(|expected| Hdf5Store::open_expected(empty(Format::NetCdf4), expected, limits))
        {
            return Ok(Self { listing, store: Box::new(store), chunks });
        }
        // libnetcdf reads all groups, follows all links and reads all attributes when it opens a file.
        let chunks = scan(path, limits)?;
        if let Some((listing, store)) = NetCdf4Store::open(empty(Format::NetCdf4))? {
            return Ok(Self { listing, store: Box::new(store), chunks });
        }
        let (listing, store) = Hdf5Store::open(empty(Format::Hdf5), limits)?;
        Ok(Self { listing, store: Box::new(store), chunks })
    }

    fn read(&self, name: &str, start: &[usize], count: &[usize], limits: &Limits) -> Result<Vec<f64>, FormatError> {
        let failed = |what: String| self.listing.read_error(name, what);
        let index = self.listing.find(name).ok_or_else(|| failed("it is gone".into()))?;
        let variable = &self.listing.variables[index];
        let shape = self.listing.shape(variable);
        let inside = start.len() == shape.len() && count.len() == shape.len();
        if !inside || (0..shape.len()).any(|k| start[k].checked_add(count[k]).is_none_or(|end| end > shape[k])) {
            return Err(failed(format!("{count:?} values from {start:?} were asked for, but its shape is {shape:?}")));
        }
        if variable.number == NumberType::Other {
            return Err(failed(variable.text(UNREADABLE).unwrap_or("it holds no numbers").into()));
        }
        let total = self.listing.check_count(variable, count)?;
        let chunk = self.chunks.get(name).copied().unwrap_or(0);
        limits.check_read(total, chunk).map_err(failed)?;
        let mut values: Vec<f64> = Vec::new();
        values.try_reserve_exact(total).map_err(|_| failed(format!("out of memory for {total} values")))?;
        if total > 0 {
            self.store.read(index, variable, start, count, &mut values).map_err(failed)?;
        }
        Ok(values)
    }
}

fn is_zip(file: &mut File, length: u64) -> std::io::Result<bool> {
    let mut head = [0u8; 4];
    if length >= 4 {
        file.read_exact(&mut head)?;
        file.seek(SeekFrom::Start(0))?;
    }
    Ok(head == *b"PK\x03\x04")
}

/// Recognises the format by the first bytes. The inner error names the format that they suggest instead.
fn recognise(file: &mut File, length: u64) -> std::io::Result<Result<Format, String>> {
    const HDF5: [u8; 8] = *b"\x89HDF\r\n\x1a\n";
    let mut head = [0u8; 8];
    let got = length.min(8) as usize;
    file.read_exact(&mut head[..got])?;
    file.seek(SeekFrom::Start(0))?;
    if let [b'C', b'D', b'F', version @ (1 | 2 | 5), ..] = head
        && got >= 4
    {
        return Ok(Ok(Format::Classic(version)));
    }
    if let [b'G', b'R', b'I', b'B', .., edition] = head {
        return Ok(Ok(Format::Grib(edition)));
    }
    // The signature of HDF5 may follow a user block of 512 bytes times a power of two.
    let mut at = 0u64;
    while at + 8 <= length && at <= 1 << 20 {
        let mut signature = [0u8; 8];
        file.seek(SeekFrom::Start(at))?;
        file.read_exact(&mut signature)?;
        if signature == HDF5 {
            return Ok(Ok(Format::Hdf5));
        }
        at = if at == 0 { 512 } else { at * 2 };
    }
    Ok(Err(match head {
        _ if got == 0 => "it is empty".into(),
        [0x1f, 0x8b, ..] => "it is compressed with gzip: unpack it first".into(),
        [b'C', b'D', b'F', version, ..] => format!("its version {version} is unknown"),
        _ => format!("it starts with {:?}", String::from_utf8_lossy(&head[..got])),
    }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::formats::messages::{Attribute, Dimension};
    use crate::formats::write::{NewVariable, Values, write_netcdf};

    #[test]
    fn requests_and_answers_survive_a_process_boundary() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.nc");
        let units = vec![("units", Attribute::Text("m s-1".into()))];
        let values = Values::Float32((0..6).map(|i| i as f32).collect());
        write_netcdf(&path, &[], &[NewVariable { name: "u", dimensions: vec![("y", 2), ("x", 3)], attributes: units, values }]).unwrap();
        let mut server = FormatServer::new(Limits::NONE);
        let mut ask = |request: Request| -> Response {
            let request = serde_json::from_str(&serde_json::to_string(&request).unwrap()).unwrap();
            serde_json::from_str(&serde_json::to_string(&server.answer(request).unwrap()).unwrap()).unwrap()
        };
        let Response::Listing(listing) = ask(Request::List { path: path.clone(), expected: None }) else { panic!("no listing") };
        assert_eq!(
            (listing.format, &listing.variables[0].name[..], listing.variables[0].units()),
            (Format::Classic(2), "u", Some("m s-1"))
        );
        let Response::Description(u) = ask(Request::Describe { path: path.clone(), variable: "u".into() }) else { panic!("not described") };
        assert_eq!(u.dimensions, [("y", 2), ("x", 3)].map(|(name, len)| Dimension { name: name.into(), len }));
        let block = Request::Read { path, variable: "u".into(), start: vec![0, 1], count: vec![2, 2] };
        assert_eq!(ask(block), Response::Values(vec![1.0, 2.0, 4.0, 5.0]));
    }
}
