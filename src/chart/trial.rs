//! A short trial of methods on a scene: the choice of `method = "auto"`.

use super::device_name;
use super::slides::FirstSlides;
use super::still::{colours_of, compile, noise_psnr, still};
use super::with_method;
use crate::backend::Device;
use crate::render::{Film, Method};
use crate::run::{RunError, RunOptions, Settings};
use serde::{Deserialize, Serialize};
use std::sync::atomic::{AtomicBool, Ordering};

/// Seconds of a trial, all methods together, preparation of the slide not counted.
pub const TRIAL_SECONDS: f64 = 4.0;
/// Samples a pixel of a frame.
const SAMPLES: f64 = 2.0;
/// PSNR over lit pixels, in decibels, to which the methods race.
const TARGET: f64 = 40.0;
/// Times that differ by less than this factor count as equal, since the times of a trial do.
const MARGIN: f64 = 1.1;

/// Result of a trial.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Choice {
    /// The method that reaches the target first; `two_level`, which goes on from there, if it takes at most 10 % longer.
    pub method: Method,
    /// Seconds since a slide to the target, by method; extrapolated for methods that did not reach it in the trial. `None` for methods that never
    /// reach it.
    pub seconds: Vec<(Method, Option<f64>)>,
    /// The target, in decibels over lit pixels.
    pub target: f64,
    /// Device on which the trial ran.
    pub device: String,
}

impl Choice {
    /// The times that decided.
    pub fn why(&self) -> String {
        let time = |seconds: &Option<f64>| {
            seconds.filter(|seconds| seconds.is_finite()).map_or("never".to_owned(), |seconds| format!("{seconds:.2} s"))
        };
        let times: Vec<String> = self.seconds.iter().map(|(method, seconds)| format!("{} {}", method.name(), time(seconds))).collect();
        format!("first to {} dB in a trial ({})", self.target, times.join(", "))
    }
}

impl std::fmt::Display for Choice {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "render.method = \"auto\": {}, {}", self.method.name(), self.why())
    }
}

/// Lets the methods race on the first slide. Setting `stop` ends the trial soon, with a choice from what was measured.
///
/// # Errors
/// The source cannot be opened, or the device fails.
pub fn choose(settings: &Settings, device: &Device, threads: usize, stop: &AtomicBool) -> Result<Choice, RunError> {
    race(settings, device, threads, stop, &FirstSlides::read(settings, 1, stop)?)
}

/// As [`choose`], with slides that were read before.
pub(super) fn race(
    settings: &Settings,
    device: &Device,
    threads: usize,
    stop: &AtomicBool,
    slides: &FirstSlides,
) -> Result<Choice, RunError> {
    const METHODS: [Method; 3] = [Method::TwoLevel, Method::Marched, Method::Reference];
    let mut settings = slides.settled(settings);
    settings.transfer = Some(colours_of(&settings, device, slides)?);
    let options = RunOptions { device: device.clone(), threads, ..RunOptions::default() };
    // Small frames, so that a method ends soon after the target.
    settings.render.samples = SAMPLES;
    let kind = settings.surrogate.kind;
    compile(&settings, &options, slides)?;
    let mut seconds = Vec::new();
    for method in METHODS {
        let scene = with_method(&settings, method, kind);
        let longest = TRIAL_SECONDS / METHODS.len() as f64;
        let (mut since, mut spent, mut reached) = (0.0, 0.0, Reached::default());
        still(scene, &options, (slides, 0), |frame| {
            let record = &frame.record;
            (since, spent) = (since + record.seconds.slide + record.seconds.total, spent + record.seconds.total);
            match record.picture_error {
                // A march does not improve, so that it must be sure to be there.
                Some(stated) if method == Method::Marched => reached.stated(since, record.seconds.total, stated.psnr.low),
                Some(stated) => reached.stated(since, record.seconds.total, stated.psnr.value),
                None => reached.independent(since, record.seconds.total, &frame.film, frame.tone_map),
            }
            reached.psnr < TARGET && (spent < longest || reached.frames < 2) && !stop.load(Ordering::Relaxed)
        })?;
        // The error of a marched picture is that of the surrogate, which samples do not lower.
        let never = method == Method::Marched && reached.psnr < TARGET;
        seconds.push((method, if never { None } else { reached.seconds_to(TARGET) }));
    }
    let best = seconds.iter().filter_map(|(_, seconds)| *seconds).fold(f64::INFINITY, f64::min);
    // The first in their order that is about as fast as the best.
    let as_fast = |(_, seconds): &&(Method, Option<f64>)| seconds.is_some_and(|seconds| seconds <= MARGIN * best);
    let method = seconds.iter().find(as_fast).map_or(Method::TwoLevel, |(method, _)| *method);
    Ok(Choice { method, seconds, target: TARGET, device: device_name(device) })
}

/// State of a racing method.
#[derive(Default)]
struct Reached {
    frames: u64,
    /// Seconds since the slide, of them the last frame's.
    seconds: f64,
    last: f64,
    psnr: f64,
    /// Sums of the odd and of the even frames of a method that states no error.
    halves: Option<[Film; 2]>,
}

impl Reached {
    fn stated(&mut self, seconds: f64, last: f64, psnr: f64) {
        (self.frames, self.seconds, self.last, self.psnr) = (self.frames + 1, seconds, last, psnr);
    }

    /// Frames with independent noise, which the two halves tell.
    fn independent(&mut self, seconds: f64, last: f64, film: &Film, tone_map: [f64; 3]) {
        (self.frames, self.seconds, self.last) = (self.frames + 1, seconds, last);
        let halves = self.halves.get_or_insert_with(|| [(); 2].map(|()| Film::new(film.width, film.height)));
        // All films of a trial have one size.
        let added = halves[self.frames as usize % 2].accumulate(film).is_ok();
        if added && self.frames.is_multiple_of(2) {
            let [a, b] = &*halves;
            self.psnr = noise_psnr(a, b, tone_map);
        }
    }

    /// Seconds to a PSNR: those taken, or extrapolated as if the squared error fell in proportion to the number of frames. `None` without a frame.
    fn seconds_to(&self, target: f64) -> Option<f64> {
        if self.frames == 0 {
            return None;
        }
        let more = self.frames as f64 * (10f64.powf((target - self.psnr) / 10.0) - 1.0).max(0.0);
        Some(self.seconds + more * self.last)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_are_extrapolated_as_noise_falls() {
        let mut reached = Reached::default();
        assert_eq!(reached.seconds_to(40.0), None, "without a frame");
        for _ in 0..4 {
            reached.stated(reached.seconds + 0.5, 0.5, 30.0);
        }
        assert!((reached.seconds_to(40.0).unwrap() - (2.0 + 36.0 * 0.5)).abs() < 1e-9, "ten times as many frames");
        assert_eq!(reached.seconds_to(30.0), Some(2.0), "those taken");
    }

    #[test]
    fn two_frames_tell_their_noise() {
        let film = |offset: f32| {
            let mut film = Film::new(64, 64);
            for (i, pixel) in film.rgba.iter_mut().enumerate() {
                // Opposite noise of size 0.01 around 0.4.
                let noise = if i % 2 == 0 { offset } else { -offset };
                *pixel = [0.4 + noise, 0.4 + noise, 0.4 + noise, 1.0];
            }
            // Films are weighted by their samples.
            film.samples.fill(1.0);
            film
        };
        let mut reached = Reached::default();
        let linear = [1.0, 0.5, 1.0];
        reached.independent(1.0, 1.0, &film(0.01), linear);
        reached.independent(2.0, 1.0, &film(-0.01), linear);
        // Their difference is 0.02; half of it is the noise of their mean: 40 dB.
        assert!((reached.psnr - 40.0).abs() < 0.01, "{}", reached.psnr);
    }
}
