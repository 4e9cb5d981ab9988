//! Frames through a real socket.

use crate::kit::publishing::{self, GREETING};
use ridgewatch::progress::Work;
use ridgewatch::publish::{
    FRAME_TOPIC, FrameHeader, Output, PROTOCOL, Payload, PublishError, PublishSettings, Publisher, RECORD_TOPIC, RunFolder, Summary,
    WORK_TOPIC, WorkMark, decode_exr,
};
use ridgewatch::render::Film;
use ridgewatch::run::{Frame, FrameRecord};
use std::sync::Arc;
use std::time::{Duration, Instant};
use zeromq::{Socket, SocketRecv, SubSocket, ZmqMessage};

/// Longer than anything here takes on a busy machine, so that a test that hangs fails.
const LIMIT: Duration = Duration::from_secs(120);

fn frame(number: u64) -> Frame {
    let rgba = (0..24 * 16).map(|i| [i as f32 / 384.0, number as f32 / 1000.0, 0.5, 1.0]).collect();
    let film = Film { width: 24, height: 16, rgba, ..Default::default() };
    let record = FrameRecord { frame: number, time: 0.5 * number as f64, warnings: vec!["odd".into()], ..Default::default() };
    publishing::frame(record, film)
}

fn settings(payload: Payload) -> PublishSettings {
    // No subscriber counts as stalled here, however slow the machine is.
    PublishSettings { payload, endpoint: Some("tcp://127.0.0.1:0".into()), stall_seconds: LIMIT.as_secs_f64(), ..Default::default() }
}

async fn subscribe(endpoint: &str, topics: &[&str]) -> SubSocket {
    let mut socket = SubSocket::new();
    socket.connect(endpoint).await.unwrap();
    for topic in topics {
        socket.subscribe(topic).await.unwrap();
    }
    socket
}

async fn receive_header(socket: &mut SubSocket) -> FrameHeader {
    serde_json::from_slice(receive(socket).await.get(1).unwrap()).unwrap()
}

async fn receive(socket: &mut SubSocket) -> ZmqMessage {
    tokio::time::timeout(LIMIT, socket.recv()).await.expect("a message in time").unwrap()
}

/// Sends frames until the subscription takes effect. Returns the number of the last frame that was sent and the first message.
async fn first_message(publisher: &Publisher, socket: &mut SubSocket) -> (u64, ZmqMessage) {
    for number in 0..1000 {
        publisher.frame(frame(number));
        if let Ok(message) = tokio::time::timeout(Duration::from_millis(50), socket.recv()).await {
            return (number, message.unwrap());
        }
    }
    panic!("no message came");
}

#[tokio::test(flavor = "multi_thread")]
async fn every_encoding_arrives_and_decodes() {
    for payload in [Payload::Jpeg, Payload::Png, Payload::Exr, Payload::Raw] {
        let publisher = Publisher::start("tcp://127.0.0.1:0", &settings(payload)).unwrap();
        let mut socket = subscribe(publisher.endpoint(), &[FRAME_TOPIC]).await;
        let (_, message) = first_message(&publisher, &mut socket).await;
        assert_eq!(message.len(), 3);
        assert_eq!(message.get(0).unwrap(), FRAME_TOPIC.as_bytes());
        let header: FrameHeader = serde_json::from_slice(message.get(1).unwrap()).unwrap();
        let body = message.get(2).unwrap();
        let sent = frame(header.frame);
        assert_eq!((header.encoding, header.payload_bytes), (payload, body.len()));
        assert_eq!(header.record, *sent.record);
        let film = &sent.film;
        match payload {
            Payload::Jpeg | Payload::Png => {
                let picture = image::load_from_memory(body).unwrap().to_rgb8();
                assert_eq!((header.shape, header.dtype.as_str()), ([16, 24, 3], "uint8"));
                assert_eq!(picture.dimensions(), (24, 16));
                if payload == Payload::Png {
                    assert_eq!(picture.into_raw(), film.tone_mapped(header.tone_map));
                }
            }
            Payload::Exr => assert_eq!(decode_exr(body).unwrap().rgba, film.rgba),
            Payload::Raw => {
                assert_eq!((header.shape, header.dtype.as_str()), ([16, 24, 4], "float32"));
                let floats: Vec<f32> = body.chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect();
                assert_eq!(floats, film.rgba.as_flattened());
            }
        }
        let statistics = publisher.finish(LIMIT);
        assert_eq!(statistics.frames, statistics.sent + statistics.superseded + statistics.without_subscriber, "{statistics:?}");
        assert_eq!(statistics.peak_subscribers, 1);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn every_record_arrives_though_pictures_are_superseded() {
    let publisher = Publisher::start("tcp://127.0.0.1:0", &settings(Payload::Png)).unwrap();
    // Pictures that nobody wants are not encoded, and then none might be superseded.
    let mut socket = subscribe(publisher.endpoint(), &[RECORD_TOPIC, FRAME_TOPIC]).await;
    let (sent, mut message) = first_message(&publisher, &mut socket).await;
    // A burst of large pictures, much faster than they can be encoded.
    let film = Arc::new(Film { width: 512, height: 512, rgba: vec![[0.5, 0.25, 0.125, 1.0]; 512 * 512], ..Default::default() });
    for number in sent + 1..sent + 100 {
        publisher.frame(Frame { film: film.clone(), ..frame(number) });
    }
    let mut numbers: Vec<u64> = Vec::new();
    loop {
        if message.get(0).unwrap().as_ref() == RECORD_TOPIC.as_bytes() {
            assert_eq!(message.len(), 2);
            numbers.push(serde_json::from_slice::<FrameRecord>(message.get(1).unwrap()).unwrap().frame);
        }
        if numbers.last() == Some(&(sent + 99)) {
            break;
        }
        message = receive(&mut socket).await;
    }
    assert!(numbers.len() >= 99 && numbers.windows(2).all(|pair| pair[1] == pair[0] + 1), "{numbers:?}");
    let statistics = publisher.finish(LIMIT);
    assert!(statistics.superseded > 0 && statistics.records_dropped == 0, "{statistics:?}");
}

fn work_mark(message: &ZmqMessage) -> WorkMark {
    assert_eq!((message.len(), message.get(0).unwrap().as_ref()), (2, WORK_TOPIC.as_bytes()));
    serde_json::from_slice(message.get(1).unwrap()).unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn what_takes_long_is_told_each_second_and_once_that_it_is_over() {
    let publisher = Publisher::start("tcp://127.0.0.1:0", &settings(Payload::Jpeg)).unwrap();
    let mut socket = subscribe(publisher.endpoint(), &[WORK_TOPIC]).await;
    let begin = Instant::now();
    let work = Work::begun("a test", begin - Duration::from_secs(100));
    let mut marks = 0;
    for done in 1..=3 {
        work.reached(done, 4);
        // One of before may have been on its way.
        let share = format!("a test: {} %, about ", 25 * done);
        let mark = loop {
            let mark = work_mark(&receive(&mut socket).await);
            if mark.work.as_deref().is_some_and(|words| words.starts_with(&share)) {
                break mark;
            }
        };
        assert!(mark.protocol == PROTOCOL && mark.marks > marks, "{mark:?} after {marks}");
        marks = mark.marks;
    }
    assert!(begin.elapsed() >= Duration::from_secs(2), "three in {:?}", begin.elapsed());
    drop(work);
    while work_mark(&receive(&mut socket).await).work.is_some() {}
    if let Ok(message) = tokio::time::timeout(Duration::from_millis(2500), socket.recv()).await {
        let mark = work_mark(&message.unwrap());
        assert!(mark.work.is_some(), "of another test, or it is told twice that it is over: {mark:?}");
    }
}

/// More strangers than places, from the address of the subscribers or from another. All send the greeting of ZMTP 3 and stay.
#[tokio::test(flavor = "multi_thread")]
async fn strangers_who_greet_and_stay_keep_nobody_out() {
    // One after the other: each connection is looked up among all connections of this machine.
    strangers_from("127.0.0.1:0").await;
    strangers_from("127.0.0.2:0").await;
}

async fn strangers_from(own: &str) {
    let publisher = Publisher::start("tcp://127.0.0.1:0", &settings(Payload::Jpeg)).unwrap();
    let mut early = subscribe(publisher.endpoint(), &[FRAME_TOPIC]).await;
    first_message(&publisher, &mut early).await;
    let address: std::net::SocketAddr = publisher.endpoint().strip_prefix("tcp://").unwrap().parse().unwrap();
    let mut strangers = Vec::new();
    for _ in 0..300 {
        let socket = tokio::net::TcpSocket::new_v4().unwrap();
        socket.bind(own.parse().unwrap()).unwrap();
        let mut stranger = socket.connect(address).await.unwrap();
        tokio::io::AsyncWriteExt::write_all(&mut stranger, &GREETING).await.unwrap();
        strangers.push(stranger);
    }
    let mut late = subscribe(publisher.endpoint(), &[FRAME_TOPIC]).await;
    first_message(&publisher, &mut late).await;
    // The first subscriber still gets its frames on one connection.
    publisher.frame(frame(5000));
    while receive_header(&mut early).await.frame != 5000 {}
    // Strangers have some seconds to subscribe.
    let mut last = strangers.pop().unwrap();
    let mut sent = Vec::new();
    let gone = tokio::io::AsyncReadExt::read_to_end(&mut last, &mut sent);
    tokio::time::timeout(LIMIT, gone).await.expect("a client that does not subscribe is disconnected").ok();
    publisher.frame(frame(5001));
    receive(&mut early).await;
    let statistics = tokio::task::spawn_blocking(move || publisher.finish(LIMIT)).await.unwrap();
    assert_eq!(statistics.stall_disconnects, 0, "{statistics:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn finishing_flushes_the_last_frame() {
    let publisher = Publisher::start("tcp://127.0.0.1:0", &settings(Payload::Png)).unwrap();
    let mut socket = subscribe(publisher.endpoint(), &[FRAME_TOPIC]).await;
    first_message(&publisher, &mut socket).await;
    publisher.frame(frame(5000));
    tokio::task::spawn_blocking(move || publisher.finish(LIMIT)).await.unwrap();
    while receive_header(&mut socket).await.frame != 5000 {}
}

#[tokio::test(flavor = "multi_thread")]
async fn a_unix_socket_serves_frames_and_replaces_one_that_was_left() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("frames");
    drop(std::os::unix::net::UnixListener::bind(&path).unwrap());
    let publisher = Publisher::start(&format!("ipc://{}", path.display()), &settings(Payload::Jpeg)).unwrap();
    let mut socket = subscribe(publisher.endpoint(), &[FRAME_TOPIC]).await;
    first_message(&publisher, &mut socket).await;
    tokio::task::spawn_blocking(move || publisher.finish(LIMIT)).await.unwrap();
    assert!(!path.exists());
}

#[test]
fn an_endpoint_in_use_is_said_at_start() {
    let publisher = Publisher::start("tcp://127.0.0.1:0", &settings(Payload::Jpeg)).unwrap();
    let taken = PublishSettings { endpoint: Some(publisher.endpoint().to_owned()), ..Default::default() };
    let error = Output::start(&taken, None).unwrap_err();
    assert!(matches!(error, PublishError::EndpointInUse { .. }));
    assert!(error.to_string().contains(publisher.endpoint()) && error.to_string().contains("in use"), "{error}");
}

#[test]
fn without_subscribers_nothing_is_encoded_and_nothing_waits() {
    let publisher = Publisher::start("tcp://127.0.0.1:0", &settings(Payload::Exr)).unwrap();
    for number in 0..100 {
        publisher.frame(frame(number));
    }
    let statistics = publisher.finish(LIMIT);
    assert_eq!((statistics.frames, statistics.sent, statistics.peak_queued_bytes), (100, 0, 0));
    assert_eq!(statistics.without_subscriber + statistics.superseded, 100);
}

#[test]
fn a_whole_run_leaves_its_folder_and_its_summary() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run");
    let settings = PublishSettings { keep: Some(3), ..settings(Payload::Jpeg) };
    let mut output = Output::start(&settings, Some(RunFolder::create(&path, false).unwrap())).unwrap();
    assert!(output.endpoint().unwrap().starts_with("tcp://127.0.0.1:"));
    for number in 0..10 {
        output.frame(frame(number));
    }
    let mut extra = serde_json::Map::new();
    extra.insert("scene".into(), "double_gyre".into());
    let summary = output.finish(extra);
    let files = summary.files.clone().unwrap();
    assert_eq!((summary.frames, files.records_written, files.pictures_written, files.pictures_removed), (10, 10, 10, 7));
    assert_eq!(summary.totals.warnings, 10);
    let written: Summary = serde_json::from_slice(&std::fs::read(path.join("summary.json")).unwrap()).unwrap();
    assert_eq!(written, summary);
    assert_eq!(written.run["scene"], "double_gyre");
    let text = std::fs::read_to_string(path.join("records.jsonl")).unwrap();
    assert_eq!(text.lines().count(), 10);
    assert!(path.join("frames/frame_000009.exr").exists() && !path.join("frames/frame_000006.png").exists());
}
