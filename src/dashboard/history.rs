//! What the run keeps in its folder, for pages that look back beyond what they have received: records over all of it, thinned, and pictures by number.

use super::access::parameter;
use super::hub::message;
use super::pixels::{Refusal, Sent, refused, whole};
use crate::publish::PastRun;
use crate::run::FrameRecord;
use axum::http::header::CONTENT_TYPE;
use axum::http::{StatusCode, Uri};
use axum::response::{IntoResponse, Response};
use bytes::Bytes;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::timeout;

/// Pictures and lists that are read or on their way at once.
const MAX_READS: usize = 1;
/// Longest wait for one of these places.
const READ_WAIT: Duration = Duration::from_secs(4);
/// Records of a list.
const LISTED_RECORDS: u64 = 1000;
/// Numbers of frames of a list.
const LISTED_FRAMES: usize = 10_000;
/// Maximum length of a list, in bytes, which proxies accept.
const MAX_LIST_BYTES: usize = 8 << 20;
/// Maximum number of pixels of a picture.
const MAX_PIXELS: usize = 1 << 24;

/// The folder of a run.
#[derive(Debug)]
pub(super) struct History {
    folder: PathBuf,
    /// Of frames of which only the EXR is kept: that of the newest picture.
    pub tone_map: Mutex<[f64; 3]>,
    reads: Arc<Semaphore>,
}

impl History {
    pub fn new(folder: PathBuf) -> Self {
        Self { folder, tone_map: Mutex::new([1.0, 0.5, 1.0]), reads: Arc::new(Semaphore::new(MAX_READS)) }
    }

    /// Answers with the numbers of the frames whose pictures are kept, and records over all of the run, as JSON.
    pub async fn list(&self) -> Response {
        let folder = self.folder.clone();
        let listed = self.read(move || list(&folder)).await;
        listed.map_or_else(refused, |(json, permit)| {
            ([(CONTENT_TYPE, "application/json")], Bytes::from_owner(Sent::new(json, permit))).into_response()
        })
    }

    /// Answers with a kept picture as a message: length and JSON with its record, then the picture as PNG.
    pub async fn picture(&self, uri: &Uri) -> Response {
        let accepted = "the number of a frame";
        let frame = match whole("frame", parameter(uri, "frame").unwrap_or_default(), accepted) {
            Ok(frame) => frame,
            Err(refusal) => return refused(refusal),
        };
        let (folder, tone_map) = (self.folder.clone(), *self.tone_map.lock().unwrap_or_else(PoisonError::into_inner));
        let read = self.read(move || picture(&folder, frame, tone_map)).await;
        read.map_or_else(refused, |(bytes, permit)| {
            ([(CONTENT_TYPE, "application/octet-stream")], Bytes::from_owner(Sent::new(bytes, permit))).into_response()
        })
    }

    /// Reads in another thread, a few at a time.
    async fn read<T: Send + 'static>(
        &self,
        read: impl FnOnce() -> Result<T, Refusal> + Send + 'static,
    ) -> Result<(T, OwnedSemaphorePermit), Refusal> {
        let busy = || (StatusCode::SERVICE_UNAVAILABLE, "other frames of the past are on their way: try again in some seconds".to_owned());
        let permit = timeout(READ_WAIT, Arc::clone(&self.reads).acquire_owned()).await.map_err(|_| busy())?.map_err(|_| busy())?;
        let failed = |error: tokio::task::JoinError| (StatusCode::INTERNAL_SERVER_ERROR, error.to_string());
        Ok((tokio::task::spawn_blocking(read).await.map_err(failed)??, permit))
    }
}

/// Those who watch are not told of files: the log of the dashboard is.
fn unreadable(error: &dyn std::fmt::Display) -> Refusal {
    tracing::warn!("the past of the run: {error}");
    (StatusCode::INTERNAL_SERVER_ERROR, "the folder of the run cannot be read: the log of the dashboard says why".to_owned())
}

fn open(folder: &Path) -> Result<PastRun, Refusal> {
    PastRun::open(folder).map_err(|error| {
        tracing::debug!("{error}");
        (StatusCode::NOT_FOUND, "the run has no records in its folder yet".to_owned())
    })
}

/// What a record tells of its frame.
#[derive(Deserialize)]
struct First {
    frame: u64,
}

fn list(folder: &Path) -> Result<Vec<u8>, Refusal> {
    // Before the first frame.
    let Ok(past) = open(folder) else { return Ok(br#"{"frames":[],"records":[]}"#.to_vec()) };
    let records = thinned(past.some_records(LISTED_RECORDS).map_err(|error| unreadable(&error))?, MAX_LIST_BYTES);
    // Pictures may be kept for longer than records; without them they are not shown.
    let first = records.first().and_then(|record| serde_json::from_str::<First>(record).ok()).map_or(u64::MAX, |first| first.frame);
    let kept: Vec<u64> = past.kept().filter(|frame| *frame >= first).collect();
    let step = kept.len().div_ceil(LISTED_FRAMES).max(1);
    let frames: Vec<u64> = kept.into_iter().rev().step_by(step).collect();
    let numbers = frames.iter().rev().map(u64::to_string).collect::<Vec<_>>().join(",");
    Ok(format!(r#"{{"frames":[{numbers}],"records":[{}]}}"#, records.join(",")).into_bytes())
}

/// Every second record, or fewer, down to this length in bytes. The newest stays.
fn thinned(mut records: Vec<String>, most: usize) -> Vec<String> {
    while records.len() > 1 && records.iter().map(|record| record.len() + 1).sum::<usize>() > most {
        records = records.into_iter().rev().step_by(2).collect();
        records.reverse();
    }
    records
}

/// JSON before a picture, as before those of a publisher.
#[derive(Serialize)]
struct Head<'a> {
    frame: u64,
    encoding: &'static str,
    /// Rows, columns and channels.
    shape: [usize; 3],
    record: &'a FrameRecord,
}

fn picture(folder: &Path, frame: u64, tone_map: [f64; 3]) -> Result<Bytes, Refusal> {
    let past = open(folder)?;
    let record = past.record(frame).map_err(|error| unreadable(&error))?;
    let record = record.ok_or_else(|| (StatusCode::NOT_FOUND, format!("the run has no frame {frame} in its records")))?;
    let gone = || (StatusCode::GONE, format!("the run has no picture of frame {frame} any more: it keeps its newest (publish.keep)"));
    if !past.keeps(frame) {
        return Err(gone());
    }
    let [width, height] = record.size;
    if width.saturating_mul(height) > MAX_PIXELS {
        return Err((StatusCode::PAYLOAD_TOO_LARGE, format!("the picture has {width} x {height} pixels; accepted: {MAX_PIXELS}")));
    }
    let picture = match past.picture(&record, tone_map) {
        Ok(picture) => picture,
        // It may have been deleted since the folder was listed.
        Err(_) if !open(folder)?.keeps(frame) => return Err(gone()),
        Err(error) => return Err(unreadable(&error)),
    };
    let png = picture.png().map_err(|error| unreadable(&error))?;
    let head = Head { frame, encoding: "png", shape: [height, width, 3], record: &record };
    let json = serde_json::to_string(&head).map_err(|error| unreadable(&error))?;
    Ok(message(&json, &png))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_list_that_is_too_long_keeps_the_newest_record_and_even_steps() {
        let records: Vec<String> = (10..31).map(|number| number.to_string()).collect();
        assert_eq!(thinned(records.clone(), 63), records);
        assert_eq!(thinned(records.clone(), 62), ["10", "12", "14", "16", "18", "20", "22", "24", "26", "28", "30"]);
        assert_eq!(thinned(records, 1), ["30"]);
    }
}
