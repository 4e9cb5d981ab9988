//! The page of records and checkpoints, compared with those that are written.

use crate::network_support::{DoubleGyre, traced, uniform_points};
use crate::page;
use ridgewatch::flow::Tracer;
use ridgewatch::publish::{PROTOCOL, WorkMark};
use ridgewatch::render::smooth::PictureError;
use ridgewatch::run::{CheckpointRecord, FrameRecord, StageSeconds};
use ridgewatch::source::live::LiveRecord;
use ridgewatch::surrogate::network::{Encoding, Input, NetworkSettings};
use ridgewatch::surrogate::{Kind, Learned, ReplayBuffer, SurrogateSettings, build};
use ridgewatch::trust::TrustedError;
use std::collections::{BTreeMap, BTreeSet};

fn keys(value: &impl serde::Serialize) -> BTreeSet<String> {
    serde_json::to_value(value).unwrap().as_object().unwrap().keys().cloned().collect()
}

/// Names in back quotes, of a table only those in its first column.
fn quoted(text: &str, column: bool) -> BTreeSet<String> {
    let part = |line: &str| if column { line.split('|').nth(1).unwrap_or("").to_owned() } else { line.to_owned() };
    let text: Vec<String> = text.lines().map(part).collect();
    text.join(" ").split('`').skip(1).step_by(2).map(str::to_owned).collect()
}

#[test]
fn the_page_names_every_key_of_a_record_and_no_other() {
    let page = page("protocol.md");
    let record = page.split("## The record").nth(1).unwrap().split("\n## ").next().unwrap();
    let (fields, rest) = record.split_once("`trusted_error` and `verified_error`:").unwrap();
    let (fields, live) = fields.split_once("`live`, of a simulation that runs now").unwrap();
    assert_eq!(quoted(fields, true), keys(&FrameRecord::default()));
    assert_eq!(quoted(live, true), keys(&LiveRecord::default()));
    assert_eq!(quoted(rest.split("`training`:").next().unwrap(), true), keys(&TrustedError::default()));
    let paragraph = |start: &str| {
        let text = rest.split("\n\n").map(str::trim).find(|text| text.starts_with(start)).unwrap();
        quoted(text.strip_prefix(start).unwrap(), false)
    };
    assert_eq!(paragraph("`picture_error`:"), keys(&PictureError::default()));
    assert_eq!(paragraph("`training`:"), keys(&Learned::default()));
    assert_eq!(paragraph("`checkpoint`:"), keys(&CheckpointRecord::default()));
    assert_eq!(paragraph("`seconds`:"), keys(&StageSeconds::default()));
}

#[test]
fn the_page_names_every_key_of_a_message_about_work() {
    let page = page("protocol.md");
    let section = page.split("### `work`\n").nth(1).unwrap().split("\n### ").next().unwrap();
    assert_eq!(quoted(section, true), keys(&WorkMark { protocol: PROTOCOL, work: None, marks: 0 }));
}

#[test]
fn the_page_names_all_that_a_checkpoint_holds_and_nothing_else() {
    let page = page("protocol.md");
    let weights = page.split("## Weights").nth(1).unwrap();
    let (folder, tracer) = (tempfile::tempdir().unwrap(), DoubleGyre::new(0.0, 3.0, 20));
    let hash = NetworkSettings { levels: Some(2), log2_table: Some(6), width: 16, batch: Some(64), ..NetworkSettings::default() };
    let start = NetworkSettings { inputs: vec![Input::Start], start_range: Some([0.0, 1.0]), ..hash.clone() };
    let frequency = NetworkSettings { encoding: Encoding::Frequency, ..hash.clone() };
    let (mut tensors, mut notes, mut shapes) = (BTreeSet::new(), BTreeSet::new(), Vec::new());
    for (kind, network) in [(Kind::Table, &hash), (Kind::Residual, &hash), (Kind::Network, &start), (Kind::Network, &frequency)] {
        let settings = SurrogateSettings { kind, table_nodes: Some([5, 4, 2]), ..SurrogateSettings::default() };
        let mut surrogate = build(&settings, network, tracer.domain(), 5, &tracer).unwrap();
        surrogate.learn(&ReplayBuffer::holding(&traced(&tracer, uniform_points(3, 100), false)), f64::INFINITY, 1).unwrap();
        let path = folder.path().join("checkpoint");
        surrogate.save(&path).unwrap();
        let file = std::fs::read(path).unwrap();
        let length = u64::from_le_bytes(file[..8].try_into().unwrap()) as usize;
        let mut header: BTreeMap<String, serde_json::Value> = serde_json::from_slice(&file[8..8 + length]).unwrap();
        let metadata = header.remove("__metadata__").unwrap();
        notes.extend(keys(&metadata));
        tensors.extend(header.into_keys());
        if let Some(shape) = metadata.get("network.shape") {
            shapes.push(serde_json::from_str::<serde_json::Value>(shape.as_str().unwrap()).unwrap());
        }
    }
    let table = |head: &str| quoted(weights.split(head).nth(1).unwrap().split("\n\n").next().unwrap(), true);
    assert_eq!(table("| tensor |"), tensors);
    assert_eq!(table("| key |"), notes);
    assert_eq!(table("| of `network.shape` |"), keys(&shapes[0]));
    let parts = weights.split("\n\n").find(|text| text.starts_with("Of a level:")).unwrap();
    let (level, layer) = parts.split_once("Of a layer:").unwrap();
    assert_eq!(quoted(level, false), keys(&shapes[0]["levels"][0]));
    assert_eq!(quoted(&layer.replace("`network.layers`", ""), false), keys(&shapes[0]["layers"][0]));
}
