//! Unstructured meshes as models write them: values at nodes and in faces, meshes in files of their own, levels, land, regions.
//! The flow is a rotation of the globe about a tilted axis, which is smooth everywhere, poles included.

use crate::kit::flow::{Vector, cross, direction, dot, unit};
use crate::kit::netcdf::*;
use crate::{HOURS, inspected, notes, open, open_with, refused};
use ridgewatch::field::Snapshot;
use ridgewatch::source::{Archive, SnapshotSource};
use std::path::{Path, PathBuf};
use tempfile::tempdir;

/// Axis of the rotation, in m/s at distance 1.
const OMEGA: Vector = [0.3, -0.5, 0.8];

/// Longitudes and latitudes of points that are spread evenly over the globe, north of `south` degrees.
fn spiral(n: usize, south: f64) -> Vec<[f64; 2]> {
    let golden = std::f64::consts::PI * (3.0 - 5f64.sqrt());
    let height = |k: usize| 1.0 - (2 * k + 1) as f64 / n as f64;
    let place = |k: usize| [(golden * k as f64).to_degrees() % 360.0 - 180.0, height(k).asin().to_degrees()];
    (0..n).map(place).filter(|p| p[1] > south).collect()
}

/// Eastward and northward velocity.
fn rotation(place: [f64; 2]) -> [f64; 2] {
    let p = direction(place[0], place[1]);
    let flow = cross(OMEGA, p);
    let east = unit(cross([0.0, 0.0, 1.0], p));
    [dot(flow, east), dot(flow, cross(p, east))]
}

/// Largest error of the known nodes, as vectors, and their share.
fn error(snapshot: &Snapshot, factor: impl Fn(f64) -> f64) -> (f64, f64) {
    let grid = &snapshot.grid;
    let [nx, ny, _] = grid.shape();
    let (mut worst, mut known) = (0.0f64, 0);
    for (i, node) in snapshot.nodes.iter().enumerate().filter(|(_, n)| !n[3].is_nan()) {
        let p = direction(grid.axes[0].coordinates()[i % nx], grid.axes[1].coordinates()[i / nx % ny]);
        let scale = factor(grid.axes.get(2).map_or(0.0, |z| z.coordinates()[i / (nx * ny)]));
        let exact = cross(OMEGA, p).map(|v| v * scale);
        worst = (0..3).map(|k| (f64::from(node[k]) - exact[k]).abs()).fold(worst, f64::max);
        known += 1;
    }
    (worst, known as f64 / snapshot.nodes.len() as f64)
}

fn known_at(snapshot: &Snapshot, place: [f64; 2]) -> bool {
    let axes = &snapshot.grid.axes;
    let nearest = |k: usize| {
        let distance = |v: f64| if k == 0 { ((v - place[0] + 540.0).rem_euclid(360.0) - 180.0).abs() } else { (v - place[1]).abs() };
        let all = axes[k].coordinates();
        (0..all.len()).min_by(|&a, &b| distance(all[a]).total_cmp(&distance(all[b]))).unwrap()
    };
    !snapshot.nodes[nearest(1) * axes[0].len() + nearest(0)][3].is_nan()
}

/// A file with the longitudes and latitudes of points, named so.
fn coordinates(fixture: Fixture, dimension: &str, names: [&str; 2], places: &[[f64; 2]], radians: bool) -> Fixture {
    (0..2).fold(fixture, |fixture, k| {
        let values = places.iter().map(|p| if radians { p[k].to_radians() } else { p[k] }).collect();
        let units = if radians { "radian" } else { ["degrees_east", "degrees_north"][k] };
        fixture.variable(names[k], &[dimension], Data::F64(values)).with("units", units)
    })
}

/// The file with `u` and `v` of the rotation at points, at two times from `hour` on; on levels if `depths` are given, which are the last dimension.
fn velocities(fixture: Fixture, dimension: &str, places: &[[f64; 2]], depths: &[f64]) -> Fixture {
    let (n, levels) = (places.len(), depths.len().max(1));
    (0..2).fold(fixture, |fixture, c| {
        let factor = |level: usize| depths.get(level).map_or(1.0, |depth| 1.0 - depth / 1000.0);
        let values = (0..2 * n * levels).map(|i| rotation(places[i / levels % n])[c] * factor(i % levels)).collect();
        let on: &[&str] = if depths.is_empty() { &["time", dimension] } else { &["time", dimension, "nz1"] };
        fixture.variable(["u", "v"][c], on, f32s(values)).with("units", "m/s")
    })
}

fn written(dir: &Path, name: &str, fixture: Fixture) -> PathBuf {
    fixture.write(&dir.join(name))
}

fn times(dimensions: &[(&str, usize)]) -> Fixture {
    let dimensions: Vec<(&str, usize)> = [("time", 2)].into_iter().chain(dimensions.iter().copied()).collect();
    Fixture::new(NETCDF4, &dimensions).axis("time", HOURS, &[0.0, 6.0])
}

#[test]
fn a_globe_of_points_without_faces() {
    let dir = tempdir().unwrap();
    let places = spiral(5000, -90.0);
    let fixture = velocities(coordinates(times(&[("ncells", 5000)]), "ncells", ["clon", "clat"], &places, true), "ncells", &places, &[]);
    let mut archive = open(&[written(dir.path(), "icon.nc", fixture)]);
    assert_eq!(archive.grid().axes[0].period(), Some(360.0));
    let (worst, known) = error(&archive.read(1).unwrap(), |_| 1.0);
    println!("5000 points: {worst:.1e} m/s, {known:.3} known");
    // Half of the square of the radius around a triangle, 0.034 with sides of 2.9 degrees.
    assert!(worst < 6e-4 && known == 1.0, "{worst:e} {known}");
    let all = notes(&archive);
    for piece in
        ["no faces are known between the points of `clon` and `clat`", "a mesh without rows: resampled from 5000 points, linearly in 9996"]
    {
        assert!(all.contains(piece), "`{piece}` is missing in {all}");
    }
}

/// A basin of quadrangles, 40 x 30 degrees across the date line, with an island of 8 x 6 degrees in its middle: nodes, and their numbers at the corners.
fn basin() -> (Vec<[f64; 2]>, Vec<[usize; 4]>) {
    let (nx, ny) = (41, 31);
    let nodes = (0..nx * ny).map(|n| [160.0 + (n % nx) as f64, -15.0 + (n / nx) as f64]).collect();
    let water = |&(i, j): &(usize, usize)| !(16..24).contains(&i) || !(12..18).contains(&j);
    let cells = (0..ny - 1).flat_map(|j| (0..nx - 1).map(move |i| (i, j))).filter(water);
    (nodes, cells.map(|(i, j)| j * nx + i).map(|n| [n, n + 1, n + nx + 1, n + nx]).collect())
}

fn middle(nodes: &[[f64; 2]], face: &[usize; 4]) -> [f64; 2] {
    [0, 1].map(|k| face.iter().map(|&n| nodes[n][k]).sum::<f64>() / 4.0)
}

/// Corners of triangles, corner after corner, counted from 1.
fn triangles(faces: &[[usize; 4]]) -> Vec<f64> {
    let all: Vec<[usize; 3]> = faces.iter().flat_map(|f| [[f[0], f[1], f[2]], [f[0], f[2], f[3]]]).collect();
    (0..3).flat_map(|k| all.iter().map(move |t| (t[k] + 1) as f64)).collect()
}

fn triangle_middles(nodes: &[[f64; 2]], corners: &[f64]) -> Vec<[f64; 2]> {
    let count = corners.len() / 3;
    (0..count).map(|t| [0, 1].map(|k| (0..3).map(|c| nodes[corners[c * count + t] as usize - 1][k]).sum::<f64>() / 3.0)).collect()
}

fn check_basin(name: &str, archive: &mut Archive, wanted: f64) {
    let snapshot = archive.read(0).unwrap();
    let (worst, known) = error(&snapshot, |depth| 1.0 + depth / 1000.0);
    println!("{name}: {worst:.1e} m/s, {known:.3} known\n{}", notes(archive));
    assert!(worst < wanted, "{name}: {worst:e}");
    let axis = &archive.grid().axes[0];
    assert!(axis.first() <= 160.6 && axis.last() >= 199.4 && axis.period().is_none(), "{axis:?}");
    // The island, its coast from both sides, and the water around it.
    for (place, water) in
        [([180.0, 0.0], false), ([177.2, 2.2], false), ([174.8, 0.0], true), ([180.0, 4.8], true), ([-175.0, -10.0], true)]
    {
        assert_eq!(known_at(&snapshot, place), water, "{name}: {place:?}");
    }
}

#[test]
fn nodes_and_faces_of_a_basin_with_an_island() {
    let dir = tempdir().unwrap();
    let (nodes, faces) = basin();
    let middles: Vec<[f64; 2]> = faces.iter().map(|face| middle(&nodes, face)).collect();
    let ugrid = || {
        let corners = faces.iter().flatten().map(|&n| n as f64).collect();
        let fixture = times(&[("node", nodes.len()), ("face", faces.len()), ("four", 4)]);
        let fixture = fixture.variable("corners", &["face", "four"], Data::F64(corners)).with("cf_role", "face_node_connectivity");
        coordinates(fixture.with("start_index", 0), "node", ["mesh_lon", "mesh_lat"], &nodes, false)
    };
    // An eighth of the square of a degree at the most in linear triangles whose sides are 1.4; and of the last half cell that faces have no middle in.
    let file = written(dir.path(), "nodes.nc", velocities(ugrid(), "node", &nodes, &[]));
    check_basin("UGRID, nodes", &mut open(&[&file]), 1e-4);
    let own = coordinates(ugrid(), "face", ["face_lon", "face_lat"], &middles, false);
    let file = written(dir.path(), "faces.nc", velocities(own, "face", &middles, &[]));
    check_basin("UGRID, faces", &mut open(&[&file]), 2e-2);
    let file = written(dir.path(), "middles.nc", velocities(ugrid(), "face", &middles, &[]));
    check_basin("UGRID, faces without coordinates", &mut open(&[&file]), 2e-2);
    // FVCOM: triangles by their usual name.
    let corners = triangles(&faces);
    let cells = triangle_middles(&nodes, &corners);
    let fixture = times(&[("node", nodes.len()), ("nele", cells.len()), ("three", 3)]);
    let fixture = fixture.variable("nv", &["three", "nele"], Data::F64(corners.clone()));
    let fixture = coordinates(fixture, "node", ["lon", "lat"], &nodes, false);
    let fixture = coordinates(fixture, "nele", ["lonc", "latc"], &cells, false);
    let file = written(dir.path(), "fvcom.nc", velocities(fixture, "nele", &cells, &[]));
    check_basin("FVCOM", &mut open(&[&file]), 2e-2);
}

/// Faces in any order: the triangles do not depend on which middle comes first.
#[test]
fn faces_in_any_order() {
    let dir = tempdir().unwrap();
    let (nodes, mut faces) = basin();
    for round in 0..4 {
        // Steps that share no factor with the number of faces take each once.
        let count = faces.len();
        let step = [131, 377, 601, 997][round];
        faces = (0..count).map(|k| faces[(k * step + 17 * round) % count]).collect();
        let middles: Vec<[f64; 2]> = faces.iter().map(|face| middle(&nodes, face)).collect();
        // Counted from 1, filled up by 0: one triangle has no fourth corner; the last node is in use.
        let corners = faces
            .iter()
            .enumerate()
            .flat_map(|(f, face)| (0..5).map(move |k| if k == 4 || (k == 3 && f == 7) { 0.0 } else { (face[k] + 1) as f64 }));
        let fixture =
            times(&[("node", nodes.len()), ("face", count), ("five", 5)]).variable("nv", &["face", "five"], Data::F64(corners.collect()));
        let fixture = if round % 2 == 0 { fixture.with("start_index", 1) } else { fixture };
        let fixture = coordinates(fixture, "node", ["lon", "lat"], &nodes, false);
        let file = written(dir.path(), &format!("{round}.nc"), velocities(fixture, "face", &middles, &[]));
        let snapshot = open(&[&file]).read(0).unwrap();
        let (worst, known) = error(&snapshot, |_| 1.0);
        println!("order {round}: {worst:.1e} m/s, {known:.3} known");
        assert!(worst < 2e-2 && known > 0.94, "{round}: {worst:e} {known}");
    }
}

/// ICON: cells by their own coordinates, the grid in a file whose dimensions have other names. MPAS: radians, units with braces, levels last. FVCOM and
/// others: velocities at the sides of faces are not read.
#[test]
fn names_and_orders_of_models() {
    let dir = tempdir().unwrap();
    let (nodes, faces) = basin();
    let corners = triangles(&faces);
    let count = corners.len() / 3;
    let middles = triangle_middles(&nodes, &corners);
    let icon = coordinates(times(&[("ncells", count)]), "ncells", ["clon", "clat"], &middles, true);
    let icon = written(dir.path(), "icon.nc", velocities(icon, "ncells", &middles, &[]));
    let grid = Fixture::new(NETCDF4, &[("cell", count), ("vertex", nodes.len()), ("nv", 3)]).variable(
        "vertex_of_cell",
        &["nv", "cell"],
        Data::F64(corners.clone()),
    );
    let grid = coordinates(
        coordinates(grid, "vertex", ["vlon", "vlat"], &nodes, true),
        "cell",
        ["lon_cell_centre", "lat_cell_centre"],
        &middles,
        true,
    );
    let mut grid = grid;
    for variable in &mut grid.variables {
        let name = match &variable.name[..] {
            "vlon" | "lon_cell_centre" => "longitude",
            "vlat" | "lat_cell_centre" => "latitude",
            _ => continue,
        };
        variable.attributes.push(("standard_name".into(), name.into()));
    }
    let grid = written(dir.path(), "icon_grid.nc", grid);
    check_basin("ICON with its grid", &mut open(&[icon, grid]), 2e-2);

    let mpas = Fixture::new(NETCDF4, &[("Time", 2), ("nCells", count), ("nVertLevels", 3)]).axis("Time", HOURS, &[0.0, 6.0]);
    let mut mpas = coordinates(mpas, "nCells", ["lonCell", "latCell"], &middles, true);
    for variable in mpas.variables.iter_mut().filter(|v| v.name.ends_with("Cell")) {
        variable.attributes = vec![("units".into(), "rad".into())];
    }
    for (c, name) in ["uReconstructZonal", "uReconstructMeridional"].into_iter().enumerate() {
        let values = (0..2 * count * 3).map(|i| rotation(middles[i / 3 % count])[c] * (1.0 - 0.1 * (i % 3) as f64)).collect();
        mpas = mpas.variable(name, &["Time", "nCells", "nVertLevels"], f32s(values)).with("units", "m s^{-1}");
    }
    let mut archive = open_with(&[written(dir.path(), "mpas.nc", mpas)], "select = { nVertLevels = 1 }");
    let (worst, _) = error(&archive.read(1).unwrap(), |_| 0.9);
    assert!(worst < 2e-2, "{worst:e}");

    // Times, levels, faces; a vertical velocity at the nodes of the same mesh.
    let depths = [5.0, 50.0];
    let fixture =
        times(&[("nz1", 2), ("elem", count), ("nod2", nodes.len()), ("n3", 3)]).axis("nz1", "m", &depths).with("positive", "down");
    let fixture = fixture.variable("elements", &["n3", "elem"], Data::F64(corners.clone()));
    let mut fixture = coordinates(fixture, "nod2", ["lon", "lat"], &nodes, false);
    for (c, name) in ["u", "v"].into_iter().enumerate() {
        let values = (0..2 * 2 * count).map(|i| rotation(middles[i % count])[c] * (1.0 - depths[i / count % 2] / 1000.0)).collect();
        fixture = fixture.variable(name, &["time", "nz1", "elem"], f32s(values)).with("units", "m/s");
    }
    let rising = (0..2 * 2 * nodes.len()).map(|i| 1e-3 * (nodes[i % nodes.len()][1])).collect();
    let file = written(dir.path(), "w.nc", fixture.variable("w", &["time", "nz1", "nod2"], f32s(rising)).with("units", "m/s"));
    let mut archive = open_with(&[&file], "x = \"lon\"\ny = \"lat\"");
    let snapshot = archive.read(0).unwrap();
    let (worst, _) = error(&snapshot, |depth| 1.0 + depth / 1000.0);
    assert!(worst < 2e-2, "{worst:e}");
    let [nx, ny, _] = snapshot.grid.shape();
    for (n, node) in snapshot.nodes.iter().enumerate().filter(|(_, node)| !node[3].is_nan()) {
        let exact = 1e-3 * snapshot.grid.axes[1].coordinates()[n / nx % ny];
        assert!((f64::from(node[3]) - exact).abs() < 1e-5, "{} {exact}", node[3]);
    }

    // SCHISM: coordinates whose names say nothing, which are named.
    let fixture = times(&[("nSCHISM_hgrid_face", faces.len()), ("node", nodes.len()), ("four", 4)]);
    let all = faces.iter().flatten().map(|&n| (n + 1) as f64).collect();
    let fixture = fixture.variable("SCHISM_hgrid_face_nodes", &["nSCHISM_hgrid_face", "four"], Data::F64(all)).with("start_index", 1);
    let mut fixture = coordinates(fixture, "node", ["SCHISM_hgrid_node_x", "SCHISM_hgrid_node_y"], &nodes, false);
    fixture.variables.iter_mut().filter(|v| v.name.contains("_node_")).for_each(|v| v.attributes.clear());
    for (c, name) in ["horizontalVelX", "horizontalVelY"].into_iter().enumerate() {
        let values = (0..2 * nodes.len()).map(|i| rotation(nodes[i % nodes.len()])[c]).collect();
        fixture = fixture.variable(name, &["time", "node"], f32s(values)).with("units", "m/s");
    }
    let named = "x = \"SCHISM_hgrid_node_x\"\ny = \"SCHISM_hgrid_node_y\"";
    check_basin("SCHISM", &mut open_with(&[written(dir.path(), "schism.nc", fixture)], named), 1e-4);

    let mut sides = velocities(coordinates(times(&[("edge", count)]), "edge", ["lon", "lat"], &middles, false), "edge", &middles, &[]);
    sides.variables.iter_mut().filter(|v| v.name == "u").for_each(|v| v.attributes.push(("location".into(), "edge".into())));
    refused(&[written(dir.path(), "edges.nc", sides)], "", &["sides of faces"]);
    let track = velocities(coordinates(times(&[("station", count)]), "station", ["lon", "lat"], &middles, false), "station", &middles, &[]);
    refused(&[written(dir.path(), "track.nc", track.attribute("featureType", "timeSeries"))], "", &["no dimension would be y"]);
}

#[test]
fn a_region_of_a_globe_of_points() {
    let dir = tempdir().unwrap();
    let places = spiral(5000, -90.0);
    let fixture = velocities(coordinates(times(&[("n", 5000)]), "n", ["lon", "lat"], &places, false), "n", &places, &[]);
    let file = written(dir.path(), "globe.nc", fixture);
    for (region, ends) in [("[-20, 30, 60, 90]", [-20.0, 30.0]), ("[170, -170, -10, 10]", [170.0, 190.0])] {
        let mut part = open_with(&[&file], &format!("region = {region}"));
        let axis = part.grid().axes[0].clone();
        assert!(
            axis.period().is_none() && (axis.first() - ends[0]).abs() < 1e-9 && (axis.last() - ends[1]).abs() < 1e-9,
            "{region}: {axis:?}"
        );
        let (worst, known) = error(&part.read(0).unwrap(), |_| 1.0);
        assert!(worst < 6e-4 && known == 1.0, "{region}: {worst:e} {known}");
    }
}

/// As FESOM writes: one file for each component, the mesh in another, values in triangles on levels.
#[test]
fn components_and_mesh_in_files_of_their_own() {
    let dir = tempdir().unwrap();
    let (nodes, faces) = basin();
    let corners = triangles(&faces);
    let count = corners.len() / 3;
    let middles = triangle_middles(&nodes, &corners);
    let mesh = Fixture::new(NETCDF4, &[("nod2", nodes.len()), ("elem", count), ("n3", 3)])
        .variable("elements", &["n3", "elem"], Data::F64(corners))
        .with("long_name", "nodes of elements");
    let mesh = written(dir.path(), "mesh.diag.nc", coordinates(mesh, "nod2", ["lon", "lat"], &nodes, false));
    let file = |c: usize, hour: f64| {
        let fixture = Fixture::new(NETCDF4, &[("time", 2), ("elem", count), ("nz1", 3)]).axis("time", HOURS, &[hour, hour + 1.0]);
        let mut fixture =
            velocities(fixture.axis("nz1", "m", &[5.0, 50.0, 200.0]).with("positive", "down"), "elem", &middles, &[5.0, 50.0, 200.0]);
        let other = ["v", "u"][c];
        fixture.variables.retain(|variable| variable.name != other);
        written(dir.path(), &format!("{}.{hour}.nc", ["u", "v"][c]), fixture)
    };
    let mut files: Vec<PathBuf> = [0.0, 2.0].into_iter().flat_map(|hour| [file(0, hour), file(1, hour)]).collect();
    files.push(mesh.clone());
    let mut archive = open(&files);
    assert_eq!((archive.times().len(), archive.grid().axes[2].coordinates()), (4, &[-200.0, -50.0, -5.0][..]));
    check_basin("FESOM", &mut archive, 2e-2);
    let (worst, _) = error(&archive.read(3).unwrap(), |depth| 1.0 + depth / 1000.0);
    assert!(worst < 2e-2, "{worst:e}");
    // One level, part of the basin, across the date line.
    let mut part = open_with(&files, "level = 50\nregion = [170, -175, -12, -4]");
    let grid = part.grid().clone();
    assert!(grid.axes.len() == 2 || grid.axes[2].len() == 1, "{:?}", grid.shape());
    assert_eq!(
        [grid.axes[0].first(), grid.axes[0].last(), grid.axes[1].first(), grid.axes[1].last()].map(f64::round),
        [170.0, 185.0, -12.0, -4.0]
    );
    // The flow is slower at depth.
    let (worst, known) = error(&part.read(0).unwrap(), |_| 0.95);
    assert!(worst < 1e-3 && known == 1.0, "{worst} {known}");
    // ICON: the output names its points otherwise than the file of the mesh, which alone has their places.
    let corners = triangles(&faces);
    let middles = triangle_middles(&nodes, &corners);
    let icon = velocities(times(&[("ncells", middles.len())]), "ncells", &middles, &[]).write(&dir.path().join("output.nc"));
    let grid = Fixture::new(NETCDF4, &[("cell", middles.len()), ("vertex", nodes.len()), ("nv", 3)]);
    let grid = coordinates(grid, "vertex", ["vlon", "vlat"], &nodes, true).variable("vertex_of_cell", &["nv", "cell"], Data::F64(corners));
    let grid = coordinates(grid, "cell", ["clon", "clat"], &middles, true).write(&dir.path().join("grid.nc"));
    check_basin("ICON", &mut open(&[icon, grid]), 2e-2);
    // SCHISM: the topology alone says what the coordinates are.
    let schism = velocities(times(&[("node", nodes.len()), ("topology", 1)]), "node", &nodes, &[]);
    let mut schism = coordinates(schism, "node", ["SCHISM_hgrid_node_x", "SCHISM_hgrid_node_y"], &nodes, false);
    schism.variables.iter_mut().filter(|v| v.name.starts_with("SCHISM")).for_each(|v| v.attributes.clear());
    let schism = schism.variable("SCHISM_hgrid", &["topology"], Data::F64(vec![0.0])).with("cf_role", "mesh_topology");
    let schism = schism.with("node_coordinates", "SCHISM_hgrid_node_x SCHISM_hgrid_node_y").write(&dir.path().join("schism.nc"));
    let (worst, _) = error(&open(&[schism]).read(0).unwrap(), |_| 1.0);
    assert!(worst < 1e-3, "{worst}");
    // Without the mesh nothing says where the values lie.
    refused(&files[..2], "level = 50", &["unstructured mesh, name the file of their longitudes and latitudes too"]);
}

#[test]
fn values_of_zero_and_masks_are_land() {
    let dir = tempdir().unwrap();
    let places = spiral(3000, 20.0);
    let dry = |p: &[f64; 2]| (p[0] - 40.0).abs() < 20.0 && (p[1] - 45.0).abs() < 12.0;
    let fixture = coordinates(times(&[("ncol", places.len())]), "ncol", ["lon", "lat"], &places, false);
    let mut fixture = velocities(fixture, "ncol", &places, &[]);
    for variable in fixture.variables.iter_mut().filter(|v| ["u", "v"].contains(&v.name.as_str())) {
        let Data::F32(values) = &mut variable.data else { panic!("numbers") };
        values.iter_mut().enumerate().filter(|(i, _)| dry(&places[i % places.len()])).for_each(|(_, v)| *v = 0.0);
    }
    let land = places.iter().map(|p| f64::from(u8::from(!dry(p)))).collect();
    let file = written(dir.path(), "zeros.nc", fixture.variable("wet_points", &["ncol"], Data::F64(land)));
    let mut archive = open(&[&file]);
    assert!(notes(&archive).contains("the velocity is exactly 0 at") && notes(&archive).contains("% of the points"), "{}", notes(&archive));
    assert!(known_at(&archive.read(0).unwrap(), [40.0, 45.0]));
    for mask in ["zero", "wet_points"] {
        let masked = open_with(&[&file], &format!("mask = \"{mask}\"")).read(0).unwrap();
        assert!(!known_at(&masked, [40.0, 45.0]) && known_at(&masked, [90.0, 45.0]), "{mask}");
    }
}

#[test]
fn what_is_no_mesh_in_degrees_is_refused_with_the_reason() {
    let dir = tempdir().unwrap();
    let places = spiral(400, 0.0);
    let n = places.len();
    let plain = || coordinates(times(&[("n", n)]), "n", ["lon", "lat"], &places, false);
    let file = |name: &str, fixture: Fixture| written(dir.path(), name, velocities(fixture, "n", &places, &[]));
    let whole = file("whole.nc", plain());
    refused(&[&whole], "grid_relative = true", &["grid_relative", "without rows"]);
    refused(&[&whole], "metric = \"cartesian\"", &["metric", "sphere", "unstructured mesh"]);
    refused(&[&whole], "region = [0, 20, -60, -40]", &["lies beside it", "degrees north"]);
    let metres = times(&[("n", n)]).variable("x", &["n"], Data::F64(vec![1.0; n])).with("units", "m").with("standard_name", "longitude");
    let metres = metres.variable("y", &["n"], Data::F64(vec![1.0; n])).with("units", "m").with("standard_name", "latitude");
    refused(&[file("metres.nc", metres)], "", &["degrees or radians"]);
    let far: Vec<[f64; 2]> = places.iter().map(|p| [p[0], p[1] + 30.0]).collect();
    refused(&[file("far.nc", coordinates(times(&[("n", n)]), "n", ["lon", "lat"], &far, false))], "", &["a latitude is", "-90 to 90"]);
    let line: Vec<[f64; 2]> = places.iter().map(|p| [p[0], 10.0]).collect();
    refused(&[file("line.nc", coordinates(times(&[("n", n)]), "n", ["lon", "lat"], &line, false))], "", &["make no cell"]);
    // A later file on another mesh of as many points.
    let moved: Vec<[f64; 2]> = places.iter().enumerate().map(|(k, p)| [p[0] + f64::from(u8::from(k == 7)), p[1]]).collect();
    let mut later = coordinates(times(&[("n", n)]), "n", ["lon", "lat"], &moved, false);
    later.variables[0].data = Data::F64(vec![12.0, 18.0]);
    refused(&[whole, file("later.nc", later)], "", &["entry 7", "one mesh"]);
    let report = inspected(&[file("named.nc", plain())]).to_string();
    assert!(report.contains("a mesh without rows"), "{report}");
}
