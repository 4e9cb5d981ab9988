//! `ridgewatch chart`: speed against accuracy of a scene, and the pick; or an earlier chart, drawn anew.

use super::common::{
    CHART, Common, Interrupted, RaceFile, Usage, beside_scene, device, located, open, print_json, print_text, scene, seconds,
};
use super::messages;
use super::signals::Stop;
use anyhow::{Context, Result, bail};
use ridgewatch::chart::{Chart, ChartOptions, chart, csv, verdict, write_png, write_svg};
use ridgewatch::files::write_whole;
use ridgewatch::run::RunError;
use ridgewatch::source::SourceKind;
use serde::Serialize;
use std::path::PathBuf;
use std::time::Duration;

/// Time from a signal to the end of the process.
const STOP_WITHIN: Duration = Duration::from_secs(60);

/// Options of `chart`.
#[derive(Debug, clap::Args)]
pub struct Options {
    /// A scene file (.toml), or data files, globs and URLs of Zarr stores; or a chart.json, which is drawn anew without
    /// measuring, so that of the other options only --out and --json count.
    #[arg(required = true, value_name = "CONFIG | FILES | CHART.json")]
    paths: Vec<PathBuf>,
    /// Seconds for all measurements. What did not fit is named.
    #[arg(long, default_value_t = 300.0, value_parser = seconds, value_name = "S")]
    seconds: f64,
    /// Panels: ftle (error and cost of FTLE samples), pictures (PSNR, relMSE and SSIM over time), scaling (cost against tau, nodes, threads).
    #[arg(long, value_enum, value_delimiter = ',', default_values_t = [Panel::Ftle, Panel::Pictures, Panel::Scaling], value_name = "PANELS")]
    only: Vec<Panel>,
    /// Folder for chart.png, chart.svg, chart.csv and chart.json. Files of these names are replaced. Beside a scene file, SCENE.chart.svg is written for
    /// the dashboard.
    #[arg(long, short, default_value = "out/chart")]
    out: PathBuf,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum Panel {
    Ftle,
    Pictures,
    Scaling,
}

#[derive(Serialize)]
struct Report<'a> {
    #[serde(flatten)]
    chart: &'a Chart,
    verdict: &'a [String],
}

/// Charts.
pub fn run(common: &Common, options: &Options) -> Result<()> {
    if let [path] = options.paths.as_slice()
        && path.extension().is_some_and(|extension| extension == "json")
    {
        let text = std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
        let chart: Chart =
            serde_json::from_str(&text).with_context(|| format!("{} is no chart.json of `ridgewatch chart`", path.display()))?;
        std::fs::create_dir_all(&options.out).with_context(|| format!("cannot make the folder {}", options.out.display()))?;
        return write(common, options, &chart, &verdict(&chart)).map(drop);
    }
    let scene = scene(common, &options.paths)?;
    if scene.source.kind == SourceKind::Live {
        bail!(Usage(
            "a running simulation cannot be charted, since no moment of it comes twice; accepted: archives and closed forms".into()
        ));
    }
    let device = device(common, &scene)?;
    std::fs::create_dir_all(&options.out).with_context(|| format!("cannot make the folder {}", options.out.display()))?;
    let bar = messages::spinner_within("opening the source".into(), options.seconds);
    let tell = |what: &str| {
        tracing::info!("measuring {what}");
        bar.set_message(format!("measuring {what}"));
    };
    let has = |panel| options.only.contains(&panel);
    let wanted =
        ChartOptions { seconds: options.seconds, ftle: has(Panel::Ftle), pictures: has(Panel::Pictures), scaling: has(Panel::Scaling) };
    let stop = Stop::default();
    stop.watch(Some(STOP_WITHIN), || ());
    let chart = chart(&scene.settings(), &wanted, &device, common.threads, &tell, &stop.requested)
        .map_err(|error| located(&scene, error, RunError::refused))?;
    bar.finish_and_clear();
    let said = verdict(&chart);
    let svg = write(common, options, &chart, &said)?;
    if let Some(path) = beside_scene(&options.paths, CHART).filter(|_| stop.status() == 0) {
        match write_whole(&path, &svg) {
            Ok(()) => messages::note(format_args!("the dashboard of this scene shows {}", path.display())),
            Err(error) => messages::note(format_args!("the dashboard will not show this chart: {}: {error}", path.display())),
        }
    }
    let race = chart.pictures.as_ref().and_then(|pictures| pictures.race.clone()).filter(|_| stop.status() == 0);
    if let (Some(file), Some(race)) = (RaceFile::of(common, &scene, &options.paths, &device)?, race) {
        file.write(&open(&scene)?.plan, race)?;
    }
    match stop.status() {
        0 => Ok(()),
        status => bail!(Interrupted { status, done: "the chart has what was measured until then" }),
    }
}

/// Writes the files of a chart and prints what it says. Returns the SVG.
fn write(common: &Common, options: &Options, chart: &Chart, said: &[String]) -> Result<Vec<u8>> {
    let report = Report { chart, verdict: said };
    let svg = write_svg(chart)?.into_bytes();
    let files = [
        ("chart.csv", csv(chart).into_bytes()),
        ("chart.svg", svg.clone()),
        ("chart.png", write_png(chart)?),
        ("chart.json", serde_json::to_vec_pretty(&report)?),
    ];
    for (name, bytes) in files {
        let path = options.out.join(name);
        write_whole(&path, &bytes).with_context(|| format!("cannot write {}", path.display()))?;
    }
    if common.json {
        print_json(&report)?;
    } else {
        said.iter().for_each(print_text);
        for line in &chart.not_measured {
            messages::note(format_args!("not measured: {line}"));
        }
        print_text(format_args!("{}: chart.png, chart.svg, chart.csv, chart.json, after {:.0} s", options.out.display(), chart.seconds));
    }
    Ok(svg)
}
