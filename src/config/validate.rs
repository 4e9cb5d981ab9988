//! Ranges, and values that must go together.

use super::error::Fault;
use super::{SceneFile, SourceKind, StepsSetting};
use crate::flow::{Boundary, Integrator, Precision};

/// Largest picture edge and sample count: beyond them a typing slip is more likely than a wish.
const MAX_EDGE: usize = 16_384;
const MAX_SAMPLES: usize = 1 << 20;

fn fault(key: &str, found: impl std::fmt::Display, accepted: &str) -> Result<(), Fault> {
    Err(Fault { key: key.to_owned(), found: found.to_string(), accepted: accepted.to_owned() })
}

fn require(ok: bool, key: &str, value: impl std::fmt::Debug, accepted: &str) -> Result<(), Fault> {
    if ok { Ok(()) } else { fault(key, format!("is {value:?}"), accepted) }
}

fn positive(key: &str, value: f64) -> Result<(), Fault> {
    require(value.is_finite() && value > 0.0, key, value, "a number above 0")
}

fn count(key: &str, value: usize, low: usize, high: usize) -> Result<(), Fault> {
    require((low..=high).contains(&value), key, value, &format!("a whole number from {low} to {high}"))
}

/// The first fault found, if any.
pub(super) fn check(scene: &SceneFile) -> Result<(), Fault> {
    check_source(scene)?;
    check_time(scene)?;
    check_flow(scene)?;
    check_learning(scene)?;
    check_trust(scene)?;
    check_render(scene)?;
    require(
        scene.device.memory_mib.is_none_or(|mib| (1..=1 << 24).contains(&mib)),
        "device.memory_mib",
        scene.device.memory_mib,
        "1 or more",
    )
}

fn check_source(scene: &SceneFile) -> Result<(), Fault> {
    let source = &scene.source;
    let kind = source.kind;
    use SourceKind::*;
    let given = [
        ("amplitude", source.amplitude, &[DoubleGyre, Turbulence][..]),
        ("epsilon", source.epsilon, &[DoubleGyre]),
        ("omega", source.omega, &[DoubleGyre, Rotation]),
        ("rate", source.rate, &[Saddle, Shear]),
        ("a", source.a, &[Abc]),
        ("b", source.b, &[Abc]),
        ("c", source.c, &[Abc]),
        ("growth", source.growth, &[Abc]),
        ("k_max", source.k_max, &[Turbulence]),
        ("nodes", source.nodes.map(|n| n[0] as f64), &[Turbulence]),
        ("modes", source.modes.map(|n| n as f64), &[Turbulence]),
        ("snapshots", source.snapshots.map(|n| n as f64), &[Turbulence]),
    ];
    for (key, value, kinds) in given {
        let Some(value) = value else { continue };
        let key = format!("source.{key}");
        if !kinds.contains(&kind) {
            return fault(&key, format!("does not belong to kind {kind:?}"), &format!("only with kind {kinds:?}"));
        }
        require(value.is_finite(), &key, value, "a finite number")?;
    }
    if let Some(nodes) = source.nodes {
        for n in nodes {
            count("source.nodes", n, 4, 4096)?;
        }
        count("source.nodes", nodes.iter().product(), 64, 1 << 28)?;
    }
    if let Some(n) = source.modes {
        count("source.modes", n, 1, 4096)?;
    }
    if let Some(n) = source.snapshots {
        count("source.snapshots", n, 2, 100_000)?;
    }
    if let Some(k) = source.k_max {
        require(k > 2.0, "source.k_max", k, "a number above 2, the smallest wave number")?;
    }
    match (kind, &scene.domain) {
        (Archive | Turbulence, Some(_)) => fault(
            "domain",
            "is given for gridded velocity",
            "no [domain]: the grid is the domain (archives may be cropped with archive.region)",
        )?,
        (DoubleGyre | Abc | Saddle | Rotation | Shear, None) => {
            fault("domain", "is missing", "[domain] with min = [x, y, z] and max = [x, y, z], since a closed form has no grid")?
        }
        _ => {}
    }
    if let Some(domain) = &scene.domain {
        let proper = (0..3).all(|k| domain.min[k].is_finite() && domain.max[k].is_finite() && domain.max[k] > domain.min[k]);
        require(proper, "domain.max", domain.max, &format!("three finite numbers above domain.min = {:?}", domain.min))?;
    }
    if kind == Archive && scene.archive.files.is_empty() {
        fault("archive.files", "is empty", "a list of files or globs")?;
    }
    Ok(())
}

fn check_time(scene: &SceneFile) -> Result<(), Fault> {
    let time = &scene.time;
    match &time.tau {
        Some(tau) => {
            let accepted = "a number above 0 in the source's time unit, or words such as \"30 days\", \"36 h\", \"90 min\"";
            require(tau.value().is_some_and(|v| v.is_finite() && v > 0.0), "time.tau", tau, accepted)?;
            if tau.has_unit() && scene.source.kind != SourceKind::Archive {
                fault("time.tau", "has a unit", "a plain number: the time of a closed form has no unit")?;
            }
        }
        None if scene.source.kind != SourceKind::Archive => fault("time.tau", "is missing", "a number above 0")?,
        None => {}
    }
    require(time.start.is_finite(), "time.start", time.start, "a finite number")?;
    require(time.step.is_finite(), "time.step", time.step, "a finite number")?;
    if let Some(slides) = time.slides {
        count("time.slides", slides, 1, 10_000_000)?;
    }
    count("time.stride", time.stride, 1, 1_000_000)?;
    count("time.frames_per_slide", time.frames_per_slide, 1, 1_000_000)?;
    count("time.warmup_frames", time.warmup_frames, 0, 1_000_000)
}

fn check_flow(scene: &SceneFile) -> Result<(), Fault> {
    let flow = &scene.flow;
    if let StepsSetting::Fixed(steps) = flow.steps {
        count("flow.steps", steps, 1, 10_000_000)?;
    }
    if let Some(tolerance) = flow.tolerance {
        positive("flow.tolerance", tolerance)?;
    }
    positive("flow.gap", flow.gap)?;
    let gridded = matches!(scene.source.kind, SourceKind::Archive | SourceKind::Turbulence);
    if gridded && flow.boundary == Some(Boundary::Unbounded) {
        fault("flow.boundary", "is \"unbounded\"", "stop, clamp, periodic or zero: gridded velocity ends at its grid")?;
    }
    if flow.integrator == Integrator::DormandPrince && flow.precision == Precision::F32 {
        fault("flow.precision", "is \"f32\"", "\"f64\" with integrator = \"dormandprince\", which is the reference")?;
    }
    Ok(())
}

fn check_learning(scene: &SceneFile) -> Result<(), Fault> {
    if let Some(nodes) = scene.surrogate.table_nodes {
        for n in nodes {
            count("surrogate.table_nodes", n, 2, 16_384)?;
        }
    }
    let n = &scene.network;
    count("network.levels", n.levels, 1, 32)?;
    require([1, 2, 4, 8].contains(&n.features), "network.features", n.features, "1, 2, 4 or 8")?;
    require((4..=24).contains(&n.log2_table), "network.log2_table", n.log2_table, "a whole number from 4 to 24")?;
    count("network.base_resolution", n.base_resolution, 2, 4096)?;
    require(n.growth.is_finite() && n.growth >= 1.0 && n.growth <= 4.0, "network.growth", n.growth, "a number from 1 to 4")?;
    count("network.octaves", n.octaves, 1, 16)?;
    count("network.hidden_layers", n.hidden_layers, 1, 64)?;
    require((8..=1024).contains(&n.width) && n.width.is_multiple_of(8), "network.width", n.width, "a multiple of 8 from 8 to 1024")?;
    count("network.batch", n.batch, 64, 1 << 22)?;
    require(n.mean_penalty.is_finite() && n.mean_penalty >= 0.0, "network.mean_penalty", n.mean_penalty, "0 or a number above")?;
    if let Some(rate) = n.learning_rate {
        positive("network.learning_rate", f64::from(rate))?;
    }
    let t = &scene.training;
    require((0.0..1.0).contains(&t.share), "training.share", t.share, "a number from 0 up to, not including, 1")?;
    require(
        t.seconds_per_frame.is_finite() && t.seconds_per_frame >= 0.0,
        "training.seconds_per_frame",
        t.seconds_per_frame,
        "0 or a number above",
    )?;
    require(t.seconds_per_frame <= 86_400.0, "training.seconds_per_frame", t.seconds_per_frame, "at most 86400 (a day)")?;
    if let Some(steps) = t.steps_per_frame {
        require((1..=100_000_000).contains(&steps), "training.steps_per_frame", steps, "a whole number from 1 to 100000000")?;
    }
    count("training.ring", t.ring, 1024, 1 << 28)
}

fn check_trust(scene: &SceneFile) -> Result<(), Fault> {
    let t = &scene.trust;
    positive("trust.tolerance", t.tolerance)?;
    require((0.01..=1.0).contains(&t.audit_share), "trust.audit_share", t.audit_share, "a number from 0.01 to 1")?;
    count("trust.audit_per_cell", t.audit_per_cell, 1, 4096)?;
    count("trust.audit_most_per_cell", t.audit_most_per_cell, 1, 65_536)?;
    require((0.001..=1.0).contains(&t.audit_precision), "trust.audit_precision", t.audit_precision, "a number from 0.001 to 1")?;
    require((4.0..=4096.0).contains(&t.min_samples), "trust.min_samples", t.min_samples, "a number from 4 to 4096")?;
    require(t.slide_inflation.is_finite() && t.slide_inflation >= 1.0, "trust.slide_inflation", t.slide_inflation, "a number from 1 up")?;
    if let Some(seconds) = t.trace_budget {
        positive("trust.trace_budget", seconds)?;
    }
    if let Some(cells) = t.cells {
        for n in cells {
            count("trust.cells", n, 1, 1024)?;
        }
        count("trust.cells", cells.iter().product(), 1, 1 << 20)?;
    }
    Ok(())
}

fn check_render(scene: &SceneFile) -> Result<(), Fault> {
    let r = &scene.render;
    count("render.width", r.width, 1, MAX_EDGE)?;
    count("render.height", r.height, 1, MAX_EDGE)?;
    count("render.samples", r.samples, 1, MAX_SAMPLES)?;
    if let Some(cells) = r.majorant_cells {
        for n in cells {
            count("render.majorant_cells", n, 1, 1024)?;
        }
        count("render.majorant_cells", cells.iter().product(), 1, 1 << 24)?;
    }
    Ok(())
}
