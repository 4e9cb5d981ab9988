//! Networks and residuals in the panel of FTLE samples, trained for some seconds.

use super::failed;
use super::ftle::{Bench, MIN_BATCH, Opened, Points, fits, scaled, surrogate_of, tracer_of};
use crate::backend::{Backend, Surrogate, audit};
use crate::run::RunError;
use crate::surrogate::network::{Architecture, Encoding, NetworkSettings};
use crate::surrogate::{Kind, ReplayBuffer, SurrogateSettings, Trace};
use std::time::Instant;

/// Seconds for which networks are trained before each measurement, the tracing of their labels included.
const TRAINED: [f64; 3] = [1.0, 3.0, 10.0];
/// Seconds of training between fresh labels, at first and at most, and how often a label is trained on.
const SLICES: [f64; 2] = [0.02, 0.25];
const REUSE: u64 = 4;
/// Labels before the first training, and most fresh ones afterwards.
const FIRST_LABELS: usize = 1 << 16;
const MAX_FRESH: usize = 1 << 24;
/// A small network has a table of 2^-5 or less, and one sixteenth of the entries of all levels at most.
const SMALLER: u32 = 5;
const FEWER: usize = 16;

/// Networks over encodings, sizes and seconds of training, and base + residual.
pub(super) fn networks<B: Backend>(bench: &mut Bench<'_, '_>, backend: &mut B) -> Result<(), RunError> {
    let map = bench.opened.plan.map.clone();
    let Some(tracer) = tracer_of(bench, backend, "labels for networks", &map)? else { return Ok(()) };
    let is_gpu = bench.charting.device.is_gpu();
    let own = bench.opened.own_nodes(is_gpu);
    let scene = NetworkSettings { inputs: Vec::new(), start_range: None, ..bench.opened.plan.scene.network.clone() };
    let suited = bench.opened.shape().filter(|_| is_gpu).map_or(scene.clone(), |shape| scene.suited_to(shape));
    let domain = &bench.opened.plan.domain;
    let axes: Vec<usize> = (0..domain.dimensions).collect();
    let entries =
        |network: &NetworkSettings| Architecture::new(network, &axes, domain.lengths()).map_or(0, |network| network.table_entries());
    // Levels that are stored densely do not shrink with the table at once.
    let sizes = (4..=suited.log2_table().saturating_sub(SMALLER).max(4)).rev();
    let mut smaller = sizes.map(|log2_table| NetworkSettings { log2_table: Some(log2_table), ..suited.clone() });
    let small = smaller.find(|network| entries(network) * FEWER <= entries(&suited)).filter(|_| entries(&suited) > 0);
    let frequency = NetworkSettings { encoding: Encoding::Frequency, hidden_layers: 8, width: 256, learning_rate: None, ..scene };
    let narrow = NetworkSettings { hidden_layers: 4, width: 64, ..frequency.clone() };
    let mut variants = vec![
        ("base + residual", Kind::Residual, scaled(own, 0.5), suited.clone()),
        ("network", Kind::Network, own, suited),
        ("network", Kind::Network, own, if is_gpu { frequency } else { narrow }),
    ];
    // The large ones of both kinds come first.
    if let Some(small) = small {
        variants.insert(2, ("base + residual", Kind::Residual, scaled(own, 0.5), small.clone()));
        variants.insert(3, ("network", Kind::Network, own, small));
    }
    variants.retain(|(_, kind, _, network)| *kind == Kind::Network || network.encoding == Encoding::HashGrid);
    let mut pupils = Vec::new();
    for (name, kind, nodes, network) in variants {
        let size = match network.encoding {
            Encoding::HashGrid => format!("{}x{}, {} entries", network.levels(), network.features, thousands(entries(&network))),
            Encoding::Frequency => format!("frequency, {} x {}", network.hidden_layers, network.width),
        };
        let what = format!("{name}, {size}");
        let count = if kind == Kind::Residual { nodes.iter().product() } else { 0 };
        if !fits(bench, &what, count, count) {
            continue;
        }
        let began = Instant::now();
        let settings = SurrogateSettings { kind, table_nodes: Some(nodes), ..SurrogateSettings::default() };
        let Some(surrogate) = surrogate_of(bench, backend, &what, &settings, &network, &tracer)? else { continue };
        let lessons = Lessons::new(bench.opened);
        pupils.push(Pupil { name, size, what, surrogate, built: began.elapsed().as_secs_f64(), lessons, ended: false });
    }
    // All have first figures before any is trained for long, in case that time ends.
    for seconds in TRAINED {
        for Pupil { name, size, what, surrogate, built, lessons, ended } in pupils.iter_mut().filter(|pupil| !pupil.ended) {
            *ended = !bench.charting.has_time_for(&format!("{what}, {seconds} s of training"));
            if *ended {
                continue;
            }
            let (before, is_late) = (lessons.steps, lessons.seconds >= seconds);
            while lessons.seconds < seconds {
                bench.charting.pool.install(|| lessons.give(surrogate, &tracer, seconds))?;
            }
            if lessons.steps == before {
                bench.charting.skip(
                    format_args!("{what}, {seconds} s of training"),
                    if is_late { "the training before it took longer" } else { "no optimizer step ended in time" },
                );
                continue;
            }
            let frozen = surrogate.freeze().map_err(failed)?;
            bench.measure_predictor(name, format!("{size}, {seconds} s"), *built + lessons.seconds, &frozen)?;
        }
    }
    Ok(())
}

/// A surrogate in training.
struct Pupil<'a, S> {
    name: &'static str,
    size: String,
    /// Name and size.
    what: String,
    surrogate: S,
    /// Seconds that building it took.
    built: f64,
    lessons: Lessons<'a>,
    /// No time was left for it.
    ended: bool,
}

/// A count in thousands or millions.
fn thousands(count: usize) -> String {
    match count {
        0..10_000 => count.to_string(),
        10_000..999_500 => format!("{:.0}k", count as f64 / 1e3),
        _ => format!("{:.1}M", count as f64 / 1e6),
    }
}

/// Training on labels at uniform random points that are traced on the way, as the frames of a run trace theirs.
struct Lessons<'a> {
    opened: &'a Opened,
    /// Labels on the host.
    buffer: ReplayBuffer,
    /// Points traced so far, and in the next turn.
    drawn: u64,
    fresh: usize,
    /// Seconds of the next training.
    slice: f64,
    /// Optimizer steps so far.
    steps: u64,
    /// Seconds of tracing and training so far.
    seconds: f64,
}

impl<'a> Lessons<'a> {
    fn new(opened: &'a Opened) -> Self {
        let buffer = ReplayBuffer::new(opened.plan.scene.training.replay_buffer);
        Self { opened, buffer, drawn: 0, fresh: FIRST_LABELS, slice: SLICES[0], steps: 0, seconds: 0.0 }
    }

    /// Traces fresh labels and trains on all for a slice of time, which doubles up to the longest. Ends at about `end` seconds in all.
    fn give<S: Surrogate<Tracer = T>, T: Trace>(&mut self, surrogate: &mut S, tracer: &T, end: f64) -> Result<(), RunError> {
        const STREAM: u32 = 4;
        let began = Instant::now();
        let scene = &self.opened.plan.scene;
        if !surrogate.trace_labels(tracer, scene.seed, self.drawn, self.fresh).map_err(failed)? {
            let numbers = self.drawn as u32..self.drawn as u32 + self.fresh as u32;
            let points = Points::numbered(self.opened, numbers, STREAM);
            self.buffer.push(&audit::trace(tracer, &points.unit, scene.network.label_extras()).map_err(failed)?.samples);
        }
        self.drawn += self.fresh as u64;
        let traced = began.elapsed().as_secs_f64();
        let left = (end - self.seconds - traced).clamp(0.01, self.slice);
        let learned = surrogate.learn(&self.buffer, left, u64::MAX).map_err(failed)?;
        // Tracing takes no longer than training.
        let as_long = self.fresh as f64 * learned.seconds / traced;
        self.fresh = ((learned.samples / REUSE) as usize).min(as_long as usize).clamp(MIN_BATCH, MAX_FRESH);
        self.slice = SLICES[1].min(2.0 * self.slice);
        self.steps += learned.steps;
        self.seconds += began.elapsed().as_secs_f64();
        Ok(())
    }
}
