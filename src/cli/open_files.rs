//! How many files may be open: each ring takes a descriptor of everybody who follows it, and a relay one for each of its followers besides.

use super::messages;

/// Sixteen followers of a relay beside a thousand blocks.
const MOST: u64 = 1 << 14;

/// Raises what this process may have open (1024 as a rule) as far as it may do so itself. Where the system refuses, that is said.
pub fn allow_many() {
    if let Err(error) = rlimit::increase_nofile_limit(MOST) {
        messages::note(format_args!("the limit of open files stays as it is: {error}"));
    }
}
