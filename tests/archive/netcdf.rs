//! NetCDF archives that must be read, and the snapshots that they give.

use crate::kit::grids::{packed_levels, packed_wind};
use crate::kit::netcdf::*;
use crate::{DAYS, HOURS, inspected, notes, open, open_with, refused, settings};
use ridgewatch::field::{EARTH_RADIUS, Geometry};
use ridgewatch::source::{ArchiveSettings, FileOrder, Metric, SnapshotSource, inspect, read_ahead};
use std::path::PathBuf;
use tempfile::tempdir;

/// ARCO-ERA5: pressures without a unit, known by omega. Numbers of a model's levels are none.
#[test]
fn levels_without_a_unit_are_pressures_if_their_numbers_are() {
    let dir = tempdir().unwrap();
    let write = |name: &str, levels: &[f64], long_name: &str| {
        let axes: [(&str, &str, &[f64]); 4] = [
            ("time", HOURS, &[0.0, 6.0]),
            ("level", "", levels),
            ("latitude", "degrees_north", &[41.0, 40.0]),
            ("longitude", "degrees_east", &[10.0, 11.0, 12.0]),
        ];
        let mut fixture = Fixture::on(NETCDF4, &axes);
        fixture.variables.iter_mut().filter(|v| v.name == "level").for_each(|v| v.attributes.push(("long_name".into(), long_name.into())));
        let count = 2 * levels.len() * 6;
        fixture = fixture.fields("m s**-1", [("u", f32s(vec![5.0; count])), ("v", f32s(vec![1.0; count]))]);
        fixture
            .fields("Pa s**-1", [("vertical_velocity", f32s(vec![-0.5; count]))])
            .with("standard_name", "lagrangian_tendency_of_air_pressure")
            .write(&dir.path().join(name))
    };
    let archive = open(&[write("arco.nc", &[300.0, 500.0, 850.0], "")]);
    assert!((archive.grid().axes[2].coordinates()[0] + 7000.0 * 0.85f64.ln()).abs() < 1e-6);
    let numbers: Vec<f64> = (1..=20).map(f64::from).collect();
    for (name, levels, long_name) in [("ml.nc", &numbers[..], ""), ("named.nc", &[10.0, 50.0, 100.0], "model_level_number")] {
        refused(
            &[write(name, levels, long_name)],
            "",
            &["`vertical_velocity`", "does not fit the axis `level`", "--set archive.units.z=hPa"],
        );
    }
}

#[test]
fn every_format_gives_the_same_snapshots() {
    let dir = tempdir().unwrap();
    for (name, options) in [("c.nc", CLASSIC), ("o.nc", OFFSET_64), ("d.nc", DATA_64), ("h.nc", NETCDF4)] {
        let file = plane(options, &[0.0, 1.0, 2.0], HOURS).write(&dir.path().join(name));
        let mut archive = open(&[file]);
        assert_eq!(archive.grid().shape(), [4, 3, 1], "{name}");
        assert_eq!(archive.grid().geometry, Geometry::Cartesian);
        assert_eq!(archive.grid().slab, (0.0, 0.4), "a tenth of the longer edge");
        // 10957 days between 1970 and 2000.
        assert_eq!(archive.times(), [0.0, 3600.0, 7200.0].map(|s| s + 10_957.0 * 86_400.0));
        assert_eq!(archive.date(archive.times()[1]).as_deref(), Some("2000-01-01T01:00:00Z"));
        for t in 0..3 {
            let expected: Vec<f32> = fill(1, 3, 4, |_, y, x| (100 * t + 10 * y + x) as f64).iter().map(|v| *v as f32).collect();
            let snapshot = archive.read(t).unwrap();
            assert_eq!(us(&snapshot), expected, "{name}");
            assert!(snapshot.nodes.iter().all(|n| n[1] == -n[0] && n[2] == 0.0 && n[3] == 0.0), "{name}");
        }
        assert!(archive.read(3).unwrap_err().to_string().contains("there are 3"));
    }
}

#[test]
fn record_dimensions_interleave() {
    let dir = tempdir().unwrap();
    // Odd numbers of 2-byte values, so that records are padded; and a single variable of records, which is not.
    for options in [CLASSIC, DATA_64, NETCDF4] {
        let values: Vec<i16> = (0..4 * 9).collect();
        let fixture = Fixture::new(options, &[("time", 0), ("y", 3), ("x", 3)])
            .axis("x", "m", &[0.0, 1.0, 2.0])
            .axis("y", "m", &[0.0, 1.0, 2.0])
            .axis("time", "s", &[0.0, 1.0, 2.0, 3.0])
            .fields("", ["u", "v"].map(|name| (name, Data::I16(values.clone()))));
        let mut archive = open(&[fixture.write(&dir.path().join("records.nc"))]);
        let last = archive.read(3).unwrap();
        assert_eq!(us(&last), (27..36).map(|v| v as f32).collect::<Vec<_>>());
        assert_eq!(archive.date(1.0), None, "simulation time has no date");
    }
}

#[test]
fn packed_integers_and_fill_values() {
    let dir = tempdir().unwrap();
    let fixture = |name: &str, day: f64, scale: f64| {
        let packed: Vec<i16> = vec![1, 2, 3, -999, 5, -32_768, 7, 8, 200, 10, 11, 12];
        let axes: [(&str, &str, &[f64]); 3] = [("time", DAYS, &[day]), ("y", "km", &[0.0, 1.0, 2.0]), ("x", "km", &[0.0, 1.0, 2.0, 3.0])];
        let mut fixture = Fixture::on(CLASSIC, &axes);
        for component in ["u", "v"] {
            fixture = fixture
                .fields("cm s-1", [(component, Data::I16(packed.clone()))])
                .with("scale_factor", scale)
                .with("add_offset", 50.0)
                .with("_FillValue", -32_768i16)
                .with("missing_value", -999i16)
                .with("valid_max", 100i16);
        }
        fixture.write(&dir.path().join(name))
    };
    // Each file has its own packing.
    let mut archive = open(&[fixture("a.nc", 0.0, 10.0), fixture("b.nc", 1.0, 20.0)]);
    assert_eq!(archive.grid().axes[0].last(), 3000.0, "kilometres become metres");
    for (index, scale) in [(0, 10.0), (1, 20.0)] {
        let snapshot = archive.read(index).unwrap();
        let missing: Vec<usize> = (0..12).filter(|&i| snapshot.nodes[i][3].is_nan()).collect();
        assert_eq!(missing, [3, 5, 8]);
        assert_eq!(snapshot.nodes[3][..3], [0.0; 3]);
        assert_eq!(snapshot.nodes[11][0], ((12.0 * scale + 50.0) * 0.01) as f32);
    }
}

#[test]
fn files_are_ordered_by_time_not_by_name() {
    let dir = tempdir().unwrap();
    // Different units and several times in a file, interleaved with another's.
    plane(CLASSIC, &[3.0, 5.0], DAYS).write(&dir.path().join("a.nc"));
    plane(CLASSIC, &[0.0], HOURS).write(&dir.path().join("c.nc"));
    plane(NETCDF4, &[1.0, 4.0], DAYS).write(&dir.path().join("b.nc"));
    let archives = [open(&[dir.path().join("*.nc")]), open(&[dir.path().to_path_buf()])];
    for mut archive in archives {
        let days: Vec<f64> = archive.times().iter().map(|s| s / 86_400.0 - 10_957.0).collect();
        assert_eq!(days, [0.0, 1.0, 3.0, 4.0, 5.0]);
        for (i, day) in days.iter().enumerate() {
            assert_eq!(archive.read(i).unwrap().nodes[0][0], (100.0 * day) as f32);
        }
        let gaps = archive.gaps();
        assert_eq!(gaps.len(), 1);
        assert_eq!((gaps[0].missing, gaps[0].after), (1, archive.times()[1]));
        let indexed = open_with(&[dir.path().join("*.nc")], "metric = \"index\"");
        assert_eq!(indexed.gaps(), gaps, "in snapshots every interval is one");
        let notes = notes(&archive);
        assert!(notes.contains("between 2000-01-02T00:00:00Z and 2000-01-04T00:00:00Z"), "{notes}");
    }
}

#[test]
fn descending_latitude_and_global_longitude() {
    let dir = tempdir().unwrap();
    let (nx, ny) = (12, 5);
    let longitudes: Vec<f64> = (0..nx).map(|i| i as f64 * 30.0).collect();
    let latitudes = [60.0, 30.0, 0.0, -30.0, -60.0];
    let axes: [(&str, &str, &[f64]); 4] = [
        ("time", "days since 1900-1-1", &[37_255.0]),
        ("depth", "m", &[0.5]),
        ("latitude", "degrees_north", &latitudes),
        ("longitude", "degrees_east", &longitudes),
    ];
    let u = fill(1, ny, nx, |_, y, x| latitudes[y] + longitudes[x] / 1000.0);
    let v = fill(1, ny, nx, |_, y, _| -latitudes[y]);
    let fixture = Fixture::on(CLASSIC, &axes).fields("m/s", [("water_u", f32s(u)), ("water_v", f32s(v))]);
    let file = fixture.write(&dir.path().join("ocean.nc"));
    let mut archive = open(&[&file]);
    let grid = archive.grid().clone();
    assert_eq!(grid.geometry, Geometry::Sphere { radius: EARTH_RADIUS });
    assert_eq!((grid.dimensions(), grid.axes[0].period(), grid.axes[1].first()), (2, Some(360.0), -60.0));
    assert_eq!(archive.date(archive.times()[0]).as_deref(), Some("2002-01-01T00:00:00Z"));
    let snapshot = archive.read(0).unwrap();
    for i in 0..grid.nodes() {
        let (lon, lat) = (grid.axes[0].coordinates()[i % nx], grid.axes[1].coordinates()[i / nx]);
        let [east, north] = east_north(&snapshot, i);
        // Components of size 60 pass through f32 three times.
        assert!((east - lat - lon / 1000.0).abs() < 2e-5 && (north + lat).abs() < 2e-5, "node {i}: {east} {north}");
    }
    // A region over the seam.
    let mut part = open_with(&[file], "region = [-40.0, 40.0, -40.0, 10.0]");
    assert_eq!(part.grid().axes[0].coordinates(), [-30.0, 0.0, 30.0]);
    assert_eq!(part.grid().axes[1].coordinates(), [-30.0, 0.0]);
    let snapshot = part.read(0).unwrap();
    for (i, expected) in [-30.0 + 0.33, -30.0, -30.0 + 0.03, 0.33, 0.0, 0.03].into_iter().enumerate() {
        assert!((east_north(&snapshot, i)[0] - expected).abs() < 2e-5, "node {i}");
    }
}

#[test]
fn dimensions_in_odd_order() {
    let dir = tempdir().unwrap();
    // (x, level, time, y): u = 1000 z + 100 t + 10 y + x.
    let (nx, nz, nt, ny) = (4, 3, 2, 5);
    let values = f32s(fill(nx * nz, nt, ny, |xz, t, y| (1000 * (xz % nz) + 100 * t + 10 * y + xz / nz) as f64));
    let axes: [(&str, &str, &[f64]); 4] = [
        ("west_east", "m", &[0.0, 1.0, 2.0, 3.0]),
        ("lev", "hPa", &[1000.0, 500.0, 100.0]),
        ("time", HOURS, &[0.0, 1.0]),
        ("south_north", "m", &[4.0, 3.0, 2.0, 1.0, 0.0]),
    ];
    for options in [CLASSIC, NETCDF4] {
        let fixture = Fixture::on(options, &axes).fields("m s**-1", ["U", "V"].map(|name| (name, values.clone())));
        let file = fixture.fields("hPa s**-1", [("W", values.clone())]).write(&dir.path().join("odd.nc"));
        let mut archive = open(&[&file]);
        assert_eq!(archive.grid().shape(), [nx, ny, nz]);
        // Pressures become heights.
        let heights = [1000.0f64, 500.0, 100.0].map(|p| 7000.0 * (1000.0 / p).ln());
        for (found, expected) in archive.grid().axes[2].coordinates().iter().zip(heights) {
            assert!((found - expected).abs() < 1e-9, "rounding only");
        }
        let snapshot = archive.read(1).unwrap();
        for (i, node) in snapshot.nodes.iter().enumerate() {
            // y descends in the file; pressures do too, heights do not.
            let (x, y, z) = (i % nx, ny - 1 - i / nx % ny, i / (nx * ny));
            let expected = (1000 * z + 100 + 10 * y + x) as f32;
            let upward = f64::from(expected) * 100.0 * -7000.0 / [1000.0, 500.0, 100.0].map(|p| p * 100.0)[z];
            assert_eq!(node[..2], [expected, expected], "node {i}");
            // Two roundings to f32.
            assert!((f64::from(node[2]) / upward - 1.0).abs() < 2e-7, "node {i}: {} {upward}", node[2]);
        }
        // One level makes it two-dimensional.
        let mut flat = open_with(&[&file], "level = 500.0");
        assert_eq!(flat.grid().dimensions(), 2);
        assert_eq!(flat.read(0).unwrap().nodes[0][..3], [1040.0, 1040.0, 0.0]);
        refused(&[file], "level = 501.0", &["1000, 500, 100 hPa"]);
    }
}

#[test]
fn index_metric_counts_cells_and_snapshots() {
    let dir = tempdir().unwrap();
    let constant = |v: f64| f32s(vec![v; 2 * 16]);
    let axes: [(&str, &str, &[f64]); 3] = [
        ("time", HOURS, &[0.0, 6.0]),
        ("lat", "degrees_north", &[-90.0, -60.0, 0.0, 60.0]),
        ("lon", "degrees_east", &[0.0, 2.0, 4.0, 6.0]),
    ];
    let file = Fixture::on(CLASSIC, &axes).winds(constant(10.0), constant(5.0)).write(&dir.path().join("index.nc"));
    let mut archive = open_with(&[&file], "metric = \"index\"");
    assert_eq!(archive.times(), [0.0, 1.0]);
    assert_eq!(archive.date(0.5).as_deref(), Some("2000-01-01T03:00:00Z"));
    assert_eq!(archive.grid().axes[1].coordinates(), [0.0, 1.0, 2.0, 3.0]);
    let snapshot = archive.read(0).unwrap();
    let degrees = |metres: f64| (metres / EARTH_RADIUS).to_degrees();
    let hours = 6.0 * 3600.0;
    // Width of a column: 2 degrees times cos(lat); at the pole that of the circle half a cell away. Heights: 30, 45, 60, 60 degrees.
    let widths = [75f64, 60.0, 0.0, 60.0].map(|l| 2.0 * l.to_radians().cos());
    for (y, (width, height)) in widths.into_iter().zip([30.0, 45.0, 60.0, 60.0]).enumerate() {
        let node = snapshot.nodes[y * 4 + 1];
        let (u, v) = (degrees(10.0 * hours) / width, degrees(5.0 * hours) / height);
        // One rounding to f32 before the product and one after.
        assert!((f64::from(node[0]) / u - 1.0).abs() < 3e-7 && (f64::from(node[1]) / v - 1.0).abs() < 3e-7, "row {y}: {node:?}");
    }
    let mut cells = open_with(&[file], "velocity_unit = \"cells\"");
    assert_eq!(cells.read(1).unwrap().nodes[7][..2], [10.0, 5.0]);
}

/// Winds on longitude, latitude and a level axis of this unit.
fn levels(unit: &str, values: &[f64]) -> Fixture {
    let nz = values.len();
    let axes: [(&str, &str, &[f64]); 4] = [
        ("time", HOURS, &[0.0, 1.0]),
        ("level", unit, values),
        ("lat", "degrees_north", &[60.0, 0.0, -60.0]),
        ("lon", "degrees_east", &[0.0, 90.0, 180.0, 270.0]),
    ];
    let winds = [
        ("u", "eastward_wind", "m s-1", 1.0),
        ("v", "northward_wind", "m s-1", 1.0),
        ("w", "lagrangian_tendency_of_air_pressure", "Pa s-1", 2.0),
    ];
    winds.into_iter().fold(Fixture::on(NETCDF4, &axes), |fixture, (name, standard, unit, value)| {
        fixture.fields(unit, [(name, Data::F32(vec![value; 2 * nz * 12]))]).with("standard_name", standard)
    })
}

#[test]
fn pressure_levels_on_the_sphere_become_heights() {
    let dir = tempdir().unwrap();
    let height = |hpa: f64| 7000.0 * (1000.0 / hpa).ln();
    // In any order.
    for (name, values) in [("up.nc", [1000.0, 500.0, 100.0]), ("down.nc", [100.0, 500.0, 1000.0])] {
        let file = levels("hPa", &values).write(&dir.path().join(name));
        let mut archive = open(&[&file]);
        assert_eq!((archive.metric(), archive.grid().dimensions()), (Metric::Sphere, 3));
        let grid = archive.grid().clone();
        assert!(matches!(grid.geometry, Geometry::Sphere { .. }));
        for (found, hpa) in grid.axes[2].coordinates().iter().zip([1000.0, 500.0, 100.0]) {
            assert!((found - height(hpa)).abs() < 1e-9, "rounding only");
        }
        // The poles lie a cell beyond the last rows: they become rows.
        assert_eq!(grid.axes[1].coordinates(), [-90.0, -60.0, 0.0, 60.0, 90.0]);
        let snapshot = archive.read(0).unwrap();
        assert_eq!(snapshot.missing_nodes(), 0);
        for (k, hpa) in [1000.0, 500.0, 100.0].into_iter().enumerate() {
            // The mark of a known node is its vertical velocity, m/s.
            let upward = f64::from(snapshot.nodes[k * 20 + 4][3]);
            assert!((upward / (-7000.0 * 2.0 / (hpa * 100.0)) - 1.0).abs() < 1e-6, "{upward}");
        }
        // Eastward 1 and northward 1 all around have no mean at a pole.
        assert!(snapshot.nodes[..4].iter().all(|n| n[..3].iter().all(|v| v.abs() < 1e-6)));
    }
    let file = levels("hPa", &[1000.0, 500.0]).write(&dir.path().join("scaled.nc"));
    let mut archive = open_with(&[&file], "vertical_scale = 100.0");
    assert!((archive.grid().axes[2].last() - 100.0 * height(500.0)).abs() < 1e-6);
    assert!((f64::from(archive.read(0).unwrap().nodes[4][3]) / (-7000.0 * 2.0 / 1e5 * 100.0) - 1.0).abs() < 1e-6);
    assert!(notes(&archive).contains("`vertical_scale`"));
    // One level makes it two-dimensional.
    assert_eq!(open_with(&[file], "level = 500.0").grid().dimensions(), 2);
}

#[test]
fn the_index_metric_of_levels() {
    let dir = tempdir().unwrap();
    let file = levels("hPa", &[100.0, 500.0, 1000.0]).write(&dir.path().join("levels.nc"));
    let mut archive = open_with(&[&file], "metric = \"index\"");
    assert_eq!((archive.grid().axes[0].period(), archive.grid().shape()), (Some(4.0), [4, 3, 3]));
    // 2 Pa/s for an hour, in cells of 400, 450 and 500 hPa.
    let w: Vec<f32> = archive.read(0).unwrap().nodes.iter().step_by(12).map(|n| n[2]).collect();
    assert_eq!(w, [7200.0 / 40_000.0, 7200.0 / 45_000.0, 7200.0 / 50_000.0]);
    assert_eq!(open_with(&[file], "metric = \"index\"\nperiodic = \"none\"").grid().axes[0].period(), None);
    // Levels without a unit have no height.
    let bare = levels("level", &[1.0, 2.0, 3.0]).write(&dir.path().join("bare.nc"));
    assert_eq!(open_with(&[&bare], "w = \"none\"").metric(), Metric::Index);
    refused(&[bare], "w = \"none\"\nmetric = \"sphere\"", &["--set archive.level=VALUE"]);
}

#[test]
fn depth_becomes_height() {
    let dir = tempdir().unwrap();
    let fixture = Fixture::new(CLASSIC, &[("time", 2), ("depth", 3), ("y", 2), ("x", 2)])
        .axis("x", "m", &[0.0, 1.0])
        .axis("y", "m", &[0.0, 1.0])
        .axis("depth", "m", &[0.0, 10.0, 30.0])
        .with("positive", "down")
        .axis("time", "s", &[0.0, 1.0]);
    let values: Vec<f32> = (0..24).map(|i| (i / 4 % 3) as f32).collect();
    let fixture = fixture.fields("m/s", ["uo", "vo", "wo"].map(|name| (name, Data::F32(values.clone()))));
    let mut archive = open(&[fixture.write(&dir.path().join("depth.nc"))]);
    assert_eq!(archive.grid().axes[2].coordinates(), [-30.0, -10.0, 0.0]);
    let w: Vec<f32> = archive.read(0).unwrap().nodes.iter().step_by(4).map(|n| n[2]).collect();
    assert_eq!(w, [2.0, 1.0, 0.0], "upward stays upward");
}

#[test]
fn settings_outweigh_conventions() {
    let dir = tempdir().unwrap();
    let fixture = plane(CLASSIC, &[0.0, 1.0], HOURS)
        .fields("km/h", [("fast", Data::F32(vec![7.0; 24]))])
        .variable("runtime", &["time"], Data::F64(vec![10.0, 20.0]))
        .with("units", "minutes");
    let file = fixture.write(&dir.path().join("named.nc"));
    let mut archive = open_with(&[&file], "u = \"fast\"\ntime = \"runtime\"\nslab = [1.0, 2.0]");
    assert_eq!(archive.times(), [600.0, 1200.0]);
    assert_eq!(archive.grid().slab, (1.0, 2.0));
    assert_eq!(archive.read(0).unwrap().nodes[0][0], (7.0 / 3.6) as f32);
    assert!(archive.describe().variables[0].contains("named by the setting"));
    refused(&[file], "u = \"fats\"", &["`u = \"fats\"`", "is `fast` meant?"]);
}

#[test]
fn settings_are_read_from_toml() {
    let settings = settings("files = \"a/*.nc\"\nmetric = \"index\"\nvelocity_unit = \"cells\"\nregion = [0, 1, 2, 3.5]");
    assert_eq!(settings.files, [PathBuf::from("a/*.nc")]);
    assert_eq!((settings.metric, settings.region), (Some(Metric::Index), Some([0.0, 1.0, 2.0, 3.5])));
    assert!(toml::from_str::<ArchiveSettings>("colour = 1").unwrap_err().to_string().contains("colour"));
}

#[test]
fn read_ahead_delivers_an_archive() {
    let dir = tempdir().unwrap();
    for day in 0..6 {
        plane(CLASSIC, &[f64::from(day)], DAYS).write(&dir.path().join(format!("{}.nc", 9 - day)));
    }
    let archive = open(&[dir.path().join("?.nc")]);
    let reader = read_ahead(Box::new(archive), 1..5, 2);
    let firsts: Vec<f32> = reader.map(|s| s.unwrap().nodes[0][0]).collect();
    assert_eq!(firsts, [100.0, 200.0, 300.0, 400.0]);
}

#[test]
fn inspection_says_what_and_why() {
    let dir = tempdir().unwrap();
    let mut values = fill(4, 3, 4, |_, _, _| 0.5 / 3600.0);
    values[5] = f64::NAN;
    let axes: [(&str, &str, &[f64]); 3] =
        [("time", HOURS, &[0.0, 1.0, 2.0, 3.0]), ("y", "m", &[4.0, 2.0, 0.0]), ("x", "m", &[0.0, 1.0, 2.0, 3.0])];
    let fixture = Fixture::on(CLASSIC, &axes).winds(Data::F64(values), Data::F64(vec![0.0; 48]));
    let file = fixture.fields("K", [("sst", Data::F64(vec![0.0; 48]))]).write(&dir.path().join("inspected.nc"));
    let inspection = inspect(&[file], &settings(""), 1, Some(7200.0)).unwrap();
    let resolution = inspection.resolution.as_ref().unwrap();
    // u crosses half a cell an hour; stored as f32.
    assert!((resolution.rms_cells - 0.5).abs() < 1e-6 && (resolution.max_cells - 0.5).abs() < 1e-6);
    assert_eq!(inspection.missing.as_ref().unwrap().share, 1.0 / 48.0);
    let time = inspection.time.as_ref().unwrap();
    assert_eq!((time.window_snapshots, time.window_bytes), (Some(3), Some(3 * 12 * 16)));
    assert_eq!(inspection.axes[1].in_file.as_ref().unwrap().order, FileOrder::Descending);
    let text = inspection.to_string();
    for piece in [
        "u    u",
        "usual name `u`, unit `m/s`",
        "unit `K` is no velocity",
        "; in the file 4 to 0 m, descending",
        "every 3600 s",
        "missing 2.1 %",
    ] {
        assert!(text.contains(piece), "{piece} is missing in:\n{text}");
    }
    assert!(serde_json::to_string(&inspection).unwrap().contains("\"role\":\"time\""));
    // A file without velocities is shown all the same.
    let lone = Fixture::new(CLASSIC, &[("lat", 3), ("x", 2)]).axis("lat", "degrees_north", &[30.0, 20.0, 10.0]).variable(
        "sst",
        &["lat", "x"],
        Data::F32(vec![0.0; 6]),
    );
    let inspection = inspected(&[lone.write(&dir.path().join("lone.nc"))]);
    assert!(inspection.problem.as_ref().unwrap().contains("no velocity found"));
    assert_eq!((inspection.variables.len(), inspection.axes.len()), (2, 1));
    let line = "y `lat`: 3 nodes from 10 to 30 degrees_north, every 10; in the file 30 to 10 degrees_north, descending";
    assert!(inspection.to_string().contains(line), "{inspection}");
}

#[test]
fn pressure_levels_come_in_any_order() {
    let dir = tempdir().unwrap();
    for (format, name) in [(CLASSIC, "classic"), (NETCDF4, "netcdf4")] {
        for (n, levels) in [[1000.0, 500.0, 850.0, 200.0], [200.0, 500.0, 850.0, 1000.0], [1000.0, 850.0, 500.0, 200.0]].iter().enumerate()
        {
            let files = [0.0, 2.0].map(|hour| packed_levels(format, levels, hour).write(&dir.path().join(format!("{name}_{n}_{hour}.nc"))));
            let mut archive = open(&files);
            let grid = archive.grid().clone();
            let [nx, ny, nz] = grid.shape();
            assert_eq!((nx, ny, nz, archive.times().len()), (4, 5, 4, 4));
            let snapshot = archive.read(2).unwrap();
            for (i, node) in (0..snapshot.nodes.len()).map(|i| (i, east_north(&snapshot, i))) {
                let pressure = 1000.0 * (-grid.axes[2].coordinates()[i / (nx * ny)] / 7000.0).exp();
                let expected = packed_wind(pressure, i % nx, i / nx % ny);
                // Packed in steps of 0.01 m/s; both components are the same.
                assert!(node.iter().all(|v| (v - expected).abs() < 5.01e-3 + 1e-5), "{levels:?}, node {i}: {node:?}, {expected}");
            }
            let inspection = inspected(&files).to_string();
            let order = ["1000 to 200 hPa, unsorted", "200 to 1000 hPa, ascending", "1000 to 200 hPa, descending"][n];
            assert!(inspection.contains(order), "{inspection}");
        }
    }
}

#[test]
fn two_hundred_files_start_at_once() {
    let dir = tempdir().unwrap();
    for (kind, options) in [("classic", OFFSET_64), ("netcdf4", NETCDF4)] {
        let file = |hour| dir.path().join(format!("{kind}_{hour:03}.nc"));
        for hour in 0..200 {
            plane(options, &[f64::from(hour)], HOURS).write(&file(hour));
        }
        let whole = || assert_eq!(open(&[dir.path().join(format!("{kind}_*.nc"))]).times().len(), 200);
        // The library alone, reading the times.
        let times = || {
            for hour in 0..200 {
                let times = netcdf::open(file(hour)).unwrap().variable("time").unwrap().get_values::<f64, _>(..).unwrap();
                assert_eq!(times, [f64::from(hour)]);
            }
        };
        let timed = |work: &dyn Fn()| {
            let begin = std::time::Instant::now();
            work();
            begin.elapsed()
        };
        // The shortest of five tries each: the machine may be busy, and the files are in its cache.
        let took: Vec<[std::time::Duration; 2]> = (0..5).map(|_| [timed(&whole), timed(&times)]).collect();
        let [took, library] = [0, 1].map(|which| took.iter().map(|both| both[which]).min().unwrap());
        println!("200 {kind} files opened in {took:?}, their times alone read in {library:?}");
        assert!(took < 8 * library, "{took:?}, {library:?}");
    }
}

#[test]
fn later_files_have_packing_and_time_units_of_their_own() {
    let dir = tempdir().unwrap();
    let file = |name: &str, units: &str, scale: f64, upside_down: bool| {
        let mut y = [0.0, 2.0, 4.0];
        if upside_down {
            y.reverse();
        }
        let other = |fixture: Fixture, k| fixture.variable(&format!("other{k}"), &["y", "x"], Data::F32(vec![0.0; 12])).with("units", "K");
        (0..5)
            .fold(Fixture::new(NETCDF4, &[("time", 1), ("y", 3), ("x", 4)]), other)
            .axis("x", "m", &[0.0, 1.0, 2.0, 3.0])
            .axis("y", "m", &y)
            .axis("time", units, &[0.0])
            .fields("m/s", [("u", Data::I16((0..12).collect()))])
            .with("scale_factor", scale)
            .with("_FillValue", 3i16)
            .fields("cm/s", [("v", Data::I16((0..12).collect()))])
            .write(&dir.path().join(name))
    };
    let first = file("a.nc", "days since 2000-01-02", 0.5, false);
    let second = file("b.nc", HOURS, 0.25, false);
    let mut archive = open(&[first.clone(), second]);
    assert_eq!(archive.date(archive.times()[0]).as_deref(), Some("2000-01-01T00:00:00Z"), "the second one is the earlier");
    for (index, scale) in [(0, 0.25), (1, 0.5)] {
        let snapshot = archive.read(index).unwrap();
        assert_eq!((snapshot.nodes[4][0], snapshot.nodes[4][1]), (4.0 * scale, 0.04));
        assert!(snapshot.nodes[3][3].is_nan() && snapshot.missing_nodes() == 1);
    }
    let turned = file("c.nc", "days since 2000-01-05", 1.0, true);
    refused(&[first, turned], "", &["c.nc", "do not belong to one archive"]);
}
