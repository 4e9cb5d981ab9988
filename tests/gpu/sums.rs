//! The unbiased sum: its mean over seeds is the picture of `reference`.

use super::scenes::*;
use super::small;
use crate::kit::scene;
use ridgewatch::backend::cuda::{GpuSettings, Storage};
use ridgewatch::backend::{CudaDevice, Device, WhenLost};
use ridgewatch::run::{Frame, RunOptions};

const WIDTH: usize = 64;
const HEIGHT: usize = 32;
const TILE: usize = 16;

/// The whole picture, and each tile of 16 x 16 pixels.
fn parts() -> Vec<Vec<usize>> {
    let tile = |x: usize, y: usize| (0..TILE * TILE).map(|i| (y + i / TILE) * WIDTH + x + i % TILE).collect::<Vec<_>>();
    let tiles = (0..HEIGHT).step_by(TILE).flat_map(|y| (0..WIDTH).step_by(TILE).map(move |x| tile(x, y)));
    std::iter::once((0..WIDTH * HEIGHT).collect()).chain(tiles).collect()
}

#[test]
#[ignore = "needs a GPU"]
fn means_of_sums_are_the_picture_of_reference() {
    // Two-sided quantile of Student's t with 63 or 2 degrees of freedom at 1 %, over all nine comparisons (Bonferroni).
    let (seeds, limit, of_reference) = if small() { (3_u64, 30.0, 64) } else { (64, 3.42, 8192) };
    let gpu = opened(GpuSettings::default());
    let frame = |method: &str, samples: usize, seed: u64| -> Frame {
        // Of few nodes not only the surrogate is coarse, but also the steps of the march and its light volume.
        let keys = format!(
            "source.nodes = [48, 24, 24]\nsource.snapshots = 9\ntime.tau = 5\ntime.slides = 1\ntime.frames_per_slide = 1\ntime.warmup_frames = 0\n
            flow.steps = 20\ntransfer.low = 0.1\ntransfer.high = 0.3\nsurrogate.kind = \"table\"\nsurrogate.table_nodes = [13, 7, 7]\n
            render.method = \"{method}\"\nrender.combine = \"sum\"\nseed = {seed}\n"
        );
        let setup = scene::setup(&scene::scene("turbulence", [WIDTH, HEIGHT, samples], &keys), &[]);
        let device =
            Device::Cuda(CudaDevice { gpu: gpu.clone(), storage: Some(Storage::F32), when_lost: WhenLost::Stop, may_fall_back: false });
        frames_of(setup, &RunOptions { device, ..RunOptions::default() }).remove(0)
    };
    let means = |frame: &Frame| -> Vec<f64> {
        let luminances = frame.film.luminances();
        parts().iter().map(|pixels| pixels.iter().map(|&i| luminances[i]).sum::<f64>() / pixels.len() as f64).collect()
    };
    let truth = frame("reference", of_reference, 1000);
    let variances: Vec<f64> = parts()
        .iter()
        .map(|pixels| pixels.iter().map(|&i| f64::from(truth.film.variance[i])).sum::<f64>() / (pixels.len() as f64).powi(2))
        .collect();
    let (truth, surrogate) = (means(&truth), means(&frame("marched", 1, 0)));
    let pictures: Vec<Vec<f64>> = (0..seeds)
        .map(|seed| {
            let frame = frame("two_level", 16, seed);
            assert!(frame.record.picture_error.unwrap().unbiased, "seed {seed}");
            means(&frame)
        })
        .collect();
    let mut seen = 0;
    for part in 0..truth.len() {
        let of_pictures: Vec<f64> = pictures.iter().map(|picture| picture[part] - truth[part]).collect();
        let n = seeds as f64;
        let bias = of_pictures.iter().sum::<f64>() / n;
        let scatter = of_pictures.iter().map(|d| (d - bias).powi(2)).sum::<f64>() / (n - 1.0) / n;
        let error = (scatter + variances[part]).sqrt();
        println!("part {part}: {bias:.2e} of {:.3}, standard error {error:.2e}", truth[part]);
        // Where nothing is lit both are zero.
        assert!(bias.abs() <= limit * error, "part {part}: {bias:e}, standard error {error:e}");
        seen += usize::from((surrogate[part] - truth[part]).abs() > limit * error);
        if part == 0 {
            measured!("a bias of the picture would show from {:.1} dB on", 20.0 * (limit * error).log10());
        }
    }
    // What is corrected is no small thing. Next to nothing is lit in half of the tiles.
    assert!(small() || seen >= 4, "the surrogate alone is wrong in {seen} of {} parts", truth.len());
}
