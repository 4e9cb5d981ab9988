//! Finding the velocity: by `standard_name`, then by usual names, then by `long_name`; always with a fitting unit.

use super::units::Unit;
use crate::formats::{Listing, UNREADABLE, Variable};

/// The rule that chooses among several candidates.
pub const RULE: &str = "standard names go before usual names before long names, then pairs of one naming family, then more \
                                          dimensions, then common dimensions, then the order of the list of names, then the order in the file";

/// A velocity component.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Component {
    U,
    V,
    W,
}

impl Component {
    pub fn name(self) -> &'static str {
        ["u", "v", "w"][self as usize]
    }
}

/// Eastward, northward and upward standard names of one family, most usual first.
const STANDARD_NAMES: [[&str; 3]; 14] = [
    ["eastward_wind", "northward_wind", "upward_air_velocity"],
    ["x_wind", "y_wind", "lagrangian_tendency_of_air_pressure"],
    ["grid_eastward_wind", "grid_northward_wind", ""],
    ["eastward_sea_water_velocity", "northward_sea_water_velocity", "upward_sea_water_velocity"],
    ["sea_water_x_velocity", "sea_water_y_velocity", ""],
    ["surface_eastward_sea_water_velocity", "surface_northward_sea_water_velocity", ""],
    ["surface_geostrophic_eastward_sea_water_velocity", "surface_geostrophic_northward_sea_water_velocity", ""],
    ["geostrophic_eastward_sea_water_velocity", "geostrophic_northward_sea_water_velocity", ""],
    [
        "surface_geostrophic_eastward_sea_water_velocity_assuming_sea_level_for_geoid",
        "surface_geostrophic_northward_sea_water_velocity_assuming_sea_level_for_geoid",
        "",
    ],
    ["surface_geostrophic_sea_water_x_velocity", "surface_geostrophic_sea_water_y_velocity", ""],
    ["barotropic_eastward_sea_water_velocity", "barotropic_northward_sea_water_velocity", ""],
    ["geostrophic_eastward_wind", "geostrophic_northward_wind", ""],
    ["eastward_sea_ice_velocity", "northward_sea_ice_velocity", ""],
    ["sea_ice_x_velocity", "sea_ice_y_velocity", ""],
];

/// Usual names of one family, compared without regard to case.
const USUAL_NAMES: [[&str; 3]; 29] = [
    ["u", "v", "w"],
    ["uo", "vo", "wo"],
    ["ua", "va", "wa"],
    ["water_u", "water_v", "water_w"],
    ["eastward_eulerian_current_velocity", "northward_eulerian_current_velocity", ""],
    ["vozocrtx", "vomecrty", "vovecrtz"],
    ["uvel", "vvel", "wvel"],
    ["u_velocity", "v_velocity", "w_velocity"],
    ["velocity_x", "velocity_y", "velocity_z"],
    ["x_velocity", "y_velocity", "z_velocity"],
    ["vx", "vy", "vz"],
    ["ux", "uy", "uz"],
    ["uwnd", "vwnd", "wwnd"],
    ["uwind", "vwind", "wwind"],
    ["zonal_velocity", "meridional_velocity", "vertical_velocity"],
    ["u-component_of_wind_isobaric", "v-component_of_wind_isobaric", "vertical_velocity_pressure_isobaric"],
    ["u_component_of_wind", "v_component_of_wind", "omega"],
    ["ugos", "vgos", ""],
    ["ugosa", "vgosa", ""],
    ["ucur", "vcur", "wcur"],
    ["ssu", "ssv", ""],
    ["unod", "vnod", ""],
    ["horizontalvelx", "horizontalvely", ""],
    ["ureconstructzonal", "ureconstructmeridional", ""],
    ["uas", "vas", ""],
    ["us", "vs", ""],
    ["u10", "v10", ""],
    ["10u", "10v", ""],
    ["u100", "v100", ""],
];

/// Further names of vertical velocities, of any family.
const VERTICAL_NAMES: [&str; 6] = ["lagrangian_tendency_of_air_pressure", "omega", "wap", "vertical_velocity", "ww", "wt"];

/// A variable that may be a component.
#[derive(Debug, Clone)]
pub struct Candidate {
    pub variable: usize,
    pub component: Component,
    tier: usize,
    family: usize,
    /// Why it is a candidate.
    pub why: String,
}

/// The chosen components.
#[derive(Debug, Clone)]
pub struct Velocity {
    pub u: Candidate,
    pub v: Candidate,
    pub w: Option<Candidate>,
    /// Candidates that were passed over.
    pub others: Vec<Candidate>,
}

/// Judges whether a variable may be a component. `stated` are units of u, v and w that outweigh those of the file.
///
/// # Errors
/// It may not; the error says what it lacks.
pub fn judge(listing: &Listing, index: usize, stated: [Option<&str>; 3]) -> Result<Candidate, String> {
    let variable = &listing.variables[index];
    if !variable.number.is_number() {
        return Err(variable.text(UNREADABLE).unwrap_or("holds no numbers").into());
    }
    if variable.dimensions.len() < 2 {
        return Err(format!("has {} dimension(s); a velocity has two or more", variable.dimensions.len()));
    }
    let named = by_standard_name(variable).or_else(|| by_name(variable)).or_else(|| by_long_name(variable));
    let unit = named.as_ref().and_then(|(component, ..)| stated[*component as usize]).or(variable.units());
    let parsed = unit.map(Unit::parse);
    // A standard name is a promise: an unknown unit is reported where the unit is needed.
    let fits = match (&named, parsed) {
        (_, None) => true,
        (Some((_, 0, ..)), Some(None)) => true,
        (_, Some(None)) => false,
        (Some((Component::W, ..)), Some(Some(u))) => u.is_velocity() || u.is_pressure_tendency() || u.is_dimensionless(),
        (_, Some(Some(u))) => u.is_velocity() || (u.is_dimensionless() && named.is_some()),
    };
    match named {
        Some((component, tier, family, why)) if fits => {
            let unit = unit.map_or_else(|| "no unit, taken as SI".into(), |u| format!("unit `{u}`"));
            Ok(Candidate { variable: index, component, tier, family, why: format!("{why}, {unit}") })
        }
        Some((component, .., why)) => Err(format!(
            "{why}, but its unit `{}` is no velocity; if it is one, state it with --set archive.units.{}=\"m s-1\"",
            unit.unwrap_or_default(),
            component.name()
        )),
        None if unit.is_none() => Err("neither unit, standard_name nor name is that of a velocity component".into()),
        None if fits => {
            Err(format!("unit `{}`, but neither standard_name, name nor long_name says which component", unit.unwrap_or_default()))
        }
        None => Err(format!("unit `{}` is no velocity", unit.unwrap_or_default())),
    }
}

/// The component that a name of the variable says, whatever its unit.
pub fn named(variable: &Variable) -> Option<Component> {
    by_standard_name(variable).or_else(|| by_name(variable)).or_else(|| by_long_name(variable)).map(|(component, ..)| component)
}

/// The reason for which a name says that a component runs east; `None` if none does.
pub fn says_eastward(u: &Variable) -> Option<String> {
    let standard = u.text("standard_name").unwrap_or_default();
    let long = u.text("long_name").unwrap_or_default().to_ascii_lowercase();
    // `grid_eastward_wind` runs along the grid.
    let says = |text: &str| (text.contains("eastward") || text.contains("zonal")) && !text.starts_with("grid");
    match () {
        () if says(standard) => Some(format!("standard_name `{standard}`")),
        () if standard.is_empty() && says(&long) => Some(format!("long_name `{long}`")),
        () => None,
    }
}

type Named = (Component, usize, usize, String);

fn by_standard_name(variable: &Variable) -> Option<Named> {
    let name = variable.text("standard_name")?;
    let found =
        look_up(&STANDARD_NAMES, name).or_else(|| VERTICAL_NAMES[..1].contains(&name).then_some((Component::W, STANDARD_NAMES.len())));
    found.map(|(component, family)| (component, 0, family, format!("standard_name `{name}`")))
}

fn by_name(variable: &Variable) -> Option<Named> {
    let name = variable.name.to_ascii_lowercase();
    let directed = || match () {
        () if name.starts_with("eastward_") => Some((Component::U, USUAL_NAMES.len())),
        () if name.starts_with("northward_") => Some((Component::V, USUAL_NAMES.len())),
        () if name.starts_with("upward_") || VERTICAL_NAMES.contains(&name.as_str()) => Some((Component::W, USUAL_NAMES.len())),
        () => None,
    };
    // A standard name of another quantity outweighs the name.
    if variable.text("standard_name").is_some_and(|s| !s.is_empty() && !s.contains("velocity") && !s.contains("wind")) {
        return None;
    }
    let (component, family) = look_up(&USUAL_NAMES, &name).or_else(directed)?;
    Some((component, 1, family, format!("usual name `{}`", variable.name)))
}

fn by_long_name(variable: &Variable) -> Option<Named> {
    // Without a unit, a long name is too weak a sign.
    variable.units()?;
    let long = variable.text("long_name").or_else(|| variable.text("description"))?.to_ascii_lowercase();
    let says = |words: &[&str]| words.iter().any(|w| long.contains(w));
    let component = if says(&["eastward", "zonal", "u component", "u-component", "x-wind component", "x component"]) {
        Component::U
    } else if says(&["northward", "meridional", "v component", "v-component", "y-wind component", "y component"]) {
        Component::V
    } else if says(&["upward velocity", "vertical velocity", "w component", "w-component", "z-wind component"]) {
        Component::W
    } else {
        return None;
    };
    Some((component, 2, 0, format!("long_name `{long}`")))
}

fn look_up<const N: usize>(table: &[[&str; 3]; N], name: &str) -> Option<(Component, usize)> {
    table.iter().enumerate().find_map(|(family, names)| {
        let k = names.iter().position(|n| !n.is_empty() && *n == name)?;
        Some(([Component::U, Component::V, Component::W][k], family))
    })
}

/// Chooses the components. `fixed` are variables that the settings name; `ignore_w` leaves out the vertical component; `stated` as for
/// [`judge`].
///
/// # Errors
/// A horizontal component is lacking; the error says which.
pub fn choose(listing: &Listing, fixed: [Option<usize>; 3], ignore_w: bool, stated: [Option<&str>; 3]) -> Result<Velocity, String> {
    let judged: Vec<Candidate> = (0..listing.variables.len()).filter_map(|i| judge(listing, i, stated).ok()).collect();
    let of = |component: Component| -> Vec<Candidate> {
        match fixed[component as usize] {
            Some(variable) => {
                let why = format!("named by the setting `{}`", component.name());
                vec![Candidate { variable, component, tier: 0, family: usize::MAX, why }]
            }
            None => judged.iter().filter(|c| c.component == component && !fixed.contains(&Some(c.variable))).cloned().collect(),
        }
    };
    let (us, vs) = (of(Component::U), of(Component::V));
    let lacking = [(us.is_empty(), "no eastward or x component"), (vs.is_empty(), "no northward or y component")];
    let lacking: Vec<&str> = lacking.into_iter().filter(|(lacks, _)| *lacks).map(|(_, what)| what).collect();
    let extent = |c: &Candidate| listing.shape(&listing.variables[c.variable]).iter().filter(|&&n| n > 1).count();
    let foreign =
        |a: &Candidate, b: &Candidate| a.family != usize::MAX && b.family != usize::MAX && (a.tier, a.family) != (b.tier, b.family);
    let key = |u: &Candidate, v: &Candidate| {
        let dims = extent(u).min(extent(v));
        let apart = !same_dimensions(listing, u.variable, v.variable);
        (u.tier.max(v.tier), foreign(u, v), usize::MAX - dims, apart, u.family.min(v.family), u.variable, v.variable)
    };
    let pairs = us.iter().flat_map(|u| vs.iter().map(move |v| (u, v)));
    let (u, v) = pairs.min_by_key(|(u, v)| key(u, v)).ok_or_else(|| lacking.join(" and "))?;
    let wide = extent(u);
    let w = if ignore_w {
        None
    } else {
        let apart = |w: &Candidate| !same_dimensions(listing, u.variable, w.variable);
        // A vertical velocity of fewer dimensions belongs to something else.
        let candidates = of(Component::W).into_iter().filter(|w| w.family == usize::MAX || extent(w) == wide);
        candidates.min_by_key(|w| (apart(w), w.tier, foreign(u, w), w.family, w.variable))
    };
    let chosen = [Some(u.variable), Some(v.variable), w.as_ref().map(|w| w.variable)];
    let others = judged.iter().filter(|c| !chosen.contains(&Some(c.variable))).cloned().collect();
    Ok(Velocity { u: u.clone(), v: v.clone(), w, others })
}

/// True if two variables lie on the same points. The order of the dimensions and dimensions of one entry do not count.
pub fn same_dimensions(listing: &Listing, a: usize, b: usize) -> bool {
    let wide = |i: usize| {
        let mut dims: Vec<usize> = listing.variables[i].dimensions.iter().copied().filter(|&d| listing.dimensions[d].len > 1).collect();
        dims.sort_unstable();
        dims
    };
    wide(a) == wide(b)
}
