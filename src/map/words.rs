//! Numbers, durations and units as a map says them.

/// Seconds of a day, an hour and a minute.
const DAY: f64 = 86_400.0;
const HOUR: f64 = 3600.0;
const MINUTE: f64 = 60.0;

/// Unit in which a map shows the FTLE.
#[derive(Debug, Clone, PartialEq)]
pub struct Rate {
    /// For example `1/day`; empty if times have no unit.
    pub unit: String,
    /// Factor from 1 / time unit of the source.
    pub factor: f64,
}

impl Rate {
    /// The unit that fits a duration: of seconds 1/day from two days on, 1/h from ten minutes on; other units of time stay.
    pub fn fitting(time_unit: &str, tau: f64) -> Self {
        let (unit, factor) = match time_unit {
            "" => (String::new(), 1.0),
            "s" if tau >= 2.0 * DAY => ("1/day".into(), DAY),
            "s" if tau >= 10.0 * MINUTE => ("1/h".into(), HOUR),
            other => (format!("1/{other}"), 1.0),
        };
        Self { unit, factor }
    }

    /// A value of this unit, with its unit.
    pub fn words(&self, value: f64) -> String {
        format!("{} {}", number(value), self.unit).trim_end().to_owned()
    }
}

/// A duration in readable units.
pub fn duration(tau: f64, time_unit: &str) -> String {
    match time_unit {
        "" => number(tau),
        "s" if tau >= 2.0 * DAY => format!("{} days", number(tau / DAY)),
        "s" if tau >= 2.0 * HOUR => format!("{} hours", number(tau / HOUR)),
        "s" if tau >= 2.0 * MINUTE => format!("{} minutes", number(tau / MINUTE)),
        other => format!("{} {other}", number(tau)),
    }
}

/// A number of three significant digits, without trailing zeros; powers of ten beyond 0.001 and 1e6.
pub fn number(value: f64) -> String {
    if value == 0.0 || !value.is_finite() {
        return if value == 0.0 { "0".into() } else { value.to_string() };
    }
    let exponent = value.abs().log10().floor() as i32;
    if !(-3..6).contains(&exponent) {
        return format!("{value:.2e}");
    }
    let text = format!("{:.*}", (2 - exponent).max(0) as usize, value);
    if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.').to_owned() } else { text }
}

/// A date of the source without what a title does not need: `2002-01-30T12:00:00Z` is `2002-01-30 12:00 UTC`.
pub fn date(text: &str) -> String {
    let Some((day, time)) = text.trim_end_matches('Z').split_once('T') else { return text.to_owned() };
    format!("{day} {} UTC", time.strip_suffix(":00").unwrap_or(time))
}

/// Steps of ticks: 1, 2 and 5 times powers of ten, at least `count` in a range.
pub fn even_step(range: f64, count: f64) -> f64 {
    let power = 10f64.powf((range / count).log10().floor());
    [5.0, 2.0, 1.0].into_iter().map(|n| n * power).find(|step| range / step >= count).unwrap_or(power)
}

/// Multiples of a step within a range.
pub fn ticks([low, high]: [f64; 2], step: f64) -> Vec<f64> {
    let slack = 1e-9 * (high - low);
    let (first, last) = (((low - slack) / step).ceil() as i64, ((high + slack) / step).floor() as i64);
    (first..=last.min(first + 100)).map(|n| n as f64 * step).collect()
}
