//! Projections: there and back, equal scales, and the choice by region.

use crate::kit::program::{json, project};
use ridgewatch::field::Domain;
use ridgewatch::map::{Projection, ProjectionKind};
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
