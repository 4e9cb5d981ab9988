//! Fields as VTK XML files, and `.pvd` collections of several times.

use super::{Field, FieldFrame, failed};
use crate::field::Geometry;
use crate::publish::PublishError;
use crate::publish::vtk_xml::{Appended, Array, begin, escaped, of_what, text, unit_texts};
use std::fmt::Write as _;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

/// A kind of grid.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum VtkKind {
    Image,
    Rectilinear,
    Structured,
}

impl VtkKind {
    fn name(self) -> &'static str {
        match self {
            Self::Image => "ImageData",
            Self::Rectilinear => "RectilinearGrid",
            Self::Structured => "StructuredGrid",
        }
    }

    fn extension(self) -> &'static str {
        match self {
            Self::Image => "vti",
            Self::Rectilinear => "vtr",
            Self::Structured => "vts",
        }
    }
}

/// Files of one kind.
pub(super) struct VtkFiles {
    path: PathBuf,
    kind: VtkKind,
    frame: FieldFrame,
    series: bool,
    /// Times and names of the files of a series.
    written: Vec<(f64, String)>,
}

impl VtkFiles {
    pub(super) fn new(path: &Path, kind: VtkKind, frame: FieldFrame, series: bool) -> Self {
        Self { path: path.to_owned(), kind, frame, series, written: Vec::new() }
    }

    pub(super) fn add(&mut self, field: &Field) -> Result<(), PublishError> {
        let path = if self.series { self.numbered(self.written.len()) } else { self.path.clone() };
        self.file(&path, field).map_err(|e| failed(&path, e))?;
        if self.series {
            let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            self.written.push((field.time, name));
            // After each field, so that a series that ends early can be opened.
            let pvd = self.collection();
            crate::files::write_whole(&pvd, self.listed().as_bytes()).map_err(|e| failed(&pvd, e))?;
        }
        Ok(())
    }

    pub(super) fn finish(self) -> PathBuf {
        if self.series { self.collection() } else { self.path }
    }

    fn collection(&self) -> PathBuf {
        self.path.with_extension("pvd")
    }

    /// File of field `number` of a series.
    fn numbered(&self, number: usize) -> PathBuf {
        let stem = self.path.file_stem().unwrap_or_default().to_string_lossy();
        let extension = self.path.extension().map_or(self.kind.extension().into(), |e| e.to_string_lossy());
        self.path.with_file_name(format!("{stem}_{number:06}.{extension}"))
    }

    /// The next file of an earlier, longer series, which the new collection does not name.
    pub(super) fn left_over(&self) -> Option<PathBuf> {
        Some(self.numbered(self.written.len())).filter(|next| self.series && next.exists())
    }

    fn listed(&self) -> String {
        let mut text = String::from(
            "<?xml version=\"1.0\"?>\n<VTKFile type=\"Collection\" version=\"1.0\" byte_order=\"LittleEndian\">\n<Collection>\n",
        );
        for (time, name) in &self.written {
            let _ = writeln!(text, "<DataSet timestep=\"{time}\" part=\"0\" file=\"{}\"/>", escaped(name));
        }
        text + "</Collection>\n</VTKFile>\n"
    }

    fn file(&self, path: &Path, field: &Field) -> io::Result<()> {
        crate::files::write_with(path, |file| {
            let mut out = BufWriter::with_capacity(1 << 20, file);
            self.write(&mut out, field)?;
            out.flush()
        })
    }

    fn write(&self, out: &mut impl Write, field: &Field) -> io::Result<()> {
        let frame = &self.frame;
        let [nx, ny, nz] = frame.grid;
        let seeds = nx * ny * nz;
        let facts = vec![
            Array::number("TimeValue", field.time),
            Array::number("integration_time", frame.tau),
            Array::number("direction", frame.direction.sign()),
            Array::number("ftle_error_of_steps", field.error_of_steps.unwrap_or(f64::NAN)),
        ];
        let finite = |value: f64| if value.is_finite() { value } else { f64::NAN };
        let mut points = vec![Array::doubles("ftle", 1, seeds, field.ftle.iter().map(move |&v| finite(v)))];
        if let (Some(error), Some(_)) = (field.error, frame.pointwise) {
            points.push(Array::doubles("ftle_error", 1, seeds, error.iter().map(move |&v| finite(v))));
        }
        points.push(Array::doubles("lifetime", 1, seeds, field.lifetimes(frame.tau).map(|lifetime| lifetime.unwrap_or(f64::NAN))));
        points.push(Array::bytes("status", seeds, field.status()));
        let axes: [Vec<f64>; 3] = std::array::from_fn(|k| if k < frame.dimensions() { frame.coordinates(k) } else { vec![0.0] });
        let grid = match self.kind {
            VtkKind::Image => Vec::new(),
            VtkKind::Rectilinear => ["x", "y", "z"]
                .into_iter()
                .zip(&axes)
                .map(|(name, axis)| Array::doubles(name, 1, axis.len(), axis.iter().copied()))
                .collect(),
            VtkKind::Structured => {
                let [x, y, z] = &axes;
                let place = move |i: usize| in_space(frame.geometry, [x[i % nx], y[i / nx % ny], z[i / (nx * ny)]]);
                vec![Array::doubles("points", 3, seeds, (0..seeds).flat_map(place))]
            }
        };

        let extent = format!("0 {} 0 {} 0 {}", nx - 1, ny - 1, nz - 1);
        let spacing = |k: usize| axes[k].get(1).map_or(1.0, |second| second - axes[k][0]);
        let kind = self.kind.name();
        begin(out, kind, &format!("{} FTLE of {}", frame.direction.name(), of_what(&frame.title, &frame.source)))?;
        write!(out, "<{kind} WholeExtent=\"{extent}\"")?;
        if self.kind == VtkKind::Image {
            let [x, y, z] = [0, 1, 2].map(|k| axes[k][0]);
            write!(out, " Origin=\"{x} {y} {z}\" Spacing=\"{} {} {}\"", spacing(0), spacing(1), spacing(2))?;
        }
        writeln!(out, ">")?;
        let mut appended = Appended::default();
        writeln!(out, "<FieldData>")?;
        appended.declare(out, facts, true)?;
        // Points of a sphere lie in space.
        let in_metres = matches!((self.kind, frame.geometry), (VtkKind::Structured, Geometry::Sphere { .. }));
        let axes = frame.axes.iter().map(|[name, unit]| [name.as_str(), unit]).take(frame.dimensions());
        let axes = axes.filter(|_| !in_metres).chain(["x", "y", "z"].map(|name| [name, "m"]).into_iter().filter(|_| in_metres));
        unit_texts(axes, &frame.time_unit).try_for_each(|(name, fact)| text(out, name, &fact))?;
        writeln!(out, "</FieldData>\n<Piece Extent=\"{extent}\">\n<PointData Scalars=\"ftle\">")?;
        appended.declare(out, points, false)?;
        writeln!(out, "</PointData>")?;
        let around = match self.kind {
            VtkKind::Image => None,
            VtkKind::Rectilinear => Some("Coordinates"),
            VtkKind::Structured => Some("Points"),
        };
        if let Some(around) = around {
            writeln!(out, "<{around}>")?;
            appended.declare(out, grid, false)?;
            writeln!(out, "</{around}>")?;
        }
        writeln!(out, "</Piece>\n</{kind}>")?;
        appended.finish(out)
    }
}

/// A place in space: on a sphere in metres, x to 0 degrees east and z to the north pole; else the coordinates.
fn in_space(geometry: Geometry, [x, y, z]: [f64; 3]) -> [f64; 3] {
    match geometry {
        Geometry::Cartesian => [x, y, z],
        Geometry::Sphere { radius } => {
            let ((sin_x, cos_x), (sin_y, cos_y)) = (x.to_radians().sin_cos(), y.to_radians().sin_cos());
            [cos_y * cos_x, cos_y * sin_x, sin_y].map(|e| e * (radius + z))
        }
    }
}
