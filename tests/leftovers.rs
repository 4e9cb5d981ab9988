//! What processes leave in shared memory and among temporary files, and `ridgewatch clean`.

#![allow(clippy::unwrap_used)] // Tests: a panic is the report.

mod kit;

use kit::program::{ridgewatch, run, start, text, until};
use kit::ring::{Ring, grid, publish};
use kit::scene::{self, double_gyre};
use ridgewatch_wire::{Policy, Producer};
use std::path::Path;
use std::process::Command;

fn names(folder: &Path) -> Vec<String> {
    let mut names: Vec<String> =
        std::fs::read_dir(folder).into_iter().flatten().map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

/// A relay is a follower like `attach`, and starts at once.
#[test]
fn a_ring_that_its_solver_and_its_killed_sidecar_left_is_listed_and_removed() {
    let ring = Ring::new("leftovers");
    let files = tempfile::tempdir().unwrap();
    let connection = files.path().join("connection");
    let sidecar = start(&mut ridgewatch(["relay", text(&ring.0), "--connection", text(&connection)]));
    until("the relay", || connection.exists());
    let producer = Producer::open(&ring.0, grid(&[4, 4]), 2, Policy::NewestWins).unwrap();
    publish(&producer, 1, 0.0, &[&[0.0; 16], &[0.0; 16]]);
    // Nothing is taken while it is published and followed.
    let clean = |arguments: &[&str]| run(ridgewatch(["clean"]).args(arguments)).success();
    let found = clean(&[text(&ring.0), "--json"]).json();
    assert_eq!((found[0]["living"][0].as_u64(), found[0]["followed"].as_bool()), (Some(0), Some(true)), "{found}");
    drop(producer);
    drop(sidecar);
    assert_eq!(names(&ring.0), ["block-00000.lock", "block-00000.ring", "followers.lock"]);
    let listed = clean(&[text(&ring.0), "--dry-run"]).stdout;
    assert!(listed.contains(&format!("would remove {}/block-00000.ring (", ring.0.display())), "{listed}");
    assert_eq!(names(&ring.0).len(), 3);
    // Without arguments it finds the ring below /dev/shm. Other tests' rings are left alone.
    let found = clean(&["--dry-run", "--json"]).json();
    assert!(found.as_array().unwrap().iter().any(|one| one["ring"] == text(&ring.0)), "{found}");
    let removed = clean(&[text(&ring.0)]).stdout;
    assert!(!ring.0.exists() && removed.lines().count() == 3 && removed.starts_with("removed "), "{removed}");
    assert_eq!(clean(&[text(&ring.0)]).stdout, "nothing to remove\n");
    run(&mut ridgewatch(["clean", "--set", "a.b=1"])).refused(2, &["--set", "accepted: RING"]);
}

/// With too few descriptors a run fails at one place or another, and never leaves a temporary folder.
#[test]
fn without_descriptors_no_temporary_folder_is_left() {
    let files = tempfile::tempdir().unwrap();
    let temporary = files.path().join("temporary");
    std::fs::create_dir(&temporary).unwrap();
    let scene =
        scene::write(files.path(), &double_gyre([8, 4, 1], "time.tau = 1\ntransfer.low = 0.05\ntransfer.high = 0.45\nflow.steps = 4"));
    for descriptors in 10..20 {
        let mut shell = Command::new("sh");
        shell.args(["-c", "ulimit -n \"$1\"; shift; exec \"$@\"", "sh", &descriptors.to_string(), env!("CARGO_BIN_EXE_ridgewatch")]);
        shell.args(["replay", &scene, "--publish=tcp://127.0.0.1:0", "--method", "reference", "--overwrite", "--out"]);
        let outcome = run(shell.arg(files.path().join("run")).env("TMPDIR", &temporary));
        assert_eq!(names(&temporary), [""; 0], "{descriptors} descriptors: {}", outcome.stderr);
        assert!(
            matches!(outcome.status, Some(0 | 1)) && !outcome.stderr.contains("panicked"),
            "{descriptors} descriptors: {}",
            outcome.stderr
        );
    }
}
