//! A server of files on this machine that may be far away, slow, broken or dishonest.

use std::collections::HashMap;
use std::io::{BufRead, BufReader, Write};
use std::net::{TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// A request for a file.
#[derive(Debug, Clone, PartialEq)]
pub struct Request {
    /// Path within the served folder, decoded.
    pub path: String,
    /// Earlier requests for the same bytes.
    pub again: usize,
    pub range: Option<String>,
    pub authorization: Option<String>,
}

/// What is done with a request.
#[derive(Debug, Clone, PartialEq)]
pub enum Answer {
    /// The file, or the range of it; 404 if there is none.
    File,
    /// This status, with a short body.
    Status(u16),
    /// The connection is closed.
    Drop,
    /// The connection is closed in the middle of the body.
    Half,
    /// As many bytes are announced as there are, and these more.
    Announce(i64),
    /// The file without a length, followed by bytes without an end.
    Endless,
    /// All of the file, whatever the range.
    Whole,
    /// A range that begins a byte later than asked for.
    Shifted,
    /// These bytes instead.
    Bytes(Vec<u8>),
    /// Nothing, while the server lives.
    Silence,
    /// A few bytes of the body, then nothing.
    Stall,
    /// Another path.
    Redirect(String),
    /// The file, with this header.
    With(&'static str),
}

/// The way to the server.
#[derive(Debug, Clone, Copy, Default)]
pub struct Line {
    /// Time from a request to the first byte of its answer, and to open a connection.
    pub latency: Duration,
    /// Of all connections together.
    pub bytes_per_second: Option<f64>,
}

struct Shared {
    root: PathBuf,
    line: Line,
    behave: Box<dyn Fn(&Request) -> Answer + Send + Sync>,
    requests: Mutex<Vec<Request>>,
    seen: Mutex<HashMap<(String, Option<String>), usize>>,
    now: AtomicUsize,
    most: AtomicUsize,
    sent: AtomicUsize,
    /// When the line is free.
    free: Mutex<Instant>,
    ended: AtomicBool,
}

/// A server, which ends when it is dropped.
pub struct Server {
    shared: Arc<Shared>,
    address: String,
    accepting: Option<JoinHandle<()>>,
}

impl Server {
    /// Serves a folder.
    pub fn start(root: &Path, line: Line, behave: impl Fn(&Request) -> Answer + Send + Sync + 'static) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = listener.local_addr().unwrap().to_string();
        let shared = Arc::new(Shared {
            root: root.to_owned(),
            line,
            behave: Box::new(behave),
            requests: Mutex::default(),
            seen: Mutex::default(),
            now: AtomicUsize::new(0),
            most: AtomicUsize::new(0),
            sent: AtomicUsize::new(0),
            free: Mutex::new(Instant::now()),
            ended: AtomicBool::new(false),
        });
        let served = shared.clone();
        let accepting = std::thread::spawn(move || {
            for stream in listener.incoming().flatten() {
                if served.ended.load(Ordering::SeqCst) {
                    return;
                }
                let served = served.clone();
                std::thread::spawn(move || served.connection(stream));
            }
        });
        Self { shared, address, accepting: Some(accepting) }
    }

    /// Serves a folder without faults.
    pub fn plain(root: &Path) -> Self {
        Self::start(root, Line::default(), |_| Answer::File)
    }

    pub fn address(&self) -> &str {
        &self.address
    }

    pub fn url(&self, path: &str) -> PathBuf {
        format!("http://{}/{path}", self.address).into()
    }

    /// The requests since the last call.
    pub fn take(&self) -> Vec<Request> {
        std::mem::take(&mut self.shared.requests.lock().unwrap())
    }

    /// Most requests that were answered at once.
    pub fn most_at_once(&self) -> usize {
        self.shared.most.load(Ordering::SeqCst)
    }

    /// Bytes of all bodies.
    pub fn sent(&self) -> usize {
        self.shared.sent.load(Ordering::SeqCst)
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.shared.ended.store(true, Ordering::SeqCst);
        // Wakes the thread that accepts.
        let _ = TcpStream::connect(&self.address);
        if let Some(thread) = self.accepting.take() {
            let _ = thread.join();
        }
    }
}

impl Shared {
    /// Answers requests until the client or a fault ends the connection.
    fn connection(&self, stream: TcpStream) {
        stream.set_read_timeout(Some(Duration::from_secs(30))).unwrap();
        stream.set_nodelay(true).unwrap();
        std::thread::sleep(self.line.latency);
        let mut reader = BufReader::new(stream.try_clone().unwrap());
        let mut stream = stream;
        while let Some(request) = self.request(&mut reader) {
            // Before the answer: who has it may ask for the list at once.
            self.requests.lock().unwrap().push(request.clone());
            let now = self.now.fetch_add(1, Ordering::SeqCst) + 1;
            self.most.fetch_max(now, Ordering::SeqCst);
            std::thread::sleep(self.line.latency);
            let again = self.answer(&request, &mut stream).unwrap_or(false);
            self.now.fetch_sub(1, Ordering::SeqCst);
            if !again {
                let _ = stream.shutdown(std::net::Shutdown::Both);
                return;
            }
        }
    }

    fn request(&self, reader: &mut impl BufRead) -> Option<Request> {
        let mut line = String::new();
        reader.read_line(&mut line).ok()?;
        let target = line.strip_prefix("GET /")?.split(' ').next()?.to_owned();
        let (mut range, mut authorization) = (None, None);
        loop {
            let mut line = String::new();
            reader.read_line(&mut line).ok()?;
            let Some((name, value)) = line.trim_end().split_once(": ") else { break };
            match &name.to_lowercase()[..] {
                "range" => range = Some(value.to_owned()),
                "authorization" => authorization = Some(value.to_owned()),
                _ => {}
            }
        }
        let (mut path, mut bytes) = (Vec::new(), target.bytes());
        while let Some(byte) = bytes.next() {
            let hex = |b: Option<u8>| char::from(b.unwrap()).to_digit(16).unwrap() as u8;
            path.push(if byte == b'%' { hex(bytes.next()) * 16 + hex(bytes.next()) } else { byte });
        }
        let path = String::from_utf8(path).unwrap();
        let mut seen = self.seen.lock().unwrap();
        let count = seen.entry((path.clone(), range.clone())).or_default();
        *count += 1;
        Some(Request { path, again: *count - 1, range, authorization })
    }

    /// Sends an answer; false if the connection ends then.
    fn answer(&self, request: &Request, stream: &mut TcpStream) -> std::io::Result<bool> {
        let answer = (self.behave)(request);
        let file = std::fs::read(self.root.join(&request.path)).ok();
        let data = match (&answer, file) {
            (Answer::Drop, _) => return Ok(false),
            (Answer::Silence, _) => {
                self.wait_for_the_end();
                return Ok(false);
            }
            (Answer::Status(status), _) => return self.short(stream, *status, ""),
            (Answer::Redirect(to), _) => return self.short(stream, 302, &format!("Location: {to}\r\n")),
            (Answer::Bytes(data), _) => data.clone(),
            (_, Some(data)) => data,
            (_, None) => return self.short(stream, 404, ""),
        };
        let range = request.range.as_deref().filter(|_| answer != Answer::Whole).map(|text| {
            let (from, to) = text.strip_prefix("bytes=").unwrap().split_once('-').unwrap();
            match (from.parse::<usize>(), to.parse::<usize>()) {
                (Ok(from), Ok(to)) => from..(to + 1).min(data.len()),
                (Err(_), Ok(last)) => data.len().saturating_sub(last)..data.len(),
                _ => panic!("{text}"),
            }
        });
        let mut head = String::new();
        let body = match &range {
            Some(range) if range.start >= range.end => return self.short(stream, 416, ""),
            Some(range) => {
                let shift = usize::from(answer == Answer::Shifted);
                let (from, to) = (range.start + shift, range.end - 1 + shift);
                head += &format!("HTTP/1.1 206 Partial Content\r\nContent-Range: bytes {from}-{to}/{}\r\n", data.len());
                &data[range.clone()]
            }
            None => {
                head += "HTTP/1.1 200 OK\r\n";
                &data[..]
            }
        };
        match &answer {
            Answer::Announce(more) => head += &format!("Content-Length: {}\r\n", body.len() as i64 + more),
            Answer::Endless => head += "Connection: close\r\n",
            _ => head += &format!("Content-Length: {}\r\n", body.len()),
        }
        if let Answer::With(header) = &answer {
            head += &format!("{header}\r\n");
        }
        stream.write_all(format!("{head}\r\n").as_bytes())?;
        match &answer {
            Answer::Half => self.send(stream, &body[..body.len() / 2]).map(|()| false),
            Answer::Stall => {
                self.send(stream, &body[..body.len() / 2])?;
                self.wait_for_the_end();
                Ok(false)
            }
            Answer::Announce(_) => self.send(stream, body).map(|()| false),
            Answer::Endless => loop {
                self.send(stream, body)?;
                self.send(stream, &[0; 1 << 16])?;
            },
            _ => self.send(stream, body).map(|()| true),
        }
    }

    fn short(&self, stream: &mut TcpStream, status: u16, header: &str) -> std::io::Result<bool> {
        write!(stream, "HTTP/1.1 {status} Status\r\n{header}Content-Length: 6\r\n\r\nno way")?;
        Ok(true)
    }

    fn send(&self, stream: &mut TcpStream, body: &[u8]) -> std::io::Result<()> {
        for part in body.chunks(1 << 16) {
            if let Some(rate) = self.line.bytes_per_second {
                let until = {
                    let mut free = self.free.lock().unwrap();
                    *free = (*free).max(Instant::now()) + Duration::from_secs_f64(part.len() as f64 / rate);
                    *free
                };
                std::thread::sleep(until.saturating_duration_since(Instant::now()));
            }
            stream.write_all(part)?;
            self.sent.fetch_add(part.len(), Ordering::SeqCst);
        }
        Ok(())
    }

    fn wait_for_the_end(&self) {
        while !self.ended.load(Ordering::SeqCst) {
            std::thread::sleep(Duration::from_millis(10));
        }
    }
}
