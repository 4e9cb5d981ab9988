//! A field as NetCDF by the CF conventions, of which 1.8 is the newest version that the CF checker knows.

use super::{Field, FieldFrame, Of, STATUS};
use crate::source::{GridMapping, MappingValue};
use netcdf::{FileMut, Options, VariableMut};
use std::io;
use std::path::Path;
use tempfile::TempPath;
use thiserror::Error;

/// Values without a number, as the library fills them (NC_FILL_DOUBLE).
pub(super) const FILL: f64 = 9.969_209_968_386_869e36;

/// Axes by the CF conventions.
const AXES: [&str; 3] = ["X", "Y", "Z"];

#[derive(Debug, Error)]
pub(super) enum CfError {
    #[error(transparent)]
    NetCdf(#[from] netcdf::Error),
    #[error(transparent)]
    System(#[from] io::Error),
}

/// A NetCDF file under a temporary name.
pub(super) struct CfFile {
    file: FileMut,
    temporary: TempPath,
    frame: FieldFrame,
    written: usize,
}

impl CfFile {
    pub(super) fn create(path: &Path, frame: FieldFrame) -> Result<Self, CfError> {
        let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
        // Mode by the umask; by default temporary files are private.
        let mode = std::os::unix::fs::PermissionsExt::from_mode(0o666);
        let temporary =
            tempfile::Builder::new().prefix(".ridgewatch-").suffix(".nc").permissions(mode).tempfile_in(folder)?.into_temp_path();
        let file = netcdf::create_with(&temporary, Options::_64BIT_OFFSET)?;
        let mut new = Self { file, temporary, frame, written: 0 };
        new.define()?;
        new.file.enddef()?;
        new.put_coordinates()?;
        Ok(new)
    }

    fn axis_names(&self) -> Vec<String> {
        (0..self.frame.dimensions()).map(|k| self.frame.axis_name(k)).collect()
    }

    /// Names of the auxiliary longitudes and latitudes; empty if the axes are longitude and latitude, or their place is unknown.
    fn auxiliary(&self) -> Vec<String> {
        let axes = self.axis_names();
        let free = |name: &String| if axes.contains(name) { format!("{name}_2d") } else { name.clone() };
        self.frame.georeference.positions.iter().flat_map(|positions| &positions.names).map(free).collect()
    }

    fn define(&mut self) -> Result<(), CfError> {
        let frame = self.frame.clone();
        let (axes, auxiliary) = (self.axis_names(), self.auxiliary());
        let file = &mut self.file;
        file.add_unlimited_dimension("time")?;
        file.add_dimension("window", 2)?;
        for (name, n) in axes.iter().zip(frame.grid) {
            file.add_dimension(name, n)?;
        }

        let backward = frame.direction.sign() < 0.0;
        let direction = frame.direction.name();
        let text = |file: &mut FileMut, name: &str, value: &str| file.add_attribute(name, value).map(drop);
        text(file, "Conventions", "CF-1.8")?;
        text(file, "title", if frame.title.is_empty() { "Finite-time Lyapunov exponent" } else { &frame.title })?;
        text(file, "source", &format!("ridgewatch {} from {}", env!("CARGO_PKG_VERSION"), frame.source))?;
        text(file, "history", &frame.history)?;
        text(file, "references", "Shadden, Lekien and Marsden, Physica D 212, 2005, doi:10.1016/j.physd.2005.10.007")?;
        text(file, "integrator", &frame.integrator)?;

        let mut time = file.add_variable::<f64>("time", &["time"])?;
        let dated = frame.georeference.calendar.filter(|_| frame.time_unit == "s");
        match dated {
            Some(calendar) => {
                put(&mut time, &[("standard_name", "time"), ("units", "seconds since 1970-01-01 00:00:00"), ("calendar", calendar)])?
            }
            None => put(&mut time, &[("units", frame.time_units())])?,
        }
        let counted = if frame.time_unit == "snapshots" { ", in snapshots" } else { "" };
        put(&mut time, &[("long_name", &format!("time at which the particles are seeded{counted}")), ("bounds", "time_bounds")])?;
        if dated.is_some() {
            put(&mut time, &[("axis", "T")])?;
        }
        file.add_variable::<f64>("time_bounds", &["time", "window"])?;

        for (k, name) in axes.iter().enumerate() {
            let mut variable = file.add_variable::<f64>(name, &[name])?;
            match frame.georeference.axes.get(k) {
                Some(axis) => {
                    put(&mut variable, &[("units", &axis.units)])?;
                    for (attribute, value) in [("standard_name", &axis.standard_name), ("long_name", &axis.long_name)] {
                        if let Some(value) = value {
                            put(&mut variable, &[(attribute, value)])?;
                        }
                    }
                    if let Some(positive) = axis.positive {
                        put(&mut variable, &[("positive", positive)])?;
                    }
                }
                None => put(&mut variable, &[("units", "1"), ("long_name", ["x", "y", "z"][k])])?,
            }
            put(&mut variable, &[("axis", AXES[k])])?;
            if frame.of == Of::Pixels {
                // What a mean is taken over.
                put(&mut variable, &[("bounds", &bounds_of(name))])?;
                file.add_variable::<f64>(&bounds_of(name), &[name, "window"])?;
            }
        }
        for (k, name) in auxiliary.iter().enumerate() {
            let mut variable = file.add_variable::<f64>(name, &[&axes[1], &axes[0]])?;
            put(&mut variable, &[("standard_name", ["longitude", "latitude"][k]), ("units", ["degrees_east", "degrees_north"][k])])?;
            variable.put_attribute("_FillValue", FILL)?;
        }
        if let Some(mapping) = &frame.georeference.mapping {
            add_mapping(file, mapping)?;
        }

        let dimensions: Vec<&str> = std::iter::once("time").chain(axes.iter().rev().map(String::as_str)).collect();
        let mut placed = Vec::new();
        if !auxiliary.is_empty() {
            placed.push(("coordinates", auxiliary.join(" ")));
        }
        if let Some(mapping) = &frame.georeference.mapping {
            placed.push(("grid_mapping", mapping.name.clone()));
        }
        let placed: Vec<(&str, &str)> = placed.iter().map(|(name, value)| (*name, value.as_str())).collect();

        let mut ftle = file.add_variable::<f64>("ftle", &dimensions)?;
        let ancillary = match (frame.of, frame.pointwise) {
            (Of::Pixels, _) => "ftle_error missing_share",
            (Of::Seeds, Some(_)) => "ftle_error ftle_error_of_steps lifetime status",
            (Of::Seeds, None) => "ftle_error_of_steps lifetime status",
        };
        let meaning = if backward { "its ridges attract: particles come together there" } else { "its ridges repel: particles part there" };
        put(
            &mut ftle,
            &[
                ("long_name", &format!("{direction} finite-time Lyapunov exponent")),
                ("units", frame.ftle_units()),
                ("ancillary_variables", ancillary),
                ("direction", direction),
                ("comment", meaning),
            ],
        )?;
        ftle.put_attribute("integration_time", frame.tau)?;
        put(&mut ftle, &[("integration_time_units", if frame.time_unit.is_empty() { "1" } else { &frame.time_unit })])?;
        ftle.put_attribute("_FillValue", FILL)?;
        put(&mut ftle, &placed)?;
        if frame.of == Of::Pixels {
            put(&mut ftle, &[("cell_methods", &format!("{}: {}: mean", axes[1], axes[0]))])?;
            let mut error = file.add_variable::<f64>("ftle_error", &dimensions)?;
            let named = "stated root mean square error of the mean over the pixel";
            put(&mut error, &[("long_name", named), ("units", frame.ftle_units())])?;
            error.put_attribute("_FillValue", FILL)?;
            put(&mut error, &placed)?;
            let mut missing = file.add_variable::<f64>("missing_share", &dimensions)?;
            put(&mut missing, &[("long_name", "share of the pixel without a velocity"), ("units", "1")])?;
            missing.put_attribute("_FillValue", FILL)?;
            put(&mut missing, &placed)?;
            return Ok(());
        }

        if let Some(truth) = frame.pointwise {
            let mut error = file.add_variable::<f64>("ftle_error", &dimensions)?;
            put(&mut error, &[("long_name", &format!("absolute difference of the FTLE from {truth}")), ("units", frame.ftle_units())])?;
            error.put_attribute("_FillValue", FILL)?;
            put(&mut error, &placed)?;
        }
        let mut of_steps = file.add_variable::<f64>("ftle_error_of_steps", &["time"])?;
        let named = "root mean square of the difference of the FTLE from that of twice as many integration steps";
        put(&mut of_steps, &[("long_name", named), ("units", frame.ftle_units())])?;
        of_steps.put_attribute("_FillValue", FILL)?;

        let mut lifetime = file.add_variable::<f64>("lifetime", &dimensions)?;
        let named = "time until the particle left the domain or stopped, at most the integration time";
        put(&mut lifetime, &[("long_name", named), ("units", frame.time_units())])?;
        lifetime.put_attribute("_FillValue", FILL)?;
        put(&mut lifetime, &placed)?;

        let mut status = file.add_variable::<i8>("status", &dimensions)?;
        let meanings = STATUS.map(|(_, meaning)| meaning).join(" ");
        put(&mut status, &[("long_name", "what became of the particle"), ("flag_meanings", &meanings)])?;
        status.put_attribute("flag_values", STATUS.map(|(value, _)| value).to_vec())?;
        put(&mut status, &placed)?;

        let mut steps = file.add_variable::<i32>("integration_steps", &["time"])?;
        put(&mut steps, &[("long_name", "integration steps, 0 if they are adaptive"), ("units", "1")])?;
        Ok(())
    }

    fn put_coordinates(&mut self) -> Result<(), CfError> {
        let (axes, auxiliary) = (self.axis_names(), self.auxiliary());
        for (k, name) in axes.iter().enumerate() {
            let mut values = self.frame.coordinates(k);
            if let Some(axis) = self.frame.georeference.axes.get(k) {
                values.iter_mut().for_each(|value| *value = axis.value(*value));
            }
            self.variable(name)?.put_values(&values, ..)?;
            if self.frame.of == Of::Pixels {
                // Pixels lie evenly; a single one has no neighbour to tell its width.
                let half = if values.len() > 1 { 0.5 * (values[1] - values[0]) } else { 0.0 };
                let bounds: Vec<f64> = values.iter().flat_map(|value| [value - half, value + half]).collect();
                self.variable(&bounds_of(name))?.put_values(&bounds, ..)?;
            }
        }
        if let Some(positions) = self.frame.georeference.positions.clone() {
            let (x, y) = (self.frame.coordinates(0), self.frame.coordinates(1));
            let degrees: Vec<[f64; 2]> =
                y.iter().flat_map(|&y| x.iter().map(move |&x| (x, y))).map(|(x, y)| positions.at(x, y).unwrap_or([FILL; 2])).collect();
            for (k, name) in auxiliary.iter().enumerate() {
                let values: Vec<f64> = degrees.iter().map(|degrees| degrees[k]).collect();
                self.variable(name)?.put_values(&values, ..)?;
            }
        }
        Ok(())
    }

    fn variable(&mut self, name: &str) -> Result<VariableMut<'_>, CfError> {
        self.file.variable_mut(name).ok_or_else(|| io::Error::other(format!("variable `{name}` is gone")).into())
    }

    pub(super) fn add(&mut self, field: &Field) -> Result<(), CfError> {
        let (at, tau, dimensions) = (self.written, self.frame.tau, self.frame.dimensions());
        let known = |value: f64| if value.is_finite() { value } else { FILL };
        let start: Vec<usize> = std::iter::once(at).chain(std::iter::repeat_n(0, dimensions)).collect();
        let count: Vec<usize> = std::iter::once(1).chain(self.frame.grid[..dimensions].iter().rev().copied()).collect();
        let place = || (start.as_slice(), count.as_slice());
        let window = self.frame.window(field.time);
        self.variable("time")?.put_value(field.time, [at])?;
        self.variable("time_bounds")?.put_values(&window, (&[at, 0][..], &[1, 2][..]))?;
        let values: Vec<f64> = field.ftle.iter().map(|&ftle| known(ftle)).collect();
        self.variable("ftle")?.put_values(&values, place())?;
        if let (Some(error), Some(_)) = (field.error, self.frame.pointwise) {
            let values: Vec<f64> = error.iter().map(|&error| known(error)).collect();
            self.variable("ftle_error")?.put_values(&values, place())?;
        }
        self.variable("ftle_error_of_steps")?.put_value(field.error_of_steps.map_or(FILL, known), [at])?;
        let values: Vec<f64> = field.lifetimes(tau).map(|lifetime| lifetime.unwrap_or(FILL)).collect();
        self.variable("lifetime")?.put_values(&values, place())?;
        let values: Vec<i8> = field.status().collect();
        self.variable("status")?.put_values(&values, place())?;
        self.variable("integration_steps")?.put_value(i32::try_from(field.steps).unwrap_or(i32::MAX), [at])?;
        // A full disk is told here, and not at the end.
        self.file.sync()?;
        self.written += 1;
        Ok(())
    }

    /// Adds the pixels of a map: mean FTLE, its error and the share without a velocity, x fastest, upwards.
    pub(super) fn add_pixels(&mut self, time: f64, [ftle, error, missing]: [&[f64]; 3]) -> Result<(), CfError> {
        let window = self.frame.window(time);
        let [x, y, _] = self.frame.grid;
        self.variable("time")?.put_value(time, [0])?;
        self.variable("time_bounds")?.put_values(&window, (&[0, 0][..], &[1, 2][..]))?;
        for (name, values) in [("ftle", ftle), ("ftle_error", error), ("missing_share", missing)] {
            let values: Vec<f64> = values.iter().map(|&value| if value.is_finite() { value } else { FILL }).collect();
            self.variable(name)?.put_values(&values, (&[0, 0, 0][..], &[1, y, x][..]))?;
        }
        Ok(())
    }

    /// Gives the file its name. A link there is replaced, not followed.
    pub(super) fn finish(self, path: &Path) -> Result<(), CfError> {
        self.file.close()?;
        self.temporary.persist(path).map_err(|refused| refused.error)?;
        Ok(())
    }
}

/// Name of the bounds of an axis.
fn bounds_of(axis: &str) -> String {
    format!("{axis}_bounds")
}

/// Adds the variable of a grid mapping.
///
/// # Errors
/// libnetcdf fails.
pub(crate) fn add_mapping(file: &mut FileMut, mapping: &GridMapping) -> Result<(), netcdf::Error> {
    let mut variable = file.add_variable::<i32>(&mapping.name, &[])?;
    for (name, value) in &mapping.attributes {
        match value {
            MappingValue::Text(text) => variable.put_attribute(name, text.as_str())?,
            MappingValue::Numbers(numbers) if numbers.len() == 1 => variable.put_attribute(name, numbers[0])?,
            MappingValue::Numbers(numbers) => variable.put_attribute(name, numbers.clone())?,
        };
    }
    Ok(())
}

fn put(variable: &mut VariableMut, attributes: &[(&str, &str)]) -> Result<(), netcdf::Error> {
    attributes.iter().try_for_each(|(name, value)| variable.put_attribute(name, *value).map(drop))
}
