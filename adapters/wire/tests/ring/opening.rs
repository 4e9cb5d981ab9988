//! Rings that cannot be opened, and files that opening leaves.

use super::{Folder, cube, overwrite, publish, step, values};
use ridgewatch_wire::{
    BlockExtent, Description, Element, Event, Field, Following, Geometry, Limits, Policy, Producer, RING_VARIABLE, RingFollower,
    RingReader, WireError, block_path, blocks, producer_lives,
};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

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
        // SAFETY: a call that is not refused reads 8 of 9 values.
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
    assert!(producer_lives(&folder.0, 0).unwrap());
    // As after SIGKILL: the files stay, and the lock is released.
    let reader = RingReader::open(&folder.0, 0, &Limits::default()).unwrap();
    let left = std::fs::read(block_path(&folder.0, 0)).unwrap();
    drop(first);
    assert!(!producer_lives(&folder.0, 0).unwrap() && !folder.0.exists(), "without a follower the folder is removed");
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

/// Path of the file whose lock the producer of block 0 holds.
fn lock_of(ring: &Path) -> PathBuf {
    ring.join("block-00000.lock")
}

#[test]
fn a_living_ring_whose_lock_was_removed_by_hand_is_neither_replaced_nor_taken_for_dead() {
    let folder = Folder::new("unlocked");
    let first = Producer::open(&folder.0, cube([2, 2, 2]), 2, Policy::NewestWins).unwrap();
    std::fs::remove_file(lock_of(&folder.0)).unwrap();
    assert!(producer_lives(&folder.0, 0).unwrap());
    let error = Producer::open(&folder.0, cube([2, 2, 2]), 2, Policy::NewestWins).unwrap_err();
    assert!(matches!(error, WireError::InUse { pid, .. } if pid == u64::from(std::process::id())), "{error}");
    // A follower that comes and one that leaves take it for living too.
    let mut follower = RingFollower::begin(&folder.0, Limits::default()).unwrap();
    let mut values = Vec::new();
    assert!(matches!(follower.poll(&mut values), Some(Event::Opened { .. })));
    publish(&first, 3, 0.0).unwrap();
    assert!(matches!(follower.poll(&mut values), Some(Event::Step { step: 3, .. })));
    std::thread::sleep(Duration::from_millis(150));
    assert!(follower.poll(&mut values).is_none());
    drop(follower);
    publish(&first, 4, 1.0).unwrap();
    let mut reader = RingReader::open(&folder.0, 0, &Limits::default()).unwrap();
    assert_eq!(step(&mut reader, &mut values).unwrap().step, 3);
    drop(first);
    assert!(!folder.0.exists(), "{:?}", std::fs::read_dir(&folder.0).unwrap().flatten().collect::<Vec<_>>());
}

#[test]
fn a_producer_whose_ring_was_removed_by_hand_is_told_and_takes_nothing_from_the_next() {
    let folder = Folder::new("removed");
    let first = Producer::open(&folder.0, cube([2, 2, 2]), 2, Policy::NewestWins).unwrap();
    publish(&first, 0, 0.0).unwrap();
    std::fs::remove_file(block_path(&folder.0, 0)).unwrap();
    assert!(matches!(publish(&first, 1, 1.0), Err(WireError::Removed)));
    // The name is still the first one's.
    assert!(matches!(Producer::open(&folder.0, cube([2, 2, 2]), 2, Policy::NewestWins), Err(WireError::InUse { .. })));
    std::fs::remove_dir_all(&folder.0).unwrap();
    let second = Producer::open(&folder.0, cube([2, 2, 2]), 2, Policy::NewestWins).unwrap();
    let error = publish(&first, 2, 2.0).unwrap_err().to_string();
    assert!(error.contains("was removed") && error.contains("open it again"), "{error}");
    drop(first);
    publish(&second, 5, 0.0).unwrap();
    let mut reader = RingReader::open(&folder.0, 0, &Limits::default()).unwrap();
    assert_eq!(step(&mut reader, &mut Vec::new()).unwrap().step, 5);
    assert!(producer_lives(&folder.0, 0).unwrap() && lock_of(&folder.0).exists());
    drop(second);
    assert!(!folder.0.exists());
}

#[test]
fn open_rings_links_and_odd_files_are_refused() {
    let folder = Folder::new("foreign");
    let producer = Producer::open(&folder.0, cube([2, 2, 2]), 2, Policy::NewestWins).unwrap();
    let path = block_path(&folder.0, 0);
    let open = || RingReader::open(&folder.0, 0, &Limits::default()).unwrap_err();
    std::fs::set_permissions(&path, PermissionsExt::from_mode(0o640)).unwrap();
    assert!(matches!(open(), WireError::Foreign { found, .. } if found == "has mode 0640"));
    std::fs::set_permissions(&path, PermissionsExt::from_mode(0o600)).unwrap();
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
    // A folder inside one that others may write into, who could replace it; the sticky bit prevents that.
    let within = open_to_all.join("ring");
    let error = Producer::open(&within, cube([2, 2, 2]), 2, Policy::NewestWins).unwrap_err().to_string();
    assert!(error.contains("open: is a folder that all users may write into (mode 0777)"), "{error}");
    std::fs::set_permissions(&open_to_all, PermissionsExt::from_mode(0o1777)).unwrap();
    drop(Producer::open(&within, cube([2, 2, 2]), 2, Policy::NewestWins).unwrap());
    std::fs::remove_dir_all(&open_to_all).unwrap();
    drop(producer);
}

#[test]
#[ignore = "gives a ring to another user, which needs root"]
fn rings_and_folders_of_another_user_are_refused() {
    let folder = Folder::new("theirs");
    let producer = Producer::open(&folder.0, cube([2, 2, 2]), 2, Policy::NewestWins).unwrap();
    let theirs = |error: WireError| matches!(error, WireError::Foreign { found, .. } if found == "belongs to user 12345");
    std::os::unix::fs::chown(block_path(&folder.0, 0), Some(12345), None).unwrap();
    assert!(theirs(RingReader::open(&folder.0, 0, &Limits::default()).unwrap_err()));
    drop(producer);
    std::fs::create_dir_all(&folder.0).unwrap();
    std::os::unix::fs::chown(&folder.0, Some(12345), None).unwrap();
    let error = Producer::open(&folder.0, cube([2, 2, 2]), 2, Policy::NewestWins).unwrap_err().to_string();
    assert!(error.contains("belongs to user 12345; accepted: a folder of user") && error.contains(RING_VARIABLE), "{error}");
    // A folder of this user inside one of another user, who may replace it whatever the mode.
    let within = folder.0.join("ring");
    for mode in [0o755, 0o1777] {
        std::fs::set_permissions(&folder.0, PermissionsExt::from_mode(mode)).unwrap();
        let error = Producer::open(&within, cube([2, 2, 2]), 2, Policy::NewestWins).unwrap_err().to_string();
        assert!(error.contains("is a folder of user 12345, who may replace") && error.contains(RING_VARIABLE), "{mode:o}: {error}");
        assert!(Following::begin(&within).is_err());
    }
    // In a user namespace the owner of /dev/shm is nobody.
    std::os::unix::fs::chown(&folder.0, Some(65534), None).unwrap();
    drop(Producer::open(&within, cube([2, 2, 2]), 2, Policy::NewestWins).unwrap());
}

/// Another user has made the folder's parent first, and lets nobody else in: the error says whose it is, and not only that it cannot be used.
#[test]
#[ignore = "becomes another user, which needs root"]
fn a_name_that_another_user_took_first_is_refused_with_what_to_do() {
    let folder = Folder::alone("squatted");
    std::fs::create_dir(&folder.0).unwrap();
    std::os::unix::fs::chown(&folder.0, Some(12346), None).unwrap();
    let ring = folder.0.join("run");
    // SAFETY: the child changes its user, tries to follow, and ends without returning into the test.
    let child = unsafe { libc::fork() };
    if child == 0 {
        // SAFETY: plain numbers.
        let changed = unsafe { libc::setresuid(12345, 12345, 12345) } == 0;
        let error = Following::begin(&ring).map_or_else(|error| error.to_string(), |_| String::new());
        let good = changed && error.contains("is a folder of user 12346, who may replace") && error.contains(RING_VARIABLE);
        // SAFETY: ends the child.
        unsafe { libc::_exit(i32::from(!good)) };
    }
    let mut status = 0;
    // SAFETY: a child of this process.
    assert_eq!(unsafe { libc::waitpid(child, &raw mut status, 0) }, child);
    assert_eq!(status, 0);
}

#[test]
fn what_a_producer_left_that_was_killed_while_it_opened_goes_with_the_last_follower() {
    let folder = Folder::new("half");
    let following = Following::begin(&folder.0).unwrap();
    // Block 3 has a lock and a partial ring, block 4 only a partial ring.
    for name in ["block-00003.lock", ".block-00003.part", ".block-00004.part"] {
        std::fs::write(folder.0.join(name), "half").unwrap();
        std::fs::set_permissions(folder.0.join(name), PermissionsExt::from_mode(0o600)).unwrap();
    }
    assert_eq!(blocks(&folder.0).collect::<Vec<_>>(), [3, 4]);
    drop(following);
    assert!(!folder.0.exists(), "{:?}", std::fs::read_dir(&folder.0).unwrap().flatten().collect::<Vec<_>>());
}

/// Error of a valid ring after a change.
fn changed(change: impl Fn(&Path), limits: &Limits) -> WireError {
    static NUMBER: std::sync::atomic::AtomicU32 = std::sync::atomic::AtomicU32::new(0);
    let folder = Folder::new(&format!("changed{}", NUMBER.fetch_add(1, std::sync::atomic::Ordering::Relaxed)));
    let producer = Producer::open(&folder.0, cube([4, 4, 4]), 2, Policy::NewestWins).unwrap();
    publish(&producer, 1, 1.0).unwrap();
    // A copy, because a producer whose own file is truncated is killed by a signal.
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

#[test]
fn damaged_rings_have_their_own_errors() {
    let limits = Limits::default();
    assert!(matches!(changed(|p| overwrite(p, 0, b"RIFF"), &limits), WireError::NotARing { .. }));
    assert!(matches!(changed(|p| overwrite(p, 8, &[1]), &limits), WireError::Version { what: "the ring", found: 1, known: 2 }));
    assert!(matches!(changed(|p| overwrite(p, 12, &[255; 4]), &limits), WireError::TooLarge { .. }));
    assert!(matches!(changed(|p| overwrite(p, 24, &[3]), &limits), WireError::Checksum { .. }));
    assert!(matches!(changed(|p| overwrite(p, 8200, &[77]), &limits), WireError::Checksum { .. }));
    let truncate = |length: u64| move |p: &Path| std::fs::OpenOptions::new().write(true).open(p).unwrap().set_len(length).unwrap();
    assert!(matches!(changed(truncate(100), &limits), WireError::Short { .. }));
    assert!(matches!(changed(truncate(8200), &limits), WireError::Short { .. }));
    assert!(matches!(changed(truncate(12288 + 100), &limits), WireError::Short { .. }));
    let small = Limits { step_bytes: 4 * 4 * 4 * 3 * 4 - 1 };
    assert!(matches!(changed(|_| {}, &small), WireError::TooLarge { .. }));
    // A time that is NaN, written behind the producer's back.
    assert!(matches!(changed(|p| overwrite(p, 12288 + 16, &f64::NAN.to_ne_bytes()), &limits), WireError::Field { field: "time", .. }));
}

#[test]
fn no_room_is_an_error_and_leaves_nothing() {
    let folder = Folder::new("room");
    // A petabyte.
    let description = cube([1 << 15, 1 << 15, 1 << 14]);
    let error = Producer::open(&folder.0, description, 16, Policy::NewestWins).unwrap_err();
    assert!(matches!(error, WireError::NoSpace { .. }), "{error}");
    assert!(!folder.0.exists());
}

#[test]
fn what_cannot_be_there_at_all_takes_nothing_from_who_follows() {
    let folder = Folder::new("impossible");
    let following = Following::begin(&folder.0).unwrap();
    for index in 0..2 {
        let mut description = cube([4, 4, 4]);
        description.block = BlockExtent { index, count: 2, offset: [0, 0, 2 * u64::from(index)], extent: [4, 4, 2] };
        publish(&Producer::open(&folder.0, description, 2, Policy::NewestWins).unwrap(), 7, 0.0).unwrap();
    }
    // The length of 4096 slots of 2^50 bytes overflows; a petabyte exceeds the memory.
    for (nodes, slots) in [([1 << 16, 1 << 16, 1 << 16], 4096), ([1 << 15, 1 << 15, 1 << 14], 16)] {
        let error = Producer::open(&folder.0, cube(nodes), slots, Policy::NewestWins).unwrap_err();
        assert!(matches!(error, WireError::NoSpace { .. }), "{error}");
        for block in 0..2 {
            let mut reader = RingReader::open(&folder.0, block, &Limits::default()).unwrap();
            assert_eq!(step(&mut reader, &mut Vec::new()).unwrap().step, 7);
        }
    }
    drop(following);
    assert!(!folder.0.exists());
}

#[test]
fn a_ring_on_a_disk_is_refused() {
    let kind = |place: &str| std::process::Command::new("stat").args(["-f", "-c", "%T", place]).output().map(|out| out.stdout);
    let on_disk =
        |place: &&&str| kind(place).is_ok_and(|kind| !kind.is_empty() && !kind.starts_with(b"tmpfs") && !kind.starts_with(b"ramfs"));
    let Some(disk) = [env!("CARGO_TARGET_TMPDIR"), "/var/tmp"].iter().find(on_disk) else {
        let _ = std::io::Write::write_all(&mut std::io::stderr(), b"NOT RUN: a ring on a disk, since no folder here lies on one\n");
        return;
    };
    let ring = Path::new(disk).join(format!("rw-test-disk-{}", std::process::id()));
    let error = Producer::open(&ring, cube([4, 4, 4]), 2, Policy::NewestWins).unwrap_err();
    assert!(matches!(error, WireError::NotInMemory { .. }), "{error}");
    assert!(error.to_string().contains("/dev/shm") && !ring.exists(), "{error}");
}

/// A small file system, unmounted when the test ends.
struct SmallDisk(PathBuf);

impl SmallDisk {
    fn new(name: &str, size: &str) -> Self {
        let disk = Self(std::env::temp_dir().join(format!("rw-test-{name}-{}", std::process::id())));
        std::fs::create_dir_all(&disk.0).unwrap();
        let options = format!("size={size},mode=0700");
        let mounted = std::process::Command::new("mount").args(["-t", "tmpfs", "-o", &options, "tmpfs"]).arg(&disk.0).status();
        assert!(mounted.unwrap().success(), "mounting needs root");
        disk
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        let _ = std::process::Command::new("umount").arg("-l").arg(&self.0).status();
        let _ = std::fs::remove_dir(&self.0);
    }
}

#[test]
#[ignore = "mounts a small file system, which needs root"]
fn a_full_file_system_refuses_the_next_ring_and_leaves_the_first_alone() {
    // Not while another test forks: its child would hold the ballast file open, and with it the memory.
    let _beside = Folder::new("full");
    let disk = SmallDisk::new("full", "1m");
    let (first, second) = (disk.0.join("first"), disk.0.join("second"));
    // 2 slots of 24^3 x 3 f32: 332 kB.
    let producer = Producer::open(&first, cube([24, 24, 24]), 2, Policy::NewestWins).unwrap();
    // A ring three times as large has no room, and the attempt leaves nothing.
    let error = Producer::open(&second, cube([24, 24, 24]), 6, Policy::NewestWins).unwrap_err();
    assert!(matches!(error, WireError::NoSpace { needed, .. } if needed > 900_000), "{error}");
    assert!(!second.exists());
    // Another file takes the rest, to the last page.
    let mut ballast = std::fs::File::create(disk.0.join("ballast")).unwrap();
    while std::io::Write::write_all(&mut ballast, &[1; 4096]).is_ok() {}
    // The memory reserved at opening suffices: every slot is written without a fault, and a follower reads them.
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
    // With room again, the refused name is free.
    drop(ballast);
    std::fs::remove_file(disk.0.join("ballast")).unwrap();
    Producer::open(&second, cube([4, 4, 4]), 2, Policy::NewestWins).unwrap();
}

/// A solver in `count` blocks, whose rings of 4 slots take 2.3 MB together, and that is killed after one step.
fn killed(ring: &Path, count: u32) {
    // SAFETY: the child opens producers and is killed, and needs no other thread.
    let child = unsafe { libc::fork() };
    if child == 0 {
        let producers = (0..count).map(|index| {
            let mut description = cube([24, 24, 84]);
            let part = 84 / u64::from(count);
            description.block = BlockExtent { index, count, offset: [0, 0, u64::from(index) * part], extent: [24, 24, part] };
            Producer::open(ring, description, 4, Policy::NewestWins).unwrap()
        });
        let producers: Vec<_> = producers.collect();
        for producer in &producers {
            publish(producer, 1, 1.0).unwrap();
        }
        // SAFETY: as if the machine ran out of memory.
        unsafe { libc::kill(libc::getpid(), libc::SIGKILL) };
    }
    let mut status = 0;
    // SAFETY: waits for this child.
    unsafe { libc::waitpid(child, &mut status, 0) };
    assert!(libc::WIFSIGNALED(status) && libc::WTERMSIG(status) == libc::SIGKILL);
}

#[test]
#[ignore = "mounts a small file system, which needs root"]
fn what_a_killed_run_left_takes_no_room_from_the_next() {
    let _alone = Folder::alone("again");
    let disk = SmallDisk::new("again", "3m");
    let ring = disk.0.join("ring");
    let open = || Producer::open(&ring, cube([24, 24, 84]), 4, Policy::NewestWins);
    // More than half of the memory, in as many blocks as the next run or in more, without a follower.
    for count in [1, 3] {
        killed(&ring, count);
        assert_eq!(blocks(&ring).count() as u32, count);
        drop(open().unwrap());
    }
    // With a follower that has the ring open and has not read it, like a stopped sidecar.
    let mut follower = RingFollower::begin(&ring, Limits::default()).unwrap();
    let mut told = |enough: &str| {
        let (mut seen, mut values, begin) = (Vec::new(), Vec::new(), Instant::now());
        while !seen.last().is_some_and(|last: &String| last.starts_with(enough)) && begin.elapsed() < Duration::from_secs(120) {
            match follower.poll(&mut values) {
                Some(Event::Opened { .. }) => seen.push("opened".to_owned()),
                Some(Event::Step { step, .. }) => seen.push(format!("step {step}")),
                Some(Event::Ended { closed, .. }) => seen.push(format!("ended {closed}")),
                Some(Event::Refused(error)) => seen.push(error.to_string()),
                None => std::thread::sleep(Duration::from_millis(1)),
            }
        }
        seen
    };
    let producer = open().unwrap();
    publish(&producer, 1, 1.0).unwrap();
    assert_eq!(told("step"), ["opened", "step 1"]);
    publish(&producer, 2, 2.0).unwrap();
    drop(producer);
    let next = open().unwrap();
    publish(&next, 3, 3.0).unwrap();
    let seen = told("step 3");
    assert!(seen.len() == 4 && seen[0].contains("was it truncated?"), "{seen:?}");
    assert_eq!(seen[1..], ["ended false", "opened", "step 3"]);
}

/// A solver in a process of its own, which publishes into a ring of 2.3 MB until a file `stop` exists beside the ring. Returns its process id.
fn solver_beside(ring: &Path) -> i32 {
    // SAFETY: the child opens a producer and ends, and needs no other thread.
    let child = unsafe { libc::fork() };
    if child == 0 {
        let producer = Producer::open(ring, cube([24, 24, 84]), 4, Policy::NewestWins).unwrap();
        let begin = Instant::now();
        let mut step = 0;
        while !ring.with_file_name("stop").exists() && begin.elapsed() < Duration::from_secs(60) {
            publish(&producer, step, step as f64).unwrap();
            step += 1;
        }
        // SAFETY: ends the child without the tests' own cleaning.
        unsafe { libc::_exit(0) };
    }
    let begin = Instant::now();
    let published = || RingReader::open(ring, 0, &Limits::default()).is_ok_and(|mut reader| step(&mut reader, &mut Vec::new()).is_some());
    while !published() {
        assert!(begin.elapsed() < Duration::from_secs(30));
        std::thread::sleep(Duration::from_millis(1));
    }
    child
}

#[test]
#[ignore = "mounts a small file system, which needs root"]
fn a_second_start_without_room_does_not_kill_a_solver_whose_lock_was_removed() {
    let _alone = Folder::alone("second");
    // The second start has the same block, or another block of the same run.
    for count in [1, 2] {
        let disk = SmallDisk::new(&format!("second{count}"), "3m");
        let ring = disk.0.join("ring");
        let child = solver_beside(&ring);
        std::fs::remove_file(lock_of(&ring)).unwrap();
        let extent = [24, 24, 84];
        let block = BlockExtent { index: count - 1, count, offset: [0, 0, 84 * u64::from(count - 1)], extent };
        let description = match count {
            1 => cube(extent),
            _ => Description { block, ..cube([24, 24, 168]) },
        };
        let second = Producer::open(&ring, description, 4, Policy::NewestWins).map(drop);
        std::thread::sleep(Duration::from_millis(200));
        std::fs::write(disk.0.join("stop"), "").unwrap();
        let mut status = 0;
        // SAFETY: waits for this child.
        unsafe { libc::waitpid(child, &mut status, 0) };
        let signal = libc::WIFSIGNALED(status).then(|| libc::WTERMSIG(status));
        assert_eq!(
            (signal, libc::WEXITSTATUS(status)),
            (None, 0),
            "{count} blocks: SIGBUS is {}; the second start: {second:?}",
            libc::SIGBUS
        );
        match count {
            1 => assert!(matches!(second, Err(WireError::InUse { .. })), "{second:?}"),
            _ => assert!(matches!(second, Err(WireError::NoSpace { .. })), "{second:?}"),
        }
    }
}

#[test]
#[ignore = "mounts a small file system, which needs root"]
fn no_more_of_a_killed_run_goes_than_the_next_needs() {
    let _alone = Folder::alone("least");
    let disk = SmallDisk::new("least", "3m");
    let ring = disk.0.join("ring");
    let _following = Following::begin(&ring).unwrap();
    // Three rings of 0.79 MB leave 0.7 MB.
    killed(&ring, 3);
    let there = || [0, 1, 2].map(|block| block_path(&ring, block).exists());
    let open = |slots| {
        let block = BlockExtent { index: 1, count: 3, offset: [0, 0, 28], extent: [24, 24, 28] };
        Producer::open(&ring, Description { block, ..cube([24, 24, 84]) }, slots, Policy::NewestWins).map(drop)
    };
    // 3.9 MB exceed even the empty file system.
    assert!(matches!(open(20), Err(WireError::NoSpace { .. })));
    assert_eq!(there(), [true; 3]);
    // 1.2 MB fit without the ring of this name, 2 MB without one more.
    open(6).unwrap();
    assert_eq!(there(), [true; 3], "the new ring replaces the old one of its name");
    open(10).unwrap();
    assert_eq!(there(), [false, true, true]);
}
