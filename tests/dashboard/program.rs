//! The program: `ridgewatch dashboard`, and `--dashboard` of a run.

use crate::kit::program::{Outcome, Running, ridgewatch, run, set, start, text, until};
use crate::kit::scene::{self, double_gyre};
use crate::visitor::{Visitor, ask, get, socket_status};
use std::fs::Permissions;
use std::net::SocketAddr;
use std::os::unix::fs::{DirBuilderExt, PermissionsExt};
use std::path::Path;
use std::process::Command;
use std::time::Duration;

/// Address and token of a printed URL.
pub fn parts(url: &str) -> (SocketAddr, String) {
    let (address, token) = url.strip_prefix("http://").unwrap().split_once("/?token=").unwrap();
    (address.parse().unwrap(), token.to_owned())
}

/// Waits for the URL that is printed as JSON.
pub fn url(running: &Running) -> String {
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

/// A run in this folder with these options.
fn replay(folder: &Path, options: &[&str]) -> Command {
    let scene = scene::write(folder, &double_gyre([32, 16, 1], "time.tau = 10\ntime.slides = 10000\nrender.method = \"reference\"\n"));
    let endpoint = format!("ipc://{}", folder.join("frames").display());
    let mut command = ridgewatch(["replay", &scene, "--json", "--out", text(&folder.join("run")), "--publish", &endpoint]);
    command.args(options).args(set(&["flow.steps=20", "publish.preview=false"]));
    command
}

#[test]
fn a_run_is_reached_by_an_allowed_name_and_the_token_of_a_file_alone() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("token");
    let steer = format!("--steer=ipc://{}", folder.path().join("commands").display());
    let options = ["--dashboard=0", &steer, "--allow-host", "Portal.example.org", "--token-file", text(&file)];
    let running = start(&mut replay(folder.path(), &options));
    let printed = url(&running);
    let address: SocketAddr = printed.strip_prefix("http://").unwrap().strip_suffix('/').unwrap().parse().unwrap();
    let token = std::fs::read_to_string(&file).unwrap().trim().to_owned();
    assert!(address.ip().is_loopback() && file.metadata().unwrap().permissions().mode() & 0o777 == 0o600);
    let mut visitor = Visitor::open(address, &token);
    visitor.frame();
    visitor.until_state(|state| state["token_to_share"].is_string());
    let asked =
        |host: &str| ask(address, &format!("GET /frame.json?token={token} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n")).0;
    assert_eq!(["portal.example.org", "portal.example.org:8443", "localhost", "node.example.org"].map(asked), [200, 200, 200, 403]);
    for (host, origin, status) in [
        ("portal.example.org", "https://portal.example.org", 101),
        ("localhost:8577", "https://portal.example.org", 101),
        ("localhost:8577", "https://node.example.org", 403),
        ("node.example.org", "https://node.example.org", 403),
    ] {
        let lines = [format!("Host: {host}"), format!("Origin: {origin}")];
        assert_eq!(socket_status(address, &format!("/socket?token={token}"), &lines.each_ref().map(String::as_str)), status, "{lines:?}");
    }
    assert_eq!(get(address, "/frame.json", &[]).0, 403);
    running.signal(libc::SIGTERM);
    let outcome = running.wait();
    assert!(!outcome.stdout.contains(&token) && !outcome.stderr.contains(&token) && !outcome.stdout.contains("watching_url"));
    assert!(!outcome.stderr.contains("open to other machines"), "{}", outcome.stderr);
}

#[test]
fn a_run_that_listens_for_other_machines_says_so_and_refuses_names_that_are_not_allowed() {
    let folder = tempfile::tempdir().unwrap();
    let running = start(&mut replay(folder.path(), &["--dashboard=0", "--bind", "0.0.0.0"]));
    let (address, token) = parts(&url(&running));
    assert!(address.ip().is_unspecified());
    let near = SocketAddr::from(([127, 0, 0, 1], address.port()));
    let asked = |host: &str| ask(near, &format!("GET /?token={token} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n")).0;
    assert_eq!(["192.0.2.7:8577", "node.example.org:8577"].map(asked), [200, 403]);
    running.signal(libc::SIGTERM);
    let warning = format!("{address} is open to other machines: without encryption");
    assert!(running.wait().stderr.contains(&warning));
}

#[test]
fn options_of_a_page_are_refused_before_the_work() {
    let folder = tempfile::tempdir().unwrap();
    let (file, ring) = (folder.path().join("token"), folder.path().join("ring"));
    let option = ["--token-file", text(&file)];
    for options in [&["--bind", "0.0.0.0"], &["--allow-host", "portal.example.org"], &option] {
        let given = options.join(" ");
        let hints = [given.as_str(), "accepted with --dashboard"];
        run(&mut replay(folder.path(), options)).refused(2, &hints);
        run(ridgewatch(["attach", text(&ring), "--tau", "1"]).args(options)).refused(2, &hints);
    }
    assert!(!file.exists());
    std::fs::write(&file, "a".repeat(64)).unwrap();
    std::fs::set_permissions(&file, Permissions::from_mode(0o644)).unwrap();
    run(replay(folder.path(), &option).arg("--dashboard")).refused(2, &["has mode 0644; accepted: a file that only its owner may read"]);
    run(ridgewatch(["attach", text(&ring), "--tau", "1", "--dashboard"]).args(option)).refused(2, &["has mode 0644"]);
    let name = ["--allow-host", "https://portal.example.org"];
    run(replay(folder.path(), &name).arg("--dashboard")).refused(2, &["--allow-host", "without scheme, port or path"]);
    assert!(!folder.path().join("run").exists());
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
