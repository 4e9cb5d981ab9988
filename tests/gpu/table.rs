//! The table on the device against the CPU's.

use super::scenes::*;
use ridgewatch::engine::cuda::{CudaTracer, DevicePredict, DeviceTable, Tuning};
use ridgewatch::flow::{Boundary, FlowMap, Precision, VelocitySource, cpu_tracer};
use ridgewatch::surrogate::{Predict, Surrogate, Table};

fn check(source: &VelocitySource, nodes: [usize; 3]) {
    let map = FlowMap { boundary: Boundary::Clamp, precision: Precision::F32, ..map(3.0, 9) };
    let gpu = gpu();
    let domain = domain(source);
    let tracer = CudaTracer::new(store(), &gpu, source.clone(), &map, 0.0, Tuning::default()).unwrap();
    let table = DeviceTable::trace(tracer.device(), &domain, nodes).unwrap();
    let exact = Table::trace(&*cpu_tracer(source.clone(), &FlowMap { precision: Precision::F64, ..map }, 0.0).unwrap(), nodes);
    assert_eq!((table.nodes(), table.not_finite()), (exact.nodes(), exact.not_finite()));
    let values = table.values().unwrap();
    let mut errors: Vec<f32> = values.iter().zip(exact.values()).map(|(a, b)| (a - b).abs()).collect();
    errors.sort_by(f32::total_cmp);
    // Rounding in single precision, amplified by the stretch (up to e^4); nodes on a cell face may take the gradient of either side.
    assert!(errors[errors.len() * 9 / 10] < 2e-5, "{}", errors[errors.len() * 9 / 10]);
    // Lookups: the very table, on the CPU.
    let points = fresh(&ridgewatch::field::Domain::cuboid([-0.1; 3], [1.1; 3]), 30_001);
    let flat = gpu.upload("points", &points).unwrap();
    let out = gpu.upload("values", &vec![f32::NAN; points.len()]).unwrap();
    // SAFETY: both buffers hold as many entries as there are points.
    unsafe { table.predict(flat.address(), points.len(), out.address()) }.unwrap();
    let mut found = vec![f32::NAN; points.len()];
    out.read(&mut found).unwrap();
    let mut expected = vec![0.0; points.len()];
    exact.predict(&points, &mut expected);
    let mut errors: Vec<f32> = found.iter().zip(&expected).map(|(a, b)| (a - b).abs()).collect();
    assert!(errors.iter().all(|e| !e.is_nan()), "every point has a value");
    errors.sort_by(f32::total_cmp);
    assert!(errors[errors.len() * 8 / 10] < 1e-4, "{}", errors[errors.len() * 8 / 10]);
}

#[test]
#[ignore = "needs a GPU"]
fn tables_are_the_cpus() {
    check(&turbulence([40, 24, 24], 4), [40, 24, 24]);
    check(&turbulence([40, 24, 24], 4), [83, 47, 5]);
    check(&gyre([0.0, 0.0], [2.0, 1.0]), [101, 51, 77]);
    check(&smooth(&cartesian(even(&[19, 13])), 0.6, false), [37, 25, 1]);
}

/// A table traced through the engine's seam stays on the device: what it answers there, what comes over, and what a checkpoint holds.
#[test]
#[ignore = "needs a GPU"]
fn a_table_of_a_run_stays_on_the_device() {
    let (gpu, map) = (gpu(), FlowMap { boundary: Boundary::Clamp, precision: Precision::F32, ..map(3.0, 9) });
    let nodes = [83, 47, 50];
    let source = turbulence([40, 24, 24], 5);
    let tracer = |t0: f64| CudaTracer::new(store(), &gpu, source.clone(), &map, t0, Tuning::default()).unwrap();
    let domain = domain(&source);
    let mut table = Table::trace(&tracer(0.0), nodes);
    let points = fresh(&ridgewatch::field::Domain::cuboid([0.0; 3], [1.0; 3]), 30_001);
    for t0 in [0.0, 1.0] {
        if t0 > 0.0 {
            let frozen = table.freeze();
            table.window_slid(&tracer(t0));
            let (mut before, mut after) = (vec![f32::NAN; points.len()], vec![f32::NAN; points.len()]);
            frozen.predict(&points, &mut before);
            table.predict(&points, &mut after);
            assert_ne!(before, after, "what a frame renders with stays that of its window");
        }
        let expected = DeviceTable::trace(tracer(t0).device(), &domain, nodes).unwrap();
        assert!(DeviceTable::of(&table).is_some());
        let mut there = vec![f32::NAN; points.len()];
        table.predict(&points, &mut there);
        assert_eq!(table.values(), expected.values().unwrap(), "the same kernels");
        assert_eq!(table.not_finite(), expected.not_finite());
        let file = tempfile::NamedTempFile::new().unwrap();
        table.save(file.path()).unwrap();
        let mut restored = Table::trace(&*cpu_tracer(source.clone(), &map, 0.0).unwrap(), nodes);
        restored.load(file.path()).unwrap();
        assert_eq!(restored.values(), table.values());
        let mut here = vec![f32::NAN; points.len()];
        restored.predict(&points, &mut here);
        // Seven interpolations between values of up to 5, each rounded once or, where the CPU does not fuse, twice.
        assert!(there.iter().zip(&here).all(|(a, b)| (a - b).abs() <= 5e-6), "on the device and on the host");
    }
    assert_eq!(gpu.health().failure(), None);
}
