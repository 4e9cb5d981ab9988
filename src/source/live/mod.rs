//! A simulation that runs now: steps from its ring or from relays fill the window while frames are made.
//!
//! One thread reads, puts blocks together, thins in time where memory is short, and keeps the window; the cycle takes the window as it is
//! at that moment. So frames are of the newest, however long they take, and the ring is read at the simulation's pace.

mod conversion;
mod link;
mod settings;
mod thinning;
mod window;

pub use link::ring_of;
pub use settings::{AtEnd, Follow, LiveSettings};
pub use window::{LiveRecord, LiveWindow, Taken};

use super::SourceError;
use crate::field::{Axis, Geometry, Grid};
use link::Link;
use ridgewatch_wire::{Description, Event, Limits};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// A simulation that was found.
pub struct Live {
    link: Link,
    description: Description,
    generation: u64,
    grid: Arc<Grid>,
    settings: LiveSettings,
}

impl Live {
    /// Waits until a simulation is there, or `stop` is set (none then). `tell` hears how to connect, and what was refused.
    ///
    /// # Errors
    /// A folder or connection file that is not this user's alone, or no way named at all.
    pub fn connect(settings: &LiveSettings, stop: &AtomicBool, tell: &mut dyn FnMut(String)) -> Result<Option<Self>, SourceError> {
        let limits = Limits { step_bytes: memory(settings) };
        let (mut link, how) = Link::open(settings, limits)?;
        tell(how);
        let mut values = Vec::new();
        while !stop.load(Ordering::Relaxed) {
            match link.poll(&mut values, &|_, _| false) {
                Some(Event::Opened { description, generation }) => match grid(&description) {
                    Ok(grid) => {
                        return Ok(Some(Self {
                            link,
                            description: *description,
                            generation,
                            grid: Arc::new(grid),
                            settings: settings.clone(),
                        }));
                    }
                    Err(what) => tell(format!("a simulation was refused: {what}")),
                },
                Some(Event::Refused(error)) => tell(format!("refused: {error}")),
                // What belongs to a simulation that was refused.
                Some(Event::Step { .. } | Event::Ended { .. }) | None => {}
            }
        }
        Ok(None)
    }

    /// The global grid.
    pub fn grid(&self) -> &Arc<Grid> {
        &self.grid
    }

    /// Unit of the times.
    pub fn time_unit(&self) -> &str {
        &self.description.time_unit
    }

    /// What it is, in words.
    pub fn describe(&self) -> String {
        let [x, y, z] = self.description.shape();
        format!("{x} x {y} x {z} nodes in {} block(s), time in {}", self.description.block.count, self.description.time_unit)
    }

    /// Starts to fill a window over `tau`; with [`Follow::Every`] a slide is `stride` steps.
    ///
    /// # Errors
    /// Too little memory for three snapshots, or the thread could not be started.
    pub fn follow(self, tau: f64, stride: usize) -> Result<LiveWindow, SourceError> {
        LiveWindow::start(self, tau, stride)
    }
}

/// Bytes that the settings allow.
fn memory(settings: &LiveSettings) -> u64 {
    (settings.memory_gib * f64::from(1 << 30)) as u64
}

/// The grid that a simulation describes; its description was checked.
fn grid(description: &Description) -> Result<Grid, String> {
    let axes: Result<Vec<Axis>, _> = description
        .axes
        .iter()
        .map(|axis| {
            let made = Axis::new(&axis.name, &axis.unit, axis.coordinates.clone())?;
            Ok(match axis.period {
                Some(period) => made.with_period(period),
                None => made,
            })
        })
        .collect();
    let axes = axes.map_err(|fault: crate::field::AxisFault| fault.to_string())?;
    let geometry = match description.geometry {
        ridgewatch_wire::Geometry::Cartesian => Geometry::Cartesian,
        ridgewatch_wire::Geometry::Sphere { radius } => Geometry::Sphere { radius },
    };
    let slab = super::slab_of(&axes);
    Ok(Grid { axes, geometry, slab })
}
