//! Zarr stores: the velocities are those of the same data as NetCDF, and what is not a store that can be read is refused.

use crate::kit::grids::{Ocean, Wrf, packed_levels};
use crate::kit::netcdf::*;
use crate::kit::program::{self, project};
use crate::kit::zarr::{Layout, Pack, V2, V3, parts, write, zipped};
use crate::{DAYS, inspected, open, open_with, refused, same};
use ridgewatch::source::SnapshotSource;
use std::path::{Path, PathBuf};
use std::process::Command;
use tempfile::tempdir;

/// An ocean with land, four times, and packed numbers that are not round in decimals.
fn currents() -> Fixture {
    let axes = [
        ("time", DAYS, &[0.0, 1.0, 2.0, 3.0][..]),
        ("lat", "degrees_north", &[-10.0, 0.0, 10.0, 20.0, 30.0]),
        ("lon", "degrees_east", &[0.0, 7.0, 14.0, 21.0, 28.0, 35.0, 42.0]),
    ];
    let land = |y: usize, x: usize| y >= 3 && x >= 4;
    let packed = |seed: i16| (0..4 * 5 * 7).map(|i| if land(i / 7 % 5, i % 7) { -32_767 } else { (i as i16 * 97 + seed) % 3000 }).collect();
    ["uo", "vo"].into_iter().zip([0, 500]).fold(Fixture::on(CLASSIC, &axes), |fixture, (name, seed)| {
        fixture
            .fields("m s-1", [(name, Data::I16(packed(seed)))])
            .with("scale_factor", 0.000_610_370_189_519_943_6)
            .with("add_offset", -0.300_000_004_470_348_36)
            .with("_FillValue", -32_767i16)
    })
}

const CUT: &[(&str, usize)] =
    &[("time", 2), ("lat", 3), ("lon", 4), ("level", 2), ("latitude", 2), ("longitude", 3), ("y", 6), ("bottom_top", 3), ("west_east", 4)];

fn layouts() -> Vec<Layout> {
    let mut all = Vec::new();
    for pack in [Pack::None, Pack::Gzip, Pack::Zlib, Pack::Zstd, Pack::Blosc, Pack::Lz4] {
        all.push(Layout { pack, chunks: CUT, ..V2 });
        if !matches!(pack, Pack::Zlib | Pack::Lz4) {
            all.push(Layout { pack, chunks: CUT, ..V3 });
        }
    }
    all.extend([
        V2,
        V3,
        Layout { big_endian: true, chunks: CUT, ..V2 },
        Layout { big_endian: true, chunks: CUT, ..V3 },
        Layout { turned: true, chunks: CUT, separator: '/', ..V2 },
        Layout { turned: true, chunks: CUT, separator: '.', ..V3 },
        Layout { consolidated: true, sparse: true, chunks: CUT, ..V2 },
        Layout { consolidated: true, sparse: true, chunks: CUT, ..V3 },
        Layout { shards: 2, chunks: CUT, ..V3 },
        Layout { shards: 3, turned: true, big_endian: true, sparse: true, pack: Pack::Zstd, chunks: CUT, ..V3 },
    ]);
    all
}

#[test]
fn velocities_are_those_of_netcdf() {
    let dir = tempdir().unwrap();
    let fixtures = [
        ("currents", currents(), ""),
        ("plane", plane(CLASSIC, &[0.0, 1.0, 2.0], DAYS), ""),
        ("packed levels", packed_levels(CLASSIC, &[850.0, 500.0, 700.0], 0.0), ""),
        ("curvilinear", Ocean { format: CLASSIC, n: 15, ..Ocean::default() }.fixture(), ""),
        ("staggered", Wrf { format: CLASSIC, ..Wrf::default() }.fixture(), ""),
        ("a region", currents(), "region = [6, 30, -1, 21]"),
        ("one level", packed_levels(CLASSIC, &[850.0, 500.0, 700.0], 0.0), "level = 500\nregion = [80, 200, -40, 40]"),
    ];
    for (number, (name, fixture, settings)) in fixtures.into_iter().enumerate() {
        let file = fixture.write(&dir.path().join(format!("{number}.nc")));
        for (place, layout) in layouts().into_iter().enumerate() {
            let store = write(&fixture, &layout, &dir.path().join(format!("{number}_{place}.zarr")));
            same(&mut open_with(&[&store], settings), &mut open_with(&[&file], settings), &format!("{name}, {layout:?}"));
        }
    }
}

#[test]
fn components_in_stores_of_their_own_are_read_as_one() {
    let dir = tempdir().unwrap();
    let path = |name: &str| dir.path().join(name);
    let without = |name: &str| {
        let mut fixture = currents();
        fixture.variables.retain(|variable| variable.name != name);
        fixture
    };
    let whole = currents().write(&path("whole.nc"));
    let u = write(&without("vo"), &Layout { pack: Pack::Zstd, chunks: CUT, ..V3 }, &path("u.zarr"));
    let v = write(&without("uo"), &Layout { chunks: CUT, ..V2 }, &path("v.zarr"));
    let file = without("uo").write(&path("v.nc"));
    for files in [[&u, &v], [&v, &u], [&u, &file], [&file, &u]] {
        same(&mut open(&files), &mut open(&[&whole]), &format!("{files:?}"));
    }
    refused(&[&u], "", &["u.zarr"]);
}

#[test]
fn zip_files_are_stores() {
    let dir = tempdir().unwrap();
    let file = currents().write(&dir.path().join("a.nc"));
    for (number, layout) in
        [V2, Layout { pack: Pack::Blosc, chunks: CUT, consolidated: true, ..V2 }, Layout { shards: 2, chunks: CUT, ..V3 }]
            .into_iter()
            .enumerate()
    {
        for (top, deflated) in [("", false), ("a.zarr/", false), ("", true)] {
            if deflated && layout.shards > 1 {
                continue;
            }
            let path = dir.path().join(format!("{number}.zarr.zip"));
            std::fs::write(&path, zipped(&parts(&currents(), &layout), top, deflated)).unwrap();
            same(&mut open(&[&path]), &mut open(&[&file]), &format!("{layout:?} in `{top}`, {deflated}"));
        }
    }
    // Some programs add folders of their own.
    let below = |tops: &[&str]| {
        let stores =
            tops.iter().flat_map(|top| parts(&currents(), &V2).into_iter().map(move |(name, data)| (format!("{top}/{name}"), data)));
        std::iter::once(("__MACOSX/._store".to_owned(), vec![0])).chain(stores).collect::<Vec<_>>()
    };
    let copied = dir.path().join("copied.zip");
    std::fs::write(&copied, zipped(&below(&["store"]), "", false)).unwrap();
    same(&mut open(&[&copied]), &mut open(&[&file]), "beside a stray folder");
    std::fs::write(&copied, zipped(&below(&["a", "b"]), "", false)).unwrap();
    refused(&[&copied], "", &["copied.zip", "holds 2 stores, among them a and b"]);
    let shards = dir.path().join("shards.zip");
    std::fs::write(&shards, zipped(&parts(&currents(), &Layout { shards: 2, chunks: CUT, ..V3 }), "", true)).unwrap();
    refused(&[&shards], "", &["shards.zip", "shard that the zip file compresses", "zip -0"]);
    let other = dir.path().join("other.zip");
    std::fs::write(&other, zipped(&vec![("readme.txt".into(), b"nothing".to_vec())], "", false)).unwrap();
    refused(&[&other], "", &["other.zip", "holds no `zarr.json`", "accepted are NetCDF classic"]);
}

#[test]
fn stores_are_found_by_what_they_hold() {
    let dir = tempdir().unwrap();
    let at = |day: f64| plane(CLASSIC, &[day], DAYS);
    // The name does not matter.
    let first = write(&at(0.0), &V2, &dir.path().join("a"));
    let second = write(&at(1.0), &Layout { consolidated: true, ..V3 }, &dir.path().join("b.zarr"));
    std::fs::write(dir.path().join("c.zarr.zip"), zipped(&parts(&at(2.0), &V3), "", false)).unwrap();
    at(3.0).write(&dir.path().join("d.nc"));
    assert_eq!(open(&[dir.path()]).times().len(), 4, "a folder of stores and files");
    assert_eq!(open(&[dir.path().join("[ab]*")]).times().len(), 2, "a pattern");
    assert_eq!(open(&[&first, &second]).describe().kind, "Zarr 2, 2 file(s)");
    let inspection = inspected(&[&second]);
    assert_eq!((inspection.format.as_str(), inspection.problem), ("Zarr 3", None));
    let program = program::run(program::ridgewatch(["inspect"]).arg(&first)).success();
    assert!(program.stdout.contains("Zarr 2") && program.stdout.contains("4 nodes from 0 to 3 m"), "{}", program.stdout);
    let none = dir.path().join("none.zarr");
    std::fs::create_dir(&none).unwrap();
    // A copy that was interrupted.
    for files in [none.clone(), dir.path().to_owned(), dir.path().join("*.zarr")] {
        refused(&[files], "", &["none.zarr", "holds no `zarr.json`"]);
    }
    std::fs::remove_dir(&none).unwrap();
    #[cfg(unix)]
    {
        std::os::unix::fs::symlink(dir.path().join("gone"), &none).unwrap();
        refused(&[dir.path()], "", &["none.zarr", "which does not exist"]);
    }
}

#[test]
fn groups_are_read_by_path_or_opened() {
    let dir = tempdir().unwrap();
    for layout in [V2, V3, Layout { consolidated: true, ..V2 }, Layout { consolidated: true, ..V3 }] {
        let store = dir.path().join(format!("{}{}.zarr", layout.version, layout.consolidated));
        let inner = store.join("model/surface");
        write(&plane(CLASSIC, &[0.0, 1.0], DAYS), &layout, &inner);
        let group = if layout.version == 2 {
            (".zgroup", r#"{"zarr_format": 2}"#)
        } else {
            ("zarr.json", r#"{"zarr_format": 3, "node_type": "group"}"#)
        };
        for folder in [&store, &store.join("model")] {
            std::fs::write(folder.join(group.0), group.1).unwrap();
        }
        let mut expected = open(&[&inner]);
        let names = "u = \"model/surface/u\"\nv = \"model/surface/v\"";
        same(&mut open_with(&[&store], names), &mut expected, &format!("{layout:?}"));
        let listed: Vec<String> = inspected(&[&store]).variables.into_iter().map(|v| v.name).collect();
        assert_eq!(listed, ["time", "u", "v", "x", "y"].map(|name| format!("model/surface/{name}")));
    }
}

#[test]
fn arrays_without_names_of_dimensions_are_read_as_hdf5() {
    let dir = tempdir().unwrap();
    let store = write(&plane(CLASSIC, &[0.0, 1.0], DAYS), &V3, &dir.path().join("bare.zarr"));
    for name in ["u", "v", "x", "y", "time"] {
        let path = store.join(name).join("zarr.json");
        let text = std::fs::read_to_string(&path).unwrap().replace("\"dimension_names\"", "\"other\"");
        std::fs::write(path, text).unwrap();
    }
    let mut archive = open_with(&[&store], "order = \"tyx\"\nx = \"x\"\ny = \"y\"\ntime = \"time\"\nu = \"u\"\nv = \"v\"");
    assert_eq!(us(&archive.read(1).unwrap())[..3], [100.0, 101.0, 102.0]);
}

/// Replaces a text in a part of a store.
fn change(store: &Path, part: &str, from: &str, to: &str) {
    let path = store.join(part);
    let text = std::fs::read_to_string(&path).unwrap();
    assert!(text.contains(from), "{text}");
    std::fs::write(path, text.replace(from, to)).unwrap();
}

#[test]
fn chunks_that_are_not_stored_hold_the_fill_value() {
    let dir = tempdir().unwrap();
    let layout = Layout { chunks: &[("time", 1)], ..V2 };
    let field = || plane(CLASSIC, &[0.0, 1.0, 2.0], DAYS);
    // In version 2 the fill value says what is missing; without one, nothing was ever written there.
    for fill in ["-1.5", "null", "\"NaN\""] {
        let store = write(&field(), &layout, &dir.path().join(format!("2{}.zarr", fill.len())));
        std::fs::remove_file(store.join("u/1.0.0")).unwrap();
        change(&store, "u/.zarray", "\"fill_value\": null", &format!("\"fill_value\": {fill}"));
        let mut archive = open(&[&store]);
        assert_eq!((archive.read(0).unwrap().missing_nodes(), archive.read(1).unwrap().missing_nodes()), (0, 12), "{fill}");
    }
    // In version 3 it is a value like others, unless the attribute says that it is missing.
    let store = write(&field(), &Layout { version: 3, ..layout }, &dir.path().join("3.zarr"));
    std::fs::remove_file(store.join("u/c.1.0.0")).unwrap();
    change(&store, "u/zarr.json", "\"fill_value\": 0", "\"fill_value\": 2.5");
    assert_eq!(us(&open(&[&store]).read(1).unwrap()), [2.5; 12]);
    change(&store, "u/zarr.json", "\"attributes\": {", "\"attributes\": { \"_FillValue\": \"AAAAAAAABEA=\",");
    assert_eq!(open(&[&store]).read(1).unwrap().missing_nodes(), 12);
}

#[test]
fn only_the_chunks_in_question_are_read() {
    let dir = tempdir().unwrap();
    let layout = Layout { chunks: &[("time", 1), ("level", 1), ("latitude", 2), ("longitude", 2)], ..V2 };
    let fixture = packed_levels(CLASSIC, &[850.0, 500.0, 700.0], 0.0);
    let store = write(&fixture, &layout, &dir.path().join("a.zarr"));
    // Level 500, latitudes 60 and 30, longitudes 0 and 90.
    let settings = "level = 500\nregion = [-5, 95, 29, 61]\nw = \"none\"";
    let expected = open_with(&[&store], settings).read(1).unwrap().nodes.clone();
    for name in ["u", "v", "w"] {
        for entry in std::fs::read_dir(store.join(name)).unwrap() {
            let path = entry.unwrap().path();
            let file = path.file_name().unwrap().to_str().unwrap();
            if !file.starts_with('.') && (name == "w" || file != "1.1.0.0") {
                std::fs::write(&path, b"not a chunk").unwrap();
            }
        }
    }
    let mut archive = open_with(&[&store], settings);
    assert_eq!(archive.read(1).unwrap().nodes, expected);
    let message = archive.read(0).unwrap_err().to_string();
    for piece in ["a.zarr", "variable `u`", "`u/0.1.0.0`", "11 bytes", "its metadata say 8"] {
        assert!(message.contains(piece), "{message}");
    }
}

#[test]
fn what_unpacks_to_more_than_declared_is_refused() {
    let dir = tempdir().unwrap();
    let field = plane(CLASSIC, &[0.0, 1.0], DAYS);
    for pack in [Pack::Gzip, Pack::Zlib, Pack::Zstd, Pack::Blosc, Pack::Lz4] {
        let store = write(&field, &Layout { pack, ..V2 }, &dir.path().join(format!("{pack:?}.zarr")));
        // A chunk of 128 MiB of zeros, where 96 bytes are declared.
        let large = Fixture::on(CLASSIC, &[("x", "", &vec![0.0; 1 << 24])]);
        let bomb = parts(&large, &Layout { pack, ..V2 }).into_iter().find(|(name, _)| name == "x/0").unwrap().1;
        std::fs::write(store.join("u/0.0.0"), bomb).unwrap();
        let message = open(&[&store]).read(0).unwrap_err().to_string();
        assert!(message.contains("`u/0.0.0`") && !message.contains("codecs failed"), "{pack:?}: {message}");
    }
    let stored = write(&field, &V2, &dir.path().join("stored.zarr"));
    std::fs::write(stored.join("u/0.0.0"), vec![0; 1 << 20]).unwrap();
    let message = open(&[&stored]).read(0).unwrap_err().to_string();
    assert!(message.contains("holds 1048576 bytes"), "{message}");
}

#[test]
fn extents_are_checked_before_memory_is_taken() {
    let dir = tempdir().unwrap();
    let changed = |name: &str, from: &str, to: &str| {
        let store = write(&plane(CLASSIC, &[0.0, 1.0], DAYS), &Layout { consolidated: false, ..V2 }, &dir.path().join(name));
        let compact = |part: &str| {
            let value: serde_json::Value = serde_json::from_slice(&std::fs::read(store.join(part)).unwrap()).unwrap();
            std::fs::write(store.join(part), value.to_string()).unwrap();
        };
        for part in ["u/.zarray", "v/.zarray"] {
            compact(part);
            change(&store, part, from, to);
        }
        store
    };
    let small = "memory_gib = 0.01";
    let chunks = changed("chunks.zarr", "\"chunks\":[2,3,4]", "\"chunks\":[2,3000,4000]");
    let mut archive = open_with(&[&chunks], small);
    let message = archive.read(0).unwrap_err().to_string();
    assert!(message.contains("its chunks of 96000000 bytes") && message.contains("archive.memory_gib"), "{message}");
    let shape = changed("shape.zarr", "\"shape\":[2,3,4]", "\"shape\":[2,3,40000000]");
    refused(&[&shape], small, &["shape.zarr", "variable `u`", "40000000 nodes along a dimension"]);
    refused(&[&changed("wide.zarr", "\"shape\":[2,3,4]", "\"shape\":[2,9223372036854775807,4]")], "", &["wide.zarr", "overflow"]);
    refused(&[&changed("zero.zarr", "\"chunks\":[2,3,4]", "\"chunks\":[2,0,4]")], "", &["zero.zarr", "`u/.zarray`", "`chunks` holds 0"]);
    let unknown = changed("codec.zarr", "\"compressor\":null", "\"compressor\":{\"id\":\"jpeg2k\"}");
    let message = open(&[&unknown]).read(0).unwrap_err().to_string();
    assert!(message.contains("codec `jpeg2k`") && message.contains("accepted are gzip, zlib, zstd, blosc"), "{message}");
}

#[test]
#[cfg(unix)]
fn links_and_names_do_not_lead_out_of_a_store() {
    let dir = tempdir().unwrap();
    let field = plane(CLASSIC, &[0.0, 1.0], DAYS);
    let store = write(&field, &Layout { chunks: &[("time", 1)], ..V2 }, &dir.path().join("a.zarr"));
    let chunk = store.join("u/1.0.0");
    // Within the store a link is a file like others.
    std::fs::remove_file(&chunk).unwrap();
    std::os::unix::fs::symlink(store.join("u/0.0.0"), &chunk).unwrap();
    assert_eq!(us(&open(&[&store]).read(1).unwrap())[..2], [0.0, 1.0]);
    let elsewhere = dir.path().join("elsewhere");
    std::fs::copy(store.join("u/0.0.0"), &elsewhere).unwrap();
    std::fs::remove_file(&chunk).unwrap();
    std::os::unix::fs::symlink(&elsewhere, &chunk).unwrap();
    let message = open(&[&store]).read(1).unwrap_err().to_string();
    assert!(message.contains("`u/1.0.0`: it is a link out of the store") && message.contains("archive.external = true"), "{message}");
    assert_eq!(us(&open_with(&[&store], "external = true").read(1).unwrap())[..2], [0.0, 1.0]);
    // A folder that leads out, with metadata or chunks in it.
    let outside = write(&field, &V2, &dir.path().join("b.zarr"));
    std::fs::remove_dir_all(store.join("v")).unwrap();
    std::os::unix::fs::symlink(outside.join("v"), store.join("v")).unwrap();
    refused(&[&store], "", &["a.zarr", "`v/.zarray`", "link out of the store"]);
    // Names in consolidated metadata.
    let store = write(&field, &Layout { consolidated: true, ..V2 }, &dir.path().join("c.zarr"));
    change(&store, ".zmetadata", "\"v/", "\"../b.zarr/v/");
    let message = open_with(&[&store], "v = \"../b.zarr/v\"").read(0).unwrap_err().to_string();
    assert!(message.contains("names of parts hold no `..`"), "{message}");
    // A pipe would wait for a writer.
    let pipe = write(&field, &V2, &dir.path().join("d.zarr")).join("u/0.0.0");
    std::fs::remove_file(&pipe).unwrap();
    assert!(Command::new("mkfifo").arg(&pipe).status().unwrap().success());
    let message = open(&[dir.path().join("d.zarr")]).read(0).unwrap_err().to_string();
    assert!(message.contains("accepted: a regular file"), "{message}");
}

#[test]
fn very_many_parts_are_refused() {
    let dir = tempdir().unwrap();
    let store = write(&plane(CLASSIC, &[0.0], DAYS), &V2, &dir.path().join("deep.zarr"));
    let deep: PathBuf = (0..70).map(|_| "g").collect();
    std::fs::create_dir_all(store.join(deep)).unwrap();
    refused(&[&store], "", &["deep.zarr", "nested more than 64 deep"]);
    let many = write(&plane(CLASSIC, &[0.0], DAYS), &V3, &dir.path().join("many.zarr"));
    for i in 0..10_001 {
        std::fs::create_dir(many.join(i.to_string())).unwrap();
    }
    refused(&[&many], "", &["many.zarr", "holds more than 10000"]);
    let large = write(&plane(CLASSIC, &[0.0], DAYS), &V3, &dir.path().join("large.zarr"));
    std::fs::write(large.join("zarr.json"), vec![b' '; (16 << 20) + 1]).unwrap();
    refused(&[&large], "", &["large.zarr", "`zarr.json`", "more than the 16777216"]);
    // The same in a zip file, where a name of 64 KiB would lead through 32,000 folders.
    let deep = dir.path().join("deep.zip");
    let mut field = parts(&plane(CLASSIC, &[0.0], DAYS), &V2);
    field.push(("g/".repeat(32_000) + ".zarray", b"{}".to_vec()));
    std::fs::write(&deep, zipped(&field, "", false)).unwrap();
    refused(&[&deep], "", &["deep.zip", "nested more than 64 deep"]);
    // Lists of objects take most memory for their length.
    let objects = "{\"\":0},".repeat(100_000);
    let list = format!("{{\"zarr_format\": 3, \"node_type\": \"group\", \"attributes\": {{\"a\": [{objects}0]}}}}");
    let store = write(&plane(CLASSIC, &[0.0], DAYS), &V3, &dir.path().join("objects.zarr"));
    std::fs::write(store.join("zarr.json"), &list).unwrap();
    refused(&[&store], "memory_gib = 0.05", &["objects.zarr", "the metadata up to `zarr.json` need 0.08 GiB"]);
    assert_eq!(open(&[&store]).times().len(), 1);
    // Names, dimensions and what is quoted of metadata have bounds.
    let long = write(&plane(CLASSIC, &[0.0], DAYS), &Layout { consolidated: true, ..V2 }, &dir.path().join("long.zarr"));
    change(&long, ".zmetadata", "\"v/", &format!("\"{}/v/", "n".repeat(5000)));
    refused(&[&long], "", &["long.zarr", "the name of a variable has 5002 bytes; accepted are 4096"]);
    let fine = write(&plane(CLASSIC, &[0.0], DAYS), &Layout { chunks: &[("x", 1), ("y", 1)], ..V2 }, &dir.path().join("fine.zarr"));
    change(&fine, "time/.zarray", "1\n  ]", "9000000\n  ]");
    refused(&[&fine], "", &["fine.zarr"]);
}

/// Stores that xarray and zarr-python write, beside the same data as NetCDF: tests/independent/stores.py.
#[test]
#[ignore = "needs Python: make test-data"]
fn stores_of_xarray_and_zarr_python() {
    let python = std::env::var_os("RIDGEWATCH_PYTHON").map_or_else(|| project(".venv/bin/python"), PathBuf::from);
    assert!(python.exists(), "{} is not there: make test-data installs it", python.display());
    let dir = tempdir().unwrap();
    let output = program::run(Command::new(python).arg(project("tests/independent/stores.py")).arg(dir.path())).success();
    let mut count = 0;
    for line in output.stdout.lines() {
        let (file, store) = line.split_once(' ').unwrap();
        let (mut found, mut expected) = (open(&[dir.path().join(store)]), open(&[dir.path().join(file)]));
        same(&mut found, &mut expected, store);
        println!("{store}: {}, {} snapshots as in {file}", found.describe().kind, found.times().len());
        count += 1;
    }
    assert!(count >= 20, "{count}");
}

/// Bytes and seconds of a window, beside xarray reading the same: tests/independent/window.py.
#[test]
#[ignore = "needs Python: make test-data"]
#[cfg(target_os = "linux")]
fn a_window_beside_xarray() {
    let python = std::env::var_os("RIDGEWATCH_PYTHON").map_or_else(|| project(".venv/bin/python"), PathBuf::from);
    let script = project("tests/independent/window.py");
    let dir = tempdir().unwrap();
    program::run(Command::new(&python).arg(&script).arg(dir.path()).arg("write")).success();
    let read = || -> u64 {
        let io = std::fs::read_to_string("/proc/thread-self/io").unwrap();
        io.lines().next().unwrap().split(' ').nth(1).unwrap().parse().unwrap()
    };
    let region = [20.0, 55.0, -30.0, 15.0];
    for store in ["blosc.zarr", "zstd.zarr", "daily.zarr", "shards.zarr"] {
        let path = dir.path().join(store);
        let arguments: Vec<String> = region.iter().map(f64::to_string).collect();
        let theirs = program::run(Command::new(&python).arg(&script).arg(&path).args(&arguments)).success().stdout;
        let (begin, before) = (std::time::Instant::now(), read());
        let mut archive = open_with(&[&path], &format!("region = {region:?}\nmetric = \"index\"\nvelocity_unit = \"cells\""));
        let mut total = 0.0;
        for index in 0..archive.times().len() {
            let snapshot = archive.read(index).unwrap();
            total += snapshot.nodes.iter().map(|n| f64::from(n[0]).hypot(f64::from(n[1]))).sum::<f64>();
        }
        let (seconds, bytes) = (begin.elapsed().as_secs_f64(), read() - before);
        println!("{store}: {seconds:.2} s, {bytes} bytes; xarray (snapshot by snapshot, at once): {}", theirs.trim().replace('\n', ", "));
        let sums: Vec<f64> = theirs.lines().map(|line| line.split(' ').nth(2).unwrap().parse().unwrap()).collect();
        assert!(sums.iter().all(|sum| (sum - total).abs() < 1e-6 * total), "{sums:?} {total}");
        // Each byte in question once, and metadata; xarray reads at least the same.
        let at_once: u64 = theirs.lines().last().unwrap().split(' ').nth(1).unwrap().parse().unwrap();
        assert!(bytes < at_once + at_once / 20 + (1 << 20), "{bytes} {at_once}");
    }
}
