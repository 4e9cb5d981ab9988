//! Times of a file.

use super::dimensions::Extent;
use super::planner::Planner;
use crate::cf::calendar::{CALENDARS, Calendar};
use crate::cf::coordinate::{Kind, classify};
use crate::cf::time::{TIME_UNITS, TimeUnit};
use crate::error::SourceError;
use crate::formats::NumberType;

/// Times of one file.
#[derive(Debug, Clone, PartialEq)]
pub struct TimePlan {
    pub variable: String,
    pub units: String,
    /// Seconds, strictly ascending.
    pub seconds: Vec<f64>,
    /// Frame (see [`super::layout::Layout::frames`]) and entry along its time dimension of each time.
    pub places: Vec<(usize, usize)>,
    pub calendar: Option<Calendar>,
}

impl Planner<'_> {
    /// Error about the times.
    pub fn time_fault(&self, what: impl AsRef<str>) -> SourceError {
        self.fault(format!("time: {}", what.as_ref()))
    }

    /// Finds the time variable and reads it.
    pub fn time(&self, extents: &[Extent]) -> Result<TimePlan, SourceError> {
        let listing = self.listing();
        let dimension = extents.iter().find(|e| e.kind == Kind::Time);
        let expected = dimension.map_or(1, |e| listing.dimensions[e.dimension].len);
        let variable = match (&self.settings.time, dimension) {
            (Some(name), _) if listing.find(name).is_some() => listing.find(name),
            (_, Some(extent)) => extent.coordinate.or_else(|| {
                // Rows of characters along the time dimension.
                let row = |dims: &[usize]| matches!(*dims, [rows, _] if rows == extent.dimension);
                listing.matching(|v| v.number == NumberType::Text && row(&v.dimensions) && classify(v) == Kind::Time).next()
            }),
            (_, None) => listing.matching(|v| listing.shape(v).iter().product::<usize>() == 1 && classify(v) == Kind::Time).next(),
        };
        let Some(index) = variable else {
            let times: Vec<&str> = listing.variables.iter().filter(|v| classify(v) == Kind::Time).map(|v| v.name.as_str()).collect();
            let found =
                if times.is_empty() { "no time variable".into() } else { format!("no numeric time variable, only {}", times.join(", ")) };
            return Err(self.time_fault(format!("{found}; name one with `time = \"...\"`, in {TIME_UNITS}")));
        };
        let variable = self.variable(index);
        if variable.number == NumberType::Text {
            return self.characters(index, expected);
        }
        let name = variable.name.clone();
        // WRF before version 3.8 puts the reference into the description only.
        let description = variable.text("description").filter(|d| TimeUnit::has_reference(d));
        let units = variable.units().filter(|u| TimeUnit::has_reference(u)).or(description).or(variable.units()).unwrap_or_default();
        let calendar_name = variable.text("calendar").unwrap_or_default();
        let Some(calendar) = Calendar::parse(calendar_name) else {
            return Err(self.time_fault(format!("calendar `{calendar_name}` of `{name}` is unknown; accepted are {CALENDARS}")));
        };
        let Some(unit) = TimeUnit::parse(units, calendar) else {
            let calendar = calendar.name();
            let what = format!("unit `{units}` of `{name}` (calendar {calendar}) is not understood; accepted are {TIME_UNITS}");
            return Err(self.time_fault(what));
        };
        let seconds: Vec<f64> = self.coordinate_values(index)?.into_iter().map(|v| unit.seconds(v)).collect();
        let show = |i: usize| unit.calendar.and_then(|c| c.iso(seconds[i])).unwrap_or_else(|| seconds[i].to_string());
        self.check_times(&name, &seconds, expected, show)?;
        let places = (0..seconds.len()).map(|entry| (0, entry)).collect();
        Ok(TimePlan { variable: name, units: units.to_owned(), seconds, places, calendar: unit.calendar })
    }

    /// Times as dates in rows of characters: `2005-08-28_12:00:00`.
    pub fn characters(&self, index: usize, expected: usize) -> Result<TimePlan, SourceError> {
        let name = self.variable(index).name.clone();
        let rows = self.file.read_text(index)?;
        let calendar = Calendar::Standard;
        let second = |row: &String| {
            let unit = TimeUnit::parse(&format!("seconds since {}", row.replace('_', " ")), calendar);
            let what = || self.time_fault(format!("`{row}` in `{name}` is no date; accepted are such as 2005-08-28_12:00:00"));
            unit.map(|u| u.offset).ok_or_else(what)
        };
        let seconds = rows.iter().map(second).collect::<Result<Vec<f64>, _>>()?;
        self.check_times(&name, &seconds, expected, |i| rows[i].clone())?;
        let places = (0..seconds.len()).map(|entry| (0, entry)).collect();
        Ok(TimePlan { variable: name, units: "characters".into(), seconds, places, calendar: Some(calendar) })
    }

    fn check_times(&self, name: &str, seconds: &[f64], expected: usize, show: impl Fn(usize) -> String) -> Result<(), SourceError> {
        if seconds.is_empty() || seconds.len() != expected {
            return Err(self.time_fault(format!("`{name}` holds {} times for {expected} snapshots", seconds.len())));
        }
        if let Some(i) = seconds.iter().position(|s| !s.is_finite()) {
            return Err(self.time_fault(format!("entry {i} of `{name}` is missing or not a number")));
        }
        match (1..seconds.len()).find(|&i| seconds[i] <= seconds[i - 1]) {
            None => Ok(()),
            Some(i) => {
                let (before, here) = (show(i - 1), show(i));
                Err(self.time_fault(format!("entry {i} of `{name}` is {here}, the one before it {before}; times must ascend")))
            }
        }
    }
}
