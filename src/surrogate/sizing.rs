//! `size = "auto"`: how large table and network are, decided by the error that is measured.
//!
//! Starts small. Grows while the optical residual over the whole domain (an error that the transfer function hides is none) is above the
//! tolerance and the last growth made it fall; goes back when it did not; shrinks when the residual is far below. Every size tried is
//! remembered, so that no size is tried twice in vain and the search ends.

use super::network::{Encoding, NetworkSettings};
use super::{Kind, MOST_OWN_NODES, SurrogateError, SurrogateSettings};
use crate::field::Domain;

/// Frames that a size is given before it is judged: the first one's weights have seen next to nothing.
const FRAMES_TO_JUDGE: u32 = 4;
/// Share of the residual that must be left at most for a growth to have been worth its cost.
const STILL_FALLS: f64 = 0.9;
/// Share of the tolerance below which a smaller size is tried.
const FAR_BELOW: f64 = 0.25;
/// Largest size; each doubles the bytes.
const LARGEST: u32 = 12;
/// Size at which a table has the nodes that a fixed one would have.
const PLAIN: u32 = 2;
/// Entries a level of the smallest hash grid, as a power of two.
const SMALLEST_LOG2_TABLE: u32 = 12;
/// Width of the smallest network.
const SMALLEST_WIDTH: usize = 16;

/// Finds the size.
#[derive(Debug, Clone)]
pub struct Sizing {
    /// Nodes of a table of plain size, and axes along which they count.
    nodes: [usize; 3],
    axes: usize,
    size: u32,
    /// Sizes outside have been found useless: too small or not worth it.
    least: u32,
    most: u32,
    /// Residual of the smaller size that was left last, until the growth is judged.
    before_growth: Option<f64>,
    frames: u32,
    /// Sum of the mean squares of the frames that count.
    squares: f64,
    counted: u32,
}

/// A change of size, and why.
#[derive(Debug, Clone, PartialEq)]
pub struct Resize {
    /// The new size, from 0; each step doubles the bytes until the scene's own bounds are reached.
    pub size: u32,
    /// In words.
    pub why: String,
}

impl Sizing {
    /// Starts with the smallest size of what the settings say at most.
    ///
    /// # Errors
    /// Table nodes that are not accepted.
    pub fn new(settings: &SurrogateSettings, network: &NetworkSettings, domain: &Domain) -> Result<Self, SurrogateError> {
        let (nodes, axes) = (settings.nodes(domain)?, domain.dimensions);
        let matters = |size: u32| {
            let (table, network) = at_size(settings, network, nodes, axes, size);
            match settings.kind {
                Kind::Table => (table.table_nodes, 0, 0),
                Kind::Network => (None, network.width, network.log2_table),
                Kind::Residual => (table.table_nodes, network.width, network.log2_table),
            }
        };
        // Beyond the scene's bounds a larger size is the same.
        let most = (0..LARGEST).rev().find(|&size| matters(size) != matters(size + 1)).map_or(0, |size| size + 1);
        Ok(Self { nodes, axes, ..Self::up_to(most) })
    }

    fn up_to(most: u32) -> Self {
        Self { nodes: [2; 3], axes: 3, size: 0, least: 0, most, before_growth: None, frames: 0, squares: 0.0, counted: 0 }
    }

    /// The settings at the size in force.
    pub fn settings(&self, settings: &SurrogateSettings, network: &NetworkSettings) -> (SurrogateSettings, NetworkSettings) {
        at_size(settings, network, self.nodes, self.axes, self.size)
    }

    /// Takes in a frame's root mean square optical residual over the whole domain; gives the size to change to, if it should change.
    pub fn observe(&mut self, residual: f64, tolerance: f64) -> Option<Resize> {
        self.frames += 1;
        // The first half of the frames still learns.
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
        let state = format!("optical residual {residual:.4}, tolerance {tolerance:.4}");
        if residual > tolerance {
            if let Some(before) = before.filter(|before| residual > STILL_FALLS * before) {
                self.most = self.size - 1;
                return Some(self.change_to(self.size - 1, format!("{state}: growing hardly lowered it from {before:.4}, so back to")));
            }
            self.least = self.least.max((self.size + 1).min(self.most));
            if self.size < self.most {
                self.before_growth = Some(residual);
                return Some(self.change_to(self.size + 1, format!("{state}, and it still falls: grow to")));
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

/// The settings at a size. A table starts with a quarter of the nodes that are set (or that the data have) and doubles them at every
/// size, up to those set or 2^21, whichever is more; the network starts small and ends at the scene's.
fn at_size(
    settings: &SurrogateSettings,
    network: &NetworkSettings,
    nodes: [usize; 3],
    dimensions: usize,
    size: u32,
) -> (SurrogateSettings, NetworkSettings) {
    let axes = dimensions.clamp(1, 3);
    let all: f64 = nodes[..axes].iter().map(|&n| n as f64).product();
    let bound = (MOST_OWN_NODES as f64 / all).max(1.0).powf(1.0 / axes as f64);
    let growth = 2f64.powf((f64::from(size) - f64::from(PLAIN)) / axes as f64).min(bound);
    let mut sized = network.clone();
    sized.width = network.width.min(SMALLEST_WIDTH << size.div_ceil(2));
    if network.encoding == Encoding::HashGrid {
        sized.log2_table = network.log2_table.min(SMALLEST_LOG2_TABLE + size);
    }
    let table = nodes.map(|n| ((n as f64 * growth) as usize).max(2));
    (SurrogateSettings { table_nodes: Some(table), ..settings.clone() }, sized)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Runs frames whose residual is a function of the size; gives the sizes after each change.
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
        // The flow calms down: what was needed no longer is.
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
        assert_eq!((at(0).1.log2_table, at(0).1.width), (12, 16));
        assert_eq!((at(LARGEST).1.log2_table, at(LARGEST).1.width), (network.log2_table, network.width));
        let [x, y, _] = at_size(&SurrogateSettings::default(), &network, [4096, 2048, 2], 2, LARGEST).0.table_nodes.unwrap();
        assert_eq!([x, y], [4096, 2048], "beyond 2^21 nodes those that the scene sets are the most");
        let domain = Domain::slab([0.0, 0.0], [2.0, 1.0], (0.0, 1.0));
        let most = |kind, width| {
            let network = NetworkSettings { width, log2_table: 14, ..NetworkSettings::default() };
            Sizing::new(&SurrogateSettings { kind, table_nodes: None }, &network, &domain).unwrap().most
        };
        // 2^12 entries are doubled twice; width 64 is reached at size 3; the plain table has 2^15 nodes. Nothing is tried that changes nothing.
        assert_eq!((most(Kind::Network, 16), most(Kind::Network, 64), most(Kind::Table, 64)), (2, 3, PLAIN + MOST_OWN_NODES.ilog2() - 15));
    }
}
