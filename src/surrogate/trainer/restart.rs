//! The part of a checkpoint that holds a network in training.

use super::super::CheckpointError;
use super::super::checkpoint::{Checkpoint, Entry};
use super::super::device::{HostNetwork, Training};
use super::super::network::Average;
use super::copy::Copies;
use super::{NetworkSource, Progress, Trainer};
use ridgewatch_base::DeviceError;
use std::sync::Arc;
use std::time::Instant;

/// A network in training at one moment, to be written.
pub(crate) struct NetworkState {
    notes: Vec<(String, String)>,
    source: NetworkSource,
}

impl NetworkState {
    /// Reason why frames had to wait for the copy; `None` if they did not.
    pub(crate) fn wait_reason(&self) -> Option<&str> {
        match &self.source {
            NetworkSource::Here(_, why) => why.as_deref(),
            NetworkSource::Pending(_) => None,
        }
    }

    /// Adds notes and tensors to a checkpoint. Waits for downloads in progress.
    pub(crate) fn entries<'a>(&'a self, checkpoint: &mut Checkpoint<'a>) -> Result<(), DeviceError> {
        for (key, text) in &self.notes {
            checkpoint.note(&format!("network.{key}"), text.clone());
        }
        let HostNetwork { model, average } = match &self.source {
            NetworkSource::Here(network, _) => network,
            NetworkSource::Pending(pending) => pending.fetch()?,
        };
        checkpoint.note("network.steps", model.steps().to_string());
        let (entries, features) = (model.shape.table_entries(), model.shape.features);
        let [tables, layers] = model.state();
        let shapes = [vec![entries, features], vec![model.shape.layer_parameters()]];
        for (name, shape, values) in [("tables", &shapes[0], tables), ("layers", &shapes[1], layers)] {
            if values[0].is_empty() {
                continue;
            }
            for (part, values) in ["", ".moment_1", ".moment_2"].into_iter().zip(values) {
                checkpoint.push(Entry::new(&format!("network.{name}{part}"), shape, values));
            }
        }
        let Average { tables, layers } = &**average;
        if !tables.is_empty() {
            checkpoint.push(Entry::new("network.tables.average", &shapes[0], tables));
        }
        checkpoint.push(Entry::new("network.layers.average", &shapes[1], layers));
        Ok(())
    }
}

impl<T: Training> Trainer<T> {
    /// Returns the present network. Waits for the download from a device.
    ///
    /// # Errors
    /// The device fails.
    pub(crate) fn checkpoint(&self) -> Result<NetworkState, DeviceError> {
        Ok(NetworkState { notes: self.notes(), source: NetworkSource::Here(self.training.download()?, None) })
    }

    /// Returns the present network without waiting, if the device has memory for a copy. `None` while an earlier copy is being downloaded.
    ///
    /// # Errors
    /// The device fails.
    pub(crate) fn checkpoint_async(&mut self) -> Result<Option<NetworkState>, DeviceError> {
        let begin = Instant::now();
        let Some(source) = self.copy()? else { return Ok(None) };
        (self.copies.made, self.copies.wait_seconds) = (Instant::now(), begin.elapsed().as_secs_f64());
        Ok(Some(NetworkState { notes: self.notes(), source }))
    }

    /// Values that a checkpoint stores as text.
    fn notes(&self) -> Vec<(String, String)> {
        let mut notes: Vec<(String, String)> = self.fixed().into_iter().map(|(key, text)| (key.into(), text)).collect();
        notes.push(("inputs".into(), self.training.shape().input_names().join(" ")));
        let Progress { drawn, averaged, stall, caution, first_loss, smooth, looked } = self.progress;
        let rate = self.rate * stall * caution;
        let numbers = [
            ("tau", self.times.tau),
            ("stall", stall),
            ("caution", caution),
            ("first_loss", first_loss),
            ("smooth", smooth),
            ("looked", looked),
            ("learning_rate", rate),
        ];
        notes.extend(numbers.map(|(key, value)| (key.into(), value.to_string())));
        notes.extend([("drawn", drawn), ("averaged", averaged)].map(|(key, value)| (key.into(), value.to_string())));
        notes.push(("standardised".into(), self.standardised.to_string()));
        let scale = &self.objective.scale;
        for output in 0..3 {
            notes.push((format!("mean.{output}"), scale.mean[output].to_string()));
            notes.push((format!("deviation.{output}"), scale.deviation[output].to_string()));
        }
        notes
    }

    /// Notes that must match exactly: the shape and the loss in JSON, the loss without its quotes.
    fn fixed(&self) -> Vec<(&'static str, String)> {
        let shape = serde_json::to_string(self.training.shape()).unwrap_or_default();
        let loss = serde_json::to_string(&self.objective.loss).unwrap_or_default();
        let [x, y, z] = self.objective.extent;
        let mut fixed = vec![("shape", shape), ("loss", loss.trim_matches('"').to_owned()), ("extent", format!("{x} {y} {z}"))];
        fixed.extend(self.times.starts.map(|[first, last]| ("start_range", format!("{first} {last}"))));
        fixed
    }

    /// Number of values that a checkpoint of this trainer has.
    ///
    /// # Errors
    /// The notes are those of another network or of another tau.
    pub(crate) fn checkpoint_values(&self, checkpoint: &Checkpoint<'_>) -> Result<usize, CheckpointError> {
        self.expect_notes(checkpoint)?;
        let shape = self.training.shape();
        // Weights, two moments, and the average.
        Ok(4 * (shape.table_entries() * shape.features + shape.layer_parameters()))
    }

    fn expect_notes(&self, checkpoint: &Checkpoint<'_>) -> Result<(), CheckpointError> {
        for (key, text) in self.fixed() {
            checkpoint.expect_note(&format!("network.{key}"), &text)?;
        }
        let tau: f64 = checkpoint.number("network.tau")?;
        // Compared in f32, as in the loss, since the start times of windows are rounded.
        if tau as f32 != self.objective.tau {
            return Err(checkpoint.mismatch(format!("network.tau {tau}"), format!("network.tau {}", self.times.tau)));
        }
        Ok(())
    }

    /// Restores the trainer. The whole checkpoint is checked before any state changes.
    pub(crate) fn restore(&mut self, checkpoint: &Checkpoint<'_>) -> Result<(), CheckpointError> {
        self.expect_notes(checkpoint)?;
        let progress = Progress {
            drawn: checkpoint.number("network.drawn")?,
            averaged: checkpoint.number("network.averaged")?,
            stall: checkpoint.number_in("network.stall", 0.0..=1.0)?,
            caution: checkpoint.number_in("network.caution", 0.0..=1.0)?,
            first_loss: checkpoint.number_in("network.first_loss", 0.0..=f64::MAX)?,
            smooth: checkpoint.number_in("network.smooth", 0.0..=f64::MAX)?,
            looked: checkpoint.number_in("network.looked", 0.0..=f64::MAX)?,
        };
        let standardised = checkpoint.number("network.standardised")?;
        let steps = checkpoint.number("network.steps")?;
        let mut scale = self.objective.scale;
        for output in 0..3 {
            scale.mean[output] = checkpoint.finite(&format!("network.mean.{output}"))?;
            // The loss divides by it.
            scale.deviation[output] = checkpoint.number_in(&format!("network.deviation.{output}"), f32::MIN_POSITIVE..=f32::MAX)?;
        }
        let shape = self.training.shape();
        let read = |name: &str, len: usize| -> Result<[Vec<f32>; 3], CheckpointError> {
            if len == 0 {
                return Ok(Default::default());
            }
            let part = |part: &str| checkpoint.finite_values(&format!("network.{name}{part}"), len);
            Ok([part("")?, part(".moment_1")?, part(".moment_2")?])
        };
        let (table_values, layer_values) = (shape.table_entries() * shape.features, shape.layer_parameters());
        let state = [read("tables", table_values)?, read("layers", layer_values)?];
        let tables = if table_values == 0 { Vec::new() } else { checkpoint.finite_values("network.tables.average", table_values)? };
        let layers = checkpoint.finite_values("network.layers.average", layer_values)?;
        let mut model = self.training.host_copy().model.clone();
        model.set_state(state, steps);
        self.training.restore(HostNetwork { model, average: Arc::new(Average { tables, layers }) });
        self.objective.scale = scale;
        (self.progress, self.standardised, self.kept, self.copies) = (progress, standardised, None, Copies::new(progress));
        Ok(())
    }
}
