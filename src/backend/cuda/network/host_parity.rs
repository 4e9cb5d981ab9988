//! Compares the network's kernels, compiled as host C++ with the macros and arguments of a launch, with the CPU's prediction and with its gradient
//! of the loss with derivatives. Needs no GPU.

use crate::cuda::host_parity::{half, library};
use crate::cuda::layout::UnitBoxArgument;
use crate::cuda::network::layout::{GridArgument, ReadingArgument};
use crate::cuda::network::network::{LossTerms, TangentTerm, further_places, grid, network_defines, placed_times, reading};
use crate::router::unit_jacobian;
use ridgewatch_field::{Domain, DomainPoint, UnitPoint};
use ridgewatch_surrogate::Samples;
use ridgewatch_surrogate::network::{
    Architecture, Average, Encoding, Fused, Input, Loss, Model, NetworkSettings, Objective, PlannedStep, Predictor, Scale, Step, Target,
    uniform,
};

type HostPredict = unsafe extern "C" fn(*const GridArgument, *const u16, *const f32, *const ReadingArgument, *const f32, u32, *mut f32);

type HostGradient = unsafe extern "C" fn(
    *const GridArgument,
    *const u16,
    *const f32,
    *const UnitBoxArgument,
    *const ReadingArgument,
    *const f32,
    *const f32,
    *const f32,
    u32,
    f32,
    *mut f32,
    *mut f32,
) -> f64;

const POINTS: usize = 700;

/// Values in [-1, 1).
fn values(seed: u64, count: usize) -> Vec<f32> {
    (0..count as u64).map(|i| 2.0 * uniform(seed, i) - 1.0).collect()
}

/// Tables, which half precision represents exactly, and layers whose values are of order 1.
fn parameters(shape: &Architecture) -> (Vec<f32>, Vec<f32>) {
    let tables = values(1, shape.table_entries() * shape.features).iter().map(|x| (512.0 * x).round() / 1024.0).collect();
    let mut layers = values(2, shape.layer_parameters());
    for layer in &shape.layers {
        let spread = 1.0 / (layer.inputs as f32).sqrt();
        layers[layer.weights..layer.biases].iter_mut().for_each(|weight| *weight *= 2.0 * spread);
    }
    (tables, layers)
}

/// Values of the tables in the layout of the device.
fn padded<T: Copy>(shape: &Architecture, tables: &[f32], zero: T, of: impl Fn(f32) -> T) -> Vec<T> {
    let mut padded = Vec::new();
    for level in &shape.levels {
        padded.extend(tables[level.offset * shape.features..][..level.entries * shape.features].iter().map(|&x| of(x)));
        padded.resize(padded.len().next_multiple_of(64 * shape.features), zero);
    }
    padded
}

fn check(name: &str, settings: &NetworkSettings, axes: &[usize]) {
    let extent = [2.0, 1.0, 1.5];
    let shape = Architecture::new(settings, axes, extent).unwrap();
    let scale = Scale { mean: [0.3, -0.1, 0.2], deviation: [0.7, 1.3, 0.4] };
    let objective = Objective { scale, ..Objective::new(settings, &shape, extent, 2.5) };
    let (tables, layers) = parameters(&shape);
    let times = [0.3, 0.8];
    let mut points: Vec<UnitPoint> =
        values(3, 3 * POINTS).chunks_exact(3).map(|p| UnitPoint([p[0], p[1], p[2]].map(|x| 0.5 * x + 0.5))).collect();
    points.extend([[0.0; 3], [1.0; 3], [1.0, 0.0, 1.0]].map(UnitPoint));

    let mut expected = vec![f32::NAN; points.len()];
    Predictor::new(&shape, &layers).log_stretch(&shape, &objective, &tables, &points, times, &mut expected);

    let (levels, room) = grid(&shape).unwrap();
    let halves = padded(&shape, &tables, 0, half);
    assert_eq!(halves.len(), room);
    let folder = tempfile::tempdir().unwrap();
    let library = library(folder.path(), "network/host_network.cpp", &network_defines(&shape, LossTerms::default()).unwrap());
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

/// Loss and gradient of traced points with derivatives in the loss, against one step of the CPU's training.
fn check_gradient(name: &str, settings: &NetworkSettings, axes: &[usize]) {
    let domain = Domain::cuboid([-1.0, 0.5, 0.0], [1.0, 1.5, 1.5]);
    let extent = domain.extent();
    let settings = NetworkSettings { jacobian_weight: 0.3, ..settings.clone() };
    let shape = Architecture::new(&settings, axes, extent).unwrap();
    let scale = Scale { mean: [0.3, -0.1, 0.2], deviation: [0.7, 1.3, 0.4] };
    let objective = Objective { scale, ..Objective::new(&settings, &shape, extent, 2.5) };
    let (tables, layers) = parameters(&shape);
    let times = [0.3, 0.8];
    let places = |seed: u64| values(seed, 3 * POINTS);
    let point = |p: &[f32]| DomainPoint(std::array::from_fn(|k| (domain.min[k] + extent[k] * f64::from(0.5 * p[k] + 0.5)) as f32));
    let mut points: Vec<DomainPoint> = places(3).chunks_exact(3).map(point).collect();
    let mut arrivals: Vec<DomainPoint> = places(4).chunks_exact(3).map(point).collect();
    let mut jacobians: Vec<[f32; 9]> = values(5, 9 * POINTS).chunks_exact(9).map(|j| std::array::from_fn(|k| 3.0 * j[k])).collect();

    let samples = Samples {
        points: points.iter().map(|&point| domain.to_unit(point)).collect(),
        log_stretch: vec![0.0; POINTS],
        arrival: arrivals.iter().map(|&arrival| domain.to_unit_unclamped(arrival)).collect(),
        jacobian: jacobians.iter().map(|jacobian| unit_jacobian(&domain, jacobian)).collect(),
        times: vec![times; POINTS],
    };
    let mut model = Model::new(shape.clone(), 0, false);
    let nothing = |values: &[f32]| vec![0.0; values.len()];
    model.set_state([[tables.clone(), nothing(&tables), nothing(&tables)], [layers.clone(), nothing(&layers), nothing(&layers)]], 0);
    let mut average = Average { tables: tables.clone(), layers: layers.clone() };
    let planned = PlannedStep { count: POINTS, drawn: None, hold_out: false, rate: 1e-9, average_share: 0.0, lazy: false };
    let mut expected_loss = f64::NAN;
    Fused::new(&model, &objective, POINTS).steps(&mut model, &objective, &mut average, |done, loss| {
        expected_loss = loss.unwrap_or(expected_loss);
        (done == 0).then(|| Step::of(&planned, &samples, None, None))
    });
    // After one step from no moments the first one is a tenth of the gradient.
    let [[_, of_tables, _], [_, of_layers, _]] = model.state();
    let of_tables = padded(&shape, &of_tables, 0.0, |moment| 10.0 * moment);
    let of_layers: Vec<f32> = of_layers.into_iter().map(|moment| 10.0 * moment).collect();

    // Points whose derivatives are not finite add nothing.
    for broken in [f32::NAN, f32::INFINITY] {
        points.push(points[0]);
        arrivals.push(arrivals[0]);
        jacobians.push(std::array::from_fn(|k| if k == 3 * axes[0] + axes[1] { broken } else { jacobians[0][k] }));
    }
    let (levels, room) = grid(&shape).unwrap();
    let halves = padded(&shape, &tables, 0, half);
    let folder = tempfile::tempdir().unwrap();
    let library = library(folder.path(), "network/host_network.cpp", &network_defines(&shape, LossTerms::of(&objective)).unwrap());
    // SAFETY: the function has this signature.
    let gradient: libloading::Symbol<HostGradient> = unsafe { library.get(b"host_gradient") }.unwrap();
    let given = reading(&shape, &objective, placed_times(&shape, Some(times)), None, 1.0);
    let found = |factor: f32| {
        let (mut on_tables, mut on_layers) = (vec![0.0_f32; room], vec![0.0_f32; layers.len()]);
        // SAFETY: all memory is live and as large as the function presumes.
        let loss = unsafe {
            gradient(
                &levels,
                halves.as_ptr(),
                layers.as_ptr(),
                &UnitBoxArgument::new(&domain),
                &given,
                points.as_ptr().cast(),
                arrivals.as_ptr().cast(),
                jacobians.as_ptr().cast(),
                points.len() as u32,
                factor,
                on_tables.as_mut_ptr(),
                on_layers.as_mut_ptr(),
            )
        };
        // The sums are over outputs and batch.
        let share = 1.0 / (POINTS * shape.outputs()) as f32;
        let scaled = |sums: Vec<f32>| sums.into_iter().map(|sum| share * sum).collect::<Vec<_>>();
        (loss * f64::from(share), scaled(on_tables), scaled(on_layers))
    };
    let norm = |values: &mut dyn Iterator<Item = f32>| values.map(|x| f64::from(x).powi(2)).sum::<f64>().sqrt();
    let apart = |found: &[f32], expected: &[f32]| {
        norm(&mut found.iter().zip(expected).map(|(a, b)| a - b)) / norm(&mut expected.iter().copied()).max(f64::MIN_POSITIVE)
    };
    let (loss, tables_found, layers_found) = found(TangentTerm::of(&shape, &objective).unwrap().factor);
    let errors = [(loss / expected_loss - 1.0).abs(), apart(&tables_found, &of_tables), apart(&layers_found, &of_layers)];
    // Sums in single precision in another order.
    assert!(errors.iter().all(|&error| error < 1e-5), "{name}: {errors:?}");
    // The derivatives are a large part of both.
    let (without, _, layers_without) = found(0.0);
    assert!(without < 0.9 * loss && apart(&layers_without, &of_layers) > 0.1, "{name}: {without} of {loss}");
}

fn usual() -> NetworkSettings {
    NetworkSettings {
        levels: Some(3),
        features: 2,
        log2_table: Some(9),
        base_resolution: Some(4),
        growth: Some(2.0),
        octaves: 4,
        width: 16,
        target: Target::FlowMap,
        ..NetworkSettings::default()
    }
}

#[test]
fn gradients_with_derivatives_in_the_loss() {
    let usual = usual();
    let (plane, space) = (&[0, 1][..], &[0, 1, 2][..]);
    let frequency = NetworkSettings { encoding: Encoding::Frequency, ..usual.clone() };
    let both = vec![Input::Start, Input::Duration];
    check_gradient("the plane", &usual, plane);
    check_gradient("space, 4 features, 3 layers", &NetworkSettings { features: 4, hidden_layers: 3, ..usual.clone() }, space);
    check_gradient("x and z, 1 feature, odd width", &NetworkSettings { features: 1, width: 21, ..usual.clone() }, &[0, 2]);
    check_gradient("space and start", &NetworkSettings { inputs: vec![Input::Start], ..usual.clone() }, space);
    check_gradient("one hidden layer", &NetworkSettings { hidden_layers: 1, ..usual }, plane);
    check_gradient("frequencies", &frequency, space);
    check_gradient("frequencies and both times", &NetworkSettings { inputs: both, ..frequency }, space);
}

#[test]
fn networks() {
    let usual = usual();
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
