//! Clients of the command socket.

use crate::kit::scene::{double_gyre, setup};
use ridgewatch::run::Steering;
use ridgewatch::steer::{CommandSocket, Outcome, SteerError, Steerer};
use ridgewatch_wire::message::{ConnectionFile, Key};
use ridgewatch_zmtp::Requester;
use serde_json::{Value, json};
use std::os::unix::fs::MetadataExt;
use std::sync::Arc;
use std::time::Duration;
use tempfile::TempDir;
use zeromq::{Socket, SocketRecv, SocketSend};

const LIMIT: Duration = Duration::from_secs(30);

/// A command socket in a folder of its own, without a run.
struct Stage {
    folder: TempDir,
    socket: CommandSocket,
    steering: Arc<Steering>,
}

impl Stage {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let setup = setup(&double_gyre([32, 16, 1], "time.tau = 10"), &[]);
        let steering = Arc::new(Steering::new(&setup.plan));
        let endpoint = format!("ipc://{}", folder.path().join("commands").display());
        let socket = CommandSocket::bind(&endpoint, Arc::clone(&steering)).unwrap();
        Self { folder, socket, steering }
    }

    async fn steerer(&self) -> Steerer {
        Steerer::connect(self.socket.connection()).await.unwrap()
    }

    /// Number of commands that were accepted.
    fn commands(&self) -> u64 {
        self.steering.command(&serde_json::Map::new()).unwrap().commands
    }
}

async fn command(steerer: &mut Steerer, set: Value) -> Outcome {
    steerer.command(set.as_object().unwrap()).await.unwrap()
}

fn refusal(outcome: Outcome) -> String {
    match outcome {
        Outcome::Refused(refusal) => refusal.text,
        Outcome::Accepted(state) => panic!("accepted: {state:?}"),
    }
}

/// A client of its own, as docs/protocol.md describes one.
struct Raw {
    requester: Requester,
    session: Key,
}

impl Raw {
    async fn connect(stage: &Stage, key: &Key) -> Self {
        let mut requester = Requester::connect(stage.socket.endpoint(), 1 << 16).await.unwrap();
        let nonce = [7; 32];
        let hello = json!({"hello": 1, "nonce": "07".repeat(32)}).to_string();
        let answer = requester.ask(&[hello.as_bytes()], LIMIT).await.unwrap();
        let answer: Value = serde_json::from_slice(&answer[0]).unwrap();
        let digits = answer["challenge"].as_str().unwrap();
        let challenge: Vec<u8> = (0..32).map(|i| u8::from_str_radix(&digits[2 * i..2 * i + 2], 16).unwrap()).collect();
        Self { requester, session: key.derive(&[b"ridgewatch commands", &nonce, &challenge]) }
    }

    fn signed(&self, body: &str) -> [Vec<u8>; 2] {
        let signature = self.session.signature(&[b"command", body.as_bytes()]);
        [signature.iter().map(|byte| format!("{byte:02x}")).collect::<String>().into_bytes(), body.as_bytes().to_vec()]
    }

    /// The last part of the answer, and whether it was signed.
    async fn ask(&mut self, parts: &[Vec<u8>]) -> (Value, bool) {
        let parts: Vec<&[u8]> = parts.iter().map(Vec::as_slice).collect();
        let answer = self.requester.ask(&parts, LIMIT).await.unwrap();
        (serde_json::from_slice(answer.last().unwrap()).unwrap(), answer.len() == 2)
    }
}

fn key_of(stage: &Stage) -> Key {
    ConnectionFile::read(stage.socket.connection()).unwrap().key
}

#[tokio::test(flavor = "multi_thread")]
async fn each_command_is_answered_and_the_file_goes_with_the_socket() {
    let stage = Stage::new();
    let path = stage.socket.connection().to_owned();
    assert_eq!((path.metadata().unwrap().mode() & 0o777, path.parent()), (0o600, Some(stage.folder.path())));
    let mut steerer = stage.steerer().await;
    let Outcome::Accepted(state) = command(&mut steerer, json!({"paused": true, "trust.tolerance": 0.5})).await else { panic!() };
    assert_eq!((state.commands, state.paused, state.dimensions), (1, true, 2));
    let text = refusal(command(&mut steerer, json!({"trust.tolerance": -1})).await);
    assert_eq!(text, "`trust.tolerance` is -1.0; accepted: a number above 0");
    let text = refusal(command(&mut steerer, json!({"a".repeat(3000): 1})).await);
    assert!(text.len() < 600, "{text}");
    let Outcome::Accepted(state) = command(&mut steerer, json!({})).await else { panic!() };
    assert_eq!((state.commands, state.paused), (1, true));
    let second = CommandSocket::bind(stage.socket.endpoint(), Arc::clone(&stage.steering)).unwrap_err();
    assert!(second.to_string().contains("another program listens"), "{second}");
    drop(stage.socket);
    assert!(!path.exists() && steerer.command(&serde_json::Map::new()).await.is_err());
}

#[tokio::test(flavor = "multi_thread")]
async fn who_has_another_key_is_refused() {
    let stage = Stage::new();
    let mut stranger = Steerer::connect_to(stage.socket.endpoint(), &Key::random().unwrap()).await.unwrap();
    let error = stranger.command(json!({"paused": true}).as_object().unwrap()).await.unwrap_err();
    assert!(matches!(error, SteerError::Answer(_)) && error.to_string().contains("`signature` is another one"), "{error}");
    assert_eq!(stage.commands(), 0);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_message_counts_once_and_only_where_it_was_signed_for() {
    let stage = Stage::new();
    let mut client = Raw::connect(&stage, &key_of(&stage)).await;
    let paused = client.signed("{\"number\": 5, \"set\": {\"paused\": true}}");
    let (answer, is_signed) = client.ask(&paused).await;
    assert!(is_signed && answer["accepted"]["paused"] == true && answer["number"] == 5, "{answer}");
    for again in [paused.clone(), client.signed("{\"number\": 4, \"set\": {\"paused\": false}}")] {
        let (answer, is_signed) = client.ask(&again).await;
        let text = answer["refused"]["text"].as_str().unwrap();
        assert!(is_signed && text.contains("accepted: a number above 5"), "{answer}");
    }
    // Changed on its way.
    let mut changed = client.signed("{\"number\": 6, \"set\": {\"paused\": true}}");
    changed[1][11] = b'7';
    let (answer, is_signed) = client.ask(&changed).await;
    assert!(!is_signed && answer["refused"]["field"] == "signature", "{answer}");
    // On another connection, before and after its hello.
    let mut other = Requester::connect(stage.socket.endpoint(), 1 << 16).await.unwrap();
    let answer = other.ask(&[&paused[0], &paused[1]], LIMIT).await.unwrap();
    assert!(String::from_utf8_lossy(&answer[0]).contains("`hello` is missing"));
    let mut other = Raw::connect(&stage, &key_of(&stage)).await;
    assert_eq!(other.ask(&paused).await.0["refused"]["field"], "signature");
    assert_eq!(stage.commands(), 1);
}

#[tokio::test(flavor = "multi_thread")]
async fn what_is_not_understood_is_answered_or_ends_the_connection() {
    let stage = Stage::new();
    let key = key_of(&stage);
    let mut client = Raw::connect(&stage, &key).await;
    for (body, field) in [
        ("{\"number\": 1}", "command"),
        ("{\"number\": -1, \"set\": {}}", "command"),
        ("{\"number\": 1, \"set\": {}, \"more\": 1}", "command"),
        ("[", "command"),
        ("{\"number\": 2, \"set\": {\"camera\": {\"eye\": [1e999, 0, 0]}}}", "command"),
        ("{\"number\": 3, \"set\": {\"camera\": {\"eye\": [0, 0, 0]}}}", "camera"),
    ] {
        let (answer, is_signed) = client.ask(&client.signed(body)).await;
        assert!(is_signed && answer["refused"]["field"] == field, "{body}: {answer}");
    }
    for (parts, field) in [
        (&["{}"][..], "hello"),
        (&["{\"hello\": 2}"], "hello"),
        (&["{\"hello\": 1, \"nonce\": \"07\"}"], "nonce"),
        (&["a", "b", "c"], "message"),
    ] {
        let parts: Vec<Vec<u8>> = parts.iter().map(|part| part.as_bytes().to_vec()).collect();
        let (answer, is_signed) = client.ask(&parts).await;
        assert!(!is_signed && answer["refused"]["field"] == field, "{parts:?}: {answer}");
    }
    let long = client.signed(&format!("{{\"number\": 9, \"set\": {{\"{}\": 1}}}}", "a".repeat(4096)));
    assert!(client.requester.ask(&[&long[0], &long[1]], LIMIT).await.is_err());
    assert_eq!(stage.commands(), 0);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_flood_is_bounded_and_others_steer_on() {
    let stage = Stage::new();
    let mut steerer = stage.steerer().await;
    command(&mut steerer, json!({})).await;
    // Connections that prove nothing take no place of one that has.
    let mut strangers = Vec::new();
    for _ in 0..40 {
        strangers.push(Requester::connect(stage.socket.endpoint(), 1 << 16).await.unwrap());
    }
    let mut flood = Raw::connect(&stage, &key_of(&stage)).await;
    let mut answered = 0;
    while flood.requester.ask(&[b"{}"], LIMIT).await.is_ok() {
        answered += 1;
        assert!(answered < 20_000, "the flood is not bounded");
    }
    assert!(answered >= 9_000, "{answered}");
    let Outcome::Accepted(state) = command(&mut steerer, json!({"paused": true})).await else { panic!() };
    assert!(state.paused);
}

/// Another implementation of ZeroMQ.
#[tokio::test(flavor = "multi_thread")]
async fn sockets_of_type_req_and_dealer_are_served() {
    let stage = Stage::new();
    let hello = json!({"hello": 1, "nonce": "07".repeat(32)}).to_string();
    let mut request = zeromq::ReqSocket::new();
    request.connect(stage.socket.endpoint()).await.unwrap();
    let mut dealer = zeromq::DealerSocket::new();
    dealer.connect(stage.socket.endpoint()).await.unwrap();
    request.send(hello.clone().into()).await.unwrap();
    dealer.send(hello.into()).await.unwrap();
    for answer in [request.recv().await.unwrap(), dealer.recv().await.unwrap()] {
        assert!(answer.len() == 1 && String::from_utf8_lossy(answer.get(0).unwrap()).contains("challenge"), "{answer:?}");
    }
}
