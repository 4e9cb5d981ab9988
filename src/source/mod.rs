//! Sources of velocity: files, memory, or a running simulation.
//!
//! In: settings, and files or a simulation. Out: snapshots in time order. Calls `field`. Its rooms, each calling only those after
//! it:
//!
//! - `archive`: files in order of time, read ahead; inspection; archives in memory and of synthetic turbulence
//! - [`live`]: ring and relay of a running simulation
//! - `grids`: meaning of a mesh; knows no formats
//! - `cf`: conventions of names, units, calendars, packing
//! - `formats`: bytes and variables, reached through plain messages; knows no meshes
//!
//! Shared by the rooms: the trait [`SnapshotSource`] (`snapshots`), [`SourceError`] (`error`), the settings, and the mathematics of projections
//! (`projection`). Between `archive` and `grids`: what coordinates are called (`georeference`), velocities over the ground on planes (`ground`), and vertical
//! velocity from the horizontal one (`continuity`).

mod archive;
mod archive_settings;
mod cf;
mod continuity;
mod error;
mod formats;
mod georeference;
mod grids;
mod ground;
pub mod live;
mod projection;
mod snapshots;
mod source_settings;

pub use archive::{
    Archive, AxisReport, DEFAULT_READ_AHEAD, Every, GlobeTurbulence, Inspection, MemorySource, MissingReport, ReadAhead, ResamplingReport,
    ResolutionReport, Steady, TimeReport, VariableReport, expand, follow, inspect, read_ahead, synthesize,
};
pub use archive_settings::{ArchiveSettings, Metric, Staggering, SyntheticSettings, SyntheticShape, VelocityUnit};
pub use cf::calendar::utc;
pub use error::SourceError;
pub use formats::{FormatError, FormatFault, hdf5_version, is_url, netcdf_version, read_without_locks, report_crashes};
pub use georeference::{Coordinate, Georeference, GridMapping, MappingValue, Positions};
pub use grids::{FileOrder, InFile};
pub use snapshots::{Listener, News, SnapshotSource, SourceDescription, StillReading, TimeGap, duration, window_snapshots};
pub use source_settings::{DomainSettings, SourceKind, SourceSettings};
