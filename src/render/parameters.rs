//! What a device must be told to track a frame's paths, and what it tells back.
//!
//! The structs are those of `kernels/tracking.cuh`, `kernels/film.cuh` and `kernels/majorant.cuh`, field by field.

use super::film::Film;
use super::rng::FrameRandom;
use super::space::SceneBox;
use super::{Camera, Light, Transfer};

/// Coefficients that a channel of the albedo polynomial may have.
const COEFFICIENTS: usize = 16;

#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct CameraParameters {
    pub(super) eye: [f64; 3],
    pub(super) forward: [f64; 3],
    pub(super) right: [f64; 3],
    pub(super) up: [f64; 3],
    pub(super) orthographic: i32,
    pub(super) pad: i32,
}

#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct BoxParameters {
    pub(super) min: [f64; 3],
    pub(super) max: [f64; 3],
    pub(super) domain_min: [f64; 3],
    pub(super) cell_edge: [f64; 3],
    pub(super) cell_extent: [f64; 3],
    pub(super) inward_min: [f32; 3],
    pub(super) inward_max: [f32; 3],
    pub(super) cells: [i32; 3],
    pub(super) pad: i32,
}

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
    pub(super) albedo: [[f32; COEFFICIENTS]; 3],
}

/// Everything that stays the same during a frame, as the kernels read it.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameParameters {
    camera: CameraParameters,
    space: BoxParameters,
    light: LightParameters,
    transfer: TransferParameters,
    key: [u32; 2],
    frame: u32,
    pad: u32,
    width: u32,
    height: u32,
    background: [f32; 3],
    missing: [f32; 3],
    per_tau: f32,
    pad_end: f32,
}

// The size that `kernels/tracking.cuh` asserts.
const _: () = assert!(size_of::<FrameParameters>() == 576);

impl FrameParameters {
    pub(super) fn new(
        camera: &Camera,
        light: &Light,
        transfer: &Transfer,
        space: &SceneBox,
        random: &FrameRandom,
        size: [usize; 2],
        colours: [[f32; 3]; 2],
        per_tau: f32,
    ) -> Self {
        let (key, frame) = random.parts();
        Self {
            camera: camera.parameters(),
            space: space.parameters(),
            light: light.parameters(),
            transfer: transfer.parameters(),
            key,
            frame,
            pad: 0,
            width: size[0] as u32,
            height: size[1] as u32,
            background: colours[0],
            missing: colours[1],
            per_tau,
            pad_end: 0.0,
        }
    }

    /// The bytes, in the machine's order.
    pub fn as_bytes(&self) -> &[u8] {
        // SAFETY: `repr(C)`, and every byte is written: the fields fill the struct (each size and alignment is a multiple of 4, those of
        // the structs that hold f64 a multiple of 8), which the assertion on the size shows.
        unsafe { std::slice::from_raw_parts(std::ptr::from_ref(self).cast(), size_of::<Self>()) }
    }

    /// Pixels of the picture.
    pub fn pixels(&self) -> usize {
        self.width as usize * self.height as usize
    }
}

impl Transfer {
    pub(super) fn parameters(&self) -> TransferParameters {
        let (low, per_range, extinction_max, albedo) = self.parts();
        let mut padded = [[0.0; COEFFICIENTS]; 3];
        for (padded, channel) in padded.iter_mut().zip(albedo) {
            padded[..channel.len()].copy_from_slice(channel);
        }
        let coefficients = albedo.each_ref().map(|channel| channel.len() as i32);
        TransferParameters { low, per_range, extinction_max, coefficients, albedo: padded }
    }
}

impl Light {
    pub(super) fn parameters(&self) -> LightParameters {
        match *self {
            Self::Directional { toward, radiance } => LightParameters { vector: toward, radiance, is_point: 0 },
            Self::Point { position, intensity } => LightParameters { vector: position, radiance: intensity, is_point: 1 },
        }
    }
}

/// What a frame's tracking needs, for an engine that tracks elsewhere than [`super::Renderer::render`] does.
#[derive(Debug)]
pub struct FrameSetup<'a> {
    /// The scene.
    pub parameters: FrameParameters,
    /// The majorants in force, x fastest.
    pub majorants: &'a [f32],
    /// Whether a cell may hold missing values.
    pub may_miss: &'a [bool],
}

/// What an engine saw in the majorant grid's cells, x fastest; all three have one entry a cell.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct SeenInCells {
    /// Values seen, missing ones included.
    pub count: Vec<u32>,
    /// Order-preserving image of the highest FTLE (see `ordered` in `kernels/majorant.cuh`); 0: none.
    pub highest: Vec<u32>,
    /// Whether missing values were seen: 0 or 1.
    pub missing: Vec<u32>,
}

/// One pixel of a finished picture; the fields are those of [`Film`].
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct PixelValue {
    /// R, G, B, alpha.
    pub rgba: [f32; 4],
    /// Mean FTLE.
    pub ftle_mean: f32,
    /// Traced share.
    pub traced: f32,
    /// Variance of the mean luminance.
    pub variance: f32,
    /// Samples.
    pub samples: f32,
    /// Share that saw missing values.
    pub missing: f32,
    /// Queries.
    pub queries: f32,
}

impl Film {
    /// Overwrites the pixels from `first` on.
    ///
    /// # Panics
    /// When there are more values than pixels.
    pub fn write_pixels(&mut self, first: usize, values: &[PixelValue]) {
        use rayon::prelude::*;
        const CHUNK: usize = 1 << 15;
        let range = first..first + values.len();
        (
            self.rgba[range.clone()].par_chunks_mut(CHUNK),
            self.ftle_mean[range.clone()].par_chunks_mut(CHUNK),
            self.traced[range.clone()].par_chunks_mut(CHUNK),
            self.variance[range.clone()].par_chunks_mut(CHUNK),
            self.samples[range.clone()].par_chunks_mut(CHUNK),
            self.missing[range.clone()].par_chunks_mut(CHUNK),
            self.queries[range].par_chunks_mut(CHUNK),
            values.par_chunks(CHUNK),
        )
            .into_par_iter()
            .for_each(|(rgba, ftle_mean, traced, variance, samples, missing, queries, values)| {
                for (i, value) in values.iter().enumerate() {
                    rgba[i] = value.rgba;
                    ftle_mean[i] = value.ftle_mean;
                    traced[i] = value.traced;
                    variance[i] = value.variance;
                    samples[i] = value.samples;
                    missing[i] = value.missing;
                    queries[i] = value.queries;
                }
            });
    }
}
