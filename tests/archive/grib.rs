//! GRIB: the velocities are those of the same data as NetCDF, and what cannot be read is refused by name.

use crate::kit::grib::{HEIGHT, ISOBARIC, LevelType, Message, OMEGA, Parameter, TEMPERATURE, U, V, cone, real, write};
use crate::kit::mutants::random;
use crate::kit::netcdf::*;
use crate::kit::program;
use crate::{HOURS, inspected, notes, open, open_with, refused, same};
use ridgewatch::field::Geometry;
use ridgewatch::source::SnapshotSource;
use tempfile::tempdir;

const LONGITUDES: [f64; 8] = [0.0, 45.0, 90.0, 135.0, 180.0, 225.0, 270.0, 315.0];
const LATITUDES: [f64; 5] = [60.0, 30.0, 0.0, -30.0, -60.0];
const LEVELS: [f64; 3] = [500.0, 700.0, 850.0];

/// A component at a time, on a level and at a node: quarters, so that packing is exact.
fn value(component: usize, [time, level, y, x]: [usize; 4]) -> f64 {
    ((component * 37 + time * 31 + level * 17 + y * 5 + x * 11) % 64) as f64 / 4.0 - 6.0
}

/// Messages of a component at so many hours, on levels.
fn messages(edition: u8, parameter: Parameter, component: usize, times: usize, levels: &[(LevelType, f64)]) -> Vec<Message> {
    let field = |time: usize, level: usize| Message {
        edition,
        parameter,
        level: levels[level],
        hour: time as u8,
        step: 0,
        member: None,
        longitudes: (0.0, 315.0, LONGITUDES.len()),
        latitudes: (60.0, -60.0, LATITUDES.len()),
        order: 0,
        values: (0..40).map(|i| value(component, [time, level, i / 8, i % 8])).collect(),
        bits: 12,
        plane: None,
    };
    (0..times).flat_map(|time| (0..levels.len()).map(move |level| (time, level))).map(|(time, level)| field(time, level)).collect()
}

fn isobaric() -> Vec<(LevelType, f64)> {
    LEVELS.iter().map(|&level| (ISOBARIC, level)).collect()
}

/// Winds on pressure levels, in an arbitrary order.
fn winds(edition: u8, times: usize) -> Vec<Message> {
    let all = [U, V, OMEGA].into_iter().enumerate();
    let mut all: Vec<Message> = all.flat_map(|(k, parameter)| messages(edition, parameter, k, times, &isobaric())).collect();
    let mut state = 1;
    for k in (1..all.len()).rev() {
        all.swap(k, random(&mut state) as usize % (k + 1));
    }
    all
}

/// The same as NetCDF, where `there` says so.
fn netcdf(times: usize, there: impl Fn(usize, usize) -> bool) -> Fixture {
    let hours: Vec<f64> = (0..times).map(|time| time as f64).collect();
    let axes = [
        ("time", HOURS, &hours[..]),
        ("level", "hPa", &LEVELS),
        ("lat", "degrees_north", &LATITUDES),
        ("lon", "degrees_east", &LONGITUDES),
    ];
    let field = |component: usize| {
        let node = |i: usize| [i / 120, i / 40 % 3, i / 8 % 5, i % 8];
        let value = |i: usize| if there(node(i)[2], node(i)[3]) { value(component, node(i)) as f32 } else { f32::NAN };
        Data::F32((0..times * 120).map(value).collect())
    };
    Fixture::on(CLASSIC, &axes).winds(field(0), field(1)).fields("Pa/s", [("omega", field(2))])
}

#[test]
fn velocities_are_those_of_netcdf() {
    let dir = tempdir().unwrap();
    let file = netcdf(3, |_, _| true).write(&dir.path().join("a.nc"));
    let grib = dir.path().join("a.grib");
    for edition in [1, 2] {
        for order in [0, 0x10, 0x20, 0x30] {
            for (westward, northward) in [(false, false), (true, false), (false, true), (true, true)] {
                let mut all = winds(edition, 3);
                for message in &mut all {
                    message.order = order;
                    if westward {
                        let (first, last, count) = message.longitudes;
                        message.longitudes = (last, first, count);
                        message.values.chunks_mut(count).for_each(<[f64]>::reverse);
                    }
                    if northward {
                        let (first, last, count) = message.latitudes;
                        message.latitudes = (last, first, count);
                        message.values = message.values.chunks(8).rev().flatten().copied().collect();
                    }
                }
                let what = format!("edition {edition}, order {order}, westward {westward}, northward {northward}");
                same(&mut open(&[write(&all, &grib)]), &mut open(&[&file]), &what);
            }
        }
        write(&winds(edition, 3), &grib);
        for settings in ["region = [40, 230, -40, 70]", "region = [-100, 100, -30, 60]", "level = 700\nw = \"none\"", "metric = \"index\""]
        {
            same(&mut open_with(&[&grib], settings), &mut open_with(&[&file], settings), &format!("edition {edition}, {settings}"));
        }
        let archive = open(&[&grib]);
        assert_eq!(archive.describe().kind, format!("GRIB {edition}, 1 file(s)"));
        let names: Vec<String> = inspected(&[&grib]).variables.into_iter().map(|variable| variable.name).collect();
        assert_eq!(names.len(), 7);
        for name in ["time", "isobaricInhPa", "latitude", "longitude", "u", "v", "w"] {
            assert!(names.iter().any(|listed| listed == name), "{names:?}");
        }
    }
    // A file for each time, and both editions in one.
    let at = |edition: u8, hour: u8| winds(edition, 3).into_iter().filter(move |message| message.hour == hour).collect::<Vec<_>>();
    let files = [1, 2, 0].map(|hour| write(&at(1 + hour % 2, hour), &dir.path().join(format!("{hour}.grb"))));
    same(&mut open(&files), &mut open(&[&file]), "a file for each time");
    let both: Vec<Message> = winds(1, 3).into_iter().filter(|m| m.hour < 2).chain(at(2, 2)).collect();
    same(&mut open(&[write(&both, &grib)]), &mut open(&[&file]), "both editions");
    // Several fields in one message, which share its date and grid.
    let joined = [0, 1, 2].map(|hour| {
        let all: Vec<Vec<u8>> = at(2, hour).iter().map(Message::bytes).collect();
        let shared = 16 + 21 + 72;
        let fields = all.iter().flat_map(|bytes| &bytes[shared..bytes.len() - 4]);
        let mut bytes: Vec<u8> = all[0][..shared].iter().chain(fields).chain(b"7777").copied().collect();
        let length = bytes.len() as u64;
        bytes[8..16].copy_from_slice(&length.to_be_bytes());
        bytes
    });
    std::fs::write(&grib, joined.concat()).unwrap();
    same(&mut open(&[&grib]), &mut open(&[&file]), "several fields in a message");
    let program = program::run(program::ridgewatch(["inspect"]).arg(&grib)).success();
    assert!(program.stdout.contains("GRIB") && program.stdout.contains("isobaricInhPa"), "{}", program.stdout);
}

#[test]
fn bitmaps_and_constant_fields() {
    let dir = tempdir().unwrap();
    let there = |y: usize, x: usize| !(1..3).contains(&y) || !x.is_multiple_of(3);
    let file = netcdf(2, there).write(&dir.path().join("a.nc"));
    for edition in [1, 2] {
        for order in [0, 0x30] {
            let mut all = winds(edition, 2);
            for message in &mut all {
                message.order = order;
                message.values.iter_mut().enumerate().filter(|(i, _)| !there(i / 8, i % 8)).for_each(|(_, value)| *value = f64::NAN);
            }
            let mut archive = open(&[write(&all, &dir.path().join("a.grib2"))]);
            assert!(archive.read(0).unwrap().missing_nodes() > 0);
            same(&mut archive, &mut open(&[&file]), &format!("edition {edition}, order {order}"));
        }
        // Nothing is packed: all values are the reference.
        let mut all = winds(edition, 2);
        all.iter_mut().for_each(|message| (message.values, message.bits) = (vec![2.5; 40], 0));
        let mut archive = open_with(&[write(&all, &dir.path().join("b.grib"))], "metric = \"index\"\nvelocity_unit = \"cells\"");
        assert_eq!(us(&archive.read(1).unwrap()), [2.5; 120]);
    }
}

#[test]
fn forecasts_members_and_types_of_level() {
    let dir = tempdir().unwrap();
    let file = netcdf(3, |_, _| true).write(&dir.path().join("a.nc"));
    let grib = dir.path().join("a.grb2");
    for edition in [1, 2] {
        // Times are those for which a forecast is valid.
        let mut all = winds(edition, 3);
        all.iter_mut().for_each(|message| (message.hour, message.step) = (message.hour / 2, message.hour - message.hour / 2));
        same(&mut open(&[write(&all, &grib)]), &mut open(&[&file]), "forecasts");
        // The second of three members.
        let member = |number: u8| {
            winds(edition, 3).into_iter().map(move |mut message| {
                message.values.iter_mut().for_each(|value| *value += f64::from(number) - 2.0);
                Message { member: Some(number), ..message }
            })
        };
        let members: Vec<Message> = [3, 1, 2].into_iter().flat_map(member).collect();
        write(&members, &grib);
        refused(&[&grib], "", &["dimension `number` has 3 entries", "--set archive.select.number=0"]);
        same(&mut open_with(&[&grib], "select.number = 1"), &mut open(&[&file]), "a member");
        // Winds above the ground, and another parameter on fewer levels.
        let heights = [(HEIGHT, 10.0), (HEIGHT, 100.0)];
        let mut all = winds(edition, 3);
        all.extend(messages(edition, U, 3, 3, &heights).into_iter().chain(messages(edition, V, 4, 3, &heights)));
        all.extend(messages(edition, TEMPERATURE, 5, 2, &isobaric()[..1]));
        write(&all, &grib);
        let listed: Vec<String> = inspected(&[&grib]).variables.into_iter().map(|variable| variable.name).collect();
        for name in
            ["u_isobaricInhPa", "v_isobaricInhPa", "u_heightAboveGround", "v_heightAboveGround", "heightAboveGround", "w", "t", "time1"]
        {
            assert!(listed.iter().any(|listed| listed == name), "{name}: {listed:?}");
        }
        same(&mut open(&[&grib]), &mut open(&[&file]), "types of level");
        let settings = "u = \"u_heightAboveGround\"\nv = \"v_heightAboveGround\"\nw = \"none\"\nlevel = 100\nmetric = \"index\"\nvelocity_unit = \"cells\"";
        // Latitudes ascend in a snapshot.
        let expected: Vec<f32> = (0..40).map(|i| value(3, [2, 1, 4 - i / 8, i % 8]) as f32).collect();
        assert_eq!(us(&open_with(&[&grib], settings).read(2).unwrap()), expected);
    }
}

#[test]
fn what_is_missing_or_unknown_is_told_by_name() {
    let dir = tempdir().unwrap();
    let grib = dir.path().join("wind.grib");
    let is = |message: &Message, parameter: Parameter, hour: u8, level: f64| {
        message.parameter == parameter && message.hour == hour && message.level.1 == level
    };
    for edition in [1, 2] {
        let whole = winds(edition, 3);
        let without: Vec<Message> = whole.iter().filter(|message| !is(message, V, 1, 700.0)).cloned().collect();
        write(&without, &grib);
        let pieces = [
            "wind.grib",
            "no northward",
            "v (time, isobaricInhPa, latitude, longitude): its message at 700 hPa of 2000-01-01T01:00:00Z is missing",
        ];
        refused(&[&grib], "", &[&pieces[..], &["8 of the 9 that 3 times, 1 members and 3 levels make"]].concat());
        refused(&[&grib], "v = \"v\"", &["its message at 700 hPa of 2000-01-01T01:00:00Z is missing"]);
        let twice: Vec<Message> = whole.iter().cloned().chain(whole.iter().find(|message| is(message, U, 2, 850.0)).cloned()).collect();
        refused(&[write(&twice, &grib)], "", &["its message at 850 hPa of 2000-01-01T02:00:00Z is there twice", "grib_copy"]);
        // Vertical motion that cannot be read is not left out without a word.
        let without: Vec<Message> = whole.iter().filter(|message| !is(message, OMEGA, 2, 500.0)).cloned().collect();
        write(&without, &grib);
        refused(&[&grib], "", &["`w`", "its message at 500 hPa of 2000-01-01T02:00:00Z is missing", "--set archive.w=none"]);
        assert!(notes(&open_with(&[&grib], "w = \"none\"")).contains("`w` cannot be read"));
        let whole: Vec<u8> = whole.iter().flat_map(Message::bytes).collect();
        let change = |at: usize, byte: u8, what: &[&str]| {
            let mut bytes = whole.clone();
            let mut from = 0;
            while from < bytes.len() {
                bytes[from + at] = byte;
                from += if edition == 1 {
                    usize::from(bytes[from + 5]) << 8 | usize::from(bytes[from + 6])
                } else {
                    usize::from(bytes[from + 14]) << 8 | usize::from(bytes[from + 15])
                };
            }
            std::fs::write(&grib, bytes).unwrap();
            refused(&[&grib], "", what);
        };
        if edition == 1 {
            change(8 + 28 + 5, 50, &["spherical harmonics", "cdo -f nc sp2gpl"]);
            change(8 + 28 + 5, 3, &["its grid is a Lambert projection", "wgrib2 IN -new_grid_winds earth"]);
            change(8 + 28 + 5, 10, &["its grid is rotated or stretched", "-rotuvb,u,v"]);
            change(8 + 28 + 27, 0x01, &["its rows are offset"]);
            change(8 + 28 + 32 + 3, 0x40, &["second-order packing", "grib_set -r -s packingType=grid_simple"]);
            change(8 + 17, 4, &["months or years, which have no fixed length"]);
            change(8 + 20, 113, &["its time range indicator 113"]);
            change(8 + 13, 13, &["is no date"]);
        } else {
            change(16 + 21 + 13, 50, &["spherical harmonics", "cdo -f nc sp2gpl"]);
            change(16 + 21 + 13, 23, &["its grid is a polar stereographic projection", "wgrib2 IN -new_grid_winds earth"]);
            change(16 + 21 + 10, 4, &["a reduced grid", "cdo -f nc setgridtype,regular"]);
            change(16 + 21 + 9, 41, &["its grid of 8 x 5 nodes is said to have 41"]);
            change(16 + 21 + 72 + 34 + 10, 51, &["it is packed as spherical harmonics"]);
            change(16 + 21 + 72 + 34 + 10, 99, &["it is packed in the unknown way 99"]);
            change(16 + 21 + 72 + 8, 5, &["its product description 5 is not understood"]);
            change(16 + 21 + 72 + 17, 3, &["months or years"]);
            change(16 + 14, 31 + 1, &["is no date"]);
        }
    }
}

#[test]
fn files_that_are_cut_or_padded() {
    let dir = tempdir().unwrap();
    let grib = dir.path().join("wind.grib");
    for edition in [1, 2] {
        let all = winds(edition, 2);
        let whole: Vec<u8> = all.iter().flat_map(Message::bytes).collect();
        for keep in [whole.len() - 1, whole.len() - 100, whole.len() / 2 + 7, 30, 9] {
            std::fs::write(&grib, &whole[..keep]).unwrap();
            refused(&[&grib], "", &["wind.grib", "truncated"]);
        }
        // Padding, and the headers of bulletins, lie between messages.
        let padded: Vec<u8> = all.iter().flat_map(|message| [&message.bytes()[..], b"\0\0\0\r\n\x01TTAAii"].concat()).collect();
        std::fs::write(&grib, padded).unwrap();
        assert_eq!(open(&[&grib]).times().len(), 2);
        std::fs::write(&grib, [&whole[..], &vec![1; 1 << 17]].concat()).unwrap();
        refused(&[&grib], "", &["wind.grib", "no message begins within 65536 bytes"]);
        let mut open_end = whole.clone();
        let last = whole.len() - 1;
        open_end[last] = b'8';
        std::fs::write(&grib, open_end).unwrap();
        refused(&[&grib], "", &["does not end with 7777"]);
    }
    std::fs::write(&grib, b"GRIB\0\0\0\x03").unwrap();
    refused(&[&grib], "", &["wind.grib", "edition 3", "accepted are 1 and 2"]);
    // By its ending, a file is found in a folder.
    for ending in ["grib", "grib1", "grib2", "grb", "grb2", "GRB"] {
        let folder = dir.path().join(ending);
        std::fs::create_dir(&folder).unwrap();
        write(&winds(2, 2), &folder.join(format!("a.{ending}")));
        assert_eq!(open(&[folder]).times().len(), 2);
    }
}

#[test]
fn sizes_are_checked_before_memory_is_taken() {
    let dir = tempdir().unwrap();
    let grib = dir.path().join("large.grib");
    // All values are the reference, so that a small message may have any number of them.
    let mut all = winds(2, 2);
    for message in &mut all {
        (message.values, message.bits) = (vec![1.0; 40], 0);
        message.longitudes = (0.0, 315.0, 8);
    }
    let mut bytes: Vec<u8> = all.iter().flat_map(Message::bytes).collect();
    let length = all[0].bytes().len();
    for from in (0..bytes.len()).step_by(length) {
        let grid = from + 16 + 21;
        bytes[grid + 30..grid + 34].copy_from_slice(&(1u32 << 16).to_be_bytes());
        bytes[grid + 34..grid + 38].copy_from_slice(&(1u32 << 15).to_be_bytes());
        bytes[grid + 6..grid + 10].copy_from_slice(&(1u32 << 31).to_be_bytes());
        let packing = grid + 72 + 34;
        bytes[packing + 5..packing + 9].copy_from_slice(&(1u32 << 31).to_be_bytes());
    }
    std::fs::write(&grib, bytes).unwrap();
    refused(&[&grib], "memory_gib = 1", &["large.grib", "GiB of memory; accepted are 1.00 GiB"]);
    // A field of five bytes, again and again in one message.
    let mut bytes = winds(2, 2)[0].bytes();
    let field = [0, 0, 0, 5, 7].repeat(1 << 20);
    bytes.splice(bytes.len() - 4..bytes.len() - 4, field);
    let length = bytes.len() as u64;
    bytes[8..16].copy_from_slice(&length.to_be_bytes());
    std::fs::write(&grib, bytes).unwrap();
    refused(&[&grib], "", &["large.grib", "it holds more than 1048576 fields"]);
    refused(&[&grib], "memory_gib = 0.01", &["large.grib", "the headers of", "fields"]);
}

#[test]
fn what_eccodes_packs_is_unpacked() {
    let dir = tempdir().unwrap();
    for (packing, components) in real() {
        let path = dir.path().join("real.grib2");
        std::fs::write(&path, components.concat()).unwrap();
        let mut archive = open_with(&[&path], "metric = \"index\"\nvelocity_unit = \"cells\"\nsteady = true\nperiodic = \"none\"");
        let snapshot = archive.read(0).unwrap();
        // Latitudes ascend in a snapshot, and descend in the file.
        for (i, node) in snapshot.nodes.iter().enumerate() {
            let (x, y) = (i % 6, 3 - i / 6);
            let expected = |component: usize| (((y * y + 3 * x * component + 5 * y * x) % 41) as f32) * 0.25 - 4.0;
            let missing = packing.ends_with("bitmap") && (x, y) == (2, 1);
            assert!(missing == node[3].is_nan(), "{packing}, {x} {y}: {node:?}");
            assert!(missing || node[..2] == [expected(1), expected(2)], "{packing}, {x} {y}: {node:?}");
        }
    }
}

/// Lambert's cone, with winds along the grid and with winds to the east and north.
#[test]
fn projections_of_edition_2_are_planes() {
    let dir = tempdir().unwrap();
    let grib = dir.path().join("cone.grib2");
    let winds = |along: bool| -> Vec<Message> {
        let of = |(component, parameter)| {
            messages(2, parameter, component, 2, &isobaric()[..1])
                .into_iter()
                .map(move |message| Message { plane: Some(cone(along)), ..message })
        };
        let mut all: Vec<Message> = [(0, U), (1, V)].into_iter().flat_map(of).collect();
        all.iter_mut().for_each(|message| message.values = vec![if message.parameter == U { 8.0 } else { 0.0 }; 40]);
        all
    };
    let read = |along: bool| {
        write(&winds(along), &grib);
        let mut archive = open(&[&grib]);
        let grid = archive.grid().clone();
        assert!(matches!(grid.geometry, Geometry::Cartesian));
        // As NOAA states its first node, on a sphere of 6371229 m.
        let first = [grid.axes[0].first() + 2_697_520.14, grid.axes[1].first() + 1_587_306.15];
        assert!(first.iter().all(|apart| apart.abs() < 1.0), "{first:?}");
        assert_eq!((grid.shape(), grid.axes[0].uniform_step(), grid.axes[1].uniform_step()), ([8, 5, 1], Some(3000.0), Some(3000.0)));
        (archive.read(1).unwrap().nodes[0], notes(&archive))
    };
    let (along, said) = read(true);
    assert!(said.contains("velocities run along x and y, and are stretched"), "{said}");
    // Scale of the cone at a latitude (Snyder 1987, page 107): n = sin 38.5 degrees.
    let (n, latitude) = (38.5f64.to_radians().sin(), 21.138_123f64.to_radians());
    let tangent = |latitude: f64| (std::f64::consts::FRAC_PI_4 + latitude / 2.0).tan();
    let scale = 38.5f64.to_radians().cos() * (tangent(38.5f64.to_radians()) / tangent(latitude)).powf(n) / latitude.cos();
    assert!((f64::from(along[0]) - 8.0 * scale).abs() < 1e-5 && along[1] == 0.0, "{along:?} {scale}");
    let (east, said) = read(false);
    assert!(said.contains("velocities run east and north"), "{said}");
    let turn = n * (237.280_472f64 - 262.5).to_radians();
    let expected = [8.0 * scale * turn.cos(), 8.0 * scale * turn.sin()];
    assert!((0..2).all(|k| (f64::from(east[k]) - expected[k]).abs() < 1e-5), "{east:?} {expected:?}");
}
