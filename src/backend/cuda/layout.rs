//! Structures that kernels read, laid out as in `kernels/*.cuh`.

use crate::simd::Real;
use crate::trust::CellErrors;
use cudarc::driver::DeviceRepr;

/// A number type of the kernels.
pub trait DeviceReal: Real + DeviceRepr {
    /// Its name in C++.
    const NAME: &'static str;
}
impl DeviceReal for f32 {
    const NAME: &'static str = "float";
}
impl DeviceReal for f64 {
    const NAME: &'static str = "double";
}

/// `AxisData`.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct AxisData<R> {
    pub positions: u64,
    pub inverse: u64,
    pub begins: u64,
    pub first: f64,
    pub spacing: f64,
    pub density: R,
    pub high: R,
    pub wrap: R,
    pub nodes: i32,
    pub last_cell: i32,
    pub intervals: i32,
}

/// `GridData`.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct GridData<R> {
    pub row: u32,
    pub plane: u32,
    pub axes: [AxisData<R>; 3],
    pub rate: [R; 4],
    pub low: [R; 3],
    pub high: [R; 3],
    pub ratios: [[R; 3]; 3],
    pub per_radian: [R; 2],
    pub origin: [R; 2],
    pub turn: [R; 2],
    pub poles: [R; 2],
    pub middle: f64,
    pub radius: f64,
    pub level: f64,
}

/// `GridStep`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GridStep<R> {
    pub first: [u64; 3],
    pub second: [u64; 3],
    pub weight: [R; 3],
}

/// `ClosedData`.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ClosedData<R> {
    pub low: [R; 3],
    pub high: [R; 3],
    pub box_low: [R; 3],
    pub box_high: [R; 3],
    pub rate: f64,
}

/// `Verdict`.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct Verdict {
    pub zero_where_left: i32,
    pub by_lived: i32,
    pub steps: i32,
}

/// Where results go, as device addresses; 0: not wanted, but for `log_stretch`. One entry a seed: f32, f64, f32, 3 f32, 9 f32.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default)]
pub struct Outputs {
    /// Log-stretch, with edge policy and normalisation applied.
    pub log_stretch: u64,
    /// The same unrounded.
    pub log_stretch_f64: u64,
    /// Share of |tau| lived.
    pub lived: u64,
    /// Arrival positions.
    pub arrival: u64,
    /// Jacobians, row-major.
    pub jacobian: u64,
}

/// `SortFrame` of `sort.cu`.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct SortFrame {
    pub first: [f32; 3],
    pub per_cell: [f32; 3],
    pub bits: [i32; 3],
    pub shift: i32,
    pub last_cell: [f32; 3],
}

/// `TableFrame` of `table.cu`.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct TableFrame {
    pub nodes: [i32; 3],
    pub dimensions: i32,
    pub min: [f64; 3],
    pub extent: [f64; 3],
}

/// `Table` of `table.cuh`.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct TableArgument {
    pub nodes: [i32; 3],
    pub dimensions: i32,
    pub values: u64,
}

/// `LandAxis` of `land.cuh`.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct LandAxis {
    pub nodes: u64,
    pub period: f64,
    pub count: i32,
    pub pad: i32,
}

/// `Land` of `land.cuh`.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct LandArgument {
    pub axes: [LandAxis; 3],
    pub cells: [i32; 3],
    pub dimensions: i32,
    pub empty: u64,
}

impl LandArgument {
    /// No land.
    pub const NONE: Self = Self { axes: [LandAxis { nodes: 0, period: 0.0, count: 0, pad: 0 }; 3], cells: [0; 3], dimensions: 0, empty: 0 };
}

/// `Choice` of `answer.cuh`, its domain and gate included.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ChoiceArgument {
    pub min: [f64; 3],
    pub extent: [f64; 3],
    pub gate_shape: [i32; 3],
    pub gate_pad: i32,
    pub trusted: u64,
    pub land: LandArgument,
    pub budget_spent: i32,
    pub pad: i32,
}

/// `Lists` of `answer.cu`.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ListsArgument {
    pub points: u64,
    pub places: u64,
    pub values: u64,
    pub arrivals: u64,
    pub lengths: u64,
    pub capacity: u32,
    pub pad: u32,
}

/// `Labels` of `answer.cu`.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct LabelsArgument {
    pub at: u64,
    pub arrivals: u64,
    pub length: u64,
    pub capacity: u32,
    pub shift: u32,
}

/// `AuditDraw` of `audit.cu`.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct AuditDrawArgument {
    pub shape: [i32; 3],
    pub key: [u32; 2],
    pub stream: [u32; 3],
    pub min: [f64; 3],
    pub extent: [f64; 3],
    pub land: LandArgument,
}

/// `AuditBatch` of `audit.cu`.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct AuditBatchArgument {
    pub begins: u64,
    pub first: u32,
    pub count: u32,
}

/// `AuditPoints` of `audit.cu`.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct AuditPointsArgument {
    pub unit: u64,
    pub points: u64,
    pub land: u64,
    pub traced: u64,
    pub lived: u64,
    pub predicted: u64,
    pub optical: u64,
}

/// `CellFindings` of `audit.cuh`.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default)]
pub struct CellFindings {
    pub errors: CellErrors,
    pub points: f64,
    pub lived: f64,
    pub peak: f64,
}

// SAFETY: plain numbers in C layout; addresses are used by kernels alone.
unsafe impl DeviceRepr for Verdict {}
// SAFETY: as above.
unsafe impl DeviceRepr for AuditDrawArgument {}
// SAFETY: as above.
unsafe impl DeviceRepr for AuditBatchArgument {}
// SAFETY: as above.
unsafe impl DeviceRepr for AuditPointsArgument {}
// SAFETY: as above.
unsafe impl DeviceRepr for CellFindings {}
// SAFETY: as above.
unsafe impl DeviceRepr for Outputs {}
// SAFETY: as above.
unsafe impl DeviceRepr for SortFrame {}
// SAFETY: as above.
unsafe impl DeviceRepr for TableFrame {}
// SAFETY: as above.
unsafe impl DeviceRepr for TableArgument {}
// SAFETY: as above.
unsafe impl DeviceRepr for ChoiceArgument {}
// SAFETY: as above.
unsafe impl DeviceRepr for ListsArgument {}
// SAFETY: as above.
unsafe impl DeviceRepr for LabelsArgument {}

/// Eight-byte words of a kernel parameter whose type depends on the precision.
pub type Words = [u64; 64];

/// A structure as words, for kernel parameters.
pub fn words<T: Copy>(value: &T) -> Words {
    const { assert!(size_of::<T>() <= size_of::<Words>() && align_of::<T>() <= 8) };
    let mut words = [0u64; 64];
    // SAFETY: `words` is at least as large and as aligned; any bytes (padding is copied with an untyped copy) make valid integers only
    // where they are initialised, and the kernel reads no others: padding stays unread.
    unsafe { std::ptr::copy_nonoverlapping((&raw const *value).cast::<u8>(), words.as_mut_ptr().cast::<u8>(), size_of::<T>()) };
    words
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_those_of_cpp() {
        // As nvcc and g++ lay them out (static_asserts in kernels/host.cpp hold the other side).
        assert_eq!((size_of::<AxisData<f32>>(), size_of::<AxisData<f64>>()), (64, 80));
        assert_eq!((size_of::<GridData<f32>>(), size_of::<GridData<f64>>()), (336, 488));
        assert_eq!((size_of::<GridStep<f32>>(), size_of::<GridStep<f64>>()), (64, 72));
        assert_eq!((size_of::<ClosedData<f32>>(), size_of::<Outputs>(), size_of::<Verdict>()), (56, 40, 12));
        assert_eq!((size_of::<SortFrame>(), size_of::<TableFrame>()), (52, 64));
        // static_asserts in the kernels' sources hold the other side of these.
        assert_eq!((size_of::<TableArgument>(), size_of::<LandArgument>(), size_of::<ChoiceArgument>()), (24, 96, 176));
        assert_eq!((size_of::<ListsArgument>(), size_of::<LabelsArgument>()), (48, 32));
        assert_eq!((size_of::<AuditDrawArgument>(), size_of::<AuditBatchArgument>()), (176, 16));
        assert_eq!((size_of::<AuditPointsArgument>(), size_of::<CellFindings>()), (56, 80));
    }
}
