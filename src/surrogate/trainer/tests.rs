//! Tests of the warning for a device without memory for a copy, and of the state to roll back to.

use super::*;
use crate::{HostTraining, Samples, Table};
use ridgewatch_field::analytic::Analytic;
use ridgewatch_field::{Domain, UnitPoint};
use ridgewatch_flow::{FlowMap, VelocitySource, cpu_tracer};
use std::sync::Mutex;
use std::time::Duration;

/// A device that takes the CPU's steps and has no memory for a copy. Counts how often training waited for one.
struct Full(HostTraining, Mutex<u32>);

impl Training for Full {
    type Table = Table;
    type Network = <HostTraining as Training>::Network;

    fn shape(&self) -> &Architecture {
        self.0.shape()
    }
    fn steps_taken(&self) -> usize {
        self.0.steps_taken()
    }
    fn is_on_device(&self) -> bool {
        true
    }
    fn begin(&mut self, objective: &Objective, capacity: usize, batch: usize) -> Result<(), DeviceError> {
        self.0.begin(objective, capacity, batch)
    }
    fn sync(&mut self, objective: &Objective, labels: Labels<'_, Table>) -> Result<SyncedSamples, DeviceError> {
        self.0.sync(objective, labels)
    }
    fn train(&mut self, objective: &Objective, labels: Labels<'_, Table>, steps: &[PlannedStep]) -> Result<Vec<f64>, DeviceError> {
        self.0.train(objective, labels, steps)
    }
    fn group(&self, seconds: f64) -> u64 {
        self.0.group(seconds)
    }
    fn keep(&mut self) -> Result<(), DeviceError> {
        self.0.keep()
    }
    fn roll_back(&mut self) -> Result<(), DeviceError> {
        self.0.roll_back()
    }
    fn restart_average(&mut self) -> Result<(), DeviceError> {
        self.0.restart_average()
    }
    fn settle(&mut self) {
        self.0.settle();
    }
    fn zero_output(&mut self) -> Result<(), DeviceError> {
        self.0.zero_output()
    }
    fn forget_labels(&mut self) {}
    fn frozen(&self, objective: &Objective) -> Result<Arc<Self::Network>, DeviceError> {
        self.0.frozen(objective)
    }
    fn download(&self) -> Result<HostNetwork, DeviceError> {
        self.0.download()
    }
    fn copy(&mut self) -> Result<NetworkCopy, DeviceError> {
        *self.1.lock().unwrap() += 1;
        Ok(NetworkCopy::Ready(self.0.download()?, Some("no room, by the test".into())))
    }
    fn host_copy(&self) -> &HostNetwork {
        self.0.host_copy()
    }
    fn set_host_copy(&mut self, network: HostNetwork) {
        self.0.set_host_copy(network);
    }
    fn restore(&mut self, network: HostNetwork) {
        self.0.restore(network);
    }
    fn device_seconds(&mut self) -> Option<f64> {
        Some(0.0)
    }
}

fn tracer() -> Box<dyn Tracer> {
    let flow = VelocitySource::Analytic(Analytic::Saddle { rate: 0.7 }, Domain::slab([-1.0; 2], [1.0; 2], (0.0, 1.0)));
    cpu_tracer(flow, &FlowMap::tangent(1.0, 4), 0.0).unwrap()
}

fn labels() -> ReplayBuffer {
    let points: Vec<UnitPoint> = (0..1000).map(|i| UnitPoint([i as f32 / 1000.0, (i % 7) as f32 / 7.0, 0.5])).collect();
    ReplayBuffer::holding(&Samples { log_stretch: vec![0.7; points.len()], points, ..Samples::default() })
}

fn trainer<T: Training>(training: impl FnOnce(HostTraining) -> T) -> Trainer<T> {
    let settings = NetworkSettings { levels: Some(2), log2_table: Some(8), width: 16, batch: Some(256), ..NetworkSettings::default() };
    Trainer::new(&settings, &*tracer(), 1, false, |model| training(HostTraining::new(HostNetwork::fresh(model)))).unwrap()
}

#[test]
fn a_device_without_room_for_a_copy_is_waited_for_every_minute_and_warned_of_once() {
    let (mut trainer, buffer) = (trainer(|host| Full(host, Mutex::new(0))), labels());
    let warnings: Vec<Vec<String>> = (0..4)
        .map(|call| {
            if call >= 2 {
                trainer.copies.made -= Duration::from_secs(61);
            }
            trainer.learn(&buffer, None, f64::INFINITY, 3).unwrap().warnings
        })
        .collect();
    assert_eq!(*trainer.training.1.lock().unwrap(), 2, "waited for when a minute had passed, and then again");
    assert!(warnings[2].len() == 1 && warnings[2][0].contains("training waited") && warnings[2][0].contains("no room, by the test"));
    assert!([0, 1, 3].iter().all(|&call| warnings[call].is_empty()), "{warnings:?}");
}

#[test]
fn a_slide_keeps_the_memory_of_the_copy_but_rolls_back_to_nothing_before_it() {
    let (mut trainer, buffer) = (trainer(|host| host), labels());
    let learn = |trainer: &mut Trainer<HostTraining>| assert_eq!(trainer.learn(&buffer, None, f64::INFINITY, 10).unwrap().steps, 10);
    learn(&mut trainer);
    // A capacity that nothing else asks for.
    let ([[tables, ..], _], _, _) = trainer.training.kept.as_mut().unwrap();
    tables.reserve_exact(12_345);
    let room = tables.capacity();
    let forgets: [fn(&mut Trainer<HostTraining>); 2] =
        [|trainer| trainer.window_slid(&*tracer()), |trainer| trainer.forget_output().unwrap()];
    for forget in forgets {
        let before = trainer.training.steps_taken();
        forget(&mut trainer);
        let weights = trainer.training.host_copy().model.tables();
        trainer.roll_back().unwrap();
        let after = (trainer.training.steps_taken(), trainer.training.host_copy().model.tables());
        assert_eq!(after, (before, weights.clone()), "there is nothing to roll back to");
        learn(&mut trainer);
        let ([[tables, ..], _], _, steps) = trainer.training.kept.as_ref().unwrap();
        assert_eq!((*steps, tables), (before, &weights), "the first step of the new window starts from a copy");
        assert_eq!(tables.capacity(), room, "in the same memory");
    }
}
