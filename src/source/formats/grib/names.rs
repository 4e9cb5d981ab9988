//! Names, units and CF standard names of parameters and types of level. Names are those of ecCodes and cfgrib.

use super::message::Process;

/// A parameter.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Parameter {
    /// The row of [`KNOWN`].
    Known(usize),
    /// Discipline, category and number of edition 2.
    Edition2([u8; 3]),
    /// Table and number of edition 1.
    Edition1([u8; 2]),
}

/// What is known of a parameter.
pub struct Known {
    pub name: &'static str,
    pub units: &'static str,
    pub standard_name: &'static str,
    pub long_name: &'static str,
    /// Discipline, category and number (edition 2, code table 4.2); 255 if it has no entry of its own.
    edition2: [u8; 3],
    /// Number in table 2 of edition 1; 0 without.
    wmo: u8,
    /// Table and number of ECMWF in edition 1; 0 without.
    ecmwf: [u8; 2],
}

const fn row([name, units, standard_name, long_name]: [&'static str; 4], edition2: [u8; 3], wmo: u8, ecmwf: [u8; 2]) -> Known {
    Known { name, units, standard_name, long_name, edition2, wmo, ecmwf }
}

/// Velocities, masks of land and a few others. All other parameters are listed by their numbers.
const KNOWN: &[Known] = &[
    row(["u", "m s-1", "eastward_wind", "U component of wind"], [0, 2, 2], 33, [128, 131]),
    row(["v", "m s-1", "northward_wind", "V component of wind"], [0, 2, 3], 34, [128, 132]),
    row(["w", "Pa s-1", "lagrangian_tendency_of_air_pressure", "Vertical velocity"], [0, 2, 8], 39, [128, 135]),
    row(["wz", "m s-1", "upward_air_velocity", "Geometric vertical velocity"], [0, 2, 9], 40, [0, 0]),
    row(["u10", "m s-1", "eastward_wind", "10 metre U wind component"], [255; 3], 0, [128, 165]),
    row(["v10", "m s-1", "northward_wind", "10 metre V wind component"], [255; 3], 0, [128, 166]),
    row(["u100", "m s-1", "eastward_wind", "100 metre U wind component"], [255; 3], 0, [228, 246]),
    row(["v100", "m s-1", "northward_wind", "100 metre V wind component"], [255; 3], 0, [228, 247]),
    row(["uo", "m s-1", "eastward_sea_water_velocity", "U component of current"], [10, 1, 2], 49, [0, 0]),
    row(["vo", "m s-1", "northward_sea_water_velocity", "V component of current"], [10, 1, 3], 50, [0, 0]),
    row(["siu", "m s-1", "eastward_sea_ice_velocity", "U component of ice drift"], [10, 2, 4], 95, [0, 0]),
    row(["siv", "m s-1", "northward_sea_ice_velocity", "V component of ice drift"], [10, 2, 5], 96, [0, 0]),
    row(["lsm", "1", "land_area_fraction", "Land-sea mask"], [2, 0, 0], 81, [128, 172]),
    row(["t", "K", "air_temperature", "Temperature"], [0, 0, 0], 11, [128, 130]),
    row(["q", "kg kg-1", "specific_humidity", "Specific humidity"], [0, 1, 0], 51, [128, 133]),
    row(["z", "m2 s-2", "geopotential", "Geopotential"], [0, 3, 4], 6, [128, 129]),
    row(["gh", "m", "geopotential_height", "Geopotential height"], [0, 3, 5], 7, [128, 156]),
    row(["msl", "Pa", "air_pressure_at_mean_sea_level", "Mean sea level pressure"], [0, 3, 1], 2, [128, 151]),
];

/// ECMWF and the Japan Meteorological Agency (common code table C-1).
const ECMWF: u8 = 98;
const JMA: u8 = 34;

impl Parameter {
    pub fn of_edition2(code: [u8; 3]) -> Self {
        KNOWN.iter().position(|known| known.edition2 == code).map_or(Self::Edition2(code), Self::Known)
    }

    /// By the originating centre, the version of its table and the number there.
    pub fn of_edition1(centre: u8, table: u8, number: u8) -> Self {
        let found = match (centre, table) {
            // Numbers up to 127 are those of the WMO in each version of its table, and in the table of JRA-55.
            (_, 1..=3) | (JMA, 200) if (1..128).contains(&number) => KNOWN.iter().position(|known| known.wmo == number),
            (ECMWF, 128..) => KNOWN.iter().position(|known| known.ecmwf == [table, number]),
            _ => None,
        };
        found.map_or(Self::Edition1([table, number]), Self::Known)
    }

    pub fn known(self) -> Option<&'static Known> {
        match self {
            Self::Known(row) => KNOWN.get(row),
            Self::Edition2(_) | Self::Edition1(_) => None,
        }
    }

    pub fn name(self) -> String {
        match self {
            Self::Known(row) => KNOWN[row].name.into(),
            Self::Edition2([discipline, category, number]) => format!("parameter_{discipline}_{category}_{number}"),
            Self::Edition1([table, number]) => format!("parameter_{table}_{number}"),
        }
    }
}

impl Process {
    /// As part of a name.
    pub fn name(self) -> String {
        match self {
            Self::Statistic(0) => "mean".into(),
            Self::Statistic(1) => "sum".into(),
            Self::Statistic(2) => "maximum".into(),
            Self::Statistic(3) => "minimum".into(),
            Self::Statistic(code) => format!("statistic_{code}"),
            Self::Derived(0 | 1) => "members_mean".into(),
            Self::Derived(code) => format!("members_{code}"),
        }
    }
}

/// Type of the levels of a variable (code table 4.5 of edition 2).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Levels {
    /// 255 for types of edition 1 that have no like in edition 2.
    pub code: u8,
    /// Type of the lower surface of a layer, 255 without; or the type in edition 1.
    pub second: u8,
    /// Whether they have numbers.
    pub valued: bool,
}

/// What is known of a type of level.
pub struct LevelType {
    code: u8,
    name: &'static str,
    pub units: &'static str,
    pub standard_name: &'static str,
    /// `up` or `down`; empty if it is no vertical coordinate.
    pub positive: &'static str,
}

const fn level(code: u8, name: &'static str, [units, standard_name, positive]: [&'static str; 3]) -> LevelType {
    LevelType { code, name, units, standard_name, positive }
}

const LEVEL_TYPES: &[LevelType] = &[
    level(1, "surface", [""; 3]),
    level(6, "maxWind", [""; 3]),
    level(7, "tropopause", [""; 3]),
    level(8, "nominalTop", [""; 3]),
    level(10, "atmosphere", [""; 3]),
    level(100, "isobaricInhPa", ["hPa", "air_pressure", "down"]),
    level(101, "meanSea", [""; 3]),
    level(102, "heightAboveSea", ["m", "altitude", "up"]),
    level(103, "heightAboveGround", ["m", "height", "up"]),
    level(104, "sigma", ["1", "atmosphere_sigma_coordinate", "down"]),
    level(105, "hybrid", ["1", "model_level_number", "down"]),
    level(106, "depthBelowLand", ["m", "depth", "down"]),
    level(107, "theta", ["K", "air_potential_temperature", "up"]),
    level(108, "pressureFromGround", ["Pa", "", "up"]),
    level(109, "potentialVorticity", ["K m2 kg-1 s-1", "", "up"]),
    level(160, "depthBelowSea", ["m", "depth", "down"]),
];

/// The type of isobaric surfaces.
pub const ISOBARIC: u8 = 100;

impl Levels {
    pub fn known(self) -> Option<&'static LevelType> {
        LEVEL_TYPES.iter().find(|known| known.code == self.code)
    }

    pub fn name(self) -> String {
        match self.known() {
            None => format!("levelType{}", if self.code == 255 { self.second } else { self.code }),
            Some(known) if self.second == 255 => known.name.into(),
            Some(known) => format!("{}Layer", known.name),
        }
    }

    /// Whether surfaces of a type have no numbers: of these, some files state one all the same.
    pub fn is_single(code: u8) -> bool {
        matches!(code, 1..=10 | 101)
    }
}
