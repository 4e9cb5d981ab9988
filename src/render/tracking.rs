//! A path: free flight by delta tracking (Woodcock et al. 1965), then transmittance to the light by ratio tracking (Novak, Selle and Jarosz
//! 2014), with isotropic single scattering.
//!
//! Both traverse the majorant grid by a digital differential analyser (Amanatides and Woo 1987) and stop at tentative collisions, which need
//! the extinction there. If the extinction exceeds its majorant, the probability of a null collision is negative. The collision is then drawn
//! in proportion to the absolute rates and carries a weight (Galtier et al. 2013), so that the estimate stays unbiased. From there on the path
//! takes the largest extinction of all for its majorant: thinning stays exact if the rate depends on what was met before (Ogata 1981), and weights
//! that multiplied from collision to collision would have no bound.

use super::film::PathSample;
use super::majorant::MajorantGrid;
use super::parameters::FrameParameters;
use super::rng::{FrameRandom, unit};
use super::space::{GridPoint, SceneBox};
use super::{Camera, Light, Transfer};

/// Isotropic phase function.
pub const PHASE: f32 = 1.0 / (4.0 * std::f32::consts::PI);
/// Transmittance below which Russian roulette ends shadow flights. It is unbiased and saves expensive queries.
pub const ROULETTE: f32 = 1.0 / 16.0;

/// Everything that is constant during a frame.
pub struct FrameScene<'a> {
    /// Camera.
    pub camera: &'a Camera,
    /// Light.
    pub light: &'a Light,
    /// Transfer function.
    pub transfer: &'a Transfer,
    /// The box, in domain and scene units.
    pub space: &'a SceneBox,
    /// Upper bounds of the extinction per cell.
    pub majorants: &'a MajorantGrid,
    /// Random numbers of the frame.
    pub random: FrameRandom,
    /// Pixels across.
    pub width: usize,
    /// Pixels down.
    pub height: usize,
    /// Linear radiance behind the box.
    pub background: [f32; 3],
    /// Linear radiance of missing cells.
    pub missing: [f32; 3],
    /// 1 / |tau|, which turns a log-stretch into an FTLE.
    pub inverse_tau: f32,
}

impl FrameScene<'_> {
    /// The parameters that a device needs to track the paths itself.
    pub fn parameters(&self) -> FrameParameters {
        let (key, frame) = self.random.parts();
        FrameParameters {
            camera: *self.camera,
            space: *self.space,
            light: self.light.parameters(),
            transfer: self.transfer.parameters(),
            key,
            frame,
            pad: 0,
            width: self.width as u32,
            height: self.height as u32,
            background: self.background,
            missing: self.missing,
            inverse_tau: self.inverse_tau,
            pad_end: 0.0,
        }
    }
}

/// Stage of a path.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Stage {
    /// From the camera to the first real collision.
    Camera,
    /// From the collision to the light.
    Shadow,
    /// Left the box without a collision: a random point of the way through it decides between the colours of missing cells and background.
    MissingProbe,
}

/// Result of advancing a flight.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Outcome {
    /// The flight waits for the extinction at its tentative collision.
    Pending,
    /// The path has ended.
    Done(PathSample),
}

/// A path in flight, `t` scene lengths from `origin`.
#[derive(Debug, Clone)]
pub struct Flight {
    origin: GridPoint,
    direction: [f32; 3],
    t: f32,
    end: f32,
    /// Camera stage: weight of the path. Shadow stage: transmittance so far.
    weight: f32,
    /// Least majorant: 0, and the largest extinction once the path has met one above its majorant.
    least_majorant: f32,
    /// Cell of the tentative collision and its majorant.
    cell: u32,
    majorant: f32,
    /// Random numbers for the decisions at the collision.
    decision: f32,
    roulette: f32,
    pixel: u32,
    sample: u32,
    dimension: u32,
    stage: Stage,
    /// Contribution of the path at full transmittance.
    path: PathSample,
    /// Index of the result in its group.
    pub slot: u32,
}

impl Flight {
    /// Starts the path of a sample and advances it to its first tentative collision.
    pub fn start(scene: &FrameScene, pixel: u32, sample: u32, slot: u32) -> (Self, Outcome) {
        let [jitter_x, jitter_y, ..] = scene.random.words(pixel, sample, 0).map(|w| f64::from(unit(w)));
        let (column, row) = (pixel as usize % scene.width, pixel as usize / scene.width);
        let x = (column as f64 + jitter_x) / scene.width as f64 * 2.0 - 1.0;
        let y = 1.0 - (row as f64 + jitter_y) / scene.height as f64 * 2.0;
        let (origin, direction) = scene.camera.ray(x, y);
        let mut flight = Self {
            origin: GridPoint::default(),
            direction: scene.space.grid_direction(direction),
            t: 0.0,
            end: 0.0,
            weight: 1.0,
            least_majorant: 0.0,
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
            let outcome = flight.finish_unscattered(scene.background, 0.0);
            return (flight, outcome);
        };
        flight.origin = scene.space.grid_point(std::array::from_fn(|k| origin[k] + enter * direction[k]));
        flight.end = (leave - enter) as f32;
        let outcome = flight.continue_flight(scene);
        (flight, outcome)
    }

    /// The tentative collision.
    #[inline]
    pub fn point(&self) -> GridPoint {
        self.origin.along(self.direction, self.t)
    }

    /// Draws an optical depth and advances the flight to the next tentative collision or to its end.
    #[inline]
    fn continue_flight(&mut self, scene: &FrameScene) -> Outcome {
        let words = scene.random.words(self.pixel, self.sample, self.dimension);
        self.dimension += 1;
        self.decision = unit(words[1]);
        self.roulette = unit(words[2]);
        // 1 - u lies in (0, 1].
        let depth = -(1.0 - unit(words[0])).ln();
        match walk(scene.majorants, self.least_majorant, self.origin, self.direction, self.t, self.end, depth) {
            Some(hit) => {
                (self.t, self.cell, self.majorant) = (hit.t, hit.cell, hit.majorant);
                Outcome::Pending
            }
            None => self.exit_box(scene, unit(words[3])),
        }
    }

    /// Ends a flight that has left the box or reached the light. A camera flight queries a point drawn uniformly along its way through the box.
    /// The point does not depend on the majorants, so that the picture does not either. Cells without missing values need no query.
    fn exit_box(&mut self, scene: &FrameScene, position: f32) -> Outcome {
        if self.stage == Stage::Shadow {
            self.path.radiance = self.path.radiance.map(|c| c * self.weight);
            return Outcome::Done(self.path);
        }
        self.t = position * self.end;
        let cell = scene.majorants.cell_at(self.point());
        if !scene.majorants.may_be_missing(cell) {
            return self.finish_unscattered(scene.background, 0.0);
        }
        self.cell = cell as u32;
        self.stage = Stage::MissingProbe;
        Outcome::Pending
    }

    /// Ends a camera path that did not scatter with the colour behind the box.
    fn finish_unscattered(&mut self, colour: [f32; 3], missing: f32) -> Outcome {
        self.path.radiance = colour.map(|c| c * self.weight);
        self.path.missing = missing * self.weight;
        Outcome::Done(self.path)
    }

    /// Processes the answer at the tentative collision and advances to the next. `exceeded` counts extinctions above their majorant.
    #[inline]
    pub fn resolve(&mut self, scene: &FrameScene, log_stretch: f32, traced: bool, exceeded: &mut u64) -> Outcome {
        self.path.queries += 1;
        self.path.traced += u32::from(traced);
        if !log_stretch.is_finite() {
            scene.majorants.observe_missing(self.cell as usize);
            return if self.stage == Stage::MissingProbe {
                self.finish_unscattered(scene.missing, 1.0)
            } else {
                self.continue_flight(scene)
            };
        }
        let ftle = log_stretch * scene.inverse_tau;
        scene.majorants.observe(self.cell as usize, ftle);
        if self.stage == Stage::MissingProbe {
            return self.finish_unscattered(scene.background, 0.0);
        }
        let ratio = scene.transfer.extinction(ftle) / self.majorant;
        if ratio > 1.0 {
            *exceeded += 1;
            self.least_majorant = scene.transfer.extinction_max();
        }
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
        self.continue_flight(scene)
    }

    /// Real collision: starts the shadow flight to the light.
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
        self.continue_flight(scene)
    }
}

/// The point at which the optical depth of a flight is used up.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Hit {
    pub t: f32,
    pub cell: u32,
    pub majorant: f32,
}

/// Traverses the grid from `t` along `origin + t direction` until the majorants, each at least `least`, integrate to `depth`; `None` if that is
/// beyond `end`. Visits at most as many cells as the grid has along its three axes together.
#[inline]
pub fn walk(grid: &MajorantGrid, least: f32, origin: GridPoint, direction: [f32; 3], mut t: f32, end: f32, mut depth: f32) -> Option<Hit> {
    let cells = grid.cells();
    let majorants = grid.majorants();
    let strides = [1, cells[0] as isize, (cells[0] * cells[1]) as isize];
    let mut index = 0_isize;
    // Per axis: cells left before the ray leaves the grid, t of the next cell wall, and the difference in t between walls.
    let (mut left, mut wall, mut wall_spacing, mut step) = ([0_i32; 3], [f32::INFINITY; 3], [0.0_f32; 3], [0_isize; 3]);
    for k in 0..3 {
        let place = origin.0[k] + t * direction[k];
        let cell = (place as i32).clamp(0, cells[k] as i32 - 1);
        index += cell as isize * strides[k];
        if direction[k] != 0.0 {
            let ahead = direction[k] > 0.0;
            let inverse = 1.0 / direction[k];
            wall[k] = ((cell + i32::from(ahead)) as f32 - origin.0[k]) * inverse;
            wall_spacing[k] = inverse.abs();
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
        let majorant = majorants[index as usize].max(least);
        // Rounding may put a wall slightly before t.
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
        wall[axis] += wall_spacing[axis];
    }
}

#[cfg(test)]
#[path = "tracking_tests.rs"]
mod tests;
