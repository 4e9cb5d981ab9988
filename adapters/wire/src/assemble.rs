//! Assembles the blocks of a decomposed domain into steps of the global field.
//!
//! All blocks of one start of a simulation have the same start number (0 if none was given) and the same number of blocks. One start is followed. Blocks of
//! other starts are collected, and the first complete step of another start makes it the followed one. So a simulation may return in other blocks, and blocks
//! of two starts are never joined.
//!
//! Within a start, blocks at the same [`Place`] belong together.

use crate::place::{Place, Rounds};
use crate::{BlockExtent, Description, WireError};
use std::collections::VecDeque;
use std::time::{Duration, Instant};

/// Most known starts: the followed one, and those whose blocks are collected.
const MAX_STARTS: usize = 4;

/// A step of the global field.
#[derive(Debug, Clone, PartialEq)]
pub struct Step {
    /// The solver's number.
    pub step: u64,
    /// The solver's time.
    pub time: f64,
    /// Time when its last block was published, nanoseconds since 1970.
    pub published: u64,
    /// True for the first step after a block was opened: the simulation was started or restarted.
    pub anew: bool,
    /// Components of all nodes, one after another, x fastest.
    pub values: Vec<f32>,
}

/// A step that was abandoned.
#[derive(Debug, Clone, PartialEq)]
pub struct Incomplete {
    /// The solver's number.
    pub step: u64,
    /// The solver's time.
    pub time: f64,
    /// Number of blocks received.
    pub blocks: u32,
    /// Number of blocks of the step.
    pub wanted: u32,
    /// Reason.
    pub why: &'static str,
}

/// Joins blocks to steps.
#[derive(Debug)]
pub struct Assembler {
    /// Description of any block; only the grid is used.
    global: Description,
    /// The followed start, then those whose blocks are collected, in the order in which they appeared.
    starts: VecDeque<Start>,
    /// Incomplete steps, in the order in which they began.
    steps: VecDeque<Pending>,
    pending: usize,
    limit: Duration,
    abandoned: Vec<Incomplete>,
    /// Buffers for reuse.
    spare: Vec<Vec<f32>>,
}

/// Start number and number of blocks.
type StartKey = (u64, u32);

#[derive(Debug)]
struct Start {
    key: StartKey,
    /// By index; `None` until introduced.
    blocks: Vec<Option<Block>>,
    /// Newest step that was completed or abandoned.
    newest: Option<Place>,
    /// The highest round that a block has had.
    round: u64,
    /// True if a block was opened since the last complete step.
    anew: bool,
    /// Number of restarts under this key: each time, a block displaced one of the newest run.
    run: u64,
    /// Time when the first block of that run was opened, nanoseconds since 1970.
    run_opened: u64,
}

#[derive(Debug)]
struct Block {
    generation: u64,
    extent: BlockExtent,
    ended: bool,
    /// The run of its start that it belongs to. A block of an earlier run is about to be opened again.
    run: u64,
    rounds: Rounds,
    /// Time when its last step was published.
    published: Option<u64>,
}

#[derive(Debug)]
struct Pending {
    start: StartKey,
    round: u64,
    step: Step,
    came: Vec<bool>,
    missing: u32,
    since: Instant,
}

impl Pending {
    fn place(&self) -> Place {
        (self.round, self.step.step)
    }
}

impl Block {
    /// The place of the block's next step; `None` if the step was received before, which its time of publication shows. `newest` is the newest round of the
    /// start.
    fn next(&mut self, step: u64, published: u64, newest: u64) -> Option<Place> {
        if self.published.is_some_and(|last| published <= last) {
            return None;
        }
        self.published = Some(published);
        Some(self.rounds.next(step, newest))
    }
}

impl Start {
    fn new(key: StartKey) -> Self {
        Self { key, blocks: (0..key.1).map(|_| None).collect(), newest: None, round: 0, anew: true, run: 0, run_opened: 0 }
    }

    fn block(&self, index: u32, generation: u64) -> Option<&Block> {
        self.blocks.get(index as usize)?.as_ref().filter(|block| block.generation == generation)
    }

    fn is_complete(&self) -> bool {
        self.blocks.iter().all(Option::is_some)
    }

    /// Number of nodes of its blocks, which do not overlap.
    fn covered(&self) -> u64 {
        self.blocks.iter().flatten().map(|block| block.extent.extent.iter().product::<u64>()).sum()
    }
}

impl Assembler {
    /// For the grid of one of the blocks. A step waits for its blocks up to `limit`, and at most `pending` steps wait.
    pub fn new(description: &Description, limit: Duration, pending: usize) -> Self {
        Self {
            global: description.clone(),
            starts: VecDeque::new(),
            steps: VecDeque::new(),
            pending: pending.max(1),
            limit,
            abandoned: Vec::new(),
            spare: Vec::new(),
        }
    }

    /// Introduces a block that a producer has opened. Within its start it displaces its earlier opening and the blocks that it overlaps.
    ///
    /// # Errors
    /// The block has another grid; its steps are ignored. Two more errors leave the block introduced: it displaced a block that has not ended, or all blocks
    /// are known and do not cover the grid.
    pub fn introduce(&mut self, description: &Description, generation: u64) -> Result<(), WireError> {
        let extent = description.block;
        let refuse = |found: String, accepted: &str| Err(WireError::Block { block: extent.index, found, accepted: accepted.into() });
        if !self.global.same_grid(description) {
            return refuse("it has another grid or time unit".into(), "those of the earlier blocks; another grid needs another run");
        }
        let key = (description.start, extent.count);
        let at = match self.starts.iter().position(|start| start.key == key) {
            Some(at) => at,
            None => {
                // The oldest of the collected starts.
                if self.starts.len() == MAX_STARTS
                    && let Some(left) = self.starts.remove(1)
                {
                    self.abandon_if(|p| p.start == left.key, "blocks of later starts were opened");
                }
                self.starts.push_back(Start::new(key));
                self.starts.len() - 1
            }
        };
        let start = &mut self.starts[at];
        let place = extent.index as usize;
        if let Some(known) = start.blocks[place].as_mut().filter(|known| known.generation == generation) {
            // Its connection was restored.
            known.ended = false;
            return Ok(());
        }
        let displaced = |(index, other): (usize, &Option<Block>)| {
            let other = other.as_ref()?;
            (index == place || extent.overlaps(&other.extent)).then_some((index, other.ended))
        };
        let displaced: Vec<(usize, bool)> = start.blocks.iter().enumerate().filter_map(displaced).collect();
        let newest_run = start.run;
        if displaced.iter().any(|(index, _)| start.blocks[*index].as_ref().is_some_and(|other| other.run == newest_run)) {
            (start.run, start.run_opened) = (newest_run + 1, generation);
        }
        // All incomplete steps belong to the earlier run, even those without a displaced block: the other blocks will be opened again too.
        let is_new_run = start.run > newest_run;
        displaced.iter().for_each(|(index, _)| start.blocks[*index] = None);
        let (run, rounds) = (start.run, Rounds::begin(start.round));
        start.blocks[place] = Some(Block { generation, extent, ended: false, run, rounds, published: None });
        let is_before = |p: &Pending| p.start == key && (is_new_run || displaced.iter().any(|(index, _)| p.came[*index]));
        self.abandon_if(is_before, "the simulation was restarted");
        let start = &mut self.starts[at];
        // Its step numbers may begin at 0 again.
        (start.anew, start.newest) = (true, None);
        let covered = start.is_complete().then(|| start.covered());
        if let Some((other, _)) = displaced.iter().find(|(index, ended)| *index != place && !ended) {
            return refuse(
                format!("it overlaps block {other}, which has not ended and is ignored from now on"),
                "blocks that do not overlap (without ghost cells)",
            );
        }
        let nodes = self.global.shape().iter().product::<u64>();
        match covered {
            Some(covered) if covered != nodes => {
                refuse(format!("all blocks together have {covered} of {nodes} nodes"), "blocks that cover the grid")
            }
            _ => Ok(()),
        }
    }

    /// Adds one block of a step, and returns the step if it is complete. If one block is the whole field, its values are moved out of `values`, which gets
    /// another buffer. Returns `None` for blocks that were not introduced or are not followed any more, for steps that were received before, and for steps of
    /// an earlier run if another block of the newest run was opened already.
    ///
    /// # Errors
    /// A wrong number of values, or a time that differs from that of the step's other blocks.
    pub fn block(
        &mut self,
        block: u32,
        generation: u64,
        step: u64,
        time: f64,
        published: u64,
        values: &mut Vec<f32>,
    ) -> Result<Option<Step>, WireError> {
        let refuse = |found: String, accepted: &str| Err(WireError::Block { block, found, accepted: accepted.into() });
        let found = self.starts.iter().enumerate().find_map(|(at, start)| Some((at, start.block(block, generation)?.extent)));
        let Some((at, extent)) = found else { return Ok(None) };
        let (shape, components) = (self.global.shape(), self.global.components());
        let nodes = extent.extent.iter().product::<u64>() as usize;
        if values.len() != nodes * components {
            return refuse(format!("{} values", values.len()), &format!("{} values", nodes * components));
        }
        let start = &mut self.starts[at];
        let (key, newest) = (start.key, start.newest);
        let Some(known) = start.blocks[block as usize].as_mut() else { return Ok(None) };
        if known.run < start.run {
            // A remainder of the earlier run, unless this block continues while another was opened again.
            if published <= start.run_opened {
                return Ok(None);
            }
            known.run = start.run;
        }
        let Some((round, _)) = known.next(step, published, newest.map_or(0, |(round, _)| round)) else { return Ok(None) };
        start.round = start.round.max(round);
        // Steps before the newest complete one are ignored.
        if newest.is_some_and(|newest| (round, step) <= newest) {
            return Ok(None);
        }
        if key.1 == 1 {
            let values = std::mem::replace(values, self.spare.pop().unwrap_or_default());
            return Ok(Some(self.complete(at, round, Step { step, time, published, anew: false, values })));
        }
        let place = match self.steps.iter().position(|p| p.start == key && p.place() == (round, step)) {
            Some(place) => place,
            None => {
                if self.steps.len() >= self.pending {
                    let least = self.steps.iter().position(|p| self.is_hopeless(p)).unwrap_or(0);
                    self.steps.remove(least).into_iter().for_each(|old| self.abandon(old, "newer steps arrived"));
                }
                let mut whole = self.spare.pop().unwrap_or_default();
                whole.resize(shape.iter().product::<u64>() as usize * components, f32::NAN);
                self.steps.push_back(Pending {
                    start: key,
                    round,
                    step: Step { step, time, published, anew: false, values: whole },
                    came: vec![false; key.1 as usize],
                    missing: key.1,
                    since: Instant::now(),
                });
                self.steps.len() - 1
            }
        };
        let pending = &mut self.steps[place];
        if pending.step.time != time {
            return refuse(format!("step {step} is at time {time}"), &format!("{}, the time of its other blocks", pending.step.time));
        }
        put(&mut pending.step.values, shape, values, &extent, components);
        pending.step.published = pending.step.published.max(published);
        if !std::mem::replace(&mut pending.came[block as usize], true) {
            pending.missing -= 1;
        }
        if pending.missing > 0 {
            return Ok(None);
        }
        let Some(pending) = self.steps.remove(place) else { return Ok(None) };
        if self.starts[at].covered() != shape.iter().product::<u64>() {
            self.abandon(pending, "its blocks do not cover the grid");
            return Ok(None);
        }
        Ok(Some(self.complete(at, round, pending.step)))
    }

    /// Completes a step of the start at an index, and abandons earlier steps and starts.
    fn complete(&mut self, at: usize, round: u64, mut step: Step) -> Step {
        let left: Vec<StartKey> = self.starts.drain(..at).map(|start| start.key).collect();
        self.abandon_if(|p| left.contains(&p.start), "the simulation was restarted");
        // Older steps would be out of order.
        let key = self.starts[0].key;
        let place = (round, step.step);
        self.abandon_if(|p| p.start == key && p.place() < place, "a newer step was complete before it");
        let start = &mut self.starts[0];
        start.newest = start.newest.max(Some(place));
        step.anew = std::mem::take(&mut start.anew);
        step
    }

    /// Returns true if a block is so far ahead of others that its next step would displace one that may still become complete.
    pub fn is_ahead(&self, block: u32, generation: u64) -> bool {
        if self.steps.len() + 1 < self.pending {
            return false;
        }
        let Some(start) = self.starts.iter().find(|start| start.block(block, generation).is_some()) else { return false };
        let waits = |p: &&Pending| p.start == start.key && p.came[block as usize] && !self.is_hopeless(p);
        self.steps.iter().filter(waits).count() + 1 >= self.pending
    }

    /// Returns true if a missing block of a step has ended or has reached a later step. Blocks that are about to be opened again do not count.
    fn is_hopeless(&self, pending: &Pending) -> bool {
        let Some(start) = self.starts.iter().find(|start| start.key == pending.start) else { return true };
        let lacks = pending.came.iter().zip(&start.blocks).filter(|(came, _)| !**came).filter_map(|(_, block)| block.as_ref());
        lacks.filter(|block| block.run == start.run).any(|block| block.ended || block.rounds.last() > Some(pending.place()))
    }

    /// The steps that were abandoned since the last call.
    pub fn incomplete(&mut self) -> Vec<Incomplete> {
        std::mem::take(&mut self.abandoned)
    }

    /// Abandons the steps that have waited longer than the limit. To be called only after all available blocks were added.
    pub fn expire(&mut self) {
        let limit = self.limit;
        self.abandon_if(|p| p.since.elapsed() > limit, "blocks did not arrive in time");
    }

    /// Excludes a time in which no block was taken on purpose from the limit.
    pub fn held(&mut self, time: Duration) {
        self.steps.iter_mut().for_each(|pending| pending.since += time);
    }

    /// Records that a producer has closed a block or its process has ended. Returns true if the simulation has ended: all blocks of the followed start are
    /// known, and no block of any start lives.
    pub fn ended(&mut self, block: u32, generation: u64) -> bool {
        for start in &mut self.starts {
            if let Some(known) = start.blocks.get_mut(block as usize).and_then(Option::as_mut).filter(|b| b.generation == generation) {
                known.ended = true;
            }
        }
        self.starts.front().is_some_and(Start::is_complete) && self.starts.iter().flat_map(|s| &s.blocks).flatten().all(|b| b.ended)
    }

    /// Returns a buffer for reuse.
    pub fn recycle(&mut self, values: Vec<f32>) {
        if self.spare.len() < 2 {
            self.spare.push(values);
        }
    }

    fn abandon_if(&mut self, is: impl Fn(&Pending) -> bool, why: &'static str) {
        while let Some(place) = self.steps.iter().position(&is) {
            if let Some(old) = self.steps.remove(place) {
                self.abandon(old, why);
            }
        }
    }

    fn abandon(&mut self, old: Pending, why: &'static str) {
        let wanted = old.start.1;
        // Its other blocks are ignored from now on.
        if let Some(start) = self.starts.iter_mut().find(|start| start.key == old.start) {
            start.newest = start.newest.max(Some(old.place()));
        }
        self.abandoned.push(Incomplete { step: old.step.step, time: old.step.time, blocks: wanted - old.missing, wanted, why });
        self.recycle(old.step.values);
    }
}

/// Copies a block's values into the global field.
fn put(to: &mut [f32], shape: [u64; 3], from: &[f32], block: &BlockExtent, components: usize) {
    let [sx, sy, sz] = shape.map(|n| n as usize);
    let [ox, oy, oz] = block.offset.map(|n| n as usize);
    let [ex, ey, ez] = block.extent.map(|n| n as usize);
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
