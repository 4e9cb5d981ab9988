//! Fully connected layers on a tile of samples: Y = ReLU(X W + b), and its gradients for X and for W.
//!
//! Source: the fully fused MLP of Müller et al. 2021 (Real-time neural radiance caching for path tracing, ACM Transactions on Graphics
//! 40), for a CPU: the activations of a tile stay in the cache from layer to layer. All products are register-blocked: six rows by two
//! vector registers, so that twelve accumulators hide the latency of the multiply-adds. Rows are samples, so no activation is transposed;
//! weights are packed into panels of [`PANEL`] columns once a step, which costs little beside a batch of thousands.
//!
//! The kernels are generic over the vector registers (`pulp`), and the widest registers of the processor are chosen at run time. Every
//! output is summed in the same order with all of them, so all give the same bits.
//!
//! Rows come in groups of [`Rows::values`] rows: the first group holds values, the others hold tangents (derivatives along one input
//! axis). A tangent has no bias and takes the ReLU mask of its value, because the network is linear between the kinks.

use super::architecture::Layer;
use super::memory::{Aligned, BLOCK, PANEL, padded, row_stride};
use pulp::{Arch, Simd, WithSimd};

/// Rows of a tile that are computed; both numbers are multiples of [`BLOCK`].
#[derive(Debug, Clone, Copy)]
pub(super) struct Rows {
    /// Rows of all groups.
    pub(super) all: usize,
    /// Rows of the first group, the values; each further group has as many.
    pub(super) values: usize,
}

/// Weights of a layer in panels `[panel][input][PANEL]`, then the padded biases; and the transpose `[panel][output][PANEL]` for gradients.
pub(super) struct PackedLayer {
    inputs: usize,
    outputs: usize,
    forward: Aligned,
    backward: Aligned,
}

/// Length of a layer's packed weights and biases (and of their packed gradient).
pub(super) fn packed_len(layer: &Layer) -> usize {
    (layer.inputs + 1) * padded(layer.outputs)
}

/// Position of the first weight of `column` in panels of `depth` rows.
fn in_panels(column: usize, depth: usize) -> usize {
    column / PANEL * PANEL * depth + column % PANEL
}

/// Calls `place(packed index, flat index)` for every parameter of the layer.
pub(super) fn for_each_parameter(layer: &Layer, mut place: impl FnMut(usize, usize)) {
    for input in 0..layer.inputs {
        for output in 0..layer.outputs {
            place(in_panels(output, layer.inputs) + input * PANEL, layer.weights + input * layer.outputs + output);
        }
    }
    let biases = layer.inputs * padded(layer.outputs);
    for output in 0..layer.outputs {
        place(biases + output, layer.biases + output);
    }
}

impl PackedLayer {
    /// Room for a layer; `transposed` adds the weights that [`input_gradient`] needs.
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
        for_each_parameter(layer, |to, from| self.forward[to] = flat[from]);
        if !self.backward.is_empty() {
            for input in 0..layer.inputs {
                let row = &flat[layer.weights + input * layer.outputs..][..layer.outputs];
                for (output, &weight) in row.iter().enumerate() {
                    self.backward[in_panels(input, layer.outputs) + output * PANEL] = weight;
                }
            }
        }
    }
}

/// Y = ReLU(X W + b); tangent rows: X W where Y of the value row is above 0. Rows of X and Y lie [`row_stride`] apart.
pub(super) fn forward(layer: &PackedLayer, x: &[f32], y: &mut [f32], rows: Rows) {
    Arch::new().dispatch(Product::forward(layer, x, y, rows));
}

/// dX = dZ W^T, kept only where `active` (the value rows of X itself) is above 0; no mask for encoded inputs.
pub(super) fn input_gradient(layer: &PackedLayer, dz: &[f32], dx: &mut [f32], active: Option<&[f32]>, rows: Rows) {
    Arch::new().dispatch(Product::input_gradient(layer, dz, dx, active, rows));
}

/// Adds X^T dZ and, as the gradient of the biases, the column sums of the value rows of dZ to the packed gradient.
pub(super) fn weight_gradient(layer: &PackedLayer, x: &[f32], dz: &[f32], gradient: &mut [f32], rows: Rows) {
    Arch::new().dispatch(WeightGradient { layer, x, dz, gradient, rows });
}

/// The sums of a product that become 0.
#[derive(Clone, Copy)]
enum Mask<'a> {
    /// Negative sums; in tangent rows those whose value became 0.
    Relu,
    /// Sums whose value row here is not above 0.
    Inactive(&'a [f32]),
    /// None.
    Nothing,
}

/// Y = mask(X P + b) for panels P of `depth` rows.
struct Product<'a> {
    x: &'a [f32],
    depth: usize,
    panels: &'a [f32],
    /// Added to value rows.
    biases: Option<&'a [f32]>,
    y: &'a mut [f32],
    columns: usize,
    mask: Mask<'a>,
    rows: Rows,
}

impl<'a> Product<'a> {
    fn forward(layer: &'a PackedLayer, x: &'a [f32], y: &'a mut [f32], rows: Rows) -> Self {
        let (panels, biases) = layer.forward.split_at(layer.inputs * padded(layer.outputs));
        Self { x, depth: layer.inputs, panels, biases: Some(biases), y, columns: layer.outputs, mask: Mask::Relu, rows }
    }

    fn input_gradient(layer: &'a PackedLayer, dz: &'a [f32], dx: &'a mut [f32], active: Option<&'a [f32]>, rows: Rows) -> Self {
        let mask = active.map_or(Mask::Nothing, Mask::Inactive);
        Self { x: dz, depth: layer.outputs, panels: &layer.backward, biases: None, y: dx, columns: layer.inputs, mask, rows }
    }

    /// Checks all lengths that the unsafe code relies on.
    fn check(&self) {
        let (all, values, columns) = (self.rows.all, self.rows.values, padded(self.columns));
        assert!(all.is_multiple_of(BLOCK) && values.is_multiple_of(BLOCK) && values <= all);
        assert!(self.panels.len() == self.depth * columns && self.biases.is_none_or(|biases| biases.len() == columns));
        assert!(self.x.len() >= all * row_stride(self.depth) && self.y.len() >= all * row_stride(self.columns));
        if let Mask::Inactive(values) = self.mask {
            assert!(values.len() >= self.rows.values * row_stride(self.columns));
        }
    }

    /// Computes N registers of columns, from `column` on.
    ///
    /// # Safety
    /// [`Self::check`] passed, and `column + N * S::F32_LANES` is at most the padded number of columns.
    #[inline(always)]
    unsafe fn compute<S: Simd, const N: usize>(&mut self, simd: S, column: usize) {
        let (depth, rows, y) = (self.depth, self.rows, self.y.as_mut_ptr());
        let (x_stride, y_stride) = (row_stride(depth), row_stride(self.columns));
        let zero = simd.splat_f32s(0.0);
        let where_positive = |value, sum| simd.select_f32s(simd.greater_than_f32s(value, zero), sum, zero);
        let columns: [usize; N] = std::array::from_fn(|n| column + n * S::F32_LANES);
        for row in (0..rows.all).step_by(BLOCK) {
            let is_value = row < rows.values;
            let value_row = row % rows.values;
            // SAFETY: `check` bounds every buffer: a block has BLOCK whole rows, the panels have `depth` rows, and the columns end at most
            // at the padded number of columns, which is at most `y_stride`.
            unsafe {
                let panels = columns.map(|column| self.panels.as_ptr().add(in_panels(column, depth)));
                let start = match self.biases {
                    Some(biases) if is_value => columns.map(|column| load::<S>(biases.as_ptr().add(column))),
                    _ => [zero; N],
                };
                let x = Strided { at: self.x.as_ptr().add(row * x_stride), row: x_stride, term: 1 };
                let sums = multiply_add::<S, BLOCK, N>(simd, [start; BLOCK], depth, x, panels, PANEL);
                for (m, sums) in sums.into_iter().enumerate() {
                    for (column, sum) in columns.into_iter().zip(sums) {
                        let value = (value_row + m) * y_stride + column;
                        let kept = match self.mask {
                            // NaN passes, so that a diverged network is seen and not painted black.
                            Mask::Relu if is_value => simd.select_f32s(simd.less_than_or_equal_f32s(sum, zero), zero, sum),
                            Mask::Relu => where_positive(load::<S>(y.add(value)), sum),
                            Mask::Inactive(values) => where_positive(load::<S>(values.as_ptr().add(value)), sum),
                            Mask::Nothing => sum,
                        };
                        store::<S>(y.add((row + m) * y_stride + column), kept);
                    }
                }
            }
        }
    }
}

impl WithSimd for Product<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        self.check();
        // The padding of a gradient for encoded inputs is never read.
        let columns = if let Mask::Nothing = self.mask { self.columns } else { padded(self.columns) };
        for column in (0..columns).step_by(2 * S::F32_LANES) {
            // SAFETY: checked above; panels are whole registers, so the last register ends at most at the padded number of columns.
            unsafe {
                if columns - column <= S::F32_LANES {
                    self.compute::<S, 1>(simd, column);
                } else {
                    self.compute::<S, 2>(simd, column);
                }
            }
        }
    }
}

/// dW += X^T dZ and db += the column sums of the value rows of dZ.
struct WeightGradient<'a> {
    layer: &'a PackedLayer,
    x: &'a [f32],
    dz: &'a [f32],
    gradient: &'a mut [f32],
    rows: Rows,
}

impl WeightGradient<'_> {
    /// Checks all lengths that the unsafe code relies on.
    fn check(&self) {
        let Self { layer, rows, .. } = self;
        assert!(rows.values <= rows.all && self.gradient.len() == layer.forward.len());
        assert!(self.x.len() >= rows.all * row_stride(layer.inputs) && self.dz.len() >= rows.all * row_stride(layer.outputs));
    }

    /// Computes N registers of columns, from `column` on.
    ///
    /// # Safety
    /// [`Self::check`] passed, and `column + N * S::F32_LANES` is at most the padded number of outputs.
    #[inline(always)]
    unsafe fn compute<S: Simd, const N: usize>(&mut self, simd: S, column: usize) {
        let (inputs, outputs, rows) = (self.layer.inputs, self.layer.outputs, self.rows.all);
        let (x_stride, dz_stride) = (row_stride(inputs), row_stride(outputs));
        let columns: [usize; N] = std::array::from_fn(|n| column + n * S::F32_LANES);
        // SAFETY: `check` bounds every buffer; input + M <= inputs <= x_stride, and the columns end at most at dz_stride.
        unsafe {
            let dz = columns.map(|column| self.dz.as_ptr().add(column));
            for input in (0..inputs).step_by(BLOCK) {
                let x = Strided { at: self.x.as_ptr().add(input), row: 1, term: x_stride };
                let to = columns.map(|column| self.gradient.as_mut_ptr().add(in_panels(column, inputs) + input * PANEL));
                match inputs - input {
                    1 => add_product::<S, 1, N>(simd, to, rows, x, dz, dz_stride),
                    2 => add_product::<S, 2, N>(simd, to, rows, x, dz, dz_stride),
                    3 => add_product::<S, 3, N>(simd, to, rows, x, dz, dz_stride),
                    4 => add_product::<S, 4, N>(simd, to, rows, x, dz, dz_stride),
                    5 => add_product::<S, 5, N>(simd, to, rows, x, dz, dz_stride),
                    _ => add_product::<S, BLOCK, N>(simd, to, rows, x, dz, dz_stride),
                }
            }
            // A bias is the weight of an input that is always 1.
            let one = Strided { at: &1.0, row: 0, term: 0 };
            let biases = columns.map(|column| self.gradient.as_mut_ptr().add(inputs * padded(outputs) + column));
            add_product::<S, 1, N>(simd, biases, self.rows.values, one, dz, dz_stride);
        }
    }
}

impl WithSimd for WeightGradient<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        self.check();
        let columns = padded(self.layer.outputs);
        for column in (0..columns).step_by(2 * S::F32_LANES) {
            // SAFETY: checked above; panels are whole registers, so the last register ends at most at the padded number of columns.
            unsafe {
                if columns - column <= S::F32_LANES {
                    self.compute::<S, 1>(simd, column);
                } else {
                    self.compute::<S, 2>(simd, column);
                }
            }
        }
    }
}

/// A matrix whose rows lie `row` values apart, and the terms of a row `term` values.
#[derive(Clone, Copy)]
struct Strided {
    at: *const f32,
    row: usize,
    term: usize,
}

/// `sums[m][n] + ` the sum over `k < depth` of `a[m][k] * b[n][k]`, where `b[n][k]` is the register at `b[n] + k * step`.
///
/// # Safety
/// `a` has M rows of `depth` readable values, and every `b[n]` has `depth` readable registers.
#[inline(always)]
unsafe fn multiply_add<S: Simd, const M: usize, const N: usize>(
    simd: S,
    mut sums: [[S::f32s; N]; M],
    depth: usize,
    a: Strided,
    b: [*const f32; N],
    step: usize,
) -> [[S::f32s; N]; M] {
    for k in 0..depth {
        // SAFETY: k < depth, so every read lies inside the caller's promise.
        unsafe {
            let b = b.map(|b| load::<S>(b.add(k * step)));
            for (m, sums) in sums.iter_mut().enumerate() {
                let a = simd.splat_f32s(*a.at.add(m * a.row + k * a.term));
                for (sum, b) in sums.iter_mut().zip(b) {
                    *sum = simd.mul_add_f32s(a, b, *sum);
                }
            }
        }
    }
    sums
}

/// [`multiply_add`] to rows of [`PANEL`] values at `to`.
///
/// # Safety
/// As for [`multiply_add`]; every `to[n]` has M writable registers, PANEL values apart.
#[inline(always)]
unsafe fn add_product<S: Simd, const M: usize, const N: usize>(
    simd: S,
    to: [*mut f32; N],
    depth: usize,
    a: Strided,
    b: [*const f32; N],
    step: usize,
) {
    // SAFETY: promised by the caller.
    unsafe {
        let sums = std::array::from_fn(|m| to.map(|to| load::<S>(to.add(m * PANEL))));
        let sums = multiply_add::<S, M, N>(simd, sums, depth, a, b, step);
        for (m, sums) in sums.into_iter().enumerate() {
            for (to, sum) in to.into_iter().zip(sums) {
                store::<S>(to.add(m * PANEL), sum);
            }
        }
    }
}

/// # Safety
/// A register of readable values lies at `at`.
#[inline(always)]
unsafe fn load<S: Simd>(at: *const f32) -> S::f32s {
    // SAFETY: promised by the caller; the read is unaligned.
    unsafe { at.cast::<S::f32s>().read_unaligned() }
}

/// # Safety
/// A register of writable values lies at `at`.
#[inline(always)]
unsafe fn store<S: Simd>(at: *mut f32, value: S::f32s) {
    // SAFETY: promised by the caller; the write is unaligned.
    unsafe { at.cast::<S::f32s>().write_unaligned(value) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use pulp::{Scalar, Scalar512b};

    fn values(count: usize, seed: u64) -> Vec<f32> {
        (0..count as u64).map(|i| 2.0 * super::super::random::uniform(seed, i) - 1.0).collect()
    }

    /// All products of a layer of random weights, as bits.
    struct Products {
        inputs: usize,
        outputs: usize,
        rows: Rows,
    }

    impl WithSimd for Products {
        type Output = Vec<(&'static str, Vec<u32>)>;

        fn with_simd<S: Simd>(self, simd: S) -> Self::Output {
            let Self { inputs, outputs, rows } = self;
            let shape = Layer { inputs, outputs, weights: 0, biases: inputs * outputs };
            let mut layer = PackedLayer::new(&shape, true);
            layer.fill(&shape, &values((inputs + 1) * outputs, 1));
            let (x_stride, y_stride) = (row_stride(inputs), row_stride(outputs));
            let mut x = values(rows.all * x_stride, 2);
            x[0] = f32::NAN;
            let dz = values(rows.all * y_stride, 3);
            let bits = |values: &[f32]| values.iter().map(|v| if v.is_nan() { u32::MAX } else { v.to_bits() }).collect::<Vec<_>>();
            // Registers of different widths leave different parts of the padding alone.
            let columns = |values: &[f32], stride: usize, width: usize| -> Vec<u32> {
                values.chunks(stride).flat_map(|row| bits(&row[..width])).collect()
            };

            let mut y = values(rows.all * y_stride, 4);
            simd.vectorize(Product::forward(&layer, &x, &mut y, rows));
            assert!(y[0].is_nan(), "NaN passes the ReLU");
            let mut found = vec![("forward", columns(&y, y_stride, outputs))];
            for (name, active) in [("input gradient", None), ("masked input gradient", Some(&x[..]))] {
                let mut dx = values(rows.all * x_stride, 5);
                simd.vectorize(Product::input_gradient(&layer, &dz, &mut dx, active, rows));
                found.push((name, columns(&dx, x_stride, inputs)));
            }
            let mut gradient = values((inputs + 1) * padded(outputs), 6);
            simd.vectorize(WeightGradient { layer: &layer, x: &x, dz: &dz, gradient: &mut gradient, rows });
            found.push(("weight gradient", bits(&gradient)));
            found
        }
    }

    /// Widths with whole and half panels, an odd number of them, inputs that are no multiple of the block, tangent rows, and a NaN;
    /// registers of one and of sixteen lanes, and those of this processor.
    #[test]
    fn registers_of_all_widths_give_the_same_bits() {
        for (inputs, outputs, all, values) in [(24, 64, 48, 48), (64, 64, 36, 12), (40, 33, 12, 12), (7, 16, 6, 6), (64, 1, 24, 24)] {
            let products = || Products { inputs, outputs, rows: Rows { all, values } };
            let found = Arch::new().dispatch(products());
            assert_eq!(found, Scalar.vectorize(products()), "{inputs} {outputs}");
            assert_eq!(found, Scalar512b.vectorize(products()), "{inputs} {outputs}");
        }
    }
}
