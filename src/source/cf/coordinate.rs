//! Kind of a coordinate variable.

use super::time::TimeUnit;
use super::units::Unit;
use crate::formats::Variable;

/// Quantity along an axis.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    Longitude,
    Latitude,
    X,
    Y,
    Level,
    Time,
    Unknown,
}

impl Kind {
    pub fn is_horizontal(self) -> bool {
        matches!(self, Self::Longitude | Self::Latitude | Self::X | Self::Y)
    }
}

/// Kind by `standard_name`, then `units`, then `axis` and `positive`, then the name (CF conventions, chapter 4).
pub fn classify(variable: &Variable) -> Kind {
    let units = variable.units().unwrap_or_default();
    if TimeUnit::has_reference(units) {
        // The start of a forecast is not a time axis.
        return match variable.text("standard_name") {
            None | Some("time" | "") => Kind::Time,
            Some(_) => Kind::Unknown,
        };
    }
    match variable.text("standard_name").unwrap_or_default() {
        "longitude" | "grid_longitude" => return Kind::Longitude,
        "latitude" | "grid_latitude" => return Kind::Latitude,
        "projection_x_coordinate" => return Kind::X,
        "projection_y_coordinate" => return Kind::Y,
        "time" => return Kind::Time,
        "air_pressure" | "sea_water_pressure" | "height" | "altitude" | "depth" | "model_level_number" => return Kind::Level,
        name if name.starts_with("atmosphere_") || name.starts_with("ocean_") || name.starts_with("height_above_") => return Kind::Level,
        _ => {}
    }
    match units.to_ascii_lowercase().as_str() {
        "degrees_east" | "degree_east" | "degreese" | "degreee" | "degrees_e" | "degree_e" => return Kind::Longitude,
        "degrees_north" | "degree_north" | "degreesn" | "degreen" | "degrees_n" | "degree_n" => return Kind::Latitude,
        _ => {}
    }
    if Unit::parse(units).is_some_and(|u| u.is_pressure()) || variable.attribute("positive").is_some() {
        return Kind::Level;
    }
    let angle = units.to_ascii_lowercase().starts_with("degree") || units.to_ascii_lowercase().starts_with("radian");
    match variable.text("axis").map(str::to_ascii_uppercase).as_deref() {
        Some("X") if angle => Kind::Longitude,
        Some("Y") if angle => Kind::Latitude,
        Some("X") => match classify_name(&variable.name) {
            Kind::Longitude => Kind::Longitude,
            _ => Kind::X,
        },
        Some("Y") => match classify_name(&variable.name) {
            Kind::Latitude => Kind::Latitude,
            _ => Kind::Y,
        },
        Some("Z") => Kind::Level,
        Some("T") => Kind::Time,
        _ => classify_name(&variable.name),
    }
}

/// Kind by usual names alone.
pub fn classify_name(name: &str) -> Kind {
    match name.to_ascii_lowercase().as_str() {
        "lon" | "longitude" | "longitudes" | "lons" | "nav_lon" | "rlon" | "xlong" | "grid_longitude" | "glamt" | "glamu" | "glamv"
        | "glamf" | "lonc" | "clon" | "vlon" | "loncell" | "λ_faa" | "λ_caa" => Kind::Longitude,
        "lat" | "latitude" | "latitudes" | "lats" | "nav_lat" | "rlat" | "xlat" | "grid_latitude" | "gphit" | "gphiu" | "gphiv"
        | "gphif" | "latc" | "clat" | "vlat" | "latcell" | "φ_afa" | "φ_aca" => Kind::Latitude,
        "x" | "xc" | "nx" | "easting" | "west_east" | "xu_ocean" | "xt_ocean" | "xcoor" | "x_coordinate" | "x_rho" | "x_u" | "x_v"
        | "xg" | "xp1" | "xf" | "xq" | "xh" | "x_faa" | "x_caa" => Kind::X,
        "y" | "yc" | "ny" | "northing" | "south_north" | "yu_ocean" | "yt_ocean" | "ycoor" | "y_coordinate" | "y_rho" | "y_u" | "y_v"
        | "yg" | "yp1" | "yf" | "yq" | "yh" | "y_afa" | "y_aca" => Kind::Y,
        "z" | "zc" | "nz" | "nz1" | "lev" | "level" | "levels" | "plev" | "pressure" | "pressure_level" | "isobaric" | "depth"
        | "deptht" | "depthu" | "depthv" | "depthw" | "height" | "altitude" | "bottom_top" | "st_ocean" | "s_rho" | "sigma" | "zcoor"
        | "zl" | "zu" | "zp1" | "zf" | "z_aaf" | "z_aac" | "sw_ocean" => Kind::Level,
        "time" | "times" | "t" | "nt" | "ocean_time" | "valid_time" | "xtime" | "time_counter" | "month" | "months" | "dayofyear"
        | "day_of_year" => Kind::Time,
        _ => Kind::Unknown,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::formats::{Attribute, NumberType};

    #[test]
    fn attributes_come_before_names() {
        let variable = |name: &str, attributes: &[(&str, &str)]| Variable {
            name: name.into(),
            number: NumberType::Float64,
            dimensions: vec![0],
            attributes: attributes.iter().map(|(n, v)| (n.to_string(), Attribute::Text(v.to_string()))).collect(),
        };
        let cases: [(&str, &[(&str, &str)], Kind); 11] = [
            ("a", &[("units", "degrees_east")], Kind::Longitude),
            ("lon", &[("Unit", "degrees")], Kind::Longitude),
            ("x", &[("axis", "X"), ("units", "degrees")], Kind::Longitude),
            ("x", &[("standard_name", "projection_x_coordinate"), ("units", "m")], Kind::X),
            ("plev", &[("units", "hPa")], Kind::Level),
            ("x", &[("units", "hours since 2000-01-01")], Kind::Time),
            ("reftime", &[("units", "hours since 2000-01-01"), ("standard_name", "forecast_reference_time")], Kind::Unknown),
            ("k", &[("positive", "down")], Kind::Level),
            ("LATITUDE", &[("axis", "Y")], Kind::Latitude),
            ("j", &[("axis", "Y")], Kind::Y),
            ("member", &[], Kind::Unknown),
        ];
        for (name, attributes, kind) in cases {
            assert_eq!(classify(&variable(name, attributes)), kind, "{name} {attributes:?}");
        }
    }
}
