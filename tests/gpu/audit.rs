//! Audits on the device against those on the host: the same points, and sums of the same bits from the same traces and predictions.

use super::scenes::*;
use ridgewatch::backend::audit::audit;
use ridgewatch::backend::cuda::{Audits, CudaTracer, Tuning};
use ridgewatch::backend::{AuditRequest, stratified_points};
use ridgewatch::flow::{Boundary, Direction, Extras, FlowMap, Precision, VelocitySource};
use ridgewatch::render::{Transfer, TransferSettings};
use ridgewatch::surrogate::Kind;
use ridgewatch::surrogate::Predict;
use ridgewatch::surrogate::network::NetworkSettings;
use ridgewatch::trust::{CellErrors, Strata};
use std::sync::atomic::AtomicBool;

fn check(source: &VelocitySource, map: &FlowMap, t0: f64, nodes: [usize; 3], strata: &Strata, land: bool) {
    let gpu = gpu();
    let tracer = CudaTracer::new(store(), &gpu, source.clone(), map, t0, Tuning::default()).unwrap();
    assert_eq!(tracer.missing_cells().is_some(), land);
    let surrogate = resident(&gpu, Kind::Table, nodes, &NetworkSettings::default(), &tracer);
    let (frozen, on_device) = (surrogate.freeze().unwrap(), surrogate.table().unwrap().device().unwrap());
    let settings = TransferSettings { low: Some(0.1), high: Some(0.3), ..TransferSettings::default() };
    let transfer = Transfer::new(&settings, 1.0).unwrap();
    let mut audits = Audits::new(&gpu).unwrap();
    for (stream, samples) in [(0, None), (1, Some(Extras { arrival: true, jacobian: true })), (1 << 40, Some(Extras::default()))] {
        let request =
            AuditRequest { strata: strata.clone(), seed: 77, stream, transfer: &transfer, samples, stop: &AtomicBool::new(false) };
        let expected = audit(&request, &tracer, Some(&frozen)).unwrap();
        let found = audits.audit(&request, &tracer, on_device).unwrap();
        assert_eq!((found.drawn, found.points), (expected.drawn, expected.points));
        assert_eq!(land, found.points < found.drawn);
        assert_eq!(found.peak, expected.peak);
        // Sums of the same numbers in f64, in another order.
        assert!((found.mean_lifetime_share - expected.mean_lifetime_share).abs() < 1e-12);
        assert_eq!(found.samples.points, expected.samples.points);
        assert_eq!(found.samples.log_stretch, expected.samples.log_stretch);
        assert_eq!(found.samples.arrival, expected.samples.arrival);
        let jacobians =
            [&found, &expected].map(|findings| findings.samples.jacobian.iter().map(|j| j.map(f32::to_bits)).collect::<Vec<_>>());
        assert_eq!(jacobians[0], jacobians[1]);
        let [found, expected] = [found, expected].map(|findings| findings.errors.unwrap());
        let bits = |cell: &CellErrors| {
            let CellErrors { count, optical, square, fourth, second, third, log_square } = *cell;
            [count, optical, square, fourth, second, third, log_square].map(f64::to_bits)
        };
        for (cell, (found, expected)) in found.cells().iter().zip(expected.cells()).enumerate() {
            assert_eq!(bits(found), bits(expected), "cell {cell}: {found:?} for {expected:?}");
        }
        let total: f64 = found.cells().iter().map(|cell| cell.square).sum();
        assert!(total > 0.0, "the table is not exact");
    }
}

#[test]
#[ignore = "needs a GPU"]
fn sums_are_the_host_s_bits() {
    let clamp = FlowMap { boundary: Boundary::Clamp, precision: Precision::F32, ..map(3.0, 9) };
    let drawn = |cells: usize| (0..cells as u32).map(|cell| cell * 7919 % 61).collect::<Vec<_>>();
    let strata = |shape: [usize; 3]| Strata::new(shape, drawn(shape.iter().product()));
    check(&turbulence([40, 24, 24], 4), &clamp, 0.0, [30, 20, 20], &strata([9, 5, 7]), false);
    // More points than fit a batch, in few cells.
    check(&turbulence([40, 24, 24], 4), &clamp, 0.0, [30, 20, 20], &Strata::even([3, 1, 1], 1_500_000), false);
    check(
        &gyre([0.0, 0.0], [2.0, 1.0]),
        &FlowMap { precision: Precision::F32, ..map(10.0, 40) },
        0.3,
        [20, 10, 1],
        &strata([16, 8, 1]),
        false,
    );
    let backward = FlowMap { direction: Direction::Backward, ..clamp };
    check(&smooth(&cartesian(even(&[40, 30, 20])), 0.6, true), &backward, 3.5, [20, 15, 10], &strata([8, 8, 5]), true);
}

#[test]
#[ignore = "needs a GPU"]
fn memory_is_kept_from_audit_to_audit() {
    let gpu = opened(Default::default());
    let store = ridgewatch::backend::cuda::SnapshotStore::new(&gpu);
    let map = FlowMap { boundary: Boundary::Clamp, precision: Precision::F32, ..map(3.0, 9) };
    let tracer = CudaTracer::new(&store, &gpu, turbulence([40, 24, 24], 4), &map, 0.0, Tuning::default()).unwrap();
    let surrogate = resident(&gpu, Kind::Table, [30, 20, 20], &NetworkSettings::default(), &tracer);
    let table = surrogate.table().unwrap().device().unwrap();
    let transfer = Transfer::new(&TransferSettings { low: Some(0.1), high: Some(0.3), ..TransferSettings::default() }, 1.0).unwrap();
    let mut audits = Audits::new(&gpu).unwrap();
    let mut taken = None;
    for stream in 0..50 {
        let strata = Strata::even([16, 8, 8], 20 + (stream % 7) as u32);
        let points = stratified_points(&strata, 77, stream).len();
        let request = AuditRequest { strata, seed: 77, stream, transfer: &transfer, samples: None, stop: &AtomicBool::new(false) };
        assert_eq!(audits.audit(&request, &tracer, table).unwrap().drawn, points);
        if stream >= 7 {
            assert_eq!(*taken.get_or_insert(gpu.memory().0), gpu.memory().0);
        }
    }
    assert!(surrogate.bytes() > 0 && tracer.host().steps() == 9);
}
