//! `/metrics`: the text of the format, its values, and those who name them.

use crate::visitor::{Visitor, ask, get};
use crate::{LIMIT, Stage, frame};
use ridgewatch::publish::{PublishSettings, Publisher};
use ridgewatch::render::smooth::{ErrorEstimate, PictureError};
use ridgewatch::run::{CheckpointRecord, Frame, FrameRecord, StageSeconds};
use ridgewatch::source::live::LiveRecord;
use ridgewatch::surrogate::Learned;
use ridgewatch::trust::TrustedError;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

/// A record in which all is known.
fn full(number: u64) -> FrameRecord {
    let estimate = ErrorEstimate { value: 40.0, low: 39.0, high: 41.5 };
    FrameRecord {
        frame: number,
        source: "a \"quoted\" \\ name\nof two lines".into(),
        size: [48, 32],
        queries: 100,
        traced: 25,
        traced_share: 0.25,
        warnings: vec!["a".into(), "b".into()],
        tolerance_excess: Some(0.5),
        trusted_error: Some(TrustedError { optical_rms: 0.01, optical_rms_interval: [0.005, 0.02], ..Default::default() }),
        picture_error: Some(PictureError { psnr: estimate, rms: estimate, ..Default::default() }),
        gate_evidence: Some(1.5),
        surrogate_psnr: Some(31.0),
        training: Some(Learned { steps: 7, samples: 64, loss: Some(0.125), ..Default::default() }),
        checkpoint: Some(CheckpointRecord { bytes: Some(4096), ..Default::default() }),
        live: Some(LiveRecord { step: 812, age: 0.25, missed_blocks: 3, ..Default::default() }),
        seconds: StageSeconds { render: 0.5, trace: 0.125, total: 0.75, elapsed: 9.0, ..Default::default() },
        ..Default::default()
    }
}

/// A metric as a scraper reads it.
#[derive(Debug, Default)]
struct Family {
    kind: String,
    /// By the text of the labels.
    samples: BTreeMap<String, f64>,
}

/// Reads the text, and holds it to the format: HELP and TYPE once before the samples, names and labels of the accepted letters, values that parse.
fn parse(text: &str) -> BTreeMap<String, Family> {
    let mut families = BTreeMap::<String, Family>::new();
    let is_name =
        |name: &str| name.starts_with("ridgewatch_") && name.bytes().all(|b| b.is_ascii_lowercase() || b.is_ascii_digit() || b == b'_');
    let (mut helped, mut current) = (String::new(), String::new());
    assert!(text.ends_with('\n') && !text.contains("\n\n"));
    for line in text.lines() {
        if let Some(help) = line.strip_prefix("# HELP ") {
            let (name, help) = help.split_once(' ').unwrap();
            assert!(is_name(name) && help.ends_with('.') && !families.contains_key(name), "{line}");
            helped = name.to_owned();
        } else if let Some(kind) = line.strip_prefix("# TYPE ") {
            let (name, kind) = kind.split_once(' ').unwrap();
            assert!(name == helped && ["gauge", "counter"].contains(&kind), "{line}");
            assert_eq!(name.ends_with("_total"), kind == "counter", "{line}");
            families.insert(name.to_owned(), Family { kind: kind.to_owned(), ..Default::default() });
            current = name.to_owned();
        } else {
            let (series, value) = line.rsplit_once(' ').unwrap();
            let (name, labels) = series.split_once('{').map_or((series, ""), |(name, labels)| (name, labels.strip_suffix('}').unwrap()));
            assert_eq!(name, current, "{line}");
            let value: f64 = value.parse().unwrap();
            let family = families.get_mut(name).unwrap();
            assert!(value.is_finite() && (family.kind == "gauge" || value >= 0.0), "{line}");
            assert!(family.samples.insert(labels.to_owned(), value).is_none(), "twice: {line}");
        }
    }
    families
}

fn scrape(stage: &Stage) -> BTreeMap<String, Family> {
    let (status, answer) = get(stage.address(), &format!("/node/a/metrics?token={}", stage.token), &[]);
    assert_eq!(status, 200, "{answer}");
    let (head, text) = answer.split_once("\r\n\r\n").unwrap();
    assert!(head.contains("content-type: text/plain; version=0.0.4; charset=utf-8"), "{head}");
    parse(text)
}

/// Metrics after `records` full records.
fn published(records: u64) -> BTreeMap<String, Family> {
    let stage = Stage::new();
    let publisher = Publisher::start(&stage.endpoint(), &PublishSettings::default()).unwrap();
    let mut visitor = Visitor::open(stage.address(), &stage.token);
    // Until the dashboard subscribes, records go nowhere.
    let begin = Instant::now();
    while scrape(&stage)["ridgewatch_records_total"].samples[""] == 0.0 {
        assert!(begin.elapsed() < LIMIT);
        publisher.frame(Frame { record: Arc::new(FrameRecord { size: [48, 32], ..Default::default() }), ..frame(0) });
        std::thread::sleep(std::time::Duration::from_millis(50));
    }
    for number in 1..=records {
        publisher.frame(Frame { record: Arc::new(full(number)), ..frame(number) });
    }
    visitor.until_state(|_| scrape(&stage)["ridgewatch_frame"].samples[""] == records as f64);
    let (status, text) = get(stage.address(), &format!("/metrics?token={}", stage.token), &[]);
    assert_eq!(status, 200);
    if let Some(path) = std::env::var_os("METRICS_TEXT") {
        // For a parser of another project.
        std::fs::write(path, text.split_once("\r\n\r\n").unwrap().1).unwrap();
    }
    scrape(&stage)
}

#[test]
fn counters_sum_the_records_and_gauges_are_those_of_the_newest() {
    let metrics = published(3);
    let value = |name: &str, labels: &str| metrics[&format!("ridgewatch_{name}")].samples[labels];
    for (name, labels, expected) in [
        ("queries_total", "", 300.0),
        ("queries_traced_total", "", 75.0),
        ("warnings_total", "", 6.0),
        ("frames_over_tolerance_total", "", 3.0),
        ("optimizer_steps_total", "", 21.0),
        ("training_samples_total", "", 192.0),
        ("checkpoints_total", "", 3.0),
        ("checkpoint_failures_total", "", 0.0),
        ("records_unreadable_total", "", 0.0),
        ("stage_seconds_total", "stage=\"render\"", 1.5),
        ("stage_seconds_total", "stage=\"trace\"", 0.375),
        ("frame", "", 3.0),
        ("traced_ratio", "", 0.25),
        ("tolerance_excess_ratio", "", 0.5),
        ("trusted_error_ratio", "bound=\"value\"", 0.01),
        ("trusted_error_ratio", "bound=\"high\"", 0.02),
        ("picture_psnr_decibels", "bound=\"low\"", 39.0),
        ("training_loss", "", 0.125),
        ("checkpoint_bytes", "", 4096.0),
        ("picture_pixels", "", 1536.0),
        ("simulation_step", "", 812.0),
        // Age and frame: what the page calls lag.
        ("simulation_lag_seconds", "", 1.0),
        ("simulation_missed_blocks_total", "", 3.0),
        ("frame_duration_seconds", "", 0.75),
        ("run_elapsed_seconds", "", 9.0),
        ("publisher_connected", "", 1.0),
        ("pages", "", 1.0),
    ] {
        assert_eq!(value(name, labels), expected, "{name} {labels}");
    }
    let info = metrics["ridgewatch_run_info"].samples.keys().next().unwrap();
    assert!(info.contains(r#"source="a \"quoted\" \\ name\nof two lines""#), "{info}");
    let now = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).unwrap().as_secs_f64();
    assert!((0.0..60.0).contains(&(now - value("record_received_timestamp_seconds", ""))));
}

#[test]
fn the_page_and_the_example_name_the_metrics_that_are_there() {
    let names: BTreeSet<String> = published(1).into_keys().collect();
    let file = |path: &str| std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join(path)).unwrap();
    let page = file("docs/dashboard.md");
    let rows = page.lines().filter_map(|line| line.strip_prefix("| `")?.split_once('`')).map(|(name, _)| name.to_owned());
    let told: BTreeSet<String> = rows.filter(|name| name.starts_with("ridgewatch_")).collect();
    assert_eq!(told, names);
    let example: serde_json::Value = serde_json::from_str(&file("examples/grafana.json")).unwrap();
    let panels = example["panels"].as_array().unwrap();
    let queries: Vec<&str> =
        panels.iter().flat_map(|panel| panel["targets"].as_array().unwrap()).map(|t| t["expr"].as_str().unwrap()).collect();
    assert!(panels.len() > 5 && queries.len() > panels.len());
    for query in queries {
        let words: Vec<&str> =
            query.split(|c: char| !c.is_ascii_alphanumeric() && c != '_').filter(|word| word.contains("ridgewatch")).collect();
        assert!(!words.is_empty() && words.iter().all(|word| names.contains(*word)), "{query}");
        // A rate of a gauge, and the value of a counter, are of no use.
        assert_eq!(query.contains("rate(") || query.contains("increase("), words.iter().all(|word| word.ends_with("_total")), "{query}");
    }
}

#[test]
fn without_records_and_with_unknown_ones_there_are_metrics_of_the_server_alone() {
    let stage = Stage::new();
    let metrics = scrape(&stage);
    assert_eq!(metrics["ridgewatch_publisher_connected"].samples[""], 0.0);
    assert!(!metrics.contains_key("ridgewatch_frame") && !metrics.contains_key("ridgewatch_run_info"));
    let mut visitor = stage.visit();
    // It sends a record with a frame number alone.
    let _publisher = crate::raw_publisher(&stage, &mut visitor);
    let metrics = scrape(&stage);
    let unreadable = metrics["ridgewatch_records_unreadable_total"].samples[""];
    assert!(
        unreadable >= 1.0 && unreadable == metrics["ridgewatch_records_total"].samples[""] && !metrics.contains_key("ridgewatch_frame")
    );
}

#[test]
fn metrics_need_a_token() {
    let stage = Stage::new();
    let (address, token) = (stage.address(), stage.token.clone());
    let watching = stage.dashboard.watching_url().split("token=").nth(1).unwrap().to_owned();
    let of = |query: &str, lines: &[&str]| get(address, &format!("/metrics{query}"), lines).0;
    for good in [&token, &watching] {
        assert_eq!(of(&format!("?token={good}"), &[]), 200);
        assert_eq!(of("", &[&format!("Authorization: Bearer {good}")]), 200);
    }
    for (query, line) in [
        ("", "X-Nothing: 1".to_owned()),
        ("", format!("Authorization: Basic {token}")),
        ("", format!("Authorization: Bearer {token}0")),
        ("?token=0", format!("Authorization: Bearer {token}")),
        ("", format!("Cookie: token={token}")),
    ] {
        assert_eq!(of(query, &[&line]), 403, "{query} {line}");
    }
    assert_eq!(of(&format!("?token={token}"), &["Origin: https://evil.example.org"]), 403);
    let head = format!("GET /metrics?token={token} HTTP/1.1\r\nHost: evil.example.org\r\nConnection: close\r\n\r\n");
    assert_eq!(ask(address, &head).0, 403);
    // The page takes its token from the address only, and no other path takes it from the head.
    assert_eq!(get(address, "/values?x=0&y=0", &[&format!("Authorization: Bearer {token}")]).0, 403);
}
