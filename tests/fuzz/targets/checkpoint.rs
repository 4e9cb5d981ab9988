//! A checkpoint of any bytes is loaded or refused: no panic, and a refused one changes nothing.
#![no_main]

mod support;

use libfuzzer_sys::fuzz_target;
use ridgewatch::field::{Domain, DomainPoint, UnitPoint};
use ridgewatch::flow::{Extras, Traced, Tracer};
use ridgewatch::surrogate::network::NetworkSettings;
use ridgewatch::surrogate::{HostSurrogate, Kind, Predict, SurrogateSettings, build};
use std::path::PathBuf;
use std::sync::{Mutex, OnceLock};

/// A flow that stretches nothing.
struct Still(Domain);

impl Tracer for Still {
    fn domain(&self) -> &Domain {
        &self.0
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
        out.log_stretch = vec![0.0; seeds.len()];
        out.lifetime_share = vec![1.0; seeds.len()];
        out.arrival = if extras.arrival { seeds.to_vec() } else { Vec::new() };
        out.jacobian = if extras.jacobian { vec![[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]; seeds.len()] } else { Vec::new() };
    }
}

struct Target {
    surrogate: HostSurrogate,
    good: Vec<u8>,
    /// Place of the tensors, and of the checksum's text in the header.
    tensors: usize,
    sum: usize,
    path: PathBuf,
}

/// FNV-1a over the tensors' words, as text.
fn checksum(tensors: &[u8]) -> String {
    let mix = |sum: u64, word: &[u8; 4]| (sum ^ u64::from(u32::from_le_bytes(*word))).wrapping_mul(0x0000_0100_0000_01b3);
    format!("{:016x}", tensors.as_chunks::<4>().0.iter().fold(0xcbf2_9ce4_8422_2325, mix))
}

impl Target {
    fn new() -> Self {
        let tracer = Still(Domain::slab([0.0, 0.0], [2.0, 1.0], (0.0, 1.0)));
        let network = NetworkSettings { levels: Some(2), log2_table: Some(6), width: 16, batch: Some(256), ..NetworkSettings::default() };
        let settings = SurrogateSettings { kind: Kind::Residual, table_nodes: Some([5, 3, 1]), ..SurrogateSettings::default() };
        let surrogate = build(&settings, &network, &tracer.0, 5, &tracer).expect("a small surrogate");
        let path = std::env::temp_dir().join(format!("rw-fuzz-{}.safetensors", std::process::id()));
        surrogate.save(&path).expect("a temporary file");
        let good = std::fs::read(&path).expect("what was saved");
        let tensors = 8 + u64::from_le_bytes(*good.first_chunk().expect("a length")) as usize;
        let sum = checksum(&good[tensors..]);
        let sum = good.windows(sum.len()).position(|text| text == sum.as_bytes()).expect("the checksum");
        Self { surrogate, good, tensors, sum, path }
    }

    fn predictions(&self) -> Vec<u32> {
        let points: Vec<UnitPoint> = (0..16).map(|i| UnitPoint([i as f32 / 16.0, 0.3, 0.5])).collect();
        let mut out = vec![0.0; points.len()];
        self.surrogate.predict(&points, &mut out).expect("the CPU");
        out.iter().map(|value| value.to_bits()).collect()
    }
}

fuzz_target!(|input: &[u8]| {
    static TARGET: OnceLock<Mutex<Target>> = OnceLock::new();
    let mut target = TARGET.get_or_init(|| Mutex::new(Target::new())).lock().expect("no panic before");
    let mut bytes = support::file(&target.good, input);
    // Corrects the checksum, so that changes reach the checks behind it.
    if input.first().is_some_and(|kind| kind & 3 == 1) {
        let sum = checksum(&bytes[target.tensors..]);
        let place = target.sum;
        bytes[place..place + sum.len()].copy_from_slice(sum.as_bytes());
    }
    std::fs::write(&target.path, &bytes).expect("a temporary file");
    let (before, path) = (target.predictions(), target.path.clone());
    if target.surrogate.load(&path).is_err() {
        assert!(target.predictions() == before, "a refused checkpoint changes nothing");
    } else {
        // The next input begins where this one did.
        let good = target.good.clone();
        std::fs::write(&path, good).expect("a temporary file");
        target.surrogate.load(&path).expect("the good checkpoint");
    }
});
