//! Levels that follow the bottom (ROMS, CROCO, sigma coordinates): velocities are proportional to the true height, so that a value tells the height from
//! which it was read.

use crate::kit::netcdf::*;
use crate::{HOURS, inspected, notes, open, open_with, refused};
use ridgewatch::field::Snapshot;
use ridgewatch::source::{Archive, SnapshotSource};
use std::path::Path;
use tempfile::tempdir;

const NX: usize = 14;
const NY: usize = 9;
/// Levels of u and v.
const LEVELS: usize = 12;
/// h_c, metres.
const CRITICAL: f64 = 12.0;
/// theta_s and theta_b.
const THETA: [f64; 2] = [3.0, 0.4];

/// How a file says where its levels lie.
#[derive(Clone, Copy, PartialEq, Debug)]
enum Says {
    /// `standard_name` and `formula_terms`.
    Terms(&'static str),
    /// Variables `Vtransform`, `hc`, `Cs_r`, `s_rho`, and those of w.
    Variables(f64),
    /// Attributes of the file, as CROCO.
    Attributes,
}

/// Depth at a longitude: a slope.
fn depth(lon: f64) -> f64 {
    30.0 + 40.0 * (lon - 10.0)
}

/// Height of the surface at a time, which slopes too.
fn surface(time: usize, lon: f64) -> f64 {
    0.8 * time as f64 - 0.2 + 0.3 * (lon - 10.0)
}

/// C(s) of the files, by Song & Haidvogel (1994) or another stretching.
fn stretch(says: Says, s: f64) -> f64 {
    match says {
        Says::Terms("ocean_s_coordinate") => {
            let [a, b] = THETA;
            (1.0 - b) * (a * s).sinh() / a.sinh() + b * ((a * (s + 0.5)).tanh() / (2.0 * (0.5 * a).tanh()) - 0.5)
        }
        Says::Terms("ocean_sigma_coordinate") => s,
        _ => (1.0 - (3.0 * s).cosh()) / (3f64.cosh() - 1.0),
    }
}

/// Height of a level, written from the conventions and not from the program.
fn height(says: Says, s: f64, h: f64, eta: f64) -> f64 {
    let c = stretch(says, s);
    match says {
        Says::Terms("ocean_sigma_coordinate") => eta + s * (h + eta),
        Says::Terms("ocean_s_coordinate") => eta * (1.0 + s) + CRITICAL * s + (h - CRITICAL) * c,
        Says::Terms("ocean_s_coordinate_g1") | Says::Variables(1.0) => {
            let z0 = CRITICAL * s + (h - CRITICAL) * c;
            z0 + eta * (1.0 + z0 / h)
        }
        _ => eta + (eta + h) * (CRITICAL * s + h * c) / (CRITICAL + h),
    }
}

/// s of level `k` of u and v, or of w.
fn s_of(k: usize, between: bool) -> f64 {
    (k as f64 + if between { 0.0 } else { 0.5 }) / LEVELS as f64 - 1.0
}

/// A C-grid of ROMS: u and v between tracer points, w between levels. `u = z / 100` eastward, `v = -u` northward, `w = z / 1000`.
struct Roms {
    says: Says,
    zeta: bool,
    w: bool,
    hour: f64,
}

impl Default for Roms {
    fn default() -> Self {
        Self { says: Says::Variables(2.0), zeta: true, w: true, hour: 0.0 }
    }
}

impl Roms {
    fn fixture(&self) -> Fixture {
        let &Self { says, zeta, w, hour } = self;
        let mut fixture = Fixture::new(NETCDF4, &[("ocean_time", 2), ("s_rho", LEVELS), ("s_w", LEVELS + 1)]);
        fixture = fixture.axis("ocean_time", HOURS, &[hour, hour + 1.0]);
        for (between, s, c, count) in [(false, "s_rho", "Cs_r", LEVELS), (true, "s_w", "Cs_w", LEVELS + 1)] {
            let levels: Vec<f64> = (0..count).map(|k| s_of(k, between)).collect();
            let stretching: Vec<f64> = levels.iter().map(|&s| stretch(says, s)).collect();
            if says == Says::Attributes {
                fixture = fixture.attribute(if between { "sc_w" } else { "sc_r" }, levels).attribute(c, stretching);
                continue;
            }
            fixture = fixture.variable(s, &[s], Data::F64(levels));
            if let Says::Terms(name) = says {
                let terms = match name {
                    "ocean_sigma_coordinate" => format!("sigma: {s} eta: zeta depth: h"),
                    "ocean_s_coordinate" => format!("s: {s} eta: zeta depth: h a: theta_s b: theta_b depth_c: hc"),
                    _ => format!("s: {s} C: {c} eta: zeta depth: h depth_c: hc"),
                };
                fixture = fixture.with("standard_name", name).with("positive", "up").with("formula_terms", terms.as_str());
            }
            fixture = fixture.variable(c, &[s], Data::F64(stretching));
        }
        for (name, value) in [("hc", CRITICAL), ("theta_s", THETA[0]), ("theta_b", THETA[1])] {
            fixture = match says {
                Says::Attributes => fixture.attribute(name, value),
                _ => fixture.variable(name, &[], Data::F64(vec![value])),
            };
        }
        fixture = match says {
            Says::Attributes => fixture.attribute("VertCoordType", "NEW"),
            Says::Variables(transform) => fixture.variable("Vtransform", &[], Data::F64(vec![transform])),
            Says::Terms(_) => fixture,
        };
        for (c, (name, ny, nx)) in [("rho", NY, NX), ("u", NY, NX - 1), ("v", NY - 1, NX)].into_iter().enumerate() {
            let shift = [f64::from(u8::from(nx < NX)) / 2.0, f64::from(u8::from(ny < NY)) / 2.0];
            let (eta, xi) = (format!("eta_{name}"), format!("xi_{name}"));
            fixture = fixture.dimension(&eta, ny).dimension(&xi, nx);
            // Bent, so that rows are no coordinates.
            let lon = |y: usize, x: usize| 10.0 + 0.1 * (x as f64 + shift[0]) + 0.02 * (y as f64 + shift[1]);
            let lat = |y: usize, x: usize| 40.0 + 0.1 * (y as f64 + shift[1]) - 0.01 * (x as f64 + shift[0]);
            let values = |f: &dyn Fn(usize, usize) -> f64| Data::F64(fill(1, ny, nx, |_, y, x| f(y, x)));
            fixture = fixture.variable(&format!("lon_{name}"), &[&eta, &xi], values(&lon)).with("units", "degrees_east");
            fixture = fixture.variable(&format!("lat_{name}"), &[&eta, &xi], values(&lat)).with("units", "degrees_north");
            let of = |levels: usize, factor: f64| {
                f32s(fill(2 * levels, ny, nx, |n, y, x| {
                    let lon = lon(y, x);
                    let eta = if zeta { surface(n / levels, lon) } else { 0.0 };
                    factor * height(says, s_of(n % levels, levels > LEVELS), depth(lon), eta)
                }))
            };
            let on = |fixture: Fixture, name: &str, level: &str, data: Data| {
                fixture.variable(name, &["ocean_time", level, &eta, &xi], data).with("units", "meter second-1")
            };
            fixture = match c {
                0 => {
                    fixture = fixture.variable("h", &[&eta, &xi], values(&|y, x| depth(lon(y, x)))).with("units", "meter");
                    if zeta {
                        let values = Data::F64(fill(2, ny, nx, |t, y, x| surface(t, lon(y, x))));
                        fixture = fixture.variable("zeta", &["ocean_time", &eta, &xi], values).with("units", "meter");
                    }
                    if w { on(fixture, "w", "s_w", of(LEVELS + 1, 1e-3)) } else { fixture }
                }
                1 => on(fixture, "u", "s_rho", of(LEVELS, 1e-2)),
                _ => on(fixture, "v", "s_rho", of(LEVELS, -1e-2)),
            };
        }
        fixture
    }
}

/// Checks all nodes: known ones tell their own height, wherever the levels reach; those below the bottom are missing. Returns how many were compared.
fn check(archive: &mut Archive, roms: &Roms, what: &str) -> usize {
    let mut compared = 0;
    for time in 0..2 {
        let snapshot = archive.read(time).unwrap();
        let [nx, ny, nz] = snapshot.grid.shape();
        for i in 0..nx * ny * nz {
            let lon = snapshot.grid.axes[0].coordinates()[i % nx];
            let z = snapshot.grid.axes[2].coordinates()[i / (nx * ny)];
            let eta = if roms.zeta { surface(time, lon) } else { 0.0 };
            // Columns of neighbouring cells are up to 0.15 degrees away, 6 m of depth.
            let ends = [0, LEVELS - 1].map(|k| height(roms.says, s_of(k, false), depth(lon), eta));
            let node = snapshot.nodes[i];
            if -z > depth(lon) + 6.0 {
                assert!(node[3].is_nan(), "{what}: {lon} E at {z} m is below the bottom at {}", depth(lon));
            }
            if node[3].is_nan() || z < ends[0] + 6.0 || z > ends[1] - 0.3 {
                continue;
            }
            let [east, north] = east_north(&snapshot, i);
            // Cells turn by 0.002, and heights of 100 m in f32 are rounded by 1e-5.
            let off = (east - z / 100.0).abs().max((north + z / 100.0).abs());
            assert!(off < 3e-6, "{what}, time {time}: {east} and {north} at {lon} E, {z} m");
            let up = if roms.w { z / 1000.0 } else { 0.0 };
            assert!((f64::from(node[3]) - up).abs() < 1e-6, "{what}, time {time}: w is {} at {z} m", node[3]);
            compared += 1;
        }
    }
    compared
}

const HEIGHTS: &str = "heights = [-60.0, -40.0, -25.0, -12.0, -8.0, -5.0]\ngrid_relative = false";

#[test]
fn levels_lie_where_the_conventions_say() {
    let dir = tempdir().unwrap();
    let terms = ["ocean_sigma_coordinate", "ocean_s_coordinate", "ocean_s_coordinate_g1", "ocean_s_coordinate_g2"].map(Says::Terms);
    for (n, says) in terms.into_iter().chain([Says::Variables(1.0), Says::Variables(2.0), Says::Attributes]).enumerate() {
        let roms = Roms { says, ..Roms::default() };
        let mut archive = open_with(&[roms.fixture().write(&dir.path().join(format!("{n}.nc")))], HEIGHTS);
        let compared = check(&mut archive, &roms, &format!("{says:?}"));
        assert!(compared > 300, "{says:?}: {compared}");
        let notes = notes(&archive);
        assert!(notes.contains("depth `h`, surface `zeta` of each time") && notes.contains("6 heights from -60.0 to -5.0 m"), "{notes}");
    }
    let still = Roms { zeta: false, w: false, ..Roms::default() };
    let mut archive = open_with(&[still.fixture().write(&dir.path().join("still.nc"))], HEIGHTS);
    assert!(check(&mut archive, &still, "without zeta and w") > 300);
    assert!(notes(&archive).contains("surface at rest") && notes(&archive).contains("no vertical velocity found"));
}

/// Mean eastward velocity of a plane.
fn east(snapshot: &Snapshot) -> f64 {
    let known: Vec<f64> =
        (0..snapshot.nodes.len()).filter(|&i| !snapshot.nodes[i][3].is_nan()).map(|i| east_north(snapshot, i)[0]).collect();
    known.iter().sum::<f64>() / known.len() as f64
}

#[test]
fn one_depth_the_surface_and_the_mean_heights() {
    let dir = tempdir().unwrap();
    let roms = Roms::default();
    let file = roms.fixture().write(&dir.path().join("roms.nc"));
    let later = Roms { hour: 2.0, ..Roms::default() }.fixture().write(&dir.path().join("later.nc"));
    let plane = |level: &str| open_with(&[&file], &format!("{level}\ngrid_relative = false"));
    for time in 0..2 {
        let at_ten = plane("level = -10.0").read(time).unwrap();
        assert_eq!(at_ten.grid.dimensions(), 2);
        for i in (0..at_ten.nodes.len()).filter(|&i| !at_ten.nodes[i][3].is_nan()) {
            assert!((east_north(&at_ten, i)[0] + 0.1).abs() < 3e-6, "{:?}", at_ten.nodes[i]);
        }
        // Only nodes outside the mesh are missing.
        assert!(at_ten.missing_nodes() < at_ten.nodes.len() / 2);
        let top = plane("level = 0.0").read(time).unwrap();
        let native = plane(&format!("select.s_rho = {}", LEVELS - 1)).read(time).unwrap();
        assert_eq!(top.missing_nodes(), native.missing_nodes());
        if time == 0 {
            // Above the highest level the velocity is that of the level, also where the surface is below 0.
            assert!(east(&top) == east(&native) && east(&top) < -1e-3, "{} {}", east(&top), east(&native));
        } else {
            // The highest level is above 0.
            assert!(east(&top).abs() < 1e-6 && east(&native) > 1e-3, "{} {}", east(&top), east(&native));
        }
    }
    // The heights of the first file are those of the archive.
    let mut archive = open_with(&[&file, &later], "grid_relative = false");
    assert_eq!(archive.times().len(), 4);
    let heights = archive.grid().axes[2].coordinates().to_vec();
    assert_eq!(heights.len(), LEVELS + 1);
    let lon = |n: usize| 10.0 + 0.1 * (n % NX) as f64 + 0.02 * (n / NX) as f64;
    for (k, &found) in heights.iter().enumerate() {
        let mean = (0..NX * NY).map(|n| height(roms.says, s_of(k, false), depth(lon(n)), 0.0)).sum::<f64>() / (NX * NY) as f64;
        assert!((found - if k == LEVELS { 0.0 } else { mean }).abs() < 1e-4, "level {k}: {found} and {mean}");
    }
    assert!(check(&mut archive, &roms, "mean heights") > 300);
    let report = inspected(&[&file]).to_string();
    for piece in ["z `altitude`: 13 nodes", "`s_rho` follows the bottom (CF conventions, appendix D", "others with archive.heights"] {
        assert!(report.contains(piece), "`{piece}` is missing in {report}");
    }
}

/// Sigma levels from the surface downwards, on longitudes and latitudes of one dimension.
fn rectilinear(path: &Path, omega: bool) -> std::path::PathBuf {
    let (lon, lat): (Vec<f64>, Vec<f64>) = ((0..8).map(|i| 10.0 + 0.1 * f64::from(i)).collect(), (0..6).map(f64::from).collect());
    let sigma: Vec<f64> = (0..5).map(|k| -0.1 - 0.2 * f64::from(k)).collect();
    let axes: [(&str, &str, &[f64]); 4] =
        [("time", HOURS, &[0.0, 1.0]), ("sigma", "1", &sigma), ("lat", "degrees_north", &lat), ("lon", "degrees_east", &lon)];
    let z = |n: usize, _: usize, x: usize| {
        let eta = surface(n / 5, lon[x]);
        eta + sigma[n % 5] * (depth(lon[x]) + eta)
    };
    let field = |factor: f64| f32s(fill(10, 6, 8, |n, y, x| factor * z(n, y, x)));
    let mut fixture = Fixture::on(NETCDF4, &axes).winds(field(0.01), field(-0.01));
    if omega {
        fixture = fixture.fields("m/s", [("w", field(1e-3))]);
    }
    for variable in fixture.variables.iter_mut().filter(|v| v.name == "sigma") {
        for (name, value) in [("standard_name", "ocean_sigma_coordinate"), ("formula_terms", "sigma: sigma eta: ssh depth: bottom")] {
            variable.attributes.push((name.into(), value.into()));
        }
    }
    fixture
        .variable("bottom", &["lat", "lon"], Data::F64(fill(1, 6, 8, |_, _, x| depth(lon[x]) / 1000.0)))
        .with("units", "km")
        .variable("ssh", &["time", "lat", "lon"], Data::F64(fill(2, 6, 8, |t, _, x| surface(t, lon[x]))))
        .with("units", "m")
        .write(path)
}

#[test]
fn sigma_levels_on_rows_of_coordinates() {
    let dir = tempdir().unwrap();
    for w in [false, true] {
        let file = rectilinear(&dir.path().join(format!("{w}.nc")), w);
        let mut archive = open_with(&[&file], "heights = [-25.0, -20.0, -10.0, -6.0]\nregion = [10.05, 10.65, 0.5, 4.5]");
        assert_eq!(archive.grid().shape(), [6, 4, 4]);
        for time in 0..2 {
            let snapshot = archive.read(time).unwrap();
            assert_eq!(snapshot.missing_nodes(), 0);
            for i in 0..snapshot.nodes.len() {
                let z = snapshot.grid.axes[2].coordinates()[i / 24];
                let [east, north] = east_north(&snapshot, i);
                assert!((east - z / 100.0).abs() < 1e-6 && (north + z / 100.0).abs() < 1e-6, "{east} {north} at {z} m, time {time}");
                assert!((f64::from(snapshot.nodes[i][3]) - if w { z / 1000.0 } else { 0.0 }).abs() < 1e-7);
            }
        }
    }
}

#[test]
fn levels_that_do_not_fit_say_why() {
    let dir = tempdir().unwrap();
    let write = |name: &str, fixture: Fixture| fixture.write(&dir.path().join(name));
    let file = write("roms.nc", Roms::default().fixture());
    for (toml, pieces) in [
        ("level = 10.0", &["level", "10", "negative below the surface"][..]),
        ("level = -1000.0", &["level", "-1000", "deepest bottom"]),
        ("heights = [-5.0]", &["heights", "two heights or more", "archive.level=-DEPTH"]),
        ("heights = [-5.0, -9.0]", &["strictly ascending"]),
        ("heights = [-9.0, -5.0]\nlevel = -5.0", &["heights", "beside `level`"]),
    ] {
        refused(&[&file], toml, pieces);
    }
    let without = |says: Says, name: &str| {
        let mut fixture = Roms { says, ..Roms::default() }.fixture();
        fixture.variables.retain(|v| v.name != name);
        fixture
    };
    let g2 = Says::Terms("ocean_s_coordinate_g2");
    refused(&[write("c.nc", without(g2, "Cs_r"))], "", &["c.nc", "`s_rho`", "lack the term `C`", "formula_terms"]);
    refused(&[write("hc.nc", without(g2, "hc"))], "", &["hc.nc", "lack the term `depth_c`"]);
    refused(&[write("three.nc", Roms { says: Says::Variables(3.0), ..Roms::default() }.fixture())], "", &["`Vtransform` is 3", "1 and 2"]);
    let mut odd = Roms::default().fixture();
    odd.variables
        .iter_mut()
        .filter(|v| v.name == "h")
        .for_each(|v| (v.dimensions, v.data) = (vec!["s_rho".into(), "s_w".into()], Data::F64(vec![9.0; 156])));
    refused(&[write("odd.nc", odd)], "", &["odd.nc", "`h`", "[12, 13]", "13 x 9 points"]);
    // Without the depth, levels are numbers, as before; a level is picked by its number.
    let shallow = write("no_depth.nc", without(g2, "h"));
    refused(&[&shallow], "", &["neither pressures nor lengths"]);
    assert!(notes(&open_with(&[&shallow], "select.s_rho = 3")).contains("entry 3"));
    let mut archive = open(&[write("whole.nc", Roms { says: g2, ..Roms::default() }.fixture())]);
    assert!(archive.read(0).unwrap().missing_nodes() > 0);
}
