//! Smoothing of fields before they are differentiated.

use rayon::prelude::*;

/// A field of `size` nodes (first axis fastest) after a Gaussian with this standard deviation in nodes, over the known nodes only; missing nodes stay
/// missing.
pub(super) fn smoothed(values: &[f32], size: &[usize], deviation: f64) -> Vec<f64> {
    let values: Vec<f64> = values.iter().map(|v| f64::from(*v)).collect();
    if deviation <= 0.0 {
        return values;
    }
    let reach = (3.0 * deviation).ceil() as isize;
    let kernel: Vec<f64> = (-reach..=reach).map(|k| (-0.5 * (k as f64 / deviation).powi(2)).exp()).collect();
    // Sums of weighted values and of weights, along one axis after the other.
    let mut sums: Vec<[f64; 2]> = values.iter().map(|v| if v.is_finite() { [*v, 1.0] } else { [0.0, 0.0] }).collect();
    let mut stride = 1;
    for &length in size {
        let along = |node: usize| {
            let at = (node / stride % length) as isize;
            kernel.iter().zip(-reach..=reach).fold([0.0; 2], |[sum, weight], (k, offset)| {
                if !(0..length as isize).contains(&(at + offset)) {
                    return [sum, weight];
                }
                let [v, w] = sums[(node as isize + offset * stride as isize) as usize];
                [sum + k * v, weight + k * w]
            })
        };
        sums = (0..sums.len()).into_par_iter().map(along).collect();
        stride *= length;
    }
    sums.iter().zip(&values).map(|([sum, weight], v)| if v.is_finite() { sum / weight } else { f64::NAN }).collect()
}
