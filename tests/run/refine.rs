//! A finer table for a picture that stands still.

use crate::kit::program::{config, records, set, summary, text};
use crate::{picture, ridgewatch};
use ridgewatch::run::FrameRecord;
use std::path::Path;

const SCENE: [&str; 5] =
    ["source.nodes=[24, 12, 12]", "source.snapshots=14", "time.slides=2", "time.frames_per_slide=8", "time.warmup_frames=0"];

/// The choice of table nodes in the summary.
fn chosen(run: &Path) -> Vec<[String; 2]> {
    let summary = summary(run);
    let decisions = summary["run"]["decisions"].as_array().unwrap();
    let of_nodes = decisions.iter().filter(|decision| decision["setting"] == "surrogate.table_nodes");
    of_nodes.map(|decision| ["chosen", "why"].map(|key| decision[key].as_str().unwrap().to_owned())).collect()
}

fn replay(folder: &Path, name: &str, keys: &[&str]) -> (Vec<FrameRecord>, Vec<[String; 2]>) {
    let run = folder.join(name);
    let (scene, size, keys) = (config("turbulence_easy.toml"), picture([32, 16, 2]), set(&[&SCENE[..], keys].concat()));
    let size: Vec<&str> = size.iter().map(String::as_str).collect();
    ridgewatch([&["replay", &scene, "--out", text(&run), "--device", "cpu"][..], &size, &keys].concat()).success();
    (records(&run), chosen(&run))
}

#[test]
fn a_picture_that_stands_still_starts_anew_on_a_finer_table() {
    let folder = tempfile::tempdir().unwrap();
    // 47 x 23 x 23 nodes are the work of 1.5 frames of 32 x 16 pixels with two samples, 16 nodes for each, and come at once. The first of eight frames has an
    // eighth of a sample, the second what is missing, and the third the samples of two. Where the first is noisy, the second is completed before.
    let (clear, noisy) = ([0.0, 2.0, 6.0, 8.0, 10.0, 12.0, 14.0, 16.0], [0.0, 2.0, 2.0, 4.0, 6.0, 8.0, 10.0, 12.0]);
    for (name, keys, at, expected) in [("clear", &["transfer.extinction=0.1"][..], 1, clear), ("noisy", &[], 2, noisy)] {
        let (open, nodes) = replay(folder.path(), name, keys);
        let samples: Vec<f64> = open.iter().map(|record| record.picture_error.unwrap().samples_per_pixel.round()).collect();
        assert_eq!(samples, expected.repeat(2), "{name}: each window begins with the nodes of the data");
        assert!(open.iter().step_by(8).all(|record| record.samples_per_pixel == 0.125));
        assert!(open.iter().step_by(8).all(|record| (record.picture_error.unwrap().psnr.value < 32.0) == (name == "noisy")));
        let refined: Vec<bool> = open.iter().map(|record| record.seconds.refine > 0.0).collect();
        assert_eq!(refined, (0..8).map(|frame| frame == at).collect::<Vec<_>>().repeat(2), "{name}");
        assert_eq!((nodes.len(), nodes[0][0].as_str()), (1, "[47, 23, 23]"));
        assert!(nodes[0][1].contains("[24, 12, 12]") && nodes[0][1].contains(&format!("after {at} frames of slide 1")), "{nodes:?}");
    }
    for keys in [&["surrogate.refine=false"][..], &["surrogate.table_nodes=[24, 12, 12]"], &["time.frames_per_slide=4"]] {
        let (kept, _) = replay(folder.path(), &format!("kept {}", keys[0].len()), keys);
        let first = kept.iter().filter(|record| record.slide == 0);
        let samples: Vec<f64> = first.map(|record| record.picture_error.unwrap().samples_per_pixel).collect();
        assert!(samples.windows(2).all(|pair| pair[1] > pair[0]), "{keys:?}: {samples:?}");
        assert!(kept.iter().all(|record| record.seconds.refine == 0.0), "{keys:?}");
    }
}

#[test]
fn a_table_is_audited_as_its_queries_warrant() {
    let folder = tempfile::tempdir().unwrap();
    let (records, _) = replay(folder.path(), "few", &["render.samples=0.1", "surrogate.refine=false"]);
    for slide in records.chunks(8) {
        assert!(slide[0].audited > 0 && slide[0].surrogate_psnr.is_some(), "each window is audited");
        assert!(slide.iter().filter(|record| record.audited == 0).count() > 4);
        for pair in slide.windows(2).filter(|pair| pair[1].audited == 0) {
            let [before, after] =
                [&pair[0], &pair[1]].map(|r| (r.trusted_error, r.tolerance_excess, r.surrogate_psnr, r.mean_lifetime_share));
            assert_eq!(before, after, "what the last audit found");
        }
    }
    // Many queries warrant an audit of each frame.
    let (records, _) = replay(folder.path(), "many", &["render.samples=64", "surrogate.refine=false", "trust.audit_share=1"]);
    assert!(records.chunks(8).flat_map(|slide| &slide[2..]).all(|record| record.audited > 0));
}

/// A budget buys nodes too. That of this run has time for many times the nodes, so that a slow machine refines the table as well.
#[test]
fn a_run_with_a_budget_refines_its_table() {
    let folder = tempfile::tempdir().unwrap();
    let keys = ["render.budget=500", "time.slides=1", "time.frames_per_slide=12"];
    let (records, nodes) = replay(folder.path(), "budget", &keys);
    assert_eq!(records[0].seconds.refine, 0.0, "the first picture comes soon, and tells what a frame costs");
    let refined = records.iter().filter(|record| record.seconds.refine > 0.0).count();
    assert!(refined > 0 && refined < records.len(), "{refined} frames");
    assert!(nodes[0][0] != "[24, 12, 12]" && nodes[0][1].contains(" halved after "), "{nodes:?}");
    let mut took: Vec<f64> = records[1..].iter().map(|r| r.seconds.refine + r.seconds.render + r.seconds.trace).collect();
    took.sort_by(f64::total_cmp);
    // Twice the budget: the machine may have other work.
    assert!(took[took.len() / 2] < 1.0, "{took:?}");
}

/// Marching keeps to a budget in which it has no time for rays in each frame.
#[test]
fn a_short_budget_holds_for_the_march_too() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("run");
    let keys =
        ["render.width=96", "render.height=96", "render.budget=60", "time.slides=1", "time.frames_per_slide=16", "time.warmup_frames=1"];
    ridgewatch([&["replay", &config("abc.toml"), "--out", text(&out), "--device", "cpu"][..], &set(&keys)].concat()).success();
    let records = records(&out);
    let mut took: Vec<f64> = records[1..].iter().map(|r| r.seconds.refine + r.seconds.render + r.seconds.trace).collect();
    took.sort_by(f64::total_cmp);
    // Twice the budget: the machine may have other work.
    assert!(took[took.len() / 2] < 0.12, "{took:?}");
    let error = |record: &FrameRecord| record.picture_error.unwrap();
    let (first, last) = (error(&records[1]), error(&records[16]));
    assert!(last.rays_per_pixel >= 2 * first.rays_per_pixel && last.psnr.value > first.psnr.value + 3.0, "it goes on: {first:?}, {last:?}");
}

/// A picture of many samples in one frame begins with a table that is worth them, and is better for it.
#[test]
fn a_single_picture_of_many_samples_has_a_finer_table() {
    let folder = tempfile::tempdir().unwrap();
    let render = |name: &str, keys: &[&str]| {
        let out = folder.path().join(name);
        let common = ["source.nodes=[24, 12, 12]", "render.width=32", "render.height=16", "transfer.low=0.05", "transfer.high=0.25"];
        let keys = set(&[&common[..], keys].concat());
        let (scene, out) = (config("turbulence_easy.toml"), text(&out).to_owned());
        ridgewatch([&["render", &scene, "--warmup", "0", "--device", "cpu", "--out", &out][..], &keys].concat()).success();
        out
    };
    let truth = render("truth.exr", &["render.method=reference", "render.samples=4096"]);
    let [coarse, fine] = [("coarse.exr", "surrogate.refine=false"), ("fine.exr", "surrogate.refine=true")]
        .map(|(name, key)| render(name, &[key, "render.method=two_level", "render.samples=64"]));
    let psnr = |out: &str| ridgewatch(["compare", out, &truth, "--json"]).json()["psnr"].as_f64().unwrap();
    let (coarse, fine) = (psnr(&coarse), psnr(&fine));
    assert!(fine > coarse + 2.0, "{fine} dB, {coarse} dB with the nodes of the data");
}
