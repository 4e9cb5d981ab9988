//! What comes back of a network that a device trains, while it goes on there.

use super::super::network::{Average, Model, Predictor};
use super::super::{DeviceLost, OffloadedCopy};
use super::Progress;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

/// A network on the host. Shared: whoever changes a part copies it before.
#[derive(Clone)]
pub(super) struct Numbers {
    pub(super) model: Model,
    pub(super) average: Arc<Average>,
    pub(super) predictor: Arc<Predictor>,
}

/// A copy that a device made, and its numbers once somebody has brought them back.
pub(super) struct DeviceCopy {
    /// How far the network was.
    pub(super) progress: Progress,
    /// With a network of its shape.
    copy: Mutex<Option<(Box<dyn OffloadedCopy>, Model)>>,
    numbers: OnceLock<Result<Numbers, DeviceLost>>,
}

impl DeviceCopy {
    pub(super) fn new(copy: Box<dyn OffloadedCopy>, shaped: Model, progress: Progress) -> Arc<Self> {
        Arc::new(Self { progress, copy: Mutex::new(Some((copy, shaped))), numbers: OnceLock::new() })
    }

    /// Brings the numbers back, or waits for the thread that is about to.
    pub(super) fn fetch(&self) -> Result<&Numbers, DeviceLost> {
        let bring = || {
            let taken = self.copy.lock().unwrap_or_else(PoisonError::into_inner).take();
            // Taken before, by a thread that did not come to its end.
            let (copy, mut model) = taken.ok_or(DeviceLost)?;
            let mut average = Average { tables: Vec::new(), layers: Vec::new() };
            copy.read(&mut model, &mut average)?;
            let predictor = Arc::new(Predictor::new(&model.shape, &average.layers));
            Ok(Numbers { model, average: Arc::new(average), predictor })
        };
        self.numbers.get_or_init(bring).as_ref().map_err(|lost| *lost)
    }

    /// The numbers, where they are back.
    pub(super) fn ready(&self) -> Option<Result<&Numbers, DeviceLost>> {
        self.numbers.get().map(|numbers| numbers.as_ref().map_err(|lost| *lost))
    }
}
