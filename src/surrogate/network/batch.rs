//! Batches of tiles on all cores: predictions, and gradients of a loss.

use super::architecture::Architecture;
use super::encode::{Corners, scatter_level};
use super::memory::{Aligned, TILE_ROWS, row_stride};
use super::tile::{Parameters, Tile, WeightGradient};
use super::times::Row;
use rayon::prelude::*;

/// Chunks of a batch, at most.
const MAX_CHUNKS: usize = 16;
/// Values of the gradients of all chunks together, at most (64 MiB), if there are more than two chunks.
const MAX_GRADIENT_VALUES: usize = 16 * 1024 * 1024;

/// A fixed part of the batch with a separate gradient, so that sums do not depend on the number of threads.
struct Chunk {
    tile: Tile,
    /// The tiles of the chunk, for the gradient of the tables; empty for the frequency encoding.
    features: Vec<TileFeatures>,
    gradient: WeightGradient,
    loss: f64,
}

/// The gradient for the features of one tile.
struct TileFeatures {
    coordinates: Vec<[f32; TILE_ROWS]>,
    count: usize,
    gradient: Aligned,
}

/// Memory for the gradient of batches.
pub(super) struct Batch {
    chunks: Vec<Chunk>,
    /// Samples of a chunk, at most.
    max_share: usize,
}

impl Batch {
    /// Memory for at most `size` samples; `derivatives` adds the derivatives of the outputs along the axes of the domain.
    pub(super) fn new(shape: &Architecture, size: usize, derivatives: bool) -> Self {
        let max_chunks = (MAX_GRADIENT_VALUES / WeightGradient::zeros(shape).len()).clamp(2, MAX_CHUNKS);
        let capacity = Tile::new(shape, derivatives, false).capacity;
        let chunks = max_chunks.min(size.div_ceil(capacity)).max(1);
        let max_share = size.div_ceil(chunks);
        let groups = if derivatives { 1 + shape.dimensions() } else { 1 };
        let tiles = if shape.levels.is_empty() { 0 } else { max_share.div_ceil(capacity) };
        let chunk = |_| Chunk {
            tile: Tile::new(shape, derivatives, true),
            features: (0..tiles)
                .map(|_| TileFeatures {
                    coordinates: vec![[0.0; TILE_ROWS]; shape.inputs()],
                    count: 0,
                    gradient: Aligned::zeros(groups * capacity * row_stride(shape.encoded())),
                })
                .collect(),
            gradient: WeightGradient::zeros(shape),
            loss: 0.0,
        };
        Self { chunks: (0..chunks).map(chunk).collect(), max_share }
    }

    /// Evaluates the network and its gradient for `count` samples and returns the loss. `row` gives the inputs of a sample; `prefetch` is
    /// called for every sample one tile earlier. `loss` gets the number of the tile's first sample and the evaluated tile, writes the
    /// gradient for its outputs, and returns its share of the loss.
    pub(super) fn accumulate(
        &mut self,
        network: Parameters<'_>,
        count: usize,
        prefetch: impl Fn(usize) + Sync,
        row: impl Fn(usize) -> Row + Sync,
        loss: impl Fn(usize, &mut Tile) -> f64 + Sync,
    ) -> f64 {
        let share = count.div_ceil(self.chunks.len());
        assert!(share <= self.max_share, "a batch of {count} samples in memory for {} per chunk", self.max_share);
        self.chunks.par_iter_mut().enumerate().with_max_len(1).for_each(|(number, chunk)| {
            let Chunk { tile, features, gradient, loss: sum } = chunk;
            (number * share..count.min(number * share + tile.capacity)).for_each(&prefetch);
            let end = count.min((number + 1) * share);
            *sum = 0.0;
            gradient.reset();
            features.iter_mut().for_each(|features| features.count = 0);
            let mut features = features.iter_mut();
            for first in (number * share..end).step_by(tile.capacity) {
                let next = first + tile.capacity;
                (next..end.min(next + tile.capacity)).for_each(&prefetch);
                tile.forward(network, tile.capacity.min(end - first), |sample| row(first + sample));
                *sum += loss(first, tile);
                let features = features.next().map(|features| {
                    features.count = tile.count;
                    features.coordinates.copy_from_slice(&tile.coordinates);
                    &mut features.gradient[..]
                });
                tile.backward(network, gradient, features);
            }
        });
        // The first chunk's gradient becomes the sum, in a fixed order.
        let (sum, rest) = self.chunks.split_at_mut(1);
        rest.iter().for_each(|chunk| sum[0].gradient.add(&chunk.gradient));
        self.chunks.iter().map(|chunk| chunk.loss).sum()
    }

    /// Adds the gradient of the layers to a flat vector.
    pub(super) fn layer_gradient(&self, shape: &Architecture, flat: &mut [f32]) {
        self.chunks[0].gradient.add_to(shape, flat);
    }

    /// Adds the gradient of the entries of level `number` to `table`, and marks the cache lines that it writes to in `touched`.
    pub(super) fn table_gradient(&self, shape: &Architecture, number: usize, corners: &mut Corners, table: &mut [f32], touched: &mut [u8]) {
        for chunk in &self.chunks {
            for features in chunk.features.iter().filter(|features| features.count > 0) {
                let positions = chunk.tile.positions(&features.coordinates, features.count);
                scatter_level(shape, number, positions, &features.gradient, corners, table, touched);
            }
        }
    }
}

/// Evaluates the network for `out.len() / width` samples on all cores. `write` puts an evaluated tile into its part of `out`, `width`
/// values per sample.
pub(super) fn predict(
    network: Parameters<'_>,
    row: impl Fn(usize) -> Row + Sync,
    derivatives: bool,
    out: &mut [f32],
    width: usize,
    write: impl Fn(&Tile, &mut [f32]) + Sync,
) {
    let capacity = Tile::new(network.shape, derivatives, false).capacity;
    // Sixteen tiles per task: large enough to hide the scheduling, small enough to distribute a frame's batch.
    let share = 16 * capacity;
    out.par_chunks_mut(share * width).enumerate().for_each_init(
        || Tile::new(network.shape, derivatives, false),
        |tile, (task, out)| {
            for (number, out) in out.chunks_mut(capacity * width).enumerate() {
                let first = task * share + number * capacity;
                tile.forward(network, out.len() / width, |sample| row(first + sample));
                write(tile, out);
            }
        },
    );
}
