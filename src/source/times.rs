//! The times of a file.

use super::SourceError;
use super::cf::calendar::{CALENDARS, Calendar};
use super::cf::coordinate::{Kind, classify};
use super::cf::time::{TIME_UNITS, TimeUnit};
use super::container::NumberType;
use super::dimensions::Extent;
use super::layout::Planner;

/// Times of one file.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct TimePlan {
    pub(super) variable: String,
    pub(super) units: String,
    /// Seconds, strictly ascending.
    pub(super) seconds: Vec<f64>,
    /// Frame (see [`super::layout::Layout::frames`]) and entry along its time dimension of each.
    pub(super) places: Vec<(usize, usize)>,
    pub(super) calendar: Option<Calendar>,
}

impl Planner<'_> {
    /// Finds the time variable and reads it.
    pub(super) fn time(&mut self, extents: &[Extent]) -> Result<TimePlan, SourceError> {
        let header = self.header();
        let fault = |what: String| SourceError::Time { path: self.path().into(), what };
        let dimension = extents.iter().find(|e| e.kind == Kind::Time);
        let single =
            |i: &usize| header.shape(&header.variables[*i]).iter().product::<usize>() == 1 && classify(&header.variables[*i]) == Kind::Time;
        // Rows of characters along the time dimension.
        let text = |e: &Extent| {
            let rows = |i: &usize| {
                let v = &header.variables[*i];
                v.number == NumberType::Text && v.dimensions.len() == 2 && v.dimensions[0] == e.dimension && classify(v) == Kind::Time
            };
            (0..header.variables.len()).find(rows)
        };
        let variable = match (&self.settings.time, dimension) {
            (Some(name), _) if header.find(name).is_some() => header.find(name),
            (_, Some(extent)) => extent.coordinate.or_else(|| text(extent)),
            (_, None) => (0..header.variables.len()).find(single),
        };
        let Some(index) = variable else {
            let times: Vec<&str> = header.variables.iter().filter(|v| classify(v) == Kind::Time).map(|v| v.name.as_str()).collect();
            let found =
                if times.is_empty() { "no time variable".into() } else { format!("no numeric time variable, only {}", times.join(", ")) };
            return Err(fault(format!("{found}; name one with `time = \"...\"`, in {TIME_UNITS}")));
        };
        let variable = &header.variables[index];
        if variable.number == NumberType::Text {
            return self.characters(index, dimension.map_or(1, |e| header.dimensions[e.dimension].len));
        }
        let name = variable.name.clone();
        let expected = dimension.map_or(1, |e| header.dimensions[e.dimension].len);
        // WRF before version 3.8 puts the reference into the description only.
        let description = variable.text("description").filter(|d| TimeUnit::has_reference(d));
        let units =
            variable.units().filter(|u| TimeUnit::has_reference(u)).or(description).or(variable.units()).unwrap_or_default().to_owned();
        let calendar_name = variable.text("calendar").unwrap_or_default();
        let Some(calendar) = Calendar::parse(calendar_name) else {
            return Err(fault(format!("calendar `{calendar_name}` of `{name}` is unknown; accepted are {CALENDARS}")));
        };
        let Some(unit) = TimeUnit::parse(&units, calendar) else {
            return Err(fault(format!(
                "unit `{units}` of `{name}` (calendar {}) is not understood; accepted are {TIME_UNITS}",
                calendar.name()
            )));
        };
        let seconds: Vec<f64> = self.coordinate_values(index)?.into_iter().map(|v| unit.seconds(v)).collect();
        if seconds.is_empty() || seconds.len() != expected {
            return Err(fault(format!("`{name}` holds {} times for {expected} snapshots", seconds.len())));
        }
        if let Some(i) = seconds.iter().position(|s| !s.is_finite()) {
            return Err(fault(format!("entry {i} of `{name}` is missing or not a number")));
        }
        if let Some(i) = (1..seconds.len()).find(|&i| seconds[i] <= seconds[i - 1]) {
            let show = |s: f64| unit.calendar.and_then(|c| c.iso(s)).unwrap_or_else(|| s.to_string());
            let (before, here) = (show(seconds[i - 1]), show(seconds[i]));
            return Err(fault(format!("entry {i} of `{name}` is {here}, the one before it {before}; times must ascend")));
        }
        let places = (0..seconds.len()).map(|entry| (0, entry)).collect();
        Ok(TimePlan { variable: name, units, seconds, places, calendar: unit.calendar })
    }

    /// Times as dates in characters, one a row: `2005-08-28_12:00:00`.
    pub(super) fn characters(&self, index: usize, expected: usize) -> Result<TimePlan, SourceError> {
        let name = self.header().variables[index].name.clone();
        let fault = |what: String| SourceError::Time { path: self.path().into(), what };
        let rows = self.file.read_text(index)?;
        let calendar = Calendar::Standard;
        let second = |row: &String| {
            let unit = TimeUnit::parse(&format!("seconds since {}", row.replace('_', " ")), calendar);
            unit.map(|u| u.offset).ok_or_else(|| fault(format!("`{row}` in `{name}` is no date; accepted are such as 2005-08-28_12:00:00")))
        };
        let seconds = rows.iter().map(second).collect::<Result<Vec<f64>, _>>()?;
        if seconds.is_empty() || seconds.len() != expected {
            return Err(fault(format!("`{name}` holds {} times for {expected} snapshots", seconds.len())));
        }
        if let Some(i) = (1..seconds.len()).find(|&i| seconds[i] <= seconds[i - 1]) {
            return Err(fault(format!("entry {i} of `{name}` is {}, the one before it {}; times must ascend", rows[i], rows[i - 1])));
        }
        let places = (0..seconds.len()).map(|entry| (0, entry)).collect();
        Ok(TimePlan { variable: name, units: "characters".into(), seconds, places, calendar: Some(calendar) })
    }
}
