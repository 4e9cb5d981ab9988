//! Tests of a reader while the solver continues, ends, or tears the ring.

use super::{Folder, cube, overwrite, publish, step, values};
use ridgewatch_wire::{
    Element, Event, Field, Following, Limits, Policy, Producer, Read, ReadAt, RingFollower, RingReader, WireError, block_path, blocks,
};
use std::time::{Duration, Instant};

#[test]
fn what_is_published_is_read_in_order_and_the_rest_is_counted() {
    let folder = Folder::new("order");
    let producer = Producer::open(&folder.0, cube([5, 4, 3]), 4, Policy::NewestWins).unwrap();
    let mut reader = RingReader::open(&folder.0, 0, &Limits::default()).unwrap();
    assert_eq!(reader.header().description, cube([5, 4, 3]));
    let mut buffer = Vec::new();
    assert_eq!(reader.read(&mut buffer).unwrap(), Read::Nothing);
    for n in 0..3 {
        publish(&producer, n, n as f64 / 2.0).unwrap();
    }
    for n in 0..3 {
        let info = step(&mut reader, &mut buffer).unwrap();
        assert_eq!((info.number, info.step, info.time, info.missed), (n, n, n as f64 / 2.0, 0));
        assert_eq!(buffer, values(producer.description(), n).concat());
    }
    // Ten more in four slots: the oldest six are overwritten.
    for n in 3..13 {
        publish(&producer, n, n as f64).unwrap();
    }
    let info = step(&mut reader, &mut buffer).unwrap();
    assert_eq!((info.step, info.missed), (9, 6));
    assert_eq!(buffer, values(producer.description(), 9).concat());
    // A late follower begins with the oldest step.
    let mut late = RingReader::open(&folder.0, 0, &Limits::default()).unwrap();
    assert_eq!(step(&mut late, &mut buffer).unwrap().step, 9);
}

#[test]
fn the_end_is_told_and_the_last_follower_sweeps_up() {
    let folder = Folder::new("end");
    let following = Following::begin(&folder.0).unwrap();
    let producer = Producer::open(&folder.0, cube([2, 2, 2]), 2, Policy::NewestWins).unwrap();
    publish(&producer, 7, 1.0).unwrap();
    drop(producer);
    assert_eq!(blocks(&folder.0).collect::<Vec<_>>(), [0], "its last step stays for the follower");
    let mut reader = RingReader::open(&folder.0, 0, &Limits::default()).unwrap();
    let mut buffer = Vec::new();
    assert_eq!(step(&mut reader, &mut buffer).unwrap().step, 7);
    assert_eq!(reader.read(&mut buffer).unwrap(), Read::Ended);
    let other = Following::begin(&folder.0).unwrap();
    drop(following);
    assert_eq!(blocks(&folder.0).collect::<Vec<_>>(), [0], "another follower is left");
    drop(other);
    assert!(!folder.0.exists());
    // A living producer keeps its ring when the last follower goes.
    let producer = Producer::open(&folder.0, cube([2, 2, 2]), 2, Policy::NewestWins).unwrap();
    drop(Following::begin(&folder.0).unwrap());
    assert_eq!(blocks(&folder.0).collect::<Vec<_>>(), [0]);
    publish(&producer, 1, 0.0).unwrap();
}

/// The next step that a follower gets.
fn next(follower: &mut RingFollower, buffer: &mut Vec<f32>) -> u64 {
    let begin = Instant::now();
    while begin.elapsed() < Duration::from_secs(60) {
        match follower.poll(buffer) {
            Some(Event::Step { step, missed, .. }) => {
                assert_eq!(missed, 0);
                return step;
            }
            Some(Event::Opened { .. }) => {}
            Some(other) => panic!("{other:?}"),
            None => std::thread::sleep(Duration::from_millis(1)),
        }
    }
    panic!("no step came");
}

#[test]
fn two_three_and_64_followers_get_every_step_and_another_one_is_refused() {
    for count in [2, 3, 64] {
        let folder = Folder::new(&format!("together-{count}"));
        let producer = Producer::open(&folder.0, cube([4, 3, 2]), 2, Policy::Wait(Duration::from_secs(60))).unwrap();
        let mut followers: Vec<_> = (0..count).map(|_| RingFollower::begin(&folder.0, Limits::default()).unwrap()).collect();
        let mut buffer = Vec::new();
        // None is waited for that has not found the ring.
        let found = |follower: &mut RingFollower| matches!(follower.poll(&mut Vec::new()), Some(Event::Opened { .. }));
        assert!(followers.iter_mut().all(found));
        std::thread::scope(|scope| {
            let producer = &producer;
            scope.spawn(move || (0..5).for_each(|n| assert!(!publish(producer, n, n as f64).unwrap().overwrote)));
            for n in 0..5 {
                for follower in &mut followers {
                    assert_eq!(next(follower, &mut buffer), n);
                    assert_eq!(buffer, values(producer.description(), n).concat());
                }
            }
        });
        if count == 64 {
            let refused = RingFollower::begin(&folder.0, Limits::default()).map(drop).unwrap_err().to_string();
            assert!(refused.contains("64 follow") && refused.contains("at most 64"), "{refused}");
            // It has disturbed nobody, and may come when one has left.
            publish(&producer, 5, 5.0).unwrap();
            assert!(followers.iter_mut().all(|follower| next(follower, &mut buffer) == 5));
            drop(followers.pop());
            let mut late = RingFollower::begin(&folder.0, Limits::default()).unwrap();
            assert_eq!([next(&mut late, &mut buffer), next(&mut late, &mut buffer)], [4, 5]);
        }
        drop(followers);
        drop(producer);
        assert!(!folder.0.exists());
    }
}

#[test]
fn a_step_that_is_overwritten_while_it_is_read_is_never_seen() {
    let folder = Folder::new("torn");
    let description = cube([64, 32, 32]);
    let producer = Producer::open(&folder.0, description, 2, Policy::NewestWins).unwrap();
    let mut reader = RingReader::open(&folder.0, 0, &Limits::default()).unwrap();
    let seen = std::thread::scope(|scope| {
        let reader = scope.spawn(move || {
            let (mut buffer, mut seen, mut missed) = (Vec::new(), 0u64, 0);
            loop {
                match reader.read(&mut buffer).unwrap() {
                    Read::Step(info) => {
                        assert!(buffer.iter().all(|v| *v == info.step as f32), "step {} is torn", info.step);
                        assert_eq!(info.time, info.step as f64);
                        (seen, missed) = (seen + 1, missed + info.missed);
                        if info.step == 3000 {
                            return (seen, missed);
                        }
                    }
                    _ => std::thread::yield_now(),
                }
            }
        });
        for n in 1..=3000u64 {
            let plane = vec![n as f32; 64 * 32 * 32];
            let pointers = [plane.as_ptr().cast::<u8>(); 3];
            // SAFETY: the plane has one value per node.
            unsafe { producer.publish(n, n as f64, &Field::packed(&pointers, Element::F32, [64, 32, 32])).unwrap() };
        }
        reader.join().unwrap()
    });
    assert_eq!(seen.0 + seen.1, 3000, "each step is seen or counted");
}

/// A ring into which the producer publishes several steps while the first values are read.
struct Overtaken<'a>(std::fs::File, &'a Producer, std::cell::Cell<u64>);

impl ReadAt for Overtaken<'_> {
    fn length(&self) -> std::io::Result<u64> {
        self.0.length()
    }

    fn read_at(&self, to: &mut [u8], offset: u64) -> std::io::Result<()> {
        ReadAt::read_at(&self.0, to, offset)?;
        if offset > 12288 && to.len() > 32 {
            for n in 4..4 + self.2.take() {
                publish(self.1, n, n as f64).unwrap();
            }
        }
        Ok(())
    }

    fn write_at(&self, from: &[u8], offset: u64) -> std::io::Result<()> {
        ReadAt::write_at(&self.0, from, offset)
    }
}

#[test]
fn a_reader_that_was_overtaken_goes_on_with_the_newest() {
    for (more, step, missed) in [(0, 0, 0), (1, 4, 4), (3, 6, 6), (20, 23, 23)] {
        let folder = Folder::new("overtaken");
        let producer = Producer::open(&folder.0, cube([5, 4, 3]), 4, Policy::NewestWins).unwrap();
        for n in 0..4 {
            publish(&producer, n, n as f64).unwrap();
        }
        let file = std::fs::File::open(block_path(&folder.0, 0)).unwrap();
        let ring = Overtaken(file, &producer, more.into());
        let mut reader = RingReader::over("overtaken".into(), ring, &Limits::default()).unwrap();
        let mut buffer = Vec::new();
        let Read::Step(info) = reader.read(&mut buffer).unwrap() else { panic!("nothing was read") };
        assert_eq!((info.step, info.missed), (step, missed), "{more} more");
        assert_eq!(buffer, values(producer.description(), step).concat());
    }
}

/// A ring whose slots are overwritten by a newer step while their values are read.
struct Racing(std::cell::RefCell<Vec<u8>>);

impl ReadAt for Racing {
    fn length(&self) -> std::io::Result<u64> {
        Ok(self.0.borrow().len() as u64)
    }

    fn read_at(&self, to: &mut [u8], offset: u64) -> std::io::Result<()> {
        let mut bytes = self.0.borrow_mut();
        let begin = offset as usize;
        let (half, end) = (to.len() / 2, begin + to.len());
        to[..half].copy_from_slice(&bytes[begin..begin + half]);
        if begin > 12288 && to.len() > 32 {
            let slot = begin - 64;
            let sequence = u64::from_ne_bytes(bytes[slot..slot + 8].try_into().unwrap()) + 3;
            bytes[slot..slot + 8].copy_from_slice(&sequence.to_ne_bytes());
            bytes[begin..end].fill(0x7f);
        }
        to[half..].copy_from_slice(&bytes[begin + half..end]);
        Ok(())
    }

    fn write_at(&self, _: &[u8], _: u64) -> std::io::Result<()> {
        Ok(())
    }
}

#[test]
fn a_step_that_changes_between_two_looks_is_thrown_away() {
    let folder = Folder::new("racing");
    let producer = Producer::open(&folder.0, cube([4, 4, 4]), 3, Policy::NewestWins).unwrap();
    for n in 0..3 {
        publish(&producer, n, n as f64).unwrap();
    }
    let bytes = std::fs::read(block_path(&folder.0, 0)).unwrap();
    let mut reader = RingReader::over("racing".into(), Racing(bytes.into()), &Limits::default()).unwrap();
    assert_eq!(reader.read(&mut Vec::new()).unwrap(), Read::Nothing);
}

#[test]
fn a_ring_that_is_cut_short_or_runs_backwards_under_the_reader_is_an_error() {
    let folder = Folder::new("cut");
    let producer = Producer::open(&folder.0, cube([4, 4, 4]), 2, Policy::NewestWins).unwrap();
    for n in 0..3 {
        publish(&producer, n, n as f64).unwrap();
    }
    let copy = folder.0.join("copy");
    std::fs::create_dir(&copy).unwrap();
    std::fs::copy(block_path(&folder.0, 0), block_path(&copy, 0)).unwrap();
    let mut reader = RingReader::open(&copy, 0, &Limits::default()).unwrap();
    let mut buffer = Vec::new();
    assert!(matches!(reader.read(&mut buffer).unwrap(), Read::Step(_)));
    overwrite(&block_path(&copy, 0), 1024, &1u64.to_ne_bytes());
    assert!(matches!(reader.read(&mut buffer), Err(WireError::Field { field: "published", .. })));
    overwrite(&block_path(&copy, 0), 1024, &3u64.to_ne_bytes());
    std::fs::OpenOptions::new().write(true).open(block_path(&copy, 0)).unwrap().set_len(12288 + 64).unwrap();
    assert!(matches!(reader.read(&mut buffer), Err(WireError::Io { .. })));
}

#[test]
fn a_ring_that_was_given_up_is_not_made_long_again() {
    let folder = Folder::new("givenup");
    let producer = Producer::open(&folder.0, cube([4, 4, 4]), 2, Policy::NewestWins).unwrap();
    publish(&producer, 0, 0.0).unwrap();
    // A copy, because the producer maps its own file.
    let copy = folder.0.join("copy");
    std::fs::create_dir(&copy).unwrap();
    let (path, mut buffer) = (block_path(&copy, 0), Vec::new());
    std::fs::copy(block_path(&folder.0, 0), &path).unwrap();
    let mut reader = RingReader::open(&copy, 0, &Limits::default()).unwrap();
    assert_eq!(step(&mut reader, &mut buffer).unwrap().step, 0);
    let file = std::fs::OpenOptions::new().write(true).open(&path).unwrap();
    file.set_len(0).unwrap();
    for marked in [reader.acknowledge(3), reader.leave(3)] {
        assert!(marked.unwrap_err().to_string().contains("was it truncated?"));
    }
    assert_eq!(file.metadata().unwrap().len(), 0);
    // A delayed mark extends the file.
    overwrite(&path, 4096, &[1; 16]);
    let error = reader.read(&mut buffer).unwrap_err().to_string();
    assert!(error.contains("was it truncated?"), "{error}");
}
