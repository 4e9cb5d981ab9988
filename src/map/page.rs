//! A frame of a run as a page for a talk or a paper: the picture large, its colour bar, and what it shows in words.

use super::make::structures;
use super::sheet::{Bar, DrawError, Image, LEFT, Pen, Sheet, sheet_png, sheet_svg, wrapped};
use super::words::{Rate, date, duration, number};
use crate::flow::Direction;
use crate::publish::Picture;
use crate::render::Method;
use crate::run::{ColorBar, FrameRecord};
use plotters::prelude::{BLACK, Color as _, DrawingBackend, FontTransform};

/// Parts of the colour bar.
const PARTS: usize = 256;

/// A page that can be drawn.
#[derive(Debug, Clone, PartialEq)]
pub struct FramePage {
    picture: Picture,
    title: String,
    subtitle: String,
    bar: Bar,
    /// Lines below.
    words: Vec<String>,
    /// Width and height, in pixels.
    size: [f64; 2],
    /// Those of the picture.
    shown: [f64; 2],
    /// Size of the text, 1 for small pages.
    unit: f64,
}

impl FramePage {
    /// The page of a frame, `width` pixels wide. `colours` are those of its transfer function, `title` that of the scene.
    ///
    /// # Errors
    /// plotters fails.
    pub fn new(picture: Picture, record: &FrameRecord, colours: &ColorBar, title: &str, width: usize) -> Result<Self, DrawError> {
        let (bar, what, when) = (bar_of(record, colours, false), field_of(record), when_of(record));
        let unit = (width as f64 / 900.0).clamp(0.6, 5.0);
        let words = wrapped(&words(record), 13.0 * unit, width as f64 - 32.0 * unit)?;
        let [columns, rows] = picture.size.map(|n| n.max(1) as f64);
        let room = width as f64 - 32.0 * unit;
        // High ones are narrower than the page.
        let scale = (room / columns).min(2.0 * room / rows);
        let shown = [(columns * scale).round().max(1.0), (rows * scale).round().max(1.0)];
        let height = 66.0 * unit + shown[1] + 84.0 * unit + 17.0 * unit * words.len() as f64 + 8.0 * unit;
        Ok(Self {
            picture,
            title: if title.is_empty() { what } else { title.to_owned() },
            subtitle: format!(
                "{when}, tau = {} {}, frame {}",
                duration(record.tau, &record.time_unit),
                direction_of(record).name(),
                record.frame
            ),
            bar,
            words,
            size: [width as f64, height.ceil()],
            shown,
            unit,
        })
    }

    /// Width and height, in pixels.
    pub fn size(&self) -> [usize; 2] {
        self.size.map(|n| n as usize)
    }

    /// The page as PNG.
    ///
    /// # Errors
    /// plotters fails, or the page cannot be encoded.
    pub fn png(&self) -> Result<Vec<u8>, DrawError> {
        sheet_png(self)
    }

    /// The page as SVG: words as such, the picture as a PNG inside.
    ///
    /// # Errors
    /// plotters fails, or the picture cannot be encoded.
    pub fn svg(&self) -> Result<String, DrawError> {
        sheet_svg(self)
    }

    /// Upper left corner of the picture.
    fn corner(&self) -> [f64; 2] {
        [((self.size[0] - self.shown[0]) / 2.0).floor(), (66.0 * self.unit).floor()]
    }
}

impl Sheet for FramePage {
    fn size(&self) -> [f64; 2] {
        self.size
    }

    fn images(&self) -> Vec<Image<'_>> {
        let Picture { size, pixels } = &self.picture;
        vec![Image { corner: self.corner(), shown: self.shown, size: *size, pixels, is_smooth: true }]
    }

    fn draw<B: DrawingBackend>(&self, pen: &Pen<'_, B>) -> Result<(), DrawError> {
        let (u, width) = (self.unit, self.size[0]);
        let room = width - 32.0 * u;
        for (text, top, size) in [(&self.title, 12.0, 21.0), (&self.subtitle, 39.0, 16.0)] {
            pen.text(&pen.fitting(text, size * u, room)?, [16.0 * u, top * u], size * u, LEFT, FontTransform::None)?;
        }
        let [left, top] = self.corner();
        let (right, bottom) = (left + self.shown[0], top + self.shown[1]);
        let rim = [[left, top], [right, top], [right, bottom], [left, bottom], [left, top]];
        pen.line(&rim, [0.0; 2], BLACK.to_rgba(), 0.8 * u)?;
        let below = bottom + 10.0 * u;
        let bar = (room - 40.0 * u).min(560.0 * u);
        pen.bar(&self.bar, [(width - bar) / 2.0, below], bar, u)?;
        self.words.iter().enumerate().try_for_each(|(number, line)| {
            let place = [16.0 * u, below + 74.0 * u + 17.0 * u * number as f64];
            pen.text(line, place, 13.0 * u, LEFT, FontTransform::None)
        })
    }
}

fn direction_of(record: &FrameRecord) -> Direction {
    if record.direction == Direction::Forward.name() { Direction::Forward } else { Direction::Backward }
}

/// What a frame shows.
fn field_of(record: &FrameRecord) -> String {
    let direction = direction_of(record);
    format!("{} FTLE ({} structures)", direction.name(), structures(direction))
}

/// The colour bar of a frame. Its label tells the ends too if `ends` is set, since ticks stand at round numbers.
pub(super) fn bar_of(record: &FrameRecord, colours: &ColorBar, ends: bool) -> Bar {
    let rate = Rate::fitting(&record.time_unit, record.tau);
    let range = [colours.low, colours.high].map(|value| value * rate.factor);
    let unit = if rate.unit.is_empty() { String::new() } else { format!(", {}", rate.unit) };
    let ends = if ends { format!(", {} to {}", number(range[0]), rate.words(range[1])) } else { unit };
    Bar {
        label: format!("{}{ends}", field_of(record)),
        colours: (0..PARTS).map(|part| between(&colours.colors, (part as f64 + 0.5) / PARTS as f64)).collect(),
        range,
        goes_on: [true, true],
    }
}

/// Date or time of a frame.
pub(super) fn when_of(record: &FrameRecord) -> String {
    match &record.date {
        Some(text) => date(text),
        // Without the digits that sums of steps leave.
        None => format!("t = {} {}", (record.time * 1e6).round() / 1e6, record.time_unit).trim_end().to_owned(),
    }
}

/// A colour between neighbours of a list that lies evenly on [0, 1].
fn between(colours: &[[u8; 3]], share: f64) -> [u8; 3] {
    let at = share.clamp(0.0, 1.0) * colours.len().saturating_sub(1) as f64;
    let first = at as usize;
    match colours.get(first..) {
        Some([a, b, ..]) => std::array::from_fn(|k| (f64::from(a[k]) + at.fract() * (f64::from(b[k]) - f64::from(a[k]))).round() as u8),
        Some([a]) => *a,
        _ => [255; 3],
    }
}

/// The projection of a map that has one.
pub(super) fn projection_of(record: &FrameRecord) -> Option<String> {
    record.projection.map(|plane| format!("Projection: {}.", plane.projection.words()))
}

/// Source, extent, method and error of a frame, a paragraph each.
fn words(record: &FrameRecord) -> Vec<String> {
    let mut words = vec![format!("Source: {}.", record.source.trim_end_matches('.'))];
    if let Some(domain) = &record.domain {
        let axes = domain.axes.iter().zip(domain.min.iter().zip(&domain.max));
        let extents = axes.map(|([name, unit], (low, high))| {
            let unit = unit.replace('_', " ");
            format!("{name} {} to {} {unit}", number(*low), number(*high)).trim_end().to_owned()
        });
        words.push(format!("Extent: {}.", extents.collect::<Vec<_>>().join(", ")));
    }
    words.extend(projection_of(record));
    let surrogate = record.surrogate.as_ref().map_or_else(String::new, |kind| format!(" with surrogate {kind}"));
    let samples = record.picture_error.map_or(record.samples_per_pixel, |error| error.samples_per_pixel);
    let what = if record.method == Method::Map.name() { "seeds" } else { "samples" };
    words.push(format!("Method: {}{surrogate}, {} {what} a pixel, on {}.", record.method, number(samples), record.device));
    words.push(format!("{} {}", picture_error(record), traced_error(record)).trim_end().to_owned());
    words.push(format!("Drawn by ridgewatch {}.", env!("CARGO_PKG_VERSION")));
    words
}

/// The stated error of the picture, with its interval.
pub(super) fn picture_error(record: &FrameRecord) -> String {
    if let Some(error) = &record.picture_error {
        // The peak of the picture is 1.
        let share = |decibels: f64| number(100.0 * 10f64.powf(-decibels / 20.0));
        let [value, low, high] = [error.psnr.value, error.psnr.low, error.psnr.high];
        let (what, pixels) = match record.method == Method::Map.name() {
            true => ("Error of the FTLE, of the range of the colours", "pixels with a value"),
            false => ("Error of colours", "lit pixels"),
        };
        return format!(
            "{what}: {} % rms [{}, {}], {value:.1} dB [{low:.1}, {high:.1}], over {pixels}, 95 % intervals.",
            share(value),
            share(high),
            share(low)
        );
    }
    match &record.trusted_error {
        Some(error) => {
            let [low, high] = error.optical_rms_interval.map(|v| number(100.0 * v));
            let value = number(100.0 * error.optical_rms);
            format!(
                "Error of colours where the surrogate is trusted: {value} % rms [{low}, {high}], 95 % interval; none is stated of the whole picture."
            )
        }
        None => "No error of the picture is stated.".into(),
    }
}

/// The error of the integration.
fn traced_error(record: &FrameRecord) -> String {
    let Some(steps) = record.integration_steps else { return "FTLE traced with adaptive steps.".into() };
    let difference = match (record.integration_residual, record.integration_difference) {
        (Some(residual), _) => format!("; colours differ by {} % rms from those of many more", number(100.0 * residual)),
        (None, Some(difference)) => {
            format!("; the log-stretch (FTLE times tau) differs by {} rms from that of twice as many", number(difference))
        }
        (None, None) => String::new(),
    };
    format!("FTLE traced with {steps} steps{difference}.")
}
