//! Maps: the FTLE of one moment as a picture for people, and its ridge lines.
//!
//! In: the settings of a scene, a device and what to show. Out: a picture (PNG, SVG), a record of it, and lines (GeoJSON, NetCDF, VTK). Calls `run`
//! and the rooms below it.
//!
//! Each pixel is the mean of the FTLE over what it covers, from seeds in two independent halves, whose difference is the stated error. Ridges are
//! found on a grid of their own.

mod arrows;
mod colour;
mod contour;
mod draw;
mod footprint;
mod graticule;
mod lines;
mod make;
mod moment;
mod projection;
mod record;
mod ridges;
mod view;
mod words;

pub use arrows::{Arrows, arrows};
pub use colour::{LAND, OUTSIDE, Ramp, overprinted};
pub use contour::contours;
pub use draw::{DrawError, MapFigure, write_png, write_svg};
pub use footprint::{MapTracer, Raster, RasterError, Sampling};
pub use graticule::{GridLine, graticule, latitude, longitude};
pub use lines::{LinesAbout, LinesFormat, RidgeLine, geojson, vtk, write_netcdf};
pub use make::{MOST_NODES, MapOptions, MapResult, make};
pub use moment::Moment;
pub use projection::{Projection, ProjectionKind};
pub use record::{MapRecord, PanelRecord, RidgeRecord};
pub use ridges::{Field, RidgePoint, Strength};
pub use view::{LARGEST, View, is_geographic};
pub use words::{Rate, date, duration, number};

use crate::run::RunError;
use thiserror::Error;

/// Error of a map.
#[derive(Debug, Error)]
pub enum MapError {
    /// An option is not accepted.
    #[error("{0}")]
    Usage(String),
    /// The scene, its source or the device fails.
    #[error(transparent)]
    Run(#[from] RunError),
    /// No pixel has a velocity.
    #[error("no pixel has a velocity at {0}: all seeds lie on missing cells (fill values or NaN; `ridgewatch inspect` counts them)")]
    AllMissing(String),
    /// The source is too short for both directions.
    #[error("both directions from one time need twice tau = {tau} of data: {error}")]
    Both {
        /// |tau|, in time units.
        tau: f64,
        /// Why the source cannot be opened for that.
        error: RunError,
    },
    /// The picture cannot be drawn.
    #[error(transparent)]
    Draw(#[from] DrawError),
}
