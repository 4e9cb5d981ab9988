//! The one door through which the cycle lets frames out.

use super::file_writer::FileWriter;
use super::summary::{Summary, Totals, peak_memory_bytes};
use super::{PublishError, PublishSettings, Publisher, RunFolder};
use crate::engine::Frame;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Longest that the end of a run waits for subscribers to take the last frame.
const LINGER: Duration = Duration::from_millis(500);

/// Frames go to the run folder and to the socket, each at its own pace. Nothing that happens there reaches the cycle.
#[derive(Debug)]
pub struct Output {
    folder: Option<PathBuf>,
    files: Option<FileWriter>,
    publisher: Option<Publisher>,
    totals: Totals,
    frames: u64,
    started: Instant,
}

impl Output {
    /// Checks the settings, binds the socket (unless `settings.endpoint` is None) and takes the run folder over, which
    /// [`RunFolder::create`] made ready. All that can be refused is refused here, before work starts.
    pub fn start(settings: &PublishSettings, folder: Option<RunFolder>) -> Result<Self, PublishError> {
        settings.check()?;
        let publisher = settings.endpoint.as_deref().map(|endpoint| Publisher::start(endpoint, settings)).transpose()?;
        let path = folder.as_ref().map(|f| f.path().to_owned());
        let files = folder.map(|folder| FileWriter::start(folder, settings.clone())).transpose()?;
        Ok(Self { folder: path, files, publisher, totals: Totals::default(), frames: 0, started: Instant::now() })
    }

    /// Writes frames into a run folder from now on.
    pub fn write_to(&mut self, folder: RunFolder, settings: &PublishSettings) -> Result<(), PublishError> {
        self.folder = Some(folder.path().to_owned());
        self.files = Some(FileWriter::start(folder, settings.clone())?);
        Ok(())
    }

    /// Where subscribers find the frames, with the port that was got.
    pub fn endpoint(&self) -> Option<&str> {
        self.publisher.as_ref().map(Publisher::endpoint)
    }

    /// The run folder.
    pub fn folder(&self) -> Option<&Path> {
        self.folder.as_deref()
    }

    /// Hands a frame over; never fails. With `when_disk_slow = "drop"` it does not wait either; with `"wait"` it waits while four frames
    /// wait for the disk, a minute at most.
    pub fn frame(&mut self, frame: Frame) {
        self.frames += 1;
        self.totals.add(&frame.record);
        if let Some(publisher) = &self.publisher {
            publisher.frame(frame.clone());
        }
        if let Some(files) = &self.files {
            files.frame(frame);
        }
    }

    /// Finishes the files (a minute at most) and the socket (half a second at most), writes `summary.json` with the caller's values under
    /// `run`, and returns the same. A summary that cannot be written is a warning.
    pub fn finish(self, run: serde_json::Map<String, serde_json::Value>) -> Summary {
        let published = self.publisher.map(|publisher| publisher.finish(LINGER));
        let (folder, files) = match self.files {
            Some(files) => {
                let (folder, statistics) = files.finish();
                (folder, Some(statistics))
            }
            None => (None, None),
        };
        let summary = Summary {
            frames: self.frames,
            totals: self.totals,
            files,
            published,
            seconds: self.started.elapsed().as_secs_f64(),
            peak_memory_bytes: peak_memory_bytes(),
            run,
        };
        if let Some(mut folder) = folder {
            // A run that ends before its first frame gives the folder back to the one that it was to replace.
            let given_back = self.frames == 0
                && folder.put_back().unwrap_or_else(|error| {
                    tracing::warn!("{}: the run before cannot be put back: {error}", folder.path().display());
                    false
                });
            if !given_back && let Err(error) = folder.write_summary(&summary) {
                tracing::warn!("{error}");
            }
        }
        summary
    }
}
