//! A coarse traced table plus a network that learns what the table lacks: s = table + shrinkage * network.
//!
//! The network's output layer starts at 0, so the sum starts as the table. With few labels a network fits their noise and would make the sum worse
//! than the table; so one sample in [`HELD_OUT`] is never trained on, and the shrinkage in [0, 1] is the least-squares factor on those.

use super::checkpoint::Checkpoint;
use super::network::HELD_OUT;
use super::trainer::{FrozenNetwork, NetworkDraft, Trainer};
use super::{
    CheckpointError, Draft, Learned, NetworkSettings, NetworkState, Offload, Predict, SampleRing, Samples, Surrogate, SurrogateError, Table,
};
use crate::flow::Tracer;
use std::path::Path;
use std::sync::Arc;

/// Held-out samples, at most, that decide the shrinkage.
const COMPARED: usize = 8192;
/// Shrinkage after a slide of the window below which the network starts anew: it knows nothing about the new table's errors.
const USELESS: f32 = 0.05;

/// Table and network.
pub struct ResidualNetwork {
    table: Table,
    trainer: Trainer,
    shrinkage: f32,
    /// Whether the table has changed since the network last learned.
    slid: bool,
}

impl ResidualNetwork {
    /// Traces the table with `nodes` along x, y, z. The network must have the target `ftle` and the mean-square loss: nothing else adds up.
    pub fn new(network: &NetworkSettings, nodes: [usize; 3], seed: u64, tracer: &dyn Tracer) -> Result<Self, SurrogateError> {
        Self::check(network)?;
        let trainer = Trainer::new(network, tracer, seed, true)?;
        Ok(Self { table: Table::trace(tracer, nodes), trainer, shrinkage: 0.0, slid: false })
    }

    /// Refuses targets and losses for which table and network do not add up.
    pub(super) fn check(network: &NetworkSettings) -> Result<(), SurrogateError> {
        let refuse = |key: &str, found: String, accepted: &str| {
            Err(SurrogateError::Setting { key: key.into(), found, accepted: format!("{accepted} (surrogate.kind = \"residual\")") })
        };
        if network.target != super::network::Target::Ftle {
            return refuse("network.target", "flow_map".into(), "ftle");
        }
        if network.loss != super::network::Loss::MeanSquare {
            return refuse("network.loss", "published".into(), "mean_square");
        }
        Ok(())
    }

    /// The table below.
    pub fn table(&self) -> &Table {
        &self.table
    }

    /// Factor on the network's output.
    pub fn shrinkage(&self) -> f32 {
        self.shrinkage
    }

    fn drafted(&self, network: NetworkDraft) -> Draft {
        let draft = Draft::new(self.name(), Some(self.table.clone()), Some(network));
        draft.noting("slid", self.slid.to_string()).noting("shrinkage", self.shrinkage.to_string())
    }

    /// The factor that fits the held-out samples best. Training noise is independent of them, so what it adds is weighed down.
    fn fitted_shrinkage(&self, samples: &Samples) -> f32 {
        let stride = HELD_OUT * (samples.len() / HELD_OUT / COMPARED).max(1);
        let finite = |&i: &usize| samples.log_stretch[i].is_finite() && samples.points[i].iter().all(|x| x.is_finite());
        let chosen: Vec<usize> = (0..samples.len()).step_by(stride).filter(finite).collect();
        let points: Vec<[f32; 3]> = chosen.iter().map(|&i| samples.points[i]).collect();
        let (mut below, mut learned) = (vec![0.0; points.len()], vec![0.0; points.len()]);
        self.table.predict(&points, &mut below);
        self.trainer.predict(&points, &mut learned);
        let (mut common, mut square) = (0.0, 0.0);
        for ((&i, below), learned) in chosen.iter().zip(below).zip(learned) {
            common += f64::from(samples.log_stretch[i] - below) * f64::from(learned);
            square += f64::from(learned).powi(2);
        }
        if square > 0.0 { (common / square).clamp(0.0, 1.0) as f32 } else { 0.0 }
    }
}

impl Predict for ResidualNetwork {
    fn name(&self) -> &'static str {
        "residual"
    }

    fn predict(&self, points: &[[f32; 3]], out: &mut [f32]) {
        self.trainer.predict(points, out);
        add_below(&self.table, self.shrinkage, points, out);
    }

    fn bytes(&self) -> usize {
        self.table.bytes() + self.trainer.bytes()
    }
}

/// A residual as it was.
struct Frozen {
    table: Table,
    network: FrozenNetwork,
    shrinkage: f32,
}

/// Turns the network's outputs into table + shrinkage * network.
fn add_below(table: &Table, shrinkage: f32, points: &[[f32; 3]], out: &mut [f32]) {
    let mut below = vec![0.0; points.len()];
    table.predict(points, &mut below);
    for (out, below) in out.iter_mut().zip(below) {
        *out = shrinkage.mul_add(*out, below);
    }
}

impl Predict for Frozen {
    fn name(&self) -> &'static str {
        "residual"
    }

    fn predict(&self, points: &[[f32; 3]], out: &mut [f32]) {
        self.network.predict(points, out);
        add_below(&self.table, self.shrinkage, points, out);
    }

    fn bytes(&self) -> usize {
        self.table.bytes() + self.network.bytes()
    }

    fn network(&self) -> Option<NetworkState<'_>> {
        Some(NetworkState { base: Some((&self.table, self.shrinkage)), ..self.network.network()? })
    }
}

impl Surrogate for ResidualNetwork {
    fn freeze(&self) -> Arc<dyn Predict> {
        Arc::new(Frozen { table: self.table.clone(), network: self.trainer.frozen(), shrinkage: self.shrinkage })
    }

    fn learns(&self) -> bool {
        true
    }

    fn learn(&mut self, ring: &SampleRing, seconds: f64, max_steps: u64) -> Learned {
        let start = std::time::Instant::now();
        let samples = ring.samples();
        if !samples.is_empty() && std::mem::take(&mut self.slid) && self.fitted_shrinkage(samples) < USELESS {
            self.trainer.forget_output();
        }
        let left = seconds - start.elapsed().as_secs_f64();
        let learned = self.trainer.learn(ring, Some(&self.table), left, max_steps);
        if learned.steps > 0 {
            self.shrinkage = self.fitted_shrinkage(samples);
        }
        Learned { seconds: start.elapsed().as_secs_f64(), ..learned }
    }

    fn offload(&mut self, to: &Arc<dyn Offload>) {
        self.trainer.offload(to);
    }

    fn is_offloaded(&self) -> bool {
        self.trainer.is_offloaded()
    }

    fn window_slid(&mut self, tracer: &dyn Tracer) {
        self.trainer.let_go_of_base();
        self.table.retrace(tracer);
        self.trainer.window_slid(tracer);
        (self.slid, self.shrinkage) = (true, 0.0);
    }

    fn leave_device(&mut self) {
        self.trainer.let_go_of_base();
        self.table.leave_device();
    }

    fn draft(&self) -> Draft {
        self.drafted(self.trainer.draft())
    }

    fn draft_behind(&mut self) -> Option<Draft> {
        let (network, waited_for) = self.trainer.draft_behind()?;
        Some(self.drafted(network).waited_for(waited_for))
    }

    fn load(&mut self, path: &Path) -> Result<(), CheckpointError> {
        let checkpoint = Checkpoint::read(path, "residual")?;
        let table = self.table.restored(&checkpoint)?;
        let (slid, shrinkage) = (checkpoint.number("slid")?, checkpoint.number("shrinkage")?);
        self.trainer.restored(&checkpoint)?;
        (self.table, self.slid, self.shrinkage) = (table, slid, shrinkage);
        Ok(())
    }
}
