//! Files that killed solvers and followers leave, and who removes them.

use super::{Folder, cube, publish, step};
use ridgewatch_wire::{
    BlockExtent, Description, Following, Limits, Policy, Producer, RingFollower, RingReader, WireError, block_path, clean, find_rings,
    leftovers,
};
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Runs `work` in a process of its own and kills that process when `work` is done and `meanwhile` has returned.
fn killed_after(work: impl FnOnce() -> Box<dyn std::any::Any>, ready: &Path, meanwhile: impl FnOnce()) {
    // SAFETY: the child needs no other thread and is killed.
    let child = unsafe { libc::fork() };
    if child == 0 {
        let _held = work();
        std::fs::write(ready, "").unwrap();
        std::thread::sleep(Duration::from_secs(60));
        // SAFETY: ends the child without the tests' own cleaning.
        unsafe { libc::_exit(1) };
    }
    let begin = Instant::now();
    while !ready.exists() {
        assert!(begin.elapsed() < Duration::from_secs(30));
        std::thread::sleep(Duration::from_millis(1));
    }
    std::fs::remove_file(ready).unwrap();
    meanwhile();
    let mut status = 0;
    // SAFETY: ends and waits for this child.
    unsafe { (libc::kill(child, libc::SIGKILL), libc::waitpid(child, &mut status, 0)) };
    assert!(libc::WIFSIGNALED(status));
}

fn names(folder: &Path) -> Vec<String> {
    let mut names: Vec<String> =
        std::fs::read_dir(folder).into_iter().flatten().map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

/// A ring whose solver ended while it was followed, and whose follower was killed.
fn forsaken(ring: &Path) {
    let ready = ring.with_extension("ready");
    let follow = || Box::new(RingFollower::begin(ring, Limits::default()).unwrap()) as Box<dyn std::any::Any>;
    killed_after(follow, &ready, || {
        let producer = Producer::open(ring, cube([16, 16, 16]), 2, Policy::NewestWins).unwrap();
        publish(&producer, 7, 1.0).unwrap();
    });
    assert_eq!(names(ring), ["block-00000.lock", "block-00000.ring", "followers.lock"]);
}

#[test]
fn a_ring_that_its_solver_and_its_follower_left_is_found_and_removed() {
    let folder = Folder::alone("forsaken");
    let ring = folder.0.join("run");
    std::fs::create_dir(&folder.0).unwrap();
    forsaken(&ring);
    // Looking changes nothing, and a link leads nowhere.
    symlink(&ring, folder.0.join("link")).unwrap();
    assert_eq!(find_rings(&folder.0), std::slice::from_ref(&ring));
    let found = leftovers(&ring).unwrap();
    assert_eq!((found.living.len(), found.followed), (0, false));
    let files: Vec<PathBuf> = found.leftovers.iter().map(|file| file.path.clone()).collect();
    assert_eq!(files, ["block-00000.ring", "block-00000.lock", "followers.lock"].map(|name| ring.join(name)));
    let bytes = found.leftovers.iter().map(|file| file.bytes).collect::<Vec<_>>();
    assert!(bytes[0] > 2 * 16 * 16 * 16 * 3 * 4 && bytes[1..] == [0, 0], "{bytes:?}");
    assert_eq!(clean(&ring).unwrap(), found);
    assert!(!ring.exists() && find_rings(&folder.0).is_empty());
    assert!(matches!(clean(&ring), Err(WireError::Io { source, .. }) if source.kind() == std::io::ErrorKind::NotFound));
    // An empty lock of a follower that was killed before any solver came.
    killed_after(|| Box::new(Following::begin(&ring).unwrap()), &folder.0.join("ready"), || {});
    assert_eq!(names(&ring), ["followers.lock"]);
    assert_eq!(clean(&ring).unwrap().leftovers.len(), 1);
    assert!(!ring.exists());
}

#[test]
fn cleaning_takes_nothing_from_who_lives() {
    let folder = Folder::alone("living");
    let ring = &folder.0;
    let of = |index: u64| {
        let block = BlockExtent { index: index as u32, count: 2, offset: [0, 0, 2 * index], extent: [4, 4, 2] };
        Producer::open(ring, Description { block, ..cube([4, 4, 4]) }, 2, Policy::NewestWins).unwrap()
    };
    let living = of(0);
    killed_after(|| Box::new(of(1)), &ring.with_extension("ready"), || {});
    // Its lock was removed by hand.
    std::fs::remove_file(ring.join("block-00000.lock")).unwrap();
    // A follower may still read what a solver has left.
    let following = Following::begin(ring).unwrap();
    let found = clean(ring).unwrap();
    assert_eq!((found.leftovers.len(), found.living.as_slice(), found.followed), (0, &[0][..], true));
    drop(following);
    killed_after(|| Box::new(of(1)), &ring.with_extension("ready"), || {});
    let found = clean(ring).unwrap();
    assert_eq!((found.leftovers.len(), found.living.as_slice(), found.followed), (2, &[0][..], false));
    assert_eq!(names(ring), ["block-00000.ring"]);
    publish(&living, 3, 0.0).unwrap();
    let mut reader = RingReader::open(ring, 0, &Limits::default()).unwrap();
    assert_eq!(step(&mut reader, &mut Vec::new()).unwrap().step, 3);
    drop(living);
    assert!(!ring.exists());
}

#[test]
fn the_first_follower_removes_what_killed_solvers_left_and_reads_what_ended() {
    let folder = Folder::alone("first");
    let ring = &folder.0;
    let ready = ring.with_extension("ready");
    killed_after(|| Box::new(Producer::open(ring, cube([16, 16, 16]), 2, Policy::NewestWins).unwrap()), &ready, || {});
    assert!(block_path(ring, 0).exists());
    let following = Following::begin(ring).unwrap();
    assert_eq!(names(ring), ["followers.lock"]);
    // A second follower removes nothing: the first one may read it.
    killed_after(|| Box::new(Producer::open(ring, cube([16, 16, 16]), 2, Policy::NewestWins).unwrap()), &ready, || {});
    drop(Following::begin(ring).unwrap());
    assert!(block_path(ring, 0).exists());
    drop(following);
    assert!(!ring.exists());
    // The last steps of a solver that has ended are read by the next follower.
    forsaken(ring);
    let following = Following::begin(ring).unwrap();
    let mut reader = RingReader::open(ring, 0, &Limits::default()).unwrap();
    assert_eq!(step(&mut reader, &mut Vec::new()).unwrap().step, 7);
    drop(following);
    assert!(!ring.exists());
}
