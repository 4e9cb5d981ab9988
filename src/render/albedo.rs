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
