//! `summary.json`, written at the end of a run.

use crate::run::FrameRecord;
use serde::{Deserialize, Serialize};

/// `summary.json`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Summary {
    /// Frames finished by the cycle.
    pub frames: u64,
    /// Sums over the frames' records.
    pub totals: Totals,
    /// Counts of the run folder. `None` without one.
    pub files: Option<FileStatistics>,
    /// Counts of the socket. `None` without one.
    pub published: Option<PublishStatistics>,
    /// Counts of the film. `None` without one.
    #[serde(default)]
    pub movie: Option<MovieStatistics>,
    /// Wall-clock seconds from start to finish.
    pub seconds: f64,
    /// Largest resident memory of the process, in bytes. `None` if the system does not report it.
    pub peak_memory_bytes: Option<u64>,
    /// Values of the caller.
    pub run: serde_json::Map<String, serde_json::Value>,
}

/// Sums over the records of all frames.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Totals {
    /// Log-stretch queries of the renderer.
    pub queries: u64,
    /// Queries answered by RK4.
    pub traced: u64,
    /// Queries without a value, at missing cells.
    pub missing: u64,
    /// `traced / (queries - missing)`; 0 without queries.
    pub traced_share: f64,
    /// Audit points traced.
    pub audited: u64,
    /// Queries whose extinction exceeded the majorant in force.
    pub majorant_exceeded: u64,
    /// Frames whose estimated residual exceeded the tolerance.
    pub tolerance_exceeded_frames: u64,
    /// Optimizer steps.
    pub training_steps: u64,
    /// Times the weights were rolled back.
    pub rollbacks: u64,
    /// Warnings in the records.
    pub warnings: u64,
}

impl Totals {
    /// Adds one frame.
    pub fn add(&mut self, record: &FrameRecord) {
        self.queries += record.queries;
        self.traced += record.traced;
        self.missing += record.missing;
        self.traced_share = self.traced as f64 / (self.queries - self.missing).max(1) as f64;
        self.audited += record.audited;
        self.majorant_exceeded += record.majorant_exceeded;
        self.tolerance_exceeded_frames += u64::from(record.tolerance_excess.is_some());
        if let Some(training) = &record.training {
            self.training_steps += training.steps;
            self.rollbacks += training.rollbacks;
        }
        self.warnings += record.warnings.len() as u64;
    }
}

/// Counts of the socket. `frames = sent + superseded + without_subscriber + failed`, once finished.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct PublishStatistics {
    /// Frames handed over by the cycle.
    pub frames: u64,
    /// Pictures given to subscribers.
    pub sent: u64,
    /// Pictures replaced by a newer one before they could be sent.
    pub superseded: u64,
    /// Pictures without a subscriber; they are not encoded.
    pub without_subscriber: u64,
    /// Pictures that could not be encoded or sent.
    pub failed: u64,
    /// Messages with all layers of a frame given to subscribers.
    pub layers: u64,
    /// Records given to subscribers, or without one.
    pub records: u64,
    /// Records dropped because too many waited, once for each subscriber.
    pub records_dropped: u64,
    /// Times that a subscriber was disconnected because it did not read.
    pub stall_disconnects: u64,
    /// Connections refused because of their user.
    pub refused_connections: u64,
    /// Connections closed for what they sent, or in favour of others.
    pub closed_connections: u64,
    /// Maximum number of subscribers at a time.
    pub peak_subscribers: u64,
    /// Maximum number of bytes queued for all subscribers at a time.
    pub peak_queued_bytes: u64,
}

/// Counts of the run folder. `frames = pictures_written + pictures_dropped + pictures_failed + unfinished` if
/// pictures are written.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct FileStatistics {
    /// Records written.
    pub records_written: u64,
    /// Records written and removed later by `records_bytes`. The others are the lines of `records-1.jsonl` and `records.jsonl`.
    pub records_removed: u64,
    /// Records that the disk refused, or for which the queue was full.
    pub records_lost: u64,
    /// Frames whose pictures were written.
    pub pictures_written: u64,
    /// Frames whose pictures were dropped because the disk was slower than the cycle.
    pub pictures_dropped: u64,
    /// Frames whose pictures the disk refused (full, for instance).
    pub pictures_failed: u64,
    /// Frames whose pictures were deleted later, by `keep` or `keep_bytes`.
    pub pictures_removed: u64,
    /// EXR files deleted because a later frame of their slide has one (`exr = "slide"`).
    pub exr_replaced: u64,
    /// Maps of slides written.
    #[serde(default)]
    pub maps_written: u64,
    /// Maps of slides that the disk refused, or had not taken when the run stopped waiting for it.
    #[serde(default)]
    pub maps_failed: u64,
    /// Maps of slides dropped because the disk, or their drawing beside a simulation, was slower than the cycle.
    #[serde(default)]
    pub maps_dropped: u64,
    /// Bytes of pictures and maps written.
    pub bytes_written: u64,
    /// Bytes of the pictures and maps not removed.
    pub bytes_kept: u64,
    /// Frames not written when the run stopped waiting for the disk.
    pub unfinished: u64,
    /// Error of the first record or picture that the disk refused.
    pub refused: Option<String>,
}

/// Counts of the film. `frames = frames_written + frames_lost`, unless the encoder hangs or fails: frames that it held are in neither.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct MovieStatistics {
    /// The film's file.
    pub file: String,
    /// Frames in the film.
    pub frames_written: u64,
    /// Frames left out because the encoder was slower than the cycle, or had failed.
    pub frames_lost: u64,
    /// Why the film ends early. `None` if it is complete.
    pub failed: Option<String>,
}

impl MovieStatistics {
    /// The film in a line for people.
    pub fn line(&self) -> String {
        let Self { file, frames_written, frames_lost, failed } = self;
        let lost = if *frames_lost > 0 { format!(", {frames_lost} left out") } else { String::new() };
        let failed = failed.as_ref().map_or_else(String::new, |why| format!("; it ends early: {why}"));
        if *frames_written == 0 {
            return format!("no frame for the film {file}{lost}{failed}");
        }
        format!("film of {frames_written} frames{lost} in {file}{failed}")
    }
}

impl FileStatistics {
    /// Whether maps are lost, and all pictures and records are written.
    pub fn lost_only_maps(&self) -> bool {
        self.maps_failed > 0 && self.pictures_failed + self.unfinished + self.records_lost == 0
    }

    /// Describes records, pictures and maps lost. `None` if everything is written, apart from what settings drop.
    pub fn lost(&self) -> Option<String> {
        let Self { pictures_written, pictures_failed, pictures_dropped, unfinished, records_lost, maps_failed, .. } = *self;
        let lost = pictures_failed + unfinished;
        let why = self.refused.as_deref().unwrap_or("the disk does not answer");
        let maps = if maps_failed > 0 { format!(", and {maps_failed} maps") } else { String::new() };
        match (lost, records_lost) {
            (0, 0) if self.lost_only_maps() => Some(format!("{maps_failed} maps are lost ({why})")),
            (0, 0) => None,
            (0, records) => Some(format!("{records} records{maps} are lost ({why})")),
            (failed, _) => Some(format!(
                "{pictures_written} of {} pictures written ({failed} failed{maps}: {why})",
                pictures_written + pictures_dropped + failed
            )),
        }
    }
}

/// Largest resident memory of this process so far, in bytes: VmHWM of `/proc/self/status`. `None` if the file does not exist.
pub fn peak_memory_bytes() -> Option<u64> {
    procfs::process::Process::myself().and_then(|process| process.status()).ok()?.vmhwm.map(|kibibytes| kibibytes * 1024)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn peak_memory_grows_with_what_is_touched() {
        let Some(before) = peak_memory_bytes() else { return };
        let block = vec![1u8; 64 << 20];
        let sum: u64 = block.iter().step_by(4096).map(|&b| u64::from(b)).sum();
        assert_eq!(sum, (64 << 20) / 4096);
        // Other tests run beside this one, so that only a lower bound is certain.
        assert!(before > 0 && peak_memory_bytes().unwrap() >= 64 << 20);
    }

    #[test]
    fn totals_add_up() {
        let mut totals = Totals::default();
        totals.add(&FrameRecord { queries: 100, traced: 100, tolerance_excess: Some(0.01), ..Default::default() });
        totals.add(&FrameRecord { queries: 300, traced: 0, warnings: vec!["odd".into()], ..Default::default() });
        assert_eq!((totals.queries, totals.traced_share, totals.tolerance_exceeded_frames, totals.warnings), (400, 0.25, 1, 1));
        totals.add(&FrameRecord { queries: 600, traced: 0, missing: 600, ..Default::default() });
        assert_eq!((totals.missing, totals.traced_share), (600, 0.25), "land is not traced, and no share of it");
    }
}
