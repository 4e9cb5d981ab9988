//! Compiles every kernel for two architectures, in representative variants. Needs NVRTC but no GPU: `make test` fetches NVRTC and runs these
//! tests; a plain `cargo test` reports them as ignored.

#![cfg(feature = "cuda")]
#![allow(clippy::unwrap_used)]

use rayon::prelude::*;
use ridgewatch::backend::cuda::compile::{Request, SOURCES};
use ridgewatch::backend::cuda::{LossTerms, Tiling, is_fused, network_defines};
use ridgewatch::surrogate::network::{Architecture, Encoding, Input, NetworkSettings, Target};

/// Macros of the gridded kernel: the usual ones with changes.
fn grid(changes: &[(&str, &str)]) -> Vec<String> {
    let usual = [
        ("REAL", "float"),
        ("AXES", "3"),
        ("SPHERE", "0"),
        ("STORAGE", "0"),
        ("CUBIC", "0"),
        ("MISSING", "0"),
        ("KEEP", "1"),
        ("SCALED", "0"),
        ("EVEN", "7"),
        ("WRAP", "0"),
        ("SEAM", "0"),
        ("DIFFERENCES", "0"),
    ];
    let value = |name: &str, usual: &str| changes.iter().find(|(n, _)| *n == name).map_or(usual.to_owned(), |(_, v)| (*v).to_owned());
    usual.iter().map(|(name, usual)| format!("RW_{name}={}", value(name, usual))).collect()
}

/// Networks of different encodings, widths and depths: some fill the registers, some have a single feature or no tables.
fn networks() -> Vec<Network> {
    let usual = NetworkSettings { levels: Some(8), features: 2, ..NetworkSettings::default() };
    let both = vec![Input::Start, Input::Duration];
    let settings = [
        (usual.clone(), &[0, 1, 2][..]),
        (NetworkSettings { width: 128, features: 4, ..usual.clone() }, &[0, 1, 2]),
        (NetworkSettings { levels: Some(5), features: 1, width: 21, hidden_layers: 1, ..usual.clone() }, &[1]),
        (NetworkSettings { levels: Some(16), features: 8, hidden_layers: 4, ..usual.clone() }, &[0, 2]),
        (NetworkSettings { encoding: Encoding::Frequency, ..usual.clone() }, &[0, 1, 2]),
        (NetworkSettings { encoding: Encoding::Frequency, width: 512, hidden_layers: 16, ..usual.clone() }, &[0, 1, 2]),
        (NetworkSettings { encoding: Encoding::Frequency, width: 256, hidden_layers: 8, ..usual.clone() }, &[0, 1, 2]),
        (NetworkSettings { width: 200, hidden_layers: 5, ..usual.clone() }, &[0, 1]),
        (NetworkSettings { inputs: vec![Input::Start], ..usual.clone() }, &[0, 1]),
        (NetworkSettings { inputs: vec![Input::Start], ..usual.clone() }, &[0, 1, 2]),
        (NetworkSettings { encoding: Encoding::Frequency, inputs: both.clone(), octaves: 4, ..usual.clone() }, &[0, 1, 2]),
        (NetworkSettings { target: Target::FlowMap, inputs: both, ..usual.clone() }, &[0, 1]),
        (NetworkSettings { target: Target::FlowMap, features: 4, ..usual.clone() }, &[0, 1, 2]),
        (NetworkSettings { target: Target::FlowMap, features: 1, width: 21, ..usual.clone() }, &[0, 2]),
        (NetworkSettings { target: Target::FlowMap, encoding: Encoding::Frequency, width: 256, hidden_layers: 8, ..usual }, &[0, 1, 2]),
    ];
    let shape = |(settings, axes): &(NetworkSettings, &[usize])| Architecture::new(settings, axes, [1.0; 3]).unwrap();
    let with = |number: usize, terms: LossTerms| Network { shape: shape(&settings[number]), terms };
    let all = (0..settings.len()).map(|number| with(number, LossTerms::default()));
    // Fused and batched networks.
    let penalty = [0, 6].map(|number| with(number, LossTerms { mean_penalty: true, derivatives: false }));
    let derivatives = [11, 12, 13, 14].map(|number| with(number, LossTerms { mean_penalty: false, derivatives: true }));
    all.chain(penalty).chain(derivatives).collect()
}

/// An architecture, and what its loss has.
struct Network {
    shape: Architecture,
    terms: LossTerms,
}

impl Network {
    fn defines(&self) -> Vec<String> {
        network_defines(&self.shape, self.terms).unwrap()
    }
}

fn variants(source: &str) -> Vec<Vec<String>> {
    match source {
        "trace_closed.cu" => [("0", "float", "0"), ("1", "double", "0"), ("2", "float", "0"), ("0", "float", "1"), ("0", "double", "1")]
            .map(|(form, real, starts)| [("REAL", real), ("FORM", form), ("BOUNDARY", "1"), ("DIFFERENCES", "0"), ("STARTS", starts)])
            .into_iter()
            .map(|defines| defines.map(|(name, value)| format!("RW_{name}={value}")).to_vec())
            .collect(),
        "trace_grid.cu" => vec![
            grid(&[]),
            grid(&[("STORAGE", "1"), ("MISSING", "1"), ("SCALED", "1"), ("EVEN", "5"), ("WRAP", "2"), ("SEAM", "2")]),
            grid(&[("STORAGE", "2"), ("MISSING", "1")]),
            grid(&[("STORAGE", "2"), ("REAL", "double"), ("KEEP", "0"), ("DIFFERENCES", "1")]),
            grid(&[("REAL", "double"), ("KEEP", "0")]),
            grid(&[("REAL", "double"), ("DIFFERENCES", "1")]),
            grid(&[("AXES", "2"), ("MISSING", "1"), ("DIFFERENCES", "1")]),
            grid(&[("AXES", "2"), ("CUBIC", "1"), ("EVEN", "3")]),
            grid(&[("CUBIC", "1")]),
            grid(&[("AXES", "2"), ("SPHERE", "1"), ("SCALED", "1"), ("WRAP", "1"), ("SEAM", "1")]),
            grid(&[("SPHERE", "1"), ("SCALED", "1"), ("WRAP", "1"), ("SEAM", "1"), ("MISSING", "1"), ("EVEN", "3")]),
        ],
        "march.cu" | "mend.cu" => [(0, 0), (1, 0), (0, 1), (1, 1)]
            .map(|(holes, point_light)| vec![format!("RW_HOLES={holes}"), format!("RW_POINT_LIGHT={point_light}")])
            .into(),
        "window.cu" => (1..3).map(|storage| vec![format!("RW_STORAGE={storage}")]).collect(),
        "network.cu" => networks().iter().map(Network::defines).collect(),
        "network_fused.cu" => networks().iter().filter(|network| is_fused(&network.shape, usize::MAX)).map(Network::defines).collect(),
        // All tilings, for the shared memory of H200, A100 and the RTX cards since Ampere.
        "network_batched.cu" => networks()
            .iter()
            .flat_map(|network| {
                let mut tilings: Vec<Tiling> = [227, 163, 99].map(|kibibytes| Tiling::of(&network.shape, kibibytes << 10).unwrap()).into();
                tilings.dedup();
                tilings.into_iter().map(|tiling| network.defines().into_iter().chain(tiling.defines()).collect())
            })
            .collect(),
        _ => vec![Vec::new()],
    }
}

#[test]
#[ignore = "needs NVRTC (`make test` fetches it)"]
fn for_both_architectures() {
    let sources = SOURCES.iter().filter_map(|(path, _)| path.rsplit('/').next());
    let requests = sources.flat_map(|source| {
        let of_variant = move |defines: Vec<String>| [(8, 0), (9, 0)].map(|capability| (source, capability, defines.clone()));
        variants(source).into_iter().flat_map(of_variant)
    });
    requests.par_bridge().for_each(|(source, capability, defines)| {
        let cubin = Request::new(source, capability, &defines).unwrap().compile().unwrap_or_else(|error| panic!("{error}"));
        assert!(cubin.starts_with(b"\x7fELF"), "{source} {defines:?}: machine code");
    });
}

#[test]
#[ignore = "needs NVRTC (`make test` fetches it)"]
fn what_does_not_compile_is_told_with_the_log() {
    let request = Request::new("trace_closed.cu", (9, 0), &["RW_REAL=nonsense".into(), "RW_FORM=0".into()]).unwrap();
    let error = request.compile().unwrap_err().to_string();
    assert!(error.contains("trace_closed.cu") && error.contains("nonsense"), "{error}");
}
