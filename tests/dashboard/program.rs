//! The program: `ridgewatch dashboard`, and `--dashboard` of a run.

use crate::kit::program::{Outcome, Running, ridgewatch, run, set, start, text, until};
use crate::kit::scene::{self, double_gyre};
use crate::visitor::{Visitor, get, socket_status};
use std::net::SocketAddr;
use std::os::unix::fs::DirBuilderExt;
use std::process::Command;
use std::time::Duration;

/// Address and token of a printed URL.
fn parts(url: &str) -> (SocketAddr, String) {
    let (address, token) = url.strip_prefix("http://").unwrap().split_once("/?token=").unwrap();
    (address.parse().unwrap(), token.to_owned())
}

/// Waits for the URL that is printed as JSON.
fn url(running: &Running) -> String {
    until("an address", || running.stdout().contains('}'));
    let mut values =
        serde_json::Deserializer::from_str(&running.stdout()).into_iter::<serde_json::Value>().map(Result::unwrap).collect::<Vec<_>>();
    values.remove(0)["url"].as_str().unwrap().to_owned()
}

fn dashboard(arguments: &[&str]) -> Command {
    let mut command = ridgewatch(["dashboard", "-vv", "--port", "0"]);
    command.args(arguments).env("RIDGEWATCH_LOG", "trace");
    command
}

fn stopped(running: Running) -> Outcome {
    running.signal(libc::SIGTERM);
    // It takes a fifth of a second; the machine may be busy.
    running.wait_at_most(Duration::from_secs(20)).success()
}

#[test]
fn the_token_is_printed_once_and_logged_never() {
    let folder = tempfile::tempdir().unwrap();
    let endpoint = format!("ipc://{}", folder.path().join("frames").display());
    let running = start(&mut dashboard(&[&endpoint, "--json"]));
    let (address, token) = parts(&url(&running));
    assert!(token.len() == 64 && address.ip().is_loopback());
    assert_eq!(get(address, &format!("/?token={token}"), &[]).0, 200);
    assert_eq!(get(address, &format!("/?token={token}0"), &[]).0, 403);
    assert_eq!(socket_status(address, &format!("/socket?token={token}"), &["Host: evil.org"]), 403);
    Visitor::open(address, &token).until_state(|state| state["endpoint"] == endpoint.as_str());
    let outcome = stopped(running);
    assert_eq!((outcome.stdout.matches(&token).count(), outcome.stderr.matches(&token).count()), (1, 0), "{}", outcome.stderr);
    assert!(outcome.stderr.contains(&endpoint), "something was logged: {}", outcome.stderr);
}

#[test]
fn a_token_in_a_file_stays_there() {
    let folder = tempfile::tempdir().unwrap();
    let (file, endpoint) = (folder.path().join("token"), format!("ipc://{}", folder.path().join("frames").display()));
    let running = start(&mut dashboard(&[&endpoint, "--token-file", text(&file)]));
    until("an address", || running.stdout().contains("ssh -L"));
    let token = std::fs::read_to_string(&file).unwrap().trim().to_owned();
    let printed = running.stdout();
    let address = printed.split("http://").nth(1).unwrap().split('/').next().unwrap().parse().unwrap();
    Visitor::open(address, &token).until_state(|_| true);
    let outcome = stopped(running);
    assert!(!outcome.stdout.contains(&token) && !outcome.stderr.contains(&token));
}

#[test]
fn requests_that_cannot_be_met_are_refused() {
    for (arguments, hint) in [
        (&["udp://127.0.0.1:1"][..], "neither tcp:// nor ipc://"),
        (&["tcp://127.0.0.1"], "no port"),
        (&["--allow-host", "https://portal.example.org"], "--allow-host"),
        (&["--set", "time.tau=1"], "no scene"),
    ] {
        run(&mut ridgewatch(["dashboard"].iter().chain(arguments))).refused(2, &[hint]);
    }
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let port = taken.local_addr().unwrap().port().to_string();
    run(&mut ridgewatch(["dashboard", "--port", &port])).refused(1, &["cannot listen", &port]);
}

#[test]
fn a_run_shows_itself_and_goes_on_without_a_free_port() {
    let folder = tempfile::tempdir().unwrap();
    let scene =
        scene::write(folder.path(), &double_gyre([32, 16, 1], "time.tau = 10\ntime.slides = 1000\nrender.method = \"reference\"\n"));
    let replay = |out: &str, options: &[&str]| {
        let mut command = ridgewatch(["replay", &scene, "--json", "--out", text(&folder.path().join(out))]);
        command.args(options).args(set(&["flow.steps=20"]));
        command
    };
    let endpoint = format!("ipc://{}", folder.path().join("frames").display());
    let running = start(&mut replay("shown", &["--dashboard=0", "--publish", &endpoint]));
    let (address, token) = parts(&url(&running));
    let mut visitor = Visitor::open(address, &token);
    let first = visitor.frame();
    assert_eq!(first.json["header"]["color_bar"]["colors"].as_array().unwrap().len(), 32);
    assert!(visitor.frame().sequence() > first.sequence());
    running.signal(libc::SIGTERM);
    let outcome = running.wait();
    assert!(!outcome.stderr.contains(&token), "{}", outcome.stderr);
    // The port is in use.
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let port = format!("--dashboard={}", taken.local_addr().unwrap().port());
    let outcome = run(&mut replay("hidden", &[&port, "--publish", &endpoint, "--seconds", "0.5"])).success();
    assert!(outcome.stderr.contains("there is no dashboard: cannot listen at"), "{}", outcome.stderr);
    assert!(outcome.json()["frames"].as_u64().unwrap() > 0);
}

#[test]
fn a_run_with_a_command_socket_is_steered_from_its_page() {
    let folder = tempfile::tempdir().unwrap();
    let scene =
        scene::write(folder.path(), &double_gyre([32, 16, 1], "time.tau = 10\ntime.slides = 10000\nrender.method = \"reference\"\n"));
    let [frames, commands] = ["frames", "commands"].map(|name| format!("ipc://{}", folder.path().join(name).display()));
    let mut replay = ridgewatch(["replay", &scene, "--json", "--out", text(&folder.path().join("run")), "--dashboard=0"]);
    let running =
        start(replay.args(["--publish", &frames, &format!("--steer={commands}")]).args(set(&["flow.steps=20", "publish.preview=false"])));
    let (address, token) = parts(&url(&running));
    let printed: serde_json::Value = serde_json::Deserializer::from_str(&running.stdout()).into_iter().next().unwrap().unwrap();
    let (_, watching) = parts(printed["watching_url"].as_str().unwrap());
    let mut visitor = Visitor::open(address, &token);
    visitor.until_state(|state| state["steering"]["ready"]["dimensions"] == 2 && state["token_to_share"] == watching.as_str());
    visitor.say(r#"{"command": 1, "set": {"trust.tolerance": 0.125}}"#);
    assert_eq!(visitor.next("answer").json["accepted"]["commands"], 1);
    while visitor.frame().json["header"]["record"]["tolerance"] != 0.125 {}
    running.signal(libc::SIGTERM);
    let outcome = running.wait();
    assert!(!outcome.stderr.contains(&token) && !outcome.stderr.contains(&watching), "{}", outcome.stderr);
}

#[test]
fn a_second_run_with_a_page_is_steered_at_an_endpoint_of_its_own() {
    let folder = tempfile::tempdir().unwrap();
    let private = folder.path().join("private");
    std::fs::DirBuilder::new().mode(0o700).create(&private).unwrap();
    let scene =
        scene::write(folder.path(), &double_gyre([32, 16, 1], "time.tau = 10\ntime.slides = 100000\nrender.method = \"reference\"\n"));
    let replay = |out: &str, options: &[&str]| {
        let mut command = ridgewatch(["replay", &scene, "--json", "--out", text(&folder.path().join(out))]);
        command
            .args(options)
            .args(set(&["flow.steps=20", "publish.preview=false", "publish.exr=\"none\""]))
            .env("XDG_RUNTIME_DIR", &private);
        command
    };
    let first = start(&mut replay("first", &["--dashboard=0", "--steer"]));
    let (address, token) = parts(&url(&first));
    let mut of_first = Visitor::open(address, &token);
    of_first.until_state(|state| state["steering"]["ready"]["commands"] == 0);
    let second = start(&mut replay("second", &["--dashboard=0", "--steer"]));
    let (address, token) = parts(&url(&second));
    let mut visitor = Visitor::open(address, &token);
    visitor.until_state(|state| state["steering"]["ready"]["commands"] == 0);
    visitor.say(r#"{"command": 1, "set": {"trust.tolerance": 0.125}}"#);
    assert_eq!(visitor.next("answer").json["accepted"]["commands"], 1);
    while visitor.frame().json["header"]["record"]["tolerance"] != 0.125 {}
    of_first.until_state(|state| state["steering"]["ready"]["commands"] == 0);
    // A named endpoint that is taken is refused, and so is one that no page would find.
    for options in [&["--dashboard=0", "--steer=private"][..], &["--steer"], &["--steer", "--publish=tcp://127.0.0.1:0"]] {
        run(&mut replay("third", options)).refused(1, &["command socket `private`: another program listens there"]);
        assert!(!folder.path().join("third").exists(), "{options:?}");
    }
    for running in [first, second] {
        running.signal(libc::SIGTERM);
        running.wait();
    }
    let left: Vec<_> = walk(&private).into_iter().filter(|name| name.ends_with(".connection")).collect();
    assert!(left.is_empty(), "{left:?}");
}

/// Names of the files below a folder.
fn walk(folder: &std::path::Path) -> Vec<String> {
    let entries = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    entries.flat_map(|path| if path.is_dir() { walk(&path) } else { vec![path.display().to_string()] }).collect()
}
