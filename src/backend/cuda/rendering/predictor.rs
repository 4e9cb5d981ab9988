//! What predicts on the device what a surrogate predicts: tables and networks that are there, and copies of those that are not.

use super::offload::{CudaNetwork, LabelPool, LabelSink};
use super::{CudaTracer, DeviceError, DeviceLearns, DeviceNetwork, DevicePredict, DeviceTable, Gpu, NetworkAbove};
use crate::field::Domain;
use crate::flow::Tracer;
use crate::surrogate::{NetworkState, Predict, Table};
use std::sync::Arc;

/// Points from the host that are predicted at once, at most: bounds the memory of a call.
const BATCH: usize = 1 << 22;
/// Bytes of one, with what is predicted there.
const POINT: u64 = 16;

/// Predicts at unit points on the host.
pub(super) fn predict_from_host(gpu: &Gpu, by: &dyn DevicePredict, points: &[[f32; 3]], out: &mut [f32]) -> Result<(), DeviceError> {
    let batch = gpu.batch(BATCH, POINT);
    for (points, out) in points.chunks(batch).zip(out.chunks_mut(batch)) {
        let unit = gpu.upload("points to predict at", points)?;
        let values = gpu.alloc::<f32>("points to predict at", points.len())?;
        // SAFETY: both buffers hold as many entries as there are points, and reading waits for the stream.
        unsafe { by.predict(unit.address(), points.len(), values.address()) }?;
        values.read(out)?;
    }
    Ok(())
}

/// Tables from the host: the copy of the latest one, by its stamp.
#[derive(Debug, Default)]
pub(super) struct TableCopy(Option<(u64, DeviceTable)>);

impl TableCopy {
    /// Gives its memory back.
    pub(super) fn let_go(&mut self) {
        self.0 = None;
    }

    /// The table on the device: itself where it was traced there, otherwise the copy, which is made where there is none yet.
    pub(super) fn of<'a>(&'a mut self, gpu: &Arc<Gpu>, domain: &Domain, table: &'a Table) -> Result<&'a DeviceTable, DeviceError> {
        if let Some(there) = DeviceTable::of(table) {
            self.let_go();
            return Ok(there);
        }
        let copy = match self.0.take() {
            Some((stamp, copy)) if stamp == table.stamp() => copy,
            old => {
                // The old one goes first, so that old and new never need memory together.
                drop(old);
                DeviceTable::upload(gpu, domain, table)?
            }
        };
        Ok(&self.0.insert((table.stamp(), copy)).1)
    }
}

/// What predicts in one frame.
pub(super) enum Predictor<'a> {
    Table(&'a DeviceTable),
    /// And who learns from what is traced, where the network is trained here.
    Network(NetworkAbove<'a>, Option<LabelSink<'a>>),
}

impl Predictor<'_> {
    pub(super) fn label_sink(&self) -> Option<&dyn DeviceLearns> {
        match self {
            Self::Network(_, Some(sink)) => Some(sink),
            _ => None,
        }
    }
}

impl DevicePredict for Predictor<'_> {
    unsafe fn predict(&self, points: u64, count: usize, out: u64) -> Result<(), DeviceError> {
        // SAFETY: the caller's.
        unsafe {
            match self {
                Self::Table(table) => table.predict(points, count, out),
                Self::Network(network, _) => network.predict(points, count, out),
            }
        }
    }
}

/// Finds predictors, and keeps the copies that they need from frame to frame.
pub(super) struct Predictors {
    gpu: Arc<Gpu>,
    /// The network from the host that frames were last answered from, by its stamp.
    network: Option<(u64, DeviceNetwork)>,
    below: TableCopy,
}

impl Predictors {
    pub(super) fn new(gpu: &Arc<Gpu>) -> Self {
        Self { gpu: gpu.clone(), network: None, below: TableCopy::default() }
    }

    /// Gives copies of tables back.
    pub(super) fn let_go_of_tables(&mut self) {
        self.below.let_go();
    }

    /// What predicts what `surrogate` predicts; none where nothing does.
    pub(super) fn of<'a>(&'a mut self, surrogate: &'a dyn Predict, tracer: &'a CudaTracer) -> Result<Option<Predictor<'a>>, DeviceError> {
        if let Some(table) = surrogate.as_any().and_then(|any| any.downcast_ref()).and_then(DeviceTable::of) {
            return Ok(Some(Predictor::Table(table)));
        }
        let Some(state) = surrogate.network().filter(|state| DeviceNetwork::takes(&self.gpu, state.shape)) else { return Ok(None) };
        let Self { gpu, network, below } = self;
        let there = state.on_device.and_then(|there| there.as_any().downcast_ref::<CudaNetwork>());
        let network = match there {
            Some(there) => {
                // One that came from the host before that.
                *network = None;
                there.network()
            }
            None => brought(gpu, network, &state)?,
        };
        let base = match state.base {
            Some((table, share)) => Some((below.of(gpu, tracer.domain(), table)?, share)),
            None => None,
        };
        let sink = there.and_then(|there| there.label_sink(tracer.domain(), base.map(|(table, _)| table), state.times));
        Ok(Some(Predictor::Network(network.above(base).at(state.times), sink)))
    }
}

/// Where labels go that stay on the device for the network that predicts; none where nothing learns there.
pub(super) fn pool(surrogate: &dyn Predict) -> Option<Arc<LabelPool>> {
    let there = surrogate.network()?.on_device?.as_any().downcast_ref::<CudaNetwork>()?;
    there.pool().cloned()
}

/// The copy of a network from the host, which is made where there is none yet.
fn brought<'a>(
    gpu: &Arc<Gpu>,
    kept: &'a mut Option<(u64, DeviceNetwork)>,
    state: &NetworkState<'_>,
) -> Result<&'a DeviceNetwork, DeviceError> {
    let network = match kept.take() {
        Some((stamp, network)) if stamp == state.stamp => network,
        old => {
            // As for tables.
            drop(old);
            DeviceNetwork::upload(gpu, state.shape, state.objective, state.tables, state.layers)?
        }
    };
    Ok(&kept.insert((state.stamp, network)).1)
}
