//! Encodings of the positions of a tile, their derivatives along the axes, and the gradient of the hash tables.
//!
//! Hash grid: Müller, Evans, Schied and Keller 2022 (Instant neural graphics primitives with a multiresolution hash encoding, ACM
//! Transactions on Graphics 41). On every level, the features of a position are interpolated multilinearly between the table entries of the
//! corners of its cell. Entries of fine levels are found by a spatial hash; collisions are left to the MLP.
//!
//! Frequencies: Mildenhall et al. 2020 (NeRF: representing scenes as neural radiance fields for view synthesis, ECCV), equation 4, with
//! half the base frequency: sin and cos of 2^l (pi / 2) p for p = 2x - 1 in [-1, 1].

use super::architecture::{Architecture, HASH, Level};
use super::memory::{LINE, TILE_ROWS, load, row_stride};
use std::f32::consts::FRAC_PI_2;
use wide::{f32x8, i32x8};

/// Positions of a tile, and the arrangement of the rows of features that belong to them.
#[derive(Clone, Copy)]
pub(super) struct Positions<'a> {
    /// Unit coordinates, `[input][sample]`.
    pub(super) coordinates: &'a [[f32; TILE_ROWS]],
    /// Samples in use.
    pub(super) count: usize,
    /// Groups of rows: the features, then their derivatives along each axis of the domain, if any.
    pub(super) groups: usize,
    /// Rows of a group.
    pub(super) group_rows: usize,
}

/// The corners of the cell around each sample of a tile, for one level.
pub(super) struct Corners {
    /// Table entries, `[corner][sample]`.
    entries: Vec<[u32; TILE_ROWS]>,
    /// Factors of the entries, `[group][corner][sample]`: the multilinear weights, then their derivatives along each axis.
    factors: Vec<[f32; TILE_ROWS]>,
}

/// The features of one level in rows of features.
#[derive(Clone, Copy)]
struct Columns {
    first: usize,
    stride: usize,
    rows: usize,
}

impl Corners {
    /// Memory for one tile; empty for the frequency encoding, which has no cells.
    pub(super) fn new(shape: &Architecture) -> Self {
        let corners = if shape.levels.is_empty() { 0 } else { 1 << shape.inputs() };
        Self { entries: vec![[0; TILE_ROWS]; corners], factors: vec![[0.0; TILE_ROWS]; corners * (1 + shape.dimensions())] }
    }

    /// Finds the entries and the factors of all samples. Coordinates out of range and NaN are clamped, so that every entry is below
    /// `level.entries`.
    fn locate<const D: usize>(&mut self, level: &Level, positions: Positions<'_>) {
        let (zero, one) = (f32x8::splat(0.0), f32x8::splat(1.0));
        let mask = i32x8::splat((level.entries - 1) as i32);
        for first in (0..positions.count).step_by(8) {
            // The lower and the upper node along each axis, as parts of an index, and their weights.
            let mut nodes = [[i32x8::splat(0); 2]; D];
            let mut weights = [[zero; 2]; D];
            let mut stride = 1_i32;
            for axis in 0..D {
                let cells = level.cells[axis];
                let position = load(&positions.coordinates[axis][first..]).fast_max(zero).fast_min(one) * f32x8::splat(cells as f32);
                let cell = position.fast_trunc_int().max(i32x8::splat(0)).min(i32x8::splat(cells as i32 - 1));
                let fraction = position - f32x8::from_i32x8(cell);
                let factor = if level.hashed { HASH[axis] as i32 } else { stride };
                let lower = cell * i32x8::splat(factor);
                nodes[axis] = [lower, lower + i32x8::splat(factor)];
                weights[axis] = [one - fraction, fraction];
                stride = stride.wrapping_mul(cells as i32 + 1);
            }
            for corner in 0..1 << D {
                let side = |axis: usize| (corner >> axis) & 1;
                let mut entry = nodes[0][side(0)];
                for axis in 1..D {
                    let node = nodes[axis][side(axis)];
                    entry = if level.hashed { entry ^ node } else { entry + node };
                }
                if level.hashed {
                    entry &= mask;
                }
                self.entries[corner][first..first + 8].copy_from_slice(&entry.to_array().map(|entry| entry as u32));
                for group in 0..positions.groups {
                    let mut factor = one;
                    for axis in 0..D {
                        factor *= if group == axis + 1 {
                            let cells = level.cells[axis] as f32;
                            f32x8::splat(if side(axis) == 1 { cells } else { -cells })
                        } else {
                            weights[axis][side(axis)]
                        };
                    }
                    self.factors[(group << D) + corner][first..first + 8].copy_from_slice(&factor.to_array());
                }
            }
        }
    }

    /// Writes the sum of `factor * entry` over the corners into the level's columns of `out`.
    fn gather<const D: usize, const F: usize>(&self, group: usize, table: &[[f32; F]], out: &mut [f32], columns: Columns) {
        let (entries, factors) = (&self.entries[..1 << D], &self.factors[group << D..][..1 << D]);
        for (sample, row) in out.chunks_exact_mut(columns.stride).take(columns.rows.min(TILE_ROWS)).enumerate() {
            let mut sum = [0.0_f32; F];
            for (entry, factor) in entries.iter().zip(factors) {
                // SAFETY: `locate` keeps every entry below the level's, and the caller passes that level's table.
                let features = unsafe { table.get_unchecked(entry[sample] as usize) };
                for (sum, feature) in sum.iter_mut().zip(features) {
                    *sum = factor[sample].mul_add(*feature, *sum);
                }
            }
            row[columns.first..columns.first + F].copy_from_slice(&sum);
        }
    }

    /// Adds `factor * gradient` to the entries of the corners, for the level's columns of `gradient`, and marks the cache lines of
    /// the entries in `touched`.
    fn scatter<const D: usize, const F: usize>(
        &self,
        group: usize,
        gradient: &[f32],
        columns: Columns,
        table: &mut [[f32; F]],
        touched: &mut [u8],
    ) {
        assert!(touched.len() >= table.as_flattened().len().div_ceil(LINE));
        let (entries, factors) = (&self.entries[..1 << D], &self.factors[group << D..][..1 << D]);
        for (sample, row) in gradient.chunks_exact(columns.stride).take(columns.rows.min(TILE_ROWS)).enumerate() {
            let mut gradient = [0.0_f32; F];
            gradient.copy_from_slice(&row[columns.first..columns.first + F]);
            for (entry, factor) in entries.iter().zip(factors) {
                // Read before any store, so that the features are updated as one vector.
                let (entry, factor) = (entry[sample] as usize, factor[sample]);
                // SAFETY: as in `gather`; the entry's line has a mark.
                let features = unsafe {
                    *touched.get_unchecked_mut(entry * F / LINE) = 1;
                    table.get_unchecked_mut(entry)
                };
                for (feature, gradient) in features.iter_mut().zip(&gradient) {
                    *feature = factor.mul_add(*gradient, *feature);
                }
            }
        }
    }
}

/// Calls the instance for the numbers of inputs and features.
macro_rules! dispatch {
    ($shape:expr, $call:ident) => {
        match ($shape.inputs(), $shape.features) {
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

/// Encodes a tile into rows of `out`, [`row_stride`] apart.
pub(super) fn encode(shape: &Architecture, tables: &[f32], positions: Positions<'_>, corners: &mut Corners, out: &mut [f32]) {
    if shape.levels.is_empty() {
        return frequencies(shape, positions, out);
    }
    let stride = row_stride(shape.encoded());
    assert!(tables.len() == shape.table_entries() * shape.features);
    for (number, level) in shape.levels.iter().enumerate() {
        let table = &tables[level.offset * shape.features..][..level.entries * shape.features];
        let columns = Columns { first: number * shape.features, stride, rows: positions.count };
        macro_rules! level {
            ($d:literal, $f:literal) => {{
                corners.locate::<$d>(level, positions);
                for group in 0..positions.groups {
                    let out = &mut out[group * positions.group_rows * stride..];
                    corners.gather::<$d, $f>(group, table.as_chunks().0, out, columns);
                }
            }};
        }
        dispatch!(shape, level);
    }
}

/// Adds the gradient of level `number` to that of its table, for one tile. The rows of `gradient` lie [`row_stride`] apart.
pub(super) fn scatter_level(
    shape: &Architecture,
    number: usize,
    positions: Positions<'_>,
    gradient: &[f32],
    corners: &mut Corners,
    table: &mut [f32],
    touched: &mut [u8],
) {
    let (level, stride) = (&shape.levels[number], row_stride(shape.encoded()));
    assert!(table.len() == level.entries * shape.features);
    let columns = Columns { first: number * shape.features, stride, rows: positions.count };
    macro_rules! level {
        ($d:literal, $f:literal) => {{
            corners.locate::<$d>(level, positions);
            for group in 0..positions.groups {
                let gradient = &gradient[group * positions.group_rows * stride..];
                corners.scatter::<$d, $f>(group, gradient, columns, table.as_chunks_mut().0, touched);
            }
        }};
    }
    dispatch!(shape, level);
}

/// Frequency encoding, ordered by axis, octave, (sin, cos).
fn frequencies(shape: &Architecture, positions: Positions<'_>, out: &mut [f32]) {
    let (octaves, stride) = (shape.octaves, row_stride(shape.encoded()));
    for first in (0..positions.count).step_by(8) {
        let lanes = (positions.count - first).min(8);
        for (axis, coordinates) in positions.coordinates.iter().enumerate() {
            let x = load(&coordinates[first..]).fast_max(f32x8::splat(0.0)).fast_min(f32x8::splat(1.0));
            let position = x + x - f32x8::splat(1.0);
            for octave in 0..octaves {
                let frequency = FRAC_PI_2 * (1_u32 << octave) as f32;
                let (sin, cos) = (position * f32x8::splat(frequency)).sin_cos();
                let (sin, cos) = (sin.to_array(), cos.to_array());
                let column = 2 * (axis * octaves + octave);
                for lane in 0..lanes {
                    for group in 0..positions.groups {
                        let slope = if group == axis + 1 { 2.0 * frequency } else { 0.0 };
                        let pair = if group == 0 { [sin[lane], cos[lane]] } else { [slope * cos[lane], -slope * sin[lane]] };
                        let row = group * positions.group_rows + first + lane;
                        out[row * stride + column..][..2].copy_from_slice(&pair);
                    }
                }
            }
        }
    }
}
