//! Versions of the C libraries.

use std::ffi::CStr;

/// Version of the NetCDF library.
pub fn netcdf_version() -> String {
    // SAFETY: the library returns a pointer to a static string that ends in NUL, or null.
    let version = unsafe {
        let text = netcdf_sys::nc_inq_libvers();
        if text.is_null() { None } else { Some(CStr::from_ptr(text).to_string_lossy().into_owned()) }
    };
    version.unwrap_or_else(|| "unknown".to_owned())
}

/// Version of the HDF5 library.
pub fn hdf5_version() -> String {
    let (major, minor, patch) = hdf5_metno::library_version();
    format!("{major}.{minor}.{patch}")
}
