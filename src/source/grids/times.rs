//! Times of a file.

use super::dimensions::Extent;
use super::planner::Planner;
use crate::cf::calendar::{CALENDARS, Calendar};
use crate::cf::coordinate::{Kind, classify};
use crate::cf::time::{TIME_UNITS, TimeUnit};
use crate::cf::units::Unit;
use crate::error::SourceError;
use crate::formats::{NumberType, Variable};

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

/// All entries along the time dimension of the only frame.
fn places_of(seconds: &[f64]) -> Vec<(usize, usize)> {
    (0..seconds.len()).map(|entry| (0, entry)).collect()
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
            if self.settings.steady && expected == 1 {
                let (variable, units) = (String::new(), String::new());
                return Ok(TimePlan { variable, units, seconds: vec![0.0], places: vec![(0, 0)], calendar: None });
            }
            let times: Vec<&str> = listing.variables.iter().filter(|v| classify(v) == Kind::Time).map(|v| v.name.as_str()).collect();
            let found =
                if times.is_empty() { "no time variable".into() } else { format!("no numeric time variable, only {}", times.join(", ")) };
            let steady =
                if expected == 1 { ", or take the flow as steady with --set archive.steady=true and --set time.tau=DURATION" } else { "" };
            return Err(self.time_fault(format!("{found}; name one with --set archive.time=NAME, in {TIME_UNITS}{steady}")));
        };
        let variable = self.variable(index);
        if variable.number == NumberType::Text {
            return Ok(self.selected_time(self.characters(index, expected)?, dimension));
        }
        let name = variable.name.clone();
        // WRF before version 3.8 puts the reference into the description only.
        let description = variable.text("description").filter(|d| TimeUnit::has_reference(d));
        let units = variable.units().filter(|u| TimeUnit::has_reference(u)).or(description).or(variable.units());
        let units = self.settings.unit("time").or(units).unwrap_or_default();
        self.check_months(variable, units)?;
        let calendar_name = variable.text("calendar").unwrap_or_default();
        let Some(calendar) = Calendar::parse(calendar_name) else {
            return Err(self.time_fault(format!("calendar `{calendar_name}` of `{name}` is unknown; accepted are {CALENDARS}")));
        };
        let Some(unit) = TimeUnit::parse(units, calendar) else {
            let calendar = calendar.name();
            let what = format!(
                "unit `{units}` of `{name}` (calendar {calendar}) is not understood; accepted are {TIME_UNITS}; if the file is wrong, state it \
                 with --set archive.units.time=\"hours since 2000-01-01\""
            );
            return Err(self.time_fault(what));
        };
        let seconds: Vec<f64> = self.coordinate_values(index)?.into_iter().map(|v| unit.seconds(v)).collect();
        let show = |i: usize| unit.calendar.and_then(|c| c.iso(seconds[i])).unwrap_or_else(|| seconds[i].to_string());
        self.check_times(&name, &seconds, expected, show)?;
        let (variable, units, calendar) = (name, units.to_owned(), unit.calendar);
        Ok(self.selected_time(TimePlan { variable, units, places: places_of(&seconds), seconds, calendar }, dimension))
    }

    /// The time that the settings pick, or all.
    fn selected_time(&self, mut plan: TimePlan, dimension: Option<&Extent>) -> TimePlan {
        let entry = dimension.and_then(|extent| self.settings.entry(&self.listing().dimensions[extent.dimension].name));
        if let Some((entry, &seconds)) = entry.and_then(|entry| Some((entry, plan.seconds.get(entry)?))) {
            (plan.seconds, plan.places) = (vec![seconds], vec![(0, entry)]);
        }
        plan
    }

    /// Refuses months, whose lengths differ, and numbers of months, which are no time.
    fn check_months(&self, variable: &Variable, units: &str) -> Result<(), SourceError> {
        let first = units.split_whitespace().next().unwrap_or_default().to_ascii_lowercase();
        let counted = |word: &str| word.starts_with("month") || word.starts_with("year");
        let name = format!("{} {}", variable.name, variable.text("long_name").unwrap_or_default()).to_ascii_lowercase();
        let bare = Unit::parse(units).is_some_and(|unit| unit.is_dimensionless());
        let months = |word: &str| word.starts_with("month");
        let numbers = bare && name.split(|c: char| !c.is_alphabetic()).any(months);
        let days = bare && ["dayofyear", "day_of_year"].contains(&variable.name.to_ascii_lowercase().as_str());
        if !counted(&first) && !numbers && !days {
            return Ok(());
        }
        let found = if units.is_empty() { "has no unit".into() } else { format!("is in `{units}`") };
        let (counts, length) = match () {
            () if days => ("days of a year", "1 day"),
            () if first.starts_with("year") => ("years, which have no fixed length", "365.2425 days"),
            () => ("months, which have no fixed length", "30.4375 days"),
        };
        let date = units.split_once("since").map_or("2000-01-01", |(_, date)| date.trim());
        Err(self.time_fault(format!(
            "`{}` counts {counts}, and {found}: state the length of 1 with --set archive.units.time=\"{length}\" or, with a date for 0, \
             \"{length} since {date}\"",
            variable.name
        )))
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
        Ok(TimePlan { variable: name, units: "characters".into(), places: places_of(&seconds), seconds, calendar: Some(calendar) })
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
                Err(self.time_fault(format!("entry {i} of `{name}` is {here}, the one before it {before}; times must ascend (`cdo mergetime` or xarray's `sortby` orders them)")))
            }
        }
    }
}
