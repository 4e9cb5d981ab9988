//! Counter-based random numbers: a pure function of (seed, frame, pixel, sample, dimension).
//!
//! Philox4x32-10 of Salmon, Moraes, Dror and Shaw, "Parallel random numbers: as easy as 1, 2, 3" (SC 2011): 32-bit integer
//! operations only, so that the numbers do not depend on the number of threads, the rank or the device.

/// Round multipliers and key increments (Weyl constants) of Philox4x32, from table 2 and section 4.3 of the paper.
const MULTIPLIERS: [u32; 2] = [0xD251_1F53, 0xCD9E_8D57];
const WEYL: [u32; 2] = [0x9E37_79B9, 0xBB67_AE85];

/// Philox4x32-10: four random words for a counter under a key.
#[inline]
pub fn philox(mut counter: [u32; 4], mut key: [u32; 2]) -> [u32; 4] {
    for _ in 0..10 {
        let product_0 = u64::from(MULTIPLIERS[0]) * u64::from(counter[0]);
        let product_1 = u64::from(MULTIPLIERS[1]) * u64::from(counter[2]);
        counter = [
            (product_1 >> 32) as u32 ^ counter[1] ^ key[0],
            product_1 as u32,
            (product_0 >> 32) as u32 ^ counter[3] ^ key[1],
            product_0 as u32,
        ];
        key = [key[0].wrapping_add(WEYL[0]), key[1].wrapping_add(WEYL[1])];
    }
    counter
}

/// Uniform number in [0, 1) with 24 random bits, exact in f32.
#[inline]
pub fn unit(word: u32) -> f32 {
    (word >> 8) as f32 * (1.0 / 16_777_216.0)
}

/// The random numbers of one frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FrameRandom {
    key: [u32; 2],
    frame: u32,
}

impl FrameRandom {
    /// Numbers for `frame` under `seed`. The upper half of the frame number is added to the upper half of the key.
    pub fn new(seed: u64, frame: u64) -> Self {
        Self { key: [seed as u32, ((seed >> 32) as u32).wrapping_add((frame >> 32) as u32)], frame: frame as u32 }
    }

    /// Key and frame number of the counter.
    pub fn parts(&self) -> ([u32; 2], u32) {
        (self.key, self.frame)
    }

    /// Four random words. `dimension` numbers the decisions along one path.
    #[inline]
    pub fn words(&self, pixel: u32, sample: u32, dimension: u32) -> [u32; 4] {
        philox([pixel, sample, dimension, self.frame], self.key)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn known_answers_of_the_paper_s_reference_implementation() {
        // kat_vectors of Random123 1.14, philox4x32 10.
        assert_eq!(philox([0; 4], [0; 2]), [0x6627_e8d5, 0xe169_c58d, 0xbc57_ac4c, 0x9b00_dbd8]);
        assert_eq!(philox([u32::MAX; 4], [u32::MAX; 2]), [0x408f_276d, 0x41c8_3b0e, 0xa20b_c7c6, 0x6d54_51fd]);
        assert_eq!(
            philox([0x243f_6a88, 0x85a3_08d3, 0x1319_8a2e, 0x0370_7344], [0xa409_3822, 0x299f_31d0]),
            [0xd16c_fe09, 0x94fd_cceb, 0x5001_e420, 0x2412_6ea1]
        );
    }

    /// Chi-square of a histogram against equal expectations.
    fn chi_square(histogram: &[u32]) -> f64 {
        let total: u32 = histogram.iter().sum();
        let expected = f64::from(total) / histogram.len() as f64;
        histogram.iter().map(|&n| (f64::from(n) - expected).powi(2) / expected).sum()
    }

    #[test]
    fn every_word_is_uniform_along_every_argument() {
        // 255 degrees of freedom: mean 255, deviation sqrt(510) = 22.6. Six deviations either way: a chance of 1e-9 a check, and
        // seeds are fixed, so the test either always passes or shows a fault.
        type Draw = fn(u32) -> [u32; 4];
        let draws: [Draw; 4] = [
            |i| FrameRandom::new(7, 0).words(i, 3, 5),
            |i| FrameRandom::new(7, 0).words(11, i, 5),
            |i| FrameRandom::new(7, 0).words(11, 3, i),
            |i| FrameRandom::new(7, u64::from(i)).words(11, 3, 5),
        ];
        for (argument, draw) in draws.iter().enumerate() {
            for word in 0..4 {
                let mut histogram = [0_u32; 256];
                (0..65_536).for_each(|i| histogram[(draw(i)[word] >> 24) as usize] += 1);
                let chi = chi_square(&histogram);
                assert!((chi - 255.0).abs() < 6.0 * 510_f64.sqrt(), "argument {argument}, word {word}: {chi}");
            }
        }
    }

    #[test]
    fn neighbours_are_independent() {
        // Pairs (word of i, word of i + 1) fill a 16 x 16 table evenly; correlation of n pairs has deviation 1/sqrt(n).
        let random = FrameRandom::new(1, 2);
        let n = 65_536;
        let numbers: Vec<f32> = (0..=n).map(|i| unit(random.words(i, 0, 0)[0])).collect();
        let mut table = [0_u32; 256];
        let mut correlation = 0.0;
        for pair in numbers.windows(2) {
            table[(pair[0] * 16.0) as usize * 16 + (pair[1] * 16.0) as usize] += 1;
            correlation += f64::from(pair[0] - 0.5) * f64::from(pair[1] - 0.5) * 12.0;
        }
        assert!((chi_square(&table) - 255.0).abs() < 6.0 * 510_f64.sqrt());
        assert!((correlation / f64::from(n)).abs() < 6.0 / f64::from(n).sqrt());
    }

    #[test]
    fn each_argument_changes_the_numbers_and_half_the_bits() {
        let base = FrameRandom::new(9, 4).words(1, 2, 3);
        let others = [
            FrameRandom::new(8, 4).words(1, 2, 3),
            FrameRandom::new(9 + (1 << 40), 4).words(1, 2, 3),
            FrameRandom::new(9, 5).words(1, 2, 3),
            FrameRandom::new(9, 4 + (1 << 32)).words(1, 2, 3),
            FrameRandom::new(9, 4).words(0, 2, 3),
            FrameRandom::new(9, 4).words(1, 3, 3),
            FrameRandom::new(9, 4).words(1, 2, 2),
        ];
        for other in others {
            let flipped: u32 = base.iter().zip(other).map(|(a, b)| (a ^ b).count_ones()).sum();
            // 128 bits: mean 64, deviation 5.7; five deviations.
            assert!((35..=93).contains(&flipped), "{flipped} bits of 128 differ");
        }
        assert_eq!(base, FrameRandom::new(9, 4).words(1, 2, 3));
    }

    #[test]
    fn unit_stays_below_one() {
        assert_eq!(unit(0), 0.0);
        assert!(unit(u32::MAX) < 1.0);
    }
}
