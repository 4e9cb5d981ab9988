//! A tracer that can be stopped. It traces large batches in parts and checks the stop flag between them, because preparing a slide may take minutes.

use super::DeviceError;
use ridgewatch_base::progress::Work;
use ridgewatch_field::DomainPoint;
use ridgewatch_flow::{Extras, Traced, Tracer};
use ridgewatch_surrogate::Trace;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

/// Seeds of the first part, which measures the speed.
const FIRST_PART: usize = 1 << 12;
/// Target duration of a part in seconds. Larger parts sort better, smaller ones react sooner to a stop.
const PART_SECONDS: f64 = 0.5;

/// A tracer that ends early if the stop flag is set. The results of seeds that are not traced by then are NaN, so the caller must check the flag
/// before it uses them.
pub struct Interruptible<'a> {
    tracer: &'a dyn Trace,
    stop: &'a AtomicBool,
    /// Seeds of the next part, from the latest measured speed.
    part: Mutex<usize>,
}

impl<'a> Interruptible<'a> {
    /// Wraps `tracer`; setting `stop` ends its work early.
    pub fn new(tracer: &'a dyn Trace, stop: &'a AtomicBool) -> Self {
        Self { tracer, stop, part: Mutex::new(FIRST_PART) }
    }

    fn part(&self) -> usize {
        self.part.lock().map_or(FIRST_PART, |part| *part)
    }

    /// Adapts the size of the next part to the measured speed.
    fn measured(&self, seeds: usize, seconds: f64) {
        if let Ok(mut part) = self.part.lock() {
            let wanted = (seeds as f64 * PART_SECONDS / seconds.max(1e-6)) as usize;
            // Growth is limited to a factor of 4: a part of seeds in missing cells takes no time and does not predict the next part.
            *part = wanted.clamp(FIRST_PART / 8, part.saturating_mul(4));
        }
    }
}

impl Trace for Interruptible<'_> {
    fn flow(&self) -> &dyn Tracer {
        self.tracer.flow()
    }

    fn trace(&self, seeds: &[DomainPoint], extras: Extras, out: &mut Traced) -> Result<(), DeviceError> {
        let mut done = 0;
        let mut piece = Traced::default();
        *out = Traced::default();
        let work = Work::begin("tracing");
        while done < seeds.len() && !self.stop.load(Ordering::Relaxed) {
            work.reached(done, seeds.len());
            let part = &seeds[done..seeds.len().min(done + self.part())];
            let start = Instant::now();
            if part.len() == seeds.len() {
                self.tracer.trace(part, extras, out)?;
            } else {
                self.tracer.trace(part, extras, &mut piece)?;
                out.append(&mut piece);
            }
            done += part.len();
            self.measured(part.len(), start.elapsed().as_secs_f64());
        }
        if done < seeds.len() {
            // Either all seeds have f64 values or no seed has one.
            let double = !out.log_stretch_f64.is_empty();
            out.set_len(seeds.len(), extras, double);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ridgewatch_field::{Domain, DomainPoint};

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
        fn trace(&self, seeds: &[DomainPoint], extras: Extras, out: &mut Traced) {
            let mut traced = self.traced.lock().unwrap();
            *traced += seeds.len();
            self.stop.fetch_or(*traced >= self.limit, Ordering::Relaxed);
            out.log_stretch = seeds.iter().map(|s| s.0[0]).collect();
            out.lifetime_share = vec![1.0; seeds.len()];
            out.arrival = if extras.arrival { seeds.to_vec() } else { Vec::new() };
        }
    }

    fn traced(limit: usize) -> (Vec<DomainPoint>, Traced) {
        let stop = AtomicBool::new(false);
        let counting = Counting { domain: Domain::cuboid([0.0; 3], [1.0; 3]), traced: Mutex::new(0), limit, stop: &stop };
        let seeds: Vec<DomainPoint> = (0..100_000).map(|i| DomainPoint([i as f32, 0.0, 0.0])).collect();
        let mut out = Traced::default();
        Interruptible::new(&counting, &stop).trace(&seeds, Extras { arrival: true, jacobian: false }, &mut out).unwrap();
        (seeds, out)
    }

    #[test]
    fn parts_join_to_the_whole() {
        let (seeds, out) = traced(usize::MAX);
        assert_eq!(out.arrival, seeds);
        assert!(out.log_stretch.iter().zip(&seeds).all(|(s, seed)| *s == seed.0[0]));
        assert_eq!((out.lifetime_share.len(), out.log_stretch_f64.len(), out.jacobian.len()), (seeds.len(), 0, 0));
    }

    #[test]
    fn what_a_stop_left_untraced_is_no_number() {
        let (seeds, out) = traced(5000);
        let known = out.log_stretch.iter().filter(|s| !s.is_nan()).count();
        assert!((5000..seeds.len()).contains(&known), "{known}");
        assert_eq!((out.log_stretch.len(), out.lifetime_share.len(), out.arrival.len()), (seeds.len(), seeds.len(), seeds.len()));
        assert!(out.log_stretch[known..].iter().all(|s| s.is_nan()));
    }
}
