//! Connection to a simulation.

use super::link::Link;
use super::settings::LiveSettings;
use crate::error::SourceError;
use crate::grids::slab_of;
use ridgewatch_base::progress;
use ridgewatch_field::{Axis, AxisFault, Geometry, Grid};
use ridgewatch_wire::{Description, Event, Limits};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// A connected simulation.
pub struct Live {
    pub(super) link: Link,
    pub(super) description: Description,
    pub(super) generation: u64,
    pub(super) grid: Arc<Grid>,
    pub(super) settings: LiveSettings,
}

impl Live {
    /// Waits for a simulation. `None` if `stop` is set first. `tell` receives instructions to connect, and refusals.
    ///
    /// # Errors
    /// A folder or connection file that other users can write; settings that name neither.
    pub fn connect(settings: &LiveSettings, stop: &AtomicBool, tell: &mut dyn FnMut(String)) -> Result<Option<Self>, SourceError> {
        let limits = Limits { step_bytes: settings.memory_bytes() };
        let (mut link, how) = Link::open(settings, limits)?;
        tell(how);
        let mut values = Vec::new();
        while !stop.load(Ordering::Relaxed) {
            progress::mark();
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
                // Events of a refused simulation.
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

    /// Description for the user.
    pub fn describe(&self) -> String {
        let [x, y, z] = self.description.shape();
        let unit = match self.time_unit() {
            "" => "time without a unit".to_owned(),
            unit => format!("time in {unit}"),
        };
        format!("{x} x {y} x {z} nodes in {} block(s), {unit}", self.description.block.count)
    }
}

/// The grid of a checked description.
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
    let axes = axes.map_err(|fault: AxisFault| fault.to_string())?;
    let geometry = match description.geometry {
        ridgewatch_wire::Geometry::Cartesian => Geometry::Cartesian,
        ridgewatch_wire::Geometry::Sphere { radius } => Geometry::Sphere { radius },
    };
    let slab = slab_of(&axes);
    Ok(Grid { axes, geometry, slab })
}
