//! The picture of a map: pixels, lines, graticule, colour bars and words, drawn by plotters.
//!
//! The PNG is drawn several times larger and averaged, since plotters places lines on whole pixels. Pixels without a line over them keep their colours
//! exactly.

use super::colour::Ramp;
use super::graticule::{GridLine, axis_unit, graticule};
use super::projection::Projection;
use super::view::View;
use super::words::{duration, even_step, number, ticks};
use base64::Engine as _;
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder as _};
use plotters::coord::Shift;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};
use plotters::style::{FontStyle, register_font};
use thiserror::Error;

/// Font that is built in, so that a map looks the same on every machine.
const FONT: &str = "sans-serif";
/// Times that the picture is larger while it is drawn.
const FINER: f64 = 3.0;
/// Panels in a row.
const COLUMNS: usize = 3;

/// Error of drawing a map.
#[derive(Debug, Error)]
pub enum DrawError {
    /// plotters fails.
    #[error("the map cannot be drawn: {0}")]
    Plot(String),
    /// The PNG cannot be encoded.
    #[error("the map cannot be encoded: {0}")]
    Encode(#[from] image::ImageError),
}

fn plot_error(error: impl std::fmt::Display) -> DrawError {
    DrawError::Plot(error.to_string())
}

/// A map that can be drawn. All places are in pixels of a panel.
#[derive(Debug, Clone, PartialEq)]
pub struct MapFigure {
    /// First line.
    pub title: String,
    /// Second line.
    pub subtitle: String,
    /// Lines below.
    pub footer: Vec<String>,
    /// Names and units of Cartesian axes; `None` for degrees.
    pub axes: Option<[(String, String); 2]>,
    /// What all panels show.
    pub view: View,
    /// Panels, one for each tau.
    pub panels: Vec<Panel>,
    /// Colour bars.
    pub bars: Vec<Bar>,
    /// Unit of the panels' tau.
    pub caption_unit: String,
}

/// A panel.
#[derive(Debug, Clone, PartialEq)]
pub struct Panel {
    /// |tau|, in time units.
    pub tau: f64,
    /// Colours, rows from the top.
    pub pixels: Vec<[u8; 3]>,
    /// Rims of land and missing cells.
    pub coast: Vec<Vec<[f64; 2]>>,
    /// Contours.
    pub contours: Vec<Vec<[f64; 2]>>,
    /// Ridges with their colour.
    pub ridges: Vec<([u8; 3], Vec<[f64; 2]>)>,
    /// Tails and tips of arrows.
    pub arrows: Vec<[[f64; 2]; 2]>,
}

/// A colour bar.
#[derive(Debug, Clone, PartialEq)]
pub struct Bar {
    /// What it shows, with its unit.
    pub label: String,
    /// Its colours.
    pub ramp: Ramp,
    /// Its ends.
    pub range: [f64; 2],
    /// Whether values lie below and above its ends.
    pub goes_on: [bool; 2],
}

/// Places of all parts, in pixels of the picture.
struct Layout {
    width: f64,
    height: f64,
    /// Size of the text, 1 for small pictures.
    unit: f64,
    /// Upper left corners of the panels.
    panels: Vec<[f64; 2]>,
    /// Top of the colour bars, and of the footer.
    bars: f64,
    footer: f64,
}

impl Layout {
    fn new(figure: &MapFigure) -> Self {
        let [w, h] = figure.view.size.map(|n| n as f64);
        let columns = figure.panels.len().clamp(1, COLUMNS);
        let rows = figure.panels.len().div_ceil(columns).max(1);
        let unit = ((w * columns as f64).max(h) / 900.0).clamp(1.0, 5.0);
        let caption = if figure.panels.len() > 1 { 24.0 * unit } else { 0.0 };
        let axis = if figure.axes.is_some() { 20.0 * unit } else { 0.0 };
        let (left, right, between) = (66.0 * unit + axis, 42.0 * unit, 66.0 * unit + axis);
        let inner = w * columns as f64 + between * (columns - 1) as f64;
        let width = (left + inner + right).max(if figure.bars.len() > 1 { 820.0 } else { 640.0 } * unit).ceil();
        let start = left + (width - right - left - inner) / 2.0;
        let row = caption + h + 30.0 * unit + axis;
        // Meridians that end at the top have their labels there.
        let is_round = matches!(figure.view.projection, Projection::Polar { .. });
        let top = if is_round { 88.0 } else { 66.0 } * unit;
        let panels = (0..figure.panels.len())
            .map(|k| [(start + (k % columns) as f64 * (w + between)).round(), (top + caption + (k / columns) as f64 * row).round()])
            .collect();
        let bars = top + rows as f64 * row + 4.0 * unit;
        let footer = bars + 68.0 * unit;
        let height = (footer + figure.footer.len() as f64 * 17.0 * unit + 8.0 * unit).ceil();
        Self { width, height, unit, panels, bars, footer }
    }
}

/// Draws a map as PNG.
///
/// # Errors
/// plotters fails, or the picture cannot be encoded.
pub fn write_png(figure: &MapFigure) -> Result<Vec<u8>, DrawError> {
    let layout = Layout::new(figure);
    // Large pictures are smooth enough at twice their size, which bounds the memory.
    let finer = if layout.width * layout.height > 4e6 { 2.0 } else { FINER };
    let scale = finer as usize;
    let (width, height) = (layout.width as usize, layout.height as usize);
    let (wide, high) = (width * scale, height * scale);
    let mut fine = vec![255u8; wide * high * 3];
    let [columns, rows] = figure.view.size;
    for (panel, corner) in figure.panels.iter().zip(&layout.panels) {
        let [x0, y0] = corner.map(|c| c as usize * scale);
        for y in 0..rows * scale {
            for x in 0..columns * scale {
                let at = ((y0 + y) * wide + x0 + x) * 3;
                fine[at..at + 3].copy_from_slice(&panel.pixels[y / scale * columns + x / scale]);
            }
        }
    }
    {
        let area = BitMapBackend::with_buffer(&mut fine, (wide as u32, high as u32)).into_drawing_area();
        Pen { area: &area, finer, in_parts: true }.figure(figure, &layout)?;
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

/// Draws a map as SVG: lines and words as such, the pixels of each panel as a PNG inside.
///
/// # Errors
/// plotters fails, or the pixels cannot be encoded.
pub fn write_svg(figure: &MapFigure) -> Result<String, DrawError> {
    let layout = Layout::new(figure);
    let (width, height) = (layout.width, layout.height);
    let mut text = String::new();
    {
        let size = ((width * FINER) as u32, (height * FINER) as u32);
        let area = SVGBackend::with_string(&mut text, size).into_drawing_area();
        Pen { area: &area, finer: FINER, in_parts: false }.figure(figure, &layout)?;
        area.present().map_err(plot_error)?;
    }
    let (_, body) = text.split_once('>').ok_or_else(|| plot_error("the SVG has no head"))?;
    let [columns, rows] = figure.view.size;
    let mut whole = format!(
        "<svg width=\"{width}\" height=\"{height}\" viewBox=\"0 0 {0} {1}\" xmlns=\"http://www.w3.org/2000/svg\">\n\
         <rect width=\"100%\" height=\"100%\" fill=\"white\"/>\n",
        width * FINER,
        height * FINER
    );
    for (panel, [x, y]) in figure.panels.iter().zip(&layout.panels) {
        let picture = png(columns, rows, &panel.pixels.concat())?;
        let data = base64::engine::general_purpose::STANDARD.encode(picture);
        whole += &format!(
            "<image x=\"{}\" y=\"{}\" width=\"{}\" height=\"{}\" style=\"image-rendering: pixelated\" href=\"data:image/png;base64,{data}\"/>\n",
            x * FINER,
            y * FINER,
            columns as f64 * FINER,
            rows as f64 * FINER
        );
    }
    whole += body.trim_start_matches('\n');
    Ok(whole)
}

/// Draws in pixels of the picture.
struct Pen<'a, B: DrawingBackend> {
    area: &'a DrawingArea<B, Shift>,
    finer: f64,
    /// Lines piece by piece: plotters fills a thick path as one polygon, in which parts that cross each other would be holes.
    in_parts: bool,
}

/// Where a text stands relative to its place.
const LEFT: Pos = Pos { h_pos: HPos::Left, v_pos: VPos::Top };
const CENTRE: Pos = Pos { h_pos: HPos::Center, v_pos: VPos::Top };

impl<B: DrawingBackend> Pen<'_, B> {
    fn at(&self, [x, y]: [f64; 2]) -> (i32, i32) {
        ((x * self.finer).round() as i32, (y * self.finer).round() as i32)
    }

    fn line(&self, points: &[[f64; 2]], offset: [f64; 2], colour: RGBAColor, width: f64) -> Result<(), DrawError> {
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

    fn text(&self, text: &str, place: [f64; 2], size: f64, anchor: Pos, angle: FontTransform) -> Result<(), DrawError> {
        let style = TextStyle::from((FONT, size * self.finer).into_font().transform(angle)).pos(anchor).color(&BLACK);
        self.area.draw_text(text, &style, self.at(place)).map_err(plot_error)
    }

    /// Width of a text, in pixels of the picture.
    fn width(&self, text: &str, size: f64) -> Result<f64, DrawError> {
        let style = TextStyle::from((FONT, size * self.finer).into_font());
        Ok(f64::from(self.area.estimate_text_size(text, &style).map_err(plot_error)?.0) / self.finer)
    }

    /// A text that is cut at a word to fit, with an ellipsis.
    fn fitting(&self, text: &str, size: f64, width: f64) -> Result<String, DrawError> {
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

    fn figure(&self, figure: &MapFigure, layout: &Layout) -> Result<(), DrawError> {
        register_font(FONT, FontStyle::Normal, epaint_default_fonts::UBUNTU_LIGHT)
            .map_err(|_| plot_error("the built-in font is not read"))?;
        let u = layout.unit;
        let margin = 16.0 * u;
        let room = layout.width - 2.0 * margin;
        self.text(&self.fitting(&figure.title, 21.0 * u, room)?, [margin, 12.0 * u], 21.0 * u, LEFT, FontTransform::None)?;
        self.text(&self.fitting(&figure.subtitle, 16.0 * u, room)?, [margin, 39.0 * u], 16.0 * u, LEFT, FontTransform::None)?;
        for (panel, corner) in figure.panels.iter().zip(&layout.panels) {
            self.panel(figure, panel, *corner, u)?;
        }
        let gap = 48.0 * u;
        let count = figure.bars.len().max(1) as f64;
        let each = ((layout.width - 2.0 * (margin + 30.0 * u) - gap * (count - 1.0)) / count).min(560.0 * u);
        let first = (layout.width - each * count - gap * (count - 1.0)) / 2.0;
        for (number, bar) in figure.bars.iter().enumerate() {
            self.bar(bar, [first + number as f64 * (each + gap), layout.bars], each, u)?;
        }
        for (number, line) in figure.footer.iter().enumerate() {
            let text = self.fitting(line, 13.0 * u, room)?;
            self.text(&text, [margin, layout.footer + 17.0 * u * number as f64], 13.0 * u, LEFT, FontTransform::None)?;
        }
        Ok(())
    }

    fn panel(&self, figure: &MapFigure, panel: &Panel, corner: [f64; 2], u: f64) -> Result<(), DrawError> {
        let view = &figure.view;
        let [w, h] = view.size.map(|n| n as f64);
        if figure.panels.len() > 1 {
            let caption = format!("tau = {}", duration(panel.tau, &figure.caption_unit));
            self.text(&caption, [corner[0] + w / 2.0, corner[1] - 21.0 * u], 15.0 * u, CENTRE, FontTransform::None)?;
        }
        for line in &panel.coast {
            self.line(line, corner, RGBColor(60, 60, 60).to_rgba(), 1.2 * u)?;
        }
        let [x, y] = view.region_extent();
        let units = figure.axes.as_ref().map(|names| [axis_unit(&names[0].1, x), axis_unit(&names[1].1, y)]);
        let grid = graticule(view, units.map_or([1.0; 2], |units| units.map(|(_, divisor)| divisor)), u);
        for (axis, lines) in grid.iter().enumerate() {
            let mut taken: Vec<[f64; 2]> = Vec::new();
            for line in lines {
                if view.is_geographic {
                    self.line(&line.points, corner, BLACK.mix(0.28), 0.7 * u)?;
                }
                self.label(line, axis, corner, view, u, &mut taken)?;
            }
        }
        for line in &panel.contours {
            self.line(line, corner, WHITE.mix(0.9), 1.2 * u)?;
        }
        // By the size of the panel, so that lines leave room between them.
        let thin = (1.3 * w.max(h) / 900.0).max(0.8);
        for (colour, line) in &panel.ridges {
            let [r, g, b] = *colour;
            self.line(line, corner, RGBColor(r, g, b).to_rgba(), thin)?;
        }
        for (colour, width) in [(BLACK.mix(0.55), 2.6), (WHITE.to_rgba(), 1.1)] {
            for [tail, tip] in &panel.arrows {
                let (dx, dy) = (tip[0] - tail[0], tip[1] - tail[1]);
                let barb = |side: f64| [tip[0] - 0.32 * dx + side * 0.2 * dy, tip[1] - 0.32 * dy - side * 0.2 * dx];
                self.line(&[*tail, *tip], corner, colour, width * u)?;
                self.line(&[barb(1.0), *tip, barb(-1.0)], corner, colour, width * u)?;
            }
        }
        view.rim().iter().try_for_each(|line| self.line(line, corner, BLACK.to_rgba(), 1.2 * u))?;
        if let (Some(names), Some(units)) = (&figure.axes, units) {
            let words = |k: usize| if units[k].0.is_empty() { names[k].0.clone() } else { format!("{}, {}", names[k].0, units[k].0) };
            self.text(&words(0), [corner[0] + w / 2.0, corner[1] + h + 25.0 * u], 14.0 * u, CENTRE, FontTransform::None)?;
            let widths = grid[1].iter().map(|line| self.width(&line.label, 14.0 * u));
            let widest = widths.collect::<Result<Vec<f64>, _>>()?.into_iter().fold(0.0, f64::max);
            self.text(&words(1), [corner[0] - 32.0 * u - widest, corner[1] + h / 2.0], 14.0 * u, CENTRE, FontTransform::Rotate270)?;
        }
        Ok(())
    }

    /// Tick and label at the first point of a line, outward along it. `taken`: places of labels that this one must not touch.
    fn label(
        &self,
        line: &GridLine,
        axis: usize,
        corner: [f64; 2],
        view: &View,
        u: f64,
        taken: &mut Vec<[f64; 2]>,
    ) -> Result<(), DrawError> {
        let (first, second) = (line.points[0], line.points[1]);
        let (dx, dy) = (first[0] - second[0], first[1] - second[1]);
        let length = dx.hypot(dy).max(1e-9);
        let out = [dx / length, dy / length];
        let size = 14.0 * u;
        let width = self.width(&line.label, size)?;
        // The box of the text touches a circle around the end of the line.
        let away = 7.0 * u + (out[0] * width / 2.0).abs() + (out[1] * size / 2.0).abs();
        let centre = [first[0] + away * out[0], first[1] + away * out[1]];
        let is_near = |other: &[f64; 2]| (other[0] - centre[0]).abs() < width + 6.0 * u && (other[1] - centre[1]).abs() < size + 2.0 * u;
        let [w, h] = view.size.map(|n| n as f64);
        // A parallel of a polar map starts inside of it.
        let is_inside = axis == 1 && centre[0] > 0.0 && centre[0] < w && centre[1] > 0.0 && centre[1] < h;
        if taken.iter().any(is_near) {
            return Ok(());
        }
        taken.push(centre);
        let place = [centre[0] + corner[0], centre[1] + corner[1]];
        if is_inside {
            let (x, y) = (width / 2.0 + 2.0 * u, size / 2.0);
            let ends = [self.at([place[0] - x, place[1] - y]), self.at([place[0] + x, place[1] + y])];
            self.area.draw(&Rectangle::new(ends, WHITE.mix(0.75).filled())).map_err(plot_error)?;
        } else {
            self.line(&[first, [first[0] + 4.0 * u * out[0], first[1] + 4.0 * u * out[1]]], corner, BLACK.to_rgba(), u)?;
        }
        self.text(&line.label, [place[0], place[1] - size / 2.0], size, CENTRE, FontTransform::None)
    }

    fn bar(&self, bar: &Bar, [x, y]: [f64; 2], width: f64, u: f64) -> Result<(), DrawError> {
        let (top, bottom) = (y + 22.0 * u, y + 38.0 * u);
        let label = self.fitting(&bar.label, 15.0 * u, width + 40.0 * u)?;
        self.text(&label, [x + width / 2.0, y], 15.0 * u, CENTRE, FontTransform::None)?;
        let solid = |[r, g, b]: [u8; 3]| RGBColor(r, g, b).filled();
        const PARTS: usize = 256;
        for part in 0..PARTS {
            // To the end of the bar, and the next one over it: in an SVG, seams between neighbours would show.
            let ends = [self.at([x + width * part as f64 / PARTS as f64, top]), self.at([x + width, bottom])];
            self.area.draw(&Rectangle::new(ends, solid(bar.ramp.colour((part as f64 + 0.5) / PARTS as f64)))).map_err(plot_error)?;
        }
        // Points at ends beyond which values lie.
        let middle = (top + bottom) / 2.0;
        let mut rim = Vec::new();
        for (end, sign) in [(0, -1.0), (1, 1.0)] {
            let edge = x + width * end as f64;
            let corners = if sign < 0.0 { [[edge, bottom], [edge, top]] } else { [[edge, top], [edge, bottom]] };
            if bar.goes_on[end] {
                let tip = [edge + sign * 11.0 * u, middle];
                let outline = vec![self.at(corners[0]), self.at(tip), self.at(corners[1])];
                self.area.draw(&Polygon::new(outline, solid(bar.ramp.colour(end as f64)))).map_err(plot_error)?;
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
