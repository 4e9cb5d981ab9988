//! scratch
#![allow(clippy::print_stdout, clippy::unwrap_used, missing_docs)]
use ridgewatch::surrogate::Samples;
use ridgewatch::surrogate::network::*;
fn main() {
    let a: Vec<String> = std::env::args().collect();
    let dims: usize = a[1].parse().unwrap();
    let mode = a[2].as_str();
    let steps: u64 = a[3].parse().unwrap();
    let settings = NetworkSettings::default();
    let extent = [2.0, 1.0, 1.0];
    let axes: Vec<usize> = (0..dims).collect();
    let shape = std::sync::Arc::new(Architecture::new(&settings, &axes, extent).unwrap());
    let mut model = Model::new((*shape).clone(), 1, false);
    let n = 1 << 20;
    let mut st = 1_u64;
    let mut r = || { st = st.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407); (st >> 40) as f32 / (1_u64 << 24) as f32 };
    let points: Vec<[f32; 3]> = (0..n).map(|_| std::array::from_fn(|_| r())).collect();
    let log_stretch = points.iter().map(|p| (9.0 * p[0]).sin() * (7.0 * p[1]).cos() + p[2]).collect();
    let samples = Samples { points, log_stretch, ..Samples::default() };
    let objective = Objective::new(&settings, &shape, extent, 10.0);
    let t = std::time::Instant::now();
    if mode == "train" {
        let mut average = Average { tables: model.tables(), layers: model.layers() };
        let mut fused = Fused::new(&model, &objective, 1 << 14);
        fused.steps(&mut model, &objective, &mut average, |done, _| {
            let pick = Pick::Random { seed: 1, counter: done << 14, among: None, hold_out: false };
            (done < steps).then_some(Step { samples: &samples, pick, count: 1 << 14, rate: 1e-3, average_share: if done % 4 == 0 { 0.01 } else { 0.0 }, lazy: true, base: None })
        });
    } else {
        let flat: Vec<f32> = samples.points[..1 << 16].iter().flat_map(|p| p[..dims].to_vec()).collect();
        let points = burn::tensor::Tensor::<burn::backend::Flex, 2>::from_data(burn::tensor::TensorData::new(flat, [1 << 16, dims]), &Default::default());
        for _ in 0..steps / 4 { model.module.forward_fused(&shape, points.clone()); }
    }
    println!("{} M samples in {:?}", (steps << 14) as f64 / 1e6, t.elapsed());
}
