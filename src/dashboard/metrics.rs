//! Records as text for Prometheus (exposition format 0.0.4): gauges of the newest one, counters over all that this server received.

use crate::run::{FrameRecord, StageSeconds};
use std::fmt::Write;
use std::time::{SystemTime, UNIX_EPOCH};

/// Media type of the text.
pub(super) const MEDIA_TYPE: &str = "text/plain; version=0.0.4; charset=utf-8";

/// What is known of the records.
#[derive(Debug, Default)]
pub(super) struct Metrics {
    totals: Totals,
    newest: Option<(FrameRecord, SystemTime)>,
}

/// Sums over all records that were received, also of several runs.
#[derive(Debug, Default)]
struct Totals {
    records: u64,
    unreadable: u64,
    queries: u64,
    traced: u64,
    missing: u64,
    over_budget: u64,
    over_tolerance: u64,
    warnings: u64,
    commands: u64,
    optimizer_steps: u64,
    training_samples: u64,
    checkpoints: u64,
    checkpoints_failed: u64,
    seconds: StageSeconds,
}

/// State of the server beside the records.
pub(super) struct Server {
    pub is_connected: bool,
    pub pages: usize,
}

impl Metrics {
    /// Takes in a record, as JSON.
    pub fn take(&mut self, json: &str) {
        self.totals.records += 1;
        match serde_json::from_str::<FrameRecord>(json) {
            Ok(record) => {
                self.totals.add(&record);
                self.newest = Some((record, SystemTime::now()));
            }
            // Of another version.
            Err(_) => self.totals.unreadable += 1,
        }
    }

    pub fn text(&self, server: &Server) -> String {
        let mut text = Text::default();
        text.gauge("publisher_connected", "1 while the publisher of the frames is connected, else 0.", f64::from(server.is_connected));
        text.gauge("pages", "Open pages of the dashboard.", server.pages as f64);
        self.totals.write(&mut text);
        if let Some((record, at)) = &self.newest {
            let at = at.duration_since(UNIX_EPOCH).map_or(0.0, |since| since.as_secs_f64());
            text.gauge("record_received_timestamp_seconds", "Time at which the newest record came, since 1970.", at);
            newest(&mut text, record);
        }
        text.0
    }
}

impl Totals {
    fn add(&mut self, record: &FrameRecord) {
        let (training, checkpoint) = (record.training.as_ref(), record.checkpoint.as_ref());
        for (sum, more) in [
            (&mut self.queries, record.queries),
            (&mut self.traced, record.traced),
            (&mut self.missing, record.missing),
            (&mut self.over_budget, record.over_budget),
            (&mut self.over_tolerance, u64::from(record.tolerance_excess.is_some())),
            (&mut self.warnings, record.warnings.len() as u64),
            (&mut self.commands, record.commands.len() as u64),
            (&mut self.optimizer_steps, training.map_or(0, |training| training.steps)),
            (&mut self.training_samples, training.map_or(0, |training| training.samples)),
            (&mut self.checkpoints, u64::from(checkpoint.is_some_and(|checkpoint| checkpoint.bytes.is_some()))),
            (&mut self.checkpoints_failed, u64::from(checkpoint.is_some_and(|checkpoint| checkpoint.failed.is_some()))),
        ] {
            // Another program may have written the record.
            *sum = sum.saturating_add(more);
        }
        let (sum, seconds) = (&mut self.seconds, &record.seconds);
        for (sum, more) in [
            (&mut sum.slide, seconds.slide),
            (&mut sum.waiting, seconds.waiting),
            (&mut sum.race, seconds.race),
            (&mut sum.refine, seconds.refine),
            (&mut sum.render, seconds.render),
            (&mut sum.trace, seconds.trace),
            (&mut sum.predict, seconds.predict),
            (&mut sum.audit, seconds.audit),
            (&mut sum.train, seconds.train),
            (&mut sum.checkpoint, seconds.checkpoint),
        ] {
            // A counter that fell, or had no value, would be of no use.
            *sum += Some(more).filter(|more| more.is_finite() && *more > 0.0).unwrap_or_default();
        }
    }

    fn write(&self, text: &mut Text) {
        for (name, help, value) in [
            ("records_total", "Records that were received: finished frames.", self.records),
            (
                "records_unreadable_total",
                "Records that are not understood, of another version. No other metric counts them.",
                self.unreadable,
            ),
            ("queries_total", "Log-stretch queries of the renderer.", self.queries),
            ("queries_traced_total", "Queries answered by tracing.", self.traced),
            ("queries_missing_total", "Queries without a value, at missing cells.", self.missing),
            ("queries_over_budget_total", "Queries answered by the surrogate since the tracing budget was spent.", self.over_budget),
            ("frames_over_tolerance_total", "Frames whose estimated error is above the tolerance.", self.over_tolerance),
            ("warnings_total", "Warnings in the records.", self.warnings),
            ("commands_total", "Commands that frames were the first to show.", self.commands),
            ("optimizer_steps_total", "Optimizer steps of the surrogate that count.", self.optimizer_steps),
            ("training_samples_total", "Samples that the training used, with repetition.", self.training_samples),
            ("checkpoints_total", "Checkpoints that records tell to be written.", self.checkpoints),
            ("checkpoint_failures_total", "Checkpoints that records tell to have failed.", self.checkpoints_failed),
        ] {
            text.family(name, "counter", help, [(String::new(), value as f64)]);
        }
        let seconds = &self.seconds;
        let stages = [
            ("slide", seconds.slide),
            ("waiting", seconds.waiting),
            ("race", seconds.race),
            ("refine", seconds.refine),
            ("render", seconds.render),
            ("trace", seconds.trace),
            ("predict", seconds.predict),
            ("audit", seconds.audit),
            ("train", seconds.train),
            ("checkpoint", seconds.checkpoint),
        ];
        let stages = stages.map(|(stage, value)| (labels(&[("stage", stage)]), value));
        text.family("stage_seconds_total", "counter", "Wall-clock seconds of the stages of frames.", stages);
    }
}

/// Gauges of one record. Unknown values are left out.
fn newest(text: &mut Text, record: &FrameRecord) {
    let info = labels(&[
        ("version", env!("CARGO_PKG_VERSION")),
        ("source", &record.source),
        ("method", &record.method),
        ("surrogate", record.surrogate.as_deref().unwrap_or_default()),
        ("device", &record.device),
        ("direction", &record.direction),
        ("time_unit", &record.time_unit),
    ]);
    text.family("run_info", "gauge", "Always 1; what the run is, in its labels.", [(info, 1.0)]);
    text.gauge("frame", "Number of the newest frame.", record.frame as f64);
    text.gauge("slide", "Number of the slide of the window.", record.slide as f64);
    text.gauge("seed_time", "Seed time of the FTLE, in the source's unit of time.", record.time);
    text.gauge("tau", "Integration time, in the source's unit of time.", record.tau);
    text.gauge("picture_pixels", "Pixels of the picture.", record.size[0] as f64 * record.size[1] as f64);
    text.gauge("samples_per_pixel", "Samples a pixel of the frame.", record.samples_per_pixel);
    text.gauge("traced_ratio", "Share of the frame's queries answered by tracing.", record.traced_share);
    text.gauge("trusted_volume_ratio", "Share of the domain's volume in which the surrogate is trusted.", record.trusted_volume);
    text.gauge("lifetime_ratio", "Mean lifetime of the audit particles as a share of tau.", record.mean_lifetime_share);
    text.gauge("tolerance_ratio", "Allowed optical residual, as a share of the colour scale.", record.tolerance);
    let excess = record.tolerance_excess.unwrap_or_default();
    text.gauge("tolerance_excess_ratio", "Estimated optical residual above the tolerance, 0 within it.", excess);
    text.optional("gate_evidence", "Evidence (e-value) against the gate.", record.gate_evidence);
    text.optional("surrogate_psnr_decibels", "PSNR of the surrogate over the domain.", record.surrogate_psnr);
    text.interval(
        "trusted_error_ratio",
        "Root mean square optical residual where trusted, with its 95 % interval.",
        record.trusted_error.as_ref().map(|error| {
            let [low, high] = error.optical_rms_interval;
            [error.optical_rms, low, high]
        }),
    );
    let psnr = record.picture_error.map(|error| [error.psnr.value, error.psnr.low, error.psnr.high]);
    text.interval("picture_psnr_decibels", "Stated PSNR of the picture over lit pixels, with its 95 % interval.", psnr);
    let rms = record.picture_error.map(|error| [error.rms.value, error.rms.low, error.rms.high]);
    text.interval("picture_error_radiance", "Stated root mean square error of the picture's radiance, with its 95 % interval.", rms);
    text.optional(
        "training_loss",
        "Mean loss of the training since the last frame.",
        record.training.as_ref().and_then(|training| training.loss),
    );
    text.gauge("replay_samples", "Samples in the replay buffer.", record.replay_samples as f64);
    text.gauge("frame_duration_seconds", "Wall-clock seconds of the frame, without preparing the slide and waiting.", record.seconds.total);
    text.gauge("run_elapsed_seconds", "Wall-clock seconds since the run began.", record.seconds.elapsed);
    let bytes = record.checkpoint.as_ref().and_then(|checkpoint| checkpoint.bytes);
    text.optional("checkpoint_bytes", "Bytes of a checkpoint that ended since the last frame.", bytes.map(|bytes| bytes as f64));
    let Some(live) = &record.live else { return };
    text.gauge("simulation_step", "The simulation's number of the newest step in the window.", live.step as f64);
    let lag = live.age + record.seconds.total;
    text.gauge("simulation_lag_seconds", "Seconds from the publication of that step until the frame was finished.", lag);
    text.gauge("window_snapshots", "Snapshots in the window.", live.snapshots as f64);
    for (name, help, value) in [
        ("simulation_steps_total", "Complete steps that were received.", live.steps),
        ("simulation_missed_blocks_total", "Blocks that were overwritten before they were read.", live.missed_blocks),
        ("simulation_steps_skipped_total", "Steps left out because memory is short.", live.steps_skipped),
        ("simulation_steps_incomplete_total", "Steps given up because blocks were missing.", live.steps_incomplete),
        ("simulation_restarts_total", "Starts and set-backs of the simulation.", live.restarts),
    ] {
        text.family(name, "counter", help, [(String::new(), value as f64)]);
    }
}

/// Lines of the format.
#[derive(Default)]
struct Text(String);

impl Text {
    /// A metric with its samples: labels and value. Values that are not finite are unknown.
    fn family(&mut self, name: &str, kind: &str, help: &str, samples: impl IntoIterator<Item = (String, f64)>) {
        let samples: Vec<_> = samples.into_iter().filter(|(_, value)| value.is_finite()).collect();
        if samples.is_empty() {
            return;
        }
        // Writing to a string does not fail.
        let _ = writeln!(self.0, "# HELP ridgewatch_{name} {help}\n# TYPE ridgewatch_{name} {kind}");
        for (labels, value) in samples {
            let _ = writeln!(self.0, "ridgewatch_{name}{labels} {value}");
        }
    }

    fn gauge(&mut self, name: &str, help: &str, value: f64) {
        self.family(name, "gauge", help, [(String::new(), value)]);
    }

    fn optional(&mut self, name: &str, help: &str, value: Option<f64>) {
        self.family(name, "gauge", help, value.map(|value| (String::new(), value)));
    }

    /// Value, low and high end.
    fn interval(&mut self, name: &str, help: &str, value: Option<[f64; 3]>) {
        let samples = value.map(|values| ["value", "low", "high"].map(|bound| labels(&[("bound", bound)])).into_iter().zip(values));
        self.family(name, "gauge", help, samples.into_iter().flatten());
    }
}

fn labels(labels: &[(&str, &str)]) -> String {
    let escaped = |text: &str| text.replace('\\', "\\\\").replace('"', "\\\"").replace('\n', "\\n");
    let labels: Vec<_> = labels.iter().map(|(name, value)| format!("{name}=\"{}\"", escaped(value))).collect();
    format!("{{{}}}", labels.join(","))
}
