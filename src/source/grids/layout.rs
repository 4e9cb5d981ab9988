//! The plan of how to read a file: components, axes, times, resampling.

use super::axes::AxisPlan;
use super::component::ComponentPlan;
use super::curvilinear::Curvilinear;
use super::poles::Poles;
use super::refine::{LARGE, ResamplingError};
use super::staggered::Staggered;
use super::times::TimePlan;
use crate::archive_settings::Metric;
use crate::cf::calendar::Calendar;
use crate::error::SourceError;
use crate::formats::{DataFile, Listing};
use ridgewatch_field::{Axis, AxisFault};
use std::sync::Arc;

/// How to read one file.
#[derive(Debug, Clone)]
pub struct Layout {
    /// u, v and, if it exists, w: one frame, or as many as there are datasets whose names carry a time.
    pub frames: Vec<Vec<ComponentPlan>>,
    /// x, y and, in three dimensions, z of the grid.
    pub axes: Vec<AxisPlan>,
    /// Factors from w in the file's SI to w along the grid's third axis, one for each level; empty if they are 1.
    pub vertical: Vec<f64>,
    pub poles: Poles,
    pub time: TimePlan,
    pub metric: Metric,
    /// Set if the nodes of the grid are not nodes of the file.
    pub resampling: Option<Resampling>,
    /// Choices and conversions, as sentences.
    pub notes: Vec<String>,
}

impl Layout {
    /// Names of the variables that the plan uses.
    pub fn used(&self, listing: &Listing) -> Vec<String> {
        let mut names: Vec<String> = self.frames.iter().flatten().map(|c| c.name.clone()).collect();
        names.extend(self.axes.iter().map(|a| a.axis.name().to_owned()).filter(|name| listing.find(name).is_some()));
        names.push(self.time.variable.clone());
        names
    }

    /// Widens the domain of a moving nest to that of a later file, which contains it.
    ///
    /// # Errors
    /// The wider axes cannot be made.
    pub fn widen(&mut self, later: &Self) -> Result<(), AxisFault> {
        let (Some(Resampling::Staggered(own)), Some(Resampling::Staggered(other))) = (&self.resampling, &later.resampling) else {
            return Ok(());
        };
        if own.reach == other.reach {
            return Ok(());
        }
        let wide = Staggered { reach: other.reach, ..(**own).clone() };
        let known = own.movement();
        self.notes.retain(|note| Some(note) != known.as_ref());
        self.notes.extend(wide.movement());
        for (axis, wider) in self.axes.iter_mut().zip(wide.horizontal()?) {
            *axis = wider;
        }
        self.resampling = Some(Resampling::Staggered(Arc::new(wide)));
        Ok(())
    }
}

/// How velocities come onto a grid whose nodes are not nodes of the file.
#[derive(Debug, Clone)]
pub enum Resampling {
    Staggered(Arc<Staggered>),
    Curvilinear(Arc<Curvilinear>),
}

impl Resampling {
    /// Reads one entry along time onto the grid. `levels` are the grid's, as [`super::own_axes::read_levels`] counts them.
    ///
    /// # Errors
    /// The values cannot be read.
    pub fn read(&self, file: &DataFile, frame: &[ComponentPlan], entry: usize, levels: &[usize]) -> Result<Vec<Vec<f32>>, SourceError> {
        match self {
            Self::Staggered(s) => s.read(file, frame, entry),
            Self::Curvilinear(c) => c.read(file, frame, entry, levels),
        }
    }

    /// Description of the resampling.
    pub fn what(&self) -> String {
        match self {
            Self::Staggered(s) => s.what.clone(),
            Self::Curvilinear(c) => c.what(),
        }
    }

    /// A warning about a large error, which says what to write.
    pub fn warning(&self, error: &ResamplingError) -> Option<String> {
        match self {
            Self::Curvilinear(c) if error.excess() > LARGE => Some(c.warning(error)),
            _ => None,
        }
    }

    /// Error of the resampling at one entry along time.
    ///
    /// # Errors
    /// The values cannot be read.
    pub fn error(&self, file: &DataFile, frame: &[ComponentPlan], entry: usize) -> Result<ResamplingError, SourceError> {
        match self {
            Self::Staggered(s) => s.error(file, frame, entry).map(ResamplingError::at_points),
            Self::Curvilinear(c) => Ok(c.error(&c.truth(file, frame, entry, true)?)),
        }
    }
}

/// First difference between the layouts of two files that keeps them from being one archive.
pub fn difference(a: &Layout, b: &Layout) -> Option<String> {
    let names = |l: &Layout| l.frames[0].iter().map(|c| format!("`{}`", c.name)).collect::<Vec<_>>().join(", ");
    // Names of datasets may carry the time.
    if names(a) != names(b) && a.frames.len() == 1 && !a.time.variable.is_empty() {
        return Some(format!("their velocities are {} and {}", names(a), names(b)));
    }
    if a.axes.len() != b.axes.len() {
        return Some(format!("they have {} and {} axes", a.axes.len(), b.axes.len()));
    }
    for (x, y) in a.axes.iter().zip(&b.axes) {
        if x.axis == y.axis && x.order == y.order {
            continue;
        }
        let (one, two) = (&x.axis, &y.axis);
        if one == two {
            return Some(format!("axis `{}` is in another order", one.name()));
        }
        let show = |a: &Axis| format!("`{}` of {} nodes from {} to {} {}", a.name(), a.len(), a.first(), a.last(), a.units());
        let detail = match one.coordinates().iter().zip(two.coordinates()).position(|(p, q)| p != q) {
            Some(i) if one.len() == two.len() => format!(", first at node {i}: {} and {}", one.coordinates()[i], two.coordinates()[i]),
            _ => String::new(),
        };
        return Some(format!("their axes are {} and {}{detail}", show(one), show(two)));
    }
    let calendar = |l: &Layout| l.time.calendar.map_or("none", Calendar::name);
    (calendar(a) != calendar(b)).then(|| format!("their calendars are {} and {}", calendar(a), calendar(b)))
}
