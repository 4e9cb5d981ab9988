//! A frame with a strip below that says what it shows: colour bar, time, source and stated error.

use super::page::{bar_of, picture_error, projection_of, when_of};
use super::sheet::{Bar, DrawError, Image, LEFT, Pen, Sheet, sheet_png, wrapped};
use super::words::duration;
use crate::publish::Picture;
use crate::run::Frame;
use plotters::prelude::{DrawingBackend, FontTransform};

/// A picture with its strip, which leaves the pixels of the picture as they are.
struct Strip {
    picture: Picture,
    bar: Option<Bar>,
    words: Vec<String>,
    size: [f64; 2],
    /// Size of the text, 1 for a picture of 640 pixels.
    unit: f64,
}

/// Height of the colour bar with its words, and of a line, in units.
const BAR: f64 = 66.0;
const LINE: f64 = 17.0;

/// The frame as a PNG with the strip below. The picture is its upper left part, pixel by pixel; a narrow one has white beside it
/// ([`Picture::LEAST_WIDTH`]).
///
/// # Errors
/// plotters fails, or the picture cannot be encoded.
pub fn annotated(frame: &Frame) -> Result<Vec<u8>, DrawError> {
    let (film, record) = (&frame.film, &frame.record);
    let picture = Picture { size: [film.width, film.height], pixels: film.tone_mapped(frame.tone_map).as_chunks().0.to_vec() };
    let width = film.width.max(Picture::LEAST_WIDTH) as f64;
    let unit = (width / 640.0).clamp(0.7, 4.0);
    let bar = frame.color_bar.as_ref().map(|colours| bar_of(record, colours, true));
    let tau = duration(record.tau, &record.time_unit);
    let mut words = vec![
        format!("{}, tau = {tau} {}, {}", when_of(record), record.direction, record.method),
        format!("Source: {}.", record.source.trim_end_matches('.')),
    ];
    words.extend(projection_of(record));
    words.push(picture_error(record));
    let words = wrapped(&words, 13.0 * unit, width - 16.0 * unit)?;
    let below = 8.0 + if bar.is_some() { BAR } else { 0.0 } + LINE * words.len() as f64 + 6.0;
    sheet_png(&Strip { picture, bar, words, size: [width, (film.height as f64 + below * unit).ceil()], unit })
}

impl Sheet for Strip {
    fn size(&self) -> [f64; 2] {
        self.size
    }

    fn images(&self) -> Vec<Image<'_>> {
        let Picture { size, pixels } = &self.picture;
        vec![Image { corner: [0.0; 2], shown: size.map(|n| n as f64), size: *size, pixels, is_smooth: false }]
    }

    fn draw<B: DrawingBackend>(&self, pen: &Pen<'_, B>) -> Result<(), DrawError> {
        let (u, width) = (self.unit, self.size[0]);
        let mut top = self.picture.size[1] as f64 + 8.0 * u;
        if let Some(bar) = &self.bar {
            let length = (width - 56.0 * u).min(560.0 * u);
            pen.bar(bar, [(width - length) / 2.0, top], length, u)?;
            top += BAR * u;
        }
        self.words
            .iter()
            .enumerate()
            .try_for_each(|(number, line)| pen.text(line, [8.0 * u, top + LINE * u * number as f64], 13.0 * u, LEFT, FontTransform::None))
    }
}
