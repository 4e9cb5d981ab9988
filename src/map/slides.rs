//! Maps of the slides of a run.

use super::draw::write_png;
use super::footprint::Sampling;
use super::make::{MapOptions, make};
use super::moment::seed_of_both;
use super::ridges::Strength;
use super::sheet::plot_error;
use super::view::LARGEST;
use super::{MapError, Moment};
use crate::backend::Device;
use crate::field::{Snapshot, Window};
use crate::flow::{Direction, FlowMap, VelocitySource};
use crate::progress::Work;
use crate::publish::SlideMap;
use crate::run::{Plan, ShownSlide, Slide};
use crate::source::live::{Follow, NextWindow};
use std::collections::HashSet;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

/// Seeds per pixel: as many in all as a table with two nodes a pixel has along each axis, which every slide of a smooth picture traces as well.
const SEEDS: usize = 4;
/// Share of the time that maps beside a simulation may take while the next window is complete.
const SHARE: f64 = 0.1;

/// Draws the slides of a run.
pub struct SlideMaps {
    plan: Plan,
    device: Device,
    /// Range of the colours, of the first slide since tau or direction was steered, so that maps of a run compare.
    range: Option<(f64, Direction, [f64; 2])>,
    /// Remarks made so far, without their numbers, which differ from slide to slide.
    told: HashSet<String>,
    /// The snapshots over twice tau so far, if maps show both directions.
    past: Window,
    /// Dates of the slides that these snapshots cover.
    dates: Vec<(f64, Option<String>)>,
    /// True from windows that have no snapshot in common on, until twice tau is known again.
    is_apart: bool,
    pace: Pace,
}

/// What came of the map of a slide.
pub enum Drawn {
    /// The map.
    Map(SlideMap),
    /// The next window of a simulation was complete, and the map would have taken too long.
    TooSlow,
    /// Both directions are to be shown, and less than twice tau is known yet.
    TooEarly,
    /// The same after windows that have no snapshot in common.
    Apart,
}

impl SlideMaps {
    /// Maps of a run; `None` for a flow in three dimensions, which has no map without a level.
    pub fn new(plan: &Plan, device: &Device) -> Option<Self> {
        let live = &plan.scene.live;
        (plan.domain.dimensions == 2).then(|| Self {
            plan: plan.clone(),
            device: device.clone(),
            range: None,
            told: HashSet::new(),
            past: Window::new(2.0 * plan.map.tau),
            dates: Vec::new(),
            is_apart: false,
            // A simulation may wait until each of its steps is in a slide.
            pace: Pace::new(if live.follow == Follow::Every { 0.0 } else { SHARE }),
        })
    }

    /// The map of a slide, with as many pixels along its longer edge as the frames have (16 to 4096), and remarks for the user that were not made before.
    /// Beside a simulation it is given up once the next window is complete, unless maps take at most a tenth of the time.
    ///
    /// # Errors
    /// No map shows the domain, no pixel has a velocity, or the device fails; [`MapError::Stopped`] soon after `stop` is set.
    pub fn draw(&mut self, shown: ShownSlide, stop: &AtomicBool) -> Result<(Drawn, Vec<String>), MapError> {
        let ShownSlide { slide, map, next, .. } = shown;
        let (index, tau, direction) = (slide.index, map.tau, map.direction);
        let Some(moment) = self.moment(slide, map) else {
            let (drawn, text) = match self.is_apart {
                false => (Drawn::TooEarly, "maps of both directions begin when twice tau of snapshots are known"),
                true => (
                    Drawn::Apart,
                    "windows of two slides have no snapshot in common: maps of both directions wait until twice tau is known again (maps_dropped)",
                ),
            };
            return Ok((drawn, self.untold([text.to_owned()])));
        };
        let (scene, shown) = (&self.plan.scene, &self.plan.scene.maps);
        let options = MapOptions {
            pixels: scene.render.width.max(scene.render.height).clamp(16, LARGEST),
            sampling: Sampling { seeds: SEEDS, seed: scene.seed },
            projection: scene.render.projection.kind(),
            level: None,
            both: shown.both,
            range: self.range.filter(|of| (of.0, of.1) == (tau, direction)).map(|(_, _, range)| range),
            contours: shown.contour.clone(),
            arrows: shown.arrows,
            ridges: shown.ridges.then_some(Strength::LINES),
            ridge_grid: None,
        };
        let mut attempt = Attempt::begin(next);
        let mut work = Some(Work::begin("drawing the map of the slide"));
        let mut goes_on = |done: u64, all: u64| {
            // What comes after the seeds tells of itself.
            work = work.take().filter(|_| done < all);
            work.iter().for_each(|work| work.reached_share(done as f64 / all as f64));
            !stop.load(Ordering::Relaxed) && attempt.may_go_on(&self.pace)
        };
        let made = if goes_on(0, 1) { make(&moment, &options, &self.device, &mut goes_on) } else { Err(MapError::Stopped) };
        let made = match made {
            Err(MapError::Stopped) if !stop.load(Ordering::Relaxed) => {
                self.pace.ended(&attempt, false);
                let text =
                    "slides are left without a map: the next window was complete before theirs was drawn (maps_dropped in the summary)";
                return Ok((Drawn::TooSlow, self.untold([text.to_owned()])));
            }
            made => made?,
        };
        self.range = Some((tau, direction, made.record.range));
        let record = serde_json::to_vec_pretty(&made.record).map_err(plot_error)?;
        let map = SlideMap { slide: index, png: write_png(&made.figure)?, record };
        self.pace.ended(&attempt, true);
        Ok((Drawn::Map(map), self.untold(made.notes)))
    }

    /// The remarks that were not made before.
    fn untold(&mut self, notes: impl IntoIterator<Item = String>) -> Vec<String> {
        let kind = |note: &String| note.replace(|letter: char| letter.is_ascii_digit(), "");
        notes.into_iter().filter(|note| self.told.insert(kind(note))).collect()
    }

    /// What the map of a slide shows; `None` as long as both directions are to be shown and less than twice tau is known.
    fn moment(&mut self, slide: Slide, map: FlowMap) -> Option<Moment> {
        let (tau, plan) = (map.tau, Plan { map, ..self.plan.clone() });
        let Slide { mut velocity, mut time, mut date, .. } = slide;
        if let (true, VelocitySource::Window(window)) = (self.plan.scene.maps.both, &velocity) {
            let before = self.past.oldest();
            self.past = joined(&self.past, window, 2.0 * tau);
            self.is_apart |= before.is_some() && self.past.oldest() == window.oldest();
            self.dates.push((time, date));
            let oldest = self.past.oldest()?;
            self.dates.retain(|(time, _)| *time >= oldest);
            if !self.past.is_full() {
                return None;
            }
            self.is_apart = false;
            time = seed_of_both(&self.past, tau)?;
            let of_slide = self.dates.iter().find(|(known, _)| *known == time).and_then(|(_, date)| date.clone());
            date = of_slide.or_else(|| plan.georeference.date(time));
            velocity = VelocitySource::Window(Arc::new(self.past.clone()));
        }
        Some(Moment { plan, velocity, time, date, taus: vec![tau], notes: Vec::new() })
    }
}

/// The snapshots of a window and those before it, over `span`. Without a snapshot in common, after a gap or if the simulation was set back, those of
/// the window alone.
fn joined(past: &Window, window: &Window, span: f64) -> Window {
    let mut all = Window::new(span);
    let is_first = |snapshot: &&Arc<Snapshot>| window.snapshots().next().is_some_and(|first| Arc::ptr_eq(first, snapshot));
    let before = past.snapshots().position(|snapshot| is_first(&snapshot)).unwrap_or(0);
    for snapshot in past.snapshots().take(before).chain(window.snapshots()) {
        // In order of time and of one grid, as in their windows.
        let _ = all.push(Arc::clone(snapshot));
    }
    all
}

/// How long maps may take beside a simulation.
struct Pace {
    /// Share of the time that they may take while the next window is complete.
    share: f64,
    /// End of the last whole map, or begin of the run.
    since: Instant,
    /// Seconds that maps have taken since then while the next window was complete.
    taken: f64,
    /// Seconds that a map takes, or twice those after which one was given up.
    cost: f64,
}

/// A map in progress.
struct Attempt {
    /// `None` for sources that are no simulation.
    next: Option<NextWindow>,
    begin: Instant,
    /// Seconds for which the next window was awaited; `None` if it still is.
    awaited: Option<f64>,
}

impl Attempt {
    fn begin(next: Option<NextWindow>) -> Self {
        Self { next, begin: Instant::now(), awaited: None }
    }

    /// Seconds so far, and those of them for which the next window was awaited.
    fn seconds(&self) -> [f64; 2] {
        let seconds = self.begin.elapsed().as_secs_f64();
        [seconds, self.awaited.unwrap_or(seconds)]
    }

    fn may_go_on(&mut self, pace: &Pace) -> bool {
        let seconds = self.begin.elapsed().as_secs_f64();
        if self.awaited.is_none() && self.next.as_ref().is_some_and(NextWindow::is_complete) {
            self.awaited = Some(seconds);
        }
        self.awaited.is_none_or(|awaited| pace.allows(pace.since.elapsed().as_secs_f64(), seconds, awaited))
    }
}

impl Pace {
    fn new(share: f64) -> Self {
        Self { share, since: Instant::now(), taken: 0.0, cost: 0.0 }
    }

    /// Whether a map may go on after so many seconds, for some of which the next window was `awaited`, if it is `now` seconds since the last whole map.
    fn allows(&self, now: f64, seconds: f64, awaited: f64) -> bool {
        self.cost.max(seconds) - awaited < self.share * now - self.taken
    }

    fn ended(&mut self, attempt: &Attempt, is_whole: bool) {
        let [seconds, awaited] = attempt.seconds();
        if is_whole {
            *self = Self { cost: seconds, ..Self::new(self.share) };
        } else {
            self.taken += seconds - awaited;
            self.cost = self.cost.max(2.0 * seconds);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::{Axis, Geometry, Grid, analytic::Analytic};

    /// Snapshots of a run, one at each whole time.
    fn snapshots() -> Vec<Arc<Snapshot>> {
        let axes = ["x", "y"].map(|name| Axis::uniform(name, "1", 0.0, 1.0, 2).unwrap());
        let grid = Arc::new(Grid { axes: axes.to_vec(), geometry: Geometry::Cartesian, slab: (0.0, 1.0) });
        (0..12).map(|time| Arc::new(Analytic::Saddle { rate: 1.0 }.snapshot(f64::from(time), &grid))).collect()
    }

    fn window(of: &[Arc<Snapshot>]) -> Window {
        let mut window = Window::new(2.0);
        for snapshot in of {
            window.push(snapshot.clone()).unwrap();
        }
        window
    }

    #[test]
    fn windows_join_to_one_over_twice_tau_but_not_over_a_gap() {
        let times = |window: &Window| window.snapshots().map(|snapshot| snapshot.time).collect::<Vec<_>>();
        let run = snapshots();
        let mut past = joined(&Window::new(4.0), &window(&run[..3]), 4.0);
        assert!(times(&past) == [0.0, 1.0, 2.0] && !past.is_full());
        for newest in 3..=6 {
            past = joined(&past, &window(&run[newest - 2..=newest]), 4.0);
        }
        assert!(times(&past) == [2.0, 3.0, 4.0, 5.0, 6.0] && past.is_full());
        assert_eq!(seed_of_both(&past, 2.0), Some(4.0));
        let apart = joined(&past, &window(&run[8..=10]), 4.0);
        assert_eq!(times(&apart), [8.0, 9.0, 10.0], "nothing is known between 6 and 8");
        let again = snapshots();
        let back = joined(&past, &window(&again[4..=6]), 4.0);
        assert_eq!(times(&back), [4.0, 5.0, 6.0], "a simulation that was set back goes another way than before");
    }

    #[test]
    fn a_map_may_take_a_tenth_of_the_time_beside_a_complete_window() {
        let pace = Pace { share: 0.1, since: Instant::now(), taken: 1.0, cost: 4.0 };
        // Of 50 seconds 5 are a tenth, of which 1 was taken.
        assert!(!pace.allows(49.0, 0.0, 0.0) && pace.allows(51.0, 0.0, 0.0), "as long as a map takes");
        assert!(!pace.allows(51.0, 4.2, 0.0), "this one takes longer");
        assert!(pace.allows(20.0, 3.5, 3.5) && !pace.allows(14.0, 3.5, 3.5), "half a second is left, if it takes as long as the last one");
        let unknown = Pace { taken: 0.0, cost: 0.0, ..pace };
        assert!(unknown.allows(10.0, 0.9, 0.0) && !unknown.allows(10.0, 1.1, 0.0), "the first one tries");
        let waiting = Pace { share: 0.0, ..unknown };
        assert!(!waiting.allows(1e6, 0.0, 0.0), "a simulation that waits for slides waits for no map");
    }

    #[test]
    fn maps_that_never_end_in_time_are_tried_ever_more_rarely() {
        let mut pace = Pace { share: 0.1, since: Instant::now(), taken: 0.0, cost: 0.0 };
        let given_up = |seconds: f64| {
            let begin = Instant::now().checked_sub(std::time::Duration::from_secs_f64(seconds)).unwrap();
            Attempt { next: None, begin, awaited: Some(0.0) }
        };
        pace.ended(&given_up(2.0), false);
        assert!((pace.taken - 2.0).abs() < 0.5 && (pace.cost - 4.0).abs() < 1.0, "{} {}", pace.taken, pace.cost);
        assert!(!pace.allows(45.0, 0.0, 0.0) && pace.allows(80.0, 0.0, 0.0), "2 seconds are gone, and 4 are needed");
        pace.ended(&given_up(5.0), true);
        assert!(pace.taken == 0.0 && (pace.cost - 5.0).abs() < 0.5, "a whole map tells what one takes");
    }
}
