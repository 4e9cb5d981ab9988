//! File formats: NetCDF classic, NetCDF-4, HDF5, GRIB and Zarr, as variables, attributes and numbers.
//!
//! In: one of three [`messages::Request`]s (list a file, describe a variable, read a hyperslab). Out: plain data ([`Listing`],
//! [`messages::Description`], values as `f64`, [`FormatError`]). No library handle leaves this room, so that it can move to a child
//! process. Calls no other room, and knows no meshes.
//!
//! [`DataFile`] is the client side of the requests. To add a format: implement [`store::Store`] and recognise its first bytes
//! in [`server`].

mod classic;
mod data_file;
mod grib;
mod guard;
mod hdf5;
mod libraries;
mod limits;
mod messages;
mod netcdf4;
mod scan;
mod server;
mod store;
mod write;
mod zarr;

pub use data_file::DataFile;
pub use guard::{read_without_locks, report_crashes};
pub use libraries::{hdf5_version, netcdf_version};
pub use limits::Limits;
pub use messages::{Attribute, Format, FormatError, FormatFault, Listing, NumberType, UNREADABLE, Variable};
pub use write::{NewVariable, Values, write_hdf5, write_netcdf};
pub use zarr::{ACCEPTED_URLS, checked_url, is_store, is_url};
