//! `ridgewatch map`: the FTLE of one moment as a map, and its ridge lines.

use super::common::{Common, Usage, check_folder, device, dimensions, located, print_json, print_text, refuse_live, scene, word};
use super::messages;
use anyhow::{Context, Result, anyhow, bail};
use ridgewatch::config::SceneFile;
use ridgewatch::files::write_whole;
use ridgewatch::flow::Direction;
use ridgewatch::map::{
    self, LARGEST, LinesFormat, MOST_NODES, MapError, MapOptions, MapRecord, Moment, PanelRecord, ProjectionKind, Rate, RidgeLine,
    RidgesAbout, Sampling, Strength,
};
use ridgewatch::run::{RunError, TimeSpan};
use serde::Serialize;
use std::path::{Path, PathBuf};

/// Options of `map`.
#[derive(Debug, clap::Args)]
pub struct Options {
    /// A scene file (.toml), or data files, globs and URLs of Zarr stores.
    #[arg(required = true, value_name = "CONFIG | FILES")]
    paths: Vec<PathBuf>,
    /// Picture: .png or .svg. A record of the same name that ends in .json is written beside it.
    #[arg(long, short, default_value = "out/map.png")]
    out: PathBuf,
    /// Slide of the window, from 0.
    #[arg(long, default_value_t = 0, value_name = "N")]
    slide: u64,
    /// Durations side by side: `--tau "10 days,20 days"`. Plain numbers are seconds for data with dates, else time units of the source. Default:
    /// the scene's.
    #[arg(long, value_delimiter = ',', value_parser = time_span)]
    tau: Vec<TimeSpan>,
    /// forward (repelling structures) or backward (attracting ones). Default: the scene's.
    #[arg(long, value_parser = direction, conflicts_with = "both")]
    direction: Option<Direction>,
    /// Forward FTLE in red and backward FTLE in blue, in one picture. Archives have to span twice tau.
    #[arg(long)]
    both: bool,
    /// Coordinate along the third axis, for flows in three dimensions (metres for pressure levels). Default: the middle one of the data's levels.
    #[arg(long, value_name = "Z", allow_negative_numbers = true)]
    level: Option<f64>,
    /// auto, plate_carree, mercator, lambert, polar, or plain (the coordinates themselves).
    #[arg(long, default_value = "auto", value_parser = projection)]
    projection: Projection,
    /// Pixels of the longer edge of a panel.
    #[arg(long, default_value_t = 800, value_name = "PIXELS", value_parser = clap::value_parser!(u64).range(16..=LARGEST as u64))]
    width: u64,
    /// Seeds per pixel, an even number: half of them for each of the two means whose difference is the stated error.
    #[arg(long, default_value_t = 16, value_name = "N", value_parser = seeds)]
    seeds: usize,
    /// Range of the colours, in the unit of the map. Default: from the values.
    #[arg(long, value_name = "LOW,HIGH", value_parser = range, allow_negative_numbers = true)]
    range: Option<[f64; 2]>,
    /// Draw lines at these values, in the unit of the map.
    #[arg(long, value_name = "LEVELS", value_delimiter = ',', value_parser = number, allow_negative_numbers = true)]
    contour: Vec<f64>,
    /// Draw arrows of the velocity at the seed time.
    #[arg(long)]
    arrows: bool,
    /// Draw the ridge lines of the FTLE.
    #[arg(long)]
    ridges: bool,
    /// Write the ridge lines: .geojson, .nc (CF geometries) or .vtk. Includes --ridges.
    #[arg(long, value_name = "FILE")]
    lines: Option<PathBuf>,
    /// Percentile of the FTLE that --ridge-length of a ridge line reaches. Default: 80.
    #[arg(long, value_name = "P", value_parser = percentile)]
    ridge_percentile: Option<f64>,
    /// Least length of a ridge line that reaches the percentile, in nodes of the ridge grid. Default: 30; a cell of the data at least, where its cells
    /// resolve the FTLE.
    #[arg(long, value_name = "NODES", value_parser = not_negative)]
    ridge_length: Option<f64>,
    /// Standard deviation of the smoothing before derivatives, in nodes of the ridge grid; 0 for none. Default: 2; 0.4 cells of the data at least, where
    /// its cells resolve the FTLE.
    #[arg(long, value_name = "NODES", value_parser = smoothing)]
    ridge_smoothing: Option<f64>,
    /// Grid on which ridges are found, NXxNY. Default: two nodes per pixel along x and y.
    #[arg(long, value_name = "NXxNY", value_parser = grid)]
    ridge_grid: Option<[usize; 2]>,
}

/// `None`: the one that fits.
#[derive(Debug, Clone, Copy)]
struct Projection(Option<ProjectionKind>);

fn projection(text: &str) -> Result<Projection, String> {
    if text == "auto" {
        return Ok(Projection(None));
    }
    word(text, "auto, plate_carree, mercator, lambert, polar, plain").map(|kind| Projection(Some(kind)))
}

pub(super) fn direction(text: &str) -> Result<Direction, String> {
    word(text, "forward, backward")
}

pub(super) fn time_span(text: &str) -> Result<TimeSpan, String> {
    let span = text.trim().parse().map_or_else(|_| TimeSpan::Words(text.trim().to_owned()), TimeSpan::Number);
    let value = span.value().filter(|value| value.is_finite() && *value > 0.0);
    value.map(|_| span).ok_or_else(|| "accepted: durations above 0, such as 7200 or \"30 days\"".into())
}

fn number(text: &str) -> Result<f64, String> {
    text.trim().parse().ok().filter(|n: &f64| n.is_finite()).ok_or_else(|| "accepted: a finite number".into())
}

pub(super) fn percentile(text: &str) -> Result<f64, String> {
    number(text).ok().filter(|n| (0.0..=100.0).contains(n)).ok_or_else(|| "accepted: a number from 0 to 100".into())
}

pub(super) fn not_negative(text: &str) -> Result<f64, String> {
    number(text).ok().filter(|n| *n >= 0.0).ok_or_else(|| "accepted: a number from 0 on".into())
}

pub(super) fn smoothing(text: &str) -> Result<f64, String> {
    number(text).ok().filter(|n| (0.0..=50.0).contains(n)).ok_or_else(|| "accepted: a number from 0 to 50".into())
}

fn range(text: &str) -> Result<[f64; 2], String> {
    let parsed = text.split_once(',').and_then(|(low, high)| Some([number(low).ok()?, number(high).ok()?]));
    parsed.filter(|[low, high]| low < high).ok_or_else(|| "accepted: LOW,HIGH with LOW below HIGH".into())
}

fn seeds(text: &str) -> Result<usize, String> {
    text.parse().ok().filter(|n| (2..=4096).contains(n) && n % 2 == 0).ok_or_else(|| "accepted: even numbers from 2 to 4096".into())
}

fn grid(text: &str) -> Result<[usize; 2], String> {
    match dimensions(text)
        .filter(|numbers| numbers.iter().all(|n| (8..=16_384).contains(n)) && numbers.iter().product::<usize>() <= MOST_NODES)
        .as_deref()
    {
        Some(&[x, y]) => Ok([x, y]),
        _ => Err("accepted: NXxNY with numbers from 8 to 16384, and 2^25 nodes in all".into()),
    }
}

#[derive(Serialize)]
struct Report<'a> {
    #[serde(flatten)]
    record: &'a MapRecord,
    picture: &'a Path,
    lines: Option<&'a Path>,
}

/// Makes the map.
pub fn run(common: &Common, options: &Options) -> Result<()> {
    let mut scene = scene(common, &options.paths)?;
    let extension = options.out.extension().and_then(|e| e.to_str()).unwrap_or("").to_ascii_lowercase();
    if !["png", "svg"].contains(&extension.as_str()) {
        bail!(Usage(format!("--out {}: accepted: a name that ends in .png or .svg", options.out.display())));
    }
    refuse_live(&scene, "map")?;
    let record_file = options.out.with_extension("json");
    let draws_ridges = options.ridges || options.lines.is_some();
    let about_ridges = [
        ("--ridge-percentile", options.ridge_percentile.is_some()),
        ("--ridge-length", options.ridge_length.is_some()),
        ("--ridge-smoothing", options.ridge_smoothing.is_some()),
        ("--ridge-grid", options.ridge_grid.is_some()),
    ];
    if let Some((name, _)) = about_ridges.into_iter().find(|(_, given)| *given && !draws_ridges) {
        bail!(Usage(format!("{name}: the map has no ridge lines; accepted with --ridges or --lines FILE")));
    }
    for out in [Some(&options.out), options.lines.as_ref()].into_iter().flatten() {
        check_folder(out)?;
    }
    scene.time.direction = options.direction.or(scene.time.direction);
    let device = device(common, &scene)?;
    let spinner = messages::spinner("reading the window".into());
    let moment = Moment::read(scene.settings(), &options.tau, options.both, options.slide).map_err(|error| explained(&scene, error))?;
    spinner.finish_and_clear();
    moment.notes.iter().for_each(messages::note);
    let lines_format = match &options.lines {
        Some(out) => {
            let format = LinesFormat::of(out, map::is_geographic(&moment.velocity));
            Some((out, format.map_err(|why| Usage(format!("--lines {}: {why}", out.display())))?))
        }
        None => None,
    };
    let strength = Strength::LINES.with(options.ridge_smoothing, options.ridge_length);
    let strength = Strength { percentile: options.ridge_percentile.unwrap_or(strength.percentile), ..strength };
    let wanted = MapOptions {
        pixels: options.width as usize,
        sampling: Sampling { seeds: options.seeds, seed: scene.seed },
        projection: options.projection.0,
        level: options.level,
        both: options.both,
        range: options.range,
        contours: options.contour.clone(),
        arrows: options.arrows,
        ridges: draws_ridges.then_some(strength),
        ridge_grid: options.ridge_grid,
    };
    let bar = messages::progress(Some(1));
    bar.set_message("seeds");
    let result = map::make(&moment, &wanted, &device, &mut |done, total| {
        bar.set_length(total);
        bar.set_position(done);
        true
    })
    .map_err(|error| explained(&scene, error))?;
    bar.finish_and_clear();
    result.notes.iter().chain(&result.doubts).for_each(messages::note);
    if wanted.level.is_none()
        && let Some(level) = result.record.level
    {
        let [low, high] = [moment.plan.domain.min[2], moment.plan.domain.max[2]];
        let [level, low, high] = [level, low, high].map(map::number);
        messages::note(format_args!("--level is not given: {level} is shown of {low} to {high}"));
    }
    let _drawing = messages::spinner("drawing".into());
    let picture = if extension == "svg" { map::write_svg(&result.figure)?.into_bytes() } else { map::write_png(&result.figure)? };
    let written = |out: &Path, bytes: &[u8]| write_whole(out, bytes).with_context(|| format!("cannot write {}", out.display()));
    written(&options.out, &picture)?;
    written(&record_file, &serde_json::to_vec_pretty(&result.record)?)?;
    if let Some((out, format)) = lines_format {
        write_lines(out, format, &result.lines, &result.about).with_context(|| format!("cannot write {}", out.display()))?;
    }
    drop(_drawing);
    if common.json {
        return print_json(&Report { record: &result.record, picture: &options.out, lines: options.lines.as_deref() });
    }
    let rate = Rate { unit: result.record.ftle_unit.clone(), factor: 1.0 };
    for panel in &result.record.panels {
        print_text(line(panel, &result.record, &rate));
    }
    let [w, h] = result.record.pixels;
    print_text(format_args!(
        "{}: {w} x {h} pixels, {}; record in {}",
        options.out.display(),
        result.figure.view.projection.words(),
        record_file.display()
    ));
    if let Some(out) = &options.lines {
        print_text(format_args!("{}: {} ridge lines", out.display(), result.lines.len()));
    }
    Ok(())
}

/// An error of a map with its place in the scene, and with the exit status of its kind.
pub(super) fn explained(scene: &SceneFile, error: MapError) -> anyhow::Error {
    match error {
        MapError::Usage(why) => Usage(why).into(),
        MapError::Run(error) => located(scene, error, RunError::refused),
        MapError::Both { tau, error } => located(scene, error, RunError::refused)
            .context(format!("--both needs data over twice tau (tau = {tau}); accepted: a shorter --tau")),
        error @ (MapError::Stopped | MapError::AllMissing(_) | MapError::Draw(_)) => anyhow!(error),
    }
}

/// Describes a panel in one line.
fn line(panel: &PanelRecord, record: &MapRecord, rate: &Rate) -> String {
    let tau = map::duration(panel.tau, &record.time_unit);
    let mut text = format!("{} FTLE, tau = {tau}, {} steps a path", panel.direction.name(), panel.steps);
    if let Some([low, mean, high]) = panel.ftle {
        text += &format!(": {} to {}, mean {}", map::number(low), map::number(high), rate.words(mean));
    }
    if let (Some(error), Some(share)) = (panel.error, panel.error_share) {
        text += &format!(
            "; error {} rms (95 %: {} to {}), {:.2} % of the colours",
            rate.words(error.rms),
            map::number(error.interval[0]),
            map::number(error.interval[1]),
            100.0 * share
        );
    }
    if panel.missing_share > 0.0 {
        text += &format!("; {:.1} % land or missing", 100.0 * panel.missing_share);
    }
    if panel.failed_seeds > 0 {
        text += &format!("; {} seeds overflowed", panel.failed_seeds);
    }
    if let Some(lines) = panel.ridge_lines {
        text += &format!("; {lines} ridge lines");
    }
    text
}

/// Writes ridge lines whole or not at all.
pub(super) fn write_lines(out: &Path, format: LinesFormat, lines: &[RidgeLine], about: &RidgesAbout) -> Result<()> {
    match format {
        LinesFormat::GeoJson => Ok(write_whole(out, map::geojson(lines, about).as_bytes())?),
        LinesFormat::Vtk => Ok(write_whole(out, map::vtk(lines, about).as_bytes())?),
        LinesFormat::NetCdf => {
            let folder = out.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
            // Mode by the umask; by default temporary files are private.
            let mode = std::os::unix::fs::PermissionsExt::from_mode(0o666);
            let temporary =
                tempfile::Builder::new().prefix(".ridgewatch-").suffix(".nc").permissions(mode).tempfile_in(folder)?.into_temp_path();
            map::write_netcdf(&temporary, lines, about)?;
            temporary.persist(out)?;
            Ok(())
        }
    }
}
