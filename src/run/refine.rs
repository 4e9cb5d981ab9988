//! A finer table for a picture that stands still.
//!
//! The table of a new window has few nodes, so that its first picture comes soon. From then on nodes and samples share the time: finer nodes take more
//! error away than the samples that could be drawn meanwhile (docs/smooth.md has the measurements). The part that a frame traces and the choice to begin
//! follow from counts of nodes, samples and frames, never from a clock, so that a run can be repeated.

use super::cycle::{Cycle, Run};
use super::decision::Decision;
use super::slides::Slide;
use super::stop::{RunEnd, check_stop};
use super::transaction::{On, present, transaction, with};
use crate::backend::{Backend, Surrogate};
use crate::surrogate::Kind;

/// Frames of the present slide.
#[derive(Debug, Clone, Copy)]
pub(super) struct Frames {
    /// Those that were shown.
    pub(super) shown: usize,
    /// Those still to come, if the slide's end is known.
    pub(super) planned: Option<usize>,
    /// Frames of the slide before; 0 for the first.
    pub(super) before: usize,
}

impl Frames {
    /// Frames that are expected to come: those that are planned, or else as many as were shown, or what the slide before had more.
    fn expected(self) -> usize {
        self.planned.unwrap_or(self.shown.max(self.before.saturating_sub(self.shown)))
    }

    /// Nodes to trace before the next frame for a table of `nodes` in all, with `per_frame` nodes for a frame; 0 if it does not pay. It does if frames
    /// with the finer table will be as many as those before it. A slide of a single frame has nothing to show meanwhile, and gets the whole table at once.
    fn share(self, nodes: usize, per_frame: f64) -> usize {
        let expected = self.expected();
        let pays = 2.0 * nodes as f64 <= per_frame * expected as f64;
        match (pays, self.shown) {
            (false, _) => 0,
            (true, 0) if expected == 1 => usize::MAX,
            (true, 0) => 0,
            (true, _) => (per_frame as usize).max(1),
        }
    }
}

/// Nodes of a table with another node in the middle of each cell.
fn halved_cells(nodes: [usize; 3]) -> [usize; 3] {
    // Two-dimensional tables have one node along z.
    nodes.map(|n| if n > 1 { 2 * n - 1 } else { 1 })
}

impl Run<'_> {
    /// Whether tables are refined: those of smooth pictures whose nodes the scene leaves open.
    fn refines(&self) -> bool {
        let settings = &self.plan.scene.surrogate;
        let is_open = settings.refine && settings.table_nodes.is_none() && self.learning.sizing.is_none();
        is_open && settings.kind == Kind::Table && self.render.method.is_smooth() && !self.progress.is_refused_nodes
    }

    /// Traces about `most` further nodes of a finer table. Returns whether the surrogate has it now.
    fn refine_table<B: Backend>(&mut self, on: &mut On<B>, nodes: [usize; 3], most: usize) -> Result<bool, RunEnd> {
        let On { backend, tracer, surrogate, .. } = on;
        let all: usize = nodes.iter().product();
        let Some(surrogate) = surrogate.as_mut().filter(|_| all <= backend.most_refined_nodes()) else { return Ok(false) };
        let refined = self.threads.render().install(|| surrogate.refine_table(present(tracer), nodes, most, self.stop));
        check_stop(self.stop)?;
        match refined {
            // The picture does not need them.
            Err(error) if error.is_refusal() => {
                tracing::info!("the table keeps its nodes: {error}");
                self.progress.is_refused_nodes = true;
                Ok(false)
            }
            refined => Ok(refined?),
        }
    }
}

impl<B: Backend> Cycle<'_, B> {
    /// Traces part of a finer table if enough frames will show it. The picture starts anew once it is complete.
    pub(super) fn refine(&mut self, slide: &Slide, frames: Frames) -> Result<(), RunEnd> {
        if !self.run.refines() {
            return Ok(());
        }
        let [width, height] = [self.run.plan.scene.render.width, self.run.plan.scene.render.height];
        let samples = (width * height) as f64 * self.run.progress.affordable_samples(&self.run.render);
        loop {
            let (table, most, per_sample) = with!(&self.session, on => {
                let backend = &on.backend;
                (on.surrogate.as_ref().and_then(Surrogate::table_nodes), backend.most_refined_nodes(), backend.nodes_per_sample())
            });
            let Some(table) = table else { return Ok(()) };
            let nodes = halved_cells(table);
            let all: usize = nodes.iter().product();
            let begun = self.run.progress.refining.filter(|begun| *begun == nodes);
            let per_frame = samples * per_sample as f64;
            let share = if begun.is_some() { (per_frame as usize).max(1) } else { frames.share(all, per_frame) };
            if all > most || share == 0 {
                return Ok(());
            }
            self.run.progress.refining = Some(nodes);
            if !transaction!(self, slide, run, on => run.refine_table(on, nodes, share)) {
                return Ok(());
            }
            self.run.progress.refining = None;
            let (before, megabytes) = (&self.run.learning.why_nodes, (all * size_of::<f32>()) as f64 / 1e6);
            let halved = format!("cells of {table:?} halved after {} frames of slide {}", frames.shown, slide.index);
            let why = format!("{before}; {halved}; {megabytes:.2} MB");
            Decision::new("surrogate.table_nodes", format_args!("{nodes:?}"), why).enter(&mut self.run.report.decisions);
            // Its residuals are those of the coarser table.
            self.run.learning.trust.reset();
            with!(&mut self.session, on => on.picture = Default::default());
            self.probe_again(slide)?;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn planned(shown: usize, planned: usize) -> Frames {
        Frames { shown, planned: Some(planned), before: 0 }
    }

    #[test]
    fn a_finer_table_pays_if_frames_with_it_outnumber_those_before() {
        assert_eq!(planned(1, 9).share(500, 100.0), 0, "five frames for nodes, four to show them");
        assert_eq!(planned(1, 10).share(500, 100.0), 100);
        assert_eq!(planned(0, 10).share(500, 100.0), 0, "the first picture comes soon");
        assert_eq!(planned(0, 1).share(50, 100.0), usize::MAX, "a picture of many samples begins with the finer table");
        assert_eq!(planned(0, 1).share(51, 100.0), 0);
    }

    #[test]
    fn without_a_plan_a_picture_is_expected_to_stand_as_long_as_it_stood() {
        let open = |shown, before| Frames { shown, planned: None, before };
        assert_eq!(open(9, 0).share(500, 100.0), 0);
        assert_eq!(open(10, 0).share(500, 100.0), 100);
        assert_eq!(open(1, 11).share(500, 100.0), 100, "the slide before had eleven frames");
        assert_eq!(open(1, 10).share(500, 100.0), 0);
    }

    #[test]
    fn every_node_of_a_table_stays_one() {
        assert_eq!(halved_cells([41, 2, 1]), [81, 3, 1]);
    }
}
