//! `ridgewatch ridges`: the ridges of the FTLE as geometry, lines in two dimensions and surfaces in three.

use super::common::{Common, Usage, check_folder, device, dimensions, print_json, print_text, refuse_live, scene};
use super::map::{direction, explained, not_negative, percentile, smoothing, time_span, write_lines};
use super::messages;
use anyhow::{Context, Result, bail};
use ridgewatch::files::write_with;
use ridgewatch::flow::Direction;
use ridgewatch::map::{self, FoundRidges, LinesFormat, MOST_NODES, Moment, RidgesOfMoment, RidgesRecord, Strength, SurfacesFormat};
use ridgewatch::run::TimeSpan;
use serde::Serialize;
use std::io::{BufWriter, Write as _};
use std::path::{Path, PathBuf};

/// Options of `ridges`.
#[derive(Debug, clap::Args)]
pub struct Options {
    /// A scene file (.toml), or data files, globs and URLs of Zarr stores.
    #[arg(required = true, value_name = "CONFIG | FILES")]
    paths: Vec<PathBuf>,
    /// File of the ridges. In three dimensions .vtp (VTK PolyData) or .ply; in two .geojson, .nc (CF geometries) or .vtk.
    #[arg(long, short, value_name = "FILE")]
    out: PathBuf,
    /// Nodes on which ridges are found, from edge to edge of the domain: NXxNYxNZ in three dimensions, NXxNY in two. Default: a million nodes, evenly
    /// spaced; in two dimensions that of `map`.
    #[arg(long, value_name = "NXxNYxNZ", value_parser = grid)]
    grid: Option<Grid>,
    /// Slide of the window, from 0.
    #[arg(long, default_value_t = 0, value_name = "N")]
    slide: u64,
    /// Duration, such as "10 days". A plain number is in seconds for data with dates, else in time units of the source. Default: the scene's.
    #[arg(long, value_parser = time_span)]
    tau: Option<TimeSpan>,
    /// forward (repelling structures) or backward (attracting ones). Default: the scene's.
    #[arg(long, value_parser = direction)]
    direction: Option<Direction>,
    /// Percentile of the FTLE that --area or --length of a ridge reaches; points below three quarters of it are cut off.
    #[arg(long, value_name = "P", default_value_t = Strength::SURFACES.percentile, value_parser = percentile)]
    percentile: f64,
    /// Percentile of the sharpness of these points below which they are cut off.
    #[arg(long, value_name = "P", default_value_t = Strength::SURFACES.sharpness, value_parser = percentile)]
    sharpness: f64,
    /// Least area of a surface that reaches the percentile, in squares of nodes. Default: 100.
    #[arg(long, value_name = "SQUARES", value_parser = not_negative)]
    area: Option<f64>,
    /// Least length of a line that reaches the percentile, in nodes. Default: 30; a cell of the data at least, where its cells resolve the FTLE.
    #[arg(long, value_name = "NODES", value_parser = not_negative)]
    length: Option<f64>,
    /// Standard deviation of the smoothing before derivatives, in nodes; 0 for none. Default: 1 for surfaces; for lines 2, and
    /// 0.4 cells of the data at least, where its cells resolve the FTLE.
    #[arg(long, value_name = "NODES", value_parser = smoothing)]
    smoothing: Option<f64>,
}

/// Nodes along each axis.
#[derive(Debug, Clone)]
struct Grid(Vec<usize>);

fn grid(text: &str) -> Result<Grid, String> {
    let fits = |numbers: &Vec<usize>| {
        (2..=3).contains(&numbers.len())
            && numbers.iter().all(|n| (8..=16_384).contains(n))
            && numbers.iter().product::<usize>() <= MOST_NODES
    };
    let accepted = "accepted: NXxNYxNZ, or NXxNY in two dimensions, with numbers from 8 to 16384, and 2^25 nodes in all";
    dimensions(text).filter(fits).map(Grid).ok_or_else(|| accepted.into())
}

#[derive(Serialize)]
struct Report<'a> {
    #[serde(flatten)]
    record: &'a RidgesRecord,
    file: &'a Path,
}

/// A format that fits the flow.
enum Format {
    Lines(LinesFormat),
    Surfaces(SurfacesFormat),
}

/// Finds and writes the ridges.
pub fn run(common: &Common, options: &Options) -> Result<()> {
    let mut scene = scene(common, &options.paths)?;
    refuse_live(&scene, "ridges")?;
    check_folder(&options.out)?;
    scene.time.direction = options.direction.or(scene.time.direction);
    let device = device(common, &scene)?;
    let spinner = messages::spinner("reading the window".into());
    let moment = Moment::read(scene.settings(), options.tau.as_slice(), false, options.slide).map_err(|error| explained(&scene, error))?;
    spinner.finish_and_clear();
    moment.notes.iter().for_each(messages::note);
    let is_flat = moment.plan.domain.dimensions == 2;
    let format = if is_flat {
        LinesFormat::of(&options.out, map::is_geographic(&moment.velocity)).map(Format::Lines)
    } else {
        SurfacesFormat::of(&options.out).map(Format::Surfaces)
    };
    let format = format.map_err(|why| Usage(format!("--out {}: {why}", options.out.display())))?;
    let (defaults, extent) = match (is_flat, options.area, options.length) {
        (true, Some(_), _) => bail!(Usage("--area: the flow has two dimensions and no ridge surfaces; accepted: --length".into())),
        (false, _, Some(_)) => bail!(Usage("--length: the flow has three dimensions and no ridge lines; accepted: --area".into())),
        (true, None, length) => (Strength::LINES, length),
        (false, area, None) => (Strength::SURFACES, area),
    };
    let strength = Strength { percentile: options.percentile, sharpness: options.sharpness, ..defaults.with(options.smoothing, extent) };
    let bar = messages::progress(Some(1));
    bar.set_message("nodes");
    let found = map::find(&moment, options.grid.as_ref().map(|grid| &grid.0[..]), &strength, &device, &mut |done, total| {
        bar.set_length(total);
        bar.set_position(done);
        if done == total {
            bar.set_message("traced");
        }
    })
    .map_err(|error| explained(&scene, error))?;
    bar.finish_and_clear();
    found.notes.iter().for_each(messages::note);
    write(&options.out, format, &found).with_context(|| format!("cannot write {}", options.out.display()))?;
    if common.json {
        return print_json(&Report { record: &found.record, file: &options.out });
    }
    print_text(line(&found.record));
    let RidgesRecord { ridges, points, triangles, .. } = &found.record;
    let what = match triangles {
        Some(triangles) => format!("{ridges} ridge surfaces, {points} vertices, {triangles} triangles"),
        None => format!("{ridges} ridge lines, {points} points"),
    };
    print_text(format_args!("{}: {what}", options.out.display()));
    Ok(())
}

fn write(out: &Path, format: Format, found: &FoundRidges) -> Result<()> {
    match (&found.ridges, format) {
        (RidgesOfMoment::Lines(lines), Format::Lines(format)) => write_lines(out, format, lines, &found.about.shared),
        (RidgesOfMoment::Surfaces(surfaces), Format::Surfaces(format)) => Ok(write_with(out, |file| {
            let mut file = BufWriter::with_capacity(1 << 20, file);
            surfaces.write(format, &found.about, &mut file)?;
            file.flush()
        })?),
        _ => bail!("the ridges have another dimension than their flow"),
    }
}

/// Describes the field in one line.
fn line(record: &RidgesRecord) -> String {
    let size = record.grid.iter().map(usize::to_string).collect::<Vec<_>>().join(" x ");
    let [traced, found] = record.seconds;
    format!(
        "{} FTLE, tau = {}, {} steps a path, {size} nodes: traced in {traced:.1} s, ridges in {found:.1} s",
        record.direction.name(),
        map::duration(record.tau, &record.time_unit),
        record.steps
    )
}
