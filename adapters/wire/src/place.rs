//! Where a step stands in its simulation.
//!
//! Within a start the step's number says which blocks belong together, and must rise. Where a solver is set back within its run, each of its blocks comes
//! to a number that is not above its last one: there a new round begins, and only what is of one round belongs together.

/// Steps in a row that a block may be behind the others' round. It was set back too, then, and what would have shown it was overwritten unread.
const BEHIND: u32 = 3;

/// How often the solver was set back before a step, and the step's number.
pub(crate) type Place = (u64, u64);

/// Follows one block's numbers.
#[derive(Debug)]
pub(crate) struct Rounds {
    round: u64,
    /// Number of its last step.
    last: Option<u64>,
    /// Steps of a round before the newest, in a row.
    behind: u32,
}

impl Rounds {
    /// Of a block whose first step is of this round.
    pub fn begin(round: u64) -> Self {
        Self { round, last: None, behind: 0 }
    }

    /// The place of the block's next step. `newest` is the round that the others have come to.
    pub fn next(&mut self, step: u64, newest: u64) -> Place {
        self.round += u64::from(self.last.is_some_and(|last| step <= last));
        self.last = Some(step);
        self.behind = if self.round < newest { self.behind + 1 } else { 0 };
        if self.behind > BEHIND {
            (self.round, self.behind) = (newest, 0);
        }
        (self.round, step)
    }
    /// The place of its last step.
    pub fn last(&self) -> Option<Place> {
        self.last.map(|step| (self.round, step))
    }
}
