//! Archives to which snapshots are added while they are read.

use crate::kit::netcdf::*;
use crate::{DAYS, open_with, refused};
use ridgewatch::field::Snapshot;
use ridgewatch::source::{ReadAhead, SnapshotSource, follow};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};
use tempfile::tempdir;

const LONGEST: Duration = Duration::from_secs(60);

/// A file of these days, in which u is the day; `parts` of its components.
fn fixture(days: &[f64], parts: &[&str]) -> Fixture {
    fixture_as(CLASSIC, days, parts)
}

fn fixture_as(format: Format, days: &[f64], parts: &[&str]) -> Fixture {
    let nodes = |value: &dyn Fn(f64) -> f64| f32s(days.iter().flat_map(|&day| [value(day); 12]).collect());
    let fixture = Fixture::on(
        format,
        &[("time", DAYS, days), ("lat", "degrees_north", &[10.0, 11.0, 12.0]), ("lon", "degrees_east", &[5.0, 6.0, 7.0, 8.0])],
    );
    parts.iter().fold(fixture, |fixture, part| {
        let value: &dyn Fn(f64) -> f64 = if *part == "u" { &|day| day } else { &|_| 0.5 };
        fixture.fields("m/s", [(*part, nodes(value))])
    })
}

/// Writes beside the name first, as no reader would find it in part.
fn put(dir: &Path, name: &str, fixture: &Fixture) -> PathBuf {
    let part = fixture.write(&dir.join(format!("{name}.part")));
    let whole = dir.join(name);
    std::fs::rename(part, &whole).unwrap();
    whole
}

/// The days of the next snapshots, by their values.
fn next(reader: &mut ReadAhead, count: usize) -> Vec<f64> {
    (0..count).map(|_| day(&reader.next_within(LONGEST).expect("no snapshot came").expect("the archive ended").unwrap())).collect()
}

/// Day of a snapshot, by its values.
fn day(snapshot: &Snapshot) -> f64 {
    let node = snapshot.nodes[5];
    let speed = (0..3).map(|k| f64::from(node[k]).powi(2)).sum::<f64>().sqrt();
    (speed * speed - 0.25).sqrt().round()
}

fn followed(dir: &Path, pattern: &str, longest: Duration) -> ReadAhead {
    let archive = open_with(&[dir.join(pattern)], "follow = 60\nmask = \"none\"");
    follow(Box::new(archive), 2, longest)
}

/// Warnings of the looks, as soon as there are some.
fn warnings(reader: &ReadAhead) -> Vec<String> {
    let begin = Instant::now();
    let mut found = Vec::new();
    while found.is_empty() && begin.elapsed() < LONGEST {
        std::thread::sleep(Duration::from_millis(50));
        found.extend(reader.news().warnings);
    }
    found
}

/// Files that settle at the same look are read by their times, not by their names; one that has grown before its turn is read as it was planned, and
/// then on.
#[test]
fn names_and_turns_do_not_matter() {
    let dir = tempdir().unwrap();
    put(dir.path(), "run_1.nc", &fixture(&[1.0, 2.0, 3.0, 4.0, 5.0], &["u", "v"]));
    put(dir.path(), "run_2.nc", &fixture(&[6.0], &["u", "v"]));
    let mut reader = followed(dir.path(), "*.nc", LONGEST);
    // At most two wait, and one is in hand.
    put(dir.path(), "run_2.nc", &fixture(&[6.0, 7.0], &["u", "v"]));
    assert_eq!(next(&mut reader, 7), [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]);
    for (name, day) in [("run_10.nc", 9.0), ("run_9.nc", 8.0)] {
        put(dir.path(), name, &fixture(&[day], &["u", "v"]));
    }
    assert_eq!(next(&mut reader, 2), [8.0, 9.0]);
    assert_eq!(reader.news().warnings, Vec::<String>::new());
    // A store that comes later.
    let store = dir.path().join("x.nc");
    std::fs::create_dir(&store).unwrap();
    std::fs::write(store.join(".zgroup"), "{\"zarr_format\": 2}").unwrap();
    let found = warnings(&reader);
    assert!(found.len() == 1 && found[0].contains("x.nc: a Zarr store is not followed"), "{found:?}");
}

/// A file of HDF5 to which another handle appends.
#[test]
fn records_that_are_appended_are_read() {
    let dir = tempdir().unwrap();
    let path = dir.path().join("grows.nc");
    let write = |day: usize, file: &mut netcdf::FileMut| {
        let value = |name: &str| if name == "u" { day as f32 } else { 0.5 };
        file.variable_mut("time").unwrap().put_values(&[day as f64], day - 1..day).unwrap();
        for name in ["u", "v"] {
            file.variable_mut(name).unwrap().put_values(&[value(name); 12], (day - 1..day, 0..3, 0..4)).unwrap();
        }
    };
    {
        let mut file = netcdf::create(&path).unwrap();
        file.add_unlimited_dimension("time").unwrap();
        for (name, units, values) in [("lat", "degrees_north", &[10.0, 11.0, 12.0][..]), ("lon", "degrees_east", &[5.0, 6.0, 7.0, 8.0])] {
            file.add_dimension(name, values.len()).unwrap();
            let mut variable = file.add_variable::<f64>(name, &[name]).unwrap();
            variable.put_attribute("units", units).unwrap();
            variable.put_values(values, ..).unwrap();
        }
        file.add_variable::<f64>("time", &["time"]).unwrap().put_attribute("units", DAYS).unwrap();
        for name in ["u", "v"] {
            file.add_variable::<f32>(name, &["time", "lat", "lon"]).unwrap().put_attribute("units", "m/s").unwrap();
        }
        write(1, &mut file);
        write(2, &mut file);
    }
    let mut reader = followed(dir.path(), "*.nc", LONGEST);
    assert_eq!(next(&mut reader, 2), [1.0, 2.0]);
    // The library refuses to write to a file that this process has open, as the reader has until it looks for more.
    let append = || {
        let begin = Instant::now();
        loop {
            match netcdf::append(&path) {
                Err(netcdf::Error::Netcdf(-101)) if begin.elapsed() < LONGEST => std::thread::sleep(Duration::from_millis(5)),
                file => return file.unwrap(),
            }
        }
    };
    write(3, &mut append());
    assert_eq!(next(&mut reader, 1), [3.0]);
    write(4, &mut append());
    assert_eq!(next(&mut reader, 1), [4.0]);
}

#[test]
fn files_that_come_and_files_that_grow_are_read_on() {
    let dir = tempdir().unwrap();
    put(dir.path(), "a.nc", &fixture(&[1.0, 2.0], &["u", "v"]));
    let mut reader = followed(dir.path(), "*.nc", LONGEST);
    assert_eq!(next(&mut reader, 2), [1.0, 2.0]);
    // A new file, whose first time lies before the newest.
    put(dir.path(), "b.nc", &fixture(&[1.5, 3.0, 4.0], &["u", "v"]));
    assert_eq!(next(&mut reader, 2), [3.0, 4.0]);
    let news = reader.news();
    assert_eq!(
        news.dates.iter().map(|(_, date)| date.clone().unwrap()).collect::<Vec<_>>(),
        ["2000-01-04T00:00:00Z", "2000-01-05T00:00:00Z"]
    );
    assert!(news.warnings[0].contains("b.nc: 1 of its times lie before the newest"), "{:?}", news.warnings);
    // The same file with two more times.
    put(dir.path(), "b.nc", &fixture(&[1.5, 3.0, 4.0, 5.0, 6.0], &["u", "v"]));
    assert_eq!(next(&mut reader, 2), [5.0, 6.0]);
    assert_eq!(reader.news().warnings, Vec::<String>::new());
    // What cannot be read is told once, and read when it has changed.
    std::fs::write(dir.path().join("c.nc"), "no data yet").unwrap();
    let warnings = warnings(&reader);
    assert!(warnings.len() == 1 && warnings[0].contains("c.nc") && warnings[0].contains("not read, until it changes"), "{warnings:?}");
    put(dir.path(), "c.nc", &fixture(&[7.0], &["u", "v"]));
    assert_eq!(next(&mut reader, 1), [7.0]);
    // Another grid.
    let other =
        Fixture::on(CLASSIC, &[("time", DAYS, &[8.0]), ("lat", "degrees_north", &[10.0, 11.0]), ("lon", "degrees_east", &[5.0, 6.0])]);
    put(dir.path(), "d.nc", &other.winds(f32s(vec![1.0; 4]), f32s(vec![1.0; 4])));
    put(dir.path(), "e.nc", &fixture(&[9.0], &["u", "v"]));
    assert_eq!(next(&mut reader, 1), [9.0]);
    let warnings = reader.news().warnings;
    assert!(warnings.len() == 1 && warnings[0].contains("d.nc") && warnings[0].contains("axes"), "{warnings:?}");
}

#[test]
fn components_in_files_of_their_own_are_read_once_all_are_there() {
    let dir = tempdir().unwrap();
    for part in ["u", "v"] {
        put(dir.path(), &format!("1{part}.nc"), &fixture(&[1.0, 2.0], &[part]));
    }
    let mut reader = followed(dir.path(), "*.nc", LONGEST);
    assert_eq!(next(&mut reader, 2), [1.0, 2.0]);
    put(dir.path(), "2u.nc", &fixture(&[3.0], &["u"]));
    let warnings = warnings(&reader);
    assert!(warnings.len() == 1 && warnings[0].contains("not read yet") && warnings[0].contains("2u.nc"), "{warnings:?}");
    put(dir.path(), "2v.nc", &fixture(&[3.0], &["v"]));
    assert_eq!(next(&mut reader, 1), [3.0]);
}

#[test]
fn waiting_ends_after_the_longest_time_and_when_nobody_reads() {
    let dir = tempdir().unwrap();
    put(dir.path(), "a.nc", &fixture(&[1.0, 2.0], &["u", "v"]));
    let mut reader = followed(dir.path(), "*.nc", Duration::from_millis(300));
    assert!(reader.is_followed());
    assert_eq!(next(&mut reader, 2), [1.0, 2.0]);
    let begin = Instant::now();
    assert!(reader.next_within(LONGEST).unwrap().is_none() && !reader.is_followed());
    assert!(begin.elapsed() < Duration::from_secs(20), "{:?}", begin.elapsed());
    let archive = open_with(&[dir.path().join("*.nc")], "");
    assert_eq!(archive.times().len(), 2);
    let store = dir.path().join("x.zarr");
    std::fs::create_dir(&store).unwrap();
    std::fs::write(store.join(".zgroup"), "{\"zarr_format\": 2}").unwrap();
    refused(&[store], "follow = 5", &["follow", "Zarr store", "with files"]);
    refused(&[dir.path().join("a.nc")], "follow = 0", &["follow", "seconds above 0"]);
    refused(&[dir.path().join("a.nc")], "follow = 5\nmetric = \"index\"", &["follow", "index metric"]);
    refused(&[dir.path().join("a.nc")], "follow = 5\nsteady = true", &["follow", "steady"]);
}

#[test]
fn a_file_that_changes_while_it_is_open_is_opened_again() {
    let dir = tempdir().unwrap();
    let path = put(dir.path(), "a.nc", &fixture(&[1.0, 2.0], &["u", "v"]));
    let mut archive = open_with(&[&path], "mask = \"none\"");
    assert_eq!(day(&archive.read(1).unwrap()), 2.0);
    // In place, with the data elsewhere.
    let other = |days: &[f64]| {
        let longer = fixture(days, &["u", "v"]).with("comment", "a longer header").write(&dir.path().join("b"));
        std::fs::write(&path, std::fs::read(longer).unwrap()).unwrap();
    };
    // With one more time, as a file that grows.
    other(&[1.0, 2.0, 3.0]);
    assert_eq!(day(&archive.read(1).unwrap()), 2.0);
    other(&[1.0, 3.0]);
    let error = archive.read(1).unwrap_err().to_string();
    assert!(error.contains("a.nc: its times changed since the archive was opened"), "{error}");
    assert_eq!(day(&archive.read(0).unwrap()), 1.0);
}

#[test]
fn a_file_that_was_locked_when_it_came_is_read_once_it_is_not() {
    let dir = tempdir().unwrap();
    put(dir.path(), "a.nc", &fixture_as(NETCDF4, &[1.0, 2.0], &["u", "v"]));
    let mut reader = followed(dir.path(), "*.nc", LONGEST);
    assert_eq!(next(&mut reader, 2), [1.0, 2.0]);
    let part = fixture_as(NETCDF4, &[3.0], &["u", "v"]).write(&dir.path().join("part"));
    let lock = std::fs::File::open(&part).unwrap();
    lock.lock().unwrap();
    std::fs::rename(&part, dir.path().join("b.nc")).unwrap();
    let warnings = warnings(&reader);
    assert!(warnings.len() == 1 && warnings[0].contains("not read yet") && warnings[0].contains("cannot be locked"), "{warnings:?}");
    lock.unlock().unwrap();
    assert_eq!(next(&mut reader, 1), [3.0]);
}

#[test]
fn a_locked_file_is_waited_for_within_a_limit() {
    let dir = tempdir().unwrap();
    let file = |name: &str, day: f64| fixture_as(NETCDF4, &[day], &["u", "v"]).write(&dir.path().join(name));
    let (first, second) = (file("a.nc", 1.0), file("b.nc", 2.0));
    let mut archive = open_with(&[&first, &second], "mask = \"none\"");
    let lock = std::fs::File::open(&second).unwrap();
    // An exclusive lock waits until the archive has closed its file.
    archive.read(0).unwrap();
    lock.lock().unwrap();
    let begin = Instant::now();
    let error = archive.read(1).unwrap_err().to_string();
    assert!(error.contains("b.nc: cannot be locked: another process has locked it"), "{error}");
    assert!((30.0..60.0).contains(&begin.elapsed().as_secs_f64()), "{:?}", begin.elapsed());
    std::thread::scope(|scope| {
        scope.spawn(|| {
            std::thread::sleep(Duration::from_secs(1));
            lock.unlock().unwrap();
        });
        assert_eq!(day(&archive.read(1).unwrap()), 2.0);
    });
}
