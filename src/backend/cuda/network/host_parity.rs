//! Compares the network's kernels, compiled as host C++ with the macros and arguments of a launch, with the CPU's prediction. Needs no GPU.

use crate::cuda::host_parity::{half, library};
use crate::cuda::network::layout::{GridArgument, ReadingArgument};
use crate::cuda::network::network::{further_places, grid, network_defines, placed_times, reading};
use ridgewatch_field::UnitPoint;
use ridgewatch_surrogate::network::{Architecture, Encoding, Input, Loss, NetworkSettings, Objective, Predictor, Scale, Target, uniform};

type HostPredict = unsafe extern "C" fn(*const GridArgument, *const u16, *const f32, *const ReadingArgument, *const f32, u32, *mut f32);

const POINTS: usize = 700;

/// Values in [-1, 1).
fn values(seed: u64, count: usize) -> Vec<f32> {
    (0..count as u64).map(|i| 2.0 * uniform(seed, i) - 1.0).collect()
}

fn check(name: &str, settings: &NetworkSettings, axes: &[usize]) {
    let extent = [2.0, 1.0, 1.5];
    let shape = Architecture::new(settings, axes, extent).unwrap();
    let scale = Scale { mean: [0.3, -0.1, 0.2], deviation: [0.7, 1.3, 0.4] };
    let objective = Objective { scale, ..Objective::new(settings, &shape, extent, 2.5) };
    // Half precision represents these tables exactly.
    let tables: Vec<f32> = values(1, shape.table_entries() * shape.features).iter().map(|x| (512.0 * x).round() / 1024.0).collect();
    let mut layers = values(2, shape.layer_parameters());
    for layer in &shape.layers {
        let spread = 1.0 / (layer.inputs as f32).sqrt();
        layers[layer.weights..layer.biases].iter_mut().for_each(|weight| *weight *= 2.0 * spread);
    }
    let times = [0.3, 0.8];
    let mut points: Vec<UnitPoint> =
        values(3, 3 * POINTS).chunks_exact(3).map(|p| UnitPoint([p[0], p[1], p[2]].map(|x| 0.5 * x + 0.5))).collect();
    points.extend([[0.0; 3], [1.0; 3], [1.0, 0.0, 1.0]].map(UnitPoint));

    let mut expected = vec![f32::NAN; points.len()];
    Predictor::new(&shape, &layers).log_stretch(&shape, &objective, &tables, &points, times, &mut expected);

    let (levels, padded) = grid(&shape).unwrap();
    let mut halves = Vec::with_capacity(padded);
    for level in &shape.levels {
        halves.extend(tables[level.offset * shape.features..][..level.entries * shape.features].iter().map(|&x| half(x)));
        halves.resize(halves.len().next_multiple_of(64 * shape.features), 0);
    }
    assert_eq!(halves.len(), padded);
    let folder = tempfile::tempdir().unwrap();
    let library = library(folder.path(), "network/host_network.cpp", &network_defines(&shape, false).unwrap());
    // SAFETY: the function has this signature.
    let predict: libloading::Symbol<HostPredict> = unsafe { library.get(b"host_predict") }.unwrap();
    let found = |points: &[[f32; 3]], reading: &ReadingArgument| {
        let mut out = vec![f32::NAN; points.len()];
        // SAFETY: all memory is live and as large as the function presumes.
        unsafe {
            predict(&levels, halves.as_ptr(), layers.as_ptr(), reading, points.as_ptr().cast(), points.len() as u32, out.as_mut_ptr())
        };
        out
    };
    let given = reading(&shape, &objective, placed_times(&shape, Some(times)), None, 1.0);
    let compare = |found: &[f32], how: &str| {
        for ((found, expected), point) in found.iter().zip(&expected).zip(&points) {
            // Sums in single precision in another order; slopes are about a hundred times the values.
            assert!((found - expected).abs() <= 2e-4 * expected.abs().max(1.0), "{name}, {how}, {point:?}: {found}, not {expected}");
        }
    };
    compare(&found(bytemuck::cast_slice(&points), &given), "given times");
    // The same times in the points, each at its place.
    let placed = placed_times(&shape, Some(times));
    let with_times: Vec<[f32; 3]> =
        points.iter().map(|p| std::array::from_fn(|k| if placed[k].is_nan() { p.0[k] } else { placed[k] })).collect();
    let further: Vec<f32> = points.iter().flat_map(|_| placed[3..][..further_places(&shape)].to_vec()).collect();
    let further = if further.is_empty() { 0 } else { further.as_ptr() as u64 };
    compare(&found(&with_times, &ReadingArgument { times: [f32::NAN; 5], further, ..given }), "times of points");
}

#[test]
fn networks() {
    let usual = NetworkSettings {
        levels: Some(3),
        features: 2,
        log2_table: Some(9),
        base_resolution: Some(4),
        growth: Some(2.0),
        octaves: 4,
        width: 16,
        target: Target::FlowMap,
        ..NetworkSettings::default()
    };
    let (plane, space) = (&[0, 1][..], &[0, 1, 2][..]);
    let both = vec![Input::Start, Input::Duration];
    let frequency = NetworkSettings { encoding: Encoding::Frequency, ..usual.clone() };
    let ftle = NetworkSettings { target: Target::Ftle, ..usual.clone() };
    check("flow map in the plane", &usual, plane);
    check("flow map in space, 4 features", &NetworkSettings { features: 4, hidden_layers: 3, ..usual.clone() }, space);
    check("flow map along x and z, 1 feature", &NetworkSettings { features: 1, width: 21, ..usual.clone() }, &[0, 2]);
    check("flow map in space and start", &NetworkSettings { inputs: vec![Input::Start], ..usual.clone() }, space);
    check("flow map in the plane and both times", &NetworkSettings { inputs: both.clone(), ..usual.clone() }, plane);
    check("flow map, frequencies", &frequency, space);
    check("flow map, frequencies and both times", &NetworkSettings { inputs: both.clone(), ..frequency.clone() }, space);
    check("log-stretch in space and start", &NetworkSettings { inputs: vec![Input::Start], ..ftle.clone() }, space);
    check("log-stretch in the plane and both times", &NetworkSettings { inputs: both, ..ftle }, plane);
    let published = NetworkSettings { target: Target::Ftle, loss: Loss::Published, inputs: vec![Input::Duration], ..frequency };
    check("log-stretch, published", &published, space);
}
