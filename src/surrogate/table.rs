//! The log-stretch traced at the nodes of a regular grid over the unit domain, interpolated multilinearly.

use super::CheckpointError;
use super::checkpoint::{Checkpoint, Entry};
use super::network::Field;
use super::trace::Trace;
use rayon::prelude::*;
use ridgewatch_base::DeviceError;
use ridgewatch_base::progress::Work;
use ridgewatch_field::{Domain, DomainPoint, UnitPoint};
use ridgewatch_flow::{Extras, Traced};
use std::sync::Arc;
use wide::{f32x8, i32x8};

/// Seeds traced at once while a table is built: bounds the memory beside the table itself.
const TRACE_AT_ONCE: usize = 1 << 20;

/// Node i of n along an axis lies at unit coordinate i / (n - 1). Two-dimensional tables have one node along z.
#[derive(Debug, Clone)]
pub struct Table {
    nodes: [usize; 3],
    dimensions: usize,
    /// Values at the nodes, x fastest. Clones share them; a slide allocates new memory if a clone exists.
    values: Arc<Vec<f32>>,
    /// Nodes that are traced, from the first on.
    traced: usize,
    not_finite: usize,
}

impl Table {
    /// Creates a table none of whose nodes is traced yet. `nodes` along z is ignored in two dimensions; fewer than 2 along an active axis are taken as 2.
    pub fn untraced(domain: &Domain, nodes: [usize; 3]) -> Self {
        let dimensions = domain.dimensions.clamp(2, 3);
        let nodes: [usize; 3] = std::array::from_fn(|axis| if axis < dimensions { nodes[axis].max(2) } else { 1 });
        Self { nodes, dimensions, values: Arc::default(), traced: 0, not_finite: 0 }
    }

    /// Traces every node of a new table, as for [`Table::untraced`].
    ///
    /// # Errors
    /// The tracer's device fails.
    pub fn trace(tracer: &dyn Trace, nodes: [usize; 3]) -> Result<Self, DeviceError> {
        let mut table = Self::untraced(tracer.flow().domain(), nodes);
        table.trace_more(tracer, usize::MAX)?;
        Ok(table)
    }

    /// Creates a table from values that were traced on a device, x fastest.
    pub fn from_values(nodes: [usize; 3], values: Vec<f32>, not_finite: usize) -> Self {
        let (dimensions, traced) = (if nodes[2] > 1 { 3 } else { 2 }, values.len());
        Self { nodes, dimensions, values: Arc::new(values), traced, not_finite }
    }

    /// Traces every node again, after the window has slid.
    ///
    /// # Errors
    /// The tracer's device fails; values are then unspecified.
    pub fn retrace(&mut self, tracer: &dyn Trace) -> Result<(), DeviceError> {
        (self.traced, self.not_finite) = (0, 0);
        self.trace_more(tracer, usize::MAX).map(drop)
    }

    /// Traces the next nodes, at most `most`. True once every node is traced.
    ///
    /// # Errors
    /// The tracer's device fails; values are then unspecified.
    pub fn trace_more(&mut self, tracer: &dyn Trace, most: usize) -> Result<bool, DeviceError> {
        let (nodes, dimensions, domain) = (self.nodes, self.dimensions, tracer.flow().domain());
        let unit = |index: usize| -> UnitPoint {
            let node = [index % nodes[0], index / nodes[0] % nodes[1], index / (nodes[0] * nodes[1])];
            // Two-dimensional flows are traced in the middle of the slab.
            UnitPoint(std::array::from_fn(|axis| if axis < dimensions { node[axis] as f32 / (nodes[axis] - 1) as f32 } else { 0.5 }))
        };
        let mut traced = Traced::default();
        let all = nodes.iter().product();
        if self.traced == 0 && Arc::get_mut(&mut self.values).is_none_or(|values| values.len() != all) {
            // A frame still renders with the old values, so the new ones get their own memory.
            self.values = Arc::new(vec![0.0; all]);
        }
        let end = all.min(self.traced.saturating_add(most));
        let (begin, work) = (self.traced, Work::begin("tracing the table"));
        for values in Arc::make_mut(&mut self.values)[self.traced..end].chunks_mut(TRACE_AT_ONCE) {
            let first = self.traced;
            let seeds: Vec<DomainPoint> = (0..values.len()).into_par_iter().map(|i| domain.from_unit(unit(first + i))).collect();
            tracer.trace(&seeds, Extras::default(), &mut traced)?;
            for (value, &traced) in values.iter_mut().zip(&traced.log_stretch) {
                // A NaN would spread to all adjacent cells. Zero stretch is the value of a particle at rest.
                *value = if traced.is_finite() { traced } else { 0.0 };
                self.not_finite += usize::from(!traced.is_finite());
            }
            self.traced += values.len();
            work.reached(self.traced - begin, end - begin);
        }
        Ok(self.traced == all)
    }

    /// Nodes along x, y, z.
    pub fn nodes(&self) -> [usize; 3] {
        self.nodes
    }

    /// Values at the nodes, x fastest.
    pub fn values(&self) -> &[f32] {
        &self.values
    }

    /// Nodes whose trace was not finite; they hold 0.
    pub fn not_finite(&self) -> usize {
        self.not_finite
    }

    /// Interpolates at eight points.
    fn lookup<const D: usize>(&self, values: &[f32], points: &[UnitPoint; 8]) -> [f32; 8] {
        let (zero, one) = (f32x8::splat(0.0), f32x8::splat(1.0));
        let mut base = i32x8::splat(0);
        let mut fraction = [zero; D];
        let mut stride = [0_usize; D];
        let mut step = 1;
        for axis in 0..D {
            let cells = (self.nodes[axis] - 1) as i32;
            let x = f32x8::from(std::array::from_fn(|lane| points[lane].0[axis]));
            let position = x.fast_max(zero).fast_min(one) * f32x8::splat(cells as f32);
            let cell = position.fast_trunc_int().max(i32x8::splat(0)).min(i32x8::splat(cells - 1));
            fraction[axis] = position - f32x8::from_i32x8(cell);
            base += cell * i32x8::splat(step as i32);
            stride[axis] = step;
            step *= self.nodes[axis];
        }
        let base = base.to_array();
        let corner = |offset: usize| f32x8::from(std::array::from_fn(|lane| values[base[lane] as usize + offset]));
        let along = |low: f32x8, high: f32x8, axis: usize| (high - low).mul_add(fraction[axis], low);
        let plane = |offset: usize| {
            let low = along(corner(offset), corner(offset + stride[0]), 0);
            along(low, along(corner(offset + stride[1]), corner(offset + stride[1] + stride[0]), 0), 1)
        };
        let value = if D == 2 { plane(0) } else { along(plane(0), plane(stride[D - 1]), D - 1) };
        value.to_array()
    }

    fn predict_chunk(&self, values: &[f32], points: &[UnitPoint], out: &mut [f32]) {
        for (points, out) in points.chunks(8).zip(out.chunks_mut(8)) {
            let mut eight = [UnitPoint::default(); 8];
            eight[..points.len()].copy_from_slice(points);
            let found = if self.dimensions == 2 { self.lookup::<2>(values, &eight) } else { self.lookup::<3>(values, &eight) };
            out.copy_from_slice(&found[..out.len()]);
        }
    }

    /// Writes the interpolated value at each unit point into `out` (same length). Points outside the domain take the value at its edge.
    pub fn interpolate(&self, points: &[UnitPoint], out: &mut [f32]) {
        assert_eq!(points.len(), out.len(), "one value a point");
        points.par_chunks(4096).zip(out.par_chunks_mut(4096)).for_each(|(points, out)| self.predict_chunk(&self.values, points, out));
    }

    /// Adds notes and values.
    pub(super) fn entries<'a>(&'a self, checkpoint: &mut Checkpoint<'a>) {
        checkpoint.note("table.nodes", format!("{:?}", self.nodes));
        checkpoint.note("table.not_finite", self.not_finite.to_string());
        checkpoint.push(Entry::new("table.values", &[self.nodes[2], self.nodes[1], self.nodes[0]], &*self.values));
    }

    /// The table with the values of a checkpoint.
    pub(super) fn restored(&self, checkpoint: &Checkpoint<'_>) -> Result<Self, CheckpointError> {
        checkpoint.expect_note("table.nodes", &format!("{:?}", self.nodes))?;
        let values = Arc::new(checkpoint.finite_values("table.values", self.nodes.iter().product())?);
        let (traced, not_finite) = (values.len(), checkpoint.number("table.not_finite")?);
        Ok(Self { nodes: self.nodes, dimensions: self.dimensions, values, traced, not_finite })
    }
}

impl Field for Table {
    fn values(&self, points: &[UnitPoint], out: &mut [f32]) {
        self.predict_chunk(&self.values, points, out);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ridgewatch_field::Domain;
    use ridgewatch_flow::Tracer;

    /// Log-stretch 1 + 2x + 3y + 4z in unit coordinates, NaN left of `hole`.
    struct Plane(Domain, f32);

    impl Tracer for Plane {
        fn domain(&self) -> &Domain {
            &self.0
        }
        fn start(&self) -> f64 {
            0.0
        }
        fn tau(&self) -> f64 {
            1.0
        }
        fn steps(&self) -> usize {
            1
        }
        fn trace(&self, seeds: &[DomainPoint], _: Extras, out: &mut Traced) {
            let value = |UnitPoint(p)| if p[0] < self.1 { f32::NAN } else { 1.0 + 2.0 * p[0] + 3.0 * p[1] + 4.0 * p[2] };
            out.log_stretch = seeds.iter().map(|&s| value(self.0.to_unit(s))).collect();
        }
    }

    fn points(count: u64) -> Vec<UnitPoint> {
        let random = |i| super::super::network::uniform(5, i);
        (0..count).map(|i| UnitPoint([random(3 * i), random(3 * i + 1), random(3 * i + 2)])).collect()
    }

    #[test]
    fn a_linear_field_is_exact_in_three_dimensions() {
        let tracer = Plane(Domain::cuboid([-1.0, 0.0, 2.0], [3.0, 1.0, 5.0]), -1.0);
        let table = Table::trace(&tracer, [5, 3, 4]).unwrap();
        let mut points = points(1003);
        points.push(UnitPoint([1.0; 3]));
        points.push(UnitPoint([0.0; 3]));
        let mut out = vec![0.0; points.len()];
        table.interpolate(&points, &mut out);
        for (p, value) in points.iter().zip(out) {
            // A few roundings of values up to 10.
            assert!((value - (1.0 + 2.0 * p.0[0] + 3.0 * p.0[1] + 4.0 * p.0[2])).abs() < 1e-5, "{p:?} {value}");
        }
        assert_eq!(table.values().len(), 5 * 3 * 4);
    }

    #[test]
    fn the_slab_axis_is_ignored_and_points_outside_are_clamped() {
        let tracer = Plane(Domain::slab([0.0, 0.0], [1.0, 1.0], (0.0, 1.0)), -1.0);
        let table = Table::trace(&tracer, [3, 3, 77]).unwrap();
        assert_eq!(table.nodes(), [3, 3, 1]);
        let mut out = [0.0; 4];
        table.interpolate(&[[0.5, 0.25, 0.0], [0.5, 0.25, 1.0], [2.0, -1.0, 0.0], [f32::NAN, 0.0, 0.0]].map(UnitPoint), &mut out);
        // The tracer sees the slab's middle: z = 0.5 adds 2. NaN is clamped like a point below the domain.
        assert_eq!(out, [4.75, 4.75, 5.0, 3.0]);
    }

    #[test]
    fn a_frozen_table_shares_its_values_until_the_window_slides() {
        let domain = Domain::slab([0.0, 0.0], [1.0, 1.0], (0.0, 1.0));
        let mut table = Table::trace(&Plane(domain.clone(), -1.0), [3, 3, 1]).unwrap();
        let frozen = table.clone();
        assert!(std::ptr::eq(frozen.values(), table.values()), "nothing is copied");
        let before = frozen.values().to_vec();
        // The new window has no value in the left half.
        table.retrace(&Plane(domain, 0.4)).unwrap();
        assert_eq!(frozen.values(), before, "what a frame renders with stays");
        assert_eq!((table.values()[0], table.values()[8]), (0.0, before[8]));
        let own = table.values().as_ptr();
        drop(frozen);
        table.retrace(&Plane(Domain::slab([0.0, 0.0], [1.0, 1.0], (0.0, 1.0)), -1.0)).unwrap();
        assert_eq!(table.values().as_ptr(), own, "with nobody else looking it is written in place");
    }

    #[test]
    fn a_table_that_is_traced_in_parts_is_the_same() {
        let tracer = Plane(Domain::slab([0.0, 0.0], [1.0, 1.0], (0.0, 1.0)), 0.3);
        let whole = Table::trace(&tracer, [7, 5, 1]).unwrap();
        let mut table = Table::untraced(&tracer.0, [7, 5, 1]);
        let parts: Vec<bool> = (0..4).map(|_| table.trace_more(&tracer, 10).unwrap()).collect();
        assert_eq!(parts, [false, false, false, true]);
        assert_eq!((table.values(), table.not_finite()), (whole.values(), whole.not_finite()));
        assert!(whole.not_finite() > 0);
    }

    #[test]
    fn nodes_without_a_value_are_counted() {
        let tracer = Plane(Domain::slab([0.0, 0.0], [1.0, 1.0], (0.0, 1.0)), 0.5);
        let table = Table::trace(&tracer, [5, 2, 1]).unwrap();
        assert_eq!(table.not_finite(), 4);
        assert!(table.values().iter().all(|v| v.is_finite()));
    }
}
