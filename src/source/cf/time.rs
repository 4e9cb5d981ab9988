//! Time units: `hours since 1900-01-01 00:00:0.0 +01:00`, or a plain duration.

use super::calendar::Calendar;
use super::units::Unit;

/// Accepted time units, for messages.
pub const TIME_UNITS: &str =
    "`seconds|minutes|hours|days|weeks since YEAR-MONTH-DAY [HOUR:MINUTE:SECOND] [ZONE]`, a plain unit of time, or none";

/// Conversion of numbers to seconds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TimeUnit {
    /// Seconds per unit.
    factor: f64,
    /// Seconds from 1970-01-01 in `calendar` to the reference; 0 without a reference.
    pub offset: f64,
    /// `None` if the unit has no reference (simulation time).
    pub calendar: Option<Calendar>,
}

impl TimeUnit {
    /// Parses `units` in `calendar`; `None` if they are not understood.
    pub fn parse(units: &str, calendar: Calendar) -> Option<Self> {
        let Some((unit, reference)) = split_since(units) else {
            let unit = Unit::parse(units)?;
            return (unit.is_time() || unit.is_dimensionless()).then_some(Self { factor: unit.factor, offset: 0.0, calendar: None });
        };
        let factor = match unit.trim().to_ascii_lowercase().as_str() {
            "week" | "weeks" => 604_800.0,
            "ms" | "msec" | "millisecond" | "milliseconds" => 1e-3,
            "us" | "microsecond" | "microseconds" => 1e-6,
            "ns" | "nanosecond" | "nanoseconds" => 1e-9,
            other => Unit::parse(other).filter(Unit::is_time)?.factor,
        };
        Some(Self { factor, offset: reference_seconds(reference, calendar)?, calendar: Some(calendar) })
    }

    /// True if a unit counts from a date.
    pub fn has_reference(units: &str) -> bool {
        split_since(units).is_some()
    }

    pub fn seconds(&self, value: f64) -> f64 {
        self.offset + value * self.factor
    }
}

fn split_since(units: &str) -> Option<(&str, &str)> {
    let lower = units.to_ascii_lowercase();
    let at = lower.find(" since ")?;
    Some((&units[..at], &units[at + 7..]))
}

/// Seconds from 1970-01-01 to `YEAR[-MONTH[-DAY]][T| ]HOUR[:MINUTE[:SECOND]][ ZONE]`.
fn reference_seconds(text: &str, calendar: Calendar) -> Option<f64> {
    let text = text.trim();
    let (sign, text) = text.strip_prefix('-').map_or((1, text), |rest| (-1, rest));
    let date_end = text.find(|c: char| !(c.is_ascii_digit() || c == '-')).unwrap_or(text.len());
    let mut parts = text[..date_end].split('-');
    let mut part = |missing: Option<i64>| parts.next().map_or(missing, |p| p.parse().ok());
    let (year, month, day) = (part(None)?, part(Some(1))?, part(Some(1))?);
    if parts.next().is_some() {
        return None;
    }
    let seconds = calendar.days(sign * year, month, day)? as f64 * 86_400.0;
    let rest = text[date_end..].trim_start_matches(['T', 't', ' ']).trim_end();
    let clock_end = rest.find(|c: char| !(c.is_ascii_digit() || c == ':' || c == '.')).unwrap_or(rest.len());
    Some(seconds + clock(&rest[..clock_end])? - zone(rest[clock_end..].trim())?)
}

fn clock(text: &str) -> Option<f64> {
    let mut seconds = 0.0;
    if text.is_empty() {
        return Some(seconds);
    }
    let parts: Vec<&str> = text.split(':').collect();
    for ((part, unit), limit) in parts.iter().zip([3600.0, 60.0, 1.0]).zip([24.0, 59.0, 60.999_999]) {
        let value: f64 = part.parse().ok()?;
        if !(0.0..=limit).contains(&value) {
            return None;
        }
        seconds += value * unit;
    }
    (parts.len() <= 3).then_some(seconds)
}

/// Seconds that a time zone is ahead of UTC.
fn zone(text: &str) -> Option<f64> {
    let rest = ["UTC", "GMT", "utc", "gmt", "Z", "z"].iter().find_map(|name| text.strip_prefix(name)).unwrap_or(text).trim();
    if rest.is_empty() {
        return Some(0.0);
    }
    let (sign, digits) = rest.strip_prefix('+').map(|d| (1.0, d)).or_else(|| rest.strip_prefix('-').map(|d| (-1.0, d)))?;
    let (hours, minutes) = match digits.split_once(':') {
        Some(pair) => pair,
        None if digits.len() >= 3 && digits.is_ascii() => digits.split_at(digits.len() - 2),
        None => (digits, "0"),
    };
    let number = |text: &str, limit: f64| text.parse::<u32>().ok().map(f64::from).filter(|v| *v <= limit);
    Some(sign * (number(hours, 15.0)? * 3600.0 + number(minutes, 59.0)? * 60.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn date(units: &str, calendar: Calendar, value: f64) -> String {
        let unit = TimeUnit::parse(units, calendar).unwrap_or_else(|| panic!("{units}"));
        calendar.iso(unit.seconds(value)).unwrap()
    }

    #[test]
    fn known_times() {
        use Calendar::*;
        // The first GlobCurrent file of 2002.
        assert_eq!(date("days since 1900-1-1", Standard, 37_255.0), "2002-01-01T00:00:00Z");
        assert_eq!(date("hours since 2025-5-1 00:00:00", Proleptic, 2.5), "2025-05-01T02:30:00Z");
        assert_eq!(date("minutes since 2005-08-28 00:00:00", Standard, 720.0), "2005-08-28T12:00:00Z");
        assert_eq!(date("seconds since 1970-01-01T00:00:00Z", Standard, 1e9), "2001-09-09T01:46:40Z");
        assert_eq!(date("hours since 1-1-1 00:00:0.0", Standard, 17_522_904.0), "2000-01-01T00:00:00Z");
        assert_eq!(date("days since 2000-01-01 12:30", NoLeap, 59.0), "2000-03-01T12:30:00Z");
        assert_eq!(date("days since 2000-01-01", AllLeap, 59.0), "2000-02-29T00:00:00Z");
        assert_eq!(date("days since 2000-02-30", Days360, 1.0), "2000-03-01T00:00:00Z");
        assert_eq!(date("days since 1900-02-28", Julian, 1.0), "1900-02-29T00:00:00Z");
        assert_eq!(date("seconds since 2000-01-01 00:00:00 +02:00", Standard, 0.0), "1999-12-31T22:00:00Z");
        assert_eq!(date("seconds since 2000-01-01 00:00:00 -0530", Standard, 0.0), "2000-01-01T05:30:00Z");
        assert_eq!(date("weeks since 2000-01-01 00:00 UTC", Standard, 1.0), "2000-01-08T00:00:00Z");
    }

    #[test]
    fn simulation_time_has_no_calendar() {
        let unit = TimeUnit::parse("hours", Calendar::Standard).unwrap();
        assert_eq!((unit.seconds(2.0), unit.calendar), (7200.0, None));
        assert_eq!(TimeUnit::parse("1", Calendar::Standard).unwrap().seconds(3.0), 3.0);
    }

    #[test]
    fn nonsense_is_refused() {
        for units in [
            "months since 2000-01-01",
            "days since yesterday",
            "days since 2000-13-01",
            "days since 2001-02-29",
            "days since 2000-01-01 25:00",
            "days since 2000-01-01 00:00 +99:00",
            "days since ",
            "days since 2000-01-01 00:00 \u{e9}\u{e9}\u{e9}",
            "m/s",
            "day as %Y%m%d.%f",
        ] {
            assert_eq!(TimeUnit::parse(units, Calendar::Standard), None, "{units}");
        }
    }
}
