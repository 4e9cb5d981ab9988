//! What training tells of a device that has no memory for a copy of the network; what it comes back to.

use super::*;
use crate::field::Domain;
use crate::field::analytic::Analytic;
use crate::flow::{FlowMap, VelocitySource, cpu_tracer};
use crate::surrogate::{Copied, OffloadedTraining};
use std::ops::Range;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

/// A device that takes steps, whatever they are, and has no memory for a copy; how often it was waited for.
#[derive(Clone, Default)]
struct Full(Arc<AtomicUsize>);

fn trainer() -> Trainer {
    let source = VelocitySource::Analytic(Analytic::Saddle { rate: 1.0 }, Domain::slab([0.0; 2], [1.0; 2], (0.0, 1.0)));
    let tracer = cpu_tracer(source, &FlowMap::tangent(1.0, 4), 0.0).unwrap();
    let settings = NetworkSettings { levels: 2, log2_table: 4, width: 16, batch: 64, ..NetworkSettings::default() };
    Trainer::new(&settings, &*tracer, 1, false).unwrap()
}

fn labels() -> ReplayBuffer {
    let points: Vec<[f32; 3]> = (0..64).map(|i| [i as f32 / 64.0, 0.5, 0.5]).collect();
    ReplayBuffer::holding(&Samples { log_stretch: vec![1.0; points.len()], points, ..Samples::default() })
}

impl Offload for Full {
    fn takes(&self, _: &Architecture, _: &Objective) -> bool {
        true
    }
    fn training(&self, _: &Model, _: &Objective, _: &Average, _: usize, _: usize) -> Result<Box<dyn OffloadedTraining>, NotTaken> {
        Ok(Box::new(self.clone()))
    }
}

impl OffloadedTraining for Full {
    fn bring(&mut self, ring: &ReplayBuffer, _: Option<&Table>) -> Result<Brought, NotTaken> {
        Ok(Brought { usable: ring.len(), dropped: 0 })
    }
    fn forget_labels(&mut self) {}
    fn let_go_of_base(&mut self) {}
    fn steps(&mut self, steps: &[PlannedStep]) -> Result<Vec<f64>, NotTaken> {
        Ok(vec![0.5; steps.len()])
    }
    fn keep(&mut self) -> Result<(), NotTaken> {
        Ok(())
    }
    fn roll_back(&mut self) -> Result<(), DeviceLost> {
        Ok(())
    }
    fn restart_average(&mut self) -> Result<(), DeviceLost> {
        Ok(())
    }
    fn zero_layers(&mut self, _: Range<usize>) -> Result<(), DeviceLost> {
        Ok(())
    }
    fn frozen(&self) -> Result<Arc<dyn OffloadedNetwork>, NotTaken> {
        Err(NotTaken::NoRoom("no room to predict, by the test".into()))
    }
    fn fetch(&self, _: &mut Model, _: &mut Average) -> Result<(), DeviceLost> {
        self.0.fetch_add(1, Ordering::Relaxed);
        Ok(())
    }
    fn copy(&mut self) -> Result<Copied, DeviceLost> {
        Ok(Copied::NoRoom("no room, by the test".into()))
    }
    fn device_seconds(&mut self) -> f64 {
        0.0
    }
}

/// Without memory for what predicts, the network comes back once for all questions until it changes.
#[test]
fn a_network_that_is_asked_twice_comes_back_once() {
    let (mut trainer, full, ring) = (trainer(), Full::default(), labels());
    let offload: Arc<dyn Offload> = Arc::new(full.clone());
    trainer.offload(&offload);
    assert_eq!(trainer.learn(&ring, None, f64::INFINITY, 4).steps, 4);
    let fetched = || full.0.load(Ordering::Relaxed);
    assert_eq!(fetched(), 0);
    let mut out = [0.0; 64];
    for _ in 0..3 {
        trainer.predict(&ring.samples().points, &mut out);
        assert_eq!(fetched(), 1);
    }
    trainer.forget_output();
    trainer.predict(&ring.samples().points, &mut out);
    assert_eq!(fetched(), 2, "it has changed");
    let learned = trainer.learn(&ring, None, f64::INFINITY, 4);
    assert!(learned.steps == 4 && !trainer.is_offloaded(), "{:?}", learned.warnings);
}

#[test]
fn a_network_that_is_waited_for_every_minute_is_told_of_once() {
    let (mut trainer, full, ring) = (trainer(), Full::default(), labels());
    let offload: Arc<dyn Offload> = Arc::new(full.clone());
    trainer.offload(&offload);
    let told: Vec<Vec<String>> = (0..4)
        .map(|call| {
            if call >= 2 {
                trainer.on_device.as_mut().unwrap().fetched_at -= Duration::from_secs(61);
            }
            trainer.learn(&ring, None, f64::INFINITY, 3).warnings
        })
        .collect();
    assert_eq!(full.0.load(Ordering::Relaxed), 2, "waited for when a minute had passed, and then again");
    assert!(told[2].len() == 1 && told[2][0].contains("training waited") && told[2][0].contains("no room, by the test"), "{told:?}");
    assert!([0, 1, 3].iter().all(|&call| told[call].is_empty()), "{told:?}");
}

#[test]
fn a_slide_keeps_the_memory_of_the_copy_but_nothing_comes_back_from_before_it() {
    let flow = VelocitySource::Analytic(Analytic::Saddle { rate: 0.7 }, Domain::slab([-1.0; 2], [1.0; 2], (0.0, 1.0)));
    let tracer = cpu_tracer(flow, &FlowMap::tangent(1.0, 4), 0.0).unwrap();
    let settings = NetworkSettings { levels: 2, log2_table: 8, width: 16, batch: 256, ..NetworkSettings::default() };
    let mut trainer = Trainer::new(&settings, &*tracer, 1, false).unwrap();
    let mut ring = ReplayBuffer::new(1000);
    let points: Vec<[f32; 3]> = (0..1000).map(|i| [i as f32 / 1000.0, (i % 7) as f32 / 7.0, 0.5]).collect();
    ring.push(&Samples { log_stretch: vec![0.7; points.len()], points, ..Samples::default() });
    let learn = |trainer: &mut Trainer| assert_eq!(trainer.learn(&ring, None, f64::INFINITY, 10).steps, 10);
    learn(&mut trainer);
    // So much is asked for nowhere else.
    let ([[tables, ..], _], _) = trainer.kept.as_mut().unwrap().here.as_mut().unwrap();
    tables.reserve_exact(12_345);
    let room = tables.capacity();
    let forgets: [fn(&mut Trainer, &dyn Tracer); 2] = [Trainer::window_slid, |trainer, _| trainer.forget_output()];
    for forget in forgets {
        let before = trainer.steps();
        forget(&mut trainer, &*tracer);
        let weights = trainer.model.tables();
        trainer.roll_back().unwrap_or_else(|_| unreachable!("no device is there"));
        assert_eq!((trainer.steps(), trainer.model.tables()), (before, weights.clone()), "there is nothing to come back to");
        learn(&mut trainer);
        let kept = trainer.kept.as_ref().unwrap();
        let ([[tables, ..], _], _) = kept.here.as_ref().unwrap();
        assert_eq!((kept.steps, tables), (before, &weights), "the first step of the new window is taken from a copy");
        assert_eq!(tables.capacity(), room, "in the same memory");
    }
}
