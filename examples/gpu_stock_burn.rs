//! The network in burn's stock operations on a GPU, beside the fused kernels in the same run; as a block of docs/performance.md.
//! `cargo run --release --features burn-cuda --example gpu_stock_burn`
//!
//! The same parameters in both. Wall clock between synchronisations, medians of nine (of three where one takes
//! over half a second); random points, targets 0.5. burn's CUDA backend runs without fusion and autotune, as ridgewatch builds burn.

#![allow(clippy::print_stdout)] // a measurement, which prints

use burn::backend::Autodiff;
use burn::module::AutodiffModule;
use burn::optim::{AdamConfig, GradientsParams, Optimizer};
use burn::tensor::backend::Backend;
use burn::tensor::{Tensor, TensorData};
use burn_cuda::{Cuda, CudaDevice};
use ridgewatch::engine::cuda::{DevicePredict, DeviceTraining, Gpu, GpuSettings};
use ridgewatch::field::Domain;
use ridgewatch::surrogate::network::{Architecture, Encoding, Model, Network, NetworkSettings, Objective, PlannedStep};
use std::error::Error;
use std::time::Instant;

type Outcome<T> = Result<T, Box<dyn Error>>;
type Stock = Cuda;

const ROUNDS: usize = 9;
/// Points that are predicted at once, and that the fused training draws from.
const COUNT: usize = 1 << 20;
const RATE: f64 = 1e-3;

/// Median seconds of `work`, which ends when the device has done it.
fn time(mut work: impl FnMut() -> Outcome<()>) -> Outcome<f64> {
    let mut times = Vec::new();
    // The first round compiles and takes memory.
    work()?;
    while times.len() < if times.first().is_some_and(|&first| first > 0.5) { 3 } else { ROUNDS } {
        let start = Instant::now();
        work()?;
        times.push(start.elapsed().as_secs_f64());
    }
    times.sort_by(f64::total_cmp);
    Ok(times[times.len() / 2])
}

/// `Display` for burn's errors, which are not all `Error`.
fn done<T, E: std::fmt::Debug>(outcome: Result<T, E>) -> Outcome<T> {
    outcome.map_err(|error| format!("{error:?}").into())
}

fn main() -> Outcome<()> {
    let gpu = Gpu::open(0, &GpuSettings::default())?;
    let device = CudaDevice::new(0);
    let cube = Domain::cuboid([0.0; 3], [1.0; 3]);
    let hash = |log2_table| NetworkSettings { levels: 8, features: 2, growth: 2.0, log2_table, ..NetworkSettings::default() };
    let frequency =
        |hidden_layers, width| NetworkSettings { encoding: Encoding::Frequency, hidden_layers, width, ..NetworkSettings::default() };
    println!("<!-- block network-stock -->");
    println!("| network | batch | burn trains, M/s | fused, M/s | burn predicts, G/s | fused, G/s | predictions differ by |");
    println!("|---|---|---|---|---|---|---|");
    for (name, settings) in [
        ("frequency 10, 4x64", frequency(4, 64)),
        ("frequency 10, 8x256", frequency(8, 256)),
        ("hash 8x2, growth 2, T = 2^19, 2x64", hash(19)),
        ("hash 8x2, growth 2, T = 2^22, 2x64", hash(22)),
    ] {
        let shape = Architecture::new(&settings, &[0, 1, 2], cube.extent())?;
        let objective = Objective::new(&settings, &shape, cube.extent(), 1.0);
        let model = Model::new(shape.clone(), 1, false);
        let epsilon = model.epsilon;
        let mut fused = DeviceTraining::new(&gpu, &model, &objective)?;
        let mut points = gpu.alloc("points", COUNT)?;
        fused.draw_points(&cube, 3, 0, &mut points)?;
        let mut host = vec![[0.0_f32; 3]; COUNT];
        points.read(&mut host)?;
        let values = gpu.upload("values", &vec![0.5_f32; COUNT])?;
        let mut pool = fused.ring(COUNT)?;
        // SAFETY: both buffers hold `COUNT` entries and outlive the work below.
        unsafe { fused.append(&mut pool, &cube, points.address(), values.address(), COUNT, None)? };

        let mut stock = Network::<Autodiff<Stock>>::new(&shape, 1, false, &device);
        let flat: Vec<f32> = host.iter().flatten().copied().collect();
        let at = |count: usize| TensorData::new(flat[..3 * count].to_vec(), [count, 3]);

        let frozen = fused.frozen()?;
        let still = stock.valid();
        let inputs = Tensor::<Stock, 2>::from_data(at(COUNT), &device);
        let ours = time(|| {
            // SAFETY: as above.
            unsafe { frozen.predict(points.address(), COUNT, values.address()) }?;
            Ok(gpu.synchronize()?)
        })?;
        let mut found = vec![0.0_f32; COUNT];
        values.read(&mut found)?;
        let theirs = time(|| {
            let outputs = still.forward(&shape, inputs.clone());
            done(Stock::sync(&device))?;
            drop(outputs);
            Ok(())
        })?;
        let expected = done(still.forward(&shape, inputs).into_data().to_vec::<f32>())?;
        let square = |values: &mut dyn Iterator<Item = f32>| values.map(|v| f64::from(v).powi(2)).sum::<f64>().sqrt();
        let scaled = |value: &f32| value * objective.scale.deviation[0] + objective.scale.mean[0];
        let differ = square(&mut found.iter().zip(&expected).map(|(a, b)| a - scaled(b))) / square(&mut expected.iter().map(scaled));
        drop(frozen);

        for batch in [1 << 16, 1 << 18] {
            let mut adam = AdamConfig::new().with_beta_1(0.9).with_beta_2(0.999).with_epsilon(epsilon).init();
            let inputs = Tensor::<Autodiff<Stock>, 2>::from_data(at(batch), &device);
            let wanted = Tensor::<Autodiff<Stock>, 2>::full([batch, 1], 0.5, &device);
            let burn = time(|| {
                let loss = (stock.forward(&shape, inputs.clone()) - wanted.clone()).powi_scalar(2).mean();
                let gradients = GradientsParams::from_grads(loss.backward(), &stock);
                stock = adam.step(RATE, stock.clone(), gradients);
                done(Stock::sync(&device))
            })?;
            let mut drawn = 0;
            let own = time(|| {
                let step =
                    PlannedStep { count: batch, drawn: Some((1, drawn)), hold_out: false, rate: RATE, average_share: 0.0, lazy: true };
                drawn += batch as u64;
                fused.train_steps(&pool, None, &[step])?;
                Ok(gpu.synchronize()?)
            })?;
            let rate = |seconds: f64, count: usize| count as f64 / seconds;
            println!(
                "| {name} | 2^{} | {:.2} | {:.0} | {:.3} | {:.2} | {differ:.1e} |",
                batch.ilog2(),
                rate(burn, batch) * 1e-6,
                rate(own, batch) * 1e-6,
                rate(theirs, COUNT) * 1e-9,
                rate(ours, COUNT) * 1e-9
            );
        }
    }
    println!();
    Ok(())
}
