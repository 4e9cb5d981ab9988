//! `ridgewatch publish`: publishes an archive as a simulation does.

use super::common::{Common, Usage, dimensions, located, opening, print_json, print_text, ring_folder, scene};
use super::{messages, signals};
use anyhow::{Context, Result, bail};
use ridgewatch::field::{Axis, Geometry, Grid, Snapshot};
use ridgewatch::progress::Work;
use ridgewatch::run::{RunError, open_snapshots};
use ridgewatch::source::SnapshotSource;
use ridgewatch_wire::{AxisDescription, BlockExtent, Description, Element, Field, Policy, Producer};
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

/// Options of `publish`.
#[derive(Debug, clap::Args)]
pub struct Options {
    /// A scene file (.toml) with an archive or the turbulence, or data files.
    #[arg(required = true, value_name = "CONFIG | FILES")]
    paths: Vec<PathBuf>,
    /// The ring folder; by default the environment variable RIDGEWATCH_RING names it.
    #[arg(long, value_name = "FOLDER")]
    ring: Option<PathBuf>,
    /// Steps a second; by default as fast as they can be read.
    #[arg(long, value_name = "STEPS", value_parser = rate)]
    rate: Option<f64>,
    /// End after N steps. A shorter archive is repeated with increasing times.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    steps: Option<u64>,
    /// Number of blocks along x, y and z, as of a decomposed simulation.
    #[arg(long, default_value = "1x1x1", value_name = "AxBxC", value_parser = blocks)]
    blocks: [u64; 3],
    /// Number of steps that a ring holds.
    #[arg(long, default_value_t = 4, value_name = "N")]
    slots: u32,
    /// Maximum wait for ridgewatch to take a step, in milliseconds; 0: never wait.
    #[arg(long, default_value_t = 0, value_name = "MILLISECONDS")]
    wait: u64,
}

/// Parses the steps a second. The minimum keeps the time of a step within the range of clocks.
fn rate(word: &str) -> Result<f64, String> {
    word.parse().ok().filter(|rate: &f64| rate.is_finite() && *rate >= 1e-6).ok_or_else(|| "accepted: a number from 0.000001".to_owned())
}

fn blocks(text: &str) -> Result<[u64; 3], String> {
    match dimensions::<u64>(text).as_deref() {
        Some(&[x, y, z]) if x > 0 && y > 0 && z > 0 && x.saturating_mul(y).saturating_mul(z) <= 4096 => Ok([x, y, z]),
        _ => Err("accepted: AxBxC, at most 4096 blocks".into()),
    }
}

/// Publishes.
pub fn run(common: &Common, options: Options) -> Result<()> {
    let scene = scene(common, &options.paths)?;
    let spinner = opening(&scene);
    let mut source = open_snapshots(&scene.settings()).map_err(|error| located(&scene, error, RunError::refused))?;
    drop(spinner);
    let ring = ring_folder(options.ring.as_deref())?;
    let grid = source.grid().clone();
    let shape = grid.shape().map(|n| n as u64);
    if (0..3).any(|k| options.blocks[k] > shape[k]) {
        bail!(Usage(format!("--blocks {:?}: the grid has {shape:?} nodes", options.blocks)));
    }
    let policy = if options.wait == 0 { Policy::NewestWins } else { Policy::Wait(Duration::from_millis(options.wait)) };
    // Identifies this start; another one may have other blocks.
    let start = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_nanos() as u64);
    let whole = Description { start, ..description(&grid, &source.describe().time_unit) };
    let producers: Result<Vec<Producer>, _> = parts(shape, options.blocks)
        .into_iter()
        .map(|block| Producer::open(&ring, Description { block, ..whole.clone() }, options.slots, policy))
        .collect();
    let producers = producers.context("cannot publish")?;
    messages::note(format_args!("publishing {} steps of {shape:?} nodes into {}", source.times().len(), ring.display()));
    source.describe().notes.iter().for_each(messages::note);
    let (rate, steps) = (options.rate, options.steps.unwrap_or(source.times().len() as u64));
    let bar = messages::progress(Some(steps));
    let (steps, overwrote, seconds) = signals::until_stopped(|| (), |stop| play(&mut *source, &producers, rate, steps, stop, &bar))?;
    bar.finish_and_clear();
    if common.json {
        return print_json(&serde_json::json!({ "steps": steps, "overwrote": overwrote, "seconds": seconds }));
    }
    print_text(format_args!("{steps} steps in {seconds:.2} s; {overwrote} blocks were overwritten before they were taken"));
    Ok(())
}

/// Maximum size of an archive that is read before the first step, so that the disk does not limit the rate.
const MAX_HELD_BYTES: usize = 4 << 30;

/// Publishes `steps` steps. Returns their number, the number of blocks overwritten before they were read, and the seconds.
fn play(
    source: &mut dyn SnapshotSource,
    producers: &[Producer],
    rate: Option<f64>,
    steps: u64,
    stop: &AtomicBool,
    bar: &indicatif::ProgressBar,
) -> Result<(u64, u64, f64)> {
    let times = source.times().to_vec();
    // Time of one pass; the interval between two passes is the last one of the archive.
    let round = times[times.len() - 1] - times[0] + if times.len() > 1 { times[times.len() - 1] - times[times.len() - 2] } else { 1.0 };
    let wanted = times.len().min(usize::try_from(steps).unwrap_or(usize::MAX));
    let mut held = Vec::new();
    if wanted.saturating_mul(source.grid().nodes()).saturating_mul(12) <= MAX_HELD_BYTES {
        let work = Work::begin("reading the archive");
        for index in 0..wanted {
            if stop.load(Ordering::Relaxed) {
                return Ok((0, 0, 0.0));
            }
            held.push(planes(&source.read(index)?));
            work.reached(index + 1, wanted);
        }
    }
    bar.reset_eta();
    let (begin, mut overwrote) = (Instant::now(), 0);
    for step in 0..steps {
        let index = (step % times.len() as u64) as usize;
        let read;
        let planes = match held.get(index) {
            Some(planes) => planes,
            None => {
                read = planes(&source.read(index)?);
                &read
            }
        };
        if let Some(rate) = rate {
            let due = Duration::try_from_secs_f64(step as f64 / rate).unwrap_or(Duration::MAX);
            while begin.elapsed() < due && !stop.load(Ordering::Relaxed) {
                std::thread::sleep((due - begin.elapsed().min(due)).min(Duration::from_millis(50)));
            }
        }
        if stop.load(Ordering::Relaxed) {
            return Ok((step, overwrote, begin.elapsed().as_secs_f64()));
        }
        let time = times[index] + round * (step / times.len() as u64) as f64;
        for producer in producers {
            let whole = producer.description();
            let ([nx, ny, _], [ox, oy, oz]) = (whole.shape(), whole.block.offset);
            let first = (ox + nx * (oy + ny * oz)) as usize;
            let components: Vec<*const u8> = planes[..whole.components()].iter().map(|plane| plane[first..].as_ptr().cast()).collect();
            let field = Field { components: &components, element: Element::F32, strides: [1, nx as isize, (nx * ny) as isize] };
            // SAFETY: each plane has one value for each node of the grid, which contains the block.
            overwrote += u64::from(unsafe { producer.publish(step, time, &field) }?.overwrote);
        }
        bar.inc(1);
    }
    Ok((steps, overwrote, begin.elapsed().as_secs_f64()))
}

/// Components u, v and w as of a simulation; NaN at missing cells.
fn planes(snapshot: &Snapshot) -> [Vec<f32>; 3] {
    let grid = &snapshot.grid;
    let [nx, ny, _] = grid.shape();
    let mut planes: [Vec<f32>; 3] = std::array::from_fn(|_| Vec::with_capacity(snapshot.nodes.len()));
    for (i, node) in snapshot.nodes.iter().enumerate() {
        let value = if node[3].is_nan() {
            [f32::NAN; 3]
        } else {
            match grid.geometry {
                Geometry::Cartesian => [node[0], node[1], node[2]],
                // From geocentric components to eastward and northward; node[3] is the velocity along the third axis.
                Geometry::Sphere { .. } => {
                    let (sin_lon, cos_lon) = grid.axes[0].coordinates()[i % nx].to_radians().sin_cos();
                    let (sin_lat, cos_lat) = grid.axes[1].coordinates()[i / nx % ny].to_radians().sin_cos();
                    let [x, y, z] = [node[0], node[1], node[2]].map(f64::from);
                    let east = y * cos_lon - x * sin_lon;
                    let north = z * cos_lat - (x * cos_lon + y * sin_lon) * sin_lat;
                    [east as f32, north as f32, node[3]]
                }
            }
        };
        (0..3).for_each(|k| planes[k].push(value[k]));
    }
    planes
}

/// Describes the grid as a simulation does.
fn description(grid: &Grid, time_unit: &str) -> Description {
    // The wire limits the length of names, which are for people.
    let short = |text: &str| text.chars().filter(|c| !c.is_control()).take(16).collect::<String>();
    let axis = |axis: &Axis| AxisDescription {
        name: short(axis.name()),
        unit: short(axis.units()),
        coordinates: axis.coordinates().to_vec(),
        period: axis.period(),
    };
    let geometry = match grid.geometry {
        Geometry::Cartesian => ridgewatch_wire::Geometry::Cartesian,
        Geometry::Sphere { radius } => ridgewatch_wire::Geometry::Sphere { radius },
    };
    Description::whole(geometry, grid.axes.iter().map(axis).collect(), &short(time_unit))
}

/// Blocks of about equal size, x fastest.
fn parts(shape: [u64; 3], blocks: [u64; 3]) -> Vec<BlockExtent> {
    let count = blocks.iter().product::<u64>() as u32;
    let begin = |k: usize, b: u64| shape[k] * b / blocks[k];
    (0..count)
        .map(|index| {
            let n = u64::from(index);
            let at = [n % blocks[0], n / blocks[0] % blocks[1], n / blocks[0] / blocks[1]];
            let offset: [u64; 3] = std::array::from_fn(|k| begin(k, at[k]));
            let extent = std::array::from_fn(|k| begin(k, at[k] + 1) - offset[k]);
            BlockExtent { index, count, offset, extent }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Arc;

    #[test]
    fn blocks_cover_the_grid() {
        let parts = parts([7, 5, 3], [3, 2, 1]);
        assert_eq!(parts.len(), 6);
        assert_eq!(parts.iter().map(|p| p.extent.iter().product::<u64>()).sum::<u64>(), 105);
        assert_eq!((parts[5].offset, parts[5].extent), ([4, 2, 0], [3, 3, 3]));
    }

    #[test]
    fn velocities_on_the_sphere_come_back() {
        let lon = Axis::uniform("lon", "", 0.0, 300.0, 6).unwrap().with_period(360.0);
        let lat = Axis::uniform("lat", "", -80.0, 80.0, 5).unwrap();
        let z = Axis::uniform("z", "", 0.0, 1.0, 2).unwrap();
        let grid = Arc::new(Grid { axes: vec![lon, lat, z], geometry: Geometry::Sphere { radius: 1.0 }, slab: (0.0, 1.0) });
        let [u, v, w] = [1.0f32, -2.0, 3.0].map(|a| (0..60).map(|i| a + i as f32 * 0.1).collect::<Vec<_>>());
        let back = planes(&Snapshot::from_components(0.0, grid, &u, &v, &w));
        for (found, expected) in back.iter().zip([&u, &v, &w]) {
            assert!(found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-5));
        }
    }
}
