//! A running simulation: steps from its ring or from relays fill the window while frames are made.
//!
//! In: the ring of this node, or relays. Out: the window as it is at one moment ([`Taken`]). Calls `field`, and `grids` for the slab of
//! a plane. One thread reads, assembles blocks, skips steps if memory is short, and fills the window. The cycle takes the window
//! when it needs one, so a frame uses the newest steps, and the ring is read at the simulation's pace.

mod conversion;
mod link;
mod settings;
mod simulation;
mod thinning;
mod window;

pub use link::ring_of;
pub use settings::{AtEnd, Follow, LiveSettings};
pub use simulation::Live;
pub use window::{LiveRecord, LiveWindow, NextWindow, Taken};
