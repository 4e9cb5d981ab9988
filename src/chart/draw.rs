//! The panels of a chart as one picture, drawn by plotters.

use super::Chart;
use super::ftle::{CHARGED, FtlePanel, FtlePoint};
use super::picture::{PictureCurve, PicturePanel, PicturePoint, TARGETS};
use super::scaling::{Axis, ScalingPanel};
use super::verdict::size;
use crate::source::duration;
use image::{ImageFormat, RgbImage};
use plotters::coord::Shift;
use plotters::coord::ranged1d::{AsRangedCoord, Ranged, ValueFormatter};
use plotters::prelude::*;
use plotters::style::{FontStyle, register_font};
use std::io::Cursor;
use std::ops::Range;
use thiserror::Error;

/// Width of the picture and height of a row of panels, in pixels.
const WIDTH: u32 = 1800;
const ROW: u32 = 620;
/// Width of the legend beside each panel.
const LEGEND: u32 = 270;
/// Most points of a line that are marked besides.
const MARKED: usize = 60;
/// Font that is built in, so that a chart looks the same on every machine.
const FONT: &str = "sans-serif";

/// Colours that remain distinct with colour blindness (Okabe and Ito 2008), without yellow, which is faint on white.
const COLOURS: [RGBColor; 7] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(86, 180, 233),
    RGBColor(230, 159, 0),
    RGBColor(90, 90, 90),
];

/// Error of drawing a chart.
#[derive(Debug, Error)]
pub enum DrawError {
    /// plotters fails.
    #[error("the chart cannot be drawn: {0}")]
    Plot(String),
    /// The PNG cannot be encoded.
    #[error("the chart cannot be encoded: {0}")]
    Encode(#[from] image::ImageError),
}

fn plot_error(error: impl std::fmt::Display) -> DrawError {
    DrawError::Plot(error.to_string())
}

/// Draws a chart as SVG.
///
/// # Errors
/// plotters fails.
pub fn write_svg(chart: &Chart) -> Result<String, DrawError> {
    let mut text = String::new();
    let panels = panels(chart);
    draw(&SVGBackend::with_string(&mut text, picture_size(&panels)).into_drawing_area(), &title(chart), &panels)?;
    Ok(text)
}

/// A curve with its name in the legend.
pub type Curve = (String, Vec<(f64, f64)>);

/// Draws the validation error over the epochs of trainings as SVG; the epochs, and errors of more than a decade, on logarithmic axes.
///
/// # Errors
/// plotters fails.
pub fn write_epochs(title: &str, curves: &[Curve]) -> Result<String, DrawError> {
    let series =
        curves.iter().map(|(name, points)| Series { name: name.clone(), points: points.clone(), is_line: true, ..Series::default() });
    let panels = [Panel {
        title: "Error on points that were not trained on".into(),
        x: "epochs".into(),
        y: "root mean square error of the log-stretch".into(),
        is_y_log: {
            let errors = || curves.iter().flat_map(|(_, points)| points).map(|(_, error)| *error).filter(|error| *error > 0.0);
            // Within a decade a logarithmic axis has no labels.
            errors().fold(0.0, f64::max) > 10.0 * errors().fold(f64::INFINITY, f64::min)
        },
        series: series.collect(),
        front: Vec::new(),
        pick: None,
        levels: Vec::new(),
    }];
    let mut text = String::new();
    draw(&SVGBackend::with_string(&mut text, picture_size(&panels)).into_drawing_area(), title, &panels)?;
    Ok(text)
}

/// Draws a chart as PNG.
///
/// # Errors
/// plotters fails, or the picture cannot be encoded.
pub fn write_png(chart: &Chart) -> Result<Vec<u8>, DrawError> {
    let panels = panels(chart);
    let (width, height) = picture_size(&panels);
    let mut pixels = vec![0; (width * height * 3) as usize];
    draw(&BitMapBackend::with_buffer(&mut pixels, (width, height)).into_drawing_area(), &title(chart), &panels)?;
    let picture = RgbImage::from_raw(width, height, pixels).ok_or_else(|| plot_error("the picture has another size than its buffer"))?;
    let mut bytes = Cursor::new(Vec::new());
    picture.write_to(&mut bytes, ImageFormat::Png)?;
    Ok(bytes.into_inner())
}

/// Points of one entry of the legend.
#[derive(Default)]
struct Series {
    name: String,
    points: Vec<(f64, f64)>,
    /// Vertical lines from points to another value: the two ends.
    whiskers: Vec<[(f64, f64); 2]>,
    is_line: bool,
}

/// One panel. The horizontal axis is logarithmic.
#[derive(Default)]
struct Panel {
    title: String,
    x: String,
    y: String,
    is_y_log: bool,
    series: Vec<Series>,
    /// Pareto front, with labels.
    front: Vec<(f64, f64, String)>,
    /// The pick on the front.
    pick: Option<(f64, f64)>,
    /// Horizontal lines with labels.
    levels: Vec<(f64, String)>,
}

fn panels(chart: &Chart) -> Vec<Panel> {
    let unit = if chart.time_unit.is_empty() { String::new() } else { format!(", 1/{}", chart.time_unit) };
    let mut panels = Vec::new();
    if let Some(panel) = &chart.ftle {
        panels.push(ftle_panel(panel, &unit, "FTLE: error against cost of a sample".into(), "seconds per sample", |point| {
            1.0 / point.samples_per_second
        }));
        for samples in [CHARGED[0], CHARGED[1]] {
            let title = format!("FTLE: error against seconds of {samples:.0e} samples, building included");
            panels.push(ftle_panel(panel, &unit, title, "seconds", |point| point.seconds(samples)));
        }
    }
    panels.extend(chart.pictures.iter().flat_map(picture_panels));
    panels.extend(chart.pictures.as_ref().and_then(sliding_panel));
    if let Some(panel) = &chart.scaling {
        let tau = if chart.time_unit.is_empty() { "tau".to_owned() } else { format!("tau, {}", chart.time_unit) };
        let axes = [
            (Axis::Tau, "tau", tau.as_str()),
            (Axis::Snapshots, "snapshots in tau", "snapshots"),
            (Axis::Nodes, "nodes of the grid", "nodes"),
            (Axis::Threads, "threads", "threads"),
        ];
        panels.extend(axes.into_iter().filter_map(|(axis, against, label)| scaling_panel(panel, axis, against, label)));
    }
    panels
}

fn ftle_panel(panel: &FtlePanel, unit: &str, title: String, x: &str, cost: impl Fn(&FtlePoint) -> f64) -> Panel {
    let at: Vec<[f64; 2]> = panel.methods.iter().map(|point| [cost(point), point.rms]).collect();
    let mut series: Vec<Series> = Vec::new();
    for (point, &[x, y]) in panel.methods.iter().zip(&at) {
        let number = series.iter().position(|series| series.name == point.method).unwrap_or_else(|| {
            series.push(Series { name: point.method.clone(), ..Series::default() });
            series.len() - 1
        });
        series[number].points.push((x, y));
        series[number].whiskers.push([(x, y), (x, point.p99)]);
    }
    let (front, pick) = panel.front(cost);
    let label = |i: usize| (at[i][0], at[i][1], format!("{}, {}", panel.methods[i].setting, size(panel.methods[i].bytes)));
    Panel {
        title,
        x: x.into(),
        y: format!("error of the FTLE, root mean square to 99th percentile{unit}"),
        is_y_log: true,
        series,
        front: front.into_iter().map(label).collect(),
        pick: pick.map(|i| (at[i][0], at[i][1])),
        levels: vec![(panel.tolerance, "tolerance".into())],
    }
}

/// The curves of the volume view, and that of the map.
fn curves(panel: &PicturePanel) -> impl Iterator<Item = (String, &PictureCurve)> {
    let map = panel.map.iter().map(|curve| (format!("{} (of its FTLE)", curve.name()), curve));
    panel.curves.iter().map(|curve| (curve.name(), curve)).chain(map)
}

/// PSNR, relMSE and SSIM of a still window; without those that no frame has.
fn picture_panels(panel: &PicturePanel) -> impl Iterator<Item = Panel> {
    let [width, height] = panel.size;
    let targets = TARGETS.map(|target| target.to_string());
    let of = |what: &str, y: &str, is_y_log: bool, levels: &[f64], value: fn(&PicturePoint) -> Option<f64>| {
        // An error of 0, which the noise of the truth hides, has no place on a logarithmic axis.
        let is_drawn = |value: &f64| value.is_finite() && (!is_y_log || *value > 0.0);
        let at = |frame: &PicturePoint| value(frame).filter(is_drawn).map(|value| (frame.seconds, value));
        let series = curves(panel).map(|(name, curve)| {
            let points = curve.frames.iter().filter_map(at).collect();
            Series { name, points, is_line: true, ..Series::default() }
        });
        let series: Vec<Series> = series.collect();
        series.iter().any(|series| !series.points.is_empty()).then(|| Panel {
            title: format!("Pictures of {width} x {height}: {what} over time, still window"),
            x: "seconds since the slide, preparation and training included".into(),
            y: y.into(),
            is_y_log,
            series,
            front: Vec::new(),
            pick: panel.winner().and_then(at),
            levels: levels.iter().map(|&level| (level, format!("{level} dB"))).collect(),
        })
    };
    [
        of("PSNR", "PSNR over lit pixels, dB", false, &[35.0, 40.0], |frame| Some(frame.psnr)),
        of("relMSE", "relMSE over lit pixels", true, &[], |frame| Some(frame.relmse)),
        of("SSIM", &format!("SSIM of frames that reach {} dB, and of the last", targets.join(", ")), false, &[], |frame| frame.ssim),
    ]
    .into_iter()
    .flatten()
}

/// Pictures of a window that slides at every frame; `None` if none was measured.
fn sliding_panel(panel: &PicturePanel) -> Option<Panel> {
    let at = |curve: &PictureCurve| curve.sliding.and_then(|sliding| Some((1.0 / sliding.frames_per_second, sliding.psnr?)));
    // All curves, so that a method has the colour that it has beside.
    let series = curves(panel).map(|(name, curve)| Series { name, points: at(curve).into_iter().collect(), ..Series::default() });
    let series: Vec<Series> = series.collect();
    series.iter().any(|series| !series.points.is_empty()).then(|| Panel {
        title: "Pictures: error against time of a frame, window that slides at every frame".into(),
        x: "seconds per frame, preparation and training included".into(),
        y: "PSNR over lit pixels, dB".into(),
        is_y_log: false,
        series,
        front: Vec::new(),
        pick: None,
        levels: [35.0, 40.0].map(|level| (level, format!("{level} dB"))).to_vec(),
    })
}

/// Costs along one axis; `None` with fewer than two points on it.
fn scaling_panel(panel: &ScalingPanel, axis: Axis, against: &str, label: &str) -> Option<Panel> {
    let mut along: Vec<_> = panel.points.iter().filter(|point| point.axis == axis).collect();
    if along.len() < 2 {
        return None;
    }
    along.sort_by(|a, b| a.value.total_cmp(&b.value));
    let series = |name: &str, value: &dyn Fn(&super::ScalingPoint) -> f64| Series {
        name: name.into(),
        points: along.iter().map(|point| (point.value, value(point))).collect(),
        is_line: true,
        ..Series::default()
    };
    Some(Panel {
        title: format!("Cost of a sample against {against}, steps by error"),
        x: label.into(),
        y: "nanoseconds per sample".into(),
        is_y_log: true,
        series: vec![series("tracing", &|point| point.trace_ns), series("table (built)", &|point| point.table_ns)],
        front: Vec::new(),
        pick: None,
        levels: Vec::new(),
    })
}

/// Rows and columns of panels.
fn layout(panels: &[Panel]) -> (usize, usize) {
    (panels.len().div_ceil(2).max(1), panels.len().clamp(1, 2))
}

fn picture_size(panels: &[Panel]) -> (u32, u32) {
    let (rows, columns) = layout(panels);
    (WIDTH / 2 * columns as u32, 60 + ROW * rows as u32)
}

fn title(chart: &Chart) -> String {
    let threads = if chart.threads == 1 { "thread" } else { "threads" };
    let name = if chart.scene.is_empty() { &chart.source } else { &chart.scene };
    format!("{name} (tau {}) on {}, {} CPU {threads}", duration(chart.tau, &chart.time_unit), chart.device, chart.threads)
}

fn draw<B: DrawingBackend>(area: &DrawingArea<B, Shift>, title: &str, panels: &[Panel]) -> Result<(), DrawError> {
    register_font(FONT, FontStyle::Normal, epaint_default_fonts::UBUNTU_LIGHT).map_err(|_| plot_error("the built-in font is not read"))?;
    area.fill(&WHITE).map_err(plot_error)?;
    let (head, body) = area.split_vertically(60);
    head.titled(title, (FONT, 28)).map_err(plot_error)?;
    for (panel, area) in panels.iter().zip(body.split_evenly(layout(panels))) {
        let (plot, legend) = area.split_horizontally(WIDTH / 2 - LEGEND);
        draw_legend(&legend, panel)?;
        let (x, y) = (span(panel, |(x, _)| x), span(panel, |(_, y)| y));
        if panel.is_y_log {
            draw_panel(&plot, panel, log(x).log_scale(), log(y).log_scale())?;
        } else {
            // One value alone has room as well.
            let range = if y.end > y.start { y.end - y.start } else { y.end.abs().max(1e-3) };
            let margin = 0.05 * range;
            draw_panel(&plot, panel, log(x).log_scale(), y.start - margin..y.end + margin)?;
        }
    }
    area.present().map_err(plot_error)
}

/// Range of all finite values, levels included.
fn span(panel: &Panel, of: impl Fn((f64, f64)) -> f64) -> Range<f64> {
    let points =
        panel.series.iter().flat_map(|series| series.points.iter().chain(series.whiskers.iter().flatten())).map(|point| of(*point));
    let levels = panel.levels.iter().map(|(level, _)| of((f64::NAN, *level)));
    let finite = points.chain(levels).filter(|value| value.is_finite());
    let (low, high) = finite.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), value| (low.min(value), high.max(value)));
    if low <= high { low..high } else { 1.0..10.0 }
}

/// A range for a logarithmic axis, with a margin.
fn log(range: Range<f64>) -> Range<f64> {
    let high = range.end.max(1e-30);
    // Twelve decades at most: an error of 0 must not squeeze the rest.
    let low = range.start.max(1e-12 * high);
    let (low, high) = (low / 1.6, high * 1.6);
    let [first, last] = [low.log10().ceil(), high.log10().floor()];
    // Powers of ten have labels: two of them at least.
    if last > first { low..high } else { 10f64.powf(low.log10().floor())..10f64.powf(high.log10().ceil()) }
}

/// Size of the letters of labels, and the width of one, in pixels.
const LABEL_SIZE: i32 = 13;
const LETTER: f64 = 6.6;
/// Half the width of a marker with some room around it, in pixels.
const MARKER: i32 = 7;

/// A rectangle in pixels: left, top, right, bottom.
type Rectangle = [i32; 4];

/// Size of a label in pixels, from above.
fn label_size(text: &str) -> [i32; 2] {
    [(LETTER * text.chars().count() as f64).ceil() as i32, LABEL_SIZE + 2]
}

/// Corner of a label beside a point, so that it lies within `area` and on nothing in `taken`; `None` if there is no room.
fn beside((x, y): (i32, i32), text: &str, area: Rectangle, taken: &[Rectangle]) -> Option<(i32, i32)> {
    let [width, height] = label_size(text);
    let corners = [
        (x + MARKER, y - height - 2),
        (x - MARKER - width, y - height - 2),
        (x + MARKER, y + 4),
        (x - MARKER - width, y + 4),
        (x - width / 2, y - height - MARKER - 2),
        (x - width / 2, y + MARKER + 2),
    ];
    corners.into_iter().find(|&(left, top)| {
        let own = [left, top, left + width, top + height];
        let is_within = own[0] >= area[0] && own[1] >= area[1] && own[2] <= area[2] && own[3] <= area[3];
        let is_apart = |other: &Rectangle| own[2] <= other[0] || other[2] <= own[0] || own[3] <= other[1] || other[3] <= own[1];
        is_within && taken.iter().all(is_apart)
    })
}

fn draw_panel<B, X, Y>(area: &DrawingArea<B, Shift>, panel: &Panel, x: X, y: Y) -> Result<(), DrawError>
where
    B: DrawingBackend,
    X: AsRangedCoord<Value = f64>,
    Y: AsRangedCoord<Value = f64>,
    X::CoordDescType: Ranged<ValueType = f64> + ValueFormatter<f64>,
    Y::CoordDescType: Ranged<ValueType = f64> + ValueFormatter<f64>,
{
    let mut plot = ChartBuilder::on(area)
        .caption(&panel.title, (FONT, 20))
        .margin(12)
        .x_label_area_size(48)
        .y_label_area_size(78)
        .build_cartesian_2d(x, y)
        .map_err(plot_error)?;
    let height = plot.y_range().end - plot.y_range().start;
    let decimals = (1.0 - height.log10().floor()).clamp(0.0, 6.0) as usize;
    plot.configure_mesh()
        .x_desc(&panel.x)
        .y_desc(&panel.y)
        .label_style((FONT, 15))
        .axis_desc_style((FONT, 17))
        .x_label_formatter(&tick)
        .y_label_formatter(&|y| if panel.is_y_log { tick(y) } else { format!("{y:.decimals$}") })
        .light_line_style(WHITE)
        .draw()
        .map_err(plot_error)?;
    let [x0, x1] = [plot.x_range().start, plot.x_range().end];
    let [y0, y1] = [plot.y_range().start, plot.y_range().end];
    let ((left, bottom), (right, top)) = (plot.backend_coord(&(x0, y0)), plot.backend_coord(&(x1, y1)));
    let area = [left, top, right, bottom];
    let is_drawn = |(x, y): &(f64, f64)| x.is_finite() && y.is_finite();
    let markers = panel.series.iter().filter(|series| !series.is_line || series.points.len() <= MARKED).flat_map(|series| &series.points);
    let mut taken: Vec<Rectangle> = markers
        .filter(|at| is_drawn(at))
        .map(|at| {
            let (x, y) = plot.backend_coord(at);
            [x - MARKER, y - MARKER, x + MARKER, y + MARKER]
        })
        .collect();
    for (level, name) in &panel.levels {
        let style = BLACK.mix(0.5).stroke_width(1);
        plot.draw_series(DashedLineSeries::new([(x0, *level), (x1, *level)], 6, 4, style)).map_err(plot_error)?;
        // Above its line.
        let [width, height] = label_size(name);
        let above = EmptyElement::at((x0, *level)) + Text::new(name.clone(), (5, -height), (FONT, LABEL_SIZE).into_font());
        plot.draw_series([above]).map_err(plot_error)?;
        let (x, y) = plot.backend_coord(&(x0, *level));
        taken.push([x, y - height, x + 5 + width, y]);
    }
    for (number, series) in panel.series.iter().enumerate() {
        let colour = COLOURS[number % COLOURS.len()];
        let finite: Vec<(f64, f64)> = series.points.iter().copied().filter(is_drawn).collect();
        if series.is_line {
            plot.draw_series(LineSeries::new(finite.iter().copied(), colour.stroke_width(2))).map_err(plot_error)?;
        }
        let whiskers = series.whiskers.iter().filter(|ends| ends.iter().all(is_drawn));
        plot.draw_series(whiskers.map(|ends| PathElement::new(*ends, colour.stroke_width(1)))).map_err(plot_error)?;
        if series.is_line && finite.len() > MARKED {
            continue;
        }
        if number < COLOURS.len() {
            plot.draw_series(finite.iter().map(|&at| Circle::new(at, 5, colour.filled()))).map_err(plot_error)?;
        } else {
            plot.draw_series(finite.iter().map(|&at| TriangleMarker::new(at, 7, colour.filled()))).map_err(plot_error)?;
        }
    }
    plot.draw_series(LineSeries::new(panel.front.iter().map(|(x, y, _)| (*x, *y)), BLACK.stroke_width(1))).map_err(plot_error)?;
    // That of the pick first. One without room is left out; the table has them all.
    let is_pick = |(x, y, _): &&(f64, f64, String)| panel.pick == Some((*x, *y));
    for (x, y, label) in panel.front.iter().filter(is_pick).chain(panel.front.iter().filter(|place| !is_pick(place))) {
        let point = plot.backend_coord(&(*x, *y));
        let Some((across, down)) = beside(point, label, area, &taken) else { continue };
        let [width, height] = label_size(label);
        taken.push([across, down, across + width, down + height]);
        let text = Text::new(label.clone(), (across - point.0, down - point.1), (FONT, LABEL_SIZE).into_font());
        plot.draw_series([EmptyElement::at((*x, *y)) + text]).map_err(plot_error)?;
    }
    if let Some(pick) = panel.pick {
        plot.draw_series([Circle::new(pick, 11, BLACK.stroke_width(2))]).map_err(plot_error)?;
    }
    Ok(())
}

/// A label of a tick on a logarithmic axis. Those of all tenths within a decade would run into each other: of 1, 2 and 5 only.
fn tick(value: &f64) -> String {
    let digits = value / 10f64.powf((value.log10() + 1e-9).floor());
    // Others in between would round to the same label.
    if [1.0, 2.0, 5.0].iter().any(|digit| (digits - digit).abs() < 1e-3) { power(value) } else { String::new() }
}

/// A number on a logarithmic axis: 0.001 to 1000 in full, powers beyond.
fn power(value: &f64) -> String {
    // Two digits, since ticks carry rounding.
    let rounded = format!("{value:.1e}").parse().unwrap_or(*value);
    if (1e-3..=1e3).contains(&rounded) { format!("{rounded}") } else { format!("{rounded:.0e}") }
}

fn draw_legend<B: DrawingBackend>(area: &DrawingArea<B, Shift>, panel: &Panel) -> Result<(), DrawError> {
    let mut row = 52;
    let mut line = |text: &str, mark: &dyn Fn((i32, i32)) -> Result<(), DrawError>| {
        mark((8, row + 8))?;
        area.draw_text(text, &(FONT, 15).into_text_style(area), (22, row)).map_err(plot_error)?;
        row += 24;
        Ok::<_, DrawError>(())
    };
    for (number, series) in panel.series.iter().enumerate() {
        let colour = COLOURS[number % COLOURS.len()];
        line(&series.name, &|at| {
            if number < COLOURS.len() {
                area.draw(&Circle::new(at, 5, colour.filled())).map_err(plot_error)
            } else {
                area.draw(&TriangleMarker::new(at, 7, colour.filled())).map_err(plot_error)
            }
        })?;
    }
    if !panel.front.is_empty() {
        line("Pareto front", &|(x, y)| area.draw(&PathElement::new([(x - 6, y), (x + 6, y)], BLACK.stroke_width(1))).map_err(plot_error))?;
    }
    if panel.pick.is_some() {
        line("pick", &|at| area.draw(&Circle::new(at, 7, BLACK.stroke_width(2))).map_err(plot_error))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::{Panel, Series, beside, log, span, tick};

    #[test]
    fn a_panel_has_room_for_its_percentiles() {
        let series = Series { points: vec![(1.0, 2.0)], whiskers: vec![[(1.0, 2.0), (1.0, 9.0)]], ..Series::default() };
        let panel = Panel { series: vec![series], ..Panel::default() };
        assert_eq!(span(&panel, |(_, y)| y), 2.0..9.0);
    }

    #[test]
    fn a_logarithmic_axis_has_two_labels_at_least() {
        assert_eq!(log(2.3..5.3), 1.0..10.0);
        assert_eq!(log(0.8..2.0), 0.1..10.0);
        let wide = log(0.05..20.0);
        assert!(wide.start > 0.03 && wide.end < 40.0, "{wide:?}");
    }

    #[test]
    fn ticks_that_would_touch_have_no_label() {
        let labels = [0.1, 0.2, 0.300_000_000_1, 0.5, 0.7, 0.9, 1.0, 2e-7].map(|value| tick(&value));
        assert_eq!(labels, ["0.1", "0.2", "", "0.5", "", "", "1", "2e-7"]);
    }

    #[test]
    fn labels_lie_within_the_panel_and_beside_what_is_drawn() {
        let area = [0, 0, 200, 100];
        assert_eq!(beside((50, 50), "label", area, &[]), Some((57, 33)), "above, to the right");
        assert_eq!(beside((190, 50), "label", area, &[]), Some((150, 33)), "to the left at the right edge");
        let marker = [60, 30, 74, 44];
        assert_eq!(beside((50, 50), "label", area, &[marker]), Some((10, 33)));
        assert_eq!(beside((50, 50), "label", area, &[area]), None);
    }
}
