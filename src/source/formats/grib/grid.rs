//! Grids: regular longitudes and latitudes, also about a rotated pole, regular Gaussian grids, planes of projections, and the order in which their values are
//! stored.

use super::message::{signed, unsigned};
use crate::projection::Projection;

/// Most nodes along an axis, as for other formats.
const MAX_NODES: u32 = 1 << 24;
/// Most parallels between a pole and the equator whose Gaussian latitudes are computed: their cost grows with the square.
const MAX_PARALLELS: u32 = 2000;
/// A circle, in millionths of a degree.
const CIRCLE: i64 = 360_000_000;

/// A grid.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub enum Grid {
    Regular(Regular),
    /// Why its values cannot be read.
    Other(String),
}

/// A grid of rows and columns.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Regular {
    pub x: Axis,
    pub y: Axis,
    /// Flag table 8 of edition 1, 3.4 of edition 2.
    scanning: u8,
    /// `None` for longitudes and latitudes.
    pub mapping: Option<Mapping>,
}

/// Where rows and columns lie that are no parallels and meridians, in the words of the CF conventions, appendix F.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Mapping {
    pub kind: &'static str,
    /// Attributes, with the bits of each number as `f64`.
    numbers: Vec<(&'static str, Vec<u64>)>,
    /// True if vectors run along rows and columns, and not east and north.
    pub along_grid: bool,
}

impl Mapping {
    fn new(kind: &'static str, along_grid: bool, numbers: &[(&'static str, &[f64])]) -> Self {
        let bits = |values: &[f64]| values.iter().map(|value| value.to_bits()).collect();
        Self { kind, numbers: numbers.iter().map(|(name, values)| (*name, bits(values))).collect(), along_grid }
    }

    /// True if x and y are metres.
    pub fn is_plane(&self) -> bool {
        self.kind != ROTATED_POLE
    }

    pub fn numbers(&self) -> Vec<(&'static str, Vec<f64>)> {
        self.numbers.iter().map(|(name, bits)| (*name, bits.iter().map(|&bits| f64::from_bits(bits)).collect())).collect()
    }
}

const ROTATED_POLE: &str = "rotated_latitude_longitude";

/// The coordinates along a dimension.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub enum Axis {
    /// From the first to the last of so many, in millionths of a degree.
    Even { first: i64, last: i64, count: u32, longitude: bool },
    /// The latitudes of a Gaussian grid from the first to the last (millionths of a degree): see [`Grid::resolved`].
    Gaussian { parallels: u32, first: i64, last: i64, count: u32 },
    /// x or y of a projection: steps in thousandths of a metre from the first node, which lies at this longitude and latitude (millionths of a degree) and,
    /// once that is computed ([`Grid::resolved`]), at the coordinate with these bits.
    Plane { first: [i64; 2], step: i64, count: u32, origin: Option<u64> },
    /// The bits of each coordinate as `f64`.
    Listed(Vec<u64>),
}

impl Axis {
    /// Listed coordinates.
    pub fn of(values: impl IntoIterator<Item = f64>) -> Self {
        Self::Listed(values.into_iter().map(f64::to_bits).collect())
    }

    pub fn len(&self) -> usize {
        match self {
            Self::Even { count, .. } | Self::Gaussian { count, .. } | Self::Plane { count, .. } => *count as usize,
            Self::Listed(values) => values.len(),
        }
    }

    pub fn coordinate(&self, index: usize) -> f64 {
        match self {
            Self::Even { first, last, count, longitude } => {
                let intervals = f64::from((*count).max(2) - 1);
                let mut step = (last - first) as f64 / intervals;
                // Degrees are rounded to thousandths in edition 1: a row around the globe is known by its end.
                if *longitude && (step.abs() * f64::from(*count) - CIRCLE as f64).abs() < 1100.0 {
                    step = (CIRCLE as f64 / f64::from(*count)).copysign(step);
                }
                (*first as f64 + step * index as f64) / 1e6
            }
            Self::Gaussian { .. } => f64::NAN,
            Self::Plane { step, origin, .. } => origin.map_or(f64::NAN, f64::from_bits) + *step as f64 / 1e3 * index as f64,
            Self::Listed(values) => f64::from_bits(values[index]),
        }
    }
}

/// Fields of a description that both editions have, in millionths of a degree.
pub struct Corners {
    pub count: [u32; 2],
    /// Longitude and latitude.
    pub first: [i64; 2],
    pub last: [i64; 2],
    pub scanning: u8,
    /// Parallels of a Gaussian grid between a pole and the equator.
    pub parallels: Option<u32>,
    pub mapping: Option<Mapping>,
}

impl Grid {
    pub fn of(corners: Corners) -> Self {
        let Corners { count: [nx, ny], first, last, scanning, parallels, mapping } = corners;
        if nx == 0 || ny == 0 || nx > MAX_NODES || ny > MAX_NODES {
            return Self::Other(format!("its grid has {nx} x {ny} nodes; accepted are 1 to {MAX_NODES} along each axis"));
        }
        if first.iter().chain(&last).any(|angle| angle.unsigned_abs() > 2 * CIRCLE as u64) {
            return Self::Other("its corners are no longitudes and latitudes".into());
        }
        if scanning & 0x0f != 0 {
            return Self::Other(format!("its rows are offset against each other (scanning mode {scanning}): {REGRID}"));
        }
        let westward = scanning & 0x80 != 0;
        let mut end = last[0];
        // Longitudes go on behind the seam.
        if westward && end > first[0] {
            end -= CIRCLE;
        } else if !westward && end < first[0] {
            end += CIRCLE;
        }
        let x = Axis::Even { first: first[0], last: end, count: nx, longitude: true };
        let y = match parallels {
            None => Axis::Even { first: first[1], last: last[1], count: ny, longitude: false },
            Some(parallels) => Axis::Gaussian { parallels, first: first[1], last: last[1], count: ny },
        };
        Self::Regular(Regular { x, y, scanning, mapping })
    }

    /// A plane with the steps `step` (thousandths of a metre) from its first node.
    fn of_plane(count: [u32; 2], first: [i64; 2], step: [u32; 2], scanning: u8, mapping: Mapping) -> Self {
        // The limits of other grids.
        match Self::of(Corners { count, first, last: first, scanning, parallels: None, mapping: None }) {
            Self::Regular(_) if step.contains(&0) => Self::Other("its nodes lie on each other".into()),
            Self::Regular(_) => {
                let sign = [if scanning & 0x80 == 0 { 1 } else { -1 }, if scanning & 0x40 == 0 { -1 } else { 1 }];
                let axis = |k: usize| Axis::Plane { first, step: sign[k] * i64::from(step[k]), count: count[k], origin: None };
                Self::Regular(Regular { x: axis(0), y: axis(1), scanning, mapping: Some(mapping) })
            }
            refused => refused,
        }
    }

    /// True if its coordinates are not computed yet.
    pub fn is_open(&self) -> bool {
        matches!(self, Self::Regular(Regular { y: Axis::Gaussian { .. } | Axis::Plane { origin: None, .. }, .. }))
    }

    /// The grid with the latitudes of a Gaussian one, which are costly to compute, or the coordinates of a projection.
    pub fn resolved(self) -> Self {
        match self {
            Self::Regular(Regular { x, y: Axis::Gaussian { parallels, first, last, count }, scanning, mapping }) => {
                match gaussian(parallels, count as usize, first, last) {
                    Ok(latitudes) => Self::Regular(Regular { x, y: Axis::of(latitudes), scanning, mapping }),
                    Err(what) => Self::Other(what),
                }
            }
            Self::Regular(Regular { x: x @ Axis::Plane { first, .. }, y, scanning, mapping: Some(mapping) }) => {
                let numbers = mapping.numbers();
                let of = |name: &str| numbers.iter().find(|(n, _)| *n == name).map_or(&[][..], |(_, values)| values);
                let origin = Projection::of(mapping.kind, of, 1.0).and_then(|plane| plane.in_plane(first.map(|angle| angle as f64 / 1e6)));
                let Some(origin) = origin else { return Self::Other("its first node lies nowhere in its projection".into()) };
                let at = |axis: Axis, origin: f64| match axis {
                    Axis::Plane { first, step, count, .. } => Axis::Plane { first, step, count, origin: Some(origin.to_bits()) },
                    known => known,
                };
                Self::Regular(Regular { x: at(x, origin[0]), y: at(y, origin[1]), scanning, mapping: Some(mapping) })
            }
            grid => grid,
        }
    }

    /// Section 2 of edition 1.
    pub fn of_edition1(section: &[u8]) -> Self {
        let kind = section[5];
        if let Some(what) = other_edition1(kind) {
            return Self::Other(what);
        }
        if section.len() < 28 {
            return Self::Other(format!("its description of a grid has {} bytes; 28 are needed", section.len()));
        }
        let count = [unsigned(&section[6..8]), unsigned(&section[8..10])];
        if count.contains(&0xffff) {
            return Self::Other(REDUCED.into());
        }
        let degrees = |at: usize| i64::from(signed(&section[at..at + 3])) * 1000;
        let parallels = (kind == 4).then(|| unsigned(&section[25..27]));
        Self::of(Corners {
            count,
            first: [degrees(13), degrees(10)],
            last: [degrees(20), degrees(17)],
            scanning: section[27],
            parallels,
            mapping: None,
        })
    }

    /// Section 3 of edition 2.
    pub fn of_edition2(section: &[u8]) -> Self {
        let template = unsigned(&section[12..14]);
        if section[5] != 0 {
            return Self::Other(format!("its grid is number {template} of a catalogue and not described: {REGRID}"));
        }
        if let Some(what) = other_edition2(template) {
            return Self::Other(what);
        }
        let needed = match template {
            1 => 84,
            20 => 65,
            30 => 81,
            _ => 72,
        };
        if section.len() < needed {
            return Self::Other(format!("its description of a grid has {} bytes; {needed} are needed", section.len()));
        }
        let number = |at: usize| unsigned(&section[at..at + 4]);
        let count = [number(30), number(34)];
        if count.contains(&u32::MAX) || section[10] != 0 {
            return Self::Other(REDUCED.into());
        }
        // Degrees are counted in millionths, or in parts of a basic angle.
        let (basic, parts) = (number(38), number(42));
        let degrees = |at: usize| {
            let value = i64::from(signed(&section[at..at + 4]));
            match (basic, parts) {
                (0, _) | (_, 0 | u32::MAX) => value,
                _ => (value as f64 * f64::from(basic) / f64::from(parts) * 1e6).round() as i64,
            }
        };
        let grid = match template {
            10 | 20 | 30 => Self::of_projection(template, count, section),
            _ => {
                let rotated = (template == 1).then(|| {
                    // The poles of the rotated grid lie opposite of each other.
                    let pole = [degrees(76) as f64 / 1e6 + 180.0, -degrees(72) as f64 / 1e6];
                    let numbers: [(_, &[f64]); 2] = [("grid_north_pole_longitude", &pole[..1]), ("grid_north_pole_latitude", &pole[1..])];
                    Mapping::new(ROTATED_POLE, section[54] & ALONG_GRID != 0, &numbers)
                });
                if template == 1 && number(80) != 0 {
                    return Self::Other(ROTATED.into());
                }
                Self::of(Corners {
                    count,
                    first: [degrees(50), degrees(46)],
                    last: [degrees(59), degrees(55)],
                    scanning: section[71],
                    parallels: (template == 40).then(|| number(67)),
                    mapping: rotated,
                })
            }
        };
        match grid {
            Self::Regular(regular) if regular.points() as u64 != u64::from(number(6)) => {
                Self::Other(format!("its grid of {} x {} nodes is said to have {}", count[0], count[1], number(6)))
            }
            grid => grid,
        }
    }
}

/// Vectors run along rows and columns (flag table 3.3 of edition 2).
const ALONG_GRID: u8 = 0x08;

impl Grid {
    /// Templates 3.10, 3.20 and 3.30 of edition 2.
    fn of_projection(template: u32, count: [u32; 2], section: &[u8]) -> Self {
        let degrees = |at: usize| f64::from(signed(&section[at..at + 4])) / 1e6;
        let number = |at: usize| unsigned(&section[at..at + 4]);
        let Some(axes) = axes_of_earth(section) else {
            return Self::Other(format!(
                "the shape of its earth is number {} of code table 3.2, which is not understood here",
                section[14]
            ));
        };
        let along_grid = section[46] & ALONG_GRID != 0;
        let first = [i64::from(signed(&section[42..46])), i64::from(signed(&section[38..42]))];
        let globe: [(_, &[f64]); 2] = [("semi_major_axis", &axes[..1]), ("semi_minor_axis", &axes[1..])];
        let true_at = [degrees(47)];
        let mapping = |kind, numbers: &[(&'static str, &[f64])]| Mapping::new(kind, along_grid, &[&globe[..], numbers].concat());
        if template == 10 {
            let numbers: [(_, &[f64]); 2] = [("standard_parallel", &true_at), ("longitude_of_projection_origin", &[first[0] as f64 / 1e6])];
            if number(60) != 0 {
                return Self::Other(projected("turned Mercator"));
            }
            return Self::of_plane(count, first, [number(64), number(68)], section[59], mapping("mercator", &numbers));
        }
        let (meridian, step, scanning) = ([degrees(51)], [number(55), number(59)], section[64]);
        let is_south = section[63] & 0x80 != 0;
        if template == 20 {
            let pole = [if is_south { -90.0 } else { 90.0 }];
            let numbers: [(_, &[f64]); 3] = [
                ("straight_vertical_longitude_from_pole", &meridian),
                ("latitude_of_projection_origin", &pole),
                ("standard_parallel", &true_at),
            ];
            return Self::of_plane(count, first, step, scanning, mapping("polar_stereographic", &numbers));
        }
        let parallels = [degrees(65), degrees(69)];
        let numbers: [(_, &[f64]); 3] =
            [("standard_parallel", &parallels), ("latitude_of_projection_origin", &true_at), ("longitude_of_central_meridian", &meridian)];
        Self::of_plane(count, first, step, scanning, mapping("lambert_conformal_conic", &numbers))
    }
}

/// Semi-axes of the earth, metres (code table 3.2 of edition 2).
fn axes_of_earth(section: &[u8]) -> Option<[f64; 2]> {
    let scaled = |at: usize| f64::from(unsigned(&section[at + 1..at + 5])) / 10f64.powi(section[at].into());
    let found = match section[14] {
        0 => [6_367_470.0; 2],
        1 => [scaled(15); 2],
        2 => [6_378_160.0, 6_356_775.0],
        3 => [1e3 * scaled(20), 1e3 * scaled(25)],
        4 => [6_378_137.0, 6_356_752.314],
        5 => [6_378_137.0, 6_356_752.314_2],
        6 => [6_371_229.0; 2],
        7 => [scaled(20), scaled(25)],
        8 => [6_371_200.0; 2],
        _ => return None,
    };
    // Other numbers are damaged.
    found.iter().all(|axis| (6e6..=6.8e6).contains(axis)).then_some(found)
}

const REGRID: &str = "write it on regular longitudes and latitudes, for example with `cdo -f nc remapbil,r720x361 IN OUT`";
const REDUCED: &str = "its rows have fewer nodes towards the poles (a reduced grid): write it on regular ones, for example with \
                       `cdo -f nc setgridtype,regular IN OUT`, or ask the archive for a regular `grid`";
const SPECTRAL: &str = "it holds spherical harmonics: write it on a grid, for example with `cdo -f nc sp2gpl IN OUT`, or ask the archive \
                        for a regular `grid`";

/// Winds along the axes of a grid have to be turned, which interpolation alone does not do.
const ROTATED: &str = "its grid is rotated or stretched, with winds along its own axes: turn them and write them on regular longitudes and \
                       latitudes, for example with `cdo -f nc remapbil,r720x361 -rotuvb,u,v IN OUT`";

fn unread(name: &str) -> String {
    format!("its grid is {name}: {REGRID}")
}

fn projected(name: &str) -> String {
    format!(
        "its grid is a {name} projection: write it on regular longitudes and latitudes, with winds to the east and north, for example with \
         `wgrib2 IN -new_grid_winds earth -new_grid latlon 0:720:0.5 -90:361:0.5 OUT` (edition 1: after `grib_set -s edition=2`)"
    )
}

/// Why a grid cannot be read (code table 6 of edition 1).
fn other_edition1(kind: u8) -> Option<String> {
    Some(match kind {
        0 | 4 => return None,
        1 => projected("Mercator"),
        3 | 13 => projected("Lambert"),
        5 => projected("polar stereographic"),
        10 | 14 | 20 | 24 | 30 | 34 => ROTATED.into(),
        50 | 60 | 70 | 80 => SPECTRAL.into(),
        90 => unread("the view from a satellite"),
        _ => unread(&format!("of the unknown type {kind}")),
    })
}

/// Why a grid cannot be read (code table 3.1 of edition 2).
fn other_edition2(template: u32) -> Option<String> {
    Some(match template {
        0 | 1 | 10 | 20 | 30 | 40 => return None,
        2 | 3 | 41..=43 => ROTATED.into(),
        12 | 13 => projected("Mercator"),
        23 => projected("polar stereographic"),
        31 | 33 | 140 => projected("Lambert"),
        50..=53 | 61..=63 => SPECTRAL.into(),
        90 => unread("the view from a satellite"),
        100 | 101 => unread("made of triangles"),
        _ => unread(&format!("of the unknown type {template}")),
    })
}

impl Regular {
    /// Nodes, which are no more than 2^48.
    pub fn points(&self) -> usize {
        self.x.len() * self.y.len()
    }

    /// Appends a block of rows (y, x) in the order of the axes. `values` has all points, in the order of the message.
    pub fn copy(&self, values: &[f64], [y0, x0]: [usize; 2], [rows, columns]: [usize; 2], out: &mut Vec<f64>) {
        let (nx, ny) = (self.x.len(), self.y.len());
        let (by_columns, alternating) = (self.scanning & 0x20 != 0, self.scanning & 0x10 != 0);
        for y in y0..y0 + rows {
            if by_columns {
                out.extend((x0..x0 + columns).map(|x| values[x * ny + if alternating && x % 2 == 1 { ny - 1 - y } else { y }]));
            } else if alternating && y % 2 == 1 {
                out.extend((x0..x0 + columns).map(|x| values[y * nx + nx - 1 - x]));
            } else {
                out.extend_from_slice(&values[y * nx + x0..y * nx + x0 + columns]);
            }
        }
    }
}

/// The latitudes of `count` rows of a Gaussian grid from the first to the last, which are in millionths of a degree: the arcsines of the
/// roots of the Legendre polynomial of degree 2 N for N parallels, by Newton's method.
fn gaussian(parallels: u32, count: usize, first: i64, last: i64) -> Result<Vec<f64>, String> {
    if parallels == 0 || parallels > MAX_PARALLELS {
        return Err(format!(
            "its Gaussian grid has {parallels} parallels between a pole and the equator; accepted are 1 to {MAX_PARALLELS}"
        ));
    }
    let degree = 2 * parallels as usize;
    let root = |k: usize| {
        // The first guess of Press et al., Numerical Recipes, section 4.5.
        let mut x = (std::f64::consts::PI * (k as f64 + 0.75) / (degree as f64 + 0.5)).cos();
        for _ in 0..10 {
            let (mut before, mut value) = (1.0, x);
            for n in 2..=degree {
                (before, value) = (value, ((2 * n - 1) as f64 * x * value - (n - 1) as f64 * before) / n as f64);
            }
            let slope = degree as f64 * (x * value - before) / (x * x - 1.0);
            let change = value / slope;
            x -= change;
            if change.abs() < 1e-15 {
                break;
            }
        }
        x.asin().to_degrees()
    };
    let north: Vec<f64> = (0..parallels as usize).map(root).collect();
    let mut all: Vec<f64> = north.iter().copied().chain(north.iter().rev().map(|latitude| -latitude)).collect();
    if last > first {
        all.reverse();
    }
    // Corners of edition 1 are rounded to thousandths of a degree.
    let near = |latitude: f64, corner: i64| (latitude - corner as f64 / 1e6).abs() <= 0.0015;
    let start = all.iter().position(|&latitude| near(latitude, first)).ok_or("its first latitude is none of its Gaussian grid")?;
    match all.get(start..start + count) {
        Some(rows) if near(rows[count - 1], last) => Ok(rows.to_vec()),
        _ => Err(format!("its {count} rows of a Gaussian grid do not end at its last latitude")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gaussian_latitudes_are_those_of_the_tables() {
        // N32, as ECMWF lists it: https://www.ecmwf.int/en/forecasts/documentation-and-support/gaussian_n32
        let latitudes = gaussian(32, 64, 87_864_000, -87_864_000).unwrap();
        assert_eq!(
            latitudes[..4].iter().map(|latitude| (latitude * 1e4).round() / 1e4).collect::<Vec<_>>(),
            [87.8638, 85.0965, 82.3129, 79.5256]
        );
        assert_eq!(latitudes[31] + latitudes[32], 0.0);
        assert_eq!(gaussian(32, 2, -87_863_799, -85_096_527).unwrap(), [-latitudes[0], -latitudes[1]]);
        assert!(gaussian(32, 3, 87_864_000, -87_864_000).is_err() && gaussian(32, 64, 80_000_000, -87_864_000).is_err());
    }
}
