//! `size = "auto"`: search for the size of table and network, based on the measured error.
//!
//! The search starts small. The size grows while the optical residual over the whole domain (which ignores errors that the transfer function hides)
//! exceeds the tolerance and the last growth reduced it. It returns to the previous size otherwise, and shrinks if the residual is far below the
//! tolerance. Rejected sizes are remembered, so that the search ends.

use super::network::{Encoding, NetworkSettings};
use super::{Kind, MAX_OWN_NODES, SurrogateError, SurrogateSettings};
use ridgewatch_field::Domain;

/// Frames before a size is judged, since new weights need some training first.
const FRAMES_TO_JUDGE: u32 = 4;
/// Maximum ratio of the residuals after and before a growth for the growth to be kept.
const STILL_FALLS: f64 = 0.9;
/// Share of the tolerance below which a smaller size is tried.
const FAR_BELOW: f64 = 0.25;
/// Largest size. Each size has twice the bytes of the previous one.
const LARGEST: u32 = 12;
/// Size at which a table has as many nodes as with `size = "fixed"`.
const PLAIN: u32 = 2;
/// Base-2 logarithm of the entries per level of the smallest hash grid.
const SMALLEST_LOG2_TABLE: u32 = 12;
/// Width of the smallest network.
const SMALLEST_WIDTH: usize = 16;

/// Search for the size.
#[derive(Debug, Clone)]
pub struct Sizing {
    /// Nodes of a table of fixed size, and the number of axes along which they vary.
    nodes: [usize; 3],
    axes: usize,
    size: u32,
    /// Sizes outside this range were rejected: too small, or not worth their cost.
    least: u32,
    most: u32,
    /// Residual before the last growth, until the growth is judged.
    before_growth: Option<f64>,
    frames: u32,
    /// Sum of the mean squares of the judged frames.
    squares: f64,
    counted: u32,
}

/// A change of size, with its reason.
#[derive(Debug, Clone, PartialEq)]
pub struct Resize {
    /// The new size, from 0; each step doubles the bytes until the scene's own bounds are reached.
    pub size: u32,
    /// Reason for the record.
    pub why: String,
}

impl Sizing {
    /// Starts with the smallest size. The settings give the largest one.
    ///
    /// # Errors
    /// The table nodes are not accepted.
    pub fn new(settings: &SurrogateSettings, network: &NetworkSettings, domain: &Domain) -> Result<Self, SurrogateError> {
        let (nodes, axes) = (settings.nodes(domain)?, domain.dimensions);
        let matters = |size: u32| {
            let (table, network) = at_size(settings, network, nodes, axes, size);
            match settings.kind {
                Kind::Table => (table.table_nodes, 0, 0),
                Kind::Network => (None, network.width, network.log2_table()),
                Kind::Residual => (table.table_nodes, network.width, network.log2_table()),
            }
        };
        // Larger sizes do not differ beyond the scene's bounds.
        let most = (0..LARGEST).rev().find(|&size| matters(size) != matters(size + 1)).map_or(0, |size| size + 1);
        Ok(Self { nodes, axes, ..Self::up_to(most) })
    }

    fn up_to(most: u32) -> Self {
        Self { nodes: [2; 3], axes: 3, size: 0, least: 0, most, before_growth: None, frames: 0, squares: 0.0, counted: 0 }
    }

    /// Settings at the present size.
    pub fn settings(&self, settings: &SurrogateSettings, network: &NetworkSettings) -> (SurrogateSettings, NetworkSettings) {
        at_size(settings, network, self.nodes, self.axes, self.size)
    }

    /// Adds a frame's root mean square optical residual over the whole domain. Returns the new size if it should change.
    pub fn observe(&mut self, residual: f64, tolerance: f64) -> Option<Resize> {
        self.frames += 1;
        // The network is still learning in the first half of the frames.
        if self.frames > FRAMES_TO_JUDGE / 2 && residual.is_finite() {
            self.squares += residual * residual;
            self.counted += 1;
        }
        if self.frames < FRAMES_TO_JUDGE || self.counted == 0 {
            return None;
        }
        let residual = (self.squares / f64::from(self.counted)).sqrt();
        (self.frames, self.squares, self.counted) = (0, 0.0, 0);
        let before = self.before_growth.take();
        let state = format!("error of the colours (optical residual) {residual:.4}, tolerance {tolerance:.4}");
        if residual > tolerance {
            if let Some(before) = before.filter(|before| residual > STILL_FALLS * before) {
                self.most = self.size - 1;
                return Some(self.change_to(self.size - 1, format!("{state}: growth hardly reduced it from {before:.4}, so back to")));
            }
            self.least = self.least.max((self.size + 1).min(self.most));
            if self.size < self.most {
                self.before_growth = Some(residual);
                return Some(self.change_to(self.size + 1, format!("{state}, and still falling: grow to")));
            }
        } else if residual < FAR_BELOW * tolerance && self.size > self.least {
            return Some(self.change_to(self.size - 1, format!("{state}, far below: shrink to")));
        }
        None
    }

    fn change_to(&mut self, size: u32, why: String) -> Resize {
        self.size = size;
        Resize { size, why: format!("{why} size {size}") }
    }
}

/// Settings at a size. A table starts with a quarter of the nodes that are set (or of the data's) and has twice as many at every further size,
/// up to those set or 2^21, whichever is more. The network starts small and ends at the scene's size.
fn at_size(
    settings: &SurrogateSettings,
    network: &NetworkSettings,
    nodes: [usize; 3],
    dimensions: usize,
    size: u32,
) -> (SurrogateSettings, NetworkSettings) {
    let axes = dimensions.clamp(1, 3);
    let all: f64 = nodes[..axes].iter().map(|&n| n as f64).product();
    let bound = (MAX_OWN_NODES as f64 / all).max(1.0).powf(1.0 / axes as f64);
    let growth = 2f64.powf((f64::from(size) - f64::from(PLAIN)) / axes as f64).min(bound);
    let mut sized = network.clone();
    sized.width = network.width.min(SMALLEST_WIDTH << size.div_ceil(2));
    if network.encoding == Encoding::HashGrid {
        sized.log2_table = Some(network.log2_table().min(SMALLEST_LOG2_TABLE + size));
    }
    let table = nodes.map(|n| ((n as f64 * growth) as usize).max(2));
    (SurrogateSettings { table_nodes: Some(table), ..settings.clone() }, sized)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Runs frames whose residual is a function of the size. Returns the sizes after each change.
    fn sizes(residual: impl Fn(u32) -> f64, tolerance: f64) -> Vec<u32> {
        let mut sizing = Sizing::up_to(LARGEST);
        (0..200).filter_map(|_| sizing.observe(residual(sizing.size), tolerance)).map(|resize| resize.size).collect()
    }

    #[test]
    fn it_grows_until_the_error_is_within_the_tolerance() {
        assert_eq!(sizes(|size| 0.2 * 0.5f64.powi(size as i32), 0.03), [1, 2, 3], "0.025 is within 0.03");
        assert!(sizes(|_| 0.01, 0.03).is_empty(), "what is enough stays");
    }

    #[test]
    fn it_goes_back_when_growing_does_not_help() {
        assert_eq!(sizes(|size| if size < 2 { 0.3 / f64::from(size + 1) } else { 0.149 }, 0.03), [1, 2, 1]);
        assert_eq!(sizes(|_| 0.5, 0.03), [1, 0], "and does not try again");
    }

    #[test]
    fn it_is_bounded_and_shrinks_when_far_below() {
        assert_eq!(sizes(|size| 10.0 * 0.8f64.powi(size as i32), 1e-6).last(), Some(&LARGEST));
        // The flow calms down, and a smaller size suffices.
        let mut sizing = Sizing { size: 5, ..Sizing::up_to(LARGEST) };
        let sizes: Vec<u32> =
            (0..100).filter_map(|_| sizing.observe(0.001 * f64::from(1 << (5 - sizing.size)), 0.03)).map(|r| r.size).collect();
        assert_eq!(sizes, [4, 3, 2], "0.008 is no longer far below 0.03");
    }

    #[test]
    fn numbers_that_are_none_decide_nothing() {
        let mut sizing = Sizing::up_to(LARGEST);
        assert!((0..20).all(|_| sizing.observe(f64::NAN, 0.03).is_none()));
    }

    #[test]
    fn sizes_double_and_end_at_the_scenes_bounds() {
        let network = NetworkSettings::default();
        let at = |size| at_size(&SurrogateSettings::default(), &network, [256, 128, 2], 2, size);
        assert_eq!(at(PLAIN).0.table_nodes.map(|n| [n[0], n[1]]), Some([256, 128]));
        assert_eq!(at(0).0.table_nodes.map(|n| [n[0], n[1]]), Some([128, 64]));
        assert_eq!((at(0).1.log2_table(), at(0).1.width), (12, 16));
        assert_eq!((at(LARGEST).1.log2_table(), at(LARGEST).1.width), (network.log2_table(), network.width));
        let [x, y, _] = at_size(&SurrogateSettings::default(), &network, [4096, 2048, 2], 2, LARGEST).0.table_nodes.unwrap();
        assert_eq!([x, y], [4096, 2048], "beyond 2^21 nodes those that the scene sets are the most");
        let domain = Domain::slab([0.0, 0.0], [2.0, 1.0], (0.0, 1.0));
        let most = |kind, width| {
            let network = NetworkSettings { width, log2_table: Some(14), ..NetworkSettings::default() };
            Sizing::new(&SurrogateSettings { kind, ..SurrogateSettings::default() }, &network, &domain).unwrap().most
        };
        // 2^12 entries are doubled twice; width 64 is reached at size 3; the plain table has 2^15 nodes. Nothing is tried that changes nothing.
        assert_eq!((most(Kind::Network, 16), most(Kind::Network, 64), most(Kind::Table, 64)), (2, 3, PLAIN + MAX_OWN_NODES.ilog2() - 15));
    }
}
