//! `ridgewatch train`: offline training of a scene's network on a still window.

use super::common::{Common, Interrupted, Usage, device, located, print_json, print_text, scene};
use super::messages;
use super::signals::Stop;
use anyhow::{Context, Result, bail};
use ridgewatch::chart::{Curve, Epoch, TrainOptions, TrainReport, train, write_epochs};
use ridgewatch::files::{open, write_whole};
use ridgewatch::publish::write_png;
use ridgewatch::render::Film;
use ridgewatch::run::RunError;
use ridgewatch::source::SourceKind;
use ridgewatch::surrogate::Kind;
use std::fmt::Write;
use std::path::{Path, PathBuf};

/// Columns of epochs.csv.
const HEAD: &str = "epoch,steps,seconds,loss,rms,psnr,rollbacks";

/// Options of `train`.
#[derive(Debug, clap::Args)]
pub struct Options {
    /// A scene file (.toml), or data files, globs and URLs of Zarr stores. The surrogate is the scene's (surrogate.kind network or residual).
    #[arg(required = true, value_name = "CONFIG | FILES")]
    paths: Vec<PathBuf>,
    /// Passes over the labels.
    #[arg(long, default_value_t = 100, value_parser = clap::value_parser!(u64).range(1..=1_000_000))]
    epochs: u64,
    /// Traced labels.
    #[arg(long, default_value_t = 1 << 20, value_parser = clap::value_parser!(u64).range(1024..=1 << 28))]
    labels: u64,
    /// Epochs after which a picture of the network alone is written, besides the last one.
    #[arg(long, value_delimiter = ',', default_values_t = [1, 100], value_name = "EPOCHS")]
    pictures: Vec<u64>,
    /// Folder for epochs.csv, epochs.svg and the pictures. Files of these names are replaced.
    #[arg(long, short, default_value = "out/train")]
    out: PathBuf,
    /// Folders of earlier trainings, whose curves are drawn beside this one, by the folders' names.
    #[arg(long, num_args = 1.., value_name = "FOLDER")]
    beside: Vec<PathBuf>,
}

/// Trains.
pub fn run(common: &Common, options: &Options) -> Result<()> {
    let scene = scene(common, &options.paths)?;
    if scene.source.kind == SourceKind::Live {
        bail!(Usage("a running simulation has no still window to train on; accepted: archives and closed forms".into()));
    }
    if scene.surrogate.kind == Kind::Table {
        bail!(Usage(
            "a table is not trained; accepted: a scene with surrogate.kind network or residual (--set surrogate.kind=network)".into()
        ));
    }
    if !scene.network.inputs.is_empty() {
        bail!(Usage(
            "network.inputs is given, and a still window has one start time and duration; accepted: a network over positions".into()
        ));
    }
    let beside = options.beside.iter().map(|folder| read_curve(folder)).collect::<Result<Vec<Curve>>>()?;
    let device = device(common, &scene)?;
    std::fs::create_dir_all(&options.out).with_context(|| format!("cannot make the folder {}", options.out.display()))?;
    let wanted = TrainOptions {
        epochs: options.epochs,
        labels: options.labels as usize,
        pictures: options.pictures.clone(),
        ..TrainOptions::default()
    };
    let bar = messages::progress(Some(options.epochs));
    let (tone_map, mut failed) = (scene.render.tone_map, None);
    let mut seen = |epoch: &Epoch, film: Option<&Film>| {
        bar.set_position(epoch.epoch);
        bar.set_message(format!("rms {:.4}", epoch.rms));
        if let Some(film) = film {
            let path = options.out.join(format!("epoch_{:06}.png", epoch.epoch));
            failed = failed.take().or(write_png(&path, film, tone_map).err());
        }
    };
    let stop = Stop::default();
    // Without a bound: an epoch may take long, and a second signal ends the process.
    stop.watch(None, || ());
    let trained = train(&scene.settings(), &wanted, &device, common.threads, &mut seen, &stop.requested);
    let report = trained.map_err(|error| located(&scene, error, RunError::refused))?;
    bar.finish_and_clear();
    if let Some(error) = failed {
        return Err(error.into());
    }
    write_csv(&options.out.join("epochs.csv"), &report.epochs)?;
    let own = (name_of(&options.out), report.epochs.iter().map(|epoch| (epoch.epoch as f64, epoch.rms)).collect());
    let curves: Vec<Curve> = beside.into_iter().chain([own]).collect();
    let path = options.out.join("epochs.svg");
    write_whole(&path, write_epochs(&scene.title, &curves)?.as_bytes()).with_context(|| format!("cannot write {}", path.display()))?;
    if common.json {
        print_json(&report)?;
    } else if let Some(text) = summary(&options.out, &report) {
        print_text(text);
    }
    match stop.status() {
        0 => Ok(()),
        status => bail!(Interrupted { status, done: "the epochs until then are written" }),
    }
}

/// The result for people: where it is, how good it is, and what was chosen for open settings. `None` if no epoch was trained.
fn summary(out: &Path, report: &TrainReport) -> Option<String> {
    let last = report.epochs.last()?;
    let psnr = last.psnr.map_or(String::new(), |psnr| format!(", {psnr:.1} dB"));
    let mut text = format!(
        "{}: epochs.csv, epochs.svg, epoch_*.png; after {} epochs ({} steps, {:.1} s, {:.1} MB) the log-stretch has an error of {:.4}{psnr}",
        out.display(),
        last.epoch,
        last.steps,
        last.seconds,
        report.bytes as f64 / 1e6,
        last.rms
    );
    report.decisions.iter().for_each(|decision| text += &format!("\n{decision}"));
    Some(text)
}

fn name_of(folder: &Path) -> String {
    folder.file_name().map_or_else(|| folder.display().to_string(), |name| name.to_string_lossy().into_owned())
}

/// The curve of an earlier training.
fn read_curve(folder: &Path) -> Result<Curve> {
    let path = folder.join("epochs.csv");
    let text = open(&path).and_then(std::io::read_to_string).with_context(|| format!("--beside: cannot read {}", path.display()))?;
    let mut lines = text.lines();
    let head = lines.next().unwrap_or_default();
    if head != HEAD {
        bail!("{}: found the head {head:?}; accepted: {HEAD:?}, as this program writes it", path.display());
    }
    let mut points = Vec::new();
    for (number, line) in lines.enumerate() {
        let cell = |i: usize| line.split(',').nth(i).and_then(|cell| cell.parse().ok());
        let (Some(epoch), Some(rms)) = (cell(0), cell(4)) else {
            bail!("{}, line {}: found {line:?}; accepted: {HEAD}", path.display(), number + 2);
        };
        points.push((epoch, rms));
    }
    Ok((name_of(folder), points))
}

fn write_csv(path: &Path, epochs: &[Epoch]) -> Result<()> {
    let mut text = format!("{HEAD}\n");
    let number = |value: Option<f64>| value.map_or(String::new(), |value| format!("{value:.6e}"));
    for Epoch { epoch, steps, seconds, loss, rms, psnr, rollbacks } in epochs {
        // Writing into a string does not fail.
        let _ = writeln!(text, "{epoch},{steps},{seconds:.3},{},{rms:.6e},{},{rollbacks}", number(*loss), number(*psnr));
    }
    write_whole(path, text.as_bytes()).with_context(|| format!("cannot write {}", path.display()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use ridgewatch::run::Decision;

    #[test]
    fn the_summary_ends_with_what_was_chosen() {
        let epoch = Epoch { epoch: 2, steps: 8, seconds: 0.5, loss: None, rms: 0.125, psnr: None, rollbacks: 0 };
        let decisions = vec![Decision::new("network.batch", 16_384, "few labels"), Decision::new("network.levels", 4, "few levels")];
        let report = |epochs| TrainReport {
            epochs,
            label_seconds: 0.1,
            bytes: 2_000_000,
            device: "cpu".into(),
            decisions: decisions.clone(),
            interrupted: false,
        };
        let text = summary(Path::new("out"), &report(vec![epoch])).unwrap();
        let lines: Vec<&str> = text.lines().collect();
        assert!(
            lines[0].starts_with("out: ")
                && lines[0].ends_with("after 2 epochs (8 steps, 0.5 s, 2.0 MB) the log-stretch has an error of 0.1250")
        );
        assert_eq!(lines[1..], ["network.batch = 16384: few labels", "network.levels = 4: few levels"]);
        assert_eq!(summary(Path::new("out"), &report(Vec::new())), None);
    }
}
