//! Maps as frames, whose seeds the device traces.

use super::scenes::*;
use crate::kit::scene::double_gyre;
use crate::small;
use ridgewatch::backend::Device;
use ridgewatch::backend::cuda::GpuSettings;
use ridgewatch::run::{Frame, RunOptions};

/// The seeds are the same, and their FTLE is that of the CPU up to rounding.
#[test]
#[ignore = "needs a GPU"]
fn a_map_on_the_device_is_the_cpu_s() {
    let size = if small() { [48, 24, 4] } else { [192, 96, 8] };
    let keys = "time.tau = 10\nflow.steps = 40\ntime.frames_per_slide = 3\nrender.method = \"map\"\nsurrogate.kind = \"table\"\n";
    let frames = |device: Device| frames(&double_gyre(size, keys), &[], &RunOptions { device, ..RunOptions::default() });
    let (found, expected): (Vec<Frame>, Vec<Frame>) = (frames(device(GpuSettings::default())), frames(Device::CPU));
    assert!(found[0].record.device.starts_with("cuda:0") && found.len() == 3);
    for (found, expected) in found.iter().zip(&expected) {
        assert_eq!((found.record.queries, found.record.missing), (expected.record.queries, expected.record.missing));
        let scale = expected.film.ftle_mean.iter().fold(0.0_f32, |most, value| most.max(value.abs()));
        let worst = found.film.ftle_mean.iter().zip(&expected.film.ftle_mean).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        let stated = [found, expected].map(|frame| frame.record.picture_error.unwrap());
        measured!(
            "map, frame {}: worst difference {:.1e} of the largest FTLE, stated {:.2} and {:.2} dB, {:.1} ms",
            found.record.frame,
            worst / scale,
            stated[0].psnr.value,
            stated[1].psnr.value,
            1e3 * found.record.seconds.total
        );
        // Both integrate in f32; stretches of e^5 magnify its rounding.
        assert!(worst < 1e-3 * scale, "{worst} of {scale}");
        assert!((stated[0].psnr.value - stated[1].psnr.value).abs() < 0.05);
    }
}
