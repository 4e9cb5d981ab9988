//! Grids: regular longitudes and latitudes, regular Gaussian grids, and the order in which their values are stored.

use super::message::{signed, unsigned};

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
}

/// The coordinates along a dimension.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub enum Axis {
    /// From the first to the last of so many, in millionths of a degree.
    Even { first: i64, last: i64, count: u32, longitude: bool },
    /// The latitudes of a Gaussian grid from the first to the last (millionths of a degree): see [`Grid::resolved`].
    Gaussian { parallels: u32, first: i64, last: i64, count: u32 },
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
            Self::Even { count, .. } | Self::Gaussian { count, .. } => *count as usize,
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
}

impl Grid {
    pub fn of(corners: Corners) -> Self {
        let Corners { count: [nx, ny], first, last, scanning, parallels } = corners;
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
        Self::Regular(Regular { x, y, scanning })
    }

    /// The grid with the latitudes of a Gaussian one, which are costly to compute.
    pub fn resolved(self) -> Self {
        match self {
            Self::Regular(Regular { x, y: Axis::Gaussian { parallels, first, last, count }, scanning }) => {
                match gaussian(parallels, count as usize, first, last) {
                    Ok(latitudes) => Self::Regular(Regular { x, y: Axis::of(latitudes), scanning }),
                    Err(what) => Self::Other(what),
                }
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
        Self::of(Corners { count, first: [degrees(13), degrees(10)], last: [degrees(20), degrees(17)], scanning: section[27], parallels })
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
        if section.len() < 72 {
            return Self::Other(format!("its description of a grid has {} bytes; 72 are needed", section.len()));
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
        let grid = Self::of(Corners {
            count,
            first: [degrees(50), degrees(46)],
            last: [degrees(59), degrees(55)],
            scanning: section[71],
            parallels: (template == 40).then(|| number(67)),
        });
        match grid {
            Self::Regular(regular) if regular.points() as u64 != u64::from(number(6)) => {
                Self::Other(format!("its grid of {} x {} nodes is said to have {}", count[0], count[1], number(6)))
            }
            grid => grid,
        }
    }
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
        0 | 40 => return None,
        1..=3 | 41..=43 => ROTATED.into(),
        10 | 12 | 13 => projected("Mercator"),
        20 | 23 => projected("polar stereographic"),
        30 | 31 | 33 | 140 => projected("Lambert"),
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
