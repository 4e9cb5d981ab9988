//! Both ends of a session over a real connection.

use ridgewatch_wire::WireError;
use ridgewatch_wire::message::{Key, Session};
use std::net::{TcpListener, TcpStream};

/// Sessions of the relay and the follower, with the keys of each.
pub fn sessions(relay: &Key, follower: &Key) -> (Result<Session, WireError>, Result<Session, WireError>) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let (address, key) = (listener.local_addr().unwrap(), follower.clone());
    let client = std::thread::spawn(move || Session::connect(&mut TcpStream::connect(address).unwrap(), &key));
    let server = Session::accept(&mut listener.accept().unwrap().0, relay);
    (server, client.join().unwrap())
}

/// Sessions with one random key.
#[allow(dead_code)]
pub fn session() -> (Session, Session) {
    let key = Key::random().unwrap();
    let (relay, follower) = sessions(&key, &key);
    (relay.unwrap(), follower.unwrap())
}
