//! Prints the learning curve of surrogates in a run: PSNR over the whole domain against wall-clock seconds, for the network, for base + residual, and
//! for the traced table of the same bytes.
//!
//! `cargo run --release --example learning_curve -- CONFIG SECONDS [key=value ...]`. Each run is the ordinary cycle on the first slide of the
//! scene: labels are those that rendering and its audits traced, tracing and rendering count as time. PSNR is the records'
//! `surrogate_psnr`: on audit points that the surrogate had not seen, with their largest traced value as peak.
#![allow(clippy::print_stdout)]

use ridgewatch::config::SceneFile;
use ridgewatch::run::{self, Event, RunOptions, Setup};
use ridgewatch::surrogate::Kind;
use std::error::Error;
use std::path::Path;
use std::sync::atomic::AtomicBool;

/// Runs the scene with one kind of surrogate; returns its bytes.
fn curve(mut scene: SceneFile, kind: Kind, nodes: Option<[usize; 3]>, seconds: f64) -> Result<usize, Box<dyn Error>> {
    scene.surrogate.kind = kind;
    scene.surrogate.table_nodes = nodes;
    (scene.time.slides, scene.time.warmup_frames) = (Some(1), 0);
    // A table does not learn, so a few frames suffice.
    scene.time.frames_per_slide = if kind == Kind::Table { 3 } else { 100_000 };
    let options = RunOptions { seconds: Some(seconds), ..RunOptions::default() };
    let mut next = 0.0;
    let mut print = |event: Event| {
        if let Event::Frame(frame) = event {
            let record = &frame.record;
            let now = record.seconds.elapsed;
            if now >= next || now >= seconds {
                next = now + seconds / 12.0;
                let (psnr, name) = (record.surrogate_psnr.unwrap_or(f64::NAN), record.surrogate.as_deref().unwrap_or("none"));
                println!("{name:9} {now:6.1} s  {psnr:6.2} dB  traced {:5.1} %", 100.0 * record.traced_share);
            }
        }
    };
    let report = run::run(Setup::new(scene.settings())?, &options, &mut print, &AtomicBool::new(false))?;
    println!("          {} bytes, {} optimizer steps", report.surrogate_bytes, report.train_steps);
    Ok(report.surrogate_bytes)
}

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let (Some(config), Some(seconds)) = (arguments.next(), arguments.next()) else {
        return Err("usage: learning_curve CONFIG SECONDS [key=value ...]".into());
    };
    let (seconds, settings): (f64, Vec<String>) = (seconds.parse()?, arguments.collect());
    let scene = SceneFile::read(Path::new(&config), &settings)?;
    let bytes = curve(scene.clone(), Kind::Network, None, seconds)?;
    let setup = Setup::new(scene.settings())?;
    let (lengths, axes) = (setup.plan.domain.lengths(), setup.plan.domain.dimensions);
    let volume: f64 = lengths[..axes].iter().product();
    let scale = (bytes as f64 / 4.0 / volume).powf(1.0 / axes as f64);
    let nodes = std::array::from_fn(|axis| if axis < axes { ((lengths[axis] * scale) as usize).max(2) } else { 2 });
    println!("table of {nodes:?} nodes");
    curve(scene.clone(), Kind::Table, Some(nodes), seconds)?;
    let base = scene.surrogate.table_nodes;
    curve(scene, Kind::Residual, base, seconds)?;
    Ok(())
}
