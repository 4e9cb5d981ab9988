//! How often a frame shows each FTLE.

use crate::run::Frame;
use serde::Serialize;

/// Number of bins.
const BINS: usize = 64;
/// Maximum number of pixels that are counted.
const MAX_COUNTED: usize = 1 << 15;
/// Share of the values at each end that the outer bins take in, so that a few do not squeeze the others.
const TAIL: f64 = 0.001;

/// Counts of the mean FTLE of a frame's pixels, of an even choice of at most 2^15.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Histogram {
    /// Number of the frame.
    pub frame: u64,
    /// Edges of the outer bins, which hold what lies beyond as well; `None` if no pixel has a value.
    pub range: Option<[f64; 2]>,
    /// Pixels of each bin; the bins are of equal width.
    pub counts: Vec<u32>,
    /// Pixels that were looked at, of which those without a value are in no bin.
    pub pixels: usize,
    /// Unit of `range`, as 1/s; empty if there is none.
    pub unit: String,
}

/// Counts the FTLE of a frame.
pub fn histogram(frame: &Frame) -> Histogram {
    let values = &frame.film.ftle_mean;
    let pixels = values.len().min(MAX_COUNTED);
    let mut known: Vec<f32> = (0..pixels).map(|k| values[k * values.len() / pixels]).filter(|value| value.is_finite()).collect();
    known.sort_unstable_by(f32::total_cmp);
    let at = |share: f64| known.get((share * known.len().saturating_sub(1) as f64).round() as usize).copied().map(f64::from);
    let range = at(TAIL).zip(at(1.0 - TAIL)).map(|(low, high)| {
        let room = if high > low { 0.0 } else { 0.01 * low.abs().max(f64::from(f32::MIN_POSITIVE)) };
        [low - room, high + room]
    });
    let mut counts = vec![0; BINS];
    if let Some([low, high]) = range {
        for value in &known {
            let bin = (f64::from(*value) - low) / (high - low) * BINS as f64;
            // A negative one becomes 0.
            counts[(bin as usize).min(BINS - 1)] += 1;
        }
    }
    let unit = frame.color_bar.as_ref().map_or(String::new(), |bar| bar.unit.clone());
    Histogram { frame: frame.record.frame, range, counts, pixels, unit }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::Film;
    use crate::run::FrameRecord;
    use std::sync::Arc;

    fn of(ftle_mean: Vec<f32>) -> Histogram {
        let film = Film { width: ftle_mean.len(), height: 1, ftle_mean, ..Film::default() };
        let record = FrameRecord { frame: 3, ..Default::default() };
        histogram(&Frame { record: Arc::new(record), film: Arc::new(film), tone_map: [1.0, 0.5, 1.0], color_bar: None, gate: None })
    }

    #[test]
    fn even_values_fill_the_bins_evenly_and_few_far_ones_do_not_squeeze_them() {
        let mut values: Vec<f32> = (0..6400).map(|i| (i as f32 + 0.5) / 6400.0).collect();
        values.extend([-1e6, 1e6, f32::NAN, f32::INFINITY]);
        let found = of(values);
        let [low, high] = found.range.unwrap();
        assert!(low.abs() < 0.002 && (high - 1.0).abs() < 0.002, "{low} {high}");
        assert_eq!((found.frame, found.pixels, found.counts.iter().sum::<u32>()), (3, 6404, 6402));
        assert!(found.counts.iter().all(|count| (95..=110).contains(count)), "{:?}", found.counts);
    }

    #[test]
    fn one_value_none_and_very_many_are_counted() {
        let one = of(vec![0.25; 5]);
        assert!(one.range.is_some_and(|[low, high]| low < 0.25 && high > 0.25) && one.counts.iter().sum::<u32>() == 5);
        for nothing in [Vec::new(), vec![f32::NAN; 4]] {
            let none = of(nothing);
            assert!(none.range.is_none() && none.counts.iter().all(|count| *count == 0));
        }
        let many = of((0..1_000_000).map(|i| (i % 1000) as f32).collect());
        assert_eq!((many.pixels, many.counts.iter().sum::<u32>()), (1 << 15, 1 << 15));
        assert!(many.counts.iter().all(|count| (450..=580).contains(count)), "{:?}", many.counts);
    }
}
