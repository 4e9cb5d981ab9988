//! Measures the network with burn's standard operations on a GPU: rows of the table of `gpu_network speed`, for docs/performance.md.
//! `cargo run --release --features burn-cuda --example gpu_stock_burn`
//!
//! Both use the same parameters; the example stops if their predictions differ. Wall clock between synchronisations, medians of nine (of three where
//! one takes over half a second, of one where over two); random points, targets 0.5. burn's CUDA backend runs without fusion and autotune, as
//! ridgewatch builds burn.

#![allow(clippy::print_stdout)] // a measurement, which prints

use burn::backend::Autodiff;
use burn::module::AutodiffModule;
use burn::optim::{AdamConfig, GradientsParams, Optimizer};
use burn::tensor::backend::Backend;
use burn::tensor::{Tensor, TensorData};
use burn_cuda::{Cuda, CudaDevice};
use ridgewatch::backend::cuda::{DevicePredict, DeviceTraining, Gpu, GpuSettings};
use ridgewatch::field::Domain;
use ridgewatch::surrogate::network::{Architecture, Encoding, Model, Network, NetworkSettings, Objective};
use std::error::Error;
use std::time::Instant;

type Outcome<T> = Result<T, Box<dyn Error>>;
type Stock = Cuda;

const ROUNDS: usize = 9;
/// Number of points per prediction.
const COUNT: usize = 1 << 20;
const RATE: f64 = 1e-3;

/// Median seconds of `work`, which waits for the device.
fn time(mut work: impl FnMut() -> Outcome<()>) -> Outcome<f64> {
    let mut times = Vec::new();
    let wanted = |first: Option<&f64>| match first {
        Some(&first) if first > 2.0 => 1,
        Some(&first) if first > 0.5 => 3,
        _ => ROUNDS,
    };
    while times.len() < wanted(times.first()) {
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
    let hash = |log2_table| NetworkSettings {
        levels: Some(8),
        features: 2,
        growth: Some(2.0),
        log2_table: Some(log2_table),
        ..NetworkSettings::default()
    };
    let frequency =
        |hidden_layers, width| NetworkSettings { encoding: Encoding::Frequency, hidden_layers, width, ..NetworkSettings::default() };
    for (name, settings) in [
        ("frequency 10, 4x64", frequency(4, 64)),
        ("frequency 10, 8x256", frequency(8, 256)),
        ("hash 8x2, growth 2, T = 2^19, 2x64", hash(19)),
        ("hash 8x2, growth 2, T = 2^22, 2x64", hash(22)),
    ] {
        let shape = Architecture::new(&settings, &[0, 1, 2], cube.lengths())?;
        let objective = Objective::new(&settings, &shape, cube.extent(), 1.0);
        let model = Model::new(shape.clone(), 1, false);
        let epsilon = model.epsilon;
        let fused = DeviceTraining::new(&gpu, &model, &objective)?;
        let mut points = gpu.alloc("points", COUNT)?;
        fused.draw_points(&cube, 3, 0, &mut points)?;
        let mut host = vec![[0.0_f32; 3]; COUNT];
        points.read(&mut host)?;
        let values = gpu.upload("values", &vec![0.5_f32; COUNT])?;
        let mut stock = Network::<Autodiff<Stock>>::new(&shape, 1, false, &device);
        let flat: Vec<f32> = host.iter().flatten().copied().collect();
        let at = |count: usize| TensorData::new(flat[..3 * count].to_vec(), [count, 3]);

        let frozen = fused.frozen()?;
        let still = stock.valid();
        let inputs = Tensor::<Stock, 2>::from_data(at(COUNT), &device);
        // SAFETY: both buffers hold `COUNT` entries.
        unsafe { frozen.predict(points.address(), COUNT, values.address()) }?;
        let mut found = vec![0.0_f32; COUNT];
        values.read(&mut found)?;
        let predict = || {
            let outputs = still.forward(&shape, inputs.clone());
            done(Stock::sync(&device))?;
            drop(outputs);
            Ok(())
        };
        // The first call compiles kernels and allocates memory.
        predict()?;
        let predicted = COUNT as f64 / time(predict)?;
        let expected = done(still.forward(&shape, inputs.clone()).into_data().to_vec::<f32>())?;
        let square = |values: &mut dyn Iterator<Item = f32>| values.map(|v| f64::from(v).powi(2)).sum::<f64>().sqrt();
        let scaled = |value: &f32| value * objective.scale.deviation[0] + objective.scale.mean[0];
        let differ = square(&mut found.iter().zip(&expected).map(|(a, b)| a - scaled(b))) / square(&mut expected.iter().map(scaled));
        // Halves carry 11 bits.
        if differ.is_nan() || differ >= 3e-3 {
            return Err(format!("{name}: predictions differ by {differ}").into());
        }

        let mut adam = AdamConfig::new().with_beta_1(0.9).with_beta_2(0.999).with_epsilon(epsilon).init();
        let mut row = format!("| burn 0.21, {name} | {:.2} | {:.2} ", shape.parameters() as f64 * 1e-6, predicted * 1e-9);
        // The first batch compiles kernels and allocates memory.
        for (number, batch) in [1 << 14, 1 << 20, 1 << 18, 1 << 14].into_iter().enumerate() {
            let inputs = Tensor::<Autodiff<Stock>, 2>::from_data(at(batch), &device);
            let wanted = Tensor::<Autodiff<Stock>, 2>::full([batch, 1], 0.5, &device);
            let seconds = time(|| {
                let loss = (stock.forward(&shape, inputs.clone()) - wanted.clone()).powi_scalar(2).mean();
                let gradients = GradientsParams::from_grads(loss.backward(), &stock);
                stock = adam.step(RATE, stock.clone(), gradients);
                done(Stock::sync(&device))
            })?;
            if number > 0 {
                row += &format!("| {:.2} ", batch as f64 / seconds * 1e-6);
            }
        }
        println!("{row}|");
    }
    Ok(())
}
