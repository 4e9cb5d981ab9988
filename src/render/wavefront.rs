//! The wavefront: lanes of flights that advance together, wave by wave.
//!
//! Each lane owns a number of flights and a ring of results. Paths start in the order of (pixel, sample) and end in any order; the
//! ring lets them retire in the order in which they started, so that a pixel's sum never depends on threads, lanes or waves, and
//! memory is bounded whatever the number of samples.

use super::film::{Film, PathSample, Pixel};
use super::tracking::{Flight, FrameScene, Outcome};
use std::collections::VecDeque;

/// Results a lane holds back, as a multiple of its flights: how far a long path may delay the ones behind it.
const RING_FACTOR: usize = 4;
/// Paths that are handed to a lane at a time.
const TILE_PATHS: u64 = 512;

/// A run of pixels.
#[derive(Debug, Clone, Copy)]
struct Tile {
    first: u32,
    end: u32,
}

/// What a lane's waves added up to.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Tally {
    pub(super) queries: u64,
    pub(super) traced: u64,
    pub(super) exceeded: u64,
    pub(super) missing: u64,
    pub(super) paths: u64,
}

impl std::ops::Add for Tally {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self {
            queries: self.queries + other.queries,
            traced: self.traced + other.traced,
            exceeded: self.exceeded + other.exceeded,
            missing: self.missing + other.missing,
            paths: self.paths + other.paths,
        }
    }
}

/// A group of flights that one thread advances at a time.
pub(super) struct Lane {
    capacity: usize,
    flights: Vec<Flight>,
    /// Domain coordinates of the flights' tentative collisions.
    pub(super) points: Vec<[f32; 3]>,
    ring: Vec<Option<PathSample>>,
    started: u64,
    retired: u64,
    tiles: VecDeque<Tile>,
    /// Sample of the front tile's first pixel that starts next.
    next_sample: u32,
    /// Pixels of the paths in the ring, oldest first; the front one is being summed in `sum`.
    open: VecDeque<u32>,
    sum: Pixel,
    finished: Vec<(u32, Pixel)>,
    pub(super) tally: Tally,
}

impl Lane {
    pub(super) fn new(capacity: usize) -> Self {
        Self {
            capacity,
            flights: Vec::new(),
            points: Vec::new(),
            ring: vec![None; capacity * RING_FACTOR],
            started: 0,
            retired: 0,
            tiles: VecDeque::new(),
            next_sample: 0,
            open: VecDeque::new(),
            sum: Pixel::default(),
            finished: Vec::new(),
            tally: Tally::default(),
        }
    }

    /// Takes the answers for this lane's points, advances every flight to its next tentative collision and starts new paths in the
    /// room that ended ones leave.
    pub(super) fn advance(&mut self, scene: &FrameScene, log_stretch: &[f32], traced: &[bool], samples: &std::ops::Range<u32>) {
        let mut kept = 0;
        for i in 0..self.flights.len() {
            self.tally.queries += 1;
            self.tally.traced += u64::from(traced[i]);
            self.tally.missing += u64::from(!log_stretch[i].is_finite());
            match self.flights[i].resolve(scene, log_stretch[i], traced[i], &mut self.tally.exceeded) {
                Outcome::Pending => {
                    self.flights.swap(kept, i);
                    kept += 1;
                }
                Outcome::Done(path) => self.ring[self.flights[i].slot as usize] = Some(path),
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
            if self.started - self.retired == self.ring.len() as u64 {
                self.retire(samples);
                if self.started - self.retired == self.ring.len() as u64 {
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
            let slot = (self.started % self.ring.len() as u64) as u32;
            self.started += 1;
            match Flight::start(scene, pixel, sample, slot) {
                (flight, Outcome::Pending) => self.flights.push(flight),
                (_, Outcome::Done(path)) => self.ring[slot as usize] = Some(path),
            }
        }
        self.retire(samples);
    }

    /// Adds finished paths to their pixels, in the order in which they started, up to the first that is still in flight.
    fn retire(&mut self, samples: &std::ops::Range<u32>) {
        while self.retired < self.started {
            let slot = (self.retired % self.ring.len() as u64) as usize;
            let Some(path) = self.ring[slot].take() else { return };
            self.retired += 1;
            self.tally.paths += 1;
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

/// Hands pixels out to lanes.
pub(super) struct Schedule {
    next: u32,
    pixels: u32,
    per_tile: u32,
}

impl Schedule {
    pub(super) fn new(pixels: u32, samples: u32) -> Self {
        Self { next: 0, pixels, per_tile: (TILE_PATHS / u64::from(samples)).clamp(1, 512) as u32 }
    }

    /// Gives tiles, one lane after the other, to those whose waiting paths do not fill them.
    pub(super) fn deal(&mut self, lanes: &mut [Lane], samples: u32) {
        let mut hungry = true;
        while hungry && self.next < self.pixels {
            hungry = false;
            for lane in lanes.iter_mut() {
                let waiting: u64 = lane.tiles.iter().map(|t| u64::from(t.end - t.first) * u64::from(samples)).sum();
                if self.next < self.pixels && lane.flights.len() as u64 + waiting < lane.capacity as u64 + u64::from(lane.next_sample) {
                    let end = (self.next + self.per_tile).min(self.pixels);
                    lane.tiles.push_back(Tile { first: self.next, end });
                    self.next = end;
                    hungry = true;
                }
            }
        }
    }

    /// Whether every path has ended.
    pub(super) fn is_over(&self, lanes: &[Lane]) -> bool {
        self.next == self.pixels && lanes.iter().all(Lane::idle)
    }
}

/// Writes the pixels that lanes have finished.
pub(super) fn collect(lanes: &mut [Lane], film: &mut Film) {
    for lane in lanes {
        for (pixel, sum) in lane.finished.drain(..) {
            sum.write(film, pixel as usize);
        }
    }
}
