//! `ridgewatch ftle`: the FTLE field on a grid, and its error.

use super::common::{Common, Usage, check_folder, chosen_steps, device, dimensions, located, open, print_json, print_text, scene};
use super::messages;
use anyhow::{Result, bail};
use ridgewatch::backend::{Device, Interruptible, TracedOnce};
use ridgewatch::field::DomainPoint;
use ridgewatch::field::analytic::Analytic;
use ridgewatch::flow::{Boundary, Extras, FlowError, FlowMap, Integrator, Precision, Steps, Traced, Tracer, VelocitySource, cpu_tracer};
use ridgewatch::publish::{FieldExport, FieldFormat, FieldFrame, SeedField, seeds};
use ridgewatch::run::{Plan, RunError, Setup, Slide, short_lived};
use ridgewatch::setting::word;
use ridgewatch::source::{self, utc};
use ridgewatch::surrogate::Trace;
use serde::Serialize;
use std::path::PathBuf;
use std::sync::atomic::AtomicBool;

/// Options of `ftle`.
#[derive(Debug, clap::Args)]
pub struct Options {
    /// A scene file (.toml), or data files, globs and URLs of Zarr stores.
    #[arg(required = true, value_name = "CONFIG | FILES")]
    paths: Vec<PathBuf>,
    /// Grid of seeds, from edge to edge of the domain: NXxNY, or NXxNYxNZ in three dimensions. Default of NZ: the number of levels of the
    /// source, or the spacing along x for closed forms.
    #[arg(long, default_value = "201x101", value_parser = grid)]
    grid: [usize; 3],
    /// Slide of the window, from 0.
    #[arg(long, default_value_t = 0, value_name = "N", conflicts_with = "slides")]
    slide: u64,
    /// Several slides, one after the other: all, N, or A..B (both included). With --out, NetCDF holds them along `time`; VTK has a file for each, and
    /// a .pvd that names them all.
    #[arg(long, value_name = "all | N | A..B", value_parser = slides)]
    slides: Option<Wanted>,
    /// Compare the field with its closed form if it has one, else with Dormand-Prince integration in f64.
    #[arg(long)]
    check: bool,
    /// Print the error for 5, 10, 20 ... 160 steps (in f64) against the same truth, and the order of convergence.
    #[arg(long)]
    convergence: bool,
    /// File of the field, with its lifetimes and errors (those of each seed with --check); by default nothing is written.
    #[arg(long, short, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Format of the file: netcdf (CF conventions), vti, vtr or vts (VTK image data, rectilinear, structured), or vtk for vti. Default: that of
    /// its extension, .nc, .vti, .vtr or .vts.
    #[arg(long, value_name = "FORMAT", value_parser = format, requires = "out")]
    format: Option<FieldFormat>,
}

/// Slides from the first to the last.
#[derive(Debug, Clone, Copy)]
struct Wanted {
    first: u64,
    /// `None`: to the end of the source.
    last: Option<u64>,
}

fn slides(text: &str) -> Result<Wanted, String> {
    let number = |text: &str| text.trim().parse::<u64>().ok().filter(|n| *n < u64::MAX);
    let wanted = match text.split_once("..") {
        None if text == "all" => Some(Wanted { first: 0, last: None }),
        None => number(text).map(|n| Wanted { first: n, last: Some(n) }),
        Some((first, last)) => number(first).zip(number(last)).map(|(first, last)| Wanted { first, last: Some(last) }),
    };
    wanted.filter(|w| w.last.is_none_or(|last| w.first <= last)).ok_or_else(|| "accepted: all, N, or A..B with A at most B".into())
}

fn format(text: &str) -> Result<FieldFormat, String> {
    Ok(match text {
        "netcdf" => FieldFormat::NetCdf,
        "vtk" | "vti" => FieldFormat::VtkImage,
        "vtr" => FieldFormat::VtkRectilinear,
        "vts" => FieldFormat::VtkStructured,
        _ => return Err("accepted: netcdf, vtk, vti, vtr, vts".into()),
    })
}

fn grid(text: &str) -> Result<[usize; 3], String> {
    match dimensions(text).filter(|numbers| numbers.iter().all(|n| (2..=16_384).contains(n))).as_deref() {
        Some(&[x, y]) => Ok([x, y, 1]),
        Some(&[x, y, z]) => Ok([x, y, z]),
        _ => Err("accepted: NXxNY or NXxNYxNZ with numbers from 2 to 16384".into()),
    }
}

/// Maximum number of seeds, which take some 8 GiB of memory.
const MAX_SEEDS: usize = 1 << 27;

#[derive(Serialize)]
struct Report {
    time: f64,
    date: Option<String>,
    tau: f64,
    grid: [usize; 3],
    integrator: Integrator,
    precision: Precision,
    steps: usize,
    /// Difference of the log-stretch from twice as many steps. `None` if the steps were given.
    integration_difference: Option<f64>,
    /// Unit of `time` and `tau`; empty if they have none.
    time_unit: String,
    source: String,
    minimum: f64,
    mean: f64,
    maximum: f64,
    missing_seeds: usize,
    /// Seeds with a velocity whose integration overflowed.
    failed_seeds: usize,
    stopped_early_share: f64,
    seconds: f64,
    samples_per_second: f64,
    check: Option<Check>,
    convergence: Option<Convergence>,
    file: Option<PathBuf>,
}

/// Reports of several slides.
#[derive(Serialize)]
struct Series {
    slides: Vec<Report>,
    file: Option<PathBuf>,
}

#[derive(Serialize)]
struct Check {
    truth: &'static str,
    /// Seeds that have a velocity.
    compared: usize,
    rms: f64,
    maximum: f64,
    maximum_relative: Option<f64>,
    psnr: Option<f64>,
}

#[derive(Serialize)]
struct Convergence {
    truth: &'static str,
    steps: Vec<usize>,
    rms: Vec<f64>,
    order: Vec<f64>,
}

/// Computes, compares and writes.
pub fn run(common: &Common, options: &Options) -> Result<()> {
    let format = options
        .out
        .as_ref()
        .filter(|_| options.format.is_none())
        .map(|out| FieldFormat::of(out).map_err(|why| Usage(format!("--out {}: {why}", out.display()))));
    let format = format.transpose()?.or(options.format).unwrap_or(FieldFormat::NetCdf);
    let scene = scene(common, &options.paths)?;
    let faulty = |error| located(&scene, error, RunError::refused);
    let Setup { plan, mut slides, notes, .. } = open(&scene)?;
    notes.iter().for_each(messages::note);
    if let Some(out) = &options.out {
        check_folder(out)?;
    }
    let wanted = options.slides.unwrap_or(Wanted { first: options.slide, last: Some(options.slide) });
    let option = if options.slides.is_some() { "--slides" } else { "--slide" };
    let few = |wanted: u64, there: u64| {
        Usage(format!("{option} {wanted}: the source has fewer slides: {there}, counted from 0 (time.slides limits them)"))
    };
    // Before any work.
    if let (Some(there), last) = (slides.expected(), wanted.last.unwrap_or(wanted.first))
        && last >= there
    {
        bail!(few(last, there));
    }
    let device = device(common, &scene)?;
    let last = wanted.last.or_else(|| slides.expected().map(|there| there.saturating_sub(1)));
    let bar = match last.map(|last| (last + 1).saturating_sub(wanted.first)) {
        // With the time left, from that of the slides so far.
        Some(count) if count > 1 => messages::progress(Some(count)).with_finish(indicatif::ProgressFinish::AndClear),
        _ => messages::spinner(String::new()),
    };
    let mut export = None;
    let mut reports = Vec::new();
    for index in 0..=wanted.last.unwrap_or(u64::MAX - 1) {
        bar.set_message("reading the window");
        let Some(slide) = slides.next_slide(&AtomicBool::new(false)).map_err(faulty)? else {
            if wanted.last.is_some() || reports.is_empty() {
                bail!(few(wanted.last.unwrap_or(wanted.first), index));
            }
            break;
        };
        if index < wanted.first {
            continue;
        }
        let report =
            compute(&plan, &slide, options, format, &device, &bar, &mut export).map_err(|error| match error.downcast::<RunError>() {
                Ok(error) => located(&scene, error, RunError::refused),
                Err(error) => match error.downcast::<FlowError>() {
                    Ok(error) => located(&scene, error, FlowError::refused),
                    Err(error) => error,
                },
            })?;
        if !common.json {
            bar.suspend(|| print_report(&report));
        }
        reports.push(report);
        bar.inc(1);
    }
    bar.finish_and_clear();
    if let Some(first) = export.as_ref().and_then(FieldExport::left_over) {
        messages::note(format_args!(
            "{} and what follows it are of an earlier, longer series, and the .pvd does not name them",
            first.display()
        ));
    }
    let file = export.map(FieldExport::finish).transpose()?;
    match (&file, common.json, options.slides) {
        (Some(file), false, _) => print_text(format_args!("written to {}", file.display())),
        (None, false, _) => {}
        (_, true, Some(_)) => return print_json(&Series { slides: reports, file }),
        (_, true, None) => return reports.pop().map_or(Ok(()), |report| print_json(&Report { file, ..report })),
    }
    Ok(())
}

/// Words of the command line, with the date, for the history of a file.
fn history() -> String {
    let words = std::env::args_os().skip(1).map(|word| word.to_string_lossy().into_owned());
    format!("{} ridgewatch {}", utc(std::time::SystemTime::now()), words.collect::<Vec<_>>().join(" "))
}

/// Computes one field and, with `--out`, adds it to the file, which the first one begins.
fn compute(
    plan: &Plan,
    slide: &Slide,
    options: &Options,
    format: FieldFormat,
    device: &Device,
    bar: &indicatif::ProgressBar,
    export: &mut Option<FieldExport>,
) -> Result<Report> {
    let mut grid = options.grid;
    match (plan.domain.dimensions, grid[2]) {
        (2, 1) => {}
        (2, n) => bail!(Usage(format!("--grid has {n} seeds along z, but the flow does not vary along z; accepted: NXxNY"))),
        (_, 1) => {
            let spaced = || {
                let lengths = plan.domain.lengths();
                (((grid[0] - 1) as f64 * lengths[2] / lengths[0]).round() as usize + 1).max(2)
            };
            grid[2] = match &slide.velocity {
                VelocitySource::Window(window) => window.grid().and_then(|g| g.axes.get(2)).map_or_else(spaced, |z| z.cells() + 1),
                VelocitySource::Analytic(..) => spaced(),
            };
        }
        _ => {}
    }
    if grid.iter().product::<usize>() > MAX_SEEDS {
        let [x, y, z] = grid;
        bail!(Usage(format!("--grid {x}x{y}x{z}: accepted: at most 2^27 seeds in all")));
    }
    let seeds = seeds(&plan.domain, grid);
    bar.set_message(format!("tracing {} seeds", seeds.len()));
    let TracedOnce { flow: tracer, traced, seconds, note } =
        device.trace(&slide.velocity, &plan.map, slide.time, &seeds, &AtomicBool::new(false)).map_err(RunError::of)?;
    note.into_iter().for_each(|note| bar.suspend(|| messages::note(note)));
    let found = SeedField::new(&*tracer, &seeds, traced);
    let lived = found.lifetime_share.iter().zip(&found.missing).filter(|(_, missing)| !**missing);
    let (lives, count) = lived.fold((0.0, 0), |(sum, count), (share, _)| (sum + f64::from(*share), count + 1));
    short_lived(lives / f64::from(count)).into_iter().for_each(|note| bar.suspend(|| messages::note(note)));
    let known: Vec<f64> = found.ftle.iter().copied().filter(|f| f.is_finite()).collect();
    let missing = found.missing.iter().filter(|missing| **missing).count();
    if options.check || options.convergence {
        bar.set_message(format!("integrating {} seeds for comparison", seeds.len()));
    }
    let truth = if options.check { Some(truth(plan, slide, &seeds)?) } else { None };
    let check = truth.as_ref().map(|truth| check(truth, &*tracer, &seeds, &found.ftle)).transpose()?;
    let convergence = if options.convergence { Some(convergence(plan, slide, &*tracer, &seeds)?) } else { None };
    if let Some(out) = &options.out {
        bar.set_message("writing the field");
        let export = match export {
            Some(export) => export,
            None => {
                let frame = FieldFrame::new(plan, slide, grid, history(), truth.as_ref().map(|(name, _)| *name));
                export.insert(FieldExport::create(out, format, frame, options.slides.is_some())?)
            }
        };
        let differences = |truth: &Vec<f64>| found.ftle.iter().zip(truth).map(|(a, b)| (a - b).abs()).collect();
        let error: Option<Vec<f64>> = truth.as_ref().map(|(_, truth)| differences(truth));
        export.add(&found.field(error.as_deref()))?;
    }
    Ok(Report {
        time: slide.time,
        date: slide.date.clone(),
        tau: tracer.tau(),
        grid,
        integrator: plan.map.integrator,
        precision: plan.map.precision,
        steps: tracer.steps(),
        integration_difference: found.difference_of_steps,
        time_unit: plan.time_unit.clone(),
        source: plan.source.clone(),
        minimum: known.iter().copied().fold(f64::INFINITY, f64::min),
        mean: known.iter().sum::<f64>() / known.len().max(1) as f64,
        maximum: known.iter().copied().fold(f64::NEG_INFINITY, f64::max),
        missing_seeds: missing,
        failed_seeds: seeds.len() - missing - known.len(),
        stopped_early_share: found.lifetime_share.iter().zip(&found.ftle).filter(|(share, ftle)| **share < 1.0 && !ftle.is_nan()).count()
            as f64
            / seeds.len() as f64,
        seconds,
        samples_per_second: seeds.len() as f64 / seconds,
        check,
        convergence,
        file: None,
    })
}

/// FTLE of a flow whose FTLE is uniform and known. `None` for other flows.
fn closed_form(plan: &Plan, velocity: &VelocitySource) -> Option<f64> {
    let tau = plan.map.tau;
    match velocity {
        VelocitySource::Analytic(flow, _) if plan.map.boundary == Boundary::Unbounded => match *flow {
            Analytic::Saddle { rate } => Some(rate.abs()),
            Analytic::Rotation { .. } => Some(0.0),
            Analytic::Shear { rate } => {
                let g = (rate * tau).abs();
                Some((1.0 + g * g / 2.0 + g * (1.0 + g * g / 4.0).sqrt()).ln() / (2.0 * tau))
            }
            _ => None,
        },
        _ => None,
    }
}

/// FTLE at the seeds that counts as the truth, with its name.
fn truth(plan: &Plan, slide: &Slide, seeds: &[DomainPoint]) -> Result<(&'static str, Vec<f64>)> {
    if let Some(value) = closed_form(plan, &slide.velocity) {
        return Ok(("closed form", vec![value; seeds.len()]));
    }
    let map = FlowMap { integrator: Integrator::DormandPrince, precision: Precision::F64, ..plan.map.clone() };
    Ok(("Dormand-Prince, f64", ftle(&map, slide, seeds)?))
}

fn ftle(map: &FlowMap, slide: &Slide, seeds: &[DomainPoint]) -> Result<Vec<f64>> {
    let tracer = cpu_tracer(slide.velocity.clone(), map, slide.time)?;
    let (mut traced, never) = (Traced::default(), AtomicBool::new(false));
    // In parts, which tell how far they are.
    Trace::trace(&Interruptible::new(&tracer, &never), seeds, Extras::default(), &mut traced)?;
    Ok(traced.unrounded().iter().map(|s| s / map.tau).collect())
}

fn check((name, truth): &(&'static str, Vec<f64>), tracer: &dyn Tracer, seeds: &[DomainPoint], ftle: &[f64]) -> Result<Check> {
    let pairs = comparable(tracer, seeds, ftle, truth)?;
    let (rms, maximum) = difference(&pairs);
    let peak = pairs.iter().map(|(_, b)| *b).fold(0.0, f64::max);
    let relative = pairs.iter().map(|(a, b)| (a - b).abs() / b.abs()).fold(0.0, f64::max);
    Ok(Check {
        truth: name,
        compared: pairs.len(),
        rms,
        maximum,
        maximum_relative: relative.is_finite().then_some(relative),
        psnr: (rms > 0.0 && peak > 0.0).then(|| 20.0 * (peak / rms).log10()),
    })
}

/// Both values at every seed with a velocity. A value there that is not finite is an error.
fn comparable(tracer: &dyn Tracer, seeds: &[DomainPoint], a: &[f64], b: &[f64]) -> Result<Vec<(f64, f64)>> {
    let pairs = a.iter().copied().zip(b.iter().copied());
    let pairs: Vec<(f64, f64)> = pairs.zip(seeds).filter(|(_, seed)| !tracer.is_missing(**seed)).map(|(pair, _)| pair).collect();
    let failed = pairs.iter().filter(|(a, b)| !a.is_finite() || !b.is_finite()).count();
    match (pairs.len(), failed) {
        (0, _) => bail!("no seed has a velocity: there is nothing to compare"),
        (_, 0) => Ok(pairs),
        (all, failed) => bail!("{failed} of {all} seeds have no finite FTLE, here or in the truth: a shorter tau or more steps may help"),
    }
}

/// Root mean square and maximum of the difference.
fn difference(pairs: &[(f64, f64)]) -> (f64, f64) {
    let square = pairs.iter().map(|(a, b)| (a - b).powi(2)).sum::<f64>() / pairs.len() as f64;
    (square.sqrt(), pairs.iter().map(|(a, b)| (a - b).abs()).fold(0.0, f64::max))
}

fn convergence(plan: &Plan, slide: &Slide, tracer: &dyn Tracer, seeds: &[DomainPoint]) -> Result<Convergence> {
    let (name, truth) = truth(plan, slide, seeds)?;
    let steps: Vec<usize> = (0..6).map(|k| 5 << k).collect();
    let mut rms = Vec::new();
    for &n in &steps {
        let map = FlowMap { integrator: Integrator::Tangent, precision: Precision::F64, steps: Steps::Fixed(n), ..plan.map.clone() };
        rms.push(difference(&comparable(tracer, seeds, &ftle(&map, slide, seeds)?, &truth)?).0);
    }
    let order = rms.windows(2).map(|pair| (pair[0] / pair[1]).log2()).collect();
    Ok(Convergence { truth: name, steps, rms, order })
}

fn print_report(report: &Report) {
    let [nx, ny, nz] = report.grid;
    let when = report.date.clone().unwrap_or_else(|| format!("t0 = {}", report.time));
    print_text(format_args!(
        "{when}, tau = {}: {}, {}, {} steps, {nx} x {ny} x {nz} seeds in {:.3} s ({:.0} samples/s)",
        source::duration(report.tau, &report.time_unit),
        word(report.integrator),
        word(report.precision),
        report.steps,
        report.seconds,
        report.samples_per_second
    ));
    if let Some(difference) = report.integration_difference {
        messages::note(chosen_steps(report.steps as u64, difference, None));
    }
    let per = if report.time_unit.is_empty() { String::new() } else { format!(" 1/{}", report.time_unit) };
    print_text(format_args!("FTLE from {:.6e} to {:.6e}, mean {:.6e}{per}", report.minimum, report.maximum, report.mean));
    if report.missing_seeds > 0 || report.stopped_early_share > 0.0 {
        print_text(format_args!(
            "{} seeds without velocity; {:.2} % of the particles stopped early",
            report.missing_seeds,
            100.0 * report.stopped_early_share
        ));
    }
    if report.failed_seeds > 0 {
        messages::note(format_args!("{} seeds have no finite FTLE: the integration overflowed there", report.failed_seeds));
    }
    if let Some(check) = &report.check {
        let relative = check.maximum_relative.map_or_else(String::new, |r| format!(", relative {r:.3e}"));
        let psnr = check.psnr.map_or_else(String::new, |p| format!(", PSNR {p:.1} dB"));
        print_text(format_args!("against {}: rms {:.3e}, maximum {:.3e}{relative}{psnr}", check.truth, check.rms, check.maximum));
    }
    if let Some(c) = &report.convergence {
        let f64 = if c.truth.ends_with("f64") { "" } else { ", steps in f64" };
        print_text(format_args!("against {}{f64}:", c.truth));
        for (k, (steps, rms)) in c.steps.iter().zip(&c.rms).enumerate() {
            let order = if k > 0 { format!("   order {:.2}", c.order[k - 1]) } else { String::new() };
            print_text(format_args!("  {steps:>4} steps   rms {rms:.3e}{order}"));
        }
    }
}
