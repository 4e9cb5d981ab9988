//! The products of [`super::dense`] with AVX-512: a panel of [`PANEL`] weights is one register, two panels go together, so that twelve
//! accumulators of sixteen lanes stand for twelve of eight. Every output is summed up in the same order, so that both give the same bits.

use super::architecture::{PANEL, padded};
use super::dense::{BLOCK, Packed};
use std::arch::x86_64::{
    __m512, _CMP_GT_OQ, _mm512_add_ps, _mm512_cmp_ps_mask, _mm512_fmadd_ps, _mm512_loadu_ps, _mm512_mask_storeu_ps, _mm512_maskz_mov_ps,
    _mm512_max_ps, _mm512_set1_ps, _mm512_setzero_ps, _mm512_storeu_ps,
};

/// Whether the processor has what this file needs.
pub(super) fn available() -> bool {
    std::arch::is_x86_feature_detected!("avx512f")
}

/// `init + X[BLOCK rows] * N panels`, over `depth` inputs; panels follow one another.
///
/// # Safety
/// AVX-512 is there; `x` points to BLOCK rows of at least `depth` values, `stride` apart; `panels` to `N * depth * PANEL` values.
#[inline]
#[target_feature(enable = "avx512f")]
unsafe fn product<const N: usize>(
    x: *const f32,
    stride: usize,
    depth: usize,
    panels: *const f32,
    init: [__m512; N],
) -> [[__m512; N]; BLOCK] {
    let mut sums = [init; BLOCK];
    for k in 0..depth {
        // SAFETY: k < depth, so every read lies inside what the caller promised.
        unsafe {
            let mut weights = [_mm512_setzero_ps(); N];
            for (n, weight) in weights.iter_mut().enumerate() {
                *weight = _mm512_loadu_ps(panels.add((n * depth + k) * PANEL));
            }
            for (m, sum) in sums.iter_mut().enumerate() {
                let value = _mm512_set1_ps(*x.add(m * stride + k));
                for (sum, weight) in sum.iter_mut().zip(weights) {
                    *sum = _mm512_fmadd_ps(value, weight, *sum);
                }
            }
        }
    }
    sums
}

/// As [`super::dense::forward`].
///
/// # Safety
/// AVX-512 is there, and the assertions of that function hold.
#[target_feature(enable = "avx512f")]
pub(super) unsafe fn forward(layer: &Packed, x: &[f32], x_stride: usize, y: &mut [f32], y_stride: usize, rows: usize, primal: usize) {
    let panels = padded(layer.outputs) / PANEL;
    for pair in (0..panels).step_by(2) {
        // SAFETY: promised by the caller; one panel is left where their number is odd.
        unsafe {
            match panels - pair {
                1 => forward_panels::<1>(layer, pair, x, x_stride, y, y_stride, rows, primal),
                _ => forward_panels::<2>(layer, pair, x, x_stride, y, y_stride, rows, primal),
            }
        }
    }
}

/// # Safety
/// As for [`forward`]; the layer has `N` panels from `panel` on.
#[inline]
#[target_feature(enable = "avx512f")]
unsafe fn forward_panels<const N: usize>(
    layer: &Packed,
    panel: usize,
    x: &[f32],
    x_stride: usize,
    y: &mut [f32],
    y_stride: usize,
    rows: usize,
    primal: usize,
) {
    let (depth, wide, column) = (layer.inputs, padded(layer.outputs), panel * PANEL);
    let zero = _mm512_setzero_ps();
    for row in (0..rows).step_by(BLOCK) {
        // SAFETY: the caller's assertions bound x and y; `forward` holds (depth + 1) * wide values; row % primal is a row up to this one.
        unsafe {
            let mut init = [zero; N];
            if row < primal {
                for (n, bias) in init.iter_mut().enumerate() {
                    *bias = _mm512_loadu_ps(layer.forward.as_ptr().add(depth * wide + column + n * PANEL));
                }
            }
            let sums = product::<N>(x.as_ptr().add(row * x_stride), x_stride, depth, layer.forward.as_ptr().add(column * depth), init);
            let value_row = row % primal;
            for (m, sum) in sums.into_iter().enumerate() {
                for (n, sum) in sum.into_iter().enumerate() {
                    let at = column + n * PANEL;
                    let value = y.as_ptr().add((value_row + m) * y_stride + at);
                    // `max(0, sum)` in this order lets NaN through.
                    let passed = if row < primal { _mm512_max_ps(zero, sum) } else { where_active(_mm512_loadu_ps(value), sum) };
                    _mm512_storeu_ps(y.as_mut_ptr().add((row + m) * y_stride + at), passed);
                }
            }
        }
    }
}

/// `sum` where `value` is above 0, else 0.
#[inline]
#[target_feature(enable = "avx512f")]
fn where_active(value: __m512, sum: __m512) -> __m512 {
    _mm512_maskz_mov_ps(_mm512_cmp_ps_mask::<_CMP_GT_OQ>(value, _mm512_setzero_ps()), sum)
}

/// As [`super::dense::input_gradient`].
///
/// # Safety
/// AVX-512 is there, and the assertions of that function hold.
#[target_feature(enable = "avx512f")]
pub(super) unsafe fn input_gradient(
    layer: &Packed,
    dz: &[f32],
    dz_stride: usize,
    dx: &mut [f32],
    dx_stride: usize,
    active: Option<&[f32]>,
    rows: usize,
    primal: usize,
) {
    let panels = padded(layer.inputs) / PANEL;
    for pair in (0..panels).step_by(2) {
        // SAFETY: promised by the caller; one panel is left where their number is odd.
        unsafe {
            match panels - pair {
                1 => input_panels::<1>(layer, pair, dz, dz_stride, dx, dx_stride, active, rows, primal),
                _ => input_panels::<2>(layer, pair, dz, dz_stride, dx, dx_stride, active, rows, primal),
            }
        }
    }
}

/// # Safety
/// As for [`input_gradient`]; the layer's transpose has `N` panels from `panel` on.
#[inline]
#[target_feature(enable = "avx512f")]
unsafe fn input_panels<const N: usize>(
    layer: &Packed,
    panel: usize,
    dz: &[f32],
    dz_stride: usize,
    dx: &mut [f32],
    dx_stride: usize,
    active: Option<&[f32]>,
    rows: usize,
    primal: usize,
) {
    let (depth, column) = (layer.outputs, panel * PANEL);
    for row in (0..rows).step_by(BLOCK) {
        // SAFETY: the caller's assertions bound every buffer.
        unsafe {
            let weights = layer.backward.as_ptr().add(column * depth);
            let sums = product::<N>(dz.as_ptr().add(row * dz_stride), dz_stride, depth, weights, [_mm512_setzero_ps(); N]);
            let value_row = row % primal;
            for (m, sum) in sums.into_iter().enumerate() {
                for (n, sum) in sum.into_iter().enumerate() {
                    let at = column + n * PANEL;
                    let out = dx.as_mut_ptr().add((row + m) * dx_stride + at);
                    match active {
                        Some(a) => {
                            let value = _mm512_loadu_ps(a.as_ptr().add((value_row + m) * dx_stride + at));
                            _mm512_storeu_ps(out, where_active(value, sum));
                        }
                        // Where half of the panel is padding it is left alone, as in the narrower version.
                        None => {
                            let mask = if layer.inputs - at <= PANEL / 2 { 0x00ff } else { 0xffff };
                            _mm512_mask_storeu_ps(out, mask, sum);
                        }
                    }
                }
            }
        }
    }
}

/// As [`super::dense::weight_gradient`].
///
/// # Safety
/// AVX-512 is there, and the assertions of that function hold.
#[target_feature(enable = "avx512f")]
pub(super) unsafe fn weight_gradient(
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
    let panels = wide / PANEL;
    for pair in (0..panels).step_by(2) {
        let column = pair * PANEL;
        let mut input = 0;
        while input < inputs {
            let take = (inputs - input).min(BLOCK);
            // SAFETY: input + take <= inputs <= x_stride, and the pair's columns lie below wide <= dz_stride.
            unsafe {
                let x = x.as_ptr().add(input);
                let dz = dz.as_ptr().add(column);
                let sum = gradient.as_mut_ptr().add(column * inputs + input * PANEL);
                match (panels - pair, take) {
                    (1, BLOCK) => outer::<BLOCK, 1>(x, x_stride, dz, dz_stride, rows, sum, inputs),
                    (_, BLOCK) => outer::<BLOCK, 2>(x, x_stride, dz, dz_stride, rows, sum, inputs),
                    (1, take) => (0..take).for_each(|m| outer::<1, 1>(x.add(m), x_stride, dz, dz_stride, rows, sum.add(m * PANEL), inputs)),
                    (_, take) => (0..take).for_each(|m| outer::<1, 2>(x.add(m), x_stride, dz, dz_stride, rows, sum.add(m * PANEL), inputs)),
                }
            }
            input += take;
        }
    }
    for panel in 0..panels {
        // SAFETY: the panel's columns lie below wide, row < primal <= rows.
        unsafe {
            let biases = gradient.as_mut_ptr().add(inputs * wide + panel * PANEL);
            let mut sum = _mm512_loadu_ps(biases);
            for row in 0..primal {
                sum = _mm512_add_ps(sum, _mm512_loadu_ps(dz.as_ptr().add(row * dz_stride + panel * PANEL)));
            }
            _mm512_storeu_ps(biases, sum);
        }
    }
}

/// `sum[n][m][PANEL] += ` over rows of `x[row][m] * dz[row][n][PANEL]`; the sums of two panels are `inputs` rows apart.
///
/// # Safety
/// AVX-512 is there; `x` and `dz` point to `rows` rows of M and `N * PANEL` values; `sum` to the M rows of N panels, all writable.
#[inline]
#[target_feature(enable = "avx512f")]
unsafe fn outer<const M: usize, const N: usize>(
    x: *const f32,
    x_stride: usize,
    dz: *const f32,
    dz_stride: usize,
    rows: usize,
    sum: *mut f32,
    inputs: usize,
) {
    // SAFETY: all indices stay inside what the caller promised.
    unsafe {
        let mut sums = [[_mm512_setzero_ps(); N]; M];
        for (m, sums) in sums.iter_mut().enumerate() {
            for (n, value) in sums.iter_mut().enumerate() {
                *value = _mm512_loadu_ps(sum.add((n * inputs + m) * PANEL));
            }
        }
        for row in 0..rows {
            let mut d = [_mm512_setzero_ps(); N];
            for (n, d) in d.iter_mut().enumerate() {
                *d = _mm512_loadu_ps(dz.add(row * dz_stride + n * PANEL));
            }
            for (m, sums) in sums.iter_mut().enumerate() {
                let value = _mm512_set1_ps(*x.add(row * x_stride + m));
                for (sum, d) in sums.iter_mut().zip(d) {
                    *sum = _mm512_fmadd_ps(value, d, *sum);
                }
            }
        }
        for (m, sums) in sums.into_iter().enumerate() {
            for (n, value) in sums.into_iter().enumerate() {
                _mm512_storeu_ps(sum.add((n * inputs + m) * PANEL), value);
            }
        }
    }
}
