//! Errors of the CUDA driver as [`DeviceError`].

use crate::DeviceError;
use cudarc::driver::result::DriverError;
use cudarc::driver::sys::CUresult;

/// The error of a driver call that failed while `doing` something.
pub fn driver_error(doing: &'static str) -> impl Fn(DriverError) -> DeviceError {
    move |error| match error.0 {
        CUresult::CUDA_ERROR_OUT_OF_MEMORY => DeviceError::DriverOutOfMemory { doing },
        code => DeviceError::Driver {
            doing,
            reason: error.error_string().map_or_else(|_| format!("{code:?}"), |text| text.to_string_lossy().into_owned()),
        },
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_driver_without_memory_is_no_fault() {
        let error = driver_error("loading kernels")(DriverError(CUresult::CUDA_ERROR_OUT_OF_MEMORY));
        assert!(error.is_out_of_memory() && error.is_refusal() && !error.is_fault(), "{error}");
        assert!(error.to_string().starts_with("loading kernels: "), "{error}");
    }
}
