//! Blocks of a decomposed domain become steps of the global field.
//!
//! The blocks of one start of a simulation name the same start (0 where they name none) and the same number of blocks. One start is followed; blocks
//! of another gather beside it, and its first whole step takes over. So a simulation may come back in other blocks, and what two starts
//! have published is never put together.
//!
//! Within a start what is at one [`Place`] belongs together.

use crate::place::{Place, Rounds};
use crate::{BlockExtent, Description, WireError};
use std::collections::VecDeque;
use std::time::{Duration, Instant};

/// Starts that are known at once: the one that is followed, and those that gather.
const STARTS: usize = 4;

/// A step of the global field.
#[derive(Debug, Clone, PartialEq)]
pub struct Step {
    /// The solver's number.
    pub step: u64,
    /// Its time.
    pub time: f64,
    /// When its last block was published, nanoseconds since 1970.
    pub published: u64,
    /// The first since a block was opened: the simulation was started, or started anew.
    pub anew: bool,
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

/// Puts blocks together.
#[derive(Debug)]
pub struct Assembler {
    /// Of any block: what counts is its grid.
    global: Description,
    /// First the one that is followed, then those that gather, as they were found.
    starts: VecDeque<Start>,
    /// As they began.
    steps: VecDeque<Pending>,
    pending: usize,
    limit: Duration,
    given_up: Vec<Incomplete>,
    /// Buffers to use again.
    spare: Vec<Vec<f32>>,
}

/// The number that its blocks name, and how many they are.
type StartKey = (u64, u32);

#[derive(Debug)]
struct Start {
    key: StartKey,
    /// By index, once known.
    blocks: Vec<Option<Block>>,
    /// Newest step that was finished or given up.
    newest: Option<Place>,
    /// The highest round of a block, now or before.
    round: u64,
    /// A block was opened since the last whole step.
    anew: bool,
    /// How often the simulation was started anew under this key, as far as the openings show: a block took the place of one of the newest run.
    run: u64,
    /// When the first block of that run was opened, nanoseconds since 1970.
    run_opened: u64,
}

#[derive(Debug)]
struct Block {
    generation: u64,
    extent: BlockExtent,
    ended: bool,
    /// The run of its start that it belongs to. In an earlier one than the newest it is about to be opened anew.
    run: u64,
    rounds: Rounds,
    /// When its last step was published.
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
    /// The place of the block's next step; none where it came before its connection broke: a producer publishes none at the time of another. `newest` is
    /// the round that the start has come to.
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

    /// Nodes of its blocks, which share none.
    fn covered(&self) -> u64 {
        self.blocks.iter().flatten().map(|block| block.extent.extent.iter().product::<u64>()).sum()
    }
}

impl Assembler {
    /// For the grid that one of the blocks describes; a step waits for its blocks for `limit` at most, and at most `pending` steps wait.
    pub fn new(description: &Description, limit: Duration, pending: usize) -> Self {
        Self {
            global: description.clone(),
            starts: VecDeque::new(),
            steps: VecDeque::new(),
            pending: pending.max(1),
            limit,
            given_up: Vec::new(),
            spare: Vec::new(),
        }
    }

    /// Makes a block known that a producer has opened. In its start it takes the place of an earlier opening, and of blocks that it overlaps.
    ///
    /// # Errors
    /// It has another grid: its steps will not be taken. Or, with the block taken in: it took the place of a block that has not ended;
    /// all blocks have come and leave nodes uncovered.
    pub fn introduce(&mut self, description: &Description, generation: u64) -> Result<(), WireError> {
        let extent = description.block;
        let refuse = |found: String, accepted: &str| Err(WireError::Block { block: extent.index, found, accepted: accepted.into() });
        if !self.global.same_grid(description) {
            return refuse("it has another grid or time unit".into(), "that of the blocks before it; another grid needs a run of its own");
        }
        let key = (description.start, extent.count);
        let at = match self.starts.iter().position(|start| start.key == key) {
            Some(at) => at,
            None => {
                // Of those that gather, the oldest.
                if self.starts.len() == STARTS
                    && let Some(left) = self.starts.remove(1)
                {
                    self.give_up_if(|p| p.start == left.key, "blocks of later starts came");
                }
                self.starts.push_back(Start::new(key));
                self.starts.len() - 1
            }
        };
        let start = &mut self.starts[at];
        let place = extent.index as usize;
        if let Some(known) = start.blocks[place].as_mut().filter(|known| known.generation == generation) {
            // The way to it had broken.
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
        // What waits belongs to the run before, also where it has none of the displaced blocks: the others will be opened anew too.
        let is_new_run = start.run > newest_run;
        displaced.iter().for_each(|(index, _)| start.blocks[*index] = None);
        let (run, rounds) = (start.run, Rounds::begin(start.round));
        start.blocks[place] = Some(Block { generation, extent, ended: false, run, rounds, published: None });
        let is_before = |p: &Pending| p.start == key && (is_new_run || displaced.iter().any(|(index, _)| p.came[*index]));
        self.give_up_if(is_before, "the simulation was started anew");
        let start = &mut self.starts[at];
        // Its steps may count from 0 again.
        (start.anew, start.newest) = (true, None);
        let covered = start.is_complete().then(|| start.covered());
        if let Some((other, _)) = displaced.iter().find(|(index, ended)| *index != place && !ended) {
            return refuse(
                format!("it overlaps block {other}, which has not ended and is left out now"),
                "blocks that share no node (leave ghost cells out)",
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

    /// Takes one block of a step in; the whole step when it was the last that was missing. Where one block is the whole field, its values are
    /// taken out of `values`, which gets another buffer, and not copied. Blocks that were not introduced, or are followed no more, give nothing; nor
    /// does what a block published at the same moment as one of its steps that came, or before, or before the run was started of which another block
    /// was opened already.
    ///
    /// # Errors
    /// Another number of values, or another time than the step's other blocks have.
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
            // What the run before has left; unless the block goes on while another was opened anew.
            if published <= start.run_opened {
                return Ok(None);
            }
            known.run = start.run;
        }
        let Some((round, _)) = known.next(step, published, newest.map_or(0, |(round, _)| round)) else { return Ok(None) };
        start.round = start.round.max(round);
        // What came before the newest and is not whole by now will not be asked for.
        if newest.is_some_and(|newest| (round, step) <= newest) {
            return Ok(None);
        }
        if key.1 == 1 {
            let values = std::mem::replace(values, self.spare.pop().unwrap_or_default());
            return Ok(Some(self.whole(at, round, Step { step, time, published, anew: false, values })));
        }
        let place = match self.steps.iter().position(|p| p.start == key && p.place() == (round, step)) {
            Some(place) => place,
            None => {
                if self.steps.len() >= self.pending {
                    let least = self.steps.iter().position(|p| self.is_hopeless(p)).unwrap_or(0);
                    self.steps.remove(least).into_iter().for_each(|old| self.give_up(old, "newer steps came"));
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
            return refuse(
                format!("step {step} is at time {time}"),
                &format!("{}, the time that its other blocks have", pending.step.time),
            );
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
            self.give_up(pending, "its blocks do not cover the grid");
            return Ok(None);
        }
        Ok(Some(self.whole(at, round, pending.step)))
    }

    /// A step of the start at a place is whole: what came before it is given up.
    fn whole(&mut self, at: usize, round: u64, mut step: Step) -> Step {
        let left: Vec<StartKey> = self.starts.drain(..at).map(|start| start.key).collect();
        self.give_up_if(|p| left.contains(&p.start), "the simulation was started anew");
        // Older ones would come out of order.
        let key = self.starts[0].key;
        let place = (round, step.step);
        self.give_up_if(|p| p.start == key && p.place() < place, "a newer step was whole before it");
        let start = &mut self.starts[0];
        start.newest = start.newest.max(Some(place));
        step.anew = std::mem::take(&mut start.anew);
        step
    }

    /// Whether a block has come so far before others that its next step would take the place of one that may still be whole.
    pub fn is_ahead(&self, block: u32, generation: u64) -> bool {
        if self.steps.len() + 1 < self.pending {
            return false;
        }
        let Some(start) = self.starts.iter().find(|start| start.block(block, generation).is_some()) else { return false };
        let waits = |p: &&Pending| p.start == start.key && p.came[block as usize] && !self.is_hopeless(p);
        self.steps.iter().filter(waits).count() + 1 >= self.pending
    }

    /// Whether one of the blocks that a step lacks has come to a later one, or has ended. Of one that is about to be opened anew that says nothing.
    fn is_hopeless(&self, pending: &Pending) -> bool {
        let Some(start) = self.starts.iter().find(|start| start.key == pending.start) else { return true };
        let lacks = pending.came.iter().zip(&start.blocks).filter(|(came, _)| !**came).filter_map(|(_, block)| block.as_ref());
        lacks.filter(|block| block.run == start.run).any(|block| block.ended || block.rounds.last() > Some(pending.place()))
    }

    /// The steps that were given up since the last call.
    pub fn incomplete(&mut self) -> Vec<Incomplete> {
        std::mem::take(&mut self.given_up)
    }

    /// Gives up the steps that have waited longer than the limit: to be called when nothing has come that they may have waited for.
    pub fn expire(&mut self) {
        let limit = self.limit;
        self.give_up_if(|p| p.since.elapsed() > limit, "blocks did not come in time");
    }

    /// For so long nothing was taken on purpose, which does not count as waiting.
    pub fn held(&mut self, time: Duration) {
        self.steps.iter_mut().for_each(|pending| pending.since += time);
    }

    /// A producer has closed a block, or its process ended. Whether the simulation has: all blocks of the start that is followed are known, and none
    /// of any start lives.
    pub fn ended(&mut self, block: u32, generation: u64) -> bool {
        for start in &mut self.starts {
            if let Some(known) = start.blocks.get_mut(block as usize).and_then(Option::as_mut).filter(|b| b.generation == generation) {
                known.ended = true;
            }
        }
        self.starts.front().is_some_and(Start::is_complete) && self.starts.iter().flat_map(|s| &s.blocks).flatten().all(|b| b.ended)
    }

    /// A buffer that is no longer needed, to be used again.
    pub fn recycle(&mut self, values: Vec<f32>) {
        if self.spare.len() < 2 {
            self.spare.push(values);
        }
    }

    fn give_up_if(&mut self, is: impl Fn(&Pending) -> bool, why: &'static str) {
        while let Some(place) = self.steps.iter().position(&is) {
            if let Some(old) = self.steps.remove(place) {
                self.give_up(old, why);
            }
        }
    }

    fn give_up(&mut self, old: Pending, why: &'static str) {
        let wanted = old.start.1;
        // Its other blocks come too late.
        if let Some(start) = self.starts.iter_mut().find(|start| start.key == old.start) {
            start.newest = start.newest.max(Some(old.place()));
        }
        self.given_up.push(Incomplete { step: old.step.step, time: old.step.time, blocks: wanted - old.missing, wanted, why });
        self.recycle(old.step.values);
    }
}

/// Puts a block's values into the global field's.
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
