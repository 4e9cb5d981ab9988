//! Structures that the network's kernels read, laid out as in `kernels/network.cuh`, `kernels/network_data.cuh` and `kernels/network.cu`.

use super::layout::TableArgument;
use cudarc::driver::DeviceRepr;

/// Most levels of a hash grid.
const MOST_LEVELS: usize = 32;

/// `Level`.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default)]
pub struct LevelArgument {
    pub cells: [f32; 3],
    pub last_cell: [u32; 3],
    pub factor: [u32; 3],
    pub mask: u32,
    pub hashed: u32,
    pub entries: u32,
    pub offset: u32,
    pub start: u32,
}

/// `Grid`, of which a kernel takes as many levels as it is compiled for.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default)]
pub struct GridArgument {
    pub levels: [LevelArgument; MOST_LEVELS],
}

/// `Reading`.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ReadingArgument {
    pub mean: f32,
    pub deviation: f32,
    pub tau: f32,
    pub published: i32,
    pub share: f32,
    pub times: [f32; 3],
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
    pub pad: u32,
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

/// `UnitBox` of `answer.cuh`.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct UnitBoxArgument {
    pub min: [f64; 3],
    pub extent: [f64; 3],
}

// SAFETY: plain numbers in C layout; addresses are used by kernels alone.
unsafe impl DeviceRepr for GridArgument {}
// SAFETY: as above.
unsafe impl DeviceRepr for ReadingArgument {}
// SAFETY: as above.
unsafe impl DeviceRepr for DrawArgument {}
// SAFETY: as above.
unsafe impl DeviceRepr for AdamArgument {}
// SAFETY: as above.
unsafe impl DeviceRepr for UnitBoxArgument {}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_those_of_cpp() {
        // static_asserts in the kernels' sources hold the other side.
        assert_eq!((size_of::<LevelArgument>(), size_of::<ReadingArgument>()), (56, 56));
        assert_eq!((size_of::<DrawArgument>(), size_of::<AdamArgument>(), size_of::<UnitBoxArgument>()), (56, 16, 48));
    }
}
