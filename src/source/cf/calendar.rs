//! Calendars of the CF conventions (section 4.4.1): days since 1970-01-01, counted in each calendar.

/// The calendars of the CF conventions.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Calendar {
    /// Julian until 1582-10-04, Gregorian from the next day, 1582-10-15.
    Standard,
    /// Gregorian at all times.
    Proleptic,
    /// A leap year every four years.
    Julian,
    /// 365 days.
    NoLeap,
    /// 366 days.
    AllLeap,
    /// Twelve months of 30 days.
    Days360,
}

/// Names of the calendars, for messages.
pub const CALENDARS: &str = "standard (gregorian), proleptic_gregorian, julian, noleap (365_day), all_leap (366_day), 360_day";

/// Days between 1970-01-01 of the Gregorian and of the Julian calendar.
const JULIAN_LAG: i64 = 13;
/// 1582-10-15 in days since 1970-01-01.
const REFORM: i64 = -141_427;

impl Calendar {
    pub fn parse(name: &str) -> Option<Self> {
        Some(match name.trim().to_ascii_lowercase().as_str() {
            "" | "standard" | "gregorian" => Self::Standard,
            "proleptic_gregorian" => Self::Proleptic,
            "julian" => Self::Julian,
            "noleap" | "no_leap" | "365_day" => Self::NoLeap,
            "all_leap" | "366_day" => Self::AllLeap,
            "360_day" => Self::Days360,
            _ => return None,
        })
    }

    pub fn name(self) -> &'static str {
        match self {
            Self::Standard => "standard",
            Self::Proleptic => "proleptic_gregorian",
            Self::Julian => "julian",
            Self::NoLeap => "noleap",
            Self::AllLeap => "all_leap",
            Self::Days360 => "360_day",
        }
    }

    /// Days from 1970-01-01 to this date; `None` if the calendar lacks it. Years have at most six digits.
    pub fn days(self, year: i64, month: i64, day: i64) -> Option<i64> {
        if year.abs() > 999_999 || !(1..=12).contains(&month) || !(1..=31).contains(&day) {
            return None;
        }
        let days = match self {
            Self::Standard => {
                let gregorian = gregorian_days(year, month, day);
                if gregorian >= REFORM { gregorian } else { julian_days(year, month, day) + JULIAN_LAG }
            }
            Self::Proleptic => gregorian_days(year, month, day),
            Self::Julian => julian_days(year, month, day),
            Self::NoLeap => fixed_days(year, month, day, 28),
            Self::AllLeap => fixed_days(year, month, day, 29),
            Self::Days360 => (year - 1970) * 360 + (month - 1) * 30 + day - 1,
        };
        (self.date(days) == (year, month, day)).then_some(days)
    }

    /// Year, month and day at `days` after 1970-01-01.
    pub fn date(self, days: i64) -> (i64, i64, i64) {
        match self {
            Self::Standard if days >= REFORM => gregorian_date(days),
            Self::Standard => julian_date(days - JULIAN_LAG),
            Self::Proleptic => gregorian_date(days),
            Self::Julian => julian_date(days),
            Self::NoLeap => fixed_date(days, 28),
            Self::AllLeap => fixed_date(days, 29),
            Self::Days360 => (1970 + days.div_euclid(360), days.rem_euclid(360) / 30 + 1, days.rem_euclid(30) + 1),
        }
    }

    /// `2002-01-01T00:00:00Z` for seconds since 1970-01-01, to the nearest second; `None` beyond six-digit years.
    pub fn iso(self, seconds: f64) -> Option<String> {
        if seconds.is_nan() || seconds.abs() > 3e13 {
            return None;
        }
        let whole = seconds.round() as i64;
        let (year, month, day) = self.date(whole.div_euclid(86_400));
        let second = whole.rem_euclid(86_400);
        Some(format!("{year:04}-{month:02}-{day:02}T{:02}:{:02}:{:02}Z", second / 3600, second / 60 % 60, second % 60))
    }
}

/// `2002-01-01T00:00:00Z` for a moment of this machine's clock.
pub fn utc(moment: std::time::SystemTime) -> String {
    let seconds = moment.duration_since(std::time::UNIX_EPOCH).map_or(0.0, |since| since.as_secs_f64());
    Calendar::Proleptic.iso(seconds).unwrap_or_default()
}

/// Day of a year that begins in March, so that the leap day is its last.
fn day_from_march(month: i64, day: i64) -> i64 {
    (153 * ((month + 9) % 12) + 2) / 5 + day - 1
}

/// Month and day of a day of a year that begins in March; the year is one later for January and February.
fn month_from_march(day_of_year: i64) -> (i64, i64) {
    let shifted = (5 * day_of_year + 2) / 153;
    let day = day_of_year - (153 * shifted + 2) / 5 + 1;
    (if shifted < 10 { shifted + 3 } else { shifted - 9 }, day)
}

fn gregorian_days(year: i64, month: i64, day: i64) -> i64 {
    let year = year - i64::from(month <= 2);
    let (era, of_era) = (year.div_euclid(400), year.rem_euclid(400));
    era * 146_097 + of_era * 365 + of_era / 4 - of_era / 100 + day_from_march(month, day) - 719_468
}

fn gregorian_date(days: i64) -> (i64, i64, i64) {
    let shifted = days + 719_468;
    let (era, of_era) = (shifted.div_euclid(146_097), shifted.rem_euclid(146_097));
    let year = (of_era - of_era / 1460 + of_era / 36_524 - of_era / 146_096) / 365;
    let (month, day) = month_from_march(of_era - (365 * year + year / 4 - year / 100));
    (era * 400 + year + i64::from(month <= 2), month, day)
}

/// Days from March 1 of year 0 to January 1, 1970, in the Julian calendar.
const JULIAN_EPOCH: i64 = 1969 * 365 + 1969 / 4 + 306;

fn julian_days(year: i64, month: i64, day: i64) -> i64 {
    let year = year - i64::from(month <= 2);
    year.div_euclid(4) * 1461 + year.rem_euclid(4) * 365 + day_from_march(month, day) - JULIAN_EPOCH
}

fn julian_date(days: i64) -> (i64, i64, i64) {
    let shifted = days + JULIAN_EPOCH;
    let (era, of_era) = (shifted.div_euclid(1461), shifted.rem_euclid(1461));
    let year = (of_era - of_era / 1460) / 365;
    let (month, day) = month_from_march(of_era - 365 * year);
    (era * 4 + year + i64::from(month <= 2), month, day)
}

fn month_lengths(february: i64) -> [i64; 12] {
    [31, february, 31, 30, 31, 30, 31, 31, 30, 31, 30, 31]
}

/// Days of a calendar whose years all have the same months.
fn fixed_days(year: i64, month: i64, day: i64, february: i64) -> i64 {
    let lengths = month_lengths(february);
    (year - 1970) * (337 + february) + lengths[..(month - 1) as usize].iter().sum::<i64>() + day - 1
}

fn fixed_date(days: i64, february: i64) -> (i64, i64, i64) {
    let year = 1970 + days.div_euclid(337 + february);
    let mut rest = days.rem_euclid(337 + february);
    let mut month = 1;
    for length in month_lengths(february) {
        if rest < length {
            break;
        }
        rest -= length;
        month += 1;
    }
    (year, month, rest + 1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use Calendar::*;

    #[test]
    fn known_dates() {
        // Julian day numbers of the Astronomical Almanac less 2440588 (1970-01-01).
        assert_eq!(Proleptic.days(1970, 1, 1), Some(0));
        assert_eq!(Proleptic.days(2000, 1, 1), Some(10_957));
        assert_eq!(Proleptic.days(1900, 1, 1), Some(-25_567));
        assert_eq!(Standard.days(1582, 10, 15), Some(2_299_161 - 2_440_588));
        assert_eq!(Standard.days(1582, 10, 4), Some(2_299_160 - 2_440_588));
        assert_eq!(Standard.days(1582, 10, 10), None, "the reform dropped it");
        assert_eq!(Standard.days(1, 1, 1), Some(1_721_424 - 2_440_588));
        assert_eq!(Proleptic.days(1, 1, 1), Some(1_721_426 - 2_440_588));
        assert_eq!(Julian.days(1970, 1, 1), Some(0));
        assert_eq!(Julian.days(1900, 2, 29), Some(-25_509));
        assert_eq!(NoLeap.days(2000, 3, 1), Some(30 * 365 + 59));
        assert_eq!(NoLeap.days(2000, 2, 29), None);
        assert_eq!(AllLeap.days(1971, 2, 29), Some(366 + 59));
        assert_eq!(Days360.days(2000, 2, 30), Some(30 * 360 + 59));
        assert_eq!(Days360.days(2000, 1, 31), None);
    }

    #[test]
    fn days_and_dates_are_inverse_and_without_gaps() {
        for calendar in [Standard, Proleptic, Julian, NoLeap, AllLeap, Days360] {
            let mut before = (i64::MIN, 0, 0);
            // Year 0 to 2190, which holds every kind of leap year and the reform.
            for days in -719_600..80_400 {
                let date = calendar.date(days);
                assert!(date > before, "{calendar:?}: {date:?} after {before:?}");
                assert_eq!(calendar.days(date.0, date.1, date.2), Some(days), "{calendar:?} {date:?}");
                before = date;
            }
        }
    }

    #[test]
    fn iso_rounds_into_the_next_day() {
        assert_eq!(Standard.iso(86_399.6).as_deref(), Some("1970-01-02T00:00:00Z"));
        assert_eq!(Days360.iso(-86_400.0).as_deref(), Some("1969-12-30T00:00:00Z"));
        assert_eq!(Standard.iso(f64::NAN), None);
    }
}
