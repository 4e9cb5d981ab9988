//! Flows whose stretch is known, windows, and how they are traced.

use ridgewatch::field::{DomainPoint, EARTH_RADIUS, Window};
use ridgewatch::flow::{Extras, FlowMap, Traced, VelocitySource, cpu_tracer};
use ridgewatch::source::{Archive, SnapshotSource};
use std::sync::Arc;

pub const DAY: f64 = 86_400.0;

/// Arrivals and Jacobians besides the stretch.
pub const EVERYTHING: Extras = Extras { arrival: true, jacobian: true };

pub fn trace(source: &VelocitySource, map: &FlowMap, t0: f64, seeds: &[DomainPoint], extras: Extras) -> Traced {
    let mut out = Traced::default();
    cpu_tracer(source.clone(), map, t0).unwrap().trace(seeds, extras, &mut out);
    out
}

/// All snapshots of an archive.
pub fn window(archive: &mut Archive) -> Arc<Window> {
    let times = archive.times().to_vec();
    let mut window = Window::new(times[times.len() - 1] - times[0]);
    for index in 0..times.len() {
        window.push(Arc::new(archive.read(index).unwrap())).unwrap();
    }
    Arc::new(window)
}

/// Point `i` of the additive recurrence R3 in the unit cube (Roberts 2018): any first points are evenly spread.
pub fn quasi_random(i: usize) -> [f64; 3] {
    [0.754_877_67, 0.569_840_29, 0.438_579_02].map(|r: f64| (0.5 + r * (i + 1) as f64).fract())
}

/// Eastward and northward velocity (m/s) of a rotation of the Earth by `rate` radians a second about (sin tilt, 0, cos tilt); angles in radians.
pub fn rotation(rate: f64, tilt: f64, lon: f64, lat: f64) -> [f64; 2] {
    let speed = rate * EARTH_RADIUS;
    [speed * (tilt.cos() * lat.cos() - tilt.sin() * lon.cos() * lat.sin()), speed * tilt.sin() * lon.sin()]
}

pub type Vector = [f64; 3];

pub fn cross(a: Vector, b: Vector) -> Vector {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

pub fn dot(a: Vector, b: Vector) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

pub fn unit(v: Vector) -> Vector {
    v.map(|c| c / dot(v, v).sqrt())
}

/// Direction of a longitude and latitude in degrees.
pub fn direction(lon: f64, lat: f64) -> Vector {
    let ((sin_lon, cos_lon), (sin_lat, cos_lat)) = (lon.to_radians().sin_cos(), lat.to_radians().sin_cos());
    [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat]
}
