//! Fill values that a file does not name.

/// Magnitudes that files are commonly filled with where there is no value.
const FILLS: [f32; 18] = [
    999.0,
    9999.0,
    99_999.0,
    999_999.0,
    9_999_999.0,
    999.9,
    9999.9,
    32_766.0,
    32_767.0,
    32_768.0,
    1e10,
    1e15,
    1e20,
    1e30,
    1e34,
    1e35,
    1e36,
    1e37,
];
/// Times the root mean square of all other values that a fill value exceeds.
const OUTSTANDS: f64 = 20.0;

/// A value of at least two nodes that looks like a fill value, with its share of the nodes. NaN are known to be missing.
pub(super) fn unnamed_fill(values: &[f32]) -> Option<(f32, f64)> {
    let fill = *values.iter().find(|value| FILLS.contains(&value.abs()))?;
    let count = values.iter().filter(|value| **value == fill).count();
    let others = values.iter().filter(|value| **value != fill && value.is_finite());
    let (sum, known) = others.fold((0.0, 0u64), |(sum, known), value| (sum + f64::from(*value).powi(2), known + 1));
    let stands_out = f64::from(fill.abs()) > OUTSTANDS * (sum / known.max(1) as f64).sqrt();
    (count > 1 && stands_out).then(|| (fill, count as f64 / values.len() as f64))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_fill_value_stands_out() {
        let mut values: Vec<f32> = (0..100).map(|i| (i as f32 * 0.37).sin()).collect();
        assert_eq!(unnamed_fill(&values), None);
        values[3] = -9999.0;
        assert_eq!(unnamed_fill(&values), None, "one node may be a fault");
        values[70] = -9999.0;
        values[71] = f32::NAN;
        assert_eq!(unnamed_fill(&values), Some((-9999.0, 0.02)));
        // Velocities of that size are none.
        let fast: Vec<f32> = (0..100).map(|i| 990.0 + 9.0 * (i % 2) as f32).collect();
        assert_eq!(unnamed_fill(&fast), None);
    }
}
