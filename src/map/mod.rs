//! Maps: the FTLE of one moment as a picture for people, its ridge lines, and the ridge surfaces of volumes.
//!
//! In: the settings of a scene, a device and what to show. Out: a picture (PNG, SVG), a record of it, lines (GeoJSON, NetCDF, VTK) and surfaces (VTK,
//! PLY). Calls `run` and the rooms below it, and `publish` for the parts of VTK files.
//!
//! Each pixel is the mean of the FTLE over what it covers, from seeds in two independent halves, whose difference is the stated error. Ridges are
//! found on a grid of their own.

mod arrows;
mod colour;
mod contour;
mod draw;
mod find;
mod footprint;
mod graticule;
mod lines;
mod make;
mod moment;
mod page;
mod pieces;
mod record;
mod ridges;
mod sheet;
mod slides;
mod smoothing;
mod spline;
mod strip;
mod surface_files;
mod surfaces;
mod view;
mod volume;
mod words;

pub use arrows::{Arrows, arrows};
pub use colour::{LAND, OUTSIDE, Ramp, overprinted};
pub use contour::contours;
pub use draw::{MapFigure, write_png, write_svg};
pub use find::{FoundRidges, RidgesOfMoment, RidgesRecord, find};
pub use footprint::{MapTracer, Raster, RasterError, Sampling};
pub use graticule::{GridLine, degrees_over, graticule, latitude, longitude, nodes_over};
pub use lines::{LinesFormat, RidgeLine, RidgesAbout, geojson, vtk, write_netcdf};
pub use make::{MOST_NODES, MapOptions, MapResult, make};
pub use moment::Moment;
pub use page::FramePage;
pub use record::{MapRecord, PanelRecord, RidgeRecord};
pub use ridges::{Field, RidgePoint, Strength};
pub use sheet::DrawError;
pub use slides::{Drawn, SlideMaps};
pub use strip::annotated;
pub use surface_files::{SurfacesAbout, SurfacesFormat};
pub use surfaces::{Surface, SurfacePoint, Surfaces};
pub use view::{LARGEST, View, is_geographic};
pub use volume::Volume;
pub use words::{Rate, date, duration, number};

pub use crate::render::{Projection, ProjectionKind};
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
    /// Whoever watches the progress ended it.
    #[error("the map was abandoned")]
    Stopped,
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
