//! `ridgewatch ridges`: files of surfaces and lines read back, and refusals.

use crate::kit::flow::{cross, dot};
use crate::kit::program::{config, ridgewatch, run, text};
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::Path;

fn ridges(out: &Path, arguments: &[&str]) -> Value {
    let mut all = vec!["ridges", "--device", "cpu", "--json", "--out", text(out)];
    all.extend(arguments);
    run(&mut ridgewatch(all)).success().json()
}

/// What a file of surfaces holds.
#[derive(Debug, PartialEq)]
struct Mesh {
    points: Vec<[f64; 3]>,
    ftle: Vec<f64>,
    sharpness: Vec<f64>,
    triangles: Vec<[i64; 3]>,
    surfaces: Vec<i64>,
}

fn count(head: &str, before: &str) -> usize {
    let line = head.lines().find_map(|line| line.strip_prefix(before)).unwrap_or_else(|| panic!("no {before:?} in {head}"));
    line.trim().parse().unwrap()
}

fn read_ply(path: &Path) -> (String, Mesh) {
    let bytes = std::fs::read(path).unwrap();
    let end = b"end_header\n";
    let at = bytes.windows(end.len()).position(|window| window == end).unwrap() + end.len();
    let head = String::from_utf8(bytes[..at].to_vec()).unwrap();
    assert!(head.starts_with("ply\nformat binary_little_endian 1.0\n"), "{head}");
    let (vertices, faces) = (count(&head, "element vertex "), count(&head, "element face "));
    let (vertex, face) = (5 * 8, 1 + 4 * 4);
    assert_eq!(bytes.len(), at + vertices * vertex + faces * face);
    let (vertices, faces) = bytes[at..].split_at(vertices * vertex);
    let vertices: Vec<Vec<f64>> =
        vertices.chunks(vertex).map(|row| row.as_chunks::<8>().0.iter().map(|b| f64::from_le_bytes(*b)).collect()).collect();
    let faces: Vec<Vec<i64>> = faces
        .chunks(face)
        .map(|row| {
            assert_eq!(row[0], 3);
            row[1..].as_chunks::<4>().0.iter().map(|b| i64::from(i32::from_le_bytes(*b))).collect()
        })
        .collect();
    let mesh = Mesh {
        points: vertices.iter().map(|v| [v[0], v[1], v[2]]).collect(),
        ftle: vertices.iter().map(|v| v[3]).collect(),
        sharpness: vertices.iter().map(|v| v[4]).collect(),
        triangles: faces.iter().map(|f| [f[0], f[1], f[2]]).collect(),
        surfaces: faces.iter().map(|f| f[3]).collect(),
    };
    (head, mesh)
}

fn read_vtp(path: &Path) -> Mesh {
    let bytes = std::fs::read(path).unwrap();
    let marker = b"<AppendedData encoding=\"raw\">\n_";
    let at = bytes.windows(marker.len()).position(|window| window == marker).unwrap() + marker.len();
    let tail = b"\n</AppendedData>\n</VTKFile>\n";
    assert!(bytes.ends_with(tail));
    let head = String::from_utf8(bytes[..at].to_vec()).unwrap() + "</AppendedData></VTKFile>";
    let document = roxmltree::Document::parse(&head).unwrap();
    let of = |tag: &str, name: &str| {
        let named = |n: &roxmltree::Node| n.has_tag_name("DataArray") && n.attribute("Name") == Some(name);
        let array = document.descendants().find(|n| named(n) && n.parent().unwrap().has_tag_name(tag)).unwrap();
        let from = at + array.attribute("offset").unwrap().parse::<usize>().unwrap();
        let length = u64::from_le_bytes(bytes[from..from + 8].try_into().unwrap()) as usize;
        let values = bytes[from + 8..from + 8 + length].as_chunks::<8>().0;
        (array.attribute("type").unwrap().to_owned(), values)
    };
    let doubles = |tag, name| {
        let (number, values) = of(tag, name);
        assert_eq!(number, "Float64");
        values.iter().map(|b| f64::from_le_bytes(*b)).collect::<Vec<f64>>()
    };
    let integers = |tag, name| {
        let (number, values) = of(tag, name);
        assert_eq!(number, "Int64");
        values.iter().map(|b| i64::from_le_bytes(*b)).collect::<Vec<i64>>()
    };
    let piece = document.descendants().find(|n| n.has_tag_name("Piece")).unwrap();
    let mesh = Mesh {
        points: doubles("Points", "points").as_chunks().0.to_vec(),
        ftle: doubles("PointData", "ftle"),
        sharpness: doubles("PointData", "sharpness"),
        triangles: integers("Polys", "connectivity").as_chunks().0.to_vec(),
        surfaces: integers("CellData", "surface"),
    };
    let counts = ["NumberOfPoints", "NumberOfPolys"].map(|name| piece.attribute(name).unwrap().parse::<usize>().unwrap());
    assert_eq!(counts, [mesh.points.len(), mesh.triangles.len()]);
    assert_eq!(integers("Polys", "offsets"), (1..=counts[1] as i64).map(|n| 3 * n).collect::<Vec<_>>());
    assert_eq!(doubles("FieldData", "integration_time"), [4.0]);
    assert_eq!(doubles("FieldData", "direction"), [-1.0]);
    mesh
}

#[test]
fn surfaces_are_the_same_in_both_formats() {
    let folder = tempfile::tempdir().unwrap();
    let abc = config("abc.toml");
    let arguments = [&abc, "--grid", "40x40x40", "--tau", "4", "--direction", "backward", "--area", "50", "--smoothing", "0"];
    let [vtp, ply] = ["abc.vtp", "abc.ply"].map(|name| folder.path().join(name));
    let record = ridges(&vtp, &arguments);
    ridges(&ply, &arguments);
    let ((head, mesh), same) = (read_ply(&ply), read_vtp(&vtp));
    assert_eq!(mesh, same);
    for fact in
        ["comment attracting ridge surfaces of the backward FTLE", "ABC flow", "comment direction backward", "comment integration_time 4"]
    {
        assert!(head.contains(fact), "{head}");
    }
    assert_eq!(
        (record["points"].as_u64(), record["triangles"].as_u64()),
        (Some(mesh.points.len() as u64), Some(mesh.triangles.len() as u64))
    );
    assert!(mesh.triangles.len() > 1000, "the ABC flow has some: {record}");
    assert!(mesh.points.iter().flatten().all(|c| (0.0..=std::f64::consts::TAU).contains(c)), "inside of the domain");
    assert!(mesh.triangles.iter().flatten().all(|n| (0..mesh.points.len() as i64).contains(n)));
    assert!(mesh.surfaces.is_sorted() && mesh.surfaces.last() == Some(&(record["ridges"].as_i64().unwrap() - 1)));
    assert!(mesh.sharpness.iter().all(|v| *v > 0.0));
    // Without smoothing, filters are percentiles of the field itself.
    let field = folder.path().join("field.nc");
    let traced = [
        "ftle",
        &abc,
        "--device",
        "cpu",
        "--grid",
        "40x40x40",
        "--set",
        "time.tau=4",
        "--set",
        "time.direction=\"backward\"",
        "-o",
        text(&field),
    ];
    run(&mut ridgewatch(traced)).success();
    let mut values = netcdf::open(&field).unwrap().variable("ftle").unwrap().get_values::<f64, _>(..).unwrap();
    values.sort_by(f64::total_cmp);
    let at = |share: f64| values[((values.len() - 1) as f64 * share).round() as usize];
    assert!(mesh.ftle.iter().all(|v| *v > at(0.6) - 1e-6), "three quarters of percentile 80");
    let mut sums: BTreeMap<i64, [f64; 2]> = BTreeMap::new();
    for (triangle, surface) in mesh.triangles.iter().zip(&mesh.surfaces) {
        let [a, b, c] = triangle.map(|n| n as usize);
        let side = |to: usize| std::array::from_fn(|k| mesh.points[to][k] - mesh.points[a][k]);
        let normal = cross(side(b), side(c));
        let area = dot(normal, normal).sqrt() / 2.0;
        let sum = sums.entry(*surface).or_default();
        *sum = [sum[0] + area, sum[1] + area * (mesh.ftle[a] + mesh.ftle[b] + mesh.ftle[c]) / 3.0];
    }
    let square = (std::f64::consts::TAU / 39.0).powi(2);
    assert!(sums.values().all(|[area, sum]| *area > 50.0 * square * (1.0 - 1e-9) && sum / area > at(0.8) - 1e-6), "{sums:?} {}", at(0.8));
}

/// In two dimensions, the lines are those of `map`.
#[test]
fn lines_are_those_of_the_map() {
    let folder = tempfile::tempdir().unwrap();
    let gyre = config("double_gyre.toml");
    let [one, other, picture] = ["one.vtk", "other.vtk", "map.png"].map(|name| folder.path().join(name));
    let record = ridges(&one, &[&gyre, "--grid", "201x101", "--tau", "10"]);
    let map = ["map", &gyre, "--tau", "10", "--ridge-grid", "201x101", "--lines", text(&other), "--out", text(&picture), "--width", "64"];
    run(&mut ridgewatch(map)).success();
    let [one, other] = [one, other].map(|path| std::fs::read_to_string(path).unwrap());
    assert!(record["ridges"].as_u64().unwrap() >= 1 && record["triangles"].is_null(), "{record}");
    assert_eq!(one, other);
}

#[test]
fn what_does_not_fit_is_refused_and_named() {
    let (gyre, abc) = (config("double_gyre.toml"), config("abc.toml"));
    let cases: [(&[&str], &[&str]); 9] = [
        (&[&abc, "-o", "a.geojson"], &["--out a.geojson", ".vtp or .ply"]),
        (&[&gyre, "-o", "a.ply"], &["--out a.ply", ".nc or .vtk"]),
        (&[&abc, "-o", "a.ply", "--grid", "64x64"], &["--grid 64x64", "3 dimensions", "accepted: NXxNYxNZ"]),
        (&[&gyre, "-o", "a.vtk", "--grid", "64x64x8"], &["--grid 64x64x8", "2 dimensions", "accepted: NXxNY"]),
        (&[&abc, "-o", "a.ply", "--grid", "512x512x512"], &["--grid", "2^25 nodes"]),
        (&[&abc, "-o", "a.ply", "--length", "3"], &["--length", "accepted: --area"]),
        (&[&gyre, "-o", "a.vtk", "--area", "3"], &["--area", "accepted: --length"]),
        (&[&abc, "-o", "a.ply", "--sharpness", "101"], &["--sharpness", "0 to 100"]),
        (&[&abc], &["--out"]),
    ];
    for (arguments, parts) in cases {
        let elsewhere = tempfile::tempdir().unwrap();
        let all: Vec<&str> = ["ridges"].into_iter().chain(arguments.iter().copied()).collect();
        run(ridgewatch(all).current_dir(elsewhere.path())).refused(2, parts);
        assert_eq!(std::fs::read_dir(elsewhere.path()).unwrap().count(), 0, "{arguments:?} leaves nothing");
    }
}
