//! How much of its time training needs: all of it while the loss falls, a sixteenth once the loss has stalled.
//!
//! The loss is compared over the two last quarters of the steps since the labels or the network changed. The comparison thus has no length
//! of its own: a loss that falls as a power of the steps falls as much from one quarter to the next at any time, however slow it has become. A
//! lower learning rate, which the trainer chooses when the loss stands, lets it fall again; that counts as falling.

use crate::surrogate::Learned;
use std::collections::VecDeque;

/// Need while the loss has stalled. New samples are still learned from, and show whether the loss rises.
const LEAST: f64 = 1.0 / 16.0;
/// Steps before which no loss has stalled: four times as many as the trainer takes between two looks at its learning rate.
const FIRST_STEPS: u64 = 2048;
/// Blocks of steps that a quarter needs at least, so that their scatter tells its noise.
const LEAST_BLOCKS: usize = 8;
/// Steps since the change, as a multiple of those of a new block at most.
const PARTS: u64 = 64;
/// Relative change of the loss from one quarter to the next up to which it stands. A mean square that falls as much loses half a decibel
/// each time the steps double.
const SMALL_CHANGE: f64 = 0.05;
/// Standard errors that a fall must exceed to end a stall, so that noise does not.
const SURE: f64 = 3.0;
/// Relative rise of the loss that ends a stall: samples of another region, or of a window to which the network does not generalise.
const RISE: f64 = 0.25;
/// Steps over which the loss is smoothed to see it rise.
const RECENT_STEPS: f64 = 64.0;
/// Seconds of the shortest turn while the loss has stalled: a shorter one may end before its first step, since samples are counted before.
const LEAST_TURN: f64 = 0.01;
/// Seconds that may be due, or made up for, at most.
const MOST_DUE: f64 = 1.0;
/// Share of the domain's volume whose loss of trust ends a stall.
const LOST_TRUST: f64 = 0.1;

/// Mean loss of some steps.
#[derive(Debug, Clone, Copy, Default)]
struct Block {
    steps: u64,
    loss: f64,
}

impl Block {
    fn and(self, other: Self) -> Self {
        let steps = self.steps + other.steps;
        let sum = self.loss * self.steps as f64 + other.loss * other.steps as f64;
        Self { steps, loss: sum / steps.max(1) as f64 }
    }
}

/// A loss that has stopped falling.
#[derive(Debug, Clone, Copy)]
struct Stall {
    /// Its lowest mean over a quarter of the steps.
    loss: f64,
    /// The smoothed loss.
    recent: f64,
    /// Largest share of the domain's volume that was trusted since.
    trusted: f64,
}

/// Judges from the losses of training how much of it is needed.
#[derive(Debug)]
pub(super) struct Need {
    /// Steps since the network or its labels changed.
    steps: u64,
    /// Blocks of at least a part ([`PARTS`]) of the steps each, of the later half of the steps.
    blocks: VecDeque<Block>,
    /// Steps since the last block.
    open: Block,
    stall: Option<Stall>,
    /// Seconds of training that are due; below 0 if the last turns took longer than was due.
    owed: f64,
    /// Seconds of the next turn at least: more after one that was too short for a step.
    least_turn: f64,
}

impl Default for Need {
    fn default() -> Self {
        Self { steps: 0, blocks: VecDeque::new(), open: Block::default(), stall: None, owed: 0.0, least_turn: LEAST_TURN }
    }
}

impl Need {
    /// Factor on the time of training.
    pub(super) fn factor(&self) -> f64 {
        if self.stall.is_some() { LEAST } else { 1.0 }
    }

    /// Forgets all losses, since the network or its labels are others: training needs all of its time.
    pub(super) fn restart(&mut self) {
        *self = Self::default();
    }

    /// Takes in the loss of some steps. Training that lost steps starts again.
    pub(super) fn observe(&mut self, learned: &Learned) {
        let is_lost = learned.rollbacks > 0 || learned.lost_steps > 0;
        if is_lost || learned.loss.is_some_and(|loss| !loss.is_finite()) {
            return self.restart();
        }
        let Some(loss) = learned.loss.filter(|_| learned.steps > 0) else { return };
        if let Some(stall) = &mut self.stall {
            let weight = learned.steps as f64 / (learned.steps as f64 + RECENT_STEPS);
            stall.recent += weight * (loss - stall.recent);
            if stall.recent > (1.0 + RISE) * stall.loss {
                tracing::info!("the loss of training rose from {:.3e} to {:.3e}: training takes all of its time", stall.loss, stall.recent);
                return self.restart();
            }
        }
        self.steps += learned.steps;
        self.open = self.open.and(Block { steps: learned.steps, loss });
        if self.open.steps * PARTS >= self.steps {
            self.blocks.push_back(std::mem::take(&mut self.open));
            self.judge();
        }
    }

    /// Takes in the share of the domain's volume in which the surrogate is trusted.
    pub(super) fn trusts(&mut self, share: f64) {
        let Some(stall) = &mut self.stall else { return };
        stall.trusted = stall.trusted.max(share);
        if share < stall.trusted - LOST_TRUST {
            tracing::info!("trust fell from {:.2} to {share:.2} of the volume: training takes all of its time", stall.trusted);
            self.restart();
        }
    }

    /// Seconds of the next turn of training, of which `due` come with the present frame. While the loss has stalled, turns are left out until
    /// enough is due for one that takes a step.
    pub(super) fn turn(&mut self, due: f64) -> f64 {
        if self.stall.is_none() {
            self.owed = due;
            return due;
        }
        self.owed = (self.owed + due).min(MOST_DUE.max(due));
        if self.owed >= self.least_turn { self.owed } else { 0.0 }
    }

    /// Subtracts the seconds that a turn took for its steps.
    pub(super) fn took(&mut self, seconds: f64, steps: u64) {
        self.owed = (self.owed - seconds).max(-MOST_DUE);
        self.least_turn = if steps > 0 { LEAST_TURN } else { (2.0 * seconds).clamp(LEAST_TURN, MOST_DUE) };
    }

    /// The window has slid, and the labels hold: what is trusted of it shows anew.
    pub(super) fn window_slid(&mut self) {
        if let Some(stall) = &mut self.stall {
            stall.trusted = 0.0;
        }
    }

    /// Compares the last quarter of the steps with the one before. While noise hides whether the loss stands, it has not stalled.
    fn judge(&mut self) {
        let mut held: u64 = self.blocks.iter().map(|block| block.steps).sum();
        while let Some(&Block { steps, .. }) = self.blocks.front()
            && 2 * (held - steps) >= self.steps
        {
            held -= steps;
            self.blocks.pop_front();
        }
        let mut reached = 0;
        let last = self.blocks.iter().rev().take_while(|block| {
            let begins = 4 * reached < self.steps;
            reached += block.steps;
            begins
        });
        let last: Vec<f64> = last.map(|block| block.loss).collect();
        let before: Vec<f64> = self.blocks.iter().rev().skip(last.len()).map(|block| block.loss).collect();
        if self.steps < FIRST_STEPS || last.len().min(before.len()) < LEAST_BLOCKS {
            return;
        }
        let [(before, before_error), (last, last_error)] = [before, last].map(|losses| mean(&losses));
        let (fall, error, small) = (before - last, before_error.hypot(last_error), SMALL_CHANGE * before);
        match &mut self.stall {
            Some(_) if fall > small.max(SURE * error) => self.stall = None,
            Some(stall) => stall.loss = stall.loss.min(last),
            None if fall.abs() + error <= small => {
                tracing::info!("training stalled at a loss of {last:.3e} after {} steps: it takes {LEAST} of its time", self.steps);
                self.stall = Some(Stall { loss: last, recent: last, trusted: 0.0 });
            }
            None => {}
        }
    }
}

/// Mean of some losses, and its standard error.
fn mean(losses: &[f64]) -> (f64, f64) {
    let count = losses.len() as f64;
    let mean = losses.iter().sum::<f64>() / count;
    let squares: f64 = losses.iter().map(|loss| (loss - mean).powi(2)).sum();
    (mean, (squares / (count * (count - 1.0))).sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surrogate::network::uniform;

    /// Turns of 16 steps at full need, whose losses have a noise of 5 %, root mean square.
    struct Training {
        need: Need,
        seed: u64,
        turns: u64,
        steps: u64,
    }

    impl Training {
        fn new(seed: u64) -> Self {
            Self { need: Need::default(), seed, turns: 0, steps: 0 }
        }

        /// Training whose loss of 1 has stalled.
        fn stalled(seed: u64) -> Self {
            let mut training = Self::new(seed);
            training.take(1000, |_| 1.0);
            assert_eq!(training.need.factor(), LEAST, "seed {seed}");
            training
        }

        /// Takes turns whose loss is a function of the steps taken. Returns the need after each.
        fn take(&mut self, turns: u64, loss: impl Fn(f64) -> f64) -> Vec<f64> {
            let mut turn = || {
                let steps = (16.0 * self.need.factor()) as u64;
                (self.turns, self.steps) = (self.turns + 1, self.steps + steps);
                let noise = 0.05 * 12f64.sqrt() * (f64::from(uniform(self.seed, self.turns)) - 0.5);
                let loss = Some((1.0 + noise) * loss(self.steps as f64));
                self.need.observe(&Learned { steps, loss, ..Learned::default() });
                self.need.factor()
            };
            (0..turns).map(|_| turn()).collect()
        }
    }

    #[test]
    fn a_loss_that_falls_as_a_power_of_the_steps_needs_all_training() {
        for (power, seed) in [0.3, 0.5, 1.0].into_iter().flat_map(|power| (0..8).map(move |seed| (power, seed))) {
            let needs = Training::new(seed).take(5000, |steps| steps.powf(-power));
            assert!(needs.iter().all(|&need| need == 1.0), "steps^-{power}, seed {seed}");
        }
    }

    #[test]
    fn a_loss_that_stops_falling_needs_less() {
        for seed in 0..8 {
            let mut training = Training::new(seed);
            let loss = |steps: f64| (5000.0 / steps).sqrt().max(1.0);
            let needs = training.take(5000 / 16, loss);
            assert!(needs.iter().all(|&need| need == 1.0), "seed {seed}: it falls");
            training.take(10_000 / 16, loss);
            let needs = training.take(4000, loss);
            assert!(needs.iter().all(|&need| need == LEAST), "seed {seed}: it stands");
        }
    }

    /// The trainer lowers its rate each 512 steps, seven times, if the loss has stopped falling.
    #[test]
    fn a_loss_that_falls_with_the_learning_rate_needs_all_training() {
        for seed in 0..8 {
            let needs = Training::new(seed).take(8 * 512 / 16, |steps| 0.9f64.powf((steps / 512.0).floor()));
            assert!(needs.iter().all(|&need| need == 1.0), "seed {seed}");
        }
    }

    #[test]
    fn a_loss_of_zero_has_stalled() {
        assert!(Training::new(0).take(1000, |_| 0.0).ends_with(&[LEAST]));
    }

    #[test]
    fn new_labels_need_all_training_for_a_while() {
        let mut training = Training::stalled(0);
        training.need.restart();
        let needs = training.take(FIRST_STEPS / 16 - 1, |_| 1.0);
        assert!(needs.iter().all(|&need| need == 1.0));
        assert_eq!(training.take(1000, |_| 1.0).last(), Some(&LEAST));
    }

    #[test]
    fn a_loss_that_rises_needs_all_training_and_one_that_rises_little_does_not() {
        for seed in 0..8 {
            let needs = Training::stalled(seed).take(4000, |_| 1.1);
            assert!(needs.iter().all(|&need| need == LEAST), "seed {seed}: new samples");
            // A step each.
            let needs = Training::stalled(seed).take(16, |_| 3.0);
            assert!(needs.contains(&1.0), "seed {seed}: labels of another field");
        }
    }

    /// A lower learning rate lets a loss fall that stood.
    #[test]
    fn a_loss_that_falls_again_needs_all_training() {
        for seed in 0..8 {
            let needs = Training::stalled(seed).take(4000, |_| 0.7);
            assert!(needs.contains(&1.0), "seed {seed}");
        }
    }

    #[test]
    fn lost_steps_and_a_loss_that_is_no_number_need_all_training() {
        let learned = |loss| Learned { steps: 1, loss, ..Learned::default() };
        let [not_finite, rolled_back, lost] =
            [learned(Some(f64::NAN)), Learned { rollbacks: 1, ..learned(Some(1.0)) }, Learned { steps: 0, lost_steps: 4, ..learned(None) }];
        for (learned, need) in [(not_finite, 1.0), (rolled_back, 1.0), (lost, 1.0), (learned(None), LEAST), (learned(Some(1.0)), LEAST)] {
            let mut training = Training::stalled(0);
            training.need.observe(&learned);
            assert_eq!(training.need.factor(), need, "{learned:?}");
        }
    }

    #[test]
    fn lost_trust_needs_all_training() {
        let mut need = Training::stalled(0).need;
        for (share, expected) in [(0.7, LEAST), (0.9, LEAST), (0.82, LEAST), (0.79, 1.0)] {
            need.trusts(share);
            assert_eq!(need.factor(), expected, "{share} of the volume");
        }
    }

    /// Turns of a device whose step takes longer than is due.
    #[test]
    fn long_steps_are_made_up_for_while_the_loss_has_stalled() {
        let mut need = Training::stalled(0).need;
        let (due, step) = (0.001, 0.015);
        let mut trained = 0.0;
        for _ in 0..10_000 {
            if need.turn(due) > 0.0 {
                need.took(step, 1);
                trained += step;
            }
        }
        assert!((trained - 10_000.0 * due).abs() <= step, "{trained} s");
        // A wait that no step caused is not made up for without end.
        need.took(100.0, 1);
        assert!((0..2_000).any(|_| need.turn(due) > 0.0), "training goes on within two thousand frames");
        need.restart();
        for _ in 0..3 {
            assert_eq!(need.turn(due), due);
            need.took(step, 1);
        }
    }

    /// Fails if a turn is as short as what is due with a frame: it would end before its first step, and no loss would show that training is needed.
    #[test]
    fn a_turn_becomes_long_enough_for_a_step() {
        for (due, before) in [(1e-5, 0.002), (0.0002, 0.002), (0.0002, 0.05), (0.002, 0.4)] {
            let (mut need, mut steps) = (Training::stalled(0).need, 0);
            for _ in 0..1_000_000 {
                let turn = need.turn(due);
                if turn > 0.0 {
                    let taken = u64::from(turn > before);
                    steps += taken;
                    need.took(turn.max(before), taken);
                }
            }
            assert!(steps > 2, "{due} s a frame, steps after {before} s: {steps}");
        }
    }
}
