//! From a moment to the figure of its map, its record and its ridge lines.

use super::arrows::{Arrows, arrows};
use super::colour::{LAND, OUTSIDE, Ramp, overprinted, range};
use super::contour::contours;
use super::draw::{MapFigure, Panel};
use super::footprint::{MapTracer, Raster, RasterError, Sampling, in_parts};
use super::graticule::{axis_unit, nodes_over};
use super::lines::{RidgeLine, RidgesAbout};
use super::record::{MapRecord, PanelRecord, RidgeRecord};
use super::ridges::{Field, Strength};
use super::sheet::Bar;
use super::smoothing::{self, too_coarse};
use super::view::{View, is_geographic};
use super::words::{Rate, date, duration, number};
use super::{MapError, Moment};
use crate::backend::Device;
use crate::field::EARTH_RADIUS;
use crate::flow::{Direction, FlowMap, VelocitySource};
use crate::render::ProjectionKind;
use crate::run::{Plan, RunError, uniform_ftle};
use std::path::Path;

/// Most nodes of the grid on which ridges are found: some GiB of memory.
pub const MOST_NODES: usize = 1 << 25;

/// What a map shows.
#[derive(Debug, Clone, PartialEq)]
pub struct MapOptions {
    /// Pixels of the longer edge of a panel.
    pub pixels: usize,
    /// Seeds per pixel.
    pub sampling: Sampling,
    /// Projection; `None`: the one that fits.
    pub projection: Option<ProjectionKind>,
    /// Third coordinate of all seeds; `None`: that of the middle level of the data, or of the domain of a closed form. Two-dimensional flows take none.
    pub level: Option<f64>,
    /// Forward and backward FTLE in one picture.
    pub both: bool,
    /// Range of colours in the unit of the map; `None`: from the values.
    pub range: Option<[f64; 2]>,
    /// Levels that get a line, in the unit of the map.
    pub contours: Vec<f64>,
    /// Arrows of the velocity.
    pub arrows: bool,
    /// Ridge lines; `None`: none.
    pub ridges: Option<Strength>,
    /// Nodes of the grid on which ridges are found; `None`: two per pixel along x and y.
    pub ridge_grid: Option<[usize; 2]>,
}

/// What a map came to.
pub struct MapResult {
    /// The picture, to be drawn.
    pub figure: MapFigure,
    /// The record beside it.
    pub record: MapRecord,
    /// Ridge lines of all panels.
    pub lines: Vec<RidgeLine>,
    /// What files of lines say.
    pub about: RidgesAbout,
    /// Remarks for the user.
    pub notes: Vec<String>,
    /// Remarks on what the colours do not show, and on values that cover less than they seem to. The frames of a run have their own.
    pub doubts: Vec<String>,
}

/// One traced field.
struct Traced {
    direction: Direction,
    tau: f64,
    raster: Raster,
    steps: usize,
    difference: Option<f64>,
    ridges: Vec<RidgeLine>,
    /// Roughness of their field, and what counted as one.
    found_by: Option<(f64, Strength)>,
}

/// Makes the map of a moment. Calls `progress` with the seeds traced and those in all; once it returns false, the map is abandoned.
///
/// # Errors
/// An option does not fit the domain, or the device fails.
pub fn make(
    moment: &Moment,
    options: &MapOptions,
    device: &Device,
    progress: &mut dyn FnMut(u64, u64) -> bool,
) -> Result<MapResult, MapError> {
    let plan = &moment.plan;
    let domain = &plan.domain;
    let level = level(options.level, domain, &moment.velocity)?;
    let geographic = is_geographic(&moment.velocity);
    let view = View::new(domain, geographic, options.projection, level, options.pixels).map_err(|why| {
        MapError::Usage(match options.projection {
            Some(kind) => format!("--projection {}: {why}", crate::setting::word(kind)),
            None => why,
        })
    })?;
    let rate = Rate::fitting(&plan.time_unit, moment.taus.iter().copied().fold(0.0, f64::max));
    let directions = if options.both { vec![Direction::Forward, Direction::Backward] } else { vec![plan.map.direction] };
    let nodes = options.ridges.map(|_| options.ridge_grid.unwrap_or_else(|| ridge_nodes(&view)));
    let (mut notes, mut doubts) = (Vec::new(), Vec::<String>::new());
    let each = (view.size[0] * view.size[1] * options.sampling.seeds + nodes.map_or(0, |[x, y]| x * y)) as u64;
    let panels = moment.taus.len() * directions.len();
    let (mut done, total) = (0, each * panels as u64);
    let mut traced = Vec::new();
    for &tau in &moment.taus {
        for &direction in &directions {
            let map = FlowMap { direction, ..moment.map(tau) };
            let mut tracer = MapTracer::new(device, &moment.velocity, &map, moment.time).map_err(RunError::of)?;
            let mut count = |seeds: u64| {
                done += seeds;
                progress(done, total)
            };
            let traced_raster =
                Raster::trace(&view, &mut tracer, options.sampling, &mut |pixels| count((pixels * options.sampling.seeds) as u64))
                    .map_err(RunError::of)?;
            let Some(raster) = traced_raster else { return Err(MapError::Stopped) };
            let (mut ridges, mut found_by) = (Vec::new(), None);
            if let (Some(strength), Some(size)) = (&options.ridges, nodes) {
                let field = ridge_field(&view, &mut tracer, size, &mut |seeds| count(seeds as u64))?;
                let kind = structures(direction);
                let found = smoothing::roughness(&field.values, &size);
                let panel = if panels > 1 { format!("{} FTLE, tau = {tau}: ", direction.name()) } else { String::new() };
                notes.extend(too_coarse(found, "grid (`map --ridge-grid`)").map(|text| panel + &text));
                let strength = strength.over(&field, nodes_in_cell(&moment.velocity, size));
                found_by = Some((found, strength));
                ridges = field.ridges(&strength).into_iter().map(|points| RidgeLine { kind, tau, points }).collect();
            }
            let flow = tracer.flow();
            let difference = flow.step_choice().map(|chosen| chosen.difference).filter(|d| d.is_finite());
            let steps = flow.steps();
            doubts.extend(tracer.short_lived());
            notes.extend(tracer.note.take());
            traced.push(Traced { direction, tau, raster, steps, difference, ridges, found_by });
        }
    }
    if traced.iter().all(|t| t.raster.mean.iter().all(|v| v.is_nan())) {
        return Err(MapError::AllMissing(when(moment)));
    }
    let values: Vec<&[f32]> = traced.iter().map(|t| &t.raster.mean[..]).collect();
    let shown = options.range.unwrap_or_else(|| range(&values, options.both).map(|v| v * rate.factor));
    let scale = shown.map(|v| v / rate.factor);
    doubts.extend(colourless(&traced, options, &rate, shown));
    doubts.dedup();
    let found = options.arrows.then(|| arrows(&view, &moment.velocity, moment.time, 26.0));
    let figure = figure(moment, options, &view, &traced, &rate, shown, scale, found.as_ref());
    let record = MapRecord {
        version: env!("CARGO_PKG_VERSION"),
        title: plan.scene.title.clone(),
        source: plan.source.clone(),
        time: moment.time,
        date: moment.date.clone(),
        time_unit: plan.time_unit.clone(),
        level: (domain.dimensions == 3).then_some(level),
        projection: view.projection.kind(),
        region: view.region,
        pixels: view.size,
        sampling: options.sampling,
        ftle_unit: rate.unit.clone(),
        range: shown,
        fastest: found.map(|arrows| arrows.fastest),
        ridges: options.ridges.zip(nodes).map(|(Strength { percentile, .. }, grid)| RidgeRecord { grid, percentile }),
        panels: traced.iter().map(|t| panel_record(t, options, &rate, shown)).collect(),
    };
    let about = about(moment, rate, level);
    let lines = traced.into_iter().flat_map(|t| t.ridges).collect();
    Ok(MapResult { figure, record, lines, about, notes, doubts })
}

/// What files say of the ridges of a moment; `rate` is the unit of their FTLE.
pub(super) fn about(moment: &Moment, rate: Rate, level: f64) -> RidgesAbout {
    RidgesAbout {
        title: moment.plan.scene.title.clone(),
        source: moment.plan.source.clone(),
        when: when(moment),
        time_unit: moment.plan.time_unit.clone(),
        rate,
        is_geographic: is_geographic(&moment.velocity),
        axes: moment.velocity.axes(),
        mapping: moment.plan.georeference.mapping.clone(),
        level: (moment.plan.domain.dimensions == 3).then_some(level),
    }
}

/// What the colours and lines of traced fields do not show. `shown`: the range of the colours, in the unit of the map.
fn colourless(traced: &[Traced], options: &MapOptions, rate: &Rate, shown: [f64; 2]) -> Vec<String> {
    let values = || traced.iter().flat_map(|t| &t.raster.mean).filter(|v| v.is_finite()).map(|v| f64::from(*v) * rate.factor);
    let (least, most) = values().fold((f64::INFINITY, f64::NEG_INFINITY), |(least, most), v| (least.min(v), most.max(v)));
    let there = format!("the FTLE of the map is {} to {}", number(least), rate.words(most));
    let mut said: Vec<String> = (options.contours.iter())
        .filter(|level| **level <= least || **level >= most)
        .map(|level| format!("--contour {level}: no line, since {there}"))
        .collect();
    let [low, high] = shown;
    match options.range {
        Some(_) if least >= high || most <= low => said.push(format!("--range {low},{high}: one colour, since {there}")),
        None if !options.both => {
            let error = traced.iter().filter_map(|t| t.difference).reduce(f64::max);
            let tau = traced.iter().map(|t| t.tau).fold(0.0, f64::max);
            said.extend(uniform_ftle([least, most].map(|end| end / rate.factor), tau, error, "--range and --contour"));
        }
        _ => {}
    }
    said
}

/// Third coordinate of the seeds.
fn level(given: Option<f64>, domain: &crate::field::Domain, velocity: &VelocitySource) -> Result<f64, MapError> {
    let (low, high) = (domain.min[2], domain.max[2]);
    match given {
        None => Ok(middle_level(velocity).unwrap_or((low + high) / 2.0)),
        Some(level) if domain.dimensions == 2 => {
            Err(MapError::Usage(format!("--level {level}: the flow has two dimensions; accepted: a map without --level")))
        }
        Some(level) if (low..=high).contains(&level) => Ok(level),
        Some(level) => Err(MapError::Usage(format!("--level {level}: accepted: {low} to {high}, the third axis of the domain"))),
    }
}

/// Third coordinate of the level of gridded data that has as many levels below as above it, or between two of them.
fn middle_level(velocity: &VelocitySource) -> Option<f64> {
    let VelocitySource::Window(window) = velocity else { return None };
    let levels = window.grid()?.axes.get(2)?.coordinates();
    let (below, above) = (levels.get((levels.len() - 1) / 2)?, levels.get(levels.len() / 2)?);
    Some((below + above) / 2.0)
}

/// Two nodes a pixel, along x and y: filaments of the FTLE are as narrow as pixels. Fewer if that passes a quarter of [`MOST_NODES`].
pub(super) fn ridge_nodes(view: &View) -> [usize; 2] {
    let [west, south, east, north] = view.region;
    let shrink = if view.is_geographic { ((south + north) / 2.0).to_radians().cos().max(0.1) } else { 1.0 };
    let ratio = (east - west) * shrink / (north - south);
    let nodes = (4 * view.size[0] * view.size[1]).min(MOST_NODES / 4);
    let across = (nodes as f64 * ratio).sqrt();
    [across, across / ratio].map(|n| (n.round() as usize + 1).max(8))
}

/// The FTLE at nodes from edge to edge of the data. Calls `done` with the number of nodes after each part; [`MapError::Stopped`] once that returns false.
pub(super) fn ridge_field(
    view: &View,
    tracer: &mut MapTracer<'_>,
    size: [usize; 2],
    done: &mut dyn FnMut(usize) -> bool,
) -> Result<Field, MapError> {
    let [west, south, east, north] = view.region;
    let step = [(east - west) / (size[0] - 1) as f64, (north - south) / (size[1] - 1) as f64];
    let at = |i: usize, j: usize| [west + step[0] * i as f64, south + step[1] * j as f64];
    let mut values = Vec::with_capacity(size[0] * size[1]);
    let is_whole = in_parts(size[1], size[0], |rows| {
        let seeds: Vec<_> = rows.flat_map(|j| (0..size[0]).map(move |i| (i, j))).map(|(i, j)| view.seed(at(i, j))).collect();
        values.extend(tracer.ftle(&seeds, &mut |_| ()).map_err(RunError::of)?);
        Ok::<_, RunError>(done(seeds.len()))
    })?;
    if !is_whole {
        return Err(MapError::Stopped);
    }
    let kilometres = (EARTH_RADIUS / 1000.0).to_radians();
    let scale = (0..size[1])
        .map(|j| if view.is_geographic { [kilometres * at(0, j)[1].to_radians().cos().max(0.0), kilometres] } else { [1.0; 2] })
        .collect();
    Ok(Field { origin: [west, south], step, size, values, scale })
}

/// Nodes of a grid from edge to edge of the domain in a cell of the data, along x and y; `None` for closed forms.
pub(super) fn nodes_in_cell(velocity: &VelocitySource, size: [usize; 2]) -> Option<[f64; 2]> {
    let VelocitySource::Window(window) = velocity else { return None };
    let axes = &window.grid()?.axes;
    let nodes = |k: usize| Some((size[k] - 1) as f64 / axes.get(k)?.cells() as f64);
    Some([nodes(0)?, nodes(1)?])
}

/// Title of the scene, else its files.
fn name(plan: &Plan) -> String {
    let files = &plan.scene.archive.files;
    if !plan.scene.title.is_empty() {
        return plan.scene.title.clone();
    }
    let Some(first) = files.first() else { return String::new() };
    // A pattern without a name of its own is called by its folder.
    let stem = |path: &Path| {
        path.file_stem().map_or_else(String::new, |stem| stem.to_string_lossy().trim_matches(['*', '_', '-', '.']).to_owned())
    };
    let name = Some(stem(first)).filter(|name| !name.is_empty()).unwrap_or_else(|| first.parent().map_or_else(String::new, stem));
    if files.len() > 1 { format!("{name} and further files") } else { name }
}

/// Seed time in words.
pub(super) fn when(moment: &Moment) -> String {
    let unit = &moment.plan.time_unit;
    moment.date.as_deref().map_or_else(|| format!("t = {} {unit}", number(moment.time)).trim_end().to_owned(), date)
}

fn panel_record(traced: &Traced, options: &MapOptions, rate: &Rate, shown: [f64; 2]) -> PanelRecord {
    let raster = &traced.raster;
    let known = || raster.mean.iter().filter(|v| v.is_finite()).map(|v| f64::from(*v) * rate.factor);
    let count = known().count();
    let error = raster.error.map(|e| RasterError { rms: e.rms * rate.factor, interval: e.interval.map(|v| v * rate.factor), ..e });
    let within = raster.missing.iter().filter(|m| m.is_finite()).count();
    PanelRecord {
        direction: traced.direction,
        tau: traced.tau,
        steps: traced.steps,
        integration_difference: traced.difference,
        error,
        error_share: error.map(|e| e.rms / (shown[1] - shown[0])),
        ftle: (count > 0).then(|| {
            [known().fold(f64::INFINITY, f64::min), known().sum::<f64>() / count as f64, known().fold(f64::NEG_INFINITY, f64::max)]
        }),
        missing_share: (0..raster.missing.len()).filter(|p| raster.is_land(*p)).count() as f64 / within.max(1) as f64,
        failed_seeds: raster.failed,
        ridge_lines: options.ridges.map(|_| traced.ridges.len()),
        ridge_roughness: traced.found_by.map(|(roughness, _)| roughness),
        ridge_smoothing: traced.found_by.map(|(_, strength)| strength.smoothing),
        ridge_length: traced.found_by.map(|(_, strength)| strength.extent),
        colours: ramp(options.both, traced.direction).name(),
    }
}

fn ramp(both: bool, direction: Direction) -> Ramp {
    match (both, direction) {
        (false, _) => Ramp::Viridis,
        (true, Direction::Forward) => Ramp::Reds,
        (true, Direction::Backward) => Ramp::Blues,
    }
}

/// Names of structures by the direction that shows them.
pub(super) fn structures(direction: Direction) -> &'static str {
    match direction {
        Direction::Forward => "repelling",
        Direction::Backward => "attracting",
    }
}

#[allow(clippy::too_many_arguments)] // the parts of one picture
fn figure(
    moment: &Moment,
    options: &MapOptions,
    view: &View,
    traced: &[Traced],
    rate: &Rate,
    shown: [f64; 2],
    scale: [f64; 2],
    found: Option<&Arrows>,
) -> MapFigure {
    let plan = &moment.plan;
    let per_panel = if options.both { 2 } else { 1 };
    let panels: Vec<Panel> = traced.chunks(per_panel).map(|fields| panel(fields, options, view, rate, scale, found)).collect();
    let bars = traced[..per_panel]
        .iter()
        .map(|t| {
            let unit = if rate.unit.is_empty() { String::new() } else { format!(", {}", rate.unit) };
            let values = || traced.iter().filter(|o| o.direction == t.direction).flat_map(|o| &o.raster.mean).filter(|v| v.is_finite());
            Bar {
                label: format!("{} FTLE ({} structures){unit}", t.direction.name(), structures(t.direction)),
                colours: (0..256).map(|part| ramp(options.both, t.direction).colour((f64::from(part) + 0.5) / 256.0)).collect(),
                range: shown,
                goes_on: [values().any(|v| f64::from(*v) < scale[0]), values().any(|v| f64::from(*v) > scale[1])],
            }
        })
        .collect();
    let tau = if moment.taus.len() == 1 { format!(", tau = {}", duration(moment.taus[0], &plan.time_unit)) } else { String::new() };
    let names = moment.velocity.axes();
    let level = if plan.domain.dimensions == 3 {
        let [.., [name, unit]] = &names;
        let (unit, divisor) = axis_unit(unit, view.level.abs());
        let value = number(view.level / divisor);
        format!(", level {value} {unit} ({name})").replace("  ", " ")
    } else {
        String::new()
    };
    let what = if options.both {
        "Forward and backward FTLE".to_owned()
    } else {
        format!("{} FTLE", if plan.map.direction == Direction::Forward { "Forward" } else { "Backward" })
    };
    let errors: Vec<f64> = traced.iter().filter_map(|t| t.raster.error).map(|e| e.rms * rate.factor).collect();
    let largest = errors.iter().copied().fold(0.0, f64::max);
    let mut footer = vec![format!("Source: {}", plan.source)];
    let error = if errors.is_empty() {
        String::new()
    } else {
        format!(", error {} rms ({} % of the colours)", rate.words(largest), number(100.0 * largest / (shown[1] - shown[0])))
    };
    let colours: Vec<&str> = traced[..per_panel].iter().map(|t| ramp(options.both, t.direction).name()).collect();
    footer.push(format!("Pixels: mean of {} seeds{error}. Colours: {}.", options.sampling.seeds, colours.join(", ")));
    let speed = found.map(|arrows| {
        // Velocities on the sphere are metres, others are in the unit of the axes.
        let length = if view.is_geographic { "m" } else { names[0][1].as_str() };
        let unit = if length.is_empty() || plan.time_unit.is_empty() { String::new() } else { format!(" {length}/{}", plan.time_unit) };
        format!("Longest arrow: {}{unit}.", number(arrows.fastest))
    });
    let contours = (!options.contours.is_empty())
        .then(|| format!("Lines: {}.", options.contours.iter().map(|c| rate.words(*c)).collect::<Vec<_>>().join(", ")));
    let ridges = options.ridges.map(|_| format!("Ridge lines: {}.", traced.iter().map(|t| t.ridges.len()).sum::<usize>()));
    let missing = traced.iter().any(|t| t.raster.missing.iter().any(|m| *m >= 0.5)).then(|| "Grey: land or missing.".to_owned());
    let projection = Some(format!("Projection: {}.", view.projection.words()));
    footer.push([projection, missing, ridges, contours, speed].into_iter().flatten().collect::<Vec<_>>().join(" "));
    // Axes that are no degrees may be those of a known projection.
    let degrees = if view.is_geographic { None } else { plan.georeference.degrees(&nodes_over(view)) };
    MapFigure {
        degrees,
        title: format!("{what}: {}", name(plan)).trim_end_matches([':', ' ']).to_owned(),
        subtitle: format!("{}{tau}{level}", when(moment)),
        footer,
        axes: if view.is_geographic {
            None
        } else {
            let [x, y, _] = names.map(|[name, unit]| (name, unit));
            Some([x, y])
        },
        view: view.clone(),
        panels,
        bars,
        caption_unit: plan.time_unit.clone(),
    }
}

fn panel(fields: &[Traced], options: &MapOptions, view: &View, rate: &Rate, scale: [f64; 2], found: Option<&Arrows>) -> Panel {
    let raster = &fields[0].raster;
    let share = |v: f32| (f64::from(v) - scale[0]) / (scale[1] - scale[0]);
    let colour = |pixel: usize| {
        if raster.missing[pixel].is_nan() {
            return OUTSIDE;
        }
        if raster.is_land(pixel) || fields.iter().any(|f| f.raster.mean[pixel].is_nan()) {
            return LAND;
        }
        let one = |f: &Traced| ramp(options.both, f.direction).colour(share(f.raster.mean[pixel]));
        fields[1..].iter().fold(one(&fields[0]), |under, field| overprinted(under, one(field)))
    };
    // Values are those of the centres of pixels.
    let centred = |lines: Vec<Vec<[f64; 2]>>| lines.into_iter().map(|line| line.into_iter().map(|p| p.map(|c| c + 0.5)).collect());
    let levels = || options.contours.iter().map(|level| (level / rate.factor) as f32);
    let ridge_colour = |f: &Traced| match (options.both, f.direction) {
        (false, _) => [0, 0, 0],
        (true, Direction::Forward) => [120, 0, 0],
        (true, Direction::Backward) => [0, 20, 110],
    };
    Panel {
        tau: fields[0].tau,
        pixels: (0..raster.mean.len()).map(colour).collect(),
        coast: centred(contours(&raster.missing, raster.size, 0.5)).collect(),
        contours: fields
            .iter()
            .flat_map(|f| levels().map(|level| contours(&f.raster.mean, f.raster.size, level)).collect::<Vec<_>>())
            .flat_map(centred)
            .collect(),
        ridges: fields
            .iter()
            .flat_map(|f| {
                f.ridges.iter().map(|line| (ridge_colour(f), line.points.iter().map(|p| view.pixel(p.place)).collect())).collect::<Vec<_>>()
            })
            .collect(),
        arrows: found.map_or_else(Vec::new, |found| found.arrows.clone()),
    }
}
