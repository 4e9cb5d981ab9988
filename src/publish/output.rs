//! Output of all frames of a run.

use super::error::PublishError;
use super::file_writer::FileWriter;
use super::movie::Movie;
use super::newest::{NewestFrame, RunAbout};
use super::run_folder::{RunFolder, SlideMap};
use super::settings::PublishSettings;
use super::summary::{Summary, Totals, peak_memory_bytes};
use super::zmq::Publisher;
use crate::run::Frame;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Longest wait at the end of a run for subscribers to receive the last frame.
const LINGER: Duration = Duration::from_millis(500);

/// Writes frames to the run folder and to the socket, each at its own pace. Errors of either never reach the cycle.
#[derive(Debug)]
pub struct Output {
    files: Option<FileWriter>,
    publisher: Option<Publisher>,
    newest: Option<Arc<NewestFrame>>,
    movie: Option<Movie>,
    totals: Totals,
    frames: u64,
    started: Instant,
}

impl Output {
    /// Checks the settings, binds the socket (unless `settings.endpoint` is `None`) and starts to write to `folder`.
    ///
    /// # Errors
    /// A setting that is not accepted, an endpoint that cannot be bound, or a thread that cannot be started.
    pub fn start(settings: &PublishSettings, folder: Option<RunFolder>) -> Result<Self, PublishError> {
        settings.check()?;
        let publisher = settings.endpoint.as_deref().map(|endpoint| Publisher::start(endpoint, settings)).transpose()?;
        let (totals, frames, started) = (Totals::default(), 0, Instant::now());
        let mut output = Self { files: None, publisher, movie: None, newest: None, totals, frames, started };
        folder.map_or(Ok(()), |folder| output.write_to(folder, settings))?;
        Ok(output)
    }

    /// Starts to write frames to a run folder.
    ///
    /// # Errors
    /// A thread that cannot be started.
    pub fn write_to(&mut self, folder: RunFolder, settings: &PublishSettings) -> Result<(), PublishError> {
        self.files = Some(FileWriter::start(folder, settings.clone())?);
        Ok(())
    }

    /// Tells those who get all layers what is to be known of the run.
    pub fn describe(&self, about: &RunAbout) {
        if let Some(publisher) = &self.publisher {
            publisher.describe(about);
        }
    }

    /// Keeps the newest frame in memory from now on.
    pub fn keep_newest(&mut self, newest: Arc<NewestFrame>) {
        self.newest = Some(newest);
    }

    /// Starts to make a film of the frames or maps.
    pub fn film(&mut self, movie: Movie) {
        self.movie = Some(movie);
    }

    /// Endpoint of the socket, with the port that was bound. `None` without a socket.
    pub fn endpoint(&self) -> Option<&str> {
        self.publisher.as_ref().map(Publisher::endpoint)
    }

    /// Takes a frame; never fails. With `when_disk_slow = "wait"` it waits while four frames wait for the disk, a minute at most.
    pub fn frame(&mut self, frame: Frame) {
        self.frames += 1;
        self.totals.add(&frame.record);
        // Before it is published, so that it is there when it is seen.
        if let Some(newest) = &self.newest {
            newest.put(frame.clone());
        }
        if let Some(publisher) = &self.publisher {
            publisher.frame(frame.clone());
        }
        if let Some(movie) = &mut self.movie {
            movie.frame(frame.clone());
        }
        if let Some(files) = &self.files {
            files.frame(frame);
        }
    }

    /// Takes the map of a slide, for the run folder and a film of maps; never fails.
    pub fn map(&mut self, map: SlideMap) {
        if let Some(movie) = &mut self.movie {
            movie.map(&map.png);
        }
        if let Some(files) = &self.files {
            files.map(map);
        }
    }

    /// Counts a slide whose map was not drawn in time.
    pub fn no_map(&self) {
        if let Some(files) = &self.files {
            files.no_map();
        }
    }

    /// Finishes the film and the files (a minute each at most) and the socket (half a second at most), and writes `summary.json` with the caller's values under
    /// `run`. Returns the summary. If it cannot be written, that is a warning.
    pub fn finish(self, run: serde_json::Map<String, serde_json::Value>) -> Summary {
        let published = self.publisher.map(|publisher| publisher.finish(LINGER));
        let movie = self.movie.map(Movie::finish);
        let (folder, files) = self.files.map(FileWriter::finish).unzip();
        let summary = Summary {
            frames: self.frames,
            totals: self.totals,
            files,
            published,
            movie,
            seconds: self.started.elapsed().as_secs_f64(),
            peak_memory_bytes: peak_memory_bytes(),
            run,
        };
        if let Some(mut folder) = folder.flatten() {
            // A run without a frame does not replace the previous one.
            let restored = self.frames == 0 && folder.give_up();
            if !restored && let Err(error) = folder.write_summary(&summary) {
                tracing::warn!("{error}");
            }
        }
        summary
    }
}
