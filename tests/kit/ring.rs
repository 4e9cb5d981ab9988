//! Rings in shared memory and the simulations that publish into them.

use ridgewatch_wire::{AxisDescription, BlockExtent, Description, Element, Field, Geometry, Producer, Published};
use std::path::{Path, PathBuf};

/// A folder of shared memory, removed at the end of its test.
pub struct Ring(pub PathBuf);

impl Ring {
    pub fn new(name: &str) -> Self {
        let path = PathBuf::from("/dev/shm").join(format!("rw-{name}-{}", std::process::id()));
        let _ = std::fs::remove_dir_all(&path);
        Self(path)
    }
}

impl Drop for Ring {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

/// A grid over one metre along each axis.
pub fn grid(nodes: &[u64]) -> Description {
    let axes = ["x", "y", "z"].into_iter().zip(nodes).map(|(name, nodes)| AxisDescription::uniform(name, "m", 0.0, 1.0, *nodes));
    Description::whole(Geometry::Cartesian, axes.collect(), "s")
}

/// Descriptions of the blocks of a plane of `nodes` x `nodes`, cut into columns.
pub fn columns(nodes: u64, count: u32) -> Vec<Description> {
    let width = nodes / u64::from(count);
    let block = |index: u32| BlockExtent { index, count, offset: [width * u64::from(index), 0, 0], extent: [width, nodes, 1] };
    (0..count).map(|index| Description { start: 1, block: block(index), ..grid(&[nodes; 2]) }).collect()
}

/// Publishes a step with one value a node of the block for each component.
pub fn publish(producer: &Producer, step: u64, time: f64, components: &[&[f32]]) -> Published {
    let block = &producer.description().block;
    assert!(components.iter().all(|values| values.len() as u64 == producer.description().block_nodes()));
    let pointers: Vec<*const u8> = components.iter().map(|values| values.as_ptr().cast()).collect();
    // SAFETY: each component has a value for each node of the block.
    unsafe { producer.publish(step, time, &Field::packed(&pointers, Element::F32, block.extent)).unwrap() }
}
