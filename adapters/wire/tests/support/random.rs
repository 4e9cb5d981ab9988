//! Random numbers and the number of cases of the mutation tests.

/// SplitMix64 (Steele, Lea & Flood 2014).
pub struct Random(pub u64);

impl Random {
    pub fn number(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    pub fn below(&mut self, n: usize) -> usize {
        (self.number() % n.max(1) as u64) as usize
    }
}

/// Number of cases; `RIDGEWATCH_MUTATIONS` sets it.
pub fn cases() -> u64 {
    std::env::var("RIDGEWATCH_MUTATIONS").ok().and_then(|n| n.parse().ok()).unwrap_or(20_000)
}
