//! Meridians and parallels, or the ticks of Cartesian axes.

use super::view::View;
use super::words::{even_step, number, ticks};
use crate::render::Projection;

/// A line of the graticule.
#[derive(Debug, Clone, PartialEq)]
pub struct GridLine {
    /// Name, such as `30°W`.
    pub label: String,
    /// Points in pixels. The label stands beyond the first one.
    pub points: Vec<[f64; 2]>,
}

/// Steps of degrees that are in use on maps.
const DEGREES: [f64; 12] = [0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 15.0, 20.0, 30.0, 45.0, 60.0];
/// Pixels between two lines, at least.
const APART: f64 = 70.0;
/// Points of a line.
const POINTS: usize = 120;

/// Unit of the labels of Cartesian axes: kilometres for many metres.
pub fn axis_unit(unit: &str, extent: f64) -> (&str, f64) {
    match unit {
        "m" if extent >= 5000.0 => ("km", 1000.0),
        "1" => ("", 1.0),
        other => (other, 1.0),
    }
}

/// A degree of longitude as people write it.
pub fn longitude(degrees: f64) -> String {
    let east = (degrees + 180.0).rem_euclid(360.0) - 180.0;
    match east {
        e if e.abs() < 1e-9 => "0°".into(),
        e if (e.abs() - 180.0).abs() < 1e-9 => "180°".into(),
        e => format!("{}°{}", number(e.abs()), if e > 0.0 { "E" } else { "W" }),
    }
}

/// A degree of latitude as people write it.
pub fn latitude(degrees: f64) -> String {
    match degrees {
        d if d.abs() < 1e-9 => "0°".into(),
        d => format!("{}°{}", number(d.abs()), if d > 0.0 { "N" } else { "S" }),
    }
}

/// Lines of constant first coordinate and of constant second coordinate. `divisors`: units of the labels of Cartesian axes. `scale`: size of the text.
pub fn graticule(view: &View, divisors: [f64; 2], scale: f64) -> [Vec<GridLine>; 2] {
    let [west, south, east, north] = view.region;
    let ranges = [[west, east], [south, north]];
    let polar = match view.projection {
        Projection::Polar { pole, .. } => Some(pole),
        _ => None,
    };
    [0, 1].map(|axis| {
        let [low, high] = ranges[axis];
        // Meridians of a polar map go around it; parallels cross half of it.
        let pixels = view.size[axis] as f64
            * if polar.is_none() {
                1.0
            } else if axis == 0 {
                2.0
            } else {
                0.5
            };
        let count = (pixels / (APART * scale)).clamp(2.0, 12.0);
        let step = if view.is_geographic {
            DEGREES.into_iter().find(|step| (high - low) / step <= count).unwrap_or(60.0)
        } else {
            even_step(high - low, (count / 2.0).max(2.0))
        };
        // On a polar map, the line at which a full circle closes is drawn once, and the pole is no line.
        let is_drawn = |v: &f64| polar.is_none() || if axis == 0 { v - low < 360.0 } else { v.abs() < 90.0 };
        let shown = ticks([low, high], step).into_iter().filter(is_drawn);
        let line = |value: f64| {
            let label = match (view.is_geographic, axis) {
                (true, 0) => longitude(value),
                (true, _) => latitude(value),
                _ => number(value / divisors[axis]),
            };
            let [from, to] = if axis == 0 && polar == Some(-1.0) { [north, south] } else { ranges[1 - axis] };
            let at = |k: usize| from + (to - from) * k as f64 / POINTS as f64;
            let place = |other: f64| if axis == 0 { [value, other] } else { [other, value] };
            GridLine { label, points: (0..=POINTS).map(|k| view.pixel(place(at(k)))).collect() }
        };
        shown.map(line).collect()
    })
}
