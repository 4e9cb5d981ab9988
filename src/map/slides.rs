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

/// Seeds per pixel: as many in all as a table with two nodes a pixel has along each axis, which every slide of a smooth picture traces as well.
const SEEDS: usize = 4;

/// Draws the slides of a run.
pub struct SlideMaps {
    plan: Plan,
    device: Device,
    /// Range of the colours, of the first slide with this tau and direction, so that maps of a run compare.
    range: Option<(f64, Direction, [f64; 2])>,
}

impl SlideMaps {
    /// Maps of a run; `None` for a flow in three dimensions, which has no map without a level.
    pub fn new(plan: &Plan, device: &Device) -> Option<Self> {
        (plan.domain.dimensions == 2).then(|| Self { plan: plan.clone(), device: device.clone(), range: None })
    }

    /// The map of a slide, with as many pixels along its longer edge as the frames have, and remarks for the user.
    ///
    /// # Errors
    /// No map shows the domain, no pixel has a velocity, or the device fails.
    pub fn draw(&mut self, shown: ShownSlide) -> Result<(SlideMap, Vec<String>), MapError> {
        let ShownSlide { slide, map } = shown;
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
        let made = make(&moment, &options, &self.device, &mut |_, _| ())?;
        self.range = Some((tau, direction, made.record.range));
        let record = serde_json::to_vec_pretty(&made.record).map_err(plot_error)?;
        Ok((SlideMap { slide: slide.index, png: write_png(&made.figure)?, record }, made.notes))
    }
}
