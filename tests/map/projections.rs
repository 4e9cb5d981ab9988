//! Projections: there and back, equal scales, and the choice by region.

use crate::kit::netcdf::{Data, Fixture, NETCDF4, f32s, fill};
use crate::kit::program::{json, project, ridgewatch, run, text};
use ridgewatch::field::{Domain, EARTH_RADIUS};
use ridgewatch::map::{Projection, ProjectionKind, View, degrees_over, nodes_over};
use ridgewatch::render::{MapPlane, ProjectionChoice, RenderSettings};
use serde_json::{Value, json};

/// Regions (west, south, east, north) that each kind can show.
const SHOWN: [(ProjectionKind, [f64; 4]); 8] = [
    (ProjectionKind::PlateCarree, [14.875, -40.125, 34.875, -30.125]),
    (ProjectionKind::PlateCarree, [-180.0, -90.0, 180.0, 90.0]),
    (ProjectionKind::Mercator, [-60.0, -40.0, 40.0, 60.0]),
    (ProjectionKind::Lambert, [-20.0, 30.0, 50.0, 72.0]),
    (ProjectionKind::Lambert, [100.0, -60.0, 180.0, -20.0]),
    (ProjectionKind::Polar, [0.0, 60.0, 360.0, 90.0]),
    (ProjectionKind::Polar, [-180.0, -90.0, 180.0, -50.0]),
    (ProjectionKind::Plain, [-3.0, 100.0, 5.0, 400.0]),
];

fn places([west, south, east, north]: [f64; 4]) -> impl Iterator<Item = [f64; 2]> {
    let at = |low: f64, high: f64, k: usize| low + (high - low) * (k as f64 + 0.5) / 24.0;
    (0..24 * 24).map(move |k| [at(west, east, k % 24), at(south, north, k / 24)])
}

#[test]
fn places_come_back() {
    for (kind, region) in SHOWN {
        let projection = Projection::new(kind, region).unwrap();
        for [x, y] in places(region) {
            let [u, v] = projection.inverse(projection.forward([x, y]));
            let turned = (u - x).rem_euclid(360.0).min((x - u).rem_euclid(360.0));
            assert!(turned < 1e-9 && (v - y).abs() < 1e-9, "{kind:?}: {x}, {y} comes back as {u}, {v}");
        }
    }
}

/// Mercator, Lambert and the polar one are conformal: east and north have one scale everywhere, at a right angle, and north is left of east.
#[test]
fn conformal_ones_keep_angles() {
    for (kind, region) in SHOWN {
        if matches!(kind, ProjectionKind::PlateCarree | ProjectionKind::Plain) {
            continue;
        }
        let projection = Projection::new(kind, region).unwrap();
        for [x, y] in places(region) {
            let small = 1e-5;
            let difference = |[dx, dy]: [f64; 2]| {
                let (a, b) = (projection.forward([x - dx, y - dy]), projection.forward([x + dx, y + dy]));
                [b[0] - a[0], b[1] - a[1]]
            };
            let (east, north) = (difference([small / y.to_radians().cos(), 0.0]), difference([0.0, small]));
            let scale = east[0].hypot(east[1]);
            assert!(
                (north[0] - -east[1]).abs() < 1e-5 * scale && (north[1] - east[0]).abs() < 1e-5 * scale,
                "{kind:?} at {x}, {y}: {east:?} {north:?}"
            );
        }
    }
    // Known values: Snyder's numerical example of Mercator's isometric latitude at 35 degrees, and stereographic distance 2 tan of half the colatitude.
    let [_, y] = Projection::Mercator.forward([0.0, 35.0]);
    assert!((y - 0.652_836_6).abs() < 1e-6, "{y}");
    let [_, y] = Projection::new(ProjectionKind::Polar, [-180.0, 40.0, 180.0, 90.0]).unwrap().forward([0.0, 60.0]);
    assert!((y + 2.0 * 15f64.to_radians().tan()).abs() < 1e-12, "{y}");
}

#[test]
fn the_region_chooses() {
    for (region, kind) in [
        ([14.875, -40.125, 34.875, -30.125], ProjectionKind::PlateCarree),
        ([0.0, -90.0, 360.0, 90.0], ProjectionKind::PlateCarree),
        ([-60.0, -40.0, 60.0, 60.0], ProjectionKind::Mercator),
        ([-25.0, 30.0, 45.0, 72.0], ProjectionKind::Lambert),
        ([0.0, 60.0, 360.0, 90.0], ProjectionKind::Polar),
        ([-180.0, -90.0, 180.0, -55.0], ProjectionKind::Polar),
    ] {
        assert_eq!(ProjectionKind::fitting(region), kind, "{region:?}");
        Projection::new(kind, region).unwrap();
    }
    assert!(Projection::new(ProjectionKind::Lambert, [0.0, -10.0, 20.0, 10.0]).unwrap_err().to_string().contains("plate_carree"));
    assert!(Projection::new(ProjectionKind::Mercator, [0.0, -10.0, 20.0, 89.0]).unwrap_err().to_string().contains("polar"));
    assert!(Projection::new(ProjectionKind::Polar, [0.0, -10.0, 20.0, 89.0]).unwrap_err().to_string().contains("one side of the equator"));
    Projection::new(ProjectionKind::Polar, [-180.0, 0.0, 180.0, 90.0]).unwrap();
    Projection::new(ProjectionKind::Lambert, [0.0, -60.0, 40.0, 0.0]).unwrap();
}

/// Longitude and latitude in a polar stereographic plane in metres, whose meridian of 0 degrees runs down from the pole.
fn on_cap([x, y]: [f64; 2]) -> [f64; 2] {
    [x.atan2(-y).to_degrees(), 90.0 - 2.0 * (x.hypot(y) / (2.0 * EARTH_RADIUS)).atan().to_degrees()]
}

/// Over data in metres of a plane, lines of degrees lie where these have round values, also around a pole.
#[test]
fn degrees_lie_over_a_plane_of_metres() {
    for (low, high) in [([-1.0e6, -3.0e6], [1.0e6, -1.5e6]), ([-2.0e6, -2.0e6], [2.0e6, 2.0e6])] {
        let domain = Domain::slab(low, high, (0.0, 1.0));
        let view = View::new(&domain, false, None, 0.5, 600).unwrap();
        let degrees: Vec<[f64; 2]> = nodes_over(&view).into_iter().map(on_cap).collect();
        let lines = degrees_over(&view, &degrees, 1.0);
        let (meridians, parallels): (Vec<_>, Vec<_>) = lines.iter().partition(|line| !line.label.ends_with('N'));
        assert!(meridians.len() >= 3 && parallels.len() >= 3, "{} {}", meridians.len(), parallels.len());
        for line in &lines {
            let name = line.label.trim_end_matches(['°', 'E', 'W', 'N']).trim_end_matches('°').parse::<f64>().unwrap();
            for at in &line.points {
                let [longitude, latitude] = on_cap(view.place(at[0], at[1]).unwrap());
                // In the cells around the pole a longitude has no one value to go through.
                if latitude > 89.5 {
                    continue;
                }
                // Of arc; lines are straight between nodes, which a circle is not.
                let shrink = latitude.to_radians().cos();
                let off = if line.label.ends_with('N') { (latitude - name).abs() } else { (longitude.abs() - name).abs() * shrink };
                assert!(off < 0.02, "{}: {longitude} {latitude}", line.label);
            }
            let (first, last) = (line.points[0], line.points[line.points.len() - 1]);
            let inside = |at: [f64; 2]| (0..2).all(|k| at[k] > 2.0 && at[k] < view.size[k] as f64 - 2.0);
            if inside(first) != inside(last) {
                assert!(!inside(first), "{}: its label is at the pole", line.label);
                continue;
            }
            let is_named_well = if line.label.ends_with('N') { first[0] >= last[0] } else { first[1] <= last[1] };
            assert!(is_named_well, "{}: {first:?} {last:?}", line.label);
        }
    }
}

#[test]
fn a_map_of_a_plane_in_metres_has_degrees_over_kilometres() {
    let folder = tempfile::tempdir().unwrap();
    let x: Vec<f64> = (0..21).map(|i| -1e6 + 1e5 * f64::from(i)).collect();
    let y: Vec<f64> = (0..15).map(|i| -3e6 + 1e5 * f64::from(i)).collect();
    let write = |mapping: bool, name: &str| {
        let shear = |j: usize| 1e-5 * (y[j] + 2e6);
        let axes: [(&str, &str, &[f64]); 3] = [("time", "hours since 2002-01-01", &[0.0, 12.0, 24.0]), ("y", "m", &y), ("x", "m", &x)];
        let mut fixture = Fixture::on(NETCDF4, &axes)
            .variable("x_wind", &["time", "y", "x"], f32s(fill(3, 15, 21, |_, j, _| shear(j))))
            .with("units", "m s-1")
            .with("standard_name", "x_wind")
            .with("grid_mapping", "crs")
            .variable("y_wind", &["time", "y", "x"], f32s(fill(3, 15, 21, |_, _, _| 0.0)))
            .with("units", "m s-1")
            .with("standard_name", "y_wind")
            .with("grid_mapping", "crs");
        if mapping {
            fixture = fixture.variable("crs", &[], Data::F64(vec![0.0])).with("grid_mapping_name", "polar_stereographic");
            for (key, value) in [
                ("latitude_of_projection_origin", 90.0),
                ("straight_vertical_longitude_from_pole", 0.0),
                ("scale_factor_at_projection_origin", 1.0),
                ("earth_radius", EARTH_RADIUS),
            ] {
                fixture = fixture.with(key, value);
            }
        }
        let axis = fixture.variables.iter_mut().find(|v| v.name == "x").unwrap();
        axis.attributes.push(("standard_name".into(), "projection_x_coordinate".into()));
        let axis = fixture.variables.iter_mut().find(|v| v.name == "y").unwrap();
        axis.attributes.push(("standard_name".into(), "projection_y_coordinate".into()));
        let out = folder.path().join(format!("{name}.svg"));
        let data = fixture.write(&folder.path().join(format!("{name}.nc")));
        run(&mut ridgewatch([
            "map",
            text(&data),
            "--device",
            "cpu",
            "--width",
            "300",
            "--seeds",
            "2",
            "--tau",
            "1 day",
            "--out",
            text(&out),
        ]))
        .success();
        std::fs::read_to_string(out).unwrap()
    };
    let picture = write(true, "mapped");
    for words in ["x, km", "70°N", "0°"] {
        assert!(picture.contains(words), "{words} is not in {picture}");
    }
    let picture = write(false, "unknown");
    assert!(picture.contains("x, km") && !picture.contains('°'), "{picture}");
}

/// The page of the dashboard has these projections too. Its tests read the same numbers: planes as records tell them, and places of the scene.
#[test]
fn the_page_is_tested_with_these_numbers() {
    let kinds = [
        (ProjectionChoice::PlateCarree, [14.875, -40.125, 34.875, -30.125]),
        (ProjectionChoice::Mercator, [-60.0, -40.0, 40.0, 60.0]),
        (ProjectionChoice::Lambert, [-20.0, 30.0, 50.0, 72.0]),
        (ProjectionChoice::Lambert, [100.0, -60.0, 180.0, -20.0]),
        (ProjectionChoice::Polar, [0.0, 60.0, 360.0, 90.0]),
        (ProjectionChoice::Polar, [-180.0, -90.0, 180.0, -50.0]),
    ];
    let cases = kinds.map(|(projection, region)| {
        let [west, south, east, north] = region;
        let domain = Domain { is_geographic: true, ..Domain::slab([west, south], [east, north], (0.0, 1.0)) };
        let settings = RenderSettings { projection, ..RenderSettings::default() };
        let plane = MapPlane::new(&domain, &settings, None, [0.02, 0.02, 0.25]).unwrap().unwrap();
        let places: Vec<[f64; 2]> = places(region).step_by(53).collect();
        let scene: Vec<[f64; 2]> = places
            .iter()
            .map(|place| {
                let at = plane.projection.forward(*place);
                [0, 1].map(|k| plane.origin[k] + plane.unit * at[k])
            })
            .collect();
        json!({"projection": plane, "places": places, "scene": scene})
    });
    let file = json(&project("tests/dashboard/browser/projections.json"));
    assert!(alike(&json!(cases), &file), "tests/dashboard/browser/projections.json is to hold {}", json!(cases));
}

/// Whether two values are the same but for the rounding of their numbers.
fn alike(one: &Value, other: &Value) -> bool {
    match (one, other) {
        (Value::Array(a), Value::Array(b)) => a.len() == b.len() && a.iter().zip(b).all(|(a, b)| alike(a, b)),
        (Value::Object(a), Value::Object(b)) => {
            a.len() == b.len() && a.iter().all(|(key, value)| b.get(key).is_some_and(|other| alike(value, other)))
        }
        (Value::Number(a), Value::Number(b)) => match (a.as_f64(), b.as_f64()) {
            (Some(a), Some(b)) => (a - b).abs() <= 1e-11 * (1.0 + a.abs()),
            _ => false,
        },
        _ => one == other,
    }
}
