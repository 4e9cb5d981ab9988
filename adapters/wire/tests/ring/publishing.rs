//! Tests of a solver: any strides, several threads, waiting.

use super::{Folder, cube, publish, step, values};
use ridgewatch_wire::{BlockExtent, Element, Field, Following, Limits, Policy, Producer, Read, RingReader, WireError, producer_lives};
use std::time::{Duration, Instant};

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
fn followers_that_come_and_go_stand_in_no_producers_way_and_nothing_stays() {
    let folder = Folder::new("sweeping");
    let ring = &folder.0;
    for round in 0..20 {
        std::thread::scope(|scope| {
            for index in 0..3 {
                scope.spawn(move || {
                    let mut description = cube([6, 2, 2]);
                    description.block = BlockExtent { index, count: 3, offset: [2 * u64::from(index), 0, 0], extent: [2, 2, 2] };
                    for _ in 0..40 {
                        drop(Producer::open(ring, description.clone(), 2, Policy::NewestWins).unwrap());
                    }
                });
            }
            for _ in 0..2 {
                scope.spawn(move || (0..80).for_each(|_| drop(Following::begin(ring).unwrap())));
            }
        });
        assert!(!ring.exists(), "round {round}: {:?}", std::fs::read_dir(ring).unwrap().flatten().collect::<Vec<_>>());
    }
}

#[test]
fn a_sweeper_that_was_stopped_is_not_waited_for_without_end() {
    let folder = Folder::new("stopped");
    std::fs::create_dir_all(&folder.0).unwrap();
    std::fs::set_permissions(&folder.0, std::os::unix::fs::PermissionsExt::from_mode(0o700)).unwrap();
    let mut options = std::fs::OpenOptions::new();
    std::os::unix::fs::OpenOptionsExt::mode(options.read(true).write(true).create(true), 0o600);
    let file = options.open(folder.0.join("followers.lock")).unwrap();
    // SAFETY: all of its fields are integers; the descriptor is open, and the lock outlives the call.
    let locked = unsafe {
        let mut lock: libc::flock = std::mem::zeroed();
        (lock.l_type, lock.l_len) = (libc::F_WRLCK as libc::c_short, 1);
        libc::fcntl(std::os::fd::AsRawFd::as_raw_fd(&file), libc::F_OFD_SETLK, &lock)
    };
    assert_eq!(locked, 0);
    let error = Following::begin(&folder.0).unwrap_err().to_string();
    assert!(error.contains("followers.lock") && error.contains("follower that leaves"), "{error}");
    // A producer can still publish and end.
    let producer = Producer::open(&folder.0, cube([2, 2, 2]), 2, Policy::NewestWins).unwrap();
    publish(&producer, 0, 0.0).unwrap();
    drop(producer);
    // The stopped follower ends, and the next one cleans up.
    drop(file);
    drop(Following::begin(&folder.0).unwrap());
    assert!(!folder.0.exists());
}

#[test]
fn waiting_is_bounded_and_happens_once() {
    let folder = Folder::new("wait");
    let limit = Duration::from_secs(1);
    let producer = Producer::open(&folder.0, cube([2, 2, 2]), 2, Policy::Wait(limit)).unwrap();
    let timed = |n: u64| {
        let begin = Instant::now();
        let published = publish(&producer, n, n as f64).unwrap();
        (published.overwrote, begin.elapsed())
    };
    assert!(!timed(0).0 && !timed(1).0);
    let (overwrote, took) = timed(2);
    assert!(overwrote && took >= limit, "{took:?}");
    // A busy machine may delay one of them.
    let again = [3, 4, 5, 6].map(timed);
    assert!(again.iter().all(|(overwrote, _)| *overwrote), "{again:?}");
    assert!(again.iter().any(|(_, took)| *took < limit), "{again:?}: no follower moved, so the producer does not wait again");
}

#[test]
fn a_follower_that_takes_steps_is_waited_for_and_loses_none() {
    let folder = Folder::new("taking");
    let producer = Producer::open(&folder.0, cube([2, 2, 2]), 2, Policy::Wait(Duration::from_secs(120))).unwrap();
    (0..2).for_each(|n| _ = publish(&producer, n, n as f64).unwrap());
    let path = folder.0.clone();
    let mut reader = RingReader::open(&path, 0, &Limits::default()).unwrap();
    let (taken, took_one) = std::sync::mpsc::sync_channel(32);
    let follower = std::thread::spawn(move || {
        let (mut buffer, mut seen) = (Vec::new(), Vec::new());
        while seen.last() != Some(&30) {
            match reader.read(&mut buffer).unwrap() {
                Read::Step(info) => {
                    seen.push(info.step);
                    std::thread::sleep(Duration::from_millis(3));
                    reader.acknowledge(0).unwrap();
                    taken.send(()).unwrap();
                }
                _ => std::thread::yield_now(),
            }
        }
        seen
    });
    took_one.recv().unwrap();
    for n in 2..=30 {
        assert!(!publish(&producer, n, n as f64).unwrap().overwrote, "step {n}");
    }
    assert_eq!(follower.join().unwrap(), (0..=30).collect::<Vec<_>>());
}

#[test]
fn threads_may_publish_at_once_and_a_fork_may_not() {
    let folder = Folder::alone("threads");
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
    // SAFETY: the child does not wait for a lock of another thread, and ends by _exit.
    let child = unsafe { libc::fork() };
    if child == 0 {
        let data = [0.0f32; 512];
        let pointers = [data.as_ptr().cast::<u8>(); 3];
        // SAFETY: 512 values, as described.
        let refused = unsafe { producer.publish(99, 0.0, &Field::packed(&pointers, Element::F32, [8, 8, 8])) };
        // Closing it in the child must not end the parent's ring.
        drop(producer);
        // SAFETY: ends the child.
        unsafe { libc::_exit(if matches!(refused, Err(WireError::Forked { .. })) { 0 } else { 1 }) };
    }
    let mut status = 0;
    // SAFETY: waits for the child made above.
    unsafe { libc::waitpid(child, &mut status, 0) };
    assert_eq!(status, 0);
    assert!(producer_lives(&folder.0, 0).unwrap());
    publish(&producer, 40, 0.0).unwrap();
    assert_eq!(step(&mut reader, &mut buffer).unwrap().step, 40);
}

#[test]
fn a_child_that_another_thread_has_made_keeps_no_lock() {
    let folder = Folder::alone("child");
    let following = Following::begin(&folder.0).unwrap();
    let mark = following.mark().unwrap();
    let producer = Producer::open(&folder.0, cube([2, 2, 2]), 2, Policy::NewestWins).unwrap();
    // As between fork and exec of `system()`: the child holds a copy of every descriptor until the pipe ends.
    let (from, to) = std::io::pipe().unwrap();
    // SAFETY: the child reads from a pipe and ends by _exit.
    let child = unsafe { libc::fork() };
    if child == 0 {
        drop(to);
        let _ = std::io::Read::read(&mut &from, &mut [0]);
        // In a fork none of the locks is released.
        drop((following, producer));
        // SAFETY: ends the child.
        unsafe { libc::_exit(0) };
    }
    drop(producer);
    // The name is free at once, and no mark is taken.
    let next = Producer::open(&folder.0, cube([2, 2, 2]), 2, Policy::NewestWins).unwrap();
    drop(following);
    let other = Following::begin(&folder.0).unwrap();
    assert_eq!(other.mark().unwrap(), mark);
    // The child closes its copies: the new locks on the same files remain.
    drop((from, to));
    // SAFETY: waits for the child made above.
    unsafe { libc::waitpid(child, &mut 0, 0) };
    assert!(producer_lives(&folder.0, 0).unwrap());
    drop(next);
    assert!(folder.0.exists(), "its last steps stay for the follower");
    drop(other);
    assert!(!folder.0.exists(), "nothing is left behind");
}

#[test]
fn the_slowest_of_several_followers_is_waited_for_and_one_that_left_is_not() {
    let folder = Folder::new("marks");
    let producer = Producer::open(&folder.0, cube([2, 2, 2]), 2, Policy::Wait(Duration::from_secs(120))).unwrap();
    let followers = [Following::begin(&folder.0).unwrap(), Following::begin(&folder.0).unwrap()];
    let marks = followers.each_ref().map(|f| f.mark().unwrap());
    assert_eq!(marks, [0, 1]);
    let mut readers = [0, 1].map(|_| RingReader::open(&folder.0, 0, &Limits::default()).unwrap());
    for n in 0..2 {
        publish(&producer, n, n as f64).unwrap();
    }
    let mut buffer = Vec::new();
    // The first follower has taken all steps, the second none.
    readers[1].acknowledge(marks[1]).unwrap();
    while step(&mut readers[0], &mut buffer).is_some() {}
    readers[0].acknowledge(marks[0]).unwrap();
    std::thread::scope(|scope| {
        let publishing = scope.spawn(|| publish(&producer, 2, 2.0).unwrap());
        std::thread::sleep(Duration::from_millis(100));
        assert!(!publishing.is_finished(), "the second has not taken step 0");
        let mut buffer = Vec::new();
        assert_eq!(step(&mut readers[1], &mut buffer).unwrap().step, 0);
        readers[1].acknowledge(marks[1]).unwrap();
        assert!(!publishing.join().unwrap().overwrote);
    });
    // Its number is free for the next follower.
    readers[1].leave(marks[1]).unwrap();
    let [first, second] = followers;
    drop(second);
    let next = Following::begin(&folder.0).unwrap();
    assert_eq!(next.mark().unwrap(), 1);
    // A follower that has left delays no step: the first continues alone.
    let mut taking = std::thread::scope(|scope| {
        let taking = scope.spawn(|| {
            let (mut buffer, mut seen) = (Vec::new(), Vec::new());
            while seen.last() != Some(&6) {
                seen.extend(step(&mut readers[0], &mut buffer).map(|info| info.step));
                readers[0].acknowledge(marks[0]).unwrap();
                std::thread::sleep(Duration::from_millis(1));
            }
            seen
        });
        let begin = Instant::now();
        let overwrote = (3..7).filter(|n| publish(&producer, *n, *n as f64).unwrap().overwrote).count();
        // A silent follower that has not left would be waited for five seconds.
        assert!(overwrote == 0 && begin.elapsed() < Duration::from_secs(4), "{overwrote} {:?}", begin.elapsed());
        taking.join().unwrap()
    });
    taking.sort_unstable();
    assert_eq!(taking, (2..7).collect::<Vec<_>>());
    drop(first);
}

#[test]
fn there_are_64_marks() {
    let folder = Folder::new("many");
    let followers: Vec<_> = (0..65).map(|_| Following::begin(&folder.0).unwrap()).collect();
    let marks: Vec<_> = followers[..64].iter().map(|f| f.mark().unwrap()).collect();
    assert_eq!(marks, (0..64).collect::<Vec<_>>());
    let error = followers[64].mark().unwrap_err().to_string();
    assert!(error.contains("64 follow") && error.contains("at most 64"), "{error}");
}
