//! Records of a run folder that are read out of order.

use ridgewatch::publish::PastRun;
use ridgewatch::run::FrameRecord;

/// Records of frames 0, 2, 4, ... in two files, with lines of other lengths and two that are none.
fn past() -> (tempfile::TempDir, PastRun) {
    let folder = tempfile::tempdir().unwrap();
    let line = |frame: u64| {
        let record = FrameRecord { frame: 2 * frame, warnings: vec!["x".repeat((frame * 37 % 211) as usize)], ..Default::default() };
        serde_json::to_string(&record).unwrap() + "\n"
    };
    let text = |frames: std::ops::Range<u64>| frames.map(line).collect::<String>();
    std::fs::write(folder.path().join("records-1.jsonl"), text(0..150) + "{\"frame\": 29\n" + &text(150..300)).unwrap();
    std::fs::write(folder.path().join("records.jsonl"), text(300..500) + "{\"frame\": 1000").unwrap();
    let past = PastRun::open(folder.path()).unwrap();
    (folder, past)
}

#[test]
fn a_record_is_found_among_many() {
    let (_folder, past) = past();
    for frame in 0..1002 {
        let found = past.record(frame).unwrap().map(|record| record.frame);
        assert_eq!(found, (frame % 2 == 0 && frame < 1000).then_some(frame));
    }
}

#[test]
fn records_are_thinned_evenly_and_few_are_all() {
    let (_folder, past) = past();
    let frames = |most: u64| -> Vec<u64> {
        let some = past.some_records(most).unwrap();
        some.iter().map(|line| serde_json::from_str::<FrameRecord>(line).unwrap().frame).collect()
    };
    assert_eq!(frames(1 << 20), (0..500).map(|frame| 2 * frame).collect::<Vec<_>>());
    let few = frames(50);
    assert!((45..=52).contains(&few.len()) && few[0] == 0 && few[few.len() - 1] > 960, "{few:?}");
    assert!(few.windows(2).all(|pair| (10..=30).contains(&(pair[1] - pair[0]))), "{few:?}");
    assert_eq!(frames(1).len(), 2, "one of each file");
}
