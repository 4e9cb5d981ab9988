//! GIF: 256 colours a frame, chosen for each frame.

use super::Encoder;
use gif::{DisposalMethod, EncodingError, Frame, Repeat};
use std::fs::File;
use std::io::{self, BufWriter, Write};

/// Pixels from which a palette is learned, about: all of a small picture, and one in ten of a large one.
const LEARNED: usize = 100_000;

pub(super) struct Gif {
    encoder: gif::Encoder<BufWriter<File>>,
    size: [u16; 2],
    frames_per_second: f64,
    written: u64,
}

impl Gif {
    pub(super) fn new(file: File, size: [usize; 2], frames_per_second: f64) -> io::Result<Self> {
        let [width, height] = size;
        let edge = |pixels: usize| u16::try_from(pixels).map_err(|_| io::Error::other("a GIF has at most 65,535 pixels along an edge"));
        let size = [edge(width)?, edge(height)?];
        let mut encoder = gif::Encoder::new(BufWriter::new(file), size[0], size[1], &[]).map_err(system)?;
        encoder.set_repeat(Repeat::Infinite).map_err(system)?;
        Ok(Self { encoder, size, frames_per_second, written: 0 })
    }
}

impl Encoder for Gif {
    fn add(&mut self, rgb: &[u8]) -> io::Result<()> {
        let speed = (rgb.len() / 3 / LEARNED).clamp(1, 10) as i32;
        let mut frame = Frame::from_rgb_speed(self.size[0], self.size[1], rgb, speed);
        // Hundredths of a second, rounded so that the film as a whole keeps its rate.
        let end = |frames: u64| (frames as f64 * 100.0 / self.frames_per_second).round();
        frame.delay = (end(self.written + 1) - end(self.written)) as u16;
        frame.dispose = DisposalMethod::Keep;
        self.encoder.write_frame(&frame).map_err(system)?;
        // A film without its end is played up to the last whole frame.
        self.encoder.get_mut().flush()?;
        self.written += 1;
        Ok(())
    }

    fn finish(self: Box<Self>) -> io::Result<()> {
        self.encoder.into_inner().map_err(system)?.flush()
    }
}

fn system(error: EncodingError) -> io::Error {
    match error {
        EncodingError::Io(error) => error,
        other => io::Error::other(other),
    }
}
