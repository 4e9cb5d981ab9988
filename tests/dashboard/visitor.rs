//! A browser as the server sees it: requests, and what comes over the WebSocket.

use serde_json::Value;
use std::io::{ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::time::{Duration, Instant};
use tungstenite::handshake::client::generate_key;
use tungstenite::{Error, Message, WebSocket};

/// Longer than anything here takes on a busy machine, so that a test that hangs fails.
pub const LIMIT: Duration = Duration::from_secs(60);
/// Interval at which a visitor looks up from its socket.
const GLANCE: Duration = Duration::from_millis(20);

/// Status and text of the answer to a GET, whose target and further lines of the head are given.
pub fn get(address: SocketAddr, target: &str, lines: &[&str]) -> (u16, String) {
    ask(address, &format!("GET {target} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n{}\r\n", head(lines)))
}

/// Status and text of the answer to these bytes.
pub fn ask(address: SocketAddr, request: &str) -> (u16, String) {
    let mut stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(LIMIT)).unwrap();
    stream.write_all(request.as_bytes()).unwrap();
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).unwrap();
    let answer = String::from_utf8_lossy(&answer).into_owned();
    (answer.split(' ').nth(1).unwrap_or_default().parse().unwrap_or_default(), answer)
}

/// Status of the answer to a request for a WebSocket with these lines in its head.
pub fn socket_status(address: SocketAddr, target: &str, lines: &[&str]) -> u16 {
    let upgrade =
        "Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n";
    let mut stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(LIMIT)).unwrap();
    write!(stream, "GET {target} HTTP/1.1\r\n{upgrade}{}\r\n", head(lines)).unwrap();
    let mut line = [0; 12];
    stream.read_exact(&mut line).unwrap();
    String::from_utf8_lossy(&line[9..]).parse().unwrap()
}

fn head(lines: &[&str]) -> String {
    lines.iter().map(|line| format!("{line}\r\n")).collect()
}

/// What came over a WebSocket.
#[derive(Debug)]
pub struct Received {
    pub json: Value,
    pub payload: Vec<u8>,
}

impl Received {
    pub fn of(bytes: &[u8]) -> Self {
        let length = u32::from_le_bytes(bytes[..4].try_into().unwrap()) as usize;
        Self { json: serde_json::from_slice(&bytes[4..4 + length]).unwrap(), payload: bytes[4 + length..].to_vec() }
    }

    pub fn kind(&self) -> &str {
        self.json["kind"].as_str().unwrap()
    }

    pub fn sequence(&self) -> u64 {
        self.json["sequence"].as_u64().unwrap()
    }
}

/// An open page.
pub struct Visitor {
    socket: WebSocket<TcpStream>,
    /// Sequence of a frame that came while another kind was waited for.
    passed: Option<u64>,
}

impl Visitor {
    pub fn open(address: SocketAddr, token: &str) -> Self {
        let stream = TcpStream::connect(address).unwrap();
        stream.set_read_timeout(Some(GLANCE)).unwrap();
        let request = tungstenite::http::Request::get(format!("ws://{address}/socket?token={token}"))
            .header("Host", address.to_string())
            .header("Origin", format!("http://{address}"))
            .header("Connection", "Upgrade")
            .header("Upgrade", "websocket")
            .header("Sec-WebSocket-Version", "13")
            .header("Sec-WebSocket-Key", generate_key());
        let mut shaking = tungstenite::client(request.body(()).unwrap(), stream);
        loop {
            match shaking {
                Ok((socket, _)) => return Self { socket, passed: None },
                Err(tungstenite::HandshakeError::Interrupted(middle)) => shaking = middle.handshake(),
                Err(error) => panic!("{error}"),
            }
        }
    }

    /// The next message until a moment. `None` if there was none.
    pub fn next_until(&mut self, end: Instant) -> Option<Result<Received, Error>> {
        while Instant::now() < end {
            match self.socket.read() {
                Ok(Message::Binary(bytes)) => return Some(Ok(Received::of(&bytes))),
                Ok(Message::Close(frame)) => panic!("closed: {frame:?}"),
                Ok(_) => {}
                Err(Error::Io(error)) if [ErrorKind::WouldBlock, ErrorKind::TimedOut].contains(&error.kind()) => {}
                Err(error) => return Some(Err(error)),
            }
        }
        None
    }

    /// The next message of a kind; others are skipped.
    pub fn next(&mut self, kind: &str) -> Received {
        let end = Instant::now() + LIMIT;
        loop {
            let received = self.next_until(end).unwrap_or_else(|| panic!("no message {kind} in {LIMIT:?}")).unwrap();
            if received.kind() == kind {
                return received;
            }
            if received.kind() == "frame" {
                self.passed = Some(received.sequence());
            }
        }
    }

    /// The next frame, acknowledged.
    pub fn frame(&mut self) -> Received {
        if let Some(passed) = self.passed.take() {
            self.acknowledge(passed);
        }
        let frame = self.next("frame");
        self.acknowledge(frame.sequence());
        frame
    }

    pub fn acknowledge(&mut self, sequence: u64) {
        self.say(&format!("{{\"ack\":{sequence}}}"));
    }

    pub fn say(&mut self, text: &str) {
        self.socket.send(Message::text(text)).unwrap();
    }

    /// Waits until the state says this. Returns it.
    pub fn until_state(&mut self, holds: impl Fn(&Value) -> bool) -> Value {
        let end = Instant::now() + LIMIT;
        loop {
            let state = self.next("state").json;
            if holds(&state) {
                return state;
            }
            assert!(Instant::now() < end, "{state}");
        }
    }

    /// Code with which the server closes the connection.
    pub fn close_code(&mut self) -> u16 {
        let end = Instant::now() + LIMIT;
        loop {
            match self.socket.read() {
                Ok(Message::Close(Some(frame))) => return frame.code.into(),
                Ok(_) => {}
                Err(Error::Io(error)) if [ErrorKind::WouldBlock, ErrorKind::TimedOut].contains(&error.kind()) => {}
                Err(error) => panic!("closed without a reason: {error}"),
            }
            assert!(Instant::now() < end, "it is not closed");
        }
    }
}
