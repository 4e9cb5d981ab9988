//! The parameters of a frame as kernels read them: the structs of `kernels/rendering/tracking.cuh`, field by field.

use super::Camera;
use super::space::SceneBox;

/// Largest number of coefficients of an albedo channel.
pub(super) const MAX_ALBEDO_COEFFICIENTS: usize = 16;

#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct LightParameters {
    pub(super) vector: [f64; 3],
    pub(super) radiance: [f32; 3],
    pub(super) is_point: i32,
}

#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct TransferParameters {
    pub(super) low: f32,
    pub(super) per_range: f32,
    pub(super) extinction_max: f32,
    pub(super) coefficients: [i32; 3],
    pub(super) albedo: [[f32; MAX_ALBEDO_COEFFICIENTS]; 3],
}

/// Everything that is constant during a frame, in the layout that kernels read.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameParameters {
    pub(super) camera: Camera,
    pub(super) space: SceneBox,
    pub(super) light: LightParameters,
    pub(super) transfer: TransferParameters,
    pub(super) key: [u32; 2],
    pub(super) frame: u32,
    pub(super) pad: u32,
    pub(super) width: u32,
    pub(super) height: u32,
    pub(super) background: [f32; 3],
    pub(super) missing: [f32; 3],
    pub(super) inverse_tau: f32,
    pub(super) pad_end: f32,
}

// The size that `kernels/rendering/tracking.cuh` asserts.
const _: () = assert!(size_of::<FrameParameters>() == 576);

impl FrameParameters {
    /// The bytes, in native order.
    pub fn as_bytes(&self) -> &[u8] {
        // SAFETY: the struct is `repr(C)` and has no padding: the fields fill it (all sizes and alignments are multiples of 4, and of 8 in
        // structs with f64), as the assertion on the size shows.
        unsafe { std::slice::from_raw_parts(std::ptr::from_ref(self).cast(), size_of::<Self>()) }
    }

    /// Pixels across and down.
    pub fn size(&self) -> [usize; 2] {
        [self.width as usize, self.height as usize]
    }

    /// Number of pixels.
    pub fn pixels(&self) -> usize {
        self.width as usize * self.height as usize
    }
}
