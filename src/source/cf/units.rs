//! Units of length, pressure and velocity, as products of powers (`m s-1`, `m/s`, `cm s**-1`, `Pa/s`).

/// A unit as a factor to SI and powers of length, time and pressure.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Unit {
    pub factor: f64,
    powers: [i32; 3],
}

/// Accepted units of velocity, for messages.
pub const VELOCITY_UNITS: &str =
    "m/s (m s-1, m s**-1, cm/s, km/h, m/day, knots and the like) and, along a pressure axis, Pa/s (hPa/s, hPa/h)";

/// Accepted units of axes, for messages.
pub const AXIS_UNITS: &str = "degrees_east and degrees_north, m, km, cm, Pa, hPa, mbar, dbar, or none";

const NONE: Unit = Unit { factor: 1.0, powers: [0, 0, 0] };

fn base(name: &str) -> Option<Unit> {
    let length = |factor| Unit { factor, powers: [1, 0, 0] };
    let time = |factor| Unit { factor, powers: [0, 1, 0] };
    let pressure = |factor| Unit { factor, powers: [0, 0, 1] };
    let velocity = |factor| Unit { factor, powers: [1, -1, 0] };
    Some(match name.to_ascii_lowercase().as_str() {
        // Geopotential metres too.
        "m" | "meter" | "meters" | "metre" | "metres" | "gpm" => length(1.0),
        "km" | "kilometer" | "kilometers" | "kilometre" | "kilometres" => length(1e3),
        "cm" | "centimeter" | "centimeters" | "centimetre" | "centimetres" => length(1e-2),
        "mm" | "millimeter" | "millimeters" | "millimetre" | "millimetres" => length(1e-3),
        "s" | "sec" | "secs" | "second" | "seconds" => time(1.0),
        "min" | "minute" | "minutes" => time(60.0),
        "h" | "hr" | "hour" | "hours" => time(3600.0),
        "d" | "day" | "days" => time(86_400.0),
        "pa" | "pascal" | "pascals" => pressure(1.0),
        "hpa" | "mb" | "mbar" | "millibar" | "millibars" => pressure(100.0),
        "kpa" => pressure(1e3),
        "dbar" | "decibar" | "decibars" => pressure(1e4),
        "bar" => pressure(1e5),
        "kn" | "kt" | "kts" | "knot" | "knots" => velocity(1852.0 / 3600.0),
        "ms-1" | "mps" => velocity(1.0),
        "cms-1" => velocity(0.01),
        "pas-1" => Unit { factor: 1.0, powers: [0, -1, 1] },
        _ => return None,
    })
}

impl Unit {
    /// Parses a unit; `None` if a part of it is unknown.
    pub fn parse(text: &str) -> Option<Self> {
        let text =
            text.trim().replace("**", "").replace('^', "").replace(['{', '}'], "").replace(['·', '*', '(', ')'], " ").replace(" per ", "/");
        let mut unit = NONE;
        for (i, part) in text.split('/').enumerate() {
            for token in part.split_whitespace().flat_map(split_dots) {
                unit = unit.times(factor(token)?, if i == 0 { 1 } else { -1 });
            }
        }
        Some(unit)
    }

    fn times(self, other: Self, power: i32) -> Self {
        let powers = [0, 1, 2].map(|k| self.powers[k] + other.powers[k] * power);
        Self { factor: self.factor * other.factor.powi(power), powers }
    }
}

macro_rules! kinds_of_units {
    ($($name:ident $powers:expr),*) => {
        impl Unit {
            $(pub fn $name(&self) -> bool { self.powers == $powers })*
        }
    };
}
kinds_of_units!(
    is_velocity [1, -1, 0], is_pressure_tendency [0, -1, 1], is_length [1, 0, 0], is_pressure [0, 0, 1], is_time [0, 1, 0],
    is_geopotential [2, -2, 0], is_dimensionless [0, 0, 0]
);

/// `m.s-1` is a product, `0.01` a number.
fn split_dots(token: &str) -> Vec<&str> {
    if token.parse::<f64>().is_ok() { vec![token] } else { token.split('.').filter(|t| !t.is_empty()).collect() }
}

/// A number, or a base unit with an exponent.
fn factor(token: &str) -> Option<Unit> {
    if let Ok(number) = token.parse::<f64>() {
        return (number.is_finite() && number > 0.0).then_some(Unit { factor: number, ..NONE });
    }
    if let Some(unit) = base(token) {
        return Some(unit);
    }
    let letters = token.find(|c: char| !c.is_alphabetic())?;
    let power: i32 = token[letters..].parse().ok().filter(|p: &i32| p.abs() <= 9)?;
    Some(NONE.times(base(&token[..letters])?, power))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn velocities_come_out_in_si() {
        let metres_a_second =
            ["m/s", "m s-1", "m s^-1", "m s**-1", "m.s-1", "meter second-1", "meters/second", "metre per second", "ms-1", "m*s^-1"];
        for text in metres_a_second {
            let unit = Unit::parse(text).unwrap();
            assert!(unit.is_velocity() && unit.factor == 1.0, "{text}");
        }
        for (text, factor) in [("cm/s", 0.01), ("cm s-1", 0.01), ("km h-1", 1.0 / 3.6), ("knots", 0.514_444_4), ("0.01 m/s", 0.01)] {
            let unit = Unit::parse(text).unwrap();
            // Written with seven digits above.
            assert!(unit.is_velocity() && (unit.factor / factor - 1.0).abs() < 1e-6, "{text}");
        }
        let omega = Unit::parse("hPa h-1").unwrap();
        // Two roundings.
        assert!(omega.is_pressure_tendency() && (omega.factor - 1.0 / 36.0).abs() < 1e-15);
    }

    #[test]
    fn other_units_are_told_apart() {
        for text in ["K", "furlong/fortnight", "m s-1 K", "degrees_east", "hours since 2000-01-01", "m s--1", "m s-99"] {
            assert_eq!(Unit::parse(text), None, "{text}");
        }
        for text in ["m2 s-2", "m", "s", "1", "", "N m-2", "W m**-2"] {
            assert!(!Unit::parse(text).is_some_and(|u| u.is_velocity() || u.is_pressure_tendency()), "{text}");
        }
        assert!(Unit::parse("1").unwrap().is_dimensionless() && Unit::parse("").unwrap().is_dimensionless());
        assert!(Unit::parse("hPa").unwrap().is_pressure() && Unit::parse("km").unwrap().is_length());
    }
}
