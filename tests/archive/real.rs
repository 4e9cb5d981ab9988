//! Real archives (`RIDGEWATCH_DATA`, by default `../shared/data`) through the whole loop, or to the right error, and against an integration
//! by other tools: `make test-data`.

use crate::integrated::{Compared, Pairs};
use crate::kit::flow::{quasi_random, trace, window};
use crate::kit::program::{self, project, records, set, text};
use crate::{inspected, open, refused};
use ridgewatch::field::{DomainPoint, Geometry, UnitPoint};
use ridgewatch::flow::{Boundary, Direction, Extras, FlowMap, Precision, Steps, VelocitySource, cpu_tracer};
use ridgewatch::publish::read_exr;
use ridgewatch::render::Film;
use ridgewatch::source::{Metric, SnapshotSource};
use std::path::{Path, PathBuf};

/// A file of the collection, which must exist: without it, `make test` leaves these tests out and says so.
fn data(name: &str) -> PathBuf {
    let root = std::env::var_os("RIDGEWATCH_DATA").map_or_else(|| project("../shared/data"), PathBuf::from);
    let path = root.join(name);
    assert!(path.exists(), "{} is not there; set RIDGEWATCH_DATA to the folder of the collection", path.display());
    path
}

/// The last of eight frames of a replay by the program. The first ones exceed the tolerance, and say so: trust begins with few points.
fn replay(files: &Path, tau: f64) -> Film {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("run");
    let tau = format!("time.tau={tau:?}");
    let picture = set(&["render.width=128", "render.height=64", "render.samples=4"]);
    let length = set(&[
        "render.method=gated",
        "surrogate.kind=residual",
        "training.steps_per_frame=100",
        "time.slides=1",
        "time.frames_per_slide=8",
        &tau,
    ]);
    let mut command = program::ridgewatch(["replay", "--json", "--out", text(&out), text(files)]);
    program::run(command.args(picture).args(length)).success();
    let records = records(&out);
    let last = &records[7];
    assert!(last.tolerance_excess.is_none() && last.traced_share < 1.0 && last.trusted_error.is_some(), "{last:?}");
    let frame = out.join("frames/frame_000007");
    assert_eq!(image::image_dimensions(frame.with_extension("png")).unwrap(), (128, 64));
    read_exr(&frame.with_extension("exr")).unwrap()
}

/// Compares a picture with the FTLE (1/s) of another integration: visible values vary, and lie above the low end of the transfer function,
/// the median. `land` is the accepted range of its share of pixels.
fn looks_right(name: &str, film: &Film, ftle: &[f64], land: std::ops::RangeInclusive<f64>) {
    assert!(film.rgba.iter().flatten().all(|c| c.is_finite()), "{name}: every pixel has a colour");
    let seen: Vec<f64> = film.ftle_mean.iter().filter(|f| f.is_finite()).map(|&f| f64::from(f)).collect();
    let mean = seen.iter().sum::<f64>() / seen.len() as f64;
    let spread = (seen.iter().map(|f| (f - mean).powi(2)).sum::<f64>() / seen.len() as f64).sqrt();
    let share = film.missing.iter().map(|&m| f64::from(m)).sum::<f64>() / film.missing.len() as f64;
    let mut ftle = ftle.to_vec();
    ftle.sort_by(f64::total_cmp);
    let (median, largest) = (ftle[ftle.len() / 2], ftle[ftle.len() - 1]);
    println!(
        "{name}: {} of {} pixels show FTLE {mean:.2e} +- {spread:.1e} (independent median {median:.2e}, largest {largest:.2e}); land {share:.3}",
        seen.len(),
        film.ftle_mean.len()
    );
    assert!(seen.len() * 20 > film.ftle_mean.len(), "{name}: something is seen");
    assert!(mean > median && mean < largest, "{name}: {mean:e}");
    assert!(spread > 0.1 * (largest - median) && spread < largest - median, "{name}: {spread:e}");
    assert!(land.contains(&share), "{name}: {share}");
}

#[test]
#[ignore = "needs real archives: make test-data"]
fn globcurrent() {
    let folder = data("globcurrent");
    let mut archive = open(&[folder.join("*.nc")]);
    let grid = archive.grid().clone();
    assert_eq!((grid.shape(), archive.times().len()), ([81, 41, 1], 60));
    assert!(matches!(grid.geometry, Geometry::Sphere { .. }));
    assert_eq!((grid.axes[0].first(), grid.axes[1].first(), grid.axes[0].period()), (14.875, -40.125, None));
    assert_eq!(archive.date(archive.times()[0]).as_deref(), Some("2002-01-01T00:00:00Z"));
    assert_eq!(archive.date(archive.times()[59]).as_deref(), Some("2002-03-01T00:00:00Z"));
    assert_eq!((archive.longest_default_tau().unwrap(), archive.gaps().len()), (29.5 * 86_400.0, 0));
    let snapshot = archive.read(0).unwrap();
    // Counted with another tool: 769 of 3321 values are NaN.
    assert_eq!(snapshot.missing_nodes(), 769);
    let fastest = snapshot.nodes.iter().map(|n| n[..3].iter().map(|v| v * v).sum::<f32>().sqrt()).fold(0.0, f32::max);
    assert!(fastest > 1.0 && fastest < 3.0, "the Agulhas current runs at {fastest} m/s");
}

#[test]
#[ignore = "needs real archives: make test-data"]
fn era5_on_a_projected_grid() {
    let first = data("era5_utm32_2025_05_01_00.nc");
    let pattern = first.with_file_name("era5_utm32_*.nc");
    let mut archive = open(&[&pattern]);
    assert_eq!((archive.grid().shape(), archive.times().len()), ([17, 30, 37], 3));
    // Pressures of 1000 to 1 hPa become heights.
    assert_eq!((archive.metric(), archive.grid().axes[2].first()), (Metric::Cartesian, 0.0));
    assert!((archive.grid().axes[2].last() - 7000.0 * 1000f64.ln()).abs() < 1e-6);
    let share = archive.read(1).unwrap().missing_nodes() as f64 / archive.grid().nodes() as f64;
    // Counted with another tool: 14.1 %.
    assert!((share - 0.141).abs() < 1e-3, "{share}");
}

#[test]
#[ignore = "needs real archives: make test-data"]
fn wrf_hurricane() {
    let file = data("wrf_katrina_uvw_4t.nc");
    let mut archive = open(&[&file]);
    assert_eq!((archive.grid().shape(), archive.times().len()), ([125, 119, 28], 4));
    // 48 x 48 cells that follow the storm by 15 cells west and 12 north in nine hours.
    assert_eq!(archive.date(archive.times()[3]).as_deref(), Some("2005-08-28T21:00:00Z"));
    let snapshot = archive.read(0).unwrap();
    let known = snapshot.nodes.len() - snapshot.missing_nodes();
    // Some nodes at the ground are missing.
    assert!((0.99..=1.0).contains(&(known as f64 / (95.0 * 95.0 * 28.0))), "{known}");
    let inspection = inspected(&[&file]);
    let resampling = inspection.resampling.unwrap();
    println!("WRF resampling: {resampling:?}");
    assert!(resampling.error < 0.003 * resampling.velocity, "{resampling:?}");
}

#[test]
#[ignore = "needs real archives: make test-data"]
fn what_cannot_be_traced_says_why() {
    for (name, pieces) in [
        ("jhtdb_iso1024coarse_pressure_64.h5", &["Pressure_0001", "one component per point: it is a scalar"][..]),
        ("jhtdb_legacy_cutout_10x10.h5", &["`u01000`", "1 node(s) thick along z", "2 nodes or more"]),
    ] {
        refused(&[data(name)], "", &[pieces, &[name]].concat());
    }
}

#[test]
#[ignore = "needs real archives: make test-data"]
fn automatic_steps_see_the_kinks_of_linear_interpolation() {
    let mut archive = open(&[data("globcurrent").join("*.nc")]);
    let (begin, source) = (archive.times()[59], VelocitySource::Window(window(&mut archive)));
    for (days, limit) in [(5.0, 0.03), (10.0, 0.04)] {
        let with = |steps| FlowMap {
            direction: Direction::Backward,
            precision: Precision::F64,
            boundary: Boundary::Stop,
            steps,
            ..FlowMap::tangent(days * 86_400.0, 1)
        };
        // As scenes of archives with linear interpolation have it.
        let automatic = with(Steps::AutoByShare { tolerance: 0.1, share: 0.015 });
        let tracer = cpu_tracer(source.clone(), &automatic, begin).unwrap();
        let seeds: Vec<DomainPoint> = (0..8000).map(|i| tracer.domain().from_unit(UnitPoint(quasi_random(i).map(|c| c as f32)))).collect();
        let of = |steps| trace(&source, &with(Steps::Fixed(steps)), begin, &seeds, Extras::default());
        let (coarse, fine) = (of(tracer.steps()), of(16 * tracer.steps()));
        let whole = |i: &usize| coarse.lifetime_share[*i] == 1.0 && fine.lifetime_share[*i] == 1.0 && !tracer.is_missing(seeds[*i]);
        let chosen: Vec<usize> = (0..seeds.len()).filter(whole).collect();
        let sum = |f: &dyn Fn(usize) -> f64| chosen.iter().map(|&i| f(i).powi(2)).sum::<f64>();
        let error = (sum(&|i| coarse.log_stretch_f64[i] - fine.log_stretch_f64[i]) / sum(&|i| fine.log_stretch_f64[i])).sqrt();
        println!(
            "GlobCurrent, linear, {days} days: {} steps, {:.2} % of the FTLE at {} seeds",
            tracer.steps(),
            100.0 * error,
            chosen.len()
        );
        assert!(error < limit, "{error}");
    }
}

/// Compares the FTLE with ftle.py: it differs by a share of `most` and correlates by `least`, and differs by 3 % with the defaults of a scene. Returns the
/// former pairs.
fn agreeing(kind: &str, files: &Path, tau: f64, [most, least]: [f64; 2]) -> Pairs {
    let files = [files.to_owned()];
    let compared = Compared::new(kind, &files, "", tau);
    let pairs = compared.exactly();
    let (relative, correlation) = pairs.report(kind);
    assert!(relative < most && correlation > least, "{kind}: {relative} {correlation}");
    let (relative, correlation) = compared.by_default().report(&format!("{kind}, by default"));
    assert!(relative < 0.03 && correlation > 0.99, "{kind}: {relative} {correlation}");
    pairs
}

/// FTLE, per second, of log-stretches.
fn per_second(log_stretch: &[f64], tau: f64) -> Vec<f64> {
    log_stretch.iter().map(|s| s / tau).collect()
}

#[test]
#[ignore = "needs real archives: make test-data"]
fn globcurrent_agrees_with_an_independent_integration() {
    let (files, tau) = (data("globcurrent").join("*.nc"), 5.0 * 86_400.0);
    let pairs = agreeing("globcurrent", &files, tau, [1e-3, 0.9999]);
    // A point is on land if one of the 4 x 4 nodes of cubic interpolation, the default in two dimensions, is missing.
    let mut archive = open(&[&files]);
    let snapshot = archive.read(59).unwrap();
    let [nx, ny, _] = snapshot.grid.shape();
    let read = |cell: usize, n: usize| cell.saturating_sub(1)..=(cell + 2).min(n - 1);
    let is_land = |i: usize, j: usize| read(j, ny).any(|y| read(i, nx).any(|x| snapshot.nodes[y * nx + x][3].is_nan()));
    let cells = ((nx - 1) * (ny - 1)) as f64;
    let land = (0..ny - 1).map(|j| (0..nx - 1).filter(|&i| is_land(i, j)).count()).sum::<usize>() as f64 / cells;
    looks_right("GlobCurrent", &replay(&files, tau), &per_second(&pairs.theirs, tau), land - 0.005..=land + 0.005);
}

#[test]
#[ignore = "needs real archives: make test-data"]
fn era5_agrees_with_an_independent_integration() {
    let (files, tau) = (data("era5_utm32_2025_05_01_00.nc").with_file_name("era5_utm32_*.nc"), 7200.0);
    let pairs = agreeing("era5", &files, tau, [1e-6, 0.999_999_9]);
    // The rim is visible behind transparent parts; 0.040 was measured.
    looks_right("ERA5", &replay(&files, tau), &per_second(&pairs.theirs, tau), 0.03..=0.05);
}

#[test]
#[ignore = "needs real archives: make test-data"]
fn wrf_agrees_with_an_independent_integration() {
    let (file, tau) = (data("wrf_katrina_uvw_4t.nc"), 3600.0);
    // Horizontally the same interpolant; vertically fixed heights here, the levels of each column there.
    let pairs = agreeing("wrf", &file, tau, [0.024, 0.9992]);
    // Outside of the nest; 0.128 was measured.
    looks_right("WRF", &replay(&file, tau), &per_second(&pairs.theirs, tau), 0.1..=0.16);
}
