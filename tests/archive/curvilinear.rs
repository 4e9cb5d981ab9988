//! Longitudes and latitudes of two dimensions as ocean models have them: levels, components on staggered points, a seam, three poles.
//! The flow is a rotation of the globe about a tilted axis, which is smooth everywhere, poles included.

use crate::kit::flow::{Vector, cross, direction, dot, unit};
use crate::kit::netcdf::*;
use crate::{HOURS, notes, open, open_with, refused};
use ridgewatch::field::Snapshot;
use ridgewatch::source::SnapshotSource;
use std::path::{Path, PathBuf};
use tempfile::tempdir;

/// Axis of the rotation, in m/s at distance 1.
const OMEGA: Vector = [0.3, -0.5, 0.8];

fn degrees(p: Vector) -> [f64; 2] {
    [p[1].atan2(p[0]).to_degrees(), p[2].clamp(-1.0, 1.0).asin().to_degrees()]
}

fn east(p: Vector) -> Vector {
    unit(cross([0.0, 0.0, 1.0], p))
}

/// A mesh: a point of the globe at every pair of (real) indices.
type Mesh<'a> = &'a dyn Fn(f64, f64) -> Vector;

/// Direction of x at a point of a mesh.
fn along(mesh: Mesh, i: f64, j: f64) -> Vector {
    let (p, q) = (mesh(i, j), mesh(i + 1e-4, j));
    let radial = dot(q, p) - 1.0;
    unit(std::array::from_fn(|k| q[k] - p[k] - radial * p[k]))
}

/// Layout of a file of currents.
struct Layout<'a> {
    mesh: Mesh<'a>,
    shape: [usize; 2],
    /// Components run along the mesh; otherwise eastward and northward.
    along: bool,
    /// u lies half a cell further along x, and v along y; the file has coordinates of these points.
    apart: bool,
    /// Depths in metres, in the order of the file; without levels if empty.
    depths: &'a [f64],
    hour: f64,
}

/// Factor by which the flow is faster than the rotation: it grows with height.
fn growth(depth: f64) -> f64 {
    1.0 - depth / 1000.0
}

impl Layout<'_> {
    fn write(&self, path: &Path) -> PathBuf {
        let [nx, ny] = self.shape;
        let levels = self.depths.len().max(1);
        let mut dims = vec![("time", 2), ("y", ny), ("x", nx)];
        if !self.depths.is_empty() {
            dims.insert(1, ("depth", levels));
        }
        if self.apart {
            dims.extend([("y_u", ny), ("x_u", nx), ("y_v", ny), ("x_v", nx)]);
        }
        let mut fixture = Fixture::new(NETCDF4, &dims).axis("time", HOURS, &[self.hour, self.hour + 1.0]);
        if !self.depths.is_empty() {
            fixture = fixture.axis("depth", "m", self.depths).with("positive", "down");
        }
        let names = if self.along {
            ["sea_water_x_velocity", "sea_water_y_velocity"]
        } else {
            ["eastward_sea_water_velocity", "northward_sea_water_velocity"]
        };
        for (c, name) in ["u", "v"].into_iter().enumerate() {
            let suffix = if self.apart { format!("_{name}") } else { String::new() };
            let shift = if self.apart { [[0.5, 0.0], [0.0, 0.5]][c] } else { [0.0; 2] };
            let places: Vec<[f64; 2]> = (0..nx * ny).map(|n| [(n % nx) as f64 + shift[0], (n / nx) as f64 + shift[1]]).collect();
            let points: Vec<Vector> = places.iter().map(|p| (self.mesh)(p[0], p[1])).collect();
            let (y, x) = (format!("y{suffix}"), format!("x{suffix}"));
            if c == 0 || self.apart {
                for (k, (coordinate, units)) in [("lon", "degrees_east"), ("lat", "degrees_north")].into_iter().enumerate() {
                    let values = points.iter().map(|&p| degrees(p)[k]).collect();
                    fixture = fixture.variable(&format!("{coordinate}{suffix}"), &[&y, &x], Data::F64(values)).with("units", units);
                }
            }
            let plane: Vec<f64> = places
                .iter()
                .zip(&points)
                .map(|(place, &p)| {
                    let x = if self.along { along(self.mesh, place[0], place[1]) } else { east(p) };
                    dot(cross(OMEGA, p), if c == 0 { x } else { cross(p, x) })
                })
                .collect();
            let factor = |level: usize| self.depths.get(level).map_or(1.0, |&depth| growth(depth));
            let values = fill(2 * levels, 1, nx * ny, |n, _, i| plane[i] * factor(n % levels));
            let mut on = vec!["time", &y, &x];
            if !self.depths.is_empty() {
                on.insert(1, "depth");
            }
            fixture = fixture
                .variable(["uo", "vo"][c], &on, f32s(values))
                .with("standard_name", names[c])
                .with("units", "m s-1")
                .with("coordinates", format!("lon{suffix} lat{suffix}").as_str());
        }
        fixture.write(path)
    }
}

/// Largest error of the known nodes, as vectors, and their share.
fn error(snapshot: &Snapshot) -> (f64, f64) {
    let grid = &snapshot.grid;
    let [nx, ny, _] = grid.shape();
    let (mut worst, mut known) = (0.0f64, 0);
    for (i, node) in snapshot.nodes.iter().enumerate().filter(|(_, n)| !n[3].is_nan()) {
        let p = direction(grid.axes[0].coordinates()[i % nx], grid.axes[1].coordinates()[i / nx % ny]);
        let factor = grid.axes.get(2).map_or(1.0, |z| growth(-z.coordinates()[i / (nx * ny)]));
        let exact = cross(OMEGA, p).map(|v| v * factor);
        worst = (0..3).map(|k| (f64::from(node[k]) - exact[k]).abs()).fold(worst, f64::max);
        known += 1;
    }
    (worst, known as f64 / snapshot.nodes.len() as f64)
}

/// A patch in cells of half a degree, turned by 30 degrees about a place near the date line.
fn patch(i: f64, j: f64) -> Vector {
    let (sine, cosine) = 30f64.to_radians().sin_cos();
    let (a, b) = ((i - 20.0) * 0.5f64.to_radians(), (j - 15.0) * 0.5f64.to_radians());
    let middle = direction(179.0, 35.0);
    let (x, y) = (cosine * a - sine * b, sine * a + cosine * b);
    let (e, n) = (east(middle), cross(middle, east(middle)));
    unit(std::array::from_fn(|k| middle[k] + x * e[k] + y * n[k]))
}

/// Cells of 5 degrees around the globe from 74 degrees east, whose rows are bent.
fn belt(i: f64, j: f64) -> Vector {
    let lon = 74.0 + 5.0 * i;
    direction(lon, -60.0 + 5.0 * j + 3.0 * (lon.to_radians() * 2.0).sin())
}

/// Like `belt` up to 60 degrees north; beyond, rows are ellipses that flatten to a line between two poles of the mesh, at 0 and 180 degrees
/// east: both halves of the last row lie on it, the pole of the globe inside.
fn tripolar(i: f64, j: f64) -> Vector {
    let angle = (2.5 + 5.0 * i).to_radians();
    if j <= 24.0 {
        return direction(angle.to_degrees(), -60.0 + 5.0 * j);
    }
    let height = 1.0 - (j - 24.0) / 8.0;
    // On the plane that touches the pole, where 60 degrees north is a circle.
    let radius = 30f64.to_radians().tan();
    unit([radius * angle.cos(), radius * angle.sin() * height, 1.0])
}

/// MITgcm: u and v on faces whose dimensions have no coordinates of their own, half a cell west and south of the centres.
#[test]
fn faces_lie_half_a_cell_from_the_centres() {
    let dir = tempdir().unwrap();
    let (nx, ny) = (40, 30);
    let write = |names: [&str; 2], shift: Option<f64>, moved: f64| {
        let mut fixture = Fixture::new(NETCDF4, &[("time", 2), ("j", ny), ("i", nx), (names[1], ny), (names[0], nx)]);
        fixture = fixture.axis("time", HOURS, &[0.0, 1.0]);
        if let Some(shift) = shift {
            let numbers = |n: usize| Data::F64((0..n).map(|i| i as f64).collect());
            fixture = fixture.variable(names[0], &[names[0]], numbers(nx)).with("c_grid_axis_shift", shift).with("axis", "X");
            fixture = fixture.variable(names[1], &[names[1]], numbers(ny)).with("c_grid_axis_shift", shift).with("axis", "Y");
        }
        for (k, (name, units)) in [("XC", "degrees_east"), ("YC", "degrees_north")].into_iter().enumerate() {
            let values = fill(1, ny, nx, |_, j, i| degrees(patch(i as f64, j as f64))[k]);
            fixture = fixture.variable(name, &["j", "i"], Data::F64(values)).with("units", units);
        }
        let half = shift.unwrap_or(-0.5);
        for (c, (name, on)) in [("UVEL", ["j", names[0]]), ("VVEL", [names[1], "i"])].into_iter().enumerate() {
            let at = |j: usize, i: usize| match c {
                0 => [i as f64 + half, j as f64],
                _ => [i as f64, j as f64 + half],
            };
            let values = fill(2, ny, nx, |_, j, i| {
                let [x, y] = at(j, i);
                let p = patch(x, y);
                let along_x = along(&patch, x, y);
                dot(cross(OMEGA, p), if c == 0 { along_x } else { cross(p, along_x) }) * moved
            });
            fixture = fixture.variable(name, &["time", on[0], on[1]], f32s(values)).with("units", "m s-1");
        }
        fixture.write(&dir.path().join(format!("{}.nc", names[0])))
    };
    for (names, shift) in [(["i_g", "j_g"], None), (["xf", "yf"], Some(-0.5)), (["right_x", "right_y"], Some(0.5))] {
        let mut archive = open(&[write(names, shift, 1.0)]);
        let (worst, known) = error(&archive.read(0).unwrap());
        // Bilinear interpolation alone errs by 1e-5 here; half a cell of half a degree is 4e-3.
        assert!(worst < 3e-4 && known > 0.4, "{names:?}: {worst} {known}");
        assert!(
            notes(&archive).contains("`UVEL` lies on faces without coordinates: half a cell from the points of `XC` and `YC`"),
            "{}",
            notes(&archive)
        );
    }
}

/// A component of another place is no partner.
#[test]
fn components_lie_beside_one_another() {
    let dir = tempdir().unwrap();
    let write = |name: &str, nx: usize, moved: f64, file: &str| {
        let (ny, component) = (30, name.chars().next().unwrap());
        let mut fixture = Fixture::new(NETCDF4, &[("time", 2), ("y", ny), ("x", nx)]).axis("time", HOURS, &[0.0, 1.0]);
        for (k, (name, units)) in [("nav_lon", "degrees_east"), ("nav_lat", "degrees_north")].into_iter().enumerate() {
            let values = fill(1, ny, nx, |_, j, i| degrees(patch(i as f64, j as f64))[k] - if k == 1 { moved } else { 0.0 });
            fixture = fixture.variable(name, &["y", "x"], Data::F64(values)).with("units", units);
        }
        let standard = if component == 'u' { "sea_water_x_velocity" } else { "sea_water_y_velocity" };
        fixture
            .variable(name, &["time", "y", "x"], f32s(vec![0.1; 2 * nx * ny]))
            .with("standard_name", standard)
            .with("units", "m s-1")
            .write(&dir.path().join(file))
    };
    let u = write("uo", 40, 0.0, "u.nc");
    open(&[&u, &write("vo", 40, 0.0, "v.nc")]);
    refused(&[&u, &write("vo", 40, 30.0, "far.nc")], "", &["v lies at", "u at", "components of one place"]);
    // Points of its own, fewer or more, are no reason.
    open(&[&u, &write("vo", 30, 0.0, "small.nc")]);
}

#[test]
fn levels_and_components_on_points_of_their_own() {
    let dir = tempdir().unwrap();
    for (n, (along, apart)) in [(false, false), (true, false), (false, true), (true, true)].into_iter().enumerate() {
        let layout = |hour: f64| Layout { mesh: &patch, shape: [41, 31], along, apart, depths: &[10.0, 200.0, 0.0, 50.0], hour };
        let files = [0.0, 2.0].map(|hour| layout(hour).write(&dir.path().join(format!("{n}_{hour}.nc"))));
        let mut archive = open(&files);
        assert_eq!(archive.times().len(), 4);
        let grid = archive.grid().clone();
        // Depths as heights, sorted; longitudes run on across the date line.
        assert_eq!(grid.axes[2].coordinates(), [-200.0, -50.0, -10.0, 0.0]);
        assert!(grid.axes[0].first() < 180.0 && grid.axes[0].last() > 180.0 && grid.axes[0].period().is_none(), "{:?}", grid.axes[0]);
        for time in 0..4 {
            let (worst, known) = error(&archive.read(time).unwrap());
            println!("along {along}, apart {apart}: {worst:.1e} m/s, {known:.2} known");
            // An eighth of the square of a cell (0.0087) in each direction, of 1 m/s in components that turn, and twice that apart.
            assert!(worst < 4e-5, "along {along}, apart {apart}: {worst:e}");
            // A turned patch of 20 x 15 in the box around it: 0.53, less the edge.
            assert!(known > 0.45, "{known}");
        }
        let notes = notes(&archive);
        assert!(notes.contains("`depth` neither ascends nor descends in the file: sorted"), "{notes}");
    }
}

#[test]
fn a_mesh_that_goes_round_has_no_seam() {
    let dir = tempdir().unwrap();
    // Once around, and with two columns that repeat the first ones, as some models write.
    for (n, (along, apart, columns)) in [(false, false, 72), (true, true, 72), (true, false, 74), (false, true, 74)].into_iter().enumerate()
    {
        let layout = Layout { mesh: &belt, shape: [columns, 25], along, apart, depths: &[], hour: 0.0 };
        let mut archive = open(&[layout.write(&dir.path().join(format!("{n}.nc")))]);
        let grid = archive.grid().clone();
        assert_eq!(grid.axes[0].period(), Some(360.0));
        let snapshot = archive.read(0).unwrap();
        let (worst, _) = error(&snapshot);
        // Cells of 0.087, twice; the same bound holds beside the last column of the mesh.
        println!("once around, along {along}, apart {apart}, {columns} columns: {worst:.1e} m/s");
        assert!(worst < 4e-3, "along {along}, apart {apart}, {columns} columns: {worst:e}");
        let [nx, ny, _] = grid.shape();
        for j in (0..ny).filter(|&j| grid.axes[1].coordinates()[j].abs() < 50.0) {
            assert!((0..nx).all(|i| !snapshot.nodes[j * nx + i][3].is_nan()), "row {j} has a hole");
        }
        let ends = open_with(&[dir.path().join(format!("{n}.nc"))], "periodic = \"none\"");
        assert_eq!(ends.grid().axes[0].period(), None);
    }
}

#[test]
fn three_poles() {
    let dir = tempdir().unwrap();
    for along in [false, true] {
        let layout = Layout { mesh: &tripolar, shape: [72, 33], along, apart: false, depths: &[], hour: 0.0 };
        let mut archive = open(&[layout.write(&dir.path().join(format!("{along}.nc")))]);
        let grid = archive.grid().clone();
        assert_eq!((grid.axes[0].period(), grid.axes[1].last()), (Some(360.0), 90.0));
        let snapshot = archive.read(1).unwrap();
        let (worst, known) = error(&snapshot);
        println!("three poles, along {along}: {worst:.1e} m/s, {known:.3} known");
        assert!(worst < 2.5e-3, "along {along}: {worst:e}");
        // Missing nodes lie at the poles of the mesh, which models put on land.
        let [nx, _, _] = grid.shape();
        for (i, _) in snapshot.nodes.iter().enumerate().filter(|(_, n)| n[3].is_nan()) {
            let (lon, lat) = (grid.axes[0].coordinates()[i % nx], grid.axes[1].coordinates()[i / nx]);
            let p = direction(lon, lat);
            let nearest = [0.0, 180.0].map(|l| dot(p, direction(l, 60.0)).acos().to_degrees()).into_iter().fold(f64::INFINITY, f64::min);
            assert!(nearest < 7.0, "a hole at {lon} E, {lat} N");
        }
    }
}
