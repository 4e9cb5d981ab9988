//! Meaning of a mesh: axes, levels, poles and staggered points, and the velocity at the nodes of one grid.
//!
//! In: the listing of a file and its values (by requests to `formats`), settings. Out: a [`Layout`] (axes, components, times), and
//! the components of one time on the grid. Calls `formats` (requests only) and `cf`. Knows no file format: it distinguishes only
//! files that name their dimensions from files that do not.
//!
//! [`plan()`] chooses one of four plans: `rectilinear`, `curvilinear_plan` (also of unstructured meshes, whose points `unstructured_plan`
//! finds and `triangles` connects), `staggered_plan` (WRF) and `datasets` (no named dimensions). Two of them share `column` (levels that follow the bottom of the sea; WRF uses its interpolation) and `own_axes` (components on
//! coordinates of their own), and `refine` chooses
//! how fine the grid of `curvilinear_plan` is.

mod axes;
mod column;
mod column_field;
mod column_plan;
mod component;
mod content;
mod curvilinear;
mod curvilinear_plan;
mod datasets;
mod dimensions;
mod land;
mod layout;
mod levels;
mod locator;
mod mask;
mod nest;
mod own_axes;
mod plan;
mod planner;
mod poles;
mod rectilinear;
mod refine;
mod staggered;
mod staggered_plan;
mod times;
mod triangles;
mod unstructured_plan;
mod velocity_units;

pub use axes::{AxisPlan, FileOrder, InFile, Quantity, slab_of};
pub use component::{ComponentPlan, Orders, Role, read_component};
pub use content::{Content, content};
pub use land::Mask;
pub use layout::{Layout, Resampling, difference};
pub use levels::{REFERENCE_PRESSURE, SCALE_HEIGHT, to_heights};
pub use mask::{Masks, NO_MASK, ZERO, holds_mask};
pub use own_axes::read_levels;
pub use plan::{plan, readable_axes};
pub use poles::Poles;
pub use refine::ResamplingError;
pub use times::TimePlan;
pub use velocity_units::VelocityScale;
