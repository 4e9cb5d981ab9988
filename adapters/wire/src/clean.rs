//! Files that no living process holds: rings of solvers that ended or were killed, and the locks of followers that were killed.

use crate::lock::{Unfollowed, blocks, is_followed, producer_lives};
use crate::map::allocated;
use crate::private::check_folder;
use crate::{WireError, block_path, followers_path, lock_path, part_path};
use std::path::{Path, PathBuf};

/// Most entries of a folder that are examined when rings are looked for.
const ENTRIES: usize = 1 << 16;
/// Levels of folders below the one in which rings are looked for.
const DEPTH: usize = 3;

/// A file of a ring that no living process holds.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Leftover {
    /// The file.
    pub path: PathBuf,
    /// Memory that it occupies, bytes.
    pub bytes: u64,
}

/// What was found in a ring's folder.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Cleaned {
    /// Files that nobody holds; [`clean`] has removed them. Empty if the ring has followers, which may still read the steps of a solver that has ended.
    pub leftovers: Vec<Leftover>,
    /// Blocks whose producers live.
    pub living: Vec<u32>,
    /// True if the ring has followers.
    pub followed: bool,
}

fn leftover(path: PathBuf) -> Option<Leftover> {
    let about = std::fs::symlink_metadata(&path).ok()?;
    Some(Leftover { bytes: allocated(&about), path })
}

/// Looks for what no living process holds in a ring's folder, and changes nothing.
///
/// # Errors
/// The folder does not exist or does not belong to this user alone, or a lock cannot be examined.
pub fn leftovers(ring: &Path) -> Result<Cleaned, WireError> {
    check_folder(ring)?;
    let mut found = Cleaned { followed: is_followed(ring), ..Cleaned::default() };
    for block in blocks(ring) {
        if producer_lives(ring, block)? {
            found.living.push(block);
        } else if !found.followed {
            let files = [block_path(ring, block), part_path(ring, block), lock_path(ring, block)];
            found.leftovers.extend(files.into_iter().filter_map(leftover));
        }
    }
    if !found.followed {
        found.leftovers.extend(leftover(followers_path(ring)));
    }
    Ok(found)
}

/// Removes what no living process holds from a ring's folder, and the folder if nothing is left in it.
///
/// # Errors
/// Those of [`leftovers`].
pub fn clean(ring: &Path) -> Result<Cleaned, WireError> {
    let mut found = leftovers(ring)?;
    // Otherwise any empty folder would be removed.
    if found.leftovers.is_empty() {
        return Ok(found);
    }
    match Unfollowed::take(ring)? {
        Some(alone) => alone.clean(ring),
        // A follower came meanwhile.
        None => found.followed = true,
    }
    // Somebody may have taken a name meanwhile.
    found.leftovers.retain(|file| !file.path.exists());
    Ok(found)
}

/// Folders of this user's rings below a folder, such as /dev/shm, in order of their names.
pub fn find_rings(below: &Path) -> Vec<PathBuf> {
    let (mut rings, mut folders) = (Vec::new(), vec![(below.to_owned(), 0)]);
    let mut left = ENTRIES;
    while let Some((folder, depth)) = folders.pop() {
        if depth > 0 && (blocks(&folder).next().is_some() || followers_path(&folder).exists()) {
            rings.push(folder.clone());
        }
        if depth == DEPTH {
            continue;
        }
        for entry in std::fs::read_dir(&folder).into_iter().flatten().flatten().take(left) {
            left -= 1;
            // No link, and nothing of another user.
            if entry.file_type().is_ok_and(|kind| kind.is_dir()) && check_folder(&entry.path()).is_ok() {
                folders.push((entry.path(), depth + 1));
            }
        }
    }
    rings.sort();
    rings
}
