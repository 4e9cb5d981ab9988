//! A short trial of methods on a scene: the choice of `method = "auto"`.

use super::Truth;
use super::picture::{fixed_colours, picture_errors, still, with_method};
use crate::backend::Device;
use crate::render::{Film, Method};
use crate::run::{RunError, RunOptions, Settings};
use crate::surrogate::Kind;
use serde::{Deserialize, Serialize};
use std::sync::atomic::{AtomicBool, Ordering};

/// Seconds of a trial, all methods together, preparation of the slide not counted.
pub const TRIAL_SECONDS: f64 = 4.0;
/// PSNR over lit pixels, in decibels, to which the methods race.
const TARGET: f64 = 40.0;

/// Result of a trial.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Choice {
    /// The method that reaches the target first.
    pub method: Method,
    /// Seconds since a slide to the target, by method; extrapolated for methods that did not reach it in the trial.
    pub seconds: Vec<(Method, f64)>,
    /// The target, in decibels over lit pixels.
    pub target: f64,
    /// Device on which the trial ran.
    pub device: String,
}

impl std::fmt::Display for Choice {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let times: Vec<String> = self.seconds.iter().map(|(method, seconds)| format!("{} {seconds:.2} s", method.name())).collect();
        write!(f, "render.method = \"auto\": {}, first to {} dB in a trial ({})", self.method.name(), self.target, times.join(", "))
    }
}

/// Lets the methods race on the first slide. Setting `stop` ends the trial soon, with a choice from what was measured.
///
/// # Errors
/// The source cannot be opened, or the device fails.
pub fn choose(settings: &Settings, device: &Device, threads: usize, stop: &AtomicBool) -> Result<Choice, RunError> {
    const METHODS: [Method; 2] = [Method::TwoLevel, Method::Reference];
    let mut settings = settings.clone();
    settings.transfer = Some(fixed_colours(&settings, device)?);
    let options = RunOptions { device: device.clone(), threads, ..RunOptions::default() };
    let target = match settings.render.until {
        Some(crate::render::Target::Psnr(decibels)) => decibels,
        _ => TARGET,
    };
    let (mut seconds, mut name) = (Vec::new(), String::new());
    for method in METHODS {
        let scene = with_method(&settings, method, Kind::Table);
        let longest = TRIAL_SECONDS / METHODS.len() as f64;
        let (mut since, mut spent, mut reached) = (0.0, 0.0, Reached::default());
        still(scene, &options, 0, |frame| {
            let record = &frame.record;
            (since, spent) = (since + record.seconds.slide + record.seconds.total, spent + record.seconds.total);
            name.clone_from(&record.device);
            match record.picture_error {
                Some(stated) => reached.stated(since, record.seconds.total, stated.psnr.value),
                None => reached.independent(since, record.seconds.total, &frame.film, frame.tone_map),
            }
            reached.psnr < target && (spent < longest || reached.frames < 2) && !stop.load(Ordering::Relaxed)
        })?;
        seconds.push((method, reached.seconds_to(target)));
    }
    let method = seconds.iter().min_by(|a, b| a.1.total_cmp(&b.1)).map_or(Method::TwoLevel, |(method, _)| *method);
    Ok(Choice { method, seconds, target, device: name })
}

/// State of a racing method.
#[derive(Default)]
struct Reached {
    frames: u64,
    /// Seconds since the slide, of them the last frame's.
    seconds: f64,
    last: f64,
    psnr: f64,
    /// The first frame of a method that states no error.
    first: Option<Film>,
}

impl Reached {
    fn stated(&mut self, seconds: f64, last: f64, psnr: f64) {
        (self.frames, self.seconds, self.last, self.psnr) = (self.frames + 1, seconds, last, psnr);
    }

    /// Frames with independent noise: half the squared difference of two is the error of one, and their mean has less in proportion to their number.
    fn independent(&mut self, seconds: f64, last: f64, film: &Film, tone_map: [f64; 3]) {
        (self.frames, self.seconds, self.last) = (self.frames + 1, seconds, last);
        let Some(first) = &self.first else {
            self.first = Some(film.clone());
            return;
        };
        if let Ok(other) = Truth::new([film.clone(), film.clone()]) {
            self.psnr = picture_errors(first, &other, tone_map).psnr + 10.0 * (2.0 * self.frames as f64).log10();
        }
    }

    /// Seconds to a PSNR: those taken, or extrapolated as if the squared error fell in proportion to the number of frames.
    fn seconds_to(&self, target: f64) -> f64 {
        if self.psnr >= target || self.frames == 0 {
            return if self.frames == 0 { f64::INFINITY } else { self.seconds };
        }
        let more = self.frames as f64 * (10f64.powf((target - self.psnr) / 10.0) - 1.0);
        self.seconds + more * self.last
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_are_extrapolated_as_noise_falls() {
        let mut reached = Reached::default();
        assert_eq!(reached.seconds_to(40.0), f64::INFINITY, "without a frame");
        for _ in 0..4 {
            reached.stated(reached.seconds + 0.5, 0.5, 30.0);
        }
        assert!((reached.seconds_to(40.0) - (2.0 + 36.0 * 0.5)).abs() < 1e-9, "ten times as many frames");
        assert_eq!(reached.seconds_to(30.0), 2.0, "those taken");
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
            film
        };
        let mut reached = Reached::default();
        let linear = [1.0, 0.5, 1.0];
        reached.independent(1.0, 1.0, &film(0.01), linear);
        reached.independent(2.0, 1.0, &film(-0.01), linear);
        // Their squared difference is 4e-4; one frame has half of it, the mean of two a quarter: 40 dB.
        assert!((reached.psnr - 40.0).abs() < 0.01, "{}", reached.psnr);
    }
}
