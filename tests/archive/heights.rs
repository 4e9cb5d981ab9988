//! Levels whose heights are a field: partial cells at the bottom, layers that move, a model of the atmosphere. Velocities are proportional to the height.

use crate::kit::netcdf::*;
use crate::{HOURS, inspected, notes, open, open_with, refused};
use ridgewatch::source::{Archive, SnapshotSource};
use tempfile::tempdir;

const NX: usize = 9;
const NY: usize = 6;
const LEVELS: usize = 8;

/// A field of heights in a file, and what it is told by.
#[derive(Clone, Copy)]
struct Layers {
    /// Height of the centre of a layer, counted from the top, at a time and a longitude, metres.
    height: fn(time: usize, layer: usize, lon: f64) -> f64,
    /// Name, unit, how many metres it is, attribute `positive`.
    name: &'static str,
    unit: (&'static str, f64),
    positive: Option<&'static str>,
    /// True if `coordinates` of u and v name it.
    named: bool,
    moves: bool,
    w: bool,
}

/// Layers of a sloping sea, moved by the tide.
fn sloping(time: usize, layer: usize, lon: f64) -> f64 {
    -(layer as f64 + 0.5) * (8.0 + 4.0 * (lon - 10.0) + 0.5 * time as f64)
}

/// Levels 10 m apart. The last layer is thinner to the east: its centre is higher.
fn partial(_: usize, layer: usize, lon: f64) -> f64 {
    let thinner = if layer == LEVELS - 1 { 4.0 * (lon - 10.0) } else { 0.0 };
    -(10.0 * layer as f64 + 5.0) + thinner
}

/// Layers that are thinner to the west, where two have no thickness.
fn vanishing(_: usize, layer: usize, lon: f64) -> f64 {
    let (thick, thin) = (layer.min(2) + layer.saturating_sub(4), layer.clamp(2, 4) - 2);
    -(5.0 + 10.0 * thick as f64 + 50.0 * (lon - 10.0) * thin as f64)
}

/// Layers above a mountain.
fn of_air(_: usize, layer: usize, lon: f64) -> f64 {
    let ground = 800.0 * (lon - 10.0);
    ground + ((LEVELS - layer) as f64 - 0.5) * (12_000.0 - ground) / LEVELS as f64
}

impl Default for Layers {
    fn default() -> Self {
        Self { height: sloping, name: "depths", unit: ("km", 1000.0), positive: Some("down"), named: true, moves: true, w: true }
    }
}

impl Layers {
    fn fixture(&self) -> Fixture {
        let &Self { height, name, unit: (unit, metres), positive, named, moves, w } = self;
        let (lon, lat): (Vec<f64>, Vec<f64>) = ((0..NX).map(|i| 10.0 + 0.1 * i as f64).collect(), (0..NY).map(|j| j as f64).collect());
        let axes: [(&str, &str, &[f64]); 3] = [("time", HOURS, &[0.0, 1.0]), ("lat", "degrees_north", &lat), ("lon", "degrees_east", &lon)];
        let mut fixture = Fixture::on(NETCDF4, &axes).dimension("layer", LEVELS).dimension("face", LEVELS + 1);
        // Faces lie half way between the centres, and as far beyond them.
        let face = move |time: usize, face: usize, lon: f64| {
            let at = |layer: usize| height(time, layer, lon);
            match face {
                0 => 1.5 * at(0) - 0.5 * at(1),
                LEVELS => 1.5 * at(LEVELS - 1) - 0.5 * at(LEVELS - 2),
                _ => 0.5 * (at(face - 1) + at(face)),
            }
        };
        let sign = if positive == Some("up") { 1.0 } else { -1.0 };
        for (component, factor, level) in [("u", 0.01, "layer"), ("v", -0.01, "layer"), ("w", 1e-3, "face")] {
            let count = if level == "layer" { LEVELS } else { LEVELS + 1 };
            let z = |n: usize, x: usize| {
                if level == "layer" { height(n / count, n % count, lon[x]) } else { face(n / count, n % count, lon[x]) }
            };
            let field = if level == "layer" { name.to_string() } else { format!("{name}_w") };
            if component != "v" && (w || component == "u") {
                let times = if moves { 2 } else { 1 };
                let data = Data::F64(fill(times * count, NY, NX, |n, _, x| sign * z(n, x) / metres));
                let dimensions = if moves { vec!["time", level, "lat", "lon"] } else { vec![level, "lat", "lon"] };
                fixture = fixture.variable(&field, &dimensions, data).with("units", unit);
                if let Some(positive) = positive {
                    fixture = fixture.with("positive", positive);
                }
            }
            if component == "w" && !w {
                continue;
            }
            let data = f32s(fill(2 * count, NY, NX, |n, _, x| factor * z(n, x)));
            fixture = fixture.variable(component, &["time", level, "lat", "lon"], data).with("units", "m s-1");
            fixture = fixture.with(
                "standard_name",
                match component {
                    "u" => "eastward_sea_water_velocity",
                    "v" => "northward_sea_water_velocity",
                    _ => "upward_sea_water_velocity",
                },
            );
            if named {
                fixture = fixture.with("coordinates", format!("{field} lat lon").as_str());
            }
        }
        fixture
    }

    /// Checks every node against its own height. Returns how many were known.
    fn check(&self, archive: &mut Archive) -> usize {
        let mut known = 0;
        for time in 0..2 {
            let snapshot = archive.read(time).unwrap();
            let [nx, ny, nz] = snapshot.grid.shape();
            for i in 0..nx * ny * nz {
                let (lon, z) = (snapshot.grid.axes[0].coordinates()[i % nx], snapshot.grid.axes[2].coordinates()[i / (nx * ny)]);
                let [high, low] = [0, LEVELS - 1].map(|layer| (self.height)(time, layer, lon));
                // Between the highest level of the sea and its surface the velocity is that of the level.
                let top = if high < 0.0 { 0.0 } else { high };
                let node = snapshot.nodes[i];
                if (z - low).abs() < 1e-3 || (z - top).abs() < 1e-3 {
                    continue;
                }
                assert_eq!(node[3].is_nan(), !(low..=top).contains(&z), "{lon} E, {z} m, time {time}: {node:?}");
                if node[3].is_nan() {
                    continue;
                }
                let [east, north] = east_north(&snapshot, i);
                let from = z.min(high);
                let off = (east - from / 100.0).abs().max((north + from / 100.0).abs());
                assert!(off < 2e-6 * (1.0 + from.abs() / 100.0), "{lon} E, {z} m, time {time}: {east} {north}");
                // w has faces above the highest centre.
                if z <= high {
                    let up = if self.w { z / 1000.0 } else { 0.0 };
                    assert!((f64::from(node[3]) - up).abs() < 1e-6 * (1.0 + up.abs()), "{lon} E, {z} m, time {time}: {}", node[3]);
                }
                known += 1;
            }
        }
        known
    }
}

#[test]
fn layers_lie_where_their_field_says() {
    let dir = tempdir().unwrap();
    let file = |name: &str, layers: &Layers| layers.fixture().write(&dir.path().join(name));
    let moving = Layers::default();
    let moved = file("moving.nc", &moving);
    let mut archive = open_with(&[&moved], "heights = [-60.0, -40.0, -20.0, -10.0, -2.0, 0.0]");
    assert!(moving.check(&mut archive) > 400);
    let said = notes(&archive);
    assert!(said.contains("`layer` lies at the heights `depths` of each point (positive down)"), "{said}");
    // The mean heights, and 0.
    let mut archive = open(&[&moved]);
    assert_eq!(archive.grid().axes[2].len(), LEVELS + 1);
    assert!((archive.grid().axes[2].coordinates()[0] - sloping(0, LEVELS - 1, 10.4)).abs() < 1e-3);
    assert!(moving.check(&mut archive) > 500);
    assert!(inspected(&[&moved]).to_string().contains("z `altitude`: 9 nodes"));

    // Layers that vanish.
    let vanishing = Layers { height: vanishing, w: false, ..moving };
    assert!(vanishing.check(&mut open_with(&[file("vanishing.nc", &vanishing)], "heights = [-55.0, -35.0, -15.0, -2.0]")) > 200);

    // Without `positive`, by the name. Of one time.
    let still = Layers { height: |_, layer, lon| sloping(0, layer, lon), positive: None, moves: false, unit: ("m", 1.0), ..moving };
    assert!(still.check(&mut open_with(&[file("still.nc", &still)], "heights = [-60.0, -30.0, -10.0]")) > 150);

    let air = Layers { height: of_air, name: "altitude", positive: Some("up"), unit: ("m", 1.0), moves: false, ..moving };
    let air_file = file("air.nc", &air);
    let mut archive = open_with(&[&air_file], "heights = [800.0, 1200.0, 2000.0, 6000.0, 11000.0]");
    assert!(air.check(&mut archive) > 300);
    assert!(notes(&archive).contains("below the ground it is missing"));
    let mut one = open_with(&[&air_file], "level = 2000.0");
    let snapshot = one.read(0).unwrap();
    assert!((east_north(&snapshot, 0)[0] - 20.0).abs() < 1e-4);
}

/// The atmosphere's levels by geopotentials or pressures, which need not count downwards.
#[test]
fn geopotentials_and_pressures_tell_heights() {
    let dir = tempdir().unwrap();
    let air = Layers { height: of_air, name: "zg", positive: Some("up"), unit: ("m", 1.0), named: false, moves: false, w: true };
    let write = |name: &str, unit: &str, of: &dyn Fn(f64) -> f64| {
        let mut fixture = air.fixture();
        for variable in &mut fixture.variables {
            let standard = match variable.name.as_str() {
                "u" => "eastward_wind",
                "v" => "northward_wind",
                "w" => "upward_air_velocity",
                name => {
                    if let (true, Data::F64(values)) = (name.starts_with("zg"), &mut variable.data) {
                        variable.attributes = vec![("units".into(), unit.into())];
                        values.iter_mut().for_each(|z| *z = of(*z));
                    }
                    continue;
                }
            };
            variable.attributes = ["units", "standard_name", "coordinates"]
                .map(String::from)
                .into_iter()
                .zip(["m s-1", standard, if standard == "upward_air_velocity" { "zg_w lat lon" } else { "lat lon" }].map(Into::into))
                .collect();
        }
        fixture.write(&dir.path().join(name))
    };
    let heights = "z = \"zg\"\nheights = [800.0, 1200.0, 2000.0, 6000.0, 11000.0]";
    for (name, unit, of) in [
        ("geopotential.nc", "m**2 s**-2", &(|z: f64| 9.80665 * z) as &dyn Fn(f64) -> f64),
        ("pressure.nc", "hPa", &|z: f64| 1000.0 * (-z / 7000.0).exp()),
    ] {
        let mut archive = open_with(&[write(name, unit, of)], heights);
        assert!(air.check(&mut archive) > 300, "{name}");
        let said = notes(&archive);
        assert!(said.contains(if unit == "hPa" { "lies at the pressures `zg`" } else { "lies at the heights `zg`" }), "{said}");
    }
}

/// Heights that change, in a file of their own: those of the velocity's times.
#[test]
fn heights_of_other_times_are_refused() {
    let dir = tempdir().unwrap();
    let layers = Layers { w: false, ..Layers::default() };
    let [mut currents, mut depths] = [layers.fixture(), layers.fixture()];
    currents.variables.retain(|v| v.name != "depths");
    depths.variables.retain(|v| !["u", "v"].contains(&v.name.as_str()));
    let files = [currents.write(&dir.path().join("currents.nc")), depths.write(&dir.path().join("depths.nc"))];
    let toml = "z = \"depths\"\nheights = [-60.0, -30.0, -10.0]";
    assert!(layers.check(&mut open_with(&files, toml)) > 200);
    depths.variables.iter_mut().filter(|v| v.name == "time").for_each(|v| v.data = Data::F64(vec![2.0, 3.0]));
    let late = depths.write(&dir.path().join("late.nc"));
    refused(&[&files[0], &late], toml, &["late.nc", "currents.nc", "must have the same times"]);
    // One time a file.
    let of_time = |time: usize, holds: &[&str]| {
        let at = Layers {
            height: if time == 0 { |_, k, lon| sloping(0, k, lon) } else { |_, k, lon| sloping(1, k, lon) },
            moves: true,
            ..layers
        };
        let mut fixture = at.fixture();
        fixture.variables.retain(|v| holds.contains(&v.name.as_str()));
        for (name, len) in fixture.dimensions.iter_mut().filter(|(name, _)| name == "time") {
            assert_eq!((name.as_str(), *len), ("time", 2));
            *len = 1;
        }
        for variable in fixture.variables.iter_mut().filter(|v| v.dimensions[0] == "time") {
            variable.data = match &variable.data {
                Data::F64(_) if variable.name == "time" => Data::F64(vec![time as f64]),
                Data::F64(values) => Data::F64(values[..values.len() / 2].to_vec()),
                Data::F32(values) => Data::F32(values[..values.len() / 2].to_vec()),
                _ => panic!("other numbers"),
            };
        }
        fixture.write(&dir.path().join(format!("{}{time}.nc", holds[0])))
    };
    let axes = ["time", "lat", "lon"];
    let currents = [0, 1].map(|time| of_time(time, &[&["u", "v"][..], &axes].concat()));
    let depths = [0, 1].map(|time| of_time(time, &[&["depths"][..], &axes].concat()));
    let [first, second] = [&depths[0], &depths[1]];
    assert!(layers.check(&mut open_with(&[&currents[0], &currents[1], second, first], toml)) > 200);
    refused(&[&currents[0], &currents[1], second], toml, &["must have the same times"]);
    // Cells are those of the file.
    let whole = layers.fixture().write(&dir.path().join("whole.nc"));
    refused(&[&whole], "z = \"depths\"\nmetric = \"index\"", &["`depths`", "in metres and not in cells"]);
}

/// Levels of w that are as many as those of u lie elsewhere.
#[test]
fn w_has_heights_of_its_own() {
    let dir = tempdir().unwrap();
    let whole = Layers { unit: ("m", 1.0), ..Layers::default() };
    let read = |fixture: &Fixture, name: &str| {
        let mut archive = open_with(&[fixture.write(&dir.path().join(name))], "z = \"depths\"\nheights = [-50.0, -30.0, -20.0]");
        (notes(&archive), archive.read(0).unwrap())
    };
    // The lowest face is left out, so that faces are as many as layers.
    let mut fixture = whole.fixture();
    fixture.dimensions.iter_mut().filter(|(name, _)| name == "face").for_each(|(_, len)| *len = LEVELS);
    for variable in fixture.variables.iter_mut().filter(|v| v.dimensions.contains(&"face".to_string())) {
        let level = NY * NX;
        let whole = |n: usize| n / level % (LEVELS + 1) < LEVELS;
        variable.data = match &variable.data {
            Data::F64(values) => Data::F64(values.iter().enumerate().filter(|(n, _)| whole(*n)).map(|(_, v)| *v).collect()),
            Data::F32(values) => Data::F32(values.iter().enumerate().filter(|(n, _)| whole(*n)).map(|(_, v)| *v).collect()),
            _ => panic!("other numbers"),
        };
    }
    let (_, snapshot) = read(&fixture, "own.nc");
    let known = (0..snapshot.nodes.len()).filter(|&i| !snapshot.nodes[i][3].is_nan());
    let compared = known.map(|i| {
        let z = snapshot.grid.axes[2].coordinates()[i / (NX * NY)];
        assert!((f64::from(snapshot.nodes[i][3]) - z / 1000.0).abs() < 1e-6, "{:?} at {z}", snapshot.nodes[i]);
    });
    assert!(compared.count() > 50);
    // Without heights of its own it is not used.
    fixture.variables.retain(|v| v.name != "depths_w");
    let (said, snapshot) = read(&fixture, "none.nc");
    assert!(
        said.contains("`w` does not lie on the levels of the heights, nor do its `coordinates` name heights of its own, and is not used"),
        "{said}"
    );
    assert!(snapshot.nodes.iter().all(|node| node[3].is_nan() || node[3] == 0.0));
}

/// NEMO: w lies at `gdepw_0` beside `gdept_0`.
#[test]
fn w_of_nemo_lies_between_the_depths_that_are_named() {
    let dir = tempdir().unwrap();
    let layers = Layers {
        name: "gdept_0",
        unit: ("m", 1.0),
        named: false,
        moves: false,
        height: |_, k, lon| sloping(0, k, lon),
        ..Layers::default()
    };
    let mut fixture = layers.fixture();
    fixture.variables.iter_mut().filter(|v| v.name == "gdept_0_w").for_each(|v| v.name = "gdepw_0".into());
    let mut archive = open_with(&[fixture.write(&dir.path().join("nemo.nc"))], "z = \"gdept_0\"\nheights = [-60.0, -30.0, -10.0]");
    assert!(layers.check(&mut archive) > 150);
}

/// A depth that nothing calls one is told by the water.
#[test]
fn depths_of_water_are_positive_down() {
    let dir = tempdir().unwrap();
    let layers = Layers { name: "zc", positive: None, unit: ("m", 1.0), ..Layers::default() };
    let mut archive = open_with(&[layers.fixture().write(&dir.path().join("water.nc"))], "heights = [-60.0, -30.0, -10.0]");
    assert!(layers.check(&mut archive) > 200 && notes(&archive).contains("positive down"));
}

/// Levels with depths of their own, and a field that says more: it has to be named, and may lie in another file.
#[test]
fn partial_cells_by_a_field_that_is_named() {
    let dir = tempdir().unwrap();
    let layers = Layers { height: partial, name: "gdept_0", unit: ("m", 1.0), positive: None, named: false, moves: false, w: false };
    let depths: Vec<f64> = (0..LEVELS).map(|k| 10.0 * k as f64 + 5.0).collect();
    let with_depths =
        |fixture: Fixture| fixture.variable("layer", &["layer"], Data::F64(depths.clone())).with("units", "m").with("positive", "down");
    let whole = with_depths(layers.fixture());
    let file = whole.write(&dir.path().join("whole.nc"));
    let heights = "heights = [-73.0, -70.0, -66.0, -40.0, -12.0]";
    assert!(layers.check(&mut open_with(&[&file], &format!("z = \"gdept_0\"\n{heights}"))) > 300);
    // Without the name levels are flat.
    let flat = notes(&open(&[&file]));
    assert!(flat.contains("--set archive.z=gdept_0 uses it") && !flat.contains("lies at the heights"), "{flat}");

    let [mut currents, mut mesh] = [with_depths(layers.fixture()), layers.fixture()];
    currents.variables.retain(|v| v.name != "gdept_0");
    mesh.variables.retain(|v| !["u", "v", "time"].contains(&v.name.as_str()));
    let files = [currents.write(&dir.path().join("currents.nc")), mesh.write(&dir.path().join("mesh.nc"))];
    assert!(layers.check(&mut open_with(&files, &format!("z = \"gdept_0\"\n{heights}"))) > 300);

    // A mesh file whose dimensions have other names, as NEMO's.
    let data = fill(LEVELS, NY, NX, |k, _, x| -partial(0, k, 10.0 + 0.1 * x as f64));
    let mesh = Fixture::new(NETCDF4, &[("t", 1), ("z", LEVELS), ("y", NY), ("x", NX)]);
    let mesh = mesh.variable("gdept_0", &["t", "z", "y", "x"], Data::F64(data)).with("units", "m").write(&dir.path().join("mesh_mask.nc"));
    assert!(layers.check(&mut open_with(&[&files[0], &mesh], &format!("z = \"gdept_0\"\n{heights}"))) > 300);

    // Land that was filled with zeros has no columns.
    let mut filled = with_depths(layers.fixture());
    for variable in filled.variables.iter_mut().filter(|v| v.name == "gdept_0") {
        if let Data::F64(values) = &mut variable.data {
            values.iter_mut().step_by(NX).for_each(|value| *value = 0.0);
        }
    }
    let mut archive = open_with(&[filled.write(&dir.path().join("filled.nc"))], "z = \"gdept_0\"\nheights = [-60.0, -40.0]");
    let snapshot = archive.read(0).unwrap();
    let land = |i: usize| i.is_multiple_of(NX);
    assert!((0..snapshot.nodes.len()).all(|i| snapshot.nodes[i][3].is_nan() == land(i)));

    let mut thick = with_depths(layers.fixture());
    thick.variables.iter_mut().filter(|v| v.name == "gdept_0").for_each(|v| v.name = "e3t_0".into());
    refused(&[thick.write(&dir.path().join("thick.nc"))], "z = \"e3t_0\"", &["`e3t_0`", "thicknesses of layers", "gdept_0"]);

    // A level that is selected is read as it is.
    let mut level = open_with(&[&file], "z = \"gdept_0\"\nselect.layer = 2");
    assert!((east_north(&level.read(0).unwrap(), 0)[0] + 0.25).abs() < 1e-6);

    refused(&[&files[0]], "z = \"gdept_0\"", &["gdept_0"]);
    let mut other = whole.dimension("deep", 3);
    other = other.variable("dz", &["deep", "lat", "lon"], Data::F64(vec![1.0; 3 * NX * NY]));
    refused(&[other.write(&dir.path().join("other.nc"))], "z = \"dz\"", &["other.nc", "`dz`", "levels, y and x as those of `u`"]);
    // A part of the sea that begins at 105 m: nothing is known above.
    let deep = Layers { height: |_, layer, _| -(105.0 + 10.0 * layer as f64), named: true, ..layers };
    let mut archive = open_with(&[deep.fixture().write(&dir.path().join("deep.nc"))], "z = \"gdept_0\"");
    assert_eq!(archive.grid().axes[2].coordinates(), (0..LEVELS).map(|k| -175.0 + 10.0 * k as f64).collect::<Vec<_>>());
    assert_eq!(archive.read(0).unwrap().missing_nodes(), 0);
    let mut above = open_with(&[dir.path().join("deep.nc")], "z = \"gdept_0\"\nheights = [-150.0, -50.0]");
    assert_eq!(above.read(0).unwrap().missing_nodes(), NX * NY);

    let pressure = Layers { unit: ("dbar", 1.0), ..layers };
    let file = with_depths(pressure.fixture()).write(&dir.path().join("pressure.nc"));
    refused(&[&file], "z = \"gdept_0\"", &["`gdept_0`", "`dbar` is no length or geopotential", "archive.units.z=m"]);
    let square = Fixture::new(NETCDF4, &[("time", 2), ("layer", 2), ("lat", 3), ("lon", 3)])
        .axis("time", HOURS, &[0.0, 1.0])
        .axis("lat", "degrees_north", &[0.0, 1.0, 2.0])
        .axis("lon", "degrees_east", &[0.0, 1.0, 2.0])
        .variable("turned", &["layer", "lon", "lat"], Data::F64((0..18).map(f64::from).collect()));
    let square = ["eastward", "northward"].iter().zip(["u", "v"]).fold(square, |fixture, (along, name)| {
        let fixture = fixture.variable(name, &["time", "layer", "lat", "lon"], Data::F32(vec![1.0; 36])).with("units", "m s-1");
        fixture.with("standard_name", format!("{along}_wind").as_str())
    });
    refused(&[square.write(&dir.path().join("turned.nc"))], "z = \"turned\"", &["`turned`", "layer, lon, lat", "y and x as the last ones"]);
    let folded = Layers { height: |_, layer, _| -((layer as f64 - 3.2).powi(2) + 5.0), ..layers };
    let file = with_depths(folded.fixture()).write(&dir.path().join("folded.nc"));
    refused(&[&file], "z = \"gdept_0\"", &["`gdept_0`", "go up and down"]);
    let mut empty = with_depths(layers.fixture());
    for variable in empty.variables.iter_mut().filter(|v| v.name == "gdept_0") {
        variable.data = Data::F64(vec![f64::NAN; LEVELS * NX * NY]);
    }
    refused(&[empty.write(&dir.path().join("empty.nc"))], "z = \"gdept_0\"", &["`gdept_0`", "it gives the levels no heights"]);
}
