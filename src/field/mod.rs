//! Velocity data: axes and grids, snapshots, missing cells, the sliding window, closed-form flows.
//!
//! In: velocities from `source`. Out: the fields that `flow` integrates. Calls only `simd`.

mod axis;
mod domain;
mod grid;
mod snapshot;
mod window;

pub mod analytic;
pub mod turbulence;

pub use axis::{Axis, AxisFault};
pub use domain::{Domain, DomainPoint, UnitPoint};
pub use grid::{Geometry, Grid, VERTICAL_EDGE, is_pole};
pub use snapshot::Snapshot;
pub use window::{Pushed, Window, WindowFault, WindowWarning};

/// Radius of the sphere on which longitude-latitude data are advected, in metres (IUGG mean radius R1).
pub const EARTH_RADIUS: f64 = 6_371_008.8;
