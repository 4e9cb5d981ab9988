//! Levels that follow the bottom or the terrain: each column is interpolated linearly between its own levels to fixed heights.
//!
//! The heights of ocean models' levels are those of the CF conventions, appendix D (ocean sigma and s coordinates). With s from -1 at the
//! bottom to 0 at the surface, C(s) the stretching, h the depth, h_c the critical depth and eta the height of the surface:
//!
//! - `ocean_s_coordinate` (Song & Haidvogel 1994): z = eta (1 + s) + h_c s + (h - h_c) C
//! - `ocean_s_coordinate_g1` (ROMS, `Vtransform` 1): z = S + eta (1 + S / h), S = h_c s + (h - h_c) C
//! - `ocean_s_coordinate_g2` (ROMS, `Vtransform` 2): z = eta + (eta + h) S, S = (h_c s + h C) / (h_c + h)
//! - `ocean_sigma_coordinate`: z = eta + (eta + h) sigma, which is the last one with h_c = 0 and C = sigma
//!
//! Those of the atmosphere (`atmosphere_hybrid_sigma_pressure_coordinate`, `atmosphere_sigma_coordinate`) have the pressure p = a + b p_s, with the
//! pressure p_s at the ground, whose height is that of the isothermal atmosphere (see [`super::levels`]).
//!
//! Other files hold the heights themselves, a number for each point of each level: layers that follow the density, or the last cells above an
//! uneven bottom.

use super::component::{ComponentPlan, Orders, SquaredErrors, read_component};
use super::levels::{REFERENCE_PRESSURE, height_of, pressure_at, upward};
use super::refine::ResamplingError;
use crate::error::SourceError;
use crate::formats::DataFile;

/// Lowest pressure that has a height (113 km), Pa.
const TOP: f64 = 0.01;

/// How heights follow from the two numbers of a level: s and C(s), or a (Pa) and b.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Formula {
    S,
    G1,
    G2,
    Hybrid,
}

impl Formula {
    /// Height above the sea at rest, metres. The ground is its depth below the sea, metres, or its pressure, Pa.
    fn height(self, [s, stretching]: [f64; 2], critical: f64, ground: f64, surface: f64) -> f64 {
        let linear = critical * s + (ground - critical) * stretching;
        match self {
            Self::S => surface * (1.0 + s) + linear,
            Self::G1 => linear + surface * (1.0 + linear / ground),
            Self::G2 => surface + (surface + ground) * (critical * s + ground * stretching) / (critical + ground),
            Self::Hybrid => {
                let pressure = s + stretching * ground;
                // Half levels end at a pressure of 0.
                height_of(if pressure < TOP { TOP } else { pressure })
            }
        }
    }

    /// Lower and upper end of a column. The atmosphere has none above.
    fn ends(self, ground: f64, surface: f64) -> [f64; 2] {
        match self {
            Self::S | Self::G1 | Self::G2 => [-ground, surface.max(0.0)],
            Self::Hybrid => [height_of(ground), f64::INFINITY],
        }
    }

    /// Numbers that ascend with the height of the levels.
    pub fn rank(self, [s, stretching]: [f64; 2]) -> f64 {
        match self {
            Self::S | Self::G1 | Self::G2 => s,
            Self::Hybrid => -(s + stretching * REFERENCE_PRESSURE),
        }
    }

    pub fn is_of_air(self) -> bool {
        self == Self::Hybrid
    }
}

/// Most columns, about, on which the error of interpolation is measured.
const MEASURED_COLUMNS: usize = 1 << 16;

/// Where the levels of a column lie.
#[derive(Debug, Clone, PartialEq)]
pub enum Places {
    /// By a formula of the conventions.
    Formula {
        formula: Formula,
        /// The numbers of each level, from the bottom upwards.
        levels: Vec<[f64; 2]>,
        /// h_c, metres.
        critical_depth: f64,
        /// Depth of the sea, metres, or pressure at the ground, Pa.
        ground: Box<ComponentPlan>,
        /// Height of the surface; without it 0.
        surface: Option<Box<ComponentPlan>>,
    },
    /// By a field of their heights (x, y, levels), metres, or pressures, Pa.
    Field {
        heights: Box<ComponentPlan>,
        is_pressure: bool,
        /// True if they lie above the sea.
        is_of_air: bool,
    },
}

/// Levels of one component, and the heights that it is interpolated to.
#[derive(Debug, Clone, PartialEq)]
pub struct Columns {
    pub places: Places,
    /// Index in the file of each level, from the bottom upwards.
    pub order: Vec<usize>,
    /// True if the component is the change of a particle's pressure, Pa/s, which is read as a vertical velocity.
    pub is_tendency: bool,
    /// Heights of the grid, ascending, metres.
    pub heights: Vec<f64>,
}

impl Columns {
    pub fn is_of_air(&self) -> bool {
        match &self.places {
            Places::Formula { formula, .. } => formula.is_of_air(),
            Places::Field { is_of_air, .. } => *is_of_air,
        }
    }

    /// The variable that tells where the levels lie: their heights, or the depth or pressure at the ground.
    pub fn teller(&self) -> &str {
        match &self.places {
            Places::Formula { ground, .. } => &ground.name,
            Places::Field { heights, .. } => &heights.name,
        }
    }

    /// Reads a component like [`read_component`], but `orders[2]` are indices of [`Self::heights`]. Below the bottom it is missing. Between the bottom and
    /// the lowest level, and between the highest level and the surface, it is that of the level. The surface is taken to be at height 0 at least,
    /// so that height 0 always is in the water. A field of heights tells no bottom: below the lowest level it is missing.
    ///
    /// # Errors
    /// The values cannot be read.
    pub fn read(&self, file: &DataFile, component: &ComponentPlan, orders: &Orders, entry: usize) -> Result<Vec<f32>, SourceError> {
        let [x, y, wanted] = orders;
        let values = read_component(file, component, &[x.clone(), y.clone(), self.order.clone()], entry)?;
        let (heights, ends) = self.columns_at(file, component, orders, entry)?;
        let plane = x.len() * y.len();
        let mut out = vec![f32::NAN; plane * wanted.len()];
        let mut known = Vec::with_capacity(self.order.len());
        for point in 0..plane {
            let height = |k: usize| heights[k * plane + point];
            if !self.known_levels(&mut known, height) {
                continue;
            }
            let value = |k: usize| {
                let value = values[known[k] * plane + point];
                if self.is_tendency { upward(value.into(), pressure_at(height(known[k]).into())) as f32 } else { value }
            };
            for (level, &k) in wanted.iter().enumerate() {
                let found = in_layer(self.heights[k] as f32, ends[point], known.len(), |k| height(known[k]), value);
                out[level * plane + point] = found.unwrap_or(f32::NAN);
            }
        }
        Ok(out)
    }

    /// Finds the levels of a column that have heights, ascending. False if nothing is known there.
    fn known_levels(&self, known: &mut Vec<usize>, height: impl Fn(usize) -> f32) -> bool {
        let is_field = matches!(self.places, Places::Field { .. });
        known.clear();
        let mut descends = false;
        for k in (0..self.order.len()).filter(|&k| height(k).is_finite()) {
            match known.last() {
                Some(&below) if is_field && height(k) < height(below) => descends = true,
                // Of layers that vanish the last one lies beside the next that does not.
                Some(&below) if is_field && height(k) == height(below) => {
                    known.pop();
                    known.push(k);
                }
                _ => known.push(k),
            }
        }
        // What was never computed may be filled with one number.
        !known.is_empty() && !(is_field && (descends || known.len() == 1))
    }

    /// Error of interpolation between the heights of the grid, at the levels of components of the first time, and the share of their values that lie below or
    /// above the heights, or beside one where nothing is known; `None` if none could be compared. In archives of many columns, some rows of them are read.
    ///
    /// # Errors
    /// The values cannot be read.
    pub fn error(file: &DataFile, components: &[ComponentPlan]) -> Result<(Option<ResamplingError>, f64), SourceError> {
        let (mut sums, mut outside, mut all) = (SquaredErrors::default(), 0u64, 0u64);
        for component in components {
            let Some(columns) = &component.columns else { continue };
            let [x, y, _] = component.file_order();
            let each = (x.len() * y.len()).div_ceil(MEASURED_COLUMNS).min(y.len()).max(1);
            let y: Vec<usize> = y.into_iter().skip(each / 2).step_by(each).collect();
            let plane = x.len() * y.len();
            let orders = [x, y, (0..columns.heights.len()).collect()];
            let on_grid = columns.read(file, component, &orders, 0)?;
            let (heights, _) = columns.columns_at(file, component, &orders, 0)?;
            let [x, y, _] = orders;
            let values = read_component(file, component, &[x, y, columns.order.clone()], 0)?;
            for (i, &value) in values.iter().enumerate().filter(|(i, value)| value.is_finite() && heights[*i].is_finite()) {
                let at = |k: usize| on_grid[k * plane + i % plane];
                let found =
                    in_column(heights[i], columns.heights.len(), |k| columns.heights[k] as f32, at).filter(|found| found.is_finite());
                all += 1;
                match found {
                    Some(found) => sums.add(found.into(), value.into()),
                    None => outside += 1,
                }
            }
        }
        let error = (outside < all).then(|| ResamplingError::at_points(sums.root_mean_squares()));
        Ok((error, outside as f64 / all.max(1) as f64))
    }

    /// Heights of all levels over the points of a component, and the lower and upper end of each column, metres.
    fn columns_at(
        &self,
        file: &DataFile,
        component: &ComponentPlan,
        orders: &Orders,
        entry: usize,
    ) -> Result<(Vec<f32>, Vec<[f32; 2]>), SourceError> {
        match &self.places {
            Places::Formula { formula, levels, critical_depth, ground, surface } => {
                let ground = at_points(file, ground, 0, component, orders, entry)?;
                let surface = surface.as_ref().map(|plan| at_points(file, plan, 0, component, orders, entry)).transpose()?;
                let surface = surface.unwrap_or_else(|| vec![0.0; ground.len()]);
                let columns = || ground.iter().zip(&surface);
                let height = |level: &[f64; 2], (&ground, &surface)| formula.height(*level, *critical_depth, ground, surface) as f32;
                let heights = levels.iter().flat_map(|level| columns().map(move |column| height(level, column))).collect();
                Ok((heights, columns().map(|(&ground, &surface)| formula.ends(ground, surface).map(|end| end as f32)).collect()))
            }
            Places::Field { heights, is_pressure, is_of_air } => {
                let plane = orders[0].len() * orders[1].len();
                let mut found = Vec::with_capacity(plane * self.order.len());
                for &level in &self.order {
                    let values = at_points(file, heights, level, component, orders, entry)?;
                    found.extend(values.into_iter().map(|value| if *is_pressure { height_of(value) } else { value } as f32));
                }
                let ends = |point: usize| {
                    let mut known = found[point..].iter().step_by(plane).copied().filter(|height| height.is_finite());
                    let lowest = known.next().unwrap_or(f32::INFINITY);
                    let [below, highest] =
                        known.fold([lowest; 2], |[below, highest], z| if z > highest { [highest, z] } else { [below, highest] });
                    [lowest, if *is_of_air { f32::NEG_INFINITY } else { surface_above(below.into(), highest.into()) as f32 }]
                };
                let ends = (0..plane).map(ends).collect();
                Ok((found, ends))
            }
        }
    }

    /// Mean heights of the levels over all columns at the first time; in the sea with the surface at rest, and 0.
    pub fn mean_heights(&self, file: &DataFile) -> Result<Vec<f64>, SourceError> {
        let mean = |heights: &mut dyn Iterator<Item = f64>| {
            let (sum, count) = heights.filter(|z| z.is_finite()).fold((0.0, 0u32), |(sum, count), z| (sum + z, count + 1));
            sum / f64::from(count)
        };
        let mut heights: Vec<f64> = match &self.places {
            Places::Formula { formula, levels, critical_depth, ground, .. } => {
                let mut grounds = read_component(file, ground, &ground.file_order(), 0)?;
                grounds.retain(|ground| ground.is_finite() && *ground > 0.0);
                let of_level =
                    |level: &[f64; 2]| mean(&mut grounds.iter().map(|&g| formula.height(*level, *critical_depth, g.into(), 0.0)));
                levels.iter().map(of_level).collect()
            }
            Places::Field { heights, is_pressure, .. } => {
                let of_level = |&level: &usize| Ok(mean(&mut heights_of(read_level(file, heights, level, 0)?, *is_pressure)));
                self.order.iter().map(of_level).collect::<Result<_, SourceError>>()?
            }
        };
        heights.retain(|z| z.is_finite());
        // Means over different columns need not ascend.
        heights.sort_by(f64::total_cmp);
        if !self.is_of_air() {
            heights.retain(|z| *z < 0.0);
            let reaches = match (&self.places, &heights[..]) {
                (Places::Field { .. }, [.., below, highest]) => surface_above(*below, *highest) == 0.0,
                _ => true,
            };
            heights.extend(reaches.then_some(0.0));
        }
        heights.dedup();
        Ok(heights)
    }

    /// Heights of the lowest ground and of the surface at rest or, in the atmosphere, of the highest level, metres.
    pub fn reach(&self, file: &DataFile) -> Result<[f64; 2], SourceError> {
        match &self.places {
            Places::Formula { formula, levels, critical_depth, ground, .. } => {
                let grounds = read_component(file, ground, &ground.file_order(), 0)?;
                // Deep, or of high pressure.
                let lowest = grounds.into_iter().filter(|ground| ground.is_finite()).fold(f64::NEG_INFINITY, |a, b| a.max(b.into()));
                let [bottom, surface] = formula.ends(lowest, 0.0);
                let highest = levels.last().map_or(0.0, |&level| formula.height(level, *critical_depth, lowest, 0.0));
                Ok([bottom, if formula.is_of_air() { highest } else { surface }])
            }
            Places::Field { heights, is_pressure, is_of_air } => {
                let [mut low, mut high] = [f64::INFINITY, f64::NEG_INFINITY];
                for &level in &self.order {
                    let known = heights_of(read_level(file, heights, level, 0)?, *is_pressure).filter(|z| z.is_finite());
                    [low, high] = known.fold([low, high], |[low, high], z| [low.min(z), high.max(z)]);
                }
                Ok([low, if *is_of_air { high } else { high.max(0.0) }])
            }
        }
    }
}

/// Upper end of a column of the sea whose highest levels these are: the surface, 0, if no level is missing between them, so far as their distance tells.
fn surface_above(below: f64, highest: f64) -> f64 {
    if highest + (highest - below) >= 0.0 { highest.max(0.0) } else { highest }
}

/// All points of one level of a field at an entry along time. Level by level, a field of any size takes the memory of a plane.
pub fn read_level(file: &DataFile, plan: &ComponentPlan, level: usize, entry: usize) -> Result<Vec<f32>, SourceError> {
    let [x, y, _] = plan.file_order();
    read_component(file, plan, &[x, y, vec![level]], entry)
}

/// Heights, or those of pressures, metres.
fn heights_of(values: Vec<f32>, is_pressure: bool) -> impl Iterator<Item = f64> {
    values.into_iter().map(move |value| if is_pressure { height_of(value.into()) } else { value.into() })
}

/// A level of a field at the points of a component: means of those beside them that are known, if the field has one point more along an axis.
fn at_points(
    file: &DataFile,
    plan: &ComponentPlan,
    level: usize,
    component: &ComponentPlan,
    [x, y, _]: &Orders,
    entry: usize,
) -> Result<Vec<f64>, SourceError> {
    let values = read_level(file, plan, level, entry)?;
    let width = plan.along(0);
    let reach = [0, 1].map(|k| usize::from(plan.along(k) > component.along(k)));
    let mut out = Vec::with_capacity(x.len() * y.len());
    for &j in y {
        for &i in x {
            let beside = (j..=j + reach[1]).flat_map(|j| (i..=i + reach[0]).map(move |i| (j, i)));
            let known = beside.map(|(j, i)| f64::from(values[j * width + i])).filter(|v| v.is_finite());
            let (sum, count) = known.fold((0.0, 0u32), |(sum, count), v| (sum + v, count + 1));
            // None known: 0 / 0 is missing.
            out.push(sum / f64::from(count));
        }
    }
    Ok(out)
}

/// Linear interpolation in a column whose level `k` is at `height(k)`, ascending. `None` outside.
pub fn in_column(z: f32, count: usize, height: impl Fn(usize) -> f32, value: impl Fn(usize) -> f32) -> Option<f32> {
    if !(z >= height(0) && z <= height(count - 1)) {
        return None;
    }
    let (mut low, mut high) = (0, count - 1);
    while high - low > 1 {
        let middle = (low + high) / 2;
        if height(middle) <= z { low = middle } else { high = middle }
    }
    let weight = (z - height(low)) / (height(high) - height(low));
    Some(value(low) * (1.0 - weight) + value(high) * weight)
}

/// The same, but constant between the lowest level and the lower end of the column, and between the highest level and its upper end.
pub fn in_layer(z: f32, [bottom, top]: [f32; 2], count: usize, height: impl Fn(usize) -> f32, value: impl Fn(usize) -> f32) -> Option<f32> {
    match () {
        () if z < bottom => None,
        () if z < height(0) => Some(value(0)),
        () if z > height(count - 1) && z <= top => Some(value(count - 1)),
        () => in_column(z, count, height, value),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_end_where_their_levels_do() {
        let heights = [0.0f32, 10.0, 40.0];
        let at = |z: f32| in_column(z, 3, |k| heights[k], |k| heights[k] * 2.0);
        assert_eq!((at(5.0), at(25.0), at(40.0)), (Some(10.0), Some(50.0), Some(80.0)));
        assert_eq!((at(-0.1), at(40.1), at(f32::NAN)), (None, None, None));
        let wide = |z: f32| in_layer(z, [-1.0, 42.0], 3, |k| heights[k], |k| heights[k] * 2.0);
        assert_eq!((wide(-1.0), wide(25.0), wide(42.0)), (Some(0.0), Some(50.0), Some(80.0)));
        assert_eq!((wide(-1.1), wide(42.1)), (None, None));
    }

    #[test]
    fn hybrid_levels_lie_between_the_ground_and_the_top() {
        let at = |level: [f64; 2], ground: f64| Formula::Hybrid.height(level, 0.0, ground, 0.0);
        assert_eq!(at([0.0, 1.0], 90_000.0), Formula::Hybrid.ends(90_000.0, 0.0)[0]);
        assert!((at([50_000.0, 0.0], 1.0) - 7000.0 * 2f64.ln()).abs() < 1e-9);
        assert!((pressure_at(at([20_000.0, 0.5], 80_000.0)) - 60_000.0).abs() < 1e-6);
        assert!(Formula::Hybrid.rank([10_000.0, 0.1]) > Formula::Hybrid.rank([0.0, 1.0]));
    }

    #[test]
    fn levels_end_at_the_bottom_and_at_the_surface() {
        for formula in [Formula::S, Formula::G1, Formula::G2] {
            let at = |s: f64| formula.height([s, s], 10.0, 80.0, 0.5);
            assert!((at(0.0) - 0.5).abs() < 1e-12 && (at(-1.0) + 80.0).abs() < 1e-12, "{formula:?}");
        }
    }
}
