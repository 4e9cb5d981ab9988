//! Small files on the grids of models: WRF's staggered one, a turned mesh, packed pressure levels.

use super::netcdf::{Data, Fixture, Format, NETCDF4, f32s, fill};
use ridgewatch::field::EARTH_RADIUS;

pub const CELLS: [usize; 3] = [6, 5, 4];
const STEP: f64 = 1000.0;
const GRAVITY: f64 = 9.81;

/// Height of the ground, which rises along x.
pub fn ground(x: f64) -> f64 {
    0.02 * x
}

/// Velocities that are linear in all coordinates, so that interpolation is exact.
pub fn wind(x: f64, y: f64, z: f64, time: f64) -> [f64; 3] {
    [3.0 + 2e-3 * x - 1e-3 * y + 4e-3 * z + time, -1.0 + 1e-3 * x + 3e-3 * y, 0.1 + 1e-4 * z]
}

/// A file of WRF.
pub struct Wrf {
    pub format: Format,
    /// Writes times as characters as well.
    pub characters: bool,
    /// Hour of the first time; the second is three hours later.
    pub hour: usize,
    /// Distance in cells by which the grid has moved east at each of the two times.
    pub east: [f64; 2],
}

impl Default for Wrf {
    fn default() -> Self {
        Self { format: NETCDF4, characters: true, hour: 12, east: [0.0; 2] }
    }
}

impl Wrf {
    /// Cells of 1 km with centres at half kilometres and full levels 500 m apart over a ground that rises. Winds grow by 1 m/s in three hours.
    pub fn fixture(&self) -> Fixture {
        let [nx, ny, nz] = CELLS;
        let hours = [self.hour, self.hour + 3];
        let mut fixture = Fixture::new(
            self.format,
            &[
                ("Time", 2),
                ("DateStrLen", 19),
                ("west_east", nx),
                ("south_north", ny),
                ("bottom_top", nz),
                ("west_east_stag", nx + 1),
                ("south_north_stag", ny + 1),
                ("bottom_top_stag", nz + 1),
            ],
        )
        .attribute("DX", STEP as f32)
        .attribute("DY", STEP as f32);
        if self.characters {
            let times: String = hours.iter().map(|hour| format!("2005-08-28_{hour:02}:00:00")).collect();
            fixture = fixture.variable("Times", &["Time", "DateStrLen"], Data::Text(times));
        }
        let minutes = hours.map(|hour| 60.0 * hour as f32).to_vec();
        fixture = fixture.variable("XTIME", &["Time"], Data::F32(minutes)).with("units", "minutes since 2005-08-28 00:00:00");
        // Degrees a cell, on the equator.
        let cell = (STEP / EARTH_RADIUS).to_degrees();
        let longitude = |east: f64, _: usize, i: usize| cell * (i as f64 + east) - 87.0;
        let latitude = |_: f64, j: usize, _: usize| cell * j as f64;
        let coordinates: [(&str, &str, &dyn Fn(f64, usize, usize) -> f64); 2] =
            [("XLONG", "degree_east", &longitude), ("XLAT", "degree_north", &latitude)];
        for (name, units, at) in coordinates {
            let values = f32s(fill(2, ny, nx, |t, j, i| at(self.east[t], j, i)));
            fixture = fixture.variable(name, &["Time", "south_north", "west_east"], values).with("units", units);
        }
        for (c, (name, dims)) in [
            ("U", ["Time", "bottom_top", "south_north", "west_east_stag"]),
            ("V", ["Time", "bottom_top", "south_north_stag", "west_east"]),
            ("W", ["Time", "bottom_top_stag", "south_north", "west_east"]),
        ]
        .into_iter()
        .enumerate()
        {
            let mut values = Vec::new();
            for (hour, east) in hours.into_iter().zip(self.east) {
                for k in 0..nz + usize::from(c == 2) {
                    for j in 0..ny + usize::from(c == 1) {
                        for i in 0..nx + usize::from(c == 0) {
                            let x = (i as f64 + east + if c == 0 { 0.0 } else { 0.5 }) * STEP;
                            let y = (j as f64 + if c == 1 { 0.0 } else { 0.5 }) * STEP;
                            let z = ground(x) + 500.0 * (k as f64 + if c == 2 { 0.0 } else { 0.5 });
                            values.push(wind(x, y, z, (hour - 12) as f64 / 3.0)[c] as f32);
                        }
                    }
                }
            }
            fixture = fixture.variable(name, &dims, Data::F32(values)).with("units", "m s-1").with("stagger", ["X", "Y", "Z"][c]);
        }
        for (name, share) in [("PH", 0.25), ("PHB", 0.75)] {
            let height = |i: usize, k: usize, east: f64| ground((i as f64 + east + 0.5) * STEP) + 500.0 * k as f64;
            let values = fill(2 * (nz + 1), ny, nx, |n, _, i| height(i, n % (nz + 1), self.east[n / (nz + 1)]) * GRAVITY * share);
            let dimensions = ["Time", "bottom_top_stag", "south_north", "west_east"];
            fixture = fixture.variable(name, &dimensions, f32s(values)).with("units", "m2 s-2");
        }
        fixture
    }
}

/// Longitude and latitude of a mesh turned by 20 degrees about (30 E, 40 N).
fn mesh(i: usize, j: usize, n: usize) -> (f64, f64) {
    let (x, y) = ((i as f64 / (n - 1) as f64 - 0.5) * 12.0, (j as f64 / (n - 1) as f64 - 0.5) * 12.0);
    let (sine, cosine) = 20f64.to_radians().sin_cos();
    // Lengths on the ground, so that the mesh is turned there and not only on the map.
    (30.0 + (cosine * x - sine * y) / 40f64.to_radians().cos(), 40.0 + sine * x + cosine * y)
}

pub fn eastward(lon: f64, lat: f64) -> f64 {
    0.5 + 0.3 * (lon * 0.2).sin() + 0.02 * (lat - 40.0)
}

/// Currents on the turned mesh.
pub struct Ocean {
    pub format: Format,
    /// Points along each side.
    pub n: usize,
    /// The flow runs along the mesh at one metre a second, and not eastward.
    pub along_grid: bool,
    /// Degrees by which the mesh lies further east.
    pub east: f64,
    /// Hour of the first of two times.
    pub hour: f64,
}

impl Default for Ocean {
    fn default() -> Self {
        Self { format: NETCDF4, n: 49, along_grid: false, east: 0.0, hour: 0.0 }
    }
}

impl Ocean {
    pub fn fixture(&self) -> Fixture {
        let &Self { format, n, along_grid, east, hour } = self;
        let points: Vec<(f64, f64)> = (0..n * n).map(|p| mesh(p % n, p / n, n)).map(|(lon, lat)| (lon + east, lat)).collect();
        // An island of nine points; along the grid the flow is (1, 0) everywhere.
        let island = |p: usize| (10..13).contains(&(p % n)) && (10..13).contains(&(p / n));
        let flow = |p: usize| if along_grid { 1.0 } else { eastward(points[p].0, points[p].1) };
        let u: Vec<f32> = (0..2 * n * n).map(|p| if island(p % (n * n)) { f32::NAN } else { flow(p % (n * n)) as f32 }).collect();
        let names = if along_grid {
            ["sea_water_x_velocity", "sea_water_y_velocity"]
        } else {
            ["eastward_sea_water_velocity", "northward_sea_water_velocity"]
        };
        let mut fixture =
            Fixture::new(format, &[("time", 2), ("y", n), ("x", n)]).axis("time", "hours since 2000-01-01", &[hour, hour + 1.0]);
        let (lon, lat) = points.iter().copied().unzip();
        for (name, units, values) in [("nav_lon", "degrees_east", lon), ("nav_lat", "degrees_north", lat)] {
            fixture = fixture.variable(name, &["y", "x"], Data::F64(values)).with("units", units);
        }
        for (name, standard, values) in [("uo", names[0], u), ("vo", names[1], vec![0.0; 2 * n * n])] {
            fixture = fixture.fields("m s-1", [(name, Data::F32(values))]).with("standard_name", standard);
            fixture = fixture.with("coordinates", "nav_lat nav_lon");
        }
        fixture
    }
}

/// Wind (m/s) of [`packed_levels`] at a pressure (hPa) and indices along longitude and ascending latitude.
pub fn packed_wind(pressure: f64, i: usize, j: usize) -> f64 {
    0.01 * pressure + 0.1 * j as f64 + i as f64
}

/// Winds as ECMWF packs them, on `levels` (hPa) in their order: longitudes 90 degrees apart, latitudes descending, omega, two times.
pub fn packed_levels(format: Format, levels: &[f64], hour: f64) -> Fixture {
    let (nx, ny) = (4, 5);
    let mut fixture = Fixture::on(
        format,
        &[
            ("time", "hours since 2000-01-01", &[hour, hour + 1.0]),
            ("level", "hPa", levels),
            ("latitude", "degrees_north", &[60.0, 30.0, 0.0, -30.0, -60.0]),
            ("longitude", "degrees_east", &[0.0, 90.0, 180.0, 270.0]),
        ],
    );
    let described =
        [("u", "eastward_wind", "m s**-1"), ("v", "northward_wind", "m s**-1"), ("w", "lagrangian_tendency_of_air_pressure", "Pa s**-1")];
    for (name, standard, units) in described {
        let winds = fill(2 * levels.len(), ny, nx, |n, j, i| packed_wind(levels[n % levels.len()], i, ny - 1 - j));
        let packed = winds.into_iter().map(|wind| (wind * 100.0).round() as i16).collect();
        fixture = fixture
            .fields(units, [(name, Data::I16(packed))])
            .with("standard_name", standard)
            .with("scale_factor", 0.01)
            .with("add_offset", 0.0)
            .with("_FillValue", -32_767i16)
            .deflated();
    }
    fixture
}
