//! Position of a step in its simulation.
//!
//! Within a start, blocks with the same step number belong together, and the numbers must rise. If a solver is set back within its run, each of its blocks
//! repeats a number or falls below its last one. A new round begins there, and only blocks of one round belong together.

/// Consecutive steps that a block may stay behind the others' round. After that it must have been set back too, at a step that was overwritten unread.
const MAX_BEHIND: u32 = 3;

/// Number of set-backs of the solver before a step, and the step's number.
pub(crate) type Place = (u64, u64);

/// Follows one block's numbers.
#[derive(Debug)]
pub(crate) struct Rounds {
    round: u64,
    /// Number of the block's last step.
    last: Option<u64>,
    /// Consecutive steps of a round before the newest.
    behind: u32,
}

impl Rounds {
    /// For a block whose first step belongs to this round.
    pub fn begin(round: u64) -> Self {
        Self { round, last: None, behind: 0 }
    }

    /// The place of the block's next step. `newest` is the newest round of the other blocks.
    pub fn next(&mut self, step: u64, newest: u64) -> Place {
        self.round += u64::from(self.last.is_some_and(|last| step <= last));
        self.last = Some(step);
        self.behind = if self.round < newest { self.behind + 1 } else { 0 };
        if self.behind > MAX_BEHIND {
            (self.round, self.behind) = (newest, 0);
        }
        (self.round, step)
    }

    /// The place of the block's last step.
    pub fn last(&self) -> Option<Place> {
        self.last.map(|step| (self.round, step))
    }
}
