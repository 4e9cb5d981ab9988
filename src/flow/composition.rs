//! Flow maps composed of tabulated ones (Brunton and Rowley, Fast computation of finite-time Lyapunov exponent fields for unsteady flows, Chaos 20,
//! 017503, 2010): the displacement over each interval of time is traced once at nodes and interpolated, so that a window that slides traces one
//! interval only.

use super::axis_map::AxisMap;
use super::sphere::{Globe, GlobeLocation, MIN_COSINE, dot, normalised, project, trigonometry};
use super::stretch::log_stretch;
use super::{Boundary, Extras, FlowError, FlowMap, Integrator, Normalisation, Steps, Traced, Tracer, VelocitySource, cpu_tracer};
use rayon::prelude::*;
use ridgewatch_field::{Axis, Domain, DomainPoint, Geometry, UnitPoint};

/// Nodes traced at once, which bounds the memory beside the tables.
const AT_ONCE: usize = 1 << 20;
/// Points per parallel task.
const CHUNK: usize = 1 << 10;
/// Most components of a state.
const STATE: usize = 4;
/// Share of an interval from which on a particle did not stop in it, but for rounding.
const SURVIVES: f32 = 1.0 - 1e-5;

/// Place of a particle: unit coordinates, or on a sphere a unit vector and, with levels, the height in unit coordinates.
type State = [f64; STATE];

/// What the nodes of a flow hold.
#[derive(Debug, Clone, Copy)]
struct Layout {
    dimensions: usize,
    /// Radius of the sphere; `None` in a box.
    radius: Option<f64>,
    /// True if the last value of a node tells whether its particle stops in the interval: 1 or 0.
    stops: bool,
}

/// Displacements of the nodes over an interval, or over joined ones.
#[derive(Debug, Clone)]
struct Table(Vec<f32>);

/// A chain of tabulated flow maps, one per interval of time, earliest first.
#[derive(Debug, Clone)]
pub struct Composition {
    /// Nodes along x, y, z, of a regular grid over the domain, x fastest; one along z in two dimensions.
    nodes: [usize; 3],
    domain: Domain,
    layout: Layout,
    /// Locates directions among the nodes of a sphere.
    globe: Option<Globe<f64>>,
    tables: Vec<Table>,
}

impl Layout {
    /// `None` as for [`Composition::trace`].
    fn new(velocity: &VelocitySource, map: &FlowMap) -> Option<Self> {
        let (dimensions, radius, wraps, has_missing) = match velocity {
            VelocitySource::Analytic(_, domain) => (domain.dimensions, None, false, false),
            VelocitySource::Window(window) => {
                let grid = window.grid()?;
                let has_missing = window.snapshots().any(|snapshot| snapshot.missing_nodes() > 0);
                let is_periodic = grid.axes.iter().any(|axis| axis.period().is_some());
                match grid.geometry {
                    Geometry::Cartesian => (grid.dimensions(), None, is_periodic, has_missing),
                    Geometry::Sphere { radius } => (grid.dimensions(), Some(radius), false, has_missing),
                }
            }
        };
        let is_told = !matches!(map.boundary, Boundary::Periodic | Boundary::Zero) && map.normalisation == Normalisation::Tau;
        // Without a velocity particles stop under any policy.
        (is_told && !wraps).then_some(Self { dimensions, radius, stops: map.boundary == Boundary::Stop || has_missing })
    }

    /// Components of a state that particles change.
    fn components(self) -> usize {
        if self.radius.is_some() { 3 + usize::from(self.dimensions == 3) } else { self.dimensions }
    }

    /// Values of a node.
    fn values(self) -> usize {
        self.components() + usize::from(self.stops)
    }
}

impl Composition {
    /// Traces the displacements over `intervals` equal parts of tau by the tangent flow's Runge-Kutta steps, `steps` per part, with the interpolation,
    /// boundary and direction of `map`. A particle stops in the interval in which that of the nearest node does, and the gradient is that of the map that
    /// stops it. Outside of the domain it moves as at the edge.
    ///
    /// `None` if axes of a box wrap (periodic ones, or `flow.boundary = "periodic"`), with `flow.boundary = "zero"`, and with
    /// `flow.normalisation = "lifetime"`: a displacement does not tell them.
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
        let Some(layout) = Layout::new(velocity, map) else { return Ok(None) };
        let part = map.tau / intervals.max(1) as f64;
        let map = FlowMap { tau: part, steps: Steps::Fixed(steps.max(1)), integrator: Integrator::Tangent, ..map.clone() };
        let mut composition: Option<Self> = None;
        for interval in 0..intervals.max(1) {
            let tracer = cpu_tracer(velocity.clone(), &map, t0 + map.direction.sign() * part * interval as f64)?;
            let built = composition.get_or_insert_with(|| Self::empty(tracer.domain(), layout, nodes));
            let table = built.traced(&*tracer);
            built.tables.push(table);
        }
        Ok(composition)
    }

    /// Values that a node of one interval has, of four bytes each; `None` as for [`Composition::trace`].
    pub fn values_per_node(velocity: &VelocitySource, map: &FlowMap) -> Option<usize> {
        Layout::new(velocity, map).map(Layout::values)
    }

    fn empty(domain: &Domain, layout: Layout, nodes: [usize; 3]) -> Self {
        let nodes: [usize; 3] = std::array::from_fn(|axis| if axis < layout.dimensions { nodes[axis].max(2) } else { 1 });
        let axis =
            |k: usize| Axis::uniform("", "", domain.min[k], domain.max[k], nodes[k]).map(|axis| AxisMap::new(&axis, Boundary::Clamp));
        // A domain has an extent along each of its axes.
        let globe = layout.radius.and_then(|_| Some(Globe::new(&axis(0).ok()?, &axis(1).ok()?)));
        Self { nodes, domain: domain.clone(), layout, globe, tables: Vec::new() }
    }

    /// Displacements over the interval of a tracer.
    fn traced(&self, tracer: &dyn Tracer) -> Table {
        let (components, values) = (self.layout.components(), self.layout.values());
        let mut table = vec![0.0; values * self.nodes.iter().product::<usize>()];
        let mut traced = Traced::default();
        for (number, rows) in table.chunks_mut(values * AT_ONCE).enumerate() {
            let first = number * AT_ONCE;
            let nodes = first..first + rows.len() / values;
            let seeds: Vec<DomainPoint> = nodes.into_par_iter().map(|node| self.seed(node)).collect();
            tracer.trace(&seeds, Extras { arrival: true, jacobian: false }, &mut traced);
            rows.par_chunks_exact_mut(values).enumerate().for_each(|(i, row)| {
                let [from, to] = [seeds[i], traced.arrival[i]].map(|point| self.state(point.0.map(f64::from)));
                for component in 0..components {
                    row[component] = (to[component] - from[component]) as f32;
                }
                if self.layout.stops {
                    row[components] = f32::from(u8::from(traced.lifetime_share[i] < SURVIVES));
                }
            });
        }
        Table(table)
    }

    /// Joins neighbouring intervals until one is left (the hierarchical variant): a sample then takes one look-up instead of one per interval.
    /// Each joining interpolates once more.
    #[must_use]
    pub fn joined(&self) -> Self {
        let join = |tables: &[Table]| tables.chunks(2).map(|pair| self.join(pair)).collect::<Vec<_>>();
        let mut tables = join(&self.tables);
        while tables.len() > 1 {
            tables = join(&tables);
        }
        Self { nodes: self.nodes, domain: self.domain.clone(), layout: self.layout, globe: self.globe.clone(), tables }
    }

    fn join(&self, pair: &[Table]) -> Table {
        let mut joint = pair[0].clone();
        let Some(second) = pair.get(1) else { return joint };
        let components = self.layout.components();
        joint.0.par_chunks_exact_mut(self.layout.values()).enumerate().for_each(|(node, row)| {
            if self.layout.stops && row[components] > 0.0 {
                return;
            }
            let from = self.state(self.coordinates(node));
            let mut at: State = std::array::from_fn(|i| if i < components { from[i] + f64::from(row[i]) } else { from[i] });
            let place = self.place(&at);
            let (value, _) = self.interpolate(second, place.nodes);
            self.advance::<0>(&mut at, &mut [[]; STATE], &value);
            for i in 0..components {
                row[i] = (at[i] - from[i]) as f32;
            }
            if self.layout.stops {
                row[components] = f32::from(u8::from(self.stops_at(second, place.nodes)));
            }
        });
        joint
    }

    /// Bytes of the tables.
    pub fn bytes(&self) -> usize {
        self.tables.iter().map(|table| size_of_val(&table.0[..])).sum()
    }

    /// Domain coordinates of a node. Two-dimensional flows are traced in the middle of the slab.
    fn coordinates(&self, node: usize) -> [f64; 3] {
        let ([x, y, _], extent) = (self.nodes, self.domain.extent());
        let index = [node % x, node / x % y, node / (x * y)];
        let unit = |axis: usize| if self.nodes[axis] > 1 { index[axis] as f64 / (self.nodes[axis] - 1) as f64 } else { 0.5 };
        std::array::from_fn(|axis| self.domain.min[axis] + extent[axis] * unit(axis))
    }

    /// The seed of a node, in single precision and not outside of the domain.
    fn seed(&self, node: usize) -> DomainPoint {
        self.domain.inward(self.coordinates(node))
    }

    /// State at domain coordinates.
    fn state(&self, point: [f64; 3]) -> State {
        let extent = self.domain.extent();
        let [x, y, z] = std::array::from_fn(|axis| (point[axis] - self.domain.min[axis]) / extent[axis]);
        if self.globe.is_none() {
            return [x, y, z, 0.0];
        }
        let [sin_lon, cos_lon, sin_lat, cos_lat] = trigonometry(point);
        [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat, z]
    }

    /// d state / d seed along an orthonormal basis at the seed, lengths in units of the domain, or in radii.
    fn initial_tangent<const C: usize>(&self, point: [f64; 3]) -> [[f64; C]; STATE] {
        let extent = self.domain.extent();
        let full = match self.layout.radius {
            None => [[1.0 / extent[0], 0.0, 0.0], [0.0, 1.0 / extent[1], 0.0], [0.0, 0.0, 1.0 / extent[2]], [0.0; 3]],
            Some(radius) => {
                let [sin_lon, cos_lon, sin_lat, cos_lat] = trigonometry(point);
                [
                    [-sin_lon, -sin_lat * cos_lon, 0.0],
                    [cos_lon, -sin_lat * sin_lon, 0.0],
                    [0.0, cos_lat, 0.0],
                    [0.0, 0.0, radius / extent[2]],
                ]
            }
        };
        full.map(|row| std::array::from_fn(|c| row[c]))
    }

    /// Gradient of the flow map between orthonormal bases at seed and arrival.
    fn gradient<const C: usize>(&self, at: &State, tangent: &[[f64; C]; STATE]) -> [[f64; C]; C] {
        let extent = self.domain.extent();
        let (Some(globe), Some(radius)) = (&self.globe, self.layout.radius) else {
            return std::array::from_fn(|i| tangent[i].map(|x| x * extent[i]));
        };
        let basis = globe.basis(&[at[0], at[1], at[2]], at[0].hypot(at[1]).max(MIN_COSINE));
        std::array::from_fn(|i| {
            std::array::from_fn(|c| match i {
                0 | 1 => dot(&basis[i], &[tangent[0][c], tangent[1][c], tangent[2][c]]),
                _ => tangent[3][c] * extent[2] / radius,
            })
        })
    }

    fn place(&self, at: &State) -> Place {
        // Outside the domain displacement and derivatives are those at its edge.
        let within = |x: f64, axis: usize| x.clamp(0.0, 1.0) * (self.nodes[axis] - 1) as f64;
        let Some(globe) = &self.globe else {
            return Place { nodes: std::array::from_fn(|axis| within(at[axis], axis)), on_sphere: None };
        };
        let here = globe.locate(&[at[0], at[1], at[2]]);
        let [longitude, latitude] = [0, 1].map(|axis| here.location[axis].clamp(0.0, (self.nodes[axis] - 1) as f64));
        Place { nodes: [longitude, latitude, within(at[3], 2)], on_sphere: Some(here) }
    }

    /// Interpolated displacement among the nodes and its derivatives along the axes, per node.
    fn interpolate(&self, table: &Table, place: [f64; 3]) -> (State, [[f64; 3]; STATE]) {
        let ([nx, ny, _], axes) = (self.nodes, self.layout.dimensions);
        let (values, components) = (self.layout.values(), self.layout.components());
        let (mut low, mut fraction) = ([0; 3], [0.0; 3]);
        for axis in 0..axes {
            low[axis] = (place[axis] as usize).min(self.nodes[axis] - 2);
            fraction[axis] = place[axis] - low[axis] as f64;
        }
        let (mut value, mut derivative) = ([0.0; STATE], [[0.0; 3]; STATE]);
        for corner in 0..1 << axes {
            let high = |axis: usize| corner >> axis & 1;
            let weight = |axis: usize| if high(axis) == 1 { fraction[axis] } else { 1.0 - fraction[axis] };
            let node = (low[0] + high(0)) + nx * ((low[1] + high(1)) + ny * (if axes == 3 { low[2] + high(2) } else { 0 }));
            let row = &table.0[values * node..values * node + components];
            let all: f64 = (0..axes).map(weight).product();
            let mut slopes = [0.0; 3];
            for axis in 0..axes {
                let others: f64 = (0..axes).filter(|&k| k != axis).map(weight).product();
                slopes[axis] = if high(axis) == 1 { others } else { -others };
            }
            for (i, &entry) in row.iter().enumerate() {
                value[i] += f64::from(entry) * all;
                for axis in 0..axes {
                    derivative[i][axis] += f64::from(entry) * slopes[axis];
                }
            }
        }
        (value, derivative)
    }

    /// Whether the particle of the nearest node stops in the interval of a table.
    fn stops_at(&self, table: &Table, place: [f64; 3]) -> bool {
        let ([nx, ny, _], values) = (self.nodes, self.layout.values());
        let [x, y, z]: [usize; 3] = std::array::from_fn(|axis| (place[axis].round() as usize).min(self.nodes[axis] - 1));
        self.layout.stops && table.0[values * (x + nx * (y + ny * z)) + values - 1] > 0.0
    }

    /// Changes of the place among the nodes for a change of the state.
    fn differentials(&self, place: &Place, change: State) -> [f64; 3] {
        let cells = self.nodes.map(|n| (n.max(2) - 1) as f64);
        match (&self.globe, &place.on_sphere) {
            (Some(globe), Some(here)) => {
                let basis = globe.basis(&here.p, here.cosine);
                let (_, [longitude, latitude]) = globe.differentials(here, &basis, [change[0], change[1], change[2]]);
                [longitude, latitude, change[3] * cells[2]]
            }
            _ => std::array::from_fn(|axis| change[axis] * cells[axis]),
        }
    }

    /// Adds a displacement to a state, whose tangent has what was added already; both stay on the sphere.
    fn advance<const C: usize>(&self, at: &mut State, tangent: &mut [[f64; C]; STATE], value: &State) {
        (0..self.layout.components()).for_each(|i| at[i] += value[i]);
        if self.globe.is_none() {
            return;
        }
        let (p, inverse) = normalised(&[at[0], at[1], at[2]]);
        at[..3].copy_from_slice(&p);
        for c in 0..C {
            let (column, _) = project(&p, &[tangent[0][c], tangent[1][c], tangent[2][c]]);
            (0..3).for_each(|i| tangent[i][c] = column[i] * inverse);
        }
    }

    /// Writes the log-stretch at unit points into `out` (same length).
    pub fn log_stretch(&self, points: &[UnitPoint], out: &mut [f64]) {
        points.par_chunks(CHUNK).zip(out.par_chunks_mut(CHUNK)).for_each(|(points, out)| {
            for (point, out) in points.iter().zip(out) {
                *out = if self.layout.dimensions == 2 { self.stretch_at::<2>(*point) } else { self.stretch_at::<3>(*point) };
            }
        });
    }

    fn stretch_at<const C: usize>(&self, point: UnitPoint) -> f64 {
        let (extent, components) = (self.domain.extent(), self.layout.components());
        let seed = std::array::from_fn(|axis| self.domain.min[axis] + extent[axis] * f64::from(point.0[axis]));
        let (mut at, mut tangent) = (self.state(seed), self.initial_tangent::<C>(seed));
        for table in &self.tables {
            let place = self.place(&at);
            let (value, derivative) = self.interpolate(table, place.nodes);
            for c in 0..C {
                let change = self.differentials(&place, std::array::from_fn(|i| tangent[i][c]));
                for i in 0..components {
                    tangent[i][c] += (0..3).map(|axis| derivative[i][axis] * change[axis]).sum::<f64>();
                }
            }
            self.advance(&mut at, &mut tangent, &value);
            if self.stops_at(table, place.nodes) {
                break;
            }
        }
        log_stretch(&self.gradient(&at, &tangent))
    }
}

/// A place among the nodes: node coordinates from the first node on, and the location on the sphere.
struct Place {
    nodes: [f64; 3],
    on_sphere: Option<GlobeLocation<f64>>,
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
