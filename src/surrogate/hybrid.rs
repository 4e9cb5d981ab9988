//! A traced table, a network, or both: s = table + shrinkage * network.
//!
//! Above a table the network's output layer starts at 0, so the sum starts as the table. With few labels a network fits their noise and would make
//! the sum worse than the table. Therefore one sample in [`HELD_OUT`] is never trained on, and the shrinkage in [0, 1] is the least-squares factor
//! on those.

use super::checkpoint::Checkpoint;
use super::checkpoint_state::CheckpointState;
use super::device::{FrozenHybrid, HostNetwork, NetworkFrom, SurrogateDevice, SurrogateTable, Training};
use super::network::{HELD_OUT, Loss, Model, NetworkSettings, Target};
use super::trace::Trace;
use super::trainer::Trainer;
use super::{CheckpointError, Kind, Learned, Predict, ReplayBuffer, Samples, SurrogateError, fresh_stamp};
use ridgewatch_base::DeviceError;
use ridgewatch_field::UnitPoint;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

/// Largest number of held-out samples that decide the shrinkage.
const MAX_COMPARED: usize = 8192;
/// Shrinkage after a slide of the window below which the network is reset: it does not describe the new table's errors.
const USELESS: f32 = 0.05;

/// A surrogate whose numbers are on the device `D`.
pub struct Hybrid<D: SurrogateDevice> {
    kind: Kind,
    /// Nodes of the table of a new window.
    nodes: [usize; 3],
    table: Option<D::Table>,
    /// Nodes of the present table.
    table_nodes: [usize; 3],
    /// The finer table that is being traced, with its nodes.
    finer: Option<(D::Table, [usize; 3])>,
    trainer: Option<Trainer<D::Training>>,
    shrinkage: f32,
    /// True if the table has changed since the last training.
    slid: bool,
}

impl<D: SurrogateDevice> Predict for Hybrid<D> {
    fn name(&self) -> &'static str {
        self.kind.name()
    }

    fn predict(&self, points: &[UnitPoint], out: &mut [f32]) -> Result<(), DeviceError> {
        self.freeze()?.predict(points, out)
    }

    fn bytes(&self) -> usize {
        let table = if self.kind == Kind::Network { 0 } else { self.table_nodes.iter().product::<usize>() * size_of::<f32>() };
        table + self.trainer.as_ref().map_or(0, |trainer| trainer.training.shape().parameters() * size_of::<f32>())
    }
}

/// Rejects targets and losses with which table and network cannot be added.
pub(super) fn check_residual(network: &NetworkSettings) -> Result<(), SurrogateError> {
    let refuse = |key: &str, found: &str, accepted: &str| {
        let accepted = format!("{accepted} (surrogate.kind = \"residual\")");
        Err(SurrogateError::Setting { key: key.into(), found: found.into(), accepted })
    };
    if network.target != Target::Ftle {
        return refuse("network.target", "flow_map", "ftle");
    }
    if network.loss != Loss::MeanSquare {
        return refuse("network.loss", "published", "mean_square");
    }
    Ok(())
}

impl<D: SurrogateDevice> Hybrid<D> {
    /// Builds a surrogate and traces its table with `nodes` along x, y, z. `training` moves the new network to its device.
    ///
    /// # Errors
    /// Outer error: settings out of range. Inner error: the device fails.
    pub fn new(
        kind: Kind,
        nodes: [usize; 3],
        network: &NetworkSettings,
        seed: u64,
        tracer: &D::Tracer<'_>,
        training: impl FnOnce(Model) -> D::Training,
    ) -> Result<Result<Self, DeviceError>, SurrogateError> {
        if kind == Kind::Residual {
            check_residual(network)?;
        }
        let trainer = match kind {
            Kind::Table => None,
            _ => Some(Trainer::new(network, tracer.flow(), seed, kind == Kind::Residual, training)?),
        };
        // Two-dimensional tables have one node along z.
        let dimensions = tracer.flow().domain().dimensions.clamp(2, 3);
        let nodes = std::array::from_fn(|axis| if axis < dimensions { nodes[axis].max(2) } else { 1 });
        let mut surrogate = Self { kind, nodes, table: None, table_nodes: nodes, finer: None, trainer, shrinkage: 0.0, slid: false };
        Ok(surrogate.trace_table(tracer).map(|()| surrogate))
    }

    /// Traces the table, if there is one, with the nodes of a new window.
    ///
    /// # Errors
    /// The device fails or lacks memory.
    pub fn trace_table(&mut self, tracer: &D::Tracer<'_>) -> Result<(), DeviceError> {
        self.finer = None;
        if self.kind != Kind::Network {
            // A table of other nodes cannot be traced again in place.
            let old = self.table.take().filter(|_| self.table_nodes == self.nodes);
            self.table_nodes = self.nodes;
            self.table = Some(D::trace_table(tracer, self.nodes, old)?);
        }
        Ok(())
    }

    /// Nodes of the present table along x, y, z; `None` without a table.
    pub fn table_nodes(&self) -> Option<[usize; 3]> {
        self.table.as_ref().map(|_| self.table_nodes)
    }

    /// Traces about `most` further nodes of a finer table with `nodes` along x, y, z, which replaces the present one as soon as it is complete. Returns
    /// whether it did. Other `nodes` than in the last call begin another table. The next window has the former nodes again. Once `stop` is set, nothing is
    /// replaced, since a tracer that was stopped leaves nodes without a value.
    ///
    /// # Errors
    /// The device fails or lacks memory.
    pub fn refine_table(&mut self, tracer: &D::Tracer<'_>, nodes: [usize; 3], most: usize, stop: &AtomicBool) -> Result<bool, DeviceError> {
        let (mut table, nodes) = match self.finer.take() {
            Some((table, begun)) if begun == nodes => (table, begun),
            _ => (D::untraced_table(tracer, nodes)?, nodes),
        };
        let is_complete = D::trace_more(tracer, &mut table, most)?;
        if stop.load(Ordering::Relaxed) {
            return Ok(false);
        }
        if is_complete {
            (self.table, self.table_nodes) = (Some(table), nodes);
        } else {
            self.finer = Some((table, nodes));
        }
        Ok(is_complete)
    }

    /// Nodes of the finer table that is being traced; `None` if there is none.
    pub fn finer_nodes(&self) -> Option<[usize; 3]> {
        self.finer.as_ref().map(|(_, nodes)| *nodes)
    }

    /// Forgets the finer table that is being traced, and frees its memory.
    pub fn forget_finer(&mut self) {
        self.finer = None;
    }

    /// The table, if there is one.
    pub fn table(&self) -> Option<&D::Table> {
        self.table.as_ref()
    }

    /// The network's trainer, if there is one.
    pub fn training(&self) -> Option<&D::Training> {
        self.trainer.as_ref().map(|trainer| &trainer.training)
    }

    /// The table, to be changed in place.
    pub fn table_mut(&mut self) -> Option<&mut D::Table> {
        self.table.as_mut()
    }

    /// The network's training, to be moved elsewhere.
    pub fn training_mut(&mut self) -> Option<&mut D::Training> {
        self.trainer.as_mut().map(|trainer| &mut trainer.training)
    }

    /// Factor on the network's output above a table.
    pub fn shrinkage(&self) -> f32 {
        self.shrinkage
    }

    /// True if the surrogate has a network, so that [`Hybrid::learn`] has an effect.
    pub fn learns(&self) -> bool {
        self.trainer.is_some()
    }

    /// True if a device other than the CPU takes the optimizer steps.
    pub fn trains_on_device(&self) -> bool {
        self.trainer.as_ref().is_some_and(|trainer| trainer.training.is_on_device())
    }

    /// Returns an immutable copy of the surrogate.
    ///
    /// # Errors
    /// The device fails or lacks memory.
    pub fn freeze(&self) -> Result<FrozenHybrid<D>, DeviceError> {
        let network = self.trainer.as_ref().map(Trainer::frozen).transpose()?;
        Ok(FrozenHybrid {
            table: self.table.clone(),
            network,
            shrinkage: if self.kind == Kind::Residual { self.shrinkage } else { 1.0 },
            times: self.trainer.as_ref().map_or_else(Default::default, Trainer::asked_times),
            stamp: fresh_stamp(),
            kind: self.kind,
            bytes: self.bytes(),
        })
    }

    /// Trains on the buffer's samples for at most `seconds` of wall clock and at most `max_steps` optimizer steps.
    ///
    /// # Errors
    /// The device fails or lacks memory. The steps before the failure are part of the next call's result.
    pub fn learn(&mut self, buffer: &ReplayBuffer, seconds: f64, max_steps: u64) -> Result<Learned, DeviceError> {
        let start = Instant::now();
        let samples = buffer.samples();
        if !samples.is_empty()
            && self.kind == Kind::Residual
            && std::mem::take(&mut self.slid)
            && self.fitted_shrinkage(samples)? < USELESS
            && let Some(trainer) = &mut self.trainer
        {
            trainer.forget_output()?;
        }
        let left = seconds - start.elapsed().as_secs_f64();
        let Some(trainer) = &mut self.trainer else { return Ok(Learned::default()) };
        let learned = trainer.learn(buffer, self.table.as_ref(), left, max_steps)?;
        if self.kind == Kind::Residual && learned.steps > 0 {
            self.shrinkage = self.fitted_shrinkage(samples)?;
        }
        Ok(Learned { seconds: start.elapsed().as_secs_f64(), ..learned })
    }

    /// Least-squares factor on the held-out samples. Training noise is independent of them and thus lowers the factor.
    fn fitted_shrinkage(&self, samples: &Samples) -> Result<f32, DeviceError> {
        let stride = HELD_OUT * (samples.len() / HELD_OUT / MAX_COMPARED).max(1);
        let finite = |&i: &usize| samples.log_stretch[i].is_finite() && samples.points[i].0.iter().all(|x| x.is_finite());
        let chosen: Vec<usize> = (0..samples.len()).step_by(stride).filter(finite).collect();
        let points: Vec<UnitPoint> = chosen.iter().map(|&i| samples.points[i]).collect();
        let (mut below, mut sum) = (vec![0.0; points.len()], vec![0.0; points.len()]);
        let frozen = self.freeze()?;
        FrozenHybrid { network: None, ..frozen.parts() }.predict(&points, &mut below)?;
        FrozenHybrid { table: None, ..frozen.parts() }.predict(&points, &mut sum)?;
        let (mut common, mut square) = (0.0, 0.0);
        for ((&i, below), learned) in chosen.iter().zip(below).zip(sum) {
            common += f64::from(samples.log_stretch[i] - below) * f64::from(learned);
            square += f64::from(learned).powi(2);
        }
        Ok(if square > 0.0 { (common / square).clamp(0.0, 1.0) as f32 } else { 0.0 })
    }

    /// Moves the surrogate to a new window: the table is traced again and the weights are kept. A network with the start time as an input keeps its
    /// training schedule as well, and predicts for the new start.
    ///
    /// # Errors
    /// The device fails or lacks memory.
    pub fn window_slid(&mut self, tracer: &D::Tracer<'_>) -> Result<(), DeviceError> {
        self.trace_table(tracer)?;
        if let Some(trainer) = &mut self.trainer {
            trainer.window_slid(tracer.flow());
        }
        (self.slid, self.shrinkage) = (true, 0.0);
        Ok(())
    }

    /// Returns the present state (weights, optimizer state, base table) for a checkpoint. Waits for all downloads.
    ///
    /// # Errors
    /// The device fails.
    pub fn checkpoint(&self) -> Result<CheckpointState, DeviceError> {
        let network = self.trainer.as_ref().map(Trainer::checkpoint).transpose()?;
        Ok(self.state(network))
    }

    /// Returns the present state without waiting. The thread that writes it downloads the numbers from the device. `None` while an earlier copy is
    /// still being downloaded.
    ///
    /// # Errors
    /// The device fails.
    pub fn checkpoint_async(&mut self) -> Result<Option<CheckpointState>, DeviceError> {
        let network = match &mut self.trainer {
            Some(trainer) => match trainer.checkpoint_async()? {
                Some(network) => Some(network),
                None => return Ok(None),
            },
            None => None,
        };
        Ok(Some(self.state(network)))
    }

    fn state(&self, network: Option<super::trainer::NetworkState>) -> CheckpointState {
        let table = self.table.clone().map(|table| -> super::checkpoint_state::DownloadTable { Box::new(move || table.to_host()) });
        let mut notes = Vec::new();
        if self.kind == Kind::Residual {
            notes = vec![("slid", self.slid.to_string()), ("shrinkage", self.shrinkage.to_string())];
        }
        CheckpointState::new(self.name(), notes, table, network)
    }

    /// Writes [`Hybrid::checkpoint`] into the file.
    ///
    /// # Errors
    /// The device or the file system fails.
    pub fn save(&self, path: &Path) -> Result<(), CheckpointError> {
        let lost = |source| CheckpointError::Lost { path: path.into(), what: "its numbers", source };
        self.checkpoint().map_err(lost)?.write(path).map(drop)
    }

    /// Loads a checkpoint.
    ///
    /// # Errors
    /// The file cannot be read, or is a checkpoint of another shape. Then nothing changes.
    pub fn load(&mut self, path: &Path) -> Result<(), CheckpointError> {
        // The notes tell another surrogate before its values are read.
        let opened = Checkpoint::open(path, self.name())?;
        let mut expected = self.trainer.as_ref().map_or(Ok(0), |trainer| trainer.checkpoint_values(opened.header()))?;
        if self.kind != Kind::Network {
            opened.header().expect_note("table.nodes", &format!("{:?}", self.table_nodes))?;
            expected += self.table_nodes.iter().product::<usize>();
        }
        let checkpoint = opened.read(expected)?;
        let lost = |source| CheckpointError::Lost { path: path.into(), what: "the present table", source };
        let table = match &self.table {
            Some(table) => {
                let restored = table.to_host().map_err(lost)?.restored(&checkpoint)?;
                Some(table.with_values(restored).map_err(lost)?)
            }
            None => None,
        };
        let (mut slid, mut shrinkage) = (self.slid, self.shrinkage);
        if self.kind == Kind::Residual {
            (slid, shrinkage) = (checkpoint.number("slid")?, checkpoint.number_in("shrinkage", 0.0..=1.0)?);
        }
        if let Some(trainer) = &mut self.trainer {
            trainer.restore(&checkpoint)?;
        }
        self.finer = None;
        (self.table, self.slid, self.shrinkage) = (table, slid, shrinkage);
        Ok(())
    }

    /// Returns the surrogate on another device, without its table, which is traced later. `training` moves the network there.
    ///
    /// # Errors
    /// The network is downloaded from the device, and the device fails.
    pub(super) fn moved<E: SurrogateDevice>(
        &mut self,
        from: NetworkFrom,
        training: impl FnOnce(HostNetwork) -> E::Training,
    ) -> Result<Hybrid<E>, DeviceError> {
        let trainer = self.trainer.as_mut().map(|trainer| trainer.moved(from, training)).transpose()?;
        let Self { kind, nodes, shrinkage, slid, .. } = *self;
        Ok(Hybrid { kind, nodes, table: None, table_nodes: nodes, finer: None, trainer, shrinkage, slid })
    }
}
