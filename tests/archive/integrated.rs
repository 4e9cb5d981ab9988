//! The FTLE of archives beside an integration by other tools, tests/independent/ftle.py: with the same interpolant, and as a scene has it by default.

use crate::kit::flow::{quasi_random, trace, window};
use crate::kit::netcdf::*;
use crate::kit::program::{self, project};
use crate::kit::scene;
use crate::{HOURS, open_with};
use ridgewatch::field::{DomainPoint, UnitPoint};
use ridgewatch::flow::{Boundary, Direction, Extras, FlowMap, Integrator, Interpolation, Precision, VelocitySource, cpu_tracer};
use ridgewatch::run::Setup;
use ridgewatch::source::SnapshotSource;
use std::cell::RefCell;
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::process::Command;
use tempfile::tempdir;

/// Pairs of log-stretches that are compared.
const PAIRS: usize = 50;

/// An archive that ftle.py reads too.
pub struct Compared<'a> {
    kind: &'a str,
    files: &'a [PathBuf],
    keys: &'a str,
    tau: f64,
    /// Tasks of ftle.py and its answers.
    asked: RefCell<BTreeMap<String, Vec<serde_json::Value>>>,
}

/// Log-stretches of this program and of ftle.py.
pub struct Pairs {
    ours: Vec<f64>,
    pub theirs: Vec<f64>,
    tau: f64,
}

impl<'a> Compared<'a> {
    /// An archive that ftle.py calls `kind`, with `keys` as its settings, over `tau` seconds backward from its last time.
    pub fn new(kind: &'a str, files: &'a [PathBuf], keys: &'a str, tau: f64) -> Self {
        Self { kind, files, keys, tau, asked: RefCell::default() }
    }

    /// Linear interpolation and steps that err by nothing that counts.
    pub fn exactly(&self) -> Pairs {
        self.with(&FlowMap {
            direction: Direction::Backward,
            integrator: Integrator::DormandPrince,
            precision: Precision::F64,
            boundary: Boundary::Stop,
            ..FlowMap::tangent(self.tau, 1)
        })
    }

    /// As a scene has it that names only the files and tau. The interpolation of ftle.py is of the same order.
    pub fn by_default(&self) -> Pairs {
        self.with(&default_map(self.files, self.keys, self.tau))
    }

    /// At 50 seeds that live the whole tau, neighbours included.
    fn with(&self, map: &FlowMap) -> Pairs {
        let mut archive = open_with(self.files, self.keys);
        let begin = archive.times()[archive.times().len() - 1];
        let source = VelocitySource::Window(window(&mut archive));
        let tracer = cpu_tracer(source.clone(), map, begin).unwrap();
        // Seeds that stop are left out. More remain than are needed, since a neighbour of some stops.
        let seeds: Vec<DomainPoint> = (0..2000).map(|i| tracer.domain().from_unit(UnitPoint(quasi_random(i).map(|c| c as f32)))).collect();
        let out = trace(&source, map, begin, &seeds, Extras::default());
        let chosen: Vec<usize> =
            (0..seeds.len()).filter(|&i| out.lifetime_share[i] == 1.0 && !tracer.is_missing(seeds[i])).take(2 * PAIRS).collect();
        assert_eq!(chosen.len(), 2 * PAIRS);
        let grid = archive.grid();
        let task = serde_json::json!({
            "kind": self.kind,
            "files": archive.files().map(|f| f.display().to_string()).collect::<Vec<_>>(),
            "count": PAIRS,
            "points": chosen.iter().map(|&i| seeds[i].0.map(f64::from)).collect::<Vec<_>>(),
            "from": begin,
            "tau": -self.tau,
            "interpolation": if map.interpolation == Interpolation::Cubic { "cubic" } else { "linear" },
            "heights": grid.axes.get(2).map_or(&[][..], |axis| axis.coordinates()),
        });
        let theirs = self.ask(task.to_string());
        let all = out.unrounded();
        let (ours, numbers): (Vec<f64>, Vec<f64>) =
            chosen.iter().zip(&theirs).filter_map(|(&i, theirs)| theirs.as_f64().map(|t| (all[i], t))).unzip();
        println!("{}: {} of {} points are left out, since a neighbour stops", self.kind, theirs.len() - PAIRS, theirs.len());
        for (&i, theirs) in chosen.iter().zip(&theirs) {
            assert_ne!(theirs, "seed", "{}: {:?} lives here and not there", self.kind, seeds[i]);
        }
        assert_eq!(ours.len(), PAIRS);
        Pairs { ours, theirs: numbers, tau: self.tau }
    }

    /// What ftle.py answers. With its defaults many an archive has the interpolation of the exact map, so that the same would be asked twice.
    fn ask(&self, task: String) -> Vec<serde_json::Value> {
        let mut asked = self.asked.borrow_mut();
        let answer = asked.entry(task).or_insert_with_key(|task| {
            let python = std::env::var_os("RIDGEWATCH_PYTHON").map_or_else(|| project(".venv/bin/python"), PathBuf::from);
            assert!(python.exists(), "{} is not there: make test-data installs it", python.display());
            let output = program::run_with_input(Command::new(python).arg(project("tests/independent/ftle.py")), task).success();
            serde_json::from_str(&output.stdout).unwrap()
        });
        answer.clone()
    }
}

/// The flow map of a scene that names only files, settings of the archive and tau.
pub fn default_map(files: &[PathBuf], keys: &str, tau: f64) -> FlowMap {
    let names = files.iter().map(|file| file.display().to_string()).collect::<Vec<_>>();
    let text = format!("source.kind = \"archive\"\ntime.tau = {tau:?}\narchive.files = {names:?}\n");
    let settings = scene::parse(&text, &[]).unwrap().settings();
    let map = Setup::over(settings, Some(Box::new(open_with(files, keys)))).unwrap().plan.map;
    assert_eq!((map.direction, map.boundary, map.precision), (Direction::Backward, Boundary::Stop, Precision::F32));
    println!("by default: {:?}, {:?}", map.interpolation, map.steps);
    map
}

impl Pairs {
    /// Root mean square difference as a share of the root mean square FTLE, and correlation.
    pub fn report(&self, name: &str) -> (f64, f64) {
        let Self { ours, theirs, tau } = self;
        let n = ours.len() as f64;
        let mean = |f: &dyn Fn(usize) -> f64| (0..ours.len()).map(f).sum::<f64>() / n;
        let rms = mean(&|i| (ours[i] - theirs[i]).powi(2)).sqrt();
        let size = mean(&|i| theirs[i].powi(2)).sqrt();
        let mut apart: Vec<f64> = ours.iter().zip(theirs).map(|(a, b)| (a - b).abs()).collect();
        apart.sort_by(f64::total_cmp);
        let (a, b) = (mean(&|i| ours[i]), mean(&|i| theirs[i]));
        let correlation =
            mean(&|i| (ours[i] - a) * (theirs[i] - b)) / (mean(&|i| (ours[i] - a).powi(2)) * mean(&|i| (theirs[i] - b).powi(2))).sqrt();
        println!(
            "{name}: {n} points, tau {tau} s: FTLE differs by {:.2e} 1/s root mean square, {:.2e} median, {:.2e} at most, of {:.2e}: {:.2e}; correlation \
             {correlation:.6}",
            rms / tau,
            apart[apart.len() / 2] / tau,
            apart[apart.len() - 1] / tau,
            size / tau,
            rms / size
        );
        (rms / size, correlation)
    }
}

/// A flow without symmetry, between -1 and 1, at a place in periods and at a time.
fn waves(which: usize, [x, y, z]: [f64; 3], time: f64) -> f64 {
    let (a, b, c) = (x + 0.4 * time, y - 0.3 * time, z);
    [a.sin() * b.cos() + 0.4 * c.sin(), 0.7 * (a.cos() - b).sin() + 0.2 * c.cos(), (a + b).sin() * c.cos()][which] / 1.4
}

/// As ROMS writes it: faces in a plane, 100 m apart, between centres over a bottom of 60 to 95 m, and a surface that moves.
fn roms() -> Fixture {
    let (nx, ny, nz) = (8usize, 7usize, 20usize);
    let mut fixture =
        Fixture::new(NETCDF4, &[("ocean_time", 2), ("s_rho", nz), ("eta_rho", ny), ("eta_v", ny - 1), ("xi_rho", nx), ("xi_u", nx - 1)]);
    fixture = fixture.axis("ocean_time", HOURS, &[0.0, 1.0]);
    let s: Vec<f64> = (0..nz).map(|k| (k as f64 + 0.5) / nz as f64 - 1.0).collect();
    let c: Vec<f64> = s.iter().map(|s| (1.0 - (3.0 * s).cosh()) / (3f64.cosh() - 1.0)).collect();
    let hc = 20.0;
    for (name, value) in [("Vtransform", 2.0), ("hc", hc)] {
        fixture = fixture.variable(name, &[], Data::F64(vec![value]));
    }
    fixture = fixture.variable("s_rho", &["s_rho"], Data::F64(s.clone())).variable("Cs_r", &["s_rho"], Data::F64(c.clone()));
    let depth = |x: f64, y: f64| 60.0 + 0.04 * x + 10.0 * (y / 300.0).sin();
    let surface = |x: f64, time: usize| 0.4 * (x / 400.0).cos() + 0.3 * time as f64;
    let plane = |f: &dyn Fn(f64, f64) -> f64| Data::F64(fill(1, ny, nx, |_, j, i| f(100.0 * i as f64, 100.0 * j as f64)));
    for (name, of) in [("x_rho", plane(&|x, _| x)), ("y_rho", plane(&|_, y| y)), ("h", plane(&depth))] {
        fixture = fixture.variable(name, &["eta_rho", "xi_rho"], of).with("units", "meter");
    }
    let zeta = fill(2, ny, nx, |n, _, i| surface(100.0 * i as f64, n));
    fixture = fixture.variable("zeta", &["ocean_time", "eta_rho", "xi_rho"], Data::F64(zeta)).with("units", "meter");
    let components =
        [("u", ["eta_rho", "xi_u"], [50.0, 0.0]), ("v", ["eta_v", "xi_rho"], [0.0, 50.0]), ("w", ["eta_rho", "xi_rho"], [0.0; 2])];
    for (which, (name, [eta, xi], shift)) in components.into_iter().enumerate() {
        let [nx, ny] = [if shift[0] > 0.0 { nx - 1 } else { nx }, if shift[1] > 0.0 { ny - 1 } else { ny }];
        let values = fill(2 * nz, ny, nx, |n, j, i| {
            let (time, k) = (n / nz, n % nz);
            let [x, y] = [100.0 * i as f64 + shift[0], 100.0 * j as f64 + shift[1]];
            let (h, eta) = (depth(x, y), surface(x, time));
            let z = eta + (eta + h) * (hc * s[k] + h * c[k]) / (hc + h);
            [0.02, 0.02, 1e-3][which] * waves(which, [x / 110.0, y / 130.0, z / 25.0], time as f64)
        });
        fixture = fixture.variable(name, &["ocean_time", "s_rho", eta, xi], f32s(values)).with("units", "meter second-1");
    }
    fixture
}

const LON: [f64; 9] = [10.0, 10.5, 11.0, 11.5, 12.0, 12.5, 13.0, 13.5, 14.0];
const LAT: [f64; 8] = [53.5, 53.0, 52.5, 52.0, 51.5, 51.0, 50.5, 50.0];

/// A flow at a longitude, latitude and height, m/s.
fn carries(which: usize, [lon, lat, z]: [f64; 3], time: f64, [speed, rise, scale]: [f64; 3]) -> f64 {
    [speed, speed, rise][which] * waves(which, [1.7 * lon, 2.1 * lat, z / scale], time)
}

/// Layers that follow the density, by a field of depths that changes.
fn layers() -> Fixture {
    let lat: Vec<f64> = LAT.iter().rev().copied().collect();
    let mut fixture = Fixture::on(NETCDF4, &[("time", HOURS, &[0.0, 24.0]), ("lat", "degrees_north", &lat), ("lon", "degrees_east", &LON)]);
    let count = 7;
    let z = |n: usize, j: usize, i: usize| {
        let bent = 1.0 + 0.25 * (1.3 * LON[i] + 0.9 * lat[j] + 0.5 * (n / count) as f64).sin();
        -(20.0 + 250.0 * (n % count) as f64 * bent)
    };
    fixture = fixture.dimension("layer", count);
    let dimensions = ["time", "layer", "lat", "lon"];
    fixture = fixture.variable("depth", &dimensions, Data::F64(fill(2 * count, lat.len(), LON.len(), |n, j, i| -z(n, j, i))));
    fixture = fixture.with("units", "m").with("positive", "down");
    for (which, (name, to)) in [("uo", "eastward"), ("vo", "northward"), ("wo", "upward")].into_iter().enumerate() {
        let values = fill(2 * count, lat.len(), LON.len(), |n, j, i| {
            carries(which, [LON[i], lat[j], z(n, j, i)], (n / count) as f64, [0.4, 1e-3, 700.0])
        });
        fixture = fixture.variable(name, &dimensions, f32s(values)).with("units", "m s-1");
        fixture = fixture.with("standard_name", format!("{to}_sea_water_velocity").as_str()).with("coordinates", "depth lat lon");
    }
    fixture
}

/// Hybrid levels of the atmosphere above a mountain, and omega.
fn hybrid() -> Fixture {
    let a = [0.05, 0.2, 0.18, 0.12, 0.05, 0.0];
    let b = [0.0, 0.1, 0.3, 0.5, 0.85, 0.99];
    let mut fixture = Fixture::on(NETCDF4, &[("time", HOURS, &[0.0, 6.0]), ("lat", "degrees_north", &LAT), ("lon", "degrees_east", &LON)])
        .dimension("lev", a.len())
        .axis("lev", "1", &b)
        .with("standard_name", "atmosphere_hybrid_sigma_pressure_coordinate")
        .with("positive", "down")
        .with("formula_terms", "p0: p0 a: a b: b ps: PS")
        .variable("a", &["lev"], Data::F64(a.to_vec()))
        .variable("b", &["lev"], Data::F64(b.to_vec()))
        .variable("p0", &[], Data::F64(vec![1000.0]))
        .with("units", "hPa");
    let ground = |time: usize, j: usize, i: usize| 97_000.0 - 2500.0 * (LON[i] + 0.6 * LAT[j]).sin() - 150.0 * time as f64;
    let pressures = Data::F64(fill(2, LAT.len(), LON.len(), ground));
    fixture = fixture.variable("PS", &["time", "lat", "lon"], pressures).with("units", "Pa");
    let pressure = |n: usize, j: usize, i: usize| a[n % a.len()] * 1e5 + b[n % a.len()] * ground(n / a.len(), j, i);
    for (which, (name, unit)) in [("U", "m/s"), ("V", "m/s"), ("OMEGA", "Pa/s")].into_iter().enumerate() {
        let values = fill(2 * a.len(), LAT.len(), LON.len(), |n, j, i| {
            let p = pressure(n, j, i);
            let z = -7000.0 * (p / 1e5).ln();
            let value = carries(which, [LON[i], LAT[j], z], (n / a.len()) as f64, [4.0, 0.02, 4000.0]);
            if name == "OMEGA" { -value * p / 7000.0 } else { value }
        });
        fixture = fixture.variable(name, &["time", "lev", "lat", "lon"], f32s(values)).with("units", unit);
    }
    fixture
}

#[test]
#[ignore = "needs Python: make test-data"]
fn columns_agree_with_an_independent_integration() {
    let dir = tempdir().unwrap();
    for (kind, fixture, keys, tau) in
        [("roms", roms(), "", 3600.0), ("layers", layers(), "", 86_400.0), ("hybrid", hybrid(), "", 6.0 * 3600.0)]
    {
        let files = [fixture.write(&dir.path().join(format!("{kind}.nc")))];
        let compared = Compared::new(kind, &files, keys, tau);
        // The same interpolant: columns at fixed heights, those between linear in all directions.
        let (relative, correlation) = compared.exactly().report(kind);
        assert!(relative < 1e-4 && correlation > 0.999_99, "{kind}: {relative} {correlation}");
        let (relative, correlation) = compared.by_default().report(&format!("{kind}, by default"));
        assert!(relative < 0.03 && correlation > 0.99, "{kind}: {relative} {correlation}");
    }
    // The columns of the model at every place: the error of fixed heights, and with as many between them.
    let files = [dir.path().join("roms.nc")];
    let heights = open_with(&files, "").grid().axes[2].coordinates().to_vec();
    let mut errors = Vec::new();
    for times in [1, 2] {
        let finer: Vec<f64> = heights
            .windows(2)
            .flat_map(|pair| (0..times).map(move |k| pair[0] + (pair[1] - pair[0]) * f64::from(k) / f64::from(times)))
            .chain(heights.last().copied())
            .collect();
        let keys = format!("heights = {finer:?}");
        let compared = Compared::new("roms columns", &files, &keys, 3600.0);
        errors.push(compared.exactly().report(&format!("roms, {times} times as many heights as levels")).0);
    }
    assert!(errors[1] < errors[0], "{errors:?}");
}
