//! Time to error of pictures: the true error of each frame against the seconds since the window was new.

use super::ftle::Opened;
use super::slides::FirstSlides;
use super::still::{colours_of, compile, still};
use super::{Charting, map, with_method};
use crate::publish::compare_films;
use crate::render::smooth::{LIT, noise_psnr, squared_slope};
use crate::render::{Film, Method};
use crate::run::{Event, Frame, Race, RunError, RunOptions, Settings, run};
use crate::surrogate::Kind;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

/// PSNR over lit pixels, in decibels, to which the time is measured.
pub const TARGETS: [f64; 4] = [30.0, 35.0, 40.0, 45.0];
/// Shares of the panel's time for the truth: of the first window, and of the last one that slides.
const TRUTH_SHARES: [f64; 2] = [0.35, 0.1];
/// Decibels above the PSNR of the truth up to which that of a picture can be told, since the noise of the truth is taken off to first order only.
pub(super) const RESOLVED: f64 = 6.0;
/// PSNR beyond which a curve ends.
const ENOUGH: f64 = 47.0;
/// Longest curve, in seconds, on the CPU and on a GPU; twice that if a network learns on the way.
pub(super) const LONGEST: [f64; 2] = [20.0, 6.0];
/// Samples a pixel of a frame of the truth.
const TRUTH_SAMPLES: f64 = 16.0;
/// Slides of a sliding window; the first one is not counted.
pub(super) const SLIDES: usize = 3;

/// A frame of a curve.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub struct PicturePoint {
    /// Seconds since the slide: its preparation and all frames so far, training included.
    pub seconds: f64,
    /// Samples a pixel so far.
    pub samples: f64,
    /// True PSNR of the tone-mapped picture over lit pixels, in decibels; of a map that of its FTLE, with the range of its colours as peak.
    pub psnr: f64,
    /// The same over all pixels.
    pub psnr_all: f64,
    /// Mean of squared error / (radiance^2 + 0.01) over lit pixels, linear; of a map with the share of the range in place of the radiance.
    pub relmse: f64,
    /// Structural similarity of the tone-mapped luma with the mean of the truth's halves; of the frames that reach [`TARGETS`] and of the last one.
    pub ssim: Option<f64>,
    /// PSNR over lit pixels that the frame states; `None` if the method states none.
    pub stated_psnr: Option<f64>,
}

/// The frames of a method.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct PictureCurve {
    /// Method.
    pub method: String,
    /// Kind of its surrogate; `None` for `reference` and `map`.
    pub surrogate: Option<String>,
    /// Bytes of the surrogate.
    pub bytes: usize,
    /// Frames of a still window, in order of time.
    pub frames: Vec<PicturePoint>,
    /// Frames of a window that slides at every frame; `None` if it was not measured.
    pub sliding: Option<Sliding>,
}

/// A window that slides at every frame.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub struct Sliding {
    /// Frames per second, preparation included.
    pub frames_per_second: f64,
    /// True PSNR over lit pixels of the last frame, in decibels; `None` if the runs ended before it, or the source before its truth.
    pub psnr: Option<f64>,
}

impl PictureCurve {
    pub(super) fn new(method: Method, kind: Kind) -> Self {
        let surrogate = method.has_surrogate().then(|| kind.name().to_owned());
        Self { method: method.name().to_owned(), surrogate, bytes: 0, frames: Vec::new(), sliding: None }
    }

    /// Method and surrogate.
    pub fn name(&self) -> String {
        match &self.surrogate {
            Some(surrogate) => format!("{}, {surrogate}", self.method),
            None => self.method.clone(),
        }
    }

    /// The frame from which on the PSNR over lit pixels is at least `decibels`; `None` if the last one is below.
    pub(super) fn reaches(&self, decibels: f64) -> Option<&PicturePoint> {
        let below = self.frames.iter().rposition(|frame| frame.psnr < decibels);
        self.frames.get(below.map_or(0, |last| last + 1))
    }

    /// Its seconds.
    pub fn seconds_to(&self, decibels: f64) -> Option<f64> {
        self.reaches(decibels).map(|frame| frame.seconds)
    }
}

impl PicturePanel {
    /// The curve of a method with the scene's surrogate.
    pub(super) fn curve(&self, method: Method) -> Option<&PictureCurve> {
        let name = PictureCurve::new(method, self.kind).name();
        self.curves.iter().find(|curve| curve.name() == name)
    }

    /// The frame with which the method that wins the race reaches its target.
    pub(super) fn winner(&self) -> Option<&PicturePoint> {
        let race = self.race.as_ref()?;
        self.curve(race.method)?.reaches(race.target)
    }
}

/// Curves of all methods.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct PicturePanel {
    /// Width and height in pixels.
    pub size: [usize; 2],
    /// Samples a pixel of both halves of the first window's truth.
    pub truth_samples: f64,
    /// PSNR over lit pixels of the mean of the halves, whose noise is taken off from errors.
    #[serde(deserialize_with = "super::number_or_nan")]
    pub truth_psnr: f64,
    /// One curve per method and surrogate, of the volume view.
    pub curves: Vec<PictureCurve>,
    /// The curve of the flow's map, which is another picture, against its own truth; `None` in three dimensions, and if it was not measured.
    #[serde(default)]
    pub map: Option<PictureCurve>,
    /// As [`PicturePanel::truth_psnr`], of the map's truth; `None` without a map.
    #[serde(default)]
    pub map_truth_psnr: Option<f64>,
    /// Kind of the scene's surrogate.
    pub kind: Kind,
    /// The same race as that of `render.method = "auto"`, by the true errors of these curves; `None` if no method reached its target.
    pub race: Option<Race>,
    /// True if `render.method = "auto"` draws the scene as a map.
    #[serde(default)]
    pub auto_is_map: bool,
}

/// Two independent pictures of the same scene. Half of their difference is the noise of their mean, which is taken off from squared errors against it.
#[derive(Debug, Clone)]
pub struct Truth {
    /// The halves.
    pub halves: [Film; 2],
    /// Mean of both.
    pub mean: Film,
    /// Lower and upper end of a map's colours, 1/time; `None` of pictures of volumes.
    pub(super) range: Option<[f64; 2]>,
}

impl Truth {
    /// Takes two independent pictures of one size.
    ///
    /// # Errors
    /// The pictures differ in size.
    pub fn new(halves: [Film; 2]) -> Result<Self, RunError> {
        let mut mean = halves[0].clone();
        mean.accumulate(&halves[1])?;
        Ok(Self { halves, mean, range: None })
    }

    /// [`picture_errors`], or [`map::errors`] of maps.
    fn errors(&self, film: &Film, tone_map: [f64; 3]) -> PictureErrors {
        self.range.map_or_else(|| picture_errors(film, self, tone_map), |range| map::errors(film, &self.halves, range))
    }

    /// True if a pixel is lit: its opacity is above [`LIT`].
    pub fn is_lit(&self, pixel: usize) -> bool {
        self.halves[0].rgba[pixel][3] + self.halves[1].rgba[pixel][3] > 2.0 * LIT
    }

    /// [`most_wrong`] of the picture of a surrogate.
    pub fn most_wrong(&self, surrogate: &Film) -> Vec<usize> {
        most_wrong(&self.mean.luminances(), &surrogate.luminances())
    }
}

/// The twentieth of the pixels in which the luminance of a surrogate's picture is most wrong: thin ridges, which nodes smooth.
pub fn most_wrong(truth: &[f64], surrogate: &[f64]) -> Vec<usize> {
    let wrong: Vec<f64> = truth.iter().zip(surrogate).map(|(truth, surrogate)| (truth - surrogate).abs()).collect();
    let mut pixels: Vec<usize> = (0..wrong.len()).collect();
    pixels.sort_by(|&a, &b| wrong[b].total_cmp(&wrong[a]));
    pixels.truncate(wrong.len() / 20);
    pixels
}

/// Errors of a picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PictureErrors {
    /// Root mean square over lit pixels, linear radiance.
    pub rms: f64,
    /// As in [`PicturePoint`].
    pub psnr: f64,
    /// As in [`PicturePoint`].
    pub psnr_all: f64,
    /// As in [`PicturePoint`].
    pub relmse: f64,
}

/// Sums of [`picture_errors`] over pixels.
#[derive(Default, Clone, Copy)]
struct ErrorSums {
    linear: f64,
    relative: f64,
    /// Tone-mapped squared error and its noise, over lit pixels and over all.
    mapped: [[f64; 2]; 2],
    lit: f64,
}

impl std::ops::Add for ErrorSums {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        let mapped = std::array::from_fn(|which| std::array::from_fn(|k| self.mapped[which][k] + other.mapped[which][k]));
        Self { linear: self.linear + other.linear, relative: self.relative + other.relative, mapped, lit: self.lit + other.lit }
    }
}

/// Errors of a film against the truth; lit pixels have an opacity above [`LIT`] there. `tone_map` is `[contrast, brightness, gamma]`. A PSNR is told
/// up to 6 dB above that of the truth.
pub fn picture_errors(film: &Film, truth: &Truth, tone_map: [f64; 3]) -> PictureErrors {
    let [contrast, brightness, gamma] = tone_map;
    let tone = |c: f32| ((f64::from(c) - 0.5) * contrast + brightness).clamp(0.0, 1.0).powf(1.0 / gamma);
    let [a, b] = &truth.halves;
    let of_pixel = |i: usize| {
        let mut sums = ErrorSums::default();
        for k in 0..3 {
            let (c, a, b) = (film.rgba[i][k], a.rgba[i][k], b.rgba[i][k]);
            let mean = 0.5 * (a + b);
            let error = f64::from(c - a) * f64::from(c - b) / 3.0;
            // The tone map of a noisy picture is not that of its mean; the slope carries small noise through it.
            let noise = f64::from(squared_slope(tone_map, mean)) * f64::from(0.5 * (a - b)).powi(2) / 3.0;
            sums.linear += error;
            sums.relative += error / f64::from(mean * mean + 0.01);
            sums.mapped[1][0] += (tone(c) - tone(mean)).powi(2) / 3.0 - noise;
            sums.mapped[1][1] += noise;
        }
        if truth.is_lit(i) {
            ErrorSums { mapped: [sums.mapped[1]; 2], lit: 1.0, ..sums }
        } else {
            ErrorSums { mapped: [[0.0; 2], sums.mapped[1]], ..ErrorSums::default() }
        }
    };
    let sums = (0..film.rgba.len()).into_par_iter().with_min_len(1 << 12).map(of_pixel).reduce(ErrorSums::default, |a, b| a + b);
    PictureErrors {
        rms: (sums.linear / sums.lit).max(0.0).sqrt(),
        psnr: decibels(sums.mapped[0], sums.lit),
        psnr_all: decibels(sums.mapped[1], film.rgba.len() as f64),
        relmse: (sums.relative / sums.lit).max(0.0),
    }
}

/// PSNR of a sum of squared errors over `count` values, whose truth has this sum of squared noise: it may hide the error, or leave its square below zero.
pub(super) fn decibels([square, noise]: [f64; 2], count: f64) -> f64 {
    -10.0 * (square.max(10f64.powf(-0.1 * RESOLVED) * noise) / count).max(1e-12).log10()
}

/// What the pictures of a panel share.
pub(super) struct Windows<'a> {
    options: RunOptions,
    pub(super) slides: &'a FirstSlides,
    stop: &'a AtomicBool,
}

/// Renders the truth and the curves.
pub(super) fn panel(
    charting: &mut Charting<'_>,
    opened: &Opened,
    slides: &FirstSlides,
    auto_is_map: bool,
) -> Result<PicturePanel, RunError> {
    let options = RunOptions { device: charting.device.clone(), threads: charting.pool.current_num_threads(), ..RunOptions::default() };
    let windows = Windows { options, slides, stop: charting.stop };
    let found = if opened.plan.domain.dimensions == 2 { map::curve(charting, opened, &windows)? } else { None };
    let (map, map_truth_psnr) = found.unzip();
    Ok(PicturePanel { map, map_truth_psnr, auto_is_map, ..volumes(charting, &windows)? })
}

/// Two independent halves of a slide's picture, rendered for so many seconds in all, and the samples a pixel of both.
pub(super) fn truth(windows: &Windows<'_>, scene: &Settings, slide: usize, seconds: f64) -> Result<(Truth, f64), RunError> {
    let mut samples = 0.0;
    // Seeds of their own: the charted pictures must not share random numbers with the truth.
    let mut half = |seed: u64| {
        let mut scene = Settings { seed, ..scene.clone() };
        scene.render.samples = TRUTH_SAMPLES;
        // Opening the source does not count.
        let mut began = None;
        let mut sum = Film::new(scene.render.width, scene.render.height);
        let mut last = None;
        let accumulates = scene.render.method.accumulates();
        still(scene, &windows.options, (windows.slides, slide), |frame| {
            samples += TRUTH_SAMPLES;
            // Both films have the size of the scene.
            let whole = accumulates || sum.accumulate(&frame.film).is_ok();
            last = accumulates.then(|| frame.film.clone());
            whole && began.get_or_insert_with(Instant::now).elapsed().as_secs_f64() < 0.5 * seconds && !windows.stop.load(Ordering::Relaxed)
        })?;
        Ok::<_, RunError>(last.map_or(sum, |film| (*film).clone()))
    };
    let halves = [half(scene.seed ^ 0x5eed_0001)?, half(scene.seed ^ 0x5eed_0002)?];
    Ok((Truth::new(halves)?, samples))
}

/// The truth and the curves of the volume view.
fn volumes(charting: &mut Charting<'_>, windows: &Windows<'_>) -> Result<PicturePanel, RunError> {
    let slides = windows.slides;
    let mut settings = charting.settings.clone();
    settings.transfer = Some(colours_of(&settings, Method::Reference, charting.device, slides)?);
    let size = [settings.render.width, settings.render.height];
    let left = charting.left();
    let true_picture = |slide: usize, share: f64| {
        (charting.tell)("the true picture: two halves of reference");
        truth(windows, &with_method(&settings, Method::Reference, Kind::Table), slide, share * left)
    };
    let (truth, samples) = true_picture(0, TRUTH_SHARES[0])?;
    if !truth.mean.rgba.iter().any(|pixel| pixel[3] > LIT) {
        charting.skip("pictures", "nothing of the flow is shown: the transfer function is 0 everywhere (transfer.low, transfer.high)");
        return Ok(PicturePanel {
            size,
            truth_samples: samples,
            truth_psnr: f64::INFINITY,
            curves: Vec::new(),
            map: None,
            map_truth_psnr: None,
            kind: settings.surrogate.kind,
            race: None,
            auto_is_map: false,
        });
    }
    let last_truth = if slides.count() < SLIDES {
        charting.skip("a sliding window", format_args!("it takes {SLIDES} slides, {} could be read: {}", slides.count(), slides.end()));
        None
    } else {
        match true_picture(SLIDES - 1, TRUTH_SHARES[1]) {
            Ok((truth, _)) => Some(truth),
            Err(error) => {
                charting.refused("the truth of a window that slides", error)?;
                None
            }
        }
    };
    let [a, b] = &truth.halves;
    let truth_psnr = noise_psnr(a, b, settings.render.tone_map);
    let mut curves = Vec::new();
    let candidates = [
        (Method::TwoLevel, Kind::Table),
        (Method::Reference, Kind::Table),
        (Method::Marched, Kind::Table),
        (Method::TwoLevel, Kind::Residual),
        (Method::Gated, Kind::Table),
        (Method::Gated, Kind::Residual),
        (Method::Marched, Kind::Network),
        (Method::TwoLevel, Kind::Network),
        (Method::Gated, Kind::Network),
    ];
    if let Err(error) = compile(&settings, &windows.options, slides) {
        charting.refused("a first frame, which compiles kernels", error)?;
    }
    for (number, (method, kind)) in candidates.into_iter().enumerate() {
        let mut curve = PictureCurve::new(method, kind);
        if !charting.has_time_for(&format!("pictures by {}", curve.name())) {
            continue;
        }
        let most = LONGEST[usize::from(charting.device.is_gpu())] * if kind == Kind::Network { 2.0 } else { 1.0 };
        let longest = (charting.left() / (candidates.len() - number) as f64).min(most);
        let scene = with_method(&settings, method, kind);
        match measure(windows, &scene, &truth, 0.8 * longest, &mut curve.frames) {
            Ok(bytes) => curve.bytes = bytes,
            Err(error) => {
                charting.refused(format_args!("pictures by {}", curve.name()), error)?;
                continue;
            }
        }
        if slides.count() >= SLIDES {
            match sliding(windows, &scene, last_truth.as_ref(), 0.2 * longest) {
                Ok(found) => curve.sliding = found,
                Err(error) => charting.refused(format_args!("a sliding window by {}", curve.name()), error)?,
            }
        }
        curves.push(curve);
    }
    let kind = settings.surrogate.kind;
    let mut panel = PicturePanel {
        size,
        truth_samples: samples,
        truth_psnr,
        curves,
        map: None,
        map_truth_psnr: None,
        kind,
        race: None,
        auto_is_map: false,
    };
    panel.race = Race::of_times(|method, target| {
        let curve = panel.curve(method)?;
        match method {
            // The curve is of sums of frames, which a run does not draw.
            Method::Reference => curve.frames.first().filter(|frame| frame.psnr >= target).map(|frame| frame.seconds),
            _ => curve.seconds_to(target),
        }
    });
    Ok(panel)
}

/// Frames of a still window for some seconds; returns the bytes of the surrogate.
pub(super) fn measure(
    windows: &Windows<'_>,
    scene: &Settings,
    truth: &Truth,
    longest: f64,
    frames: &mut Vec<PicturePoint>,
) -> Result<usize, RunError> {
    let mut sum = Film::new(scene.render.width, scene.render.height);
    let (mut seconds, mut last, mut before) = (0.0, None, f64::NEG_INFINITY);
    let ssim = |film: &Film, tone_map| compare_films(film, &truth.mean, tone_map).ok().and_then(|compared| compared.ssim);
    let bytes = still(scene.clone(), &windows.options, (windows.slides, 0), |frame| {
        let record = &frame.record;
        seconds += record.seconds.slide + record.seconds.total;
        // Films of the other methods have their own samples only.
        let accumulated = scene.render.method.accumulates() || sum.accumulate(&frame.film).is_err();
        let film = if accumulated { &*frame.film } else { &sum };
        let errors = truth.errors(film, frame.tone_map);
        let reaches = TARGETS.iter().any(|target| before < *target && *target <= errors.psnr);
        before = errors.psnr;
        let own = record.samples_per_pixel * (record.frame + 1) as f64;
        frames.push(PicturePoint {
            seconds,
            samples: record.picture_error.map_or(own, |stated| stated.samples_per_pixel),
            psnr: errors.psnr,
            psnr_all: errors.psnr_all,
            relmse: errors.relmse,
            ssim: reaches.then(|| ssim(film, frame.tone_map)).flatten(),
            stated_psnr: record.picture_error.map(|stated| stated.psnr.value),
        });
        last = Some((frame.film.clone(), frame.tone_map));
        errors.psnr < ENOUGH && seconds < longest && !windows.stop.load(Ordering::Relaxed)
    })?;
    if let (Some((film, tone_map)), Some(point)) = (last, frames.last_mut()) {
        let film = if scene.render.method.accumulates() { &*film } else { &sum };
        point.ssim = ssim(film, tone_map);
    }
    Ok(bytes)
}

/// A window that slides at every frame; `None` if a frame took too long.
pub(super) fn sliding(windows: &Windows<'_>, scene: &Settings, truth: Option<&Truth>, longest: f64) -> Result<Option<Sliding>, RunError> {
    let mut scene = scene.clone();
    (scene.time.frames_per_slide, scene.time.warmup_frames) = (1, 0);
    let (mut seconds, mut frames, mut psnr) = (0.0, 0, None);
    let enough = AtomicBool::new(false);
    let mut sink = |event: Event| {
        if let Event::Frame(Frame { record, film, tone_map, .. }) = event
            && record.slide > 0
        {
            seconds += record.seconds.slide + record.seconds.total;
            frames += 1;
            if record.slide + 1 == SLIDES as u64 {
                psnr = truth.map(|truth| truth.errors(&film, tone_map).psnr).filter(|psnr| psnr.is_finite());
            }
            enough.store(seconds > longest || windows.stop.load(Ordering::Relaxed), Ordering::Relaxed);
        }
    };
    run(windows.slides.setup(scene, 0)?, &windows.options, &mut sink, &enough)?;
    Ok((frames > 0).then(|| Sliding { frames_per_second: f64::from(frames) / seconds, psnr }))
}
