//! Commands to a run take effect between its frames.

use super::TransferRecord;
use super::another_map::asked;
use super::decision::Decision;
use super::state::Run;
use super::steering::{Command, Range, drawn_by};
use crate::render::RenderError;

/// What commands changed since the last frame, by what follows from it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Commands {
    None,
    /// Camera, extinction or albedo, or whether the window stands still.
    View,
    /// The method: the picture begins anew.
    Method,
    /// The ramp or the tolerance too, by which steps are chosen.
    Colours,
    /// Tau or direction: all that was traced is of another flow map.
    Map,
}

impl Run<'_> {
    /// Applies the commands that came since the last frame, and returns what they changed. A picture that accumulates notices what it no longer shows,
    /// and starts anew.
    pub(super) fn apply_commands(&mut self) -> Commands {
        let Some(steering) = &self.options.steering else { return Commands::None };
        let mut changed = Commands::None;
        for command in steering.take() {
            let set = &command.set;
            changed = changed.max(match set {
                _ if set.tau.is_some_and(|tau| tau != self.asked.tau) => Commands::Map,
                _ if set.direction.is_some_and(|direction| direction != self.asked.direction) => Commands::Map,
                _ if set.range.is_some() || set.tolerance.is_some() => Commands::Colours,
                _ if set.method.is_some_and(|method| method != self.render.method) => Commands::Method,
                _ => Commands::View,
            });
            match self.apply(&command) {
                Ok(()) => self.progress.commands.push(command),
                Err(refused) => self.progress.warnings.push(format!("command {} had no effect: {refused}", command.number)),
            }
        }
        changed
    }

    /// Takes no more commands. Those that no frame shows are told.
    pub(super) fn end_commands(&mut self) {
        let mut late = std::mem::take(&mut self.progress.commands);
        late.extend(self.options.steering.iter().flat_map(|steering| steering.end()));
        if let (Some(first), Some(last)) = (late.first(), late.last()) {
            self.progress.warnings.push(format!("commands {} to {} came too late: no frame shows them", first.number, last.number));
        }
    }

    /// Coefficients of the albedo, if a command set others than the scene's.
    pub(super) fn steered_albedo(&self) -> Option<[Vec<f64>; 3]> {
        let (own, now) = (self.plan.scene.transfer.clone().unwrap_or_default().albedo, &self.renderer.scene().transfer.albedo);
        (*now != own).then(|| now.clone())
    }

    fn apply(&mut self, Command { set, .. }: &Command) -> Result<(), RenderError> {
        let has_transfer = set.range.is_some() || set.extinction.is_some() || set.albedo.is_some();
        if set.camera.is_some() || has_transfer {
            let mut scene = self.renderer.scene().clone();
            scene.camera = set.camera.clone().unwrap_or(scene.camera);
            if let Some(Range { low, high }) = set.range {
                (scene.transfer.low, scene.transfer.high) = (Some(low), Some(high));
            }
            scene.transfer.extinction = set.extinction.or(scene.transfer.extinction);
            scene.transfer.albedo = set.albedo.clone().unwrap_or(scene.transfer.albedo);
            let renderer = &mut self.renderer;
            self.threads.render().install(|| renderer.set_scene(scene))?;
        }
        if has_transfer || set.tolerance.is_some() || set.method.is_some() {
            self.progress.last_audit = None;
        }
        if has_transfer {
            let extinction = f64::from(self.renderer.transfer().extinction_max());
            let Range { low, high } = set.range.unwrap_or(Range { low: self.transfer.low, high: self.transfer.high });
            self.transfer = TransferRecord { low, high, extinction };
            self.report.transfer = Some(self.transfer);
        }
        if set.range.is_some() {
            Decision::withdraw(&mut self.report.decisions, &["transfer.low", "transfer.high"]);
            // Its residuals are those of another ramp.
            self.learning.trust.reset();
        }
        self.has_range |= set.range.is_some();
        // The flow map follows once all commands are applied.
        self.asked = asked(&self.plan.map, &self.asked, set);
        if set.method.is_some() || set.budget.is_some() {
            self.races = None;
        }
        if let Some(method) = set.method {
            Decision::withdraw(&mut self.report.decisions, &["render.method"]);
            // Of another method.
            self.progress.cost = None;
            // A budget waits for the method that has one.
            self.render = drawn_by(&self.plan.scene.render, method, self.budget);
        }
        if let Some(budget) = set.budget {
            self.budget = Some(budget);
            // Since it was accepted, a race may have gone on with a method that has none.
            self.render = drawn_by(&self.plan.scene.render, self.render.method, self.budget);
        }
        if let Some(tolerance) = set.tolerance {
            self.learning.trust.set_tolerance(tolerance);
        }
        self.draw_color_bar();
        Ok(())
    }
}
