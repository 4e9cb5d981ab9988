//! Grids as models write them, small: WRF's, a turned mesh, packed pressure levels.

use super::{Data, Fixture, Format, NETCDF4};
use ridgewatch::field::EARTH_RADIUS;

pub const CELLS: [usize; 3] = [6, 5, 4];
const STEP: f64 = 1000.0;
const GRAVITY: f64 = 9.81;

/// Ground rises along x.
pub fn ground(x: f64) -> f64 {
    0.02 * x
}

/// Velocities that are linear in all coordinates: no interpolation is wrong about them.
pub fn wind(x: f64, y: f64, z: f64, time: f64) -> [f64; 3] {
    [3.0 + 2e-3 * x - 1e-3 * y + 4e-3 * z + time, -1.0 + 1e-3 * x + 3e-3 * y, 0.1 + 1e-4 * z]
}

/// A file of WRF.
pub struct Wrf {
    pub format: Format,
    /// Whether times are characters too.
    pub characters: bool,
    /// Hour of the first time; the second is three hours later.
    pub hour: usize,
    /// How far east the grid lies of where it was at first, in cells, at each of the two times.
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
        for (name, units) in [("XLONG", "degree_east"), ("XLAT", "degree_north")] {
            let mut values = Vec::new();
            for east in self.east {
                for j in 0..ny {
                    values.extend((0..nx).map(|i| {
                        (cell * if name == "XLAT" { j as f64 } else { i as f64 + east } - 87.0 * f64::from(name == "XLONG")) as f32
                    }));
                }
            }
            fixture = fixture.variable(name, &["Time", "south_north", "west_east"], Data::F32(values)).with("units", units);
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
            let mut values = Vec::new();
            for east in self.east {
                for k in 0..nz + 1 {
                    for _ in 0..ny {
                        values.extend(
                            (0..nx).map(|i| ((ground((i as f64 + east + 0.5) * STEP) + 500.0 * k as f64) * GRAVITY * share) as f32),
                        );
                    }
                }
            }
            fixture =
                fixture.variable(name, &["Time", "bottom_top_stag", "south_north", "west_east"], Data::F32(values)).with("units", "m2 s-2");
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
    /// Whether the flow runs along the mesh, one metre a second, and not eastward.
    pub along_grid: bool,
    /// Degrees that the mesh lies further east.
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
        let v: Vec<f32> = (0..2 * n * n).map(|_| 0.0).collect();
        let names = if along_grid {
            ["sea_water_x_velocity", "sea_water_y_velocity"]
        } else {
            ["eastward_sea_water_velocity", "northward_sea_water_velocity"]
        };
        Fixture::new(format, &[("time", 2), ("y", n), ("x", n)])
            .axis("time", "hours since 2000-01-01", &[hour, hour + 1.0])
            .variable("nav_lon", &["y", "x"], Data::F64(points.iter().map(|p| p.0).collect()))
            .with("units", "degrees_east")
            .variable("nav_lat", &["y", "x"], Data::F64(points.iter().map(|p| p.1).collect()))
            .with("units", "degrees_north")
            .variable("uo", &["time", "y", "x"], Data::F32(u))
            .with("standard_name", names[0])
            .with("units", "m s-1")
            .with("coordinates", "nav_lat nav_lon")
            .variable("vo", &["time", "y", "x"], Data::F32(v))
            .with("standard_name", names[1])
            .with("units", "m s-1")
            .with("coordinates", "nav_lat nav_lon")
    }
}

/// What [`packed_levels`] holds at a pressure (hPa) and indices along longitude and latitude, latitudes ascending: u in m/s.
pub fn packed_wind(pressure: f64, i: usize, j: usize) -> f64 {
    0.01 * pressure + 0.1 * j as f64 + i as f64
}

/// Winds as ECMWF packs them, on `levels` (hPa) in their order: longitudes 90 degrees apart, latitudes descending, omega, two times.
pub fn packed_levels(format: Format, levels: &[f64], hour: f64) -> Fixture {
    let (nx, ny) = (4, 5);
    let mut fixture = Fixture::new(format, &[("time", 2), ("level", levels.len()), ("latitude", ny), ("longitude", nx)])
        .axis("longitude", "degrees_east", &[0.0, 90.0, 180.0, 270.0])
        .axis("latitude", "degrees_north", &[60.0, 30.0, 0.0, -30.0, -60.0])
        .axis("level", "hPa", levels)
        .axis("time", "hours since 2000-01-01", &[hour, hour + 1.0]);
    let described =
        [("u", "eastward_wind", "m s**-1"), ("v", "northward_wind", "m s**-1"), ("w", "lagrangian_tendency_of_air_pressure", "Pa s**-1")];
    for (name, standard, units) in described {
        let mut values = Vec::new();
        for _ in 0..2 {
            for &pressure in levels {
                for j in 0..ny {
                    values.extend((0..nx).map(|i| (packed_wind(pressure, i, ny - 1 - j) * 100.0).round() as i16));
                }
            }
        }
        fixture = fixture
            .variable(name, &["time", "level", "latitude", "longitude"], Data::I16(values))
            .with("standard_name", standard)
            .with("units", units)
            .with("scale_factor", 0.01)
            .with("add_offset", 0.0)
            .with("_FillValue", -32_767i16)
            .deflated();
    }
    fixture
}
