//! The form in which a device holds windows: half precision, in pairs, where a smooth picture does not tell it from single.

use super::cycle::Cycle;
use super::decision::Decision;
use super::setup::Plan;
use super::slides::Slide;
use super::steps::suit_the_picture;
use super::stop::RunEnd;
use super::transaction::{transaction, with};
use crate::backend::{Backend, Storage};
use crate::flow::{Extras, Precision, Traced, VelocitySource};
use crate::progress::Work;
use crate::surrogate::Trace;

/// Largest optical residual of the device, in units of what the steps may have or have at the same points.
const MARGIN: f64 = 1.1;
const SETTING: &str = "device.storage";

/// Begins with half precision where the picture will be asked about it: nothing is uploaded twice unless it refuses.
pub(super) fn begin_with_half<B: Backend>(backend: &mut B, plan: &Plan, first: &Slide) {
    // Who asks for double precision gets what the data hold.
    if suit_the_picture(plan)
        && plan.map.precision == Precision::F32
        && matches!(first.velocity, VelocitySource::Window(_))
        && let Some(storage) = backend.open_storage()
    {
        *storage = Storage::F16Pairs;
    }
}

impl<B: Backend> Cycle<'_, B> {
    /// Compares paths of the device's flow map with those that the steps of this slide were compared with. If pictures would show the difference,
    /// windows are held in single precision from now on, and the flow map is made again. Returns whether it was. A choice that stays is entered
    /// if it `is_new`.
    ///
    /// # Errors
    /// The device fails.
    pub(super) fn settle_storage(&mut self, slide: &Slide, is_new: bool) -> Result<bool, RunEnd> {
        let compared = self.compared.take();
        if !with!(&mut self.session, on => is_half(&mut on.backend)) {
            return Ok(false);
        }
        let why = match compared {
            Some(comparison) => {
                let _work = Work::begin("comparing half precision with double");
                let mut traced = Traced::default();
                transaction!(self, slide, run, on => {
                    let tracer = on.tracer();
                    run.threads.render().install(|| Ok(tracer.trace(&comparison.points, Extras::default(), &mut traced)?))
                });
                // The session may have gone on without its device.
                if !with!(&mut self.session, on => is_half(&mut on.backend)) {
                    return Ok(false);
                }
                let shown = self.run.shown();
                let (residual, most) = (comparison.residual(shown, &traced), MARGIN * shown.most().max(comparison.of_steps));
                let words =
                    format!("colours differ by {residual:.4} of their range, rms, from those in double precision with many more steps");
                if residual <= most {
                    if is_new {
                        Decision::new(SETTING, Storage::F16Pairs.name(), words).enter(&mut self.run.report.decisions);
                    }
                    return Ok(false);
                }
                format!("with {} {words}; allowed: {most:.4}", Storage::F16Pairs.name())
            }
            // What was judged before stays.
            None if Decision::is_entered(&self.run.report.decisions, SETTING) => return Ok(false),
            None => "too few points show anything to judge half precision by".to_owned(),
        };
        with!(&mut self.session, on => {
            on.backend.open_storage().into_iter().for_each(|storage| *storage = Storage::F32);
            on.tracer = None;
        });
        Decision::new(SETTING, Storage::F32.name(), why).enter(&mut self.run.report.decisions);
        transaction!(self, slide, run, on => run.next_tracer(on, slide, &self.map));
        Ok(true)
    }
}

fn is_half<B: Backend>(backend: &mut B) -> bool {
    backend.open_storage().is_some_and(|storage| *storage != Storage::F32)
}
