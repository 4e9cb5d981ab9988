//! `ridgewatch doctor`.

use super::{Common, print_json, print_text};
use anyhow::Result;
use serde::Serialize;

#[derive(Serialize)]
struct Diagnosis {
    version: &'static str,
    device: String,
    cpu: Cpu,
    gpu: Gpu,
    netcdf: String,
    hdf5: String,
}

#[derive(Serialize)]
struct Cpu {
    threads: usize,
    built_for: &'static str,
    has_avx2_and_fma: bool,
}

#[derive(Serialize)]
struct Gpu {
    usable: bool,
    found: Vec<String>,
    why_not: Option<String>,
}

/// Looks and tells.
pub fn run(common: &Common) -> Result<()> {
    let diagnosis = Diagnosis {
        version: env!("CARGO_PKG_VERSION"),
        device: "cpu".into(),
        cpu: cpu(),
        gpu: gpu(),
        netcdf: ridgewatch::source::netcdf_version(),
        hdf5: ridgewatch::source::hdf5_version(),
    };
    if common.json {
        return print_json(&diagnosis);
    }
    let Cpu { threads, built_for, has_avx2_and_fma } = diagnosis.cpu;
    print_text(format_args!("ridgewatch {}", diagnosis.version));
    print_text(format_args!("computes on  cpu"));
    print_text(format_args!(
        "cpu          {threads} threads; built for {built_for}; AVX2 and FMA {}",
        if has_avx2_and_fma { "present" } else { "absent" }
    ));
    for device in &diagnosis.gpu.found {
        print_text(format_args!("gpu          {device}"));
    }
    if let Some(why) = &diagnosis.gpu.why_not {
        print_text(format_args!("gpu          not used: {why}"));
    }
    print_text(format_args!("netcdf       {}", diagnosis.netcdf));
    print_text(format_args!("hdf5         {}", diagnosis.hdf5));
    Ok(())
}

fn cpu() -> Cpu {
    #[cfg(target_arch = "x86_64")]
    let has_avx2_and_fma = std::is_x86_feature_detected!("avx2") && std::is_x86_feature_detected!("fma");
    #[cfg(not(target_arch = "x86_64"))]
    let has_avx2_and_fma = false;
    let built_for =
        if cfg!(all(target_feature = "avx2", target_feature = "fma")) { "AVX2 and FMA" } else { "this architecture's baseline" };
    Cpu { threads: std::thread::available_parallelism().map_or(1, |n| n.get()), built_for, has_avx2_and_fma }
}

#[cfg(feature = "cuda")]
fn gpu() -> Gpu {
    use cudarc::driver::{result, sys};
    let unusable = |why: String| Gpu { usable: false, found: Vec::new(), why_not: Some(why) };
    // SAFETY: only looks the driver library up; asked first because cudarc panics where it is absent.
    if !unsafe { sys::is_culib_present() } {
        return unusable("no NVIDIA driver library (libcuda) is found".into());
    }
    if let Err(error) = result::init() {
        return unusable(format!("the driver does not start: {error}"));
    }
    let count = match result::device::get_count() {
        Ok(0) => return unusable("the driver finds no device".into()),
        Ok(count) => count,
        Err(error) => return unusable(format!("the driver cannot count devices: {error}")),
    };
    let found = (0..count)
        .filter_map(|n| result::device::get(n).ok())
        .map(|device| result::device::get_name(device).unwrap_or_else(|error| format!("unnamed: {error}")))
        .collect();
    Gpu { usable: false, found, why_not: Some("this version computes on the CPU only".into()) }
}

#[cfg(not(feature = "cuda"))]
fn gpu() -> Gpu {
    Gpu { usable: false, found: Vec::new(), why_not: Some("built without the feature `cuda`".into()) }
}
