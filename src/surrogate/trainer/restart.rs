//! What a checkpoint has of a network in training.

use super::super::CheckpointError;
use super::super::checkpoint::{Checkpoint, Entry};
use super::super::network::Average;
use super::{Progress, Trainer};
use std::sync::Arc;

impl Trainer {
    pub(in crate::surrogate) fn entries<'a>(&'a self, checkpoint: &mut Checkpoint<'a>) {
        checkpoint.note("network.shape", self.shape_text());
        checkpoint.note("network.inputs", self.model.shape.input_names().join(" "));
        if let Some([first, last]) = self.times.starts {
            checkpoint.note("network.start_range", format!("{first} {last}"));
        }
        checkpoint.note("network.tau", self.times.tau.to_string());
        let (model, average, progress) = self.present();
        let Progress { drawn, averaged, stall, caution, first_loss, smooth, looked } = progress;
        let scale = &self.objective.scale;
        let numbers = [("stall", stall), ("caution", caution), ("first_loss", first_loss), ("smooth", smooth), ("looked", looked)];
        for (key, value) in numbers {
            checkpoint.note(&format!("network.{key}"), value.to_string());
        }
        checkpoint.note("network.learning_rate", (self.rate * stall * caution).to_string());
        checkpoint.note("network.steps", model.steps().to_string());
        checkpoint.note("network.drawn", drawn.to_string());
        checkpoint.note("network.averaged", averaged.to_string());
        checkpoint.note("network.standardised", self.standardised.to_string());
        for output in 0..3 {
            checkpoint.note(&format!("network.mean.{output}"), scale.mean[output].to_string());
            checkpoint.note(&format!("network.deviation.{output}"), scale.deviation[output].to_string());
        }
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
        let Average { tables, layers } = average.into_owned();
        if !tables.is_empty() {
            checkpoint.push(Entry::new("network.tables.average", &shapes[0], tables));
        }
        checkpoint.push(Entry::new("network.layers.average", &shapes[1], layers));
    }

    /// What must agree for a checkpoint to fit.
    fn shape_text(&self) -> String {
        let shape = serde_json::to_string(&self.model.shape).unwrap_or_default();
        let starts = self.times.starts.map_or_else(String::new, |[first, last]| format!(" starts {first} to {last}"));
        format!("{shape} loss {:?} tau {} extent {:?}{starts}", self.objective.loss, self.objective.tau, self.objective.extent)
    }

    /// Reads everything, and only then changes anything.
    pub(in crate::surrogate) fn restored(&mut self, checkpoint: &Checkpoint<'_>) -> Result<(), CheckpointError> {
        checkpoint.expect_note("network.shape", &self.shape_text())?;
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
        (self.progress, self.standardised, self.kept, self.away) = (progress, standardised, None, None);
        self.average = Arc::new(Average { tables, layers });
        self.pack();
        Ok(())
    }
}
