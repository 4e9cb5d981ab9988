//! How fine the grid of a mesh is made: turned, stretched and sheared meshes whose flow is known, against interpolation in the mesh's own index
//! space and an integration of its own.

use crate::integrated::default_map;
use crate::kit::flow::{quasi_random, trace, window};
use crate::kit::netcdf::*;
use crate::{HOURS, inspected, notes, open, open_with};
use ridgewatch::field::{DomainPoint, EARTH_RADIUS, Snapshot};
use ridgewatch::flow::{Boundary, Direction, Extras, FlowMap, Integrator, Precision, VelocitySource};
use ridgewatch::source::{Archive, SnapshotSource};
use std::path::{Path, PathBuf};
use tempfile::tempdir;

/// Middle of the meshes, degrees.
const MIDDLE: [f64; 2] = [30.0, 45.0];
/// Hours that particles move.
const HOURS_LONG: f64 = 120.0;

/// A mesh, and a flow (eastward and northward, m/s) about [`MIDDLE`] in degrees.
#[derive(Clone, Copy)]
struct Sea {
    points: [usize; 2],
    /// Place of indices, degrees from the middle.
    place: fn(f64, f64) -> [f64; 2],
    /// Indices of a place.
    index: fn(f64, f64) -> [f64; 2],
    flow: fn(f64, f64) -> [f64; 2],
    /// Each cell is two triangles of an unstructured mesh, not a part of rows and columns.
    triangles: bool,
    /// Nothing moves at the first time.
    begins_at_rest: bool,
}

/// Eddies of 2.5 to 4 degrees.
fn eddies(x: f64, y: f64) -> [f64; 2] {
    let wave = |length: f64, x: f64| (std::f64::consts::TAU / length * x + 0.5).sin();
    [0.5 * wave(4.0, y) + 0.2 * wave(2.5, x), 0.4 * wave(4.0, x) + 0.15 * wave(2.5, y)]
}

/// A jet to the north along the middle, which eddies bend.
fn jet(x: f64, y: f64) -> [f64; 2] {
    let [u, v] = eddies(x / 1.5, y / 1.5);
    [0.3 * u, 0.8 * (-(x / 0.35).powi(2)).exp() + 0.3 * v]
}

/// Cells of 0.4 degrees, turned by 35 degrees (on the map).
const TURNED: Sea = Sea {
    points: [41, 41],
    place: |i, j| {
        let (sine, cosine) = 35f64.to_radians().sin_cos();
        [0.4 * (cosine * (i - 20.0) - sine * (j - 20.0)), 0.4 * (sine * (i - 20.0) + cosine * (j - 20.0))]
    },
    index: |x, y| {
        let (sine, cosine) = 35f64.to_radians().sin_cos();
        [20.0 + (cosine * x + sine * y) / 0.4, 20.0 + (cosine * y - sine * x) / 0.4]
    },
    flow: eddies,
    triangles: false,
    begins_at_rest: false,
};

/// Columns from 0.08 degrees in the middle to 0.5 degrees at the sides.
const STRETCHED: Sea = Sea {
    points: [61, 41],
    place: |i, j| [6.0 * (2.5 * (i - 30.0) / 30.0).sinh() / 2.5f64.sinh(), 0.3 * (j - 20.0)],
    index: |x, y| [30.0 + 30.0 / 2.5 * (x / 6.0 * 2.5f64.sinh()).asinh(), 20.0 + y / 0.3],
    flow: jet,
    triangles: false,
    begins_at_rest: false,
};

/// Rows of which each lies three columns further east.
const SHEARED: Sea = Sea {
    points: [61, 41],
    place: |i, j| [0.3 * (i - 30.0) + 0.9 * (j - 20.0), 0.3 * (j - 20.0)],
    index: |x, y| [30.0 + (x - 3.0 * y) / 0.3, 20.0 + y / 0.3],
    flow: eddies,
    triangles: false,
    begins_at_rest: false,
};

impl Sea {
    /// By the UGRID conventions: values at the nodes of triangles, counted from 1.
    fn write_triangles(&self, path: &Path, places: &[[f64; 2]]) -> PathBuf {
        let ([nx, ny], nodes) = (self.points, places.len());
        let cells = (0..(nx - 1) * (ny - 1)).map(|cell| cell / (nx - 1) * nx + cell % (nx - 1) + 1);
        let corners: Vec<f64> = cells.flat_map(|n| [n, n + 1, n + nx + 1, n, n + nx + 1, n + nx]).map(|n| n as f64).collect();
        let mut fixture = Fixture::new(NETCDF4, &[("time", 2), ("face", corners.len() / 3), ("node", nodes), ("three", 3)])
            .axis("time", HOURS, &[0.0, HOURS_LONG])
            .variable("face_nodes", &["face", "three"], Data::F64(corners))
            .with("cf_role", "face_node_connectivity")
            .with("start_index", 1);
        for (k, (name, units)) in [("node_lon", "degrees_east"), ("node_lat", "degrees_north")].into_iter().enumerate() {
            let values = places.iter().map(|p| MIDDLE[k] + p[k]).collect();
            fixture = fixture.variable(name, &["node"], Data::F64(values)).with("units", units);
        }
        for (c, name) in ["uo", "vo"].into_iter().enumerate() {
            let values = (0..2 * nodes).map(|n| (self.flow)(places[n % nodes][0], places[n % nodes][1])[c]).collect();
            fixture = fixture.variable(name, &["time", "node"], f32s(values)).with("units", "m s-1").with("location", "node");
        }
        fixture.write(path)
    }

    fn write(&self, path: &Path) -> PathBuf {
        let [nx, ny] = self.points;
        let places: Vec<[f64; 2]> = (0..nx * ny).map(|n| (self.place)((n % nx) as f64, (n / nx) as f64)).collect();
        if self.triangles {
            return self.write_triangles(path, &places);
        }
        let mut fixture = Fixture::new(NETCDF4, &[("time", 2), ("y", ny), ("x", nx)]).axis("time", HOURS, &[0.0, HOURS_LONG]);
        for (k, (name, units)) in [("lon", "degrees_east"), ("lat", "degrees_north")].into_iter().enumerate() {
            let values = places.iter().map(|p| MIDDLE[k] + p[k]).collect();
            fixture = fixture.variable(name, &["y", "x"], Data::F64(values)).with("units", units);
        }
        for (c, (name, standard)) in [("uo", "eastward_sea_water_velocity"), ("vo", "northward_sea_water_velocity")].into_iter().enumerate()
        {
            let factor = |n: usize| if self.begins_at_rest && n < nx * ny { 0.0 } else { 1.0 };
            let values = (0..2 * nx * ny).map(|n| factor(n) * (self.flow)(places[n % (nx * ny)][0], places[n % (nx * ny)][1])[c]).collect();
            fixture = fixture.variable(name, &["time", "y", "x"], f32s(values)).with("standard_name", standard).with("units", "m s-1");
        }
        fixture.write(path)
    }

    /// Interpolation of the flow in the indices of the mesh, bilinear or linear in triangles; degrees from the middle.
    fn in_mesh(&self, x: f64, y: f64) -> [f64; 2] {
        let place = (self.index)(x, y);
        let low = place.map(f64::floor);
        let [s, t] = [0, 1].map(|k| place[k] - low[k]);
        let at = |di: f64, dj: f64| {
            let [x, y] = (self.place)(low[0] + di, low[1] + dj);
            (self.flow)(x, y)
        };
        if self.triangles {
            let (side, [along, across]) = if s >= t { (at(1.0, 0.0), [s - t, t]) } else { (at(0.0, 1.0), [t - s, s]) };
            return [0, 1].map(|c| (1.0 - along - across) * at(0.0, 0.0)[c] + along * side[c] + across * at(1.0, 1.0)[c]);
        }
        [0, 1].map(|c| {
            (1.0 - t) * ((1.0 - s) * at(0.0, 0.0)[c] + s * at(1.0, 0.0)[c]) + t * ((1.0 - s) * at(0.0, 1.0)[c] + s * at(1.0, 1.0)[c])
        })
    }

    /// Log-stretch at a longitude and latitude by classical Runge-Kutta steps through interpolation in the mesh, and differences of neighbours.
    fn stretch(&self, [longitude, latitude]: [f64; 2]) -> f64 {
        let velocity = |p: [f64; 2]| {
            let [u, v] = self.in_mesh(p[0] - MIDDLE[0], p[1] - MIDDLE[1]);
            [(u / (EARTH_RADIUS * p[1].to_radians().cos())).to_degrees(), (v / EARTH_RADIUS).to_degrees()]
        };
        let steps = 1500;
        let h = HOURS_LONG * 3600.0 / f64::from(steps);
        let carry = |start: [f64; 2]| {
            (0..steps).fold(start, |p, _| {
                let along = |k: [f64; 2], f: f64| [p[0] + f * h * k[0], p[1] + f * h * k[1]];
                let a = velocity(p);
                let b = velocity(along(a, 0.5));
                let c = velocity(along(b, 0.5));
                let d = velocity(along(c, 1.0));
                [0, 1].map(|k| p[k] + h / 6.0 * (a[k] + 2.0 * b[k] + 2.0 * c[k] + d[k]))
            })
        };
        let gap = 1e-6;
        let wide = gap / latitude.to_radians().cos();
        let pairs = [([-wide, 0.0], [wide, 0.0]), ([0.0, -gap], [0.0, gap])].map(|(back, ahead)| {
            let [a, b] = [back, ahead].map(|d| carry([longitude + d[0], latitude + d[1]]));
            [(b[0] - a[0]) * (0.5 * (a[1] + b[1])).to_radians().cos() / (2.0 * gap), (b[1] - a[1]) / (2.0 * gap)]
        });
        // Larger singular value of the 2 x 2 matrix.
        let [[a, c], [b, d]] = pairs;
        let (sum, det) = (a * a + b * b + c * c + d * d, a * d - b * c);
        (0.5 * (sum + (sum * sum - 4.0 * det * det).max(0.0).sqrt())).sqrt().ln()
    }
}

/// Eastward and northward velocity at a place, by linear interpolation on the grid.
fn on_grid(snapshot: &Snapshot, place: [f64; 2]) -> [f64; 2] {
    let axes = &snapshot.grid.axes;
    let cell = [0, 1].map(|k| (place[k] - axes[k].first()) / axes[k].uniform_step().unwrap());
    let low = cell.map(|c| c.floor() as usize);
    let [s, t] = [0, 1].map(|k| cell[k] - low[k] as f64);
    let at = |di: usize, dj: usize| east_north(snapshot, (low[1] + dj) * axes[0].len() + low[0] + di);
    [0, 1].map(|c| (1.0 - t) * ((1.0 - s) * at(0, 0)[c] + s * at(1, 0)[c]) + t * ((1.0 - s) * at(0, 1)[c] + s * at(1, 1)[c]))
}

/// Root mean square of differences, as a share of that of the second.
fn relative(pairs: &[(f64, f64)]) -> f64 {
    let sum = |f: &dyn Fn(&(f64, f64)) -> f64| pairs.iter().map(|p| f(p).powi(2)).sum::<f64>();
    (sum(&|p| p.0 - p.1) / sum(&|p| p.1)).sqrt()
}

/// Places within 2.5 degrees of the middle, which no particle leaves for the edge.
fn places(count: usize) -> impl Iterator<Item = [f64; 2]> {
    (0..count).map(quasi_random).map(|q| [MIDDLE[0] + 4.0 * (q[0] - 0.5), MIDDLE[1] + 3.0 * (q[1] - 0.5)])
}

/// Errors of the velocity against the mesh and against the flow itself, and of the FTLE against the integration in the mesh: by linear interpolation, and with
/// the defaults of a scene, of `file`.
fn errors(sea: &Sea, archive: &mut Archive, file: &Path) -> [f64; 4] {
    let snapshot = archive.read(0).unwrap();
    let compare = |truth: &dyn Fn(f64, f64) -> [f64; 2]| {
        let at = |p: [f64; 2]| {
            let (found, expected) = (on_grid(&snapshot, p), truth(p[0] - MIDDLE[0], p[1] - MIDDLE[1]));
            [(found[0], expected[0]), (found[1], expected[1])]
        };
        relative(&places(3000).flat_map(at).collect::<Vec<_>>())
    };
    let slab = snapshot.grid.slab;
    let seeds: Vec<DomainPoint> = places(40).map(|p| DomainPoint([p[0] as f32, p[1] as f32, (0.5 * (slab.0 + slab.1)) as f32])).collect();
    let linear = FlowMap {
        integrator: Integrator::DormandPrince,
        precision: Precision::F64,
        boundary: Boundary::Stop,
        ..FlowMap::tangent(HOURS_LONG * 3600.0, 1)
    };
    // Forward, as the integration in the mesh.
    let default = FlowMap { direction: Direction::Forward, ..default_map(&[file.to_owned()], "", HOURS_LONG * 3600.0) };
    let (begin, window) = (archive.times()[0], window(archive));
    let truth: Vec<f64> = seeds.iter().map(|seed| sea.stretch([0, 1].map(|k| f64::from(seed.0[k])))).collect();
    let [linear, default] = [linear, default].map(|map| {
        let traced = trace(&VelocitySource::Window(window.clone()), &map, begin, &seeds, Extras::default());
        assert!(traced.lifetime_share.iter().all(|&share| share == 1.0), "a particle stopped");
        relative(&traced.unrounded().into_iter().zip(truth.iter().copied()).collect::<Vec<_>>())
    });
    [compare(&|x, y| sea.in_mesh(x, y)), compare(&|x, y| (sea.flow)(x, y)), linear, default]
}

#[test]
fn grids_are_refined_until_they_carry_particles_as_the_mesh_does() {
    let dir = tempdir().unwrap();
    // Beside grids of the spacing of the rows.
    for (name, sea, coarse) in [
        ("turned", TURNED, "[0.4, 0.4]"),
        ("stretched", STRETCHED, "[0.3, 0.3]"),
        ("sheared", SHEARED, "[0.3, 0.3]"),
        ("turned, of triangles", Sea { triangles: true, ..TURNED }, "[0.4, 0.4]"),
        ("stretched, of triangles", Sea { triangles: true, ..STRETCHED }, "[0.3, 0.3]"),
    ] {
        let file = sea.write(&dir.path().join(format!("{name}.nc")));
        let mut refined = open(&[&file]);
        let [velocity, exact, ftle, default] = errors(&sea, &mut refined, &file);
        let mut kept = open_with(&[&file], &format!("resolution = {coarse}"));
        let [coarse_velocity, coarse_exact, coarse_ftle, _] = errors(&sea, &mut kept, &file);
        // What interpolation in the mesh itself errs by.
        let at = |p: [f64; 2]| {
            let [x, y] = [0, 1].map(|k| p[k] - MIDDLE[k]);
            let (found, expected) = (sea.in_mesh(x, y), (sea.flow)(x, y));
            [(found[0], expected[0]), (found[1], expected[1])]
        };
        let own = relative(&places(3000).flat_map(at).collect::<Vec<_>>());
        println!(
            "{name}: velocity {velocity:.4} of the mesh's, {exact:.4} of the flow (the mesh {own:.4}), FTLE {ftle:.4}, by default {default:.4}; with {coarse} {coarse_velocity:.4}, \
             {coarse_exact:.4}, {coarse_ftle:.4}; {:?} and {:?} nodes",
            refined.grid().shape(),
            kept.grid().shape()
        );
        // 0.6 % is reached over the whole mesh; in its middle, the jet errs by more.
        assert!(velocity < 0.016 && coarse_velocity > 2.0 * velocity, "{name}: {velocity} and {coarse_velocity}");
        // Against the flow itself, the error of interpolation in the mesh remains.
        assert!(exact < own + 0.016, "{name}: {exact} and {own}");
        // Across the edges of triangles the gradient jumps, and a grid does not follow them.
        let most = if sea.triangles { 0.05 } else { 0.03 };
        assert!(default < most, "{name}, by default: {default}");
        assert!(ftle < most && coarse_ftle > 1.5 * ftle, "{name}: {ftle} and {coarse_ftle}");
        let report = inspected(&[&file]).resampling.unwrap();
        println!("  {report:?}");
        let share = |error: f64| error / report.velocity;
        // Between the points, the error is stated at other places than those by which the grid was chosen.
        assert!(share(report.error) < 0.025 && share(report.error_between.unwrap()) < 0.007 && report.warning.is_none(), "{report:?}");
        assert!(report.what.contains("times finer than the mesh's median spacing, for errors of at most 2.5 %"), "{}", report.what);
    }
}

/// A run that begins at rest: the grid is chosen by a later time.
#[test]
fn a_first_snapshot_at_rest_does_not_choose_the_grid() {
    let dir = tempdir().unwrap();
    let moving = TURNED.write(&dir.path().join("moving.nc"));
    let resting = Sea { begins_at_rest: true, ..TURNED }.write(&dir.path().join("resting.nc"));
    let keys = "mask = \"none\"";
    assert_eq!(open_with(&[&resting], keys).grid().shape(), open_with(&[&moving], keys).grid().shape());
    let report = inspected(&[&resting]).resampling.unwrap();
    assert!(report.velocity > 0.1 && report.error < 0.025 * report.velocity, "{report:?}");
}

#[test]
fn a_bound_on_the_refinement_is_told_with_what_to_write() {
    let dir = tempdir().unwrap();
    let file = TURNED.write(&dir.path().join("turned.nc"));
    // 2 MiB, half of which a snapshot that is read and a window of two may take.
    let archive = open_with(&[&file], "memory_gib = 0.002");
    let bounded = archive.grid().nodes();
    let all = notes(&archive);
    println!("{bounded} nodes\n{all}");
    assert!(
        bounded < open(&[&file]).grid().nodes() && ((bounded * (60 + 44 + 32)) as f64) < 1.02 * 0.001 * f64::from(1 << 30),
        "{bounded}"
    );
    for piece in
        ["WARNING: interpolation on the grid", "need more than", "--set archive.resolution=[", "archive.level=VALUE", "archive.memory_gib"]
    {
        assert!(all.contains(piece), "`{piece}` is missing in {all}");
    }
    // What is set is kept, with its error.
    let kept = open_with(&[&file], "resolution = [0.4, 0.4]");
    assert_eq!(kept.grid().shape()[0], 57);
    assert!(notes(&kept).contains("the resolution is kept as set") && notes(&kept).contains("(as set)"), "{}", notes(&kept));
    let report = inspected(&[&file]).to_string();
    assert!(report.contains("between them, against interpolation in the mesh"), "{report}");
}
