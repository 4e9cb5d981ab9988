//! |tau| of archives whose scene gives none.

use crate::kit::netcdf::{Fixture, NETCDF4, f32s, fill};
use crate::kit::{program::text, scene};
use ridgewatch::run::Setup;

/// Notes and tau of an archive with a snapshot every `interval` seconds, of the steady velocity (u, v) at (x, y).
fn found(xs: &[f64], times: (usize, f64), keys: &str, flow: fn(f64, f64) -> [f64; 2]) -> (f64, String) {
    let folder = tempfile::tempdir().unwrap();
    let times: Vec<f64> = (0..times.0).map(|i| i as f64 * times.1).collect();
    let ys: Vec<f64> = (0..9).map(|i| i as f64 * 0.25 - 1.0).collect();
    let component = |k: usize| f32s(fill(times.len(), ys.len(), xs.len(), |_, y, x| flow(xs[x], ys[y])[k]));
    let axes: [(&str, &str, &[f64]); 3] = [("time", "seconds since 2000-01-01", &times), ("y", "m", &ys), ("x", "m", xs)];
    let file = Fixture::on(NETCDF4, &axes).winds(component(0), component(1)).write(&folder.path().join("flow.nc"));
    let text = scene::scene("archive", [16, 8, 1], &format!("archive.files = [{:?}]\narchive.metric = \"cartesian\"\n{keys}", text(&file)));
    let Setup { plan, notes, .. } = scene::setup(&text, &[]);
    (plan.map.tau, notes.join("\n"))
}

fn evenly(first: f64, last: f64, count: usize) -> Vec<f64> {
    (0..count).map(|i| first + (last - first) * i as f64 / (count - 1) as f64).collect()
}

#[test]
fn neighbours_part() {
    // A shear of rate 1 parts neighbours by 2 sinh(3) = 20.04 seconds; 19 and 28 intervals are tried.
    for keys in ["", "time.direction = \"forward\"", "flow.normalisation = \"lifetime\""] {
        let (tau, notes) = found(&evenly(0.0, 400.0, 41), (80, 1.0), keys, |_, y| [y, 0.0]);
        assert_eq!(tau, 28.0, "{notes}");
        assert!(notes.contains("time.tau is not given: 28 s, in which 9") && notes.contains(" % of the particles part from"), "{notes}");
    }
    // 120 intervals and more, of which every fourth snapshot is held in the end.
    let (tau, notes) = found(&evenly(0.0, 400.0, 41), (481, 1.0 / 6.0), "", |_, y| [y, 0.0]);
    assert!((20.04..=31.0).contains(&tau), "{tau}: {notes}");
}

#[test]
fn particles_leave() {
    // Backward in time the strain of rate 1 moves particles out along y: exp(-tau) of them stay, 0.67 after 4 intervals and 0.55 after 6, however long
    // the archive is.
    for snapshots in [40, 2000] {
        let (tau, notes) = found(&evenly(-1.0, 1.0, 9), (snapshots, 0.1), "", |x, y| [x, -y]);
        assert!((tau - 0.4).abs() < 1e-6 && notes.contains("since 45 % of the particles stop at an edge"), "{tau}: {notes}");
        assert!(notes.contains("over the next longer time"), "{notes}");
    }
    // Too fast for two intervals.
    let (tau, notes) = found(&evenly(-1.0, 1.0, 9), (40, 0.5), "", |x, y| [x, -y]);
    assert!((tau - 1.0).abs() < 1e-6 && notes.contains("over this time"), "{tau}: {notes}");
}

#[test]
fn the_archive_ends() {
    // No stretch at all: half of the span, which is the whole of an archive with two or three snapshots.
    for (snapshots, tau) in [(21, 10.0), (20, 9.5), (3, 2.0), (2, 1.0)] {
        let (found, notes) = found(&evenly(-1.0, 1.0, 9), (snapshots, 1.0), "", |_, _| [1e-3, 0.0]);
        assert_eq!(found, tau, "{notes}");
        assert!(notes.contains("the longest by default, in which 0 % of the particles part"), "{notes}");
    }
}

#[test]
fn memory_ends() {
    // A snapshot of 401 x 9 nodes takes 58 kB, of 1 MiB.
    let (tau, notes) = found(&evenly(0.0, 400.0, 401), (80, 1.0), "archive.memory_gib = 0.001", |_, y| [y, 0.0]);
    assert!(
        (4.0..=13.0).contains(&tau) && notes.contains("longer windows may not be held in memory (archive.memory_gib)"),
        "{tau}: {notes}"
    );
}
