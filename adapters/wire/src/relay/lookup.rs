//! Name lookup with a timeout. The system's resolver has no timeout that can be set, and may take minutes if a name server does not answer.

use std::io::{Error, ErrorKind, Result};
use std::net::{SocketAddr, ToSocketAddrs};
use std::sync::mpsc::{Receiver, RecvTimeoutError, sync_channel};
use std::time::{Duration, Instant};

/// Lookup by the system's resolver.
pub(super) fn system(address: &str) -> Result<Vec<SocketAddr>> {
    address.to_socket_addrs().map(Iterator::collect)
}

/// Looks up one name at a time. A lookup that exceeds the timeout continues in its thread, and the next call waits for it.
pub(super) struct Lookup<R> {
    resolve: R,
    /// The current lookup, and the channel of its result.
    running: Option<(String, Receiver<Result<Vec<SocketAddr>>>)>,
}

impl<R: Fn(&str) -> Result<Vec<SocketAddr>> + Copy + Send + 'static> Lookup<R> {
    pub fn new(resolve: R) -> Self {
        Self { resolve, running: None }
    }

    /// The addresses of `HOST:PORT`. An earlier lookup, even of another name, is waited for first.
    ///
    /// # Errors
    /// `TimedOut`: the lookup is not complete. Also errors of the system, and of starting a thread.
    pub fn find(&mut self, address: &str, limit: Duration) -> Result<Vec<SocketAddr>> {
        // Numeric addresses need no lookup.
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
                        "the lookup of `{of}` has taken longer than {limit:?}; accepted: a name that is resolved within that time, or a numeric address"
                    );
                    return Err(Error::new(ErrorKind::TimedOut, what));
                }
                ended => {
                    let wanted = of == address;
                    self.running = None;
                    if wanted {
                        return ended.unwrap_or_else(|_| Err(Error::other("the thread of the name lookup has panicked")));
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
        // While locked, the server does not answer.
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
            assert!(
                error.kind() == ErrorKind::TimedOut && error.to_string().starts_with("the lookup of `node:7` has taken longer"),
                "{error}"
            );
        }
        assert!(begin.elapsed() < LONG);
        assert_eq!(lookup.find("127.0.0.9:1", SHORT).unwrap(), ["127.0.0.9:1".parse().unwrap()], "a numeric address needs no server");
        drop(silent);
        assert_eq!(lookup.find("odd:7", LONG).unwrap_err().kind(), ErrorKind::NotFound);
        assert_eq!(lookup.find("node:7", LONG).unwrap(), [answer]);
        // Lookups of node, odd and node again.
        assert_eq!(ASKED.load(Ordering::Relaxed), 3);
    }

    #[test]
    fn the_system_knows_this_machine() {
        let found = Lookup::new(system).find("localhost:7", LONG).unwrap();
        assert!(!found.is_empty() && found.iter().all(|address| address.ip().is_loopback() && address.port() == 7), "{found:?}");
        assert!(Lookup::new(system).find("no port", LONG).is_err());
    }
}
