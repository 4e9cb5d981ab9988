//! Another tau or direction, by a command to a run in progress.

use super::cycle::Cycle;
use super::decision::{Decision, enter_colours};
use super::scene::colours;
use super::slides::{Slide, Slides};
use super::steering::Change;
use super::steps::fixed_steps;
use super::stop::RunEnd;
use super::transaction::{transaction, with};
use super::{RunError, TransferRecord};
use crate::backend::Backend;
use crate::flow::{FlowMap, Steps, VelocitySource, time_resolution};
use crate::render::smooth::StepsError;
use crate::render::{Renderer, Scene, TransferSettings};
use crate::surrogate::network::Times;
use crate::surrogate::{ReplayBuffer, Sizing, Trace};

/// The flow map that a command asks for after `former`. Steps that the scene gives, for the map that the run `began` with, keep their length.
pub(super) fn asked(began: &FlowMap, former: &FlowMap, set: &Change) -> FlowMap {
    let tau = set.tau.unwrap_or(former.tau);
    let steps = match began.steps {
        // Rounding adds no step.
        Steps::Fixed(steps) => Steps::Fixed(((steps as f64 * (tau / began.tau) * (1.0 - 1e-12)).ceil() as usize).max(1)),
        rule => rule,
    };
    FlowMap { tau, direction: set.direction.unwrap_or(former.direction), steps, ..former.clone() }
}

impl<B: Backend> Cycle<'_, B> {
    /// Goes on with the flow map that was asked for, in the window as it is: colours that the scene leaves open, steps, surrogate and trust begin
    /// anew, since all that was traced is of another map. If it cannot be traced, the former one stays, with a warning.
    ///
    /// # Errors
    /// The device fails, a stop is requested, or no point has a velocity.
    pub(super) fn take_map(&mut self, slides: &mut dyn Slides, slide: &mut Slide) -> Result<(), RunEnd> {
        let (former, wanted) = (self.map.clone(), self.run.asked.clone());
        let (former_tau, former_direction) = (former.tau, former.direction);
        with!(&mut self.session, on => {
            on.tracer = None;
            on.picture = Default::default();
        });
        if let Err(end) = self.trace_from(slides, slide, wanted) {
            let RunEnd::Failed(RunError::Flow(error)) = end else { return Err(end) };
            self.run.progress.warnings.push(format!("tau and direction stay {former_tau} and {}: {error}", former_direction.name()));
            let back = Change { tau: Some(former_tau), direction: Some(former_direction), ..Change::default() };
            self.run.asked = asked(&self.run.plan.map, &self.run.asked, &back);
            self.run.progress.take_back_map();
            if let Some(steering) = &self.run.options.steering {
                steering.keep(former_tau, former_direction);
            }
            self.trace_from(slides, slide, former)?;
            // Colours and tolerance may have come with it.
            if self.look_at_steps(slide)? || self.settle_storage(slide, false)? {
                with!(&mut self.session, on => on.tracer = None);
                self.trace_anew(slide)?;
            }
            return self.probe_again(slide);
        }
        let chosen = with!(&self.session, on => on.tracer().flow().step_choice());
        if let Some(steps) = with!(&self.session, on => fixed_steps(on.tracer().flow())) {
            self.map.steps = Steps::Fixed(steps);
        }
        (self.settled, self.run.steps_error) = (None, StepsError::default());
        let report = &mut self.run.report;
        (report.integration_difference, report.integration_residual) = (None, None);
        report.integration_steps = with!(&self.session, on => fixed_steps(on.tracer().flow()));
        Decision::withdraw(&mut report.decisions, &["flow.steps"]);
        if self.map.tau != former_tau {
            Decision::withdraw(&mut report.decisions, &["time.tau"]);
        }
        if let Some(chosen) = chosen {
            self.take_steps(chosen, None);
        }
        self.draw_anew(slide)?;
        let differences = self.measure_integration(slide, chosen)?;
        let warnings = self.run.flow_warnings(with!(&self.session, on => on.tracer().flow()), chosen, differences);
        slide.warnings.extend(warnings);
        self.settle_steps(slide, chosen)?;
        self.learn_anew(slide)
    }

    /// Makes the flow map `map`, from the end of the window at which it starts.
    fn trace_from(&mut self, slides: &mut dyn Slides, slide: &mut Slide, map: FlowMap) -> Result<(), RunEnd> {
        slides.turn(map.direction);
        slide.turn(map.direction)?;
        slide.date = slides.date(slide.time);
        self.map = map;
        transaction!(self, slide, run, on => run.next_tracer(on, slide, &self.map));
        Ok(())
    }

    /// A renderer of this flow map, with the view and the range that commands set.
    fn draw_anew(&mut self, slide: &Slide) -> Result<(), RunEnd> {
        let mut scene = self.run.renderer.scene().clone();
        if !self.run.has_range {
            let plan = self.run.plan;
            let TransferSettings { extinction, albedo, .. } = scene.transfer.clone();
            scene.transfer = loop {
                let (stop, method) = (self.run.stop, self.run.render.method);
                let settled = with!(&self.session, on => {
                    let tracer = on.tracer();
                    self.run.threads.render().install(|| colours(plan, method, tracer, slide, stop))
                });
                match settled {
                    Err(RunEnd::Device(error)) => self.session.recover(error, slide, &self.map, &mut self.run)?,
                    // The picture shows what is missing, in the former colours.
                    Err(RunEnd::Failed(RunError::AllMissing { .. })) => break scene.transfer,
                    settled => break settled?,
                }
            };
            // Those of the scene, or of a command.
            scene.transfer = TransferSettings { extinction, albedo, ..scene.transfer };
        }
        let run = &mut self.run;
        let (plan, tau) = (run.plan, self.map.tau);
        let drawn = |scene: Scene| run.threads.render().install(|| Renderer::new(scene, &plan.domain, tau));
        let former = run.renderer.scene().clone();
        // The end that the scene gives may be beyond the one that is scaled to this FTLE.
        run.renderer = match drawn(scene) {
            Err(error) => {
                run.progress.warnings.push(format!("the colours stay, since those of this tau and direction are not accepted: {error}"));
                drawn(former)?
            }
            renderer => renderer?,
        };
        let transfer = &run.renderer.scene().transfer;
        let range = (transfer.low.unwrap_or_default(), transfer.high.unwrap_or_default());
        run.transfer = TransferRecord { low: range.0, high: range.1, extinction: f64::from(run.renderer.transfer().extinction_max()) };
        run.report.transfer = Some(run.transfer);
        if !run.has_range {
            enter_colours(&plan.scene, run.render.method, run.transfer, &mut run.report.decisions);
        }
        run.draw_color_bar();
        Ok(())
    }

    /// A surrogate without labels, trust without residuals, and majorants that a pilot picture tightens.
    fn learn_anew(&mut self, slide: &Slide) -> Result<(), RunEnd> {
        let plan = self.run.plan;
        let (scene, tau) = (&plan.scene, self.map.tau);
        let learning = &mut self.run.learning;
        learning.trust.reset();
        learning.buffer = ReplayBuffer::new(scene.training.replay_buffer);
        learning.times = Times::new(&scene.network, tau);
        learning.start = slide.time;
        learning.resize = None;
        learning.peak = f32::NEG_INFINITY;
        self.run.progress.last_audit = None;
        if learning.sizing.is_some() {
            // Sizes that the former map rejected may suit this one.
            learning.sizing = Some(Sizing::new(&learning.settings, &learning.network, &plan.domain)?);
        }
        self.run.report.time_resolution = match &slide.velocity {
            VelocitySource::Window(window) => Some(self.run.threads.render().install(|| time_resolution(window, &self.map, slide.time))?),
            VelocitySource::Analytic(..) => None,
        };
        self.run.progress.cost = None;
        self.run.progress.steps_shown = 0;
        self.run.progress.has_warned_of_deaths = false;
        if with!(&self.session, on => on.surrogate.is_some()) {
            transaction!(self, slide, run, on => run.rebuild_surrogate(on));
        }
        transaction!(self, slide, run, on => run.pilot(on));
        self.probe_again(slide)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_keep_their_length_whatever_was_asked_for_before() {
        let began = FlowMap::tangent(5.0, 20);
        let mut map = began.clone();
        for (tau, steps) in [(4.9, 20), (5.0, 20), (0.001, 1), (5.0, 20), (2.5, 10), (7.5, 30), (5.0, 20)] {
            map = asked(&began, &map, &Change { tau: Some(tau), ..Change::default() });
            assert_eq!((map.tau, map.steps), (tau, Steps::Fixed(steps)));
        }
    }
}
