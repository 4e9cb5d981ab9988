//! Encodings of a tile of positions, with their derivatives along the input axes, and the way back into the tables.

use super::architecture::{Architecture, HASH, Level};
use super::lanes::lanes;
use std::f32::consts::FRAC_PI_2;
use wide::{f32x8, i32x8};

/// Values of a table that share one mark of having received a gradient: a cache line.
pub(super) const LINE: usize = 16;

/// The corners of the cell around each sample of a tile, for one level. Arrays are `[corner][lane]`, slopes `[input][corner][lane]`.
pub(super) struct Corners {
    lanes: usize,
    index: Vec<u32>,
    weight: Vec<f32>,
    slope: Vec<f32>,
}

impl Corners {
    /// Room for `samples` samples (rounded up to vectors); none for the frequency encoding, which has no cells.
    pub(super) fn new(shape: &Architecture, samples: usize) -> Self {
        let lanes = samples.next_multiple_of(8);
        let values = if shape.levels.is_empty() { 0 } else { lanes << shape.inputs() };
        Self { lanes, index: vec![0; values], weight: vec![0.0; values], slope: vec![0.0; shape.inputs() * values] }
    }

    /// Finds cells and multilinear weights of the first `count` samples; `coordinates` holds one run of `run` unit coordinates an axis, and
    /// may be read up to the next multiple of 8. Out-of-range and NaN coordinates are clamped, so every index lies below `level.entries`.
    fn locate<const D: usize>(&mut self, level: &Level, coordinates: &[f32], run: usize, count: usize, slopes: bool) {
        let lanes_held = self.lanes;
        assert!(count <= lanes_held);
        let (zero, one) = (f32x8::splat(0.0), f32x8::splat(1.0));
        let mask = i32x8::splat((level.entries - 1) as i32);
        for first in (0..count).step_by(8) {
            let mut node = [[i32x8::splat(0); 2]; D];
            let mut share = [[zero; 2]; D];
            let mut stride = 1_i32;
            for axis in 0..D {
                let cells = level.cells[axis];
                let position = lanes(&coordinates[axis * run + first..]).fast_max(zero).fast_min(one) * f32x8::splat(cells as f32);
                let cell = position.fast_trunc_int().max(i32x8::splat(0)).min(i32x8::splat(cells as i32 - 1));
                let fraction = position - f32x8::from_i32x8(cell);
                let factor = if level.hashed { HASH[axis] as i32 } else { stride };
                let low = cell * i32x8::splat(factor);
                node[axis] = [low, low + i32x8::splat(factor)];
                share[axis] = [one - fraction, fraction];
                stride = stride.wrapping_mul(cells as i32 + 1);
            }
            for corner in 0..1 << D {
                let side = |axis: usize| (corner >> axis) & 1;
                let (mut index, mut weight) = (node[0][side(0)], share[0][side(0)]);
                for axis in 1..D {
                    let other = node[axis][side(axis)];
                    index = if level.hashed { index ^ other } else { index + other };
                    weight *= share[axis][side(axis)];
                }
                if level.hashed {
                    index &= mask;
                }
                let at = corner * lanes_held + first;
                for (to, from) in self.index[at..at + 8].iter_mut().zip(index.to_array()) {
                    *to = from as u32;
                }
                self.weight[at..at + 8].copy_from_slice(&weight.to_array());
                if slopes {
                    for axis in 0..D {
                        let cells = level.cells[axis] as f32;
                        let mut slope = f32x8::splat(if side(axis) == 1 { cells } else { -cells });
                        for other in (0..D).filter(|&other| other != axis) {
                            slope *= share[other][side(other)];
                        }
                        let at = ((axis << D) + corner) * lanes_held + first;
                        self.slope[at..at + 8].copy_from_slice(&slope.to_array());
                    }
                }
            }
        }
    }

    /// Adds up `factors[corner] * table[index]` into columns `column..column + F` of `out`, one row a sample.
    fn gather<const D: usize, const F: usize>(
        &self,
        factors: &[f32],
        table: &[f32],
        out: &mut [f32],
        stride: usize,
        column: usize,
        count: usize,
    ) {
        assert!(count <= self.lanes && column + F <= stride && out.len() >= count * stride && factors.len() >= (1 << D) * self.lanes);
        for (sample, row) in out.chunks_exact_mut(stride).take(count).enumerate() {
            let mut sum = [0.0_f32; F];
            for corner in 0..1 << D {
                let at = corner * self.lanes + sample;
                // SAFETY: at < 2^D * lanes, the length of both arrays; `locate` keeps every index below the level's entries, and the caller
                // passes that level's table of entries * F values.
                unsafe {
                    let entry = *self.index.get_unchecked(at) as usize * F;
                    let factor = *factors.get_unchecked(at);
                    for (feature, sum) in sum.iter_mut().enumerate() {
                        *sum = factor.mul_add(*table.get_unchecked(entry + feature), *sum);
                    }
                }
            }
            row[column..column + F].copy_from_slice(&sum);
        }
    }

    /// Adds `factors[corner] * gradient[sample]` to the table entries; the gradient's columns `column..column + F`, one row a sample.
    fn scatter<const D: usize, const F: usize>(
        &self,
        factors: &[f32],
        gradient: &[f32],
        stride: usize,
        column: usize,
        table: &mut [f32],
        touched: &mut [u8],
        count: usize,
    ) {
        assert!(count <= self.lanes && gradient.len() >= count * stride && factors.len() >= (1 << D) * self.lanes);
        assert!(touched.len() >= table.len().div_ceil(LINE));
        for (sample, row) in gradient.chunks_exact(stride).take(count).enumerate() {
            let mut gradient = [0.0_f32; F];
            gradient.copy_from_slice(&row[column..column + F]);
            for corner in 0..1 << D {
                let at = corner * self.lanes + sample;
                // SAFETY: as in `gather`; entry < table.len(), so its line has a mark.
                unsafe {
                    let entry = *self.index.get_unchecked(at) as usize * F;
                    let factor = *factors.get_unchecked(at);
                    *touched.get_unchecked_mut(entry / LINE) = 1;
                    for (feature, gradient) in gradient.iter().enumerate() {
                        let value = table.get_unchecked_mut(entry + feature);
                        *value = factor.mul_add(*gradient, *value);
                    }
                }
            }
        }
    }
}

/// Chooses the instance for the number of inputs and features.
macro_rules! dispatch {
    ($d:expr, $f:expr, $call:ident) => {
        match ($d, $f) {
            (1, 1) => $call!(1, 1),
            (1, 2) => $call!(1, 2),
            (1, 4) => $call!(1, 4),
            (1, _) => $call!(1, 8),
            (2, 1) => $call!(2, 1),
            (2, 2) => $call!(2, 2),
            (2, 4) => $call!(2, 4),
            (2, _) => $call!(2, 8),
            (3, 1) => $call!(3, 1),
            (3, 2) => $call!(3, 2),
            (3, 4) => $call!(3, 4),
            (3, _) => $call!(3, 8),
            (_, 1) => $call!(4, 1),
            (_, 2) => $call!(4, 2),
            (_, 4) => $call!(4, 4),
            (_, _) => $call!(4, 8),
        }
    };
}

/// Encodes `count` samples into rows of `out`; `groups - 1` further groups of rows, `group` rows apart, get the derivatives along the axes.
pub(super) fn encode(
    shape: &Architecture,
    tables: &[f32],
    coordinates: &[f32],
    run: usize,
    count: usize,
    groups: usize,
    group: usize,
    corners: &mut Corners,
    out: &mut [f32],
    stride: usize,
) {
    if shape.levels.is_empty() {
        return frequencies(shape, coordinates, run, count, groups, group, out, stride);
    }
    assert!(tables.len() == shape.table_entries() * shape.features);
    for (number, level) in shape.levels.iter().enumerate() {
        let table = &tables[level.offset * shape.features..][..level.entries * shape.features];
        let column = number * shape.features;
        macro_rules! level {
            ($d:literal, $f:literal) => {{
                corners.locate::<$d>(level, coordinates, run, count, groups > 1);
                corners.gather::<$d, $f>(&corners.weight, table, out, stride, column, count);
                for axis in 0..groups - 1 {
                    let slopes = &corners.slope[(axis << $d) * corners.lanes..];
                    corners.gather::<$d, $f>(slopes, table, &mut out[(axis + 1) * group * stride..], stride, column, count);
                }
            }};
        }
        dispatch!(shape.inputs(), shape.features, level);
    }
}

/// Adds the gradient of the features of level `number` to its table gradient, for one tile. `gradient` has a row of `stride` values a sample;
/// further groups of rows are `group` rows apart.
pub(super) fn scatter_level(
    shape: &Architecture,
    number: usize,
    level: &Level,
    coordinates: &[f32],
    run: usize,
    count: usize,
    groups: usize,
    group: usize,
    gradient: &[f32],
    stride: usize,
    corners: &mut Corners,
    table: &mut [f32],
    touched: &mut [u8],
) {
    assert!(table.len() == level.entries * shape.features);
    let column = number * shape.features;
    macro_rules! level {
        ($d:literal, $f:literal) => {{
            corners.locate::<$d>(level, coordinates, run, count, groups > 1);
            corners.scatter::<$d, $f>(&corners.weight, gradient, stride, column, table, touched, count);
            for axis in 0..groups - 1 {
                let slopes = &corners.slope[(axis << $d) * corners.lanes..];
                corners.scatter::<$d, $f>(slopes, &gradient[(axis + 1) * group * stride..], stride, column, table, touched, count);
            }
        }};
    }
    dispatch!(shape.inputs(), shape.features, level);
}

/// sin and cos of 2^l (pi/2) p with p = 2x - 1 in [-1, 1], ordered axis, octave, (sin, cos).
fn frequencies(
    shape: &Architecture,
    coordinates: &[f32],
    run: usize,
    count: usize,
    groups: usize,
    group: usize,
    out: &mut [f32],
    stride: usize,
) {
    let (inputs, octaves) = (shape.inputs(), shape.octaves);
    assert!(stride >= 2 * inputs * octaves);
    for first in (0..count).step_by(8) {
        let take = (count - first).min(8);
        for axis in 0..inputs {
            let x = lanes(&coordinates[axis * run + first..]).fast_max(f32x8::splat(0.0)).fast_min(f32x8::splat(1.0));
            let position = x + x - f32x8::splat(1.0);
            for octave in 0..octaves {
                let frequency = FRAC_PI_2 * (1_u32 << octave) as f32;
                let (sin, cos) = (position * f32x8::splat(frequency)).sin_cos();
                let (sin, cos) = (sin.to_array(), cos.to_array());
                let column = 2 * (axis * octaves + octave);
                for lane in 0..take {
                    let row = first + lane;
                    out[row * stride + column] = sin[lane];
                    out[row * stride + column + 1] = cos[lane];
                    for along in 0..groups - 1 {
                        let row = (along + 1) * group + row;
                        let slope = if along == axis { 2.0 * frequency } else { 0.0 };
                        out[row * stride + column] = slope * cos[lane];
                        out[row * stride + column + 1] = -slope * sin[lane];
                    }
                }
            }
        }
    }
}
