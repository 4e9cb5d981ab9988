//! The addresses of a name, with a limit: the system's own resolver has none that can be set, and may take minutes where a name server does not answer.

use std::io::{Error, ErrorKind, Result};
use std::net::{SocketAddr, ToSocketAddrs};
use std::sync::mpsc::{Receiver, RecvTimeoutError, sync_channel};
use std::time::{Duration, Instant};

/// Asks the system.
pub(super) fn system(address: &str) -> Result<Vec<SocketAddr>> {
    address.to_socket_addrs().map(Iterator::collect)
}

/// Looks names up, one at a time: where one takes longer than it is waited for, its thread is gone on with.
pub(super) struct Lookup<R> {
    resolve: R,
    /// What is being looked up, and where the answer comes.
    running: Option<(String, Receiver<Result<Vec<SocketAddr>>>)>,
}

impl<R: Fn(&str) -> Result<Vec<SocketAddr>> + Copy + Send + 'static> Lookup<R> {
    pub fn new(resolve: R) -> Self {
        Self { resolve, running: None }
    }

    /// The addresses of `HOST:PORT`. A lookup that was begun before, of another name too, is waited for first.
    ///
    /// # Errors
    /// None within the limit: it is still being looked up. Those of the system, and that no thread could be started.
    pub fn find(&mut self, address: &str, limit: Duration) -> Result<Vec<SocketAddr>> {
        // Numbers need no lookup.
        if let Ok(known) = address.parse() {
            return Ok(vec![known]);
        }
        let until = Instant::now() + limit;
        loop {
            let Some((of, answer)) = &self.running else {
                self.begin(address)?;
                continue;
            };
            match answer.recv_timeout(until.saturating_duration_since(Instant::now())) {
                Err(RecvTimeoutError::Timeout) => {
                    let what = format!(
                        "the name of `{of}` is still being looked up after {limit:?}; accepted: a name that is resolved by then, or a number"
                    );
                    return Err(Error::new(ErrorKind::TimedOut, what));
                }
                ended => {
                    let wanted = of == address;
                    self.running = None;
                    if wanted {
                        return ended.unwrap_or_else(|_| Err(Error::other("the thread that looks names up has panicked")));
                    }
                }
            }
        }
    }

    fn begin(&mut self, address: &str) -> Result<()> {
        let (to, answer) = sync_channel(1);
        let (resolve, name) = (self.resolve, address.to_owned());
        std::thread::Builder::new().name("ridgewatch-lookup".into()).spawn(move || drop(to.send(resolve(&name))))?;
        self.running = Some((address.to_owned(), answer));
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Mutex;
    use std::sync::atomic::{AtomicUsize, Ordering};

    const SHORT: Duration = Duration::from_millis(20);
    const LONG: Duration = Duration::from_secs(60);

    #[test]
    fn a_name_server_that_does_not_answer_costs_the_limit_and_one_thread() {
        static ASKED: AtomicUsize = AtomicUsize::new(0);
        // Locked: it does not answer.
        static SERVER: Mutex<()> = Mutex::new(());
        let answer: SocketAddr = "127.0.0.3:7".parse().unwrap();
        let resolve = |name: &str| {
            ASKED.fetch_add(1, Ordering::Relaxed);
            let _answering = SERVER.lock().unwrap();
            if name == "odd:7" { Err(ErrorKind::NotFound.into()) } else { Ok(vec!["127.0.0.3:7".parse().unwrap()]) }
        };
        let mut lookup = Lookup::new(resolve);
        let silent = SERVER.lock().unwrap();
        let begin = Instant::now();
        for name in ["node:7", "node:7", "odd:7"] {
            let error = lookup.find(name, SHORT).unwrap_err();
            assert!(error.kind() == ErrorKind::TimedOut && error.to_string().starts_with("the name of `node:7` is still"), "{error}");
        }
        assert!(begin.elapsed() < LONG);
        assert_eq!(lookup.find("127.0.0.9:1", SHORT).unwrap(), ["127.0.0.9:1".parse().unwrap()], "a number needs no server");
        drop(silent);
        assert_eq!(lookup.find("odd:7", LONG).unwrap_err().kind(), ErrorKind::NotFound);
        assert_eq!(lookup.find("node:7", LONG).unwrap(), [answer]);
        // Those of node, odd and node again.
        assert_eq!(ASKED.load(Ordering::Relaxed), 3);
    }

    #[test]
    fn the_system_knows_this_machine() {
        let found = Lookup::new(system).find("localhost:7", LONG).unwrap();
        assert!(!found.is_empty() && found.iter().all(|address| address.ip().is_loopback() && address.port() == 7), "{found:?}");
        assert!(Lookup::new(system).find("no port", LONG).is_err());
    }
}
