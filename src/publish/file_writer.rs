//! Thread that writes the run folder, with a short queue.

use super::error::PublishError;
use super::run_folder::{RunFolder, SlideMap};
use super::settings::{ExrFrames, PublishSettings, WhenDiskSlow};
use super::summary::FileStatistics;
use crate::progress::Work;
use crate::run::{Frame, FrameRecord};
use std::collections::VecDeque;
use std::sync::mpsc::channel;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::{Builder, JoinHandle};
use std::time::{Duration, Instant};

/// Maximum number of queued frames with pictures, and of queued maps.
const MAX_PICTURES: usize = 4;
/// Maximum number of queued records.
const MAX_RECORDS: usize = 1024;
/// Longest wait for a place in the queue, and at the end of the run for the last frame.
const DISK_LIMIT: Duration = Duration::from_secs(60);

/// Writes frames asynchronously.
#[derive(Debug)]
pub(super) struct FileWriter {
    shared: Arc<Shared>,
    /// `None` once finished.
    thread: Option<JoinHandle<Option<RunFolder>>>,
    when_disk_slow: WhenDiskSlow,
    limit: Duration,
}

impl Drop for FileWriter {
    /// Without [`FileWriter::finish`], after an error elsewhere, the thread empties the queue and ends by itself.
    fn drop(&mut self) {
        self.shared.lock().closed = true;
        self.shared.changed.notify_all();
    }
}

#[derive(Debug, Default)]
struct Shared {
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Debug, Default)]
struct State {
    queue: VecDeque<Job>,
    /// Frames with pictures in `queue`.
    pictures: usize,
    /// Maps in `queue`.
    maps: usize,
    /// The job that is being written.
    busy: Option<Busy>,
    closed: bool,
    statistics: FileStatistics,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Busy {
    Frame,
    Map,
}

#[derive(Debug)]
enum Job {
    Whole(Frame),
    /// Its pictures were dropped.
    Record(Arc<FrameRecord>),
    Map(SlideMap),
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl FileWriter {
    /// Starts the thread. If it cannot be started, the folder has its previous run again.
    pub(super) fn start(folder: RunFolder, settings: PublishSettings) -> Result<Self, PublishError> {
        Self::start_in(Builder::new(), folder, settings, DISK_LIMIT)
    }

    fn start_in(thread: Builder, mut folder: RunFolder, settings: PublishSettings, limit: Duration) -> Result<Self, PublishError> {
        let shared = Arc::new(Shared::default());
        let (theirs, when_disk_slow) = (Arc::clone(&shared), settings.when_disk_slow.unwrap_or(WhenDiskSlow::Wait));
        let name = "ridgewatch-files";
        // Sent once the thread exists: one that is refused would take the folder with it.
        let (send, receive) = channel();
        let work = move || receive.recv().ok().map(|folder| write_all(&theirs, folder, &settings));
        match thread.name(name.to_owned()).spawn(work) {
            Ok(thread) => {
                // It waits for the folder.
                let _ = send.send(folder);
                Ok(Self { shared, thread: Some(thread), when_disk_slow, limit })
            }
            Err(source) => {
                folder.give_up();
                Err(PublishError::Thread { name, source })
            }
        }
    }

    /// The state. With [`WhenDiskSlow::Wait`], once fewer than [`MAX_PICTURES`] of their kind are queued, or after the limit.
    fn with_place(&self, queued: impl Fn(&State) -> usize) -> MutexGuard<'_, State> {
        let state = self.shared.lock();
        if self.when_disk_slow == WhenDiskSlow::Drop {
            return state;
        }
        let _work = (queued(&state) >= MAX_PICTURES).then(|| Work::begin("waiting for the disk"));
        let waited = self.shared.changed.wait_timeout_while(state, self.limit, |state| queued(state) >= MAX_PICTURES);
        waited.unwrap_or_else(PoisonError::into_inner).0
    }

    /// Queues a frame. With [`WhenDiskSlow::Wait`] it waits for a place in the queue, a minute at most.
    pub(super) fn frame(&self, frame: Frame) {
        let mut state = self.with_place(|state| state.pictures);
        if state.pictures >= MAX_PICTURES {
            state.drop_oldest_pictures(self.when_disk_slow);
        }
        if state.queue.len() >= MAX_RECORDS {
            // Few of the jobs have pictures or are maps.
            let oldest = state.queue.iter().position(|job| matches!(job, Job::Record(_)));
            if let Some(oldest) = oldest {
                state.queue.remove(oldest);
                state.statistics.records_lost += 1;
            }
        }
        state.queue.push_back(Job::Whole(frame));
        state.pictures += 1;
        self.shared.changed.notify_all();
    }

    /// Queues the map of a slide, whose frame was queued before. It waits for a place as a frame does; without one the map is left out.
    pub(super) fn map(&self, map: SlideMap) {
        let mut state = self.with_place(|state| state.maps);
        if state.maps >= MAX_PICTURES {
            match self.when_disk_slow {
                WhenDiskSlow::Wait => state.statistics.maps_failed += 1,
                WhenDiskSlow::Drop => state.statistics.maps_dropped += 1,
            }
            return;
        }
        state.queue.push_back(Job::Map(map));
        state.maps += 1;
        self.shared.changed.notify_all();
    }

    /// Counts a map that was not drawn in time.
    pub(super) fn no_map(&self) {
        self.shared.lock().statistics.maps_dropped += 1;
    }

    /// Waits for the last frame, a minute at most. Returns the folder, unless the disk hangs, and the counts.
    pub(super) fn finish(mut self) -> (Option<RunFolder>, FileStatistics) {
        let deadline = Instant::now() + self.limit;
        let mut state = self.shared.lock();
        state.closed = true;
        self.shared.changed.notify_all();
        let left = |state: &State| state.queue.len() + usize::from(state.busy.is_some());
        let (work, all) = (Work::begin("writing the last frames"), left(&state));
        while left(&state) > 0 {
            work.reached(all.saturating_sub(left(&state)), all);
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                let mut statistics = state.statistics.clone();
                let busy = |with: Busy| usize::from(state.busy == Some(with));
                statistics.unfinished = (state.pictures + busy(Busy::Frame)) as u64;
                let maps = (state.maps + busy(Busy::Map)) as u64;
                statistics.maps_failed += maps;
                let unfinished = statistics.unfinished;
                tracing::error!("the disk did not take the last {unfinished} frames and {maps} maps within {:?}", self.limit);
                return (None, statistics);
            }
            state = self.shared.changed.wait_timeout(state, left).unwrap_or_else(PoisonError::into_inner).0;
        }
        drop(state);
        let folder = self.thread.take().and_then(|thread| thread.join().ok().flatten());
        let mut statistics = self.shared.lock().statistics.clone();
        statistics.bytes_kept = folder.as_ref().map_or(0, RunFolder::kept_bytes);
        (folder, statistics)
    }
}

impl State {
    fn drop_oldest_pictures(&mut self, when_disk_slow: WhenDiskSlow) {
        let oldest = self.queue.iter_mut().find(|job| matches!(job, Job::Whole(_)));
        if let Some(job) = oldest {
            if let Job::Whole(frame) = job {
                *job = Job::Record(Arc::clone(&frame.record));
            }
            self.pictures -= 1;
            if when_disk_slow == WhenDiskSlow::Wait {
                self.statistics.pictures_failed += 1;
                return;
            }
            self.statistics.pictures_dropped += 1;
            if self.statistics.pictures_dropped == 1 {
                tracing::warn!("the disk is slower than the frames: pictures are dropped from here on (counted in the summary)");
            }
        }
    }
}

fn write_all(shared: &Shared, mut folder: RunFolder, settings: &PublishSettings) -> RunFolder {
    // Only the first error of a series is reported.
    let mut refused = false;
    loop {
        let mut state = shared.lock();
        state.busy = None;
        shared.changed.notify_all();
        let job = loop {
            if let Some(job) = state.queue.pop_front() {
                break job;
            }
            if state.closed {
                return folder;
            }
            state = shared.changed.wait(state).unwrap_or_else(PoisonError::into_inner);
        };
        state.busy = Some(if matches!(job, Job::Map(_)) { Busy::Map } else { Busy::Frame });
        state.pictures -= usize::from(matches!(job, Job::Whole(_)));
        state.maps -= usize::from(matches!(job, Job::Map(_)));
        // A place is free.
        shared.changed.notify_all();
        drop(state);

        let record = match &job {
            Job::Whole(frame) => &frame.record,
            Job::Record(record) => record,
            Job::Map(map) => {
                let written = folder.write_map(map, settings);
                let statistics = &mut shared.lock().statistics;
                match written {
                    Ok(bytes) => {
                        statistics.maps_written += 1;
                        statistics.bytes_written += bytes;
                    }
                    Err(error) => {
                        statistics.maps_failed += 1;
                        if statistics.maps_failed == 1 {
                            let (path, slide) = (folder.path().display(), map.slide);
                            tracing::warn!(
                                "{path}: the map of slide {slide} could not be written: {error}; the run continues and counts such maps"
                            );
                        }
                        statistics.refused.get_or_insert_with(|| error.to_string());
                    }
                }
                continue;
            }
        };
        let appended = folder.append_record(record, settings.records_bytes);
        let pictured = match &job {
            Job::Whole(frame) if settings.exr != ExrFrames::None || settings.preview => Some(folder.write_pictures(frame, settings)),
            _ => None,
        };

        let mut state = shared.lock();
        let statistics = &mut state.statistics;
        statistics.records_written += u64::from(appended.is_ok());
        statistics.records_lost += u64::from(appended.is_err());
        let mut trouble = appended.err();
        let removed = folder.records_removed();
        if removed > 0 && statistics.records_removed == 0 {
            tracing::warn!(
                "{}: the oldest {removed} records are removed, to stay within `publish.records_bytes`; the summary counts them",
                folder.path().display()
            );
        }
        statistics.records_removed = removed;
        match pictured {
            Some(Ok(written)) => {
                statistics.pictures_written += 1;
                statistics.bytes_written += written.bytes;
                statistics.pictures_removed += written.removed;
                statistics.exr_replaced += u64::from(written.replaced);
            }
            Some(Err(error)) => {
                statistics.pictures_failed += 1;
                trouble = Some(error);
            }
            None => {}
        }
        if let Some(error) = &trouble {
            statistics.refused.get_or_insert_with(|| error.to_string());
        }
        drop(state);
        let path = folder.path().display();
        match &trouble {
            Some(error) if !refused => {
                tracing::warn!("{path}: frame {} could not be written: {error}; the run continues and counts such frames", record.frame);
            }
            None if refused => tracing::info!("{path}: frames are written again from {} on", record.frame),
            _ => {}
        }
        refused = trouble.is_some();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::Film;

    fn frame(number: u64, edge: usize) -> Frame {
        let film = Film { width: edge, height: edge, rgba: vec![[0.5; 4]; edge * edge], ..Default::default() };
        let record = FrameRecord { frame: number, slide: number, ..Default::default() };
        Frame { record: Arc::new(record), film: Arc::new(film), tone_map: [1.0, 0.5, 1.0], color_bar: None, gate: None }
    }

    fn recorded(folder: &std::path::Path) -> Vec<u64> {
        let text = std::fs::read_to_string(folder.join("records.jsonl")).unwrap();
        text.lines().map(|l| serde_json::from_str::<FrameRecord>(l).unwrap().frame).collect()
    }

    fn run(when_disk_slow: WhenDiskSlow, frames: u64, edge: usize) -> (FileStatistics, Vec<u64>) {
        let folder = tempfile::tempdir().unwrap();
        let settings = PublishSettings { when_disk_slow: Some(when_disk_slow), ..Default::default() };
        let writer = FileWriter::start(RunFolder::create(folder.path(), false).unwrap(), settings).unwrap();
        // All frames share one film, so that they come at once.
        let film = frame(0, edge).film;
        for n in 0..frames {
            writer.frame(Frame { film: film.clone(), ..frame(n, 1) });
        }
        let (_, statistics) = writer.finish();
        (statistics, recorded(folder.path()))
    }

    #[test]
    fn waiting_loses_nothing() {
        let (statistics, records) = run(WhenDiskSlow::Wait, 40, 64);
        assert_eq!((statistics.pictures_written, statistics.records_written), (40, 40));
        assert_eq!(records, (0..40).collect::<Vec<u64>>());
    }

    #[test]
    fn a_thread_that_is_refused_does_not_cost_the_earlier_run() {
        let folder = tempfile::tempdir().unwrap();
        let create = |overwrite| RunFolder::create(folder.path(), overwrite).unwrap();
        create(false).append_record(&frame(7, 1).record, None).unwrap();
        // No system has memory for this stack.
        let refusing = Builder::new().stack_size(1 << 60);
        let refused = FileWriter::start_in(refusing, create(true), PublishSettings::default(), DISK_LIMIT).unwrap_err().to_string();
        assert!(refused.contains("cannot start the thread ridgewatch-files"), "{refused}");
        assert_eq!(recorded(folder.path()), [7]);
        assert!(!folder.path().join(".previous").exists());
    }

    #[test]
    fn records_beyond_their_cap_are_counted() {
        let folder = tempfile::tempdir().unwrap();
        // A few lines a file.
        let settings = PublishSettings { records_bytes: Some(16 << 10), exr: ExrFrames::None, preview: false, ..Default::default() };
        let writer = FileWriter::start(RunFolder::create(folder.path(), false).unwrap(), settings).unwrap();
        (0..100).for_each(|n| writer.frame(frame(n, 1)));
        let (_, statistics) = writer.finish();
        let older = std::fs::read_to_string(folder.path().join("records-1.jsonl")).unwrap();
        let left = (older.lines().count() + recorded(folder.path()).len()) as u64;
        assert_eq!((statistics.records_written, statistics.records_removed, statistics.records_lost), (100, 100 - left, 0));
        assert!((8..=24).contains(&left), "{left}");
    }

    #[test]
    fn dropping_loses_pictures_but_no_record() {
        // Frames of a megapixel come far faster than they can be compressed.
        let (statistics, records) = run(WhenDiskSlow::Drop, 30, 1024);
        assert!(statistics.pictures_dropped >= 20, "{statistics:?}");
        assert_eq!(statistics.pictures_written + statistics.pictures_dropped, 30);
        assert_eq!(records, (0..30).collect::<Vec<u64>>(), "every record, in order");
    }

    #[test]
    fn a_disk_that_refuses_is_counted_and_the_run_goes_on() {
        let folder = tempfile::tempdir().unwrap();
        let frames = folder.path().join("frames");
        let writer = FileWriter::start(RunFolder::create(folder.path(), false).unwrap(), PublishSettings::default()).unwrap();
        let settled = |n: u64| {
            writer.frame(frame(n, 8));
            let mut state = writer.shared.lock();
            while state.statistics.records_written <= n {
                state = writer.shared.changed.wait_timeout(state, Duration::from_secs(10)).unwrap().0;
            }
        };
        settled(0);
        // A folder in the way of the file cannot be removed as one.
        for n in [1, 2] {
            std::fs::create_dir(frames.join(format!(".frame_{n:06}.exr.part"))).unwrap();
        }
        settled(1);
        settled(2);
        settled(3);
        let (back, statistics) = writer.finish();
        assert_eq!((statistics.pictures_written, statistics.pictures_failed, statistics.records_written), (2, 2, 4));
        assert!(back.is_some() && frames.join("frame_000003.exr").exists());
    }

    #[test]
    fn a_disk_that_hangs_costs_the_limit_and_no_more() {
        let folder = tempfile::tempdir().unwrap();
        let limit = Duration::from_millis(200);
        let mut run = RunFolder::create(folder.path(), false).unwrap();
        // A pipe that nobody reads hangs like a lost disk, once it is full.
        let (_reader, mut pipe) = std::io::pipe().unwrap();
        std::io::Write::write_all(&mut pipe, &[0; 1 << 16]).unwrap();
        run.hang(std::fs::File::from(std::os::fd::OwnedFd::from(pipe)));
        let writer = FileWriter::start_in(Builder::new(), run, PublishSettings::default(), limit).unwrap();
        for n in 0..2 {
            writer.frame(frame(n, 8));
        }
        // It comes back at all: the pipe takes nothing.
        let (back, statistics) = writer.finish();
        assert!(back.is_none() && statistics.unfinished == 2, "{statistics:?}");
    }
}
