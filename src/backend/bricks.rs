//! Bricks of the nodes on which a network is laid out for a picture: where the network is not trusted, their nodes are traced instead.

use ridgewatch_render::smooth::{Nodes, own_nodes};
use ridgewatch_trust::Gate;

/// Which bricks have been traced since the window slid.
#[derive(Debug, Clone, Default)]
pub struct TracedBricks {
    shape: [usize; 3],
    /// In the order in which they were traced.
    bricks: Vec<u32>,
    /// Nodes of bricks that were wanted at last, and are not traced.
    missing: usize,
}

impl TracedBricks {
    /// The bricks, in the order in which they were traced.
    pub fn bricks(&self) -> &[u32] {
        &self.bricks
    }

    /// Share of all nodes whose bricks were wanted when [`TracedBricks::next`] was called last, and are not traced since.
    pub fn untraced_share(&self) -> f64 {
        self.missing as f64 / self.shape.iter().product::<usize>().max(1) as f64
    }

    /// Forgets all bricks if these are other nodes. Returns true if it did.
    pub fn settle(&mut self, shape: [usize; 3]) -> bool {
        let is_other = self.shape != shape;
        if is_other {
            *self = Self { shape, ..Self::default() };
        }
        is_other
    }

    /// Bricks to trace next, of at most `most` nodes: those that reach into cells which the gate does not trust, first the ones of which the transfer
    /// function shows most. `brick_max` has the largest log-stretch of each brick, `shown` the optical ramp of a log-stretch.
    pub fn next(&mut self, brick_max: &[f32], gate: &Gate, shown: impl Fn(f32) -> f32, most: usize) -> Vec<u32> {
        let mut is_traced = vec![false; brick_max.len()];
        self.bricks.iter().for_each(|&brick| is_traced[brick as usize] = true);
        let wanted = |brick: &usize| !is_traced[*brick] && !is_trusted(self.shape, *brick, gate);
        let mut found: Vec<(f32, usize)> = (0..brick_max.len()).filter(wanted).map(|brick| (shown(brick_max[brick]), brick)).collect();
        found.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        let shape = self.shape;
        self.missing = found.iter().map(|&(_, brick)| count(shape, brick)).sum();
        let mut left = most;
        let fits = |&(_, brick): &(f32, usize)| {
            let count = count(shape, brick);
            let fits = count <= left;
            left = left.saturating_sub(count);
            fits
        };
        found.into_iter().take_while(fits).map(|(_, brick)| brick as u32).collect()
    }

    /// Counts bricks as traced.
    pub fn add(&mut self, bricks: &[u32]) {
        let traced: usize = bricks.iter().map(|&brick| count(self.shape, brick as usize)).sum();
        self.missing = self.missing.saturating_sub(traced);
        self.bricks.extend_from_slice(bricks);
    }
}

/// Number of nodes of a brick.
fn count(shape: [usize; 3], brick: usize) -> usize {
    own_nodes(shape, brick).iter().map(ExactSizeIterator::len).product()
}

/// True if the gate trusts every cell that holds a node of a brick.
fn is_trusted(shape: [usize; 3], brick: usize, gate: &Gate) -> bool {
    let nodes = own_nodes(shape, brick);
    let corner = |node: [usize; 3]| Nodes::unit(shape, (node[2] * shape[1] + node[1]) * shape[0] + node[0]);
    gate.trusts_box([corner(nodes.clone().map(|range| range.start)), corner(nodes.map(|range| range.end - 1))])
}

#[cfg(test)]
mod tests {
    use super::*;
    use ridgewatch_render::smooth::brick_shape;

    #[test]
    fn bricks_are_traced_where_the_network_is_not_trusted_the_brightest_first() {
        let shape = [17, 17, 1];
        // Cells of the gate along x: only the last quarter is trusted.
        let gate = Gate::new([4, 1, 1], vec![false, false, false, true]);
        let mut traced = TracedBricks::default();
        assert!(traced.settle(shape) && !traced.settle(shape));
        assert_eq!(brick_shape(shape), [2, 2, 1]);
        let most = [0.1, 0.7, 0.4, 0.2];
        let next = |traced: &mut TracedBricks, nodes| traced.next(&most, &gate, |s| s - 0.15, nodes);
        // The last bricks along an axis have nine nodes of their own.
        assert_eq!(next(&mut traced, 1000), [1, 2, 3, 0]);
        assert_eq!(next(&mut traced, 9 * 8 + 8 * 9), [1, 2]);
        assert_eq!(next(&mut traced, 9 * 8 - 1), [0_u32; 0]);
        assert_eq!(traced.untraced_share(), 1.0);
        traced.add(&[1, 3]);
        let share = |nodes: usize| nodes as f64 / 289.0;
        assert_eq!(traced.untraced_share(), share(8 * 8 + 8 * 9));
        assert_eq!(next(&mut traced, 1000), [2, 0]);
        assert_eq!(traced.next(&most, &Gate::uniform(true), |s| s, 1000), [0_u32; 0]);
        assert_eq!(traced.untraced_share(), 0.0);
        let half = Gate::new([2, 1, 1], vec![true, false]);
        // The first bricks end at node 7 of 16.
        assert_eq!(TracedBricks { shape, ..TracedBricks::default() }.next(&most, &half, |s| s, 1000), [1, 3]);
        assert!(traced.settle([9, 9, 1]) && traced.bricks().is_empty());
    }
}
