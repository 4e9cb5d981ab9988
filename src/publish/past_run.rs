//! A run folder that is read: its records and the pictures that it kept.

use super::error::PublishError;
use super::exr::read_exr;
use super::preview::png_of;
use super::run_folder::{FRAMES, OLDER_RECORDS, RECORDS};
use crate::run::FrameRecord;
use image::{ImageError, ImageReader, Limits};
use serde::Deserialize;
use std::collections::BTreeMap;
use std::io::{BufRead, BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

/// Longest line of the records that is read.
const MAX_LINE_BYTES: u64 = 16 << 20;

/// A run folder.
#[derive(Debug)]
pub struct PastRun {
    path: PathBuf,
    /// Pictures by frame, the PNG rather than the EXR.
    kept: BTreeMap<u64, PathBuf>,
}

/// A picture of 8 bits, rows from the top.
#[derive(Debug, Clone, PartialEq)]
pub struct Picture {
    /// Width and height.
    pub size: [usize; 2],
    /// R, G, B.
    pub pixels: Vec<[u8; 3]>,
}

impl Picture {
    /// Least width of a picture with a strip below (`--annotate`), so that words have room.
    pub const LEAST_WIDTH: usize = 320;

    /// Encodes it as a PNG.
    ///
    /// # Errors
    /// A picture without pixels, or of another size than its pixels.
    pub fn png(&self) -> Result<Vec<u8>, ImageError> {
        png_of(self.pixels.as_flattened(), self.size)
    }
}

#[derive(Deserialize)]
struct Numbered {
    frame: u64,
}

/// A file of records, of which single lines are read.
struct Lines {
    path: PathBuf,
    reader: BufReader<std::fs::File>,
    /// Bytes when it was opened.
    length: u64,
}

/// A complete line: where it begins, where the next one does, and the number of its frame.
struct Line {
    begin: u64,
    end: u64,
    frame: u64,
    text: String,
}

impl Lines {
    /// `None` if there is no such file.
    fn open(path: PathBuf) -> Result<Option<Self>, PublishError> {
        let failed = |error: std::io::Error| PublishError::File { path: path.clone(), problem: format!("cannot be read: {error}") };
        match crate::files::open(&path) {
            Ok(file) => {
                let length = file.metadata().map_err(failed)?.len();
                Ok(Some(Self { path, reader: BufReader::new(file), length }))
            }
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(None),
            Err(error) => Err(failed(error)),
        }
    }

    fn failed(&self, problem: &str) -> PublishError {
        PublishError::File { path: self.path.clone(), problem: problem.to_owned() }
    }

    /// The first line that begins at this byte or after it and is a record. `None` at the end.
    fn after(&mut self, from: u64) -> Result<Option<Line>, PublishError> {
        let cannot = |lines: &Self, error: std::io::Error| lines.failed(&format!("cannot be read: {error}"));
        // The line to which the byte before belongs is passed over.
        let mut at = from.saturating_sub(1);
        self.reader.seek(SeekFrom::Start(at)).map_err(|error| cannot(self, error))?;
        let mut is_passed = from == 0;
        let mut bytes = Vec::new();
        loop {
            bytes.clear();
            let read = (&mut self.reader).take(MAX_LINE_BYTES).read_until(b'\n', &mut bytes);
            let length = read.map_err(|error| cannot(self, error))? as u64;
            // A last line without its end is being written.
            if length == 0 || (at + length >= self.length && !bytes.ends_with(b"\n")) {
                return Ok(None);
            }
            let begin = at;
            at += length;
            // A line that a full disk or a kill cut short is none.
            let found = serde_json::from_slice::<Numbered>(&bytes).ok().filter(|_| is_passed);
            if let Some(Numbered { frame }) = found
                && let Ok(text) = String::from_utf8(std::mem::take(&mut bytes))
            {
                return Ok(Some(Line { begin, end: at, frame, text: text.trim_end().to_owned() }));
            }
            is_passed = true;
        }
    }
}

impl PastRun {
    /// Opens the folder of a run.
    ///
    /// # Errors
    /// The folder cannot be read, or no run wrote it.
    pub fn open(path: &Path) -> Result<Self, PublishError> {
        if !path.join(RECORDS).is_file() {
            let problem = format!("is no run: it has no {RECORDS}; accepted: a folder that `ridgewatch replay` or `attach` wrote");
            return Err(PublishError::File { path: path.to_owned(), problem });
        }
        let frames = path.join(FRAMES);
        let mut kept = BTreeMap::new();
        let entries = match std::fs::read_dir(&frames) {
            Ok(entries) => Some(entries),
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => None,
            Err(source) => return Err(PublishError::Folder { path: frames, source }),
        };
        for entry in entries.into_iter().flatten() {
            let file = entry.map_err(|source| PublishError::Folder { path: frames.clone(), source })?.path();
            let number = file.file_stem().and_then(|stem| stem.to_str()?.strip_prefix("frame_")?.parse::<u64>().ok());
            let Some(number) = number else { continue };
            match file.extension().and_then(|e| e.to_str()) {
                Some("png") => {
                    kept.insert(number, file);
                }
                Some("exr") => {
                    kept.entry(number).or_insert(file);
                }
                _ => {}
            }
        }
        Ok(Self { path: path.to_owned(), kept })
    }

    /// Frames whose pictures are kept, ascending.
    pub fn kept(&self) -> impl DoubleEndedIterator<Item = u64> {
        self.kept.keys().copied()
    }

    /// Whether the picture of a frame is kept.
    pub fn keeps(&self, frame: u64) -> bool {
        self.kept.contains_key(&frame)
    }

    /// The record of a frame, found among records in the order of their frames, of which few are read. `None` if the records that are left do not have it.
    ///
    /// # Errors
    /// Records that cannot be read.
    pub fn record(&self, frame: u64) -> Result<Option<FrameRecord>, PublishError> {
        for mut lines in self.lines()?.into_iter().rev() {
            let (mut low, mut high) = (0, lines.length);
            while low < high {
                let middle = low + (high - low) / 2;
                match lines.after(middle)?.filter(|line| line.begin < high) {
                    None => high = middle,
                    Some(line) if line.frame < frame => low = line.end,
                    Some(line) if line.frame > frame => high = middle,
                    Some(line) => {
                        let failed = |error: serde_json::Error| lines.failed(&format!("the record of frame {frame} is none: {error}"));
                        return serde_json::from_str(&line.text).map(Some).map_err(failed);
                    }
                }
            }
        }
        Ok(None)
    }

    /// Records over all of the run as they are written, in order: all of them, or about `most` that are evenly chosen.
    ///
    /// # Errors
    /// Records that cannot be read.
    pub fn some_records(&self, most: u64) -> Result<Vec<String>, PublishError> {
        let mut files = self.lines()?;
        let all: u64 = files.iter().map(|lines| lines.length).sum();
        let step = (all / most.max(1)).max(1);
        let mut chosen = Vec::new();
        for lines in &mut files {
            let mut from = 0;
            while let Some(line) = lines.after(from)? {
                from = line.end.max(from + step);
                chosen.push(line.text);
            }
        }
        Ok(chosen)
    }

    /// The files of the records, the older one first.
    fn lines(&self) -> Result<Vec<Lines>, PublishError> {
        // The newer one first: it may become the older one meanwhile, and is there then twice rather than not at all.
        let newer = Lines::open(self.path.join(RECORDS))?;
        let older = Lines::open(self.path.join(OLDER_RECORDS))?;
        Ok(older.into_iter().chain(newer).collect())
    }

    /// The picture of a frame. `tone_map` are `[contrast, brightness, gamma]` for a frame of which only the EXR is kept.
    ///
    /// # Errors
    /// The frame is not kept, or its file cannot be read or has another size than its record says.
    pub fn picture(&self, record: &FrameRecord, tone_map: [f64; 3]) -> Result<Picture, PublishError> {
        let path = self.kept.get(&record.frame).cloned().unwrap_or_else(|| self.path.join(FRAMES));
        let failed = |problem: String| PublishError::File { path: path.clone(), problem };
        let [width, height] = record.size;
        let another = |[w, h]: [usize; 2]| failed(format!("has {w} x {h} pixels, and its record says {width} x {height}"));
        if path.extension().is_some_and(|e| e == "exr") {
            let film = read_exr(&path)?;
            if [film.width, film.height] != record.size {
                return Err(another([film.width, film.height]));
            }
            return Ok(Picture { size: record.size, pixels: film.tone_mapped(tone_map).as_chunks().0.to_vec() });
        }
        let unreadable = |error: &dyn std::fmt::Display| failed(format!("cannot be read: {error}"));
        let file = crate::files::open(&path).map_err(|error| unreadable(&error))?;
        let mut reader = ImageReader::with_format(BufReader::new(file), image::ImageFormat::Png);
        // Before the picture is allocated.
        let mut limits = Limits::default();
        // With room for a strip.
        let most = [width.max(Picture::LEAST_WIDTH), height.saturating_add(width).saturating_add(1024)].map(|n| u32::try_from(n).ok());
        [limits.max_image_width, limits.max_image_height] = most;
        reader.limits(limits);
        let mut picture = reader.decode().map_err(|error| unreadable(&error))?.into_rgb8();
        if picture.width() as usize == width.max(Picture::LEAST_WIDTH) && picture.height() as usize > height {
            // The frame above the strip.
            picture = image::imageops::crop_imm(&picture, 0, 0, width as u32, height as u32).to_image();
        }
        let size = [picture.width() as usize, picture.height() as usize];
        if size != record.size {
            return Err(another(size));
        }
        Ok(Picture { size, pixels: picture.into_raw().as_chunks().0.to_vec() })
    }
}
