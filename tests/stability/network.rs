//! The network: learning rates that diverge, labels without a value, regime changes of a run, regions that the camera never sees.

use crate::kit::scene;
use crate::network_support::{DoubleGyre, rms, traced, uniform_points};
use crate::sweep::{decibels, grid, lattice, map, map_psnr, row, window};
use ridgewatch::field::{Domain, Snapshot, Window, WindowWarning};
use ridgewatch::flow::{Boundary, Extras, FlowMap, Precision, VelocitySource};
use ridgewatch::publish::compare_films;
use ridgewatch::run::{FrameRecord, RunOptions};
use ridgewatch::surrogate::network::NetworkSettings;
use ridgewatch::surrogate::{HostSurrogate, Kind, Predict, ReplayBuffer, Samples, SurrogateSettings, build};
use std::sync::Arc;

fn settings(rate: Option<f32>) -> NetworkSettings {
    NetworkSettings {
        levels: Some(4),
        log2_table: Some(10),
        width: 16,
        batch: Some(512),
        learning_rate: rate,
        ..NetworkSettings::default()
    }
}

fn network(tracer: &DoubleGyre, rate: Option<f32>) -> HostSurrogate {
    build(
        &SurrogateSettings { kind: Kind::Network, table_nodes: None, ..SurrogateSettings::default() },
        &settings(rate),
        &tracer.domain,
        5,
        tracer,
    )
    .unwrap()
}

fn size(samples: &Samples) -> f64 {
    crate::sweep::rms(samples.log_stretch.iter().map(|&s| f64::from(s)))
}

/// PSNR of a map that the network answers alone, one of these points a pixel.
fn picture(network: &HostSurrogate, held_out: &Samples) -> f64 {
    let mut predicted = vec![0.0; held_out.len()];
    network.predict(&held_out.points, &mut predicted).unwrap();
    let [found, exact] = [&predicted, &held_out.log_stretch].map(|values| values.iter().map(|&s| f64::from(s)).collect::<Vec<f64>>());
    map_psnr(&found, &exact)
}

/// Fails without the roll-back of the weights.
#[test]
fn learning_rate_too_high() {
    let tracer = DoubleGyre::new(0.0, 10.0, 20);
    let (samples, held_out) = (traced(&tracer, uniform_points(1, 5_000), false), traced(&tracer, uniform_points(2, 1_000), false));
    let buffer = ReplayBuffer::holding(&samples);
    let mut found = Vec::new();
    for rate in [1e-3, 1e-2, 3e-2, 1e-1, 3e-1, 1.0] {
        let mut network = network(&tracer, Some(rate));
        let learned = network.learn(&buffer, f64::INFINITY, 400).unwrap();
        let error = rms(&network, &held_out) / size(&held_out);
        println!("rate {rate}: {} roll-backs, {} steps lost, error {:.3} of the labels", learned.rollbacks, learned.lost_steps, error);
        assert!(error.is_finite() && error < 2.0, "rate {rate}: {error}");
        found.push((rate, learned.rollbacks, learned.lost_steps, error, picture(&network, &held_out)));
    }
    let fails = found.iter().find(|f| f.1 > 0).expect("a rate diverges");
    let usual = found.iter().find(|f| f.0 == 1e-2).unwrap();
    assert!(usual.1 == 0 && fails.0 > usual.0, "{found:?}");
    // Labels so large that every loss diverges, after good ones: the weights are those of before, to the bit.
    let mut calm = network(&tracer, None);
    calm.learn(&buffer, f64::INFINITY, 100).unwrap();
    let before = rms(&calm, &held_out);
    let poison = Samples { log_stretch: vec![1e30; samples.len()], ..samples };
    let learned = calm.learn(&ReplayBuffer::holding(&poison), f64::INFINITY, 20).unwrap();
    assert!(learned.rollbacks > 0 && learned.steps == 0, "{learned:?}");
    assert_eq!(rms(&calm, &held_out), before, "rolled back");
    row([
        "learning rate too high",
        &format!("rate {} (roll-backs in 400 steps: {}); the default is 0.01", fails.0, fails.1),
        "`training.rollbacks`, `training.lost_steps`, a warning",
        "goes back to the last good weights at half the rate",
        &format!(
            "{:.2} of the labels' size at that rate (map {}), {:.2} at 1 ({}), {:.2} at the default ({})",
            fails.3,
            decibels(fails.4),
            found[5].3,
            decibels(found[5].4),
            usual.3,
            decibels(usual.4)
        ),
        "learning_rate_too_high",
    ]);
}

#[test]
fn labels_without_a_value() {
    let tracer = DoubleGyre::new(0.0, 10.0, 20);
    let (samples, held_out) = (traced(&tracer, uniform_points(1, 5_000), false), traced(&tracer, uniform_points(2, 1_000), false));
    let mut found = Vec::new();
    for share in [0.0, 0.5, 0.9, 0.99, 0.999] {
        let mut spoiled = samples.clone();
        let lost = (share * 5_000.0) as usize;
        spoiled.log_stretch[..lost].fill(f32::NAN);
        let mut network = network(&tracer, None);
        let learned = network.learn(&ReplayBuffer::holding(&spoiled), f64::INFINITY, 300).unwrap();
        assert_eq!((learned.dropped, learned.rollbacks), (lost as u64, 0), "dropped and counted");
        let error = rms(&network, &held_out) / size(&held_out);
        assert!(error.is_finite());
        found.push((share, error, picture(&network, &held_out)));
    }
    println!("{found:?}");
    let fails = found.iter().find(|f| f.1 > 2.0 * found[0].1).expect("too few labels remain");
    assert!(fails.0 >= 0.5 && fails.2 < found[0].2, "half of the labels suffice: {found:?}");
    row([
        "labels without a value (NaN)",
        &format!("{:.0} % of the labels lost (error {:.1} times as large)", 100.0 * fails.0, fails.1 / found[0].1),
        "`training.dropped`",
        "drops and counts them; the others train as before",
        &format!(
            "{:.2} of the labels' size with all of them (map {}), {:.2} there ({})",
            found[0].1,
            decibels(found[0].2),
            fails.1,
            decibels(fails.2)
        ),
        "labels_without_a_value",
    ]);
}

#[test]
fn velocities_without_a_value() {
    // A uniform wind over 20 cells. Scattered nodes lose their velocity in the last snapshots.
    let grid = grid([64.0, 64.0], [65, 65]);
    let nodes = grid.nodes();
    let mut found = Vec::new();
    for share in [0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.04, 0.06, 0.1] {
        let gone = |i: usize| (0.5 + 0.618_033_988_75 * ((i * 7919) % nodes) as f64).fract() < share;
        let snapshot = |time: f64| {
            let u: Vec<f32> = (0..nodes).map(|i| if time > 1.5 && gone(i) { f32::NAN } else { 1.0 }).collect();
            Snapshot::from_components(time, grid.clone(), &u, &vec![0.0; nodes], &[])
        };
        let mut pushed = Window::new(20.0);
        let warned = (0..=20)
            .any(|i| matches!(pushed.push(Arc::new(snapshot(f64::from(i)))).unwrap().warning, Some(WindowWarning::MissingBurst { .. })));
        let seeds = lattice(&Domain::slab([1.0, 1.0], [43.0, 63.0], (0.0, 1.0)), [40, 40]);
        let map = FlowMap { boundary: Boundary::Stop, ..map(20.0, 80, Precision::F32) };
        let out = crate::kit::flow::trace(&VelocitySource::Window(window(20.0, 1.0, snapshot)), &map, 0.0, &seeds, Extras::default());
        let stopped = out.lifetime_share.iter().filter(|&&l| l < 1.0).count() as f64 / seeds.len() as f64;
        let lived = out.lifetime_share.iter().map(|&l| f64::from(l)).sum::<f64>() / seeds.len() as f64;
        println!(
            "{:.2} % of the nodes lost: {:.0} % of the paths stop, lifetime {lived:.2}, warned {warned}",
            100.0 * share,
            100.0 * stopped
        );
        assert!(out.log_stretch.iter().all(|s| s.is_finite()), "no NaN reaches a path");
        found.push((share, stopped, lived, warned));
    }
    let fails = found.iter().find(|f| f.1 > 0.1).unwrap();
    let burst = found.iter().find(|f| f.3).unwrap();
    let mean = found.iter().find(|f| f.2 < 0.75).unwrap();
    // The snapshot's own warning asks for a twentieth of the nodes; the record's lifetime comes first.
    assert!(burst.0 > 0.05 && mean.0 < burst.0, "{found:?}");
    row([
        "velocities without a value (NaN), scattered",
        &format!("{:.2} % of the nodes ({:.0} % of the paths stop within 20 cells)", 100.0 * fails.0, 100.0 * fails.1),
        &format!("`mean_lifetime_share` ({:.2} there)", fails.2),
        &format!("a path that needs the node stops; warns of the lifetime from {:.1} % on, of the snapshot from 5 % on", 100.0 * mean.0),
        &format!("{:.0} % of the paths stop at the first warning", 100.0 * mean.1),
        "velocities_without_a_value",
    ]);
}

/// Records of a run of the double gyre whose network takes a fixed number of steps a frame.
fn records(keys: &str) -> Vec<FrameRecord> {
    let common = "
        time.tau = 5
        flow.steps = 40
        training.steps_per_frame = 80
        surrogate.kind = \"network\"
        transfer.low = 0.05
        transfer.high = 0.4
        transfer.extinction = 50
    ";
    let text = scene::double_gyre([32, 16, 4], &(common.to_owned() + scene::SMALL_NETWORK + keys));
    let mut records = Vec::new();
    let options = RunOptions { verify_points: 20_000, ..RunOptions::default() };
    scene::run_frames(scene::setup(&text, &[]), &options, |frame| records.push((*frame.record).clone()));
    records
}

#[test]
fn a_regime_change_at_a_slide() {
    let mut found = Vec::new();
    for jump in [0.05, 0.5, 2.5] {
        let records = records(&format!("time.slides = 2\ntime.frames_per_slide = 12\ntime.seed_step = {jump}"));
        let of_slide = |slide: u64| records.iter().filter(move |r| r.slide == slide);
        let before = of_slide(0).next_back().unwrap();
        let after: Vec<&FrameRecord> = of_slide(1).collect();
        let regained = after.iter().position(|r| r.trusted_volume >= 0.9 * before.trusted_volume);
        let worst = after.iter().filter_map(|r| r.verified_error).map(|e| e.optical_rms).fold(0.0, f64::max);
        println!(
            "jump {jump}: trusted {:.2}, then {:.2}, regained after {regained:?}; worst verified error {worst:.4}; traced {:.2}, then {:.2}; PSNR {:.1}, then {:.1}",
            before.trusted_volume,
            after[0].trusted_volume,
            before.traced_share,
            after[0].traced_share,
            before.surrogate_psnr.unwrap(),
            after[0].surrogate_psnr.unwrap()
        );
        assert!(after[0].trusted_volume < before.trusted_volume, "a slide costs trust");
        // What the gate lets through meanwhile: the tolerance, and a fifth for the error of estimates from few points.
        assert!(worst < 1.2 * 0.03, "jump {jump}: {worst}");
        found.push((
            jump,
            before.trusted_volume,
            after[0].trusted_volume,
            regained,
            worst,
            after[0].traced_share,
            before.surrogate_psnr.unwrap() - after[0].surrogate_psnr.unwrap(),
        ));
    }
    let [small, _, large] = [found[0], found[1], found[2]];
    assert!(large.2 < small.2 && large.5 > small.5, "a larger jump costs more trust: {found:?}");
    let regained = |f: Option<usize>| f.map_or("not within 12 frames".to_owned(), |n| format!("{} frames", n + 1));
    row([
        "regime change at a slide (forgetting)",
        &format!("start time moves by a quarter of a period: the network loses {:.1} dB (by 1/200: {:.1} dB)", large.6, small.6),
        "`surrogate_psnr`, `trusted_volume`, `traced_share`",
        "all cells earn their trust again from points traced before the frame; the rest is traced",
        &format!(
            "trusted volume {:.2}, then {:.2}, regained in {}; error where trusted at most {:.3} (tolerance 0.03)",
            large.1,
            large.2,
            regained(large.3),
            large.4
        ),
        "a_regime_change_at_a_slide",
    ]);
}

#[test]
fn a_region_the_camera_never_sees() {
    let mut found = Vec::new();
    // Parallel rays on a part of the domain, from all of it down to a corner.
    for seen in [1.0, 0.25, 0.0625] {
        let edge = f64::sqrt(seen);
        let (x, y) = (edge, 0.5 * edge);
        // Half the picture's width is the distance times the tangent of half the field of view.
        let keys = format!(
            "time.slides = 1\ntime.frames_per_slide = 16\ncamera.eye = [{x}, {y}, 1.2]\ncamera.look_at = [{x}, {y}, 0.2]\ncamera.up = [0, 1, 0]\ncamera.orthographic = true\ncamera.field_of_view = {}",
            2.0 * edge.atan().to_degrees()
        );
        let records = records(&keys);
        let last = records.last().unwrap();
        let held = records.iter().filter_map(|r| Some((r.trusted_error?, r.verified_error?))).map(|(s, v)| (s.optical_rms, v.optical_rms));
        let (count, off) = held.fold((0, 0.0), |(n, off), (s, v)| (n + 1, off + (s / v - 1.0).powi(2)));
        let off = f64::sqrt(off / f64::from(count.max(1)));
        let verified = last.verified_error.unwrap().optical_rms;
        println!(
            "{:.0} % seen: PSNR {:.1}, trusted {:.2}, verified {verified:.4}, stated off by {:.1} % (rms over {count} frames)",
            100.0 * seen,
            last.surrogate_psnr.unwrap(),
            last.trusted_volume,
            100.0 * off
        );
        assert!(off < 0.2, "the statement covers what is not seen: {off}");
        assert!(verified < 1.1 * 0.03, "{verified}");
        found.push((seen, last.surrogate_psnr.unwrap(), last.trusted_volume, off, verified));
    }
    let [all, .., corner] = found[..] else { panic!() };
    assert!(corner.2 > corner.0, "cells that are never seen are trusted by their audits: {corner:?}");
    row([
        "a region the camera never sees",
        &format!("{:.0} % of the domain seen: PSNR over the domain {:.1} dB less", 100.0 * corner.0, all.1 - corner.1),
        "`surrogate_psnr`, `trusted_error`: both over the whole domain",
        "audits and labels cover the domain, whatever the picture shows",
        &format!("{:.3} where trusted ({:.0} % of the domain), stated to {:.0} %", corner.4, 100.0 * corner.2, 100.0 * corner.3),
        "a_region_the_camera_never_sees",
    ]);
}

/// Fails without the share of audit points.
#[test]
fn too_few_audit_points() {
    let mut found = Vec::new();
    for share in [1.0, 0.3, 0.1, 0.03, 0.01] {
        // A coarse table, whose error is that of its nodes, in eight large cells. Nothing but the share asks for points.
        let keys = format!(
            "surrogate.kind = \"table\"\nsurrogate.table_nodes = [33, 17, 2]\ntime.tau = 5\ntime.slides = 1\ntime.frames_per_slide = 10\n\
             flow.steps = 40\ntransfer.low = 0.05\ntransfer.high = 0.4\ntransfer.extinction = 20\ntrust.tolerance = 0.3\ntrust.cells = [4, 2, 1]\n\
             trust.audit_min_per_cell = 1\ntrust.audit_max_per_cell = 1\ntrust.audit_share = {share}"
        );
        let options = RunOptions { verify_points: 20_000, ..RunOptions::default() };
        let (mut held, mut frames, mut width, mut points, mut errs) = (0, 0, 0.0, 0.0, 0.0);
        scene::run_frames(scene::setup(&scene::double_gyre([32, 16, 2], &keys), &[]), &options, |frame| {
            let record = &frame.record;
            assert!(record.audited as f64 >= share * record.queries as f64, "{} points for {} queries", record.audited, record.queries);
            let (Some(stated), Some(verified)) = (record.trusted_error, record.verified_error) else { return };
            let [low, high] = stated.optical_rms_interval;
            held += u32::from((low..=high).contains(&verified.optical_rms));
            width += (high - low) / verified.optical_rms;
            errs += verified.optical_rms;
            points += record.audited as f64;
            frames += 1;
        });
        assert!(frames >= 9, "every frame states an error");
        println!(
            "share {share}: {:.0} points, width {:.2}, {held} of {frames} hold",
            points / f64::from(frames),
            width / f64::from(frames)
        );
        found.push((share, points / f64::from(frames), width / f64::from(frames), held, frames, errs / f64::from(frames)));
    }
    let fails = found.iter().find(|f| f.2 > 1.0).unwrap_or(&found[found.len() - 1]);
    assert!(found[4].2 > 3.0 * found[0].2, "fewer points say less: {found:?}");
    row([
        "too few audit points",
        &format!("{:.0} points (interval {:.1} times as wide as the value)", fails.1, fails.2),
        "`trusted_error.optical_rms_interval`, `audited`",
        "traces `trust.audit_share` of all queries, whatever the gate says, and more until the standard error is a tenth (`audit_precision`)",
        &format!(
            "{:.3} of the ramp where trusted; {:.0} points: {:.2} times as wide, {} of {} intervals hold",
            fails.5, found[0].1, found[0].2, found[0].3, found[0].4
        ),
        "too_few_audit_points",
    ]);
}

/// A smooth picture of a network that is trusted nowhere is that of the traced nodes, from the first frame on.
#[test]
fn what_a_network_does_not_know_is_traced_for_smooth_pictures() {
    let text = |keys: &str| {
        let common = "
            source.nodes = [24, 12, 12]
            time.tau = 5
            time.slides = 1
            time.frames_per_slide = 1
            flow.steps = 10
            transfer.low = 0.05
            transfer.high = 0.3
            render.method = \"marched\"
        ";
        scene::scene("turbulence", [64, 32, 1], &format!("{common}{keys}"))
    };
    let first = |keys: &str| {
        let mut frames = Vec::new();
        scene::run_frames(scene::setup(&text(keys), &[]), &RunOptions::default(), |frame| frames.push(frame));
        frames.remove(0)
    };
    let table = first("surrogate.kind = \"table\"\nsurrogate.table_nodes = [24, 12, 12]\n");
    let keys = "network.levels = 4\nnetwork.log2_table = 12\nnetwork.width = 16\ntraining.steps_per_frame = 1\n";
    let network = first(&format!("surrogate.kind = \"network\"\ntrust.tolerance = 1e-6\n{keys}"));
    let psnr = compare_films(&network.film, &table.film, network.tone_map).unwrap().psnr.unwrap_or(f64::INFINITY);
    println!("first frame of an untrained network beside a table: {psnr:.1} dB, {} traced before it", network.record.preparation_traces);
    assert!(psnr > 60.0 && network.record.preparation_traces >= 24 * 12 * 12, "{psnr} dB");
}
