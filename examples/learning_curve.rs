//! Prints PSNR over seconds of training for the network, base + residual, and the table of the same bytes.
//!
//! `cargo run --release --example learning_curve -- [gyre|turbulence] [seconds] [key=value ...]`, where the keys are those of `[network]` in a
//! scene file. Labels are traced on the fly into a ring, from a share of the time; the error is the root mean square on held-out points, PSNR has
//! the maximum of their reference as peak.
#![allow(clippy::print_stdout)]

#[path = "../tests/network_support/mod.rs"]
mod support;

use ridgewatch::field::analytic::Analytic;
use ridgewatch::field::{Domain, turbulence::Turbulence};
use ridgewatch::flow::{
    Boundary, Direction, FlowMap, Integrator, Interpolation, Normalisation, Precision, Steps, Tracer, VelocitySource, cpu_tracer,
};
use ridgewatch::surrogate::network::NetworkSettings;
use ridgewatch::surrogate::{Kind, SampleRing, Samples, Surrogate, SurrogateSettings, build};
use std::sync::Arc;
use std::time::Instant;

/// PSNR in decibels of the surrogate against traced samples; peak and error in log-stretch, which is FTLE times a constant.
fn psnr(surrogate: &dyn Surrogate, held_out: &Samples) -> f64 {
    let mut predicted = vec![0.0; held_out.len()];
    surrogate.predict(&held_out.points, &mut predicted);
    let square = predicted.iter().zip(&held_out.log_stretch).map(|(p, t)| f64::from(p - t).powi(2)).sum::<f64>() / predicted.len() as f64;
    let peak = held_out.log_stretch.iter().copied().fold(f32::MIN, f32::max);
    20.0 * (f64::from(peak) / square.sqrt()).log10()
}

/// Trains for `seconds` of wall clock, tracing included, and prints a line every few seconds.
fn curve(name: &str, surrogate: &mut dyn Surrogate, tracer: &dyn Tracer, held_out: &Samples, seconds: f64, flow_map: bool) {
    let mut ring = SampleRing::new(1 << 24);
    let (start, mut measuring) = (Instant::now(), 0.0);
    let (mut next, mut steps, mut rollbacks, mut tracing) = (1.0, 0, 0, 0.0);
    let mut seed = 100;
    loop {
        let now = start.elapsed().as_secs_f64() - measuring;
        if now >= next || now >= seconds {
            let before = Instant::now();
            println!(
                "{name:9} {now:6.1} s  {:6.2} dB  {steps:6} steps  {:5.1} M labels, {tracing:4.1} s traced, {rollbacks} rollbacks",
                psnr(surrogate, held_out),
                ring.pushed() as f64 / 1e6
            );
            measuring += before.elapsed().as_secs_f64();
            next += (seconds / 10.0).max(1.0);
            if now >= seconds {
                break;
            }
        }
        // A frame's worth of labels, as long as tracing takes at most a quarter of the time.
        if tracing <= 0.25 * now {
            let before = Instant::now();
            ring.push(&support::traced(tracer, support::uniform_points(seed, 1 << 17), flow_map));
            seed += 1;
            tracing += before.elapsed().as_secs_f64();
        }
        let learned = surrogate.learn(ring.samples(), 0.25_f64.min(seconds - now), u64::MAX);
        steps += learned.steps;
        rollbacks += learned.rollbacks;
    }
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args().skip(1);
    let scene = arguments.next().unwrap_or_else(|| "gyre".into());
    let seconds: f64 = arguments.next().map_or(Ok(30.0), |text| text.parse())?;
    let mut settings = toml::Table::new();
    let mut only = None;
    for argument in arguments {
        match argument.strip_prefix("only=") {
            Some(kind) => only = Some(kind.to_owned()),
            None => settings.extend(argument.parse::<toml::Table>()?),
        }
    }
    let network: NetworkSettings = settings.try_into()?;
    let (source, tau, steps) = match scene.as_str() {
        "gyre" => {
            let flow = Analytic::DoubleGyre { amplitude: 0.1, epsilon: 0.25, omega: std::f64::consts::TAU / 10.0 };
            (VelocitySource::Analytic(flow, Domain::slab([0.0, 0.0], [2.0, 1.0], (0.0, 1.0))), 10.0, 50)
        }
        "turbulence" => {
            let shape = [96, 48, 48];
            let window = Turbulence::easy(shape, 0).window(&Turbulence::grid(shape)?, 12)?;
            (VelocitySource::Window(Arc::new(window)), 11.0, 11)
        }
        other => return Err(format!("unknown scene `{other}`; there are gyre and turbulence").into()),
    };
    let map = |steps, precision| FlowMap {
        tau,
        direction: Direction::Forward,
        integrator: Integrator::Tangent,
        precision,
        steps: Steps::Fixed(steps),
        gap: 1e-6,
        boundary: Boundary::Clamp,
        normalisation: Normalisation::Tau,
        interpolation: Interpolation::Linear,
    };
    // The steps of the labels: their own error (41 dB on turbulence with 11 steps, more on the gyre) stays below the network's.
    let coarse = cpu_tracer(source.clone(), &map(steps, Precision::F32), 0.0)?;
    let fine = cpu_tracer(source, &map(10 * steps, Precision::F64), 0.0)?;
    let domain = coarse.domain().clone();
    let flow_map = network.target == ridgewatch::surrogate::network::Target::FlowMap;
    let held_out = support::traced(&*fine, support::uniform_points(1, 1 << 16), false);
    let wanted = |kind: &str| only.as_deref().is_none_or(|only| only == kind);
    let of = |kind| SurrogateSettings { kind, table_nodes: None };
    let mut bytes = 0;
    if wanted("network") {
        let mut surrogate = build(&of(Kind::Network), &network, &domain, 0, &*coarse)?;
        bytes = surrogate.bytes();
        println!("network: {bytes} bytes");
        curve("network", &mut *surrogate, &*coarse, &held_out, seconds, flow_map);
    }
    if wanted("table") && bytes > 0 {
        let extent = domain.extent();
        let volume: f64 = extent[..domain.dimensions].iter().product();
        let scale = (bytes as f64 / 4.0 / volume).powf(1.0 / domain.dimensions as f64);
        let nodes = std::array::from_fn(|axis| ((extent[axis] * scale) as usize).max(2));
        let start = Instant::now();
        let table = build(&SurrogateSettings { kind: Kind::Table, table_nodes: Some(nodes) }, &network, &domain, 0, &*coarse)?;
        println!(
            "table     {:6.1} s  {:6.2} dB  {nodes:?} nodes, {} bytes",
            start.elapsed().as_secs_f64(),
            psnr(&*table, &held_out),
            table.bytes()
        );
    }
    if wanted("residual") && !flow_map {
        let mut surrogate = build(&of(Kind::Residual), &network, &domain, 0, &*coarse)?;
        println!("residual: {} bytes, at first {:.2} dB", surrogate.bytes(), psnr(&*surrogate, &held_out));
        curve("residual", &mut *surrogate, &*coarse, &held_out, seconds, false);
    }
    Ok(())
}
