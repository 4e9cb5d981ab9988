//! `ridgewatch clean`.

use super::common::{Common, print_json, print_text, refuse_settings};
use super::messages;
use anyhow::Result;
use ridgewatch_wire::{Cleaned, Leftover, WireError, clean, find_rings, leftovers, ring_from_environment};
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

/// Folder below which rings are looked for.
const SHARED_MEMORY: &str = "/dev/shm";

/// Options of `clean`.
#[derive(Debug, clap::Args)]
pub struct Options {
    /// Ring folders; by default that of the environment variable RIDGEWATCH_RING, and all of this user below /dev/shm.
    #[arg(value_name = "RING")]
    rings: Vec<PathBuf>,
    /// Only list what would be removed.
    #[arg(long)]
    dry_run: bool,
}

/// Removes what no living process holds.
pub fn run(common: &Common, options: &Options) -> Result<()> {
    refuse_settings(common, "clean", "RING, --dry-run")?;
    let mut rings = options.rings.clone();
    if rings.is_empty() {
        rings = find_rings(Path::new(SHARED_MEMORY));
        rings.extend(ring_from_environment().filter(|ring| !rings.contains(ring)));
    }
    let (mut results, mut failed) = (Vec::new(), None);
    for ring in rings {
        match if options.dry_run { leftovers(&ring) } else { clean(&ring) } {
            Ok(found) => results.push((ring, found)),
            // Its last process has removed it.
            Err(WireError::Io { source, .. }) if source.kind() == ErrorKind::NotFound => {}
            // The other folders are cleaned nevertheless.
            Err(error) => {
                if let Some(earlier) = failed.replace(error) {
                    messages::note(earlier);
                }
            }
        }
    }
    if common.json {
        print_json(&results.iter().map(|(ring, found)| report(ring, found)).collect::<Vec<_>>())?;
    } else {
        results.iter().for_each(|(ring, found)| describe(ring, found, options.dry_run));
        let is_empty = |found: &Cleaned| found.leftovers.is_empty() && found.living.is_empty() && !found.followed;
        if failed.is_none() && results.iter().all(|(_, found)| is_empty(found)) {
            print_text("nothing to remove");
        }
    }
    failed.map_or(Ok(()), |error| Err(error.into()))
}

fn report(ring: &Path, found: &Cleaned) -> serde_json::Value {
    let file = |file: &Leftover| serde_json::json!({ "path": file.path, "bytes": file.bytes });
    let files: Vec<_> = found.leftovers.iter().map(file).collect();
    serde_json::json!({ "ring": ring, "leftovers": files, "living": found.living, "followed": found.followed })
}

fn describe(ring: &Path, found: &Cleaned, dry_run: bool) {
    let action = if dry_run { "would remove" } else { "removed" };
    for Leftover { path, bytes } in &found.leftovers {
        print_text(format_args!("{action} {} ({bytes} bytes)", path.display()));
    }
    if !found.living.is_empty() {
        print_text(format_args!("kept {}: its solver publishes ({} blocks)", ring.display(), found.living.len()));
    }
    if found.followed {
        print_text(format_args!("kept {}: it is followed, and its last follower removes what is left", ring.display()));
    }
}
