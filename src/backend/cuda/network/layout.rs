//! Structures that the network's kernels read, laid out as in the files of `kernels/network/`.

use crate::cuda::layout::{TableArgument, device_repr};
use ridgewatch_surrogate::network::GRID_INPUTS;

/// Maximum number of levels of a hash grid.
const MAX_LEVELS: usize = 32;

/// `Level`, with room for all inputs.
#[derive(Debug, Clone, Copy, Default)]
pub struct LevelArgument {
    pub cells: [f32; GRID_INPUTS],
    pub last_cell: [u32; GRID_INPUTS],
    pub factor: [u32; GRID_INPUTS],
    pub mask: u32,
    pub hashed: u32,
    pub entries: u32,
    pub offset: u32,
    pub start: u32,
}

/// `Grid`. A kernel reads as many levels as it is compiled for.
#[repr(C, align(8))]
#[derive(Debug, Clone, Copy)]
pub struct GridArgument {
    words: [u32; 18 * MAX_LEVELS],
}

impl GridArgument {
    /// Bytes of a `Level`, which has room for three or four inputs.
    pub const fn level_bytes(inputs: usize) -> usize {
        if inputs > 3 { 72 } else { 56 }
    }

    /// Packs the levels, at most [`MAX_LEVELS`].
    pub fn new(levels: &[LevelArgument], inputs: usize) -> Self {
        let (room, held) = (Self::level_bytes(inputs) / 4, inputs.clamp(3, GRID_INPUTS));
        let mut grid = Self { words: [0; 18 * MAX_LEVELS] };
        for (level, to) in levels.iter().zip(grid.words.chunks_exact_mut(room)) {
            let cells = level.cells.map(f32::to_bits);
            let lists = [&cells[..held], &level.last_cell[..held], &level.factor[..held]];
            let rest = [level.mask, level.hashed, level.entries, level.offset, level.start];
            for (to, from) in to.iter_mut().zip(lists.into_iter().flatten().chain(&rest)) {
                *to = *from;
            }
        }
        grid
    }
}

/// Unit times at their places in a sample; NaN at the other places.
pub type PlacedTimes = [f32; 5];

/// `Reading`.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ReadingArgument {
    pub mean: [f32; 3],
    pub deviation: [f32; 3],
    pub tau: f32,
    pub published: i32,
    pub share: f32,
    pub times: PlacedTimes,
    pub step: f32,
    pub factor: [[f32; 3]; 3],
    pub further: u64,
    pub base: TableArgument,
}

/// `Draw`.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct DrawArgument {
    pub samples: u64,
    pub more: u64,
    pub seed: u64,
    pub counter: u64,
    pub count: u32,
    pub first: u32,
    pub batch: u32,
    pub random: u32,
    pub hold_out: u32,
    pub penalty: f32,
    pub means: u64,
}

/// `Adam`.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct AdamArgument {
    pub rate: f32,
    pub epsilon: f32,
    pub correction: f32,
    pub gradient: f32,
}

device_repr!(GridArgument, ReadingArgument, DrawArgument, AdamArgument);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_those_of_cpp() {
        // static_asserts in the kernels' sources have the same numbers.
        assert_eq!(size_of::<ReadingArgument>(), 128);
        assert_eq!((size_of::<DrawArgument>(), size_of::<AdamArgument>()), (64, 16));
    }
}
