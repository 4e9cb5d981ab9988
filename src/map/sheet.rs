//! A sheet: rasters with lines and words over them, as PNG or SVG, drawn by plotters.
//!
//! The PNG is drawn several times larger and averaged, since plotters places lines on whole pixels. Pixels without a line over them keep their colours
//! exactly if they are not scaled.

use super::words::{even_step, number, ticks};
use base64::Engine as _;
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder as _, RgbImage};
use plotters::coord::Shift;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};
use plotters::style::{FontStyle, register_font};
use thiserror::Error;

/// Font that is built in, so that a sheet looks the same on every machine.
const FONT: &str = "sans-serif";
/// Times that the picture is larger while it is drawn.
const FINER: f64 = 3.0;

/// Error of drawing a sheet.
#[derive(Debug, Error)]
pub enum DrawError {
    /// plotters fails.
    #[error("the picture cannot be drawn: {0}")]
    Plot(String),
    /// The PNG cannot be encoded.
    #[error("the picture cannot be encoded: {0}")]
    Encode(#[from] image::ImageError),
}

pub(super) fn plot_error(error: impl std::fmt::Display) -> DrawError {
    DrawError::Plot(error.to_string())
}

/// What a sheet shows. All places are in pixels of the picture.
pub(super) trait Sheet {
    /// Width and height, whole numbers.
    fn size(&self) -> [f64; 2];
    /// Rasters under the lines and words.
    fn images(&self) -> Vec<Image<'_>>;
    /// Draws lines and words.
    fn draw<B: DrawingBackend>(&self, pen: &Pen<'_, B>) -> Result<(), DrawError>;
}

/// A raster of a sheet.
pub(super) struct Image<'a> {
    /// Upper left corner.
    pub(super) corner: [f64; 2],
    /// Width and height in the picture.
    pub(super) shown: [f64; 2],
    /// Columns and rows.
    pub(super) size: [usize; 2],
    /// Colours, rows from the top.
    pub(super) pixels: &'a [[u8; 3]],
    /// Whether colours go over into each other where the raster is enlarged or reduced; else pixels keep their edges.
    pub(super) is_smooth: bool,
}

/// A colour bar.
#[derive(Debug, Clone, PartialEq)]
pub struct Bar {
    /// What it shows, with its unit.
    pub label: String,
    /// Its colours from one end to the other, as parts of equal length.
    pub colours: Vec<[u8; 3]>,
    /// Its ends.
    pub range: [f64; 2],
    /// Whether values lie below and above its ends.
    pub goes_on: [bool; 2],
}

/// Draws a sheet as PNG.
///
/// # Errors
/// plotters fails, or the picture cannot be encoded.
pub(super) fn sheet_png(sheet: &impl Sheet) -> Result<Vec<u8>, DrawError> {
    let [width, height] = sheet.size();
    // Large pictures are smooth enough at twice their size, which bounds the memory.
    let finer = if width * height > 4e6 { 2.0 } else { FINER };
    let scale = finer as usize;
    let (width, height) = (width as usize, height as usize);
    let (wide, high) = (width * scale, height * scale);
    let mut fine = vec![255u8; wide * high * 3];
    for Image { corner, shown, size: [columns, rows], pixels, is_smooth } in sheet.images() {
        let [x0, y0] = corner.map(|c| (c * finer) as usize);
        let [w, h] = shown.map(|c| (c * finer) as usize);
        if is_smooth {
            let raster = RgbImage::from_raw(columns as u32, rows as u32, pixels.as_flattened().to_vec());
            let raster = raster.ok_or_else(|| plot_error("a raster has another size than its pixels"))?;
            // Linear between centres of pixels; their mean where the raster is reduced.
            let scaled = image::imageops::resize(&raster, w as u32, h as u32, image::imageops::FilterType::Triangle);
            for (row, line) in scaled.as_raw().chunks(3 * w).enumerate().take(high.saturating_sub(y0)) {
                let at = ((y0 + row) * wide + x0) * 3;
                let length = line.len().min(3 * wide.saturating_sub(x0));
                fine[at..at + length].copy_from_slice(&line[..length]);
            }
            continue;
        }
        for y in 0..h.min(high.saturating_sub(y0)) {
            for x in 0..w.min(wide.saturating_sub(x0)) {
                let at = ((y0 + y) * wide + x0 + x) * 3;
                fine[at..at + 3].copy_from_slice(&pixels[y * rows / h * columns + x * columns / w]);
            }
        }
    }
    {
        let area = BitMapBackend::with_buffer(&mut fine, (wide as u32, high as u32)).into_drawing_area();
        sheet.draw(&Pen::new(&area, finer, true)?)?;
        area.present().map_err(plot_error)?;
    }
    let mut pixels = vec![0u8; width * height * 3];
    for (index, value) in pixels.iter_mut().enumerate() {
        let (channel, x, y) = (index % 3, index / 3 % width, index / (3 * width));
        let block = (0..scale * scale).map(|k| u32::from(fine[((y * scale + k / scale) * wide + x * scale + k % scale) * 3 + channel]));
        let count = (scale * scale) as u32;
        *value = ((block.sum::<u32>() + count / 2) / count) as u8;
    }
    png(width, height, &pixels)
}

fn png(width: usize, height: usize, pixels: &[u8]) -> Result<Vec<u8>, DrawError> {
    let mut bytes = Vec::new();
    let encoder = PngEncoder::new_with_quality(&mut bytes, CompressionType::Best, FilterType::Adaptive);
    encoder.write_image(pixels, width as u32, height as u32, ExtendedColorType::Rgb8)?;
    Ok(bytes)
}

/// Draws a sheet as SVG: lines and words as such, each raster as a PNG inside.
///
/// # Errors
/// plotters fails, or a raster cannot be encoded.
pub(super) fn sheet_svg(sheet: &impl Sheet) -> Result<String, DrawError> {
    let [width, height] = sheet.size();
    let mut text = String::new();
    {
        let size = ((width * FINER) as u32, (height * FINER) as u32);
        let area = SVGBackend::with_string(&mut text, size).into_drawing_area();
        sheet.draw(&Pen::new(&area, FINER, false)?)?;
        area.present().map_err(plot_error)?;
    }
    let (_, body) = text.split_once('>').ok_or_else(|| plot_error("the SVG has no head"))?;
    let mut whole = format!(
        "<svg width=\"{width}\" height=\"{height}\" viewBox=\"0 0 {0} {1}\" xmlns=\"http://www.w3.org/2000/svg\">\n\
         <rect width=\"100%\" height=\"100%\" fill=\"white\"/>\n",
        width * FINER,
        height * FINER
    );
    for Image { corner: [x, y], shown, size: [columns, rows], pixels, is_smooth } in sheet.images() {
        let style = if is_smooth { "" } else { " style=\"image-rendering: pixelated\"" };
        let picture = png(columns, rows, pixels.as_flattened())?;
        let data = base64::engine::general_purpose::STANDARD.encode(picture);
        whole += &format!(
            "<image x=\"{}\" y=\"{}\" width=\"{}\" height=\"{}\" preserveAspectRatio=\"none\"{style} href=\"data:image/png;base64,{data}\"/>\n",
            x * FINER,
            y * FINER,
            shown[0] * FINER,
            shown[1] * FINER
        );
    }
    whole += body.trim_start_matches('\n');
    Ok(whole)
}

/// Draws in pixels of the picture.
pub(super) struct Pen<'a, B: DrawingBackend> {
    pub(super) area: &'a DrawingArea<B, Shift>,
    finer: f64,
    /// Lines piece by piece: plotters fills a thick path as one polygon, in which parts that cross each other would be holes.
    in_parts: bool,
}

/// Where a text stands relative to its place.
pub(super) const LEFT: Pos = Pos { h_pos: HPos::Left, v_pos: VPos::Top };
pub(super) const CENTRE: Pos = Pos { h_pos: HPos::Center, v_pos: VPos::Top };

/// Texts of a size in lines of at most `width`, cut between words.
///
/// # Errors
/// plotters fails.
pub(super) fn wrapped(texts: &[String], size: f64, width: f64) -> Result<Vec<String>, DrawError> {
    let mut none = [0; 3];
    let area = BitMapBackend::with_buffer(&mut none, (1, 1)).into_drawing_area();
    let pen = Pen::new(&area, FINER, false)?;
    let mut lines = Vec::new();
    for text in texts {
        let mut line = String::new();
        for word in text.split(' ') {
            let longer = if line.is_empty() { word.to_owned() } else { format!("{line} {word}") };
            if !line.is_empty() && pen.width(&longer, size)? > width {
                lines.push(std::mem::replace(&mut line, word.to_owned()));
            } else {
                line = longer;
            }
        }
        lines.push(line);
    }
    Ok(lines)
}

impl<'a, B: DrawingBackend> Pen<'a, B> {
    fn new(area: &'a DrawingArea<B, Shift>, finer: f64, in_parts: bool) -> Result<Self, DrawError> {
        register_font(FONT, FontStyle::Normal, epaint_default_fonts::UBUNTU_LIGHT)
            .map_err(|_| plot_error("the built-in font is not read"))?;
        Ok(Self { area, finer, in_parts })
    }

    pub(super) fn at(&self, [x, y]: [f64; 2]) -> (i32, i32) {
        ((x * self.finer).round() as i32, (y * self.finer).round() as i32)
    }

    pub(super) fn line(&self, points: &[[f64; 2]], offset: [f64; 2], colour: RGBAColor, width: f64) -> Result<(), DrawError> {
        let style = colour.stroke_width((width * self.finer).round().max(1.0) as u32);
        let mut path: Vec<(i32, i32)> = points.iter().map(|p| self.at([p[0] + offset[0], p[1] + offset[1]])).collect();
        path.dedup();
        if path.len() < 2 {
            return Ok(());
        }
        if !self.in_parts {
            return self.area.draw(&PathElement::new(path, style)).map_err(plot_error);
        }
        path.windows(2).try_for_each(|pair| self.area.draw(&PathElement::new(pair.to_vec(), style)).map_err(plot_error))
    }

    pub(super) fn text(&self, text: &str, place: [f64; 2], size: f64, anchor: Pos, angle: FontTransform) -> Result<(), DrawError> {
        let style = TextStyle::from((FONT, size * self.finer).into_font().transform(angle)).pos(anchor).color(&BLACK);
        self.area.draw_text(text, &style, self.at(place)).map_err(plot_error)
    }

    /// Width of a text, in pixels of the picture.
    pub(super) fn width(&self, text: &str, size: f64) -> Result<f64, DrawError> {
        let style = TextStyle::from((FONT, size * self.finer).into_font());
        Ok(f64::from(self.area.estimate_text_size(text, &style).map_err(plot_error)?.0) / self.finer)
    }

    /// A text that is cut at a word to fit, with an ellipsis.
    pub(super) fn fitting(&self, text: &str, size: f64, width: f64) -> Result<String, DrawError> {
        let mut cut = text.to_owned();
        while self.width(&cut, size)? > width {
            let shorter: String = cut
                .trim_end_matches('…')
                .chars()
                .collect::<Vec<_>>()
                .split_last()
                .map_or_else(String::new, |(_, rest)| rest.iter().collect());
            if shorter.is_empty() {
                break;
            }
            cut = format!("{}…", shorter.trim_end());
        }
        Ok(cut)
    }

    pub(super) fn bar(&self, bar: &Bar, [x, y]: [f64; 2], width: f64, u: f64) -> Result<(), DrawError> {
        let (top, bottom) = (y + 22.0 * u, y + 38.0 * u);
        let label = self.fitting(&bar.label, 15.0 * u, width + 40.0 * u)?;
        self.text(&label, [x + width / 2.0, y], 15.0 * u, CENTRE, FontTransform::None)?;
        let solid = |[r, g, b]: [u8; 3]| RGBColor(r, g, b).filled();
        let parts = bar.colours.len();
        for (part, colour) in bar.colours.iter().enumerate() {
            // To the end of the bar, and the next one over it: in an SVG, seams between neighbours would show.
            let ends = [self.at([x + width * part as f64 / parts as f64, top]), self.at([x + width, bottom])];
            self.area.draw(&Rectangle::new(ends, solid(*colour))).map_err(plot_error)?;
        }
        // Points at ends beyond which values lie.
        let middle = (top + bottom) / 2.0;
        let mut rim = Vec::new();
        for (end, sign) in [(0, -1.0), (1, 1.0)] {
            let edge = x + width * end as f64;
            let corners = if sign < 0.0 { [[edge, bottom], [edge, top]] } else { [[edge, top], [edge, bottom]] };
            let colour = if end == 0 { bar.colours.first() } else { bar.colours.last() };
            if let Some(colour) = colour.filter(|_| bar.goes_on[end]) {
                let tip = [edge + sign * 11.0 * u, middle];
                let outline = vec![self.at(corners[0]), self.at(tip), self.at(corners[1])];
                self.area.draw(&Polygon::new(outline, solid(*colour))).map_err(plot_error)?;
                rim.extend([corners[0], tip, corners[1]]);
            } else {
                rim.extend(corners);
            }
        }
        rim.push(rim[0]);
        self.line(&rim, [0.0; 2], BLACK.to_rgba(), 0.9 * u)?;
        let [low, high] = bar.range;
        for tick in ticks(bar.range, even_step(high - low, 4.0)) {
            let at = x + width * (tick - low) / (high - low);
            self.line(&[[at, bottom], [at, bottom + 4.0 * u]], [0.0; 2], BLACK.to_rgba(), 0.9 * u)?;
            self.text(&number(tick), [at, bottom + 6.0 * u], 14.0 * u, CENTRE, FontTransform::None)?;
        }
        Ok(())
    }
}
