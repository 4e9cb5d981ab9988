//! The FTLE field of one slide or several, in files that other programs read: NetCDF by the CF conventions, and VTK.
//!
//! One slide is held in memory at a time. A file has its name only when it is whole.

mod cf;
mod pixels;
mod seeds;
mod vtk;

use super::error::PublishError;
use crate::field::{Domain, Geometry};
use crate::flow::{Direction, VelocitySource};
use crate::run::{Plan, Slide};
use crate::setting::word;
use crate::source::Georeference;
use cf::CfFile;
pub(crate) use cf::add_mapping;
pub use pixels::{MapAbout, NoField, map_netcdf};
pub use seeds::{NewestSlide, SeedField, SlideField, seeds};
use std::path::{Path, PathBuf};
use vtk::{VtkFiles, VtkKind};

/// A file format of fields.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FieldFormat {
    /// NetCDF classic with 64-bit offsets, by the CF conventions; all slides in one file.
    NetCdf,
    /// VTK image data (`.vti`): even spacing.
    VtkImage,
    /// VTK rectilinear grid (`.vtr`): the source's coordinates.
    VtkRectilinear,
    /// VTK structured grid (`.vts`): points in space; those of a sphere lie on it, in metres.
    VtkStructured,
}

impl FieldFormat {
    /// The format that a file's extension names.
    ///
    /// # Errors
    /// Another extension; the text says what is accepted.
    pub fn of(path: &Path) -> Result<Self, &'static str> {
        match path.extension().and_then(|extension| extension.to_str()).map(str::to_ascii_lowercase).as_deref() {
            Some("nc" | "nc3" | "cdf") => Ok(Self::NetCdf),
            Some("vti") => Ok(Self::VtkImage),
            Some("vtr") => Ok(Self::VtkRectilinear),
            Some("vts") => Ok(Self::VtkStructured),
            _ => Err("accepted: names that end in .nc, .vti, .vtr or .vts, or any name with --format"),
        }
    }
}

/// What the fields of all slides share.
#[derive(Debug, Clone)]
pub struct FieldFrame {
    /// Seeds along x, y and z; 1 along z in two dimensions. They lie from edge to edge of the domain.
    pub grid: [usize; 3],
    domain: Domain,
    geometry: Geometry,
    /// Names and units of the coordinates of the domain.
    axes: [[String; 2]; 3],
    georeference: Georeference,
    direction: Direction,
    time_unit: String,
    title: String,
    source: String,
    integrator: String,
    tau: f64,
    /// Line of the file's history.
    history: String,
    /// True if every field has the error of each seed.
    pointwise: Option<&'static str>,
    of: Of,
}

/// What the values of a field are of.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Of {
    /// Seeds, with their lifetime and status.
    Seeds,
    /// Pixels of a map: means, with the share that has no velocity.
    Pixels,
}

/// The FTLE of one slide; arrays have one value a seed, x fastest.
#[derive(Debug, Clone, Copy)]
pub struct Field<'a> {
    /// Seed time.
    pub time: f64,
    /// FTLE in 1/time; not finite without a velocity, or where the integration overflowed.
    pub ftle: &'a [f64],
    /// Share of tau until the particle stopped.
    pub lifetime_share: &'a [f32],
    /// Whether the seed has no velocity.
    pub missing: &'a [bool],
    /// Absolute error of each FTLE, where it is known.
    pub error: Option<&'a [f64]>,
    /// Root mean square of the difference of the FTLE from that of twice as many steps, where it is known.
    pub error_of_steps: Option<f64>,
    /// Integration steps; 0 for adaptive ones.
    pub steps: usize,
}

/// What became of a particle: values of `status`.
const STATUS: [(i8, &str); 4] = [(0, "integrated_over_tau"), (1, "left_or_stopped_earlier"), (2, "no_velocity"), (3, "overflow")];

impl FieldFrame {
    /// Of a plan and one of its slides. `history` describes the command, with its date. `pointwise` names the truth if every field will have the error
    /// of each seed.
    pub fn new(plan: &Plan, slide: &Slide, grid: [usize; 3], history: String, pointwise: Option<&'static str>) -> Self {
        let geometry = match &slide.velocity {
            VelocitySource::Window(window) => window.grid().map_or(Geometry::Cartesian, |grid| grid.geometry),
            VelocitySource::Analytic(..) => Geometry::Cartesian,
        };
        Self {
            grid,
            domain: plan.domain.clone(),
            geometry,
            axes: slide.velocity.axes(),
            georeference: plan.georeference.clone(),
            direction: plan.map.direction,
            time_unit: plan.time_unit.clone(),
            title: plan.scene.title.clone(),
            source: plan.source.clone(),
            integrator: format!("{}, {}", word(plan.map.integrator), word(plan.map.precision)),
            tau: plan.map.tau,
            history,
            pointwise,
            of: Of::Seeds,
        }
    }

    fn dimensions(&self) -> usize {
        self.domain.dimensions
    }

    /// Coordinates of the seeds along an axis, in those of the domain.
    fn coordinates(&self, axis: usize) -> Vec<f64> {
        let n = self.grid[axis];
        let step = self.domain.extent()[axis] / (n - 1).max(1) as f64;
        (0..n).map(|i| self.domain.min[axis] + step * i as f64).collect()
    }

    /// Name of an axis that is a word in every format: that of the source, unless another variable has it.
    fn axis_name(&self, axis: usize) -> String {
        const TAKEN: [&str; 10] = [
            "time",
            "time_bounds",
            "ftle",
            "ftle_error",
            "ftle_error_of_steps",
            "lifetime",
            "status",
            "integration_steps",
            "window",
            "missing_share",
        ];
        let own = ["x", "y", "z"][axis];
        let Some(coordinate) = self.georeference.axes.get(axis) else { return own.into() };
        // A dataset in a group is called by its path.
        let last = coordinate.name.rsplit('/').next().unwrap_or_default();
        let mut name: String = last.chars().map(|c| if c.is_ascii_alphanumeric() || c == '_' { c } else { '_' }).collect();
        if !name.starts_with(|c: char| c.is_ascii_alphabetic()) {
            name = format!("{own}_{name}");
        }
        let same = |other: &usize| *other != axis && self.georeference.axes.get(*other).is_some_and(|o| o.name == coordinate.name);
        let mapping = self.georeference.mapping.as_ref().is_some_and(|mapping| mapping.name == name);
        if TAKEN.contains(&name.as_str()) || mapping || (0..3).any(|k| same(&k)) { format!("{own}_{name}") } else { name }
    }

    /// Unit of times that UDUNITS knows.
    fn time_units(&self) -> &str {
        if self.time_unit == "s" { "s" } else { "1" }
    }

    fn ftle_units(&self) -> &'static str {
        if self.time_unit == "s" { "s-1" } else { "1" }
    }

    /// Start and end of the integration of a field, ascending.
    fn window(&self, time: f64) -> [f64; 2] {
        let other = time + self.direction.sign() * self.tau;
        [time.min(other), time.max(other)]
    }
}

impl Field<'_> {
    fn status(&self) -> impl Iterator<Item = i8> {
        let left = |share: f32| if share < 1.0 { 1 } else { 0 };
        self.ftle.iter().zip(self.lifetime_share).zip(self.missing).map(move |((ftle, &share), &missing)| {
            match (missing, ftle.is_finite()) {
                (true, _) => 2,
                (false, false) => 3,
                (false, true) => left(share),
            }
        })
    }

    /// Time until the particle stopped, at most tau. `None` without a velocity.
    fn lifetimes(&self, tau: f64) -> impl Iterator<Item = Option<f64>> {
        self.lifetime_share.iter().zip(self.missing).map(move |(&share, &missing)| (!missing).then_some(f64::from(share) * tau))
    }
}

/// Writes fields, one after the other.
pub struct FieldExport {
    path: PathBuf,
    files: Files,
}

enum Files {
    Cf(CfFile),
    Vtk(VtkFiles),
}

impl FieldExport {
    /// Begins a file, or several for a series in a VTK format: `NAME_000000.vti` and so on, and `NAME.pvd`, which names them all with their times.
    ///
    /// # Errors
    /// The file cannot be created; a frame that a format cannot hold.
    pub fn create(path: &Path, format: FieldFormat, frame: FieldFrame, series: bool) -> Result<Self, PublishError> {
        let kind = match format {
            FieldFormat::NetCdf => {
                let files = CfFile::create(path, frame).map_err(|e| failed(path, e))?;
                return Ok(Self { path: path.to_owned(), files: Files::Cf(files) });
            }
            FieldFormat::VtkImage => VtkKind::Image,
            FieldFormat::VtkRectilinear => VtkKind::Rectilinear,
            FieldFormat::VtkStructured => VtkKind::Structured,
        };
        Ok(Self { path: path.to_owned(), files: Files::Vtk(VtkFiles::new(path, kind, frame, series)) })
    }

    /// Writes the next field.
    ///
    /// # Errors
    /// The disk is full, or the system refuses; the error names the file.
    pub fn add(&mut self, field: &Field) -> Result<(), PublishError> {
        match &mut self.files {
            Files::Cf(file) => file.add(field).map_err(|e| failed(&self.path, e)),
            Files::Vtk(files) => files.add(field),
        }
    }

    /// The first file of an earlier, longer series of the same name, which stays and belongs to no collection.
    pub fn left_over(&self) -> Option<PathBuf> {
        match &self.files {
            Files::Cf(_) => None,
            Files::Vtk(files) => files.left_over(),
        }
    }

    /// Completes the file and returns the one to open.
    ///
    /// # Errors
    /// As [`FieldExport::add`].
    pub fn finish(self) -> Result<PathBuf, PublishError> {
        match self.files {
            Files::Cf(file) => file.finish(&self.path).map_err(|e| failed(&self.path, e)).map(|()| self.path),
            Files::Vtk(files) => Ok(files.finish()),
        }
    }
}

fn failed(path: &Path, problem: impl std::fmt::Display) -> PublishError {
    PublishError::File { path: path.to_owned(), problem: format!("cannot be written: {problem}") }
}
