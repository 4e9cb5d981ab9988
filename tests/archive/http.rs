//! Zarr stores behind a URL: the velocities are those of the same store as a folder, or an error names the part within a bounded time.

use crate::kit::grids::packed_levels;
use crate::kit::http::{Answer, Line, Request, Server};
use crate::kit::netcdf::*;
use crate::kit::program;
use crate::kit::zarr::{Layout, Pack, V2, V3, write};
use crate::{DAYS, inspected, open, open_with, refused, same};
use ridgewatch::source::SnapshotSource;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};
use tempfile::tempdir;

const CUT: &[(&str, usize)] = &[("time", 1), ("y", 2), ("x", 3), ("level", 1), ("latitude", 2), ("longitude", 2)];
const OLD: Layout = Layout { consolidated: true, chunks: CUT, ..V2 };
const NEW: Layout = Layout { consolidated: true, chunks: CUT, ..V3 };
/// Each try of a part that a server never sends, and all its pauses.
const BOUND: Duration = Duration::from_secs(60);

fn field() -> Fixture {
    plane(CLASSIC, &[0.0, 1.0, 2.0], DAYS)
}

fn is_chunk(request: &Request) -> bool {
    !["zarr.json", ".zmetadata", ".zgroup", ".zarray", ".zattrs"].iter().any(|name| request.path.ends_with(name))
}

#[test]
fn velocities_are_those_of_the_folder() {
    let dir = tempdir().unwrap();
    let server = Server::plain(dir.path());
    let levels = || packed_levels(CLASSIC, &[850.0, 500.0, 700.0], 0.0);
    let layouts = [
        OLD,
        NEW,
        Layout { chunks: &[], ..OLD },
        Layout { pack: Pack::Blosc, sparse: true, separator: '/', ..OLD },
        Layout { pack: Pack::Zstd, sparse: true, ..NEW },
        Layout { shards: 2, ..NEW },
        Layout { shards: 3, turned: true, big_endian: true, sparse: true, pack: Pack::Gzip, ..NEW },
    ];
    for (number, layout) in layouts.iter().enumerate() {
        for (name, fixture, settings) in
            [("plane", field(), ""), ("levels", levels(), ""), ("part", levels(), "level = 500\nregion = [80, 200, -40, 40]")]
        {
            let folder = write(&fixture, layout, &dir.path().join(format!("{name} {number}.zarr")));
            let url = server.url(&format!("{name}%20{number}.zarr/"));
            same(&mut open_with(&[&url], settings), &mut open_with(&[&folder], settings), &format!("{name}, {layout:?}"));
        }
    }
    let url = server.url("plane%200.zarr");
    let inspection = inspected(&[&url]);
    assert_eq!((&inspection.format[..], inspection.problem, inspection.file), ("Zarr 2", None, url));
    // Components in stores of their own, one here and one there.
    let alone = |without: &str| {
        let mut fixture = field();
        fixture.variables.retain(|variable| variable.name != without);
        fixture
    };
    let u = write(&alone("v"), &OLD, &dir.path().join("u.zarr"));
    write(&alone("u"), &NEW, &dir.path().join("v.zarr"));
    same(&mut open(&[u, server.url("v.zarr")]), &mut open(&[dir.path().join("plane 0.zarr")]), "two places");
}

/// Answers the first request for each range of each part with `first`.
fn at_first(first: Answer) -> impl Fn(&Request) -> Answer + Send + Sync {
    move |request| if request.again == 0 { first.clone() } else { Answer::File }
}

#[test]
fn faults_that_pass_are_outlived() {
    let dir = tempdir().unwrap();
    let layouts = [Layout { pack: Pack::Zstd, ..OLD }, Layout { shards: 2, ..NEW }];
    let folders: Vec<PathBuf> = (0..2).map(|i| write(&field(), &layouts[i], &dir.path().join(format!("{i}.zarr")))).collect();
    let faults =
        [Answer::Drop, Answer::Half, Answer::Announce(10), Answer::Status(500), Answer::Status(503), Answer::Status(429), Answer::Shifted];
    for fault in faults {
        let server = Server::start(dir.path(), Line::default(), at_first(fault.clone()));
        for (number, folder) in folders.iter().enumerate() {
            let begin = Instant::now();
            same(&mut open(&[server.url(&format!("{number}.zarr"))]), &mut open(&[folder]), &format!("{fault:?}"));
            assert!(begin.elapsed() < BOUND, "{fault:?}: {:?}", begin.elapsed());
            let again = server.take().iter().filter(|request| request.again > 0).count();
            assert!(again > 0 || fault == Answer::Shifted && number == 0, "{fault:?} was not met");
        }
    }
}

#[test]
fn a_server_without_ranges_serves_shards() {
    let dir = tempdir().unwrap();
    let folder = write(&field(), &Layout { shards: 2, pack: Pack::Gzip, ..NEW }, &dir.path().join("a.zarr"));
    let server = Server::start(dir.path(), Line::default(), |_| Answer::Whole);
    same(&mut open(&[server.url("a.zarr")]), &mut open(&[folder]), "no ranges");
    assert!(server.take().iter().any(|request| request.range.is_some()));
}

#[test]
fn faults_that_stay_are_named() {
    let dir = tempdir().unwrap();
    write(&field(), &OLD, &dir.path().join("raw.zarr"));
    write(&field(), &Layout { pack: Pack::Zstd, ..OLD }, &dir.path().join("zstd.zarr"));
    write(&field(), &Layout { shards: 2, ..NEW }, &dir.path().join("shards.zarr"));
    let other = Answer::Bytes(b"<html>not a chunk, but a page of some length that explains this</html>".repeat(4000));
    let cases = [
        ("raw.zarr", Answer::Drop, "4 tries"),
        ("raw.zarr", Answer::Half, "4 tries"),
        ("zstd.zarr", Answer::Announce(7), "4 tries"),
        ("zstd.zarr", Answer::Announce(-3), "zstd"),
        ("raw.zarr", Answer::Announce(-3), "its metadata say"),
        ("raw.zarr", Answer::Announce(1 << 40), "more than the"),
        ("raw.zarr", Answer::Endless, "more than the"),
        ("raw.zarr", Answer::Status(502), "status 502 (4 tries"),
        ("raw.zarr", Answer::Status(401), "credentials"),
        ("raw.zarr", Answer::Status(418), "status 418"),
        ("raw.zarr", other.clone(), "bytes, more than the"),
        ("zstd.zarr", Answer::Bytes(b"garbage".to_vec()), "zstd"),
        ("raw.zarr", Answer::With("Content-Encoding: gzip"), "coding"),
        ("raw.zarr", Answer::Redirect("/elsewhere/again".into()), ""),
        ("shards.zarr", Answer::Shifted, "was asked for"),
        ("shards.zarr", Answer::Half, "4 tries"),
        ("shards.zarr", Answer::Announce(9), " announced (4 tries"),
        ("shards.zarr", Answer::Bytes(b"short".to_vec()), "it ends after 5 bytes"),
        ("shards.zarr", Answer::Status(416), "shorter than the range"),
    ];
    std::thread::scope(|scope| {
        for (store, fault, said) in &cases {
            let dir = dir.path();
            scope.spawn(move || {
                let wrong = fault.clone();
                // Only one chunk, or shard, of the second time.
                let server = Server::start(dir, Line::default(), move |request| {
                    let hit = request.path.ends_with("u/1.0.0") || request.path.ends_with("u/c/0/0/0");
                    if hit { wrong.clone() } else { Answer::File }
                });
                let url = server.url(store);
                let mut archive = open_with(&[&url], "mask = \"none\"");
                let begin = Instant::now();
                let result = archive.read(1);
                assert!(begin.elapsed() < BOUND, "{store}, {fault:?}: {:?}", begin.elapsed());
                if let Answer::Redirect(_) = fault {
                    // It leads to nothing, so that the chunk is not stored.
                    assert!(result.unwrap().missing_nodes() > 0);
                    return;
                }
                let message = result.unwrap_err().to_string();
                let part = if *store == "shards.zarr" { "`u/c/0/0/0`" } else { "`u/1.0.0`" };
                for piece in [url.to_str().unwrap(), "variable `u`", part, said] {
                    assert!(message.contains(piece), "{store}, {fault:?}: {piece:?} is missing in: {message}");
                }
                // Other times are there still.
                if *store != "shards.zarr" {
                    archive.read(0).unwrap();
                }
            });
        }
    });
}

#[test]
fn what_is_no_store_is_refused() {
    let dir = tempdir().unwrap();
    write(&field(), &Layout { consolidated: false, ..OLD }, &dir.path().join("two.zarr"));
    write(&field(), &Layout { consolidated: false, ..NEW }, &dir.path().join("three.zarr"));
    std::fs::create_dir(dir.path().join("empty.zarr")).unwrap();
    std::fs::write(dir.path().join("a.nc"), b"CDF\x01").unwrap();
    let server = Server::plain(dir.path());
    for name in ["two.zarr", "three.zarr"] {
        let url = server.url(name);
        let pieces = [url.to_str().unwrap(), "without consolidated metadata", ".zmetadata", "zarr.consolidate_metadata(STORE)"];
        refused(&[&url], "", &pieces);
    }
    for name in ["empty.zarr", "a.nc", "gone"] {
        let url = server.url(name);
        refused(&[&url], "", &[url.to_str().unwrap(), "it holds no `zarr.json`, `.zmetadata`", "folders of Zarr stores"]);
    }
    let answers = |answer: Answer| Server::start(dir.path(), Line::default(), move |_| answer.clone());
    for (answer, pieces) in [
        (Answer::Status(403), &["403", "may not read it"][..]),
        (Answer::Status(401), &["cannot be opened", "`zarr.json`", "RIDGEWATCH_HTTP_AUTHORIZATION"]),
        (Answer::Status(500), &["cannot be opened", "`zarr.json`: status 500 (4 tries"]),
        (Answer::Bytes(b"<html></html>".to_vec()), &["`zarr.json`", "expected value"]),
        (Answer::Bytes(b"{}".to_vec()), &["without consolidated metadata"]),
        (Answer::Announce(1 << 30), &["`zarr.json`"]),
        (Answer::Redirect("/x.zarr/zarr.json".into()), &["redirected more than 4 times"]),
        (Answer::Redirect("/a b?signature=hunter2".into()), &["`zarr.json`: it is redirected", "`Location`"]),
    ] {
        let server = answers(answer);
        std::fs::create_dir_all(dir.path().join("x.zarr")).unwrap();
        std::fs::write(dir.path().join("x.zarr/zarr.json"), b"{}").unwrap();
        let url = server.url("x.zarr");
        let said = refused(&[&url], "", &[&[url.to_str().unwrap()], pieces].concat()).to_string();
        assert!(!said.contains("hunter2"), "{said}");
    }
    // Nobody listens.
    let gone = answers(Answer::File).url("x.zarr");
    refused(&[&gone], "", &[gone.to_str().unwrap(), "cannot be opened: `zarr.json`", "4 tries"]);
}

#[test]
fn urls_that_are_not_accepted_show_no_secret() {
    let dir = tempdir().unwrap();
    for (url, piece) in [
        ("https://me:hunter2@host.invalid/x.zarr", "names a user"),
        ("https://host.invalid/x.zarr?token=hunter2", "`?`"),
        ("https://host.invalid/*.zarr", "is a pattern"),
        ("s3://bucket/x.zarr", "amazonaws.com"),
    ] {
        let said = refused(&[url], "", &[piece]).to_string();
        assert!(!said.contains("hunter2"), "{said}");
        let scene = dir.path().join("scene.toml");
        std::fs::write(&scene, format!("source.kind = \"archive\"\narchive.files = [\"{url}\"]\n")).unwrap();
        let out = dir.path().join("out");
        for input in [program::text(&scene), url] {
            let outcome = program::run(&mut program::ridgewatch(["replay", input, "--out", program::text(&out)]));
            assert!(outcome.status != Some(0) && outcome.stderr.contains(piece), "{url}: {outcome:?}");
            assert!(!outcome.stderr.contains("hunter2") && !outcome.stdout.contains("hunter2"), "{outcome:?}");
            assert!(!out.exists(), "{url} is in a record");
        }
    }
}

/// A server that never answers, or stops in the middle, ends the program within its limit.
#[test]
fn waiting_has_a_limit() {
    let dir = tempdir().unwrap();
    write(&field(), &OLD, &dir.path().join("a.zarr"));
    for (answer, part) in
        [(Answer::Silence, "zarr.json"), (Answer::Silence, "u/0.0.0"), (Answer::Stall, ".zmetadata"), (Answer::Stall, "u/0.0.0")]
    {
        let wrong = answer.clone();
        let server = Server::start(
            dir.path(),
            Line::default(),
            move |request| {
                if request.path.ends_with(part) { wrong.clone() } else { Answer::File }
            },
        );
        let url = server.url("a.zarr");
        let mut command = program::ridgewatch(["inspect", program::text(&url), "--set", "archive.mask=none"]);
        let begin = Instant::now();
        let outcome = program::run(command.env("RIDGEWATCH_HTTP_LIMIT", "3"));
        assert!(begin.elapsed() < BOUND, "{answer:?} of {part} took {:?}", begin.elapsed());
        outcome.refused(1, &[program::text(&url), part, "tries"]);
    }
    let mut command = program::ridgewatch(["inspect", "http://127.0.0.1:1/x.zarr"]);
    program::run(command.env("RIDGEWATCH_HTTP_LIMIT", "soon")).refused(1, &["RIDGEWATCH_HTTP_LIMIT", "soon", "from 1 to 3600"]);
}

#[test]
fn a_chunk_that_is_forbidden_is_missing_while_the_store_may_be_read() {
    let dir = tempdir().unwrap();
    // Land is left out, as nothing but the fill value is stored there.
    let layout = Layout { sparse: true, ..OLD };
    let folder = write(&packed_levels(CLASSIC, &[850.0, 500.0], 0.0), &layout, &dir.path().join("a.zarr"));
    std::fs::remove_file(folder.join("u/1.0.1.1")).unwrap();
    let root = dir.path().to_owned();
    let unlisted = move |request: &Request| if root.join(&request.path).exists() { Answer::File } else { Answer::Status(403) };
    let server = Server::start(dir.path(), Line::default(), unlisted);
    same(&mut open(&[server.url("a.zarr")]), &mut open(&[&folder]), "403 for what is not stored");
    // One look at the metadata serves for all chunks that a request for a variable does not find, and they are not asked for again.
    server.take();
    let mut archive = open(&[server.url("a.zarr")]);
    archive.read(1).unwrap();
    let requests = server.take();
    let looks = requests.iter().filter(|request| request.path.ends_with(".zmetadata") && request.range.is_some()).count();
    let missing = requests.iter().filter(|request| is_chunk(request) && !dir.path().join(&request.path).exists()).count();
    assert!((1..=missing).contains(&looks), "{looks} looks for {missing} chunks");
    archive.read(1).unwrap();
    assert_eq!(server.take(), []);
}

#[test]
fn a_store_that_goes_away_ends_the_reading() {
    let dir = tempdir().unwrap();
    let folder = write(&field(), &OLD, &dir.path().join("a.zarr"));
    let settings = "mask = \"none\"";
    for status in [403, 404, 410] {
        let gone = Arc::new(AtomicBool::new(false));
        let over = gone.clone();
        let answer = move |_: &Request| if over.load(Ordering::SeqCst) { Answer::Status(status) } else { Answer::File };
        let server = Server::start(dir.path(), Line::default(), answer);
        let mut archive = open_with(&[server.url("a.zarr")], settings);
        archive.read(0).unwrap();
        gone.store(true, Ordering::SeqCst);
        let message = archive.read(1).unwrap_err().to_string();
        let looked = format!("`.zmetadata`: status {status}");
        assert!(["/1.", "it was not found", &looked].into_iter().all(|piece| message.contains(piece)), "{message}");
        assert_eq!(message.contains("asks for credentials"), status == 403, "{message}");
        // What was not found then is asked for again.
        gone.store(false, Ordering::SeqCst);
        same(&mut archive, &mut open_with(&[&folder], settings), &format!("after status {status}"));
    }
}

#[test]
fn only_the_chunks_in_question_are_asked_for_and_at_once() {
    let dir = tempdir().unwrap();
    let n = 24;
    let axis = |step: f64| (0..n).map(|i| i as f64 * step).collect::<Vec<_>>();
    let (days, x) = (axis(1.0), axis(1000.0));
    let axes = [("time", DAYS, &days[..4]), ("y", "m", &x), ("x", "m", &x)];
    let values = |seed: f64| f32s(fill(4, n, n, |t, y, x| 1.0 + seed + (t * 100 + y * 10 + x) as f64 * 0.01));
    let fixture = Fixture::on(CLASSIC, &axes).winds(values(0.0), values(1.0));
    const TILES: &[(&str, usize)] = &[("time", 1), ("y", 4), ("x", 4)];
    let shards = Layout { shards: 3, chunks: TILES, ..NEW };
    for (name, layout) in [("a.zarr", Layout { chunks: TILES, ..OLD }), ("b.zarr", shards)] {
        let folder = write(&fixture, &layout, &dir.path().join(name));
        let latency = Duration::from_millis(50);
        let server = Server::start(dir.path(), Line { latency, bytes_per_second: None }, |_| Answer::File);
        let url = server.url(name);
        let region = "mask = \"none\"\nregion = [0, 11000, 0, 11000]";
        let mut archive = open_with(&[&url], region);
        let expected = open_with(&[&folder], region).read(2).unwrap().nodes.clone();
        server.take();
        assert_eq!(archive.read(2).unwrap().nodes, expected);
        let chunks: Vec<Request> = server.take().into_iter().filter(is_chunk).collect();
        let different: BTreeSet<_> = chunks.iter().map(|request| (request.path.clone(), request.range.clone())).collect();
        // Nodes 0 to 11: three tiles of four along x and along y, of two variables; one index for each shard, which holds them all.
        let (tiles, indices) = (2 * 3 * 3, if layout.shards > 1 { 2 } else { 0 });
        assert_eq!((chunks.len(), different.len()), (tiles + indices, tiles + indices), "{chunks:#?}");
        let most = server.most_at_once();
        assert!((4..=16).contains(&most), "{name}: {most} at once");
        // What was read serves again.
        archive.read(2).unwrap();
        assert_eq!(server.take(), []);
    }
}

#[test]
fn a_redirect_is_followed_and_a_credential_stays_with_its_host() {
    let dir = tempdir().unwrap();
    let folder = write(&field(), &OLD, &dir.path().join("a.zarr"));
    let other = Server::plain(dir.path());
    let to = other.url("").display().to_string();
    let first = Server::start(dir.path(), Line::default(), move |request| {
        let (_, part) = request.path.split_once('/').unwrap();
        Answer::Redirect(format!("{to}a.zarr/{part}"))
    });
    let url = first.url("moved.zarr");
    same(&mut open(&[&url]), &mut open(&[&folder]), "a redirect");
    assert!(first.take().iter().chain(&other.take()).all(|request| request.authorization.is_none()));
    let mut command = program::ridgewatch(["inspect", program::text(&url)]);
    command.env("RIDGEWATCH_HTTP_AUTHORIZATION", format!("{} Bearer secret", first.address())).env("RIDGEWATCH_LOG", "trace");
    // Nobody listens there: what is sent to this machine takes no proxy.
    command.env("ALL_PROXY", "http://127.0.0.1:1").env_remove("NO_PROXY").env_remove("no_proxy");
    let outcome = program::run(&mut command).success();
    assert!(!outcome.stderr.contains("secret") && !outcome.stdout.contains("secret"), "{}", outcome.stderr);
    assert!(first.take().iter().all(|request| request.authorization.as_deref() == Some("Bearer secret")));
    assert!(other.take().iter().all(|request| request.authorization.is_none()));
}

/// Serves a folder by `openssl s_server`.
fn encrypted(folder: &Path, certificate: &Path, key: &Path) -> (program::Running, u16) {
    let mut command = Command::new("openssl");
    command.args(["s_server", "-WWW", "-accept", "127.0.0.1:0", "-cert"]).arg(certificate).arg("-key").arg(key);
    let server = program::start(command.current_dir(folder));
    let port = || server.stdout().lines().find_map(|line| line.strip_prefix("ACCEPT 127.0.0.1:").and_then(|port| port.parse().ok()));
    program::until("the server's start", || port().is_some());
    let port = port().unwrap();
    (server, port)
}

#[test]
fn a_certificate_is_accepted_from_its_authority_alone() {
    let dir = tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    let openssl = |arguments: &str| {
        let arguments = arguments.split(' ').map(|word| if word.contains('.') { at(word).into_os_string() } else { word.into() });
        program::run(Command::new("openssl").args(arguments)).success();
    };
    std::fs::write(at("san.ext"), "subjectAltName = DNS:localhost\nbasicConstraints = CA:FALSE\n").unwrap();
    openssl("req -x509 -newkey rsa:2048 -nodes -days 2 -subj /CN=authority -keyout ca.key -out ca.pem");
    openssl("req -newkey rsa:2048 -nodes -subj /CN=localhost -keyout own.key -out own.csr");
    openssl("x509 -req -days 2 -in own.csr -CA ca.pem -CAkey ca.key -CAcreateserial -extfile san.ext -out own.pem");
    write(&field(), &NEW, &at("a.zarr"));
    let (_server, port) = encrypted(dir.path(), &at("own.pem"), &at("own.key"));
    let inspect = |host: &str, authority: Option<&str>| {
        let mut command = program::ridgewatch(["inspect", &format!("https://{host}:{port}/a.zarr"), "--json"]);
        command.env_remove("SSL_CERT_FILE");
        program::run(command.envs(authority.map(|file| ("SSL_CERT_FILE", at(file)))))
    };
    let found = inspect("localhost", Some("ca.pem")).success().json();
    assert_eq!((&found["format"], &found["problem"]), (&"Zarr 3".into(), &serde_json::Value::Null));
    inspect("localhost", None).refused(1, &["`zarr.json`: no secure connection", "SSL_CERT_FILE"]);
    inspect("127.0.0.1", Some("ca.pem")).refused(1, &["`zarr.json`: no secure connection"]);
    inspect("localhost", Some("own.key")).refused(1, &["SSL_CERT_FILE", "holds no certificates"]);
    inspect("localhost", Some("gone.pem")).refused(1, &["SSL_CERT_FILE", "gone.pem"]);
}

/// Seconds to the first frame of a store here and far away, and bytes read over bytes needed: the figures of docs/archives.md.
#[test]
#[ignore = "takes a minute; measures"]
fn the_first_frame_from_far_away() {
    let dir = tempdir().unwrap();
    let n = 512;
    let axis = |step: f64, n: usize| (0..n).map(|i| i as f64 * step).collect::<Vec<_>>();
    let (days, x) = (axis(1.0, 16), axis(1000.0, n));
    let axes = [("time", DAYS, &days[..]), ("y", "m", &x), ("x", "m", &x)];
    let wave = |t: usize, y: usize, x: usize, seed: f64| (0.02 * x as f64 + seed + 0.1 * t as f64).sin() * (0.03 * y as f64).cos() * 0.05;
    let values = |seed: f64| f32s(fill(16, n, n, |t, y, x| wave(t, y, x, seed)));
    let fixture = Fixture::on(CLASSIC, &axes).winds(values(0.0), values(1.0));
    for (name, chunks) in [("a chunk a time", &[("time", 1)][..]), ("tiles of 128", &[("time", 1), ("y", 128), ("x", 128)])] {
        let store = format!("{}.zarr", chunks.len());
        let folder = write(&fixture, &Layout { pack: Pack::Zstd, chunks, ..OLD }, &dir.path().join(&store));
        let line = Line { latency: Duration::from_millis(200), bytes_per_second: Some(50e6) };
        let server = Server::start(dir.path(), line, |_| Answer::File);
        for (place, input, part) in [
            ("here", folder.clone(), false),
            ("far away", server.url(&store), false),
            ("here, a quarter", folder, true),
            ("far away, a quarter", server.url(&store), true),
        ] {
            let out = tempdir().unwrap();
            let out = out.path().join("out");
            let mut command = program::ridgewatch(["replay", program::text(&input), "--out", program::text(&out), "--method", "reference"]);
            for set in ["time.tau=\"6 days\"", "render.width=160", "render.height=80", "render.samples=1", "time.frames_per_slide=1"] {
                command.args(["--set", set]);
            }
            if part {
                command.args(["--set", "archive.region=[0, 255000, 0, 255000]"]);
            }
            let sent = server.sent();
            let begin = Instant::now();
            let mut running = program::start(command.env("RIDGEWATCH_LOG", "debug"));
            program::until("a frame", || running.has_ended() || out.join("records.jsonl").metadata().is_ok_and(|file| file.len() > 0));
            let first = begin.elapsed().as_secs_f64();
            let outcome = running.wait().success();
            let run = &program::summary(&out)["run"];
            println!(
                "{name}, {place}: first frame {first:.2} s, all {:.2} s, waited {} ({}); sent {} bytes, {} requests",
                begin.elapsed().as_secs_f64(),
                run["waited_seconds"],
                run["waited_share"],
                server.sent() - sent,
                server.take().len()
            );
            outcome.stderr.lines().filter(|line| line.contains("values of")).for_each(|line| println!("  {line}"));
        }
    }
}
