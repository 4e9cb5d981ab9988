//! Fully connected layers on a tile of rows: Y = X W + b, its gradient for X, and its gradient for W.
//!
//! All three are register-blocked products of a broadcast scalar and a row of [`PANEL`] weights: six rows by two vectors, so that
//! twelve accumulators hide the latency of the multiply-adds (two a cycle on Zen 3); where the processor has AVX-512, `dense512` does
//! the same with registers twice as wide. Rows are samples, so no activation is ever
//! transposed; weights are packed into panels once a step, which costs little beside a batch of thousands.
//!
//! Rows come in groups of `primal` rows: the first group are values, the further ones tangents (derivatives along one input axis). A
//! tangent has no bias and takes the ReLU mask of its value, because the network is linear between the kinks.

use super::architecture::{Layer, PANEL, padded};
#[cfg(target_arch = "x86_64")]
use super::dense512;
use super::lanes::{Aligned, load, store};
use wide::f32x8;

/// Rows computed at once. Tiles have a multiple of it in each group.
pub(super) const BLOCK: usize = 6;

/// A layer's weights in panels: `[panel][input][PANEL]`, then the padded biases; and the transpose `[panel][output][PANEL]` for the way back.
pub(super) struct Packed {
    pub(super) inputs: usize,
    pub(super) outputs: usize,
    pub(super) forward: Aligned,
    pub(super) backward: Aligned,
}

/// Length of a layer's packed weights and biases (and of their packed gradient).
pub(super) fn packed_len(layer: &Layer) -> usize {
    (layer.inputs + 1) * padded(layer.outputs)
}

/// Calls `place(packed index, flat index)` for every parameter of the layer.
pub(super) fn for_each_parameter(layer: &Layer, mut place: impl FnMut(usize, usize)) {
    for input in 0..layer.inputs {
        for output in 0..layer.outputs {
            place((output / PANEL * layer.inputs + input) * PANEL + output % PANEL, layer.weights + input * layer.outputs + output);
        }
    }
    let biases = layer.inputs * padded(layer.outputs);
    for output in 0..layer.outputs {
        place(biases + output, layer.biases + output);
    }
}

impl Packed {
    /// Room for a layer; `transposed` when the gradient for its input will be asked for.
    pub(super) fn new(layer: &Layer, transposed: bool) -> Self {
        let backward = if transposed { padded(layer.inputs) * layer.outputs } else { 0 };
        Self {
            inputs: layer.inputs,
            outputs: layer.outputs,
            forward: Aligned::zeros(packed_len(layer)),
            backward: Aligned::zeros(backward),
        }
    }

    /// Copies the layer's parameters out of the flat vector.
    pub(super) fn fill(&mut self, layer: &Layer, flat: &[f32]) {
        let forward = &mut self.forward[..];
        for_each_parameter(layer, |to, from| forward[to] = flat[from]);
        if !self.backward.is_empty() {
            for input in 0..layer.inputs {
                let row = &flat[layer.weights + input * layer.outputs..][..layer.outputs];
                for (output, &weight) in row.iter().enumerate() {
                    self.backward[(input / PANEL * layer.outputs + output) * PANEL + input % PANEL] = weight;
                }
            }
        }
    }
}

/// `X[M rows] * panel`, over `depth` inputs, for the first eight columns of a panel whose others are padding.
///
/// # Safety
/// As for [`product`].
#[inline(always)]
unsafe fn half_product<const M: usize>(x: *const f32, stride: usize, depth: usize, panel: *const f32) -> [f32x8; M] {
    let mut sums = [f32x8::splat(0.0); M];
    for k in 0..depth {
        // SAFETY: k < depth, so both reads lie inside what the caller promised.
        unsafe {
            let low = load(panel.add(k * PANEL));
            for (m, sum) in sums.iter_mut().enumerate() {
                *sum = f32x8::splat(*x.add(m * stride + k)).mul_add(low, *sum);
            }
        }
    }
    sums
}

/// `init + X[M rows] * panel`, over `depth` inputs.
///
/// # Safety
/// `x` points to M rows of at least `depth` values, `stride` apart; `panel` to `depth * PANEL` values.
#[inline(always)]
unsafe fn product<const M: usize>(x: *const f32, stride: usize, depth: usize, panel: *const f32, init: [f32x8; 2]) -> [[f32x8; 2]; M] {
    let mut sums = [init; M];
    for k in 0..depth {
        // SAFETY: k < depth, so both reads lie inside what the caller promised.
        unsafe {
            let low = load(panel.add(k * PANEL));
            let high = load(panel.add(k * PANEL + 8));
            for (m, sum) in sums.iter_mut().enumerate() {
                let value = f32x8::splat(*x.add(m * stride + k));
                sum[0] = value.mul_add(low, sum[0]);
                sum[1] = value.mul_add(high, sum[1]);
            }
        }
    }
    sums
}

/// Y = relu(X W + b) on `rows` rows; tangent rows: (X W) where the value row's Y is above 0. `rows` and `primal` are multiples of [`BLOCK`].
pub(super) fn forward(layer: &Packed, x: &[f32], x_stride: usize, y: &mut [f32], y_stride: usize, rows: usize, primal: usize) {
    let (depth, wide) = (layer.inputs, padded(layer.outputs));
    assert!(rows.is_multiple_of(BLOCK) && primal.is_multiple_of(BLOCK) && x_stride >= depth && y_stride >= wide);
    assert!(rows == 0 || (x.len() >= rows * x_stride && y.len() >= rows * y_stride));
    #[cfg(target_arch = "x86_64")]
    if dense512::available() {
        // SAFETY: AVX-512 was found, and the asserts hold.
        return unsafe { dense512::forward(layer, x, x_stride, y, y_stride, rows, primal) };
    }
    forward_256(layer, x, x_stride, y, y_stride, rows, primal);
}

fn forward_256(layer: &Packed, x: &[f32], x_stride: usize, y: &mut [f32], y_stride: usize, rows: usize, primal: usize) {
    let (depth, wide) = (layer.inputs, padded(layer.outputs));
    let biases = depth * wide;
    let zero = f32x8::splat(0.0);
    for panel in 0..wide / PANEL {
        let column = panel * PANEL;
        for row in (0..rows).step_by(BLOCK) {
            // SAFETY: the asserts above bound x and y; `forward` holds (depth + 1) * wide values; row - row % primal is a row before this one.
            unsafe {
                let weights = layer.forward.as_ptr().add(column * depth);
                let bias = layer.forward.as_ptr().add(biases + column);
                let init = if row < primal { [load(bias), load(bias.add(8))] } else { [zero; 2] };
                let value_row = row % primal;
                let sums = product::<BLOCK>(x.as_ptr().add(row * x_stride), x_stride, depth, weights, init);
                for (m, sum) in sums.into_iter().enumerate() {
                    let out = y.as_mut_ptr().add((row + m) * y_stride + column);
                    let value = y.as_ptr().add((value_row + m) * y_stride + column);
                    for (half, sum) in sum.into_iter().enumerate() {
                        // `max(0, sum)` in this order lets NaN through, so that a diverged network is seen and not painted black.
                        let passed = if row < primal { zero.fast_max(sum) } else { load(value.add(8 * half)).simd_gt(zero) & sum };
                        store(out.add(8 * half), passed);
                    }
                }
            }
        }
    }
}

/// dX = dZ W^T, kept only where `active` (the value rows of X itself) is above 0; no mask for an encoded input.
pub(super) fn input_gradient(
    layer: &Packed,
    dz: &[f32],
    dz_stride: usize,
    dx: &mut [f32],
    dx_stride: usize,
    active: Option<&[f32]>,
    rows: usize,
    primal: usize,
) {
    let (depth, wide) = (layer.outputs, padded(layer.inputs));
    assert!(rows.is_multiple_of(BLOCK) && primal.is_multiple_of(BLOCK) && dz_stride >= depth && dx_stride >= wide);
    assert!(dz.len() >= rows * dz_stride && dx.len() >= rows * dx_stride && layer.backward.len() == depth * wide);
    assert!(active.is_none_or(|a| a.len() >= primal * dx_stride));
    #[cfg(target_arch = "x86_64")]
    if dense512::available() {
        // SAFETY: AVX-512 was found, and the asserts hold.
        return unsafe { dense512::input_gradient(layer, dz, dz_stride, dx, dx_stride, active, rows, primal) };
    }
    input_gradient_256(layer, dz, dz_stride, dx, dx_stride, active, rows, primal);
}

fn input_gradient_256(
    layer: &Packed,
    dz: &[f32],
    dz_stride: usize,
    dx: &mut [f32],
    dx_stride: usize,
    active: Option<&[f32]>,
    rows: usize,
    primal: usize,
) {
    let (depth, wide) = (layer.outputs, padded(layer.inputs));
    let zero = f32x8::splat(0.0);
    for panel in 0..wide / PANEL {
        let column = panel * PANEL;
        for row in (0..rows).step_by(BLOCK) {
            // SAFETY: the asserts above bound every buffer.
            unsafe {
                let weights = layer.backward.as_ptr().add(column * depth);
                let dz = dz.as_ptr().add(row * dz_stride);
                if layer.inputs - column <= PANEL / 2 && active.is_none() {
                    for (m, sum) in half_product::<BLOCK>(dz, dz_stride, depth, weights).into_iter().enumerate() {
                        store(dx.as_mut_ptr().add((row + m) * dx_stride + column), sum);
                    }
                    continue;
                }
                let sums = product::<BLOCK>(dz, dz_stride, depth, weights, [zero; 2]);
                let value_row = row % primal;
                for (m, sum) in sums.into_iter().enumerate() {
                    let out = dx.as_mut_ptr().add((row + m) * dx_stride + column);
                    for (half, sum) in sum.into_iter().enumerate() {
                        let kept = match active {
                            Some(a) => {
                                let value = load(a.as_ptr().add((value_row + m) * dx_stride + column + 8 * half));
                                value.simd_gt(zero) & sum
                            }
                            None => sum,
                        };
                        store(out.add(8 * half), kept);
                    }
                }
            }
        }
    }
}

/// Adds X^T dZ (and the column sums of the value rows of dZ) to the packed gradient.
pub(super) fn weight_gradient(
    inputs: usize,
    outputs: usize,
    x: &[f32],
    x_stride: usize,
    dz: &[f32],
    dz_stride: usize,
    gradient: &mut [f32],
    rows: usize,
    primal: usize,
) {
    let wide = padded(outputs);
    assert!(x_stride >= inputs && dz_stride >= wide && gradient.len() == (inputs + 1) * wide);
    assert!(x.len() >= rows * x_stride && dz.len() >= rows * dz_stride && primal <= rows);
    #[cfg(target_arch = "x86_64")]
    if dense512::available() {
        // SAFETY: AVX-512 was found, and the asserts hold.
        return unsafe { dense512::weight_gradient(inputs, outputs, x, x_stride, dz, dz_stride, gradient, rows, primal) };
    }
    weight_gradient_256(inputs, outputs, x, x_stride, dz, dz_stride, gradient, rows, primal);
}

fn weight_gradient_256(
    inputs: usize,
    outputs: usize,
    x: &[f32],
    x_stride: usize,
    dz: &[f32],
    dz_stride: usize,
    gradient: &mut [f32],
    rows: usize,
    primal: usize,
) {
    let wide = padded(outputs);
    for panel in 0..wide / PANEL {
        let column = panel * PANEL;
        let mut input = 0;
        while input < inputs {
            let take = (inputs - input).min(BLOCK);
            // SAFETY: input + take <= inputs <= x_stride and column + PANEL <= wide <= dz_stride; the asserts above bound the buffers.
            unsafe {
                let x = x.as_ptr().add(input);
                let dz = dz.as_ptr().add(column);
                let sum = gradient.as_mut_ptr().add(column * inputs + input * PANEL);
                match take {
                    6 => outer::<6>(x, x_stride, dz, dz_stride, rows, sum),
                    5 => outer::<5>(x, x_stride, dz, dz_stride, rows, sum),
                    4 => outer::<4>(x, x_stride, dz, dz_stride, rows, sum),
                    3 => outer::<3>(x, x_stride, dz, dz_stride, rows, sum),
                    2 => outer::<2>(x, x_stride, dz, dz_stride, rows, sum),
                    _ => outer::<1>(x, x_stride, dz, dz_stride, rows, sum),
                }
            }
            input += take;
        }
        // SAFETY: column + PANEL <= wide bounds the biases, row < primal <= rows the rows.
        unsafe {
            let biases = gradient.as_mut_ptr().add(inputs * wide + column);
            let mut sums = [load(biases), load(biases.add(8))];
            for row in 0..primal {
                let dz = dz.as_ptr().add(row * dz_stride + column);
                sums[0] += load(dz);
                sums[1] += load(dz.add(8));
            }
            store(biases, sums[0]);
            store(biases.add(8), sums[1]);
        }
    }
}

/// sum[m][PANEL] += over rows of x[row][m] * dz[row][PANEL].
///
/// # Safety
/// `x` and `dz` point to `rows` rows of M and PANEL values; `sum` to M * PANEL writable values.
#[inline(always)]
unsafe fn outer<const M: usize>(x: *const f32, x_stride: usize, dz: *const f32, dz_stride: usize, rows: usize, sum: *mut f32) {
    // SAFETY: all indices stay inside what the caller promised.
    unsafe {
        let mut sums: [[f32x8; 2]; M] = std::array::from_fn(|m| [load(sum.add(m * PANEL)), load(sum.add(m * PANEL + 8))]);
        for row in 0..rows {
            let low = load(dz.add(row * dz_stride));
            let high = load(dz.add(row * dz_stride + 8));
            for (m, sum) in sums.iter_mut().enumerate() {
                let value = f32x8::splat(*x.add(row * x_stride + m));
                sum[0] = value.mul_add(low, sum[0]);
                sum[1] = value.mul_add(high, sum[1]);
            }
        }
        for (m, values) in sums.into_iter().enumerate() {
            store(sum.add(m * PANEL), values[0]);
            store(sum.add(m * PANEL + 8), values[1]);
        }
    }
}

#[cfg(all(test, target_arch = "x86_64"))]
mod tests {
    use super::*;
    use std::io::Write;

    fn values(count: usize, seed: u32) -> Vec<f32> {
        let mut state = seed;
        let mut next = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 8) as f32 / (1 << 23) as f32 - 1.0
        };
        (0..count).map(|_| next()).collect()
    }

    /// Widths with whole and half panels, an odd number of them, inputs that are no multiple of the block, tangent rows, and a NaN.
    #[test]
    fn both_widths_of_registers_give_the_same_bits() {
        if !dense512::available() {
            // Nothing to compare: this processor always takes the narrower way, which the gradient tests check. Past the capture of tests that pass.
            writeln!(std::io::stderr(), "NOT RUN: both_widths_of_registers_give_the_same_bits, since this processor has no AVX-512")
                .unwrap();
            return;
        }
        for (inputs, outputs, rows, primal) in [(24, 64, 48, 48), (64, 64, 36, 12), (40, 33, 12, 12), (7, 16, 6, 6), (64, 1, 24, 24)] {
            let shape = Layer { inputs, outputs, weights: 0, biases: inputs * outputs };
            let mut layer = Packed::new(&shape, true);
            layer.fill(&shape, &values((inputs + 1) * outputs, 1));
            let (x_stride, y_stride) = (padded(inputs), padded(outputs));
            let mut x = values(rows * x_stride, 2);
            x[0] = f32::NAN;
            let dz = values(rows * y_stride, 3);
            let bits = |values: &[f32]| values.iter().map(|v| if v.is_nan() { u32::MAX } else { v.to_bits() }).collect::<Vec<_>>();

            let (mut narrow, mut wide) = (values(rows * y_stride, 4), values(rows * y_stride, 4));
            forward_256(&layer, &x, x_stride, &mut narrow, y_stride, rows, primal);
            // SAFETY: AVX-512 is there, and the buffers have the lengths that `forward` asserts.
            unsafe { dense512::forward(&layer, &x, x_stride, &mut wide, y_stride, rows, primal) };
            assert!(narrow[0].is_nan());
            assert_eq!(bits(&narrow), bits(&wide), "forward {inputs} {outputs}");

            for active in [None, Some(&x[..])] {
                let (mut narrow, mut wide) = (values(rows * x_stride, 5), values(rows * x_stride, 5));
                input_gradient_256(&layer, &dz, y_stride, &mut narrow, x_stride, active, rows, primal);
                // SAFETY: as above.
                unsafe { dense512::input_gradient(&layer, &dz, y_stride, &mut wide, x_stride, active, rows, primal) };
                assert_eq!(bits(&narrow), bits(&wide), "input gradient {inputs} {outputs} {}", active.is_some());
            }

            let start = values((inputs + 1) * y_stride, 6);
            let (mut narrow, mut wide) = (start.clone(), start);
            weight_gradient_256(inputs, outputs, &x, x_stride, &dz, y_stride, &mut narrow, rows, primal);
            // SAFETY: as above.
            unsafe { dense512::weight_gradient(inputs, outputs, &x, x_stride, &dz, y_stride, &mut wide, rows, primal) };
            assert_eq!(bits(&narrow), bits(&wide), "weight gradient {inputs} {outputs}");
        }
    }
}
