//! Hears a request to stop while a slide is prepared, which may take minutes: tables, probes, the pilot.

use super::EngineError;
use crate::field::Domain;
use crate::flow::{Extras, StepChoice, Traced, TracedNodes, Tracer};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Instant;

/// Why preparing did not come to its end.
pub(super) enum Halt {
    /// The run's own time is over.
    TimeIsUp,
    /// Somebody asked for it.
    Stopped,
    /// It failed.
    Failed(EngineError),
}

impl<E: Into<EngineError>> From<E> for Halt {
    fn from(error: E) -> Self {
        Halt::Failed(error.into())
    }
}

/// An error once a stop is asked for.
pub(super) fn heed(stop: &AtomicBool) -> Result<(), Halt> {
    if stop.load(Ordering::Relaxed) { Err(Halt::Stopped) } else { Ok(()) }
}

/// Seeds of the first part, from which the speed is read off.
const FIRST_PART: usize = 1 << 12;
/// Seconds that a part should take: large parts sort better, small ones hear sooner.
const PART_SECONDS: f64 = 0.5;

/// A tracer that gives up once a stop is asked for: what it has not traced by then is NaN. Whoever uses it must [`heed`] the stop
/// before believing a result.
pub(super) struct Interruptible<'a> {
    tracer: &'a dyn Tracer,
    stop: &'a AtomicBool,
    /// Seeds that a part should have, by the speed measured last.
    part: Mutex<usize>,
}

impl<'a> Interruptible<'a> {
    pub(super) fn new(tracer: &'a dyn Tracer, stop: &'a AtomicBool) -> Self {
        Self { tracer, stop, part: Mutex::new(FIRST_PART) }
    }

    fn part(&self) -> usize {
        self.part.lock().map_or(FIRST_PART, |part| *part)
    }

    /// Takes the speed of `seeds` in `seconds` in.
    fn measured(&self, seeds: usize, seconds: f64) {
        if let Ok(mut part) = self.part.lock() {
            let wanted = (seeds as f64 * PART_SECONDS / seconds.max(1e-6)) as usize;
            // Fourfold at most: a part of void seeds takes no time and says little about the next.
            *part = wanted.clamp(FIRST_PART / 8, part.saturating_mul(4));
        }
    }
}

impl Tracer for Interruptible<'_> {
    fn domain(&self) -> &Domain {
        self.tracer.domain()
    }

    fn start(&self) -> f64 {
        self.tracer.start()
    }

    fn tau(&self) -> f64 {
        self.tracer.tau()
    }

    fn steps(&self) -> usize {
        self.tracer.steps()
    }

    fn step_choice(&self) -> Option<StepChoice> {
        self.tracer.step_choice()
    }

    fn is_missing(&self, seed: [f32; 3]) -> bool {
        self.tracer.is_missing(seed)
    }

    /// In one go: a device that traces all nodes does so in a second or two.
    fn trace_nodes(&self, nodes: [usize; 3]) -> Option<Arc<dyn TracedNodes>> {
        if self.stop.load(Ordering::Relaxed) { None } else { self.tracer.trace_nodes(nodes) }
    }

    fn trace(&self, seeds: &[[f32; 3]], extras: Extras, out: &mut Traced) {
        let mut done = 0;
        let mut piece = Traced::default();
        *out = Traced::default();
        while done < seeds.len() && !self.stop.load(Ordering::Relaxed) {
            let part = &seeds[done..seeds.len().min(done + self.part())];
            let start = Instant::now();
            if part.len() == seeds.len() {
                self.tracer.trace(part, extras, out);
            } else {
                self.tracer.trace(part, extras, &mut piece);
                out.log_stretch.append(&mut piece.log_stretch);
                out.log_stretch_f64.append(&mut piece.log_stretch_f64);
                out.lived.append(&mut piece.lived);
                out.arrival.append(&mut piece.arrival);
                out.jacobian.append(&mut piece.jacobian);
            }
            done += part.len();
            self.measured(part.len(), start.elapsed().as_secs_f64());
        }
        if done < seeds.len() {
            // Unrounded values are there for all seeds or for none.
            let double = !out.log_stretch_f64.is_empty();
            out.set_len(seeds.len(), extras, double);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Log-stretch = x; asks for a stop once it has traced `limit` seeds.
    struct Counting<'a> {
        domain: Domain,
        traced: Mutex<usize>,
        limit: usize,
        stop: &'a AtomicBool,
    }

    impl Tracer for Counting<'_> {
        fn domain(&self) -> &Domain {
            &self.domain
        }
        fn start(&self) -> f64 {
            0.0
        }
        fn tau(&self) -> f64 {
            1.0
        }
        fn steps(&self) -> usize {
            1
        }
        fn trace(&self, seeds: &[[f32; 3]], extras: Extras, out: &mut Traced) {
            let mut traced = self.traced.lock().unwrap();
            *traced += seeds.len();
            self.stop.fetch_or(*traced >= self.limit, Ordering::Relaxed);
            out.log_stretch = seeds.iter().map(|s| s[0]).collect();
            out.lived = vec![1.0; seeds.len()];
            out.arrival = if extras.arrival { seeds.to_vec() } else { Vec::new() };
        }
    }

    fn traced(limit: usize) -> (Vec<[f32; 3]>, Traced) {
        let stop = AtomicBool::new(false);
        let counting = Counting { domain: Domain::cuboid([0.0; 3], [1.0; 3]), traced: Mutex::new(0), limit, stop: &stop };
        let seeds: Vec<[f32; 3]> = (0..100_000).map(|i| [i as f32, 0.0, 0.0]).collect();
        let mut out = Traced::default();
        Interruptible::new(&counting, &stop).trace(&seeds, Extras { arrival: true, jacobian: false }, &mut out);
        (seeds, out)
    }

    #[test]
    fn parts_join_to_the_whole() {
        let (seeds, out) = traced(usize::MAX);
        assert_eq!(out.arrival, seeds);
        assert!(out.log_stretch.iter().zip(&seeds).all(|(s, seed)| *s == seed[0]));
        assert_eq!((out.lived.len(), out.log_stretch_f64.len(), out.jacobian.len()), (seeds.len(), 0, 0));
    }

    #[test]
    fn what_a_stop_left_untraced_is_no_number() {
        let (seeds, out) = traced(5000);
        let known = out.log_stretch.iter().filter(|s| !s.is_nan()).count();
        assert!((5000..seeds.len()).contains(&known), "{known}");
        assert_eq!((out.log_stretch.len(), out.lived.len(), out.arrival.len()), (seeds.len(), seeds.len(), seeds.len()));
        assert!(out.log_stretch[known..].iter().all(|s| s.is_nan()));
    }
}
