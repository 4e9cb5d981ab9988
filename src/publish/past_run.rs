//! A run folder that is read: its records and the pictures that it kept.

use super::error::PublishError;
use super::exr::read_exr;
use super::run_folder::{FRAMES, OLDER_RECORDS, RECORDS};
use crate::run::FrameRecord;
use image::{ImageReader, Limits};
use serde::Deserialize;
use std::collections::BTreeMap;
use std::io::{BufRead, BufReader, Read};
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

impl Picture {
    /// Least width of a picture with a strip below (`--annotate`), so that words have room.
    pub const LEAST_WIDTH: usize = 320;
}

/// A picture of 8 bits, rows from the top.
#[derive(Debug, Clone, PartialEq)]
pub struct Picture {
    /// Width and height.
    pub size: [usize; 2],
    /// R, G, B.
    pub pixels: Vec<[u8; 3]>,
}

#[derive(Deserialize)]
struct Numbered {
    frame: u64,
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

    /// The record of a frame. `None` if the records that are left do not have it.
    ///
    /// # Errors
    /// Records that cannot be read.
    pub fn record(&self, frame: u64) -> Result<Option<FrameRecord>, PublishError> {
        for name in [RECORDS, OLDER_RECORDS] {
            let path = self.path.join(name);
            let failed = |problem: String| PublishError::File { path: path.clone(), problem };
            let file = match crate::files::open(&path) {
                Ok(file) => file,
                Err(error) if name == OLDER_RECORDS && error.kind() == std::io::ErrorKind::NotFound => continue,
                Err(error) => return Err(failed(format!("cannot be read: {error}"))),
            };
            let mut reader = BufReader::new(file);
            let mut line = Vec::new();
            for number in 1.. {
                line.clear();
                let length = (&mut reader)
                    .take(MAX_LINE_BYTES)
                    .read_until(b'\n', &mut line)
                    .map_err(|error| failed(format!("cannot be read: {error}")))?;
                if length == 0 {
                    break;
                }
                // A line that a full disk or a kill cut short is none.
                if serde_json::from_slice(&line).is_ok_and(|found: Numbered| found.frame == frame) {
                    let record = serde_json::from_slice(&line).map_err(|error| failed(format!("line {number} is no record: {error}")))?;
                    return Ok(Some(record));
                }
            }
        }
        Ok(None)
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
