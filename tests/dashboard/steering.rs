//! Commands of pages on their way to the command socket, and who may send them.

use crate::Stage;
use crate::kit::scene::{double_gyre, setup};
use crate::visitor::Visitor;
use ridgewatch::run::Steering;
use ridgewatch::steer::CommandSocket;
use serde_json::{Value, json};
use std::path::Path;
use std::process::{Command, Output};
use std::sync::Arc;

fn command_socket(folder: &Path) -> CommandSocket {
    let setup = setup(&double_gyre([32, 16, 1], "time.tau = 10"), &[]);
    let endpoint = format!("ipc://{}", folder.join("commands").display());
    CommandSocket::bind(&endpoint, Arc::new(Steering::new(&setup.plan))).unwrap()
}

/// A dashboard that looks for a command socket in its folder.
fn stage() -> Stage {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("commands.connection");
    Stage::with(folder, Some(file), None)
}

fn answer(visitor: &mut Visitor, number: u64, set: Value) -> Value {
    visitor.say(&json!({"command": number, "set": set}).to_string());
    let answer = visitor.next("answer").json;
    assert_eq!(answer["command"], number);
    answer
}

fn refused(visitor: &mut Visitor, set: Value) -> String {
    answer(visitor, 1, set)["refused"].as_str().unwrap().to_owned()
}

#[test]
fn commands_are_passed_on_and_their_answers_back() {
    let stage = stage();
    let mut visitor = stage.visit();
    // Before the run and after it.
    visitor.until_state(|state| state["steering"]["none"].as_str().is_some_and(|why| why.contains("cannot be reached")));
    assert!(refused(&mut visitor, json!({"paused": true})).contains("the run is not steered: its command socket cannot be reached"));
    // The reason names a file, which is not for those who only watch.
    let state = Visitor::open(stage.address(), stage.dashboard.watching_url().split_once("token=").unwrap().1).until_state(|_| true);
    assert!(state["steering"]["none"].as_str().unwrap().contains("is not reached;"), "{state}");
    assert!(!state["steering"].to_string().contains("connection"), "{state}");
    let socket = command_socket(stage.folder.path());
    let state = |commands, paused| {
        json!({
            "commands": commands, "paused": paused, "dimensions": 2, "method": "gated", "budget": null, "tau": 10.0, "direction": "forward",
            "longest_tau": null,
        })
    };
    let begun = visitor.until_state(|state| !state["steering"]["ready"].is_null());
    assert_eq!(begun["steering"]["ready"], state(0, false));
    let paused = answer(&mut visitor, 2, json!({"paused": true}));
    assert_eq!(paused["accepted"], state(1, true));
    visitor.until_state(|state| state["steering"]["ready"]["paused"] == true);
    assert_eq!(refused(&mut visitor, json!({"trust.tolerance": -1})), "`trust.tolerance` is -1.0; accepted: a number above 0");
    assert!(refused(&mut visitor, json!({"render.width": 7})).contains("`render.width` cannot change during a run"));
    drop(socket);
    visitor.until_state(|state| state["steering"]["none"].is_string());
    let _next = command_socket(stage.folder.path());
    visitor.until_state(|state| state["steering"]["ready"]["commands"] == 0);
}

#[test]
fn who_only_watches_is_refused_by_the_server() {
    let stage = stage();
    let _socket = command_socket(stage.folder.path());
    let mut steering = stage.visit();
    let state = steering.until_state(|state| state["steering"]["ready"].is_object());
    let shared = state["token_to_share"].as_str().unwrap();
    assert!(stage.dashboard.watching_url().ends_with(shared) && shared != stage.token);
    let mut watching = Visitor::open(stage.address(), shared);
    let state = watching.until_state(|_| true);
    assert!(state["token_to_share"].is_null() && state["steering"]["ready"].is_object(), "{state}");
    assert!(refused(&mut watching, json!({"paused": true})).contains("only watches"));
    assert!(refused(&mut watching, json!({})).contains("only watches"));
    assert_eq!(answer(&mut steering, 3, json!({}))["accepted"]["commands"], 0);
    assert!(Visitor::open(stage.address(), &stage.token).until_state(|_| true)["token_to_share"].is_string());
}

#[test]
fn a_page_without_a_command_socket_is_told_so() {
    let stage = Stage::new();
    let mut visitor = stage.visit();
    let state = visitor.until_state(|_| true);
    assert!(state["steering"]["none"].as_str().unwrap().contains("without --steer"), "{state}");
    assert!(refused(&mut visitor, json!({"paused": true})).contains("without --steer"));
}

/// What `examples/steer.py` does with a connection file and a command.
fn python_client(file: &Path, command: &str) -> Output {
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/examples/steer.py");
    let python = std::env::var("PYTHON").unwrap_or_else(|_| "python3".to_owned());
    Command::new(python).arg(script).arg(file).arg(command).output().unwrap()
}

#[test]
#[ignore = "needs a Python with pyzmq, named by PYTHON"]
fn the_python_client_says_what_became_of_its_command() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("commands.connection");
    let fails = |command: &str, why: &str| {
        let output = python_client(&file, command);
        let said = String::from_utf8([output.stdout, output.stderr].concat()).unwrap();
        assert!(output.status.code() == Some(1) && said.contains(why) && !said.contains("Traceback"), "{command}: {said}");
    };
    fails("{}", "the connection file cannot be read");
    std::fs::write(&file, "nothing\n").unwrap();
    fails("{}", "is no connection file");
    let socket = command_socket(folder.path());
    let output = python_client(&file, "{\"paused\": true}");
    let answer: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert!(output.status.success() && answer["accepted"]["paused"] == true && answer["number"] == 1, "{answer}");
    fails("{\"trust.tolerance\": -1}", "`trust.tolerance` is -1.0");
    fails("paused", "the command is no JSON");
    fails("7", "cannot be read");
    // The key of another run, then no run at all.
    let text = std::fs::read_to_string(&file).unwrap();
    let key = text.lines().find(|line| line.starts_with("key")).unwrap();
    std::fs::write(&file, text.replace(key, &format!("key = {}", "0".repeat(64)))).unwrap();
    fails("{}", "not signed by this run");
    drop(socket);
    std::fs::write(&file, &text).unwrap();
    fails("{}", "no answer came within 5 seconds");
}

/// More commands than are answered at a time: each gets an answer, and the page stays.
#[test]
fn a_flood_of_commands_is_answered() {
    let stage = stage();
    let _socket = command_socket(stage.folder.path());
    let mut visitor = stage.visit();
    visitor.until_state(|state| state["steering"]["ready"].is_object());
    (0..500).for_each(|number| visitor.say(&json!({"command": number, "set": {"paused": true}}).to_string()));
    let answers: Vec<Value> = (0..500).map(|_| visitor.next("answer").json).collect();
    let accepted = answers.iter().filter(|answer| answer["accepted"].is_object()).count();
    assert!((1..500).contains(&accepted), "{accepted}");
    assert!(answers.iter().filter_map(|answer| answer["refused"].as_str()).all(|why| why.contains("an earlier command")));
}
