//! The server of the dashboard: frames of a real publisher through a real WebSocket, and who is refused.
#![allow(clippy::unwrap_used)] // Tests: a panic is the report.

#[path = "../kit/mod.rs"]
mod kit;
mod layers;
mod metrics;
mod past;
mod planes;
mod program;
mod steering;
mod values;
mod visitor;
mod work;

use kit::publishing;
use ridgewatch::dashboard::{Dashboard, DashboardSettings, Token};
use ridgewatch::publish::{NewestFrame, PublishSettings, Publisher};
use ridgewatch::render::Film;
use ridgewatch::run::{ColorBar, Frame, FrameRecord};
use ridgewatch_zmtp::{Keep, Limits, PubSocket};
use serde_json::json;
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};
use tempfile::TempDir;
use visitor::{LIMIT, Received, Visitor, ask, get, socket_status};

const SIZE: [usize; 2] = [48, 32];

fn frame(number: u64) -> Frame {
    let [width, height] = SIZE;
    let rgba = vec![[number as f32 % 7.0 / 7.0, 0.25, 0.5, 1.0]; width * height];
    let bar = ColorBar { colors: vec![[1, 2, 3]; 32], low: 0.5, high: 2.0, unit: "1/s".into() };
    let record = FrameRecord { frame: number, time: 0.5 * number as f64, ..Default::default() };
    let film = Film { width, height, rgba, ..Default::default() };
    Frame { color_bar: Some(Arc::new(bar)), ..publishing::frame(record, film) }
}

/// A dashboard of an endpoint in a folder of its own, whose publisher may come and go.
struct Stage {
    folder: TempDir,
    dashboard: Dashboard,
    token: String,
}

impl Stage {
    fn new() -> Self {
        Self::with(tempfile::tempdir().unwrap(), None, None)
    }

    /// With the connection file of a command socket, or the newest frame of a run.
    fn with(folder: TempDir, steer: Option<PathBuf>, newest: Option<Arc<NewestFrame>>) -> Self {
        Self::start(folder, |settings| DashboardSettings { steer, newest, ..settings })
    }

    fn charted(chart: &str) -> Self {
        Self::start(tempfile::tempdir().unwrap(), |settings| DashboardSettings { chart: Some(chart.into()), ..settings })
    }

    fn start(folder: TempDir, change: impl FnOnce(DashboardSettings) -> DashboardSettings) -> Self {
        let token = Token::random().unwrap();
        let secret = token.secret().to_owned();
        let endpoint = format!("ipc://{}", folder.path().join("frames").display());
        let settings = change(DashboardSettings::local(endpoint, Some(0), token));
        Self { folder, dashboard: Dashboard::start(settings).unwrap(), token: secret }
    }

    fn address(&self) -> SocketAddr {
        self.dashboard.address()
    }

    fn endpoint(&self) -> String {
        format!("ipc://{}", self.folder.path().join("frames").display())
    }

    fn visit(&self) -> Visitor {
        Visitor::open(self.address(), &self.token)
    }

    /// Publishes a frame at each interval, until it is dropped.
    fn publish_every(&self, interval: Duration) -> Publishing {
        let publisher = Publisher::start(&self.endpoint(), &PublishSettings::default()).unwrap();
        let ends = Arc::new(AtomicBool::new(false));
        let until = Arc::clone(&ends);
        let thread = std::thread::spawn(move || {
            let begin = Instant::now();
            for number in 0.. {
                if until.load(Ordering::Relaxed) {
                    return;
                }
                publisher.frame(frame(number));
                std::thread::sleep((begin + interval * (number as u32 + 1)).saturating_duration_since(Instant::now()));
            }
        });
        Publishing { ends, thread: Some(thread) }
    }
}

struct Publishing {
    ends: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Drop for Publishing {
    fn drop(&mut self) {
        self.ends.store(true, Ordering::Relaxed);
        let _ = self.thread.take().map(JoinHandle::join);
    }
}

#[test]
fn the_chart_of_the_scene_goes_to_those_who_know_a_token() {
    let stage = Stage::charted("<svg>speed against accuracy</svg>");
    assert_eq!(stage.visit().until_state(|_| true)["has_chart"], true);
    let (status, answer) = get(stage.address(), &format!("/chart.svg?token={}", stage.token), &[]);
    assert!(status == 200 && answer.contains("content-type: image/svg+xml"), "{answer}");
    assert!(answer.ends_with("<svg>speed against accuracy</svg>"), "{answer}");
    assert_eq!(get(stage.address(), "/chart.svg", &[]).0, 403);
    assert_eq!(get(stage.address(), &format!("/chart.svg?token={}", stage.token), &["Origin: http://elsewhere"]).0, 403);
    let bare = Stage::new();
    assert_eq!(bare.visit().until_state(|_| true)["has_chart"], false);
    assert_eq!(get(bare.address(), &format!("/chart.svg?token={}", bare.token), &[]).0, 404);
}

#[test]
fn frames_and_records_arrive_and_advance() {
    let stage = Stage::new();
    let mut visitor = stage.visit();
    let state = visitor.until_state(|_| true);
    assert_eq!((&state["status"], &state["seconds_since_message"]), (&json!("waiting"), &json!(null)));
    assert_eq!((&state["endpoint"], &state["version"]), (&json!(stage.endpoint()), &json!(env!("CARGO_PKG_VERSION"))));
    let _publishing = stage.publish_every(Duration::from_millis(50));
    let (mut sequence, mut shown, mut recorded) = (0, None, None);
    let end = Instant::now() + LIMIT;
    while sequence < 20 {
        let received = visitor.next_until(end).expect("frames in time").unwrap();
        match received.kind() {
            "frame" => {
                let header = &received.json["header"];
                assert!(received.sequence() > sequence && header["frame"].as_u64() > shown, "{header}");
                (sequence, shown) = (received.sequence(), header["frame"].as_u64());
                assert_eq!((&header["record"]["frame"], &header["encoding"]), (&header["frame"], &json!("jpeg")));
                assert_eq!(header["color_bar"], json!({"colors": vec![[1, 2, 3]; 32], "low": 0.5, "high": 2.0, "unit": "1/s"}));
                let picture = image::load_from_memory(&received.payload).unwrap();
                assert_eq!([picture.width() as usize, picture.height() as usize], SIZE);
                visitor.acknowledge(sequence);
            }
            "records" => {
                for record in received.json["records"].as_array().unwrap() {
                    let number = record["frame"].as_u64().unwrap();
                    assert!(recorded.is_none_or(|before| number == before + 1), "every frame has a record");
                    recorded = Some(number);
                }
            }
            _ => {}
        }
    }
    assert!(recorded.unwrap() + 2 > shown.unwrap());
    let state = visitor.until_state(|state| state["status"] == "following");
    assert!(state["seconds_since_message"].as_f64().unwrap() < 3.0 && state["clients"] == 1 && state["problem"].is_null(), "{state}");
}

/// One shows nothing and acknowledges nothing; the other one keeps up.
#[test]
fn a_stalled_page_has_one_picture_and_costs_another_one_nothing() {
    let stage = Stage::new();
    let _publishing = stage.publish_every(Duration::from_millis(100));
    let (mut stalled, mut healthy) = (stage.visit(), stage.visit());
    let first = stalled.next("frame").sequence();
    let begin = healthy.frame().sequence();
    let mut last = begin;
    for _ in 0..40 {
        last = healthy.frame().sequence();
    }
    // 40 of them, of which the machine may lose some for a moment.
    assert!(last - begin < 40 + 10, "the healthy page missed {} of {}", last - begin - 40, last - begin);
    // What has come to the stalled one meanwhile: records and states, and no second picture.
    let (end, mut kinds) = (Instant::now() + Duration::from_secs(1), Vec::new());
    while let Some(received) = stalled.next_until(end) {
        kinds.push(received.unwrap().kind().to_owned());
    }
    kinds.sort();
    kinds.dedup();
    assert_eq!(kinds, ["records", "state"]);
    stalled.acknowledge(first);
    let next = stalled.frame().sequence();
    assert!(next > last, "after the acknowledgement comes the newest picture, not number {next}");
}

#[test]
fn strangers_are_refused() {
    let stage = Stage::new();
    let (address, token) = (stage.address(), stage.token.as_str());
    let port = address.port();
    let (page, socket) = (format!("/?token={token}"), format!("/socket?token={token}"));
    let host = format!("Host: {address}");
    let cookie = format!("Cookie: ridgewatch-{port}={token}; token={token}");
    let origin = format!("Origin: http://{address}");
    for (target, lines, status) in [
        (socket.as_str(), &[host.as_str(), &origin][..], 101),
        (&format!("/node/node17/8577/socket?token={token}"), &[&host, &origin], 101),
        // Cookies go to all servers of a host.
        ("/socket", &[&host, &origin, &cookie], 403),
        (&socket, &[&host], 101),
        ("/socket", &[&host, &origin], 403),
        ("/socket?token=", &[&host, &origin], 403),
        (&socket[..socket.len() - 1], &[&host, &origin], 403),
        (&format!("/socket?token={}", "0".repeat(64)), &[&host, &origin], 403),
        (&socket, &[&host, "Origin: https://evil.example.org"], 403),
        (&socket, &[&host, "Origin: null"], 403),
        (&socket, &[&host, &format!("Origin: http://{}:{}", address.ip(), port ^ 1)], 403),
        // A name that a stranger points at this machine: host and origin agree.
        (&socket, &["Host: evil.example.org", "Origin: http://evil.example.org"], 403),
        (&socket, &[&host, "Host: evil.example.org", &origin], 403),
    ] {
        assert_eq!(socket_status(address, target, lines), status, "{target} {lines:?}");
    }
    assert_eq!(get(address, &page, &[]).0, 200);
    // The page itself holds no data.
    let (status, text) = get(address, "/", &[]);
    assert!(status == 200 && !text.contains(token), "{text}");
    for target in ["/?token=", "/?token=wrong", "/node/node17/8577/?token=wrong"] {
        let (status, text) = get(address, target, &[]);
        assert!(status == 403 && text.contains("token") && !text.contains(token), "{text}");
    }
    assert_eq!(ask(address, &format!("GET {page} HTTP/1.1\r\nHost: evil.example.org\r\nConnection: close\r\n\r\n")).0, 403);
    assert_eq!(ask(address, &format!("GET {page} HTTP/1.1\r\nConnection: close\r\n\r\n")).0, 403);
    assert_eq!(ask(address, &format!("POST {page} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n")).0, 405);
}

#[test]
fn the_page_and_its_files_come_with_their_policy() {
    let stage = Stage::new();
    let (status, page) = get(stage.address(), &format!("/?token={}", stage.token), &[]);
    assert_eq!(status, 200);
    assert!(!page.to_lowercase().contains("set-cookie"), "{page}");
    // Only the host's own script and style, as the policy demands.
    assert!(page.contains("<html") && !page.contains("<script>") && !page.contains("style=\"") && !page.contains("//cdn"));
    for (target, media_type) in [("/page.js", "text/javascript"), ("/style.css", "text/css"), ("/some/prefix/page.js", "text/javascript")] {
        let (status, answer) = get(stage.address(), target, &[]);
        let answer = answer.to_lowercase();
        assert_eq!(status, 200, "{target}");
        assert!(answer.contains(&format!("content-type: {media_type}")), "{target}");
    }
    assert_eq!(get(stage.address(), "/nothing.js", &[]).0, 404);
    for target in [format!("/?token={}", stage.token), "/page.js".into(), "/nothing.js".into(), "/?token=wrong".into()] {
        let answer = get(stage.address(), &target, &[]).1.to_lowercase();
        for header in [
            "content-security-policy: default-src 'self';",
            "referrer-policy: no-referrer",
            "x-content-type-options: nosniff",
            "cache-control: no-store",
        ] {
            assert!(answer.contains(header), "{target}: {header}");
        }
        assert!(!answer.contains("unsafe-inline") && !answer.contains("access-control-allow-origin"));
    }
}

#[test]
fn a_publisher_that_stops_is_silent_within_five_seconds_and_recovers() {
    let stage = Stage::new();
    let mut visitor = stage.visit();
    let publishing = stage.publish_every(Duration::from_millis(50));
    let seen = (0..10).map(|_| visitor.frame().sequence()).max().unwrap();
    drop(publishing);
    let stopped = Instant::now();
    let state = visitor.until_state(|state| state["status"] != "following");
    assert_eq!(state["status"], "silent");
    assert!(stopped.elapsed() < Duration::from_secs(5), "{:?}", stopped.elapsed());
    assert!(state["seconds_since_message"].as_f64().unwrap() > 3.0, "{state}");
    let _publishing = stage.publish_every(Duration::from_millis(50));
    visitor.until_state(|state| state["status"] == "following");
    while visitor.frame().json["header"]["frame"].as_u64().unwrap() < 10 {}
    assert!(visitor.frame().sequence() > seen, "sequences go on");
}

/// Sends until the dashboard subscribes and follows.
/// Proxies as jupyter-server-proxy end a connection with a message of more than 10 MB.
#[test]
fn pictures_keep_messages_below_ten_megabytes() {
    let stage = Stage::new();
    let mut visitor = stage.visit();
    let publisher = raw_publisher(&stage, &mut visitor);
    let mut longest = 0;
    for (bytes, is_shown) in [(9_700_000, true), (10_000_000, false), (12_000_000, false)] {
        let header = json!({"protocol": 3, "frame": bytes, "encoding": "jpeg", "payload_bytes": bytes}).to_string();
        publisher.send(&[b"frame", header.as_bytes()], vec![7; bytes], Keep::All);
        if is_shown {
            let Received { json, payload } = visitor.frame();
            assert_eq!(payload.len(), bytes);
            longest = 4 + json.to_string().len() + payload.len();
        } else {
            let state = visitor
                .until_state(|state| state["problem"].as_str().is_some_and(|problem| problem.contains(&format!("of {bytes} bytes"))));
            assert!(state["problem"].as_str().unwrap().contains("publish.payload"), "{state}");
        }
    }
    assert!((9_700_000..10_000_000).contains(&longest), "{longest}");
}

/// Opens a WebSocket and then neither reads its messages as such nor answers any.
fn mute_page(address: SocketAddr, token: &str) -> TcpStream {
    let mut stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(LIMIT)).unwrap();
    let head = format!("GET /socket?token={token} HTTP/1.1\r\nHost: {address}\r\nOrigin: http://{address}\r\n");
    let upgrade =
        "Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n";
    stream.write_all(format!("{head}{upgrade}").as_bytes()).unwrap();
    stream
}

#[test]
fn a_page_that_answers_no_ping_is_disconnected_and_one_that_does_stays() {
    let stage = Stage::new();
    let mut quiet = stage.visit();
    let mut mute = mute_page(stage.address(), &stage.token);
    let watching = std::thread::spawn(move || {
        let (begin, mut received) = (Instant::now(), Vec::new());
        mute.read_to_end(&mut received).unwrap();
        (begin.elapsed(), received)
    });
    // Its library answers pings while it reads.
    let (begin, mut states) = (Instant::now(), 0);
    while begin.elapsed() < Duration::from_secs(26) {
        let received = quiet.next_until(Instant::now() + LIMIT).expect("states go on").unwrap();
        states += u32::from(received.kind() == "state");
    }
    assert!(states >= 20, "{states} states in 26 s");
    let (lasted, received) = watching.join().unwrap();
    // Ten seconds of silence, ten after the ping, and the next tick.
    assert!((Duration::from_secs(19)..Duration::from_secs(26)).contains(&lasted), "{lasted:?}");
    assert!(received.windows(2).any(|frame| frame == [0x89, 0]), "a ping came");
}

fn raw_publisher(stage: &Stage, visitor: &mut Visitor) -> PubSocket {
    let publisher = PubSocket::bind(&stage.endpoint(), None, Limits { queued: 5000, ..Limits::default() }).unwrap();
    kit::program::until("a subscription", || publisher.is_wanted(b"record") && publisher.is_wanted(b"frame"));
    publisher.send(&[b"record"], br#"{"frame":0}"#.to_vec(), Keep::All);
    visitor.until_state(|state| state["status"] == "following");
    publisher
}

#[test]
fn a_late_page_gets_the_latest_records() {
    let stage = Stage::new();
    let mut early = stage.visit();
    let publisher = raw_publisher(&stage, &mut early);
    for number in 1..2500 {
        publisher.send(&[b"record"], format!("{{\"frame\":{number},\"text\":\"\u{e9}\"}}").into_bytes(), Keep::All);
    }
    let mut newest = 0;
    while newest < 2499 {
        let records = early.next("records").json;
        newest = records["records"].as_array().unwrap().last().unwrap()["frame"].as_u64().unwrap();
    }
    let mut late = stage.visit();
    let first = late.next("records").json;
    let numbers: Vec<_> = first["records"].as_array().unwrap().iter().map(|record| record["frame"].as_u64().unwrap()).collect();
    assert_eq!((numbers.len(), numbers[0], numbers[1999]), (2000, 500, 2499));
    assert_eq!(first["skipped"], 500);
    // Long records: as many as a bounded number of bytes holds, in messages that proxies accept.
    for number in 2500..2700 {
        let long = json!({"frame": number, "text": "a".repeat(200_000)});
        publisher.send(&[b"record"], long.to_string().into_bytes(), Keep::All);
        std::thread::sleep(Duration::from_millis(2));
    }
    while early.next("records").json["records"].as_array().unwrap().last().unwrap()["frame"] != 2699 {}
    let (mut visitor, mut kept, mut last) = (stage.visit(), 0, json!(0));
    while last != 2699 {
        let records = visitor.next("records").json;
        assert!(records.to_string().len() < 10_000_000);
        kept += records["records"].as_array().unwrap().len();
        last = records["records"].as_array().unwrap().last().unwrap()["frame"].clone();
    }
    assert!((70..=84).contains(&kept), "16 MiB of them: {kept}");
}

#[test]
fn messages_that_are_not_understood_are_told_and_cost_nothing() {
    let stage = Stage::new();
    let mut visitor = stage.visit();
    let publisher = raw_publisher(&stage, &mut visitor);
    let header = |change: &str, to: serde_json::Value| {
        let mut header = json!({"protocol": 3, "frame": 1, "encoding": "jpeg", "payload_bytes": 3});
        header[change] = to;
        header.to_string().into_bytes()
    };
    let good = header("frame", json!(1));
    for (parts, hint) in [
        (vec![b"frame".to_vec(), header("protocol", json!(4))], "protocol 4; accepted: 3"),
        (vec![b"frame".to_vec(), header("encoding", json!("raw"))], "as raw; shown are jpeg, png and exr"),
        (vec![b"frame".to_vec(), header("encoding", json!("exr"))], "not understood"),
        (vec![b"frame".to_vec(), header("payload_bytes", json!(4))], "of 3 bytes, of which its header says 4"),
        (vec![b"frame".to_vec(), b"{".to_vec()], "not understood"),
        (vec![b"frame".to_vec(), b"{\"protocol\":3}".to_vec()], "not understood"),
        (vec![b"frame".to_vec(), b"\xff".to_vec()], "not understood"),
        (vec![b"frame".to_vec(), vec![b'['; 200_000]], "not understood"),
        (vec![b"frame".to_vec(), vec![b' '; 300_000]], "JSON of 300000 bytes"),
        (vec![b"frame".to_vec()], "a message of 2 parts"),
        (vec![b"record".to_vec()], "not understood"),
        (vec![b"work".to_vec()], "not understood"),
    ] {
        let parts: Vec<&[u8]> = parts.iter().map(Vec::as_slice).collect();
        publisher.send(&parts, b"abc".to_vec(), Keep::All);
        let state = visitor.until_state(|state| state["problem"].as_str().is_some_and(|problem| problem.contains(hint)));
        assert!(state["status"] == "following", "{state}");
        publisher.send(&[b"record"], br#"{"frame":1}"#.to_vec(), Keep::All);
        assert!(visitor.until_state(|_| true)["problem"].is_string(), "a record does not hide it");
        publisher.send(&[b"frame", &good], b"abc".to_vec(), Keep::All);
        assert_eq!(visitor.frame().payload, b"abc");
        visitor.until_state(|state| state["problem"].is_null());
    }
}

#[test]
fn a_page_that_says_something_else_is_disconnected() {
    let stage = Stage::new();
    for odd in ["", "{}", "ack", "{\"ack\":-1}", "{\"command\":1}", "{\"command\":1,\"set\":[]}"] {
        let mut visitor = stage.visit();
        visitor.say(odd);
        assert_eq!(visitor.close_code(), 1008, "{odd:?}");
    }
    let mut visitor = stage.visit();
    // Of a picture that was never sent.
    visitor.acknowledge(1 << 60);
    // The first may be older than the acknowledgement.
    (0..3).for_each(|_| drop(visitor.until_state(|_| true)));
}

#[test]
fn a_page_too_many_takes_the_place_of_the_idlest() {
    let stage = Stage::new();
    let mut visitors: Vec<_> = (0..64).map(|_| stage.visit()).collect();
    visitors[0].acknowledge(1);
    visitors[0].until_state(|state| state["clients"] == 64);
    let mut newest = stage.visit();
    assert_eq!(visitors[1].close_code(), 4001);
    newest.until_state(|state| state["clients"] == 64);
    visitors[0].until_state(|_| true);
}

#[test]
fn a_head_that_never_ends_is_not_waited_for() {
    let stage = Stage::new();
    let begin = Instant::now();
    let mut slow = TcpStream::connect(stage.address()).unwrap();
    slow.set_read_timeout(Some(LIMIT)).unwrap();
    slow.write_all(b"GET / HTTP/1.1\r\nHost: ").unwrap();
    slow.read_to_end(&mut Vec::new()).unwrap();
    // 10 seconds, and time for a busy machine.
    assert!((8.0..25.0).contains(&begin.elapsed().as_secs_f64()), "{:?}", begin.elapsed());
    let long = format!("GET / HTTP/1.1\r\nHost: {}\r\nX-Long: {}\r\n\r\n", stage.address(), "a".repeat(20 << 10));
    assert_eq!(ask(stage.address(), &long).0, 431);
}
