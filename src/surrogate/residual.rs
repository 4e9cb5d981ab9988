//! A coarse traced table plus a network that learns what the table lacks. The network's output layer starts at 0, so the sum starts as
//! the table.

use super::checkpoint::Checkpoint;
use super::trainer::{FrozenNetwork, Trainer};
use super::{CheckpointError, Learned, NetworkSettings, Predict, Samples, Surrogate, SurrogateError, Table};
use crate::flow::Tracer;
use std::path::Path;
use std::sync::Arc;

/// Samples on which the network is compared with nothing, after the table below it has changed.
const COMPARED: usize = 4096;

/// Table and network; the prediction is their sum.
pub struct Residual {
    table: Table,
    trainer: Trainer,
    /// Whether the table has changed since the network last learned.
    slid: bool,
}

impl Residual {
    /// Traces the table with `nodes` along x, y, z. The network must have the target `ftle` and the mean-square loss: nothing else adds up.
    pub fn new(network: &NetworkSettings, nodes: [usize; 3], seed: u64, tracer: &dyn Tracer) -> Result<Self, SurrogateError> {
        let refuse = |key: &str, found: String, accepted: &str| {
            Err(SurrogateError::Setting { key: key.into(), found, accepted: format!("{accepted} (surrogate.kind = \"residual\")") })
        };
        if network.target != super::network::Target::Ftle {
            return refuse("network.target", "flow_map".into(), "ftle");
        }
        if network.loss != super::network::Loss::MeanSquare {
            return refuse("network.loss", "published".into(), "mean_square");
        }
        let trainer = Trainer::new(network, tracer.domain(), tracer.tau(), seed, true)?;
        Ok(Self { table: Table::trace(tracer, nodes), trainer, slid: false })
    }

    /// The table below.
    pub fn table(&self) -> &Table {
        &self.table
    }

    /// A residual learned on the previous table may be worse than none; then it starts from 0 again.
    fn forget_if_worse(&mut self, samples: &Samples) {
        let stride = (samples.len() / COMPARED).max(1);
        let chosen: Vec<usize> = (0..samples.len()).step_by(stride).filter(|&i| samples.log_stretch[i].is_finite()).collect();
        let points: Vec<[f32; 3]> = chosen.iter().map(|&i| samples.points[i]).collect();
        let (mut below, mut learned) = (vec![0.0; points.len()], vec![0.0; points.len()]);
        self.table.predict(&points, &mut below);
        self.trainer.predict(&points, &mut learned);
        let (mut with, mut without) = (0.0, 0.0);
        for ((&i, below), learned) in chosen.iter().zip(below).zip(learned) {
            let lacking = samples.log_stretch[i] - below;
            with += f64::from(lacking - learned).powi(2);
            without += f64::from(lacking).powi(2);
        }
        if with > without {
            self.trainer.forget_output();
        }
    }
}

impl Predict for Residual {
    fn name(&self) -> &'static str {
        "residual"
    }

    fn predict(&self, points: &[[f32; 3]], out: &mut [f32]) {
        let mut below = vec![0.0; points.len()];
        self.table.predict(points, &mut below);
        self.trainer.predict(points, out);
        for (out, below) in out.iter_mut().zip(below) {
            *out += below;
        }
    }

    fn bytes(&self) -> usize {
        self.table.bytes() + self.trainer.bytes()
    }
}

/// A residual as it was.
struct Frozen {
    table: Table,
    network: FrozenNetwork,
}

impl Predict for Frozen {
    fn name(&self) -> &'static str {
        "residual"
    }

    fn predict(&self, points: &[[f32; 3]], out: &mut [f32]) {
        let mut below = vec![0.0; points.len()];
        self.table.predict(points, &mut below);
        self.network.predict(points, out);
        for (out, below) in out.iter_mut().zip(below) {
            *out += below;
        }
    }

    fn bytes(&self) -> usize {
        self.table.bytes() + self.network.bytes()
    }
}

impl Surrogate for Residual {
    fn freeze(&self) -> Arc<dyn Predict> {
        Arc::new(Frozen { table: self.table.clone(), network: self.trainer.frozen() })
    }

    fn learns(&self) -> bool {
        true
    }

    fn learn(&mut self, samples: &Samples, seconds: f64, max_steps: u64) -> Learned {
        let start = std::time::Instant::now();
        if !samples.is_empty() && std::mem::take(&mut self.slid) {
            self.forget_if_worse(samples);
        }
        let left = seconds - start.elapsed().as_secs_f64();
        let learned = self.trainer.learn(samples, Some(&self.table), left, max_steps);
        Learned { seconds: start.elapsed().as_secs_f64(), ..learned }
    }

    fn window_slid(&mut self, tracer: &dyn Tracer) {
        self.table.retrace(tracer);
        self.trainer.window_slid();
        self.slid = true;
    }

    fn save(&self, path: &Path) -> Result<(), CheckpointError> {
        let mut checkpoint = Checkpoint::new("residual");
        checkpoint.note("slid", self.slid.to_string());
        self.table.entries(&mut checkpoint);
        self.trainer.entries(&mut checkpoint);
        checkpoint.write(path)
    }

    fn load(&mut self, path: &Path) -> Result<(), CheckpointError> {
        let checkpoint = Checkpoint::read(path, "residual")?;
        let table = self.table.restored(&checkpoint)?;
        let slid = checkpoint.number("slid")?;
        self.trainer.restored(&checkpoint)?;
        (self.table, self.slid) = (table, slid);
        Ok(())
    }
}
