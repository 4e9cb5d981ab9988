//! Ridge surfaces as files for other tools: VTK PolyData and PLY.

use super::lines::RidgesAbout;
use super::make::structures;
use super::surfaces::{SurfacePoint, Surfaces};
use crate::flow::Direction;
use crate::publish::vtk_xml::{Appended, Array, begin, of_what, text};
use std::io::{self, Write};
use std::path::Path;

/// What surfaces are ridges of.
#[derive(Debug, Clone, PartialEq)]
pub struct SurfacesAbout {
    /// What all ridges of the moment share.
    pub shared: RidgesAbout,
    /// Seed time, in time units of the source.
    pub time: f64,
    /// |tau|, in time units of the source.
    pub tau: f64,
    /// Direction of the integration.
    pub direction: Direction,
}

impl SurfacesAbout {
    /// One line for people.
    fn line(&self) -> String {
        let RidgesAbout { title, source, when, .. } = &self.shared;
        let of = of_what(title, source);
        format!("{} ridge surfaces of the {} FTLE at {when}: {of}", structures(self.direction), self.direction.name())
    }
}

/// Kind of a file of surfaces, by its ending.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SurfacesFormat {
    /// VTK XML PolyData with appended raw arrays.
    Vtp,
    /// PLY, binary, little endian (Turk, The PLY polygon file format, 1994).
    Ply,
}

impl SurfacesFormat {
    /// The format of a file name.
    ///
    /// # Errors
    /// The ending is unknown; the text says what is accepted.
    pub fn of(path: &Path) -> Result<Self, String> {
        match path.extension().and_then(|e| e.to_str()).map(str::to_ascii_lowercase).as_deref() {
            Some("vtp") => Ok(Self::Vtp),
            Some("ply") => Ok(Self::Ply),
            _ => Err("accepted for surfaces in three dimensions: names that end in .vtp or .ply".into()),
        }
    }
}

impl Surfaces {
    /// Writes the surfaces. Coordinates are those of the data, degrees on a sphere.
    ///
    /// # Errors
    /// Those of `out`.
    pub fn write(&self, format: SurfacesFormat, about: &SurfacesAbout, out: &mut impl Write) -> io::Result<()> {
        match format {
            SurfacesFormat::Vtp => self.vtp(about, out),
            SurfacesFormat::Ply => self.ply(about, out),
        }
    }

    /// Number of the surface of each triangle.
    fn numbers(&self) -> impl Iterator<Item = usize> {
        self.surfaces.iter().enumerate().flat_map(|(number, surface)| std::iter::repeat_n(number, surface.triangles))
    }

    fn vtp(&self, about: &SurfacesAbout, out: &mut impl Write) -> io::Result<()> {
        let (points, triangles) = (self.points.len(), self.triangles.len());
        let each = |name, of: fn(&SurfacePoint) -> f64| Array::doubles(name, 1, points, self.points.iter().map(of));
        let mut appended = Appended::default();
        begin(out, "PolyData", &about.line())?;
        writeln!(out, "<PolyData>\n<FieldData>")?;
        let facts = [("TimeValue", about.time), ("integration_time", about.tau), ("direction", about.direction.sign())];
        appended.declare(out, facts.map(|(name, value)| Array::number(name, value)).into(), true)?;
        about.shared.texts().try_for_each(|(name, fact)| text(out, name, &fact))?;
        writeln!(
            out,
            "</FieldData>\n<Piece NumberOfPoints=\"{points}\" NumberOfVerts=\"0\" NumberOfLines=\"0\" NumberOfStrips=\"0\" NumberOfPolys=\"{triangles}\">\n\
             <PointData Scalars=\"ftle\">"
        )?;
        appended.declare(out, vec![each("ftle", |p| p.value), each("sharpness", |p| p.sharpness)], false)?;
        writeln!(out, "</PointData>\n<CellData>")?;
        appended.declare(out, vec![Array::integers("surface", triangles, self.numbers().map(|n| n as i64))], false)?;
        writeln!(out, "</CellData>\n<Points>")?;
        appended.declare(out, vec![Array::doubles("points", 3, points, self.points.iter().flat_map(|p| p.place))], false)?;
        writeln!(out, "</Points>\n<Polys>")?;
        let corners = self.triangles.iter().flatten().map(|n| i64::from(*n));
        let connectivity = Array::integers("connectivity", 3 * triangles, corners);
        appended.declare(out, vec![connectivity, Array::integers("offsets", triangles, (1..=triangles as i64).map(|n| 3 * n))], false)?;
        writeln!(out, "</Polys>\n</Piece>\n</PolyData>")?;
        appended.finish(out)
    }

    fn ply(&self, about: &SurfacesAbout, out: &mut impl Write) -> io::Result<()> {
        let fact = |text: &str| -> String { text.chars().map(|c| if c.is_control() { ' ' } else { c }).collect() };
        writeln!(out, "ply\nformat binary_little_endian 1.0\ncomment {}", fact(&about.line()))?;
        writeln!(out, "comment written by ridgewatch {}", env!("CARGO_PKG_VERSION"))?;
        writeln!(out, "comment direction {}\ncomment integration_time {}\ncomment time {}", about.direction.name(), about.tau, about.time)?;
        about.shared.texts().try_for_each(|(name, text)| writeln!(out, "comment {name} {}", fact(&text)))?;
        writeln!(out, "element vertex {}", self.points.len())?;
        ["x", "y", "z", "ftle", "sharpness"].iter().try_for_each(|name| writeln!(out, "property double {name}"))?;
        writeln!(out, "element face {}\nproperty list uchar int vertex_indices\nproperty int surface\nend_header", self.triangles.len())?;
        for SurfacePoint { place: [x, y, z], value, sharpness } in &self.points {
            [*x, *y, *z, *value, *sharpness].iter().try_for_each(|v| out.write_all(&v.to_le_bytes()))?;
        }
        for (triangle, number) in self.triangles.iter().zip(self.numbers()) {
            out.write_all(&[3])?;
            triangle.iter().chain([&(number as u32)]).try_for_each(|n| out.write_all(&n.to_le_bytes()))?;
        }
        Ok(())
    }
}
