//! Pixels of the newest frame, of the run in this process or as another one publishes its layers, and that frame as a file.

use super::access::parameter;
use super::field::Fields;
use super::layers::Layers;
use super::planes::MAX_PLANES;
use crate::publish::{MAX_LAYERED_PIXELS, NewestFrame, NoField, NoFrame, RunAbout, channels_at, encode_exr, no_error, png};
use crate::render::Film;
use crate::run::Frame;
use axum::http::header::{CONTENT_DISPOSITION, CONTENT_TYPE};
use axum::http::{StatusCode, Uri};
use axum::response::{IntoResponse, Response};
use bytes::Bytes;
use serde::Serialize;
use serde_json::{Map, Value};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Weak};
use tokio::sync::{Mutex, OwnedSemaphorePermit, Semaphore};

/// Maximum number of pixels of a picture that is encoded here: an EXR of some 700 MB before compression.
const MAX_PIXELS: usize = 1 << 24;
/// Files that are encoded or on their way at once. Each may be large.
const MAX_DOWNLOADS: usize = 1;
/// Lossless pictures on their way at once, most of them the same one.
const MAX_PICTURES: usize = 64;

/// Of a picture that is published without its layers. A test holds the number to the publisher's.
const TOO_LARGE: &str = "the run publishes layers of pictures of up to 4194304 pixels; with --dashboard it serves those of larger ones";
/// Of layers that were asked for.
pub(super) const NOT_REACHED: &str = "the run is not reached";
pub(super) const CUT_OFF: &str = "the connection to the run ended before its layers had come: the run has ended, or the link is too slow for them (publish.stall_seconds of the run)";
pub(super) const NOT_COME: &str = "the layers of its newest frame have not come: try again (a run of an earlier version sends none)";
/// Of what is not sent.
pub(super) const NO_WINDOW: &str = "only a run with --dashboard has it, since it is traced in the run's window";
pub(super) const NO_CELLS: &str = "the run did not send its trusted cells: with --dashboard it has them";

/// What is served of the pixels, as a page is told.
#[derive(Debug, Serialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Kept {
    /// The newest frame, of the run of this name, or layers that come when they are asked for.
    Ready(String),
    /// Why nothing is.
    None(&'static str),
}

/// Serves the newest frame: of the run in this process, or as it is received with all layers.
#[derive(Debug)]
pub(super) struct Pixels {
    pub(super) newest: Arc<NewestFrame>,
    /// The run is another process.
    pub(super) is_beside: bool,
    /// Of a run in another process.
    pub(super) layers: Layers,
    /// Its pictures are published with all layers.
    are_whole: AtomicBool,
    /// Pixels of its newest picture that was published without.
    pixels: AtomicUsize,
    pub(super) downloads: Arc<Semaphore>,
    /// The latest picture that was encoded without loss, for all pages that ask for it.
    lossless: Mutex<Option<(Weak<Film>, Bytes)>>,
    pictures: Arc<Semaphore>,
    pub(super) planes: Arc<Semaphore>,
    pub(super) fields: Arc<Fields>,
}

/// A file that a frame is sent as.
#[derive(Debug, Clone, Copy)]
pub(super) enum File {
    Exr,
    Png,
    Record,
    NetCdf,
}

/// A request that is not met: status and words.
pub(super) type Refusal = (StatusCode, String);

/// Bytes of an answer, and the right to send it until all are sent.
pub(super) struct Sent<T> {
    bytes: T,
    _permit: OwnedSemaphorePermit,
}

impl<T> Sent<T> {
    pub fn new(bytes: T, permit: OwnedSemaphorePermit) -> Self {
        Self { bytes, _permit: permit }
    }
}

impl<T: AsRef<[u8]>> AsRef<[u8]> for Sent<T> {
    fn as_ref(&self) -> &[u8] {
        self.bytes.as_ref()
    }
}

impl File {
    /// The file that a path asks for.
    pub fn named(path: &str) -> Option<Self> {
        let files = [("/frame.exr", Self::Exr), ("/frame.png", Self::Png), ("/frame.json", Self::Record), ("/frame.nc", Self::NetCdf)];
        files.into_iter().find(|(end, _)| path.ends_with(end)).map(|(_, file)| file)
    }

    /// Ending of its name, and its media type.
    fn form(self) -> (&'static str, &'static str) {
        match self {
            Self::Exr => ("exr", "image/x-exr"),
            Self::Png => ("png", "image/png"),
            Self::Record => ("json", "application/json"),
            Self::NetCdf => ("nc", "application/netcdf"),
        }
    }

    fn encode(self, frame: &Frame, newest: &NewestFrame) -> Result<Vec<u8>, Refusal> {
        let system = |error: String| (StatusCode::INTERNAL_SERVER_ERROR, error);
        match self {
            Self::Exr => encode_exr(&frame.film, Some(&frame.record)).map_err(system),
            Self::Png => png(&frame.film, frame.tone_map).map_err(|error| system(error.to_string())),
            Self::Record => serde_json::to_vec_pretty(&*frame.record).map_err(|error| system(error.to_string())),
            Self::NetCdf => newest.netcdf(frame).map_err(no_field),
        }
    }
}

impl Pixels {
    pub fn new(newest: Option<Arc<NewestFrame>>) -> Self {
        let [downloads, pictures, planes] = [MAX_DOWNLOADS, MAX_PICTURES, MAX_PLANES].map(|most| Arc::new(Semaphore::new(most)));
        let is_beside = newest.is_none();
        let newest = newest.unwrap_or_else(|| Arc::new(NewestFrame::received()));
        Self {
            newest,
            is_beside,
            layers: Layers::default(),
            are_whole: AtomicBool::new(false),
            pixels: AtomicUsize::new(0),
            downloads,
            lossless: Mutex::default(),
            pictures,
            planes,
            fields: Arc::default(),
        }
    }

    pub fn kept(&self) -> Kept {
        if self.is_too_large() { Kept::None(TOO_LARGE) } else { Kept::Ready(self.newest.about().run().to_owned()) }
    }

    /// Takes a frame of a run in another process that is published with all layers.
    pub fn receive(&self, frame: Frame, about: RunAbout) {
        if self.is_beside {
            self.are_whole.store(true, Ordering::Relaxed);
            self.newest.receive(frame, about);
        }
    }

    /// A picture of a run in another process came, of so many pixels and without its layers.
    pub fn receive_plain(&self, pixels: usize) {
        self.pixels.store(pixels, Ordering::Relaxed);
        // One before may have been of another run.
        if self.are_whole.swap(false, Ordering::Relaxed) {
            self.forget_layers();
        }
    }

    /// Gives up layers that were asked for.
    pub(super) fn forget_layers(&self) {
        if self.is_beside && !self.are_whole.load(Ordering::Relaxed) {
            self.newest.set(None);
        }
    }

    fn is_too_large(&self) -> bool {
        self.is_beside && !self.are_whole.load(Ordering::Relaxed) && self.pixels.load(Ordering::Relaxed) > MAX_LAYERED_PIXELS
    }

    /// As [`Self::frame`]; a run in another process is asked for its layers first, and they are waited for.
    pub(super) async fn needed_frame(&self, uri: &Uri) -> Result<(Frame, Arc<RunAbout>), Refusal> {
        if self.is_beside && !self.are_whole.load(Ordering::Relaxed) && !self.is_too_large() {
            self.layers.need().await;
        }
        self.frame(uri)
    }

    /// The frame that a query asks for by its number, or the newest one, and what is known of its run.
    pub(super) fn frame(&self, uri: &Uri) -> Result<(Frame, Arc<RunAbout>), Refusal> {
        let wanted =
            parameter(uri, "frame").map(|text| whole("frame", text, "the number of a frame, or none for the newest")).transpose()?;
        match self.newest.get(wanted) {
            Ok(frame) => Ok((frame, self.newest.about())),
            Err(NoFrame::NotYet) if self.is_too_large() => Err((StatusCode::PAYLOAD_TOO_LARGE, TOO_LARGE.to_owned())),
            Err(NoFrame::NotYet) if self.is_beside => Err((StatusCode::NOT_FOUND, self.layers.why_none().to_owned())),
            Err(NoFrame::NotYet) => Err((StatusCode::NOT_FOUND, "no frame is complete yet".to_owned())),
            Err(NoFrame::MovedOn { wanted, kept }) if self.is_beside => {
                Err((StatusCode::GONE, format!("frame {wanted} is not kept here: the newest whose layers came is {kept}")))
            }
            Err(NoFrame::MovedOn { wanted, kept }) => {
                Err((StatusCode::GONE, format!("frame {wanted} is no longer kept: the run keeps its newest one, {kept} by now")))
            }
        }
    }

    /// Answers with all that is known of a pixel: the channels of the frame's EXR there, as JSON.
    pub async fn values(&self, uri: &Uri) -> Response {
        self.values_at(uri).await.map_or_else(refused, |json| ([(CONTENT_TYPE, "application/json")], json).into_response())
    }

    async fn values_at(&self, uri: &Uri) -> Result<String, Refusal> {
        #[derive(Serialize)]
        struct Values<'a> {
            frame: u64,
            slide: u64,
            x: usize,
            y: usize,
            size: [usize; 2],
            /// By the names of the EXR; `null` where there is no value.
            channels: Map<String, Value>,
            /// Of `ftle.mean`.
            unit: &'a str,
            /// Method of the frame: the error of a `map` is that of its FTLE.
            method: &'a str,
            /// Why there is no error.
            #[serde(skip_serializing_if = "Option::is_none")]
            no_error: Option<String>,
        }
        let (frame, _) = self.needed_frame(uri).await?;
        let no_error = no_error(&frame);
        let Frame { film, record, color_bar, .. } = frame;
        let at = |name: &str, end: usize| {
            let accepted = format!("a pixel of the picture, 0 to {}", end.saturating_sub(1));
            let text = parameter(uri, name).unwrap_or_default();
            let value = whole(name, text, &accepted)?;
            usize::try_from(value).ok().filter(|value| *value < end).ok_or_else(|| bad(name, text, &accepted))
        };
        let (x, y) = (at("x", film.width)?, at("y", film.height)?);
        let channels: Map<String, Value> =
            channels_at(&film, [x, y]).into_iter().map(|(name, value)| (name.to_owned(), value.into())).collect();
        let unit = color_bar.as_ref().map_or("", |bar| bar.unit.as_str());
        let values =
            Values { frame: record.frame, slide: record.slide, x, y, size: record.size, channels, unit, method: &record.method, no_error };
        serde_json::to_string(&values).map_err(|error| (StatusCode::INTERNAL_SERVER_ERROR, error.to_string()))
    }

    /// Answers with the frame as a file. It is encoded by another thread.
    pub async fn download(&self, file: File, uri: &Uri) -> Response {
        self.encoded(file, uri).await.unwrap_or_else(refused)
    }

    async fn encode(&self, file: File, frame: &Frame) -> Result<Bytes, Refusal> {
        let (frame, newest) = (frame.clone(), Arc::clone(&self.newest));
        let encode = move || file.encode(&frame, &newest);
        let failed = |error: tokio::task::JoinError| (StatusCode::INTERNAL_SERVER_ERROR, error.to_string());
        Ok(tokio::task::spawn_blocking(encode).await.map_err(failed)??.into())
    }

    /// The picture without loss. It is encoded once, whoever asks: idle pages all do.
    async fn lossless(&self, frame: &Frame) -> Result<Bytes, Refusal> {
        let mut latest = self.lossless.lock().await;
        if let Some((_, bytes)) = latest.as_ref().filter(|(film, _)| std::ptr::eq(film.as_ptr(), Arc::as_ptr(&frame.film))) {
            return Ok(bytes.clone());
        }
        let bytes = self.encode(File::Png, frame).await?;
        *latest = Some((Arc::downgrade(&frame.film), bytes.clone()));
        Ok(bytes)
    }

    async fn encoded(&self, file: File, uri: &Uri) -> Result<Response, Refusal> {
        let busy = |_| (StatusCode::SERVICE_UNAVAILABLE, "another file is on its way: try again when it has arrived".to_owned());
        let permits = if matches!(file, File::Png) { &self.pictures } else { &self.downloads };
        let permit = Arc::clone(permits).try_acquire_owned().map_err(busy)?;
        let (frame, about) = if parameter(uri, "if") == Some("newest") {
            match self.frame(uri) {
                // A page that only wants a nicer picture asks for no layers, and is not told of an error, which browsers put on their console.
                Err((StatusCode::GONE | StatusCode::NOT_FOUND | StatusCode::PAYLOAD_TOO_LARGE, _)) => {
                    return Ok(StatusCode::NO_CONTENT.into_response());
                }
                found => found?,
            }
        } else {
            self.needed_frame(uri).await?
        };
        let pixels = frame.film.width * frame.film.height;
        if pixels > MAX_PIXELS {
            let found = format!("the picture has {pixels} pixels; accepted: {MAX_PIXELS}. The run folder holds its files");
            return Err((StatusCode::PAYLOAD_TOO_LARGE, found));
        }
        let (ending, media_type) = file.form();
        let name = format!("{}-frame-{:06}-slide-{:04}.{ending}", about.run(), frame.record.frame, frame.record.slide);
        let failed = |(status, error): Refusal| (status, format!("{name} cannot be made: {error}"));
        let bytes = match file {
            File::Png => self.lossless(&frame).await,
            _ => self.encode(file, &frame).await,
        };
        let bytes = bytes.map_err(failed)?;
        let disposition = format!("attachment; filename=\"{name}\"");
        Ok(([(CONTENT_TYPE, media_type.to_owned()), (CONTENT_DISPOSITION, disposition)], Bytes::from_owner(Sent::new(bytes, permit)))
            .into_response())
    }
}

pub(super) fn no_field(error: NoField) -> Refusal {
    match error {
        NoField::Missing(why) => (StatusCode::NOT_FOUND, why),
        NoField::Gone(why) => (StatusCode::GONE, why),
        NoField::NoRoom(why) => (StatusCode::SERVICE_UNAVAILABLE, why),
        NoField::System(error) => (StatusCode::INTERNAL_SERVER_ERROR, error),
    }
}

pub(super) fn refused((status, words): Refusal) -> Response {
    (status, words + "\n").into_response()
}

pub(super) fn bad(name: &str, found: &str, accepted: &str) -> Refusal {
    let found: String = found.chars().take(32).collect();
    (StatusCode::BAD_REQUEST, format!("`{name}` is \"{found}\"; accepted: {accepted}"))
}

pub(super) fn whole(name: &str, text: &str, accepted: &str) -> Result<u64, Refusal> {
    text.parse().map_err(|_| bad(name, text, accepted))
}
