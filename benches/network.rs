//! Fused network against burn's stock operations, in one run on the same cores: inference, training steps, and the parts between.
//!
//! `cargo bench --bench network` (under a minute). Ratios compare the fastest of alternating runs, which other processes disturb least.
#![allow(clippy::print_stdout, clippy::unwrap_used, missing_docs)]

use burn::backend::Flex;
use burn::tensor::{Tensor, TensorData};
use ridgewatch::field::UnitPoint;
use ridgewatch::surrogate::Samples;
use ridgewatch::surrogate::network::{
    Architecture, Average, Encoding, Fused, Model, Network, NetworkSettings, Objective, PlannedStep, Step, operation_step, stock_step,
};
use std::sync::Arc;
use std::time::Instant;

fn samples(count: usize) -> Samples {
    let mut state = 1_u64;
    let mut random = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 40) as f32 / (1_u64 << 24) as f32
    };
    let points: Vec<UnitPoint> = (0..count).map(|_| UnitPoint(std::array::from_fn(|_| random()))).collect();
    let log_stretch = points.iter().map(|p| (9.0 * p.0[0]).sin() * (7.0 * p.0[1]).cos() + p.0[2]).collect();
    Samples { points, log_stretch, ..Samples::default() }
}

fn seconds(mut work: impl FnMut()) -> f64 {
    let start = Instant::now();
    work();
    start.elapsed().as_secs_f64()
}

/// The fastest of `rounds` alternating runs of each.
fn compare(rounds: usize, mut works: Vec<Box<dyn FnMut() + '_>>) -> Vec<f64> {
    works.iter_mut().for_each(|work| work());
    let mut times = vec![f64::INFINITY; works.len()];
    for _ in 0..rounds {
        for (work, times) in works.iter_mut().zip(&mut times) {
            *times = times.min(seconds(&mut **work));
        }
    }
    times
}

fn measure(name: &str, settings: &NetworkSettings, dimensions: usize, inference: usize, training: usize, rounds: usize) {
    let extent = [2.0, 1.0, 1.0];
    let axes: Vec<usize> = (0..dimensions).collect();
    let shape = Arc::new(Architecture::new(settings, &axes, extent).unwrap());
    let model = Model::new((*shape).clone(), 1, false);
    let samples = samples(inference.max(training));
    let objective = Objective::new(settings, &shape, extent, 10.0);
    println!("{name}: {} parameters, encoded {}", shape.parameters(), shape.encoded());

    let device = Default::default();
    let flat: Vec<f32> = samples.points[..inference].iter().flat_map(|p| p.0[..dimensions].to_vec()).collect();
    let points = Tensor::<Flex, 2>::from_data(TensorData::new(flat, [inference, dimensions]), &device);
    let network: &Network<Flex> = &model.module;
    let times = compare(
        rounds,
        vec![
            Box::new(|| drop(network.forward(&shape, points.clone()).into_data())),
            Box::new(|| drop(network.forward_fused(&shape, points.clone()).into_data())),
        ],
    );
    println!(
        "  inference, batch {inference}: stock {:.2} M/s, fused {:.2} M/s, ratio {:.1}",
        inference as f64 / times[0] / 1e6,
        inference as f64 / times[1] / 1e6,
        times[0] / times[1]
    );

    let (mut stock, mut operation, mut production) = (model.clone(), model.clone(), model.clone());
    let mut average = Average { tables: model.tables(), layers: model.layers() };
    let mut fused = Fused::new(&production, &objective, training);
    let times = compare(
        rounds,
        vec![
            Box::new(|| {
                stock_step(&mut stock, &objective, &samples, training, 1e-3);
            }),
            Box::new(|| {
                operation_step(&mut operation, &objective, &samples, training, 1e-3);
            }),
            Box::new(|| {
                fused.steps(&mut production, &objective, &mut average, |done, _| {
                    let planned = PlannedStep {
                        count: training,
                        drawn: Some((1, done * training as u64)),
                        hold_out: false,
                        rate: 1e-3,
                        average_share: 0.01,
                        lazy: true,
                    };
                    (done < 4).then_some(Step::of(&planned, &samples, None, None))
                });
            }),
        ],
    );
    let rate = |time: f64| training as f64 / time / 1e6;
    println!(
        "  training, batch {training}: stock {:.3} M/s, fused operation {:.3} M/s (ratio {:.1}), train_steps {:.3} M/s (ratio {:.1})",
        rate(times[0]),
        rate(times[1]),
        times[0] / times[1],
        rate(times[2] / 4.0),
        times[0] / (times[2] / 4.0)
    );
}

fn main() {
    // `cargo bench` passes `--bench`; any other word selects the cases whose names contain it.
    let wanted = std::env::args().skip(1).find(|word| !word.starts_with('-')).unwrap_or_default();
    let default = NetworkSettings::default();
    let published = NetworkSettings { encoding: Encoding::Frequency, hidden_layers: 8, width: 256, ..default.clone() };
    println!("{} threads", rayon::current_num_threads());
    for (name, settings, dimensions, inference, training, rounds) in [
        ("hash grid, 2 axes (default)", &default, 2, 1 << 16, 1 << 14, 25),
        ("hash grid, 3 axes (default)", &default, 3, 1 << 16, 1 << 14, 9),
        ("frequency 8x256 (published), 2 axes", &published, 2, 1 << 14, 1 << 13, 3),
    ] {
        if name.contains(&wanted) {
            measure(name, settings, dimensions, inference, training, rounds);
        }
    }
}
