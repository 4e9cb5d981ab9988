//! Maps of the slides of a run.

use super::draw::write_png;
use super::footprint::Sampling;
use super::make::{MapOptions, make};
use super::sheet::plot_error;
use super::view::LARGEST;
use super::{MapError, Moment};
use crate::backend::Device;
use crate::flow::Direction;
use crate::publish::SlideMap;
use crate::run::{Plan, ShownSlide};
use std::collections::HashSet;
use std::sync::atomic::{AtomicBool, Ordering};

/// Seeds per pixel: as many in all as a table with two nodes a pixel has along each axis, which every slide of a smooth picture traces as well.
const SEEDS: usize = 4;

/// Draws the slides of a run.
pub struct SlideMaps {
    plan: Plan,
    device: Device,
    /// Range of the colours, of the first slide since tau or direction was steered, so that maps of a run compare.
    range: Option<(f64, Direction, [f64; 2])>,
    /// Remarks made so far; they are few.
    told: HashSet<String>,
}

impl SlideMaps {
    /// Maps of a run; `None` for a flow in three dimensions, which has no map without a level.
    pub fn new(plan: &Plan, device: &Device) -> Option<Self> {
        (plan.domain.dimensions == 2).then(|| Self { plan: plan.clone(), device: device.clone(), range: None, told: HashSet::new() })
    }

    /// The map of a slide, with as many pixels along its longer edge as the frames have (16 to 4096), and remarks for the user that were not made before.
    ///
    /// # Errors
    /// No map shows the domain, no pixel has a velocity, or the device fails; [`MapError::Stopped`] soon after `stop` is set.
    pub fn draw(&mut self, shown: ShownSlide, stop: &AtomicBool) -> Result<(SlideMap, Vec<String>), MapError> {
        let ShownSlide { slide, map, .. } = shown;
        let (tau, direction) = (map.tau, map.direction);
        self.plan.map = map;
        let scene = &self.plan.scene;
        let options = MapOptions {
            pixels: scene.render.width.max(scene.render.height).clamp(16, LARGEST),
            sampling: Sampling { seeds: SEEDS, seed: scene.seed },
            projection: None,
            level: None,
            both: false,
            range: self.range.filter(|of| (of.0, of.1) == (tau, direction)).map(|(_, _, range)| range),
            contours: Vec::new(),
            arrows: false,
            ridges: None,
            ridge_grid: None,
        };
        let (plan, notes) = (self.plan.clone(), Vec::new());
        let moment = Moment { plan, velocity: slide.velocity, time: slide.time, date: slide.date, taus: vec![tau], notes };
        let made = make(&moment, &options, &self.device, &mut |_, _| !stop.load(Ordering::Relaxed))?;
        self.range = Some((tau, direction, made.record.range));
        let notes: Vec<String> = made.notes.into_iter().filter(|note| self.told.insert(note.clone())).collect();
        let record = serde_json::to_vec_pretty(&made.record).map_err(plot_error)?;
        Ok((SlideMap { slide: slide.index, png: write_png(&made.figure)?, record }, notes))
    }
}
