//! Properties of any grid and any decomposition: descriptions arrive unchanged over a ring and over a session; blocks of any shapes, in any order, join exactly
//! to the field; steps with lost blocks are abandoned by number. `RIDGEWATCH_PROPERTIES` sets the number of cases.

#![allow(clippy::unwrap_used)]

#[path = "support/folder.rs"]
mod folder;
#[path = "support/sessions.rs"]
mod sessions;

use folder::Folder;
use proptest::collection::vec;
use proptest::prelude::*;
use ridgewatch_wire::message::{Facts, Kind};
use ridgewatch_wire::{
    Assembler, AxisDescription, BlockExtent, Description, Element, Event, Field, Geometry, Incomplete, Limits, Policy, Producer,
    RingFollower, RingReader, Step,
};
use sessions::session;
use std::collections::BTreeSet;
use std::io::Cursor;
use std::time::Duration;

/// `usual` cases, times the number in the environment.
fn config(usual: u32) -> ProptestConfig {
    let times = std::env::var("RIDGEWATCH_PROPERTIES").ok().and_then(|n| n.parse().ok()).unwrap_or(1);
    // The same cases each time, and no file of failures.
    ProptestConfig {
        failure_persistence: None,
        rng_seed: prop::test_runner::RngSeed::Fixed(6),
        ..ProptestConfig::with_cases(usual * times)
    }
}

/// At most 64 bytes without control characters.
fn text() -> impl Strategy<Value = String> {
    vec(prop_oneof![Just('m'), Just('/'), Just(' '), Just('°'), Just('µ'), prop::char::range('!', '~')], 0..21).prop_map(String::from_iter)
}

/// Ascending coordinates from `first`, over at most `reach`.
fn axis(first: impl Strategy<Value = f64>, reach: Option<f64>) -> impl Strategy<Value = AxisDescription> {
    let period = prop::option::of(1e-6..10.0f64);
    (text(), text(), first, vec(1e-3..1e3f64, 1..40), period).prop_map(move |(name, unit, first, gaps, beyond)| {
        let sum: f64 = gaps.iter().sum();
        let scale = reach.map_or(1.0, |reach| reach / (1.01 * sum));
        let mut at = first;
        let mut coordinates = vec![at];
        for gap in gaps {
            at += gap * scale;
            coordinates.push(at);
        }
        let period = beyond.map(|beyond| (at - first) * (1.0 + beyond));
        AxisDescription { name, unit, coordinates, period }
    })
}

/// Any valid description, of the whole grid or a part of it.
fn description() -> impl Strategy<Value = Description> {
    let wide = || axis(-1e6..1e6f64, None).boxed();
    let cartesian = (Just(Geometry::Cartesian), vec(wide(), 2..=3));
    let globe = (axis(-720.0..360.0f64, Some(360.0)), axis(-90.0..0.0f64, Some(90.0)), prop::option::of(wide()));
    let globe = ((1.0..1e8f64).prop_map(|radius| Geometry::Sphere { radius }), globe)
        .prop_map(|(geometry, (longitude, latitude, height))| (geometry, [longitude, latitude].into_iter().chain(height).collect()));
    let part = (1..=65_536u32, any::<u32>(), prop::array::uniform3((0.0..1.0f64, 0.0..1.0f64)));
    (prop_oneof![cartesian.boxed(), globe.boxed()], text(), any::<u64>(), part).prop_map(
        |((geometry, axes), time_unit, start, (count, index, parts))| {
            let mut description = Description { start, ..Description::whole(geometry, axes, &time_unit) };
            if count > 1 {
                let shape = description.shape();
                let offset = std::array::from_fn(|k| (parts[k].0 * shape[k] as f64) as u64);
                let extent = std::array::from_fn(|k| 1 + (parts[k].1 * (shape[k] - offset[k]) as f64) as u64);
                description.block = BlockExtent { index: index % count, count, offset, extent };
            }
            description
        },
    )
}

#[test]
fn a_description_arrives_over_a_session_as_it_was_given() {
    let ends = std::cell::RefCell::new(session());
    proptest!(config(1000), |(given in description())| {
        prop_assert!(given.check(&Limits::default()).is_ok(), "{:?}", given.check(&Limits::default()));
        let (relay, follower) = &mut *ends.borrow_mut();
        let block = given.block.index;
        let facts = Facts { kind: Kind::Opened, block, generation: 1, step: 0, time: 0.0, published: 0, missed: 0 };
        let (mut bytes, mut found) = (Vec::new(), None);
        relay.send(&mut bytes, &facts, Some(&given), &[]).unwrap();
        let mut note = |_, announced| {
            found = announced;
            None
        };
        follower.receive(&mut Cursor::new(&bytes), &Limits::default(), &mut note, &mut Vec::new()).unwrap();
        prop_assert_eq!(found.unwrap(), given);
    });
}

#[test]
fn a_description_arrives_over_a_ring_as_it_was_given() {
    let folder = Folder::new("ring");
    proptest!(config(100), |(given in description(), slots in 2..5u32)| {
        let producer = Producer::open(&folder.0, given.clone(), slots, Policy::NewestWins).unwrap();
        let reader = RingReader::open(&folder.0, given.block.index, &Limits::default()).unwrap();
        prop_assert_eq!(&reader.header().description, &given);
        prop_assert_eq!(reader.header().slots, slots);
        drop(producer);
    });
}

/// Steps of a field in blocks, and the order of their blocks.
#[derive(Debug, Clone)]
struct Run {
    shape: Vec<u64>,
    /// Offset and extent of each block.
    blocks: Vec<([u64; 3], [u64; 3])>,
    steps: u64,
    /// The next block, once for each step of it: a rank publishes its steps in order.
    order: Vec<usize>,
    /// Steps and blocks that never arrive.
    lost: BTreeSet<(u64, usize)>,
}

/// A box that is repeatedly cut in two at random, with indices in random order.
fn run() -> impl Strategy<Value = Run> {
    let cuts = vec((any::<prop::sample::Index>(), 0..3usize, any::<prop::sample::Index>()), 1..12);
    (vec(2..10u64, 2..=3), cuts, 1..5u64)
        .prop_flat_map(|(shape, cuts, steps)| {
            let whole = std::array::from_fn(|k| shape.get(k).copied().unwrap_or(1));
            let mut blocks = vec![([0; 3], whole)];
            for (which, axis, place) in cuts {
                let (offset, extent) = blocks[which.index(blocks.len())];
                if extent[axis] < 2 {
                    continue;
                }
                let place = 1 + place.index(extent[axis] as usize - 1) as u64;
                let (mut before, mut behind, mut from) = (extent, extent, offset);
                before[axis] = place;
                behind[axis] -= place;
                from[axis] += place;
                let at = which.index(blocks.len());
                blocks[at].1 = before;
                blocks.push((from, behind));
            }
            let count = blocks.len();
            let order: Vec<usize> = (0..count * steps as usize).map(|n| n % count).collect();
            let lost = prop::collection::btree_set((0..steps, 0..count), 0..3);
            (Just(shape), Just(blocks).prop_shuffle(), Just(steps), Just(order).prop_shuffle(), lost)
        })
        .prop_map(|(shape, blocks, steps, order, lost)| Run { shape, blocks, steps, order, lost })
}

impl Run {
    fn description(&self, block: usize) -> Description {
        let axes = self.shape.iter().map(|n| AxisDescription::uniform("x", "m", 0.0, 1.0, *n)).collect();
        let mut description = Description { start: 9, ..Description::whole(Geometry::Cartesian, axes, "s") };
        let (offset, extent) = self.blocks[block];
        description.block = BlockExtent { index: block as u32, count: self.blocks.len() as u32, offset, extent };
        description
    }

    /// Values of a part of the field; each value encodes its place, component and step.
    fn values(&self, step: u64, offset: [u64; 3], extent: [u64; 3]) -> Vec<f32> {
        let mut values = Vec::new();
        for c in 0..self.shape.len() as u64 {
            for k in offset[2]..offset[2] + extent[2] {
                for j in offset[1]..offset[1] + extent[1] {
                    values.extend((offset[0]..offset[0] + extent[0]).map(|i| ((((step * 3 + c) * 10 + k) * 10 + j) * 10 + i) as f32));
                }
            }
        }
        values
    }

    /// Expected complete steps, and expected abandoned steps with their number of blocks.
    fn expected(&self) -> (Vec<u64>, Vec<(u64, u32)>) {
        let missing = |step: u64| self.lost.iter().filter(|(s, _)| *s == step).count();
        let whole = (0..self.steps).filter(|step| missing(*step) == 0).collect();
        let came = |step: u64| (step, (self.blocks.len() - missing(step)) as u32);
        let given_up = (0..self.steps).filter(|step| missing(*step) > 0).map(came).filter(|(_, came)| *came > 0).collect();
        (whole, given_up)
    }

    /// Compares the result with the expected one.
    fn judge(&self, whole: &[Step], mut given_up: Vec<Incomplete>) -> Result<(), TestCaseError> {
        let (steps, incomplete) = self.expected();
        prop_assert_eq!(whole.iter().map(|step| step.step).collect::<Vec<_>>(), steps);
        let shape = std::array::from_fn(|k| self.shape.get(k).copied().unwrap_or(1));
        for step in whole {
            prop_assert_eq!(step.time, step.step as f64);
            prop_assert_eq!(&step.values, &self.values(step.step, [0; 3], shape));
        }
        given_up.sort_by_key(|one| one.step);
        prop_assert!(given_up.iter().all(|one| one.wanted as usize == self.blocks.len()));
        prop_assert_eq!(given_up.iter().map(|one| (one.step, one.blocks)).collect::<Vec<_>>(), incomplete);
        Ok(())
    }
}

#[test]
fn blocks_of_any_decomposition_meet_exactly() {
    proptest!(config(1000), |(run in run())| {
        // The limit is zero: at the end every incomplete step has waited too long.
        let mut assembler = Assembler::new(&run.description(0), Duration::ZERO, 4);
        for block in 0..run.blocks.len() {
            assembler.introduce(&run.description(block), 1 + block as u64).unwrap();
        }
        let mut next = vec![0; run.blocks.len()];
        let mut whole = Vec::new();
        for block in run.order.iter().copied() {
            let step = next[block];
            next[block] += 1;
            if run.lost.contains(&(step, block)) {
                continue;
            }
            let (offset, extent) = run.blocks[block];
            let mut values = run.values(step, offset, extent);
            whole.extend(assembler.block(block as u32, 1 + block as u64, step, step as f64, 1 + step, &mut values).unwrap());
        }
        std::thread::sleep(Duration::from_nanos(1));
        assembler.expire();
        run.judge(&whole, assembler.incomplete())?;
    });
}

#[test]
fn blocks_of_any_decomposition_meet_through_rings() {
    let folder = Folder::new("blocks");
    proptest!(config(50), |(run in run())| {
        let mut follower = RingFollower::begin(&folder.0, Limits::default()).unwrap();
        // At most as many steps as a ring holds.
        let open = |block| Producer::open(&folder.0, run.description(block), 4, Policy::NewestWins).unwrap();
        let producers: Vec<Producer> = (0..run.blocks.len()).map(open).collect();
        let mut next = vec![0; run.blocks.len()];
        for block in run.order.iter().copied() {
            let step = next[block];
            next[block] += 1;
            if run.lost.contains(&(step, block)) {
                continue;
            }
            let (offset, extent) = run.blocks[block];
            let values = run.values(step, offset, extent);
            let components: Vec<*const u8> = values.chunks(values.len() / run.shape.len()).map(|c| c.as_ptr().cast()).collect();
            // SAFETY: as many values as the block has nodes, for each component.
            unsafe { producers[block].publish(step, step as f64, &Field::packed(&components, Element::F32, extent)).unwrap() };
        }
        drop(producers);
        let mut assembler = Assembler::new(&run.description(0), Duration::from_secs(60), 4);
        let (mut values, mut whole, mut given_up, mut open) = (Vec::new(), Vec::new(), Vec::new(), 0);
        let mut ended = false;
        while !ended {
            match follower.poll(&mut values) {
                Some(Event::Opened { description, generation }) => {
                    assembler.introduce(&description, generation).unwrap();
                    open += 1;
                }
                Some(Event::Step { block, generation, step, time, published, missed }) => {
                    prop_assert_eq!(missed, 0);
                    whole.extend(assembler.block(block, generation, step, time, published, &mut values).unwrap());
                    given_up.extend(assembler.incomplete());
                }
                Some(Event::Ended { block, generation, .. }) => ended = assembler.ended(block, generation),
                Some(Event::Refused(error)) => panic!("{error}"),
                None => std::thread::yield_now(),
            }
        }
        prop_assert_eq!(open, run.blocks.len());
        // Steps that still wait would be abandoned after a minute; the others are as expected.
        let waiting: BTreeSet<u64> = given_up.iter().map(|one: &Incomplete| one.step).collect();
        let (_, incomplete) = run.expected();
        prop_assert!(incomplete.iter().filter(|(step, _)| !waiting.contains(step)).all(|(step, _)| whole.iter().all(|w| w.step < *step)));
        for (step, blocks) in incomplete.into_iter().filter(|(step, _)| !waiting.contains(step)) {
            given_up.push(Incomplete { step, time: step as f64, blocks, wanted: run.blocks.len() as u32, why: "not reported yet" });
        }
        run.judge(&whole, given_up)?;
    });
}
