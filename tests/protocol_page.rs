//! The page that describes the records, held against the records.

#![allow(clippy::unwrap_used)]

use ridgewatch::engine::{FrameRecord, StageSeconds};
use ridgewatch::source::live::LiveRecord;
use ridgewatch::surrogate::Learned;
use ridgewatch::trust::TrustedError;
use std::collections::BTreeSet;

fn keys(value: &impl serde::Serialize) -> BTreeSet<String> {
    serde_json::to_value(value).unwrap().as_object().unwrap().keys().cloned().collect()
}

/// Names in back quotes: of a table, those in its first column.
fn quoted(text: &str, column: bool) -> BTreeSet<String> {
    let part = |line: &str| if column { line.split('|').nth(1).unwrap_or("").to_owned() } else { line.to_owned() };
    let text: Vec<String> = text.lines().map(part).collect();
    text.join(" ").split('`').skip(1).step_by(2).map(str::to_owned).collect()
}

#[test]
fn the_page_names_every_key_of_a_record_and_no_other() {
    let page = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/docs/protocol.md")).unwrap();
    let record = page.split("## The record").nth(1).unwrap().split("\n## ").next().unwrap();
    let (fields, rest) = record.split_once("`trusted` and `verified`:").unwrap();
    let (fields, live) = fields.split_once("`live`, of a simulation that runs now").unwrap();
    assert_eq!(quoted(fields, true), keys(&FrameRecord::default()));
    assert_eq!(quoted(live, true), keys(&LiveRecord::default()));
    assert_eq!(quoted(rest.split("`training`:").next().unwrap(), true), keys(&TrustedError::default()));
    let paragraph = |start: &str| {
        let text = rest.split("\n\n").map(str::trim).find(|text| text.starts_with(start)).unwrap();
        quoted(text.strip_prefix(start).unwrap(), false)
    };
    assert_eq!(paragraph("`training`:"), keys(&Learned::default()));
    assert_eq!(paragraph("`seconds`:"), keys(&StageSeconds::default()));
}
