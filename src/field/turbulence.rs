//! Synthetic turbulence for benchmarks: a sum of travelling shear waves (random Fourier modes, Kraichnan 1970).
//!
//! Unit length = the short side of the grid (192 cells in the published 600x192x192). Each mode has a wave vector uniform on the
//! sphere with k cycles per unit, k log-uniform from 2 to k_max; a polarisation perpendicular to it, uniform in angle; amplitude
//! k^(-5/6); a uniform phase; a phase speed of 0.15 k^(2/3) N(0, 1) radians per snapshot. The sum is scaled so that the expected
//! root mean square of |v| over all space and time (sqrt of half the sum of the squared amplitudes) is A cells per snapshot on 192
//! cells. On another grid velocities scale with it, so that displacements relative to the domain stay the same.

use super::{Axis, AxisFault, Geometry, Grid, Snapshot, Window, WindowFault};
use rayon::prelude::*;
use std::f64::consts::TAU;
use std::sync::Arc;
use wide::f64x4;

/// Cells along the short side of the published grid.
const PUBLISHED_SHORT_SIDE: f64 = 192.0;
/// Time interval between snapshots.
const SNAPSHOT_INTERVAL: f64 = 1.0;

/// SplitMix64 (Steele, Lea, Flood 2014): a small, portable, seedable generator.
struct SplitMix64(u64);

impl SplitMix64 {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }
    /// Uniform in (0, 1).
    fn uniform(&mut self) -> f64 {
        ((self.next() >> 11) as f64 + 0.5) / (1u64 << 53) as f64
    }
    /// Normal with variance 1 (Box and Muller 1958).
    fn normal(&mut self) -> f64 {
        let radius = (-2.0 * self.uniform().ln()).sqrt();
        radius * (TAU * self.uniform()).cos()
    }
}

/// v = amplitude cos(wave . x + phase + speed t), x in cells.
#[derive(Debug, Clone, Copy)]
struct Mode {
    /// Radians per cell.
    wave: [f64; 3],
    /// Cells per snapshot.
    amplitude: [f64; 3],
    phase: f64,
    /// Radians per snapshot.
    speed: f64,
}

/// Synthetic turbulence on a Cartesian grid whose coordinates are cells, 0 to n - 1; time counts snapshots.
#[derive(Debug, Clone)]
pub struct Turbulence {
    modes: Vec<Mode>,
}

impl Turbulence {
    /// `modes` waves up to `k_max` cycles per unit, root mean square speed `amplitude` cells per snapshot on the published grid,
    /// for a grid of this shape.
    pub fn new(shape: [usize; 3], modes: usize, k_max: f64, amplitude: f64, seed: u64) -> Self {
        let short_side = *shape.iter().min().unwrap_or(&1) as f64;
        let mut random = SplitMix64(seed);
        let mut modes: Vec<Mode> = (0..modes)
            .map(|_| {
                let cosine = 2.0 * random.uniform() - 1.0;
                let (sin_turn, cos_turn) = (TAU * random.uniform()).sin_cos();
                let k = 2.0 * (k_max / 2.0).powf(random.uniform());
                let sine = (1.0 - cosine * cosine).sqrt();
                let direction = [sine * cos_turn, sine * sin_turn, cosine];
                // Two vectors perpendicular to the direction: along its meridian and its circle of latitude.
                let (meridian, parallel) = ([cosine * cos_turn, cosine * sin_turn, -sine], [-sin_turn, cos_turn, 0.0]);
                let (sin_angle, cos_angle) = (TAU * random.uniform()).sin_cos();
                let size = k.powf(-5.0 / 6.0);
                Mode {
                    wave: direction.map(|d| d * TAU * k / short_side),
                    amplitude: std::array::from_fn(|i| size * (cos_angle * meridian[i] + sin_angle * parallel[i])),
                    phase: TAU * random.uniform(),
                    speed: 0.15 * k.powf(2.0 / 3.0) * random.normal() / SNAPSHOT_INTERVAL,
                }
            })
            .collect();
        let mean_square: f64 = modes.iter().map(|m| m.amplitude.iter().map(|a| a * a).sum::<f64>() / 2.0).sum();
        let scale = amplitude * short_side / PUBLISHED_SHORT_SIDE / mean_square.sqrt();
        for mode in &mut modes {
            mode.amplitude = mode.amplitude.map(|a| a * scale);
        }
        Self { modes }
    }

    /// Description in words, which marks the data as synthetic.
    pub fn described(modes: usize, k_max: f64, amplitude: f64, seed: u64) -> String {
        format!("synthetic turbulence, seed {seed}, {modes} modes up to {k_max} cycles, {amplitude} cells a snapshot")
    }

    /// 48 modes, k_max 14, A 3.
    pub fn easy(shape: [usize; 3], seed: u64) -> Self {
        Self::new(shape, 48, 14.0, 3.0, seed)
    }

    /// 48 modes, k_max 30, A 8.
    pub fn hard(shape: [usize; 3], seed: u64) -> Self {
        Self::new(shape, 48, 30.0, 8.0, seed)
    }

    /// The grid whose coordinates are cells.
    pub fn grid(shape: [usize; 3]) -> Result<Arc<Grid>, AxisFault> {
        let axis = |name: &str, n: usize| Axis::uniform(name, "cells", 0.0, n as f64 - 1.0, n);
        let axes = vec![axis("x", shape[0])?, axis("y", shape[1])?, axis("z", shape[2])?];
        Ok(Arc::new(Grid { axes, geometry: Geometry::Cartesian, slab: (0.0, 1.0) }))
    }

    /// Velocity at a point (cells) and time (snapshots), in cells per snapshot.
    pub fn velocity(&self, point: [f64; 3], time: f64) -> [f64; 3] {
        let mut v = [0.0; 3];
        for mode in &self.modes {
            let angle = (0..3).map(|i| mode.wave[i] * point[i]).sum::<f64>() + mode.phase + mode.speed * time;
            let cosine = angle.cos();
            for i in 0..3 {
                v[i] += mode.amplitude[i] * cosine;
            }
        }
        v
    }

    /// The flow sampled at the nodes of a Cartesian grid (uniform along x); rows in parallel.
    pub fn snapshot(&self, time: f64, grid: &Arc<Grid>) -> Snapshot {
        let [nx, ny, _] = grid.shape();
        let along_x = grid.axes[0].coordinates();
        let step = (along_x[nx - 1] - along_x[0]) / (nx - 1) as f64;
        let at = |axis: usize, index: usize| grid.axes.get(axis).map_or(0.0, |a| a.coordinates()[index]);
        let mut nodes = vec![[0.0f32; 4]; grid.nodes()];
        // Four nodes at once; a rotation advances the phase of each mode by four nodes.
        nodes.par_chunks_mut(nx).enumerate().for_each_init(
            || vec![[f64x4::ZERO; 3]; nx.div_ceil(4)],
            |sums, (row, nodes)| {
                let (y, z) = (at(1, row % ny), at(2, row / ny));
                sums.fill([f64x4::ZERO; 3]);
                for mode in &self.modes {
                    let start = mode.wave[0] * along_x[0] + mode.wave[1] * y + mode.wave[2] * z + mode.phase + mode.speed * time;
                    let turn = mode.wave[0] * step;
                    let angle = f64x4::new(std::array::from_fn(|i| start + turn * i as f64));
                    let (mut sine, mut cosine) = ridgewatch_simd::Lanes::sin_cos(angle);
                    let (s, c) = (4.0 * turn).sin_cos();
                    let (s, c) = (f64x4::splat(s), f64x4::splat(c));
                    let amplitude = mode.amplitude.map(f64x4::splat);
                    for sum in sums.iter_mut() {
                        for i in 0..3 {
                            sum[i] = amplitude[i].mul_add(cosine, sum[i]);
                        }
                        (sine, cosine) = (sine.mul_add(c, cosine * s), cosine.mul_sub(c, sine * s));
                    }
                }
                for (four, sum) in nodes.chunks_mut(4).zip(sums.iter()) {
                    let [u, v, w] = sum.map(f64x4::to_array);
                    for (i, node) in four.iter_mut().enumerate() {
                        *node = [u[i] as f32, v[i] as f32, w[i] as f32, 0.0];
                    }
                }
            },
        );
        Snapshot::new(time, grid.clone(), nodes)
    }

    /// A window of `snapshots` snapshots at times 0, 1, 2, ...
    pub fn window(&self, grid: &Arc<Grid>, snapshots: usize) -> Result<Window, WindowFault> {
        let mut window = Window::new((snapshots.max(2) - 1) as f64 * SNAPSHOT_INTERVAL);
        for index in 0..snapshots {
            window.push(Arc::new(self.snapshot(index as f64 * SNAPSHOT_INTERVAL, grid)))?;
        }
        Ok(window)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nodes_are_the_closed_form() {
        let shape = [37, 12, 10];
        let flow = Turbulence::easy(shape, 3);
        let grid = Turbulence::grid(shape).unwrap();
        let snapshot = flow.snapshot(4.0, &grid);
        for i in (0..grid.nodes()).step_by(97) {
            let point = [(i % 37) as f64, (i / 37 % 12) as f64, (i / 37 / 12) as f64];
            let exact = flow.velocity(point, 4.0);
            for c in 0..3 {
                // Nodes are single precision; speeds are below one cell per snapshot here.
                assert!((f64::from(snapshot.nodes[i][c]) - exact[c]).abs() < 1e-7, "{i} {c}");
            }
        }
    }

    #[test]
    fn speed_is_as_stated_and_scales_with_the_grid() {
        let mean_square = |shape: [usize; 3]| {
            let flow = Turbulence::hard(shape, 0);
            let mut random = SplitMix64(9);
            let mut sum = 0.0;
            for _ in 0..20_000 {
                let point = std::array::from_fn(|_| 1e4 * random.uniform());
                sum += flow.velocity(point, 1e3 * random.uniform()).iter().map(|v| v * v).sum::<f64>();
            }
            sum / 20_000.0
        };
        // 20,000 independent points know the mean square to about 1 %.
        assert!((mean_square([600, 192, 192]).sqrt() / 8.0 - 1.0).abs() < 0.02);
        assert!((mean_square([96, 48, 48]).sqrt() / 2.0 - 1.0).abs() < 0.02);
    }

    #[test]
    fn it_is_divergence_free_and_seeded() {
        let flow = Turbulence::easy([96, 48, 48], 0);
        for mode in &flow.modes {
            let along: f64 = (0..3).map(|i| mode.wave[i] * mode.amplitude[i]).sum();
            assert!(along.abs() < 1e-15);
        }
        let same = Turbulence::easy([96, 48, 48], 0);
        let other = Turbulence::easy([96, 48, 48], 1);
        let p = [10.0, 11.0, 12.0];
        assert_eq!(flow.velocity(p, 1.0), same.velocity(p, 1.0));
        assert_ne!(flow.velocity(p, 1.0), other.velocity(p, 1.0));
    }
}
