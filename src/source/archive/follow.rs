//! Snapshots that come while an archive is read: in files that grow, and in new files of the same folders and patterns.

use super::archive::{Archive, ArchiveFile, Place, open_next};
use super::files::expand;
use super::group::{Group, grouped};
use crate::archive_settings::ArchiveSettings;
use crate::error::SourceError;
use crate::formats::{is_store, is_url};
use crate::grids::{ComponentPlan, Layout, difference};
use crate::snapshots::News;
use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

/// Length of a file and time of its last change.
type Stamp = (u64, Option<SystemTime>);

/// What is known of the files of an archive that is followed.
pub(super) struct Followed {
    paths: Vec<PathBuf>,
    settings: ArchiveSettings,
    /// Layout of the first file.
    first: Layout,
    /// As the files were when they were read, or refused.
    known: HashMap<PathBuf, Stamp>,
    /// As changed files were when they were looked at last.
    seen: HashMap<PathBuf, Stamp>,
    told: HashSet<String>,
}

fn stamp(path: &Path) -> Option<Stamp> {
    path.metadata().ok().map(|found| (found.len(), found.modified().ok()))
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

    pub(super) fn new(paths: Vec<PathBuf>, settings: &ArchiveSettings, first: Layout, known: HashMap<PathBuf, Stamp>) -> Self {
        Self { paths, settings: settings.clone(), first, known, seen: HashMap::new(), told: HashSet::new() }
    }

    /// Files that are new or have changed, and have been as they are since the last look: no one writes to them.
    fn settled(&mut self, files: &[PathBuf]) -> HashSet<PathBuf> {
        let mut settled = HashSet::new();
        for path in files {
            let Some(now) = stamp(path).filter(|now| self.known.get(path) != Some(now)) else { continue };
            if self.seen.insert(path.clone(), now) == Some(now) {
                settled.insert(path.clone());
            }
        }
        settled
    }

    /// Files that were read or refused are looked at again only after they have changed.
    fn done(&mut self, group: &Group) {
        for path in group {
            if let Some(stamp) = self.seen.remove(path) {
                self.known.insert(path.clone(), stamp);
            }
        }
    }

    /// Tells what has not been told before.
    fn tell(&mut self, news: &mut News, what: String) {
        if self.told.insert(what.clone()) {
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
        let before = self.times.len();
        // A folder that cannot be listed now may be at the next look.
        if let Ok(files) = expand(&followed.paths) {
            let settled = followed.settled(&files);
            if !settled.is_empty() {
                for group in self.changed_groups(&files, &settled, &mut followed, &mut news) {
                    match self.take(&group, &followed) {
                        Ok(0) => {}
                        Ok(late) => {
                            let name = group[0].display();
                            followed.tell(
                                &mut news,
                                format!("{name}: {late} of its times lie before the newest that was read: they are left out"),
                            );
                        }
                        Err(error) => followed.tell(&mut news, format!("not read, until it changes: {error}")),
                    }
                    followed.done(&group);
                }
            }
        }
        news.times = self.times[before..].to_vec();
        self.followed = Some(followed);
        news
    }

    /// Groups of files of which one has settled and none is being written.
    fn changed_groups(&self, files: &[PathBuf], settled: &HashSet<PathBuf>, followed: &mut Followed, news: &mut News) -> Vec<Group> {
        let all = if self.files.iter().any(|file| file.group.len() > 1) {
            match grouped(files, &followed.settings) {
                Ok(Some(groups)) => groups,
                Ok(None) => Vec::new(),
                // A partner may come later.
                Err(error) => {
                    followed.tell(news, format!("not read yet: {error}"));
                    Vec::new()
                }
            }
        } else {
            files.iter().map(|path| vec![path.clone()]).collect()
        };
        let quiet = |path: &PathBuf| settled.contains(path) || !followed.seen.contains_key(path);
        all.into_iter().filter(|group| group.iter().any(|path| settled.contains(path)) && group.iter().all(quiet)).collect()
    }

    /// Takes the snapshots of a group of files behind the newest one. Returns how many of a new group lie before it.
    fn take(&mut self, group: &Group, followed: &Followed) -> Result<usize, SourceError> {
        let (_, mut layout) = open_next(group, &followed.settings, Some(&followed.first), None, self.limits)?;
        if let Some(what) = difference(&followed.first, &layout) {
            return Err(SourceError::Mixed { first: self.files[0].path.clone(), second: group[0].clone(), what });
        }
        for (component, known) in layout.frames.iter_mut().flat_map(|frame| frame.iter_mut().zip(&self.files[0].frames[0])) {
            give_mask(component, known);
        }
        let own = self.files.iter().position(|file| file.group.first() == group.first());
        let file = own.unwrap_or(self.files.len());
        let newest = self.seconds.last().copied().unwrap_or(f64::NEG_INFINITY);
        let mut entries: Vec<(f64, Place)> = (layout.time.seconds.iter().copied())
            .zip(layout.time.places.iter().map(|&(frame, entry)| Place { file, frame, entry }))
            .collect();
        let read = self.places.iter().filter(|place| Some(place.file) == own).count();
        entries.sort_by(|a, b| a.0.total_cmp(&b.0));
        let late = entries.iter().filter(|(seconds, _)| *seconds <= newest).count();
        entries.retain(|(seconds, _)| *seconds > newest);
        let plan = ArchiveFile { path: group[0].clone(), group: group.clone(), frames: layout.frames };
        match own {
            Some(own) => self.files[own] = plan,
            None => self.files.push(plan),
        }
        // What is open may be the file as it was.
        self.open = None;
        for (seconds, place) in entries {
            self.times.push(if self.is_counted() { self.times.len() as f64 } else { seconds });
            self.seconds.push(seconds);
            self.places.push(place);
        }
        Ok(late.saturating_sub(read))
    }
}

/// Points on land are those of the first file.
fn give_mask(component: &mut ComponentPlan, known: &ComponentPlan) {
    let fits = |component: &ComponentPlan| [0, 1, 2].map(|axis| component.along(axis)) == [0, 1, 2].map(|axis| known.along(axis));
    if fits(component) {
        component.mask.clone_from(&known.mask);
    }
}
