//! What runs on a GPU, against the f64 reference on the CPU. Every test needs a device and is ignored elsewhere; `make gpu-check` runs
//! them where one is. Inputs are other ones in every run; fresh device memory and outputs are poisoned.

#![cfg(feature = "cuda")]
// Helpers of a test may unwrap, and figures are printed for the record.
#![allow(clippy::unwrap_used, clippy::print_stdout)]

/// Prints a figure that `gpu-check` puts on its page.
macro_rules! measured {
    ($($figure:tt)*) => { println!("measured: {}", format_args!($($figure)*)) };
}

/// Whether tests are to be small: kernels are then watched access by access (`gpu-check`), which takes a hundred times as long.
fn small() -> bool {
    std::env::var_os("GPU_CHECK_SMALL").is_some()
}

#[path = "gpu/answers.rs"]
mod answers;
#[path = "gpu/audit.rs"]
mod audit;
#[path = "gpu/coupled.rs"]
mod coupled;
#[path = "gpu/device.rs"]
mod device;
mod kit;
#[path = "gpu/live.rs"]
mod live;
#[path = "gpu/lost.rs"]
mod lost;
#[path = "gpu/maps.rs"]
mod maps;
#[path = "gpu/network.rs"]
mod network;
#[path = "gpu/network_flow_map.rs"]
mod network_flow_map;
#[path = "gpu/network_loop.rs"]
mod network_loop;
mod network_support;
#[path = "gpu/network_training.rs"]
mod network_training;
#[path = "gpu/render.rs"]
mod render;
#[path = "gpu/scenes.rs"]
mod scenes;
#[path = "gpu/steering.rs"]
mod steering;
#[path = "gpu/sums.rs"]
mod sums;
#[path = "gpu/table.rs"]
mod table;
#[path = "gpu/trace.rs"]
mod trace;
#[path = "gpu/window.rs"]
mod window;
