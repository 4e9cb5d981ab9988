//! What a checkpoint has of a network in training.

use super::super::checkpoint::{Checkpoint, Entry};
use super::super::network::{Average, Model};
use super::super::{CheckpointError, DeviceLost};
use super::{DeviceCopy, Progress, Sent, Trainer};
use std::sync::Arc;
use std::time::Instant;

/// A network in training as it was, to be written.
pub(in crate::surrogate) struct NetworkDraft {
    notes: Vec<(String, String)>,
    numbers: Source,
}

enum Source {
    Here(Box<Model>, Arc<Average>),
    DeviceCopy(Arc<DeviceCopy>),
}

impl NetworkDraft {
    /// Adds notes and tensors, those on their way back once they are there.
    pub(in crate::surrogate) fn entries<'a>(&'a self, checkpoint: &mut Checkpoint<'a>) -> Result<(), DeviceLost> {
        for (key, text) in &self.notes {
            checkpoint.note(&format!("network.{key}"), text.clone());
        }
        let (model, average) = match &self.numbers {
            Source::Here(model, average) => (&**model, &**average),
            Source::DeviceCopy(device_copy) => device_copy.fetch().map(|numbers| (&numbers.model, &*numbers.average))?,
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
        let Average { tables, layers } = average;
        if !tables.is_empty() {
            checkpoint.push(Entry::new("network.tables.average", &shapes[0], tables));
        }
        checkpoint.push(Entry::new("network.layers.average", &shapes[1], layers));
        Ok(())
    }
}

impl Trainer {
    /// As it is now; what a device has is waited for.
    pub(in crate::surrogate) fn draft(&self) -> NetworkDraft {
        let (model, average, progress) = self.present();
        NetworkDraft { notes: self.notes(progress), numbers: Source::Here(Box::new(model), average) }
    }

    /// The same without waiting, where the device has room for a copy; otherwise with the reason. None while an earlier one is on its way.
    pub(in crate::surrogate) fn draft_behind(&mut self) -> Option<(NetworkDraft, Option<String>)> {
        let begin = Instant::now();
        if self.on_device.is_none() {
            return Some((self.draft(), None));
        }
        match self.send_for() {
            Ok(Sent::Before) => None,
            Ok(Sent::For(device_copy)) => {
                if let Some(on_device) = &mut self.on_device {
                    (on_device.fetched_at, on_device.fetch_seconds) = (Instant::now(), begin.elapsed().as_secs_f64());
                }
                Some((NetworkDraft { notes: self.notes(self.progress), numbers: Source::DeviceCopy(device_copy) }, None))
            }
            Ok(Sent::NoRoom(why)) => Some((self.draft(), Some(why))),
            // What came back last; training goes on from that too.
            Err(lost) => Some((self.draft(), Some(lost.to_string()))),
        }
    }

    /// What is stated as text.
    fn notes(&self, progress: Progress) -> Vec<(String, String)> {
        let mut notes: Vec<(String, String)> = self.fixed().into_iter().map(|(key, text)| (key.into(), text)).collect();
        notes.push(("inputs".into(), self.model.shape.input_names().join(" ")));
        let Progress { drawn, averaged, stall, caution, first_loss, smooth, looked } = progress;
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

    /// What must agree to the letter for a checkpoint to fit: the shape and the loss in JSON, the loss without its quotes.
    fn fixed(&self) -> Vec<(&'static str, String)> {
        let shape = serde_json::to_string(&self.model.shape).unwrap_or_default();
        let loss = serde_json::to_string(&self.objective.loss).unwrap_or_default();
        let [x, y, z] = self.objective.extent;
        let mut fixed = vec![("shape", shape), ("loss", loss.trim_matches('"').to_owned()), ("extent", format!("{x} {y} {z}"))];
        fixed.extend(self.times.starts.map(|[first, last]| ("start_range", format!("{first} {last}"))));
        fixed
    }

    /// Reads everything, and only then changes anything.
    pub(in crate::surrogate) fn restored(&mut self, checkpoint: &Checkpoint<'_>) -> Result<(), CheckpointError> {
        for (key, text) in self.fixed() {
            checkpoint.expect_note(&format!("network.{key}"), &text)?;
        }
        let tau: f64 = checkpoint.number("network.tau")?;
        // As the loss has it: starts of windows round.
        if tau as f32 != self.objective.tau {
            return Err(checkpoint.mismatch(format!("network.tau {tau}"), format!("network.tau {}", self.times.tau)));
        }
        let progress = Progress {
            drawn: checkpoint.number("network.drawn")?,
            averaged: checkpoint.number("network.averaged")?,
            stall: checkpoint.number("network.stall")?,
            caution: checkpoint.number("network.caution")?,
            first_loss: checkpoint.number("network.first_loss")?,
            smooth: checkpoint.number("network.smooth")?,
            looked: checkpoint.number("network.looked")?,
        };
        let standardised = checkpoint.number("network.standardised")?;
        let steps = checkpoint.number("network.steps")?;
        let mut scale = self.objective.scale;
        for output in 0..3 {
            scale.mean[output] = checkpoint.number(&format!("network.mean.{output}"))?;
            scale.deviation[output] = checkpoint.number(&format!("network.deviation.{output}"))?;
        }
        let shape = &self.model.shape;
        let read = |name: &str, len: usize| -> Result<[Vec<f32>; 3], CheckpointError> {
            if len == 0 {
                return Ok(Default::default());
            }
            let part = |part: &str| checkpoint.values(&format!("network.{name}{part}"), len);
            Ok([part("")?, part(".moment_1")?, part(".moment_2")?])
        };
        let (table_values, layer_values) = (shape.table_entries() * shape.features, shape.layer_parameters());
        let state = [read("tables", table_values)?, read("layers", layer_values)?];
        let tables = if table_values == 0 { Vec::new() } else { checkpoint.values("network.tables.average", table_values)? };
        let layers = checkpoint.values("network.layers.average", layer_values)?;
        self.model.set_state(state, steps);
        self.objective.scale = scale;
        // Where a device trains it, it goes over again with the next step.
        (self.progress, self.standardised, self.kept, self.on_device) = (progress, standardised, None, None);
        self.average = Arc::new(Average { tables, layers });
        self.pack();
        Ok(())
    }
}
