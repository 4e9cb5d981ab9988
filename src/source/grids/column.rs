//! Levels that follow the bottom or the terrain: each column is interpolated linearly between its own levels to fixed heights.
//!
//! The heights of ocean models' levels are those of the CF conventions, appendix D (ocean sigma and s coordinates). With s from -1 at the
//! bottom to 0 at the surface, C(s) the stretching, h the depth, h_c the critical depth and eta the height of the surface:
//!
//! - `ocean_s_coordinate` (Song & Haidvogel 1994): z = eta (1 + s) + h_c s + (h - h_c) C
//! - `ocean_s_coordinate_g1` (ROMS, `Vtransform` 1): z = S + eta (1 + S / h), S = h_c s + (h - h_c) C
//! - `ocean_s_coordinate_g2` (ROMS, `Vtransform` 2): z = eta + (eta + h) S, S = (h_c s + h C) / (h_c + h)
//! - `ocean_sigma_coordinate`: z = eta + (eta + h) sigma, which is the last one with h_c = 0 and C = sigma

use super::component::{ComponentPlan, Orders, read_component};
use crate::error::SourceError;
use crate::formats::DataFile;

/// How heights follow from s.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Formula {
    S,
    G1,
    G2,
}

impl Formula {
    /// Height above the sea at rest, metres.
    fn height(self, [s, stretching]: [f64; 2], critical: f64, depth: f64, surface: f64) -> f64 {
        let linear = critical * s + (depth - critical) * stretching;
        match self {
            Self::S => surface * (1.0 + s) + linear,
            Self::G1 => linear + surface * (1.0 + linear / depth),
            Self::G2 => surface + (surface + depth) * (critical * s + depth * stretching) / (critical + depth),
        }
    }
}

/// Levels of one component, and the heights that it is interpolated to.
#[derive(Debug, Clone, PartialEq)]
pub struct Columns {
    pub formula: Formula,
    /// s and C(s), from the bottom upwards.
    pub levels: Vec<[f64; 2]>,
    /// Index in the file of each level.
    pub order: Vec<usize>,
    /// h_c, metres.
    pub critical_depth: f64,
    pub depth: ComponentPlan,
    /// Height of the surface; without it 0.
    pub surface: Option<ComponentPlan>,
    /// Heights of the grid, ascending, metres.
    pub heights: Vec<f64>,
}

impl Columns {
    /// Reads a component like [`read_component`], but `orders[2]` are indices of [`Self::heights`]. Below the bottom it is missing. Between the bottom and
    /// the lowest level, and between the highest level and the surface, it is that of the level. The surface is taken to be at height 0 at least,
    /// so that height 0 always is in the water.
    ///
    /// # Errors
    /// The values cannot be read.
    pub fn read(&self, file: &DataFile, component: &ComponentPlan, orders: &Orders, entry: usize) -> Result<Vec<f32>, SourceError> {
        let [x, y, wanted] = orders;
        let values = read_component(file, component, &[x.clone(), y.clone(), self.order.clone()], entry)?;
        let depth = at_points(file, &self.depth, component, orders, entry)?;
        let surface = self.surface.as_ref().map(|plan| at_points(file, plan, component, orders, entry)).transpose()?;
        let plane = x.len() * y.len();
        let mut out = vec![f32::NAN; plane * wanted.len()];
        let mut own = vec![0f32; self.levels.len()];
        for point in 0..plane {
            let (depth, surface) = (depth[point], surface.as_ref().map_or(0.0, |surface| surface[point]));
            for (height, &level) in own.iter_mut().zip(&self.levels) {
                *height = self.formula.height(level, self.critical_depth, depth, surface) as f32;
            }
            let ends = [-depth as f32, surface.max(0.0) as f32];
            // A missing surface makes missing heights.
            if own.iter().any(|height| !height.is_finite()) {
                continue;
            }
            for (level, &k) in wanted.iter().enumerate() {
                let found = in_layer(self.heights[k] as f32, ends, own.len(), |k| own[k], |k| values[k * plane + point]);
                out[level * plane + point] = found.unwrap_or(f32::NAN);
            }
        }
        Ok(out)
    }

    /// Mean heights of the levels over all columns, with the surface at rest, and 0.
    pub fn mean_heights(&self, file: &DataFile) -> Result<Vec<f64>, SourceError> {
        let mut depths = read_component(file, &self.depth, &self.depth.file_order(), 0)?;
        depths.retain(|depth| depth.is_finite() && *depth > 0.0);
        let mean = |level: &[f64; 2]| {
            let heights = depths.iter().map(|&depth| self.formula.height(*level, self.critical_depth, depth.into(), 0.0));
            heights.sum::<f64>() / depths.len() as f64
        };
        let mut heights: Vec<f64> = self.levels.iter().map(mean).filter(|z| *z < 0.0).collect();
        heights.push(0.0);
        heights.dedup();
        Ok(heights)
    }

    /// Greatest depth of the bottom, metres.
    pub fn deepest(&self, file: &DataFile) -> Result<f64, SourceError> {
        let depths = read_component(file, &self.depth, &self.depth.file_order(), 0)?;
        Ok(depths.into_iter().filter(|depth| depth.is_finite()).fold(f64::NEG_INFINITY, |a, b| a.max(b.into())))
    }
}

/// A field of the plane at the points of a component: means of those beside them that are known, if the field has one point more along an axis.
fn at_points(
    file: &DataFile,
    plan: &ComponentPlan,
    component: &ComponentPlan,
    [x, y, _]: &Orders,
    entry: usize,
) -> Result<Vec<f64>, SourceError> {
    let values = read_component(file, plan, &plan.file_order(), entry)?;
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
    fn levels_end_at_the_bottom_and_at_the_surface() {
        for formula in [Formula::S, Formula::G1, Formula::G2] {
            let at = |s: f64| formula.height([s, s], 10.0, 80.0, 0.5);
            assert!((at(0.0) - 0.5).abs() < 1e-12 && (at(-1.0) + 80.0).abs() < 1e-12, "{formula:?}");
        }
    }
}
