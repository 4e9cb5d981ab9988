//! Tests of joining blocks, and of starts that replace one another.

use super::{cube, values};
use ridgewatch_wire::{Assembler, BlockExtent, Description, Incomplete, Step};
use std::collections::VecDeque;
use std::time::Duration;

/// Columns of a grid of 4 x 3 x 2 nodes, with the given widths.
fn columns(start: u64, widths: &[u64]) -> Vec<Description> {
    let (mut left, count) = (0, widths.len() as u32);
    let column = |(index, width): (usize, &u64)| {
        let block = BlockExtent { index: index as u32, count, offset: [left, 0, 0], extent: [*width, 3, 2] };
        left += width;
        Description { start, block, ..cube([4, 3, 2]) }
    };
    widths.iter().enumerate().map(column).collect()
}

/// A block of step `n`, whose values differ from those of every other step.
fn cut(block: &Description, n: u64) -> Vec<f32> {
    let [begin, width] = [block.block.offset[0], block.block.extent[0]].map(|n| n as usize);
    values(&cube([4, 3, 2]), n).concat().chunks_exact(4).flat_map(|row| row[begin..begin + width].to_vec()).collect()
}

/// Adds a block of step `n` at time n / 2, published after all openings.
fn give(assembler: &mut Assembler, block: &Description, generation: u64, n: u64) -> Option<Step> {
    assembler.block(block.block.index, generation, n, n as f64 / 2.0, 1000 + n, &mut cut(block, n)).unwrap()
}

fn numbers(given_up: &[Incomplete]) -> Vec<u64> {
    given_up.iter().map(|g| g.step).collect()
}

#[test]
fn blocks_meet_and_what_does_not_fit_is_told() {
    let [left, right] = [0, 1].map(|k| columns(0, &[1, 3])[k].clone());
    let mut assembler = Assembler::new(&left, Duration::from_millis(30), 2);
    assembler.introduce(&left, 1).unwrap();
    assert_eq!(give(&mut assembler, &right, 1, 0), None, "the block was not introduced");
    let stranger = Description { axes: cube([4, 3, 3]).axes, ..right.clone() };
    assert!(assembler.introduce(&stranger, 1).unwrap_err().to_string().contains("another grid"));
    let short = Description { block: BlockExtent { offset: [2, 0, 0], extent: [2, 3, 2], ..right.block }, ..right.clone() };
    assert!(assembler.introduce(&short, 1).unwrap_err().to_string().contains("18 of 24 nodes"));
    assembler.introduce(&right, 2).unwrap();
    // Either order.
    assert_eq!(give(&mut assembler, &right, 2, 1), None);
    let whole = give(&mut assembler, &left, 1, 1).unwrap();
    assert_eq!((whole.step, whole.time, whole.published, whole.anew), (1, 0.5, 1001, true));
    assert_eq!(whole.values, values(&cube([4, 3, 2]), 1).concat());
    // Another time, another length.
    assert_eq!(give(&mut assembler, &left, 1, 2), None);
    let other = assembler.block(1, 2, 2, 1.5, 1002, &mut cut(&right, 2)).unwrap_err().to_string();
    assert!(other.contains("the time of its other blocks"));
    assert!(assembler.block(1, 2, 2, 1.0, 0, &mut cut(&left, 2)).unwrap_err().to_string().contains("18 values"));
    // A step that lacks a block is abandoned when a newer one is complete,
    assert_eq!(give(&mut assembler, &left, 1, 3), None);
    let whole = give(&mut assembler, &right, 2, 3).unwrap();
    assert_eq!((whole.step, whole.anew), (3, false));
    let given_up = assembler.incomplete();
    assert_eq!((given_up.len(), given_up[0].step, given_up[0].blocks, given_up[0].wanted), (1, 2, 1, 2));
    assert_eq!(give(&mut assembler, &right, 2, 2), None, "too late");
    // when it has waited too long,
    assert_eq!(give(&mut assembler, &left, 1, 4), None);
    std::thread::sleep(Duration::from_millis(40));
    // Times in which no block was taken do not count.
    assembler.held(Duration::from_secs(60));
    assembler.expire();
    assert!(assembler.incomplete().is_empty());
    assert_eq!(give(&mut assembler, &right, 2, 4).unwrap().step, 4);
    assert_eq!(give(&mut assembler, &left, 1, 5), None);
    std::thread::sleep(Duration::from_millis(40));
    assembler.expire();
    assert_eq!(assembler.incomplete()[0].why, "blocks did not arrive in time");
    // and when too many steps wait.
    let ahead = (6..10).map(|n| {
        assert_eq!(give(&mut assembler, &left, 1, n), None);
        assembler.is_ahead(0, 1)
    });
    assert_eq!(ahead.collect::<Vec<_>>(), [true; 4], "one more than this one is all that may wait");
    assert!(!assembler.is_ahead(1, 2) && !assembler.is_ahead(1, 1));
    assert_eq!(numbers(&assembler.incomplete()), [6, 7]);
    // Steps that cannot become complete are abandoned first: the other block has reached a later one.
    assert_eq!(give(&mut assembler, &right, 2, 10), None);
    assert_eq!(numbers(&assembler.incomplete()), [8]);
    assert_eq!(give(&mut assembler, &left, 1, 11), None);
    assert_eq!(numbers(&assembler.incomplete()), [9], "step 10 may still become complete");
    // Before the limit a step is kept.
    let mut patient = Assembler::new(&left, Duration::from_secs(3600), 2);
    patient.introduce(&left, 1).unwrap();
    assert_eq!(give(&mut patient, &left, 1, 1), None);
    std::thread::sleep(Duration::from_millis(40));
    patient.expire();
    assert!(patient.incomplete().is_empty());
}

#[test]
fn another_start_takes_over_with_its_first_whole_step() {
    for starts in [[1, 2, 3], [0, 0, 0]] {
        let [four, two, one] = [columns(starts[0], &[1, 1, 1, 1]), columns(starts[1], &[2, 2]), columns(starts[2], &[4])];
        let mut assembler = Assembler::new(&four[0], Duration::from_secs(60), 8);
        four.iter().for_each(|block| assembler.introduce(block, 10).unwrap());
        let whole = |assembler: &mut Assembler, blocks: &[Description], generation, n| {
            blocks.iter().filter_map(|block| give(assembler, block, generation, n)).next()
        };
        assert_eq!(whole(&mut assembler, &four, 10, 57).unwrap().step, 57);
        assert_eq!(whole(&mut assembler, &four[..3], 10, 58), None);
        // It was killed during a step, and returns in two blocks, from step 40 on. The first of them alone changes nothing.
        assembler.introduce(&two[0], 20).unwrap();
        assert_eq!(give(&mut assembler, &two[0], 20, 40), None);
        assert_eq!(whole(&mut assembler, &four[..3], 10, 59), None);
        assert!(assembler.incomplete().is_empty());
        assembler.introduce(&two[1], 21).unwrap();
        let step = give(&mut assembler, &two[1], 21, 40).unwrap();
        assert_eq!((step.step, step.anew), (40, true));
        assert_eq!(step.values, values(&cube([4, 3, 2]), 40).concat());
        let given_up = assembler.incomplete();
        assert_eq!(numbers(&given_up), [58, 59]);
        assert!(given_up.iter().all(|g| (g.blocks, g.wanted, g.why) == (3, 4, "the simulation was restarted")));
        // The remainder of the first start is ignored.
        assert_eq!(give(&mut assembler, &four[3], 10, 58), None);
        assert!(!assembler.ended(0, 20));
        assert_eq!(whole(&mut assembler, &two, 20, 41), None, "block 1 was opened at 21");
        assert_eq!(give(&mut assembler, &two[1], 21, 41).map(|s| (s.step, s.anew)), Some((41, false)));
        // Then it returns in one block.
        assert!(assembler.ended(1, 21), "all blocks of the start that is followed");
        assembler.introduce(&one[0], 30).unwrap();
        assert!(!assembler.ended(0, 20));
        assert_eq!(give(&mut assembler, &one[0], 30, 3).map(|s| (s.step, s.anew)), Some((3, true)));
        // Then in four again, under its earlier start number.
        four.iter().for_each(|block| assembler.introduce(block, 40).unwrap());
        assert_eq!(whole(&mut assembler, &four, 40, 4).map(|s| (s.step, s.anew)), Some((4, true)));
    }
}

#[test]
fn a_start_in_the_same_blocks_takes_nothing_of_the_one_before() {
    let blocks = columns(0, &[2, 2]);
    let mut assembler = Assembler::new(&blocks[0], Duration::from_secs(60), 4);
    blocks.iter().for_each(|block| assembler.introduce(block, 1).unwrap());
    assert_eq!(give(&mut assembler, &blocks[0], 1, 5), None);
    // Both were killed. A step of the old second block arrives between the openings of the new ones.
    assembler.introduce(&blocks[0], 2).unwrap();
    assert_eq!(numbers(&assembler.incomplete()), [5]);
    assert_eq!(give(&mut assembler, &blocks[1], 1, 9), None);
    assembler.introduce(&blocks[1], 3).unwrap();
    assert_eq!(numbers(&assembler.incomplete()), [9]);
    assert_eq!(give(&mut assembler, &blocks[0], 2, 0), None);
    assert_eq!(give(&mut assembler, &blocks[1], 1, 0), None, "of the killed block");
    assert_eq!(give(&mut assembler, &blocks[1], 3, 0).map(|s| s.anew), Some(true));
    // A restored connection is no start.
    assembler.introduce(&blocks[1], 3).unwrap();
    assert_eq!(give(&mut assembler, &blocks[0], 2, 1), None);
    assert_eq!(give(&mut assembler, &blocks[1], 3, 1).map(|s| s.anew), Some(false));
}

#[test]
fn blocks_of_as_many_in_other_places_displace_those_that_they_overlap() {
    let [columns, rows] = [columns(0, &[2, 2]), {
        let row = |index: u32, from, extent| BlockExtent { index, count: 2, offset: [0, from, 0], extent: [4, extent, 2] };
        [row(0, 0, 1), row(1, 1, 2)].map(|block| Description { block, ..cube([4, 3, 2]) }).to_vec()
    }];
    let mut assembler = Assembler::new(&columns[0], Duration::from_secs(60), 4);
    columns.iter().for_each(|block| assembler.introduce(block, 1).unwrap());
    // The second block lives as far as is known: blocks of one start with ghost cells would overlap like this.
    assembler.ended(0, 1);
    let error = assembler.introduce(&rows[0], 2).unwrap_err().to_string();
    assert!(error.contains("overlaps block 1") && error.contains("ghost cells"), "{error}");
    assembler.introduce(&rows[1], 2).unwrap();
    let row = |n: u64, block: &Description| {
        let [from, extent] = [block.block.offset[1], block.block.extent[1]].map(|n| 4 * n as usize);
        values(&cube([4, 3, 2]), n).concat().chunks_exact(12).flat_map(|plane| plane[from..from + extent].to_vec()).collect::<Vec<_>>()
    };
    assert_eq!(assembler.block(0, 2, 7, 1.0, 0, &mut row(7, &rows[0])).unwrap(), None);
    let whole = assembler.block(1, 2, 7, 1.0, 0, &mut row(7, &rows[1])).unwrap().unwrap();
    assert_eq!(whole.values, values(&cube([4, 3, 2]), 7).concat());
}

#[test]
fn starts_that_never_come_whole_are_bounded() {
    let mut assembler = Assembler::new(&columns(1, &[2, 2])[0], Duration::from_secs(60), 8);
    for start in 1..100 {
        let block = &columns(start, &[2, 2])[0];
        assembler.introduce(block, start).unwrap();
        assert_eq!(give(&mut assembler, block, start, 0), None);
    }
    // The followed first start and the newest three are left.
    assert_eq!(assembler.incomplete().len(), 95);
    for (start, whole) in [(1, true), (50, false), (99, true)] {
        let block = &columns(start, &[2, 2])[1];
        assembler.introduce(block, start).unwrap();
        assert_eq!(give(&mut assembler, block, start, 0).is_some(), whole, "{start}");
    }
}

#[test]
fn a_block_that_is_the_whole_field_is_handed_on_and_not_copied() {
    let grid = cube([4, 3, 2]);
    let mut assembler = Assembler::new(&grid, Duration::from_secs(1), 2);
    assembler.introduce(&grid, 1).unwrap();
    let mut buffer = values(&grid, 1).concat();
    let (address, expected) = (buffer.as_ptr(), buffer.clone());
    let step = assembler.block(0, 1, 1, 0.5, 9, &mut buffer).unwrap().unwrap();
    assert_eq!((step.step, step.time, step.published), (1, 0.5, 9));
    assert_eq!(step.values, expected);
    assert_eq!(step.values.as_ptr(), address);
    assembler.recycle(step.values);
    // Repeated steps and wrong lengths stay with the caller.
    let mut buffer = values(&grid, 2).concat();
    assert_eq!(assembler.block(0, 1, 1, 0.5, 9, &mut buffer).unwrap(), None);
    assert!(assembler.block(0, 1, 2, 0.5, 9, &mut vec![0.0; 7]).unwrap_err().to_string().contains("7 values"));
    assert_eq!(buffer, values(&grid, 2).concat());
    assembler.block(0, 1, 2, 0.6, 10, &mut buffer).unwrap();
    assert_eq!(buffer.as_ptr(), address, "the first step's buffer is used again");
}

#[test]
fn a_solver_of_one_block_that_is_set_back_is_followed_by_when_it_published() {
    let grid = cube([4, 3, 2]);
    let mut assembler = Assembler::new(&grid, Duration::from_secs(1), 2);
    assembler.introduce(&grid, 1).unwrap();
    let mut take = |step, published| {
        let mut values = values(&grid, step).concat();
        assembler.block(0, 1, step, step as f64, published, &mut values).unwrap().map(|whole| whole.step)
    };
    // The numbers rise, are set back by a checkpoint, and finally stay the same.
    for (published, step) in (1..).zip([10, 11, 12, 5, 6, 7, 8, 8, 8]) {
        assert_eq!(take(step, published), Some(step), "published at {published}");
    }
    // After a reconnection a relay sends the steps of its ring again.
    for (published, step) in (6..).zip([7, 8, 8, 8]) {
        assert_eq!(take(step, published), None, "published at {published}");
    }
    assert_eq!(take(9, 10), Some(9));
}

#[test]
fn blocks_that_are_set_back_meet_again() {
    let blocks = columns(7, &[1, 3]);
    for (unseen, last, expected) in [(false, 8, vec![10, 11, 12, 5, 6, 7, 8]), (true, 18, vec![10, 11, 12, 16, 17, 18])] {
        let mut assembler = Assembler::new(&blocks[0], Duration::from_secs(60), 3);
        blocks.iter().for_each(|block| assembler.introduce(block, 1).unwrap());
        let mut whole = Vec::new();
        for (published, n) in (1..).zip((10..13).chain(5..=last)) {
            // After the third step all blocks are set back. The second block's ring may be read too late to show that.
            for (index, block) in (0..).zip(&blocks) {
                if unseen && index == 1 && published > 3 && n < 13 {
                    continue;
                }
                let step = assembler.block(index, 1, n, n as f64 / 2.0, published, &mut cut(block, n)).unwrap();
                if let Some(step) = step {
                    assert_eq!((step.time, &step.values), (n as f64 / 2.0, &values(&cube([4, 3, 2]), n).concat()));
                    whole.push(n);
                }
            }
        }
        assert_eq!(whole, expected);
    }
}

/// Event of a relay's block.
#[derive(Clone, Copy)]
enum Told {
    Opened { generation: u64 },
    Step { generation: u64, n: u64, published: u64 },
}

/// Events of a relay of one block: the first run up to a step, `left` more steps in its ring, the second run.
fn relayed(last: u64, left: u64, opened: u64) -> VecDeque<Told> {
    let first = (0..=last + left).map(|n| Told::Step { generation: 1, n, published: 2 + n });
    let second = (0..=120).map(|n| Told::Step { generation: opened, n, published: 2000 + n });
    let begin = |generation| std::iter::once(Told::Opened { generation });
    begin(1).chain(first).chain(begin(opened)).chain(second).collect()
}

#[test]
fn a_restart_that_one_relay_tells_before_another_mixes_no_runs_and_waits_for_no_limit() {
    let blocks = columns(0, &[2, 2]);
    let cases = [0, 1].into_iter().flat_map(|ahead| [0, 3, 40].map(|left| (ahead, left)));
    for (ahead, left, stays_behind) in cases.flat_map(|(ahead, left)| [(ahead, left, false), (ahead, left, true)]) {
        let other = 1 - ahead;
        let mut assembler = Assembler::new(&blocks[0], Duration::from_secs(3600), 4);
        let mut relays = [VecDeque::new(), VecDeque::new()];
        relays[ahead] = relayed(103, left, 1001);
        relays[other] = relayed(100, 0, 1000);
        let (mut whole, mut run): (Vec<Step>, _) = (Vec::new(), [1; 2]);
        while relays.iter().any(|relay| !relay.is_empty()) {
            let order = if stays_behind && run[other] > 1 { [other, ahead] } else { [ahead, other] };
            let may = |index: &usize| !assembler.is_ahead(*index as u32, run[*index]) && !relays[*index].is_empty();
            let index = order.into_iter().find(may).expect("all relays are held back");
            match relays[index].pop_front() {
                Some(Told::Opened { generation }) => {
                    run[index] = generation;
                    assembler.introduce(&blocks[index], generation).unwrap();
                }
                Some(Told::Step { generation, n, published }) => {
                    let second = 500 * u64::from(generation > 1);
                    let mut cut = cut(&blocks[index], n + second);
                    whole.extend(assembler.block(index as u32, generation, n, n as f64, published, &mut cut).unwrap());
                }
                None => unreachable!("it is not empty"),
            }
        }
        let expected: Vec<u64> = (0..=100).chain(500..=620).collect();
        let numbers_of: Vec<u64> = whole.iter().zip(&expected).map(|(step, n)| step.step + 500 * (n / 500)).collect();
        assert_eq!(numbers_of, expected, "relay {ahead} was ahead, {left} steps were left");
        assert_eq!(whole.len(), expected.len());
        for (step, n) in whole.iter().zip(&expected) {
            assert_eq!(step.values, values(&cube([4, 3, 2]), *n).concat(), "step {n} is of two runs");
            assert_eq!(step.anew, [0, 500].contains(n));
        }
        let given_up = assembler.incomplete();
        assert_eq!(numbers(&given_up), [101, 102, 103]);
        assert!(given_up.iter().all(|g| g.why == "the simulation was restarted"));
    }
}

#[test]
fn a_block_that_goes_on_while_another_is_opened_anew_is_taken() {
    let blocks = columns(0, &[2, 2]);
    let mut assembler = Assembler::new(&blocks[0], Duration::from_secs(3600), 4);
    blocks.iter().for_each(|block| assembler.introduce(block, 1).unwrap());
    assert_eq!(give(&mut assembler, &blocks[0], 1, 5), None);
    assembler.introduce(&blocks[1], 1007).unwrap();
    assert_eq!(numbers(&assembler.incomplete()), [5]);
    assert_eq!(
        (give(&mut assembler, &blocks[0], 1, 6), give(&mut assembler, &blocks[1], 1007, 6)),
        (None, None),
        "published before it was opened"
    );
    assert_eq!((give(&mut assembler, &blocks[0], 1, 8), give(&mut assembler, &blocks[1], 1007, 8).map(|s| s.step)), (None, Some(8)));
}

#[test]
fn a_block_that_is_over_holds_nobody_back() {
    let blocks = columns(0, &[2, 2]);
    let mut assembler = Assembler::new(&blocks[0], Duration::from_secs(3600), 4);
    blocks.iter().for_each(|block| assembler.introduce(block, 1).unwrap());
    for n in 0..3 {
        assert_eq!(give(&mut assembler, &blocks[0], 1, n), None);
    }
    assert!(assembler.is_ahead(0, 1), "the other may still come");
    assert!(!assembler.ended(1, 1));
    for n in 3..20 {
        assert!(!assembler.is_ahead(0, 1), "step {n}");
        assert_eq!(give(&mut assembler, &blocks[0], 1, n), None);
    }
    // Its connection is restored.
    assembler.introduce(&blocks[1], 1).unwrap();
    assert!(assembler.is_ahead(0, 1));
    assert_eq!(give(&mut assembler, &blocks[1], 1, 19).map(|s| s.step), Some(19));
}
