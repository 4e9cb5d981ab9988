//! Films of a run, of its frames or of its maps: GIF, and MP4 through `ffmpeg`. A thread encodes; a film that fails costs the run nothing but the film.

mod gif;
mod mp4;

use super::annotate::annotate;
use super::error::PublishError;
use super::summary::MovieStatistics;
use crate::folder::Folder;
use crate::progress::Work;
use crate::run::Frame;
use crate::setting::{Refused, require};
use image::ImageFormat;
use serde::Deserialize;
use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, TrySendError, channel, sync_channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::Builder;
use std::time::{Duration, Instant};

/// Maximum number of pictures that wait for the encoder.
const QUEUED: usize = 4;
/// Longest wait of a run for a place in the queue, and at its end for the last frame.
const LIMIT: Duration = Duration::from_secs(60);
/// Interval at which the end of a film is looked for.
const LOOK: Duration = Duration::from_millis(200);
/// Pause between two attempts to queue a frame.
const PAUSE: Duration = Duration::from_millis(5);

/// What a film shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Filmed {
    /// The frames.
    Frames,
    /// The maps of the slides.
    Maps,
}

/// How a film is made.
#[derive(Debug, Clone)]
pub struct MovieSettings {
    /// What it shows.
    pub of: Filmed,
    /// The file, `.gif` or `.mp4`.
    pub path: PathBuf,
    /// Frames a second, 1 to 50 (a GIF counts hundredths of a second, and viewers slow those below two down).
    pub frames_per_second: f64,
    /// Writes time and stated error into frames. Maps have them.
    pub annotate: bool,
    /// Whether the run waits for a slow encoder, a minute at most, before frames are left out.
    pub waits: bool,
    /// Replaces an earlier film.
    pub overwrite: bool,
}

/// An encoder of frames of one size, R, G, B in 8 bits, rows from the top.
trait Encoder {
    /// Adds a frame. Once it returns, the film up to here can be played, or soon will be.
    fn add(&mut self, rgb: &[u8]) -> io::Result<()>;
    /// Completes the file.
    fn finish(self: Box<Self>) -> io::Result<()>;
}

#[derive(Debug, Clone, Copy)]
enum Format {
    Gif,
    Mp4,
}

fn format_of(path: &Path) -> Result<Format, Refused> {
    match path.extension().and_then(|extension| extension.to_str()) {
        Some("gif") => Ok(Format::Gif),
        Some("mp4") => Ok(Format::Mp4),
        _ => Err(Refused::new("--movie", format_args!("is {}", path.display()), "a name that ends in .gif or .mp4")),
    }
}

/// A picture of a film.
#[derive(Debug)]
enum Shot {
    Frame(Frame),
    /// As PNG.
    Map(Vec<u8>),
}

/// A film that is being made.
#[derive(Debug)]
pub struct Movie {
    of: Filmed,
    /// `None` once the encoder has failed.
    queue: Option<SyncSender<Shot>>,
    done: Receiver<()>,
    /// Frames that were queued.
    queued: u64,
    statistics: Arc<Mutex<MovieStatistics>>,
    waits: bool,
}

impl Movie {
    /// Checks that the film can be made and starts its thread. The file is created with the first frame.
    ///
    /// # Errors
    /// Another ending than `.gif` or `.mp4`, frames a second out of range, a film of that name, `ffmpeg` that is missing, a folder that cannot be
    /// written, or a thread that cannot be started.
    pub fn start(settings: MovieSettings) -> Result<Self, PublishError> {
        let format = format_of(&settings.path)?;
        let rate = settings.frames_per_second;
        require((1.0..=50.0).contains(&rate), "--movie-fps", rate, "a number from 1 to 50")?;
        let problem = |problem: String| PublishError::File { path: settings.path.clone(), problem };
        if !settings.overwrite && settings.path.symlink_metadata().is_ok() {
            return Err(problem("exists already: choose another name, or pass --overwrite to replace it".into()));
        }
        let folder = folder_of(&settings.path);
        std::fs::create_dir_all(folder).map_err(|e| problem(format!("its folder cannot be made: {e}")))?;
        tempfile::NamedTempFile::new_in(folder).map_err(|e| problem(format!("its folder cannot be written: {e}")))?;
        if matches!(format, Format::Mp4) {
            mp4::check().map_err(problem)?;
        }
        let statistics = MovieStatistics { file: settings.path.display().to_string(), ..MovieStatistics::default() };
        let statistics = Arc::new(Mutex::new(statistics));
        let (queue, shots) = sync_channel(QUEUED);
        let (tell, done) = channel();
        let (theirs, of, waits) = (Arc::clone(&statistics), settings.of, settings.waits);
        let name = "ridgewatch-movie";
        let work = move || {
            encode_all(&shots, &settings, format, &theirs);
            let _ = tell.send(());
        };
        Builder::new().name(name.into()).spawn(work).map_err(|source| PublishError::Thread { name, source })?;
        Ok(Self { of, queue: Some(queue), done, queued: 0, statistics, waits })
    }

    /// Adds a frame to a film of frames; never fails. Waits for a slow encoder if the settings say so, and else leaves the frame out.
    pub fn frame(&mut self, frame: Frame) {
        if self.of == Filmed::Frames {
            self.add(Shot::Frame(frame));
        }
    }

    /// Adds the PNG of a map to a film of maps, as [`Self::frame`] does.
    pub fn map(&mut self, png: &[u8]) {
        if self.of == Filmed::Maps {
            self.add(Shot::Map(png.to_vec()));
        }
    }

    fn add(&mut self, mut shot: Shot) {
        let Some(queue) = &self.queue else { return locked(&self.statistics).frames_lost += 1 };
        let limit = if self.waits { LIMIT } else { Duration::ZERO };
        let (begin, mut work) = (Instant::now(), None);
        loop {
            match queue.try_send(shot) {
                Ok(()) => return self.queued += 1,
                Err(TrySendError::Full(back)) if begin.elapsed() < limit => {
                    work.get_or_insert_with(|| Work::begin("waiting for the encoder of the film"));
                    shot = back;
                    std::thread::sleep(PAUSE);
                }
                Err(TrySendError::Full(_)) => {
                    // An encoder that hangs costs one wait, not one a frame.
                    self.waits = false;
                    let mut statistics = locked(&self.statistics);
                    statistics.frames_lost += 1;
                    if statistics.frames_lost == 1 {
                        tracing::warn!(
                            "{}: the encoder is slower than the frames: some are left out (the summary counts them)",
                            statistics.file
                        );
                    }
                    return;
                }
                Err(TrySendError::Disconnected(_)) => {
                    self.queue = None;
                    locked(&self.statistics).frames_lost += 1;
                    return;
                }
            }
        }
    }

    /// Completes the film, within a minute, and returns its counts.
    pub fn finish(mut self) -> MovieStatistics {
        self.queue = None;
        let (work, by) = (Work::begin("finishing the film"), Instant::now() + LIMIT);
        let answered = loop {
            match self.done.recv_timeout(LOOK) {
                Err(RecvTimeoutError::Timeout) if Instant::now() < by => {
                    let left = self.queued.saturating_sub(locked(&self.statistics).frames_written);
                    work.stands(format!("{left} frames are left"));
                }
                answer => break answer.is_ok(),
            }
        };
        let mut statistics = locked(&self.statistics).clone();
        if !answered && statistics.failed.is_none() {
            let failed = format!("the encoder did not end within {LIMIT:?}");
            tracing::warn!("{}: {failed}", statistics.file);
            statistics.failed = Some(failed);
        }
        statistics
    }
}

fn locked(statistics: &Mutex<MovieStatistics>) -> MutexGuard<'_, MovieStatistics> {
    statistics.lock().unwrap_or_else(PoisonError::into_inner)
}

fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// Encodes until the queue is closed. After an error the frames that follow are lost, and counted by the queue's other end.
fn encode_all(shots: &Receiver<Shot>, settings: &MovieSettings, format: Format, statistics: &Mutex<MovieStatistics>) {
    let outcome = (|| {
        let mut film: Option<([usize; 2], Box<dyn Encoder>)> = None;
        for shot in shots {
            let (size, rgb) = pixels(&shot, settings.annotate)?;
            let (known, encoder) = match &mut film {
                Some(film) => film,
                None => film.insert((size, begin(settings, format, size)?)),
            };
            if *known != size {
                return Err(io::Error::other(format!("frames of {known:?} pixels are followed by one of {size:?}")));
            }
            encoder.add(&rgb)?;
            locked(statistics).frames_written += 1;
        }
        film.map_or(Ok(()), |(_, encoder)| encoder.finish())
    })();
    if let Err(error) = outcome {
        let mut statistics = locked(statistics);
        tracing::warn!("{}: the film ends after {} frames: {error}; the run continues", statistics.file, statistics.frames_written);
        statistics.failed = Some(error.to_string());
    }
}

/// Width, height and R, G, B of a picture, rows from the top.
fn pixels(shot: &Shot, annotates: bool) -> io::Result<([usize; 2], Vec<u8>)> {
    let frame = match shot {
        Shot::Frame(frame) => frame,
        Shot::Map(png) => {
            let picture = image::load_from_memory_with_format(png, ImageFormat::Png).map_err(io::Error::other)?.into_rgb8();
            return Ok(([picture.width() as usize, picture.height() as usize], picture.into_raw()));
        }
    };
    let size = [frame.film.width, frame.film.height];
    let mut rgb = frame.film.tone_mapped(frame.tone_map);
    if rgb.is_empty() || rgb.len() != 3 * size[0] * size[1] {
        return Err(io::Error::other("a frame without pixels"));
    }
    if annotates {
        annotate(&mut rgb, size, &frame.record).map_err(io::Error::other)?;
    }
    Ok((size, rgb))
}

/// Creates the file, through no link, and its encoder.
fn begin(settings: &MovieSettings, format: Format, size: [usize; 2]) -> io::Result<Box<dyn Encoder>> {
    let name = settings.path.file_name().ok_or_else(|| io::Error::new(io::ErrorKind::InvalidInput, "no file name"))?;
    let folder = Folder::open(folder_of(&settings.path))?;
    if settings.overwrite {
        match folder.remove(name) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
            _ => {}
        }
    }
    let file: File = folder.create_new(name)?;
    Ok(match format {
        Format::Gif => Box::new(gif::Gif::new(file, size, settings.frames_per_second)?),
        Format::Mp4 => Box::new(mp4::Mp4::new(file, size, settings.frames_per_second)?),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::Film;
    use crate::run::FrameRecord;

    fn frame(edge: usize, red: f32) -> Frame {
        let rgba = (0..edge * edge).map(|i| [red, (i % 997) as f32 / 997.0, (i % 61) as f32 / 61.0, 1.0]).collect();
        let film = Film { width: edge, height: edge, rgba, ..Default::default() };
        Frame { record: Arc::new(FrameRecord::default()), film: Arc::new(film), tone_map: [1.0, 0.5, 1.0], color_bar: None, gate: None }
    }

    fn settings(path: PathBuf, waits: bool) -> MovieSettings {
        MovieSettings { of: Filmed::Frames, path, frames_per_second: 30.0, annotate: false, waits, overwrite: false }
    }

    fn decoded(path: &Path) -> Vec<u16> {
        let mut decoder = ::gif::DecodeOptions::new().read_info(File::open(path).unwrap()).unwrap();
        let mut delays = Vec::new();
        while let Ok(Some(frame)) = decoder.read_next_frame() {
            delays.push(frame.delay);
        }
        delays
    }

    #[test]
    fn a_film_without_its_end_is_played_up_to_the_last_frame() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("film.gif");
        let mut gif = gif::Gif::new(File::create(&path).unwrap(), [16, 16], 30.0).unwrap();
        for red in 0..3 {
            gif.add(&frame(16, red as f32 / 3.0).film.tone_mapped([1.0, 0.5, 1.0])).unwrap();
        }
        // As a killed process leaves it.
        std::mem::forget(gif);
        assert_eq!(decoded(&path), [3, 4, 3], "hundredths of a second, ten in three frames");
    }

    #[test]
    fn a_slow_encoder_does_not_hold_up_the_run_and_what_it_leaves_out_is_counted() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("film.gif");
        let mut movie = Movie::start(settings(path.clone(), false)).unwrap();
        let large = frame(1500, 0.5);
        let begin = Instant::now();
        (0..40).for_each(|_| movie.frame(large.clone()));
        // A frame of 2.25 megapixels takes the encoder longer than all 40 take here.
        assert!(begin.elapsed() < Duration::from_secs(2), "{:?}", begin.elapsed());
        let statistics = movie.finish();
        assert!(statistics.frames_lost >= 30 && statistics.frames_written >= 1 && statistics.failed.is_none(), "{statistics:?}");
        assert_eq!(statistics.frames_lost + statistics.frames_written, 40);
        assert_eq!(decoded(&path).len() as u64, statistics.frames_written);
    }

    #[test]
    fn a_film_that_cannot_be_written_is_told_and_nothing_else_fails() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("film.gif");
        let mut movie = Movie::start(settings(path.clone(), true)).unwrap();
        std::os::unix::fs::symlink("elsewhere", &path).unwrap();
        (0..10).for_each(|_| movie.frame(frame(8, 0.0)));
        let statistics = movie.finish();
        assert_eq!(statistics.frames_written, 0);
        assert!(statistics.failed.is_some() && statistics.line().contains("it ends early"), "{statistics:?}");
        assert!(!folder.path().join("elsewhere").exists(), "no link is followed");

        let refused = |path: &str, fps: f64| {
            let settings = MovieSettings { frames_per_second: fps, ..settings(folder.path().join(path), true) };
            Movie::start(settings).unwrap_err().to_string()
        };
        assert!(refused("film.avi", 10.0).contains(".gif or .mp4"));
        assert!(refused("new.gif", 0.5).contains("a number from 1 to 50"));
        assert!(refused("film.gif", 10.0).contains("--overwrite"), "the link is there already");

        let mut movie = Movie::start(settings(folder.path().join("sizes.gif"), true)).unwrap();
        [8, 8, 9].into_iter().for_each(|edge| movie.frame(frame(edge, 0.0)));
        let statistics = movie.finish();
        assert!(statistics.frames_written == 2 && statistics.failed.unwrap().contains("[8, 8]"));
    }
}
