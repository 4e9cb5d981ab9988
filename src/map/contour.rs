//! Lines of one value on a regular grid of points (marching squares), and the joining of segments into lines.

use std::collections::HashMap;

/// Number of an edge of the grid. An edge has one crossing at most, so that its number stands for the point.
pub(super) type Edge = u64;

/// Segments of crossings, which are joined where they share an edge.
#[derive(Default)]
pub(super) struct Segments<P> {
    points: HashMap<Edge, P>,
    pairs: Vec<[Edge; 2]>,
}

impl<P: Clone> Segments<P> {
    pub(super) fn new() -> Self {
        Self { points: HashMap::new(), pairs: Vec::new() }
    }

    pub(super) fn add(&mut self, ends: [(Edge, P); 2]) {
        self.pairs.push([ends[0].0, ends[1].0]);
        for (edge, point) in ends {
            self.points.insert(edge, point);
        }
    }

    /// Joins all segments into lines, in the order in which they were added. A closed line repeats its first point at the end.
    pub(super) fn lines(&self) -> Vec<Vec<P>> {
        let mut at: HashMap<Edge, Vec<usize>> = HashMap::new();
        for (number, pair) in self.pairs.iter().enumerate() {
            pair.iter().for_each(|edge| at.entry(*edge).or_default().push(number));
        }
        let mut used = vec![false; self.pairs.len()];
        let mut lines = Vec::new();
        for start in 0..self.pairs.len() {
            if used[start] {
                continue;
            }
            used[start] = true;
            let mut line = std::collections::VecDeque::from(self.pairs[start]);
            for front in [false, true] {
                // Only edges that two segments share continue a line; at a fork it ends.
                while let Some(end) = if front { line.front().copied() } else { line.back().copied() }
                    && let [a, b] = at[&end][..]
                    && let Some(next) = [a, b].into_iter().find(|n| !used[*n])
                {
                    used[next] = true;
                    let [p, q] = self.pairs[next];
                    let further = if p == end { q } else { p };
                    if front { line.push_front(further) } else { line.push_back(further) }
                }
            }
            lines.push(line.iter().map(|edge| self.points[edge].clone()).collect());
        }
        lines
    }
}

/// Lines on which values of a grid of `size` points (x fastest) equal `level`, in grid coordinates. Cells with a value that is not finite have none.
pub fn contours(values: &[f32], [nx, ny]: [usize; 2], level: f32) -> Vec<Vec<[f64; 2]>> {
    let mut segments = Segments::new();
    let value = |i: usize, j: usize| f64::from(values[j * nx + i] - level);
    for j in 0..ny.saturating_sub(1) {
        for i in 0..nx.saturating_sub(1) {
            // Counter-clockwise from the lower left.
            let corners = [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)];
            let at = corners.map(|(i, j)| value(i, j));
            if !at.iter().all(|v| v.is_finite()) {
                continue;
            }
            let crossing = |k: usize| {
                let (a, b) = (at[k], at[(k + 1) % 4]);
                ((a >= 0.0) != (b >= 0.0)).then(|| {
                    let (from, to, t) = (corners[k], corners[(k + 1) % 4], a / (a - b));
                    let between = |a: usize, b: usize| a as f64 + t * (b as f64 - a as f64);
                    let (low, is_vertical) = ((from.0.min(to.0), from.1.min(to.1)), from.0 == to.0);
                    (2 * (low.1 * nx + low.0) as Edge + Edge::from(is_vertical), [between(from.0, to.0), between(from.1, to.1)])
                })
            };
            let found = [crossing(0), crossing(1), crossing(2), crossing(3)];
            match found {
                // A saddle: the mean of the corners decides which pairs belong together.
                [Some(a), Some(b), Some(c), Some(d)] => {
                    let is_joined = (at.iter().sum::<f64>() >= 0.0) == (at[0] >= 0.0);
                    let pairs = if is_joined { [[a, b], [c, d]] } else { [[a, d], [b, c]] };
                    pairs.into_iter().for_each(|pair| segments.add(pair));
                }
                found => {
                    let mut ends = found.into_iter().flatten();
                    if let (Some(a), Some(b)) = (ends.next(), ends.next()) {
                        segments.add([a, b]);
                    }
                }
            }
        }
    }
    segments.lines()
}
