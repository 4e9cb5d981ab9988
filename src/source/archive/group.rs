//! Components in files of their own, and meshes and masks beside them: which files belong together.

use super::limits;
use crate::archive_settings::ArchiveSettings;
use crate::cf::coordinate::{Kind, classify};
use crate::error::SourceError;
use crate::formats::{DataFile, Limits};
use crate::grids::{Content, content};
use std::collections::HashSet;
use std::path::{Path, PathBuf};

/// Names of the components.
const NAMES: [&str; 3] = ["u", "v", "w"];

/// Files that are read as one: the first names them.
pub type Group = Vec<PathBuf>;

struct Part {
    path: PathBuf,
    content: Content,
}

impl Part {
    fn holds(&self) -> String {
        let names: Vec<&str> = (0..3).filter(|&k| self.content.components[k]).map(|k| NAMES[k]).collect();
        names.join(" and ")
    }
}

/// Groups files of which some lack a component: those with components by their times, meshes and masks with all of them. `None` if every
/// file with a component has u and v and no other file can help, or if a file cannot be understood.
///
/// # Errors
/// A component without its partner at a time, or twice.
pub fn grouped(paths: &[PathBuf], settings: &ArchiveSettings) -> Result<Option<Vec<Group>>, SourceError> {
    let limits = limits(settings);
    let (mut parts, mut helpers, mut helped, mut idle) = (Vec::new(), Vec::new(), HashSet::new(), None);
    let mut moving: Vec<Part> = Vec::new();
    for path in paths {
        let Ok(file) = DataFile::open(path, None, limits) else { return Ok(None) };
        let Some(content) = content(&file, settings)? else { return Ok(None) };
        if content.components.contains(&true) {
            parts.push(Part { path: path.clone(), content });
        } else if content.helps {
            // Heights that change belong to the components of their times.
            if !content.seconds.is_empty() {
                moving.push(Part { path: path.clone(), content });
            } else if helped.insert(content.fixed) {
                // One file of each time may repeat the mesh.
                helpers.push(path.clone());
            }
        } else {
            idle.get_or_insert_with(|| path.clone());
        }
    }
    let whole = |part: &Part| part.content.components[0] && part.content.components[1];
    if parts.is_empty() || (parts.iter().all(whole) && helpers.is_empty() && moving.is_empty()) {
        return Ok(None);
    }
    if let Some(idle) = idle {
        // Of whole files, the plan tells what it lacks.
        let what = "it holds neither a component of the velocity nor a mesh or a mask: leave it out, or name its variable with --set archive.u=NAME, \
                    archive.v, archive.w or archive.mask";
        return if parts.iter().all(whole) { Ok(None) } else { Err(SourceError::file(&idle, what)) };
    }
    let held: [bool; 3] = [0, 1, 2].map(|k| parts.iter().any(|part| part.content.components[k]));
    let mut groups: Vec<Vec<Part>> = Vec::new();
    for part in parts {
        match groups.iter_mut().find(|group| same_times(&group[0].content.seconds, &part.content.seconds)) {
            Some(group) => group.push(part),
            None => groups.push(vec![part]),
        }
    }
    let mut found = Vec::new();
    for group in groups {
        check_group(&group, held, settings)?;
        let own = moving.iter().filter(|part| same_times(&part.content.seconds, &group[0].content.seconds)).map(|part| part.path.clone());
        let own: Vec<PathBuf> = own.collect();
        if let (true, Some(part)) = (own.is_empty(), moving.first()) {
            let what = format!(
                "its heights are of {}, the velocities of {} of {}: heights that change must have the same times",
                part.content.when,
                group[0].path.display(),
                group[0].content.when
            );
            return Err(SourceError::file(&part.path, what));
        }
        found.push(group.into_iter().map(|part| part.path).chain(own).chain(helpers.iter().cloned()).collect());
    }
    Ok(Some(found))
}

/// Refuses a group that lacks a component, or has one twice.
fn check_group(group: &[Part], held: [bool; 3], settings: &ArchiveSettings) -> Result<(), SourceError> {
    for k in 0..3 {
        let with: Vec<&Part> = group.iter().filter(|part| part.content.components[k]).collect();
        let (first, name) = (&group[0], NAMES[k]);
        match with[..] {
            [_] => {}
            [] if k == 2 && !held[2] => {}
            [] => {
                let who = if held[k] {
                    format!(
                        "but no file holds {name} at these times ({}): files of all components must have the same times",
                        first.content.when
                    )
                } else {
                    match [&settings.u, &settings.v, &settings.w][k] {
                        Some(named) => format!("but no file holds {name}: none has the variable `{named}` that archive.{name} names"),
                        None => format!("but no file holds {name}: name its files too"),
                    }
                };
                return Err(SourceError::file(&first.path, format!("it holds {}, {who}", first.holds())));
            }
            [one, other, ..] => {
                let what = format!("both hold {name} at the same times ({}): name one of them", one.content.when);
                return Err(SourceError::Mixed { first: one.path.clone(), second: other.path.clone(), what });
            }
        }
    }
    Ok(())
}

/// True if times are the same, up to the rounding of other units.
fn same_times(a: &[f64], b: &[f64]) -> bool {
    let slack = a.iter().chain(b).fold(0.0f64, |m, t| m.max(t.abs())) * 1e-9;
    a.len() == b.len() && a.iter().zip(b).all(|(a, b)| (a - b).abs() <= slack)
}

/// Opens the files of a group as one.
///
/// # Errors
/// A file that cannot be read; coordinates of one name that differ.
pub fn open_group(group: &[PathBuf], limits: Limits) -> Result<DataFile, SourceError> {
    let files = group.iter().map(|path| DataFile::open(path, None, limits)).collect::<Result<Vec<_>, _>>()?;
    let mut files = files.into_iter();
    let Some(mut whole) = files.next() else { return Err(SourceError::NoFiles) };
    for other in files {
        check_coordinates(&whole, &other)?;
        whole = whole.join(other);
    }
    Ok(whole)
}

/// Refuses rows of coordinates that have one name and length and differ.
fn check_coordinates(a: &DataFile, b: &DataFile) -> Result<(), SourceError> {
    let row = |file: &DataFile, i: usize| {
        let variable = &file.listing.variables[i];
        (variable.number.is_number() && variable.dimensions.len() == 1).then(|| file.listing.shape(variable))
    };
    for (j, variable) in b.listing.variables.iter().enumerate() {
        let Some(i) = a.listing.find(&variable.name) else { continue };
        if row(a, i).is_none() || row(a, i) != row(b, j) {
            continue;
        }
        // Times are compared in seconds.
        let kind = classify(variable);
        if kind == Kind::Time {
            continue;
        }
        let (one, other) = (a.read_all(i)?, b.read_all(j)?);
        // A mesh may count heights, and the fields on it depths.
        let sign = if kind == Kind::Level && one.iter().zip(&other).all(|(x, y)| *x == -y) { -1.0 } else { 1.0 };
        let same = |x: f64, y: f64| x == sign * y || (x.is_nan() && y.is_nan());
        if let Some(k) = one.iter().zip(&other).position(|(x, y)| !same(*x, *y)) {
            let what = format!(
                "entry {k} of `{}` is {} and {}; components in files of their own lie on one grid",
                variable.name, one[k], other[k]
            );
            return Err(SourceError::Mixed { first: path(a), second: path(b), what });
        }
    }
    Ok(())
}

fn path(file: &DataFile) -> PathBuf {
    let path: &Path = &file.listing.path;
    path.to_owned()
}
