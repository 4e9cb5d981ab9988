//! One path: free flight by delta tracking, then transmittance toward the light by ratio tracking.
//!
//! Both walk the majorant grid by a digital differential analyser (Amanatides and Woo 1987) and stop at tentative collisions,
//! where the extinction is asked for. Above its majorant, an extinction makes the probability of a null collision negative; such
//! a collision is then drawn in proportion to absolute rates and carries a weight (Galtier et al. 2013), which keeps the mean right.

use super::film::PathSample;
use super::majorant::MajorantGrid;
use super::rng::{FrameRandom, unit};
use super::space::SceneBox;
use super::{Camera, Light, Transfer};

/// Isotropic phase function.
const PHASE: f32 = 1.0 / (4.0 * std::f32::consts::PI);
/// Transmittance below which Russian roulette decides whether a shadow flight goes on. Unbiased; queries are dear.
const ROULETTE: f32 = 1.0 / 16.0;

/// Everything that stays the same during a frame.
pub(super) struct FrameScene<'a> {
    pub(super) camera: &'a Camera,
    pub(super) light: &'a Light,
    pub(super) transfer: &'a Transfer,
    pub(super) space: &'a SceneBox,
    pub(super) majorants: &'a MajorantGrid,
    pub(super) random: FrameRandom,
    pub(super) width: usize,
    pub(super) height: usize,
    pub(super) background: [f32; 3],
    pub(super) missing: [f32; 3],
    pub(super) per_tau: f32,
}

/// What a path is after.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Stage {
    /// From the camera to the first real collision.
    Camera,
    /// From there to the light.
    Shadow,
    /// Past the box without a collision: one point of the way through it tells land from background.
    Probe,
}

/// What becomes of a flight.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Outcome {
    /// It waits for the extinction at its tentative collision.
    Pending,
    /// Its path is over.
    Done(PathSample),
}

/// A path in flight. Positions are in grid coordinates, `t` in scene lengths from `origin`.
#[derive(Debug, Clone)]
pub(super) struct Flight {
    origin: [f32; 3],
    direction: [f32; 3],
    t: f32,
    end: f32,
    /// Camera stage: weight of the path. Shadow stage: transmittance so far.
    weight: f32,
    /// Cell of the tentative collision and its majorant.
    cell: u32,
    majorant: f32,
    /// Random numbers that decide there.
    decision: f32,
    roulette: f32,
    pixel: u32,
    sample: u32,
    dimension: u32,
    stage: Stage,
    /// What the path adds at full transmittance.
    path: PathSample,
    /// Where its lane keeps the result.
    pub(super) slot: u32,
}

impl Flight {
    /// Starts the path of a sample and walks to its first tentative collision.
    pub(super) fn start(scene: &FrameScene, pixel: u32, sample: u32, slot: u32) -> (Self, Outcome) {
        let [jitter_x, jitter_y, ..] = scene.random.words(pixel, sample, 0).map(|w| f64::from(unit(w)));
        let (column, row) = (pixel as usize % scene.width, pixel as usize / scene.width);
        let x = (column as f64 + jitter_x) / scene.width as f64 * 2.0 - 1.0;
        let y = 1.0 - (row as f64 + jitter_y) / scene.height as f64 * 2.0;
        let (origin, direction) = scene.camera.ray(x, y);
        let mut flight = Self {
            origin: [0.0; 3],
            direction: scene.space.grid_direction(direction),
            t: 0.0,
            end: 0.0,
            weight: 1.0,
            cell: 0,
            majorant: 0.0,
            decision: 0.0,
            roulette: 0.0,
            pixel,
            sample,
            dimension: 1,
            stage: Stage::Camera,
            path: PathSample::default(),
            slot,
        };
        let Some((enter, leave)) = scene.space.intersect(origin, direction) else {
            let outcome = flight.see(scene.background, 0.0);
            return (flight, outcome);
        };
        flight.origin = scene.space.grid_point(std::array::from_fn(|k| origin[k] + enter * direction[k]));
        flight.end = (leave - enter) as f32;
        let outcome = flight.fly(scene);
        (flight, outcome)
    }

    /// Grid coordinates of the tentative collision.
    #[inline]
    pub(super) fn point(&self) -> [f32; 3] {
        std::array::from_fn(|k| self.origin[k] + self.t * self.direction[k])
    }

    /// Draws a free flight and walks it; past the end the path is over.
    #[inline]
    fn fly(&mut self, scene: &FrameScene) -> Outcome {
        let words = scene.random.words(self.pixel, self.sample, self.dimension);
        self.dimension += 1;
        self.decision = unit(words[1]);
        self.roulette = unit(words[2]);
        // 1 - u lies in (0, 1].
        let depth = -(1.0 - unit(words[0])).ln();
        match walk(scene.majorants, self.origin, self.direction, self.t, self.end, depth) {
            Some(hit) => {
                (self.t, self.cell, self.majorant) = (hit.t, hit.cell, hit.majorant);
                Outcome::Pending
            }
            None => self.leave(scene, unit(words[3])),
        }
    }

    /// The walk has come to its end. A camera flight probes a point drawn uniformly along its way through the box: a choice that
    /// does not depend on majorants, so that neither does the picture. Cells known to hold no missing value need no query.
    fn leave(&mut self, scene: &FrameScene, place: f32) -> Outcome {
        if self.stage == Stage::Shadow {
            self.path.radiance = self.path.radiance.map(|c| c * self.weight);
            return Outcome::Done(self.path);
        }
        self.t = place * self.end;
        let cell = scene.majorants.cell_at(self.point());
        if !scene.majorants.may_miss(cell) {
            return self.see(scene.background, 0.0);
        }
        self.cell = cell as u32;
        self.stage = Stage::Probe;
        Outcome::Pending
    }

    /// A camera path that did not scatter sees what lies behind.
    fn see(&mut self, colour: [f32; 3], missing: f32) -> Outcome {
        self.path.radiance = colour.map(|c| c * self.weight);
        self.path.missing = missing * self.weight;
        Outcome::Done(self.path)
    }

    /// Takes the answer at the tentative collision and goes on to the next. `exceeded` counts extinctions above their majorant.
    #[inline]
    pub(super) fn resolve(&mut self, scene: &FrameScene, log_stretch: f32, traced: bool, exceeded: &mut u64) -> Outcome {
        self.path.queries += 1;
        self.path.traced += u32::from(traced);
        if !log_stretch.is_finite() {
            scene.majorants.observe_missing(self.cell as usize);
            return if self.stage == Stage::Probe { self.see(scene.missing, 1.0) } else { self.fly(scene) };
        }
        let ftle = log_stretch * scene.per_tau;
        scene.majorants.observe(self.cell as usize, ftle);
        if self.stage == Stage::Probe {
            return self.see(scene.background, 0.0);
        }
        let ratio = scene.transfer.extinction(ftle) / self.majorant;
        *exceeded += u64::from(ratio > 1.0);
        match self.stage {
            Stage::Camera => {
                let real = if ratio <= 1.0 { ratio } else { ratio / (2.0 * ratio - 1.0) };
                if self.decision < real {
                    if ratio > 1.0 {
                        self.weight *= 2.0 * ratio - 1.0;
                    }
                    return self.scatter(scene, ftle);
                }
                if ratio > 1.0 {
                    self.weight *= 1.0 - 2.0 * ratio;
                }
            }
            _ => {
                self.weight *= 1.0 - ratio;
                let size = self.weight.abs();
                if size < ROULETTE {
                    if self.roulette * ROULETTE >= size {
                        self.path.radiance = [0.0; 3];
                        return Outcome::Done(self.path);
                    }
                    self.weight = ROULETTE.copysign(self.weight);
                }
            }
        }
        self.fly(scene)
    }

    /// A real collision: the path turns toward the light.
    fn scatter(&mut self, scene: &FrameScene, ftle: f32) -> Outcome {
        let point = self.point();
        let (direction, distance, radiance) = scene.light.seen_from(scene.space.scene_point(point));
        let albedo = scene.transfer.albedo(ftle);
        self.path.radiance = std::array::from_fn(|k| albedo[k] * radiance[k] * (PHASE * self.weight));
        self.path.scattered = self.weight;
        self.path.ftle = self.weight * ftle;
        self.origin = point;
        self.direction = scene.space.grid_direction(direction);
        self.end = scene.space.exit(point, self.direction).min(distance as f32);
        self.t = 0.0;
        self.weight = 1.0;
        self.stage = Stage::Shadow;
        self.fly(scene)
    }
}

/// Where a walk used up its optical depth.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Hit {
    t: f32,
    cell: u32,
    majorant: f32,
}

/// Walks from `t` along `origin + t direction` (grid coordinates) until the majorants add up to `depth`; none when that lies beyond
/// `end`. Touches at most as many cells as the grid has along its three axes together.
#[inline]
fn walk(grid: &MajorantGrid, origin: [f32; 3], direction: [f32; 3], mut t: f32, end: f32, mut depth: f32) -> Option<Hit> {
    let cells = grid.cells();
    let majorants = grid.majorants();
    let strides = [1, cells[0] as isize, (cells[0] * cells[1]) as isize];
    let mut index = 0_isize;
    // Cells left along each axis before the walk leaves the grid, t of the next wall, and t between walls.
    let (mut left, mut wall, mut pace, mut step) = ([0_i32; 3], [f32::INFINITY; 3], [0.0_f32; 3], [0_isize; 3]);
    for k in 0..3 {
        let place = origin[k] + t * direction[k];
        let cell = (place as i32).clamp(0, cells[k] as i32 - 1);
        index += cell as isize * strides[k];
        if direction[k] != 0.0 {
            let ahead = direction[k] > 0.0;
            let inverse = 1.0 / direction[k];
            wall[k] = ((cell + i32::from(ahead)) as f32 - origin[k]) * inverse;
            pace[k] = inverse.abs();
            left[k] = if ahead { cells[k] as i32 - 1 - cell } else { cell };
            step[k] = if ahead { strides[k] } else { -strides[k] };
        }
    }
    loop {
        let axis = if wall[0] < wall[1] {
            if wall[0] < wall[2] { 0 } else { 2 }
        } else if wall[1] < wall[2] {
            1
        } else {
            2
        };
        let stop = wall[axis].min(end);
        let majorant = majorants[index as usize];
        // Rounding may put a wall a little behind t.
        let crossed = majorant * (stop - t).max(0.0);
        if crossed > depth {
            return Some(Hit { t: t + depth / majorant, cell: index as u32, majorant });
        }
        if wall[axis] >= end || left[axis] == 0 {
            return None;
        }
        depth -= crossed;
        t = t.max(stop);
        left[axis] -= 1;
        index += step[axis];
        wall[axis] += pace[axis];
    }
}

#[cfg(test)]
#[path = "tracking_tests.rs"]
mod tests;
