//! Runs whose network is trained on the device, against the same runs on the CPU.

use super::network_support::{traced, uniform_points};
use super::scenes::*;
use super::small;
use crate::kit::scene;
use ridgewatch::backend::cuda::{CudaTracer, GpuSettings, SnapshotStore, Tuning};
use ridgewatch::backend::{Device, WhenLost};
use ridgewatch::chart::{TrainOptions, train};
use ridgewatch::publish::compare_films;
use ridgewatch::run::{Decision, Frame, RunOptions};
use ridgewatch::surrogate::network::{Encoding, NetworkSettings};
use ridgewatch::surrogate::{Kind, ReplayBuffer};
use std::sync::atomic::AtomicBool;

/// A small run that trains a fixed number of steps a frame.
fn turbulence() -> String {
    scene::gated_turbulence(
        "
        time.tau = 8
        time.frames_per_slide = 3
        flow.steps = 16
        surrogate.kind = \"residual\"
        network.width = 16
        training.steps_per_frame = 60
        ",
    )
}

/// What the device learned is worth as much as what the CPU learned, goes into a checkpoint, and either goes on from the other's.
#[test]
#[ignore = "needs a GPU"]
fn a_run_trains_on_the_device_and_goes_on_on_either() {
    let folder = tempfile::tempdir().unwrap();
    let gpu = device(GpuSettings::default());
    let file = |name: &str| folder.path().join(name);
    let (count, steps) = if small() { (2, 10) } else { (6, 60) };
    let learned = |device: &Device, from: Option<&str>, to: &str| {
        let options = RunOptions { device: device.clone(), checkpoint: Some(file(to)), ..RunOptions::default() };
        let mut keys = vec![
            "surrogate.kind=\"network\"".to_owned(),
            format!("time.frames_per_slide={count}"),
            format!("training.steps_per_frame={steps}"),
        ];
        keys.extend(from.map(|from| format!("training.resume=\"{}\"", file(from).display())));
        let frames = frames(&turbulence(), &keys, &options);
        for frame in &frames {
            let learned = frame.record.training.clone().unwrap();
            assert_eq!((learned.steps, learned.rollbacks), (steps, 0));
            assert_eq!(learned.device_seconds.is_some(), device.is_gpu());
            assert!(warnings(&frame.record).is_empty(), "{:?}", frame.record.warnings);
        }
        let psnr = |frame: &Frame| frame.record.surrogate_psnr.unwrap();
        // The first frame is answered by what the run began with.
        (psnr(&frames[0]), psnr(&frames[count - 1]))
    };
    let (gpu_first, gpu_last) = learned(&gpu, None, "gpu");
    let (cpu_first, cpu_last) = learned(&Device::CPU, None, "cpu");
    let (on_cpu, on_cpu_last) = learned(&Device::CPU, Some("gpu"), "gpu, then cpu");
    let (on_gpu, on_gpu_last) = learned(&gpu, Some("cpu"), "cpu, then gpu");
    measured!(
        "what a network knows, dB: GPU {gpu_first:.2} to {gpu_last:.2}, then CPU {on_cpu:.2} to {on_cpu_last:.2}; CPU {cpu_first:.2} to {cpu_last:.2}, then GPU {on_gpu:.2} to {on_gpu_last:.2}"
    );
    if small() {
        println!("not held against the CPU's: so few steps say nothing");
        return;
    }
    assert!(gpu_last > gpu_first + 5.0 && cpu_last > cpu_first + 5.0, "both learn");
    assert!((gpu_last - cpu_last).abs() < 1.0, "as much");
    // A checkpoint is of the end of a run, whose last frame was answered by the network before its last 60 steps.
    assert!(on_cpu > gpu_last - 0.5 && on_gpu > cpu_last - 0.5 && on_cpu_last > on_cpu - 0.5 && on_gpu_last > on_gpu - 0.5, "and go on");
}

/// A double gyre whose start is an input of the network, over slides: what the device learns is worth what the CPU learns, and labels outlive
/// slides on both.
#[test]
#[ignore = "needs a GPU"]
fn a_network_with_the_start_time_slides_on_the_device() {
    let gyre = scene::double_gyre(
        [48, 24, 4],
        "
            time.tau = 5
            time.seed_step = 0.5
            time.slides = 4
            time.frames_per_slide = 4
            flow.steps = 25
            surrogate.kind = \"network\"
            network.inputs = [\"start\"]
            network.log2_table = 16
            network.width = 32
            network.batch = 4096
            training.steps_per_frame = 200
        ",
    );
    let keys = if small() { vec!["training.steps_per_frame=20".to_owned(), "time.slides=2".to_owned()] } else { Vec::new() };
    let made = |device: &Device| frames(&gyre, &keys, &RunOptions { device: device.clone(), ..RunOptions::default() });
    let (found, expected) = (made(&device(GpuSettings::default())), made(&Device::CPU));
    let psnr = |frames: &[Frame]| -> Vec<f64> { frames.iter().map(|frame| frame.record.surrogate_psnr.unwrap()).collect() };
    println!("dB: GPU {:.1?}, CPU {:.1?}", psnr(&found), psnr(&expected));
    for (frames, learns_there) in [(&found, true), (&expected, false)] {
        for pair in frames.windows(2) {
            let [before, after] = [&pair[0].record, &pair[1].record];
            assert!(
                after.replay_samples > before.replay_samples,
                "frame {}: {} samples, then {}",
                after.frame,
                before.replay_samples,
                after.replay_samples
            );
            assert!(warnings(after).is_empty(), "{:?}", after.warnings);
            assert_eq!(after.training.as_ref().unwrap().device_seconds.is_some(), learns_there);
        }
        assert!(psnr(frames)[frames.len() - 1] > psnr(frames)[0] + 5.0, "it learns");
    }
    // A device learns from all that it traces, the CPU from what is kept.
    assert!(psnr(&found).last().unwrap() > &(psnr(&expected).last().unwrap() - 1.0), "as much");
}

/// A rate at which Adam throws every weight across the whole landscape: a run rolls back, counts it, and shows what it can.
#[test]
#[ignore = "needs a GPU"]
fn a_run_whose_network_diverges_goes_on() {
    let options = RunOptions { device: device(GpuSettings::default()), ..RunOptions::default() };
    let mut keys = vec!["network.learning_rate=1", "surrogate.kind=\"network\""];
    keys.extend(if small() { &["training.steps_per_frame=20", "time.frames_per_slide=2"][..] } else { &[] });
    let frames = frames(&answered(), &keys.into_iter().map(str::to_owned).collect::<Vec<_>>(), &options);
    let learned: Vec<_> = frames.iter().map(|frame| frame.record.training.clone().unwrap()).collect();
    let [rollbacks, lost] = [learned.iter().map(|l| l.rollbacks).sum::<u64>(), learned.iter().map(|l| l.lost_steps).sum()];
    measured!("a rate of 1: {rollbacks} rollbacks, {lost} steps lost");
    assert!(rollbacks > 0 && lost > 0 && learned.iter().all(|l| l.device_seconds.is_some()), "{learned:?}");
    for frame in &frames {
        let record = &frame.record;
        assert!(frame.film.rgba.iter().flatten().all(|value| value.is_finite()), "frame {}", record.frame);
        let diverged = record.training.as_ref().is_some_and(|learned| learned.rollbacks > 0);
        assert!(record.warnings.len() == usize::from(diverged), "{:?}", record.warnings);
        assert!(record.warnings.iter().all(|warning| warning.contains("training diverged")), "{:?}", record.warnings);
    }
    let [first, last] = [&frames[0], &frames[frames.len() - 1]].map(|frame| frame.record.surrogate_psnr.unwrap());
    assert!(small() || last > first + 5.0, "{first} dB, then {last}");
}

/// A double gyre of which about half is traced after some frames, the rest answered by a network above a coarse table.
fn answered() -> String {
    scene::scene(
        "double_gyre",
        [48, 24, 8],
        "
        domain.min = [0, 0, 0]
        domain.max = [2, 1, 0.5]
        time.tau = 5
        time.slides = 1
        time.frames_per_slide = 6
        flow.steps = 25
        surrogate.kind = \"residual\"
        surrogate.table_nodes = [17, 9, 2]
        network.levels = 6
        network.features = 2
        network.log2_table = 14
        network.width = 16
        network.batch = 4096
        training.steps_per_frame = 100
        ",
    )
}

/// A network above a table answers on the device, and the mean picture is the CPU's within its noise: seeds of the noise differ, as do the
/// networks, which are trained on other samples. A network that has learned a tenth as long shows.
#[test]
#[ignore = "needs a GPU"]
fn frames_with_a_network_are_the_cpu_s_over_many_seeds() {
    let seeds = if small() { 1 } else { 16 };
    let pictures = |device: &Device, first: u64, keys: &[&str]| -> Vec<Frame> {
        let options = RunOptions { device: device.clone(), ..RunOptions::default() };
        let keys = |seed: u64| keys.iter().map(|key| (*key).to_owned()).chain([format!("seed={seed}")]).collect::<Vec<String>>();
        (first..first + seeds).map(|seed| frames(&answered(), &keys(seed), &options).pop().unwrap()).collect()
    };
    let few: &[&str] = if small() { &["training.steps_per_frame=20", "time.frames_per_slide=3"] } else { &[] };
    let found = pictures(&device(GpuSettings::default()), 0, few);
    for frame in &found {
        let record = &frame.record;
        assert!(record.device.starts_with("cuda:0") && warnings(record).is_empty(), "{:?}", record.warnings);
        // A GPU that walks answers points ahead of their flights; one that only traces does not.
        assert!(record.speculative_traces > 0, "the device walks");
        assert!(record.traced_share > 0.05 && record.traced_share < 0.9, "traced: {}", record.traced_share);
    }
    if small() {
        println!("not held against the CPU's: one seed says nothing");
        return;
    }
    let expected = pictures(&Device::CPU, 100, &[]);
    let untaught = pictures(&Device::CPU, 200, &["render.method=\"surrogate\"", "training.steps_per_frame=10"]);
    let [(difference, pixels, larger), (seen, _, as_large)] = [&found, &untaught].map(|frames| dealt_out(frames, &expected));
    let traced = found.iter().map(|frame| frame.record.traced_share).sum::<f64>() / seeds as f64;
    measured!(
        "frames with a network, {seeds} seeds each, {:.1} % traced: squared difference of the means over its variance: {difference:.3} on average over {pixels} pixels; {larger} of {DEALS} deals are as large; with a network of a tenth of the steps alone {seen:.3}, {as_large} deals",
        100.0 * traced
    );
    assert!(pixels > 200 && larger > DEALS / 100, "{difference} over {pixels} pixels: in {larger} deals of {DEALS} as large");
    assert!(as_large < DEALS / 100, "{seen}: in {as_large} deals of {DEALS} as large, so nothing would be seen");
}

const DEALS: usize = 9999;

/// Squared difference of two mean pictures over its variance, pixels that count, and how many times it is as large when the frames are dealt
/// out at random. Where both come from one distribution, who made a frame does not matter: then the difference found is not larger than those.
/// That holds whatever the pixels have in common, as those of a frame do through its network.
fn dealt_out(found: &[Frame], expected: &[Frame]) -> (f64, usize, usize) {
    let frames: Vec<Vec<f64>> = found.iter().chain(expected).map(brightness).collect();
    let mut dealt: Vec<usize> = (0..frames.len()).collect();
    let (difference, pixels) = difference_over_noise(&frames, &dealt);
    let larger = (0..DEALS as u64).filter(|deal| {
        let random = uniform_points(*deal, dealt.len());
        (1..dealt.len()).for_each(|last| dealt.swap(last, ((random[last].0[0] * (last + 1) as f32) as usize).min(last)));
        difference_over_noise(&frames, &dealt).0 >= difference
    });
    let larger = larger.count();
    (difference, pixels, larger)
}

/// Red, green and blue together of each pixel.
fn brightness(frame: &Frame) -> Vec<f64> {
    frame.film.rgba.iter().map(|pixel| pixel[..3].iter().map(|&c| f64::from(c)).sum()).collect()
}

/// Squared difference of the mean pictures of the first and the second half of `dealt` over its variance, on average over pixels that are not
/// the same in all frames; and the number of these.
fn difference_over_noise(frames: &[Vec<f64>], dealt: &[usize]) -> (f64, usize) {
    let half = dealt.len() / 2;
    let moments = |half: &[usize], pixel: usize| {
        let count = half.len() as f64;
        let mean = half.iter().map(|&i| frames[i][pixel]).sum::<f64>() / count;
        (mean, half.iter().map(|&i| (frames[i][pixel] - mean).powi(2)).sum::<f64>() / (count - 1.0) / count)
    };
    let (mut sum, mut count) = (0.0, 0);
    for pixel in 0..frames[0].len() {
        let ((a, noise_a), (b, noise_b)) = (moments(&dealt[..half], pixel), moments(&dealt[half..], pixel));
        if noise_a + noise_b > 1e-12 {
            sum += (a - b).powi(2) / (noise_a + noise_b);
            count += 1;
        }
    }
    (sum / count as f64, count)
}

/// A cap that frames keep to and training does not, for its replay buffer, for the network itself, or for what its steps need beside both: the
/// network is trained on the CPU, which is told once, and frames stay on the device, even where a run is to end with it. The plan of the slide
/// foresees the first two; the third shows as a shortage in the first frame, which is made again.
#[test]
#[ignore = "needs a GPU"]
fn without_memory_for_training_frames_stay_on_the_device() {
    // A replay buffer of 1 GiB; and a network of 17 million parameters, of which training holds nine times as many and prediction halves.
    // And the published 16x512, whose layers' values and their gradients for 65,536 samples are 1 GiB each.
    // A rate that so many layers bear: what is told is of memory alone.
    let published = [
        "network.encoding=\"frequency\"",
        "network.hidden_layers=16",
        "network.width=512",
        "network.batch=1024",
        "network.learning_rate=1e-4",
    ];
    let cases: [(u64, &str, &[&str]); 3] = [
        (512, "surrogate and training need", &["training.replay_buffer=67108864"]),
        (192, "surrogate and training need", &["network.levels=8", "network.log2_table=21"]),
        (2048, "the layers' values", &published),
    ];
    for (mib, what, more) in cases.into_iter().take(if small() { 1 } else { 3 }) {
        let settings = GpuSettings { memory_cap: Some(mib << 20), ..GpuSettings::default() };
        let keys = ["surrogate.kind=\"network\"", "training.steps_per_frame=5"].iter().chain(more).map(ToString::to_string);
        let options = RunOptions { device: device_when_lost(settings, WhenLost::Stop), ..RunOptions::default() };
        let frames = frames(&turbulence(), &keys.collect::<Vec<_>>(), &options);
        assert_eq!(frames.len(), 3);
        for (i, Frame { record, .. }) in frames.iter().enumerate() {
            let learned = record.training.as_ref().unwrap();
            assert_eq!((learned.steps, learned.device_seconds), (5, None), "{what}, frame {i}");
            assert!(record.device.starts_with("cuda:0") && record.speculative_traces > 0, "{what}, frame {i}: the device walks");
            assert_eq!(record.warnings.len(), usize::from(i == 0), "{what}, frame {i}: {:?}", record.warnings);
        }
        let told = &frames[0].record.warnings[0];
        println!("{told}");
        assert!(told.contains("trained on the CPU") && told.contains(what) && told.contains("MiB on the device"), "{told}");
    }
}

/// A checkpoint that is written while training goes on is, byte for byte, the one that training would have waited for; its room on the device is
/// taken once; where there is none, training waits and the checkpoint says why.
#[test]
#[ignore = "needs a GPU"]
fn a_checkpoint_is_of_its_moment_though_training_went_on() {
    let gpu = opened(GpuSettings { memory_cap: Some(2 << 30), ..GpuSettings::default() });
    let source = gyre([0.0, 0.0], [2.0, 1.0]);
    let tracer = CudaTracer::new(&SnapshotStore::new(&gpu), &gpu, source, &map(10.0, 40), 0.0, Tuning::default()).unwrap();
    // 60 MB on the device, in several pieces and a rest.
    let (log2_table, batch) = if small() { (12, 1 << 10) } else { (18, 1 << 16) };
    let network = NetworkSettings { levels: Some(8), log2_table: Some(log2_table), batch: Some(batch), ..NetworkSettings::default() };
    let frequency =
        NetworkSettings { encoding: Encoding::Frequency, hidden_layers: 4, batch: Some(batch / 4), ..NetworkSettings::default() };
    let buffer = ReplayBuffer::holding(&traced(tracer.host(), uniform_points(1, 20_000), false));
    let (rounds, steps) = if small() { (1, 10) } else { (3, 1000) };
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str| folder.path().join(name);
    let bytes = |name: &str| std::fs::read(file(name)).unwrap();
    for (kind, network) in [(Kind::Network, &network), (Kind::Residual, &network), (Kind::Network, &frequency)] {
        let built = || resident(&gpu, kind, [257, 129, 2], network, &tracer);
        let mut surrogate = built();
        surrogate.learn(&buffer, f64::INFINITY, steps / 5).unwrap();
        let before = gpu.memory().0;
        let mut room = None;
        for round in 0..rounds {
            surrogate.save(&file("waited for")).unwrap();
            let state = surrogate.checkpoint_async().unwrap().unwrap();
            assert_eq!(state.wait_reason(), None);
            assert!(surrogate.checkpoint_async().unwrap().is_none(), "one at a time");
            std::thread::scope(|scope| {
                let learning = scope.spawn(|| surrogate.learn(&buffer, f64::INFINITY, steps).unwrap());
                state.write(&file("behind")).unwrap();
                assert_eq!(learning.join().unwrap().steps, steps);
            });
            assert!(bytes("behind") == bytes("waited for"), "{kind:?}, round {round}");
            surrogate.save(&file("later")).unwrap();
            assert!(bytes("later") != bytes("behind"), "training went on");
            let taken = gpu.memory().0 - before;
            assert_eq!(*room.get_or_insert(taken), taken, "taken once");
        }
        println!("{kind:?}: {} bytes of room, {} bytes a file", room.unwrap(), bytes("behind").len());
        drop(surrogate);
        // What others have leaves no room.
        let mut surrogate = built();
        surrogate.learn(&buffer, f64::INFINITY, steps / 50 + 1).unwrap();
        let others = gpu.alloc::<u8>("what others have", (gpu.memory_left() - (1 << 16)) as usize).unwrap();
        surrogate.save(&file("waited for")).unwrap();
        let state = surrogate.checkpoint_async().unwrap().unwrap();
        assert!(state.wait_reason().is_some_and(|why| why.contains("left")), "{:?}", state.wait_reason());
        state.write(&file("behind")).unwrap();
        assert!(bytes("behind") == bytes("waited for"));
        drop(others);
        assert_eq!(surrogate.checkpoint_async().unwrap().unwrap().wait_reason(), None, "there is room again");
    }
}

/// A network that is trusted nowhere is traced brick by brick, so that the picture is the same on either.
#[test]
#[ignore = "needs a GPU"]
fn bricks_of_a_network_that_is_not_trusted_are_traced() {
    let text = scene::scene(
        "turbulence",
        [160, 80, 1],
        "
        source.nodes = [48, 24, 24]
        time.tau = 5
        time.slides = 1
        time.frames_per_slide = 2
        flow.steps = 20
        transfer.low = 0.05
        transfer.high = 0.3
        surrogate.kind = \"network\"
        network.levels = 4
        network.log2_table = 12
        network.width = 16
        training.steps_per_frame = 1
        trust.tolerance = 1e-6
        render.method = \"marched\"
        ",
    );
    let [found, expected] =
        [device(GpuSettings::default()), Device::CPU].map(|device| frames(&text, &[], &RunOptions { device, ..RunOptions::default() }));
    for (frame, other) in found.iter().zip(&expected) {
        let traced = [&frame.record, &other.record].map(|record| record.preparation_traces);
        let psnr = compare_films(&frame.film, &other.film, frame.tone_map).unwrap().psnr.unwrap_or(f64::INFINITY);
        measured!("a network that is not trusted, frame {}: {traced:?} nodes and probes traced, {psnr:.1} dB", frame.record.frame);
        assert!(psnr > 50.0, "{psnr} dB");
    }
    // Every node, and what opens the gate.
    let first = [&found[0].record, &expected[0].record].map(|record| record.preparation_traces);
    assert!(first[0] == first[1] && first[0] >= 80_000, "{first:?}");
}

/// Offline training takes the sizes that a run takes where the scene leaves them open, and says so in the same words.
#[test]
#[ignore = "needs a GPU"]
fn offline_training_is_fitted_to_the_window_as_a_run_is() {
    let keys = "
        source.nodes = [96, 12, 12]
        source.snapshots = 6
        time.tau = 4
        time.slides = 1
        flow.steps = 8
        surrogate.kind = \"network\"
        network.width = 16
        training.steps_per_frame = 1
    ";
    let text = scene::scene("turbulence", [16, 8, 2], keys);
    let device = device(GpuSettings::default());
    let of_network = |decisions: Vec<Decision>| -> Vec<Decision> {
        decisions.into_iter().filter(|decision| decision.setting.starts_with("network.")).collect()
    };
    let options = RunOptions { device: device.clone(), ..RunOptions::default() };
    let expected = of_network(scene::run_frames(scene::setup(&text, &[]), &options, |_| ()).decisions);
    let wanted = TrainOptions { epochs: 1, labels: 1 << 12, validation: 1 << 10, pictures: Vec::new() };
    let settings = scene::parse(&text, &[]).unwrap().settings();
    let report = train(&settings, &wanted, &device, 0, &mut |_, _| (), &AtomicBool::new(false)).unwrap();
    assert_eq!(expected.len(), 5, "{expected:?}");
    let (mut found, mut expected) = (of_network(report.decisions), expected);
    let [batch, of_run] = [&mut found, &mut expected].map(|decisions| {
        let place = decisions.iter().position(|decision| decision.setting == "network.batch").unwrap();
        decisions.remove(place).chosen
    });
    assert_eq!([batch, of_run], ["64", "262144"], "64 steps an epoch of 4096 labels");
    assert_eq!(found, expected);
    let report = train(&settings, &wanted, &Device::CPU, 0, &mut |_, _| (), &AtomicBool::new(false)).unwrap();
    assert!(report.decisions.is_empty(), "{:?}", report.decisions);
}
