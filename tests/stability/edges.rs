//! Edges of data: poles and the dateline, coasts, open boundaries.

use crate::kit::flow::{DAY, EVERYTHING, quasi_random, rotation, trace};
use crate::kit::scene;
use crate::sweep::{TOLERANCE, bisect, grid, in_square, lattice, map, rms, row, traced};
use ridgewatch::field::{Axis, Domain, EARTH_RADIUS, Geometry, Grid, Snapshot};
use ridgewatch::field::{DomainPoint, analytic::Analytic};
use ridgewatch::flow::{Boundary, Extras, FlowMap, Interpolation, Normalisation, Precision, VelocitySource};
use ridgewatch::run::RunOptions;
use std::sync::Arc;

/// Solid rotation by a quarter of a turn in ten days about an axis `tilt` degrees from that of the Earth: at 90 degrees paths cross the poles.
/// `sphere`: as vectors on the sphere; otherwise as degrees of longitude and latitude a second on a plane.
fn turned(tilt: f64, sphere: bool, periodic: bool) -> VelocitySource {
    let (nx, ny) = (360, 181);
    let longitude = Axis::uniform("lon", "degrees_east", 0.0, 359.0, nx).unwrap();
    let longitude = if periodic { longitude.with_period(360.0) } else { longitude };
    let latitude = Axis::uniform("lat", "degrees_north", -90.0, 90.0, ny).unwrap();
    let geometry = if sphere { Geometry::Sphere { radius: EARTH_RADIUS } } else { Geometry::Cartesian };
    let grid = Arc::new(Grid { axes: vec![longitude, latitude], geometry, slab: (0.0, 1.0) });
    let tau = 10.0 * DAY;
    let velocity = |i: usize| {
        let [lon, lat] = [i % nx, i / nx].map(|n| n as f64);
        let lat = (lat - 90.0).to_radians();
        let [u, v] = rotation(0.25 * std::f64::consts::TAU / tau, tilt.to_radians(), lon.to_radians(), lat);
        let degrees = if sphere { 1.0 } else { 1.0f64.to_degrees() / EARTH_RADIUS };
        // At the pole itself longitude has no length; half a cell beside it stands for it.
        let circle = if sphere { 1.0 } else { lat.cos().max(0.5f64.to_radians().sin()) };
        [u * degrees / circle, v * degrees]
    };
    let components = [0, 1].map(|c| (0..nx * ny).map(|i| velocity(i)[c] as f32).collect::<Vec<f32>>());
    let snapshot = |time: f64| Snapshot::from_components(time, grid.clone(), &components[0], &components[1], &[]);
    VelocitySource::Window(crate::sweep::window(tau, tau, snapshot))
}

#[test]
fn poles_and_dateline() {
    let tau = 10.0 * DAY;
    let flow = |precision| FlowMap { boundary: Boundary::Stop, interpolation: Interpolation::Cubic, ..map(tau, 100, precision) };
    // A solid rotation stretches nothing. Seeds on a circle of latitude; the path of some passes a pole.
    let circle = |latitude: f64| (0..72).map(|i| DomainPoint([5.0 * i as f32 + 0.3, latitude as f32, 0.5])).collect::<Vec<_>>();
    let worst = |source: &VelocitySource, latitude: f64, precision| {
        traced(source, &flow(precision), 0.0, &circle(latitude)).into_iter().map(f64::abs).fold(0.0, f64::max)
    };
    // Seeds on the equator come as far from it as the axis is tilted.
    let plane = |tilt: f64| worst(&turned(tilt, false, true), 0.0, Precision::F64);
    let fails = bisect(1.0, 80.0, |tilt| plane(tilt) > 0.1);
    let sphere = turned(90.0, true, true);
    let mut most: f64 = 0.0;
    for latitude in [0.0, 30.0, 60.0, 80.0, 89.0, 89.9, 89.999, 90.0] {
        for precision in [Precision::F32, Precision::F64] {
            most = most.max(worst(&sphere, latitude, precision));
        }
    }
    assert!(most < TOLERANCE, "the sphere has no pole: {most:e}");
    let at_60 = plane(60.0);
    println!("plane of degrees: fails from {fails:.1} degrees on, {at_60:.2} at 60; sphere {most:.1e}");
    assert!(at_60 > 100.0 * most);
    row([
        "poles, degrees taken as lengths",
        &format!("paths that come {fails:.0} degrees from the equator (log-stretch 0.1 of a solid rotation)"),
        "the metric, in the log and in `inspect`",
        "sphere metric by default on longitudes and latitudes: paths are vectors, a pole is a point like others",
        &format!("sphere {most:.0e} at all latitudes and the poles (1 degree, cubic); plane {at_60:.1} at 60 degrees"),
        "poles_and_dateline",
    ]);
    // The cell between the last longitude and the first.
    let lived = |periodic: bool| {
        let seeds: Vec<DomainPoint> =
            (0..2000).map(quasi_random).map(|p| DomainPoint([(359.0 * p[0]) as f32, (60.0 * p[1] - 30.0) as f32, 0.5])).collect();
        let out = trace(&turned(90.0, true, periodic), &flow(Precision::F32), 0.0, &seeds, Extras::default());
        out.lifetime_share.iter().filter(|&&share| share < 1.0).count() as f64 / seeds.len() as f64
    };
    let (open, closed) = (lived(false), lived(true));
    assert!(open > 0.01 && closed == 0.0, "{open} {closed}");
    row([
        "dateline, longitudes that do not close",
        &format!("{:.0} % of the paths stop there in ten days", 100.0 * open),
        "`mean_lifetime_share`",
        "an axis of longitudes that spans 360 degrees with its last cell is periodic",
        "no path stops",
        "poles_and_dateline",
    ]);
}

#[test]
fn coasts() {
    const RATE: f64 = 1.0;
    const TIME: f64 = 8.0;
    // A wind of one cell a unit of time towards the coast at x = 30, faster to the north: a uniform shear.
    let grid = grid([40.0, 4.0], [41, 41]);
    let at = |i: usize| [grid.axes[0].coordinates()[i % 41], grid.axes[1].coordinates()[i / 41]];
    let u: Vec<f32> = (0..grid.nodes()).map(|i| if at(i)[0] > 30.5 { f32::NAN } else { (1.0 + RATE * (at(i)[1] - 2.0)) as f32 }).collect();
    let source = VelocitySource::Window(crate::sweep::window(TIME, TIME, |time| {
        Snapshot::from_components(time, grid.clone(), &u, &vec![0.0; grid.nodes()], &[])
    }));
    let inland = {
        let g = RATE * TIME;
        0.5 * (1.0 + g * g / 2.0 + g * (1.0 + g * g / 4.0).sqrt()).ln() / TIME
    };
    let ftle = |normalisation, distance: f64| {
        let map = FlowMap { boundary: Boundary::Stop, normalisation, ..map(TIME, 800, Precision::F64) };
        let out = trace(&source, &map, 0.0, &[DomainPoint([(30.0 - distance) as f32, 2.0, 0.5])], EVERYTHING);
        (out.unrounded()[0] / TIME, f64::from(out.lifetime_share[0]))
    };
    // From the open sea towards the coast: where the FTLE is off by a tenth.
    let off = |normalisation| 20.0 / bisect(1.0, 200.0, |nearer| (ftle(normalisation, 20.0 / nearer).0 / inland - 1.0).abs() > 0.1);
    let [by_life, by_tau] = [off(Normalisation::Lifetime), off(Normalisation::Tau)];
    let ridge = ftle(Normalisation::Lifetime, 0.1).0 / inland;
    let quiet = ftle(Normalisation::Tau, 0.1).0 / inland;
    println!(
        "coast: off by a tenth within {by_life:.1} (lifetime) and {by_tau:.1} (tau); at the coast {ridge:.2} and {quiet:.3} of the inland value"
    );
    // Particles reach the coast within tau from 8 cells on; the quotient of a short life is the strain rate, here half the shear.
    assert!((0.5..=8.0).contains(&by_life) && (0.5..=8.0).contains(&by_tau), "{by_life} {by_tau}");
    assert!((ridge * inland / (0.5 * RATE) - 1.0).abs() < 0.1, "the strain rate: {ridge}");
    assert!(quiet < 0.1, "no ridge: {quiet}");
    let share = ftle(Normalisation::Tau, by_tau).1;
    // Over the cells from which particles reach the coast.
    let band = rms((0..64).map(|i| ftle(Normalisation::Tau, TIME * (f64::from(i) + 0.5) / 64.0).0 / inland - 1.0));
    assert!(band > 0.1, "{band}");
    row([
        "coasts (missing cells)",
        &format!("within {by_tau:.1} cells of a coast, towards which particles move {TIME:.0} cells in tau (off by 10 %)"),
        &format!("`mean_lifetime_share` ({share:.2} there), `missing`"),
        "the particle stops; its stretch is divided by all of tau, so a coast shows no ridge; warns below a mean of 0.75",
        &format!(
            "FTLE at the coast {quiet:.2} of that at sea, over the {TIME:.0} cells before it off by {:.0} % rms; divided by the lifetime it would be \
             {ridge:.1}, a false ridge",
            100.0 * band
        ),
        "coasts",
    ]);
}

#[test]
fn open_boundaries() {
    let source = in_square(Analytic::Saddle { rate: 1.0 });
    // Particles at x leave the box at ln(1 / x): the share e^-tau stays, and the mean FTLE and the mean lifetime are (1 - e^-tau) / tau.
    let seeds = lattice(&Domain::slab([-1.0, -1.0], [1.0, 1.0], (0.0, 1.0)), [4000, 1]);
    let out = |tau: f64| {
        let map = FlowMap { boundary: Boundary::Stop, ..map(tau, 400, Precision::F64) };
        let out = trace(&source, &map, 0.0, &seeds, Extras::default());
        let mean = |values: &mut dyn Iterator<Item = f64>| values.sum::<f64>() / seeds.len() as f64;
        let lived = mean(&mut out.lifetime_share.iter().map(|&s| f64::from(s)));
        let left = mean(&mut out.lifetime_share.iter().map(|&s| f64::from(u8::from(s < 1.0))));
        // The FTLE is 1 where particles stay.
        let off = rms(out.unrounded().into_iter().map(|stretch| stretch / tau - 1.0));
        (mean(&mut out.unrounded().into_iter()) / tau, lived, left, off)
    };
    let biased = bisect(0.01, 10.0, |tau| out(tau).0 < 0.9);
    let warned = bisect(0.01, 10.0, |tau| out(tau).1 < 0.75);
    let (_, lived, left, off) = out(biased);
    let (ftle, lived_at_warning, left_at_warning, off_at_warning) = out(warned);
    assert!(off_at_warning > off, "{off} {off_at_warning}");
    // A path stops within a step of tau / 400.
    assert!((biased - 0.2148).abs() < 5e-3 && (left - (1.0 - (-biased).exp())).abs() < 5e-3, "{biased} {left}");
    for tau in [0.1, 0.5, 2.0, 5.0] {
        let (ftle, lived, ..) = out(tau);
        assert!((ftle - lived).abs() < 5e-3, "the record's lifetime is the share of the FTLE that is left: {ftle} {lived}");
    }
    // The warning itself, of a run just before and just after.
    let says = |tau: f64| {
        let keys = format!(
            "domain.min = [-1, -1, 0]\ndomain.max = [1, 1, 0.2]\nrender.method = \"reference\"\nflow.boundary = \"stop\"\nflow.steps = 200\ntime.tau = {tau}"
        );
        let mut said = false;
        scene::run_frames(scene::setup(&scene::scene("saddle", [8, 8, 1], &keys), &[]), &RunOptions::default(), |frame| {
            said |= frame.record.warnings.iter().any(|w| w.starts_with("particles live"));
        });
        said
    };
    assert!(!says(0.9 * warned) && says(1.1 * warned), "warned from a mean lifetime of 0.75 on");
    row([
        "open boundaries",
        &format!("{:.0} % of the paths leave (mean FTLE 10 % too small)", 100.0 * left),
        &format!("`mean_lifetime_share`: {lived:.2}, the share of the FTLE that is left"),
        &format!("stops the particle, keeps its stretch; warns below {lived_at_warning:.2}, when {:.0} % leave", 100.0 * left_at_warning),
        &format!(
            "mean FTLE {:.0} % too small at the warning; over the picture off by {:.0} % rms, {:.0} % at the warning",
            100.0 * (1.0 - ftle),
            100.0 * off,
            100.0 * off_at_warning
        ),
        "open_boundaries",
    ]);
}
