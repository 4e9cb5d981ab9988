//! Arrows of the velocity at nodes of the data.

use super::view::View;
use crate::field::{Axis, Geometry, Grid};
use crate::flow::VelocitySource;
use std::collections::HashSet;
use std::sync::Arc;

/// Arrows in pixels, and the speed of the longest.
#[derive(Debug, Clone, PartialEq)]
pub struct Arrows {
    /// Tail and tip of each.
    pub arrows: Vec<[[f64; 2]; 2]>,
    /// Largest speed, in the unit of the velocity.
    pub fastest: f64,
    /// Time of the velocity.
    pub time: f64,
}

/// Arrows some `apart` pixels from each other: at nodes of the snapshot nearest to `time`, of the level nearest to that of the view.
pub fn arrows(view: &View, velocity: &VelocitySource, time: f64, apart: f64) -> Arrows {
    let [west, south, east, north] = view.region;
    let nodes = |k: usize| (view.size[k] as f64 / apart).ceil().max(2.0) as usize;
    let snapshot = match velocity {
        VelocitySource::Window(window) => {
            window.snapshots().min_by(|a, b| (a.time - time).abs().total_cmp(&(b.time - time).abs())).cloned()
        }
        VelocitySource::Analytic(flow, domain) => {
            let third =
                (domain.dimensions == 3).then(|| Axis::uniform("z", "1", view.level, view.level + domain.extent()[2].abs().max(1e-9), 2));
            let axes = [Axis::uniform("x", "1", west, east, nodes(0) + 1), Axis::uniform("y", "1", south, north, nodes(1) + 1)];
            let axes: Option<Vec<Axis>> = axes.into_iter().chain(third).map(Result::ok).collect();
            axes.map(|axes| Arc::new(flow.snapshot(time, &Arc::new(Grid { axes, geometry: Geometry::Cartesian, slab: (0.0, 1.0) }))))
        }
    };
    let Some(snapshot) = snapshot else { return Arrows { arrows: Vec::new(), fastest: 0.0, time } };
    let grid = &snapshot.grid;
    let [nx, ny, _] = grid.shape();
    let level = grid.axes.get(2).map_or(0, |z| {
        let distance = |k: &usize| (z.coordinates()[*k] - view.level).abs();
        (0..z.len()).min_by(|a, b| distance(a).total_cmp(&distance(b))).unwrap_or(0)
    });
    // Every so many nodes, by the mean distance of nodes in pixels.
    let stride = |count: usize, pixels: usize| (apart * (count - 1) as f64 / pixels as f64).round().max(1.0) as usize;
    let strides = [stride(nx, view.size[0]), stride(ny, view.size[1])];
    let mut found = Vec::new();
    for j in (strides[1] / 2..ny).step_by(strides[1]) {
        for i in (strides[0] / 2..nx).step_by(strides[0]) {
            let node = snapshot.nodes[(level * ny + j) * nx + i];
            if node[3].is_nan() {
                continue;
            }
            let place = [grid.axes[0].coordinates()[i], grid.axes[1].coordinates()[j]];
            let [x, y, z] = [node[0], node[1], node[2]].map(f64::from);
            let (along, up) = match grid.geometry {
                Geometry::Cartesian => (x, y),
                Geometry::Sphere { .. } => {
                    let ((sin_lon, cos_lon), (sin_lat, cos_lat)) = (place[0].to_radians().sin_cos(), place[1].to_radians().sin_cos());
                    (-x * sin_lon + y * cos_lon, -sin_lat * (x * cos_lon + y * sin_lon) + z * cos_lat)
                }
            };
            found.push((place, [along, up]));
        }
    }
    let speed = |v: &[f64; 2]| v[0].hypot(v[1]);
    let fastest = found.iter().map(|(_, v)| speed(v)).fold(0.0, f64::max);
    // Nodes crowd near poles.
    let mut taken = HashSet::new();
    let mut arrow = |(place, v): &([f64; 2], [f64; 2])| {
        let share = speed(v) / fastest;
        if share.is_nan() || share < 0.02 {
            return None;
        }
        // A small step along the velocity gives its direction in the plane.
        let small = 1e-4 * (east - west).min(north - south) / speed(v);
        let shrink = if view.is_geographic { place[1].to_radians().cos().max(1e-6) } else { 1.0 };
        let (tail, ahead) = (view.pixel(*place), view.pixel([place[0] + small * v[0] / shrink, place[1] + small * v[1]]));
        let (dx, dy) = (ahead[0] - tail[0], ahead[1] - tail[1]);
        // The square root keeps slow ones visible.
        let length = 1.3 * apart * share.sqrt() / dx.hypot(dy);
        let tip = [tail[0] + length * dx, tail[1] + length * dy];
        let inside = length.is_finite() && [tail, tip].iter().all(|[x, y]| view.place(*x, *y).is_some());
        let cell = tail.map(|c| (c / (0.6 * apart)) as i64);
        (inside && taken.insert(cell)).then_some([tail, tip])
    };
    let arrows = found.iter().filter_map(&mut arrow).collect();
    Arrows { arrows, fastest, time: snapshot.time }
}
