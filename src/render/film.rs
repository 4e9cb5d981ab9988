//! The film: means, variances and shares per pixel, by the running updates of Welford (1962) and Chan, Golub and LeVeque (1979).

use super::RenderError;

/// A picture: one entry per pixel, rows from the top, left to right.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Film {
    /// Pixels across.
    pub width: usize,
    /// Pixels down.
    pub height: usize,
    /// Mean linear radiance (R, G, B) and alpha (share of paths that scattered).
    pub rgba: Vec<[f32; 4]>,
    /// Mean FTLE at the real collisions seen through the pixel (1/time); NaN without collisions.
    pub ftle_mean: Vec<f32>,
    /// Share of the queries of the pixel that were traced.
    pub traced: Vec<f32>,
    /// Variance of the mean luminance (Rec. 709 weights); NaN with fewer than two samples.
    pub variance: Vec<f32>,
    /// Number of samples.
    pub samples: Vec<f32>,
    /// Share of paths that left the box without scattering and found a missing value at a point drawn uniformly along their way through it.
    /// Their colour is `render.missing_color`. For a map seen from above the share is 1 over missing cells and 0 elsewhere.
    pub missing: Vec<f32>,
    /// Number of log-stretch queries.
    pub queries: Vec<f32>,
    /// Stated error of the linear radiance, root mean square over the channels and the neighbourhood; of a map, of the FTLE (1/time). Empty for tracked
    /// pictures.
    pub error: Vec<f32>,
}

impl Film {
    /// A film without samples.
    pub fn new(width: usize, height: usize) -> Self {
        let pixels = width * height;
        Self::from_layers(width, height, vec![[0.0; 4]; pixels], |value| vec![value; pixels])
    }

    /// A film without samples whose memory pages all threads of the current rayon pool touch. A large new film is mapped page by page at the
    /// first write, which takes longer than copying the picture and longer than the work of a GPU on a frame.
    pub fn resident(width: usize, height: usize) -> Self {
        use rayon::prelude::*;
        /// Enough pages to be worth a task.
        const PIXELS_PER_TASK: usize = 1 << 16;
        // Collected, since one thread zeroes recycled memory for `vec![0.0; n]`.
        fn layer<T: Copy + Send + Sync>(pixels: usize, value: T) -> Vec<T> {
            rayon::iter::repeat_n(value, pixels).with_min_len(PIXELS_PER_TASK).collect()
        }
        let pixels = width * height;
        Self::from_layers(width, height, layer(pixels, [0.0; 4]), |value| layer(pixels, value))
    }

    fn from_layers(width: usize, height: usize, rgba: Vec<[f32; 4]>, layer: impl Fn(f32) -> Vec<f32>) -> Self {
        Self {
            width,
            height,
            rgba,
            ftle_mean: layer(f32::NAN),
            traced: layer(0.0),
            variance: layer(f32::NAN),
            samples: layer(0.0),
            missing: layer(0.0),
            queries: layer(0.0),
            error: Vec::new(),
        }
    }

    /// Tone-mapped 8-bit RGB with `((c - 0.5) * contrast + brightness)^(1/gamma)`.
    pub fn tone_mapped(&self, [contrast, brightness, gamma]: [f64; 3]) -> Vec<u8> {
        let map = |c: f32| {
            let value = ((f64::from(c) - 0.5) * contrast + brightness).clamp(0.0, 1.0).powf(1.0 / gamma);
            (value * 255.0 + 0.5) as u8
        };
        self.rgba.iter().flat_map(|p| [map(p[0]), map(p[1]), map(p[2])]).collect()
    }

    /// Rec. 709 luminance of every pixel.
    pub fn luminances(&self) -> Vec<f64> {
        self.rgba.iter().map(|[r, g, b, _]| f64::from(0.2126 * r + 0.7152 * g + 0.0722 * b)).collect()
    }

    /// Merges other samples of the same frame (a later pass or another rank), weighted by sample counts.
    ///
    /// # Errors
    /// [`RenderError::FilmSize`] if the films have different sizes.
    pub fn accumulate(&mut self, other: &Film) -> Result<(), RenderError> {
        if (self.width, self.height) != (other.width, other.height) {
            return Err(RenderError::FilmSize { found: [other.width, other.height], expected: [self.width, self.height] });
        }
        for i in 0..self.rgba.len() {
            let merged = Pixel::of(self, i).merged(&Pixel::of(other, i));
            merged.write(self, i);
        }
        Ok(())
    }
}

/// Sums over the paths of a pixel, in f64.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Pixel {
    samples: f64,
    /// Sums of red, green, blue and of the weights of scattered paths.
    rgba: [f64; 4],
    /// Sum of weight times FTLE at real collisions.
    ftle: f64,
    missing: f64,
    /// Welford's running mean of the luminance and sum of squared deviations.
    luminance: f64,
    deviations: f64,
    queries: f64,
    traced: f64,
}

/// Contribution of a path to its pixel.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct PathSample {
    pub(super) radiance: [f32; 3],
    /// Weight of the path if it scattered, otherwise 0.
    pub(super) scattered: f32,
    /// `scattered` times the FTLE at the collision.
    pub(super) ftle: f32,
    /// Weight of the path if it left the box and found a missing value, otherwise 0.
    pub(super) missing: f32,
    pub(super) queries: u32,
    pub(super) traced: u32,
}

impl Pixel {
    pub(super) fn add(&mut self, path: &PathSample) {
        let radiance = path.radiance.map(f64::from);
        self.samples += 1.0;
        (0..3).for_each(|k| self.rgba[k] += radiance[k]);
        self.rgba[3] += f64::from(path.scattered);
        self.ftle += f64::from(path.ftle);
        self.missing += f64::from(path.missing);
        let luminance = 0.2126 * radiance[0] + 0.7152 * radiance[1] + 0.0722 * radiance[2];
        let step = luminance - self.luminance;
        self.luminance += step / self.samples;
        self.deviations += step * (luminance - self.luminance);
        self.queries += f64::from(path.queries);
        self.traced += f64::from(path.traced);
    }

    pub(super) fn samples(&self) -> u32 {
        self.samples as u32
    }

    fn of(film: &Film, i: usize) -> Self {
        let samples = f64::from(film.samples[i]);
        let rgba = film.rgba[i].map(|v| f64::from(v) * samples);
        let [r, g, b, _] = film.rgba[i].map(f64::from);
        let queries = f64::from(film.queries[i]);
        // A NaN mean or variance means a sum without terms.
        let known = |v: f32, factor: f64| if v.is_nan() { 0.0 } else { f64::from(v) * factor };
        Self {
            samples,
            rgba,
            ftle: known(film.ftle_mean[i], rgba[3]),
            missing: f64::from(film.missing[i]) * samples,
            luminance: 0.2126 * r + 0.7152 * g + 0.0722 * b,
            deviations: known(film.variance[i], samples * (samples - 1.0)),
            queries,
            traced: f64::from(film.traced[i]) * queries,
        }
    }

    /// Sums of both, with the pairwise update of the deviations of Chan, Golub and LeVeque (1979).
    fn merged(&self, other: &Self) -> Self {
        let samples = self.samples + other.samples;
        if samples == 0.0 {
            return *self;
        }
        let step = other.luminance - self.luminance;
        Self {
            samples,
            rgba: std::array::from_fn(|k| self.rgba[k] + other.rgba[k]),
            ftle: self.ftle + other.ftle,
            missing: self.missing + other.missing,
            luminance: self.luminance + step * other.samples / samples,
            deviations: self.deviations + other.deviations + step * step * self.samples * other.samples / samples,
            queries: self.queries + other.queries,
            traced: self.traced + other.traced,
        }
    }

    pub(super) fn write(&self, film: &mut Film, i: usize) {
        if self.samples == 0.0 {
            return;
        }
        film.samples[i] = self.samples as f32;
        film.rgba[i] = self.rgba.map(|sum| (sum / self.samples) as f32);
        film.ftle_mean[i] = if self.rgba[3] == 0.0 { f32::NAN } else { (self.ftle / self.rgba[3]) as f32 };
        film.missing[i] = (self.missing / self.samples) as f32;
        film.variance[i] = if self.samples < 2.0 { f32::NAN } else { (self.deviations / (self.samples * (self.samples - 1.0))) as f32 };
        film.queries[i] = self.queries as f32;
        film.traced[i] = if self.queries == 0.0 { 0.0 } else { (self.traced / self.queries) as f32 };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn path(value: f32, scattered: bool) -> PathSample {
        let weight = if scattered { 1.0 } else { 0.0 };
        PathSample { radiance: [value; 3], scattered: weight, ftle: weight * value, missing: 1.0 - weight, queries: 4, traced: 1 }
    }

    fn film_of(values: &[f32]) -> Film {
        let mut film = Film::new(1, 1);
        let mut pixel = Pixel::default();
        values.iter().enumerate().for_each(|(i, &v)| pixel.add(&path(v, i % 2 == 0)));
        pixel.write(&mut film, 0);
        film
    }

    #[test]
    fn a_pixel_is_mean_and_variance() {
        let film = film_of(&[1.0, 2.0, 6.0, 3.0]);
        assert_eq!(film.rgba[0], [3.0, 3.0, 3.0, 0.5]);
        assert_eq!(film.ftle_mean[0], 3.5);
        assert_eq!((film.missing[0], film.traced[0], film.queries[0], film.samples[0]), (0.5, 0.25, 16.0, 4.0));
        // Sample variance 14/3 over 4 samples; f32 rounding.
        assert!((film.variance[0] - 14.0 / 12.0).abs() < 1e-6);
    }

    #[test]
    fn merging_is_as_good_as_one_go() {
        let values: Vec<f32> = (0..13).map(|i| (i * i % 7) as f32).collect();
        let mut merged = Film::new(1, 1);
        // Cuts at even indices keep `scattered` of each sample; a part of one sample has no variance.
        for part in [0..6, 6..6, 6..12, 12..13] {
            merged.accumulate(&film_of(&values[part])).unwrap();
        }
        let whole = film_of(&values);
        let near = |a: f32, b: f32| assert!((a - b).abs() <= 1e-6 * b.abs(), "{a} is not {b} up to f32 rounding");
        (0..4).for_each(|k| near(merged.rgba[0][k], whole.rgba[0][k]));
        near(merged.variance[0], whole.variance[0]);
        near(merged.ftle_mean[0], whole.ftle_mean[0]);
        near(merged.missing[0], whole.missing[0]);
        assert_eq!((merged.samples[0], merged.queries[0], merged.traced[0]), (13.0, 52.0, 0.25));
    }

    #[test]
    fn films_of_other_sizes_are_refused() {
        let fault = Film::new(2, 1).accumulate(&Film::new(1, 2)).unwrap_err();
        assert_eq!(fault.to_string(), "a film of [1, 2] pixels cannot be merged into one of [2, 1]");
    }
}
