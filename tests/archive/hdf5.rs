//! HDF5 archives: known layouts, and those that the settings describe.

use crate::{open_with, refused};
use hdf5_metno::{Dataset, File, Group};
use ndarray::{Array, ArrayD, IxDyn};
use ridgewatch::source::{Archive, Metric, SnapshotSource};
use std::path::PathBuf;
use tempfile::tempdir;

/// Nodes along x, y and z.
const N: [usize; 3] = [5, 4, 3];

/// The value of a component at a node and time.
fn value(c: usize, [x, y, z]: [usize; 3], t: usize) -> f32 {
    (1000 * c + 100 * t + 20 * z + 5 * y + x) as f32
}

/// An array whose axes are named by letters: x, y, z, t, c.
fn array(order: &str, component: usize, time: usize) -> ArrayD<f32> {
    let shape: Vec<usize> = order
        .chars()
        .map(|l| match l {
            'x' => N[0],
            'y' => N[1],
            'z' => N[2],
            't' => 2,
            'c' => 3,
            _ => 1,
        })
        .collect();
    Array::from_shape_fn(IxDyn(&shape), |index| {
        let at = |letter: char| order.find(letter).map_or(0, |k| index[k]);
        let c = if order.contains('c') { at('c') } else { component };
        let t = if order.contains('t') { at('t') } else { time };
        value(c, [at('x'), at('y'), at('z')], t)
    })
}

fn store(group: &Group, name: &str, order: &str, component: usize, time: usize) -> Dataset {
    group.new_dataset_builder().with_data(&array(order, component, time)).create(name).unwrap()
}

fn coordinates(file: &File, names: [&str; 3]) {
    for (k, name) in names.into_iter().enumerate() {
        let values: Vec<f32> = (0..N[k]).map(|i| 0.5 * i as f32).collect();
        file.new_dataset_builder().with_data(&values).create(name).unwrap();
    }
}

fn check(paths: &[PathBuf], settings: &str, times: &[f64]) -> Archive {
    let mut archive = open_with(paths, settings);
    assert_eq!((archive.grid().shape(), archive.times()), (N, times), "{settings}");
    for t in 0..times.len() {
        let snapshot = archive.read(t).unwrap();
        for (i, node) in snapshot.nodes.iter().enumerate() {
            let at = [i % N[0], i / N[0] % N[1], i / (N[0] * N[1])];
            assert_eq!(node[..3], [0, 1, 2].map(|c| value(c, at, t)), "time {t}, node {at:?}, {settings}");
        }
    }
    archive
}

#[test]
fn both_layouts_of_the_turbulence_database() {
    let dir = tempdir().unwrap();
    let current = dir.path().join("current.h5");
    let file = File::create(&current).unwrap();
    for (t, name) in ["Velocity_0011", "Velocity_0013"].into_iter().enumerate() {
        store(&file, name, "zyxc", 0, t);
    }
    coordinates(&file, ["xcoor", "ycoor", "zcoor"]);
    drop(file);
    let archive = check(std::slice::from_ref(&current), "time_step = 0.5", &[5.5, 6.5]);
    assert_eq!((archive.metric(), archive.grid().axes[0].last()), (Metric::Cartesian, 2.0));
    let archive = check(&[current], "periodic = \"xy\"", &[11.0, 13.0]);
    assert_eq!((archive.grid().axes[0].period(), archive.grid().axes[2].period()), (Some(2.5), None));
    // The older one has no coordinates, and one time a file.
    let mut paths = Vec::new();
    for t in 0..2 {
        let path = dir.path().join(format!("legacy_{t}.h5"));
        let file = File::create(&path).unwrap();
        store(&file, &format!("u{:05}", 10 * (t + 1)), "zyxc", 0, t);
        file.new_dataset_builder().with_data(&[3i32]).create("_contents").unwrap();
        paths.push(path);
    }
    refused(&paths[..1], "", &["no dataset holds the 5 coordinates along x", "--set archive.spacing=[DX,DY,DZ]"]);
    check(&paths, "spacing = [0.1, 0.1, 0.1]\norigin = [1.0, 2.0, 3.0]\ntime_step = 0.01", &[0.1, 0.2]);
    let archive = check(&paths, "velocity_unit = \"cells\"", &[0.0, 1.0]);
    assert_eq!(archive.metric(), Metric::Index);
}

#[test]
fn any_datasets_in_any_order_are_read() {
    let dir = tempdir().unwrap();
    for (n, order) in ["zyx", "xyz", "yzx", "x-yz"].into_iter().enumerate() {
        // Separate components in a group, one time a file, the time in an attribute of the file.
        let mut paths = Vec::new();
        for t in 0..2 {
            let path = dir.path().join(format!("separate_{n}_{t}.h5"));
            let file = File::create(&path).unwrap();
            let group = file.create_group("fields").unwrap();
            for (c, name) in ["vel_x", "vel_y", "vel_z"].into_iter().enumerate() {
                store(&group, name, order, c, t);
            }
            coordinates(&file, ["gx", "gy", "gz"]);
            file.new_attr::<f64>().create("time").unwrap().write_scalar(&(0.25 * t as f64)).unwrap();
            paths.push(path);
        }
        let names = "u = \"fields/vel_x\"\nv = \"fields/vel_y\"\nw = \"fields/vel_z\"\nx = \"gx\"\ny = \"gy\"\nz = \"gz\"";
        check(&paths, &format!("{names}\norder = \"{order}\""), &[0.0, 0.25]);
    }
    for (n, order) in ["tzyxc", "cxyzt", "tczyx"].into_iter().enumerate() {
        // All components and times in one dataset.
        let path = dir.path().join(format!("whole_{n}.h5"));
        let file = File::create(&path).unwrap();
        store(&file, "velocity", order, 0, 0);
        file.new_dataset_builder().with_data(&[3.0f64, 4.5]).create("time").unwrap();
        coordinates(&file, ["x", "y", "z"]);
        drop(file);
        check(&[path], &format!("velocity = \"velocity\"\norder = \"{order}\""), &[3.0, 4.5]);
    }
    // Times in attributes of the datasets, whose names are numbered.
    let path = dir.path().join("attributes.h5");
    let file = File::create(&path).unwrap();
    for t in 0..2 {
        for (c, name) in ["u", "v", "w"].into_iter().enumerate() {
            let dataset = store(&file, &format!("{name}_{t}"), "zyx", c, t);
            dataset.new_attr::<f64>().create("t").unwrap().write_scalar(&(7.0 + t as f64)).unwrap();
        }
    }
    coordinates(&file, ["x", "y", "z"]);
    drop(file);
    check(&[path], "u = \"u_*\"\nv = \"v_*\"\nw = \"w_*\"", &[7.0, 8.0]);
    // By usual names, the time in the file's name.
    let mut paths = Vec::new();
    for t in 0..2 {
        let path = dir.path().join(format!("plain_{}.h5", 100 + t));
        let file = File::create(&path).unwrap();
        for (c, name) in ["u", "v", "w"].into_iter().enumerate() {
            store(&file, name, "zyx", c, t);
        }
        coordinates(&file, ["x", "y", "z"]);
        paths.push(path);
    }
    check(&paths, "", &[100.0, 101.0]);
}

#[test]
fn what_does_not_fit_is_said() {
    let dir = tempdir().unwrap();
    let path = dir.path().join("odd.h5");
    let file = File::create(&path).unwrap();
    store(&file, "velocity", "zyxc", 0, 0);
    store(&file, "a", "zyx", 0, 0);
    store(&file, "b", "zy", 0, 0);
    coordinates(&file, ["x", "y", "z"]);
    drop(file);
    refused(&[&path], "", &["no velocity found"]);
    refused(&[&path], "velocity = \"velocities\"", &["`velocity = \"velocities\"`", "is `velocity` meant?"]);
    refused(&[&path], "velocity = \"velocity\"", &["--set archive.time=NAME"]);
    refused(&[&path], "velocity = \"velocity\"\norder = \"zyx\"", &["`zyx` does not describe", "one letter for each axis"]);
    refused(&[&path], "velocity = \"velocity\"\norder = \"zcyx\"", &["odd.h5", "component axis holds 4 entries"]);
    refused(&[&path], "velocity = \"velocity\"\nmetric = \"sphere\"", &["sphere", "cartesian"]);
    refused(&[&path], "u = \"a\"\nv = \"b\"", &["`b`", "shape"]);
    refused(&[&path], "u = \"a\"", &["given without `v`"]);
}
