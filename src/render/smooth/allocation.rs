//! Distribution of coupled samples over tiles: in proportion to the standard deviation of a sample (Neyman allocation, Cochran 1977, section 5.5).

/// Edge of a tile, in pixels.
pub const TILE: usize = 16;
const TILE_PIXELS: usize = TILE * TILE;
/// Share of the pairs that is spread evenly over all tiles.
const EVEN_SHARE: f64 = 0.25;
/// Largest share of a tile, of the mean.
const MAX_RELATIVE: f64 = 8.0;
/// Variance of a tile that showed no difference, as a share of the mean: none seen is not none.
const VARIANCE_FLOOR: f64 = 0.02;

/// Pairs of one tile in one round: the pixels whose ranks follow `cursor`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TilePairs {
    pub cursor: u8,
    pub pairs: usize,
}

/// Samples per tile, and where each tile goes on.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Allocation {
    cursors: Vec<u8>,
    /// Pairs so far, or as many as give every pixel one.
    given: Vec<u16>,
    /// Variance of a single sample.
    variance: Vec<f64>,
}

/// Rank of a pixel within its tile of 16x16, in the order in which pixels get samples: bits of x ^ y and y interleaved (ordered dithering, Bayer
/// 1973; `bayer_rank` of `kernels/rendering/coupled.cuh`).
pub fn bayer_rank(x: usize, y: usize) -> u8 {
    let (a, b) = (x ^ y, y);
    (0..4).fold(0, |rank, bit| (rank << 2) | ((((a >> bit) & 1) << 1) | ((b >> bit) & 1)) as u8)
}

/// Quarter of a pixel's pair with this number: the parity of the bits of both coordinates, which halves the pixels of every range of ranks that
/// starts at a multiple of its length, and alternates from pair to pair.
pub fn quarter(x: usize, y: usize, pair: usize) -> usize {
    (x.count_ones() as usize + y.count_ones() as usize + pair) & 1
}

/// Tiles across and down.
pub fn tiles(width: usize, height: usize) -> [usize; 2] {
    [width.div_ceil(TILE), height.div_ceil(TILE)]
}

impl Allocation {
    /// No samples yet, for a film of this size.
    pub fn new(width: usize, height: usize) -> Self {
        let count = tiles(width, height).iter().product();
        Self { cursors: vec![0; count], given: vec![0; count], variance: vec![0.0; count] }
    }

    /// Pairs of each tile in the next round, rows of tiles from the top.
    pub fn next(&mut self, pairs_per_pixel: f64) -> Vec<TilePairs> {
        let mean = self.variance.iter().sum::<f64>() / self.variance.len() as f64;
        let deviation = |variance: f64| variance.max(VARIANCE_FLOOR * mean).sqrt();
        let spread = self.variance.iter().map(|&v| deviation(v)).sum::<f64>() / self.variance.len() as f64;
        let wanted = pairs_per_pixel * TILE_PIXELS as f64;
        let mut round = Vec::with_capacity(self.cursors.len());
        for (cursor, &variance) in self.cursors.iter_mut().zip(&self.variance) {
            let relative = if spread > 0.0 { (deviation(variance) / spread).min(MAX_RELATIVE) } else { 1.0 };
            let share = wanted * (EVEN_SHARE + (1.0 - EVEN_SHARE) * relative);
            // The cursor, which visits every number evenly, decides which of two whole numbers is taken.
            let pairs = share.floor() as usize + usize::from(share.fract() * TILE_PIXELS as f64 > f64::from(*cursor));
            round.push(TilePairs { cursor: *cursor, pairs });
            *cursor = cursor.wrapping_add(pairs as u8);
        }
        for (given, tile) in self.given.iter_mut().zip(&round) {
            *given = (usize::from(*given) + tile.pairs).min(TILE_PIXELS) as u16;
        }
        round
    }

    /// True once every pixel has had a pair.
    pub fn covers_every_pixel(&self) -> bool {
        self.given.iter().all(|given| usize::from(*given) == TILE_PIXELS)
    }

    /// Takes in the variance of a single sample in each tile; `None` where it is unknown.
    pub fn learn(&mut self, variances: impl Iterator<Item = Option<f64>>) {
        for (known, found) in self.variance.iter_mut().zip(variances) {
            *known = found.unwrap_or(*known);
        }
    }
}

/// The pixels of a picture that get a pair; a pixel may come several times. One by one, since a round of many samples has more than memory should hold.
pub(super) fn pixels(round: &[TilePairs], width: usize, height: usize) -> impl Iterator<Item = u32> {
    let across = tiles(width, height)[0];
    round.iter().enumerate().flat_map(move |(tile, &TilePairs { cursor, pairs })| {
        let corner = [tile % across * TILE, tile / across * TILE];
        (0..pairs).step_by(TILE_PIXELS).flat_map(move |first| {
            let now = (pairs - first).min(TILE_PIXELS);
            (0..TILE_PIXELS).map(|i| (i % TILE, i / TILE)).filter_map(move |(x, y)| {
                let is_inside = corner[0] + x < width && corner[1] + y < height;
                let is_due = usize::from(bayer_rank(x, y).wrapping_sub(cursor)) < now;
                (is_inside && is_due).then(|| ((corner[1] + y) * width + corner[0] + x) as u32)
            })
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_pixel_gets_its_share() {
        let (width, height) = (40, 33);
        let mut allocation = Allocation::new(width, height);
        let mut pairs = vec![0; width * height];
        for _ in 0..32 {
            pixels(&allocation.next(0.375), width, height).for_each(|pixel| pairs[pixel as usize] += 1);
        }
        assert!(pairs.iter().all(|&n| (11..=13).contains(&n)), "{:?} of 12", (pairs.iter().min(), pairs.iter().max()));
    }

    #[test]
    fn quarters_halve_every_level_of_the_order() {
        for range in [0..4, 0..16, 16..32, 0..64, 0..128, 128..256_usize] {
            let mut quarters = [0; 2];
            for (y, x) in (0..TILE).flat_map(|y| (0..TILE).map(move |x| (y, x))) {
                if range.contains(&usize::from(bayer_rank(x, y))) {
                    quarters[quarter(x, y, 0)] += 1;
                }
            }
            assert_eq!(quarters[0], quarters[1], "{range:?}");
        }
    }

    #[test]
    fn tiles_get_pairs_in_proportion_to_their_deviation() {
        let mut allocation = Allocation::new(32, 16);
        allocation.learn([Some(9.0), Some(1.0)].into_iter());
        let (mut first, mut second) = (0, 0);
        for _ in 0..64 {
            let round = allocation.next(1.0);
            (first, second) = (first + round[0].pairs, second + round[1].pairs);
        }
        // Deviations 3 and 1, of which a quarter is spread evenly: 0.25 + 0.75 * 1.5 and 0.25 + 0.75 * 0.5.
        assert!((first as f64 / second as f64 - 1.375 / 0.625).abs() < 0.02, "{first} and {second}");
        assert!(((first + second) as f64 / (64.0 * 512.0) - 1.0).abs() < 0.02);
    }
}
