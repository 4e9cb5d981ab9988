//! A ring of any bytes is read or refused: no panic, no memory beyond the limit.
#![no_main]

mod support;

use libfuzzer_sys::fuzz_target;
use ridgewatch_wire::{
    AxisDescription, Description, Element, Field, Geometry, Limits, Policy, Producer, Read, ReadAt, RingReader, block_path,
};
use std::io::{ErrorKind, Result};
use std::sync::OnceLock;

/// Bytes of the largest step that is read.
const STEP_BYTES: u64 = 1 << 16;

struct Bytes(Vec<u8>);

impl ReadAt for Bytes {
    fn length(&self) -> Result<u64> {
        Ok(self.0.len() as u64)
    }

    fn read_at(&self, to: &mut [u8], offset: u64) -> Result<()> {
        let from = usize::try_from(offset).ok().and_then(|begin| self.0.get(begin..)?.get(..to.len()));
        to.copy_from_slice(from.ok_or(ErrorKind::UnexpectedEof)?);
        Ok(())
    }

    fn write_at(&self, _: &[u8], _: u64) -> Result<()> {
        Ok(())
    }
}

/// A ring of three slots after five steps.
fn good() -> Vec<u8> {
    let folder = std::path::PathBuf::from("/dev/shm").join(format!("rw-fuzz-{}", std::process::id()));
    let axis = |name, nodes| AxisDescription::uniform(name, "m", 0.0, 1.0, nodes);
    let description = Description::whole(Geometry::Sphere { radius: 6.371e6 }, vec![axis("lon", 5), axis("lat", 4), axis("z", 3)], "s");
    let producer = Producer::open(&folder, description, 3, Policy::NewestWins).expect("/dev/shm");
    let values = [1.0f32; 60];
    let field = [values.as_ptr().cast::<u8>(); 3];
    for step in 0..5 {
        // SAFETY: each component has 60 values, as described.
        unsafe { producer.publish(step, step as f64, &Field::packed(&field, Element::F32, [5, 4, 3])) }.expect("a step");
    }
    std::fs::read(block_path(&folder, 0)).expect("its file")
}

/// Corrects the checksum, so that changes reach the checks behind it.
fn repair(bytes: &mut [u8]) {
    let Some(length) = bytes.get(12..16).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]) as usize) else { return };
    let Some(description) = 8192usize.checked_add(length).and_then(|end| bytes.get(8192..end)) else { return };
    let mix = |sum: u64, byte: &u8| (sum ^ u64::from(*byte)).wrapping_mul(0x0000_0100_0000_01b3);
    let sum = bytes[..72].iter().chain(description).fold(0xcbf2_9ce4_8422_2325, mix);
    bytes[72..80].copy_from_slice(&sum.to_le_bytes());
}

fuzz_target!(|input: &[u8]| {
    static GOOD: OnceLock<Vec<u8>> = OnceLock::new();
    let mut bytes = support::file(GOOD.get_or_init(good), input);
    if input.first().is_some_and(|kind| kind & 2 == 0) {
        repair(&mut bytes);
    }
    let Ok(mut reader) = RingReader::over("fuzzed".into(), Bytes(bytes), &Limits { step_bytes: STEP_BYTES }) else { return };
    let mut values = Vec::new();
    for _ in 0..8 {
        match reader.read(&mut values) {
            Ok(Read::Step(info)) => {
                assert!(info.time.is_finite());
                assert_eq!(values.len() as u64 * 4, reader.header().description.block_bytes());
            }
            Ok(_) | Err(_) => break,
        }
    }
    assert!(values.capacity() as u64 * 4 <= 2 * STEP_BYTES);
});
