//! `ridgewatch doctor`.

use super::common::{Common, print_json, print_text, refuse_settings};
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

/// Prints what is found.
pub fn run(common: &Common) -> Result<()> {
    refuse_settings(common, "doctor", "--json")?;
    let gpu = gpu();
    let diagnosis = Diagnosis {
        version: env!("CARGO_PKG_VERSION"),
        device: if gpu.usable { "cuda:0".into() } else { "cpu".into() },
        cpu: cpu(),
        gpu,
        netcdf: ridgewatch::source::netcdf_version(),
        hdf5: ridgewatch::source::hdf5_version(),
    };
    if common.json {
        return print_json(&diagnosis);
    }
    let Cpu { threads, built_for, has_avx2_and_fma } = diagnosis.cpu;
    print_text(format_args!("ridgewatch {}", diagnosis.version));
    print_text(format_args!("computes on  {}", diagnosis.device));
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
    use ridgewatch::backend::cuda::{Gpu as Opened, GpuSettings, nvrtc_version, probe};
    let found = match probe() {
        Ok(found) => found,
        Err(why) => return Gpu { usable: false, found: Vec::new(), why_not: Some(why.to_string()) },
    };
    let names = found.iter().map(|d| format!("cuda:{} {}", d.ordinal, d.name)).collect();
    match Opened::open(0, &GpuSettings::default()) {
        Ok(gpu) => {
            let (_, cap) = gpu.memory();
            let (major, minor) = gpu.capability();
            let (nvrtc, minor_nvrtc) = nvrtc_version();
            let more = format!(
                "driver for CUDA {}, NVRTC {nvrtc}.{minor_nvrtc}, compute capability {major}.{minor}, {} MiB to be used",
                gpu.driver(),
                cap >> 20
            );
            // NVRTC may not support an old card, and an old driver may refuse the code of a new NVRTC.
            let why_not = gpu.module("sort.cu", &[]).err().map(|why| why.to_string());
            Gpu { usable: why_not.is_none(), found: [names, vec![more]].concat(), why_not }
        }
        Err(why) => Gpu { usable: false, found: names, why_not: Some(why.to_string()) },
    }
}

#[cfg(not(feature = "cuda"))]
fn gpu() -> Gpu {
    Gpu { usable: false, found: Vec::new(), why_not: Some("built without the feature `cuda`".into()) }
}
