//! Surrogates through their trait: learning, divergence, bad samples, checkpoints, slides of the window.

#![allow(clippy::unwrap_used)]

mod network_support;

use network_support::{DoubleGyre, rms, traced, uniform_points};
use ridgewatch::field::UnitPoint;
use ridgewatch::flow::Tracer;
use ridgewatch::surrogate::network::{Encoding, Input, Loss, NetworkSettings, Target};
use ridgewatch::surrogate::{CheckpointError, HostSurrogate, Kind, Predict, ReplayBuffer, Samples, SurrogateSettings, Trace, build};

fn small() -> NetworkSettings {
    NetworkSettings { levels: Some(6), log2_table: Some(12), width: 32, batch: Some(2048), ..NetworkSettings::default() }
}

fn surrogate(kind: Kind, network: &NetworkSettings, tracer: &dyn Trace) -> HostSurrogate {
    let settings = SurrogateSettings { kind, table_nodes: Some([33, 17, 1]), ..SurrogateSettings::default() };
    build(&settings, network, tracer.flow().domain(), 5, tracer).unwrap()
}

fn psnr(surrogate: &HostSurrogate, samples: &Samples) -> f64 {
    let peak = samples.log_stretch.iter().copied().fold(f32::MIN, f32::max);
    20.0 * (f64::from(peak) / rms(surrogate, samples)).log10()
}

/// Every kind of network learns the double gyre. The error of a constant is 1 deviation; 300 small steps reach a fraction of it.
#[test]
fn every_variant_learns() {
    let tracer = DoubleGyre::new(0.0, 10.0, 40);
    let samples = traced(&tracer, uniform_points(1, 20_000), true);
    let held_out = traced(&tracer, uniform_points(2, 2_000), false);
    let mean = held_out.log_stretch.iter().sum::<f32>() / held_out.len() as f32;
    let deviation = (held_out.log_stretch.iter().map(|s| f64::from(s - mean).powi(2)).sum::<f64>() / held_out.len() as f64).sqrt();
    let frequency = NetworkSettings { encoding: Encoding::Frequency, octaves: 5, hidden_layers: 3, ..small() };
    for (name, network, share) in [
        ("mean square", small(), 0.4),
        ("published loss", NetworkSettings { loss: Loss::Published, ..small() }, 0.6),
        ("frequency", frequency, 0.8),
    ] {
        let mut surrogate = surrogate(Kind::Network, &network, &tracer);
        let learned = surrogate.learn(&ReplayBuffer::holding(&samples), f64::INFINITY, 300).unwrap();
        assert_eq!((learned.steps, learned.rollbacks, learned.dropped), (300, 0, 0), "{name}");
        assert_eq!(learned.samples, 300 * 2048);
        let error = rms(&surrogate, &held_out) / deviation;
        assert!(error < share, "{name}: {error} of the deviation");
    }
}

/// The FTLE comes from derivatives of the network, which are less accurate than its values, but must improve too.
#[test]
fn the_flow_map_learns_arrivals_and_jacobians() {
    let tracer = DoubleGyre::new(0.0, 10.0, 40);
    let samples = traced(&tracer, uniform_points(1, 20_000), true);
    let held_out = traced(&tracer, uniform_points(2, 2_000), false);
    let identity = held_out.log_stretch.iter().map(|s| f64::from(*s).powi(2)).sum::<f64>().sqrt() / (held_out.len() as f64).sqrt();
    for jacobian_weight in [0.0, 0.1] {
        let network = NetworkSettings { target: Target::FlowMap, jacobian_weight, ..small() };
        let mut surrogate = surrogate(Kind::Network, &network, &tracer);
        let first = surrogate.learn(&ReplayBuffer::holding(&samples), f64::INFINITY, 20).unwrap().loss.unwrap();
        let last =
            (0..14).map(|_| surrogate.learn(&ReplayBuffer::holding(&samples), f64::INFINITY, 20).unwrap().loss.unwrap()).last().unwrap();
        assert!(last < 0.5 * first, "weight {jacobian_weight}: loss {first}, then {last}");
        // A network that has learned nothing maps every point nearly onto itself: hardly any stretch. Derivatives lag behind values, so in
        // 300 steps only a third of the way is asked for.
        let error = rms(&surrogate, &held_out);
        assert!(error < 0.7 * identity, "weight {jacobian_weight}: {error} of {identity}");
    }
    // Samples without the labels of the target are dropped.
    let network = NetworkSettings { target: Target::FlowMap, ..small() };
    assert_eq!(
        surrogate(Kind::Network, &network, &tracer).learn(&ReplayBuffer::holding(&held_out), f64::INFINITY, 20).unwrap().dropped,
        2_000
    );
}

#[test]
fn a_residual_starts_as_its_table_and_improves_on_it() {
    let tracer = DoubleGyre::new(0.0, 10.0, 40);
    let held_out = traced(&tracer, uniform_points(2, 4_000), false);
    let table = surrogate(Kind::Table, &small(), &tracer);
    let mut residual = surrogate(Kind::Residual, &small(), &tracer);
    let (mut a, mut b) = (vec![0.0; held_out.len()], vec![0.0; held_out.len()]);
    table.predict(&held_out.points, &mut a).unwrap();
    residual.predict(&held_out.points, &mut b).unwrap();
    assert_eq!(a, b);
    let before = psnr(&residual, &held_out);
    residual.learn(&ReplayBuffer::holding(&traced(&tracer, uniform_points(1, 40_000), false)), f64::INFINITY, 400).unwrap();
    let after = psnr(&residual, &held_out);
    assert!(after > before + 2.0, "{before} dB, then {after} dB");
    // At another start time, the table is traced anew, and the next samples reset a residual that no longer fits.
    let later = DoubleGyre::new(5.0, 10.0, 40);
    let held_out = traced(&later, uniform_points(3, 4_000), false);
    residual.window_slid(&later).unwrap();
    residual.learn(&ReplayBuffer::holding(&traced(&later, uniform_points(4, 40_000), false)), f64::INFINITY, 1).unwrap();
    let (slid, table) = (psnr(&residual, &held_out), psnr(&surrogate(Kind::Table, &small(), &later), &held_out));
    // One step at the full rate may cost a little.
    assert!(slid > table - 1.0, "residual {slid} dB on a table of {table} dB");
}

#[test]
fn a_network_does_not_lose_to_the_constant_after_a_slide() {
    let (early, late) = (DoubleGyre::new(0.0, 10.0, 40), DoubleGyre::new(0.5, 10.0, 40));
    let mut network = surrogate(Kind::Network, &small(), &early);
    network.learn(&ReplayBuffer::holding(&traced(&early, uniform_points(1, 20_000), false)), f64::INFINITY, 300).unwrap();
    network.window_slid(&late).unwrap();
    let held_out = traced(&late, uniform_points(2, 4_000), false);
    let carried = rms(&network, &held_out);
    network.learn(&ReplayBuffer::holding(&traced(&late, uniform_points(3, 20_000), false)), f64::INFINITY, 300).unwrap();
    assert!(rms(&network, &held_out) < carried);
}

#[test]
fn samples_without_a_value_are_dropped_and_counted() {
    let tracer = DoubleGyre::new(0.0, 10.0, 20);
    let mut samples = traced(&tracer, uniform_points(1, 5_000), false);
    samples.log_stretch[3] = f32::NAN;
    samples.log_stretch[77] = f32::INFINITY;
    samples.points[100].0[1] = f32::NAN;
    let mut network = surrogate(Kind::Network, &small(), &tracer);
    let learned = network.learn(&ReplayBuffer::holding(&samples), f64::INFINITY, 50).unwrap();
    assert_eq!((learned.dropped, learned.rollbacks, learned.steps), (3, 0, 50));
    assert!(learned.loss.unwrap().is_finite());
    assert!(rms(&network, &traced(&tracer, uniform_points(2, 500), false)).is_finite());
    let nothing = Samples { points: vec![UnitPoint([0.5; 3])], log_stretch: vec![f32::NAN], ..Samples::default() };
    let learned = network.learn(&ReplayBuffer::holding(&nothing), f64::INFINITY, 50).unwrap();
    assert_eq!((learned.dropped, learned.steps, learned.loss), (1, 0, None));
}

#[test]
fn a_diverging_loss_is_rolled_back_and_counted() {
    let tracer = DoubleGyre::new(0.0, 10.0, 20);
    let samples = traced(&tracer, uniform_points(1, 5_000), false);
    // At this rate Adam diverges.
    let network = NetworkSettings { learning_rate: Some(1.0), ..small() };
    let mut wild = surrogate(Kind::Network, &network, &tracer);
    let learned = wild.learn(&ReplayBuffer::holding(&samples), f64::INFINITY, 300).unwrap();
    assert!(learned.rollbacks > 0, "{learned:?}");
    let held_out = traced(&tracer, uniform_points(2, 2_000), false);
    let error = rms(&wild, &held_out);
    let scale = held_out.log_stretch.iter().map(|s| f64::from(*s).powi(2)).sum::<f64>().sqrt() / (held_out.len() as f64).sqrt();
    assert!(error.is_finite() && error < 4.0 * scale, "{error} beside labels of {scale}");
    // Finite labels whose squares overflow.
    let mut calm = surrogate(Kind::Network, &small(), &tracer);
    calm.learn(&ReplayBuffer::holding(&samples), f64::INFINITY, 100).unwrap();
    let before = rms(&calm, &held_out);
    let poison = Samples { log_stretch: vec![1e30; samples.len()], ..samples.clone() };
    let learned = calm.learn(&ReplayBuffer::holding(&poison), f64::INFINITY, 20).unwrap();
    assert!(learned.rollbacks > 0 && learned.steps == 0, "{learned:?}");
    assert_eq!(learned.loss, None, "all of its steps diverged");
    assert_eq!(rms(&calm, &held_out), before);
}

/// A flow that stretches three times as much from window to window: losses grow by 9 without divergence.
#[test]
fn a_flow_that_grows_is_not_taken_for_a_divergence() {
    let tracer = DoubleGyre::new(0.0, 10.0, 20);
    let calm = traced(&tracer, uniform_points(1, 5_000), false);
    for kind in [Kind::Network, Kind::Residual] {
        let mut surrogate = surrogate(kind, &small(), &tracer);
        let mut growth = 0.01;
        for window in 0..8 {
            let log_stretch = calm.log_stretch.iter().map(|s| growth * s).collect();
            let learned = surrogate.learn(&ReplayBuffer::holding(&Samples { log_stretch, ..calm.clone() }), f64::INFINITY, 40).unwrap();
            assert_eq!((learned.rollbacks, learned.steps), (0, 40), "{kind:?}, window {window}: {learned:?}");
            surrogate.window_slid(&tracer).unwrap();
            growth *= 3.0;
        }
    }
}

#[test]
fn a_resumed_run_goes_on_bit_for_bit() {
    let tracer = DoubleGyre::new(0.0, 10.0, 20);
    let samples = traced(&tracer, uniform_points(1, 5_000), true);
    let folder = tempfile::tempdir().unwrap();
    let flow_map = NetworkSettings { target: Target::FlowMap, ..small() };
    let frequency = NetworkSettings { encoding: Encoding::Frequency, octaves: 4, ..small() };
    let of_start = NetworkSettings { inputs: vec![Input::Start], start_range: Some([0.0, 3.0]), ..small() };
    for (number, (kind, network)) in [
        (Kind::Network, small()),
        (Kind::Residual, small()),
        (Kind::Network, flow_map),
        (Kind::Network, frequency),
        (Kind::Network, of_start.clone()),
        (Kind::Table, small()),
    ]
    .into_iter()
    .enumerate()
    {
        let path = folder.path().join(number.to_string());
        let mut first = surrogate(kind, &network, &tracer);
        first.learn(&ReplayBuffer::holding(&samples), f64::INFINITY, 37).unwrap();
        first.save(&path).unwrap();
        first.learn(&ReplayBuffer::holding(&samples), f64::INFINITY, 23).unwrap();
        let mut second = surrogate(kind, &network, &tracer);
        second.load(&path).unwrap();
        second.learn(&ReplayBuffer::holding(&samples), f64::INFINITY, 23).unwrap();
        let (mut a, mut b) = (vec![0.0; 5_000], vec![0.0; 5_000]);
        first.predict(&samples.points, &mut a).unwrap();
        second.predict(&samples.points, &mut b).unwrap();
        assert!(a.iter().zip(&b).all(|(a, b)| a.to_bits() == b.to_bits()), "{kind:?}");
        // Saving again gives the same file: weights, both moments, averages and notes.
        let again = [folder.path().join("a"), folder.path().join("b")];
        first.save(&again[0]).unwrap();
        second.save(&again[1]).unwrap();
        assert_eq!(std::fs::read(&again[0]).unwrap(), std::fs::read(&again[1]).unwrap(), "{kind:?}");
    }
    // The folder holds only the checkpoints.
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 8);
    // The range of an input must match.
    let other = NetworkSettings { start_range: Some([0.0, 4.0]), ..of_start };
    let fault = surrogate(Kind::Network, &other, &tracer).load(&folder.path().join("4")).unwrap_err().to_string();
    assert!(fault.contains("start_range 0 3") && fault.contains("start_range 0 4"), "{fault}");
}

#[test]
fn a_bad_checkpoint_is_an_error_and_changes_nothing() {
    let tracer = DoubleGyre::new(0.0, 10.0, 20);
    let samples = traced(&tracer, uniform_points(1, 3_000), false);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("checkpoint");
    let mut network = surrogate(Kind::Network, &small(), &tracer);
    network.learn(&ReplayBuffer::holding(&samples), f64::INFINITY, 20).unwrap();
    network.save(&path).unwrap();
    let good = std::fs::read(&path).unwrap();
    let reference = rms(&network, &samples);

    let mut damaged: Vec<(String, Vec<u8>)> = vec![
        ("empty".into(), Vec::new()),
        ("foreign".into(), b"not a checkpoint at all, but a few words of text".to_vec()),
        ("longer".into(), [&good[..], &[0; 16]].concat()),
    ];
    for keep in [4, 9, 200, good.len() / 2, good.len() - 1] {
        damaged.push((format!("cut at {keep}"), good[..keep].to_vec()));
    }
    let mut flipped = good.clone();
    let last = flipped.len() - 3;
    flipped[last] ^= 0x40;
    damaged.push(("one bit flipped".into(), flipped));
    for (name, bytes) in damaged {
        std::fs::write(&path, bytes).unwrap();
        assert!(matches!(network.load(&path), Err(CheckpointError::Mismatch { .. })), "{name}");
        assert_eq!(rms(&network, &samples), reference, "{name}");
    }
    assert!(matches!(network.load(&folder.path().join("missing")), Err(CheckpointError::Io { .. })));

    // 64 GB without content are not read: this machine has no such memory.
    std::fs::write(&path, &good).unwrap();
    std::fs::OpenOptions::new().write(true).open(&path).unwrap().set_len(64 << 30).unwrap();
    assert!(matches!(network.load(&path), Err(CheckpointError::Mismatch { .. })));
    // Nor are those that the header names.
    let header = br#"{"__metadata__":{"format":"ridgewatch-surrogate-1","kind":"network"},"a":{"dtype":"F32","shape":[17179869184],"data_offsets":[0,68719476736]}}"#;
    std::fs::write(&path, [&(header.len() as u64).to_le_bytes()[..], header].concat()).unwrap();
    std::fs::OpenOptions::new().write(true).open(&path).unwrap().set_len((64 << 30) + 8 + header.len() as u64).unwrap();
    assert!(matches!(network.load(&path), Err(CheckpointError::Mismatch { .. })));

    // A valid checkpoint of another shape, kind or scene.
    std::fs::write(&path, &good).unwrap();
    let wider = NetworkSettings { width: 48, ..small() };
    assert!(matches!(surrogate(Kind::Network, &wider, &tracer).load(&path), Err(CheckpointError::Mismatch { .. })));
    assert!(matches!(surrogate(Kind::Residual, &small(), &tracer).load(&path), Err(CheckpointError::Mismatch { .. })));
    assert!(matches!(surrogate(Kind::Table, &small(), &tracer).load(&path), Err(CheckpointError::Mismatch { .. })));
    network.load(&path).unwrap();
    assert_eq!(rms(&network, &samples), reference);
    // A folder that is not there: an error, and nothing written.
    assert!(matches!(network.save(&folder.path().join("no/such/checkpoint")), Err(CheckpointError::Io { .. })));
}

/// FNV-1a over the values' words, as a checkpoint has it.
fn checksum(values: &[u8]) -> String {
    let words = values.chunks_exact(4).map(|b| u64::from(u32::from_le_bytes(b.try_into().unwrap())));
    format!("{:016x}", words.fold(0xcbf2_9ce4_8422_2325_u64, |sum, word| (sum ^ word).wrapping_mul(0x0000_0100_0000_01b3)))
}

/// A checkpoint with other notes and values, and a checksum that fits.
fn altered(good: &[u8], notes: &[(&str, &str)], change: impl FnOnce(&mut [u8])) -> Vec<u8> {
    let begin = 8 + u64::from_le_bytes(good[..8].try_into().unwrap()) as usize;
    let mut header: serde_json::Value = serde_json::from_slice(&good[8..begin]).unwrap();
    let mut values = good[begin..].to_vec();
    change(&mut values);
    for (key, text) in notes.iter().copied().chain([("checksum", checksum(&values).as_str())]) {
        let note = header["__metadata__"].get_mut(key).unwrap_or_else(|| panic!("no note {key}"));
        *note = text.into();
    }
    let mut header = serde_json::to_vec(&header).unwrap();
    header.resize(header.len().next_multiple_of(8), b' ');
    [&(header.len() as u64).to_le_bytes()[..], &header, &values].concat()
}

#[test]
fn numbers_that_are_not_finite_are_refused_in_every_checkpoint() {
    let tracer = DoubleGyre::new(0.0, 10.0, 20);
    let samples = traced(&tracer, uniform_points(1, 3_000), false);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("checkpoint");
    let not_a_number = f32::NAN.to_le_bytes();
    for kind in [Kind::Table, Kind::Network, Kind::Residual] {
        let mut taught = surrogate(kind, &small(), &tracer);
        taught.learn(&ReplayBuffer::holding(&samples), f64::INFINITY, 20).unwrap();
        taught.save(&path).unwrap();
        let (good, reference) = (std::fs::read(&path).unwrap(), rms(&taught, &samples));
        let mut load = |bytes: Vec<u8>| {
            std::fs::write(&path, bytes).unwrap();
            let loaded = taught.load(&path);
            assert_eq!(rms(&taught, &samples), reference, "{kind:?}");
            loaded.err().map(|error| error.to_string())
        };
        assert_eq!(load(altered(&good, &[], |_| {})), None, "{kind:?}: what is altered by nothing is taken");
        for stride in [4, good.len() / 40 * 4] {
            let odd = altered(&good, &[], |values| values.chunks_mut(stride).for_each(|part| part[..4].copy_from_slice(&not_a_number)));
            let fault = load(odd).unwrap_or_else(|| panic!("{kind:?}: taken with a NaN every {stride} bytes"));
            assert!(fault.contains("that are not finite; expected finite values"), "{kind:?}: {fault}");
        }
        let of_network =
            ["stall", "caution", "first_loss", "smooth", "looked", "mean.0", "deviation.0"].map(|key| format!("network.{key}"));
        let keys = of_network.iter().map(String::as_str).filter(|_| kind != Kind::Table);
        for key in keys.chain((kind == Kind::Residual).then_some("shrinkage")) {
            for number in ["NaN", "inf", "-1e999"] {
                let fault = load(altered(&good, &[(key, number)], |_| {})).unwrap_or_else(|| panic!("{kind:?}: taken with {key} {number}"));
                assert!(fault.contains(key) && fault.contains(" from "), "{fault}");
            }
        }
    }
}

#[test]
fn wrong_settings_are_refused_by_name() {
    let tracer = DoubleGyre::new(0.0, 10.0, 20);
    let fault = |kind, network: NetworkSettings, nodes| {
        let settings = SurrogateSettings { kind, table_nodes: nodes, ..SurrogateSettings::default() };
        build(&settings, &network, tracer.domain(), 0, &tracer).err().unwrap().to_string()
    };
    assert!(fault(Kind::Network, NetworkSettings { width: 0, ..small() }, None).contains("network.width = 0"));
    assert!(fault(Kind::Residual, NetworkSettings { target: Target::FlowMap, ..small() }, None).contains("network.target = flow_map"));
    assert!(fault(Kind::Table, small(), Some([1, 5, 5])).contains("surrogate.table_nodes = [1, 5, 5]"));
    assert!(fault(Kind::Table, small(), Some([1 << 20, 1 << 20, 1])).contains("at most 2^30"));
}

#[test]
fn time_and_steps_bound_learning() {
    let tracer = DoubleGyre::new(0.0, 10.0, 20);
    let samples = traced(&tracer, uniform_points(1, 5_000), false);
    let mut network = surrogate(Kind::Network, &small(), &tracer);
    assert_eq!(network.learn(&ReplayBuffer::holding(&samples), 0.0, 100).unwrap().steps, 0);
    assert_eq!(network.learn(&ReplayBuffer::holding(&samples), f64::INFINITY, 0).unwrap().steps, 0);
    let learned = network.learn(&ReplayBuffer::holding(&samples), 0.3, u64::MAX).unwrap();
    // One step of 2048 samples takes milliseconds; the rest is for a machine that stands still for a while.
    assert!(learned.steps > 0 && (0.3..30.0).contains(&learned.seconds), "{learned:?}");
}
