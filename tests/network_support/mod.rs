//! Double gyre (Shadden, Lekien and Marsden 2005) with its tangent flow, traced by a scalar Runge-Kutta method in f64, independent of the
//! program's tracers.
#![allow(dead_code)]

pub mod reference;

use rayon::prelude::*;
use ridgewatch::field::{Domain, DomainPoint, UnitPoint};
use ridgewatch::flow::{Extras, Traced, Tracer};
use ridgewatch::surrogate::network::{Encoding, Input, Loss, NetworkSettings, Target};
use ridgewatch::surrogate::{Predict, Samples};
use std::f64::consts::PI;

/// A = 0.1, eps = 0.25, omega = 2 pi / 10, forward from `start` over `tau`.
pub struct DoubleGyre {
    pub domain: Domain,
    pub start: f64,
    pub tau: f64,
    pub steps: usize,
}

impl DoubleGyre {
    pub fn new(start: f64, tau: f64, steps: usize) -> Self {
        Self { domain: Domain::slab([0.0, 0.0], [2.0, 1.0], (0.0, 1.0)), start, tau, steps }
    }
}

/// d/dt of (x, y, J row-major).
fn rate(t: f64, s: &[f64; 6]) -> [f64; 6] {
    let (a, eps, omega) = (0.1, 0.25, 2.0 * PI / 10.0);
    let (p, q) = (eps * (omega * t).sin(), 1.0 - 2.0 * eps * (omega * t).sin());
    let (x, y) = (s[0], s[1]);
    let (f, df, ddf) = (p * x * x + q * x, 2.0 * p * x + q, 2.0 * p);
    let (sf, cf) = (PI * f).sin_cos();
    let (sy, cy) = (PI * y).sin_cos();
    let u = -PI * a * sf * cy;
    let v = PI * a * cf * sy * df;
    let (ux, uy) = (-PI * PI * a * cf * df * cy, PI * PI * a * sf * sy);
    let (vx, vy) = (PI * a * sy * (-PI * sf * df * df + cf * ddf), PI * PI * a * cf * cy * df);
    [u, v, ux * s[2] + uy * s[4], ux * s[3] + uy * s[5], vx * s[2] + vy * s[4], vx * s[3] + vy * s[5]]
}

fn advect(start: f64, tau: f64, steps: usize, DomainPoint(point): DomainPoint) -> [f64; 6] {
    let mut s = [f64::from(point[0]), f64::from(point[1]), 1.0, 0.0, 0.0, 1.0];
    let h = tau / steps as f64;
    let along = |s: &[f64; 6], k: &[f64; 6], h: f64| -> [f64; 6] { std::array::from_fn(|i| s[i] + h * k[i]) };
    for step in 0..steps {
        let t = start + h * step as f64;
        let a = rate(t, &s);
        let b = rate(t + h / 2.0, &along(&s, &a, h / 2.0));
        let c = rate(t + h / 2.0, &along(&s, &b, h / 2.0));
        let d = rate(t + h, &along(&s, &c, h));
        s = std::array::from_fn(|i| s[i] + h / 6.0 * (a[i] + 2.0 * b[i] + 2.0 * c[i] + d[i]));
    }
    s
}

impl Tracer for DoubleGyre {
    fn domain(&self) -> &Domain {
        &self.domain
    }
    fn start(&self) -> f64 {
        self.start
    }
    fn tau(&self) -> f64 {
        self.tau
    }
    fn steps(&self) -> usize {
        self.steps
    }
    fn trace(&self, seeds: &[DomainPoint], extras: Extras, out: &mut Traced) {
        let states: Vec<[f64; 6]> = seeds.par_iter().map(|&p| advect(self.start, self.tau, self.steps, p)).collect();
        out.log_stretch = states
            .iter()
            .map(|s| {
                let (a, b, c) = (s[2] * s[2] + s[4] * s[4], s[2] * s[3] + s[4] * s[5], s[3] * s[3] + s[5] * s[5]);
                let largest = (a + c) / 2.0 + (((a - c) / 2.0).powi(2) + b * b).sqrt();
                (0.5 * largest.ln()) as f32
            })
            .collect();
        out.lifetime_share = vec![1.0; seeds.len()];
        out.arrival = if extras.arrival {
            states.iter().zip(seeds).map(|(s, p)| DomainPoint([s[0] as f32, s[1] as f32, p.0[2]])).collect()
        } else {
            Vec::new()
        };
        let matrix = |s: &[f64; 6]| [s[2] as f32, s[3] as f32, 0.0, s[4] as f32, s[5] as f32, 0.0, 0.0, 0.0, 1.0];
        out.jacobian = if extras.jacobian { states.iter().map(matrix).collect() } else { Vec::new() };
    }
}

/// Uniform points of the unit domain, from a seed.
pub fn uniform_points(seed: u64, count: usize) -> Vec<UnitPoint> {
    let mut state = seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1;
    let mut random = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 40) as f32 / (1_u64 << 24) as f32
    };
    (0..count).map(|_| UnitPoint(std::array::from_fn(|_| random()))).collect()
}

/// Traced samples at unit points, flow-map labels included, in unit coordinates.
pub fn traced(tracer: &dyn Tracer, points: Vec<UnitPoint>, flow_map: bool) -> Samples {
    let domain = tracer.domain();
    let seeds: Vec<DomainPoint> = points.iter().map(|&p| domain.from_unit(p)).collect();
    let mut out = Traced::default();
    tracer.trace(&seeds, Extras { arrival: flow_map, jacobian: flow_map }, &mut out);
    let extent = domain.extent();
    let scaled = |j: &[f32; 9]| std::array::from_fn(|i| j[i] * (extent[i % 3] / extent[i / 3]) as f32);
    Samples {
        points,
        log_stretch: out.log_stretch,
        arrival: out.arrival.iter().map(|&p| domain.to_unit_unclamped(p)).collect(),
        jacobian: out.jacobian.iter().map(scaled).collect(),
        times: Vec::new(),
    }
}

/// Root mean square error of the predicted log-stretch.
pub fn rms(surrogate: &dyn Predict, samples: &Samples) -> f64 {
    let mut predicted = vec![0.0; samples.len()];
    surrogate.predict(&samples.points, &mut predicted).unwrap();
    let sum: f64 = predicted.iter().zip(&samples.log_stretch).map(|(p, t)| f64::from(p - t).powi(2)).sum();
    (sum / samples.len() as f64).sqrt()
}

/// A network whose gradients are checked.
pub struct Case {
    pub name: &'static str,
    pub settings: NetworkSettings,
    pub axes: &'static [usize],
}

/// Every kind of encoding, loss and target, every number of axes and features; widths and depths that fill blocks of 16 and that do not.
pub fn cases() -> Vec<Case> {
    let small = NetworkSettings {
        levels: Some(3),
        features: 2,
        log2_table: Some(7),
        base_resolution: Some(4),
        growth: Some(2.0),
        octaves: 4,
        width: 16,
        batch: Some(300),
        learning_rate: Some(1e-2),
        ..NetworkSettings::default()
    };
    let case = |name, axes, change: fn(&mut NetworkSettings)| {
        let mut settings = small.clone();
        change(&mut settings);
        Case { name, settings, axes }
    };
    let (plane, space) = (&[0, 1][..], &[0, 1, 2][..]);
    let flow_map: fn(&mut NetworkSettings) = |s| (s.target, s.jacobian_weight) = (Target::FlowMap, 0.3);
    vec![
        case("2 axes", plane, |_| ()),
        case("3 axes, width 64", space, |s| s.width = 64),
        case("8 levels, finer than 8 samples per node", space, |s| (s.levels, s.log2_table) = (Some(8), Some(12))),
        case("4 features, width 128", space, |s| (s.features, s.width) = (4, 128)),
        case("8 features, x and z", &[0, 2], |s| s.features = 8),
        case("1 feature, 1 axis, odd width", &[1], |s| (s.features, s.width) = (1, 21)),
        case("one hidden layer", plane, |s| s.hidden_layers = 1),
        case("frequency, 4 layers of 40", plane, |s| (s.encoding, s.hidden_layers, s.width) = (Encoding::Frequency, 4, 40)),
        case("wide, tables", space, |s| s.width = 130),
        case("deep, frequency", plane, |s| (s.encoding, s.hidden_layers, s.width) = (Encoding::Frequency, 6, 25)),
        case("2 axes and start", plane, |s| s.inputs = vec![Input::Start]),
        case("x, z and duration, wide", &[0, 2], |s| (s.width, s.inputs) = (130, vec![Input::Duration])),
        case("3 axes and start", space, |s| s.inputs = vec![Input::Start]),
        case("frequency, 3 axes, start and duration", space, |s| {
            (s.encoding, s.inputs) = (Encoding::Frequency, vec![Input::Duration, Input::Start]);
        }),
        case("flow map, 2 axes and start", plane, |s| {
            (s.target, s.jacobian_weight, s.inputs) = (Target::FlowMap, 0.3, vec![Input::Start]);
        }),
        case("published loss", plane, |s| (s.loss, s.mean_penalty) = (Loss::Published, 0.7)),
        case("flow map, 2 axes", plane, flow_map),
        case("flow map, 3 axes", space, flow_map),
        case("flow map, frequency", plane, |s| {
            (s.target, s.jacobian_weight, s.encoding, s.octaves) = (Target::FlowMap, 0.3, Encoding::Frequency, 2);
        }),
    ]
}
