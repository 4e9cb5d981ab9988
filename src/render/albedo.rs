//! Albedo presets: polynomials in t = 1 - ramp, lowest power first.

use super::RenderError;

/// Names that `transfer.albedo` accepts in place of coefficients.
pub const ALBEDO_PRESETS: [&str; 4] = ["published", "grey", "ember", "deep"];

/// Albedo coefficients a0..a4 of the small renderer published with Günther, Kuhn and Theisel, "MCFTLE" (2016): dark red ridges, pale
/// yellow flanks, blue rims.
pub(super) fn published_albedo() -> [Vec<f64>; 3] {
    [
        vec![0.6639, 1.4380, 1.1657, -8.0915, 5.0048],
        vec![-0.0013, 1.2767, 7.4696, -15.9415, 7.4158],
        vec![0.1685, -1.4886, 11.9910, -16.2287, 6.1246],
    ]
}

/// Albedo polynomials by name: `published`; `grey` (0.9 everywhere); `ember` (dark red ridges to pale flanks); `deep` (dark blue
/// ridges to pale flanks).
///
/// # Errors
/// [`RenderError::Invalid`] for an unknown name.
pub fn albedo_preset(name: &str) -> Result<[Vec<f64>; 3], RenderError> {
    match name {
        "published" => Ok(published_albedo()),
        "grey" => Ok([vec![0.9], vec![0.9], vec![0.9]]),
        "ember" => Ok([vec![0.55, 0.42], vec![0.05, 0.85], vec![0.03, 0.15, 0.62]]),
        "deep" => Ok([vec![0.03, 0.15, 0.62], vec![0.18, 0.72], vec![0.45, 0.50]]),
        _ => Err(RenderError::Invalid {
            key: "transfer.albedo",
            found: format!("{name:?}"),
            accepted: "\"published\", \"grey\", \"ember\", \"deep\", or three lists of polynomial coefficients",
        }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Linear RGB as it is seen without one kind of cones (Machado, Oliveira and Fernandes 2009): red, green, blue.
    const SEEN_WITHOUT: [[[f64; 3]; 3]; 3] = [
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
        [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
    ];
    const SEEN: [[f64; 3]; 3] = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];

    fn times(matrix: &[[f64; 3]; 3], v: [f64; 3]) -> [f64; 3] {
        matrix.map(|row| row.iter().zip(v).map(|(a, b)| a * b).sum())
    }

    /// CIE L*a*b* of linear sRGB, white point D65.
    fn lab(rgb: [f64; 3]) -> [f64; 3] {
        let xyz = times(&[[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]], rgb.map(|c| c.clamp(0.0, 1.0)));
        let share = |k: usize| xyz[k] / [0.9505, 1.0, 1.089][k];
        let f = [0, 1, 2].map(|k| if share(k) > 0.008856 { share(k).cbrt() } else { 7.787 * share(k) + 16.0 / 116.0 });
        [116.0 * f[1] - 16.0, 500.0 * (f[0] - f[1]), 200.0 * (f[1] - f[2])]
    }

    /// Smallest difference of two colours a quarter of the ramp apart.
    fn told_apart(preset: &str, seen: &[[f64; 3]; 3]) -> f64 {
        let albedo = albedo_preset(preset).unwrap();
        let at = |n: i32| {
            let t = 1.0 - f64::from(n) / 32.0;
            let rgb = [0, 1, 2].map(|k| albedo[k].iter().rev().fold(0.0, |sum, c| sum * t + c).clamp(0.0, 1.0));
            lab(times(seen, rgb))
        };
        let difference = |(a, b): (i32, i32)| at(a).iter().zip(at(b)).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
        let pairs = (0..=32).flat_map(|a| (a + 8..=32).map(move |b| (a, b)));
        pairs.map(difference).fold(f64::INFINITY, f64::min)
    }

    #[test]
    fn colours_stay_apart_with_colour_blindness() {
        for preset in ["published", "ember", "deep"] {
            let all = told_apart(preset, &SEEN);
            for seen in &SEEN_WITHOUT {
                let found = told_apart(preset, seen);
                // Two is about the least that is noticed.
                assert!(found > 9.0 && found > 0.78 * all, "{preset}: {found} of {all}");
            }
        }
    }
}
