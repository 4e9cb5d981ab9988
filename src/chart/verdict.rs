//! What a chart says, in words.

use super::Chart;
use super::ftle::{CHARGED, Front, FtlePanel, FtlePoint};
use super::picture::{PictureCurve, PicturePanel, PicturePoint, RESOLVED, TARGETS};
use crate::render::Method;

/// Multiples of the tolerance for which the cheapest method is named, in words.
const TOLERANCES: [(f64, &str); 3] = [(3.0, "three times the tolerance"), (1.0, "the tolerance"), (0.3, "three tenths of the tolerance")];

/// Sentences about the front, the picks, and where each method wins.
pub fn verdict(chart: &Chart) -> Vec<String> {
    let mut said = Vec::new();
    if let Some(panel) = &chart.ftle {
        of_ftle(panel, chart, &mut said);
    }
    if let Some(panel) = &chart.pictures {
        of_pictures(panel, &mut said);
    }
    for point in chart.scaling.iter().flat_map(|panel| &panel.points) {
        let from = match point.table_pays_from {
            Some(samples) => format!("the table pays from {samples:.1e} samples on"),
            None => "the table never pays".into(),
        };
        let within = match (point.table_rms, chart.ftle.as_ref().map(|panel| panel.tolerance)) {
            (Some(rms), Some(tolerance)) if rms > tolerance => format!(", with rms {rms:.1e}, not within the tolerance"),
            (Some(rms), _) => format!(", with rms {rms:.1e}"),
            (None, _) => ", whatever its error".to_owned(),
        };
        let from = from + &within;
        let axis = point.axis.name();
        let differs = point.rms.map_or(String::new(), |rms| format!(" The FTLE differs by {rms:.1e} rms from that of all {axis}."));
        said.push(format!(
            "{axis} {}: {} steps, {:.2} ns a traced sample, {:.3} ns from a table that takes {}; {from}.{differs}",
            point.value,
            point.steps,
            point.trace_ns,
            point.table_ns,
            duration(point.table_seconds)
        ));
    }
    said
}

fn of_ftle(panel: &FtlePanel, chart: &Chart, said: &mut Vec<String>) {
    let time_unit = &chart.time_unit;
    let per = if time_unit.is_empty() { String::new() } else { format!(" /{time_unit}") };
    let tolerance = panel.tolerance;
    let methods: Vec<&FtlePoint> = panel.methods.iter().filter(|point| point.is_sound(panel.points)).collect();
    let best_of = |class: &[&str]| {
        let errors = methods.iter().filter(|point| class.iter().any(|prefix| point.method.starts_with(prefix))).map(|point| point.rms);
        errors.fold(f64::INFINITY, f64::min)
    };
    for Front { samples, pick, .. } in &panel.fronts {
        let samples = *samples;
        let Some(best) = pick.map(|best| &panel.methods[best]) else {
            said.push(format!("No method is within {tolerance:.2e}{per}."));
            break;
        };
        said.push(format!(
            "{samples:.0e} FTLE samples within {tolerance:.2e}{per}: {} takes {}, building included (rms {:.1e}, {}).",
            name(best),
            duration(best.seconds(samples)),
            best.rms,
            size(best.bytes)
        ));
    }
    for (factor, words) in TOLERANCES {
        let within = cheapest(methods.iter().copied().filter(|point| point.rms <= factor * tolerance));
        said.extend(within.map(|cheapest| format!("Cheapest within {words} ({:.1e}{per}): {cheapest}.", factor * tolerance)));
    }
    for Front { samples, methods, .. } in panel.fronts.iter().filter(|front| front.samples == CHARGED[1]) {
        let on = |place: &usize| {
            let point = &panel.methods[*place];
            format!("{} {} at {:.1e}", name(point), duration(point.seconds(*samples)), point.rms)
        };
        let points: Vec<String> = methods.iter().map(on).collect();
        said.push(format!("Pareto front of {samples:.0e} samples, rms{per}: {}.", points.join("; ")));
    }
    // From how many samples on the cheapest setting of each class within the tolerance beats the fastest tracing within it.
    const TRACING: [&str; 3] = ["tangent", "differences", "Dormand-Prince"];
    let within = |class: &[&str]| {
        let of_class = |point: &&&FtlePoint| class.iter().any(|prefix| point.method.starts_with(prefix)) && point.rms <= tolerance;
        methods.iter().filter(of_class).copied().collect::<Vec<_>>()
    };
    let fastest = within(&TRACING).into_iter().max_by(|a, b| a.samples_per_second.total_cmp(&b.samples_per_second));
    for class in ["composition", "table", "base + residual", "network"] {
        let points = within(&[class]);
        if points.is_empty() {
            let best = best_of(&[class]);
            said.push(if best.is_finite() {
                format!("{class}: not within the tolerance; its best rms is {best:.1e}{per}.")
            } else {
                let why = chart.not_measured.iter().filter(|line| line.starts_with(class)).find_map(|line| line.split_once(": "));
                format!("{class}: not measured{}.", why.map_or(String::new(), |(_, why)| format!(", {why}")))
            });
            continue;
        }
        let Some(tracing) = fastest else {
            said.push(format!("{class}: within the tolerance, as no tracing that was measured is."));
            continue;
        };
        let pays = |point: &FtlePoint| {
            let saved = 1.0 / tracing.samples_per_second - 1.0 / point.samples_per_second;
            if saved > 0.0 { point.build_seconds / saved } else { f64::INFINITY }
        };
        let first = points.into_iter().map(|point| (pays(point), point)).min_by(|a, b| a.0.total_cmp(&b.0));
        said.push(match first {
            Some((from, point)) if from.is_finite() => format!(
                "{class} ({}): cheaper than tracing from {from:.1e} samples on, at {:.1} times its speed.",
                point.setting,
                point.samples_per_second / tracing.samples_per_second
            ),
            _ => format!("{class}: within the tolerance, and never cheaper than tracing."),
        });
    }
}

/// Which method is the cheapest, building included, from how many samples on. `None` without any.
fn cheapest<'a>(within: impl Iterator<Item = &'a FtlePoint>) -> Option<String> {
    let within: Vec<&FtlePoint> = within.collect();
    let mut best = within.iter().copied().min_by(|a, b| a.seconds(1.0).total_cmp(&b.seconds(1.0)))?;
    let mut said = name(best);
    let mut from = 1.0;
    loop {
        // Where the cost of another one, which is built for longer and faster, falls below.
        let crossing = |point: &'a FtlePoint| {
            let saved = 1.0 / best.samples_per_second - 1.0 / point.samples_per_second;
            let at = (point.build_seconds - best.build_seconds) / saved;
            (saved > 0.0 && at > from).then_some((at, point))
        };
        let next = within.iter().filter_map(|point| crossing(point)).min_by(|a, b| a.0.total_cmp(&b.0));
        let Some((at, point)) = next else { return Some(said) };
        said += &format!(", from {at:.1e} samples on {}", name(point));
        (best, from) = (point, at);
    }
}

fn of_pictures(panel: &PicturePanel, said: &mut Vec<String>) {
    said.extend(panel.map.as_ref().map(|curve| of_map(curve, panel.map_truth_psnr)));
    if panel.curves.is_empty() {
        said.push(if panel.map.is_some() { "Pictures of the volume view: not measured.".into() } else { "Pictures: not measured.".into() });
        return;
    }
    for target in TARGETS {
        let resolved = panel.truth_psnr + RESOLVED;
        if target > resolved {
            said.push(format!("{target} dB over lit pixels: the truth tells up to {resolved:.1} dB; more --seconds give it more samples."));
            continue;
        }
        let reached = |curve: &PictureCurve| curve.reaches(target).map(|frame| (*frame, curve.name()));
        let mut times: Vec<(PicturePoint, String)> = panel.curves.iter().filter_map(reached).collect();
        times.sort_by(|a, b| a.0.seconds.total_cmp(&b.0.seconds));
        said.push(match times.as_slice() {
            [] => format!("{target} dB over lit pixels: reached by no method in the time given."),
            [(frame, first), rest @ ..] => {
                let others: Vec<String> = rest.iter().map(|(frame, name)| format!("{name} {}", duration(frame.seconds))).collect();
                let others = if others.is_empty() { "no other method reached it".into() } else { others.join(", ") };
                let ssim = frame.ssim.map_or(String::new(), |ssim| format!(", SSIM {ssim:.3}"));
                let also = format!("relMSE {:.1e}{ssim}", frame.relmse);
                format!("{target} dB over lit pixels: {first} after {}, {also} ({others}).", duration(frame.seconds))
            }
        });
    }
    said.push(of_auto(panel));
    let rates: Vec<String> = panel.curves.iter().filter_map(rate).collect();
    if !rates.is_empty() {
        said.push(format!("Frames of a window that slides at every frame: {}.", rates.join(", ")));
    }
}

/// Frames a second of a window that slides at every frame; `None` if they were not measured.
fn rate(curve: &PictureCurve) -> Option<String> {
    let found = curve.sliding?;
    let psnr = found.psnr.map_or(String::new(), |psnr| format!(" at {psnr:.1} dB"));
    Some(format!("{} {:.2}/s{psnr}", curve.name(), found.frames_per_second))
}

/// When the map reaches each target that its truth tells.
fn of_map(curve: &PictureCurve, truth_psnr: Option<f64>) -> String {
    let resolved = truth_psnr.map_or(f64::INFINITY, |psnr| psnr + RESOLVED);
    let reached = TARGETS.iter().map(|&target| match curve.seconds_to(target) {
        _ if target > resolved => format!("{target} dB not told by its truth, which tells up to {resolved:.1} dB"),
        Some(seconds) => format!("{target} dB after {}", duration(seconds)),
        None => format!("{target} dB not in the time given"),
    });
    let reached = reached.collect::<Vec<_>>().join(", ");
    let sliding = rate(curve).map_or(String::new(), |rate| format!("; of a window that slides at every frame, {rate}"));
    format!("The map, of which the FTLE of each pixel is compared: {reached}{sliding}.")
}

/// How far `auto` is from the best curve, which begins with `two_level` and the scene's surrogate, and goes on with the method that wins its race.
fn of_auto(panel: &PicturePanel) -> String {
    let name = |method| PictureCurve::new(method, panel.kind).name();
    let first = name(Method::TwoLevel);
    let curve = panel.curve(Method::TwoLevel);
    let compared = TARGETS.iter().filter_map(|&target| {
        let best = panel.curves.iter().filter_map(|curve| curve.seconds_to(target)).min_by(f64::total_cmp)?;
        Some(match curve.and_then(|curve| curve.seconds_to(target)) {
            Some(seconds) if seconds <= best => format!("first at {target} dB"),
            Some(seconds) => format!("{:.0} % after the first at {target} dB", 100.0 * (seconds / best - 1.0)),
            None => format!("does not reach {target} dB, which others do"),
        })
    });
    let compared: Vec<String> = compared.collect();
    let compared = if compared.is_empty() { "no target was reached".to_owned() } else { compared.join(", ") };
    let goes_on = match &panel.race {
        Some(race) if race.method != Method::TwoLevel => format!(" Its race between {first} and others goes to {}.", name(race.method)),
        Some(_) => " It stays with it in its race.".to_owned(),
        None => String::new(),
    };
    if panel.auto_is_map {
        let why = "since its flow has two dimensions and it sets nothing of a volume. Of these curves, which are of volumes";
        return format!("render.method = \"auto\" draws this scene as a map, {why}, {first}: {compared}.");
    }
    format!("render.method = \"auto\" begins with {first}: {compared}.{goes_on}")
}

fn name(point: &FtlePoint) -> String {
    format!("{} ({})", point.method, point.setting)
}

/// Bytes in a unit that reads well.
pub(super) fn size(bytes: u64) -> String {
    match bytes {
        0 => "no memory".into(),
        1..1_000_000 => format!("{:.0} kB", bytes as f64 / 1e3),
        _ => format!("{:.1} MB", bytes as f64 / 1e6),
    }
}

/// Seconds in a unit that reads well.
fn duration(seconds: f64) -> String {
    match seconds {
        s if s < 1e-3 => format!("{:.0} us", 1e6 * s),
        s if s < 1.0 => format!("{:.0} ms", 1e3 * s),
        s if s < 600.0 => format!("{s:.2} s"),
        s if s < 36_000.0 => format!("{:.0} min", s / 60.0),
        s => format!("{:.0} h", s / 3600.0),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_cheapest_method_changes_where_costs_cross() {
        let point = |method: &str, build_seconds, samples_per_second| FtlePoint {
            method: method.into(),
            setting: "set".into(),
            rms: 0.1,
            p99: 0.1,
            psnr: None,
            samples_per_second,
            build_seconds,
            bytes: 0,
            failed: 0,
        };
        // Costs cross at 200 (1 s against 200 / 100 - 200 / 200), and at 20,000 (100 s against 20,000 / 200 - 20,000 / 1e9).
        let points = [point("tracing", 0.0, 100.0), point("table", 1.0, 200.0), point("dear", 500.0, 150.0), point("network", 101.0, 1e9)];
        let said = "tracing (set), from 2.0e2 samples on table (set), from 2.0e4 samples on network (set)";
        assert_eq!(cheapest(points.iter()).as_deref(), Some(said));
        assert_eq!(cheapest(std::iter::empty()), None);
    }
}
