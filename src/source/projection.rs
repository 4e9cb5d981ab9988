//! Where the points of a projection or of a rotated pole lie, and how its plane is turned and stretched there.

use proj4rs::proj::Proj;
use proj4rs::transform::transform;
use ridgewatch_field::EARTH_RADIUS;

/// Step of differences, degrees: some 10 m.
const STEP: f64 = 1e-4;

/// A projection or a rotated pole.
pub enum Projection {
    /// Longitude and latitude of the rotated north pole, and the rotated longitude of the geographic one.
    Rotated { pole: [f64; 2], turned: f64 },
    /// A plane, and the globe that it shows with its semi-major axis (metres) and squared eccentricity.
    Plane { plane: Box<Proj>, globe: Box<Proj>, major: f64, eccentricity: f64 },
}

/// Derivatives of (x, y) to metres on the ground to the east and to the north: dx/de, dx/dn, dy/de, dy/dn.
pub type Jacobian = [f64; 4];

impl Projection {
    /// From the words of the CF conventions, appendix F: the name of a grid mapping, and its attributes of numbers by their names; `unit` are metres in a unit of
    /// x and y in the file. `None` for projections that are not known here.
    pub fn of<'a>(kind: &str, numbers: impl Fn(&str) -> &'a [f64], unit: f64) -> Option<Self> {
        let number = |name: &str| numbers(name).first().copied();
        if kind == "rotated_latitude_longitude" {
            let pole = [number("grid_north_pole_longitude")?, number("grid_north_pole_latitude")?];
            return Some(Self::Rotated { pole, turned: number("north_pole_grid_longitude").unwrap_or(0.0) });
        }
        let major = number("semi_major_axis").or(number("earth_radius")).unwrap_or(EARTH_RADIUS);
        let flattening = match (number("inverse_flattening"), number("semi_minor_axis")) {
            (Some(inverse), _) if inverse > 0.0 => 1.0 / inverse,
            (None, Some(minor)) => 1.0 - minor / major,
            _ => 0.0,
        };
        let globe = format!("+a={major} +b={}", major * (1.0 - flattening));
        let origin = number("latitude_of_projection_origin");
        let meridian = number("longitude_of_central_meridian").or(number("longitude_of_projection_origin"));
        let scale = number("scale_factor_at_projection_origin").or(number("scale_factor_at_central_meridian"));
        let parallels = numbers("standard_parallel");
        let mut words = vec![match kind {
            "transverse_mercator" => format!("+proj=tmerc +lat_0={}", origin?),
            "lambert_conformal_conic" | "albers_conical_equal_area" => {
                let (name, first) = (if kind.starts_with('l') { "lcc" } else { "aea" }, *parallels.first()?);
                let second = parallels.get(1).unwrap_or(&first);
                format!("+proj={name} +lat_1={first} +lat_2={second} +lat_0={}", origin.unwrap_or(first))
            }
            "polar_stereographic" | "stereographic" => format!("+proj=stere +lat_0={}", origin?),
            "lambert_azimuthal_equal_area" => format!("+proj=laea +lat_0={}", origin?),
            "azimuthal_equidistant" => format!("+proj=aeqd +lat_0={}", origin?),
            "mercator" => "+proj=merc".into(),
            _ => return None,
        }];
        let meridian = number("straight_vertical_longitude_from_pole").or(meridian)?;
        words.push(format!("+lon_0={meridian}"));
        match (scale, parallels) {
            (Some(scale), _) => words.push(format!("+k_0={scale}")),
            (None, [parallel]) if ["polar_stereographic", "mercator"].contains(&kind) => words.push(format!("+lat_ts={parallel}")),
            _ => {}
        }
        let shift = ["false_easting", "false_northing"].map(|name| number(name).unwrap_or(0.0) * unit);
        words.push(format!("+x_0={} +y_0={} +units=m +no_defs", shift[0], shift[1]));
        let plane = Proj::from_proj_string(&format!("{} {globe}", words.join(" "))).ok()?;
        let ground = Proj::from_proj_string(&format!("+proj=longlat {globe} +no_defs")).ok()?;
        Some(Self::Plane { plane: Box::new(plane), globe: Box::new(ground), major, eccentricity: flattening * (2.0 - flattening) })
    }

    /// Longitude and latitude of a point, degrees.
    pub fn position(&self, [x, y]: [f64; 2]) -> Option<[f64; 2]> {
        match self {
            Self::Rotated { pole, turned } => Some(from_rotated([x - turned, y], *pole)),
            Self::Plane { plane, globe, .. } => {
                let mut point = (x, y, 0.0);
                transform(plane, globe, &mut point).ok()?;
                Some([point.0, point.1].map(f64::to_degrees)).filter(|degrees| degrees.iter().all(|d| d.is_finite()))
            }
        }
    }

    /// x and y of a longitude and latitude in degrees; of planes only.
    pub fn in_plane(&self, [longitude, latitude]: [f64; 2]) -> Option<[f64; 2]> {
        let Self::Plane { plane, globe, .. } = self else { return None };
        let mut point = (longitude.to_radians(), latitude.to_radians(), 0.0);
        transform(globe, plane, &mut point).ok()?;
        Some([point.0, point.1]).filter(|place| place.iter().all(|c| c.is_finite()))
    }

    /// How the plane lies at a point, or a kilometre (about a rotated pole, a hundredth of a degree) beside it where it has no east, as at a pole. Not a number
    /// outside of the projection.
    pub fn near(&self, [x, y]: [f64; 2]) -> Jacobian {
        let aside = if matches!(self, Self::Plane { .. }) { 1000.0 } else { 0.01 };
        self.jacobian([x, y]).or_else(|| self.jacobian([x + aside, y + aside])).unwrap_or([f64::NAN; 4])
    }

    /// How the plane lies at a point. About a rotated pole, x and y are metres on the ground too.
    pub fn jacobian(&self, place: [f64; 2]) -> Option<Jacobian> {
        match self {
            Self::Rotated { .. } => {
                let ends = [-STEP, STEP].map(|step| self.position([place[0] + step, place[1]]));
                let [from, to] = [ends[0]?, ends[1]?];
                turned(self.position(place)?, &[(from, -1.0), (to, 1.0)])
            }
            Self::Plane { major, eccentricity, .. } => {
                let [longitude, latitude] = self.position(place)?;
                let sine = latitude.to_radians().sin();
                let square = 1.0 - eccentricity * sine * sine;
                let [east, north] = [latitude.to_radians().cos() * major / square.sqrt(), major * (1.0 - eccentricity) / square.powf(1.5)];
                let ends = |step: [f64; 2]| {
                    let [from, to] = [-1.0, 1.0].map(|s| self.in_plane([longitude + s * step[0], latitude + s * step[1]]));
                    let metres = 2.0 * STEP.to_radians() * if step[0] == 0.0 { north } else { east };
                    Some([0, 1].map(|k| Some((to?[k] - from?[k]) / metres)))
                };
                let ([xe, ye], [xn, yn]) = (ends([STEP, 0.0])?, ends([0.0, STEP])?);
                let found = [xe?, xn?, ye?, yn?];
                found.iter().all(|d| d.is_finite()).then_some(found)
            }
        }
    }
}

/// Parts to the east and to the north at `here` of a weighted difference of points, in radii of the globe.
pub fn difference(here: [f64; 2], points: &[([f64; 2], f64)]) -> [f64; 2] {
    let angles = |place: [f64; 2]| place.map(|angle| angle.to_radians().sin_cos());
    let point = |place: [f64; 2]| {
        let [(sin_lon, cos_lon), (sin_lat, cos_lat)] = angles(place);
        [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat]
    };
    let [(sin_lon, cos_lon), (sin_lat, cos_lat)] = angles(here);
    let along = |direction: [f64; 3]| {
        let rise = |end: [f64; 2]| point(end).iter().zip(direction).map(|(p, d)| p * d).sum::<f64>();
        points.iter().map(|&(end, weight)| weight * rise(end)).sum::<f64>()
    };
    [along([-sin_lon, cos_lon, 0.0]), along([-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat])]
}

/// Rotation from east and north at `here` to x and y, where `row` are points along x and the weights of their difference.
pub fn turned(here: [f64; 2], row: &[([f64; 2], f64)]) -> Option<Jacobian> {
    let [east, north] = difference(here, row);
    let length = east.hypot(north);
    (length > 0.0).then(|| [east / length, north / length, -north / length, east / length])
}

/// Longitude and latitude of rotated ones; the rotated north pole lies at `pole` (CF conventions, appendix F). All in degrees.
fn from_rotated(rotated: [f64; 2], pole: [f64; 2]) -> [f64; 2] {
    let [(sin_x, cos_x), (sin_y, cos_y)] = rotated.map(|a| a.to_radians().sin_cos());
    let (sin_pole, cos_pole) = pole[1].to_radians().sin_cos();
    // Away from the meridian opposite of the pole's.
    let along = cos_y * cos_x * sin_pole - sin_y * cos_pole;
    let latitude = (cos_y * cos_x * cos_pole + sin_y * sin_pole).clamp(-1.0, 1.0).asin();
    [pole[0] + 180.0 + (cos_y * sin_x).atan2(along).to_degrees(), latitude.to_degrees()]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(kind: &str, numbers: &'static [(&str, &[f64])]) -> Option<Projection> {
        Projection::of(kind, |name| numbers.iter().find(|(n, _)| *n == name).map_or(&[][..], |(_, values)| values), 1.0)
    }

    fn close<const N: usize>(found: [f64; N], expected: [f64; N], tolerance: f64) {
        assert!(found.iter().zip(expected).all(|(a, b)| (a - b).abs() < tolerance), "{found:?} {expected:?}");
    }

    #[test]
    fn rotated_poles_are_turned_back() {
        // The rotated origin lies on the meridian opposite of the pole's, as far from the equator as the pole from the north pole.
        let pole = [-162.0, 39.25];
        close(from_rotated([0.0, 0.0], pole), [18.0, 50.75], 1e-12);
        close(from_rotated([12.0, 90.0], pole).map(|d| d.rem_euclid(360.0)), [198.0, 39.25], 1e-9);
        // East of the origin along the rotated equator: on a great circle that runs east there.
        close(from_rotated([90.0, 0.0], pole), [108.0, 0.0], 1e-9);
        close(from_rotated([7.0, 3.0], [180.0, 90.0]), [367.0, 3.0], 1e-9);
    }

    /// Against closed forms (Snyder, Map projections: a working manual, USGS professional paper 1395, 1987).
    #[test]
    fn planes_are_turned_and_stretched() {
        // Polar stereographic sphere: meridian 0 runs down from the pole, east is (cos, sin) and the scale 2 / (1 + sin latitude).
        let polar = of(
            "polar_stereographic",
            &[
                ("latitude_of_projection_origin", &[90.0]),
                ("straight_vertical_longitude_from_pole", &[0.0]),
                ("scale_factor_at_projection_origin", &[1.0]),
                ("earth_radius", &[6.371e6]),
            ],
        );
        let polar = polar.unwrap();
        let place = [1.2e6, -2.0e6];
        let [longitude, latitude] = polar.position(place).unwrap();
        let expected = 90.0 - 2.0 * (1.2e6f64.hypot(2e6) / (2.0 * 6.371e6)).atan().to_degrees();
        close([longitude, latitude], [1.2f64.atan2(2.0).to_degrees(), expected], 1e-9);
        let ((sine, cosine), scale) = (longitude.to_radians().sin_cos(), 2.0 / (1.0 + latitude.to_radians().sin()));
        close(polar.jacobian(place).unwrap(), [cosine, -sine, sine, cosine].map(|d| d * scale), 1e-7);
        // Lambert's cone: meridians turn by the sine of the parallel times the longitude; no stretch on the parallel.
        let cone = of(
            "lambert_conformal_conic",
            &[
                ("standard_parallel", &[46.5]),
                ("latitude_of_projection_origin", &[46.5]),
                ("longitude_of_central_meridian", &[2.0]),
                ("earth_radius", &[6_371_229.0]),
            ],
        );
        let cone = cone.unwrap();
        close(cone.jacobian([0.0, 0.0]).unwrap(), [1.0, 0.0, 0.0, 1.0], 1e-7);
        let place = [4e5, 3e5];
        let turn = 46.5f64.to_radians().sin() * (cone.position(place).unwrap()[0] - 2.0).to_radians();
        let [xe, xn, ye, yn] = cone.jacobian(place).unwrap();
        close([ye.atan2(xe), (-xn).atan2(yn), xe.hypot(ye) - xn.hypot(yn)], [turn, turn, 0.0], 1e-7);
        // UTM: 0.9996 on the meridian; elsewhere the convergence is near the longitude from it times the sine of the latitude.
        let utm = of(
            "transverse_mercator",
            &[
                ("latitude_of_projection_origin", &[0.0]),
                ("longitude_of_central_meridian", &[9.0]),
                ("scale_factor_at_central_meridian", &[0.9996]),
                ("false_easting", &[500_000.0]),
                ("semi_major_axis", &[6_378_137.0]),
                ("inverse_flattening", &[298.257_223_563]),
            ],
        );
        let utm = utm.unwrap();
        close(utm.jacobian([500_000.0, 5.5e6]).unwrap(), [0.9996, 0.0, 0.0, 0.9996], 1e-7);
        let [longitude, latitude] = utm.position([740_000.0, 5.4e6]).unwrap();
        let [xe, _, ye, _] = utm.jacobian([740_000.0, 5.4e6]).unwrap();
        let expected = ((longitude - 9.0).to_radians().tan() * latitude.to_radians().sin()).atan();
        close([ye.atan2(xe), xe.hypot(ye)], [expected, 0.9996 * (1.0 + 0.5 * (240_000.0f64 / 0.9996 / 6.38e6).powi(2))], 2e-5);
        assert!(of("geostationary", &[]).is_none());
    }
}
