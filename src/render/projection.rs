//! Projections of the sphere onto the plane of a map, and back (Snyder, Map projections: a working manual, USGS professional paper 1395, 1987).

use serde::{Deserialize, Serialize};
use std::f64::consts::FRAC_PI_4;
use thiserror::Error;

/// Kind of a projection, as it is named on the command line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ProjectionKind {
    /// Longitude and latitude as x and y, with x shortened by the cosine of the middle latitude.
    PlateCarree,
    /// Mercator: conformal, meridians are parallel.
    Mercator,
    /// Lambert's conformal cone of two standard parallels.
    Lambert,
    /// Polar stereographic: conformal, a pole is the centre.
    Polar,
    /// The coordinates themselves.
    Plain,
}

/// A kind of projection cannot show a region.
#[derive(Debug, Clone, PartialEq, Error)]
#[error("{why}; accepted: {accepted}")]
pub struct Unprojectable {
    /// What the kind cannot show.
    pub why: String,
    /// Kinds that are accepted.
    pub accepted: &'static str,
}

/// A projection. Planes have the unit of the sphere's radius, or of the coordinates for [`Self::Plain`].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum Projection {
    /// [`ProjectionKind::PlateCarree`]: the factor of x.
    PlateCarree {
        /// Cosine of the latitude at which east and north have one scale.
        cosine: f64,
    },
    /// [`ProjectionKind::Mercator`].
    Mercator,
    /// [`ProjectionKind::Lambert`], equations 15-1 to 15-11.
    Lambert {
        /// Longitude that points up, degrees.
        middle: f64,
        /// Latitudes at which lengths are those on the sphere, degrees; `n` and `factor` follow from them.
        parallels: [f64; 2],
        /// Sine of the cone.
        n: f64,
        /// Factor of the distance from the cone's top.
        factor: f64,
    },
    /// [`ProjectionKind::Polar`], equations 21-5 to 21-11.
    Polar {
        /// Longitude that points down from the north pole (up from the south pole), degrees.
        middle: f64,
        /// 1 for the north pole, -1 for the south pole.
        pole: f64,
    },
    /// [`ProjectionKind::Plain`].
    Plain,
}

/// ln tan(pi/4 + latitude/2), for a latitude in degrees.
fn isometric(latitude: f64) -> f64 {
    (FRAC_PI_4 + latitude.to_radians() / 2.0).tan().ln()
}

/// Inverse of [`isometric`].
fn latitude_of(isometric: f64) -> f64 {
    2.0 * (isometric.exp().atan() - FRAC_PI_4).to_degrees()
}

/// Most polar latitude that Mercator reaches, in degrees.
const MERCATOR_END: f64 = 85.0;

impl ProjectionKind {
    /// The kind that fits a region: plain for Cartesian coordinates; polar near a pole; plate carree for regions of at most 40 by 25 degrees and
    /// for those that go around the globe; Lambert on one side of the equator in middle latitudes; otherwise Mercator.
    /// `west`, `south`, `east`, `north` in degrees.
    pub fn fitting([west, south, east, north]: [f64; 4]) -> Self {
        let (width, height, middle) = (east - west, north - south, (south + north) / 2.0);
        let (nearest, farthest) = if south * north <= 0.0 {
            (0.0, south.abs().max(north.abs()))
        } else {
            (south.abs().min(north.abs()), south.abs().max(north.abs()))
        };
        if (nearest >= 55.0 && farthest > 75.0) || (nearest >= 30.0 && farthest > 80.0) {
            Self::Polar
        } else if width > 180.0 || farthest > 80.0 || (width <= 40.0 && height <= 25.0 && farthest <= 70.0) {
            Self::PlateCarree
        } else if nearest > 0.0 && (25.0..=70.0).contains(&middle.abs()) && width <= 120.0 {
            Self::Lambert
        } else {
            Self::Mercator
        }
    }
}

impl Projection {
    /// The projection of a kind for a region, in degrees.
    ///
    /// # Errors
    /// The kind cannot show the region.
    pub fn new(kind: ProjectionKind, [west, south, east, north]: [f64; 4]) -> Result<Self, Unprojectable> {
        let (middle, latitude) = ((west + east) / 2.0, (south + north) / 2.0);
        let refused = |why: String, accepted| Err(Unprojectable { why, accepted });
        match kind {
            ProjectionKind::Plain => Ok(Self::Plain),
            ProjectionKind::PlateCarree if east - west > 180.0 => Ok(Self::PlateCarree { cosine: 1.0 }),
            ProjectionKind::PlateCarree => Ok(Self::PlateCarree { cosine: latitude.to_radians().cos() }),
            ProjectionKind::Mercator if south < -MERCATOR_END || north > MERCATOR_END => refused(
                format!("mercator ends at {MERCATOR_END} degrees, and the data reach from {south:.2} to {north:.2}"),
                "plate_carree, polar",
            ),
            ProjectionKind::Mercator => Ok(Self::Mercator),
            ProjectionKind::Lambert if south < 0.0 && north > 0.0 || east - west > 180.0 => {
                refused("lambert shows one side of the equator and at most 180 degrees of longitude".into(), "plate_carree, mercator")
            }
            ProjectionKind::Lambert => {
                // Standard parallels a sixth of the height inside, as in common use (Snyder, page 105).
                let [first, second] = [south + (north - south) / 6.0, north - (north - south) / 6.0];
                let n = (first.to_radians().cos() / second.to_radians().cos()).ln() / (isometric(second) - isometric(first));
                let factor = first.to_radians().cos() * (n * isometric(first)).exp() / n;
                Ok(Self::Lambert { middle, parallels: [first, second], n, factor })
            }
            ProjectionKind::Polar if south < 0.0 && north > 0.0 => {
                refused("polar shows one side of the equator".into(), "plate_carree, mercator")
            }
            ProjectionKind::Polar => Ok(Self::Polar { middle, pole: latitude.signum() }),
        }
    }

    /// Kind of this projection.
    pub fn kind(&self) -> ProjectionKind {
        match self {
            Self::PlateCarree { .. } => ProjectionKind::PlateCarree,
            Self::Mercator => ProjectionKind::Mercator,
            Self::Lambert { .. } => ProjectionKind::Lambert,
            Self::Polar { .. } => ProjectionKind::Polar,
            Self::Plain => ProjectionKind::Plain,
        }
    }

    /// What the map says of its projection.
    pub fn words(&self) -> String {
        match *self {
            Self::PlateCarree { cosine: 1.0 } => "plate carrée".into(),
            Self::PlateCarree { cosine } => format!("plate carrée, shortened east-west by cos {:.1}°", cosine.acos().to_degrees()),
            Self::Mercator => "Mercator".into(),
            Self::Lambert { middle, .. } => format!("Lambert conformal conic about {middle:.1}°"),
            Self::Polar { middle, .. } => format!("polar stereographic about {middle:.1}°"),
            Self::Plain => "plain coordinates".into(),
        }
    }

    /// From coordinates (degrees) to the plane, x to the right and y up.
    pub fn forward(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        match *self {
            Self::Plain => [x, y],
            Self::PlateCarree { cosine } => [x.to_radians() * cosine, y.to_radians()],
            Self::Mercator => [x.to_radians(), isometric(y)],
            Self::Lambert { middle, n, factor, .. } => {
                let (rho, theta) = (factor * (-n * isometric(y)).exp(), n * (x - middle).to_radians());
                [rho * theta.sin(), -rho * theta.cos()]
            }
            Self::Polar { middle, pole } => {
                let (rho, theta) = (2.0 * (FRAC_PI_4 - pole * y.to_radians() / 2.0).tan(), (x - middle).to_radians());
                [rho * theta.sin(), -pole * rho * theta.cos()]
            }
        }
    }

    /// From the plane to coordinates. Longitudes of cones and poles lie within 180 degrees of the middle.
    pub fn inverse(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        match *self {
            Self::Plain => [x, y],
            Self::PlateCarree { cosine } => [(x / cosine).to_degrees(), y.to_degrees()],
            Self::Mercator => [x.to_degrees(), latitude_of(y)],
            Self::Lambert { middle, n, factor, .. } => {
                let rho = n.signum() * x.hypot(y);
                let theta = (n.signum() * x).atan2(-n.signum() * y);
                [middle + (theta / n).to_degrees(), latitude_of((factor / rho).ln() / n)]
            }
            Self::Polar { middle, pole } => {
                let theta = x.atan2(-pole * y);
                [middle + theta.to_degrees(), pole * (90.0 - 2.0 * (x.hypot(y) / 2.0).atan().to_degrees())]
            }
        }
    }

    /// Coordinates of a place in the plane that lies in a region, on whose rim rounding is forgiven; `None` outside.
    pub fn place_in(&self, [west, south, east, north]: [f64; 4], plane: [f64; 2]) -> Option<[f64; 2]> {
        let [u, v] = self.inverse(plane);
        let slack = 1e-9 * (east - west);
        (u >= west - slack && u <= east + slack && v >= south - slack && v <= north + slack)
            .then(|| [u.clamp(west, east), v.clamp(south, north)])
    }

    /// Lower and upper ends of a region in the plane.
    pub fn bounds(&self, region: [f64; 4]) -> [[f64; 2]; 2] {
        let mut ends = [[f64::INFINITY; 2], [f64::NEG_INFINITY; 2]];
        for place in outline(region) {
            let [x, y] = self.forward(place);
            ends = [[ends[0][0].min(x), ends[0][1].min(y)], [ends[1][0].max(x), ends[1][1].max(y)]];
        }
        ends
    }
}

/// The rim of a region, dense enough to be straight between its points.
pub fn outline([west, south, east, north]: [f64; 4]) -> Vec<[f64; 2]> {
    const PARTS: usize = 180;
    let corners = [[west, south], [east, south], [east, north], [west, north], [west, south]];
    let between = |pair: &[[f64; 2]]| {
        let (from, to) = (pair[0], pair[1]);
        (0..PARTS).map(move |k| [0, 1].map(|axis| from[axis] + (to[axis] - from[axis]) * k as f64 / PARTS as f64))
    };
    corners.windows(2).flat_map(between).chain([corners[0]]).collect()
}
