//! The CF conventions for velocity fields: units, calendars, coordinates, packing, names of the velocity.
//!
//! In: variables and attributes as plain data. Out: their meaning. Calls `formats` for its plain data only, and reads no file.
//!
//! Source: "NetCDF Climate and Forecast (CF) Metadata Conventions", version 1.11, chapters 3, 4 and 8.

pub mod calendar;
pub mod coordinate;
pub mod packing;
pub mod time;
pub mod units;
pub mod velocity;
