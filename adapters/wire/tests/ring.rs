//! The ring, through its files: what is published is read, and what cannot be is refused by name.

#![allow(clippy::unwrap_used, clippy::print_stdout)]

use ridgewatch_wire::{
    Assembler, AxisDescription, BlockExtent, Description, Element, Field, Following, Geometry, Limits, Policy, Producer, Read, ReadAt,
    RingReader, WireError, block_path, blocks, producer_lives,
};
use std::os::unix::fs::{FileExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// A folder of its own on the file system that rings live on, removed at the end.
struct Folder(PathBuf);

impl Folder {
    fn new(name: &str) -> Self {
        let path = PathBuf::from("/dev/shm").join(format!("rw-test-{name}-{}", std::process::id()));
        let _ = std::fs::remove_dir_all(&path);
        Self(path)
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

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
    // SAFETY: the vectors hold a value a node.
    unsafe { producer.publish(step, time, &field) }
}

fn step(reader: &mut RingReader, buffer: &mut Vec<f32>) -> Option<ridgewatch_wire::StepInfo> {
    match reader.read(buffer).unwrap() {
        Read::Step(info) => Some(info),
        _ => None,
    }
}

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
    // Ten more into four slots: the oldest six are gone.
    for n in 3..13 {
        publish(&producer, n, n as f64).unwrap();
    }
    let info = step(&mut reader, &mut buffer).unwrap();
    assert_eq!((info.step, info.missed), (9, 6));
    assert_eq!(buffer, values(producer.description(), 9).concat());
    // A follower that comes late begins with the oldest that is there.
    let mut late = RingReader::open(&folder.0, 0, &Limits::default()).unwrap();
    assert_eq!(step(&mut late, &mut buffer).unwrap().step, 9);
}

#[test]
fn strides_and_f64_arrive_as_packed_f32_does() {
    let folder = Folder::new("strides");
    let description = cube([3, 4, 2]);
    let producer = Producer::open(&folder.0, description.clone(), 2, Policy::NewestWins).unwrap();
    let mut reader = RingReader::open(&folder.0, 0, &Limits::default()).unwrap();
    let expected = values(&description, 1);
    let at = |i: usize, j: usize, k: usize| i + 3 * (j + 4 * k);
    let mut buffer = Vec::new();
    let mut check = |field: &Field| {
        // SAFETY: every stride below stays inside its array.
        unsafe { producer.publish(1, 0.0, field).unwrap() };
        step(&mut reader, &mut buffer).unwrap();
        assert_eq!(buffer, expected.concat());
    };
    // Interleaved.
    let interleaved: Vec<f32> = (0..24).flat_map(|n| (0..3).map(move |c| (c, n))).map(|(c, n): (usize, usize)| expected[c][n]).collect();
    let pointers: Vec<*const u8> = (0..3).map(|c| interleaved[c..].as_ptr().cast()).collect();
    check(&Field { components: &pointers, element: Element::F32, strides: [3, 9, 36] });
    // [x][y][z], doubles.
    let mut transposed = vec![vec![0.0f64; 24]; 3];
    for (c, component) in transposed.iter_mut().enumerate() {
        for (i, j, k) in (0..24).map(|n| (n % 3, n / 3 % 4, n / 12)) {
            component[(i * 4 + j) * 2 + k] = f64::from(expected[c][at(i, j, k)]);
        }
    }
    let pointers: Vec<*const u8> = transposed.iter().map(|v| v.as_ptr().cast()).collect();
    check(&Field { components: &pointers, element: Element::F64, strides: [8, 2, 1] });
    // With ghost cells, y downward.
    let (px, py) = (5, 6);
    let mut padded = vec![vec![f32::NAN; px * py * 4]; 3];
    for (c, component) in padded.iter_mut().enumerate() {
        for (i, j, k) in (0..24).map(|n| (n % 3, n / 3 % 4, n / 12)) {
            component[(i + 1) + px * ((4 - j) + py * (k + 1))] = expected[c][at(i, j, k)];
        }
    }
    let pointers: Vec<*const u8> = padded.iter().map(|v| v[1 + px * (4 + py)..].as_ptr().cast()).collect();
    check(&Field { components: &pointers, element: Element::F32, strides: [1, -(px as isize), (px * py) as isize] });
}

#[test]
fn every_unaligned_value_and_lie_of_the_caller_is_refused() {
    let folder = Folder::new("caller");
    let description = cube([2, 2, 2]);
    let producer = Producer::open(&folder.0, description.clone(), 2, Policy::NewestWins).unwrap();
    let data = [0.0f32; 9];
    let base: *const u8 = data.as_ptr().cast();
    let good = [base; 3];
    let refused = |components: &[*const u8], time: f64| {
        let field = Field::packed(components, Element::F32, [2, 2, 2]);
        // SAFETY: what is not refused reads 8 of 9 values.
        unsafe { producer.publish(0, time, &field) }.unwrap_err().to_string()
    };
    assert!(refused(&good[..2], 0.0).contains("3, as many as axes"));
    assert!(refused(&[base, std::ptr::null(), base], 0.0).contains("null"));
    assert!(refused(&[base, base.wrapping_add(1), base], 0.0).contains("divisible by 4"));
    assert!(refused(&good, f64::NAN).contains("finite"));
    assert!(publish(&producer, 0, 0.0).is_ok());
    for (what, change) in [
        ("axis.coordinates", Box::new(|d: &mut Description| d.axes[0].coordinates.reverse()) as Box<dyn Fn(&mut Description)>),
        ("axis.coordinates", Box::new(|d| d.axes[1].coordinates[1] = f64::NAN)),
        ("axis.nodes", Box::new(|d| d.axes[2].coordinates.truncate(1))),
        ("axis.period", Box::new(|d| d.axes[0].period = Some(0.5))),
        ("radius", Box::new(|d| d.geometry = Geometry::Sphere { radius: -1.0 })),
        ("block", Box::new(|d| d.block.offset[0] = 1)),
        ("block", Box::new(|d| d.block.extent[2] = u64::MAX)),
        ("block", Box::new(|d| d.block.index = 1)),
        ("axes", Box::new(|d| d.axes.truncate(1))),
        ("time_unit", Box::new(|d| d.time_unit = "s\n".into())),
    ] {
        let mut wrong = description.clone();
        change(&mut wrong);
        let error = Producer::open(&folder.0.join("other"), wrong, 2, Policy::NewestWins).unwrap_err().to_string();
        assert!(error.contains(&format!("`{what}`")), "{what}: {error}");
    }
}

#[test]
fn two_producers_of_one_name_and_what_a_killed_one_leaves() {
    let folder = Folder::new("names");
    let first = Producer::open(&folder.0, cube([2, 2, 2]), 2, Policy::NewestWins).unwrap();
    let error = Producer::open(&folder.0, cube([2, 2, 2]), 2, Policy::NewestWins).unwrap_err();
    assert!(matches!(error, WireError::InUse { pid, .. } if pid == u64::from(std::process::id())), "{error}");
    assert!(producer_lives(&folder.0, 0));
    // As SIGKILL leaves it: the files stay, the lock goes.
    let reader = RingReader::open(&folder.0, 0, &Limits::default()).unwrap();
    let left = std::fs::read(block_path(&folder.0, 0)).unwrap();
    drop(first);
    assert!(!producer_lives(&folder.0, 0) && !folder.0.exists(), "nobody follows: the folder goes");
    std::fs::create_dir_all(&folder.0).unwrap();
    std::fs::write(block_path(&folder.0, 0), left).unwrap();
    std::fs::write(folder.0.join(".block-00000.part"), "half").unwrap();
    std::fs::set_permissions(block_path(&folder.0, 0), PermissionsExt::from_mode(0o600)).unwrap();
    let second = Producer::open(&folder.0, cube([2, 2, 2]), 2, Policy::NewestWins).unwrap();
    let new = RingReader::open(&folder.0, 0, &Limits::default()).unwrap();
    assert!(!reader.is_current() && new.is_current());
    assert!(new.header().generation > reader.header().generation && new.header().producer != reader.header().producer);
    assert!(!folder.0.join(".block-00000.part").exists());
    drop(second);
}

#[test]
fn the_end_is_told_and_the_last_follower_sweeps_up() {
    let folder = Folder::new("end");
    let following = Following::begin(&folder.0).unwrap();
    let producer = Producer::open(&folder.0, cube([2, 2, 2]), 2, Policy::NewestWins).unwrap();
    publish(&producer, 7, 1.0).unwrap();
    drop(producer);
    assert_eq!(blocks(&folder.0), [0], "its last step waits for the follower");
    let mut reader = RingReader::open(&folder.0, 0, &Limits::default()).unwrap();
    let mut buffer = Vec::new();
    assert_eq!(step(&mut reader, &mut buffer).unwrap().step, 7);
    assert_eq!(reader.read(&mut buffer).unwrap(), Read::Ended);
    let other = Following::begin(&folder.0).unwrap();
    drop(following);
    assert_eq!(blocks(&folder.0), [0], "another follows still");
    drop(other);
    assert!(!folder.0.exists());
    // A living producer keeps its ring when the last follower goes.
    let producer = Producer::open(&folder.0, cube([2, 2, 2]), 2, Policy::NewestWins).unwrap();
    drop(Following::begin(&folder.0).unwrap());
    assert_eq!(blocks(&folder.0), [0]);
    publish(&producer, 1, 0.0).unwrap();
}

#[test]
fn producers_that_come_and_go_at_once_do_not_take_each_others_folder() {
    let folder = Folder::new("crowd");
    std::thread::scope(|scope| {
        for index in 0..4 {
            let ring = &folder.0;
            scope.spawn(move || {
                let mut description = cube([8, 2, 2]);
                description.block = BlockExtent { index, count: 4, offset: [2 * u64::from(index), 0, 0], extent: [2, 2, 2] };
                for _ in 0..300 {
                    drop(Producer::open(ring, description.clone(), 2, Policy::NewestWins).unwrap());
                }
            });
        }
    });
    assert!(!folder.0.exists());
}

#[test]
fn waiting_is_bounded_and_happens_once() {
    let folder = Folder::new("wait");
    let limit = Duration::from_millis(80);
    let producer = Producer::open(&folder.0, cube([2, 2, 2]), 2, Policy::Wait(limit)).unwrap();
    let timed = |n: u64| {
        let begin = Instant::now();
        let published = publish(&producer, n, n as f64).unwrap();
        (published.overwrote, begin.elapsed())
    };
    assert!(!timed(0).0 && !timed(1).0);
    let (overwrote, took) = timed(2);
    assert!(overwrote && took >= limit && took < limit * 10, "{took:?}");
    let (overwrote, took) = timed(3);
    assert!(overwrote && took < limit, "{took:?}: nobody moved, nobody is waited for again");
    // A follower that takes steps is waited for, and loses none.
    let path = folder.0.clone();
    let mut reader = RingReader::open(&path, 0, &Limits::default()).unwrap();
    let follower = std::thread::spawn(move || {
        let (mut buffer, mut seen) = (Vec::new(), Vec::new());
        while seen.last() != Some(&30) {
            match reader.read(&mut buffer).unwrap() {
                Read::Step(info) => {
                    seen.push(info.step);
                    std::thread::sleep(Duration::from_millis(3));
                    reader.acknowledge().unwrap();
                }
                _ => std::thread::yield_now(),
            }
        }
        seen
    });
    for n in 4..=30 {
        // The first may come before the follower has taken anything.
        assert!(!timed(n).0 || n < 6, "step {n}");
        if n < 6 {
            std::thread::sleep(Duration::from_millis(20));
        }
    }
    let seen = follower.join().unwrap();
    assert!(seen[0] <= 5 && seen == (seen[0]..=30).collect::<Vec<_>>(), "{seen:?}");
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
            // SAFETY: the plane holds a value a node.
            unsafe { producer.publish(n, n as f64, &Field::packed(&pointers, Element::F32, [64, 32, 32])).unwrap() };
        }
        reader.join().unwrap()
    });
    assert_eq!(seen.0 + seen.1, 3000, "each step is seen or counted");
}

/// A ring whose slots are overwritten by a newer step at the moment that their values are read.
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
fn threads_may_publish_at_once_and_a_fork_may_not() {
    let folder = Folder::new("threads");
    let producer = Producer::open(&folder.0, cube([8, 8, 8]), 64, Policy::NewestWins).unwrap();
    std::thread::scope(|scope| {
        for thread in 0..4 {
            let producer = &producer;
            scope.spawn(move || {
                for n in 0..10 {
                    publish(producer, 10 * thread + n, n as f64).unwrap();
                }
            });
        }
    });
    let mut reader = RingReader::open(&folder.0, 0, &Limits::default()).unwrap();
    let mut buffer = Vec::new();
    let mut steps: Vec<u64> = std::iter::from_fn(|| {
        let info = step(&mut reader, &mut buffer)?;
        assert_eq!(buffer, values(producer.description(), info.step).concat());
        Some(info.step)
    })
    .collect();
    steps.sort_unstable();
    assert_eq!(steps, (0..40).collect::<Vec<_>>());
    // SAFETY: the child calls nothing that could wait for a lock of another thread, and leaves by _exit.
    let child = unsafe { libc::fork() };
    if child == 0 {
        let data = [0.0f32; 512];
        let pointers = [data.as_ptr().cast::<u8>(); 3];
        // SAFETY: 512 values, as described.
        let refused = unsafe { producer.publish(99, 0.0, &Field::packed(&pointers, Element::F32, [8, 8, 8])) };
        // Closing it here must not end the parent's ring.
        drop(producer);
        // SAFETY: ends the child.
        unsafe { libc::_exit(if matches!(refused, Err(WireError::Forked { .. })) { 0 } else { 1 }) };
    }
    let mut status = 0;
    // SAFETY: waits for the child made above.
    unsafe { libc::waitpid(child, &mut status, 0) };
    assert_eq!(status, 0);
    assert!(producer_lives(&folder.0, 0));
    publish(&producer, 40, 0.0).unwrap();
    assert_eq!(step(&mut reader, &mut buffer).unwrap().step, 40);
}

#[test]
fn rings_of_others_links_and_odd_files_are_refused() {
    let folder = Folder::new("foreign");
    let producer = Producer::open(&folder.0, cube([2, 2, 2]), 2, Policy::NewestWins).unwrap();
    let path = block_path(&folder.0, 0);
    let open = || RingReader::open(&folder.0, 0, &Limits::default()).unwrap_err();
    std::fs::set_permissions(&path, PermissionsExt::from_mode(0o640)).unwrap();
    assert!(matches!(open(), WireError::Foreign { found, .. } if found == "has mode 0640"));
    std::fs::set_permissions(&path, PermissionsExt::from_mode(0o600)).unwrap();
    // SAFETY: a call of the system on a path that lives.
    if unsafe { libc::geteuid() } == 0 {
        std::os::unix::fs::chown(&path, Some(12345), None).unwrap();
        assert!(matches!(open(), WireError::Foreign { found, .. } if found == "belongs to user 12345"));
        std::os::unix::fs::chown(&path, Some(0), None).unwrap();
        let theirs = folder.0.join("theirs");
        std::fs::create_dir(&theirs).unwrap();
        std::os::unix::fs::chown(&theirs, Some(12345), None).unwrap();
        let error = Producer::open(&theirs, cube([2, 2, 2]), 2, Policy::NewestWins).unwrap_err();
        assert!(matches!(error, WireError::Foreign { .. }), "{error}");
        std::fs::remove_dir(&theirs).unwrap();
    }
    let moved = folder.0.join("moved");
    std::fs::rename(&path, &moved).unwrap();
    std::os::unix::fs::symlink(&moved, &path).unwrap();
    assert!(matches!(open(), WireError::Foreign { found, .. } if found.contains("link")));
    std::fs::remove_file(&path).unwrap();
    std::fs::create_dir(&path).unwrap();
    assert!(matches!(open(), WireError::Foreign { .. } | WireError::Io { .. }));
    std::fs::remove_dir(&path).unwrap();
    std::fs::rename(&moved, &path).unwrap();
    // A folder that others may write into.
    let open_to_all = folder.0.join("open");
    std::fs::create_dir(&open_to_all).unwrap();
    std::fs::set_permissions(&open_to_all, PermissionsExt::from_mode(0o777)).unwrap();
    let error = Producer::open(&open_to_all, cube([2, 2, 2]), 2, Policy::NewestWins).unwrap_err().to_string();
    assert!(error.contains("others may write into"), "{error}");
    std::fs::remove_dir(&open_to_all).unwrap();
    drop(producer);
}

/// A ring that is there whole, then changed.
fn changed(change: impl Fn(&Path), limits: &Limits) -> WireError {
    static NUMBER: std::sync::atomic::AtomicU32 = std::sync::atomic::AtomicU32::new(0);
    let folder = Folder::new(&format!("changed{}", NUMBER.fetch_add(1, std::sync::atomic::Ordering::Relaxed)));
    let producer = Producer::open(&folder.0, cube([4, 4, 4]), 2, Policy::NewestWins).unwrap();
    publish(&producer, 1, 1.0).unwrap();
    // A copy, for a producer whose own file is cut short would be killed with it.
    let copy = folder.0.join("copy");
    std::fs::create_dir(&copy).unwrap();
    std::fs::copy(block_path(&folder.0, 0), block_path(&copy, 0)).unwrap();
    change(&block_path(&copy, 0));
    let mut buffer = Vec::new();
    match RingReader::open(&copy, 0, limits) {
        Err(error) => error,
        Ok(mut reader) => reader.read(&mut buffer).unwrap_err(),
    }
}

fn overwrite(path: &Path, offset: u64, bytes: &[u8]) {
    std::fs::OpenOptions::new().write(true).open(path).unwrap().write_all_at(bytes, offset).unwrap();
}

#[test]
fn damaged_rings_have_their_own_errors() {
    let limits = Limits::default();
    assert!(matches!(changed(|p| overwrite(p, 0, b"RIFF"), &limits), WireError::NotARing { .. }));
    assert!(matches!(changed(|p| overwrite(p, 8, &[2]), &limits), WireError::Version { found: 2, known: 1 }));
    assert!(matches!(changed(|p| overwrite(p, 12, &[255; 4]), &limits), WireError::TooLarge { .. }));
    assert!(matches!(changed(|p| overwrite(p, 24, &[3]), &limits), WireError::Checksum { .. }));
    assert!(matches!(changed(|p| overwrite(p, 8200, &[77]), &limits), WireError::Checksum { .. }));
    let truncate = |length: u64| move |p: &Path| std::fs::OpenOptions::new().write(true).open(p).unwrap().set_len(length).unwrap();
    assert!(matches!(changed(truncate(100), &limits), WireError::Short { .. }));
    assert!(matches!(changed(truncate(8200), &limits), WireError::Short { .. }));
    assert!(matches!(changed(truncate(12288 + 100), &limits), WireError::Short { .. }));
    let small = Limits { step_bytes: 4 * 4 * 4 * 3 * 4 - 1 };
    assert!(matches!(changed(|_| {}, &small), WireError::TooLarge { .. }));
    // A time that is no number, put there behind the producer's back.
    assert!(matches!(changed(|p| overwrite(p, 12288 + 16, &f64::NAN.to_ne_bytes()), &limits), WireError::Field { field: "time", .. }));
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
fn no_room_is_an_error_and_leaves_nothing() {
    let folder = Folder::new("room");
    // A petabyte.
    let description = cube([1 << 15, 1 << 15, 1 << 14]);
    let error = Producer::open(&folder.0, description, 16, Policy::NewestWins).unwrap_err();
    assert!(matches!(error, WireError::NoSpace { .. }), "{error}");
    assert_eq!(std::fs::read_dir(&folder.0).unwrap().count(), 0);
}

/// A file system of one megabyte that is gone when the test ends.
struct SmallDisk(PathBuf);

impl Drop for SmallDisk {
    fn drop(&mut self) {
        let _ = std::process::Command::new("umount").arg("-l").arg(&self.0).status();
        let _ = std::fs::remove_dir(&self.0);
    }
}

#[test]
#[ignore = "mounts a small file system, which needs root"]
fn a_full_file_system_refuses_the_next_ring_and_leaves_the_first_alone() {
    let disk = SmallDisk(std::env::temp_dir().join(format!("rw-test-full-{}", std::process::id())));
    std::fs::create_dir_all(&disk.0).unwrap();
    let mounted = std::process::Command::new("mount").args(["-t", "tmpfs", "-o", "size=1m,mode=0700", "tmpfs"]).arg(&disk.0).status();
    assert!(mounted.unwrap().success(), "mounting needs root");
    let (first, second) = (disk.0.join("first"), disk.0.join("second"));
    // 2 slots of 24^3 x 3 f32: 332 kB.
    let producer = Producer::open(&first, cube([24, 24, 24]), 2, Policy::NewestWins).unwrap();
    // Three times as much does not fit any more, and nothing of the attempt stays.
    let error = Producer::open(&second, cube([24, 24, 24]), 6, Policy::NewestWins).unwrap_err();
    assert!(matches!(error, WireError::NoSpace { needed, .. } if needed > 900_000), "{error}");
    assert_eq!(std::fs::read_dir(&second).unwrap().count(), 0);
    // Somebody else takes the rest, to the last page.
    let mut ballast = std::fs::File::create(disk.0.join("ballast")).unwrap();
    while std::io::Write::write_all(&mut ballast, &[1; 4096]).is_ok() {}
    // What was reserved at opening holds: every slot is written, none faults, and a follower reads them.
    let mut reader = RingReader::open(&first, 0, &Limits::default()).unwrap();
    let mut buffer = Vec::new();
    for n in 0..6 {
        publish(&producer, n, n as f64).unwrap();
        assert_eq!(step(&mut reader, &mut buffer).unwrap().step, n);
        assert_eq!(buffer, values(producer.description(), n).concat());
    }
    assert!(matches!(
        Producer::open(&second, cube([4, 4, 4]), 2, Policy::NewestWins),
        Err(WireError::NoSpace { .. } | WireError::Io { .. })
    ));
    // With room again, the name that was refused is free.
    drop(ballast);
    std::fs::remove_file(disk.0.join("ballast")).unwrap();
    Producer::open(&second, cube([4, 4, 4]), 2, Policy::NewestWins).unwrap();
}

#[test]
fn blocks_meet_and_what_does_not_fit_is_refused() {
    let grid = cube([4, 3, 2]);
    let part = |index: u32, x: u64, nx: u64| {
        let mut part = grid.clone();
        part.block = BlockExtent { index, count: 2, offset: [x, 0, 0], extent: [nx, 3, 2] };
        part
    };
    let (left, right) = (part(0, 0, 1), part(1, 1, 3));
    let whole = values(&grid, 1).concat();
    let cut = |p: &Description| -> Vec<f32> {
        let [ox, ex] = [p.block.offset[0], p.block.extent[0]].map(|n| n as usize);
        whole.chunks_exact(4).flat_map(|row| row[ox..ox + ex].to_vec()).collect()
    };
    let mut assembler = Assembler::new(&left, Duration::from_millis(30), 2);
    assembler.introduce(&left).unwrap();
    assert!(assembler.block(1, 0, 0.0, 0, &mut cut(&right)).unwrap_err().to_string().contains("not introduced"));
    assert!(assembler.introduce(&part(1, 0, 3)).unwrap_err().to_string().contains("overlaps block 0"));
    assert!(assembler.introduce(&part(1, 2, 2)).unwrap_err().to_string().contains("18 of 24 nodes"));
    let mut stranger = right.clone();
    stranger.axes[0].coordinates[1] += 0.01;
    assert!(assembler.introduce(&stranger).unwrap_err().to_string().contains("another field"));
    assembler.introduce(&right).unwrap();
    // Either order.
    assert_eq!(assembler.block(1, 1, 0.5, 10, &mut cut(&right)).unwrap(), (None, vec![]));
    let (step, given_up) = assembler.block(0, 1, 0.5, 9, &mut cut(&left)).unwrap();
    let step = step.unwrap();
    assert_eq!((step.step, step.time, step.published, given_up.len()), (1, 0.5, 10, 0));
    assert_eq!(step.values, whole);
    // Another time, another length.
    assembler.block(0, 2, 1.0, 0, &mut cut(&left)).unwrap();
    assert!(assembler.block(1, 2, 1.5, 0, &mut cut(&right)).unwrap_err().to_string().contains("the time that its other blocks have"));
    assert!(assembler.block(1, 2, 1.0, 0, &mut cut(&left)).unwrap_err().to_string().contains("18 values"));
    // A step that lacks a block goes when a newer one is whole,
    assembler.block(0, 3, 2.0, 0, &mut cut(&left)).unwrap();
    let (step, given_up) = assembler.block(1, 3, 2.0, 0, &mut cut(&right)).unwrap();
    assert_eq!(step.unwrap().step, 3);
    assert_eq!((given_up.len(), given_up[0].step, given_up[0].blocks, given_up[0].wanted), (1, 2, 1, 2));
    assert_eq!(assembler.block(1, 2, 1.0, 0, &mut cut(&right)).unwrap(), (None, vec![]), "too late");
    // when time is up,
    assembler.block(0, 4, 3.0, 0, &mut cut(&left)).unwrap();
    assert!(assembler.expire().is_empty());
    std::thread::sleep(Duration::from_millis(40));
    assert_eq!(assembler.expire()[0].why, "blocks did not come in time");
    // and when too many wait.
    let given_up: Vec<_> = (5..9).flat_map(|n| assembler.block(0, n, n as f64, 0, &mut cut(&left)).unwrap().1).collect();
    assert_eq!(given_up.iter().map(|g| g.step).collect::<Vec<_>>(), [5, 6]);
}

#[test]
fn a_block_that_is_the_whole_field_is_handed_on_and_not_copied() {
    let grid = cube([4, 3, 2]);
    let mut assembler = Assembler::new(&grid, Duration::from_secs(1), 2);
    assembler.introduce(&grid).unwrap();
    let mut buffer = values(&grid, 1).concat();
    let (address, expected) = (buffer.as_ptr(), buffer.clone());
    let (step, given_up) = assembler.block(0, 1, 0.5, 9, &mut buffer).unwrap();
    let step = step.unwrap();
    assert_eq!((step.step, step.time, step.published, given_up.len()), (1, 0.5, 9, 0));
    assert_eq!(step.values, expected);
    assert_eq!(step.values.as_ptr(), address);
    assembler.recycle(step.values);
    // What came already, and what has another length, stays with the caller.
    let mut buffer = values(&grid, 2).concat();
    assert_eq!(assembler.block(0, 1, 0.5, 9, &mut buffer).unwrap(), (None, vec![]));
    assert!(assembler.block(0, 2, 0.5, 9, &mut vec![0.0; 7]).unwrap_err().to_string().contains("7 values"));
    assert_eq!(buffer, values(&grid, 2).concat());
    assembler.block(0, 2, 0.6, 9, &mut buffer).unwrap();
    assert_eq!(buffer.as_ptr(), address, "the first step's buffer came back");
}
