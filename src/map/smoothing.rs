//! Smoothing of fields before they are differentiated, and how well a grid resolves them.

use rayon::prelude::*;

/// Roughness from which on a grid is too coarse.
const ROUGH: f64 = 0.4;

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

/// Root mean square difference of a value from the mean of its two neighbours along an axis, over all axes, as a share of the standard deviation of the
/// field: small if the grid resolves the field, 1.22 for noise. 0 if nothing is known.
pub(super) fn roughness(values: &[f32], size: &[usize]) -> f64 {
    let mut stride = 1;
    let mut differences = [0.0; 2];
    for &length in size {
        let at = |node: usize| f64::from(values[node]);
        let inner = |node: &usize| (1..length - 1).contains(&(node / stride % length));
        let difference = |node: usize| at(node) - (at(node - stride) + at(node + stride)) / 2.0;
        let of_axis = moments(values.len(), |node| Some(node).filter(inner).map(difference));
        differences = [differences[0] + of_axis[0], differences[1] + of_axis[2]];
        stride *= length;
    }
    let [count, sum, squares] = moments(values.len(), |node| Some(f64::from(values[node])));
    let variance = squares / count - (sum / count).powi(2);
    if variance > 0.0 && differences[0] > 0.0 { (differences[1] / differences[0] / variance).sqrt() } else { 0.0 }
}

/// Whether cells of so many nodes resolve a field in two dimensions: every such node alone would.
pub(super) fn is_resolved(values: &[f32], size: [usize; 2], nodes: [f64; 2]) -> bool {
    let counts = [0, 1].map(|k| ((size[k] - 1) as f64 / nodes[k]) as usize + 1);
    if nodes.iter().any(|nodes| *nodes < 2.0) || counts.iter().any(|count| *count < 3) {
        return false;
    }
    let at = |k: usize, n: usize| ((n as f64 * nodes[k]).round() as usize).min(size[k] - 1);
    let of_cells: Vec<f32> = (0..counts[0] * counts[1]).map(|n| values[at(1, n / counts[0]) * size[0] + at(0, n % counts[0])]).collect();
    roughness(&of_cells, &counts) < ROUGH
}

/// What is said of a grid, of this option, that does not resolve the FTLE.
pub(super) fn too_coarse(roughness: f64, option: &str) -> Option<String> {
    (roughness > ROUGH).then(|| {
        format!(
            "the grid is too coarse for this FTLE: from node to node it changes by {:.0} % of its spread, so that ridges are lost, torn or misplaced; take \
             a finer {option}, or a shorter tau",
            100.0 * roughness
        )
    })
}

/// Number, sum and sum of squares of the finite values at so many nodes; `None` where none is wanted. Summed in parts, so that the rounding does not
/// depend on the number of threads.
fn moments(nodes: usize, value: impl Fn(usize) -> Option<f64> + Sync) -> [f64; 3] {
    const PART: usize = 1 << 14;
    let add = |a: [f64; 3], b: [f64; 3]| std::array::from_fn(|k| a[k] + b[k]);
    let of_part = |part: usize| {
        let finite = (part * PART..nodes.min((part + 1) * PART)).filter_map(&value).filter(|v| v.is_finite());
        finite.map(|v| [1.0, v, v * v]).fold([0.0; 3], add)
    };
    let parts: Vec<[f64; 3]> = (0..nodes.div_ceil(PART)).into_par_iter().map(of_part).collect();
    parts.into_iter().fold([0.0; 3], add)
}

#[cfg(test)]
mod tests {
    use super::{is_resolved, roughness};

    #[test]
    fn cells_resolve_what_is_wider_than_they() {
        let size = [201, 101];
        let wave = |length: f64| {
            (0..size[0] * size[1]).map(|n| (std::f64::consts::TAU * (n % size[0]) as f64 / length).sin() as f32).collect::<Vec<_>>()
        };
        // Cells of ten nodes: waves of 200 nodes and of 20.
        assert!(is_resolved(&wave(200.0), size, [10.0, 10.0]) && !is_resolved(&wave(27.0), size, [10.0, 10.0]));
        assert!(!is_resolved(&wave(200.0), size, [1.5, 10.0]), "a grid as coarse as the data says nothing");
    }

    #[test]
    fn roughness_of_noise_and_of_waves_is_that_of_the_formula() {
        let size = [64, 48, 32];
        let field = |of: &dyn Fn(usize) -> f64| -> Vec<f32> { (0..size.iter().product()).map(|node| of(node) as f32).collect() };
        // 1.22 is the root of 1 + 1/2: one value and the mean of two others.
        let noise = roughness(
            &field(&|node| f64::from((node as u32).wrapping_mul(2_654_435_769).reverse_bits().wrapping_mul(2_246_822_519) >> 8)),
            &size,
        );
        assert!((noise - 1.5f64.sqrt()).abs() < 0.02, "{noise}");
        // cos(k (x - 1)) + cos(k (x + 1)) = 2 cos(k x) cos k, along x alone: a third of the squares, less the ends.
        for nodes in [4.0, 8.0, 32.0] {
            let wave = std::f64::consts::TAU / nodes;
            let found = roughness(&field(&|node| (wave * (node % 64) as f64 + 0.3).cos()), &size);
            let [nx, ny, nz] = size.map(|n| n as f64);
            let share = (nx - 2.0) * ny * nz / ((nx - 2.0) * ny * nz + nx * (ny - 2.0) * nz + nx * ny * (nz - 2.0));
            let expected = (1.0 - wave.cos()) * share.sqrt();
            assert!((found / expected - 1.0).abs() < 0.02, "{nodes} nodes a wave: {found}, {expected}");
        }
        assert_eq!((roughness(&[1.0; 8], &[2, 2, 2]), roughness(&[f32::NAN; 27], &[3, 3, 3])), (0.0, 0.0));
        let mut holes = field(&|node| (node % 64) as f64);
        holes[1000] = f32::NAN;
        assert!(roughness(&holes, &size) < 1e-6, "a slope is resolved, whatever is missing");
    }
}
