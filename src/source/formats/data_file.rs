//! One file, seen through requests.

use super::limits::Limits;
use super::messages::{Description, FormatError, FormatFault, Listing, Request, Response};
use super::server::FormatServer;
use std::cell::RefCell;
use std::path::Path;

/// A listed file whose values are read on request.
pub struct DataFile {
    /// Contents of the file.
    pub listing: Listing,
    /// What reading it may cost.
    pub limits: Limits,
    server: RefCell<FormatServer>,
}

impl DataFile {
    /// Opens a file and lists it. See [`Request::List`] for `expected`.
    ///
    /// # Errors
    /// A file that is missing, damaged, of another format or beyond the limits.
    pub fn open(path: &Path, expected: Option<&Listing>, limits: Limits) -> Result<Self, FormatError> {
        let mut server = FormatServer::new(limits);
        match server.answer(Request::List { path: path.into(), expected: expected.cloned() })? {
            Response::Listing(listing) => Ok(Self { listing, limits, server: RefCell::new(server) }),
            _ => Err(FormatFault::Damaged("it was not listed".into()).of(path)),
        }
    }

    fn ask(&self, request: Request) -> Result<Response, FormatError> {
        self.server.borrow_mut().answer(request)
    }

    /// Type, dimensions and attributes of a variable.
    ///
    /// # Errors
    /// A variable that does not exist.
    pub fn describe(&self, variable: &str) -> Result<Description, FormatError> {
        match self.ask(Request::Describe { path: self.listing.path.clone(), variable: variable.into() })? {
            Response::Description(description) => Ok(description),
            _ => Err(self.listing.read_error(variable, "it was not described")),
        }
    }

    /// Raw values of a hyperslab as `f64` (not unpacked), in the file's order, slowest dimension first.
    ///
    /// # Errors
    /// A block outside the variable, values that are not numbers, a damaged file, too little memory.
    pub fn read(&self, variable: usize, start: Vec<usize>, count: Vec<usize>) -> Result<Vec<f64>, FormatError> {
        let name = &self.listing.variables[variable].name;
        match self.ask(Request::Read { path: self.listing.path.clone(), variable: name.clone(), start, count })? {
            Response::Values(values) => Ok(values),
            _ => Err(self.listing.read_error(name, "it was not read")),
        }
    }

    /// All values of a variable.
    ///
    /// # Errors
    /// As for [`DataFile::read`].
    pub fn read_all(&self, variable: usize) -> Result<Vec<f64>, FormatError> {
        let shape = self.listing.shape(&self.listing.variables[variable]);
        self.read(variable, vec![0; shape.len()], shape)
    }

    /// Rows of characters along the last dimension, without padding.
    ///
    /// # Errors
    /// As for [`DataFile::read`].
    pub fn read_text(&self, variable: usize) -> Result<Vec<String>, FormatError> {
        let width = self.listing.shape(&self.listing.variables[variable]).last().copied().unwrap_or(1).max(1);
        let bytes = self.read_all(variable)?;
        let row = |row: &[f64]| row.iter().map(|&b| char::from(b as u8)).collect::<String>();
        Ok(bytes.chunks(width).map(|r| row(r).trim_matches(['\0', ' ']).to_owned()).collect())
    }
}
