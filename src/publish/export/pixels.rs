//! The pixels of a map as NetCDF.

use super::cf::{CfError, CfFile};
use super::{FieldFrame, Of};
use crate::field::{Domain, EARTH_RADIUS, Geometry};
use crate::flow::Direction;
use crate::render::{Camera, MapPlane, Method, Projection};
use crate::run::{DomainRecord, Frame, FrameRecord, Plan};
use crate::source::{Georeference, Positions, utc};
use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Why there is no file of a frame's pixels, or of a slide's field.
#[derive(Debug, Error)]
pub enum NoField {
    /// The frame is no field on axes, or no frame is complete.
    #[error("{0}")]
    Missing(String),
    /// What was asked for is no longer kept.
    #[error("{0}")]
    Gone(String),
    /// There is no memory for it now.
    #[error("{0}")]
    NoRoom(String),
    /// The system refuses.
    #[error("{0}")]
    System(String),
}

/// What is to be known of a run for the files of its maps.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct MapAbout {
    title: String,
    georeference: Georeference,
}

impl MapAbout {
    /// Of a plan.
    pub fn new(plan: &Plan) -> Self {
        Self { title: plan.scene.title.clone(), georeference: plan.georeference.clone() }
    }
}

/// The plane of a projection in which parallels and meridians are no axes of even steps. Pixels then lie along its own, in metres.
fn curved(record: &FrameRecord) -> Option<MapPlane> {
    record.projection.filter(|plane| !matches!(plane.projection, Projection::PlateCarree { .. }))
}

/// Pixels of a picture whose centres lie in the domain; all of them in the plane of a projection.
struct Centres {
    /// Coordinates of the first and the last centre along x and y, ascending: of the domain, or metres in the plane of a projection.
    first: [f64; 2],
    last: [f64; 2],
    /// First column and number of columns; the same of rows, from the top.
    columns: [usize; 2],
    rows: [usize; 2],
}

impl Centres {
    /// Of a frame whose columns and rows run along x and y.
    fn of(record: &FrameRecord) -> Result<Self, String> {
        let (Some(camera), Some(domain)) = (&record.camera, &record.domain) else {
            return Err("its record has no camera or domain".into());
        };
        let [width, height] = record.size;
        let camera = Camera::new(camera, width as f64 / height as f64).map_err(|error| error.to_string())?;
        let middle = 0.5 * (domain.min[2] + domain.max[2]) * record.scale[2];
        let at = |column: f64, row: f64| {
            let (origin, direction) = camera.ray(2.0 * (column + 0.5) / width as f64 - 1.0, 1.0 - 2.0 * (row + 0.5) / height as f64);
            let along = (middle - origin[2]) / direction[2];
            let scene = [0, 1].map(|k| origin[k] + along * direction[k]);
            match record.projection {
                None => [0, 1].map(|k| scene[k] / record.scale[k]),
                Some(plane) if curved(record).is_some() => plane.plane(scene).map(|x| EARTH_RADIUS * x),
                Some(plane) => plane.projection.inverse(plane.plane(scene)),
            }
        };
        let ends = |k: usize| if curved(record).is_some() { f64::NEG_INFINITY..=f64::INFINITY } else { domain.min[k]..=domain.max[k] };
        let (corner, right, down) = (at(0.0, 0.0), at(1.0, 0.0), at(0.0, 1.0));
        let step = [right[0] - corner[0], corner[1] - down[1]];
        // A millionth of a pixel, more than rounding in a near view.
        let slack = 1e-6 * (step[0].abs() + step[1].abs());
        let is_straight = (right[1] - corner[1]).abs() <= slack && (down[0] - corner[0]).abs() <= slack;
        // Far pixels of a view that is tilted lie elsewhere.
        let far = at(width as f64, height as f64);
        let expected = [corner[0] + step[0] * width as f64, corner[1] - step[1] * height as f64];
        let is_even = (0..2).all(|k| (far[k] - expected[k]).abs() <= 1e-6 * step[k].abs() * (width + height) as f64);
        if !(step[0] > 0.0 && step[1] > 0.0 && is_straight && is_even) {
            return Err("its view is turned or tilted, so that pixels do not lie along x and y".into());
        }
        let inside = |k: usize, count: usize, place: &dyn Fn(usize) -> f64| {
            let within = |i: &usize| ends(k).contains(&place(*i));
            let first = (0..count).find(within)?;
            Some([first, (first..count).take_while(within).count()])
        };
        let x = |column: usize| corner[0] + step[0] * column as f64;
        let y = |row: usize| corner[1] - step[1] * row as f64;
        let (Some(columns), Some(rows)) = (inside(0, width, &x), inside(1, height, &y)) else {
            return Err("no pixel lies in the domain".into());
        };
        let [last_column, last_row] = [columns, rows].map(|[first, count]| first + count - 1);
        Ok(Self { first: [x(columns[0]), y(last_row)], last: [x(last_column), y(rows[0])], columns, rows })
    }

    /// Values of these pixels, x fastest, upwards.
    fn of_layer(&self, layer: &[f32], width: usize) -> Vec<f64> {
        let [first, count] = self.columns;
        let rows = (self.rows[0]..self.rows[0] + self.rows[1]).rev();
        rows.flat_map(|row| layer[row * width + first..][..count].iter().map(|value| f64::from(*value))).collect()
    }
}

/// Longitudes and latitudes of pixels that lie along the axes of a plane, by the CF conventions for grid mappings. `None` if none lies in the domain.
fn on_sphere(plane: &MapPlane, domain: &DomainRecord, head: &FieldFrame) -> Option<Georeference> {
    let [x, y] = [0, 1].map(|k| head.coordinates(k));
    let DomainRecord { min, max, .. } = domain;
    let places = y.iter().flat_map(|&y| x.iter().map(move |&x| [x / EARTH_RADIUS, y / EARTH_RADIUS]));
    let is_seen = |place| plane.projection.place_in([min[0], min[1], max[0], max[1]], place).is_some();
    places.clone().any(is_seen).then_some(())?;
    // Beside a cone there is no place.
    let middle = match plane.projection {
        Projection::Lambert { middle, .. } | Projection::Polar { middle, .. } => Some(middle),
        _ => None,
    };
    let is_place = |degrees: &[f64; 2]| degrees[1].is_finite() && middle.is_none_or(|middle| (degrees[0] - middle).abs() <= 180.0);
    let known = |degrees: [f64; 2]| if is_place(&degrees) { degrees } else { [f64::NAN; 2] };
    let degrees = places.map(|place| known(plane.projection.inverse(place))).collect();
    let positions = Positions::new(["lon", "lat"], x, y, degrees);
    Some(match plane.projection {
        Projection::Lambert { middle, parallels, n, .. } => {
            let numbers: [(_, &[f64]); 3] = [
                ("standard_parallel", &parallels),
                ("longitude_of_central_meridian", &[middle]),
                // The top of the cone.
                ("latitude_of_projection_origin", &[90.0 * n.signum()]),
            ];
            head.georeference.in_plane("lambert_conformal_conic", &numbers, positions)
        }
        Projection::Polar { middle, pole } => {
            let numbers: [(_, &[f64]); 3] = [
                ("straight_vertical_longitude_from_pole", &[middle]),
                ("latitude_of_projection_origin", &[90.0 * pole]),
                ("scale_factor_at_projection_origin", &[1.0]),
            ];
            head.georeference.in_plane("polar_stereographic", &numbers, positions)
        }
        _ => {
            let numbers: [(_, &[f64]); 2] = [("standard_parallel", &[0.0]), ("longitude_of_projection_origin", &[0.0])];
            head.georeference.in_plane("mercator", &numbers, positions)
        }
    })
}

/// A frame of the method `map` as NetCDF by the CF conventions: the FTLE of its pixels, the error of each, and the share without a velocity.
///
/// # Errors
/// Why the frame is no such field, or what the system refuses.
pub fn map_netcdf(frame: &Frame, about: &MapAbout, run: &str) -> Result<Vec<u8>, NoField> {
    let Frame { film, record, .. } = frame;
    if record.method != Method::Map.name() {
        let found = format!("a frame of {} is a picture of a volume, which shows no FTLE below transfer.low", record.method);
        return Err(NoField::Missing(found));
    }
    // Another program may have sent it.
    let pixels = film.width.saturating_mul(film.height);
    if record.size != [film.width, film.height]
        || [&film.ftle_mean, &film.error, &film.missing, &film.queries].iter().any(|layer| layer.len() != pixels)
    {
        return Err(NoField::Missing("the frame lacks the FTLE, its error or the missing share of some pixels".into()));
    }
    let centres = Centres::of(record).map_err(|why| NoField::Missing(format!("the frame is no field on axes: {why}")))?;
    let ([min_x, min_y], [max_x, max_y]) = (centres.first, centres.last);
    let domain = Domain { dimensions: 2, ..Domain::cuboid([min_x, min_y, 0.0], [max_x, max_y, 1.0]) };
    let steps = record.integration_steps.map_or_else(|| "adaptive steps".to_owned(), |steps| format!("{steps} steps"));
    let mut head = FieldFrame {
        grid: [centres.columns[1], centres.rows[1], 1],
        domain,
        geometry: Geometry::Cartesian,
        axes: Default::default(),
        georeference: about.georeference.clone(),
        direction: if record.direction == Direction::Backward.name() { Direction::Backward } else { Direction::Forward },
        time_unit: record.time_unit.clone(),
        title: about.title.clone(),
        source: record.source.clone(),
        integrator: steps,
        tau: record.tau,
        history: format!("{} ridgewatch: frame {} of {run}", utc(std::time::SystemTime::now()), record.frame),
        pointwise: None,
        of: Of::Pixels,
    };
    if let (Some(plane), Some(domain)) = (curved(record), &record.domain) {
        let outside = || NoField::Missing("the frame is no field on axes: no pixel lies in the domain".into());
        head.georeference = on_sphere(&plane, domain, &head).ok_or_else(outside)?;
    }
    let refused = |error: &dyn std::fmt::Display| NoField::System(error.to_string());
    let folder = tempfile::tempdir().map_err(|error| refused(&error))?;
    let path = folder.path().join("map.nc");
    // Of pixels without a seed in the domain it is not known what is missing.
    let missing = film.missing.iter().zip(&film.queries).map(|(missing, seeds)| if *seeds > 0.0 { *missing } else { f32::NAN }).collect();
    let values = [&film.ftle_mean, &film.error, &missing].map(|layer| centres.of_layer(layer, film.width));
    let write = || -> Result<(), CfError> {
        let mut file = CfFile::create(&path, head)?;
        file.add_pixels(record.time, values.each_ref().map(Vec::as_slice))?;
        file.finish(&path)
    };
    write().map_err(|error| refused(&error))?;
    std::fs::read(&path).map_err(|error| refused(&error))
}
