//! Unpacked chunks that a later request may want: chunks often hold many times, and snapshots are read one by one.

use std::collections::HashMap;
use std::sync::Arc;

/// The variable, its place in the array, and whether it is the index of a shard.
pub type Key = (usize, Vec<usize>, bool);

/// Requests for a variable that a chunk stays without being reached: a snapshot may take several, for its sides of the seam.
const IDLE: u32 = 16;

/// Chunks within a bound of bytes. What the latest request for a variable reached is kept; all else goes first, and soon.
pub struct Cache {
    most: u64,
    bytes: u64,
    held: HashMap<Key, Held>,
    /// Whether there may be something that the latest requests did not reach.
    spare: bool,
}

struct Held {
    /// `None` if the store lacks it.
    data: Option<Arc<Vec<u8>>>,
    /// Whether it is sure that the store lacks it, if it does.
    confirmed: bool,
    bytes: u64,
    extents: Vec<usize>,
    /// Requests for the variable since one reached it.
    idle: u32,
}

/// Bytes of an entry beside its data.
const ENTRY_BYTES: u64 = 256;

impl Cache {
    pub fn new(most: u64) -> Self {
        Self { most, bytes: 0, held: HashMap::new(), spare: false }
    }

    /// Begins a request for a block of a variable.
    pub fn begin(&mut self, variable: usize, start: &[usize], count: &[usize]) {
        let reached = |origin: &[usize], extents: &[usize]| {
            (0..origin.len()).all(|k| origin[k] < start[k] + count[k] && start[k] < origin[k] + extents[k])
        };
        for ((_, origin, _), held) in self.held.iter_mut().filter(|(key, _)| key.0 == variable) {
            held.idle = if reached(origin, &held.extents) { 0 } else { held.idle + 1 };
        }
        self.spare = true;
        // What is not confirmed is left by a request that failed.
        self.keep_if(|held| held.confirmed && held.idle <= IDLE);
    }

    /// What the store was found to lack is kept beyond this request.
    pub fn confirm(&mut self) {
        self.held.values_mut().for_each(|held| held.confirmed = true);
    }

    fn keep_if(&mut self, keep: impl Fn(&Held) -> bool) {
        self.held.retain(|_, held| keep(held));
        self.bytes = self.held.values().map(|held| held.bytes).sum();
    }

    pub fn get(&self, key: &Key) -> Option<Option<Arc<Vec<u8>>>> {
        self.held.get(key).map(|held| held.data.clone())
    }

    /// Keeps a chunk if there is room. One that the store lacks is kept for this request, until [`Self::confirm`].
    pub fn keep(&mut self, key: Key, extents: &[usize], data: &Option<Arc<Vec<u8>>>) {
        let bytes = data.as_ref().map_or(0, |data| data.capacity() as u64) + ENTRY_BYTES;
        if self.bytes + bytes > self.most && self.spare {
            self.keep_if(|held| held.idle == 0);
            self.spare = false;
        }
        let held = Held { data: data.clone(), confirmed: data.is_some(), bytes, extents: extents.to_vec(), idle: 0 };
        if self.bytes + bytes <= self.most && self.held.insert(key, held).is_none() {
            self.bytes += bytes;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Reads times one by one from chunks of `long` times, two variables in turn, `tiles` chunks a time. Returns how often a chunk was unpacked.
    fn unpacked(most: u64, times: usize, long: usize, tiles: usize) -> f64 {
        let mut cache = Cache::new(most);
        let mut count = 0;
        for time in 0..times {
            for variable in 0..2 {
                cache.begin(variable, &[time, 0], &[1, tiles]);
                for tile in 0..tiles {
                    let key = (variable, vec![time / long * long, tile], false);
                    if cache.get(&key).is_none() {
                        count += 1;
                        cache.keep(key, &[long, 1], &Some(Arc::new(vec![0; 1000])));
                    }
                    assert!(cache.bytes <= most && cache.bytes == cache.held.values().map(|h| h.bytes).sum::<u64>());
                }
            }
        }
        count as f64 / (2 * tiles * times.div_ceil(long)) as f64
    }

    #[test]
    fn a_chunk_of_many_times_is_unpacked_about_once() {
        let one = 1000 + ENTRY_BYTES;
        assert_eq!(unpacked(u64::MAX, 24, 6, 5), 1.0);
        // Room for what one snapshot reaches, and no more.
        let tight = unpacked(10 * one, 24, 6, 5);
        assert!(tight <= 2.0, "{tight}");
        assert_eq!(unpacked(20 * one, 24, 6, 5), 1.0);
        // With half the room, half of them are still kept.
        let half = unpacked(5 * one, 24, 6, 5);
        assert!(half > 3.0 && half < 4.5, "{half}");
        assert_eq!(unpacked(0, 24, 6, 5), 6.0);
    }

    #[test]
    fn what_is_missing_is_kept_once_it_is_confirmed() {
        let mut cache = Cache::new(u64::MAX);
        let key = |chunk: usize| -> Key { (0, vec![chunk], false) };
        cache.begin(0, &[0], &[3]);
        cache.keep(key(0), &[1], &None);
        cache.confirm();
        cache.keep(key(1), &[1], &None);
        cache.keep(key(2), &[1], &Some(Arc::new(vec![0; 1000])));
        assert!((0..3).all(|chunk| cache.get(&key(chunk)).is_some()));
        // The request failed: the next one asks again.
        cache.begin(0, &[0], &[3]);
        assert_eq!([0, 1, 2].map(|chunk| cache.get(&key(chunk)).is_some()), [true, false, true]);
    }

    #[test]
    fn what_is_not_reached_any_more_is_given_up() {
        let mut cache = Cache::new(u64::MAX);
        for time in 0..100 {
            cache.begin(0, &[time, 0], &[1, 1]);
            cache.keep((0, vec![time, 0], false), &[1, 2], &Some(Arc::new(vec![0; 1000])));
        }
        assert_eq!(cache.held.len(), IDLE as usize + 1);
    }
}
