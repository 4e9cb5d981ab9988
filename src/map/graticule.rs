//! Meridians and parallels, or the ticks of Cartesian axes.

use super::contour::contours;
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

/// Nodes along an edge of a panel over which longitude and latitude are known.
const NODES: usize = 129;

/// Coordinates of nodes over the data of a map, from edge to edge, x fastest.
pub fn nodes_over(view: &View) -> Vec<[f64; 2]> {
    (0..NODES * NODES).map(|n| node(view, [(n % NODES) as f64, (n / NODES) as f64])).collect()
}

/// Coordinates of a node, of which the numbers may be broken.
fn node(view: &View, [i, j]: [f64; 2]) -> [f64; 2] {
    let ([west, south, ..], [x, y]) = (view.region, view.region_extent());
    [west + x * i / (NODES - 1) as f64, south + y * j / (NODES - 1) as f64]
}

/// Meridians and parallels over a map whose axes are neither, from longitudes and latitudes at [`nodes_over`] it. A label stands at the first point of a line:
/// the top of a meridian, the right end of a parallel, or the end that is at the rim of the map if the other is not.
pub fn degrees_over(view: &View, degrees: &[[f64; 2]], scale: f64) -> Vec<GridLine> {
    let Some(&[middle, _]) = degrees.iter().find(|at| at.iter().all(|degree| degree.is_finite())) else { return Vec::new() };
    let near = |longitude: f64, to: f64| to + (longitude - to + 180.0).rem_euclid(360.0) - 180.0;
    let lines = |axis: usize| {
        let values: Vec<f64> = degrees.iter().map(|at| if axis == 0 { near(at[0], middle) } else { at[1] }).collect();
        let (low, high) =
            values.iter().filter(|v| v.is_finite()).fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), v| (a.min(*v), b.max(*v)));
        let count = (view.size[axis] as f64 / (APART * scale)).clamp(2.0, 12.0);
        let step = DEGREES.into_iter().find(|step| (high - low) / step <= count).unwrap_or(60.0);
        let line = move |value: f64| {
            // Where longitudes jump by a whole turn there is no line.
            let apart = |v: f64| if axis == 0 { near(v, value) - value } else { v - value };
            let apart: Vec<f32> = values.iter().map(|v| Some(apart(*v)).filter(|d| d.abs() < 90.0).unwrap_or(f64::NAN) as f32).collect();
            let label = if axis == 0 { longitude(value) } else { latitude(value) };
            contours(&apart, [NODES; 2], 0.0).into_iter().map(move |line| {
                let mut points: Vec<[f64; 2]> = line.into_iter().map(|at| view.pixel(node(view, at))).collect();
                let ends = [points[0], points[points.len() - 1]];
                // Meridians may end at a pole.
                let inside = |at: [f64; 2]| (0..2).map(|k| at[k].min(view.size[k] as f64 - at[k])).fold(f64::INFINITY, f64::min) > 2.0;
                let wanted = if axis == 0 { ends[1][1] < ends[0][1] } else { ends[1][0] > ends[0][0] };
                if (inside(ends[0]), inside(ends[1])) == (true, false) || (wanted && inside(ends[0]) == inside(ends[1])) {
                    points.reverse();
                }
                GridLine { label: label.clone(), points }
            })
        };
        ticks([low, high], step).into_iter().flat_map(line).collect::<Vec<_>>()
    };
    [lines(0), lines(1)].concat()
}
