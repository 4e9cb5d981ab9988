//! Shared parts of the integration tests: files, flows, rings and scenes to test with, and the runner of the program.
#![allow(dead_code, unused_imports)] // Each test binary uses its part.
#![allow(clippy::unwrap_used)] // Helpers of tests may panic.

pub mod flow;
pub mod grib;
pub mod grids;
pub mod http;
pub mod mutants;
pub mod netcdf;
pub mod program;
pub mod publishing;
pub mod ring;
pub mod scene;
pub mod zarr;
