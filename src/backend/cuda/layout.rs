//! Structures that kernels read, laid out as in the headers of `kernels/`. All padding is explicit, so that every byte is initialised.

use bytemuck::{NoUninit, Pod, Zeroable};
use cudarc::driver::DeviceRepr;
use ridgewatch_field::Domain;
use ridgewatch_simd::Real;
use ridgewatch_trust::CellErrors;
use std::fmt::Debug;

/// A floating-point type of the kernels.
pub trait DeviceReal: Real + DeviceRepr + Pod {
    /// Its name in C++.
    const NAME: &'static str;
    /// Padding behind an odd number of values of this type, up to eight bytes.
    type RealPad: Pod + Debug;
    /// Padding behind an odd number of 32-bit integers, up to the alignment of this type.
    type IntPad: Pod + Debug;
}
impl DeviceReal for f32 {
    const NAME: &'static str = "float";
    type RealPad = [u32; 1];
    type IntPad = [u32; 0];
}
impl DeviceReal for f64 {
    const NAME: &'static str = "double";
    type RealPad = [u32; 0];
    type IntPad = [u32; 1];
}

/// `AxisData`.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct AxisData<R: DeviceReal> {
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
    pub pad: R::IntPad,
}

/// `GridData`.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct GridData<R: DeviceReal> {
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
    pub pad: R::RealPad,
    pub middle: f64,
    pub radius: f64,
    pub level: f64,
}

/// `GridStep`.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct GridStep<R: DeviceReal> {
    pub first: [u64; 3],
    pub second: [u64; 3],
    pub weight: [R; 3],
    pub pad: R::RealPad,
}

/// `ClosedData`.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ClosedData<R: DeviceReal> {
    pub low: [R; 3],
    pub high: [R; 3],
    pub box_low: [R; 3],
    pub box_high: [R; 3],
    pub rate: f64,
}

// SAFETY: `repr(C)` structures of numbers, whose padding is in fields: the tests compare their sizes with the sums of their fields.
unsafe impl<R: DeviceReal> NoUninit for AxisData<R> {}
// SAFETY: as above.
unsafe impl<R: DeviceReal> NoUninit for GridData<R> {}
// SAFETY: as above.
unsafe impl<R: DeviceReal> NoUninit for GridStep<R> {}
// SAFETY: as above; an even number of values needs no padding.
unsafe impl<R: DeviceReal> NoUninit for ClosedData<R> {}

/// `ResultPolicy`.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ResultPolicy {
    pub zero_if_left: i32,
    pub by_lifetime: i32,
    pub steps: i32,
}

/// Device addresses of results. 0: not wanted (`log_stretch` always is). One entry per seed: f32, f64, f32, 3 f32, 9 f32.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default)]
pub struct Outputs {
    /// Log-stretch, with edge policy and normalisation applied.
    pub log_stretch: u64,
    /// Log-stretch in double precision.
    pub log_stretch_f64: u64,
    /// Lifetime as a share of |tau|.
    pub lifetime_share: u64,
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

/// `UnitBox` of `domain.cuh`.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct UnitBoxArgument {
    pub min: [f64; 3],
    pub extent: [f64; 3],
    pub low: [f32; 3],
    pub high: [f32; 3],
}

impl UnitBoxArgument {
    pub fn new(domain: &Domain) -> Self {
        let [low, high] = domain.inward_corners();
        Self { min: domain.min, extent: domain.extent(), low, high }
    }
}

/// `TableFrame` of `table.cu`.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct TableFrame {
    pub nodes: [i32; 3],
    pub dimensions: i32,
    pub domain: UnitBoxArgument,
}

/// `Table` of `table.cuh`.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct TableArgument {
    pub nodes: [i32; 3],
    pub dimensions: i32,
    pub values: u64,
}

/// `MissingCellsAxis` of `missing_cells.cuh`.
#[repr(C)]
#[derive(Debug, Clone, Copy, Zeroable)]
pub struct MissingCellsAxis {
    pub nodes: u64,
    pub period: f64,
    pub count: i32,
    pub pad: i32,
}

/// `MissingCells` of `missing_cells.cuh`. Zeroed: no cell is missing.
#[repr(C)]
#[derive(Debug, Clone, Copy, Zeroable)]
pub struct MissingCellsArgument {
    pub axes: [MissingCellsAxis; 3],
    pub cells: [i32; 3],
    pub dimensions: i32,
    pub missing: u64,
}

/// `Choice` of `answer.cuh`, including its gate.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct ChoiceArgument {
    pub domain: UnitBoxArgument,
    pub gate_shape: [i32; 3],
    pub gate_pad: i32,
    pub trusted: u64,
    pub missing_cells: MissingCellsArgument,
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
    pub jacobians: u64,
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
    pub jacobians: u64,
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
    pub domain: UnitBoxArgument,
    pub missing_cells: MissingCellsArgument,
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
    pub is_missing: u64,
    pub traced: u64,
    pub lifetime_share: u64,
    pub predicted: u64,
    pub optical: u64,
}

/// `CellFindings` of `audit.cuh`.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default)]
pub struct CellFindings {
    pub errors: CellErrors,
    pub points: f64,
    pub lifetimes: f64,
    pub peak: f64,
}

macro_rules! device_repr {
    ($($name:ty),*) => {
        // SAFETY: plain numbers in C layout; only kernels use the addresses.
        $(unsafe impl cudarc::driver::DeviceRepr for $name {})*
    };
}
pub(super) use device_repr;

device_repr!(ResultPolicy, Outputs, SortFrame, UnitBoxArgument, TableFrame, TableArgument, ChoiceArgument, ListsArgument, LabelsArgument);
device_repr!(AuditDrawArgument, AuditBatchArgument, AuditPointsArgument, CellFindings);

/// A kernel parameter whose type depends on the precision, as eight-byte words.
pub type Words = [u64; 64];

/// Copies a structure to words, for kernel parameters.
pub fn words<T: NoUninit>(value: &T) -> Words {
    const { assert!(size_of::<T>() <= size_of::<Words>() && align_of::<T>() <= 8) };
    let mut words = [0; 64];
    bytemuck::bytes_of_mut(&mut words)[..size_of::<T>()].copy_from_slice(bytemuck::bytes_of(value));
    words
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_those_of_cpp() {
        // static_asserts in kernels/tracing/host.cpp have the same numbers.
        assert_eq!((size_of::<AxisData<f32>>(), size_of::<AxisData<f64>>()), (64, 80));
        assert_eq!((size_of::<GridData<f32>>(), size_of::<GridData<f64>>()), (336, 488));
        assert_eq!((size_of::<GridStep<f32>>(), size_of::<GridStep<f64>>()), (64, 72));
        assert_eq!((size_of::<ClosedData<f32>>(), size_of::<Outputs>(), size_of::<ResultPolicy>()), (56, 40, 12));
        assert_eq!((size_of::<SortFrame>(), size_of::<UnitBoxArgument>(), size_of::<TableFrame>()), (52, 72, 88));
        // static_asserts in the kernels' sources have the same numbers.
        assert_eq!((size_of::<TableArgument>(), size_of::<MissingCellsArgument>(), size_of::<ChoiceArgument>()), (24, 96, 200));
        assert_eq!((size_of::<ListsArgument>(), size_of::<LabelsArgument>()), (56, 40));
        assert_eq!((size_of::<AuditDrawArgument>(), size_of::<AuditBatchArgument>()), (200, 16));
        assert_eq!((size_of::<AuditPointsArgument>(), size_of::<CellFindings>()), (56, 80));
    }

    /// [`NoUninit`] of the generic structures relies on this.
    #[test]
    fn no_structure_has_hidden_padding() {
        fn check<R: DeviceReal>() {
            let (real, real_pad, int_pad) = (size_of::<R>(), size_of::<R::RealPad>(), size_of::<R::IntPad>());
            assert_eq!(size_of::<AxisData<R>>(), 3 * 8 + 2 * 8 + 3 * real + 3 * 4 + int_pad);
            assert_eq!(size_of::<GridData<R>>(), 2 * 4 + 3 * size_of::<AxisData<R>>() + 27 * real + real_pad + 3 * 8);
            assert_eq!(size_of::<GridStep<R>>(), 6 * 8 + 3 * real + real_pad);
            assert_eq!(size_of::<ClosedData<R>>(), 12 * real + 8);
        }
        check::<f32>();
        check::<f64>();
    }
}
