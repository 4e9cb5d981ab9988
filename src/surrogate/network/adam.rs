//! Adam (Kingma and Ba 2015, Adam: a method for stochastic optimization, algorithm 1) on slices, in the order of burn's arithmetic, and the
//! running mean of the parameters (Polyak and Juditsky 1992).
//!
//! The lazy variant for sparse gradients updates only the cache lines of a hash table that received a gradient: a batch reaches a few
//! percent of a fine level's entries, and all of them together are tens of megabytes.

use super::memory::{LINE, prefetch};

/// Decay of the first moment.
pub(super) const BETA_1: f32 = 0.9;
/// Decay of the second moment.
pub(super) const BETA_2: f32 = 0.999;

/// Lines that are prefetched before the first of them is used: enough to keep the memory busy.
const PREFETCHED_LINES: usize = 32;

/// Factors of one step, with both bias corrections folded in.
#[derive(Debug, Clone, Copy)]
pub struct Adam {
    /// Learning rate.
    pub rate: f32,
    /// Added to the root of the second moment, times the root of its bias correction.
    pub epsilon: f32,
    /// Both bias corrections: of the root of the second moment over that of the first.
    pub correction: f32,
}

impl Adam {
    /// Factors of step number `time`, counted from 1.
    pub fn at(time: usize, rate: f64, epsilon: f32) -> Self {
        // 1 - 0.999^t is 1 in f32 long before i32 runs out.
        let time = time.min(1 << 30) as i32;
        let second = (1.0 - BETA_2.powi(time)).sqrt();
        Self { rate: rate as f32, epsilon: epsilon * second, correction: second / (1.0 - BETA_1.powi(time)) }
    }

    /// Updates parameters and moments, and zeroes the gradient.
    #[inline]
    pub(super) fn step(self, parameters: &mut [f32], gradient: &mut [f32], first: &mut [f32], second: &mut [f32]) {
        let Self { rate, epsilon, correction } = self;
        for (((p, g), m), v) in parameters.iter_mut().zip(gradient.iter_mut()).zip(first).zip(second) {
            *m = *m * BETA_1 + *g * (1.0 - BETA_1);
            *v = *v * BETA_2 + *g * *g * (1.0 - BETA_2);
            *p -= *m * correction / (v.sqrt() + epsilon) * rate;
            *g = 0.0;
        }
    }

    /// [`Adam::step`] on the marked cache lines; clears the marks. The other lines keep their moments.
    pub(super) fn lazy_step(self, parameters: &mut [f32], gradient: &mut [f32], first: &mut [f32], second: &mut [f32], touched: &mut [u8]) {
        let len = parameters.len();
        assert!(gradient.len() == len && first.len() == len && second.len() == len && touched.len() >= len.div_ceil(LINE));
        for (group, marks) in touched[..len.div_ceil(LINE)].chunks_mut(PREFETCHED_LINES).enumerate() {
            let begin = |line: usize| (PREFETCHED_LINES * group + line) * LINE;
            for (line, _) in marks.iter().enumerate().filter(|(_, mark)| **mark != 0) {
                for buffer in [&*parameters, &*gradient, &*first, &*second] {
                    prefetch(buffer, begin(line));
                }
            }
            for (line, mark) in marks.iter_mut().enumerate().filter(|(_, mark)| **mark != 0) {
                *mark = 0;
                let range = begin(line)..(begin(line) + LINE).min(len);
                self.step(&mut parameters[range.clone()], &mut gradient[range.clone()], &mut first[range.clone()], &mut second[range]);
            }
        }
    }
}

/// Moves the mean of the parameters by `share` of its distance to them.
pub(super) fn move_average(average: &mut [f32], parameters: &[f32], share: f32) {
    for (a, &p) in average.iter_mut().zip(parameters) {
        *a += (p - *a) * share;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lazy_step_is_the_step_where_there_is_a_gradient() {
        // No whole number of lines, and more of them than are prefetched together.
        let len = 40 * LINE + 5;
        let value = |i: usize, k: u64| super::super::random::uniform(k, i as u64) - 0.5;
        let mut touched: Vec<u8> = (0..len.div_ceil(LINE)).map(|line| u8::from(line % 3 == 1 || line >= 39)).collect();
        let marked: Vec<bool> = (0..len).map(|i| touched[i / LINE] != 0).collect();
        let gradient: Vec<f32> = (0..len).map(|i| if marked[i] { value(i, 1) } else { 0.0 }).collect();
        let start = [2, 3, 4].map(|k| (0..len).map(|i| value(i, k).abs()).collect::<Vec<f32>>());
        let adam = Adam::at(7, 1e-2, 1e-15);
        let [mut p, mut m, mut v] = start.clone();
        adam.step(&mut p, &mut gradient.clone(), &mut m, &mut v);
        let [mut lazy_p, mut lazy_m, mut lazy_v] = start.clone();
        let mut lazy_gradient = gradient;
        adam.lazy_step(&mut lazy_p, &mut lazy_gradient, &mut lazy_m, &mut lazy_v, &mut touched);
        for i in 0..len {
            let expected = if marked[i] { [p[i], m[i], v[i]] } else { [start[0][i], start[1][i], start[2][i]] };
            // Vectors and scalars may round a multiply-add differently in the last place.
            for (found, expected) in [lazy_p[i], lazy_m[i], lazy_v[i]].into_iter().zip(expected) {
                assert!((found - expected).abs() <= 2.0 * f32::EPSILON * expected.abs().max(0.01), "{i}: {found} and {expected}");
            }
        }
        assert!(touched.iter().all(|&mark| mark == 0) && lazy_gradient.iter().all(|&g| g == 0.0));
    }
}
