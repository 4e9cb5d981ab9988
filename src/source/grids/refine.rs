//! How fine the grid of a mesh has to be, by measurement.
//!
//! Particles move through the grid, whose bilinear interpolation runs along longitudes and latitudes. It is compared with interpolation in the
//! mesh itself (inverse bilinear, see [`super::curvilinear`]) on one snapshot: at the mesh's own points, and at places anywhere between
//! them. The grid is refined until both errors are small, or a bound is reached.

use super::component::{ComponentPlan, SquaredErrors};
use super::curvilinear::{Curvilinear, Vectors, locators};
use super::locator::Target;
use super::own_axes::read_levels;
use crate::error::SourceError;
use crate::formats::DataFile;
use std::fmt;
use std::sync::Arc;

/// Errors that the grid is refined to, as shares of the root mean square velocity: at the file's own points, where interpolation in the mesh has its
/// kinks and the error is largest, and between them, where particles are.
const WANTED: [f64; 2] = [0.025, 0.006];
/// Multiple of these above which there is a warning.
pub const LARGE: f64 = 2.0;
/// Most nodes of a refined grid, levels included.
pub const MAX_NODES: usize = 1 << 24;
/// Most nodes of a refined grid, for each point of the mesh; those in the box around a turned mesh count too.
const MAX_NODES_A_POINT: usize = 256;
/// Most levels on which the error of grids to choose from is measured.
const MEASURED_LEVELS: usize = 3;
/// Power of the spacing with which the error falls, about: 1 where interpolation in the mesh has kinks, 2 between them.
const ORDER: f64 = 1.5;
/// Smallest and largest factor by which spacings are reduced at once.
const FACTORS: [f64; 2] = [1.25, 2.0];
/// Share of the error that has to go when the spacing is reduced; otherwise it has another reason.
const GAIN: f64 = 0.03;
/// Smallest factor for which there has to be room.
const LEAST_ROOM: f64 = 1.1;

/// Error of a resampling on one snapshot, in m/s, root mean squares over components.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ResamplingError {
    /// Interpolation on the grid minus the file's values, at the file's own points.
    pub at_points: f64,
    /// Interpolation on the grid minus interpolation in the mesh, between the points. `None` if it is not measured.
    pub between: Option<f64>,
    /// The file's velocity.
    pub velocity: f64,
}

impl ResamplingError {
    /// From root mean squares of error and velocity at the file's points.
    pub fn at_points([at_points, velocity]: [f64; 2]) -> Self {
        Self { at_points, between: None, velocity }
    }

    /// The greater error, as a multiple of the one that is wanted.
    pub fn excess(&self) -> f64 {
        let worst = (self.at_points / WANTED[0]).max(self.between.unwrap_or(0.0) / WANTED[1]);
        // Without any motion nothing is wrong.
        if worst > 0.0 { worst / self.velocity.max(f64::MIN_POSITIVE) } else { 0.0 }
    }
}

impl fmt::Display for ResamplingError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.velocity == 0.0 {
            return f.write_str("an unknown amount, since nothing moves in the snapshot that was looked at");
        }
        let percent = |error: f64| 100.0 * error / self.velocity.max(f64::MIN_POSITIVE);
        // Slow flows have more decimals.
        let digits = if self.velocity > 0.0 { (1.0 - self.velocity.log10().floor()).clamp(3.0, 9.0) as usize } else { 3 };
        let Self { at_points, velocity, .. } = self;
        write!(f, "{at_points:.digits$} m/s of {velocity:.digits$} m/s ({:.1} %) at the file's own points", percent(*at_points))?;
        match self.between {
            Some(between) => write!(f, ", {between:.digits$} m/s ({:.1} %) between them", percent(between)),
            None => Ok(()),
        }
    }
}

/// Why a grid has its spacing.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Choice {
    /// The settings say so.
    Set,
    /// It is the mesh's own, divided by `factor`.
    Mesh { factor: f64, stopped: Option<Stop> },
}

/// Why a grid is not finer, although its error is larger than wanted.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Stop {
    /// It would have more nodes, levels included.
    Nodes(usize),
    /// The error no longer falls.
    NoGain,
}

impl fmt::Display for Choice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self::Mesh { factor, stopped } = self else { return f.write_str("as set") };
        // In tenths of a per cent.
        let [points, between] = WANTED.map(|share| (1000.0 * share).round() / 10.0);
        let wanted = format!("{points} % at the file's own points and {between} % between them");
        if *factor > 1.0 {
            write!(f, "{factor:.1} times finer than the mesh's median spacing")?;
        } else {
            f.write_str("the mesh's median spacing")?;
        }
        match stopped {
            None => write!(f, ", for errors of at most {wanted}"),
            Some(Stop::Nodes(most)) => write!(f, "; errors of {wanted} need more than {most} nodes"),
            Some(Stop::NoGain) => write!(f, "; a finer grid errs no less"),
        }
    }
}

/// Velocities of one snapshot with which grids are compared.
pub struct Truth {
    /// u and v at their own points, level after level.
    own: [Vec<f32>; 2],
    places: Target,
    /// At `places`, for each level, by interpolation in the mesh.
    between: Vec<Vectors>,
}

impl Truth {
    /// True if some velocity is not 0.
    pub fn moves(&self) -> bool {
        self.own.iter().flatten().any(|value| value.is_finite() && *value != 0.0)
    }
}

impl Curvilinear {
    /// Warning about an error, and what to write.
    pub fn warning(&self, error: &ResamplingError) -> String {
        let [dx, dy] = self.target.step;
        let half = format!("--set archive.resolution=[{:.4},{:.4}]", dx / 2.0, dy / 2.0);
        let remedy = match self.choice {
            Choice::Set => "the resolution is kept as set; without `archive.resolution` it is chosen by the error".into(),
            Choice::Mesh { stopped: Some(Stop::NoGain), .. } => {
                "a finer grid errs no less: are the longitudes and latitudes those of the velocities? Name others with --set archive.x=NAME \
                 --set archive.y=NAME"
                    .into()
            }
            Choice::Mesh { .. } => format!(
                "a finer grid takes more nodes than are chosen by default: write {half}, or read one level with --set archive.level=VALUE; \
                 --set archive.memory_gib=NUMBER allows more memory"
            ),
        };
        format!("WARNING: interpolation on the grid that the mesh is resampled to errs by {error}, and the FTLE by more: {remedy}")
    }

    /// Reads the velocities at an entry along time, on a few levels or on all.
    pub fn truth(&self, file: &DataFile, frame: &[ComponentPlan], entry: usize, all_levels: bool) -> Result<Truth, SourceError> {
        let values = |plan: &ComponentPlan| {
            let ([x, y, _], all) = (plan.file_order(), plan.levels());
            let few = if all_levels { all } else { all.min(MEASURED_LEVELS) };
            let levels = (0..few).map(|k| if few > 1 { k * (all - 1) / (few - 1) } else { 0 }).collect();
            read_levels(file, plan, &[x, y, levels], entry)
        };
        let own = [values(&frame[0])?, values(&frame[1])?];
        let places = self.target.between();
        let located = locators(&self.meshes[..2], &places);
        let between = self.vectors(&located, &own[0], &own[1]).collect();
        Ok(Truth { own, places, between })
    }

    /// Error of interpolation on the grid. Interpolates vectors, as the flow is sampled.
    pub fn error(&self, truth: &Truth) -> ResamplingError {
        let on_grid = self.horizontal(&truth.own[0], &truth.own[1]);
        let nodes = self.bases[0].len();
        let (mut at_points, mut between) = (SquaredErrors::default(), SquaredErrors::default());
        let bases = truth.places.bases();
        let levels = on_grid[0].chunks_exact(nodes).zip(on_grid[1].chunks_exact(nodes)).zip(&truth.between);
        for (level, ((east, north), expected)) in levels.enumerate() {
            let vectors: Vectors =
                std::array::from_fn(|k| (0..nodes).map(|n| east[n] * self.bases[0][n][k] + north[n] * self.bases[1][n][k]).collect());
            let at = |place: [f64; 2]| [0, 1, 2].map(|k| self.target.interpolate(&vectors[k], place[0], place[1]));
            let along = |vector: [f64; 3], direction: [f32; 3]| (0..3).map(|k| vector[k] * f64::from(direction[k])).sum::<f64>();
            for which in 0..2 {
                let mesh = &self.meshes[which];
                let points = mesh.longitude.len();
                for (point, &value) in truth.own[which][level * points..][..points].iter().enumerate() {
                    let found = at([mesh.longitude[point], mesh.latitude[point]]);
                    at_points.add(along(found, self.directions[which][point]), value.into());
                }
            }
            for node in 0..expected[0].len() {
                let place = truth.places.place(node);
                // As many in each area of the sphere.
                let (share, column) = (place[1].to_radians().cos(), (node % truth.places.nodes[0]) as f64);
                if (share * (column + 1.0)).floor() <= (share * column).floor() {
                    continue;
                }
                let (found, expected) = (at(place), [0, 1, 2].map(|k| f64::from(expected[k][node])));
                for base in &bases {
                    between.add(along(found, base[node]), along(expected, base[node]));
                }
            }
        }
        let ([at_points, velocity], [between, _]) = (at_points.root_mean_squares(), between.root_mean_squares());
        ResamplingError { at_points, between: Some(between), velocity }
    }

    /// A grid that is fine enough, of at most `most` nodes on each of `levels` levels.
    pub fn refined(self: &Arc<Self>, truth: &Truth, most: usize, levels: usize) -> Arc<Self> {
        let most = most.min(MAX_NODES / levels.max(1)).min(MAX_NODES_A_POINT.saturating_mul(self.meshes[0].longitude.len()));
        let (mut best, mut error, mut fineness) = (self.clone(), self.error(truth).excess(), 1.0);
        let stopped = |best: &Self, factor: f64, stop: Stop| {
            let choice = Choice::Mesh { factor, stopped: Some(stop) };
            Arc::new(Self { choice, ..best.clone() })
        };
        while error > 1.0 {
            let room = (most as f64 / best.bases[0].len() as f64).sqrt();
            if room < LEAST_ROOM {
                return stopped(&best, fineness, Stop::Nodes(most.saturating_mul(levels)));
            }
            let factor = error.powf(1.0 / ORDER).clamp(FACTORS[0], FACTORS[1]).min(room);
            let finer = Arc::new(best.on(best.target.finer(factor), Choice::Mesh { factor: fineness * factor, stopped: None }));
            let found = finer.error(truth).excess();
            if found > error * (1.0 - GAIN) {
                return stopped(&best, fineness, Stop::NoGain);
            }
            (best, error, fineness) = (finer, found, fineness * factor);
        }
        best
    }
}
