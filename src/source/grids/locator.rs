//! Locates the nodes of an even longitude-latitude grid among the cells of a mesh of points on the sphere.
//!
//! Algorithm: each cell of four corners is projected onto the plane that touches the sphere at its middle (gnomonic projection); the place of
//! a node in it is the inverse of the bilinear map, by Newton's method. For triangles see [`super::triangles`].

use super::triangles::{InTriangles, Triangles};

/// Points on the sphere; degrees, NaN for missing points.
#[derive(Debug)]
pub struct Mesh {
    /// Points along x and y, x fastest; points without rows count along x.
    pub shape: [usize; 2],
    pub longitude: Vec<f64>,
    pub latitude: Vec<f64>,
    /// Between points without rows.
    pub triangles: Option<Triangles>,
}

/// An even grid.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Target {
    /// Longitude and latitude of the first node.
    pub first: [f64; 2],
    pub step: [f64; 2],
    pub nodes: [usize; 2],
    /// True if longitudes close the circle.
    pub round: bool,
}

/// Index of no cell.
pub const NOWHERE: u32 = u32::MAX;
/// Largest number of nodes for each point of the mesh in a grid that has not been refined: a mesh that is dense in one place must not
/// exhaust the memory.
const MAX_NODES: usize = 4;
/// Most places at which an error is measured, about, and most for each cell of the grid.
const MAX_PLACES: [f64; 2] = [65_536.0, 16.0];
/// Ratio of two spacings that no small whole numbers have: nodes of one grid lie anywhere in the cells of the other.
const GOLDEN: f64 = 0.618_033_988_749_895;
/// Extent of a mesh in degrees (0.1 m) below which it has no cells: a grid on it would have steps of 0.
const MIN_EXTENT: f64 = 1e-6;
/// Degrees of longitude above which the curvature of a cell's sides counts.
const WIDE: f64 = 5.0;
/// Width of the area of a point, as a share of the distance to its neighbours, below which points lie along a line.
const NARROW: f64 = 0.1;
/// Largest number of columns that a mesh repeats at its seam.
const MAX_REPEATED: usize = 4;
/// Largest distance outside a cell, in units of the cell, at which a node still counts as inside: rounding must not open seams.
pub const SLACK: f64 = 1e-7;

/// Interpolation from a mesh to a grid.
#[derive(Debug)]
pub enum Locator {
    Rows(InRows),
    Triangles(InTriangles),
}

/// Bilinear interpolation between points in rows.
#[derive(Debug)]
pub struct InRows {
    shape: [usize; 2],
    /// Lower corner of the cell of each node of the grid.
    cell: Vec<u32>,
    /// Place of each node in its cell.
    place: Vec<[f32; 2]>,
}

pub type Vector = [f64; 3];

pub fn dot(a: Vector, b: Vector) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

pub fn vector(longitude: f64, latitude: f64) -> Vector {
    let ((sin_lon, cos_lon), (sin_lat, cos_lat)) = (longitude.to_radians().sin_cos(), latitude.to_radians().sin_cos());
    [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat]
}

/// Longitude and latitude of a direction.
pub fn degrees(v: Vector) -> [f64; 2] {
    [v[1].atan2(v[0]).to_degrees(), v[2].atan2(v[0].hypot(v[1])).to_degrees()]
}

/// The middle of points. `None` if they lie on all sides of the globe.
fn middle(points: &[Vector]) -> Option<Vector> {
    let sum: Vector = std::array::from_fn(|k| points.iter().map(|v| v[k]).sum());
    let length = dot(sum, sum).sqrt();
    (length >= 0.5 * points.len() as f64).then(|| sum.map(|v| v / length))
}

/// East and north at a point.
fn east_north(longitude: f64, latitude: f64) -> [Vector; 2] {
    let ((sin_lon, cos_lon), (sin_lat, cos_lat)) = (longitude.to_radians().sin_cos(), latitude.to_radians().sin_cos());
    [[-sin_lon, cos_lon, 0.0], [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat]]
}

/// Degrees between two points (longitude, latitude).
pub fn apart(p: [f64; 2], q: [f64; 2]) -> f64 {
    dot(vector(p[0], p[1]), vector(q[0], q[1])).clamp(-1.0, 1.0).acos().to_degrees()
}

/// A difference of longitudes in [-180, 180).
fn turn(degrees: f64) -> f64 {
    (degrees + 180.0).rem_euclid(360.0) - 180.0
}

impl Mesh {
    pub fn rows(shape: [usize; 2], longitude: Vec<f64>, latitude: Vec<f64>) -> Self {
        Self { shape, longitude, latitude, triangles: None }
    }

    /// Takes points at longitude 0 and latitude 0 as missing if there are several: models write them where nothing was computed.
    pub fn leave_out_zeros(&mut self) {
        let nowhere: Vec<usize> = (0..self.longitude.len()).filter(|&n| self.longitude[n] == 0.0 && self.latitude[n] == 0.0).collect();
        if nowhere.len() > 1 {
            for n in nowhere {
                (self.longitude[n], self.latitude[n]) = (f64::NAN, f64::NAN);
            }
        }
    }

    /// The middles between neighbours along the axes that `between` names.
    pub fn between(self, between: [bool; 2]) -> Self {
        let reach = between.map(usize::from);
        if reach == [0; 2] {
            return self;
        }
        let shape = [self.shape[0] - reach[0], self.shape[1] - reach[1]];
        let (mut longitude, mut latitude) = (Vec::new(), Vec::new());
        for j in 0..shape[1] {
            for i in 0..shape[0] {
                let mut sum = [0.0; 3];
                for (di, dj) in (0..=reach[0]).flat_map(|di| (0..=reach[1]).map(move |dj| (di, dj))) {
                    let n = (j + dj) * self.shape[0] + i + di;
                    let own = vector(self.longitude[n], self.latitude[n]);
                    sum = std::array::from_fn(|k| sum[k] + own[k]);
                }
                let middle = degrees(sum);
                longitude.push(middle[0]);
                latitude.push(middle[1]);
            }
        }
        Self::rows(shape, longitude, latitude)
    }

    /// The points half a cell before (-1) or behind (1) these along each axis; at an end as far beyond it as the last cell tells.
    pub fn shifted(mut self, shift: [i8; 2]) -> Self {
        for (axis, &half) in shift.iter().enumerate().filter(|(_, half)| **half != 0) {
            let last = self.shape[axis] - 1;
            let own = |place: [usize; 2]| {
                let n = place[1] * self.shape[0] + place[0];
                vector(self.longitude[n], self.latitude[n])
            };
            let (mut longitude, mut latitude) = (Vec::new(), Vec::new());
            for (j, i) in (0..self.shape[1]).flat_map(|j| (0..self.shape[0]).map(move |i| (j, i))) {
                let at = |n: usize| own(if axis == 0 { [n, j] } else { [i, n] });
                let n = [i, j][axis];
                let pairs = match (half < 0, n) {
                    (true, 0) => [(at(0), 1.5), (at(1.min(last)), -0.5)],
                    (true, n) => [(at(n - 1), 0.5), (at(n), 0.5)],
                    (false, n) if n == last => [(at(n), 1.5), (at(n.saturating_sub(1)), -0.5)],
                    (false, n) => [(at(n), 0.5), (at(n + 1), 0.5)],
                };
                let [east, north] = degrees(std::array::from_fn(|k| pairs.iter().map(|(v, weight)| weight * v[k]).sum()));
                longitude.push(east);
                latitude.push(north);
            }
            self = Self::rows(self.shape, longitude, latitude);
        }
        self
    }

    /// Longitude and latitude of point `n`; `None` if they are missing.
    pub fn place(&self, n: usize) -> Option<[f64; 2]> {
        (self.longitude[n].is_finite() && self.latitude[n].is_finite()).then(|| [self.longitude[n], self.latitude[n]])
    }

    pub fn point(&self, i: usize, j: usize) -> Option<[f64; 2]> {
        self.place(j * self.shape[0] + i)
    }

    /// Degrees between neighbouring points: along x, or along all sides of triangles.
    fn spacings(&self) -> Vec<f64> {
        let [nx, ny] = self.shape;
        if let Some(triangles) = &self.triangles {
            return triangles.sides(self);
        }
        let mut found = Vec::new();
        for (j, i) in (0..ny).flat_map(|j| (0..nx - 1).map(move |i| (j, i))) {
            if let (Some(a), Some(b)) = (self.point(i, j), self.point(i + 1, j)) {
                found.push((turn(b[0] - a[0]) * ((a[1] + b[1]) / 2.0).to_radians().cos()).hypot(b[1] - a[1]));
            }
        }
        found
    }

    /// Steps to the east and to the north, in degrees of a great circle, in which the indices of the mesh change by one: medians over its
    /// cells. Among triangles, the width of the area of one point. `None` without cells.
    fn steps(&self) -> Option<[f64; 2]> {
        let [nx, ny] = self.shape;
        if let Some(triangles) = &self.triangles {
            // Each point has the area of two triangles.
            return median(triangles.areas(self)).map(|area| [(2.0 * area).sqrt(); 2]);
        }
        let mut found = [Vec::new(), Vec::new()];
        for (j, i) in (0..ny - 1).flat_map(|j| (0..nx - 1).map(move |i| (j, i))) {
            let (Some(p), Some(q), Some(r)) = (self.point(i, j), self.point(i + 1, j), self.point(i, j + 1)) else { continue };
            let side = |q: [f64; 2]| [turn(q[0] - p[0]) * ((p[1] + q[1]) / 2.0).to_radians().cos(), q[1] - p[1]];
            let (a, b) = (side(q), side(r));
            let area = (a[0] * b[1] - a[1] * b[0]).abs();
            // The gradients of both indices are the rows of the inverse of (a, b).
            for (k, steps) in found.iter_mut().enumerate() {
                steps.push(area / a[1 - k].hypot(b[1 - k]));
            }
        }
        let [east, north] = found.map(median);
        east.zip(north).map(|(east, north)| [east, north])
    }

    /// True if the last column's neighbour is the first one.
    fn goes_round(&self, spacing: f64) -> bool {
        let [nx, ny] = self.shape;
        let closes = |j: &usize| match (self.point(nx - 1, *j), self.point(0, *j), self.point(nx / 2, *j)) {
            (Some(a), Some(b), Some(m)) => apart(a, b) < 2.0 * spacing && apart(a, m) > 4.0 * spacing,
            _ => false,
        };
        nx > 8 && (0..ny).filter(closes).count() * 2 > ny
    }

    /// Unit vectors along u and v at each point: east and north or, if `along` is set, the direction of the mesh's x and the direction 90
    /// degrees to the left of it. NaN if neighbours coincide.
    pub fn directions(&self, along: bool) -> Vec<[[f32; 3]; 2]> {
        let [nx, ny] = self.shape;
        let round = along && self.goes_round(median(self.spacings()).unwrap_or(0.0));
        let mut out = Vec::with_capacity(nx * ny);
        for j in 0..ny {
            for i in 0..nx {
                let Some(here) = self.point(i, j) else {
                    out.push([[f32::NAN; 3]; 2]);
                    continue;
                };
                let [east, north] = east_north(here[0], here[1]);
                let [x, y] = if along {
                    let own = vector(here[0], here[1]);
                    let at = |i: usize| self.point(i, j).map_or(own, |p| vector(p[0], p[1]));
                    let way = |a: Vector, b: Vector| -> Vector { std::array::from_fn(|k| b[k] - a[k]) };
                    let (mut before, mut after) = (way(at(i.saturating_sub(1)), own), way(own, at((i + 1).min(nx - 1))));
                    // Beyond the seam, the mesh may repeat columns: take the first one that lies ahead.
                    let beyond = |onward: Vector, step: &dyn Fn(usize) -> Vector| {
                        let ahead = |s: &Vector| dot(*s, onward) > 1e-6 * dot(onward, onward);
                        (0..=MAX_REPEATED.min(nx - 1)).map(step).find(ahead).unwrap_or([0.0; 3])
                    };
                    if round && i == 0 {
                        before = beyond(after, &|k| way(at(nx - 1 - k), own));
                    } else if round && i + 1 == nx {
                        after = beyond(before, &|k| way(own, at(k)));
                    }
                    let step = std::array::from_fn(|k| before[k] + after[k]);
                    let (x, y) = (dot(step, east), dot(step, north));
                    let length = x.hypot(y);
                    if length > 0.0 { [x / length, y / length] } else { [f64::NAN; 2] }
                } else {
                    [1.0, 0.0]
                };
                let of = |a: f64, b: f64| std::array::from_fn(|k| (a * east[k] + b * north[k]) as f32);
                out.push([of(x, y), of(-y, x)]);
            }
        }
        out
    }
}

fn median(mut values: Vec<f64>) -> Option<f64> {
    values.retain(|v| *v > 0.0);
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

/// An even grid that covers a mesh, or the part of it in `region` (west, east, south, north), in steps of `resolution` degrees or of the mesh's own
/// ([`Mesh::steps`]).
///
/// # Errors
/// A mesh without cells, a resolution out of range, a region beside the mesh, or too many nodes.
pub fn target(mesh: &Mesh, resolution: Option<[f64; 2]>, region: Option<[f64; 4]>) -> Result<Target, String> {
    if mesh.triangles.is_none() && mesh.shape.iter().any(|&n| n < 2) {
        return Err(format!("{:?} points make no cell", mesh.shape));
    }
    if let Some(odd) = resolution.and_then(|r| r.into_iter().find(|r| !(*r > 0.0 && *r <= 45.0))) {
        return Err(format!("a `resolution` of {odd} degrees: accepted are numbers above 0, up to 45"));
    }
    // Faces reach beyond their middles.
    let [longitude, latitude] =
        mesh.triangles.as_ref().and_then(Triangles::nodes).map_or([&mesh.longitude, &mesh.latitude], |[lon, lat]| [lon, lat]);
    let known: Vec<[f64; 2]> =
        longitude.iter().zip(latitude).map(|(&lon, &lat)| [lon, lat]).filter(|p| p.iter().all(|v| v.is_finite())).collect();
    let Some(along_x) = median(mesh.spacings()) else { return Err("no two neighbouring points differ: they make no cell".into()) };
    let latitudes: Vec<f64> = known.iter().map(|p| p[1]).collect();
    let (mut south, mut north) = latitudes.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), &l| (a.min(l), b.max(l)));
    let mut middle = latitudes;
    middle.sort_by(f64::total_cmp);
    if north - south <= MIN_EXTENT {
        return Err(format!("its points lie on one parallel, at {south} degrees north: they make no cell"));
    }
    let cosine = middle[middle.len() / 2].to_radians().cos().max(0.1);
    let steps = mesh.steps();
    if mesh.triangles.is_some() && steps.is_none_or(|[east, _]| east < NARROW * along_x) {
        return Err("its points lie along a line: they make no cell".into());
    }
    let own = steps.map(|[east, north]| [east / cosine, north]);
    let Some(mut step) = resolution.or(own) else { return Err("no four neighbouring points make a cell".into()) };

    // The widest arc without a point lies outside the mesh, unless it is as narrow as a cell.
    let mut circle: Vec<f64> = known.iter().map(|p| p[0].rem_euclid(360.0)).collect();
    circle.sort_by(f64::total_cmp);
    let (mut start, mut hole) = (circle[0], circle[0] + 360.0 - circle[circle.len() - 1]);
    for pair in circle.windows(2) {
        if pair[1] - pair[0] > hole {
            (start, hole) = (pair[1], pair[1] - pair[0]);
        }
    }
    let mut round = hole < 2.0 * step[0].max(along_x / cosine);
    if round {
        start = 0.0;
    } else if start > 180.0 && start + 360.0 - hole > 360.0 {
        start -= 360.0;
    }
    let mut width = if round { 360.0 } else { 360.0 - hole };
    if width <= MIN_EXTENT {
        return Err(format!("its points lie on one meridian, at {start} degrees east: they make no cell"));
    }
    let mut most = MAX_NODES as f64 * known.len().max(64) as f64;
    if let Some([west, east, low, high]) = region {
        let all = width * (north - south);
        let ends = format!("{start} to {} degrees east and from {south} to {north} degrees north", start + width);
        (south, north) = (south.max(low), north.min(high));
        let wanted = (east - west).rem_euclid(360.0);
        let from = (west - start).rem_euclid(360.0);
        match () {
            // All around.
            () if wanted == 0.0 => {}
            () if round => (round, start, width) = (false, west, wanted),
            // It begins in the mesh, and may come back to it behind the part of the circle without points.
            () if from < width => (start, width) = (start + from, if from + wanted > 360.0 { wanted } else { wanted.min(width - from) }),
            () => width = (from + wanted - 360.0).min(width),
        }
        if width <= MIN_EXTENT || north - south <= MIN_EXTENT {
            return Err(format!("the region [{west}, {east}, {low}, {high}] lies beside it: it reaches from {ends}"));
        }
        most = (most * width * (north - south) / all).max(64.0);
    }
    loop {
        let across = ((width / step[0]).round() as usize).max(1);
        let up = (((north - south) / step[1]).round() as usize).max(1);
        if resolution.is_none() && across.saturating_mul(up) as f64 > most {
            step = step.map(|s| s * 1.25);
            continue;
        }
        if across.saturating_mul(up) > 1 << 28 {
            return Err(format!("{across} x {up} nodes are too many; give a coarser --set archive.resolution=[DLON,DLAT]"));
        }
        let step = [width / across as f64, (north - south) / up as f64];
        let nodes = [if round { across } else { across + 1 }, up + 1];
        return Ok(Target { first: [start, south], step, nodes, round });
    }
}

impl Target {
    /// Cells along both axes.
    fn cells(&self) -> [usize; 2] {
        [if self.round { self.nodes[0] } else { self.nodes[0] - 1 }, self.nodes[1] - 1]
    }

    /// The same box in cells that are smaller by about `factor`.
    pub fn finer(&self, factor: f64) -> Self {
        let old = self.cells();
        let cells = old.map(|n| (n as f64 * factor).round().max(1.0) as usize);
        let step = [0, 1].map(|k| self.step[k] * old[k] as f64 / cells[k] as f64);
        Self { step, nodes: [if self.round { cells[0] } else { cells[0] + 1 }, cells[1] + 1], ..*self }
    }

    /// Another even grid in the same box, whose nodes lie anywhere in the cells of this one and of finer ones.
    pub fn between(&self) -> Self {
        let cells = self.cells().map(|n| n as f64);
        let all = cells[0] * cells[1];
        // Powers of two keep the ratio to refined grids irrational.
        let finer = (MAX_PLACES[0].min(MAX_PLACES[1] * all) / all).sqrt().log2().floor().exp2();
        let step = self.step.map(|step| step * GOLDEN / finer);
        let first = [0, 1].map(|k| self.first[k] + 0.3 * step[k]);
        let nodes = [0, 1].map(|k| (((cells[k] * self.step[k] / step[k]) - 0.3).floor() as usize).max(1) + 1);
        Self { first, step, nodes, round: false }
    }

    /// Longitude and latitude of a node.
    pub fn place(&self, node: usize) -> [f64; 2] {
        let at = [node % self.nodes[0], node / self.nodes[0]];
        [0, 1].map(|k| self.first[k] + self.step[k] * at[k] as f64)
    }

    /// Unit vectors to the east and to the north at each node.
    pub fn bases(&self) -> [Vec<[f32; 3]>; 2] {
        let [nx, ny] = self.nodes;
        let at = |k: usize| -> Vec<[f32; 3]> {
            let base = |n: usize| {
                let place = self.place(n);
                east_north(place[0], place[1])[k].map(|v| v as f32)
            };
            (0..nx * ny).map(base).collect()
        };
        [at(0), at(1)]
    }

    /// Bilinear interpolation of values on the grid; NaN outside.
    pub fn interpolate(&self, values: &[f32], longitude: f64, latitude: f64) -> f64 {
        let mut x = (longitude - self.first[0]).rem_euclid(360.0) / self.step[0];
        let y = (latitude - self.first[1]) / self.step[1];
        let ([nx, ny], [cells, _]) = (self.nodes, self.cells());
        if !self.round && x > cells as f64 && (360.0 / self.step[0] - x) < 1e-6 {
            x = 0.0;
        }
        if !(x <= cells as f64 + 1e-9 && (-1e-9..=(ny - 1) as f64 + 1e-9).contains(&y)) {
            return f64::NAN;
        }
        let (i, j) = ((x as usize).min(cells - 1), (y.max(0.0) as usize).min(ny - 2));
        let (s, t) = (x - i as f64, y - j as f64);
        let at = |i: usize, j: usize| f64::from(values[j * nx + i % nx]);
        (1.0 - t) * ((1.0 - s) * at(i, j) + s * at(i + 1, j)) + t * ((1.0 - s) * at(i, j + 1) + s * at(i + 1, j + 1))
    }
}

impl Target {
    /// Calls `visit` with the nodes of the grid, and their directions, in a box around a few corners of a cell.
    pub fn around(&self, corners: &[[f64; 2]], mut visit: impl FnMut(usize, Vector)) {
        let mut vectors = [[0.0; 3]; 4];
        let vectors = &mut vectors[..corners.len()];
        vectors.iter_mut().zip(corners).for_each(|(v, c)| *v = vector(c[0], c[1]));
        let Some([longitude, latitude]) = middle(vectors).map(degrees) else { return };
        let mut low = [f64::INFINITY; 2];
        let mut high = [f64::NEG_INFINITY; 2];
        let mut reach = |place: [f64; 2]| {
            for (k, value) in [turn(place[0] - longitude), place[1]].into_iter().enumerate() {
                (low[k], high[k]) = (low[k].min(value), high[k].max(value));
            }
            high[0] - low[0]
        };
        let wide = corners.iter().map(|&corner| reach(corner)).fold(0.0, f64::max);
        // The sides are curved in longitude and latitude.
        if wide > WIDE {
            for (a, b) in vectors.iter().enumerate().flat_map(|(k, a)| vectors[..k].iter().map(move |b| (a, b))) {
                for share in [0.25, 0.5, 0.75] {
                    reach(degrees(std::array::from_fn(|k| (1.0 - share) * a[k] + share * b[k])));
                }
            }
        }
        for k in 0..2 {
            let more = 0.1 * (high[k] - low[k]);
            (low[k], high[k]) = (low[k] - more, high[k] + more);
        }
        let pole_inside = high[0] - low[0] > 180.0;
        if pole_inside {
            if latitude > 0.0 { high[1] = 90.0 } else { low[1] = -90.0 }
        }
        let row = |l: f64| (l - self.first[1]) / self.step[1];
        let rows =
            row(low[1]).ceil().max(0.0) as usize..=(row(high[1]).floor().max(-1.0) as i64).min(self.nodes[1] as i64 - 1).max(-1) as usize;
        if row(high[1]) < 0.0 {
            return;
        }
        // The longitudes of a grid that ends lie within a turn of its first one; those of a cell at that end may lie on either side of it.
        let east = (longitude - self.first[0]).rem_euclid(360.0);
        let columns = self.nodes[0] as i64;
        let ends: &[f64] = if self.round || pole_inside { &[0.0] } else { &[0.0, 360.0] };
        let span = |back: &f64| {
            let column = |l: f64| (l + east - back) / self.step[0];
            let (first, last) = (column(low[0]).ceil() as i64, column(high[0]).floor() as i64);
            match () {
                () if pole_inside => 0..=columns - 1,
                () if self.round => first..=last,
                () => first.max(0)..=last.min(columns - 1),
            }
        };
        for y in rows {
            for x in ends.iter().flat_map(span) {
                let column = x.rem_euclid(columns);
                let place = [self.first[0] + self.step[0] * column as f64, self.first[1] + self.step[1] * y as f64];
                visit(y * self.nodes[0] + column as usize, vector(place[0], place[1]));
            }
        }
    }
}

impl Locator {
    pub fn new(mesh: &Mesh, target: &Target) -> Self {
        match &mesh.triangles {
            Some(triangles) => Self::Triangles(InTriangles::new(mesh, triangles, target)),
            None => Self::Rows(InRows::new(mesh, target)),
        }
    }

    /// Points of the mesh.
    pub fn points(&self) -> usize {
        match self {
            Self::Rows(rows) => rows.shape[0] * rows.shape[1],
            Self::Triangles(triangles) => triangles.points,
        }
    }

    /// Values at the nodes of the grid; NaN outside all cells and if a corner is missing.
    pub fn apply(&self, values: &[f32]) -> Vec<f32> {
        match self {
            Self::Rows(rows) => rows.apply(values),
            Self::Triangles(triangles) => triangles.apply(values),
        }
    }
}

impl InRows {
    fn new(mesh: &Mesh, target: &Target) -> Self {
        let [nx, ny] = mesh.shape;
        let mut this = Self {
            shape: mesh.shape,
            cell: vec![NOWHERE; target.nodes[0] * target.nodes[1]],
            place: vec![[0.0; 2]; target.nodes[0] * target.nodes[1]],
        };
        let spacing = median(mesh.spacings()).unwrap_or(0.0);
        let across = if mesh.goes_round(spacing) { nx } else { nx - 1 };
        for j in 0..ny - 1 {
            for i in 0..across {
                let corners = [(i, j), ((i + 1) % nx, j), (i, j + 1), ((i + 1) % nx, j + 1)].map(|(i, j)| mesh.point(i, j));
                if let [Some(a), Some(b), Some(c), Some(d)] = corners {
                    this.fill((j * nx + i) as u32, [a, b, c, d], target);
                }
            }
        }
        this
    }

    /// Locates the grid's nodes in one cell.
    fn fill(&mut self, index: u32, corners: [[f64; 2]; 4], target: &Target) {
        let vectors = corners.map(|c| vector(c[0], c[1]));
        let Some(middle) = middle(&vectors) else { return };
        let [longitude, latitude] = degrees(middle);
        let [east, north] = east_north(longitude, latitude);
        let project = |v: Vector| {
            let ahead = dot(v, middle);
            (ahead > 0.1).then(|| [dot(v, east) / ahead, dot(v, north) / ahead])
        };
        let [Some(a), Some(b), Some(c), Some(d)] = vectors.map(project) else { return };
        target.around(&corners, |node, p| {
            if self.cell[node] == NOWHERE
                && let Some(place) = project(p).and_then(|p| inside([a, b, c, d], p))
            {
                self.cell[node] = index;
                self.place[node] = place.map(|s| s as f32);
            }
        });
    }

    fn apply(&self, values: &[f32]) -> Vec<f32> {
        let nx = self.shape[0];
        let one = |(&cell, &[s, t]): (&u32, &[f32; 2])| {
            if cell == NOWHERE {
                return f32::NAN;
            }
            let cell = cell as usize;
            let next = if cell % nx + 1 == nx { cell + 1 - nx } else { cell + 1 };
            (1.0 - t) * ((1.0 - s) * values[cell] + s * values[next]) + t * ((1.0 - s) * values[cell + nx] + s * values[next + nx])
        };
        self.cell.iter().zip(&self.place).map(one).collect()
    }
}

/// Place of a point in a quadrangle of corners (0,0), (1,0), (0,1), (1,1), by Newton's method. `None` outside.
fn inside([a, b, c, d]: [[f64; 2]; 4], p: [f64; 2]) -> Option<[f64; 2]> {
    let (mut s, mut t) = (0.5, 0.5);
    for _ in 0..20 {
        let at = |k: usize| a[k] + s * (b[k] - a[k]) + t * (c[k] - a[k]) + s * t * (a[k] - b[k] - c[k] + d[k]) - p[k];
        let along_s = |k: usize| b[k] - a[k] + t * (a[k] - b[k] - c[k] + d[k]);
        let along_t = |k: usize| c[k] - a[k] + s * (a[k] - b[k] - c[k] + d[k]);
        let determinant = along_s(0) * along_t(1) - along_s(1) * along_t(0);
        if determinant == 0.0 || !determinant.is_finite() {
            return None;
        }
        let step = [(at(0) * along_t(1) - at(1) * along_t(0)) / determinant, (at(1) * along_s(0) - at(0) * along_s(1)) / determinant];
        (s, t) = (s - step[0], t - step[1]);
        if step[0].abs() + step[1].abs() < 1e-12 {
            break;
        }
        if !(s.abs() < 10.0 && t.abs() < 10.0) {
            return None;
        }
    }
    let within = |v: f64| (-SLACK..=1.0 + SLACK).contains(&v);
    (within(s) && within(t)).then(|| [s.clamp(0.0, 1.0), t.clamp(0.0, 1.0)])
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A mesh turned by an angle about its middle at 30 degrees east, 50 degrees north.
    fn turned(degrees: f64, n: usize) -> Mesh {
        let (sine, cosine) = degrees.to_radians().sin_cos();
        let (mut longitude, mut latitude) = (Vec::new(), Vec::new());
        for j in 0..n {
            for i in 0..n {
                let (x, y) = ((i as f64 / (n - 1) as f64 - 0.5) * 10.0, (j as f64 / (n - 1) as f64 - 0.5) * 10.0);
                longitude.push(30.0 + (cosine * x - sine * y) / 0.7);
                latitude.push(50.0 + sine * x + cosine * y);
            }
        }
        Mesh::rows([n, n], longitude, latitude)
    }

    #[test]
    fn smooth_fields_survive() {
        let mesh = turned(25.0, 41);
        let target = target(&mesh, None, None).unwrap();
        assert!(!target.round && target.nodes.iter().all(|&n| n > 20 && n < 80), "{target:?}");
        let locator = Locator::new(&mesh, &target);
        let field = |lon: f64, lat: f64| (lon * 0.3).sin() + 0.1 * lat;
        let values: Vec<f32> = (0..mesh.longitude.len()).map(|n| field(mesh.longitude[n], mesh.latitude[n]) as f32).collect();
        let on_grid = locator.apply(&values);
        let mut found = 0;
        for (node, &value) in on_grid.iter().enumerate().filter(|(_, v)| v.is_finite()) {
            let (x, y) = (node % target.nodes[0], node / target.nodes[0]);
            let exact = field(target.first[0] + target.step[0] * x as f64, target.first[1] + target.step[1] * y as f64);
            // An eighth of the square of a cell (0.36 degrees) times the second derivative (0.09).
            assert!((f64::from(value) - exact).abs() < 3e-3, "{value} {exact}");
            found += 1;
        }
        // The turned square fills more than half of the box around it.
        assert!(found * 2 > on_grid.len() && found < on_grid.len(), "{found} of {}", on_grid.len());
        let middle = 20 * 41 + 20;
        let [x, y] = mesh.directions(true)[middle].map(|d| d.map(f64::from));
        let [east, north] = east_north(mesh.longitude[middle], mesh.latitude[middle]);
        // East is stretched by 0.7 / cos(50 degrees) here.
        assert!((dot(x, north).atan2(dot(x, east)).to_degrees() - 25.0).abs() < 3.0);
        assert!(dot(x, y).abs() < 1e-6 && (dot(y, north) - dot(x, east)).abs() < 1e-6, "{x:?} {y:?}");
        assert_eq!(mesh.directions(false)[middle], [east, north].map(|e| e.map(|v| v as f32)));
    }

    #[test]
    fn the_date_line_makes_no_hole() {
        for resolution in [0.2, 0.25, 0.31, 0.37, 0.45] {
            let known = |east: f64| {
                let mut mesh = turned(25.0, 41);
                mesh.longitude.iter_mut().for_each(|l| *l = turn(*l + east));
                let target = target(&mesh, Some([resolution; 2]), None).unwrap();
                Locator::new(&mesh, &target).apply(&vec![1.0; 41 * 41]).iter().filter(|v| v.is_finite()).count()
            };
            // Rounding may decide for nodes on the rim.
            assert!(known(0.0).abs_diff(known(150.0)) < 4, "{resolution}: {} and {}", known(0.0), known(150.0));
        }
    }

    #[test]
    fn steps_are_those_in_which_the_indices_change() {
        // Of a mesh whose rows run north, 3 degrees apart in columns of 1 degree, on the equator; and of one whose rows lie 5 columns further east.
        let mesh = |place: fn(f64, f64) -> [f64; 2]| {
            let points: Vec<[f64; 2]> = (0..25).map(|n| place(f64::from(n % 5) - 2.0, f64::from(n / 5) - 2.0)).collect();
            Mesh::rows([5, 5], points.iter().map(|p| p[0]).collect(), points.iter().map(|p| p[1]).collect())
        };
        for (place, east, north) in [
            ((|i, j| [-0.01 * j, 0.03 * i]) as fn(f64, f64) -> [f64; 2], 0.01, 0.03),
            (|i, j| [0.01 * i + 0.05 * j, 0.01 * j], 0.01, 0.01 / 26f64.sqrt()),
        ] {
            let found = mesh(place).steps().unwrap();
            assert!((found[0] / east - 1.0).abs() < 1e-5 && (found[1] / north - 1.0).abs() < 1e-5, "{found:?}");
        }
    }

    #[test]
    fn a_region_is_the_part_of_the_grid_in_it() {
        // Meshes of 10 rows from one longitude to another, and the ends of the grid in a region.
        let ends = |first: f64, last: f64, region: [f64; 2]| {
            let columns = ((last - first) / 2.0).round() as usize + 1;
            let longitude = (0..columns * 10).map(|n| first + 2.0 * (n % columns) as f64).collect();
            let mesh = Mesh::rows([columns, 10], longitude, (0..columns * 10).map(|n| 2.0 * (n / columns) as f64).collect());
            let target = target(&mesh, None, Some([region[0], region[1], 3.0, 90.0]))?;
            assert_eq!((target.first[1], target.first[1] + target.step[1] * (target.nodes[1] - 1) as f64), (3.0, 18.0));
            let last = target.first[0] + target.step[0] * (target.nodes[0] - 1) as f64;
            Ok::<_, String>(([target.first[0], last].map(|l| (l * 1e6).round() / 1e6), target.round))
        };
        assert_eq!(ends(160.0, 200.0, [170.0, -175.0]), Ok(([170.0, 185.0], false)));
        assert_eq!(ends(160.0, 200.0, [-180.0, 180.0]), Ok(([160.0, 200.0], false)));
        assert_eq!(ends(160.0, 200.0, [100.0, 170.0]), Ok(([160.0, 170.0], false)));
        assert_eq!(ends(-10.0, 30.0, [0.0, 360.0]), Ok(([-10.0, 30.0], false)));
        assert_eq!(ends(20.0, 340.0, [-60.0, 60.0]), Ok(([300.0, 420.0], false)));
        assert_eq!(ends(0.0, 358.0, [-60.0, 60.0]), Ok(([-60.0, 60.0], false)));
        assert!(ends(0.0, 358.0, [-180.0, 180.0]).unwrap().1);
        assert!(ends(160.0, 200.0, [0.0, 20.0]).unwrap_err().contains("lies beside it"));
    }

    #[test]
    fn a_mesh_without_width_is_refused() {
        let line = |longitude: fn(f64) -> f64, latitude: fn(f64) -> f64| {
            let at = |f: fn(f64) -> f64| (0..9).map(|n| f(f64::from(n))).collect();
            target(&Mesh::rows([3, 3], at(longitude), at(latitude)), Some([0.5, 0.5]), None)
        };
        // Along a meridian, the one at 180 degrees, a parallel, and a closed parallel.
        for (longitude, latitude, word) in [
            ((|_| 20.0) as fn(f64) -> f64, (|n| 10.0 + n) as fn(f64) -> f64, "meridian"),
            (|n| if n > 4.0 { 180.0 } else { -180.0 }, |n| n, "meridian"),
            (|n| 20.0 + n, |_| 10.0, "parallel"),
            (|n| 40.0 * n, |_| 10.0, "parallel"),
        ] {
            let message = line(longitude, latitude).unwrap_err();
            assert!(message.contains(word), "{message}");
        }
        assert!(line(|n| 20.0 + n % 3.0, |n| 10.0 + (n / 3.0).floor()).is_ok());
    }

    #[test]
    fn a_globe_with_the_pole_in_a_cell_has_no_hole() {
        // A polar cap on a stereographic plane.
        let n = 41;
        let (mut longitude, mut latitude) = (Vec::new(), Vec::new());
        for j in 0..n {
            for i in 0..n {
                let (x, y) = (i as f64 - 20.3, j as f64 - 19.6);
                longitude.push(y.atan2(x).to_degrees());
                latitude.push(90.0 - x.hypot(y));
            }
        }
        let mesh = Mesh::rows([n, n], longitude, latitude);
        let target = target(&mesh, Some([5.0, 1.0]), None).unwrap();
        assert!(target.round);
        let locator = Locator::new(&mesh, &target);
        let ones = locator.apply(&vec![1.0; n * n]);
        // All rows north of 72 degrees lie inside the square.
        let row = ((73.0 - target.first[1]) / target.step[1]).ceil() as usize;
        assert!(ones[row * target.nodes[0]..].iter().all(|v| (v - 1.0).abs() < 1e-6));
    }
}
