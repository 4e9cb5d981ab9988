//! Surrogates on the CPU.

use super::device::{
    FrozenHybrid, HostNetwork, Labels, NetworkCopy, NetworkFrom, SurrogateDevice, SurrogateTable, SyncedSamples, Training,
};
use super::hybrid::Hybrid;
use super::network::{Architecture, Average, Field, Fused, Model, Objective, PlannedStep, Predictor, Step};
use super::trace::Trace;
use super::{Kind, NetworkSettings, SurrogateError, SurrogateSettings, Table};
use ridgewatch_base::DeviceError;
use ridgewatch_field::{Domain, UnitPoint};
use std::sync::Arc;

/// The CPU as a surrogate's device. Its calls never fail.
pub struct Host;

/// A surrogate on the CPU.
pub type HostSurrogate = Hybrid<Host>;

impl SurrogateDevice for Host {
    type Tracer<'t> = dyn Trace + 't;
    type Table = Table;
    type Training = HostTraining;

    fn trace_table(tracer: &dyn Trace, nodes: [usize; 3], old: Option<Table>) -> Result<Table, DeviceError> {
        match old {
            Some(mut table) => table.retrace(tracer).map(|()| table),
            None => Table::trace(tracer, nodes),
        }
    }

    fn untraced_table(tracer: &dyn Trace, nodes: [usize; 3]) -> Result<Table, DeviceError> {
        Ok(Table::untraced(tracer.flow().domain(), nodes))
    }

    fn trace_more(tracer: &dyn Trace, table: &mut Table, most: usize) -> Result<bool, DeviceError> {
        table.trace_more(tracer, most)
    }

    fn predict(frozen: &FrozenHybrid<Self>, points: &[UnitPoint], out: &mut [f32]) -> Result<(), DeviceError> {
        match (&frozen.table, &frozen.network) {
            (Some(table), None) => table.interpolate(points, out),
            (None, Some(network)) => network.predict(points, frozen.times, out),
            (Some(table), Some(network)) => {
                network.predict(points, frozen.times, out);
                let mut below = vec![0.0; points.len()];
                table.interpolate(points, &mut below);
                for (out, below) in out.iter_mut().zip(below) {
                    *out = frozen.shrinkage.mul_add(*out, below);
                }
            }
            (None, None) => out.fill(0.0),
        }
        Ok(())
    }
}

impl SurrogateTable for Table {
    fn to_host(&self) -> Result<Table, DeviceError> {
        Ok(self.clone())
    }

    fn with_values(&self, values: Table) -> Result<Self, DeviceError> {
        Ok(values)
    }
}

/// Builds a surrogate on the CPU. Tables are traced at once. `seed` draws the network's first weights and its batches.
///
/// # Errors
/// Settings that are out of range.
///
/// # Panics
/// If `tracer` fails, which CPU tracers never do.
pub fn build(
    settings: &SurrogateSettings,
    network: &NetworkSettings,
    domain: &Domain,
    seed: u64,
    tracer: &dyn Trace,
) -> Result<HostSurrogate, SurrogateError> {
    let nodes = if settings.kind == Kind::Network { [2; 3] } else { settings.nodes(domain)? };
    let training = |model: Model| HostTraining::new(HostNetwork::fresh(model));
    Ok(Hybrid::new(settings.kind, nodes, network, seed, tracer, training)?.unwrap_or_else(|error| panic!("a tracer of the CPU: {error}")))
}

impl<D: SurrogateDevice> Hybrid<D> {
    /// Returns the surrogate on the CPU, with its network and without its table, which is traced later.
    ///
    /// # Errors
    /// The network is downloaded from the device, and the device fails.
    pub fn to_host(&mut self, from: NetworkFrom) -> Result<HostSurrogate, DeviceError> {
        self.moved(from, HostTraining::new)
    }
}

impl HostNetwork {
    /// A network before its first step: the running mean starts at the parameters.
    pub fn fresh(model: Model) -> Self {
        let average = Arc::new(Average { tables: model.tables(), layers: model.layers() });
        Self { model, average }
    }
}

/// A network on the CPU that does not change.
pub struct FrozenNetwork {
    /// The layout of the parameters.
    pub shape: Architecture,
    /// Interpretation of the outputs.
    pub objective: Objective,
    /// The parameters.
    pub average: Arc<Average>,
    predictor: Arc<Predictor>,
}

impl FrozenNetwork {
    /// Writes the log-stretch at unit points, for these unit times.
    pub fn predict(&self, points: &[UnitPoint], times: [f32; 2], out: &mut [f32]) {
        self.predictor.log_stretch(&self.shape, &self.objective, &self.average.tables, points, times, out);
    }
}

/// A network in training on the CPU.
pub struct HostTraining {
    network: HostNetwork,
    predictor: Arc<Predictor>,
    fused: Option<Fused>,
    /// Largest number of samples of a step.
    batch: usize,
    /// Indices of the samples that can be used for training; `None` if all can.
    among: Option<Vec<u32>>,
    /// State saved by [`Training::keep`]: parameters with moments, mean, steps.
    pub(super) kept: Option<([[Vec<f32>; 3]; 2], Average, usize)>,
}

impl HostTraining {
    /// Continues training from `network`.
    pub fn new(network: HostNetwork) -> Self {
        let predictor = Arc::new(Predictor::new(&network.model.shape, &network.average.layers));
        Self { network, predictor, fused: None, batch: 0, among: None, kept: None }
    }
}

impl Training for HostTraining {
    type Table = Table;
    type Network = FrozenNetwork;

    fn shape(&self) -> &Architecture {
        &self.network.model.shape
    }

    fn steps_taken(&self) -> usize {
        self.network.model.steps()
    }

    fn is_on_device(&self) -> bool {
        false
    }

    fn begin(&mut self, _: &Objective, _: usize, batch: usize) -> Result<(), DeviceError> {
        self.batch = batch;
        Ok(())
    }

    fn sync(&mut self, objective: &Objective, labels: Labels<'_, Table>) -> Result<SyncedSamples, DeviceError> {
        let samples = labels.buffer.samples();
        self.among = objective.usable_samples(samples);
        let usable = self.among.as_ref().map_or(samples.len(), Vec::len);
        Ok(SyncedSamples { usable, dropped: samples.len() - usable })
    }

    fn train(&mut self, objective: &Objective, labels: Labels<'_, Table>, steps: &[PlannedStep]) -> Result<Vec<f64>, DeviceError> {
        let Self { network: HostNetwork { model, average }, fused, among, batch, .. } = self;
        let fused = fused.get_or_insert_with(|| Fused::new(model, objective, *batch));
        let base = labels.base.map(|base| base as &dyn Field);
        let mut losses = Vec::with_capacity(steps.len());
        fused.steps(model, objective, Arc::make_mut(average), |done, loss| {
            losses.extend(loss);
            steps.get(done as usize).map(|step| Step::of(step, labels.buffer.samples(), among.as_deref(), base))
        });
        Ok(losses)
    }

    /// One, since a step takes much longer than reading the clock.
    fn group(&self, _: f64) -> u64 {
        1
    }

    fn keep(&mut self) -> Result<(), DeviceError> {
        let HostNetwork { model, average } = &self.network;
        self.kept = Some(match self.kept.take() {
            // Reusing the memory avoids page faults at each slide of a window.
            Some((mut state, mut mean, _)) => {
                model.copy_state(&mut state);
                mean.tables.copy_from_slice(&average.tables);
                mean.layers.copy_from_slice(&average.layers);
                (state, mean, model.steps())
            }
            None => (model.state(), Average::clone(average), model.steps()),
        });
        Ok(())
    }

    fn roll_back(&mut self) -> Result<(), DeviceError> {
        if let Some((state, average, steps)) = &self.kept {
            self.network.model.set_state(state.clone(), *steps);
            self.network.average = Arc::new(average.clone());
        }
        Ok(())
    }

    fn restart_average(&mut self) -> Result<(), DeviceError> {
        let model = &self.network.model;
        self.network.average = Arc::new(Average { tables: model.tables(), layers: model.layers() });
        Ok(())
    }

    fn settle(&mut self) {
        self.predictor = Arc::new(Predictor::new(&self.network.model.shape, &self.network.average.layers));
    }

    fn zero_output(&mut self) -> Result<(), DeviceError> {
        let output = self.network.model.shape.output_parameters();
        self.network.model.zero_output();
        Arc::make_mut(&mut self.network.average).layers[output].fill(0.0);
        self.settle();
        Ok(())
    }

    fn forget_labels(&mut self) {}

    fn frozen(&self, objective: &Objective) -> Result<Arc<FrozenNetwork>, DeviceError> {
        let HostNetwork { model, average } = &self.network;
        let (shape, objective) = (model.shape.clone(), objective.clone());
        Ok(Arc::new(FrozenNetwork { shape, objective, average: average.clone(), predictor: self.predictor.clone() }))
    }

    fn download(&self) -> Result<HostNetwork, DeviceError> {
        Ok(self.network.clone())
    }

    fn copy(&mut self) -> Result<NetworkCopy, DeviceError> {
        Ok(NetworkCopy::Ready(self.network.clone(), None))
    }

    fn host_copy(&self) -> &HostNetwork {
        &self.network
    }

    fn set_host_copy(&mut self, network: HostNetwork) {
        self.network = network;
        self.settle();
    }

    fn restore(&mut self, network: HostNetwork) {
        (self.fused, self.kept) = (None, None);
        self.set_host_copy(network);
    }

    fn device_seconds(&mut self) -> Option<f64> {
        None
    }
}
