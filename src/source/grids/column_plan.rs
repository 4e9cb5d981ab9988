//! Finds levels that follow the bottom of the sea or the ground: by `formula_terms` (CF conventions, appendix D), by the names of ROMS and CROCO, or by a
//! [field of their heights](super::column_field).

use super::axes::{AxisPlan, Quantity};
use super::column::{Columns, Formula, Places};
use super::component::{ComponentPlan, Role, read_component};
use super::dimensions::Extent;
use super::layout::Layout;
use super::levels::REFERENCE_PRESSURE;
use super::planner::Planner;
use super::refine::LARGE;
use crate::archive_settings::{Metric, VelocityUnit};
use crate::cf::coordinate::Kind;
use crate::cf::units::Unit;
use crate::cf::velocity::{Candidate, Velocity};
use crate::error::SourceError;
use crate::formats::{Attribute, Variable};
use ridgewatch_field::Axis;
use std::sync::Arc;

/// Levels of u, v and w that follow the bottom, and their dimensions.
pub struct Terrain {
    of: Vec<Option<(usize, Arc<Columns>)>>,
    /// Heights of the grid, metres; one if a single one is read.
    heights: Vec<f64>,
    is_of_air: bool,
}

/// Mean pressures at the ground that are taken as such, Pa.
const PRESSURES: [f64; 2] = [2e4, 1.5e5];
/// Names of ROMS and CROCO, for levels of tracers and those between them: s, C(s).
const NAMES: [[&[&str]; 2]; 2] = [[&["s_rho", "sc_r"], &["Cs_r", "Cs_rho"]], [&["s_w", "sc_w"], &["Cs_w"]]];

/// Share of the values outside of the heights of the grid above which there is a warning.
const MUCH_OUTSIDE: f64 = 0.5;

impl Terrain {
    /// True along the levels of component `which` (0, 1, 2 for u, v, w).
    pub fn is_along(&self, which: usize, dimension: usize) -> bool {
        self.of.get(which).and_then(Option::as_ref).is_some_and(|(own, _)| *own == dimension)
    }

    /// True if w may be the change of a particle's pressure.
    pub fn is_of_air(&self) -> bool {
        self.is_of_air
    }

    /// False if a single height is read.
    pub fn is_three(&self) -> bool {
        self.heights.len() > 1
    }

    /// True if a field tells where levels lie.
    fn is_by_field(&self) -> bool {
        self.columns(0).is_some_and(|columns| matches!(columns.places, Places::Field { .. }))
    }

    /// Levels of a component.
    pub fn columns(&self, which: usize) -> Option<Arc<Columns>> {
        self.of.get(which)?.as_ref().map(|(_, columns)| columns.clone())
    }
}

impl Planner<'_> {
    /// The levels of the components, if u has levels that follow the bottom, and the heights that they are interpolated to: `level`, `heights`, those of
    /// the archive's first file, or the mean heights of its levels. `extents` are those of u, whose levels are marked.
    ///
    /// # Errors
    /// Values that cannot be read; terms that do not fit; settings that do not fit.
    pub fn terrain(&mut self, velocity: &Velocity, extents: &mut [Extent], first: Option<&Layout>) -> Result<Option<Terrain>, SourceError> {
        let time = extents.iter().find(|e| e.kind == Kind::Time).map(|e| e.dimension);
        let u = velocity.u.variable;
        let found = self.columns(u, time, None)?;
        // A level that is selected is read as it is.
        let is_selected = self.variable(u).dimensions.iter().any(|&d| self.settings.entry(&self.listing().dimensions[d].name).is_some());
        if let Some(field) = self.named_heights()
            && !is_selected
            && found.as_ref().is_none_or(|(_, columns)| *columns.teller() != self.variable(field).name)
        {
            return Err(self.misfit(field, self.of_other_levels(u)));
        }
        let Some((dimension, columns)) = found else {
            self.note_depths_of_points(u);
            return Ok(None);
        };
        let Some(extent) = extents.iter_mut().find(|e| e.dimension == dimension) else { return Ok(None) };
        extent.kind = Kind::Level;
        let mut found = vec![Some((dimension, columns))];
        let v = self.columns(velocity.v.variable, time, None)?;
        if v.is_none() {
            return Err(self.misfit(velocity.v.variable, "it has no levels that follow the bottom or the ground, which u has"));
        }
        found.push(v);
        found.push(match &velocity.w {
            Some(w) => {
                let is_tendency = self.is_pressure_tendency(w.variable);
                self.columns(w.variable, time, Some(dimension))?.map(|(dimension, columns)| (dimension, Columns { is_tendency, ..columns }))
            }
            None => None,
        });
        if let (Some(w), Some(Some((_, Columns { is_tendency: true, places: Places::Field { is_pressure: false, .. }, .. })))) =
            (&velocity.w, found.get(2))
        {
            let name = &self.variable(w.variable).name;
            self.note(format!(
                "`{name}` is read as w = -H omega / p, with H = 7 km and the pressure of an isothermal atmosphere at each height"
            ));
        }
        let Some((_, columns)) = &found[0] else { return Ok(None) };
        let is_of_air = columns.is_of_air();
        if is_of_air && matches!(columns.places, Places::Formula { .. }) {
            self.check_is_height(dimension)?;
        }
        let heights = self.heights_for(columns, first)?;
        let level = &self.listing().dimensions[dimension].name;
        let to = match heights[..] {
            [one] => format!("to height {one} m"),
            _ => format!("to {} heights from {:.1} to {:.1} m", heights.len(), heights[0], heights[heights.len() - 1]),
        };
        let default = match is_of_air {
            true => "the mean heights of the levels over all columns; others with archive.heights, one with --set archive.level=HEIGHT",
            false => {
                "0 and the mean heights of the levels over all columns; others with archive.heights, one with --set archive.level=-DEPTH"
            }
        };
        let why = if (self.settings.level, &self.settings.heights) == (None, &None) { default } else { "as set" };
        let under = if is_of_air { "the ground" } else { "the bottom" };
        let teller = columns.teller();
        let lie = match &columns.places {
            Places::Formula { .. } if is_of_air => format!(
                "follows the ground (CF conventions, appendix D; pressure at the ground `{teller}`, heights z = -H ln(p / p0) with H = 7 km and p0 = 1000 hPa)"
            ),
            Places::Formula { surface, .. } => {
                let surface =
                    surface.as_ref().map_or("at rest, since no term gives its height".into(), |s| format!("`{}` of each time", s.name));
                format!("follows the bottom (CF conventions, appendix D; depth `{teller}`, surface {surface})")
            }
            Places::Field { is_pressure: true, .. } => {
                format!("lies at the pressures `{teller}` of each point (heights z = -H ln(p / p0) with H = 7 km and p0 = 1000 hPa)")
            }
            Places::Field { heights, .. } => {
                let positive = if heights.factor < 0.0 { "down" } else { "up" };
                format!("lies at the heights `{teller}` of each point (positive {positive})")
            }
        };
        self.note(format!("`{level}` {lie}: each column is interpolated between its own levels {to} ({why}); below {under} it is missing"));
        let with_heights = |(dimension, columns): (usize, Columns)| (dimension, Arc::new(Columns { heights: heights.clone(), ..columns }));
        Ok(Some(Terrain { of: found.into_iter().map(|found| found.map(with_heights)).collect(), heights, is_of_air }))
    }

    /// Tells of NEMO's depths of every point (partial cells), which are used only if they are named.
    fn note_depths_of_points(&mut self, u: usize) {
        let shape = self.shape(u);
        let fits = |v: &Variable| {
            let own = self.listing().shape(v);
            v.name.to_ascii_lowercase().starts_with("gdept")
                && own.len() >= 3
                && shape.len() >= 3
                && own[own.len() - 3..] == shape[shape.len() - 3..]
        };
        let found = self
            .listing()
            .matching(fits)
            .next()
            .filter(|_| !self.counts_cells() && self.settings.z.is_none() && self.settings.level.is_none());
        if let Some(found) = found {
            let name = &self.variable(found).name;
            self.note(format!(
                "`{name}` tells the depth of every point, such as of partial cells at the bottom: --set archive.z={name} uses it"
            ));
        }
    }

    /// True if cells are those of the file, so that its levels are no heights.
    fn counts_cells(&self) -> bool {
        self.settings.metric == Some(Metric::Index) || self.settings.velocity_unit == VelocityUnit::Cells
    }

    /// True if w is the change of a particle's pressure: by its unit or, without one, by its names.
    fn is_pressure_tendency(&self, w: usize) -> bool {
        let variable = self.variable(w);
        let unit = Unit::parse(self.settings.unit("w").or(variable.units()).unwrap_or_default());
        let named = variable.text("standard_name") == Some("lagrangian_tendency_of_air_pressure")
            || ["omega", "wap"].contains(&variable.name.to_ascii_lowercase().as_str());
        unit.is_some_and(|u| u.is_pressure_tendency() || (u.is_dimensionless() && named))
    }

    /// Refuses a `level` that is one of the levels, where a height is wanted.
    fn check_is_height(&self, dimension: usize) -> Result<(), SourceError> {
        let (Some(level), Some(coordinate)) = (self.settings.level, self.measured(dimension).coordinate) else { return Ok(()) };
        let Some(entry) = self.coordinate_values(coordinate)?.iter().position(|value| *value == level) else { return Ok(()) };
        let name = &self.listing().dimensions[dimension].name;
        let accepted = format!(
            "heights in metres, since `{name}` follows the ground; --set archive.select.{name}={entry} reads this level as it is, \
             --set archive.metric=index all of them"
        );
        Err(SourceError::setting("level", level.to_string(), accepted))
    }

    fn heights_for(&self, columns: &Columns, first: Option<&Layout>) -> Result<Vec<f64>, SourceError> {
        let s = self.settings;
        let known = first.and_then(|layout| layout.frames[0][0].columns.as_ref()).map(|columns| columns.heights.clone());
        match (s.level, &s.heights, known) {
            (Some(_), Some(_), _) => {
                Err(SourceError::setting("heights", "given beside `level`", "one of them: `level` reads one depth, `heights` several"))
            }
            (_, _, Some(known)) => Ok(known),
            (Some(level), None, None) => {
                let [low, high] = columns.reach(self.file)?;
                if !(low..=high).contains(&level) {
                    let accepted = match columns.is_of_air() {
                        true => format!("heights in metres: from {low:.1} at the lowest ground to {high:.1}"),
                        false => format!("heights in metres, negative below the surface: from {low:.1} at the deepest bottom to 0"),
                    };
                    return Err(SourceError::setting("level", level.to_string(), accepted));
                }
                Ok(vec![level])
            }
            (None, Some(heights), None) if heights.len() < 2 => {
                let accepted = match columns.is_of_air() {
                    true => "two heights or more, in metres; one with --set archive.level=HEIGHT",
                    false => "two heights or more, in metres, negative below the surface; one with --set archive.level=-DEPTH",
                };
                Err(SourceError::setting("heights", format!("{heights:?}"), accepted))
            }
            (None, Some(heights), None) => Ok(heights.clone()),
            (None, None, None) => match columns.mean_heights(self.file)? {
                heights if heights.len() < 2 => Err(SourceError::variable(
                    self.path(),
                    columns.teller(),
                    "it gives the levels no heights: its values are missing, or all on the other side of the surface",
                )),
                heights => Ok(heights),
            },
        }
    }

    /// The axis of heights; `None` if a single depth is read.
    pub fn height_axis(&self, terrain: &Terrain) -> Result<Option<AxisPlan>, SourceError> {
        if !terrain.is_three() {
            return Ok(None);
        }
        let axis = Axis::new("altitude", "m", terrain.heights.clone()).map_err(|fault| self.fault(fault))?;
        Ok(Some(AxisPlan::made(Kind::Level, axis, Quantity::Length)))
    }

    /// w, unless it does not lie on levels that follow the bottom although u does, or runs through them.
    pub fn vertical_candidate<'v>(&mut self, velocity: &'v Velocity, terrain: Option<&Terrain>) -> Option<&'v Candidate> {
        let w = velocity.w.as_ref()?;
        let Some(terrain) = terrain else { return Some(w) };
        let name = &self.variable(w.variable).name;
        let odd = match () {
            () if self.settings.w.is_none() && !terrain.is_of_air() && name.eq_ignore_ascii_case("omega") => {
                "is the velocity through the levels"
            }
            () if terrain.columns(2).is_none() && terrain.is_by_field() => {
                "does not lie on the levels of the heights, nor do its `coordinates` name heights of its own"
            }
            () if terrain.columns(2).is_none() => "does not lie on levels that follow the bottom or the ground",
            () => return Some(w),
        };
        self.note(format!("`{name}` {odd}, and is not used"));
        None
    }

    /// Gives the levels to the components that lie on them. Of the first file, the error of interpolation between the heights is told.
    pub fn give_columns(&mut self, components: &mut [ComponentPlan], terrain: Option<&Terrain>, is_first: bool) -> Result<(), SourceError> {
        for (which, component) in components.iter_mut().enumerate() {
            component.columns = terrain.and_then(|terrain| terrain.columns(which));
            if component.columns.is_some() && !component.roles.ends_with(&[Role::Axis(1), Role::Axis(0)]) {
                let what = "its levels follow the bottom, so that its last dimensions have to be y and x";
                return Err(SourceError::variable(self.path(), &component.name, what));
            }
        }
        if is_first && terrain.is_some_and(Terrain::is_three) {
            let (error, outside) = Columns::error(self.file, &components[..2])?;
            let told = match error {
                Some(error) => format!("interpolation between these heights errs by {error}, at the first time"),
                None => "interpolation between these heights could not be measured at the first time".into(),
            };
            let told = format!("{told}; {:.1} % of the file's values lie above or below them, or beside a missing one", 100.0 * outside);
            self.note(match outside > MUCH_OUTSIDE || error.is_some_and(|error| error.excess() > LARGE) {
                true => format!("WARNING: {told}: --set archive.heights=[...] names others, more where the flow changes most"),
                false => told,
            });
        }
        Ok(())
    }

    /// Levels of a variable that follow the bottom, without heights to interpolate to, and their dimension. `of_u`: see [`Self::field_of_heights`].
    fn columns(&mut self, variable: usize, time: Option<usize>, of_u: Option<usize>) -> Result<Option<(usize, Columns)>, SourceError> {
        let dims = &self.variable(variable).dimensions;
        let Some((&[y, x], others)) = dims.split_last_chunk::<2>().map(|(rest, plane)| (plane, rest)) else { return Ok(None) };
        let listing = self.listing();
        let picked = |d: usize| self.settings.entry(&listing.dimensions[d].name).is_some();
        for dimension in
            others.iter().copied().filter(|&d| listing.dimensions[d].len > 1 && Some(d) != time && !picked(d)).collect::<Vec<_>>()
        {
            let coordinates: Vec<usize> = self.listing().matching(|v| v.dimensions == [dimension] && v.number.is_number()).collect();
            let declared = coordinates.iter().copied().find(|&i| formula_of(self.variable(i)).is_some());
            let field = self.field_of_heights(variable, dimension, of_u).filter(|_| !self.counts_cells());
            if let (Some(field), true) = (field, field == self.named_heights() || declared.is_none()) {
                return Ok(Some((dimension, self.by_field(field, [x, y], time, variable)?)));
            }
            let found = match declared {
                Some(level) => self.by_terms(variable, dimension, level)?,
                None => self.by_names(dimension)?,
            };
            let Some(Terms { formula, levels, critical_depth, ground, surface }) = found else { continue };
            let mut order: Vec<usize> = (0..levels.len()).collect();
            order.sort_by(|&a, &b| formula.rank(levels[a]).total_cmp(&formula.rank(levels[b])));
            if levels.iter().flatten().any(|v| !v.is_finite()) || !critical_depth.is_finite() {
                return Err(self.misfit(variable, "a term of its levels is missing or not a number"));
            }
            let plane = [x, y].map(|d| self.listing().dimensions[d].len);
            let ground = self.field_of_columns(ground, None, plane, time, variable)?;
            let surface = surface.map(|index| self.field_of_columns(index, None, plane, time, variable)).transpose()?;
            let levels = order.iter().map(|&k| levels[k]).collect();
            if formula.is_of_air() {
                self.check_pressures(&ground)?;
            }
            let places = Places::Formula { formula, levels, critical_depth, ground: Box::new(ground), surface: surface.map(Box::new) };
            return Ok(Some((dimension, Columns { places, order, is_tendency: false, heights: Vec::new() })));
        }
        Ok(None)
    }

    /// Refuses a field that is no pressure at the ground, such as its logarithm.
    fn check_pressures(&self, ground: &ComponentPlan) -> Result<(), SourceError> {
        let mut found = read_component(self.file, ground, &ground.file_order(), 0)?;
        found.retain(|pressure| pressure.is_finite());
        let mean = found.iter().map(|&pressure| f64::from(pressure)).sum::<f64>() / found.len() as f64;
        if (PRESSURES[0]..=PRESSURES[1]).contains(&mean) {
            return Ok(());
        }
        let what = format!(
            "its mean is {mean:.4e} Pa; accepted is a pressure at the ground of {:.0} to {:.0} hPa, in Pa if it has no unit",
            PRESSURES[0] / 100.0,
            PRESSURES[1] / 100.0
        );
        Err(SourceError::variable(self.path(), &ground.name, what))
    }

    /// Terms that `formula_terms` of the coordinate `level` names.
    fn by_terms(&mut self, variable: usize, dimension: usize, level: usize) -> Result<Option<Terms>, SourceError> {
        let coordinate = self.variable(level);
        let Some(declared) = formula_of(coordinate) else { return Ok(None) };
        let text = coordinate.text("formula_terms").unwrap_or_default();
        let words: Vec<&str> = text.split_whitespace().collect();
        let name_of = |term: &str| {
            let key = format!("{term}:");
            words.iter().position(|word| *word == key).and_then(|k| words.get(k + 1)).copied()
        };
        let listing = self.listing();
        let find = |term: &str, usual: &str| listing.find(name_of(term).unwrap_or(usual));
        if declared.is_of_air() {
            if self.counts_cells() {
                return Ok(None);
            }
            let Some(ground) = find("ps", "ps") else {
                let (name, ground) = (&coordinate.name, name_of("ps").unwrap_or("ps"));
                self.note(format!(
                    "`{name}` follows the ground, but the pressure there, `{ground}`, is not in the file, which fixed heights need: merge it into the file"
                ));
                return Ok(None);
            };
            let levels = self.pressures(declared, level, dimension, &name_of)?;
            let Some(levels) = levels else {
                let name = &coordinate.name;
                self.note(format!(
                    "`{name}` follows the ground, but a term of its formula (`formula_terms`) is not in the file: it is not read as heights"
                ));
                return Ok(None);
            };
            return Ok(Some(Terms { formula: Formula::Hybrid, levels, critical_depth: 0.0, ground, surface: None }));
        }
        let Some(depth) = find("depth", "h") else {
            let (name, depth) = (&coordinate.name, name_of("depth").unwrap_or("h"));
            self.note(format!(
                "`{name}` follows the bottom, but its depth `{depth}` is not in the files: name the file that holds it too, to read fixed depths"
            ));
            return Ok(None);
        };
        let surface = find("eta", "zeta");
        let s = self.coordinate_values(level)?;
        if declared == Declared::Sigma {
            let levels = s.iter().map(|&s| [s, s]).collect();
            return Ok(Some(Terms { formula: Formula::G2, levels, critical_depth: 0.0, ground: depth, surface }));
        }
        // ROMS of before the names g1 and g2 says more by its variables.
        if declared == Declared::S
            && self.scalar(&["Vtransform"])?.is_some()
            && let Some(terms) = self.by_names(dimension)?
        {
            return Ok(Some(terms));
        }
        let lacking = |term: &str| {
            let what = format!("its levels `{}` lack the term `{term}` of their formula (`formula_terms`)", coordinate.name);
            self.misfit(variable, what)
        };
        let number = |term: &str, usual: &str| self.scalar(&[name_of(term).unwrap_or(usual)])?.ok_or_else(|| lacking(term));
        let critical_depth = number("depth_c", "hc")?;
        let (formula, stretching) = match declared {
            Declared::S => {
                let (a, b) = (number("a", "theta_s")?, number("b", "theta_b")?);
                (Formula::S, s.iter().map(|&s| stretching(s, a, b)).collect())
            }
            Declared::G1 | Declared::G2 | Declared::Sigma => {
                let formula = if declared == Declared::G1 { Formula::G1 } else { Formula::G2 };
                let usual = NAMES.iter().flat_map(|names| names[1]).copied();
                let names: Vec<&str> = name_of("C").into_iter().chain(usual).collect();
                (formula, self.along_levels(&names, dimension)?.ok_or_else(|| lacking("C"))?)
            }
            Declared::Hybrid | Declared::AirSigma => return Ok(None),
        };
        let levels = s.into_iter().zip(stretching).map(|(s, c)| [s, c]).collect();
        Ok(Some(Terms { formula, levels, critical_depth, ground: depth, surface }))
    }

    /// a (Pa) and b of the levels of the atmosphere, whose pressure is a + b p_s. `None` if a term is not there.
    fn pressures<'t>(
        &mut self,
        declared: Declared,
        level: usize,
        dimension: usize,
        name_of: &dyn Fn(&str) -> Option<&'t str>,
    ) -> Result<Option<Vec<[f64; 2]>>, SourceError> {
        let pascals = |index: Option<usize>| {
            let unit = index.and_then(|index| Unit::parse(self.variable(index).units()?));
            unit.filter(Unit::is_pressure).map_or(1.0, |unit| unit.factor)
        };
        let named = |term: &str| name_of(term).and_then(|name| self.listing().find(name));
        let row = |term: &str| name_of(term).map_or(Ok(None), |name| self.along_levels(&[name], dimension));
        let number = |term: &str| name_of(term).map_or(Ok(None), |name| self.scalar(&[name]));
        if declared == Declared::AirSigma {
            let Some(top) = number("ptop")? else { return Ok(None) };
            let top = top * pascals(named("ptop"));
            return Ok(Some(self.coordinate_values(level)?.into_iter().map(|sigma| [top * (1.0 - sigma), sigma]).collect()));
        }
        let (fixed, share) = (row("ap")?, row("b")?);
        let fixed = match fixed {
            Some(fixed) => Some(fixed.into_iter().map(|a| a * pascals(named("ap"))).collect::<Vec<_>>()),
            // Without p0, the one of most models.
            None => {
                let reference = number("p0")?.map_or(REFERENCE_PRESSURE, |p| p * pascals(named("p0")));
                // Some models write `a` as a pressure.
                let unit = named("a").and_then(|index| Unit::parse(self.variable(index).units()?)).filter(Unit::is_pressure);
                let factor = unit.map_or(reference, |unit| unit.factor);
                row("a")?.map(|a| a.into_iter().map(|a| a * factor).collect())
            }
        };
        Ok(fixed.zip(share).map(|(fixed, share)| fixed.into_iter().zip(share).map(|(a, b)| [a, b]).collect()))
    }

    /// Terms by the names of ROMS and CROCO.
    fn by_names(&mut self, dimension: usize) -> Result<Option<Terms>, SourceError> {
        if let Some(terms) = self.by_hybrid_names(dimension)? {
            return Ok(Some(terms));
        }
        let name = &self.listing().dimensions[dimension].name;
        let Some([s, stretching]) = NAMES.iter().find(|names| names[0].contains(&name.as_str())) else { return Ok(None) };
        let (Some(s), Some(stretching)) = (self.along_levels(s, dimension)?, self.along_levels(stretching, dimension)?) else {
            return Ok(None);
        };
        let (Some(depth), Some(critical_depth)) = (self.listing().find("h"), self.scalar(&["hc"])?) else { return Ok(None) };
        let new = matches!(self.listing().attribute("VertCoordType"), Some(Attribute::Text(text)) if text.trim() == "NEW");
        let formula = match self.scalar(&["Vtransform"])? {
            Some(2.0) => Formula::G2,
            None if new => Formula::G2,
            Some(1.0) => Formula::G1,
            None => {
                self.note("no `Vtransform` says how the levels lie: taken as 1, as in ROMS before it had others");
                Formula::G1
            }
            Some(odd) => return Err(self.fault(format!("`Vtransform` is {odd}; accepted are 1 and 2"))),
        };
        let levels = s.into_iter().zip(stretching).map(|(s, c)| [s, c]).collect();
        Ok(Some(Terms { formula, levels, critical_depth, ground: depth, surface: self.listing().find("zeta") }))
    }

    /// Levels of CAM, in files that lost their `formula_terms`: pressures `hyam` P0 + `hybm` PS.
    fn by_hybrid_names(&self, dimension: usize) -> Result<Option<Terms>, SourceError> {
        let (Some(a), Some(b)) = (self.along_levels(&["hyam"], dimension)?, self.along_levels(&["hybm"], dimension)?) else {
            return Ok(None);
        };
        let (Some(ground), false) = (self.listing().find("PS").or(self.listing().find("ps")), self.counts_cells()) else { return Ok(None) };
        let unit = self.listing().find("P0").and_then(|index| Unit::parse(self.variable(index).units()?)).filter(Unit::is_pressure);
        let reference = self.scalar(&["P0"])?.map_or(REFERENCE_PRESSURE, |p| p * unit.map_or(1.0, |unit| unit.factor));
        // ECHAM and CDO write pressures under the same name.
        let unit = self.listing().find("hyam").and_then(|index| Unit::parse(self.variable(index).units()?)).filter(Unit::is_pressure);
        let is_share = unit.is_none() && a.iter().all(|a| a.abs() <= 1.0);
        let factor = if is_share { reference } else { unit.map_or(1.0, |unit| unit.factor) };
        let levels = a.into_iter().zip(b).map(|(a, b)| [a * factor, b]).collect();
        Ok(Some(Terms { formula: Formula::Hybrid, levels, critical_depth: 0.0, ground, surface: None }))
    }

    /// The first of some numbers: a variable of one entry, or an attribute of the file.
    fn scalar(&self, names: &[&str]) -> Result<Option<f64>, SourceError> {
        let one = |&i: &usize| self.shape(i).iter().product::<usize>() == 1 && self.variable(i).number.is_number();
        match names.iter().find_map(|name| self.listing().find(name).filter(one)) {
            Some(index) => Ok(self.coordinate_values(index)?.first().copied()),
            None => Ok(names.iter().find_map(|name| self.listing().number(name))),
        }
    }

    /// The first of some rows of numbers along the levels: a variable, or an attribute of the file.
    fn along_levels(&self, names: &[&str], dimension: usize) -> Result<Option<Vec<f64>>, SourceError> {
        let along = |&i: &usize| self.variable(i).dimensions == [dimension] && self.variable(i).number.is_number();
        if let Some(index) = names.iter().find_map(|name| self.listing().find(name).filter(along)) {
            return self.coordinate_values(index).map(Some);
        }
        let count = self.listing().dimensions[dimension].len;
        let attribute = |name: &&str| match self.listing().attribute(name) {
            Some(Attribute::Numbers(_, values)) if values.len() == count => Some(values.clone()),
            _ => None,
        };
        Ok(names.iter().find_map(attribute))
    }

    /// A length or a pressure over the plane of a variable, on its points or with one more along x or y, and along its levels, if they are given; its last
    /// two dimensions are y and x.
    pub fn field_of_columns(
        &self,
        field: usize,
        levels: Option<usize>,
        plane: [usize; 2],
        time: Option<usize>,
        of: usize,
    ) -> Result<ComponentPlan, SourceError> {
        let variable = self.variable(field);
        let shape = self.shape(field);
        let rank = shape.len();
        if rank >= 2
            && let Some(&[y, x]) = self.variable(of).dimensions.last_chunk::<2>()
            && (variable.dimensions[rank - 1] == y || variable.dimensions[rank - 2] == x)
        {
            let dimensions = self.listing().dimension_names(variable);
            return Err(self.misfit(field, format!("its dimensions are {dimensions}; accepted are y and x as the last ones")));
        }
        let fits = rank >= 2 && [0, 1].iter().all(|&k| (plane[k]..=plane[k] + 1).contains(&shape[rank - 1 - k]));
        if !fits {
            let what = format!(
                "its shape is {shape:?}, but `{}` has {} x {} points along x and y; accepted are as many, or one more",
                self.variable(of).name,
                plane[0],
                plane[1]
            );
            return Err(self.misfit(field, what));
        }
        if let Some(k) = (0..rank - 2).find(|&k| shape[k] > 1 && ![time, levels].contains(&Some(variable.dimensions[k]))) {
            let (name, of) = (&self.listing().dimensions[variable.dimensions[k]].name, &self.variable(of).name);
            return Err(
                self.misfit(field, format!("its dimension `{name}` is not that of the times of `{of}`: which entry counts is not known"))
            );
        }
        self.listing().check_count(variable, &shape[rank - 2..])?;
        let role = |k: usize| match rank - 1 - k {
            axis @ 0..=1 => Role::Axis(axis),
            _ if Some(variable.dimensions[k]) == levels => Role::Axis(2),
            _ if Some(variable.dimensions[k]) == time => Role::Time,
            _ => Role::Fixed(0),
        };
        let unit = variable.units().and_then(Unit::parse).filter(|unit| unit.is_length() || unit.is_pressure());
        Ok(ComponentPlan {
            name: variable.name.clone(),
            roles: (0..rank).map(role).collect(),
            dimensions: self.dimensions_of(field),
            shape,
            packing: self.packing(field)?,
            factor: unit.map_or(1.0, |unit| unit.factor),
            why: String::new(),
            of_water: false,
            of_air: false,
            mask: None,
            columns: None,
            own: Default::default(),
        })
    }
}

/// What a formula needs.
struct Terms {
    formula: Formula,
    /// See [`Columns::levels`], in the order of the file.
    levels: Vec<[f64; 2]>,
    critical_depth: f64,
    ground: usize,
    surface: Option<usize>,
}

/// Formulae by their standard names.
#[derive(Clone, Copy, PartialEq)]
enum Declared {
    Sigma,
    S,
    G1,
    G2,
    Hybrid,
    AirSigma,
}

impl Declared {
    fn is_of_air(self) -> bool {
        matches!(self, Self::Hybrid | Self::AirSigma)
    }
}

fn formula_of(coordinate: &Variable) -> Option<Declared> {
    match coordinate.text("standard_name")? {
        "ocean_sigma_coordinate" => Some(Declared::Sigma),
        "ocean_s_coordinate" => Some(Declared::S),
        "ocean_s_coordinate_g1" => Some(Declared::G1),
        "ocean_s_coordinate_g2" => Some(Declared::G2),
        "atmosphere_hybrid_sigma_pressure_coordinate" => Some(Declared::Hybrid),
        "atmosphere_sigma_coordinate" => Some(Declared::AirSigma),
        _ => None,
    }
}

/// C(s) of `ocean_s_coordinate` (CF conventions, appendix D).
fn stretching(s: f64, a: f64, b: f64) -> f64 {
    // The limit without stretching.
    if a == 0.0 {
        return s;
    }
    (1.0 - b) * (a * s).sinh() / a.sinh() + b * ((a * (s + 0.5)).tanh() / (2.0 * (0.5 * a).tanh()) - 0.5)
}
