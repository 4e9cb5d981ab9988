//! The table on the device against the CPU's.

use super::scenes::*;
use ridgewatch::backend::cuda::{CudaTracer, DeviceTable, OnGpu, Tuning};
use ridgewatch::field::Axis;
use ridgewatch::flow::{Boundary, FlowMap, Precision, VelocitySource, cpu_tracer};
use ridgewatch::surrogate::network::NetworkSettings;
use ridgewatch::surrogate::{HostSurrogate, Hybrid, Kind, Predict, SurrogateSettings, SurrogateTable as _, Table, build};

fn on_device(tracer: &CudaTracer, nodes: [usize; 3]) -> Hybrid<OnGpu> {
    resident(&gpu(), Kind::Table, nodes, &NetworkSettings::default(), tracer)
}

fn on_host(source: &VelocitySource, map: &FlowMap, nodes: [usize; 3]) -> HostSurrogate {
    let settings = SurrogateSettings { table_nodes: Some(nodes), ..SurrogateSettings::default() };
    let tracer = cpu_tracer(source.clone(), map, 0.0).unwrap();
    build(&settings, &NetworkSettings::default(), &domain(source), 5, &tracer).unwrap()
}

/// The values, brought over.
fn values(surrogate: &Hybrid<OnGpu>) -> Table {
    surrogate.table().unwrap().to_host().unwrap()
}

fn check(source: &VelocitySource, nodes: [usize; 3]) {
    let map = FlowMap { boundary: Boundary::Clamp, precision: Precision::F32, ..map(3.0, 9) };
    let gpu = gpu();
    let tracer = CudaTracer::new(store(), &gpu, source.clone(), &map, 0.0, Tuning::default()).unwrap();
    let there = on_device(&tracer, nodes);
    let table = values(&there);
    let double = on_host(source, &FlowMap { precision: Precision::F64, ..map.clone() }, nodes);
    let mut host = on_host(source, &map, nodes);
    let (exact, single) = (double.table().unwrap(), host.table().unwrap());
    assert_eq!((table.nodes(), table.not_finite()), (exact.nodes(), exact.not_finite()));
    // Rounding in single precision, amplified by the stretch (up to e^4): no worse than the CPU's. Nodes on a cell face may take the gradient of
    // either side, as theirs do.
    let errors = |values: &[f32]| {
        let mut errors: Vec<f32> = values.iter().zip(exact.values()).map(|(a, b)| (a - b).abs()).collect();
        errors.sort_by(f32::total_cmp);
        [90, 99].map(|percent| errors[errors.len() * percent / 100])
    };
    let (ours, theirs) = (errors(table.values()), errors(single.values()));
    println!("{nodes:?}: 90 and 99 % of the nodes are within {ours:?}, the CPU's single precision within {theirs:?}");
    for (ours, theirs) in ours.into_iter().zip(theirs) {
        assert!(ours <= 3.0 * theirs + 2e-6, "{nodes:?}: off by {ours:e}, the CPU by {theirs:e}");
    }
    // Lookups in and around the unit cube, against the same values on the host: every one.
    let file = tempfile::NamedTempFile::new().unwrap();
    there.save(file.path()).unwrap();
    host.load(file.path()).unwrap();
    let points = fresh_unit(-0.1, 1.1, 30_001);
    let (mut found, mut here) = (vec![f32::NAN; points.len()], vec![f32::NAN; points.len()]);
    assert!(there.table().unwrap().device().is_ok());
    there.predict(&points, &mut found).unwrap();
    host.predict(&points, &mut here).unwrap();
    for (point, (there, here)) in points.iter().zip(found.iter().zip(&here)) {
        // Seven interpolations between values of up to 5, each rounded once or, where the CPU does not fuse, twice.
        assert!((there - here).abs() <= 5e-6, "{nodes:?} at {point:?}: {there} on the device, {here} on the host");
    }
}

#[test]
#[ignore = "needs a GPU"]
fn tables_are_the_cpus() {
    check(&turbulence([40, 24, 24], 4), [40, 24, 24]);
    check(&turbulence([40, 24, 24], 4), [83, 47, 5]);
    check(&gyre([0.0, 0.0], [2.0, 1.0]), [101, 51, 77]);
    check(&smooth(&cartesian(even(&[19, 13])), 0.6, false), [37, 25, 1]);
}

/// The table of a surrogate stays on the device: what it answers there, what comes over, and what a checkpoint holds.
#[test]
#[ignore = "needs a GPU"]
fn a_table_of_a_run_stays_on_the_device() {
    let (gpu, map) = (gpu(), FlowMap { boundary: Boundary::Clamp, precision: Precision::F32, ..map(3.0, 9) });
    let nodes = [83, 47, 50];
    let source = turbulence([40, 24, 24], 5);
    let tracer = |t0: f64| CudaTracer::new(store(), &gpu, source.clone(), &map, t0, Tuning::default()).unwrap();
    let domain = domain(&source);
    let mut table = on_device(&tracer(0.0), nodes);
    let points = fresh_unit(0.0, 1.0, 30_001);
    for t0 in [0.0, 1.0] {
        if t0 > 0.0 {
            let frozen = table.freeze().unwrap();
            table.window_slid(&tracer(t0)).unwrap();
            let (mut before, mut after) = (vec![f32::NAN; points.len()], vec![f32::NAN; points.len()]);
            frozen.predict(&points, &mut before).unwrap();
            table.predict(&points, &mut after).unwrap();
            assert_ne!(before, after, "what a frame renders with stays that of its window");
        }
        let expected = DeviceTable::trace(tracer(t0).device(), &domain, nodes).unwrap();
        assert!(table.table().unwrap().device().is_ok());
        let mut there = vec![f32::NAN; points.len()];
        table.predict(&points, &mut there).unwrap();
        let found = values(&table);
        assert_eq!(found.values(), expected.values().unwrap(), "the same kernels");
        assert_eq!(found.not_finite(), expected.not_finite());
        let file = tempfile::NamedTempFile::new().unwrap();
        table.save(file.path()).unwrap();
        let mut restored = on_host(&source, &map, nodes);
        restored.load(file.path()).unwrap();
        assert_eq!(restored.table().unwrap().values(), found.values());
        let mut here = vec![f32::NAN; points.len()];
        restored.predict(&points, &mut here).unwrap();
        // Seven interpolations between values of up to 5, each rounded once or, where the CPU does not fuse, twice.
        assert!(there.iter().zip(&here).all(|(a, b)| (a - b).abs() <= 5e-6), "on the device and on the host");
    }
}

/// Nodes on edges that single precision rounds outwards are traced from within, as on the CPU.
#[test]
#[ignore = "needs a GPU"]
fn what_starts_on_an_edge_starts_inside() {
    let axes = [(0.7, 1.7), (0.1, 1.1), (-1.7, -0.7)].into_iter().zip(["x", "y", "z"]);
    let source = smooth(&cartesian(axes.map(|((low, high), name)| Axis::uniform(name, "", low, high, 9).unwrap()).collect()), 0.05, false);
    for boundary in [Boundary::Stop, Boundary::Clamp] {
        let map = FlowMap { boundary, precision: Precision::F64, ..map(3.0, 30) };
        let tracer = CudaTracer::new(store(), &gpu(), source.clone(), &map, 0.0, Tuning::default()).unwrap();
        let (there, here) = (values(&on_device(&tracer, [17, 17, 17])), on_host(&source, &map, [17, 17, 17]));
        let (there, here) = (there.values(), here.table().unwrap().values());
        let moves = (0..17 * 17).filter(|i| here[i * 17] != 0.0).count();
        assert!(moves > 17 * 17 / 4, "{boundary:?}: {moves} nodes of the lower edge move into the domain");
        let apart = there.iter().zip(here).filter(|(there, here)| (*there - *here).abs() > 1e-4).count();
        assert!(apart <= 17 * 17 * 17 / 500, "{boundary:?}: {apart} nodes differ");
    }
}

static NEVER: std::sync::atomic::AtomicBool = std::sync::atomic::AtomicBool::new(false);

/// A finer table, traced in parts beside a frame's work, is the same as one that is traced at once, and the next window has the former nodes.
#[test]
#[ignore = "needs a GPU"]
fn a_table_is_refined_part_by_part() {
    let (gpu, map) = (gpu(), FlowMap { boundary: Boundary::Clamp, precision: Precision::F32, ..map(3.0, 9) });
    let source = turbulence([40, 24, 24], 5);
    let tracer = |t0: f64| CudaTracer::new(store(), &gpu, source.clone(), &map, t0, Tuning::default()).unwrap();
    let (few, many) = ([40, 24, 24], [79, 47, 47]);
    let here = tracer(0.0);
    let mut table = on_device(&here, few);
    let coarse = values(&table);
    let mut parts = 1;
    while !table.refine_table(&here, many, 50_000, &NEVER).unwrap() {
        let present = table.table().unwrap().device().unwrap().values().unwrap();
        assert_eq!(present, coarse.values(), "frames are drawn with the present table meanwhile");
        parts += 1;
    }
    assert!(parts > 3, "{parts} parts");
    assert_eq!(table.table_nodes(), Some(many));
    let expected = DeviceTable::trace(here.device(), &domain(&source), many).unwrap();
    assert_eq!(values(&table).values(), expected.values().unwrap());
    table.window_slid(&tracer(1.0)).unwrap();
    assert_eq!(values(&table).nodes(), few);
}
