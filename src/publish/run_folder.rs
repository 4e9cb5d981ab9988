//! The run folder: `scene.toml`, `frames/frame_000000.exr` and `.png`, `maps/slide_000000.png` and `.json`, `records.jsonl` (and `records-1.jsonl`),
//! `summary.json`.

use super::error::PublishError;
use super::exr::encode_exr;
use super::preview::png;
use super::scene::{is_ours, refuse_foreign_scene, text_of};
use super::settings::{ExrFrames, PublishSettings};
use super::summary::Summary;
use crate::folder::{Folder, Lock};
use crate::run::{Frame, FrameRecord};
use std::collections::VecDeque;
use std::ffi::OsString;
use std::fs::File;
use std::io::{self, Write};
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Folder of the pictures.
pub(super) const FRAMES: &str = "frames";
/// Folder of the maps, made for the first one.
const MAPS: &str = "maps";
/// Records, one JSON object a line.
pub(super) const RECORDS: &str = "records.jsonl";
/// Older records, if their size is capped.
pub(super) const OLDER_RECORDS: &str = "records-1.jsonl";
/// Holds the files of the previous run until the new one has a frame.
const PREVIOUS: &str = ".previous";
/// Scene of the run.
const SCENE: &str = "scene.toml";
/// Written at the end.
const SUMMARY: &str = "summary.json";
/// Locked by the run that writes, and by nobody once its process has ended. It stays.
const LOCK: &str = ".ridgewatch.lock";
/// Attempts to take the lock, and the pause between them: another process holds it for a moment while it looks for a vacant folder.
const ATTEMPTS: usize = 5;
const PAUSE: Duration = Duration::from_millis(20);
/// Attempts to create the first vacant folder. Each fails because another run takes it at that moment.
const VACANT_ATTEMPTS: usize = 100;

/// Encodes the PNG of a frame.
pub type DrawFrame = fn(&Frame) -> io::Result<Vec<u8>>;

/// The picture alone.
fn plain(frame: &Frame) -> io::Result<Vec<u8>> {
    png(&frame.film, frame.tone_map).map_err(io::Error::other)
}

/// A folder that only this run writes to. It is held open, so that its files are written into the folder that was checked.
#[derive(Debug)]
pub struct RunFolder {
    folder: Folder,
    frames: Folder,
    records: File,
    /// Length of `records.jsonl` up to its last complete line.
    complete: u64,
    /// Number of lines of `records.jsonl` and of `records-1.jsonl`.
    lines: [u64; 2],
    /// Number of records in files that were replaced.
    records_removed: u64,
    /// Pictures in the folder, oldest first.
    kept: VecDeque<Kept>,
    kept_bytes: u64,
    draw: DrawFrame,
    /// `None` before the first map.
    maps: Option<Folder>,
    /// Maps in the folder, oldest first.
    kept_maps: VecDeque<Kept>,
    /// Folder with the files of the previous run, until this one has a frame.
    previous: Option<Folder>,
    _lock: Lock,
}

#[derive(Debug)]
struct Kept {
    slide: u64,
    /// Names with sizes in bytes.
    files: Vec<(String, u64)>,
}

impl Kept {
    fn bytes(&self) -> u64 {
        self.files.iter().map(|(_, bytes)| bytes).sum()
    }
}

/// The map of a slide.
#[derive(Debug)]
pub struct SlideMap {
    /// Number of the slide.
    pub slide: u64,
    /// The picture.
    pub png: Vec<u8>,
    /// Its record, as JSON.
    pub record: Vec<u8>,
}

/// Result of writing a frame's pictures.
#[derive(Debug, Default, Clone, Copy, PartialEq, Eq)]
pub struct Written {
    /// Bytes of its pictures.
    pub bytes: u64,
    /// Number of older frames whose pictures were deleted.
    pub removed: u64,
    /// Whether it replaced the EXR of an older frame of its slide.
    pub replaced: bool,
}

impl RunFolder {
    /// Returns the first of `path`, `path-2`, `path-3` and so on that holds no run.
    ///
    /// # Errors
    /// A folder that cannot be read.
    pub fn vacant(path: &Path) -> Result<PathBuf, PublishError> {
        let numbered = (2_u32..).map(|n| {
            let mut name = path.as_os_str().to_owned();
            name.push(format!("-{n}"));
            PathBuf::from(name)
        });
        for place in std::iter::once(path.to_owned()).chain(numbered) {
            let failed = |source| PublishError::Folder { path: place.clone(), source };
            if holder(&place).map_err(failed)?.is_none() && occupied(&place).map_err(failed)?.is_none() {
                return Ok(place);
            }
        }
        unreachable!("a folder holds fewer than 2^32 others")
    }

    /// Creates the first of `path`, `path-2`, `path-3` and so on that holds no run, also if several runs do so at the same time.
    ///
    /// # Errors
    /// As [`RunFolder::create`]; `InUse` if other runs take each folder first, a hundred times.
    pub fn create_vacant(path: &Path) -> Result<Self, PublishError> {
        Self::create_first(path, &mut |place| Self::create(place, false))
    }

    fn create_first(path: &Path, create: &mut dyn FnMut(&Path) -> Result<Self, PublishError>) -> Result<Self, PublishError> {
        for _ in 1..VACANT_ATTEMPTS {
            match create(&Self::vacant(path)?) {
                Err(PublishError::InUse { .. } | PublishError::Occupied { .. }) => {}
                created => return created,
            }
        }
        create(&Self::vacant(path)?)
    }

    /// Checks that a run may be written to `path`; changes nothing.
    ///
    /// # Errors
    /// The folder holds a run (unless `overwrite`), a run that is in progress, or a scene that no run wrote, or cannot be read.
    pub fn refuse_occupied(path: &Path, overwrite: bool) -> Result<(), PublishError> {
        if let Some(holder) = holder(path).map_err(|source| PublishError::Folder { path: path.to_owned(), source })? {
            return Err(PublishError::InUse { path: path.to_owned(), holder });
        }
        Self::refuse_finished(path, overwrite)
    }

    fn refuse_finished(path: &Path, overwrite: bool) -> Result<(), PublishError> {
        refuse_foreign_scene(&path.join(SCENE))?;
        if overwrite {
            return Ok(());
        }
        match occupied(path).map_err(|source| PublishError::Folder { path: path.to_owned(), source })? {
            Some(found) => Err(PublishError::Occupied { path: path.to_owned(), found }),
            None => Ok(()),
        }
    }

    /// Creates the folder, takes its lock and checks that it can be written to, and that nobody else can put files into it. With `overwrite`, the
    /// files of a previous run, and no others, are moved to `.previous` until this run has a frame.
    ///
    /// # Errors
    /// As [`RunFolder::refuse_occupied`], or a folder that cannot be written to, belongs to another user or may be written into by all users.
    pub fn create(path: &Path, overwrite: bool) -> Result<Self, PublishError> {
        let refuse = |at: &Path, source| PublishError::Folder { path: at.to_owned(), source };
        let failed = |source| refuse(path, source);
        // Whatever the umask: a folder into which all users may write is refused below.
        let mut make = std::fs::DirBuilder::new();
        make.recursive(true).mode(0o775);
        make.create(path).map_err(failed)?;
        let folder = Folder::open(path).map_err(failed)?;
        folder.check_owner().map_err(failed)?;
        let lock = lock(&folder).map_err(|error| match error.kind() {
            io::ErrorKind::WouldBlock => PublishError::InUse { path: path.to_owned(), holder: error.to_string() },
            _ => refuse(&path.join(LOCK), error),
        })?;
        make.create(path.join(FRAMES)).map_err(|error| refuse(&path.join(FRAMES), error))?;
        let frames = folder.inner(FRAMES).and_then(|frames| frames.check_owner().map(|()| frames));
        let frames = frames.map_err(|error| refuse(&path.join(FRAMES), error))?;
        Self::refuse_finished(path, overwrite)?;
        let old = run_files(&folder, Some(&frames)).map_err(failed)?;
        let empty = old.iter().all(|old| old.is_empty(&folder));
        let aside = |error| refuse(&path.join(PREVIOUS), error);
        if !empty {
            remove_previous(&folder).map_err(aside)?;
        }
        let previous = if empty { folder.existing(PREVIOUS) } else { folder.inner(PREVIOUS).map(Some) }.map_err(aside)?;
        // Opened if there is one to move.
        let maps = folder.existing(MAPS).map_err(|error| refuse(&path.join(MAPS), error))?;
        for old in &old {
            let from = match (old.place, &maps) {
                (Place::Frames, _) => &frames,
                (Place::Maps, Some(maps)) => maps,
                _ => &folder,
            };
            let moved = match &previous {
                Some(previous) if !empty => from.rename(&old.name, previous, &old.name),
                _ => from.remove(&old.name),
            };
            moved.map_err(|error| refuse(&from.path().join(&old.name), error))?;
        }
        let probe = ".probe";
        // A link of this name is removed, not followed.
        let _ = frames.remove(probe);
        let probed = frames.create_new(probe).and_then(|mut file| file.write_all(b"ridgewatch")).and_then(|()| frames.remove(probe));
        if let Err(error) = probed {
            if let Some(previous) = &previous {
                restore(&folder, &frames, previous).map_err(aside)?;
            }
            return Err(refuse(&path.join(FRAMES), error));
        }
        let records = folder.create_new(RECORDS).map_err(|e| refuse(&path.join(RECORDS), e))?;
        Ok(Self {
            folder,
            frames,
            records,
            complete: 0,
            lines: [0; 2],
            records_removed: 0,
            kept: VecDeque::new(),
            kept_bytes: 0,
            draw: plain,
            maps: None,
            kept_maps: VecDeque::new(),
            previous,
            _lock: lock,
        })
    }

    /// Moves the files of the previous run back. Returns whether there was a previous run. After an error, files that could not be moved stay in
    /// `.previous`.
    fn restore_previous(&mut self) -> io::Result<bool> {
        let Some(previous) = self.previous.take() else { return Ok(false) };
        restore(&self.folder, &self.frames, &previous)?;
        Ok(true)
    }

    /// Moves the files of the previous run back, for a run that ends without a frame. Errors are warnings. Returns whether there was one.
    pub fn give_up(&mut self) -> bool {
        self.restore_previous().unwrap_or_else(|error| {
            tracing::warn!("{}: the previous run cannot be restored: {error}", self.path().display());
            false
        })
    }

    /// Draws the PNGs of frames by another function than the picture alone.
    pub fn draw_by(&mut self, draw: DrawFrame) {
        self.draw = draw;
    }

    /// The folder.
    pub fn path(&self) -> &Path {
        self.folder.path()
    }

    /// Bytes of the pictures in the folder.
    pub fn kept_bytes(&self) -> u64 {
        self.kept_bytes
    }

    /// Appends a line to `records.jsonl`. If the file would exceed half of `max_bytes`, it first replaces `records-1.jsonl`. After an error the
    /// file still ends with a complete line.
    ///
    /// # Errors
    /// Errors of the system.
    pub fn append_record(&mut self, record: &FrameRecord, max_bytes: Option<u64>) -> io::Result<()> {
        let mut line = serde_json::to_vec(record)?;
        line.push(b'\n');
        self.trim()?;
        let full = max_bytes.is_some_and(|max| self.complete > 0 && self.complete + line.len() as u64 > max / 2);
        if full {
            self.rotate_records()?;
        }
        match self.records.write_all(&line) {
            Ok(()) => {
                self.complete += line.len() as u64;
                self.lines[0] += 1;
                if let Some(previous) = self.previous.take()
                    && let Err(error) = remove_previous(&self.folder)
                {
                    tracing::warn!("{}: cannot be removed: {error}", previous.path().display());
                }
                Ok(())
            }
            Err(error) => {
                // If this fails too, the next append tries again.
                let _ = self.trim();
                Err(error)
            }
        }
    }

    /// Number of records removed to stay within the cap.
    pub fn records_removed(&self) -> u64 {
        self.records_removed
    }

    /// Renames `records.jsonl` to `records-1.jsonl` and begins a new file. Also completes an attempt that failed half-way.
    fn rotate_records(&mut self) -> io::Result<()> {
        match self.folder.rename(RECORDS, &self.folder, OLDER_RECORDS) {
            Ok(()) => {
                self.records_removed += self.lines[1];
                self.lines = [0, self.lines[0]];
            }
            // It was renamed by an earlier attempt, or removed by somebody.
            Err(error) if error.kind() == io::ErrorKind::NotFound => self.lines[0] = 0,
            Err(error) => return Err(error),
        }
        self.records = self.folder.create_new(RECORDS)?;
        self.complete = 0;
        Ok(())
    }

    /// Removes the incomplete line of a failed append.
    fn trim(&mut self) -> io::Result<()> {
        if self.records.metadata()?.len() > self.complete { self.records.set_len(self.complete) } else { Ok(()) }
    }

    /// Writes the frame's pictures, then deletes those of the oldest frames beyond `keep` and `keep_bytes`.
    ///
    /// # Errors
    /// A film that cannot be encoded, or an error of the system. Then none of the frame's pictures remains.
    pub fn write_pictures(&mut self, frame: &Frame, settings: &PublishSettings) -> io::Result<Written> {
        let name = format!("frame_{:06}", frame.record.frame);
        let mut new = Kept { slide: frame.record.slide, files: Vec::new() };
        let outcome = (|| {
            if settings.exr != ExrFrames::None {
                let bytes = encode_exr(&frame.film, Some(&frame.record)).map_err(io::Error::other)?;
                self.write_picture(&mut new, &format!("{name}.exr"), &bytes)?;
            }
            if settings.preview {
                let bytes = (self.draw)(frame)?;
                self.write_picture(&mut new, &format!("{name}.png"), &bytes)?;
            }
            Ok(())
        })();
        if let Err(error) = outcome {
            self.remove(&new.files);
            return Err(error);
        }
        let replaced = settings.exr == ExrFrames::Slide && self.remove_exr_of_slide(new.slide);
        let bytes = new.bytes();
        self.kept_bytes += bytes;
        self.kept.push_back(new);
        Ok(Written { bytes, removed: self.make_room(settings), replaced })
    }

    /// Writes the map of a slide, and returns its bytes. With `keep` no more maps stay than frames may, and older ones go beyond `keep_bytes`.
    ///
    /// # Errors
    /// Errors of the system. Then no file of the map remains.
    pub fn write_map(&mut self, map: &SlideMap, settings: &PublishSettings) -> io::Result<u64> {
        let maps = match self.maps.take() {
            Some(maps) => maps,
            None => {
                let maps = self.folder.inner(MAPS)?;
                maps.check_owner()?;
                maps
            }
        };
        let maps = self.maps.insert(maps);
        let name = format!("slide_{:06}", map.slide);
        let mut new = Kept { slide: map.slide, files: Vec::new() };
        for (extension, bytes) in [("png", &map.png), ("json", &map.record)] {
            let file = format!("{name}.{extension}");
            if let Err(error) = maps.write_whole(&file, bytes) {
                remove(maps, &new.files);
                return Err(error);
            }
            new.files.push((file, bytes.len() as u64));
        }
        let bytes = new.bytes();
        self.kept_bytes += bytes;
        self.kept_maps.push_back(new);
        let (max, max_bytes) = (settings.keep.unwrap_or(usize::MAX), settings.keep_bytes.unwrap_or(u64::MAX));
        while self.kept_maps.len() > max || (self.kept_maps.len() > 1 && self.kept_bytes > max_bytes) {
            self.remove_oldest_map();
        }
        Ok(bytes)
    }

    fn remove_oldest_map(&mut self) {
        if let (Some(oldest), Some(maps)) = (self.kept_maps.pop_front(), &self.maps) {
            remove(maps, &oldest.files);
            self.kept_bytes -= oldest.bytes();
        }
    }

    /// Deletes the EXR of the newest frame in the folder if it belongs to this slide. Its preview remains.
    fn remove_exr_of_slide(&mut self, slide: u64) -> bool {
        let Some(last) = self.kept.back_mut().filter(|last| last.slide == slide) else { return false };
        let is_exr = |file: &(String, u64)| file.0.ends_with(".exr");
        let Some(at) = last.files.iter().position(is_exr) else { return false };
        let exr = last.files.remove(at);
        self.kept_bytes -= exr.1;
        if last.files.is_empty() {
            self.kept.pop_back();
        }
        self.remove(&[exr]);
        true
    }

    fn write_picture(&self, new: &mut Kept, name: &str, bytes: &[u8]) -> io::Result<()> {
        self.frames.write_whole(name, bytes)?;
        new.files.push((name.to_owned(), bytes.len() as u64));
        Ok(())
    }

    /// Deletes pictures of the oldest frames until both caps hold. The newest frame is always kept.
    fn make_room(&mut self, settings: &PublishSettings) -> u64 {
        let (max, max_bytes) = (settings.keep.unwrap_or(usize::MAX), settings.keep_bytes.unwrap_or(u64::MAX));
        let mut removed = 0;
        while self.kept.len() > 1 && (self.kept.len() > max || self.kept_bytes > max_bytes) {
            let Some(oldest) = self.kept.pop_front() else { break };
            self.remove(&oldest.files);
            self.kept_bytes -= oldest.bytes();
            removed += 1;
            // Maps of slides whose frames are gone.
            let first = self.kept.front().map_or(0, |kept| kept.slide);
            while self.kept_maps.front().is_some_and(|map| map.slide < first) {
                self.remove_oldest_map();
            }
        }
        removed
    }

    /// Writes `scene.toml`, from which `command` repeats the run.
    ///
    /// # Errors
    /// Errors of the system.
    pub fn write_scene(&self, command: &str, scene: &str) -> Result<(), PublishError> {
        let path = self.path().join(SCENE);
        let written = self.folder.write_whole(SCENE, text_of(SCENE, command, scene).as_bytes());
        written.map_err(|error| PublishError::File { path, problem: format!("cannot be written: {error}") })
    }

    /// Makes the file of the records one that takes no byte, as a disk that hangs.
    #[cfg(test)]
    pub(super) fn hang(&mut self, full: File) {
        self.records = full;
    }

    /// Writes `summary.json`.
    ///
    /// # Errors
    /// Errors of the system.
    pub fn write_summary(&self, summary: &Summary) -> Result<(), PublishError> {
        let json = serde_json::to_vec_pretty(summary).map_err(io::Error::from);
        let written = json.and_then(|json| self.folder.write_whole(SUMMARY, &json));
        written.map_err(|source| PublishError::Folder { path: self.path().join(SUMMARY), source })
    }

    fn remove(&self, files: &[(String, u64)]) {
        remove(&self.frames, files);
    }
}

/// Deletes pictures. Files that do not exist any more are ignored; other errors are warnings.
fn remove(folder: &Folder, files: &[(String, u64)]) {
    for (file, _) in files {
        match folder.remove(file) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => {
                tracing::warn!("{}: cannot be removed: {error}", folder.path().join(file).display());
            }
            _ => {}
        }
    }
}

/// Takes the lock of a run folder.
fn lock(folder: &Folder) -> io::Result<Lock> {
    for _ in 1..ATTEMPTS {
        match folder.lock(LOCK) {
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => std::thread::sleep(PAUSE),
            taken => return taken,
        }
    }
    folder.lock(LOCK)
}

/// The process whose run writes into a folder. `None` if there is none, or no folder.
fn holder(path: &Path) -> io::Result<Option<String>> {
    let folder = match Folder::open(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        folder => folder?,
    };
    folder.holder(LOCK)
}

/// Removes the files of the previous run.
fn remove_previous(folder: &Folder) -> io::Result<()> {
    let Some(previous) = folder.existing(PREVIOUS)? else { return Ok(()) };
    for name in previous.names()? {
        previous.remove(name)?;
    }
    folder.remove_folder(PREVIOUS)
}

/// Moves the files of the previous run back.
fn restore(folder: &Folder, frames: &Folder, previous: &Folder) -> io::Result<()> {
    // A previous run without a scene must not keep the scene of this one.
    if let Err(error) = folder.remove(SCENE)
        && error.kind() != io::ErrorKind::NotFound
    {
        return Err(error);
    }
    for name in previous.names()? {
        match name.to_str() {
            Some(known) if is_picture(known) => previous.rename(&name, frames, &name)?,
            Some(known) if is_map(known) => previous.rename(&name, &folder.inner(MAPS)?, &name)?,
            _ => previous.rename(&name, folder, &name)?,
        }
    }
    folder.remove_folder(PREVIOUS)
}

/// A file of a run.
struct OldFile {
    name: OsString,
    place: Place,
}

/// Where a file of a run is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Place {
    Run,
    Frames,
    Maps,
}

impl OldFile {
    /// Whether it may be lost, as the files of a run that failed before its first frame.
    fn is_empty(&self, folder: &Folder) -> bool {
        if self.name == RECORDS || self.name == OLDER_RECORDS { folder.length(&self.name) == Some(0) } else { self.place == Place::Run }
    }
}

/// Files of a run in the folder.
fn run_files(folder: &Folder, frames: Option<&Folder>) -> io::Result<Vec<OldFile>> {
    let known = [RECORDS, OLDER_RECORDS, SUMMARY, ".summary.json.part", ".scene.toml.part"];
    let mut files: Vec<OldFile> =
        known.into_iter().filter(|name| folder.has(name)).map(|name| OldFile { name: name.into(), place: Place::Run }).collect();
    if folder.has(SCENE) && is_ours(&folder.path().join(SCENE))? {
        files.push(OldFile { name: SCENE.into(), place: Place::Run });
    }
    if let Some(frames) = frames {
        let pictures = frames.names()?.into_iter().filter(|name| name.to_str().is_some_and(is_picture));
        files.extend(pictures.map(|name| OldFile { name, place: Place::Frames }));
    }
    if let Some(maps) = folder.existing(MAPS)? {
        let found = maps.names()?.into_iter().filter(|name| name.to_str().is_some_and(is_map));
        files.extend(found.map(|name| OldFile { name, place: Place::Maps }));
    }
    Ok(files)
}

/// First file of a run in a folder. `None` if the folder holds no run or does not exist.
fn occupied(path: &Path) -> io::Result<Option<String>> {
    let folder = match Folder::open(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        folder => folder?,
    };
    // Left by a process that was killed before its first frame; it holds the previous run.
    if folder.has(PREVIOUS) {
        return Ok(Some(PREVIOUS.into()));
    }
    let files = run_files(&folder, folder.existing(FRAMES)?.as_ref())?;
    if files.iter().all(|file| file.is_empty(&folder)) {
        return Ok(None);
    }
    let shown = |file: &OldFile| match file.place {
        Place::Run => PathBuf::from(&file.name),
        Place::Frames => Path::new(FRAMES).join(&file.name),
        Place::Maps => Path::new(MAPS).join(&file.name),
    };
    Ok(files.first().map(|file| shown(file).display().to_string()))
}

/// Whether the name is that of a picture of a run, complete or not.
fn is_picture(name: &str) -> bool {
    is_numbered(name, "frame_", [".exr", ".png"])
}

/// Whether the name is that of a map of a run or of its record, complete or not.
fn is_map(name: &str) -> bool {
    is_numbered(name, "slide_", [".png", ".json"])
}

fn is_numbered(name: &str, begin: &str, ends: [&str; 2]) -> bool {
    let name = name.strip_prefix('.').and_then(|n| n.strip_suffix(".part")).unwrap_or(name);
    let number = name.strip_prefix(begin).and_then(|n| ends.iter().find_map(|end| n.strip_suffix(end)));
    number.is_some_and(|n| n.len() >= 6 && n.bytes().all(|b| b.is_ascii_digit()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::Film;
    use std::fs;
    use std::os::unix::fs::symlink;
    use std::sync::Arc;

    #[test]
    fn a_run_in_progress_keeps_others_out() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("run");
        let run = RunFolder::create(&path, false).unwrap();
        for overwrite in [false, true] {
            let refused = RunFolder::create(&path, overwrite).unwrap_err();
            let expected = format!("in use by process {}", std::process::id());
            assert!(matches!(refused, PublishError::InUse { .. }) && refused.to_string().contains(&expected), "{refused}");
            assert!(matches!(RunFolder::refuse_occupied(&path, overwrite), Err(PublishError::InUse { .. })));
        }
        assert_eq!(RunFolder::vacant(&path).unwrap(), folder.path().join("run-2"), "it has no frame yet");
        drop(run);
        RunFolder::create(&RunFolder::vacant(&path).unwrap(), false).unwrap();
    }

    /// As several `attach` that waited for one simulation.
    #[test]
    fn runs_that_begin_together_have_a_folder_each() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("run");
        // Others take what was vacant a moment ago, three times.
        let mut others = Vec::new();
        let mut create = |place: &Path| {
            if others.len() < 3 {
                others.push(RunFolder::create(place, false).unwrap());
            }
            RunFolder::create(place, false)
        };
        let run = RunFolder::create_first(&path, &mut create).unwrap();
        assert_eq!(run.path(), folder.path().join("run-4"));
        assert_eq!(RunFolder::create_vacant(&path).unwrap().path(), folder.path().join("run-5"));
        // One that always comes second ends.
        let mut taken = Vec::new();
        let refused = RunFolder::create_first(&path, &mut |place| {
            taken.push(place.to_owned());
            Err(PublishError::InUse { path: place.to_owned(), holder: "another process".into() })
        });
        assert!(matches!(refused, Err(PublishError::InUse { .. })) && taken.len() == VACANT_ATTEMPTS);
    }

    #[test]
    fn a_lock_of_another_program_is_left_alone() {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join(".lock"), "theirs").unwrap();
        let other = Folder::open(folder.path()).unwrap();
        let _held = other.lock(".lock").unwrap();
        fs::write(folder.path().join(".lock"), "theirs").unwrap();
        drop(RunFolder::create(folder.path(), false).unwrap());
        assert_eq!(fs::read(folder.path().join(".lock")).unwrap(), b"theirs");
    }

    #[test]
    fn links_and_pipes_in_the_folder_are_not_followed() {
        let (folder, victim) = (tempfile::tempdir().unwrap(), tempfile::NamedTempFile::new().unwrap());
        fs::write(victim.path(), "precious").unwrap();
        let frames = folder.path().join(FRAMES);
        fs::create_dir(&frames).unwrap();
        symlink(victim.path(), frames.join(".probe")).unwrap();
        let mut run = RunFolder::create(folder.path(), false).unwrap();
        for link in
            [frames.join(".frame_000000.png.part"), folder.path().join(".summary.json.part"), folder.path().join(".scene.toml.part")]
        {
            symlink(victim.path(), link).unwrap();
        }
        assert!(std::process::Command::new("mkfifo").arg(frames.join(".frame_000000.exr.part")).status().unwrap().success());
        run.write_pictures(&frame(0), &PublishSettings::default()).unwrap();
        run.write_scene("replay", "seed = 1\n").unwrap();
        run.write_summary(&Summary::default()).unwrap();
        assert_eq!(fs::read(victim.path()).unwrap(), b"precious");
        assert_eq!(names(folder.path()), ["frame_000000.exr", "frame_000000.png"]);
        drop(run);
        // The pictures' folder itself.
        let (folder, elsewhere) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        symlink(elsewhere.path(), folder.path().join(FRAMES)).unwrap();
        assert!(RunFolder::create(folder.path(), false).is_err() && fs::read_dir(elsewhere.path()).unwrap().count() == 0);
    }

    #[test]
    fn a_folder_that_others_may_write_into_is_refused() {
        use std::os::unix::fs::PermissionsExt;
        let folder = tempfile::tempdir().unwrap();
        fs::set_permissions(folder.path(), fs::Permissions::from_mode(0o777)).unwrap();
        let refused = RunFolder::create(folder.path(), false).unwrap_err().to_string();
        assert!(refused.contains("has mode 0777; accepted: a folder of user"), "{refused}");
    }

    #[test]
    fn a_run_without_a_frame_does_not_occupy_its_folder() {
        let folder = tempfile::tempdir().unwrap();
        drop(RunFolder::create(folder.path(), false).unwrap());
        fs::write(folder.path().join(SUMMARY), "{}").unwrap();
        let mut run = RunFolder::create(folder.path(), false).unwrap();
        assert!(!folder.path().join(SUMMARY).exists());
        run.append_record(&frame(0).record, None).unwrap();
        drop(run);
        assert!(matches!(RunFolder::create(folder.path(), false), Err(PublishError::Occupied { .. })));
    }

    #[test]
    fn a_run_that_fails_before_its_first_frame_gives_the_earlier_one_back() {
        let folder = tempfile::tempdir().unwrap();
        let picture = folder.path().join(FRAMES).join("frame_000000.png");
        let mut run = RunFolder::create(folder.path(), false).unwrap();
        run.append_record(&frame(0).record, None).unwrap();
        fs::write(&picture, b"picture").unwrap();
        drop(run);
        let records = fs::read(folder.path().join(RECORDS)).unwrap();
        let scene = || fs::read_to_string(folder.path().join(SCENE)).ok();
        let mut failed = RunFolder::create(folder.path(), true).unwrap();
        assert!(!picture.exists());
        failed.write_scene("replay", "seed = 1\n").unwrap();
        assert!(failed.restore_previous().unwrap() && scene().is_none(), "a run of before scenes were written");
        failed.write_scene("replay", "seed = 2\n").unwrap();
        drop(failed);
        let mut failed = RunFolder::create(folder.path(), true).unwrap();
        failed.write_scene("replay", "seed = 3\n").unwrap();
        assert!(failed.restore_previous().unwrap() && scene().unwrap().ends_with("again.\nseed = 2\n"));
        drop(failed);
        // A folder that cannot be written any more.
        let probe = folder.path().join(FRAMES).join(".probe");
        fs::create_dir(&probe).unwrap();
        assert!(RunFolder::create(folder.path(), true).is_err() && scene().unwrap().ends_with("again.\nseed = 2\n"));
        fs::remove_dir(&probe).unwrap();
        assert!(picture.exists() && fs::read(folder.path().join(RECORDS)).unwrap() == records);
        assert!(!folder.path().join(PREVIOUS).exists());
        // Killed during its preparation: the earlier run is kept, and still occupies the folder.
        drop(RunFolder::create(folder.path(), true).unwrap());
        assert!(matches!(RunFolder::create(folder.path(), false), Err(PublishError::Occupied { .. })));
        let mut second = RunFolder::create(folder.path(), true).unwrap();
        assert!(second.restore_previous().unwrap() && picture.exists());
        drop(second);
        let mut run = RunFolder::create(folder.path(), true).unwrap();
        run.append_record(&frame(0).record, None).unwrap();
        assert!(!run.restore_previous().unwrap() && !picture.exists() && !folder.path().join(PREVIOUS).exists());
    }

    fn frame(number: u64) -> Frame {
        let film = Film { width: 4, height: 2, rgba: vec![[number as f32, 0.5, 0.25, 1.0]; 8], ..Default::default() };
        let record = FrameRecord { frame: number, slide: number, ..Default::default() };
        Frame { record: Arc::new(record), film: Arc::new(film), tone_map: [1.0, 0.5, 1.0], color_bar: None, gate: None }
    }

    fn names(folder: &Path) -> Vec<String> {
        let mut names: Vec<String> =
            fs::read_dir(folder.join(FRAMES)).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }

    #[test]
    fn keeps_the_newest_by_number_and_by_bytes() {
        let folder = tempfile::tempdir().unwrap();
        let mut run = RunFolder::create(folder.path(), false).unwrap();
        let two = PublishSettings { keep: Some(2), preview: false, ..Default::default() };
        let removed: Vec<u64> = (0..4).map(|n| run.write_pictures(&frame(n), &two).unwrap().removed).collect();
        assert_eq!(removed, [0, 0, 1, 1]);
        assert_eq!(names(folder.path()), ["frame_000002.exr", "frame_000003.exr"]);

        let one_byte = PublishSettings { keep_bytes: Some(1), ..Default::default() };
        let written = run.write_pictures(&frame(4), &one_byte).unwrap();
        assert_eq!(written.removed, 2);
        assert_eq!(names(folder.path()), ["frame_000004.exr", "frame_000004.png"], "the newest stays though it is over the cap");
        assert_eq!(run.kept_bytes(), written.bytes);
    }

    #[test]
    fn records_take_no_more_than_their_cap_and_those_that_go_are_counted() {
        let folder = tempfile::tempdir().unwrap();
        let mut run = RunFolder::create(folder.path(), false).unwrap();
        let numbers = |name: &str| -> Vec<u64> {
            let text = fs::read_to_string(folder.path().join(name)).unwrap_or_default();
            text.lines().map(|line| serde_json::from_str::<FrameRecord>(line).unwrap().frame).collect()
        };
        run.append_record(&frame(100).record, None).unwrap();
        let line = fs::metadata(folder.path().join(RECORDS)).unwrap().len();
        // Three lines a file, numbers of as many digits.
        let cap = Some(2 * (3 * line + line / 2));
        let mut appended = |n| {
            run.append_record(&frame(n).record, cap).unwrap();
            run.records_removed()
        };
        assert_eq!((101..112).map(&mut appended).collect::<Vec<_>>(), [0, 0, 0, 0, 0, 3, 3, 3, 6, 6, 6]);
        assert_eq!((numbers(OLDER_RECORDS), numbers(RECORDS)), (vec![106, 107, 108], vec![109, 110, 111]));
        // A file that cannot be created loses one record, with an error, and nothing else.
        let (records, away) = (folder.path().join(RECORDS), folder.path().join("away"));
        fs::rename(folder.path().join(OLDER_RECORDS), &away).unwrap();
        fs::create_dir(folder.path().join(OLDER_RECORDS)).unwrap();
        assert!(run.append_record(&frame(112).record, cap).is_err() && records.exists());
        fs::remove_dir(folder.path().join(OLDER_RECORDS)).unwrap();
        run.append_record(&frame(113).record, cap).unwrap();
        assert_eq!(run.records_removed(), 9);
        assert_eq!((numbers(OLDER_RECORDS), numbers(RECORDS)), (vec![109, 110, 111], vec![113]));
        // Both files belong to the run: another run is refused, and one with `overwrite` replaces both.
        fs::remove_file(&records).unwrap();
        drop(run);
        assert!(matches!(RunFolder::create(folder.path(), false), Err(PublishError::Occupied { .. })));
        drop(RunFolder::create(folder.path(), true).unwrap());
        assert!(!folder.path().join(OLDER_RECORDS).exists());
    }

    #[test]
    fn each_slide_keeps_the_exr_of_its_newest_frame() {
        let folder = tempfile::tempdir().unwrap();
        let mut run = RunFolder::create(folder.path(), false).unwrap();
        let of_slide = |number: u64, slide: u64| Frame {
            record: Arc::new(FrameRecord { frame: number, slide, ..Default::default() }),
            ..frame(number)
        };
        let mut write = |number, slide, settings: &PublishSettings| run.write_pictures(&of_slide(number, slide), settings).unwrap();
        let settings = PublishSettings::default();
        let replaced: Vec<bool> = [(0, 0), (1, 0), (2, 0), (3, 1)].map(|(n, slide)| write(n, slide, &settings).replaced).into();
        assert_eq!(replaced, [false, true, true, false]);
        let pngs = ["frame_000000.png", "frame_000001.png"];
        assert_eq!(
            names(folder.path()),
            [&pngs[..], &["frame_000002.exr", "frame_000002.png", "frame_000003.exr", "frame_000003.png"]].concat()
        );
        let every = PublishSettings { exr: ExrFrames::Every, preview: false, ..Default::default() };
        assert!(!write(4, 1, &every).replaced && !write(5, 1, &every).replaced);
        let none = PublishSettings { exr: ExrFrames::None, ..Default::default() };
        write(6, 1, &none);
        assert_eq!(names(folder.path())[6..], ["frame_000004.exr", "frame_000005.exr", "frame_000006.png"]);
        let there: u64 = fs::read_dir(folder.path().join(FRAMES)).unwrap().map(|e| e.unwrap().metadata().unwrap().len()).sum();
        assert_eq!(run.kept_bytes(), there);
    }

    #[test]
    fn an_older_run_is_refused_and_overwritten_only_on_demand() {
        let folder = tempfile::tempdir().unwrap();
        let mut run = RunFolder::create(folder.path(), false).unwrap();
        run.append_record(&frame(0).record, None).unwrap();
        run.write_pictures(&frame(0), &PublishSettings::default()).unwrap();
        for foreign in ["notes.txt", "frames/frame_best.png", "frames/frame_000000.tif"] {
            fs::write(folder.path().join(foreign), "mine").unwrap();
        }
        drop(run);
        let refused = RunFolder::create(folder.path(), false).unwrap_err().to_string();
        assert!(refused.contains("--overwrite") && refused.contains("records.jsonl"), "{refused}");
        let inner = folder.path().join("run");
        for expected in ["run", "run-2", "run-3"] {
            let vacant = RunFolder::vacant(&inner).unwrap();
            assert_eq!(vacant, folder.path().join(expected));
            RunFolder::create(&vacant, false).unwrap().append_record(&frame(0).record, None).unwrap();
        }
        // A run without a frame is no run.
        fs::write(inner.join(RECORDS), "").unwrap();
        assert_eq!(RunFolder::vacant(&inner).unwrap(), inner);
        fs::remove_dir_all(&inner).unwrap();

        fs::write(folder.path().join("frames/.frame_000007.exr.part"), "half").unwrap();
        let run = RunFolder::create(folder.path(), true).unwrap();
        assert_eq!(fs::read(folder.path().join(RECORDS)).unwrap(), b"");
        assert_eq!(names(run.path()), ["frame_000000.tif", "frame_best.png"]);
        assert!(folder.path().join("notes.txt").exists());
    }

    #[test]
    fn a_folder_that_cannot_be_written_is_refused_at_once() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("taken");
        fs::write(&file, "a file").unwrap();
        let error = RunFolder::create(&file.join("run"), false).unwrap_err();
        assert!(matches!(error, PublishError::Folder { .. }) && error.to_string().contains("taken"), "{error}");
    }

    #[test]
    fn a_torn_line_is_cut_off_before_the_next() {
        let folder = tempfile::tempdir().unwrap();
        let mut run = RunFolder::create(folder.path(), false).unwrap();
        run.append_record(&frame(0).record, None).unwrap();
        run.records.write_all(b"{\"frame\":1,\"ti").unwrap();
        run.append_record(&frame(2).record, None).unwrap();
        let text = fs::read_to_string(folder.path().join(RECORDS)).unwrap();
        let frames: Vec<u64> = text.lines().map(|l| serde_json::from_str::<FrameRecord>(l).unwrap().frame).collect();
        assert_eq!(frames, [0, 2]);
    }

    #[test]
    fn a_failed_picture_leaves_nothing_under_its_name() {
        let folder = tempfile::tempdir().unwrap();
        let mut run = RunFolder::create(folder.path(), false).unwrap();
        // A folder has the name of the PNG: the EXR written before it must be removed.
        fs::create_dir_all(folder.path().join("frames/frame_000000.png/x")).unwrap();
        assert!(run.write_pictures(&frame(0), &PublishSettings::default()).is_err());
        assert_eq!(names(folder.path()), ["frame_000000.png"]);
        assert_eq!(run.kept_bytes(), 0);
    }
}
