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
    /// Files that were joined to this one.
    others: Vec<DataFile>,
    /// For each variable that one of them holds, which one, and its name there; in the order of the listing, after the own ones.
    joined: Vec<(usize, String)>,
}

impl DataFile {
    /// Opens a file and lists it. See [`Request::List`] for `expected`.
    ///
    /// # Errors
    /// A file that is missing, damaged, of another format or beyond the limits.
    pub fn open(path: &Path, expected: Option<&Listing>, limits: Limits) -> Result<Self, FormatError> {
        let mut server = FormatServer::new(limits);
        match server.answer(Request::List { path: path.into(), expected: expected.cloned() })? {
            Response::Listing(listing) => {
                Ok(Self { listing, limits, server: RefCell::new(server), others: Vec::new(), joined: Vec::new() })
            }
            _ => Err(FormatFault::Damaged("it was not listed".into()).of(path)),
        }
    }

    /// Reads this file and another one as one. Of rows of one name and length the first counts; other names that repeat get the name of
    /// their file.
    pub fn join(mut self, other: Self) -> Self {
        let file = other.listing.path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
        for variable in &other.listing.variables {
            let mut joined = variable.clone();
            joined.dimensions = variable.dimensions.iter().map(|&d| self.listing.dimension(other.listing.dimensions[d].clone())).collect();
            if let Some(known) = self.listing.find(&joined.name) {
                if joined.dimensions.len() < 2 && self.listing.variables[known].dimensions == joined.dimensions {
                    continue;
                }
                joined.name = format!("{} ({file})", joined.name);
            }
            self.listing.variables.push(joined);
            self.joined.push((self.others.len(), variable.name.clone()));
        }
        self.listing.bytes += other.listing.bytes;
        self.others.push(other);
        self
    }

    /// The joined file that holds a variable, from 1, and its name there; 0 for this file.
    pub fn origin(&self, variable: usize) -> (usize, &str) {
        let own = self.listing.variables.len() - self.joined.len();
        match variable.checked_sub(own).and_then(|k| self.joined.get(k)) {
            Some((file, name)) => (file + 1, name),
            None => (0, &self.listing.variables[variable].name),
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
        if let Some((file @ 1.., name)) = self.listing.find(variable).map(|index| self.origin(index)) {
            return self.others[file - 1].describe(name);
        }
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
        if let (file @ 1.., name) = self.origin(variable) {
            let other = &self.others[file - 1];
            let index = other.listing.find(name).ok_or_else(|| other.listing.read_error(name, "it is gone"))?;
            return other.read(index, start, count);
        }
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
