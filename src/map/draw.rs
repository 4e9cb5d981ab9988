//! The picture of a map: pixels, lines, graticule, colour bars and words.

use super::graticule::{GridLine, axis_unit, degrees_over, graticule};
use super::sheet::{Bar, CENTRE, DrawError, Image, LEFT, Pen, Sheet, plot_error, sheet_png, sheet_svg};
use super::view::View;
use super::words::duration;
use crate::render::Projection;
use plotters::prelude::*;

/// Panels in a row.
const COLUMNS: usize = 3;

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
    /// Longitudes and latitudes at nodes over a panel ([`super::graticule::nodes_over`]), if its axes are neither.
    pub degrees: Option<Vec<[f64; 2]>>,
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
    sheet_png(&Laid { figure, layout: Layout::new(figure) })
}

/// Draws a map as SVG: lines and words as such, the pixels of each panel as a PNG inside.
///
/// # Errors
/// plotters fails, or the pixels cannot be encoded.
pub fn write_svg(figure: &MapFigure) -> Result<String, DrawError> {
    sheet_svg(&Laid { figure, layout: Layout::new(figure) })
}

/// A map with the places of its parts.
struct Laid<'a> {
    figure: &'a MapFigure,
    layout: Layout,
}

impl Sheet for Laid<'_> {
    fn size(&self) -> [f64; 2] {
        [self.layout.width, self.layout.height]
    }

    fn images(&self) -> Vec<Image<'_>> {
        let size = self.figure.view.size;
        let panels = self.figure.panels.iter().zip(&self.layout.panels);
        panels
            .map(|(panel, corner)| Image { corner: *corner, shown: size.map(|n| n as f64), size, pixels: &panel.pixels, is_smooth: false })
            .collect()
    }

    fn draw<B: DrawingBackend>(&self, pen: &Pen<'_, B>) -> Result<(), DrawError> {
        pen.figure(self.figure, &self.layout)
    }
}

impl<B: DrawingBackend> Pen<'_, B> {
    fn figure(&self, figure: &MapFigure, layout: &Layout) -> Result<(), DrawError> {
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
        if let Some(degrees) = &figure.degrees {
            let mut taken: Vec<[f64; 2]> = Vec::new();
            for line in degrees_over(view, degrees, u) {
                self.line(&line.points, corner, BLACK.mix(0.28), 0.7 * u)?;
                self.label_inside(&line, corner, view, u, &mut taken)?;
            }
        }
        for line in &panel.contours {
            self.line(line, corner, WHITE.mix(0.9), 1.2 * u)?;
        }
        // By the size of the panel, so that lines leave room between them.
        let thin = (1.3 * w.max(h) / 900.0).max(0.8);
        // A light rim, since lines cross dark colours too.
        for (_, line) in &panel.ridges {
            self.line(line, corner, WHITE.mix(0.6), thin + 1.4 * u)?;
        }
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

    /// Label on a light ground at the first point of a line, inside of the panel: beside it stand the labels of its own axes.
    fn label_inside(&self, line: &GridLine, corner: [f64; 2], view: &View, u: f64, taken: &mut Vec<[f64; 2]>) -> Result<(), DrawError> {
        let size = 13.0 * u;
        let half = [self.width(&line.label, size)? / 2.0 + 2.0 * u, size / 2.0];
        let place = [0, 1].map(|k| line.points[0][k].min(view.size[k] as f64 - half[k] - 2.0 * u).max(half[k] + 2.0 * u));
        if taken.iter().any(|other| (0..2).all(|k| (other[k] - place[k]).abs() < 2.0 * half[k] + 2.0 * u)) {
            return Ok(());
        }
        taken.push(place);
        let middle = [place[0] + corner[0], place[1] + corner[1]];
        let ends = [self.at([middle[0] - half[0], middle[1] - half[1]]), self.at([middle[0] + half[0], middle[1] + half[1]])];
        self.area.draw(&Rectangle::new(ends, WHITE.mix(0.75).filled())).map_err(plot_error)?;
        self.text(&line.label, [middle[0], middle[1] - size / 2.0], size, CENTRE, FontTransform::None)
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
}
