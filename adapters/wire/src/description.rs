//! Description of a published field: the global grid, and the producer's block of it.

use crate::WireError;
use crate::bytes::{Parser, Writer};

/// Most nodes of an axis.
pub const AXIS_NODES: u64 = 1 << 20;
/// Most bytes of a name or unit.
pub const TEXT: usize = 64;
/// Most blocks of a decomposed domain.
pub(crate) const BLOCKS: u32 = 1 << 16;

/// Metric of the coordinates.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Geometry {
    /// Coordinates are lengths; velocities are along the axes, in coordinate units per time unit.
    Cartesian,
    /// Axes 0 and 1 are longitude and latitude in degrees, velocities are eastward, northward and upward, in the radius's unit per time unit.
    Sphere {
        /// Radius, in a length unit.
        radius: f64,
    },
}

/// One axis of the global grid.
#[derive(Debug, Clone, PartialEq)]
pub struct AxisDescription {
    /// For example `x`.
    pub name: String,
    /// For example `m`.
    pub unit: String,
    /// Strictly ascending.
    pub coordinates: Vec<f64>,
    /// Period of the axis; the last node is not the periodic image of the first.
    pub period: Option<f64>,
}

impl AxisDescription {
    /// `nodes` nodes from `first` to `last`, evenly spaced.
    pub fn uniform(name: &str, unit: &str, first: f64, last: f64, nodes: u64) -> Self {
        Self { name: name.into(), unit: unit.into(), coordinates: even(first, last, nodes).collect(), period: None }
    }

    fn check(&self) -> Result<(), WireError> {
        let nodes = self.coordinates.len() as u64;
        if !(2..=AXIS_NODES).contains(&nodes) {
            return Err(WireError::field("axis.nodes", nodes, format!("2 to {AXIS_NODES}")));
        }
        if let Some(odd) = self.coordinates.iter().find(|c| !c.is_finite()) {
            return Err(WireError::field("axis.coordinates", odd, "finite numbers"));
        }
        if let Some(turn) = self.coordinates.windows(2).find(|w| w[1] <= w[0]) {
            return Err(WireError::field("axis.coordinates", format_args!("{} after {}", turn[1], turn[0]), "strictly ascending numbers"));
        }
        for (field, text) in [("axis.name", &self.name), ("axis.unit", &self.unit)] {
            check_text(field, text)?;
        }
        let reach = self.coordinates[self.coordinates.len() - 1] - self.coordinates[0];
        match self.period {
            // The tolerance covers rounded coordinates.
            Some(period) if !(period.is_finite() && period >= reach * (1.0 + 1e-9)) => {
                Err(WireError::field("axis.period", period, format!("a length above {reach}, the distance from first to last node")))
            }
            _ => Ok(()),
        }
    }

    fn encode(&self, out: &mut Writer) {
        out.text(&self.name);
        out.text(&self.unit);
        out.f64(self.period.unwrap_or(0.0));
        out.u64(self.coordinates.len() as u64);
        self.coordinates.iter().for_each(|c| out.f64(*c));
    }

    fn decode(input: &mut Parser) -> Result<Self, WireError> {
        let (name, unit) = (input.text("axis.name", TEXT)?, input.text("axis.unit", TEXT)?);
        let period = input.f64()?;
        let nodes = input.u64()?;
        if !(2..=AXIS_NODES).contains(&nodes) {
            return Err(WireError::field("axis.nodes", nodes, format!("2 to {AXIS_NODES}")));
        }
        // The memory is bounded by the bytes received.
        let bytes = input.take(nodes as usize * 8)?;
        let coordinates = bytes.as_chunks::<8>().0.iter().map(|c| f64::from_le_bytes(*c)).collect();
        let axis = Self { name, unit, coordinates, period: (period != 0.0).then_some(period) };
        axis.check()?;
        Ok(axis)
    }
}

/// Checks a name or unit. The error does not repeat one that is too long.
fn check_text(field: &'static str, text: &str) -> Result<(), WireError> {
    let accepted = || format!("at most {TEXT} bytes without control characters");
    if text.len() > TEXT {
        return Err(WireError::field(field, format_args!("{} bytes long", text.len()), accepted()));
    }
    match text.chars().any(char::is_control) {
        true => Err(WireError::field(field, format_args!("{text:?}"), accepted())),
        false => Ok(()),
    }
}

/// Coordinates of `nodes` nodes from `first` to `last`, evenly spaced. An iterator, so that the caller can reserve memory that may fail.
pub fn even(first: f64, last: f64, nodes: u64) -> impl ExactSizeIterator<Item = f64> {
    let step = (last - first) / nodes.saturating_sub(1).max(1) as f64;
    // At most one more than an axis may have, so that the check refuses it.
    (0..nodes.min(AXIS_NODES + 1) as usize).map(move |i| if i as u64 + 1 == nodes { last } else { first + step * i as f64 })
}

/// A producer's part of the global grid.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BlockExtent {
    /// Index, from 0.
    pub index: u32,
    /// Number of blocks.
    pub count: u32,
    /// First node along x, y, z.
    pub offset: [u64; 3],
    /// Nodes along x, y, z (1 in z if the grid is two-dimensional).
    pub extent: [u64; 3],
}

impl BlockExtent {
    /// Returns true if two blocks share a node.
    pub fn overlaps(&self, other: &Self) -> bool {
        (0..3).all(|k| self.offset[k] < other.offset[k] + other.extent[k] && other.offset[k] < self.offset[k] + self.extent[k])
    }
}

/// Description of a published field.
#[derive(Debug, Clone, PartialEq)]
pub struct Description {
    /// Metric of the coordinates.
    pub geometry: Geometry,
    /// A number that all blocks of one start of the simulation share, and another start does not; 0 if none was given.
    pub start: u64,
    /// Two or three axes of the global grid. The velocity has as many components.
    pub axes: Vec<AxisDescription>,
    /// This producer's block.
    pub block: BlockExtent,
    /// Unit of the steps' times, for display. With `s`, tau may be given in words.
    pub time_unit: String,
}

/// Memory limits of a reader.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// Most bytes of one step of the global field (4 bytes per component and node).
    pub step_bytes: u64,
}

impl Default for Limits {
    /// 16 GiB per step.
    fn default() -> Self {
        Self { step_bytes: 16 << 30 }
    }
}

impl Description {
    /// The whole grid as one block.
    pub fn whole(geometry: Geometry, axes: Vec<AxisDescription>, time_unit: &str) -> Self {
        let extent = std::array::from_fn(|k| axes.get(k).map_or(1, |a| a.coordinates.len() as u64));
        let block = BlockExtent { index: 0, count: 1, offset: [0; 3], extent };
        Self { geometry, start: 0, axes, block, time_unit: time_unit.into() }
    }

    /// Number of components of the velocity, which is the number of axes.
    pub fn components(&self) -> usize {
        self.axes.len()
    }

    /// Nodes of the global grid along x, y, z (1 in z if the grid is two-dimensional).
    pub fn shape(&self) -> [u64; 3] {
        std::array::from_fn(|k| self.axes.get(k).map_or(1, |a| a.coordinates.len() as u64))
    }

    /// Number of nodes of this block; exact after [`Description::check`].
    pub fn block_nodes(&self) -> u64 {
        self.block.extent.iter().fold(1, |n, e| n.saturating_mul(*e))
    }

    /// Bytes of one step of this block.
    pub fn block_bytes(&self) -> u64 {
        self.block_nodes().saturating_mul(4 * self.components() as u64)
    }

    /// Returns true if two descriptions have the same global grid and unit of time.
    pub fn same_grid(&self, other: &Self) -> bool {
        (self.geometry, &self.axes, &self.time_unit) == (other.geometry, &other.axes, &other.time_unit)
    }

    /// Checks all values.
    ///
    /// # Errors
    /// The first invalid value, or a field larger than `limits`.
    pub fn check(&self, limits: &Limits) -> Result<(), WireError> {
        if !(2..=3).contains(&self.axes.len()) {
            return Err(WireError::field("axes", self.axes.len(), "2 or 3"));
        }
        self.axes.iter().try_for_each(AxisDescription::check)?;
        if let Geometry::Sphere { radius } = self.geometry {
            if !(radius.is_finite() && radius > 0.0) {
                return Err(WireError::field("radius", radius, "a number above 0"));
            }
            let ends = |k: usize| (self.axes[k].coordinates[0], self.axes[k].coordinates[self.axes[k].coordinates.len() - 1]);
            let ((west, east), (south, north)) = (ends(0), ends(1));
            if !(-720.0..=720.0).contains(&west) || east - west > 360.0 + 1e-6 || east > 720.0 {
                return Err(WireError::field("longitude", format_args!("{west} to {east}"), "degrees, at most once around"));
            }
            if south < -90.0 - 1e-6 || north > 90.0 + 1e-6 {
                return Err(WireError::field("latitude", format_args!("{south} to {north}"), "-90 to 90 degrees"));
            }
        }
        check_text("time_unit", &self.time_unit)?;
        let shape = self.shape();
        // At most 2^20 nodes per axis, so there is no overflow.
        let bytes = shape.iter().product::<u64>() as u128 * 4 * self.components() as u128;
        if bytes > u128::from(limits.step_bytes) {
            let needed = bytes.min(u128::from(u64::MAX)) as u64;
            return Err(WireError::TooLarge { what: "a step of the field", needed, limit: limits.step_bytes });
        }
        let block = &self.block;
        if !(1..=BLOCKS).contains(&block.count) || block.index >= block.count {
            let found = format!("{} of {}", block.index, block.count);
            return Err(WireError::field("block", found, format!("an index below the count, which is 1 to {BLOCKS}")));
        }
        for k in 0..3 {
            let end = block.offset[k].checked_add(block.extent[k]);
            if block.extent[k] == 0 || end.is_none_or(|end| end > shape[k]) {
                let found = format!("{} nodes from {} along axis {k}", block.extent[k], block.offset[k]);
                return Err(WireError::field("block", found, format!("a part of the grid's {} nodes", shape[k])));
            }
        }
        if block.count == 1 && block.extent != shape {
            return Err(WireError::field("block", format_args!("{:?} nodes", block.extent), format!("all {shape:?}, as the only block")));
        }
        Ok(())
    }

    /// Bytes of the encoded description.
    fn encoded_bytes(&self) -> usize {
        let axis = |a: &AxisDescription| 24 + a.name.len() + a.unit.len() + 8 * a.coordinates.len();
        84 + self.time_unit.len() + self.axes.iter().map(axis).sum::<usize>()
    }

    /// # Errors
    /// There is no memory.
    pub(crate) fn encode(&self) -> Result<Vec<u8>, WireError> {
        let mut out = Writer::default();
        let bytes = self.encoded_bytes();
        out.0.try_reserve_exact(bytes).map_err(|_| WireError::no_memory(bytes))?;
        let (kind, radius) = match self.geometry {
            Geometry::Cartesian => (0, 0.0),
            Geometry::Sphere { radius } => (1, radius),
        };
        out.u32(kind);
        out.u32(self.axes.len() as u32);
        out.f64(radius);
        out.u64(self.start);
        out.u32(self.block.index);
        out.u32(self.block.count);
        out.three(self.block.offset);
        out.three(self.block.extent);
        out.text(&self.time_unit);
        self.axes.iter().for_each(|axis| axis.encode(&mut out));
        debug_assert_eq!(out.0.len(), bytes);
        Ok(out.0)
    }

    pub(crate) fn decode(bytes: &[u8], limits: &Limits) -> Result<Self, WireError> {
        let mut input = Parser::new("the description", bytes);
        let (kind, axes, radius, start) = (input.u32()?, input.u32()?, input.f64()?, input.u64()?);
        let geometry = match kind {
            0 => Geometry::Cartesian,
            1 => Geometry::Sphere { radius },
            other => return Err(WireError::field("geometry", other, "0 (Cartesian) or 1 (sphere)")),
        };
        if !(2..=3).contains(&axes) {
            return Err(WireError::field("axes", axes, "2 or 3"));
        }
        let block = BlockExtent { index: input.u32()?, count: input.u32()?, offset: input.three()?, extent: input.three()? };
        let time_unit = input.text("time_unit", TEXT)?;
        let axes = (0..axes).map(|_| AxisDescription::decode(&mut input)).collect::<Result<_, _>>()?;
        input.end()?;
        let description = Self { geometry, start, axes, block, time_unit };
        description.check(limits)?;
        Ok(description)
    }
}
