//! Checkpoints of a run, written by a background thread while frames continue; at most one at a time.

use super::record::CheckpointRecord;
use crate::backend::{DeviceError, Surrogate};
use crate::surrogate::{CheckpointError, CheckpointState};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

/// Maximum time that the end of a run waits for the disk: for the checkpoint in progress, and again for the last one.
const DISK_LIMIT: Duration = Duration::from_secs(120);

/// Totals of a run's checkpoints.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct CheckpointTotals {
    /// Number of checkpoints written.
    pub written: u64,
    /// Number of checkpoints that failed; each failure was reported.
    pub failed: u64,
    /// Number of checkpoints that became due while another was being written, and were skipped.
    pub postponed: u64,
    /// Longest pause of the loop for a checkpoint, in seconds, without the checkpoint at the end of the run.
    pub longest_copy_seconds: f64,
    /// The last checkpoint.
    pub last: Option<CheckpointRecord>,
}

/// Writes checkpoints in the background.
pub(super) struct Checkpoints {
    path: PathBuf,
    /// Seconds between checkpoints; `None`: only at the end.
    every: Option<f64>,
    /// Time at which a checkpoint was last due.
    due: Instant,
    limit: Duration,
    writing: Option<Writing>,
    /// The newest that ended without being told of, for the next record.
    ended: Option<CheckpointRecord>,
    totals: CheckpointTotals,
}

/// A checkpoint in progress.
struct Writing {
    record: CheckpointRecord,
    begun: Instant,
    /// The lock only makes the type `Sync`, since rendering threads share the cycle.
    result: Mutex<Receiver<Result<u64, CheckpointError>>>,
}

impl Drop for Checkpoints {
    /// After an error elsewhere, without [`Checkpoints::finish`], the checkpoint in progress is completed.
    fn drop(&mut self) {
        // Errors are logged by `wait`.
        let _ = self.wait();
    }
}

impl Checkpoints {
    pub(super) fn new(path: PathBuf, every: Option<f64>) -> Self {
        Self { path, every, due: Instant::now(), limit: DISK_LIMIT, writing: None, ended: None, totals: CheckpointTotals::default() }
    }

    /// Totals so far.
    pub(super) fn totals(&self) -> &CheckpointTotals {
        &self.totals
    }

    /// Starts a checkpoint after `frame`, if one is due and the one before has ended. Returns the pause of the loop in seconds, and a warning if frames had to wait.
    ///
    /// # Errors
    /// The device fails.
    pub(super) fn after_frame<S: Surrogate>(&mut self, frame: u64, live: &mut S) -> Result<(f64, Option<String>), DeviceError> {
        if self.every.is_none_or(|seconds| self.due.elapsed().as_secs_f64() < seconds) {
            return Ok((0.0, None));
        }
        // In a pause no frame looks.
        if let Some((record, _)) = self.hear(Duration::ZERO) {
            self.ended = Some(record);
        }
        if let Some(writing) = &mut self.writing {
            self.due = Instant::now();
            writing.record.postponed += 1;
            self.totals.postponed += 1;
            return Ok((0.0, None));
        }
        let begun = Instant::now();
        // If an earlier copy is still being downloaded, the checkpoint stays due for the next frame.
        let Some(state) = live.checkpoint_async()? else { return Ok((0.0, None)) };
        self.due = begun;
        let copy_seconds = begun.elapsed().as_secs_f64();
        self.totals.longest_copy_seconds = self.totals.longest_copy_seconds.max(copy_seconds);
        let told = state.wait_reason().map(|why| format!("the frames waited {copy_seconds:.2} s for a checkpoint: {why}"));
        let record = CheckpointRecord { frame: Some(frame), copy_seconds, asynchronous: told.is_none(), ..CheckpointRecord::default() };
        self.write(record, begun, state);
        Ok((copy_seconds, told))
    }

    fn write(&mut self, record: CheckpointRecord, begun: Instant, state: CheckpointState) {
        let path = self.path.clone();
        self.start(record, begun, move || state.write(&path));
    }

    fn start(&mut self, record: CheckpointRecord, begun: Instant, write: impl FnOnce() -> Result<u64, CheckpointError> + Send + 'static) {
        let (told, result) = channel();
        let path = self.path.clone();
        let work = {
            let told = told.clone();
            // The receiver is gone if the wait for the disk timed out.
            move || drop(told.send(write()))
        };
        if let Err(source) = std::thread::Builder::new().name("ridgewatch-checkpoint".into()).spawn(work) {
            let _ = told.send(Err(CheckpointError::Io { path, source }));
        }
        self.writing = Some(Writing { record, begun, result: Mutex::new(result) });
    }

    /// Record of the checkpoint in progress since the last frame, complete or partial; `None` without one.
    pub(super) fn look(&mut self) -> Option<CheckpointRecord> {
        let ended = self.ended.take().or_else(|| self.hear(Duration::ZERO).map(|(record, _)| record));
        ended.or_else(|| self.under_way())
    }

    fn under_way(&self) -> Option<CheckpointRecord> {
        self.writing.as_ref().map(|w| CheckpointRecord { seconds: w.begun.elapsed().as_secs_f64(), ..w.record.clone() })
    }

    /// Receives the result of the checkpoint in progress, if it completes within this time.
    fn hear(&mut self, within: Duration) -> Option<(CheckpointRecord, Result<(), CheckpointError>)> {
        let result = self.writing.as_mut()?.result.get_mut().unwrap_or_else(PoisonError::into_inner);
        let result = match result.recv_timeout(within) {
            Ok(result) => result,
            Err(RecvTimeoutError::Timeout) => return None,
            Err(RecvTimeoutError::Disconnected) => {
                Err(CheckpointError::Writer { path: self.path.clone(), why: "the thread that wrote it panicked (see above)".into() })
            }
        };
        let mut record = self.under_way()?;
        self.writing = None;
        let result = result.map(|bytes| record.bytes = Some(bytes));
        match &result {
            Ok(()) => self.totals.written += 1,
            Err(error) => {
                tracing::warn!("{error}");
                record.failed = Some(error.to_string());
                self.totals.failed += 1;
            }
        }
        self.totals.last = Some(record.clone());
        Some((record, result))
    }

    /// Waits for the checkpoint in progress. Fails if it takes longer than the limit.
    fn wait(&mut self) -> Result<(), CheckpointError> {
        if self.writing.is_none() {
            return Ok(());
        }
        if let Some((_, result)) = self.hear(self.limit) {
            return result;
        }
        let error = CheckpointError::Hangs { path: self.path.clone(), seconds: self.limit.as_secs() };
        tracing::error!("{error}");
        self.totals.failed += 1;
        self.totals.last = self.under_way().map(|record| CheckpointRecord { failed: Some(error.to_string()), ..record });
        self.writing = None;
        Err(error)
    }

    /// Writes the last checkpoint of a run whose last frame was `frame`, and waits for it.
    ///
    /// # Errors
    /// The last checkpoint cannot be written, or an earlier one hangs. Other errors of the earlier one are logged and counted.
    pub(super) fn finish<S: Surrogate>(&mut self, frame: Option<u64>, live: &S) -> Result<(), CheckpointError> {
        if let Err(hangs @ CheckpointError::Hangs { .. }) = self.wait() {
            return Err(hangs);
        }
        let begun = Instant::now();
        let lost = |source| CheckpointError::Lost { path: self.path.clone(), what: "its numbers", source };
        let state = live.checkpoint().map_err(lost)?;
        let copy_seconds = begun.elapsed().as_secs_f64();
        self.write(CheckpointRecord { frame, copy_seconds, ..CheckpointRecord::default() }, begun, state);
        self.wait()
    }
}

/// Largest number of checkpoints that are kept aside.
const MAX_UNFIT: usize = 99;

/// Keeps a checkpoint that does not fit from being replaced by the next one: it may be the work of another run. Returns where it is, in words.
pub(super) fn set_aside(path: &Path, refused: &CheckpointError) -> String {
    if !matches!(refused, CheckpointError::Mismatch { .. } | CheckpointError::Io { .. }) {
        return String::new();
    }
    for number in 1..=MAX_UNFIT {
        let mut aside = path.as_os_str().to_owned();
        aside.push(if number == 1 { ".unfit".to_owned() } else { format!(".unfit-{number}") });
        // A link takes the name only if it is free.
        match std::fs::hard_link(path, &aside).and_then(|()| std::fs::remove_file(path)) {
            Ok(()) => return format!("; it is now {}", Path::new(&aside).display()),
            Err(error) if error.kind() == std::io::ErrorKind::AlreadyExists => {}
            Err(error) => return format!("; it cannot be set aside: {error}"),
        }
    }
    format!("; it cannot be set aside: {MAX_UNFIT} such files are there")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::Domain;
    use crate::field::analytic::Analytic;
    use crate::flow::{FlowMap, VelocitySource, cpu_tracer};
    use crate::surrogate::network::NetworkSettings;
    use crate::surrogate::{HostSurrogate, SurrogateSettings, build};
    use std::sync::mpsc::Sender;

    fn table() -> HostSurrogate {
        let source = VelocitySource::Analytic(Analytic::Saddle { rate: 1.0 }, Domain::slab([0.0; 2], [1.0; 2], (0.0, 1.0)));
        let tracer = cpu_tracer(source, &FlowMap::tangent(1.0, 4), 0.0).unwrap();
        let settings = SurrogateSettings { table_nodes: Some([3, 3, 1]), ..SurrogateSettings::default() };
        build(&settings, &NetworkSettings::default(), tracer.domain(), 0, &tracer).unwrap()
    }

    /// A writer that is due after every frame and writes until the test sends its result.
    fn slow(folder: &std::path::Path) -> (Checkpoints, Sender<Result<u64, CheckpointError>>) {
        let mut checkpoints = Checkpoints::new(folder.join("weights"), Some(0.0));
        let (end, told) = channel();
        let record = CheckpointRecord { frame: Some(0), asynchronous: true, ..CheckpointRecord::default() };
        checkpoints.start(record, Instant::now(), move || told.recv().unwrap());
        (checkpoints, end)
    }

    #[test]
    fn frames_go_on_while_one_is_written_and_others_wait_for_the_next_time() {
        let folder = tempfile::tempdir().unwrap();
        let (mut checkpoints, end) = slow(folder.path());
        let mut table = table();
        for frame in 1..=5 {
            assert_eq!(checkpoints.after_frame(frame, &mut table).unwrap(), (0.0, None), "nothing is waited for");
            let record = checkpoints.look().unwrap();
            assert_eq!((record.frame, record.bytes, record.postponed), (Some(0), None, frame));
        }
        end.send(Ok(77)).unwrap();
        let (record, result) = checkpoints.hear(DISK_LIMIT).unwrap();
        assert!(result.is_ok() && record.bytes == Some(77) && record.postponed == 5, "{record:?}");
        assert_eq!(checkpoints.look(), None, "told once");
        // The next checkpoint succeeds.
        checkpoints.after_frame(6, &mut table).unwrap();
        let (record, result) = checkpoints.hear(DISK_LIMIT).unwrap();
        assert!(result.is_ok() && record.frame == Some(6) && record.bytes == Some(folder.path().join("weights").metadata().unwrap().len()));
        checkpoints.finish(Some(7), &table).unwrap();
        assert_eq!((checkpoints.totals.written, checkpoints.totals.failed, checkpoints.totals.postponed), (3, 0, 5));
    }

    #[test]
    fn without_frames_the_end_of_one_is_heard_and_told_by_the_next_record() {
        let folder = tempfile::tempdir().unwrap();
        let (mut checkpoints, end) = slow(folder.path());
        let mut table = table();
        checkpoints.after_frame(1, &mut table).unwrap();
        assert_eq!((checkpoints.totals.postponed, checkpoints.totals.written), (1, 0));
        end.send(Ok(77)).unwrap();
        let until = Instant::now() + DISK_LIMIT;
        while checkpoints.totals.written < 3 {
            assert!(Instant::now() < until, "{:?}", checkpoints.totals);
            checkpoints.after_frame(1, &mut table).unwrap();
        }
        let record = checkpoints.look().unwrap();
        assert!(record.frame == Some(1) && record.bytes == Some(folder.path().join("weights").metadata().unwrap().len()), "{record:?}");
        checkpoints.finish(Some(1), &table).unwrap();
    }

    #[test]
    fn the_one_under_way_is_told_of_and_the_last_one_is_waited_for() {
        let folder = tempfile::tempdir().unwrap();
        let (mut checkpoints, end) = slow(folder.path());
        let late = std::thread::spawn(move || {
            std::thread::sleep(Duration::from_millis(50));
            end.send(Err(CheckpointError::Writer { path: "elsewhere".into(), why: "refused by the test".into() })).unwrap();
        });
        checkpoints.finish(Some(3), &table()).unwrap();
        late.join().unwrap();
        let last = checkpoints.totals.last.clone().unwrap();
        assert!(last.frame == Some(3) && last.bytes.is_some() && folder.path().join("weights").exists());
        assert_eq!((checkpoints.totals.written, checkpoints.totals.failed), (1, 1), "the one before is counted");
        // A failed write is an error at the end of the run, and an entry of the record while frames continue.
        let mut nowhere = Checkpoints::new(folder.path().join("no/such/weights"), Some(0.0));
        nowhere.after_frame(0, &mut table()).unwrap();
        let (record, _) = nowhere.hear(DISK_LIMIT).unwrap();
        assert!(record.failed.unwrap().contains("no/such/weights"));
        assert!(matches!(nowhere.finish(Some(1), &table()), Err(CheckpointError::Io { .. })));
        assert_eq!(nowhere.totals.failed, 2);
    }

    #[test]
    fn a_writer_that_hangs_costs_the_limit_and_one_that_panics_an_error() {
        let folder = tempfile::tempdir().unwrap();
        let (mut checkpoints, end) = slow(folder.path());
        checkpoints.limit = Duration::from_millis(50);
        // The call returns although the writer still waits for the test.
        assert!(matches!(checkpoints.finish(Some(1), &table()), Err(CheckpointError::Hangs { .. })));
        drop(checkpoints);
        end.send(Ok(1)).unwrap();

        let (mut checkpoints, end) = slow(folder.path());
        // The writer's thread panics, since its channel is closed.
        drop(end);
        let (record, result) = checkpoints.hear(DISK_LIMIT).unwrap();
        assert!(matches!(result, Err(CheckpointError::Writer { .. })) && record.failed.unwrap().contains("panicked"));
    }
}
