//! The newest frame of a run in memory, and its slide, for those who ask about its pixels or want it as a file.

use super::export::{MapAbout, NewestSlide, NoField, map_netcdf};
use crate::run::{Frame, Plan};
use serde::{Deserialize, Serialize};
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};

/// Maximum length of the name of a run.
const MAX_NAME: usize = 100;

/// What is to be known of a run beside its frames.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunAbout {
    /// Its name in names of files: letters, digits, `-`, `_` and `.`.
    run: String,
    /// `None`: unknown.
    map: Option<MapAbout>,
}

impl RunAbout {
    /// Of a run that writes into this folder.
    pub fn new(folder: &Path, map: MapAbout) -> Self {
        let name = folder.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
        Self { run: plain(&name), map: Some(map) }
    }

    /// As another program tells it, in JSON.
    pub fn told(json: Option<&serde_json::Value>) -> Self {
        let told = json.and_then(|json| Self::deserialize(json).ok());
        told.map_or_else(|| Self { run: plain(""), map: None }, |told| Self { run: plain(&told.run), ..told })
    }

    /// Its name in names of files: letters, digits, `-`, `_` and `.`.
    pub fn run(&self) -> &str {
        &self.run
    }
}

/// What every file system and a quoted string of HTTP accept.
fn plain(name: &str) -> String {
    let plain: String = name.chars().take(MAX_NAME).map(|c| if c.is_ascii_alphanumeric() || "-_.".contains(c) { c } else { '_' }).collect();
    if plain.is_empty() { "run".to_owned() } else { plain }
}

/// Keeps one frame: the newest. Its picture is shared with those who publish and write it, not copied.
#[derive(Debug)]
pub struct NewestFrame {
    about: Mutex<Arc<RunAbout>>,
    frame: Mutex<Option<Frame>>,
    /// `None` if no slides are kept.
    slide: Option<NewestSlide>,
}

/// Why a frame is not there.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NoFrame {
    /// No frame is complete yet.
    NotYet,
    /// Another one is kept by now.
    MovedOn {
        /// Number of the one that was asked for.
        wanted: u64,
        /// Number of the one that is kept.
        kept: u64,
    },
}

impl NewestFrame {
    /// Of a run that writes into this folder, whose name goes into the names of files. Keeps its slides as well.
    pub fn of_run(folder: &Path, plan: &Plan) -> Self {
        Self { slide: Some(NewestSlide::new(plan)), ..Self::new(folder, MapAbout::new(plan)) }
    }

    /// The same of frames alone.
    pub fn new(folder: &Path, about: MapAbout) -> Self {
        Self { about: Mutex::new(Arc::new(RunAbout::new(folder, about))), frame: Mutex::default(), slide: None }
    }

    /// Of frames that another process publishes, with all their layers.
    pub fn received() -> Self {
        Self { about: Mutex::new(Arc::new(RunAbout::told(None))), frame: Mutex::default(), slide: None }
    }

    /// What is known of the run.
    pub fn about(&self) -> Arc<RunAbout> {
        Arc::clone(&self.about.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// The pixels of a frame, of a map, as NetCDF by the CF conventions.
    ///
    /// # Errors
    /// Why it is no such field, or what the system refuses.
    pub fn netcdf(&self, frame: &Frame) -> Result<Vec<u8>, NoField> {
        let unknown = || NoField::Missing("the run did not tell what its coordinates mean: with --dashboard it serves the file".to_owned());
        let about = self.about();
        map_netcdf(frame, about.map.as_ref().ok_or_else(unknown)?, &about.run)
    }

    /// The slide of the newest frame; `None` if no slides are kept.
    pub fn slide(&self) -> Option<&NewestSlide> {
        self.slide.as_ref()
    }

    /// Keeps this frame in place of the one before.
    pub fn put(&self, frame: Frame) {
        self.set(Some(frame));
    }

    /// Keeps a frame that was received, and what its publisher told of the run.
    pub fn receive(&self, frame: Frame, about: RunAbout) {
        *self.about.lock().unwrap_or_else(PoisonError::into_inner) = Arc::new(about);
        self.put(frame);
    }

    /// Keeps this frame, or none.
    pub fn set(&self, frame: Option<Frame>) {
        let before = std::mem::replace(&mut *self.lock(), frame);
        // A large picture is given back to the system without the lock.
        drop(before);
    }

    /// The frame of this number, or the newest one.
    ///
    /// # Errors
    /// It is not there.
    pub fn get(&self, wanted: Option<u64>) -> Result<Frame, NoFrame> {
        let newest = self.lock().clone().ok_or(NoFrame::NotYet)?;
        match wanted.filter(|wanted| *wanted != newest.record.frame) {
            Some(wanted) => Err(NoFrame::MovedOn { wanted, kept: newest.record.frame }),
            None => Ok(newest),
        }
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, Option<Frame>> {
        self.frame.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::Film;
    use crate::run::FrameRecord;
    use std::sync::{Arc, Weak};

    fn frame(number: u64) -> (Frame, Weak<Film>) {
        let film = Arc::new(Film::new(4, 2));
        let (record, weak) = (FrameRecord { frame: number, ..Default::default() }, Arc::downgrade(&film));
        (Frame { record: Arc::new(record), film, tone_map: [1.0, 0.5, 1.0], color_bar: None, gate: None }, weak)
    }

    #[test]
    fn what_another_program_tells_of_a_run_is_made_plain() {
        let told = |json: &str| RunAbout::told(Some(&serde_json::from_str(json).unwrap()));
        assert_eq!(told(r#"{"run": "../a b\"; x", "map": null}"#), RunAbout { run: ".._a_b___x".to_owned(), map: None });
        assert_eq!(told(&format!(r#"{{"run": "{}"}}"#, "a".repeat(1000))).run().len(), MAX_NAME);
        assert_eq!(told("3"), RunAbout { run: "run".to_owned(), map: None });
        let own = RunAbout::new(Path::new("out/gulf"), MapAbout::default());
        assert_eq!(RunAbout::told(serde_json::to_value(&own).ok().as_ref()), own);
    }

    #[test]
    fn one_frame_is_kept_and_an_earlier_one_is_freed() {
        let newest = NewestFrame::new(Path::new("out/some run\"1"), MapAbout::default());
        assert_eq!(newest.about().run(), "some_run_1");
        assert_eq!(RunAbout::new(Path::new(".."), MapAbout::default()).run(), "run");
        assert_eq!(newest.get(None).unwrap_err(), NoFrame::NotYet);
        let ((first, film), (second, _)) = (frame(3), frame(4));
        newest.put(first);
        assert_eq!((newest.get(None).unwrap().record.frame, newest.get(Some(3)).unwrap().record.frame), (3, 3));
        newest.put(second);
        assert_eq!(newest.get(Some(3)).unwrap_err(), NoFrame::MovedOn { wanted: 3, kept: 4 });
        assert!(film.upgrade().is_none(), "the first picture is no longer in memory");
    }
}
