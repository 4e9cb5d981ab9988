//! Damaged copies of files.

/// SplitMix64.
pub fn random(state: &mut u64) -> u64 {
    *state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let z = (*state ^ (*state >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

/// Places of the bytes that are not zero: there a file holds structure.
pub fn used(whole: &[u8]) -> Vec<usize> {
    (0..whole.len()).filter(|&i| whole[i] != 0).collect()
}

/// A copy with one to four bytes changed, at or just behind those of `used`; one of eight is cut short.
pub fn mutant(whole: &[u8], used: &[usize], state: &mut u64) -> Vec<u8> {
    let mut bytes = whole.to_vec();
    for _ in 0..1 + random(state) % 4 {
        let near = used[random(state) as usize % used.len()] + random(state) as usize % 4;
        let at = near.min(bytes.len() - 1);
        bytes[at] = match random(state) % 4 {
            0 => 0,
            1 => 0xff,
            2 => bytes[at] ^ (1 << (random(state) % 8)),
            _ => random(state) as u8,
        };
    }
    if random(state).is_multiple_of(8) {
        bytes.truncate(random(state) as usize % (bytes.len() + 1));
    }
    bytes
}
