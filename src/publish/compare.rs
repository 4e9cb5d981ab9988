//! Differences of two pictures: PSNR and SSIM of the tone-mapped colours, relative error in linear HDR.

use super::error::PublishError;
use super::exr::read_exr;
use crate::render::Film;
use serde::{Deserialize, Serialize};
use std::fmt;
use std::path::Path;
use thiserror::Error;

/// Added to the squared reference in the relative error, so that black pixels do not dominate it.
const RELATIVE_EPSILON: f64 = 0.01;
/// Edge of the SSIM window, in pixels, and the deviation of its Gaussian weights (Wang, Bovik, Sheikh, Simoncelli 2004).
const SSIM_WINDOW: usize = 11;
const SSIM_DEVIATION: f64 = 1.5;

/// Why two pictures cannot be compared.
#[derive(Debug, Error)]
pub enum CompareError {
    /// One of them cannot be read.
    #[error(transparent)]
    Read(#[from] PublishError),
    /// They differ in size.
    #[error("the pictures differ in size: {} x {} pixels against {} x {}; only equal sizes can be compared", a[0], a[1], b[0], b[1])]
    Size {
        /// Width and height of the first.
        a: [usize; 2],
        /// Width and height of the second.
        b: [usize; 2],
    },
    /// They have no pixels.
    #[error("the pictures have no pixels")]
    Empty,
}

/// Difference of a picture from its reference.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Comparison {
    /// Pixels across.
    pub width: usize,
    /// Pixels down.
    pub height: usize,
    /// Peak signal-to-noise ratio of the tone-mapped 8-bit colours, in dB (peak 255). `None` if they are identical.
    pub psnr: Option<f64>,
    /// Structural similarity of the tone-mapped luma (Wang et al. 2004: Gaussian window 11x11, deviation 1.5, mean over whole
    /// windows). `None` if the picture is smaller than the window.
    pub ssim: Option<f64>,
    /// Mean of (a - b)^2 / (b^2 + 0.01) over the linear colours, b being the reference. `None` if no pixel is finite.
    pub relative_mse: Option<f64>,
    /// Largest |a - b| of the linear colours. `None` if no pixel is finite.
    pub max_abs_difference: Option<f64>,
    /// Pixels left out of the two linear figures because a colour is not finite in one of the pictures.
    pub not_finite: usize,
}

impl fmt::Display for Comparison {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "size     {} x {}", self.width, self.height)?;
        match self.psnr {
            Some(psnr) => writeln!(f, "PSNR     {psnr:.2} dB (tone-mapped, 8 bits)")?,
            None => writeln!(f, "PSNR     identical (tone-mapped, 8 bits)")?,
        }
        match self.ssim {
            Some(ssim) => writeln!(f, "SSIM     {ssim:.4} (tone-mapped luma)")?,
            None => writeln!(f, "SSIM     - (picture smaller than {SSIM_WINDOW} pixels)")?,
        }
        let linear = |figure: Option<f64>| figure.map_or("-".to_owned(), |figure| format!("{figure:.4e}"));
        writeln!(f, "relMSE   {} (linear)", linear(self.relative_mse))?;
        write!(f, "max diff {} (linear)", linear(self.max_abs_difference))?;
        if self.not_finite > 0 {
            write!(f, "\n{} pixels are not finite and were left out of the linear figures", self.not_finite)?;
        }
        Ok(())
    }
}

/// Compares two EXR files; `b` is the reference. `tone_map` is `[contrast, brightness, gamma]`.
///
/// # Errors
/// A file that cannot be read, or pictures of different sizes or without pixels.
pub fn compare_files(a: &Path, b: &Path, tone_map: [f64; 3]) -> Result<Comparison, CompareError> {
    compare_films(&read_exr(a)?, &read_exr(b)?, tone_map)
}

/// Compares two films; `b` is the reference. `tone_map` is `[contrast, brightness, gamma]`.
///
/// # Errors
/// Films of different sizes or without pixels.
pub fn compare_films(a: &Film, b: &Film, tone_map: [f64; 3]) -> Result<Comparison, CompareError> {
    let (width, height) = (a.width, a.height);
    if (width, height) != (b.width, b.height) || a.rgba.len() != b.rgba.len() {
        return Err(CompareError::Size { a: [width, height], b: [b.width, b.height] });
    }
    if a.rgba.is_empty() || a.rgba.len() != width * height {
        return Err(CompareError::Empty);
    }
    let (mut relative, mut largest, mut counted, mut not_finite) = (0.0f64, 0.0f64, 0usize, 0usize);
    for (p, q) in a.rgba.iter().zip(&b.rgba) {
        if p[..3].iter().chain(&q[..3]).any(|c| !c.is_finite()) {
            not_finite += 1;
            continue;
        }
        for k in 0..3 {
            let (x, y) = (f64::from(p[k]), f64::from(q[k]));
            relative += (x - y).powi(2) / (y * y + RELATIVE_EPSILON);
            largest = largest.max((x - y).abs());
            counted += 1;
        }
    }
    let (seen_a, seen_b) = (a.tone_mapped(tone_map), b.tone_mapped(tone_map));
    let squares: f64 = seen_a.iter().zip(&seen_b).map(|(&x, &y)| (f64::from(x) - f64::from(y)).powi(2)).sum();
    Ok(Comparison {
        width,
        height,
        psnr: (squares > 0.0).then(|| 10.0 * (255.0f64.powi(2) * seen_a.len() as f64 / squares).log10()),
        ssim: ssim(&luma(&seen_a), &luma(&seen_b), width, height),
        relative_mse: (counted > 0).then(|| relative / counted as f64),
        max_abs_difference: (counted > 0).then_some(largest),
        not_finite,
    })
}

/// ITU-R BT.601 luma of 8-bit RGB, 0 to 255.
fn luma(rgb: &[u8]) -> Vec<f64> {
    rgb.chunks_exact(3).map(|p| 0.299 * f64::from(p[0]) + 0.587 * f64::from(p[1]) + 0.114 * f64::from(p[2])).collect()
}

/// Mean structural similarity (Wang et al. 2004, equation 13, K1 = 0.01, K2 = 0.03, L = 255) over all windows inside the picture.
///
/// Not taken from the `image-compare` crate (0.5), which weights all pixels of disjoint 8x8 blocks equally and does not divide the sum of
/// covariances by their number.
fn ssim(a: &[f64], b: &[f64], width: usize, height: usize) -> Option<f64> {
    if width < SSIM_WINDOW || height < SSIM_WINDOW {
        return None;
    }
    let blur = |values: Vec<f64>| gaussian(&values, width, height);
    let product = |x: &[f64], y: &[f64]| x.iter().zip(y).map(|(x, y)| x * y).collect::<Vec<f64>>();
    let (mean_a, mean_b) = (blur(a.to_vec()), blur(b.to_vec()));
    let (square_a, square_b, cross) = (blur(product(a, a)), blur(product(b, b)), blur(product(a, b)));
    let (c1, c2) = ((0.01f64 * 255.0).powi(2), (0.03f64 * 255.0).powi(2));
    let sum: f64 = (0..mean_a.len())
        .map(|i| {
            let (m, n) = (mean_a[i], mean_b[i]);
            let (var_a, var_b, covariance) = (square_a[i] - m * m, square_b[i] - n * n, cross[i] - m * n);
            (2.0 * m * n + c1) * (2.0 * covariance + c2) / ((m * m + n * n + c1) * (var_a + var_b + c2))
        })
        .sum();
    Some(sum / mean_a.len() as f64)
}

/// Gaussian means, one for each window inside the picture.
fn gaussian(values: &[f64], width: usize, height: usize) -> Vec<f64> {
    let centre = (SSIM_WINDOW / 2) as f64;
    let mut weights: [f64; SSIM_WINDOW] = std::array::from_fn(|k| (-0.5 * ((k as f64 - centre) / SSIM_DEVIATION).powi(2)).exp());
    let sum: f64 = weights.iter().sum();
    weights.iter_mut().for_each(|w| *w /= sum);
    let inside = width - SSIM_WINDOW + 1;
    let rows: Vec<f64> = values
        .chunks_exact(width)
        .flat_map(|row| row.windows(SSIM_WINDOW).map(|w| w.iter().zip(&weights).map(|(v, w)| v * w).sum::<f64>()))
        .collect();
    (0..(height - SSIM_WINDOW + 1) * inside).map(|i| weights.iter().enumerate().map(|(k, w)| w * rows[i + k * inside]).sum()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The identity.
    const PLAIN: [f64; 3] = [1.0, 0.5, 1.0];

    fn film(width: usize, height: usize, colour: impl Fn(usize, usize) -> [f32; 3]) -> Film {
        let rgba = (0..width * height)
            .map(|i| {
                let [r, g, b] = colour(i % width, i / width);
                [r, g, b, 1.0]
            })
            .collect();
        Film { width, height, rgba, ..Default::default() }
    }

    /// Integer pattern of 8-bit greys, the same as in the script that gave the expected figures.
    fn pattern(x: usize, y: usize) -> usize {
        (x * 7 + y * 13 + x * y) % 256
    }

    fn grey(level: usize) -> [f32; 3] {
        [level as f32 / 255.0; 3]
    }

    #[test]
    fn identical_pictures() {
        let a = film(16, 12, |x, y| grey(pattern(x, y)));
        let same = compare_films(&a, &a, PLAIN).unwrap();
        assert_eq!((same.psnr, same.relative_mse, same.max_abs_difference), (None, Some(0.0), Some(0.0)));
        // Sums of products of the same numbers: rounding only.
        assert!((same.ssim.unwrap() - 1.0).abs() < 1e-12);
        assert!(same.to_string().contains("identical"));
    }

    #[test]
    fn a_shift_by_a_known_amount() {
        let a = film(16, 12, |_, _| grey(110));
        let b = film(16, 12, |_, _| grey(100));
        let report = compare_films(&a, &b, PLAIN).unwrap();
        // 20 log10(255 / 10): ten levels everywhere.
        assert!((report.psnr.unwrap() - 20.0 * 25.5f64.log10()).abs() < 1e-9);
        let (x, y) = (f64::from(110.0f32 / 255.0), f64::from(100.0f32 / 255.0));
        assert!((report.relative_mse.unwrap() - (x - y).powi(2) / (y * y + 0.01)).abs() < 1e-12);
        assert!((report.max_abs_difference.unwrap() - (x - y)).abs() < 1e-12);
        // Flat pictures: only the luminance term is left.
        let c1 = 2.55f64.powi(2);
        assert!((report.ssim.unwrap() - (2.0 * 110.0 * 100.0 + c1) / (110.0f64.powi(2) + 100.0f64.powi(2) + c1)).abs() < 1e-9);
    }

    #[test]
    fn ssim_is_the_one_of_the_literature() {
        let a = film(32, 24, |x, y| grey(pattern(x, y)));
        let b = film(32, 24, |x, y| grey((pattern(x, y) + 5 * (x % 3) + 9 * (y % 2)).min(255)));
        let report = compare_films(&a, &b, PLAIN).unwrap();
        // scikit-image 0.26: structural_similarity(gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=255).
        assert!((report.ssim.unwrap() - SKIMAGE).abs() < 1e-6, "{report:?}");
    }

    const SKIMAGE: f64 = 0.9924091185040533;

    #[test]
    fn sizes_must_agree() {
        let error = compare_films(&film(4, 2, |_, _| [0.0; 3]), &film(2, 4, |_, _| [0.0; 3]), PLAIN).unwrap_err();
        assert!(error.to_string().contains("4 x 2") && error.to_string().contains("2 x 4"), "{error}");
        assert!(matches!(compare_films(&Film::default(), &Film::default(), PLAIN), Err(CompareError::Empty)));
    }

    #[test]
    fn pixels_that_are_not_finite_are_counted() {
        let a = film(4, 4, |x, y| [if x == 0 && y == 0 { f32::NAN } else { 0.5 }, 0.5, 0.5]);
        let b = film(4, 4, |_, _| [0.5; 3]);
        let report = compare_films(&a, &b, PLAIN).unwrap();
        assert_eq!((report.not_finite, report.relative_mse, report.ssim), (1, Some(0.0), None));
        let nowhere = film(4, 4, |_, _| [f32::NAN; 3]);
        assert_eq!(compare_films(&nowhere, &b, PLAIN).unwrap().relative_mse, None, "no figure rather than a good one");
    }
}
