//! Dates of messages as seconds since 1970, in the Gregorian calendar.
//!
//! Source: H. Hinnant, "chrono-Compatible Low-Level Date Algorithms" (`days_from_civil`, `civil_from_days`).

const DAY: i64 = 86_400;

/// Seconds since 1970 of year, month, day, hour, minute and second; `None` if they are no date.
pub fn seconds([year, month, day, hour, minute, second]: [i64; 6]) -> Option<i64> {
    if !(1..=12).contains(&month) || !(0..24).contains(&hour) || !(0..60).contains(&minute) || !(0..60).contains(&second) {
        return None;
    }
    let date = days(year, month, day) * DAY;
    // A day that its month does not have is one of the next month.
    (civil(date.div_euclid(DAY)) == [year, month, day]).then_some(date + hour * 3600 + minute * 60 + second)
}

/// The date and time in words: `2020-01-31T06:00:00Z`.
pub fn iso(seconds: i64) -> String {
    let [year, month, day] = civil(seconds.div_euclid(DAY));
    let rest = seconds.rem_euclid(DAY);
    format!("{year:04}-{month:02}-{day:02}T{:02}:{:02}:{:02}Z", rest / 3600, rest / 60 % 60, rest % 60)
}

/// Days since 1970. Years begin in March, so that a leap day is the last of its year.
fn days(year: i64, month: i64, day: i64) -> i64 {
    let year = if month <= 2 { year - 1 } else { year };
    let era = year.div_euclid(400);
    let of_era = year.rem_euclid(400);
    let of_year = (153 * ((month + 9) % 12) + 2) / 5 + day - 1;
    era * 146_097 + of_era * 365 + of_era / 4 - of_era / 100 + of_year - 719_468
}

fn civil(days: i64) -> [i64; 3] {
    let days = days + 719_468;
    let (era, of_era) = (days.div_euclid(146_097), days.rem_euclid(146_097));
    let year = (of_era - of_era / 1460 + of_era / 36_524 - of_era / 146_096) / 365;
    let of_year = of_era - (365 * year + year / 4 - year / 100);
    let shifted = (5 * of_year + 2) / 153;
    let month = if shifted < 10 { shifted + 3 } else { shifted - 9 };
    [era * 400 + year + i64::from(month <= 2), month, of_year - (153 * shifted + 2) / 5 + 1]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dates_are_seconds_and_back() {
        for (date, expected, text) in [
            ([1970, 1, 1, 0, 0, 0], 0, "1970-01-01T00:00:00Z"),
            ([2000, 2, 29, 12, 30, 15], 951_827_415, "2000-02-29T12:30:15Z"),
            ([1900, 3, 1, 0, 0, 0], -2_203_891_200, "1900-03-01T00:00:00Z"),
            ([2023, 12, 31, 23, 59, 59], 1_704_067_199, "2023-12-31T23:59:59Z"),
        ] {
            assert_eq!(seconds(date), Some(expected));
            assert_eq!(iso(expected), text);
        }
        for none in [[1900, 2, 29, 0, 0, 0], [2023, 4, 31, 0, 0, 0], [2023, 0, 1, 0, 0, 0], [2023, 1, 0, 0, 0, 0], [2023, 1, 1, 24, 0, 0]] {
            assert_eq!(seconds(none), None, "{none:?}");
        }
    }
}
