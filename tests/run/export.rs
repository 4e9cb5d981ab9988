//! `ridgewatch ftle --out`: what other programs read in its files.

use crate::kit::netcdf::{Fixture, NETCDF4, f32s, fill};
use crate::kit::program::{config, set};
use crate::{in_folder, run};
use netcdf::AttributeValue;
use std::path::Path;

/// Value that the library takes as missing, NC_FILL_DOUBLE.
const FILL: f64 = 9.969_209_968_386_869e36;

fn ftle(folder: &Path, arguments: &[&str]) {
    run(&mut in_folder(folder, &[&["ftle"][..], arguments].concat())).success();
}

fn text(attribute: Option<netcdf::Attribute>) -> String {
    match attribute.unwrap().value().unwrap() {
        AttributeValue::Str(text) => text,
        other => panic!("{other:?}"),
    }
}

fn doubles(file: &netcdf::File, name: &str) -> Vec<f64> {
    file.variable(name).unwrap_or_else(|| panic!("no `{name}`")).get_values(..).unwrap()
}

#[test]
fn several_slides_lie_along_time_with_their_windows_and_errors() {
    let folder = tempfile::tempdir().unwrap();
    let gyre = config("double_gyre.toml");
    let keys = set(&["time.slides=4", "time.start=1.0", "time.seed_step=0.5", "time.tau=5"]);
    let common = [&[gyre.as_str(), "--grid", "21x11", "--check"][..], &keys].concat();
    ftle(folder.path(), &[&common[..], &["--slides", "1..3", "-o", "series.nc"]].concat());
    ftle(folder.path(), &[&common[..], &["--slide", "2", "-o", "one.nc", "--set", "time.direction=backward"]].concat());
    ftle(folder.path(), &[&common[..], &["--slide", "2", "-o", "same.nc"]].concat());
    let [series, one, same] = ["series.nc", "one.nc", "same.nc"].map(|name| netcdf::open(folder.path().join(name)).unwrap());

    assert_eq!(text(series.attribute("Conventions")), "CF-1.8");
    assert!(series.dimension("time").unwrap().is_unlimited());
    assert_eq!(doubles(&series, "time"), [1.5, 2.0, 2.5]);
    assert_eq!(doubles(&series, "time_bounds"), [1.5, 6.5, 2.0, 7.0, 2.5, 7.5]);
    assert_eq!(doubles(&one, "time_bounds"), [-3.0, 2.0], "backward, the window ends at the seed time");
    let long_name = |file: &netcdf::File| text(file.variable("ftle").unwrap().attribute("long_name"));
    assert_eq!(
        (long_name(&series).as_str(), long_name(&one).as_str()),
        ("forward finite-time Lyapunov exponent", "backward finite-time Lyapunov exponent")
    );

    // A slide of the series is the slide by itself.
    let seeds = 21 * 11;
    let (fields, alone) = (doubles(&series, "ftle"), doubles(&same, "ftle"));
    assert_eq!((fields.len(), &fields[seeds..2 * seeds]), (3 * seeds, &alone[..]));
    assert!(fields[..seeds] != fields[seeds..2 * seeds]);
    let errors = doubles(&series, "ftle_error");
    let worst = errors.iter().copied().fold(0.0, f64::max);
    assert!(worst > 0.0 && worst < 0.1, "{worst}");
    assert_eq!(doubles(&series, "x").iter().copied().fold(0.0, f64::max), 2.0);
    assert!(doubles(&series, "status").iter().all(|&status| status == 0.0), "nothing leaves an unbounded flow");
    assert!(doubles(&series, "lifetime").iter().all(|&lifetime| lifetime == 5.0));
    assert!(std::fs::read_dir(folder.path()).unwrap().count() == 3, "no temporary file is left");
}

/// Three days on a projected grid of 13 x 9 nodes with three pressures, land in a corner, and longitudes and latitudes of both dimensions.
fn projected(path: &Path) {
    let (nt, nz, ny, nx) = (3, 3, 9, 13);
    let metres = |n: usize| (0..n).map(|i| 5e5 + 1e4 * i as f64).collect::<Vec<_>>();
    let axes: [(&str, &str, &[f64]); 4] = [
        ("time", "hours since 2001-02-28", &[0.0, 24.0, 48.0]),
        ("plev", "hPa", &[1000.0, 500.0, 250.0]),
        ("y", "m", &metres(ny)),
        ("x", "m", &metres(nx)),
    ];
    let values = |amplitude: f64| {
        let plane = move |y: usize, x: usize| if x < 3 && y < 3 { f64::NAN } else { amplitude * (0.5 * x as f64 + 0.8 * y as f64).sin() };
        f32s((0..nt * nz).flat_map(|_| fill(1, ny, nx, |_, y, x| plane(y, x))).collect())
    };
    let place = |f: fn(f64, f64) -> f64| f32s(fill(1, ny, nx, |_, y, x| f(x as f64, y as f64)));
    let mapped = |file: Fixture| file.with("units", "m s-1").with("grid_mapping", "proj");
    let dimensions = ["time", "plev", "y", "x"];
    let mut file = Fixture::on(NETCDF4, &axes)
        .variable("lon", &["y", "x"], place(|x, y| 10.0 + 0.1 * x + 0.01 * y))
        .with("units", "degrees_east")
        .variable("lat", &["y", "x"], place(|x, y| 45.0 + 0.02 * x + 0.1 * y))
        .with("units", "degrees_north")
        .variable("proj", &[], f32s(vec![0.0]))
        .with("grid_mapping_name", "lambert_conformal_conic")
        .with("standard_parallel", 46.5)
        .with("longitude_of_central_meridian", 11.0);
    file = mapped(file.variable("u", &dimensions, values(0.3)));
    file = mapped(file.variable("v", &dimensions, values(0.2)));
    let time = file.variables.iter_mut().find(|v| v.name == "time").unwrap();
    time.attributes.push(("calendar".into(), "noleap".into()));
    file.write(path);
}

#[test]
fn a_field_has_the_coordinates_of_its_archive() {
    let folder = tempfile::tempdir().unwrap();
    projected(&folder.path().join("winds.nc"));
    ftle(folder.path(), &["winds.nc", "--grid", "25x17x3", "--set", "time.tau=1 day", "--slides", "all", "-o", "field.nc"]);
    let file = netcdf::open(folder.path().join("field.nc")).unwrap();
    let of = |variable: &str, name: &str| text(file.variable(variable).unwrap_or_else(|| panic!("no `{variable}`")).attribute(name));
    let names: Vec<String> = file.variable("ftle").unwrap().dimensions().iter().map(|d| d.name()).collect();
    assert_eq!(names, ["time", "plev", "y", "x"]);
    // Backward, from the second and the third day, of a calendar without February 29.
    let day = |day: f64| (31.0 * 365.0 + 31.0 + 27.0 + day) * 86_400.0;
    assert_eq!((of("time", "calendar"), of("time", "units")), ("noleap".into(), "seconds since 1970-01-01 00:00:00".into()));
    assert_eq!(doubles(&file, "time"), [day(1.0), day(2.0)]);
    assert_eq!(doubles(&file, "time_bounds"), [day(0.0), day(1.0), day(1.0), day(2.0)]);
    // Heights are pressures again: seeds at the geometric mean.
    let pressures = doubles(&file, "plev");
    assert_eq!((of("plev", "units"), of("plev", "positive")), ("Pa".into(), "down".into()));
    for (found, expected) in pressures.iter().zip([100_000.0, 50_000.0, 25_000.0]) {
        assert!((found / expected - 1.0).abs() < 1e-9, "{pressures:?}");
    }
    assert_eq!((of("x", "standard_name"), of("x", "units"), of("x", "axis")), ("projection_x_coordinate".into(), "m".into(), "X".into()));
    assert_eq!((of("ftle", "grid_mapping"), of("ftle", "coordinates")), ("proj".into(), "lon lat".into()));
    assert_eq!(of("proj", "grid_mapping_name"), "lambert_conformal_conic");
    assert_eq!((of("lon", "standard_name"), of("lat", "units")), ("longitude".into(), "degrees_north".into()));
    let (lon, lat) = (doubles(&file, "lon"), doubles(&file, "lat"));
    for (j, i) in [(0, 0), (7, 11), (16, 24)] {
        let (x, y) = (i as f64 / 2.0, j as f64 / 2.0);
        let (expected, found) = ([10.0 + 0.1 * x + 0.01 * y, 45.0 + 0.02 * x + 0.1 * y], [lon[j * 25 + i], lat[j * 25 + i]]);
        assert!((0..2).all(|k| (expected[k] - found[k]).abs() < 1e-5), "{expected:?} {found:?}");
    }
    // Land has the fill value in all fields, and its own status; what left is told.
    let [ftle, lifetime, status] = ["ftle", "lifetime", "status"].map(|name| doubles(&file, name));
    assert_eq!((status[0], ftle[0], lifetime[0]), (2.0, FILL, FILL));
    assert_eq!(of("status", "flag_meanings"), "integrated_over_tau left_or_stopped_earlier no_velocity overflow");
    let land = status.iter().filter(|&&s| s == 2.0).count();
    assert!(land > 0 && land < status.len() / 4 && status.contains(&0.0) && status.contains(&1.0), "{land}");
    for ((ftle, lifetime), status) in ftle.iter().zip(&lifetime).zip(&status) {
        match *status as u8 {
            0 => assert!(ftle.abs() < 1.0 && *lifetime == 86_400.0),
            1 => assert!(ftle.abs() < 1.0 && *lifetime < 86_400.0),
            2 => assert!(*ftle == FILL && *lifetime == FILL),
            other => panic!("{other}"),
        }
    }
    let ancillary = of("ftle", "ancillary_variables");
    assert!(ancillary.split(' ').all(|name| file.variable(name).is_some()), "{ancillary}");
}

/// An array of a VTK file, from its offset in the appended data.
fn vtk_array(document: &roxmltree::Document, appended: &[u8], name: &str) -> Vec<f64> {
    let node = document.descendants().find(|n| n.has_tag_name("DataArray") && n.attribute("Name") == Some(name)).unwrap();
    let from: usize = node.attribute("offset").unwrap().parse().unwrap();
    let length = u64::from_le_bytes(appended[from..from + 8].try_into().unwrap()) as usize;
    let bytes = &appended[from + 8..from + 8 + length];
    match node.attribute("type").unwrap() {
        "Float64" => bytes.as_chunks::<8>().0.iter().map(|b| f64::from_le_bytes(*b)).collect(),
        "Int8" => bytes.iter().map(|&b| f64::from(b as i8)).collect(),
        other => panic!("{other}"),
    }
}

/// Reads a VTK file: its XML without the data, and the data.
fn vtk<T>(path: &Path, read: impl FnOnce(&roxmltree::Document, &[u8]) -> T) -> T {
    let bytes = std::fs::read(path).unwrap();
    let marker = b"<AppendedData encoding=\"raw\">\n_";
    let from = bytes.windows(marker.len()).position(|window| window == marker).unwrap() + marker.len();
    let tail = b"\n</AppendedData>\n</VTKFile>\n";
    assert!(bytes.ends_with(tail));
    let head = String::from_utf8(bytes[..from].to_vec()).unwrap() + "</AppendedData></VTKFile>";
    read(&roxmltree::Document::parse(&head).unwrap(), &bytes[from..bytes.len() - tail.len()])
}

#[test]
fn vtk_files_hold_the_same_field() {
    let folder = tempfile::tempdir().unwrap();
    projected(&folder.path().join("winds.nc"));
    let common = ["winds.nc", "--grid", "13x9x3", "--set", "time.tau=1 day", "--check"];
    ftle(folder.path(), &[&common[..], &["--slides", "all", "-o", "field.nc"]].concat());
    for kind in ["vti", "vtr", "vts"] {
        ftle(folder.path(), &[&common[..], &["-o", &format!("one.{kind}")]].concat());
    }
    ftle(folder.path(), &[&common[..], &["--slides", "all", "--format", "vtk", "-o", "series.pvd"]].concat());
    let file = netcdf::open(folder.path().join("field.nc")).unwrap();
    let seeds = 13 * 9 * 3;
    let equal = |name: &str, slide: usize, found: &[f64]| {
        let expected = doubles(&file, name)[slide * seeds..(slide + 1) * seeds].to_vec();
        assert_eq!(found.len(), seeds, "{name}");
        assert!(found.iter().zip(&expected).all(|(a, b)| a == b || (a.is_nan() && *b == FILL)), "{name}");
    };
    for kind in ["vti", "vtr", "vts"] {
        vtk(&folder.path().join(format!("one.{kind}")), |document, appended| {
            for name in ["ftle", "ftle_error", "lifetime", "status"] {
                equal(name, 0, &vtk_array(document, appended, name));
            }
            assert_eq!(vtk_array(document, appended, "direction"), [-1.0]);
            assert_eq!(vtk_array(document, appended, "TimeValue"), doubles(&file, "time")[..1]);
            let codes = document.descendants().find(|n| n.attribute("Name") == Some("ftle_unit")).unwrap().text().unwrap();
            let unit: Vec<u8> = codes.split(' ').map(|code| code.parse().unwrap()).collect();
            assert_eq!(unit, b"1/s\0");
            let grid = document.root_element().first_element_child().unwrap();
            assert_eq!(grid.attribute("WholeExtent"), Some("0 12 0 8 0 2"));
            let height = 7000.0 * 4f64.ln();
            match kind {
                "vti" => {
                    let numbers = |name: &str| grid.attribute(name).unwrap().split(' ').map(|n| n.parse().unwrap()).collect::<Vec<f64>>();
                    assert_eq!(numbers("Origin"), [5e5, 5e5, 0.0]);
                    let spacing = numbers("Spacing");
                    assert_eq!(spacing[..2], [1e4, 1e4]);
                    assert!((spacing[2] - height / 2.0).abs() < 1e-6, "{spacing:?}");
                }
                "vtr" => assert_eq!(vtk_array(document, appended, "y"), (0..9).map(|j| 5e5 + 1e4 * f64::from(j)).collect::<Vec<_>>()),
                _ => {
                    let points = vtk_array(document, appended, "points");
                    assert_eq!((points.len(), &points[3 * 13 + 3..][..2]), (3 * seeds, &[5.1e5, 5.1e5][..]));
                    assert!((points[3 * seeds - 1] - height).abs() < 1e-6);
                }
            }
        });
    }
    let pvd = std::fs::read_to_string(folder.path().join("series.pvd")).unwrap();
    let document = roxmltree::Document::parse(&pvd).unwrap();
    let sets: Vec<_> = document.descendants().filter(|n| n.has_tag_name("DataSet")).collect();
    assert_eq!(sets.len(), 2);
    for (slide, node) in sets.iter().enumerate() {
        assert_eq!(node.attribute("timestep").unwrap().parse::<f64>().unwrap(), doubles(&file, "time")[slide]);
        vtk(&folder.path().join(node.attribute("file").unwrap()), |document, appended| {
            equal("ftle", slide, &vtk_array(document, appended, "ftle"));
        });
    }
}

#[test]
fn points_of_a_sphere_lie_on_it() {
    let folder = tempfile::tempdir().unwrap();
    let axes: [(&str, &str, &[f64]); 3] = [
        ("time", "days since 2000-01-01", &[0.0, 1.0, 2.0]),
        ("lat", "degrees_north", &[0.0, 15.0, 30.0, 45.0]),
        ("lon", "degrees_east", &[60.0, 75.0, 90.0]),
    ];
    let wind = || f32s(fill(3, 4, 3, |_, y, x| (x + y) as f64));
    Fixture::on(NETCDF4, &axes).winds(wind(), wind()).write(&folder.path().join("winds.nc"));
    ftle(folder.path(), &["winds.nc", "--grid", "3x4", "--set", "time.tau=1 day", "-o", "globe.vts"]);
    ftle(folder.path(), &["winds.nc", "--grid", "3x4", "--set", "time.tau=1 day", "-o", "globe.nc"]);
    vtk(&folder.path().join("globe.vts"), |document, appended| {
        let points = vtk_array(document, appended, "points");
        let expected = [0.0, 6_371_008.8, 0.0];
        assert!(points[6..9].iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-3), "90 E on the equator: {points:?}");
    });
    let file = netcdf::open(folder.path().join("globe.nc")).unwrap();
    assert_eq!(text(file.variable("ftle").unwrap().attribute("grid_mapping")), "crs");
    assert_eq!(text(file.variable("lat").unwrap().attribute("standard_name")), "latitude");
    let crs = file.variable("crs").unwrap();
    assert_eq!(text(crs.attribute("grid_mapping_name")), "latitude_longitude");
    assert_eq!(crs.attribute("earth_radius").unwrap().value().unwrap(), AttributeValue::Double(6_371_008.8));
}

#[test]
fn what_cannot_be_written_is_refused_and_named() {
    let folder = tempfile::tempdir().unwrap();
    let gyre = config("double_gyre.toml");
    let refused = |arguments: &[&str], parts: &[&str]| {
        let all = [&["ftle", gyre.as_str(), "--grid", "21x11", "--set", "time.slides=3"][..], arguments].concat();
        run(&mut in_folder(folder.path(), &all)).refused(2, parts);
    };
    refused(&["--slides", "2..1"], &["--slides", "all, N, or A..B"]);
    refused(&["--slides", "1..3"], &["--slides 3", "fewer slides: 3"]);
    refused(&["--slides", "0", "--slide", "1"], &["--slide"]);
    refused(&["--format", "png", "-o", "a.png"], &["netcdf, vtk, vti, vtr, vts"]);

    // A link is replaced, and what it leads to stays.
    let target = folder.path().join("target");
    std::fs::write(&target, "kept").unwrap();
    for name in ["link.nc", "link.vti"] {
        std::os::unix::fs::symlink(&target, folder.path().join(name)).unwrap();
        ftle(folder.path(), &[&gyre, "--grid", "21x11", "-o", name]);
        assert!(!folder.path().join(name).symlink_metadata().unwrap().is_symlink());
    }
    assert_eq!(std::fs::read_to_string(&target).unwrap(), "kept");

    // A limit on the length of files stands for a full disk: 64 KiB.
    for name in ["full.nc", "full.vti"] {
        let program = env!("CARGO_BIN_EXE_ridgewatch");
        let script = format!("trap '' XFSZ; ulimit -f 64; exec {program} ftle {gyre} --grid 201x101 --device cpu -o {name}");
        let shell = std::process::Command::new("bash").args(["-c", &script]).current_dir(folder.path()).output().unwrap();
        let said = String::from_utf8_lossy(&shell.stderr).into_owned();
        assert_eq!(shell.status.code(), Some(1), "{said}");
        assert!(said.contains(name) && said.contains("cannot be written"), "{said}");
        assert!(!folder.path().join(name).exists());
    }
    let left: Vec<_> = std::fs::read_dir(folder.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
    assert_eq!(left.len(), 3, "{left:?}");
}
