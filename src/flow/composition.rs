//! Flow maps composed of tabulated ones (Brunton and Rowley, Fast computation of finite-time Lyapunov exponent fields for unsteady flows, Chaos 20,
//! 017503, 2010): the displacement over each interval of time is traced once at nodes and interpolated, so that a window that slides traces one
//! interval only.

use super::stretch::log_stretch;
use super::{Boundary, Extras, FlowError, FlowMap, Normalisation, Traced, VelocitySource, cpu_tracer};
use rayon::prelude::*;
use ridgewatch_field::{Domain, DomainPoint, Geometry, UnitPoint};

/// Nodes traced at once, which bounds the memory beside the tables.
const AT_ONCE: usize = 1 << 20;
/// Points per parallel task.
const CHUNK: usize = 1 << 10;

/// Displacement over one interval in unit coordinates, at nodes of a regular grid over the unit domain, x fastest.
#[derive(Debug, Clone)]
struct DisplacementTable(Vec<[f32; 3]>);

/// A chain of tabulated flow maps, one per interval of time, earliest first.
#[derive(Debug, Clone)]
pub struct Composition {
    /// Nodes along x, y, z; one along z in two dimensions.
    nodes: [usize; 3],
    domain: Domain,
    tables: Vec<DisplacementTable>,
}

impl Composition {
    /// Traces the displacements over `intervals` equal parts of tau, with the interpolation, boundary and direction of `map`, and `steps` Runge-Kutta
    /// steps per part. `None` on a sphere, where a displacement in degrees jumps at the dateline and the poles, and if particles stop or wrap, which
    /// the displacement does not tell.
    ///
    /// # Errors
    /// As [`cpu_tracer`].
    pub fn trace(
        velocity: &VelocitySource,
        map: &FlowMap,
        t0: f64,
        nodes: [usize; 3],
        intervals: usize,
        steps: usize,
    ) -> Result<Option<Self>, FlowError> {
        if let VelocitySource::Window(window) = velocity
            && window.grid().is_some_and(|grid| grid.geometry != Geometry::Cartesian)
        {
            return Ok(None);
        }
        if !matches!(map.boundary, Boundary::Clamp | Boundary::Unbounded) || map.normalisation == Normalisation::Lifetime {
            return Ok(None);
        }
        let part = map.tau / intervals.max(1) as f64;
        let map = FlowMap { tau: part, steps: super::Steps::Fixed(steps.max(1)), ..map.clone() };
        let mut composition: Option<Self> = None;
        for interval in 0..intervals.max(1) {
            let tracer = cpu_tracer(velocity.clone(), &map, t0 + map.direction.sign() * part * interval as f64)?;
            let built = composition.get_or_insert_with(|| {
                let domain = tracer.domain().clone();
                let nodes = std::array::from_fn(|axis| if axis < domain.dimensions { nodes[axis].max(2) } else { 1 });
                Self { nodes, domain, tables: Vec::new() }
            });
            let mut table = vec![[0.0; 3]; built.nodes.iter().product()];
            let mut traced = Traced::default();
            for (number, displacements) in table.chunks_mut(AT_ONCE).enumerate() {
                let unit: Vec<UnitPoint> = (0..displacements.len()).into_par_iter().map(|i| built.unit(number * AT_ONCE + i)).collect();
                let seeds: Vec<DomainPoint> = unit.par_iter().map(|&point| built.domain.from_unit(point)).collect();
                tracer.trace(&seeds, Extras { arrival: true, jacobian: false }, &mut traced);
                for ((displacement, arrival), seed) in displacements.iter_mut().zip(&traced.arrival).zip(&unit) {
                    let arrival = built.domain.to_unit_unclamped(*arrival);
                    // Missing cells have no arrival; a particle rests there.
                    *displacement = std::array::from_fn(|axis| {
                        let moved = arrival.0[axis] - seed.0[axis];
                        if moved.is_finite() && axis < built.domain.dimensions { moved } else { 0.0 }
                    });
                }
            }
            built.tables.push(DisplacementTable(table));
        }
        Ok(composition)
    }

    /// Joins neighbouring intervals until one is left (the hierarchical variant): a sample then takes one look-up instead of one per interval.
    /// Each joining interpolates once more.
    #[must_use]
    pub fn joined(&self) -> Self {
        let join = |tables: &[DisplacementTable]| tables.chunks(2).map(|pair| self.join(pair)).collect::<Vec<_>>();
        let mut tables = join(&self.tables);
        while tables.len() > 1 {
            tables = join(&tables);
        }
        Self { nodes: self.nodes, domain: self.domain.clone(), tables }
    }

    fn join(&self, pair: &[DisplacementTable]) -> DisplacementTable {
        let mut first = pair[0].clone();
        if let Some(second) = pair.get(1) {
            first.0.par_iter_mut().enumerate().for_each(|(node, displacement)| {
                let from = self.unit(node).0.map(f64::from);
                let there: [f64; 3] = std::array::from_fn(|axis| from[axis] + f64::from(displacement[axis]));
                let (further, _) = self.interpolate(second, there);
                *displacement = std::array::from_fn(|axis| (f64::from(displacement[axis]) + further[axis]) as f32);
            });
        }
        first
    }

    /// Bytes of the tables.
    pub fn bytes(&self) -> usize {
        self.tables.len() * self.nodes.iter().product::<usize>() * size_of::<[f32; 3]>()
    }

    /// Unit coordinates of a node. Two-dimensional flows are traced in the middle of the slab.
    fn unit(&self, node: usize) -> UnitPoint {
        let [x, y, _] = self.nodes;
        let index = [node % x, node / x % y, node / (x * y)];
        UnitPoint(std::array::from_fn(|axis| if self.nodes[axis] > 1 { index[axis] as f32 / (self.nodes[axis] - 1) as f32 } else { 0.5 }))
    }

    /// Interpolated displacement at a unit point and its derivatives, `[component][axis]`. Outside the domain both are those at its edge.
    fn interpolate(&self, table: &DisplacementTable, point: [f64; 3]) -> ([f64; 3], [[f64; 3]; 3]) {
        let [nx, ny, _] = self.nodes;
        let axes = self.domain.dimensions.clamp(2, 3);
        let (mut low, mut fraction, mut cells) = ([0; 3], [0.0; 3], [0.0; 3]);
        for axis in 0..axes {
            cells[axis] = (self.nodes[axis] - 1) as f64;
            let position = point[axis].clamp(0.0, 1.0) * cells[axis];
            low[axis] = (position as usize).min(self.nodes[axis] - 2);
            fraction[axis] = position - low[axis] as f64;
        }
        let (mut value, mut derivative) = ([0.0; 3], [[0.0; 3]; 3]);
        for corner in 0..1 << axes {
            let high = |axis: usize| corner >> axis & 1;
            let weight = |axis: usize| if high(axis) == 1 { fraction[axis] } else { 1.0 - fraction[axis] };
            let node = (low[0] + high(0)) + nx * ((low[1] + high(1)) + ny * (if axes == 3 { low[2] + high(2) } else { 0 }));
            let displacement = table.0[node].map(f64::from);
            let all: f64 = (0..axes).map(weight).product();
            for axis in 0..axes {
                let others: f64 = (0..axes).filter(|&k| k != axis).map(weight).product();
                let slope = if high(axis) == 1 { others * cells[axis] } else { -others * cells[axis] };
                for component in 0..axes {
                    derivative[component][axis] += displacement[component] * slope;
                }
            }
            for component in 0..axes {
                value[component] += displacement[component] * all;
            }
        }
        (value, derivative)
    }

    /// Writes the log-stretch at unit points into `out` (same length).
    pub fn log_stretch(&self, points: &[UnitPoint], out: &mut [f64]) {
        points.par_chunks(CHUNK).zip(out.par_chunks_mut(CHUNK)).for_each(|(points, out)| {
            for (point, out) in points.iter().zip(out) {
                *out = if self.domain.dimensions == 2 { self.stretch_at::<2>(*point) } else { self.stretch_at::<3>(*point) };
            }
        });
    }

    fn stretch_at<const D: usize>(&self, point: UnitPoint) -> f64 {
        let mut at = point.0.map(f64::from);
        let mut jacobian: [[f64; D]; D] = std::array::from_fn(|i| std::array::from_fn(|j| f64::from(u8::from(i == j))));
        for table in &self.tables {
            let (displacement, derivative) = self.interpolate(table, at);
            let before = jacobian;
            for i in 0..D {
                for j in 0..D {
                    jacobian[i][j] = before[i][j] + (0..D).map(|k| derivative[i][k] * before[k][j]).sum::<f64>();
                }
                at[i] += displacement[i];
            }
        }
        let extent = self.domain.extent();
        let in_coordinates: [[f64; D]; D] = std::array::from_fn(|i| std::array::from_fn(|j| jacobian[i][j] * extent[i] / extent[j]));
        log_stretch(&in_coordinates)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Boundary;
    use ridgewatch_field::analytic::Analytic;

    fn errors(nodes: usize, intervals: usize) -> [f64; 2] {
        let domain = Domain::slab([0.0, 0.0], [2.0, 1.0], (0.0, 1.0));
        let flow = Analytic::DoubleGyre { amplitude: 0.1, epsilon: 0.25, omega: std::f64::consts::TAU / 10.0 };
        let velocity = VelocitySource::Analytic(flow, domain.clone());
        let map = FlowMap { boundary: Boundary::Unbounded, ..FlowMap::tangent(5.0, 200) };
        let composed = Composition::trace(&velocity, &map, 0.0, [2 * nodes, nodes, 1], intervals, 40).unwrap().unwrap();
        let cube = Domain::slab([0.0; 2], [1.0; 2], (0.0, 1.0));
        let points: Vec<UnitPoint> = super::super::steps::quasi_random_points(&cube, 500).into_iter().map(|p| cube.to_unit(p)).collect();
        let seeds: Vec<DomainPoint> = points.iter().map(|&p| domain.from_unit(p)).collect();
        let mut truth = Traced::default();
        cpu_tracer(velocity, &map, 0.0).unwrap().trace(&seeds, Extras::default(), &mut truth);
        [composed.clone(), composed.joined()].map(|composed| {
            let mut found = vec![0.0; points.len()];
            composed.log_stretch(&points, &mut found);
            let square: f64 = found.iter().zip(&truth.log_stretch).map(|(a, b)| (a - f64::from(*b)).powi(2)).sum();
            (square / points.len() as f64).sqrt()
        })
    }

    #[test]
    fn composed_maps_converge_to_the_flow_map() {
        let (coarse, fine) = (errors(40, 5), errors(160, 5));
        // Linear interpolation of a displacement has a gradient of first order.
        for kind in 0..2 {
            assert!(fine[kind] < 0.45 * coarse[kind] && fine[kind] < 0.12, "{coarse:?} {fine:?}");
        }
    }

    #[test]
    fn one_interval_is_its_own_joint() {
        let [plain, joined] = errors(40, 1);
        assert_eq!(plain, joined);
    }
}
