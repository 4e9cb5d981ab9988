//! Snapshots that come while an archive is read: in files that grow, and in new files of the same folders and patterns.

use super::archive::{Archive, ArchiveFile, Place, open_next};
use super::files::expand;
use super::group::{Group, grouped};
use crate::error::SourceError;
use crate::formats::{is_store, is_url};
use crate::grids::{ComponentPlan, Layout, TimePlan, difference};
use crate::snapshots::{News, SnapshotSource};
use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

/// Looks after which a file that changes at each of them is told.
const RESTLESS: u32 = 60;

/// Length of a file and time of its last change.
pub(super) type Stamp = (u64, Option<SystemTime>);

/// What is known of the files of an archive that is followed.
#[derive(Default)]
pub(super) struct Followed {
    paths: Vec<PathBuf>,
    /// As the files were when they were read, or refused.
    as_read: HashMap<PathBuf, Stamp>,
    /// As changed files were at the last look, and how many looks in a row they have changed.
    last_look: HashMap<PathBuf, (Stamp, u32)>,
    /// Files that had settled when groups were made last.
    grouped: HashSet<PathBuf>,
    warned: HashSet<String>,
}

fn stamp(path: &Path) -> Option<Stamp> {
    path.metadata().ok().map(|found| (found.len(), found.modified().ok()))
}

/// Files as they are; `None` for what is not there, and for URLs.
pub(super) fn stamps(group: &Group) -> Vec<Option<Stamp>> {
    group.iter().map(|path| stamp(path)).collect()
}

impl Followed {
    /// Files as they are before they are read.
    ///
    /// # Errors
    /// Stores and URLs, of which no change can be told.
    pub(super) fn stamps(files: &[PathBuf]) -> Result<HashMap<PathBuf, Stamp>, SourceError> {
        if let Some(store) = files.iter().find(|path| is_url(path) || is_store(path)) {
            let found = format!("given, but {} is a Zarr store", store.display());
            return Err(SourceError::setting("follow", found, "with files: a store shows no sign that a snapshot is complete"));
        }
        Ok(files.iter().filter_map(|path| Some((path.clone(), stamp(path)?))).collect())
    }

    /// Looks at these files, folders and patterns, whose files were read as they are in `as_read`.
    pub(super) fn watching(self: Box<Self>, paths: Vec<PathBuf>, as_read: HashMap<PathBuf, Stamp>) -> Box<Self> {
        Box::new(Self { paths, as_read, ..*self })
    }

    /// Files that are new or have changed, and have been as they are since the last look: no one writes to them.
    fn settled(&mut self, files: &[PathBuf], news: &mut News) -> HashSet<PathBuf> {
        let mut settled = HashSet::new();
        for path in files {
            let Some(now) = stamp(path).filter(|now| self.as_read.get(path) != Some(now)) else { continue };
            if is_url(path) || is_store(path) {
                self.warn(news, format!("{}: a Zarr store is not followed, and not read", path.display()));
                continue;
            }
            let changes = match self.last_look.get(path) {
                Some((last, _)) if *last == now => {
                    settled.insert(path.clone());
                    continue;
                }
                Some((_, changes)) => changes + 1,
                None => 1,
            };
            self.last_look.insert(path.clone(), (now, changes));
            if changes == RESTLESS {
                self.warn(news, format!("{}: it is written to all the time, and read once it rests for a second", path.display()));
            }
        }
        settled
    }

    /// These are looked at again only after they have changed.
    fn mark_read(&mut self, group: &Group) {
        for path in group {
            if let Some((stamp, _)) = self.last_look.remove(path) {
                self.as_read.insert(path.clone(), stamp);
            }
        }
    }

    /// Tells what has not been told before.
    fn warn(&mut self, news: &mut News, what: String) {
        if self.warned.insert(what.clone()) {
            tracing::warn!("{what}");
            news.warnings.push(what);
        }
    }
}

impl Archive {
    /// Looks for snapshots that have come since the archive was opened, or since the last look. Those of a file are taken once it has stayed as it is
    /// from one look to the next.
    pub(super) fn look_for_news(&mut self) -> News {
        let mut news = News::default();
        let Some(mut followed) = self.followed.take() else { return news };
        // An open file shows what it held when it was opened.
        self.open = None;
        let before = self.times.len();
        match expand(&followed.paths) {
            Ok(files) => self.take_settled(&files, &mut followed, &mut news),
            Err(error) => followed.warn(&mut news, format!("the files cannot be listed now: {error}")),
        }
        news.dates = self.times[before..].iter().map(|&time| (time, self.date(time))).collect();
        self.followed = Some(followed);
        news
    }

    fn take_settled(&mut self, files: &[PathBuf], followed: &mut Followed, news: &mut News) {
        let settled = followed.settled(files, news);
        if settled.is_empty() || settled == followed.grouped {
            return;
        }
        let mut planned = Vec::new();
        let mut tried_again = HashSet::new();
        for group in self.changed_groups(files, &settled, followed, news) {
            let before = stamps(&group);
            match self.plan_group(&group) {
                // Someone writes to them again.
                _ if stamps(&group) != before => {
                    tried_again.extend(group);
                    continue;
                }
                Ok(layout) => {
                    let plan = ArchiveFile { path: group[0].clone(), group: group.clone(), frames: layout.frames, stamps: before };
                    planned.push((plan, layout.time));
                }
                // Its lock may end without a change.
                Err(error) if error.is_locked() => {
                    followed.warn(news, format!("not read yet: {error}"));
                    tried_again.extend(group);
                    continue;
                }
                Err(error) => followed.warn(news, format!("not read, until it changes: {error}")),
            }
            followed.mark_read(&group);
        }
        // What waits for a partner is not grouped again until something changes.
        followed.grouped =
            settled.into_iter().filter(|path| followed.last_look.contains_key(path) && !tried_again.contains(path)).collect();
        for (path, late) in self.append(planned) {
            followed.warn(news, format!("{}: {late} of its times lie before the newest that was read: they are left out", path.display()));
        }
    }

    /// Groups of files of which one has settled and none is being written.
    fn changed_groups(&self, files: &[PathBuf], settled: &HashSet<PathBuf>, followed: &mut Followed, news: &mut News) -> Vec<Group> {
        let quiet = |path: &PathBuf, followed: &Followed| settled.contains(path) || !followed.last_look.contains_key(path);
        let all = if self.files.iter().any(|file| file.group.len() > 1) {
            // What is being written may be no file yet.
            let quiet: Vec<PathBuf> = files.iter().filter(|path| quiet(path, followed)).cloned().collect();
            match grouped(&quiet, &self.settings) {
                Ok(Some(groups)) => groups,
                Ok(None) => {
                    let names: Vec<String> = settled.iter().map(|path| path.display().to_string()).collect();
                    followed.warn(news, format!("not read yet: among {} is a file that is not understood", names.join(", ")));
                    Vec::new()
                }
                // A partner may come later.
                Err(error) => {
                    followed.warn(news, format!("not read yet: {error}"));
                    Vec::new()
                }
            }
        } else {
            files.iter().map(|path| vec![path.clone()]).collect()
        };
        let changed = |group: &Group| group.iter().any(|path| settled.contains(path)) && group.iter().all(|path| quiet(path, followed));
        all.into_iter().filter(changed).collect()
    }

    fn plan_group(&self, group: &Group) -> Result<Layout, SourceError> {
        let (_, mut layout) = open_next(group, &self.settings, Some(&self.first), None, self.limits)?;
        if let Some(what) = difference(&self.first, &layout) {
            return Err(SourceError::Mixed { first: self.files[0].path.clone(), second: group[0].clone(), what });
        }
        for (component, known) in layout.frames.iter_mut().flat_map(|frame| frame.iter_mut().zip(&self.files[0].frames[0])) {
            give_mask(component, known);
        }
        Ok(layout)
    }

    /// Appends the snapshots behind the newest one, in order of time. Returns the new files of which some lie before it, and how many.
    fn append(&mut self, planned: Vec<(ArchiveFile, TimePlan)>) -> Vec<(PathBuf, usize)> {
        let newest = self.seconds.last().copied().unwrap_or(f64::NEG_INFINITY);
        let (mut entries, mut late): (Vec<(f64, Place)>, Vec<_>) = (Vec::new(), Vec::new());
        for (plan, time) in planned {
            let own = self.files.iter().position(|file| file.group.first() == plan.group.first());
            let file = own.unwrap_or(self.files.len());
            let read = self.places.iter().filter(|place| Some(place.file) == own).count();
            let places = time.places.iter().map(|&(frame, entry)| Place { file, frame, entry });
            let (old, new): (Vec<_>, Vec<_>) = time.seconds.iter().copied().zip(places).partition(|(seconds, _)| *seconds <= newest);
            if old.len() > read {
                late.push((plan.path.clone(), old.len() - read));
            }
            entries.extend(new);
            match own {
                Some(own) => self.files[own] = plan,
                None => self.files.push(plan),
            }
        }
        entries.sort_by(|a, b| a.0.total_cmp(&b.0));
        for (seconds, place) in entries {
            // Two files of one time.
            if self.seconds.last().is_some_and(|last| *last >= seconds) {
                late.push((self.files[place.file].path.clone(), 1));
                continue;
            }
            self.times.push(seconds);
            self.seconds.push(seconds);
            self.places.push(place);
        }
        late
    }
}

/// Points on land are those of the first file.
fn give_mask(component: &mut ComponentPlan, known: &ComponentPlan) {
    let fits = |component: &ComponentPlan| [0, 1, 2].map(|axis| component.along(axis)) == [0, 1, 2].map(|axis| known.along(axis));
    if fits(component) {
        component.mask.clone_from(&known.mask);
    }
}
