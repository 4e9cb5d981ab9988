//! The wavefront: groups of flights that advance together, one tentative collision per wave.
//!
//! Each group owns a number of flights and a ring buffer of results. Paths start in the order of (pixel, sample) and end in any order. The ring
//! buffer releases them in the order in which they started, so that the sum of a pixel does not depend on threads, groups or waves, and memory
//! does not grow with the number of samples.

use super::film::{Film, PathSample, Pixel};
use super::tracking::{Flight, FrameScene, Outcome};
use ridgewatch_field::DomainPoint;
use std::collections::VecDeque;

/// Capacity of the ring buffer of results per flight. It limits how many later paths wait for a long one.
const RESULTS_PER_FLIGHT: usize = 4;
/// Paths assigned to a group at a time.
const TILE_PATHS: u64 = 512;

/// A run of pixels.
#[derive(Debug, Clone, Copy)]
struct Tile {
    first: u32,
    end: u32,
}

/// Counts over the waves of a group.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct PathCounts {
    pub(super) queries: u64,
    pub(super) traced: u64,
    pub(super) exceeded: u64,
    pub(super) missing: u64,
    pub(super) paths: u64,
}

/// A group of flights that one thread advances at a time.
pub(super) struct FlightGroup {
    capacity: usize,
    flights: Vec<Flight>,
    /// The flights' tentative collisions.
    pub(super) points: Vec<DomainPoint>,
    results: Vec<Option<PathSample>>,
    started: u64,
    retired: u64,
    tiles: VecDeque<Tile>,
    /// Next sample of the first pixel of the front tile.
    next_sample: u32,
    /// Pixels of the paths in `results`, oldest first; `sum` belongs to the front one.
    open: VecDeque<u32>,
    sum: Pixel,
    finished: Vec<(u32, Pixel)>,
    pub(super) counts: PathCounts,
}

impl FlightGroup {
    pub(super) fn new(capacity: usize) -> Self {
        Self {
            capacity,
            flights: Vec::new(),
            points: Vec::new(),
            results: vec![None; capacity * RESULTS_PER_FLIGHT],
            started: 0,
            retired: 0,
            tiles: VecDeque::new(),
            next_sample: 0,
            open: VecDeque::new(),
            sum: Pixel::default(),
            finished: Vec::new(),
            counts: PathCounts::default(),
        }
    }

    /// Processes the answers for the points of this group, advances every flight to its next tentative collision and replaces finished paths by
    /// new ones.
    pub(super) fn advance(&mut self, scene: &FrameScene, log_stretch: &[f32], traced: &[bool], samples: &std::ops::Range<u32>) {
        let mut kept = 0;
        for i in 0..self.flights.len() {
            self.counts.queries += 1;
            self.counts.traced += u64::from(traced[i]);
            self.counts.missing += u64::from(!log_stretch[i].is_finite());
            match self.flights[i].resolve(scene, log_stretch[i], traced[i], &mut self.counts.exceeded) {
                Outcome::Pending => {
                    self.flights.swap(kept, i);
                    kept += 1;
                }
                Outcome::Done(path) => self.results[self.flights[i].slot as usize] = Some(path),
            }
        }
        self.flights.truncate(kept);
        self.retire(samples);
        self.refill(scene, samples);
        self.points.clear();
        self.points.extend(self.flights.iter().map(|flight| scene.space.domain_point(flight.point())));
    }

    fn refill(&mut self, scene: &FrameScene, samples: &std::ops::Range<u32>) {
        while self.flights.len() < self.capacity && !self.tiles.is_empty() {
            if self.started - self.retired == self.results.len() as u64 {
                self.retire(samples);
                if self.started - self.retired == self.results.len() as u64 {
                    return;
                }
            }
            let tile = &mut self.tiles[0];
            let (pixel, sample) = (tile.first, samples.start + self.next_sample);
            if self.next_sample == 0 {
                self.open.push_back(pixel);
            }
            self.next_sample += 1;
            if samples.start + self.next_sample == samples.end {
                self.next_sample = 0;
                tile.first += 1;
                if tile.first == tile.end {
                    self.tiles.pop_front();
                }
            }
            let slot = (self.started % self.results.len() as u64) as u32;
            self.started += 1;
            match Flight::start(scene, pixel, sample, slot) {
                (flight, Outcome::Pending) => self.flights.push(flight),
                (_, Outcome::Done(path)) => self.results[slot as usize] = Some(path),
            }
        }
        self.retire(samples);
    }

    /// Adds finished paths to their pixels in the order in which they started, up to the first unfinished path.
    fn retire(&mut self, samples: &std::ops::Range<u32>) {
        while self.retired < self.started {
            let slot = (self.retired % self.results.len() as u64) as usize;
            let Some(path) = self.results[slot].take() else { return };
            self.retired += 1;
            self.counts.paths += 1;
            self.sum.add(&path);
            if self.sum.samples() == samples.end - samples.start
                && let Some(pixel) = self.open.pop_front()
            {
                self.finished.push((pixel, std::mem::take(&mut self.sum)));
            }
        }
    }

    fn idle(&self) -> bool {
        self.flights.is_empty() && self.tiles.is_empty()
    }
}

/// Distributes pixels over groups.
pub(super) struct Schedule {
    next: u32,
    pixels: u32,
    per_tile: u32,
}

impl Schedule {
    pub(super) fn new(pixels: u32, samples: u32) -> Self {
        Self { next: 0, pixels, per_tile: (TILE_PATHS / u64::from(samples)).clamp(1, 512) as u32 }
    }

    /// Assigns tiles in turn to the groups whose waiting paths are fewer than their free flights.
    pub(super) fn assign_tiles(&mut self, groups: &mut [FlightGroup], samples: u32) {
        let mut assigned = true;
        while assigned && self.next < self.pixels {
            assigned = false;
            for group in groups.iter_mut() {
                let waiting: u64 = group.tiles.iter().map(|t| u64::from(t.end - t.first) * u64::from(samples)).sum();
                if self.next < self.pixels && group.flights.len() as u64 + waiting < group.capacity as u64 + u64::from(group.next_sample) {
                    let end = (self.next + self.per_tile).min(self.pixels);
                    group.tiles.push_back(Tile { first: self.next, end });
                    self.next = end;
                    assigned = true;
                }
            }
        }
    }

    /// True if every path has ended.
    pub(super) fn is_over(&self, groups: &[FlightGroup]) -> bool {
        self.next == self.pixels && groups.iter().all(FlightGroup::idle)
    }
}

/// Writes the finished pixels of all groups.
pub(super) fn collect(groups: &mut [FlightGroup], film: &mut Film) {
    for group in groups {
        for (pixel, sum) in group.finished.drain(..) {
            sum.write(film, pixel as usize);
        }
    }
}
