//! Tests of the ring through its files: published steps are read, and invalid values are refused by name.

#![allow(clippy::unwrap_used, clippy::print_stdout)]

mod assembling;
mod cleaning;
#[path = "../support/folder.rs"]
mod folder;
mod following;
mod opening;
mod publishing;

use folder::Folder;
use ridgewatch_wire::{AxisDescription, Description, Element, Field, Geometry, Producer, Read, RingReader, WireError};
use std::os::unix::fs::FileExt;
use std::path::Path;

fn cube(nodes: [u64; 3]) -> Description {
    let axis = |name, n| AxisDescription::uniform(name, "m", 0.0, 1.0, n);
    Description::whole(Geometry::Cartesian, vec![axis("x", nodes[0]), axis("y", nodes[1]), axis("z", nodes[2])], "s")
}

/// u = 1000 c + node + 10^6 step.
fn values(description: &Description, step: u64) -> Vec<Vec<f32>> {
    let nodes = description.block_nodes() as usize;
    (0..description.components()).map(|c| (0..nodes).map(|i| (1_000_000 * step as usize + 1000 * c + i) as f32).collect()).collect()
}

fn publish(producer: &Producer, step: u64, time: f64) -> Result<ridgewatch_wire::Published, WireError> {
    let values = values(producer.description(), step);
    let pointers: Vec<*const u8> = values.iter().map(|v| v.as_ptr().cast()).collect();
    let field = Field::packed(&pointers, Element::F32, producer.description().block.extent);
    // SAFETY: the vectors have one value per node.
    unsafe { producer.publish(step, time, &field) }
}

fn step(reader: &mut RingReader, buffer: &mut Vec<f32>) -> Option<ridgewatch_wire::StepInfo> {
    match reader.read(buffer).unwrap() {
        Read::Step(info) => Some(info),
        _ => None,
    }
}

fn overwrite(path: &Path, offset: u64, bytes: &[u8]) {
    std::fs::OpenOptions::new().write(true).open(path).unwrap().write_all_at(bytes, offset).unwrap();
}
