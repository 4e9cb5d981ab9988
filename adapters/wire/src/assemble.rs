//! Blocks of a decomposed domain become steps of the global field.

use crate::{Description, WireError};
use std::collections::VecDeque;
use std::time::{Duration, Instant};

/// A step of the global field.
#[derive(Debug, Clone, PartialEq)]
pub struct Step {
    /// The solver's number.
    pub step: u64,
    /// Its time.
    pub time: f64,
    /// When its last block was published, nanoseconds since 1970.
    pub published: u64,
    /// Components of all nodes, one behind the other, x fastest.
    pub values: Vec<f32>,
}

/// A step that was given up.
#[derive(Debug, Clone, PartialEq)]
pub struct Incomplete {
    /// The solver's number.
    pub step: u64,
    /// Its time.
    pub time: f64,
    /// Blocks that had come.
    pub blocks: u32,
    /// Blocks wanted.
    pub wanted: u32,
    /// Why.
    pub why: &'static str,
}

/// Puts blocks together. At most `pending` steps are held at once.
#[derive(Debug)]
pub struct Assembler {
    global: Description,
    /// Extents by block, once known.
    blocks: Vec<Option<([u64; 3], [u64; 3])>>,
    steps: VecDeque<Pending>,
    pending: usize,
    limit: Duration,
    /// Newest step that was finished or given up.
    newest: Option<u64>,
    /// Buffers to use again.
    spare: Vec<Vec<f32>>,
}

#[derive(Debug)]
struct Pending {
    step: Step,
    came: Vec<bool>,
    missing: u32,
    since: Instant,
}

impl Assembler {
    /// For the field that one of the blocks describes; a step waits for its blocks for `limit` at most, and at most `pending` steps wait.
    pub fn new(description: &Description, limit: Duration, pending: usize) -> Self {
        let blocks = vec![None; description.block.count as usize];
        Self {
            global: description.clone(),
            blocks,
            steps: VecDeque::new(),
            pending: pending.max(1),
            limit,
            newest: None,
            spare: Vec::new(),
        }
    }

    /// Makes a block known.
    ///
    /// # Errors
    /// It belongs to another field, or overlaps another block, or all have come and leave nodes uncovered.
    pub fn introduce(&mut self, description: &Description) -> Result<(), WireError> {
        let block = description.block;
        let refuse = |found: String, accepted: &str| Err(WireError::Block { block: block.index, found, accepted: accepted.into() });
        if !self.global.same_field(description) {
            return refuse("it describes another field (grid, time unit or number of blocks)".into(), "the field of the other blocks");
        }
        let this = (block.offset, block.extent);
        let overlaps =
            |other: &([u64; 3], [u64; 3])| (0..3).all(|k| this.0[k] < other.0[k] + other.1[k] && other.0[k] < this.0[k] + this.1[k]);
        for (index, other) in self.blocks.iter().enumerate() {
            if index != block.index as usize
                && let Some(other) = other
                && overlaps(other)
            {
                return refuse(format!("it overlaps block {index}"), "blocks that share no node (leave ghost cells out)");
            }
        }
        let known = self.blocks[block.index as usize].replace(this);
        if known.is_some_and(|known| known != this) {
            // Steps that wait hold values of the old place.
            self.steps.clear();
        }
        if self.blocks.iter().all(Option::is_some) {
            let covered: u64 = self.blocks.iter().flatten().map(|(_, extent)| extent.iter().product::<u64>()).sum();
            let nodes = self.global.shape().iter().product::<u64>();
            if covered != nodes {
                self.blocks[block.index as usize] = None;
                return refuse(format!("all blocks together have {covered} of {nodes} nodes"), "blocks that cover the grid");
            }
        }
        Ok(())
    }

    /// Takes one block of a step in; the whole step when it was the last that was missing. Where one block is the whole field, its values are
    /// taken out of `values`, which gets another buffer, and not copied.
    ///
    /// # Errors
    /// An unknown block, another number of values, or another time than the step's other blocks have.
    pub fn block(
        &mut self,
        block: u32,
        step: u64,
        time: f64,
        published: u64,
        values: &mut Vec<f32>,
    ) -> Result<(Option<Step>, Vec<Incomplete>), WireError> {
        let refuse = |found: String, accepted: &str| Err(WireError::Block { block, found, accepted: accepted.into() });
        let Some((offset, extent)) = self.blocks.get(block as usize).copied().flatten() else {
            return refuse("it was not introduced".into(), "a block that described itself");
        };
        let components = self.global.components();
        let nodes = extent.iter().product::<u64>() as usize;
        if values.len() != nodes * components {
            return refuse(format!("{} values", values.len()), &format!("{} values", nodes * components));
        }
        let mut given_up = Vec::new();
        // The newest: what came before it and is not whole by now will not be asked for.
        if self.newest.is_some_and(|newest| step <= newest) {
            return Ok((None, given_up));
        }
        if self.blocks.len() == 1 {
            self.newest = Some(step);
            let values = std::mem::replace(values, self.spare.pop().unwrap_or_default());
            return Ok((Some(Step { step, time, published, values }), given_up));
        }
        let place = match self.steps.iter().position(|p| p.step.step == step) {
            Some(place) => place,
            None => {
                if self.steps.len() >= self.pending
                    && let Some(old) = self.steps.pop_front()
                {
                    given_up.push(self.give_up(old, "newer steps came"));
                }
                let place = self.steps.partition_point(|p| p.step.step < step);
                let shape = self.global.shape();
                let mut whole = self.spare.pop().unwrap_or_default();
                whole.resize(shape.iter().product::<u64>() as usize * components, f32::NAN);
                let count = self.blocks.len();
                let pending = Pending {
                    step: Step { step, time, published, values: whole },
                    came: vec![false; count],
                    missing: count as u32,
                    since: Instant::now(),
                };
                self.steps.insert(place, pending);
                place
            }
        };
        let shape = self.global.shape();
        let pending = &mut self.steps[place];
        if pending.step.time != time {
            return refuse(
                format!("step {step} is at time {time}"),
                &format!("{}, the time that its other blocks have", pending.step.time),
            );
        }
        put(&mut pending.step.values, shape, values, offset, extent, components);
        pending.step.published = pending.step.published.max(published);
        if !std::mem::replace(&mut pending.came[block as usize], true) {
            pending.missing -= 1;
        }
        if pending.missing > 0 {
            return Ok((None, given_up));
        }
        // Older ones would come out of order.
        for old in self.steps.drain(..place).collect::<Vec<_>>() {
            given_up.push(self.give_up(old, "a newer step was whole before it"));
        }
        let whole = self.steps.pop_front().map(|p| p.step);
        self.newest = whole.as_ref().map(|s| s.step).or(self.newest);
        Ok((whole, given_up))
    }

    /// Gives up the steps that have waited longer than the limit.
    pub fn expire(&mut self) -> Vec<Incomplete> {
        let mut given_up = Vec::new();
        while self.steps.front().is_some_and(|p| p.since.elapsed() > self.limit)
            && let Some(old) = self.steps.pop_front()
        {
            given_up.push(self.give_up(old, "blocks did not come in time"));
        }
        given_up
    }

    /// A buffer that is no longer needed, to be used again.
    pub fn recycle(&mut self, values: Vec<f32>) {
        if self.spare.len() < 2 {
            self.spare.push(values);
        }
    }

    /// Forgets steps, after a restart: numbers may begin anew.
    pub fn restart(&mut self) {
        self.steps.clear();
        self.newest = None;
    }

    fn give_up(&mut self, old: Pending, why: &'static str) -> Incomplete {
        self.newest = self.newest.max(Some(old.step.step));
        let wanted = self.blocks.len() as u32;
        let incomplete = Incomplete { step: old.step.step, time: old.step.time, blocks: wanted - old.missing, wanted, why };
        self.recycle(old.step.values);
        incomplete
    }
}

/// Puts a block's values into the global field's.
fn put(to: &mut [f32], shape: [u64; 3], from: &[f32], offset: [u64; 3], extent: [u64; 3], components: usize) {
    let [sx, sy, sz] = shape.map(|n| n as usize);
    let [ox, oy, oz] = offset.map(|n| n as usize);
    let [ex, ey, ez] = extent.map(|n| n as usize);
    let mut rows = from.chunks_exact(ex);
    for c in 0..components {
        for k in 0..ez {
            for j in 0..ey {
                let Some(row) = rows.next() else { return };
                let begin = ((c * sz + oz + k) * sy + oy + j) * sx + ox;
                to[begin..begin + ex].copy_from_slice(row);
            }
        }
    }
}
