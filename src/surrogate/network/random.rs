//! Random numbers as functions of a seed and a counter: the finaliser of splitmix64 (Steele, Lea and Flood 2014) over both.

fn bits(seed: u64, counter: u64) -> u64 {
    let mut z = seed.wrapping_mul(0xD134_2543_DE82_EF95).wrapping_add(counter.wrapping_add(1).wrapping_mul(0x9E37_79B9_7F4A_7C15));
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

/// A number in [0, 1).
pub fn uniform(seed: u64, counter: u64) -> f32 {
    (bits(seed, counter) >> 40) as f32 / (1_u64 << 24) as f32
}

/// A number in `0..count`.
pub fn draw(seed: u64, counter: u64, count: usize) -> usize {
    // Multiply-shift: its bias of 2^-64 * count is far below anything that training could notice.
    ((u128::from(bits(seed, counter)) * count as u128) >> 64) as usize
}

#[cfg(test)]
mod tests {
    use super::draw;

    #[test]
    fn draws_are_even_and_of_their_counter_alone() {
        let drawn = |first: u64| -> Vec<usize> { (first..first + 100_000).map(|counter| draw(7, counter, 1000)).collect() };
        let (here, further) = (drawn(0), drawn(300));
        assert!(here[300..] == further[..99_700] && here[..99_700] != further[..99_700] && here.iter().all(|&n| n < 1000));
        let mean = here.iter().sum::<usize>() as f64 / 1e5;
        // The mean of 1e5 uniform draws from 0..999 has a deviation of 0.91; five of them.
        assert!((mean - 499.5).abs() < 4.6, "{mean}");
    }
}
