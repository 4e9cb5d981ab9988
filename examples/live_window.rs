//! Follows a simulation and writes the window of each slide: all nodes of its snapshots, 4 f32 each (u, v, w, and NaN where missing), oldest first.
//!
//! ```text
//! cargo run --release --example live_window -- /dev/shm/ridgewatch-$(id -u)/run 6 windows
//! ```
//! It takes every step, and ends with the simulation.
#![allow(clippy::print_stdout)]

use anyhow::{Context, bail};
use ridgewatch::source::live::{AtEnd, Follow, Live, LiveSettings};
use std::io::Write;
use std::path::PathBuf;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

fn main() -> anyhow::Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [ring, tau, folder] = arguments.as_slice() else { bail!("live_window RING TAU FOLDER") };
    let tau: f64 = tau.parse().with_context(|| format!("TAU {tau:?}: accepted: a number in the simulation's unit of time"))?;
    let folder = PathBuf::from(folder);
    std::fs::create_dir_all(&folder).with_context(|| folder.display().to_string())?;
    let settings = LiveSettings { ring: Some(ring.into()), follow: Follow::Every, at_end: AtEnd::Stop, ..LiveSettings::default() };
    let stop = AtomicBool::new(false);
    let Some(live) = Live::connect(&settings, &stop, &mut |text| eprintln!("{text}"))? else { return Ok(()) };
    println!("{}", live.describe());
    let window = live.follow(tau, 1)?;
    for slide in 0.. {
        let taken = loop {
            match window.next_within(Duration::from_secs(1)) {
                Ok(Some(taken)) => break taken?,
                Ok(None) => return Ok(()),
                // No new step within the second.
                Err(_) => {}
            }
        };
        let mut file = std::io::BufWriter::new(std::fs::File::create(folder.join(format!("window_{slide:06}.f32")))?);
        let mut times = Vec::new();
        for snapshot in taken.window.snapshots() {
            times.push(snapshot.time);
            for value in snapshot.nodes.iter().flatten() {
                file.write_all(&value.to_le_bytes())?;
            }
        }
        file.flush()?;
        println!("slide {slide}: step {}, {} missed, times {times:?}", taken.live.step, taken.live.missed_blocks);
    }
    Ok(())
}
