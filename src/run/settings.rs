//! Settings of a run: `[time]`, `[training]`, and those of all rooms that the cycle calls.

use crate::flow::{Direction, FlowSettings};
use crate::render::{Camera, CameraSettings, Light, LightSettings, MAX_SAMPLES, RenderSettings, Transfer, TransferSettings};
use crate::setting::{Refused, count, require};
use crate::source::live::LiveSettings;
use crate::source::{ArchiveSettings, DomainSettings, SourceKind, SourceSettings};
use crate::surrogate::{
    SurrogateSettings,
    network::{NetworkSettings, Size},
};
use crate::trust::TrustSettings;
use serde::{Deserialize, Serialize};

/// Settings that determine the results of a run.
#[derive(Debug, Clone, PartialEq)]
pub struct Settings {
    /// Title for people.
    pub title: String,
    /// Seed of every random number.
    pub seed: u64,
    /// Source of the velocity.
    pub source: SourceSettings,
    /// Files, variables and metric of archives.
    pub archive: ArchiveSettings,
    /// The running simulation.
    pub live: LiveSettings,
    /// Box of the seeds; required by closed forms.
    pub domain: Option<DomainSettings>,
    /// Integration time, direction and the slides of the window.
    pub time: TimeSettings,
    /// Integration.
    pub flow: FlowSettings,
    /// Kind of surrogate.
    pub surrogate: SurrogateSettings,
    /// Network of the surrogate.
    pub network: NetworkSettings,
    /// Amount of training a frame.
    pub training: TrainingSettings,
    /// Error up to which the surrogate answers.
    pub trust: TrustSettings,
    /// Picture.
    pub render: RenderSettings,
    /// View; `None`: an overview of the domain.
    pub camera: Option<CameraSettings>,
    /// Light; `None`: from above, over the shoulder.
    pub light: Option<LightSettings>,
    /// Extinction and albedo; `None`: scaled to the FTLE of the first slide.
    pub transfer: Option<TransferSettings>,
    /// Maps of the slides.
    pub maps: MapSettings,
}

impl Settings {
    /// Checks everything that does not need the open source.
    ///
    /// # Errors
    /// The first setting that is not accepted.
    pub fn check(&self) -> Result<(), Refused> {
        let kind = self.source.kind;
        self.source.check(self.domain.as_ref(), &self.archive)?;
        self.time.check(kind)?;
        self.live.check()?;
        self.flow.check(matches!(kind, SourceKind::Archive | SourceKind::Turbulence | SourceKind::Live))?;
        self.surrogate.check(&self.network)?;
        self.network.validate()?;
        self.training.check()?;
        if self.network.size == Size::Auto && self.training.resume.is_some() {
            let accepted = "\"fixed\", with training.resume (or --resume): a checkpoint has one size";
            return Err(Refused::new("network.size", "is \"auto\"", accepted));
        }
        self.trust.check()?;
        self.render.check()?;
        if let Some(camera) = &self.camera {
            Camera::new(camera, self.render.aspect())?;
        }
        if let Some(light) = &self.light {
            Light::new(light)?;
        }
        if let Some(transfer) = &self.transfer {
            // Values that are not set, and the unit of extinction, are chosen later and are always accepted.
            Transfer::new(&with_ends(transfer), 1.0)?;
        }
        self.maps.check()
    }
}

/// The settings with ends that suit those that are given, for checks before the FTLE is known, to which open ends are scaled later.
pub(super) fn with_ends(transfer: &TransferSettings) -> TransferSettings {
    let (low, high) = (transfer.low, transfer.high);
    TransferSettings {
        low: low.or(high.map(|high| high - high.abs().max(1.0))),
        high: high.or(low.map(|low| low + low.abs().max(1.0))),
        ..transfer.clone()
    }
    .scaled_to(&[0.0, 1.0])
}

/// A number in the source's time unit, or words such as `"30 days"` if that unit is the second.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(untagged, expecting = "a number, or words such as \"30 days\"")]
pub enum TimeSpan {
    /// In time units of the source.
    Number(f64),
    /// With a unit.
    Words(String),
}

impl TimeSpan {
    /// Returns the seconds of a span with a unit, or the plain number. `None` if the words are not a span.
    pub fn value(&self) -> Option<f64> {
        let words = match self {
            TimeSpan::Number(n) => return Some(*n),
            TimeSpan::Words(words) => words.trim(),
        };
        let split = words.find(|c: char| c.is_ascii_alphabetic() && c != 'e' && c != 'E')?;
        let (number, unit) = words.split_at(split);
        let factor = match unit.trim().trim_end_matches('s') {
            "" | "sec" | "second" => 1.0,
            "min" | "minute" => 60.0,
            "h" | "hr" | "hour" => 3600.0,
            "d" | "day" => 86_400.0,
            "week" => 604_800.0,
            _ => return None,
        };
        number.trim().parse::<f64>().ok().map(|n| n * factor)
    }

    /// True if the span has a unit.
    pub fn has_unit(&self) -> bool {
        matches!(self, TimeSpan::Words(_))
    }
}

/// `[time]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TimeSettings {
    /// |tau|; `None`: chosen from the stretching of an archive's flow, at most half of its span or two intervals. Required by other sources.
    pub tau: Option<TimeSpan>,
    /// Direction; `None`: backward for archives and live runs, forward otherwise.
    pub direction: Option<Direction>,
    /// Closed forms: seed time of the first slide.
    pub start: f64,
    /// Closed forms: step of the seed time from slide to slide.
    pub seed_step: f64,
    /// Maximum number of slides; `None`: 1 for closed forms, all for snapshots.
    pub slides: Option<usize>,
    /// Every how many snapshots one is read, from the first one on; beside a simulation, every how many complete steps one is taken. Whatever counts
    /// snapshots counts those that are read.
    pub every: usize,
    /// Number of snapshots by which the window moves from slide to slide.
    pub snapshots_per_slide: usize,
    /// Frames rendered at each slide.
    pub frames_per_slide: usize,
    /// Further frames at the first slide, which train the surrogate.
    pub warmup_frames: usize,
    /// Samples a pixel of warm-up frames; `None`: as for other frames.
    pub warmup_samples: Option<usize>,
}

impl Default for TimeSettings {
    fn default() -> Self {
        Self {
            tau: None,
            direction: None,
            start: 0.0,
            seed_step: 1.0,
            slides: None,
            every: 1,
            snapshots_per_slide: 1,
            frames_per_slide: 1,
            warmup_frames: 0,
            warmup_samples: None,
        }
    }
}

impl TimeSettings {
    /// Checks ranges. Closed forms require tau as a plain number.
    ///
    /// # Errors
    /// The first setting that is not accepted.
    pub fn check(&self, kind: SourceKind) -> Result<(), Refused> {
        let time = self;
        let refuse = |key: &str, found: &str, accepted: &str| Err(Refused::new(key, found, accepted));
        match &time.tau {
            Some(tau) => {
                let accepted = "a number above 0 in the source's time unit, or words such as \"30 days\", \"36 h\", \"90 min\"";
                require(tau.value().is_some_and(|v| v.is_finite() && v > 0.0), "time.tau", tau, accepted)?;
                if tau.has_unit() && !matches!(kind, SourceKind::Archive | SourceKind::Live) {
                    refuse("time.tau", "has a unit", "a plain number: the time of a closed form has no unit")?;
                }
            }
            None if kind == SourceKind::Live => {
                refuse("time.tau", "is missing", "a duration in the simulation's time (attach --tau TIME)")?
            }
            None if kind != SourceKind::Archive => refuse("time.tau", "is missing", "a number above 0")?,
            None => {}
        }
        require(time.start.is_finite(), "time.start", time.start, "a finite number")?;
        require(time.seed_step.is_finite(), "time.seed_step", time.seed_step, "a finite number")?;
        if time.seed_step == 0.0 && time.slides.is_some_and(|slides| slides > 1) {
            let refused = Refused::new("time.seed_step", "is 0", "a number other than 0: otherwise all slides have one time");
            return Err(refused.beside(&["time.slides"]));
        }
        if let Some(slides) = time.slides {
            count("time.slides", slides, 1, 10_000_000)?;
        }
        count("time.every", time.every, 1, 1_000_000)?;
        count("time.snapshots_per_slide", time.snapshots_per_slide, 1, 1_000_000)?;
        count("time.frames_per_slide", time.frames_per_slide, 1, 1_000_000)?;
        count("time.warmup_frames", time.warmup_frames, 0, 1_000_000)?;
        count("time.warmup_samples", time.warmup_samples.unwrap_or(1), 1, MAX_SAMPLES)
    }
}

/// `[training]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TrainingSettings {
    /// On the CPU, share of the threads that train while the others render (at least one thread each; a single thread alternates). On a GPU,
    /// share of the device's time until the loss has stalled.
    pub share: f64,
    /// Seconds of training a frame: a minimum, for which the next frame waits, and the maximum while waiting for a simulation. `None`: 1 on the
    /// CPU until the loss has stalled, given by `share` on a GPU.
    pub seconds_per_frame: Option<f64>,
    /// Exact number of optimizer steps a frame instead, for reproducible runs.
    pub steps_per_frame: Option<u64>,
    /// Capacity of the replay buffer, in samples.
    pub replay_buffer: usize,
    /// Checkpoint to start from.
    pub resume: Option<std::path::PathBuf>,
}

impl Default for TrainingSettings {
    fn default() -> Self {
        Self { share: 0.5, seconds_per_frame: None, steps_per_frame: None, replay_buffer: 1 << 22, resume: None }
    }
}

impl TrainingSettings {
    /// Minimum seconds of training a frame on the CPU. `need`: factor on what is not given.
    pub fn seconds(&self, need: f64) -> f64 {
        self.seconds_per_frame.unwrap_or(need)
    }

    /// Seconds of training after `picture` seconds of rendering on a device that does both, so that training takes `share` of its time if
    /// `need`, a factor on it, is 1.
    pub fn turn(&self, picture: f64, need: f64) -> f64 {
        (need * self.share / (1.0 - self.share) * picture).max(self.seconds_per_frame.unwrap_or(0.0))
    }

    /// True if the time of training does not depend on how much is needed.
    pub fn is_constant(&self, on_device: bool) -> bool {
        self.steps_per_frame.is_some() || !on_device && self.seconds_per_frame.is_some()
    }

    /// Checks ranges.
    ///
    /// # Errors
    /// The first value out of its range.
    pub fn check(&self) -> Result<(), Refused> {
        let t = self;
        require((0.0..1.0).contains(&t.share), "training.share", t.share, "a number from 0 up to, not including, 1")?;
        if let Some(seconds) = t.seconds_per_frame {
            require((0.0..=86_400.0).contains(&seconds), "training.seconds_per_frame", seconds, "0 to 86400 (a day)")?;
        }
        if let Some(steps) = t.steps_per_frame {
            require((1..=100_000_000).contains(&steps), "training.steps_per_frame", steps, "a whole number from 1 to 100000000")?;
        }
        count("training.replay_buffer", t.replay_buffer, 1024, 1 << 28)
    }
}

/// `[maps]`: what the maps of the slides show over their colours, as options of these names of the command `map`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MapSettings {
    /// Ridge lines of the FTLE.
    pub ridges: bool,
    /// Arrows of the velocity at the seed time.
    pub arrows: bool,
    /// Values that get a line, in the unit of the map.
    pub contour: Vec<f64>,
    /// Forward FTLE in red and backward FTLE in blue. Maps of snapshots then begin when twice tau of them are known, and show the time in their middle.
    pub both: bool,
}

impl MapSettings {
    /// Most values that get a line.
    const MOST_CONTOURS: usize = 64;

    /// Checks ranges.
    ///
    /// # Errors
    /// The values of the lines are too many, or one is not finite.
    pub fn check(&self) -> Result<(), Refused> {
        let values = &self.contour;
        let is_accepted = values.len() <= Self::MOST_CONTOURS && values.iter().all(|value| value.is_finite());
        require(is_accepted, "maps.contour", values, "a list of at most 64 finite numbers, in the unit of the map")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_turn_of_training_is_its_share_of_the_device_s_time() {
        let with = |share, seconds_per_frame| TrainingSettings { share, seconds_per_frame, ..TrainingSettings::default() };
        for share in [0.0, 0.25, 0.5, 0.9] {
            let turn = with(share, None).turn(0.03, 1.0);
            assert!((turn / (turn + 0.03) - share).abs() < 1e-12, "{share}: {turn}");
        }
        assert_eq!((with(0.5, Some(2.0)).turn(0.03, 1.0), with(0.5, Some(0.0)).turn(0.03, 1.0)), (2.0, 0.03), "seconds are the least");
        assert_eq!((with(0.5, None).seconds(1.0), with(0.5, Some(0.2)).seconds(1.0)), (1.0, 0.2));
    }

    #[test]
    fn need_is_a_factor_on_what_is_not_given() {
        let with = |seconds_per_frame| TrainingSettings { seconds_per_frame, ..TrainingSettings::default() };
        assert_eq!((with(None).seconds(0.25), with(Some(0.2)).seconds(0.25)), (0.25, 0.2));
        assert_eq!((with(None).turn(0.04, 0.25), with(Some(0.2)).turn(0.04, 0.25)), (0.01, 0.2));
        let steps = TrainingSettings { steps_per_frame: Some(9), ..TrainingSettings::default() };
        assert_eq!(
            [with(None), with(Some(0.2)), steps].map(|t| [true, false].map(|on_device| t.is_constant(on_device))),
            [[false, false], [false, true], [true, true]]
        );
    }

    #[test]
    fn spans_have_units() {
        let words = |s: &str| TimeSpan::Words(s.to_owned()).value();
        assert_eq!(words("30 days"), Some(30.0 * 86_400.0));
        assert_eq!(words("1.5h"), Some(5400.0));
        assert_eq!(words("3 fortnights"), None);
        assert_eq!(words("days"), None);
    }
}
