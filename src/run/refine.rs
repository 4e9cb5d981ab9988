//! A finer table for a picture that stands still.
//!
//! The table of a new window has few nodes, so that its first picture comes soon. From then on nodes and samples share the time: finer nodes take more
//! error away than the samples that could be drawn meanwhile (docs/smooth.md has the measurements). The part that a frame traces and the choice to begin
//! follow from counts of nodes, samples and frames, not from a clock, so that a run can be repeated; with a budget, whose samples follow the
//! clock as well, from the time that a traced point takes.

use super::cycle::Cycle;
use super::decision::Decision;
use super::slides::Slide;
use super::state::Run;
use super::stop::{RunEnd, check_stop};
use super::transaction::{On, present, transaction, with};
use crate::backend::{Backend, Surrogate};
use crate::render::{Method, RenderSettings};
use crate::surrogate::Kind;
use std::time::Instant;

/// Frames of a picture that stands still.
#[derive(Debug, Clone, Copy)]
pub(super) struct Frames {
    /// Those that were shown since the window slid or a command changed something.
    pub(super) shown: usize,
    /// Those still to come, if the end is known.
    pub(super) left: Option<usize>,
    /// Frames of the slide before; 0 for the first.
    pub(super) before: usize,
    /// True if the run has no other slide.
    pub(super) is_only_slide: bool,
    /// Frames by which nodes were put off: they pay as they did before.
    pub(super) put_off: usize,
}

/// Nodes of a finer table for a frame.
#[derive(Debug, Clone, Copy)]
struct NodesPerFrame {
    /// As many as its samples are worth, or as its budget allows.
    worth: f64,
    /// As many as take as long as its samples.
    as_long: f64,
    /// As many as a frame traces if that completes a table that is not begun.
    most: f64,
}

impl Frames {
    /// Frames that are expected to come: those that are left, or else as many as were shown, or how many more the slide before had.
    fn expected(self) -> usize {
        let shown = self.shown - self.put_off;
        self.left.map_or(shown.max(self.before.saturating_sub(shown)), |left| left + self.put_off)
    }

    /// Nodes to trace before the next frame for a table of `nodes` in all; 0 if it does not pay. It does if tracing takes at most half of the frames that are
    /// expected. A slide of a single frame has nothing to show meanwhile, and gets the whole table at once; if others follow, it takes at most twice as
    /// long for that.
    fn part(self, nodes: usize, per_frame: NodesPerFrame) -> usize {
        let nodes = nodes as f64;
        let pays = 2.0 * nodes <= per_frame.worth * self.expected() as f64;
        let is_too_long = !self.is_only_slide && nodes > per_frame.as_long;
        match (pays, self.shown) {
            (false, _) => 0,
            (true, 0) if self.left == Some(1) && !is_too_long => usize::MAX,
            (true, 0) => 0,
            (true, _) if nodes <= per_frame.most => usize::MAX,
            (true, _) => (per_frame.worth as usize).max(1),
        }
    }
}

/// Nodes of a table with another node in the middle of each cell.
fn halved_cells(nodes: [usize; 3]) -> [usize; 3] {
    // Two-dimensional tables have one node along z.
    nodes.map(|n| if n > 1 { 2 * n - 1 } else { 1 })
}

/// A table that replaced a coarser one.
struct Refined {
    from: [usize; 3],
    to: [usize; 3],
}

impl Run<'_> {
    /// Whether tables are refined: those of smooth pictures whose nodes the scene leaves open.
    pub(super) fn refines(&self) -> bool {
        let settings = &self.plan.scene.surrogate;
        let is_open = settings.refine && settings.table_nodes.is_none() && self.learning.sizing.is_none();
        is_open && settings.kind == Kind::Table && self.render.method.is_smooth() && !self.progress.lacks_room_for_nodes
    }

    fn nodes_per_frame<B: Backend>(&self, backend: &B) -> NodesPerFrame {
        let RenderSettings { width, height, samples, method, budget, .. } = self.render;
        if let Some(milliseconds) = budget {
            let nodes = self.progress.cost.map_or(0.0, |cost| cost.nodes(1e-3 * milliseconds));
            return NodesPerFrame { worth: nodes, as_long: nodes, most: nodes };
        }
        // The samples of `marched` only measure its error.
        let samples = if method == Method::Marched { 1.0 } else { samples };
        let [worth, as_long] = backend.nodes_per_sample().map(|nodes| (width * height * nodes) as f64 * samples);
        // Two frames' nodes in one: the samples of the first would be lost when the second completes the table.
        NodesPerFrame { worth, as_long, most: 2.0 * worth }
    }

    /// Traces part of a finer table, if frames enough will show it.
    fn refine_table<B: Backend>(&mut self, on: &mut On<B>, frames: Frames) -> Result<Option<Refined>, RunEnd> {
        let On { backend, tracer, surrogate, .. } = on;
        let Some(surrogate) = surrogate else { return Ok(None) };
        let Some(from) = surrogate.table_nodes() else { return Ok(None) };
        let to = halved_cells(from);
        let all: usize = to.iter().product();
        let per_frame = self.nodes_per_frame(backend);
        let part = match surrogate.finer_nodes() {
            Some(begun) if begun == to => (per_frame.worth as usize).max(1),
            _ if all > backend.most_refined_nodes() => 0,
            _ => frames.part(all, per_frame),
        };
        if part == 0 {
            return Ok(None);
        }
        let refined = self.threads.render().install(|| surrogate.refine_table(present(tracer), to, part, self.stop));
        check_stop(self.stop)?;
        match refined {
            // The picture can do without.
            Err(error) if error.is_refusal() => {
                self.progress.warnings.push(format!("the table keeps its nodes in this slide: {error}"));
                self.progress.lacks_room_for_nodes = true;
                Ok(None)
            }
            refined => Ok(refined?.then_some(Refined { from, to })),
        }
    }
}

impl<B: Backend> Cycle<'_, B> {
    /// Traces part of a finer table if enough frames will show it. The picture starts anew once it is complete. Returns the seconds that it took.
    pub(super) fn refine(&mut self, slide: &Slide, frames: Frames) -> Result<f64, RunEnd> {
        let begin = Instant::now();
        if !self.run.refines() {
            return Ok(0.0);
        }
        let mut is_refined = false;
        while let Some(Refined { from, to }) = transaction!(self, slide, run, on => run.refine_table(on, frames)) {
            let (before, megabytes) = (&self.run.learning.why_nodes, (to.iter().product::<usize>() * size_of::<f32>()) as f64 / 1e6);
            let halved = format!("cells of {from:?} halved after {} frames of slide {}", frames.shown, slide.index);
            let why = format!("{before}; {halved}; {megabytes:.2} MB");
            Decision::new("surrogate.table_nodes", format_args!("{to:?}"), why).enter(&mut self.run.report.decisions);
            is_refined = true;
            if frames.shown > 0 {
                break;
            }
        }
        if is_refined {
            // Its residuals are those of the coarser table.
            self.run.learning.trust.reset();
            with!(&mut self.session, on => on.picture = Default::default());
            self.probe_again(slide)?;
        }
        let is_in_progress = with!(&self.session, on => on.surrogate.as_ref().and_then(Surrogate::finer_nodes).is_some());
        Ok(if is_refined || is_in_progress { begin.elapsed().as_secs_f64() } else { 0.0 })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const FEW: NodesPerFrame = NodesPerFrame { worth: 100.0, as_long: 50.0, most: 200.0 };

    fn left(shown: usize, left: usize) -> Frames {
        Frames { shown, left: Some(left), before: 0, is_only_slide: true, put_off: 0 }
    }

    #[test]
    fn a_finer_table_pays_if_tracing_it_takes_half_of_the_frames_at_most() {
        assert_eq!(left(1, 9).part(500, FEW), 0);
        assert_eq!(left(1, 10).part(500, FEW), 100);
        assert_eq!([200, 201].map(|nodes| left(1, 10).part(nodes, FEW)), [usize::MAX, 100], "the nodes of two frames come at once");
        assert_eq!(Frames { put_off: 1, ..left(2, 9) }.part(500, FEW), 100, "as with one frame fewer");
        assert_eq!(left(0, 10).part(500, FEW), 0, "the first picture comes soon");
        assert_eq!(left(0, 1).part(50, FEW), usize::MAX, "a picture of many samples begins with the finer table");
        assert_eq!(left(0, 1).part(51, FEW), 0);
    }

    #[test]
    fn a_window_that_slides_at_every_frame_takes_at_most_twice_as_long() {
        let part = |nodes, as_long| Frames { is_only_slide: false, ..left(0, 1) }.part(nodes, NodesPerFrame { as_long, ..FEW });
        assert_eq!([part(40, 40.0), part(40, 39.0)], [usize::MAX, 0]);
    }

    #[test]
    fn without_an_end_a_picture_is_expected_to_stand_as_long_as_it_stood() {
        let open = |shown, before| Frames { shown, left: None, before, is_only_slide: false, put_off: 0 };
        assert_eq!(open(9, 0).part(500, FEW), 0);
        assert_eq!(open(10, 0).part(500, FEW), 100);
        assert_eq!(open(1, 11).part(500, FEW), 100, "the slide before had eleven frames");
        assert_eq!(open(1, 10).part(500, FEW), 0);
        assert_eq!(open(0, 1).part(0, FEW), 0, "a slide whose end is open may have more frames than one");
    }

    #[test]
    fn every_node_of_a_table_stays_one() {
        assert_eq!(halved_cells([41, 2, 1]), [81, 3, 1]);
    }
}
